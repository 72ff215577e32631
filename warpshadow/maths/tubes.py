"""Tubes: bent or ring-shaped rods of quads, cut across into straight segments."""

import functools
import itertools
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from warpshadow.maths.adjacency import area_normals, edges_of

SLACK = 0.2  # largest distance of a tube's surface from its straight segments, over the radius of its section

MAX_SEGMENTS = 128  # of all tubes of a mesh: beyond, spheres are faster

_MAX_BEND = 0.95
"""Cosine of the largest angle between adjacent segments, 18°: with 30° shadows of rings had corners."""

_MAX_SWELL = 0.03
"""Largest relative deviation of the radius of a section from that of a straight segment. Surfaces of revolution deviate
more: a column would have no shadows in its grooves."""

_MAX_TWIST = 0.02  # largest 1 − cos α between the triangles of a quad, 11°; and largest relative error of volume


class Tube(NamedTuple):
    """A tube, cut into straight segments."""

    sections: np.ndarray
    """Indices of vertices around each section, corresponding ones in one column, int of shape [segment + 1, corner].
    The last section of a closed tube is the first."""
    segments: list[np.ndarray]  # triangles of the convex hull of two sections, consistently wound, [triangle, 3]
    gaps: np.ndarray  # largest distance of the surface from each segment [units of points], shape [segment]


class _Ring(NamedTuple):
    """A ring of quads around a tube: their indices, and the vertices of both boundaries in order."""

    quads: list[int]
    front: np.ndarray
    back: np.ndarray


def find_tube(points: np.ndarray, triangles: np.ndarray, maximum: int) -> Tube | None:
    """Cut a tube into straight segments.

    Args:
        points: Vertices, float64 of shape [vertex, 3].
        triangles: Triangles of a closed surface, consistently wound, shape [triangle, 3].
        maximum: Maximum number of segments.

    Returns:
        The tube; None if the surface is not one of nearly flat quads with flat ends, if sections are not convex, or if
        more segments are needed.
    """
    pairs, corners = _quads(points, triangles)
    if not len(pairs):
        return None
    quad_at = {edge: divmod(k, 4) for k, edge in enumerate(_sides(corners))}
    for direction in range(2):
        steps, is_closed = _quad_strip(corners, quad_at, 0, direction)
        if not is_closed:
            backward, _ = _quad_strip(corners, quad_at, 0, direction + 2)
            steps = [(quad, (side + 2) % 4) for quad, side in backward[:0:-1]] + steps
        rings = [ring for ring in itertools.starmap(functools.partial(_ring, corners, quad_at), steps) if ring]
        if len(rings) == len(steps) and _covers(triangles, pairs, rings, is_closed):
            sections = np.array([rings[0].back, *(ring.front for ring in rings)])
            volumes = [_volume(points, _lofted(*pair)) for pair in itertools.pairwise(sections)]
            if min(volumes) > 0 and abs(sum(volumes) / _volume(points, triangles) - 1) < _MAX_TWIST:
                return _simplified(points, sections, maximum)
    return None


def _lofted(section: np.ndarray, next_section: np.ndarray) -> np.ndarray:
    """Triangles of the loft between two sections, shape [triangle, 3]."""
    rolled_section, next_rolled_section = np.roll(section, -1), np.roll(next_section, -1)
    sides = [[section, next_rolled_section, rolled_section], [section, next_section, next_rolled_section]]
    rest = np.arange(1, len(section) - 1)
    first, last = np.full(len(rest), section[0]), np.full(len(rest), next_section[0])
    ends = [[first, section[rest], rolled_section[rest]], [last, next_rolled_section[rest], next_section[rest]]]
    return np.concatenate([np.stack(columns, axis=1) for columns in (*sides, *ends)])


def _volume(points: np.ndarray, triangles: np.ndarray) -> float:
    """Signed volume that triangles enclose, negative if they face inward."""
    return float(np.linalg.det(points[triangles] - points[triangles[0, 0]]).sum() / 6)


def _bulge(points: np.ndarray, section: np.ndarray, next_section: np.ndarray, middle_sections: np.ndarray) -> float:
    """Largest distance of intermediate sections from the straight lines between two others."""
    starts, lines = points[section], points[next_section] - points[section]
    units = lines / np.linalg.norm(lines, axis=1, keepdims=True)
    return float(np.linalg.norm(np.cross(points[middle_sections] - starts, units), axis=-1).max(initial=0.0))


def _swell(radii: np.ndarray, chosen: np.ndarray) -> float:
    """Largest relative deviation of radii [section, corner] from those interpolated between chosen sections."""
    rings = np.arange(len(radii))
    expected = np.stack([np.interp(rings, chosen, column) for column in radii[chosen].T], axis=1)
    return float(np.abs(radii / expected - 1).max())


def _simplified(points: np.ndarray, sections: np.ndarray, maximum: int) -> Tube | None:
    """The tube of the fewest evenly spaced sections that approximate it; None if that takes more than the maximum."""
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
    """Triangles of the convex hull of two sections, consistently wound, shape [triangle, 3]."""
    from scipy.spatial import ConvexHull

    vertices = np.unique(sections)
    hull = ConvexHull(points[vertices])
    corners = points[vertices[hull.simplices]]
    normals = area_normals(corners)
    is_inward = (normals * hull.equations[:, :3]).sum(axis=1) < 0
    triangles: np.ndarray = vertices[np.where(is_inward[:, None], hull.simplices[:, ::-1], hull.simplices)]
    return triangles


def _quads(points: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pair nearly coplanar triangles that share their longest edge into quads.

    Returns:
        Indices of both triangles, [quad, 2], and corners in order, [quad, 4].
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
    """The four directed sides of each quad."""
    return map(tuple, np.stack([corners, np.roll(corners, -1, axis=1)], axis=2).reshape(-1, 2).tolist())


def _quad_strip(
    corners: np.ndarray, quad_at: dict[tuple[int, int], tuple[int, int]], quad: int, side: int
) -> tuple[list[tuple[int, int]], bool]:
    """Follow the strip of quads that leaves a quad through a side: each quad with the side through which the strip
    leaves it, and whether the strip closes.
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
    """The ring of quads around a tube through a quad, whose side faces along the tube; None if it does not close."""
    steps, is_closed = _quad_strip(corners, quad_at, quad, side + 1)
    if not is_closed:
        return None
    quads, sides = np.array(steps).T
    return _Ring(quads.tolist(), corners[quads, (sides - 1) % 4], corners[quads, (sides + 2) % 4])


def _covers(triangles: np.ndarray, pairs: np.ndarray, rings: list[_Ring], is_closed: bool) -> bool:
    """Whether rings cover all of the surface but flat ends."""
    quads = list(itertools.chain.from_iterable(ring.quads for ring in rings))
    if len(set(quads)) != len(quads) or len({len(ring.quads) for ring in rings}) > 1:
        return False
    is_end = np.ones(len(triangles), bool)
    is_end[pairs[quads]] = False
    at_ends = set() if is_closed else {*rings[0].back.tolist(), *rings[-1].front.tolist()}
    return set(triangles[is_end].ravel().tolist()) == at_ends
