"""Pictures: those of the renderer itself, whatever is shared between them, and the distances beside them."""

import dataclasses

import numpy as np
import pytest

import warpshadow as ws
from warpshadow.scene.visibility import Visibility
from warpshadow.viewer.page_camera import PageCamera
from warpshadow.viewer.painter import Painter, bounds, distances, error_picture, own_page, picture, relative_error
from warpshadow.viewer.quality import Quality
from warpshadow.viewer.state import ERROR, BodyPose, ViewerState

# float32 sums in another order, and a camera that went through a quaternion
SAME_IMAGE = 2e-4

FULL = Quality(1 << 20, cells=1 << 16, rays=1 << 16, supersampling=16, is_moving=False)
QUICK = Quality(48**2, cells=32, rays=16, supersampling=1, is_moving=True)


@pytest.fixture(scope="module")
def scene():
    ball = ws.Body(
        ws.icosphere(subdivisions=2), blockers=ws.Spheres([[0, 0, 0]], [1.0]), translation=(0, 1, 0), name="ball"
    )
    ground = ws.Body(ws.plane(8.0, 24), blockers=0, name="ground")
    camera = ws.Camera.look_at((0, 3, 5), (0, 0.6, 0), size=(64, 48))
    return ws.Scene([ball, ground], ws.synthetic_sky(), camera, Visibility(directions=64))


@pytest.fixture(scope="module")
def painter(scene):
    return Painter(scene)


def test_a_ground_to_the_horizon_does_not_count_in_the_size_of_a_scene(scene):
    ball, ground = scene.bodies
    horizon = dataclasses.replace(ground, mesh=ws.infinite_ground(8.0))
    np.testing.assert_allclose(bounds(scene), [[-4, 0, -4], [4, 2, 4]], atol=1e-3)
    np.testing.assert_allclose(bounds(dataclasses.replace(scene, bodies=(ball, horizon))), bounds_of(ball), atol=1e-6)
    alone = dataclasses.replace(scene, bodies=(horizon,))
    np.testing.assert_allclose(bounds(alone), bounds_of(horizon))


def bounds_of(body):
    return body.world_mesh().bounds


def difference(image, other):
    return np.linalg.norm(image - other) / np.linalg.norm(other)


def test_a_picture_of_the_scene_as_it_is_is_that_of_the_renderer(scene, painter):
    page = own_page(scene, painter.page_scale)
    assert difference(painter.image(ViewerState.of(scene), page, FULL), ws.render(scene)) < SAME_IMAGE


def test_a_picture_of_what_was_changed_is_that_of_the_scene_so_changed(scene, painter):
    viewer_state = dataclasses.replace(
        ViewerState.of(scene),
        turn=50.0,
        scale=0.5,
        directions=128,
        softness=0.6,
        poses=(BodyPose((0, 30, 0), (0.5, 1.2, 0.2)), BodyPose((0, 0, 0), (0, 0, 0))),
    )
    page = own_page(scene, painter.page_scale)
    shown = viewer_state.scene(scene)
    image = painter.image(viewer_state, page, FULL)
    assert difference(image, ws.render(shown)) < SAME_IMAGE
    assert difference(image, ws.render(scene)) > 0.1  # which is another picture


def test_pages_of_other_sizes_share_a_renderer_and_see_what_one_of_their_own_would(scene, painter):
    viewer_state = ViewerState.of(scene)
    for size in ((64, 48), (40, 60), (64, 48)):
        page = dataclasses.replace(own_page(scene, painter.page_scale), width=size[0], height=size[1])
        camera = page.camera(size, page_scale=painter.page_scale, near=scene.camera.near)
        truth = ws.render(dataclasses.replace(scene, camera=camera))
        assert difference(painter.image(viewer_state, page, FULL), truth) < SAME_IMAGE


def test_a_moving_picture_costs_less_and_is_about_the_same(scene, painter):
    page = own_page(scene, painter.page_scale)
    quick, full = (painter.paint(ViewerState.of(scene), page, quality) for quality in (QUICK, FULL))
    assert quick.cells == "32 directions" and full.cells == "64 directions"
    assert quick.rgb.size < full.rgb.size and full.rgb.shape == (48, 64, 3)
    assert abs(quick.rgb.mean() - full.rgb.mean()) < 0.05 * full.rgb.mean()


