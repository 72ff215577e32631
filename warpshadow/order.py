"""Compact order: what is near in space is near in memory, so that kernels can look at several things at once."""

import numpy as np


def compact_order(points: np.ndarray, *, runs: tuple[int, ...] = (16, 4)) -> np.ndarray:
    """Order points by recursive bisection along their longest extent.

    Args:
        points: Shape [point, 3].
        runs: Lengths of the runs that are to be compact, each a multiple of the next.

    Returns:
        Indices [point]: as they follow each other, the points of every run are near each other; the last run of a
        length may be short.
    """
    count = len(points)
    unit = next((run for run in runs if run < count), None)
    if unit is None:
        return np.arange(count)
    _, axes = np.linalg.eigh(np.cov(points.T))
    along = np.argsort(points @ axes[:, -1], kind="stable")
    middle = -(-count // unit) // 2 * unit
    halves = along[:middle], along[middle:]
    return np.concatenate([half[compact_order(points[half], runs=runs)] for half in halves])
