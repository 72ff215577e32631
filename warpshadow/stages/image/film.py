"""Film: from irradiance and reflectance of the samples to color and coverage of the pixels."""

import warp as wp

from warpshadow import check
from warpshadow.device.batch import common_batch, instance_in, rows
from warpshadow.device.launch import launch
from warpshadow.device.memory import empty, reshaped
from warpshadow.device.parallel import run_dimensions, run_length, split_launch
from warpshadow.stages.raster.interpolation import interpolate_at
from warpshadow.stages.raster.rasterization import Fragments

_COST = 5.0  # nanoseconds that a sample takes


@wp.kernel
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
        if face >= 0:
            irradiance = interpolate_at(receiver_shading, faces[face], barycentrics[fragment_batch, sample])
            radiance = wp.cw_mul(irradiance, sample_albedo[sample])
            samples[batch, sample] = wp.vec4(radiance[0], radiance[1], radiance[2], 1.0)
        else:
            samples[batch, sample] = wp.vec4()


def sample_radiance(fragments: Fragments, faces: wp.array, shading: wp.array, albedo: wp.array) -> wp.array:
    """Multiply the light at the samples, interpolated from the receivers, with their reflectance.

    Where surfaces move, :func:`warpshadow.stages.image.slopes.moving_radiance` has the better gradient.

    Args:
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
    samples = empty((count, height * width), dtype=wp.vec4, device=shading.device)
    launch(
        _sample_radiance,
        run_dimensions(shading.device, height * width // run, count),
        cost=_COST * run,
        inputs=[*fragments.rows, faces, shading, rows(albedo), run],
        outputs=[samples],
        shared=[shading],
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
