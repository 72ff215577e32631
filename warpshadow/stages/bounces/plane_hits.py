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
    load_place,
    load_side,
    outline_coverage_on_side,
)

_MIN_WEIGHT_SUM = wp.constant(1.0e-30)  # the least Σ s


HIT_ROWS = SIDE_ROWS + 8
"""Rows of scratch for each plane: those of its sides, and four for the hit of a cell on each of two sides."""


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
def load_hit(store: wp.array(dtype=wp.vec3), first_hit: int, i: int):
    """Load the hit on side i; without coverage, all else in it is old. ``first_hit`` is the row of the first."""
    row = first_hit + 4 * i
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
def clear_hit(store: wp.array(dtype=wp.vec3), first_hit: int, i: int):
    """Take its coverage away."""
    store[first_hit + 4 * i] = wp.vec3()


@wp.func
def store_hit(store: wp.array(dtype=wp.vec3), first_hit: int, i: int, hit: PlaneHit):
    """Overwrite it."""
    row = first_hit + 4 * i
    store[row] = wp.vec3(hit.coverage, hit.distance, hit.distance_range)
    store[row + 1] = hit.radiosity
    store[row + 2] = wp.vec3(hit.outline_coverage, hit.mesh_share, hit.per_cosine)
    store[row + 3] = wp.vec3(hit.center[0], hit.center[1], hit.transmittance)


@wp.func
def add_to_hit(
    adj_store: wp.array(dtype=wp.vec3), first_hit: int, i: int, coverage: float, distance: float, distance_range: float
):
    """Add to the adjoint of a hit."""
    row = first_hit + 4 * i
    adj_store[row] = adj_store[row] + wp.vec3(coverage, distance, distance_range)


@wp.func
def levels_of(grid: PlaneGrid, is_back: bool):
    """First mip level of a side. A one-sided plane reuses its front levels for occupancy."""
    return grid.first_level + wp.where(is_back and grid.sides == 2, grid.level_count, 0)


@wp.func
def hit_sides(
    scene: PlaneArrays,
    cell: VisibleCell,
    texels: wp.array(dtype=wp.vec3),
    part: float,
    side_count: int,
    store: wp.array(dtype=wp.vec3),
    edges: wp.array(dtype=ViewedEdge),
):
    """Store which plane sides this cell hits; return whether any. No part meets nothing."""
    if part <= 0.0:
        return False
    first_hit = SIDE_ROWS * scene.grids.shape[0]
    meets = bool(False)
    for i in range(side_count):
        side = load_side(scene, i, store)
        grid = scene.grids[side.f]
        place = load_place(store, side.f)
        share = outline_coverage_on_side(scene, grid, side, place, cell, edges)[0]
        clear_hit(store, first_hit, i)
        if share > 0.0:
            hit = PlaneHit()
            footprint = footprint_on_side(scene, grid, side, place, cell.direction)
            hit.outline_coverage = share
            hit.mesh_share = 1.0
            hit.distance = footprint.distance
            hit.distance_range = footprint.distance * scene.radius * footprint.per_cosine
            hit.per_cosine = footprint.per_cosine
            hit.center = footprint.center
            sends = grid.sides == 2 or not side.is_back
            if sends or is_covered_by_texels(grid):
                first_level = levels_of(grid, side.is_back)
                mip = find_mip_footprint(grid, scene, footprint)
                if is_covered_by_texels(grid):
                    hit.mesh_share = fetch(scene.covered, scene, first_level, mip)[0]
                if sends:
                    hit.radiosity = fetch(texels, scene, first_level, mip)
            hit.coverage = share * hit.mesh_share
            store_hit(store, first_hit, i, hit)
            meets = True
    return meets


