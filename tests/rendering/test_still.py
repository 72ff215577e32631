"""Stills: pictures that are made once, by rays that all receivers share."""

import dataclasses

import numpy as np
import pytest
import trimesh
import warp as wp

import warpshadow as ws
from warpshadow.pipeline.receivers.choice_of_receivers import for_still
from warpshadow.scene.visibility import SHARED_DIRECTIONS
from warpshadow.spheres import Spheres
from warpshadow.stages.light.light_samples import cut_map
from warpshadow.stages.ray_traced.shared_rays import TOLERANCE, Corners, find_light_shares, trace_shared
from warpshadow.stages.rays.ray_packets import build_face_tree
from warpshadow.stages.rays.ray_tracing import trace_visibility

# Error of a still, 512 directions, against 4096 independent rays.
STILL_ERROR = 0.03

# The same with bounces, of a small image whose ground is lit by a sun.
BOUNCED_ERROR = 0.045

SKY = ws.synthetic_sky()


def scene(size=64, **options):
    ball = ws.Body(ws.icosphere(1.0, 3), (0.8, 0.4, 0.2)).on_ground(size=2)
    ground = ws.Body(ws.infinite_ground(6.0), (0.4, 0.4, 0.4))
    camera = ws.Camera.framing(ball, size=(size, size))
    return ws.Scene([ball, ground], SKY, camera, **options)


def error(image, truth):
    return np.linalg.norm((image - truth)[..., :3]) / np.linalg.norm(truth[..., :3])


