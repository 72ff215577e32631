"""Tail: the light of all further bounces, from those that were found.

Radiosities B_k after k bounces are sums of terms D_k = B_k − B_(k−1), of which each is a linear map of the one before.
After a few bounces terms hardly change but in size: the next are ρ D_k, ρ² D_k, … Their sum is

    Σ = ρ / (1 − ρ) D_k,   ρ = Σ_p A_p D_k D_(k−1) / Σ_p A_p D_(k−1)²

in each color, with areas A: the solution among the multiples of D_(k−1) [Galerkin; Kaniel 1966: it errs by the square
of what D still lacks]. Where light does not die away, as in a closed room of white walls, there is no sum: ρ counts as
0.98 at most, so what is added is at most 49 terms.
"""

from __future__ import annotations

import numpy as np
import warp as wp

from warpshadow import check
from warpshadow.device.batch import common_batch, instance_in
from warpshadow.device.constants import constant
from warpshadow.device.launch import launch

_MOST = wp.constant(0.98)
"""The largest ρ."""

_LEAST = wp.constant(1.0e-30)
"""The least Σ A D²: less is darkness."""


@wp.kernel
def _sum_up(
    # in
    before: wp.array2d(dtype=wp.vec3),
    last: wp.array2d(dtype=wp.vec3),
    now: wp.array2d(dtype=wp.vec3),
    areas: wp.array(dtype=wp.float32),
    # out
    sums: wp.array3d(dtype=wp.vec3),
):
    """A thread owns a patch of an instance, and adds to Σ A D_k D_(k−1) and Σ A D_(k−1)²."""
    batch, patch = wp.tid()
    middle = last[instance_in(batch, last.shape[0]), patch]
    old = middle - before[instance_in(batch, before.shape[0]), patch]
    new = now[instance_in(batch, now.shape[0]), patch] - middle
    wp.atomic_add(sums, batch, 0, 0, areas[patch] * wp.cw_mul(new, old))
    wp.atomic_add(sums, batch, 1, 0, areas[patch] * wp.cw_mul(old, old))


@wp.func
def _factor(product: float, square: float):
    """ρ / (1 − ρ)."""
    ratio = wp.clamp(product / wp.max(square, _LEAST), 0.0, _MOST)
    return ratio / (1.0 - ratio)


@wp.kernel
def _add_tail(
    # in
    last: wp.array2d(dtype=wp.vec3),
    now: wp.array2d(dtype=wp.vec3),
    sums: wp.array3d(dtype=wp.vec3),
    # out
    total: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a patch of an instance."""
    batch, patch = wp.tid()
    radiosity = now[instance_in(batch, now.shape[0]), patch]
    product = sums[batch, 0, 0]
    square = sums[batch, 1, 0]
    factor = wp.vec3(_factor(product[0], square[0]), _factor(product[1], square[1]), _factor(product[2], square[2]))
    term = radiosity - last[instance_in(batch, last.shape[0]), patch]
    total[batch, patch] = radiosity + wp.cw_mul(factor, term)


def with_tail(before: wp.array, last: wp.array, now: wp.array, areas: np.ndarray) -> wp.array:
    """Radiosity of patches after all bounces, from that after three numbers of bounces that follow each other.

    Args:
        before, last, now: After k − 2, k − 1 and k bounces, vec3 of shape [batch, patch]; a batch of 1 serves every
            instance.
        areas: Of patches [scene units²], not negative, shape [patch].

    Returns:
        vec3 of shape [batch, patch].

    Differentiable: before, last, now.
    """
    check.shape("last", last.shape, ("batch", before.shape[1]))
    check.shape("now", now.shape, ("batch", before.shape[1]))
    check.shape("areas", areas.shape, (before.shape[1],))
    check.finite("areas", np.asarray(areas), least=0.0)
    count = common_batch({"before": before, "last": last, "now": now})
    # of one, so that sums of squares neither overflow nor vanish, whatever the scene's units
    parts = constant(np.asarray(areas / max(areas.sum(), 1e-30), np.float32), wp.float32, now.device)
    sums = wp.zeros((count, 2, 1), dtype=wp.vec3, device=now.device)
    total = wp.empty((count, now.shape[1]), dtype=wp.vec3, device=now.device)
    launch(_sum_up, total.shape, inputs=[before, last, now, parts], outputs=[sums])
    launch(_add_tail, total.shape, inputs=[last, now, sums], outputs=[total])
    return total
