"""Grids of planes: where the points of texels lie, and how much texels count, if another plane crosses them."""

import numpy as np
import pytest

import warpshadow as ws
from warpshadow.stages.planes.grid import find_grid
from warpshadow.stages.planes.plane_blockers import PlaneBlockers, PlaneBody

EDGE = 0.28  # x from which on a wall hides the ground


@pytest.fixture
def ground():
    mesh = ws.plane(2.0, 3)
    return mesh.positions, mesh.surface.faces


def points_of(grid, covered_points, surface):
    positions, faces = surface
    return np.einsum("pc,pck->pk", covered_points.barycentrics, positions[faces[covered_points.faces]])


def test_points_of_texels_that_a_plane_crosses_lie_before_it(ground):
    grid, covered_points = find_grid(*ground, is_two_sided=False, half_spaces=np.array([[-1.0, 0, 0, EDGE]]))
    x = points_of(grid, covered_points, ground)[:, 0]
    _, plain_points = find_grid(*ground, is_two_sided=False)
    plain_x = points_of(grid, plain_points, ground)[:, 0]
    np.testing.assert_array_equal(covered_points.texels, plain_points.texels)
    moved = x != plain_x
    texel_size = 2 / 24
    assert moved.any() and (plain_x[moved] > EDGE).all() and (x[moved] < EDGE).all()
    assert (np.abs(x - plain_x) < texel_size / 2).all()
    np.testing.assert_array_equal(grid.texel_weights.ravel()[covered_points.texels] < 0.5, x > EDGE)


def test_planes_that_hide_all_or_nothing_change_no_weight(ground):
    half_spaces = np.array([[0, 1.0, 0, 1.0], [0, 1.0, 0, -1.0], [0, 1.0, 0, 0.0]])  # above, below and in the plane
    grid, _ = find_grid(*ground, is_two_sided=False, half_spaces=half_spaces)
    assert (grid.texel_weights == 1).all()


def test_texels_beside_a_plane_have_the_light_before_it(ground):
    grid, _ = find_grid(*ground, is_two_sided=False, half_spaces=np.array([[-1.0, 0, 0, EDGE]]))
    body = PlaneBody(grid, *ground, 0, 0, blocks=True)
    planes = PlaneBlockers.from_bodies([body], grid.covered.size, len(ground[0]), device="cpu")
    is_before = (grid.texel_weights == 1).ravel()
    entries = planes.texels_of_patches.rows
    starts, columns, weights = (a.numpy() for a in (entries.row_starts, entries.columns, entries.weights))

    def light(row):
        row = slice(*starts[row : row + 2])
        return (weights[row] * is_before[columns[row]]).sum() / weights[row].sum()

    lit = np.array([light(row) for row in range(grid.covered.size)]).reshape(grid.covered.shape)
    behind = ~is_before.reshape(grid.covered.shape)
    assert (lit[~behind] > 0.999).all()
    next_to_lit = behind & (np.roll(~behind, 1, axis=0) | np.roll(~behind, -1, axis=0) | np.roll(~behind, 1, axis=1))
    next_to_lit[:, 0] = next_to_lit[:, -1] = next_to_lit[0] = next_to_lit[-1] = False
    assert next_to_lit.any() and (lit[next_to_lit] > 0.98).all()
    assert (lit[behind] < 1e-3).any()
