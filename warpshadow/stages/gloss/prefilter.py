"""Prefiltered light: a map blurred by Gaussians of rising width, and its lookup.

Level 0 is the map; level k ≥ 1 has a Gaussian of σ = 2^(k−1) π / rows around each direction, and texels as wide as σ,
but at least 16 rows of them. A lookup of a blur σ is linear in log σ between two levels, and bilinear between their
texels. Levels stand one after another, each a latitude by longitude grid as :class:`warpshadow.EnvironmentMap` has it.
It is linear in the map.
"""

import functools

import numpy as np
import warp as wp

from warpshadow import check
from warpshadow.device.batch import common_batch, expand_rows, instance_in
from warpshadow.device.constants import constant
from warpshadow.device.lane_code import ANGLE
from warpshadow.device.lanes import lane_count, lane_type, make_lane_functions, module_options
from warpshadow.device.launch import differentiable, launch
from warpshadow.device.memory import empty
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


@wp.struct
class TexelPlace:
    """The four texels of a level around a direction, and its position between them."""

    upper_left: int
    upper_right: int
    lower_left: int
    lower_right: int
    lower_share: float
    right_share: float
    is_between_rows: float  # 1; 0 beyond the first and the last


@wp.func
def _find_place(first: int, rows: int, half_turns: float, turns: float):
    """The texels around a direction; rows end at the poles, columns go around."""
    height = half_turns * float(rows) - 0.5
    row = wp.clamp(height, 0.0, float(rows) - 1.0)
    column = turns * float(2 * rows) + 0.5
    upper = wp.min(int(row), rows - 2)
    right_column = int(column)
    place = TexelPlace()
    place.lower_share = row - float(upper)
    place.right_share = column - float(right_column)
    place.is_between_rows = wp.where(row == height, 1.0, 0.0)
    left_column = wp.where(right_column > 0, right_column - 1, 2 * rows - 1)
    right_column = wp.where(right_column < 2 * rows, right_column, 0)
    upper_row = first + upper * 2 * rows
    place.upper_left = upper_row + left_column
    place.upper_right = upper_row + right_column
    place.lower_left = upper_row + 2 * rows + left_column
    place.lower_right = upper_row + 2 * rows + right_column
    return place


@wp.func
def _interpolate_texels(texels: wp.array(dtype=wp.vec3), place: TexelPlace):
    above = texels[place.upper_left]
    above += place.right_share * (texels[place.upper_right] - above)
    below = texels[place.lower_left]
    below += place.right_share * (texels[place.lower_right] - below)
    return above + place.lower_share * (below - above)


@wp.func
def _slopes(texels: wp.array(dtype=wp.vec3), place: TexelPlace, adj: wp.vec3):
    """Products of the gradient with the light of a level, and with its slopes along rows and columns."""
    upper_left = wp.dot(adj, texels[place.upper_left])
    upper_right = wp.dot(adj, texels[place.upper_right])
    lower_left = wp.dot(adj, texels[place.lower_left])
    lower_right = wp.dot(adj, texels[place.lower_right])
    above = upper_left + place.right_share * (upper_right - upper_left)
    below = lower_left + place.right_share * (lower_right - lower_left)
    return wp.vec3(
        above + place.lower_share * (below - above),
        place.is_between_rows * (below - above),
        upper_right - upper_left + place.lower_share * (lower_right - lower_left - upper_right + upper_left),
    )


@wp.func
def _add_to_texels(adj: wp.vec3, place: TexelPlace, adj_texels: wp.array(dtype=wp.vec3)):
    wp.atomic_add(adj_texels, place.upper_left, (1.0 - place.lower_share) * (1.0 - place.right_share) * adj)
    wp.atomic_add(adj_texels, place.upper_right, (1.0 - place.lower_share) * place.right_share * adj)
    wp.atomic_add(adj_texels, place.lower_left, place.lower_share * (1.0 - place.right_share) * adj)
    wp.atomic_add(adj_texels, place.lower_right, place.lower_share * place.right_share * adj)


@wp.func
def _find_height(blur: float, texels_per_radian: float):
    """Level, from 0 on and fractional, whose blur is the given one [radians]."""
    # half a texel of the map itself is between levels 0 and 1
    return wp.clamp(wp.log2(wp.max(blur * texels_per_radian, 0.5)) + 1.0, 0.0, float(_LEVELS) - 1.001)


