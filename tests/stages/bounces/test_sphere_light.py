"""Light from spheres: against the float64 twin, differences, and what is known of a sphere above a plane."""

import numpy as np
import pytest
import twins
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st

from warpshadow.device import parallel
from warpshadow.maths.directions import fibonacci
from warpshadow.stages.bounces import sphere_light as stage
from warpshadow.stages.bounces.proxy_radiance import find_proxy_radiance, patches_of_clusters
from warpshadow.stages.bounces.tangent_planes import TangentPlanes
from warpshadow.stages.visibility import merging
from warpshadow.stages.visibility.directional import transmittance

# Shares of cells are as float32 has them in the transmittance (test_directional.py), of 64 and 128 directions 1e-4 at
# the most; their quotient is better. Measured 2e-6 of the brightest.
FLOAT32 = 3e-5
# Relative L2 of a whole gradient: float32 kernels against float64 differences. Measured 2e-5 to 4e-4.
ADJOINT = 2e-3

pytestmark = pytest.mark.usefixtures("poisoned_outputs")

NAMES = ("points", "normals", "centers", "radii", "proxy_radiance", "passing", "unblocked")
DTYPES = (wp.vec3, wp.vec3, wp.vec3, wp.float32, wp.vec4, wp.float32, wp.float32)


def scene(seed, count=64, *, vertex_count=19, sphere_count=7):
    """Arguments, without a batch: one receiver in the blend at a surface, one inside, one where a sphere fades."""
    rng = np.random.default_rng(seed)
    points, normals, centers, radii = (
        values.astype(float)
        for values in twins.random_scene(seed, vertex_count=vertex_count, sphere_count=sphere_count)
    )
    up = np.array([0.6, 0.8, 0])
    for sphere, distance in enumerate([1.004, 0.7, 0.15, 300]):
        points[sphere] = centers[sphere] + distance * radii[sphere] * up
    proxy_radiance = rng.uniform(0.1, 1, (sphere_count, count, 4))
    unblocked = rng.uniform(0.2, 1, (vertex_count, count))
    passing = unblocked * rng.uniform(0, 0.9, (vertex_count, count))
    return points, normals, centers, radii, proxy_radiance, passing, unblocked


def put(values, device, **options):
    """Put arguments, each with a batch, on a device."""
    arrays = zip(values, DTYPES, strict=True)
    return [None if v is None else wp.array(v.astype(np.float32), dtype=t, device=device, **options) for v, t in arrays]


def light(values, count=64, device="cpu", **options):
    """Light of arguments without a batch, NumPy."""
    arrays = put([None if v is None else v[None] for v in values], device)
    return stage.sphere_light(*arrays, fibonacci(count), **options).numpy()[0]


def gradients(values, weights, count, device, **options):
    """Of arguments with a batch."""
    arrays = put(values, device, requires_grad=True)
    with wp.Tape() as tape:
        result = stage.sphere_light(*arrays, fibonacci(count), **options)
    result.grad.assign(weights.astype(np.float32))
    tape.backward()
    return result.numpy(), [None if array is None else array.grad.numpy() for array in arrays]


def differences(function, values, number, step=1e-6):
    """Central differences of a function of several arrays by one of them."""
    values = [value.copy() for value in values]
    result = np.zeros_like(values[number])
    for index in np.ndindex(result.shape):
        kept = values[number][index]
        ends = []
        for sign in (1, -1):
            values[number][index] = kept + sign * step
            ends.append(function(*values))
        values[number][index] = kept
        result[index] = (ends[0] - ends[1]) / (2 * step)
    return result


@pytest.mark.parametrize("count", [16, 64, 128])
def test_light_is_that_of_the_float64_twin(count, device):
    values = scene(count, count)
    expected = twins.sphere_light(*values, fibonacci(count))
    assert np.abs(light(values, count, device) - expected).max() < FLOAT32 * expected.max()


