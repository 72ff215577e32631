"""Prefiltered light: a map blurred by Gaussians of rising width, and its lookup.

Level 0 is the map; level k ≥ 1 has a Gaussian of σ = 2^(k−1) π / rows around each direction, and texels as wide as σ.
Between levels log σ interpolates, between texels their positions do. Levels stand one after another, each a latitude
by longitude grid as :class:`warpshadow.EnvironmentMap` has it. It is linear in the map.
"""

import functools

import numpy as np
import warp as wp

from warpshadow import check
from warpshadow.device.batch import common_batch, instance_in
from warpshadow.device.constants import constant
from warpshadow.device.launch import launch
from warpshadow.device.parallel import split_row
from warpshadow.maths import sh

MAX_ROWS = 128  # most rows of level 0

_MIN_ROWS = 16
_LEVELS = 7

_COST = 60.0  # nanoseconds that a lookup takes

wp.set_module_options({"max_unroll": 1})


def level_rows(rows: int) -> list[int]:
    """Rows of each level of a map of a number of rows."""
    return [rows] + [max(rows >> level, _MIN_ROWS) for level in range(_LEVELS - 1)]


def resize_rows(radiance: np.ndarray, rows: int) -> np.ndarray:
    """A map [height, width, channel] as [rows, 2 rows, channel]: means by area, or repeated pixels."""
    height = len(radiance)
    bounds = np.arange(rows + 1) * height / rows
    cosines = np.cos(np.pi * np.arange(height + 1) / height)

    def integrals(values: np.ndarray, edges: np.ndarray, sizes: np.ndarray) -> np.ndarray:
        """Integrals of a piecewise constant function between edges, over the first axis."""
        cumulative = np.concatenate([np.zeros_like(values[:1]), np.cumsum(values * sizes[:, None, None], axis=0)])
        indices = np.minimum(edges.astype(int), len(values) - 1)
        return np.diff(
            cumulative[indices] + (edges - indices)[:, None, None] * (values * sizes[:, None, None])[indices], axis=0
        )

    sizes = -np.diff(cosines)
    ones = np.ones((height, 1, 1))
    row_means = integrals(radiance.astype(np.float64), bounds, sizes) / integrals(ones, bounds, sizes)
    columns = np.arange(2 * rows + 1) * height / rows
    resized = integrals(row_means.swapaxes(0, 1), columns, np.ones(2 * height)) * (rows / height)
    return resized.swapaxes(0, 1)


@functools.cache
def _blur_spectra(rows: int, sigma: float) -> np.ndarray:
    """Spectra of a Gaussian blur from row to row, over longitude: [row, row of the source, frequency]."""
    polar = np.pi * (np.arange(rows) + 0.5) / rows
    longitudes = np.pi * np.arange(2 * rows) / rows
    solid_angles = sh.pixel_solid_angles(rows)
    spectra = np.empty((rows, rows, rows + 1))
    for row in range(rows):
        cosine = np.cos(polar[row]) * np.cos(polar)[:, None] + np.outer(
            np.sin(polar[row]) * np.sin(polar), np.cos(longitudes)
        )
        weights = np.exp((cosine - 1) / sigma**2) * solid_angles[:, None]
        spectra[row] = np.fft.rfft(weights / weights.sum(), axis=1).real  # it is even
    return spectra


def prefilter(radiance: np.ndarray) -> np.ndarray:
    """Blur a map.

    Args:
        radiance: Shape [height, 2·height, channel], of any number of channels.

    Returns:
        Texels of all levels, one level and row after another, float32 of shape [texel, channel].
    """
    rows = min(max(1 << (len(radiance) - 1).bit_length(), 64), MAX_ROWS)
    levels = [resize_rows(radiance, rows)]
    for level, count in enumerate(level_rows(rows)[1:]):
        spectrum = np.fft.rfft(resize_rows(levels[0], count), axis=1)
        # texels are means, and interpolated: that blurs by a twelfth and a sixth of their square
        sigma = float(np.sqrt((2**level / rows) ** 2 - 0.25 / count**2) * np.pi)
        blurred_texels = np.einsum("rsf,sfc->rfc", _blur_spectra(count, sigma), spectrum, optimize=True)
        levels.append(np.fft.irfft(blurred_texels, 2 * count, axis=1))
    channels = radiance.shape[2]
    return np.concatenate([level.reshape(-1, channels) for level in levels]).astype(np.float32)


