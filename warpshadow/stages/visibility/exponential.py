"""The exponential of log-visibility under the truncated SH product, by scaling and squaring.

exp*(f) = e^{f0/√4π} exp*(f̂ / 2^p)^{2^p}            [Lyu et al. 2021, section 3.3.3; Ren et al. 2006, section 5]

Squarings are *held* where they would explode (:mod:`.held_squares`).

p is the least with t = |f̂| / (2^p T) ≤ 1. So that the value does not jump with p (by some tenths of a percent, where
finite differences of images would be wrong), the number of squarings is *blended*. With q the base approximation and
w = smoothstep((t − ½) / (BLEND_END − ½)), squared p times is

| t | |
| --- | --- |
| below ½, where p = 0 | q(f / 2^p) |
| ½ to BLEND_END | (1 − w) q(f / 2^p) + w q(f / 2^{p+1})² |
| BLEND_END to 1 | q(f / 2^{p+1})² |

At t = 1, p + 1 squarings take over, at their t = ½ and w = 0, with the same value and a continuous derivative. It costs
one product more.
"""

import functools
from typing import NamedTuple

import numpy as np
import warp as wp

from warpshadow import check
from warpshadow.device.array_checks import look_at_values
from warpshadow.device.lanes import block_count, lane_count, lane_type, make_lane_functions, module_options
from warpshadow.device.launch import differentiable, launch
from warpshadow.device.memory import empty, zeros
from warpshadow.device.parallel import Scratch, scratch_slot
from warpshadow.maths import sh
from warpshadow.stages.sh_kernels import ProductTable, make_multiply, product_table
from warpshadow.stages.visibility.held_squares import UNIT, make_square, make_square_adjoint
from warpshadow.stages.visibility.zonal_logs import zonal_eigen_log


class Threshold(NamedTuple):
    """The |f̂| that a base approximation of the exponential is given by default, and the most it may be given."""

    default: float
    limit: float


THRESHOLDS = {"quadratic": Threshold(1.0, 1.0), "linear": Threshold(0.12, 1.0), "optimal_linear": Threshold(0.12, 2.0)}
"""Base approximations of the exponential. Beyond the limits, plain squaring explodes: for `quadratic` the error is
3-fold at twice its limit and 200-fold at four times. "Numbers" in stages/README.md has the errors at the defaults; that
of `optimal_linear` is largest, as its table of single caps fits a sum of many spheres badly."""

MIN_THRESHOLD = 0.01  # squarings amplify float32 rounding 2^p times; below this they cost more digits than they give
MAX_SQUARINGS = 20  # limit of the squarings; a log that asks for more is cut down to it

BLEND_END = 0.7
"""|f̂| / 2^p, in thresholds, from which on the base approximation is the square of half the log's."""

_SQUARING_COST = 0.5  # nanoseconds that exponentiation takes for a receiver and a pair of coefficients

_TABLE_KNOTS = 2048


@functools.cache
def _optimal_table(order: int, device: str) -> wp.array:
    """The best a·1 + b·f̂ for exp(f̂) of one cap's log, over |f̂| (Ren et al. 2006, section 5): [knot] of (a, b)."""
    log = zonal_eigen_log(order, np.cos(np.linspace(1e-3, np.pi / 2, 2000)))
    log[:, 0] = 0
    norm = np.linalg.norm(log, axis=1)
    z, weight = np.polynomial.legendre.leggauss(64)
    basis = sh.zonal_basis(order, z)
    exponential = 2 * np.pi * np.exp(log @ basis.T) * weight @ basis
    a = exponential[:, 0] / UNIT
    b = np.sum(exponential * log, axis=1) / norm**2
    peak = np.argmax(norm)
    knots = np.linspace(0, THRESHOLDS["optimal_linear"].limit, _TABLE_KNOTS + 1)
    table = np.stack([np.interp(knots, np.r_[0, norm[:peak]], np.r_[1, v[:peak]]) for v in (a, b)], axis=-1)
    return wp.array(table.astype(np.float32), dtype=wp.vec2, device=device)


