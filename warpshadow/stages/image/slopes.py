"""Slopes: how samples change as surfaces move over the screen, by the mean gradient of color over each sample.

A surface of color c that moves over the screen by v changes a sample by −∇c · v. At the sample's point ∇c is that of
one face, of many where faces are as small as samples; and towards a limb, where shading changes faster and faster, it
is far from the mean. So the mean over the sample is taken. To the right of the sample color changes by

    ½ (c_right − c) over ½ sample    if the neighbor's center is on the surface,
    c_edge − c over t samples        if the surface has an edge before, of color c_edge at distance t,

and likewise to the other sides. An edge at t > ½ lies in the neighbor, which shows this surface up to it. With the step
c_edge − c over t, steps along a row add up to the color at the surface's right edge minus that at its left; the
derivative of the moving edges has the same with the other sign. They cancel only if the step to an edge follows the
edge's point, and if a sample counts along a row as far as its surface reaches there: 1, or ½ + t beside an edge (along
a column likewise). The smoothed image weighs it once for both axes; so slopes are multiplied by extent / weight. (Else
a ball of metal of roughness 0.2 before a sun has a gradient of −3500 where the slope of the image is 1300; so it has
1630.)

Where another surface comes in front before the neighbor's center, or the image ends, the opposite half counts alone.
Where all neighbors see the same face, the slope is the face's own.

A sample that is a receiver itself has the exact derivative at its point instead, except beside the outline of its
surface. There the exact slope is often tiny and rarely huge, as it grows without bound towards a limb, and does not
match the colors at the edges: gradients of a mirroring ball are half of the differences of images. With mean slopes of
the samples along an outline, and of their neighbors, the colors of edges cancel.
"""

import math
from dataclasses import replace

import warp as wp

from warpshadow.device.batch import instance_in, rows
from warpshadow.device.launch import launch, without_gradient
from warpshadow.device.memory import empty, reshaped
from warpshadow.device.parallel import run_length
from warpshadow.device.tape import record_adjoint
from warpshadow.stages.image.film import sample_radiance
from warpshadow.stages.raster.interpolation import interpolate, interpolate_values_adjoint, interpolate_weights_adjoint
from warpshadow.stages.raster.rasterization import Fragments
from warpshadow.stages.raster.screen import (
    direction_sign,
    ends_before,
    half_size,
    has_neighbor,
    line_distance,
    neighbor,
    relative_to_ray,
    relative_to_ray_adjoint,
    sample_center,
)
from warpshadow.stages.receivers.quadtree import Quadtree
from warpshadow.stages.silhouettes.edge_colors import find_edge_colors
from warpshadow.stages.silhouettes.find import Silhouettes
from warpshadow.stages.silhouettes.lines import (
    NOTHING,
    FragmentArrays,
    edge_line,
    edge_position_adjoint,
    line_between,
    make_fragment_arrays,
)
from warpshadow.stages.silhouettes.smooth import find_image_weight

MIN_DISTANCE = 0.02  # distance of an edge [samples] below which rounding outweighs how color changes on the way to it

MIN_WEIGHT = 0.25  # of a sample in the smoothed image, by which its slopes are divided

_COST, _MEAN_SLOPE_COST = 20.0, 4.0  # nanoseconds of a sample: its gradient, and the search for its mean slope


@wp.func
def _face_slope(values: wp.vec3, corners: wp.vec3i, center: wp.vec2, clip_positions: wp.array(dtype=wp.vec4)):
    """Gradient by position, at a point of a face, of an attribute of its corners.

    Barycentrics are to each other as the last components of these normals of the planes through the eye and an edge.
    """
    a = relative_to_ray(clip_positions[corners[0]], center)
    b = relative_to_ray(clip_positions[corners[1]], center)
    c = relative_to_ray(clip_positions[corners[2]], center)
    normal_a = wp.cross(b, c)
    normal_b = wp.cross(c, a)
    normal_c = wp.cross(a, b)
    normal_sum = normal_a + normal_b + normal_c
    slope = values[0] * normal_a + values[1] * normal_b + values[2] * normal_c
    slope = (slope - slope[2] / normal_sum[2] * normal_sum) / normal_sum[2]
    return wp.vec2(slope[0], slope[1])


