"""Flat light: what bodies that lie in planes, such as a ground or walls, block of each cell and what they send instead.

Their patches are the nodes of a :class:`.patches.Grid`. Seen from a receiver x, a cell with direction ω and angular
radius ρ = 2/√Q meets a plane with normal N at height d below the receiver:

    c = −N·ω                                  cosine
    c′ = ρ s(c/ρ),  s(z) = z,  and 1/3 + 2/3 ((z + 1)/2)³ below z = 1
                                              mean cosine of the part of the cell that is below the plane's horizon
    t = d / c′                                distance
    y = x + t ω                               where, in the plane
    h = S(c/ρ) · Π_axes [S((y_most − y)/e) − S((y_least − y)/e)],  e = t ρ √(1 + (ω_axis / c′)²) + a margin
                                              coverage: part of the cell that the rectangle takes

S(z) is the smoothstep from 0 at −1 to 1 at 1, so h has no step at the horizon, or at the border. Where the mesh has
holes, h is multiplied with what it covers of the footprint. Radiosity is bilinear in two mip levels of the grid, which
are blended so that their texels are as wide as the footprint is in the mean of both axes, 2 t ρ / √c′.

A flat is seen from both sides, and its back is black unless it has patches there. From its plane to a margin below it a
receiver sees its front fade away, so that one that lies on the ground is lit as if it were above. Of several flats the
nearest takes the cell; where they are at about the same distance, the cell is divided:

    I = 4/Q Σ_q max(n·ω_q, 0) T_q Σ_k h_k B_k Π_{j≠k} (1 − h_j S((t_k − t_j) / (t_k ρ/c′_k + t_j ρ/c′_j)))

Measured above a ground with the shadow of a disc, 400 receivers on a body over it, 128 cells, 24² nodes: the error of
I is 1.9% (relative L2), most of it that of 128 cells; 2.7% without mip levels, 2.1% with 16² nodes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import warp as wp

from warpshadow import check
from warpshadow.device.batch import common_batch, expand, instance_in
from warpshadow.device.constants import constant
from warpshadow.device.launch import differentiable, launch
from warpshadow.device.parallel import Scratch, scratch_place, split_row
from warpshadow.maths.directions import cell_radius
from warpshadow.stages.bounces.patches import Grid, stretched
from warpshadow.stages.bounces.sparse import SparseMatrix, multiply

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

_CELL_COST = 15.0
"""Nanoseconds that a cell of a receiver takes, on average over those that see a flat and those that do not."""

_MARGIN = 0.1
"""Margin of borders and of planes, in widths of the smallest texel."""

# ---------------------------------------------------------------------------------------------------- flats


class FlatBody(NamedTuple):
    """A body with a grid, among all bodies."""

    grid: Grid
    positions: np.ndarray
    """Its vertices at rest, in its own frame, shape [vertex, 3]."""
    faces: np.ndarray
    """Its faces, indices of those, shape [face, 3]."""
    first_vertex: int
    """Where its vertices begin among those of all bodies."""
    first_patch: int
    """Where its patches begin among those of all bodies."""
    blocks: bool
    """Whether it casts shadows."""


@wp.struct
class _Flat:
    """A grid as kernels read it."""

    least: wp.vec2  # corners of the rectangle [units of the body]
    most: wp.vec2
    low: wp.vec2  # its corner in squeezed coordinates
    texels: wp.vec2  # texels of the finest level for a unit of squeezed coordinates
    spread: float
    margin: float
    first_level: int  # of the front; those of the back follow, if it has any
    level_count: int
    sides: int
    is_whole: int  # the mesh covers the rectangle
    blocks: int


@dataclass(frozen=True, eq=False)
class Flats:
    """The flat bodies of a scene.

    Args:
        count: Number of flats.
        grids: Their grids.
        levels: First texel, width and height of each mip level, for each side of each flat, vec3i of shape [level].
        covered: What the mesh covers of each texel, in all three components, vec3 of shape [texel].
        texels_of_patches: Matrix of mip levels, [texel, patch].
        frames_of_vertices: Matrix that finds frames, [3 · flat, vertex].
    """

    count: int
    grids: wp.array
    levels: wp.array
    covered: wp.array
    texels_of_patches: SparseMatrix
    frames_of_vertices: SparseMatrix

    @staticmethod
    def of(bodies: Sequence[FlatBody], patch_count: int, vertex_count: int, *, device: wp.DeviceLike) -> Flats:
        """Prepare flat bodies, among bodies that have so many patches and vertices together."""
        from scipy.sparse import vstack

        levels: list[tuple[int, int, int]] = []
        grids, covered, pyramids, frames, texel_count = [], [], [], [], 0
        for body in bodies:
            grid, first_level = body.grid, len(levels)
            matrices = _halvings(*grid.covered.shape)
            for side in range(grid.sides):
                for matrix, (height, width) in matrices:
                    levels.append((texel_count, width, height))
                    texel_count += width * height
                    share = matrix @ grid.covered.ravel()
                    covered.append(share)
                    first = body.first_patch + side * grid.covered.size
                    pyramids.append(_shifted(matrix.multiply(grid.covered.ravel()).tocsr(), first, patch_count))
            grids.append(_kernel_grid(body, first_level, len(matrices)))
            frames.append(_frame_matrix(body, vertex_count))
        return Flats(
            len(bodies),
            wp.array(grids, dtype=_Flat, device=device),
            wp.array(np.array(levels, np.int32), dtype=wp.vec3i, device=device),
            wp.array(np.repeat(np.concatenate(covered)[:, None], 3, axis=1), dtype=wp.vec3, device=device),
            SparseMatrix.of(vstack(pyramids), device=device),
            SparseMatrix.of(vstack(frames), device=device),
        )

    def frames(self, positions: wp.array) -> wp.array:
        """Where flats are: origin, and both axes, each as long as the body's scale.

        Args:
            positions: Vertices of all bodies [scene units], vec3 of shape [batch, vertex]. Three of each flat count, so
                bodies must be moved and scaled only, not bent.

        Returns:
            vec3 of shape [batch, 3 · flat].

        Differentiable: positions.
        """
        return multiply(self.frames_of_vertices, positions)


def _halvings(height: int, width: int) -> list[tuple[csr_matrix, tuple[int, int]]]:
    """Matrices from a grid to each of its mip levels, each half as large as the one before, and their sizes."""
    from scipy.sparse import kron

    sizes = [(height, width)]
    while max(sizes[-1]) > 1:
        sizes.append((max(sizes[-1][0] // 2, 1), max(sizes[-1][1] // 2, 1)))
    return [(kron(_means(height, rows), _means(width, columns)).tocsr(), (rows, columns)) for rows, columns in sizes]


def _means(fine: int, coarse: int) -> csr_matrix:
    """Means of ``fine`` equal texels in ``coarse`` ones of the same length in all."""
    from scipy.sparse import csr_matrix

    edges = np.arange(coarse + 1) * fine / coarse
    texels = np.arange(fine)
    overlap = np.minimum(edges[1:, None], texels + 1) - np.maximum(edges[:-1, None], texels)
    return csr_matrix(np.maximum(overlap, 0) * coarse / fine)


def _shifted(matrix: csr_matrix, first: int, count: int) -> csr_matrix:
    """The matrix as part of one with ``count`` columns, from the column ``first`` on."""
    from scipy.sparse import csr_matrix

    return csr_matrix((matrix.data, matrix.indices + first, matrix.indptr), shape=(matrix.shape[0], count))


def _kernel_grid(body: FlatBody, first_level: int, level_count: int) -> _Flat:
    grid = body.grid
    flat = _Flat()
    size = np.array(grid.covered.shape[::-1])
    flat.least = wp.vec2(*(grid.spread * stretched(grid.low)))
    flat.most = wp.vec2(*(grid.spread * stretched(grid.high)))
    flat.low = wp.vec2(*grid.low)
    flat.texels = wp.vec2(*(size / (grid.high - grid.low)))
    flat.spread = grid.spread
    flat.margin = _MARGIN * float(grid.texel_sizes().min())
    flat.first_level, flat.level_count, flat.sides = first_level, level_count, grid.sides
    flat.is_whole, flat.blocks = int((grid.covered == 1).all()), int(body.blocks)
    return flat


def _frame_matrix(body: FlatBody, vertex_count: int) -> csr_matrix:
    """Rows that combine three vertices, far apart, to a flat's origin and axes."""
    from scipy.sparse import csr_matrix

    vertices = np.unique(body.faces)
    points = (body.positions[vertices].astype(np.float64) - body.grid.origin) @ body.grid.frame[:2].T
    first = np.linalg.norm(points - points.mean(axis=0), axis=1).argmax()
    second = np.linalg.norm(points - points[first], axis=1).argmax()
    along = points[second] - points[first]
    third = np.abs(along[0] * (points - points[first])[:, 1] - along[1] * (points - points[first])[:, 0]).argmax()
    chosen = [first, second, third]
    # the rows w with Σ w = 1 and Σ w p = 0 for the origin, and Σ w = 0 and Σ w p = e for an axis e
    system = np.concatenate([points[chosen].T, np.ones((1, 3))])
    weights = np.linalg.solve(system, np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]]).T).T
    columns = np.tile(body.first_vertex + vertices[chosen], 3)
    return csr_matrix((weights.ravel(), (np.repeat(np.arange(3), 3), columns)), shape=(3, vertex_count))


