"""Face horizon: samples of a lobe that leave below the face of their receiver bring no light.

Where smooth normals n lean away from faces, lobes reach below the face that they are on, into the body. A sample l has
its weights w and w' times

    s(1 + l·g / 0.1),

with the smoothstep s from 0 to 1 and the face's normal g, on the side of n: all above the face, a few degrees below it
nothing.
"""

import warp as wp

from warpshadow import check
from warpshadow.device.batch import common_batch, instance_in
from warpshadow.device.launch import launch
from warpshadow.device.parallel import split_row
from warpshadow.stages.raster.rasterization import Fragments

_DEPTH = 0.1  # cosine below the face at which nothing is left

_COST = 2.0  # nanoseconds that a sample takes

wp.set_module_options({"max_unroll": 1})


@wp.kernel
def _weigh_by_faces(
    first_row: int,
    worker: int,
    # in
    face_ids: wp.array2d(dtype=wp.int32),
    faces: wp.array(dtype=wp.vec3i),
    positions: wp.array2d(dtype=wp.vec3),
    normals: wp.array2d(dtype=wp.vec3),
    directions: wp.array3d(dtype=wp.vec3),
    weights: wp.array3d(dtype=wp.vec2),
    # out
    weighed: wp.array3d(dtype=wp.vec2),
):
    """A thread owns a receiver."""
    batch, receiver = split_row(first_row + wp.tid(), weighed.shape[1])
    face = face_ids[instance_in(batch, face_ids.shape[0]), receiver]
    face_normal = wp.vec3()  # 0 without a face, which leaves all as it is
    if face >= 0:
        corners = faces[face]
        position_batch = instance_in(batch, positions.shape[0])
        a = positions[position_batch, corners[0]]
        b = positions[position_batch, corners[1]]
        c = positions[position_batch, corners[2]]
        # of unit edges, so that no product leaves the range of float32
        face_normal = wp.normalize(wp.cross(wp.normalize(b - a), wp.normalize(c - a)))
    side = wp.dot(face_normal, normals[instance_in(batch, normals.shape[0]), receiver])
    sign = wp.where(side < 0.0, -1.0, 1.0)
    for i in range(weighed.shape[2]):
        height = sign * wp.dot(face_normal, directions[batch, receiver, i])
        weighed[batch, receiver, i] = wp.smoothstep(-_DEPTH, 0.0, height) * weights[batch, receiver, i]


def weigh_by_faces(
    fragments: Fragments,
    faces: wp.array,
    positions: wp.array,
    normals: wp.array,
    directions: wp.array,
    weights: wp.array,
) -> wp.array:
    """Weigh samples of lobes by where they are above the faces of their receivers.

    Args:
        fragments: Sides of faces on which receivers lie, −1 for none, [batch, receiver].
        faces: Vertices of the sides, vec3i of shape [2 · face].
        positions: Of vertices [scene units], vec3 of shape [batch, vertex].
        normals: Of receivers, whose side counts, vec3 of shape [batch, receiver].
            Any of these batches may be 1 and then serves every instance.
        directions, weights: Of :func:`.lobes.sample_lobes`, vec3 and vec2 of shape [batch, receiver, sample].

    Returns:
        Weights, vec2 of shape [batch, receiver, sample].

    Differentiable: positions, directions, weights.
    """
    check.shape("weights", weights.shape, directions.shape)
    arrays = {"fragments": fragments.face_ids, "positions": positions, "normals": normals, "weights": weights}
    assert common_batch(arrays) == len(weights)
    weighed = wp.empty(weights.shape, dtype=wp.vec2, device=weights.device)
    launch(
        _weigh_by_faces,
        len(weights) * weights.shape[1],
        inputs=[fragments.face_ids, faces, positions, normals, directions, weights],
        outputs=[weighed],
        shared=[positions],
        cost=_COST * weights.shape[2],
    )
    return weighed
