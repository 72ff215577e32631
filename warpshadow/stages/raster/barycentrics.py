"""Barycentrics: where on its face the center of each sample lies, and how that changes with the vertices."""

import math

import warp as wp

from warpshadow import check
from warpshadow.device.batch import rows
from warpshadow.device.launch import launch_with_adjoint
from warpshadow.device.memory import empty, reshaped
from warpshadow.device.parallel import run_length, split_row
from warpshadow.stages.raster.screen import center, ray_volumes, relative_to_ray, relative_to_ray_adjoint

TINY_VOLUME = 1.0e-36  # below this the volumes of a face are subnormal numbers, which have no reciprocal in float32

ROUNDING = 1.0e-6  # of volumes, relative to their sum

_COST = 5.0  # nanoseconds that a sample takes


@wp.func
def _weights(a: wp.vec4, b: wp.vec4, c: wp.vec4, ray: wp.vec2):
    """Perspective-correct barycentrics: to each other as the volumes that the ray spans in clip space.

    That holds for vertices behind the eye, too, so no clipping is needed; and relative to the ray nothing cancels when
    a face is small.
    """
    abc_volumes = ray_volumes(relative_to_ray(a, ray), relative_to_ray(b, ray), relative_to_ray(c, ray))
    sign = wp.sign(abc_volumes[0] + abc_volumes[1] + abc_volumes[2])
    # A center may lie outside of the face by as much as the vertices moved when they snapped.
    clamped_volumes = wp.max(sign * abc_volumes, wp.vec3(0.0, 0.0, 0.0))
    volume_sum = clamped_volumes[0] + clamped_volumes[1] + clamped_volumes[2]
    if volume_sum > TINY_VOLUME:
        return clamped_volumes / volume_sum
    return wp.vec3(1.0 / 3.0, 1.0 / 3.0, 1.0 / 3.0)  # edge-on, drawn only because its vertices snapped


@wp.func
def _weights_adjoint(a: wp.vec4, b: wp.vec4, c: wp.vec4, ray: wp.vec2, adj_weights: wp.vec3):
    """The adjoint of `_weights` by each vertex.

    With volumes v, their sum t and weights w = v/t: dL/dv_i = (dL/dw_i - Σ_j w_j dL/dw_j) / t, but 0 where v_i is
    clamped. A volume of 0 but for rounding, on an edge, is not clamped: meshes aligned with the samples would lose
    gradients there, on one machine or another.
    """
    relative_a = relative_to_ray(a, ray)
    relative_b = relative_to_ray(b, ray)
    relative_c = relative_to_ray(c, ray)
    abc_volumes = ray_volumes(relative_a, relative_b, relative_c)
    sign = wp.sign(abc_volumes[0] + abc_volumes[1] + abc_volumes[2])
    clamped_volumes = wp.max(sign * abc_volumes, wp.vec3(0.0, 0.0, 0.0))
    volume_sum = clamped_volumes[0] + clamped_volumes[1] + clamped_volumes[2]
    v = wp.vec3()  # the adjoint of the volumes
    if volume_sum > TINY_VOLUME:
        mean = wp.dot(clamped_volumes, adj_weights) / volume_sum
        for k in range(3):
            is_clamped = sign * abc_volumes[k] < -ROUNDING * volume_sum
            v[k] = wp.where(is_clamped, 0.0, sign / volume_sum * (adj_weights[k] - mean))
    return (
        relative_to_ray_adjoint(
            ray, wp.vec3(v[2] * relative_b[1] - v[1] * relative_c[1], v[1] * relative_c[0] - v[2] * relative_b[0], 0.0)
        ),
        relative_to_ray_adjoint(
            ray, wp.vec3(v[0] * relative_c[1] - v[2] * relative_a[1], v[2] * relative_a[0] - v[0] * relative_c[0], 0.0)
        ),
        relative_to_ray_adjoint(
            ray, wp.vec3(v[1] * relative_a[1] - v[0] * relative_b[1], v[0] * relative_b[0] - v[1] * relative_a[0], 0.0)
        ),
    )


