"""A scene that is taken home is the one that was shown."""

import dataclasses
import io
import zipfile

import numpy as np
import pytest

import warpshadow as ws
from warpshadow.viewer.page_camera import PageCamera
from warpshadow.viewer.painter import own_page
from warpshadow.viewer.saving import as_archive, as_toml, saved_camera
from warpshadow.viewer.state import BodyPose, ViewerState

ROUNDING = 1e-6  # of float32 maps that were turned in one step or in two; whole pixels here

FILE = """
[camera]
eye = [0.0, 2.0, 5.0]
target = [0.0, 0.5, 0.0]
size = [64, 48]
supersampling = 3

[light]
envmap = "sky.exr"
rotation = 90.0
scale = 2.0

[visibility]
order = 4

[[body]]
primitive = "icosphere"
spheres = "ball.npz"
albedo = [0.2, 0.4, 0.6]
name = "ball"

[[body]]
primitive = "plane"
size = 6.0
segments = 8
blockers = 0
"""


@pytest.fixture
def path(tmp_path):
    ws.EnvironmentMap(np.random.default_rng(0).uniform(0, 1, (16, 32, 3)).astype(np.float32)).write(
        tmp_path / "sky.exr"
    )
    ws.Spheres([[0, 0, 0]], [1.0]).write(tmp_path / "ball.npz")
    (tmp_path / "scene.toml").write_text(FILE)
    return tmp_path / "scene.toml"


def changed(scene):
    return dataclasses.replace(
        ViewerState.of(scene),
        turn=45.0,
        scale=0.5,
        directions=64,
        softness=0.5,
        receivers="pixel",
        bounces=2,
        poses=(BodyPose((0, 30, 0), (0.1, 1.0, 0)), BodyPose((0, 0, 0), (0, 0, 0))),
    )


def assert_same(read, shown):
    given, kept = (
        vars(scene.visibility.with_method()) | {"directions": scene.direction_count} for scene in (read, shown)
    )
    assert given == kept
    assert (read.bounces, read.supersampling) == (shown.bounces, shown.supersampling)
    np.testing.assert_allclose(read.light.radiance, shown.light.radiance, atol=ROUNDING)
    np.testing.assert_allclose(read.camera.clip_matrix(), shown.camera.clip_matrix(), atol=ROUNDING)
    for one, other in zip(read.bodies, shown.bodies, strict=True):
        assert (one.receivers, one.name) == (other.receivers, other.name)
        np.testing.assert_allclose(one.rotation, other.rotation)
        np.testing.assert_allclose(one.translation, other.translation)
        np.testing.assert_allclose(one.albedo, other.albedo)


def test_a_scene_file_comes_back_with_what_was_changed(path, tmp_path):
    scene = ws.load_scene(path)
    viewer_state, page = changed(scene), own_page(scene, 2.0)
    camera = saved_camera(scene, page, 2.0)
    (tmp_path / "saved.toml").write_bytes(as_toml(path, scene, viewer_state, camera))
    assert 'envmap = "sky.exr"' in (tmp_path / "saved.toml").read_text()
    assert_same(ws.load_scene(tmp_path / "saved.toml"), dataclasses.replace(viewer_state.scene(scene), camera=camera))


def test_a_scene_file_of_a_look_that_changes_nothing_is_the_same_scene(path, tmp_path):
    scene = ws.load_scene(path)
    (tmp_path / "saved.toml").write_bytes(as_toml(path, scene, ViewerState.of(scene), scene.camera))
    assert_same(ws.load_scene(tmp_path / "saved.toml"), scene)


def test_a_body_that_stood_and_a_camera_that_framed_are_where_they_were_moved_to(path, tmp_path):
    standing = FILE.replace('name = "ball"', "translation = [1.0, 0.0, 0.0]\non_ground = {size = 3.0}")
    path.write_text(standing.replace("eye = [0.0, 2.0, 5.0]\ntarget = [0.0, 0.5, 0.0]", 'framing = "auto"'))
    scene = ws.load_scene(path)
    start = ViewerState.of(scene)
    moved = dataclasses.replace(start, poses=(BodyPose((0, 30, 0), (0.1, 1.0, 0)), start.poses[1]))
    for viewer_state in (start, moved):
        (tmp_path / "saved.toml").write_bytes(as_toml(path, scene, viewer_state, scene.camera))
        read = ws.load_scene(tmp_path / "saved.toml")
        assert_same(read, viewer_state.scene(scene))
        assert read.bodies[0].scale == pytest.approx(1.5)


def test_gloss_that_was_changed_is_in_the_scene_file(path, tmp_path):
    path.write_text(FILE.replace('name = "ball"', 'name = "ball"\nroughness = 0.5'))
    scene = ws.load_scene(path)
    viewer_state = dataclasses.replace(ViewerState.of(scene), gloss=({"roughness": 0.25, "metallic": 1.0}, {}))
    (tmp_path / "saved.toml").write_bytes(as_toml(path, scene, viewer_state, scene.camera))
    ball = ws.load_scene(tmp_path / "saved.toml").bodies[0]
    assert ball.roughness == 0.25 and ball.metallic == 1


def test_other_numbers_of_spheres_take_the_place_of_given_ones(path, tmp_path):
    scene = ws.load_scene(path)
    viewer_state = dataclasses.replace(ViewerState.of(scene), spheres=32)
    (tmp_path / "saved.toml").write_bytes(as_toml(path, scene, viewer_state, scene.camera))
    assert [body.blockers for body in ws.load_scene(tmp_path / "saved.toml").bodies] == [32, 0]


def test_an_archive_has_the_scene_and_all_that_it_names(path, tmp_path):
    scene = ws.load_scene(path)
    viewer_state = changed(scene)
    archive = zipfile.ZipFile(io.BytesIO(as_archive(scene, viewer_state, scene.camera)))
    archive.extractall(tmp_path / "home")
    assert_same(ws.load_scene(tmp_path / "home" / "scene.toml"), viewer_state.scene(scene))


def test_a_saved_camera_is_as_high_as_the_scenes_and_as_wide_as_the_page(path):
    scene = ws.load_scene(path)
    page = PageCamera((1, 0, 0, 0), (0, 0, -5), 40.0, 2000, 1000)
    camera = saved_camera(scene, page, 1.0)
    assert (camera.width, camera.height) == (96, 48)
    assert camera.intrinsics[0, 0] == pytest.approx(camera.intrinsics[1, 1])
