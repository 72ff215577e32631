"""The soft edge of a blocked cone: how much of a cell's light passes a sphere."""

import functools

import warp as wp

from warpshadow.device.lanes import lane_functions, lane_type


@functools.cache
def edge_function(lanes: int) -> wp.Function:
    """Make the kernel function of a cone's soft edge: cos θ, sin θ, sin²θ, weight, lo, w → hi, 1/(hi−lo), A."""
    Lane = lane_type(lanes)
    sqrt = lane_functions(lanes).sqrt

    @wp.func
    def edge(cosine: Lane, sine: Lane, sine2: Lane, weight: Lane, low: Lane, cos_width: float, sin_width: float):
        # cos(max(θ − w, 0)): where θ < w the sine of the difference is cut off at 0
        inner = wp.max(cos_width * sine - sin_width * cosine, Lane(0.0))
        high = sqrt(Lane(1.0) - wp.cw_mul(inner, inner))
        slope = wp.cw_div(Lane(1.0), high - low)
        solid_angle = wp.cw_div(sine2, Lane(1.0) + cosine)
        opacity = wp.cw_div(solid_angle, Lane(1.0) - 0.5 * (high + low))
        return high, slope, wp.cw_mul(weight, wp.min(opacity, Lane(1.0)))

    return edge


@functools.cache
def edge_adjoint(lanes: int) -> wp.Function:
    """Make the adjoint of :func:`edge_function` → adjoints of cos θ, sin²θ and the weight.

    With k = 1 − cos θ the solid angle over 2π, h = 1 − (hi+lo)/2, g = k/h and m = min(1, g):

        w̄ = Ā m,  k̄ = Ā w/h and h̄ = −Ā w g/h where g < 1,  lo and hi each gain −h̄/2
        lo = cos w cos θ − sin w sin θ,  hi = √(1 − inner²),  inner = cos w sin θ − sin w cos θ where that is positive
    """
    Lane = lane_type(lanes)
    sqrt = lane_functions(lanes).sqrt

    @wp.func
    def adjoint(
        cosine: Lane,
        sine: Lane,
        sine2: Lane,
        weight: Lane,
        cos_width: float,
        sin_width: float,
        adj_low: Lane,
        adj_high: Lane,
        adj_opacity: Lane,
    ):
        low = cos_width * cosine - sin_width * sine
        inner = wp.max(cos_width * sine - sin_width * cosine, Lane(0.0))
        high = sqrt(Lane(1.0) - wp.cw_mul(inner, inner))
        inverse = wp.cw_div(Lane(1.0), Lane(1.0) - 0.5 * (high + low))
        share = wp.cw_mul(wp.cw_div(sine2, Lane(1.0) + cosine), inverse)
        is_partial = wp.min(wp.max((Lane(1.0) - share) * 1.0e20, Lane(0.0)), Lane(1.0))
        adj_weight = wp.cw_mul(adj_opacity, wp.min(share, Lane(1.0)))
        adj_solid_angle = wp.cw_mul(wp.cw_mul(is_partial, wp.cw_mul(adj_opacity, weight)), inverse)
        gain = 0.5 * wp.cw_mul(adj_solid_angle, share)
        low_ = adj_low + gain
        high_ = adj_high + gain
        adj_inner = -wp.cw_div(wp.cw_mul(high_, inner), high)
        adj_cosine = cos_width * low_ - sin_width * adj_inner - adj_solid_angle
        adj_sine = cos_width * adj_inner - sin_width * low_
        adj_sine2 = wp.cw_div(0.5 * adj_sine, wp.max(sine, Lane(1.0e-18)))
        return adj_cosine, adj_sine2, adj_weight

    return adjoint
