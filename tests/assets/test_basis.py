"""What light is expressed in: harmonics or cells, and what their coefficients mean."""

import numpy as np
import pytest
import twins
import warp as wp

import warpshadow as ws
from warpshadow.assets.basis import CellBasis, HarmonicBasis, check_basis
from warpshadow.assets.light import EnvironmentMap
from warpshadow.assets.sky import synthetic_sky
from warpshadow.maths import directions as cells
from warpshadow.maths.sh import equirectangular_directions

# Coefficients are float32 of numbers up to 10.
FLOAT32 = 5e-6


def unit_vectors(count):
    vectors = np.random.default_rng(0).normal(size=(count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def test_harmonics_are_as_many_as_the_order_squared_and_scipys():
    basis = HarmonicBasis(5)
    directions = unit_vectors(20)
    assert basis.size == 25
    assert np.abs(basis.functions(directions) - twins.harmonics(5, directions)).max() < 1e-12


@pytest.mark.parametrize("order", [2, 4, 7])
def test_harmonic_light_of_another_order_is_cut_off_or_filled_with_zeros(order):
    light = np.random.default_rng(1).normal(size=(order**2, 3))
    coefficients = HarmonicBasis(4).coefficients(light)
    assert coefficients.shape == (16, 3) and coefficients.dtype == np.float32
    count = min(16, order**2)
    np.testing.assert_array_equal(coefficients[:count], light[:count].astype(np.float32))
    assert not coefficients[count:].any()


def test_a_map_in_harmonics_is_its_projection():
    light = EnvironmentMap(np.random.default_rng(2).uniform(size=(32, 64, 3)).astype(np.float32))
    np.testing.assert_array_equal(HarmonicBasis(3).coefficients(light), light.sh(3))


def test_a_direction_belongs_to_its_nearest_cell_alone():
    directions = cells.fibonacci(64)
    basis = CellBasis(directions)
    assert basis.size == 64
    np.testing.assert_array_equal(basis.functions(directions), np.eye(64))
    elsewhere = unit_vectors(500)
    functions = basis.functions(elsewhere)
    assert (functions.sum(axis=1) == 1).all()
    nearest = np.linalg.norm(elsewhere[:, None] - directions, axis=-1).argmin(axis=1)
    np.testing.assert_array_equal(functions.argmax(axis=1), nearest)


def test_harmonic_light_in_cells_is_its_value_at_their_directions():
    light = np.random.default_rng(3).normal(size=(16, 3))
    directions = cells.fibonacci(64)
    coefficients = CellBasis(directions).coefficients(light)
    assert coefficients.dtype == np.float32
    assert np.abs(coefficients - twins.harmonics(4, directions) @ light).max() < FLOAT32


def test_a_constant_map_in_cells_keeps_its_energy_and_nearly_its_radiance():
    """A cell gets all light that is nearest to it over 4π/Q; the true cells of Fibonacci directions differ by 6%."""
    light = EnvironmentMap(np.full((32, 64, 3), 0.7, np.float32))
    coefficients = CellBasis(cells.fibonacci(64)).coefficients(light)
    np.testing.assert_allclose(coefficients.mean(axis=0), 0.7, rtol=FLOAT32)
    assert np.abs(coefficients / 0.7 - 1).max() < 0.1


def test_light_that_fills_no_order_is_refused_in_cells():
    with pytest.raises(ValueError, match="light: got 15 coefficients, expected a square number"):
        CellBasis(cells.fibonacci(16)).coefficients(np.zeros((15, 3)))


@pytest.mark.parametrize("count", [15, 17])
def test_light_that_fills_no_order_is_refused_in_harmonics(count):
    with pytest.raises(ValueError, match=f"light: got {count} coefficients, expected a square number"):
        HarmonicBasis(4).coefficients(np.zeros((count, 3)))


@pytest.mark.parametrize("directions", [128, None, np.zeros((16, 3)), np.ones((16, 2)), np.zeros((0, 3))])
def test_cells_are_around_unit_vectors(directions):
    with pytest.raises(ValueError, match=r"^directions: got .*fibonacci\(128\)"):
        CellBasis(directions)


@pytest.mark.parametrize("order", [1, 9, 5.0, True, "5"])
def test_harmonics_have_an_order_that_the_kernels_are_made_for(order):
    with pytest.raises(ValueError, match=f"^order: got {order!r}"):
        HarmonicBasis(order)


@pytest.mark.parametrize(
    ("basis", "remedy"), [(5, r"HarmonicBasis\(5\)"), ("sh", "CellBasis"), (HarmonicBasis, "the class HarmonicBasis")]
)
def test_what_is_no_basis_is_refused_with_how_to_make_one(basis, remedy):
    check_basis(None)
    check_basis(HarmonicBasis(5))
    with pytest.raises(ValueError, match=f"^basis: got .*{remedy}"):
        check_basis(basis)


@pytest.mark.parametrize("basis", [HarmonicBasis(3), CellBasis(cells.fibonacci(32))])
def test_coefficients_are_the_callers_own(basis):
    """What maps keep of their light is not to be written to, as an optimizer does to its start."""
    light = synthetic_sky(height=16)
    coefficients = basis.coefficients(light)
    expected = coefficients.copy()
    coefficients[:] = 0
    np.testing.assert_array_equal(basis.coefficients(light), expected)


# ------------------------------------------------------------------------------------------------ maps of coefficients


@pytest.mark.parametrize("count", [16, 128, 512])
def test_cells_keep_their_energy_in_a_map(count):
    basis = CellBasis(cells.fibonacci(count))
    light = np.random.default_rng(4).uniform(0.1, 10, (count, 3))
    np.testing.assert_allclose(basis.coefficients(basis.to_map(light)), light, rtol=FLOAT32)


@pytest.mark.parametrize("order", [2, 5, 8])
def test_harmonics_that_are_nowhere_negative_are_in_a_map_what_they_were(order):
    basis = HarmonicBasis(order)
    light = np.random.default_rng(5).normal(size=(order**2, 3))
    light /= np.linalg.norm(light)
    light[0] = np.sqrt(4 * np.pi) * order
    found = basis.coefficients(basis.to_map(light))
    assert np.linalg.norm((found - light)[1:]) < 5e-3 * np.linalg.norm(light[1:])  # pixels of 1/64 of a half turn
    assert np.abs(found[0] / light[0] - 1).max() < 1e-4


@pytest.mark.parametrize("basis", [HarmonicBasis(3), CellBasis(cells.fibonacci(16))])
def test_negative_radiance_is_none_in_a_map(basis):
    light = np.random.default_rng(6).normal(size=(basis.size, 3))
    radiance = basis.to_map(light).radiance
    assert radiance.min() == 0 and radiance.max() > 0
    directions = equirectangular_directions(len(radiance))
    values = np.stack([basis.functions(row) @ light for row in directions])
    np.testing.assert_array_equal(radiance > 0, values > 0)


@pytest.mark.parametrize("basis", [HarmonicBasis(3), CellBasis(cells.fibonacci(16))])
@pytest.mark.parametrize(
    ("given", "message"),
    [
        (np.zeros((7, 3)), r"got shape \(7, 3\), expected \[(9|16), 3\]"),
        (np.full(1, np.nan), "got 1 NaN or Inf"),
        ("sky.exr", "got 'sky.exr', expected linear RGB"),
    ],
)
def test_maps_are_made_of_coefficients_in_the_basis(basis, given, message):
    if isinstance(given, np.ndarray) and given.ndim == 1:
        given = np.where(np.arange(3 * basis.size).reshape(-1, 3) == 4, given, 1.0)
    with pytest.raises(ValueError, match=f"^coefficients: {message}"):
        basis.to_map(given)


def test_a_map_of_cells_lights_a_scene_as_the_cells_do():
    """Without shadows, by which alone a map that a renderer knows differs from free light."""
    ball = ws.Body(ws.icosphere(1.0, 3), blockers=0)
    camera = ws.Camera.look_at((0, 1, 3), (0, 0, 0), size=(16, 16))
    basis = CellBasis(cells.fibonacci(128))
    light = basis.coefficients(synthetic_sky(height=64))
    scene = ws.Scene([ball], basis.to_map(light), camera)
    found = ws.Renderer(scene, basis=basis)
    free = found.draw(wp.array(light[None], dtype=wp.vec3)).numpy()
    again = found.draw(wp.array(basis.coefficients(scene.light)[None], dtype=wp.vec3)).numpy()
    np.testing.assert_allclose(again, free, rtol=FLOAT32, atol=FLOAT32)
    assert np.linalg.norm(found.render() - free) < 0.01 * np.linalg.norm(free)
