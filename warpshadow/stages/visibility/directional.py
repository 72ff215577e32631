"""Visibility as transmittance towards cells of directions.

Each sphere lets 1 − A·smoothstep of the light of a cell pass, the step going from the blocked cone's edge outwards and
inwards by the softness w, and A making up for it so that the blocked solid angle is exactly the cone's:

    T_q(x) = Π_i (1 − A_i smoothstep((u_i·ω_q − lo_i) / (hi_i − lo_i)))
    lo = cos(θ+w),  hi = cos(max(θ−w, 0)),  A = min(1, (1 − cos θ) / (1 − (hi+lo)/2)),  w = κ·ρ,  ρ = 2/√Q

There is no band limit to ring, T stays in [0, 1] however many spheres overlap, tiny spheres neither vanish nor bloat,
and the soft edge has a smooth gradient.
"""

import functools

import numpy as np
import warp as wp

from warpshadow import check
from warpshadow.device.lanes import group_count, lane_count, lane_functions, lane_type, module_options
from warpshadow.device.parallel import Scratch, launch_slices, scratch_place
from warpshadow.device.tape import record_adjoint
from warpshadow.maths.directions import BUNDLE, CHUNK, cell_radius, check_count, edge_width
from warpshadow.stages.visibility.cones import TINY_RADIUS, check_spheres, cone_adjoint, relative_cone_function
from warpshadow.stages.visibility.culling import (
    QUADS,
    Cells,
    find_bundles_function,
    find_node,
    make_cells,
    make_spheres,
    reach_function,
    rise_function,
)
from warpshadow.stages.visibility.merging import (
    ITEMS,
    MERGING,
    QUAD,
    Spheres,
    load_merged_function,
    merge_where_far,
    merged_adjoint,
)
from warpshadow.stages.visibility.soft_edges import edge_adjoint, edge_function

SOFTNESS = 0.35
"""κ: half-width of the soft edge in cell radii. More gives wider gradients and more bias."""

_OPAQUE = 1.0e-4  # below this transmittance a bundle is not looked at any more

_PAIR_COST = 0.15
"""Nanoseconds that a sphere costs for a receiver and a direction, culling included."""


@functools.cache
def _load_normals_function(has_horizon: bool, lanes: int) -> wp.Function:
    """Make the kernel function that loads the normals of a group, 0 where there is no horizon."""
    Lane = lane_type(lanes)
    load = lane_functions(lanes).load

    @wp.func
    def load_normals(normals: wp.array2d(dtype=wp.vec3), batch: int, group: int):
        x = Lane(0.0)
        y = Lane(0.0)
        z = Lane(0.0)
        if wp.static(has_horizon):
            x, y, z = load(normals[batch], group)
        return x, y, z

    return load_normals


@functools.cache
def _block_function(lanes: int) -> wp.Function:
    """Make the kernel function that lets a sphere block its share of what passes towards a bundle of directions."""
    Lane = lane_type(lanes)
    is_any_above = lane_functions(lanes).is_any_above

    @wp.func
    def block(
        ux: Lane,
        uy: Lane,
        uz: Lane,
        low: Lane,
        slope: Lane,
        opacity: Lane,
        direction: int,
        directions: wp.array(dtype=wp.vec3),
        place: int,
        passing: wp.array(dtype=Lane),
    ):
        """Returns whether anything is left."""
        most = Lane(0.0)
        for i in range(BUNDLE):
            omega = directions[direction + i]
            t = wp.cw_mul(omega[0] * ux + omega[1] * uy + omega[2] * uz - low, slope)
            t = wp.min(wp.max(t, Lane(0.0)), Lane(1.0))
            step = wp.cw_mul(wp.cw_mul(t, t), Lane(3.0) - 2.0 * t)
            left = wp.cw_mul(passing[place + i], Lane(1.0) - wp.cw_mul(opacity, step))
            most = wp.max(most, left)
            passing[place + i] = left
        return is_any_above(most, _OPAQUE)

    return block


