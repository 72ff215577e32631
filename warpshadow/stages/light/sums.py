"""Sums of light that comes to receivers on several ways."""

import warp as wp

from warpshadow.device.batch import common_batch, instance_in
from warpshadow.device.launch import launch
from warpshadow.device.memory import copied, empty, zeros


@wp.kernel
def _add_light(
    # in
    first: wp.array2d(dtype=wp.vec3),
    second: wp.array2d(dtype=wp.vec3),
    third: wp.array2d(dtype=wp.vec3),
    fourth: wp.array2d(dtype=wp.vec3),
    # out
    total: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a receiver of an instance; the last two of four summands may be missing."""
    batch, receiver = wp.tid()
    light = first[instance_in(batch, first.shape[0]), receiver] + second[instance_in(batch, second.shape[0]), receiver]
    if third:
        light += third[instance_in(batch, third.shape[0]), receiver]
    if fourth:
        light += fourth[instance_in(batch, fourth.shape[0]), receiver]
    total[batch, receiver] = light


def begin_sum(addend: wp.array | None, shape: tuple[int, int], device: wp.Device) -> wp.array:
    """Light to which a kernel adds: a copy of other light, vec3 of shape [batch, receiver], or 0.

    The kernel's adjoint has that of the copy.
    """
    return zeros(shape, wp.vec3, device) if addend is None else copied(addend)


def add_light(*summands: wp.array) -> wp.array:
    """Add light of several kinds, vec3 of shape [batch, receiver]; a batch of 1 serves every instance.

    Differentiable: summands.
    """
    if len(summands) == 1:
        return summands[0]
    if len(summands) > 4:
        return add_light(add_light(*summands[:4]), *summands[4:])
    count = common_batch({f"summand {number}": summand for number, summand in enumerate(summands)})
    total = empty((count, summands[0].shape[1]), dtype=wp.vec3, device=summands[0].device)
    launch(_add_light, total.shape, inputs=[*summands, *[None] * (4 - len(summands))], outputs=[total])
    return total
