"""Light of emitters on receivers: a sum over samples.

    E(x) = Σ_k L_k T_k max(n·ω_k, 0) max(−A_k·ω_k, 0) / √(π² d_k⁴ + |A_k|²)

L_k is the radiance of sample k, A_k its area vector, d_k and ω_k the distance and the direction to its middle, T_k the
transmittance on the way past spheres, planes, convex parts, the receiver's own body and the emitter's. E is over π, as
all shading is. The root is π d² but for receivers closer to a sample than samples are to each other, where nothing
becomes infinite. (A disc on its axis has π d² + |A| instead; samples are beside each other.) An open body sends light
to both sides: |A_k·ω_k| is in place of the maximum.

Receivers closer than about three times its half diagonal see a sample as its pieces, triangles whose
form factors (:mod:`.triangles`) are in place of the fraction.
"""

import numpy as np
import warp as wp

from warpshadow.device.batch import common_batch, expand, expand_rows, instance_in
from warpshadow.device.launch import launch
from warpshadow.device.memory import empty
from warpshadow.device.parallel import split_row
from warpshadow.stages.emitters.samples import EmitterSpan, PlacedSamples, facing_area, may_light, sample_transmittance
from warpshadow.stages.emitters.triangles import form_factor_of_triangle

_COST = 6.0  # nanoseconds that a sample takes

wp.set_module_options({"max_unroll": 1})


@wp.kernel
def _find_directions(
    # in
    points: wp.array2d(dtype=wp.vec3),
    sample_points: wp.array2d(dtype=wp.vec3),
    first_sample: int,
    # out
    directions: wp.array3d(dtype=wp.vec3),
):
    """A thread owns a receiver and a sample."""
    batch, receiver, i = wp.tid()
    sample_point = sample_points[instance_in(batch, sample_points.shape[0]), first_sample + i]
    directions[batch, receiver, i] = wp.normalize(sample_point - points[instance_in(batch, points.shape[0]), receiver])


def find_directions_to_samples(points: wp.array, samples: PlacedSamples, span: EmitterSpan) -> wp.array:
    """Unit vectors from receivers to the samples of an emitter, vec3 of shape [batch, receiver, sample].

    Differentiable: points, samples.
    """
    count = common_batch({"points": points, "emitters": samples.points})
    directions = empty((count, points.shape[1], span.size), dtype=wp.vec3, device=points.device)
    launch(_find_directions, directions.shape, inputs=[points, samples.points, span.first], outputs=[directions])
    return directions


@wp.kernel
def _multiply_transmittances(
    first_row: int,
    worker: int,
    # in
    log_of_spheres: wp.array3d(dtype=wp.float32),
    log_of_planes: wp.array3d(dtype=wp.float32),
    log_of_parts: wp.array3d(dtype=wp.float32),
    transmittance_self: wp.array3d(dtype=wp.float32),
    transmittance_of_emitter: wp.array3d(dtype=wp.float32),
    # out
    transmittance: wp.array3d(dtype=wp.float32),
):
    """A thread owns a receiver of an instance."""
    batch, receiver = split_row(first_row + wp.tid(), transmittance.shape[1])
    for i in range(transmittance.shape[2]):
        exponent = float(0.0)
        if log_of_spheres:
            exponent += log_of_spheres[batch, receiver, i]
        if log_of_planes:
            exponent += log_of_planes[batch, receiver, i]
        if log_of_parts:
            exponent += log_of_parts[batch, receiver, i]
        product = wp.exp(exponent) * sample_transmittance(transmittance_self, batch, receiver, i)
        transmittance[batch, receiver, i] = product * sample_transmittance(transmittance_of_emitter, batch, receiver, i)


def find_transmittance_to_samples(
    *,
    log_of_spheres: wp.array | None = None,
    log_of_planes: wp.array | None = None,
    log_of_parts: wp.array | None = None,
    transmittance_self: wp.array | None = None,
    transmittance_of_emitter: wp.array | None = None,
) -> wp.array | None:
    """Transmittance to the samples of an emitter past all that blocks; None where nothing does.

    Args:
        log_of_spheres, log_of_planes, log_of_parts: Logarithms of transmittance, float32 of shape [batch, receiver,
            sample].
        transmittance_self, transmittance_of_emitter: Transmittance past the receivers' own body and past the emitter's,
            of the same shape. Any batch may be 1; None where nothing blocks.
    Returns:
        Of the same shape.
    Differentiable: all.
    """
    factors = {"spheres": log_of_spheres, "planes": log_of_planes, "parts": log_of_parts}
    factors |= {"own body": transmittance_self, "emitter": transmittance_of_emitter}
    first = next((item for item in factors.values() if item is not None), None)
    if first is None:
        return None
    count = common_batch(factors)
    transmittance = empty((count, *first.shape[1:]), dtype=wp.float32, device=first.device)
    launch(
        _multiply_transmittances,
        count * first.shape[1],
        inputs=[None if item is None else expand_rows(item, count) for item in factors.values()],
        outputs=[transmittance],
        cost=_COST * first.shape[2],
    )
    return transmittance


@wp.kernel
def _replace_instances(
    # in
    transmittance: wp.array3d(dtype=wp.float32),
    replacement: wp.array3d(dtype=wp.float32),
    is_replaced: wp.array(dtype=wp.int32),
    # out
    replaced: wp.array3d(dtype=wp.float32),
):
    """A thread owns a receiver and a sample."""
    batch, receiver, i = wp.tid()
    if is_replaced[instance_in(batch, is_replaced.shape[0])] == 1:
        replaced[batch, receiver, i] = replacement[instance_in(batch, replacement.shape[0]), receiver, i]
    else:
        replaced[batch, receiver, i] = transmittance[instance_in(batch, transmittance.shape[0]), receiver, i]


