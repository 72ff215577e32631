"""Film: from what the samples of an image receive and reflect to the color and coverage of its pixels."""

import warp as wp

from warpshadow import check
from warpshadow.device.batch import common_batch, instance_in, rows
from warpshadow.device.launch import differentiable, launch
from warpshadow.device.parallel import run_length, split_row
from warpshadow.stages.rasterize import Fragments

_SAMPLE_COST = 5.0
"""Nanoseconds that a sample takes."""


@wp.func
def light_at(corners: wp.vec3i, weights: wp.vec3, instance: int, shading: wp.array2d(dtype=wp.vec3)):
    """Shading at a point of a face."""
    result = weights[0] * shading[instance, corners[0]]
    result += weights[1] * shading[instance, corners[1]]
    result += weights[2] * shading[instance, corners[2]]
    return result


@wp.kernel(enable_backward=False)
def _expose(
    first_row: int,
    worker: int,
    # in
    face_ids: wp.array2d(dtype=wp.int32),
    barycentrics: wp.array2d(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    shading: wp.array2d(dtype=wp.vec3),
    albedo: wp.array2d(dtype=wp.vec3),
    run: int,
    # out
    samples: wp.array2d(dtype=wp.vec4),
):
    """A thread owns a run of samples; they are zero before."""
    batch, thread = split_row(first_row + wp.tid(), samples.shape[1] // run)
    view = instance_in(batch, face_ids.shape[0])
    lit = instance_in(batch, shading.shape[0])
    reflected = instance_in(batch, albedo.shape[0])
    for sample in range(thread * run, (thread + 1) * run):
        face = face_ids[view, sample]
        if face >= 0:
            received = light_at(faces[face], barycentrics[view, sample], lit, shading)
            color = wp.cw_mul(received, albedo[reflected, sample])
            samples[batch, sample] = wp.vec4(color[0], color[1], color[2], 1.0)


@wp.kernel(enable_backward=False)
def _expose_adjoint(
    first_row: int,
    worker: int,
    # in
    face_ids: wp.array2d(dtype=wp.int32),
    barycentrics: wp.array2d(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    shading: wp.array2d(dtype=wp.vec3),
    albedo: wp.array2d(dtype=wp.vec3),
    run: int,
    adj_samples: wp.array2d(dtype=wp.vec4),
    # out
    adj_barycentrics: wp.array2d(dtype=wp.vec3),
    adj_albedo: wp.array2d(dtype=wp.vec3),
    adj_shading: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a run of samples of all instances.

    With received r = Σ_k w_k s_k and color c = r a:  r̄ = c̄ a,  ā = c̄ r,  s̄_k = w_k r̄,  w̄_k = r̄ · s_k.
    """
    thread = first_row + wp.tid()
    for batch in range(adj_samples.shape[0]):
        view = instance_in(batch, face_ids.shape[0])
        lit = instance_in(batch, shading.shape[0])
        reflected = instance_in(batch, albedo.shape[0])
        for sample in range(thread * run, (thread + 1) * run):
            face = face_ids[view, sample]
            if face >= 0:
                corners = faces[face]
                weights = barycentrics[view, sample]
                adj_sample = adj_samples[batch, sample]
                adj_color = wp.vec3(adj_sample[0], adj_sample[1], adj_sample[2])
                adj_received = wp.cw_mul(adj_color, albedo[reflected, sample])
                if adj_shading:
                    wp.atomic_add(adj_shading, lit, corners[0], weights[0] * adj_received)
                    wp.atomic_add(adj_shading, lit, corners[1], weights[1] * adj_received)
                    wp.atomic_add(adj_shading, lit, corners[2], weights[2] * adj_received)
                if adj_albedo:
                    received = light_at(corners, weights, lit, shading)
                    adj_albedo[reflected, sample] = adj_albedo[reflected, sample] + wp.cw_mul(adj_color, received)
                if adj_barycentrics:
                    adj_barycentrics[view, sample] = adj_barycentrics[view, sample] + wp.vec3(
                        wp.dot(adj_received, shading[lit, corners[0]]),
                        wp.dot(adj_received, shading[lit, corners[1]]),
                        wp.dot(adj_received, shading[lit, corners[2]]),
                    )


def expose(
    fragments: Fragments, faces: wp.array, shading: wp.array, albedo: wp.array, *, at_points: bool = True
) -> wp.array:
    """Multiply the light that the samples receive, interpolated from the receivers, with what they reflect.

    Args:
        fragments: What each sample sees.
        faces: Indices of receivers, vec3i of shape [face].
        shading: Of the receivers, vec3 of shape [batch, receiver].
        albedo: Of the samples, vec3 of shape [batch, height, width].
            Any batch, that of the fragments included, may be 1 and then serves every instance.
        at_points: Whether barycentrics get their gradient, which is that of the faces at the points that samples see;
            else it is left to :func:`warpshadow.stages.slopes.pull_surfaces`.

    Returns:
        Linear RGB and coverage, 1 or 0, vec4 of shape [batch, height, width].

    Raises:
        ValueError: naming the argument, what it got and what it accepts.

    Differentiable: shading, albedo, barycentrics of the fragments.
    """
    arrays = {"fragments": fragments.face_ids, "shading": shading, "albedo": albedo}
    _, height, width = fragments.face_ids.shape
    check.shape("albedo", albedo.shape, ("batch", height, width))
    instances, device = common_batch(arrays), shading.device
    run = run_length(device, width)
    run_count, cost = height * width // run, _SAMPLE_COST * run
    factors = [*fragments.rows, faces, shading, rows(albedo), run]
    return differentiable(
        lambda samples: launch(_expose, instances * run_count, inputs=factors, outputs=[rows(samples)], cost=cost),
        lambda adj_samples: launch(
            _expose_adjoint,
            run_count,
            inputs=[*factors, rows(adj_samples)],
            outputs=[rows(fragments.barycentrics.grad) if at_points else None, rows(albedo.grad)],
            sums=[shading.grad],
            cost=2 * cost * instances,
        ),
        result=wp.zeros((instances, height, width), dtype=wp.vec4, device=device),
        variables=[fragments.barycentrics, shading, albedo],
    )


@wp.kernel
def _average(
    # in
    samples: wp.array4d(dtype=wp.vec4),
    across: int,
    # out
    pixels: wp.array2d(dtype=wp.vec4),
):
    """A thread owns a pixel: the mean of its samples."""
    row, pixel = wp.tid()
    total = wp.vec4()
    for i in range(across):
        for j in range(across):
            total += samples[row, i, pixel, j]
    pixels[row, pixel] = total / float(across * across)


def average(samples: wp.array, across: int) -> wp.array:
    """Average the samples of each pixel.

    Args:
        samples: vec4 of shape [batch, height·across, width·across].
        across: Samples of a pixel across and down.

    Returns:
        vec4 of shape [batch, height, width].

    Differentiable: samples.
    """
    if across == 1:
        return samples
    batch_count, height, width = samples.shape[0], samples.shape[1] // across, samples.shape[2] // across
    rows_of_pixels = samples.reshape((batch_count * height, across, width, across))
    pixels = wp.empty((batch_count * height, width), dtype=wp.vec4, device=samples.device)
    launch(_average, pixels.shape, inputs=[rows_of_pixels, across], outputs=[pixels])
    return pixels.reshape((batch_count, height, width))
