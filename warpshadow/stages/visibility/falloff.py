"""The falloff of a blocked cone: how the light of a cell that a sphere blocks goes from none to all at its rim."""

import functools

import warp as wp

from warpshadow.device.lanes import lane_type, make_lane_functions, vectors_type
from warpshadow.maths.directions import BUNDLE
from warpshadow.stages.visibility.cones import cone_type, make_cone_adjoint
from warpshadow.stages.visibility.culling import FOOTPRINT_SHARE, cap_type, make_cap_functions
from warpshadow.stages.visibility.traversal import lane_structs, sphere_view_type


@functools.cache
def make_falloff(lanes: int) -> wp.Function:
    """Make the kernel function of the falloff: a cone, sin θ, lo, cosine and sine of w → 1/(hi−lo), A times weight."""
    Lane, Cone = lane_type(lanes), cone_type(lanes)
    sqrt = make_lane_functions(lanes).sqrt

    @wp.func(inline=True)
    def falloff(cone: Cone, sine: Lane, low: Lane, cos_width: Lane, sin_width: Lane):
        # cos(max(θ − w, 0)): where θ < w the sine of the difference is cut off at 0
        inner_sine = wp.max(wp.cw_mul(cos_width, sine) - wp.cw_mul(sin_width, cone.cosine), Lane(0.0))
        high = sqrt(Lane(1.0) - wp.cw_mul(inner_sine, inner_sine))
        slope = wp.cw_div(Lane(1.0), high - low)
        solid_angle = wp.cw_div(cone.sine2, Lane(1.0) + cone.cosine)
        opacity = wp.cw_div(solid_angle, Lane(1.0) - 0.5 * (high + low))
        return slope, wp.cw_mul(cone.weight, wp.min(opacity, Lane(1.0)))

    return falloff


@functools.cache
def make_falloff_adjoint(lanes: int) -> wp.Function:
    """Make the adjoint of :func:`make_falloff`'s function → adjoints of cos θ, sin²θ, the weight, cos w
    and sin w.

    With k = 1 − cos θ the solid angle over 2π, h = 1 − (hi+lo)/2, g = k/h and m = min(1, g):

        w̄ = Ā m,  k̄ = Ā w/h and h̄ = −Ā w g/h where g < 1,  lo and hi each gain −h̄/2
        lo = cos w cos θ − sin w sin θ,  hi = √(1 − inner²),  inner = cos w sin θ − sin w cos θ where that is positive
    """
    Lane, Cone = lane_type(lanes), cone_type(lanes)
    sqrt = make_lane_functions(lanes).sqrt

    @wp.func(inline=True)
    def adjoint(
        cone: Cone,
        sine: Lane,
        low: Lane,
        cos_width: Lane,
        sin_width: Lane,
        adj_low: Lane,
        adj_high: Lane,
        adj_opacity: Lane,
    ):
        inner_sine = wp.max(wp.cw_mul(cos_width, sine) - wp.cw_mul(sin_width, cone.cosine), Lane(0.0))
        high = sqrt(Lane(1.0) - wp.cw_mul(inner_sine, inner_sine))
        inverse = wp.cw_div(Lane(1.0), Lane(1.0) - 0.5 * (high + low))
        cap_share = wp.cw_mul(wp.cw_div(cone.sine2, Lane(1.0) + cone.cosine), inverse)
        is_below_one = wp.min(wp.max((Lane(1.0) - cap_share) * 1.0e20, Lane(0.0)), Lane(1.0))
        adj_weight = wp.cw_mul(adj_opacity, wp.min(cap_share, Lane(1.0)))
        adj_solid_angle = wp.cw_mul(wp.cw_mul(is_below_one, wp.cw_mul(adj_opacity, cone.weight)), inverse)
        adj_bound = 0.5 * wp.cw_mul(adj_solid_angle, cap_share)
        total_adj_low = adj_low + adj_bound
        total_adj_high = adj_high + adj_bound
        adj_inner_sine = -wp.cw_div(wp.cw_mul(total_adj_high, inner_sine), high)
        adj_cosine = wp.cw_mul(cos_width, total_adj_low) - wp.cw_mul(sin_width, adj_inner_sine) - adj_solid_angle
        adj_sine = wp.cw_mul(cos_width, adj_inner_sine) - wp.cw_mul(sin_width, total_adj_low)
        adj_cos_width = wp.cw_mul(cone.cosine, total_adj_low) + wp.cw_mul(sine, adj_inner_sine)
        adj_sin_width = -wp.cw_mul(sine, total_adj_low) - wp.cw_mul(cone.cosine, adj_inner_sine)
        adj_sine2 = wp.cw_div(0.5 * adj_sine, wp.max(sine, Lane(1.0e-18)))
        return adj_cosine, adj_sine2, adj_weight, adj_cos_width, adj_sin_width

    return adjoint


