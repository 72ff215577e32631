"""Where a convex part may block light of a block of receivers: within the cone around it, above their horizons."""

import functools
from typing import Any, NamedTuple

import warp as wp

from warpshadow.device.lanes import lane_type, make_lane_functions, vectors_type
from warpshadow.device.parallel import ScratchStruct
from warpshadow.stages.convex.convex_blockers import UNSEEN, ConvexArrays
from warpshadow.stages.convex.joint_lanes import coverage_type, sums_type
from warpshadow.stages.convex.silhouette import EDGE_LANES, SUM_LANES, silhouette_type
from warpshadow.stages.receivers.body_spans import ReceiverBlock, ReceiverSpans, SpanValues
from warpshadow.stages.visibility.culling import DirectionCells

_BOUND_MARGIN = 1.001  # bounds are so much larger, for rounding

_ON_SURFACE = 3.0e-4
"""Height above a face up to which a receiver lies on it, over the radius of the part: faces are flat to 1e-4. Where the
part is a chord of a bent surface, its gap is added."""

_ROUNDING = 1.0e-6
"""Height, over the distance of the part from the origin, up to which a receiver lies on a face: float32 rounds so."""


@wp.struct
class PartInputs:
    """Receivers, and the parts around them."""

    points: wp.array2d(dtype=wp.vec3)
    horizon_normals: wp.array2d(dtype=wp.vec3)  # none where there is no horizon
    corners: wp.array2d(dtype=wp.vec3)
    face_planes: wp.array2d(dtype=wp.vec4)
    bounds: wp.array2d(dtype=wp.vec4)
    parts: ConvexArrays
    cells: DirectionCells
    radius: float  # of cells
    spans: ReceiverSpans
    self_bodies: SpanValues  # number of its body among the blockers, −1 for none
    on_surface: bool  # whether receivers lie on the parts, which then are those of one body


@functools.cache
def scratch_type(lanes: int) -> Any:
    """Struct of scratch memory, a row for each block of receivers: as in the fields of the same names of its task."""
    Lane, Coverages, SumsOfBlockers = lane_type(lanes), coverage_type(lanes), sums_type(lanes)

    @wp.struct
    class PartsScratch:
        coverage: wp.array2d(dtype=Coverages)
        hull_weight: wp.array2d(dtype=Lane)
        covered: wp.array2d(dtype=wp.int32)
        sums: wp.array2d(dtype=SumsOfBlockers)
        facing: wp.array2d(dtype=wp.int32)
        numbers: wp.array2d(dtype=wp.int32)
        edges: wp.array2d(dtype=Lane)
        chord_sums: wp.array2d(dtype=Lane)

    return PartsScratch


def parts_scratch(lanes: int, cell_count: int, edge_count: int) -> ScratchStruct:
    """Scratch memory for cells, and for parts of up to so many edges."""
    shapes = dict.fromkeys(("coverage", "hull_weight", "covered", "sums"), (cell_count,))
    shapes |= {"facing": (edge_count,), "numbers": (edge_count,)}
    shapes |= {"edges": (EDGE_LANES * edge_count,), "chord_sums": (SUM_LANES,)}
    return ScratchStruct(scratch_type(lanes), shapes)


@functools.cache
def task_type(lanes: int) -> Any:
    """Struct of a block of receivers, and memory for its cells."""
    Lane, Vectors, Silhouette = lane_type(lanes), vectors_type(lanes), silhouette_type(lanes)
    Coverages, SumsOfBlockers = coverage_type(lanes), sums_type(lanes)

    @wp.struct
    class PartsTask:
        block: ReceiverBlock
        self_body: int  # the body that the receivers are part of, −1 for none
        slot: int  # of scratch memory
        instance: int  # of the parts
        bounds: wp.array(dtype=wp.vec4)  # [part]
        points: Vectors
        normals: Vectors
        lift: Lane  # 1 where there is no horizon, else 0
        coverage: wp.array(dtype=Coverages)  # [direction] by a compound, 0 between compounds
        hull_weight: wp.array(dtype=Lane)  # [direction] 1 where its hull covers, else 0; not set without one
        covered: wp.array(dtype=wp.int32)  # numbers of the cells in which that is not 0
        sums: wp.array(dtype=SumsOfBlockers)  # [direction] over compounds
        silhouette: Silhouette

    return PartsTask


@functools.cache
def _bound_type(lanes: int) -> Any:
    """Struct of the cones around a part, as a block of receivers sees it."""
    Lane, Vectors = lane_type(lanes), vectors_type(lanes)

    @wp.struct
    class PartBound:
        rise: Lane  # above 0 where some of it is above the horizon of a receiver
        axis: Vectors
        cosine: Lane  # of its half-angle and that of a cell together, and sine; below −1 within the bound
        sine: Lane

    return PartBound


class BoundFunctions(NamedTuple):
    """Kernel functions on the bounds of parts."""

    find_bound: wp.Function
    reaches_bundle: wp.Function
    find_reach: wp.Function


