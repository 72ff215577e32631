"""Joint coverage: the share of a cell of directions that several blockers leave open, and where.

Of each blocker the share h that it covers is known, and its first moment μ (:mod:`warpshadow.stages.cell_coverage`),
but not the part that two of them cover both. If they are independent; beside each other, as a roof and the wall under
it; or behind each other, as a car on a ground, there is open

    Π (1 − h)        max(0, 1 − Σ h)        1 − max h

Moments tell which: of blockers beside each other they point apart, of blockers behind each other the same way. With
ν(h) the moment of a half-plane that covers h, the longest that there is,

    k = Σ_{i≠j} μ_i·μ_j / Σ_{i≠j} ν(h_i) ν(h_j)
    T = (1 − |k|) Π (1 − h) + |k| (max(0, 1 − Σ h) where k < 0, else 1 − max h)

Together they cover h = 1 − T, with the moment μ = T′ Σ μ, T′ = (1 − T) / Σ h. (The kernels below find T past two
blockers, :mod:`.convex.joint_lanes` h and μ of any number.)

A barn of planks under an even sky is 2% off, as if blockers were independent it would be 23% too bright.
"""

import warp as wp

from warpshadow import check
from warpshadow.device.batch import common_batch, expand_rows
from warpshadow.device.launch import launch_with_adjoint
from warpshadow.device.memory import empty
from warpshadow.device.parallel import split_row

MIN_BOUNDS = wp.constant(1.0e-6)
"""Σ ν ν below which blockers count as independent: such a product is of the size of its rounding."""

MOMENT_BOUND = wp.constant(wp.vec3(0.96935, -0.81588, 1.36307))
"""ν(h) by powers of h (1 − h), from the first on, fitted to within 0.0005: a half-plane at the distance d from the
middle of a disc of radius 1 covers h = (acos d − d √(1 − d²)) / π, with the moment 2 (1 − d²)^(3/2) / 3π."""

_PASS_COST = 1.0  # time of a cell [ns]


@wp.func
def _open_share(coverage: wp.vec4, other: wp.vec4):
    """T past two blockers of a cell; it calls no function, whose slopes ``wp.grad`` may leave out."""
    cell_share = wp.clamp(coverage[0], 0.0, 1.0)
    other_share = wp.clamp(other[0], 0.0, 1.0)
    u = cell_share * (1.0 - cell_share)
    v = other_share * (1.0 - other_share)
    bound = u * (MOMENT_BOUND[0] + u * (MOMENT_BOUND[1] + u * MOMENT_BOUND[2]))
    other_bound = v * (MOMENT_BOUND[0] + v * (MOMENT_BOUND[1] + v * MOMENT_BOUND[2]))
    moment = wp.vec3(coverage[1], coverage[2], coverage[3])
    other_moment = wp.vec3(other[1], other[2], other[3])
    moment_sum = moment + other_moment
    moment_pairs = wp.dot(moment_sum, moment_sum) - (wp.dot(moment, moment) + wp.dot(other_moment, other_moment))
    bound_sum = bound + other_bound
    bound_pairs = bound_sum * bound_sum - (bound * bound + other_bound * other_bound) + MIN_BOUNDS
    relation = wp.clamp(moment_pairs / bound_pairs, -1.0, 1.0)
    weight = wp.abs(relation)
    related = wp.where(
        relation < 0.0, wp.max(0.0, 1.0 - (cell_share + other_share)), 1.0 - wp.max(cell_share, other_share)
    )
    return (1.0 - weight) * ((1.0 - cell_share) * (1.0 - other_share)) + weight * related


@wp.func
def _is_partial(coverage: wp.vec4):
    """Whether a blocker covers a part of a cell only; other coverage has no gradient."""
    return coverage[0] > 0.0 and coverage[0] < 1.0


