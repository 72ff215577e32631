"""Weights of proxies: how much each counts, of all that a block of receivers sees through a cell.

    w = f s⁴ / (d² + (r/4)²)²

with d the distance to the proxy's center, r its radius, s the radius of the largest run of proxies, so that w does not
depend on the scene's units, and f the factor of its tangent plane (:mod:`.tangent_planes`). With √w for w a white ball
behind a black one sent a tenth of its light past it.

The adjoint, from the product w̄w, with y the offset to the center over s and u = √(w/f):

    ȳ = −4 w̄w u y + …,  r̄ = −w̄w u r / (4 s²) + …

The dots are the terms through f: f′/f = (1 − ε) 6 x (1 − x) / f, with x the argument of the smoothstep in f.
"""

import functools
from typing import NamedTuple

import warp as wp

from warpshadow.device.lanes import lane_type, make_lane_functions, vectors_type

_CORE_RADIUS = 0.25  # radii within which a proxy's weight hardly grows any more

_NEAREST2 = 1.0e-12  # the least d² + (r/4)², in squares of s: so √w is at most 1e12

_HIDDEN_FACING = 1.0e-8  # ε, of receivers below the tangent plane
_TINY = 1.0e-18  # distance that has a derivative


@wp.struct
class WeightInputs:
    """Inputs of the weights of proxies, beside receivers, centers and radii."""

    inverse_size: float  # 1/s
    equations: wp.array(dtype=wp.vec4)  # [proxy] of tangent planes; none where all receivers are above them
    tolerances: wp.array(dtype=wp.vec2)  # [proxy]
    adj_equations: wp.array(dtype=wp.vec4)


class WeightFunctions(NamedTuple):
    """Kernel functions of the weights of a proxy for a block of receivers."""

    weight: wp.Function  # offset to its center, 1/r, number of the proxy, inputs → w
    adjoint: wp.Function  # offset, 1/r, number, w̄ w, inputs → adjoints of offset and r; adds to that of the equation


@functools.cache
def make_weight_functions(lanes: int) -> WeightFunctions:
    """Make the kernel functions for a number of lanes."""
    Lane, Vectors = lane_type(lanes), vectors_type(lanes)
    fn = make_lane_functions(lanes)
    sqrt, dot, dot_direction, total, scale, add = fn.sqrt, fn.dot, fn.dot_direction, fn.total, fn.scale, fn.add
    CORE, CORE2, NEAREST2 = wp.constant(_CORE_RADIUS), wp.constant(_CORE_RADIUS**2), wp.constant(_NEAREST2)
    TINY, HIDDEN = wp.constant(_TINY), wp.constant(_HIDDEN_FACING)

    @wp.func(inline=True)
    def find_nearness(offset: Vectors, curvature: float, inverse_size: float):
        """√(w/f), the root of a proxy's weight w without the factor f of its tangent plane."""
        scaled_offset = scale(Lane(inverse_size), offset)
        core_radius = CORE * inverse_size / curvature
        return wp.cw_div(
            Lane(1.0), wp.max(dot(scaled_offset, scaled_offset) + Lane(core_radius * core_radius), Lane(NEAREST2))
        )

    @wp.func(inline=True)
    def find_height(offset: Vectors, equation: wp.vec4, tolerance: wp.vec2):
        """Heights of receivers above the tangent plane, plus d sin σ."""
        normal = wp.vec3(equation[0], equation[1], equation[2])
        return tolerance[0] * sqrt(dot(offset, offset)) - dot_direction(normal, offset) - Lane(equation[3])

    @wp.func(inline=True)
    def find_facing(offset: Vectors, curvature: float, equation: wp.vec4, tolerance: wp.vec2):
        """The factor f of the tangent plane, after the argument of its smoothstep."""
        x = (tolerance[1] * curvature) * find_height(offset, equation, tolerance)
        x = wp.min(wp.max(x, Lane(0.0)), Lane(1.0))
        return x, Lane(HIDDEN) + (1.0 - HIDDEN) * wp.cw_mul(wp.cw_mul(x, x), Lane(3.0) - 2.0 * x)

    @wp.func(inline=True)
    def weight(offset: Vectors, curvature: float, proxy: int, inputs: WeightInputs):
        nearness = find_nearness(offset, curvature, inputs.inverse_size)
        result = wp.cw_mul(nearness, nearness)
        if inputs.equations:
            _x, facing = find_facing(offset, curvature, inputs.equations[proxy], inputs.tolerances[proxy])
            result = wp.cw_mul(result, facing)
        return result

    @wp.func(inline=True)
    def adjoint(offset: Vectors, curvature: float, proxy: int, relative_adjoint: Lane, inputs: WeightInputs):
        nearness = find_nearness(offset, curvature, inputs.inverse_size)
        adj_nearness = (-4.0 * inputs.inverse_size) * wp.cw_mul(relative_adjoint, nearness)
        adj_offset = scale(adj_nearness, scale(Lane(inputs.inverse_size), offset))
        adj_radius = (CORE2 * inputs.inverse_size / curvature) * adj_nearness
        if inputs.equations:
            equation, tolerance = inputs.equations[proxy], inputs.tolerances[proxy]
            x, facing = find_facing(offset, curvature, equation, tolerance)
            slope = (6.0 * (1.0 - HIDDEN)) * wp.cw_mul(x, Lane(1.0) - x)
            adj_height = (tolerance[1] * curvature) * wp.cw_mul(wp.cw_div(slope, facing), relative_adjoint)
            adj_normal = scale(-adj_height, offset)
            adj_equation = wp.vec4(total(adj_normal.x), total(adj_normal.y), total(adj_normal.z), -total(adj_height))
            if inputs.adj_equations and not adj_equation == wp.vec4():  # noqa: SIM201 (vectors have no !=)
                wp.atomic_add(inputs.adj_equations, proxy, adj_equation)
            distance = wp.max(sqrt(dot(offset, offset)), Lane(TINY))
            adj_offset = add(adj_offset, scale(wp.cw_div(tolerance[0] * adj_height, distance), offset))
            adj_offset = add(
                adj_offset, Vectors(-equation[0] * adj_height, -equation[1] * adj_height, -equation[2] * adj_height)
            )
            adj_radius -= curvature * wp.cw_mul(adj_height, find_height(offset, equation, tolerance))
        return adj_offset, adj_radius

    return WeightFunctions(weight, adjoint)
