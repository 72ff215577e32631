"""Cameras of pages: a browser's own camera, checked, and converted to ours.

A page knows a world of its own, in which the scene is a few units large: its near plane, its orbit and its depths are
made for such scenes. So lengths that it says are divided by a factor.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from warpshadow import check
from warpshadow.assets.camera import Camera

LARGEST_CANVAS = 1 << 14  # width and height of a canvas [pixels] beyond which a page is not believed

PAGE_RADIUS = 3.0  # of scenes, in units of pages
_NARROWEST, _WIDEST = 0.5, 170.0  # field of view [degrees]


@dataclass(frozen=True)
class PageCamera:
    """A pinhole camera with square pixels that looks through the middle of a canvas.

    Raises:
        ValueError: for numbers that are not finite, or larger than any page is.
    """

    wxyz: tuple[float, ...]  # camera to world as a quaternion (x right, y down, z forward), any length but 0
    position: tuple[float, ...]  # of the eye [page units]
    fov_y: float  # vertical field of view [degrees]
    width: int  # of the canvas [pixels]
    height: int  # of the canvas [pixels]

    def __post_init__(self) -> None:
        """Check it."""
        wxyz, position = check.array("wxyz", self.wxyz, (4,)), check.array("position", self.position, (3,))
        check.finite("wxyz", wxyz, maximum=1e3, minimum=-1e3)
        check.finite("position", position, maximum=1e9, minimum=-1e9)
        if np.linalg.norm(wxyz) < 1e-6:
            raise ValueError(f"wxyz: got {wxyz.tolist()}, expected a quaternion that is not 0")
        if not _NARROWEST <= check.number("fov_y", self.fov_y) <= _WIDEST:
            raise ValueError(f"fov_y: got {self.fov_y:g}, expected {_NARROWEST:g} to {_WIDEST:g} degrees")
        for name in ("width", "height"):
            if check.integer(name, getattr(self, name), unit="pixels") > LARGEST_CANVAS:
                raise ValueError(f"{name}: got {getattr(self, name)}, expected at most {LARGEST_CANVAS} pixels")
        object.__setattr__(self, "wxyz", tuple((wxyz / np.linalg.norm(wxyz)).tolist()))
        object.__setattr__(self, "position", tuple(position.tolist()))

    def size(self, pixels: int) -> tuple[int, int]:
        """Width and height of an image of about so many pixels; not more than the canvas has."""
        factor = min(1.0, np.sqrt(pixels / (self.width * self.height)))
        if factor == 1.0:
            return self.width, self.height
        step = 16 if min(self.width, self.height) * factor > 64 else 1  # windows of nearly the same size share one
        width, height = (max(step, step * round(factor * side / step)) for side in (self.width, self.height))
        return width, height

    def camera(self, size: tuple[int, int], *, page_scale: float, near: float) -> Camera:
        """The camera whose image, stretched onto the canvas, shows the page's view.

        Args:
            size: Width and height of the image [pixels].
            page_scale: Units of the page in a unit of the scene.
            near: Distance of the near plane [scene units].
        """
        width, height = size
        tangent = np.tan(np.radians(0.5 * self.fov_y))
        focal_y = 0.5 * height / tangent
        focal_x = 0.5 * width / (tangent * self.width / self.height)
        to_camera = rotation(self.wxyz).as_matrix().T
        return Camera(
            [[focal_x, 0, 0.5 * width], [0, focal_y, 0.5 * height], [0, 0, 1]],
            to_camera,
            -to_camera @ np.array(self.position) / page_scale,
            width,
            height,
            near,
        )


def page_scale(low: np.ndarray, high: np.ndarray) -> float:
    """Units of a page in a unit of the scene, from the corners of the box around all bodies."""
    radius = 0.5 * float(np.linalg.norm(high - low))
    return PAGE_RADIUS / radius if radius > 0 else 1.0


def upward(camera: Camera) -> tuple[float, float, float]:
    """The axis of the world that points up in an image, about which a page orbits."""
    up = -camera.rotation[1]
    axis = int(np.abs(up).argmax())
    x, y, z = (float(np.sign(up[axis])) if number == axis else 0.0 for number in range(3))
    return x, y, z


def rotation(wxyz: tuple[float, ...] | np.ndarray) -> Rotation:
    """The rotation that a page says as a quaternion, w first."""
    return Rotation.from_quat(np.roll(np.asarray(wxyz, np.float64), -1))


def quaternion(rotation: Rotation) -> np.ndarray:
    """A rotation as a page is told it, w first, shape [4]."""
    return np.roll(rotation.as_quat(), 1)
