"""Log-visibility in spherical harmonics: the blocked cones of the spheres, turned to their directions, add up.

log V(x) ≈ f(x) = Σ_i R(u_i) z(θ_i)                [Lyu et al. 2021, section 3.3.2, after Ren et al. 2006]
"""

import functools
from collections.abc import Sequence
from typing import Any

import warp as wp

from warpshadow import check
from warpshadow.device.lanes import lane_type, make_lane_functions, module_options
from warpshadow.device.launch import launch_with_adjoint
from warpshadow.device.memory import empty
from warpshadow.device.parallel import Scratch, scratch_slot
from warpshadow.maths import sh
from warpshadow.maths.directions import cell_radius
from warpshadow.stages.receivers.body_spans import Span
from warpshadow.stages.sh_kernels import make_add_rotated_zonal, make_rotated_zonal_adjoint, zonal_type
from warpshadow.stages.visibility.cones import cone_type, make_cone_adjoint
from warpshadow.stages.visibility.merging import MERGING, Gradients
from warpshadow.stages.visibility.traversal import (
    ClusterTree,
    TraversalInputs,
    lane_structs,
    make_load_receivers,
    make_traversal,
    prepare_traversal,
    receiver_lanes_type,
    sphere_view_type,
)
from warpshadow.stages.visibility.zonal_logs import LOGS, band_type, make_interpolate_zonal, zonal_table

HORIZON_FADE = 0.5  # a sphere fades out from (1 − HORIZON_FADE) radii to one radius below the tangent plane


_PAIR_COST = 0.25  # nanoseconds that a sphere costs for a receiver and a coefficient


@functools.cache
def _task_type(order: int, lanes: int) -> Any:
    """Struct of the coefficients of a thread's block."""
    Lane, Band = lane_type(lanes), band_type(order)

    @wp.struct
    class LogTask:
        table: wp.array2d(dtype=Band)
        row: wp.array(dtype=Lane)  # log-visibility; for the adjoint its adjoint

    return LogTask


@functools.cache
def _make_horizon(lanes: int) -> wp.Function:
    """Make the kernel function of the fade at the horizon: n·d/r → weight and its derivative."""
    Lane, smoothstep = lane_type(lanes), make_lane_functions(lanes).smoothstep

    @wp.func(inline=True)
    def horizon(height: Lane):
        t = wp.min(wp.max((height + Lane(1.0)) / HORIZON_FADE, Lane(0.0)), Lane(1.0))
        fade_slope = 6.0 / HORIZON_FADE * wp.cw_mul(t, Lane(1.0) - t)
        return smoothstep(t), fade_slope

    return horizon


@functools.cache
def _make_cull(order: int, has_horizon: bool, lanes: int) -> wp.Function:
    """Make the kernel function that says whether spheres are above the horizon of any receiver, if only in part."""
    ReceiverLanes, LogTask = receiver_lanes_type(lanes), _task_type(order, lanes)
    fn = make_lane_functions(lanes)
    is_any_above, dot, offset = fn.is_any_above, fn.dot, fn.offset

    @wp.func
    def cull(receivers: ReceiverLanes, bound: wp.vec4, traversal_index: int, candidates: int, task: LogTask):
        """Returns 1 or 0."""
        count = int(1)
        if wp.static(has_horizon):
            height = dot(receivers.normals, offset(wp.vec3(bound[0], bound[1], bound[2]), receivers.points))
            if not is_any_above(height, -1.001 * bound[3]):  # rounding included
                count = 0
        return count

    return cull


