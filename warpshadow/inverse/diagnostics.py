"""Diagnostics of a fit.

Before it: factors that images show as a product, and a texture that may keep a shadow. After it: pixels without a body,
wrong exposure, images or bodies that are not explained, a loss that was still falling.
"""

import math
from collections.abc import Mapping, Sequence

import numpy as np
import torch

from warpshadow import check
from warpshadow.inverse.free import Exposure, Pose
from warpshadow.inverse.free.base import Values
from warpshadow.inverse.loss import clip_saturated
from warpshadow.inverse.model import Model
from warpshadow.inverse.problem import Problem
from warpshadow.inverse.schedule import Stage
from warpshadow.inverse.target import Outlines
from warpshadow.inverse.world import FitContext, World
from warpshadow.scene.remarks import is_out_of_frame

MAX_UNSEEN_SHARE = 0.01  # share of the counted pixels that may see no body without a warning

MAX_LAST_GAIN = 0.01  # part of its loss that a fit may still gain over a window of iterations without a warning

MAX_EXPLAINED_SHARE = 0.5  # part of the residual's squares that a factor of an image may explain without a warning

MIN_EXPOSURE_GAP = 0.2
"""Stops from which on an exposure draws a warning; smaller gaps also come from a wrong pose."""

MAX_IMAGE_ERROR = 0.25  # error of images that is poor: a pose in a wrong minimum has 0.34, and where it is found 0.02

MIN_EXPLAINED_SHARE = 0.85
"""Share of a body, see :func:`explained_shares`, below which it is not explained: of 24 fits of a bunny to images with
noise of 3%, those that found it have 0.95 or more, and wrong minima 0.81 or less, where a small bunny's images may be
off by 14% alone.
"""

_FAR = 1e3  # distance at which a body is taken away [distances of the scene from the eye]
_SEEN_CHANGE = 0.1  # part of the largest change of a pixel by a body from which on pixels count
_LEAST_CHANGE = 1e-3  # largest change by a body that is not seen, nor its shadow [root mean squares of the targets]

_WINDOW = 20  # iterations, of which the second half is compared with the first
_SIDE = 96  # shorter side of small images [pixels]


