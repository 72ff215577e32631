"""Orders in which neighbors in space are neighbors in memory."""

import numpy as np
import pytest

from warpshadow.maths.spatial_sort import compact_order, z_order, z_order_of_cells


def test_cells_follow_the_letter_z_in_blocks_of_two_of_blocks_of_two():
    rows, columns = np.divmod(np.arange(16), 4)
    order = z_order_of_cells(np.stack([columns, rows], axis=-1))
    expected = [0, 1, 4, 5, 2, 3, 6, 7, 8, 9, 12, 13, 10, 11, 14, 15]
    np.testing.assert_array_equal(order, expected)


@pytest.mark.parametrize("order", [z_order, compact_order])
def test_points_that_follow_each_other_are_nearer_than_points_at_random(order):
    points = np.random.default_rng(0).uniform(-3, 5, size=(2000, 3))
    along = order(points)
    np.testing.assert_array_equal(np.sort(along), np.arange(2000))
    steps = np.linalg.norm(np.diff(points[along], axis=0), axis=1)
    at_random = np.linalg.norm(np.diff(points, axis=0), axis=1)
    assert np.median(steps) < 0.3 * np.median(at_random)


@pytest.mark.parametrize("order", [z_order, compact_order])
@pytest.mark.parametrize("count", [0, 1, 3])
def test_a_few_points_have_an_order_too(order, count):
    np.testing.assert_array_equal(np.sort(order(np.ones((count, 3)))), np.arange(count))
