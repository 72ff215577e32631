"""What a page may change, and what becomes of the scene."""

import dataclasses

import numpy as np
import pytest

import warpshadow as ws
from warpshadow.viewer import gizmo
from warpshadow.viewer.quality import Quality
from warpshadow.viewer.state import AS_GIVEN, BodyPose, ViewerState

QUICK = Quality(64**2, cells=32, rays=16, supersampling=1, is_moving=True)
ROUNDING = 1e-6  # float64


@pytest.fixture
def scene():
    ball = ws.Body(ws.icosphere(subdivisions=1), blockers=ws.Spheres([[0, 0, 0]], [1]), translation=(0, 1, 0), name="b")
    ground = ws.Body(ws.plane(6.0, 4), blockers=0, name="ground")
    light = ws.EnvironmentMap(np.random.default_rng(0).uniform(0, 1, (8, 16, 3)).astype(np.float32))
    return ws.Scene([ball, ground], light, ws.Camera.look_at((0, 2, 4), (0, 1, 0)), bounces=1)


def test_a_look_of_a_scene_is_that_scene(scene):
    shown = ViewerState.of(scene).scene(scene)
    assert (
        vars(shown.visibility) == vars(scene.visibility.with_method()) | {"directions": scene.direction_count}
        and shown.bounces == 1
    )
    assert shown.bodies[0].blockers is scene.bodies[0].blockers and shown.bodies[1].blockers == 0
    assert shown.light is scene.light
    assert not ViewerState.of(scene).has_moved(scene)


def test_light_turns_as_in_scene_files(scene):
    viewer_state = dataclasses.replace(ViewerState.of(scene), turn=90.0, scale=2.0)
    np.testing.assert_array_equal(viewer_state.light(scene.light).radiance, scene.light.rotated(90).scaled(2).radiance)
    coefficients = np.random.default_rng(1).normal(size=(9, 3))
    about_y = np.array([[0, 0, 1.0], [0, 1, 0], [-1, 0, 0]])
    turned = viewer_state.light(coefficients)
    d = np.array([[0.6, 0.48, 0.64]])
    from warpshadow.maths import sh

    np.testing.assert_allclose(
        sh.evaluate(3, d) @ turned, 2 * sh.evaluate(3, d @ about_y) @ coefficients, atol=ROUNDING
    )


@pytest.mark.parametrize("feature", ["gloss", "emission", "near light"])
def test_settings_of_a_scene_that_shows_more_can_all_be_chosen(scene, feature):
    ball, ground = scene.bodies
    ball = dataclasses.replace(
        ball, **{"gloss": {"roughness": 0.4}, "emission": {"emission": (1, 1, 1)}}.get(feature, {})
    )
    radius = 20.0 if feature == "near light" else None
    light = ws.EnvironmentMap(scene.light.radiance, radius=radius)
    scene = dataclasses.replace(scene, bodies=[ball, ground], light=light)
    assert scene.methods == ("directional", "none", "ray-traced")
    for method in scene.methods:
        viewer_state = dataclasses.replace(ViewerState.of(scene), method=method, receivers="vertex", turn=90.0)
        shown = viewer_state.scene(scene)
        assert shown.visibility.method == method and shown.light.radius == radius
        assert [body.receivers for body in shown.bodies] == ["auto" if ball.is_glossy else "vertex", "vertex"]
    assert ws.render(shown, progress=False)[..., 3].any()


def test_settings_change_what_they_name_and_a_quality_bounds_them(scene):
    viewer_state = dataclasses.replace(
        ViewerState.of(scene), directions=256, softness=0.5, receivers="pixel", bounces=2
    )
    full, quick = viewer_state.settings(scene), viewer_state.settings(scene, QUICK)
    assert (full.visibility.directions, full.visibility.softness, full.bounces, full.supersampling) == (256, 0.5, 2, 2)
    assert (quick.visibility.directions, quick.supersampling) == (32, 1)
    assert [body.receivers for body in full.bodies] == ["pixel", "pixel"]
    rays = dataclasses.replace(viewer_state, method="ray-traced").settings(scene, QUICK)
    assert rays.visibility.samples == 16
    shared = dataclasses.replace(viewer_state, method="ray-traced", sampling="shared")
    assert (shared.settings(scene).visibility.ray_count, shared.settings(scene, QUICK).visibility.ray_count) == (
        512,
        32,
    )
    assert dataclasses.replace(viewer_state, method="none").settings(scene).bounces == 0  # which finds none


