"""Decimation of meshes by collapses of edges."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from warpshadow.maths.adjacency import area_normals, edges_of

_MAX_TURN = 0.5  # cosine of the angle, 60°, by which a collapse may turn a triangle
_SLIVER = 0.1
"""Height over the longest side of a triangle below which a collapse may leave it only if it is more than half of that
before."""

_RIM_WEIGHT = 0.1  # weight of planes upright on the rim. With 1 a shell whose rim has many teeth has a panel at each.

_TIE = 1e-6  # part of the squared length of an edge in its cost: of edges in a plane, short ones collapse first
_MAX_POINTS = 4096  # vertices at most with which collapses begin: 20 000 triangles take a second

_ROUNDS_OF_CHOICE = 3  # in which collapses far from each other are chosen: more find few more


def decimate(points: np.ndarray, triangles: np.ndarray, tolerance: float) -> np.ndarray:
    """Collapse the edges of a mesh while it stays near.

    Vertices go to neighbors, so that those that are left do not move. The cost of a collapse is the mean squared
    distance of where the vertex goes to from the planes of the triangles around all vertices that have come there
    [Garland and Heckbert 1997: quadric error metrics]. At the rim, planes upright on it count a tenth, and a
    collapse along it also costs (A / l)²: A is the area that it and earlier ones took from the surface there, less the
    area that they added, l the length of the rim at both vertices. So a row of teeth is cut at its mean height. Many
    edges collapse at once, far from each other. Of a large mesh a sample is taken first: the triangles between the
    Voronoi cells of some vertices.

    Args:
        points: Vertices, float64 of shape [point, 3].
        triangles: That have an area, shape [triangle, 3]. Edges of more than two stay.
        tolerance: Root of the cost of a collapse at most [units of points].

    Returns:
        Triangles of the points that are left, wound as before, shape [triangle, 3].
    """
    used_points = np.unique(triangles)
    if len(used_points) > _MAX_POINTS:
        triangles = _sampled(points, triangles)
        used_points = np.unique(triangles)
    positions, faces = points[used_points], np.searchsorted(used_points, triangles)
    edges = _find_edges(faces, len(positions))
    quadrics, areas = _quadrics(positions, faces, edges)
    rim_lengths, removed_areas = _rim_lengths(positions, faces, edges), np.zeros(len(positions))
    generator = np.random.default_rng(0)
    while True:
        begin, end = _collapses(edges, len(positions))
        targets = np.concatenate([positions[end], np.ones((len(end), 1))], axis=1)[:, None]
        sums = (targets @ (quadrics[begin] + quadrics[end]) @ targets.swapaxes(1, 2)).ravel()
        lengths2 = ((positions[begin] - positions[end]) ** 2).sum(axis=1)
        costs = np.maximum(sums, 0) / (areas[begin] + areas[end]) + _TIE * lengths2
        new_areas = _removed_areas(positions, faces, edges, begin, end)
        shifts = removed_areas[begin] + removed_areas[end] + new_areas
        costs += (shifts / np.maximum(rim_lengths[begin] + rim_lengths[end], 1e-30)) ** 2 * (new_areas != 0)
        affordable = np.flatnonzero(costs <= tolerance**2)
        affordable = affordable[np.argsort(costs[affordable], kind="stable")]
        cheapest = _first_of_each(begin, affordable)
        allowed = cheapest[_keeps_sides(positions, faces, begin[cheapest], end[cheapest])]
        if 2 * len(allowed) < len(cheapest):
            allowed = _first_of_each(
                begin, affordable[_keeps_sides(positions, faces, begin[affordable], end[affordable])]
            )
        if not len(allowed):
            return used_points[faces]
        allowed = allowed[: max(len(allowed) // 2, 32)]
        chosen = allowed[_far_apart(faces, begin[allowed], generator.permutation(len(allowed)), len(positions))]
        begin, end, new_areas = begin[chosen], end[chosen], new_areas[chosen]
        quadrics[end] += quadrics[begin]
        areas[end] += areas[begin]
        rim_lengths[end] += rim_lengths[begin]
        removed_areas[end] += removed_areas[begin] + new_areas
        moved_to = np.arange(len(positions))
        moved_to[begin] = end
        faces = moved_to[faces]
        faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
        edges = _find_edges(faces, len(positions))


def _sampled(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Triangles between the Voronoi cells of random vertices; vertices of the border stand for cells that have some."""
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
    """The first of some collapses of each vertex."""
    return collapses[np.sort(np.unique(begin[collapses], return_index=True)[1])]


