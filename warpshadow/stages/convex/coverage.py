"""Coverage of cells by convex blockers, such as boxes and rods.

Each body covers h_q = Σ_parts h, with the moment Σ_parts μ, of cell q: h and μ are the coverage by the silhouette of a
convex part (:mod:`warpshadow.stages.cell_coverage`), the edges between a face that a receiver sees and one that it does
not. Parts of one body are beside each other, so they cover different parts of a cell. Prisms into which a body is cut
both cover their seam, the face between them, where they are seen at a slant: it is taken off. How bodies are to each
other, :mod:`.joint_coverage` tells. Edges are exact, and so are thin parts: spheres bulge out of them.
"""

import numpy as np
import warp as wp

from warpshadow import check
from warpshadow.device.batch import common_batch, expand, instance_in
from warpshadow.device.launch import differentiable, launch
from warpshadow.device.parallel import Scratch, scratch_slot, split_row
from warpshadow.maths.directions import BUNDLE, cell_radius
from warpshadow.stages.cell_coverage import ViewedEdge, convex_coverage, coverage_adjoint, viewed_edge
from warpshadow.stages.convex.prepared import ConvexArrays, ConvexBlockers, PlacedParts
from warpshadow.stages.joint_coverage import (
    BlockerSums,
    blocker_adjoint,
    joint_coverage,
    joint_coverage_adjoint,
    no_blockers,
    with_blocker,
)
from warpshadow.stages.planes.coverage import horizon_normal, is_above_horizon
from warpshadow.stages.visibility.culling import DirectionCells, make_cells
from warpshadow.stages.visibility.directional import SOFTNESS

_PART_COST = 300.0
"""Mean time of a part of a receiver [ns]."""

_UNKNOWN_COUNT = wp.constant(-2)
"""Number of edges of a silhouette that is not found yet."""

_BOUND_MARGIN = wp.constant(1.001)
"""Bounds are so much larger, for rounding."""

_MIN_EDGE_SINE = wp.constant(1.0e-6)
"""Sine of the least angle under which a receiver sees an edge."""


@wp.func
def _find_silhouette(
    point: wp.vec3,
    corners: wp.array(dtype=wp.vec3),
    planes: wp.array(dtype=wp.vec4),
    parts: ConvexArrays,
    part: int,
    silhouette: wp.array(dtype=ViewedEdge),
):
    """Store a part's silhouette.

    Returns how many edges it has, 0 for a tiny one or a polygon from the side, −1 for a receiver inside the part.
    """
    first_face = parts.first_face[part]
    facing_bits = wp.uint64(0)
    for face in range(first_face, parts.first_face[part + 1]):
        plane = planes[face]
        if plane[0] * point[0] + plane[1] * point[1] + plane[2] * point[2] > plane[3]:
            facing_bits = facing_bits | (wp.uint64(1) << wp.uint64(face - first_face))
    if facing_bits == wp.uint64(0):
        return wp.where(parts.first_face[part + 1] - first_face > 2, -1, 0)
    count = int(0)
    for e in range(parts.first_edge[part], parts.first_edge[part + 1]):
        edge = parts.edges[e]
        is_left = ((facing_bits >> wp.uint64(edge[2])) & wp.uint64(1)) == wp.uint64(1)
        is_right = ((facing_bits >> wp.uint64(edge[3])) & wp.uint64(1)) == wp.uint64(1)
        if is_left != is_right:
            # the part is to the left of its faces' edges as they are seen
            begin = wp.where(is_left, edge[1], edge[0])
            end = wp.where(is_left, edge[0], edge[1])
            a = corners[begin] - point
            b = corners[end] - point
            n = wp.cross(a, b)
            if wp.length_sq(n) > _MIN_EDGE_SINE * _MIN_EDGE_SINE * wp.length_sq(a) * wp.length_sq(b):
                seen_edge = viewed_edge(a, b, n)
                seen_edge.corners = wp.vec2i(begin, end)
                silhouette[count] = seen_edge
                count += 1
    return wp.where(count < 3, 0, count)  # fewer enclose nothing


