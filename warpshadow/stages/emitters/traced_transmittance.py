"""Emitters and rays: the transmittance between receivers and samples, and, for paths, light of points of the surfaces.

A point y of a face is drawn in proportion to area and mean radiance, with the density p. On average a receiver gets

    L(y) V max(n·ω, 0) max(−m·ω, 0) / (π d² p)               [Shirley et al. 1996, "Monte Carlo Techniques for Direct
                                                              Lighting Calculations"]

m the normal of the face; of an open body |m·ω| counts.
"""

from typing import NamedTuple

import numpy as np
import warp as wp

from warpshadow.device.constants import constant
from warpshadow.device.launch import launch
from warpshadow.device.memory import empty
from warpshadow.maths.adjacency import area_normals
from warpshadow.stages.emitters.samples import SURFACE_POINTS, EmitterSamples, EmitterSpan, may_light
from warpshadow.stages.emitters.spot_cones import spot_falloff
from warpshadow.stages.raster.interpolation import interpolate_at
from warpshadow.stages.rays.ray_tracing import RAY_COST, mesh_id, progress_slices, sees_point
from warpshadow.stages.textures.pyramid import Textures
from warpshadow.stages.textures.sample import interpolate_uv

_SEED = 43

_GOLDEN_SHARE = (5**0.5 - 1) / 2
"""Part of a sample's points by which the first ray to the next sample goes further, so that rays to near samples
differ."""

_POWER_POINTS = 64  # of a face, at which its texture tells how often it is drawn
_LEAST_POWER = 0.1  # of its texture's mean radiance, that a face counts beside: those points may miss its bright ones


@wp.struct
class EmittingFaces:
    """The faces of emitters, one instance."""

    faces: wp.array(dtype=wp.vec3i)  # [emitting face]
    is_two_sided: wp.array(dtype=wp.int32)  # [emitting face]
    distribution: wp.array(dtype=wp.float32)  # sums of their probabilities, [emitting face]
    positions: wp.array(dtype=wp.vec3)  # of all vertices
    emission: wp.array(dtype=wp.vec3)  # of all vertices
    texels: wp.array(dtype=wp.vec3)  # of all textures of emission
    levels: wp.array2d(dtype=wp.vec3i)
    texture_of_face: wp.array(dtype=wp.int32)  # [emitting face], -1 for none
    uvs: wp.array(dtype=wp.vec2)
    uv_faces: wp.array(dtype=wp.vec3i)  # [emitting face]
    axes: wp.array(dtype=wp.vec3)  # of their beams, [emitting face], or none
    beams: wp.array(dtype=wp.vec2)


class EmissionTextures(NamedTuple):
    """Textures of the radiance of emitting faces, of one instance."""

    textures: Textures
    texture_of_face: wp.array  # int32 of shape [emitting face], -1 for none
    uvs: wp.array  # vec2 of shape [uv]
    uv_faces: wp.array  # vec3i of shape [emitting face]


class FaceBeams(NamedTuple):
    """Beams of emitting faces, of one instance."""

    axes: np.ndarray  # [emitting face, 3]
    beams: np.ndarray  # [emitting face, 2]


def emitting_faces(
    positions: wp.array,
    emission: wp.array,
    faces: wp.array,
    is_two_sided: np.ndarray,
    textures: EmissionTextures | None = None,
    beams: FaceBeams | None = None,
) -> EmittingFaces:
    """Prepare the faces of emitters.

    Args:
        positions: Of all vertices [scene units], vec3 of shape [vertex].
        emission: Radiance of all vertices, vec3 of shape [vertex].
        faces: That emit, vec3i of shape [face].
        is_two_sided: Whether their bodies are open, bool of shape [face].
        textures: Of radiance, in place of that of vertices; None for none.
        beams: Of the faces; None where none has one.
    """
    result = EmittingFaces()
    result.positions, result.emission, result.faces = positions, emission, faces
    corner_ids, device = faces.numpy(), positions.device
    corners = positions.numpy().astype(np.float64)[corner_ids]
    areas = np.linalg.norm(area_normals(corners), axis=1) / 2
    radiance = emission.numpy()[corner_ids].mean(axis=(1, 2))
    result.texture_of_face = constant(np.full(len(corner_ids), -1), wp.int32, device)
    if textures is not None:
        result.texels, result.levels = textures.textures.texels[0], textures.textures.levels
        result.texture_of_face, result.uvs, result.uv_faces = textures[1:]
        radiance = radiance + _mean_radiance(textures)
    if beams is not None:
        result.axes = wp.array(beams.axes, dtype=wp.vec3, device=device)
        result.beams = wp.array(beams.beams, dtype=wp.vec2, device=device)
    power = areas * radiance
    sums = np.cumsum(power)
    has_power = bool(len(sums) and sums[-1] > 0)
    result.distribution = wp.array(sums / sums[-1] if has_power else [], dtype=wp.float32, device=device)
    result.is_two_sided = wp.array(is_two_sided.astype(np.int32), dtype=wp.int32, device=device)
    return result


