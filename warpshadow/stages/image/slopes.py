"""Slopes: how samples change as surfaces move over the screen, by the mean gradient of color over each sample.

A surface of color c that moves over the screen by v changes a sample by −∇c · v, with ∇c its mean over the sample. (At
the sample's point ∇c would be that of one face, and far from the mean where shading changes fast, as towards a limb.)
To the right of the sample color changes by

    ½ (c_right − c) over ½ sample    if the neighbor's center is on the surface,
    c_edge − c over t samples        if the surface ends before, at distance t, with the color c_edge,

and likewise to the other sides:

- An edge at t > ½ lies in the neighbor, which shows this surface up to it.
- Where another surface comes in front before the neighbor's center, or the image ends, the opposite half counts alone.
- Where all neighbors see the same face, the slope is the face's own.

    left edge  sample      sample      sample  right edge
        ├───t────●────½──┼──½──●────½──┼──½──●───t───┤
      c_edge     c             c             c     c_edge

These steps add up along a row to the color at the surface's right edge minus that at its left, and the moving edges
contribute the opposite. A body that moves in its own light shows the same sum wherever it is, so the two must cancel.
They do, since

- a step to an edge moves as the edge's point does, which under a rotation is not how the sample's own point moves;
- a sample counts along a row as far as its surface reaches there, its extent: 1; ½ + t beside one edge; t + t′ between
  two. That is the length of its steps, so extent times slope are the steps, and half steps of neighbors are whole ones.
  The smoothed image weighs a sample once for both axes, so slopes are multiplied by extent / weight.

Near outlines mean slopes also replace exact derivatives (:mod:`.outlines`).

Without the factor extent / weight the gradient of a ball of metal before a sun is −3500, with it 1630; differences of
images say 1300. Without mean slopes near outlines that of a mirroring ball is half of it; with them up to one step away
in place of two it has the wrong sign at a sun's highlight that is three samples wide.
"""

import math
from dataclasses import replace

import warp as wp

from warpshadow.device.batch import common_batch, instance_in, rows
from warpshadow.device.launch import launch, without_gradient
from warpshadow.device.memory import empty
from warpshadow.device.parallel import run_length
from warpshadow.device.tape import record_adjoint
from warpshadow.stages.image.film import sample_radiance
from warpshadow.stages.image.outlines import SurfaceArrays, distance_to_end, make_surface_arrays
from warpshadow.stages.raster.interpolation import interpolate_values_adjoint, interpolate_weights_adjoint
from warpshadow.stages.raster.rasterization import Fragments
from warpshadow.stages.raster.screen import (
    direction_sign,
    half_size,
    has_neighbor,
    neighbor,
    relative_to_ray,
    relative_to_ray_adjoint,
    sample_center,
)
from warpshadow.stages.silhouettes.areas import LineArea
from warpshadow.stages.silhouettes.edge_colors import find_edge_colors
from warpshadow.stages.silhouettes.lines import FragmentArrays, edge_position_adjoint
from warpshadow.stages.silhouettes.silhouettes import Silhouettes
from warpshadow.stages.silhouettes.smooth import find_image_weight

MIN_WEIGHT = 0.25  # of a sample in the smoothed image, by which its slopes are divided

_COST = 20.0  # nanoseconds that the gradient of a sample takes


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


@wp.struct
class _ImageArrays:
    """The samples of one image, whose color is light times albedo."""

    colors: wp.array(dtype=wp.vec4)
    light: wp.array(dtype=wp.vec3)
    albedo: wp.array(dtype=wp.vec3)
    face_ids: wp.array(dtype=wp.int32)  # of receivers
    edge_colors: wp.array2d(dtype=wp.vec4)  # [entry of all images, direction]


@wp.struct
class _MovingFactors:
    """The factors of a sample's color that move with its surface by mean slopes."""

    light: bool
    albedo: bool


@wp.struct
class _ColorSteps:
    """Changes of color on the way from a sample to its neighbors, times the gradient of its color."""

    inner: wp.vec2  # to neighbors on its surface, in a row and in a column
    to_edges: wp.vec4  # to edges of its surface, by direction
    lengths: wp.vec2  # of these ways in a row and in a column [samples]; 0 where there is none
    extents: wp.vec2  # of its surface in a row and in a column [samples]


@wp.func
def _is_surrounded(fragments: FragmentArrays, sample: int):
    """Whether all neighbors of a sample see its face."""
    result = bool(True)
    for direction in range(4):
        if has_neighbor(sample, direction, fragments.width, fragments.height):
            other = neighbor(sample, direction, fragments.width)
            result = result and fragments.face_ids[other] == fragments.face_ids[sample]
    return result


@wp.func
def _inner_step(image: _ImageArrays, sample: int, other: int, adj_color: wp.vec3, moving: _MovingFactors):
    """The change of color from a sample to another on its surface."""
    other_light = image.light[sample]
    if moving.light:
        other_light = image.light[other]
    step = wp.dot(wp.cw_mul(adj_color, image.albedo[sample]), other_light - image.light[sample])
    if moving.albedo:
        step += wp.dot(adj_color, wp.cw_mul(other_light, image.albedo[other] - image.albedo[sample]))
    return step


