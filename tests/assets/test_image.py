"""Picture files: what each format gives, what is refused and how, and that writing is all or nothing."""

import struct
import sys
import zlib

import numpy as np
import pytest

from warpshadow.assets.color import srgb_to_linear
from warpshadow.assets.image import ImageError, read_image, write_image
from warpshadow.assets.picture import Picture

RANDOM = np.random.default_rng(0)
PIXELS = RANDOM.random((6, 8, 3), dtype=np.float32)


def write_exr(path, channels, **header):
    import OpenEXR

    header = {"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION, **header}
    OpenEXR.File(header, channels).write(str(path))
    return path


def srgb_twin(code):
    """IEC 61966-2-1, one number at a time."""
    return code / 12.92 if code <= 0.04045 else ((code + 0.055) / 1.055) ** 2.4


# ------------------------------------------------------------------------------------------------ OpenEXR


@pytest.mark.parametrize("shape", [(4, 6), (4, 6, 1), (4, 6, 3), (4, 6, 4), (1, 1, 3)])
def test_an_exr_reads_back_every_float32(tmp_path, shape):
    pixels = RANDOM.normal(size=shape).astype(np.float32) * np.float32(1e30)
    pixels.flat[0] = np.inf
    write_image(tmp_path / "a.exr", pixels)
    read = read_image(tmp_path / "a.exr")
    assert read.dtype == np.float32
    np.testing.assert_array_equal(read, pixels.reshape(*shape[:2], -1))


def test_channels_of_every_pixel_type_are_read(tmp_path):
    channels = {"R": PIXELS[..., 0].astype(np.float16), "G": PIXELS[..., 1].copy()}
    channels["B"] = (PIXELS[..., 2] * 1000).astype(np.uint32)
    read = read_image(write_exr(tmp_path / "a.exr", dict(channels)))  # OpenEXR replaces the values
    expected = np.stack([channels[name].astype(np.float32) for name in "RGB"], axis=-1)
    np.testing.assert_array_equal(read, expected)


def test_tiles_are_read(tmp_path):
    import OpenEXR

    tiles = OpenEXR.TileDescription()
    tiles.xSize = tiles.ySize = 4
    path = write_exr(tmp_path / "a.exr", {"RGB": PIXELS}, type=OpenEXR.tiledimage, tiles=tiles)
    np.testing.assert_array_equal(read_image(path), PIXELS)


def test_a_part_is_chosen_by_name_or_index_and_the_first_by_default(tmp_path):
    import OpenEXR

    path = tmp_path / "a.exr"
    header = {"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION}
    parts = [
        OpenEXR.Part({**header, "name": name}, {"RGB": PIXELS + i}, name) for i, name in enumerate(["left", "right"])
    ]
    OpenEXR.File(parts).write(str(path))
    for part, expected in ((None, PIXELS), (0, PIXELS), ("left", PIXELS), (1, PIXELS + 1), ("right", PIXELS + 1)):
        np.testing.assert_array_equal(read_image(path, part=part), expected)
    for part in ("middle", 2, -1):
        with pytest.raises(ImageError, match=f"got part {part!r}, expected 0 to 1 or one of 'left', 'right'"):
            read_image(path, part=part)
    content = path.read_bytes()
    path.write_bytes(content[:-20])
    with pytest.raises(ImageError, match="truncated or damaged: only 1 of 2 parts"):
        read_image(path)


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        ("R G B", "R G B"),
        ("R G B A", "R G B A"),
        ("R G B Z", "R G B"),
        ("Y", "Y"),
        ("Y A", "Y A"),
        ("Y R G B", "R G B"),
        ("sun.R sun.G sun.B sun.A Z", "sun.R sun.G sun.B sun.A"),
        ("a.b.Y", "a.b.Y"),
        ("R G B sun.R sun.G sun.B", "R G B"),
    ],
)
def test_color_is_found_in_the_unnamed_or_the_only_layer(tmp_path, names, expected):
    planes = {name: np.full((2, 4), i, np.float32) for i, name in enumerate(names.split())}
    read = read_image(write_exr(tmp_path / "a.exr", planes))
    np.testing.assert_array_equal(read[0, 0], [names.split().index(name) for name in expected.split()])


