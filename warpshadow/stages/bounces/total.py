"""Sums of light that comes to receivers on several ways."""

import functools
from collections.abc import Sequence

import warp as wp

from warpshadow.device.batch import common_batch, instance_in
from warpshadow.device.launch import launch
from warpshadow.device.memory import empty


@wp.kernel
def _add_light(
    # in
    first: wp.array2d(dtype=wp.vec3),
    second: wp.array2d(dtype=wp.vec3),
    # out
    total: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a receiver of an instance."""
    batch, receiver = wp.tid()
    total[batch, receiver] = (
        first[instance_in(batch, first.shape[0]), receiver] + second[instance_in(batch, second.shape[0]), receiver]
    )


def total_light(summands: Sequence[wp.array]) -> wp.array:
    """Add light, vec3 of shape [batch, receiver]; a batch of 1 serves every instance. Differentiable: summands."""
    return functools.reduce(_sum_pair, summands)


def _sum_pair(first: wp.array, second: wp.array) -> wp.array:
    batch_count = common_batch({"light": first, "more light": second})
    total = empty((batch_count, first.shape[1]), dtype=wp.vec3, device=first.device)
    launch(_add_light, total.shape, inputs=[first, second], outputs=[total])
    return total
