"""Tail: the light of all further bounces, extrapolated from the computed ones.

Radiosities B_k after k bounces are sums of B_0 and terms D_k = B_k − B_(k−1), each the same linear map T of the one
before. All light past B_0, R = D_1 + T R, is sought among the sums Σ_j c_j D_j, 1 ≤ j ≤ 3, as the one whose error
D_1 + T R − R is orthogonal to these terms, in each color and with areas A as weights [Galerkin; Saad 2003, chapter 5]:

    Σ_j M_ij c_j = <D_i, D_1>,   M_ij = <D_i, D_j − D_(j+1)>,   <u, v> = Σ_p A_p u_p v_p

and T is applied to it once more: B_1 + Σ_j c_j D_(j+1). Sums of three geometric series are exact, such as of light that
a room, a bowl and a gap keep for different times.

- Terms that are nearly multiples of each other: 1e-7 is added to the diagonal of M, with D of length 1, so that the
  smallest c count.
- A closed room of white walls, where the series diverges (<D_1, R> is below 0 or above 50 <D_1, D_1>): terms from D_3
  on count as if each were 0.98 of the one before.

In a room of albedo 0.8 with a window the energy is 0.3% off; by one term in place of three it would be 0.9%, and at an
albedo of 1 8% too low.
"""

from collections.abc import Sequence

import numpy as np
import warp as wp

from warpshadow import check
from warpshadow.device.batch import common_batch, instance_in
from warpshadow.device.constants import constant
from warpshadow.device.launch import launch
from warpshadow.device.memory import empty, zeros

TERM_COUNT = 5  # radiosities from which the tail is found

_MAX_RESIDUAL = wp.constant(wp.float64(50.0))  # length of R in that of D_1, at most
_RIDGE = wp.constant(wp.float64(1.0e-7))  # added to the diagonal of M
_MIN_SQUARE = wp.constant(wp.float64(1.0e-60))  # the least <D, D>: less is darkness


@wp.func
def _bounce_terms(
    batch: int,
    patch: int,
    color: int,
    radiosity_0: wp.array2d(dtype=wp.vec3),
    radiosity_1: wp.array2d(dtype=wp.vec3),
    radiosity_2: wp.array2d(dtype=wp.vec3),
    radiosity_3: wp.array2d(dtype=wp.vec3),
    radiosity_4: wp.array2d(dtype=wp.vec3),
):
    """The terms D_1 to D_4 of a patch, for one color."""
    b0 = wp.float64(radiosity_0[instance_in(batch, radiosity_0.shape[0]), patch][color])
    b1 = wp.float64(radiosity_1[instance_in(batch, radiosity_1.shape[0]), patch][color])
    b2 = wp.float64(radiosity_2[instance_in(batch, radiosity_2.shape[0]), patch][color])
    b3 = wp.float64(radiosity_3[instance_in(batch, radiosity_3.shape[0]), patch][color])
    b4 = wp.float64(radiosity_4[instance_in(batch, radiosity_4.shape[0]), patch][color])
    return wp.vec4d(b1 - b0, b2 - b1, b3 - b2, b4 - b3)


@wp.kernel
def _sum_products(
    # in
    radiosity_0: wp.array2d(dtype=wp.vec3),
    radiosity_1: wp.array2d(dtype=wp.vec3),
    radiosity_2: wp.array2d(dtype=wp.vec3),
    radiosity_3: wp.array2d(dtype=wp.vec3),
    radiosity_4: wp.array2d(dtype=wp.vec3),
    areas: wp.array(dtype=wp.float32),
    # out
    products: wp.array3d(dtype=wp.vec4d),
):
    """A thread owns a patch of an instance in a color, and adds to <D_i, D_j>, i ≤ 3."""
    batch, patch, color = wp.tid()
    terms = _bounce_terms(batch, patch, color, radiosity_0, radiosity_1, radiosity_2, radiosity_3, radiosity_4)
    weighted_terms = wp.float64(areas[patch]) * terms
    wp.atomic_add(products, batch, color, 0, weighted_terms[0] * terms)
    wp.atomic_add(products, batch, color, 1, weighted_terms[1] * terms)
    wp.atomic_add(products, batch, color, 2, weighted_terms[2] * terms)


