"""Panels: nearly flat, convex regions of a sheet. A sheet is an open surface, such as cloth, or a layer of a thin
wall.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from warpshadow.maths.adjacency import area_normals, edge_neighbors
from warpshadow.maths.components import connected_components
from warpshadow.maths.decimation import decimate
from warpshadow.maths.outline import cut_outline, find_outline
from warpshadow.maths.plane import is_flat, principal_axes
from warpshadow.maths.polygons import merge_triangles

MAX_PANELS_OF = {0.007: 160, 0.01: 352, 0.02: 288, 0.04: 144}
"""Maximum number of panels of a mesh by their tolerance: their largest thickness and mean gap to the mesh, over the
scale of their sheet. Tolerances are tried in order until the number suffices. A shell's shadow is a polygon: on the
ground under a bowl of a thin wall, 128² pixels, light is off by 2.2% with 0.02 (131 panels), 1.4% with 0.01 (265), 0.9%
with 0.007 (361), 3.9% by 1024 spheres, and an iteration of its pose takes 0.27, 0.36, 0.43, 0.19 s of CPU time. A mug's
shadow has corners at its foot with more than 0.007. A bunny would have 190 with 0.04, and has spheres."""

MAX_FLAT_PANELS_OF = {1e-3: 64}  # the same for flat panels, which do not shade the mesh itself

_MAX_SCALE = 2.0
"""Maximum scale of a sheet over its extent. The scale is the geometric mean of the extents of the sheet and the mesh:
small sheets have fewer panels. Half a shell beside one of 7 times its size has 29, and a ball in it is 0.2% too dark;
with 3 it has 24, and the ball is 4.7% too dark; by spheres it is 16% too bright."""

_DECIMATION = 0.6  # tolerance of decimation over that of panels, which are joined from its triangles
_MAX_TRIANGLES = 3  # maximum mean number of triangles of a panel
_CREASE = 0.94  # cosine of the smallest dihedral angle of a crease, 20°


def find_panels(
    points: np.ndarray, triangles: np.ndarray, tolerance: float, maximum: int, *, decimates: bool = True
) -> list[np.ndarray] | None:
    """Decompose a sheet into panels.

    The sheet is cut along creases. Coplanar regions that are not convex, such as a wall with a window, are decomposed
    exactly. If all other regions are thin and convex, they are panels, and adjacent ones are merged where the result is
    a panel. Otherwise their triangles are merged, or those of the decimated regions if that gives fewer panels
    [Garland and Heckbert 1997; Lien and Amato 2007: approximate convex decomposition].

    Args:
        points: Vertices, float64 of shape [vertex, 3].
        triangles: Triangles, shape [triangle, 3]; slivers do not count.
        tolerance: Maximum thickness and mean gap of a panel [units of points].
        maximum: Maximum number of panels.
        decimates: Whether bent regions are decimated; otherwise a sheet with any has no panels.

    Returns:
        Corners of each panel in order, indices of points, int of shape [corner]; None if more panels are needed.
    """
    triangles, numbers = _smooth_regions(points, triangles)
    exact: list[np.ndarray] = []
    if (count := numbers.max(initial=-1) + 1) <= maximum:
        regions = [triangles[numbers == number] for number in range(count)]
        deviations = [_deviation(points, region) for region in regions]
        for number in reversed(np.flatnonzero(np.array(deviations) > tolerance)):
            polygons = _flat_polygons(points, regions[number], maximum - len(regions) + 1)
            if polygons is not None:
                exact, maximum = exact + polygons, maximum - len(polygons)
                del regions[number], deviations[number]
        if max(deviations, default=0.0) <= tolerance:
            return exact + [
                _outline(points, panel, tolerance / 2) for panel in _merge_regions(points, regions, tolerance)
            ]
        triangles = np.concatenate(regions)
    if not decimates:
        return None
    meshes = [decimate(points, triangles, _DECIMATION * tolerance), triangles]
    joined = [merge_triangles(points, mesh, tolerance) for mesh in meshes if len(mesh) <= _MAX_TRIANGLES * maximum]
    panels = min(joined, key=len, default=None)
    return exact + panels if panels is not None and len(panels) <= maximum else None


def find_panels_of_sheets(
    points: np.ndarray, sheets: Sequence[np.ndarray], max_panels_of: Mapping[float, int] = MAX_PANELS_OF
) -> list[list[np.ndarray]] | None:
    """Decompose the sheets of a mesh into panels of the smallest tolerance that the numbers allow.

    Args:
        points: Vertices, float64 of shape [vertex, 3].
        sheets: Triangles of each, [sheet][triangle, 3].
        max_panels_of: :data:`MAX_PANELS_OF` or, if sheets may not bend, :data:`MAX_FLAT_PANELS_OF`.

    Returns:
        Corners of the panels of each sheet, as of :func:`find_panels`; None if more panels are needed.
    """
    size = np.ptp(points, axis=0).max()
    extents = np.array([np.ptp(points[sheet.ravel()], axis=0).max() for sheet in sheets])
    scales = np.minimum(np.sqrt(extents * size), _MAX_SCALE * extents).tolist()
    decimates = max_panels_of is not MAX_FLAT_PANELS_OF
    for tolerance, maximum in max_panels_of.items():
        panels: list[list[np.ndarray]] = []
        for sheet, scale in zip(sheets, scales, strict=True):
            left = maximum - sum(map(len, panels))
            new_panels = find_panels(points, sheet, tolerance * scale, left, decimates=decimates)
            if new_panels is None:
                break
            panels.append(new_panels)
        else:
            return panels
    return None


def _smooth_regions(points: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Triangles without slivers, and the region of each: regions end at creases and non-manifold edges."""
    corners = points[triangles]
    normals = area_normals(corners)
    lengths = np.linalg.norm(normals, axis=1)
    has_area = lengths > 1e-10 * np.ptp(corners, axis=(0, 1)).max() ** 2
    triangles, normals = triangles[has_area], normals[has_area] / lengths[has_area, None]
    neighbors = edge_neighbors(triangles)
    triangle, edge = np.nonzero(neighbors >= 0)
    neighbor = neighbors[triangle, edge]
    is_smooth = np.abs((normals[triangle] * normals[neighbor]).sum(axis=1)) > _CREASE
    return triangles, connected_components(triangle[is_smooth], neighbor[is_smooth], len(triangles))


