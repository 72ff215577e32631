"""Path tracing: light that bounces between the meshes before it reaches receivers. It judges the approximations.

A path starts at a receiver. At each of its hits x_k light is drawn from the sky (next-event estimation), so that with
n bounces the receiver gets

    I = Σ_{k=1..n} a(x_1) ⋯ a(x_k) S(x_k)                [Kajiya 1986; Veach 1997, section 10.2]

on average over paths whose directions are drawn in proportion to the cosine: a albedo and S the direct shading of a
white surface, by the sky and, if bodies emit, by a point of their surfaces. A hit is a receiver of its own: on the side
of its face that the ray meets, with the normal of the vertices, interpolated.

Where much light comes from a few bright faces, such as those in a lampshade, one of five directions is drawn towards a
point of these, and all count by the balance heuristic (:mod:`.bounces.bright_patches`, each side of a face a patch).
Direct light at some points of each face tells which are bright: it need not be exact for that.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import warp as wp

from warpshadow.device.launch import launch
from warpshadow.device.memory import empty
from warpshadow.stages.bounces.bright_patches import (
    BrightPatches,
    find_bright_patches,
    hit_weight,
    point_of_bright_side,
)
from warpshadow.stages.emitters.traced_transmittance import EmittingFaces, light_of_point
from warpshadow.stages.light.light_samples import LightSamples
from warpshadow.stages.raster.interpolation import interpolate_at
from warpshadow.stages.rays.ray_tracing import RAY_COST, escapes, first_hit, mesh_id, progress_slices
from warpshadow.stages.shell.shell_rays import FAR, beam_to_shell
from warpshadow.stages.textures.pyramid import Textures
from warpshadow.stages.textures.sample import interpolate_uv

_SEED = 29

_SIDE_SEED = 31

_BRIGHT_PART = wp.constant(4)
"""Directions for each one that is drawn towards a bright face. With 1024 rays a room with a bulb in a shade has 7.7%
of noise in place of 20%, in 0.85 of the time; with every second direction it has 7.9%, and other rooms have more."""

_MIN_BRIGHT_SHARE = 1 / 3
"""Part of the light that faces reflect first which bright ones do at least, or none of them counts as bright: 57% in a
room with a bulb in a shade, 32% on a table under a lamp, which has 1.1% of noise without and 1.7% with such directions,
and 0.1% or less in rooms that the sky lights."""

_SIDE_POINTS = 2**18
"""Points at which all faces together are lit to find bright ones, at most 16 on each side and at least one."""

_STEP_U, _STEP_V = wp.uint32(3242174889), wp.uint32(2447445414)
"""Roberts' R2 sequence, which spreads the first directions of a receiver's paths, in parts of 2³²."""


class PathSurfaces(NamedTuple):
    """Surfaces that light bounces from, one instance."""

    mesh: wp.Mesh  # all bodies
    blocker_mesh: wp.Mesh | None  # mesh that blocks direct light, None for none
    faces: wp.array  # vertex indices of the mesh, vec3i of shape [face]
    normals: wp.array  # unit normals of the vertices, vec3 of shape [vertex]
    vertex_albedo: wp.array  # reflectance of the vertices, vec3 of shape [vertex]
    textures: Textures | None  # textures, of one instance; None where no body has one
    texture_of_face: wp.array  # texture of each face, -1 for none, int32 of shape [face]
    uvs: wp.array  # texture coordinates, vec2 of shape [uv]
    uv_faces: wp.array  # indices of uvs, vec3i of shape [face]
    emitters: EmittingFaces | None = None  # faces that emit; None without any


@wp.struct
class _SurfaceArrays:
    """Surfaces of a path tracer, as kernels take them."""

    mesh: wp.uint64
    blocker_mesh: wp.uint64
    positions: wp.array(dtype=wp.vec3)
    faces: wp.array(dtype=wp.vec3i)
    normals: wp.array(dtype=wp.vec3)
    vertex_albedo: wp.array(dtype=wp.vec3)
    texels: wp.array(dtype=wp.vec3)
    levels: wp.array2d(dtype=wp.vec3i)
    texture_of_face: wp.array(dtype=wp.int32)
    uvs: wp.array(dtype=wp.vec2)
    uv_faces: wp.array(dtype=wp.vec3i)
    emitters: EmittingFaces


@wp.func
def _albedo(surfaces: _SurfaceArrays, face: int, weights: wp.vec3):
    """Reflectance at a point of a face: bilinear in the finest level of its texture, or between vertices."""
    texture = surfaces.texture_of_face[face]
    if texture < 0:
        return interpolate_at(surfaces.vertex_albedo, surfaces.faces[face], weights)
    return interpolate_uv(
        surfaces.texels, surfaces.levels[texture, 0], interpolate_at(surfaces.uvs, surfaces.uv_faces[face], weights)
    )


@wp.func
def _cosine_direction(normal: wp.vec3, u: float, v: float):
    """A direction of the hemisphere, with a probability in proportion to the cosine for even u and v in [0, 1).

    The normal and a point of the unit sphere add up to it [Shirley et al. 2019, "Sampling Transformations Zoo",
    section 16.6.1].
    """
    z = 1.0 - 2.0 * u
    sine = wp.sqrt(wp.max(1.0 - z * z, 0.0))
    angle = 2.0 * wp.pi * v
    return wp.normalize(normal + wp.vec3(sine * wp.cos(angle), sine * wp.sin(angle), z))


@wp.func
def _quasi_random(shift: wp.uint32, step: wp.uint32, number: int):
    """A number of a low-discrepancy sequence, from 0 to 1."""
    return float((shift + step * wp.uint32(number)) >> wp.uint32(8)) / 16777216.0


@wp.func
def _cosine_to_sky(surfaces: _SurfaceArrays, shell: wp.vec4, point: wp.vec3, normal: wp.vec3, direction: wp.vec3):
    """Cosine at a point of a direction of the sky, times the shell's factor w; 0 where the direction is blocked."""
    beam = beam_to_shell(shell, point, direction)
    light_direction = wp.vec3(beam[0], beam[1], beam[2])
    cosine = beam[3] * wp.dot(normal, light_direction)
    if cosine > 0.0 and escapes(surfaces.blocker_mesh, point, normal, light_direction):
        return cosine
    return 0.0


