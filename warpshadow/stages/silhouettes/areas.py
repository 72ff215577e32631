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

Between two neighbors of which one sees the surface there is an odd number of edges. One of them is found; the others
cancel in pairs, since they move alike. (By the edge's normal they would not: along a border with teeth of a sample
gradients had the wrong sign.)

**Intersections** have no points that move with the line, so they count by its normal, with ω:

    dx = Σ_i (λ_i u n·dv_i − λ′_i u′ n′·dv′_i) / ℓ_x        λ: barycentrics of the fragments, u: its 1/w

The change of m is left out: it hardly matters to the exchange between two samples (1e-4 of the gradient by a rigid
motion), and at edges far below a sample it would outweigh the rest, pulling their ends opposite ways.
"""

import warp as wp

from warpshadow.device.launch import launch
from warpshadow.device.memory import empty
from warpshadow.stages.raster.screen import (
    direction_sign,
    face_plane,
    half_size,
    line_distance,
    line_slope,
    neighbor,
    opposite,
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


@wp.func
def _area_beyond(distance: float, slope: float):
    """The area e, given t and m."""
    area = float(0.0)
    if distance <= 0.5 * (1.0 - slope):
        area = 0.5 - distance
    elif distance < 0.5 * (1.0 + slope):
        overlap = 0.5 * (1.0 + slope) - distance
        area = 0.5 * overlap * overlap / slope
    return area


@wp.kernel(enable_backward=False)
def _measure_areas(
    # in
    samples: wp.array(dtype=wp.int32),
    edges: wp.array2d(dtype=wp.vec2i),
    entries: wp.array(dtype=wp.int32),
    fragments: FragmentArrays,
    # out
    shares: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a direction of an entry: area e beyond the line there, its weight ω, and the kind of its end."""
    entry, direction = wp.tid()
    edge = edges[entry, direction]
    area_and_weight = wp.vec3()
    if edge[0] != NOTHING:
        samples_per_unit = half_size(fragments.width, fragments.height)
        line = line_between(fragments, samples[entry], direction, edge)
        distance = wp.clamp(line_distance(line, direction, samples_per_unit), 0.0, 1.0)
        slope = line_slope(line, direction, samples_per_unit)
        area = _area_beyond(distance, wp.min(slope, 1.0))
        if wp.isfinite(line / line[direction / 2]):  # else vertices are so far away that products overflow
            neighbor_edge = edges[entries[neighbor(samples[entry], direction, fragments.width)], opposite(direction)]
            is_surface_end = edge[0] == neighbor_edge[0] and edge[1] == neighbor_edge[1]
            line_weight = 1.0 / (1.0 + slope * slope * slope * slope)
            area_and_weight = wp.vec3(area, line_weight, wp.where(is_surface_end, 1.0, 0.0))
    shares[entry, direction] = area_and_weight


@wp.kernel(enable_backward=False)
def _measure_areas_adjoint(
    # in
    samples: wp.array(dtype=wp.int32),
    edges: wp.array2d(dtype=wp.vec2i),
    fragments: FragmentArrays,
    adj_areas: wp.array2d(dtype=wp.float32),
    # out
    adj_clip_positions: wp.array2d(dtype=wp.vec4),
):
    """A thread owns a direction of an entry: it adds to the gradients of the line's vertices."""
    entry, direction = wp.tid()
    edge = edges[entry, direction]
    adj_area = adj_areas[entry, direction]
    if edge[0] != NOTHING and adj_area != 0.0:
        axis = direction / 2
        sample = samples[entry]
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


def measure_areas(samples: wp.array, edges: wp.array, entries: wp.array, arrays: FragmentArrays) -> wp.array:
    """Measure the areas beyond the lines beside samples.

    Args:
        samples: Of each entry, int32 of shape [entry].
        edges: Vertices of the line in each direction, vec2i of shape [entry, 4].
        entries: Of each sample, int32 of shape [sample].
    Returns:
        The area e beyond each line, its weight ω, and whether a surface ends there, 1, or has a crease, 0;
        vec3 of shape [entry, 4], zero where there is no line.
    """
    shares = empty(edges.shape, dtype=wp.vec3, device=edges.device)
    launch(_measure_areas, edges.shape, inputs=[samples, edges, entries, arrays], outputs=[shares])
    return shares


def measure_areas_adjoint(samples: wp.array, edges: wp.array, arrays: FragmentArrays, adj_areas: wp.array) -> None:
    """The adjoint of the areas e, float32 of shape [entry, 4]: add to the gradient of the clip positions."""
    adj_clip_positions = arrays.clip_positions.grad
    launch(
        _measure_areas_adjoint, edges.shape, inputs=[samples, edges, arrays, adj_areas], outputs=[adj_clip_positions]
    )
