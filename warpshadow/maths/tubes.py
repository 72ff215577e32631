"""Tubes: rods that are bent, or closed to a ring, of quads around them; cut across, into straight segments."""

import functools
import itertools
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from warpshadow.maths.adjacency import area_normals, edges_of

SLACK = 0.2  # distance of a corner of a tube from its straight segments at most, over the radius of its section

MAX_SEGMENTS = 128  # segments of the tubes of a mesh at most: beyond, spheres are faster

_MAX_BEND = 0.95
"""Cosine of the angle between neighboring segments at least, 18°: with 30° shadows of rings had corners."""

_MAX_SWELL = 0.03
"""Distance of a section's corners from its middle, over that distance where it is straight, from 1 at most: rods bend,
and are not turned on a lathe. Grooves of a column would have no shadows on it."""

_MAX_TWIST = 0.02  # 1 − cos α of the angle between the triangles of a quad at most, 11°; and error of the volume


class Tube(NamedTuple):
    """A tube, cut into straight segments."""

    sections: np.ndarray
    """Vertices around it between segments and at its ends, neighbors along it in one column, int of shape
    [segment + 1, corner]: of a closed tube the last are the first."""
    segments: list[np.ndarray]  # triangles of the convex hull of two sections, which wind alike, [triangle, 3]
    gaps: np.ndarray  # largest distance of the surface from each segment [units of points], shape [segment]


class _Ring(NamedTuple):
    """A ring of quads around a tube: their numbers, and the vertices of its borders, in order around it."""

    quads: list[int]
    front: np.ndarray
    back: np.ndarray


def find_tube(points: np.ndarray, triangles: np.ndarray, maximum: int) -> Tube | None:
    """Cut a tube across.

    Args:
        points: Vertices, float64 of shape [vertex, 3].
        triangles: Triangles of a closed surface that wind alike, shape [triangle, 3].
        maximum: Number of segments at most.

    Returns:
        The tube; None where quads that are nearly flat, and flat ends, do not make one, where its sections are not
        convex, or where it has more segments.
    """
    pairs, corners = _quads(points, triangles)
    if not len(pairs):
        return None
    quad_at = {edge: divmod(k, 4) for k, edge in enumerate(_sides(corners))}
    for direction in range(2):
        steps, is_closed = _traverse_quads(corners, quad_at, 0, direction)
        if not is_closed:
            backward, _ = _traverse_quads(corners, quad_at, 0, direction + 2)
            steps = [(quad, (side + 2) % 4) for quad, side in backward[:0:-1]] + steps
        rings = [ring for ring in itertools.starmap(functools.partial(_ring, corners, quad_at), steps) if ring]
        if len(rings) == len(steps) and _covers(triangles, pairs, rings, is_closed):
            sections = np.array([rings[0].back, *(ring.front for ring in rings)])
            volumes = [_volume(points, _lofted(*pair)) for pair in itertools.pairwise(sections)]
            if min(volumes) > 0 and abs(sum(volumes) / _volume(points, triangles) - 1) < _MAX_TWIST:
                return _straightened(points, sections, maximum)
    return None


def _lofted(section: np.ndarray, next_section: np.ndarray) -> np.ndarray:
    """Triangles of the solid between two sections, shape [triangle, 3]."""
    rolled_section, next_rolled_section = np.roll(section, -1), np.roll(next_section, -1)
    sides = [[section, next_rolled_section, rolled_section], [section, next_section, next_rolled_section]]
    rest = np.arange(1, len(section) - 1)
    first, last = np.full(len(rest), section[0]), np.full(len(rest), next_section[0])
    ends = [[first, section[rest], rolled_section[rest]], [last, next_rolled_section[rest], next_section[rest]]]
    return np.concatenate([np.stack(columns, axis=1) for columns in (*sides, *ends)])


def _volume(points: np.ndarray, triangles: np.ndarray) -> float:
    """Volume that triangles enclose, below 0 where they face inward."""
    return float(np.linalg.det(points[triangles] - points[triangles[0, 0]]).sum() / 6)


def _bulge(points: np.ndarray, section: np.ndarray, next_section: np.ndarray, middle_sections: np.ndarray) -> float:
    """Largest distance of sections from the straight lines between two others."""
    starts, lines = points[section], points[next_section] - points[section]
    units = lines / np.linalg.norm(lines, axis=1, keepdims=True)
    return float(np.linalg.norm(np.cross(points[middle_sections] - starts, units), axis=-1).max(initial=0.0))


def _swell(radii: np.ndarray, chosen: np.ndarray) -> float:
    """Largest part by which radii of sections, [section, corner], differ from radii between chosen sections."""
    rings = np.arange(len(radii))
    expected = np.stack([np.interp(rings, chosen, column) for column in radii[chosen].T], axis=1)
    return float(np.abs(radii / expected - 1).max())