@wp.func
def _distance_to_end(
    fragments: FragmentArrays, entries: wp.array(dtype=wp.int32), edges: wp.array2d(dtype=wp.vec2i), sample: int, k: int
):
    """How far before a sample's neighbor in direction k its surface ends [samples]; −1 if it does not, as one can tell.

    −2 where the neighbor sees another surface, or there is none.
    """
    if not has_neighbor(sample, k, fragments.width, fragments.height):
        return -2.0
    entry = entries[sample]
    if entry >= 0:
        edge = edges[entry, k]
        if edge[0] != NOTHING:
            if edge[0] >= 0:
                line = line_between(fragments, sample, k, edge)
                t = line_distance(line, k, half_size(fragments.width, fragments.height))
                if ends_before(line, k) and t > MIN_DISTANCE and t <= 1.0:
                    return t
            return -2.0
    return wp.where(fragments.face_ids[neighbor(sample, k, fragments.width)] >= 0, -1.0, -2.0)


@wp.func
def _is_near_silhouette(fragments: FragmentArrays, entries: wp.array(dtype=wp.int32), sample: int):
    """Whether a sample or a neighbor has an entry among the silhouettes."""
    width = fragments.width
    last = entries.shape[0] - 1
    entry_in_row = wp.max(entries[wp.max(sample - 1, 0)], entries[wp.min(sample + 1, last)])
    entry_in_column = wp.max(entries[wp.max(sample - width, 0)], entries[wp.min(sample + width, last)])
    return wp.max(entries[sample], wp.max(entry_in_row, entry_in_column)) >= 0


@wp.kernel(enable_backward=False)
def _find_mean_slopes(
    first_row: int,
    worker: int,
    # in
    fragments: FragmentArrays,
    entries: wp.array(dtype=wp.int32),
    edges: wp.array2d(dtype=wp.vec2i),
    sides: wp.array(dtype=wp.int32),
    keys: wp.array(dtype=wp.int32),
    # out
    has_mean_slope: wp.array(dtype=wp.bool),
):
    """A thread owns a sample: whether its surface ends beside it, or beside a neighbor, and both slopes are known."""
    sample = first_row + wp.tid()
    side = sides[sample]
    is_at_outline = bool(False)
    has_slopes = side >= 0 and _is_near_silhouette(fragments, entries, sample)  # nearly all samples end here
    if keys and has_slopes:
        has_slopes = keys[side] < 0
    if has_slopes:
        for axis in range(2):
            is_known = bool(False)
            for k in range(2 * axis, 2 * axis + 2):
                distance = _distance_to_end(fragments, entries, edges, sample, k)
                is_known = is_known or distance > -2.0
                is_at_outline = is_at_outline or distance > 0.0
                if distance == -1.0:
                    neighbor_sample = neighbor(sample, k, fragments.width)
                    for j in range(4):
                        neighbor_distance = _distance_to_end(fragments, entries, edges, neighbor_sample, j)
                        is_at_outline = is_at_outline or neighbor_distance > 0.0
            has_slopes = has_slopes and is_known
    has_mean_slope[sample] = has_slopes and is_at_outline


def find_mean_slopes(silhouettes: Silhouettes, clip_positions: wp.array, quadtree: Quadtree | None = None) -> wp.array:
    """Find the samples that follow their surface by mean slopes although they are receivers.

    Args:
        silhouettes: Of :func:`warpshadow.stages.silhouettes.find.find_silhouettes`.
        clip_positions: The vertices that the silhouettes were found for, vec4 of shape [batch, vertex].
        quadtree: Squares in which samples interpolate, which none of these does; None for none.
    Returns:
        bool of shape [view, sample].

    Not differentiable.
    """
    fragments = silhouettes.fragments
    sides = fragments.face_ids if fragments.sides is None else fragments.sides
    has_mean_slope = empty(rows(sides).shape, dtype=wp.bool, device=sides.device)
    arrays = make_fragment_arrays(fragments, silhouettes.faces, clip_positions)
    keys = None if quadtree is None else quadtree.square_key_of_side
    inputs = [arrays, silhouettes.entries, silhouettes.edges, reshaped(sides, (-1,)), keys]
    launch(
        _find_mean_slopes, sides.size, inputs=inputs, outputs=[reshaped(has_mean_slope, (-1,))], cost=_MEAN_SLOPE_COST
    )
    return has_mean_slope


