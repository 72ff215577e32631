"""Cameras of other libraries: points land where the formula of each convention, written out here, has them."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

import warpshadow as ws
from warpshadow.assets.camera import Camera

RVEC, TVEC = np.array([0.3, -0.5, 0.2]), np.array([0.1, -0.2, 4.0])
K = np.array([[310.0, 0.0, 155.5], [0.0, 290.0, 121.0], [0.0, 0.0, 1.0]])
SIZE = (320, 240)
POINTS = np.random.default_rng(0).normal(size=(50, 3)) * 0.7


def rotated(points, rvec):
    """Rodrigues' formula for each point, as in OpenCV's manual."""
    angle = np.linalg.norm(rvec)
    axis = rvec / angle
    along = np.outer(points @ axis, axis)
    return along + np.cos(angle) * (points - along) + np.sin(angle) * np.cross(axis, points)


def in_opencv(points):
    """Pixels of OpenCV's pinhole model; the center of the top left pixel is at (0, 0)."""
    x, y, z = (rotated(points, RVEC) + TVEC).T
    return np.stack([K[0, 0] * x / z + K[0, 2], K[1, 1] * y / z + K[1, 2]], axis=-1)


def assert_shows(camera, pixels, *, first_center):
    """Points are where a convention has them whose top left pixel has its center there: ours is at 0.5."""
    np.testing.assert_allclose(camera.project(POINTS), pixels + (0.5 - first_center), atol=1e-9)


@pytest.mark.parametrize("shape", [(3,), (3, 1), (1, 3)])
def test_a_camera_of_solve_pnp_shows_points_where_opencv_does(shape):
    camera = Camera.from_opencv(RVEC.reshape(shape), TVEC.reshape(shape), K, SIZE, np.zeros((5, 1)), near=0.2)
    assert_shows(camera, in_opencv(POINTS), first_center=0)
    assert (camera.width, camera.height, camera.near) == (*SIZE, 0.2)


def test_the_pixel_that_opencv_calls_a_whole_number_is_the_one_that_its_ray_goes_through():
    camera = Camera.from_opencv(RVEC, TVEC, K, SIZE)
    eye, directions = camera.rays()
    column, row = in_opencv((eye + 2.0 * directions[30, 70])[None])[0]
    assert (column, row) == (pytest.approx(70), pytest.approx(30))


def test_opencv_may_give_a_rotation_matrix():
    matrix = rotated(np.eye(3), RVEC).T
    assert_shows(Camera.from_opencv(matrix, TVEC, K, SIZE), in_opencv(POINTS), first_center=0)


@pytest.mark.parametrize("names", [("k", "d"), ("K", "D")])
def test_a_ros_camera_info_has_size_and_distortion(names):
    info = SimpleNamespace(width=SIZE[0], height=SIZE[1], **{names[0]: K.ravel().tolist(), names[1]: []})
    assert_shows(Camera.from_opencv(RVEC, TVEC, info), in_opencv(POINTS), first_center=0)
    setattr(info, names[1], [0.1, 0, 0, 0, 0])
    with pytest.raises(ValueError, match=r"^distortion: got \[0.1, .*cv2.undistort"):
        Camera.from_opencv(RVEC, TVEC, info)


def test_realsense_intrinsics_show_points_where_its_library_does():
    intrinsics = SimpleNamespace(width=320, height=240, fx=310.0, fy=290.0, ppx=155.5, ppy=121.0, coeffs=[0.0] * 5)
    # rs2_project_point_to_pixel without a lens: x/z fx + ppx; "(0, 0) is the center of the top left pixel"
    assert_shows(Camera.from_opencv(RVEC, TVEC, intrinsics), in_opencv(POINTS), first_center=0)
    intrinsics.coeffs = [0.2, 0, 0, 0, 0]
    with pytest.raises(ValueError, match="^distortion: got"):
        Camera.from_opencv(RVEC, TVEC, intrinsics)


@pytest.mark.parametrize(
    ("message", "given"),
    [
        ("rvec: got", {"rvec": np.zeros((2, 3))}),
        ("tvec: got", {"tvec": np.zeros((3, 3))}),
        ("tvec: got 1 NaN", {"tvec": [0, np.nan, 1]}),
        ("K: got", {"K": np.zeros((3, 4))}),
        ("K: got .*; the order is rvec, tvec, K", {"rvec": K, "tvec": RVEC, "K": TVEC}),
        ("size: missing", {"size": None}),
        ("distortion: got", {"distortion": [0, 0, 1e-3, 0]}),
        ("rotation: got", {"rvec": 2 * np.eye(3)}),
    ],
)
def test_from_opencv_names_the_argument_it_refuses(message, given):
    with pytest.raises(ValueError, match=f"^{message}"):
        Camera.from_opencv(**{"rvec": RVEC, "tvec": TVEC, "K": K, "size": SIZE} | given)


