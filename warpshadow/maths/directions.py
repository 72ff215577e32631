"""Cells of the sphere of directions: Q directions, each standing for a solid angle of 4π/Q, in compact bundles of 4."""

import functools
import math
from typing import NamedTuple

import numpy as np

from warpshadow import check
from warpshadow.maths.spatial_sort import compact_order

CHUNK = 16  # directions that fill a vector register; their number is a multiple of it
BUNDLE = 4  # directions that are culled together


MIN_WIDTH = 2e-3  # half-width of a falloff [rad] below which float32 has no digits left for it


def check_count(name: str, count: int) -> None:
    """Raise ValueError unless ``count`` is a positive multiple of 16."""
    if not check.is_integer(count) or count <= 0 or count % CHUNK:
        raise ValueError(f"{name}: got {count!r}, expected a positive multiple of {CHUNK}")


def check_directions(directions: np.ndarray) -> None:
    """Raise ValueError unless ``directions`` are unit vectors [direction, 3] for which there are cells."""
    check.shape("directions", directions.shape, ("direction", 3))
    check_count("directions", len(directions))
    check.finite("directions", directions)
    if not np.allclose(np.linalg.norm(directions, axis=1), 1, atol=1e-3):
        raise ValueError("directions: got vectors of other lengths, expected unit vectors")


@functools.cache
def fibonacci(count: int) -> np.ndarray:
    """Fibonacci directions z = 1 − (2i+1)/Q, φ = π(1+√5)(i+½), ordered so that each run of 4, 8, 16, … is compact.

    Args:
        count: Number of directions Q, a multiple of 16.
    Returns:
        Unit vectors, float64 of shape [Q, 3], not writable.
    """
    check_count("count", count)
    i = np.arange(count)
    z = 1 - (2 * i + 1) / count
    azimuth = np.pi * (1 + np.sqrt(5)) * (i + 0.5)
    radius = np.sqrt(1 - z**2)
    directions = np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), z], axis=-1)
    directions = directions[compact_order(directions, runs=(CHUNK, BUNDLE))]
    directions.flags.writeable = False
    return directions


def cell_radius(count: int) -> float:
    """Angular radius ρ = 2/√Q of a disc with a cell's solid angle [rad]."""
    return 2 / math.sqrt(count)


def falloff_width(softness: float, count: int) -> float:
    """Half-width w = κ·ρ of the falloff of a blocked cone towards ``count`` cells [rad].

    Raises:
        ValueError: for a width of π/4 or more, where the falloff is as wide as cones, and below :data:`MIN_WIDTH`.
    """
    width = softness * cell_radius(count) if check.is_number(softness) else -1.0
    if not MIN_WIDTH <= width < np.pi / 4:
        raise ValueError(
            f"softness: got {softness!r} for {count} directions, expected {MIN_WIDTH / cell_radius(count):.3g} to "
            f"{np.pi / 4 / cell_radius(count):.3g} (a half-width softness·2/√directions from {MIN_WIDTH} to π/4)"
        )
    return width


def brightest_chunk(power: np.ndarray, is_candidate: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The 16 brightest of the candidate cells; where there are fewer, each fills several of 16 slots.

    Args:
        power: Light of each cell [direction].
        is_candidate: Whether a cell may be among them, bool of shape [direction].
    Returns:
        Their numbers, ascending, [cell]; which of them fills each slot, [16]; and the first slot of each of all cells,
        −1 for the others, [direction].
    """
    cells = np.flatnonzero(is_candidate)
    cells = np.sort(cells[np.argsort(-power[cells], kind="stable")[:CHUNK]])
    repeated_cells = np.arange(CHUNK) * len(cells) // CHUNK
    slots = np.full(len(power), -1, np.int32)
    slots[cells] = np.searchsorted(repeated_cells, np.arange(len(cells)))
    return cells, repeated_cells, slots


class BundleCones(NamedTuple):
    """The cone around each bundle: axes [bundle, 3], cosine and sine of the half-angle [bundle].

    A bundle that is too wide for such a cone has axis 0, cosine 0 and sine 1: then the test that culls, axis·u > …,
    is never failed.
    """

    axes: np.ndarray
    cosine: np.ndarray
    sine: np.ndarray


def bundle_cones(directions: np.ndarray, width: float = 0.0, length: int = BUNDLE) -> BundleCones:
    """Bound every run of ``length`` directions [Q, 3] with a cone.

    It is compared with hemispheres widened by ``width`` [rad]. All three together must stay within 180°, where cosines
    order angles; a bundle that is too wide culls nothing.
    """
    bundles = directions.reshape(-1, length, 3)
    axes = bundles.mean(axis=1)
    axes /= np.maximum(np.linalg.norm(axes, axis=1, keepdims=True), 1e-12)
    cosine = np.minimum(np.einsum("bqx,bx->bq", bundles, axes).min(axis=1), 1.0)
    is_wide = cosine < max(np.cos(np.radians(80)), np.sin(width))
    cosine = np.where(is_wide, 0.0, cosine)
    return BundleCones(np.where(is_wide[:, None], 0.0, axes), cosine, np.sqrt(1 - cosine**2))
