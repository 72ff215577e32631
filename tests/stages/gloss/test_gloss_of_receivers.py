"""Gloss: samples of lobes, prefiltered light, transmittance of lobes and reflection, against float64 twins."""

import numpy as np
import pytest
import twins
import warp as wp

from warpshadow.maths.directions import fibonacci
from warpshadow.stages.gloss import lobes, prefilter, reflection, transmittance
from warpshadow.stages.gloss.face_horizon import weigh_by_faces
from warpshadow.stages.gloss.normal_spread import NormalSpread, find_normal_spread
from warpshadow.stages.raster.rasterization import Fragments
from warpshadow.stages.textures import numbers

# Numbers near 1 after some tens of operations in float32.
FLOAT32 = 2e-5
# Light that a lobe takes from everywhere, by 32 samples; measured 0.1% to 0.7%, at grazing angles and roughness 1.
ENERGY = 0.01

pytestmark = pytest.mark.usefixtures("poisoned_outputs")

CAMERA = np.array([[1.2, 0.1, 0.2, 0.3], [0, 1.4, 0.1, -0.2], [0.1, 0.2, 1.0, 0.5], [0.1, -0.2, 0.9, 3.0]])


def receivers(count=9, seed=0):
    """Points, normals and roughness; all normals see the camera."""
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(1, count, 3))
    views = twins.unit(twins.eye_of(CAMERA) - points)
    normals = twins.unit(views + 0.8 * rng.uniform(-1, 1, size=views.shape))
    return points, normals, rng.uniform(0.2, 0.9, size=(1, count))


def arrays(device, *values, requires_grad=False):
    dtypes, vectors = {(1, 4, 4): wp.mat44}, {2: wp.vec2, 3: wp.vec3}
    return [
        wp.array(
            value.astype(np.float32),
            dtype=dtypes.get(value.shape, vectors.get(value.shape[-1], wp.float32)),
            device=device,
            requires_grad=requires_grad,
        )
        for value in values
    ]


def spreads(normals, seed=5):
    """Two vectors across each normal."""
    rng = np.random.default_rng(seed)
    vectors = 0.6 * rng.uniform(-1, 1, size=(2, *normals.shape))
    return vectors - (vectors * normals).sum(axis=-1, keepdims=True) * normals


def places_of(points, device):
    """Places of receivers in their pixels, of 2 × 2, and the angles by which samples are turned there."""
    places = np.arange(points[..., 0].size).reshape(points.shape[:2]) % 4
    return wp.array(places, dtype=wp.int32, device=device), np.pi / 2 * places


@pytest.mark.parametrize("varies", [False, True])
def test_samples_of_lobes_are_those_of_the_twin(device, varies):
    points, normals, roughness = receivers()
    spread = spreads(normals) if varies else None
    arguments = arrays(device, points, normals, roughness, CAMERA[None])
    got = lobes.sample_lobes(*arguments, 32, NormalSpread(*arrays(device, *spread)) if varies else None)
    expected_samples = twins.lobe_samples(points, normals, roughness, CAMERA, 32, spread)
    for result, expected in zip(got[:4], expected_samples, strict=True):
        assert np.abs(result.numpy() - expected).max() < 20 * FLOAT32 * np.abs(expected).max()


def test_samples_of_lobes_are_turned_by_the_places_of_receivers_in_pixels(device):
    points, normals, roughness = receivers()
    places, turns = places_of(points, device)
    got = lobes.sample_lobes(*arrays(device, points, normals, roughness, CAMERA[None]), 8, None, places, 4)
    expected_samples = twins.lobe_samples(points, normals, roughness, CAMERA, 8, None, turns)
    expected_samples[2][:] *= 4**-0.2  # narrower blur
    for result, expected in zip(got[:4], expected_samples, strict=True):
        assert np.abs(result.numpy() - expected).max() < 20 * FLOAT32 * np.abs(expected).max()


