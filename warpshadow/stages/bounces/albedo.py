"""Albedo of patches: the matrices that take colors of vertices, or texels, to their means over patches."""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING

import numpy as np

from warpshadow.maths.adjacency import area_normals
from warpshadow.stages.patches import Patches
from warpshadow.stages.textures.pyramid import level_matrices, level_sizes

if TYPE_CHECKING:  # it is imported where a matrix is made
    from scipy.sparse import csr_matrix


def mean_over_vertices(patches: Patches, positions: np.ndarray, faces: np.ndarray) -> csr_matrix:
    """The matrix of means over patches of an attribute that is interpolated between vertices.

    Args:
        positions, faces: Vertices [units of the body], shape [vertex, 3], and faces, [face, 3].
    Returns:
        Shape [patch, vertex]; rows sum to 1, rows of patches without an area are empty.
    """
    weights = patches.pieces.corners.mean(axis=1)
    columns = faces[patches.pieces.faces]
    return _mean(patches, _piece_areas(patches, positions, faces), columns, weights, len(positions))


def mean_over_texels(
    patches: Patches,
    positions: np.ndarray,
    faces: np.ndarray,
    uvs: np.ndarray,
    uv_faces: np.ndarray,
    size: tuple[int, int],
) -> csr_matrix:
    """The matrix of means over patches of a texture, from its texels.

    A piece of a patch takes the mip level whose texels are about as large as it, in its middle, bilinearly.

    Args:
        positions, faces: Vertices [units of the body], shape [vertex, 3], and faces, [face, 3].
        uvs: Texture coordinates, shape [uv, 2].
        uv_faces: Indices of them, shape [face, 3].
        size: Height and width of the texture.
    Returns:
        Shape [patch, texel]; rows sum to 1, rows of patches without an area are empty.
    """
    corners = patches.pieces.corners.astype(np.float64) @ uvs.astype(np.float64)[uv_faces[patches.pieces.faces]]
    edge_u, edge_v = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    texel_areas = np.abs(edge_u[:, 0] * edge_v[:, 1] - edge_u[:, 1] * edge_v[:, 0]) / 2 * size[0] * size[1]
    sizes = np.array(level_sizes(*size))
    level_starts = np.cumsum([0, *sizes.prod(axis=1)])
    levels = np.minimum(np.rint(np.log2(np.maximum(texel_areas, 1)) / 2).astype(int), len(sizes) - 1)
    level_start, (height, width) = level_starts[levels], sizes[levels].T
    u, v = np.moveaxis(corners.mean(axis=1) % 1, -1, 0)
    x, y = u * width - 0.5, (1 - v) * height - 0.5
    x_floor, y_floor = np.floor(x).astype(int), np.floor(y).astype(int)
    columns, weights = [], []
    for row_step, row_weight in ((0, 1 - (y - y_floor)), (1, y - y_floor)):
        for column_step, column_weight in ((0, 1 - (x - x_floor)), (1, x - x_floor)):
            columns.append(level_start + (y_floor + row_step) % height * width + (x_floor + column_step) % width)
            weights.append(row_weight * column_weight)
    areas = _piece_areas(patches, positions, faces)
    means = _mean(patches, areas, np.stack(columns, axis=1), np.stack(weights, axis=1), level_starts[-1])
    level_means = (means[:, start:end] for start, end in itertools.pairwise(level_starts))
    return sum(level_mean @ matrix for level_mean, matrix in zip(level_means, level_matrices(*size), strict=True))


def _piece_areas(patches: Patches, positions: np.ndarray, faces: np.ndarray) -> np.ndarray:
    return np.linalg.norm(area_normals(patches.pieces.positions(positions, faces)), axis=1) / 2


def _mean(
    patches: Patches, areas: np.ndarray, columns: np.ndarray, weights: np.ndarray, column_count: int
) -> csr_matrix:
    """Matrix of the means over patches, by area, of the columns and weights [piece, n] of their pieces."""
    from scipy.sparse import csr_matrix

    entry_weights = areas[:, None] * weights
    entry_lists = []
    for patch_of_pieces in patches.patch_of_pieces:
        has_patch = patch_of_pieces >= 0
        rows = np.repeat(patch_of_pieces[has_patch], columns.shape[1])
        entry_lists.append((rows, columns[has_patch].ravel(), entry_weights[has_patch].ravel()))
    rows, entry_columns, values = (np.concatenate(item) for item in zip(*entry_lists, strict=True))
    area_sums = np.bincount(rows, values, patches.count)
    return csr_matrix((values / area_sums[rows], (rows, entry_columns)), shape=(patches.count, column_count))