@functools.cache
def _make_find_squarings(order: int, lanes: int) -> wp.Function:
    """Make the kernel function of the number of squarings.

    It returns eight values. The fifth is one number, the others have one for each lane:
        1, 2. the number of squarings p, and 2^−p;
        3. |f̂|;
        4. |f̂| with f0 as one more coefficient where f0 > 0, as in no visibility: p follows from it;
        5. the largest p of all lanes;
        6. e^{2^−p f0 / 2√4π}, whose square is the constant factor of the base approximation;
        7, 8. the share w that blends the number of squarings, and its derivative by |f̂|.
    """
    Lane = lane_type(lanes)
    sqrt = make_lane_functions(lanes).sqrt
    PER_BLEND = wp.constant(1 / (BLEND_END - 0.5))

    @wp.func
    def find_squarings(log: wp.array(dtype=Lane), threshold: float):
        norm2 = Lane(0.0)
        for i in range(1, wp.static(order**2)):
            norm2 += wp.cw_mul(log[i], log[i])
        positive_dc = wp.max(log[0], Lane(0.0))
        depth = sqrt(norm2 + wp.cw_mul(positive_dc, positive_dc))
        count = Lane(0.0)
        scale = Lane(1.0)
        maximum = int(0)
        sqrt_factor = Lane(0.0)
        blend = Lane(0.0)
        blend_slope = Lane(0.0)
        for lane in range(lanes):
            # the least p with |f̂| / 2^p ≤ threshold, of each receiver by itself
            squaring_count = int(0)
            halving = float(1.0)
            while halving * depth[lane] > threshold:
                halving = 0.5 * halving
                squaring_count = squaring_count + 1
            squaring_count = wp.min(squaring_count, MAX_SQUARINGS)
            count[lane] = float(squaring_count)
            scale[lane] = halving
            maximum = wp.max(maximum, squaring_count)
            # DC isolation: exp*(f) = e^{f0/√4π} exp*(f̂), the factor taken below the squarings so that nothing
            # overflows
            sqrt_factor[lane] = wp.exp(0.5 * halving * log[0][lane] / UNIT)
            t = wp.clamp((halving * depth[lane] / threshold - 0.5) * PER_BLEND, 0.0, 1.0)
            blend[lane] = wp.smoothstep(0.0, 1.0, t)
            blend_slope[lane] = 6.0 * PER_BLEND * t * (1.0 - t) * halving / threshold
        return count, scale, sqrt(norm2), depth, maximum, sqrt_factor, blend, blend_slope

    return find_squarings


@functools.cache
def _make_factor(base: str, lanes: int) -> wp.Function:
    """Make the kernel function of the base's factors: |h| → a, b of a 1 + b h, and their derivatives."""
    Lane = lane_type(lanes)
    STEP = wp.constant(THRESHOLDS["optimal_linear"].limit / _TABLE_KNOTS)
    is_optimal = base == "optimal_linear"

    @wp.func
    def factors(length: Lane, optimal: wp.array(dtype=wp.vec2)):
        constant = Lane(1.0)
        slope = Lane(1.0)
        constant_change = Lane(0.0)
        slope_change = Lane(0.0)
        if wp.static(is_optimal):
            for lane in range(lanes):
                position = length[lane] / STEP
                interval = wp.min(int(position), _TABLE_KNOTS - 1)
                factors_at_length = wp.lerp(optimal[interval], optimal[interval + 1], position - float(interval))
                change = (optimal[interval + 1] - optimal[interval]) / STEP
                constant[lane] = factors_at_length[0]
                slope[lane] = factors_at_length[1]
                constant_change[lane] = change[0]
                slope_change[lane] = change[1]
        return constant, slope, constant_change, slope_change

    return factors


