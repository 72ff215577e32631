"""Scenes of all kinds: furniture, rooms, vessels, a city, a cage, a tree, cloth, things that touch, far apart in size.

Each is a function of the image's size and of :class:`Sources`. The library is tried on them, so nothing in
them is made easy: bodies have the default settings, shapes have the faces that a modeler gives them, and parts overlap.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import warpshadow as ws
from demos import shapes
from demos.scenes import shipped_mesh
from demos.shapes import Point, X, Z, ball, box, cone, joined, open_box, ring, rod, turned

HIGH_SUN = (0.5, 0.9, 0.3)
LOW_SUN = (0.8, 0.3, 0.35)
GRAY = (0.7, 0.7, 0.7)
WOOD = (0.6, 0.42, 0.26)
WHITE = (0.8, 0.8, 0.78)
RED, GREEN, BLUE, GOLD = (0.75, 0.2, 0.15), (0.25, 0.6, 0.25), (0.2, 0.35, 0.7), (0.8, 0.6, 0.2)


@dataclass(frozen=True)
class Sources:
    """Where meshes and maps are from.

    Args:
        data: Folder with meshes/ and envmaps/, whose scan and whose maps stand in some of the scenes; None for a mesh
            that ships with Warp, and synthetic skies.
    """

    data: Path | None = None

    def scan(self) -> ws.Mesh:
        """A mesh of many faces."""
        return ws.load_mesh(self.data / "meshes" / "stanford-bunny.obj") if self.data else shipped_mesh("bunny")

    def sky(self, name: str, sun: Point, **options: float) -> ws.EnvironmentMap:
        """A map of the folder; or a synthetic sky, with its sun in a direction."""
        return ws.EnvironmentMap.read(self.data / "envmaps" / name) if self.data else ws.synthetic_sky(sun, **options)


Kind = Callable[[Sources, int], ws.Scene]


def body(
    mesh: ws.Mesh, albedo: Point = GRAY, at: Point = (0, 0, 0), *, name: str | None = None, **options: object
) -> ws.Body:
    """A body whose mesh's origin is at a place."""
    return ws.Body(mesh, albedo=albedo, translation=at, name=name or mesh.name, **options)


def standing(
    mesh: ws.Mesh, albedo: Point, foot: Point, size: float, *, name: str | None = None, **options: object
) -> ws.Body:
    """A body of a size that stands at a place."""
    return body(mesh, albedo, name=name, **options).on_ground(foot, size=size)


def ground(size: float = 6.0, albedo: Point = GRAY) -> ws.Body:
    return body(ws.plane(size, 64), albedo, name="ground")


def wall(size: tuple[float, float], at: Point, rotation: Point, albedo: Point, name: str) -> ws.Body:
    """A plane that faces +y, turned."""
    mesh = ws.plane(size, (round(8 * size[0]), round(8 * size[1])))
    return body(mesh, albedo, at, name=name, rotation=rotation)


def seen(
    bodies: Sequence[ws.Body],
    light: ws.EnvironmentMap,
    size: int,
    eye: Point = (1.6, 2.6, 4.6),
    target: Point = (0, 0.75, 0),
    *,
    fov_y: float = 36,
    near: float = 0.01,
) -> ws.Scene:
    return ws.Scene(bodies, light, ws.Camera.look_at(eye, target, fov_y=fov_y, size=(size, size), near=near))


def room(depth: float = 3.0) -> list[ws.Body]:
    """Floor, ceiling, two sides and a back, 3 units wide and high, that face each other; the front, +z, is open."""
    return [
        wall((3, depth), (0, 0, 0), (0, 0, 0), GRAY, "floor"),
        wall((3, depth), (0, 3, 0), (180, 0, 0), WHITE, "ceiling"),
        wall((3, depth), (-1.5, 1.5, 0), (0, 0, -90), RED, "left wall"),
        wall((3, depth), (1.5, 1.5, 0), (0, 0, 90), GREEN, "right wall"),
        wall((3, 3), (0, 1.5, -depth / 2), (90, 0, 0), WHITE, "back wall"),
    ]


# -------------------------------------------------------------------------------- furniture and rooms


TABLE_TOP = 1.03  # height of the round table


