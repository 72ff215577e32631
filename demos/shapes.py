"""Shapes that code builds: furniture, vessels, cloth, plates with holes, a tree. Edges are sharp where they are bent.

Parts of a shape touch or overlap as modelers leave them: a chair is its legs, seat and slats in one mesh.
"""

from collections.abc import Callable, Iterable, Sequence

import numpy as np
import numpy.typing as npt
import trimesh
from trimesh.transformations import rotation_matrix

import warpshadow as ws

Part = trimesh.Trimesh
Point = Sequence[float]
X, Y, Z = np.eye(3)


def box(size: Point, middle: Point = (0, 0, 0)) -> Part:
    """A box of twelve faces."""
    return trimesh.creation.box(size).apply_translation(middle)


def rod(start: Point, end: Point, radius: float, sections: int = 12) -> Part:
    """A cylinder between two points, of as many sides, with no vertices along them."""
    return trimesh.creation.cylinder(radius, sections=sections, segment=[start, end])


def ball(radius: float, middle: Point = (0, 0, 0), subdivisions: int = 3) -> Part:
    """A sphere."""
    return trimesh.creation.icosphere(subdivisions, radius).apply_translation(middle)


def cone(radius: float, height: float, middle: Point = (0, 0, 0), sections: int = 24) -> Part:
    """A cone that stands on a point, upright."""
    return _upright(trimesh.creation.cone(radius, height, sections=sections)).apply_translation(middle)


def ring(radius: float, thickness: float, sections: tuple[int, int] = (48, 12)) -> Part:
    """A torus around the z axis."""
    return trimesh.creation.torus(radius, thickness, major_sections=sections[0], minor_sections=sections[1])


def lathed(profile: npt.ArrayLike, sections: int = 48) -> Part:
    """A closed solid around the y axis, of its profile: (distance from it, height), outside from the bottom up."""
    return _upright(trimesh.creation.revolve(profile, sections=sections))


def turned(part: Part, degrees: float, axis: npt.ArrayLike = Y) -> Part:
    """A part turned about an axis through the origin."""
    return part.apply_transform(rotation_matrix(np.radians(degrees), axis))


def joined(name: str, parts: Part | Iterable[Part]) -> ws.Mesh:
    """One mesh of parts."""
    whole = parts if isinstance(parts, Part) else trimesh.util.concatenate(list(parts))
    return ws.Mesh(whole.vertices, whole.faces, name=name).creased()


def sheet(name: str, point: Callable[..., npt.ArrayLike], columns: int, rows: int) -> ws.Mesh:
    """A grid with uvs, bent: ``point(u, v)`` gives x, y and z for arrays from 0 to 1. One layer, without thickness."""
    flat = ws.plane(1.0, (columns, rows))
    positions = np.stack(np.broadcast_arrays(*point(*flat.uvs.T)), axis=-1)
    return ws.Mesh(positions, flat.faces, flat.uvs, flat.uv_faces, name)


def _upright(part: Part) -> Part:
    """With its z axis up, along y."""
    return turned(part, -90, X)


# -------------------------------------------------------------------------------- furniture


def round_table(radius: float = 1.1, height: float = 1.0) -> ws.Mesh:
    """A thin round top on three thin legs that lean."""
    top = rod((0, height - 0.03, 0), (0, height + 0.03, 0), radius, 48)
    angles = np.radians([90, 210, 330])
    feet = [(np.sin(a), np.cos(a)) for a in angles]
    legs = [
        rod((0.9 * radius * x, 0, 0.9 * radius * z), (0.5 * radius * x, height, 0.5 * radius * z), 0.04)
        for x, z in feet
    ]
    return joined("round table", [top, *legs])


def chair() -> ws.Mesh:
    """Four legs, a thin seat, a back of slats."""
    legs = [box((0.07, 0.9, 0.07), (x, 0.45, z)) for x in (-0.4, 0.4) for z in (-0.4, 0.4)]
    seat = box((0.95, 0.06, 0.95), (0, 0.92, 0))
    posts = [box((0.07, 1.0, 0.07), (x, 1.43, -0.42)) for x in (-0.42, 0.42)]
    slats = [box((0.04, 0.9, 0.03), (x, 1.4, -0.42)) for x in np.linspace(-0.28, 0.28, 5)]
    return joined("chair", [*legs, seat, *posts, *slats, box((0.95, 0.1, 0.06), (0, 1.88, -0.42))])


def wheel(spokes: int = 14) -> ws.Mesh:
    """A rim with thin spokes between it and a hub, around the z axis."""
    hub = rod((0, 0, -0.12), (0, 0, 0.12), 0.1, 16)
    angles = 2 * np.pi * np.arange(spokes) / spokes
    rods = [
        rod((0.05 * np.cos(a), 0.05 * np.sin(a), 0), (0.9 * np.cos(a), 0.9 * np.sin(a), 0), 0.018, 8) for a in angles
    ]
    return joined("wheel", [ring(0.92, 0.06), hub, *rods])