def _quadrics(positions: np.ndarray, faces: np.ndarray, edges: _Edges) -> tuple[np.ndarray, np.ndarray]:
    """Sums over the planes around each vertex, of squared distances, [vertex, 4, 4], and of areas."""
    count = len(positions)
    normals = area_normals(positions[faces])
    doubles = np.linalg.norm(normals, axis=1)
    units = normals / doubles[:, None]
    border, triangle = _rim(faces, edges)
    sides = positions[border[:, 1]] - positions[border[:, 0]]
    upright = np.cross(sides, units[triangle])
    lengths = np.linalg.norm(upright, axis=1)
    result, areas = np.zeros((count, 4, 4)), np.zeros(count)
    for corners, planes, weights in (
        (faces, units, doubles / 2),
        (border, upright / lengths[:, None], _RIM_WEIGHT * lengths**2),
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
    ends: np.ndarray  # [2, edge]
    of_triangles: np.ndarray  # [3, triangle]
    counts: np.ndarray  # triangles that have it, [edge]


def _find_edges(faces: np.ndarray, count: int) -> _Edges:
    codes, edge, counts = np.unique(
        np.sort(edges_of(faces), axis=1) @ [count, 1], return_inverse=True, return_counts=True
    )
    return _Edges(np.stack([codes // count, codes % count]), edge.reshape(3, -1), counts)


def _rim(faces: np.ndarray, edges: _Edges) -> tuple[np.ndarray, np.ndarray]:
    """Edges of one triangle, from its first corner first, shape [edge, 2], and the numbers of these triangles."""
    on_rim = np.flatnonzero(edges.counts[edges.of_triangles.ravel()] == 1)
    return edges_of(faces)[on_rim], on_rim % len(faces)


def _rim_lengths(positions: np.ndarray, faces: np.ndarray, edges: _Edges) -> np.ndarray:
    """Half the length of the edges of the rim at each vertex."""
    rim, _ = _rim(faces, edges)
    lengths = np.linalg.norm(positions[rim[:, 1]] - positions[rim[:, 0]], axis=1) / 2
    return np.bincount(rim.ravel(), np.repeat(lengths, 2), len(positions))


def _removed_areas(
    positions: np.ndarray, faces: np.ndarray, edges: _Edges, begin: np.ndarray, end: np.ndarray
) -> np.ndarray:
    """Area of the surface at the rim that collapses take away, below 0 where they add some."""
    rim, triangle = _rim(faces, edges)
    before, after = np.full((2, len(positions)), -1)
    before[rim[:, 1]], after[rim[:, 0]] = rim.T
    normals = np.zeros((len(positions), 3))
    np.add.at(normals, rim, area_normals(positions[faces[triangle]])[:, None])
    result = np.zeros(len(begin))
    at_rim = np.flatnonzero((before[begin] >= 0) & ((end == before[begin]) | (end == after[begin])))
    corner = begin[at_rim]
    first, last = positions[before[corner]], positions[after[corner]]
    twice = np.cross(positions[corner] - first, last - first)
    lengths = np.linalg.norm(normals[corner], axis=1)
    result[at_rim] = (twice * normals[corner]).sum(axis=1) / (2 * np.maximum(lengths, 1e-30))
    return result


def _collapses(edges: _Edges, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices, and the neighbors to which they may go, such that the mesh stays a surface with the same border."""
    from scipy.sparse import csr_matrix

    ends, edge, counts = edges
    is_lone = np.zeros(len(counts), bool)
    is_lone[edge[:, (counts[edge] == 1).all(axis=0)]] = True  # of triangles without neighbors, which would be gone
    borders_at = np.bincount(ends[:, counts == 1].ravel(), minlength=count)
    is_fixed = borders_at > 2  # where borders touch
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
        | ((borders_at[begin] > 0) & (counts != 1))
    )
    return begin[~is_barred], end[~is_barred]


def _keeps_sides(positions: np.ndarray, faces: np.ndarray, begin: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Whether collapses turn no triangle over, and leave no slivers."""
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


def _far_apart(faces: np.ndarray, begin: np.ndarray, ranks: np.ndarray, count: int) -> np.ndarray:
    """Choose collapses around which no vertices are the same, low ranks first."""
    rank, is_chosen = np.full(count, count), np.zeros(len(begin), bool)
    rank[begin] = ranks
    for _ in range(_ROUNDS_OF_CHOICE):
        is_lowest = (_lowest_around(faces, rank, 2)[begin] == ranks) & (rank[begin] < count)
        is_chosen |= is_lowest
        near = np.full(count, count)
        near[begin[is_lowest]] = 0
        rank[_lowest_around(faces, near, 2) == 0] = count
    return is_chosen


def _lowest_around(faces: np.ndarray, values: np.ndarray, steps: int) -> np.ndarray:
    """Lowest values of vertices that are so few edges away."""
    for _ in range(steps):
        result, lowest = values.copy(), values[faces].min(axis=1)
        for column in faces.T:
            np.minimum.at(result, column, lowest)
        values = result
    return values


def _longest2(positions: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Squared longest sides of triangles."""
    corners = positions[faces]
    return ((corners - np.roll(corners, 1, axis=1)) ** 2).sum(axis=2).max(axis=1)