def laid_table() -> list[ws.Body]:
    """A round table with things on it, and a box below."""
    top = TABLE_TOP
    return [
        body(shapes.round_table(), WOOD),
        standing(shipped_mesh("bunny"), WHITE, (-0.4, top, -0.35), 0.7),
        standing(ws.icosphere(1.0, 4), RED, (0.35, top, 0.45), 0.4, name="ball"),
        standing(joined("cone", cone(0.2, 0.6)), GREEN, (0.55, top, -0.4), 0.6),
        standing(joined("ring", turned(ring(0.25, 0.08), 90, X)), BLUE, (-0.45, top, 0.45), 0.6),
        standing(joined("box", box((1, 1, 1))), GOLD, (0.0, 0, 0.3), 0.45, rotation=(0, 30, 0), name="box below"),
    ]


def table(sources: Sources, size: int) -> ws.Scene:
    column = joined("column", rod((0, 0, 0), (0, 1, 0), 0.3, 32))
    can = standing(column, GRAY, (0.05, TABLE_TOP, 0.0), 0.35, name="can")
    return seen([*laid_table(), can, ground()], ws.synthetic_sky(HIGH_SUN), size)


def open_room(sources: Sources, size: int) -> ws.Scene:
    bodies = [
        standing(shipped_mesh("bear"), GOLD, (-0.5, 0, -0.4), 1.5, rotation=(0, 30, 0)),
        standing(joined("box", box((1, 1.6, 1))), WHITE, (0.7, 0, 0.2), 1.3, rotation=(0, -20, 0)),
    ]
    return seen([*bodies, *room()], ws.synthetic_sky((0.4, 0.7, 1.0)), size, (0, 1.5, 6.6), (0, 1.45, 0), fov_y=34)


def closed_room(sources: Sources, size: int) -> ws.Scene:
    """Light comes through a window beside the camera."""
    front = body(shapes.wall_with_window(3, 3, (1.5, 1.25)), BLUE, (0, 1.5, 2), name="window wall")
    bodies = [
        standing(ws.icosphere(1.0, 4), GRAY, (-0.6, 0, -0.8), 1.0, name="ball"),
        standing(joined("box", box((1, 1, 1))), GOLD, (0.65, 0, -0.9), 0.9, rotation=(0, 25, 0)),
    ]
    light = ws.synthetic_sky((0.3, 0.6, 1.0))
    return seen([*bodies, *room(4.0), front], light, size, (1.2, 1.9, 1.7), (-0.2, 1.2, -1), fov_y=70)


def chair_wheel_fence(sources: Sources, size: int) -> ws.Scene:
    bodies = [
        body(shapes.chair(), WOOD, (-0.9, 0, 0.3), rotation=(0, 30, 0)),
        body(shapes.wheel(), GRAY, (0.75, 0.96, 0.3), rotation=(-14, -20, 0)),
        body(shapes.fence(), WHITE, (0, 0, -0.9), scale=1.2),
    ]
    return seen([*bodies, ground()], ws.synthetic_sky((-0.5, 0.8, 0.6)), size)


def shelf(sources: Sources, size: int) -> ws.Scene:
    bodies = [body(shapes.bookshelf(), WOOD)]
    for number, height in enumerate((0.075, 0.605, 1.135, 1.665)):
        shade = (RED, BLUE, GREEN, GOLD)[number]
        bodies.append(body(shapes.books(16, 1.5, number), shade, (0, height, -0.03)))
    back = wall((6, 4), (0, 2, -0.4), (90, 0, 0), WHITE, "wall")
    return seen([*bodies, back, ground()], ws.synthetic_sky((0.7, 0.8, 0.9)), size, (1.4, 1.9, 4.6), (0, 1.1, 0))


def nested_boxes(sources: Sources, size: int) -> ws.Scene:
    """Three boxes without lids, one in another, and a ball in the last."""
    bodies = []
    for edge, shade in ((1.8, WOOD), (1.25, BLUE), (0.75, WHITE)):
        mesh = joined(f"open box {edge}", open_box((edge, 0.6 * edge, edge), 0.05))
        height = 0.052 * len(bodies)
        bodies.append(body(mesh, shade, (0, height, 0), rotation=(0, 14 * len(bodies), 0)))
    bodies.append(standing(ws.icosphere(1.0, 4), RED, (0, 0.157, 0), 0.4, name="ball"))
    light = ws.synthetic_sky((0.4, 0.9, 0.5))
    return seen([*bodies, ground()], light, size, (1.3, 3.4, 3.2), (0, 0.3, 0))


