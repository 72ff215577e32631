"""What the approximations are judged by: visibility of the mesh itself, by rays through its bounding volume hierarchy."""

from __future__ import annotations

import numpy as np
import warp as wp

from warpshadow import check


@wp.kernel(enable_backward=False)
def _trace_visibility(
    # in
    mesh: wp.uint64,
    points: wp.array2d[wp.vec3],
    normals: wp.array2d[wp.vec3],
    directions: wp.array[wp.vec3],
    offset: float,
    # out
    visibility: wp.array3d[wp.uint8],
):
    """Each thread owns one ray: a receiver and a direction."""
    batch, vertex, direction = wp.tid()
    normal = normals[batch, vertex]
    toward = directions[direction]
    escapes = wp.uint8(0)
    if wp.dot(normal, toward) > 0.0:
        start = points[batch, vertex] + offset * normal
        if not wp.mesh_query_ray_anyhit(mesh, start, toward, 1.0e30):
            escapes = wp.uint8(1)
    visibility[batch, vertex, direction] = escapes


def trace_visibility(
    mesh: wp.Mesh,
    points: wp.array,
    normals: wp.array,
    directions: wp.array,
    *,
    offset: float | None = None,
) -> wp.array:
    """Trace which directions every receiver sees past the mesh, exactly.

    Rays start ``offset`` above the receiver along its normal, so that a point of the mesh does not block itself.
    Directions below a receiver's horizon (n·ω ≤ 0) receive no light from there; they are not traced and count as blocked.

    Args:
        mesh: The blockers in scene units, one mesh for all batches; build it once, it holds the hierarchy.
        points: Receiver positions [scene units], vec3, shape [batch, vertex].
        normals: Unit normals of the receivers, vec3, shape [batch, vertex].
        directions: Unit directions toward the light, vec3, shape [direction].
        offset: Start of the rays above the receivers [scene units]; by default 1e-4 of the diagonal of the mesh's bounding box.
    Returns:
        1 where the ray escapes, else 0; uint8, shape [batch, vertex, direction].
    Raises:
        ValueError: naming the argument whose shape or value does not fit.
    Differentiable: no.
    """
    check.shape("points", points.shape, ("batch", "vertex"))
    check.shape("normals", normals.shape, points.shape)
    check.shape("directions", directions.shape, ("direction",))
    if offset is None:
        corners = mesh.points.numpy()
        offset = 1e-4 * float(np.linalg.norm(corners.max(axis=0) - corners.min(axis=0)))
    if not (np.isfinite(offset) and offset >= 0.0):
        raise ValueError(f"offset: got {offset!r}, expected a finite length that is not negative")
    visibility = wp.empty(points.shape + directions.shape, dtype=wp.uint8, device=points.device)
    wp.launch(
        _trace_visibility,
        dim=visibility.shape,
        inputs=[mesh.id, points, normals, directions, float(offset)],
        outputs=[visibility],
        device=points.device,
    )
    return visibility
