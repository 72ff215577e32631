"""Partial cells: the coverage of the light in cells that planes cover in part, by where in the cell it comes from.

Planes cover the share C of a cell. Where C is neither 0 nor 1, as at the edge of a window, the light of the cell is
covered in the share

    C′ = C + g(C) (Σ_s c_s min(1, Σ_k h_k(ω_s)) / Σ_s c_s − C),  g(C) = min(1, C/0.05, (1 − C)/0.05) ≥ 0

Eight directions ω_s are drawn from the light of the cell. Each has a small cell of its own, of which plane k covers
h_k, and a weight c_s: max(n·ω_s, 0) for receivers in a plane, for others 1 above the horizon and 0 below it.

A wall behind a window is 8.0, 4.5 and 2.6% off in 32, 64 and 128 cells, with C in place of C′ 15, 5.4 and 3.4%.
"""

import numpy as np
import warp as wp

from warpshadow import check
from warpshadow.device.batch import common_batch, expand, expand_rows
from warpshadow.device.constants import constant
from warpshadow.device.launch import launch_with_adjoint
from warpshadow.device.memory import empty
from warpshadow.maths.directions import cell_radius
from warpshadow.stages.cell_coverage import ViewedEdge
from warpshadow.stages.planes.cells import PlaneArrays, check_planes, plane_arrays
from warpshadow.stages.planes.coverage import horizon_normal, side_coverage, side_coverage_adjoint
from warpshadow.stages.planes.plane_blockers import PlaneBlockers
from warpshadow.stages.planes.sides import (
    PlaneInputs,
    PlaneReceiver,
    StoredSide,
    load_side,
    plane_inputs,
    prepare_receiver,
    prepare_receiver_adjoint,
    receiver_scratch,
    visible_cell,
)

SAMPLES = 8  # directions of a cell

_PER_RAMP = wp.constant(20.0)  # one over the coverage from which on a cell counts as covered in part
_CELL_COST = 4.0  # mean time of a cell of a receiver [ns]: few are looked at


@wp.func
def _partial_weight(coverage: float):
    """Weight of a cell as partially covered."""
    return wp.clamp(_PER_RAMP * wp.min(coverage, 1.0 - coverage), 0.0, 1.0)


@wp.func
def _sample_weight(planes: PlaneArrays, normal: wp.vec3, direction: wp.vec3):
    """Weight of a direction in the mean: its cosine for receivers in a plane; for others 1 above their horizon."""
    cosine = wp.dot(normal, direction)
    weight = wp.where(cosine > 0.0, 1.0, 0.0)
    if wp.length_sq(normal) == 0.0:
        weight = 1.0
    elif planes.self_plane >= 0:
        weight = wp.max(cosine, 0.0)
    return weight


@wp.func
def _direction_coverage(planes: PlaneArrays, direction: wp.vec3, normal: wp.vec3, receiver: PlaneReceiver):
    """Σ_k h_k of a direction."""
    coverage_sum = float(0.0)
    cell = visible_cell(planes, normal, direction)
    for i in range(receiver.side_count):
        side = load_side(planes, receiver, i)
        if side.grid.blocks == 1 and coverage_sum < 1.0:
            covered = side_coverage(planes, side, cell, receiver.edges)
            coverage_sum += covered.outline[0] * covered.mesh_share
    return coverage_sum


@wp.func
def _find_mean_coverage(
    planes: PlaneArrays, samples: wp.array(dtype=wp.vec3), normal: wp.vec3, receiver: PlaneReceiver
):
    """Mean coverage of the directions drawn from a cell, by their weights, and the sum of these."""
    weighted_sum = float(0.0)
    weights = float(0.0)
    for s in range(samples.shape[0]):
        weight = _sample_weight(planes, normal, samples[s])
        if weight > 0.0:
            coverage = _direction_coverage(planes, samples[s], normal, receiver)
            weighted_sum += weight * wp.min(1.0, coverage)
            weights += weight
    if weights > 0.0:
        weighted_sum = weighted_sum / weights
    return weighted_sum, weights


@wp.kernel(enable_backward=False)
def _refine_coverage(
    first_row: int,
    worker: int,
    # in
    inputs: PlaneInputs,
    horizon_normals: wp.array2d(dtype=wp.vec3),
    covered: wp.array3d(dtype=wp.vec4),
    samples: wp.array2d(dtype=wp.vec3),
    # scratch
    sides: wp.array2d(dtype=StoredSide),
    edges: wp.array2d(dtype=ViewedEdge),
    # out
    refined: wp.array3d(dtype=wp.vec4),
):
    """A thread owns a receiver."""
    receiver = prepare_receiver(first_row + wp.tid(), worker, inputs, sides, edges)
    batch, index = receiver.batch, receiver.index
    normal = horizon_normal(horizon_normals, batch, index)
    for q in range(samples.shape[0]):
        cell = covered[batch, index, q]
        coverage = cell[0]
        weight = _partial_weight(coverage)
        if weight > 0.0:
            mean_coverage, weights = _find_mean_coverage(inputs.planes, samples[q], normal, receiver)
            if weights > 0.0:
                coverage = coverage + weight * (mean_coverage - coverage)
        refined[batch, index, q] = wp.vec4(coverage, cell[1], cell[2], cell[3])


