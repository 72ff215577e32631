"""Sums of light that comes to receivers on several ways."""

import functools
from collections.abc import Sequence

import warp as wp

from warpshadow.device.batch import common_batch, instance_in
from warpshadow.device.launch import launch
from warpshadow.device.memory import empty


@wp.kernel
def _add(
    # in
    some: wp.array2d(dtype=wp.vec3),
    more: wp.array2d(dtype=wp.vec3),
    # out
    total: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a receiver of an instance."""
    batch, receiver = wp.tid()
    total[batch, receiver] = (
        some[instance_in(batch, some.shape[0]), receiver] + more[instance_in(batch, more.shape[0]), receiver]
    )


def total_light(parts: Sequence[wp.array]) -> wp.array:
    """Add light, vec3 of shape [batch, receiver]; a batch of 1 serves every instance. Differentiable: parts."""
    return functools.reduce(_sum, parts)


def _sum(some: wp.array, more: wp.array) -> wp.array:
    count = common_batch({"light": some, "more light": more})
    total = empty((count, some.shape[1]), dtype=wp.vec3, device=some.device)
    launch(_add, total.shape, inputs=[some, more], outputs=[total])
    return total
