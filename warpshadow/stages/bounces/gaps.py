"""Gaps: how far points of a body are from the surface of another that is parallel there."""

import numpy as np
import warp as wp

from warpshadow.device.launch import launch
from warpshadow.device.memory import empty

_PARALLEL = wp.constant(0.95)  # cosine between normals of surfaces that are parallel, at least: 18°


@wp.kernel(enable_backward=False)
def _find_gaps(
    # in
    mesh: wp.uint64,
    points: wp.array(dtype=wp.vec3),
    normals: wp.array(dtype=wp.vec3),
    max_distance: float,
    # out
    gaps: wp.array(dtype=wp.float32),
):
    """A thread owns a point."""
    i = wp.tid()
    nearest = wp.mesh_query_point_no_sign(mesh, points[i], max_distance)
    gap = float(wp.inf)
    if nearest.result:
        cosine = wp.dot(wp.normalize(normals[i]), wp.mesh_eval_face_normal(mesh, nearest.face))
        if wp.abs(cosine) > _PARALLEL:
            gap = wp.length(points[i] - wp.mesh_eval_position(mesh, nearest.face, nearest.u, nearest.v))
    gaps[i] = gap


def find_gaps(mesh: wp.Mesh, points: np.ndarray, normals: np.ndarray, max_distance: float) -> np.ndarray:
    """Distances of points [point, 3] to a mesh, of shape [point].

    They are infinite beyond ``max_distance``, and where the mesh is not parallel to the surface of the points, whose
    normals may have any length.
    """
    gaps = empty(len(points), dtype=wp.float32, device=mesh.device)
    vectors = (wp.array(item, dtype=wp.vec3, device=mesh.device) for item in (points, normals))
    launch(_find_gaps, len(points), inputs=[mesh.id, *vectors, float(max_distance)], outputs=[gaps])
    return gaps.numpy()