@functools.cache
def _transmit_kernel(has_horizon: bool, lanes: int) -> wp.Kernel:
    Lane = lane_type(lanes)
    fn = lane_functions(lanes)
    find_group, load, load_normals = fn.find_group, fn.load, _load_normals_function(has_horizon, lanes)
    store_columns, sqrt, is_any_above = fn.store_columns, fn.sqrt, fn.is_any_above
    cone, edge, block = relative_cone_function(lanes), edge_function(lanes), _block_function(lanes)
    reaches, rises = reach_function(lanes), rise_function(lanes)
    find_bundles, load_merged = find_bundles_function(has_horizon, lanes), load_merged_function(lanes)

    @wp.kernel(module="unique", module_options=module_options(lanes), enable_backward=False)
    def transmit(
        first_row: int,
        worker: int,
        # in
        points: wp.array2d(dtype=wp.vec3),
        normals: wp.array2d(dtype=wp.vec3),
        spheres: Spheres,
        cells: Cells,
        # scratch
        scratch: wp.array2d(dtype=Lane),
        found_bundles: wp.array3d(dtype=wp.int32),
        # out
        all_ends: wp.array3d(dtype=wp.int32),
        transmittance: wp.array3d(dtype=wp.float32),
    ):
        """A thread owns a group of receivers and a span of bundles; ends are the spheres where it stopped looking."""
        item, span = wp.tid()
        row = first_row + item
        batch, group = find_group(row, points.shape[1])
        place = scratch_place(worker, row * all_ends.shape[1] + span)
        passing = scratch[place]
        every = found_bundles[place, 0]
        found_by_run = found_bundles[place, 1]
        found = found_bundles[place, 2]
        ends = all_ends[row, span]
        first_bundle = span * ends.shape[0]
        cos_width = cells.cos_width
        sin_width = cells.sin_width
        x, y, z = load(points[batch], group)
        nx, ny, nz = load_normals(normals, batch, group)
        for bundle in range(ends.shape[0]):
            every[bundle] = bundle
            for i in range(BUNDLE):
                passing[bundle * BUNDLE + i] = Lane(1.0)
            ends[bundle] = spheres.bounds_of_quads.shape[1] * ITEMS
            if wp.static(has_horizon):
                axis = cells.axes[first_bundle + bundle]
                height = axis[0] * nx + axis[1] * ny + axis[2] * nz
                if not is_any_above(height, -cells.edges[first_bundle + bundle][1]):
                    ends[bundle] = 0  # wholly below the horizon: the cosine is zero there
        for run in range(spheres.bounds_of_runs.shape[1]):
            begin = run * QUADS
            end = wp.min(begin + QUADS, spheres.bounds_of_quads.shape[1])
            run_count = find_bundles(
                x,
                y,
                z,
                nx,
                ny,
                nz,
                spheres.bounds_of_runs[batch, run],
                begin,
                first_bundle,
                cells,
                ends,
                every,
                ends.shape[0],
                found_by_run,
            )
            if run_count == 0:
                end = begin
            for quad in range(begin, end):
                count = find_bundles(
                    x,
                    y,
                    z,
                    nx,
                    ny,
                    nz,
                    spheres.bounds_of_quads[batch, quad],
                    quad,
                    first_bundle,
                    cells,
                    ends,
                    found_by_run,
                    run_count,
                    found,
                )
                item_count = int(0)
                merged = Lane(0.0)
                if count > 0:
                    item_count = ITEMS
                    merged = load_merged(x, y, z, batch, quad, spheres)
                for item in range(item_count):
                    node = find_node(quad, item, spheres.count, spheres.centers.shape[1])
                    share = Lane(1.0) - merged
                    if item == QUAD:
                        share = merged
                    radius = float(0.0)
                    if node >= 0 and is_any_above(share, 0.0):
                        radius = spheres.radii[batch, node]
                    if radius > TINY_RADIUS:
                        center = spheres.centers[batch, node]
                        curvature = 1.0 / radius
                        ux, uy, uz, cosine, sine2, fade = cone(
                            curvature * (Lane(center[0]) - x),
                            curvature * (Lane(center[1]) - y),
                            curvature * (Lane(center[2]) - z),
                        )
                        weight = wp.cw_mul(fade, share)
                        sine = sqrt(sine2)
                        low = cos_width * cosine - sin_width * sine
                        wide_sine = sin_width * cosine + cos_width * sine
                        is_up = bool(True)
                        if wp.static(has_horizon):
                            is_up = rises(ux, uy, uz, low, wide_sine, nx, ny, nz)
                        if is_up:
                            _high, slope, opacity = edge(cosine, sine, sine2, weight, low, cos_width, sin_width)
                            for k in range(count):
                                bundle = found[k]
                                at = first_bundle + bundle
                                is_met = ends[bundle] > quad * ITEMS + item
                                if is_met:
                                    is_met = reaches(ux, uy, uz, low, wide_sine, cells.axes[at], cells.edges[at])
                                if is_met:
                                    is_left = block(
                                        ux,
                                        uy,
                                        uz,
                                        low,
                                        slope,
                                        opacity,
                                        at * BUNDLE,
                                        cells.directions,
                                        bundle * BUNDLE,
                                        passing,
                                    )
                                    if not is_left:
                                        ends[bundle] = quad * ITEMS + item + 1
        direction_count = ends.shape[0] * BUNDLE
        store_columns(passing, first_bundle * BUNDLE, direction_count, group, transmittance[batch])

    return transmit


