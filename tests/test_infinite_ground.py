"""A ground to the horizon: where it ends, how deep it is, what stands on it, and its light."""

import dataclasses

import numpy as np
import pytest

import warpshadow as ws
from warpshadow.scene.files import write_scene
from warpshadow.stages.patches import find_plane_patches

SIZE = 2.0
SKY = ws.synthetic_sky()
BALL = ws.Body(ws.icosphere(0.5, 3), blockers=ws.Spheres([[0, 0, 0]], [0.5]), translation=(0, 0.5, 0), name="ball")
SIDE_ON = ws.Camera.look_at((0, 1, 4), (0, 0.6, 0), size=(64, 48))


def ground(**given):
    return ws.Body(ws.infinite_ground(SIZE), albedo=(0.7, 0.5, 0.3), name="ground", **given)


def scene_of(*bodies, camera=SIDE_ON, method="none", **given):
    return ws.Scene(bodies, SKY, camera, ws.Visibility(method), **given)


# ---------------------------------------------------------------------------------------------- the horizon

CAMERAS = {
    "level": {"target": (0, 2, -1)},
    "down": {"target": (0.4, 1.8, -1)},
    "up": {"target": (-2, 2.4, -1)},
    "tilted": {"target": (1, 1.8, -1), "up": (0.5, 1, 0)},
    "away from the middle": {"eye": (40, 2, 30), "target": (39, 1.7, 31)},
    "narrow": {"target": (0, 2, -1), "fov_y": 2.0},
}


@pytest.mark.filterwarnings("ignore:fov_y")
@pytest.mark.parametrize("view", CAMERAS.values(), ids=CAMERAS)
def test_it_fills_all_below_the_horizon_and_is_as_deep_as_its_plane(view):
    camera = ws.Camera.look_at(**({"eye": (0, 2, 0), "size": (96, 128)} | view))
    layers = ws.Renderer(scene_of(ground(), camera=camera)).layers()
    eye, directions = camera.rays()
    pixel = 1 / camera.intrinsics[0, 0]
    edge = eye[1] / (1e4 * SIZE)  # angle from its end to the horizon
    below = directions[..., 1] < -pixel - 2 * edge
    assert below.any() and (~below).any()
    assert (layers.bodies[below] == 0).all() and (layers.bodies[directions[..., 1] > pixel] == -1).all()
    np.testing.assert_allclose(layers.masks[0][below], 1, atol=1e-6)
    depths = -eye[1] / directions[..., 1] * (directions @ camera.rotation[2])
    np.testing.assert_allclose(layers.depth[below], depths[below], rtol=1e-4)
    np.testing.assert_allclose(layers.normals[below], np.broadcast_to((0, 1, 0), (below.sum(), 3)), atol=1e-6)


@pytest.mark.parametrize("distance", [3.0, 300.0, 3000.0])
def test_what_stands_on_it_hides_it_as_far_as_it_reaches(distance):
    """A ball whose radius is a sixth of its distance, against the rays that meet it."""
    radius = distance / 6
    ball = dataclasses.replace(BALL, scale=2 * radius, translation=(0, radius, -distance))
    camera = ws.Camera.look_at((0, distance / 4, 0), ball.translation, size=(96, 96), near=0.01)
    bodies = ws.Renderer(scene_of(ball, ground(), camera=camera)).layers().bodies
    eye, directions = camera.rays()
    nearest = np.linalg.norm(np.cross(ball.translation - eye, directions), axis=-1)
    assert (bodies[nearest < 0.985 * radius] == 0).all()
    outside = (nearest > 1.01 * radius) & (directions[..., 1] < -0.02 - eye[1] / (1e4 * SIZE))
    assert outside.any() and (bodies[outside] == 1).all()


# ---------------------------------------------------------------------------------------------- its light


