"""Rotations of bodies: axis-angle vectors in degrees, and matrices."""

import numpy as np
import numpy.typing as npt

from warpshadow import check
from warpshadow.assets.camera import check_rotation

_ROUNDED = 2e-3  # difference from an eighth of a turn [radians] up to which an angle is one, such as 3.14


def rotation_vector(value: npt.ArrayLike) -> np.ndarray:
    """The axis-angle vector [degrees] of a rotation, float64 of shape [3].

    Args:
        value: Such a vector, [3], or a matrix, [3, 3].
    Raises:
        ValueError: for other shapes, and for a matrix that is no rotation.
    """
    meaning = "an axis-angle vector in degrees, or a rotation matrix [3, 3]"
    matrix = check.numbers("rotation", value, expected=f"3 finite numbers: {meaning}", dtype=np.float64)
    if matrix.ndim == 0:
        raise ValueError(f"rotation: got {matrix:g}, expected {meaning}: about the vertical (0, {matrix:g}, 0)")
    if matrix.shape == (4,):
        raise ValueError(
            f"rotation: got 4 numbers, expected {meaning}; of a unit quaternion it is "
            "scipy.spatial.transform.Rotation.from_quat((x, y, z, w)).as_matrix(), with the real part w last"
        )
    if matrix.shape != (3, 3):
        vector = check.array("rotation", value, (3,), meaning)
        is_checked = isinstance(value, np.ndarray) and not value.flags.writeable  # of a body that is replaced
        if not is_checked:
            _warn_of_radians(vector)
        return vector
    from scipy.spatial.transform import Rotation

    check.finite("rotation", matrix)
    check_rotation("rotation", matrix)
    vector = np.asarray(Rotation.from_matrix(matrix).as_rotvec(degrees=True))
    vector.setflags(write=False)
    return vector


def _warn_of_radians(vector: np.ndarray) -> None:
    """Warn of a turn about an axis of the world by an eighth of a turn, or several, as it is in radians."""
    angle = np.abs(vector).max()
    eighths = angle / (np.pi / 4)
    if np.count_nonzero(vector) == 1 and 0.5 < eighths < 8.5 and abs(eighths - round(eighths)) * np.pi / 4 < _ROUNDED:
        x, y, z = vector.tolist()
        degrees = ", ".join(f"{number:.0f}" for number in np.degrees(vector))
        check.warn(
            f"rotation: got ({x:g}, {y:g}, {z:g}), a turn by {angle:g}°, expected degrees; if it is in radians, "
            f"({degrees}) is meant"
        )


def rotation_matrix(vector: np.ndarray) -> np.ndarray:
    """The matrix of an axis-angle vector [degrees], float64 of shape [3, 3] (Rodrigues' formula)."""
    degrees = np.linalg.norm(vector)
    if degrees == 0:
        return np.eye(3)
    x, y, z = np.array(vector) / degrees
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(np.radians(degrees)) * cross + (1 - np.cos(np.radians(degrees))) * cross @ cross
