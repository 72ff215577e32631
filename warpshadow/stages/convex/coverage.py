"""Coverage of cells by convex blockers, such as boxes and rods.

Edges are exact, and so are thin parts: spheres bulge out of them. The parts of a body cover h_q = Σ_parts h, with the
moment Σ_parts μ, of cell q: h and μ are the coverage by the silhouette of a convex part
(:mod:`warpshadow.stages.cell_coverage`), the edges between a face that a receiver sees and one that it does not. Parts
of one piece cover different parts of a cell, but for the seams of prisms into which it is cut, which both cover where
seen at a slant: these are taken off. :mod:`warpshadow.stages.joint_coverage` tells how pieces relate.

Pieces that stand side by side, such as slats, are a compound [Coumans 2003, Bullet: compound shapes] if their body has
a hull (:mod:`warpshadow.maths.hull`). Their shares add up to no more than their convex hull covers,

    h_q = min(Σ_parts h, h_hull)

with the moment of the smaller. If the pieces were blockers of their own, 14 strips that touch would let 9% of a
window's light through, and a room behind a blind would be 24% off instead of 6%.
"""

import functools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import warp as wp

from warpshadow import check
from warpshadow.device.batch import common_batch, expand, instance_in
from warpshadow.device.lanes import lane_count, lane_type, make_lane_functions, module_options, vectors_type
from warpshadow.device.launch import launch_with_adjoint
from warpshadow.device.memory import empty
from warpshadow.device.parallel import Scratch, scratch_slot
from warpshadow.maths.directions import BUNDLE, cell_radius
from warpshadow.stages.convex.convex_blockers import ConvexBlockers, PlacedParts
from warpshadow.stages.convex.joint_lanes import coverage_type, make_joint_functions, sums_type
from warpshadow.stages.convex.part_bounds import (
    PartInputs,
    make_bound_functions,
    parts_scratch,
    scratch_type,
    task_type,
)
from warpshadow.stages.convex.silhouette import ADJOINT_LANES, make_silhouette_functions
from warpshadow.stages.receivers.body_spans import Span, make_find_span, receiver_spans, span_values, value_of_span
from warpshadow.stages.visibility.culling import make_cells
from warpshadow.stages.visibility.directional import SOFTNESS

_PART_COST = 200.0  # mean time of a part of a receiver [ns]


class _PartFunctions(NamedTuple):
    """Kernel functions on compounds: the pieces of a body with a hull are one; any other piece is one by itself."""

    prepare_block: wp.Function
    is_blocking: wp.Function
    cover_by_compound: wp.Function
    cover_by_all_compounds: wp.Function


