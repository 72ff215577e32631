"""Light of emitters on receivers: a sum over samples.

    E(x) = Σ_k L_k T_k max(n·ω_k, 0) max(−A_k·ω_k, 0) / √(π² d_k⁴ + |A_k|²)

L_k is the radiance of sample k, A_k its area vector, d_k and ω_k the distance and the direction to its middle, T_k the
transmittance on the way. E is over π, as all shading is. The root is π d² but for receivers closer to a sample than
samples are to each other, where nothing becomes infinite. (The form factor of a disc on its axis has π d² + |A| in
place of the root; samples are beside each other.) An open body sends light to both sides: |A_k·ω_k| is in place of the
maximum.

Receivers closer than about three times its half diagonal see a sample as its pieces, triangles with corners in the
directions a_j, cut at the horizon. In place of the fraction they have [Lambert 1760; Baum, Rushmeier and Winget 1989]

    Σ_pieces max(−Σ_j γ_j n·(a_j × a_{j+1}) / sin γ_j, 0) / (2 π),   γ_j the angle between a_j and a_{j+1}
"""

import warp as wp

from warpshadow.device.batch import common_batch, expand, expand_rows, instance_in
from warpshadow.device.launch import launch
from warpshadow.device.memory import empty
from warpshadow.device.parallel import split_row
from warpshadow.stages.emitters.samples import EmitterSpan, PlacedSamples, facing_area, may_light

_COST = 6.0  # nanoseconds that a sample takes

_TINY = 1e-12

wp.set_module_options({"max_unroll": 1})


@wp.kernel
def _find_directions(
    # in
    points: wp.array2d(dtype=wp.vec3),
    sample_points: wp.array2d(dtype=wp.vec3),
    first_sample: int,
    # out
    directions: wp.array3d(dtype=wp.vec3),
):
    """A thread owns a receiver and a sample."""
    batch, receiver, i = wp.tid()
    sample_point = sample_points[instance_in(batch, sample_points.shape[0]), first_sample + i]
    directions[batch, receiver, i] = wp.normalize(sample_point - points[instance_in(batch, points.shape[0]), receiver])


def directions_to_samples(points: wp.array, samples: PlacedSamples, span: EmitterSpan) -> wp.array:
    """Unit vectors from receivers to the samples of an emitter, vec3 of shape [batch, receiver, sample].

    Differentiable: points, samples.
    """
    count = common_batch({"points": points, "emitters": samples.points})
    directions = empty((count, points.shape[1], span.size), dtype=wp.vec3, device=points.device)
    launch(_find_directions, directions.shape, inputs=[points, samples.points, span.first], outputs=[directions])
    return directions


@wp.func
def transmittance_to_sample(
    log_of_spheres: wp.array3d(dtype=wp.float32),
    log_of_planes: wp.array3d(dtype=wp.float32),
    log_of_parts: wp.array3d(dtype=wp.float32),
    transmittance: wp.array3d(dtype=wp.float32),
    transmittance_of_emitter: wp.array3d(dtype=wp.float32),
    batch: int,
    receiver: int,
    i: int,
):
    """T of a sample, past all that blocks."""
    exponent = float(0.0)
    if log_of_spheres:
        exponent += log_of_spheres[batch, receiver, i]
    if log_of_planes:
        exponent += log_of_planes[batch, receiver, i]
    if log_of_parts:
        exponent += log_of_parts[batch, receiver, i]
    through = wp.exp(exponent)
    if transmittance:
        through = through * transmittance[batch, receiver, i]
    if transmittance_of_emitter:
        through = through * transmittance_of_emitter[batch, receiver, i]
    return through


@wp.func
def _edge_light(a: wp.vec3, b: wp.vec3, normal: wp.vec3):
    """2π times the light of an edge from a to b, seen from the origin."""
    a = wp.normalize(a)
    b = wp.normalize(b)
    cross = wp.cross(a, b)
    sine = wp.sqrt(wp.length_sq(cross) + _TINY)
    return wp.atan2(sine, wp.dot(a, b)) / sine * wp.dot(normal, cross)


