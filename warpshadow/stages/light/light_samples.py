"""Samples of light: directions drawn in proportion to the radiance of a map."""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
import warp as wp

from warpshadow.maths import sh
from warpshadow.maths.directions import BUNDLE, CHUNK, fibonacci
from warpshadow.maths.spatial_sort import compact_order

SET_COUNT = 16
"""Independent sets of directions; neighboring receivers take different ones, so that error is noise, not bands."""

_UNIFORM_SHARE = 0.1  # of the samples of a map: light too dim to be drawn still is

_BRIGHTNESS = 30.0  # radiance, in means of the map, from which shared directions are aimed at a pixel …
_BRIGHT_SHARE = 0.35  # … and such pixels get so much of them at most
_UNSEEN_SHARE = 0.3  # of the importance of light, which stays where receivers do not see it
_MIN_ROWS, _MAX_ROWS = 64, 512  # of a map that is cut


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
    plastic_number = 1.32471795724474602596
    shifts = np.random.default_rng(seed).random((SET_COUNT, 1, 2))
    points = (shifts + np.arange(1, count + 1)[:, None] / np.array([plastic_number, plastic_number**2])) % 1
    rows, v = _invert_distribution(np.cumsum(probability.sum(axis=1)), points[..., 0])
    conditional = np.cumsum(probability, axis=1)
    conditional /= conditional[:, -1:]
    flat_indices, u = _invert_distribution((conditional + np.arange(height)[:, None]).ravel(), points[..., 1] + rows)
    columns = flat_indices - rows * width
    drawn_radiance = radiance[rows, columns] * (solid_angle / (count * probability))[rows, columns, None]
    return LightSamples(_map_directions(rows, v, columns + u, height), drawn_radiance)


