"""The log-visibility of one blocked cap around the z axis, in zonal harmonics, and tables of it for kernels.

`cap` projects the function that is −ε inside the cap and 0 outside (the paper's). `eigen` is the logarithm of the
matrix that multiplies by the cap's visibility (Ren's); where spheres overlap it is several times more accurate.
"""

import functools

import numpy as np
import warp as wp

from warpshadow.device.lanes import lane_type
from warpshadow.maths import sh
from warpshadow.stages.sh_kernels import zonal_type

LOGS = ("eigen", "cap")

CAP_DEPTH = 3.0  # ε of the log `cap`: e^−3 ≈ 0.05 of the light passes a single cap
EIGENVALUE_FLOOR = 0.05  # δ of the log `eigen`: eigenvalues of the product matrix are raised to it before the logarithm

_INTERVALS = 2048


def zonal_cap(order: int, cosine: np.ndarray) -> np.ndarray:
    """Zonal coefficients of the indicator of caps around the z axis, shape [..., order], from cos θ [...]."""
    cosine = np.asarray(cosine, np.float64)
    return (1 - cosine**2)[..., None] * _zonal_cap_per_sine2(order, cosine)


def _zonal_cap_per_sine2(order: int, cosine: np.ndarray) -> np.ndarray:
    """``zonal_cap`` over sin²θ, which has a limit at θ = 0: √π / (1+c), and √(π(2l+1)) / (l(l+1)) P_l'(c)."""
    cosine = np.asarray(cosine, np.float64)[..., None]
    band = np.arange(1, order)
    slopes = [np.polynomial.legendre.legval(cosine, np.polynomial.legendre.legder(np.eye(order)[k])) for k in band]
    higher = np.sqrt(np.pi * (2 * band + 1)) / (band * (band + 1)) * np.concatenate(slopes, axis=-1)
    return np.concatenate([np.sqrt(np.pi) / (1 + cosine), higher], axis=-1)


def zonal_eigen_log(order: int, cosine: np.ndarray) -> np.ndarray:
    """Zonal log-visibility of caps by eigen decomposition (Ren et al. 2006, section 4), shape [..., order].

    M_lk = Σ_j v_j ∫ y_l0 y_j0 y_k0 multiplies with the cap's visibility v; with M = R diag(e) Rᵀ, the result is
    R log(max(e, δ)) Rᵀ applied to the constant 1.
    """
    visibility = -zonal_cap(order, cosine)
    visibility[..., 0] += np.sqrt(4 * np.pi)
    node_cosines, weight = np.polynomial.legendre.leggauss(2 * order)
    basis = sh.zonal_basis(order, node_cosines)
    triple_products = 2 * np.pi * np.einsum("q,ql,qj,qk->ljk", weight, basis, basis, basis)
    eigenvalues, vectors = np.linalg.eigh(np.einsum("...j,ljk->...lk", visibility, triple_products))
    logs = np.log(np.maximum(eigenvalues, EIGENVALUE_FLOOR))
    return np.sqrt(4 * np.pi) * np.einsum("...lj,...j,...j->...l", vectors, logs, vectors[..., 0, :])


def band_type(order: int) -> type:
    """One number for each band."""
    return wp.types.vector(length=order, dtype=wp.float32)


@functools.cache
def zonal_table(order: int, function: str, device: str) -> wp.array:
    """C² cubic splines of z_l / sin²θ over cos θ, [interval, power] of [order], in units of an interval.

    The quotient is smooth down to θ = 0, where the difference P_{l−1} − P_{l+1} of the textbook formula would lose all
    digits, and needs no case of its own.

    Args:
        function: The log, "eigen" or "cap".
    """
    from scipy.interpolate import CubicSpline

    knots = np.linspace(0, 1, _INTERVALS + 1)
    if function == "eigen":
        cosine = np.minimum(knots, 1 - 1e-9)  # the limit of 0/0
        values = zonal_eigen_log(order, cosine) / (1 - cosine**2)[:, None]
    else:
        values = -CAP_DEPTH * _zonal_cap_per_sine2(order, knots)
    powers = CubicSpline(knots, values).c[::-1].transpose(1, 0, 2)
    powers = powers / float(_INTERVALS) ** np.arange(4)[:, None]
    return wp.array(powers.astype(np.float32), dtype=band_type(order), device=device)


@functools.cache
def make_interpolate_zonal(order: int, is_slope: bool, lanes: int) -> wp.Function:
    """Make the kernel function of a table: cos θ → z_l / sin²θ of each lane, or its derivative by cos θ."""
    Lane, Zonal, Band = lane_type(lanes), zonal_type(order, lanes), band_type(order)

    @wp.func
    def interpolate_zonal(cosine: Lane, table: wp.array2d(dtype=Band)):
        zonal = Zonal()
        for lane in range(lanes):
            position = cosine[lane] * float(_INTERVALS)
            interval = wp.min(int(position), _INTERVALS - 1)
            t = position - float(interval)
            if wp.static(is_slope):
                values = 2.0 * table[interval, 2] + (3.0 * t) * table[interval, 3]
                values = float(_INTERVALS) * (table[interval, 1] + t * values)
            else:
                values = table[interval, 2] + t * table[interval, 3]
                values = table[interval, 1] + t * values
                values = table[interval, 0] + t * values
            for band in range(order):
                zonal[band, lane] = values[band]
        return zonal

    return interpolate_zonal