def test_a_white_surface_that_nothing_blocks_gets_all_light_of_a_map():
    for light in (SKY, ws.EnvironmentMap.constant(1.0, height=1), ws.EnvironmentMap(SKY.radiance[::4, ::4])):
        samples, times = cut_map(light.radiance, 512), -(-512 // len(light.radiance))
        for normal in np.eye(3):
            received = (samples.radiance[0] * np.maximum(samples.directions[0] @ normal, 0)[:, None]).sum(axis=0)
            fine = ws.EnvironmentMap(light.radiance.repeat(times, axis=0).repeat(times, axis=1))
            cosine = np.maximum(fine.directions().astype(float) @ normal, 0) * fine.solid_angles()[:, None]
            np.testing.assert_allclose(received, (fine.radiance * cosine[..., None]).sum(axis=(0, 1)), rtol=0.01)


@pytest.mark.parametrize("rows", [2, 64, 75, 600])
def test_open_level_ground_gets_all_light_above_its_horizon(rows):
    even = ws.EnvironmentMap.constant(1.0, height=rows).radiance

    def find_upper_shares(samples):
        cosine = np.maximum(samples.directions[0, :, 1], 0)
        return cosine / cosine.sum()

    for find in (None, find_upper_shares):
        samples = cut_map(even, 512, find)
        received = samples.radiance[0, :, 0] @ np.maximum(samples.directions[0, :, 1], 0)
        np.testing.assert_allclose(received, np.pi, rtol=1e-3)


def test_packets_give_each_receiver_what_single_rays_do(device):
    mesh = ws.icosphere(1.0, 3)
    rng = np.random.default_rng(0)
    points = rng.normal(size=(100, 3)).astype(np.float32)
    normals = (points / np.linalg.norm(points, axis=1, keepdims=True))[::-1].copy()
    samples = cut_map(SKY.radiance, 64)
    at, facing, towards = (wp.array(v, dtype=wp.vec3, device=device) for v in (points, normals, samples.directions[0]))
    tree = build_face_tree(mesh.positions, mesh.faces, device)
    shading = trace_shared(tree, at, facing, samples).numpy()
    numbers = wp.array(mesh.faces.ravel(), dtype=wp.int32, device=device)
    traced = wp.Mesh(wp.array(mesh.positions, dtype=wp.vec3, device=device), numbers)
    visible = trace_visibility(traced, at.reshape((1, -1)), facing.reshape((1, -1)), towards).numpy()[0]
    cosine = np.maximum(normals @ samples.directions[0].T, 0)
    np.testing.assert_allclose(shading, (visible * cosine) @ samples.radiance[0] / np.pi, rtol=1e-3, atol=1e-3)


def test_receivers_between_corners_get_the_light_that_they_get_alone(device):
    """In a square under a ball's edge."""
    ball = ws.icosphere(0.5, 3)
    tree = build_face_tree(ball.positions + np.float32([0, 1, 0]), ball.faces, device)
    x, z = (axis.ravel() for axis in np.meshgrid(np.linspace(0, 1, 5), np.linspace(0, 1, 5), indexing="ij"))
    corner = np.flatnonzero(np.isin(x, (0, 1)) & np.isin(z, (0, 1)))
    points = np.stack([0.3 + 0.1 * x, 0 * x, 0.1 * z], axis=1).astype(np.float32)
    weights = np.stack([(1 - x) * (1 - z), (1 - x) * z, x * (1 - z), x * z], axis=1)
    receivers = np.tile(corner, (len(x), 1))
    receivers[corner] = -1
    at, up = (wp.array(v, dtype=wp.vec3, device=device) for v in (points, np.tile([[0, 1, 0]], (len(x), 1))))
    samples = cut_map(SKY.radiance, 512)
    alone = trace_shared(tree, at, up, samples).numpy()
    together = trace_shared(tree, at, up, samples, corners=Corners(receivers, weights)).numpy()
    np.testing.assert_allclose(together[corner], alone[corner], rtol=1e-5)
    assert np.abs(together - alone).sum(axis=1).max() < TOLERANCE * alone.sum(axis=1).max()
    assert np.abs(together - alone).max() > 1e-5  # some visibility is interpolated
    wrong = trace_shared(tree, at, up, samples, corners=Corners(receivers, 0 * weights)).numpy()
    np.testing.assert_allclose(wrong, alone, rtol=1e-4)  # nothing is, where the tolerance is 0: all doubts are traced


def test_a_still_is_that_of_all_rays_at_all_receivers(monkeypatch):
    monkeypatch.setattr("warpshadow.stages.ray_traced.shared_rays.SQUARES", 32)  # of 2 × 2 pixels
    image = ws.render(scene(64))
    monkeypatch.setattr("warpshadow.pipeline.methods.ray_traced.find_corners", lambda *_: None)
    assert 0 < error(image, ws.render(scene(64))) < 0.005


def test_a_still_does_not_add_up_light_that_is_not_traced_yet(monkeypatch):
    empty = wp.empty

    def huge(*args, **kwargs):
        array = empty(*args, **kwargs)
        if array.dtype == wp.vec3:
            array.fill_(3e38)
        return array

    monkeypatch.setattr(wp, "empty", huge)
    with np.errstate(over="raise"):
        assert np.isfinite(ws.render(scene(size=256))).all()


def test_directions_go_where_receivers_see_light():
    lid = ws.plane(2.0, segments=1)
    lid = np.concatenate([lid.positions[lid.faces] + [x, 0.5, 0] for x in (-1.2, 1.2)]).reshape(-1, 3)
    tree = build_face_tree(lid, np.arange(len(lid)).reshape(-1, 3))
    points = np.zeros((5, 3), np.float32)
    points[:, 2] = np.linspace(-0.2, 0.2, 5)
    at, facing = (wp.array(v, dtype=wp.vec3, device="cpu") for v in (points, np.tile([[0, 1, 0]], (5, 1))))
    even = ws.EnvironmentMap.constant(1.0).radiance
    plain = cut_map(even, 256)
    shares = find_light_shares(tree, at, facing, plain)
    np.testing.assert_allclose(shares.sum(), 1, rtol=1e-5)
    assert (shares[plain.directions[0, :, 1] < 0] == 0).all()
    aimed = cut_map(even, 256, lambda samples: find_light_shares(tree, at, facing, samples))
    assert np.count_nonzero(find_light_shares(tree, at, facing, aimed)) > 1.5 * np.count_nonzero(shares)
    np.testing.assert_allclose(aimed.radiance.sum(), plain.radiance.sum(), rtol=0.02)


@pytest.mark.parametrize("size", [1.0, 1e-3])
def test_leaves_of_an_infinite_ground_do_not_widen_others(size):
    ground, ball = ws.infinite_ground(6.0), ws.icosphere(size, 2)
    positions = np.concatenate([ground.positions, ball.positions])
    tree = build_face_tree(positions, np.concatenate([ground.faces, ball.faces + ground.vertex_count]))
    lowers, uppers = tree.lowers.numpy()[tree.leaf_count :], tree.uppers.numpy()[tree.leaf_count :]
    corners = tree.corners.numpy()
    starts = np.arange(tree.leaf_count) * len(corners) // tree.leaf_count
    extent = np.maximum.reduceat(corners.max(axis=1), starts) - np.minimum.reduceat(corners.min(axis=1), starts)
    assert np.median((uppers - lowers - extent).max(axis=1) / extent.max(axis=1)) < 1e-4


@pytest.mark.parametrize(("supersampling", "size"), [(1, 64), (3, 32)])
def test_a_still_is_within_three_percent_of_rays(supersampling, size):
    rays = ws.Visibility("ray-traced", samples=4096 * supersampling**2)
    truth = ws.render(scene(size, visibility=rays, supersampling=supersampling))
    assert error(ws.render(scene(size, supersampling=supersampling)), truth) < STILL_ERROR


def test_a_still_with_bounces_is_near_paths():
    red = scene(48).bodies[1]
    bodies = scene(48).bodies[0], dataclasses.replace(red, albedo=(0.9, 0.2, 0.1))
    given = dataclasses.replace(scene(48, bounces="all"), bodies=bodies)
    truth = ws.render(dataclasses.replace(given, visibility=ws.Visibility("ray-traced", samples=4096)))
    assert error(ws.render(given), truth) < BOUNCED_ERROR


def test_a_still_fits_no_spheres_and_traces_no_tables(monkeypatch):
    def refuse(*_, **__):
        raise AssertionError("a still asked for it")

    monkeypatch.setattr("warpshadow.scene.blockers.fit_spheres", refuse)
    monkeypatch.setattr("warpshadow.pipeline.bodies.self_visibility.SelfVisibility.rows", refuse)
    assert np.isfinite(ws.render(scene(16))).all()


def test_a_still_does_not_depend_on_what_the_cache_holds():
    before = ws.render(scene(32))
    ws.Renderer(scene(32)).render()  # which keeps spheres and tables
    np.testing.assert_array_equal(ws.render(scene(32)), before)


def test_a_method_that_is_named_is_obeyed():
    named = scene(16, visibility=ws.Visibility("directional"))
    assert for_still(named).visibility.method == "directional"
    kept = ws.Renderer(scene(16)).render()
    np.testing.assert_array_equal(ws.Renderer(named).render(), kept)
    by_rays = scene(16, visibility=ws.Visibility("ray-traced", samples=64))
    assert for_still(by_rays).visibility is by_rays.visibility


@pytest.mark.parametrize("setting", [{"directions": 64}, {"softness": 0.5}, {"self_shadows": "spheres"}])
def test_a_setting_that_directional_alone_reads_names_it(setting):
    assert ws.Visibility(**setting).method == "directional"
    assert dataclasses.replace(ws.Visibility(), **setting).method == "directional"


def test_settings_that_both_read_name_nothing():
    for count in (64, 1024):
        visibility = dataclasses.replace(ws.Visibility(), samples=count)
        assert visibility.method is None
        still = for_still(scene(16, visibility=visibility)).visibility
        assert (still.ray_count, still.sampling) == (count, "shared")
    assert for_still(scene(16)).visibility.ray_count == SHARED_DIRECTIONS


@pytest.mark.parametrize("own", [{"self_shadows": "spheres"}, {"blockers": Spheres([[0, 0, 0]], [1.0])}])
def test_what_a_body_says_of_its_spheres_names_directional(own):
    given = scene(16)
    bodies = (dataclasses.replace(given.bodies[0], **own), given.bodies[1])
    assert for_still(dataclasses.replace(given, bodies=bodies)).visibility.method == "directional"


def test_a_scene_that_names_no_method_reads_back_so(tmp_path):
    ws.write_scene(scene(16), tmp_path)
    assert "method" not in (tmp_path / "scene.toml").read_text()
    assert ws.load_scene(tmp_path / "scene.toml").visibility.method is None


def test_a_shadow_catcher_far_from_all_bodies_has_no_shadow_and_no_noise():
    ball = ws.Body(ws.icosphere(1.0, 3)).on_ground(size=2)
    ground = ws.Body(ws.infinite_ground(6.0), shadow_catcher=True)
    camera = ws.Camera.look_at((0, 30, 60), (0, 0, 0), fov_y=60, size=(64, 64))
    image = ws.render(ws.Scene([ball, ground], ws.EnvironmentMap.constant(1.0), camera))
    assert image[40:, :8, 3].max() < 0.01
    assert image[..., 3].max() > 0.5


def test_a_still_of_nothing_is_empty():
    given = scene(16)
    away = ws.Camera.look_at((0, 50, 0), (0, 100, 0), up=(0, 0, 1), size=(16, 16))
    assert not ws.render(dataclasses.replace(given, camera=away)).any()


def test_light_of_nan_is_refused():
    coefficients = np.full((9, 3), np.nan)
    with pytest.raises(ValueError, match="NaN"):
        ws.render(dataclasses.replace(scene(16), light=coefficients))


def test_more_samples_a_pixel_resolve_bumps_and_edges():
    """Bumps smaller than a pixel: every sample has its own normal where a pixel has more than 2 × 2."""
    size = 40
    x, z = np.meshgrid(np.linspace(-1, 1, size), np.linspace(-1, 1, size), indexing="ij")
    positions = np.stack([x, 0.01 * np.sin(40 * x) * np.cos(40 * z), z], axis=-1).reshape(-1, 3)
    first = (np.arange(size - 1)[:, None] * size + np.arange(size - 1)).ravel()
    quads = np.stack([first, first + 1, first + size + 1, first + size], axis=1)
    bumps = ws.Body(ws.Mesh(positions, np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])))
    camera = ws.Camera.look_at((0, 2, 1), (0, 0, 0), size=(12, 12))
    light = ws.EnvironmentMap(np.linspace(0.2, 2.0, 16)[None, :, None] * np.ones((8, 16, 3)))
    given = ws.Scene([bumps], light, camera, supersampling=8)
    rays = dataclasses.replace(given, visibility=ws.Visibility("ray-traced", samples=65536))
    still, reference = ws.render(given), ws.render(rays)
    assert np.linalg.norm(still - reference) < 0.01 * np.linalg.norm(reference)