def _level_offsets(texel_count: int) -> np.ndarray:
    """First texel and rows of each level, [level, 2], by the number of all texels."""
    choices = (np.array(level_rows(rows)) for rows in (64, MAX_ROWS))
    rows = next(counts for counts in choices if (2 * counts**2).sum() == texel_count)
    return np.stack([np.cumsum(2 * rows**2) - 2 * rows**2, rows], axis=1)


@wp.func
def _interpolate_level(texels: wp.array(dtype=wp.vec3), first: int, rows: int, polar: float, azimuth: float):
    """Interpolate a level at a direction; rows end at the poles, columns go around."""
    row = wp.clamp(polar * float(rows) - 0.5, 0.0, float(rows) - 1.0)
    column = azimuth * float(2 * rows) - 0.5
    upper = wp.min(int(row), rows - 2)
    left_column = int(wp.floor(column))
    lower_share = row - float(upper)
    right_share = column - float(left_column)
    next_column = wp.where(left_column + 1 >= 2 * rows, 0, left_column + 1)
    left_column = wp.where(left_column < 0, left_column + 2 * rows, left_column)
    upper_row = first + upper * 2 * rows
    lower_row = upper_row + 2 * rows
    return (1.0 - lower_share) * (
        (1.0 - right_share) * texels[upper_row + left_column] + right_share * texels[upper_row + next_column]
    ) + lower_share * (
        (1.0 - right_share) * texels[lower_row + left_column] + right_share * texels[lower_row + next_column]
    )


@wp.kernel
def _interpolate_levels(
    first_row: int,
    worker: int,
    # in
    texels: wp.array2d(dtype=wp.vec3),
    levels: wp.array(dtype=wp.vec2i),
    directions: wp.array3d(dtype=wp.vec3),
    filters: wp.array3d(dtype=wp.vec3),
    # out
    light: wp.array3d(dtype=wp.vec3),
):
    """A thread owns a receiver."""
    batch, receiver = split_row(first_row + wp.tid(), light.shape[1])
    light_texels = texels[instance_in(batch, texels.shape[0])]
    direction_batch = instance_in(batch, directions.shape[0])
    for i in range(light.shape[2]):
        direction = directions[direction_batch, receiver, i]
        polar = wp.acos(wp.clamp(direction[1], -0.999999, 0.999999)) / wp.pi
        azimuth = wp.atan2(direction[0], -direction[2]) / (2.0 * wp.pi)
        azimuth = azimuth - wp.floor(azimuth)
        # half a texel of the map itself is between levels 0 and 1
        blur = wp.max(filters[direction_batch, receiver, i][2] * float(levels[0][1]) / wp.pi, 0.5)
        height = wp.clamp(wp.log2(blur) + 1.0, 0.0, float(_LEVELS) - 1.001)
        level = int(height)
        a = _interpolate_level(light_texels, levels[level][0], levels[level][1], polar, azimuth)
        b = _interpolate_level(light_texels, levels[level + 1][0], levels[level + 1][1], polar, azimuth)
        light[batch, receiver, i] = a + (height - float(level)) * (b - a)


def look_up_light(texels: wp.array, directions: wp.array, filters: wp.array) -> wp.array:
    """Look up light from the directions of lobes.

    Args:
        texels: Of :func:`prefilter`, linear RGB, vec3 of shape [batch, texel].
        directions, filters: Of :func:`.lobes.sample_lobes`, [batch, receiver, sample].

    Returns:
        Radiance, vec3 of shape [batch, receiver, sample].

    Differentiable: texels, directions, filters.
    """
    check.shape("filters", filters.shape, directions.shape)
    count = common_batch({"texels": texels, "directions": directions})
    light = wp.empty((count, *directions.shape[1:]), dtype=wp.vec3, device=directions.device)
    levels = constant(_level_offsets(texels.shape[1]), wp.vec2i, directions.device)
    launch(
        _interpolate_levels,
        count * directions.shape[1],
        inputs=[texels, levels, directions, filters],
        outputs=[light],
        shared=[texels, directions, filters],
        cost=_COST * directions.shape[2],
    )
    return light
