"""Hits of lobes: which faces of the shown bodies their samples meet, and, from metals, the rays that these mirror.

A ray is mirrored by up to REFLECTIONS metals, one after another. Where smooth normals lean away from faces, rays leave
below the face that they start on. There is no light from there.
"""

from typing import NamedTuple

import warp as wp

from warpshadow.device.launch import launch
from warpshadow.device.memory import empty
from warpshadow.stages.raster.interpolation import interpolate_at
from warpshadow.stages.rays.ray_tracing import RAY_COST, escapes, first_hit

REFLECTIONS = 2  # most bodies that a ray meets one after another

MEETS_SKY, MEETS_BODY, LEAVES_BELOW = (wp.constant(number) for number in range(3))  # what becomes of a ray
SENDS, MIRRORS = wp.constant(1), wp.constant(2)  # light of faces that counts: their radiosity; that they mirror, too

wp.set_module_options({"max_unroll": 1})


@wp.kernel(enable_backward=False)
def _trace_hits(
    first_row: int,
    worker: int,
    # in
    mesh: wp.uint64,
    light_of_face: wp.array(dtype=wp.int32),
    faces: wp.array(dtype=wp.vec3i),
    vertex_normals: wp.array(dtype=wp.vec3),
    points: wp.array(dtype=wp.vec3),
    normals: wp.array(dtype=wp.vec3),
    directions: wp.array2d(dtype=wp.vec3),
    transmittance: wp.array2d(dtype=wp.float32),
    # out
    face_ids: wp.array3d(dtype=wp.int32),
    barycentrics: wp.array3d(dtype=wp.vec3),
    hit_normals: wp.array3d(dtype=wp.vec3),
    last_rays: wp.array2d(dtype=wp.int32),
    last_points: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a sample."""
    row, sample = wp.tid()
    receiver = first_row + row
    direction = directions[receiver, sample]
    point = points[receiver]
    normal = normals[receiver]
    last_ray = int(MEETS_BODY)
    is_followed = bool(transmittance[receiver, sample] < 1.0 and wp.dot(direction, normal) > 0.0)
    for reflection in range(face_ids.shape[0]):
        face = int(-1)
        if is_followed:
            is_followed = False
            hit = first_hit(mesh, point, normal, direction)
            last_ray = MEETS_BODY
            if hit.is_below:
                last_ray = LEAVES_BELOW
            elif hit.face < 0:
                last_ray = MEETS_SKY
            elif light_of_face[hit.face] != 0:
                face = hit.face
                corners = faces[face]
                normal = wp.normalize(interpolate_at(vertex_normals, corners, hit.weights))
                if hit.is_back:
                    normal = -normal
                cosine = wp.dot(normal, direction)
                point = (
                    hit.weights[0] * wp.mesh_get_point(mesh, 3 * face)
                    + hit.weights[1] * wp.mesh_get_point(mesh, 3 * face + 1)
                    + hit.weights[2] * wp.mesh_get_point(mesh, 3 * face + 2)
                )
                barycentrics[reflection, receiver, sample] = hit.weights
                hit_normals[reflection, receiver, sample] = normal
                if light_of_face[face] == MIRRORS:
                    direction = direction - 2.0 * cosine * normal
                    rise = wp.dot(wp.mesh_eval_face_normal(mesh, face), direction)
                    if cosine >= 0.0 or rise * wp.where(hit.is_back, -1.0, 1.0) <= 0.0:
                        last_ray = LEAVES_BELOW
                    else:
                        is_followed = True
                if hit.is_back:
                    face += light_of_face.shape[0]
        face_ids[reflection, receiver, sample] = face
    if is_followed and escapes(mesh, point, normal, direction):
        last_ray = MEETS_SKY
    last_rays[receiver, sample] = last_ray
    last_points[receiver, sample] = point


class LobeHits(NamedTuple):
    """Points of bodies that samples of lobes meet, of shape [reflection, receiver, sample], or of a batch of these."""

    face_ids: wp.array  # sides of faces, int32; −1 for a ray that meets no such body: it has no other number
    barycentrics: wp.array  # vec3
    normals: wp.array  # unit normals on the side that is met, vec3
    last_rays: wp.array  # what becomes of the last ray, int32 of shape [receiver, sample]
    points: wp.array  # where that ray starts [scene units], or the body is that it meets; vec3 of the same shape


HIT_TYPES = wp.int32, wp.vec3, wp.vec3, wp.int32, wp.vec3  # of the arrays of LobeHits


def hit_shapes(reflections: int, receivers: int, samples: int) -> list[tuple[int, ...]]:
    """Shapes of the arrays of :class:`LobeHits`."""
    return [(reflections, receivers, samples)] * 3 + [(receivers, samples)] * 2


def trace_hits(
    mesh: wp.Mesh,
    light_of_face: wp.array,
    faces: wp.array,
    vertex_normals: wp.array,
    points: wp.array,
    normals: wp.array,
    directions: wp.array,
    transmittance: wp.array,
    reflections: int = REFLECTIONS,
) -> LobeHits:
    """Trace which faces the samples of lobes meet, of an instance, and the rays that metals mirror there.

    Args:
        mesh: Of all bodies.
        light_of_face: SENDS or MIRRORS for faces whose own light counts, else 0, int32 of shape [face].
        faces: Vertices of the mesh, vec3i of shape [face].
        vertex_normals: Their unit normals, vec3 of shape [vertex].
        points, normals: Of the receivers, vec3 of shape [receiver].
        directions: Of the samples, vec3 of shape [receiver, sample].
        transmittance: Of the samples, float32 of shape [receiver, sample]; where it is 1 nothing is traced.
        reflections: Most bodies that a ray meets one after another.

    Differentiable: no.
    """
    shape, device = directions.shape, points.device
    kinds = zip(hit_shapes(reflections, *shape), HIT_TYPES, strict=True)
    hits = LobeHits(*(empty(hit_shape, dtype=dtype, device=device) for hit_shape, dtype in kinds))
    inputs = [mesh.id, light_of_face, faces, vertex_normals, points, normals, directions, transmittance]
    launch(_trace_hits, shape, inputs=inputs, outputs=[*hits], cost=2 * RAY_COST * shape[1])
    return hits
