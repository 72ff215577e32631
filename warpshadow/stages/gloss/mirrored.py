"""Mirrored bodies: a body that a lobe meets shows its radiosity, a metal light from where its own normal mirrors.

A sample l of a lobe, of transmittance T, meets a body at a point with normal n, which mirrors l' = l − 2 (n·l) n. To
the mean radiance R̄ of the receiver's blockers the point adds

    M = (1 − T) (S − R̄),   S = m F L' + (1 − m) B,   F = a + (1 − a) (1 − |n·l|)⁵,

m how metallic it is, a its albedo, B the radiosity there (:mod:`warpshadow.stages.planes.face_texels`), and L' the
radiance from l': if a metal sends that ray to a second body (:mod:`.lobe_hits`), S of that; else R̄ where the ray meets
a body, 0 where it leaves below the face that it starts on, and L, light without shadows, where it meets the sky. L is
blurred by σ'² = σ² + 2 α² for each metal on the way, since variances of Gaussians add: σ is the blur of the sample
(:mod:`.lobes`), and √2 α the σ of a lobe's only sample, N = K = 1, seen from above, v = h = n, where |W| = α² and
μ = Λ = 1. Where l itself leaves below the receiver's face, M = −(1 − T) R̄.
"""

from typing import NamedTuple

import warp as wp

from warpshadow.device.batch import common_batch, instance_in
from warpshadow.device.launch import launch
from warpshadow.device.parallel import split_row
from warpshadow.stages.gloss.ggx import fresnel_weight
from warpshadow.stages.gloss.lobe_hits import LEAVES_BELOW, MEETS_SKY, LobeHits
from warpshadow.stages.gloss.lobes import MIN_ROUGHNESS
from warpshadow.stages.planes.face_texels import FaceTexels, no_face_texels, radiosity_at
from warpshadow.stages.raster.interpolation import interpolate_at

_COST = 20.0  # nanoseconds that a sample takes

wp.set_module_options({"max_unroll": 1})


@wp.func
def _reflect(
    direction: wp.vec3,
    square: float,
    face: int,
    weights: wp.vec3,
    normal: wp.vec3,
    faces: wp.array(dtype=wp.vec3i),
    roughness: wp.array(dtype=wp.float32),
):
    """Reflect a ray from a body: its direction, the square of its blur, and (1 − |n·l|)⁵. Without a face as it is."""
    weight_f90 = float(0.0)
    if face >= 0:
        width = wp.max(interpolate_at(roughness, faces[face], weights), MIN_ROUGHNESS)
        width = width * width
        square = square + 2.0 * width * width
        cosine = wp.dot(normal, direction)
        weight_f90 = fresnel_weight(wp.abs(cosine))
        direction = direction - 2.0 * cosine * normal
    return direction, square, weight_f90


