"""Transmittance past plane blockers, such as a ground or walls.

    P_q = T_q max(0, 1 − Σ_k h_k),

h_k the coverage of cell q by plane k (:mod:`.cells`), and T_q the transmittance past all else. Plane blockers that
share a cell mostly meet in it, as walls do, and cover different parts of it.

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
from warpshadow.stages.planes.cells import (
    PlaneArrays,
    PlaneFootprint,
    ReceiverInPlane,
    check_planes,
    fetch,
    fetch_adjoint,
    find_footprint,
    find_footprint_adjoint,
    find_in_plane,
    find_in_plane_adjoint,
    find_spot,
    front_of,
    front_of_adjoint,
    is_covered_by_texels,
    on_side,
    plane_arrays,
    side_adjoint,
    toward_side,
)
from warpshadow.stages.planes.prepared import PlaneBlockers, PlaneGrid

_CELL_COST = 4.0  # mean time of a cell of a receiver [ns], over cells that hit a plane and cells that do not
_PASS_COST = 0.4  # time of a cell that is only multiplied [ns]


@wp.struct
class PlaneCover:
    """Coverage of a cell by a side."""

    coverage: float
    part: float  # of the footprint, that the mesh covers, by texels
    footprint: PlaneFootprint


@wp.func
def cover(
    scene: PlaneArrays, grid: PlaneGrid, place: ReceiverInPlane, is_back: bool, direction: wp.vec3, side_weight: float
):
    """Coverage of a cell by a side of a plane, for the visible part of the cell."""
    covered = PlaneCover()
    cosine = wp.dot(direction, place.normal)
    if side_weight > 0.0 and wp.where(is_back, cosine, -cosine) > -scene.radius:
        covered.footprint = find_footprint(
            grid, scene, on_side(grid, place, is_back), toward_side(place, is_back, direction), side_weight
        )
        covered.part = 1.0
        if is_covered_by_texels(grid) and covered.footprint.share > 0.0:
            spot = find_spot(grid, scene, covered.footprint)
            covered.part = fetch(scene.covered, scene, grid.first_level, spot)[0]
        covered.coverage = covered.footprint.share * covered.part
    return covered


@wp.func
def cover_adjoint(
    scene: PlaneArrays,
    grid: PlaneGrid,
    place: ReceiverInPlane,
    is_back: bool,
    direction: wp.vec3,
    side_weight: float,
    covered: PlaneCover,
    adj: float,
    adj_place: ReceiverInPlane,
):
    """Add to the gradients of the place, and of the presence."""
    footprint = covered.footprint
    adj_spot = wp.vec3()
    if is_covered_by_texels(grid):
        spot = find_spot(grid, scene, footprint)
        adj_part = wp.vec3(adj * footprint.share, 0.0, 0.0)
        adj_spot = fetch_adjoint(scene.covered, grid, scene, grid.first_level, footprint, spot, adj_part)
    adj_distance = float(0.0)
    if adj_spot[2] != 0.0:  # a footprint is as wide as t / √c′
        adj_distance = adj_spot[2] / footprint.distance
    adj_at, adj_toward, adj_side_weight = find_footprint_adjoint(
        grid,
        scene,
        toward_side(place, is_back, direction),
        side_weight,
        footprint,
        adj * covered.part,
        adj_distance,
        -0.5 * footprint.per_cosine * adj_spot[2],
        wp.vec2(adj_spot[0], adj_spot[1]),
    )
    return side_adjoint(grid, place, is_back, direction, adj_at, adj_toward, adj_place), adj_side_weight


@wp.func
def add_sides(
    part: float, scene: PlaneArrays, grid: PlaneGrid, place: ReceiverInPlane, direction: wp.vec3, front: float
):
    """Add the coverage of a cell by both sides of a plane, given the weight of its front."""
    front_part = part + cover(scene, grid, place, False, direction, front).coverage
    return front_part + cover(scene, grid, place, True, direction, 1.0 - front).coverage


@wp.func
def add_sides_adjoint(
    scene: PlaneArrays,
    grid: PlaneGrid,
    place: ReceiverInPlane,
    direction: wp.vec3,
    front: float,
    adj: float,
    adj_place: ReceiverInPlane,
    adj_front: float,
):
    """Add to the gradients of the place, and of the front weight."""
    adj_weights = float(adj_front)
    for side in range(2):
        is_back, side_weight = side == 1, wp.where(side == 1, 1.0 - front, front)
        covered = cover(scene, grid, place, is_back, direction, side_weight)
        if covered.coverage > 0.0 and covered.coverage < 1.0:  # a cell that is covered wholly stays so
            adj_place, adj_weight = cover_adjoint(
                scene, grid, place, is_back, direction, side_weight, covered, adj, adj_place
            )
            adj_weights += wp.where(is_back, -adj_weight, adj_weight)
    return adj_place, adj_weights


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
def _add_coverage(
    first_row: int,
    worker: int,
    # in
    points: wp.array2d(dtype=wp.vec3),
    horizon_normals: wp.array2d(dtype=wp.vec3),
    covered: wp.array3d(dtype=wp.float32),
    frames: wp.array2d(dtype=wp.vec3),
    fronts: wp.array3d(dtype=wp.float32),
    scene: PlaneArrays,
    f: int,
    directions: wp.array(dtype=wp.vec3),
    # out
    result: wp.array3d(dtype=wp.float32),
):
    """A thread owns a receiver:  C_q + h of both sides of a plane."""
    batch, receiver = split_row(first_row + wp.tid(), points.shape[1])
    place = find_in_plane(points[batch, receiver], frames[instance_in(batch, frames.shape[0])], f)
    exists = wp.length_sq(place.normal) > 0.0
    grid = scene.grids[f]
    front = front_of(fronts, grid, place.at[2], batch, receiver, f)
    normal = horizon_normal(horizon_normals, batch, receiver)
    for q in range(directions.shape[0]):
        direction = directions[q]
        part = float(0.0)
        if covered:
            part = covered[batch, receiver, q]
        if exists and part < 1.0 and is_above_horizon(normal, direction):
            part = add_sides(part, scene, grid, place, direction, front)
        result[batch, receiver, q] = part


@wp.kernel(enable_backward=False)
def _add_coverage_adjoint(
    first_row: int,
    worker: int,
    # in
    points: wp.array2d(dtype=wp.vec3),
    horizon_normals: wp.array2d(dtype=wp.vec3),
    covered: wp.array3d(dtype=wp.float32),
    frames: wp.array2d(dtype=wp.vec3),
    fronts: wp.array3d(dtype=wp.float32),
    scene: PlaneArrays,
    f: int,
    directions: wp.array(dtype=wp.vec3),
    adj_result: wp.array3d(dtype=wp.float32),
    # out
    adj_points: wp.array2d(dtype=wp.vec3),
    adj_covered: wp.array3d(dtype=wp.float32),
    adj_fronts: wp.array3d(dtype=wp.float32),
    # sums
    adj_frames: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a receiver."""
    batch, receiver = split_row(first_row + wp.tid(), points.shape[1])
    instance = instance_in(batch, frames.shape[0])
    point = points[batch, receiver]
    place = find_in_plane(point, frames[instance], f)
    exists = wp.length_sq(place.normal) > 0.0
    grid = scene.grids[f]
    front = front_of(fronts, grid, place.at[2], batch, receiver, f)
    normal = horizon_normal(horizon_normals, batch, receiver)
    adj_place = ReceiverInPlane()
    adj_front = float(0.0)
    for q in range(directions.shape[0]):
        direction = directions[q]
        adj = adj_result[batch, receiver, q]
        part = float(0.0)
        if covered:
            part = covered[batch, receiver, q]
        if exists and adj != 0.0 and part < 1.0 and is_above_horizon(normal, direction):
            adj_place, adj_front = add_sides_adjoint(scene, grid, place, direction, front, adj, adj_place, adj_front)
        if adj_covered:
            adj_covered[batch, receiver, q] = adj_covered[batch, receiver, q] + adj
    adj_height = front_of_adjoint(fronts, grid, place.at[2], adj_front, batch, receiver, f, adj_fronts)
    adj_place.at = adj_place.at + wp.vec3(0.0, 0.0, adj_height)
    adj_point = find_in_plane_adjoint(point, frames[instance], f, place, adj_place, instance, adj_frames)
    if adj_points:
        adj_points[batch, receiver] = adj_points[batch, receiver] + adj_point


