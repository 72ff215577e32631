"""Handles to drag a body by: at its middle, in units of a page."""

import numpy as np
from scipy.spatial.transform import Rotation

from warpshadow.scene.body import Body
from warpshadow.viewer.page_camera import quaternion, rotation
from warpshadow.viewer.state import BodyPose


def middle(body: Body) -> np.ndarray:
    """Middle of a body in its own space, scaled."""
    low, high = body.mesh.bounds
    return body.scale * 0.5 * (np.asarray(low, np.float64) + high)


def radius(body: Body) -> float:
    """Half of a body's diagonal [scene units]."""
    low, high = body.mesh.bounds
    return 0.5 * body.scale * float(np.linalg.norm(np.asarray(high, np.float64) - low))


def handle_of(pose: BodyPose, body: Body, page_scale: float) -> tuple[np.ndarray, np.ndarray]:
    """Pose of a body's handles: quaternion, w first, and position [page units]."""
    body_rotation = Rotation.from_rotvec(pose.rotation, degrees=True)
    return quaternion(body_rotation), page_scale * (body_rotation.apply(middle(body)) + pose.translation)


def pose_of(wxyz: np.ndarray, position: np.ndarray, body: Body, page_scale: float) -> BodyPose:
    """Pose of a body that was dragged by its handles.

    Raises:
        ValueError: for numbers that are not finite, and for a quaternion of 0.
    """
    body_rotation = rotation(wxyz)
    translation = np.asarray(position, np.float64) / page_scale - body_rotation.apply(middle(body))
    return BodyPose(tuple(body_rotation.as_rotvec(degrees=True).tolist()), tuple(translation.tolist()))
