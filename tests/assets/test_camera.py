"""Cameras: hand-computed pixels, constructors against each other, errors, and the clip-space kernel."""

import dataclasses
import re

import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st

import warpshadow as ws
from warpshadow.assets.camera import Camera
from warpshadow.stages.raster.project import compose_clip_matrices, to_clip

INTRINSICS = np.array([[100.0, 0.0, 32.0], [0.0, 50.0, 24.0], [0.0, 0.0, 1.0]])
SIZE = (96, 64)


def opengl_look_at(eye, target, up):
    """gluLookAt, as in its manual page."""
    f = (target - eye) / np.linalg.norm(target - eye)
    s = np.cross(f, up)
    s /= np.linalg.norm(s)
    view = np.eye(4)
    view[:3, :3] = [s, np.cross(s, f), -f]
    view[:3, 3] = -view[:3, :3] @ eye
    return view


def opengl_frustum(left, right, bottom, top, near, far):
    """glFrustum, as in its manual page."""
    return np.array(
        [
            [2 * near / (right - left), 0, (right + left) / (right - left), 0],
            [0, 2 * near / (top - bottom), (top + bottom) / (top - bottom), 0],
            [0, 0, -(far + near) / (far - near), -2 * far * near / (far - near)],
            [0, 0, -1, 0],
        ]
    )


def clip_to_pixels(clip, width, height):
    """The documented clip convention, spelled out."""
    return np.stack([(clip[..., 0] / clip[..., 3] + 1) * width / 2, (clip[..., 1] / clip[..., 3] + 1) * height / 2], -1)


def test_a_point_lands_on_the_pixel_computed_by_hand():
    camera = Camera(INTRINSICS, np.eye(3), np.array([0.0, 0.0, 1.0]), 96, 64)
    # Camera space (0.2, 0.4, 2): u = 100 * 0.2 / 2 + 32 = 42, v = 50 * 0.4 / 2 + 24 = 34.
    np.testing.assert_allclose(camera.project([0.2, 0.4, 1.0]), [42.0, 34.0])
    np.testing.assert_allclose(camera.eye, [0.0, 0.0, -1.0])


def test_look_at_sees_the_target_in_the_middle_up_above_and_right_to_the_right():
    camera = Camera.look_at((0, 0, 5), (0, 0, 0), fov_y=90.0, size=(200, 100))
    np.testing.assert_allclose(camera.project([0, 0, 0]), [100, 50], atol=1e-12)
    np.testing.assert_allclose(camera.project([0, 5, 0]), [100, 0], atol=1e-12)  # the top edge: tan 45 degrees
    np.testing.assert_allclose(camera.project([5, 0, 0]), [150, 50], atol=1e-12)  # square pixels


def test_points_behind_the_eye_have_no_pixel():
    camera = Camera.look_at((0, 0, 5), (0, 0, 0))
    assert np.isnan(camera.project([[0, 0, 6], [0, 0, 5]])).all()


DIRECTIONS = [(0.3, 0.4, 0.9), (1, 0, 0), (-2, -1, 0.5), (0.01, 5, 0), (0, 0, -1e-3)]


@pytest.mark.parametrize("direction", DIRECTIONS)
@pytest.mark.parametrize("scale", [1e-4, 1.0, 1e4])
@pytest.mark.parametrize(("size", "fov_y"), [((64, 64), 40.0), ((200, 50), 100.0), ((50, 200), 12.0)])
def test_a_framing_camera_touches_all_that_it_shows_from_the_direction(direction, scale, size, fov_y):
    rng = np.random.default_rng(1)
    mesh = ws.Mesh(scale * (rng.normal(size=(30, 3)) * (1, 3, 0.5) + (20, -7, 3)), rng.integers(0, 30, (20, 3)))
    camera = Camera.framing(mesh, direction=direction, size=size, fov_y=fov_y, margin=0.1)
    seen = camera.project(mesh.world_points()) / size * 2 - 1
    assert np.abs(seen).max() == pytest.approx(0.9, abs=1e-6)  # as near as it may be
    touched = [np.isclose(seen[:, axis].min(), -0.9) and np.isclose(seen[:, axis].max(), 0.9) for axis in (0, 1)]
    assert any(touched)  # on both sides: in the middle
    np.testing.assert_allclose(camera.rotation[2], -np.array(direction) / np.linalg.norm(direction), atol=1e-12)
    assert (camera.rotation @ (0, 1, 0))[1] < 0  # up is up
    depths = mesh.world_points() @ camera.rotation[2] + camera.translation[2]
    assert camera.near == pytest.approx(0.01 * depths.min(), rel=1e-6)


