"""The exponential of log-visibility under the truncated SH product, by scaling and squaring.

exp*(f) = e^{f0/√4π} exp*(f̂ / 2^p)^{2^p}            [Lyu et al. 2021, section 3.3.3; Ren et al. 2006, section 5]

Where many spheres overlap, the truncated sum of their logs has lobes above 0, and their exponential grows without
bound: with 10 000 spheres in one direction, beyond float64. So squarings are *held* where they are no longer those of
a visibility. Squares of numbers from 0 to 1 are, in the mean, no more than the numbers; so with d = ⟨v²⟩ − ⟨v⟩, means
over directions,

    v ← v + w (v * v − v),    w = 1 − smoothstep(log(|f̂| d / QUIET) / log(LOUD / QUIET))

is plain squaring while |f̂| d ≤ QUIET, and no squaring from LOUD on: the result is then the visibility of a part of
f, 2^−k of it. The factor |f̂|, which is as large as spheres are deep, holds deep logs earlier: they are dark long
before all their squarings. QUIET to LOUD are two octaves, since by that or more one squaring raises d: so v moves
smoothly with f. The mean is the product's first coefficient, and the rule costs nothing.
"""

import functools
import warnings
from typing import NamedTuple

import numpy as np
import warp as wp

from warpshadow import check, sh
from warpshadow.lanes import MODULE_OPTIONS, group_count, lane_count, lane_functions, lane_type
from warpshadow.sh_kernels import multiply, product_table
from warpshadow.tape import record_adjoint
from warpshadow.visibility.zonal_logs import zonal_eigen_log


class Threshold(NamedTuple):
    """The |f̂| that a base approximation of the exponential is given by default, and the most it may be given."""

    default: float
    limit: float


THRESHOLDS = {
    "quadratic": Threshold(0.5, 1.0),
    "linear": Threshold(0.06, 1.0),
    "optimal_linear": Threshold(0.06, 2.0),
}
"""Base approximations of the exponential. Beyond the limits, plain squaring explodes: for `quadratic` the error is
12-fold at twice its limit and 48 000-fold at four times. At the defaults irradiance is within 0.1% (`quadratic`), 0.6%
(`linear`) and 3% (`optimal_linear`, whose table of single caps fits a sum of many spheres badly) of the converged."""

LEAST_THRESHOLD = 0.01
"""Squarings amplify float32 rounding 2^p times; below this they cost more digits than they give."""

MOST_SQUARINGS = 20
"""Limit of the squarings; a log that asks for more is cut down to what they can do."""

QUIET = 6.0
"""|f̂|(⟨v²⟩ − ⟨v⟩) up to which squaring is exact; 64 spheres around a bunny reach 0.4 (`eigen`) and 5.1 (`cap`)."""

LOUD = 24.0
"""|f̂|(⟨v²⟩ − ⟨v⟩) from which on nothing is squared."""

_UNIT = float(np.sqrt(4 * np.pi))  # the coefficient of the constant function 1
_KNOTS = 2048


@functools.cache
def _optimal_table(order: int, device: str) -> wp.array:
    """The best a·1 + b·f̂ for exp(f̂) of one cap's log, over |f̂| (Ren et al. 2006, section 5): [knot] of (a, b)."""
    log = zonal_eigen_log(order, np.cos(np.linspace(1e-3, np.pi / 2, 2000)))
    log[:, 0] = 0
    norm = np.linalg.norm(log, axis=1)
    z, weight = np.polynomial.legendre.leggauss(64)
    basis = sh.zonal_basis(order, z)
    exponential = 2 * np.pi * np.exp(log @ basis.T) * weight @ basis
    a = exponential[:, 0] / _UNIT
    b = np.sum(exponential * log, axis=1) / norm**2
    rising = np.argmax(norm)
    knots = np.linspace(0, THRESHOLDS["optimal_linear"].limit, _KNOTS + 1)
    table = np.stack([np.interp(knots, np.r_[0, norm[:rising]], np.r_[1, v[:rising]]) for v in (a, b)], axis=-1)
    return wp.array(table.astype(np.float32), dtype=wp.vec2, device=device)