def test_distances_are_those_of_rays(scene, painter):
    page = own_page(scene, painter.page_scale)
    frame = painter.paint(ViewerState.of(scene), page, FULL, depth=True)
    camera = scene.camera
    eye, rays = camera.rays()
    along = rays @ camera.rotation[2]
    b = rays @ (eye - (0, 1, 0))
    root = b * b - (np.dot(eye - (0, 1, 0), eye - (0, 1, 0)) - 1)
    with np.errstate(invalid="ignore", divide="ignore"):
        ball = np.where(root > 0, -b - np.sqrt(root), np.inf)
        ground = np.where(rays[..., 1] < 0, -eye[1] / rays[..., 1], np.inf)
    hits = eye + np.where(np.isfinite(ground), ground, 0)[..., None] * rays
    ground = np.where(np.abs(hits[..., [0, 2]]).max(axis=-1) < 4, ground, np.inf)
    truth = painter.page_scale * np.minimum(ball, ground) * along
    inside = np.isfinite(truth) & (frame.depth < 100)
    assert (np.isfinite(truth) == (frame.depth < 100)).mean() > 0.97  # but for pixels at edges
    error = np.abs(frame.depth - truth)[inside] / truth[inside]
    assert np.median(error) < 0.01  # the ball's faces are flat, and samples lie beside the middle
    assert painter.paint(ViewerState.of(scene), page, FULL).depth is None


def test_distances_are_in_order_even_where_nothing_is(scene, painter):
    page = PageCamera((1, 0, 0, 0), (0, 0, 100), 40.0, 32, 24)  # looks away
    frame = painter.paint(ViewerState.of(scene), page, FULL, depth=True)
    assert (frame.depth == 160).all() and len(np.unique(frame.rgb)) == 1


def test_error_against_rays_is_told_at_rest_alone(scene, painter):
    viewer_state, page = dataclasses.replace(ViewerState.of(scene), shows=ERROR), own_page(scene, painter.page_scale)
    assert painter.paint(viewer_state, page, QUICK).error is None
    told = painter.paint(viewer_state, page, FULL)
    rays = ws.render(dataclasses.replace(scene, visibility=Visibility("ray-traced", samples=4096)))
    truth = relative_error(ws.render(scene), rays)
    assert told.error == pytest.approx(truth, abs=0.03) and 0.005 < truth < 0.2  # 256 rays are noisy
    shadowless = painter.paint(dataclasses.replace(viewer_state, method="none"), page, FULL)
    assert shadowless.error > 2 * told.error


def test_an_error_picture_is_white_where_nothing_is_wrong_red_where_too_bright_and_blue_where_too_dark():
    truth = np.ones((1, 3, 4), np.float32)
    image = truth.copy()
    image[0, 1, :3], image[0, 2, :3] = 2.0, 0.0
    assert error_picture(image, truth)[0].tolist() == [[255, 255, 255], [255, 0, 0], [0, 0, 255]]
    assert error_picture(image * 0, truth * 0).shape == (1, 3, 3)
    assert relative_error(image * 0, truth * 0) is None


@pytest.mark.parametrize("stops", [-2.0, 0.0, 1.5])
def test_a_picture_is_the_librarys_but_for_a_code(stops):
    random = np.random.default_rng(0)
    alpha = np.clip(random.uniform(-0.5, 1.5, (40, 50, 1)), 0, 1)
    image = np.concatenate([alpha * random.uniform(0, 0.9 * 2**-stops, (40, 50, 3)), alpha], axis=2).astype(np.float32)
    image[0, :2] = (9, 9, 9, 1), (-0.1, 0, 0, 1)
    for behind in (np.array([0.05, 0.2, 1.0]), random.uniform(0, 2, (40, 50, 3))):
        expected = ws.Picture(image, exposure=stops, background=behind).pixels.astype(int)
        assert np.abs(picture(image, stops, behind.astype(np.float32)) - expected).max() <= 1