@wp.func
def _cut(a: wp.vec3, b: wp.vec3, normal: wp.vec3):
    """The start of the part of an edge from a to b above the horizon, where the edge has one."""
    height = wp.dot(a, normal)
    other = wp.dot(b, normal)
    share = wp.where(height < 0.0 and other > 0.0, height / wp.min(height - other, -_TINY), 0.0)
    return a + share * (b - a)


@wp.func
def _cut_edge_light(a: wp.vec3, b: wp.vec3, normal: wp.vec3):
    """2π times the light of the part of an edge above the horizon."""
    light = float(0.0)
    if wp.dot(a, normal) > 0.0 or wp.dot(b, normal) > 0.0:
        light = _edge_light(_cut(a, b, normal), _cut(b, a, normal), normal)
    return light


@wp.func
def _crossing(a: wp.vec3, b: wp.vec3, normal: wp.vec3):
    """Where an edge from a to b sinks below the horizon; 0 where it does not."""
    sinks = wp.dot(a, normal) > 0.0 and wp.dot(b, normal) <= 0.0
    return wp.where(sinks, _cut(b, a, normal), wp.vec3())


@wp.func
def form_factor_of_triangle(a: wp.vec3, b: wp.vec3, c: wp.vec3, normal: wp.vec3):
    """Share of the cosine-weighted hemisphere that a triangle fills, seen from the origin; negative from its back."""
    light = _cut_edge_light(a, b, normal) + _cut_edge_light(b, c, normal) + _cut_edge_light(c, a, normal)
    sink = _crossing(a, b, normal) + _crossing(b, c, normal) + _crossing(c, a, normal)
    rise = _crossing(b, a, normal) + _crossing(c, b, normal) + _crossing(a, c, normal)
    if wp.length_sq(sink) > 0.0 and wp.length_sq(rise) > 0.0:
        light = light + _edge_light(sink, rise, normal)
    return -light / (2.0 * wp.pi)


@wp.func
def nearness(beam: wp.vec3, size2: float, normal: wp.vec3):
    """How much a receiver sees a sample's pieces: 1 up to 1.9 half diagonals away, 0 from 4 on and at the horizon."""
    near = 1.0 - wp.smoothstep(3.5 * size2, 16.0 * size2, wp.length_sq(beam))
    return near * wp.smoothstep(0.0, 0.03 * wp.sqrt(size2), wp.dot(beam, normal))


@wp.func
def _light_of_pieces(
    point: wp.vec3,
    normal: wp.vec3,
    corners: wp.array2d(dtype=wp.vec3),
    batch: int,
    first: int,
    end: int,
    is_two_sided: int,
):
    """Form factors of the pieces of a sample, added up."""
    total = float(0.0)
    for piece in range(first, end):
        a = corners[batch, 3 * piece] - point
        b = corners[batch, 3 * piece + 1] - point
        c = corners[batch, 3 * piece + 2] - point
        factor = form_factor_of_triangle(a, b, c, normal)
        total += wp.where(is_two_sided == 1, wp.abs(factor), wp.max(factor, 0.0))
    return total