def corner(sources: Sources, size: int) -> ws.Scene:
    """A box and a ball that touch two walls and the ground."""
    bodies = [
        body(joined("box", box((0.9, 1.2, 0.9))), GOLD, (-1.05, 0.6, -1.05)),
        standing(ws.icosphere(1.0, 4), WHITE, (0.5, 0, -1.1), 0.8, name="ball"),
        body(joined("board", turned(box((0.08, 1.9, 0.6)), 28, Z)), WOOD, (-1.0, 0.87, 0.4)),
        wall((4, 4), (0.5, 0, 0.5), (0, 0, 0), GRAY, "floor"),
        wall((4, 4), (-1.5, 2, 0.5), (0, 0, -90), RED, "left wall"),
        wall((4, 4), (0.5, 2, -1.5), (90, 0, 0), WHITE, "back wall"),
    ]
    return seen(bodies, ws.synthetic_sky((0.7, 0.8, 0.6)), size, (3.2, 2.6, 4.2), (-0.35, 0.65, -0.4), fov_y=32)


def cage(sources: Sources, size: int) -> ws.Scene:
    bodies = [
        body(shapes.cage(), GOLD),
        standing(shipped_mesh("bear"), WHITE, (0, 0.061, 0), 1.2, rotation=(0, 150, 0)),
    ]
    return seen([*bodies, ground()], ws.synthetic_sky((-0.6, 0.8, 0.3)), size)


# -------------------------------------------------------------------------------- vessels


def bowl(sources: Sources, size: int) -> ws.Scene:
    bodies = [body(shapes.bowl(), BLUE), standing(shipped_mesh("bear"), WHITE, (0, 0.13, 0), 1.1, rotation=(0, 130, 0))]
    return seen([*bodies, ground()], ws.synthetic_sky(HIGH_SUN), size, (1.4, 2.7, 3.4), (0, 0.45, 0))


def cups(sources: Sources, size: int) -> ws.Scene:
    bodies = [
        body(shapes.cup(), WHITE, (-0.75, 0, 0.45), rotation=(0, -40, 0), name="cup"),
        body(shapes.cup(), RED, (0.55, 0.41, 0.65), rotation=(0, 0, -80), name="lying cup"),
        body(shapes.bottle(), GREEN, (0, 0, -0.5)),
        body(shapes.bottle(), GOLD, (1.05, 0, -0.3), scale=0.6, name="small bottle"),
    ]
    light = sources.sky("workshop.hdr", (-0.4, 0.8, 0.5), sun_radius=6.0)
    return seen([*bodies, ground()], light, size, (1.2, 2.6, 4.4), (0.1, 0.55, 0), fov_y=34)


def textured(sources: Sources, size: int) -> ws.Scene:
    from demos.problems import pattern

    bodies = [
        ws.Body(shapes.vase(), texture=pattern(1), name="vase"),
        ws.Body(ws.plane(6.0, 64), texture=pattern(2), name="ground"),
    ]
    return seen(bodies, sources.sky("venice.exr", LOW_SUN), size)


# -------------------------------------------------------------------------------- buildings, machines


