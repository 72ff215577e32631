"""Textures of numbers, such as roughness: they are filtered as grays, since textures are linear RGB."""

import warp as wp

from warpshadow.device.batch import instance_in, rows
from warpshadow.device.launch import launch
from warpshadow.device.memory import empty, zeros


@wp.kernel
def _scalars_to_colors(
    # in
    scalars: wp.array2d(dtype=wp.float32),
    # out
    grays: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a number."""
    batch, index = wp.tid()
    scalar = scalars[batch, index]
    grays[batch, index] = wp.vec3(scalar, scalar, scalar)


@wp.kernel
def _colors_to_scalars(
    # in
    grays: wp.array2d(dtype=wp.vec3),
    # out
    scalars: wp.array2d(dtype=wp.float32),
):
    """A thread owns a number."""
    batch, index = wp.tid()
    scalars[batch, index] = grays[batch, index][0]


def as_colors(values: wp.array) -> wp.array:
    """Numbers as grays, of the same shape; colors as they are.

    Args:
        values: Float32 or vec3, of shape [batch, item] or [batch, height, width].
    Differentiable: values.
    """
    if values.dtype == wp.vec3:
        return values
    grays = empty((len(values), values[0].size), dtype=wp.vec3, device=values.device)
    launch(_scalars_to_colors, grays.shape, inputs=[values if values.ndim == 2 else rows(values)], outputs=[grays])
    return grays.reshape(values.shape)


def as_scalars(grays: wp.array) -> wp.array:
    """The numbers of grays, float32 of shape [batch, item]. Differentiable: grays, [batch, height, width]."""
    colors = rows(grays)
    scalars = empty(colors.shape, dtype=wp.float32, device=grays.device)
    launch(_colors_to_scalars, scalars.shape, inputs=[colors], outputs=[scalars])
    return scalars


@wp.kernel
def _add_to_receivers(
    # in
    scalars: wp.array2d(dtype=wp.float32),
    face_ids: wp.array2d(dtype=wp.int32),
    faces: wp.array(dtype=wp.vec3i),
    # out
    sums: wp.array2d(dtype=wp.vec2),
):
    """A thread owns a sample; one that has no receiver of its own, but interpolates between some, adds nothing."""
    batch, sample = wp.tid()
    face = face_ids[instance_in(batch, face_ids.shape[0]), sample]
    if face >= 0:
        corners = faces[face]
        if corners[0] == corners[1]:
            wp.atomic_add(sums, batch, corners[0], wp.vec2(scalars[batch, sample], 1.0))


@wp.kernel
def _divide_sums(
    # in
    sums: wp.array2d(dtype=wp.vec2),
    # out
    means: wp.array2d(dtype=wp.float32),
):
    """A thread owns a receiver."""
    batch, receiver = wp.tid()
    means[batch, receiver] = sums[batch, receiver][0] / wp.max(sums[batch, receiver][1], 1.0)


def average_over_receivers(scalars: wp.array, face_ids: wp.array, faces: wp.array, receiver_count: int) -> wp.array:
    """Means of the scalars of samples that share a receiver; samples of different faces are in different texels.

    Args:
        scalars: Float32 of shape [batch, sample].
        face_ids: Of :attr:`.receivers.Receivers.fragments`, int32 of shape [view, sample].
        faces: Of receivers, vec3i of shape [face].
    Returns:
        Float32 of shape [batch, receiver], 0 for receivers that are vertices.
    Differentiable: scalars.
    """
    sums = zeros((len(scalars), receiver_count), dtype=wp.vec2, device=scalars.device)
    launch(_add_to_receivers, scalars.shape, inputs=[scalars, face_ids, faces], outputs=[sums])
    means = empty(sums.shape, dtype=wp.float32, device=scalars.device)
    launch(_divide_sums, means.shape, inputs=[sums], outputs=[means])
    return means