def fence(pickets: int = 9) -> ws.Mesh:
    """Boards with pointed tops on two rails."""
    places = np.linspace(-1.2, 1.2, pickets)
    boards = [box((0.16, 0.85, 0.03), (x, 0.425, 0)) for x in places]
    tips = [turned(box((0.113, 0.113, 0.03)), 45, Z).apply_translation((x, 0.85, 0)) for x in places]
    return joined("fence", [*boards, *tips, *(box((2.7, 0.07, 0.05), (0, y, -0.04)) for y in (0.25, 0.65))])


def bookshelf() -> ws.Mesh:
    """Two sides, a back and five boards."""
    sides = [box((0.06, 2.2, 0.6), (x, 1.1, 0)) for x in (-0.8, 0.8)]
    boards = [box((1.6, 0.05, 0.58), (0, y, 0)) for y in (0.05, 0.58, 1.11, 1.64, 2.17)]
    return joined("bookshelf", [*sides, *boards, box((1.6, 2.2, 0.03), (0, 1.1, -0.29))])


def books(count: int, length: float, seed: int) -> ws.Mesh:
    """Upright boxes side by side, of which some are left out."""
    rng = np.random.default_rng(seed)
    x, parts = -length / 2, []
    for _ in range(count):
        thickness, height, depth = rng.uniform(0.05, 0.11), rng.uniform(0.28, 0.44), rng.uniform(0.3, 0.42)
        if rng.random() > 0.2 and x + thickness < length / 2:
            parts.append(box((0.96 * thickness, height, depth), (x + thickness / 2, height / 2, 0)))
        x += thickness
    return joined(f"books {seed}", parts)


def open_box(size: Point, thickness: float) -> list[Part]:
    """A box without a lid, of a bottom and four sides, that stands on the origin."""
    x, y, z = size
    bottom = box((x, thickness, z), (0, thickness / 2, 0))
    side, end = (thickness, y, z), (x, y, thickness)
    sides = [box(side, (s * (x - thickness) / 2, y / 2, 0)) for s in (-1, 1)]
    return [bottom, *sides, *(box(end, (0, y / 2, s * (z - thickness) / 2)) for s in (-1, 1))]


def cage(radius: float = 0.8, height: float = 1.7, bars: int = 18) -> ws.Mesh:
    """Thin bars between two rings, and a floor."""
    angles = 2 * np.pi * np.arange(bars) / bars
    upright = [
        rod((radius * np.cos(a), 0.03, radius * np.sin(a)), (radius * np.cos(a), height, radius * np.sin(a)), 0.022, 8)
        for a in angles
    ]
    rings = [_upright(ring(radius, 0.04)).apply_translation((0, y, 0)) for y in (0.06, height / 2, height)]
    return joined("cage", [*upright, *rings, rod((0, 0, 0), (0, 0.06, 0), radius, 48)])


# -------------------------------------------------------------------------------- vessels


def bowl(radius: float = 1.0) -> ws.Mesh:
    """A wall around most of a half ball, with a foot."""
    angle = np.radians(np.linspace(12, 82, 15))
    outside = np.stack([radius * np.sin(angle), radius * (1.05 - np.cos(angle))], axis=1)
    inside = np.stack([0.93 * radius * np.sin(angle), radius * (1.05 - 0.93 * np.cos(angle))], axis=1)[::-1]
    foot = [(0, 0), (0.4 * radius, 0), (0.3 * radius, 0.08 * radius)]
    return joined("bowl", lathed([*foot, *outside[1:], *inside, (0, inside[-1, 1])]))


def cup(radius: float = 0.4, height: float = 0.75) -> ws.Mesh:
    """A cup with a handle."""
    r, h = radius, height
    profile = [(0, 0), (0.8 * r, 0), (r, 0.15 * h), (r, h), (0.9 * r, h), (0.9 * r, 0.18 * h), (0.7 * r, 0.08 * h)]
    handle = ring(0.3 * h, 0.06 * h, (32, 10)).apply_translation((1.1 * r, 0.52 * h, 0))
    return joined("cup", [lathed([*profile, (0, 0.08 * h)]), handle])


def bottle() -> ws.Mesh:
    """A hollow bottle with a narrow neck, open at the top."""
    outside = [(0.36, 0), (0.4, 0.05), (0.4, 0.95), (0.36, 1.1), (0.2, 1.3), (0.12, 1.42), (0.11, 1.75), (0.13, 1.8)]
    inside = [(0.09, 1.8), (0.075, 1.4), (0.16, 1.28), (0.32, 1.08), (0.36, 0.95), (0.36, 0.08), (0, 0.06)]
    return joined("bottle", lathed([(0, 0), *outside, *inside]))


