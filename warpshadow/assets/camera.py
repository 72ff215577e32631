"""Pinhole cameras, and the map from world space to clip space.

Conventions (OpenCV, with pixel centers at +0.5):

- Camera space: x right, y down, z forward; ``c = R p + t`` takes a world point to it.
- Pixel space: ``(u, v) = (K c)_xy / c_z``; column j, row i has its center at (j + 0.5, i + 0.5); row 0 is
  on top.
- Clip space ``(x, y, z, w)``: ``x/w`` runs from -1 at the left edge of the image to +1 at the right edge,
  ``y/w`` from -1 at the **top** edge to +1 at the **bottom** edge, and ``z/w = near / c_z`` from 1 at the
  near plane to 0 at infinity (reversed, without a far plane, so float32 keeps its relative precision at every
  distance); ``w = c_z``.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from warpshadow import check
from warpshadow.assets import camera_conventions
from warpshadow.assets.camera_conventions import Y_DOWN
from warpshadow.maths.plane import is_flat

ImageSize = int | tuple[int, int]  # width and height [pixels]; one number for a square

# Rotations read from a file are often rounded to six digits.
_ROTATION_TOLERANCE = 1e-4

# Fields of view below this [degrees] are rather π/2 radians or less.
_RADIANS_LIMIT = 1.6

# Part of the image that stays free in turntables for which a camera has to go back.
_TURNTABLE_MARGIN = 0.05

# From the framed bodies to a framing camera: it looks down from the front.
DIRECTION = (0.3, 0.4, 0.9)

# Near plane of a framing camera, as a fraction of the distance to the nearest point.
_NEAR = 0.01


class Placed(Protocol):
    """An object placed in the world: a :class:`Mesh` as it is, or a Body in its pose."""

    def world_points(self) -> np.ndarray:
        """Points that cover it [scene units], shape [point, 3]."""


class HasBodies(Protocol):
    """A container of bodies: a Scene."""

    @property
    def bodies(self) -> Iterable[Placed]:
        """The bodies."""


@check.frozen()
@dataclass(frozen=True, eq=False, init=False)
class Camera:
    """A pinhole camera, of any focal lengths, skew and principal point.

    ``K (R p + t)`` are the pixel coordinates of a world point p, times its depth: x is right, y down, z forward. The
    center of the top left pixel is at (0.5, 0.5), and (0, 0) is its corner. Intrinsics of OpenCV, ROS and RealSense,
    in which pixel centers are at whole numbers, differ from these by half a pixel: :meth:`from_opencv` adds it. There
    are :meth:`from_opengl`, :meth:`from_pytorch3d` and :meth:`from_colmap`, too, and :func:`warpshadow.load_cameras`
    reads the cameras of NeRF's ``transforms.json`` and of COLMAP. All take a ``size``, width and height [pixels], and
    ``near``. (Clip space: see the module.)

    Args:
        intrinsics: K [pixels], shape [3, 3], last row (0, 0, 1).
        rotation: R, world to camera, shape [3, 3].
        translation: t [scene units], world to camera, shape [3].
        width: Image width [pixels].
        height: Image height [pixels].
        near: Distance of the near plane along z [scene units]; nearer surfaces are not drawn.
    """

    intrinsics: np.ndarray
    rotation: np.ndarray
    translation: np.ndarray
    width: int
    height: int
    near: float

    @check.keywords(
        **dict.fromkeys(("eye", "target", "up", "fov_y", "size"), "Camera.look_at(eye, target, fov_y=…, size=…)")
    )
    def __init__(
        self,
        intrinsics: npt.ArrayLike,
        rotation: npt.ArrayLike,
        translation: npt.ArrayLike,
        width: int,
        height: int,
        near: float = 0.01,
    ):
        vars(self).update(
            intrinsics=check.array("intrinsics", intrinsics, (3, 3)),
            rotation=check.array("rotation", rotation, (3, 3)),
            translation=check.array("translation", translation, (3,)),
            width=check.integer("width", width, unit="pixels"),
            height=check.integer("height", height, unit="pixels"),
            near=check.positive("near", near),
        )
        if not np.array_equal(self.intrinsics[2], (0.0, 0.0, 1.0)):
            raise ValueError(f"intrinsics: got last row {self.intrinsics[2].tolist()}, expected [0, 0, 1]")
        focal = self.intrinsics[:2, :2]
        if abs(np.linalg.det(focal)) <= 1e-12 * np.abs(focal).max() ** 2:
            raise ValueError(f"intrinsics: got a singular matrix {self.intrinsics.tolist()}, expected focal lengths")
        check_rotation("rotation", self.rotation)

    def __repr__(self) -> str:
        x, y, z = self.eye
        fov_y = 2 * np.degrees(np.arctan(0.5 * self.height / self.intrinsics[1, 1]))
        return f"Camera({self.width} × {self.height}, eye ({x:.3g}, {y:.3g}, {z:.3g}), fov_y {fov_y:.3g})"

    @classmethod
    @check.keywords(fov="fov_y", position="eye", origin="eye", at="target")
    def look_at(
        cls,
        eye: npt.ArrayLike,
        target: npt.ArrayLike,
        *,
        up: npt.ArrayLike = (0.0, 1.0, 0.0),
        fov_y: float = 40.0,
        size: ImageSize = (256, 256),
        near: float = 0.01,
    ) -> Camera:
        """Place a camera with square pixels at ``eye`` so that ``target`` lies in the middle of the image.

        Args:
            eye: Center of projection [scene units], shape [3].
            target: Point looked at [scene units], shape [3].
            up: Direction that points up in the image, shape [3], any length.
            fov_y: Angle between the top and the bottom edge of the image [degrees], between 0 and 180.
            size: Width and height [pixels], or one number for both.
        Raises:
            ValueError: when eye and target coincide or up is parallel to the view.
        """
        origin, goal = check.array("eye", eye, (3,)), check.array("target", target, (3,))
        view = goal - origin
        if np.linalg.norm(view) <= 1e-9 * max(np.abs(origin).max(), np.abs(goal).max()):
            raise ValueError(f"target: got {goal.tolist()}, expected a point away from eye {origin.tolist()}")
        rotation = _looking_along(view, up)
        width, height = check.image_size(size)
        intrinsics = _centered_intrinsics(fov_y, width, height)
        return cls(intrinsics, rotation, -rotation @ origin, width, height, near)

    @classmethod
    @check.keywords(fov="fov_y", eye="direction")
    def framing(
        cls,
        shown: Placed | Iterable[Placed] | HasBodies,
        *,
        direction: npt.ArrayLike = DIRECTION,
        up: npt.ArrayLike = (0.0, 1.0, 0.0),
        fov_y: float = 40.0,
        size: ImageSize = (256, 256),
        margin: float = 0.2,
        near: float | None = None,
    ) -> Camera:
        """Place a camera with square pixels as near as it sees all of something.

        Args:
            shown: A mesh, a body, several, or a scene. Flat ones, grounds and walls, count where all are flat.
            direction: From the framed bodies to the camera, shape [3], any length; the default looks down from the
                front.
            up, fov_y, size: As of :meth:`look_at`.
            margin: Fraction of the image that stays free around the framed bodies, 0 or more and below 1; leave some
                for shadows.
            near: Distance of the near plane [scene units]; by default 1% of the distance to the framed bodies.
        Raises:
            ValueError: when up is parallel to the direction, or all that is shown is one point.
        """
        points = framed_points(shown)
        away = check.array("direction", direction, (3,))
        if not away.any():
            raise ValueError(f"direction: got {away.tolist()}, expected a direction, of any length but 0")
        if _is_parallel(away, check.array("up", up, (3,))):
            raise ValueError(
                f"direction: got {away.tolist()}, parallel to up, expected another direction, or another up: "
                "up=(0, 0, -1) for direction=(0, 1, 0), from above"
            )
        if not (check.is_number(margin) and 0.0 <= margin < 1.0):
            raise ValueError(f"margin: got {check.described(margin)}, expected 0 or more and below 1")
        rotation = _looking_along(-away, up)
        width, height = check.image_size(size)
        intrinsics = _centered_intrinsics(fov_y, width, height)
        # The eye (e, f) of an axis x and depth z sees a point if |x − e| ≤ t (z − f), t the tangent of half the view:
        # max(x − t z) + t f ≤ e ≤ min(x + t z) − t f. The largest f for which there is an e is nearest.
        center = (points.min(axis=0) + points.max(axis=0)) / 2
        x, z = (points - center) @ rotation[:2].T, (points - center) @ rotation[2]
        tangents = (1.0 - margin) * np.array([width, height]) / (2.0 * intrinsics[0, 0])
        minimum, maximum = (x - z[:, None] * tangents).max(axis=0), (x + z[:, None] * tangents).min(axis=0)
        depth = ((maximum - minimum) / (2.0 * tangents)).min()
        if not depth < z.min() - 1e-9 * np.ptp(points, axis=0).max():
            raise ValueError(f"shown: got a point or a line along {away.tolist()}, expected a surface")
        eye = np.array([*(minimum + maximum) / 2, depth])
        near = _NEAR * (z.min() - depth) if near is None else near
        return cls(intrinsics, rotation, -eye - rotation @ center, width, height, near)

    @classmethod
    def from_opencv(
        cls,
        rvec: npt.ArrayLike,
        tvec: npt.ArrayLike,
        K: npt.ArrayLike | object,
        size: tuple[int, int] | None = None,
        distortion: npt.ArrayLike | None = None,
        *,
        near: float = 0.01,
    ) -> Camera:
        """Convert a calibrated camera of OpenCV, ROS or RealSense; K changes by half a pixel, see :class:`Camera`.

        Args:
            rvec: World to camera, as of ``cv2.solvePnP``: axis-angle vector [radians], [3], [3, 1] or [1, 3], or the
                rotation matrix, [3, 3].
            tvec: World to camera [scene units], [3], [3, 1] or [1, 3].
            K: OpenCV's camera matrix [pixels], [3, 3], with pixel centers at whole numbers; or a ROS ``CameraInfo`` or
                RealSense ``intrinsics``, which have the size and the distortion, too. (Of ROS's rectified images the
                camera matrix is ``np.reshape(info.p, (3, 4))[:, :3]``.)
            distortion: Coefficients of the lens; None or zeros, since ``cv2.undistort`` makes images without.
        """
        result, (width, height) = camera_conventions.from_opencv(rvec, tvec, K, size, distortion)
        return cls(*result, width, height, near)

    @classmethod
    def from_pytorch3d(
        cls,
        R: npt.ArrayLike,
        T: npt.ArrayLike,
        focal_length: npt.ArrayLike | None = None,
        principal_point: npt.ArrayLike | None = None,
        *,
        fov: float | None = None,
        size: ImageSize = (256, 256),
        in_ndc: bool = True,
        near: float = 0.01,
    ) -> Camera:
        """Convert a perspective camera of PyTorch3D (x left, y up, z forward; row vectors, ``p @ R + T``).

        Args:
            R: World to camera, [3, 3] or [1, 3, 3], as of ``look_at_view_transform``.
            T: World to camera [scene units], [3] or [1, 3].
            focal_length: Of ``PerspectiveCameras``, one number or one for x and one for y.
            principal_point: Of ``PerspectiveCameras``, [2] or [1, 2]; by default the middle of the image.
            fov: In place of ``focal_length``: that of ``FoVPerspectiveCameras`` [degrees], across the shorter side.
            size: Width and height [pixels], or one number for both (PyTorch3D's ``image_size`` is height and width).
            in_ndc: Whether focal length and principal point are in NDC, ±1 at the ends of the shorter side, +x left and
                +y up; else in pixels, +x right and +y down.
        """
        width, height = check.image_size(size)
        check.flag("in_ndc", in_ndc)
        arguments = R, T, focal_length, principal_point, fov, (width, height), in_ndc
        return cls(*camera_conventions.from_pytorch3d(*arguments), width, height, near)

    @classmethod
    def from_colmap(
        cls,
        qvec: npt.ArrayLike,
        tvec: npt.ArrayLike,
        model: str,
        params: npt.ArrayLike,
        size: ImageSize,
        *,
        near: float = 0.01,
    ) -> Camera:
        """Convert a camera of COLMAP; :func:`warpshadow.load_cameras` reads all of a folder.

        Args:
            qvec: World to camera, a unit quaternion QW, QX, QY, QZ.
            tvec: World to camera [scene units], TX, TY, TZ.
            model: "SIMPLE_PINHOLE" or "PINHOLE"; ``colmap image_undistorter`` makes such of others.
            params: f, cx, cy, or fx, fy, cx, cy [pixels]; pixel centers are at +0.5, as here.
        """
        width, height = check.image_size(size)
        return cls(*camera_conventions.from_colmap(qvec, tvec, model, params), width, height, near)

    @classmethod
    def from_opengl(
        cls,
        view: npt.ArrayLike,
        projection: npt.ArrayLike | None = None,
        *,
        fov_y: float | None = None,
        size: ImageSize = (256, 256),
        near: float | None = None,
    ) -> Camera:
        """Convert an OpenGL camera (x right, y up, z backward; column vectors; image origin at the bottom).

        Args:
            view: World to eye, a rotation and a translation [scene units], shape [4, 4].
            projection: Perspective projection to OpenGL's clip space, shape [4, 4]; off-center ones are
                welcome. Either order of the two will do: only one of them can be a projection.
            fov_y: In place of ``projection``: vertical field of view [degrees].
            near: Distance of the near plane [scene units]; by default the projection's, or 0.01 with ``fov_y``.
        Raises:
            ValueError: when the view is not rigid or the projection not a perspective.
        """
        width, height = check.image_size(size)
        if (projection is None) == (fov_y is None):
            raise ValueError("projection, fov_y: expected exactly one of them")
        view = check.array("view", view, (4, 4))
        if fov_y is not None:
            intrinsics = _centered_intrinsics(fov_y, width, height)
            near = 0.01 if near is None else near
        else:
            projection = check.array("projection", projection, (4, 4))
            if _is_perspective(view) and not _is_perspective(projection):
                view, projection = projection, view
            if not _is_perspective(projection) or projection[:2, 3].any():
                raise ValueError(
                    f"projection: got {projection.tolist()}, expected a perspective, last row [0, 0, -1, 0] "
                    "and no translation of x and y"
                )
            intrinsics = camera_conventions.opengl_intrinsics(projection, (width, height))
            if near is None:
                near = projection[2, 3] / (projection[2, 2] - 1.0)
        if not np.array_equal(view[3], (0.0, 0.0, 0.0, 1.0)):
            raise ValueError(f"view: got last row {view[3].tolist()}, expected [0, 0, 0, 1]")
        check_rotation("view", view[:3, :3])
        rotation, translation = Y_DOWN @ view[:3, :3], Y_DOWN @ view[:3, 3]
        return cls(intrinsics, rotation, translation, width, height, near)

    @property
    def eye(self) -> np.ndarray:
        """Center of projection [scene units], shape [3]."""
        return -self.rotation.T @ self.translation

    def turned(self, degrees: float, about: npt.ArrayLike = (0.0, 0.0, 0.0)) -> Camera:
        """Turn the camera about the vertical line through a point: +y, counter-clockwise seen from above.

        Args:
            degrees: The angle.
            about: A point of the line [scene units], shape [3].
        """
        from scipy.spatial.transform import Rotation

        center = check.array("about", about, (3,))
        turn = Rotation.from_rotvec([0, check.number("degrees", degrees), 0], degrees=True).as_matrix()
        rotation = self.rotation @ turn.T
        translation = self.translation + (self.rotation - rotation) @ center
        return replace(self, rotation=rotation, translation=translation)

    def around(self, shown: Placed | Iterable[Placed] | HasBodies, count: int) -> list[Camera]:
        """Cameras for a turntable: this one, turned about the vertical through the center of the framed bodies.

        If this one shows all of it, all do: they are so far away, along their views, that they do.

        Args:
            shown: A mesh, a body, several, or a scene; as for :meth:`framing`.
            count: Number of cameras; they go around once, counter-clockwise seen from above.
        """
        points = framed_points(shown)
        center = (points.min(axis=0) + points.max(axis=0)) / 2
        angles = 360 * np.arange(check.integer("count", count, unit="cameras")) / count
        cameras = [self.turned(angle, center) for angle in angles]
        if self._missing_distance(points) > 1e-6 * np.ptp(points, axis=0).max():
            return cameras
        distance = max(0.0, *(camera._missing_distance(points, margin=_TURNTABLE_MARGIN) for camera in cameras))
        return [replace(camera, translation=camera.translation + (0.0, 0.0, distance)) for camera in cameras]

    def _missing_distance(self, points: np.ndarray, margin: float = 0.0) -> float:
        """Distance by which it must move back along the view to show all points; negative if it may move nearer."""
        x, y, z = self.rotation @ points.T + self.translation[:, None]
        (fx, skew, cx), (_, fy, cy), _ = self.intrinsics
        edges = (1 - margin) * np.array([cx, self.width - cx, cy, self.height - cy])  # pixels to the edges
        if edges.min() <= 0:
            return np.inf
        u, v = fx * x + skew * y, fy * y  # pixels from the principal point, times depth
        depths = np.stack([-u, u, -v, v]) / edges[:, None]  # at which a point is on an edge
        return float((np.maximum(depths.max(axis=0), self.near) - z).max())

    def resized(self, factor: float) -> Camera:
        """Scale the image of a view by ``factor``, rounded to whole pixels, at least one."""
        factor = check.positive("factor", factor)
        return self.stretched(*(max(1, round(count * factor)) for count in (self.width, self.height)))

    def stretched(self, width: int, height: int) -> Camera:
        """Stretch a view to an image of another size [pixels]; with other proportions, pixels are not square."""
        width, height = check.image_size((width, height))
        intrinsics = np.diag([width / self.width, height / self.height, 1.0]) @ self.intrinsics
        return replace(self, intrinsics=intrinsics, width=width, height=height)

    def with_size(self, size: ImageSize) -> Camera:
        """Give a view an image of another size [pixels]: of the same vertical field of view, wider or less wide."""
        width, height = check.image_size(size)
        factor = height / self.height
        intrinsics = np.diag([factor, factor, 1.0]) @ self.intrinsics
        intrinsics[0, 2] += (width - self.width * factor) / 2
        return replace(self, intrinsics=intrinsics, width=width, height=height)

    def clip_matrix(self) -> np.ndarray:
        """World to clip space (convention: see the module), float64, shape [4, 4]."""
        ndc_matrix = np.array([[2.0 / self.width, 0.0, -1.0], [0.0, 2.0 / self.height, -1.0]])
        matrix = np.zeros((4, 4))
        world_to_camera = np.column_stack([self.rotation, self.translation])
        matrix[:2] = ndc_matrix @ self.intrinsics @ world_to_camera
        matrix[2, 3] = self.near
        matrix[3] = world_to_camera[2]
        return matrix

    def project(self, points: np.ndarray) -> np.ndarray:
        """Pixel coordinates of world points, float64.

        Args:
            points: World positions [scene units], shape [..., 3].
        Returns:
            (u, v) [pixels], shape [..., 2]; NaN for points on or behind the plane of the eye, which have no
            image.
        """
        homogeneous = (np.asarray(points, np.float64) @ self.rotation.T + self.translation) @ self.intrinsics.T
        depth = homogeneous[..., 2:]
        return homogeneous[..., :2] / np.where(depth > 0.0, depth, np.nan)

    def rays(self) -> tuple[np.ndarray, np.ndarray]:
        """Rays through the pixel centers, in world space, float64.

        Returns:
            The eye [scene units], shape [3], and unit directions, shape [height, width, 3].
        """
        v, u = np.mgrid[0.5 : self.height, 0.5 : self.width]
        pixels = np.stack([u, v, np.ones_like(u)], axis=-1)
        directions = pixels @ np.linalg.inv(self.intrinsics).T @ self.rotation
        return self.eye, directions / np.linalg.norm(directions, axis=-1, keepdims=True)


def framed_points(shown: Any) -> np.ndarray:
    """Points that a framing camera must show, float64: of the bodies that are not flat, or of all if all are flat."""
    placed = getattr(shown, "bodies", shown)
    placed = (placed,) if hasattr(placed, "world_points") else placed
    check.instance("shown", placed, Iterable, "a mesh, a body, several, or a scene")
    parts = []
    for number, item in enumerate(placed):
        if not hasattr(item, "world_points"):
            raise ValueError(f"shown[{number}]: got {check.described(item)}, expected a mesh or a body")
        parts.append(item.world_points().astype(np.float64))
    if not parts:
        raise ValueError("shown: got nothing, expected a mesh, a body, several, or a scene")
    return np.concatenate([points for points in parts if not is_flat(points)] or parts)


def _looking_along(view: np.ndarray, up: npt.ArrayLike) -> np.ndarray:
    """Rotation from the world to a camera that looks along a direction of any length."""
    forward, top = view / np.linalg.norm(view), check.array("up", up, (3,))
    if _is_parallel(forward, top):
        raise ValueError(
            f"up: got {top.tolist()}, expected a direction not parallel to the view {forward.tolist()}, such as "
            "(0, 0, -1) for a view from above"
        )
    right = np.cross(forward, top)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward])


def _is_parallel(one: np.ndarray, other: np.ndarray) -> bool:
    return bool(np.linalg.norm(np.cross(one / np.linalg.norm(one), other)) <= 1e-6 * np.linalg.norm(other))


def _centered_intrinsics(fov_y: float, width: int, height: int) -> np.ndarray:
    if not (check.is_number(fov_y) and 0.0 < fov_y < 180.0):
        raise ValueError(f"fov_y: got {check.described(fov_y)}, expected degrees between 0 and 180")
    if fov_y < _RADIANS_LIMIT:
        check.warn(
            f"fov_y: got {fov_y:g} degrees, which is as narrow as a telescope's; if these are radians, they are "
            f"{np.degrees(fov_y):.4g} degrees"
        )
    focal = 0.5 * height / np.tan(np.radians(0.5 * fov_y))
    return np.array([[focal, 0.0, 0.5 * width], [0.0, focal, 0.5 * height], [0.0, 0.0, 1.0]])


def _is_perspective(matrix: np.ndarray) -> bool:
    return np.array_equal(matrix[3], (0.0, 0.0, -1.0, 0.0))


def check_rotation(name: str, matrix: np.ndarray) -> None:
    """Raise ValueError unless a matrix [3, 3] is a rotation."""
    orthonormal = np.abs(matrix @ matrix.T - np.eye(3)).max() <= _ROTATION_TOLERANCE
    if not orthonormal or np.linalg.det(matrix) < 0.0:
        raise ValueError(f"{name}: got {matrix.tolist()}, expected a rotation (orthonormal, determinant +1)")