@pytest.mark.parametrize("count", [32, 7])
@pytest.mark.parametrize("is_turned", [False, True])
def test_samples_of_lobes_have_the_gradients_of_the_twin(device, count, is_turned):
    points, normals, roughness = receivers()
    values = [points, normals, roughness, CAMERA[None], *spreads(normals)]
    variables = arrays(device, *values, requires_grad=True)
    rng = np.random.default_rng(7)
    places, turns = places_of(points, device) if is_turned else (None, 0.0)
    with wp.Tape() as tape:
        samples = lobes.sample_lobes(*variables[:4], count, NormalSpread(*variables[4:]), places, 4 if is_turned else 1)
    samples = samples[:4]
    weights = [rng.normal(size=result.numpy().shape) for result in samples]
    tape.backward(grads=dict(zip(samples, arrays(device, *weights), strict=True)))

    def loss(values):
        results = twins.lobe_samples(*values[:3], values[3][0], count, values[4:], turns)
        if is_turned:
            results[2][:] *= 4**-0.2
        return sum((weight * result).sum() for weight, result in zip(weights, results, strict=True))

    for number, variable in enumerate(variables):
        towards, step = rng.normal(size=values[number].shape), 1e-6
        moved = [[*values[:number], values[number] + h * towards, *values[number + 1 :]] for h in (step, -step)]
        gradient = variable.grad.numpy()
        # a dot product of numbers of either sign: float32 is relative to their size
        scale = np.linalg.norm(gradient) * np.linalg.norm(towards)
        assert abs((gradient * towards).sum() - (loss(moved[0]) - loss(moved[1])) / (2 * step)) < 20 * FLOAT32 * scale


@pytest.mark.parametrize(("tilt", "is_smooth"), [(0.1, True), (0.9, False)])
def test_normals_vary_over_a_pixel_as_they_do_between_pixels(device, tilt, is_smooth):
    """On one large face, seen in the plane across the normal, or of the face where the normal is far from its own."""
    positions, size = np.array([[-1.0, -0.8, 0.1], [1.1, -0.7, -0.4], [0.1, 0.9, 0.3]]), 16
    face_normal = twins.unit(np.cross(positions[1] - positions[0], positions[2] - positions[0]))
    corner_normals = twins.unit(0.1 * positions + face_normal + tilt * np.array([0.5, -0.8, 0.0]))
    weights, eye = np.array([0.3, 0.3, 0.4]), twins.eye_of(CAMERA)
    point, normal = weights @ positions, twins.unit(weights @ corner_normals)
    plane_normal = normal if is_smooth else face_normal
    assert (normal @ face_normal > 0.96) == is_smooth and (normal @ face_normal > 0.9) == is_smooth
    clip = CAMERA @ [*point, 1]

    def normal_at(x, y):
        """Of the point of the plane at a position in the image, from −1 to 1, moved onto the face along its normal."""
        rows = np.stack([CAMERA[0, :3] - x * CAMERA[3, :3], CAMERA[1, :3] - y * CAMERA[3, :3], plane_normal])
        seen = np.linalg.solve(rows, [*(np.array([x, y]) * CAMERA[3, 3] - CAMERA[:2, 3]), plane_normal @ point])
        barycentrics = np.linalg.solve(np.vstack([positions.T, np.ones(3)])[[0, 1, 3]], [*_onto(seen)[:2], 1])
        return twins.unit(barycentrics @ corner_normals)

    def _onto(seen):
        return seen - (seen - point) @ face_normal * face_normal

    arrays_of = [
        wp.array(np.array(value)[None].astype(np.float32), dtype=dtype, device=device)
        for value, dtype in ((corner_normals, wp.vec3), (positions, wp.vec3), (CAMERA, wp.mat44))
    ]
    fragments = Fragments(
        wp.zeros((1, 1), dtype=wp.int32, device=device),
        wp.array(weights[None, None].astype(np.float32), dtype=wp.vec3, device=device),
    )
    faces = wp.array([[0, 1, 2]], dtype=wp.vec3i, device=device)
    got = find_normal_spread(fragments, faces, *arrays_of, (size, size), 2)
    slant = abs(plane_normal @ twins.unit(eye - point))
    middle, step = clip[:2] / clip[3], 1e-4
    for result, axis in zip(got, np.eye(2), strict=True):
        change = normal_at(*(middle + step * axis)) - normal_at(*(middle - step * axis))
        expected = change / (2 * step) * 2 / size * slant / np.hypot(slant, 0.1)
        found = result.numpy()[0, 0]
        assert min(np.abs(found - expected).max(), np.abs(found + expected).max()) < 3e-3 * np.abs(expected).max()


