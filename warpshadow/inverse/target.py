"""Targets: the images that a fit explains."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch

from warpshadow import check
from warpshadow.camera import Camera


@dataclass(frozen=True, eq=False)
class Target:
    """An image that a fit explains.

    Args:
        image: Linear RGB, shape [height, width, 3]; or premultiplied RGB with coverage, [height, width, 4], as
            renderers make it, and the coverage is explained, too.
        mask: How much each pixel counts, 0 to 1, shape [height, width]; by default all do. Mask out what the scene has
            no body for: the background of a photograph, say.
        camera: Where the image was taken; by default the scene's camera, made as large as the image.

    Raises:
        ValueError: naming the argument, what it got and what it accepts.
    """

    image: np.ndarray = field(repr=False)
    mask: np.ndarray | None = field(default=None, repr=False)
    camera: Camera | None = None

    def __post_init__(self) -> None:
        """Validate, and hold arrays as float32."""
        image = np.array(self.image, np.float32)
        if image.ndim != 3 or image.shape[2] not in (3, 4) or image.size == 0:
            raise ValueError(f"image: got shape {image.shape}, expected [height, width, 3 or 4]")
        if self.mask is not None:
            mask = np.array(self.mask, np.float32)
            check.shape("mask", mask.shape, image.shape[:2])
            check.finite("mask", mask)
            if mask.min() < 0 or mask.max() > 1 or not mask.any():
                raise ValueError(
                    f"mask: got values from {mask.min():g} to {mask.max():g}, expected 0 to 1, and not 0 alone"
                )
            object.__setattr__(self, "mask", mask)
            image[mask == 0] = 0  # whatever is there
        check.finite("image", image)
        object.__setattr__(self, "image", image)
        size = image.shape[1], image.shape[0]
        if self.camera is not None and (self.camera.width, self.camera.height) != size:
            raise ValueError(
                f"image: got {size[0]} × {size[1]} pixels, expected the camera's "
                f"{self.camera.width} × {self.camera.height}"
            )

    @property
    def has_coverage(self) -> bool:
        """Whether the image says what of each pixel is covered."""
        return self.image.shape[2] == 4

    def weights(self) -> np.ndarray:
        """How much each pixel counts, float32 of shape [height, width]."""
        return np.ones(self.image.shape[:2], np.float32) if self.mask is None else self.mask


def stacked(targets: Sequence[Target], scale: float, device: torch.device) -> tuple[torch.Tensor, torch.Tensor]:
    """Images [view, height, width, channel] and weights [view, height, width] at a size, by averages over areas."""
    images = np.stack([target.image for target in targets])
    weights = np.stack([target.weights() for target in targets])[..., None]
    height, width = round(images.shape[1] * scale), round(images.shape[2] * scale)

    def resized(pixels: np.ndarray) -> torch.Tensor:
        planes = torch.from_numpy(pixels).to(device).permute(0, 3, 1, 2)
        return torch.nn.functional.interpolate(planes, (height, width), mode="area").permute(0, 2, 3, 1)

    weight = resized(weights)
    image = resized(images * weights) / torch.where(weight > 0, weight, 1)  # what is masked out bleeds into nothing
    return image.contiguous(), weight[..., 0].contiguous()
