"""Pictures of a fit under way."""

import numpy as np
import torch

from warpshadow.assets.color import auto_exposure, srgb_to_linear
from warpshadow.assets.image import write_image
from warpshadow.check import AnyPath


def write_preview(path: AnyPath, targets: torch.Tensor, images: torch.Tensor) -> None:
    """Write a picture of targets, images and differences; see :func:`side_by_side`."""
    write_image(path, side_by_side(targets, images))


def side_by_side(targets: torch.Tensor, images: torch.Tensor) -> np.ndarray:
    """Targets, images and differences (gray where equal), a row for each view: linear RGB, 0 to 1.

    Args:
        targets, images: Linear RGB, [view, height, width, 3 or more].
    Returns:
        Shape [view · height, 3 · width, 3].
    """
    target, got = targets[..., :3].cpu().numpy(), images[..., :3].cpu().numpy()
    white = 2.0 ** -auto_exposure(target)
    difference = srgb_to_linear(np.clip(0.5 + 0.5 * (got - target) / white, 0, 1))  # in steps that look even
    parts = zip(target / white, got / white, difference, strict=True)
    return np.concatenate([np.concatenate(view, axis=1) for view in parts], axis=0)