def test_samples_that_leave_below_their_face_have_no_weight(device):
    """On the front and the back of a face, and on none."""
    rng = np.random.default_rng(3)
    corners = np.array([[-1.0, -0.8, 0.1], [1.1, -0.7, -0.4], [0.1, 0.9, 0.3]])
    face_normal = twins.unit(np.cross(corners[1] - corners[0], corners[2] - corners[0]))
    side = np.array([1.0, -1.0, 1.0])[:, None]
    normals = twins.unit(side * face_normal + 0.5 * rng.normal(size=3))
    directions, weights = twins.unit(side[:, None] * face_normal + rng.normal(size=(3, 32, 3))), rng.random((3, 32, 2))
    fragments = Fragments(wp.array([[0, 0, -1]], dtype=wp.int32, device=device), wp.empty((1, 3), wp.vec3, device))
    faces = wp.array([[0, 1, 2]], dtype=wp.vec3i, device=device)
    inputs = arrays(device, corners[None], normals[None], directions[None], weights[None])
    heights = np.clip(1 + side * (directions @ face_normal) / 0.1, 0, 1)
    heights[2] = 1
    expected = weights * (heights**2 * (3 - 2 * heights))[..., None]
    assert ((heights > 0) & (heights < 1)).any() and (heights[:2] == 0).any()
    assert np.abs(weigh_by_faces(fragments, faces, *inputs).numpy()[0] - expected).max() < 20 * FLOAT32


@pytest.mark.parametrize("roughness", [0.2, 0.5, 1.0])
@pytest.mark.parametrize("cosine", [0.1, 0.5, 1.0])
def test_lobes_take_as_much_even_light_as_the_surface_reflects(device, roughness, cosine):
    """In a white furnace a white metal loses what light between its mirrors would bring."""
    normal = np.array([0.0, 0.0, 1.0])
    point = twins.eye_of(CAMERA) - 2 * np.array([np.sqrt(1 - cosine**2), 0, cosine])
    values = point[None, None], normal[None, None], np.array([[roughness]]), CAMERA[None]
    _, weights, *_ = lobes.sample_lobes(*arrays(device, *values), 32)
    got = weights.numpy()[0, 0].sum(axis=0)
    for part, expected in zip(got, twins.lobe_energy(cosine, roughness), strict=False):
        assert part == pytest.approx(expected, abs=ENERGY)


@pytest.mark.parametrize("normal", [(0.36, 0.48, 0.8), (1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 1)])
def test_lobes_that_are_seen_from_straight_above_are_as_wide_around_any_normal(device, normal):
    normal = twins.unit(np.array(normal, float))
    point = twins.eye_of(CAMERA) - 2 * normal
    values = point[None, None], normal[None, None], np.array([[0.7]]), CAMERA[None]
    directions, *_ = lobes.sample_lobes(*arrays(device, *values), 32)
    got = directions.numpy()[0, 0]
    spread = np.linalg.eigvalsh(got.T @ got / len(got))
    assert spread[0] > 0.05 and np.abs(got @ normal - np.sort(got @ normal)[::-1]).max() < 0.1


def test_prefiltered_light_is_blurred_by_gaussians(device):
    rng = np.random.default_rng(1)
    radiance = (rng.uniform(size=(16, 32, 3)) ** 4).repeat(4, axis=0).repeat(4, axis=1)
    texels = wp.array(prefilter.prefilter(radiance)[None], dtype=wp.vec3, device=device)
    directions = fibonacci(16).astype(np.float32)[None]
    for sigma in (0.1, 0.4):
        blurs = wp.full((1, 1, 16), sigma, dtype=wp.float32, device=device)
        inputs = wp.array(directions[None], dtype=wp.vec3, device=device), blurs
        expected = twins.blurred(radiance, directions[0], sigma)
        got = prefilter.look_up_light(texels, *inputs).numpy()[0, 0]
        # texels are as wide as the Gaussian, and levels interpolate: measured 10%
        assert np.linalg.norm(got - expected) < 0.12 * np.linalg.norm(expected - expected.mean(axis=0))


