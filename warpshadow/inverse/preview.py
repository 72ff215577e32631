"""Pictures of a fit under way."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import torch

from warpshadow.image import linear_to_srgb


def write_preview(path: str | Path, targets: torch.Tensor, images: torch.Tensor) -> None:
    """Write a picture of targets, images and how they differ (gray is alike), a row for each view."""
    wanted, got = targets[..., :3].cpu().numpy(), images[..., :3].cpu().numpy()
    white = white_of(wanted)
    parts = [wanted / white, got / white, 0.5 + 0.5 * (got - wanted) / white]
    encoded = [linear_to_srgb(np.clip(part, 0, 1)) for part in parts[:2]]
    sheet = np.concatenate([np.concatenate(view, axis=1) for view in zip(*encoded, parts[2], strict=True)], axis=0)
    write_picture(Path(path), sheet)


def white_of(images: np.ndarray) -> float:
    """Radiance that a picture shows as white: all but the brightest percent are below."""
    return float(np.percentile(images.max(axis=-1), 99)) or 1.0


def write_picture(path: Path, encoded: np.ndarray) -> None:
    """Write sRGB values in [0, 1]; the file appears complete or not at all."""
    from PIL import Image

    unfinished = path.with_name(f".{path.stem}.part{path.suffix}")
    Image.fromarray((255 * np.clip(encoded, 0, 1) + 0.5).astype(np.uint8)).save(unfinished)
    os.replace(unfinished, path)