@wp.kernel(enable_backward=False)
def _add_shading_gradients(
    first_row: int,
    worker: int,
    # in
    samples: wp.array2d(dtype=wp.vec4),
    light: wp.array2d(dtype=wp.vec3),
    receiver_face_ids: wp.array2d(dtype=wp.int32),
    receiver_faces: wp.array(dtype=wp.vec3i),
    shading: wp.array2d(dtype=wp.vec3),
    albedo: wp.array2d(dtype=wp.vec3),
    fragments: FragmentArrays,
    entries: wp.array(dtype=wp.int32),
    edges: wp.array2d(dtype=wp.vec2i),
    shares: wp.array2d(dtype=wp.vec3),
    edge_colors: wp.array3d(dtype=wp.vec4),
    has_mean_slope: wp.array2d(dtype=wp.bool),
    first_sample_face: int,
    run: int,
    adj_samples: wp.array2d(dtype=wp.vec4),
    # sums
    adj_clip_positions: wp.array2d(dtype=wp.vec4),
):
    """A thread owns a run of samples of all instances; ``fragment`` is the index of a sample in flat images."""
    first_sample = (first_row + wp.tid()) * run
    width = fragments.width
    samples_per_unit = half_size(width, fragments.height)
    for batch in range(adj_samples.shape[0]):
        fragment_batch = instance_in(batch, receiver_face_ids.shape[0])
        albedo_batch = instance_in(batch, albedo.shape[0])
        receiver_shading = shading[instance_in(batch, shading.shape[0])]
        light_batch = instance_in(batch, light.shape[0])
        clip = fragments.clip_positions[fragment_batch]
        for sample in range(first_sample, first_sample + run):
            fragment = fragment_batch * adj_samples.shape[1] + sample
            face = fragments.face_ids[fragment]
            adj_sample = adj_samples[batch, sample]
            adj_color = wp.vec3(adj_sample[0], adj_sample[1], adj_sample[2])
            receivers = wp.vec3i()
            if face >= 0:
                receivers = receiver_faces[receiver_face_ids[fragment_batch, sample]]
            is_receiver = receiver_face_ids[fragment_batch, sample] >= first_sample_face
            is_moving = not is_receiver
            if has_mean_slope:
                is_moving = is_moving or has_mean_slope[fragment_batch, sample]
            # A sample that is a receiver has the gradient of the receiver's point instead.
            if face >= 0 and is_moving and wp.length_sq(adj_color) > 0.0:
                adj_light = wp.cw_mul(adj_color, albedo[albedo_batch, sample])
                sample_light = light[light_batch, sample]
                color = samples[batch, sample]
                center = sample_center(fragment, width, fragments.height)
                entry = entries[fragment]
                is_flat = entry < 0 and not is_receiver
                for direction in range(4):
                    if has_neighbor(fragment, direction, width, fragments.height):
                        is_flat = is_flat and fragments.face_ids[neighbor(fragment, direction, width)] == face
                weighted_slopes = wp.vec2()
                distances = wp.vec2()  # lengths over which the differences were measured [samples]
                edge_steps = wp.vec4()
                extents = wp.vec2()  # of the sample along both axes [samples]
                image_weight = float(1.0)
                if not is_flat:
                    extents = wp.vec2(1.0, 1.0)
                    if entry >= 0:
                        image_weight = wp.max(find_image_weight(fragment, entry, entries, shares, width), MIN_WEIGHT)
                    for direction in range(4):
                        edge = wp.vec2i(NOTHING, NOTHING)
                        if entry >= 0:
                            edge = edges[entry, direction]
                        if edge[0] >= 0:
                            line = edge_line(edge, center, clip)
                            t = line_distance(line, direction, samples_per_unit)
                            if ends_before(line, direction) and t > MIN_DISTANCE and t <= 1.0:
                                # entries are of all views; where one view serves all images, each has its
                                # own colors
                                color_step = edge_colors[batch - fragment_batch, entry, direction] - color
                                adj_step = wp.dot(adj_color, wp.vec3(color_step[0], color_step[1], color_step[2]))
                                edge_steps[direction] = direction_sign(direction) * adj_step
                                distances[direction / 2] += t
                                extents[direction / 2] += t - 0.5
                        elif edge[0] == NOTHING and has_neighbor(fragment, direction, width, fragments.height):
                            neighbor_sample = neighbor(sample, direction, width)
                            if receiver_face_ids[fragment_batch, neighbor_sample] >= 0:
                                light_step = wp.dot(adj_light, light[light_batch, neighbor_sample] - sample_light)
                                weighted_slopes[direction / 2] += direction_sign(direction) * 0.5 * light_step
                                distances[direction / 2] += 0.5
                if wp.length_sq(edge_steps) > 0.0:
                    for direction in range(4):
                        if edge_steps[direction] != 0.0:
                            edge_slope = edge_steps[direction] / distances[direction / 2]
                            edge_slope *= extents[direction / 2] / image_weight
                            adj_position = -edge_slope * samples_per_unit[direction / 2]
                            edge = edges[entry, direction]
                            adj_a, adj_b = edge_position_adjoint(edge, center, direction / 2, adj_position, clip)
                            if wp.isfinite(adj_a) and wp.isfinite(adj_b):
                                wp.atomic_add(adj_clip_positions, fragment_batch, edge[0], adj_a)
                                wp.atomic_add(adj_clip_positions, fragment_batch, edge[1], adj_b)
                slope = wp.cw_mul(wp.cw_div(weighted_slopes, distances), samples_per_unit)
                corners = fragments.faces[face]
                if wp.min(distances) == 0.0:
                    receiver_slope = _face_slope(
                        interpolate_weights_adjoint(receiver_shading, receivers, adj_light), corners, center, clip
                    )
                    slope = wp.vec2(
                        wp.where(distances[0] == 0.0, receiver_slope[0], slope[0]),
                        wp.where(distances[1] == 0.0, receiver_slope[1], slope[1]),
                    )
                if entry >= 0 and not is_flat:
                    slope = wp.cw_mul(slope, extents / image_weight)
                weights = fragments.barycentrics[fragment]
                depth = wp.dot(weights, wp.vec3(clip[corners[0]][3], clip[corners[1]][3], clip[corners[2]][3]))
                adj_clip = relative_to_ray_adjoint(center, wp.vec3(-slope[0], -slope[1], 0.0)) / depth
                if wp.isfinite(adj_clip):
                    interpolate_values_adjoint(adj_clip_positions[fragment_batch], corners, weights, adj_clip)


