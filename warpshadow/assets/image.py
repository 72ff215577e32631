"""Pixel files: OpenEXR, Radiance, PNG, JPEG, TIFF and raw, as linear float32 arrays. Nothing here knows about light.

Row 0 is the top. PNG, JPEG and TIFF hold sRGB, which is decoded and encoded exactly; alpha is linear everywhere.
"""

import functools
import io
import sys
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from warpshadow import check
from warpshadow.assets import files
from warpshadow.assets.color import srgb_to_linear
from warpshadow.assets.picture import SUFFIXES, Picture, development
from warpshadow.assets.radiance import read_radiance
from warpshadow.check import AnyPath

INTEGER_SUFFIXES = (*SUFFIXES, ".tif", ".tiff")  # suffixes of files of integers, which are taken for sRGB

_RAW_SUFFIXES = (".dng", ".nef", ".cr2", ".cr3", ".crw", ".arw", ".orf", ".raf", ".rw2", ".pef", ".srw")


class ImageError(ValueError):
    """A picture, or an image file, that cannot be used; the message says its fault and names the accepted kinds."""


def read_image(
    path: AnyPath, *, part: str | int | None = None, max_pixels: int = 2**28, undo_exposure: bool | None = None
) -> np.ndarray:
    """Read a picture as linear values.

    OpenEXR: scanline or tiled, half, float or uint; the channels R, G, B[, A], or Y[, A], or the only layer
    that has them ("layer.R", …); the data window alone. Radiance: RGBE, its exposure divided out. PNG, JPEG, TIFF:
    gray or RGB of 8 or 16 bits, with or without alpha, taken for sRGB; turned upright as their EXIF orientation says.
    Raw files of cameras (.dng, .nef, .cr2, …), by LibRaw: linear, white balance as the camera has it, 1 where the
    sensor saturates.

    Args:
        path: An .exr, .hdr, .pic, .png, .jpg, .jpeg, .tif or .tiff file, or a raw file, which needs the extra ``raw``.
        part: Name or index of the part of a multi-part OpenEXR file; the first by default.
        max_pixels: Refuse larger pictures, judged by the header before any pixel is read.
        undo_exposure: Whether a .png or .jpg that warpshadow wrote, as ``warpshadow render -o x.png`` does, becomes
            the radiance that was rendered: its exposure and tone curve, which a comment in the file says, are undone.
            Of other files nothing is. By default it stays as it is shown, and a warning says so where that differs.
    Returns:
        float32 [height, width, channel] with 1 (gray), 2 (gray, alpha), 3 (RGB) or 4 (RGB, alpha) channels.
    Raises:
        ImageError: for a file of another format, truncated, deep or too large, or with other channels.
        FileNotFoundError: when the file does not exist.
        ImportError: for a raw file when rawpy, the extra ``raw``, is not installed.
    """
    path = check.path("path", path)
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        raise ImageError(f"{path}: got extension {path.suffix!r}, expected one of {', '.join(_READERS)}")
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such image file{check.nearest_file(path)}")
    if part is not None and reader is not _read_exr:
        raise ImageError(f"{path}: got part {part!r}, but only .exr files have parts")
    try:
        options = {} if part is None else {"part": part}
        pixels = reader(path, functools.partial(_check_size, max_pixels=max_pixels), **options)
    except ValueError as error:
        raise ImageError(f"{path}: {error}") from error
    exposure_record = None if undo_exposure is False else development(path)
    if exposure_record is None or exposure_record.is_plain:
        return pixels
    if undo_exposure is None:
        check.warn(
            f"{path}: warpshadow wrote it, exposed by {exposure_record.exposure:+.2f} stops, tone "
            f"{exposure_record.tone}, and reads it as it is shown; undo_exposure=True reads the radiance, and False "
            "the same without this warning"
        )
        return pixels
    colors = pixels[..., :3] if pixels.shape[2] > 2 else pixels[..., :1]
    colors[...] = exposure_record.radiance(colors)
    return pixels


