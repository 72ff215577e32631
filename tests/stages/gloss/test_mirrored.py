"""Bodies that lobes meet, against NumPy: a mirror and a wall that face each other, and receivers between them."""

import numpy as np
import pytest
import twins
import warp as wp

from warpshadow.stages.gloss import lobe_hits, mirrored

FLOAT32 = 3e-6  # rounding of unit vectors

# A mirror in the plane x = 1, 2 wide, and a wall without gloss at x = −2, 3.2 wide; normals of the mirror lean.
POSITIONS = np.array(
    [[x, y * half, z * half] for x, half in ((1.0, 1.0), (-2.0, 1.6)) for y in (-1.0, 1.0) for z in (-1.0, 1.0)],
    np.float32,
)
FACES = np.array([[0, 1, 2], [1, 3, 2], [4, 6, 5], [5, 6, 7]], np.int32)
NORMALS = twins.unit(np.array([[-1, 0.2, 0.1], [-1, 0.1, 0], [-1, 0.3, 0.2], [-1, 0.2, -0.1], *[[1, 0, 0]] * 4]))
POINTS = np.array([[0, 0, 0], [0.2, -0.3, 0.1]], np.float32)
UP = np.array([[0, 1, 0]] * 2, np.float32)
DIRECTIONS = twins.unit(
    np.array([[[1, 0.2, 0.1], [-1, 0.1, 0], [0, 1, 0]], [[1, 0.5, 0.3], [1, 0.1, -0.5], [0.4, 0.02, 1]]])
)


def put(values, dtype, device):
    return wp.array(np.asarray(values), dtype=dtype, device=device)


def hits_of(
    device,
    transmittance=0.0,
    points=POINTS,
    normals=UP,
    directions=DIRECTIONS,
    light_of_face=(2, 2, 0, 0),
    reflections=1,
):
    mesh = wp.Mesh(put(POSITIONS, wp.vec3, device), put(FACES.ravel(), wp.int32, device))
    arrays = [put(values, wp.vec3, device) for values in (NORMALS, points, normals, directions)]
    through = wp.full((2, 3), transmittance, dtype=wp.float32, device=device)
    light_of_face, faces = put(light_of_face, wp.int32, device), put([*FACES, *FACES], wp.vec3i, device)
    return lobe_hits.trace_hits(mesh, light_of_face, faces, *arrays, through, reflections), faces


def expected_hits():
    """Whether samples meet the mirror, its normals there, and whether the mirrored rays pass the wall."""
    distance = (1 - POINTS[:, None, 0]) / np.maximum(DIRECTIONS[..., 0], 1e-6)
    y = POINTS[:, None] + distance[..., None] * DIRECTIONS
    meets = (DIRECTIONS[..., 0] > 0) & (np.abs(y[..., 1:]) < 1).all(axis=-1)
    u, v = (y[..., 1] + 1) / 2, (y[..., 2] + 1) / 2
    low = (1 - v - u)[..., None] * NORMALS[0] + v[..., None] * NORMALS[1] + u[..., None] * NORMALS[2]
    high = (1 - u)[..., None] * NORMALS[1] + (u + v - 1)[..., None] * NORMALS[3] + (1 - v)[..., None] * NORMALS[2]
    normals = twins.unit(np.where((u + v < 1)[..., None], low, high))
    towards = DIRECTIONS - 2 * (DIRECTIONS * normals).sum(axis=-1, keepdims=True) * normals
    at_wall = y + ((-2 - y[..., :1]) / np.minimum(towards[..., :1], -1e-6)) * towards
    is_open = (np.abs(at_wall[..., 1:]) > 1.6).any(axis=-1)
    return meets, normals, is_open, towards, y


def test_samples_meet_the_mirror_alone_and_see_what_its_normals_mirror(device):
    hits, _ = hits_of(device)
    meets, normals, is_open, _, places = expected_hits()
    np.testing.assert_array_equal(hits.face_ids.numpy()[0] >= 0, meets)
    assert meets.sum() == 3 and set(is_open[meets]) == {True, False}
    np.testing.assert_allclose(hits.normals.numpy()[0, meets], normals[meets], atol=FLOAT32)
    np.testing.assert_array_equal(hits.last_rays.numpy()[meets] == lobe_hits.MEETS_SKY, is_open[meets])
    assert (hits.last_rays.numpy() != lobe_hits.LEAVES_BELOW).all()
    expected = np.where(meets[..., None], places, POINTS[:, None])
    np.testing.assert_allclose(hits.points.numpy(), expected, atol=FLOAT32)


def test_nothing_is_traced_towards_open_sky(device):
    hits, _ = hits_of(device, transmittance=1.0)
    assert (hits.face_ids.numpy() == -1).all()


