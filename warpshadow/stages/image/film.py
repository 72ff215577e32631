"""Film: from irradiance and reflectance of the samples to color and coverage of the pixels."""

import warp as wp

from warpshadow import check
from warpshadow.device.batch import common_batch, instance_in, rows
from warpshadow.device.launch import launch, launch_with_adjoint
from warpshadow.device.memory import empty, reshaped
from warpshadow.device.parallel import run_dimensions, run_length, split_launch
from warpshadow.stages.raster.interpolation import (
    interpolate_at,
    interpolate_values_adjoint,
    interpolate_weights_adjoint,
)
from warpshadow.stages.raster.rasterization import Fragments

_COST = 5.0  # nanoseconds that a sample takes


@wp.kernel(enable_backward=False)
def _sample_radiance(
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
    light: wp.array2d(dtype=wp.vec3),
    samples: wp.array2d(dtype=wp.vec4),
):
    """A thread owns a run of samples of an instance."""
    row, column = wp.tid()
    batch, thread = split_launch(worker, first_row + row, column)
    fragment_batch = instance_in(batch, face_ids.shape[0])
    receiver_shading = shading[instance_in(batch, shading.shape[0])]
    sample_albedo = albedo[instance_in(batch, albedo.shape[0])]
    for sample in range(thread * run, (thread + 1) * run):
        face = face_ids[fragment_batch, sample]
        irradiance = wp.vec3()
        color = wp.vec4()
        if face >= 0:
            irradiance = interpolate_at(receiver_shading, faces[face], barycentrics[fragment_batch, sample])
            radiance = wp.cw_mul(irradiance, sample_albedo[sample])
            color = wp.vec4(radiance[0], radiance[1], radiance[2], 1.0)
        samples[batch, sample] = color
        if light:
            light[batch, sample] = irradiance


@wp.kernel(enable_backward=False)
def _sample_radiance_adjoint(
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
    # sums
    adj_shading: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a run of samples of an instance:  with c = a E, E = w · S,  ā += E c̄,  Ē = a c̄."""
    row, column = wp.tid()
    batch, thread = split_launch(worker, first_row + row, column)
    fragment_batch = instance_in(batch, face_ids.shape[0])
    shading_batch = instance_in(batch, shading.shape[0])
    albedo_batch = instance_in(batch, albedo.shape[0])
    receiver_shading = shading[shading_batch]
    for sample in range(thread * run, (thread + 1) * run):
        face = face_ids[fragment_batch, sample]
        if face >= 0:
            corners = faces[face]
            weights = barycentrics[fragment_batch, sample]
            adj_sample = adj_samples[batch, sample]
            adj_color = wp.vec3(adj_sample[0], adj_sample[1], adj_sample[2])
            adj_irradiance = wp.cw_mul(albedo[albedo_batch, sample], adj_color)
            if adj_shading:
                interpolate_values_adjoint(adj_shading[shading_batch], corners, weights, adj_irradiance)
            if adj_barycentrics:
                adj_weights = interpolate_weights_adjoint(receiver_shading, corners, adj_irradiance)
                wp.atomic_add(adj_barycentrics, fragment_batch, sample, adj_weights)
            if adj_albedo:
                irradiance = interpolate_at(receiver_shading, corners, weights)
                wp.atomic_add(adj_albedo, albedo_batch, sample, wp.cw_mul(irradiance, adj_color))


def sample_radiance(
    fragments: Fragments, faces: wp.array, shading: wp.array, albedo: wp.array, light: wp.array | None = None
) -> wp.array:
    """Multiply the light at the samples, interpolated from the receivers, with their reflectance.

    Where surfaces move, :func:`warpshadow.stages.image.slopes.moving_radiance` has the better gradient.

    Args:
        faces: Indices of receivers, vec3i of shape [face].
        shading: Of the receivers, vec3 of shape [batch, receiver].
        albedo: Of the samples, vec3 of shape [batch, height, width].
            Any batch, that of the fragments included, may be 1 and then serves every instance.
        light: Memory for the light at the samples, vec3 of shape [batch, sample]; None where nobody asks for it.
    Returns:
        Linear RGB and coverage, 1 or 0, vec4 of shape [batch, height, width].
    Differentiable: shading, albedo, barycentrics of the fragments.
    """
    _, height, width = fragments.face_ids.shape
    check.shape("albedo", albedo.shape, ("batch", height, width))
    count = common_batch({"fragments": fragments.face_ids, "shading": shading, "albedo": albedo})
    run = run_length(shading.device, width)
    face_ids, barycentrics = fragments.rows
    samples = launch_with_adjoint(
        _sample_radiance,
        _sample_radiance_adjoint,
        run_dimensions(shading.device, height * width // run, count),
        inputs=[face_ids, barycentrics, faces, shading, rows(albedo), run],
        outputs=[light],
        result=empty((count, height * width), dtype=wp.vec4, device=shading.device),
        variables=[barycentrics, rows(albedo)],
        shared=[shading],
        cost=_COST * run,
    )
    return reshaped(samples, (count, height, width))


@wp.kernel
def _sum_radiance(
    # in
    first: wp.array2d(dtype=wp.vec4),
    second: wp.array2d(dtype=wp.vec4),
    # out
    sums: wp.array2d(dtype=wp.vec4),
):
    """A thread owns a sample."""
    batch, sample = wp.tid()
    first_radiance = first[instance_in(batch, first.shape[0]), sample]
    second_radiance = second[instance_in(batch, second.shape[0]), sample]
    sums[batch, sample] = wp.vec4(
        first_radiance[0] + second_radiance[0],
        first_radiance[1] + second_radiance[1],
        first_radiance[2] + second_radiance[2],
        first_radiance[3],
    )


def sum_radiance(first: wp.array, second: wp.array) -> wp.array:
    """Add the radiance of two kinds of light from the same surfaces.

    Args:
        first, second: Linear RGB and coverage, vec4 of the same shape but for a batch of 1.

    Returns:
        The sum, with the coverage of the first.

    Differentiable: first, second.
    """
    if not first.size:
        return first
    batch_count = common_batch({"first": first, "second": second})
    sums = empty((batch_count, first[0].size), dtype=wp.vec4, device=first.device)
    launch(_sum_radiance, sums.shape, inputs=[rows(first), rows(second)], outputs=[sums])
    return reshaped(sums, (batch_count, *first.shape[1:]))


@wp.kernel
def _average(
    # in
    samples: wp.array4d(dtype=wp.vec4),
    supersampling: int,
    # out
    pixels: wp.array2d(dtype=wp.vec4),
):
    """A thread owns a pixel: the mean of its samples."""
    row, pixel = wp.tid()
    total = wp.vec4()
    for i in range(supersampling):
        for j in range(supersampling):
            total += samples[row, i, pixel, j]
    pixels[row, pixel] = total / float(supersampling * supersampling)


def average(samples: wp.array, supersampling: int) -> wp.array:
    """Average the samples of each pixel.

    Args:
        samples: vec4 of shape [batch, height·supersampling, width·supersampling].
        supersampling: Samples of a pixel across and down.
    Returns:
        vec4 of shape [batch, height, width].
    Differentiable: samples.
    """
    if supersampling == 1:
        return samples
    batch_count, height, width = samples.shape[0], samples.shape[1] // supersampling, samples.shape[2] // supersampling
    pixels = empty((batch_count * height, width), dtype=wp.vec4, device=samples.device)
    sample_grid = reshaped(samples, (batch_count * height, supersampling, width, supersampling))
    launch(_average, pixels.shape, inputs=[sample_grid, supersampling], outputs=[pixels])
    return reshaped(pixels, (batch_count, height, width))
