"""Areas: how much of a sample lies beyond the lines around it, and how that changes with the vertices.

A line crosses the direction to a neighbor at distance t, and leans by m samples a sample (at most 1). Of the sample
lies beyond it

    e = ½ − t                     t ≤ (1 − m)/2
        ((1 + m)/2 − t)² / 2m     between
        0                         t ≥ (1 + m)/2

The line of an edge with ends a, b is ℓ = a × b, and that where two faces intersect ℓ = n − n′, the difference of their
planes.

**Edges.** If the outline of a surface moves by v(s), an integral of g over it changes by ∮ g (v_x dy − v_y dx). So an
edge counts, in each row that it crosses, by the motion of its point along the row, in each column by that along the
column, with 1 in place of ω:

    dx = α da_x + β db_x, on screen         α, β: the point on the edge is α a + β b in clip space, scaled to w = 1

Between two neighbors of which one sees the surface there is an odd number of edges, and the image changes by Σ ± dx,
with alternating signs. One of them is found. The others come in pairs, an entry and an exit within a sample: where a
body moves as a whole, both have the same dx along the row, and cancel. (By the edge's normal they would not: along a
border with teeth of a sample gradients had the wrong sign.)

**Intersections** have no points that move with the line, so they count by its normal, with ω:

    dx = Σ_i (λ_i u n·dv_i − λ′_i u′ n′·dv′_i) / ℓ_x        λ: barycentrics of the fragments, u: its 1/w

The change of m is left out: it hardly matters to the exchange between two samples (1e-4 of the gradient by a rigid
motion), and at edges far below a sample it would outweigh the rest, pulling their ends opposite ways.
"""

import warp as wp

from warpshadow.stages.raster.screen import (
    direction_sign,
    face_plane,
    half_size,
    line_distance,
    line_slope,
    neighbor,
    relative_to_ray_adjoint,
    sample_center,
)
from warpshadow.stages.silhouettes.lines import (
    NOTHING,
    FragmentArrays,
    edge_position_adjoint,
    image_index,
    line_between,
)

wp.set_module_options({"max_unroll": 1})  # loops that are not unrolled compile faster, and run as fast


@wp.struct
class LineArea:
    """The area that lies beyond a line; all are 0 where there is no line."""

    area: float  # e, of the sample
    weight: float  # ω, of the line
    is_surface_end: float  # 1 where a surface ends at the line, 0 where it has a crease


@wp.func
def _area_beyond(distance: float, slope: float):
    """Area e beyond a line, given t and m."""
    area = float(0.0)
    if distance <= 0.5 * (1.0 - slope):
        area = 0.5 - distance
    elif distance < 0.5 * (1.0 + slope):
        overlap = 0.5 * (1.0 + slope) - distance
        area = 0.5 * overlap * overlap / slope
    return area


@wp.func
def measure_area(fragments: FragmentArrays, sample: int, direction: int, edge: wp.vec2i, neighbor_edge: wp.vec2i):
    """The area beyond the line in a direction. At a crease the neighbor has the edge of another face."""
    line_area = LineArea()
    if edge[0] != NOTHING:
        samples_per_unit = half_size(fragments.width, fragments.height)
        line = line_between(fragments, sample, direction, edge)
        distance = wp.clamp(line_distance(line, direction, samples_per_unit), 0.0, 1.0)
        slope = line_slope(line, direction, samples_per_unit)
        area = _area_beyond(distance, wp.min(slope, 1.0))
        if wp.isfinite(line / line[direction // 2]):  # else vertices are so far away that products overflow
            is_surface_end = edge[0] == neighbor_edge[0] and edge[1] == neighbor_edge[1]
            line_area.area = area
            line_area.weight = 1.0 / (1.0 + slope * slope * slope * slope)
            line_area.is_surface_end = wp.where(is_surface_end, 1.0, 0.0)
    return line_area


@wp.func
def measure_area_adjoint(
    fragments: FragmentArrays,
    sample: int,
    direction: int,
    edge: wp.vec2i,
    adj_area: float,
    adj_clip_positions: wp.array2d(dtype=wp.vec4),
):
    """The adjoint of `measure_area` by the area: it adds to the gradients of the line's vertices."""
    axis = direction // 2
    batch = image_index(fragments, sample)
    clip = fragments.clip_positions[batch]
    samples_per_unit = half_size(fragments.width, fragments.height)
    center = sample_center(sample, fragments.width, fragments.height)
    line = line_between(fragments, sample, direction, edge)
    distance = wp.clamp(line_distance(line, direction, samples_per_unit), 0.0, 1.0)
    area_slope, _ = wp.grad(_area_beyond)(distance, wp.min(line_slope(line, direction, samples_per_unit), 1.0))
    # of the line's x in a row, or its y in a column
    adj_position = direction_sign(direction) * adj_area * area_slope * samples_per_unit[axis]
    if edge[0] >= 0:
        adj_a, adj_b = edge_position_adjoint(edge, center, axis, adj_position, clip)
        wp.atomic_add(adj_clip_positions, batch, edge[0], adj_a)
        wp.atomic_add(adj_clip_positions, batch, edge[1], adj_b)
    else:
        for end in range(2):
            fragment = sample
            sign = float(1.0)
            if end == 1:
                fragment = neighbor(sample, direction, fragments.width)
                sign = -1.0
            corners = fragments.faces[fragments.face_ids[fragment]]
            ray = sample_center(fragment, fragments.width, fragments.height)
            normal = face_plane(corners, ray, clip)
            adj_clip = sign * adj_position * (normal[2] / line[axis]) * relative_to_ray_adjoint(ray, normal)
            for k in range(3):
                wp.atomic_add(adj_clip_positions, batch, corners[k], fragments.barycentrics[fragment][k] * adj_clip)
