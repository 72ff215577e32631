"""Textures of numbers, such as roughness: they are filtered as grays, since textures are linear RGB."""

import warp as wp

from warpshadow.device.batch import rows
from warpshadow.device.launch import launch
from warpshadow.device.memory import empty


@wp.kernel
def _to_grays(
    # in
    numbers: wp.array2d(dtype=wp.float32),
    # out
    grays: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a number."""
    batch, item = wp.tid()
    number = numbers[batch, item]
    grays[batch, item] = wp.vec3(number, number, number)


@wp.kernel
def _from_grays(
    # in
    grays: wp.array2d(dtype=wp.vec3),
    # out
    numbers: wp.array2d(dtype=wp.float32),
):
    """A thread owns a number."""
    batch, item = wp.tid()
    numbers[batch, item] = grays[batch, item][0]


def as_colors(values: wp.array) -> wp.array:
    """Numbers as grays, of the same shape; colors as they are.

    Args:
        values: Float32 or vec3, of shape [batch, item] or [batch, height, width].
    Differentiable: values.
    """
    if values.dtype == wp.vec3:
        return values
    grays = empty((len(values), values[0].size), dtype=wp.vec3, device=values.device)
    launch(_to_grays, grays.shape, inputs=[values if values.ndim == 2 else rows(values)], outputs=[grays])
    return grays.reshape(values.shape)


def as_numbers(grays: wp.array) -> wp.array:
    """The numbers of grays, float32 of shape [batch, item]. Differentiable: grays, [batch, height, width]."""
    colors = rows(grays)
    numbers = empty(colors.shape, dtype=wp.float32, device=grays.device)
    launch(_from_grays, numbers.shape, inputs=[colors], outputs=[numbers])
    return numbers