@pytest.mark.parametrize("names", ["Z", "R G", "sun.R sun.G sun.B sky.R sky.G sky.B"])
def test_other_channels_are_refused_by_name(tmp_path, names):
    path = write_exr(tmp_path / "a.exr", {name: PIXELS[..., 0].copy() for name in names.split()})
    with pytest.raises(ImageError, match="got channels .*expected R, G, B or Y, in one layer") as error:
        read_image(path)
    assert all(name in str(error.value) for name in names.split())


def test_subsampled_channels_are_refused(tmp_path):
    import OpenEXR

    path = write_exr(tmp_path / "a.exr", {"Y": OpenEXR.Channel("Y", PIXELS[..., 0].copy(), 2, 2)})
    with pytest.raises(ImageError, match="got subsampled channels among Y"):
        read_image(path)


def test_a_deep_exr_is_refused(tmp_path):
    import OpenEXR

    samples = np.empty((4, 6), dtype=object)
    for index in np.ndindex(*samples.shape):
        samples[index] = np.arange(1 + sum(index) % 2, dtype=np.float32)
    channel = {"Z": OpenEXR.Channel("Z", samples)}
    path = write_exr(tmp_path / "a.exr", channel, type=OpenEXR.deepscanline, compression=OpenEXR.ZIPS_COMPRESSION)
    with pytest.raises(ImageError, match="got deep pixels"):
        read_image(path)


@pytest.mark.parametrize("keep", [0, 3, 60, -1000, -1])
def test_a_truncated_exr_is_refused(tmp_path, keep):
    path = tmp_path / "a.exr"
    write_image(path, RANDOM.random((64, 64, 3)))
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.raises(ImageError, match="a.exr: (truncated or damaged|not an OpenEXR file)"):
        read_image(path)


@pytest.mark.parametrize(
    ("window", "message"),
    [
        ((0, 0, 299999, 199999), "got 300000 x 200000 pixels, expected 1 to 268435456"),
        ((0, 0, 2**31 - 2, 2**30), "header is damaged"),
        ((5, 5, 4, 4), "header is damaged"),
    ],
)
def test_an_absurd_size_is_refused_by_the_header(tmp_path, window, message):
    path = write_exr(tmp_path / "a.exr", {"RGB": PIXELS})
    content = bytearray(path.read_bytes())
    start = content.find(b"dataWindow\0box2i\0") + len(b"dataWindow\0box2i\0") + 4
    content[start : start + 16] = struct.pack("<4i", *window)
    path.write_bytes(content)
    with pytest.raises(ImageError, match=message):
        read_image(path)


# ---------------------------------------------------------------------------------------------- PNG and JPEG


def png16(samples):
    """A PNG file of 16 bits per channel, which Pillow writes only in gray; the second row is filtered."""
    height, width, channels = samples.shape
    rows = [row.astype(">u2").tobytes() for row in samples]
    left = bytes(2 * channels) + rows[1][: -2 * channels]
    rows[1] = bytes((here - before) % 256 for here, before in zip(rows[1], left, strict=True))
    data = zlib.compress(b"".join(bytes([number == 1]) + row for number, row in enumerate(rows)))
    header = struct.pack(">IIBBBBB", width, height, 16, {1: 0, 2: 4, 3: 2, 4: 6}[channels], 0, 0, 0)
    chunks = [(b"IHDR", header), (b"IDAT", data), (b"IEND", b"")]
    packed = (struct.pack(">I", len(d)) + t + d + struct.pack(">I", zlib.crc32(t + d)) for t, d in chunks)
    return b"\x89PNG\r\n\x1a\n" + b"".join(packed)