@wp.kernel
def _mirror(
    first_row: int,
    worker: int,
    # in
    face_ids: wp.array4d(dtype=wp.int32),
    barycentrics: wp.array4d(dtype=wp.vec3),
    hit_normals: wp.array4d(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    roughness: wp.array2d(dtype=wp.float32),
    directions: wp.array3d(dtype=wp.vec3),
    blurs: wp.array3d(dtype=wp.float32),
    # out
    mirrored: wp.array3d(dtype=wp.vec3),
    fresnel_weights: wp.array4d(dtype=wp.float32),
    mirrored_blurs: wp.array3d(dtype=wp.float32),
):
    """A thread owns a sample."""
    row, sample = wp.tid()
    batch, receiver = split_row(first_row + row, mirrored.shape[1])
    hit_batch = instance_in(batch, face_ids.shape[0])
    of_vertices = roughness[instance_in(batch, roughness.shape[0])]
    blur = blurs[instance_in(batch, blurs.shape[0]), receiver, sample]
    direction, square, weight_f90 = _reflect(
        directions[instance_in(batch, directions.shape[0]), receiver, sample],
        blur * blur,
        face_ids[hit_batch, 0, receiver, sample],
        barycentrics[hit_batch, 0, receiver, sample],
        hit_normals[hit_batch, 0, receiver, sample],
        faces,
        of_vertices,
    )
    fresnel_weights[batch, 0, receiver, sample] = weight_f90
    last_direction, last_square = direction, square
    if face_ids.shape[1] > 1:
        last_direction, last_square, last_weight_f90 = _reflect(
            direction,
            square,
            face_ids[hit_batch, 1, receiver, sample],
            barycentrics[hit_batch, 1, receiver, sample],
            hit_normals[hit_batch, 1, receiver, sample],
            faces,
            of_vertices,
        )
        fresnel_weights[batch, 1, receiver, sample] = last_weight_f90
    mirrored[batch, receiver, sample] = last_direction
    mirrored_blurs[batch, receiver, sample] = wp.sqrt(last_square)


class MirroredDirections(NamedTuple):
    """Directions from which the bodies that lobes meet mirror light; samples that meet none keep their own."""

    directions: wp.array  # of the last rays, vec3 of shape [batch, receiver, sample]
    fresnel_weights: wp.array  # (1 − |n·l|)⁵ of each reflection, float32 of shape [batch, reflection, receiver, sample]
    blurs: wp.array  # σ' [radians], float32 of shape [batch, receiver, sample]


def mirror(
    hits: LobeHits, faces: wp.array, roughness: wp.array, directions: wp.array, blurs: wp.array
) -> MirroredDirections:
    """Find the directions that the points mirror.

    Args:
        hits: Of :func:`.lobe_hits.trace_hits`, of all instances.
        faces: Vertices of the sides of its faces, vec3i of shape [2 · face].
        roughness: Of the vertices, float32 of shape [batch, vertex].
        directions, blurs: Of :func:`.lobes.sample_lobes`. Any batch may be 1 and then serves every instance.

    Differentiable: roughness, directions, blurs. Not: hits, which stay where they are on their faces.
    """
    arrays = {"directions": directions, "blurs": blurs, "roughness": roughness, "hits": hits.face_ids}
    shape = common_batch(arrays), *directions.shape[1:]
    of_reflections = shape[0], *hits.face_ids.shape[1:]
    kinds = (shape, wp.vec3), (of_reflections, wp.float32), (shape, wp.float32)
    result = MirroredDirections(*(wp.empty(*kind, device=directions.device) for kind in kinds))
    of_hits = [hits.face_ids, hits.barycentrics, hits.normals]
    launch(
        _mirror,
        (shape[0] * shape[1], shape[2]),
        inputs=[*of_hits, faces, roughness, directions, blurs],
        outputs=[*result],
        shared=[roughness, *(array for array in (directions, blurs) if len(array) < shape[0])],
        cost=_COST * shape[2],
    )
    return result


@wp.func
def _shine(
    seen: wp.vec3,
    diffuse: wp.vec3,
    face: int,
    weights: wp.vec3,
    weight_f90: float,
    faces: wp.array(dtype=wp.vec3i),
    albedo: wp.array(dtype=wp.vec3),
    metallic: wp.array(dtype=wp.float32),
    radiosity: wp.array2d(dtype=wp.vec3),
    radiosity_batch: int,
    texels: FaceTexels,
):
    """Radiance S of a body that sees another; without a face that of the other. Diffuse is B if it is not known."""
    result = seen
    if face >= 0:
        color = interpolate_at(albedo, faces[face], weights)
        metal_share = interpolate_at(metallic, faces[face], weights)
        fresnel = color + weight_f90 * (wp.vec3(1.0) - color)
        if radiosity:
            diffuse = radiosity_at(radiosity[radiosity_batch], texels, faces, face, weights)
        result = metal_share * wp.cw_mul(fresnel, seen) + (1.0 - metal_share) * diffuse
    return result


@wp.kernel
def _mix_mirrored(
    first_row: int,
    worker: int,
    # in
    face_ids: wp.array4d(dtype=wp.int32),
    barycentrics: wp.array4d(dtype=wp.vec3),
    last_rays: wp.array3d(dtype=wp.int32),
    faces: wp.array(dtype=wp.vec3i),
    albedo: wp.array2d(dtype=wp.vec3),
    metallic: wp.array2d(dtype=wp.float32),
    fresnel_weights: wp.array4d(dtype=wp.float32),
    light: wp.array3d(dtype=wp.vec3),
    mean_radiance: wp.array2d(dtype=wp.vec3),
    transmittance: wp.array3d(dtype=wp.float32),
    radiosity: wp.array2d(dtype=wp.vec3),
    texels: FaceTexels,
    # out
    radiance: wp.array3d(dtype=wp.vec3),
):
    """A thread owns a sample."""
    row, sample = wp.tid()
    batch, receiver = split_row(first_row + row, radiance.shape[1])
    hit_batch = instance_in(batch, face_ids.shape[0])
    face = face_ids[hit_batch, 0, receiver, sample]
    last_ray = last_rays[hit_batch, receiver, sample]
    result = wp.vec3(0.0)
    if face >= 0 or last_ray == LEAVES_BELOW:
        fresnel_batch = instance_in(batch, fresnel_weights.shape[0])
        of_albedo = albedo[instance_in(batch, albedo.shape[0])]
        of_metallic = metallic[instance_in(batch, metallic.shape[0])]
        radiosity_batch = int(0)
        if radiosity:
            radiosity_batch = instance_in(batch, radiosity.shape[0])
        mean = mean_radiance[instance_in(batch, mean_radiance.shape[0]), receiver]
        seen = mean
        if last_ray == MEETS_SKY:
            seen = light[instance_in(batch, light.shape[0]), receiver, sample]
        if last_ray == LEAVES_BELOW:
            seen = wp.vec3()
        if face_ids.shape[1] > 1:
            seen = _shine(
                seen,
                mean,
                face_ids[hit_batch, 1, receiver, sample],
                barycentrics[hit_batch, 1, receiver, sample],
                fresnel_weights[fresnel_batch, 1, receiver, sample],
                faces,
                of_albedo,
                of_metallic,
                radiosity,
                radiosity_batch,
                texels,
            )
        seen = _shine(
            seen,
            mean,
            face,
            barycentrics[hit_batch, 0, receiver, sample],
            fresnel_weights[fresnel_batch, 0, receiver, sample],
            faces,
            of_albedo,
            of_metallic,
            radiosity,
            radiosity_batch,
            texels,
        )
        blocked = 1.0 - transmittance[instance_in(batch, transmittance.shape[0]), receiver, sample]
        result = blocked * (seen - mean)
    radiance[batch, receiver, sample] = result


def mix_mirrored(
    hits: LobeHits,
    faces: wp.array,
    albedo: wp.array,
    metallic: wp.array,
    fresnel_weights: wp.array,
    light: wp.array,
    mean_radiance: wp.array,
    transmittance: wp.array,
    radiosity: wp.array | None = None,
    texels: "FaceTexels | None" = None,
) -> wp.array:
    """Mix the radiance M that bodies add to the mean radiance of blockers in each sample.

    Args:
        hits, faces: As of :func:`mirror`.
        albedo, metallic: Of the vertices, vec3 and float32 of shape [batch, vertex].
        fresnel_weights: Of :func:`mirror`.
        light: L, vec3 of shape [batch, receiver, sample].
        mean_radiance: R̄, of :func:`.reflection.find_blocked_radiance`, vec3 of shape [batch, receiver].
        transmittance: T, float32 of shape [batch, receiver, sample].
        radiosity: B, of the texels of flat bodies and of the sides of faces, vec3 of shape [batch, texel + 2 · face];
            None for R̄.
            Any batch may be 1 and then serves every instance.
        texels: Where the faces of flat bodies are on these texels; None where no body is flat.

    Returns:
        Vec3 of shape [batch, receiver, sample].

    Differentiable: all but hits.
    """
    values = {"albedo": albedo, "metallic": metallic, "fresnel_weights": fresnel_weights, "light": light}
    values |= {"mean_radiance": mean_radiance, "transmittance": transmittance, "radiosity": radiosity}
    shape = common_batch({"hits": hits.face_ids, **values}), *light.shape[1:]
    radiance = wp.empty(shape, dtype=wp.vec3, device=light.device)
    texels = no_face_texels(light.device) if texels is None else texels
    launch(
        _mix_mirrored,
        (shape[0] * shape[1], shape[2]),
        inputs=[hits.face_ids, hits.barycentrics, hits.last_rays, faces, *values.values(), texels],
        outputs=[radiance],
        shared=[
            albedo,
            metallic,
            *(array for array in (fresnel_weights, light, mean_radiance, transmittance) if len(array) < shape[0]),
            *(array for array in (radiosity,) if array is not None),
        ],
        cost=_COST * shape[2],
    )
    return radiance
