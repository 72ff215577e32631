"""Sides of planes that a receiver sees, with their outlines, and the part of a cell that each covers."""

import warp as wp

from warpshadow.device.batch import instance_in
from warpshadow.device.parallel import Scratch, scratch_place, split_row
from warpshadow.stages.cell_coverage import ViewedEdge, convex_coverage, outline_coverage, viewed_edge
from warpshadow.stages.planes.cells import (
    PlaneArrays,
    PlaneFootprint,
    ReceiverInPlane,
    find_footprint,
    find_footprint_adjoint,
    find_in_plane,
    find_in_plane_adjoint,
    front_of,
    front_of_adjoint,
    on_side,
    side_adjoint,
    toward_side,
)
from warpshadow.stages.planes.prepared import PlaneBlockers, PlaneGrid

# Scratch of a receiver, vec3. Its position relative to each plane f, whose gradients have the same places:
#     4 f        where it is along both axes, and its height
#     4 f + 1    the axis u, of unit length; 4 f + 2 the axis v, and 4 f + 3 the normal
# Sides i that it may meet, from ``4 plane_count`` on:
#     i          the plane, 1 for its back, and which part of the side is there
SIDE_ROWS = wp.constant(6)
"""Rows of scratch for each plane."""

# of an outline as the front and the back see it
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
def load_side(scene: PlaneArrays, i: int, store: wp.array(dtype=wp.vec3)):
    """Load side i of the sides that a receiver sees."""
    side = PlaneSide()
    side.row = 4 * scene.grids.shape[0] + i
    stored = store[side.row]
    side.f = int(stored[0])
    side.is_back = stored[1] > 0.0
    side.weight = stored[2]
    grid = scene.grids[side.f]
    side.first_edge = _VIEWS * grid.first_edge + wp.where(side.is_back, grid.edge_count, 0)
    return side


@wp.func
def load_place(store: wp.array(dtype=wp.vec3), f: int):
    """Where a receiver is relative to a plane."""
    place = ReceiverInPlane()
    place.at = store[4 * f]
    place.along_u = store[4 * f + 1]
    place.along_v = store[4 * f + 2]
    place.normal = store[4 * f + 3]
    return place


@wp.func
def store_place(store: wp.array(dtype=wp.vec3), f: int, place: ReceiverInPlane):
    """Overwrite it."""
    store[4 * f] = place.at
    store[4 * f + 1] = place.along_u
    store[4 * f + 2] = place.along_v
    store[4 * f + 3] = place.normal


@wp.func
def _down(place: ReceiverInPlane, side: PlaneSide):
    """Normal of a plane away from a side."""
    return wp.where(side.is_back, 1.0, -1.0) * place.normal


@wp.func
def _view_outline(
    scene: PlaneArrays, grid: PlaneGrid, side: PlaneSide, place: ReceiverInPlane, edges: wp.array(dtype=ViewedEdge)
):
    """Store the outline of a plane as a receiver over one side sees it; n = ±(a − x) × (b − a) / |b − a|.

    Edges run so that the mesh is to their left as the receiver sees it: the front's from b to a.
    """
    at = on_side(grid, place, side.is_back)
    foot = at[2] * _down(place, side) - at[0] * place.along_u - at[1] * place.along_v
    for e in range(grid.edge_count):
        ends = scene.edges[grid.first_edge + e]
        axis = scene.edge_axes[grid.first_edge + e]
        a = foot + ends[0] * place.along_u + ends[1] * place.along_v
        b = foot + ends[2] * place.along_u + ends[3] * place.along_v
        n = wp.cross(a, axis[0] * place.along_u + axis[1] * place.along_v)
        edges[side.first_edge + e] = viewed_edge(
            wp.where(side.is_back, a, b), wp.where(side.is_back, b, a), wp.where(side.is_back, 1.0, -1.0) * n
        )


