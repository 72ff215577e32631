"""Transmittance past plane blockers, such as a ground or walls.

    P_q = T_q max(0, 1 − Σ_k h_k),

h_k the coverage of cell q by plane k, and T_q the transmittance past all else. Plane blockers that share a cell mostly
meet in it, as walls do, and cover different parts of it.

A large sphere in place of a ground is worse: on a cow over a ground the error of direct light is 0.7% of the image's
mean by the plane, and 2.3% by the sphere.
"""

import numpy as np
import warp as wp

from warpshadow import check
from warpshadow.device.batch import common_batch, expand, expand_rows, instance_in
from warpshadow.device.constants import constant
from warpshadow.device.launch import differentiable, launch
from warpshadow.device.parallel import split_row
from warpshadow.maths.directions import cell_radius
from warpshadow.stages.cell_coverage import ViewedEdge, coverage_adjoint
from warpshadow.stages.planes.cells import (
    LocalReceiver,
    PlaneArrays,
    PlaneFootprint,
    check_planes,
    fetch,
    fetch_adjoint,
    find_mip_footprint,
    is_covered_by_texels,
    plane_arrays,
)
from warpshadow.stages.planes.prepared import PlaneBlockers, PlaneGrid
from warpshadow.stages.planes.sides import (
    SIDE_ROWS,
    PlaneSide,
    VisibleCell,
    footprint_on_side,
    footprint_on_side_adjoint,
    load_local_receiver,
    load_side,
    plane_share,
    prepare_receiver,
    prepare_receiver_adjoint,
    receiver_scratch,
    visible_cell,
)

_CELL_COST = 4.0  # mean time of a cell of a receiver [ns], over cells that hit a plane and cells that do not
_PASS_COST = 0.4  # time of a cell that is only multiplied [ns]


@wp.struct
class PlaneCoverage:
    """Coverage of a cell by a side."""

    outline: float  # by its outline
    mesh_share: float  # of that, that the mesh covers, by texels
    footprint: PlaneFootprint  # of these texels


@wp.func
def side_coverage(
    scene: PlaneArrays,
    grid: PlaneGrid,
    side: PlaneSide,
    local_receiver: LocalReceiver,
    cell: VisibleCell,
    edges: wp.array(dtype=ViewedEdge),
):
    """Coverage of a cell by a side."""
    coverage = PlaneCoverage()
    coverage.mesh_share = 1.0
    coverage.outline = plane_share(scene, grid, side, local_receiver, cell, edges)
    if is_covered_by_texels(grid) and coverage.outline > 0.0:
        coverage.footprint = footprint_on_side(scene, grid, side, local_receiver, cell.direction)
        mip = find_mip_footprint(grid, scene, coverage.footprint)
        coverage.mesh_share = fetch(scene.covered, scene, grid.first_level, mip)[0]
    return coverage


@wp.func
def side_coverage_adjoint(
    scene: PlaneArrays,
    grid: PlaneGrid,
    side: PlaneSide,
    local_receiver: LocalReceiver,
    cell: VisibleCell,
    adj_coverage: float,
    edges: wp.array(dtype=ViewedEdge),
    adj_store: wp.array(dtype=wp.vec3),
):
    """Add to the gradients of the receiver relative to the plane, of the side's weight, and of viewed edges."""
    coverage = PlaneCoverage()
    coverage.mesh_share = 1.0
    if side.weight < 1.0 or is_covered_by_texels(grid):
        coverage = side_coverage(scene, grid, side, local_receiver, cell, edges)
        adj_weight = adj_coverage * coverage.mesh_share * coverage.outline / side.weight
        adj_store[side.row] = adj_store[side.row] + wp.vec3(0.0, 0.0, adj_weight)
    if is_covered_by_texels(grid) and coverage.outline > 0.0:
        footprint = coverage.footprint
        adj_part = wp.vec3(adj_coverage * coverage.outline, 0.0, 0.0)
        mip = find_mip_footprint(grid, scene, footprint)
        adj_mip = fetch_adjoint(scene.covered, grid, scene, grid.first_level, footprint, mip, adj_part)
        footprint_on_side_adjoint(
            scene, grid, side, local_receiver, cell.direction, footprint, adj_mip, 0.0, 0.0, adj_store
        )
    adj_outline = adj_coverage * side.weight * coverage.mesh_share
    coverage_adjoint(edges, side.first_edge, grid.edge_count, cell.direction, cell.radius, adj_outline)


@wp.func
def horizon_normal(horizon_normals: wp.array2d(dtype=wp.vec3), batch: int, receiver: int):
    """Receiver normal, or 0 to skip the horizon test."""
    if horizon_normals:
        return horizon_normals[instance_in(batch, horizon_normals.shape[0]), receiver]
    return wp.vec3()


@wp.func
def is_above_horizon(normal: wp.vec3, direction: wp.vec3):
    """Whether a direction is above the horizon of a normal; it is for the normal 0."""
    return wp.dot(normal, direction) > 0.0 or wp.length_sq(normal) == 0.0