def image_size(path: AnyPath) -> tuple[int, int]:
    """Width and height of a picture [pixels], upright as :func:`read_image` turns it."""
    height, width = read_image(path, undo_exposure=False).shape[:2]
    return width, height


def read_rgb(path: AnyPath, *, part: str | int | None = None) -> np.ndarray:
    """Read a picture as :func:`read_image` does, as RGB: gray is repeated, alpha dropped."""
    pixels = read_image(path, part=part)
    return np.repeat(pixels[..., :1], 3, axis=2) if pixels.shape[2] < 3 else pixels[..., :3]


def write_image(path: AnyPath, pixels: np.ndarray | Picture, *, layers: Mapping[str, np.ndarray] | None = None) -> None:
    """Write an image of linear values; the file appears complete or not at all.

    Args:
        path: A .exr file (float32, ZIP compressed, any values), or a .png, .jpg or .jpeg file (8-bit sRGB).
        pixels: Shape [height, width], or [height, width, channel] with 1 (gray), 3 (RGB) or 4 channels: RGB and
            coverage, premultiplied, as :func:`warpshadow.render` returns them. A .png or .jpg file of four channels is
            a :class:`Picture` at its automatic exposure; others keep their values, clipped to [0, 1]. Or a Picture.
        layers: Further channels of an .exr file by their names, each of shape [height, width]:
            ``Renderer(scene).layers().channels()``.
    Raises:
        ImageError: for another extension or shape, for NaN, and for numbers too large for float32, other than Inf.
        OSError: where the file cannot be written.
    """
    path = check.path("path", path)
    suffixes = SUFFIXES if isinstance(pixels, Picture) else (".exr", *SUFFIXES)
    if path.suffix.lower() not in suffixes:
        raise ImageError(f"{path}: got extension {path.suffix!r}, expected one of {', '.join(suffixes)}")
    if isinstance(pixels, Picture):
        _no_layers(path, layers)
        pixels.write(path)
        return
    original, expected = pixels, "linear values [height, width, channel]"
    pixels = check.pixels("pixels", original, expected=expected, error=ImageError)
    with check.located(str(path), ImageError):
        _check_float32("pixels", original, pixels)
    shape = pixels.shape
    if pixels.ndim == 2:
        pixels = pixels[..., None]
    if pixels.ndim != 3 or pixels.size == 0 or pixels.shape[2] not in (1, 3, 4):
        raise ImageError(f"{path}: got pixels of shape {shape}, expected [height, width] or [height, width, 1, 3 or 4]")
    if path.suffix.lower() != ".exr":
        _no_layers(path, layers)
        with check.located(str(path), ImageError):
            picture = Picture(pixels, exposure=None if pixels.shape[2] == 4 else 0.0)
        picture.write(path)
        return
    channels = _checked_layers(layers or {}, pixels)
    import OpenEXR

    try:
        with files.atomic_write(path) as temporary_path:
            name = _CHANNELS[pixels.shape[2]]
            colors = np.ascontiguousarray(pixels if len(name) > 1 else pixels[..., 0])
            exr = OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION}, {name: colors, **channels})
            exr.write(str(temporary_path))
    except RuntimeError as error:  # OpenEXR's, of a disk that is full
        raise OSError(f"{path}: {error}") from error


def exr_bytes(channels: Mapping[str, np.ndarray]) -> bytes:
    """An OpenEXR file of channels, each float32 of shape [height, width], in memory; ZIP compressed."""
    import OpenEXR

    stream = io.BytesIO()
    pixels = {name: np.ascontiguousarray(values, np.float32) for name, values in channels.items()}
    OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION}, pixels).write(stream)
    return stream.getvalue()


