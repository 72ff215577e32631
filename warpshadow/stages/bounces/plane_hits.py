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
    plane_share,
)

_MIN_WEIGHT_SUM = wp.constant(1.0e-30)  # the least Σ s


# Scratch of a receiver, vec3, follows that of its sides. The hit of a cell on each of these, from ``6 plane_count`` on:
#     4 i        coverage, distance, and how much that varies over the cell
#     4 i + 1    radiosity
#     4 i + 2    coverage of the outline, the mesh's share of that by texels, and 1 / c′
#     4 i + 3    place in the plane, and the transmittance of the sides in front of it
HIT_ROWS = SIDE_ROWS + 8
"""Rows of scratch for each plane."""


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
    cells = SIDE_ROWS * scene.grids.shape[0]
    meets = bool(False)
    for i in range(side_count):
        side = load_side(scene, i, store)
        grid = scene.grids[side.f]
        place = load_place(store, side.f)
        share = plane_share(scene, grid, side, place, cell, edges)
        store[cells + 4 * i] = wp.vec3()
        if share > 0.0:
            footprint = footprint_on_side(scene, grid, side, place, cell.direction)
            covered = float(1.0)
            radiosity = wp.vec3()
            sends = grid.sides == 2 or not side.is_back
            if sends or is_covered_by_texels(grid):
                first_level = levels_of(grid, side.is_back)
                mip = find_mip_footprint(grid, scene, footprint)
                if is_covered_by_texels(grid):
                    covered = fetch(scene.covered, scene, first_level, mip)[0]
                if sends:
                    radiosity = fetch(texels, scene, first_level, mip)
            meets = True
            store[cells + 4 * i] = wp.vec3(
                share * covered, footprint.distance, footprint.distance * scene.radius * footprint.per_cosine
            )
            store[cells + 4 * i + 1] = radiosity
            store[cells + 4 * i + 2] = wp.vec3(share, covered, footprint.per_cosine)
            store[cells + 4 * i + 3] = wp.vec3(footprint.center[0], footprint.center[1], 0.0)
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
    cells = SIDE_ROWS * scene.grids.shape[0]
    for i in range(side_count):
        if store[cells + 4 * i][0] > 0.0:
            side = load_side(scene, i, store)
            grid = scene.grids[side.f]
            stored = store[cells + 4 * i + 2]
            center = store[cells + 4 * i + 3]
            footprint = PlaneFootprint()
            footprint.distance = store[cells + 4 * i][1]
            footprint.per_cosine = stored[2]
            footprint.center = wp.vec2(center[0], center[1])
            adj_met = adj_store[cells + 4 * i]  # of coverage, distance, and t ρ / c′
            adj_light = adj_store[cells + 4 * i + 1]  # of radiosity
            adj_mip = wp.vec3()
            sends = grid.sides == 2 or not side.is_back
            if sends or is_covered_by_texels(grid):
                first_level = levels_of(grid, side.is_back)
                mip = find_mip_footprint(grid, scene, footprint)
                if is_covered_by_texels(grid):
                    adj_covered = wp.vec3(adj_met[0] * stored[0], 0.0, 0.0)
                    adj_mip += fetch_adjoint(scene.covered, grid, scene, first_level, footprint, mip, adj_covered)
                if sends:
                    adj_mip += fetch_adjoint(texels, grid, scene, first_level, footprint, mip, adj_light)
                    if adj_texels:
                        scatter(adj_texels[instance], scene, first_level, mip, adj_light)
            place = load_place(store, side.f)
            footprint_on_side_adjoint(
                scene, grid, side, place, cell.direction, footprint, adj_mip, adj_met[1], adj_met[2], adj_store
            )
            adj_share = adj_met[0] * stored[1]
            weighted = adj_share * side.weight
            coverage_adjoint(edges, side.first_edge, grid.edge_count, cell.direction, cell.radius, weighted)
            adj_store[side.row] = adj_store[side.row] + wp.vec3(0.0, 0.0, adj_share * stored[0] / side.weight)


@wp.func
def _nearness(footprint: wp.vec3, other: wp.vec3):
    """How far, in widths, another side is in front of one: −1 wholly behind it, 1 wholly in front."""
    return (footprint[1] - other[1]) / (footprint[2] + other[2] + 1.0e-20)


@wp.func
def side_transmittance(i: int, excluded: int, cells: int, side_count: int, store: wp.array(dtype=wp.vec3)):
    """Part of a side's light that passes the sides in front of it, but for one of them."""
    footprint = store[cells + 4 * i]
    part = float(1.0)
    for j in range(side_count):
        other = store[cells + 4 * j]
        if j != i and j != excluded and other[0] > 0.0:
            part *= 1.0 - other[0] * wp.smoothstep(-1.0, 1.0, _nearness(footprint, other))
    return part


@wp.func
def mean_light(cells: int, side_count: int, store: wp.array(dtype=wp.vec3)):
    """Find the mean radiosity of the sides that a cell hits, by its weights s; also their sum, and the coverages'."""
    light = wp.vec3()
    weights = float(0.0)
    covered = float(0.0)
    for i in range(side_count):
        coverage = store[cells + 4 * i][0]
        if coverage > 0.0:
            transmitted = side_transmittance(i, i, cells, side_count, store)
            store[cells + 4 * i + 3][2] = transmitted
            light += (coverage * transmitted) * store[cells + 4 * i + 1]
            weights += coverage * transmitted
            covered += coverage
    weights = wp.max(weights, _MIN_WEIGHT_SUM)
    return light / weights, weights, covered


@wp.func
def side_transmittance_adjoint(
    i: int,
    adj_part: float,
    cells: int,
    side_count: int,
    store: wp.array(dtype=wp.vec3),
    adj_store: wp.array(dtype=wp.vec3),
):
    """Add to the gradients of a cell's hits."""
    footprint = store[cells + 4 * i]
    for j in range(side_count):
        other = store[cells + 4 * j]
        if j != i and other[0] > 0.0:
            adj_factor = adj_part * side_transmittance(i, j, cells, side_count, store)
            nearness = _nearness(footprint, other)
            adj_near = -adj_factor * other[0] * smoothstep_slope(nearness) / (footprint[2] + other[2] + 1.0e-20)
            adj_width = -adj_near * nearness
            adj_store[cells + 4 * i] = adj_store[cells + 4 * i] + wp.vec3(0.0, adj_near, adj_width)
            adj_store[cells + 4 * j] = adj_store[cells + 4 * j] + wp.vec3(
                -adj_factor * wp.smoothstep(-1.0, 1.0, nearness), -adj_near, adj_width
            )