@wp.func
def _normal_at(surfaces: _SurfaceArrays, corners: wp.vec3i, weights: wp.vec3, is_back: bool):
    """Normal of a side of a face."""
    normal = wp.normalize(interpolate_at(surfaces.normals, corners, weights))
    return wp.where(is_back, -normal, normal)


@wp.kernel(enable_backward=False)
def _reflect_direct_light(
    first_row: int,
    worker: int,
    # in
    surfaces: _SurfaceArrays,
    directions: wp.array(dtype=wp.vec3),
    radiance: wp.array(dtype=wp.vec3),
    shell: wp.vec4,
    point_count: int,
    # out
    reflected: wp.array(dtype=wp.vec3),
):
    """A thread owns a side of a face, the fronts of all before their backs: a mean over points drawn on it."""
    side = first_row + wp.tid()
    state = wp.rand_init(_SIDE_SEED, side)
    face = side % surfaces.faces.shape[0]
    corners = surfaces.faces[face]
    total = wp.vec3()
    for _point in range(point_count):
        root = wp.sqrt(wp.randf(state))
        v = wp.randf(state)
        weights = wp.vec3(1.0 - root, root * (1.0 - v), root * v)
        point = interpolate_at(surfaces.positions, corners, weights)
        normal = _normal_at(surfaces, corners, weights, side != face)
        sample_set = int(wp.randu(state) % wp.uint32(directions.shape[0]))
        light = _cosine_to_sky(surfaces, shell, point, normal, directions[sample_set]) * radiance[sample_set]
        if surfaces.emitters.distribution.shape[0] > 0:
            choice = wp.randf(state)
            emitter_u = wp.randf(state)
            emitter_v = wp.randf(state)
            light += light_of_point(
                surfaces.emitters, surfaces.blocker_mesh, point, normal, choice, emitter_u, emitter_v
            )
        total += wp.cw_mul(_albedo(surfaces, face, weights), light)
    reflected[side] = total / float(point_count)


