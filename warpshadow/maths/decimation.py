"""Decimation of meshes by edge collapses."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from warpshadow.maths.adjacency import area_normals, edges_of

_MAX_TURN = 0.5  # cosine of the largest angle, 60°, by which a collapse may turn a triangle
_SLIVER = 0.1
"""A collapse may make the height of a triangle, over its longest side, lower than this only if it at most halves it."""

_BOUNDARY_WEIGHT = 0.1
"""Weight of planes perpendicular to the surface along its boundary. With 1 a shell with a jagged boundary has a panel
at each tooth."""

_TIE = 1e-6  # weight of the squared length of an edge in its cost: in a plane, short edges collapse first
_MAX_POINTS = 4096  # larger meshes are subsampled to so many vertices first: 20 000 triangles take a second

_SELECTION_ROUNDS = 3  # rounds in which independent collapses are selected: more rounds find few more


def decimate(points: np.ndarray, triangles: np.ndarray, tolerance: float) -> np.ndarray:
    """Collapse edges of a mesh up to a tolerance.

    A vertex collapses into a neighbor, so remaining vertices do not move. The cost is the quadric error of the
    remaining vertex over the area: its mean squared distance from the planes of the triangles of all vertices that
    collapsed into it [Garland and Heckbert 1997: quadric error metrics]. Boundary edges add perpendicular planes of
    weight 0.1, and a collapse along the boundary also costs (A / l)²: A is the area that it and earlier collapses
    removed there, less the area that they added, l the length of the boundary at both vertices. So a row of teeth is
    cut at its mean height. Many independent edges collapse at once. A large mesh is first replaced by the dual of the
    Voronoi cells of a random sample of its vertices.

    Args:
        points: Vertices, float64 of shape [point, 3].
        triangles: Without slivers, shape [triangle, 3]. Edges of more than two triangles stay.
        tolerance: Square root of the largest cost of a collapse [units of points].

    Returns:
        Triangles of the remaining points, wound as before, shape [triangle, 3].
    """
    used_points = np.unique(triangles)
    if len(used_points) > _MAX_POINTS:
        triangles = _sampled(points, triangles)
        used_points = np.unique(triangles)
    positions, faces = points[used_points], np.searchsorted(used_points, triangles)
    edges = _find_edges(faces, len(positions))
    quadrics, areas = _quadrics(positions, faces, edges)
    boundary_lengths, removed_areas = _boundary_lengths(positions, faces, edges), np.zeros(len(positions))
    generator = np.random.default_rng(0)
    while True:
        begin, end = _collapses(edges, len(positions))
        targets = np.concatenate([positions[end], np.ones((len(end), 1))], axis=1)[:, None]
        sums = (targets @ (quadrics[begin] + quadrics[end]) @ targets.swapaxes(1, 2)).ravel()
        lengths2 = ((positions[begin] - positions[end]) ** 2).sum(axis=1)
        costs = np.maximum(sums, 0) / (areas[begin] + areas[end]) + _TIE * lengths2
        new_areas = _removed_areas(positions, faces, edges, begin, end)
        shifts = removed_areas[begin] + removed_areas[end] + new_areas
        costs += (shifts / np.maximum(boundary_lengths[begin] + boundary_lengths[end], 1e-30)) ** 2 * (new_areas != 0)
        affordable = np.flatnonzero(costs <= tolerance**2)
        affordable = affordable[np.argsort(costs[affordable], kind="stable")]
        cheapest = _first_of_each(begin, affordable)
        allowed = cheapest[_keep_orientation(positions, faces, begin[cheapest], end[cheapest])]
        if 2 * len(allowed) < len(cheapest):
            allowed = _first_of_each(
                begin, affordable[_keep_orientation(positions, faces, begin[affordable], end[affordable])]
            )
        if not len(allowed):
            return used_points[faces]
        allowed = allowed[: max(len(allowed) // 2, 32)]
        chosen = allowed[_independent(faces, begin[allowed], generator.permutation(len(allowed)), len(positions))]
        begin, end, new_areas = begin[chosen], end[chosen], new_areas[chosen]
        quadrics[end] += quadrics[begin]
        areas[end] += areas[begin]
        boundary_lengths[end] += boundary_lengths[begin]
        removed_areas[end] += removed_areas[begin] + new_areas
        moved_to = np.arange(len(positions))
        moved_to[begin] = end
        faces = moved_to[faces]
        faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
        edges = _find_edges(faces, len(positions))


def _sampled(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """The dual of the Voronoi cells of random vertices. A boundary vertex represents its cell where it has one."""
    from scipy.sparse import csr_matrix
    from scipy.sparse.csgraph import dijkstra

    used_points = np.unique(triangles)
    positions, faces = points[used_points], np.searchsorted(used_points, triangles)
    count, (ends, _, counts) = len(positions), _find_edges(faces, len(positions))
    lengths = np.linalg.norm(positions[ends[0]] - positions[ends[1]], axis=1)
    graph = csr_matrix((lengths, tuple(ends)), (count, count))
    seeds = np.random.default_rng(0).choice(count, _MAX_POINTS, replace=False)
    distances, _, cells = dijkstra(graph, directed=False, indices=seeds, return_predecessors=True, min_only=True)
    is_inside = np.ones(count, bool)
    is_inside[ends[:, counts == 1]] = False
    permutation = np.lexsort((distances, is_inside))
    permutation = permutation[cells[permutation] >= 0]
    representatives = np.full(count, -1)
    first_cells, first = np.unique(cells[permutation], return_index=True)
    representatives[first_cells] = permutation[first]
    corners = representatives[cells[faces]]  # cells are named by their seeds
    corners = corners[((cells[faces] >= 0) & (corners != np.roll(corners, 1, axis=1))).all(axis=1)]
    _, first = np.unique(np.sort(corners, axis=1), axis=0, return_index=True)
    return used_points[corners[np.sort(first)]]


def _first_of_each(begin: np.ndarray, collapses: np.ndarray) -> np.ndarray:
    """The first collapse of each vertex among some."""
    return collapses[np.sort(np.unique(begin[collapses], return_index=True)[1])]


def _quadrics(positions: np.ndarray, faces: np.ndarray, edges: _Edges) -> tuple[np.ndarray, np.ndarray]:
    """The error quadric of each vertex, [vertex, 4, 4], and the sum of the areas of its triangles, [vertex]."""
    count = len(positions)
    normals = area_normals(positions[faces])
    doubles = np.linalg.norm(normals, axis=1)
    units = normals / doubles[:, None]
    boundary, triangle = _boundary(faces, edges)
    sides = positions[boundary[:, 1]] - positions[boundary[:, 0]]
    upright = np.cross(sides, units[triangle])
    lengths = np.linalg.norm(upright, axis=1)
    result, areas = np.zeros((count, 4, 4)), np.zeros(count)
    for corners, planes, weights in (
        (faces, units, doubles / 2),
        (boundary, upright / lengths[:, None], _BOUNDARY_WEIGHT * lengths**2),
    ):
        offsets = -(planes * positions[corners[:, 0]]).sum(axis=1)
        rows = np.concatenate([planes, offsets[:, None]], axis=1)
        squares = weights[:, None, None] * rows[:, :, None] * rows[:, None]
        for column in corners.T:
            np.add.at(result, column, squares)
    for column in faces.T:
        np.add.at(areas, column, doubles / 2)
    return result, areas


class _Edges(NamedTuple):
    """Distinct edges of a mesh."""

    ends: np.ndarray  # [2, edge]
    of_triangles: np.ndarray  # index of the edge of each side, [3, triangle]
    counts: np.ndarray  # number of triangles at each edge, [edge]


def _find_edges(faces: np.ndarray, count: int) -> _Edges:
    """Number the edges of a mesh of ``count`` vertices."""
    codes, edge, counts = np.unique(
        np.sort(edges_of(faces), axis=1) @ [count, 1], return_inverse=True, return_counts=True
    )
    return _Edges(np.stack([codes // count, codes % count]), edge.reshape(3, -1), counts)


def _boundary(faces: np.ndarray, edges: _Edges) -> tuple[np.ndarray, np.ndarray]:
    """Boundary edges, directed as their triangles are, shape [edge, 2], and the indices of these triangles."""
    on_boundary = np.flatnonzero(edges.counts[edges.of_triangles.ravel()] == 1)
    return edges_of(faces)[on_boundary], on_boundary % len(faces)


def _boundary_lengths(positions: np.ndarray, faces: np.ndarray, edges: _Edges) -> np.ndarray:
    """Half the length of the boundary edges of each vertex."""
    boundary, _ = _boundary(faces, edges)
    lengths = np.linalg.norm(positions[boundary[:, 1]] - positions[boundary[:, 0]], axis=1) / 2
    return np.bincount(boundary.ravel(), np.repeat(lengths, 2), len(positions))


def _removed_areas(
    positions: np.ndarray, faces: np.ndarray, edges: _Edges, begin: np.ndarray, end: np.ndarray
) -> np.ndarray:
    """Area that each collapse removes at the boundary, negative where it adds some."""
    boundary, triangle = _boundary(faces, edges)
    before, after = np.full((2, len(positions)), -1)
    before[boundary[:, 1]], after[boundary[:, 0]] = boundary.T
    normals = np.zeros((len(positions), 3))
    np.add.at(normals, boundary, area_normals(positions[faces[triangle]])[:, None])
    result = np.zeros(len(begin))
    at_boundary = np.flatnonzero((before[begin] >= 0) & ((end == before[begin]) | (end == after[begin])))
    corner = begin[at_boundary]
    first, last = positions[before[corner]], positions[after[corner]]
    twice = np.cross(positions[corner] - first, last - first)
    lengths = np.linalg.norm(normals[corner], axis=1)
    result[at_boundary] = (twice * normals[corner]).sum(axis=1) / (2 * np.maximum(lengths, 1e-30))
    return result


def _collapses(edges: _Edges, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of a vertex and a neighbor into which it may collapse without a change of topology (link condition)."""
    from scipy.sparse import csr_matrix

    ends, edge, counts = edges
    is_lone = np.zeros(len(counts), bool)
    is_lone[edge[:, (counts[edge] == 1).all(axis=0)]] = True  # isolated triangles, which would vanish
    boundary_counts = np.bincount(ends[:, counts == 1].ravel(), minlength=count)
    is_fixed = boundary_counts > 2  # where boundaries touch
    is_fixed[ends[:, counts > 2]] = True
    begin, end = np.concatenate([ends, ends[::-1]], axis=1)
    adjacency = csr_matrix((np.ones(len(begin), np.int32), (begin, end)), (count, count))
    common_neighbors = np.asarray((adjacency @ adjacency)[begin, end]).ravel()
    counts = np.tile(counts, 2)
    is_barred = (
        np.tile(is_lone, 2)
        | is_fixed[begin]
        | is_fixed[end]
        | (common_neighbors != counts)
        | ((boundary_counts[begin] > 0) & (counts != 1))
    )
    return begin[~is_barred], end[~is_barred]