def exr_channels(content: bytes) -> dict[str, np.ndarray]:
    """All channels of an OpenEXR file in memory, as :func:`exr_bytes` makes one.

    Raises:
        ImageError: for a file of another format, or a truncated one.
    """
    import OpenEXR

    try:
        channels = OpenEXR.File(io.BytesIO(content), separate_channels=True).channels()
        return {name: channel.pixels for name, channel in channels.items()}
    except Exception as error:  # its messages and exception types vary with the damage
        raise ImageError(f"not an OpenEXR file, or a damaged one ({error})") from error


def png_codes(content: bytes) -> np.ndarray:
    """The codes of a PNG file in memory, as :func:`warpshadow.assets.picture.png_bytes` makes one.

    Returns:
        uint8 of shape [height, width, 1, 3 or 4], or uint16 of shape [height, width, 1].
    Raises:
        ImageError: for a file of another format, or a truncated one.
    """
    from PIL import Image

    try:
        picture = Image.open(io.BytesIO(content), formats=["PNG"])
    except Image.UnidentifiedImageError as error:
        raise ImageError("not a PNG file, or its header is damaged") from error
    _load(picture)
    codes = np.asarray(picture)
    codes = codes if codes.dtype == np.uint8 else codes.astype(np.uint16)  # of 16 bits; some releases give it 32
    return codes.reshape(*codes.shape[:2], -1)


def _no_layers(path: Path, layers: object) -> None:
    if layers is not None:
        raise ImageError(f"{path}: got layers, which only .exr files have")


def _checked_layers(layers: Mapping[str, np.ndarray], pixels: np.ndarray) -> dict[str, np.ndarray]:
    """Further channels as float32, beside the image's own."""
    channels = {}
    for name, values in layers.items():
        if not isinstance(name, str) or not name or name in _CHANNELS[pixels.shape[2]]:
            raise ImageError(f"layers: got the name {name!r}, expected one that no other channel has")
        with check.located("layers", ImageError):
            channels[name] = check.numbers(name, values, expected="an array [height, width]")
            check.shape(name, channels[name].shape, pixels.shape[:2])
            _check_float32(name, values, channels[name])
    return channels


def _check_float32(name: str, values: object, copied: np.ndarray) -> None:
    """Raise ValueError for NaN in a copy of values as float32, and for Inf in place of numbers."""
    nan_count = int(np.isnan(copied).sum())
    large_count = int((np.isinf(copied) & ~np.isinf(np.asarray(values))).sum())
    if nan_count or large_count:
        got = f"{nan_count} NaN values" if nan_count else f"{large_count} values too large for float32"
        raise ValueError(f"{name}: got {got}, expected numbers up to {np.finfo(np.float32).max:.2g}, or Inf")


def _check_size(width: int, height: int, max_pixels: int) -> None:
    if width < 1 or height < 1 or width * height > max_pixels:
        raise ImageError(f"got {width} x {height} pixels, expected 1 to {max_pixels} (see max_pixels)")


# ---------------------------------------------------------------------------------------------------- OpenEXR


def _read_exr(path: Path, check_size: Callable[[int, int], None], part: str | int | None = None) -> np.ndarray:
    import OpenEXR

    try:
        parts = OpenEXR.File(str(path), header_only=True).parts
    except Exception as error:  # its messages and exception types vary with the damage
        raise ImageError(f"not an OpenEXR file, or its header is damaged ({error})") from error
    part_index = _find_part([candidate.name() for candidate in parts], part)
    if parts[part_index].type() in (OpenEXR.deepscanline, OpenEXR.deeptile):
        raise ImageError("got deep pixels, expected flat ones (scanline or tiled)")
    for candidate in parts:  # the library reads them all
        lower, upper = candidate.header["dataWindow"]
        width, height = (np.subtract(upper, lower, dtype=np.int64) + 1).tolist()
        check_size(width, height)
    header = {channel.name: channel for channel in parts[part_index].header["channels"]}
    names = _find_channels(list(header))
    if any((channel.xSampling, channel.ySampling) != (1, 1) for channel in header.values()):
        raise ImageError(f"got subsampled channels among {', '.join(header)}, expected all at full resolution")

    try:
        complete = OpenEXR.File(str(path), separate_channels=True).parts
    except Exception as error:
        raise ImageError(f"truncated or damaged ({error})") from error
    if len(complete) < len(parts):  # the library prints a warning and leaves a damaged part out
        raise ImageError(f"truncated or damaged: only {len(complete)} of {len(parts)} parts could be read")
    return np.stack([complete[part_index].channels[name].pixels.astype(np.float32) for name in names], axis=-1)