@wp.kernel(enable_backward=False)
def _trace_bounces(
    first_row: int,
    worker: int,
    # in
    surfaces: _SurfaceArrays,
    points: wp.array(dtype=wp.vec3),
    normals: wp.array(dtype=wp.vec3),
    first_receiver: int,
    directions: wp.array(dtype=wp.vec3),
    radiance: wp.array(dtype=wp.vec3),
    shell: wp.vec4,
    bright: BrightPatches,
    corners_of_faces: wp.array(dtype=wp.vec3),
    bounce_count: int,
    path_count: int,
    # out
    light: wp.array(dtype=wp.vec3),
):
    """A thread owns a receiver. Only the first directions of its paths are spread: all else is drawn apart."""
    receiver = first_row + wp.tid()
    state = wp.rand_init(_SEED, first_receiver + receiver)
    shift_u = wp.randu(state)
    shift_v = wp.randu(state)
    total = wp.vec3()
    for path in range(path_count):
        point = points[receiver]
        normal = normals[receiver]
        u = _quasi_random(shift_u, _STEP_U, path)
        v = _quasi_random(shift_v, _STEP_V, path)
        selection = (int(shift_u % wp.uint32(_BRIGHT_PART + 1)) + path) % (_BRIGHT_PART + 1)
        throughput = wp.vec3(1.0)
        for _bounce in range(bounce_count):
            ray_direction = _cosine_direction(normal, u, v)
            bright_side = int(-1)
            if bright.ray_count > 0 and selection == 0:
                choice = wp.randf(state)
                side_u = wp.randf(state)
                side_v = wp.randf(state)
                bright_side, target = point_of_bright_side(bright, corners_of_faces, choice, side_u, side_v)
                ray_direction = wp.normalize(target - point)
                if wp.dot(ray_direction, normal) <= 0.0:
                    break
            hit = first_hit(surfaces.mesh, point, normal, ray_direction)
            if hit.face < 0:
                break
            if bright.ray_count > 0:
                side = wp.where(hit.is_back, surfaces.faces.shape[0] + hit.face, hit.face)
                if bright_side >= 0 and side != bright_side:
                    break
                throughput *= (1.0 + 1.0 / float(_BRIGHT_PART)) * hit_weight(
                    bright, side, corners_of_faces, hit.face, point, normal, ray_direction, _BRIGHT_PART
                )
            corners = surfaces.faces[hit.face]
            point = interpolate_at(surfaces.positions, corners, hit.weights)
            normal = _normal_at(surfaces, corners, hit.weights, hit.is_back)
            throughput = wp.cw_mul(throughput, _albedo(surfaces, hit.face, hit.weights))
            sample_set = int(wp.randu(state) % wp.uint32(directions.shape[0]))
            cosine = _cosine_to_sky(surfaces, shell, point, normal, directions[sample_set])
            if cosine > 0.0:
                total += cosine * wp.cw_mul(throughput, radiance[sample_set])
            if surfaces.emitters.distribution.shape[0] > 0:
                choice = wp.randf(state)
                emitter_u = wp.randf(state)
                emitter_v = wp.randf(state)
                emitted = light_of_point(
                    surfaces.emitters, surfaces.blocker_mesh, point, normal, choice, emitter_u, emitter_v
                )
                total += wp.cw_mul(throughput, emitted)
            u = wp.randf(state)
            v = wp.randf(state)
            if bright.ray_count > 0:
                selection = int(wp.randu(state) % wp.uint32(_BRIGHT_PART + 1))
    light[receiver] = total / float(path_count)