# ---------------------------------------------------------------------------------------------- PyTorch3D

R3D = rotated(np.eye(3), np.array([0.2, 3.0, 0.1])).T.T  # multiplies row vectors
T3D = np.array([0.1, 0.3, 5.0])


@pytest.mark.parametrize("size", [(320, 240), (200, 300), (64, 64)])
def test_a_pytorch3d_camera_in_ndc_shows_points_where_pytorch3d_does(size):
    width, height = size
    focal, principal = (1.7, 1.9), (0.1, -0.2)
    camera = Camera.from_pytorch3d(R3D[None], T3D[None], [focal], [principal], size=size)
    x, y, z = (POINTS @ R3D + T3D).T  # x left, y up
    ndc_x, ndc_y = focal[0] * x / z + principal[0], focal[1] * y / z + principal[1]
    # "NDC: +X left, +Y up, ±1 along the shorter side"; the rasterizer's first pixel is centered at 1 - 1/size
    shorter = min(size)
    pixels = np.stack([(width - shorter * ndc_x) / 2, (height - shorter * ndc_y) / 2], axis=-1)
    assert_shows(camera, pixels, first_center=0.5)


def test_a_pytorch3d_camera_in_pixels_shows_points_where_pytorch3d_does():
    camera = Camera.from_pytorch3d(R3D, T3D, 300.0, (150.0, 130.0), size=SIZE, in_ndc=False)
    x, y, z = (POINTS @ R3D + T3D).T
    assert_shows(camera, np.stack([150 - 300 * x / z, 130 - 300 * y / z], axis=-1), first_center=0.5)


@pytest.mark.parametrize("size", [(320, 240), (240, 320)])
def test_the_field_of_view_of_pytorch3d_spans_the_shorter_side(size):
    camera = Camera.from_pytorch3d(np.eye(3), (0, 0, 3), fov=60, size=size)
    end = np.tan(np.radians(30)) * 3
    point = (0, end, 0) if size[0] > size[1] else (end, 0, 0)  # up and left
    place = camera.project(point)
    assert place[1 if size[0] > size[1] else 0] == pytest.approx(0, abs=1e-9)


def test_from_pytorch3d_names_the_argument_it_refuses():
    for message, given in (("focal_length, fov: expected", {}), ("fov: got 200", {"fov": 200}), ("size", {"size": 0})):
        with pytest.raises(ValueError, match=f"^{message}"):
            Camera.from_pytorch3d(np.eye(3), np.zeros(3), **given)
    with pytest.raises(ValueError, match="^R: got"):
        Camera.from_pytorch3d(np.zeros((2, 3, 3)), np.zeros(3), 1.0)


# ---------------------------------------------------------------------------------------------- OpenGL


def test_view_and_projection_may_come_in_either_order():
    view = np.eye(4)
    view[:3, 3] = 0.1, 0.2, -4.0
    near, far = 0.5, 20.0
    projection = np.array(
        [[1.5, 0, 0.1, 0], [0, 2, -0.2, 0], [0, 0, -(far + near) / (far - near), -2 * far * near / (far - near)]]
        + [[0, 0, -1, 0]]
    )
    one, other = Camera.from_opengl(view, projection, size=SIZE), Camera.from_opengl(projection, view, size=SIZE)
    np.testing.assert_array_equal(one.clip_matrix(), other.clip_matrix())
    x, y, _, w = projection @ view @ np.column_stack([POINTS, np.ones(50)]).T
    pixels = np.stack([(x / w + 1) / 2 * 320, (1 - y / w) / 2 * 240], axis=-1)  # window coordinates, from the top
    assert_shows(one, pixels, first_center=0.5)


# ---------------------------------------------------------------------------------------------- COLMAP

QVEC = (0.9, -0.1, 0.3, 0.2) / np.linalg.norm((0.9, -0.1, 0.3, 0.2))


def in_colmap(points, fx, fy, cx, cy):
    """COLMAP's: a unit quaternion w, x, y, z turns the world; the first pixel is centered at (0.5, 0.5)."""
    w, *v = QVEC
    turned = points + 2 * w * np.cross(v, points) + 2 * np.cross(v, np.cross(v, points))
    x, y, z = (turned + TVEC).T
    return np.stack([fx * x / z + cx, fy * y / z + cy], axis=-1)


