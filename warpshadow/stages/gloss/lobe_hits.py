"""Hits of lobes: which faces of the shown bodies their samples meet, and whether these would mirror the sky.

Where smooth normals lean away from faces, rays leave below the face that they start on. There is no light from there.
"""

from typing import NamedTuple

import warp as wp

from warpshadow.device.launch import launch
from warpshadow.device.memory import empty
from warpshadow.stages.raster.interpolation import interpolate_at
from warpshadow.stages.rays.ray_tracing import RAY_COST, escapes, first_hit

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
    face_ids: wp.array2d(dtype=wp.int32),
    barycentrics: wp.array2d(dtype=wp.vec3),
    hit_normals: wp.array2d(dtype=wp.vec3),
    last_rays: wp.array2d(dtype=wp.int32),
    hit_points: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a sample."""
    row, sample = wp.tid()
    receiver = first_row + row
    direction = directions[receiver, sample]
    face = int(-1)
    point = points[receiver]
    last_ray = int(MEETS_BODY)
    is_back = bool(False)
    if transmittance[receiver, sample] < 1.0 and wp.dot(direction, normals[receiver]) > 0.0:
        hit = first_hit(mesh, points[receiver], normals[receiver], direction)
        face = hit.face
        is_back = hit.is_back
        if hit.is_below:
            last_ray = LEAVES_BELOW
        if light_of_face[wp.max(face, 0)] == 0:
            face = -1
        if face >= 0:
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
            barycentrics[receiver, sample] = hit.weights
            hit_normals[receiver, sample] = normal
            if light_of_face[face] == MIRRORS:
                mirrored = direction - 2.0 * cosine * normal
                rise = wp.dot(wp.mesh_eval_face_normal(mesh, face), mirrored)
                if cosine >= 0.0 or rise * wp.where(hit.is_back, -1.0, 1.0) <= 0.0:
                    last_ray = LEAVES_BELOW
                elif escapes(mesh, point, normal, mirrored):
                    last_ray = MEETS_SKY
    last_rays[receiver, sample] = last_ray
    if face >= 0 and is_back:
        face += light_of_face.shape[0]
    face_ids[receiver, sample] = face
    hit_points[receiver, sample] = point


class LobeHits(NamedTuple):
    """Points of bodies that samples of lobes meet; arrays of shape [receiver, sample], or [batch, receiver, sample]."""

    face_ids: wp.array  # sides of faces, int32; −1 for a sample that meets no such body: it has no other number
    barycentrics: wp.array  # vec3
    normals: wp.array  # unit normals on the side that is met, vec3
    last_rays: wp.array  # end of a mirrored ray; of samples that meet no metal LEAVES_BELOW, or MEETS_BODY for all else
    points: wp.array  # vec3 [scene units]; the receiver of a sample that meets no such body


HIT_TYPES = wp.int32, wp.vec3, wp.vec3, wp.int32, wp.vec3  # of the arrays of LobeHits


def trace_hits(
    mesh: wp.Mesh,
    light_of_face: wp.array,
    faces: wp.array,
    vertex_normals: wp.array,
    points: wp.array,
    normals: wp.array,
    directions: wp.array,
    transmittance: wp.array,
) -> LobeHits:
    """Trace which faces the samples of lobes meet, of an instance, and whether these see the sky where they mirror it.

    Args:
        mesh: Of all bodies.
        light_of_face: SENDS or MIRRORS for faces whose own light counts, else 0, int32 of shape [face].
        faces: Vertices of the mesh, vec3i of shape [face].
        vertex_normals: Their unit normals, vec3 of shape [vertex].
        points, normals: Of the receivers, vec3 of shape [receiver].
        directions: Of the samples, vec3 of shape [receiver, sample].
        transmittance: Of the samples, float32 of shape [receiver, sample]; where it is 1 nothing is traced.

    Differentiable: no.
    """
    shape, device = directions.shape, points.device
    hits = LobeHits(*(empty(shape, dtype=dtype, device=device) for dtype in HIT_TYPES))
    inputs = [mesh.id, light_of_face, faces, vertex_normals, points, normals, directions, transmittance]
    launch(_trace_hits, shape, inputs=inputs, outputs=[*hits], cost=2 * RAY_COST * shape[1])
    return hits
