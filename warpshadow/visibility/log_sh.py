"""Visibility in log-SH space: the blocked cones of the spheres add up, and their sum is exponentiated.

Lyu et al. 2021, section 3.3, after Ren et al. 2006 and Snyder 2006:

    log V(x) ≈ Σ_i R(u_i) z(θ_i)                                   accumulate
    V(x) = exp*(log V(x)),  * the truncated SH product              exponentiate

Two logs of one blocked cap are known. `cap` projects the function that is −ε inside the cap and 0 outside (the
paper's). `eigen` is the logarithm of the matrix that multiplies by the cap's visibility (Ren's); where spheres
overlap it is several times more accurate.
"""

import functools
from typing import NamedTuple

import numpy as np
import warp as wp

from warpshadow import check, sh
from warpshadow.lanes import MODULE_OPTIONS, group_count, lane_count, lane_functions, lane_type
from warpshadow.visibility.cones import cone_function

LOGS = ("eigen", "cap")

CAP_DEPTH = 3.0
"""ε of the log `cap`: e^−3 ≈ 0.05 of the light passes a single cap."""

EIGENVALUE_FLOOR = 0.05
"""δ of the log `eigen`: eigenvalues of the product matrix are raised to it before the logarithm."""

HORIZON_FADE = 0.5
"""A sphere fades out from (1 − HORIZON_FADE) radii to one radius below the tangent plane."""


class Threshold(NamedTuple):
    """The |f̂| that a base approximation of the exponential is given by default, and the most it may be given."""

    default: float
    limit: float


THRESHOLDS = {
    "quadratic": Threshold(0.5, 1.0),
    "linear": Threshold(0.06, 1.0),
    "optimal_linear": Threshold(0.06, 2.0),
}
"""Base approximations of the exponential. Beyond the limits, repeated squaring explodes: for `quadratic` the error is
12-fold at twice its limit and 48 000-fold at four times. At the defaults irradiance is within 0.1% (`quadratic`), 0.6%
(`linear`) and 3% (`optimal_linear`, whose table of single caps fits a sum of many spheres badly) of the converged."""

_TABLE_SIZE = 2048


# ---------------------------------------------------------------------------------------------- one cap


def zonal_cap(order: int, cosine: np.ndarray) -> np.ndarray:
    """Zonal coefficients of the indicator of caps around the z axis, shape [..., order], from cos θ [...]."""
    cosine = np.asarray(cosine, np.float64)[..., None]
    band = np.arange(1, order)
    slopes = [np.polynomial.legendre.legval(cosine, np.polynomial.legendre.legder(np.eye(order)[k])) for k in band]
    sine2 = 1 - cosine**2
    higher = sine2 * np.sqrt(np.pi * (2 * band + 1)) / (band * (band + 1)) * np.concatenate(slopes, axis=-1)
    return np.concatenate([np.sqrt(np.pi) * (1 - cosine), higher], axis=-1)


def zonal_eigen_log(order: int, cosine: np.ndarray) -> np.ndarray:
    """Zonal log-visibility of caps by eigen decomposition (Ren et al. 2006, section 4), shape [..., order].

    M_lk = Σ_j v_j ∫ y_l0 y_j0 y_k0 multiplies with the cap's visibility v; with M = R diag(e) Rᵀ, the result is
    R log(max(e, δ)) Rᵀ applied to the constant 1.
    """
    visibility = -zonal_cap(order, cosine)
    visibility[..., 0] += np.sqrt(4 * np.pi)
    z, weight = np.polynomial.legendre.leggauss(2 * order)
    basis = sh.zonal_basis(order, z)
    triple = 2 * np.pi * np.einsum("q,ql,qj,qk->ljk", weight, basis, basis, basis)
    eigenvalues, vectors = np.linalg.eigh(np.einsum("...j,ljk->...lk", visibility, triple))
    logs = np.log(np.maximum(eigenvalues, EIGENVALUE_FLOOR))
    return np.sqrt(4 * np.pi) * np.einsum("...lj,...j,...j->...l", vectors, logs, vectors[..., 0, :])


@functools.cache
def _eigen_table(order: int, device: str) -> wp.array:
    """C² cubic splines of z_l / sin²θ over cos θ, which is smooth down to θ = 0: [interval, power] of [order]."""
    from scipy.interpolate import CubicSpline

    cosine = np.linspace(0, 1, _TABLE_SIZE + 1)
    cosine[-1] = 1 - 1e-9  # the limit of 0/0
    splines = CubicSpline(np.linspace(0, 1, _TABLE_SIZE + 1), zonal_eigen_log(order, cosine) / (1 - cosine**2)[:, None])
    powers = splines.c[::-1].transpose(1, 0, 2)  # [interval, power, band]
    powers = powers / float(_TABLE_SIZE) ** np.arange(4)[:, None]  # in units of an interval
    band_vector = wp.types.vector(length=order, dtype=wp.float32)
    return wp.array(powers.astype(np.float32), dtype=band_vector, device=device)


