"""Sides of planes that a receiver sees, with their outlines, and the part of a cell that each covers."""

import warp as wp

from warpshadow.device.batch import instance_in
from warpshadow.device.parallel import Scratch, scratch_slot, split_row
from warpshadow.stages.cell_coverage import ViewedEdge, convex_coverage, outline_coverage, viewed_edge
from warpshadow.stages.planes.cells import (
    LocalReceiver,
    PlaneArrays,
    PlaneFootprint,
    direction_on_side,
    find_footprint,
    find_footprint_adjoint,
    find_local_receiver,
    find_local_receiver_adjoint,
    front_of,
    front_of_adjoint,
    position_on_side,
    side_adjoint,
)
from warpshadow.stages.planes.prepared import PlaneBlockers, PlaneGrid

# Rows of a receiver's scratch, each a vec3; scratch of gradients has the same rows. Of n planes,
#     5 f            has the receiver's position in the axes of plane f (:class:`.cells.LocalReceiver`);
#     5 f + 1, 2, 3  have the plane's axes u and v, of unit length, and its normal;
#     5 f + 4        has the scale of its body;
#     5 n + i        has side i of the sides that the receiver sees, at most 2 n: the number of its plane, 1 for a back
#                    or 0 for a front, and the part of the side that the receiver sees.
_RECEIVER_ROWS = wp.constant(5)
SIDE_ROWS = wp.constant(7)
"""Rows of scratch for each plane: five, and one for each of its two sides."""

# Views of an outline: the front's and the back's.
_VIEWS = wp.constant(2)


def receiver_scratch(planes: PlaneBlockers, rows: int = SIDE_ROWS) -> list[Scratch]:
    """Scratch of a receiver: ``rows`` vec3 for each plane, and viewed edges."""
    return [Scratch((rows * planes.count,), wp.vec3), Scratch((_VIEWS * planes.edges.size,), ViewedEdge)]


@wp.struct
class PlaneSide:
    """A side of a plane, as it is stored for a receiver."""

    row: int  # of scratch
    f: int  # number of the plane
    is_back: wp.bool
    weight: float  # part of the side that is there
    first_edge: int  # of its viewed edges


@wp.func
def load_side(planes: PlaneArrays, i: int, store: wp.array(dtype=wp.vec3)):
    """Load side i of the sides that a receiver sees."""
    side = PlaneSide()
    side.row = _RECEIVER_ROWS * planes.grids.shape[0] + i
    stored_side = store[side.row]
    side.f = int(stored_side[0])
    side.is_back = stored_side[1] > 0.0
    side.weight = stored_side[2]
    grid = planes.grids[side.f]
    side.first_edge = _VIEWS * grid.first_edge + wp.where(side.is_back, grid.edge_count, 0)
    return side


@wp.func
def load_local_receiver(store: wp.array(dtype=wp.vec3), f: int):
    """Load a receiver in the axes of a plane."""
    local_receiver = LocalReceiver()
    row = _RECEIVER_ROWS * f
    local_receiver.position = store[row]
    local_receiver.axis_u = store[row + 1]
    local_receiver.axis_v = store[row + 2]
    local_receiver.normal = store[row + 3]
    local_receiver.scale = store[row + 4][0]
    return local_receiver


@wp.func
def store_local_receiver(store: wp.array(dtype=wp.vec3), f: int, local_receiver: LocalReceiver):
    """Overwrite it."""
    row = _RECEIVER_ROWS * f
    store[row] = local_receiver.position
    store[row + 1] = local_receiver.axis_u
    store[row + 2] = local_receiver.axis_v
    store[row + 3] = local_receiver.normal
    store[row + 4] = wp.vec3(local_receiver.scale, 0.0, 0.0)


@wp.func
def _side_normal(local_receiver: LocalReceiver, side: PlaneSide):
    """Normal of a plane away from a side."""
    return wp.where(side.is_back, 1.0, -1.0) * local_receiver.normal


@wp.func
def _view_outline(
    planes: PlaneArrays,
    grid: PlaneGrid,
    side: PlaneSide,
    local_receiver: LocalReceiver,
    edges: wp.array(dtype=ViewedEdge),
):
    """Store the outline of a plane as a receiver over one side sees it; n = ±(a − x) × (b − a) / |b − a|.

    Edges run so that the mesh is to their left as the receiver sees it: the front's from b to a.
    """
    position = position_on_side(grid, local_receiver, side.is_back)
    foot = (
        position[2] * _side_normal(local_receiver, side)
        - position[0] * local_receiver.axis_u
        - position[1] * local_receiver.axis_v
    )
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
    planes: PlaneArrays,
    grid: PlaneGrid,
    side: PlaneSide,
    local_receiver: LocalReceiver,
    edges: wp.array(dtype=ViewedEdge),
    adj_local_receiver: LocalReceiver,
):
    """Add to the gradient of the receiver relative to the plane."""
    position = position_on_side(grid, local_receiver, side.is_back)
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
    return side_adjoint(grid, local_receiver, side.is_back, wp.vec3(), adj_position, wp.vec3(), adj_local_receiver)


