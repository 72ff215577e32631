"""Camera paths: through their keyframes, smooth between them, and files that read back."""

import numpy as np
import pytest

import warpshadow as ws

CAMERA = ws.Camera.look_at((0, 1, 5), (0, 0, 0), fov_y=35, size=(40, 30), near=0.02)

FILE = """
fps = 10
[[keyframe]]
time = 1.0
eye = [4, 1, 0]
target = [0, 0.5, 0]
[[keyframe]]
time = 2.0
eye = [0, 2, 4]
target = [0, 0, 0]
up = [0.1, 1, 0]
fov_y = 60
[[keyframe]]
time = 4.0
eye = [-4, 1, 0]
target = [0, 0.5, 0]
"""


def path_of(*eyes, **options):
    return ws.CameraPath([ws.Keyframe(k, eye, (0, 0, 0)) for k, eye in enumerate(eyes)], **options)


def test_a_path_goes_through_its_keyframes(tmp_path):
    (tmp_path / "path.toml").write_text(FILE)
    path = ws.CameraPath.read(tmp_path / "path.toml")
    cameras = path.cameras(CAMERA)
    assert path.frame_count == len(cameras) == 31
    assert repr(path) == "CameraPath(3 keyframes, 3 s, 31 frames)"
    at_keyframes = [((4, 1, 0), (0, 0.5, 0), (0, 1, 0), 35), ((0, 2, 4), (0, 0, 0), (0.1, 1, 0), 60)]
    at_keyframes.append(((-4, 1, 0), (0, 0.5, 0), (0, 1, 0), 35))
    for camera, (eye, target, up, fov_y) in zip((cameras[0], cameras[10], cameras[30]), at_keyframes, strict=True):
        expected = ws.Camera.look_at(eye, target, up=up, fov_y=fov_y, size=(40, 30), near=0.02)
        for name in ("intrinsics", "rotation", "translation"):
            np.testing.assert_allclose(getattr(camera, name), getattr(expected, name), atol=1e-12)
        assert (camera.width, camera.height, camera.near) == (40, 30, 0.02)


def test_a_path_has_no_corners_and_does_not_overshoot():
    eyes = np.array([cam.eye for cam in path_of((4, 1, 1), (0, 2, 4), (0, 2, 4), (-9, 1, 3), fps=500).cameras(CAMERA)])
    speeds = np.diff(eyes, axis=0) * 500
    assert np.abs(np.diff(speeds, axis=0)).max() < 0.15  # of up to 13; a corner would be a step of 4
    np.testing.assert_array_equal(eyes[500:1001], np.broadcast_to(eyes[500], (501, 3)))  # what stays, stays
    assert eyes[:, 0].min() >= -9 and eyes[:, 1].max() <= 2


def test_a_closed_path_ends_before_it_begins_again():
    path = path_of((4, 1, 0), (0, 1, 4), (-4, 1, 0), (0, 1, -4), fps=100, loop=1)
    eyes = np.array([camera.eye for camera in path.cameras(CAMERA)])
    assert len(eyes) == path.frame_count == 400 and repr(path).endswith("400 frames, closed)")
    around = np.concatenate([eyes, eyes[:2]])
    assert np.abs(np.diff(around, n=2, axis=0)).max() < 2e-3 < np.linalg.norm(np.diff(around, axis=0), axis=1).min()
    radii = np.linalg.norm(eyes[:, [0, 2]], axis=1)
    assert radii.max() <= 4 and radii.min() == pytest.approx(2.5 * 2**0.5)  # about a circle, half-way the worst


@pytest.mark.parametrize("loop", [None, 2.5])
def test_a_path_that_is_written_reads_back_the_same(tmp_path, loop):
    keyframes = [ws.Keyframe(0.1, (1, 2, 3), (0, 0, 0), (0, 0, 1), 33.3), ws.Keyframe(7, (4, 2, 3), (0, 0.1, 0))]
    path = ws.CameraPath(keyframes, fps=12.5, loop=loop)
    path.write(tmp_path / "a.toml")
    read = ws.CameraPath.read(tmp_path / "a.toml")
    assert (read.fps, read.loop, read.frame_count) == (path.fps, path.loop, path.frame_count)
    for got, expected in zip(read.cameras(CAMERA), path.cameras(CAMERA), strict=True):
        np.testing.assert_array_equal(got.clip_matrix(), expected.clip_matrix())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("time = 2.0", "time = 1.0"), r"keyframes\[1\]: time: got 1 after 1, expected rising times"),
        (("fps = 10", "fps = 0"), "fps: got 0, expected a positive number"),
        (("fps = 10", "speed = 10"), "unknown key 'speed'"),
        (("eye = [0, 2, 4]", ""), r"2nd \[\[keyframe\]\]: eye: missing"),
        (("up = [0.1, 1, 0]", "down = [0, 0, 0]"), r"2nd \[\[keyframe\]\]: unknown key 'down'"),
        (("time = 4.0", "time = 40000"), "expected at most 100000 frames; times are in seconds"),
        (("[[keyframe]]", "[[key]]"), "the camera path: unknown key 'key'"),
    ],
)
def test_a_mistake_in_a_file_is_named(tmp_path, change, message):
    (tmp_path / "path.toml").write_text(FILE.replace(*change))
    with pytest.raises(ValueError, match=rf"path\.toml: .*{message}"):
        ws.CameraPath.read(tmp_path / "path.toml")


def test_a_camera_between_keyframes_that_is_none_is_named():
    with pytest.raises(ValueError, match=r"the camera at 0\.5 s: target: got"):
        path_of((0, 0, 4), (0, 0, -4), fps=2).cameras(CAMERA)
    with pytest.raises(ValueError, match="keyframes: got 1, expected two or more"):
        path_of((0, 0, 4))


def test_a_path_ends_with_its_last_keyframe_whatever_the_frames_times_are():
    path = ws.CameraPath([ws.Keyframe(0, (0, 1, 5), (0, 0, 0)), ws.Keyframe(1.1, (5, 1, 0), (0, 0, 0))], fps=4)
    np.testing.assert_allclose(path.cameras(CAMERA)[-1].eye, (5, 1, 0), atol=1e-12)


def test_pixels_keep_their_shape_and_the_principal_point_its_place():
    intrinsics = [[44.0, 0, 12], [0, 22, 7], [0, 0, 1]]
    like = ws.Camera(intrinsics, CAMERA.rotation, CAMERA.translation, 32, 16, 0.02)
    own, wider = (ws.Keyframe(k, (4 - k, 1, 3), (0, 0, 0), fov_y=fov) for k, fov in enumerate((None, 60)))
    first, *_, last = ws.CameraPath([own, wider]).cameras(like)
    np.testing.assert_allclose(first.intrinsics, intrinsics, atol=1e-10)
    fy = 8 / np.tan(np.radians(30))
    np.testing.assert_allclose(last.intrinsics, [[2 * fy, 0, 12], [0, fy, 7], [0, 0, 1]], atol=1e-10)
