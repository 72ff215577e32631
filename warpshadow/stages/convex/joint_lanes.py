"""Joint coverage of cells, for a block of receivers, by the formulas of :mod:`warpshadow.stages.joint_coverage`."""

import functools
from typing import Any, NamedTuple

import warp as wp

from warpshadow.device.lanes import lane_type, make_lane_functions, vectors_type
from warpshadow.stages.joint_coverage import MIN_BOUNDS, MOMENT_BOUND


@functools.cache
def coverage_type(lanes: int) -> Any:
    """Struct of the coverage (h, μ) of a cell for each receiver of a thread, or of its gradient."""
    Lane, Vectors = lane_type(lanes), vectors_type(lanes)

    @wp.struct
    class Coverages:
        cell_share: Lane
        moment: Vectors

    return Coverages


@functools.cache
def sums_type(lanes: int) -> Any:
    """Struct of sums over the blockers of a cell for each receiver of a thread, or of their gradients."""
    Lane, Vectors = lane_type(lanes), vectors_type(lanes)

    @wp.struct
    class SumsOfBlockers:
        total: Lane  # Σ h
        product: Lane  # Π (1 − h)
        largest: Lane  # max h
        moment: Vectors  # Σ μ
        squares: Lane  # Σ |μ|²
        bounds: Lane  # Σ ν
        bound_squares: Lane  # Σ ν²

    return SumsOfBlockers


class JointFunctions(NamedTuple):
    """Kernel functions on the coverage of cells by several blockers."""

    no_blockers: wp.Function
    with_blocker: wp.Function
    joint_coverage: wp.Function
    joint_coverage_adjoint: wp.Function
    blocker_adjoint: wp.Function
    load_columns: wp.Function
    store_columns: wp.Function


