"""Pictures of a fit under way."""

from __future__ import annotations

import numpy as np
import torch

from warpshadow.assets.color import srgb_to_linear
from warpshadow.assets.image import write_image
from warpshadow.check import AnyPath


def write_preview(path: AnyPath, targets: torch.Tensor, images: torch.Tensor) -> None:
    """Write a picture of targets, images and how they differ (gray is alike), a row for each view."""
    wanted, got = targets[..., :3].cpu().numpy(), images[..., :3].cpu().numpy()
    white = white_of(wanted)
    difference = srgb_to_linear(np.clip(0.5 + 0.5 * (got - wanted) / white, 0, 1))  # in steps that look even
    parts = zip(wanted / white, got / white, difference, strict=True)
    write_image(path, np.concatenate([np.concatenate(view, axis=1) for view in parts], axis=0))


def white_of(images: np.ndarray) -> float:
    """Radiance that a picture shows as white: all but the brightest percent are below."""
    return float(np.percentile(images.max(axis=-1), 99)) or 1.0