@functools.cache
def _make_part_functions(lanes: int) -> _PartFunctions:
    """Make the kernel functions for a number of lanes."""
    Lane = lane_type(lanes)
    PartsTask, PartsScratch, Coverages = task_type(lanes), scratch_type(lanes), coverage_type(lanes)
    fn, silhouettes, joint = make_lane_functions(lanes), make_silhouette_functions(lanes), make_joint_functions(lanes)
    is_any_above, dot, scale, add, is_positive = fn.is_any_above, fn.dot, fn.scale, fn.add, fn.is_positive
    load, find_span = fn.load, make_find_span(lanes)
    find_bound, reaches_bundle, find_reach = make_bound_functions(lanes)
    find_silhouette, find_coverage = silhouettes.find_silhouette, silhouettes.find_coverage
    no_blockers, with_blocker = joint.no_blockers, joint.with_blocker

    @wp.func
    def prepare_block(row: int, worker: int, inputs: PartInputs, scratch: PartsScratch):
        """Load a block of receivers; nothing is covered yet."""
        block = find_span(inputs.spans, row)
        slot, instance = scratch_slot(worker, row), instance_in(block.batch, inputs.corners.shape[0])
        task = PartsTask()
        task.block = block
        task.self_body = value_of_span(inputs.self_bodies, block.span)
        task.slot = slot
        task.instance = instance
        task.bounds = inputs.bounds[instance]
        task.points = load(inputs.points[block.batch][block.first : block.end], block.number)
        if inputs.horizon_normals:
            task.normals = load(inputs.horizon_normals[block.batch][block.first : block.end], block.number)
        task.lift = Lane(1.0) - is_positive(dot(task.normals, task.normals))
        task.coverage = scratch.coverage[slot]
        task.hull_weight = scratch.hull_weight[slot]
        task.covered = scratch.covered[slot]
        task.sums = scratch.sums[slot]
        task.silhouette.points = task.points
        task.silhouette.corners = inputs.corners[instance]
        task.silhouette.face_planes = inputs.face_planes[instance]
        task.silhouette.facing = scratch.facing[slot]
        task.silhouette.numbers = scratch.numbers[slot]
        task.silhouette.edges = scratch.edges[slot]
        task.silhouette.sums = scratch.chord_sums[slot]
        for q in range(task.coverage.shape[0]):
            task.coverage[q] = Coverages()
            task.sums[q] = no_blockers()
        return task

    @wp.func
    def is_blocking(inputs: PartInputs, compound: int, self_body: int):
        """Whether a compound blocks light of the receivers."""
        piece = inputs.parts.first_piece[compound]
        return inputs.parts.bodies[piece] != self_body and inputs.parts.blocks[piece] == 1

    @wp.func
    def bound_by_hull(inputs: PartInputs, hull: int, task: PartsTask, covered_count: int):
        """Replace the coverage by the parts of a compound in cells that its hull covers less; mark these cells."""
        bound = find_bound(inputs, hull, task)
        silhouette = task.silhouette
        count, is_solid = find_silhouette(inputs.parts, hull, silhouette)
        silhouette.count = count
        silhouette.is_solid = is_solid
        for k in range(covered_count):
            q = task.covered[k]
            direction = inputs.cells.directions[q]
            by_parts = task.coverage[q]
            by_hull = find_coverage(inputs.parts, silhouette, direction, inputs.radius)
            is_reached = is_positive(find_reach(task, bound, direction))  # not where the receiver lies on the hull
            hull_weight = wp.cw_mul(is_reached, is_positive(by_parts.cell_share - by_hull.cell_share))
            parts_weight = Lane(1.0) - hull_weight
            task.hull_weight[q] = hull_weight
            task.coverage[q] = Coverages(
                wp.cw_mul(parts_weight, by_parts.cell_share) + wp.cw_mul(hull_weight, by_hull.cell_share),
                add(scale(parts_weight, by_parts.moment), scale(hull_weight, by_hull.moment)),
            )

    @wp.func
    def cover_by_compound(inputs: PartInputs, compound: int, task: PartsTask):
        """Find the cells that a compound covers, and how; ``task.covered`` lists them. Return their number."""
        parts, cells, radius = inputs.parts, inputs.cells, inputs.radius
        first = parts.first_part[parts.first_piece[compound]]
        end = parts.first_part[parts.first_piece[compound + 1]]
        covered_count = int(0)
        silhouette = task.silhouette
        max_sum = wp.where(parts.signs[end - 1] < 0.0, 1.0e30, 1.0)  # seams, subtracted later, bring a sum above 1 back
        for part in range(first, end):
            bound = find_bound(inputs, part, task)
            sign = parts.signs[part]
            if is_any_above(bound.rise, 0.0):
                is_found = bool(False)
                for bundle in range(cells.axes.shape[0]):
                    if reaches_bundle(bound, cells.axes[bundle], cells.half_angles[bundle]):
                        for q in range(bundle * BUNDLE, (bundle + 1) * BUNDLE):
                            direction = cells.directions[q]
                            covered_share = task.coverage[q].cell_share
                            remaining_share = wp.min(Lane(max_sum) - covered_share, Lane(1.0) - task.sums[q].largest)
                            if sign < 0.0:
                                remaining_share = wp.min(remaining_share, covered_share)  # prisms cover the same cells
                            effect = wp.min(find_reach(task, bound, direction), remaining_share)
                            if is_any_above(effect, 0.0):
                                if not is_found:
                                    count, is_solid = find_silhouette(parts, part, silhouette)
                                    silhouette.count = count
                                    silhouette.is_solid = is_solid
                                    is_found = True
                                by_part = find_coverage(parts, silhouette, direction, radius)
                                is_affected = is_positive(effect)
                                if is_any_above(wp.cw_mul(is_affected, by_part.cell_share), 0.0):
                                    if not is_any_above(covered_share, 0.0):
                                        task.covered[covered_count] = q
                                        covered_count += 1
                                    factor = sign * is_affected
                                    task.coverage[q] = Coverages(
                                        covered_share + wp.cw_mul(factor, by_part.cell_share),
                                        add(task.coverage[q].moment, scale(factor, by_part.moment)),
                                    )
        if covered_count > 0 and parts.hulls[compound] >= 0:
            bound_by_hull(inputs, parts.hulls[compound], task, covered_count)
        return covered_count

    @wp.func
    def cover_by_all_compounds(inputs: PartInputs, task: PartsTask):
        """Store sums over all compounds for each cell."""
        for compound in range(inputs.parts.hulls.shape[0]):
            if is_blocking(inputs, compound, task.self_body):
                covered_count = cover_by_compound(inputs, compound, task)
                for k in range(covered_count):
                    q = task.covered[k]
                    task.sums[q] = with_blocker(task.sums[q], task.coverage[q])
                    task.coverage[q] = Coverages()

    return _PartFunctions(prepare_block, is_blocking, cover_by_compound, cover_by_all_compounds)


