"""Quadtree: receivers at the corners of squares of the image, which are small where light changes quickly.

On a body that lies in a plane light changes slowly over the image, but for the edges of shadows. Its receivers are the
fragments at the corners of squares of 4 × 4 pixels; a square is cut into four where the light that samples interpolate
differs from their own (Ward's irradiance caching, in the image). *Probes* tell that: every second pixel, or in small
images every one, whose light the caller estimates. In a square of corners a b / c d samples interpolate linearly in the
triangles a b c and d c b.

A square is *accepted* if its corners see one side of one body, and samples within it would be off by less than the
tolerance. Samples that see another side, or are in no accepted square, are receivers themselves. (In squares of a pixel
instead, the ground of a barn would be 26% off, not 12%.)
"""

import functools
from typing import NamedTuple

import numpy as np
import warp as wp

from warpshadow.device.constants import constant
from warpshadow.device.launch import launch
from warpshadow.device.memory import empty, reshaped, zeros
from warpshadow.device.parallel import split_row
from warpshadow.stages.receivers.numbering import number_items

MAX_SIDE = 4  # pixels of the side of the largest squares
_FINE_PIXELS = 2**14
"""Pixels of an image up to which each is a probe. Sun that falls through gaps is a pixel or two wide in small images:
with half as many probes a barn of planks is 28% off in 96² pixels, with these 12%, by pixel 9%."""

_SQUARE_COST = 50.0  # nanoseconds that one of the largest squares takes
TOLERANCE = 0.01
"""Error of interpolation at which a square is cut, as a part of the light where nothing blocks any. Pose gradients of a
bunny on a ground are 8.1 and 5.3% off (64², 128² pixels; eight poses), 8.4 and 5.9% with 0.02, whose receivers are up
to 3% fewer."""


class Quadtree(NamedTuple):
    """The accepted squares."""

    sizes: wp.array  # [view, row, column] int32, side of the square that a pixel is in [pixels], 0 for none
    numbers: wp.array  # [view, row, column] int32, number of the square, at its first pixel
    corners: wp.array  # [square, 4] int32, a b c d of each: view · samples + sample; −1 for none
    is_corner: wp.array  # [view, sample] bool
    square_key_of_side: wp.array  # [side] int32, the same for sides that share squares; −1 for sides that are in none


def probe_spacing(size: tuple[int, int], supersampling: int) -> int:
    """Pixels between the probes of an image, given its height and width [samples]."""
    return 1 if size[0] * size[1] <= _FINE_PIXELS * supersampling**2 else 2


@functools.lru_cache(maxsize=16)
def probe_grid(size: tuple[int, int], supersampling: int) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of the samples that are probes; the last may stand there several times.

    Args:
        size: Height and width of the image [samples].
    """
    spacing = probe_spacing(size, supersampling)
    counts = (MAX_SIDE // spacing * -(-length // (supersampling * MAX_SIDE)) + 1 for length in size)
    rows, columns = (
        np.minimum(spacing * supersampling * np.arange(count), length - 1)
        for count, length in zip(counts, size, strict=True)
    )
    return rows, columns


@wp.func
def sample_at(row: int, column: int, supersampling: int, height: int, width: int):
    """The sample at the upper left of a pixel; beyond the image's end the last."""
    return wp.min(row * supersampling, height - 1) * width + wp.min(column * supersampling, width - 1)


@wp.func
def _has_key(keys: wp.array2d(dtype=wp.int32), row: int, column: int, key: int):
    """Whether there is a probe in a row and column, and it has a key."""
    if row < 0 or column < 0 or row >= keys.shape[0] or column >= keys.shape[1]:
        return False
    return keys[row, column] == key


@wp.func
def _curvature_error(ratios: wp.array2d(dtype=float), keys: wp.array2d(dtype=wp.int32), row: int, column: int):
    """Error of linear interpolation over a distance of probes beside a probe: an eighth of the second difference."""
    key = keys[row, column]
    curvature_error = float(0.0)
    for axis in range(2):
        i = 1 - axis
        if _has_key(keys, row - i, column - axis, key) and _has_key(keys, row + i, column + axis, key):
            second_difference = (
                ratios[row - i, column - axis] - 2.0 * ratios[row, column] + ratios[row + i, column + axis]
            )
            curvature_error = wp.max(curvature_error, wp.abs(second_difference) / 8.0)
    return curvature_error