@functools.cache
def _make_look_up(lanes: int) -> tuple[wp.Kernel, wp.Kernel]:
    """Make the kernel and its adjoint, which find the angles of as many samples at once as there are lanes."""
    Lane, fn = lane_type(lanes), make_lane_functions(lanes)
    sqrt, is_positive, load = fn.sqrt, fn.is_positive, fn.load

    @wp.func_native(f"""
    wp::vec_t<{lanes}, float> angles;
    for (int lane = 0; lane < {lanes}; ++lane) {{
        const float y = imaginary.c[lane], x = y != (float)0 || real.c[lane] != (float)0 ? real.c[lane] : (float)1;
        {ANGLE}
        angles.c[lane] = angle;
    }}
    return angles;
    """)
    def find_angles(real: Lane, imaginary: Lane) -> Lane:  # type: ignore[empty-body, valid-type]
        """Angles of complex numbers, from −π to π."""
        ...

    @wp.func
    def find_place_angles(x: Lane, y: Lane, z: Lane):
        """Polar angles in half-turns, azimuths in turns, and sines of polar angles."""
        sine = sqrt(wp.cw_mul(x, x) + wp.cw_mul(z, z))
        azimuth = find_angles(-1.0 * z, x) / (2.0 * wp.pi)
        return find_angles(y, sine) / wp.pi, azimuth + is_positive(-azimuth), sine

    @wp.kernel(module="unique", module_options=module_options(lanes), enable_backward=False)
    def look_up(
        first_row: int,
        worker: int,
        # in
        texels: wp.array2d(dtype=wp.vec3),
        levels: wp.array(dtype=wp.vec2i),
        directions: wp.array3d(dtype=wp.vec3),
        blurs: wp.array3d(dtype=wp.float32),
        # out
        light: wp.array3d(dtype=wp.vec3),
    ):
        """A thread owns a receiver."""
        batch, receiver = split_row(first_row + wp.tid(), light.shape[1])
        light_texels = texels[instance_in(batch, texels.shape[0])]
        texels_per_radian = float(levels[0][1]) / wp.pi
        for block in range((light.shape[2] + lanes - 1) // lanes):
            first = block * lanes
            sample_directions = load(directions[batch, receiver], block)
            half_turns, turns, _sine = find_place_angles(sample_directions.x, sample_directions.y, sample_directions.z)
            for lane in range(wp.min(lanes, light.shape[2] - first)):
                height = _find_height(blurs[batch, receiver, first + lane], texels_per_radian)
                level = int(height)
                lower = _find_place(levels[level][0], levels[level][1], half_turns[lane], turns[lane])
                upper = _find_place(levels[level + 1][0], levels[level + 1][1], half_turns[lane], turns[lane])
                sharp = _interpolate_texels(light_texels, lower)
                soft = _interpolate_texels(light_texels, upper)
                light[batch, receiver, first + lane] = sharp + (height - float(level)) * (soft - sharp)

    @wp.kernel(module="unique", module_options=module_options(lanes), enable_backward=False)
    def look_up_adjoint(
        first_row: int,
        worker: int,
        # in
        texels: wp.array2d(dtype=wp.vec3),
        levels: wp.array(dtype=wp.vec2i),
        directions: wp.array3d(dtype=wp.vec3),
        blurs: wp.array3d(dtype=wp.float32),
        adj_light: wp.array3d(dtype=wp.vec3),
        # out
        adj_directions: wp.array3d(dtype=wp.vec3),
        adj_blurs: wp.array3d(dtype=wp.float32),
        adj_texels: wp.array2d(dtype=wp.vec3),
    ):
        """A thread owns a receiver."""
        batch, receiver = split_row(first_row + wp.tid(), adj_light.shape[1])
        texel_batch = instance_in(batch, texels.shape[0])
        light_texels = texels[texel_batch]
        texels_per_radian = float(levels[0][1]) / wp.pi
        for block in range((adj_light.shape[2] + lanes - 1) // lanes):
            first = block * lanes
            sample_directions = load(directions[batch, receiver], block)
            half_turns, turns, sine = find_place_angles(sample_directions.x, sample_directions.y, sample_directions.z)
            adj_polar = Lane()
            adj_azimuth = Lane()
            for lane in range(wp.min(lanes, adj_light.shape[2] - first)):
                adj = adj_light[batch, receiver, first + lane]
                blur = blurs[batch, receiver, first + lane]
                height = _find_height(blur, texels_per_radian)
                level = int(height)
                upper_share = height - float(level)
                lower = _find_place(levels[level][0], levels[level][1], half_turns[lane], turns[lane])
                upper = _find_place(levels[level + 1][0], levels[level + 1][1], half_turns[lane], turns[lane])
                if adj_texels:
                    _add_to_texels((1.0 - upper_share) * adj, lower, adj_texels[texel_batch])
                    _add_to_texels(upper_share * adj, upper, adj_texels[texel_batch])
                sharp = _slopes(light_texels, lower, adj)
                soft = _slopes(light_texels, upper, adj)
                rows = float(levels[level][1]) / wp.pi
                blurred_rows = float(levels[level + 1][1]) / wp.pi
                adj_polar[lane] = (1.0 - upper_share) * rows * sharp[1] + upper_share * blurred_rows * soft[1]
                adj_azimuth[lane] = (1.0 - upper_share) * rows * sharp[2] + upper_share * blurred_rows * soft[2]
                if adj_blurs and height > 0.0 and height < float(_LEVELS) - 1.001:
                    adj_blur = (soft[0] - sharp[0]) / (blur * wp.log(2.0))
                    adj_blurs[batch, receiver, first + lane] = adj_blurs[batch, receiver, first + lane] + adj_blur
            if adj_directions:
                # of the angle of y + i sine, and of that of -z + i x
                square = wp.max(wp.cw_mul(sine, sine), Lane(1.0e-12))
                adj_polar = wp.cw_div(adj_polar, square + wp.cw_mul(sample_directions.y, sample_directions.y))
                adj_square = wp.cw_mul(wp.cw_mul(adj_polar, sample_directions.y), wp.cw_div(sine, square))
                adj_azimuth = wp.cw_div(adj_azimuth, square)
                x = wp.cw_mul(adj_square, sample_directions.x) - wp.cw_mul(adj_azimuth, sample_directions.z)
                y = -wp.cw_mul(adj_polar, sine)
                z = wp.cw_mul(adj_square, sample_directions.z) + wp.cw_mul(adj_azimuth, sample_directions.x)
                for lane in range(wp.min(lanes, adj_light.shape[2] - first)):
                    adj_direction = wp.vec3(x[lane], y[lane], z[lane])
                    adj_directions[batch, receiver, first + lane] = (
                        adj_directions[batch, receiver, first + lane] + adj_direction
                    )

    return look_up, look_up_adjoint


def look_up_light(texels: wp.array, directions: wp.array, blurs: wp.array) -> wp.array:
    """Look up light from the directions of lobes.

    Args:
        texels: Of :func:`prefilter`, linear RGB, vec3 of shape [batch, texel].
        directions, blurs: Of :func:`.lobes.sample_lobes`, [batch, receiver, sample]. Either batch may be 1.

    Returns:
        Radiance, vec3 of shape [batch, receiver, sample].

    Differentiable: texels, directions, blurs.
    """
    check.shape("blurs", blurs.shape, ("batch", *directions.shape[1:]))
    count = common_batch({"texels": texels, "directions": directions, "blurs": blurs})
    device = directions.device
    directions, blurs = expand_rows(directions, count), expand_rows(blurs, count)
    inputs = [texels, constant(_level_offsets(texels.shape[1]), wp.vec2i, device), directions, blurs]
    look_up, look_up_adjoint = _make_look_up(lane_count(device))
    row_count, cost = count * directions.shape[1], _COST * directions.shape[2]
    return differentiable(
        lambda light: launch(look_up, row_count, inputs=inputs, outputs=[light], cost=cost),
        lambda adj_light: launch(
            look_up_adjoint,
            row_count,
            inputs=[*inputs, adj_light],
            outputs=[directions.grad, blurs.grad],
            sums=[texels.grad],
            cost=2 * cost,
        ),
        result=empty(directions.shape, dtype=wp.vec3, device=device),
        variables=[texels, directions, blurs],
    )
