"""Transmittance of convex parts, such as boxes and boards, between receivers and the samples of an emitter.

A part hides a sample y from a receiver x if the direction ω to it is within the part's silhouette, and y is behind all
faces that x sees. With m_e the normals, towards the part, of the planes through x and the edges of the silhouette, and
the outward normals N_f and offsets o_f of the faces that x sees, it takes the share

    a = S(p) S(q),   p = min_e m_e·(y − x) / R,   q = min_f (o_f − N_f·y) / R

of the beam of the sample, a disc of radius R; S is the smoothstep from −1 to 1. Parts of a piece of a body are beside
each other, so their shares add up: T = max(1 − Σ a, 0.0001) is left past the piece, and where two parts touch, all of a
sample is hidden. Seams, which :mod:`warpshadow.stages.convex.coverage` subtracts, are left out. Shares of the parts of
a compound add up, too, to at most the share of its hull; a receiver inside the hull sees no silhouette of it, and there
is no such bound. Else pieces are independent.

A bulb in an open shade of 15 panels in a room is 3.5% off; with products, which let a quarter of a sample's light
through at seams, 5.0%. Sums over all of a body are no better: two rows of slats behind each other are darker.
"""

import warp as wp

from warpshadow.device.batch import common_batch, expand, instance_in
from warpshadow.device.launch import launch_with_adjoint
from warpshadow.device.memory import empty
from warpshadow.device.parallel import Scratch, scratch_slot, split_row
from warpshadow.stages.convex.convex_blockers import ConvexArrays, ConvexBlockers, PlacedParts
from warpshadow.stages.emitters.samples import EmitterSpan, PlacedSamples, may_light, sample_radius
from warpshadow.stages.emitters.sphere_transmittance import MIN_TRANSMITTANCE, log_transmittance, reaches_ball

_COST = 40.0  # nanoseconds that a part takes
_ON_FACE = 1.0e-3  # height over a face, in radii of its part, from which below a receiver still sees the face

wp.set_module_options({"max_unroll": 1})


@wp.struct
class PlacedPartArrays:
    """Convex parts in the world, of one instance."""

    arrays: ConvexArrays
    corners: wp.array(dtype=wp.vec3)
    face_planes: wp.array(dtype=wp.vec4)
    bounds: wp.array(dtype=wp.vec4)


@wp.struct
class Beam:
    """The way from a receiver to a sample."""

    point: wp.vec3  # x
    offset: wp.vec3  # y − x
    radius: float  # R


@wp.struct
class Border:
    """The edge of a part's silhouette that is nearest to a beam, and the face seen that its end is nearest to."""

    is_any: bool  # whether there is one
    side: float  # 1 where the receiver sees the face to the right of the edge, −1 where it sees the one to the left
    ends: wp.vec4i  # of the edge, the first two
    face: wp.vec3i
    begin: wp.vec3  # positions of the ends
    end: wp.vec3
    a: wp.vec3  # positions of the face's corners
    b: wp.vec3
    c: wp.vec3


@wp.func
def _sees(face_planes: wp.array(dtype=wp.vec4), face: int, point: wp.vec3, margin: float):
    """Whether a point is before a face."""
    plane = face_planes[face]
    return wp.dot(wp.vec3(plane[0], plane[1], plane[2]), point) - plane[3] > -margin


@wp.func
def _nearest_border(parts: PlacedPartArrays, part: int, beam: Beam):
    """The nearest edge and face. Receivers that see both sides of a panel, or none, have none."""
    margin = _ON_FACE * parts.bounds[part][3]
    first_face = parts.arrays.first_face[part]
    border = Border()
    nearest_edge = int(-1)
    min_sine = float(wp.inf)
    for e in range(parts.arrays.first_edge[part], parts.arrays.first_edge[part + 1]):
        edge = parts.arrays.edges[e]
        sees_left = _sees(parts.face_planes, first_face + edge[2], beam.point, margin)
        if sees_left != _sees(parts.face_planes, first_face + edge[3], beam.point, margin):
            side = wp.where(sees_left, -1.0, 1.0)
            vector = wp.cross(parts.corners[edge[0]] - beam.point, parts.corners[edge[1]] - beam.point)
            sine = side * wp.dot(wp.normalize(vector), beam.offset)
            if sine < min_sine:
                min_sine = sine
                nearest_edge = e
                border.side = side
    nearest_face = int(-1)
    min_depth = float(wp.inf)
    for face in range(first_face, parts.arrays.first_face[part + 1]):
        if _sees(parts.face_planes, face, beam.point, margin):
            plane = parts.face_planes[face]
            depth = plane[3] - wp.dot(wp.vec3(plane[0], plane[1], plane[2]), beam.point + beam.offset)
            if depth < min_depth:
                min_depth = depth
                nearest_face = face
    if nearest_edge >= 0 and nearest_face >= 0:
        border.is_any = True
        border.ends = parts.arrays.edges[nearest_edge]
        border.face = parts.arrays.faces[nearest_face]
        border.begin = parts.corners[border.ends[0]]
        border.end = parts.corners[border.ends[1]]
        border.a = parts.corners[border.face[0]]
        border.b = parts.corners[border.face[1]]
        border.c = parts.corners[border.face[2]]
    return border