@functools.cache
def _scale_function(order: int, base: str, lanes: int) -> wp.Function:
    """Make the kernel function that measures f.

    It returns p, 2^−p, |f̂|, |f̂| with the part of f0 above 0 (which no visibility has), the most p of all lanes; and of
    the base e^{…}, a, b, da/d|h|, db/d|h|.
    """
    Lane = lane_type(lanes)
    sqrt = lane_functions(lanes).sqrt
    STEP = wp.constant(THRESHOLDS["optimal_linear"].limit / _KNOTS)
    is_optimal = base == "optimal_linear"

    @wp.func
    def scale_(log: wp.array(dtype=Lane), threshold: float, optimal: wp.array(dtype=wp.vec2)):
        norm2 = Lane(0.0)
        for i in range(1, wp.static(order**2)):
            norm2 += wp.cw_mul(log[i], log[i])
        norm = sqrt(norm2)
        above = wp.max(log[0], Lane(0.0))
        depth = sqrt(norm2 + wp.cw_mul(above, above))
        count = Lane(0.0)
        scale = Lane(1.0)
        most = int(0)
        factor = Lane(0.0)
        constant = Lane(1.0)
        slope = Lane(1.0)
        constant_change = Lane(0.0)
        slope_change = Lane(0.0)
        for lane in range(lanes):
            # the least p with |f̂| / 2^p ≤ threshold, of each receiver by itself
            p = int(0)
            s = float(1.0)
            while s * depth[lane] > threshold:
                s = 0.5 * s
                p = p + 1
            p = wp.min(p, MOST_SQUARINGS)
            count[lane] = float(p)
            scale[lane] = s
            most = wp.max(most, p)
            # DC isolation: exp*(f) = e^{f0/√4π} exp*(f̂), the factor taken below the squarings so that nothing overflows
            factor[lane] = wp.exp(s * log[0][lane] / _UNIT)
            if wp.static(is_optimal):
                position = s * norm[lane] / STEP
                interval = wp.min(int(position), _KNOTS - 1)
                ab = wp.lerp(optimal[interval], optimal[interval + 1], position - float(interval))
                change = (optimal[interval + 1] - optimal[interval]) / STEP
                constant[lane] = ab[0]
                slope[lane] = ab[1]
                constant_change[lane] = change[0]
                slope_change[lane] = change[1]
        return count, scale, norm, depth, most, factor, constant, slope, constant_change, slope_change

    return scale_


@functools.cache
def _hold_function(lanes: int) -> wp.Function:
    """Make the kernel function of holding squarings: |f̂| d → the share w of the square, and its derivative."""
    Lane = lane_type(lanes)
    PER_OCTAVES = wp.constant(float(1 / np.log(LOUD / QUIET)))

    @wp.func
    def hold(loudness: Lane):
        share = Lane(1.0)
        slope = Lane(0.0)
        if wp.max(loudness) > QUIET:
            for lane in range(lanes):
                if loudness[lane] > QUIET:
                    t = wp.min(wp.log(loudness[lane] / QUIET) * PER_OCTAVES, 1.0)
                    share[lane] = 1.0 - t * t * (3.0 - 2.0 * t)
                    slope[lane] = -6.0 * PER_OCTAVES * t * (1.0 - t) / loudness[lane]
        return share, slope

    return hold