# ---------------------------------------------------------------------------------------------------- one cell


@wp.func
def _step(z: float):
    """The smoothstep from 0 at −1 to 1 at 1."""
    u = wp.clamp(0.5 * z + 0.5, 0.0, 1.0)
    return u * u * (3.0 - 2.0 * u)


@wp.func
def _step_slope(z: float):
    u = wp.clamp(0.5 * z + 0.5, 0.0, 1.0)
    return 3.0 * u * (1.0 - u)


@wp.struct
class _Met:
    """How a cell meets a side of a flat."""

    share: float  # part of the cell that the rectangle takes
    distance: float  # [units of the body]
    cosine: float  # mean over the part of the cell below the horizon
    place: wp.vec2  # in the plane


@wp.func
def _mean_cosine(cosine: float, radius: float):
    if cosine >= radius:
        return cosine
    u = 0.5 * cosine / radius + 0.5
    return radius * (1.0 / 3.0 + 2.0 / 3.0 * u * u * u)


@wp.func
def _mean_cosine_slope(cosine: float, radius: float):
    u = wp.min(0.5 * cosine / radius + 0.5, 1.0)
    return u * u


@wp.func
def _within(place: float, least: float, most: float, extent: float):
    """Part of a stretch around a place that is between two limits."""
    return _step((most - place) / extent) - _step((least - place) / extent)


@wp.func
def _is_amid(flat: _Flat, met: _Met, radius: float):
    """Whether a footprint is so far from the border that it does not matter."""
    reach = met.distance * radius / met.cosine + flat.margin
    return (
        wp.min(met.place[0] - flat.least[0], flat.most[0] - met.place[0]) > reach
        and wp.min(met.place[1] - flat.least[1], flat.most[1] - met.place[1]) > reach
    )


@wp.func
def _extent(slope: float, met: _Met, radius: float, margin: float):
    """How far a footprint reaches along an axis, to which the cell's direction has a slope."""
    return met.distance * radius * wp.sqrt(1.0 + slope * slope) + margin


@wp.func
def _meet(flat: _Flat, at: wp.vec3, toward: wp.vec3, weight: float, radius: float):
    """Meet a side.

    Args:
        at: Where the receiver is: along both axes, and its height above the side.
        toward: Direction of the cell along both axes, and its cosine.
        weight: Part of the side that is there.
        radius: ρ.
    """
    met = _Met()
    met.cosine = _mean_cosine(toward[2], radius)
    met.distance = at[2] / met.cosine
    met.place = wp.vec2(at[0] + met.distance * toward[0], at[1] + met.distance * toward[1])
    met.share = weight * _step(toward[2] / radius)
    if not _is_amid(flat, met, radius):
        for axis in range(2):
            extent = _extent(toward[axis] / met.cosine, met, radius, flat.margin)
            met.share = met.share * _within(met.place[axis], flat.least[axis], flat.most[axis], extent)
    return met


