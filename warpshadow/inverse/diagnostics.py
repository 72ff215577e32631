"""Diagnostics of a fit that has ended: pixels that see no body, and a loss that was still falling."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch

from warpshadow import check
from warpshadow.inverse.free.base import Values
from warpshadow.inverse.model import Model
from warpshadow.inverse.problem import Problem
from warpshadow.inverse.schedule import Stage
from warpshadow.inverse.world import Setting

UNSEEN = 0.01
"""Share of the counted pixels that may see no body without a warning."""

FALLING = 0.01
"""Part of its loss that a fit may still gain over a window of iterations without a warning."""

_WINDOW = 20  # iterations, of which the second half is compared with the first
_SIDE = 96  # shorter side of small images [pixels]


class DiagnosticWarning(UserWarning):
    """A fit that ended, and a reason to doubt it."""


def small_stage(problem: Problem) -> Stage:
    """A stage of the least cost: small images, one sample a pixel."""
    return Stage(scale=min(1.0, _SIDE / min(problem.targets[0].image.shape[:2])), supersampling=1)


def unseen_share(problem: Problem, setting: Setting, values: Mapping[str, Values]) -> float:
    """Share of the counted pixels that see no body; 0 for targets with coverage, which is compared.

    Such pixels are black in every image, so their residual stays, and light and reflectance cannot tell why.
    """
    if problem.targets[0].image.shape[2] == 4:
        return 0.0
    model = Model(problem, setting, small_stage(problem))
    with torch.no_grad():
        coverage = model.images(values)[..., 3]
    return float((model.weights * (coverage < 0.5)).sum() / model.weights.sum())


def gain_of_last(losses: Sequence[float]) -> float:
    """Part of its loss that a descent gained over its last iterations, by the means of ten and of the ten before."""
    half = _WINDOW // 2
    if len(losses) < 2 * half:
        return 0.0
    last, before = sum(losses[-half:]), sum(losses[-2 * half : -half])
    return 1 - last / before if before > 0 else 0.0


def warn_of(
    problem: Problem, setting: Setting, values: Mapping[str, Values], losses: Sequence[float], end: str
) -> None:
    """Warn of reasons to doubt a result.

    Args:
        problem, setting, values: Of the result.
        losses: Of the last descent.
        end: Why it ended.
    """
    share = unseen_share(problem, setting, values)
    if share > UNSEEN:
        check.warn(
            f"{share:.0%} of the counted pixels see no body, and are explained as black; mask them out, or make the "
            "ground larger",
            DiagnosticWarning,
        )
    gain = gain_of_last(losses)
    if end == "finished" and problem.basis is not None and gain > FALLING:
        check.warn(
            f"light has not converged: the loss still fell by {gain:.1%} over the last {_WINDOW // 2} iterations; "
            'give the last stage more iterations, or stages = "photograph", which solves for the light',
            DiagnosticWarning,
        )