@wp.kernel(enable_backward=False)
def _pass(
    first_row: int,
    worker: int,
    # in
    transmittance: wp.array3d(dtype=wp.float32),
    covered: wp.array3d(dtype=wp.float32),
    # out
    passing: wp.array3d(dtype=wp.float32),
):
    """A thread owns a receiver:  P_q = T_q max(0, 1 − C_q)."""
    batch, receiver = split_row(first_row + wp.tid(), passing.shape[1])
    for q in range(passing.shape[2]):
        passing[batch, receiver, q] = transmittance[batch, receiver, q] * wp.max(0.0, 1.0 - covered[batch, receiver, q])


@wp.kernel(enable_backward=False)
def _pass_adjoint(
    first_row: int,
    worker: int,
    # in
    transmittance: wp.array3d(dtype=wp.float32),
    covered: wp.array3d(dtype=wp.float32),
    adj_passing: wp.array3d(dtype=wp.float32),
    # out
    adj_transmittance: wp.array3d(dtype=wp.float32),
    adj_covered: wp.array3d(dtype=wp.float32),
):
    """A thread owns a receiver."""
    batch, receiver = split_row(first_row + wp.tid(), adj_passing.shape[1])
    for q in range(adj_passing.shape[2]):
        adj, left = adj_passing[batch, receiver, q], 1.0 - covered[batch, receiver, q]
        if left > 0.0:
            if adj_transmittance:
                adj_transmittance[batch, receiver, q] = adj_transmittance[batch, receiver, q] + adj * left
            if adj_covered:
                blocked = adj * transmittance[batch, receiver, q]
                adj_covered[batch, receiver, q] = adj_covered[batch, receiver, q] - blocked


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
    """Coverage of cells by the planes that cast shadows, Σ_k h_k: values above 1 need not be complete.

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
        Float32 of shape [batch, receiver, direction], 1 or more where nothing passes; None where no flat casts a
        shadow on them.
    Differentiable: points, frames, fronts. Not: facing, which decides by steps.
    """
    check_planes(planes, points, frames, directions, skip)
    count = common_batch({"points": points, "frames": frames, "fronts": fronts})
    points, fronts = expand(points, count), None if fronts is None else expand_rows(fronts, count)
    own_radius = cell_radius(len(directions)) if radius is None else radius
    scene = plane_arrays(planes, own_radius, skip, tiles=radius is None)
    cells, covered = constant(directions, wp.vec3, points.device), None
    for f in planes.blocking:
        if f != skip:
            covered = _add(points, horizon_normals, covered, frames, fronts, scene, f, cells)
    return covered