def vase() -> ws.Mesh:
    """A closed vessel with uvs, as wide as a sine wave."""

    def point(u: np.ndarray, v: np.ndarray) -> npt.ArrayLike:
        radius = (0.42 + 0.2 * np.sin(2 * np.pi * (v + 0.05))) * np.minimum(1, 12 * np.minimum(v, 1 - v))
        angle = 2 * np.pi * (u % 1)
        return radius * np.sin(angle), 1.7 * v, radius * np.cos(angle)

    return sheet("vase", point, 64, 60)


# -------------------------------------------------------------------------------- buildings, machines


def stairs(steps: int = 9) -> ws.Mesh:
    """Solid steps that rise towards -z."""
    rise, run = 1.5 / steps, 2.2 / steps
    return joined("stairs", [box((1.5, rise * (k + 1), run), (0, rise * (k + 1) / 2, -run * k)) for k in range(steps)])


def spiral_stairs(steps: int = 20) -> ws.Mesh:
    """Treads around a pole, each with a thin baluster, and a rail of rods."""
    height, turn = 2.3 / steps, np.radians(400 / steps)
    parts, tops = [rod((0, 0, 0), (0, 2.6, 0), 0.09, 20)], []
    for k in range(steps):
        tread = turned(box((0.85, 0.05, 0.26), (0.45, height * (k + 0.8), 0)), np.degrees(turn) * k)
        x, z = 0.82 * np.cos(turn * k), -0.82 * np.sin(turn * k)
        tops.append((x, height * (k + 0.8) + 0.5, z))
        parts += [tread, rod((x, height * (k + 0.8), z), tops[-1], 0.015, 8)]
    rail = [rod(a, b, 0.025, 8) for a, b in zip(tops, tops[1:], strict=False)]
    return joined("spiral stairs", [*parts, *rail])


def bracket() -> ws.Mesh:
    """Two plates at a right angle, with three holes each, and a rib."""
    base = _plate_with_holes(0.55, 3, 0.16, 0.1)
    upright = turned(_plate_with_holes(0.55, 3, 0.13, 0.1), 90, X).apply_translation((0, 0.275, -0.225))
    rib = trimesh.Trimesh(
        [(x, y, z) for x in (-0.04, 0.04) for y, z in ((0.05, -0.2), (0.05, 0.25), (0.5, -0.2))],
        [(0, 1, 2), (3, 5, 4), (0, 3, 4), (0, 4, 1), (1, 4, 5), (1, 5, 2), (0, 2, 5), (0, 5, 3)],
    )
    rib.fix_normals()
    return joined("bracket", [base, upright, rib])


def _plate_with_holes(cell: float, count: int, radius: float, thickness: float, sides: int = 32) -> Part:
    """A plate in the plane y = 0 of square cells along x, each around a hole."""
    angle = 2 * np.pi * np.arange(sides) / sides
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    square = cell / 2 * circle / np.abs(circle).max(axis=1, keepdims=True)
    here, beside = np.arange(sides), np.roll(np.arange(sides), -1)
    faces = np.concatenate(
        [np.stack([here, sides + here, sides + beside], 1), np.stack([here, sides + beside, beside], 1)]
    )
    shifts = cell * (np.arange(count) - (count - 1) / 2)
    points = np.concatenate([np.concatenate([radius * circle, square]) + (shift, 0) for shift in shifts])
    faces = np.concatenate([faces + 2 * sides * k for k in range(count)])
    _, first, place = np.unique(points.round(9), axis=0, return_index=True, return_inverse=True)
    plate = trimesh.creation.extrude_triangulation(points[first], place.ravel()[faces], thickness)
    return _upright(plate.apply_translation((0, 0, -thickness / 2)))


# -------------------------------------------------------------------------------- plants, cloth, letters


def tree(seed: int = 3) -> tuple[ws.Mesh, ws.Mesh]:
    """A trunk whose branches fork four times, and leaves of one layer at their ends."""
    rng = np.random.default_rng(seed)
    wood, tips = [], []

    def grow(start: np.ndarray, direction: np.ndarray, length: float, radius: float, forks: int) -> None:
        end = start + length * direction
        wood.append(rod(start, end, radius, 10))
        if not forks:
            tips.append(end)
            return
        for _ in range(3):
            side = direction + 0.6 * rng.standard_normal(3) + 0.35 * Y
            grow(end, side / np.linalg.norm(side), 0.68 * length, 0.6 * radius, forks - 1)

    grow(np.zeros(3), Y, 0.85, 0.09, 3)
    leaves = []
    for tip in tips:
        for _ in range(6):
            leaf = Part([(-0.07, 0, 0), (0, 0, 0.05), (0.09, 0, 0), (0, 0, -0.05)], [(0, 1, 2), (0, 2, 3)])
            leaf = turned(leaf, rng.uniform(0, 360), rng.standard_normal(3))
            leaves.append(leaf.apply_translation(tip + 0.12 * rng.standard_normal(3)))
    return joined("wood", wood), joined("leaves", leaves)


