"""Plane hits: which share of a receiver's cell sees each side of a plane, past the sides in front, and its radiosity.

Known of a side k, in a cell with direction ω and angular radius ρ (:mod:`warpshadow.stages.cell_coverage`):

    h_k, μ_k          its coverage of the cell, and the moment of that
    y_k = μ_k / h_k   centroid of the covered part, in radii ρ from the middle of the cell
    g_k = N_k / d_k   inverse distances: along a direction ω the side is 1 / (g_k·ω) away

1. Two sides k and j share a part of the cell around ω + ρ (y_k + y_j). Side j is in front in the share

       S_kj = S(x),  x = (g_j − g_k)·(ω + ρ (y_k + y_j)) / ρ √(h_k h_j (|P(g_j − g_k)|² + 10⁻⁶ (|g_k|² + |g_j|²)))

   of it. x is the signed distance of the line in which both sides meet, (g_j − g_k)·(ω + ρ y) = 0, from the middle
   y_k + y_j of the shared part, over that part's radius √(h_k h_j). P projects to the plane that touches the sphere of
   directions, the term of 10⁻⁶ is for sides at one distance, S is the smoothstep from 0 at −1 to 1 at 1.
2. The sides in front of k leave the share o_k of the cell open, and block with the moment m_k:

       o_k = 1 − Σ_j S_kj h_j,  m_k = Σ_j S_kj μ_j

3. So the share h_k o_k of the cell sees side k. Convex parts in front of all planes cover h₀ of the cell, with the
   moment μ₀ (:mod:`warpshadow.stages.convex.coverage`); the transmittance takes them off.
4. Radiosity is looked up around ω + ρ z_k, away from all that blocks it, over a footprint √o as wide:

       z_k = −m / √(o² + |m|²),  o = o_k (1 − h₀),  m = m_k + μ₀

   The root keeps that point in the cell. A mean over all of the side in the cell would have parts that nearer sides
   hide, as the sunlit ground behind a garage's front wall.

Light of planes in a garage is 2.6% off, without o 3.5%, by sides ordered by distance 6.5%. Without h₀ the light of the
sunlit ground on the roof of a barn was 1.4 to 1.6 times too strong.
"""

import warp as wp

from warpshadow.device.parallel import Scratch
from warpshadow.stages.cell_coverage import coverage_adjoint
from warpshadow.stages.planes.cells import (
    MipFootprint,
    PlaneArrays,
    PlaneFootprint,
    fetch,
    fetch_adjoint,
    find_mip_footprint,
    is_covered_by_texels,
    scatter,
    smoothstep_slope,
)
from warpshadow.stages.planes.plane_blockers import PlaneBlockers
from warpshadow.stages.planes.sides import (
    PlaneReceiver,
    PlaneSide,
    VisibleCell,
    footprint_on_side,
    footprint_on_side_adjoint,
    inverse_distance_on_side,
    inverse_distance_on_side_adjoint,
    is_towards_side,
    load_side,
    outline_coverage_on_side,
)

_MIN_WEIGHT_SUM = wp.constant(1.0e-30)  # the least Σ h o
_MIN_OPEN = wp.constant(1.0e-4)  # the least o: of more than two sides each may hide another
_TIE = wp.constant(1.0e-6)  # planes whose distances differ by some thousandth of them are neither before the other
_MIN_WIDTH = wp.constant(1.0e-30)  # least denominator of S's argument


@wp.struct
class PlaneHit:
    """The hit of a cell on a side of a plane; or its adjoint, which has neither mesh share nor lookup."""

    coverage: float  # h
    mesh_share: float  # of the outline's coverage, by texels
    open_share: float  # o
    radiosity: wp.vec3
    centroid: wp.vec3  # y, of the coverage [radii of the cell]
    inverse_distance: wp.vec3  # g
    blocked_moment: wp.vec3  # m
    footprint: PlaneFootprint  # of the lookup of the radiosity
    mip: MipFootprint


def hit_scratch(planes: PlaneBlockers) -> Scratch:
    """Scratch memory of a receiver: the hit of a cell on each side."""
    return Scratch((2 * planes.count,), PlaneHit)


@wp.func
def is_hit(hits: wp.array(dtype=PlaneHit), i: int):
    """Whether side i covers a part of the cell; else other fields of its hit are of another cell."""
    return hits[i].coverage > 0.0


@wp.func
def _add_to_open_part(hits: wp.array(dtype=PlaneHit), i: int, open_share: float, blocked_moment: wp.vec3):
    """Add to the open share and the blocked moment of a hit; or of its adjoint."""
    hits[i].open_share = hits[i].open_share + open_share
    hits[i].blocked_moment = hits[i].blocked_moment + blocked_moment