def _straightened(points: np.ndarray, sections: np.ndarray, maximum: int) -> Tube | None:
    """The tube of as few of the sections as there may be, about as many apart; None if they are too many."""
    middles = points[sections].mean(axis=1)
    radii, last = np.linalg.norm(points[sections] - middles[:, None], axis=2), len(sections) - 1
    for count in range(1, min(maximum, last) + 1):
        chosen = np.linspace(0, last, count + 1).round().astype(int)
        steps = np.diff(middles[chosen], axis=0)
        if (middles[0] == middles[-1]).all():
            steps = np.concatenate([steps, steps[:1]])
        lengths = np.linalg.norm(steps, axis=1)
        if not lengths.all() or ((steps[1:] * steps[:-1]).sum(axis=1) < _MAX_BEND * lengths[1:] * lengths[:-1]).any():
            continue
        if _swell(radii, chosen) > _MAX_SWELL:
            continue
        gaps = [_bulge(points, sections[a], sections[b], sections[a + 1 : b]) for a, b in itertools.pairwise(chosen)]
        if max(gaps) <= SLACK * radii.mean():
            segments = [_hull(points, pair) for pair in itertools.pairwise(sections[chosen])]
            hulls = sum(_volume(points, segment) for segment in segments)
            solids = sum(_volume(points, _lofted(*pair)) for pair in itertools.pairwise(sections[chosen]))
            return Tube(sections[chosen], segments, np.array(gaps)) if hulls < (1 + _MAX_TWIST) * solids else None
    return None


def _hull(points: np.ndarray, sections: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """Triangles of the convex hull of two sections, which wind alike, shape [triangle, 3]."""
    from scipy.spatial import ConvexHull

    vertices = np.unique(sections)
    hull = ConvexHull(points[vertices])
    corners = points[vertices[hull.simplices]]
    normals = area_normals(corners)
    is_inward = (normals * hull.equations[:, :3]).sum(axis=1) < 0
    triangles: np.ndarray = vertices[np.where(is_inward[:, None], hull.simplices[:, ::-1], hull.simplices)]
    return triangles


def _quads(points: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of triangles that are nearly in a plane and share their longest edge, and the corners of each in order.

    Returns:
        Numbers of the triangles, [quad, 2], and the corners, [quad, 4].
    """
    corners, edges, count = points[triangles], edges_of(triangles), len(triangles)
    normals = area_normals(corners)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True).clip(1e-30)
    longest = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2).argmax(axis=1)
    diagonals = edges[longest * count + np.arange(count)].tolist()
    number_at = {(a, b): number for number, (a, b) in enumerate(diagonals)}
    candidates = [(number, number_at.get((b, a), 0)) for number, (a, b) in enumerate(diagonals)]
    pairs = np.array([pair for pair in candidates if pair[0] < pair[1]], int).reshape(-1, 2)
    pairs = pairs[(normals[pairs[:, 0]] * normals[pairs[:, 1]]).sum(axis=1) > 1 - _MAX_TWIST]
    begin, end = np.array(diagonals)[pairs[:, 0]].T
    apex, other_apex = (triangles[pairs[:, side]].sum(axis=1) - begin - end for side in range(2))
    return pairs, np.stack([begin, other_apex, end, apex], axis=1)


def _sides(corners: np.ndarray) -> Iterator[tuple[int, int]]:
    """Sides of quads, four of each: that from one corner to the next."""
    return map(tuple, np.stack([corners, np.roll(corners, -1, axis=1)], axis=2).reshape(-1, 2).tolist())


def _traverse_quads(
    corners: np.ndarray, quad_at: dict[tuple[int, int], tuple[int, int]], quad: int, side: int
) -> tuple[list[tuple[int, int]], bool]:
    """Walk from a quad out of a side of it, straight on: quads and the sides by which each is left; whether it ends
    where it began.
    """
    steps = [(quad, side % 4)]
    visited = {quad}
    while True:
        quad, side = steps[-1]
        after = quad_at.get((int(corners[quad, (side + 1) % 4]), int(corners[quad, side])))
        if after is None:
            return steps, False
        if after[0] in visited:
            return steps, after == (steps[0][0], (steps[0][1] + 2) % 4)
        visited.add(after[0])
        steps.append((after[0], (after[1] + 2) % 4))


def _ring(corners: np.ndarray, quad_at: dict[tuple[int, int], tuple[int, int]], quad: int, side: int) -> _Ring | None:
    """The ring across a tube of a quad that is left by a side on the way along it; None if it does not close."""
    steps, is_closed = _traverse_quads(corners, quad_at, quad, side + 1)
    if not is_closed:
        return None
    quads, sides = np.array(steps).T
    return _Ring(quads.tolist(), corners[quads, (sides - 1) % 4], corners[quads, (sides + 2) % 4])


def _covers(triangles: np.ndarray, pairs: np.ndarray, rings: list[_Ring], is_closed: bool) -> bool:
    """Whether rings one after another are all of the surface, but for flat ends."""
    quads = list(itertools.chain.from_iterable(ring.quads for ring in rings))
    if len(set(quads)) != len(quads) or len({len(ring.quads) for ring in rings}) > 1:
        return False
    is_end = np.ones(len(triangles), bool)
    is_end[pairs[quads]] = False
    at_ends = set() if is_closed else {*rings[0].back.tolist(), *rings[-1].front.tolist()}
    return set(triangles[is_end].ravel().tolist()) == at_ends
