"""Videos: pictures one after another."""

import itertools
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

from warpshadow import check
from warpshadow.assets import files
from warpshadow.assets.picture import Picture
from warpshadow.check import AnyPath

_STEPS = {".gif": 10, ".webp": 1}  # unit of a frame's duration [ms]

_FASTEST = {".mp4": 1000, ".gif": 50, ".webp": 90}
"""Most frames a second; browsers show frames of 10 ms and less, of .gif and .webp, for 100 ms."""

_SLOWEST = 0.1

VIDEO_SUFFIXES = tuple(_FASTEST)  # suffixes of video files


def write_video(path: AnyPath, frames: Iterable[Picture | np.ndarray], *, fps: float = 24.0) -> None:
    """Write pictures as a video; the file appears complete or not at all. It repeats, but for .mp4.

    Args:
        path: A .gif or .webp file, or an .mp4 file (H.264), for which ``imageio-ffmpeg`` must be installed (the extra
            "video").
        frames: Pictures of one size, or images as :class:`Picture` takes them, which then all have the automatic
            exposure of the first. Transparent pixels become white.
        fps: Frames a second, 0.1 to 1000; up to 90 of .webp, and 50 of .gif, whose frames last 10 ms, 20 ms and so on:
            the next is shown when its time is nearest.
    Raises:
        ImportError: for an .mp4 file without ``imageio-ffmpeg``.
    """
    path = check.path("path", path)
    check_video(path, fps)
    check.instance("frames", frames, Iterable, "pictures, one after another")
    if isinstance(frames, np.ndarray) and frames.ndim != 4:
        raise ValueError(f"frames: got an array of shape {frames.shape}, expected [frame, height, width, channel]")
    shown_frames = _uint8_frames(frames)
    first = next(shown_frames, None)
    if first is None:
        raise ValueError("frames: got none, expected at least one picture")
    with files.atomic_write(path) as temporary_path:
        if path.suffix.lower() == ".mp4":
            _write_mp4(temporary_path, first, shown_frames, fps)
        else:
            _write_animation(temporary_path, first, shown_frames, fps, _STEPS[path.suffix.lower()])


def check_video(path: Path, fps: float) -> None:
    """Raise ValueError unless a file is called as videos are, and can have so many frames a second.

    Raises:
        ImportError: for one that cannot be written here.
    """
    if path.suffix.lower() not in VIDEO_SUFFIXES:
        raise ValueError(f"{path}: got extension {path.suffix!r}, expected one of {', '.join(VIDEO_SUFFIXES)}")
    maximum = _FASTEST[path.suffix.lower()]
    if not (check.is_number(fps) and _SLOWEST <= fps <= maximum):
        raise ValueError(f"fps: got {check.described(fps)}, expected {_SLOWEST} to {maximum} for {path.suffix}")
    if path.suffix.lower() == ".mp4":
        try:
            import imageio_ffmpeg  # noqa: F401
        except ImportError as error:
            missing = check.missing("an .mp4 file", "imageio-ffmpeg", "video")
            raise ImportError(f"{path}: {missing}; .gif and .webp need none") from error


def _uint8_frames(frames: Iterable[Picture | np.ndarray]) -> Iterator[np.ndarray]:
    """Frames of uint8, [height, width, 3], all of one size."""
    exposure, shape = None, None
    for number, frame in enumerate(frames):
        with check.located(f"frames[{number}]"):
            picture = frame if isinstance(frame, Picture) else Picture(frame, exposure=exposure)
            pixels = picture.opaque()
            exposure, shape = picture.exposure if exposure is None else exposure, shape or pixels.shape
            if pixels.shape != shape:
                raise ValueError(f"got shape {pixels.shape}, expected {shape}, as of the first")
        yield np.ascontiguousarray(pixels)


def _write_mp4(path: Path, first: np.ndarray, other_frames: Iterator[np.ndarray], fps: float) -> None:
    import imageio_ffmpeg

    height, width, _ = first.shape
    odd_padding = ((0, height % 2), (0, width % 2), (0, 0))  # H.264 halves its colors' size
    size = width + width % 2, height + height % 2
    writer = imageio_ffmpeg.write_frames(str(path), size, fps=fps, quality=8, macro_block_size=1)
    try:
        writer.send(None)
        for frame in itertools.chain([first], other_frames):
            writer.send(np.pad(frame, odd_padding, mode="edge").tobytes())
    finally:
        writer.close()


def _write_animation(path: Path, first: np.ndarray, other_frames: Iterator[np.ndarray], fps: float, step: int) -> None:
    from PIL import Image

    def time(frame: int) -> int:  # when it begins [ms]
        return step * round(1000 * frame / (step * fps))

    durations = [time(1)]

    def rest() -> Iterator[Image.Image]:
        for number, frame in enumerate(other_frames, start=1):
            durations.append(time(number + 1) - time(number))  # Pillow looks for it once it has the frame
            yield Image.fromarray(frame)

    Image.fromarray(first).save(path, save_all=True, append_images=rest(), duration=durations, loop=0, quality=90)
