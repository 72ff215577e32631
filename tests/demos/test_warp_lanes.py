"""Lanes of warps: how many have work, of receivers on a ground before a body of spheres."""

import numpy as np
import pytest

from demos.tools import warp_lanes
from warpshadow.maths.directions import falloff_width, fibonacci
from warpshadow.maths.spatial_sort import z_order


@pytest.fixture(scope="module")
def reaches():
    """A ground of 64 × 64 receivers in Z-order, and a pile of small spheres on it."""
    random = np.random.default_rng(0)
    axis = np.linspace(-3, 3, 64)
    points = np.stack([*np.meshgrid(axis, [0.0], axis, indexing="ij")], axis=-1).reshape(-1, 3)
    points = points[z_order(points)]
    centers = random.uniform((-0.5, 0.2, -0.5), (0.5, 1.5, 0.5), (64, 3))
    arguments = points, np.tile([0.0, 1.0, 0.0], (len(points), 1)), centers, np.full(64, 0.15)
    return warp_lanes.reached(*arguments, fibonacci(128), falloff_width(1.0, 128))


def test_most_lanes_of_a_warp_of_neighbors_have_work(reaches):
    """A launch lays warps out like this on a GPU: run_dimensions puts spans before receivers."""
    neighbors, spans = (warp_lanes.visits(reaches, count) for count in (32, 4))
    assert neighbors.lanes >= 20
    assert spans.lanes < 8  # 8 spans of 4 receivers
    assert neighbors.spheres < 0.5 * spans.spheres


def test_a_warp_that_sums_first_takes_an_atomic_for_all_its_lanes(reaches):
    neighbors = warp_lanes.visits(reaches, 32)
    assert neighbors.reduced == pytest.approx(neighbors.atomics / neighbors.lanes)


def test_lanes_are_counted_of_each_visit():
    reaches = np.zeros((64, 2, 8), bool)
    reaches[:32, 0, 3] = True  # a warp of neighbors, all of whose lanes the first sphere reaches
    reaches[40, 1, :] = True  # one receiver of the second
    spheres, lanes, atomics, reduced = warp_lanes.visits(reaches, 32)
    assert (spheres, lanes, atomics, reduced) == (9 / 16, 40 / 9, 4 * 40, 4 * 9)
    assert warp_lanes.visits(reaches, 4) == (9 / 16, 40 / 9, 4 * 40, 4 * 9)
