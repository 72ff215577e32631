"""Held squarings of visibility in spherical harmonics: each stops where it would explode.

Where many spheres overlap, the truncated sum of their logs has lobes above 0, and their exponential has no bound: with
10 000 spheres in one direction it leaves float64. A visibility has values from 0 to 1, so the mean of v² over all
directions is at most the mean of v; truncation breaks that rule by d = ⟨v²⟩ − ⟨v⟩ > 0. Each squaring is

    v ← v + w (v * v − v),    w = 1 − smoothstep(log(|f̂| d / SQUARED_BELOW) / log(HELD_ABOVE / SQUARED_BELOW))

- While |f̂| d ≤ SQUARED_BELOW, w = 1: v is squared. From HELD_ABOVE on, w = 0: v stays as it is. If k squarings are left
  out, the result is the visibility of f / 2^k.
- |f̂| grows with the number of spheres that overlap, and stops the squarings of such logs earlier; nothing is lost,
  since such receivers are dark before their last squarings.
- HELD_ABOVE is four times SQUARED_BELOW: one squaring raises d by that factor or more, so w is between 0 and 1 for one
  squaring at a time, and v changes smoothly with f.

The rule is cheap: the mean of v² is the first coefficient of v * v.
"""

import functools

import numpy as np
import warp as wp

from warpshadow.device.lanes import lane_type
from warpshadow.stages.sh_kernels import ProductTable, make_multiply

SQUARED_BELOW = 6.0
"""|f̂|(⟨v²⟩ − ⟨v⟩) up to which squaring is exact; 64 spheres around a bunny reach 0.4 (`eigen`) and 5.1 (`cap`)."""

HELD_ABOVE = 24.0  # |f̂|(⟨v²⟩ − ⟨v⟩) from which on nothing is squared

UNIT = float(np.sqrt(4 * np.pi))  # the coefficient of the constant function 1


@functools.cache
def _make_square_share(lanes: int) -> wp.Function:
    """Make the kernel function of holding squarings: |f̂| d → the share w of the square, and its derivative."""
    Lane = lane_type(lanes)
    PER_LOG_RANGE = wp.constant(float(1 / np.log(HELD_ABOVE / SQUARED_BELOW)))

    @wp.func
    def find_square_share(overshoot: Lane):
        square_share = Lane(1.0)
        slope = Lane(0.0)
        if wp.max(overshoot) > SQUARED_BELOW:
            for lane in range(lanes):
                if overshoot[lane] > SQUARED_BELOW:
                    t = wp.min(wp.log(overshoot[lane] / SQUARED_BELOW) * PER_LOG_RANGE, 1.0)
                    square_share[lane] = 1.0 - wp.smoothstep(0.0, 1.0, t)
                    slope[lane] = -6.0 * PER_LOG_RANGE * t * (1.0 - t) / overshoot[lane]
        return square_share, slope

    return find_square_share


@functools.cache
def make_square(order: int, lanes: int) -> wp.Function:
    """Make the kernel function of held squaring: H(v) = v + w (v * v − v); returns 1 − w."""
    Lane = lane_type(lanes)
    find_square_share, multiply = _make_square_share(lanes), make_multiply(order, lanes)

    @wp.func
    def square_held(row: wp.array(dtype=Lane), depth: Lane, table: ProductTable, square: wp.array(dtype=Lane)):
        multiply(row, row, table, square)
        square_share, _slope = find_square_share(wp.cw_mul(depth, square[0] - row[0]) / UNIT)
        held_share = Lane(1.0) - square_share
        if wp.max(held_share) > 0.0:
            for i in range(wp.static(order**2)):
                square[i] = wp.cw_mul(held_share, row[i]) + wp.cw_mul(square_share, square[i])
        return held_share

    return square_held


@functools.cache
def make_square_adjoint(order: int, lanes: int) -> wp.Function:
    """Make the adjoint of :func:`make_square`: H̄ → v̄; returns Σ H̄ H(v) and |f̂|¯.

    Γ is symmetric, so v̄ = H̄ + w (2 v * H̄ − H̄), w̄ = Σ v (v * H̄ − H̄). As (v * v)_0 = |v|²/√4π, the overshoot is
    λ = |f̂| (|v|²/4π − v0/√4π), and λ̄ = w̄ w'. Where it is held, also v̄ += λ̄ |f̂| (2v/4π − e0/√4π), |f̂|¯ = λ̄ λ/|f̂|.
    """
    Lane = lane_type(lanes)
    find_square_share, multiply = _make_square_share(lanes), make_multiply(order, lanes)

    @wp.func
    def square_held_adjoint(
        row: wp.array(dtype=Lane),
        depth: Lane,
        table: ProductTable,
        adj_square: wp.array(dtype=Lane),
        adj_row: wp.array(dtype=Lane),
    ):
        multiply(row, adj_square, table, adj_row)
        mean_square = Lane(0.0)
        row_dot = Lane(0.0)
        adj_square_share = Lane(0.0)
        for i in range(wp.static(order**2)):
            mean_square += wp.cw_mul(row[i], row[i])
            row_dot += wp.cw_mul(row[i], adj_square[i])
            adj_square_share += wp.cw_mul(row[i], adj_row[i] - adj_square[i])
        mean_excess = (mean_square / UNIT - row[0]) / UNIT
        square_share, square_share_slope = find_square_share(wp.cw_mul(depth, mean_excess))
        for i in range(wp.static(order**2)):
            adj_row[i] = adj_square[i] + wp.cw_mul(square_share, 2.0 * adj_row[i] - adj_square[i])
        adj_overshoot = wp.cw_mul(adj_square_share, square_share_slope)
        if wp.min(square_share_slope) < 0.0:
            adj_mean_excess = wp.cw_mul(adj_overshoot, depth)
            for i in range(wp.static(order**2)):
                adj_row[i] = adj_row[i] + (2.0 / UNIT / UNIT) * wp.cw_mul(adj_mean_excess, row[i])
            adj_row[0] = adj_row[0] - adj_mean_excess / UNIT
        return row_dot + wp.cw_mul(square_share, adj_square_share), wp.cw_mul(adj_overshoot, mean_excess)

    return square_held_adjoint