@wp.func
def _add_side(
    planes: PlaneArrays,
    f: int,
    is_back: float,
    weight: float,
    side_count: int,
    local_receiver: LocalReceiver,
    store: wp.array(dtype=wp.vec3),
    edges: wp.array(dtype=ViewedEdge),
):
    """Store a side with its outline if some of it is there; returns how many sides are stored."""
    if weight <= 0.0:
        return side_count
    store[_RECEIVER_ROWS * planes.grids.shape[0] + side_count] = wp.vec3(float(f), is_back, weight)
    _view_outline(planes, planes.grids[f], load_side(planes, side_count, store), local_receiver, edges)
    return side_count + 1


@wp.func
def prepare_receiver(
    row: int,
    worker: int,
    points: wp.array2d(dtype=wp.vec3),
    frames: wp.array2d(dtype=wp.vec3),
    fronts: wp.array3d(dtype=wp.float32),
    planes: PlaneArrays,
    scratch: wp.array2d(dtype=wp.vec3),
    viewed_edges: wp.array2d(dtype=ViewedEdge),
):
    """Store a receiver's position relative to each plane, and the sides that it may hit.

    Returns its instance and number, its place in scratch memory, and how many sides are stored.
    """
    batch, receiver = split_row(row, points.shape[1])
    scratch_row = scratch_slot(worker, row)
    store, edges = scratch[scratch_row], viewed_edges[scratch_row]
    frame_batch = instance_in(batch, frames.shape[0])
    side_count = int(0)
    for f in range(planes.grids.shape[0]):
        local_receiver = find_local_receiver(points[batch, receiver], frames[frame_batch], f)
        store_local_receiver(store, f, local_receiver)
        if f != planes.skip and wp.length_sq(local_receiver.normal) > 0.0:
            # below the plane the front fades, and the back takes over
            front = front_of(fronts, planes.grids[f], local_receiver.position[2], batch, receiver, f)
            side_count = _add_side(planes, f, 0.0, front, side_count, local_receiver, store, edges)
            side_count = _add_side(planes, f, 1.0, 1.0 - front, side_count, local_receiver, store, edges)
    return batch, receiver, scratch_row, side_count


@wp.func
def prepare_receiver_adjoint(
    batch: int,
    receiver: int,
    side_count: int,
    points: wp.array2d(dtype=wp.vec3),
    frames: wp.array2d(dtype=wp.vec3),
    fronts: wp.array3d(dtype=wp.float32),
    planes: PlaneArrays,
    store: wp.array(dtype=wp.vec3),
    edges: wp.array(dtype=ViewedEdge),
    adj_store: wp.array(dtype=wp.vec3),
    adj_points: wp.array2d(dtype=wp.vec3),
    adj_fronts: wp.array3d(dtype=wp.float32),
    adj_frames: wp.array2d(dtype=wp.vec3),
):
    """Add to the gradients of points, fronts and frames."""
    for i in range(side_count):
        side = load_side(planes, i, store)
        grid = planes.grids[side.f]
        local_receiver = load_local_receiver(store, side.f)
        adj_receiver = _view_outline_adjoint(
            planes, grid, side, local_receiver, edges, load_local_receiver(adj_store, side.f)
        )
        adj_front = wp.where(side.is_back, -1.0, 1.0) * adj_store[side.row][2]
        adj_height = front_of_adjoint(
            fronts, grid, local_receiver.position[2], adj_front, batch, receiver, side.f, adj_fronts
        )
        adj_receiver.position = adj_receiver.position + wp.vec3(0.0, 0.0, adj_height)
        store_local_receiver(adj_store, side.f, adj_receiver)
    frame_batch = instance_in(batch, frames.shape[0])
    adj_point = wp.vec3()
    for f in range(planes.grids.shape[0]):
        local_receiver, adj_receiver = load_local_receiver(store, f), load_local_receiver(adj_store, f)
        adj_point += find_local_receiver_adjoint(
            points[batch, receiver], frames[frame_batch], f, local_receiver, adj_receiver, frame_batch, adj_frames
        )
    if adj_points:
        adj_points[batch, receiver] = adj_points[batch, receiver] + adj_point


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
    if planes.skip >= 0 and cosine > 0.0 and cosine < planes.radius:
        cell.direction = wp.normalize(direction + (0.5 * (planes.radius - cosine)) * (normal - cosine * direction))
        cell.radius = 0.5 * (planes.radius + cosine)
    return cell


