"""Pictures: linear images as they are shown, exposed, on a background, in 8 bits of sRGB."""

import io
import re
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from warpshadow import check
from warpshadow.assets import files
from warpshadow.assets.color import auto_exposure, filmic, linear_to_srgb, srgb_to_linear, unfilmic
from warpshadow.check import AnyPath

SUFFIXES = (".png", ".jpg", ".jpeg")  # suffixes of picture files

MAX_STOPS = 100  # 2 to it is a float32

TONES: dict[str, Callable[[np.ndarray], np.ndarray]] = {"clip": lambda color: color, "filmic": filmic}
"""Tone curves of exposed color before it is clipped at 1."""


class Picture:
    """An image as it is shown; notebooks draw it.

    Args:
        image: Linear values: RGB and coverage, premultiplied, as :func:`warpshadow.render` returns them, shape
            [height, width, 4]; RGB [height, width, 3]; or gray [height, width] or [height, width, 1].
        exposure: Factor of the image, in stops; by default the brightest 1% of covered pixels just saturate, and a
            lamp in view beyond that.
        tone: Tone curve of bright color: "clip" cuts it off at 1, "filmic" bends it towards 1 (Narkowicz's fit of the
            ACES curve, 2016).
        background: Shown where the image covers nothing: None for transparent; a color of the picture, linear RGB [3]
            or as CSS names it, "white" or "#ffcc00"; or an image of radiance, [height, width, 3], which is exposed like
            the rest: ``scene.background()`` is the light itself.
    Attributes:
        pixels: uint8 of shape [height, width, 3], [height, width, 4] with straight alpha where it is transparent, or
            [height, width, 1] of gray; ``PIL.Image.fromarray`` takes them.
        exposure: In stops.
        tone: Tone curve.
    Raises:
        ValueError: for NaN, and for a background behind an image that has no coverage.
    """

    pixels: np.ndarray
    exposure: float
    tone: str

    @check.keywords(gamma="exposure=… in stops; the curve is that of sRGB")
    def __init__(
        self,
        image: npt.ArrayLike,
        *,
        exposure: float | None = None,
        tone: str = "clip",
        background: npt.ArrayLike | None = None,
    ):
        linear = _checked_image("image", image)
        check.choice("tone", tone, TONES)
        if exposure is not None and not (check.is_number(exposure) and abs(exposure) <= MAX_STOPS):
            raise ValueError(
                f"exposure: got {check.described(exposure)}, expected {-MAX_STOPS} to {MAX_STOPS} stops, or None"
            )
        self.exposure = auto_exposure(linear) if exposure is None else float(exposure)
        self.tone = tone
        has_alpha = linear.shape[2] == 4
        if background is not None and not has_alpha:
            raise ValueError(f"background: got one behind an image of shape {linear.shape}, which covers all of it")
        color, alpha = (linear[..., :3], np.clip(linear[..., 3:], 0, 1)) if has_alpha else (linear, None)
        background_pixels = None if background is None else _checked_background(background, color.shape)
        if alpha is not None and background_pixels is not None and background_pixels.ndim == 3:
            color, alpha = color + (1 - alpha) * background_pixels, None
        if alpha is not None:
            color = np.divide(color, alpha, out=np.zeros_like(color), where=alpha > 0)
        color = np.clip(TONES[tone](np.maximum(color * 2.0**self.exposure, 0)), 0, 1)
        if alpha is not None and background_pixels is not None:
            color, alpha = alpha * color + (1 - alpha) * background_pixels, None
        encoded_values = linear_to_srgb(color)
        self.pixels = _codes(encoded_values if alpha is None else np.concatenate([encoded_values, alpha], axis=2))
        self.pixels.setflags(write=False)

    def __repr__(self) -> str:
        height, width, _ = self.pixels.shape
        return f"Picture({width} × {height}, {self.exposure:+.2f} stops)"

    if not TYPE_CHECKING:  # to which it would hide names that there are not

        def __getattr__(self, name: str) -> Any:
            """Map names of other libraries to ours."""
            hint = {"save": "write(path)", "show": "write(path); notebooks draw a Picture by themselves"}.get(name)
            raise AttributeError(f"a Picture has no {name!r}{hint and f' (write {hint})' or ''}")

    def _repr_png_(self) -> bytes:
        """The picture as notebooks draw it."""
        return png_bytes(self.pixels)

    def opaque(self) -> np.ndarray:
        """uint8 of shape [height, width, 3], on white where the picture is transparent."""
        if self.pixels.shape[2] < 4:
            return np.broadcast_to(self.pixels, (*self.pixels.shape[:2], 3))
        color, alpha = srgb_to_linear(self.pixels[..., :3] / 255), self.pixels[..., 3:] / 255
        return _codes(linear_to_srgb(alpha * color + 1 - alpha))

    def write(self, path: AnyPath) -> None:
        """Write a .png file, or a .jpg or .jpeg file, on white where the picture is transparent.

        A comment in the file says the exposure and the tone curve, by which fits undo them.

        Raises:
            OSError: where the file cannot be written.
        """
        path = check.path("path", path)
        if path.suffix.lower() not in SUFFIXES:
            raise ValueError(f"{path}: got extension {path.suffix!r}, expected one of {', '.join(SUFFIXES)}")
        from PIL.PngImagePlugin import PngInfo

        with files.atomic_write(path) as temporary_path:
            comment = f"warpshadow: exposure {self.exposure:+.6f} stops, tone {self.tone}"
            if path.suffix.lower() == ".png":
                chunk = PngInfo()
                chunk.add_text("Comment", comment)
                _pillow(self.pixels).save(temporary_path, pnginfo=chunk)
            else:
                opaque_pixels = self.opaque() if self.pixels.shape[2] == 4 else self.pixels
                _pillow(opaque_pixels).save(temporary_path, quality=95, subsampling=0, comment=comment)