@wp.func
def _blocked_share_within(border: Border, beam: Beam):
    """The share a of a part whose nearest border is known."""
    edge_normal = border.side * wp.normalize(wp.cross(border.begin - beam.point, border.end - beam.point))
    face_normal = wp.normalize(wp.cross(border.b - border.a, border.c - border.a))
    position = wp.dot(edge_normal, beam.offset) / beam.radius
    depth = wp.dot(face_normal, border.a - beam.point - beam.offset) / beam.radius
    return wp.smoothstep(-1.0, 1.0, position) * wp.smoothstep(-1.0, 1.0, depth)


@wp.func
def _blocked_share(parts: PlacedPartArrays, part: int, beam: Beam):
    border = _nearest_border(parts, part, beam)
    blocked_share = float(0.0)
    if border.is_any:
        blocked_share = _blocked_share_within(border, beam)
    return blocked_share


@wp.func
def _blocked_share_adjoint(
    parts: PlacedPartArrays, part: int, beam: Beam, adj_share: float, batch: int, adj_corners: wp.array2d(dtype=wp.vec3)
):
    """Gradients of the beam, given the share's gradient; gradients of corners are added."""
    adj = Beam()
    border = _nearest_border(parts, part, beam)
    if border.is_any:
        slopes, beam_slopes = wp.grad(_blocked_share_within)(border, beam)
        adj.point = adj_share * beam_slopes.point
        adj.offset = adj_share * beam_slopes.offset
        adj.radius = adj_share * beam_slopes.radius
        if adj_corners:
            wp.atomic_add(adj_corners, batch, border.ends[0], adj_share * slopes.begin)
            wp.atomic_add(adj_corners, batch, border.ends[1], adj_share * slopes.end)
            wp.atomic_add(adj_corners, batch, border.face[0], adj_share * slopes.a)
            wp.atomic_add(adj_corners, batch, border.face[1], adj_share * slopes.b)
            wp.atomic_add(adj_corners, batch, border.face[2], adj_share * slopes.c)
    return adj


@wp.struct
class BeamInputs:
    """Receivers, the samples of an emitter, and the parts around them."""

    points: wp.array2d(dtype=wp.vec3)
    normals: wp.array2d(dtype=wp.vec3)
    sample_points: wp.array2d(dtype=wp.vec3)
    sample_areas: wp.array2d(dtype=wp.vec3)
    balls: wp.array2d(dtype=wp.vec4)
    emitter: int
    first_sample: int
    is_two_sided: int
    corners: wp.array2d(dtype=wp.vec3)
    face_planes: wp.array2d(dtype=wp.vec4)
    bounds: wp.array2d(dtype=wp.vec4)
    arrays: ConvexArrays
    skipped: wp.vec2i


@wp.struct
class LitReceiver:
    """A receiver of an instance, with all that is around it."""

    point: wp.vec3
    normal: wp.vec3
    sample_points: wp.array(dtype=wp.vec3)
    sample_areas: wp.array(dtype=wp.vec3)
    first_sample: int
    is_two_sided: int
    ball_axis: wp.vec3
    ball_radius: float
    parts: PlacedPartArrays


@wp.func
def _find_receiver(inputs: BeamInputs, batch: int, index: int):
    receiver = LitReceiver()
    receiver.point = inputs.points[batch, index]
    receiver.normal = inputs.normals[instance_in(batch, inputs.normals.shape[0]), index]
    sample_batch = instance_in(batch, inputs.sample_points.shape[0])
    receiver.sample_points = inputs.sample_points[sample_batch]
    receiver.sample_areas = inputs.sample_areas[sample_batch]
    receiver.first_sample = inputs.first_sample
    receiver.is_two_sided = inputs.is_two_sided
    ball = inputs.balls[sample_batch, inputs.emitter]
    receiver.ball_axis = wp.vec3(ball[0], ball[1], ball[2]) - receiver.point
    receiver.ball_radius = ball[3]
    part_batch = instance_in(batch, inputs.bounds.shape[0])
    receiver.parts.arrays = inputs.arrays
    receiver.parts.corners = inputs.corners[part_batch]
    receiver.parts.face_planes = inputs.face_planes[part_batch]
    receiver.parts.bounds = inputs.bounds[part_batch]
    return receiver


