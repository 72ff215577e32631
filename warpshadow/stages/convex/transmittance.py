"""Transmittance past convex blockers, such as boxes and rods.

    P_q = Π_bodies max(0, 1 − Σ_parts h_q)

h is the share of cell q within the silhouette of a convex part (:mod:`warpshadow.stages.cell_coverage`), the edges
between a face that a receiver sees and one that it does not.

Parts of one body are beside each other, so they cover different parts of a cell; bodies are independent. Edges are
exact, and so are thin parts: spheres bulge out of them.
"""

import functools
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from warpshadow import check
from warpshadow.device.batch import common_batch, expand, instance_in
from warpshadow.device.lanes import (
    block_count,
    lane_count,
    lane_type,
    make_lane_functions,
    module_options,
    vectors_type,
)
from warpshadow.device.launch import differentiable, launch
from warpshadow.device.parallel import Scratch, scratch_place
from warpshadow.maths.directions import BUNDLE, cell_radius
from warpshadow.stages.convex.prepared import ConvexArrays, ConvexBlockers, PlacedParts
from warpshadow.stages.convex.silhouette import (
    ADJOINT_LANES,
    EDGE_LANES,
    make_silhouette_functions,
    silhouette_type,
)
from warpshadow.stages.visibility.culling import DirectionCells, make_cells
from warpshadow.stages.visibility.directional import SOFTNESS

_PART_COST = 200.0
"""Mean time of a part of a receiver [ns]."""

_BOUND_MARGIN = 1.001
"""Bounds are so much larger, for rounding."""


@functools.cache
def _task_type(lanes: int) -> Any:
    """Struct of a block of receivers, and memory for its cells."""
    Lane, Vectors, Silhouette = lane_type(lanes), vectors_type(lanes), silhouette_type(lanes)

    @wp.struct
    class PartsTask:
        points: Vectors
        normals: Vectors
        lift: Lane  # 1 where there is no horizon, else 0
        left: wp.array(dtype=Lane)  # [direction] transmittance; for the adjoint its product with its adjoint
        coverage: wp.array(dtype=Lane)  # [direction] of the parts of a body, 0 between bodies
        covered: wp.array(dtype=wp.int32)  # numbers of the cells in which that is not 0
        silhouette: Silhouette

    return PartsTask


@functools.cache
def _bound_type(lanes: int) -> Any:
    """Struct of the cones around a part, as a block of receivers sees it."""
    Lane, Vectors = lane_type(lanes), vectors_type(lanes)

    @wp.struct
    class PartBound:
        rise: Lane  # above 0 where some of it is above the horizon of a receiver
        axis: Vectors
        cosine: Lane  # of its half-angle and that of a cell together, and sine; below −1 within the bound
        sine: Lane

    return PartBound


class _PartFunctions(NamedTuple):
    """Kernel functions on the parts of a body."""

    begin: wp.Function
    find_bound: wp.Function
    find_effect: wp.Function
    cover: wp.Function


