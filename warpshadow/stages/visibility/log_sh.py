"""Log-visibility in spherical harmonics: the blocked cones of the spheres, turned to their directions, add up.

log V(x) ≈ f(x) = Σ_i R(u_i) z(θ_i)                [Lyu et al. 2021, section 3.3.2, after Ren et al. 2006]
"""

import functools

import numpy as np
import warp as wp

from warpshadow import check
from warpshadow.device.lanes import group_count, lane_count, lane_functions, lane_type, module_options
from warpshadow.device.parallel import Scratch, launch_slices, scratch_place
from warpshadow.device.tape import record_adjoint
from warpshadow.maths import sh
from warpshadow.maths.directions import cell_radius
from warpshadow.stages.sh_kernels import (
    PRODUCT_COST,
    add_rotated_zonal,
    multiply,
    product_table,
    rotated_zonal_adjoint,
    zonal_type,
)
from warpshadow.stages.visibility.cones import TINY_RADIUS, check_spheres, cone_adjoint, relative_cone_function
from warpshadow.stages.visibility.culling import find_node, make_spheres
from warpshadow.stages.visibility.merging import (
    ITEMS,
    MERGING,
    QUAD,
    Spheres,
    load_merged_function,
    merge_where_far,
    merged_adjoint,
)
from warpshadow.stages.visibility.zonal_logs import LOGS, band_type, look_up, look_up_slope, zonal_table

HORIZON_FADE = 0.5
"""A sphere fades out from (1 − HORIZON_FADE) radii to one radius below the tangent plane."""


_PAIR_COST = 0.25
"""Nanoseconds that a sphere costs for a receiver and a coefficient."""


@functools.cache
def _horizon_function(lanes: int) -> wp.Function:
    """Make the kernel function of the fade at the horizon: n·d/r → weight and its derivative."""
    Lane = lane_type(lanes)

    @wp.func
    def horizon(height: Lane):
        t = wp.min(wp.max((height + Lane(1.0)) / HORIZON_FADE, Lane(0.0)), Lane(1.0))
        slope = 6.0 / HORIZON_FADE * wp.cw_mul(t, Lane(1.0) - t)
        return wp.cw_mul(wp.cw_mul(t, t), Lane(3.0) - 2.0 * t), slope

    return horizon


@functools.cache
def _above_horizon_function(lanes: int) -> wp.Function:
    """Make the kernel function that says whether a sphere is above the horizon of any receiver, if only in part."""
    Lane = lane_type(lanes)
    is_any_above = lane_functions(lanes).is_any_above

    @wp.func
    def is_above_horizon(x: Lane, y: Lane, z: Lane, nx: Lane, ny: Lane, nz: Lane, bound: wp.vec4):
        height = wp.cw_mul(nx, Lane(bound[0]) - x)
        height += wp.cw_mul(ny, Lane(bound[1]) - y) + wp.cw_mul(nz, Lane(bound[2]) - z)
        return is_any_above(height, -1.001 * bound[3])  # rounding included

    return is_above_horizon