def png_bytes(codes: np.ndarray) -> bytes:
    """A PNG file in memory of uint8 [height, width, 1, 3 or 4] or uint16 [height, width, 1]."""
    file = io.BytesIO()
    _pillow(codes).save(file, format="PNG")
    return file.getvalue()


class Development(NamedTuple):
    """Exposure and tone curve by which linear values became a picture."""

    exposure: float
    """Exposure [stops]."""

    tone: str
    """Tone curve."""

    @property
    def is_plain(self) -> bool:
        """Whether the picture has the linear values themselves."""
        return self.exposure == 0 and self.tone == "clip"

    def radiance(self, colors: np.ndarray) -> np.ndarray:
        """Linear values of the picture's colors, which are linear from 0 to 1."""
        return (unfilmic(colors) if self.tone == "filmic" else colors) / np.float32(2**self.exposure)


def development(path: AnyPath) -> Development | None:
    """The exposure and tone curve that :meth:`Picture.write` left in a file; None for other pictures."""
    from PIL import Image

    try:
        with Image.open(path, formats=["PNG", "JPEG"]) as picture:
            comment = picture.info.get("Comment", picture.info.get("comment", ""))
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError):
        return None
    comment = comment.decode(errors="replace") if isinstance(comment, bytes) else comment
    match = re.fullmatch(rf"warpshadow: exposure ([+-]\d+\.\d+) stops, tone ({'|'.join(TONES)})", comment)
    return None if match is None else Development(float(match[1]), match[2])


def _checked_image(name: str, image: npt.ArrayLike) -> np.ndarray:
    """An image [height, width, channel], float64, without NaN and Inf."""
    expected = "linear values [height, width, channel]"
    pixels = check.pixels(name, image, expected=expected)
    pixels = pixels[..., None] if pixels.ndim == 2 else pixels
    if pixels.ndim != 3 or pixels.size == 0 or pixels.shape[2] not in (1, 3, 4):
        raise ValueError(f"{name}: got shape {pixels.shape}, expected [height, width] or [height, width, 1, 3 or 4]")
    if np.isnan(pixels).any():
        raise ValueError(f"{name}: got {int(np.isnan(pixels).sum())} NaN values, expected numbers")
    return np.clip(pixels.astype(np.float64), -check.LARGEST, check.LARGEST)


def _checked_background(background: npt.ArrayLike, shape: tuple[int, ...]) -> np.ndarray:
    """A color [3] or an image [height, width, 3], linear."""
    if isinstance(background, str):
        from PIL import ImageColor

        try:
            return srgb_to_linear(np.array(ImageColor.getrgb(background)[:3]) / 255)
        except ValueError as error:
            raise ValueError(
                f"background: got {background!r}, expected a color such as 'white' or '#ffcc00', or radiance such as "
                "scene.background()"
            ) from error
    expected = f"a color [3], or an image {list(shape)}"
    background_pixels = check.numbers("background", background, expected=expected, dtype=np.float64)
    if background_pixels.shape not in ((3,), shape):
        raise ValueError(f"background: got shape {background_pixels.shape}, expected {expected}")
    check.finite(
        "background", background_pixels, minimum=0.0, maximum=1.0 if background_pixels.ndim == 1 else check.LARGEST
    )
    return background_pixels


def _pillow(pixels: np.ndarray) -> Any:
    from PIL import Image

    return Image.fromarray(pixels[..., 0] if pixels.shape[2] == 1 else pixels)


def _codes(encoded_values: np.ndarray) -> np.ndarray:
    return np.floor(encoded_values * 255 + 0.5).astype(np.uint8)
