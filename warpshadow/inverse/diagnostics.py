"""Diagnostics of a fit.

Before it: factors that images show as a product, and a texture that may keep a shadow. After it: pixels without a body,
wrong exposure, images or bodies that are not explained, a loss that was still falling.
"""

from collections.abc import Sequence

import numpy as np

from warpshadow import check
from warpshadow.inverse.free import Pose
from warpshadow.inverse.problem import Problem
from warpshadow.inverse.result import Result
from warpshadow.inverse.verdict import Verdict
from warpshadow.scene.remarks import is_out_of_frame

MAX_UNSEEN_SHARE = 0.01  # share of the counted pixels that may see no body without a warning

MAX_LAST_GAIN = 0.01  # part of its loss that a fit may still gain over a window of iterations without a warning

_WINDOW = 20  # iterations, of which the second half is compared with the first


class DiagnosticWarning(UserWarning):
    """A reason to doubt a fit."""


def gain_of_last(losses: Sequence[float]) -> float:
    """Part of its loss that a descent gained over its last iterations, by the means of ten and of the ten before."""
    half = _WINDOW // 2
    if len(losses) < 2 * half:
        return 0.0
    recent_sum, earlier_sum = sum(losses[-half:]), sum(losses[-2 * half : -half])
    return 1 - recent_sum / earlier_sum if earlier_sum > 0 else 0.0


def warn_of(result: Result) -> None:
    """Warn of reasons to doubt a result."""
    problem, verdict = result.problem, result.verdict
    is_doubted = _warn_of_unseen(verdict.unseen)
    is_doubted |= _warn_of_exposures(verdict)
    gain = gain_of_last(result.losses[-1])
    is_falling = result.reason == "finished" and gain > MAX_LAST_GAIN
    if is_falling and problem.light is not None:
        is_doubted = True
        is_alone = all(free.is_light for free in problem.free)
        solving = 'stages = "photograph", which solves for the light'
        check.warn(
            f"light has not converged: the loss still fell by {gain:.1%} over the last {_WINDOW // 2} iterations; "
            f"give the last stage more iterations, or {'a learning_rate of 0.2' if is_alone else solving}",
            DiagnosticWarning,
        )
    if verdict.image_error is not None and not is_doubted:
        _warn_of_error(verdict, is_falling)


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


def _warn_of_unseen(unseen: float) -> bool:
    """Warn of pixels without a body; return whether there are."""
    if MAX_UNSEEN_SHARE < unseen < 1:  # of cameras that see nothing images warn
        check.warn(
            f"{unseen:.0%} of the counted pixels see no body, and are explained as black; mask them out, or make the "
            "ground larger",
            DiagnosticWarning,
        )
    return unseen > MAX_UNSEEN_SHARE


def _warn_of_exposures(verdict: Verdict) -> bool:
    """Warn of targets of other exposures than the images; return whether there are."""
    for view, stops in verdict.exposure_gaps.items():
        check.warn(
            f"targets[{view}] is {2**stops:.3g} times as bright as the fitted image, which is most of the residual, "
            "and may have led poses and colors astray: set exposure = true in [free], inverse.Exposure(), or the "
            f"target's exposure = {stops:+.2f} [stops]",
            DiagnosticWarning,
        )
    return bool(verdict.exposure_gaps)


def _warn_of_error(verdict: Verdict, is_falling: bool) -> None:
    if not verdict.is_explained:
        reason = "light, reflectance, shapes or the camera may not be those of the targets"
        if verdict.shown:
            reason = (
                'a pose may be in another minimum: stages = "unknown-pose" searches all, and stands_on = "…", if it is '
                f"not set, leaves fewer; or {reason}"
            )
        if is_falling:
            reason = "the loss was still falling: give the last stage more iterations"
        check.warn(f"the fit explains the targets poorly: {verdict}; {reason}", DiagnosticWarning)
