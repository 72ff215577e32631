"""The light of cells of directions, gathered from an environment map."""

import functools
from typing import NamedTuple

import numpy as np

from warpshadow import check
from warpshadow.assets.color import LUMINANCE
from warpshadow.maths import sh
from warpshadow.maths.spatial_sort import z_order_of_cells

_AT_ONCE = 2**14
"""Sums in rows of cells that are found at once: few enough to stay in a cache, and row by row in the same order."""


class CellLight(NamedTuple):
    """The light of cells of directions, and where in its cell it comes from.

    Args:
        radiance: Mean radiance, L_q = Q/4π ∫_cell L dω, so that Σ_q (4π/Q) L_q = ∫ L dω; float32 [direction, 3].
        directions: Mean directions, weighted with luminance; float32 [direction, 3].
        spots: Mean directions, weighted with the square of luminance: of a sun, where it is, for any sky around
            it; float32 [direction, 3].
        half_angles: Half-angles of the evenly bright caps whose mean vectors with that weight are as long: 0 for a
            point, about 2/√Q for an even cell [radians]; float32 [direction]. None, as spots, where light is soft.
    """

    radiance: np.ndarray
    directions: np.ndarray
    spots: np.ndarray | None
    half_angles: np.ndarray | None


def gather_cells(radiance: np.ndarray, directions: np.ndarray) -> CellLight:
    """Gather the light of the cells around directions: every pixel belongs to the nearest one.

    All cells count as 4π/Q in size, which Fibonacci directions nearly have; pixels that are not much smaller than a
    cell are split. A dark cell gets its own direction and the spread of a cap of 4π/Q.

    Args:
        radiance: An equirectangular map, shape [height, 2·height, 3].
        directions: Unit vectors, shape [direction, 3].
    """
    energy, moment, square, square_moment = _cell_integrals(radiance, directions)
    mean, _ = _means(moment, energy @ LUMINANCE, directions)
    spots, concentration = _means(square_moment, square, directions)
    half_angles = np.arccos(np.clip(2 * concentration - 1, -1, 1))
    per_cell = energy * (len(energy) / (4 * np.pi))
    return CellLight(*(array.astype(np.float32) for array in (per_cell, mean, spots, half_angles)))


