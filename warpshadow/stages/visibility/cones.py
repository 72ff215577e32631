"""The cone of directions that a sphere blocks, as a receiver sees it: on, inside and far from the sphere.

A sphere of radius r at distance D blocks the half-angle θ, sin θ = r/D. Receivers on a mesh lie on and inside the
spheres that stand in for it, so the rule goes on, C¹, where that formula ends:

    D ≥ 1.01 r      exact, c = cos θ = √(1 − r²/D²)
    r … 1.01 r      a cubic that meets it in value and slope and takes c to 0 (θ = 90°) with slope 0 at D = r
    D < r           a hemisphere, c = 0
    D < r/4         the sphere fades out, since at its center it has no direction
"""

import functools

import numpy as np
import warp as wp

from warpshadow import check
from warpshadow.device.lanes import lane_functions, lane_type

BLEND = 0.01
"""The exact formula ends at D = (1 + BLEND) r."""

FADE = 0.25
"""The sphere fades out from D = FADE·r to its center."""

TINY_RADIUS = 1.0e-19
"""Spheres no larger block nothing: the largest distance, over one that is, is still a float32."""

_NEAREST2 = 1.0e-37  # (D/r)² is kept where its root and the inverse of that are float32
_FARTHEST2 = 1.0e38

_SINE2 = (1 + BLEND) ** -2  # where the blend begins: sin²θ, cos θ, and d(cos θ)/d(D/r) times the blend's width
_COSINE = np.sqrt(1 - _SINE2)
_RISE = BLEND * (1 + BLEND) ** -3 / _COSINE


def check_spheres(points: wp.array, normals: wp.array | None, centers: wp.array, radii: wp.array) -> None:
    """Raise ValueError unless receivers [batch, vertex] and spheres [batch, sphere] are finite and fit each other."""
    check.shape("points", points.shape, ("batch", "vertex"))
    if normals is not None:
        check.shape("normals", normals.shape, points.shape)
    check.shape("centers", centers.shape, (points.shape[0], "sphere"))
    check.shape("radii", radii.shape, centers.shape)
    arrays = {"points": points, "normals": normals, "centers": centers, "radii": radii}
    check.finite_arrays(arrays, nonnegative=["radii"])


@functools.cache
def cone_function(lanes: int) -> wp.Function:
    """Make the kernel function of a group of receivers: the offset to a sphere's center and its radius → its cone.

    :func:`relative_cone_function` of the offset in radii.
    """
    Lane = lane_type(lanes)
    relative_cone = relative_cone_function(lanes)

    @wp.func
    def cone(dx: Lane, dy: Lane, dz: Lane, radius: float):
        return relative_cone((1.0 / radius) * dx, (1.0 / radius) * dy, (1.0 / radius) * dz)

    return cone


@functools.cache
def relative_cone_function(lanes: int) -> wp.Function:
    """Make the kernel function of a group of receivers: the offset to a sphere's center, in radii → its cone.

    It returns lanes of: the direction's x, y, z; cos θ; sin²θ (accurate for tiny spheres, where 1 − cos²θ is not);
    the weight in [0, 1] that fades the sphere out near its center.
    """
    Lane = lane_type(lanes)
    sqrt = lane_functions(lanes).sqrt
    SINE2 = wp.constant(float(_SINE2))
    COSINE = wp.constant(float(_COSINE))
    RISE = wp.constant(float(_RISE))
    NEAREST2 = wp.constant(_NEAREST2)

    @wp.func
    def cone(x: Lane, y: Lane, z: Lane):
        distance2 = wp.cw_mul(x, x) + wp.cw_mul(y, y) + wp.cw_mul(z, z)
        # A receiver at the center has direction 0 and weight 0. One so far that the square is Inf has inverse 0.
        distance = sqrt(wp.max(distance2, Lane(NEAREST2)))
        inverse = wp.cw_div(Lane(1.0), distance)
        sine2 = wp.min(wp.cw_mul(inverse, inverse), Lane(SINE2))
        # What the blend's cubic lacks of _COSINE is exactly 0 from 1.01 r on, where u is: sums need no cases, and
        # sine2 keeps its digits even where a compiler fuses multiplication and addition.
        t = wp.min(wp.max((1.0 / BLEND) * (distance - Lane(1.0)), Lane(0.0)), Lane(1.0))
        u = Lane(1.0) - t
        lack = wp.cw_mul(u, Lane(3.0 * COSINE - 2.0 * RISE) + (RISE - 2.0 * COSINE) * u)
        lack = wp.cw_mul(u, Lane(RISE) + lack)
        cosine = sqrt(Lane(1.0) - sine2) - lack
        sine2 = sine2 + wp.cw_mul(lack, Lane(2.0 * COSINE) - lack)
        near = wp.min((1.0 / FADE) * distance, Lane(1.0))
        weight = wp.cw_mul(wp.cw_mul(near, near), Lane(3.0) - 2.0 * near)
        return wp.cw_mul(x, inverse), wp.cw_mul(y, inverse), wp.cw_mul(z, inverse), cosine, sine2, weight

    return cone