@functools.cache
def _exponentiate_kernel(order: int, base: str, keeps_powers: bool, lanes: int) -> wp.Kernel:
    Lane = lane_type(lanes)
    fn = lane_functions(lanes)
    load_rows, store_rows = fn.load_rows, fn.store_rows
    scale_, hold, multiply_ = _scale_function(order, base, lanes), _hold_function(lanes), multiply(order, lanes)

    @wp.kernel(module="unique", module_options=MODULE_OPTIONS, enable_backward=False)
    def exponentiate_log_sh(
        # in
        log_sh: wp.array3d(dtype=wp.float32),
        threshold: float,
        first: wp.array(dtype=wp.int32),
        pairs: wp.array(dtype=wp.vec2i),
        values: wp.array(dtype=wp.float32),
        optimal: wp.array(dtype=wp.vec2),
        # scratch
        scratch: wp.array4d(dtype=Lane),
        # out
        powers: wp.array4d(dtype=Lane),
        visibility: wp.array3d(dtype=wp.float32),
        faults: wp.array(dtype=wp.int32),
    ):
        """A thread owns a group of receivers: base approximation of f / 2^p, then p squarings.

        Faults count the receivers whose squarings are held, and those whose log is too large or not finite.
        """
        batch, group = wp.tid()
        row = scratch[batch, group, 0]
        square = scratch[batch, group, 1]
        load_rows(log_sh[batch], group, row)
        count, scale, _norm, depth, most, factor, constant, slope, _c, _s = scale_(row, threshold, optimal)
        mean = row[0]
        row[0] = Lane(0.0)
        linear = wp.cw_mul(wp.cw_mul(factor, scale), slope)
        if wp.static(base == "quadratic"):
            multiply_(row, row, first, pairs, values, square)
            quadratic = 0.5 * wp.cw_mul(linear, scale)
            for i in range(wp.static(order**2)):
                row[i] = wp.cw_mul(linear, row[i]) + wp.cw_mul(quadratic, square[i])
        else:
            for i in range(wp.static(order**2)):
                row[i] = wp.cw_mul(linear, row[i])
        row[0] = row[0] + _UNIT * wp.cw_mul(factor, constant)
        held = Lane(0.0)
        for step in range(most):
            if wp.static(keeps_powers):
                for i in range(wp.static(order**2)):
                    powers[batch, group, step, i] = row[i]
            multiply_(row, row, first, pairs, values, square)
            share, _slope = hold(wp.cw_mul(depth, square[0] - row[0]) / _UNIT)
            is_due = wp.min(wp.max(count - Lane(float(step)), Lane(0.0)), Lane(1.0))  # 1 while step < p
            held += wp.cw_mul(is_due, Lane(1.0) - share)
            share = wp.cw_mul(is_due, share)
            for i in range(wp.static(order**2)):
                row[i] = row[i] + wp.cw_mul(share, square[i] - row[i])
        for lane in range(wp.min(lanes, log_sh.shape[1] - group * lanes)):
            if not wp.isfinite(depth[lane] + mean[lane]):
                wp.atomic_add(faults, 1, 1)
            elif held[lane] > 0.0:
                wp.atomic_add(faults, 0, 1)
        store_rows(row, group, visibility[batch])

    return exponentiate_log_sh