def test_a_still_of_a_post_has_the_light_of_a_finer_one():
    """Its faces are narrower than a sample, and light jumps between them: without smooth creases it is 9.8% off."""
    turns = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    rims = [np.stack([np.cos(turns), 0 * turns + height, -np.sin(turns)], axis=1) for height in (-20, 20)]
    first, second = np.arange(12), (np.arange(12) + 1) % 12
    triangles = [(first, second, first + 12), (second, second + 12, first + 12)]
    faces = np.concatenate([np.stack(corners, axis=1) for corners in triangles])
    mesh = ws.Mesh(np.concatenate(rims).astype(np.float32), faces.astype(np.int32)).creased(20.0)
    light = ws.synthetic_sky((0.8, 0.3, 0.35))

    def still(size, shift):
        post = ws.Body(mesh, scale=0.05, translation=(shift, 0, 0))
        camera = ws.Camera.look_at((0, 0, 5), (0, 0, 0), fov_y=18, size=(size, size))
        return ws.render(ws.Scene([post], light, camera), progress=False)

    errors = []
    for shift in np.linspace(0, 0.05, 5, endpoint=False):
        fine = still(320, shift).reshape(32, 10, 32, 10, 4).mean(axis=(1, 3))
        errors.append(error(still(32, shift), fine))
    assert np.mean(errors) < 0.02


def test_small_stills_resolve_shadows_that_are_thinner_than_pixels():
    posts = [trimesh.creation.box((0.015, 0.6, 0.015)).apply_translation((x, 0.3, 0)) for x in np.linspace(-1, 1, 33)]
    fence = ws.Body(trimesh.util.concatenate(posts), (0.5, 0.5, 0.5)).creased()
    ground = ws.Body(ws.infinite_ground(6.0), (0.5, 0.5, 0.5))
    camera = ws.Camera.look_at((0, 2, 2), (0, 0, 0.3), fov_y=40, size=(48, 48))
    scene = ws.Scene([fence, ground], ws.synthetic_sky((0.3, 0.6, -0.7)), camera)
    fine, coarse = (ws.render(dataclasses.replace(scene, supersampling=count)) for count in (8, 2))
    assert error(coarse, fine) < 0.07
