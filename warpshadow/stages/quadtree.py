"""Quadtree: receivers at the corners of squares of the image, which are small where light changes quickly.

On a body that lies in a plane light changes slowly over the image, but for the edges of shadows. So its receivers are
the fragments at the corners of squares of 4 × 4 pixels, and squares are cut into four, and these again, where the light
that samples interpolate differs from their own (Ward's irradiance caching, in the image). That is told by *probes*, the
corners of squares of 2 × 2 pixels, at which somebody knows the light well enough. In a square of corners a b / c d are
two triangles a b c and d c b, in which samples interpolate linearly.

A square holds if its corners see one side of one body, and, if it is larger than a pixel, samples within it would be
off by less than the tolerance. Samples within it that see another side, or whose pixel is no part of a square that
holds, have no part in it: they are receivers themselves.
"""

from typing import NamedTuple

import numpy as np
import warp as wp

from warpshadow.device.batch import rows
from warpshadow.device.constants import constant
from warpshadow.device.launch import launch
from warpshadow.device.memory import empty, from_numpy
from warpshadow.device.parallel import split_row

MAX_SIDE = 4  # pixels of the side of the largest squares
PROBE_SPACING = 2  # pixels between probes
_SQUARE_COST = 50.0  # nanoseconds that one of the largest squares takes
TOLERANCE = 0.02  # error of interpolation at which a square is cut, as a part of the light where nothing blocks any


class Quadtree(NamedTuple):
    """Squares that hold."""

    sizes: wp.array  # [view, row, column] int32, side of the square that a pixel is in [pixels], 0 for none
    numbers: wp.array  # [view, row, column] int32, number of the square, at its first pixel
    corners: np.ndarray  # [square, 4] a b c d of each: view · samples + sample
    is_corner: np.ndarray  # [view, sample] bool
    keys: wp.array  # [side] int32, the same for sides that share squares; −1 for sides that are in none

    @property
    def triangles(self) -> np.ndarray:
        """Corners of the triangles, [2 · square, 3]: a square's first is left of its diagonal b c, above it."""
        return self.corners[:, [[0, 1, 2], [3, 2, 1]]].reshape(-1, 3)


def probe_grid(size: tuple[int, int], supersampling: int) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of the samples that are probes; the last may stand there twice.

    Args:
        size: Height and width of the image [samples].
        supersampling: Samples of a pixel across and down.
    """
    counts = (PROBE_SPACING * -(-length // (supersampling * MAX_SIDE)) + 1 for length in size)
    rows, columns = (
        np.minimum(PROBE_SPACING * supersampling * np.arange(count), length - 1)
        for count, length in zip(counts, size, strict=True)
    )
    return rows, columns


@wp.func
def sample_at(row: int, column: int, supersampling: int, height: int, width: int):
    """The sample at the upper left of a pixel; beyond the image's end the last."""
    return wp.min(row * supersampling, height - 1) * width + wp.min(column * supersampling, width - 1)


@wp.func
def _key_at(sides: wp.array(dtype=wp.int32), keys: wp.array(dtype=wp.int32), sample: int):
    side = sides[sample]
    key = int(-1)
    if side >= 0:
        key = keys[side]
    return key


@wp.func
def _has_key(keys: wp.array2d(dtype=wp.int32), row: int, column: int, key: int):
    """Whether there is a probe at a place, and it has a key."""
    if row < 0 or column < 0 or row >= keys.shape[0] or column >= keys.shape[1]:
        return False
    return keys[row, column] == key


@wp.func
def _curvature_error(shares: wp.array2d(dtype=float), keys: wp.array2d(dtype=wp.int32), row: int, column: int):
    """Error of linear interpolation over a distance of probes beside a probe: an eighth of the second difference."""
    key = keys[row, column]
    curvature_error = float(0.0)
    for axis in range(2):
        i = 1 - axis
        if _has_key(keys, row - i, column - axis, key) and _has_key(keys, row + i, column + axis, key):
            second_difference = (
                shares[row - i, column - axis] - 2.0 * shares[row, column] + shares[row + i, column + axis]
            )
            curvature_error = wp.max(curvature_error, wp.abs(second_difference) / 8.0)
    return curvature_error


@wp.func
def _probe_error(
    shares: wp.array2d(dtype=float),
    keys: wp.array2d(dtype=wp.int32),
    key: int,
    probe: wp.vec2i,
    a: wp.vec2i,
    b: wp.vec2i,
):
    """Error of interpolation between two probes, at a third one."""
    probe_error = float(0.0)
    if keys[probe[0], probe[1]] == key:
        probe_error = wp.abs(shares[probe[0], probe[1]] - 0.5 * (shares[a[0], a[1]] + shares[b[0], b[1]]))
    return probe_error