@wp.func
def _view_outline_adjoint(
    scene: PlaneArrays,
    grid: PlaneGrid,
    side: PlaneSide,
    place: ReceiverInPlane,
    edges: wp.array(dtype=ViewedEdge),
    adj_place: ReceiverInPlane,
):
    """Add to the gradient of the receiver relative to the plane."""
    at = on_side(grid, place, side.is_back)
    sign = wp.where(side.is_back, 1.0, -1.0)
    adj_foot = wp.vec3()
    for e in range(grid.edge_count):
        edge = edges[side.first_edge + e]
        ends = scene.edges[grid.first_edge + e]
        axis = scene.edge_axes[grid.first_edge + e]
        adj_n = (sign / edge.length) * edge.adj_normal
        adj_a = wp.cross(axis[0] * place.along_u + axis[1] * place.along_v, adj_n)
        adj_axis = wp.cross(adj_n, wp.where(side.is_back, edge.begin, edge.end))
        adj_foot += adj_a
        adj_place.along_u = adj_place.along_u + (ends[0] - at[0]) * adj_a + axis[0] * adj_axis
        adj_place.along_v = adj_place.along_v + (ends[1] - at[1]) * adj_a + axis[1] * adj_axis
    adj_place.normal = adj_place.normal + (sign * at[2]) * adj_foot
    adj_at = wp.vec3(
        -wp.dot(adj_foot, place.along_u), -wp.dot(adj_foot, place.along_v), sign * wp.dot(adj_foot, place.normal)
    )
    return side_adjoint(grid, place, side.is_back, wp.vec3(), adj_at, wp.vec3(), adj_place)


@wp.func
def _add_side(
    scene: PlaneArrays,
    f: int,
    is_back: float,
    weight: float,
    side_count: int,
    place: ReceiverInPlane,
    store: wp.array(dtype=wp.vec3),
    edges: wp.array(dtype=ViewedEdge),
):
    """Store a side with its outline if some of it is there; returns how many sides are stored."""
    if weight <= 0.0:
        return side_count
    store[4 * scene.grids.shape[0] + side_count] = wp.vec3(float(f), is_back, weight)
    _view_outline(scene, scene.grids[f], load_side(scene, side_count, store), place, edges)
    return side_count + 1


@wp.func
def place_receiver(
    row: int,
    worker: int,
    points: wp.array2d(dtype=wp.vec3),
    frames: wp.array2d(dtype=wp.vec3),
    fronts: wp.array3d(dtype=wp.float32),
    scene: PlaneArrays,
    scratch: wp.array2d(dtype=wp.vec3),
    viewed_edges: wp.array2d(dtype=ViewedEdge),
):
    """Store a receiver's position relative to each plane, and the sides that it may hit.

    Returns its instance and number, its place in scratch memory, and how many sides are stored.
    """
    batch, receiver = split_row(row, points.shape[1])
    scratch_row = scratch_place(worker, row)
    store, edges = scratch[scratch_row], viewed_edges[scratch_row]
    frame_batch = instance_in(batch, frames.shape[0])
    side_count = int(0)
    for f in range(scene.grids.shape[0]):
        place = find_in_plane(points[batch, receiver], frames[frame_batch], f)
        store_place(store, f, place)
        if f != scene.skip and wp.length_sq(place.normal) > 0.0:
            # below the plane the front fades, and the back takes over
            front = front_of(fronts, scene.grids[f], place.at[2], batch, receiver, f)
            side_count = _add_side(scene, f, 0.0, front, side_count, place, store, edges)
            side_count = _add_side(scene, f, 1.0, 1.0 - front, side_count, place, store, edges)
    return batch, receiver, scratch_row, side_count


@wp.func
def place_receiver_adjoint(
    batch: int,
    receiver: int,
    side_count: int,
    points: wp.array2d(dtype=wp.vec3),
    frames: wp.array2d(dtype=wp.vec3),
    fronts: wp.array3d(dtype=wp.float32),
    scene: PlaneArrays,
    store: wp.array(dtype=wp.vec3),
    edges: wp.array(dtype=ViewedEdge),
    adj_store: wp.array(dtype=wp.vec3),
    adj_points: wp.array2d(dtype=wp.vec3),
    adj_fronts: wp.array3d(dtype=wp.float32),
    adj_frames: wp.array2d(dtype=wp.vec3),
):
    """Add to the gradients of points, fronts and frames."""
    for i in range(side_count):
        side = load_side(scene, i, store)
        grid = scene.grids[side.f]
        place = load_place(store, side.f)
        adj = _view_outline_adjoint(scene, grid, side, place, edges, load_place(adj_store, side.f))
        adj_front = wp.where(side.is_back, -1.0, 1.0) * adj_store[side.row][2]
        adj_height = front_of_adjoint(fronts, grid, place.at[2], adj_front, batch, receiver, side.f, adj_fronts)
        adj.at = adj.at + wp.vec3(0.0, 0.0, adj_height)
        store_place(adj_store, side.f, adj)
    frame_batch = instance_in(batch, frames.shape[0])
    adj_point = wp.vec3()
    for f in range(scene.grids.shape[0]):
        place, adj = load_place(store, f), load_place(adj_store, f)
        adj_point += find_in_plane_adjoint(
            points[batch, receiver], frames[frame_batch], f, place, adj, frame_batch, adj_frames
        )
    if adj_points:
        adj_points[batch, receiver] = adj_points[batch, receiver] + adj_point


