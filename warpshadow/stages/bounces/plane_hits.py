"""Plane hits: the sides of planes that a cell of a receiver meets, and how they hide each other.

Of each side k its coverage h_k is known, the centroid y_k = μ_k / h_k of what it covers, in radii ρ from the middle of
the cell, and the inverse of its distance along a direction ω, which is g_k·ω, g_k = N_k / d_k. Sides are taken to
cover parts of a cell that do not depend on each other. So k and j share a part around ω + ρ (y_k + y_j). In a share

    S_kj = S((g_j − g_k)·(ω + ρ (y_k + y_j)) / ρ √(h_k h_j (|P(g_j − g_k)|² + 10⁻⁶ (|g_k|² + |g_j|²))))

of it j is in front, where P projects to the plane that touches the sphere of directions and S is the smoothstep from 0
at −1 to 1 at 1: it cuts a disc as large as the shared part by the line in which both planes meet. Nearer sides leave
open, and block with a moment,

    o_k = 1 − Σ_j S_kj h_j,  m_k = Σ_j S_kj μ_j

So of a side the share h_k o_k is seen, and its centroid is that of what others leave open,

    z_k = −m_k / √(o_k² + |m_k|²)

away from where it is without them; the root holds it in the cell. Its radiosity is looked up along ω + ρ z_k, over a
footprint √o_k as wide.

A mean over all of a side in a cell has parts that nearer ones hide. Behind the front wall of a garage, which is open up
to one half of its height, lies ground in the sun. With sides looked up along ω and ordered by their distances there,
light of planes on receivers in the garage was 6.5% off (relative L2) and 4.5% too strong, and by this 2.6% and 1.4%; by
S alone 3.5%.
"""

from __future__ import annotations

import warp as wp

from warpshadow.stages.cell_coverage import ViewedEdge, coverage_adjoint
from warpshadow.stages.planes.cells import (
    LocalReceiver,
    PlaneArrays,
    fetch,
    fetch_adjoint,
    find_mip_footprint,
    is_covered_by_texels,
    scatter,
    smoothstep_slope,
)
from warpshadow.stages.planes.prepared import PlaneGrid
from warpshadow.stages.planes.sides import (
    SIDE_ROWS,
    PlaneSide,
    VisibleCell,
    footprint_on_side,
    footprint_on_side_adjoint,
    inverse_distance_on_side,
    inverse_distance_on_side_adjoint,
    load_local_receiver,
    load_side,
    outline_coverage_on_side,
)

_MIN_WEIGHT_SUM = wp.constant(1.0e-30)  # the least Σ h o
_MIN_OPEN = wp.constant(1.0e-4)  # the least o: of more than two sides each may hide another
_TIE = wp.constant(1.0e-6)  # planes whose distances differ by some thousandth of them are neither before the other
_MIN_WIDTH = wp.constant(1.0e-30)  # least denominator of S's argument


HIT_ROWS = SIDE_ROWS + 10
"""Rows of scratch for each plane: `SIDE_ROWS`, and five for the hit of a cell on each of two sides."""


@wp.struct
class PlaneHit:
    """The hit of a cell on a side of a plane; or its adjoint, which has no mesh share."""

    coverage: float  # h
    mesh_share: float  # of the outline's coverage, by texels
    open_share: float  # o
    radiosity: wp.vec3
    centroid: wp.vec3  # y, of the coverage [radii of the cell]
    inverse_distance: wp.vec3  # g
    blocked_moment: wp.vec3  # m


@wp.func
def load_hit(store: wp.array(dtype=wp.vec3), first_hit: int, side_index: int):
    """Load the hit on side ``side_index``; without coverage, all else in it is old. ``first_hit`` is side 0's row."""
    row = first_hit + 5 * side_index
    hit = PlaneHit()
    hit.coverage = store[row][0]
    hit.mesh_share = store[row][1]
    hit.open_share = store[row][2]
    hit.radiosity = store[row + 1]
    hit.centroid = store[row + 2]
    hit.inverse_distance = store[row + 3]
    hit.blocked_moment = store[row + 4]
    return hit


@wp.func
def clear_hit(store: wp.array(dtype=wp.vec3), first_hit: int, side_index: int):
    """Take its coverage away."""
    store[first_hit + 5 * side_index] = wp.vec3()


