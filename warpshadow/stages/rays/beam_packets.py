"""Beams to the shell for packets of rays, as :mod:`warpshadow.stages.shell.shell_rays` has them for one."""

import functools

import warp as wp

from warpshadow.device.lanes import lane_type, make_lane_functions, vectors_type
from warpshadow.stages.rays.ray_packets import PACKET
from warpshadow.stages.shell.shell_rays import MIN_DISTANCE, center_of

_MIN_DISTANCE2 = MIN_DISTANCE**2


@functools.cache
def make_beams(is_near: bool) -> tuple[wp.Function, wp.Function]:
    """Make the functions of the rays of a packet towards light, infinitely far away or from a shell.

    Given the shell, the receiver and the directions of the light, the first finds the rays, of any length; the second,
    given the normal in place of the point, and the rays, their cosines, times the factor of
    :mod:`warpshadow.stages.shell.shell_rays`.
    """
    Lane, Vectors, fn = lane_type(PACKET), vectors_type(PACKET), make_lane_functions(PACKET)
    add, dot, dot_direction, scale = fn.add, fn.dot, fn.dot_direction, fn.scale
    if not is_near:

        @wp.func(inline=True)
        def far_beams(shell: wp.vec4, point: wp.vec3, light_directions: Vectors):
            return light_directions

        @wp.func(inline=True)
        def far_cosines(shell: wp.vec4, normal: wp.vec3, light_directions: Vectors, beams: Vectors):
            return dot_direction(normal, light_directions)

        return far_beams, far_cosines

    @wp.func(inline=True)
    def near_beams(shell: wp.vec4, point: wp.vec3, light_directions: Vectors):
        offset = center_of(shell) - point
        return add(scale(Lane(shell[3]), light_directions), Vectors(Lane(offset[0]), Lane(offset[1]), Lane(offset[2])))

    @wp.func(inline=True)
    def near_cosines(shell: wp.vec4, normal: wp.vec3, light_directions: Vectors, beams: Vectors):
        distance2 = wp.max(dot(beams, beams), Lane(_MIN_DISTANCE2 * shell[3] * shell[3]))
        facing = wp.max(dot(light_directions, beams), Lane(0.0))
        square = wp.cw_mul(distance2, distance2)
        return wp.cw_div(shell[3] * shell[3] * wp.cw_mul(facing, dot_direction(normal, beams)), square)

    return near_beams, near_cosines