@functools.cache
def _make_accumulate(order: int, has_horizon: bool, lanes: int) -> wp.Kernel:
    Lane, Band, LogTask = lane_type(lanes), band_type(order), _task_type(order, lanes)
    ReceiverLanes, SphereView = receiver_lanes_type(lanes), sphere_view_type(lanes)
    fn = make_lane_functions(lanes)
    store_rows, is_any_above, dot = fn.store_rows, fn.is_any_above, fn.dot
    load_receivers, horizon = make_load_receivers(has_horizon, lanes), _make_horizon(lanes)
    interpolate_zonal, add_rotated_zonal = (
        make_interpolate_zonal(order, False, lanes),
        make_add_rotated_zonal(order, lanes),
    )

    @wp.func(inline=True)
    def visit(receivers: ReceiverLanes, sphere_view: SphereView, count: int, task: LogTask):
        weight = sphere_view.cone.weight
        if wp.static(has_horizon):
            fade, _slope = horizon(sphere_view.curvature * dot(receivers.normals, sphere_view.offset))
            weight = wp.cw_mul(weight, fade)
        if is_any_above(weight, 0.0):
            zonal_scale = wp.cw_mul(sphere_view.cone.sine2, weight)
            zonal = interpolate_zonal(sphere_view.cone.cosine, task.table)
            for band in range(order):
                zonal[band] = wp.cw_mul(zonal[band], zonal_scale)
            add_rotated_zonal(sphere_view.cone.axis, zonal, task.row)

    traverse = make_traversal(_make_cull(order, has_horizon, lanes), visit, LogTask, False, lanes)

    @wp.kernel(module="unique", module_options=module_options(lanes), enable_backward=False)
    def accumulate_log_sh(
        first_row: int,
        worker: int,
        # in
        inputs: TraversalInputs,
        table: wp.array2d(dtype=Band),
        # scratch
        scratch: wp.array2d(dtype=Lane),
        # out
        log_sh: wp.array3d(dtype=wp.float32),
    ):
        """A thread owns a block of receivers and sums the log-visibility of all spheres."""
        thread = first_row + wp.tid()
        block, receivers = load_receivers(inputs, thread)
        row = scratch[scratch_slot(worker, thread)]
        for i in range(wp.static(order**2)):
            row[i] = Lane(0.0)
        traverse(receivers, block.batch, inputs.spheres, Gradients(), LogTask(table, row))
        store_rows(row, block.number, log_sh[block.batch][block.first : block.end])

    return accumulate_log_sh


