"""What patches show of their area: against float64 NumPy, differences of it, and cases with known answers."""

import numpy as np
import pytest
import warp as wp
from plane_settings import Setting, ramp

from warpshadow.maths.directions import fibonacci
from warpshadow.stages.bounces.projected_areas import find_projected_areas, tilt_normals_off_planes
from warpshadow.stages.bounces.radiosity import mean_over_patch_samples

pytestmark = pytest.mark.usefixtures("poisoned_outputs")

ROUNDING = 2e-6
ADJOINT = 2e-5  # relative L2
DIRECTIONS = fibonacci(32)
HIDDEN = 0.1
SPHERES = np.int32([0, 1, 1, 0, -1, 1, 0])


def twin_turned(points, normals, radii, fronts, frames, grids, blocks):
    """Normals [patch sample, 3] without what points into flats."""
    turned = normals.copy()
    for s, sphere in enumerate(SPHERES):
        for f, grid in enumerate(grids):
            if sphere < 0 or not blocks[f]:
                continue
            origin, *axes = frames[3 * f : 3 * f + 3]
            up = np.cross(*axes) / np.linalg.norm(np.cross(*axes))
            part = radii[sphere] ** 2 / (((points[s] - origin) @ up) ** 2 + radii[sphere] ** 2)
            ends = [np.sign(end) * np.expm1(abs(end)) * grid.spread for end in (grid.low, grid.high)]
            for k, axis in enumerate(axes):
                scale = np.linalg.norm(axis)
                y, least, most = (points[s] - origin) @ axis / scale, scale * ends[0][k], scale * ends[1][k]
                part *= ramp((most - y) / radii[sphere]) - ramp((least - y) / radii[sphere])
            along_up, front = normals[s] @ up, fronts[s, f]
            turned[s] += part * (front * max(-along_up, 0) - (1 - front) * max(along_up, 0)) * up
    return turned


def twin_shown(normals, passing, matrix):
    opposite = [np.argmin(np.linalg.norm(DIRECTIONS + omega, axis=1)) for omega in DIRECTIONS]
    return np.einsum(
        "ps,sq,sq->pq", matrix, np.maximum(normals @ -DIRECTIONS.T, 0), HIDDEN + (1 - HIDDEN) * passing[:, opposite]
    )


def differences(function, values, number, weights):
    expected = np.zeros_like(values[number])
    for index in np.ndindex(expected.shape):
        ends = []
        for step in (1e-6, -1e-6):
            moved = [each.copy() for each in values]
            moved[number][index] += step
            ends.append(np.sum(weights * function(*moved)))
        expected[index] = (ends[0] - ends[1]) / 2e-6
    return expected


def compare(run, twin, values, dtypes, device):
    """Results and gradients of a stage and its twin, for one instance."""
    put = {"device": device, "requires_grad": True}
    arrays = [wp.array(each[None], dtype=dtype, **put) for each, dtype in zip(values, dtypes, strict=True)]
    with wp.Tape() as tape:
        result = run(*arrays)
    expected = twin(*values)
    assert np.abs(result.numpy()[0] - expected).max() < ROUNDING
    weights = np.random.default_rng(7).normal(size=expected.shape)
    result.grad.assign(weights[None].astype(np.float32))
    tape.backward()
    for number, array in enumerate(arrays):
        wanted = differences(twin, values, number, weights)
        assert np.linalg.norm(array.grad.numpy()[0] - wanted) <= ADJOINT * np.linalg.norm(wanted), number


def test_normals_turned_from_flats_are_those_of_the_twin(device):
    setting = Setting(device, blocks=(True, True, False))
    frames = setting.frames(setting.vertices[0])
    fronts = np.random.default_rng(2).uniform(size=(7, 3))
    values = [setting.points[0], setting.normals[0], np.array([0.3, 0.5]), fronts, np.asarray(frames, float)]
    compare(
        lambda p, n, r, *f: tilt_normals_off_planes(p, n, r, SPHERES, *f, setting.planes),
        lambda *scene: twin_turned(*scene, setting.grids, setting.blocks),
        values,
        (wp.vec3, wp.vec3, wp.float32, wp.float32, wp.vec3),
        device,
    )