@wp.func
def _measure_steps(
    image: _ImageArrays, surfaces: SurfaceArrays, sample: int, fragment: int, adj_color: wp.vec3, moving: _MovingFactors
):
    """Steps of a sample to its neighbors, or to the edges before these."""
    steps = _ColorSteps(wp.vec2(), wp.vec4(), wp.vec2(), wp.vec2(1.0, 1.0))  # type: ignore[call-arg]
    for direction in range(4):
        axis = direction // 2
        sign = direction_sign(direction)
        distance = distance_to_end(surfaces, fragment, direction)
        other = neighbor(sample, direction, surfaces.fragments.width)
        if distance > 0.0:
            step = image.edge_colors[surfaces.entries[fragment], direction] - image.colors[sample]
            adj_step = wp.dot(adj_color, wp.vec3(step[0], step[1], step[2]))
            steps.to_edges[direction] = wp.where(moving.light, sign * adj_step, 0.0)
            steps.lengths[axis] += distance
            steps.extents[axis] += distance - 0.5
        elif distance == -1.0 and image.face_ids[other] >= 0:
            steps.inner[axis] += sign * 0.5 * _inner_step(image, sample, other, adj_color, moving)
            steps.lengths[axis] += 0.5
    return steps


@wp.func
def _follow_edges(
    steps: _ColorSteps,
    image_weight: float,
    edges: wp.array(dtype=wp.vec2i),
    center: wp.vec2,
    samples_per_unit: wp.vec2,
    clip_positions: wp.array(dtype=wp.vec4),
    adj_clip_positions: wp.array(dtype=wp.vec4),
):
    """Add the gradients of the ends of the edges beside a sample, by its steps to them."""
    for direction in range(4):
        axis = direction // 2
        if steps.to_edges[direction] != 0.0:
            slope = steps.to_edges[direction] / steps.lengths[axis] * (steps.extents[axis] / image_weight)
            edge = edges[direction]
            adj_a, adj_b = edge_position_adjoint(edge, center, axis, -slope * samples_per_unit[axis], clip_positions)
            if wp.isfinite(adj_a) and wp.isfinite(adj_b):
                wp.atomic_add(adj_clip_positions, edge[0], adj_a)
                wp.atomic_add(adj_clip_positions, edge[1], adj_b)


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
    surfaces: SurfaceArrays,
    line_areas: wp.array2d(dtype=LineArea),
    edge_colors: wp.array3d(dtype=wp.vec4),
    has_mean_slope: wp.array2d(dtype=wp.bool),
    albedo_has_mean_slope: wp.array2d(dtype=wp.bool),
    first_sample_face: int,
    run: int,
    adj_samples: wp.array2d(dtype=wp.vec4),
    # sums
    adj_clip_positions: wp.array2d(dtype=wp.vec4),
):
    """A thread owns a run of samples of all instances; ``fragment`` is the index of a sample in flat images."""
    first_sample = (first_row + wp.tid()) * run
    fragments = surfaces.fragments
    samples_per_unit = half_size(fragments.width, fragments.height)
    for batch in range(adj_samples.shape[0]):
        view_batch = instance_in(batch, receiver_face_ids.shape[0])
        # entries are of all views; where one view_batch serves all images, each has its own colors
        image = _ImageArrays()
        image.colors = samples[batch]
        image.light = light[instance_in(batch, light.shape[0])]
        image.albedo = albedo[instance_in(batch, albedo.shape[0])]
        image.face_ids = receiver_face_ids[view_batch]
        image.edge_colors = edge_colors[batch - view_batch]
        clip = fragments.clip_positions[view_batch]
        adj_clip = adj_clip_positions[view_batch]
        for sample in range(first_sample, first_sample + run):
            fragment = view_batch * adj_samples.shape[1] + sample
            adj_sample = adj_samples[batch, sample]
            adj_color = wp.vec3(adj_sample[0], adj_sample[1], adj_sample[2])
            # a sample that is a receiver has the gradient of the receiver's point instead
            is_receiver = image.face_ids[sample] >= first_sample_face
            moving = _MovingFactors(not is_receiver, False)  # type: ignore[call-arg]
            if has_mean_slope:
                moving.light = moving.light or has_mean_slope[view_batch, sample]
            if albedo_has_mean_slope:
                moving.albedo = albedo_has_mean_slope[view_batch, sample]
            is_moving = fragments.face_ids[fragment] >= 0 and (moving.light or moving.albedo)
            if is_moving and wp.length_sq(adj_color) > 0.0:
                center = sample_center(fragment, fragments.width, fragments.height)
                entry = surfaces.entries[fragment]
                image_weight = float(1.0)
                if entry >= 0:
                    image_weight = find_image_weight(fragment, entry, surfaces.entries, line_areas, fragments.width)
                    image_weight = wp.max(image_weight, MIN_WEIGHT)
                steps = _ColorSteps(wp.vec2(), wp.vec4(), wp.vec2(), wp.vec2(1.0, 1.0))  # type: ignore[call-arg]
                if entry >= 0 or is_receiver or moving.albedo or not _is_surrounded(fragments, fragment):
                    steps = _measure_steps(image, surfaces, sample, fragment, adj_color, moving)
                if wp.length_sq(steps.to_edges) > 0.0:
                    _follow_edges(steps, image_weight, surfaces.edges[entry], center, samples_per_unit, clip, adj_clip)
                slope = wp.cw_mul(wp.cw_div(steps.inner, steps.lengths), samples_per_unit)
                corners = fragments.faces[fragments.face_ids[fragment]]
                if wp.min(steps.lengths) == 0.0:
                    values = shading[instance_in(batch, shading.shape[0])]
                    adj_light = wp.cw_mul(adj_color, image.albedo[sample])
                    adj_weights = interpolate_weights_adjoint(values, receiver_faces[image.face_ids[sample]], adj_light)
                    face_slope = _face_slope(adj_weights, corners, center, clip)
                    for axis in range(2):
                        slope[axis] = wp.where(steps.lengths[axis] == 0.0, face_slope[axis], slope[axis])
                slope = wp.cw_mul(slope, steps.extents / image_weight)
                weights = fragments.barycentrics[fragment]
                depth = wp.dot(weights, wp.vec3(clip[corners[0]][3], clip[corners[1]][3], clip[corners[2]][3]))
                adj_point = relative_to_ray_adjoint(center, wp.vec3(-slope[0], -slope[1], 0.0)) / depth
                if wp.isfinite(adj_point):
                    interpolate_values_adjoint(adj_clip, corners, weights, adj_point)