@wp.kernel(enable_backward=False)
def _attenuate(
    first_row: int,
    worker: int,
    # in
    transmittance: wp.array3d(dtype=wp.float32),
    coverages: wp.array3d(dtype=wp.vec4),
    others: wp.array3d(dtype=wp.vec4),
    # out
    attenuated: wp.array3d(dtype=wp.float32),
):
    """A thread owns a receiver."""
    batch, receiver = split_row(first_row + wp.tid(), attenuated.shape[1])
    for q in range(attenuated.shape[2]):
        open_share = wp.max(0.0, 1.0 - coverages[batch, receiver, q][0])
        if others and open_share > 0.0:
            if open_share < 1.0 and others[batch, receiver, q][0] > 0.0:
                open_share = _open_share(coverages[batch, receiver, q], others[batch, receiver, q])
            else:  # one of the two covers nothing, or all: the other's share is exact
                open_share = wp.min(open_share, wp.clamp(1.0 - others[batch, receiver, q][0], 0.0, 1.0))
        if transmittance:
            open_share *= transmittance[batch, receiver, q]
        attenuated[batch, receiver, q] = open_share


@wp.kernel(enable_backward=False)
def _attenuate_adjoint(
    first_row: int,
    worker: int,
    # in
    transmittance: wp.array3d(dtype=wp.float32),
    coverages: wp.array3d(dtype=wp.vec4),
    others: wp.array3d(dtype=wp.vec4),
    adj_attenuated: wp.array3d(dtype=wp.float32),
    # out
    adj_transmittance: wp.array3d(dtype=wp.float32),
    adj_coverages: wp.array3d(dtype=wp.vec4),
    adj_others: wp.array3d(dtype=wp.vec4),
):
    """A thread owns a receiver; cells that are covered wholly have no gradient."""
    batch, receiver = split_row(first_row + wp.tid(), adj_attenuated.shape[1])
    for q in range(adj_attenuated.shape[2]):
        adj_cell = adj_attenuated[batch, receiver, q]
        coverage = coverages[batch, receiver, q]
        if adj_cell != 0.0 and coverage[0] < 1.0:
            other = wp.vec4()
            if others:
                other = others[batch, receiver, q]
            open_share = _open_share(coverage, other)
            adj_coverage = wp.vec4(wp.clamp(other[0], 0.0, 1.0) - 1.0, 0.0, 0.0, 0.0)
            adj_other = wp.vec4(wp.clamp(coverage[0], 0.0, 1.0) - 1.0, 0.0, 0.0, 0.0)
            if _is_partial(coverage) and _is_partial(other):
                adj_coverage, adj_other = wp.grad(_open_share)(coverage, other)
            if open_share > 0.0:
                factor = adj_cell
                if transmittance:
                    factor = adj_cell * transmittance[batch, receiver, q]
                if adj_transmittance:
                    adj_transmittance[batch, receiver, q] = (
                        adj_transmittance[batch, receiver, q] + adj_cell * open_share
                    )
                if adj_coverages and _is_partial(coverage):
                    adj_coverages[batch, receiver, q] = adj_coverages[batch, receiver, q] + factor * adj_coverage
                if adj_others and _is_partial(other):
                    adj_others[batch, receiver, q] = adj_others[batch, receiver, q] + factor * adj_other


def transmittance_past(transmittance: wp.array | None, coverages: wp.array, others: wp.array | None = None) -> wp.array:
    """Transmittance past blockers whose coverage of cells is known, and past all else. Any batch may be 1.

    Args:
        transmittance: Past all else, float32 of shape [batch, receiver, direction]; None where nothing else blocks.
        coverages: Coverage (h, μ) by some blockers, vec4 of the same shape; an h of 1 and more covers all.
        others: Likewise, by others that may cover the same parts of cells; None for none.
    Returns:
        Float32 of the same shape.
    Differentiable: all.
    """
    for name, array in {"transmittance": transmittance, "others": others}.items():
        if array is not None:
            check.shape(name, array.shape, ("batch", *coverages.shape[1:]))
    count = common_batch({"transmittance": transmittance, "coverages": coverages, "others": others})
    inputs = [None if array is None else expand_rows(array, count) for array in (transmittance, coverages, others)]
    shape = count, *coverages.shape[1:]
    return launch_with_adjoint(
        _attenuate,
        _attenuate_adjoint,
        shape[0] * shape[1],
        inputs=inputs,
        result=empty(shape, dtype=wp.float32, device=coverages.device),
        variables=inputs,
        cost=_PASS_COST * shape[2],
    )