@functools.cache
def cone_adjoint(lanes: int) -> wp.Function:
    """Make the adjoint of :func:`cone_function`: offset in radii, 1/radius, adjoints of results → those of arguments.

    Cosine, sin²θ and weight depend on X = D/r alone, and sin²θ = 1 − cos²θ, so with c' = dc/dX

        X̄ = (c̄ − 2c s̄²) c' + w̄ w',   r̄ = −X̄ X / r,   d̄ = ((ū − u (u·ū)) / X + u X̄) / r
        c' = X⁻³ / c beyond 1.01 r, else the slope of the blend's cubic
    """
    Lane = lane_type(lanes)
    sqrt = lane_functions(lanes).sqrt
    cone = relative_cone_function(lanes)
    SINE2 = wp.constant(float(_SINE2))
    COSINE = wp.constant(float(_COSINE))
    RISE = wp.constant(float(_RISE))
    NEAREST2 = wp.constant(_NEAREST2)
    FARTHEST2 = wp.constant(_FARTHEST2)

    @wp.func
    def adjoint(
        x: Lane,
        y: Lane,
        z: Lane,
        curvature: float,
        adj_ux: Lane,
        adj_uy: Lane,
        adj_uz: Lane,
        adj_cosine: Lane,
        adj_sine2: Lane,
        adj_weight: Lane,
    ):
        ux, uy, uz, cosine, _sine2, _weight = cone(x, y, z)
        distance2 = wp.cw_mul(x, x) + wp.cw_mul(y, y) + wp.cw_mul(z, z)
        distance = sqrt(wp.min(wp.max(distance2, Lane(NEAREST2)), Lane(FARTHEST2)))
        inverse = wp.cw_div(Lane(1.0), distance)
        ratio2 = wp.min(wp.cw_mul(inverse, inverse), Lane(SINE2))
        beyond = wp.cw_div(wp.cw_mul(ratio2, sqrt(ratio2)), sqrt(Lane(1.0) - ratio2))
        u = Lane(1.0) - wp.min(wp.max((1.0 / BLEND) * (distance - Lane(1.0)), Lane(0.0)), Lane(1.0))
        within = Lane(RISE) + wp.cw_mul(u, Lane(6.0 * COSINE - 4.0 * RISE) + (3.0 * RISE - 6.0 * COSINE) * u)
        is_within = wp.min(wp.max((Lane(1.0 + BLEND) - distance) * 1.0e20, Lane(0.0)), Lane(1.0))
        cosine_slope = beyond + wp.cw_mul(is_within, (1.0 / BLEND) * within - beyond)
        near = wp.min((1.0 / FADE) * distance, Lane(1.0))
        weight_slope = (6.0 / FADE) * wp.cw_mul(near, Lane(1.0) - near)

        adj_distance = Lane(0.0)  # summed up from 0, all of the kernel runs a seventh faster on a CPU
        adj_distance += wp.cw_mul(adj_cosine - 2.0 * wp.cw_mul(cosine, adj_sine2), cosine_slope)
        adj_distance += wp.cw_mul(adj_weight, weight_slope)
        along = wp.cw_mul(ux, adj_ux) + wp.cw_mul(uy, adj_uy) + wp.cw_mul(uz, adj_uz)
        radial = adj_distance - wp.cw_mul(along, inverse)
        adj_dx = curvature * (wp.cw_mul(adj_ux, inverse) + wp.cw_mul(ux, radial))
        adj_dy = curvature * (wp.cw_mul(adj_uy, inverse) + wp.cw_mul(uy, radial))
        adj_dz = curvature * (wp.cw_mul(adj_uz, inverse) + wp.cw_mul(uz, radial))
        return adj_dx, adj_dy, adj_dz, -curvature * wp.cw_mul(adj_distance, distance)

    return adjoint
