"""Mirrored bodies: a metal that a lobe meets reflects light once more, from where its own normal mirrors.

A sample l of a lobe meets a face at a point with normal n, which mirrors l' = l − 2 (n·l) n. In place of the mean
radiance R̄ of the receiver's blockers the point sends

    R = R̄ + m (F (T' L + (1 − T') R̄) − R̄),   F = a + (1 − a) (1 − |n·l|)⁵,

m how metallic it is, a its albedo, T' whether a ray along l' meets no body, and L light without shadows from l',
blurred by σ'² = σ² + 2 α²: σ is the blur of the sample (:mod:`.lobes`), √2 α that of a whole lobe, seen from above.
The point moves over its face as the receiver, the sample or the corners do. Which face it is, and T', have no gradient.
"""

from typing import NamedTuple

import warp as wp

from warpshadow.device.batch import common_batch, instance_in
from warpshadow.device.launch import launch
from warpshadow.device.parallel import split_row
from warpshadow.stages.gloss.lobe_hits import LobeHits
from warpshadow.stages.gloss.lobes import MIN_ROUGHNESS
from warpshadow.stages.raster.interpolation import interpolate_at

_COST = 20.0  # nanoseconds that a sample takes

wp.set_module_options({"max_unroll": 1})


@wp.kernel
def _mirror(
    first_row: int,
    worker: int,
    # in
    face_ids: wp.array3d(dtype=wp.int32),
    faces: wp.array(dtype=wp.vec3i),
    positions: wp.array2d(dtype=wp.vec3),
    vertex_normals: wp.array2d(dtype=wp.vec3),
    roughness: wp.array2d(dtype=wp.float32),
    points: wp.array2d(dtype=wp.vec3),
    directions: wp.array3d(dtype=wp.vec3),
    filters: wp.array3d(dtype=wp.vec3),
    # out
    barycentrics: wp.array3d(dtype=wp.vec3),
    hit_points: wp.array3d(dtype=wp.vec3),
    mirrored: wp.array3d(dtype=wp.vec3),
    mirrored_filters: wp.array3d(dtype=wp.vec3),
):
    """A thread owns a sample."""
    row, sample = wp.tid()
    batch, receiver = split_row(first_row + row, mirrored.shape[1])
    point = points[instance_in(batch, points.shape[0]), receiver]
    direction = directions[instance_in(batch, directions.shape[0]), receiver, sample]
    blur = filters[instance_in(batch, filters.shape[0]), receiver, sample][2]
    weights = wp.vec3(0.0)
    grazing = float(0.0)
    face = face_ids[instance_in(batch, face_ids.shape[0]), receiver, sample]
    if face >= 0:
        corners = faces[face]
        position_batch = instance_in(batch, positions.shape[0])
        a = positions[position_batch, corners[0]] - point
        b = positions[position_batch, corners[1]] - point
        c = positions[position_batch, corners[2]] - point
        face_normal = wp.cross(b - a, c - a)
        slope = wp.dot(face_normal, direction)
        volumes = wp.vec3(
            wp.dot(direction, wp.cross(b, c)), wp.dot(direction, wp.cross(c, a)), wp.dot(direction, wp.cross(a, b))
        )
        weights = volumes / slope
        point = point + (wp.dot(face_normal, a) / slope) * direction
        normals = vertex_normals[instance_in(batch, vertex_normals.shape[0])]
        normal = wp.normalize(interpolate_at(normals, corners, weights))
        if slope > 0.0:
            normal = -normal
        rough = interpolate_at(roughness[instance_in(batch, roughness.shape[0])], corners, weights)
        width = wp.max(rough, MIN_ROUGHNESS)
        width = width * width
        blur = wp.sqrt(blur * blur + 2.0 * width * width)
        cosine = wp.dot(normal, direction)
        slant = 1.0 - wp.min(wp.abs(cosine), 1.0)
        grazing = slant * slant * slant * slant * slant
        direction = direction - 2.0 * cosine * normal
    barycentrics[batch, receiver, sample] = weights
    hit_points[batch, receiver, sample] = point
    mirrored[batch, receiver, sample] = direction
    mirrored_filters[batch, receiver, sample] = wp.vec3(grazing, 0.0, blur)


class Mirrors(NamedTuple):
    """Points of metals that samples meet, and where they mirror light from, vec3 of shape [batch, receiver, sample].

    A sample that meets none has its own direction and filter, from its receiver.
    """

    barycentrics: wp.array
    points: wp.array  # [scene units]
    directions: wp.array  # l'
    filters: wp.array  # (1 − |n·l|)⁵, 0 and σ' [radians]