@pytest.mark.parametrize(("model", "params"), [("SIMPLE_PINHOLE", (300, 150, 130)), ("PINHOLE", (300, 310, 150, 130))])
def test_a_colmap_camera_shows_points_where_colmap_does(model, params):
    camera = Camera.from_colmap(QVEC, TVEC, model, params, SIZE)
    assert_shows(camera, in_colmap(POINTS, params[0], params[-3], *params[-2:]), first_center=0.5)


def test_from_colmap_names_the_argument_it_refuses():
    for message, given in (
        (r"model: got 'OPENCV'.*image_undistorter", {"model": "OPENCV"}),
        ("params: got", {"params": (1, 2, 3)}),
        ("qvec: got .*unit quaternion", {"qvec": (1, 1, 0, 0)}),
    ):
        arguments = {"qvec": QVEC, "tvec": TVEC, "model": "PINHOLE", "params": (300, 300, 160, 120), "size": SIZE}
        with pytest.raises(ValueError, match=f"^{message}"):
            Camera.from_colmap(**arguments | given)


def colmap_folder(folder):
    pose = " ".join(map(str, [*QVEC, *TVEC]))
    (folder / "cameras.txt").write_text("# Camera list\n1 SIMPLE_PINHOLE 320 240 300 150 130\n4 OPENCV 3 2 1 1 1 1 1\n")
    images = f"# Image list\n#   POINTS2D[] as (X, Y, POINT3D_ID)\n7 {pose} 1 left/a photo.jpg\n\n"
    (folder / "images.txt").write_text(f"{images}8 {pose} 1 b.jpg\n10 20 -1 30 40 5\n")
    return folder


def test_a_folder_of_colmap_gives_the_cameras_by_their_images(tmp_path):
    cameras = ws.load_cameras(colmap_folder(tmp_path))
    assert [str(path) for path in cameras] == ["left/a photo.jpg", "b.jpg"]
    for camera in cameras.values():
        assert_shows(camera, in_colmap(POINTS, 300, 300, 150, 130), first_center=0.5)
    (tmp_path / "images.txt").write_text("1 1 0 0 0 0 0 0 4 a.jpg\n\n")
    with pytest.raises(ValueError, match=r"images.txt: line 1: model: got 'OPENCV'"):
        ws.load_cameras(tmp_path)
    (tmp_path / "images.txt").unlink()
    with pytest.raises(FileNotFoundError, match=r"no images.txt in it; colmap model_converter"):
        ws.load_cameras(tmp_path)


def test_images_of_colmap_need_no_lines_of_points(tmp_path):
    lines = (colmap_folder(tmp_path) / "images.txt").read_text().splitlines()
    of_images = [line for line in lines if line.endswith(".jpg")]
    (tmp_path / "images.txt").write_text("\n" + "\n".join(of_images))
    assert [str(path) for path in ws.load_cameras(tmp_path)] == ["left/a photo.jpg", "b.jpg"]


# ---------------------------------------------------------------------------------------------- NeRF

TO_WORLD = np.eye(4)
TO_WORLD[:3, :3], TO_WORLD[:3, 3] = rotated(np.eye(3), np.array([0.1, 0.2, 0.3])).T, (0.2, -0.3, 4.0)


def in_nerf(points, fx, fy, cx, cy):
    """NeRF's rays, inverted: direction ((i - cx)/fx, -(j - cy)/fy, -1) in the camera of pixel (i, j)."""
    x, y, z = np.linalg.solve(TO_WORLD, np.column_stack([points, np.ones(len(points))]).T)[:3]
    return np.stack([cx + fx * x / -z, cy - fy * y / -z], axis=-1)


def transforms(path, frame=(), **keys):
    frames = [{"file_path": "./train/r_0", "transform_matrix": TO_WORLD.tolist(), **dict(frame)}]
    path.write_text(json.dumps({**keys, "frames": frames}))
    return path


