"""The cone of directions that a sphere blocks, as a receiver sees it: on, inside and far from the sphere.

A sphere of radius r at distance D blocks the half-angle θ, sin θ = r/D. Receivers on a mesh lie on and inside the
spheres that stand in for it, so the rule goes on, C¹, where that formula ends:

    D ≥ 1.01 r      exact, c = cos θ = √(1 − r²/D²)
    r … 1.01 r      a cubic that meets it in value and slope and takes c to 0 (θ = 90°) with slope 0 at D = r
    D < r           a hemisphere, c = 0
    D < r/4         the sphere fades out, since at its center it has no direction
"""

import functools
from typing import Any

import numpy as np
import warp as wp

from warpshadow import check
from warpshadow.device.array_checks import finite_arrays
from warpshadow.device.lanes import lane_type, make_lane_functions, vectors_type

BLEND = 0.01  # the exact formula ends at D = (1 + BLEND) r
FADE_RADIUS = 0.25  # the sphere fades out from D = FADE_RADIUS · r to its center
TINY_RADIUS = 1.0e-19  # spheres no larger block nothing: the largest distance, over one that is, is still a float32

_MIN_DISTANCE2 = 1.0e-37  # (D/r)² is kept where its root and the inverse of that are float32
_MAX_DISTANCE2 = 1.0e38

_BLEND_SINE2 = (1 + BLEND) ** -2  # where the blend begins: sin²θ, cos θ, and d(cos θ)/d(D/r) times the blend's width
_BLEND_COSINE = np.sqrt(1 - _BLEND_SINE2)
_BLEND_SLOPE = BLEND * (1 + BLEND) ** -3 / _BLEND_COSINE


def check_spheres(points: wp.array, normals: wp.array | None, centers: wp.array, radii: wp.array) -> None:
    """Raise ValueError unless receivers [batch, receiver] and spheres [batch, sphere] are finite and fit each other."""
    check.shape("points", points.shape, ("batch", "receiver"))
    if normals is not None:
        check.shape("normals", normals.shape, points.shape)
    check.shape("centers", centers.shape, (points.shape[0], "sphere"))
    check.shape("radii", radii.shape, centers.shape)
    arrays = {"points": points, "normals": normals, "centers": centers, "radii": radii}
    finite_arrays(arrays, nonnegative=["radii"])


@functools.cache
def cone_type(lanes: int) -> Any:
    """Struct of the cones of a sphere, one for each receiver of a block."""
    Lane, Vectors = lane_type(lanes), vectors_type(lanes)

    @wp.struct
    class Cone:
        axis: Vectors  # unit; 0 at the sphere's center
        cosine: Lane  # of the half-angle θ
        sine2: Lane  # sin²θ, accurate for tiny spheres, where 1 − cos²θ is not
        weight: Lane  # in [0, 1]: fades the sphere out near its center

    return Cone


@functools.cache
def make_cone(lanes: int) -> wp.Function:
    """Make the kernel function of a block of receivers: offsets to a sphere's center, and 1/radius → its cones."""
    Lane, Vectors, Cone = lane_type(lanes), vectors_type(lanes), cone_type(lanes)
    fn = make_lane_functions(lanes)
    sqrt, scale, dot, smoothstep = fn.sqrt, fn.scale, fn.dot, fn.smoothstep
    BLEND_SINE2 = wp.constant(float(_BLEND_SINE2))
    BLEND_COSINE = wp.constant(float(_BLEND_COSINE))
    BLEND_SLOPE = wp.constant(float(_BLEND_SLOPE))
    MIN_DISTANCE2 = wp.constant(_MIN_DISTANCE2)

    @wp.func(inline=True)
    def cone(offset: Vectors, curvature: float):
        scaled_offset = Vectors(curvature * offset.x, curvature * offset.y, curvature * offset.z)
        # A receiver at the center has direction 0 and weight 0. One so far that the square is Inf has inverse 0.
        distance = sqrt(wp.max(dot(scaled_offset, scaled_offset), Lane(MIN_DISTANCE2)))
        inverse = wp.cw_div(Lane(1.0), distance)
        sine2 = wp.min(wp.cw_mul(inverse, inverse), Lane(BLEND_SINE2))
        # The blend's cubic misses its cosine by exactly 0 from 1.01 r on, as blend_position is 0 there: sums need no
        # cases, and sine2 keeps its digits even where a compiler fuses multiplication and addition.
        t = wp.min(wp.max((1.0 / BLEND) * (distance - Lane(1.0)), Lane(0.0)), Lane(1.0))
        blend_position = Lane(1.0) - t
        cosine_deficit = wp.cw_mul(
            blend_position,
            Lane(3.0 * BLEND_COSINE - 2.0 * BLEND_SLOPE) + (BLEND_SLOPE - 2.0 * BLEND_COSINE) * blend_position,
        )
        cosine_deficit = wp.cw_mul(blend_position, Lane(BLEND_SLOPE) + cosine_deficit)
        cosine = sqrt(Lane(1.0) - sine2) - cosine_deficit
        sine2 = sine2 + wp.cw_mul(cosine_deficit, Lane(2.0 * BLEND_COSINE) - cosine_deficit)
        fade_position = wp.min((1.0 / FADE_RADIUS) * distance, Lane(1.0))
        return Cone(scale(inverse, scaled_offset), cosine, sine2, smoothstep(fade_position))

    return cone