@wp.func
def _add_to_hit(
    adj_hits: wp.array(dtype=PlaneHit), i: int, coverage: float, centroid: wp.vec3, inverse_distance: wp.vec3
):
    adj_hits[i].coverage = adj_hits[i].coverage + coverage
    adj_hits[i].centroid = adj_hits[i].centroid + centroid
    adj_hits[i].inverse_distance = adj_hits[i].inverse_distance + inverse_distance


@wp.func
def _first_level(side: PlaneSide):
    """First mip level of a side. A one-sided plane reuses its front levels for occupancy."""
    return side.grid.first_level + wp.where(side.is_back and side.grid.sides == 2, side.grid.level_count, 0)


@wp.func
def _is_sender(side: PlaneSide):
    """Whether a side has patches."""
    return side.grid.sides == 2 or not side.is_back


@wp.struct
class _Overlap:
    """The order of two sides in the part of a cell that both cover."""

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
def _block_each_other(cell: VisibleCell, k: int, j: int, hits: wp.array(dtype=PlaneHit)):
    """Subtract from each of two hits the part that the other blocks."""
    hit, other = hits[k], hits[j]
    share_in_front = wp.smoothstep(-1.0, 1.0, _find_overlap(cell, hit, other).relative)
    by_other = share_in_front * other.coverage
    by_hit = (1.0 - share_in_front) * hit.coverage
    _add_to_open_part(hits, k, -by_other, by_other * other.centroid)
    _add_to_open_part(hits, j, -by_hit, by_hit * hit.centroid)


@wp.func
def _block_each_other_adjoint(
    cell: VisibleCell, k: int, j: int, hits: wp.array(dtype=PlaneHit), adj_hits: wp.array(dtype=PlaneHit)
):
    """Add to the gradients of two hits."""
    hit, other = hits[k], hits[j]
    adj_hit, adj_other = adj_hits[k], adj_hits[j]
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
        adj_hits,
        k,
        share_behind * adj_by_hit + 0.5 * adj_log / hit.coverage,
        (share_behind * hit.coverage) * adj_other.blocked_moment + adj_shared_centroid,
        (_TIE * adj_squares) * hit.inverse_distance - adj_difference,
    )
    _add_to_hit(
        adj_hits,
        j,
        share_in_front * adj_by_other + 0.5 * adj_log / other.coverage,
        (share_in_front * other.coverage) * adj_hit.blocked_moment + adj_shared_centroid,
        (_TIE * adj_squares) * other.inverse_distance + adj_difference,
    )


@wp.func
def _open_part(hit: PlaneHit, part_coverage: wp.vec4):
    """Share o of a side that neither nearer sides nor bodies before all planes block, and the moment m of these."""
    open_share = wp.max(hit.open_share * (1.0 - part_coverage[0]), _MIN_OPEN)
    return open_share, hit.blocked_moment + wp.vec3(part_coverage[1], part_coverage[2], part_coverage[3])


@wp.func
def _is_wholly_open(hit: PlaneHit, part_coverage: wp.vec4):
    return hit.open_share >= 1.0 and part_coverage[0] <= 0.0


@wp.func
def _unnormalized_direction(cell: VisibleCell, open_share: float, blocked_moment: wp.vec3):
    """Direction ω + ρ z of the open part of a side, not of unit length; and the length of (o, m)."""
    length = wp.sqrt(open_share * open_share + wp.length_sq(blocked_moment))
    return cell.direction - (cell.radius / length) * blocked_moment, length


@wp.func
def _visible_direction(cell: VisibleCell, hit: PlaneHit, part_coverage: wp.vec4):
    """Direction of the open part of a side."""
    if _is_wholly_open(hit, part_coverage):
        return cell.direction
    open_share, blocked_moment = _open_part(hit, part_coverage)
    visible_direction, _ = _unnormalized_direction(cell, open_share, blocked_moment)
    return wp.normalize(visible_direction)


@wp.func
def _visible_footprint(planes: PlaneArrays, side: PlaneSide, cell: VisibleCell, hit: PlaneHit, part_coverage: wp.vec4):
    """Footprint of the open part of a side that is not wholly open."""
    footprint = footprint_on_side(planes, side, _visible_direction(cell, hit, part_coverage))
    open_share, _ = _open_part(hit, part_coverage)
    footprint.extent = wp.sqrt(open_share)
    return footprint