@functools.cache
def _zonal_cap_function(order: int, lanes: int) -> wp.Function:
    """Make the kernel function that projects caps: z_0 = √π s²/(1+c), z_l = √(π(2l+1))/(l(l+1)) s² P_l'(c)."""
    Lane, Zonal = lane_type(lanes), sh.zonal_type(order, lanes)

    @wp.func
    def zonal_cap_(cosine: Lane, sine2: Lane):
        zonal = Zonal()
        zonal[0] = wp.sqrt(wp.pi) * wp.cw_div(sine2, Lane(1.0) + cosine)
        below = Lane(1.0)  # P_{l−1}
        legendre = cosine  # P_l
        slope_below = Lane(0.0)
        slope = Lane(1.0)
        for index in range(1, order):
            band = float(index)
            factor = wp.sqrt(wp.pi * (2.0 * band + 1.0)) / (band * (band + 1.0))
            zonal[index] = factor * wp.cw_mul(sine2, slope)
            slope_above = slope_below + (2.0 * band + 1.0) * legendre
            above = ((2.0 * band + 1.0) * wp.cw_mul(cosine, legendre) - band * below) / (band + 1.0)
            below = legendre
            legendre = above
            slope_below = slope
            slope = slope_above
        return zonal

    return zonal_cap_


@functools.cache
def _zonal_log_function(order: int, log: str, lanes: int) -> wp.Function:
    """Make the kernel function that takes the log-visibility of caps: cos θ, sin²θ, table → zonal coefficients."""
    Lane, Zonal = lane_type(lanes), sh.zonal_type(order, lanes)
    Band = wp.types.vector(length=order, dtype=wp.float32)
    zonal_cap_ = _zonal_cap_function(order, lanes)

    @wp.func
    def cap(cosine: Lane, sine2: Lane, table: wp.array2d(dtype=Band)):
        return -CAP_DEPTH * zonal_cap_(cosine, sine2)

    @wp.func
    def eigen(cosine: Lane, sine2: Lane, table: wp.array2d(dtype=Band)):
        zonal = Zonal()
        for lane in range(lanes):
            position = cosine[lane] * float(_TABLE_SIZE)
            interval = wp.min(int(position), _TABLE_SIZE - 1)
            t = position - float(interval)
            z = table[interval, 2] + t * table[interval, 3]
            z = table[interval, 1] + t * z
            z = sine2[lane] * (table[interval, 0] + t * z)
            for band in range(order):
                zonal[band, lane] = z[band]
        return zonal

    return {"cap": cap, "eigen": eigen}[log]


# ---------------------------------------------------------------------------------------------- accumulation


@functools.cache
def _accumulate_kernel(order: int, log: str, has_horizon: bool, lanes: int) -> wp.Kernel:
    Lane = lane_type(lanes)
    Band = wp.types.vector(length=order, dtype=wp.float32)
    fn = lane_functions(lanes)
    load, store_rows = fn.load, fn.store_rows
    cone = cone_function(lanes)
    zonal_log = _zonal_log_function(order, log, lanes)
    add_rotated_zonal = sh.add_rotated_zonal(order, lanes)

    @wp.kernel(module="unique", module_options=MODULE_OPTIONS, enable_backward=False)
    def accumulate_log_sh(
        # in
        points: wp.array2d(dtype=wp.vec3),
        normals: wp.array2d(dtype=wp.vec3),
        centers: wp.array2d(dtype=wp.vec3),
        radii: wp.array2d(dtype=wp.float32),
        table: wp.array2d(dtype=Band),
        # scratch
        total: wp.array3d(dtype=Lane),
        # out
        log_sh: wp.array3d(dtype=wp.float32),
    ):
        """A thread owns a group of receivers and sums the log-visibility of all spheres."""
        batch, group = wp.tid()
        x, y, z = load(points[batch], group)
        row = total[batch, group]
        for i in range(wp.static(order**2)):
            row[i] = Lane(0.0)
        for sphere in range(centers.shape[1]):
            radius = radii[batch, sphere]
            if radius > 0.0:
                center = centers[batch, sphere]
                dx = Lane(center[0]) - x
                dy = Lane(center[1]) - y
                dz = Lane(center[2]) - z
                ux, uy, uz, cosine, sine2, weight = cone(dx, dy, dz, radius)
                if wp.static(has_horizon):
                    nx, ny, nz = load(normals[batch], group)
                    height = (wp.cw_mul(nx, dx) + wp.cw_mul(ny, dy) + wp.cw_mul(nz, dz)) / radius
                    t = wp.min(wp.max((height + Lane(1.0)) / HORIZON_FADE, Lane(0.0)), Lane(1.0))
                    weight = wp.cw_mul(weight, wp.cw_mul(wp.cw_mul(t, t), Lane(3.0) - 2.0 * t))
                if wp.max(weight) > 0.0:
                    zonal = zonal_log(cosine, wp.cw_mul(sine2, weight), table)
                    add_rotated_zonal(ux, uy, uz, zonal, row)
        store_rows(row, group, log_sh[batch])

    return accumulate_log_sh