@functools.cache
def _accumulate_kernel(order: int, has_horizon: bool, lanes: int) -> wp.Kernel:
    Lane, Band = lane_type(lanes), band_type(order)
    fn = lane_functions(lanes)
    find_group, load, store_rows, is_any_above = fn.find_group, fn.load, fn.store_rows, fn.is_any_above
    load_merged, is_above_horizon = load_merged_function(lanes), _above_horizon_function(lanes)
    cone, horizon, look_up_ = relative_cone_function(lanes), _horizon_function(lanes), look_up(order, lanes)
    add_rotated_zonal_ = add_rotated_zonal(order, lanes)

    @wp.kernel(module="unique", module_options=module_options(lanes), enable_backward=False)
    def accumulate_log_sh(
        first_row: int,
        worker: int,
        # in
        points: wp.array2d(dtype=wp.vec3),
        normals: wp.array2d(dtype=wp.vec3),
        spheres: Spheres,
        table: wp.array2d(dtype=Band),
        # scratch
        total: wp.array2d(dtype=Lane),
        # out
        log_sh: wp.array3d(dtype=wp.float32),
    ):
        """A thread owns a group of receivers and sums the log-visibility of all spheres."""
        thread = first_row + wp.tid()
        batch, group = find_group(thread, points.shape[1])
        x, y, z = load(points[batch], group)
        nx = Lane(0.0)
        ny = Lane(0.0)
        nz = Lane(0.0)
        if wp.static(has_horizon):
            nx, ny, nz = load(normals[batch], group)
        row = total[scratch_place(worker, thread)]
        for i in range(wp.static(order**2)):
            row[i] = Lane(0.0)
        for quad in range(spheres.bounds_of_quads.shape[1]):
            merged = load_merged(x, y, z, batch, quad, spheres)
            is_up = bool(True)
            if wp.static(has_horizon):
                is_up = is_above_horizon(x, y, z, nx, ny, nz, spheres.bounds_of_quads[batch, quad])
            for item in range(ITEMS):
                node = find_node(quad, item, spheres.count, spheres.radii.shape[1])
                share = Lane(1.0) - merged
                if item == QUAD:
                    share = merged
                radius = float(0.0)
                if node >= 0 and is_up:
                    radius = spheres.radii[batch, node]
                if radius > TINY_RADIUS:
                    center = spheres.centers[batch, node]
                    dx = Lane(center[0]) - x
                    dy = Lane(center[1]) - y
                    dz = Lane(center[2]) - z
                    curvature = 1.0 / radius
                    ux, uy, uz, cosine, sine2, weight = cone(curvature * dx, curvature * dy, curvature * dz)
                    weight = wp.cw_mul(weight, share)
                    if wp.static(has_horizon):
                        height = wp.cw_mul(nx, dx) + wp.cw_mul(ny, dy) + wp.cw_mul(nz, dz)
                        fade, _slope = horizon(curvature * height)
                        weight = wp.cw_mul(weight, fade)
                    if is_any_above(weight, 0.0):
                        amount = wp.cw_mul(sine2, weight)
                        zonal = look_up_(cosine, table)
                        for band in range(order):
                            zonal[band] = wp.cw_mul(zonal[band], amount)
                        add_rotated_zonal_(ux, uy, uz, zonal, row)
        store_rows(row, group, log_sh[batch])

    return accumulate_log_sh


