"""Sides of planes that a receiver sees, with their outlines, and the part of a cell that each covers.

A thread that owns a receiver stores the sides that it sees, with its position relative to them and their outlines
(:func:`prepare_receiver`), and looks at each side cell by cell. An adjoint collects gradients beside all these, which
:func:`prepare_receiver_adjoint` carries to the points, the fronts and the frames of the planes.
"""

import warp as wp

from warpshadow.device.batch import instance_in
from warpshadow.device.parallel import Scratch, scratch_slot, split_row
from warpshadow.stages.cell_coverage import ViewedEdge, convex_coverage, outline_coverage, viewed_edge
from warpshadow.stages.planes.cells import (
    LocalReceiver,
    PlaneArrays,
    PlaneFootprint,
    find_footprint,
    find_footprint_adjoint,
    find_local_receiver,
    find_local_receiver_adjoint,
    front_of,
    front_of_adjoint,
)
from warpshadow.stages.planes.plane_blockers import PlaneBlockers, PlaneGrid

_SIDES = wp.constant(2)  # a plane's front and its back

# ---------------------------------------------------------------------------------------------------- memory


@wp.struct
class PlaneInputs:
    """Receivers, and the planes around them."""

    points: wp.array2d(dtype=wp.vec3)
    frames: wp.array2d(dtype=wp.vec3)
    front_weights: wp.array3d(dtype=wp.float32)  # none where heights decide
    planes: PlaneArrays


def plane_inputs(
    points: wp.array, frames: wp.array, front_weights: wp.array | None, planes: PlaneArrays
) -> PlaneInputs:
    """Combine receivers and the planes around them for kernels."""
    inputs = PlaneInputs()
    inputs.points, inputs.frames, inputs.planes = points, frames, planes
    if front_weights is not None:
        inputs.front_weights = front_weights
    return inputs


@wp.struct
class StoredSide:
    """A side in scratch memory, with its gradients."""

    plane: int  # its number
    is_back: wp.bool
    weight: float  # part of the side that is there
    local_receiver: LocalReceiver
    adj_weight: float
    adj_local_receiver: LocalReceiver


@wp.struct
class PlaneReceiver:
    """A receiver, and the scratch memory of its thread for the planes around it."""

    batch: int
    index: int  # of the receiver
    slot: int  # of scratch memory
    side_count: int
    sides: wp.array(dtype=StoredSide)  # the sides that it sees, ``side_count`` of them
    edges: wp.array(dtype=ViewedEdge)  # of each plane's front, and of its back


def receiver_scratch(planes: PlaneBlockers) -> list[Scratch]:
    """Scratch memory of a receiver: sides and edges, with their gradients."""
    return [Scratch((_SIDES * planes.count,), StoredSide), Scratch((_SIDES * planes.edges.size,), ViewedEdge)]


@wp.struct
class PlaneSide:
    """A side of a plane, as a receiver sees it."""

    index: int  # among the sides that the receiver sees
    plane: int  # its number
    is_back: wp.bool
    weight: float  # part of the side that is there
    first_edge: int  # of its viewed edges
    grid: PlaneGrid
    local_receiver: LocalReceiver


@wp.func
def load_side(planes: PlaneArrays, receiver: PlaneReceiver, index: int):
    """Load one of the sides that a receiver sees."""
    side = PlaneSide()
    side.index = index
    side.plane = receiver.sides[index].plane
    side.is_back = receiver.sides[index].is_back
    side.weight = receiver.sides[index].weight
    side.grid = planes.grids[side.plane]
    side.first_edge = _SIDES * side.grid.first_edge + wp.where(side.is_back, side.grid.edge_count, 0)
    side.local_receiver = receiver.sides[index].local_receiver
    return side


# ---------------------------------------------------------------------------------------------------- positions


@wp.func
def _side_normal(side: PlaneSide):
    return wp.where(side.is_back, 1.0, -1.0) * side.local_receiver.normal


@wp.func
def _position_on_side(side: PlaneSide):
    """Position of a receiver above a side: at least a margin high, and its own height from two margins on."""
    position, margin = side.local_receiver.position, side.grid.margin
    height = wp.where(side.is_back, -position[2], position[2])
    front_ramp = wp.clamp(height / margin, 0.0, 2.0)
    return wp.vec3(
        position[0], position[1], margin * (1.0 + 0.25 * front_ramp * front_ramp) + wp.max(height - 2.0 * margin, 0.0)
    )


