"""Transmittance of spheres between receivers and the samples of an emitter.

Seen from a receiver x, a sample is a disc of radius R around y, at a distance d along ω. Where a sphere with center c
and radius r is nearest to that line, at a distance t from x and p from the line, the beam of the disc has the radius
b = R t / d. The sphere takes the share

    a = W A S((hi − p) / (hi − lo)),  hi = m + w,  lo = max(m − w, 0),  m² = r² − min(w, r)²/5,  w² = b² + (κ r)²
    A = min(1, r² / (((hi + lo)/2)² + (hi − lo)²/20)),  W = S(t/r + ½) S((d − t)/r + ½)

of the beam, S the smoothstep: discs overlap so but for some percent, and averaged over p a sphere blocks as much as its
own disc. W leaves spheres out that are behind the receiver or behind the emitter. Transmittance is Π (1 − a) over all
spheres; this stage finds its logarithm, as a sum, whose adjoint is Warp's own.
"""

import warp as wp

from warpshadow.device.batch import common_batch, expand, instance_in
from warpshadow.device.launch import launch
from warpshadow.device.memory import zeros
from warpshadow.device.parallel import split_row
from warpshadow.stages.emitters.samples import SAMPLE_BUNDLE, EmitterSpan, PlacedSamples, may_light, sample_radius

_SOFTNESS = 0.05  # κ: least half-width of the edge of a sphere's shadow, in its radii
MIN_TRANSMITTANCE = 1.0e-4  # of a sphere
_REACH = 1.1  # radii beyond which a sphere blocks nothing of a beam that does not touch it
_COST = 15.0  # nanoseconds that a sphere takes, most of which do not block

wp.set_module_options({"max_unroll": 1})


@wp.func
def log_transmittance(blocked_share: float):
    """Logarithm of a beam's transmittance past a blocker of a share."""
    return wp.log(wp.max(1.0 - blocked_share, MIN_TRANSMITTANCE))


@wp.func
def _blocked_share(offset: wp.vec3, beam: wp.vec3, disc_radius: float, radius: float):
    """Blocked share a of a beam by a sphere, given c − x, y − x, R and r."""
    distance = wp.length(beam)
    direction = beam / distance
    depth = wp.dot(offset, direction)
    beam_radius = disc_radius * wp.clamp(depth / distance, 0.0, 1.0)
    width = wp.sqrt(beam_radius * beam_radius + _SOFTNESS * _SOFTNESS * radius * radius)
    narrower = wp.min(width, radius)
    middle = wp.sqrt(radius * radius - 0.2 * narrower * narrower)
    high = middle + width
    low = wp.max(middle - width, 0.0)
    mean = 0.5 * (high + low)
    opacity = wp.min(radius * radius / (mean * mean + 0.05 * (high - low) * (high - low)), 1.0)
    blocked_share = opacity * wp.smoothstep(0.0, 1.0, (high - wp.length(offset - depth * direction)) / (high - low))
    in_front = wp.smoothstep(0.0, 1.0, depth / radius + 0.5)
    is_between = wp.smoothstep(0.0, 1.0, (distance - depth) / radius + 0.5)
    return blocked_share * in_front * is_between


@wp.func
def reaches_ball(offset: wp.vec3, radius: float, axis: wp.vec3, ball_radius: float):
    """Whether a sphere may touch the cone from a receiver to a ball, given c − x and the middle of the ball − x."""
    distance = wp.length(axis)
    sine = wp.min(ball_radius / wp.max(distance, 1.0e-20), 1.0)
    depth = wp.dot(offset, axis) / wp.max(distance, 1.0e-20)
    if depth > distance + ball_radius + radius or depth < -ball_radius - radius:
        return False
    height = wp.sqrt(wp.max(wp.length_sq(offset) - depth * depth, 0.0))
    return height * wp.sqrt(1.0 - sine * sine) - wp.max(depth, 0.0) * sine < _REACH * radius


@wp.func
def _is_skipped(sphere: int, skipped: wp.vec4i):
    """Whether a sphere is in one of two spans."""
    return (sphere >= skipped[0] and sphere < skipped[1]) or (sphere >= skipped[2] and sphere < skipped[3])


