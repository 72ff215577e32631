"""Losses: how unlike the images of a model are to its targets."""

from dataclasses import dataclass

import torch

from warpshadow import check

KINDS = ("l2", "l1", "huber", "geman-mcclure", "barron")
_BY_PIXEL = ("geman-mcclure", "barron")
REDUCTIONS = ("mean", "sum")


@check.frozen()
@dataclass(frozen=True)
class Loss:
    """Loss of a difference between images.

    Differences are in units of the targets' root mean square, so that no weight or rate depends on exposure.

    Args:
        kind: "l2", squares (the paper's); "l1", magnitudes; "huber", squares up to ``delta`` and magnitudes beyond,
            less disturbed by noise and model errors. Two that are redescending, of a pixel's three differences x
            together, so that an occluder or a highlight hardly counts: "geman-mcclure", x² / (1 + x² / delta²); and
            "barron", the general robust loss of ``alpha`` [Barron 2019], x² near 0 like the others.
        delta: Where "huber" changes over, and the scale of redescending ones [root mean squares of the target].
        coverage: Weight of the coverage, for targets that have it, and of outlines.
        reduction: "mean" over pixels, or "sum", for plain gradient descent on parameters of single pixels.
        alpha: Shape of "barron": 2 is "l2", 1 about "huber", 0 Cauchy's, -2 Geman and McClure's (of twice the delta).
    """

    kind: str = "l2"
    delta: float = 0.1
    coverage: float = 1.0
    reduction: str = "mean"
    alpha: float = -2.0

    def __post_init__(self) -> None:
        check.choice("kind", self.kind, KINDS)
        check.choice("reduction", self.reduction, REDUCTIONS)
        check.positive("delta", self.delta)
        check.nonnegative("coverage", self.coverage)
        if check.number("alpha", self.alpha) > 2:
            raise ValueError(f"alpha: got {self.alpha:g}, expected 2 or less")

    def __call__(self, images: torch.Tensor, targets: torch.Tensor, weights: torch.Tensor, unit: float) -> torch.Tensor:
        """Compare images.

        Args:
            images: Premultiplied linear RGB and coverage, [view, height, width, 4].
            targets: [view, height, width, 3 or 4].
            weights: Of the pixels, [view, height, width].
            unit: Radiance that counts as 1.
        Differentiable: images.
        """
        costs = self._costs((images[..., :3] - targets[..., :3]) / unit)
        if targets.shape[-1] == 4 and self.coverage:
            costs = costs + self.coverage * self._costs(images[..., 3:] - targets[..., 3:])
        total = (weights * costs).sum()
        return total / weights.sum() if self.reduction == "mean" else total

    def pixel_shares(self, weights: torch.Tensor) -> torch.Tensor:
        """Factors of the pixels' costs in the loss, of their weights: parts of all with the reduction "mean"."""
        return weights / weights.sum() if self.reduction == "mean" else weights

    def _costs(self, x: torch.Tensor) -> torch.Tensor:
        """Cost of each pixel, of its differences, [..., channel] to [...]."""
        if self.kind in _BY_PIXEL:
            squares = x.square().sum(-1)
            if self.kind == "geman-mcclure":
                return squares / (1 + squares / self.delta**2)
            return self._robust_cost(squares / self.delta**2) * (2 * self.delta**2)
        if self.kind == "l2":
            return x.square().sum(-1)
        if self.kind == "l1":
            return x.abs().sum(-1)
        none = torch.zeros_like(x)
        return torch.nn.functional.huber_loss(x, none, reduction="none", delta=self.delta).sum(-1)

    def _robust_cost(self, squares: torch.Tensor) -> torch.Tensor:
        """ρ(x, α, 1) of squares of x [Barron 2019, equation 8]."""
        if self.alpha == 2:
            return squares / 2
        if self.alpha == 0:
            return torch.log1p(squares / 2)
        width = 2 - self.alpha
        return width / self.alpha * ((squares / width + 1) ** (self.alpha / 2) - 1)

    def pixel_weights(self, x: torch.Tensor) -> torch.Tensor:
        """Weights w for which Σ w x² has the gradient of the costs: the weights of iteratively reweighted least
        squares.

        They tell which pixels a fit believes: about 0 where a redescending loss takes a pixel for an occluder's.

        Args:
            x: Differences of colors in units of radiance, [..., channel].

        Returns:
            [..., channel].
        """
        size = x.abs().clamp_min(1e-6)
        if self.kind == "l2":
            return torch.ones_like(x)
        if self.kind == "l1":
            return 0.5 / size
        if self.kind == "huber":
            return 0.5 * (self.delta / size).clamp_max(1)
        squares = x.square().sum(-1, keepdim=True).expand_as(x) / self.delta**2
        if self.kind == "geman-mcclure":
            return (1 + squares) ** -2
        return torch.ones_like(x) if self.alpha == 2 else (squares / (2 - self.alpha) + 1) ** (self.alpha / 2 - 1)

    @property
    def is_robust(self) -> bool:
        """Whether it counts pixels of large differences less than others, relative to their squares."""
        return self.kind in ("huber", "geman-mcclure") or (self.kind == "barron" and self.alpha < 2)

    def confidence(self, x: torch.Tensor) -> torch.Tensor:
        """How much a pixel counts in the fit beside one that is explained: 1 without a difference, about 0 for an
        occluder or a highlight where the loss is redescending.

        It is the weight of :meth:`pixel_weights`, relative to that of no difference, the mean over channels; 1 for
        "l2", and for "l1", which has no such scale.

        Args:
            x: Differences of colors in units of radiance, [..., channel].

        Returns:
            [...], 0 to 1.
        """
        if not self.is_robust:
            return torch.ones_like(x[..., 0])
        return (self.pixel_weights(x) / self.pixel_weights(torch.zeros_like(x))).mean(dim=-1)


def clip_saturated(images: torch.Tensor, targets: torch.Tensor, saturated: torch.Tensor | None) -> torch.Tensor:
    """Images [view, height, width, 4] to compare with targets: no brighter than these where they are saturated
    [view, height, width, 3], None for nowhere, and so lower bounds. Differentiable: images, below the bounds.
    """
    if saturated is None:
        return images
    color = torch.where(saturated, torch.minimum(images[..., :3], targets[..., :3]), images[..., :3])
    return torch.cat([color, images[..., 3:]], dim=-1)