@functools.cache
def make_sphere_adjoint(lanes: int) -> wp.Function:
    """Make the kernel function of the adjoint of all cells that a sphere blocks in part.

    With a = A·step(t) the share of a cell that it blocks and t = (u·ω − lo) slope, a visit sums up over cells

        Ā = Σ ā step,  Σ t̄,  Σ t̄ t,  Σ t̄ ω,  where t̄ = ā A 6t(1−t)

    in variables of its own: in a struct they cost a fifth of the kernel's time on a CPU. The function is: the sphere,
    sin θ, lo, cosine and sine of w, the slope, these sums → adjoints of offset, radius, the cone's weight,
    cos w and sin w. In it

        ū = slope Σ t̄ ω,  lō = slope (Σ t̄ t − Σ t̄),  hī = −slope Σ t̄ t
    """
    Lane, Vectors, Cone = lane_type(lanes), vectors_type(lanes), cone_type(lanes)
    SphereView, scale = sphere_view_type(lanes), make_lane_functions(lanes).scale
    falloff_adjoint, cone_adjoint = make_falloff_adjoint(lanes), make_cone_adjoint(lanes)

    @wp.func(inline=True)
    def sphere_adjoint(
        sphere_view: SphereView,
        sine: Lane,
        low: Lane,
        cos_width: Lane,
        sin_width: Lane,
        slope: Lane,
        adj_opacity: Lane,
        sum_adj_t: Lane,
        sum_adj_t_t: Lane,
        sum_omega: Vectors,
    ):
        adj_cosine, adj_sine2, adj_weight, adj_cos_width, adj_sin_width = falloff_adjoint(
            sphere_view.cone,
            sine,
            low,
            cos_width,
            sin_width,
            wp.cw_mul(slope, sum_adj_t_t - sum_adj_t),  # type: ignore[operator]
            -wp.cw_mul(slope, sum_adj_t_t),
            adj_opacity,
        )
        adj_cone = Cone(scale(slope, sum_omega), adj_cosine, adj_sine2, wp.cw_mul(adj_weight, sphere_view.merge_weight))
        adj_offset, adj_radius = cone_adjoint(sphere_view.offset, sphere_view.curvature, sphere_view.cone, adj_cone)
        return adj_offset, adj_radius, adj_weight, adj_cos_width, adj_sin_width

    return sphere_adjoint


@functools.cache
def make_squared_edge_distance(lanes: int) -> wp.Function:
    """Make the kernel function of the squared distance D² − r² to the circle at which rays touch a sphere, 0 within."""
    Lane, SphereView, dot = lane_type(lanes), sphere_view_type(lanes), make_lane_functions(lanes).dot

    @wp.func(inline=True)
    def squared_edge_distance(sphere_view: SphereView):
        squared_radius = 1.0 / (sphere_view.curvature * sphere_view.curvature)
        return wp.max(dot(sphere_view.offset, sphere_view.offset) - Lane(squared_radius), Lane(0.0))

    return squared_edge_distance


