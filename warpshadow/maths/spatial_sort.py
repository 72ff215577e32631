"""Spatial sorting: points near in space are near in memory, so that kernels can process several at once."""

import numpy as np


def compact_order(points: np.ndarray, *, runs: tuple[int, ...] = (16, 4)) -> np.ndarray:
    """Order points by recursive bisection along their longest extent.

    Args:
        points: Shape [point, 3].
        runs: Lengths of compact runs, each a multiple of the next.
    Returns:
        Permutation [point] in which the points of every run are near each other; the last run may be short.
    """
    count = len(points)
    unit = next((run for run in runs if run < count), None)
    if unit is None:
        return np.arange(count)
    _, axes = np.linalg.eigh(np.cov(points.T))
    axis_order = np.argsort(points @ axes[:, -1], kind="stable")
    split = -(-count // unit) // 2 * unit
    halves = axis_order[:split], axis_order[split:]
    return np.concatenate([half[compact_order(points[half], runs=runs)] for half in halves])


def z_order(points: np.ndarray) -> np.ndarray:
    """Order points along a Z-order curve: much faster than :func:`compact_order`, but less compact.

    Args:
        points: Shape [point, 3].
    Returns:
        Permutation [point].
    """
    if not len(points):
        return np.arange(0)
    low, high = points.min(axis=0), points.max(axis=0)
    size = np.maximum((high - low).max(), np.finfo(np.float32).tiny)
    return z_order_of_cells((points - low) * ((2**21 - 1) / size))


def z_order_of_cells(cells: np.ndarray) -> np.ndarray:
    """Order cells [cell, axis] of a grid, indices from 0 to 2²¹ − 1, by their interleaved bits (Morton 1966)."""
    codes = sum(_spread(cells[:, axis].astype(np.uint64)) << np.uint64(axis) for axis in range(cells.shape[1]))
    return np.argsort(codes, kind="stable")


def _spread(integers: np.ndarray) -> np.ndarray:
    """Insert two zeros between the bits of numbers of 21 bits."""
    for shift, mask in (
        (32, 0x1F00000000FFFF),
        (16, 0x1F0000FF0000FF),
        (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3),
        (2, 0x1249249249249249),
    ):
        integers = (integers | (integers << np.uint64(shift))) & np.uint64(mask)
    return integers