@functools.cache
def make_joint_functions(lanes: int) -> JointFunctions:
    """Make the kernel functions for a number of lanes."""
    Lane, Coverages, SumsOfBlockers = lane_type(lanes), coverage_type(lanes), sums_type(lanes)
    fn = make_lane_functions(lanes)
    add, dot, scale, is_positive = fn.add, fn.dot, fn.scale, fn.is_positive

    @wp.func(inline=True)
    def moment_bound(cell_share: Lane):
        u = wp.cw_mul(cell_share, Lane(1.0) - cell_share)
        return wp.cw_mul(u, Lane(MOMENT_BOUND[0]) + wp.cw_mul(u, Lane(MOMENT_BOUND[1]) + MOMENT_BOUND[2] * u))

    @wp.func(inline=True)
    def moment_bound_slope(cell_share: Lane):
        u = wp.cw_mul(cell_share, Lane(1.0) - cell_share)
        by_u = Lane(MOMENT_BOUND[0]) + wp.cw_mul(u, Lane(2.0 * MOMENT_BOUND[1]) + (3.0 * MOMENT_BOUND[2]) * u)
        return wp.cw_mul(Lane(1.0) - 2.0 * cell_share, by_u)

    @wp.func(inline=True)
    def no_blockers():
        """Sums over nothing."""
        sums = SumsOfBlockers()
        sums.product = Lane(1.0)
        return sums

    @wp.func(inline=True)
    def with_blocker(sums: SumsOfBlockers, coverage: Coverages):
        """Sums over one blocker more."""
        cell_share = wp.min(wp.max(coverage.cell_share, Lane(0.0)), Lane(1.0))
        bound = moment_bound(cell_share)
        new_sums = SumsOfBlockers()
        new_sums.total = sums.total + cell_share
        new_sums.product = wp.cw_mul(sums.product, Lane(1.0) - cell_share)
        new_sums.largest = wp.max(sums.largest, cell_share)
        new_sums.moment = add(sums.moment, coverage.moment)
        new_sums.squares = sums.squares + dot(coverage.moment, coverage.moment)
        new_sums.bounds = sums.bounds + bound
        new_sums.bound_squares = sums.bound_squares + wp.cw_mul(bound, bound)
        return new_sums

    @wp.func(inline=True)
    def relate(sums: SumsOfBlockers):
        """1 / Σ ν ν; k; its weight; 1 where it is below 0; and the share that is open if blockers are so related."""
        per_bounds = wp.cw_div(Lane(1.0), wp.cw_mul(sums.bounds, sums.bounds) - sums.bound_squares + Lane(MIN_BOUNDS))
        relation = wp.cw_mul(dot(sums.moment, sums.moment) - sums.squares, per_bounds)
        weight = wp.min(wp.max(relation, -relation), Lane(1.0))
        is_beside = is_positive(-relation)
        related = wp.cw_mul(is_beside, wp.max(Lane(1.0) - sums.total, Lane(0.0)))
        related += wp.cw_mul(Lane(1.0) - is_beside, Lane(1.0) - sums.largest)
        return per_bounds, relation, weight, is_beside, related

    @wp.func(inline=True)
    def joint_share(sums: SumsOfBlockers, weight: Lane, related: Lane):
        open_share = wp.cw_mul(Lane(1.0) - weight, sums.product) + wp.cw_mul(weight, related)
        return wp.max(Lane(1.0) - open_share, Lane(0.0))

    @wp.func(inline=True)
    def joint_coverage(sums: SumsOfBlockers):
        """Coverage by all blockers together."""
        _per_bounds, _relation, weight, _is_beside, related = relate(sums)
        cell_share = joint_share(sums, weight, related)
        return Coverages(cell_share, scale(wp.cw_div(cell_share, wp.max(sums.total, Lane(1.0e-30))), sums.moment))

    @wp.func(inline=True)
    def joint_coverage_adjoint(sums: SumsOfBlockers, adj_coverage: Coverages):
        """Gradients of the sums, 0 where one blocker covers all."""
        per_bounds, relation, weight, is_beside, related = relate(sums)
        cell_share = joint_share(sums, weight, related)
        is_open = is_positive(Lane(1.0) - sums.largest)
        adj_moment = scale(is_open, adj_coverage.moment)
        per_total = wp.cw_div(is_positive(cell_share), wp.max(sums.total, Lane(1.0e-30)))
        of_total = wp.cw_mul(dot(adj_moment, sums.moment), per_total)
        of_moment = wp.cw_mul(cell_share, per_total)
        adj_cell_share = wp.cw_mul(is_open, adj_coverage.cell_share) + of_total
        adj_related = wp.cw_mul(weight, adj_cell_share)
        is_partial = wp.cw_mul(is_beside, is_positive(Lane(1.0) - sums.total))
        is_weighed = wp.cw_mul(is_positive(Lane(1.0) - weight), Lane(1.0) - 2.0 * is_beside)
        adj_relation = wp.cw_mul(wp.cw_mul(is_weighed, adj_cell_share), sums.product - related)
        adj_pairs = wp.cw_mul(adj_relation, per_bounds)
        adj = SumsOfBlockers()
        adj.product = wp.cw_mul(weight - Lane(1.0), adj_cell_share)
        adj.total = wp.cw_mul(is_partial, adj_related) - wp.cw_mul(of_total, of_moment)
        adj.largest = wp.cw_mul(Lane(1.0) - is_beside, adj_related)
        adj.moment = add(scale(2.0 * adj_pairs, sums.moment), scale(of_moment, adj_moment))
        adj.squares = -adj_pairs
        adj.bound_squares = wp.cw_mul(adj_pairs, relation)
        adj.bounds = -2.0 * wp.cw_mul(adj.bound_squares, sums.bounds)
        return adj

    @wp.func(inline=True)
    def blocker_adjoint(sums: SumsOfBlockers, adj: SumsOfBlockers, coverage: Coverages):
        """Gradient of the coverage by one blocker, given the sums' gradients; 0 where it covers all or nothing."""
        cell_share = coverage.cell_share
        open_share = Lane(1.0) - cell_share
        is_partial = wp.cw_mul(is_positive(cell_share), is_positive(open_share))
        difference = wp.max(sums.largest - cell_share, cell_share - sums.largest)
        adj_cell_share = adj.total - wp.cw_div(wp.cw_mul(adj.product, sums.product), wp.max(open_share, Lane(1.0e-30)))
        adj_cell_share += wp.cw_mul(Lane(1.0) - is_positive(difference), adj.largest)
        adj_bound = adj.bounds + 2.0 * wp.cw_mul(moment_bound(cell_share), adj.bound_squares)
        adj_cell_share += wp.cw_mul(adj_bound, moment_bound_slope(cell_share))
        adj_moment = add(adj.moment, scale(2.0 * adj.squares, coverage.moment))
        return Coverages(wp.cw_mul(is_partial, adj_cell_share), scale(is_partial, adj_moment))

    @wp.func_native(f"""
    for (int lane = 0; lane < {lanes}; ++lane) {{
        const int receiver = block * {lanes} + lane;
        for (int k = 0; k < rows.shape[1]; ++k) {{
            wp::vec_t<4, float> value;
            if (receiver < rows.shape[0])
                value = wp::index(rows, receiver, k);
            wp::index(scratch, k).cell_share.c[lane] = value.c[0];
            wp::index(scratch, k).moment.x.c[lane] = value.c[1];
            wp::index(scratch, k).moment.y.c[lane] = value.c[2];
            wp::index(scratch, k).moment.z.c[lane] = value.c[3];
        }}
    }}
    """)
    def load_columns(rows: wp.array2d(dtype=wp.vec4), block: int, scratch: wp.array(dtype=Coverages)):
        """scratch[k] = rows[the block's receivers, k], 0 past the last receiver."""
        ...

    @wp.func_native(f"""
    const int first = block * {lanes};
    const int past = first + {lanes} < rows.shape[0] ? first + {lanes} : rows.shape[0];
    for (int receiver = first; receiver < past; ++receiver)
        for (int k = 0; k < rows.shape[1]; ++k) {{
            wp::vec_t<4, float>& value = wp::index(rows, receiver, k);
            value.c[0] = wp::index(scratch, k).cell_share.c[receiver - first];
            value.c[1] = wp::index(scratch, k).moment.x.c[receiver - first];
            value.c[2] = wp::index(scratch, k).moment.y.c[receiver - first];
            value.c[3] = wp::index(scratch, k).moment.z.c[receiver - first];
        }}
    """)
    def store_columns(scratch: wp.array(dtype=Coverages), block: int, rows: wp.array2d(dtype=wp.vec4)):
        """rows[the block's receivers, k] = scratch[k]."""
        ...

    return JointFunctions(
        no_blockers, with_blocker, joint_coverage, joint_coverage_adjoint, blocker_adjoint, load_columns, store_columns
    )