@wp.kernel(enable_backward=False)
def _find_coverage(
    first_row: int,
    worker: int,
    # in
    points: wp.array2d(dtype=wp.vec3),
    horizon_normals: wp.array2d(dtype=wp.vec3),
    frames: wp.array2d(dtype=wp.vec3),
    fronts: wp.array3d(dtype=wp.float32),
    scene: PlaneArrays,
    directions: wp.array(dtype=wp.vec3),
    # scratch
    scratch: wp.array2d(dtype=wp.vec3),
    viewed_edges: wp.array2d(dtype=ViewedEdge),
    # out
    coverages: wp.array3d(dtype=wp.float32),
):
    """A thread owns a receiver:  C_q = Σ_k h_k."""
    batch, receiver, scratch_row, side_count = prepare_receiver(
        first_row + wp.tid(), worker, points, frames, fronts, scene, scratch, viewed_edges
    )
    store, edges = scratch[scratch_row], viewed_edges[scratch_row]
    normal = horizon_normal(horizon_normals, batch, receiver)
    coverage = coverages[batch, receiver]
    for q in range(directions.shape[0]):
        coverage[q] = 0.0
    for i in range(side_count):
        side = load_side(scene, i, store)
        grid = scene.grids[side.f]
        local_receiver = load_local_receiver(store, side.f)
        if grid.blocks == 1:
            for q in range(directions.shape[0]):
                direction = directions[q]
                if is_above_horizon(normal, direction) and coverage[q] < 1.0:
                    cell = visible_cell(scene, normal, direction)
                    coverage_of_side = side_coverage(scene, grid, side, local_receiver, cell, edges)
                    if coverage_of_side.outline > 0.0:
                        coverage[q] = coverage[q] + coverage_of_side.outline * coverage_of_side.mesh_share