@wp.func
def is_hit(store: wp.array(dtype=wp.vec3), first_hit: int, side_index: int):
    """Whether side ``side_index`` covers a part of the cell."""
    return store[first_hit + 5 * side_index][0] > 0.0


@wp.func
def store_hit(store: wp.array(dtype=wp.vec3), first_hit: int, side_index: int, hit: PlaneHit):
    """Overwrite it."""
    row = first_hit + 5 * side_index
    store[row] = wp.vec3(hit.coverage, hit.mesh_share, hit.open_share)
    store[row + 1] = hit.radiosity
    store[row + 2] = hit.centroid
    store[row + 3] = hit.inverse_distance
    store[row + 4] = hit.blocked_moment


@wp.func
def _add_to_open_part(
    store: wp.array(dtype=wp.vec3), first_hit: int, side_index: int, open_share: float, blocked_moment: wp.vec3
):
    """Add to the open share and the blocked moment of a hit; or of its adjoint."""
    row = first_hit + 5 * side_index
    store[row] = store[row] + wp.vec3(0.0, 0.0, open_share)
    store[row + 4] = store[row + 4] + blocked_moment


@wp.func
def _add_to_hit(
    adj_store: wp.array(dtype=wp.vec3),
    first_hit: int,
    side_index: int,
    coverage: float,
    centroid: wp.vec3,
    inverse_distance: wp.vec3,
):
    """Add to the adjoint of a hit."""
    row = first_hit + 5 * side_index
    adj_store[row] = adj_store[row] + wp.vec3(coverage, 0.0, 0.0)
    adj_store[row + 2] = adj_store[row + 2] + centroid
    adj_store[row + 3] = adj_store[row + 3] + inverse_distance


@wp.func
def first_level_of_side(grid: PlaneGrid, is_back: bool):
    """First mip level of a side. A one-sided plane reuses its front levels for occupancy."""
    return grid.first_level + wp.where(is_back and grid.sides == 2, grid.level_count, 0)


@wp.func
def _is_sender(grid: PlaneGrid, side: PlaneSide):
    """Whether a side has patches."""
    return grid.sides == 2 or not side.is_back


@wp.struct
class _Overlap:
    """Which of two sides is in front where both cover a cell."""

    difference: wp.vec3  # g_j − g_k
    central_difference: float  # of inverse distances in the middle of the cell
    shared_centroid: wp.vec3  # y_k + y_j, of the shared part
    slope: float  # of the inverse distances' difference over the cell
    width: float  # range of that over the shared part
    relative: float  # argument of S: −1 wholly behind the other, 1 wholly in front


@wp.func
def _find_overlap(cell: VisibleCell, hit: PlaneHit, other: PlaneHit):
    overlap = _Overlap()
    overlap.difference = other.inverse_distance - hit.inverse_distance
    overlap.central_difference = wp.dot(overlap.difference, cell.direction)
    overlap.shared_centroid = hit.centroid + other.centroid
    overlap.slope = wp.sqrt(
        wp.length_sq(overlap.difference)
        - overlap.central_difference * overlap.central_difference
        + _TIE * (wp.length_sq(hit.inverse_distance) + wp.length_sq(other.inverse_distance))
    )
    overlap.width = cell.radius * overlap.slope * wp.sqrt(hit.coverage * other.coverage)
    if overlap.width > _MIN_WIDTH:
        overlap.relative = (
            overlap.central_difference + cell.radius * wp.dot(overlap.difference, overlap.shared_centroid)
        ) / overlap.width
    return overlap


@wp.func
def _block_each_other(cell: VisibleCell, k: int, j: int, first_hit: int, store: wp.array(dtype=wp.vec3)):
    """Take from each of two hits what the other blocks of it."""
    hit, other = load_hit(store, first_hit, k), load_hit(store, first_hit, j)
    share_in_front = wp.smoothstep(-1.0, 1.0, _find_overlap(cell, hit, other).relative)
    by_other = share_in_front * other.coverage
    by_hit = (1.0 - share_in_front) * hit.coverage
    _add_to_open_part(store, first_hit, k, -by_other, by_other * other.centroid)
    _add_to_open_part(store, first_hit, j, -by_hit, by_hit * hit.centroid)


