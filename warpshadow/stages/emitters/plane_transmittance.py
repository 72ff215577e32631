"""Transmittance of plane blockers, such as walls, between receivers and the samples of an emitter.

The line from a receiver x to a sample meets a plane in h, if they are on different sides of it. There the beam of the
sample, a disc of radius R at a distance d, has the radius b = R |h − x| / d, and with s the distance of h from the
outline of the plane, positive inside, along m, the plane takes the share

    a = S((s / w + 1) / 2),   w² = b² (1 + (ω·m / ω·n)²)

of it, S the smoothstep and n the plane's normal: the projection of the beam reaches w along m.

A sample less than r above the plane, on the receiver's side, lies beyond it in part, as of a lamp half in the ground:

    a S((1 − (y_n + 2ε) / r) / 2),   r = max(R √(1 − (k·n)²), ε)

y_n is the height of the sample's middle, r how far its disc, of normal k, reaches along n, and ε the plane's margin, a
thousandth of a texel; 2ε makes a lamp in the plane whole. The disc of a thin lamp is wider than the lamp, which may lie
on the plane. So the first term of r is scaled by how far the plane divides the lamp: 0 for a lamp on one side, 1 where
at least a sixteenth of it is beyond. (With samples wholly beyond or not at all, a lamp half in the ground was off by −7
to +8%.)
"""

import warp as wp

from warpshadow.device.batch import common_batch, expand, instance_in
from warpshadow.device.launch import launch
from warpshadow.device.memory import zeros
from warpshadow.device.parallel import split_row
from warpshadow.stages.emitters.samples import EmitterSpan, PlacedSamples, may_light, sample_radius
from warpshadow.stages.emitters.sphere_transmittance import log_transmittance
from warpshadow.stages.planes.plane_blockers import PlaneBlockers, PlaneGrid

_COST = 5.0  # nanoseconds that a plane takes for a sample
_SINKING_SLOPE = 8.0  # r counts whole from a sixteenth of the lamp on that is beyond the plane
_MIN_WIDTH = 1.0e-6  # least half-width of an edge, in distances of the sample

wp.set_module_options({"max_unroll": 1})


@wp.func
def _gap_to_edge(edge: wp.vec4, u: float, v: float):
    """Vector from the nearest point of an edge to a point."""
    x = edge[2] - edge[0]
    y = edge[3] - edge[1]
    position = wp.clamp(((u - edge[0]) * x + (v - edge[1]) * y) / wp.max(x * x + y * y, 1.0e-30), 0.0, 1.0)
    return wp.vec2(u - edge[0] - position * x, v - edge[1] - position * y)


@wp.func
def _nearest_edge(edges: wp.array(dtype=wp.vec4), first_edge: int, edge_count: int, u: float, v: float):
    """The edge of an outline that is nearest to a point, counted from 1; negative where the point is outside."""
    nearest_edge = int(0)
    min_distance2 = float(wp.inf)
    crossings = int(0)
    for e in range(edge_count):
        edge = edges[first_edge + e]
        distance2 = wp.length_sq(_gap_to_edge(edge, u, v))
        if distance2 < min_distance2:
            min_distance2 = distance2
            nearest_edge = e + 1
        if (edge[1] > v) != (edge[3] > v) and u < edge[0] + (v - edge[1]) / (edge[3] - edge[1]) * (edge[2] - edge[0]):
            crossings += 1
    return wp.where(crossings % 2 == 1, nearest_edge, -nearest_edge)


@wp.func_grad(_nearest_edge)
def _nearest_edge_adjoint(
    edges: wp.array(dtype=wp.vec4), first_edge: int, edge_count: int, u: float, v: float, adj_result: int
):
    return


@wp.func
def _blocked_share(
    grid: PlaneGrid,
    edges: wp.array(dtype=wp.vec4),
    origin: wp.vec3,
    axis_u: wp.vec3,
    axis_v: wp.vec3,
    side: float,
    point: wp.vec3,
    beam: wp.vec3,
    area: wp.vec3,
):
    """Blocked share a of a beam by a plane: its frame, the lamp's side of it, x, y − x, the sample's area vector A."""
    normal = wp.normalize(wp.cross(axis_u, axis_v))
    scale = wp.length(axis_u)
    distance = wp.length(beam)
    height = wp.dot(point - origin, normal)
    rise = wp.dot(beam, normal)
    margin = grid.margin * scale
    disc_radius = sample_radius(area)
    cosine = wp.dot(normal, area) / wp.max(wp.length(area), 1.0e-30)
    sunk = wp.min(_SINKING_SLOPE * (1.0 - wp.abs(side)), 1.0)
    reach = wp.max(sunk * disc_radius * wp.sqrt(wp.max(1.0 - cosine * cosine, 1.0e-6)), margin)
    end_height = wp.where(height < 0.0, -height - rise, height + rise)
    share_beyond = 1.0 - wp.smoothstep(-1.0, 1.0, (end_height + 2.0 * margin) / reach)
    blocked_share = float(0.0)
    if height != 0.0 and share_beyond > 0.0:
        height_change = wp.max(wp.abs(rise), reach)
        position = float(1.0)
        if end_height < 0.0:
            position = wp.abs(height) / height_change
        hit = point + position * beam - origin
        u = wp.dot(hit, axis_u) / (scale * scale)
        v = wp.dot(hit, axis_v) / (scale * scale)
        number = _nearest_edge(edges, grid.first_edge, grid.edge_count, u, v)
        edge = edges[grid.first_edge + wp.abs(number) - 1]
        gap = _gap_to_edge(edge, u, v)
        outward = wp.normalize(gap)
        slope = (outward[0] * wp.dot(beam, axis_u) + outward[1] * wp.dot(beam, axis_v)) / (scale * height_change)
        width = wp.max(disc_radius * position, _MIN_WIDTH * distance) * wp.sqrt(1.0 + slope * slope)
        signed_distance = wp.where(number > 0, 1.0, -1.0) * scale * wp.length(gap)
        blocked_share = share_beyond * wp.smoothstep(-1.0, 1.0, signed_distance / width)
    return blocked_share


