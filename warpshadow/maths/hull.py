"""Convex hulls of bodies whose pieces stand side by side, such as slats, pickets, crates, and keys of a keyboard.

Seen from anywhere, such pieces together cover about min(Σ_pieces h, h_hull) of a disc of directions, of which each
covers h and their convex hull h_hull: exactly so much if none is before another, or if they leave no gap. Trunks of a
wood, of which many are behind each other, cover less. Rays tell.
"""

from collections.abc import Sequence

import numpy as np

from warpshadow.maths.adjacency import area_normals
from warpshadow.maths.convex import MAX_FACES, ConvexPart, is_panel
from warpshadow.maths.directions import cell_radius

MAX_ERROR = 0.03
"""Mean error up to which a hull is taken, if it is at most half the error of independent pieces, too. Measured, and
that of independent ones: strips that touch 0.000 (0.146), pickets 0.002 (0.104), crates 0.003 (0.018), keys of a
keyboard 0.009 (0.146), a blind 0.013 (0.112), slats of a shutter 0.021 (0.117), stairs 0.024 (0.120). Not taken: a
table 0.015 (0.011), bricks 0.032 (0.157), a fence with rails 0.033 (0.095), books 0.042 (0.218), a chair 0.059 (0.034),
a city 0.095 (0.051). With its hull the shadow of that fence is 4% too dark, as pieces 2% too bright."""

_RECEIVERS, _DISCS, _RAYS = 48, 8, 32  # points around the hull, discs that each sees, and rays to each
_DISTANCES = 0.4, 1.4  # of these points from the middle, over the hull's extent
_RADIUS = cell_radius(128)  # of discs


def find_hull(positions: np.ndarray, parts: Sequence[ConvexPart]) -> ConvexPart | None:
    """Find the convex hull of solids that stand side by side.

    Args:
        positions: Vertices of the mesh, shape [vertex, 3].
        parts: Its parts, from :func:`.find_convex_parts`.

    Returns:
        The hull; None of fewer than two pieces, of other pieces than convex solids, where it has more than
        :data:`.convex.MAX_FACES` faces, or where its bound is off: see :data:`MAX_ERROR`.
    """
    if len(parts) < 2 or any(part.is_seam or is_panel(part) for part in parts):
        return None
    points = positions.astype(np.float64)
    hull = _hull(points, np.unique(np.concatenate([part.corners for part in parts])))
    return hull if len(hull.faces) <= MAX_FACES and _is_close(points, [*parts, hull]) else None


def _hull(points: np.ndarray, corners: np.ndarray) -> ConvexPart:
    """The convex hull of some of the points; triangles of one plane are a face."""
    from scipy.spatial import ConvexHull

    hull = ConvexHull(points[corners])
    normals = area_normals(hull.points[hull.simplices])
    is_inward = (normals * hull.equations[:, :3]).sum(axis=1, keepdims=True) < 0
    triangles = np.where(is_inward, hull.simplices[:, ::-1], hull.simplices)
    neighbors = np.where(is_inward, hull.neighbors[:, ::-1], hull.neighbors)  # opposite to each corner
    face = np.unique(hull.equations, axis=0, return_inverse=True)[1].reshape(-1)
    # the largest triangle of each face, whose corners describe its plane best
    largest = np.lexsort((np.linalg.norm(normals, axis=1), face))[np.cumsum(np.bincount(face)) - 1]
    triangle, opposite = np.nonzero(face[:, None] < face[neighbors])
    ends = triangles[triangle[:, None], (opposite[:, None] + [1, 2]) % 3]
    corner_ids = np.unique(triangles)
    edges = [np.searchsorted(corner_ids, ends), face[triangle, None], face[neighbors[triangle, opposite], None]]
    faces = np.searchsorted(corner_ids, triangles[largest])
    return ConvexPart(corners[corner_ids], faces, np.concatenate(edges, axis=1))


def _is_close(points: np.ndarray, parts: Sequence[ConvexPart]) -> bool:
    """Whether min(Σ h, h_hull) is near the share that the parts cover, by rays in discs; the last part is the hull."""
    rng, corners = np.random.default_rng(0), points[parts[-1].corners]
    distances = np.ptp(corners, axis=0).max() * rng.uniform(*_DISTANCES, (_RECEIVERS, 1, 1))
    outward = rng.normal(size=(_RECEIVERS, 1, 3))
    outward *= distances / np.linalg.norm(outward, axis=-1, keepdims=True)
    receivers = (corners.min(axis=0) + corners.max(axis=0)) / 2 + outward
    axes = rng.choice(corners, (_RECEIVERS, _DISCS, 3)).mean(axis=2) - receivers  # towards points within the hull
    axes /= np.linalg.norm(axes, axis=-1, keepdims=True)
    ray_offsets = rng.normal(size=(_RECEIVERS, _DISCS, _RAYS, 3))
    ray_offsets -= (ray_offsets * axes[:, :, None]).sum(axis=-1, keepdims=True) * axes[:, :, None]
    lengths = _RADIUS * np.sqrt((np.arange(_RAYS) + 0.5) / _RAYS)
    rays = axes[:, :, None] + lengths[:, None] * ray_offsets / np.linalg.norm(ray_offsets, axis=-1, keepdims=True)
    hits = np.stack([_are_hit(points[part.corners[part.faces]], receivers[:, :, None], rays) for part in parts])
    coverages, covered = hits.mean(axis=-1), hits[:-1].any(axis=0).mean(axis=-1)  # [part, receiver, disc]
    bounds, independent = np.minimum(coverages[:-1].sum(axis=0), coverages[-1]), 1 - np.prod(1 - coverages[:-1], axis=0)
    error, error_if_independent = (np.abs(estimate - covered)[bounds > 0].mean() for estimate in (bounds, independent))
    return bool(error <= min(MAX_ERROR, error_if_independent / 2))


def _are_hit(faces: np.ndarray, origins: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Whether rays meet a convex solid, given three corners of each of its faces, [face, 3, 3]."""
    enter, leave = np.zeros(rays.shape[:-1]), np.full(rays.shape[:-1], np.inf)
    for normal, corner in zip(area_normals(faces), faces[:, 0], strict=True):
        speed, height = rays @ normal, (origins - corner) @ normal
        distance = -height / np.where(speed == 0, 1e-300, speed)
        enter = np.where(speed < 0, np.maximum(enter, distance), enter)
        leave = np.where(speed < 0, leave, np.minimum(leave, distance))
    return enter < leave
