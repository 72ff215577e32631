"""Cameras of other libraries as intrinsics K, rotation R and translation t in our conventions (see ``camera.py``).

Pixel centers lie at whole numbers in OpenCV, ROS and RealSense, and at +0.5 in the others and here.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from warpshadow import check

HALF_PIXEL = np.array([[0.0, 0.0, 0.5], [0.0, 0.0, 0.5], [0.0, 0.0, 0.0]])
"""Intrinsics with pixel centers at +0.5, from ones with pixel centers at whole numbers."""

_LARGEST_NORMALIZED = 10.0  # numbers of intrinsics up to which they are in parts of the image, and no pixels

Y_DOWN = np.diag([1.0, -1.0, -1.0])  # from camera axes of OpenGL and NeRF (x right, y up, z backward) to ours

_LEFT_UP = np.diag([-1.0, -1.0, 1.0])  # from PyTorch3D's camera axes (x left, y up, z forward) to ours


class Pinhole(NamedTuple):
    """A camera without the size of its image."""

    intrinsics: np.ndarray
    rotation: np.ndarray
    translation: np.ndarray


def from_opencv(
    rvec: npt.ArrayLike, tvec: npt.ArrayLike, K: npt.ArrayLike | object, size: object, distortion: object
) -> tuple[Pinhole, tuple[int, int]]:
    """Camera and size of the image of :meth:`warpshadow.Camera.from_opencv`."""
    intrinsics, own_size, own_distortion = _calibration(K)
    size = own_size if size is None else size
    if size is None:
        raise ValueError("size: missing, expected width and height [pixels], such as (640, 480)")
    distortion = own_distortion if distortion is None else distortion
    if distortion is not None:
        lenses = check.numbers("distortion", distortion, expected="coefficients, or None", dtype=np.float64)
        check.finite("distortion", lenses)
        if lenses.any():
            raise ValueError(
                f"distortion: got {lenses.ravel().tolist()}, expected none: the cameras here are pinholes; "
                "cv2.undistort(image, K, distortion) makes images of a pinhole with the same K, rvec and tvec"
            )
    if intrinsics[:2].max() <= _LARGEST_NORMALIZED < min(check.image_size(size)):
        raise ValueError(
            f"K: got {intrinsics.tolist()}, as if widths and heights of images were 1, expected pixels: its first row "
            "times the width, its second times the height"
        )
    rotation = _checked_numbers("rvec", rvec, (3,), (3, 1), (1, 3), (3, 3))
    if rotation.size == 3:
        from scipy.spatial.transform import Rotation

        rotation = Rotation.from_rotvec(rotation.ravel()).as_matrix()
    translation = _checked_numbers("tvec", tvec, (3,), (3, 1), (1, 3)).ravel()
    return Pinhole(intrinsics + HALF_PIXEL, rotation, translation), check.image_size(size)


def _calibration(K: Any) -> tuple[np.ndarray, object, object]:
    """Intrinsics; and size of the image and distortion where K is an object that has them, of ROS or RealSense."""
    if all(hasattr(K, name) for name in ("fx", "fy", "ppx", "ppy")):  # pyrealsense2.intrinsics
        intrinsics = check.array("K", intrinsics_of(K.fx, K.fy, K.ppx, K.ppy), (3, 3))
        return intrinsics, (K.width, K.height), getattr(K, "coeffs", None)
    names = next(((k, d) for k, d in (("k", "d"), ("K", "D")) if hasattr(K, k) and hasattr(K, d)), None)
    if names is None:
        return _checked_numbers("K", K, (3, 3), (9,)).reshape(3, 3), None, None
    matrix, distortion = (getattr(K, name) for name in names)  # sensor_msgs/CameraInfo of ROS 2, or 1
    intrinsics = _checked_numbers("K", matrix, (9,), (3, 3)).reshape(3, 3)
    return intrinsics, (K.width, K.height), distortion if len(distortion) else None


def from_pytorch3d(
    R: npt.ArrayLike,
    T: npt.ArrayLike,
    focal_length: npt.ArrayLike | None,
    principal_point: npt.ArrayLike | None,
    fov: float | None,
    size: tuple[int, int],
    in_ndc: bool,
) -> Pinhole:
    """Camera of :meth:`warpshadow.Camera.from_pytorch3d`."""
    rotation = _LEFT_UP @ _checked_numbers("R", R, (3, 3), (1, 3, 3)).reshape(3, 3).T  # of row vectors: x R + T
    translation = _LEFT_UP @ _checked_numbers("T", T, (3,), (1, 3)).ravel()
    if (focal_length is None) == (fov is None):
        raise ValueError("focal_length, fov: expected exactly one of them")
    half = min(size) / 2  # NDC runs from -1 to 1 along the shorter side
    image_center = np.array(size) / 2
    if fov is not None:
        if not (check.is_number(fov) and 0 < fov < 180):
            raise ValueError(f"fov: got {check.described(fov)}, expected degrees between 0 and 180")
        focal_length, in_ndc = 1 / np.tan(np.radians(fov / 2)), True
    focal = np.broadcast_to(_checked_numbers("focal_length", focal_length, (), (1,), (2,), (1, 2)).ravel(), 2)
    if principal_point is None:
        center = image_center
    else:
        point = _checked_numbers("principal_point", principal_point, (2,), (1, 2)).ravel()
        center = image_center - half * point if in_ndc else point
    focal = half * focal if in_ndc else focal
    return Pinhole(intrinsics_of(*focal, *center), rotation, translation)


def opengl_intrinsics(projection: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Intrinsics of a perspective projection to OpenGL's clip space."""
    # ndc = (P c) / c_z with c in OpenGL's axes; then u = (1 + x) width/2 and v = (1 - y) height/2.
    half = np.array([[0.5 * size[0]], [-0.5 * size[1]]])
    intrinsics = np.eye(3)
    intrinsics[:2] = half * projection[:2, :3] * (1.0, -1.0, -1.0)
    intrinsics[:2, 2] += np.array(size) / 2
    return intrinsics


