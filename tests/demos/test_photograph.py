"""The photograph of the demo: taken as it says, and explained by the fit files that go with it."""

import dataclasses

import numpy as np
import pytest
from PIL import Image

import warpshadow as ws
from demos.examples import photograph as demo
from warpshadow.assets.color import srgb_to_linear
from warpshadow.inverse.fit_file import load_fit
from warpshadow.scene.files import write_scene

EXPOSURE = 0.3
RADIUS = 0.8
BALL, GROUND = 0, 1

FIT = """\
scene = "scene.toml"
[[target]]
image = "photo.jpg"
mask = "mask.png"
[free]
exposure = true
[[free.pose]]
body = 0
[loss]
kind = "huber"
[[stage]]
iterations = 150
learning_rate = 0.05
"""


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def shot(camera, path, light, rng):
    """A photograph of light, as a fit reads it."""
    camera.shoot(path, light, rng)
    return ws.read_image(path)


def gray_ramp(size=64):
    """From black to a fifth above white, so slow that blur does not change it."""
    return np.repeat(np.linspace(0, 1.2, size)[None, :, None], size, axis=0).repeat(3, axis=2)


# ---------------------------------------------------------------------------------------------- the camera


def test_a_photograph_is_an_8_bit_jpeg(tmp_path, rng):
    demo.PhotoCamera().shoot(tmp_path / "photo.jpg", gray_ramp(), rng)
    with Image.open(tmp_path / "photo.jpg") as picture:
        assert (picture.format, picture.mode, picture.size) == ("JPEG", "RGB", (64, 64))
        coarse = picture.quantization[0]
    demo.PhotoCamera(quality=95).shoot(tmp_path / "photo.jpg", gray_ramp(), rng)
    with Image.open(tmp_path / "photo.jpg") as picture:
        assert sum(picture.quantization[0]) < sum(coarse)


def test_a_photograph_decodes_to_the_light_within_noise_and_clips_at_white(tmp_path, rng):
    light = gray_ramp()
    photograph = shot(demo.PhotoCamera(), tmp_path / "photo.jpg", light, rng)
    difference = photograph - np.minimum(light, 1)
    shot_noise = np.sqrt(1 / demo.PhotoCamera().full_well)  # at white
    assert abs(difference.mean()) < 0.1 * shot_noise
    assert 0.2 * shot_noise < difference.std() < 1.5 * shot_noise
    assert photograph.max() <= 1
    assert (photograph[light > 1.1] > demo.SATURATED).all()


def test_noise_falls_with_the_electrons_of_a_pixel(tmp_path, rng):
    gray = np.full((64, 64, 3), 0.4)
    levels = []
    for full_well in (400.0, 6400.0):
        camera = demo.PhotoCamera(full_well=full_well, read_noise=0.0, quality=100)
        levels.append(shot(camera, tmp_path / "photo.jpg", gray, rng)[..., 1].std())
    assert levels[0] == pytest.approx(4 * levels[1], rel=0.2)
    read = shot(demo.PhotoCamera(1.0, 400.0, 20.0, 100), tmp_path / "photo.jpg", gray, rng)[..., 1].std()
    assert read > 1.2 * levels[0]


def test_the_lens_spreads_an_edge_over_pixels(tmp_path, rng):
    edge = np.full((64, 64, 3), 0.1)
    edge[:, 32:] = 0.6
    profiles = []
    for blur in (0.01, 2.0):
        camera = demo.PhotoCamera(blur, 1e6, 0.0, 100)
        profiles.append(shot(camera, tmp_path / "photo.jpg", edge, rng)[..., 1].mean(axis=0))
    sharp, soft = profiles
    assert np.abs(sharp - edge[0, :, 1]).max() < 0.02
    assert 0.15 < soft[31] < soft[32] < 0.55
    np.testing.assert_allclose([soft[16], soft[48]], [0.1, 0.6], atol=0.01)


def test_a_mask_leaves_out_what_has_no_body_what_saturates_and_what_is_blurred_into_others():
    coverage, photograph = np.ones((12, 12)), np.full((12, 12, 3), 0.5)
    coverage[:, :2] = 0.5
    photograph[8, 8, 2] = srgb_to_linear(np.float64(252 / 255))
    mask = demo.make_mask(coverage, photograph)
    assert mask.dtype == np.float32
    assert not mask[:, :4].any()  # two pixels beyond the edge
    near = np.abs(np.indices((12, 12)) - 8).sum(axis=0) <= 2
    assert not mask[near].any()
    near[:, :4] = True
    assert (mask[~near] == 1).all()


