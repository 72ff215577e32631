"""Cells near a direction, from a table over an octahedron: where transmittance is interpolated between cells."""

import functools

import numpy as np
import warp as wp

from warpshadow.device.constants import constant
from warpshadow.maths.directions import CHUNK, cell_radius

KERNEL_RADIUS = 2.2  # distance of a cell from which it no longer counts, in cell radii

_TABLE_ROWS = 32  # rows of the table of cells near directions, and its columns: an octahedron

wp.set_module_options({"max_unroll": 1})


@functools.lru_cache(maxsize=8)
def _find_neighbors(directions: bytes, kernel_radius: float) -> np.ndarray:
    """Cells near each texel of an octahedron, the nearest first, int32 of shape [texel, cell]."""
    from scipy.spatial import cKDTree

    cells = np.frombuffer(directions).reshape(-1, 3)
    row_centers = (np.arange(_TABLE_ROWS) + 0.5) / _TABLE_ROWS * 2 - 1
    x, z = np.meshgrid(row_centers, row_centers)
    y = 1 - np.abs(x) - np.abs(z)
    lower_part = np.maximum(-y, 0)
    texels = np.stack([x - np.sign(x) * lower_part, y, z - np.sign(z) * lower_part], axis=-1).reshape(-1, 3)
    texels /= np.linalg.norm(texels, axis=1, keepdims=True)
    search_radius = 2 * np.sin(min(kernel_radius * cell_radius(len(cells)) + 2.2 / _TABLE_ROWS, np.pi) / 2)
    tree = cKDTree(cells)
    count = max(len(neighbor_cells) for neighbor_cells in tree.query_ball_point(texels, search_radius))
    return tree.query(texels, min(max(count, 3), len(cells)))[1].astype(np.int32)


@functools.lru_cache(maxsize=8)
def _find_near_chunks(directions: bytes, kernel_radius: float) -> np.ndarray:
    """Chunks of the cells near each texel of an octahedron, int32 of shape [texel, chunk], −1 past the last."""
    neighbors = _find_neighbors(directions, kernel_radius) // CHUNK
    texels = np.arange(len(neighbors))[:, None]
    is_near = np.zeros((len(neighbors), neighbors.max() + 1), bool)
    is_near[texels, neighbors] = True
    chunks = np.argsort(~is_near, axis=1, kind="stable")[:, : is_near.sum(axis=1).max()]
    return np.where(is_near[texels, chunks], chunks, -1).astype(np.int32)


def cell_neighbors(cells: np.ndarray, device: wp.DeviceLike, kernel_radius: float = KERNEL_RADIUS) -> wp.array:
    """Make the table of the cells within a kernel's radius of each texel, int32 of shape [texel, cell].

    Args:
        cells: Unit vectors, NumPy of shape [cell, 3].
        kernel_radius: In radii of cells.
    """
    neighbors = _find_neighbors(np.ascontiguousarray(cells, np.float64).tobytes(), kernel_radius)
    return constant(neighbors, wp.int32, device)


def near_chunks(cells: np.ndarray, device: wp.DeviceLike, kernel_radius: float = KERNEL_RADIUS) -> wp.array:
    """Make the table of the chunks of such cells, int32 of shape [texel, chunk], −1 past the last of a texel."""
    chunks = _find_near_chunks(np.ascontiguousarray(cells, np.float64).tobytes(), kernel_radius)
    return constant(chunks, wp.int32, device)


@wp.func
def texel_of(direction: wp.vec3):
    """Texel of the octahedron that a direction is in."""
    size = wp.abs(direction[0]) + wp.abs(direction[1]) + wp.abs(direction[2])
    x = direction[0] / size
    z = direction[2] / size
    if direction[1] < 0.0:
        folded_direction = wp.sign(x) * (1.0 - wp.abs(z))
        z = wp.sign(z) * (1.0 - wp.abs(x))
        x = folded_direction
    column = wp.clamp(int((x + 1.0) * 0.5 * float(_TABLE_ROWS)), 0, _TABLE_ROWS - 1)
    row = wp.clamp(int((z + 1.0) * 0.5 * float(_TABLE_ROWS)), 0, _TABLE_ROWS - 1)
    return row * _TABLE_ROWS + column
