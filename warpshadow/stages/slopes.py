"""Slopes: the mean gradient of color over a sample on screen, by which surfaces that move pull at their vertices.

A surface of color c that moves over the screen by v changes a sample by −∇c · v. Were faces large, ∇c could be that of
the face at the sample's point. But where they are as small as samples, it is one of many; and towards a limb, where
shading changes faster and faster, it is far from the mean. So the mean over the sample is taken. Its right half gives

    ½ (c_right − c)                 if the neighbor's center is on the surface,
    min(t, ½) / t · (c_edge − c)    if the surface ends before, at an edge of color c_edge at distance t [pixels],

and likewise the other halves. Where something else comes in front before the neighbor's center, or the image ends,
there is nothing to be known, and the opposite half counts alone. Where all neighbors see the same face, the slope is
the face's own.
"""

import warp as wp

from warpshadow.device.batch import rows
from warpshadow.device.parallel import launch_slices, split_row
from warpshadow.device.tape import record_adjoint
from warpshadow.stages.film import light_at
from warpshadow.stages.rasterize import Fragments, run_length
from warpshadow.stages.silhouettes.find import (
    NOTHING,
    Silhouettes,
    distance,
    ends_before,
    neighbor,
    pixel_center,
    relative,
)

LEAST_DISTANCE = 0.02
"""Distance of an edge [pixels] below which rounding outweighs how color changes on the way to it."""

_RECEIVE_COST = 5.0
_SAMPLE_COST = 20.0
"""Nanoseconds that a sample takes: what it receives, and how it pulls."""