@wp.func
def _block_each_other_adjoint(
    cell: VisibleCell,
    k: int,
    j: int,
    first_hit: int,
    store: wp.array(dtype=wp.vec3),
    adj_store: wp.array(dtype=wp.vec3),
):
    """Add to the gradients of two hits."""
    hit, other = load_hit(store, first_hit, k), load_hit(store, first_hit, j)
    adj_hit, adj_other = load_hit(adj_store, first_hit, k), load_hit(adj_store, first_hit, j)
    overlap = _find_overlap(cell, hit, other)
    share_in_front = wp.smoothstep(-1.0, 1.0, overlap.relative)
    share_behind = 1.0 - share_in_front
    adj_by_other = wp.dot(adj_hit.blocked_moment, other.centroid)
    if hit.open_share > _MIN_OPEN:
        adj_by_other -= adj_hit.open_share
    adj_by_hit = wp.dot(adj_other.blocked_moment, hit.centroid)
    if other.open_share > _MIN_OPEN:
        adj_by_hit -= adj_other.open_share
    adj_relative = (other.coverage * adj_by_other - hit.coverage * adj_by_hit) * smoothstep_slope(overlap.relative)
    adj_value = float(0.0)  # of the difference of inverse distances where both are
    adj_log = float(0.0)  # of its range
    adj_squares = float(0.0)  # of the slope's square, halved
    if adj_relative != 0.0 and overlap.width > _MIN_WIDTH:
        adj_value = adj_relative / overlap.width
        adj_log = -adj_relative * overlap.relative
        adj_squares = adj_log / (overlap.slope * overlap.slope)
    adj_shared_centroid = (adj_value * cell.radius) * overlap.difference
    adj_difference = (
        (adj_value - adj_squares * overlap.central_difference) * cell.direction
        + (adj_value * cell.radius) * overlap.shared_centroid
        + adj_squares * overlap.difference
    )
    _add_to_hit(
        adj_store,
        first_hit,
        k,
        share_behind * adj_by_hit + 0.5 * adj_log / hit.coverage,
        (share_behind * hit.coverage) * adj_other.blocked_moment + adj_shared_centroid,
        (_TIE * adj_squares) * hit.inverse_distance - adj_difference,
    )
    _add_to_hit(
        adj_store,
        first_hit,
        j,
        share_in_front * adj_by_other + 0.5 * adj_log / other.coverage,
        (share_in_front * other.coverage) * adj_hit.blocked_moment + adj_shared_centroid,
        (_TIE * adj_squares) * other.inverse_distance + adj_difference,
    )


@wp.func
def _unnormalized_direction(cell: VisibleCell, hit: PlaneHit):
    """Direction ω + ρ z of what others leave open of a side, not of unit length; and the length of (o, m)."""
    length = wp.sqrt(hit.open_share * hit.open_share + wp.length_sq(hit.blocked_moment))
    return cell.direction - (cell.radius / length) * hit.blocked_moment, length


@wp.func
def _visible_footprint(
    planes: PlaneArrays,
    grid: PlaneGrid,
    side: PlaneSide,
    local_receiver: LocalReceiver,
    cell: VisibleCell,
    hit: PlaneHit,
):
    """Direction and footprint of what others leave open of a side."""
    direction = cell.direction
    if hit.open_share < 1.0:
        visible_direction, _ = _unnormalized_direction(cell, hit)
        direction = wp.normalize(visible_direction)
    footprint = footprint_on_side(planes, grid, side, local_receiver, direction)
    footprint.extent = wp.sqrt(hit.open_share)
    return direction, footprint