@wp.func
def _find_beam(receiver: LitReceiver, i: int):
    """The beam of a sample; its radius is 0 where it does not light the receiver."""
    area = receiver.sample_areas[receiver.first_sample + i]
    beam = Beam()
    beam.point = receiver.point
    beam.offset = receiver.sample_points[receiver.first_sample + i] - receiver.point
    beam.radius = wp.where(
        may_light(beam.offset, area, receiver.normal, receiver.is_two_sided), sample_radius(area), 0.0
    )
    return beam


@wp.func
def _is_blocker(inputs: BeamInputs, compound: int):
    """Whether a compound blocks light between the receivers and the emitter."""
    piece = inputs.arrays.first_piece[compound]
    body = inputs.arrays.bodies[piece]
    return body != inputs.skipped[0] and body != inputs.skipped[1] and inputs.arrays.blocks[piece] == 1


@wp.func
def _parts_of(parts: ConvexArrays, compound: int):
    """The first part of a compound, and the end of the last."""
    return parts.first_part[parts.first_piece[compound]], parts.first_part[parts.first_piece[compound + 1]]


@wp.func
def _may_hide(receiver: LitReceiver, part: int):
    """Whether a part may be between a receiver and the emitter."""
    bound = receiver.parts.bounds[part]
    offset = wp.vec3(bound[0], bound[1], bound[2]) - receiver.point
    is_solid = receiver.parts.arrays.signs[part] > 0.0
    return is_solid and reaches_ball(offset, bound[3], receiver.ball_axis, receiver.ball_radius)


@wp.func
def _find_blocked_shares(
    receiver: LitReceiver, compound: int, by_parts: wp.array(dtype=wp.float32), by_hull: wp.array(dtype=wp.float32)
):
    """Find Σ a of the parts for each sample, and a of the hull, 1 without; returns whether they may hide any."""
    hides = bool(False)
    first, end = _parts_of(receiver.parts.arrays, compound)
    hull = receiver.parts.arrays.hulls[compound]
    for part in range(first, end):
        if _may_hide(receiver, part):
            for i in range(by_parts.shape[0]):
                beam = _find_beam(receiver, i)
                blocked_share = wp.where(hides, by_parts[i], 0.0)
                if beam.radius > 0.0:
                    blocked_share += _blocked_share(receiver.parts, part, beam)
                by_parts[i] = blocked_share
            hides = True
    for i in range(by_hull.shape[0]):
        by_hull[i] = 1.0
        if hides and hull >= 0:
            beam = _find_beam(receiver, i)
            if beam.radius > 0.0 and by_parts[i] > 0.0:
                border = _nearest_border(receiver.parts, hull, beam)
                if border.is_any:
                    by_hull[i] = _blocked_share_within(border, beam)
    return hides


@wp.kernel(enable_backward=False)
def _block_by_compounds(
    first_row: int,
    worker: int,
    # in
    inputs: BeamInputs,
    # scratch
    by_parts: wp.array2d(dtype=wp.float32),
    by_hull: wp.array2d(dtype=wp.float32),
    # out
    log_transmittances: wp.array3d(dtype=wp.float32),
):
    """A thread owns a receiver of an instance."""
    row = first_row + wp.tid()
    batch, index = split_row(row, log_transmittances.shape[1])
    logs = log_transmittances[batch, index]
    for i in range(logs.shape[0]):
        logs[i] = 0.0
    receiver = _find_receiver(inputs, batch, index)
    slot = scratch_slot(worker, row)
    for compound in range(inputs.arrays.hulls.shape[0]):
        if _is_blocker(inputs, compound) and _find_blocked_shares(receiver, compound, by_parts[slot], by_hull[slot]):
            for i in range(logs.shape[0]):
                blocked_share = wp.min(by_parts[slot, i], by_hull[slot, i])
                if blocked_share > 0.0:
                    logs[i] = logs[i] + log_transmittance(blocked_share)


