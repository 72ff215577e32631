"""Thin walls: closed surfaces around one, such as mugs and plates, and one layer of them, which blocks for both.

A wall's two layers are where most of a surface has its other side opposite: faces and their opposites are a signed
graph, in which neighbors should be on one side and opposites on two. The vector of the least eigenvalue of its
Laplacian tells the sides [Kunegis et al. 2010: spectral analysis of signed graphs].
"""

import numpy as np

from warpshadow.maths.adjacency import area_normals, edge_neighbors
from warpshadow.maths.plane import principal_axes

MAX_THICKNESS = 0.06
"""Thickness of a wall at most, over the size of the mesh: a mug's has 0.04, a cup's 0.055, a knot's rod 0.09."""

MIN_DEPTH = 1.5
"""Least extent of a layer along any axis, over the mean thickness: of plates and lids 5 to 8, a tray with a low rim
1.7; of slabs, whose thickness is seen, 0.8."""

MIN_OPPOSED = 0.8
"""Share of the surface at least that is on another side than its opposite: of cups and bottles 0.97, a plate with a
foot 0.89, a bracket 0.46."""

MAX_RIM = 0.15
"""Area of the rim between the layers at most, over the surface's area: of a mug 0.02, a bowl 0.09, a rod 0.6."""

_MAX_FACES = 50_000
_SAMPLES = 8192  # points of the surface that look for the other side
_CANDIDATES = 8  # samples near where the other side should be
_OPPOSITE = -0.5  # cosine of the angle between normals at most
_REACH = 0.02  # distance over the size of the mesh, beside twice the thickness, up to which samples may be opposite
_MIN_LINK = 0.01  # of faces beside each other, however sharp the edge between them, next to 1 for flat ones


def find_layer(points: np.ndarray, triangles: np.ndarray) -> np.ndarray | None:
    """Find the outer layer of a thin wall.

    Args:
        points: Vertices, float64 of shape [vertex, 3].
        triangles: Of a closed surface that winds alike, shape [triangle, 3].

    Returns:
        Those of the layer with the larger area; None where the surface is not that of a thin, hollow wall.
    """
    from scipy.sparse import coo_matrix, diags
    from scipy.sparse.linalg import eigsh

    count, corners = len(triangles), points[triangles]
    corners = corners - corners[0, 0]
    normals = area_normals(corners)
    areas = np.linalg.norm(normals, axis=1) / 2
    area, size = areas.sum(), np.ptp(corners, axis=(0, 1)).max()
    volume = (normals * corners[:, 0]).sum() / 6
    if count > _MAX_FACES or 2 * abs(volume) > MAX_THICKNESS * size * area:
        return None
    thickness = 2 * abs(volume) / area
    units = np.sign(volume) * normals / np.maximum(2 * areas, 1e-30)[:, None]
    opposites = _opposites(corners, units, areas, thickness, _REACH * size + 2 * thickness)
    neighbors = edge_neighbors(triangles)
    face, edge = np.nonzero(neighbors > np.arange(count)[:, None])
    neighbor = neighbors[face, edge]
    lengths = np.linalg.norm(corners[face, (edge + 1) % 3] - corners[face, (edge + 2) % 3], axis=1)
    flatness = ((1 + (units[face] * units[neighbor]).sum(axis=1)) / 2) ** 2
    links = thickness * lengths * (flatness + _MIN_LINK)
    weights = np.concatenate([links, np.full(len(opposites), -area / _SAMPLES)])
    ends = np.concatenate([np.stack([face, neighbor], axis=1), opposites])
    adjacency = coo_matrix((weights, tuple(ends.T)), (count, count)).tocsr()
    adjacency = adjacency + adjacency.T
    degrees = np.asarray(abs(adjacency).sum(axis=1)).ravel() + 1e-9 * area  # of a vector that fits wholly, too
    masses = diags(areas + 1e-6 * area / count).tocsc()
    laplacian = (diags(degrees) - adjacency).tocsc()
    _, vectors = eigsh(laplacian, k=1, M=masses, sigma=0, v0=np.ones(count))
    is_outer = vectors[:, 0] > 0
    opposed = np.count_nonzero(is_outer[opposites[:, 0]] != is_outer[opposites[:, 1]]) / _SAMPLES
    rim = thickness * lengths[is_outer[face] != is_outer[neighbor]].sum() / area
    if opposed < MIN_OPPOSED or rim > MAX_RIM:
        return None
    if areas[is_outer].sum() < area / 2:
        is_outer = ~is_outer
    layer = triangles[is_outer]
    layer_points = points[np.unique(layer)]
    depth = np.ptp(layer_points @ principal_axes(layer_points).T, axis=0).min()
    return layer if depth > MIN_DEPTH * thickness else None


def _opposites(corners: np.ndarray, units: np.ndarray, areas: np.ndarray, thickness: float, reach: float) -> np.ndarray:
    """Pairs of faces opposite to each other, of the samples that have an opposite, shape [pair, 2]."""
    from scipy.spatial import cKDTree

    numbers = (np.arange(_SAMPLES) + 0.5) / _SAMPLES
    face = np.minimum(np.searchsorted(areas.cumsum(), areas.sum() * numbers), len(areas) - 1)
    barycentric = np.random.default_rng(0).dirichlet((1.0, 1.0, 1.0), _SAMPLES)
    samples = (barycentric[:, :, None] * corners[face]).sum(axis=1)
    distances, candidates = cKDTree(samples).query(samples - thickness * units[face], k=_CANDIDATES)
    cosines = (units[face[candidates]] * units[face][:, None]).sum(axis=2)
    is_opposite = (cosines < _OPPOSITE) & (distances < reach)
    nearest = candidates[np.arange(_SAMPLES), is_opposite.argmax(axis=1)]
    return np.stack([face, face[nearest]], axis=1)[is_opposite.any(axis=1)]
