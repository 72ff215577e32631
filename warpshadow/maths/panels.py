"""Panels: nearly flat, convex regions of a sheet, which is a mesh of one layer, such as cloth, or of a thin wall's."""

from collections.abc import Mapping, Sequence

import numpy as np

from warpshadow.maths.adjacency import area_normals, edge_neighbors
from warpshadow.maths.components import connected_components
from warpshadow.maths.decimation import decimate
from warpshadow.maths.outline import cut_outline, find_outline
from warpshadow.maths.plane import is_flat, principal_axes
from warpshadow.maths.polygons import join_triangles

MAX_PANELS_OF = {0.007: 160, 0.01: 352, 0.02: 288, 0.04: 144}
"""How many panels a mesh may have, by their tolerance: thickness and mean gap to the mesh at most, over the scale of
their sheet. They are tried in order, until the mesh has no more. A shell's shadow is a polygon: on the ground under a
bowl of a thin wall, 128² pixels, light is off by 2.2% with 0.02 (131 panels), 1.4% with 0.01 (265), 0.9% with 0.007
(361), 3.9% by 1024 spheres, and an iteration of its pose takes 0.27, 0.36, 0.43, 0.19 s of CPU time. A mug's has
corners at its foot with more than 0.007. A bunny would have 190 with 0.04, and has spheres."""

MAX_FLAT_PANELS_OF = {1e-3: 64}  # deviation and number for flat panels, which shade nothing that lies on the mesh

_MAX_SCALE = 2.0
"""Scale of a sheet over its extent at most. The scale is the geometric mean of the extents of the sheet and the mesh:
small sheets have fewer panels. Half a shell beside one of 7 times its size has 29, and a ball in it is 0.2% too dark;
with 3 it has 24, and the ball is 4.7% too dark; by spheres it is 16% too bright."""

_DECIMATION = 0.6  # tolerance of decimation over that of panels, which are joined from its triangles
_MAX_TRIANGLES = 3  # of a panel that are joined, in the mean, at most
_CREASE = 0.94  # cosine of the angle between neighboring triangles, 20°, beyond which there is a crease between them


def find_panels(
    points: np.ndarray, triangles: np.ndarray, tolerance: float, maximum: int, *, decimates: bool = True
) -> list[np.ndarray] | None:
    """Cut a sheet into panels.

    First along creases. Regions that lie in a plane and whose outline is not convex, such as a wall with a window, are
    cut into convex ones exactly. If all others are thin and convex, they are panels, and neighbors are joined that make
    one together. Else the triangles of the others are joined, or those of their decimated mesh if these make fewer
    panels [Garland and Heckbert 1997; Lien and Amato 2007: approximate convex decomposition].

    Args:
        points: Vertices, float64 of shape [vertex, 3].
        triangles: Triangles, shape [triangle, 3]; slivers without area do not count.
        tolerance: Thickness and mean gap of a panel at most [units of points].
        maximum: Number of panels at most.
        decimates: Whether meshes that bend are decimated; else they have no panels.

    Returns:
        Vertices at the corners of each, in order around it, int of shape [corner]; None where there are more.
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
                _outline(points, panel, tolerance / 2) for panel in _join_regions(points, regions, tolerance)
            ]
        triangles = np.concatenate(regions)
    if not decimates:
        return None
    meshes = [decimate(points, triangles, _DECIMATION * tolerance), triangles]
    joined = [join_triangles(points, mesh, tolerance) for mesh in meshes if len(mesh) <= _MAX_TRIANGLES * maximum]
    panels = min(joined, key=len, default=None)
    return exact + panels if panels is not None and len(panels) <= maximum else None


def find_panels_of_sheets(
    points: np.ndarray, sheets: Sequence[np.ndarray], max_panels_of: Mapping[float, int] = MAX_PANELS_OF
) -> list[list[np.ndarray]] | None:
    """Cut sheets of a mesh into panels, as flat as there may be.

    Args:
        points: Vertices, float64 of shape [vertex, 3].
        sheets: Triangles of each, [sheet][triangle, 3].
        max_panels_of: One of the tables above. Sheets bend where it is not :data:`MAX_FLAT_PANELS_OF`.

    Returns:
        Corners of the panels of each sheet, as of :func:`find_panels`; None where there are more.
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
    """Triangles that have an area, and numbers of their regions between creases, as edges of more than two are."""
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
    """Corners of the convex polygons into which a region of a plane is cut; None if it lies in none, or of more."""
    used_vertices, faces = np.unique(region, return_inverse=True)
    if not is_flat(points[used_vertices]):
        return None
    flat = points[used_vertices] @ principal_axes(points[used_vertices])[:2].T
    polygons = cut_outline(flat, find_outline(flat, faces.reshape(region.shape)), maximum)
    return None if polygons is None else [used_vertices[polygon] for polygon in polygons]


def _deviation(points: np.ndarray, region: np.ndarray) -> float:
    """Deviation of a region from a panel: its thickness, or the mean width by which a convex outline is larger."""
    from scipy.spatial import ConvexHull

    local_points = points[region] @ principal_axes(points[np.unique(region)]).T
    flat = local_points[..., :2]
    outline = ConvexHull(flat.reshape(-1, 2))
    u, v = flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0]
    area = np.abs(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]).sum() / 2
    return float(max(np.ptp(local_points[..., 2]), (outline.volume - area) / np.ptp(flat[..., 0])))


def _join_regions(points: np.ndarray, regions: list[np.ndarray], tolerance: float) -> list[np.ndarray]:
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
