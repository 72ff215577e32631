"""Channels as pictures in PNG, and back.

PNG has whole numbers, codes. The range of the codes differs from image to image; it is stored beside each picture, so
that the channels can be decoded, but for rounding:

    values = (low (maximum − code) + high code) / maximum,   of maximum = 255 or 65535, range = [low, high]
    color  = alpha sRGB⁻¹(code / 255) / 2^exposure,          alpha = code / 255

Nothing is cut off: a range is as wide, and an exposure as low, as an image needs. Only color below 0, which sRGB has
not, becomes 0: it is said of which part of the pixels.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from warpshadow import check
from warpshadow.assets.color import linear_to_srgb, srgb_to_linear
from warpshadow.assets.image import png_codes
from warpshadow.assets.picture import png_bytes

Channels = dict[str, np.ndarray]  # float32 of shape [height, width], by names


class Coding(Protocol):
    """Conversion of a picture's channels to codes."""

    def codes(self, values: np.ndarray) -> tuple[np.ndarray, dict[str, Any]]:
        """Encode values [height, width, channel]; return the codes and their range."""
        ...


@dataclass(frozen=True)
class Even:
    """Numbers at even steps."""

    bits: int = 8  # of a code, 8 or 16
    low: float = 0.0  # the value of code 0; lower, where an image goes lower
    high: float = 1.0  # the value of the largest code; higher, where an image goes higher

    def codes(self, values: np.ndarray) -> tuple[np.ndarray, dict[str, Any]]:
        """Encode channels; see :class:`Coding`."""
        maximum = 2**self.bits - 1
        rounding = (self.high - self.low) / maximum / 2
        minimum, maximum_value = float(values.min()), float(values.max())
        low = minimum if minimum < self.low - rounding else self.low
        high = maximum_value if maximum_value > self.high + rounding else self.high
        codes = np.rint((values.astype(np.float64) - low) / (high - low) * maximum).clip(0, maximum)
        return codes.astype(np.uint8 if self.bits == 8 else np.uint16), {"range": [low, high]}


class Srgb:
    """Color and coverage in 8 bits: sRGB, not premultiplied, exposed so that the brightest value is just white."""

    def codes(self, values: np.ndarray) -> tuple[np.ndarray, dict[str, Any]]:
        """Encode channels; see :class:`Coding`."""
        alpha = np.rint(values[..., 3:].astype(np.float64) * 255).clip(0, 255)
        color = np.divide(values[..., :3], values[..., 3:], out=np.zeros_like(values[..., :3]), where=alpha > 0)
        max_radiance = float(color.max())
        exposure = -float(np.log2(max_radiance)) if max_radiance > 0 else 0.0
        encoded_color = linear_to_srgb((color.astype(np.float64) * 2**exposure).clip(0, 1))
        coding_record = {"exposure": exposure, "below_zero": float((color < 0).any(axis=-1).mean())}
        return np.concatenate([np.rint(encoded_color * 255), alpha], axis=-1).astype(np.uint8), coding_record


def as_png(channels: Channels, coding: Coding) -> tuple[bytes, dict[str, Any]]:
    """Encode 1, 3 or 4 channels as a PNG file; return it and the range of its codes."""
    codes, coding_record = coding.codes(np.stack([*channels.values()], axis=-1))
    return png_bytes(codes), {"channels": list(channels), **coding_record}


def from_png(content: bytes, coding_record: Mapping[str, Any]) -> Channels:
    """Decode the channels of a PNG file, given the range of its codes.

    Raises:
        ImageError: for a file that is no PNG, or is truncated.
    """
    codes = png_codes(content)
    check.shape("a PNG file of a sample", codes.shape, ("height", "width", len(coding_record["channels"])))
    maximum, codes = np.iinfo(codes.dtype).max, codes.astype(np.float64)
    if "range" in coding_record:
        low, high = coding_record["range"]
        values = (low * (maximum - codes) + high * codes) / maximum
    else:
        color, alpha = codes[..., :3] / maximum, codes[..., 3:] / maximum
        values = np.concatenate([alpha * srgb_to_linear(color) / 2 ** coding_record["exposure"], alpha], axis=-1)
    return {name: values[..., k].astype(np.float32) for k, name in enumerate(coding_record["channels"])}
