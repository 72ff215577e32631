"""Rays that are sent to bright patches find the same form factors with less noise."""

import numpy as np
import pytest
import twins

import warpshadow as ws
from warpshadow.stages.bounces.bright_patches import find_bright_patches
from warpshadow.stages.bounces.form_factors import loose_mesh, trace_form_factors

HEIGHT = 8.0  # of a square of 2 × 2 units, which five of 256 rays meet
RECEIVERS = 512


def factors_of_square(device, *, radiosity, hidden=False):
    """Form factors of receivers below a square that faces them, and of a large ground, [receiver, 2]."""
    square, ground = ws.plane(2.0, 1), ws.plane(200.0, 1)
    below = square.transformed(rotation=np.diag([1.0, -1, -1])).positions[square.surface.faces]
    corners = [below + [0, HEIGHT, 0], ground.positions[ground.surface.faces] - [0, 1, 0]]
    patches = [0, 0, 1, 1]
    if hidden:  # by a square that is black
        corners.append(below + [0, HEIGHT / 2, 0])
        patches += [-1, -1]
    corners, patch_of_sides = np.concatenate(corners).astype(np.float64), np.array([patches, [-1] * len(patches)])
    bright = find_bright_patches(np.repeat(radiosity, 3).reshape(2, 3), patch_of_sides, corners, rays=64, device=device)
    points, normals = np.zeros((RECEIVERS, 3)), np.tile([0.0, 1, 0], (RECEIVERS, 1))
    mesh = loose_mesh(corners, device=device)
    return bright, trace_form_factors(mesh, patch_of_sides, 2, points, normals, rays=256, bright=bright).toarray()


def test_form_factors_of_a_bright_patch_are_right_on_average_and_vary_less(device):
    _, plain = factors_of_square(device, radiosity=[1.0, 1.0])
    bright, sent = factors_of_square(device, radiosity=[1.0, 1e-6])
    assert bright.ray_count == 64
    noise = sent[:, 0].std() / np.sqrt(RECEIVERS)
    assert sent[:, 0].mean() == pytest.approx(twins.form_factor_of_square(HEIGHT), abs=4 * noise + 1e-4)
    assert sent[:, 0].std() < 0.25 * plain[:, 0].std()


def test_where_light_is_even_no_rays_are_sent_and_form_factors_are_the_same(device):
    bright, factors = factors_of_square(device, radiosity=[1.0, 0.5])
    assert bright.ray_count == 0 and not bright.density.numpy().any()
    counts = 256 * factors
    np.testing.assert_array_equal(counts, counts.round())  # each ray counts 1


def test_rays_to_a_patch_behind_another_do_not_count(device):
    bright, factors = factors_of_square(device, radiosity=[1.0, 1e-6], hidden=True)
    assert bright.ray_count == 64 and not factors[:, 0].any()