@wp.func
def _is_one_side(keys: wp.array2d(dtype=wp.int32), row: int, column: int, side: int):
    """Whether the corners of a square of probes see the same side."""
    key = keys[row, column]
    is_one = key >= 0 and keys[row, column + side] == key and keys[row + side, column] == key
    return is_one and keys[row + side, column + side] == key


@wp.func
def _probe_error(ratios: wp.array2d(dtype=float), keys: wp.array2d(dtype=wp.int32), row: int, column: int, side: int):
    """Error of interpolation between the corners of a square, at the probes in it that see the same."""
    a = ratios[row, column]
    b = ratios[row, column + side]
    c = ratios[row + side, column]
    d = ratios[row + side, column + side]
    probe_error = float(0.0)
    for i in range(side + 1):
        for j in range(side + 1):
            if keys[row + i, column + j] == keys[row, column]:
                down, right = float(i) / float(side), float(j) / float(side)
                interpolated_ratio = a + right * (b - a) + down * (c - a)
                if i + j > side:
                    interpolated_ratio = d + (1.0 - right) * (c - d) + (1.0 - down) * (b - d)
                probe_error = wp.max(probe_error, wp.abs(ratios[row + i, column + j] - interpolated_ratio))
    return probe_error


@wp.func
def _is_accepted_between_probes(
    ratios: wp.array2d(dtype=float), keys: wp.array2d(dtype=wp.int32), row: int, column: int, tolerance: float
):
    """Whether a square of neighboring probes is accepted: by the curvature of the light at these."""
    min_ratio = wp.min(ratios[row, column], ratios[row, column + 1])
    min_ratio = wp.min(min_ratio, wp.min(ratios[row + 1, column], ratios[row + 1, column + 1]))
    max_ratio = wp.max(ratios[row, column], ratios[row, column + 1])
    max_ratio = wp.max(max_ratio, wp.max(ratios[row + 1, column], ratios[row + 1, column + 1]))
    curvature_error = float(0.0)
    if max_ratio - min_ratio > tolerance:
        for corner in range(4):
            curvature_error = wp.max(
                curvature_error, _curvature_error(ratios, keys, row + corner // 2, column + corner % 2)
            )
    return curvature_error <= tolerance


@wp.kernel(enable_backward=False)
def _cut_squares(
    first_row: int,
    worker: int,
    # in
    probe_keys: wp.array3d(dtype=wp.int32),
    probe_ratios: wp.array3d(dtype=float),
    spacing: int,
    tolerance: float,
    # out
    sizes: wp.array3d(dtype=wp.int32),
    first_keys: wp.array3d(dtype=wp.int32),
):
    """A thread owns a row of the largest squares: pixels get the side of their accepted square, 0 for none.

    The first pixel of a square, its upper left, has a key, 0, others have −1.
    """
    side = 4 // spacing  # of the largest squares, in probes
    view, i = split_row(first_row + wp.tid(), probe_keys.shape[1] // side)
    view_keys = probe_keys[view]
    ratios = probe_ratios[view]
    for j in range(view_keys.shape[1] // side):
        row = side * i
        column = side * j
        is_accepted = _is_one_side(view_keys, row, column, side)
        is_accepted = is_accepted and _probe_error(ratios, view_keys, row, column, side) <= tolerance
        for quarter in range(4):
            size = int(4)
            top = row + quarter // 2 * (side // 2)
            left = column + quarter % 2 * (side // 2)
            if not is_accepted:
                size = 0
                if _is_one_side(view_keys, top, left, side // 2):
                    if spacing == 1 and _probe_error(ratios, view_keys, top, left, 2) <= tolerance:
                        size = 2
                    if spacing == 2 and _is_accepted_between_probes(ratios, view_keys, top, left, tolerance):
                        size = 2
            for pixel in range(4):
                y = spacing * top + pixel // 2
                x = spacing * left + pixel % 2
                if y < sizes.shape[1] and x < sizes.shape[2]:
                    sizes[view, y, x] = size
                    is_first = size > 0 and y % size == 0 and x % size == 0
                    first_keys[view, y, x] = wp.where(is_first, 0, -1)


@wp.kernel(enable_backward=False)
def _find_corners(
    # in
    first_pixels: wp.array2d(dtype=wp.int32),
    sizes: wp.array3d(dtype=wp.int32),
    height: int,
    width: int,
    supersampling: int,
    # out
    corners: wp.array2d(dtype=wp.int32),
    is_corner: wp.array2d(dtype=wp.bool),
):
    """A thread owns a square, −1 for none; ``is_corner`` is false before."""
    square = wp.tid()
    pixel = first_pixels[0, square]
    view, in_view = split_row(wp.max(pixel, 0), sizes.shape[1] * sizes.shape[2])
    row, column = split_row(in_view, sizes.shape[2])
    size = sizes[view, row, column]
    for k in range(4):
        corners[square, k] = -1
        if pixel >= 0:
            sample = sample_at(row + k // 2 * size, column + k % 2 * size, supersampling, height, width)
            corners[square, k] = view * height * width + sample
            is_corner[view, sample] = True


def find_quadtree(
    sides: wp.array, keys: wp.array, probe_ratios: wp.array, supersampling: int, *, tolerance: float = TOLERANCE
) -> Quadtree:
    """Find the squares in which samples interpolate.

    Args:
        sides: Side that each sample sees, −1 for none, int32 of shape [view, height, width].
        keys: A number for each side, equal for sides in one plane, −1 for sides without squares, int32 of shape [side].
        probe_ratios: Light at the samples of :func:`probe_grid`, over that where nothing blocks any, float32 of shape
            [view, row, column]; anything where they see no side that has squares.
        tolerance: Error of interpolation at which a square is cut, in the unit of the ratios.
    """
    device, (view_count, height, width) = sides.device, sides.shape
    shape = view_count, height // supersampling, width // supersampling
    sizes, first_keys = (empty(shape, dtype=wp.int32, device=device) for _ in range(2))
    probe_keys = keys_of_probes(sides, keys, supersampling)
    spacing = probe_spacing(sides.shape[1:], supersampling)
    side = MAX_SIDE // spacing
    launch(
        _cut_squares,
        view_count * (probe_keys.shape[1] // side),
        cost=_SQUARE_COST * (probe_keys.shape[2] // side),
        inputs=[probe_keys, probe_ratios, spacing, tolerance],
        outputs=[sizes, first_keys],
    )
    numbers, first_pixels, _, _ = number_items("squares", reshaped(first_keys, (1, -1)), 1)
    corners = empty((first_pixels.shape[1], 4), dtype=wp.int32, device=device)
    is_corner = zeros((view_count, height * width), wp.bool, device, outlives_recording=False)
    inputs = [first_pixels, sizes, height, width, supersampling]
    launch(_find_corners, len(corners), inputs=inputs, outputs=[corners, is_corner])
    return Quadtree(sizes, reshaped(numbers, shape), corners, is_corner, keys)


@wp.kernel(enable_backward=False)
def _find_keys(
    # in
    sides: wp.array3d(dtype=wp.int32),
    keys: wp.array(dtype=wp.int32),
    rows: wp.array(dtype=wp.int32),
    columns: wp.array(dtype=wp.int32),
    # out
    probe_keys: wp.array3d(dtype=wp.int32),
):
    """A thread owns a probe."""
    view, row, column = wp.tid()
    side = sides[view, rows[row], columns[column]]
    key = int(-1)
    if side >= 0:
        key = keys[side]
    probe_keys[view, row, column] = key


def keys_of_probes(sides: wp.array, keys: wp.array, supersampling: int) -> wp.array:
    """The keys of the sides that probes see, −1 for none, int32 of shape [view, row, column]."""
    row, column = probe_grid(sides.shape[1:], supersampling)
    probe_keys = empty((len(sides), len(row), len(column)), dtype=wp.int32, device=sides.device)
    on_device = (constant(numbers, wp.int32, sides.device) for numbers in (row, column))
    launch(_find_keys, probe_keys.shape, inputs=[sides, keys, *on_device], outputs=[probe_keys])
    return probe_keys