@wp.func
def _meet_adjoint(
    flat: _Flat,
    at: wp.vec3,
    toward: wp.vec3,
    weight: float,
    radius: float,
    met: _Met,
    adj_share: float,
    adj_of_distance: float,
    adj_of_cosine: float,
    adj_of_place: wp.vec2,
):
    """Gradients of ``at``, ``toward`` and ``weight``."""
    adj_distance = adj_of_distance
    adj_cosine = adj_of_cosine
    adj_place = wp.vec2(adj_of_place[0], adj_of_place[1])
    horizon = _step(toward[2] / radius)
    inside = wp.vec2(1.0, 1.0)
    adj_toward = wp.vec3()
    adj_slopes = wp.vec2()
    if not _is_amid(flat, met, radius):
        for axis in range(2):
            extent = _extent(toward[axis] / met.cosine, met, radius, flat.margin)
            inside[axis] = _within(met.place[axis], flat.least[axis], flat.most[axis], extent)
        for axis in range(2):
            slope = toward[axis] / met.cosine
            stretch = wp.sqrt(1.0 + slope * slope)
            extent = met.distance * radius * stretch + flat.margin
            beyond = (flat.most[axis] - met.place[axis]) / extent
            before = (flat.least[axis] - met.place[axis]) / extent
            adj_inside = adj_share * weight * horizon * inside[1 - axis]
            at_most = adj_inside * _step_slope(beyond) / extent
            at_least = adj_inside * _step_slope(before) / extent
            adj_place[axis] = adj_place[axis] + (at_least - at_most)
            adj_extent = at_least * before - at_most * beyond
            adj_distance += adj_extent * radius * stretch
            adj_slopes[axis] = adj_extent * met.distance * radius * slope / stretch
    amid = inside[0] * inside[1]
    adj_weight = adj_share * horizon * amid
    adj_toward[2] = adj_share * weight * amid * _step_slope(toward[2] / radius) / radius
    adj_distance += adj_place[0] * toward[0] + adj_place[1] * toward[1]
    for axis in range(2):
        adj_toward[axis] = adj_place[axis] * met.distance + adj_slopes[axis] / met.cosine
        adj_cosine -= adj_slopes[axis] * toward[axis] / (met.cosine * met.cosine)
    adj_cosine -= adj_distance * met.distance / met.cosine
    adj_toward[2] = adj_toward[2] + adj_cosine * _mean_cosine_slope(toward[2], radius)
    return wp.vec3(adj_place[0], adj_place[1], adj_distance / met.cosine), adj_toward, adj_weight


# ---------------------------------------------------------------------------------------------------- radiosity


@wp.struct
class _Spot:
    """Where a footprint lies on a grid, and how large it is."""

    texel: wp.vec2  # in texels of the finest level, from its corner
    slopes: wp.vec2  # of that by the place in the plane
    level: int  # finer of the two levels
    part: float  # of the coarser one
    part_slope: float  # of that, by the logarithm of the footprint's width
    log_slopes: wp.vec2  # of that logarithm by the place


@wp.func
def _find_spot(flat: _Flat, met: _Met, radius: float):
    spot = _Spot()
    area = float(1.0)  # of a unit of the plane [texels]
    for axis in range(2):
        z = met.place[axis] / flat.spread
        size = wp.abs(z)
        root = 1.0 / wp.sqrt(1.0 + size)
        spot.texel[axis] = (z * root - flat.low[axis]) * flat.texels[axis]
        slope = (1.0 + 0.5 * size) * root * root * root * flat.texels[axis] / flat.spread
        spot.slopes[axis] = slope
        spot.log_slopes[axis] = wp.sign(z) * (0.25 / (1.0 + 0.5 * size) - 0.75 * root * root) / flat.spread
        area *= slope
    width = 2.0 * met.distance * radius * wp.sqrt(area / met.cosine)
    texel_width = float(1.0)
    while spot.level < flat.level_count - 1 and width >= 2.0 * texel_width:
        spot.level = spot.level + 1
        texel_width *= 2.0
    if width > 1.0 and spot.level < flat.level_count - 1:
        spot.part = width / texel_width - 1.0
        spot.part_slope = width / texel_width
    return spot


@wp.struct
class _Corners:
    """Four texels of a level around a spot, and where it lies between them."""

    above: int  # the left one above; the right one is beside it
    below: int
    right: int  # 1, or 0 in a level of one column
    s: float
    t: float
    slopes: wp.vec2  # of s and t by the texel of the finest level


@wp.func
def _find_corners(flat: _Flat, level: wp.vec3i, finest: wp.vec3i, texel: wp.vec2):
    corners = _Corners()
    shrink_x = float(level[1]) / float(finest[1])
    shrink_y = float(level[2]) / float(finest[2])
    x = texel[0] * shrink_x - 0.5
    y = texel[1] * shrink_y - 0.5
    if x > 0.0 and x < float(level[1] - 1):
        corners.slopes[0] = shrink_x
    if y > 0.0 and y < float(level[2] - 1):
        corners.slopes[1] = shrink_y
    x = wp.clamp(x, 0.0, float(level[1] - 1))
    y = wp.clamp(y, 0.0, float(level[2] - 1))
    column = wp.min(int(x), wp.max(level[1] - 2, 0))
    row = wp.min(int(y), wp.max(level[2] - 2, 0))
    corners.s = x - float(column)
    corners.t = y - float(row)
    corners.right = wp.min(level[1] - 1, 1)
    corners.above = level[0] + row * level[1] + column
    corners.below = corners.above + wp.where(level[2] > 1, level[1], 0)
    return corners