@wp.func
def _silhouette_adjoint(
    silhouette: wp.array(dtype=ViewedEdge), count: int, instance: int, adj_corners: wp.array2d(dtype=wp.vec3)
):
    """Add to the gradients of corners; returns that of the receiver."""
    adj_point = wp.vec3()
    for e in range(count):
        seen_edge = silhouette[e]
        adj_n = seen_edge.adj_normal / seen_edge.length
        adj_a = wp.cross(seen_edge.end, adj_n)
        adj_b = wp.cross(adj_n, seen_edge.begin)
        adj_point -= adj_a + adj_b
        if adj_corners:
            wp.atomic_add(adj_corners, instance, seen_edge.corners[0], adj_a)
            wp.atomic_add(adj_corners, instance, seen_edge.corners[1], adj_b)
    return adj_point


@wp.struct
class PartBound:
    """The cone around a part, as a receiver sees it."""

    is_seen: wp.bool  # whether some of it is above the horizon
    axis: wp.vec3
    cosine: float  # of its half-angle and that of a cell together, and sine
    sine: float


@wp.func
def _find_bound(point: wp.vec3, normal: wp.vec3, bound: wp.vec4, radius: float):
    """Find the cone around a part, widened by the radius of cells."""
    part_bound = PartBound()
    away = wp.vec3(bound[0], bound[1], bound[2]) - point
    part_bound.is_seen = wp.dot(normal, away) > -bound[3] or wp.length_sq(normal) == 0.0
    distance2 = wp.length_sq(away)
    part_bound.cosine = -1.0
    if distance2 > bound[3] * bound[3]:
        distance = wp.sqrt(distance2)
        part_bound.axis = away / distance
        sine = _BOUND_MARGIN * bound[3] / distance
        cosine = wp.sqrt(wp.max(0.0, 1.0 - sine * sine))
        scale = 1.0 / wp.sqrt(1.0 + radius * radius)
        part_bound.cosine = (cosine - sine * radius) * scale
        part_bound.sine = (sine + cosine * radius) * scale
    return part_bound


@wp.func
def _reaches(bound: PartBound, axis: wp.vec3, half_angle: wp.vec2):
    """Whether the cone around a part reaches that of a bundle."""
    # as far as π together, else all does
    cosine = bound.cosine * half_angle[0] - bound.sine * half_angle[1]
    is_wide = bound.sine * half_angle[0] + bound.cosine * half_angle[1] <= 0.0
    return is_wide or wp.dot(axis, bound.axis) > cosine


@wp.func
def _find_coverage(
    point: wp.vec3,
    normal: wp.vec3,
    corners: wp.array(dtype=wp.vec3),
    planes: wp.array(dtype=wp.vec4),
    bounds: wp.array(dtype=wp.vec4),
    parts: ConvexArrays,
    body: int,
    cells: DirectionCells,
    radius: float,
    largest: wp.array(dtype=wp.float32),
    silhouette: wp.array(dtype=ViewedEdge),
    coverage: wp.array(dtype=wp.vec4),
    covered_cells: wp.array(dtype=wp.int32),
):
    """Coverage by a body of cells that no other body covers wholly; returns how many it covers, and lists them."""
    covered_count = int(0)
    enough = wp.where(parts.signs[parts.first_part[body + 1] - 1] < 0.0, 1.0e30, 1.0)  # seams take off
    for part in range(parts.first_part[body], parts.first_part[body + 1]):
        bound = _find_bound(point, normal, bounds[part], radius)
        if bound.is_seen:
            count = int(_UNKNOWN_COUNT)
            for bundle in range(cells.axes.shape[0]):
                if _reaches(bound, cells.axes[bundle], cells.half_angles[bundle]):
                    for q in range(bundle * BUNDLE, (bundle + 1) * BUNDLE):
                        direction = cells.directions[q]
                        if (
                            wp.dot(bound.axis, direction) > bound.cosine
                            and largest[q] < 1.0
                            and coverage[q][0] < enough
                            and is_above_horizon(normal, direction)
                        ):
                            if count == _UNKNOWN_COUNT:
                                count = _find_silhouette(point, corners, planes, parts, part, silhouette)
                            by_part = wp.vec4(1.0, 0.0, 0.0, 0.0)
                            if count >= 0:
                                by_part = convex_coverage(silhouette, 0, count, direction, radius)
                            if by_part[0] > 0.0:
                                if coverage[q][0] == 0.0:  # not by a seam, whose prisms cover the same cells
                                    covered_cells[covered_count] = q
                                    covered_count += 1
                                coverage[q] = coverage[q] + parts.signs[part] * by_part
    return covered_count