def moving_radiance(
    fragments: Fragments,
    faces: wp.array,
    shading: wp.array,
    albedo: wp.array,
    silhouettes: Silhouettes,
    clip_positions: wp.array,
    receivers: wp.array,
    has_mean_slope: wp.array | None = None,
    albedo_has_mean_slope: wp.array | None = None,
) -> tuple[wp.array, wp.array]:
    """Radiance of samples of moving surfaces: :func:`warpshadow.stages.image.film.sample_radiance`, by mean slopes.

    Args:
        fragments: The fragments, of faces of receivers.
        faces: Indices of receivers, vec3i of shape [face].
        shading: Of the receivers, vec3 of shape [batch, receiver].
        albedo: Of the samples, vec3 of shape [batch, height, width].
        silhouettes: Of :func:`warpshadow.stages.silhouettes.silhouettes.find_silhouettes`.
        clip_positions: The vertices that the silhouettes were found for, vec4 of shape [batch, vertex].
        receivers: As for :func:`warpshadow.stages.silhouettes.edge_colors.find_edge_colors`.
        has_mean_slope: Of :func:`find_outline_samples`, if the receivers were found with it.
        albedo_has_mean_slope: The same without a quadtree, if albedo was found by :func:`detach_near_outlines`.
    Returns:
        Linear RGB and coverage, 1 or 0, vec4 of shape [batch, height, width]; and the edge colors, with which
        :func:`warpshadow.stages.silhouettes.smooth.smooth_silhouettes` is to be called.
    Differentiable: shading, albedo, clip_positions. The latter stand for the barycentrics of the fragments, but not of
    samples that are receivers themselves, or interpolate between such, without mean slopes: these have the gradient of
    the receivers' points. By albedo samples are moved where it has a mean slope.
    """
    fragments = replace(fragments, barycentrics=without_gradient(fragments.barycentrics))
    light = None
    if clip_positions.requires_grad:
        count = common_batch({"fragments": fragments.face_ids, "shading": shading, "albedo": albedo})
        light = empty((count, math.prod(albedo.shape[1:])), dtype=wp.vec3, device=albedo.device)
    samples = sample_radiance(fragments, faces, shading, albedo, light)
    edge_colors = find_edge_colors(samples, silhouettes, clip_positions, shading, receivers, albedo)
    if light is None:
        return samples, edge_colors
    samples.requires_grad = True

    def adjoint() -> None:
        run = run_length(samples.device, samples.shape[2])
        launch(
            _add_shading_gradients,
            light.shape[1] // run,
            cost=_COST * run * samples.shape[0],
            inputs=[
                rows(samples),
                light,
                rows(fragments.face_ids),
                faces,
                shading,
                rows(albedo),
                make_surface_arrays(silhouettes, clip_positions),
                silhouettes.line_areas,
                edge_colors,
                has_mean_slope,
                albedo_has_mean_slope,
                len(silhouettes.faces) * (1 if silhouettes.fragments.sides is None else 2),
                run,
                rows(samples.grad),
            ],
            sums=[clip_positions.grad],
        )

    record_adjoint(adjoint, [samples, clip_positions])
    return samples, edge_colors
