"""Joint coverage: the share of a cell of directions that several blockers leave open, and where.

Of each blocker the share h that it covers is known, and its first moment μ (:mod:`warpshadow.stages.cell_coverage`),
but not the part that two of them cover both. If they are independent of each other; beside each other, as a roof and
the wall under it; or behind each other, as a car on a ground,

    Π (1 − h)        max(0, 1 − Σ h)        1 − max h

is open. Moments tell: of blockers beside each other they point away from each other, of blockers behind each other in
the same direction. With ν(h) the moment of a half-plane that covers h, which is the longest that there is,

    k = Σ_{i≠j} μ_i·μ_j / Σ_{i≠j} ν(h_i) ν(h_j)
    T = (1 − |k|) Π (1 − h) + |k| (max(0, 1 − Σ h) where k < 0, else 1 − max h)

Together they cover h = 1 − T, with the moment μ = T′ Σ μ, T′ = (1 − T) / Σ h.

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
"""ν(h) by powers of h (1 − h), from the first on."""

_PASS_COST = 1.0  # time of a cell [ns]


@wp.func
def _moment_bound(share: float):
    """ν(h), the moment of a half-plane that covers a share of a cell; within 3% from 0.02 to 0.98."""
    u = share * (1.0 - share)
    return u * (MOMENT_BOUND[0] + u * (MOMENT_BOUND[1] + u * MOMENT_BOUND[2]))


@wp.func
def _moment_bound_slope(share: float):
    """Its derivative."""
    u = share * (1.0 - share)
    return (1.0 - 2.0 * share) * (MOMENT_BOUND[0] + u * (2.0 * MOMENT_BOUND[1] + u * (3.0 * MOMENT_BOUND[2])))


@wp.struct
class BlockerSums:
    """Sums over the blockers of a cell; their gradients have the same fields."""

    total: float  # Σ h
    product: float  # Π (1 − h)
    largest: float  # max h
    moment: wp.vec3  # Σ μ
    squares: float  # Σ |μ|²
    bounds: float  # Σ ν
    bound_squares: float  # Σ ν²


@wp.func
def no_blockers():
    """Sums over nothing."""
    sums = BlockerSums()
    sums.product = 1.0
    return sums


@wp.func
def _moment_of(coverage: wp.vec4):
    return wp.vec3(coverage[1], coverage[2], coverage[3])


@wp.func
def with_blocker(sums: BlockerSums, coverage: wp.vec4):
    """Sums over one blocker more, of a coverage (h, μ)."""
    share = wp.clamp(coverage[0], 0.0, 1.0)
    moment = _moment_of(coverage)
    bound = _moment_bound(share)
    new_sums = sums
    new_sums.total = sums.total + share
    new_sums.product = sums.product * (1.0 - share)
    new_sums.largest = wp.max(sums.largest, share)
    new_sums.moment = sums.moment + moment
    new_sums.squares = sums.squares + wp.dot(moment, moment)
    new_sums.bounds = sums.bounds + bound
    new_sums.bound_squares = sums.bound_squares + bound * bound
    return new_sums


@wp.func
def _relation(sums: BlockerSums):
    """k, before it is clamped."""
    pairs = wp.dot(sums.moment, sums.moment) - sums.squares
    return pairs / (sums.bounds * sums.bounds - sums.bound_squares + MIN_BOUNDS)


@wp.func
def _open_if_related(sums: BlockerSums, relation: float):
    """The share that is open if blockers are beside each other, for k < 0, or behind each other."""
    return wp.where(relation < 0.0, wp.max(0.0, 1.0 - sums.total), 1.0 - sums.largest)


@wp.func
def open_share(sums: BlockerSums):
    """T, the share of a cell that blockers leave open."""
    relation = wp.clamp(_relation(sums), -1.0, 1.0)
    weight = wp.abs(relation)
    return (1.0 - weight) * sums.product + weight * _open_if_related(sums, relation)


@wp.func
def open_share_adjoint(sums: BlockerSums, adj_open: float):
    """Gradients of the sums, given that of T."""
    adj_sums = BlockerSums()
    relation = _relation(sums)
    weight = wp.min(wp.abs(relation), 1.0)
    adj_sums.product = (1.0 - weight) * adj_open
    if relation < 0.0:
        adj_sums.total = wp.where(sums.total < 1.0, -weight * adj_open, 0.0)
    else:
        adj_sums.largest = -weight * adj_open
    if weight < 1.0:
        adj_relation = wp.sign(relation) * adj_open * (_open_if_related(sums, relation) - sums.product)
        per_bounds = 1.0 / (sums.bounds * sums.bounds - sums.bound_squares + MIN_BOUNDS)
        adj_pairs = adj_relation * per_bounds
        adj_sums.moment = (2.0 * adj_pairs) * sums.moment
        adj_sums.squares = -adj_pairs
        adj_sums.bounds = -2.0 * adj_pairs * relation * sums.bounds
        adj_sums.bound_squares = adj_pairs * relation
    return adj_sums


@wp.func
def blocker_adjoint(sums: BlockerSums, adj_sums: BlockerSums, coverage: wp.vec4):
    """Gradient of the coverage (h, μ) of one blocker, given those of the sums; 0 where that covers all or nothing."""
    share = coverage[0]
    if share <= 0.0 or share >= 1.0:
        return wp.vec4()
    adj_share = adj_sums.total - adj_sums.product * sums.product / (1.0 - share)
    if share == sums.largest:
        adj_share += adj_sums.largest
    adj_share += (adj_sums.bounds + 2.0 * _moment_bound(share) * adj_sums.bound_squares) * _moment_bound_slope(share)
    adj_moment = adj_sums.moment + (2.0 * adj_sums.squares) * _moment_of(coverage)
    return wp.vec4(adj_share, adj_moment[0], adj_moment[1], adj_moment[2])


@wp.func
def _sums_of_both(
    coverages: wp.array3d(dtype=wp.vec4), others: wp.array3d(dtype=wp.vec4), batch: int, receiver: int, q: int
):
    sums = with_blocker(no_blockers(), coverages[batch, receiver, q])
    if others:
        sums = with_blocker(sums, others[batch, receiver, q])
    return sums


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
        share = wp.max(0.0, 1.0 - coverages[batch, receiver, q][0])
        if others and share > 0.0:
            share = open_share(_sums_of_both(coverages, others, batch, receiver, q))
        if transmittance:
            share *= transmittance[batch, receiver, q]
        attenuated[batch, receiver, q] = share


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
        if adj_cell != 0.0 and coverages[batch, receiver, q][0] < 1.0:
            sums = _sums_of_both(coverages, others, batch, receiver, q)
            share = open_share(sums)
            if share > 0.0:
                factor = float(1.0)
                if transmittance:
                    factor = transmittance[batch, receiver, q]
                if adj_transmittance:
                    adj_transmittance[batch, receiver, q] = adj_transmittance[batch, receiver, q] + adj_cell * share
                adj_sums = open_share_adjoint(sums, adj_cell * factor)
                if adj_coverages:
                    adj_coverages[batch, receiver, q] = adj_coverages[batch, receiver, q] + blocker_adjoint(
                        sums, adj_sums, coverages[batch, receiver, q]
                    )
                if adj_others:
                    adj_others[batch, receiver, q] = adj_others[batch, receiver, q] + blocker_adjoint(
                        sums, adj_sums, others[batch, receiver, q]
                    )


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