@functools.cache
def make_cone_adjoint(lanes: int) -> wp.Function:
    """Make the adjoint of :func:`make_cone`'s function: its arguments, result and adjoint → adj of offset and radius.

    Cosine, sin²θ and weight depend on X = D/r alone, and sin²θ = 1 − cos²θ, so with c' = dc/dX

        X̄ = (c̄ − 2c s̄²) c' + w̄ w',   r̄ = −X̄ X / r,   d̄ = ((ū − u (u·ū)) / X + u X̄) / r
        c' = X⁻³ / c beyond 1.01 r, else the slope of the blend's cubic
    """
    Lane, Vectors, Cone = lane_type(lanes), vectors_type(lanes), cone_type(lanes)
    fn = make_lane_functions(lanes)
    sqrt, dot = fn.sqrt, fn.dot
    BLEND_SINE2 = wp.constant(float(_BLEND_SINE2))
    BLEND_COSINE = wp.constant(float(_BLEND_COSINE))
    BLEND_SLOPE = wp.constant(float(_BLEND_SLOPE))
    MIN_DISTANCE2 = wp.constant(_MIN_DISTANCE2)
    MAX_DISTANCE2 = wp.constant(_MAX_DISTANCE2)

    @wp.func(inline=True)
    def adjoint(offset: Vectors, curvature: float, cone: Cone, adj_cone: Cone):
        scaled_offset = Vectors(curvature * offset.x, curvature * offset.y, curvature * offset.z)
        distance = sqrt(wp.min(wp.max(dot(scaled_offset, scaled_offset), Lane(MIN_DISTANCE2)), Lane(MAX_DISTANCE2)))
        inverse = wp.cw_div(Lane(1.0), distance)
        ratio2 = wp.min(wp.cw_mul(inverse, inverse), Lane(BLEND_SINE2))
        exact_slope = wp.cw_div(wp.cw_mul(ratio2, sqrt(ratio2)), sqrt(Lane(1.0) - ratio2))
        blend_position = Lane(1.0) - wp.min(wp.max((1.0 / BLEND) * (distance - Lane(1.0)), Lane(0.0)), Lane(1.0))
        blend_slope = Lane(BLEND_SLOPE) + wp.cw_mul(
            blend_position,
            Lane(6.0 * BLEND_COSINE - 4.0 * BLEND_SLOPE) + (3.0 * BLEND_SLOPE - 6.0 * BLEND_COSINE) * blend_position,
        )
        is_blended = wp.min(wp.max((Lane(1.0 + BLEND) - distance) * 1.0e20, Lane(0.0)), Lane(1.0))
        cosine_slope = exact_slope + wp.cw_mul(is_blended, (1.0 / BLEND) * blend_slope - exact_slope)
        fade_position = wp.min((1.0 / FADE_RADIUS) * distance, Lane(1.0))
        weight_slope = (6.0 / FADE_RADIUS) * wp.cw_mul(fade_position, Lane(1.0) - fade_position)

        adj_distance = Lane(0.0)  # summed up from 0, all of the kernel runs a seventh faster on a CPU
        adj_distance += wp.cw_mul(adj_cone.cosine - 2.0 * wp.cw_mul(cone.cosine, adj_cone.sine2), cosine_slope)
        adj_distance += wp.cw_mul(adj_cone.weight, weight_slope)
        axis, adj_axis = cone.axis, adj_cone.axis
        adj_radial = adj_distance - wp.cw_mul(dot(axis, adj_axis), inverse)
        adj_offset = Vectors(
            curvature * (wp.cw_mul(adj_axis.x, inverse) + wp.cw_mul(axis.x, adj_radial)),
            curvature * (wp.cw_mul(adj_axis.y, inverse) + wp.cw_mul(axis.y, adj_radial)),
            curvature * (wp.cw_mul(adj_axis.z, inverse) + wp.cw_mul(axis.z, adj_radial)),
        )
        return adj_offset, -curvature * wp.cw_mul(adj_distance, distance)

    return adjoint