def _flat_polygons(points: np.ndarray, region: np.ndarray, maximum: int) -> list[np.ndarray] | None:
    """Corners of the convex polygons of a coplanar region; None if it is not coplanar, or if more are needed."""
    used_vertices, faces = np.unique(region, return_inverse=True)
    if not is_flat(points[used_vertices]):
        return None
    flat = points[used_vertices] @ principal_axes(points[used_vertices])[:2].T
    polygons = cut_outline(flat, find_outline(flat, faces.reshape(region.shape)), maximum)
    return None if polygons is None else [used_vertices[polygon] for polygon in polygons]


def _deviation(points: np.ndarray, region: np.ndarray) -> float:
    """Deviation of a region from a panel: its thickness, or the mean width of its gap to its convex hull."""
    from scipy.spatial import ConvexHull

    local_points = points[region] @ principal_axes(points[np.unique(region)]).T
    flat = local_points[..., :2]
    outline = ConvexHull(flat.reshape(-1, 2))
    u, v = flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0]
    area = np.abs(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]).sum() / 2
    return float(max(np.ptp(local_points[..., 2]), (outline.volume - area) / np.ptp(flat[..., 0])))


def _merge_regions(points: np.ndarray, regions: list[np.ndarray], tolerance: float) -> list[np.ndarray]:
    """Merge regions that share an edge where the result is a panel."""
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
    """Corners of the convex hull of a region, simplified up to a tolerance [Douglas and Peucker 1973]."""
    from scipy.spatial import ConvexHull

    used_vertices = np.unique(region)
    flat = points[used_vertices] @ principal_axes(points[used_vertices])[:2].T
    hull = ConvexHull(flat).vertices
    chosen_corners = np.array([flat[hull, 0].argmin(), flat[hull, 0].argmax()])
    while True:
        corners = flat[hull[np.sort(chosen_corners)]]
        sides = np.roll(corners, -1, axis=0) - corners
        outward = np.stack([sides[:, 1], -sides[:, 0]], axis=1) / np.linalg.norm(sides, axis=1, keepdims=True)
        heights = ((flat[hull][:, None] - corners) * outward).sum(axis=-1).max(axis=1)
        if len(chosen_corners) > 2 and heights.max() <= tolerance:
            return used_vertices[hull[np.sort(chosen_corners)]]
        chosen_corners = np.append(chosen_corners, heights.argmax())
