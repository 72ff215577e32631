"""Contacts: which points of bodies touch, and how much finer surfaces are there."""

import numpy as np
import pytest

from warpshadow.maths.contacts import Contact, contact_excess, touching_numbers


def test_the_foot_of_a_ball_touches():
    rng = np.random.default_rng(0)
    points = rng.normal(size=(4000, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    points[0] = [0, -1, 0]
    touching = touching_numbers(points[:, 1] + 1.01, np.ones(4000), 1.0)
    assert 0 in touching and len(touching) <= 32
    assert np.linalg.norm(points[touching] - points[0], axis=1).max() < 0.07


@pytest.mark.parametrize("gap", [0.03, np.inf])
def test_bodies_that_are_apart_do_not_touch(gap):
    assert not len(touching_numbers(np.array([gap, 1.0]), np.ones(2), 1.0))
    assert not len(touching_numbers(np.empty(0), np.empty(0), 1.0))


def test_faces_that_lie_on_each_other_are_no_contact():
    assert not len(touching_numbers(np.array([0.0, 0, 1, 1]), np.ones(4), 1.0))


def test_density_falls_with_the_distance_of_the_nearest_contact():
    contacts = [Contact(np.zeros((1, 3)), 1.0), Contact(np.array([[3.0, 0, 0], [3, 1, 0]]), 0.5)]
    points = np.array([[0.3, 0, 0], [3, 1.2, 0], [0, 0, 0]])
    expected = [1 / (0.3**2 + 0.05**2), 1 / (0.4**2 + 0.05**2), 400]
    np.testing.assert_allclose(contact_excess(points, 0.0, contacts), expected)
    np.testing.assert_allclose(contact_excess(points[:1], np.array([0.1]), contacts), 1 / (0.2**2 + 0.05**2))
    np.testing.assert_array_equal(contact_excess(points, 0.0, ()), 0)