@functools.cache
def _make_part_functions(lanes: int) -> _PartFunctions:
    """Make the kernel functions for a number of lanes."""
    Lane = lane_type(lanes)
    PartsTask, PartBound = _task_type(lanes), _bound_type(lanes)
    fn, silhouettes = make_lane_functions(lanes), make_silhouette_functions(lanes)
    is_any_above, dot, dot_direction, offset, scale = fn.is_any_above, fn.dot, fn.dot_direction, fn.offset, fn.scale
    load, sqrt, find, find_share = fn.load, fn.sqrt, silhouettes.find, silhouettes.find_share
    MARGIN = wp.constant(_BOUND_MARGIN)

    @wp.func
    def begin(
        points: wp.array2d(dtype=wp.vec3),
        horizon_normals: wp.array2d(dtype=wp.vec3),
        batch: int,
        block: int,
        lane_scratch: wp.array2d(dtype=Lane),
        covered: wp.array(dtype=wp.int32),
        edge_scratch: wp.array(dtype=Lane),
        adj_edge_scratch: wp.array(dtype=Lane),
        numbers: wp.array2d(dtype=wp.int32),
    ):
        """Load a block of receivers; nothing is covered yet."""
        task = PartsTask()
        task.points = load(points[batch], block)
        if horizon_normals:
            task.normals = load(horizon_normals[batch], block)
        task.lift = Lane(1.0) - wp.min(1.0e30 * dot(task.normals, task.normals), Lane(1.0))
        task.left = lane_scratch[0]
        task.coverage = lane_scratch[1]
        task.covered = covered
        task.silhouette.facing = numbers[0]
        task.silhouette.numbers = numbers[1]
        task.silhouette.edges = edge_scratch
        task.silhouette.adj_edges = adj_edge_scratch
        task.silhouette.sums = lane_scratch[2]
        for q in range(task.coverage.shape[0]):
            task.coverage[q] = Lane(0.0)
        return task

    @wp.func(inline=True)
    def find_bound(task: PartsTask, bound: wp.vec4, radius: float):
        """Find the cones around a part, widened by the radius of cells."""
        result = PartBound()
        away = offset(wp.vec3(bound[0], bound[1], bound[2]), task.points)
        distance2 = dot(away, away)
        reach = MARGIN * bound[3]
        inverse = wp.cw_div(Lane(1.0), sqrt(wp.max(distance2, Lane(wp.max(reach * reach, 1.0e-37)))))
        sine = reach * inverse
        cosine = sqrt(wp.max(Lane(1.0) - wp.cw_mul(sine, sine), Lane(0.0)))
        is_within = wp.min(wp.max(1.0e30 * (Lane(bound[3] * bound[3]) - distance2), Lane(0.0)), Lane(1.0))
        shrink = 1.0 / wp.sqrt(1.0 + radius * radius)
        result.rise = dot(task.normals, away) + Lane(bound[3]) + 1.0e30 * task.lift
        result.axis = scale(inverse, away)
        result.cosine = shrink * (cosine - radius * sine) - 4.0 * is_within
        result.sine = shrink * (sine + radius * cosine)
        return result

    @wp.func(inline=True)
    def reaches(bound: PartBound, axis: wp.vec3, half_angle: wp.vec2):
        """Whether the cone around a part reaches that of a bundle."""
        # as far as π together, else all does
        cosine = half_angle[0] * bound.cosine - half_angle[1] * bound.sine
        sine = half_angle[0] * bound.sine + half_angle[1] * bound.cosine
        return is_any_above(wp.max(dot_direction(axis, bound.axis) - cosine, Lane(0.0) - sine), 0.0)

    @wp.func(inline=True)
    def find_effect(task: PartsTask, bound: PartBound, direction: wp.vec3, q: int):
        """Above 0 where a part may block something of a cell; and where both are above the horizon."""
        is_above = wp.min(dot_direction(direction, task.normals) + task.lift, bound.rise)
        reached = dot_direction(direction, bound.axis) - bound.cosine
        left = wp.max(task.left[q], -task.left[q])
        return wp.min(wp.min(reached, is_above), wp.min(left, Lane(1.0) - task.coverage[q])), is_above

    @wp.func
    def cover(
        corners: wp.array(dtype=wp.vec3),
        planes: wp.array(dtype=wp.vec4),
        bounds: wp.array(dtype=wp.vec4),
        parts: ConvexArrays,
        body: int,
        cells: DirectionCells,
        radius: float,
        task: PartsTask,
    ):
        """Σ_parts h_q of a body, in cells of which something is left; returns how many it covers, and lists them."""
        covered_count = int(0)
        silhouette = task.silhouette
        for part in range(parts.first_part[body], parts.first_part[body + 1]):
            bound = find_bound(task, bounds[part], radius)
            if is_any_above(bound.rise, 0.0):
                is_found = bool(False)
                for bundle in range(cells.axes.shape[0]):
                    if reaches(bound, cells.axes[bundle], cells.half_angles[bundle]):
                        for q in range(bundle * BUNDLE, (bundle + 1) * BUNDLE):
                            direction = cells.directions[q]
                            effect, is_above = find_effect(task, bound, direction, q)
                            if is_any_above(effect, 0.0):
                                if not is_found:
                                    count, is_solid = find(task.points, corners, planes, parts, part, silhouette)
                                    silhouette.count = count
                                    silhouette.is_solid = is_solid
                                    is_found = True
                                share = find_share(task.points, corners, parts, silhouette, direction, radius)
                                share = wp.cw_mul(share, wp.min(wp.max(1.0e30 * is_above, Lane(0.0)), Lane(1.0)))
                                if is_any_above(share, 0.0):
                                    before = task.coverage[q]
                                    if not is_any_above(before, 0.0):
                                        task.covered[covered_count] = q
                                        covered_count += 1
                                    task.coverage[q] = before + share
        return covered_count

    return _PartFunctions(begin, find_bound, find_effect, cover)