def _mean_radiance(textures: EmissionTextures) -> np.ndarray:
    """Estimate the mean radiance of textured faces, by which faces are drawn: above 0 where the texture is."""
    texture_of_face, uvs, uv_faces = (item.numpy() for item in textures[1:])
    texels, levels = textures.textures.texels.numpy()[0].mean(axis=1), textures.textures.levels.numpy()
    radiance = np.zeros(len(texture_of_face))
    draw = np.random.default_rng(0)
    for number, (first, width, height) in enumerate(levels[:, 0].tolist()):
        image = texels[first : first + width * height].reshape(height, width)
        corners = uvs[uv_faces[texture_of_face == number]].astype(np.float64)
        u, v = np.moveaxis(draw.dirichlet((1, 1, 1), _POWER_POINTS) @ corners % 1, -1, 0)
        columns, lines = (u * width).astype(int) % width, ((1 - v) * height).astype(int) % height
        radiance[texture_of_face == number] = image[lines, columns].mean(axis=1) + _LEAST_POWER * image.mean()
    return radiance


@wp.func
def light_of_point(
    emitters: EmittingFaces, mesh: wp.uint64, point: wp.vec3, normal: wp.vec3, choice: float, u: float, v: float
):
    """Light of a point of the emitters on a receiver over the point's density, given three numbers even in [0, 1)."""
    index = wp.lower_bound(emitters.distribution, choice)
    index = wp.min(index, emitters.distribution.shape[0] - 1)
    probability = emitters.distribution[index]
    if index > 0:
        probability -= emitters.distribution[index - 1]
    corners = emitters.faces[index]
    root = wp.sqrt(u)
    weights = wp.vec3(1.0 - root, root * (1.0 - v), root * v)
    a = emitters.positions[corners[0]]
    area_vector = 0.5 * wp.cross(emitters.positions[corners[1]] - a, emitters.positions[corners[2]] - a)
    beam = interpolate_at(emitters.positions, corners, weights) - point
    distance = wp.length(beam)
    ray_direction = wp.normalize(beam)  # 0 at distance 0, which faces nothing
    facing_area = -wp.dot(ray_direction, area_vector)
    if emitters.is_two_sided[index] == 1:
        facing_area = wp.abs(facing_area)
    cosine = wp.dot(ray_direction, normal)
    light = wp.vec3()
    is_facing = facing_area > 0.0 and cosine > 0.0 and probability > 0.0
    if is_facing and sees_point(mesh, point, normal, ray_direction, distance):
        texture = emitters.texture_of_face[index]
        radiance = wp.vec3()
        if texture < 0:
            radiance = interpolate_at(emitters.emission, corners, weights)
        else:
            uv = interpolate_at(emitters.uvs, emitters.uv_faces[index], weights)
            radiance = interpolate_uv(emitters.texels, emitters.levels[texture, 0], uv)
        light = cosine * (facing_area / (distance * distance)) / (wp.pi * probability) * radiance
        if emitters.axes.shape[0] > 0:
            axis = wp.normalize(emitters.axes[index])
            light = spot_falloff(axis, -ray_direction, emitters.beams[index]) * light
    return light


@wp.struct
class EmitterSurface:
    """The points of the samples of emitters to which rays go, one instance."""

    positions: wp.array(dtype=wp.vec3)  # of all vertices
    faces: wp.array(dtype=wp.vec3i)  # [emitting face]
    point_faces: wp.array2d(dtype=wp.int32)  # [sample, point]
    point_weights: wp.array2d(dtype=wp.vec3)


@wp.func
def _beam_to_point(
    surface: EmitterSurface, sample: int, index: int, point: wp.vec3, normal: wp.vec3, is_two_sided: int
):
    """The way from a receiver to a point of a sample, and how much this faces it, above 0 if both face each other."""
    corners = surface.faces[surface.point_faces[sample, index]]
    a = surface.positions[corners[0]]
    face_normal = wp.normalize(wp.cross(surface.positions[corners[1]] - a, surface.positions[corners[2]] - a))
    beam = interpolate_at(surface.positions, corners, surface.point_weights[sample, index]) - point
    facing = -wp.dot(wp.normalize(beam), face_normal)
    if is_two_sided == 1:
        facing = wp.abs(facing)
    if wp.dot(beam, normal) <= 0.0:
        facing = 0.0
    return beam, facing