@wp.struct
class VisibleCell:
    """The part of a cell that a receiver sees."""

    direction: wp.vec3
    radius: float


@wp.func
def visible_cell(scene: PlaneArrays, normal: wp.vec3, direction: wp.vec3):
    """The largest disc in a cell that is above the horizon of a receiver in a plane; the cell itself for others.

    Below its horizon nothing covers the cell but the receiver's own plane, which is not asked.
    """
    cell = VisibleCell()
    cell.direction = direction
    cell.radius = scene.radius
    cosine = wp.dot(normal, direction)
    if scene.skip >= 0 and cosine > 0.0 and cosine < scene.radius:
        cell.direction = wp.normalize(direction + (0.5 * (scene.radius - cosine)) * (normal - cosine * direction))
        cell.radius = 0.5 * (scene.radius + cosine)
    return cell


@wp.func
def footprint_on_side(scene: PlaneArrays, grid: PlaneGrid, side: PlaneSide, place: ReceiverInPlane, direction: wp.vec3):
    """Find the footprint of a cell on a side."""
    return find_footprint(scene, on_side(grid, place, side.is_back), toward_side(place, side.is_back, direction))


@wp.func
def footprint_on_side_adjoint(
    scene: PlaneArrays,
    grid: PlaneGrid,
    side: PlaneSide,
    place: ReceiverInPlane,
    direction: wp.vec3,
    footprint: PlaneFootprint,
    adj_mip: wp.vec3,
    adj_distance: float,
    adj_radius: float,
    adj_store: wp.array(dtype=wp.vec3),
):
    """Add to the gradients of the receiver relative to the plane.

    Given are the gradients of :func:`.cells.fetch`, of the distance t, and of the radius t ρ / c′ of the footprint.
    """
    adj_cosine = -footprint.per_cosine * (
        adj_radius * scene.radius * footprint.distance * footprint.per_cosine + 0.5 * adj_mip[2]
    )
    adj_t = adj_distance + adj_radius * scene.radius * footprint.per_cosine
    if adj_mip[2] != 0.0:  # texels are as wide as t / √c′
        adj_t += adj_mip[2] / footprint.distance
    toward, adj_center = toward_side(place, side.is_back, direction), wp.vec2(adj_mip[0], adj_mip[1])
    adj_at, adj_toward = find_footprint_adjoint(scene, toward, footprint, adj_t, adj_cosine, adj_center)
    adj_place = load_place(adj_store, side.f)
    store_place(adj_store, side.f, side_adjoint(grid, place, side.is_back, direction, adj_at, adj_toward, adj_place))


@wp.func
def outline_coverage_on_side(
    scene: PlaneArrays,
    grid: PlaneGrid,
    side: PlaneSide,
    place: ReceiverInPlane,
    cell: VisibleCell,
    edges: wp.array(dtype=ViewedEdge),
):
    """Coverage (h, μ) of a cell by the outline of a plane, as much of it as is seen of the side."""
    down = _down(place, side)
    if wp.dot(down, cell.direction) <= -scene.radius:
        return wp.vec4()
    first, count = side.first_edge, grid.edge_count
    if grid.is_convex == 1:
        return side.weight * convex_coverage(edges, first, count, cell.direction, cell.radius)
    return side.weight * outline_coverage(edges, first, count, down, place.along_u, cell.direction, cell.radius)
