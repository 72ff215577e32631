"""Videos: pictures one after another."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

from warpshadow import check
from warpshadow.assets import files
from warpshadow.assets.picture import Picture
from warpshadow.check import AnyPath

VIDEO_SUFFIXES = (".mp4", ".gif", ".webp")
"""What files of videos are called."""


def write_video(path: AnyPath, frames: Iterable[Picture | np.ndarray], *, fps: float = 24.0) -> None:
    """Write pictures as a video; the file appears complete or not at all. It repeats, but for .mp4.

    Args:
        path: A .gif or .webp file, or an .mp4 file (H.264), for which ``imageio-ffmpeg`` must be installed (the extra
            "video").
        frames: Pictures of one size, or images as :class:`Picture` takes them, which then all have the automatic
            exposure of the first. What is transparent is black.
        fps: Frames a second.

    Raises:
        ImportError: for an .mp4 file without ``imageio-ffmpeg``.
    """
    path = check.path("path", path)
    check_video(path)
    check.positive("fps", fps)
    check.instance("frames", frames, Iterable, "pictures, one after another")
    shown = _shown(frames)
    first = next(shown, None)
    if first is None:
        raise ValueError("frames: got none, expected at least one picture")
    with files.whole(path) as unfinished:
        write = _write_mp4 if path.suffix.lower() == ".mp4" else _write_animation
        write(unfinished, first, shown, fps)


def check_video(path: Path) -> None:
    """Raise ValueError unless a file's name is that of a video; ImportError for one that cannot be written here."""
    if path.suffix.lower() not in VIDEO_SUFFIXES:
        raise ValueError(f"{path}: got extension {path.suffix!r}, expected one of {', '.join(VIDEO_SUFFIXES)}")
    if path.suffix.lower() == ".mp4":
        try:
            import imageio_ffmpeg  # noqa: F401
        except ImportError as error:
            raise ImportError(
                f"{path}: imageio-ffmpeg is not installed (the extra 'video'); .gif and .webp need none"
            ) from error


def _shown(frames: Iterable[Picture | np.ndarray]) -> Iterator[np.ndarray]:
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


def _write_mp4(path: Path, first: np.ndarray, others: Iterator[np.ndarray], fps: float) -> None:
    import imageio_ffmpeg

    height, width, _ = first.shape
    odd = ((0, height % 2), (0, width % 2), (0, 0))  # H.264 halves its colors' size
    size = width + width % 2, height + height % 2
    writer = imageio_ffmpeg.write_frames(str(path), size, fps=fps, quality=8, macro_block_size=1)
    try:
        writer.send(None)
        for frame in itertools.chain([first], others):
            writer.send(np.pad(frame, odd, mode="edge").tobytes())
    finally:
        writer.close()


def _write_animation(path: Path, first: np.ndarray, others: Iterator[np.ndarray], fps: float) -> None:
    from PIL import Image

    rest = map(Image.fromarray, others)
    Image.fromarray(first).save(
        path, save_all=True, append_images=rest, duration=max(round(1000 / fps), 1), loop=0, quality=90
    )