def _keep_orientation(positions: np.ndarray, faces: np.ndarray, begin: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Whether collapses neither flip triangles nor leave slivers."""
    permutation = np.argsort(faces.ravel(), kind="stable")
    first = np.searchsorted(faces.ravel()[permutation], np.arange(len(positions) + 1))
    counts = np.diff(first)[begin]
    collapse = np.repeat(np.arange(len(begin)), counts)
    item = np.arange(len(collapse)) - np.repeat(np.cumsum(counts) - counts, counts)
    before = faces[permutation[first[begin[collapse]] + item] // 3]
    is_left = (before != end[collapse, None]).all(axis=1)
    before, collapse = before[is_left], collapse[is_left]
    after = np.where(before == begin[collapse, None], end[collapse, None], before)
    normals, new_normals = area_normals(positions[before]), area_normals(positions[after])
    doubles, new_doubles = np.linalg.norm(normals, axis=1), np.linalg.norm(new_normals, axis=1)
    heights, new_heights = doubles / _longest2(positions, before), new_doubles / _longest2(positions, after)
    is_worse = (normals * new_normals).sum(axis=1) < _MAX_TURN * doubles * new_doubles
    is_worse |= new_heights < np.minimum(_SLIVER, heights / 2)
    return np.bincount(collapse, is_worse, len(begin)) == 0


def _independent(faces: np.ndarray, begin: np.ndarray, ranks: np.ndarray, count: int) -> np.ndarray:
    """Select collapses whose one-rings are disjoint, by rank, lowest first."""
    rank, is_chosen = np.full(count, count), np.zeros(len(begin), bool)
    rank[begin] = ranks
    for _ in range(_SELECTION_ROUNDS):
        is_lowest = (_lowest_around(faces, rank, 2)[begin] == ranks) & (rank[begin] < count)
        is_chosen |= is_lowest
        near = np.full(count, count)
        near[begin[is_lowest]] = 0
        rank[_lowest_around(faces, near, 2) == 0] = count
    return is_chosen


def _lowest_around(faces: np.ndarray, values: np.ndarray, steps: int) -> np.ndarray:
    """The lowest value within some steps along edges of each vertex."""
    for _ in range(steps):
        result, lowest = values.copy(), values[faces].min(axis=1)
        for column in faces.T:
            np.minimum.at(result, column, lowest)
        values = result
    return values


def _longest2(positions: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Squared length of the longest side of each triangle."""
    corners = positions[faces]
    return ((corners - np.roll(corners, 1, axis=1)) ** 2).sum(axis=2).max(axis=1)
