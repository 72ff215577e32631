"""Solid angles: of an octant, of a small triangle, and of what is around a point."""

import numpy as np
import pytest

import warpshadow as ws
from warpshadow.maths.adjacency import solid_angles


def test_an_octant_is_an_eighth_of_the_sphere_however_far():
    corners = np.diag([1.0, 5.0, 0.2])[None]
    assert solid_angles(corners) == pytest.approx([np.pi / 2])
    assert solid_angles(corners[:, ::-1]) == pytest.approx([-np.pi / 2])


def test_a_small_triangle_takes_its_area_over_its_squared_distance():
    corners = np.array([[(0, 0, 10), (0.01, 0, 10), (0, 0.01, 10)]])
    assert solid_angles(corners) == pytest.approx([0.5e-4 / 100], rel=1e-4)


@pytest.mark.parametrize(("point", "total"), [((0.5, 0.2, -0.6), 4 * np.pi), ((0.9, 0.9, 0.0), 0.0)])
def test_those_of_a_closed_mesh_add_up_to_all_of_the_sphere_inside_and_to_nothing_outside(point, total):
    ball = ws.icosphere(1.0, 2)
    corners = ball.positions[ball.faces].astype(np.float64) - point
    assert solid_angles(corners).sum() == pytest.approx(total, abs=1e-9)