@wp.func
def _between(texels: wp.array(dtype=wp.vec3), corners: _Corners):
    above = (1.0 - corners.s) * texels[corners.above] + corners.s * texels[corners.above + corners.right]
    below = (1.0 - corners.s) * texels[corners.below] + corners.s * texels[corners.below + corners.right]
    return (1.0 - corners.t) * above + corners.t * below


@wp.func
def _slopes_between(texels: wp.array(dtype=wp.vec3), corners: _Corners, adj: wp.vec3):
    """Slopes by s and t, of the dot product with a color, and by the texel of the finest level in the end."""
    first = texels[corners.above]
    second = texels[corners.above + corners.right]
    third = texels[corners.below]
    fourth = texels[corners.below + corners.right]
    along = (1.0 - corners.t) * (second - first) + corners.t * (fourth - third)
    down = (1.0 - corners.s) * (third - first) + corners.s * (fourth - second)
    return wp.vec2(corners.slopes[0] * wp.dot(adj, along), corners.slopes[1] * wp.dot(adj, down))


@wp.func
def _fetch(
    texels: wp.array(dtype=wp.vec3), levels: wp.array(dtype=wp.vec3i), flat: _Flat, first_level: int, spot: _Spot
):
    """Filtered value at a spot; the levels of the side begin at ``first_level``."""
    finest = levels[first_level]
    fine = _find_corners(flat, levels[first_level + spot.level], finest, spot.texel)
    value = _between(texels, fine)
    if spot.part > 0.0:
        coarse = _find_corners(flat, levels[first_level + spot.level + 1], finest, spot.texel)
        value = (1.0 - spot.part) * value + spot.part * _between(texels, coarse)
    return value


@wp.func
def _fetch_adjoint(
    texels: wp.array(dtype=wp.vec3),
    levels: wp.array(dtype=wp.vec3i),
    flat: _Flat,
    first_level: int,
    spot: _Spot,
    adj: wp.vec3,
):
    """Gradients of the place, and of the logarithm of the footprint's width."""
    finest = levels[first_level]
    fine = _find_corners(flat, levels[first_level + spot.level], finest, spot.texel)
    slopes = _slopes_between(texels, fine, adj)
    adj_log_width = float(0.0)
    if spot.part_slope > 0.0:
        coarse = _find_corners(flat, levels[first_level + spot.level + 1], finest, spot.texel)
        slopes = (1.0 - spot.part) * slopes + spot.part * _slopes_between(texels, coarse, adj)
        adj_log_width = spot.part_slope * wp.dot(adj, _between(texels, coarse) - _between(texels, fine))
    adj_place = wp.cw_mul(slopes, spot.slopes) + adj_log_width * spot.log_slopes
    return wp.vec3(adj_place[0], adj_place[1], adj_log_width)


@wp.func
def _scatter(
    adj_texels: wp.array(dtype=wp.vec3),
    levels: wp.array(dtype=wp.vec3i),
    flat: _Flat,
    first_level: int,
    spot: _Spot,
    adj: wp.vec3,
):
    """Add to the gradients of texels."""
    finest = levels[first_level]
    part = 1.0 - spot.part
    for step in range(2):
        if part > 0.0:
            c = _find_corners(flat, levels[first_level + spot.level + step], finest, spot.texel)
            above = (part * (1.0 - c.t)) * adj
            below = (part * c.t) * adj
            wp.atomic_add(adj_texels, c.above, (1.0 - c.s) * above)
            wp.atomic_add(adj_texels, c.above + c.right, c.s * above)
            wp.atomic_add(adj_texels, c.below, (1.0 - c.s) * below)
            wp.atomic_add(adj_texels, c.below + c.right, c.s * below)
        part = spot.part


# ---------------------------------------------------------------------------------------------------- receivers

# Scratch of a receiver, vec3: what it is to each flat, and the gradients of that:
#     4 f        where it is, along both axes, and its height
#     4 f + 1    the axis u, 4 f + 2 the axis v, 4 f + 3 the normal, of unit length
# and of each side of each flat in one cell, side k = 2 f for the front, 2 f + 1 for the back:
#     2 k        coverage, distance, and how much that varies over the cell
#     2 k + 1    what the side sends


@wp.func
def _place_receiver(point: wp.vec3, frames: wp.array(dtype=wp.vec3), flat_count: int, placed: wp.array(dtype=wp.vec3)):
    """Write what a receiver is to each flat."""
    for f in range(flat_count):
        u = frames[3 * f + 1]
        v = frames[3 * f + 2]
        scale_u = wp.length(u)
        scale_v = wp.length(v)
        along_u = u / scale_u
        along_v = v / scale_v
        normal = wp.cross(along_u, along_v)
        offset = point - frames[3 * f]
        placed[4 * f] = wp.vec3(
            wp.dot(offset, along_u) / scale_u, wp.dot(offset, along_v) / scale_v, wp.dot(offset, normal) / scale_u
        )
        placed[4 * f + 1] = along_u
        placed[4 * f + 2] = along_v
        placed[4 * f + 3] = normal


@wp.func
def _place_receiver_adjoint(
    point: wp.vec3,
    frames: wp.array(dtype=wp.vec3),
    flat_count: int,
    placed: wp.array(dtype=wp.vec3),
    adj_placed: wp.array(dtype=wp.vec3),
    instance: int,
    adj_frames: wp.array2d(dtype=wp.vec3),
):
    """Add to the gradients of the frames of an instance; returns that of the point."""
    adj_point = wp.vec3()
    for f in range(flat_count):
        scale_u = wp.length(frames[3 * f + 1])
        scale_v = wp.length(frames[3 * f + 2])
        offset = point - frames[3 * f]
        at = placed[4 * f]
        along_u = placed[4 * f + 1]
        along_v = placed[4 * f + 2]
        normal = placed[4 * f + 3]
        adj = adj_placed[4 * f]
        adj_offset = (adj[0] / scale_u) * along_u + (adj[1] / scale_v) * along_v + (adj[2] / scale_u) * normal
        adj_normal = adj_placed[4 * f + 3] + (adj[2] / scale_u) * offset
        adj_u = adj_placed[4 * f + 1] + (adj[0] / scale_u) * offset + wp.cross(along_v, adj_normal)
        adj_v = adj_placed[4 * f + 2] + (adj[1] / scale_v) * offset + wp.cross(adj_normal, along_u)
        adj_scale_u = -(adj[0] * at[0] + adj[2] * at[2]) / scale_u
        adj_scale_v = -adj[1] * at[1] / scale_v
        adj_point += adj_offset
        if adj_frames:
            wp.atomic_add(adj_frames, instance, 3 * f, -adj_offset)
            wp.atomic_add(
                adj_frames,
                instance,
                3 * f + 1,
                (adj_u - wp.dot(adj_u, along_u) * along_u) / scale_u + adj_scale_u * along_u,
            )
            wp.atomic_add(
                adj_frames,
                instance,
                3 * f + 2,
                (adj_v - wp.dot(adj_v, along_v) * along_v) / scale_v + adj_scale_v * along_v,
            )
    return adj_point