def tent() -> ws.Mesh:
    """A cloth over a ridge, which sags between it and the ground, open at both ends."""

    def point(u: np.ndarray, v: np.ndarray) -> npt.ArrayLike:
        side = 2 * u - 1
        sag = 0.1 * np.sin(np.pi * np.abs(side)) + 0.08 * np.sin(np.pi * v) * (1 - np.abs(side))
        return 1.1 * side, 1.35 * (1 - np.abs(side)) - sag * (np.abs(side) < 1) + 0.01, 2.2 * (0.5 - v)

    return sheet("tent", point, 32, 32)


def dune(x: npt.ArrayLike, z: npt.ArrayLike) -> np.ndarray:
    """Height of the dunes of :func:`dunes`: two ridges that bend, and ripples."""
    across = np.asarray(x) + 0.4 * np.sin(0.9 * np.asarray(z))
    return 0.3 * np.sin(2.1 * across) + 0.05 * np.sin(5 * across + 3 * np.asarray(z))


def dunes(size: float = 6.0) -> ws.Mesh:
    """Open land of low relief."""

    def point(u: np.ndarray, v: np.ndarray) -> npt.ArrayLike:
        x, z = size * (u - 0.5), size * (0.5 - v)
        return x, dune(x, z), z

    return sheet("dunes", point, 56, 56)


_LETTERS = {
    "W": [((0.12, 0.9), (-0.36, 0.45), -10), ((0.12, 0.9), (0.36, 0.45), 10)]
    + [((0.12, 0.66), (-0.13, 0.33), 20), ((0.12, 0.66), (0.13, 0.33), -20)],
    "A": [((0.12, 0.95), (-0.2, 0.45), 22), ((0.12, 0.95), (0.2, 0.45), -22), ((0.4, 0.1), (0, 0.32), 0)],
    "R": [((0.12, 0.9), (-0.25, 0.45), 0), ((0.5, 0.12), (0, 0.84), 0), ((0.5, 0.12), (0, 0.44), 0)]
    + [((0.12, 0.5), (0.22, 0.64), 0), ((0.12, 0.56), (0.12, 0.22), -35)],
    "P": [((0.12, 0.9), (-0.25, 0.45), 0), ((0.5, 0.12), (0, 0.84), 0), ((0.5, 0.12), (0, 0.42), 0)]
    + [((0.12, 0.5), (0.22, 0.63), 0)],
}
"""Strokes of letters: width and height, middle, and how far each is turned [degrees]."""


def letter(name: str, depth: float = 0.2) -> ws.Mesh:
    """A letter of bars that overlap: one of W, A, R and P."""
    return joined(
        name, [turned(box((*size, depth)), -angle, Z).apply_translation((*at, 0)) for size, at, angle in _LETTERS[name]]
    )


def knot(sections: tuple[int, int] = (160, 20)) -> ws.Mesh:
    """A tube along a trefoil knot."""

    def point(u: np.ndarray, v: np.ndarray) -> npt.ArrayLike:
        t, angle = 2 * np.pi * (u % 1), 2 * np.pi * (v % 1)  # both ends are the same points, bit for bit

        def line(t: np.ndarray) -> np.ndarray:
            return np.stack([np.sin(t) + 2 * np.sin(2 * t), np.cos(t) - 2 * np.cos(2 * t), -np.sin(3 * t)], axis=-1) / 3

        along = line(t + 1e-4) - line(t - 1e-4)
        side = np.cross(along, line(t))
        height = np.cross(side, along)
        side, height = (each / np.linalg.norm(each, axis=-1, keepdims=True) for each in (side, height))
        return (line(t) + 0.2 * (np.cos(angle)[:, None] * side + np.sin(angle)[:, None] * height)).T

    return sheet("knot", point, *sections)


def wall_with_window(width: float, height: float, window: tuple[float, float], cell: float = 0.125) -> ws.Mesh:
    """A wall in the plane z = 0 that faces -z, around its middle, of square faces, with a window in the middle."""
    flat = ws.plane((width, height), (round(width / cell), round(height / cell)))
    positions = flat.positions[:, [0, 2, 1]]
    middle = positions[flat.faces].mean(axis=1)
    seen = (np.abs(middle[:, 0]) > window[0] / 2) | (np.abs(middle[:, 1]) > window[1] / 2)
    return ws.Mesh(positions, flat.faces[seen], name="wall with a window")