@functools.cache
def _accumulate_adjoint_kernel(order: int, has_horizon: bool, lanes: int) -> wp.Kernel:
    Lane, Zonal, Band = lane_type(lanes), zonal_type(order, lanes), band_type(order)
    fn = lane_functions(lanes)
    find_group, load, load_rows = fn.find_group, fn.load, fn.load_rows
    add_vectors, add_to_sphere = fn.add_vectors, fn.add_to_sphere
    cone, cone_adjoint_, horizon = relative_cone_function(lanes), cone_adjoint(lanes), _horizon_function(lanes)
    load_merged, merged_adjoint_ = load_merged_function(lanes), merged_adjoint(lanes)
    is_any_above, is_above_horizon = fn.is_any_above, _above_horizon_function(lanes)
    look_up_, look_up_slope_ = look_up(order, lanes), look_up_slope(order, lanes)
    rotated_zonal_adjoint_ = rotated_zonal_adjoint(order, lanes)

    @wp.kernel(module="unique", module_options=module_options(lanes), enable_backward=False)
    def accumulate_log_sh_adjoint(
        first_row: int,
        worker: int,
        # in
        points: wp.array2d(dtype=wp.vec3),
        normals: wp.array2d(dtype=wp.vec3),
        spheres: Spheres,
        table: wp.array2d(dtype=Band),
        adj_log_sh: wp.array3d(dtype=wp.float32),
        # scratch
        scratch: wp.array2d(dtype=Lane),
        # out
        adj_points: wp.array2d(dtype=wp.vec3),
        adj_normals: wp.array2d(dtype=wp.vec3),
        adj_centers: wp.array2d(dtype=wp.vec3),
        adj_radii: wp.array2d(dtype=wp.float32),
        adj_extents: wp.array2d(dtype=wp.float32),
    ):
        """A thread owns a group of receivers.

        With z_l = a h_l(c), a = s² w and h from the table:  ā = Σ z̄_l h_l,  c̄ = a Σ z̄_l h_l',  s̄² = ā w,  w̄ = ā s²,
        and with w = w_cone w_horizon(n·d/r):  n̄ = d w̄_h w_h'/r,  d̄ += n w̄_h w_h'/r,  r̄ −= n·d/r w̄_h w_h'/r
        """
        thread = first_row + wp.tid()
        batch, group = find_group(thread, points.shape[1])
        row = scratch[scratch_place(worker, thread)]
        load_rows(adj_log_sh[batch], group, row)
        x, y, z = load(points[batch], group)
        nx = Lane(0.0)
        ny = Lane(0.0)
        nz = Lane(0.0)
        if wp.static(has_horizon):
            nx, ny, nz = load(normals[batch], group)
        adj_x = Lane(0.0)
        adj_y = Lane(0.0)
        adj_z = Lane(0.0)
        adj_nx = Lane(0.0)
        adj_ny = Lane(0.0)
        adj_nz = Lane(0.0)
        for quad in range(spheres.bounds_of_quads.shape[1]):
            merged = load_merged(x, y, z, batch, quad, spheres)
            adj_merged = Lane(0.0)
            is_up = bool(True)
            if wp.static(has_horizon):
                is_up = is_above_horizon(x, y, z, nx, ny, nz, spheres.bounds_of_quads[batch, quad])
            for item in range(ITEMS):
                node = find_node(quad, item, spheres.count, spheres.radii.shape[1])
                share = Lane(1.0) - merged
                sign = float(-1.0)
                if item == QUAD:
                    share = merged
                    sign = 1.0
                radius = float(0.0)
                if node >= 0 and is_up:
                    radius = spheres.radii[batch, node]
                if radius > TINY_RADIUS:
                    center = spheres.centers[batch, node]
                    dx = Lane(center[0]) - x
                    dy = Lane(center[1]) - y
                    dz = Lane(center[2]) - z
                    curvature = 1.0 / radius
                    ux, uy, uz, cosine, sine2, near = cone(curvature * dx, curvature * dy, curvature * dz)
                    weight = wp.cw_mul(near, share)
                    height = Lane(0.0)
                    fade = Lane(1.0)
                    fade_slope = Lane(0.0)
                    if wp.static(has_horizon):
                        height = curvature * (wp.cw_mul(nx, dx) + wp.cw_mul(ny, dy) + wp.cw_mul(nz, dz))
                        height = wp.min(wp.max(height, Lane(-1.0)), Lane(1.0))  # beyond, nothing depends on it
                        fade, fade_slope = horizon(height)
                    faded = wp.cw_mul(weight, fade)
                    if is_any_above(faded, 0.0):
                        amount = wp.cw_mul(sine2, faded)
                        shape = look_up_(cosine, table)
                        slope = look_up_slope_(cosine, table)
                        zonal = Zonal()
                        for band in range(order):
                            zonal[band] = wp.cw_mul(shape[band], amount)
                        adj_ux, adj_uy, adj_uz, adj_zonal = rotated_zonal_adjoint_(ux, uy, uz, zonal, row)
                        adj_amount = Lane(0.0)
                        adj_cosine = Lane(0.0)
                        for band in range(order):
                            adj_amount += wp.cw_mul(adj_zonal[band], shape[band])
                            adj_cosine += wp.cw_mul(adj_zonal[band], slope[band])
                        adj_faded = wp.cw_mul(adj_amount, sine2)
                        adj_height = curvature * wp.cw_mul(wp.cw_mul(adj_faded, weight), fade_slope)
                        adj_dx, adj_dy, adj_dz, adj_radius = cone_adjoint_(
                            curvature * dx,
                            curvature * dy,
                            curvature * dz,
                            curvature,
                            adj_ux,
                            adj_uy,
                            adj_uz,
                            wp.cw_mul(adj_cosine, amount),
                            wp.cw_mul(adj_amount, faded),
                            wp.cw_mul(wp.cw_mul(adj_faded, fade), share),
                        )
                        adj_merged += sign * wp.cw_mul(wp.cw_mul(adj_faded, fade), near)
                        adj_dx += wp.cw_mul(adj_height, nx)
                        adj_dy += wp.cw_mul(adj_height, ny)
                        adj_dz += wp.cw_mul(adj_height, nz)
                        adj_radius -= wp.cw_mul(adj_height, height)
                        adj_nx += wp.cw_mul(adj_height, dx)
                        adj_ny += wp.cw_mul(adj_height, dy)
                        adj_nz += wp.cw_mul(adj_height, dz)
                        adj_x -= adj_dx
                        adj_y -= adj_dy
                        adj_z -= adj_dz
                        add_to_sphere(adj_dx, adj_dy, adj_dz, adj_radius, batch, node, adj_centers, adj_radii)
            adj_dx, adj_dy, adj_dz = merged_adjoint_(
                x, y, z, batch, quad, adj_merged, spheres, adj_centers, adj_radii, adj_extents
            )
            adj_x -= adj_dx
            adj_y -= adj_dy
            adj_z -= adj_dz
        if adj_points:
            add_vectors(adj_x, adj_y, adj_z, group, adj_points[batch])
        if adj_normals:
            add_vectors(adj_nx, adj_ny, adj_nz, group, adj_normals[batch])

    return accumulate_log_sh_adjoint


