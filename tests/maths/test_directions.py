"""Direction cells: where they lie, their order, and the cones around chunks of them."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from warpshadow.maths import directions as cells

# Float64 arithmetic on unit vectors.
EXACT = 1e-12

COUNTS = [16, 32, 48, 64, 128, 256, 400, 1024]


@pytest.mark.parametrize("count", COUNTS)
def test_cells_are_the_fibonacci_directions_in_another_order(count):
    i = np.arange(count)
    z, phi = 1 - (2 * i + 1) / count, np.pi * (1 + 5**0.5) * (i + 0.5)
    expected = np.stack([np.sqrt(1 - z**2) * np.cos(phi), np.sqrt(1 - z**2) * np.sin(phi), z], axis=-1)
    distance, index = cKDTree(expected).query(cells.fibonacci(count))
    assert distance.max() < EXACT
    np.testing.assert_array_equal(np.sort(index), i)


@pytest.mark.parametrize("count", COUNTS)
def test_equal_cells_integrate_the_first_bands(count):
    """Fibonacci points are not a quadrature rule; their error falls like 1/Q; measured 0.23/Q at most."""
    directions = cells.fibonacci(count)
    assert np.abs(directions.mean(axis=0)).max() < 0.5 / count
    assert np.abs(directions.T @ directions / count - np.eye(3) / 3).max() < 0.5 / count


@pytest.mark.parametrize("count", [128, 256, 1024])
def test_bundles_are_compact(count):
    """A cap of 4 cells has half-angle arccos(1 − 8/Q); a bundle spans at most twice that."""
    cones = cells.bundle_cones(cells.fibonacci(count))
    assert np.arccos(cones.cosine).max() < 2 * np.arccos(1 - 8 / count)


@pytest.mark.parametrize("count", COUNTS)
def test_each_cone_holds_its_bundle_or_culls_nothing(count):
    directions = cells.fibonacci(count)
    axes, cosine, sine = cells.bundle_cones(directions)
    for bundle, axis, edge in zip(directions.reshape(-1, 4, 3), axes, cosine, strict=True):
        if not axis.any():
            assert edge == 0
            continue
        assert abs(np.linalg.norm(axis) - 1) < EXACT
        assert (bundle @ axis).min() > edge - EXACT
    np.testing.assert_allclose(cosine**2 + sine**2, 1, atol=EXACT)


def test_a_bundle_all_over_the_sphere_has_no_axis():
    corners = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) / np.sqrt(3)
    axes, cosine, sine = cells.bundle_cones(corners)
    assert not axes.any() and cosine[0] == 0 and sine[0] == 1


def test_a_disc_of_the_cell_radius_has_a_cells_solid_angle_on_a_plane():
    np.testing.assert_allclose(np.pi * cells.cell_radius(128) ** 2, 4 * np.pi / 128)


def test_directions_cannot_be_written():
    with pytest.raises(ValueError, match="read-only"):
        cells.fibonacci(64)[0] = 0


@pytest.mark.parametrize("count", [0, -16, 15, 17, 100])
def test_a_count_that_is_no_multiple_of_16_is_refused(count):
    with pytest.raises(ValueError, match=rf"count: got {count}, expected a positive multiple of 16"):
        cells.fibonacci(count)