@functools.cache
def _make_accumulate_adjoint(order: int, has_horizon: bool, lanes: int) -> wp.Kernel:
    Lane, Zonal, Band, Cone = lane_type(lanes), zonal_type(order, lanes), band_type(order), cone_type(lanes)
    ReceiverLanes, SphereView, SphereAdjoint = lane_structs(lanes)
    LogTask = _task_type(order, lanes)
    fn = make_lane_functions(lanes)
    load_rows, add_vectors = fn.load_rows, fn.add_vectors
    is_any_above, dot, add, scale = fn.is_any_above, fn.dot, fn.add, fn.scale
    cone_adjoint = make_cone_adjoint(lanes)
    load_receivers, horizon = make_load_receivers(has_horizon, lanes), _make_horizon(lanes)
    interpolate_zonal, interpolate_zonal_slope = (
        make_interpolate_zonal(order, False, lanes),
        make_interpolate_zonal(order, True, lanes),
    )
    rotated_zonal_adjoint = make_rotated_zonal_adjoint(order, lanes)

    @wp.func(inline=True)
    def visit(receivers: ReceiverLanes, sphere_view: SphereView, count: int, task: LogTask):
        """The adjoint of the sphere's cone and of its height over the horizon.

        With z_l = a h_l(c), a = s² w and h from the table:  ā = Σ z̄_l h_l,  c̄ = a Σ z̄_l h_l',  s̄² = ā w,  w̄ = ā
        s², and with w = w_cone w_horizon(n·d/r):  n̄ = d w̄_h w_h'/r,  d̄ += n w̄_h w_h'/r,  r̄ −= n·d/r w̄_h w_h'/r
        """
        adj_sphere = SphereAdjoint()
        cone = sphere_view.cone
        height = Lane(0.0)
        fade = Lane(1.0)
        fade_slope = Lane(0.0)
        if wp.static(has_horizon):
            height = sphere_view.curvature * dot(receivers.normals, sphere_view.offset)
            height = wp.min(wp.max(height, Lane(-1.0)), Lane(1.0))  # beyond, nothing depends on it
            fade, fade_slope = horizon(height)
        faded_weight = wp.cw_mul(cone.weight, fade)
        if is_any_above(faded_weight, 0.0):
            zonal_scale = wp.cw_mul(cone.sine2, faded_weight)
            zonal_values = interpolate_zonal(cone.cosine, task.table)
            zonal_slopes = interpolate_zonal_slope(cone.cosine, task.table)
            zonal = Zonal()
            for band in range(order):
                zonal[band] = wp.cw_mul(zonal_values[band], zonal_scale)
            adj_axis, adj_zonal = rotated_zonal_adjoint(cone.axis, zonal, task.row)
            adj_zonal_scale = Lane(0.0)
            adj_cosine = Lane(0.0)
            for band in range(order):
                adj_zonal_scale += wp.cw_mul(adj_zonal[band], zonal_values[band])
                adj_cosine += wp.cw_mul(adj_zonal[band], zonal_slopes[band])
            adj_faded_weight = wp.cw_mul(adj_zonal_scale, cone.sine2)
            adj_weight = wp.cw_mul(adj_faded_weight, fade)
            adj_cone = Cone(
                adj_axis,
                wp.cw_mul(adj_cosine, zonal_scale),
                wp.cw_mul(adj_zonal_scale, faded_weight),
                wp.cw_mul(adj_weight, sphere_view.merge_weight),
            )
            adj_offset, adj_radius = cone_adjoint(sphere_view.offset, sphere_view.curvature, cone, adj_cone)
            adj_height = sphere_view.curvature * wp.cw_mul(wp.cw_mul(adj_faded_weight, cone.weight), fade_slope)
            adj_sphere.is_any = True
            adj_sphere.offset = add(adj_offset, scale(adj_height, receivers.normals))
            adj_sphere.radius = adj_radius - wp.cw_mul(adj_height, height)
            adj_sphere.weight = adj_weight
            adj_sphere.normals = scale(adj_height, sphere_view.offset)
        return adj_sphere

    traverse = make_traversal(_make_cull(order, has_horizon, lanes), visit, LogTask, True, lanes)

    @wp.kernel(module="unique", module_options=module_options(lanes), enable_backward=False)
    def accumulate_log_sh_adjoint(
        first_row: int,
        worker: int,
        # in
        inputs: TraversalInputs,
        table: wp.array2d(dtype=Band),
        adj_log_sh: wp.array3d(dtype=wp.float32),
        # scratch
        scratch: wp.array2d(dtype=Lane),
        # out
        adj_points: wp.array2d(dtype=wp.vec3),
        adj_normals: wp.array2d(dtype=wp.vec3),
        # sums
        adj_centers: wp.array2d(dtype=wp.vec3),
        adj_radii: wp.array2d(dtype=wp.float32),
        adj_extents: wp.array2d(dtype=wp.float32),
    ):
        """A thread owns a block of receivers."""
        thread = first_row + wp.tid()
        block, receivers = load_receivers(inputs, thread)
        row = scratch[scratch_slot(worker, thread)]
        load_rows(adj_log_sh[block.batch][block.first : block.end], block.number, row)
        gradients = Gradients(adj_centers, adj_radii, adj_extents)
        adj_receivers = traverse(receivers, block.batch, inputs.spheres, gradients, LogTask(table, row))
        if adj_points:
            add_vectors(adj_receivers.points, block.number, adj_points[block.batch][block.first : block.end])
        if adj_normals:
            add_vectors(adj_receivers.normals, block.number, adj_normals[block.batch][block.first : block.end])

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
    body_spans: Sequence[Span] = (),
    skips: Sequence[tuple[int, int]] = (),
    clusters: ClusterTree | None = None,
) -> wp.array:
    """Accumulate the log-visibility of spheres in spherical harmonics.

        f(x) = Σ_i R(u_i) z(θ_i)                      [Lyu et al. 2021, section 3.3.2]

    Args:
        points: Receiver positions [scene units], vec3 of shape [batch, receiver].
        normals: Unit normals of the receivers, vec3 of shape [batch, receiver]: spheres below the horizon, which
            cannot change irradiance but whose band-limited logs leak above it, fade out. None keeps them all.
        centers: Sphere centers [scene units], vec3 of shape [batch, sphere].
        radii: Sphere radii [scene units], float32 of shape [batch, sphere]; a radius of 0 blocks nothing.
        order: Number of SH bands n, 2 to 8.
        log: "eigen" (Ren et al. 2006, accurate where spheres overlap) or "cap" (the paper's).
        merging: τ, the half-angle under which four spheres that follow each other are seen as one, where there are 512
            or more, in radii 2/order of a cell for each coefficient; 0 for never.
        body_spans, skips, clusters: As for :func:`warpshadow.stages.visibility.directional.transmittance`.
    Returns:
        Log-visibility, float32 of shape [batch, receiver, order²], index l² + l + m.
    Raises:
        ValueError: for NaN, Inf, numbers beyond 1e18 and negative radii, as the transmittance.
    Differentiable: points, normals, centers, radii.
    """
    sh.check_order(order)
    check.choice("log", log, LOGS)
    arguments = points, normals, centers, radii, cell_radius(order**2)
    inputs, nodes, lanes, row_count = prepare_traversal(
        *arguments, merging=merging, body_spans=body_spans, skips=skips, clusters=clusters
    )
    traits = order, normals is not None, lanes
    return launch_with_adjoint(
        _make_accumulate(*traits),
        lambda: _make_accumulate_adjoint(*traits),
        row_count,
        inputs=[inputs, zonal_table(order, log, str(points.device))],
        result=empty((*points.shape, order**2), dtype=wp.float32, device=points.device),
        variables=[points, normals],
        shared=nodes,
        scratch=[Scratch((order**2,), lane_type(lanes))],
        cost=_PAIR_COST * lanes * radii.shape[1] * order**2,
    )
