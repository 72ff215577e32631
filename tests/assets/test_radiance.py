"""Radiance files: every encoding and orientation, and what is refused."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from warpshadow.assets.image import ImageError, read_image

PIXELS = np.random.default_rng(0).random((6, 8, 3), dtype=np.float32)


def float_to_rgbe(pixels):
    mantissa, exponent = np.frexp(pixels.max(axis=-1))
    scale = np.where(mantissa > 0, np.ldexp(1.0, 8 - exponent), 0)
    codes = np.floor(pixels * scale[..., None])
    return np.concatenate([codes, np.where(mantissa > 0, exponent + 128, 0)[..., None]], axis=-1).astype(np.uint8)


def encode_new(rgbe):
    """Encode scanlines the new way, alternating runs where values repeat and literals elsewhere."""
    data = bytearray()
    for line in rgbe:
        data += bytes([2, 2, len(line) >> 8, len(line) & 255])
        for plane in line.T.tolist():
            start = 0
            while start < len(plane):
                end = start + 1
                while end < min(len(plane), start + 127) and plane[end] == plane[start]:
                    end += 1
                if end - start > 1:
                    data += bytes([128 + end - start, plane[start]])
                else:
                    data += bytes([1, plane[start]])
                start = end
    return bytes(data)


def radiance_file(folder, body, resolution="-Y 6 +X 8", header="#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n"):
    path = folder / "a.hdr"
    path.write_bytes(f"{header}\n{resolution}\n".encode() + body)
    return path


RGBE = float_to_rgbe(np.repeat(PIXELS[:, :6], [1, 1, 2, 1, 1, 2], axis=1))
DECODED = np.ldexp(RGBE[..., :3].astype(np.float64), RGBE[..., 3:].astype(int) - 136)


@pytest.mark.parametrize("encode", [encode_new, lambda rgbe: rgbe.tobytes()], ids=["new", "flat"])
def test_a_radiance_file_is_decoded(tmp_path, encode):
    read = read_image(radiance_file(tmp_path, encode(RGBE)))
    assert read.dtype == np.float32
    np.testing.assert_array_equal(read, DECODED)


def test_old_style_runs_repeat_the_pixel_before(tmp_path):
    first, second = [128, 64, 32, 129], [1, 2, 3, 120]
    line = bytes([*first, 1, 1, 1, 3, *second, 1, 1, 1, 0, 1, 1, 1, 2])  # 1 + 3, then 1 + 0 + 2·256
    read = read_image(radiance_file(tmp_path, line * 2, "-Y 2 +X 517"))
    expected = np.repeat([[1.0, 0.5, 0.25], np.ldexp([1.0, 2, 3], 120 - 136)], [4, 513], axis=0)
    np.testing.assert_array_equal(read, [expected, expected])


@pytest.mark.parametrize(
    ("resolution", "turn"),
    [
        ("-Y 6 +X 8", lambda image: image),
        ("+Y 6 +X 8", lambda image: image[::-1]),
        ("-Y 6 -X 8", lambda image: image[:, ::-1]),
        ("+X 6 -Y 8", lambda image: image.swapaxes(0, 1)),
        ("+X 6 +Y 8", lambda image: image.swapaxes(0, 1)[::-1]),
        ("-X 6 -Y 8", lambda image: image.swapaxes(0, 1)[:, ::-1]),
    ],
)
def test_every_orientation_ends_with_the_top_in_row_zero(tmp_path, resolution, turn):
    np.testing.assert_array_equal(read_image(radiance_file(tmp_path, encode_new(RGBE), resolution)), turn(DECODED))


def test_exposures_and_color_corrections_are_divided_out(tmp_path):
    header = "#?RGBE\n# comment\nEXPOSURE=2\nFORMAT=32-bit_rle_rgbe\nEXPOSURE= 4.0\nCOLORCORR=1 2 4\n"
    read = read_image(radiance_file(tmp_path, encode_new(RGBE), header=header))
    np.testing.assert_array_equal(read, DECODED / [8, 16, 32])


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(8, 300))
def test_any_rgbe_survives_run_length_encoding(tmp_path_factory, seed, width):
    random = np.random.default_rng(seed)
    rgbe = random.integers(0, 3, (2, width, 4)).astype(np.uint8) * np.uint8([1, 1, 1, 70])  # exponent 0 is black
    path = radiance_file(tmp_path_factory.mktemp("hdr"), encode_new(rgbe), f"-Y 2 +X {width}")
    expected = rgbe[..., :3] * 2.0 ** (rgbe[..., 3:].astype(int) - 136) * (rgbe[..., 3:] > 0)
    np.testing.assert_array_equal(read_image(path), expected.astype(np.float32))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"header": "P6\n"}, "not a Radiance file"),
        ({"header": "#?RADIANCE\nFORMAT=32-bit_rle_xyze\n"}, "got format 32-bit_rle_xyze, expected 32-bit_rle_rgbe"),
        ({"header": "#?RADIANCE\nEXPOSURE=0\n"}, "got EXPOSURE=0, expected positive"),
        ({"header": "#?RADIANCE\nEXPOSURE=much\n"}, "got EXPOSURE=much, expected positive"),
        ({"resolution": "-Y 6"}, "got resolution line b'-Y 6"),
        ({"resolution": "-Y 6 +Y 8"}, "got resolution line"),
        ({"resolution": "-Y 0 +X 8"}, "got 8 x 0 pixels"),
        ({"resolution": "-Y 99999 +X 99999"}, "got 99999 x 99999 pixels, expected 1 to 268435456"),
        ({"resolution": "-Y 7 +X 8"}, "truncated or damaged: line 6 of 7"),
        ({"resolution": "-Y 6 +X 9"}, "truncated or damaged: line 0 of 6"),
        ({"body": encode_new(RGBE)[:-1]}, "truncated or damaged: line 5 of 6"),
        ({"body": b""}, "truncated or damaged: line 0 of 6"),
        ({"body": b"\1\1\1\7" * 48}, "truncated or damaged: line 0 of 6"),
        ({"body": RGBE.tobytes()[:-3]}, "truncated or damaged: line 5 of 6"),
    ],
)
def test_a_bad_radiance_file_is_refused_with_its_line(tmp_path, change, message):
    with pytest.raises(ImageError, match=message):
        read_image(radiance_file(tmp_path, **{"body": encode_new(RGBE), **change}))