@wp.kernel(enable_backward=False)
def _receive(
    first_row: int,
    worker: int,
    # in
    face_ids: wp.array2d(dtype=wp.int32),
    barycentrics: wp.array2d(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    shading: wp.array2d(dtype=wp.vec3),
    run: int,
    # out
    light: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a run of samples: the light that they receive."""
    batch, thread = split_row(first_row + wp.tid(), light.shape[1] // run)
    view = wp.min(batch, face_ids.shape[0] - 1)
    lit = wp.min(batch, shading.shape[0] - 1)
    for sample in range(thread * run, (thread + 1) * run):
        face = face_ids[view, sample]
        if face >= 0:
            light[batch, sample] = light_at(faces[face], barycentrics[view, sample], lit, shading)


@wp.func
def _slope_of_face(
    face: wp.vec3i,
    at_a: float,
    at_b: float,
    at_c: float,
    center: wp.vec2,
    clip_positions: wp.array(dtype=wp.vec4),
):
    """Gradient by normalized device coordinates, at a point of a face, of what has values at its corners.

    Barycentrics are to each other as the last components of these normals of the planes through the eye and an edge.
    """
    a = relative(clip_positions[face[0]], center)
    b = relative(clip_positions[face[1]], center)
    c = relative(clip_positions[face[2]], center)
    normal_a = wp.cross(b, c)
    normal_b = wp.cross(c, a)
    normal_c = wp.cross(a, b)
    total = normal_a + normal_b + normal_c
    slope = at_a * normal_a + at_b * normal_b + at_c * normal_c
    slope = (slope - slope[2] / total[2] * total) / total[2]
    return wp.vec2(slope[0], slope[1])


@wp.kernel(enable_backward=False)
def _pull_surfaces(
    first_row: int,
    worker: int,
    # in
    samples: wp.array2d(dtype=wp.vec4),
    light: wp.array2d(dtype=wp.vec3),
    lit_face_ids: wp.array2d(dtype=wp.int32),
    lit_faces: wp.array(dtype=wp.vec3i),
    shading: wp.array2d(dtype=wp.vec3),
    albedo: wp.array2d(dtype=wp.vec3),
    face_ids: wp.array2d(dtype=wp.int32),
    barycentrics: wp.array2d(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    entries: wp.array2d(dtype=wp.int32),
    edges: wp.array2d(dtype=wp.vec2i),
    edge_colors: wp.array3d(dtype=wp.vec4),
    clip_positions: wp.array2d(dtype=wp.vec4),
    width: int,
    height: int,
    run: int,
    adj_samples: wp.array2d(dtype=wp.vec4),
    # out
    adj_clip_positions: wp.array2d(dtype=wp.vec4),
):
    """A thread owns a run of samples of all instances."""
    first = (first_row + wp.tid()) * run
    half_size = 0.5 * wp.vec2(float(width), float(height))
    for batch in range(adj_samples.shape[0]):
        view = wp.min(batch, face_ids.shape[0] - 1)
        lit = wp.min(batch, shading.shape[0] - 1)
        reflected = wp.min(batch, albedo.shape[0] - 1)
        clip = clip_positions[view]
        for sample in range(first, first + run):
            face = face_ids[view, sample]
            adj_sample = adj_samples[batch, sample]
            adj_color = wp.vec3(adj_sample[0], adj_sample[1], adj_sample[2])
            corners = wp.vec3i()
            if face >= 0:
                corners = lit_faces[lit_face_ids[view, sample]]
            # A sample that is a receiver itself has the gradient of its point instead.
            if corners[0] != corners[1] and wp.length_sq(adj_color) > 0.0:
                seed = wp.cw_mul(adj_color, albedo[reflected, sample])
                here = light[batch, sample]
                color = samples[batch, sample]
                row = sample / width
                column = sample - row * width
                goes_on = wp.vec4i(int(column < width - 1), int(column > 0), int(row < height - 1), int(row > 0))
                center = pixel_center(sample, width, height)
                entry = entries[view, sample]
                is_flat = entry < 0
                for side in range(4):
                    if goes_on[side] != 0:
                        is_flat = is_flat and face_ids[view, neighbor(sample, side, width)] == face
                rises = wp.vec2()
                spans = wp.vec2()  # lengths over which those were measured [pixels]
                if not is_flat:
                    for side in range(4):
                        onward = 1.0 - 2.0 * float(side % 2)
                        edge = wp.vec2i(NOTHING, NOTHING)
                        if entry >= 0:
                            edge = edges[entry, side]
                        if edge[0] >= 0:
                            line = wp.cross(relative(clip[edge[0]], center), relative(clip[edge[1]], center))
                            t = distance(line, side, half_size)
                            if ends_before(line, side) and t > LEAST_DISTANCE and t <= 1.0:
                                # entries are of all views; where one view serves all images, each has its own colors
                                rise = edge_colors[batch - view, entry, side] - color
                                span = wp.min(t, 0.5)
                                total = wp.dot(adj_color, wp.vec3(rise[0], rise[1], rise[2]))
                                rises[side / 2] += onward * span / t * total
                                spans[side / 2] += span
                        elif edge[0] == NOTHING and goes_on[side] != 0:
                            other = neighbor(sample, side, width)
                            if face_ids[view, other] >= 0:
                                rises[side / 2] += onward * 0.5 * wp.dot(seed, light[batch, other] - here)
                                spans[side / 2] += 0.5
                slope = wp.cw_mul(wp.cw_div(rises, spans), half_size)
                if wp.min(spans) == 0.0:
                    own = _slope_of_face(
                        faces[face],
                        wp.dot(seed, shading[lit, corners[0]]),
                        wp.dot(seed, shading[lit, corners[1]]),
                        wp.dot(seed, shading[lit, corners[2]]),
                        center,
                        clip,
                    )
                    slope = wp.vec2(
                        wp.where(spans[0] == 0.0, own[0], slope[0]), wp.where(spans[1] == 0.0, own[1], slope[1])
                    )
                corners = faces[face]
                weights = barycentrics[view, sample]
                depth = wp.dot(weights, wp.vec3(clip[corners[0]][3], clip[corners[1]][3], clip[corners[2]][3]))
                pull = wp.vec4(-slope[0], -slope[1], 0.0, wp.dot(slope, center)) / depth
                if wp.isfinite(pull):
                    wp.atomic_add(adj_clip_positions, view, corners[0], weights[0] * pull)
                    wp.atomic_add(adj_clip_positions, view, corners[1], weights[1] * pull)
                    wp.atomic_add(adj_clip_positions, view, corners[2], weights[2] * pull)


def pull_surfaces(
    samples: wp.array,
    fragments: Fragments,
    faces: wp.array,
    shading: wp.array,
    albedo: wp.array,
    silhouettes: Silhouettes,
    edge_colors: wp.array,
    clip_positions: wp.array,
) -> None:
    """Let surfaces that move change samples by the mean slope of the light that they receive.

    It records an adjoint alone, from samples to clip positions. It replaces the gradient to barycentrics that
    :func:`warpshadow.stages.film.expose` has at points.

    Args:
        samples: Color and coverage of the samples, vec4 of shape [batch, height, width].
        fragments: What each sample sees, of faces of receivers.
        faces: Indices of receivers, vec3i of shape [face].
        shading: Of the receivers, vec3 of shape [batch, receiver].
        albedo: Of the samples, vec3 of shape [batch, height, width].
        silhouettes: Of :func:`warpshadow.stages.silhouettes.find.find_silhouettes`.
        edge_colors: Of :func:`warpshadow.stages.silhouettes.smooth.find_edge_colors`.
        clip_positions: Those that the silhouettes were found for, vec4 of shape [batch, vertex].

    Differentiable: samples in clip_positions.
    """
    seen = silhouettes.fragments
    view_count, height, width = seen.face_ids.shape
    run, device = run_length(samples.device, width), samples.device
    run_count = height * width // run
    face_ids = rows(fragments.face_ids)

    def adjoint() -> None:
        light = wp.empty((samples.shape[0], height * width), dtype=wp.vec3, device=device)
        launch_slices(
            _receive,
            dim=[light.shape[0] * run_count],
            cost=_RECEIVE_COST * run,
            inputs=[face_ids, rows(fragments.barycentrics), faces, shading, run],
            outputs=[light],
            device=device,
        )
        launch_slices(
            _pull_surfaces,
            dim=[run_count],
            cost=_SAMPLE_COST * run * light.shape[0],
            inputs=[
                rows(samples),
                light,
                face_ids,
                faces,
                shading,
                rows(albedo),
                rows(seen.face_ids),
                rows(seen.barycentrics),
                silhouettes.faces,
                silhouettes.entries.reshape((view_count, -1)),
                silhouettes.edges,
                edge_colors,
                clip_positions,
                width,
                height,
                run,
                rows(samples.grad),
            ],
            outputs=[],
            sums=[clip_positions.grad],
            device=device,
        )

    if clip_positions.requires_grad:
        record_adjoint(adjoint, [samples, clip_positions])
