"""Planes: whether triangles or points are coplanar."""

import numpy as np

from warpshadow.maths.adjacency import area_normals

_FLATNESS = 1e-4  # relative thickness below which a mesh counts as flat


def plane_normal(corners: np.ndarray) -> np.ndarray | None:
    """Find the normal of coplanar triangles.

    Args:
        corners: Float64 of shape [face, 3, 3].
    Returns:
        Unit normal, weighted by area, shape [3]; None if triangles are not coplanar, or if their normals cancel.
    """
    normal = area_normals(corners).sum(axis=0)
    if not normal.any():
        return None
    normal = normal / np.linalg.norm(normal)
    points = corners.reshape(-1, 3)
    return normal if np.ptp(points @ normal) < _FLATNESS * np.ptp(points @ principal_axes(points)[0]) else None


def is_flat(points: np.ndarray) -> bool:
    """Whether points, float64 of shape [point, 3], are coplanar."""
    axes = principal_axes(points)
    return bool(np.ptp(points @ axes[2]) < _FLATNESS * np.ptp(points @ axes[0]))


def principal_axes(points: np.ndarray) -> np.ndarray:
    """Unit vectors of the principal axes of points, the longest first, shape [3, 3]."""
    away = points - points.mean(axis=0)
    return np.linalg.eigh(away.T @ away)[1].T[::-1]