@functools.cache
def _exponentiate_adjoint_kernel(order: int, base: str, lanes: int) -> wp.Kernel:
    Lane = lane_type(lanes)
    fn = lane_functions(lanes)
    load_rows, add_rows = fn.load_rows, fn.add_rows
    scale_, hold, multiply_ = _scale_function(order, base, lanes), _hold_function(lanes), multiply(order, lanes)
    is_optimal = base == "optimal_linear"

    @wp.kernel(module="unique", module_options=MODULE_OPTIONS, enable_backward=False)
    def exponentiate_log_sh_adjoint(
        # in
        log_sh: wp.array3d(dtype=wp.float32),
        threshold: float,
        first: wp.array(dtype=wp.int32),
        pairs: wp.array(dtype=wp.vec2i),
        values: wp.array(dtype=wp.float32),
        optimal: wp.array(dtype=wp.vec2),
        powers: wp.array4d(dtype=Lane),
        adj_visibility: wp.array3d(dtype=wp.float32),
        # scratch
        scratch: wp.array4d(dtype=Lane),
        # out
        adj_log_sh: wp.array3d(dtype=wp.float32),
    ):
        """A thread owns a group of receivers and goes back through the squarings, then the base.

        Γ is symmetric, so v' = v + w (v * v − v) has v̄ = v̄' + w (2 v * v̄' − v̄'), w̄ = Σ v (v * v̄' − v̄') and, as
        (v * v)_0 = |v|²/√4π, with the loudness λ = |f̂| (|v|²/4π − v0/√4π) and λ̄ = w̄ w' where it is held also
        v̄ += λ̄ |f̂| (2v/4π − e0/√4π) and |f̂|¯ += λ̄ λ/|f̂|.
        The base is v = F (a 1 + b h + q h * h), h = f̂ / 2^p and F = exp(2^−p f0/√4π):  f̄0 = 2^−p/√4π Σ v̄ v,
        h̄ = F (b v̄ + 2q h * v̄), and for a(|h|), b(|h|) also F (√4π v̄0 a' + b' Σ v̄ h) h/|h|
        """
        batch, group = wp.tid()
        log = scratch[batch, group, 0]
        adj_row = scratch[batch, group, 1]
        product = scratch[batch, group, 2]
        load_rows(log_sh[batch], group, log)
        load_rows(adj_visibility[batch], group, adj_row)
        count, scale, norm, depth, most, factor, constant, slope, constant_change, slope_change = scale_(
            log, threshold, optimal
        )
        adj_depth = Lane(0.0)
        for back in range(most):
            step = most - 1 - back
            power = powers[batch, group, step]
            multiply_(power, adj_row, first, pairs, values, product)
            mean_square = Lane(0.0)
            for i in range(wp.static(order**2)):
                mean_square += wp.cw_mul(power[i], power[i])
            growth = (mean_square / _UNIT - power[0]) / _UNIT
            share, share_slope = hold(wp.cw_mul(depth, growth))
            is_due = wp.min(wp.max(count - Lane(float(step)), Lane(0.0)), Lane(1.0))
            adj_growth = Lane(0.0)
            if wp.min(share_slope) < 0.0:
                adj_share = Lane(0.0)
                for i in range(wp.static(order**2)):
                    adj_share += wp.cw_mul(power[i], product[i] - adj_row[i])
                adj_loudness = wp.cw_mul(wp.cw_mul(is_due, adj_share), share_slope)
                adj_growth = wp.cw_mul(adj_loudness, depth)
                adj_depth += wp.cw_mul(adj_loudness, growth)
            share = wp.cw_mul(is_due, share)
            for i in range(wp.static(order**2)):
                adj_row[i] = adj_row[i] + wp.cw_mul(share, 2.0 * product[i] - adj_row[i])
            if wp.min(share_slope) < 0.0:
                for i in range(wp.static(order**2)):
                    adj_row[i] = adj_row[i] + (2.0 / _UNIT / _UNIT) * wp.cw_mul(adj_growth, power[i])
                adj_row[0] = adj_row[0] - adj_growth / _UNIT

        adj_depth = wp.cw_div(adj_depth, wp.max(wp.cw_mul(scale, depth), Lane(1.0e-20)))
        above = wp.cw_mul(scale, wp.max(log[0], Lane(0.0)))
        log[0] = Lane(0.0)
        linear = wp.cw_mul(factor, slope)
        along = Lane(0.0)  # Σ v̄ h
        for i in range(1, wp.static(order**2)):
            log[i] = wp.cw_mul(scale, log[i])
            along += wp.cw_mul(adj_row[i], log[i])
        dc = wp.cw_mul(linear, along) + _UNIT * wp.cw_mul(wp.cw_mul(factor, constant), adj_row[0])  # Σ v̄ v
        if wp.static(base == "quadratic"):
            multiply_(log, adj_row, first, pairs, values, product)
            for i in range(wp.static(order**2)):
                dc += 0.5 * wp.cw_mul(factor, wp.cw_mul(product[i], log[i]))
        radial = Lane(0.0)
        if wp.static(is_optimal):
            length = wp.max(wp.cw_mul(scale, norm), Lane(1.0e-20))
            radial = wp.cw_mul(factor, _UNIT * wp.cw_mul(adj_row[0], constant_change) + wp.cw_mul(along, slope_change))
            radial = wp.cw_div(radial, length)
        for i in range(1, wp.static(order**2)):
            adj_h = wp.cw_mul(linear, adj_row[i]) + wp.cw_mul(radial, log[i])
            if wp.static(base == "quadratic"):
                adj_h += wp.cw_mul(factor, product[i])
            adj_row[i] = wp.cw_mul(scale, adj_h) + wp.cw_mul(adj_depth, log[i])
        adj_row[0] = wp.cw_mul(scale, dc) / _UNIT + wp.cw_mul(adj_depth, above)
        add_rows(adj_row, group, adj_log_sh[batch])

    return exponentiate_log_sh_adjoint


