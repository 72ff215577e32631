"""The falloff of a blocked cone: how the light of a cell that a sphere blocks goes from none to all at its rim."""

import functools

import warp as wp

from warpshadow.device.lanes import lane_type, make_lane_functions, vectors_type
from warpshadow.stages.visibility.cones import cone_type, make_cone_adjoint
from warpshadow.stages.visibility.traversal import sphere_view_type


@functools.cache
def make_falloff(lanes: int) -> wp.Function:
    """Make the kernel function of the falloff: a cone, sin θ, lo, cosine and sine of w → 1/(hi−lo), A times weight."""
    Lane, Cone = lane_type(lanes), cone_type(lanes)
    sqrt = make_lane_functions(lanes).sqrt

    @wp.func(inline=True)
    def falloff(cone: Cone, sine: Lane, low: Lane, cos_width: float, sin_width: float):
        # cos(max(θ − w, 0)): where θ < w the sine of the difference is cut off at 0
        inner_sine = wp.max(cos_width * sine - sin_width * cone.cosine, Lane(0.0))
        high = sqrt(Lane(1.0) - wp.cw_mul(inner_sine, inner_sine))
        slope = wp.cw_div(Lane(1.0), high - low)
        solid_angle = wp.cw_div(cone.sine2, Lane(1.0) + cone.cosine)
        opacity = wp.cw_div(solid_angle, Lane(1.0) - 0.5 * (high + low))
        return slope, wp.cw_mul(cone.weight, wp.min(opacity, Lane(1.0)))

    return falloff


@functools.cache
def make_falloff_adjoint(lanes: int) -> wp.Function:
    """Make the adjoint of :func:`make_falloff`'s function → adjoints of cos θ, sin²θ and the weight.

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
        cos_width: float,
        sin_width: float,
        adj_low: Lane,
        adj_high: Lane,
        adj_opacity: Lane,
    ):
        inner_sine = wp.max(cos_width * sine - sin_width * cone.cosine, Lane(0.0))
        high = sqrt(Lane(1.0) - wp.cw_mul(inner_sine, inner_sine))
        inverse = wp.cw_div(Lane(1.0), Lane(1.0) - 0.5 * (high + low))
        share = wp.cw_mul(wp.cw_div(cone.sine2, Lane(1.0) + cone.cosine), inverse)
        is_below_one = wp.min(wp.max((Lane(1.0) - share) * 1.0e20, Lane(0.0)), Lane(1.0))
        adj_weight = wp.cw_mul(adj_opacity, wp.min(share, Lane(1.0)))
        adj_solid_angle = wp.cw_mul(wp.cw_mul(is_below_one, wp.cw_mul(adj_opacity, cone.weight)), inverse)
        adj_bound = 0.5 * wp.cw_mul(adj_solid_angle, share)
        total_adj_low = adj_low + adj_bound
        total_adj_high = adj_high + adj_bound
        adj_inner_sine = -wp.cw_div(wp.cw_mul(total_adj_high, inner_sine), high)
        adj_cosine = cos_width * total_adj_low - sin_width * adj_inner_sine - adj_solid_angle
        adj_sine = cos_width * adj_inner_sine - sin_width * total_adj_low
        adj_sine2 = wp.cw_div(0.5 * adj_sine, wp.max(sine, Lane(1.0e-18)))
        return adj_cosine, adj_sine2, adj_weight

    return adjoint


@functools.cache
def make_sphere_adjoint(lanes: int) -> wp.Function:
    """Make the kernel function of the adjoint of all cells that a sphere blocks in part.

    With a = A·step(t) the share of a cell that it blocks and t = (u·ω − lo) slope, a visit sums up over cells

        Ā = Σ ā step,  Σ t̄,  Σ t̄ t,  Σ t̄ ω,  where t̄ = ā A 6t(1−t)

    in variables of its own: in a struct they cost a fifth of the kernel's time on a CPU. The function is: the sphere,
    sin θ, lo, cosine and sine of w, the slope, these sums → adjoints of offset, radius and the cone's weight. In it

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
        cos_width: float,
        sin_width: float,
        slope: Lane,
        adj_opacity: Lane,
        sum_adj_t: Lane,
        sum_t: Lane,
        sum_omega: Vectors,
    ):
        adj_cosine, adj_sine2, adj_weight = falloff_adjoint(
            sphere_view.cone,
            sine,
            low,
            cos_width,
            sin_width,
            wp.cw_mul(slope, sum_t - sum_adj_t),  # type: ignore[operator]
            -wp.cw_mul(slope, sum_t),
            adj_opacity,
        )
        adj_cone = Cone(scale(slope, sum_omega), adj_cosine, adj_sine2, wp.cw_mul(adj_weight, sphere_view.share))
        adj_offset, adj_radius = cone_adjoint(sphere_view.offset, sphere_view.curvature, sphere_view.cone, adj_cone)
        return adj_offset, adj_radius, adj_weight

    return sphere_adjoint