@wp.func
def _direction_on_side(side: PlaneSide, direction: wp.vec3):
    """Direction along the axes of a plane, and its cosine with a side."""
    along_normal = wp.dot(direction, side.local_receiver.normal)
    return wp.vec3(
        wp.dot(direction, side.local_receiver.axis_u),
        wp.dot(direction, side.local_receiver.axis_v),
        wp.where(side.is_back, along_normal, -along_normal),
    )


@wp.func
def _side_adjoint(
    side: PlaneSide,
    direction: wp.vec3,
    adj_position: wp.vec3,
    adj_direction: wp.vec3,
    adj_local_receiver: LocalReceiver,
):
    """Add the gradients of :func:`_position_on_side` and :func:`_direction_on_side` to the local receiver's."""
    sign = wp.where(side.is_back, -1.0, 1.0)
    height_slope = wp.clamp(0.5 * sign * side.local_receiver.position[2] / side.grid.margin, 0.0, 1.0)
    result = LocalReceiver()
    result.position = adj_local_receiver.position + wp.vec3(
        adj_position[0], adj_position[1], sign * height_slope * adj_position[2]
    )
    result.axis_u = adj_local_receiver.axis_u + adj_direction[0] * direction
    result.axis_v = adj_local_receiver.axis_v + adj_direction[1] * direction
    result.normal = adj_local_receiver.normal - (sign * adj_direction[2]) * direction
    result.scale = adj_local_receiver.scale
    return result


# ---------------------------------------------------------------------------------------------------- outlines


@wp.func
def _view_outline(planes: PlaneArrays, side: PlaneSide, edges: wp.array(dtype=ViewedEdge)):
    """Store the outline of a plane as a receiver over one side sees it; n = ±(a − x) × (b − a) / |b − a|.

    Edges run so that the mesh is to their left as the receiver sees it: the front's from b to a.
    """
    local_receiver, grid = side.local_receiver, side.grid
    position = _position_on_side(side)
    foot = position[2] * _side_normal(side) - position[0] * local_receiver.axis_u - position[1] * local_receiver.axis_v
    for e in range(grid.edge_count):
        edge_ends = planes.edges[grid.first_edge + e]
        axis = planes.edge_axes[grid.first_edge + e]
        a = foot + edge_ends[0] * local_receiver.axis_u + edge_ends[1] * local_receiver.axis_v
        b = foot + edge_ends[2] * local_receiver.axis_u + edge_ends[3] * local_receiver.axis_v
        n = wp.cross(a, axis[0] * local_receiver.axis_u + axis[1] * local_receiver.axis_v)
        edges[side.first_edge + e] = viewed_edge(
            wp.where(side.is_back, a, b), wp.where(side.is_back, b, a), wp.where(side.is_back, 1.0, -1.0) * n
        )


@wp.func
def _view_outline_adjoint(
    planes: PlaneArrays, side: PlaneSide, edges: wp.array(dtype=ViewedEdge), adj_local_receiver: LocalReceiver
):
    """Add to the gradient of the local receiver."""
    local_receiver, grid = side.local_receiver, side.grid
    position = _position_on_side(side)
    sign = wp.where(side.is_back, 1.0, -1.0)
    adj_foot = wp.vec3()
    for e in range(grid.edge_count):
        edge = edges[side.first_edge + e]
        edge_ends = planes.edges[grid.first_edge + e]
        axis = planes.edge_axes[grid.first_edge + e]
        adj_n = (sign / edge.length) * edge.adj_normal
        adj_a = wp.cross(axis[0] * local_receiver.axis_u + axis[1] * local_receiver.axis_v, adj_n)
        adj_axis = wp.cross(adj_n, wp.where(side.is_back, edge.begin, edge.end))
        adj_foot += adj_a
        adj_local_receiver.axis_u = (
            adj_local_receiver.axis_u + (edge_ends[0] - position[0]) * adj_a + axis[0] * adj_axis
        )
        adj_local_receiver.axis_v = (
            adj_local_receiver.axis_v + (edge_ends[1] - position[1]) * adj_a + axis[1] * adj_axis
        )
    adj_local_receiver.normal = adj_local_receiver.normal + (sign * position[2]) * adj_foot
    adj_position = wp.vec3(
        -wp.dot(adj_foot, local_receiver.axis_u),
        -wp.dot(adj_foot, local_receiver.axis_v),
        sign * wp.dot(adj_foot, local_receiver.normal),
    )
    return _side_adjoint(side, wp.vec3(), adj_position, wp.vec3(), adj_local_receiver)


