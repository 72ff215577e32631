"""Spherical harmonics in kernels: rotated zonal vectors and products, on lanes of float32 (see lanes.py)."""

import functools

import numpy as np
import warp as wp

from warpshadow.device.lanes import lane_type, vectors_type
from warpshadow.maths.sh import schmidt_recurrence, triple_products

PRODUCT_COST = 0.1  # nanoseconds that a product takes for a receiver and a pair of coefficients


@functools.cache
def zonal_type(order: int, lanes: int) -> type:
    """Zonal coefficients of a thread's receivers, [order, lanes]."""
    return wp.types.matrix(shape=(order, lanes), dtype=wp.float32)


@functools.cache
def _make_recurrence(order: int) -> tuple[wp.Function, wp.Function, wp.Function]:
    """:func:`warpshadow.maths.sh.schmidt_recurrence` as kernel functions: diagonal(m), up(band, m), back(band, m).

    The values stand in read-only memory: as a matrix that a kernel closes over, each thread of a GPU would copy them
    to its stack.
    """

    def values(table: np.ndarray) -> str:
        return f"static const float values[] = {{{', '.join(f'{float(np.float32(x))!r}f' for x in table.ravel())}}};"

    diagonal_code, up_code, back_code = map(values, schmidt_recurrence(order))

    @wp.func_native(f"{diagonal_code} return values[m];")
    def diagonal(m: int) -> float: ...  # type: ignore[empty-body]

    @wp.func_native(f"{up_code} return values[{order} * band + m];")
    def up(band: int, m: int) -> float: ...  # type: ignore[empty-body]

    @wp.func_native(f"{back_code} return values[{order} * band + m];")
    def back(band: int, m: int) -> float: ...  # type: ignore[empty-body]

    return diagonal, up, back


@functools.cache
def make_add_rotated_zonal(order: int, lanes: int) -> wp.Function:
    """Make the kernel function that turns lanes of zonal vectors to lanes of directions and adds them up."""
    Lane, Vectors, Zonal = lane_type(lanes), vectors_type(lanes), zonal_type(order, lanes)
    diagonal, up, back = _make_recurrence(order)

    @wp.func
    def add_rotated_zonal(direction: Vectors, zonal: Zonal, coefficients: wp.array(dtype=Lane)):
        """coefficients[l² + l + m] += √(4π/(2l+1)) z_l y_lm(direction)."""
        cosine = Lane(1.0)
        sine = Lane(0.0)
        for m in range(order):
            previous = Lane(0.0)
            legendre = Lane(diagonal(m))
            for band in range(m, order):
                weight = wp.cw_mul(zonal[band], legendre)
                center = band * band + band
                coefficients[center + m] = coefficients[center + m] + wp.cw_mul(weight, cosine)
                if m > 0:
                    coefficients[center - m] = coefficients[center - m] + wp.cw_mul(weight, sine)
                next_legendre = up(band, m) * wp.cw_mul(direction.z, legendre) - back(band, m) * previous
                previous = legendre
                legendre = next_legendre
            next_cosine = wp.cw_mul(cosine, direction.x) - wp.cw_mul(sine, direction.y)
            sine = wp.cw_mul(cosine, direction.y) + wp.cw_mul(sine, direction.x)
            cosine = next_cosine

    return add_rotated_zonal