@functools.cache
def _transmit_adjoint_kernel(has_horizon: bool, lanes: int) -> wp.Kernel:
    Lane = lane_type(lanes)
    fn = lane_functions(lanes)
    find_group, load, load_normals = fn.find_group, fn.load, _load_normals_function(has_horizon, lanes)
    load_products, sqrt, add_vectors, add_to_sphere = fn.load_products, fn.sqrt, fn.add_vectors, fn.add_to_sphere
    cone, cone_adjoint_ = relative_cone_function(lanes), cone_adjoint(lanes)
    edge, edge_adjoint_ = edge_function(lanes), edge_adjoint(lanes)
    merged_adjoint_ = merged_adjoint(lanes)
    is_any_above = fn.is_any_above
    reaches, rises = reach_function(lanes), rise_function(lanes)
    find_bundles, load_merged = find_bundles_function(has_horizon, lanes), load_merged_function(lanes)

    @wp.kernel(module="unique", module_options=module_options(lanes), enable_backward=False)
    def transmit_adjoint(
        first_row: int,
        worker: int,
        # in
        points: wp.array2d(dtype=wp.vec3),
        normals: wp.array2d(dtype=wp.vec3),
        spheres: Spheres,
        cells: Cells,
        all_ends: wp.array3d(dtype=wp.int32),
        transmittance: wp.array3d(dtype=wp.float32),
        adj_transmittance: wp.array3d(dtype=wp.float32),
        # scratch
        scratch: wp.array2d(dtype=Lane),
        found_bundles: wp.array3d(dtype=wp.int32),
        # out
        adj_points: wp.array2d(dtype=wp.vec3),
        adj_centers: wp.array2d(dtype=wp.vec3),
        adj_radii: wp.array2d(dtype=wp.float32),
        adj_extents: wp.array2d(dtype=wp.float32),
    ):
        """A thread owns a group of receivers and a span of bundles.

        With a = A·step(t) the share that a sphere blocks and t = (u·ω − lo) slope:
        ā_i = −T̄ T / (1 − a_i),  Ā = Σ ā step,  t̄ = ā A 6t(1−t),
        ū = slope Σ t̄ ω,  lō = slope (Σ t̄ t − Σ t̄),  hī = −slope Σ t̄ t
        """
        item, span = wp.tid()
        row = first_row + item
        batch, group = find_group(row, points.shape[1])
        place = scratch_place(worker, row * all_ends.shape[1] + span)
        products = scratch[place]
        every = found_bundles[place, 0]
        found_by_run = found_bundles[place, 1]
        found = found_bundles[place, 2]
        ends = all_ends[row, span]
        first_bundle = span * ends.shape[0]
        direction_count = ends.shape[0] * BUNDLE
        load_products(
            transmittance[batch], adj_transmittance[batch], first_bundle * BUNDLE, direction_count, group, products
        )
        cos_width = cells.cos_width
        sin_width = cells.sin_width
        x, y, z = load(points[batch], group)
        nx, ny, nz = load_normals(normals, batch, group)
        adj_x = Lane(0.0)
        adj_y = Lane(0.0)
        adj_z = Lane(0.0)
        for bundle in range(ends.shape[0]):
            every[bundle] = bundle
        for run in range(spheres.bounds_of_runs.shape[1]):
            begin = run * QUADS
            end = wp.min(begin + QUADS, spheres.bounds_of_quads.shape[1])
            run_count = find_bundles(
                x,
                y,
                z,
                nx,
                ny,
                nz,
                spheres.bounds_of_runs[batch, run],
                begin,
                first_bundle,
                cells,
                ends,
                every,
                ends.shape[0],
                found_by_run,
            )
            if run_count == 0:
                end = begin
            for quad in range(begin, end):
                count = find_bundles(
                    x,
                    y,
                    z,
                    nx,
                    ny,
                    nz,
                    spheres.bounds_of_quads[batch, quad],
                    quad,
                    first_bundle,
                    cells,
                    ends,
                    found_by_run,
                    run_count,
                    found,
                )
                item_count = int(0)
                merged = Lane(0.0)
                if count > 0:
                    item_count = ITEMS
                    merged = load_merged(x, y, z, batch, quad, spheres)
                adj_merged = Lane(0.0)
                for item in range(item_count):
                    node = find_node(quad, item, spheres.count, spheres.centers.shape[1])
                    share = Lane(1.0) - merged
                    sign = float(-1.0)
                    if item == QUAD:
                        share = merged
                        sign = 1.0
                    radius = float(0.0)
                    if node >= 0 and is_any_above(share, 0.0):
                        radius = spheres.radii[batch, node]
                    if radius > TINY_RADIUS:
                        center = spheres.centers[batch, node]
                        curvature = 1.0 / radius
                        dx = curvature * (Lane(center[0]) - x)
                        dy = curvature * (Lane(center[1]) - y)
                        dz = curvature * (Lane(center[2]) - z)
                        ux, uy, uz, cosine, sine2, fade = cone(dx, dy, dz)
                        weight = wp.cw_mul(fade, share)
                        sine = sqrt(sine2)
                        low = cos_width * cosine - sin_width * sine
                        wide_sine = sin_width * cosine + cos_width * sine
                        is_up = bool(True)
                        if wp.static(has_horizon):
                            is_up = rises(ux, uy, uz, low, wide_sine, nx, ny, nz)
                        if is_up:
                            _high, slope, opacity = edge(cosine, sine, sine2, weight, low, cos_width, sin_width)
                            is_any_met = bool(False)
                            sum_ = Lane(0.0)
                            sum_t = Lane(0.0)
                            sum_x = Lane(0.0)
                            sum_y = Lane(0.0)
                            sum_z = Lane(0.0)
                            adj_opacity = Lane(0.0)
                            for k in range(count):
                                bundle = found[k]
                                at = first_bundle + bundle
                                is_met = ends[bundle] > quad * ITEMS + item
                                if is_met:
                                    is_met = reaches(ux, uy, uz, low, wide_sine, cells.axes[at], cells.edges[at])
                                if is_met:
                                    is_any_met = True
                                    for i in range(BUNDLE):
                                        omega = cells.directions[at * BUNDLE + i]
                                        t = wp.cw_mul(omega[0] * ux + omega[1] * uy + omega[2] * uz - low, slope)
                                        t = wp.min(wp.max(t, Lane(0.0)), Lane(1.0))
                                        step = wp.cw_mul(wp.cw_mul(t, t), Lane(3.0) - 2.0 * t)
                                        left = wp.max(Lane(1.0) - wp.cw_mul(opacity, step), Lane(1.0e-7))
                                        adj_blocked = -wp.cw_div(products[bundle * BUNDLE + i], left)
                                        adj_opacity += wp.cw_mul(adj_blocked, step)
                                        rise = wp.cw_mul(t, Lane(1.0) - t)
                                        adj_t = 6.0 * wp.cw_mul(wp.cw_mul(adj_blocked, opacity), rise)
                                        sum_ += adj_t
                                        sum_t += wp.cw_mul(adj_t, t)
                                        sum_x += omega[0] * adj_t
                                        sum_y += omega[1] * adj_t
                                        sum_z += omega[2] * adj_t
                            if is_any_met:
                                adj_low = wp.cw_mul(slope, sum_t - sum_)
                                adj_high = -wp.cw_mul(slope, sum_t)
                                adj_cosine, adj_sine2, adj_weight = edge_adjoint_(
                                    cosine,
                                    sine,
                                    sine2,
                                    weight,
                                    cos_width,
                                    sin_width,
                                    adj_low,
                                    adj_high,
                                    adj_opacity,
                                )
                                adj_dx, adj_dy, adj_dz, adj_radius = cone_adjoint_(
                                    dx,
                                    dy,
                                    dz,
                                    curvature,
                                    wp.cw_mul(slope, sum_x),
                                    wp.cw_mul(slope, sum_y),
                                    wp.cw_mul(slope, sum_z),
                                    adj_cosine,
                                    adj_sine2,
                                    wp.cw_mul(adj_weight, share),
                                )
                                adj_merged += sign * wp.cw_mul(adj_weight, fade)
                                adj_x -= adj_dx
                                adj_y -= adj_dy
                                adj_z -= adj_dz
                                add_to_sphere(adj_dx, adj_dy, adj_dz, adj_radius, batch, node, adj_centers, adj_radii)
                if item_count > 0:
                    adj_dx, adj_dy, adj_dz = merged_adjoint_(
                        x, y, z, batch, quad, adj_merged, spheres, adj_centers, adj_radii, adj_extents
                    )
                    adj_x -= adj_dx
                    adj_y -= adj_dy
                    adj_z -= adj_dz
        if adj_points:
            add_vectors(adj_x, adj_y, adj_z, group, adj_points[batch])

    return transmit_adjoint


