"""Transmittance of convex parts, such as boxes and boards, between receivers and the samples of an emitter.

A part hides a sample y from a receiver x if the direction ω to it is within the part's silhouette, and y is behind all
faces that x sees. With m_e the normals, towards the part, of the planes through x and the edges of the silhouette, and
the outward normals N_f and offsets o_f of the faces that x sees, it takes the share

    a = S((min_e m_e·ω / ρ + 1) / 2) S((min_f (o_f − N_f·y) / R + 1) / 2),   ρ = R / d

of the beam of the sample, a disc of radius R at the distance d; S is the smoothstep. Parts of a body that are seen side
by side count as independent: along a seam between them up to a quarter of a sample's light gets through.
(A bulb in an open shade of 16 panels: 16% off, by dots along the shadows of the seams, receivers at pixels or not. By
spheres, 256 or 1024 of them, it is 12 to 14% off, since they bulge and leave gaps.)
"""

import warp as wp

from warpshadow.device.batch import common_batch, expand, instance_in
from warpshadow.device.launch import launch
from warpshadow.device.memory import zeros
from warpshadow.device.parallel import split_row
from warpshadow.stages.convex.prepared import ConvexArrays, ConvexBlockers, PlacedParts
from warpshadow.stages.emitters.samples import EmitterSpan, PlacedSamples, is_lit, sample_radius
from warpshadow.stages.emitters.spheres import log_transmittance, reaches_ball

_COST = 40.0  # nanoseconds that a part takes
_ON_FACE = 1.0e-3  # height over a face, in radii of its part, from which below a receiver still sees the face

wp.set_module_options({"max_unroll": 1})


@wp.func
def _is_seen(planes: wp.array(dtype=wp.vec4), face: int, point: wp.vec3, margin: float):
    """Whether a point is before a face."""
    plane = planes[face]
    return wp.dot(wp.vec3(plane[0], plane[1], plane[2]), point) - plane[3] > -margin


@wp.func
def _edge_normal(a: wp.vec3, b: wp.vec3, point: wp.vec3, center: wp.vec3):
    """Normal of the plane through a point and an edge, towards the middle of the part."""
    normal = wp.normalize(wp.cross(a - point, b - point))
    return wp.where(wp.dot(normal, center - point) < 0.0, -1.0, 1.0) * normal


@wp.func
def _nearest_edge_and_face(
    parts: ConvexArrays,
    corners: wp.array(dtype=wp.vec3),
    planes: wp.array(dtype=wp.vec4),
    part: int,
    center: wp.vec3,
    margin: float,
    point: wp.vec3,
    beam: wp.vec3,
):
    """The edge of the silhouette that is nearest to a beam, and the face seen that its end is nearest to; −1 for none.

    Without a gradient: minima change from one to another where they are equal.
    """
    nearest_edge = int(-1)
    min_sine = float(wp.inf)
    first_face = parts.first_face[part]
    for e in range(parts.first_edge[part], parts.first_edge[part + 1]):
        edge = parts.edges[e]
        sees_left = _is_seen(planes, first_face + edge[2], point, margin)
        if sees_left != _is_seen(planes, first_face + edge[3], point, margin):
            sine = wp.dot(_edge_normal(corners[edge[0]], corners[edge[1]], point, center), beam)
            if sine < min_sine:
                min_sine = sine
                nearest_edge = e
    nearest_face = int(-1)
    min_depth = float(wp.inf)
    for face in range(first_face, parts.first_face[part + 1]):
        if _is_seen(planes, face, point, margin):
            plane = planes[face]
            depth = plane[3] - wp.dot(wp.vec3(plane[0], plane[1], plane[2]), point + beam)
            if depth < min_depth:
                min_depth = depth
                nearest_face = face
    return wp.vec2i(nearest_edge, nearest_face)


@wp.func_grad(_nearest_edge_and_face)
def _nearest_edge_and_face_adjoint(
    parts: ConvexArrays,
    corners: wp.array(dtype=wp.vec3),
    planes: wp.array(dtype=wp.vec4),
    part: int,
    center: wp.vec3,
    margin: float,
    point: wp.vec3,
    beam: wp.vec3,
    adj_result: wp.vec2i,
):
    return