def mixed(device, hits, faces, *arrays, radiosity=None):
    """M of all samples, of a light that is the mirrored direction and its blur."""
    roughness, directions, blurs, albedo, metallic, mean, through = arrays
    towards = mirrored.mirror(hits, faces, roughness, directions, blurs)
    light = towards.directions, mean, through, radiosity
    return mirrored.mix_mirrored(hits, faces, albedo, metallic, towards.fresnel_weights, *light), towards


def inputs_of(device):
    rng = np.random.default_rng(0)
    values = [
        (rng.uniform(0.2, 0.6, (1, 8)), wp.float32),
        (DIRECTIONS[None], wp.vec3),
        (rng.uniform(0.1, 0.3, (1, 2, 3)), wp.float32),
        (rng.uniform(0.2, 0.9, (1, 8, 3)), wp.vec3),
        (rng.uniform(0.3, 0.9, (1, 8)), wp.float32),
        (rng.uniform(0.2, 0.9, (1, 2, 3)), wp.vec3),
        (rng.uniform(0.1, 0.9, (1, 2, 3)), wp.float32),
    ]
    return [put(array, dtype, device) for array, dtype in values]


def batched(hits):
    return lobe_hits.LobeHits(*(array.reshape((1, *array.shape)) for array in hits))


def test_metals_send_the_light_that_they_mirror_in_their_color(device):
    hits, faces = hits_of(device)
    arrays = inputs_of(device)
    radiance, towards = mixed(device, batched(hits), faces, *arrays)
    meets, normals, is_open, expected_towards, _ = expected_hits()
    roughness, _, blurs, albedo, metallic, mean, through = (array.numpy()[0] for array in arrays)
    weights, corners = hits.barycentrics.numpy()[0, meets], faces.numpy()[hits.face_ids.numpy()[0, meets]]
    rough, color, share = (
        np.einsum("hc,hc...->h...", weights, values[corners]) for values in (roughness, albedo, metallic)
    )
    grazing = (1 - np.abs((DIRECTIONS * normals).sum(axis=-1)[meets])) ** 5
    blur = np.sqrt(blurs[meets] ** 2 + 2 * rough**4)
    np.testing.assert_allclose(towards.fresnel_weights.numpy()[0, 0][meets], grazing, rtol=1e-4)
    np.testing.assert_allclose(towards.blurs.numpy()[0][meets], blur, rtol=1e-4)
    np.testing.assert_allclose(towards.directions.numpy()[0][meets], expected_towards[meets], atol=FLOAT32)
    of_receivers = np.broadcast_to(mean[:, None], (2, 3, 3))
    seen = np.where(is_open[meets][:, None], expected_towards[meets], of_receivers[meets])
    fresnel = color + (1 - color) * grazing[:, None]
    expected = np.zeros((2, 3, 3))
    expected[meets] = ((1 - through[meets]) * share)[:, None] * (fresnel * seen - of_receivers[meets])
    np.testing.assert_allclose(radiance.numpy()[0], expected, atol=10 * FLOAT32)