@wp.func
def find_side_hits(
    planes: PlaneArrays,
    cell: VisibleCell,
    texels: wp.array(dtype=wp.vec3),
    weight: float,
    part_coverage: wp.vec4,
    receiver: PlaneReceiver,
    hits: wp.array(dtype=PlaneHit),
):
    """Store which plane sides this cell hits, past bodies before all planes that cover (h₀, μ₀); return how many.

    A weight of 0 hits nothing.
    """
    hit_count = int(0)
    if weight <= 0.0:
        return hit_count
    for i in range(receiver.side_count):
        hits[i].coverage = float(0.0)
        outline = wp.vec4()
        side = PlaneSide()
        if is_towards_side(planes, receiver, i, cell):  # most cells end here, so before all of the side is loaded
            side = load_side(planes, receiver, i)
            outline = outline_coverage_on_side(planes, side, cell, receiver.edges)
        if outline[0] > 0.0:
            hit = PlaneHit()
            hit.mesh_share = 1.0
            hit.open_share = 1.0
            if _is_sender(side) or is_covered_by_texels(side.grid):
                first_level = _first_level(side)
                hit.footprint = footprint_on_side(planes, side, cell.direction)
                hit.mip = find_mip_footprint(side.grid, planes, hit.footprint)
                if is_covered_by_texels(side.grid):
                    hit.mesh_share = fetch(planes.covered, planes, first_level, hit.mip)[0]
                if _is_sender(side) and part_coverage[0] <= 0.0:  # else it is that of the part beside
                    hit.radiosity = fetch(texels, planes, first_level, hit.mip)
            hit.coverage = outline[0] * hit.mesh_share
            hit.centroid = wp.vec3(outline[1], outline[2], outline[3]) / outline[0]
            hit.inverse_distance = inverse_distance_on_side(side)
            hits[i] = hit
            hit_count += 1
    if hit_count > 1 or (hit_count > 0 and part_coverage[0] > 0.0):
        _find_visible_parts(planes, cell, texels, part_coverage, receiver, hits)
    return hit_count


@wp.func
def _find_visible_parts(
    planes: PlaneArrays,
    cell: VisibleCell,
    texels: wp.array(dtype=wp.vec3),
    part_coverage: wp.vec4,
    receiver: PlaneReceiver,
    hits: wp.array(dtype=PlaneHit),
):
    """Find the part of each hit that all before it leaves open, and its radiosity."""
    for k in range(1, receiver.side_count):
        for j in range(k):
            if is_hit(hits, k) and is_hit(hits, j):
                _block_each_other(cell, k, j, hits)
    for i in range(receiver.side_count):
        if is_hit(hits, i) and not _is_wholly_open(hits[i], part_coverage):
            hits[i].open_share = wp.max(hits[i].open_share, _MIN_OPEN)
            side = load_side(planes, receiver, i)
            if _is_sender(side):
                footprint = _visible_footprint(planes, side, cell, hits[i], part_coverage)
                mip = find_mip_footprint(side.grid, planes, footprint)
                hits[i].footprint = footprint
                hits[i].mip = mip
                hits[i].radiosity = fetch(texels, planes, _first_level(side), mip)


@wp.func
def find_side_hits_adjoint(
    planes: PlaneArrays,
    cell: VisibleCell,
    texels: wp.array(dtype=wp.vec3),
    part_coverage: wp.vec4,
    hit_count: int,
    receiver: PlaneReceiver,
    hits: wp.array(dtype=PlaneHit),
    adj_hits: wp.array(dtype=PlaneHit),
    instance: int,
    adj_texels: wp.array2d(dtype=wp.vec3),
):
    """Add to gradients of local receivers, viewed edges, and an instance's texels; return ``part_coverage``'s."""
    adj_part_coverage = wp.vec4()
    for i in range(receiver.side_count):
        if is_hit(hits, i):
            side = load_side(planes, receiver, i)
            if _is_sender(side):
                adj_part_coverage += _visible_radiosity_adjoint(
                    planes, cell, texels, part_coverage, side, receiver, hits, adj_hits, instance, adj_texels
                )
    if hit_count > 1:
        for k in range(1, receiver.side_count):
            for j in range(k):
                if is_hit(hits, k) and is_hit(hits, j):
                    _block_each_other_adjoint(cell, k, j, hits, adj_hits)
    for i in range(receiver.side_count):
        if is_hit(hits, i):
            side = load_side(planes, receiver, i)
            _outline_hit_adjoint(planes, cell, side, hit_count == 1, receiver, hits[i], adj_hits[i])
    return adj_part_coverage