def test_a_framing_camera_leaves_out_a_ground_unless_it_is_all_there_is():
    ball = ws.Body(ws.icosphere(0.5, 2), translation=(3, 1, 0))
    ground = ws.Body(ws.plane(90.0, 2))
    alone = Camera.framing(ball)
    for shown in ([ball, ground], ws.Scene([ground, ball], np.ones((4, 3))), (body for body in (ball, ground))):
        np.testing.assert_array_equal(Camera.framing(shown).clip_matrix(), alone.clip_matrix())
    wide = Camera.framing(ground, margin=0.0)
    assert np.abs(wide.project(ground.world_points()) / 256 * 2 - 1).max() == pytest.approx(1.0)
    np.testing.assert_array_equal(Camera.framing(ground.mesh, margin=0.0).clip_matrix(), wide.clip_matrix())


def test_a_scene_without_a_camera_shows_all_its_bodies():
    ball = ws.Body(ws.icosphere(0.5, 2), translation=(3, 1, 0))
    np.testing.assert_array_equal(
        ws.Scene([ball], np.ones((4, 3))).camera.clip_matrix(), Camera.framing(ball).clip_matrix()
    )


def test_a_turned_camera_sees_what_the_camera_sees_of_things_turned_with_it():
    camera = Camera.look_at((1, 2, 3), (0.2, 0, -0.3), up=(0.1, 1, 0), size=SIZE, near=0.2)
    points, middle = np.random.default_rng(0).normal(size=(9, 3)), np.array([0.5, 7, -0.2])
    quarter = np.array([[0, 0, 1], [0, 1, 0], [-1, 0, 0]])  # +z to +x: counter-clockwise from above
    turned = camera.turned(90, middle)
    np.testing.assert_allclose(turned.project((points - middle) @ quarter.T + middle), camera.project(points))
    assert (turned.width, turned.height, turned.near) == (*SIZE, 0.2)
    np.testing.assert_allclose(turned.turned(270, middle).clip_matrix(), camera.clip_matrix(), atol=1e-12)
    with pytest.raises(ValueError, match="^degrees: got"):
        camera.turned("90")
    with pytest.raises(ValueError, match="^about: got"):
        camera.turned(90, 0)


@pytest.mark.parametrize(
    ("name", "shown", "options"),
    [
        ("shown: got 7", 7, {}),
        ("shown: got nothing", [], {}),
        ("shown[1]: got 'bunny.obj'", [ws.icosphere(), "bunny.obj"], {}),
        ("shown: got a point or a line along", ws.Mesh([[1, 2, 3]], [[0, 0, 0]]), {}),
        ("shown: got a point or a line", ws.Mesh([[0, 0, 0], [0, 0, 1]], [[0, 1, 1]]), {"direction": (0, 0, 2)}),
        ("direction: got [0.0, 0.0, 0.0]", ws.icosphere(), {"direction": (0, 0, 0)}),
        ("direction: got [0.0, 1.0, 0.0], parallel to up", ws.icosphere(), {"direction": (0, 1, 0)}),
        ("margin: got 1", ws.icosphere(), {"margin": 1}),
        ("fov_y: got 180", ws.icosphere(), {"fov_y": 180}),
        ("near: got 0", ws.icosphere(), {"near": 0}),
    ],
)
def test_framing_names_the_argument_it_refuses(name, shown, options):
    with pytest.raises(ValueError, match=f"^{re.escape(name)}"):
        Camera.framing(shown, **options)


def test_look_at_and_from_opengl_agree():
    eye, target, up = np.array([1.0, 2.0, 3.0]), np.array([-0.5, 0.2, 0.1]), np.array([0.1, 1.0, 0.0])
    camera = Camera.look_at(eye, target, up=up, fov_y=35.0, size=SIZE, near=0.2)
    view = opengl_look_at(eye, target, up)
    top = 0.2 * np.tan(np.radians(17.5))
    right = top * SIZE[0] / SIZE[1]
    others = [
        Camera.from_opengl(view, fov_y=35.0, size=SIZE, near=0.2),
        Camera.from_opengl(view, opengl_frustum(-right, right, -top, top, 0.2, 50.0), size=SIZE),
    ]
    for other in others:
        np.testing.assert_allclose(other.clip_matrix(), camera.clip_matrix(), atol=1e-12)