@wp.kernel
def _block_by_planes(
    first_row: int,
    worker: int,
    # in
    points: wp.array2d(dtype=wp.vec3),
    normals: wp.array2d(dtype=wp.vec3),
    sample_points: wp.array2d(dtype=wp.vec3),
    sample_areas: wp.array2d(dtype=wp.vec3),
    first_sample: int,
    is_two_sided: int,
    frames: wp.array2d(dtype=wp.vec3),
    grids: wp.array(dtype=PlaneGrid),
    edges: wp.array(dtype=wp.vec4),
    sides: wp.array3d(dtype=wp.float32),
    body: int,
    skipped: wp.vec2i,
    # out
    log_transmittances: wp.array3d(dtype=wp.float32),
):
    """A thread owns a receiver of an instance."""
    batch, receiver = split_row(first_row + wp.tid(), log_transmittances.shape[1])
    point = points[batch, receiver]
    normal = normals[instance_in(batch, normals.shape[0]), receiver]
    sample_batch = instance_in(batch, sample_points.shape[0])
    frame_batch = instance_in(batch, frames.shape[0])
    for plane in range(grids.shape[0]):
        grid = grids[plane]
        axis_u = frames[frame_batch, 3 * plane + 1]
        is_skipped = plane == skipped[0] or plane == skipped[1]
        if not is_skipped and grid.blocks == 1 and wp.length_sq(axis_u) > 0.0:
            origin = frames[frame_batch, 3 * plane]
            axis_v = frames[frame_batch, 3 * plane + 2]
            side = sides[instance_in(batch, sides.shape[0]), body, plane]
            for i in range(log_transmittances.shape[2]):
                area = sample_areas[sample_batch, first_sample + i]
                beam = sample_points[sample_batch, first_sample + i] - point
                if may_light(beam, area, normal, is_two_sided):
                    blocked_share = _blocked_share(grid, edges, origin, axis_u, axis_v, side, point, beam, area)
                    if blocked_share > 0.0:
                        wp.atomic_add(log_transmittances, batch, receiver, i, log_transmittance(blocked_share))


def find_log_transmittance_of_planes(
    points: wp.array,
    normals: wp.array,
    samples: PlacedSamples,
    span: EmitterSpan,
    frames: wp.array,
    planes: PlaneBlockers,
    sides: wp.array,
    body: int,
    skipped: tuple[int, int],
) -> wp.array:
    """Logarithm of the transmittance of plane blockers between receivers and an emitter.

    Args:
        points: Receivers, lifted off the planes that they lie in, vec3 of shape [batch, receiver].
        normals, samples, span: As for :func:`.sphere_transmittance.find_log_transmittance`.
        frames: Where the planes are, vec3 of shape [batch, 3 · plane], from :meth:`.PlaneBlockers.frames`.
        sides: The side of each plane on which each body lies, of shape [batch, body, plane], from
            :func:`.fronts.find_body_sides`.
        body: The emitter's number.
        skipped: Planes that do not block, −1 for none: the receivers' and the emitter's.
    Returns:
        Float32 of shape [batch, receiver, sample].
    Differentiable: points, samples, frames, sides. Not: normals.
    """
    count = common_batch({"points": points, "emitters": samples.points, "planes": frames})
    points = expand(points, count)
    result = zeros((count, points.shape[1], span.size), dtype=wp.float32, device=points.device)
    launch(
        _block_by_planes,
        count * points.shape[1],
        inputs=[
            *(points, normals, samples.points, samples.areas, span.first, int(span.is_two_sided)),
            *(frames, planes.grids, planes.edges, sides, body, wp.vec2i(*skipped)),
        ],
        outputs=[result],
        shared=[normals, samples.points, samples.areas, frames, sides],
        cost=_COST * planes.count * result.shape[2],
    )
    return result