def trace_bounces(
    surfaces: PathSurfaces,
    points: wp.array,
    normals: wp.array,
    samples: LightSamples,
    *,
    bounces: int,
    paths: int,
    shell: np.ndarray = FAR,
    progress: bool = False,
) -> wp.array:
    """Trace the light that reaches receivers after it bounced; add direct light (:func:`.trace_shading`) to it.

    Rays that meet a face see it from either side. Direct light at their hits is blocked by the casting bodies alone, as
    at receivers.

    Args:
        points, normals: Receivers [scene units] and their unit normals, vec3 of shape [receiver].
        samples: Directions drawn from the light; each hit takes one of all the sets.
        bounces: Most bounces of a path, 1 or more.
        shell: As for :func:`.trace_shading`.
    Returns:
        The bounced light that white surfaces send back, vec3 of shape [receiver].
    Differentiable: no.
    """
    device = points.device
    count = samples.directions.shape[1]
    directions = wp.array(samples.directions.reshape(-1, 3), dtype=wp.vec3, device=device)
    radiance = wp.array(count / np.pi * samples.radiance.reshape(-1, 3), dtype=wp.vec3, device=device)
    light = empty(points.shape, dtype=wp.vec3, device=device)
    surface_arrays, cost = _surface_arrays(surfaces), 2 * bounces * paths
    lit_by = directions, radiance, wp.vec4(*shell)
    bright, corners = _bright_sides(surface_arrays, *lit_by)
    for receivers in progress_slices(points.shape[0], 2**20 // cost, progress):
        launch(
            _trace_bounces,
            receivers.stop - receivers.start,
            inputs=[
                surface_arrays,
                points[receivers],
                normals[receivers],
                receivers.start,
                *lit_by,
                bright,
                corners,
                bounces,
                paths,
            ],
            outputs=[light[receivers]],
            cost=RAY_COST * cost,
        )
    return light


def _bright_sides(
    surfaces: _SurfaceArrays, directions: wp.array, radiance: wp.array, shell: wp.vec4
) -> tuple[BrightPatches, wp.array]:
    """The bright sides of faces, and the corners of all faces, vec3 of shape [3 · face]."""
    face_count, device = len(surfaces.faces), directions.device
    corners = surfaces.positions.numpy()[surfaces.faces.numpy()]
    reflected = empty(2 * face_count, dtype=wp.vec3, device=device)
    point_count = min(max(_SIDE_POINTS // (2 * face_count), 1), 16)
    launch(
        _reflect_direct_light,
        2 * face_count,
        inputs=[surfaces, directions, radiance, shell, point_count],
        outputs=[reflected],
        cost=2 * RAY_COST * point_count,
    )
    sides = np.arange(2 * face_count).reshape(2, -1)
    bright = find_bright_patches(
        reflected.numpy(), sides, corners.astype(np.float64), rays=1, min_share=_MIN_BRIGHT_SHARE, device=device
    )
    return bright, wp.array(corners.reshape(-1, 3), dtype=wp.vec3, device=device)


def _surface_arrays(surfaces: PathSurfaces) -> _SurfaceArrays:
    struct = _SurfaceArrays()
    struct.mesh, struct.blocker_mesh = mesh_id(surfaces.mesh), mesh_id(surfaces.blocker_mesh)
    struct.positions, struct.faces, struct.normals = surfaces.mesh.points, surfaces.faces, surfaces.normals
    struct.vertex_albedo, struct.texture_of_face = surfaces.vertex_albedo, surfaces.texture_of_face
    struct.uvs, struct.uv_faces = surfaces.uvs, surfaces.uv_faces
    if surfaces.textures is not None:
        struct.texels, struct.levels = surfaces.textures.texels[0], surfaces.textures.levels
    struct.emitters = EmittingFaces() if surfaces.emitters is None else surfaces.emitters
    return struct