@wp.func
def _presence(height: float, margin: float, is_back: bool):
    """Part of a side that is there for a receiver at a height above the front: below it the back takes over."""
    front = _step(1.0 + 2.0 * height / margin)
    return wp.where(is_back, 1.0 - front, front)


@wp.func
def _on_side(placed: wp.array(dtype=wp.vec3), f: int, is_back: bool):
    """Where a receiver is above a side."""
    at = placed[4 * f]
    height = wp.where(is_back, -at[2], at[2])
    return wp.vec3(at[0], at[1], wp.max(height, 0.0))


@wp.func
def _toward(placed: wp.array(dtype=wp.vec3), f: int, is_back: bool, direction: wp.vec3):
    """Direction along the axes of a flat, and its cosine with a side."""
    cosine = -wp.dot(direction, placed[4 * f + 3])
    return wp.vec3(
        wp.dot(direction, placed[4 * f + 1]),
        wp.dot(direction, placed[4 * f + 2]),
        wp.where(is_back, -cosine, cosine),
    )


@wp.struct
class _Scene:
    """The flats as a kernel reads them."""

    flats: wp.array(dtype=_Flat)
    levels: wp.array(dtype=wp.vec3i)
    covered: wp.array(dtype=wp.vec3)
    skip: int  # the flat that the receivers are part of, -1 for none
    radius: float  # ρ


@wp.func
def _first_level(flat: _Flat, is_back: bool):
    return flat.first_level + wp.where(is_back and flat.sides == 2, flat.level_count, 0)


@wp.func
def _sends(flat: _Flat, is_back: bool):
    """Whether a side sends light."""
    return flat.sides == 2 or not is_back


@wp.func
def _coverage(scene: _Scene, flat: _Flat, is_back: bool, met: _Met, spot: _Spot):
    """Part of a footprint that the mesh covers."""
    covered = float(1.0)
    if flat.is_whole == 0:
        covered = _fetch(scene.covered, scene.levels, flat, _first_level(flat, is_back), spot)[0]
    return covered


@wp.func
def _meet_sides(
    scene: _Scene,
    direction: wp.vec3,
    texels: wp.array(dtype=wp.vec3),
    is_lit: bool,
    part: float,
    scratch: wp.array(dtype=wp.vec3),
):
    """Write what a part of a cell meets; returns whether it meets anything.

    No part meets nothing. Only flats that block count where none is lit.
    """
    if part <= 0.0:
        return False
    flat_count = scene.flats.shape[0]
    cells = 4 * flat_count
    meets = bool(False)
    for k in range(2 * flat_count):
        f = k // 2
        is_back = k - 2 * f == 1
        scratch[cells + 2 * k] = wp.vec3()
        scratch[cells + 2 * k + 1] = wp.vec3()
        flat = scene.flats[f]
        presence = _presence(scratch[4 * f][2], flat.margin, is_back)
        toward = _toward(scratch, f, is_back, direction)
        if f != scene.skip and presence > 0.0 and toward[2] > -scene.radius and (is_lit or flat.blocks != 0):
            met = _meet(flat, _on_side(scratch, f, is_back), toward, presence, scene.radius)
            if met.share > 0.0:
                meets = True
                spot = _Spot()
                if is_lit or flat.is_whole == 0:
                    spot = _find_spot(flat, met, scene.radius)
                covered = _coverage(scene, flat, is_back, met, spot)
                scratch[cells + 2 * k] = wp.vec3(
                    met.share * covered, met.distance, met.distance * scene.radius / met.cosine
                )
                if is_lit and _sends(flat, is_back):
                    scratch[cells + 2 * k + 1] = met.share * _fetch(
                        texels, scene.levels, flat, _first_level(flat, is_back), spot
                    )
    return meets


