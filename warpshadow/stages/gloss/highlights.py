"""Highlights: the light of emitters in the lobes of receivers, a sum over their samples.

A sample k of an emitter (:mod:`.emitters.samples`) fills a solid angle Ω_k around ω_k, with the radiance L_k and the
transmittance T_k on the way. With c_k = n·ω_k and the reflection f of :mod:`.ggx` it adds to a lobe's light G and G'

    f c_k Ω_k T_k L_k,   f c_k Ω_k T_k L_k (1 − v·h)⁵,   α_k² = α² + Ω_k / (4π)

A sample is a disc of the radius ρ = √(Ω / π), so the mirrors that reflect it to the viewer spread by about ρ / 2: by so
much f is wider, as the reflected image of an area light is in [Karis 2013, Real Shading in Unreal Engine 4]. Then
samples of a lamp that a smooth surface mirrors run together.
"""

import warp as wp

from warpshadow import check
from warpshadow.device.batch import common_batch, expand, expand_rows, instance_in
from warpshadow.device.launch import launch
from warpshadow.device.memory import empty
from warpshadow.device.parallel import split_row
from warpshadow.stages.emitters.samples import EmitterSpan, PlacedSamples, facing_area, may_light, sample_transmittance
from warpshadow.stages.gloss.ggx import fresnel_weight, specular_brdf
from warpshadow.stages.gloss.lobes import MAX_COSINE, MIN_COSINE, MIN_ROUGHNESS
from warpshadow.stages.gloss.reflection import LobeLight
from warpshadow.stages.raster.project import eye_position

_COST = 20.0  # nanoseconds that a sample takes

wp.set_module_options({"max_unroll": 1})


@wp.kernel
def _sum_highlights(
    first_row: int,
    worker: int,
    # in
    points: wp.array2d(dtype=wp.vec3),
    normals: wp.array2d(dtype=wp.vec3),
    roughness: wp.array2d(dtype=wp.float32),
    clip_matrices: wp.array(dtype=wp.mat44),
    sample_points: wp.array2d(dtype=wp.vec3),
    sample_areas: wp.array2d(dtype=wp.vec3),
    softness: wp.array(dtype=wp.float32),
    radiance: wp.array2d(dtype=wp.vec3),
    first_sample: int,
    sample_count: int,
    is_two_sided: int,
    transmittance: wp.array3d(dtype=wp.float32),
    # out
    light_f0: wp.array2d(dtype=wp.vec3),
    light_f90: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a receiver of an instance: G and G'."""
    batch, receiver = split_row(first_row + wp.tid(), light_f0.shape[1])
    point = points[batch, receiver]
    normal = normals[batch, receiver]
    eye = eye_position(clip_matrices[instance_in(batch, clip_matrices.shape[0])])
    view = wp.normalize(eye - point)
    view_cosine = wp.clamp(wp.dot(normal, view), MIN_COSINE, MAX_COSINE)
    rough = wp.max(roughness[instance_in(batch, roughness.shape[0]), receiver], MIN_ROUGHNESS)
    sample_batch = instance_in(batch, sample_points.shape[0])
    radiance_batch = instance_in(batch, radiance.shape[0])
    sum_f0 = wp.vec3()
    sum_f90 = wp.vec3()
    for i in range(sample_count):
        beam = sample_points[sample_batch, first_sample + i] - point
        area = sample_areas[sample_batch, first_sample + i]
        if wp.dot(beam, normal) > 0.0 and may_light(beam, area, normal, is_two_sided):
            distance2 = wp.length_sq(beam)
            distance = wp.sqrt(distance2)
            # pi d² facing / √(π² d⁴ + |A|²), as for diffuse light
            solid_angle = wp.pi * facing_area(beam, area, softness[first_sample + i], is_two_sided) / distance
            solid_angle = solid_angle / wp.sqrt(wp.pi * wp.pi * distance2 * distance2 + wp.length_sq(area))
            cosine = wp.dot(beam, normal) / distance
            mirror = wp.normalize(view + beam / distance)
            square = wp.min(rough * rough * rough * rough + solid_angle / (4.0 * wp.pi), 1.0)
            weight = cosine * solid_angle * sample_transmittance(transmittance, batch, receiver, i)
            weight = weight * specular_brdf(wp.dot(normal, mirror), cosine, view_cosine, square)
            light = weight * radiance[radiance_batch, first_sample + i]
            sum_f0 += light
            sum_f90 += fresnel_weight(wp.dot(view, mirror)) * light
    light_f0[batch, receiver] = sum_f0
    light_f90[batch, receiver] = sum_f90


def sum_highlights(
    points: wp.array,
    normals: wp.array,
    roughness: wp.array,
    clip_matrices: wp.array,
    samples: PlacedSamples,
    radiance: wp.array,
    span: EmitterSpan,
    transmittance: wp.array | None = None,
) -> LobeLight:
    """Light of an emitter in the lobes of receivers.

    Args:
        points: Receivers [scene units], vec3 of shape [batch, receiver].
        normals: Their unit normals, vec3 of shape [batch, receiver].
        roughness: Float32 of shape [batch, receiver].
        clip_matrices: Cameras, mat44 of shape [batch].
        samples, radiance, span, transmittance: As for :func:`warpshadow.stages.emitters.light.sum_light`. Any batch may
            be 1.
    Differentiable: all but span.
    """
    check.shape("roughness", roughness.shape, ("batch", points.shape[1]))
    arrays = {"points": points, "normals": normals, "roughness": roughness, "clip_matrices": clip_matrices}
    arrays |= {"emitters": samples.points, "emission": radiance, "transmittance": transmittance}
    count = common_batch(arrays)
    points, normals, roughness = (expand(array, count) for array in (points, normals, roughness))
    sums = [empty((count, points.shape[1]), dtype=wp.vec3, device=points.device) for _ in range(2)]
    launch(
        _sum_highlights,
        count * points.shape[1],
        inputs=[
            *(
                points,
                normals,
                roughness,
                clip_matrices,
                samples.points,
                samples.areas,
                samples.pieces.softness,
                radiance,
            ),
            *(span.first, span.size, int(span.is_two_sided)),
            None if transmittance is None else expand_rows(transmittance, count),
        ],
        outputs=sums,
        shared=[clip_matrices, samples.points, samples.areas, radiance],
        cost=_COST * span.size,
    )
    return LobeLight(*sums)