def city(sources: Sources, size: int) -> ws.Scene:
    """Thirty boxes and thirty cylinders, of six and four shapes, under a low sun."""
    rng = np.random.default_rng(5)
    towers = [
        joined(f"tower {k}", box((1, height, depth))) for k, (height, depth) in enumerate(rng.uniform(0.7, 3, (6, 2)))
    ]
    tanks = [joined(f"tank {k}", rod((0, 0, 0), (0, height, 0), 0.5, 24)) for k, height in enumerate((0.6, 1, 1.8, 3))]
    bodies = []
    for k in range(60):
        mesh = towers[k // 2 % 6] if k % 2 else tanks[k // 2 % 4]
        row, column = divmod(k, 8)
        foot = (
            np.array([0.62 * (column - 3.5), 0, 0.62 * (row - 3.5)])
            + np.append(rng.uniform(-0.08, 0.08, 2), 0)[[0, 2, 1]]
        )
        low, high = mesh.bounds
        width = rng.uniform(0.25, 0.42) / max(high[0] - low[0], high[2] - low[2])
        shade = tuple(rng.uniform(0.3, 0.8, 3))
        turn = (0, rng.uniform(-15, 15), 0)
        placed = standing(mesh, shade, foot, width * (high - low).max(), name=f"{mesh.name}, {k}", rotation=turn)
        bodies.append(placed)
    light = ws.synthetic_sky((0.8, 0.4, 0.5))
    return seen([*bodies, ground()], light, size, (2.6, 4.2, 5.4), (0, 0.2, 0.1), fov_y=38)


def stairs(sources: Sources, size: int) -> ws.Scene:
    bodies = [
        body(shapes.stairs(), GRAY, (-0.3, 0, 1.0)),
        standing(ws.icosphere(1.0, 4), RED, (-0.1, 1.5 / 9 * 5, 0.02), 0.3, name="ball"),
        wall((6, 4), (-1.06, 2, 0), (0, 0, -90), WHITE, "wall"),
    ]
    return seen(
        [*bodies, ground()], ws.synthetic_sky((0.8, 0.7, 0.1)), size, (3.0, 2.8, 4.4), (-0.2, 0.7, 0.1), fov_y=34
    )


def spiral(sources: Sources, size: int) -> ws.Scene:
    bodies = [body(shapes.spiral_stairs(), WOOD)]
    return seen([*bodies, ground()], ws.synthetic_sky((-0.6, 0.6, 0.5)), size, (2.0, 3.2, 5.4), (0, 1.15, 0))


def bracket(sources: Sources, size: int) -> ws.Scene:
    bodies = [
        body(shapes.bracket(), BLUE, (0, 0.06, 0), scale=1.1),
        body(joined("bolt", [rod((0, 0, 0), (0, 0.5, 0), 0.12, 24), rod((0, 0.5, 0), (0, 0.62, 0), 0.22, 6)]), GOLD),
        wall((6, 4), (0, 2, -1.0), (90, 0, 0), WHITE, "wall"),
    ]
    return seen([*bodies, ground()], ws.synthetic_sky((0.6, 0.7, 0.8)), size, (1.2, 1.7, 3.2), (0, 0.4, 0), fov_y=36)


# -------------------------------------------------------------------------------- organic, thin, far apart


def scan(sources: Sources, size: int) -> ws.Scene:
    bodies = [standing(sources.scan(), WHITE, (0, 0, 0), 2.0, name="scan")]
    return seen([*bodies, ground()], sources.sky("apartment.exr", (0.3, 0.8, -0.4), sun_strength=0.0), size)


def over_ball(sources: Sources, size: int) -> ws.Scene:
    bodies = [
        body(shapes.knot(), GOLD, (0, 1.75, 0), scale=0.55, rotation=(60, 0, 0)),
        standing(ws.icosphere(1.0, 5), WHITE, (0, 0, 0), 1.1, name="ball"),
    ]
    light = ws.synthetic_sky((0.3, 0.9, 0.25), sun_radius=0.4, sun_strength=6.0)
    return seen([*bodies, ground()], light, size)


def deformed(sources: Sources, size: int) -> ws.Scene:
    from demos.problems import bent

    bodies = [standing(bent(shipped_mesh("bunny"), 4), GOLD, (0, 0, 0), 2.0)]
    return seen([*bodies, ground()], ws.synthetic_sky(HIGH_SUN), size)


def tree(sources: Sources, size: int) -> ws.Scene:
    wood, leaves = shapes.tree()
    bodies = [body(wood, WOOD), body(leaves, GREEN)]
    return seen([*bodies, ground()], ws.synthetic_sky((0.7, 0.9, 0.2)), size, (1.6, 2.2, 5.6), (0, 1.05, 0))


def tent(sources: Sources, size: int) -> ws.Scene:
    """Cloth of one layer over what lies in it."""
    bodies = [
        body(shapes.tent(), GOLD, rotation=(0, 20, 0)),
        body(joined("pole", rod((0, 0, 1.05), (0, 1.36, 1.05), 0.03)), WOOD, rotation=(0, 20, 0)),
        standing(ws.icosphere(1.0, 4), RED, (0.1, 0, 0.55), 0.5, name="ball"),
        standing(joined("box", box((1, 0.5, 1))), BLUE, (1.5, 0, 0.6), 0.5, rotation=(0, 30, 0)),
    ]
    return seen([*bodies, ground()], ws.synthetic_sky((0.7, 0.7, 0.5)), size, (1.4, 1.8, 4.8), (0.1, 0.55, 0))


def land(sources: Sources, size: int) -> ws.Scene:
    """Things that stand, lie and stick in dunes: there is no level ground."""

    def on(x: float, z: float, sunk: float = 0.04) -> Point:
        return x, float(shapes.dune(x, z)) - sunk, z

    bodies = [
        body(shapes.dunes(), GOLD),
        standing(shipped_mesh("bear"), WHITE, on(0.75, 0.3), 0.9, rotation=(0, -50, 0)),
        body(
            joined("wall", [box((0.5, 0.7, 0.18), (x, shapes.dune(x, -0.9), -0.9)) for x in (-2, -1.5, -1, -0.5)]), GRAY
        ),
        standing(joined("stone", ball(0.3)), BLUE, on(-1.4, 0.9, 0.2), 0.6),
        body(shapes.bottle(), GREEN, on(-0.45, 1.5, -0.12), rotation=(0, 40, -80), scale=0.6),
        body(joined("post", rod((0, 0, 0), (0, 1, 0), 0.05)), WOOD, on(0.05, 0.7)),
    ]
    return seen(bodies, ws.synthetic_sky(LOW_SUN), size, (1.2, 2.4, 4.8), (-0.1, 0.1, 0.1))


def letters(sources: Sources, size: int) -> ws.Scene:
    slope = 22
    bodies = []
    for number, name in enumerate("WARP"):
        at = turned(box((0, 0, 0)), slope, X).vertices[0] + np.array([1.05 * (number - 1.5), 0, 0])
        bodies.append(body(shapes.letter(name), (RED, GOLD, GREEN, BLUE)[number], at, rotation=(slope, 0, 0)))
    plane = body(ws.plane(6.0, 64), WHITE, name="slope", rotation=(slope, 0, 0))
    return seen([*bodies, plane], ws.synthetic_sky((-0.7, 0.7, 0.3)), size, (0.9, 3.2, 6.2), (0, 0.35, 0))


def pile(sources: Sources, size: int) -> ws.Scene:
    """Fourteen bodies that stick in one another and in the ground."""
    from scipy.spatial.transform import Rotation

    rng = np.random.default_rng(11)
    meshes = [
        joined("brick", box((1, 0.5, 0.6))),
        joined("drum", rod((0, -0.5, 0), (0, 0.5, 0), 0.35, 24)),
        joined("ring", ring(0.4, 0.13)),
        joined("stone", ball(0.45)),
    ]
    bodies = []
    for k in range(14):
        spread = 0.95 * (1 - k / 16)
        at = (*rng.uniform(-spread, spread, 2), 0.15 + 0.075 * k)
        turn = Rotation.random(random_state=k).as_rotvec(degrees=True)
        shade = (RED, GOLD, BLUE, WHITE)[k % 4]
        mesh = meshes[k % 4]
        bodies.append(
            body(
                mesh, shade, (at[0], at[2], at[1]), rotation=turn, scale=rng.uniform(0.7, 1.1), name=f"{mesh.name}, {k}"
            )
        )
    return seen([*bodies, ground()], ws.synthetic_sky(LOW_SUN), size, (1.6, 2.4, 4.2), (0, 0.45, 0))


def thousand_to_one(sources: Sources, size: int) -> ws.Scene:
    """A bear that is a thousandth of the ball beside it, seen from near."""
    bodies = [
        body(ws.icosphere(1.0, 5), GOLD, (-1.07, 1.0, -0.33), name="large ball"),
        standing(shipped_mesh("bear"), WHITE, (0, 0, 0), 0.002, rotation=(0, 40, 0), name="small bear"),
    ]
    light = ws.synthetic_sky((0.5, 0.7, 0.4))
    eye, target = (0.0030, 0.0030, 0.0052), (0, 0.0009, 0)
    return seen([*bodies, ground()], light, size, eye, target, near=1e-4)


SCENES: dict[str, Kind] = {
    function.__name__: function
    for function in (
        table, open_room, closed_room, chair_wheel_fence, shelf, nested_boxes, corner, cage,
        bowl, cups, textured,
        city, stairs, spiral, bracket,
        scan, over_ball, deformed, tree, tent, land, letters, pile, thousand_to_one,
    )
}  # fmt: skip
"""All scenes by their names."""