@wp.kernel(enable_backward=False)
def _refine_coverage_adjoint(
    first_row: int,
    worker: int,
    # in
    inputs: PlaneInputs,
    horizon_normals: wp.array2d(dtype=wp.vec3),
    covered: wp.array3d(dtype=wp.vec4),
    samples: wp.array2d(dtype=wp.vec3),
    adj_refined: wp.array3d(dtype=wp.vec4),
    # scratch
    sides: wp.array2d(dtype=StoredSide),
    edges: wp.array2d(dtype=ViewedEdge),
    # out
    adj_points: wp.array2d(dtype=wp.vec3),
    adj_covered: wp.array3d(dtype=wp.vec4),
    adj_front_weights: wp.array3d(dtype=wp.float32),
    # sums
    adj_frames: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a receiver; a direction that is covered wholly has no gradient."""
    receiver = prepare_receiver(first_row + wp.tid(), worker, inputs, sides, edges)
    batch, index, planes = receiver.batch, receiver.index, inputs.planes
    normal = horizon_normal(horizon_normals, batch, index)
    for q in range(samples.shape[0]):
        coverage = covered[batch, index, q][0]
        adj_cell = adj_refined[batch, index, q]
        adj_cell_share = adj_cell[0]
        weight = _partial_weight(coverage)
        slope = float(1.0)
        if adj_cell_share != 0.0 and weight > 0.0:
            mean_coverage, weights = _find_mean_coverage(planes, samples[q], normal, receiver)
            if weights > 0.0:
                slope = 1.0 - weight + wp.grad(_partial_weight)(coverage) * (mean_coverage - coverage)
            for s in range(samples.shape[1]):
                direction = samples[q, s]
                sample_weight = _sample_weight(planes, normal, direction)
                if sample_weight > 0.0 and _direction_coverage(planes, direction, normal, receiver) < 1.0:
                    cell = visible_cell(planes, normal, direction)
                    adj_part = wp.vec4(weight * adj_cell_share * sample_weight / weights, 0.0, 0.0, 0.0)
                    for i in range(receiver.side_count):
                        side = load_side(planes, receiver, i)
                        if side.grid.blocks == 1:
                            side_coverage_adjoint(planes, side, cell, adj_part, receiver)
        if adj_covered:
            adj_covered[batch, index, q] = adj_covered[batch, index, q] + wp.vec4(
                slope * adj_cell_share, adj_cell[1], adj_cell[2], adj_cell[3]
            )
    prepare_receiver_adjoint(receiver, inputs, adj_points, adj_front_weights, adj_frames)


def coverage_of_light(
    points: wp.array,
    covered: wp.array,
    frames: wp.array,
    planes: PlaneBlockers,
    directions: np.ndarray,
    samples: np.ndarray,
    *,
    horizon_normals: wp.array | None = None,
    front_weights: wp.array | None = None,
    self_plane: int | None = None,
) -> wp.array:
    """Coverage of the light of cells, C′: more exact than coverage of cells where planes cover them in part.

    Args:
        points, frames, planes, directions, horizon_normals, front_weights, self_plane: As for
            :func:`.coverage.plane_coverage`.
        covered: Its result, (C, μ), vec4 of shape [batch, receiver, direction].
        samples: Eight directions drawn from the light of each cell, NumPy of shape [direction, 8, 3].
    Returns:
        (C′, μ), of the same shape.
    Differentiable: points, covered, frames, front_weights. Not: horizon_normals, which decide by steps,
    and how much directions count for receivers in a plane.
    """
    check.shape("samples", samples.shape, (len(directions), SAMPLES, 3))
    check_planes(planes, points, frames, directions, self_plane)
    check.shape("covered", covered.shape, ("batch", points.shape[1], len(directions)))
    count = common_batch({"points": points, "frames": frames, "front_weights": front_weights, "covered": covered})
    points, covered = expand(points, count), expand_rows(covered, count)
    front_weights = None if front_weights is None else expand_rows(front_weights, count)
    arrays = plane_arrays(planes, cell_radius(SAMPLES * len(directions)), self_plane)
    samples_on_device = constant(np.asarray(samples, np.float32), wp.vec3, points.device)
    inputs = [plane_inputs(points, frames, front_weights, arrays), horizon_normals, covered, samples_on_device]
    return launch_with_adjoint(
        _refine_coverage,
        _refine_coverage_adjoint,
        points.size,
        inputs=inputs,
        result=empty(covered.shape, dtype=wp.vec4, device=points.device),
        variables=[points, covered, front_weights],
        shared=[frames],
        scratch=receiver_scratch(planes),
        cost=_CELL_COST * len(directions),
    )
