"""Footprints: the areas for which receivers at samples stand, a pixel of their plane or a sample of it.

An edge of a shadow that is narrower than a footprint is seen at few receivers, and its motion by none between. So edges
are wide enough that each receiver has about the mean over its footprint (:mod:`.visibility.directional`).
"""

from typing import NamedTuple

import warp as wp

from warpshadow.stages.raster.screen import volume_rates


class FootprintInputs(NamedTuple):
    """Inputs by which footprints are found, beside the fragments that are seen; none where receivers are points."""

    clip_positions: wp.array | None = None  # vertices in clip space, vec4 of shape [batch, vertex]
    widths: wp.array | None = None  # of footprints on each face [pixels], 0 for points, float32 of shape [face]
    pixel: wp.vec2 = wp.vec2()  # its size in clip space


@wp.func
def find_pixel_area(
    positions: wp.array(dtype=wp.vec3),
    clip_positions: wp.array(dtype=wp.vec4),
    corners: wp.vec3i,
    weights: wp.vec3,
    pixel: wp.vec2,
):
    """Area of a pixel at a point of a face, as a vector along the face's normal or against it [scene units²]."""
    a = clip_positions[corners[0]]
    b = clip_positions[corners[1]]
    c = clip_positions[corners[2]]
    point = weights[0] * a + weights[1] * b + weights[2] * c
    rates_x, rates_y = volume_rates(a, b, c, wp.vec2(point[0] / point[3], point[1] / point[3]), pixel)
    origin = positions[corners[0]]
    along_b = positions[corners[1]] - origin
    along_c = positions[corners[2]] - origin
    by_x = rates_x - (rates_x[0] + rates_x[1] + rates_x[2]) * weights
    by_y = rates_y - (rates_y[0] + rates_y[1] + rates_y[2]) * weights
    return wp.cross(by_x[1] * along_b + by_x[2] * along_c, by_y[1] * along_b + by_y[2] * along_c)


@wp.func_grad(find_pixel_area)
def _find_pixel_area_adjoint(
    positions: wp.array(dtype=wp.vec3),
    clip_positions: wp.array(dtype=wp.vec4),
    corners: wp.vec3i,
    weights: wp.vec3,
    pixel: wp.vec2,
    adj_area: wp.vec3,
):
    return