@functools.cache
def _make_cover(lanes: int) -> wp.Kernel:
    PartsScratch = scratch_type(lanes)
    fn, functions, joint = make_lane_functions(lanes), _make_part_functions(lanes), make_joint_functions(lanes)
    is_any_above, joint_coverage, store_columns = fn.is_any_above, joint.joint_coverage, joint.store_columns
    prepare_block, _, _, cover_by_all_compounds = functions

    @wp.kernel(module="unique", module_options=module_options(lanes), enable_backward=False)
    def cover_cells(
        first_row: int,
        worker: int,
        # in
        inputs: PartInputs,
        # scratch
        scratch: PartsScratch,
        # out
        result: wp.array3d(dtype=wp.vec4),
    ):
        """A thread owns a block of receivers."""
        row = first_row + wp.tid()
        task = prepare_block(row, worker, inputs, scratch)
        cover_by_all_compounds(inputs, task)
        for q in range(task.coverage.shape[0]):
            if is_any_above(task.sums[q].total, 0.0):
                task.coverage[q] = joint_coverage(task.sums[q])
        block = task.block
        store_columns(task.coverage, block.number, result[block.batch][block.first : block.end])

    return cover_cells


@functools.cache
def _make_cover_adjoint(lanes: int) -> wp.Kernel:
    Lane, Vectors, PartsScratch = lane_type(lanes), vectors_type(lanes), scratch_type(lanes)
    Coverages, SumsOfBlockers = coverage_type(lanes), sums_type(lanes)
    fn, functions, joint = make_lane_functions(lanes), _make_part_functions(lanes), make_joint_functions(lanes)
    is_any_above, is_positive, scale = fn.is_any_above, fn.is_positive, fn.scale
    add, add_vectors = fn.add, fn.add_vectors
    joint_coverage_adjoint, blocker_adjoint = joint.joint_coverage_adjoint, joint.blocker_adjoint
    load_columns = joint.load_columns
    prepare_block, is_blocking, cover_by_compound, cover_by_all_compounds = functions
    find_bound, _, find_reach = make_bound_functions(lanes)
    find_silhouette, _find_coverage, coverage_adjoint, silhouette_adjoint = make_silhouette_functions(lanes)
    ADJOINT_STRIDE = wp.constant(ADJOINT_LANES)

    @wp.func(inline=True)
    def is_any(coverage: Coverages):
        """Whether any number of the coverage is not 0."""
        moment = coverage.moment
        highest = wp.max(wp.max(coverage.cell_share, moment.x), wp.max(moment.y, moment.z))
        lowest = wp.min(wp.min(coverage.cell_share, moment.x), wp.min(moment.y, moment.z))
        return is_any_above(wp.max(highest, -lowest), 0.0)

    @wp.kernel(module="unique", module_options=module_options(lanes), enable_backward=False)
    def cover_cells_adjoint(
        first_row: int,
        worker: int,
        # in
        inputs: PartInputs,
        adj_result: wp.array3d(dtype=wp.vec4),
        # scratch
        scratch: PartsScratch,
        adj_sums: wp.array2d(dtype=SumsOfBlockers),
        adj_edges: wp.array2d(dtype=Lane),
        # out
        adj_points: wp.array2d(dtype=wp.vec3),
        # sums
        adj_corners: wp.array2d(dtype=wp.vec3),
    ):
        """A thread owns a block of receivers; cells that are covered wholly have no gradient."""
        row = first_row + wp.tid()
        task = prepare_block(row, worker, inputs, scratch)
        task.silhouette.adj_edges = adj_edges[task.slot]
        parts, radius = inputs.parts, inputs.radius
        cover_by_all_compounds(inputs, task)
        block = task.block
        load_columns(adj_result[block.batch][block.first : block.end], block.number, task.coverage)
        for q in range(task.coverage.shape[0]):
            adj_sums[task.slot, q] = SumsOfBlockers()
            if is_any_above(task.sums[q].total, 0.0):
                adj_sums[task.slot, q] = joint_coverage_adjoint(task.sums[q], task.coverage[q])
            task.coverage[q] = Coverages()
        silhouette = task.silhouette
        adj_point = Vectors()
        for compound in range(parts.hulls.shape[0]):
            covered_count = int(0)
            if is_blocking(inputs, compound, task.self_body):
                covered_count = cover_by_compound(inputs, compound, task)
            affected_count = int(0)
            for k in range(covered_count):
                q = task.covered[k]
                adj = adj_sums[task.slot, q]
                adj_coverage = blocker_adjoint(task.sums[q], adj, task.coverage[q])
                # one blocker has the gradient of max h: of equal ones, as both sides of a mug at its outline, the first
                difference = task.sums[q].largest - task.coverage[q].cell_share
                adj.largest = wp.cw_mul(adj.largest, is_positive(wp.max(difference, -difference)))
                adj_sums[task.slot, q] = adj
                task.coverage[q] = adj_coverage
                if is_any(adj_coverage):
                    task.covered[affected_count] = q
                    affected_count += 1
            if affected_count > 0:
                first = parts.first_part[parts.first_piece[compound]]
                end = parts.first_part[parts.first_piece[compound + 1]]
                hull = parts.hulls[compound]
                for number in range(first, end + wp.where(hull < 0, 0, 1)):
                    part = wp.where(number < end, number, hull)
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
                                for i in range(ADJOINT_STRIDE * silhouette.count):
                                    silhouette.adj_edges[i] = Lane(0.0)
                            factor = parts.signs[part] * is_positive(reach)
                            if hull >= 0:
                                hull_weight = task.hull_weight[q]
                                weight = wp.where(number < end, Lane(1.0) - hull_weight, hull_weight)
                                factor = wp.cw_mul(factor, weight)
                            adj_cell = Coverages(
                                wp.cw_mul(factor, task.coverage[q].cell_share), scale(factor, task.coverage[q].moment)
                            )
                            coverage_adjoint(parts, silhouette, direction, radius, adj_cell)
                    if is_found:
                        adj_point = add(adj_point, silhouette_adjoint(parts, silhouette, task.instance, adj_corners))
                for k in range(affected_count):
                    task.coverage[task.covered[k]] = Coverages()
        if adj_points:
            add_vectors(adj_point, block.number, adj_points[block.batch][block.first : block.end])

    return cover_cells_adjoint