def test_even_light_stays_as_it_is_at_any_level(device):
    texels = wp.array(prefilter.prefilter(np.full((8, 16, 3), 0.7))[None], dtype=wp.vec3, device=device)
    directions = wp.array(fibonacci(16)[None, None], dtype=wp.vec3, device=device)
    blurs = wp.array(np.linspace(0, 1.5, 16)[None, None], dtype=wp.float32, device=device)
    assert np.abs(prefilter.look_up_light(texels, directions, blurs).numpy() - 0.7).max() < FLOAT32


def test_maps_keep_their_energy_with_other_rows():
    radiance = np.random.default_rng(0).uniform(size=(50, 100, 3))
    for rows in (16, 64):
        power = (
            prefilter.resize_rows(radiance, rows).sum(axis=1)
            * np.diff(-np.cos(np.pi * np.arange(rows + 1) / rows))[:, None]
        )
        own = radiance.sum(axis=1) * np.diff(-np.cos(np.pi * np.arange(51) / 50))[:, None]
        np.testing.assert_allclose(power.sum(axis=0) / rows, own.sum(axis=0) / 50, rtol=1e-4)


def test_transmittance_of_samples_is_the_mean_of_the_cells_around(device):
    rng = np.random.default_rng(2)
    cells, (_, normals, _) = fibonacci(64), receivers(5)
    through = rng.uniform(size=(1, 5, 64))
    directions = twins.unit(normals[:, :, None] + 0.9 * twins.unit(rng.normal(size=(1, 5, 8, 3))))
    inputs = [
        wp.array(through, dtype=wp.float32, device=device),
        *(wp.array(value, dtype=wp.vec3, device=device) for value in (normals, directions)),
    ]
    got = transmittance.interpolate_transmittance(*inputs, cells).numpy()
    expected = twins.transmittance_near(through, normals, directions, cells, transmittance.KERNEL_RADIUS)
    assert np.abs(got - expected).max() < 20 * FLOAT32


def test_sharp_transmittance_keeps_edges_in_their_places(device):
    """None, half and all of it stay."""
    blurred = np.linspace(0, 1, 9)
    sharp = transmittance.sharpen(wp.array(blurred[None, None], dtype=wp.float32, device=device)).numpy()[0, 0]
    np.testing.assert_allclose(sharp, blurred**2 * (3 - 2 * blurred), atol=FLOAT32)
    np.testing.assert_array_equal(sharp[[0, 4, 8]], [0, 0.5, 1])


def test_blockers_send_what_is_blocked(device):
    """Of even light that all bounces bring back, nothing is missing."""
    even = wp.full((1, 2), wp.vec3(0.7), dtype=wp.vec3, device=device)
    direct = wp.array([[[0.35] * 3, [0.7] * 3]], dtype=wp.vec3, device=device)
    openness = wp.array([[[0.5] * 3, [1.0] * 3]], dtype=wp.vec3, device=device)
    blocked = reflection.find_blocked_radiance(even, direct, openness)
    np.testing.assert_allclose(blocked.numpy()[0], [[0.7] * 3, [0.0] * 3], rtol=1e-6)
    weights = wp.full((1, 2, 4), wp.vec2(0.25), dtype=wp.vec2, device=device)
    light = wp.full((1, 2, 4), wp.vec3(0.7), dtype=wp.vec3, device=device)
    through = wp.array(np.linspace(0, 1, 8).reshape(1, 2, 4), dtype=wp.float32, device=device)
    for total in reflection.sum_lobes(weights, light, through, blocked):
        np.testing.assert_allclose(total.numpy()[0, 0], 0.7, rtol=1e-6)