@wp.func
def _meet_sides_adjoint(
    scene: _Scene,
    direction: wp.vec3,
    texels: wp.array(dtype=wp.vec3),
    is_lit: bool,
    scratch: wp.array(dtype=wp.vec3),
    adj_scratch: wp.array(dtype=wp.vec3),
    instance: int,
    adj_texels: wp.array2d(dtype=wp.vec3),
):
    """Add to the gradients of what a receiver is to each flat, and to those of texels of an instance."""
    flat_count = scene.flats.shape[0]
    cells = 4 * flat_count
    for k in range(2 * flat_count):
        if scratch[cells + 2 * k][2] > 0.0 or scratch[cells + 2 * k][0] > 0.0:
            f = k // 2
            is_back = k - 2 * f == 1
            flat = scene.flats[f]
            first_level = _first_level(flat, is_back)
            presence = _presence(scratch[4 * f][2], flat.margin, is_back)
            at = _on_side(scratch, f, is_back)
            toward = _toward(scratch, f, is_back, direction)
            met = _meet(flat, at, toward, presence, scene.radius)
            adj_met = adj_scratch[cells + 2 * k]  # of coverage, distance, and its width t ρ / c′
            adj_sent = adj_scratch[cells + 2 * k + 1]
            adj_share = adj_met[0]
            adj_spot = wp.vec3()
            if is_lit or flat.is_whole == 0:
                spot = _find_spot(flat, met, scene.radius)
                if flat.is_whole == 0:
                    adj_share = adj_met[0] * _coverage(scene, flat, is_back, met, spot)
                    adj_spot += _fetch_adjoint(
                        scene.covered,
                        scene.levels,
                        flat,
                        first_level,
                        spot,
                        wp.vec3(adj_met[0] * met.share, 0.0, 0.0),
                    )
                if is_lit and _sends(flat, is_back):
                    adj_share += wp.dot(adj_sent, _fetch(texels, scene.levels, flat, first_level, spot))
                    adj_spot += _fetch_adjoint(texels, scene.levels, flat, first_level, spot, met.share * adj_sent)
                    if adj_texels:
                        _scatter(adj_texels[instance], scene.levels, flat, first_level, spot, met.share * adj_sent)
            # the footprint is as wide as t / √c′
            adj_distance = adj_met[1] + adj_met[2] * scene.radius / met.cosine
            adj_cosine = -(adj_met[2] * scene.radius * met.distance / met.cosine + 0.5 * adj_spot[2]) / met.cosine
            if met.distance > 0.0:
                adj_distance += adj_spot[2] / met.distance
            adj_at, adj_toward, adj_presence = _meet_adjoint(
                flat,
                at,
                toward,
                presence,
                scene.radius,
                met,
                adj_share,
                adj_distance,
                adj_cosine,
                wp.vec2(adj_spot[0], adj_spot[1]),
            )
            height = scratch[4 * f][2]
            side = wp.where(is_back, -1.0, 1.0)
            adj_height = wp.where(side * height > 0.0, side * adj_at[2], 0.0)
            adj_height += adj_presence * side * _step_slope(1.0 + 2.0 * height / flat.margin) * 2.0 / flat.margin
            adj_scratch[4 * f] = adj_scratch[4 * f] + wp.vec3(adj_at[0], adj_at[1], adj_height)
            adj_scratch[4 * f + 1] = adj_scratch[4 * f + 1] + adj_toward[0] * direction
            adj_scratch[4 * f + 2] = adj_scratch[4 * f + 2] + adj_toward[1] * direction
            adj_scratch[4 * f + 3] = adj_scratch[4 * f + 3] - (side * adj_toward[2]) * direction


@wp.func
def _nearness(own: wp.vec3, other: wp.vec3):
    """How far, in widths, another side is in front of one: −1 wholly behind it, 1 wholly in front."""
    return (own[1] - other[1]) / (own[2] + other[2] + 1.0e-20)


@wp.func
def _unhidden(k: int, but: int, flat_count: int, scratch: wp.array(dtype=wp.vec3)):
    """Part of a side's light that passes the sides in front of it, but for one of them."""
    cells = 4 * flat_count
    own = scratch[cells + 2 * k]
    part = float(1.0)
    for j in range(2 * flat_count):
        other = scratch[cells + 2 * j]
        if j != k and j != but and other[0] > 0.0:
            part *= 1.0 - other[0] * _step(_nearness(own, other))
    return part