def test_an_off_center_opengl_projection_maps_points_where_opengl_does():
    view = opengl_look_at(np.array([1.0, 2.0, 3.0]), np.zeros(3), np.array([0.0, 1.0, 0.0]))
    projection = opengl_frustum(-0.1, 0.3, -0.2, 0.15, 0.5, 20.0)
    points = np.random.default_rng(0).uniform(-0.3, 0.3, (20, 3))
    clip = np.column_stack([points, np.ones(20)]) @ (projection @ view).T
    ndc = clip[:, :2] / clip[:, 3:]
    expected = (ndc * (1, -1) + 1) / 2 * SIZE  # OpenGL's image starts at the bottom
    camera = Camera.from_opengl(view, projection, size=SIZE)
    np.testing.assert_allclose(camera.project(points), expected)
    assert camera.near == pytest.approx(0.5)


@settings(deadline=None, max_examples=25)
@given(st.integers(0, 2**32 - 1))
def test_rays_pass_through_the_centers_of_their_pixels(seed):
    rng = np.random.default_rng(seed)
    camera = Camera.look_at(rng.normal(size=3) * 3, rng.normal(size=3), up=rng.normal(size=3), size=(7, 5))
    origin, directions = camera.rays()
    assert directions.shape == (5, 7, 3)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=-1), 1.0)
    v, u = np.mgrid[:5, :7] + 0.5
    np.testing.assert_allclose(camera.project(origin + 2.5 * directions), np.stack([u, v], -1), atol=1e-9)


def test_clip_space_is_minus_one_at_the_left_and_top_edge_and_depth_falls_from_one_at_the_near_plane():
    camera = Camera(INTRINSICS, np.eye(3), np.zeros(3), *SIZE, near=0.25)
    ray = np.linalg.inv(INTRINSICS) @ [[0.0, 96.0], [0.0, 64.0], [1.0, 1.0]]  # top-left and bottom-right corner
    for distance in (0.25, 1.0, 1e6):
        points = np.vstack([ray * distance, np.ones(2)])
        clip = camera.clip_matrix() @ points
        np.testing.assert_allclose(clip[:2] / clip[3], [[-1, 1], [-1, 1]], atol=1e-12)
        np.testing.assert_allclose(clip[2] / clip[3], 0.25 / distance)


@pytest.mark.parametrize("factor", [2, 3, 0.5])
def test_a_resized_camera_has_the_same_view(factor):
    camera = Camera.look_at((1, 2, 3), (0, 0, 0), size=(64, 48))
    resized = camera.resized(factor)
    assert (resized.width, resized.height) == (64 * factor, 48 * factor)
    np.testing.assert_allclose(resized.clip_matrix(), camera.clip_matrix(), atol=1e-14)


def test_rotation_keeps_handedness():
    camera = Camera.look_at((1, 2, 3), (0, 0, 0), up=(0, 0, 1))
    np.testing.assert_allclose(np.cross(camera.rotation[0], camera.rotation[1]), camera.rotation[2], atol=1e-14)