def _invert_distribution(distribution: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Interval of a rising distribution function for each value, and the value's position in it, 0 to 1."""
    interval = np.minimum(np.searchsorted(distribution, values, side="right"), len(distribution) - 1)
    interval_start = np.where(interval > 0, distribution[interval - 1], 0.0)
    return interval, np.clip(
        (values - interval_start) / np.maximum(distribution[interval] - interval_start, 1e-300), 0, 1
    )


def _map_directions(rows: np.ndarray, v: np.ndarray, columns: np.ndarray, height: int) -> np.ndarray:
    """Directions of positions in an equirectangular map, even in solid angle over the share v, 0 to 1, of a row."""
    cosine = (1 - v) * np.cos(np.pi * rows / height) + v * np.cos(np.pi * (rows + 1) / height)
    sine, phi = np.sqrt(np.maximum(1 - cosine**2, 0)), np.pi * columns / height
    return np.stack([np.sin(phi) * sine, cosine, -np.cos(phi) * sine], axis=-1)


def cut_map(
    radiance: np.ndarray, count: int, find_light_shares: Callable[[LightSamples], np.ndarray] | None = None
) -> LightSamples:
    """Cut an equirectangular map into rectangles of about the same importance, and take a direction of each.

    This is the median cut of Debevec [2005, "A median cut algorithm for light probe sampling"], for any count, through
    pixels where they are large. A direction is the mean of its rectangle's light, and stands for all of it. Receivers
    that see all of the rectangle get exactly its light, for any normal. Receivers on whose horizon it lies see a part
    of it and get too little; therefore the first cut is along the horizon of level ground.

    Importance is luminance, to which even light adds a tenth. Bright pixels, with
    :data:`_BRIGHTNESS` means of the map, such as those of a sun or a window, have :data:`_BRIGHT_SHARE` of it at most:
    their many directions would be close to each other.

    Args:
        radiance: Linear RGB, shape [height, 2·height, 3]; negative lobes of a band-limited map are welcome.
        count: Number of directions, a multiple of 16; runs of 16 and of 4 are close to each other.
        find_light_shares: Finds, given directions, the share of receivers' light from each, shape [direction].
            Where given, importance, but for bright pixels', goes to directions that receivers see, in a second cut: to
            a room's window.
    """
    radiance = _resize_map(np.asarray(radiance, np.float64))
    height, width, _ = radiance.shape
    solid_angle = np.repeat(sh.pixel_solid_angles(height)[:, None], width, axis=1)
    brightness = np.abs(radiance).mean(axis=2)
    power = brightness * solid_angle
    importance = _UNIFORM_SHARE * solid_angle / (4 * np.pi)
    total_power = power.sum()
    is_bright = brightness > _BRIGHTNESS * total_power / (4 * np.pi)
    if brightness.any():
        power /= total_power
        bright_share = power[is_bright].sum()
        power[is_bright] *= min(_BRIGHT_SHARE / max(bright_share, _BRIGHT_SHARE), 1.0)
        importance += (1 - _UNIFORM_SHARE) * power / power.sum()

    def cut_halves(importance: np.ndarray) -> np.ndarray:
        table = np.zeros((height + 1, width + 1))
        table[1:, 1:] = importance.cumsum(axis=0).cumsum(axis=1)
        horizon, all_columns = height / 2, np.array([0.0, width])
        upper_count = np.clip(round(count * _interpolate_axis(table, horizon)[-1] / table[-1, -1]), 1, count - 1)
        upper_cuts = _cut_rectangle(table, np.array([0.0, horizon]), all_columns, upper_count)
        lower_cuts = _cut_rectangle(table, np.array([horizon, height]), all_columns, count - upper_count)
        return np.array([*upper_cuts, *lower_cuts])

    cuts = cut_halves(importance)
    samples = _mean_samples(radiance, solid_angle, cuts)
    if find_light_shares is not None:
        visible_importance = importance.copy()
        pixels = cuts.round().astype(int).reshape(-1, 4).tolist()
        for (top, bottom, left, right), light_share in zip(pixels, find_light_shares(samples), strict=True):
            visible_importance[top:bottom, left:right] *= _UNSEEN_SHARE + (1 - _UNSEEN_SHARE) * count * light_share
        visible_importance *= importance[~is_bright].sum() / max(visible_importance[~is_bright].sum(), 1e-300)
        samples = _mean_samples(radiance, solid_angle, cut_halves(np.where(is_bright, importance, visible_importance)))
    permutation = compact_order(samples.directions[0], runs=(CHUNK, BUNDLE))
    return LightSamples(samples.directions[:, permutation], samples.radiance[:, permutation])


def _resize_map(radiance: np.ndarray) -> np.ndarray:
    """Resize a map to :data:`_MIN_ROWS` rows or more by repeating pixels, and from many rows by averaging them."""
    height = len(radiance)
    if height < _MIN_ROWS:
        repeat_count = -(-_MIN_ROWS // height)
        return radiance.repeat(repeat_count, axis=0).repeat(repeat_count, axis=1)
    pixel_step = height // _MAX_ROWS
    if pixel_step < 2:
        return radiance
    rows = height // pixel_step
    weights = sh.pixel_solid_angles(height)[:, None, None]
    starts = np.arange(rows) * height // rows, np.arange(2 * rows) * height // rows
    sums = np.add.reduceat(np.add.reduceat(radiance * weights, starts[0], axis=0), starts[1], axis=1)
    # pixels of the smaller map are as high as the larger one's by a row of these at most
    return sums / (sh.pixel_solid_angles(rows)[:, None, None])


def _cut_rectangle(
    table: np.ndarray, rows: np.ndarray, columns: np.ndarray, count: int
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Cut a rectangle of a map, between two places along each axis, into rectangles of equal importance.

    Args:
        table: Importance of all above and left of each corner of pixels, [height + 1, width + 1].
        rows, columns: Where it begins and ends.
    """
    if count == 1:
        yield rows, columns
        return
    row_angle = np.pi / (len(table) - 1)
    middle_row = np.clip((len(table) - 1) / 2, *rows)
    is_tall = np.ptp(rows) > np.ptp(columns) * np.sin(row_angle * middle_row)
    cut_axis_ends, cut_axis_table, rectangle_ends = (rows, table, columns) if is_tall else (columns, table.T, rows)
    lower_sums, upper_sums = (_interpolate_axis(cut_axis_table.T, end) for end in rectangle_ends)
    sums = upper_sums - lower_sums
    first_sum, last_sum = _interpolate_axis(sums, cut_axis_ends[0]), _interpolate_axis(sums, cut_axis_ends[1])
    half_count = count // 2
    cut_sum = first_sum + (last_sum - first_sum) * half_count / count
    position = float(np.interp(cut_sum, sums, np.arange(len(sums)))) if last_sum > first_sum else np.nan
    if not cut_axis_ends[0] < position < cut_axis_ends[1]:
        position = cut_axis_ends[0] + (cut_axis_ends[1] - cut_axis_ends[0]) * half_count / count
    for rows_or_columns, rectangle_count in (
        (np.array([cut_axis_ends[0], position]), half_count),
        (np.array([position, cut_axis_ends[1]]), count - half_count),
    ):
        yield from _cut_rectangle(
            table, *((rows_or_columns, columns) if is_tall else (rows, rows_or_columns)), rectangle_count
        )


def _interpolate_axis(values: np.ndarray, position: float) -> np.ndarray:
    """Interpolate values along the first axis at a fractional index."""
    item = min(int(position), len(values) - 2)
    return values[item] + (position - item) * (values[item + 1] - values[item])


def _mean_samples(radiance: np.ndarray, solid_angle: np.ndarray, cuts: np.ndarray) -> LightSamples:
    """The mean direction of the light of each rectangle of a map, and its light in that direction, ∫ L d·ω dω.

    Args:
        radiance, solid_angle: Of the pixels, [row, column, 3] and [row, column].
        cuts: Where the rows and the columns of each rectangle begin and end, [rectangle, 2, 2].
    """
    (first_row, first_column), rectangle_ends = np.floor(cuts[..., 0]).T.astype(int), np.ceil(cuts[..., 1]).astype(int)
    row_counts, column_counts = (rectangle_ends - np.floor(cuts[..., 0]).astype(int)).T
    starts = np.cumsum(row_counts * column_counts) - row_counts * column_counts
    rectangle = np.repeat(np.arange(len(cuts)), row_counts * column_counts)
    position = np.arange(len(rectangle)) - starts[rectangle]
    row, column = (
        first_row[rectangle] + position // column_counts[rectangle],
        first_column[rectangle] + position % column_counts[rectangle],
    )
    # the parts of pixels in rectangles
    lower_bounds = np.maximum(cuts[rectangle, :, 0], np.stack([row, column], axis=-1))
    upper_bounds = np.minimum(cuts[rectangle, :, 1], np.stack([row + 1, column + 1], axis=-1))
    centers = (lower_bounds + upper_bounds) / 2
    directions = _map_directions(row, centers[:, 0] - row, centers[:, 1], len(radiance))
    weights = (upper_bounds - lower_bounds).prod(axis=1) * solid_angle[row, column]
    light = radiance[row, column] * weights[:, None]
    moments = np.add.reduceat(directions[:, :, None] * light[:, None, :], starts)
    brightness = np.abs(light).mean(axis=1)
    is_dark = np.add.reduceat(brightness, starts) == 0
    brightness = np.where(is_dark[rectangle], weights, brightness)
    mean_directions = np.add.reduceat(directions * brightness[:, None], starts)
    mean_directions /= np.maximum(np.linalg.norm(mean_directions, axis=1, keepdims=True), 1e-300)
    return LightSamples(mean_directions[None], np.einsum("rk,rkc->rc", mean_directions, moments)[None])


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
    """
    return CellSamples(
        wp.array(samples.directions, dtype=wp.vec3, device=device),
        wp.array(_nearest_cells(samples.directions, directions), device=device),
        wp.array(samples.radiance.astype(np.float32), device=device),
        len(directions),
    )


def even_samples(count: int, directions: np.ndarray) -> LightSamples:
    """Directions that are even over the sphere, and the middles of cells without one, for light of 1 in one channel.

    Each cell gets its part of the light, 4π/Q, by however many samples fall into it: a cell's light on an open ground
    is 2.4% off (1024 samples in 128 cells), with equal weights 13%.

    Args:
        count: Number of samples that are even.
        directions: Of the cells, unit vectors of shape [direction, 3].
    """
    even_directions = fibonacci(-(-count // CHUNK) * CHUNK)
    is_empty = np.bincount(_nearest_cells(even_directions, directions), minlength=len(directions)) == 0
    samples = np.concatenate([even_directions, directions[is_empty]])
    cells = _nearest_cells(samples, directions)
    weights = 4 * np.pi / len(directions) / np.bincount(cells)
    return LightSamples(samples[None], weights[cells][None, :, None])


def _nearest_cells(samples: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Cell that each sample belongs to, int32."""
    cells = np.argmax(samples.astype(np.float32) @ directions.T.astype(np.float32), axis=-1)
    return cells.astype(np.int32)