def replace_instances(transmittance: wp.array | None, replacement: wp.array, is_replaced: np.ndarray) -> wp.array:
    """Replace transmittance, float32 of shape [batch, receiver, sample], in some instances, bool of shape [batch].

    Without any transmittance the replacement is taken everywhere. Differentiable: transmittance, replacement.
    """
    if transmittance is None:
        return replacement
    count = common_batch({"cells": transmittance, "rays": replacement})
    replaced = empty((count, *replacement.shape[1:]), dtype=wp.float32, device=replacement.device)
    flags = wp.array(is_replaced, dtype=wp.int32, device=replacement.device)
    launch(_replace_instances, replaced.shape, inputs=[transmittance, replacement, flags], outputs=[replaced])
    return replaced


@wp.func
def weight_of_pieces(beam: wp.vec3, area: wp.vec3, elongation: float, normal: wp.vec3):
    """Weight of a sample's pieces in its light: 1 up to 1.9 half diagonals away, 0 from 4 on.

    It falls to 0, too, as the sample's middle sinks from √|A| / 2 to √|A| below the receiver's horizon.
    """
    size = wp.length(area)
    near = 1.0 - wp.smoothstep(3.5, 16.0, wp.length_sq(beam) / (elongation * size))
    return near * wp.smoothstep(-1.0, -0.5, wp.dot(beam, normal) / wp.sqrt(size))


@wp.func
def _light_of_pieces(
    point: wp.vec3,
    normal: wp.vec3,
    corners: wp.array2d(dtype=wp.vec3),
    batch: int,
    first: int,
    end: int,
    is_two_sided: int,
):
    """Form factors of the pieces of a sample, added up."""
    total = float(0.0)
    for piece in range(first, end):
        a = corners[batch, 3 * piece] - point
        b = corners[batch, 3 * piece + 1] - point
        c = corners[batch, 3 * piece + 2] - point
        factor = form_factor_of_triangle(a, b, c, normal)
        total += wp.where(is_two_sided == 1, wp.abs(factor), wp.max(factor, 0.0))
    return total


@wp.kernel
def _sum_light(
    first_row: int,
    worker: int,
    # in
    points: wp.array2d(dtype=wp.vec3),
    normals: wp.array2d(dtype=wp.vec3),
    sample_points: wp.array2d(dtype=wp.vec3),
    sample_areas: wp.array2d(dtype=wp.vec3),
    corners: wp.array2d(dtype=wp.vec3),
    first_pieces: wp.array(dtype=wp.int32),
    elongations: wp.array(dtype=wp.float32),
    softness: wp.array(dtype=wp.float32),
    radiance: wp.array2d(dtype=wp.vec3),
    first_sample: int,
    sample_count: int,
    is_two_sided: int,
    transmittance: wp.array3d(dtype=wp.float32),
    # out
    light: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a receiver of an instance."""
    batch, receiver = split_row(first_row + wp.tid(), light.shape[1])
    point = points[batch, receiver]
    normal = normals[batch, receiver]
    sample_batch = instance_in(batch, sample_points.shape[0])
    radiance_batch = instance_in(batch, radiance.shape[0])
    total = wp.vec3()
    for i in range(sample_count):
        beam = sample_points[sample_batch, first_sample + i] - point
        area = sample_areas[sample_batch, first_sample + i]
        if may_light(beam, area, normal, is_two_sided):
            distance2 = wp.length_sq(beam)
            factor = wp.max(wp.dot(beam, normal), 0.0) * facing_area(
                beam, area, softness[first_sample + i], is_two_sided
            )
            factor = factor / (distance2 * wp.sqrt(wp.pi * wp.pi * distance2 * distance2 + wp.length_sq(area)))
            near = weight_of_pieces(beam, area, elongations[first_sample + i], normal)
            if near > 0.0:
                factor = factor * (1.0 - near)
                factor += near * _light_of_pieces(
                    point,
                    normal,
                    corners,
                    sample_batch,
                    first_pieces[first_sample + i],
                    first_pieces[first_sample + i + 1],
                    is_two_sided,
                )
            total += (
                factor
                * sample_transmittance(transmittance, batch, receiver, i)
                * radiance[radiance_batch, first_sample + i]
            )
    light[batch, receiver] = total


def sum_light(
    points: wp.array,
    normals: wp.array,
    samples: PlacedSamples,
    radiance: wp.array,
    span: EmitterSpan,
    transmittance: wp.array | None = None,
) -> wp.array:
    """Light of an emitter on receivers.

    Args:
        points, normals: Receivers [scene units] and their unit normals, vec3 of shape [batch, receiver].
        radiance: Of the samples, linear RGB, vec3 of shape [batch, sample].
        transmittance: To these, float32 of shape [batch, receiver, sample]; None for 1. Any batch may be 1.
    Returns:
        vec3 of shape [batch, receiver].
    Differentiable: points, normals, samples, radiance, transmittance.
    """
    arrays = {"points": points, "normals": normals, "emitters": samples.points, "emission": radiance}
    count = common_batch(arrays | {"transmittance": transmittance})
    points, normals = expand(points, count), expand(normals, count)
    light = empty((count, points.shape[1]), dtype=wp.vec3, device=points.device)
    launch(
        _sum_light,
        count * points.shape[1],
        inputs=[
            *(
                points,
                normals,
                samples.points,
                samples.areas,
                samples.corners,
                samples.pieces.first,
                samples.pieces.elongations,
                samples.pieces.softness,
                radiance,
                span.first,
                span.size,
            ),
            int(span.is_two_sided),
            None if transmittance is None else expand_rows(transmittance, count),
        ],
        outputs=[light],
        shared=[samples.points, samples.areas, samples.corners, radiance],
        cost=_COST * span.size,
    )
    return light