@wp.func
def _visible_radiosity_adjoint(
    planes: PlaneArrays,
    cell: VisibleCell,
    texels: wp.array(dtype=wp.vec3),
    part_coverage: wp.vec4,
    side: PlaneSide,
    receiver: PlaneReceiver,
    hits: wp.array(dtype=PlaneHit),
    adj_hits: wp.array(dtype=PlaneHit),
    instance: int,
    adj_texels: wp.array2d(dtype=wp.vec3),
):
    """Add to the gradients of a local receiver, of a side's open part, and of its texels; return the parts'."""
    adj_part_coverage = wp.vec4()
    hit, adj_radiosity = hits[side.index], adj_hits[side.index].radiosity
    direction = _visible_direction(cell, hit, part_coverage)
    adj_mip = fetch_adjoint(texels, side.grid, planes, _first_level(side), hit.footprint, hit.mip, adj_radiosity)
    if adj_texels:
        scatter(adj_texels[instance], planes, _first_level(side), hit.mip, adj_radiosity)
    adj_direction = footprint_on_side_adjoint(planes, side, direction, hit.footprint, adj_mip, receiver.sides)
    if not _is_wholly_open(hit, part_coverage):
        open_share, blocked_moment = _open_part(hit, part_coverage)
        visible_direction, length = _unnormalized_direction(cell, open_share, blocked_moment)
        adj_centroid = (cell.radius / wp.length(visible_direction)) * (
            adj_direction - wp.dot(adj_direction, direction) * direction
        )
        adj_length = wp.dot(adj_centroid, blocked_moment) / (length * length)
        adj_open = float(0.0)
        if open_share > _MIN_OPEN:
            adj_open = 0.5 * adj_mip[2] / open_share + adj_length * open_share / length
        adj_moment = (adj_length * blocked_moment - adj_centroid) / length
        adj_part_coverage = wp.vec4(-adj_open * hit.open_share, adj_moment[0], adj_moment[1], adj_moment[2])
        _add_to_open_part(adj_hits, side.index, adj_open * (1.0 - part_coverage[0]), adj_moment)
    return adj_part_coverage


@wp.func
def _outline_hit_adjoint(
    planes: PlaneArrays,
    cell: VisibleCell,
    side: PlaneSide,
    is_alone: bool,
    receiver: PlaneReceiver,
    hit: PlaneHit,
    adj_hit: PlaneHit,
):
    """Add to the gradients of a local receiver, of the side's weight, and of viewed edges."""
    grid = side.grid
    outline_share = hit.coverage / hit.mesh_share
    if is_covered_by_texels(grid):
        footprint = footprint_on_side(planes, side, cell.direction)
        mip = find_mip_footprint(grid, planes, footprint)
        adj_covered = wp.vec3(adj_hit.coverage * outline_share, 0.0, 0.0)
        adj_mip = fetch_adjoint(planes.covered, grid, planes, _first_level(side), footprint, mip, adj_covered)
        footprint_on_side_adjoint(planes, side, cell.direction, footprint, adj_mip, receiver.sides)
    adj_covered_share = adj_hit.coverage * hit.mesh_share
    adj_outline = wp.vec4(adj_covered_share * side.weight, 0.0, 0.0, 0.0)
    if not is_alone:
        inverse_distance_on_side_adjoint(side, hit.inverse_distance, adj_hit.inverse_distance, receiver.sides)
        adj_moment = (side.weight / outline_share) * adj_hit.centroid
        adj_outline = adj_outline + wp.vec4(
            -wp.dot(adj_moment, hit.centroid), adj_moment[0], adj_moment[1], adj_moment[2]
        )
    coverage_adjoint(receiver.edges, side.first_edge, grid.edge_count, cell.direction, cell.radius, adj_outline)
    adj_weight = adj_covered_share * outline_share / side.weight
    receiver.sides[side.index].adj_weight = receiver.sides[side.index].adj_weight + adj_weight


@wp.func
def mean_radiosity(side_count: int, hits: wp.array(dtype=PlaneHit)):
    """Find the mean radiosity of the sides that a cell hits, by its weights h o; also their sum, and the coverages'."""
    radiosity_sum = wp.vec3()
    weight_sum = float(0.0)
    total_coverage = float(0.0)
    for i in range(side_count):
        if is_hit(hits, i):
            hit = hits[i]
            radiosity_sum += (hit.coverage * hit.open_share) * hit.radiosity
            weight_sum += hit.coverage * hit.open_share
            total_coverage += hit.coverage
    weight_sum = wp.max(weight_sum, _MIN_WEIGHT_SUM)
    return radiosity_sum / weight_sum, weight_sum, total_coverage
