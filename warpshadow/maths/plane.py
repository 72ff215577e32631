"""Planes: whether triangles lie in one."""

import numpy as np

_FLATNESS = 1e-4
"""Thickness of what counts as flat, as a part of its size."""


def plane_normal(corners: np.ndarray) -> np.ndarray | None:
    """Find the normal of triangles that lie in one plane.

    Args:
        corners: Float64 of shape [face, 3, 3].

    Returns:
        Unit normal, their mean by area, shape [3]; None where they do not lie in one plane, or have no mean.
    """
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]).sum(axis=0)
    if not normal.any():
        return None
    normal = normal / np.linalg.norm(normal)
    points = corners.reshape(-1, 3)
    points = points - points.mean(axis=0)
    *_, axes = np.linalg.svd(points, full_matrices=False)
    size = np.ptp(points @ axes[0])
    return normal if np.ptp(points @ normal) < _FLATNESS * size else None
