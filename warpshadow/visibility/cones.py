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
from warpshadow.lanes import lane_functions, lane_type

BLEND = 0.01
"""The exact formula ends at D = (1 + BLEND) r."""

FADE = 0.25
"""The sphere fades out from D = FADE·r to its center."""

TINY_RADIUS = 1.0e-30
"""Spheres no larger block nothing: float32 could not divide by them."""

_SINE2 = (1 + BLEND) ** -2  # where the blend begins: sin²θ, cos θ, and d(cos θ)/d(D/r) times the blend's width
_COSINE = np.sqrt(1 - _SINE2)
_RISE = BLEND * (1 + BLEND) ** -3 / _COSINE


def check_spheres(points: wp.array, normals: wp.array | None, centers: wp.array, radii: wp.array) -> None:
    """Raise ValueError unless receivers [batch, vertex] and spheres [batch, sphere] fit each other."""
    check.shape("points", points.shape, ("batch", "vertex"))
    if normals is not None:
        check.shape("normals", normals.shape, points.shape)
    check.shape("centers", centers.shape, (points.shape[0], "sphere"))
    check.shape("radii", radii.shape, centers.shape)


@functools.cache
def cone_function(lanes: int) -> wp.Function:
    """Make the kernel function of a group of receivers: the offset to a sphere's center and its radius → its cone.

    It returns lanes of: the direction's x, y, z; cos θ; sin²θ (accurate for tiny spheres, where 1 − cos²θ is not);
    the weight in [0, 1] that fades the sphere out near its center.
    """
    Lane = lane_type(lanes)
    sqrt = lane_functions(lanes).sqrt
    SINE2 = wp.constant(float(_SINE2))
    COSINE = wp.constant(float(_COSINE))
    RISE = wp.constant(float(_RISE))

    @wp.func
    def cone(dx: Lane, dy: Lane, dz: Lane, radius: float):
        distance2 = wp.cw_mul(dx, dx) + wp.cw_mul(dy, dy) + wp.cw_mul(dz, dz)
        distance2 = wp.max(distance2, Lane(1.0e-37))  # a receiver at the center: direction 0, weight 0
        distance = sqrt(distance2)
        inverse = wp.cw_div(Lane(1.0), distance)
        sine2 = wp.min(wp.cw_mul(radius * inverse, radius * inverse), Lane(SINE2))
        # What the blend's cubic lacks of _COSINE is exactly 0 from 1.01 r on, where u is: sums need no cases, and
        # sine2 keeps its digits even where a compiler fuses multiplication and addition.
        t = wp.min(wp.max((distance / radius - Lane(1.0)) / BLEND, Lane(0.0)), Lane(1.0))
        u = Lane(1.0) - t
        lack = wp.cw_mul(u, Lane(3.0 * COSINE - 2.0 * RISE) + (RISE - 2.0 * COSINE) * u)
        lack = wp.cw_mul(u, Lane(RISE) + lack)
        cosine = sqrt(Lane(1.0) - sine2) - lack
        sine2 = sine2 + wp.cw_mul(lack, Lane(2.0 * COSINE) - lack)
        near = wp.min(distance / (FADE * radius), Lane(1.0))
        weight = wp.cw_mul(wp.cw_mul(near, near), Lane(3.0) - 2.0 * near)
        return wp.cw_mul(dx, inverse), wp.cw_mul(dy, inverse), wp.cw_mul(dz, inverse), cosine, sine2, weight

    return cone


@functools.cache
def cone_adjoint(lanes: int) -> wp.Function:
    """Make the adjoint of :func:`cone_function`: offsets, radius, adjoints of the results → adjoints of the arguments.

    Cosine, sin²θ and weight depend on X = D/r alone, and sin²θ = 1 − cos²θ, so with c' = dc/dX

        X̄ = (c̄ − 2c s̄²) c' + w̄ w',   r̄ = −X̄ X / r,   d̄ = (ū − u (u·ū)) / D + u X̄ / r
        c' = X⁻³ / c beyond 1.01 r, else the slope of the blend's cubic
    """
    Lane = lane_type(lanes)
    sqrt = lane_functions(lanes).sqrt
    cone = cone_function(lanes)
    SINE2 = wp.constant(float(_SINE2))
    COSINE = wp.constant(float(_COSINE))
    RISE = wp.constant(float(_RISE))

    @wp.func
    def adjoint(
        dx: Lane,
        dy: Lane,
        dz: Lane,
        radius: float,
        adj_ux: Lane,
        adj_uy: Lane,
        adj_uz: Lane,
        adj_cosine: Lane,
        adj_sine2: Lane,
        adj_weight: Lane,
    ):
        ux, uy, uz, cosine, _sine2, _weight = cone(dx, dy, dz, radius)
        distance = sqrt(wp.max(wp.cw_mul(dx, dx) + wp.cw_mul(dy, dy) + wp.cw_mul(dz, dz), Lane(1.0e-37)))
        inverse = wp.cw_div(Lane(1.0), distance)
        far = distance / radius
        ratio2 = wp.min(wp.cw_mul(radius * inverse, radius * inverse), Lane(SINE2))
        beyond = wp.cw_div(wp.cw_mul(ratio2, sqrt(ratio2)), sqrt(Lane(1.0) - ratio2))
        u = Lane(1.0) - wp.min(wp.max((far - Lane(1.0)) / BLEND, Lane(0.0)), Lane(1.0))
        within = Lane(RISE) + wp.cw_mul(u, Lane(6.0 * COSINE - 4.0 * RISE) + (3.0 * RISE - 6.0 * COSINE) * u)
        is_within = wp.min(wp.max((Lane(1.0 + BLEND) - far) * 1.0e20, Lane(0.0)), Lane(1.0))
        cosine_slope = beyond + wp.cw_mul(is_within, within / BLEND - beyond)
        near = wp.min(far / FADE, Lane(1.0))
        weight_slope = (6.0 / FADE) * wp.cw_mul(near, Lane(1.0) - near)

        adj_far = wp.cw_mul(adj_cosine - 2.0 * wp.cw_mul(cosine, adj_sine2), cosine_slope)
        adj_far += wp.cw_mul(adj_weight, weight_slope)
        adj_distance = adj_far / radius
        along = wp.cw_mul(ux, adj_ux) + wp.cw_mul(uy, adj_uy) + wp.cw_mul(uz, adj_uz)
        radial = adj_distance - wp.cw_mul(along, inverse)
        adj_dx = wp.cw_mul(adj_ux, inverse) + wp.cw_mul(ux, radial)
        adj_dy = wp.cw_mul(adj_uy, inverse) + wp.cw_mul(uy, radial)
        adj_dz = wp.cw_mul(adj_uz, inverse) + wp.cw_mul(uz, radial)
        return adj_dx, adj_dy, adj_dz, -wp.cw_mul(adj_distance, far)

    return adjoint