def tiff(samples, *, order="<", packed=False, tags=None):
    """A TIFF file of one strip, packed as ZIP or not; tags are numbers or bytes, in place of the usual ones."""
    height, width, channels = samples.shape
    data = samples.astype(samples.dtype.newbyteorder(order)).tobytes()
    data = zlib.compress(data) if packed else data
    entries = {256: width, 257: height, 258: (8 * samples.itemsize,) * channels, 259: 8 if packed else 1}
    entries |= {262: 1 if channels == 1 else 2, 273: 8, 277: channels, 278: height, 279: len(data)}
    entries |= {338: 2} if channels == 4 else {}
    entries = dict(sorted((entries | (tags or {})).items()))
    start = 8 + len(data) + len(data) % 2
    after, directory, more = start + 2 + 12 * len(entries) + 4, b"", b""
    for tag, value in entries.items():
        kind, values = (1, value) if isinstance(value, bytes) else (4, value if isinstance(value, tuple) else (value,))
        content = bytes(values) if kind == 1 else struct.pack(f"{order}{len(values)}I", *values)
        if len(content) > 4:
            content, more = struct.pack(f"{order}I", after + len(more)), more + content
        directory += struct.pack(f"{order}HHI", tag, kind, len(values)) + content.ljust(4, b"\0")
    magic = (b"II" if order == "<" else b"MM") + struct.pack(f"{order}HI", 42, start)
    directory = struct.pack(f"{order}H", len(entries)) + directory + bytes(4)
    return magic + data.ljust(start - 8, b"\0") + directory + more


@pytest.mark.parametrize("mode", ["L", "LA", "RGB", "RGBA"])
def test_every_8_bit_code_is_decoded_exactly_and_alpha_stays_linear(tmp_path, mode):
    from PIL import Image

    codes = np.arange(256, dtype=np.uint8).reshape(16, 16)
    Image.merge(mode, [Image.fromarray(np.roll(codes, i)) for i in range(len(mode))]).save(tmp_path / "a.png")
    read = read_image(tmp_path / "a.png")
    assert read.shape == (16, 16, len(mode))
    for channel, name in enumerate(mode):
        decode = (lambda code: code) if name == "A" else srgb_twin
        expected = np.float32([decode(code / 255) for code in np.roll(codes, channel).ravel()])
        np.testing.assert_allclose(read[..., channel].ravel(), expected, rtol=1e-7)


def test_16_bit_gray_is_decoded_in_full(tmp_path):
    codes = RANDOM.integers(0, 65536, (4, 6, 1))
    (tmp_path / "a.png").write_bytes(png16(codes))
    expected = [srgb_twin(code / 65535) for code in codes.ravel()]
    np.testing.assert_allclose(read_image(tmp_path / "a.png").ravel(), expected, rtol=2e-7)


def decoded_16(codes):
    """Linear values of 16-bit codes, whose fourth channel is alpha."""
    decoded = np.vectorize(srgb_twin)(codes / 65535)
    decoded[..., 3:] = codes[..., 3:] / 65535
    return decoded


FILES_16 = {
    "a.png": png16,
    "a.tif": tiff,
    "big.tiff": lambda codes: tiff(codes, order=">"),
    "zip.tif": lambda codes: tiff(codes, packed=True),
}


@pytest.mark.parametrize("name", FILES_16)
@pytest.mark.parametrize("channels", [3, 4])
def test_16_bit_color_is_decoded_in_full(tmp_path, name, channels):
    codes = RANDOM.integers(0, 65536, (4, 6, channels)).astype(np.uint16)
    (tmp_path / name).write_bytes(FILES_16[name](codes))
    np.testing.assert_allclose(read_image(tmp_path / name), decoded_16(codes), rtol=2e-7)


