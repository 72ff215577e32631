"""Film: from what the samples of an image receive and reflect to the color and coverage of its pixels."""

import warp as wp

from warpshadow import check
from warpshadow.device.batch import common_batch, instance_in, rows
from warpshadow.device.launch import differentiable, launch
from warpshadow.device.parallel import run_length, split_row
from warpshadow.stages.interpolate import add_to_corners, adj_weights, at_point
from warpshadow.stages.rasterize import Fragments

_COST, _ADJOINT_COST = 5.0, 10.0
"""Nanoseconds that a sample takes."""


@wp.kernel(enable_backward=False)
def _radiance(
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
    of_receivers = shading[instance_in(batch, shading.shape[0])]
    of_samples = albedo[instance_in(batch, albedo.shape[0])]
    for sample in range(thread * run, (thread + 1) * run):
        face = face_ids[view, sample]
        if face >= 0:
            received = at_point(of_receivers, faces[face], barycentrics[view, sample])
            color = wp.cw_mul(received, of_samples[sample])
            samples[batch, sample] = wp.vec4(color[0], color[1], color[2], 1.0)


@wp.kernel(enable_backward=False)
def _radiance_adjoint(
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

    With received light r and color c = r a:  r̄ = c̄ a,  ā = c̄ r.
    """
    thread = first_row + wp.tid()
    for batch in range(adj_samples.shape[0]):
        view = instance_in(batch, face_ids.shape[0])
        row = instance_in(batch, shading.shape[0])
        reflecting = instance_in(batch, albedo.shape[0])
        of_receivers = shading[row]
        for sample in range(thread * run, (thread + 1) * run):
            face = face_ids[view, sample]
            if face >= 0:
                corners = faces[face]
                weights = barycentrics[view, sample]
                adj_sample = adj_samples[batch, sample]
                adj_color = wp.vec3(adj_sample[0], adj_sample[1], adj_sample[2])
                adj_received = wp.cw_mul(adj_color, albedo[reflecting, sample])
                if adj_shading:
                    add_to_corners(adj_shading[row], corners, weights, adj_received)
                if adj_albedo:
                    by_albedo = wp.cw_mul(adj_color, at_point(of_receivers, corners, weights))
                    adj_albedo[reflecting, sample] = adj_albedo[reflecting, sample] + by_albedo
                if adj_barycentrics:
                    by_weights = adj_weights(of_receivers, corners, adj_received)
                    adj_barycentrics[view, sample] = adj_barycentrics[view, sample] + by_weights


def sample_radiance(fragments: Fragments, faces: wp.array, shading: wp.array, albedo: wp.array) -> wp.array:
    """Multiply the light that the samples receive, interpolated from the receivers, with what they reflect.

    Where surfaces move, :func:`warpshadow.stages.slopes.moving_radiance` has the better gradient.

    Args:
        fragments: What each sample sees.
        faces: Indices of receivers, vec3i of shape [face].
        shading: Of the receivers, vec3 of shape [batch, receiver].
        albedo: Of the samples, vec3 of shape [batch, height, width].
            Any batch, that of the fragments included, may be 1 and then serves every instance.

    Returns:
        Linear RGB and coverage, 1 or 0, vec4 of shape [batch, height, width].

    Differentiable: shading, albedo, barycentrics of the fragments.
    """
    _, height, width = fragments.face_ids.shape
    check.shape("albedo", albedo.shape, ("batch", height, width))
    count = common_batch({"fragments": fragments.face_ids, "shading": shading, "albedo": albedo})
    run = run_length(shading.device, width)
    run_count = height * width // run
    inputs = [*fragments.rows, faces, shading, rows(albedo), run]
    return differentiable(
        lambda samples: launch(_radiance, count * run_count, cost=_COST * run, inputs=inputs, outputs=[rows(samples)]),
        lambda adj_samples: launch(
            _radiance_adjoint,
            run_count,
            cost=_ADJOINT_COST * run * count,
            inputs=[*inputs, rows(adj_samples)],
            outputs=[rows(fragments.barycentrics.grad), rows(albedo.grad)],
            sums=[shading.grad],
        ),
        result=wp.zeros((count, height, width), dtype=wp.vec4, device=shading.device),
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
    pixels = wp.empty((batch_count * height, width), dtype=wp.vec4, device=samples.device)
    parts = samples.reshape((batch_count * height, across, width, across))
    launch(_average, pixels.shape, inputs=[parts, across], outputs=[pixels])
    return pixels.reshape((batch_count, height, width))