def test_nerfs_transforms_give_the_cameras_by_their_images(tmp_path):
    path = transforms(tmp_path / "transforms.json", camera_angle_x=0.7)
    ((image, camera),) = ws.load_cameras(path, size=(200, 100)).items()
    assert image == tmp_path / "train/r_0.png"
    focal = 100 / np.tan(0.35)
    assert_shows(camera, in_nerf(POINTS, focal, focal, 100, 50), first_center=0.5)
    with pytest.raises(ValueError, match=r"frames\[0\]: w, h: missing, and there is no image"):
        ws.load_cameras(path)
    image.parent.mkdir()
    Image.new("RGB", (200, 100)).save(image)
    np.testing.assert_array_equal(ws.load_cameras(path)[image].clip_matrix(), camera.clip_matrix())


def test_transforms_with_focal_lengths_are_read_and_may_be_resized(tmp_path):
    keys = {"fl_x": 300, "fl_y": 310, "cx": 150, "cy": 130, "w": 320, "h": 240.0, "k1": 0}
    path = transforms(tmp_path / "transforms.json", [("fl_x", 305), ("file_path", "a.jpg")], **keys)
    pixels = in_nerf(POINTS, 305, 310, 150, 130)
    assert_shows(ws.load_cameras(path)[tmp_path / "a.jpg"], pixels, first_center=0.5)
    assert_shows(ws.load_cameras(path, size=(160, 120))[tmp_path / "a.jpg"], pixels / 2, first_center=0.5)


def test_a_world_with_z_up_is_turned(tmp_path):
    path = transforms(tmp_path / "transforms.json", fl_x=300, w=320, h=240)
    (plain,), (turned,) = (ws.load_cameras(path, up=up).values() for up in "yz")
    x, y, z = POINTS.T
    np.testing.assert_allclose(turned.project(np.stack([x, z, -y], axis=-1)), plain.project(POINTS))


@pytest.mark.parametrize(
    ("message", "keys", "frame"),
    [
        (r"frames\[0\]: k1: got 0.1, expected 0", {"k1": 0.1}, {}),
        (r"frames\[0\]: transform_matrix: missing", {}, {"transform_matrix": None}),
        (r"frames\[0\]: file_path: missing", {}, {"file_path": 3}),
        (r"frames\[0\]: rotation: got", {}, {"transform_matrix": (2 * np.eye(4)).tolist()}),
        (r"frames\[0\]: fl_x: missing", {"fl_x": None}, {}),
    ],
)
def test_transforms_that_cannot_be_used_say_where(tmp_path, message, keys, frame):
    given = {"fl_x": 300, "w": 320, "h": 240} | keys
    path = transforms(tmp_path / "transforms.json", frame, **{key: v for key, v in given.items() if v is not None})
    if frame.get("transform_matrix", 0) is None:
        path.write_text(path.read_text().replace("transform_matrix", "matrix"))
    with pytest.raises(ValueError, match=message):
        ws.load_cameras(path)


def test_files_that_are_no_cameras_are_refused(tmp_path):
    (tmp_path / "x.json").write_text("[1")
    for name, message in (("x.json", "got no JSON"), ("gone.json", "no such file or folder")):
        with pytest.raises((ValueError, FileNotFoundError), match=message):
            ws.load_cameras(tmp_path / name)


@pytest.mark.parametrize("keys", [{"camera_model": "OPENCV_FISHEYE"}, {"is_fisheye": True}])
def test_transforms_of_other_lenses_are_refused(tmp_path, keys):
    path = transforms(tmp_path / "transforms.json", w=64, h=40, camera_angle_x=0.8, **keys)
    with pytest.raises(ValueError, match="camera_model: got .*, expected a pinhole"):
        ws.load_cameras(path)


def test_each_axis_has_its_own_angle_of_view(tmp_path):
    path = transforms(tmp_path / "transforms.json", w=64, h=40, camera_angle_x=0.8, camera_angle_y=0.8)
    (camera,) = ws.load_cameras(path).values()
    assert np.diag(camera.intrinsics)[:2] == pytest.approx([32 / np.tan(0.4), 20 / np.tan(0.4)])


def test_an_image_that_is_listed_twice_is_refused(tmp_path):
    path = transforms(tmp_path / "transforms.json", w=64, h=40, camera_angle_x=0.8)
    document = json.loads(path.read_text())
    path.write_text(json.dumps({**document, "frames": 2 * document["frames"]}))
    with pytest.raises(ValueError, match=r"frames\[1\]: file_path: got .* twice"):
        ws.load_cameras(path)


def test_intrinsics_in_parts_of_the_image_are_refused():
    with pytest.raises(ValueError, match="K: got .*expected pixels"):
        ws.Camera.from_opencv(RVEC, TVEC, [[1.2, 0, 0.5], [0, 1.2, 0.5], [0, 0, 1]], (256, 256))