def accumulate(
    points: wp.array,
    normals: wp.array | None,
    centers: wp.array,
    radii: wp.array,
    *,
    order: int = 8,
    log: str = "eigen",
    merging: float = MERGING,
) -> wp.array:
    """Accumulate the log-visibility of spheres in spherical harmonics.

        f(x) = Σ_i R(u_i) z(θ_i)                      [Lyu et al. 2021, section 3.3.2]

    Args:
        points: Receiver positions [scene units], vec3 of shape [batch, vertex].
        normals: Unit normals of the receivers, vec3 of shape [batch, vertex]: spheres below the horizon, which
            cannot change irradiance but whose band-limited logs leak above it, fade out. None keeps them all.
        centers: Sphere centers [scene units], vec3 of shape [batch, sphere].
        radii: Sphere radii [scene units], float32 of shape [batch, sphere]; a radius of 0 blocks nothing.
        order: Number of SH bands n, 2 to 8.
        log: "eigen" (Ren et al. 2006, accurate where spheres overlap) or "cap" (the paper's).
        merging: τ, the half-angle under which four spheres that follow each other are seen as one, where there are 512
            or more, in radii 2/order of a cell for each coefficient; 0 for never.

    Returns:
        Log-visibility, float32 of shape [batch, vertex, order²], index l² + l + m.

    Raises:
        ValueError: naming the argument, what it got and what it accepts; so for NaN, Inf, numbers beyond 1e18 and
            negative radii. (On a GPU that reads a count back, and is left out while a CUDA graph is captured.)

    Differentiable: points, normals, centers, radii.
    """
    sh.check_order(order)
    check.choice("log", log, LOGS)
    check_spheres(points, normals, centers, radii)
    device = points.device
    lanes = lane_count(device)
    batch_count, vertex_count = points.shape
    row_count = batch_count * group_count(vertex_count, lanes)
    nodes = merge_where_far(centers, radii, merging)
    spheres = make_spheres(nodes, radii.shape[1], merging * cell_radius(order**2))
    variables = [points, normals, *nodes]
    table = zonal_table(order, log, str(device))
    scratch = [Scratch((order**2,), lane_type(lanes))]
    log_sh = wp.empty(
        (batch_count, vertex_count, order**2),
        dtype=wp.float32,
        device=device,
        requires_grad=any(variable is not None and variable.requires_grad for variable in variables),
    )
    cost = _PAIR_COST * lanes * radii.shape[1] * order**2
    launch_slices(
        _accumulate_kernel(order, normals is not None, lanes),
        dim=[row_count],
        cost=cost,
        inputs=[points, normals, spheres, table],
        scratch=scratch,
        outputs=[log_sh],
        device=device,
    )

    def adjoint() -> None:
        launch_slices(
            _accumulate_adjoint_kernel(order, normals is not None, lanes),
            dim=[row_count],
            cost=2 * cost,
            inputs=[points, normals, spheres, table, log_sh.grad],
            scratch=scratch,
            outputs=[points.grad, None if normals is None else normals.grad],
            sums=[array.grad for array in nodes],
            device=device,
        )

    record_adjoint(adjoint, [*variables, log_sh])
    return log_sh


# ---------------------------------------------------------------------------------------------- the slow reference