def test_what_is_shown_is_that_of_the_twin(device):
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(5, 3))
    owners, weights = np.array([0, 0, 2, 2, 2]), np.array([0.4, 0.6, 0.5, 0.2, 0.3])
    matrix = np.zeros((3, 5))
    matrix[owners, np.arange(5)] = weights
    mean = mean_over_patch_samples(owners, weights, 3, device=device)
    compare(
        lambda n, t: find_projected_areas(n, t, mean, DIRECTIONS),
        lambda n, t: twin_shown(n, t, matrix),
        [normals, rng.random((5, 32))],
        (wp.vec3, wp.float32),
        device,
    )


def turned(height, normal, device, front=1.0, **options):
    """Normal at a height above the middle of a ground, with a sphere of radius 0.2."""
    setting = Setting(device, names=("ground",), **options)
    given = [[[0.1, height, 0.1]]], [[normal]]
    points, normals = (wp.array(each, dtype=wp.vec3, device=device).reshape((1, 1)) for each in given)
    radii = wp.full((1, 1), 0.2, dtype=wp.float32, device=device)
    frames = wp.array([setting.frames(setting.vertices[0])], dtype=wp.vec3, device=device)
    fronts = wp.full((1, 1, 1), front, dtype=wp.float32, device=device)
    return tilt_normals_off_planes(points, normals, radii, np.zeros(1, int), fronts, frames, setting.planes).numpy()[
        0, 0
    ]


def test_a_bottom_that_lies_on_a_ground_shows_nothing_and_one_above_it_does(device):
    np.testing.assert_allclose(turned(0.0, (0, -1, 0), device), 0, atol=1e-6)
    np.testing.assert_allclose(turned(0.2, (0, -1, 0), device), (0, -0.5, 0), atol=1e-6)
    assert turned(2.0, (0, -1, 0), device)[1] < -0.98
    for normal in ((0, 1, 0), (0.6, 0, 0.8)):
        np.testing.assert_allclose(turned(0.0, normal, device), normal, atol=1e-6)
    np.testing.assert_allclose(turned(0.0, (0, -1, 0), device, blocks=(False,)), (0, -1, 0), atol=1e-6)
    np.testing.assert_allclose(turned(-0.2, (0, 1, 0), device, front=0.0), (0, 0.5, 0), atol=1e-6)


@pytest.mark.parametrize("counts", [(2, 1), (1, 2)])
def test_one_instance_serves_all(counts, device):
    rng = np.random.default_rng(1)
    normals, passing = rng.normal(size=(counts[0], 2, 3)), rng.random((counts[1], 2, 32))
    mean = mean_over_patch_samples(np.zeros(2, int), np.array([0.5, 0.5]), 1, device=device)
    arrays = wp.array(normals, dtype=wp.vec3, device=device), wp.array(passing, dtype=wp.float32, device=device)
    got = find_projected_areas(*arrays, mean, DIRECTIONS).numpy()
    for batch in range(2):
        expected = twin_shown(normals[batch % counts[0]], passing[batch % counts[1]], np.array([[0.5, 0.5]]))
        np.testing.assert_allclose(got[batch], expected, atol=ROUNDING)


def test_what_does_not_fit_is_refused(device):
    mean = mean_over_patch_samples(np.zeros(2, int), np.array([0.5, 0.5]), 1, device=device)
    normals = wp.zeros((1, 2), dtype=wp.vec3, device=device)
    with pytest.raises(ValueError, match=r"transmittance: got shape \(1, 2, 8\), expected \[batch, 2, 32\]"):
        find_projected_areas(normals, wp.zeros((1, 2, 8), dtype=wp.float32, device=device), mean, DIRECTIONS)
    setting = Setting(device, names=("ground",))
    frames = wp.array([setting.frames(setting.vertices[0])], dtype=wp.vec3, device=device)
    radii, fronts = (wp.ones(shape, dtype=wp.float32, device=device) for shape in ((1, 1), (1, 2, 1)))
    with pytest.raises(ValueError, match="spheres: got 1, expected −1 to 0"):
        tilt_normals_off_planes(normals, normals, radii, np.array([0, 1]), fronts, frames, setting.planes)