def _find_part(names: list[str], part: str | int | None) -> int:
    if part is None:
        return 0
    if isinstance(part, int) and 0 <= part < len(names):
        return part
    if part in names:
        return names.index(part)
    raise ImageError(f"got part {part!r}, expected 0 to {len(names) - 1} or one of {', '.join(map(repr, names))}")


def _find_channels(names: list[str]) -> list[str]:
    """Names of the color channels, then alpha, of the unnamed layer or else of the only one with color."""
    colors = {}
    for layer in {name.rpartition(".")[0] for name in names}:
        prefix = f"{layer}." if layer else ""
        for color in ("Y", "RGB"):
            if {prefix + channel for channel in color} <= set(names):
                colors[layer] = [prefix + channel for channel in color + "A" if prefix + channel in names]
    if "" in colors:
        return colors[""]
    if len(colors) == 1:
        return colors.popitem()[1]
    raise ImageError(
        f"got channels {', '.join(names)} ({len(colors)} layers with color), expected R, G, B or Y, in one layer"
    )


_CHANNELS = {1: "Y", 3: "RGB", 4: "RGBA"}


# ----------------------------------------------------------------------------------------- PNG, JPEG and TIFF


def _read_pillow(path: Path, check_size: Callable[[int, int], None]) -> np.ndarray:
    with _open(path) as picture:
        check_size(*picture.size)
        codes, has_alpha = _codes(path, picture)
    code_max = np.iinfo(codes.dtype).max
    pixels = srgb_to_linear(np.arange(code_max + 1) / code_max).astype(np.float32)[codes]
    if has_alpha:
        pixels[..., -1] = codes[..., -1] / np.float32(code_max)
    return pixels


def _open(path: Path) -> Any:
    from PIL import Image

    formats = ["PNG", "JPEG"] if path.suffix.lower() in SUFFIXES else ["TIFF"]
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # max_pixels is the limit here
            picture: Any = Image.open(path, formats=formats)
    except Image.DecompressionBombError as error:
        raise ImageError(str(error)) from error
    except Image.UnidentifiedImageError as error:
        raise ImageError(f"not a {' or '.join(formats)} file, or its header is damaged") from error
    bits = set(picture.tag_v2.get(_BITS_PER_SAMPLE, ())) if picture.format == "TIFF" else set()
    if bits - {1, 8, 16}:
        raise ImageError(f"got {max(bits)} bits for each color, expected 8 or 16")
    picture.filename = ""  # else Pillow maps gray TIFF files into memory, and garbles files that are to be turned
    return picture


def _codes(path: Path, picture: Any) -> tuple[np.ndarray, bool]:
    """Codes of 8 or 16 bits, [height, width, channel], upright; and whether the last channel is alpha."""
    has_alpha = picture.has_transparency_data
    is_16_bit, low_tiles = is_wide(picture), _low_tiles(picture)  # which loading forgets
    upper = _load_upright(picture)
    if upper.mode.startswith("I"):  # 16-bit gray
        return np.asarray(upper).astype(np.uint16)[..., None], False
    color = "L" if upper.mode in ("1", "L", "LA") else "RGB"
    mode = {"L": "LA", "RGB": "RGBA"}[color] if has_alpha else color
    codes = np.asarray(upper.convert(mode))
    if low_tiles is not None and has_alpha == (upper.mode == "RGBA"):
        with _open(path) as picture:
            picture.tile = low_tiles
            codes = codes.astype(np.uint16) << 8 | np.asarray(_load_upright(picture).convert(mode))
    elif is_16_bit:
        check.warn(f"{path}: 16-bit color is read at 8 bits")
    return codes.reshape(*codes.shape[:2], -1), has_alpha