def test_diffuse_receivers_keep_their_light(device):
    rng = np.random.default_rng(3)
    numbers = wp.array([-1, 0, -1], dtype=wp.int32, device=device)
    diffuse = wp.array(rng.uniform(size=(1, 3, 3)), dtype=wp.vec3, device=device)
    lobe = [wp.array(rng.uniform(size=(1, 1, 3)), dtype=wp.vec3, device=device) for _ in range(2)]
    scalars = [wp.array([[value]], dtype=wp.float32, device=device) for value in (0.5, 1.0, 1.0)]
    colored, white = reflection.mix_reflection(numbers, diffuse, *lobe, *scalars)
    assert np.array_equal(colored.numpy()[0, ::2], diffuse.numpy()[0, ::2]) and not white.numpy()[0, ::2].any()
    straight, grazing = (item.numpy()[0, 0] for item in lobe)
    np.testing.assert_allclose(colored.numpy()[0, 1], straight - grazing, rtol=1e-5)
    np.testing.assert_allclose(white.numpy()[0, 1], grazing, rtol=1e-5)


@pytest.mark.parametrize("cosine", [0.0, 0.3, 0.6, 1.0])
def test_plastic_takes_from_its_diffuse_layer_the_light_that_its_coat_reflects(device, cosine):
    numbers, one = wp.array([0], dtype=wp.int32, device=device), np.ones((1, 1, 3))
    light = [wp.array(value * one, dtype=wp.vec3, device=device) for value in (1.0, 0.0, 0.0)]
    scalars = [wp.array([[value]], dtype=wp.float32, device=device) for value in (cosine, 0.0, 1.0)]
    colored, _ = reflection.mix_reflection(numbers, *light, *scalars)
    # three coefficients for all cosines
    assert colored.numpy().mean() == pytest.approx(0.96 * (1 - twins.even_grazing(cosine)), abs=1e-3)


def test_samples_that_share_a_receiver_give_it_the_mean_of_their_numbers(device):
    """One sample interpolates between vertices, and one sees nothing."""
    rng = np.random.default_rng(4)
    faces = wp.array([[0, 1, 1], [0, 1, 2], [2, 2, 2], [3, 3, 3]], dtype=wp.vec3i, device=device)
    face_ids = wp.array(np.array([[2, 3, 2, -1, 1, 2]]), dtype=wp.int32, device=device)
    values = rng.uniform(size=(3, 6)).astype(np.float32)
    samples = wp.array(values, dtype=wp.float32, device=device, requires_grad=True)
    with wp.Tape() as tape:
        means = numbers.average_over_receivers(samples, face_ids, faces, 4)
    expected = np.stack([0 * values[:, 0], 0 * values[:, 0], values[:, [0, 2, 5]].mean(axis=1), values[:, 1]], axis=1)
    np.testing.assert_allclose(means.numpy(), expected, atol=FLOAT32)
    adj_means = rng.normal(size=(3, 4)).astype(np.float32)
    tape.backward(grads={means: wp.array(adj_means, dtype=wp.float32, device=device)})
    expected = np.zeros((3, 6))
    expected[:, [0, 2, 5]], expected[:, 1] = adj_means[:, 2:3] / 3, adj_means[:, 3]
    np.testing.assert_allclose(samples.grad.numpy(), expected, atol=FLOAT32)


def test_numbers_are_grays_and_back(device):
    values = np.random.default_rng(5).uniform(size=(2, 3, 4)).astype(np.float32)
    grays = numbers.as_colors(wp.array(values, dtype=wp.float32, device=device))
    np.testing.assert_array_equal(grays.numpy(), values[..., None].repeat(3, axis=-1))
    np.testing.assert_array_equal(numbers.as_scalars(grays).numpy(), values.reshape(2, 12))
    assert numbers.as_colors(grays) is grays


@pytest.mark.parametrize(("runs", "expected"), [([], [-1] * 6), ([(1, 3), (5, 6)], [-1, 0, 1, -1, -1, 2])])
def test_receivers_of_runs_are_numbered_through(runs, expected, device):
    assert reflection.number_runs(6, runs, device).numpy().tolist() == expected
