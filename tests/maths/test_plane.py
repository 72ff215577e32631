"""Whether triangles lie in a plane."""

import numpy as np
import pytest

from warpshadow.maths.plane import plane_normal

SQUARE = np.array([[[0, 0, 0], [0, 0, 2], [2, 0, 0]], [[2, 0, 0], [0, 0, 2], [2, 0, 2]]], float)


def test_a_square_has_the_normal_of_its_front():
    np.testing.assert_allclose(plane_normal(SQUARE), [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(plane_normal(SQUARE[:, ::-1]), [0, -1, 0], atol=1e-12)


@pytest.mark.parametrize(("bump", "is_flat"), [(1e-5, True), (1e-3, False)])
def test_a_bump_of_a_thousandth_of_the_size_is_not_flat(bump, is_flat):
    bumpy = SQUARE.copy()
    bumpy[1, 2, 1] = bump
    assert (plane_normal(bumpy) is not None) == is_flat


def test_a_sheet_that_is_seen_from_both_sides_has_no_normal():
    assert plane_normal(np.concatenate([SQUARE, SQUARE[:, ::-1]])) is None