@functools.cache
def _make_pass(lanes: int) -> wp.Kernel:
    Lane = lane_type(lanes)
    fn, functions = make_lane_functions(lanes), _make_part_functions(lanes)
    find_block, store_rows, begin, cover = fn.find_block, fn.store_rows, functions.begin, functions.cover

    @wp.kernel(module="unique", module_options=module_options(lanes), enable_backward=False)
    def pass_parts(
        first_row: int,
        worker: int,
        # in
        points: wp.array2d(dtype=wp.vec3),
        horizon_normals: wp.array2d(dtype=wp.vec3),
        corners: wp.array2d(dtype=wp.vec3),
        planes: wp.array2d(dtype=wp.vec4),
        bounds: wp.array2d(dtype=wp.vec4),
        parts: ConvexArrays,
        cells: DirectionCells,
        radius: float,
        skip: int,
        # scratch
        lane_scratch: wp.array3d(dtype=Lane),
        covered: wp.array2d(dtype=wp.int32),
        edge_scratch: wp.array2d(dtype=Lane),
        numbers: wp.array3d(dtype=wp.int32),
        # out
        passing: wp.array3d(dtype=wp.float32),
    ):
        """A thread owns a block of receivers."""
        row = first_row + wp.tid()
        batch, block = find_block(row, points.shape[1])
        place, instance = scratch_place(worker, row), instance_in(batch, corners.shape[0])
        task = begin(
            points,
            horizon_normals,
            batch,
            block,
            lane_scratch[place],
            covered[place],
            edge_scratch[place],
            edge_scratch[place],
            numbers[place],
        )
        for q in range(task.left.shape[0]):
            task.left[q] = Lane(1.0)
        for body in range(parts.first_part.shape[0] - 1):
            if body != skip and parts.blocks[body] == 1:
                covered_count = cover(
                    corners[instance], planes[instance], bounds[instance], parts, body, cells, radius, task
                )
                for k in range(covered_count):
                    q = task.covered[k]
                    task.left[q] = wp.cw_mul(task.left[q], wp.max(Lane(0.0), Lane(1.0) - task.coverage[q]))
                    task.coverage[q] = Lane(0.0)
        store_rows(task.left, block, passing[batch])

    return pass_parts


@functools.cache
def _make_pass_adjoint(lanes: int) -> wp.Kernel:
    Lane, Vectors = lane_type(lanes), vectors_type(lanes)
    fn, functions, silhouettes = (
        make_lane_functions(lanes),
        _make_part_functions(lanes),
        make_silhouette_functions(lanes),
    )
    find_block, load_products, add, add_vectors = fn.find_block, fn.load_products, fn.add, fn.add_vectors
    begin, find_bound, find_effect, cover = functions
    find, _find_share, share_adjoint, silhouette_adjoint = silhouettes
    is_any_above = fn.is_any_above
    ADJOINT_STRIDE = wp.constant(ADJOINT_LANES)

    @wp.kernel(module="unique", module_options=module_options(lanes), enable_backward=False)
    def pass_parts_adjoint(
        first_row: int,
        worker: int,
        # in
        points: wp.array2d(dtype=wp.vec3),
        horizon_normals: wp.array2d(dtype=wp.vec3),
        corners: wp.array2d(dtype=wp.vec3),
        planes: wp.array2d(dtype=wp.vec4),
        bounds: wp.array2d(dtype=wp.vec4),
        parts: ConvexArrays,
        cells: DirectionCells,
        radius: float,
        skip: int,
        passing: wp.array3d(dtype=wp.float32),
        adj_passing: wp.array3d(dtype=wp.float32),
        # scratch
        lane_scratch: wp.array3d(dtype=Lane),
        covered: wp.array2d(dtype=wp.int32),
        edge_scratch: wp.array2d(dtype=Lane),
        numbers: wp.array3d(dtype=wp.int32),
        adj_edge_scratch: wp.array2d(dtype=Lane),
        # out
        adj_points: wp.array2d(dtype=wp.vec3),
        # sums
        adj_corners: wp.array2d(dtype=wp.vec3),
    ):
        """A thread owns a block of receivers:  ∂P/∂h = −P / (1 − Σ_parts h) where that is positive."""
        row = first_row + wp.tid()
        batch, block = find_block(row, points.shape[1])
        place, instance = scratch_place(worker, row), instance_in(batch, corners.shape[0])
        task = begin(
            points,
            horizon_normals,
            batch,
            block,
            lane_scratch[place],
            covered[place],
            edge_scratch[place],
            adj_edge_scratch[place],
            numbers[place],
        )
        silhouette = task.silhouette
        adj_point = Vectors()
        load_products(passing[batch], adj_passing[batch], 0, passing.shape[2], block, task.left)
        for body in range(parts.first_part.shape[0] - 1):
            covered_count = int(0)
            if body != skip and parts.blocks[body] == 1:
                covered_count = cover(
                    corners[instance], planes[instance], bounds[instance], parts, body, cells, radius, task
                )
            if covered_count > 0:
                for part in range(parts.first_part[body], parts.first_part[body + 1]):
                    bound = find_bound(task, bounds[instance, part], radius)
                    is_found = bool(False)
                    for k in range(covered_count):
                        q = task.covered[k]
                        direction = cells.directions[q]
                        effect, _is_above = find_effect(task, bound, direction, q)
                        if is_any_above(effect, 0.0):
                            if not is_found:
                                count, is_solid = find(
                                    task.points, corners[instance], planes[instance], parts, part, silhouette
                                )
                                silhouette.count = count
                                silhouette.is_solid = is_solid
                                is_found = True
                                for i in range(ADJOINT_STRIDE * count):
                                    silhouette.adj_edges[i] = Lane(0.0)
                            is_affected = wp.min(wp.max(1.0e30 * effect, Lane(0.0)), Lane(1.0))
                            left = wp.max(Lane(1.0) - task.coverage[q], Lane(1.0e-30))
                            adj = -wp.cw_div(wp.cw_mul(is_affected, task.left[q]), left)
                            share_adjoint(task.points, corners[instance], parts, silhouette, direction, radius, adj)
                    if is_found:
                        adj_point = add(
                            adj_point,
                            silhouette_adjoint(
                                task.points, corners[instance], parts, silhouette, instance, adj_corners
                            ),
                        )
                for k in range(covered_count):
                    task.coverage[task.covered[k]] = Lane(0.0)
        if adj_points:
            add_vectors(adj_point, block, adj_points[batch])

    return pass_parts_adjoint


