"""The demo of a real photograph: what it masks, where it puts the bottle, what fits find, how shadows are measured."""

import dataclasses

import numpy as np
import pytest

import warpshadow as ws
from demos.examples import bottle as demo
from demos.examples import bottle_light
from demos.problems import displaced, distance_error, ray_traced, unshadowed

WIDTH, HEIGHT = 144, 96
IS_LIGHT = (np.indices((4, 4)).sum(axis=0)[..., None] % 2 == 1).repeat(16, axis=0).repeat(16, axis=1)


def lump() -> ws.Mesh:
    """A ball, longer than wide, wider than deep, thicker below, and with a foot that it stands on."""
    ball = ws.icosphere(1.0, 3)
    x, y, z = ball.positions.T
    positions = np.stack([x * (0.5 - 0.2 * y), np.maximum(y, -0.93), 0.4 * z], axis=1)
    return dataclasses.replace(ball, positions=positions.astype(np.float32))


@pytest.fixture(scope="module")
def photo() -> demo.Photograph:
    """An image of the lump on tiles in a sky with a sun, 144 × 96 pixels."""
    spheres = ws.Spheres(
        [[0, -0.5, 0], [0.15, -0.3, 0], [-0.15, -0.3, 0], [0, 0.1, 0], [0, 0.6, 0]], [0.4] * 4 + [0.36]
    )
    body = ws.Body(lump(), (0.7, 0.3, 0.1), blockers=spheres, translation=(0, 0.93, 0), rotation=(0, 30, 0))
    texture = np.where(IS_LIGHT, np.full(3, 0.8), 0.1).astype(np.float32)
    sky = ws.synthetic_sky((0.8, 0.7, -0.1), sun_strength=3.0, sun_radius=30.0, height=64)
    camera = ws.Camera.look_at((1.2, 4.2, 3.6), (0.3, 0.4, -0.2), fov_y=40, size=(WIDTH, HEIGHT))
    truth = ws.Scene((body, ws.Body(ws.plane(7.0, 16), texture=texture)), sky, camera, demo.SHADOWS)
    image = ray_traced(truth, 256)
    alone = dataclasses.replace(unshadowed(truth), bodies=(body,), supersampling=4)
    gray = (body, ws.Body(ws.plane(7.0, 16), (0.4, 0.4, 0.4)))
    scene = dataclasses.replace(truth, bodies=gray, light=demo.PLAIN)
    return demo.Photograph(
        demo.EXPOSURE * image[..., :3], np.floor(image[..., 3]), ws.render(alone)[..., 3], scene, texels=32
    )


def away(photo: demo.Photograph) -> ws.Body:
    body = photo.scene.bodies[demo.BODY]
    return displaced(body, np.random.default_rng(1), degrees=(15, 15), part=(0.1, 0.1))


def test_a_start_is_15_degrees_and_a_tenth_of_the_diagonal_away(photo):
    start, truth = away(photo), photo.scene.bodies[demo.BODY]
    turn = start.rotation_matrix() @ truth.rotation_matrix().T
    assert np.degrees(np.arccos((np.trace(turn) - 1) / 2)) == pytest.approx(15, abs=1e-3)
    low, high = truth.world_mesh().bounds
    middle = np.linalg.inv(truth.rotation_matrix()) @ ((low + high) / 2 - truth.translation)
    shift = start.rotation_matrix() @ middle + start.translation - (low + high) / 2
    assert np.linalg.norm(shift) == pytest.approx(0.1 * np.linalg.norm(high - low), rel=1e-4)


def test_masks_leave_out_what_saturates(photo):
    burnt = photo.image.copy()
    row, column = np.argwhere(photo.mask() == 1)[5]
    burnt[row, column] = (0.2, 1.0, 0.2)
    assert dataclasses.replace(photo, image=burnt).mask()[row, column] == 0
    assert not photo.around()[photo.outline > 0].any() and photo.around().any()