@functools.cache
def make_bound_functions(lanes: int) -> BoundFunctions:
    """Make the kernel functions for a number of lanes."""
    Lane, PartsTask, PartBound = lane_type(lanes), task_type(lanes), _bound_type(lanes)
    fn = make_lane_functions(lanes)
    is_any_above, dot, dot_direction, offset, scale = fn.is_any_above, fn.dot, fn.dot_direction, fn.offset, fn.scale
    sqrt, is_positive = fn.sqrt, fn.is_positive
    MARGIN, ON_SURFACE, ROUNDING = wp.constant(_BOUND_MARGIN), wp.constant(_ON_SURFACE), wp.constant(_ROUNDING)

    @wp.func(inline=True)
    def find_cones(task: PartsTask, bound: wp.vec4, radius: float):
        """Find the cones around a part, widened by the radius of cells."""
        result = PartBound()
        away = offset(wp.vec3(bound[0], bound[1], bound[2]), task.points)
        distance2 = dot(away, away)
        reach = MARGIN * bound[3]
        inverse = wp.cw_div(Lane(1.0), sqrt(wp.max(distance2, Lane(wp.max(reach * reach, 1.0e-37)))))
        sine = reach * inverse
        cosine = sqrt(wp.max(Lane(1.0) - wp.cw_mul(sine, sine), Lane(0.0)))
        is_within = is_positive(Lane(bound[3] * bound[3]) - distance2)
        shrink = 1.0 / wp.sqrt(1.0 + radius * radius)
        result.rise = dot(task.normals, away) + Lane(bound[3]) + 1.0e30 * task.lift
        result.axis = scale(inverse, away)
        result.cosine = shrink * (cosine - radius * sine) - 4.0 * is_within
        result.sine = shrink * (sine + radius * cosine)
        return result

    @wp.func(inline=True)
    def find_margin(parts: ConvexArrays, part: int, bound: wp.vec4):
        """Height above a face up to which a receiver lies on it."""
        return (ON_SURFACE + parts.gaps[part]) * bound[3] + ROUNDING * wp.length(wp.vec3(bound[0], bound[1], bound[2]))

    @wp.func
    def find_rise(parts: ConvexArrays, part: int, task: PartsTask):
        """How far a part rises above tangent planes; not above 0 for receivers that lie on it."""
        bound = task.bounds[part]
        margin = find_margin(parts, part, bound)
        above = Lane(-1.0e30)
        is_on = Lane(0.0)
        for face in range(parts.first_face[part], parts.first_face[part + 1]):
            face_plane = task.silhouette.face_planes[face]
            normal = wp.vec3(face_plane[0], face_plane[1], face_plane[2])
            height = dot_direction(normal, task.points) - Lane(face_plane[3])
            is_near = is_positive(Lane(margin) - wp.max(height, -height))
            above = wp.max(above, height)
            is_on = wp.max(is_on, wp.cw_mul(is_near, is_positive(dot_direction(normal, task.normals))))
        is_on = wp.cw_mul(is_on, is_positive(Lane(margin) - above))
        rise = Lane(0.0)
        for corner in range(parts.first_corner[part], parts.first_corner[part + 1]):
            rise = wp.max(rise, dot(task.normals, offset(task.silhouette.corners[corner], task.points)))
        return wp.cw_mul(rise - Lane(margin), Lane(1.0) - is_on)

    @wp.func
    def find_bound(inputs: PartInputs, part: int, task: PartsTask):
        """Find the cones around a part, and where it may block light."""
        bound = task.bounds[part]
        result = find_cones(task, bound, inputs.radius)
        face = inputs.parts.first_face[part]
        if task.silhouette.face_planes[face + 1][3] == UNSEEN:  # it is one-sided
            plane = task.silhouette.face_planes[face]
            height = dot_direction(wp.vec3(plane[0], plane[1], plane[2]), task.points) - Lane(plane[3])
            result.rise = wp.min(result.rise, height)
        if inputs.on_surface and is_any_above(result.rise, 0.0):
            depth = Lane(2.0 * bound[3] + find_margin(inputs.parts, part, bound)) - result.rise
            if is_any_above(depth, 0.0):  # else it is above tangent planes
                result.rise = wp.min(result.rise, find_rise(inputs.parts, part, task))
        return result

    @wp.func(inline=True)
    def reaches_bundle(bound: PartBound, axis: wp.vec3, half_angle: wp.vec2):
        """Whether the cone around a part reaches the cone of a bundle."""
        # as far as π together, else all does
        cosine = half_angle[0] * bound.cosine - half_angle[1] * bound.sine
        sine = half_angle[0] * bound.sine + half_angle[1] * bound.cosine
        return is_any_above(wp.max(dot_direction(axis, bound.axis) - cosine, Lane(0.0) - sine), 0.0)

    @wp.func(inline=True)
    def find_reach(task: PartsTask, bound: PartBound, direction: wp.vec3):
        """Above 0 where the cone around a part reaches a cell, and both are above the horizon."""
        is_above = wp.min(dot_direction(direction, task.normals) + task.lift, bound.rise)
        return wp.min(dot_direction(direction, bound.axis) - bound.cosine, is_above)

    return BoundFunctions(find_bound, reaches_bundle, find_reach)