def moving_radiance(
    fragments: Fragments,
    faces: wp.array,
    shading: wp.array,
    albedo: wp.array,
    silhouettes: Silhouettes,
    clip_positions: wp.array,
    receivers: wp.array,
    has_mean_slope: wp.array | None = None,
) -> tuple[wp.array, wp.array]:
    """Radiance of samples of moving surfaces: :func:`warpshadow.stages.image.film.sample_radiance`, by mean slopes.

    Args:
        fragments: The fragments, of faces of receivers.
        faces: Indices of receivers, vec3i of shape [face].
        shading: Of the receivers, vec3 of shape [batch, receiver].
        albedo: Of the samples, vec3 of shape [batch, height, width].
        silhouettes: Of :func:`warpshadow.stages.silhouettes.find.find_silhouettes`.
        clip_positions: The vertices that the silhouettes were found for, vec4 of shape [batch, vertex].
        receivers: As for :func:`warpshadow.stages.silhouettes.edge_colors.find_edge_colors`.
        has_mean_slope: Of :func:`find_mean_slopes`, if the receivers were found with it.
    Returns:
        Linear RGB and coverage, 1 or 0, vec4 of shape [batch, height, width]; and the edge colors, with which
        :func:`warpshadow.stages.silhouettes.smooth.smooth_silhouettes` is to be called.
    Differentiable: shading, albedo, clip_positions; the latter in place of barycentrics of the fragments, but for the
    samples that are receivers themselves or interpolate between such, whose gradient is that of the receivers' points
    unless they have mean slopes.
    """
    fragments = replace(fragments, barycentrics=without_gradient(fragments.barycentrics))
    samples = sample_radiance(fragments, faces, shading, albedo)
    edge_colors = find_edge_colors(samples, silhouettes, clip_positions, shading, receivers, albedo)
    if not clip_positions.requires_grad:
        return samples, edge_colors
    samples.requires_grad = True

    def adjoint() -> None:
        light = interpolate(fragments, faces, without_gradient(shading))
        run = run_length(samples.device, samples.shape[2])
        launch(
            _add_shading_gradients,
            math.prod(light.shape[1:]) // run,
            cost=_COST * run * samples.shape[0],
            inputs=[
                rows(samples),
                rows(light),
                rows(fragments.face_ids),
                faces,
                shading,
                rows(albedo),
                make_fragment_arrays(silhouettes.fragments, silhouettes.faces, clip_positions),
                silhouettes.entries,
                silhouettes.edges,
                silhouettes.shares,
                edge_colors,
                has_mean_slope,
                len(silhouettes.faces) * (1 if silhouettes.fragments.sides is None else 2),
                run,
                rows(samples.grad),
            ],
            sums=[clip_positions.grad],
        )

    record_adjoint(adjoint, [samples, clip_positions])
    return samples, edge_colors