@wp.kernel
def _block_by_spheres(
    first_row: int,
    worker: int,
    # in
    points: wp.array2d(dtype=wp.vec3),
    normals: wp.array2d(dtype=wp.vec3),
    sample_points: wp.array2d(dtype=wp.vec3),
    sample_areas: wp.array2d(dtype=wp.vec3),
    bundles: wp.array2d(dtype=wp.vec4),
    balls: wp.array2d(dtype=wp.vec4),
    emitter: int,
    first_sample: int,
    is_two_sided: int,
    centers: wp.array2d(dtype=wp.vec3),
    radii: wp.array2d(dtype=wp.float32),
    skipped: wp.vec4i,
    # out
    log_transmittances: wp.array3d(dtype=wp.float32),
):
    """A thread owns a receiver of an instance."""
    batch, receiver = split_row(first_row + wp.tid(), log_transmittances.shape[1])
    point = points[batch, receiver]
    normal = normals[instance_in(batch, normals.shape[0]), receiver]
    sample_batch = instance_in(batch, sample_points.shape[0])
    sphere_batch = instance_in(batch, radii.shape[0])
    ball = balls[sample_batch, emitter]
    ball_axis = wp.vec3(ball[0], ball[1], ball[2]) - point
    if wp.dot(ball_axis, normal) <= -ball[3]:
        return
    for sphere in range(radii.shape[1]):
        radius = radii[sphere_batch, sphere]
        offset = centers[sphere_batch, sphere] - point
        is_blocker = radius > 0.0 and not _is_skipped(sphere, skipped)
        if is_blocker and reaches_ball(offset, radius, ball_axis, ball[3]):
            for bundle in range(log_transmittances.shape[2] // SAMPLE_BUNDLE):
                first = first_sample + bundle * SAMPLE_BUNDLE
                bundle_ball = bundles[sample_batch, first // SAMPLE_BUNDLE]
                bundle_axis = wp.vec3(bundle_ball[0], bundle_ball[1], bundle_ball[2]) - point
                if reaches_ball(offset, radius, bundle_axis, bundle_ball[3]):
                    for i in range(SAMPLE_BUNDLE):
                        area = sample_areas[sample_batch, first + i]
                        beam = sample_points[sample_batch, first + i] - point
                        blocked_share = float(0.0)
                        if may_light(beam, area, normal, is_two_sided):
                            blocked_share = _blocked_share(offset, beam, sample_radius(area), radius)
                        if blocked_share > 0.0:
                            index = bundle * SAMPLE_BUNDLE + i
                            wp.atomic_add(log_transmittances, batch, receiver, index, log_transmittance(blocked_share))


def find_log_transmittance(
    points: wp.array,
    normals: wp.array,
    samples: PlacedSamples,
    span: EmitterSpan,
    centers: wp.array,
    radii: wp.array,
    skipped: tuple[tuple[int, int], tuple[int, int]],
) -> wp.array:
    """Logarithm of the transmittance of spheres between receivers and an emitter.

    Args:
        points: Receivers [scene units], vec3 of shape [batch, receiver].
        normals: Their unit normals, vec3 of shape [batch, receiver]: samples below horizons are left at 0.
        centers, radii: Spheres [scene units], vec3 and float32 of shape [batch, sphere].
        skipped: Two spans of spheres that do not block: the first, and the one after the last.
            Any batch may be 1.
    Returns:
        Float32 of shape [batch, receiver, sample], 0 where nothing blocks.
    Differentiable: points, samples, centers, radii. Not: normals.
    """
    count = common_batch({"points": points, "emitters": samples.points, "spheres": radii})
    points = expand(points, count)
    result = zeros((count, points.shape[1], span.size), dtype=wp.float32, device=points.device)
    if not radii.shape[1]:
        return result
    skip_values = wp.vec4i(*skipped[0], *skipped[1])
    launch(
        _block_by_spheres,
        count * points.shape[1],
        inputs=[
            *(points, normals, samples.points, samples.areas, samples.bundles, samples.balls),
            *(span.emitter, span.first, int(span.is_two_sided)),
            *(centers, radii, skip_values),
        ],
        outputs=[result],
        shared=[normals, samples.points, samples.areas, centers, radii],
        cost=radii.shape[1] * _COST,
    )
    return result