def transmittance_past_parts(
    points: wp.array,
    placed: PlacedParts,
    blockers: ConvexBlockers,
    directions: np.ndarray,
    *,
    radius: float | None = None,
    horizon_normals: wp.array | None = None,
    skip: int | None = None,
) -> wp.array:
    """Transmittance of cells past the convex parts of bodies.

    Args:
        points: Receivers [scene units], vec3 of shape [batch, receiver].
        placed: Where the parts are, from :meth:`.ConvexBlockers.placed`; the batch may be 1.
        blockers: The bodies.
        directions: Unit vectors ω of the cells, NumPy of shape [direction, 3].
        radius: Of cells that do not tile the sphere [rad]; by default that of so many even ones, which do.
        horizon_normals: Normals, vec3 of shape [batch, receiver]: nothing blocks cells below the horizon.
        skip: Number of the body that the receivers are part of, which blocks none of their light; None for none.

    Returns:
        Float32 of shape [batch, receiver, direction].

    Differentiable: points, placed. Not: horizon_normals, which decides by steps.
    """
    check.shape("points", points.shape, ("batch", "receiver"))
    check.shape("directions", directions.shape, ("direction", 3))
    if skip is not None:
        check.choice("skip", skip, range(blockers.body_count))
    points = expand(points, common_batch({"points": points, "corners": placed.corners}))
    own_radius = cell_radius(len(directions)) if radius is None else radius
    cells = make_cells(directions, SOFTNESS, points.device)
    inputs = [points, horizon_normals, *placed, blockers.arrays, cells, own_radius, -1 if skip is None else skip]
    lanes = lane_count(points.device)
    Lane, edge_count = lane_type(lanes), blockers.edge_count
    scratch = [
        Scratch((3, len(directions)), Lane),
        Scratch((len(directions),), wp.int32),
        Scratch((EDGE_LANES * edge_count,), Lane),
        Scratch((2, edge_count), wp.int32),
    ]
    adj_scratch = Scratch((ADJOINT_LANES * edge_count,), Lane)
    rows = points.shape[0] * block_count(points.shape[1], lanes)
    cost = _PART_COST * lanes * placed.bounds.shape[1]
    passing = wp.empty((*points.shape, len(directions)), dtype=wp.float32, device=points.device)
    return differentiable(
        lambda result: launch(_make_pass(lanes), rows, inputs=inputs, outputs=[result], scratch=scratch, cost=cost),
        lambda adj_passing: launch(
            _make_pass_adjoint(lanes),
            rows,
            inputs=[*inputs, passing, adj_passing],
            outputs=[points.grad],
            sums=[placed.corners.grad],
            scratch=[*scratch, adj_scratch],
            cost=2 * cost,
        ),
        result=passing,
        variables=[points, placed.corners],
    )