def exponentiate(log_sh: wp.array, *, base: str = "quadratic", threshold: float | None = None) -> wp.array:
    """Exponentiate log-visibility with the SH product, by scaling and squaring.

        exp*(f) = e^{f0/√4π} exp*(f̂ / 2^p)^{2^p},  p the least with |f̂| / 2^p ≤ threshold
                                                     [Lyu et al. 2021, section 3.3.3; Ren et al. 2006, section 5]

    Squarings are held where the result would rise above 1, as where hundreds of spheres overlap (see the module): it is
    then bounded, and draws a warning.

    Args:
        log_sh: Log-visibility f, float32 of shape [batch, vertex, order²], f̂ being f without its constant part.
        base: Approximation of exp*(h) for small h: "quadratic" 1 + h + h²/2, "linear" 1 + h, or "optimal_linear"
            a(|h|) 1 + b(|h|) h with a and b tabulated from caps of all angles.
        threshold: Largest |h|; None for the default of THRESHOLDS[base]. Beyond its limit squaring explodes, so more
            is refused.

    Returns:
        SH visibility, float32 of shape [batch, vertex, order²].

    Raises:
        ValueError: naming the argument, what it got and what it accepts; so for NaN, Inf and numbers beyond 1e18.
            (Reading the counts waits for the device. While a CUDA graph is captured that cannot be, and nothing is
            checked.)

    Differentiable: log_sh, for the p that it has.
    """
    check.choice("base", base, THRESHOLDS)
    default, limit = THRESHOLDS[base]
    threshold = default if threshold is None else threshold
    if not LEAST_THRESHOLD <= threshold <= limit:
        raise ValueError(
            f"threshold: got {threshold!r} for base {base!r}, expected {LEAST_THRESHOLD} to {limit}: beyond it "
            "repeated squaring is unstable, below it drowns in rounding"
        )
    check.shape("log_sh", log_sh.shape, ("batch", "vertex", "order²"))
    order = int(round(np.sqrt(log_sh.shape[2])))
    sh.check_order(order)
    check.shape("log_sh", log_sh.shape, ("batch", "vertex", order**2))
    device = log_sh.device
    lanes = lane_count(device)
    batch_count, vertex_count = log_sh.shape[:2]
    groups = group_count(vertex_count, lanes)
    needs_gradient = log_sh.requires_grad
    # memory that no squaring reaches is never touched
    powers_shape = (batch_count, groups, MOST_SQUARINGS if needs_gradient else 0, order**2)
    powers = wp.empty(powers_shape, dtype=lane_type(lanes), device=device)
    scratch = wp.empty((batch_count, groups, 3, order**2), dtype=lane_type(lanes), device=device)
    visibility = wp.empty_like(log_sh, requires_grad=needs_gradient)
    optimal = _optimal_table(order, str(device)) if base == "optimal_linear" else None
    faults = wp.zeros(2, dtype=wp.int32, device=device)
    wp.launch(
        _exponentiate_kernel(order, base, needs_gradient, lanes),
        dim=(batch_count, groups),
        inputs=[log_sh, threshold, *product_table(order, str(device), symmetric=True), optimal, scratch],
        outputs=[powers, visibility, faults],
        device=device,
        record_tape=False,
    )
    if not device.is_capturing:
        held, broken = faults.numpy().tolist()
        if broken:
            check.finite_arrays({"log_sh": log_sh}, most=check.LARGEST)
        if held:
            warnings.warn(
                f"log-SH visibility of {held} of {batch_count * vertex_count} receivers is held back from rising above "
                "1, since many spheres overlap; fewer spheres, or directional transmittance, are accurate",
                stacklevel=2,
            )

    def adjoint() -> None:
        table = product_table(order, str(device))
        wp.launch(
            _exponentiate_adjoint_kernel(order, base, lanes),
            dim=(batch_count, groups),
            inputs=[log_sh, threshold, *table, optimal, powers, visibility.grad, scratch],
            outputs=[log_sh.grad],
            device=device,
            record_tape=False,
        )

    record_adjoint(adjoint, [log_sh, visibility])
    return visibility
