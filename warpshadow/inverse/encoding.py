"""Encodings of pictures: how the numbers of a file become linear radiance."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeGuard

import numpy as np

from warpshadow import check
from warpshadow.assets.color import linear_to_srgb, srgb_to_linear, unfilmic
from warpshadow.assets.image import INTEGER_SUFFIXES, is_wide, read_image
from warpshadow.check import AnyPath

ENCODINGS = ("srgb", "linear")
_SRGB_GAMMA = 0.01  # relative distance from 2.2 within which a gamma stands for sRGB, as the PNG specification has it
_ROUNDING = 1e-6  # of values in text


@dataclass(frozen=True, eq=False)
class ResponseCurve:
    """The response curve of a camera, as a calibration measures it [Debevec and Malik 1997].

    Args:
        samples: Rows of radiance, in any unit, and the value that the file has for it, 0 to 1: shape [sample, 2]; or of
            the radiance of red, green and blue that have that value, [sample, 4]. Values go from 0 to 1, and both rise
            from row to row; between rows the curve is straight.
        name: Of its file.
    """

    samples: np.ndarray = field(repr=False)
    name: str = "a response curve"

    def __post_init__(self) -> None:
        expected = "rows of radiance and value, [sample, 2], or of red, green, blue and value, [sample, 4]"
        samples = check.numbers("encoding", self.samples, expected=expected, dtype=np.float64)
        if samples.ndim != 2 or samples.shape[1] not in (2, 4) or len(samples) < 2:
            raise ValueError(f"encoding: got a curve of shape {samples.shape}, expected {expected}")
        check.finite("encoding", samples, minimum=0.0)
        values = samples[:, -1]
        if abs(values[0]) > _ROUNDING or abs(values[-1] - 1) > _ROUNDING:
            raise ValueError(
                f"encoding: got a curve of values from {values[0]:g} to {values[-1]:g}, expected all from 0 to 1; of "
                "codes of 8 bits: codes / 255"
            )
        falls = (np.diff(samples, axis=0) <= 0).any(axis=1)
        if falls.any():
            row = int(falls.argmax())
            raise ValueError(
                f"encoding: got {samples[row].tolist()} and then {samples[row + 1].tolist()} in a curve, expected "
                "radiance and value to rise from row to row"
            )
        object.__setattr__(self, "samples", samples)

    def radiance(self, values: np.ndarray) -> np.ndarray:
        """Radiance of values from 0 to 1 as they are stored, [..., 3] of red, green and blue; or of a value, [3]."""
        *radiances, knots = self.samples.T
        channels = np.broadcast_to(values, np.broadcast_shapes(np.shape(values), (3,)))
        decoded = [np.interp(channels[..., k], knots, radiances[k % len(radiances)]) for k in range(3)]
        return np.stack(decoded, axis=-1)

    @staticmethod
    def read(path: AnyPath) -> ResponseCurve:
        """Read the samples from a .csv file; a first line may name the columns, the last "value"."""
        path = check.file("encoding", path)
        lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
        rows = [[cell.strip() for cell in line.split(",")] for line in lines if line.strip() and line[0] != "#"]
        with check.located(str(path)):
            if rows and rows[0][0].isalpha():
                names = rows.pop(0)
                if names[-1] != "value":
                    raise ValueError(f'encoding: got columns {", ".join(names)}, expected the last to be "value"')
            try:
                samples = np.array(rows, np.float64)
            except ValueError as error:
                raise ValueError(f"encoding: {error}, expected as many numbers in each row") from error
            return ResponseCurve(samples, path.name)


Encoding = str | float | ResponseCurve


def checked_encoding(value: object) -> Encoding:
    """An encoding.

    "srgb", "linear", a number γ, such as 2.2, of codes that are radiance^(1/γ), or a :class:`ResponseCurve`: its
    samples, or the path of a .csv file of them.
    """
    if isinstance(value, ResponseCurve):
        return value
    if check.is_number(value) and value > 0:
        return float(value)
    if is_curve_file(value):
        return ResponseCurve.read(value)
    if isinstance(value, (list, tuple, np.ndarray)):
        return ResponseCurve(np.asarray(value))
    if value not in ENCODINGS:
        got = check.described(value)
        raise ValueError(
            f'encoding: got {got}, expected "srgb", "linear", a gamma above 0, such as 2.2, or a response curve: its '
            "samples [sample, 2], or a .csv file of them"
        )
    return str(value)


def is_curve_file(value: object) -> TypeGuard[AnyPath]:
    """Whether an encoding names a file of a response curve."""
    return check.is_path(value) and Path(value).suffix.lower() == ".csv"


def toml_value(encoding: Encoding) -> str | float:
    """An encoding as a TOML file has it."""
    return encoding.name if isinstance(encoding, ResponseCurve) else encoding


def guess_encoding(path: AnyPath) -> str | float:
    """The encoding that a file's metadata tell of; says so where that is not the usual one of its format.

    OpenEXR, Radiance and raw files are linear. PNG and TIFF, the first that they have, as PNG's specification ranks
    them: sRGB with an ICC profile, whatever that is, or an sRGB chunk; as the gAMA chunk says; linear with 16 bits and
    none of these, as raw converters write it. All others are sRGB.
    """
    path = Path(path)
    if path.suffix.lower() not in INTEGER_SUFFIXES:
        return "linear"
    info, is_16_bit = _metadata(path)
    guess: str | float = "linear" if is_16_bit else "srgb"
    reason = "it has 16 bits"
    if "srgb" in info or "icc_profile" in info:
        guess = "srgb"
    elif info.get("gamma", 0) > 0:
        gamma = 1 / info["gamma"]
        is_srgb = abs(gamma / 2.2 - 1) < _SRGB_GAMMA
        guess = "srgb" if is_srgb else "linear" if abs(gamma - 1) < _SRGB_GAMMA else round(gamma, 4)
        reason = f"its gAMA chunk says {info['gamma']:g}"
    if guess != "srgb":
        check.warn(f'{path}: taken for encoding = "{guess}", since {reason}; give encoding if that is wrong')
    return guess


def _metadata(path: Path) -> tuple[dict[str, Any], bool]:
    """Metadata of a PNG, JPEG or TIFF file, and whether it has 16 bits for each color."""
    from PIL import Image

    try:
        with Image.open(path, formats=["PNG", "JPEG", "TIFF"]) as picture:
            return {str(key): value for key, value in picture.info.items()}, is_wide(picture)
    except (OSError, SyntaxError, Image.DecompressionBombError):
        return {}, False  # which read_image refuses


def read_linear(path: AnyPath, encoding: Encoding, tone: str = "clip") -> np.ndarray:
    """Read a picture of an encoding and a tone curve as linear RGB, premultiplied with coverage if the file has alpha.

    Alpha is straight in PNG and TIFF alone.
    """
    pixels = read_image(path, undo_exposure=False)
    if pixels.shape[2] < 3:
        pixels = np.concatenate([np.repeat(pixels[..., :1], 3, axis=2), pixels[..., 1:]], axis=2)
    is_integer = Path(path).suffix.lower() in INTEGER_SUFFIXES
    stored_encoding = "srgb" if is_integer else "linear"  # as read_image takes them
    if encoding != stored_encoding or tone != "clip":
        codes = linear_to_srgb(pixels[..., :3]) if is_integer else pixels[..., :3]
        pixels[..., :3] = decoded(codes, encoding, tone)
    if pixels.shape[2] == 4 and is_integer:
        pixels[..., :3] *= pixels[..., 3:]
    return pixels


def decoded(codes: np.ndarray, encoding: Encoding, tone: str = "clip") -> np.ndarray:
    """Linear radiance of codes from 0 to 1."""
    if isinstance(encoding, ResponseCurve):
        nonlinear_radiance = encoding.radiance(codes)
    elif encoding == "linear":
        nonlinear_radiance = codes
    else:
        nonlinear_radiance = srgb_to_linear(codes) if encoding == "srgb" else np.maximum(codes, 0) ** float(encoding)
    return unfilmic(nonlinear_radiance) if tone == "filmic" else nonlinear_radiance


def read_mask(path: AnyPath) -> np.ndarray:
    """Gray as it is stored, 0 to 1: a mask is no light, so that half gray is half."""
    pixels = read_image(path, undo_exposure=False)
    has_alpha = pixels.shape[2] in (2, 4)
    colors = pixels[..., :-1] if has_alpha else pixels
    if (colors != colors[..., :1]).any() or (has_alpha and (pixels[..., -1] != 1).any()):
        raise ValueError(f"got colors or transparency in {path}, expected gray")
    gray = colors[..., 0]
    return linear_to_srgb(gray) if Path(path).suffix.lower() in INTEGER_SUFFIXES else gray