# ---------------------------------------------------------------------------------------------------- receivers


@wp.func
def _with_side(
    planes: PlaneArrays,
    plane: int,
    is_back: bool,
    weight: float,
    local_receiver: LocalReceiver,
    receiver: PlaneReceiver,
):
    """Store a side and its outline if its weight is not 0; return the number of stored sides."""
    if weight <= 0.0:
        return receiver.side_count
    side = StoredSide()
    side.plane = plane
    side.is_back = is_back
    side.weight = weight
    side.local_receiver = local_receiver
    receiver.sides[receiver.side_count] = side
    _view_outline(planes, load_side(planes, receiver, receiver.side_count), receiver.edges)
    return receiver.side_count + 1


@wp.func
def prepare_receiver(
    row: int, worker: int, inputs: PlaneInputs, sides: wp.array2d(dtype=StoredSide), edges: wp.array2d(dtype=ViewedEdge)
):
    """Store the sides of planes that a receiver may hit, and where it is relative to them, in scratch memory."""
    receiver = PlaneReceiver()
    batch, index = split_row(row, inputs.points.shape[1])
    receiver.batch = batch
    receiver.index = index
    receiver.slot = scratch_slot(worker, row)
    receiver.sides = sides[receiver.slot]
    receiver.edges = edges[receiver.slot]
    planes = inputs.planes
    frame_batch = instance_in(batch, inputs.frames.shape[0])
    for plane in range(planes.grids.shape[0]):
        if plane != planes.self_plane:
            local_receiver = find_local_receiver(inputs.points[batch, index], inputs.frames[frame_batch], plane)
            if wp.length_sq(local_receiver.normal) > 0.0:
                # below the plane the front fades, and the back takes over
                front = front_of(
                    inputs.front_weights, planes.grids[plane], local_receiver.position[2], batch, index, plane
                )
                receiver.side_count = _with_side(planes, plane, False, front, local_receiver, receiver)
                receiver.side_count = _with_side(planes, plane, True, 1.0 - front, local_receiver, receiver)
    return receiver


@wp.func
def prepare_receiver_adjoint(
    receiver: PlaneReceiver,
    inputs: PlaneInputs,
    adj_points: wp.array2d(dtype=wp.vec3),
    adj_front_weights: wp.array3d(dtype=wp.float32),
    adj_frames: wp.array2d(dtype=wp.vec3),
):
    """Add to the gradients of points, front weights and frames."""
    batch, index = receiver.batch, receiver.index
    frame_batch = instance_in(batch, inputs.frames.shape[0])
    point, frames = inputs.points[batch, index], inputs.frames[frame_batch]
    adj_point = wp.vec3()
    for i in range(receiver.side_count):
        side = load_side(inputs.planes, receiver, i)
        adj_local = _view_outline_adjoint(inputs.planes, side, receiver.edges, receiver.sides[i].adj_local_receiver)
        adj_front = wp.where(side.is_back, -1.0, 1.0) * receiver.sides[i].adj_weight
        height = side.local_receiver.position[2]
        adj_height = front_of_adjoint(
            inputs.front_weights, side.grid, height, adj_front, batch, index, side.plane, adj_front_weights
        )
        adj_local.position = adj_local.position + wp.vec3(0.0, 0.0, adj_height)
        adj_point += find_local_receiver_adjoint(
            point, frames, side.plane, side.local_receiver, adj_local, frame_batch, adj_frames
        )
    if adj_points:
        adj_points[batch, index] = adj_points[batch, index] + adj_point


# ---------------------------------------------------------------------------------------------------- cells


@wp.struct
class VisibleCell:
    """The part of a cell that a receiver sees."""

    direction: wp.vec3
    radius: float