def is_wide(picture: Any) -> bool:
    """Whether a picture that Pillow has opened, and not loaded, has 16 bits for each color."""
    return ";16" in str(picture.tile)


def _low_tiles(picture: Any) -> list | None:
    """Find the storage of a picture's lower bytes, if it has 16 bits for each of three or four colors, else None.

    Pillow's colors have 8 bits, the upper bytes. Read in the other order, the lower ones are in their place.
    """
    low_tiles = []
    for tile in picture.tile:
        *tile_position, arguments = tile
        layout, *other_arguments = arguments if isinstance(arguments, tuple) else (arguments,)
        color, _, order = str(layout).partition(";")
        if color not in ("RGB", "RGBX", "RGBA") or order not in _OTHER_ORDER:
            return None
        layout = f"{color};{_OTHER_ORDER[order]}"
        arguments = (layout, *other_arguments) if isinstance(arguments, tuple) else layout
        low_tiles.append(getattr(tile, "_make", tuple)([*tile_position, arguments]))  # a plain tuple before Pillow 11
    return low_tiles


def _load_upright(picture: Any) -> Any:
    """A picture's pixels, upright."""
    from PIL import ImageOps

    _load(picture)
    ImageOps.exif_transpose(picture, in_place=True)
    return picture


_BITS_PER_SAMPLE = 258  # TIFF's tag
_OTHER_ORDER = {"16B": "16L", "16L": "16B", "16N": "16B" if sys.byteorder == "little" else "16L"}


def _load(picture: Any) -> None:
    """Decode the pixels; Pillow raises any of these on a damaged file."""
    try:
        picture.load()
    except (OSError, SyntaxError, ValueError, EOFError) as error:
        raise ImageError(f"truncated or damaged ({error})") from error


# ------------------------------------------------------------------------------------------------- raw files


def _read_raw(path: Path, check_size: Callable[[int, int], None]) -> np.ndarray:
    """Develop a raw file linearly: no tone curve, no brightening, upright, in the primaries of sRGB.

    The white balance is the camera's, or that of daylight where the file has none.

    Args:
        check_size: Raises ValueError for a width and height that are too large.
    Returns:
        RGB, 1 where the sensor saturates, float32 of shape [height, width, 3].
    Raises:
        ImportError: when rawpy, the extra ``raw``, is not installed.
        ValueError: for a file of another format, or a damaged one.
    """
    check.importable("rawpy", path.suffix, "rawpy", "raw")
    import rawpy

    try:
        with rawpy.imread(str(path)) as raw:
            check_size(raw.sizes.width, raw.sizes.height)
            codes = raw.postprocess(
                gamma=(1, 1),
                no_auto_bright=True,
                adjust_maximum_thr=0,  # white is the sensor's, not the brightest pixel
                use_camera_wb=True,
                output_color=rawpy.ColorSpace.sRGB,
                output_bps=16,
            )
    except rawpy.LibRawError as error:
        raise ValueError(f"not a raw file that LibRaw reads, or a damaged one ({error})") from error
    return (codes / 65535).astype(np.float32)


_READERS: dict[str, Callable[..., np.ndarray]] = {
    ".exr": _read_exr,
    **dict.fromkeys([".hdr", ".pic"], read_radiance),
    **dict.fromkeys(INTEGER_SUFFIXES, _read_pillow),
    **dict.fromkeys(_RAW_SUFFIXES, _read_raw),
}
"""Readers by suffix, of a path and a function that raises for a width and height that are too large."""