class DiagnosticWarning(UserWarning):
    """A reason to doubt a fit."""


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
    """
    weight = model.pixel_weights(images)[..., None]
    targets = model.targets[..., :3]
    differences = clip_saturated(images, model.targets, model.saturated)[..., :3] - targets
    squares, unit = ((weight * item.square()).sum() for item in (differences, targets))
    return math.sqrt(float(squares / unit.clamp_min(1e-30)))


def explained_shares(model: Model, values: Mapping[str, Values]) -> dict[int, float]:
    """Shares of the bodies of a free pose or shape that targets show, by number; 0 to 1.

    A body changes the pixels in which it, or its shadow, is seen: from an image without it. Targets show it in a pixel
    if they are off the image by less than half of the change, or less than three times as much as elsewhere, by the
    median; pixels count by their changes, and by their masks. So a few occluders cost little, and a body that covers
    little of the images counts as much as a large one. Of a body with outlines it is the share that its mask and an
    outline have in common.
    """
    numbers = sorted({free.number for free in model.problem.free_of_bodies if free.reframes})
    if not numbers:
        return {}
    far = _FAR * float(model.context.distances.max())
    result: dict[int, float] = {}
    with torch.no_grad():
        world = model.world(values)
        images = _in_units(model, world.images())
        residuals = (_in_units(model, model.targets) - images).norm(dim=-1)
        outlined_shares = {} if model.outlines is None else _outlined_shares(model.outlines, world)
        for number in numbers:
            if number in outlined_shares:
                result[number] = outlined_shares[number]
                continue
            world = model.world(values)
            world.translations[number] = world.translations[number] - far * torch.eye(3, device=residuals.device)[1]
            world.moving.add(number)
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


def gain_of_last(losses: Sequence[float]) -> float:
    """Part of its loss that a descent gained over its last iterations, by the means of ten and of the ten before."""
    half = _WINDOW // 2
    if len(losses) < 2 * half:
        return 0.0
    recent_sum, earlier_sum = sum(losses[-half:]), sum(losses[-2 * half : -half])
    return 1 - recent_sum / earlier_sum if earlier_sum > 0 else 0.0


def warn_of(
    problem: Problem, context: FitContext, values: Mapping[str, Values], stage: Stage, losses: Sequence[float], end: str
) -> None:
    """Warn of reasons to doubt a result."""
    is_exposure_known = problem.light is None and not problem.free_of(Exposure)
    has_coverage = problem.targets[0].image.shape[2] == 4
    model = Model(problem, context, small_stage(problem))
    with torch.no_grad():
        images = model.images(values)
    is_doubted = not has_coverage and _warn_of_unseen(model, images)
    is_doubted |= is_exposure_known and _warn_of_exposures(model, images)
    gain = gain_of_last(losses)
    is_falling = end == "finished" and gain > MAX_LAST_GAIN
    if is_falling and problem.light is not None:
        is_doubted = True
        is_alone = all(free.is_light for free in problem.free)
        solving = 'stages = "photograph", which solves for the light'
        check.warn(
            f"light has not converged: the loss still fell by {gain:.1%} over the last {_WINDOW // 2} iterations; "
            f"give the last stage more iterations, or {'a learning_rate of 0.2' if is_alone else solving}",
            DiagnosticWarning,
        )
    if stage.compares == "all" and not is_doubted:
        _warn_of_error(model, images, explained_shares(model, values), is_falling)


def warn_before(problem: Problem) -> None:
    """Warn of parameters that images do not tell apart.

    These are factors of all images, of which all but one have to be known; and, by one image, a pose and the texture of
    another body, which may keep any shadow.
    """
    factors = _free_factors(problem)
    if len(factors) > 1:
        check.warn(
            f"free: got {' and '.join(factors)}, expected all but one of them to be known: images show their product "
            f"alone, so each may be wrong by any factor; {'; or '.join(filter(None, factors.values()))}",
            DiagnosticWarning,
        )
    poses = {pose.number for pose in problem.free_of(Pose)}
    textures = [surface.number for surface in problem.free_of_bodies if surface.paints_shadows]
    names = [body.name for body in problem.scene.bodies]
    for texture in textures if len(problem.targets) == 1 else ():
        if moved := sorted(poses - {texture}):
            check.warn(
                f"the texture of {names[texture]!r} is free beside the pose of {names[moved[0]]!r}: it may keep a "
                "shadow where the body began, and the uncertainty of the pose does not know; fit the pose first, then "
                "the texture, or give the texture a palette",
                DiagnosticWarning,
            )


def _free_factors(problem: Problem) -> dict[str, str]:
    """Name the free parameters that are factors of all images, and how each becomes known.

    The exposure is one; the light, where no map or lamp that emits is known; and the reflectance of the bodies that
    cameras see, where that of all is free, and neither gloss, lamps that are seen nor bounces, where it counts twice,
    tell it.
    """
    scene, cameras = problem.scene, problem.cameras()
    lit, reflecting = (
        {free.number for free in problem.free_of_bodies if free.scales == factor} for factor in ("light", "reflectance")
    )
    seen = {k: b for k, b in enumerate(scene.bodies) if not all(is_out_of_frame(b, camera) for camera in cameras)}
    is_map_known = problem.light is None and np.any(scene.known_light.radiance)
    lamps = {number for number, body in enumerate(scene.bodies) if body.is_emitter and np.any(body.emission)}
    is_light_free = not is_map_known and lamps <= lit
    is_determined = scene.bounces or any(body.is_glossy or body.is_emitter for body in seen.values())
    factors = {
        "light": is_light_free and "",
        "exposure": any(free.scales == "exposure" for free in problem.free)
        and "leave out Exposure(), or of several views keep one's, Exposure(reference=0)",
        "the reflectance of all bodies": not is_determined
        and set(seen) <= reflecting
        and "leave out the Albedo or Texture of a body that is known",
    }
    return {name: remedy for name, remedy in factors.items() if remedy is not False}


def _warn_of_unseen(model: Model, images: torch.Tensor) -> bool:
    """Warn of pixels without a body; return whether there are."""
    unseen = unseen_share(model, images)
    if MAX_UNSEEN_SHARE < unseen < 1:  # of cameras that see nothing images warn
        check.warn(
            f"{unseen:.0%} of the counted pixels see no body, and are explained as black; mask them out, or make the "
            "ground larger",
            DiagnosticWarning,
        )
    return unseen > MAX_UNSEEN_SHARE


def _warn_of_exposures(model: Model, images: torch.Tensor) -> bool:
    """Warn of targets of other exposures than the images; return whether there are."""
    gaps = exposure_gaps(model, images)
    for view, stops in gaps.items():
        check.warn(
            f"targets[{view}] is {2**stops:.3g} times as bright as the fitted image, which is most of the residual, "
            "and may have led poses and colors astray: set exposure = true in [free], inverse.Exposure(), or the "
            f"target's exposure = {stops:+.2f} [stops]",
            DiagnosticWarning,
        )
    return bool(gaps)


def _warn_of_error(model: Model, images: torch.Tensor, explained: Mapping[int, float], is_falling: bool) -> None:
    error, names = image_error(model, images), model.context.scene.unique_names
    unexplained = {number: part for number, part in explained.items() if part < MIN_EXPLAINED_SHARE}
    if error > MAX_IMAGE_ERROR or unexplained:
        shown = ", ".join(f"{part:.0%} of {names[number]!r}" for number, part in unexplained.items())
        shown = f", and targets show {shown}, shadows included" if shown else ""
        reason = "light, reflectance, shapes or the camera may not be those of the targets"
        if explained:
            reason = (
                "a pose may be in another minimum, which more candidates of its stages, or of a larger spread, leave, "
                f'or stands_on = "…" excludes; or {reason}'
            )
        if is_falling:
            reason = "the loss was still falling: give the last stage more iterations"
        check.warn(
            f"the fit explains the targets poorly: images are off by {error:.0%} of their root mean square"
            f"{shown}; {reason}",
            DiagnosticWarning,
        )
