"""The verdict on a fit: whether its result explains the targets.

A loss that falls no further tells of a minimum, not of which. Small images of the result do: how far they are off, how
much of each moved body targets show, and whether another exposure would explain most of the residual.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import torch

from warpshadow.inverse.free import Exposure
from warpshadow.inverse.free.base import Values
from warpshadow.inverse.loss import clip_saturated
from warpshadow.inverse.model import Model
from warpshadow.inverse.problem import Problem
from warpshadow.inverse.schedule import Stage
from warpshadow.inverse.target import Outlines
from warpshadow.inverse.world import FitContext, World

MAX_EXPLAINED_SHARE = 0.5  # part of the residual's squares that a factor of an image may explain without a warning

MIN_EXPOSURE_GAP = 0.2
"""Stops from which on an exposure draws a warning; smaller gaps also come from a wrong pose."""

MAX_IMAGE_ERROR = 0.25  # error of images that is poor: a pose in a wrong minimum has 0.34, and where it is found 0.02

MIN_EXPLAINED_SHARE = 0.85
"""Share of a body, see :func:`explained_shares`, below which it is not explained: of 24 fits of a bunny to images with
noise of 3%, those that found it have 0.95 or more, and wrong minima 0.81 or less, where a small bunny's images may be
off by 14% alone.
"""

_SEEN_CHANGE = 0.1  # part of the largest change of a pixel by a body from which on pixels count
_LEAST_CHANGE = 1e-3  # largest change by a body that is not seen, nor its shadow [root mean squares of the targets]

_SIDE = 96  # shorter side of small images [pixels]


@dataclass(frozen=True)
class Verdict:
    """Whether a result explains its targets.

    Args:
        image_error: Root mean square of the differences of small images from the targets, as a part of that of the
            targets; None where the last stage compares outlines alone.
        shown: Share of each body of a free pose or shape, with its shadow, that targets show, 0 to 1, by name; see
            :func:`explained_shares`.
        unseen: Share of the counted pixels that see no body, 0 for targets with coverage.
        exposure_gaps: Stops by which targets are brighter, by view, where that is most of the residual.
    """

    image_error: float | None
    shown: dict[str, float]
    unseen: float = field(default=0.0, repr=False)
    exposure_gaps: dict[int, float] = field(default_factory=dict, repr=False)

    @property
    def is_explained(self) -> bool:
        """Whether images are off by at most 25%, and targets show at least 85% of each body that the fit moves."""
        return (self.image_error or 0.0) <= MAX_IMAGE_ERROR and not self.unexplained

    @property
    def unexplained(self) -> dict[str, float]:
        """Shares of bodies that are too small, by name."""
        return {name: shown for name, shown in self.shown.items() if shown < MIN_EXPLAINED_SHARE}

    def __str__(self) -> str:
        parts = ", ".join(f"{shown:.0%} of {name!r}" for name, shown in self.unexplained.items())
        error = self.image_error
        texts = [
            "" if error is None else f"images are off by {error:.0%} of their root mean square",
            f"targets show {parts}, shadows included" if parts else "",
        ]
        return ", and ".join(filter(None, texts))


def verdict(problem: Problem, context: FitContext, values: Mapping[str, Values], last: Stage) -> Verdict:
    """Judge the values at the end of a fit, whose last stage says whether images are compared."""
    model = Model(problem, context, small_stage(problem))
    names = context.scene.unique_names
    with torch.no_grad():
        images = model.images(values)
    compares, is_exposure_known = last.compares == "all", problem.light is None and not problem.free_of(Exposure)
    return Verdict(
        image_error(model, images) if compares else None,
        {names[number]: shown for number, shown in explained_shares(model, values, images).items()},
        0.0 if problem.targets[0].image.shape[2] == 4 else unseen_share(model, images),
        exposure_gaps(model, images) if is_exposure_known else {},
    )


def small_stage(problem: Problem) -> Stage:
    """A stage of the least cost: small images, one sample a pixel."""
    return Stage(scale=min(1.0, _SIDE / min(problem.targets[0].image.shape[:2])), supersampling=1)


def unseen_share(model: Model, images: torch.Tensor) -> float:
    """Share of the counted pixels that see no body; only for targets without coverage, which tells where bodies are.

    Such pixels are black in every image, so their residual stays, and light and reflectance cannot tell why.
    """
    return float((model.weights * (images[..., 3] < 0.5)).sum() / model.weights.sum())


def exposure_gaps(model: Model, images: torch.Tensor) -> dict[int, float]:
    """Stops by which targets are brighter than images, for the views where that explains most of the residual."""
    gaps = {}
    for view, (image, target, weight) in enumerate(zip(images, model.targets, model.weights, strict=True)):
        weight = weight[..., None].expand(*weight.shape, 3)
        if model.saturated is not None:
            weight = weight * ~model.saturated[view]
        image, target = image[..., :3], target[..., :3]
        factor = float((weight * image * target).sum() / (weight * image.square()).sum().clamp_min(1e-30))
        residual, left = ((weight * (gain * image - target).square()).sum() for gain in (1.0, factor))
        if factor > 0 and abs(math.log2(factor)) > MIN_EXPOSURE_GAP and left < (1 - MAX_EXPLAINED_SHARE) * residual:
            gaps[view] = math.log2(factor)
    return gaps


def image_error(model: Model, images: torch.Tensor) -> float:
    """Root mean square of the differences from the targets, as a part of that of the targets.

    Pixels count as in the end of the fit: by their masks, and less where a robust loss takes them for an occluder's.
    Of black targets it is the root mean square itself.
    """
    weight = model.pixel_weights(images)[..., None]
    targets = model.targets[..., :3]
    differences = clip_saturated(images, model.targets, model.saturated)[..., :3] - targets
    squares, unit = ((weight * item.square()).sum() for item in (differences, targets))
    return math.sqrt(float(squares / torch.where(unit > 0, unit, weight.sum())))


def explained_shares(model: Model, values: Mapping[str, Values], images: torch.Tensor) -> dict[int, float]:
    """Shares of the bodies of a free pose or shape that targets show, by number; 0 to 1.

    A body changes the pixels in which it, or its shadow, is seen: from an image without it. Targets show it in a pixel
    if they are off the image by less than half of the change, or less than three times as much as elsewhere, by the
    median; pixels count by their changes, and by their masks. So a few occluders cost little, and a body that covers
    little of the images counts as much as a large one. Of a body with outlines it is the share that its mask and an
    outline have in common.

    Args:
        model: Of small images.
        values: Free parameters by name.
        images: Of these, [view, height, width, 4].
    """
    numbers = sorted({free.number for free in model.problem.free_of_bodies if free.reframes})
    if not numbers:
        return {}
    result: dict[int, float] = {}
    with torch.no_grad():
        world = model.world(values)
        images = _in_units(model, images)
        residuals = (_in_units(model, model.targets) - images).norm(dim=-1)
        outlined_shares = {} if model.outlines is None else _outlined_shares(model.outlines, world)
        for number in numbers:
            if number in outlined_shares:
                result[number] = outlined_shares[number]
                continue
            world = model.world(values)
            world.move_out_of_view(number, model.context)
            changes = (_in_units(model, world.images()) - images).norm(dim=-1) * (model.weights > 0)
            is_changed = changes > max(_SEEN_CHANGE * float(changes.max()), _LEAST_CHANGE)
            elsewhere = residuals[~is_changed & (model.weights > 0)]
            accepted = (changes / 2).clamp_min(3 * float(elsewhere.median()) if len(elsewhere) else 0.0)
            counts = model.weights * changes * is_changed
            result[number] = float((counts * (residuals < accepted)).sum() / counts.sum().clamp_min(1e-30))
    return result


def _outlined_shares(outlines: Outlines, world: World) -> dict[int, float]:
    """Least share of each body's mask and outline that both have, by number."""
    masks, result = world.masks(), dict[int, float]()
    gaps = outlines.differences(masks, world.outline_offsets)
    for view, body, gap in zip(outlines.views, outlines.bodies, gaps, strict=True):
        union = torch.maximum(masks[view, body], masks[view, body] - gap).sum().clamp_min(1e-30)
        result[body] = min(result.get(body, 1.0), 1 - float(gap.abs().sum() / union))
    return result


def _in_units(model: Model, images: torch.Tensor) -> torch.Tensor:
    """Colors of images in units of the fit, and the coverage if targets have it, [view, height, width, 3 or 4]."""
    images = clip_saturated(images, model.targets, model.saturated)
    colors = images[..., :3] / model.context.unit
    return torch.cat([colors, images[..., 3 : model.targets.shape[-1]]], dim=-1)