def accumulate(
    points: wp.array,
    normals: wp.array | None,
    centers: wp.array,
    radii: wp.array,
    *,
    order: int = 8,
    log: str = "eigen",
) -> wp.array:
    """Accumulate the log-visibility of spheres in spherical harmonics.

        f(x) = Σ_i R(u_i) z(θ_i)                      [Lyu et al. 2021, section 3.3.2]

    Args:
        points: Receiver positions [scene units], vec3 of shape [batch, vertex].
        normals: Unit normals of the receivers, vec3 of shape [batch, vertex]: spheres below the horizon, which
            cannot change irradiance but whose band-limited logs leak above it, fade out. None keeps them all.
        centers: Sphere centers [scene units], vec3 of shape [batch, sphere].
        radii: Sphere radii [scene units], float32 of shape [batch, sphere]; a radius of 0 blocks nothing.
        order: Number of SH bands n, 2 to 8.
        log: "eigen" (Ren et al. 2006, accurate where spheres overlap) or "cap" (the paper's).

    Returns:
        Log-visibility, float32 of shape [batch, vertex, order²], index l² + l + m.

    Raises:
        ValueError: naming the argument, what it got and what it accepts.

    Differentiable: nothing yet.
    """
    sh.check_order(order)
    check.choice("log", log, LOGS)
    device = points.device
    lanes = lane_count(device)
    batch_count, vertex_count = points.shape
    if normals is not None:
        check.shape("normals", normals.shape, points.shape)
    check.shape("centers", centers.shape, (batch_count, "sphere"))
    check.shape("radii", radii.shape, centers.shape)
    groups = group_count(vertex_count, lanes)
    log_sh = wp.empty((batch_count, vertex_count, order**2), dtype=wp.float32, device=device)
    wp.launch(
        _accumulate_kernel(order, log, normals is not None, lanes),
        dim=(batch_count, groups),
        inputs=[
            points,
            normals,
            centers,
            radii,
            _eigen_table(order, str(device)) if log == "eigen" else None,
            wp.empty((batch_count, groups, order**2), dtype=lane_type(lanes), device=device),
        ],
        outputs=[log_sh],
        device=device,
    )
    return log_sh


# ---------------------------------------------------------------------------------------------- exponentiation


@functools.cache
def _exponentiate_kernel(order: int, base: str, lanes: int) -> wp.Kernel:
    Lane = lane_type(lanes)
    fn = lane_functions(lanes)
    load_rows, store_rows, sqrt = fn.load_rows, fn.store_rows, fn.sqrt
    multiply = sh.multiply(order, lanes)
    UNIT = wp.constant(float(np.sqrt(4 * np.pi)))  # the coefficient of the constant function 1
    OPTIMAL_STEP = wp.constant(THRESHOLDS["optimal_linear"].limit / _TABLE_SIZE)

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
        power: wp.array3d(dtype=Lane),
        squared: wp.array3d(dtype=Lane),
        # out
        visibility: wp.array3d(dtype=wp.float32),
    ):
        """A thread owns a group of receivers: base approximation of f / 2^p, then p squarings."""
        batch, group = wp.tid()
        row = power[batch, group]
        square = squared[batch, group]
        load_rows(log_sh[batch], group, row)
        norm2 = Lane(0.0)
        for i in range(1, wp.static(order**2)):
            norm2 += wp.cw_mul(row[i], row[i])
        norm = sqrt(norm2)
        # the least p with |f̂| / 2^p ≤ threshold, of each receiver by itself
        count = Lane(0.0)
        scale = Lane(1.0)
        most = int(0)
        for lane in range(lanes):
            p = int(0)
            s = float(1.0)
            while s * norm[lane] > threshold:
                s = 0.5 * s
                p = p + 1
            count[lane] = float(p)
            scale[lane] = s
            most = wp.max(most, p)
        # DC isolation: exp*(f) = e^{f0/√4π} exp*(f̂), the factor taken below the squarings so that nothing overflows
        factor = Lane(0.0)
        constant = Lane(1.0)
        slope = Lane(1.0)
        for lane in range(lanes):
            factor[lane] = wp.exp(scale[lane] * row[0][lane] / UNIT)
            if wp.static(base == "optimal_linear"):
                position = scale[lane] * norm[lane] / OPTIMAL_STEP
                interval = wp.min(int(position), _TABLE_SIZE - 1)
                ab = wp.lerp(optimal[interval], optimal[interval + 1], position - float(interval))
                constant[lane] = ab[0]
                slope[lane] = ab[1]
        row[0] = Lane(0.0)
        linear = wp.cw_mul(wp.cw_mul(factor, scale), slope)
        if wp.static(base == "quadratic"):
            multiply(row, row, first, pairs, values, square)
            quadratic = 0.5 * wp.cw_mul(linear, scale)
            for i in range(wp.static(order**2)):
                row[i] = wp.cw_mul(linear, row[i]) + wp.cw_mul(quadratic, square[i])
        else:
            for i in range(wp.static(order**2)):
                row[i] = wp.cw_mul(linear, row[i])
        row[0] = row[0] + UNIT * wp.cw_mul(factor, constant)
        for step in range(most):
            multiply(row, row, first, pairs, values, square)
            is_due = wp.min(wp.max(count - Lane(float(step)), Lane(0.0)), Lane(1.0))  # 1 while step < p
            for i in range(wp.static(order**2)):
                row[i] = row[i] + wp.cw_mul(is_due, square[i] - row[i])
        store_rows(row, group, visibility[batch])

    return exponentiate_log_sh