@functools.cache
def _make_base(order: int, base: str, lanes: int) -> wp.Function:
    """Make the kernel function of the base approximation F (a 1 + b h + q h * h), h = s f̂."""
    Lane = lane_type(lanes)
    factors = _make_factor(base, lanes)

    @wp.func
    def approximate(
        residual: wp.array(dtype=Lane),
        square: wp.array(dtype=Lane),
        norm: Lane,
        scale: Lane,
        factor: Lane,
        optimal: wp.array(dtype=wp.vec2),
        result: wp.array(dtype=Lane),
    ):
        """Approximate exp(f̂); ``result`` may be the residual's memory, and `quadratic` alone reads the square f̂ * f̂."""
        constant, slope, _c, _s = factors(wp.cw_mul(scale, norm), optimal)
        first_power = wp.cw_mul(factor, scale)
        linear = wp.cw_mul(first_power, slope)
        quadratic = 0.5 * wp.cw_mul(first_power, scale)
        for i in range(wp.static(order**2)):
            value = wp.cw_mul(linear, residual[i])
            if wp.static(base == "quadratic"):
                value += wp.cw_mul(quadratic, square[i])
            result[i] = value
        result[0] = result[0] + UNIT * wp.cw_mul(factor, constant)

    return approximate


@functools.cache
def _make_exponentiate(order: int, base: str, keeps_powers: bool, lanes: int) -> wp.Kernel:
    Lane = lane_type(lanes)
    fn = make_lane_functions(lanes)
    load_rows, store_rows, multiply = fn.load_rows, fn.store_rows, make_multiply(order, lanes)
    find_block = fn.find_block
    find_squarings, approximate = _make_find_squarings(order, lanes), _make_base(order, base, lanes)
    square_held = make_square(order, lanes)

    @wp.kernel(module="unique", module_options=module_options(lanes), enable_backward=False)
    def exponentiate_log_sh(
        first_row: int,
        worker: int,
        # in
        log_sh: wp.array3d(dtype=wp.float32),
        threshold: float,
        table: ProductTable,
        optimal: wp.array(dtype=wp.vec2),
        # scratch
        scratch: wp.array3d(dtype=Lane),
        # out
        powers: wp.array4d(dtype=Lane),
        visibility: wp.array3d(dtype=wp.float32),
        # sums
        faults: wp.array(dtype=wp.int32),
    ):
        """A thread owns a block of receivers: base approximation of f / 2^p, then p squarings.

        Powers are the approximation of f / 2^{p+1}, then its squares. Faults count the receivers whose squarings are
        held, and the receivers whose log is too large or not finite.
        """
        thread = first_row + wp.tid()
        batch, block = find_block(thread, log_sh.shape[1])
        thread_scratch = scratch[scratch_slot(worker, thread)]
        row = thread_scratch[0]
        square = thread_scratch[1]
        half_base = thread_scratch[2]
        if wp.static(keeps_powers):
            half_base = powers[batch, block, 0]
        load_rows(log_sh[batch], block, row)
        count, scale, norm, depth, maximum, sqrt_factor, blend, _slope = find_squarings(row, threshold)
        mean = row[0]
        row[0] = Lane(0.0)
        if wp.static(base == "quadratic"):
            multiply(row, row, table, square)
        approximate(row, square, norm, 0.5 * scale, sqrt_factor, optimal, half_base)
        approximate(row, square, norm, scale, wp.cw_mul(sqrt_factor, sqrt_factor), optimal, row)
        held_share = Lane(0.0)
        if wp.max(blend) > 0.0:
            held_share = wp.cw_mul(blend, square_held(half_base, depth, table, square))
            for i in range(wp.static(order**2)):
                row[i] = wp.cw_mul(Lane(1.0) - blend, row[i]) + wp.cw_mul(blend, square[i])
        for step in range(maximum):
            if wp.static(keeps_powers):
                for i in range(wp.static(order**2)):
                    powers[batch, block, step + 1, i] = row[i]
            is_due = wp.min(wp.max(count - Lane(float(step)), Lane(0.0)), Lane(1.0))  # 1 while step < p
            held_share += wp.cw_mul(is_due, square_held(row, depth, table, square))
            for i in range(wp.static(order**2)):
                row[i] = wp.cw_mul(Lane(1.0) - is_due, row[i]) + wp.cw_mul(is_due, square[i])
        for lane in range(wp.min(lanes, log_sh.shape[1] - block * lanes)):
            if not wp.isfinite(depth[lane] + mean[lane]):
                wp.atomic_add(faults, 1, 1)
            elif held_share[lane] > 0.0:
                wp.atomic_add(faults, 0, 1)
        store_rows(row, block, visibility[batch])

    return exponentiate_log_sh


