"""The demo of a real photograph: what it masks, where it puts the bottle, and that its fits find what they should."""

import dataclasses

import numpy as np
import pytest

import warpshadow as ws
from demos.examples import bottle as demo
from demos.problems import displaced, distance_error, ray_traced, unshadowed

WIDTH, HEIGHT = 144, 96


def lump() -> ws.Mesh:
    """A ball, longer than wide, wider than deep, and thicker on top."""
    ball = ws.icosphere(1.0, 3)
    x, y, z = ball.positions.T
    return dataclasses.replace(ball, positions=np.stack([x * (0.6 + 0.2 * y), y, 0.4 * z], axis=1).astype(np.float32))


@pytest.fixture(scope="module")
def photo() -> demo.Photograph:
    """An image of the lump on tiles in a sky with a sun, 144 × 96 pixels."""
    spheres = ws.Spheres(
        [[0, 0.5, 0], [0.15, 0.3, 0], [-0.15, 0.3, 0], [0, -0.1, 0], [0, -0.6, 0]], [0.42] * 4 + [0.36]
    )
    body = ws.Body(lump(), (0.7, 0.3, 0.1), blockers=spheres, translation=(0, 1, 0), rotation=(0, 30, 0))
    tiles = np.where(np.indices((4, 4)).sum(axis=0)[..., None] % 2, 0.8, 0.1) * np.ones(3)
    texture = tiles.repeat(16, axis=0).repeat(16, axis=1).astype(np.float32)
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


def test_masks_leave_out_what_saturates_and_the_inside_of_the_body(photo):
    burnt = photo.image.copy()
    row, column = np.argwhere(photo.mask() == 1)[5]
    burnt[row, column] = (0.2, 1.0, 0.2)
    assert dataclasses.replace(photo, image=burnt).mask()[row, column] == 0
    whole, rim = photo.mask(), photo.mask(inside=False)
    left_out = (whole > 0) & (rim == 0)
    assert 0.3 * photo.outline.sum() < left_out.sum() < photo.outline.sum()
    assert (photo.outline[left_out] == 1).all()
    assert not photo.around()[photo.outline > 0].any() and photo.around().any()


def test_the_near_half_of_the_table_is_in_front_of_the_foot(photo):
    body = photo.scene.bodies[demo.BODY].world_mesh().positions
    foot, camera = body[body[:, 1].argmin()], photo.scene.camera
    forward = camera.rotation[2] * (1, 0, 1)
    forward /= np.linalg.norm(forward)
    for distance in (-0.8, -0.2, 0.2, 0.8):
        column, row = camera.project((foot + distance * forward) * (1, 0, 1)).astype(int)
        assert photo.near()[row, column] == (distance < 0)


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


def test_the_outline_finds_the_body(photo):
    start, truth = away(photo), photo.scene.bodies[demo.BODY]
    assert distance_error(demo.by_outline(photo, start), truth) < 0.35 * distance_error(start, truth)


@pytest.mark.slow
def test_the_image_keeps_the_body_nearer_with_shadows_than_without(photo):
    truth = photo.scene.bodies[demo.BODY]
    near = displaced(truth, np.random.default_rng(1), degrees=(3, 3), part=(0.02, 0.02))
    with_shadows, without = (
        distance_error(demo.by_image(photo, near, by).bodies[demo.BODY], truth) for by in (demo.SHADOWS, demo.DIRECT)
    )
    assert with_shadows < 0.85 * without


@pytest.mark.slow
def test_light_and_table_in_front_predict_light_squares_behind(photo):
    image, seen, counts = demo.prediction(photo, demo.DIRECT)
    assert image.shape == seen.shape == (*counts.shape, 3) == (HEIGHT // 2, WIDTH // 2, 3)
    assert counts.sum() > 50
    assert not counts[demo.halved(photo.near()[..., None])[..., 0] > 0].any()
    assert seen[counts].min() > 3 * np.percentile(seen[seen[..., 0] > 0], 10)
    assert np.linalg.norm((image - seen)[counts]) < 0.1 * np.linalg.norm(seen[counts])