def test_bodies_without_shadows_get_no_spheres(scene):
    bodies = dataclasses.replace(ViewerState.of(scene), spheres=32).bodies(scene.bodies)
    assert [body.blockers for body in bodies] == [32, 0]


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("turn", float("nan")),
        ("turn", 1e9),
        ("scale", -1.0),
        ("scale", float("inf")),
        ("stops", "bright"),
        ("method", "magic"),
        ("method", None),
        ("directions", 100),
        ("directions", 1 << 20),
        ("softness", 0.0),
        ("spheres", 1 << 20),
        ("spheres", 0),
        ("receivers", "/etc/passwd"),
        ("bounces", 1000),
        ("bounces", 1.5),
        ("shows", "everything"),
        ("shows_light", 1),
        ("gloss", ((0.5, 0.5),)),
    ],
)
def test_what_no_page_may_ask_for_is_refused(scene, name, value):
    with pytest.raises(ValueError, match=f"{name}: got .*expected"):
        dataclasses.replace(ViewerState.of(scene), **{name: value})


def test_gloss_is_that_of_bodies_that_shine_by_a_number(scene):
    ball, ground = scene.bodies
    varying = dataclasses.replace(ball, roughness=np.linspace(0, 1, ball.mesh.vertex_count), metallic=0.25)
    for body, expected in ((ball, {}), (varying, {"metallic": 0.25, "specular": 1.0})):
        other = dataclasses.replace(scene, bodies=(body, ground))
        viewer_state = ViewerState.of(other)
        assert viewer_state.gloss == (expected, {})
        shown = viewer_state.scene(other).bodies[0]
        assert (shown.roughness is None) if body is ball else np.array_equal(shown.roughness, body.roughness)
    changed = dataclasses.replace(viewer_state, gloss=({"metallic": 0.75}, {}))
    shown = changed.scene(other).bodies[0]
    assert shown.metallic == 0.75 and np.array_equal(shown.roughness, varying.roughness)


def test_a_place_is_finite():
    for bad in ((float("nan"), 0, 0), (0, 0, 1e12), (0, 0)):
        with pytest.raises(ValueError, match="translation: got .*expected"):
            BodyPose((0, 0, 0), bad)


@pytest.mark.parametrize("name", ["roughness", "metallic"])
def test_gloss_that_no_surface_has_is_refused(scene, name):
    for bad in (-0.1, 1.5, float("nan"), "smooth"):
        with pytest.raises(ValueError, match=f"{name}: got .*expected a number from 0 to 1"):
            dataclasses.replace(ViewerState.of(scene), gloss=({name: bad}, {}))


def test_handles_are_in_the_middle_of_a_body_and_move_it_as_they_are_moved():
    mesh = ws.icosphere(subdivisions=1).transformed(translation=np.array([5.0, 0, 0]))
    body = ws.Body(mesh, blockers=1, rotation=(0, 90, 0), translation=(1, 2, 3), scale=0.5)
    pose = BodyPose(tuple(body.rotation), tuple(body.translation))
    wxyz, position = gizmo.handle_of(pose, body, 2.0)
    low, high = body.world_mesh().bounds
    np.testing.assert_allclose(position, 2.0 * 0.5 * (low + high), atol=1e-5)  # vertices are float32
    again = gizmo.pose_of(wxyz, position, body, 2.0)
    np.testing.assert_allclose(again.rotation, pose.rotation, atol=ROUNDING)
    np.testing.assert_allclose(again.translation, pose.translation, atol=ROUNDING)
    moved = gizmo.pose_of(wxyz, position + (0, 1.0, 0), body, 2.0)
    np.testing.assert_allclose(moved.translation, np.array(pose.translation) + (0, 0.5, 0), atol=ROUNDING)


def test_handles_turn_a_body_about_its_middle():
    mesh = ws.icosphere(subdivisions=1).transformed(translation=np.array([5.0, 0, 0]))
    body = ws.Body(mesh, blockers=1)
    turned = gizmo.pose_of(np.array([np.sqrt(0.5), 0, np.sqrt(0.5), 0]), np.array([5.0, 0, 0]), body, 1.0)
    shown = ws.Body(mesh, blockers=1, rotation=turned.rotation, translation=turned.translation)
    low, high = shown.world_mesh().bounds
    np.testing.assert_allclose(0.5 * (low + high), (5, 0, 0), atol=1e-5)  # vertices are float32


@pytest.mark.parametrize("wxyz", [(0, 0, 0, 0), (float("nan"), 0, 0, 1)])
def test_handles_that_are_nowhere_are_refused(wxyz):
    with pytest.raises(ValueError):
        gizmo.pose_of(np.array(wxyz), np.zeros(3), ws.Body(ws.icosphere(1.0, 1), blockers=1), 1.0)


def test_receivers_as_given_are_those_of_the_bodies(scene):
    assert ViewerState.of(scene).receivers == AS_GIVEN
    assert ViewerState.of(scene).bodies(scene.bodies)[0].receivers == scene.bodies[0].receivers