@wp.func
def find_side_hits(
    planes: PlaneArrays,
    cell: VisibleCell,
    texels: wp.array(dtype=wp.vec3),
    weight: float,
    side_count: int,
    store: wp.array(dtype=wp.vec3),
    edges: wp.array(dtype=ViewedEdge),
):
    """Store which plane sides this cell hits; return how many. A share of 0 hits nothing."""
    hit_count = int(0)
    if weight <= 0.0:
        return hit_count
    first_hit = SIDE_ROWS * planes.grids.shape[0]
    for side_index in range(side_count):
        side = load_side(planes, side_index, store)
        grid = planes.grids[side.f]
        local_receiver = load_local_receiver(store, side.f)
        outline = outline_coverage_on_side(planes, grid, side, local_receiver, cell, edges)
        clear_hit(store, first_hit, side_index)
        if outline[0] > 0.0:
            hit = PlaneHit()
            hit.mesh_share = 1.0
            hit.open_share = 1.0
            if _is_sender(grid, side) or is_covered_by_texels(grid):
                first_level = first_level_of_side(grid, side.is_back)
                footprint = footprint_on_side(planes, grid, side, local_receiver, cell.direction)
                mip = find_mip_footprint(grid, planes, footprint)
                if is_covered_by_texels(grid):
                    hit.mesh_share = fetch(planes.covered, planes, first_level, mip)[0]
                if _is_sender(grid, side):
                    hit.radiosity = fetch(texels, planes, first_level, mip)
            hit.coverage = outline[0] * hit.mesh_share
            hit.centroid = wp.vec3(outline[1], outline[2], outline[3]) / outline[0]
            hit.inverse_distance = inverse_distance_on_side(grid, side, local_receiver)
            store_hit(store, first_hit, side_index, hit)
            hit_count += 1
    if hit_count > 1:
        _find_visible_parts(planes, cell, texels, side_count, store)
    return hit_count


@wp.func
def _find_visible_parts(
    planes: PlaneArrays,
    cell: VisibleCell,
    texels: wp.array(dtype=wp.vec3),
    side_count: int,
    store: wp.array(dtype=wp.vec3),
):
    """Find what nearer sides leave open of each hit, and the radiosity of that."""
    first_hit = SIDE_ROWS * planes.grids.shape[0]
    for k in range(1, side_count):
        for j in range(k):
            if is_hit(store, first_hit, k) and is_hit(store, first_hit, j):
                _block_each_other(cell, k, j, first_hit, store)
    for side_index in range(side_count):
        hit = load_hit(store, first_hit, side_index)
        if hit.coverage > 0.0 and hit.open_share < 1.0:
            hit.open_share = wp.max(hit.open_share, _MIN_OPEN)
            side = load_side(planes, side_index, store)
            grid = planes.grids[side.f]
            if _is_sender(grid, side):
                local_receiver = load_local_receiver(store, side.f)
                _, footprint = _visible_footprint(planes, grid, side, local_receiver, cell, hit)
                mip = find_mip_footprint(grid, planes, footprint)
                hit.radiosity = fetch(texels, planes, first_level_of_side(grid, side.is_back), mip)
            store_hit(store, first_hit, side_index, hit)


@wp.func
def find_side_hits_adjoint(
    planes: PlaneArrays,
    cell: VisibleCell,
    texels: wp.array(dtype=wp.vec3),
    hit_count: int,
    side_count: int,
    store: wp.array(dtype=wp.vec3),
    edges: wp.array(dtype=ViewedEdge),
    adj_store: wp.array(dtype=wp.vec3),
    instance: int,
    adj_texels: wp.array2d(dtype=wp.vec3),
):
    """Add to the gradients of a receiver relative to each plane, of viewed edges, and of an instance's texels."""
    first_hit = SIDE_ROWS * planes.grids.shape[0]
    for side_index in range(side_count):
        if is_hit(store, first_hit, side_index):
            _visible_radiosity_adjoint(planes, cell, texels, side_index, store, adj_store, instance, adj_texels)
    if hit_count > 1:
        for k in range(1, side_count):
            for j in range(k):
                if is_hit(store, first_hit, k) and is_hit(store, first_hit, j):
                    _block_each_other_adjoint(cell, k, j, first_hit, store, adj_store)
    for side_index in range(side_count):
        if is_hit(store, first_hit, side_index):
            _outline_hit_adjoint(planes, cell, side_index, hit_count == 1, store, edges, adj_store)