def test_without_anything_that_is_blocked_before_a_cell_has_all_of_its_light(device):
    *values, _ = scene(1)
    expected = twins.sphere_light(*values, np.ones((19, 64)), fibonacci(64))
    assert np.abs(light([*values, None], 64, device) - expected).max() < FLOAT32 * expected.max()


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_the_adjoint_is_that_of_the_twin(name, device):
    values, directions = scene(3, 16, vertex_count=17, sphere_count=5), fibonacci(16)
    weights = np.random.default_rng(4).normal(size=(17, 3))
    number = NAMES.index(name)
    got = gradients([value[None] for value in values], weights[None], 16, device)[1][number][0]
    expected = differences(lambda *all_: np.sum(weights * twins.sphere_light(*all_, directions)), values, number)
    assert np.linalg.norm(got - expected) < ADJOINT * np.linalg.norm(expected)


def tangent_planes(sphere_count=7, heights=(-0.5, 0.5)):
    """Planes and tolerances of spheres, some of which receivers see from above, some from below and some between."""
    rng = np.random.default_rng(2)
    planes = np.concatenate(
        [twins.unit(rng.normal(size=(sphere_count, 3))), rng.uniform(*heights, (sphere_count, 1))], 1
    )
    return planes, np.stack([rng.uniform(0, 0.6, sphere_count), rng.uniform(0.05, 0.5, sphere_count)], 1)


def on_device(planes, tolerances, device, **options):
    return TangentPlanes(
        wp.array(np.float32(planes)[None], dtype=wp.vec4, device=device, **options),
        wp.array(np.float32(tolerances), dtype=wp.vec2, device=device),
    )


def test_proxies_show_nothing_below_their_tangent_planes(device):
    values, (planes, tolerances) = scene(3), tangent_planes()
    shares = twins.facing_share(*values[:1], *values[2:4], planes, tolerances)
    assert all(((shares > low) & (shares < high)).mean() > 0.1 for low, high in ((0, 1e-6), (1e-3, 0.999), (0.999, 2)))
    expected = twins.sphere_light(*values, fibonacci(64), facing=(planes, tolerances))
    assert np.abs(expected - twins.sphere_light(*values, fibonacci(64))).max() > 0.05 * expected.max()
    got = light(values, 64, device, tangent_planes=on_device(planes, tolerances, device))
    assert np.abs(got - expected).max() < FLOAT32 * expected.max()


@pytest.mark.slow
@pytest.mark.parametrize("name", ("points", "centers", "radii", "planes"))
def test_the_adjoint_with_tangent_planes_is_that_of_the_twin(name, device):
    values, directions = scene(3, 16, vertex_count=17, sphere_count=5), fibonacci(16)
    planes, tolerances = tangent_planes(5, (-2, 0))
    weights = np.random.default_rng(4).normal(size=(17, 3))
    arrays = put([value[None] for value in values], device, requires_grad=True)
    facing = on_device(planes, tolerances, device, requires_grad=True)
    with wp.Tape() as tape:
        result = stage.sphere_light(*arrays, directions, tangent_planes=facing)
    result.grad.assign(weights[None].astype(np.float32))
    tape.backward()
    number = len(NAMES) if name == "planes" else NAMES.index(name)
    got = (facing.equations if name == "planes" else arrays[number]).grad.numpy()[0]

    def loss(*all_):
        return np.sum(weights * twins.sphere_light(*all_[:-1], directions, facing=(all_[-1], tolerances)))

    expected = differences(loss, (*values, planes), number)
    assert np.linalg.norm(got - expected) < ADJOINT * np.linalg.norm(expected)


@pytest.mark.parametrize("shared", [(), ("proxy_radiance",), ("unblocked",), ("proxy_radiance", "unblocked")])
def test_a_batch_is_single_calls_and_gradients_of_what_they_share_add_up(shared, device):
    singles = [list(scene(seed, 16)) for seed in (5, 6, 7)]
    for single in singles:
        for name in shared:
            single[NAMES.index(name)] = singles[0][NAMES.index(name)]
    together = [np.stack(values)[: 1 if name in shared else 3] for name, *values in zip(NAMES, *singles, strict=True)]
    weights = np.random.default_rng(8).normal(size=(3, 19, 3))
    got, got_gradients = gradients(together, weights, 16, device)
    expected = [
        gradients([value[None] for value in single], weight[None], 16, device)
        for single, weight in zip(singles, weights, strict=True)
    ]
    np.testing.assert_allclose(got, np.concatenate([values for values, _ in expected]), rtol=1e-6, atol=1e-7)
    for name, ours, *each in zip(NAMES, got_gradients, *(adj for _, adj in expected), strict=True):
        wanted = np.sum(each, axis=0) if name in shared else np.concatenate(each)
        np.testing.assert_allclose(ours, wanted, rtol=1e-4, atol=1e-5 * np.abs(wanted).max())