def transmittance(
    points: wp.array,
    normals: wp.array | None,
    centers: wp.array,
    radii: wp.array,
    directions: np.ndarray,
    *,
    softness: float = SOFTNESS,
    merging: float = MERGING,
) -> wp.array:
    """Transmittance of spheres towards cells of directions.

    Args:
        points: Receiver positions [scene units], vec3 of shape [batch, vertex].
        normals: Unit normals, vec3 of shape [batch, vertex]: what lies below a receiver's horizon, where the cosine
            is zero, may be left at 1. None computes it all.
        centers: Sphere centers [scene units], vec3 of shape [batch, sphere].
        radii: Sphere radii [scene units], float32 of shape [batch, sphere]; a radius of 0 blocks nothing.
        directions: Unit vectors ω, NumPy of shape [direction, 3], from :func:`warpshadow.fibonacci`.
        softness: κ, half-width of the soft edge in cell radii.
        merging: τ, the half-angle in cell radii under which four spheres that follow each other are seen as one (see
            :mod:`warpshadow.stages.visibility.merging`), where there are 512 or more; 0 for never.

    Returns:
        Transmittance in [0, 1], float32 of shape [batch, vertex, direction].

    Raises:
        ValueError: naming the argument, what it got and what it accepts; so for NaN, Inf, numbers beyond 1e18 and
            negative radii. (On a GPU that reads a count back, and is left out while a CUDA graph is captured.)

    Differentiable: points, centers, radii. Not: normals (they only cull), directions, softness, merging.
    """
    check.shape("directions", directions.shape, ("direction", 3))
    check_count("directions", len(directions))
    check.finite("directions", directions)
    if not np.allclose(np.linalg.norm(directions, axis=1), 1, atol=1e-3):
        raise ValueError("directions: got vectors of other lengths, expected unit vectors")
    width = edge_width(softness, len(directions))
    check_spheres(points, normals, centers, radii)
    device = points.device
    lanes = lane_count(device)
    batch_count, vertex_count = points.shape
    cells = make_cells(directions, width, device)
    # threads for a group: on a CPU one, which finds a sphere's cone once for all directions
    span_count = 1 if device.is_cpu else len(directions) // CHUNK
    bundle_count = len(directions) // (BUNDLE * span_count)
    nodes = merge_where_far(centers, radii, merging)
    spheres = make_spheres(nodes, radii.shape[1], merging * cell_radius(len(directions)))
    row_count = batch_count * group_count(vertex_count, lanes)
    dim = row_count, span_count
    scratch = [
        Scratch((bundle_count * BUNDLE,), lane_type(lanes)),
        Scratch((3, bundle_count), wp.int32),
    ]
    ends = wp.empty((*dim, bundle_count), dtype=wp.int32, device=device)
    variables = [points, *nodes]
    result = wp.empty(
        (batch_count, vertex_count, len(directions)),
        dtype=wp.float32,
        device=device,
        requires_grad=any(variable.requires_grad for variable in variables),
    )
    cost = _PAIR_COST * lanes * radii.shape[1] * bundle_count * BUNDLE
    launch_slices(
        _transmit_kernel(normals is not None, lanes),
        dim=dim,
        cost=cost,
        inputs=[points, normals, spheres, cells],
        scratch=scratch,
        outputs=[ends, result],
        device=device,
    )

    def adjoint() -> None:
        launch_slices(
            _transmit_adjoint_kernel(normals is not None, lanes),
            dim=dim,
            cost=2 * cost,
            inputs=[points, normals, spheres, cells, ends, result, result.grad],
            scratch=scratch,
            outputs=[points.grad],
            sums=[array.grad for array in nodes],
            device=device,
        )

    record_adjoint(adjoint, [*variables, result])
    return result