def part_coverage(
    points: wp.array,
    placed_parts: PlacedParts,
    blockers: ConvexBlockers,
    directions: np.ndarray,
    *,
    radius: float | None = None,
    horizon_normals: wp.array | None = None,
    body_spans: Sequence[Span] = (),
    self_bodies: Sequence[int] = (-1,),
    on_surface: bool = False,
) -> wp.array:
    """Coverage (h, μ) of cells by the convex parts of bodies.

    Args:
        points: Receivers [scene units], vec3 of shape [batch, receiver].
        placed_parts: Where the parts are, from :meth:`.ConvexBlockers.place`; the batch may be 1.
        directions: Unit vectors ω of the cells, NumPy of shape [direction, 3].
        radius: Of cells that do not tile the sphere [rad]; by default that of so many even ones, which do.
        horizon_normals: Normals, vec3 of shape [batch, receiver]: nothing blocks cells below the horizon.
        body_spans: Of the receivers, by body; () for one of all.
        self_bodies: Number of each span's body among the blockers, which blocks none of its light; −1 for none.
        on_surface: Whether receivers lie on the parts, which are those of one body, and have ``horizon_normals``: a
            part blocks no light of receivers that lie on a face of it and look out, nor below their tangent planes.

    Returns:
        vec4 of shape [batch, receiver, direction], for :func:`warpshadow.stages.joint_coverage.transmittance_past`.

    Differentiable: points, placed_parts. Not: horizon_normals, which decides by steps.
    """
    check.shape("points", points.shape, ("batch", "receiver"))
    check.shape("directions", directions.shape, ("direction", 3))
    for self_body in self_bodies:
        check.choice("self_bodies", self_body, range(-1, blockers.body_count))
    points = expand(points, common_batch({"points": points, "corners": placed_parts.corners}))
    inputs = PartInputs()
    inputs.points, inputs.parts, inputs.cells = points, blockers.arrays, make_cells(directions, SOFTNESS, points.device)
    if horizon_normals is not None:
        inputs.horizon_normals = horizon_normals
    inputs.corners, inputs.face_planes, inputs.bounds = placed_parts
    inputs.radius = cell_radius(len(directions)) if radius is None else radius
    inputs.spans = receiver_spans(body_spans, points.shape[1], lane_count(points.device), points.device)
    inputs.self_bodies = span_values(self_bodies, points.device)
    inputs.on_surface = on_surface
    lanes = lane_count(points.device)
    edge_count = blockers.edge_count
    cost = _PART_COST * lanes * placed_parts.bounds.shape[1]
    return launch_with_adjoint(
        _make_cover(lanes),
        lambda: _make_cover_adjoint(lanes),
        points.shape[0] * inputs.spans.block_count,
        inputs=[inputs],
        result=empty((*points.shape, len(directions)), dtype=wp.vec4, device=points.device),
        variables=[points],
        shared=[placed_parts.corners],
        scratch=[parts_scratch(lanes, len(directions), edge_count)],
        adj_scratch=[
            Scratch((len(directions),), sums_type(lanes)),
            Scratch((ADJOINT_LANES * edge_count,), lane_type(lanes)),
        ],
        cost=cost,
        adj_cost=3 * cost,
    )
