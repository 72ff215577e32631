"""Panels: nearly flat, convex regions of a sheet, which is a mesh of one layer, such as cloth."""

from __future__ import annotations

import numpy as np

from warpshadow.maths.adjacency import edge_neighbors
from warpshadow.maths.components import connected_components
from warpshadow.maths.outline import cut_outline, find_outline
from warpshadow.maths.plane import is_flat, principal_axes

TOLERANCES = (0.02, 0.03)
"""Thickness and mean gap of a panel at most, over the size of the mesh: the second where the first takes too many. With
0.04 light comes through between the panels of half a shell."""

FLAT = 1e-3  # the same for flat panels, which shade nothing that lies on the mesh
MAX_PANELS = 64  # of a mesh: beyond, spheres are faster. An umbrella of eight arched fields has 48
_CREASE = 0.94  # cosine of the angle between neighboring triangles, 20°, beyond which there is a crease between them


def find_panels(points: np.ndarray, triangles: np.ndarray, tolerance: float, maximum: int) -> list[np.ndarray] | None:
    """Cut a sheet into panels.

    First along creases. A region that lies in a plane and whose outline is not convex, such as a wall with a window, is
    cut into convex ones exactly. Another, or one that is too thick, is cut in two across the principal axis that leaves
    the flatter halves, until none is [Lien and Amato 2007: approximate convex decomposition]. Then neighbors are joined
    that make one panel.

    Args:
        points: Vertices, float64 of shape [vertex, 3].
        triangles: Triangles, shape [triangle, 3]; slivers without area do not count.
        tolerance: Thickness and mean gap of a panel at most [units of points].
        maximum: Number of panels at most.

    Returns:
        Vertices at the corners of each, in order around it, int of shape [corner]; None where there are more.
    """
    regions = _smooth_regions(points, triangles)
    if len(regions) > maximum:
        return None
    deviations = [_deviation(points, region) for region in regions]
    exact: list[np.ndarray] = []
    for number in reversed(np.flatnonzero(np.array(deviations) > tolerance)):
        polygons = _flat_polygons(points, regions[number], maximum - len(regions) + 1)
        if polygons is not None:
            exact, maximum = exact + polygons, maximum - len(polygons)
            del regions[number], deviations[number]
    while len(regions) + sum(deviation > tolerance for deviation in deviations) <= maximum:
        if max(deviations, default=0.0) <= tolerance:
            panels = _joined(points, regions, tolerance)
            return exact + [_outline(points, panel, tolerance / 2) for panel in panels]
        worst_region = int(np.argmax(deviations))
        halves = min(
            _cuts(points, regions[worst_region]), key=lambda cut: max(_deviation(points, half) for half in cut)
        )
        regions[worst_region : worst_region + 1] = halves
        deviations[worst_region : worst_region + 1] = [_deviation(points, half) for half in halves]
    return None


def _smooth_regions(points: np.ndarray, triangles: np.ndarray) -> list[np.ndarray]:
    """Regions between creases, of triangles that have an area; edges of more than two triangles are creases."""
    corners = points[triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    has_area = lengths > 1e-10 * np.ptp(corners, axis=(0, 1)).max() ** 2
    triangles, normals = triangles[has_area], normals[has_area] / lengths[has_area, None]
    neighbors = edge_neighbors(triangles)
    triangle, edge = np.nonzero(neighbors >= 0)
    neighbor = neighbors[triangle, edge]
    is_smooth = np.abs((normals[triangle] * normals[neighbor]).sum(axis=1)) > _CREASE
    region = connected_components(triangle[is_smooth], neighbor[is_smooth], len(triangles))
    return [triangles[region == number] for number in range(region.max(initial=-1) + 1)]


def _flat_polygons(points: np.ndarray, region: np.ndarray, maximum: int) -> list[np.ndarray] | None:
    """Corners of the convex polygons into which a region of a plane is cut; None if it lies in none, or of more."""
    used_vertices, faces = np.unique(region, return_inverse=True)
    if not is_flat(points[used_vertices]):
        return None
    flat = points[used_vertices] @ principal_axes(points[used_vertices])[:2].T
    polygons = cut_outline(flat, find_outline(flat, faces.reshape(region.shape)), maximum)
    return None if polygons is None else [used_vertices[polygon] for polygon in polygons]


def _cuts(points: np.ndarray, region: np.ndarray) -> list[list[np.ndarray]]:
    """Halves of a region, across each of its principal axes."""
    centroids = points[region].mean(axis=1)
    permutations = np.argsort(centroids @ principal_axes(centroids).T, axis=0, kind="stable")
    return [[region[half] for half in np.array_split(column, 2)] for column in permutations.T]


def _deviation(points: np.ndarray, region: np.ndarray) -> float:
    """Deviation of a region from a panel: its thickness, or the mean width by which a convex outline is larger."""
    from scipy.spatial import ConvexHull

    local_points = points[region] @ principal_axes(points[np.unique(region)]).T
    flat = local_points[..., :2]
    outline = ConvexHull(flat.reshape(-1, 2))
    u, v = flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0]
    area = np.abs(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]).sum() / 2
    return float(max(np.ptp(local_points[..., 2]), (outline.volume - area) / np.ptp(flat[..., 0])))


def _joined(points: np.ndarray, regions: list[np.ndarray], tolerance: float) -> list[np.ndarray]:
    """Join regions that share an edge and make one panel."""
    panels: list[np.ndarray] = []
    for region in regions:
        for number, panel in enumerate(panels):
            merged_region = np.concatenate([panel, region])
            if len(np.intersect1d(panel, region)) > 1 and _deviation(points, merged_region) <= tolerance:
                panels[number] = merged_region
                break
        else:
            panels.append(region)
    return panels


def _outline(points: np.ndarray, region: np.ndarray, tolerance: float) -> np.ndarray:
    """Corners around a region, but for corners that stand out by less than the tolerance."""
    from scipy.spatial import ConvexHull

    used_vertices = np.unique(region)
    flat = points[used_vertices] @ principal_axes(points[used_vertices])[:2].T
    rim = ConvexHull(flat).vertices
    rim_ends = np.array([flat[rim, 0].argmin(), flat[rim, 0].argmax()])  # of the rim, in order
    while True:
        corners = flat[rim[np.sort(rim_ends)]]
        sides = np.roll(corners, -1, axis=0) - corners
        outward = np.stack([sides[:, 1], -sides[:, 0]], axis=1) / np.linalg.norm(sides, axis=1, keepdims=True)
        heights = ((flat[rim][:, None] - corners) * outward).sum(axis=-1).max(axis=1)
        if len(rim_ends) > 2 and heights.max() <= tolerance:
            return used_vertices[rim[np.sort(rim_ends)]]
        rim_ends = np.append(rim_ends, heights.argmax())