@functools.cache
def _product_kernel(order: int, lanes: int) -> wp.Kernel:
    Lane, Band = lane_type(lanes), band_type(order)
    fn = lane_functions(lanes)
    find_group, load, store_rows = fn.find_group, fn.load, fn.store_rows
    cone, look_up_ = relative_cone_function(lanes), look_up(order, lanes)
    add_rotated_zonal_, multiply_ = add_rotated_zonal(order, lanes), multiply(order, lanes)
    UNIT = wp.constant(float(np.sqrt(4 * np.pi)))  # the coefficient of the constant function 1

    @wp.kernel(module="unique", module_options=module_options(lanes), enable_backward=False)
    def multiply_spheres(
        first_row: int,
        worker: int,
        # in
        points: wp.array2d(dtype=wp.vec3),
        centers: wp.array2d(dtype=wp.vec3),
        radii: wp.array2d(dtype=wp.float32),
        table: wp.array2d(dtype=Band),
        first: wp.array(dtype=wp.int32),
        pairs: wp.array(dtype=wp.vec2i),
        values: wp.array(dtype=wp.float32),
        # scratch
        scratch: wp.array3d(dtype=Lane),
        # out
        visibility: wp.array3d(dtype=wp.float32),
    ):
        """A thread owns a group of receivers and multiplies the visibility of one sphere after the other."""
        thread = first_row + wp.tid()
        batch, group = find_group(thread, points.shape[1])
        own = scratch[scratch_place(worker, thread)]
        so_far = own[0]
        factor = own[1]
        product = own[2]
        for i in range(wp.static(order**2)):
            so_far[i] = Lane(0.0)
        so_far[0] = Lane(UNIT)
        x, y, z = load(points[batch], group)
        for sphere in range(centers.shape[1]):
            radius = radii[batch, sphere]
            if radius > TINY_RADIUS:
                center = centers[batch, sphere]
                curvature = 1.0 / radius
                ux, uy, uz, cosine, sine2, weight = cone(
                    curvature * (Lane(center[0]) - x),
                    curvature * (Lane(center[1]) - y),
                    curvature * (Lane(center[2]) - z),
                )
                zonal = look_up_(cosine, table)
                for band in range(order):
                    zonal[band] = -wp.cw_mul(zonal[band], wp.cw_mul(sine2, weight))
                for i in range(wp.static(order**2)):
                    factor[i] = Lane(0.0)
                factor[0] = Lane(UNIT)
                add_rotated_zonal_(ux, uy, uz, zonal, factor)
                multiply_(so_far, factor, first, pairs, values, product)
                for i in range(wp.static(order**2)):
                    so_far[i] = product[i]
        store_rows(so_far, group, visibility[batch])

    return multiply_spheres


def multiply_spheres(points: wp.array, centers: wp.array, radii: wp.array, *, order: int = 8) -> wp.array:
    """Multiply the SH visibilities of the spheres one by one: what log space saves, as its reference.

        V(x) = Π_i* (1 − cap(θ_i) turned to u_i),  * the truncated SH product

    Args:
        points: Receiver positions [scene units], vec3 of shape [batch, vertex].
        centers: Sphere centers [scene units], vec3 of shape [batch, sphere].
        radii: Sphere radii [scene units], float32 of shape [batch, sphere].
        order: Number of SH bands n, 2 to 8.

    Returns:
        SH visibility, float32 of shape [batch, vertex, order²].

    Raises:
        ValueError: naming the argument, what it got and what it accepts; so for hundreds of spheres in one direction,
            whose product, truncated again and again, overflows.

    Differentiable: no.
    """
    sh.check_order(order)
    check_spheres(points, None, centers, radii)
    device = points.device
    lanes = lane_count(device)
    batch_count, vertex_count = points.shape
    row_count = batch_count * group_count(vertex_count, lanes)
    visibility = wp.empty((batch_count, vertex_count, order**2), dtype=wp.float32, device=device)
    launch_slices(
        _product_kernel(order, lanes),
        dim=[row_count],
        cost=PRODUCT_COST * lanes * radii.shape[1] * order**4,
        inputs=[
            points,
            centers,
            radii,
            zonal_table(order, "indicator", str(device)),
            *product_table(order, str(device)),
        ],
        scratch=[Scratch((3, order**2), lane_type(lanes))],
        outputs=[visibility],
        device=device,
    )
    if not (device.is_capturing or np.isfinite(visibility.numpy()).all()):
        count = radii.shape[1]
        raise ValueError(f"centers: the SH product of {count} spheres is not finite, expected fewer that overlap")
    return visibility