@functools.cache
def _optimal_table(order: int, device: str) -> wp.array:
    """The best a·1 + b·f̂ for exp(f̂) of one cap's log, over |f̂| (Ren et al. 2006, section 5): [knot] of (a, b)."""
    log = zonal_eigen_log(order, np.cos(np.linspace(1e-3, np.pi / 2, 2000)))
    log[:, 0] = 0
    norm = np.linalg.norm(log, axis=1)
    z, weight = np.polynomial.legendre.leggauss(64)
    basis = sh.zonal_basis(order, z)
    exponential = 2 * np.pi * np.exp(log @ basis.T) * weight @ basis
    a = exponential[:, 0] / np.sqrt(4 * np.pi)
    b = np.sum(exponential * log, axis=1) / norm**2
    rising = np.argmax(norm)
    knots = np.linspace(0, THRESHOLDS["optimal_linear"].limit, _TABLE_SIZE + 1)
    table = np.stack([np.interp(knots, np.r_[0, norm[:rising]], np.r_[1, v[:rising]]) for v in (a, b)], axis=-1)
    return wp.array(table.astype(np.float32), dtype=wp.vec2, device=device)


def exponentiate(log_sh: wp.array, *, base: str = "quadratic", threshold: float | None = None) -> wp.array:
    """Exponentiate log-visibility with the SH product, by scaling and squaring.

        exp*(f) = e^{f0/√4π} exp*(f̂ / 2^p)^{2^p},  p the least with |f̂| / 2^p ≤ threshold
                                                     [Lyu et al. 2021, section 3.3.3; Ren et al. 2006, section 5]

    Args:
        log_sh: Log-visibility f, float32 of shape [batch, vertex, order²], f̂ being f without its constant part.
        base: Approximation of exp*(h) for small h: "quadratic" 1 + h + h²/2, "linear" 1 + h, or "optimal_linear"
            a(|h|) 1 + b(|h|) h with a and b tabulated from caps of all angles.
        threshold: Largest |h|; None for the default of THRESHOLDS[base]. Beyond its limit squaring explodes, so more
            is refused.

    Returns:
        SH visibility, float32 of shape [batch, vertex, order²].

    Raises:
        ValueError: naming the argument, what it got and what it accepts.

    Differentiable: nothing yet.
    """
    check.choice("base", base, THRESHOLDS)
    default, limit = THRESHOLDS[base]
    threshold = default if threshold is None else threshold
    if not 0 < threshold <= limit:
        raise ValueError(
            f"threshold: got {threshold!r} for base {base!r}, expected more than 0 and at most {limit}: "
            "repeated squaring is unstable beyond it"
        )
    order = int(round(np.sqrt(log_sh.shape[2])))
    sh.check_order(order)
    check.shape("log_sh", log_sh.shape, ("batch", "vertex", order**2))
    device = log_sh.device
    lanes = lane_count(device)
    batch_count, vertex_count = log_sh.shape[:2]
    groups = group_count(vertex_count, lanes)
    power, squared = (
        wp.empty((batch_count, groups, order**2), dtype=lane_type(lanes), device=device) for _ in range(2)
    )
    visibility = wp.empty_like(log_sh)
    optimal = _optimal_table(order, str(device)) if base == "optimal_linear" else None
    wp.launch(
        _exponentiate_kernel(order, base, lanes),
        dim=(batch_count, groups),
        inputs=[
            log_sh,
            threshold,
            *sh.product_table(order, str(device), symmetric=True),
            optimal,
            power,
            squared,
        ],
        outputs=[visibility],
        device=device,
    )
    return visibility
