"""Coverage of cells by plane blockers, such as a ground or walls.

    h_q = Σ_k h_qk,  μ_q = Σ_k μ_qk

h_qk and μ_qk are the coverage of cell q by plane k (:mod:`warpshadow.stages.cell_coverage`). Plane blockers that share
a cell mostly meet in it, as walls do, and cover different parts of it. (A cow over a ground is 0.7% off in direct
light, with a large sphere in place of the plane 2.3%.)
"""

import numpy as np
import warp as wp

from warpshadow.device.batch import common_batch, expand, expand_rows, instance_in
from warpshadow.device.constants import constant
from warpshadow.device.launch import launch_with_adjoint
from warpshadow.device.memory import empty
from warpshadow.maths.directions import cell_radius
from warpshadow.stages.cell_coverage import ViewedEdge, coverage_adjoint
from warpshadow.stages.planes.cells import (
    PlaneArrays,
    PlaneFootprint,
    check_planes,
    fetch,
    fetch_adjoint,
    find_mip_footprint,
    is_covered_by_texels,
    plane_arrays,
)
from warpshadow.stages.planes.plane_blockers import PlaneBlockers
from warpshadow.stages.planes.sides import (
    PlaneInputs,
    PlaneReceiver,
    PlaneSide,
    StoredSide,
    VisibleCell,
    footprint_on_side,
    footprint_on_side_adjoint,
    load_side,
    outline_coverage_on_side,
    plane_inputs,
    prepare_receiver,
    prepare_receiver_adjoint,
    receiver_scratch,
    visible_cell,
)

_CELL_COST = 4.0  # mean time of a cell of a receiver [ns], over cells that hit a plane and cells that do not


@wp.struct
class PlaneCoverage:
    """Coverage of a cell by a side."""

    outline: wp.vec4  # (h, μ), by its outline
    mesh_share: float  # share of the outline that the mesh covers, by texels
    footprint: PlaneFootprint  # of these texels


@wp.func
def side_coverage(planes: PlaneArrays, side: PlaneSide, cell: VisibleCell, edges: wp.array(dtype=ViewedEdge)):
    """Coverage of a cell by a side."""
    coverage = PlaneCoverage()
    coverage.mesh_share = 1.0
    coverage.outline = outline_coverage_on_side(planes, side, cell, edges)
    if is_covered_by_texels(side.grid) and coverage.outline[0] > 0.0:
        coverage.footprint = footprint_on_side(planes, side, cell.direction)
        mip = find_mip_footprint(side.grid, planes, coverage.footprint)
        coverage.mesh_share = fetch(planes.covered, planes, side.grid.first_level, mip)[0]
    return coverage


@wp.func
def side_coverage_adjoint(
    planes: PlaneArrays, side: PlaneSide, cell: VisibleCell, adj_coverage: wp.vec4, receiver: PlaneReceiver
):
    """Add to the gradients of the local receiver, of the side's weight, and of viewed edges."""
    grid = side.grid
    coverage = PlaneCoverage()
    coverage.mesh_share = 1.0
    if side.weight < 1.0 or is_covered_by_texels(grid):
        coverage = side_coverage(planes, side, cell, receiver.edges)
        adj_weight = coverage.mesh_share * wp.dot(adj_coverage, coverage.outline) / side.weight
        receiver.sides[side.index].adj_weight = receiver.sides[side.index].adj_weight + adj_weight
    if is_covered_by_texels(grid) and coverage.outline[0] > 0.0:
        footprint = coverage.footprint
        adj_part = wp.vec3(wp.dot(adj_coverage, coverage.outline), 0.0, 0.0)
        mip = find_mip_footprint(grid, planes, footprint)
        adj_mip = fetch_adjoint(planes.covered, grid, planes, grid.first_level, footprint, mip, adj_part)
        footprint_on_side_adjoint(planes, side, cell.direction, footprint, adj_mip, receiver.sides)
    adj_outline = (side.weight * coverage.mesh_share) * adj_coverage
    coverage_adjoint(receiver.edges, side.first_edge, grid.edge_count, cell.direction, cell.radius, adj_outline)


@wp.func
def horizon_normal(horizon_normals: wp.array2d(dtype=wp.vec3), batch: int, receiver: int):
    """Receiver normal, or 0 to skip the horizon test."""
    if horizon_normals:
        return horizon_normals[instance_in(batch, horizon_normals.shape[0]), receiver]
    return wp.vec3()


@wp.func
def is_above_horizon(normal: wp.vec3, direction: wp.vec3):
    """Whether a direction is above the horizon of a normal; the normal 0 has none."""
    return wp.dot(normal, direction) > 0.0 or wp.length_sq(normal) == 0.0


