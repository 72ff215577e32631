"""Fronts of flats that patch samples see: their formula, its gradients, and what it means."""

import numpy as np
import pytest
import warp as wp
from plane_settings import Setting, margin_of, ramp

from warpshadow.device.tape import recorded
from warpshadow.stages.planes.fronts import NearestBlockers, find_body_sides, find_fronts
from warpshadow.stages.receivers.body_spans import Span

pytestmark = pytest.mark.usefixtures("poisoned_outputs")

FLOAT32 = 2e-5
NUMBERS = np.array([0, 1, -1, 2, 0, -1, 3], np.int32)
"""The sphere of each receiver."""


def over_margin(points, frames, grids):
    """Heights over flats in half margins, [flat, receiver]."""
    found = []
    for f, grid in enumerate(grids):
        origin, u, v = frames[3 * f : 3 * f + 3]
        up, margin = np.cross(u, v) / np.linalg.norm(np.cross(u, v)), np.linalg.norm(u) * margin_of(grid)
        found.append(2 * (points - origin) @ up / margin)
    return np.array(found)


def twin_fronts(points, normals, corners, centers, radii, frames, grids, heights):
    """Fronts, and points off the planes: [receiver, flat + 3]; steps by heights, which have no gradient, are given."""
    fronts, lifted = np.zeros((len(points), len(grids))), points.copy()
    for f, grid in enumerate(grids):
        origin, u, v = frames[3 * f : 3 * f + 3]
        up, margin = np.cross(u, v) / np.linalg.norm(np.cross(u, v)), np.linalg.norm(u) * margin_of(grid)
        of_corners = (corners[4:] - origin) @ up  # of the second body
        span = max(np.ptp(of_corners), margin)
        leaning = np.clip((of_corners.min() + of_corners.max()) / span, -1, 1)
        for point, (place, number) in enumerate(zip(points, NUMBERS, strict=True)):
            height = (place - origin) @ up
            z = leaning + (1 - leaning**2) * normals[point] @ up + heights[f, point]
            if number >= 0 and radii[number] > 0:
                z = 1.25 * (height + (centers[number] - origin) @ up) / radii[number]
            fronts[point, f] = ramp(z)
            near = max(1 - (height / margin / 10) ** 2, 0)
            lifted[point] += (2 * fronts[point, f] - 1) * 5 * margin * near**2 * up
    return np.hstack([fronts, lifted])


def test_fronts_and_their_gradients_are_those_of_the_twin(device):
    setting, rng = Setting(device), np.random.default_rng(0)
    setting.points[0, :5, 1] *= 0.2
    setting.points[0, 2:4, 1] = [1e-4, -1e-4]
    values = [
        setting.points[0],
        setting.normals[0],
        np.concatenate([np.zeros((4, 3)), rng.uniform([-0.4, -0.1, -0.4], [0.4, 1.5, 0.4], size=(9, 3))]),
        setting.points[0, :4] + rng.uniform(-0.2, 0.2, size=(4, 3)),
        np.array([1.6, 2.5, 3.0, 0.0]),
        setting.frames(setting.vertices[0]),
    ]
    dtypes = wp.vec3, wp.vec3, wp.vec3, wp.vec3, wp.float32, wp.vec3
    given = [
        wp.array(value[None], dtype=dtype, device=device, requires_grad=True)
        for value, dtype in zip(values, dtypes, strict=True)
    ]
    points, normals, corners, centers, radii, frames = given
    numbers = wp.array(NUMBERS, device=device)
    with recorded() as tape:
        spheres = NearestBlockers(centers, radii, numbers)
        sides = find_body_sides(corners, np.array([0, 4, 13], np.int32), frames, setting.planes)
        spans = (Span(1, 0, points.shape[1]),)
        fronts, lifted = find_fronts(points, normals, sides, spheres, frames, setting.planes, spans=spans)
    heights = over_margin(values[0], values[-1], setting.grids)
    expected = twin_fronts(*values, setting.grids, heights)
    np.testing.assert_allclose(fronts.numpy()[0], expected[:, :3], atol=5e-3)  # of a margin near float32's rounding
    np.testing.assert_allclose(lifted.numpy()[0], expected[:, 3:], atol=1e-6)
    assert ((expected[:, :3] > 0.01) & (expected[:, :3] < 0.99)).sum() > 5

    weights = rng.uniform(size=expected.shape) * [1, 1, 1, 1e3, 1e3, 1e3]
    seeds = (fronts, weights[None, :, :3], wp.float32), (lifted, weights[None, :, 3:], wp.vec3)
    tape.backward(grads={out: wp.array(seed, dtype=dtype, device=device) for out, seed, dtype in seeds})
    for number, array in enumerate(given):
        step = 1e-9 * rng.normal(size=values[number].shape)
        step[values[number] == 0] = 0  # a sphere without size
        ends = []
        for sign in (1, -1):
            moved = [value + sign * step if place == number else value for place, value in enumerate(values)]
            ends.append((weights * twin_fronts(*moved, setting.grids, heights)).sum())
        assert (array.grad.numpy()[0] * step).sum() == pytest.approx((ends[0] - ends[1]) / 2, rel=5e-3), number


@pytest.mark.parametrize(("center", "at_ground", "deep"), [(0.2, 1, 0), (0.16, 1, 0), (-0.2, 0, 0), (0, 0.5, 0)])
def test_a_patch_sample_is_on_the_side_on_which_its_sphere_is(center, at_ground, deep, device):
    """A sphere of radius 0.2: it stands on the ground, bulges into it, hangs from below, and is half sunk."""
    setting = Setting(device, names=("ground",))
    points = wp.array([[[0.1, 0, 0.1], [0.1, -1, 0.1]]], dtype=wp.vec3, device=device)
    centers = wp.array([[[0.1, center, 0.1]]], dtype=wp.vec3, device=device)
    radii, numbers = wp.full((1, 1), 0.2, dtype=wp.float32, device=device), wp.zeros(2, wp.int32, device=device)
    frames = wp.array([setting.frames(setting.vertices[0])], dtype=wp.vec3, device=device)
    fronts = find_fronts(points, points, None, NearestBlockers(centers, radii, numbers), frames, setting.planes)
    np.testing.assert_allclose(fronts.front_weights.numpy()[0, :, 0], [at_ground, deep], atol=1e-6)


@pytest.mark.parametrize("size", [1e-18, 1e-30, 1e18])
def test_any_size_gives_finite_fronts_and_gradients(size, device):
    setting = Setting(device, names=("ground",))
    points = wp.array([[[0.0, size, 0], [1e18, -1e18, 0]]], dtype=wp.vec3, device=device, requires_grad=True)
    centers = wp.array([[[size, size / 2, 0]]], dtype=wp.vec3, device=device, requires_grad=True)
    radii = wp.full((1, 1), size, dtype=wp.float32, device=device, requires_grad=True)
    numbers = wp.zeros(2, wp.int32, device=device)
    frames = wp.array([setting.frames(setting.vertices[0])], dtype=wp.vec3, device=device, requires_grad=True)
    with recorded() as tape:
        fronts, _ = find_fronts(points, points, None, NearestBlockers(centers, radii, numbers), frames, setting.planes)
    tape.backward(grads={fronts: wp.full(fronts.shape, 1.0, dtype=wp.float32, device=device)})
    for array in (fronts, *(given.grad for given in (points, centers, radii, frames))):
        assert np.isfinite(array.numpy()).all()