@functools.cache
def make_cap_adjoint(
    has_horizon: bool,
    find_weight: wp.Function,
    share_adjoint: wp.Function,
    is_costly: bool,
    Task: type,
    lanes: int,
    has_footprints: bool = False,
) -> wp.Function:
    """Make the kernel function of the adjoint of all cells that a sphere blocks in part, for the traversal's visits.

    Args:
        has_horizon: Whether receivers have normals.
        find_weight: (sphere_view, task) → a weight of the sphere for each receiver.
        share_adjoint: (sphere_view, weight, blocked_share, slot, direction, task) → ā of a cell, of which the sphere
            blocks a = A step(t). Slot is the number of the cell among the thread's, direction that among all.
        is_costly: Whether that costs more than the test for cells of which the sphere blocks nothing.
        Task: Struct as for :func:`.culling.make_cull`.

    Returns:
        The function (receivers, sphere_view, count, task) → SphereAdjoint, and Σ ā a.
    """
    Lane, Vectors, Cap = lane_type(lanes), vectors_type(lanes), cap_type(lanes)
    ReceiverLanes, SphereView, SphereAdjoint = lane_structs(lanes)
    fn = make_lane_functions(lanes)
    sqrt, is_any_above, is_positive = fn.sqrt, fn.is_any_above, fn.is_positive
    scale, add = fn.scale, fn.add
    falloff, sphere_adjoint = make_falloff(lanes), make_sphere_adjoint(lanes)
    cap_functions = make_cap_functions(has_horizon, lanes, has_footprints)
    widen_cone, spread, reaches_bundle, is_above_horizon, soft_edge = cap_functions
    squared_edge_distance = make_squared_edge_distance(lanes)

    @wp.func(inline=True)
    def is_looked_at(t: Lane):
        is_reached = bool(True)
        if wp.static(is_costly):
            is_reached = is_any_above(t, 0.0)
        return is_reached

    @wp.func(inline=True)
    def sum_over_cells(
        sphere_view: SphereView, cap: Cap, slope: Lane, opacity: Lane, weight: Lane, count: int, task: Task
    ):
        """Returns whether any cell is blocked; Σ ā step, Σ t̄, Σ t̄ t and Σ t̄ ω."""
        cells = task.cells
        is_any_blocked = bool(False)
        sum_adj_t = Lane(0.0)
        sum_adj_t_t = Lane(0.0)
        sum_x = Lane(0.0)
        sum_y = Lane(0.0)
        sum_z = Lane(0.0)
        adj_opacity = Lane(0.0)
        for k in range(count):
            bundle = task.reached_bundles[1, k]
            direction_bundle = task.first_bundle + bundle
            if task.opaque_from[bundle] > sphere_view.traversal_index and reaches_bundle(
                cap, cells.axes[direction_bundle], cells.half_angles[direction_bundle]
            ):
                for i in range(BUNDLE):
                    direction = direction_bundle * BUNDLE + i
                    omega = cells.directions[direction]
                    t, step = soft_edge(omega, cap, slope)
                    if is_looked_at(t):
                        is_any_blocked = True
                        blocked_share = wp.cw_mul(opacity, step)
                        adj_blocked_share = share_adjoint(
                            sphere_view, weight, blocked_share, bundle * BUNDLE + i, direction, task
                        )
                        adj_opacity += wp.cw_mul(adj_blocked_share, step)
                        step_slope = wp.cw_mul(t, Lane(1.0) - t)
                        adj_t = 6.0 * wp.cw_mul(wp.cw_mul(adj_blocked_share, opacity), step_slope)
                        sum_adj_t += adj_t
                        sum_adj_t_t += wp.cw_mul(adj_t, t)
                        sum_x += omega[0] * adj_t
                        sum_y += omega[1] * adj_t
                        sum_z += omega[2] * adj_t
        return is_any_blocked, adj_opacity, sum_adj_t, sum_adj_t_t, Vectors(sum_x, sum_y, sum_z)

    @wp.func(inline=True)
    def cap_adjoint(receivers: ReceiverLanes, sphere_view: SphereView, count: int, task: Task):
        adj_sphere = SphereAdjoint()
        cone = sphere_view.cone
        cells = task.cells
        sine = sqrt(cone.sine2)
        squared_distance = squared_edge_distance(sphere_view)
        cap = widen_cone(cone.axis, cone.cosine, sine, squared_distance, receivers, cells)
        relative_adjoint = Lane(0.0)
        if is_above_horizon(cap, receivers.normals):
            slope, opacity = falloff(cone, sine, cap.cosine, cap.cos_width, cap.sin_width)
            weight = find_weight(sphere_view, task)
            is_any_blocked, adj_opacity, sum_adj_t, sum_adj_t_t, sum_omega = sum_over_cells(
                sphere_view, cap, slope, opacity, weight, count, task
            )
            if is_any_blocked:
                adj_offset, adj_radius, adj_weight, adj_cos_width, adj_sin_width = sphere_adjoint(
                    sphere_view,
                    sine,
                    cap.cosine,
                    cap.cos_width,
                    cap.sin_width,
                    slope,
                    adj_opacity,
                    sum_adj_t,
                    sum_adj_t_t,
                    sum_omega,
                )
                if wp.static(has_footprints):
                    # sin²w = sin²w₀ + s, s = f/(d² + 2f), d² = D² − r²
                    adj_spread = 0.5 * (
                        wp.cw_div(adj_sin_width, cap.sin_width) - wp.cw_div(adj_cos_width, cap.cos_width)
                    )
                    distance_slope = wp.cw_div(
                        spread(squared_distance, receivers),
                        wp.max(squared_distance + (2.0 * FOOTPRINT_SHARE) * receivers.footprints, Lane(1.0e-37)),
                    )
                    is_outside = is_positive(squared_distance)
                    adj_squared_distance = -wp.cw_mul(is_outside, wp.cw_mul(adj_spread, distance_slope))
                    adj_offset = add(adj_offset, scale(2.0 * adj_squared_distance, sphere_view.offset))
                    adj_radius -= (2.0 / sphere_view.curvature) * adj_squared_distance
                adj_sphere.is_any = True
                adj_sphere.offset = adj_offset
                adj_sphere.radius = adj_radius
                adj_sphere.weight = adj_weight
                relative_adjoint = wp.cw_mul(adj_opacity, opacity)
        return adj_sphere, relative_adjoint

    return cap_adjoint
