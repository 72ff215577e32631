"""Culling: the directions that spheres can darken for a block of receivers, found for a bundle of four at once.

Spheres that are below the horizon of all receivers of a block, or too far from a bundle's cone, block nothing there.
Nothing is lost by leaving them out. Order in memory does not change results, but how much is left out: neighbors had
best be near each other, spheres as well as receivers (:mod:`warpshadow.maths.spatial_sort`).
"""

import functools
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from warpshadow.device.constants import cached_by_values, constant
from warpshadow.device.lanes import lane_type, make_lane_functions, vectors_type
from warpshadow.maths.directions import bundle_cones, check_directions, falloff_width
from warpshadow.stages.visibility.cones import BLEND
from warpshadow.stages.visibility.traversal import ALL_BUNDLES, receiver_lanes_type

BOUND_MARGIN = 1.001 + BLEND
"""Bounds are so much larger: cones of receivers as near as BLEND are wider than the sphere, and there is rounding."""


FOOTPRINT_SHARE = wp.constant(5.0 / 12.0)
"""W² / f²: a smoothstep from −W to W has the variance W²/5, a mean over a square of side f has f²/12."""


@wp.struct
class DirectionCells:
    """Cells of directions and the cones around bundles of them, as kernels see them."""

    directions: wp.array(dtype=wp.vec3)
    axes: wp.array(dtype=wp.vec3)
    half_angles: wp.array(dtype=wp.vec2)  # cosine and sine
    cos_width: float
    sin_width: float


@cached_by_values
def make_cells(
    directions: np.ndarray, softness: float, device: wp.Device, has_footprints: bool = False
) -> DirectionCells:
    """Make cells with the cones around their bundles, and the width w of the falloff.

    Footprints add up to ½ to sin²w: widths of 30° become 60°, those of 45° 90°.

    Raises:
        ValueError: for directions for which there are no cells, and for too soft a falloff.
    """
    check_directions(directions)
    width = falloff_width(softness, len(directions))
    max_width = np.arcsin(min(np.sqrt(np.sin(width) ** 2 + 0.5), 1.0)) if has_footprints else width
    axes, cosine, sine = bundle_cones(directions, max_width)
    cells = DirectionCells()
    cells.directions = constant(directions, wp.vec3, device)
    cells.axes = constant(axes, wp.vec3, device)
    cells.half_angles = constant(np.stack([cosine, sine], axis=-1), wp.vec2, device)
    cells.cos_width, cells.sin_width = float(np.cos(width)), float(np.sin(width))
    return cells


@functools.cache
def cap_type(lanes: int) -> Any:
    """Struct of the caps of directions that a sphere blocks in part, one for each receiver of a block."""
    Lane, Vectors = lane_type(lanes), vectors_type(lanes)

    @wp.struct
    class Cap:
        axis: Vectors
        cosine: Lane  # of the half-angle θ + w
        sine: Lane
        cos_width: Lane  # of w
        sin_width: Lane

    return Cap


class CapFunctions(NamedTuple):
    """Kernel functions on caps."""

    widen_cone: wp.Function  # cones by w: axis, cosine and sine of θ, d², receivers, cells → caps
    spread: wp.Function  # what footprints f² add to sin²w: W² / (d² + 2 W²), W² = f² 5/12; of d², receivers
    reaches_bundle: wp.Function  # whether a cap reaches a bundle for any receiver
    is_above_horizon: wp.Function  # whether a cap rises above the horizon of any receiver
    soft_edge: wp.Function  # direction, cap, 1/(hi−lo) → t in the falloff, and its smoothstep


@functools.cache
def make_cap_functions(has_horizon: bool, lanes: int, has_footprints: bool = False) -> CapFunctions:
    """Make the kernel functions for a number of lanes."""
    Lane, Vectors, Cap = lane_type(lanes), vectors_type(lanes), cap_type(lanes)
    ReceiverLanes = receiver_lanes_type(lanes)
    fn = make_lane_functions(lanes)
    sqrt, is_any_above, dot, dot_direction, smoothstep = (
        fn.sqrt,
        fn.is_any_above,
        fn.dot,
        fn.dot_direction,
        fn.smoothstep,
    )

    @wp.func(inline=True)
    def spread(squared_distance: Lane, receivers: ReceiverLanes):
        squared_width = FOOTPRINT_SHARE * receivers.footprints
        return wp.cw_div(squared_width, wp.max(squared_distance + 2.0 * squared_width, Lane(1.0e-37)))

    @wp.func(inline=True)
    def widen_cone(
        axis: Vectors, cosine: Lane, sine: Lane, squared_distance: Lane, receivers: ReceiverLanes, cells: DirectionCells
    ):
        cos_width = Lane(cells.cos_width)
        sin_width = Lane(cells.sin_width)
        if wp.static(has_footprints):
            squared_sine = Lane(cells.sin_width * cells.sin_width) + spread(squared_distance, receivers)
            sin_width = sqrt(squared_sine)
            cos_width = sqrt(Lane(1.0) - squared_sine)
        cap_cosine = wp.cw_mul(cos_width, cosine) - wp.cw_mul(sin_width, sine)
        cap_sine = wp.cw_mul(sin_width, cosine) + wp.cw_mul(cos_width, sine)
        return Cap(axis, cap_cosine, cap_sine, cos_width, sin_width)

    @wp.func(inline=True)
    def reaches_bundle(cap: Cap, axis: wp.vec3, half_angle: wp.vec2):
        # u·axis > cos(θ + w + the bundle's half-angle)
        min_cosine = half_angle[0] * cap.cosine - half_angle[1] * cap.sine
        return is_any_above(dot_direction(axis, cap.axis) - min_cosine, 0.0)

    @wp.func(inline=True)
    def is_above_horizon(cap: Cap, normals: Vectors):
        is_above = bool(True)
        if wp.static(has_horizon):
            # u·n > cos(90° + θ + w), which a cap wider than 90° does anyway
            wide_cap_offset = 1.0e9 * wp.max(Lane(0.0) - cap.cosine, Lane(0.0))
            is_above = is_any_above(dot(cap.axis, normals) + cap.sine + wide_cap_offset, 0.0)
        return is_above

    @wp.func(inline=True)
    def soft_edge(direction: wp.vec3, cap: Cap, slope: Lane):
        t = wp.cw_mul(dot_direction(direction, cap.axis) - cap.cosine, slope)
        t = wp.min(wp.max(t, Lane(0.0)), Lane(1.0))
        return t, smoothstep(t)

    return CapFunctions(widen_cone, spread, reaches_bundle, is_above_horizon, soft_edge)