@wp.kernel(enable_backward=False)
def _find_coverage_adjoint(
    first_row: int,
    worker: int,
    # in
    points: wp.array2d(dtype=wp.vec3),
    horizon_normals: wp.array2d(dtype=wp.vec3),
    frames: wp.array2d(dtype=wp.vec3),
    fronts: wp.array3d(dtype=wp.float32),
    scene: PlaneArrays,
    directions: wp.array(dtype=wp.vec3),
    adj_coverages: wp.array3d(dtype=wp.float32),
    # scratch
    scratch: wp.array2d(dtype=wp.vec3),
    viewed_edges: wp.array2d(dtype=ViewedEdge),
    adj_scratch: wp.array2d(dtype=wp.vec3),
    # out
    adj_points: wp.array2d(dtype=wp.vec3),
    adj_fronts: wp.array3d(dtype=wp.float32),
    # sums
    adj_frames: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a receiver; cells that are covered wholly are taken to have no gradient."""
    batch, receiver, scratch_row, side_count = prepare_receiver(
        first_row + wp.tid(), worker, points, frames, fronts, scene, scratch, viewed_edges
    )
    store, edges, adj_store = scratch[scratch_row], viewed_edges[scratch_row], adj_scratch[scratch_row]
    normal = horizon_normal(horizon_normals, batch, receiver)
    for k in range(SIDE_ROWS * scene.grids.shape[0]):
        adj_store[k] = wp.vec3()
    for i in range(side_count):
        side = load_side(scene, i, store)
        grid = scene.grids[side.f]
        local_receiver = load_local_receiver(store, side.f)
        if grid.blocks == 1:
            for q in range(directions.shape[0]):
                adj_coverage = adj_coverages[batch, receiver, q]
                if adj_coverage != 0.0 and is_above_horizon(normal, directions[q]):
                    cell = visible_cell(scene, normal, directions[q])
                    side_coverage_adjoint(scene, grid, side, local_receiver, cell, adj_coverage, edges, adj_store)
    prepare_receiver_adjoint(
        batch,
        receiver,
        side_count,
        points,
        frames,
        fronts,
        scene,
        store,
        edges,
        adj_store,
        adj_points,
        adj_fronts,
        adj_frames,
    )


@wp.kernel(enable_backward=False)
def _attenuate(
    first_row: int,
    worker: int,
    # in
    transmittance: wp.array3d(dtype=wp.float32),
    coverage: wp.array3d(dtype=wp.float32),
    # out
    attenuated: wp.array3d(dtype=wp.float32),
):
    """A thread owns a receiver:  P_q = T_q max(0, 1 − C_q)."""
    batch, receiver = split_row(first_row + wp.tid(), attenuated.shape[1])
    for q in range(attenuated.shape[2]):
        attenuated[batch, receiver, q] = transmittance[batch, receiver, q] * wp.max(
            0.0, 1.0 - coverage[batch, receiver, q]
        )


@wp.kernel(enable_backward=False)
def _attenuate_adjoint(
    first_row: int,
    worker: int,
    # in
    transmittance: wp.array3d(dtype=wp.float32),
    coverage: wp.array3d(dtype=wp.float32),
    adj_attenuated: wp.array3d(dtype=wp.float32),
    # out
    adj_transmittance: wp.array3d(dtype=wp.float32),
    adj_covered: wp.array3d(dtype=wp.float32),
):
    """A thread owns a receiver."""
    batch, receiver = split_row(first_row + wp.tid(), adj_attenuated.shape[1])
    for q in range(adj_attenuated.shape[2]):
        adj_cell, open_share = adj_attenuated[batch, receiver, q], 1.0 - coverage[batch, receiver, q]
        if open_share > 0.0:
            if adj_transmittance:
                adj_transmittance[batch, receiver, q] = adj_transmittance[batch, receiver, q] + adj_cell * open_share
            if adj_covered:
                adj_open_share = adj_cell * transmittance[batch, receiver, q]
                adj_covered[batch, receiver, q] = adj_covered[batch, receiver, q] - adj_open_share


def plane_coverage(
    points: wp.array,
    frames: wp.array,
    planes: PlaneBlockers,
    directions: np.ndarray,
    *,
    radius: float | None = None,
    horizon_normals: wp.array | None = None,
    fronts: wp.array | None = None,
    skip: int | None = None,
) -> wp.array | None:
    """Coverage of cells by the planes that cast shadows, Σ_k h_k: values of 1 and more need not be complete.

    Args:
        points: Receivers [scene units], vec3 of shape [batch, receiver].
        frames: Where the planes are, vec3 of shape [batch, 3 · plane], from :meth:`PlaneBlockers.frames`; the batch may
            be 1.
        directions: Unit vectors ω of the cells, NumPy of shape [direction, 3].
        radius: Of cells that do not tile the sphere [rad], how soft edges and horizons are; by default that of so many
            even ones, which do.
        horizon_normals: Normals, vec3 of shape [batch, receiver]: nothing covers cells below the horizon.
        fronts: Part of the front of each plane that receivers see, from :func:`.fronts.find_fronts`, float32 of shape
            [batch, receiver, plane]; by default their heights decide.
        skip: Number of the plane that the receivers are part of, which blocks none of their light; None for none.
    Returns:
        Float32 of shape [batch, receiver, direction], 1 or more where nothing passes; None where no plane casts a
        shadow on them.
    Differentiable: points, frames, fronts. Not: horizon_normals, which decide by steps,
    and how much receivers in a plane see of a cell.
    """
    check_planes(planes, points, frames, directions, skip)
    count = common_batch({"points": points, "frames": frames, "fronts": fronts})
    points, fronts = expand(points, count), None if fronts is None else expand_rows(fronts, count)
    radius_of_cells = cell_radius(len(directions)) if radius is None else radius
    scene = plane_arrays(planes, radius_of_cells, skip, tiles=radius is None)
    if not set(planes.is_blocking) - {skip}:
        return None
    cells = constant(directions, wp.vec3, points.device)
    inputs, cost = [points, horizon_normals, frames, fronts, scene, cells], _CELL_COST * cells.size * planes.count
    scratch = receiver_scratch(planes)
    return differentiable(
        lambda coverages: launch(
            _find_coverage, points.size, inputs=inputs, scratch=scratch, outputs=[coverages], cost=cost
        ),
        lambda adj_coverages: launch(
            _find_coverage_adjoint,
            points.size,
            inputs=[*inputs, adj_coverages],
            scratch=[*scratch, scratch[0]],
            outputs=[points.grad, None if fronts is None else fronts.grad],
            sums=[frames.grad],
            cost=2 * cost,
        ),
        result=wp.empty((*points.shape, cells.size), dtype=wp.float32, device=points.device),
        variables=[points, frames, fronts],
    )


def transmittance_past_planes(transmittance: wp.array, coverage: wp.array) -> wp.array:
    """Transmittance past planes, given the transmittance past all else, T_q max(0, 1 − C_q).

    Args:
        transmittance: Past all else, float32 of shape [batch, receiver, direction]; its batch may be 1.
        coverage: Coverage by planes, :func:`plane_coverage`, of the same shape; its batch may be 1.
    Returns:
        Float32 of the same shape.
    Differentiable: transmittance, coverage.
    """
    check.shape("transmittance", transmittance.shape, ("batch", *coverage.shape[1:]))
    count = common_batch({"transmittance": transmittance, "coverage": coverage})
    transmittance, coverage = expand_rows(transmittance, count), expand_rows(coverage, count)
    rows, cost = transmittance.shape[0] * transmittance.shape[1], _PASS_COST * transmittance.shape[2]
    inputs = [transmittance, coverage]
    return differentiable(
        lambda attenuated: launch(_attenuate, rows, inputs=inputs, outputs=[attenuated], cost=cost),
        lambda adj_attenuated: launch(
            _attenuate_adjoint,
            rows,
            inputs=[*inputs, adj_attenuated],
            outputs=[transmittance.grad, coverage.grad],
            cost=2 * cost,
        ),
        result=wp.empty(transmittance.shape, dtype=wp.float32, device=transmittance.device),
        variables=inputs,
    )
