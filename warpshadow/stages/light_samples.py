"""Samples of light: directions drawn in proportion to the radiance of a map."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import warp as wp

from warpshadow.maths import sh
from warpshadow.maths.directions import CHUNK, fibonacci

SET_COUNT = 16
"""Independent sets of directions; neighboring receivers take different ones, so that error is noise, not bands."""

_UNIFORM_SHARE = 0.1  # of the samples of a map: light too dim to be drawn still is


class LightSamples(NamedTuple):
    """Directions drawn from light, in sets that are stratified each by itself.

    Args:
        directions: Unit vectors, shape [set, sample, 3].
        radiance: Radiance over (probability density · number of samples), shape [set, sample, 3].
    """

    directions: np.ndarray
    radiance: np.ndarray


def sample_map(radiance: np.ndarray, count: int, *, seed: int = 0) -> LightSamples:
    """Draw directions from an equirectangular map, about in proportion to luminance.

    Args:
        radiance: Linear RGB, shape [height, 2·height, 3]; negative lobes of a band-limited map are welcome.
        count: Number of directions of each set.
        seed: Of the shifts that make the sets differ.
    """
    height, width, _ = radiance.shape
    solid_angle = np.repeat(sh.pixel_solid_angles(height)[:, None], width, axis=1)
    brightness = np.abs(radiance).mean(axis=2) * solid_angle
    probability = _UNIFORM_SHARE * solid_angle / (4 * np.pi)
    if brightness.any():
        probability += (1 - _UNIFORM_SHARE) * brightness / brightness.sum()
    probability /= probability.sum()

    # a low-discrepancy sequence (Roberts' R2), shifted for each set, through the inverse of the distribution function
    ratio = 1.32471795724474602596
    shifts = np.random.default_rng(seed).random((SET_COUNT, 1, 2))
    points = (shifts + np.arange(1, count + 1)[:, None] / np.array([ratio, ratio**2])) % 1
    rows, v = _invert(np.cumsum(probability.sum(axis=1)), points[..., 0])
    conditional = np.cumsum(probability, axis=1)
    conditional /= conditional[:, -1:]
    flat, u = _invert((conditional + np.arange(height)[:, None]).ravel(), points[..., 1] + rows)
    columns = flat - rows * width
    drawn = radiance[rows, columns] * (solid_angle / (count * probability))[rows, columns, None]
    return LightSamples(_map_directions(rows, v, columns + u, height), drawn)


def _invert(distribution: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Interval of a rising distribution function that each value falls into, and where in it, from 0 to 1."""
    index = np.minimum(np.searchsorted(distribution, values, side="right"), len(distribution) - 1)
    start = np.where(index > 0, distribution[index - 1], 0.0)
    return index, np.clip((values - start) / np.maximum(distribution[index] - start, 1e-300), 0, 1)


def _map_directions(rows: np.ndarray, v: np.ndarray, columns: np.ndarray, height: int) -> np.ndarray:
    """Directions of positions in an equirectangular map, even in solid angle over the share v, 0 to 1, of a row."""
    cosine = (1 - v) * np.cos(np.pi * rows / height) + v * np.cos(np.pi * (rows + 1) / height)
    sine, phi = np.sqrt(np.maximum(1 - cosine**2, 0)), np.pi * columns / height
    return np.stack([np.sin(phi) * sine, cosine, -np.cos(phi) * sine], axis=-1)


class CellSamples(NamedTuple):
    """Directions drawn from light on a device, and the cells that they belong to.

    Args:
        directions: Unit vectors, vec3 of shape [set, sample].
        cells: Nearest cell of each, int32 of shape [set, sample].
        radiance: Radiance over (probability density · number of samples), float32 of shape [set, sample, channel].
        cell_count: Number of cells.
    """

    directions: wp.array
    cells: wp.array
    radiance: wp.array
    cell_count: int


def cell_samples(samples: LightSamples, directions: np.ndarray, *, device: wp.DeviceLike = None) -> CellSamples:
    """Find the cell of each sample.

    Args:
        samples: Directions drawn from light, whose radiance may have any number of channels.
        directions: Of the cells, unit vectors of shape [direction, 3].
        device: Where they are wanted.
    """
    return CellSamples(
        wp.array(samples.directions, dtype=wp.vec3, device=device),
        wp.array(_nearest(samples.directions, directions), device=device),
        wp.array(samples.radiance.astype(np.float32), device=device),
        len(directions),
    )


def even_samples(count: int, directions: np.ndarray) -> LightSamples:
    """Directions that are even over the sphere, and the middles of cells without one, for light of 1 in one channel.

    Each cell gets its part of the light, 4π/Q, by however many samples fall into it. Measured with 1024 samples of 128
    cells: what an open ground gets of a cell is off by 2.4% (rms), and by 13% if all samples weigh the same.

    Args:
        count: Number of samples that are even.
        directions: Of the cells, unit vectors of shape [direction, 3].
    """
    even = fibonacci(-(-count // CHUNK) * CHUNK)
    is_empty = np.bincount(_nearest(even, directions), minlength=len(directions)) == 0
    samples = np.concatenate([even, directions[is_empty]])
    cells = _nearest(samples, directions)
    weights = 4 * np.pi / len(directions) / np.bincount(cells)
    return LightSamples(samples[None], weights[cells][None, :, None])


def _nearest(samples: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Cell that each sample belongs to, int32."""
    cells = np.argmax(samples.astype(np.float32) @ directions.T.astype(np.float32), axis=-1)
    return cells.astype(np.int32)