def test_light_is_behind_the_bodies_as_the_scene_has_it(scene, painter):
    viewer_state = dataclasses.replace(ViewerState.of(scene), shows_light=True, turn=90.0)
    page = dataclasses.replace(own_page(scene, painter.page_scale), position=(0, 0.5, 4), wxyz=(0, 1, 0, 0))  # level
    camera = page.camera((64, 48), page_scale=painter.page_scale, near=scene.camera.near)
    turned = dataclasses.replace(viewer_state.scene(scene), camera=camera, supersampling=1)
    expected = ws.Picture(ws.render(turned), exposure=0.0, background=turned.background()).pixels.astype(int)
    got = painter.paint(viewer_state, page, dataclasses.replace(FULL, supersampling=1)).rgb
    assert np.abs(got - expected).max() <= 2 and len(np.unique(got[:5])) > 3  # codes


def test_light_that_is_near_is_behind_the_bodies_where_rays_leave_it(scene):
    near = ws.EnvironmentMap(scene.light.radiance, radius=8.0, center=(0, 1, 0))
    scene = dataclasses.replace(scene, light=near, supersampling=1)
    painter = Painter(scene)
    viewer_state = dataclasses.replace(ViewerState.of(scene), shows_light=True)
    page = dataclasses.replace(own_page(scene, painter.page_scale), position=(0, 0.5, 4), wxyz=(0, 1, 0, 0))  # level
    camera = page.camera((64, 48), page_scale=painter.page_scale, near=scene.camera.near)
    expected = dataclasses.replace(scene, camera=camera).background()
    behind = painter._behind(viewer_state, camera, FULL)
    np.testing.assert_allclose(behind, expected, rtol=1e-4, atol=1e-4)
    assert difference(scene.light.radiance_from(camera.rays()[1]), expected) > 0.01  # of the same map far away


def test_gloss_that_is_changed_is_that_of_the_scene_so_changed(scene):
    shiny = dataclasses.replace(scene.bodies[0], roughness=0.5)
    scene = dataclasses.replace(scene, bodies=(shiny, scene.bodies[1]))
    painter = Painter(scene)
    page, start = own_page(scene, painter.page_scale), ViewerState.of(scene)
    assert start.gloss == ({"roughness": 0.5, "metallic": 0.0, "specular": 1.0}, {})
    plain = painter.image(start, page, FULL)
    viewer_state = dataclasses.replace(start, gloss=({"roughness": 0.35, "metallic": 1.0}, {}))
    image = painter.image(viewer_state, page, FULL)
    assert difference(image, ws.render(viewer_state.scene(scene))) < SAME_IMAGE
    assert difference(image, plain) > 0.1 and len(painter._renderers._cached) == 1


def test_a_light_in_harmonics_and_a_scene_of_one_point_are_painted():
    light = np.zeros((9, 3))
    light[0] = 3.0
    body = ws.Body(ws.icosphere(subdivisions=1), blockers=0, scale=1e-3)
    scene = ws.Scene([body], light, ws.Camera.look_at((0, 0, 5e-3), (0, 0, 0), size=(32, 32), near=1e-5))
    painter = Painter(scene)
    viewer_state = dataclasses.replace(ViewerState.of(scene, painter.natural_stops()), turn=30.0, shows_light=True)
    frame = painter.paint(viewer_state, own_page(scene, painter.page_scale), FULL, depth=True)
    assert frame.rgb[16, 16].min() > 200 and frame.depth.min() < 20


def test_distances_of_a_view_without_supersampling(scene):
    renderer = ws.Renderer(dataclasses.replace(scene, supersampling=1))
    assert distances(renderer, renderer.view()).shape == (48, 64)


def test_spheres_are_those_of_the_bodies(scene, painter):
    (centers, radii), (_, none) = painter.spheres(ViewerState.of(scene))
    np.testing.assert_allclose(centers, [[0, 0, 0]])
    assert radii.tolist() == [1.0] and len(none) == 0
