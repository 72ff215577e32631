"""Lenses: images of a pinhole from images of a lens with distortion, by OpenCV's five coefficients."""

import numpy as np
import numpy.typing as npt

from warpshadow import check
from warpshadow.assets.camera import Camera

_ROUNDING = 1e-6  # how far beyond the image a pixel may be [pixels]


def checked_distortion(value: npt.ArrayLike) -> np.ndarray:
    """Coefficients k1, k2, p1, p2, k3 of OpenCV's model, float64 of shape [5]; four, with k3 = 0, will do."""
    coefficients = check.numbers("distortion", value, expected="k1, k2, p1, p2[, k3]", dtype=np.float64)
    if coefficients.shape not in ((4,), (5,)):
        raise ValueError(f"distortion: got shape {coefficients.shape}, expected k1, k2, p1, p2[, k3] of OpenCV")
    check.finite("distortion", coefficients)
    return np.pad(coefficients, (0, 5 - len(coefficients)))


def distorted(points: np.ndarray, coefficients: np.ndarray) -> np.ndarray:
    """Distort points of the plane z = 1 in camera space, shape [..., 2] [Brown 1966; OpenCV].

    x' = x (1 + k1 r² + k2 r⁴ + k3 r⁶) + 2 p1 x y + p2 (r² + 2 x²)
    y' = y (1 + k1 r² + k2 r⁴ + k3 r⁶) + p1 (r² + 2 y²) + 2 p2 x y
    """
    k1, k2, p1, p2, k3 = coefficients
    x, y = points[..., 0], points[..., 1]
    radius2 = x * x + y * y
    radial = 1 + radius2 * (k1 + radius2 * (k2 + radius2 * k3))
    return np.stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (radius2 + 2 * x * x),
            y * radial + p1 * (radius2 + 2 * y * y) + 2 * p2 * x * y,
        ],
        axis=-1,
    )


def undistorted(pixels: np.ndarray, camera: Camera, coefficients: np.ndarray) -> np.ndarray:
    """The image of a pinhole, from the image of a lens with the same intrinsics; NaN where the lens saw nothing.

    Args:
        pixels: Linear, shape [height, width, channel], bilinear between pixel centers.
        camera: It has the intrinsics of the calibration and the size of the image.
        coefficients: k1, k2, p1, p2, k3.
    """
    from scipy.ndimage import map_coordinates

    height, width, channels = pixels.shape
    column, row = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    plane = np.stack([column, row, np.ones_like(row)], axis=-1) @ np.linalg.inv(camera.intrinsics).T
    distorted_points = distorted(plane[..., :2], coefficients)
    source = np.concatenate([distorted_points, np.ones_like(distorted_points[..., :1])], axis=-1) @ camera.intrinsics.T
    sample_coordinates = [source[..., 1] - 0.5, source[..., 0] - 0.5]
    planes = [
        map_coordinates(pixels[..., channel].astype(np.float64), sample_coordinates, order=1, mode="nearest")
        for channel in range(channels)
    ]
    is_seen = ((source[..., :2] > -_ROUNDING) & (source[..., :2] < (width + _ROUNDING, height + _ROUNDING))).all(
        axis=-1
    )
    return np.where(is_seen[..., None], np.stack(planes, axis=-1), np.nan).astype(np.float32)