@wp.func
def _beam_to_facing_point(
    surface: EmitterSurface, sample: int, start: int, point: wp.vec3, normal: wp.vec3, is_two_sided: int
):
    """Beam and facing of the first point, from ``start`` on, that faces the receiver above its horizon."""
    point_count = surface.point_faces.shape[1]
    beam = wp.vec3()
    facing = float(0.0)
    for k in range(point_count):
        if facing <= 0.0:
            beam, facing = _beam_to_point(surface, sample, (start + k) % point_count, point, normal, is_two_sided)
    return beam, facing


@wp.kernel(enable_backward=False)
def _trace_transmittance(
    first_row: int,
    worker: int,
    # in
    mesh: wp.uint64,
    points: wp.array(dtype=wp.vec3),
    normals: wp.array(dtype=wp.vec3),
    first_receiver: int,
    sample_points: wp.array(dtype=wp.vec3),
    sample_areas: wp.array(dtype=wp.vec3),
    surface: EmitterSurface,
    first_sample: int,
    is_two_sided: int,
    ray_counts: wp.array(dtype=wp.int32),
    # out
    transmittance: wp.array2d(dtype=wp.float32),
):
    """A thread owns a receiver."""
    receiver = first_row + wp.tid()
    turn = wp.randf(wp.rand_init(_SEED, first_receiver + receiver))
    point = points[receiver]
    normal = normals[receiver]
    for i in range(transmittance.shape[1]):
        sample = first_sample + i
        is_sending = may_light(sample_points[sample] - point, sample_areas[sample], normal, is_two_sided)
        open_weight = float(0.0)
        total_weight = float(0.0)
        point_count = surface.point_faces.shape[1]
        first_point = int(float(point_count) * wp.frac(turn + _GOLDEN_SHARE * float(i)))
        ray_count = ray_counts[i]
        for ray in range(wp.where(is_sending, ray_count, 0)):
            start = (first_point + ray * point_count // ray_count) % point_count
            beam, facing = _beam_to_facing_point(surface, sample, start, point, normal, is_two_sided)
            if facing > 0.0:
                total_weight += facing
                if sees_point(mesh, point, normal, wp.normalize(beam), wp.length(beam)):
                    open_weight += facing
        open_share = float(0.0)
        if total_weight > 0.0:
            open_share = open_weight / total_weight
        transmittance[receiver, i] = open_share


def trace_transmittance(
    mesh: wp.Mesh | None,
    points: wp.array,
    normals: wp.array,
    samples: EmitterSamples,
    positions: wp.array,
    sample_points: wp.array,
    sample_areas: wp.array,
    span: EmitterSpan,
    *,
    rays: int | np.ndarray,
    progress: bool = False,
) -> wp.array:
    """Trace the transmittance between receivers and the samples of an emitter, by rays to points of its surface.

    Args:
        mesh: The blockers, the emitter among them if it blocks light; None for none.
        points, normals: Receivers [scene units] and their unit normals, vec3 of shape [receiver].
        positions: All vertices [scene units], of one instance, vec3 of shape [vertex].
        sample_points, sample_areas: Of :class:`.samples.PlacedSamples`, of one instance.
        span: Samples of the emitter.
        rays: To each sample, spread over its points, no more than these: one number, or ints of shape [sample].
    Returns:
        Float32 of shape [receiver, sample]; 0 where a sample sends nothing.
    Differentiable: no.
    """
    device, ray_counts = points.device, np.minimum(np.broadcast_to(rays, span.size), SURFACE_POINTS)
    ray_count = max(1, int(ray_counts.sum()))
    transmittance = empty((len(points), span.size), dtype=wp.float32, device=device)
    surface = EmitterSurface()
    surface.positions, surface.faces = positions, samples.faces
    surface.point_faces = constant(samples.surface_points.faces, wp.int32, device)
    surface.point_weights = constant(samples.surface_points.weights, wp.vec3, device)
    for receivers in progress_slices(len(points), 2**20 // ray_count, progress):
        launch(
            _trace_transmittance,
            receivers.stop - receivers.start,
            inputs=[
                *(mesh_id(mesh), points[receivers], normals[receivers], receivers.start, sample_points, sample_areas),
                *(surface, span.first, int(span.is_two_sided), constant(ray_counts, wp.int32, device)),
            ],
            outputs=[transmittance[receivers]],
            cost=RAY_COST * ray_count,
        )
    return transmittance
