"""Spherical harmonics: against SciPy, quadrature and their algebra; and the kernel functions against NumPy."""

import functools

import numpy as np
import pytest
import twins
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import roots_legendre

from warpshadow.device.lanes import lane_type, make_lane_functions, module_options
from warpshadow.maths import sh
from warpshadow.stages import sh_kernels

# Float64 recurrences and quadratures of low degree: a few hundred roundings.
EXACT = 1e-12
# Kernels sum up to 10² float32 terms of size 1, each good to 6e-8.
FLOAT32 = 5e-6
# Pixels of 64 rows have the value of their centers; error falls with their square, (π/64)²/24 · band²; measured 3.5e-3.
MAP_64 = 5e-3

ORDERS = list(sh.ORDERS)


def unit_vectors(seed, count):
    vectors = np.random.default_rng(seed).normal(size=(count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


# ------------------------------------------------------------------------------------------ evaluation


def test_orders_are_two_to_eight():
    assert ORDERS == [2, 3, 4, 5, 6, 7, 8]
    assert list(sh.ORDERS) == ORDERS


@pytest.mark.parametrize("order", [1, *ORDERS, 12])
def test_the_basis_is_scipys_without_condon_shortley_phase(order):
    directions = np.concatenate([unit_vectors(0, 200), np.eye(3), -np.eye(3)])
    assert np.abs(sh.evaluate(order, directions) - twins.harmonics(order, directions)).max() < EXACT


def test_band_one_is_y_z_x():
    directions = unit_vectors(1, 50)
    expected = np.sqrt(3 / (4 * np.pi)) * directions[:, [1, 2, 0]]
    np.testing.assert_allclose(sh.evaluate(2, directions)[:, 1:], expected, atol=EXACT)


@pytest.mark.parametrize("order", ORDERS)
def test_the_basis_is_orthonormal(order):
    directions, weights = twins.sphere_quadrature(order)
    basis = sh.evaluate(order, directions)
    assert np.abs((basis * weights[:, None]).T @ basis - np.eye(order**2)).max() < EXACT


def test_evaluate_keeps_leading_dimensions():
    directions = unit_vectors(2, 24).reshape(2, 3, 4, 3)
    values = sh.evaluate(3, directions)
    assert values.shape == (2, 3, 4, 9)
    np.testing.assert_array_equal(values.reshape(-1, 9), sh.evaluate(3, directions.reshape(-1, 3)))


def test_band_of_gives_l_of_each_coefficient():
    np.testing.assert_array_equal(sh.band_of(4), [0] + [1] * 3 + [2] * 5 + [3] * 7)


def test_zonal_basis_is_the_m_zero_part_of_the_basis():
    z = np.linspace(-1, 1, 21)
    directions = np.stack([np.sqrt(1 - z**2), 0 * z, z], axis=-1)
    at_zero = [band**2 + band for band in range(8)]
    np.testing.assert_allclose(sh.zonal_basis(8, z), sh.evaluate(8, directions)[:, at_zero], atol=EXACT)


@pytest.mark.parametrize("order", [0, 1, 9, 2.5, "8", None])
def test_an_order_without_kernels_is_refused_by_name(order):
    with pytest.raises(ValueError, match=r"order: got .*, expected a number of bands from 2 to 8"):
        sh.check_order(order)


# ------------------------------------------------------------------------------------------ projection


@pytest.mark.parametrize("degree", [0, 1, 6, 21, 22])
def test_the_quadrature_is_exact_up_to_its_degree(degree):
    directions, weights = sh.quadrature(degree)
    integrals = weights @ twins.harmonics(degree + 1, directions)
    expected = np.zeros_like(integrals)
    expected[0] = twins.UNIT
    assert np.abs(integrals - expected).max() < EXACT


def test_projecting_an_expansion_gives_its_coefficients_back():
    coefficients = np.random.default_rng(3).normal(size=(64, 2))
    directions, weights = sh.quadrature(14)
    projected = (sh.evaluate(8, directions) * weights[:, None]).T @ twins.harmonics(8, directions) @ coefficients
    assert np.abs(projected - coefficients).max() < EXACT


def test_map_directions_follow_the_stated_convention():
    height = 6
    row, column = np.mgrid[:height, : 2 * height]
    theta, phi = np.pi * (row + 0.5) / height, 2 * np.pi * (column + 0.5) / (2 * height)
    expected = [np.sin(phi) * np.sin(theta), np.cos(theta), -np.cos(phi) * np.sin(theta)]
    np.testing.assert_allclose(sh.equirectangular_directions(height), np.stack(expected, -1), atol=EXACT)


@pytest.mark.parametrize("height", [1, 2, 7, 256])
def test_pixel_solid_angles_of_a_map_sum_to_the_sphere(height):
    assert abs(sh.pixel_solid_angles(height).sum() * 2 * height - 4 * np.pi) < EXACT


@pytest.mark.parametrize("height", [1, 2, 3, 8, 64])
def test_a_constant_map_of_any_height_projects_to_the_constant_function(height):
    coefficients = sh.project_map(np.full((height, 2 * height, 3), 2.0, np.float32), 8)
    np.testing.assert_allclose(coefficients[0], 2 * twins.UNIT, rtol=EXACT)
    assert np.abs(coefficients[1:]).max() < EXACT


@pytest.mark.slow
@pytest.mark.parametrize(("height", "order"), [(1, 1), (1, 12), (2, 2), (2, 8), (3, 12), (5, 8)])
def test_a_map_projects_to_the_integral_over_what_its_pixels_cover(height, order):
    """Pixel by pixel with SciPy's harmonics, each in 60 × 60 directions of a Gauss–Legendre rule."""
    pixels = np.random.default_rng(height).normal(size=(height, 2 * height, 2))
    node, weight = roots_legendre(60)
    expected = np.zeros((order**2, 2))
    for row, col in np.ndindex(height, 2 * height):
        theta = np.pi * (row + (node[:, None] + 1) / 2) / height
        phi = np.pi * (col + (node + 1) / 2) / height
        ring, up = np.broadcast_arrays(np.sin(theta), np.cos(theta) + 0 * phi)
        towards = np.stack([np.sin(phi) * ring, up, -np.cos(phi) * ring], axis=-1)
        over = (np.pi / (2 * height)) ** 2 * weight[:, None] * weight * ring
        expected += np.einsum("rc,rck->k", over, twins.harmonics(order, towards))[:, None] * pixels[row, col]
    assert np.abs(sh.project_map(pixels, order) - expected).max() < EXACT


def test_a_reconstructed_map_projects_back_to_its_coefficients():
    coefficients = np.random.default_rng(4).normal(size=(25, 3))
    pixels = sh.reconstruct_map(coefficients, 64)
    expected = twins.harmonics(5, sh.equirectangular_directions(64)) @ coefficients
    assert np.abs(pixels - expected).max() < EXACT
    assert np.abs(sh.project_map(pixels, 5) - coefficients).max() < MAP_64


def test_a_map_that_is_not_twice_as_wide_is_refused():
    with pytest.raises(ValueError, match=r"pixels: got shape \(4, 9, 3\), expected \[4, 8, channel\]"):
        sh.project_map(np.zeros((4, 9, 3)), 2)


@pytest.mark.parametrize("count", [0, 2, 63])
def test_coefficients_that_fill_no_order_are_refused(count):
    with pytest.raises(ValueError, match=rf"light: got {count} coefficients, expected a square number"):
        sh.order_of("light", np.zeros((count, 3)))


@pytest.mark.parametrize("order", ORDERS)
def test_the_clamped_cosine_is_the_numeric_projection_of_max_z_0(order):
    node, weight = np.polynomial.legendre.leggauss(50)
    z = (node + 1) / 2
    expected = np.pi * (weight * z) @ twins.zonal_values(order, z)
    assert np.abs(sh.clamped_cosine(order) - expected).max() < EXACT
    assert np.abs(sh.clamped_cosine(order)[3::2]).max(initial=0) < EXACT


# ------------------------------------------------------------------------------------------ rotation

seeds = st.integers(0, 2**32 - 1)


@settings(max_examples=15, deadline=None)
@given(seed=seeds, order=st.sampled_from(ORDERS))
def test_rotating_coefficients_rotates_the_function(seed, order):
    rotation = twins.random_rotation(seed)
    coefficients = np.random.default_rng(seed).normal(size=order**2)
    directions = unit_vectors(seed, 30)
    turned = sh.harmonic_rotation(order, rotation) @ coefficients
    difference = (
        twins.harmonics(order, directions @ rotation.T) @ turned - twins.harmonics(order, directions) @ coefficients
    )
    assert np.abs(difference).max() < 100 * EXACT  # sums of 64 terms of size up to 10


@settings(max_examples=15, deadline=None)
@given(seed=seeds, order=st.sampled_from(ORDERS))
def test_rotation_matrices_are_orthogonal_block_diagonal_and_compose(seed, order):
    first, second = twins.random_rotation(seed), twins.random_rotation(seed + 1)
    matrix = sh.harmonic_rotation(order, first)
    band = sh.band_of(order)
    assert np.abs(matrix @ matrix.T - np.eye(order**2)).max() < EXACT
    assert np.abs(matrix[band[:, None] != band]).max() < EXACT
    both = sh.harmonic_rotation(order, second @ first)
    assert np.abs(sh.harmonic_rotation(order, second) @ matrix - both).max() < EXACT


@settings(max_examples=15, deadline=None)
@given(seed=seeds, order=st.sampled_from(ORDERS))
def test_turning_a_zonal_vector_is_the_full_rotation_of_it(seed, order):
    rotation = twins.random_rotation(seed)
    zonal = np.random.default_rng(seed).normal(size=order)
    upright = np.zeros(order**2)
    upright[[band**2 + band for band in range(order)]] = zonal
    expected = sh.harmonic_rotation(order, rotation) @ upright
    assert np.abs(twins.turned(zonal, rotation[:, 2]) - expected).max() < 10 * EXACT


# ------------------------------------------------------------------------------------------ products


@pytest.mark.parametrize("order, count", [(4, 353), (5, 1158), (6, 2907), (7, 6460), (8, 12868)])
def test_triple_products_are_as_many_as_published(order, count):
    assert len(sh.triple_products(order).value) == count


def test_a_square_of_order_eight_takes_6588_multiply_adds():
    assert len(sh.triple_products(8, symmetric=True).value) == 6588
    i, j = sh.triple_products(8, symmetric=True)[1:3]
    assert (i <= j).all()


def test_2300_unordered_triples_of_order_eight_are_not_zero():
    first, i, j, _ = sh.triple_products(8)
    k = np.repeat(np.arange(64), np.diff(first))
    assert len(np.unique(np.sort(np.stack([i, j, k]), axis=0), axis=1).T) == 2300


def sparse_product(table, a, b):
    return np.array(
        [(table.value[s] * a[table.i[s]] * b[table.j[s]]).sum() for s in map(slice, table.first, table.first[1:])]
    )


@pytest.mark.parametrize("order", ORDERS)
def test_every_form_of_the_product_is_the_projection_of_the_pointwise_product(order):
    a, b = np.random.default_rng(order).normal(size=(2, order**2))
    expected = twins.Product(order)(a, b)
    scale = 10 * EXACT  # products of 64 terms of size 1
    assert np.abs(np.einsum("i,j,ijk", a, b, sh.triple_product_tensor(order)) - expected).max() < scale
    assert np.abs(sparse_product(sh.triple_products(order), a, b) - expected).max() < scale
    squared = sparse_product(sh.triple_products(order, symmetric=True), a, a)
    assert np.abs(squared - twins.Product(order)(a, a)).max() < scale


def test_triple_products_are_symmetric_in_all_three():
    tensor = sh.triple_product_tensor(8)
    for axes in ((1, 0, 2), (0, 2, 1)):
        assert np.abs(tensor - tensor.transpose(axes)).max() < EXACT


def test_bands_left_out_of_the_second_factor_are_as_if_zero():
    a, b = np.random.default_rng(7).normal(size=(2, 64))
    kept = np.isin(sh.band_of(8), (0, 1, 2, 4))
    table = sh.triple_products(8, bands_of_j=(0, 1, 2, 4))
    assert np.abs(sparse_product(table, a, b) - twins.Product(8)(a, b * kept)).max() < 10 * EXACT
    assert kept[table.j].all()


# ------------------------------------------------------------------------------------------ in kernels


@functools.cache
def turn_and_multiply_kernel(order, lanes):
    Lane, Zonal = lane_type(lanes), sh_kernels.zonal_type(order, lanes)
    fn = make_lane_functions(lanes)
    load, load_rows, store_rows = fn.load, fn.load_rows, fn.store_rows
    add_rotated_zonal, multiply = (
        sh_kernels.make_add_rotated_zonal(order, lanes),
        sh_kernels.make_multiply(order, lanes),
    )

    @wp.kernel(module="unique", module_options=module_options(lanes), enable_backward=False)
    def turn_and_multiply(
        # in
        zonals: wp.array2d(dtype=wp.float32),
        directions: wp.array(dtype=wp.vec3),
        factors: wp.array2d(dtype=wp.float32),
        table: sh_kernels.ProductTable,
        # scratch
        scratch: wp.array3d(dtype=Lane),
        # out
        turned: wp.array2d(dtype=wp.float32),
        product: wp.array2d(dtype=wp.float32),
    ):
        """A thread owns a group of rows."""
        group = wp.tid()
        zonal_rows = scratch[group, 0]
        turned_rows = scratch[group, 1]
        factor_rows = scratch[group, 2]
        product_rows = scratch[group, 3]
        load_rows(zonals, group, zonal_rows)
        load_rows(factors, group, factor_rows)
        zonal = Zonal()
        for band in range(order):
            zonal[band] = zonal_rows[band]
        load_rows(factors, group, turned_rows)  # to be added to
        add_rotated_zonal(load(directions, group), zonal, turned_rows)
        store_rows(turned_rows, group, turned)
        multiply(turned_rows, factor_rows, table, product_rows)
        store_rows(product_rows, group, product)

    return turn_and_multiply


@pytest.mark.parametrize("order, lanes", [(2, 16), (5, 16), (8, 16), (5, 1)])
def test_kernel_functions_turn_add_and_multiply_like_numpy(order, lanes, device):
    count = 37  # no multiple of 16: the last group repeats its last row
    rng = np.random.default_rng(order)
    zonals, directions = rng.normal(size=(count, order)).astype(np.float32), unit_vectors(order, count)
    factors = rng.normal(size=(count, order**2)).astype(np.float32)
    groups = -(-count // lanes)
    turned, product = (wp.full((count, order**2), np.nan, dtype=wp.float32, device=device) for _ in range(2))
    wp.launch(
        turn_and_multiply_kernel(order, lanes),
        dim=groups,
        inputs=[
            wp.array(zonals, device=device),
            wp.array(directions, dtype=wp.vec3, device=device),
            wp.array(factors, device=device),
            sh_kernels.product_table(order, device),
            wp.empty((groups, 4, order**2), dtype=lane_type(lanes), device=device),
        ],
        outputs=[turned, product],
        device=device,
    )
    expected = factors + twins.turned(zonals.astype(np.float64), directions)
    assert np.abs(turned.numpy() - expected).max() < FLOAT32
    expected = twins.Product(order)(expected, factors)
    assert np.abs(product.numpy() - expected).max() < FLOAT32 * np.abs(expected).max()