def find_mirrors(
    hits: LobeHits,
    faces: wp.array,
    positions: wp.array,
    vertex_normals: wp.array,
    roughness: wp.array,
    points: wp.array,
    directions: wp.array,
    filters: wp.array,
) -> Mirrors:
    """Find the points that samples meet, and the directions that they mirror.

    Args:
        hits: Of :func:`.lobe_hits.trace_hits`, of all instances.
        faces: Vertices of the mesh, vec3i of shape [face].
        positions, vertex_normals: Of the vertices, vec3 of shape [batch, vertex].
        roughness: Likewise, float32.
        points: Of the receivers, vec3 of shape [batch, receiver].
        directions, filters: Of :func:`.lobes.sample_lobes`. Any batch may be 1 and then serves every instance.

    Differentiable: all but hits and faces.
    """
    per_receiver = {"points": points, "directions": directions, "filters": filters}
    per_vertex = {"positions": positions, "vertex_normals": vertex_normals, "roughness": roughness}
    shape = common_batch({**per_receiver, **per_vertex, "hits": hits.face_ids}), *directions.shape[1:]
    mirrors = Mirrors(*(wp.empty(shape, dtype=wp.vec3, device=directions.device) for _ in Mirrors._fields))
    launch(
        _mirror,
        (shape[0] * shape[1], shape[2]),
        inputs=[hits.face_ids, faces, *per_vertex.values(), *per_receiver.values()],
        outputs=[*mirrors],
        shared=[*per_vertex.values(), *(array for array in per_receiver.values() if len(array) < shape[0])],
        cost=_COST * shape[2],
    )
    return mirrors


@wp.kernel
def _mix_mirrored(
    first_row: int,
    worker: int,
    # in
    face_ids: wp.array3d(dtype=wp.int32),
    is_open: wp.array3d(dtype=wp.float32),
    faces: wp.array(dtype=wp.vec3i),
    barycentrics: wp.array3d(dtype=wp.vec3),
    albedo: wp.array2d(dtype=wp.vec3),
    metallic: wp.array2d(dtype=wp.float32),
    filters: wp.array3d(dtype=wp.vec3),
    light: wp.array3d(dtype=wp.vec3),
    mean_radiance: wp.array2d(dtype=wp.vec3),
    # out
    radiance: wp.array3d(dtype=wp.vec3),
):
    """A thread owns a sample."""
    row, sample = wp.tid()
    batch, receiver = split_row(first_row + row, radiance.shape[1])
    mean = mean_radiance[instance_in(batch, mean_radiance.shape[0]), receiver]
    hit_batch = instance_in(batch, face_ids.shape[0])
    face = face_ids[hit_batch, receiver, sample]
    result = mean
    if face >= 0:
        weights = barycentrics[instance_in(batch, barycentrics.shape[0]), receiver, sample]
        color = interpolate_at(albedo[instance_in(batch, albedo.shape[0])], faces[face], weights)
        share = interpolate_at(metallic[instance_in(batch, metallic.shape[0])], faces[face], weights)
        grazing = filters[instance_in(batch, filters.shape[0]), receiver, sample][0]
        seen = mean
        if is_open[hit_batch, receiver, sample] > 0.5:
            seen = light[instance_in(batch, light.shape[0]), receiver, sample]
        fresnel = color + grazing * (wp.vec3(1.0) - color)
        result = mean + share * (wp.cw_mul(fresnel, seen) - mean)
    radiance[batch, receiver, sample] = result


def mix_mirrored(
    hits: LobeHits,
    faces: wp.array,
    mirrors: Mirrors,
    albedo: wp.array,
    metallic: wp.array,
    light: wp.array,
    mean_radiance: wp.array,
) -> wp.array:
    """Mix the radiance R of the blockers of each sample.

    Args:
        hits, faces: As of :func:`find_mirrors`.
        mirrors: Its result.
        albedo, metallic: Of the vertices, vec3 and float32 of shape [batch, vertex].
        light: L, vec3 of shape [batch, receiver, sample].
        mean_radiance: R̄, of :func:`.reflection.find_blocked_radiance`, vec3 of shape [batch, receiver].
            Any batch may be 1 and then serves every instance.

    Returns:
        Vec3 of shape [batch, receiver, sample].

    Differentiable: all but hits and faces.
    """
    values = {
        "barycentrics": mirrors.barycentrics,
        "albedo": albedo,
        "metallic": metallic,
        "filters": mirrors.filters,
        "light": light,
        "blocked": mean_radiance,
    }
    shape = common_batch({"hits": hits.face_ids, **values}), *light.shape[1:]
    radiance = wp.empty(shape, dtype=wp.vec3, device=light.device)
    per_receiver = mirrors.barycentrics, mirrors.filters, light, mean_radiance
    launch(
        _mix_mirrored,
        (shape[0] * shape[1], shape[2]),
        inputs=[*hits, faces, *values.values()],
        outputs=[radiance],
        shared=[albedo, metallic, *(array for array in per_receiver if len(array) < shape[0])],
        cost=_COST * shape[2],
    )
    return radiance