def test_bodies_that_are_no_metals_send_the_radiosity_of_the_side_that_samples_meet(device):
    """Of the wall, from its front and, for receivers behind it, from its back."""
    rng, sent = np.random.default_rng(1), []
    radiosity = rng.uniform(size=(1, 8, 3))
    arrays = inputs_of(device)
    arrays[4].zero_()
    for x, forwards in ((0.0, -1.0), (-3.0, 1.0)):
        directions = np.broadcast_to([[[forwards, 0.1, 0.2], [forwards, 0.05, 0.1], [0, 1, 0]]], (2, 3, 3))
        points = POINTS + np.float32([x, 0, 0])
        hits, faces = hits_of(
            device, points=points, directions=twins.unit(directions.copy()), light_of_face=(0, 0, 1, 1)
        )
        radiance, _ = mixed(device, batched(hits), faces, *arrays, radiosity=put(radiosity, wp.vec3, device))
        numbers = hits.face_ids.numpy()[0]
        assert (numbers[:, :2] >= 2).all() and (numbers[:, 2] == -1).all()
        sent.append(numbers[:, :2] // 4)
        mean, through = arrays[5].numpy()[0], arrays[6].numpy()[0]
        expected = (1 - through[..., None]) * (radiosity[0][numbers] - mean[:, None])
        np.testing.assert_allclose(radiance.numpy()[0, :, :2], expected[:, :2], atol=10 * FLOAT32)
    assert (sent[0] != sent[1]).all()


@pytest.mark.parametrize("wall", [lobe_hits.SENDS, lobe_hits.MIRRORS, 0])
def test_a_metal_shows_the_body_that_it_mirrors(wall, device):
    """The wall, which sends its radiosity, or mirrors the sky past the mirror; else the mean radiance of blockers."""
    directions = twins.unit(np.array([[[1, -0.2, 0], [1, -0.3, -0.1], [1, -0.4, 0.1]]] * 2))
    towards_mirror = np.array([[1.0, 0, 0]] * 2)
    hits, faces = hits_of(
        device, 0.0, POINTS, towards_mirror, directions, light_of_face=(2, 2, wall, wall), reflections=2
    )
    arrays, radiosity = inputs_of(device), np.random.default_rng(1).uniform(size=(1, 8, 3))
    arrays[1] = put(directions[None], wp.vec3, device)
    radiance, towards = mixed(device, batched(hits), faces, *arrays, radiosity=put(radiosity, wp.vec3, device))
    roughness, _, blurs, albedo, metallic, mean, through = (array.numpy()[0] for array in arrays)
    numbers, corners = hits.face_ids.numpy(), faces.numpy()[hits.face_ids.numpy()]
    assert np.isin(numbers[0], (0, 1)).all() and (np.isin(numbers[1], (2, 3)) == (wall != 0)).all()
    values = (roughness, albedo, metallic)
    barycentrics = np.where(numbers[..., None] >= 0, hits.barycentrics.numpy(), 0)
    rough, color, share = (np.einsum("krsc,krsc...->krs...", barycentrics, array[corners]) for array in values)
    ray, fresnel = directions, []
    for normals, is_met in zip(hits.normals.numpy(), numbers >= 0, strict=True):
        cosines = np.where(is_met, (ray * normals).sum(axis=-1), 0)[..., None]
        fresnel.append((1 - np.abs(cosines)) ** 5)
        ray = ray - 2 * cosines * np.where(is_met[..., None], normals, 0)
    np.testing.assert_allclose(towards.directions.numpy()[0], ray, atol=FLOAT32)
    blur = np.sqrt(blurs**2 + 2 * (rough**4).sum(axis=0))
    np.testing.assert_allclose(towards.blurs.numpy()[0], blur, rtol=1e-5)
    last, means = hits.last_rays.numpy()[..., None], np.broadcast_to(mean[:, None], (2, 3, 3))
    expected_rays = {lobe_hits.MEETS_BODY} | ({lobe_hits.MEETS_SKY} if wall == lobe_hits.MIRRORS else set())
    assert set(last.ravel()) == expected_rays
    seen = np.where(last == lobe_hits.MEETS_SKY, ray, np.where(last == lobe_hits.LEAVES_BELOW, 0, means))
    for k in (1, 0):
        mirrored_light = (color[k] + (1 - color[k]) * fresnel[k]) * seen
        shown = share[k][..., None] * mirrored_light + (1 - share[k][..., None]) * radiosity[0][numbers[k]]
        seen = np.where((numbers[k] >= 0)[..., None], shown, seen)
    expected = (1 - through[..., None]) * (seen - means)
    np.testing.assert_allclose(radiance.numpy()[0], expected, atol=10 * FLOAT32)


def test_no_light_comes_from_below_the_face_that_a_ray_leaves(device):
    points = np.array([[0.98, -0.5, 0], [1, 0.05, 0.02]], np.float32)  # before the mirror, and on it
    towards_mirror = [[0.3, 1, 0], [0.05, 1, 0], [1, 0.1, 0]]  # below it once mirrored; behind its normal; straight on
    directions = twins.unit(np.array([towards_mirror, [[0.05, 1, 0.3], [-0.5, 1, 0], [-1, 0, 0]]], float))
    normals = twins.unit(np.array([[0.0, 1, 0], [-1, 0.2, 0.1]]))
    hits, faces = hits_of(device, 0.0, points, normals, directions)
    is_below = np.array([[True, True, False], [True, False, False]])
    np.testing.assert_array_equal(hits.last_rays.numpy() == lobe_hits.LEAVES_BELOW, is_below)
    np.testing.assert_array_equal(hits.face_ids.numpy()[0, is_below] >= 0, [True, True, False])
    arrays = inputs_of(device)
    metallic, mean, through = (array.numpy()[0] for array in arrays[4:])
    radiance = mixed(device, batched(hits), faces, *arrays)[0].numpy()[0]
    weights, corners = hits.barycentrics.numpy()[0, 0, :2], FACES[hits.face_ids.numpy()[0, 0, :2]]
    shares = np.append((weights * metallic[corners]).sum(axis=1), 1.0)
    expected = -((1 - through[is_below]) * shares)[:, None] * mean[[0, 0, 1]]
    np.testing.assert_allclose(radiance[is_below], expected, atol=10 * FLOAT32)
