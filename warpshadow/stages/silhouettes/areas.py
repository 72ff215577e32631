"""Areas: how much of a sample lies beyond the lines around it, and how that changes with the vertices.

A line crosses the direction to a neighbor at distance t, and leans by m samples a sample (at most 1). Of the sample
lies beyond it

    e = ½ − t                     t ≤ (1 − m)/2
        ((1 + m)/2 − t)² / 2m     between
        0                         t ≥ (1 + m)/2

The line of an edge with ends a, b is ℓ = a × b, and that where two faces intersect ℓ = n − n′, the difference of their
planes. In a row, where ℓ·(x, y, 1) = 0, lines move by

    dx = (α ℓ·da + β ℓ·db) / ℓ_x                            α, β: the point on the edge is α a + β b, with w = 1
    dx = Σ_i (λ_i u n·dv_i − λ′_i u′ n′·dv′_i) / ℓ_x        λ: barycentrics of the fragments, u: its 1/w

The change of m is left out: on balance it hardly matters to the exchange between two samples (1e-4 of the gradient by a
rigid motion), and at edges far below a sample it would outweigh the rest, pulling their ends opposite ways.
"""

import warp as wp

from warpshadow.device.launch import launch
from warpshadow.device.memory import empty
from warpshadow.stages.screen import (
    distance,
    half_size,
    lean,
    neighbor,
    opposite,
    plane,
    relative,
    relative_adjoint,
    sample_center,
    sense,
)
from warpshadow.stages.silhouettes.lines import NOTHING, FragmentArrays, image_of, line_between

wp.set_module_options({"max_unroll": 1})  # loops that are not unrolled compile faster, and run as fast


@wp.kernel(enable_backward=False)
def _measure(
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
    share = wp.vec3()
    if edge[0] != NOTHING:
        half = half_size(fragments.width, fragments.height)
        line = line_between(fragments, samples[entry], direction, edge)
        t = wp.clamp(distance(line, direction, half), 0.0, 1.0)
        steepness = lean(line, direction, half)
        m = wp.min(steepness, 1.0)
        area = float(0.0)
        if t <= 0.5 * (1.0 - m):
            area = 0.5 - t
        elif t < 0.5 * (1.0 + m):
            rest = 0.5 * (1.0 + m) - t
            area = 0.5 * rest * rest / m
        if wp.isfinite(line / line[direction / 2]):  # else vertices are so far away that products overflow
            its_edge = edges[entries[neighbor(samples[entry], direction, fragments.width)], opposite(direction)]
            is_end = edge[0] == its_edge[0] and edge[1] == its_edge[1]
            line_weight = 1.0 / (1.0 + steepness * steepness * steepness * steepness)
            share = wp.vec3(area, line_weight, wp.where(is_end, 1.0, 0.0))
    shares[entry, direction] = share


@wp.kernel(enable_backward=False)
def _measure_adjoint(
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
        batch = image_of(fragments, sample)
        clip = fragments.clip_positions[batch]
        half = half_size(fragments.width, fragments.height)
        center = sample_center(sample, fragments.width, fragments.height)
        line = line_between(fragments, sample, direction, edge)
        t = wp.clamp(distance(line, direction, half), 0.0, 1.0)
        m = wp.min(lean(line, direction, half), 1.0)
        decline = float(0.0)  # of e with t
        if t <= 0.5 * (1.0 - m):
            decline = 1.0
        elif t < 0.5 * (1.0 + m):
            decline = (0.5 * (1.0 + m) - t) / m
        adj_place = -sense(direction) * adj_area * decline * half[axis]  # by the line's x in a row, or y in a column
        if edge[0] >= 0:
            across_a = relative(clip[edge[0]], center)[1 - axis]
            across_b = relative(clip[edge[1]], center)[1 - axis]
            spread = wp.where(axis == 0, -line[0], line[1])
            adj_clip = adj_place * relative_adjoint(center, line / line[axis])
            wp.atomic_add(adj_clip_positions, batch, edge[0], (across_b / spread) * adj_clip)
            wp.atomic_add(adj_clip_positions, batch, edge[1], (-across_a / spread) * adj_clip)
        else:
            for end in range(2):
                at = sample
                sign = float(1.0)
                if end == 1:
                    at = neighbor(sample, direction, fragments.width)
                    sign = -1.0
                corners = fragments.faces[fragments.face_ids[at]]
                ray = sample_center(at, fragments.width, fragments.height)
                normal = plane(corners, ray, clip)
                adj_clip = sign * adj_place * (normal[2] / line[axis]) * relative_adjoint(ray, normal)
                for k in range(3):
                    wp.atomic_add(adj_clip_positions, batch, corners[k], fragments.barycentrics[at][k] * adj_clip)


def measure_areas(samples: wp.array, edges: wp.array, entries: wp.array, arrays: FragmentArrays) -> wp.array:
    """Measure the areas beyond the lines beside samples.

    Args:
        samples: Of each entry, int32 of shape [entry].
        edges: Vertices of the line in each direction, vec2i of shape [entry, 4].
        entries: Of each sample, int32 of shape [sample].
        arrays: The fragments as kernels take them.
    Returns:
        The area e beyond each line, its weight ω, and whether a surface ends there, 1, or has a crease, 0;
        vec3 of shape [entry, 4], zero where there is no line.
    """
    shares = empty(edges.shape, dtype=wp.vec3, device=edges.device)
    launch(_measure, edges.shape, inputs=[samples, edges, entries, arrays], outputs=[shares])
    return shares


def add_to_vertices(samples: wp.array, edges: wp.array, arrays: FragmentArrays, adj_areas: wp.array) -> None:
    """The adjoint of the areas e, float32 of shape [entry, 4]: add to the gradient of the clip positions."""
    adj_clip_positions = arrays.clip_positions.grad
    launch(_measure_adjoint, edges.shape, inputs=[samples, edges, arrays, adj_areas], outputs=[adj_clip_positions])
