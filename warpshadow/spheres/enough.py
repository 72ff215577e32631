"""Number of spheres that a body needs, from short fits of a few counts."""

from collections.abc import Callable, Sequence

import numpy as np

from warpshadow.spheres.cover import greedy_cover
from warpshadow.spheres.normalized_mesh import NormalizedMesh
from warpshadow.spheres.receivers import FitReceivers
from warpshadow.spheres.refine import Refinement

AUTO = "auto"

TRIED_COUNTS = (8, 32, 128, 512)
MAX_SPHERES = 2 * TRIED_COUNTS[-1]

_STEPS, _STEPS_MORE = 40, 1 / 8  # of a short fit, and how many more a sphere: 512 of a table need more than 256
_TEST_RECEIVERS = 1024
_MAX_ERROR = 0.04  # of a short fit: relative to the light at receivers on grounds and in the air around
_MIN_ERROR_RATIO = 0.72  # of errors of a count and of a fourth of it, above which more are not worth it: 15% a doubling

RAGGED_ERROR = 0.2
"""Error relative to the missing light above which a shadow has holes: of 32 spheres of a box 0.19, of a bowl 0.32."""


def enough_spheres(
    mesh: NormalizedMesh,
    receivers: FitReceivers,
    seed: int,
    cached_errors: Sequence[Sequence[float]] = (),
    store_errors: Callable[[list[Sequence[float]]], None] = lambda errors: None,
) -> int:
    """Find the number of spheres that a body needs, a power of two from 8 to 1024.

    The error of short fits of 8, 32, 128 and 512 spheres falls with their number. Taken is where it is small enough, or
    where it falls no longer and the shadow is whole.

    Args:
        cached_errors: Errors of the first short fits, where an interrupted call found them.
        store_errors: Gets the known fits, after each short fit.
    """
    judges = FitReceivers(mesh, _TEST_RECEIVERS, np.random.default_rng(seed + 1), sharpness=0.0)
    previous_error = np.inf, np.inf
    errors = list(cached_errors)
    for number, count in enumerate(TRIED_COUNTS):
        if number == len(errors):
            rng = np.random.default_rng(seed)
            start = greedy_cover(mesh, count, rng)
            *_, last = Refinement(mesh, receivers, rng).run(start, _STEPS + int(_STEPS_MORE * count))
            errors.append(_errors(Refinement(mesh, judges, rng), last.spheres))
            store_errors(errors)
        error, shadow_error = errors[number]
        if error <= _MAX_ERROR:
            return _find_count(count, previous_error[0], error)
        stalls = error > _MIN_ERROR_RATIO * previous_error[0]
        if stalls and previous_error[1] <= RAGGED_ERROR:
            return count // 2
        previous_error = error, shadow_error
    return TRIED_COUNTS[-1] if stalls and previous_error[1] <= RAGGED_ERROR else MAX_SPHERES


def _errors(judge: Refinement, spheres: np.ndarray) -> tuple[float, float]:
    """Error at receivers that are not on the mesh, relative to the light there and to the light that is missing."""
    judges = judge.receivers
    off_surface = judges.off_surface
    visibility = judges.visibility[off_surface]
    total_error = judge.transmittance(spheres, off_surface, judge.WIDTHS[1]) - visibility
    parts = [
        np.sum(judges.weights[off_surface] * (part @ judges.metric) * part)
        for part in (total_error, visibility, 1 - visibility)
    ]
    total_error, lit_error, missing = np.sqrt(parts)
    return float(total_error / max(lit_error, 1e-9)), float(total_error / max(missing, 1e-9))


def _find_count(count: int, previous_error: float, error: float) -> int:
    """Estimate the count, from a quarter of ``count`` on, at which the error is small enough: it falls with a power."""
    if count == TRIED_COUNTS[0]:
        return count
    part = np.log(previous_error / _MAX_ERROR) / max(np.log(previous_error / error), 1e-6)
    return count // 4 * 2 ** int(np.clip(np.ceil(2 * part - 0.25), 1, 2))