# a sphere is some 2 cells wide, or 20. Measured 0.156 and 0.006, 0.032 and 0.003
@pytest.mark.parametrize("count, error, bias", [(128, 0.18, 0.015), (1024, 0.04, 0.006)])
def test_a_white_sphere_above_a_plane_sends_what_its_form_factor_says(count, error, bias, device):
    """cos θ (r/d)² where all of the sphere is above the horizon. What is left over is the cells'."""
    rng = np.random.default_rng(0)
    height, radius, offsets, azimuth = 1.5, 0.5, np.linspace(0, 3, 150), rng.uniform(0, 2 * np.pi, 150)
    points = np.stack([offsets * np.cos(azimuth), 0 * offsets, offsets * np.sin(azimuth)], axis=-1)
    normals = np.broadcast_to([0.0, 1.0, 0.0], points.shape)
    center, directions = np.array([[0, height, 0]]), fibonacci(count)
    distance = np.linalg.norm(center - points, axis=-1)
    expected = height / distance * (radius / distance) ** 2
    patches = rng.normal(size=(1, 40, 3))
    patches /= np.linalg.norm(patches, axis=-1, keepdims=True)
    white = wp.full((1, 40), wp.vec3(0.5, 1.0, 2.0), dtype=wp.vec3, device=device)
    clusters = patches_of_clusters(np.zeros(40, int), np.zeros(1, int))
    shown = wp.array(np.maximum(-patches @ directions.T, 0), dtype=wp.float32, device=device)
    all_open = wp.full((1, 40), wp.vec3(1.0), dtype=wp.vec3, device=device)
    table = find_proxy_radiance(white, shown, all_open, np.ones(40), *clusters)
    arrays = put([v[None] for v in (points, normals, center, np.array([radius]))] + [None] * 3, device)[:4]
    passing = transmittance(*arrays, directions)
    got = stage.sphere_light(*arrays, table, passing, None, directions).numpy()[0]
    np.testing.assert_allclose(got[:, 0] * 4, got[:, 2], rtol=1e-5)
    assert np.linalg.norm(got[:, 1] - expected) < error * np.linalg.norm(expected)
    assert abs(got[:, 1].mean() / expected.mean() - 1) < bias


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_a_white_world_is_as_bright_as_it_is_blocked(seed):
    """A mean of radiosities is never above the largest, nor below the least."""
    values = list(scene(seed))
    passing, unblocked = values[5], values[6]
    is_met = (twins.blocked_shares(*values[:1], *values[2:4], fibonacci(64)) > 1e-6).any(axis=1)
    values[5] = np.where(is_met, passing, unblocked)
    values[4][..., :3] = values[4][..., 3:]
    lacking = np.maximum(values[1] @ fibonacci(64).T, 0) * (unblocked - values[5]) * 4 / 64
    np.testing.assert_allclose(light(values), lacking.sum(axis=1)[:, None].repeat(3, axis=1), rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("scale", [1e-4, 1e-2, 1e2, 1e4])
def test_units_do_not_matter(scale, device):
    points, normals, centers, radii, *rest = scene(9)
    expected = light([points, normals, centers, radii, *rest], device=device)
    scaled = light([points * scale, normals, centers * scale, radii * scale, *rest], device=device)
    # the receiver in the blend at a surface magnifies the rounding of its place; measured 1e-5
    np.testing.assert_allclose(scaled, expected, rtol=0, atol=1e-4)


@pytest.fixture
def merged(monkeypatch):
    """Arguments without a batch: five spheres, of which four merge while receivers see them so."""
    monkeypatch.setattr(merging, "MERGED_FROM", 4)
    rng = np.random.default_rng(7)
    centers, radii = 4 * rng.normal(size=(5, 3)), 3 + rng.normal(size=5) ** 2
    middle, _, extents = twins.merged_clusters(centers, radii)
    away = rng.normal(size=(6, 3))
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    angles = np.array([0.36, 0.4, 0.43, 0.46, 0.49, 0.3])[:, None]  # of 0.5, where it begins, and 0.35, where it ends
    normals = rng.normal(size=(6, 3)) - 3 * away
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    unblocked = rng.uniform(0.5, 1, (6, 16))
    proxy_radiance = rng.uniform(0.1, 1, (6, 16, 4))
    passing = unblocked * rng.uniform(0, 0.9, (6, 16))
    return [middle + extents / angles * away, normals, centers, radii, proxy_radiance, passing, unblocked]


def merging_twin(points, normals, centers, radii, *rest):
    """Spheres with their part of the share, and the cluster's sphere with the other."""
    middle, radius, extents = twins.merged_clusters(centers, radii)
    m = twins.smoothstep((0.5**2 - (extents / np.linalg.norm(middle - points, axis=1)) ** 2) / (0.5**2 - 0.35**2))
    parts = np.stack([1 - m] * 4 + [np.ones_like(m), m], axis=1)
    centers, radii = np.concatenate([centers, middle]), np.concatenate([radii, radius])
    shares = parts[:, :, None] * twins.blocked_shares(points, centers, radii, fibonacci(16))
    return twins.sphere_light(points, normals, centers, radii, *rest, fibonacci(16), shares=shares)


def test_spheres_that_merge_send_the_light_of_their_quad(merged, device):
    expected = merging_twin(*merged)
    assert np.abs(light(merged, 16, device, merging=1.0) - expected).max() < FLOAT32 * expected.max()


@pytest.mark.slow
def test_the_adjoint_of_spheres_that_merge_is_that_of_the_twin(merged, device):
    weights = np.random.default_rng(4).normal(size=(6, 3))
    got = gradients([value[None] for value in merged], weights[None], 16, device, merging=1.0)[1]
    for number, ours in enumerate(got):
        expected = differences(lambda *all_: np.sum(weights * merging_twin(*all_)), merged, number)
        assert np.linalg.norm(ours[0] - expected) < ADJOINT * np.linalg.norm(expected)


def test_where_nothing_is_met_there_is_no_light_and_no_gradient(device):
    points, normals, centers, radii, proxy_radiance, passing, _ = scene(10)
    for radii_, passing_ in [(radii, np.ones_like(passing)), (0 * radii, passing)]:
        values = [points, normals, centers, radii_, proxy_radiance, passing_, np.ones_like(passing)]
        got, each = gradients([value[None] for value in values], np.ones((1, 19, 3)), 64, device)
        assert (got == 0).all()
        assert all((gradient == 0).all() for gradient in each)


@pytest.mark.parametrize("vertex_count, sphere_count", [(0, 3), (3, 0)])
def test_no_receivers_and_no_spheres_are_no_work(vertex_count, sphere_count, device):
    arrays = put(
        [
            np.zeros((1, vertex_count, 3)),
            np.zeros((1, vertex_count, 3)),
            np.zeros((1, sphere_count, 3)),
            np.zeros((1, sphere_count)),
            np.zeros((1, sphere_count, 16, 4)),
            np.zeros((1, vertex_count, 16)),
            None,
        ],
        device,
    )
    assert (stage.sphere_light(*arrays, fibonacci(16)).numpy() == np.zeros((1, vertex_count, 3))).all()


HARD = twins.hard_scenes()


@pytest.mark.parametrize("case", HARD)
def test_light_and_gradients_of_hard_scenes_are_finite(case, device):
    points, normals, centers, radii = HARD[case]
    rng = np.random.default_rng(0)
    proxy_radiance = rng.uniform(0, 1, (1, len(radii), 64, 4))
    arrays = put([v[None] for v in (points, normals, centers, radii)] + [proxy_radiance] + [None] * 2, device)[:5]
    for array in arrays:
        array.requires_grad = True
    with wp.Tape() as tape:
        passing = transmittance(*arrays[:4], fibonacci(64))
        result = stage.sphere_light(*arrays, passing, None, fibonacci(64))
    result.grad.fill_(1.0)
    tape.backward()
    assert np.isfinite(result.numpy()).all()
    for array in (*arrays, passing):
        assert np.isfinite(array.grad.numpy()).all()


def test_results_are_the_same_bits_for_any_number_of_threads(monkeypatch):
    values = [value[None] for value in scene(11, vertex_count=400, sphere_count=20)]
    weights = np.random.default_rng(0).normal(size=(1, 400, 3))
    monkeypatch.setattr(stage, "PAIR_COST", 10.0)  # or so little work is not shared
    try:
        each = []
        for threads in (1, 3):
            parallel.set_thread_count(threads)
            each.append(gradients(values, weights, 64, "cpu"))
    finally:
        parallel.set_thread_count(None)
    np.testing.assert_array_equal(each[0][0], each[1][0])
    for one, three in zip(each[0][1], each[1][1], strict=True):
        np.testing.assert_array_equal(one, three)


def test_the_threads_of_a_gpu_give_what_those_of_a_cpu_give(request):
    values = [value[None] for value in scene(12, 64)]
    weights = np.random.default_rng(0).normal(size=(1, 19, 3))
    many = gradients(values, weights, 64, "cpu")
    request.getfixturevalue("gpu_branches")
    one = gradients(values, weights, 64, "cpu")
    np.testing.assert_allclose(one[0], many[0], rtol=1e-5, atol=1e-6)
    for ours, theirs in zip(one[1], many[1], strict=True):
        assert np.linalg.norm(ours - theirs) < ADJOINT * np.linalg.norm(theirs)


def test_what_does_not_fit_is_refused(device):
    good = put([value[None] for value in scene(13)], device)
    with pytest.raises(ValueError, match=r"proxy_radiance: got shape \(1, 6, 64\), expected \[1, 7, 64\]"):
        stage.sphere_light(*good[:4], good[4][:, :6], *good[5:], fibonacci(64))
    with pytest.raises(ValueError, match=r"transmittance: got shape \(1, 19, 64\), expected \[1, 19, 32\]"):
        stage.sphere_light(*good[:4], good[4][:, :, :32].contiguous(), *good[5:], fibonacci(32))
    with pytest.raises(ValueError, match=r"transmittance_others: got shape \(1, 18, 64\), expected \[1, 19, 64\]"):
        stage.sphere_light(*good[:6], good[6][:, :18], fibonacci(64))
    with pytest.raises(ValueError, match="radii: got 7 values out of range"):
        negative = wp.full((1, 7), -1.0, dtype=wp.float32, device=device)
        stage.sphere_light(*good[:3], negative, *good[4:], fibonacci(64))
    with pytest.raises(ValueError, match="softness: got 0.0 for 64 directions"):
        stage.sphere_light(*good, fibonacci(64), softness=0.0)


@pytest.mark.parametrize("skip", [(0, 2), (1, 3), (5, 7)])
def test_spheres_that_are_left_out_are_as_those_of_no_radius(skip, device, monkeypatch):
    monkeypatch.setattr(merging, "MERGED_FROM", 4)
    values = [value[None] for value in scene(11, 16)]
    clusters = np.random.default_rng(0).uniform(0.1, 1, (1, 1, 16, 4))
    values[4] = np.concatenate([values[4], clusters], axis=1)
    weights = np.random.default_rng(12).normal(size=(1, 19, 3))
    options = {"merging": 1.0}
    got, got_gradients = gradients(values, weights, 16, device, skips=[skip], **options)
    radii, cluster = values[3].copy(), slice(0, 4)
    radii[0, slice(*skip)] = 0
    if skip[0] < cluster.stop:  # its four spheres no longer merge
        options, values[4] = {"merging": 0}, values[4][:, :-1]
        got_gradients[4] = got_gradients[4][:, :-1]
    values[3] = radii
    expected, expected_gradients = gradients(values, weights, 16, device, **options)
    np.testing.assert_allclose(got, expected, rtol=1e-5, atol=1e-6)
    for ours, wanted in zip(got_gradients, expected_gradients, strict=True):
        assert np.linalg.norm(ours - wanted) <= ADJOINT * np.linalg.norm(wanted)
