"""Colors: sRGB's encoding, and the exposure at which linear values become a picture."""

import numpy as np

LUMINANCE = np.array([0.2126, 0.7152, 0.0722])  # of linear sRGB, Rec. 709


def auto_exposure(image: np.ndarray) -> float:
    """Exposure [stops] at which the brightest 1% of covered pixels saturate, for RGBA [height, width, 4]."""
    covered = image[image[..., 3] > 0]
    bright = np.percentile(covered[:, :3].max(axis=1), 99) if len(covered) else 0.0
    return float(-np.log2(bright)) if bright > 0 else 0.0


def exposed(image: np.ndarray, stops: float) -> np.ndarray:
    """Multiply color by 2^stops, and cut off what saturates and the negative lobes of SH, as a picture must."""
    color = np.clip(image[..., :3] * 2.0**stops, 0, 1)
    return np.concatenate([color, image[..., 3:]], axis=-1).astype(np.float32)


def srgb_to_linear(encoded: np.ndarray) -> np.ndarray:
    """Decode sRGB values in [0, 1] (IEC 61966-2-1), in the precision of the argument."""
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)


def linear_to_srgb(linear: np.ndarray) -> np.ndarray:
    """Encode linear values in [0, 1] as sRGB (IEC 61966-2-1), in the precision of the argument."""
    return np.where(linear <= 0.0031308, linear * 12.92, 1.055 * np.maximum(linear, 0.0031308) ** (1 / 2.4) - 0.055)