def _add(
    points: wp.array,
    horizon_normals: wp.array | None,
    covered: wp.array | None,
    frames: wp.array,
    fronts: wp.array | None,
    scene: PlaneArrays,
    f: int,
    directions: wp.array,
) -> wp.array:
    """Coverage by one flat more. Differentiable: points, covered, frames, fronts."""
    inputs = [points, horizon_normals, covered, frames, fronts, scene, f, directions]
    cost = _CELL_COST * directions.size
    return differentiable(
        lambda result: launch(_add_coverage, points.size, inputs=inputs, outputs=[result], cost=cost),
        lambda adj_result: launch(
            _add_coverage_adjoint,
            points.size,
            inputs=[*inputs, adj_result],
            outputs=[points.grad, *(None if array is None else array.grad for array in (covered, fronts))],
            sums=[frames.grad],
            cost=2 * cost,
        ),
        result=wp.empty((*points.shape, directions.size), dtype=wp.float32, device=points.device),
        variables=[points, covered, frames, fronts],
    )


def transmittance_past_planes(transmittance: wp.array, covered: wp.array) -> wp.array:
    """Transmittance past planes, given the transmittance past all else, T_q max(0, 1 − C_q).

    Args:
        transmittance: Past all else, float32 of shape [batch, receiver, direction]; its batch may be 1.
        covered: Coverage by planes, :func:`plane_coverage`, of the same shape; its batch may be 1.
    Returns:
        Float32 of the same shape.
    Differentiable: transmittance, covered.
    """
    check.shape("transmittance", transmittance.shape, ("batch", *covered.shape[1:]))
    count = common_batch({"transmittance": transmittance, "covered": covered})
    transmittance, covered = expand_rows(transmittance, count), expand_rows(covered, count)
    rows, cost = transmittance.shape[0] * transmittance.shape[1], _PASS_COST * transmittance.shape[2]
    inputs = [transmittance, covered]
    return differentiable(
        lambda passing: launch(_pass, rows, inputs=inputs, outputs=[passing], cost=cost),
        lambda adj_passing: launch(
            _pass_adjoint,
            rows,
            inputs=[*inputs, adj_passing],
            outputs=[transmittance.grad, covered.grad],
            cost=2 * cost,
        ),
        result=wp.empty(transmittance.shape, dtype=wp.float32, device=transmittance.device),
        variables=inputs,
    )