@functools.cache
def make_is_bundle_above(has_horizon: bool, lanes: int) -> wp.Function:
    """Make the kernel function that tells whether a bundle of directions rises above the horizon of any receiver."""
    Vectors, fn = vectors_type(lanes), make_lane_functions(lanes)
    is_any_above, dot_direction = fn.is_any_above, fn.dot_direction

    @wp.func(inline=True)
    def is_bundle_above(cells: DirectionCells, bundle: int, normals: Vectors):
        is_above = bool(True)
        if wp.static(has_horizon):
            is_above = is_any_above(dot_direction(cells.axes[bundle], normals), -cells.half_angles[bundle][1])
        return is_above

    return is_bundle_above


@functools.cache
def make_cull(has_horizon: bool, Task: type, lanes: int, has_footprints: bool = False) -> wp.Function:
    """Make the kernel function that lists the bundles of directions that spheres can reach, for the traversal.

    Args:
        has_horizon: Whether receivers have normals.
        Task: Struct that has

            - ``cells`` and ``first_bundle``: the thread's bundles begin there;
            - ``opaque_from`` [bundle], int32: the traversal index from which on no sphere matters to a bundle;
            - ``reached_bundles`` [2, bundle], int32: bundles that a run, and then a cluster, may reach, where they are
              listed.

        lanes: Receivers of a block.
    """
    Lane, ReceiverLanes = lane_type(lanes), receiver_lanes_type(lanes)
    fn = make_lane_functions(lanes)
    sqrt, is_any_above, dot, offset, scale = fn.sqrt, fn.is_any_above, fn.dot, fn.offset, fn.scale
    widen_cone, _, reaches_bundle, is_above_horizon, _ = make_cap_functions(has_horizon, lanes, has_footprints)

    @wp.func
    def cull(receivers: ReceiverLanes, bound: wp.vec4, traversal_index: int, candidates: int, task: Task):
        """Store the candidates that a bound may reach; return their number, 0 for a bound below the horizon."""
        count = int(0)
        cells = task.cells
        if bound[3] > 0.0:
            bound_radius = BOUND_MARGIN * bound[3]
            bound_offset = offset(wp.vec3(bound[0], bound[1], bound[2]), receivers.points)
            distance = sqrt(dot(bound_offset, bound_offset))
            is_within = is_any_above(-distance, -bound_radius)
            inverse = wp.cw_div(Lane(1.0), wp.max(distance, Lane(bound_radius)))
            sine = bound_radius * inverse
            cosine = sqrt(Lane(1.0) - wp.cw_mul(sine, sine))
            gap = wp.max(distance - Lane(bound_radius), Lane(0.0))  # no edge of a shadow is nearer
            cap = widen_cone(scale(inverse, bound_offset), cosine, sine, wp.cw_mul(gap, gap), receivers, cells)
            if is_within or is_above_horizon(cap, receivers.normals):
                candidate_count = candidates
                if candidates == ALL_BUNDLES:
                    candidate_count = task.opaque_from.shape[0]
                for k in range(candidate_count):
                    bundle = k
                    if candidates != ALL_BUNDLES:
                        bundle = task.reached_bundles[0, k]
                    direction_bundle = task.first_bundle + bundle
                    is_candidate = task.opaque_from[bundle] > traversal_index
                    if is_candidate and (
                        is_within
                        or reaches_bundle(cap, cells.axes[direction_bundle], cells.half_angles[direction_bundle])
                    ):
                        task.reached_bundles[wp.where(candidates == ALL_BUNDLES, 0, 1), count] = bundle
                        count += 1
        return count

    return cull