@wp.kernel(enable_backward=False)
def _find_coverage(
    first_row: int,
    worker: int,
    # in
    inputs: PlaneInputs,
    horizon_normals: wp.array2d(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    # scratch
    sides: wp.array2d(dtype=StoredSide),
    edges: wp.array2d(dtype=ViewedEdge),
    # out
    coverages: wp.array3d(dtype=wp.vec4),
):
    """A thread owns a receiver."""
    receiver = prepare_receiver(first_row + wp.tid(), worker, inputs, sides, edges)
    normal = horizon_normal(horizon_normals, receiver.batch, receiver.index)
    coverage = coverages[receiver.batch, receiver.index]
    for q in range(directions.shape[0]):
        coverage[q] = wp.vec4()
    for i in range(receiver.side_count):
        side = load_side(inputs.planes, receiver, i)
        if side.grid.blocks == 1:
            for q in range(directions.shape[0]):
                direction = directions[q]
                if is_above_horizon(normal, direction) and coverage[q][0] < 1.0:
                    cell = visible_cell(inputs.planes, normal, direction)
                    coverage_of_side = side_coverage(inputs.planes, side, cell, receiver.edges)
                    if coverage_of_side.outline[0] > 0.0:
                        coverage[q] = coverage[q] + coverage_of_side.mesh_share * coverage_of_side.outline


@wp.kernel(enable_backward=False)
def _find_coverage_adjoint(
    first_row: int,
    worker: int,
    # in
    inputs: PlaneInputs,
    horizon_normals: wp.array2d(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    adj_coverages: wp.array3d(dtype=wp.vec4),
    # scratch
    sides: wp.array2d(dtype=StoredSide),
    edges: wp.array2d(dtype=ViewedEdge),
    # out
    adj_points: wp.array2d(dtype=wp.vec3),
    adj_front_weights: wp.array3d(dtype=wp.float32),
    # sums
    adj_frames: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a receiver; cells that are covered wholly are taken to have no gradient."""
    receiver = prepare_receiver(first_row + wp.tid(), worker, inputs, sides, edges)
    normal = horizon_normal(horizon_normals, receiver.batch, receiver.index)
    for i in range(receiver.side_count):
        side = load_side(inputs.planes, receiver, i)
        if side.grid.blocks == 1:
            for q in range(directions.shape[0]):
                adj_coverage = adj_coverages[receiver.batch, receiver.index, q]
                if wp.length_sq(adj_coverage) > 0.0 and is_above_horizon(normal, directions[q]):
                    cell = visible_cell(inputs.planes, normal, directions[q])
                    side_coverage_adjoint(inputs.planes, side, cell, adj_coverage, receiver)
    prepare_receiver_adjoint(receiver, inputs, adj_points, adj_front_weights, adj_frames)


def plane_coverage(
    points: wp.array,
    frames: wp.array,
    planes: PlaneBlockers,
    directions: np.ndarray,
    *,
    radius: float | None = None,
    horizon_normals: wp.array | None = None,
    front_weights: wp.array | None = None,
    self_plane: int | None = None,
) -> wp.array | None:
    """Coverage (h, μ) of cells by the planes that cast shadows: an h of 1 and more need not be complete.

    Args:
        points: Receivers [scene units], vec3 of shape [batch, receiver].
        frames: Where the planes are, vec3 of shape [batch, 3 · plane], from :meth:`PlaneBlockers.frames`; the batch may
            be 1.
        directions: Unit vectors ω of the cells, NumPy of shape [direction, 3].
        radius: Of cells that do not tile the sphere [rad], how soft edges and horizons are; by default that of so many
            even ones, which do.
        horizon_normals: Normals, vec3 of shape [batch, receiver]: nothing covers cells below the horizon.
        front_weights: Part of the front of each plane that receivers see, from :func:`.fronts.find_fronts`, float32 of
            shape [batch, receiver, plane]; by default their heights decide.
        self_plane: Number of the plane that the receivers are part of, which blocks none of their light; None for none.
    Returns:
        vec4 of shape [batch, receiver, direction], for :func:`warpshadow.stages.joint_coverage.transmittance_past`; h
        is 1 or more where nothing passes. None where no plane casts a shadow on them.
    Differentiable: points, frames, front_weights. Not: horizon_normals, which decide by steps, and how much receivers
    in a plane see of a cell.
    """
    check_planes(planes, points, frames, directions, self_plane)
    count = common_batch({"points": points, "frames": frames, "front_weights": front_weights})
    points, front_weights = expand(points, count), None if front_weights is None else expand_rows(front_weights, count)
    radius_of_cells = cell_radius(len(directions)) if radius is None else radius
    arrays = plane_arrays(planes, radius_of_cells, self_plane)
    if not set(planes.is_blocking) - {self_plane}:
        return None
    cells = constant(directions, wp.vec3, points.device)
    inputs = [plane_inputs(points, frames, front_weights, arrays), horizon_normals, cells]
    return launch_with_adjoint(
        _find_coverage,
        _find_coverage_adjoint,
        points.size,
        inputs=inputs,
        result=empty((*points.shape, cells.size), dtype=wp.vec4, device=points.device),
        variables=[points, front_weights],
        shared=[frames],
        scratch=receiver_scratch(planes),
        cost=_CELL_COST * cells.size * planes.count,
    )