@wp.kernel
def _sum_light(
    first_row: int,
    worker: int,
    # in
    points: wp.array2d(dtype=wp.vec3),
    normals: wp.array2d(dtype=wp.vec3),
    sample_points: wp.array2d(dtype=wp.vec3),
    sample_areas: wp.array2d(dtype=wp.vec3),
    corners: wp.array2d(dtype=wp.vec3),
    first_pieces: wp.array(dtype=wp.int32),
    elongations: wp.array(dtype=wp.float32),
    softness: wp.array(dtype=wp.float32),
    radiance: wp.array2d(dtype=wp.vec3),
    first_sample: int,
    sample_count: int,
    is_two_sided: int,
    log_of_spheres: wp.array3d(dtype=wp.float32),
    log_of_planes: wp.array3d(dtype=wp.float32),
    log_of_parts: wp.array3d(dtype=wp.float32),
    transmittance: wp.array3d(dtype=wp.float32),
    transmittance_of_emitter: wp.array3d(dtype=wp.float32),
    # out
    light: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a receiver of an instance."""
    batch, receiver = split_row(first_row + wp.tid(), light.shape[1])
    point = points[batch, receiver]
    normal = normals[batch, receiver]
    sample_batch = instance_in(batch, sample_points.shape[0])
    radiance_batch = instance_in(batch, radiance.shape[0])
    total = wp.vec3()
    for i in range(sample_count):
        beam = sample_points[sample_batch, first_sample + i] - point
        area = sample_areas[sample_batch, first_sample + i]
        if may_light(beam, area, normal, is_two_sided):
            through = transmittance_to_sample(
                log_of_spheres,
                log_of_planes,
                log_of_parts,
                transmittance,
                transmittance_of_emitter,
                batch,
                receiver,
                i,
            )
            distance2 = wp.length_sq(beam)
            factor = wp.dot(beam, normal) * facing_area(beam, area, softness[first_sample + i], is_two_sided)
            factor = factor / (distance2 * wp.sqrt(wp.pi * wp.pi * distance2 * distance2 + wp.length_sq(area)))
            near = nearness(beam, elongations[first_sample + i] * wp.length(area), normal)
            if near > 0.0:
                factor = factor * (1.0 - near)
                factor += near * _light_of_pieces(
                    point,
                    normal,
                    corners,
                    sample_batch,
                    first_pieces[first_sample + i],
                    first_pieces[first_sample + i + 1],
                    is_two_sided,
                )
            total += factor * through * radiance[radiance_batch, first_sample + i]
    light[batch, receiver] = total


def sum_light(
    points: wp.array,
    normals: wp.array,
    samples: PlacedSamples,
    radiance: wp.array,
    span: EmitterSpan,
    *,
    log_of_spheres: wp.array | None = None,
    log_of_planes: wp.array | None = None,
    log_of_parts: wp.array | None = None,
    transmittance: wp.array | None = None,
    transmittance_of_emitter: wp.array | None = None,
) -> wp.array:
    """Light of an emitter on receivers.

    Args:
        points: Receivers [scene units], vec3 of shape [batch, receiver].
        normals: Their unit normals, vec3 of shape [batch, receiver].
        samples: Of all emitters.
        radiance: Of the samples, linear RGB, vec3 of shape [batch, sample].
        span: Those of the emitter.
        log_of_spheres, log_of_planes, log_of_parts: Logarithms of transmittance, float32 of shape [batch, receiver,
            sample].
        transmittance, transmittance_of_emitter: Factors beside them, of the receivers' own body and of the emitter's,
            float32 of the same shape. Any batch may be 1; None where nothing blocks.
    Returns:
        vec3 of shape [batch, receiver].
    Differentiable: points, normals, samples, radiance and all transmittance.
    """
    arrays = {"points": points, "normals": normals, "emitters": samples.points, "emission": radiance}
    rows = {"spheres": log_of_spheres, "planes": log_of_planes, "parts": log_of_parts}
    rows |= {"others": transmittance, "emitter": transmittance_of_emitter}
    count = common_batch(arrays | rows)
    points, normals = expand(points, count), expand(normals, count)
    transmittances = [None if item is None else expand_rows(item, count) for item in rows.values()]
    light = empty((count, points.shape[1]), dtype=wp.vec3, device=points.device)
    launch(
        _sum_light,
        count * points.shape[1],
        inputs=[
            *(
                points,
                normals,
                samples.points,
                samples.areas,
                samples.corners,
                samples.pieces.first,
                samples.pieces.elongations,
                samples.pieces.softness,
                radiance,
                span.first,
                span.size,
            ),
            int(span.is_two_sided),
            *transmittances,
        ],
        outputs=[light],
        shared=[samples.points, samples.areas, samples.corners, radiance],
        cost=_COST * (span.size),
    )
    return light
