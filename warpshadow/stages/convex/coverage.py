"""Coverage of cells by convex blockers, such as boxes and rods.

Each piece of a body covers h_q = Σ_parts h, with the moment Σ_parts μ, of cell q: h and μ are the coverage by the
silhouette of a convex part (:mod:`warpshadow.stages.cell_coverage`), the edges between a face that a receiver sees and
one that it does not. Parts of one piece are beside each other, so they cover different parts of a cell. Prisms into
which a piece is cut both cover their seam, the face between them, where they are seen at a slant: it is taken off. How
pieces relate, :mod:`warpshadow.stages.joint_coverage` tells. Edges are exact, and so are thin parts: spheres bulge out
of them.
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
from warpshadow.device.launch import launch_with_adjoint
from warpshadow.device.memory import empty
from warpshadow.device.parallel import Scratch, scratch_slot
from warpshadow.maths.directions import BUNDLE, cell_radius
from warpshadow.stages.convex.convex_blockers import UNSEEN, ConvexArrays, ConvexBlockers, PlacedParts
from warpshadow.stages.convex.joint_lanes import coverage_type, make_joint_functions, sums_type
from warpshadow.stages.convex.silhouette import (
    ADJOINT_LANES,
    EDGE_LANES,
    SUM_LANES,
    make_silhouette_functions,
    silhouette_type,
)
from warpshadow.stages.visibility.culling import DirectionCells, make_cells
from warpshadow.stages.visibility.directional import SOFTNESS

_PART_COST = 200.0  # mean time of a part of a receiver [ns]

_BOUND_MARGIN = 1.001  # bounds are so much larger, for rounding

_ON_SURFACE = 3.0e-4
"""Height above a face up to which a receiver lies on it, over the radius of the part: faces are flat to 1e-4. Where the
part is a chord of a bent surface, its gap is added."""

_ROUNDING = 1.0e-6  # the same, over the distance of the part from the origin: several times that of float32


@wp.struct
class PartInputs:
    """Receivers, and the parts around them."""

    points: wp.array2d(dtype=wp.vec3)
    horizon_normals: wp.array2d(dtype=wp.vec3)  # none where there is no horizon
    corners: wp.array2d(dtype=wp.vec3)
    face_planes: wp.array2d(dtype=wp.vec4)
    bounds: wp.array2d(dtype=wp.vec4)
    parts: ConvexArrays
    cells: DirectionCells
    radius: float  # of cells
    skip: int  # the body that the receivers are part of, −1 for none
    on_surface: bool  # whether receivers lie on the parts, which then are those of one body


@functools.cache
def _task_type(lanes: int) -> Any:
    """Struct of a block of receivers, and memory for its cells."""
    Lane, Vectors, Silhouette = lane_type(lanes), vectors_type(lanes), silhouette_type(lanes)
    Coverages, SumsOfBlockers = coverage_type(lanes), sums_type(lanes)

    @wp.struct
    class PartsTask:
        batch: int
        block: int
        slot: int  # of scratch memory
        instance: int  # of the parts
        bounds: wp.array(dtype=wp.vec4)  # [part]
        points: Vectors
        normals: Vectors
        lift: Lane  # 1 where there is no horizon, else 0
        coverage: wp.array(dtype=Coverages)  # [direction] by the parts of a piece, 0 between pieces
        covered: wp.array(dtype=wp.int32)  # numbers of the cells in which that is not 0
        sums: wp.array(dtype=SumsOfBlockers)  # [direction] over pieces
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
    """Kernel functions on the parts of a piece."""

    prepare_block: wp.Function
    find_bound: wp.Function
    find_reach: wp.Function
    cover_by_piece: wp.Function
    cover_by_all_pieces: wp.Function


@functools.cache
def _make_part_functions(lanes: int) -> _PartFunctions:
    """Make the kernel functions for a number of lanes."""
    Lane = lane_type(lanes)
    PartsTask, PartBound = _task_type(lanes), _bound_type(lanes)
    Coverages, SumsOfBlockers = coverage_type(lanes), sums_type(lanes)
    fn, silhouettes, joint = make_lane_functions(lanes), make_silhouette_functions(lanes), make_joint_functions(lanes)
    is_any_above, dot, dot_direction, offset, scale = fn.is_any_above, fn.dot, fn.dot_direction, fn.offset, fn.scale
    find_block, load, sqrt, add, is_positive = fn.find_block, fn.load, fn.sqrt, fn.add, fn.is_positive
    find_silhouette, find_coverage = silhouettes.find_silhouette, silhouettes.find_coverage
    no_blockers, with_blocker = joint.no_blockers, joint.with_blocker
    MARGIN, ON_SURFACE, ROUNDING = wp.constant(_BOUND_MARGIN), wp.constant(_ON_SURFACE), wp.constant(_ROUNDING)

    @wp.func
    def prepare_block(
        row: int,
        worker: int,
        inputs: PartInputs,
        coverage: wp.array2d(dtype=Coverages),
        covered: wp.array2d(dtype=wp.int32),
        sums: wp.array2d(dtype=SumsOfBlockers),
        chord_sums: wp.array2d(dtype=Lane),
        edges: wp.array2d(dtype=Lane),
        numbers: wp.array3d(dtype=wp.int32),
    ):
        """Load a block of receivers; nothing is covered yet."""
        batch, block = find_block(row, inputs.points.shape[1])
        slot, instance = scratch_slot(worker, row), instance_in(batch, inputs.corners.shape[0])
        task = PartsTask()
        task.batch = batch
        task.block = block
        task.slot = slot
        task.instance = instance
        task.bounds = inputs.bounds[instance]
        task.points = load(inputs.points[batch], block)
        if inputs.horizon_normals:
            task.normals = load(inputs.horizon_normals[batch], block)
        task.lift = Lane(1.0) - is_positive(dot(task.normals, task.normals))
        task.coverage = coverage[slot]
        task.covered = covered[slot]
        task.sums = sums[slot]
        task.silhouette.points = task.points
        task.silhouette.corners = inputs.corners[instance]
        task.silhouette.face_planes = inputs.face_planes[instance]
        task.silhouette.facing = numbers[slot, 0]
        task.silhouette.numbers = numbers[slot, 1]
        task.silhouette.edges = edges[slot]
        task.silhouette.sums = chord_sums[slot]
        for q in range(task.coverage.shape[0]):
            task.coverage[q] = Coverages()
            task.sums[q] = no_blockers()
        return task

    @wp.func(inline=True)
    def find_cones(task: PartsTask, bound: wp.vec4, radius: float):
        """Find the cones around a part, widened by the radius of cells."""
        result = PartBound()
        away = offset(wp.vec3(bound[0], bound[1], bound[2]), task.points)
        distance2 = dot(away, away)
        reach = MARGIN * bound[3]
        inverse = wp.cw_div(Lane(1.0), sqrt(wp.max(distance2, Lane(wp.max(reach * reach, 1.0e-37)))))
        sine = reach * inverse
        cosine = sqrt(wp.max(Lane(1.0) - wp.cw_mul(sine, sine), Lane(0.0)))
        is_within = is_positive(Lane(bound[3] * bound[3]) - distance2)
        shrink = 1.0 / wp.sqrt(1.0 + radius * radius)
        result.rise = dot(task.normals, away) + Lane(bound[3]) + 1.0e30 * task.lift
        result.axis = scale(inverse, away)
        result.cosine = shrink * (cosine - radius * sine) - 4.0 * is_within
        result.sine = shrink * (sine + radius * cosine)
        return result

    @wp.func(inline=True)
    def find_margin(parts: ConvexArrays, part: int, bound: wp.vec4):
        """Height above a face up to which a receiver lies on it."""
        return (ON_SURFACE + parts.gaps[part]) * bound[3] + ROUNDING * wp.length(wp.vec3(bound[0], bound[1], bound[2]))

    @wp.func
    def find_rise(parts: ConvexArrays, part: int, task: PartsTask):
        """How far a part rises above tangent planes; not above 0 for receivers that lie on it."""
        bound = task.bounds[part]
        margin = find_margin(parts, part, bound)
        above = Lane(-1.0e30)
        is_on = Lane(0.0)
        for face in range(parts.first_face[part], parts.first_face[part + 1]):
            face_plane = task.silhouette.face_planes[face]
            normal = wp.vec3(face_plane[0], face_plane[1], face_plane[2])
            height = dot_direction(normal, task.points) - Lane(face_plane[3])
            is_near = is_positive(Lane(margin) - wp.max(height, -height))
            above = wp.max(above, height)
            is_on = wp.max(is_on, wp.cw_mul(is_near, is_positive(dot_direction(normal, task.normals))))
        is_on = wp.cw_mul(is_on, is_positive(Lane(margin) - above))
        rise = Lane(0.0)
        for corner in range(parts.first_corner[part], parts.first_corner[part + 1]):
            rise = wp.max(rise, dot(task.normals, offset(task.silhouette.corners[corner], task.points)))
        return wp.cw_mul(rise - Lane(margin), Lane(1.0) - is_on)

    @wp.func
    def find_bound(inputs: PartInputs, part: int, task: PartsTask):
        """Find the cones around a part, and where it may block light."""
        bound = task.bounds[part]
        result = find_cones(task, bound, inputs.radius)
        face = inputs.parts.first_face[part]
        if task.silhouette.face_planes[face + 1][3] == UNSEEN:  # it is one-sided
            plane = task.silhouette.face_planes[face]
            height = dot_direction(wp.vec3(plane[0], plane[1], plane[2]), task.points) - Lane(plane[3])
            result.rise = wp.min(result.rise, height)
        if inputs.on_surface and is_any_above(result.rise, 0.0):
            depth = Lane(2.0 * bound[3] + find_margin(inputs.parts, part, bound)) - result.rise
            if is_any_above(depth, 0.0):  # else it is above tangent planes
                result.rise = wp.min(result.rise, find_rise(inputs.parts, part, task))
        return result

    @wp.func(inline=True)
    def reaches_bundle(bound: PartBound, axis: wp.vec3, half_angle: wp.vec2):
        """Whether the cone around a part reaches that of a bundle."""
        # as far as π together, else all does
        cosine = half_angle[0] * bound.cosine - half_angle[1] * bound.sine
        sine = half_angle[0] * bound.sine + half_angle[1] * bound.cosine
        return is_any_above(wp.max(dot_direction(axis, bound.axis) - cosine, Lane(0.0) - sine), 0.0)

    @wp.func(inline=True)
    def find_reach(task: PartsTask, bound: PartBound, direction: wp.vec3):
        """Above 0 where the cone around a part reaches a cell, and both are above the horizon."""
        is_above = wp.min(dot_direction(direction, task.normals) + task.lift, bound.rise)
        return wp.min(dot_direction(direction, bound.axis) - bound.cosine, is_above)

    @wp.func
    def cover_by_piece(inputs: PartInputs, piece: int, task: PartsTask):
        """Coverage by a piece of cells that no other covers wholly; returns how many it covers, and lists them."""
        parts, cells, radius = inputs.parts, inputs.cells, inputs.radius
        covered_count = int(0)
        silhouette = task.silhouette
        enough = wp.where(parts.signs[parts.first_part[piece + 1] - 1] < 0.0, 1.0e30, 1.0)  # seams take off
        for part in range(parts.first_part[piece], parts.first_part[piece + 1]):
            bound = find_bound(inputs, part, task)
            sign = parts.signs[part]
            if is_any_above(bound.rise, 0.0):
                is_found = bool(False)
                for bundle in range(cells.axes.shape[0]):
                    if reaches_bundle(bound, cells.axes[bundle], cells.half_angles[bundle]):
                        for q in range(bundle * BUNDLE, (bundle + 1) * BUNDLE):
                            direction = cells.directions[q]
                            before = task.coverage[q].share
                            room = wp.min(Lane(enough) - before, Lane(1.0) - task.sums[q].largest)
                            if sign < 0.0:
                                room = wp.min(room, before)  # prisms cover the same cells
                            effect = wp.min(find_reach(task, bound, direction), room)
                            if is_any_above(effect, 0.0):
                                if not is_found:
                                    count, is_solid = find_silhouette(parts, part, silhouette)
                                    silhouette.count = count
                                    silhouette.is_solid = is_solid
                                    is_found = True
                                by_part = find_coverage(parts, silhouette, direction, radius)
                                is_affected = is_positive(effect)
                                if is_any_above(wp.cw_mul(is_affected, by_part.share), 0.0):
                                    if not is_any_above(before, 0.0):
                                        task.covered[covered_count] = q
                                        covered_count += 1
                                    factor = sign * is_affected
                                    task.coverage[q] = Coverages(
                                        before + wp.cw_mul(factor, by_part.share),
                                        add(task.coverage[q].moment, scale(factor, by_part.moment)),
                                    )
        return covered_count

    @wp.func
    def cover_by_all_pieces(inputs: PartInputs, task: PartsTask):
        """Store sums over all pieces for each cell."""
        for piece in range(inputs.parts.first_part.shape[0] - 1):
            if inputs.parts.bodies[piece] != inputs.skip and inputs.parts.blocks[piece] == 1:
                covered_count = cover_by_piece(inputs, piece, task)
                for k in range(covered_count):
                    q = task.covered[k]
                    task.sums[q] = with_blocker(task.sums[q], task.coverage[q])
                    task.coverage[q] = Coverages()

    return _PartFunctions(prepare_block, find_bound, find_reach, cover_by_piece, cover_by_all_pieces)


@functools.cache
def _make_cover(lanes: int) -> wp.Kernel:
    Lane, Coverages, SumsOfBlockers = lane_type(lanes), coverage_type(lanes), sums_type(lanes)
    fn, functions, joint = make_lane_functions(lanes), _make_part_functions(lanes), make_joint_functions(lanes)
    is_any_above, prepare_block, cover_by_all_pieces = (
        fn.is_any_above,
        functions.prepare_block,
        functions.cover_by_all_pieces,
    )
    joint_coverage, store_columns = joint.joint_coverage, joint.store_columns

    @wp.kernel(module="unique", module_options=module_options(lanes), enable_backward=False)
    def cover_cells(
        first_row: int,
        worker: int,
        # in
        inputs: PartInputs,
        # scratch
        coverage: wp.array2d(dtype=Coverages),
        covered: wp.array2d(dtype=wp.int32),
        sums: wp.array2d(dtype=SumsOfBlockers),
        chord_sums: wp.array2d(dtype=Lane),
        edges: wp.array2d(dtype=Lane),
        numbers: wp.array3d(dtype=wp.int32),
        # out
        result: wp.array3d(dtype=wp.vec4),
    ):
        """A thread owns a block of receivers."""
        row = first_row + wp.tid()
        task = prepare_block(row, worker, inputs, coverage, covered, sums, chord_sums, edges, numbers)
        cover_by_all_pieces(inputs, task)
        for q in range(task.coverage.shape[0]):
            if is_any_above(task.sums[q].total, 0.0):
                task.coverage[q] = joint_coverage(task.sums[q])
        store_columns(task.coverage, task.block, result[task.batch])

    return cover_cells


@functools.cache
def _make_cover_adjoint(lanes: int) -> wp.Kernel:
    Lane, Vectors = lane_type(lanes), vectors_type(lanes)
    Coverages, SumsOfBlockers = coverage_type(lanes), sums_type(lanes)
    fn, functions, joint = make_lane_functions(lanes), _make_part_functions(lanes), make_joint_functions(lanes)
    is_any_above, is_positive, scale = fn.is_any_above, fn.is_positive, fn.scale
    add, add_vectors = fn.add, fn.add_vectors
    joint_coverage_adjoint, blocker_adjoint = joint.joint_coverage_adjoint, joint.blocker_adjoint
    load_columns = joint.load_columns
    prepare_block, find_bound, find_reach, cover_by_piece, cover_by_all_pieces = functions
    find_silhouette, _find_coverage, coverage_adjoint, silhouette_adjoint = make_silhouette_functions(lanes)
    ADJOINT_STRIDE = wp.constant(ADJOINT_LANES)

    @wp.func(inline=True)
    def is_any(coverage: Coverages):
        """Whether anything is not 0."""
        moment = coverage.moment
        highest = wp.max(wp.max(coverage.share, moment.x), wp.max(moment.y, moment.z))
        lowest = wp.min(wp.min(coverage.share, moment.x), wp.min(moment.y, moment.z))
        return is_any_above(wp.max(highest, -lowest), 0.0)

    @wp.kernel(module="unique", module_options=module_options(lanes), enable_backward=False)
    def cover_cells_adjoint(
        first_row: int,
        worker: int,
        # in
        inputs: PartInputs,
        adj_result: wp.array3d(dtype=wp.vec4),
        # scratch
        coverage: wp.array2d(dtype=Coverages),
        covered: wp.array2d(dtype=wp.int32),
        sums: wp.array2d(dtype=SumsOfBlockers),
        chord_sums: wp.array2d(dtype=Lane),
        edges: wp.array2d(dtype=Lane),
        numbers: wp.array3d(dtype=wp.int32),
        adj_sums: wp.array2d(dtype=SumsOfBlockers),
        adj_edges: wp.array2d(dtype=Lane),
        # out
        adj_points: wp.array2d(dtype=wp.vec3),
        # sums
        adj_corners: wp.array2d(dtype=wp.vec3),
    ):
        """A thread owns a block of receivers; cells that are covered wholly have no gradient."""
        row = first_row + wp.tid()
        task = prepare_block(row, worker, inputs, coverage, covered, sums, chord_sums, edges, numbers)
        task.silhouette.adj_edges = adj_edges[task.slot]
        parts, radius = inputs.parts, inputs.radius
        cover_by_all_pieces(inputs, task)
        load_columns(adj_result[task.batch], task.block, task.coverage)
        for q in range(task.coverage.shape[0]):
            adj_sums[task.slot, q] = SumsOfBlockers()
            if is_any_above(task.sums[q].total, 0.0):
                adj_sums[task.slot, q] = joint_coverage_adjoint(task.sums[q], task.coverage[q])
            task.coverage[q] = Coverages()
        silhouette = task.silhouette
        adj_point = Vectors()
        for piece in range(parts.first_part.shape[0] - 1):
            covered_count = int(0)
            if parts.bodies[piece] != inputs.skip and parts.blocks[piece] == 1:
                covered_count = cover_by_piece(inputs, piece, task)
            affected_count = int(0)
            for k in range(covered_count):
                q = task.covered[k]
                adj = adj_sums[task.slot, q]
                adj_coverage = blocker_adjoint(task.sums[q], adj, task.coverage[q])
                # of equal ones, as the front and the back of a mug at its outline, the first is the largest
                difference = task.sums[q].largest - task.coverage[q].share
                adj.largest = wp.cw_mul(adj.largest, is_positive(wp.max(difference, -difference)))
                adj_sums[task.slot, q] = adj
                task.coverage[q] = adj_coverage
                if is_any(adj_coverage):
                    task.covered[affected_count] = q
                    affected_count += 1
            if affected_count > 0:
                for part in range(parts.first_part[piece], parts.first_part[piece + 1]):
                    bound = find_bound(inputs, part, task)
                    is_found = bool(False)
                    for k in range(affected_count):
                        q = task.covered[k]
                        direction = inputs.cells.directions[q]
                        reach = find_reach(task, bound, direction)
                        if is_any_above(reach, 0.0):
                            if not is_found:
                                count, is_solid = find_silhouette(parts, part, silhouette)
                                silhouette.count = count
                                silhouette.is_solid = is_solid
                                is_found = True
                                for i in range(ADJOINT_STRIDE * count):
                                    silhouette.adj_edges[i] = Lane(0.0)
                            factor = parts.signs[part] * is_positive(reach)
                            adj_cell = Coverages(
                                wp.cw_mul(factor, task.coverage[q].share), scale(factor, task.coverage[q].moment)
                            )
                            coverage_adjoint(parts, silhouette, direction, radius, adj_cell)
                    if is_found:
                        adj_point = add(adj_point, silhouette_adjoint(parts, silhouette, task.instance, adj_corners))
                for k in range(affected_count):
                    task.coverage[task.covered[k]] = Coverages()
        if adj_points:
            add_vectors(adj_point, task.block, adj_points[task.batch])

    return cover_cells_adjoint


def part_coverage(
    points: wp.array,
    placed_parts: PlacedParts,
    blockers: ConvexBlockers,
    directions: np.ndarray,
    *,
    radius: float | None = None,
    horizon_normals: wp.array | None = None,
    skip: int | None = None,
    on_surface: bool = False,
) -> wp.array:
    """Coverage (h, μ) of cells by the convex parts of bodies.

    Args:
        points: Receivers [scene units], vec3 of shape [batch, receiver].
        placed_parts: Where the parts are, from :meth:`.ConvexBlockers.place`; the batch may be 1.
        blockers: The bodies.
        directions: Unit vectors ω of the cells, NumPy of shape [direction, 3].
        radius: Of cells that do not tile the sphere [rad]; by default that of so many even ones, which do.
        horizon_normals: Normals, vec3 of shape [batch, receiver]: nothing blocks cells below the horizon.
        skip: Number of the body that the receivers are part of, which blocks none of their light; None for none.
        on_surface: Whether receivers lie on the parts, which are those of one body, and have ``horizon_normals``: a
            part blocks no light of receivers that lie on a face of it and look out, nor below their tangent planes.

    Returns:
        vec4 of shape [batch, receiver, direction], for :func:`warpshadow.stages.joint_coverage.transmittance_past`.

    Differentiable: points, placed_parts. Not: horizon_normals, which decides by steps.
    """
    check.shape("points", points.shape, ("batch", "receiver"))
    check.shape("directions", directions.shape, ("direction", 3))
    if skip is not None:
        check.choice("skip", skip, range(blockers.body_count))
    points = expand(points, common_batch({"points": points, "corners": placed_parts.corners}))
    inputs = PartInputs()
    inputs.points, inputs.parts, inputs.cells = points, blockers.arrays, make_cells(directions, SOFTNESS, points.device)
    if horizon_normals is not None:
        inputs.horizon_normals = horizon_normals
    inputs.corners, inputs.face_planes, inputs.bounds = placed_parts
    inputs.radius = cell_radius(len(directions)) if radius is None else radius
    inputs.skip = -1 if skip is None else skip
    inputs.on_surface = on_surface
    lanes = lane_count(points.device)
    Lane, sums, edge_count = lane_type(lanes), sums_type(lanes), blockers.edge_count
    by_cell = (len(directions),)
    cost = _PART_COST * lanes * placed_parts.bounds.shape[1]
    return launch_with_adjoint(
        _make_cover(lanes),
        lambda: _make_cover_adjoint(lanes),
        points.shape[0] * block_count(points.shape[1], lanes),
        inputs=[inputs],
        result=empty((*points.shape, len(directions)), dtype=wp.vec4, device=points.device),
        variables=[points],
        shared=[placed_parts.corners],
        scratch=[
            *(Scratch(by_cell, dtype) for dtype in (coverage_type(lanes), wp.int32, sums)),
            Scratch((SUM_LANES,), Lane),
            Scratch((EDGE_LANES * edge_count,), Lane),
            Scratch((2, edge_count), wp.int32),
        ],
        adj_scratch=[Scratch(by_cell, sums), Scratch((ADJOINT_LANES * edge_count,), Lane)],
        cost=cost,
        adj_cost=3 * cost,
    )
