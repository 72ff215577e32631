"""Colors: sRGB's encoding, and the exposure at which linear values become a picture."""

import numpy as np

GRAY = (0.8, 0.8, 0.8)  # reflectance of a surface of which nothing is said, linear

_LAMP_RATIO = 16.0  # brightness of the brightest 1% of pixels over the brightest tenth's, from which they are lamps

LUMINANCE = np.array([0.2126, 0.7152, 0.0722])  # of linear sRGB, Rec. 709


def auto_exposure(image: np.ndarray) -> float:
    """Exposure [stops] at which the brightest 1% of pixels, covered ones if there is coverage, saturate.

    A lamp in view does not count: if these are 16 times as bright as the brightest tenth, twice the latter saturates.

    Args:
        image: Linear, shape [..., 4] with coverage, or [..., 3] or [..., 1] without.
    """
    covered_pixels = image[image[..., 3] > 0] if image.shape[-1] == 4 else image.reshape(-1, image.shape[-1])
    tenth, bright_value = np.percentile(covered_pixels[:, :3].max(axis=1), (90, 99)) if len(covered_pixels) else (0, 0)
    if 0 < _LAMP_RATIO * tenth < bright_value:
        bright_value = 2 * tenth
    return float(-np.log2(bright_value)) if 0 < bright_value < np.inf else 0.0


def filmic(color: np.ndarray) -> np.ndarray:
    """Bend linear values of 0 or more towards 1 as film does (Narkowicz 2016, a fit of the ACES curve)."""
    color = np.minimum(color, 1e6)  # of which the square is a float32, and which gives 1 as any larger one does
    return np.clip(color * (2.51 * color + 0.03) / (color * (2.43 * color + 0.59) + 0.14), 0, 1)


def unfilmic(bent: np.ndarray) -> np.ndarray:
    """Undo :func:`filmic`; 1, which it gives all values from 7.2, becomes 7.2."""
    a, b = 2.51 - 2.43 * bent, 0.03 - 0.59 * bent
    return (np.sqrt(b**2 + 0.56 * a * bent) - b) / (2 * a)


def srgb_to_linear(encoded: np.ndarray) -> np.ndarray:
    """Decode sRGB values in [0, 1] (IEC 61966-2-1), in the precision of the argument."""
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)


def linear_to_srgb(linear: np.ndarray) -> np.ndarray:
    """Encode linear values in [0, 1] as sRGB (IEC 61966-2-1), in the precision of the argument."""
    return np.where(linear <= 0.0031308, linear * 12.92, 1.055 * np.maximum(linear, 0.0031308) ** (1 / 2.4) - 0.055)