@wp.func
def _visible_radiosity_adjoint(
    planes: PlaneArrays,
    cell: VisibleCell,
    texels: wp.array(dtype=wp.vec3),
    side_index: int,
    store: wp.array(dtype=wp.vec3),
    adj_store: wp.array(dtype=wp.vec3),
    instance: int,
    adj_texels: wp.array2d(dtype=wp.vec3),
):
    """Add to the gradients of a receiver relative to a plane, of what others leave open of it, and of its texels."""
    side = load_side(planes, side_index, store)
    grid = planes.grids[side.f]
    first_hit = SIDE_ROWS * planes.grids.shape[0]
    hit, adj_hit = load_hit(store, first_hit, side_index), load_hit(adj_store, first_hit, side_index)
    if _is_sender(grid, side):
        first_level = first_level_of_side(grid, side.is_back)
        local_receiver = load_local_receiver(store, side.f)
        direction, footprint = _visible_footprint(planes, grid, side, local_receiver, cell, hit)
        mip = find_mip_footprint(grid, planes, footprint)
        adj_mip = fetch_adjoint(texels, grid, planes, first_level, footprint, mip, adj_hit.radiosity)
        if adj_texels:
            scatter(adj_texels[instance], planes, first_level, mip, adj_hit.radiosity)
        adj_direction = footprint_on_side_adjoint(
            planes, grid, side, local_receiver, direction, footprint, adj_mip, adj_store
        )
        if hit.open_share < 1.0:
            visible_direction, length = _unnormalized_direction(cell, hit)
            adj_centroid = (cell.radius / wp.length(visible_direction)) * (
                adj_direction - wp.dot(adj_direction, direction) * direction
            )
            adj_length = wp.dot(adj_centroid, hit.blocked_moment) / (length * length)
            adj_open = 0.5 * adj_mip[2] / hit.open_share + adj_length * hit.open_share / length
            adj_moment = (adj_length * hit.blocked_moment - adj_centroid) / length
            _add_to_open_part(adj_store, first_hit, side_index, adj_open, adj_moment)


@wp.func
def _outline_hit_adjoint(
    planes: PlaneArrays,
    cell: VisibleCell,
    side_index: int,
    is_alone: bool,
    store: wp.array(dtype=wp.vec3),
    edges: wp.array(dtype=ViewedEdge),
    adj_store: wp.array(dtype=wp.vec3),
):
    """Add to the gradients of a receiver relative to a plane, and of viewed edges."""
    side = load_side(planes, side_index, store)
    grid = planes.grids[side.f]
    first_hit = SIDE_ROWS * planes.grids.shape[0]
    hit, adj_hit = load_hit(store, first_hit, side_index), load_hit(adj_store, first_hit, side_index)
    local_receiver = load_local_receiver(store, side.f)
    outline_share = hit.coverage / hit.mesh_share
    if is_covered_by_texels(grid):
        footprint = footprint_on_side(planes, grid, side, local_receiver, cell.direction)
        mip = find_mip_footprint(grid, planes, footprint)
        first_level = first_level_of_side(grid, side.is_back)
        adj_covered = wp.vec3(adj_hit.coverage * outline_share, 0.0, 0.0)
        adj_mip = fetch_adjoint(planes.covered, grid, planes, first_level, footprint, mip, adj_covered)
        footprint_on_side_adjoint(planes, grid, side, local_receiver, cell.direction, footprint, adj_mip, adj_store)
    adj_share = adj_hit.coverage * hit.mesh_share
    adj_outline = wp.vec4(adj_share * side.weight, 0.0, 0.0, 0.0)
    if not is_alone:
        inverse_distance_on_side_adjoint(
            grid, side, local_receiver, hit.inverse_distance, adj_hit.inverse_distance, adj_store
        )
        adj_moment = (side.weight / outline_share) * adj_hit.centroid
        adj_outline = adj_outline + wp.vec4(
            -wp.dot(adj_moment, hit.centroid), adj_moment[0], adj_moment[1], adj_moment[2]
        )
    coverage_adjoint(edges, side.first_edge, grid.edge_count, cell.direction, cell.radius, adj_outline)
    adj_store[side.row] = adj_store[side.row] + wp.vec3(0.0, 0.0, adj_share * outline_share / side.weight)


@wp.func
def mean_radiosity(first_hit: int, side_count: int, store: wp.array(dtype=wp.vec3)):
    """Find the mean radiosity of the sides that a cell hits, by its weights h o; also their sum, and the coverages'."""
    radiosity_sum = wp.vec3()
    weight_sum = float(0.0)
    total_coverage = float(0.0)
    for side_index in range(side_count):
        if is_hit(store, first_hit, side_index):
            hit = load_hit(store, first_hit, side_index)
            radiosity_sum += (hit.coverage * hit.open_share) * hit.radiosity
            weight_sum += hit.coverage * hit.open_share
            total_coverage += hit.coverage
    weight_sum = wp.max(weight_sum, _MIN_WEIGHT_SUM)
    return radiosity_sum / weight_sum, weight_sum, total_coverage