@wp.func
def _find_blocker_sums(
    point: wp.vec3,
    normal: wp.vec3,
    corners: wp.array(dtype=wp.vec3),
    planes: wp.array(dtype=wp.vec4),
    bounds: wp.array(dtype=wp.vec4),
    parts: ConvexArrays,
    skip: int,
    cells: DirectionCells,
    radius: float,
    silhouette: wp.array(dtype=ViewedEdge),
    largest: wp.array(dtype=wp.float32),
    coverage: wp.array(dtype=wp.vec4),
    covered_cells: wp.array(dtype=wp.int32),
    sums: wp.array(dtype=BlockerSums),
):
    """Store sums over all bodies for each cell."""
    for q in range(cells.directions.shape[0]):
        largest[q] = 0.0
        coverage[q] = wp.vec4()
        sums[q] = no_blockers()
    for body in range(parts.first_part.shape[0] - 1):
        if body != skip and parts.blocks[body] == 1:
            covered_count = _find_coverage(
                point,
                normal,
                corners,
                planes,
                bounds,
                parts,
                body,
                cells,
                radius,
                largest,
                silhouette,
                coverage,
                covered_cells,
            )
            for k in range(covered_count):
                q = covered_cells[k]
                sums[q] = with_blocker(sums[q], coverage[q])
                largest[q] = sums[q].largest
                coverage[q] = wp.vec4()


@wp.kernel(enable_backward=False)
def _find_joint_coverage(
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
    silhouettes: wp.array2d(dtype=ViewedEdge),
    largest: wp.array2d(dtype=wp.float32),
    coverages: wp.array2d(dtype=wp.vec4),
    covered_cells: wp.array2d(dtype=wp.int32),
    sums: wp.array2d(dtype=BlockerSums),
    # out
    joint_coverages: wp.array3d(dtype=wp.vec4),
):
    """A thread owns a receiver."""
    row = first_row + wp.tid()
    batch, receiver = split_row(row, points.shape[1])
    slot = scratch_slot(worker, row)
    corner_batch = instance_in(batch, corners.shape[0])
    _find_blocker_sums(
        points[batch, receiver],
        horizon_normal(horizon_normals, batch, receiver),
        corners[corner_batch],
        planes[corner_batch],
        bounds[corner_batch],
        parts,
        skip,
        cells,
        radius,
        silhouettes[slot],
        largest[slot],
        coverages[slot],
        covered_cells[slot],
        sums[slot],
    )
    for q in range(cells.directions.shape[0]):
        joint_coverages[batch, receiver, q] = joint_coverage(sums[slot, q])


