"""Encodings of pictures: how the numbers of a file become linear radiance."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from warpshadow import check
from warpshadow.assets.color import linear_to_srgb, srgb_to_linear, unfilmic
from warpshadow.assets.image import read_image
from warpshadow.check import AnyPath

ENCODINGS = ("srgb", "linear")
_INTEGER_FILES = (".png", ".jpg", ".jpeg")  # which read_image decodes from sRGB
_SRGB_GAMMA = 0.01  # relative distance from 2.2 within which a gamma stands for sRGB, as the PNG specification has it


def checked_encoding(value: object) -> str | float:
    """An encoding: "srgb", "linear", or a number γ, such as 2.2, of codes that are radiance^(1/γ)."""
    if check.is_number(value) and value > 0:
        return float(value)
    if value not in ENCODINGS:
        got = check.described(value)
        raise ValueError(f'encoding: got {got}, expected "srgb", "linear" or a gamma above 0, such as 2.2')
    return str(value)


def guess_encoding(path: AnyPath) -> str | float:
    """The encoding that a file's metadata tell of; says so where that is not the usual one of its format.

    OpenEXR and Radiance are linear. PNG, the first that it has, as its specification ranks them: sRGB with an ICC
    profile, whatever that is, or an sRGB chunk; as its gAMA chunk says; linear with 16 bits and none of these, as raw
    converters write it. All others are sRGB.
    """
    path = Path(path)
    if path.suffix.lower() not in _INTEGER_FILES:
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
    """Metadata of a PNG or JPEG file, and whether it has 16 bits for each color."""
    from PIL import Image

    try:
        with Image.open(path, formats=["PNG", "JPEG"]) as picture:
            return {str(key): value for key, value in picture.info.items()}, "16B" in str(picture.tile)
    except (OSError, SyntaxError, Image.DecompressionBombError):
        return {}, False  # which read_image refuses


def read_linear(path: AnyPath, encoding: str | float, tone: str = "clip") -> np.ndarray:
    """Read a picture of an encoding and a tone curve as linear RGB, premultiplied with coverage if the file has alpha.

    Alpha is straight in PNG alone.
    """
    pixels = read_image(path)
    if pixels.shape[2] < 3:
        pixels = np.concatenate([np.repeat(pixels[..., :1], 3, axis=2), pixels[..., 1:]], axis=2)
    is_integer = Path(path).suffix.lower() in _INTEGER_FILES
    stored = "srgb" if is_integer else "linear"  # as read_image takes them
    if encoding != stored or tone != "clip":
        codes = linear_to_srgb(pixels[..., :3]) if is_integer else pixels[..., :3]
        pixels[..., :3] = decoded(codes, encoding, tone)
    if pixels.shape[2] == 4 and is_integer:
        pixels[..., :3] *= pixels[..., 3:]
    return pixels


def decoded(codes: np.ndarray, encoding: str | float, tone: str = "clip") -> np.ndarray:
    """Linear radiance of codes from 0 to 1."""
    if encoding == "linear":
        bent = codes
    else:
        bent = srgb_to_linear(codes) if encoding == "srgb" else np.maximum(codes, 0) ** float(encoding)
    return unfilmic(bent) if tone == "filmic" else bent


def read_mask(path: AnyPath) -> np.ndarray:
    """Gray as it is stored, 0 to 1: a mask is no light, so that half gray is half."""
    pixels = read_image(path)
    has_alpha = pixels.shape[2] in (2, 4)
    colors = pixels[..., :-1] if has_alpha else pixels
    if (colors != colors[..., :1]).any() or (has_alpha and (pixels[..., -1] != 1).any()):
        raise ValueError(f"got colors or transparency in {path}, expected gray")
    gray = colors[..., 0]
    return linear_to_srgb(gray) if Path(path).suffix.lower() in _INTEGER_FILES else gray
