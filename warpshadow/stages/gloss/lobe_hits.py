"""Hits of lobes: which faces of metals their samples meet, and whether these see the sky they mirror."""

from typing import NamedTuple

import warp as wp

from warpshadow.device.launch import launch
from warpshadow.stages.raster.interpolation import interpolate_at
from warpshadow.stages.rays.ray_tracing import RAY_COST, escapes, first_hit

wp.set_module_options({"max_unroll": 1})


@wp.kernel(enable_backward=False)
def _trace_hits(
    first_row: int,
    worker: int,
    # in
    mesh: wp.uint64,
    is_mirror: wp.array(dtype=wp.int32),
    faces: wp.array(dtype=wp.vec3i),
    vertex_normals: wp.array(dtype=wp.vec3),
    points: wp.array(dtype=wp.vec3),
    normals: wp.array(dtype=wp.vec3),
    directions: wp.array2d(dtype=wp.vec3),
    transmittance: wp.array2d(dtype=wp.float32),
    # out
    face_ids: wp.array2d(dtype=wp.int32),
    is_open: wp.array2d(dtype=wp.float32),
):
    """A thread owns a sample."""
    row, sample = wp.tid()
    receiver = first_row + row
    direction = directions[receiver, sample]
    face = int(-1)
    openness = float(0.0)
    if transmittance[receiver, sample] < 1.0 and wp.dot(direction, normals[receiver]) > 0.0:
        hit = first_hit(mesh, points[receiver], normals[receiver], direction)
        face = hit.face
        if is_mirror[wp.max(face, 0)] == 0:
            face = -1
        if face >= 0:
            normal = wp.normalize(interpolate_at(vertex_normals, faces[face], hit.weights))
            if hit.is_back:
                normal = -normal
            cosine = wp.dot(normal, direction)
            point = (
                hit.weights[0] * wp.mesh_get_point(mesh, 3 * face)
                + hit.weights[1] * wp.mesh_get_point(mesh, 3 * face + 1)
                + hit.weights[2] * wp.mesh_get_point(mesh, 3 * face + 2)
            )
            if cosine < 0.0 and escapes(mesh, point, normal, direction - 2.0 * cosine * normal):
                openness = 1.0
    face_ids[receiver, sample] = face
    is_open[receiver, sample] = openness


class LobeHits(NamedTuple):
    """Faces of metals that samples of lobes meet; arrays of shape [batch, receiver, sample]."""

    face_ids: wp.array  # int32, −1 for a sample that meets none
    is_open: wp.array  # T', float32


def trace_hits(
    mesh: wp.Mesh,
    is_mirror: wp.array,
    faces: wp.array,
    vertex_normals: wp.array,
    points: wp.array,
    normals: wp.array,
    directions: wp.array,
    transmittance: wp.array,
    hits: LobeHits,
) -> None:
    """Trace which faces the samples of lobes meet, of an instance, and whether these see the sky where they mirror it.

    Args:
        mesh: Of all bodies.
        is_mirror: 1 for faces of metals, int32 of shape [face].
        faces: Vertices of the mesh, vec3i of shape [face].
        vertex_normals: Their unit normals, vec3 of shape [vertex].
        points, normals: Of the receivers, vec3 of shape [receiver].
        directions: Of the samples, vec3 of shape [receiver, sample].
        transmittance: Of the samples, float32 of shape [receiver, sample]; where it is 1 nothing is traced.
        hits: Filled, arrays of shape [receiver, sample].

    Differentiable: no.
    """
    inputs = [mesh.id, is_mirror, faces, vertex_normals, points, normals, directions, transmittance]
    launch(_trace_hits, directions.shape, inputs=inputs, outputs=[*hits], cost=2 * RAY_COST * directions.shape[1])