@wp.kernel(enable_backward=False)
def _cut_squares(
    first_row: int,
    worker: int,
    # in
    sides: wp.array2d(dtype=wp.int32),
    keys: wp.array(dtype=wp.int32),
    probe_keys: wp.array3d(dtype=wp.int32),
    probe_shares: wp.array3d(dtype=float),
    supersampling: int,
    height: int,
    width: int,
    tolerance: float,
    # out
    sizes: wp.array3d(dtype=wp.int32),
    is_first: wp.array3d(dtype=wp.bool),
):
    """A thread owns a row of the largest squares: pixels get the side of the square that holds there, 0 for none.

    The first pixel of a square is its upper left.
    """
    view, i = split_row(first_row + wp.tid(), probe_keys.shape[1] / 2)
    view_sides = sides[view]
    view_keys = probe_keys[view]
    shares = probe_shares[view]
    for j in range(view_keys.shape[1] / 2):
        row = 2 * i
        column = 2 * j
        key = view_keys[row, column]
        holds = key >= 0 and view_keys[row, column + 2] == key and view_keys[row + 2, column] == key
        if holds and view_keys[row + 2, column + 2] == key:
            a = wp.vec2i(row, column)
            b = wp.vec2i(row, column + 2)
            c = wp.vec2i(row + 2, column)
            d = wp.vec2i(row + 2, column + 2)
            probe_error = _probe_error(shares, view_keys, key, wp.vec2i(row + 1, column + 1), b, c)
            probe_error = wp.max(probe_error, _probe_error(shares, view_keys, key, wp.vec2i(row, column + 1), a, b))
            probe_error = wp.max(probe_error, _probe_error(shares, view_keys, key, wp.vec2i(row + 1, column), a, c))
            probe_error = wp.max(probe_error, _probe_error(shares, view_keys, key, wp.vec2i(row + 1, column + 2), b, d))
            probe_error = wp.max(probe_error, _probe_error(shares, view_keys, key, wp.vec2i(row + 2, column + 1), c, d))
            holds = probe_error <= tolerance
        else:
            holds = False
        for quarter in range(4):
            size = int(4)
            top = row + quarter / 2
            left = column + quarter % 2
            if not holds:
                key = view_keys[top, left]
                is_one = key >= 0 and view_keys[top, left + 1] == key and view_keys[top + 1, left] == key
                size = 1
                if is_one and view_keys[top + 1, left + 1] == key:
                    min_share = wp.min(shares[top, left], shares[top, left + 1])
                    min_share = wp.min(min_share, wp.min(shares[top + 1, left], shares[top + 1, left + 1]))
                    max_share = wp.max(shares[top, left], shares[top, left + 1])
                    max_share = wp.max(max_share, wp.max(shares[top + 1, left], shares[top + 1, left + 1]))
                    curvature_error = float(0.0)
                    if max_share - min_share > tolerance:
                        for corner in range(4):
                            curvature_error = wp.max(
                                curvature_error,
                                _curvature_error(shares, view_keys, top + corner / 2, left + corner % 2),
                            )
                    if curvature_error <= tolerance:
                        size = 2
            for pixel in range(4):
                y = 2 * top + pixel / 2
                x = 2 * left + pixel % 2
                if y < sizes.shape[1] and x < sizes.shape[2]:
                    pixel_size = size
                    if size == 1:
                        key = _key_at(view_sides, keys, sample_at(y, x, supersampling, height, width))
                        for corner in range(1, 4):
                            other = sample_at(y + corner / 2, x + corner % 2, supersampling, height, width)
                            if key < 0 or _key_at(view_sides, keys, other) != key:
                                pixel_size = 0
                    sizes[view, y, x] = pixel_size
                    is_first[view, y, x] = pixel_size > 0 and y % pixel_size == 0 and x % pixel_size == 0


def find_quadtree(
    sides: wp.array, keys: np.ndarray, probe_shares: np.ndarray, supersampling: int, *, tolerance: float = TOLERANCE
) -> Quadtree:
    """Find the squares in which samples interpolate.

    Args:
        sides: Side that each sample sees, −1 for none, int32 of shape [view, height, width].
        keys: A number for each side, equal for sides in one plane, −1 for sides without squares.
        probe_shares: Light at the samples of :func:`probe_grid`, over that where nothing blocks any, float32 of shape
            [view, row, column]; anything where they see no side that has squares.
        supersampling: Samples of a pixel across and down.
        tolerance: Error of interpolation at which a square is cut, in the unit of the shares.
    """
    device, (view_count, height, width) = sides.device, sides.shape
    flat, shape = rows(sides), (view_count, height // supersampling, width // supersampling)
    keys_there = constant(keys, wp.int32, device)
    sizes, is_first = empty(shape, dtype=wp.int32, device=device), empty(shape, dtype=wp.bool, device=device)
    probe_keys = keys_of(sides, keys, supersampling)
    inputs = [
        flat,
        keys_there,
        from_numpy(probe_keys, dtype=wp.int32, device=device),
        from_numpy(probe_shares, dtype=wp.float32, device=device),
    ]
    launch(
        _cut_squares,
        view_count * (probe_keys.shape[1] // 2),
        cost=_SQUARE_COST * (probe_keys.shape[2] // 2),
        inputs=[*inputs, supersampling, height, width, tolerance],
        outputs=[sizes, is_first],
    )
    first_pixels = np.flatnonzero(is_first.numpy())
    numbers = np.zeros(shape, np.int32)
    numbers.ravel()[first_pixels] = np.arange(len(first_pixels))
    view_rows, column = np.divmod(first_pixels, shape[2])
    view, row = np.divmod(view_rows, shape[1])
    side = sizes.numpy().ravel()[first_pixels]
    top, bottom = (np.minimum(end * supersampling, height - 1) for end in (row, row + side))
    left, right = (np.minimum(end * supersampling, width - 1) for end in (column, column + side))
    top, bottom = ((view * height + end) * width for end in (top, bottom))
    corners = np.stack([top + left, top + right, bottom + left, bottom + right], axis=1)
    is_corner = np.zeros(flat.shape, bool)
    is_corner.ravel()[corners] = True
    return Quadtree(sizes, from_numpy(numbers, dtype=wp.int32, device=device), corners, is_corner, keys_there)


def keys_of(sides: wp.array, keys: np.ndarray, supersampling: int) -> np.ndarray:
    """The keys of the sides that probes see, −1 for none, int of shape [view, row, column]."""
    row, column = probe_grid(sides.shape[1:], supersampling)
    view_sides = sides.numpy()[:, row[:, None], column]
    return np.where(view_sides < 0, -1, keys[view_sides]) if len(keys) else np.full(view_sides.shape, -1)