@pytest.mark.parametrize(
    ("method", "bounces", "tilt"),
    [("directional", 0, 0), ("directional", 2, 20), ("log-sh", 2, 0), ("ray-traced", 2, 0)],
)
def test_near_bodies_its_light_is_that_of_a_wide_plane(method, bounces, tilt):
    """Rays end at the plane's edge, one percent of its radius above the horizon, where the map has one row."""
    up = np.array([-np.sin(np.radians(tilt)), np.cos(np.radians(tilt)), 0])
    ball = dataclasses.replace(BALL, translation=0.5 * up)
    wide = ws.Body(ws.plane(200.0, 1), albedo=(0.7, 0.5, 0.3), name="ground", receivers="pixel")
    images = [
        ws.render(scene_of(ball, dataclasses.replace(each, rotation=(0, 0, tilt)), method=method, bounces=bounces))
        for each in (ground(receivers="pixel"), wide)
    ]
    near = np.s_[26:, :, :3]
    found, expected = (image[near] for image in images)
    assert np.abs(found - expected).mean() < 0.015 * expected.mean()


def test_its_shadow_is_right_with_the_receivers_that_are_chosen():
    scene = scene_of(BALL, ground(), method="directional")
    chosen, by_pixel = (
        ws.render(dataclasses.replace(scene, bodies=(BALL, body)))[26:, :, :3]
        for body in (ground(), ground(receivers="pixel"))
    )
    assert np.abs(chosen - by_pixel).mean() < 0.01 * by_pixel.mean()


@pytest.mark.parametrize("away", [0.0, 30.0])
def test_its_patches_are_few_and_all_have_pieces(away):
    mesh = ws.infinite_ground(SIZE)
    others = BALL.mesh.positions + np.float32([away, 1, 0.3 * away])
    patches = find_plane_patches(mesh.positions, mesh.surface.faces, is_two_sided=False, others=others)
    pieces = np.bincount(patches.patch_of_pieces[0], minlength=patches.count)
    assert (pieces[patches.areas > 0] > 0).all()
    assert mesh.face_count < pieces.sum() < 100_000
    corners = patches.pieces.positions(mesh.positions, mesh.surface.faces)
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    np.testing.assert_allclose(areas.sum(), np.pi * (1e4 * SIZE) ** 2, rtol=0.01)
    found = np.bincount(patches.patch_of_pieces[0], areas, patches.count)
    near = (np.linalg.norm(patches.centers - others.mean(axis=0), axis=1) < 20) & (patches.areas > 0)
    assert np.abs(found - patches.areas)[near].sum() < 0.1 * patches.areas[near].sum()


# ---------------------------------------------------------------------------------------------- its uses


def test_a_photograph_gets_a_shadow_on_it_and_keeps_what_is_far():
    photograph = np.random.default_rng(0).uniform(0.2, 0.8, (48, 64, 3)).astype(np.float32)
    found = ws.insert(scene_of(BALL, ground(shadow_catcher=True), method="directional"), photograph)
    ratio = found / photograph
    _, directions = SIDE_ON.rays()
    assert np.isfinite(found).all()
    mask = ws.Renderer(scene_of(BALL)).layers().masks[0] > 0
    sky, far = directions[..., 1] > 0.03, (directions[..., 1] < -0.03) & (directions[..., 1] > -0.06)
    assert (sky & ~mask).any() and (far & ~mask).any()
    np.testing.assert_allclose(ratio[sky & ~mask], 1, atol=1e-6)
    np.testing.assert_allclose(ratio[far & ~mask], 1, atol=0.05)
    beside = ~mask & (directions[..., 1] < -0.15)
    assert ratio[beside].min() < 0.7


def test_scene_files_have_it_and_keep_it(tmp_path):
    path = tmp_path / "scene.toml"
    path.write_text("""
        camera = {framing = "auto", size = [32, 32]}
        light = {sh = [[1, 1, 1], [0, 0, 0], [0, 0, 0], [0, 0, 0]]}
        [[body]]
        primitive = "icosphere"
        on_ground = true
        [[body]]
        primitive = "infinite_ground"
        size = 3.0
        segments = 16
    """)
    scene = ws.load_scene(path)
    np.testing.assert_array_equal(scene.bodies[1].mesh.positions, ws.infinite_ground(3.0, 16).positions)
    assert np.linalg.norm(scene.camera.eye) < 10  # it frames the ball
    write_scene(scene, tmp_path / "again")
    again = ws.load_scene(tmp_path / "again" / "scene.toml").bodies[1].mesh
    assert again.content_hash == scene.bodies[1].mesh.content_hash
