"""Solid angles of triangles."""

import numpy as np


def solid_angles(corners: np.ndarray) -> np.ndarray:
    """Solid angles that triangles take, seen from the origin [Van Oosterom and Strackee 1983].

    Args:
        corners: float64 of shape [triangle, 3, 3].
    Returns:
        Of each triangle, −2π to 2π, positive where its back is seen; shape [triangle]. The solid angles of a closed
        mesh that faces outwards add up to 4π inside and to 0 outside.
    """
    a, b, c = np.moveaxis(corners, 1, 0)
    length_a, length_b, length_c = np.moveaxis(np.linalg.norm(corners, axis=2), 1, 0)
    numerator = (a * np.cross(b, c)).sum(axis=1)
    denominator = length_a * length_b * length_c
    denominator += (a * b).sum(axis=1) * length_c + (b * c).sum(axis=1) * length_a + (c * a).sum(axis=1) * length_b
    return 2 * np.arctan2(numerator, denominator)