@wp.kernel
def _solve(
    # in
    products: wp.array3d(dtype=wp.vec4d),
    # out
    coefficients: wp.array2d(dtype=wp.vec3d),
):
    """A thread owns a color of an instance."""
    batch, color = wp.tid()
    row_0 = products[batch, color, 0]
    row_1 = products[batch, color, 1]
    row_2 = products[batch, color, 2]
    one = wp.float64(1.0)
    inverse_norm_0 = one / wp.sqrt(wp.max(row_0[0], _MIN_SQUARE))
    inverse_norm_1 = one / wp.sqrt(wp.max(row_1[1], _MIN_SQUARE))
    inverse_norm_2 = one / wp.sqrt(wp.max(row_2[2], _MIN_SQUARE))
    matrix = wp.mat33d(
        inverse_norm_0 * inverse_norm_0 * (row_0[0] - row_0[1]) + _RIDGE,
        inverse_norm_0 * inverse_norm_1 * (row_0[1] - row_0[2]),
        inverse_norm_0 * inverse_norm_2 * (row_0[2] - row_0[3]),
        inverse_norm_1 * inverse_norm_0 * (row_1[0] - row_1[1]),
        inverse_norm_1 * inverse_norm_1 * (row_1[1] - row_1[2]) + _RIDGE,
        inverse_norm_1 * inverse_norm_2 * (row_1[2] - row_1[3]),
        inverse_norm_2 * inverse_norm_0 * (row_2[0] - row_2[1]),
        inverse_norm_2 * inverse_norm_1 * (row_2[1] - row_2[2]),
        inverse_norm_2 * inverse_norm_2 * (row_2[2] - row_2[3]) + _RIDGE,
    )
    solution = wp.inverse(matrix) * wp.vec3d(
        inverse_norm_0 * row_0[0], inverse_norm_1 * row_1[0], inverse_norm_2 * row_2[0]
    )
    solution = wp.vec3d(inverse_norm_0 * solution[0], inverse_norm_1 * solution[1], inverse_norm_2 * solution[2])
    residual_product = solution[0] * row_0[0] + solution[1] * row_0[1] + solution[2] * row_0[2]
    if residual_product >= wp.float64(0.0) and residual_product <= _MAX_RESIDUAL * row_0[0]:
        coefficients[batch, color] = solution
    else:
        coefficients[batch, color] = wp.vec3d(one, one, _MAX_RESIDUAL)


@wp.func
def _tail_of_color(terms: wp.vec4d, coefficients: wp.vec3d):
    """Extrapolated rest Σ c_j D_(j+1) of the series of a color."""
    return wp.float32(coefficients[0] * terms[1] + coefficients[1] * terms[2] + coefficients[2] * terms[3])


@wp.kernel
def _add_tail(
    # in
    radiosity_0: wp.array2d(dtype=wp.vec3),
    radiosity_1: wp.array2d(dtype=wp.vec3),
    radiosity_2: wp.array2d(dtype=wp.vec3),
    radiosity_3: wp.array2d(dtype=wp.vec3),
    radiosity_4: wp.array2d(dtype=wp.vec3),
    coefficients: wp.array2d(dtype=wp.vec3d),
    # out
    total: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a patch of an instance."""
    batch, patch = wp.tid()
    red = _tail_of_color(
        _bounce_terms(batch, patch, 0, radiosity_0, radiosity_1, radiosity_2, radiosity_3, radiosity_4),
        coefficients[batch, 0],
    )
    green = _tail_of_color(
        _bounce_terms(batch, patch, 1, radiosity_0, radiosity_1, radiosity_2, radiosity_3, radiosity_4),
        coefficients[batch, 1],
    )
    blue = _tail_of_color(
        _bounce_terms(batch, patch, 2, radiosity_0, radiosity_1, radiosity_2, radiosity_3, radiosity_4),
        coefficients[batch, 2],
    )
    total[batch, patch] = radiosity_1[instance_in(batch, radiosity_1.shape[0]), patch] + wp.vec3(red, green, blue)


def add_tail(radiosities: Sequence[wp.array], areas: np.ndarray) -> wp.array:
    """Radiosity of patches after all bounces, extrapolated from the radiosities after the first bounces.

    Args:
        radiosities: By direct light, and after one to four bounces, vec3 of shape [batch, patch]; a batch of 1
            serves every instance.
        areas: Of patches [scene units²], not negative, shape [patch].
    Returns:
        vec3 of shape [batch, patch].
    Differentiable: radiosities.
    """
    if len(radiosities) != TERM_COUNT:
        raise ValueError(f"radiosities: got {len(radiosities)}, expected {TERM_COUNT}")
    patch_count = radiosities[0].shape[1]
    for array in radiosities:
        check.shape("radiosities", array.shape, ("batch", patch_count))
    check.shape("areas", areas.shape, (patch_count,))
    check.finite("areas", np.asarray(areas), minimum=0.0)
    batch_count = common_batch({f"radiosity after {number} bounces": array for number, array in enumerate(radiosities)})
    device = radiosities[0].device
    area_shares = constant(np.asarray(areas / max(areas.sum(), 1e-30), np.float32), wp.float32, device)
    products = zeros((batch_count, 3, 3), dtype=wp.vec4d, device=device)
    coefficients = empty((batch_count, 3), dtype=wp.vec3d, device=device)
    total = empty((batch_count, patch_count), dtype=wp.vec3, device=device)
    launch(_sum_products, (batch_count, patch_count, 3), inputs=[*radiosities, area_shares], outputs=[products])
    launch(_solve, (batch_count, 3), inputs=[products], outputs=[coefficients])
    launch(_add_tail, total.shape, inputs=[*radiosities, coefficients], outputs=[total])
    return total
