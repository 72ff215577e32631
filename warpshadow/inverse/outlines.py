"""Outlines: where bodies are seen in a target, painted by hand or by a segmentation, and not right to the pixel."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from warpshadow.inverse.edges import signed_distances
from warpshadow.inverse.target import Target, area_means
from warpshadow.scene.scene import Scene


@dataclass(frozen=True, eq=False)
class Outlines:
    """The outlines of all targets at the size of a stage."""

    views: tuple[int, ...]  # of each outline, [outline]
    bodies: tuple[int, ...]
    distances: torch.Tensor  # signed [pixels of the targets], positive inside, [outline, height, width]
    scale: float  # pixels of the stage in one of the targets

    def differences(self, masks: torch.Tensor, offsets: torch.Tensor | None) -> torch.Tensor:
        """Masks of bodies minus their outlines, [outline, height, width].

        Args:
            masks: Part of each pixel that each body covers, [view, body, height, width].
            offsets: By how much outlines are moved outwards [pixels of the targets], [view]; None for 0.

        Differentiable: masks, offsets.
        """
        distances = self.distances
        if offsets is not None:
            distances = distances + offsets[list(self.views)][:, None, None]
        return masks[list(self.views), list(self.bodies)] - (0.5 + self.scale * distances).clamp(0, 1)

    def loss(self, masks: torch.Tensor, offsets: torch.Tensor | None) -> torch.Tensor:
        """Mean square of the differences, summed over outlines. Differentiable: masks, offsets."""
        return self.differences(masks, offsets).square().mean(dim=(1, 2)).sum()


def outlines_of(targets: Sequence[Target], scene: Scene, scale: float, device: torch.device) -> Outlines | None:
    """The outlines of targets; None where they have none."""
    painted_outlines = [
        (view, scene.body_number(body, "outlines"), mask)
        for view, target in enumerate(targets)
        for body, mask in target.outlines.items()
    ]
    if not painted_outlines:
        return None
    views, bodies, masks = zip(*painted_outlines, strict=True)
    distances = np.stack([signed_distances(mask) for mask in masks])
    height_means, width_means = (area_means(count, max(1, round(count * scale))) for count in distances.shape[1:])
    small_distances = torch.einsum("ih,ohw,jw->oij", height_means, torch.from_numpy(distances), width_means)
    return Outlines(views, bodies, small_distances.contiguous().to(device), scale)