def test_the_bottle_is_seen_where_its_given_pose_projects_it(tmp_path):
    """By the formula of the data's README: body to camera is inverse(T) · G."""
    points = np.array([[0.01, 0.02, 0.0], [-0.01, 0.03, 0.1], [0.0, -0.03, 0.19], [0.01, 0.0, 0.1]])
    faces = "f 1 2 3\nf 1 3 4\nf 1 4 2\nf 2 4 3\n"
    (tmp_path / "bottle.obj").write_text("".join("v {} {} {}\n".format(*point) for point in points) + faces)
    ws.write_image(tmp_path / "bottle.png", np.full((540, 960, 3), 0.5, np.float32))
    photo = demo.bottle_photograph(tmp_path)
    model_to_world = np.array(
        [
            [0.607676, 0.408914, -0.680823, 0.297794],
            [0.786584, -0.428213, 0.444880, -0.189009],
            [-0.109620, -0.805867, -0.581860, 0.255284],
            [0, 0, 0, 1],
        ]
    )
    raised = points + (0, 0, -0.097)
    seen = (np.linalg.inv(model_to_world) @ np.column_stack([raised, np.ones(4)]).T)[:3]
    u, v = 698.128 * seen[0] / seen[2] + 478.459, 698.617 * seen[1] / seen[2] + 274.426
    world = photo.scene.bodies[demo.BODY].world_mesh().positions
    np.testing.assert_allclose(photo.scene.camera.project(world), np.stack([u, v], axis=1), atol=0.05)
    assert photo.table.shape == photo.outline.shape == (540, 960)
    assert 2e4 < photo.outline.sum() < 3e4


@pytest.mark.slow
def test_the_body_is_found_on_the_table_by_its_outline_and_its_shadow(photo):
    start, truth = away(photo), photo.scene.bodies[demo.BODY]
    result = demo.by_photograph(photo, start, demo.SHADOWS)
    assert distance_error(start, truth) > 10
    assert distance_error(result.scene.bodies[demo.BODY], truth) < 1.5
    table = photo.scene.bodies[demo.TABLE]
    assert distance_error(result.scene.bodies[demo.TABLE], table) < 1
    counts = result.problem.targets[0].mask
    assert counts.any() and not counts[photo.outline > 0].any()
    assert not counts[~demo.light_squares(photo, demo.tiles(photo))].any()


def test_light_squares_are_light_whole_and_on_the_table(photo):
    squares = bottle_light.squares_around(photo, IS_LIGHT)
    colors = photo.image[squares.seen].mean(axis=1)
    assert squares.seen.sum() > 300
    assert np.percentile(colors, 5) > 3 * np.percentile(photo.image[photo.mask() == 1].mean(axis=1), 10)
    assert not (squares.seen & (photo.outline > 0)).any()


def test_points_of_the_table_are_what_pixels_see_of_it(photo):
    for level in (0.3, 0.0):
        table = dataclasses.replace(photo.scene.bodies[demo.TABLE], translation=(0.0, level, 0.0))
        points = bottle_light.table_points(dataclasses.replace(photo.scene, bodies=(photo.scene.bodies[0], table)))
        x, z = points[60, 70]
        np.testing.assert_allclose(photo.scene.camera.project(np.array([x, level, z])), (70.5, 60.5), atol=1e-3)
    middle, radius = bottle_light.foot(photo.scene.bodies[demo.BODY])
    np.testing.assert_allclose(middle, 0, atol=0.1)
    assert 0.1 < radius < 0.4


@pytest.mark.slow
def test_light_is_found_that_casts_the_shadow_of_the_photograph(photo):
    seen = bottle_light.squares_around(photo, IS_LIGHT).seen
    visibility = ws.Visibility(directions=64)
    found = bottle_light.explained(photo, seen, visibility, iterations=100).scene
    without = bottle_light.explained(photo, seen, bottle_light.DIRECT, iterations=100).scene
    unshadowed_gap = bottle_light.gap(photo, without, seen, bottle_light.DIRECT)
    assert bottle_light.gap(photo, found, seen, visibility) < 0.6 * unshadowed_gap
    found = dataclasses.replace(found, visibility=visibility)
    kept = bottle_light.darkening(found, bottle_light.second_body(photo))
    assert 0.25 < np.nanmin(kept) < 0.8 and np.nanmedian(kept) > 0.9
    shadow = bottle_light.shadow(bottle_light.by_sector(kept, photo, bottle_light.second_body(photo)))
    assert abs(abs(shadow.direction) - 180) < 45  # the sun is on the right


def test_a_shadow_is_measured_around_its_darkest_sector():
    kept = np.ones(24)
    kept[[22, 23, 0, 1]] = 0.75, 0.6, 0.9, 0.7  # over the seam at 180°, with a gap
    kept[12] = np.nan
    found = bottle_light.shadow(kept)
    assert found == bottle_light.Shadow(pytest.approx(172.5), pytest.approx(0.4), 30)
    assert bottle_light.shadow(kept, (-180, 0)).direction == pytest.approx(-157.5)
    assert str(found) == "darkest at 172°, 40% less light, 30° wide"