VALID = {"intrinsics": INTRINSICS, "rotation": np.eye(3), "translation": np.zeros(3), "width": 4, "height": 4}


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("intrinsics", np.diag([0.0, 1.0, 1.0])),
        ("intrinsics", INTRINSICS * np.nan),
        ("intrinsics", np.eye(4)),
        ("intrinsics", 2.0 * INTRINSICS),
        ("rotation", np.diag([1.0, 1.0, -1.0])),
        ("rotation", 2.0 * np.eye(3)),
        ("rotation", np.full((3, 3), np.nan)),
        ("translation", np.array([0.0, np.inf, 0.0])),
        ("translation", np.zeros(2)),
        ("width", 0),
        ("width", 2.5),
        ("height", -3),
        ("near", 0.0),
        ("near", np.nan),
    ],
)
def test_a_camera_names_the_argument_it_refuses(name, value):
    with pytest.raises(ValueError, match=f"^{name}: got"):
        Camera(**{**VALID, name: value})


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("target", {"target": (0, 0, 5)}),
        ("up", {"up": (0, 0, -2)}),
        ("up", {"up": (0, 0, 0)}),
        ("up", {"up": (0, np.nan, 0)}),
        ("eye", {"eye": (0, np.inf, 0)}),
        ("fov_y", {"fov_y": 180.0}),
        ("fov_y", {"fov_y": np.nan}),
        ("fov_y", {"fov_y": "40"}),
        ("size", {"size": (1, 2, 3)}),
        ("size", {"size": "256x256"}),
        ("eye", {"eye": "front"}),
        ("eye", {"eye": None}),
        ("eye", {"eye": (0, (1, 2), 3)}),
        ("near", {"near": "0.1"}),
        ("size (width)", {"size": (0, 2)}),
        ("size (height)", {"size": (1, 2.0)}),
        ("near", {"near": -1.0}),
    ],
)
def test_look_at_names_the_argument_it_refuses(name, options):
    with pytest.raises(ValueError, match=f"^{re.escape(name)}: got"):
        Camera.look_at(**{"eye": (0, 0, 5), "target": (0, 0, 0), **options})


def test_a_field_of_view_that_may_be_radians_is_remarked_on():
    with pytest.warns(UserWarning, match="fov_y: got 0.7 degrees.* radians, they are 40.11 degrees"):
        Camera.look_at((0, 0, 5), (0, 0, 0), fov_y=0.7)


def test_from_opengl_names_the_argument_it_refuses():
    perspective = opengl_frustum(-1, 1, -1, 1, 0.1, 10)
    orthographic = np.diag([1.0, 1.0, -1.0, 1.0])
    with pytest.raises(ValueError, match="^projection: got"):
        Camera.from_opengl(np.eye(4), orthographic)
    with pytest.raises(ValueError, match="^view: got"):
        Camera.from_opengl(np.diag([2.0, 2.0, 2.0, 1.0]), perspective)
    with pytest.raises(ValueError, match="exactly one"):
        Camera.from_opengl(np.eye(4))
    with pytest.raises(ValueError, match="exactly one"):
        Camera.from_opengl(np.eye(4), perspective, fov_y=40.0)


@pytest.mark.parametrize(
    ("size", "factor", "expected"),
    [
        ((960, 540), 1 / 8, (120, 68)),
        ((959, 541), 1 / 4, (240, 135)),
        ((5, 4), 1e-3, (1, 1)),
        ((384, 255), 1 / 3, (128, 85)),
    ],
)
def test_a_camera_is_resized_to_whole_pixels_and_sees_the_same(size, factor, expected):
    camera = dataclasses.replace(
        Camera.look_at((1, 2, 3), (0, 0, 0), size=size),
        intrinsics=[[700, 1, 0.4 * size[0]], [0, 690, 0.6 * size[1]], [0, 0, 1]],
    )
    resized = camera.resized(factor)
    assert (resized.width, resized.height) == expected
    np.testing.assert_allclose(resized.clip_matrix(), camera.clip_matrix(), atol=1e-12)


def test_a_stretched_camera_sees_points_at_the_same_parts_of_its_image():
    camera = Camera.look_at((1, 2, 3), (0, 0, 0), size=(64, 48))
    stretched = camera.stretched(31, 90)
    points = np.random.default_rng(0).normal(0, 0.5, (20, 3))
    np.testing.assert_allclose(stretched.project(points) / (31, 90), camera.project(points) / (64, 48), atol=1e-12)
    with pytest.raises(ValueError, match="^size .height.: got"):
        camera.stretched(4, 0)


def to_device(values, dtype, device, requires_grad=False):
    return wp.array(np.asarray(values, np.float32), dtype=dtype, device=device, requires_grad=requires_grad)


def test_to_clip_then_pixels_equals_project(device):
    rng = np.random.default_rng(1)
    cameras = [Camera.look_at((1, 2, 3 + i), (0, 0.1, 0), size=SIZE) for i in range(3)]
    points = rng.uniform(-0.5, 0.5, (3, 11, 3)).astype(np.float32)
    matrices = to_device([c.clip_matrix() for c in cameras], wp.mat44, device)
    clip = to_clip(to_device(points, wp.vec3, device), matrices).numpy()
    for i, camera in enumerate(cameras):
        np.testing.assert_allclose(clip_to_pixels(clip[i], *SIZE), camera.project(points[i]), rtol=1e-5, atol=1e-4)