def _means(moment: np.ndarray, total: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean directions [direction, 3], and lengths of the mean vectors; dark cells' as for even light."""
    length = np.linalg.norm(moment, axis=1)
    has_light = length > 0
    mean = np.where(has_light[:, None], moment / np.where(has_light, length, 1)[:, None], directions)
    return mean, np.where(has_light, length / np.where(has_light, total, 1), 1 - 1 / len(moment))


def _cell_integrals(
    radiance: np.ndarray, directions: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Over every cell, with luminance Y: ∫ L dω, ∫ Y d dω, ∫ Y² dω and ∫ Y² d dω, float64, an item for each."""
    directions = np.asarray(directions, dtype=np.float64)
    check.shape("directions", directions.shape, ("direction", 3))
    if not len(directions) or not np.allclose(np.linalg.norm(directions, axis=1), 1, atol=1e-3):
        raise ValueError("directions: expected at least one, all unit vectors")
    count, height = len(directions), len(radiance)
    pixel_split = _split(height, count)
    cell_of_pixels = _cells_of_pixels(height * pixel_split, directions.astype(np.float32).tobytes())
    weights, pixel_directions = (
        sh.pixel_solid_angles(height * pixel_split),
        sh.equirectangular_directions(height * pixel_split),
    )
    integrals = np.zeros((10, count))
    block_size = max(_AT_ONCE // count, 1)
    for first in range(0, height * pixel_split, block_size):
        rows = np.arange(first, min(first + block_size, height * pixel_split))
        power = weights[rows, None, None] * np.repeat(radiance[rows // pixel_split], pixel_split, axis=1).astype(
            np.float64
        )
        luminance = (power @ LUMINANCE)[..., None]
        squared_luminance = luminance**2 / weights[rows, None, None]
        values = np.concatenate(
            [power, luminance * pixel_directions[rows], squared_luminance, squared_luminance * pixel_directions[rows]],
            axis=2,
        )
        cells = (cell_of_pixels[rows] + count * np.arange(len(rows))[:, None]).ravel()
        for integral, value in zip(integrals, values.reshape(-1, 10).T, strict=True):
            row_sums = np.bincount(cells, value, minlength=count * len(rows)).reshape(len(rows), count)
            row_sums[0] += integral
            integral[:] = row_sums.sum(axis=0)
    return integrals[:3].T, integrals[3:6].T, integrals[6], integrals[7:].T


def spread_in_cells(radiance: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Make a map of even cells around directions; :func:`gather_cells` gathers their radiance from it again.

    Args:
        radiance: Mean radiance L_q, as in a :class:`CellLight`; shape [direction, 3].
        directions: Unit vectors, shape [direction, 3].
    Returns:
        Radiance of a map in which no pixel is split, float64 of shape [height, 2·height, 3].
    """
    height = int(np.ceil(4 * np.pi * np.sqrt(len(directions))))
    cell_of_pixels = _cells_of_pixels(height, directions.astype(np.float32).tobytes())
    weights = np.repeat(sh.pixel_solid_angles(height), 2 * height)
    solid_angles = np.bincount(cell_of_pixels.ravel(), weights, minlength=len(directions))
    per_pixel = 4 * np.pi / len(directions) / np.maximum(solid_angles, weights.min())  # two equal directions: one owns
    return (radiance * per_pixel[:, None])[cell_of_pixels]


def draw_in_cells(radiance: np.ndarray, directions: np.ndarray, cells: np.ndarray, count: int) -> np.ndarray:
    """Draw directions from the light of some cells around directions, in proportion to its luminance.

    Args:
        radiance, directions: As for :func:`gather_cells`.
        cells: Numbers of the cells, none of which is dark.
        count: Directions that are drawn of each.
    Returns:
        Unit vectors, shape [cell, count, 3].
    """
    height, pixel_split = len(radiance), _split(len(radiance), len(directions))
    cell_of_pixels = _cells_of_pixels(height * pixel_split, np.asarray(directions).astype(np.float32).tobytes())
    luminance = np.abs(radiance @ LUMINANCE) * sh.pixel_solid_angles(height)[:, None]
    levels = (np.arange(count) + 0.5) / count
    jitter = (0.5 + np.outer(np.arange(count), [0.7548776662, 0.5698402910])) % 1  # Roberts' R2
    drawn_directions = np.empty((len(cells), count, 3))
    for cell_index, cell in enumerate(cells):
        rows, columns = np.nonzero(cell_of_pixels == cell)
        pixels = np.stack([rows, columns], axis=1)
        pixels = pixels[z_order_of_cells(pixels)]
        power = np.cumsum(luminance[pixels[:, 0] // pixel_split, pixels[:, 1] // pixel_split])
        pixel_indices = np.minimum(np.searchsorted(power, levels * power[-1]), len(power) - 1)
        theta, phi = (np.pi / (height * pixel_split) * (pixels[pixel_indices] + jitter)).T
        drawn_directions[cell_index] = np.stack(
            [np.sin(phi) * np.sin(theta), np.cos(theta), -np.cos(phi) * np.sin(theta)], axis=1
        )
    return drawn_directions


def without_spots(radiance: np.ndarray, spots: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Make a map without the light near some spots, at least without the pixel that each spot is in.

    Args:
        radiance: As for :func:`gather_cells`.
        spots: Their directions, unit vectors [spot, 3].
        angles: How far from its spot light is near [radians], [spot].
    """
    pixel_directions, half_diagonal = sh.equirectangular_directions(len(radiance)), np.pi / len(radiance) / np.sqrt(2)
    result = np.array(radiance)
    for direction, angle in zip(spots, angles, strict=True):
        result[pixel_directions @ direction >= np.cos(max(angle, half_diagonal))] = 0
    return result


def _split(height: int, count: int) -> int:
    """Pieces that rows of a map are split into: an eighth of a cell's angular radius 2/√Q."""
    return int(np.ceil(4 * np.pi * np.sqrt(count) / height))


@functools.lru_cache(maxsize=4)
def _cells_of_pixels(height: int, directions: bytes) -> np.ndarray:
    """Number of the direction, of float32 vectors, that is nearest to each pixel, int32 of shape [height, 2·height]."""
    from scipy.spatial import cKDTree  # which takes 0.1 s for 512 directions and 512 rows; all products take 1 to 4 s

    tree = cKDTree(np.frombuffer(directions, np.float32).reshape(-1, 3))
    nearest: np.ndarray = tree.query(sh.equirectangular_directions(height))[1].astype(np.int32)
    return nearest