def from_colmap(qvec: npt.ArrayLike, tvec: npt.ArrayLike, model: str, params: npt.ArrayLike) -> Pinhole:
    """Camera of :meth:`warpshadow.Camera.from_colmap`."""
    from scipy.spatial.transform import Rotation

    lengths: Mapping[str, int] = {"SIMPLE_PINHOLE": 3, "PINHOLE": 4}
    if model not in lengths:
        raise ValueError(
            f"model: got {model!r}, expected one of {', '.join(map(repr, lengths))}; colmap image_undistorter makes "
            "images and cameras of PINHOLE"
        )
    *focal, cx, cy = check.array("params", params, (lengths[model],), "f, cx, cy, or fx, fy, cx, cy of PINHOLE")
    qw, *vector = check.array("qvec", qvec, (4,), "QW, QX, QY, QZ")
    if not np.isclose(np.linalg.norm([qw, *vector]), 1.0, atol=1e-3):
        raise ValueError(f"qvec: got {[float(qw), *map(float, vector)]}, expected a unit quaternion QW, QX, QY, QZ")
    rotation = Rotation.from_quat([*vector, qw]).as_matrix()
    return Pinhole(intrinsics_of(focal[0], focal[-1], cx, cy), rotation, check.array("tvec", tvec, (3,)))


def intrinsics_of(fx: float, fy: float, cx: float, cy: float) -> np.ndarray:
    """K of focal lengths and a principal point [pixels]."""
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def _checked_numbers(name: str, given_numbers: object, *shapes: tuple[int, ...]) -> np.ndarray:
    """Copy finite numbers of one of some shapes to float64."""
    expected = "an array of shape " + " or ".join(map(str, shapes))
    values = check.numbers(name, given_numbers, expected=expected, dtype=np.float64)
    if values.shape not in shapes:
        order = "; the order is rvec, tvec, K, as of cv2.projectPoints" if name == "K" else ""
        raise ValueError(f"{name}: got {check.described(values)}, expected {expected}{order}")
    check.finite(name, values)
    return values