def test_where_no_body_is_a_camera_sees_the_light(rng):
    light = ws.EnvironmentMap(rng.uniform(0, 1, (16, 32, 3)).astype(np.float32))
    up = ws.Camera.look_at((0, 0, 0), (0, 1, 0), up=(0, 0, 1), fov_y=2, size=(2, 2))
    top = light.radiance[0].reshape(-1, 3)
    for color in demo.backdrop(up, light).reshape(-1, 3):
        assert (np.abs(top - color).max(axis=1) == 0).any()
    aside = ws.Camera.look_at((0, 0, 0), light.directions()[5, 7], fov_y=0.1, size=(1, 1))
    np.testing.assert_array_equal(demo.backdrop(aside, light)[0, 0], light.radiance[5, 7])


# ---------------------------------------------------------------------------------------------- the recipe


@pytest.fixture(scope="module")
def truth():
    """A ball on a ground, 48 pixels across and down."""
    ball = ws.Body(
        ws.icosphere(RADIUS, 3),
        (0.7, 0.5, 0.4),
        blockers=ws.Spheres(np.zeros((1, 3)), [RADIUS]),
        translation=(0, RADIUS, 0),
    )
    sky = ws.synthetic_sky(demo.SUN, sun_strength=2.0, sun_radius=5.0, height=64)
    camera = ws.Camera.look_at((1.6, 2.6, 4.6), (0, 0.5, 0), fov_y=36, size=(48, 48))
    return ws.Scene((ball, ws.Body(ws.plane(5.0, 20), (0.5, 0.5, 0.5))), sky, camera)


@pytest.mark.slow
def test_exposure_and_place_are_found_in_a_photograph(truth, tmp_path, rng):
    visibility = ws.Visibility(method="ray-traced", samples=256)
    traced = ws.render(dataclasses.replace(truth, visibility=visibility))
    light = EXPOSURE * (traced[..., :3] + (1 - traced[..., 3:]) * demo.backdrop(truth.camera, truth.light))
    photograph = shot(demo.PhotoCamera(), tmp_path / "photo.jpg", light, rng)
    ws.write_image(tmp_path / "mask.png", demo.make_mask(traced[..., 3], photograph))
    away = demo.changed(truth, BALL, translation=(0.25, RADIUS + 0.2, -0.2))
    write_scene(away, tmp_path)
    (tmp_path / "fit.toml").write_text(FIT)

    found = load_fit(tmp_path / "fit.toml").run().found
    ball = found.scene.bodies[BALL]
    middle = ball.to_world(np.mean(ball.mesh.bounds, axis=0))
    assert np.linalg.norm(middle - (0, RADIUS, 0)) < 0.02 * 2 * RADIUS
    assert found.exposures[0] == pytest.approx(EXPOSURE, rel=0.03)


def test_the_files_of_the_recipe_say_what_is_free_and_go_on_from_each_other(truth, tmp_path, rng):
    scene = demo.changed(truth, BALL, albedo=(0.5, 0.5, 0.5))
    (tmp_path / "shadows" / "pose").mkdir(parents=True)
    demo.PhotoCamera().shoot(tmp_path / "photo.jpg", np.full((48, 48, 3), 0.5), rng)
    ws.write_image(tmp_path / "mask.png", np.ones((48, 48)))
    demo.write_recipe(tmp_path / "shadows", scene, "photo.jpg")
    write_scene(scene, tmp_path / "shadows" / "pose")
    pose, reflectance = (load_fit(tmp_path / "shadows" / f"{step}.toml").problem for step in ("pose", "reflectance"))
    assert {free.name for free in pose.free} == {"exposure", "pose[0]", "albedo[0]", "albedo[1]"}
    assert {free.name for free in reflectance.free} == {"exposure", "albedo[0]", "texture[1]"}
    assert reflectance.visibility.method == "ray-traced"
    assert pose.visibility.method == "directional"
    np.testing.assert_array_equal(pose.cameras()[0].intrinsics, truth.camera.intrinsics)


def test_the_camera_of_the_demo_is_that_of_its_lens():
    camera = demo.true_scene().camera
    edge = camera.project(camera.eye + camera.rotation.T @ (0, demo.SENSOR_HEIGHT / 2, demo.FOCAL_LENGTH))
    np.testing.assert_allclose(edge, (demo.SIZE / 2, demo.SIZE), atol=1e-9)
