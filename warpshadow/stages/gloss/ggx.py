"""GGX: how a surface that is made of tiny mirrors reflects light, but for Fresnel's factor.

With a normal n, a viewer v, light from l and the mirror h between them, n·v = μ and n·l = c, a surface of width
α = roughness² reflects f = D V. Mirrors hide each other as Smith says, correlated by height [glTF 2.0, appendix B]:

    D = α² / (π ((n·h)² (α² − 1) + 1)²),  V = ½ / (c Λ(μ) + μ Λ(c)),  Λ(x) = √(x² (1 − α²) + α²).

With other widths along two axes, W, it is Λ(v) = √((n·v)² + |W v_t|²), v_t across the normal (:mod:`.lobes`).
Schlick's (1 − v·h)⁵ weighs the light of a surface that reflects all at grazing angles.
"""

import functools
from typing import Any, NamedTuple

import warp as wp

from warpshadow.device.lanes import lane_type, make_lane_functions

wp.set_module_options({"max_unroll": 1})


@wp.func
def fresnel_weight(cosine: float):
    """Schlick's (1 − v·h)⁵."""
    base = wp.max(1.0 - cosine, 0.0)
    return base * base * base * base * base


@wp.func
def smith_lambda(width: wp.vec3, x: float, y: float, z: float):
    """Λ of a vector, z along the normal; width is W: xx, xy, yy."""
    return wp.length(wp.vec3(width[0] * x + width[1] * y, width[1] * x + width[2] * y, z))


@wp.func
def masking(cosine: float, lambda_of_light: float, view_cosine: float, lambda_of_view: float):
    """V, of cosines and Λ of the light and of the viewer."""
    return 0.5 / (cosine * lambda_of_view + view_cosine * lambda_of_light)


@wp.func
def specular_brdf(normal_cosine: float, cosine: float, view_cosine: float, square: float):
    """D V of mirrors of the width √square, given n·h, n·l and n·v."""
    ellipsoid = normal_cosine * normal_cosine * (square - 1.0) + 1.0
    density = square / (wp.pi * ellipsoid * ellipsoid)
    lambda_of_light = wp.sqrt(cosine * cosine * (1.0 - square) + square)
    lambda_of_view = wp.sqrt(view_cosine * view_cosine * (1.0 - square) + square)
    return density * masking(cosine, lambda_of_light, view_cosine, lambda_of_view)


class LaneGgx(NamedTuple):
    """Functions of GGX for as many directions at once as there are lanes."""

    stretch: Any  # W (x, y)
    smith_lambda: Any  # of a stretched vector
    fresnel_weight: Any
    fresnel_rate: Any  # the derivative of fresnel_weight


@functools.cache
def make_ggx(lanes: int) -> LaneGgx:
    """Make the functions for a number of lanes."""
    Lane, sqrt = lane_type(lanes), make_lane_functions(lanes).sqrt

    @wp.func(inline=True)
    def stretch(width: wp.vec3, x: Lane, y: Lane):
        return width[0] * x + width[1] * y, width[1] * x + width[2] * y

    @wp.func(inline=True)
    def smith_lambda(x: Lane, y: Lane, z: Lane):
        return sqrt(wp.cw_mul(x, x) + wp.cw_mul(y, y) + wp.cw_mul(z, z))

    @wp.func(inline=True)
    def fresnel_weight(cosine: Lane):
        base = wp.max(Lane(1.0) - cosine, Lane(0.0))
        square = wp.cw_mul(base, base)
        return wp.cw_mul(wp.cw_mul(square, square), base)

    @wp.func(inline=True)
    def fresnel_rate(cosine: Lane):
        base = wp.max(Lane(1.0) - cosine, Lane(0.0))
        square = wp.cw_mul(base, base)
        return -5.0 * wp.cw_mul(square, square)

    return LaneGgx(stretch, smith_lambda, fresnel_weight, fresnel_rate)