@functools.cache
def make_rotated_zonal_adjoint(order: int, lanes: int) -> wp.Function:
    """Make the adjoint of :func:`make_add_rotated_zonal`'s function: returns the adjoints of direction and zonal.

    With S = √(4π/(2l+1)) y and s_lm = L_lm(z) (cos_m, sin_m), z̄_l = Σ_m f̄ s and ∂s/∂z = L', and since cos_m + i sin_m
    = (x + iy)^m:  ∂cos_m/∂x = m cos_{m−1}, ∂cos_m/∂y = −m sin_{m−1}, ∂sin_m/∂x = m sin_{m−1}, ∂sin_m/∂y = m cos_{m−1}.
    """
    Lane, Vectors, Zonal = lane_type(lanes), vectors_type(lanes), zonal_type(order, lanes)
    diagonal, up, back = _make_recurrence(order)

    @wp.func
    def adjoint(direction: Vectors, zonal: Zonal, adj_coefficients: wp.array(dtype=Lane)):
        adj_zonal = Zonal()
        adj_x = Lane(0.0)
        adj_y = Lane(0.0)
        adj_z = Lane(0.0)
        cosine = Lane(1.0)
        sine = Lane(0.0)
        cosine_below = Lane(0.0)
        sine_below = Lane(0.0)
        for m in range(order):
            previous = Lane(0.0)
            slope_previous = Lane(0.0)
            legendre = Lane(diagonal(m))
            slope = Lane(0.0)
            for band in range(m, order):
                center = band * band + band
                even_coefficient = adj_coefficients[center + m]
                odd_coefficient = Lane(0.0)
                if m > 0:
                    odd_coefficient = adj_coefficients[center - m]
                adj_m = wp.cw_mul(even_coefficient, cosine) + wp.cw_mul(odd_coefficient, sine)
                adj_zonal[band] = adj_zonal[band] + wp.cw_mul(legendre, adj_m)
                adj_z += wp.cw_mul(zonal[band], wp.cw_mul(slope, adj_m))
                weight = float(m) * wp.cw_mul(zonal[band], legendre)
                adj_x += wp.cw_mul(
                    weight, wp.cw_mul(even_coefficient, cosine_below) + wp.cw_mul(odd_coefficient, sine_below)
                )
                adj_y += wp.cw_mul(
                    weight, wp.cw_mul(odd_coefficient, cosine_below) - wp.cw_mul(even_coefficient, sine_below)
                )
                next_legendre = up(band, m) * wp.cw_mul(direction.z, legendre) - back(band, m) * previous
                slope_above = up(band, m) * (legendre + wp.cw_mul(direction.z, slope)) - back(band, m) * slope_previous
                previous = legendre
                legendre = next_legendre
                slope_previous = slope
                slope = slope_above
            cosine_below = cosine
            sine_below = sine
            next_cosine = wp.cw_mul(cosine, direction.x) - wp.cw_mul(sine, direction.y)
            sine = wp.cw_mul(cosine, direction.y) + wp.cw_mul(sine, direction.x)
            cosine = next_cosine
        return Vectors(adj_x, adj_y, adj_z), adj_zonal

    return adjoint


@wp.struct
class ProductTable:
    """Triple products: pairs (i, j) and values, entries of k at first[k] … first[k+1]."""

    first: wp.array(dtype=wp.int32)
    pairs: wp.array(dtype=wp.vec2i)
    values: wp.array(dtype=wp.float32)


@functools.cache
def product_table(
    order: int,
    device: str,
    bands_of_j: tuple[int, ...] | None = None,
    bands_of_k: int | None = None,
    symmetric: bool = False,
) -> ProductTable:
    """Copy :func:`triple_products` to a device, entries with k in the first ``bands_of_k`` bands, all by default."""
    first, i, j, value = triple_products(order, bands_of_j, symmetric)
    table = ProductTable()
    table.first = wp.array(np.minimum(first, first[(bands_of_k or order) ** 2]).astype(np.int32), device=device)
    table.pairs = wp.array(np.stack([i, j], axis=-1).astype(np.int32), dtype=wp.vec2i, device=device)
    table.values = wp.array(value.astype(np.float32), device=device)
    return table


@functools.cache
def make_multiply(order: int, lanes: int) -> wp.Function:
    """Make the kernel function product_k = Σ Γ_ijk a_i b_j of lanes of expansions; product must be neither factor.

    Native, since plain Warp neither keeps the sum in a register nor fuses multiplication and addition: 10 327 squares
    of order 8 take 3.8 ms, in plain Warp 10.3 ms.
    """
    Lane = lane_type(lanes)
    snippet = f"""
    const wp::float32 *a_lanes = (const wp::float32 *)a.data, *b_lanes = (const wp::float32 *)b.data;
    wp::float32 *product_lanes = (wp::float32 *)product.data;
    for (int k = 0; k < {order**2}; ++k) {{
        wp::float32 total[{lanes}] = {{}};
        for (int t = table.first.data[k]; t < table.first.data[k + 1]; ++t) {{
            const wp::float32 *a_i = a_lanes + {lanes} * table.pairs.data[t][0];
            const wp::float32 *b_j = b_lanes + {lanes} * table.pairs.data[t][1];
            for (int lane = 0; lane < {lanes}; ++lane)
                total[lane] += table.values.data[t] * a_i[lane] * b_j[lane];
        }}
        for (int lane = 0; lane < {lanes}; ++lane)
            product_lanes[{lanes} * k + lane] = total[lane];
    }}
    """

    @wp.func_native(snippet)
    def multiply(
        a: wp.array(dtype=Lane), b: wp.array(dtype=Lane), table: ProductTable, product: wp.array(dtype=Lane)
    ): ...

    return multiply