def test_16_bit_gray_with_alpha_warns_that_it_is_read_at_8_bits(tmp_path):
    codes = RANDOM.integers(0, 65536, (4, 6, 2))
    (tmp_path / "a.png").write_bytes(png16(codes))
    with pytest.warns(UserWarning, match="16-bit color is read at 8 bits") as caught:
        read = read_image(tmp_path / "a.png")
    assert caught[0].filename == __file__
    expected = [srgb_twin(code / 255) for code in (codes[..., 0] // 256).ravel()]
    np.testing.assert_allclose(read[..., 0].ravel(), expected, rtol=1e-6)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("channels", [1, 3])
def test_a_tiff_is_turned_upright(tmp_path, dtype, channels):
    codes = RANDOM.integers(0, np.iinfo(dtype).max, (4, 6, channels)).astype(dtype)
    (tmp_path / "a.tif").write_bytes(tiff(codes, tags={274: 6}))
    expected = np.vectorize(srgb_twin)(np.rot90(codes, -1) / np.iinfo(dtype).max)
    np.testing.assert_allclose(read_image(tmp_path / "a.tif"), expected, rtol=2e-7)


def test_a_tiff_of_other_numbers_is_refused(tmp_path):
    (tmp_path / "a.tif").write_bytes(tiff(np.ones((4, 6, 1), np.float32), tags={339: 3}))
    with pytest.raises(ImageError, match="a.tif: got 32 bits for each color, expected 8 or 16"):
        read_image(tmp_path / "a.tif")


def test_palettes_become_colors(tmp_path):
    from PIL import Image

    codes = RANDOM.integers(0, 256, (4, 4, 3)).astype(np.uint8)
    Image.fromarray(codes).quantize(16).save(tmp_path / "palette.png")
    np.testing.assert_array_equal(read_image(tmp_path / "palette.png"), srgb_to_linear(codes / 255).astype(np.float32))


@pytest.mark.parametrize("channels", [1, 3])
def test_a_written_png_is_rounded_and_clipped_in_srgb(tmp_path, channels):
    codes = RANDOM.integers(0, 256, (5, 7, channels)) / 255
    pixels = np.vectorize(srgb_twin)(codes)
    pixels[0, 0], pixels[0, 1], pixels[0, 2] = -1, 7, np.inf
    write_image(tmp_path / "a.png", pixels)
    np.testing.assert_allclose(read_image(tmp_path / "a.png"), np.clip(pixels, 0, 1), rtol=1e-6)


@pytest.mark.parametrize("name", ["a.png", "a.jpg"])
def test_an_image_with_coverage_is_written_as_a_picture(tmp_path, name):
    image = RANDOM.random((5, 7, 4))
    for number, pixels in enumerate((image, Picture(image))):
        write_image(tmp_path / f"{number}{name}", pixels)
    Picture(image).write(tmp_path / name)
    assert len({path.read_bytes() for path in tmp_path.iterdir()}) == 1
    with pytest.raises(ImageError, match="got extension '.exr', expected one of .png"):
        write_image(tmp_path / "a.exr", Picture(image))


ORIENTATIONS = {
    1: lambda stored: stored,
    2: lambda stored: stored[:, ::-1],
    3: lambda stored: stored[::-1, ::-1],
    4: lambda stored: stored[::-1],
    5: lambda stored: stored.swapaxes(0, 1),
    6: lambda stored: np.rot90(stored, -1),
    7: lambda stored: stored[::-1, ::-1].swapaxes(0, 1),
    8: lambda stored: np.rot90(stored),
}
"""What a viewer makes of stored rows and columns (EXIF 2.3, tag 274: where row 0 and column 0 are)."""


@pytest.mark.parametrize("orientation", ORIENTATIONS)
@pytest.mark.parametrize("name", ["a.jpg", "a.png"])
@pytest.mark.parametrize("mode", ["L", "RGB"])
def test_a_photograph_is_turned_upright_as_viewers_do(tmp_path, orientation, name, mode):
    from PIL import Image

    stored = Image.fromarray(np.kron([[0, 80, 160], [240, 200, 120]], np.ones((8, 8))).astype(np.uint8)).convert(mode)
    exif = Image.Exif()
    exif[0x0112] = orientation
    stored.save(tmp_path / f"plain{name}", quality=95)
    stored.save(tmp_path / name, quality=95, exif=exif)
    expected = ORIENTATIONS[orientation](read_image(tmp_path / f"plain{name}"))
    np.testing.assert_array_equal(read_image(tmp_path / name), expected)


def test_16_bit_gray_is_turned_upright_too(tmp_path):
    from PIL import Image

    codes = RANDOM.integers(0, 65536, (4, 6)).astype(np.uint16)
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.fromarray(codes).save(tmp_path / "a.png", exif=exif)
    expected = np.vectorize(srgb_twin)(np.rot90(codes, -1) / 65535)
    np.testing.assert_allclose(read_image(tmp_path / "a.png")[..., 0], expected, rtol=2e-7)


def test_a_jpeg_reads_back_about_the_same(tmp_path):
    ramp = np.linspace(0.1, 0.9, 32)[None, :, None] * np.ones((32, 1, 3))
    write_image(tmp_path / "a.jpg", ramp)
    np.testing.assert_allclose(read_image(tmp_path / "a.jpg"), ramp, atol=0.02)


@pytest.mark.parametrize("suffix", ["png", "jpg"])
@pytest.mark.parametrize(("keep", "message"), [(0, "not a PNG or JPEG"), (5, "not a PNG or JPEG"), (-200, "truncated")])
def test_a_truncated_png_or_jpeg_is_refused(tmp_path, suffix, keep, message):
    path = tmp_path / f"a.{suffix}"
    write_image(path, RANDOM.random((64, 64, 3)))
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.raises(ImageError, match=message):
        read_image(path)


# ------------------------------------------------------------------------------------------------ raw files


WHITE = 4000  # of the sensor below


def write_dng(path, color, **tags):
    """A DNG file of a camera that sees one color, in the primaries of XYZ, in a mosaic of red, green, green, blue."""
    mosaic = np.tile(np.array([[color[0], color[1]], [color[1], color[2]]]), (16, 16))
    codes = np.round(mosaic * WHITE).astype(np.uint16)[..., None]
    camera = {254: 0, 262: 32803, 271: b"maker", 272: b"model", 33421: (2, 2), 33422: bytes([0, 1, 1, 2])}
    camera |= {50706: bytes([1, 4, 0, 0]), 50717: WHITE, 50721: (1, 0, 0, 0, 1, 0, 0, 0, 1), 50728: (1, 1, 1)}
    path.write_bytes(tiff(codes, tags=camera | tags))
    return path


def test_a_raw_file_is_linear_and_1_where_the_sensor_saturates(tmp_path):
    pytest.importorskip("rawpy")
    dim, bright = (read_image(write_dng(tmp_path / "a.dng", value * np.ones(3))) for value in (0.1, 0.4))
    assert dim.shape == (32, 32, 3) and dim.dtype == np.float32
    np.testing.assert_allclose(bright, 4 * dim, rtol=2e-3)  # of codes of the sensor
    np.testing.assert_allclose(read_image(write_dng(tmp_path / "a.dng", np.ones(3))), 1, rtol=1e-3)
    np.testing.assert_allclose(dim, 0.1, rtol=5e-3)


def test_a_raw_file_that_is_none_is_refused(tmp_path):
    pytest.importorskip("rawpy")
    (tmp_path / "a.cr2").write_bytes(b"something else entirely\n" * 9)
    with pytest.raises(ImageError, match="a.cr2: not a raw file that LibRaw reads"):
        read_image(tmp_path / "a.cr2")
    with pytest.raises(ImageError, match="got 32 x 32 pixels, expected 1 to 99"):
        read_image(write_dng(tmp_path / "a.dng", np.ones(3)), max_pixels=99)


def test_a_raw_file_without_rawpy_names_the_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rawpy", None)
    (tmp_path / "a.nef").write_bytes(b"II")
    with pytest.raises(ImportError, match=r'.nef needs the package rawpy: pip install "warpshadow\[raw\]"'):
        read_image(tmp_path / "a.nef")


# ------------------------------------------------------------------------------------------------ all formats


@pytest.mark.parametrize("suffix", ["exr", "png", "jpg"])
def test_the_size_limit_is_named(tmp_path, suffix):
    path = tmp_path / f"a.{suffix}"
    write_image(path, PIXELS)
    assert read_image(path, max_pixels=48).shape == (6, 8, 3)
    with pytest.raises(ImageError, match=r"got 8 x 6 pixels, expected 1 to 47 \(see max_pixels\)"):
        read_image(path, max_pixels=47)


@pytest.mark.parametrize("suffix", ["exr", "hdr", "pic", "png", "jpg", "jpeg"])
def test_foreign_content_is_refused(tmp_path, suffix):
    path = tmp_path / f"a.{suffix}"
    path.write_bytes(b"something else entirely\n" * 9)
    with pytest.raises(ImageError, match=f"a.{suffix}: not an? (OpenEXR|Radiance|PNG or JPEG) file"):
        read_image(path)


def test_unknown_extensions_missing_files_and_needless_parts_are_named(tmp_path):
    with pytest.raises(ImageError, match="got extension '.tga', expected one of .exr, .hdr"):
        read_image(tmp_path / "a.tga")
    with pytest.raises(FileNotFoundError, match="no such image file"):
        read_image(tmp_path / "a.exr")
    write_image(tmp_path / "a.png", PIXELS)
    with pytest.raises(ImageError, match="got part 1, but only .exr files have parts"):
        read_image(tmp_path / "a.png", part=1)
    with pytest.raises(ImageError, match="got extension '.hdr', expected one of .exr, .png"):
        write_image(tmp_path / "a.hdr", PIXELS)


@pytest.mark.parametrize(
    ("name", "pixels", "message"),
    [
        ("a.exr", np.zeros((4, 4, 2)), r"got pixels of shape \(4, 4, 2\)"),
        ("a.exr", np.zeros((0, 4, 3)), r"got pixels of shape \(0, 4, 3\)"),
        ("a.png", np.zeros(4), r"got pixels of shape \(4,\)"),
        ("a.png", np.full((4, 4, 3), np.nan), "got 48 NaN values"),
        ("a.exr", np.full((4, 4, 3), np.nan), "got 48 NaN values"),
        ("a.exr", np.full((4, 4, 3), 1e39), "got 48 values too large for float32"),
        ("a.png", np.full((4, 4, 3), 1e39), "got 48 values too large for float32"),
        ("a.png", np.full((4, 4, 3), 200, np.uint8), "pixels: got values of uint8"),
        ("a.exr", "pixels", "pixels: got .pixels., expected linear values"),
    ],
)
def test_pixels_that_cannot_be_written_are_refused_and_leave_the_old_file(tmp_path, name, pixels, message):
    (tmp_path / name).write_text("old")
    with pytest.raises(ImageError, match=message):
        write_image(tmp_path / name, pixels)
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [(name, "old")]


def test_writing_into_a_missing_folder_says_so(tmp_path):
    with pytest.raises(FileNotFoundError):
        write_image(tmp_path / "missing" / "a.exr", PIXELS)


def test_a_written_file_replaces_the_old_one_and_leaves_nothing_else(tmp_path):
    for value in (0.0, 1.0):
        write_image(tmp_path / "a.exr", np.full((2, 4, 3), value))
    assert [path.name for path in tmp_path.iterdir()] == ["a.exr"]
    assert read_image(tmp_path / "a.exr").min() == 1.0
