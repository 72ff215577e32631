"""Plane blockers: the bodies that lie in planes, such as a ground or walls, with the mip levels of their grids."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import warp as wp

from warpshadow.maths.outline import is_convex
from warpshadow.stages.planes.grid import PlaneTexture
from warpshadow.stages.sparse import SparseMatrix, multiply

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

MAX_EDGES = 128
"""Edges of an outline at most; with more, the rectangle blocks by the share that the mesh has of each texel."""

_NEIGHBOR_WEIGHT = 0.002
"""How much texels count in their neighbors, which have their light if nothing of their own is seen."""

_MARGIN = 0.001  # margin of planes, in widths of the smallest texel


class PlaneBody(NamedTuple):
    """A body with a grid, among all bodies."""

    grid: PlaneTexture
    positions: np.ndarray  # its vertices at rest, in its own frame, shape [vertex, 3]
    faces: np.ndarray  # its faces, indices of its vertices, shape [face, 3]
    first_vertex: int  # offset of its vertices among the vertices of all bodies
    first_patch: int  # offset of its patches among the patches of all bodies
    blocks: bool  # whether it casts shadows


@wp.struct
class PlaneGrid:
    """A grid as kernels read it."""

    minimum: wp.vec2  # corners of the rectangle [units of the body]
    maximum: wp.vec2
    texels: wp.vec2  # texels of the finest level for a unit of squeezed coordinates
    first: wp.vec2  # texel at the origin
    per_spread: float
    margin: float
    first_level: int  # of the front; the back's follow, if it has any
    level_count: int
    sides: int
    first_edge: int  # of the outline
    edge_count: int
    is_convex: int  # the outline
    is_covered_by_texels: int  # the outline is the rectangle's, and texels say how much of it the mesh covers
    blocks: int


@dataclass(frozen=True, eq=False)
class PlaneBlockers:
    """The flat bodies of a scene.

    Args:
        count: Number of planes.
        is_blocking: The plane blockers.
        grids: Their grids, of shape [plane].
        levels: First texel, width and height of each mip level, for each side of each plane, vec3i of shape [level].
        level_scales: Its texels for one of the finest level, vec2 of shape [level].
        covered: Coverage of each texel by the mesh, in all three components, vec3 of shape [texel].
        edges: Begin and end of the edges of outlines, in the axes of their planes, vec4 of shape [edge].
        edge_axes: Unit vectors along them, vec2 of shape [edge].
        texels_of_patches: Part of the area of each texel that patches have, and a little in the texels beside it,
            [texel, patch]; None where no patches are given.
        frames_of_vertices: Matrix that finds frames, [3 · plane, vertex].
        has_holes: Whether a mesh of the plane blockers leaves a part of its rectangle open, as a window.
    """

    count: int
    is_blocking: tuple[int, ...]
    grids: wp.array
    levels: wp.array
    level_scales: wp.array
    covered: wp.array
    edges: wp.array
    edge_axes: wp.array
    texels_of_patches: SparseMatrix | None
    frames_of_vertices: SparseMatrix
    has_holes: bool

    @staticmethod
    def from_bodies(
        bodies: Sequence[PlaneBody], patch_count: int, vertex_count: int, *, device: wp.DeviceLike
    ) -> PlaneBlockers:
        """Prepare flat bodies, among bodies that have so many patches and vertices together; 0 if none sends light."""
        from scipy.sparse import vstack

        levels: list[tuple[int, int, int]] = []
        scales: list[tuple[float, float]] = []
        grids, covered, edges, pyramids, frames, texel_count = [], [], [np.empty((0, 4))], [], [], 0
        for body in bodies:
            grid, first_level, first_edge = body.grid, len(levels), sum(map(len, edges))
            is_exact = len(grid.outline) <= MAX_EDGES
            edges.append((grid.outline if is_exact else grid.rectangle()).reshape(-1, 4))
            matrices, weights = _halvings(*grid.covered.shape), grid.covered * grid.texel_weights
            for side in range(grid.sides):
                for matrix, level_matrix, (height, width) in matrices:
                    levels.append((texel_count, width, height))
                    scales.append((width / grid.covered.shape[1], height / grid.covered.shape[0]))
                    texel_count += width * height
                    covered.append(matrix @ grid.covered.ravel())
                    if patch_count:
                        first = body.first_patch + side * grid.covered.size
                        pyramids.append(_shifted(level_matrix.multiply(weights.ravel()).tocsr(), first, patch_count))
            grids.append(_kernel_grid(body, first_level, len(matrices), first_edge, edges[-1]))
            grids[-1].is_covered_by_texels = int(not is_exact)
            frames.append(_frame_matrix(body, vertex_count))
        outlines = np.concatenate(edges)
        vectors = outlines[:, 2:] - outlines[:, :2]
        return PlaneBlockers(
            len(bodies),
            tuple(body_index for body_index, body in enumerate(bodies) if body.blocks),
            wp.array(grids, dtype=PlaneGrid, device=device),
            wp.array(np.array(levels), dtype=wp.vec3i, device=device),
            wp.array(np.array(scales), dtype=wp.vec2, device=device),
            wp.array(np.repeat(np.concatenate(covered)[:, None], 3, axis=1), dtype=wp.vec3, device=device),
            wp.array(outlines, dtype=wp.vec4, device=device),
            wp.array(vectors / np.linalg.norm(vectors, axis=1, keepdims=True), dtype=wp.vec2, device=device),
            SparseMatrix.from_matrix(vstack(pyramids), device=device) if patch_count else None,
            SparseMatrix.from_matrix(vstack(frames), device=device),
            any(body.blocks and not body.grid.is_whole for body in bodies),
        )

    def frames(self, positions: wp.array) -> wp.array:
        """Frames of planes: origin, and both axes, each as long as the body's scale.

        Args:
            positions: Vertices of all bodies [scene units], vec3 of shape [batch, vertex]. Three of each body count, so
                bodies must be moved and scaled only, not bent.
        Returns:
            vec3 of shape [batch, 3 · plane].
        Differentiable: positions.
        """
        return multiply(self.frames_of_vertices, positions)


@functools.lru_cache(16)
def _halvings(height: int, width: int) -> list[tuple[csr_matrix, csr_matrix, tuple[int, int]]]:
    """Matrices from a grid to each of its mip levels, each half as large as the one before, and their sizes.

    The second of each adds a little of the texels beside each one.

    Not to be written to: grids of different scenes are often of one size.
    """
    from scipy.sparse import diags, kron

    def blur(count: int) -> csr_matrix:
        return diags([_NEIGHBOR_WEIGHT, 1.0, _NEIGHBOR_WEIGHT], [-1, 0, 1], shape=(count, count)).tocsr()

    sizes = [(height, width)]
    while max(sizes[-1]) > 1:
        sizes.append((max(sizes[-1][0] // 2, 1), max(sizes[-1][1] // 2, 1)))
    levels = []
    for rows, columns in sizes:
        row_means, column_means = _means(height, rows), _means(width, columns)
        matrices = kron(row_means, column_means), kron(blur(rows) @ row_means, blur(columns) @ column_means)
        levels.append((matrices[0].tocsr(), matrices[1].tocsr(), (rows, columns)))
    return levels


def _means(fine: int, coarse: int) -> csr_matrix:
    """Matrix of means of ``fine`` equal texels over ``coarse`` equal texels of the same whole."""
    from scipy.sparse import csr_matrix

    edges = np.arange(coarse + 1) * fine / coarse
    texels = np.arange(fine)
    overlap = np.minimum(edges[1:, None], texels + 1) - np.maximum(edges[:-1, None], texels)
    return csr_matrix(np.maximum(overlap, 0) * coarse / fine)


def _shifted(matrix: csr_matrix, first: int, count: int) -> csr_matrix:
    """Move a matrix to the column ``first`` of one with ``count`` columns."""
    from scipy.sparse import csr_matrix

    return csr_matrix((matrix.data, matrix.indices + first, matrix.indptr), shape=(matrix.shape[0], count))


def _kernel_grid(body: PlaneBody, first_level: int, level_count: int, first_edge: int, edges: np.ndarray) -> PlaneGrid:
    grid, kernel_grid = body.grid, PlaneGrid()
    texels = np.array(grid.covered.shape[::-1]) / (grid.high - grid.low)
    kernel_grid.minimum, kernel_grid.maximum = (wp.vec2(*corner) for corner in grid.corners())
    kernel_grid.texels, kernel_grid.first = wp.vec2(*texels), wp.vec2(*(-grid.low * texels))
    kernel_grid.per_spread, kernel_grid.margin = 1 / grid.spread, _MARGIN * float(grid.texel_sizes().min())
    kernel_grid.first_level, kernel_grid.level_count, kernel_grid.sides = first_level, level_count, grid.sides
    kernel_grid.first_edge, kernel_grid.edge_count = first_edge, len(edges)
    kernel_grid.is_convex, kernel_grid.blocks = int(is_convex(edges.reshape(-1, 2, 2))), int(body.blocks)
    return kernel_grid


def _frame_matrix(body: PlaneBody, vertex_count: int) -> csr_matrix:
    """Matrix of a plane's origin and axes by three of its vertices, far apart."""
    from scipy.sparse import csr_matrix

    vertices = np.unique(body.faces)
    points = (body.positions[vertices].astype(np.float64) - body.grid.origin) @ body.grid.frame[:2].T
    first_point = np.linalg.norm(points - points.mean(axis=0), axis=1).argmax()
    second_point = np.linalg.norm(points - points[first_point], axis=1).argmax()
    axis_u = points[second_point] - points[first_point]
    third_point = np.abs(
        axis_u[0] * (points - points[first_point])[:, 1] - axis_u[1] * (points - points[first_point])[:, 0]
    ).argmax()
    frame_points = [first_point, second_point, third_point]
    # the rows w with Σ w = 1 and Σ w p = 0 for the origin, and Σ w = 0 and Σ w p = e for an axis e
    system = np.concatenate([points[frame_points].T, np.ones((1, 3))])
    weights = np.linalg.solve(system, np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]]).T).T
    columns = np.tile(body.first_vertex + vertices[frame_points], 3)
    return csr_matrix((weights.ravel(), (np.repeat(np.arange(3), 3), columns)), shape=(3, vertex_count))