@wp.kernel(enable_backward=False)
def _block_by_compounds_adjoint(
    first_row: int,
    worker: int,
    # in
    inputs: BeamInputs,
    adj_log_transmittances: wp.array3d(dtype=wp.float32),
    # scratch
    by_parts: wp.array2d(dtype=wp.float32),
    by_hull: wp.array2d(dtype=wp.float32),
    # out
    adj_points: wp.array2d(dtype=wp.vec3),
    # sums
    adj_sample_points: wp.array2d(dtype=wp.vec3),
    adj_sample_areas: wp.array2d(dtype=wp.vec3),
    adj_corners: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a receiver of an instance; samples that are hidden wholly have no gradient."""
    row = first_row + wp.tid()
    batch, index = split_row(row, adj_log_transmittances.shape[1])
    receiver = _find_receiver(inputs, batch, index)
    slot = scratch_slot(worker, row)
    sample_batch = instance_in(batch, inputs.sample_points.shape[0])
    part_batch = instance_in(batch, inputs.corners.shape[0])
    adj_point = wp.vec3()
    for compound in range(inputs.arrays.hulls.shape[0]):
        if _is_blocker(inputs, compound) and _find_blocked_shares(receiver, compound, by_parts[slot], by_hull[slot]):
            first, end = _parts_of(inputs.arrays, compound)
            hull = inputs.arrays.hulls[compound]
            for number in range(first, end + wp.where(hull < 0, 0, 1)):
                part = wp.where(number < end, number, hull)
                if number == end or _may_hide(receiver, part):
                    for i in range(by_parts.shape[1]):
                        blocked_share = wp.min(by_parts[slot, i], by_hull[slot, i])
                        decides = (number == end) == (by_hull[slot, i] < by_parts[slot, i])
                        if decides and blocked_share > 0.0 and blocked_share < 1.0 - MIN_TRANSMITTANCE:
                            beam = _find_beam(receiver, i)
                            adj_share = -adj_log_transmittances[batch, index, i] / (1.0 - blocked_share)
                            adj = _blocked_share_adjoint(receiver.parts, part, beam, adj_share, part_batch, adj_corners)
                            adj_point += adj.point - adj.offset
                            sample = receiver.first_sample + i
                            if adj_sample_points:
                                wp.atomic_add(adj_sample_points, sample_batch, sample, adj.offset)
                            if adj_sample_areas:
                                area = receiver.sample_areas[sample]
                                # R² = |A| / π
                                adj_area = (adj.radius * beam.radius / (2.0 * wp.length_sq(area))) * area
                                wp.atomic_add(adj_sample_areas, sample_batch, sample, adj_area)
    if adj_points:
        adj_points[batch, index] = adj_points[batch, index] + adj_point


def find_log_transmittance_of_parts(
    points: wp.array,
    normals: wp.array,
    samples: PlacedSamples,
    span: EmitterSpan,
    placed_parts: PlacedParts,
    blockers: ConvexBlockers,
    skipped: tuple[int, int],
) -> wp.array:
    """Logarithm of the transmittance of convex parts between receivers and an emitter.

    Args:
        points, normals, samples, span: As for :func:`.sphere_transmittance.find_log_transmittance`.
        skipped: Indices of bodies among these that do not block, −1 for none: the receivers' and the emitter's.
    Returns:
        Float32 of shape [batch, receiver, sample].
    Differentiable: points, samples, corners of placed parts. Not: normals.
    """
    count = common_batch({"points": points, "emitters": samples.points, "parts": placed_parts.corners})
    points = expand(points, count)
    inputs = BeamInputs()
    inputs.points, inputs.normals = points, normals
    inputs.sample_points, inputs.sample_areas, inputs.balls = samples.points, samples.areas, samples.balls
    inputs.emitter, inputs.first_sample, inputs.is_two_sided = span.emitter, span.first, int(span.is_two_sided)
    inputs.corners, inputs.face_planes, inputs.bounds = placed_parts
    inputs.arrays, inputs.skipped = blockers.arrays, wp.vec2i(*skipped)
    return launch_with_adjoint(
        _block_by_compounds,
        _block_by_compounds_adjoint,
        count * points.shape[1],
        inputs=[inputs],
        result=empty((count, points.shape[1], span.size), dtype=wp.float32, device=points.device),
        variables=[points],
        shared=[samples.points, samples.areas, placed_parts.corners],
        scratch=[Scratch((span.size,), wp.float32), Scratch((span.size,), wp.float32)],
        cost=_COST * placed_parts.bounds.shape[1],
    )
