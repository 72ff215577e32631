"""Targets: the images that a fit explains."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch

from warpshadow import check
from warpshadow.assets.camera import Camera
from warpshadow.assets.color import linear_to_srgb
from warpshadow.assets.image import read_image
from warpshadow.check import AnyPath

_ENCODED = (".png", ".jpg", ".jpeg")  # which read_image decodes from sRGB


@dataclass(frozen=True, eq=False, init=False)
class Target:
    """An image that a fit explains.

    A path, relative to the current folder, stands for its file, as in fit files.

    Args:
        image: Linear RGB, shape [height, width, 3]; or premultiplied RGB with coverage, [height, width, 4], as
            renderers make it, and the coverage is explained, too; or a file that :func:`read_target` reads.
        mask: How much each pixel counts, 0 to 1, shape [height, width]; by default all do. Mask out pixels that the
            scene does not model: the background of a photograph, say. Or a file that :func:`read_mask` reads.
        camera: Where the image was taken; by default the scene's camera, made as large as the image.
    """

    image: np.ndarray = field(repr=False)
    mask: np.ndarray | None = field(repr=False)
    camera: Camera | None

    def __init__(
        self, image: npt.ArrayLike | AnyPath, mask: npt.ArrayLike | AnyPath | None = None, camera: Camera | None = None
    ):
        vars(self).update(image=image, mask=mask, camera=camera)
        for name, read in (("image", read_target), ("mask", read_mask)):
            if check.is_path(getattr(self, name)):
                path = check.file(name, getattr(self, name))
                with check.located(name):
                    object.__setattr__(self, name, read(path))
        image = check.pixels("image", self.image, expected="linear RGB [height, width, 3], or the path of a picture")
        if image.ndim != 3 or image.shape[2] not in (3, 4) or image.size == 0:
            remedy = check.channels_last(image.shape)
            raise ValueError(
                f"image: got shape {image.shape}, expected [height, width, 3 or 4]{remedy and f': {remedy}'}"
            )
        if self.mask is not None:
            is_bool = np.asarray(self.mask).dtype == bool
            arguments = np.asarray(self.mask, np.float32) if is_bool else self.mask
            mask = check.numbers(
                "mask", arguments, expected="weights of pixels [height, width], or the path of a picture"
            )
            check.shape("mask", mask.shape, image.shape[:2])
            check.finite("mask", mask)
            if mask.min() < 0 or mask.max() > 1 or not mask.any():
                raise ValueError(
                    f"mask: got values from {mask.min():g} to {mask.max():g}, expected 0 to 1, and not 0 alone; of "
                    "8 bits: mask / 255"
                )
            object.__setattr__(self, "mask", mask)
            image[mask == 0] = 0  # whatever the value
        check.finite("image", image)
        object.__setattr__(self, "image", image)
        size = image.shape[1], image.shape[0]
        check.instance("camera", self.camera, (Camera, type(None)), "a Camera, or None for the scene's")
        if self.camera is not None and (self.camera.width, self.camera.height) != size:
            raise ValueError(
                f"image: got {size[0]} × {size[1]} pixels, expected the camera's "
                f"{self.camera.width} × {self.camera.height}"
            )

    def weights(self) -> np.ndarray:
        """How much each pixel counts, float32 of shape [height, width]."""
        return np.ones(self.image.shape[:2], np.float32) if self.mask is None else self.mask


def read_target(path: AnyPath) -> np.ndarray:
    """Linear RGB, or premultiplied RGB with coverage where the file has alpha, which is straight in PNG alone."""
    pixels = read_image(path)
    if pixels.shape[2] < 3:
        pixels = np.concatenate([np.repeat(pixels[..., :1], 3, axis=2), pixels[..., 1:]], axis=2)
    if pixels.shape[2] == 4 and Path(path).suffix.lower() in _ENCODED:
        pixels[..., :3] *= pixels[..., 3:]
    return pixels


def read_mask(path: AnyPath) -> np.ndarray:
    """Gray as it is stored, 0 to 1: a mask is no light, so that half gray is half."""
    pixels = read_image(path)
    has_alpha = pixels.shape[2] in (2, 4)
    colors = pixels[..., :-1] if has_alpha else pixels
    if (colors != colors[..., :1]).any() or (has_alpha and (pixels[..., -1] != 1).any()):
        raise ValueError(f"got colors or transparency in {path}, expected gray")
    gray = colors[..., 0]
    return linear_to_srgb(gray) if Path(path).suffix.lower() in _ENCODED else gray


def stacked(targets: Sequence[Target], scale: float, device: torch.device) -> tuple[torch.Tensor, torch.Tensor]:
    """Images [view, height, width, channel] and weights [view, height, width] at the size of a camera resized."""
    images = np.stack([target.image for target in targets])
    weights = np.stack([target.weights() for target in targets])[..., None]
    down, width_means = (_area_means(count, max(1, round(count * scale))).to(device) for count in images.shape[1:3])

    def resized(pixels: np.ndarray) -> torch.Tensor:
        return torch.einsum("ih,vhwc,jw->vijc", down, torch.from_numpy(pixels).to(device), width_means)

    weight = resized(weights)
    image = resized(images * weights) / torch.where(weight > 0, weight, 1)  # masked-out pixels bleed into nothing
    return image.contiguous(), weight[..., 0].contiguous()


def _area_means(count: int, fewer: int) -> torch.Tensor:
    """Averages of a row of pixels by area, [fewer, count]; ``fewer`` need not be a part of ``count``."""
    edges, coarse_edges = np.arange(count + 1), np.arange(fewer + 1) * (count / fewer)
    ends = np.minimum(edges[1:], coarse_edges[1:, None])
    starts = np.maximum(edges[:-1], coarse_edges[:-1, None])
    return torch.from_numpy((np.maximum(ends - starts, 0) * (fewer / count)).astype(np.float32))