@wp.kernel(enable_backward=False)
def _light_receivers(
    first_row: int,
    worker: int,
    # in
    points: wp.array2d(dtype=wp.vec3),
    normals: wp.array2d(dtype=wp.vec3),
    transmittance: wp.array3d(dtype=wp.float32),
    frames: wp.array2d(dtype=wp.vec3),
    texels: wp.array2d(dtype=wp.vec3),
    scene: _Scene,
    directions: wp.array(dtype=wp.vec3),
    # scratch
    scratch: wp.array2d(dtype=wp.vec3),
    # out
    light: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a receiver."""
    row = first_row + wp.tid()
    batch, receiver = split_row(row, points.shape[1])
    own = scratch[scratch_place(worker, row)]
    sent = texels[instance_in(batch, texels.shape[0])]
    normal = normals[batch, receiver]
    flat_count = scene.flats.shape[0]
    cells = 4 * flat_count
    _place_receiver(points[batch, receiver], frames[instance_in(batch, frames.shape[0])], flat_count, own)
    total = wp.vec3()
    for q in range(directions.shape[0]):
        weight = wp.dot(normal, directions[q]) * transmittance[batch, receiver, q]
        if _meet_sides(scene, directions[q], sent, True, weight, own):
            for k in range(2 * flat_count):
                if own[cells + 2 * k][0] > 0.0:
                    total += (weight * _unhidden(k, k, flat_count, own)) * own[cells + 2 * k + 1]
    light[batch, receiver] = (4.0 / float(directions.shape[0])) * total


@wp.kernel(enable_backward=False)
def _light_receivers_adjoint(
    first_row: int,
    worker: int,
    # in
    points: wp.array2d(dtype=wp.vec3),
    normals: wp.array2d(dtype=wp.vec3),
    transmittance: wp.array3d(dtype=wp.float32),
    frames: wp.array2d(dtype=wp.vec3),
    texels: wp.array2d(dtype=wp.vec3),
    scene: _Scene,
    directions: wp.array(dtype=wp.vec3),
    adj_light: wp.array2d(dtype=wp.vec3),
    # scratch
    scratch: wp.array2d(dtype=wp.vec3),
    adj_scratch: wp.array2d(dtype=wp.vec3),
    # out
    adj_points: wp.array2d(dtype=wp.vec3),
    adj_normals: wp.array2d(dtype=wp.vec3),
    adj_transmittance: wp.array3d(dtype=wp.float32),
    # sums
    adj_frames: wp.array2d(dtype=wp.vec3),
    adj_texels: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a receiver."""
    row = first_row + wp.tid()
    batch, receiver = split_row(row, points.shape[1])
    place = scratch_place(worker, row)
    own = scratch[place]
    adj_own = adj_scratch[place]
    seen_frames = instance_in(batch, frames.shape[0])
    seen_texels = instance_in(batch, texels.shape[0])
    sent = texels[seen_texels]
    normal = normals[batch, receiver]
    flat_count = scene.flats.shape[0]
    cells = 4 * flat_count
    _place_receiver(points[batch, receiver], frames[seen_frames], flat_count, own)
    for i in range(cells):
        adj_own[i] = wp.vec3()
    adj = (4.0 / float(directions.shape[0])) * adj_light[batch, receiver]
    adj_normal = wp.vec3()
    for q in range(directions.shape[0]):
        direction = directions[q]
        cosine = wp.dot(normal, direction)
        passing = transmittance[batch, receiver, q]
        if _meet_sides(scene, direction, sent, True, cosine, own):
            for k in range(2 * flat_count):
                adj_own[cells + 2 * k] = wp.vec3()
                adj_own[cells + 2 * k + 1] = wp.vec3()
            total = float(0.0)
            for k in range(2 * flat_count):
                if own[cells + 2 * k][0] > 0.0:
                    seen = _unhidden(k, k, flat_count, own)
                    value = wp.dot(adj, own[cells + 2 * k + 1])
                    total += seen * value
                    adj_own[cells + 2 * k + 1] = (cosine * passing * seen) * adj
                    for j in range(2 * flat_count):
                        if j != k and own[cells + 2 * j][0] > 0.0:
                            adj_factor = cosine * passing * value * _unhidden(k, j, flat_count, own)
                            met = own[cells + 2 * k]
                            other = own[cells + 2 * j]
                            nearness = _nearness(met, other)
                            adj_near = -adj_factor * other[0] * _step_slope(nearness)
                            adj_near = adj_near / (met[2] + other[2] + 1.0e-20)
                            adj_width = -adj_near * nearness
                            adj_own[cells + 2 * k] = adj_own[cells + 2 * k] + wp.vec3(0.0, adj_near, adj_width)
                            adj_own[cells + 2 * j] = adj_own[cells + 2 * j] + wp.vec3(
                                -adj_factor * _step(nearness), -adj_near, adj_width
                            )
            adj_normal += (passing * total) * direction
            if adj_transmittance:
                adj_transmittance[batch, receiver, q] = adj_transmittance[batch, receiver, q] + cosine * total
            if passing > 0.0:
                _meet_sides_adjoint(scene, direction, sent, True, own, adj_own, seen_texels, adj_texels)
    if adj_normals:
        adj_normals[batch, receiver] = adj_normals[batch, receiver] + adj_normal
    adj_point = _place_receiver_adjoint(
        points[batch, receiver], frames[seen_frames], flat_count, own, adj_own, seen_frames, adj_frames
    )
    if adj_points:
        adj_points[batch, receiver] = adj_points[batch, receiver] + adj_point


@wp.kernel(enable_backward=False)
def _pass_flats(
    first_row: int,
    worker: int,
    # in
    points: wp.array2d(dtype=wp.vec3),
    transmittance: wp.array3d(dtype=wp.float32),
    frames: wp.array2d(dtype=wp.vec3),
    scene: _Scene,
    directions: wp.array(dtype=wp.vec3),
    # scratch
    scratch: wp.array2d(dtype=wp.vec3),
    # out
    passing: wp.array3d(dtype=wp.float32),
):
    """A thread owns a receiver:  P_q = T_q Π_k (1 − h_k)."""
    row = first_row + wp.tid()
    batch, receiver = split_row(row, points.shape[1])
    own = scratch[scratch_place(worker, row)]
    flat_count = scene.flats.shape[0]
    cells = 4 * flat_count
    _place_receiver(points[batch, receiver], frames[instance_in(batch, frames.shape[0])], flat_count, own)
    for q in range(directions.shape[0]):
        part = transmittance[batch, receiver, q]
        if _meet_sides(scene, directions[q], scene.covered, False, part, own):
            for k in range(2 * flat_count):
                part *= 1.0 - own[cells + 2 * k][0]
        passing[batch, receiver, q] = part


@wp.kernel(enable_backward=False)
def _pass_flats_adjoint(
    first_row: int,
    worker: int,
    # in
    points: wp.array2d(dtype=wp.vec3),
    transmittance: wp.array3d(dtype=wp.float32),
    frames: wp.array2d(dtype=wp.vec3),
    scene: _Scene,
    directions: wp.array(dtype=wp.vec3),
    adj_passing: wp.array3d(dtype=wp.float32),
    # scratch
    scratch: wp.array2d(dtype=wp.vec3),
    adj_scratch: wp.array2d(dtype=wp.vec3),
    # out
    adj_points: wp.array2d(dtype=wp.vec3),
    adj_transmittance: wp.array3d(dtype=wp.float32),
    # sums
    adj_frames: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a receiver:  T̄_q += P̄_q Π_k (1 − h_k),  h̄_k = −P̄_q T_q Π_{j≠k} (1 − h_j)."""
    row = first_row + wp.tid()
    batch, receiver = split_row(row, points.shape[1])
    place = scratch_place(worker, row)
    own = scratch[place]
    adj_own = adj_scratch[place]
    seen_frames = instance_in(batch, frames.shape[0])
    flat_count = scene.flats.shape[0]
    cells = 4 * flat_count
    _place_receiver(points[batch, receiver], frames[seen_frames], flat_count, own)
    for i in range(cells):
        adj_own[i] = wp.vec3()
    for q in range(directions.shape[0]):
        adj = adj_passing[batch, receiver, q]
        part = float(1.0)
        if _meet_sides(scene, directions[q], scene.covered, False, wp.abs(adj), own):
            for k in range(2 * flat_count):
                part *= 1.0 - own[cells + 2 * k][0]
            if transmittance[batch, receiver, q] > 0.0:
                for k in range(2 * flat_count):
                    adj_coverage = -adj * transmittance[batch, receiver, q]
                    for j in range(2 * flat_count):
                        if j != k:
                            adj_coverage *= 1.0 - own[cells + 2 * j][0]
                    adj_own[cells + 2 * k] = wp.vec3(adj_coverage, 0.0, 0.0)
                _meet_sides_adjoint(scene, directions[q], scene.covered, False, own, adj_own, 0, adj_frames)
        if adj_transmittance:
            adj_transmittance[batch, receiver, q] = adj_transmittance[batch, receiver, q] + adj * part
    adj_point = _place_receiver_adjoint(
        points[batch, receiver], frames[seen_frames], flat_count, own, adj_own, seen_frames, adj_frames
    )
    if adj_points:
        adj_points[batch, receiver] = adj_points[batch, receiver] + adj_point


def passing_flats(
    points: wp.array,
    transmittance: wp.array,
    frames: wp.array,
    flats: Flats,
    directions: np.ndarray,
    *,
    skip: int | None = None,
) -> wp.array:
    """Transmittance past the flats that cast shadows, times that past all else: T_q Π_k (1 − h_k).

    Args:
        points: Receivers [scene units], vec3 of shape [batch, receiver].
        transmittance: Past all else, float32 of shape [batch, receiver, direction]; or the batch is 1 for either.
        frames: Where the flats are, vec3 of shape [batch, 3 · flat], from :meth:`Flats.frames`; the batch may be 1.
        flats: The flats.
        directions: Unit vectors ω of the cells, NumPy of shape [direction, 3].
        skip: Number of the flat that the receivers are part of, which blocks none of their light; None for none.

    Returns:
        Float32 of shape [batch, receiver, direction].

    Differentiable: points, transmittance, frames.
    """
    given = _Given.of(flats, points, transmittance, frames, directions, skip)
    if given is None:
        return transmittance
    inputs = [given.points, given.transmittance, frames, given.scene, given.directions]
    return differentiable(
        lambda passing: launch(
            _pass_flats,
            given.points.size,
            inputs=inputs,
            scratch=[given.scratch],
            outputs=[passing],
            cost=_CELL_COST * len(directions),
        ),
        lambda adj_passing: launch(
            _pass_flats_adjoint,
            given.points.size,
            inputs=[*inputs, adj_passing],
            scratch=[given.scratch] * 2,
            outputs=[given.points.grad, given.transmittance.grad],
            sums=[frames.grad],
            cost=2 * _CELL_COST * len(directions),
        ),
        result=wp.empty(given.transmittance.shape, dtype=wp.float32, device=points.device),
        variables=inputs[:3],
    )


def flat_light(
    points: wp.array,
    normals: wp.array,
    transmittance: wp.array,
    frames: wp.array,
    radiosity: wp.array,
    flats: Flats,
    directions: np.ndarray,
    *,
    skip: int | None = None,
) -> wp.array:
    """Light that flats send to receivers.

    Args:
        points: Receivers [scene units], vec3 of shape [batch, receiver].
        normals: Their unit normals, vec3 of shape [batch, receiver].
        transmittance: Past all else, without the flats, float32 of shape [batch, receiver, direction].
        frames: Where the flats are, vec3 of shape [batch, 3 · flat], from :meth:`Flats.frames`.
        radiosity: Of the patches of all bodies, vec3 of shape [batch, patch]. A batch of 1 serves all instances here
            and above.
        flats: The flats.
        directions: Unit vectors ω of the cells, NumPy of shape [direction, 3].
        skip: Number of the flat that the receivers are part of, which sends them nothing; None for none.

    Returns:
        What white receivers reflect of it, vec3 of shape [batch, receiver].

    Differentiable: points, normals, transmittance, frames, radiosity.
    """
    check.shape("normals", normals.shape, ("batch", points.shape[1]))
    others = {"normals": normals, "radiosity": radiosity}
    given = _Given.of(flats, points, transmittance, frames, directions, skip, others)
    if given is None:
        return wp.zeros((common_batch({"points": points, **others}), points.shape[1]), wp.vec3, points.device)
    normals, texels = expand(normals, given.points.shape[0]), multiply(flats.texels_of_patches, radiosity)
    variables = [given.points, normals, given.transmittance, frames, texels]
    inputs = [*variables, given.scene, given.directions]
    return differentiable(
        lambda light: launch(
            _light_receivers,
            given.points.size,
            inputs=inputs,
            scratch=[given.scratch],
            outputs=[light],
            cost=_CELL_COST * len(directions),
        ),
        lambda adj_light: launch(
            _light_receivers_adjoint,
            given.points.size,
            inputs=[*inputs, adj_light],
            scratch=[given.scratch] * 2,
            outputs=[given.points.grad, normals.grad, given.transmittance.grad],
            sums=[frames.grad, texels.grad],
            cost=2 * _CELL_COST * len(directions),
        ),
        result=wp.empty(given.points.shape, dtype=wp.vec3, device=points.device),
        variables=variables,
    )


class _Given(NamedTuple):
    """What both functions are given, checked, and as kernels take it."""

    points: wp.array
    transmittance: wp.array
    scene: _Scene
    directions: wp.array
    scratch: Scratch

    @staticmethod
    def of(
        flats: Flats,
        points: wp.array,
        transmittance: wp.array,
        frames: wp.array,
        directions: np.ndarray,
        skip: int | None,
        others: Mapping[str, wp.array] | None = None,
    ) -> _Given | None:
        """None where there is no other flat than the one to skip."""
        check.shape("points", points.shape, ("batch", "receiver"))
        check.shape("directions", directions.shape, ("direction", 3))
        check.shape("transmittance", transmittance.shape, ("batch", points.shape[1], len(directions)))
        check.shape("frames", frames.shape, ("batch", 3 * flats.count))
        if skip is not None:
            check.choice("skip", skip, range(flats.count))
        if flats.count == (skip is not None):
            return None
        instances = common_batch({"points": points, "transmittance": transmittance, "frames": frames, **(others or {})})
        scene = _Scene()
        scene.flats, scene.levels, scene.covered = flats.grids, flats.levels, flats.covered
        scene.skip, scene.radius = -1 if skip is None else skip, cell_radius(len(directions))
        rows = expand(transmittance.reshape((transmittance.shape[0], -1)), instances)
        return _Given(
            expand(points, instances),
            rows.reshape((instances, *transmittance.shape[1:])),
            scene,
            constant(directions, wp.vec3, points.device),
            Scratch((8 * flats.count,), wp.vec3),
        )