@wp.func
def hit_sides_adjoint(
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
    for i in range(side_count):
        hit = load_hit(store, first_hit, i)
        if hit.coverage > 0.0:
            side = load_side(scene, i, store)
            grid = scene.grids[side.f]
            footprint = PlaneFootprint()
            footprint.distance = hit.distance
            footprint.per_cosine = hit.per_cosine
            footprint.center = hit.center
            adj = load_hit(adj_store, first_hit, i)
            adj_mip = wp.vec3()
            sends = grid.sides == 2 or not side.is_back
            if sends or is_covered_by_texels(grid):
                first_level = levels_of(grid, side.is_back)
                mip = find_mip_footprint(grid, scene, footprint)
                if is_covered_by_texels(grid):
                    adj_covered = wp.vec3(adj.coverage * hit.outline_coverage, 0.0, 0.0)
                    adj_mip += fetch_adjoint(scene.covered, grid, scene, first_level, footprint, mip, adj_covered)
                if sends:
                    adj_mip += fetch_adjoint(texels, grid, scene, first_level, footprint, mip, adj.radiosity)
                    if adj_texels:
                        scatter(adj_texels[instance], scene, first_level, mip, adj.radiosity)
            place = load_place(store, side.f)
            adj_range = adj.distance_range
            footprint_on_side_adjoint(
                scene, grid, side, place, cell.direction, footprint, adj_mip, adj.distance, adj_range, adj_store
            )
            adj_share = adj.coverage * hit.mesh_share
            weighted = wp.vec4(adj_share * side.weight, 0.0, 0.0, 0.0)
            coverage_adjoint(edges, side.first_edge, grid.edge_count, cell.direction, cell.radius, weighted)
            adj_store[side.row] = adj_store[side.row] + wp.vec3(
                0.0, 0.0, adj_share * hit.outline_coverage / side.weight
            )


@wp.func
def _nearness(hit: PlaneHit, other: PlaneHit):
    """How far, in ranges, another side is in front of one: −1 wholly behind it, 1 wholly in front."""
    return (hit.distance - other.distance) / (hit.distance_range + other.distance_range + 1.0e-20)


@wp.func
def side_transmittance(i: int, excluded: int, first_hit: int, side_count: int, store: wp.array(dtype=wp.vec3)):
    """Part of a side's light that passes the sides in front of it, but for one of them."""
    hit = load_hit(store, first_hit, i)
    part = float(1.0)
    for j in range(side_count):
        other = load_hit(store, first_hit, j)
        if j != i and j != excluded and other.coverage > 0.0:
            part *= 1.0 - other.coverage * wp.smoothstep(-1.0, 1.0, _nearness(hit, other))
    return part


@wp.func
def mean_light(first_hit: int, side_count: int, store: wp.array(dtype=wp.vec3)):
    """Find the mean radiosity of the sides that a cell hits, by its weights s; also their sum, and the coverages'."""
    light = wp.vec3()
    weights = float(0.0)
    covered = float(0.0)
    for i in range(side_count):
        hit = load_hit(store, first_hit, i)
        if hit.coverage > 0.0:
            hit.transmittance = side_transmittance(i, i, first_hit, side_count, store)
            store_hit(store, first_hit, i, hit)
            light += (hit.coverage * hit.transmittance) * hit.radiosity
            weights += hit.coverage * hit.transmittance
            covered += hit.coverage
    weights = wp.max(weights, _MIN_WEIGHT_SUM)
    return light / weights, weights, covered


@wp.func
def side_transmittance_adjoint(
    i: int,
    adj_part: float,
    first_hit: int,
    side_count: int,
    store: wp.array(dtype=wp.vec3),
    adj_store: wp.array(dtype=wp.vec3),
):
    """Add to the gradients of a cell's hits."""
    hit = load_hit(store, first_hit, i)
    for j in range(side_count):
        other = load_hit(store, first_hit, j)
        if j != i and other.coverage > 0.0:
            adj_factor = adj_part * side_transmittance(i, j, first_hit, side_count, store)
            nearness = _nearness(hit, other)
            ranges = hit.distance_range + other.distance_range + 1.0e-20
            adj_near = -adj_factor * other.coverage * smoothstep_slope(nearness) / ranges
            adj_range = -adj_near * nearness
            add_to_hit(adj_store, first_hit, i, 0.0, adj_near, adj_range)
            adj_coverage = -adj_factor * wp.smoothstep(-1.0, 1.0, nearness)
            add_to_hit(adj_store, first_hit, j, adj_coverage, -adj_near, adj_range)
