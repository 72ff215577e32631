"""Plane hits: the sides of planes that a cell of a receiver meets, and how they hide each other."""

from __future__ import annotations

import warp as wp

from warpshadow.stages.cell_coverage import ViewedEdge, coverage_adjoint
from warpshadow.stages.planes.cells import (
    PlaneArrays,
    PlaneFootprint,
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
    VisibleCell,
    footprint_on_side,
    footprint_on_side_adjoint,
    load_local_receiver,
    load_side,
    outline_coverage_on_side,
)

_MIN_WEIGHT_SUM = wp.constant(1.0e-30)  # the least Σ s


HIT_ROWS = SIDE_ROWS + 8
"""Rows of scratch for each plane: `SIDE_ROWS`, and four for the hit of a cell on each of two sides."""


@wp.struct
class PlaneHit:
    """The hit of a cell on a side of a plane; or its adjoint, of coverage, distance, its range and radiosity."""

    coverage: float
    distance: float
    distance_range: float  # by how much the distance varies over the cell
    radiosity: wp.vec3
    outline_coverage: float
    mesh_share: float  # of the outline's coverage, by texels
    per_cosine: float  # 1 / c′
    center: wp.vec2  # in the plane
    transmittance: float  # of the sides in front of it


@wp.func
def load_hit(store: wp.array(dtype=wp.vec3), first_hit: int, side_index: int):
    """Load the hit on side ``side_index``; without coverage, all else in it is old. ``first_hit`` is side 0's row."""
    row = first_hit + 4 * side_index
    hit = PlaneHit()
    hit.coverage = store[row][0]
    hit.distance = store[row][1]
    hit.distance_range = store[row][2]
    hit.radiosity = store[row + 1]
    hit.outline_coverage = store[row + 2][0]
    hit.mesh_share = store[row + 2][1]
    hit.per_cosine = store[row + 2][2]
    hit.center = wp.vec2(store[row + 3][0], store[row + 3][1])
    hit.transmittance = store[row + 3][2]
    return hit


@wp.func
def clear_hit(store: wp.array(dtype=wp.vec3), first_hit: int, side_index: int):
    """Take its coverage away."""
    store[first_hit + 4 * side_index] = wp.vec3()


@wp.func
def store_hit(store: wp.array(dtype=wp.vec3), first_hit: int, side_index: int, hit: PlaneHit):
    """Overwrite it."""
    row = first_hit + 4 * side_index
    store[row] = wp.vec3(hit.coverage, hit.distance, hit.distance_range)
    store[row + 1] = hit.radiosity
    store[row + 2] = wp.vec3(hit.outline_coverage, hit.mesh_share, hit.per_cosine)
    store[row + 3] = wp.vec3(hit.center[0], hit.center[1], hit.transmittance)


@wp.func
def add_to_hit(
    adj_store: wp.array(dtype=wp.vec3),
    first_hit: int,
    side_index: int,
    coverage: float,
    distance: float,
    distance_range: float,
):
    """Add to the adjoint of a hit."""
    row = first_hit + 4 * side_index
    adj_store[row] = adj_store[row] + wp.vec3(coverage, distance, distance_range)


@wp.func
def first_level_of_side(grid: PlaneGrid, is_back: bool):
    """First mip level of a side. A one-sided plane reuses its front levels for occupancy."""
    return grid.first_level + wp.where(is_back and grid.sides == 2, grid.level_count, 0)


@wp.func
def find_side_hits(
    scene: PlaneArrays,
    cell: VisibleCell,
    texels: wp.array(dtype=wp.vec3),
    cell_share: float,
    side_count: int,
    store: wp.array(dtype=wp.vec3),
    edges: wp.array(dtype=ViewedEdge),
):
    """Store which plane sides this cell hits; return whether any. A share of 0 hits nothing."""
    if cell_share <= 0.0:
        return False
    first_hit = SIDE_ROWS * scene.grids.shape[0]
    is_any_hit = bool(False)
    for side_index in range(side_count):
        side = load_side(scene, side_index, store)
        grid = scene.grids[side.f]
        local_receiver = load_local_receiver(store, side.f)
        share = outline_coverage_on_side(scene, grid, side, local_receiver, cell, edges)[0]
        clear_hit(store, first_hit, side_index)
        if share > 0.0:
            hit = PlaneHit()
            footprint = footprint_on_side(scene, grid, side, local_receiver, cell.direction)
            hit.outline_coverage = share
            hit.mesh_share = 1.0
            hit.distance = footprint.distance
            hit.distance_range = footprint.distance * scene.radius * footprint.per_cosine
            hit.per_cosine = footprint.per_cosine
            hit.center = footprint.center
            is_sender = grid.sides == 2 or not side.is_back
            if is_sender or is_covered_by_texels(grid):
                first_level = first_level_of_side(grid, side.is_back)
                mip = find_mip_footprint(grid, scene, footprint)
                if is_covered_by_texels(grid):
                    hit.mesh_share = fetch(scene.covered, scene, first_level, mip)[0]
                if is_sender:
                    hit.radiosity = fetch(texels, scene, first_level, mip)
            hit.coverage = share * hit.mesh_share
            store_hit(store, first_hit, side_index, hit)
            is_any_hit = True
    return is_any_hit