@wp.func
def _hidden_share(
    parts: ConvexArrays,
    corners: wp.array(dtype=wp.vec3),
    planes: wp.array(dtype=wp.vec4),
    part: int,
    bound: wp.vec4,
    point: wp.vec3,
    beam: wp.vec3,
    disc_radius: float,
):
    """The share a, given x, y − x and R."""
    center = wp.vec3(bound[0], bound[1], bound[2])
    nearest = _nearest_edge_and_face(parts, corners, planes, part, center, _ON_FACE * bound[3], point, beam)
    share = float(0.0)
    if nearest[0] >= 0 and nearest[1] >= 0:
        edge = parts.edges[nearest[0]]
        # (m·ω) / (R / d)
        position = wp.dot(_edge_normal(corners[edge[0]], corners[edge[1]], point, center), beam) / disc_radius
        face = parts.faces[nearest[1]]
        a = corners[face[0]]
        normal = wp.normalize(wp.cross(corners[face[1]] - a, corners[face[2]] - a))
        depth = wp.dot(normal, a - point - beam) / disc_radius
        share = wp.smoothstep(-1.0, 1.0, position) * wp.smoothstep(-1.0, 1.0, depth)
    return share


@wp.kernel
def _block_by_parts(
    first_row: int,
    worker: int,
    # in
    points: wp.array2d(dtype=wp.vec3),
    normals: wp.array2d(dtype=wp.vec3),
    sample_points: wp.array2d(dtype=wp.vec3),
    sample_areas: wp.array2d(dtype=wp.vec3),
    balls: wp.array2d(dtype=wp.vec4),
    emitter: int,
    first_sample: int,
    is_two_sided: int,
    corners: wp.array2d(dtype=wp.vec3),
    planes: wp.array2d(dtype=wp.vec4),
    bounds: wp.array2d(dtype=wp.vec4),
    parts: ConvexArrays,
    skipped: wp.vec2i,
    # out
    log_transmittances: wp.array3d(dtype=wp.float32),
):
    """A thread owns a receiver of an instance."""
    batch, receiver = split_row(first_row + wp.tid(), log_transmittances.shape[1])
    point = points[batch, receiver]
    normal = normals[instance_in(batch, normals.shape[0]), receiver]
    sample_batch = instance_in(batch, sample_points.shape[0])
    part_batch = instance_in(batch, bounds.shape[0])
    ball = balls[sample_batch, emitter]
    ball_axis = wp.vec3(ball[0], ball[1], ball[2]) - point
    for piece in range(parts.blocks.shape[0]):
        body = parts.bodies[piece]
        is_blocker = body != skipped[0] and body != skipped[1] and parts.blocks[piece] == 1
        first_part = parts.first_part[piece]
        for part in range(first_part, wp.where(is_blocker, parts.first_part[piece + 1], first_part)):
            bound = bounds[part_batch, part]
            offset = wp.vec3(bound[0], bound[1], bound[2]) - point
            if parts.signs[part] > 0.0 and reaches_ball(offset, bound[3], ball_axis, ball[3]):
                for i in range(log_transmittances.shape[2]):
                    area = sample_areas[sample_batch, first_sample + i]
                    beam = sample_points[sample_batch, first_sample + i] - point
                    share = float(0.0)
                    if is_lit(beam, area, normal, is_two_sided):
                        disc_radius = sample_radius(area)
                        share = _hidden_share(
                            parts, corners[part_batch], planes[part_batch], part, bound, point, beam, disc_radius
                        )
                    if share > 0.0:
                        wp.atomic_add(log_transmittances, batch, receiver, i, log_transmittance(share))


def find_log_transmittance_of_parts(
    points: wp.array,
    normals: wp.array,
    samples: PlacedSamples,
    span: EmitterSpan,
    placed: PlacedParts,
    blockers: ConvexBlockers,
    skipped: tuple[int, int],
) -> wp.array:
    """Logarithm of the transmittance of convex parts between receivers and an emitter.

    Args:
        points, normals, samples, span: As for :func:`.spheres.find_log_transmittance`.
        placed: Where the parts are.
        blockers: The bodies that consist of them.
        skipped: Indices of bodies among these that do not block, −1 for none: the receivers' and the emitter's.
    Returns:
        Float32 of shape [batch, receiver, sample].
    Differentiable: points, samples, corners of placed parts. Not: normals.
    """
    count = common_batch({"points": points, "emitters": samples.points, "parts": placed.corners})
    points = expand(points, count)
    result = zeros((count, points.shape[1], span.size), dtype=wp.float32, device=points.device)
    launch(
        _block_by_parts,
        count * points.shape[1],
        inputs=[
            *(points, normals, samples.points, samples.areas, samples.balls),
            *(span.emitter, span.first, int(span.is_two_sided)),
            *(*placed, blockers.arrays, wp.vec2i(*skipped)),
        ],
        outputs=[result],
        shared=[normals, samples.points, samples.areas, placed.corners],
        cost=_COST * placed.bounds.shape[1],
    )
    return result