@wp.kernel(enable_backward=False)
def _find_barycentrics(
    first_row: int,
    worker: int,
    # in
    face_ids: wp.array2d(dtype=wp.int32),
    faces: wp.array(dtype=wp.vec3i),
    clip_positions: wp.array2d(dtype=wp.vec4),
    width: int,
    run: int,
    # out
    barycentrics: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a run of samples."""
    instance, thread = split_row(first_row + wp.tid(), face_ids.shape[1] // run)
    clip = clip_positions[instance]
    height = face_ids.shape[1] // width
    row = thread * run // width
    for sample in range(thread * run, (thread + 1) * run):
        face = face_ids[instance, sample]
        if face >= 0:
            corners = faces[face]
            ray = center(sample - row * width, row, width, height)
            weights = _weights(clip[corners[0]], clip[corners[1]], clip[corners[2]], ray)
            barycentrics[instance, sample] = weights
        else:
            barycentrics[instance, sample] = wp.vec3()


@wp.kernel(enable_backward=False)
def _find_barycentrics_adjoint(
    first_row: int,
    worker: int,
    # in
    face_ids: wp.array2d(dtype=wp.int32),
    faces: wp.array(dtype=wp.vec3i),
    clip_positions: wp.array2d(dtype=wp.vec4),
    width: int,
    run: int,
    adj_barycentrics: wp.array2d(dtype=wp.vec3),
    # sums
    adj_clip_positions: wp.array2d(dtype=wp.vec4),
):
    """A thread owns a run of samples.

    An attribute that is equal at all corners does not depend on the weights, whose sum is 1.
    """
    instance, thread = split_row(first_row + wp.tid(), face_ids.shape[1] // run)
    clip = clip_positions[instance]
    height = face_ids.shape[1] // width
    row = thread * run / width
    for sample in range(thread * run, (thread + 1) * run):
        face = face_ids[instance, sample]
        adj_weights = adj_barycentrics[instance, sample]
        if face >= 0 and (adj_weights[0] != adj_weights[1] or adj_weights[1] != adj_weights[2]):
            corners = faces[face]
            ray = center(sample - row * width, row, width, height)
            adj_a, adj_b, adj_c = _weights_adjoint(
                clip[corners[0]], clip[corners[1]], clip[corners[2]], ray, adj_weights
            )
            wp.atomic_add(adj_clip_positions, instance, corners[0], adj_a)
            wp.atomic_add(adj_clip_positions, instance, corners[1], adj_b)
            wp.atomic_add(adj_clip_positions, instance, corners[2], adj_c)


def find_barycentrics(face_ids: wp.array, faces: wp.array, clip_positions: wp.array) -> wp.array:
    """Find the barycentrics of each sample's center on its face.

    Args:
        face_ids: Visible face or -1, int32, shape [batch, height, width].
        faces: Vertex indices, vec3i, shape [face].
        clip_positions: Vertices in clip space, vec4, shape [batch, vertex].
    Returns:
        Perspective-correct weights of the face's three vertices, vec3, shape [batch, height, width], zero where there
        is no face.
    Raises:
        ValueError: when the batches differ.
    Differentiable: clip_positions. Not: face_ids.
    """
    check.shape("clip_positions", clip_positions.shape, (face_ids.shape[0], "vertex"))
    device, width = clip_positions.device, face_ids.shape[2]
    run = run_length(device, width)
    barycentrics = launch_with_adjoint(
        _find_barycentrics,
        _find_barycentrics_adjoint,
        face_ids.size // run,
        inputs=[rows(face_ids), faces, clip_positions, width, run],
        result=empty((len(face_ids), math.prod(face_ids.shape[1:])), dtype=wp.vec3, device=device),
        variables=[],
        shared=[clip_positions],
        cost=_COST * run,
        adj_cost=_COST * run,  # most samples have no gradient
    )
    return reshaped(barycentrics, face_ids.shape)