@wp.func
def find_side_hits_adjoint(
    scene: PlaneArrays,
    cell: VisibleCell,
    texels: wp.array(dtype=wp.vec3),
    side_count: int,
    store: wp.array(dtype=wp.vec3),
    edges: wp.array(dtype=ViewedEdge),
    adj_store: wp.array(dtype=wp.vec3),
    instance: int,
    adj_texels: wp.array2d(dtype=wp.vec3),
):
    """Add to the gradients of a receiver relative to each plane, of viewed edges, and of an instance's texels."""
    first_hit = SIDE_ROWS * scene.grids.shape[0]
    for side_index in range(side_count):
        hit = load_hit(store, first_hit, side_index)
        if hit.coverage > 0.0:
            side = load_side(scene, side_index, store)
            grid = scene.grids[side.f]
            footprint = PlaneFootprint()
            footprint.distance = hit.distance
            footprint.per_cosine = hit.per_cosine
            footprint.center = hit.center
            adj_hit = load_hit(adj_store, first_hit, side_index)
            adj_mip = wp.vec3()
            is_sender = grid.sides == 2 or not side.is_back
            if is_sender or is_covered_by_texels(grid):
                first_level = first_level_of_side(grid, side.is_back)
                mip = find_mip_footprint(grid, scene, footprint)
                if is_covered_by_texels(grid):
                    adj_covered = wp.vec3(adj_hit.coverage * hit.outline_coverage, 0.0, 0.0)
                    adj_mip += fetch_adjoint(scene.covered, grid, scene, first_level, footprint, mip, adj_covered)
                if is_sender:
                    adj_mip += fetch_adjoint(texels, grid, scene, first_level, footprint, mip, adj_hit.radiosity)
                    if adj_texels:
                        scatter(adj_texels[instance], scene, first_level, mip, adj_hit.radiosity)
            local_receiver = load_local_receiver(store, side.f)
            adj_range = adj_hit.distance_range
            footprint_on_side_adjoint(
                scene,
                grid,
                side,
                local_receiver,
                cell.direction,
                footprint,
                adj_mip,
                adj_hit.distance,
                adj_range,
                adj_store,
            )
            adj_share = adj_hit.coverage * hit.mesh_share
            adj_outline = wp.vec4(adj_share * side.weight, 0.0, 0.0, 0.0)
            coverage_adjoint(edges, side.first_edge, grid.edge_count, cell.direction, cell.radius, adj_outline)
            adj_store[side.row] = adj_store[side.row] + wp.vec3(
                0.0, 0.0, adj_share * hit.outline_coverage / side.weight
            )


@wp.func
def _relative_distance(hit: PlaneHit, other: PlaneHit):
    """Distance of another side in front of one, in ranges: −1 wholly behind it, 1 wholly in front."""
    return (hit.distance - other.distance) / (hit.distance_range + other.distance_range + 1.0e-20)


@wp.func
def side_transmittance(side_index: int, excluded: int, first_hit: int, side_count: int, store: wp.array(dtype=wp.vec3)):
    """Part of a side's light that passes the sides in front of it, but for one of them."""
    hit = load_hit(store, first_hit, side_index)
    transmittance = float(1.0)
    for other_index in range(side_count):
        other = load_hit(store, first_hit, other_index)
        if other_index != side_index and other_index != excluded and other.coverage > 0.0:
            transmittance *= 1.0 - other.coverage * wp.smoothstep(-1.0, 1.0, _relative_distance(hit, other))
    return transmittance


@wp.func
def mean_radiosity(first_hit: int, side_count: int, store: wp.array(dtype=wp.vec3)):
    """Find the mean radiosity of the sides that a cell hits, by its weights s; also their sum, and the coverages'."""
    radiosity_sum = wp.vec3()
    weight_sum = float(0.0)
    total_coverage = float(0.0)
    for side_index in range(side_count):
        hit = load_hit(store, first_hit, side_index)
        if hit.coverage > 0.0:
            hit.transmittance = side_transmittance(side_index, side_index, first_hit, side_count, store)
            store_hit(store, first_hit, side_index, hit)
            radiosity_sum += (hit.coverage * hit.transmittance) * hit.radiosity
            weight_sum += hit.coverage * hit.transmittance
            total_coverage += hit.coverage
    weight_sum = wp.max(weight_sum, _MIN_WEIGHT_SUM)
    return radiosity_sum / weight_sum, weight_sum, total_coverage


@wp.func
def side_transmittance_adjoint(
    side_index: int,
    adj_transmittance: float,
    first_hit: int,
    side_count: int,
    store: wp.array(dtype=wp.vec3),
    adj_store: wp.array(dtype=wp.vec3),
):
    """Add to the gradients of a cell's hits."""
    hit = load_hit(store, first_hit, side_index)
    for other_index in range(side_count):
        other = load_hit(store, first_hit, other_index)
        if other_index != side_index and other.coverage > 0.0:
            adj_factor = adj_transmittance * side_transmittance(side_index, other_index, first_hit, side_count, store)
            relative_distance = _relative_distance(hit, other)
            ranges = hit.distance_range + other.distance_range + 1.0e-20
            adj_distance = -adj_factor * other.coverage * smoothstep_slope(relative_distance) / ranges
            adj_range = -adj_distance * relative_distance
            add_to_hit(adj_store, first_hit, side_index, 0.0, adj_distance, adj_range)
            adj_coverage = -adj_factor * wp.smoothstep(-1.0, 1.0, relative_distance)
            add_to_hit(adj_store, first_hit, other_index, adj_coverage, -adj_distance, adj_range)