@functools.cache
def _make_exponentiate_adjoint(order: int, base: str, lanes: int) -> wp.Kernel:
    Lane = lane_type(lanes)
    fn = make_lane_functions(lanes)
    load_rows, add_rows, multiply = fn.load_rows, fn.add_rows, make_multiply(order, lanes)
    find_block = fn.find_block
    find_squarings, factors = _make_find_squarings(order, lanes), _make_factor(base, lanes)
    square_held_adjoint = make_square_adjoint(order, lanes)

    @wp.kernel(module="unique", module_options=module_options(lanes), enable_backward=False)
    def exponentiate_log_sh_adjoint(
        first_row: int,
        worker: int,
        # in
        log_sh: wp.array3d(dtype=wp.float32),
        threshold: float,
        table: ProductTable,
        optimal: wp.array(dtype=wp.vec2),
        powers: wp.array4d(dtype=Lane),
        adj_visibility: wp.array3d(dtype=wp.float32),
        # scratch
        scratch: wp.array3d(dtype=Lane),
        # out
        adj_log_sh: wp.array3d(dtype=wp.float32),
    ):
        """A thread owns a block of receivers and goes back through the squarings, then the base.

        The base is v = q + w (H(u) − q) with q of h = f̂ / 2^p and u of h/2, each F (a 1 + b h + c h * h), and
        F = exp(2^−p f0/√4π), of u its root. So q̄ = (1 − w) v̄, ū = w H̄, w̄ = Σ v̄ H(u) − Σ v̄ q, |f̂|¯ = w̄ w', and
        f̄0 = 2^−p/√4π (Σ q̄ q + ½ Σ ū u), h̄ = F (b q̄ + 2c h * q̄) + ½ √F (b ū + 2c (h/2) * ū), and for a(|h|), b(|h|)
        also F (√4π q̄0 a' + b' Σ q̄ h) h/|h| and the like of ū. For `quadratic` q = 4 √F u − F (3 + h).
        """
        thread = first_row + wp.tid()
        batch, block = find_block(thread, log_sh.shape[1])
        thread_scratch = scratch[scratch_slot(worker, thread)]
        log = thread_scratch[0]
        adj_row = thread_scratch[1]
        product = thread_scratch[2]
        square_term = thread_scratch[3]
        load_rows(log_sh[batch], block, log)
        load_rows(adj_visibility[batch], block, adj_row)
        count, scale, norm, depth, maximum, sqrt_factor, blend, blend_slope = find_squarings(log, threshold)
        adj_depth = Lane(0.0)
        for reverse_step in range(maximum):
            step = maximum - 1 - reverse_step
            is_due = wp.min(wp.max(count - Lane(float(step)), Lane(0.0)), Lane(1.0))
            _, change = square_held_adjoint(powers[batch, block, step + 1], depth, table, adj_row, product)
            adj_depth += wp.cw_mul(is_due, change)
            for i in range(wp.static(order**2)):
                adj_row[i] = adj_row[i] + wp.cw_mul(is_due, product[i] - adj_row[i])

        half_base = powers[batch, block, 0]
        positive_dc = wp.cw_mul(scale, wp.max(log[0], Lane(0.0)))
        log[0] = Lane(0.0)
        factor = wp.cw_mul(sqrt_factor, sqrt_factor)
        length = wp.cw_mul(scale, norm)
        constant, slope, constant_change, slope_change = factors(length, optimal)
        _constant, half_slope, half_constant_change, half_slope_change = factors(0.5 * length, optimal)

        row_dot = Lane(0.0)  # Σ v̄ h
        half_dot = Lane(0.0)  # Σ v̄ u
        for i in range(wp.static(order**2)):
            log[i] = wp.cw_mul(scale, log[i])
            row_dot += wp.cw_mul(adj_row[i], log[i])
            half_dot += wp.cw_mul(adj_row[i], half_base[i])
        base_dot = wp.cw_mul(factor, UNIT * wp.cw_mul(constant, adj_row[0]) + wp.cw_mul(slope, row_dot))  # Σ v̄ q
        if wp.static(base == "quadratic"):
            base_dot = 4.0 * wp.cw_mul(sqrt_factor, half_dot) - wp.cw_mul(factor, 3.0 * UNIT * adj_row[0] + row_dot)
        base_share = Lane(1.0) - blend
        adj_dc = wp.cw_mul(base_share, base_dot)
        if wp.max(blend) > 0.0:
            squared_dot, change = square_held_adjoint(half_base, depth, table, adj_row, product)
            adj_depth += wp.cw_mul(blend, change) + wp.cw_mul(blend_slope, squared_dot - base_dot)
            for i in range(wp.static(order**2)):
                adj_half = 0.5 * wp.cw_mul(blend, product[i])
                adj_dc += wp.cw_mul(adj_half, half_base[i])
                product[i] = wp.cw_mul(sqrt_factor, adj_half)
        else:
            for i in range(wp.static(order**2)):
                product[i] = Lane(0.0)

        # from here on adj_row is F q̄ and product ½ √F ū
        half_dot = Lane(0.0)
        for i in range(wp.static(order**2)):
            adj_row[i] = wp.cw_mul(wp.cw_mul(factor, base_share), adj_row[i])
            half_dot += wp.cw_mul(product[i], log[i])
        row_dot = wp.cw_mul(wp.cw_mul(factor, base_share), row_dot)
        adj_radial = Lane(0.0)
        if wp.static(base == "optimal_linear"):
            adj_radial = UNIT * wp.cw_mul(adj_row[0], constant_change) + wp.cw_mul(row_dot, slope_change)
            adj_radial += UNIT * wp.cw_mul(product[0], half_constant_change)
            adj_radial += 0.5 * wp.cw_mul(half_dot, half_slope_change)
            adj_radial = wp.cw_div(adj_radial, wp.max(length, Lane(1.0e-20)))
        for i in range(wp.static(order**2)):
            adj_sum = adj_row[i] + 0.5 * product[i]
            adj_row[i] = (
                wp.cw_mul(slope, adj_row[i]) + wp.cw_mul(half_slope, product[i]) + wp.cw_mul(adj_radial, log[i])
            )
            product[i] = adj_sum
        if wp.static(base == "quadratic"):
            multiply(log, product, table, square_term)
            for i in range(wp.static(order**2)):
                adj_row[i] = adj_row[i] + square_term[i]
        adj_depth = wp.cw_div(adj_depth, wp.max(wp.cw_mul(scale, depth), Lane(1.0e-20)))
        for i in range(1, wp.static(order**2)):
            adj_row[i] = wp.cw_mul(scale, adj_row[i]) + wp.cw_mul(adj_depth, log[i])
        adj_row[0] = wp.cw_mul(scale, adj_dc) / UNIT + wp.cw_mul(adj_depth, positive_dc)
        add_rows(adj_row, block, adj_log_sh[batch])

    return exponentiate_log_sh_adjoint