@wp.func
def visible_cell(planes: PlaneArrays, normal: wp.vec3, direction: wp.vec3):
    """The largest disc in a cell that is above the horizon of a receiver in a plane; the cell itself for others.

    Below its horizon nothing covers the cell but the receiver's own plane, which is not asked.
    """
    cell = VisibleCell()
    cell.direction = direction
    cell.radius = planes.radius
    cosine = wp.dot(normal, direction)
    if planes.self_plane >= 0 and cosine > 0.0 and cosine < planes.radius:
        cell.direction = wp.normalize(direction + (0.5 * (planes.radius - cosine)) * (normal - cosine * direction))
        cell.radius = 0.5 * (planes.radius + cosine)
    return cell


@wp.func
def is_towards_side(planes: PlaneArrays, receiver: PlaneReceiver, index: int, cell: VisibleCell):
    """Whether a cell looks at the plane of one of the sides that a receiver sees, at least in part."""
    along_normal = wp.dot(receiver.sides[index].local_receiver.normal, cell.direction)
    return wp.where(receiver.sides[index].is_back, along_normal, -along_normal) > -planes.radius


@wp.func
def footprint_on_side(planes: PlaneArrays, side: PlaneSide, direction: wp.vec3):
    """Find the footprint of a cell on a side."""
    return find_footprint(planes, _position_on_side(side), _direction_on_side(side, direction))


@wp.func
def footprint_on_side_adjoint(
    planes: PlaneArrays,
    side: PlaneSide,
    direction: wp.vec3,
    footprint: PlaneFootprint,
    adj_mip: wp.vec3,
    sides: wp.array(dtype=StoredSide),
):
    """Add the gradients of :func:`.cells.fetch` to the local receiver's; return the direction's."""
    adj_cosine = -0.5 * footprint.per_cosine * adj_mip[2]  # texels are as wide as t / √c′
    adj_distance = float(0.0)
    if adj_mip[2] != 0.0:
        adj_distance = adj_mip[2] / footprint.distance
    adj_position, adj_direction = find_footprint_adjoint(
        planes,
        _direction_on_side(side, direction),
        footprint,
        adj_distance,
        adj_cosine,
        wp.vec2(adj_mip[0], adj_mip[1]),
    )
    sides[side.index].adj_local_receiver = _side_adjoint(
        side, direction, adj_position, adj_direction, sides[side.index].adj_local_receiver
    )
    return (
        adj_direction[0] * side.local_receiver.axis_u
        + adj_direction[1] * side.local_receiver.axis_v
        + adj_direction[2] * _side_normal(side)
    )


@wp.func
def inverse_distance_on_side(side: PlaneSide):
    """Vector g of a side: along a direction ω its plane is 1/(g·ω) away [scene units]."""
    return _side_normal(side) / (side.local_receiver.scale * _position_on_side(side)[2])


@wp.func
def inverse_distance_on_side_adjoint(
    side: PlaneSide, inverse_distance: wp.vec3, adj_inverse_distance: wp.vec3, sides: wp.array(dtype=StoredSide)
):
    """Add to the gradients of the local receiver."""
    height = _position_on_side(side)[2]
    adj_log = -wp.dot(adj_inverse_distance, inverse_distance)  # of the height in scene units
    adj_position = wp.vec3(0.0, 0.0, adj_log / height)
    adj_local_receiver = _side_adjoint(side, wp.vec3(), adj_position, wp.vec3(), sides[side.index].adj_local_receiver)
    sign = wp.where(side.is_back, 1.0, -1.0)
    adj_local_receiver.normal = (
        adj_local_receiver.normal + (sign / (side.local_receiver.scale * height)) * adj_inverse_distance
    )
    adj_local_receiver.scale = adj_local_receiver.scale + adj_log / side.local_receiver.scale
    sides[side.index].adj_local_receiver = adj_local_receiver


@wp.func
def outline_coverage_on_side(
    planes: PlaneArrays, side: PlaneSide, cell: VisibleCell, edges: wp.array(dtype=ViewedEdge)
):
    """Coverage (h, μ) of a cell by the outline of a plane, times the weight of its side."""
    side_normal = _side_normal(side)
    if wp.dot(side_normal, cell.direction) <= -planes.radius:
        return wp.vec4()
    first, count = side.first_edge, side.grid.edge_count
    if side.grid.is_convex == 1:
        return side.weight * convex_coverage(edges, first, count, cell.direction, cell.radius)
    return side.weight * outline_coverage(
        edges, first, count, side_normal, side.local_receiver.axis_u, cell.direction, cell.radius
    )
