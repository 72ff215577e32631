"""Radiance files (.hdr, .pic): colors of 8 bits with a common exponent (RGBE)."""

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np

_RESOLUTION = re.compile(rb"([+-])([XY]) +(\d+) +([+-])([XY]) +(\d+)\s*")


def read_radiance(path: Path, check_size: Callable[[int, int], None]) -> np.ndarray:
    """Read RGBE: Ward, "Real Pixels", Graphics Gems II, and the file format notes of Radiance.

    By hand: OpenImageIO (an 8 MB wheel) leaves the exposure in and fails at old-style runs; imageio needs OpenCV.

    Args:
        check_size: Raises for a width and height that are too large, before any pixel is read.
    Returns:
        Linear RGB with row 0 at the top and the exposure divided out, float32 [height, width, 3].
    Raises:
        ValueError: for a file of another format, or a truncated one; the message leaves the path out.
    """
    with path.open("rb") as file:
        if not file.readline(80).startswith((b"#?RADIANCE", b"#?RGBE")):
            raise ValueError("not a Radiance file: it does not start with #?RADIANCE or #?RGBE")
        exposure = np.ones(3)
        while line := file.readline(4096).strip():
            key, _, value = line.partition(b"=")
            if key == b"FORMAT" and value.strip() != b"32-bit_rle_rgbe":
                raise ValueError(f"got format {value.strip().decode(errors='replace')}, expected 32-bit_rle_rgbe")
            if key in (b"EXPOSURE", b"COLORCORR"):  # the product of all, already multiplied into the pixels
                exposure *= _positive_numbers(key, value)
        resolution = _RESOLUTION.fullmatch(line := file.readline(80))
        if not resolution or resolution[2] == resolution[5]:
            raise ValueError(f"got resolution line {line!r}, expected one like b'-Y 512 +X 1024'")
        major_sign, major_axis, major, minor_sign, _, minor = resolution.groups()
        major, minor = int(major), int(minor)
        check_size(minor, major)
        rgbe = _decode_rgbe(file.read(), major, minor)
    pixels = np.ldexp(rgbe[..., :3].astype(np.float32), rgbe[..., 3:].astype(np.int32) - (128 + 8))
    pixels[rgbe[..., 3] == 0] = 0
    if major_axis == b"X":
        pixels, major_sign, minor_sign = pixels.swapaxes(0, 1), minor_sign, major_sign
    # Radiance's Y points up and its X right; ours is row 0 at the top.
    pixels = pixels[:: -1 if major_sign == b"+" else 1, :: -1 if minor_sign == b"-" else 1]
    return np.ascontiguousarray(pixels / exposure.astype(np.float32))


def _positive_numbers(key: bytes, value: bytes) -> np.ndarray:
    """One number, or three, of a header line."""
    try:
        numbers = np.array(value.split(), dtype=np.float64)
    except ValueError:
        numbers = np.empty(0)
    if numbers.size not in (1, 3) or not (np.isfinite(numbers) & (numbers > 0)).all():
        raise ValueError(f"got {key.decode()}={value.decode(errors='replace')}, expected positive numbers")
    return numbers


def _decode_rgbe(data: bytes, line_count: int, width: int) -> np.ndarray:
    """Decode scanlines, each flat or run-length encoded in the old or new way, to uint8 [line, pixel, 4]."""
    lines = np.empty((line_count, width, 4), dtype=np.uint8)
    start = 0
    for line in range(line_count):
        is_new_style = (
            8 <= width < 32768 and data[start : start + 2] == b"\2\2" and data[start + 2 : start + 3] < b"\x80"
        )
        decode = _decode_planes if is_new_style else _decode_pixels
        try:
            lines[line], start = decode(data, start, width)
        except (IndexError, ValueError):
            raise ValueError(f"truncated or damaged: line {line} of {line_count} cannot be decoded") from None
    return lines


def _decode_planes(data: bytes, start: int, width: int) -> tuple[np.ndarray, int]:
    """Decode a new-style line: four planes of runs (count above 128, value) and literals (count, values)."""
    if data[start + 2] << 8 | data[start + 3] != width:
        raise ValueError("the line has another width")
    start += 4
    plane = bytearray()
    while len(plane) < 4 * width:
        count = data[start]
        if count > 128:
            plane += data[start + 1 : start + 2] * (count - 128)
            start += 2
        else:
            plane += data[start + 1 : start + 1 + count]
            start += 1 + count
    return np.frombuffer(plane, dtype=np.uint8).reshape(4, width).T, start


def _decode_pixels(data: bytes, start: int, width: int) -> tuple[np.ndarray, int]:
    """Decode a flat or old-style line: (1, 1, 1, n) repeats a pixel n times, a second in a row 256 n."""
    pixels = np.frombuffer(data, dtype=np.uint8, offset=start, count=min(width, (len(data) - start) // 4) * 4)
    pixels = pixels.reshape(-1, 4)
    index = np.arange(len(pixels))
    is_run = (pixels[:, :3] == 1).all(axis=1)
    source = np.maximum.accumulate(np.where(is_run, -1, index))
    shift = np.minimum(8 * (index - source - 1), 24)
    counts = np.where(is_run, pixels[:, 3].astype(np.int64) << np.maximum(shift, 0), 1)
    run_count = int(np.searchsorted(np.cumsum(counts), width)) + 1
    if counts[:run_count].sum() != width or source[0] < 0:
        raise ValueError("the line has another width")
    return pixels[np.repeat(source[:run_count], counts[:run_count])], start + 4 * run_count