@wp.func
def footprint_on_side(
    planes: PlaneArrays, grid: PlaneGrid, side: PlaneSide, local_receiver: LocalReceiver, direction: wp.vec3
):
    """Find the footprint of a cell on a side."""
    return find_footprint(
        planes,
        position_on_side(grid, local_receiver, side.is_back),
        direction_on_side(local_receiver, side.is_back, direction),
    )


@wp.func
def footprint_on_side_adjoint(
    planes: PlaneArrays,
    grid: PlaneGrid,
    side: PlaneSide,
    local_receiver: LocalReceiver,
    direction: wp.vec3,
    footprint: PlaneFootprint,
    adj_mip: wp.vec3,
    adj_store: wp.array(dtype=wp.vec3),
):
    """Add to the gradients of the receiver relative to the plane, given those of :func:`.cells.fetch`.

    Returns the gradient of the direction.
    """
    adj_cosine = -0.5 * footprint.per_cosine * adj_mip[2]  # texels are as wide as t / √c′
    adj_distance = float(0.0)
    if adj_mip[2] != 0.0:
        adj_distance = adj_mip[2] / footprint.distance
    local_direction, adj_center = (
        direction_on_side(local_receiver, side.is_back, direction),
        wp.vec2(adj_mip[0], adj_mip[1]),
    )
    adj_position, adj_direction = find_footprint_adjoint(
        planes, local_direction, footprint, adj_distance, adj_cosine, adj_center
    )
    adj_local_receiver = load_local_receiver(adj_store, side.f)
    store_local_receiver(
        adj_store,
        side.f,
        side_adjoint(grid, local_receiver, side.is_back, direction, adj_position, adj_direction, adj_local_receiver),
    )
    return (
        adj_direction[0] * local_receiver.axis_u
        + adj_direction[1] * local_receiver.axis_v
        + adj_direction[2] * _side_normal(local_receiver, side)
    )


@wp.func
def inverse_distance_on_side(grid: PlaneGrid, side: PlaneSide, local_receiver: LocalReceiver):
    """Vector g of a side: along a direction ω its plane is 1/(g·ω) away [scene units]."""
    height = local_receiver.scale * position_on_side(grid, local_receiver, side.is_back)[2]
    return _side_normal(local_receiver, side) / height


@wp.func
def inverse_distance_on_side_adjoint(
    grid: PlaneGrid,
    side: PlaneSide,
    local_receiver: LocalReceiver,
    inverse_distance: wp.vec3,
    adj_inverse_distance: wp.vec3,
    adj_store: wp.array(dtype=wp.vec3),
):
    """Add to the gradients of the receiver relative to the plane."""
    height = position_on_side(grid, local_receiver, side.is_back)[2]
    adj_log = -wp.dot(adj_inverse_distance, inverse_distance)  # of the height in scene units
    adj_receiver = side_adjoint(
        grid,
        local_receiver,
        side.is_back,
        wp.vec3(),
        wp.vec3(0.0, 0.0, adj_log / height),
        wp.vec3(),
        load_local_receiver(adj_store, side.f),
    )
    sign = wp.where(side.is_back, 1.0, -1.0)
    adj_receiver.normal = adj_receiver.normal + (sign / (local_receiver.scale * height)) * adj_inverse_distance
    adj_receiver.scale = adj_receiver.scale + adj_log / local_receiver.scale
    store_local_receiver(adj_store, side.f, adj_receiver)


@wp.func
def outline_coverage_on_side(
    planes: PlaneArrays,
    grid: PlaneGrid,
    side: PlaneSide,
    local_receiver: LocalReceiver,
    cell: VisibleCell,
    edges: wp.array(dtype=ViewedEdge),
):
    """Coverage (h, μ) of a cell by the outline of a plane, as much of it as is seen of the side."""
    side_normal = _side_normal(local_receiver, side)
    if wp.dot(side_normal, cell.direction) <= -planes.radius:
        return wp.vec4()
    first_edge_index, count = side.first_edge, grid.edge_count
    if grid.is_convex == 1:
        return side.weight * convex_coverage(edges, first_edge_index, count, cell.direction, cell.radius)
    return side.weight * outline_coverage(
        edges, first_edge_index, count, side_normal, local_receiver.axis_u, cell.direction, cell.radius
    )
