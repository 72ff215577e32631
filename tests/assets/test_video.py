"""Videos: frames come back in order, at one exposure, whole or not at all."""

import sys

import numpy as np
import pytest

import warpshadow as ws

COLORS = [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)]


def frames(height=34, width=51):
    """Frames of one color each, the first half as bright: under its exposure the others saturate."""
    return [np.full((height, width, 3), color, np.float32) * (0.5 if k == 0 else 1) for k, color in enumerate(COLORS)]


def read_back(path):
    """Frames of uint8, [frame, height, width, 3]."""
    if path.suffix == ".mp4":
        import imageio_ffmpeg

        stream = imageio_ffmpeg.read_frames(str(path))
        width, height = next(stream)["size"]
        return np.stack([np.frombuffer(frame, np.uint8).reshape(height, width, 3) for frame in stream])
    from PIL import Image, ImageSequence

    with Image.open(path) as file:
        return np.stack([np.asarray(frame.convert("RGB")) for frame in ImageSequence.Iterator(file)])


@pytest.mark.parametrize("suffix", ["mp4", "gif", "webp"])
@pytest.mark.parametrize("kind", ["images", "pictures", "generator"])
def test_frames_come_back_in_order(tmp_path, suffix, kind):
    if suffix == "mp4":
        pytest.importorskip("imageio_ffmpeg")
    given = [ws.Picture(frame) for frame in frames()] if kind == "pictures" else frames()
    path = tmp_path / f"a.{suffix}"
    ws.write_video(path, iter(given) if kind == "generator" else given, fps=10)
    read = read_back(path)
    assert read.shape == (3, 34, 52 if suffix == "mp4" else 51, 3)  # H.264 has even sizes
    for got, color in zip(read[:, 4:30, 4:40].mean(axis=(1, 2)), COLORS, strict=True):
        assert np.abs(got - 255 * np.array(color)).max() < 8  # what is lossy loses


def test_images_have_the_exposure_of_the_first(tmp_path):
    first, second = np.full((8, 8, 3), 2.0, np.float32), np.full((8, 8, 3), 0.5, np.float32)
    ws.write_video(tmp_path / "a.gif", [first, second])
    expected = ws.Picture(second, exposure=-1).pixels.astype(int)
    assert np.abs(read_back(tmp_path / "a.gif")[1] - expected).max() <= 2


@pytest.mark.parametrize("name", ["a.gif", "a.webp"])
def test_what_is_transparent_is_white(tmp_path, name):
    half = np.full((8, 8, 4), [0.0, 0.0, 0.0, 0.5], np.float32)
    ws.write_video(tmp_path / name, [np.zeros((8, 8, 4), np.float32), half])
    empty, shadow = read_back(tmp_path / name)[:, 4, 4].astype(int)
    assert (empty >= 254).all() and np.abs(shadow - 188).max() <= 2  # half of white, in sRGB


@pytest.mark.parametrize(
    ("name", "given", "options", "message"),
    [
        ("a.avi", frames(), {}, "a.avi: got extension '.avi', expected one of .mp4, .gif, .webp"),
        ("a.gif", [], {}, "frames: got none"),
        ("a.gif", 3, {}, "frames: got 3, expected pictures"),
        ("a.gif", [*frames(), np.ones((2, 2, 3), np.float32)], {}, r"frames\[3\]: got shape \(2, 2, 3\)"),
        ("a.gif", [*frames(), np.full((34, 51, 3), np.nan)], {}, r"frames\[3\]: image: got 5202 NaN"),
        ("a.gif", frames(), {"fps": 0}, "fps: got 0"),
        ("a.gif", frames(), {"fps": 60}, "fps: got 60, expected 0.1 to 50 for .gif"),
        ("a.webp", frames(), {"fps": 1e-9}, "fps: got 1e-09, expected 0.1 to 90"),
        ("a.gif", np.ones((8, 8, 4)), {}, r"frames: got an array of shape \(8, 8, 4\), expected \[frame, height"),
    ],
)
def test_what_is_refused_leaves_the_old_file(tmp_path, name, given, options, message):
    (tmp_path / name).write_text("old")
    with pytest.raises(ValueError, match=message):
        ws.write_video(tmp_path / name, given, **options)
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [(name, "old")]


@pytest.mark.parametrize("fps", [7, 12, 24, 30, 48])
@pytest.mark.parametrize("suffix", ["gif", "webp"])
def test_a_video_lasts_as_long_as_its_frames(tmp_path, suffix, fps):
    """To half a step, 10 ms or 1 ms, where each frame alone would be off by as much."""
    from PIL import Image, ImageSequence

    path = tmp_path / f"a.{suffix}"
    ws.write_video(path, np.random.default_rng(0).random((40, 8, 8, 3)), fps=fps)
    with Image.open(path) as file:
        frames = ImageSequence.Iterator(file)
        durations = [frame.info["duration"] for frame in frames if frame.load() is not None]
    assert len(durations) == 40
    assert abs(sum(durations) - 40e3 / fps) <= (5 if suffix == "gif" else 0.5)
    assert np.ptp(durations) <= (10 if suffix == "gif" else 1)


def test_without_ffmpeg_an_mp4_is_refused_and_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(
        ImportError, match=r'imageio-ffmpeg: pip install "warpshadow\[video\]"; .gif and .webp need none'
    ):
        ws.write_video(tmp_path / "a.mp4", frames())
