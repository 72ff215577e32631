"""Losses: how unlike the images of a model are to its targets."""

from dataclasses import dataclass

import torch

from warpshadow import check

KINDS = ("l2", "l1", "huber")
REDUCTIONS = ("mean", "sum")


@dataclass(frozen=True)
class Loss:
    """How a difference of images counts.

    Differences are in units of the targets' root mean square, so that no weight or rate depends on exposure.

    Args:
        kind: "l2", squares (the paper's); "l1", magnitudes; "huber", squares up to ``delta`` and magnitudes beyond,
            less disturbed by noise and model errors.
        delta: Where "huber" changes over [root mean squares of the target].
        coverage: Weight of the coverage, for targets that have it. reduction: "mean" over pixels, or "sum", for plain
            gradient descent on parameters of single pixels.
    """

    kind: str = "l2"
    delta: float = 0.1
    coverage: float = 1.0
    reduction: str = "mean"

    def __post_init__(self) -> None:
        check.choice("kind", self.kind, KINDS)
        check.choice("reduction", self.reduction, REDUCTIONS)
        check.positive("delta", self.delta)
        check.nonnegative("coverage", self.coverage)

    def __call__(self, images: torch.Tensor, targets: torch.Tensor, weights: torch.Tensor, unit: float) -> torch.Tensor:
        """Compare images.

        Args:
            images: Premultiplied linear RGB and coverage, [view, height, width, 4].
            targets: [view, height, width, 3 or 4].
            weights: Of the pixels, [view, height, width].
            unit: Radiance that counts as 1.

        Differentiable: images.
        """
        costs = self._costs((images[..., :3] - targets[..., :3]) / unit).sum(-1)
        if targets.shape[-1] == 4 and self.coverage:
            costs = costs + self.coverage * self._costs(images[..., 3] - targets[..., 3])
        total = (weights * costs).sum()
        return total / weights.sum() if self.reduction == "mean" else total

    def _costs(self, differences: torch.Tensor) -> torch.Tensor:
        if self.kind == "l2":
            return differences.square()
        if self.kind == "l1":
            return differences.abs()
        none = torch.zeros_like(differences)
        return torch.nn.functional.huber_loss(differences, none, reduction="none", delta=self.delta)