def exponentiate(log_sh: wp.array, *, base: str = "quadratic", threshold: float | None = None) -> wp.array:
    """Exponentiate log-visibility with the SH product, by scaling and squaring (the formula is the module's).

    Squarings are held where the result would rise above 1, as where hundreds of spheres overlap: it is then bounded,
    and draws a warning.

    Args:
        log_sh: Log-visibility f, float32 of shape [batch, receiver, order²], f̂ being f without its constant part.
        base: Approximation of exp*(h) for small h: "quadratic" 1 + h + h²/2, "linear" 1 + h, or "optimal_linear"
            a(|h|) 1 + b(|h|) h with a and b tabulated from caps of all angles.
        threshold: Largest |h|; None for the default of THRESHOLDS[base]. Beyond its limit squaring explodes, so more
            is refused.
    Returns:
        SH visibility, float32 of shape [batch, receiver, order²].
    Raises:
        ValueError: for NaN, Inf and numbers beyond 1e18. (That waits for the device. While a CUDA graph is captured,
            nothing is checked.)
    Differentiable: log_sh.
    """
    check.choice("base", base, THRESHOLDS)
    default, limit = THRESHOLDS[base]
    threshold = default if threshold is None else threshold
    if not MIN_THRESHOLD <= threshold <= limit:
        raise ValueError(
            f"threshold: got {threshold!r} for base {base!r}, expected {MIN_THRESHOLD} to {limit}: beyond it "
            "repeated squaring is unstable, below it drowns in rounding"
        )
    check.shape("log_sh", log_sh.shape, ("batch", "receiver", "order²"))
    order = int(round(np.sqrt(log_sh.shape[2])))
    sh.check_order(order)
    check.shape("log_sh", log_sh.shape, ("batch", "receiver", order**2))
    device = log_sh.device
    lanes = lane_count(device)
    batch_count, receiver_count = log_sh.shape[:2]
    blocks = block_count(receiver_count, lanes)
    row_count = batch_count * blocks
    scratch = [Scratch((4, order**2), lane_type(lanes))]
    # room for the most squarings; a CPU never touches the memory of squarings that are not done, a GPU reserves all
    powers_shape = batch_count, blocks, MAX_SQUARINGS + 1, order**2
    powers = empty(powers_shape, dtype=lane_type(lanes), device=device) if log_sh.requires_grad else None
    optimal = _optimal_table(order, str(device)) if base == "optimal_linear" else None
    faults = zeros(2, dtype=wp.int32, device=device)
    cost = _SQUARING_COST * lanes * order**4
    visibility = differentiable(
        lambda visibility: launch(
            _make_exponentiate(order, base, powers is not None, lanes),
            row_count,
            cost=cost,
            inputs=[log_sh, threshold, product_table(order, str(device), symmetric=True), optimal],
            scratch=scratch,
            outputs=[powers, visibility],
            sums=[faults],
        ),
        lambda adj_visibility: launch(
            _make_exponentiate_adjoint(order, base, lanes),
            row_count,
            cost=2 * cost,
            inputs=[log_sh, threshold, product_table(order, str(device)), optimal, powers, adj_visibility],
            scratch=scratch,
            outputs=[log_sh.grad],
        ),
        result=empty(log_sh.shape, dtype=wp.float32, device=device),
        variables=[log_sh],
    )

    def judge(counts: np.ndarray) -> None:
        held_count, broken_count = counts.tolist()
        if broken_count:
            check.finite("log_sh", log_sh.numpy())
        if held_count:
            check.warn(
                f"log-SH visibility of {held_count} of {batch_count * receiver_count} receivers is held back from "
                "rising above 1, since many spheres overlap; fewer spheres, or directional transmittance, are accurate"
            )

    look_at_values(faults, judge)
    return visibility