@wp.kernel(enable_backward=False)
def _find_joint_coverage_adjoint(
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
    adj_joint_coverages: wp.array3d(dtype=wp.vec4),
    # scratch
    silhouettes: wp.array2d(dtype=ViewedEdge),
    largest: wp.array2d(dtype=wp.float32),
    coverages: wp.array2d(dtype=wp.vec4),
    covered_cells: wp.array2d(dtype=wp.int32),
    sums: wp.array2d(dtype=BlockerSums),
    adj_sums: wp.array2d(dtype=BlockerSums),
    # out
    adj_points: wp.array2d(dtype=wp.vec3),
    # sums
    adj_corners: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a receiver; cells that are covered wholly have no gradient."""
    row = first_row + wp.tid()
    batch, receiver = split_row(row, points.shape[1])
    slot = scratch_slot(worker, row)
    corner_batch = instance_in(batch, corners.shape[0])
    point, normal = points[batch, receiver], horizon_normal(horizon_normals, batch, receiver)
    _find_blocker_sums(
        point,
        normal,
        corners[corner_batch],
        planes[corner_batch],
        bounds[corner_batch],
        parts,
        skip,
        cells,
        radius,
        silhouettes[slot],
        largest[slot],
        coverages[slot],
        covered_cells[slot],
        sums[slot],
    )
    for q in range(cells.directions.shape[0]):
        if largest[slot, q] < 1.0:
            adj_sums[slot, q] = joint_coverage_adjoint(sums[slot, q], adj_joint_coverages[batch, receiver, q])
    adj_point = wp.vec3()
    for body in range(parts.first_part.shape[0] - 1):
        if body != skip and parts.blocks[body] == 1:
            covered_count = _find_coverage(
                point,
                normal,
                corners[corner_batch],
                planes[corner_batch],
                bounds[corner_batch],
                parts,
                body,
                cells,
                radius,
                largest[slot],
                silhouettes[slot],
                coverages[slot],
                covered_cells[slot],
            )
            for part in range(parts.first_part[body], parts.first_part[body + 1]):
                bound = _find_bound(point, normal, bounds[corner_batch, part], radius)
                if bound.is_seen and covered_count > 0:
                    count = int(_UNKNOWN_COUNT)
                    for k in range(covered_count):
                        q = covered_cells[slot, k]
                        direction = cells.directions[q]
                        if wp.dot(bound.axis, direction) > bound.cosine:
                            adj_coverage = parts.signs[part] * blocker_adjoint(
                                sums[slot, q], adj_sums[slot, q], coverages[slot, q]
                            )
                            if wp.length_sq(adj_coverage) > 0.0:
                                if count == _UNKNOWN_COUNT:
                                    count = _find_silhouette(
                                        point,
                                        corners[corner_batch],
                                        planes[corner_batch],
                                        parts,
                                        part,
                                        silhouettes[slot],
                                    )
                                coverage_adjoint(silhouettes[slot], 0, count, direction, radius, adj_coverage)
                    adj_point += _silhouette_adjoint(silhouettes[slot], wp.max(count, 0), corner_batch, adj_corners)
            for k in range(covered_count):
                coverages[slot, covered_cells[slot, k]] = wp.vec4()
    if adj_points:
        adj_points[batch, receiver] = adj_points[batch, receiver] + adj_point


def part_coverage(
    points: wp.array,
    placed_parts: PlacedParts,
    blockers: ConvexBlockers,
    directions: np.ndarray,
    *,
    radius: float | None = None,
    horizon_normals: wp.array | None = None,
    skip: int | None = None,
) -> wp.array:
    """Coverage (h, μ) of cells by the convex parts of bodies.

    Args:
        points: Receivers [scene units], vec3 of shape [batch, receiver].
        placed_parts: Where the parts are, from :meth:`.ConvexBlockers.placed`; the batch may be 1.
        blockers: The bodies.
        directions: Unit vectors ω of the cells, NumPy of shape [direction, 3].
        radius: Of cells that do not tile the sphere [rad]; by default that of so many even ones, which do.
        horizon_normals: Normals, vec3 of shape [batch, receiver]: nothing blocks cells below the horizon.
        skip: Number of the body that the receivers are part of, which blocks none of their light; None for none.

    Returns:
        vec4 of shape [batch, receiver, direction], for :func:`warpshadow.stages.joint_coverage.transmittance_past`.

    Differentiable: points, placed_parts. Not: horizon_normals, which decides by steps.
    """
    check.shape("points", points.shape, ("batch", "receiver"))
    check.shape("directions", directions.shape, ("direction", 3))
    if skip is not None:
        check.choice("skip", skip, range(blockers.body_count))
    points = expand(points, common_batch({"points": points, "corners": placed_parts.corners}))
    radius_of_cells = cell_radius(len(directions)) if radius is None else radius
    cells = make_cells(directions, SOFTNESS, points.device)
    inputs = [
        points,
        horizon_normals,
        *placed_parts,
        blockers.arrays,
        cells,
        radius_of_cells,
        -1 if skip is None else skip,
    ]
    cell_shape = (len(directions),)
    scratch = [
        Scratch((blockers.edge_count,), ViewedEdge),
        *(Scratch(cell_shape, dtype) for dtype in (wp.float32, wp.vec4, wp.int32, BlockerSums)),
    ]
    cost = _PART_COST * placed_parts.bounds.shape[1]
    return differentiable(
        lambda result: launch(
            _find_joint_coverage, points.size, inputs=inputs, outputs=[result], scratch=scratch, cost=cost
        ),
        lambda adj_joint_coverages: launch(
            _find_joint_coverage_adjoint,
            points.size,
            inputs=[*inputs, adj_joint_coverages],
            outputs=[points.grad],
            sums=[placed_parts.corners.grad],
            scratch=[*scratch, scratch[-1]],
            cost=3 * cost,
        ),
        result=wp.empty((*points.shape, len(directions)), dtype=wp.vec4, device=points.device),
        variables=[points, placed_parts.corners],
    )