def test_one_instance_of_positions_or_cameras_serves_all_of_the_other(device):
    rng = np.random.default_rng(2)
    points, matrices = rng.normal(size=(2, 5, 3)), rng.normal(size=(2, 4, 4))
    full = to_clip(to_device(points, wp.vec3, device), to_device(matrices, wp.mat44, device)).numpy()
    one_camera = to_clip(to_device(points, wp.vec3, device), to_device(matrices[:1], wp.mat44, device)).numpy()
    one_mesh = to_clip(to_device(points[:1], wp.vec3, device), to_device(matrices, wp.mat44, device)).numpy()
    np.testing.assert_array_equal(one_camera[0], full[0])
    np.testing.assert_array_equal(one_mesh[0], full[0])
    homogeneous = np.concatenate([points, np.ones((2, 5, 1))], axis=-1)
    np.testing.assert_allclose(one_camera[1], homogeneous[1] @ matrices[0].T, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(one_mesh[1], homogeneous[0] @ matrices[1].T, rtol=1e-5, atol=1e-5)
    with pytest.raises(ValueError, match="^clip_matrices: got a batch of 2"):
        to_clip(to_device(np.zeros((3, 5, 3)), wp.vec3, device), to_device(matrices, wp.mat44, device))


def test_composed_clip_matrices_are_those_of_the_cameras(device):
    cameras = [
        Camera.look_at((1 + k, 2, 3), (0, 0.1 * k, 0), fov_y=30 + 5 * k, size=(40, 30), near=0.05) for k in range(3)
    ]
    parts = [
        np.stack([getattr(camera, name) for camera in cameras]) for name in ("intrinsics", "rotation", "translation")
    ]
    arrays = [to_device(part, dtype, device) for part, dtype in zip(parts, (wp.mat33, wp.mat33, wp.vec3), strict=True)]
    matrices = compose_clip_matrices(*arrays, size=(40, 30), near=0.05).numpy()
    expected = np.stack([camera.clip_matrix() for camera in cameras])
    np.testing.assert_allclose(matrices, expected, rtol=1e-5, atol=1e-5)
    one_lens = compose_clip_matrices(arrays[0][:1], *arrays[1:], size=(40, 30), near=0.05).numpy()
    np.testing.assert_array_equal(one_lens[0], matrices[0])
    with pytest.raises(ValueError, match="^translations: got a batch of 2, expected 1 or 3"):
        compose_clip_matrices(*arrays[:2], to_device(parts[2][:2], wp.vec3, device), size=(40, 30))
    with pytest.raises(ValueError, match="^near: got 0"):
        compose_clip_matrices(*arrays, size=(40, 30), near=0)


def tall_bar():
    """A bar that is wide, and deep: seen from the front it looks narrow."""
    return ws.icosphere(1.0, 3).transformed(scale=(0.5, 0.5, 2.0), translation=(3, 1, 0))


@pytest.mark.parametrize("size", [(64, 48), (48, 64)])
def test_cameras_around_a_body_show_all_of_it_where_the_first_does(size):
    bar = tall_bar()
    framing = ws.Camera.framing(bar, direction=(0, 0.3, 1), size=size)
    cameras = framing.around(bar, 8)
    for number, camera in enumerate(cameras):
        pixels = camera.project(bar.positions)
        assert (pixels > 0).all() and (pixels < size).all()
        turned = framing.turned(45 * number, (3, 1, 0))
        np.testing.assert_allclose(camera.rotation, turned.rotation, atol=1e-12)
        back = turned.rotation @ (camera.eye - turned.eye)
        np.testing.assert_allclose(back, (0, 0, back[2]), atol=1e-5)
        assert back[2] < 0
    nearest = min(np.minimum(c.project(bar.positions), size - c.project(bar.positions)).min() for c in cameras)
    assert 0 < nearest < 4  # no farther away than needed


def test_a_camera_that_shows_a_part_stays_as_near_on_its_way_around():
    bar = tall_bar()
    near = ws.Camera.look_at((3, 1, 2.5), (3, 1, 0), fov_y=10)
    for number, camera in enumerate(near.around(bar, 4)):
        np.testing.assert_allclose(camera.eye, near.turned(90 * number, (3, 1, 0)).eye, atol=1e-6)
