"""Receiver means: where the receiver is that samples of a pixel share.

Of samples on one face it is at the mean of their barycentrics. Of samples on several it is at the mean of their points,
or at the point nearest to that on one of their faces.
"""

from typing import NamedTuple

import warp as wp

from warpshadow.device.launch import differentiable, launch
from warpshadow.device.memory import empty
from warpshadow.stages.raster.rasterization import Fragments


class VisibleSurface(NamedTuple):
    """The points that samples see."""

    points: wp.array  # [view, sample] vec3
    normals: wp.array  # [view, sample] vec3
    positions: wp.array  # [vertex] vec3
    faces: wp.array  # [face] vec3i
    pieces: wp.array  # [face] int32, the smooth piece that each is of


@wp.func
def _first_of_pixel(sample: int, width: int, supersampling: int):
    """The first sample of a sample's pixel."""
    return (sample // width // supersampling * width + sample % width // supersampling) * supersampling


@wp.func
def sample_of_pixel(first: int, k: int, width: int, supersampling: int):
    """Sample k of the pixel of a first sample."""
    return first + k // supersampling * width + k % supersampling


@wp.func
def _is_at_corner(is_corner: wp.array2d(dtype=wp.bool), view: int, sample: int):
    """Whether a sample is at the corner of a square, if there are squares."""
    if is_corner:
        return is_corner[view, sample]
    return False


@wp.func
def _shares_receiver(
    owner_samples: wp.array(dtype=wp.int32), sides: wp.array(dtype=wp.int32), is_corner: bool, sample: int, other: int
):
    """Whether two samples average their barycentrics: on one face, and not at the corner of a square."""
    return other == sample or (owner_samples[other] == sample and sides[other] == sides[sample] and not is_corner)


@wp.func
def _nearest_on_face(point: wp.vec3, a: wp.vec3, b: wp.vec3, c: wp.vec3):
    """Barycentrics of the point on a face that is nearest to a point."""
    doubled_normal = wp.cross(b - a, c - a)
    squared_length = wp.max(wp.length_sq(doubled_normal), 1.0e-37)
    v = wp.dot(wp.cross(a - c, point - c), doubled_normal) / squared_length
    w = wp.dot(wp.cross(b - a, point - a), doubled_normal) / squared_length
    weights = wp.vec3(1.0 - v - w, v, w)
    if wp.min(weights) < 0.0:
        min_distance = float(wp.inf)
        corners = wp.matrix_from_rows(a, b, c)
        for k in range(3):
            edge = corners[(k + 1) % 3] - corners[k]
            offset = point - corners[k]
            edge_share = wp.clamp(wp.dot(offset, edge) / wp.max(wp.length_sq(edge), 1.0e-37), 0.0, 1.0)
            distance = wp.length_sq(edge_share * edge - offset)
            if distance < min_distance:
                min_distance = distance
                weights = wp.vec3()
                weights[k] = 1.0 - edge_share
                weights[(k + 1) % 3] = edge_share
    return weights


@wp.kernel(enable_backward=False)
def _find_means(
    # in
    points: wp.array2d(dtype=wp.vec3),
    positions: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    sides: wp.array2d(dtype=wp.int32),
    barycentrics: wp.array2d(dtype=wp.vec3),
    owner_samples: wp.array2d(dtype=wp.int32),
    is_corner: wp.array2d(dtype=wp.bool),
    samples: wp.array2d(dtype=wp.int32),
    width: int,
    supersampling: int,
    # out
    fragment_sides: wp.array2d(dtype=wp.int32),
    means: wp.array2d(dtype=wp.vec3),
    counts: wp.array2d(dtype=wp.int32),
):
    """A thread owns a receiver, whose owner ``samples`` has, −1 for none."""
    view, receiver = wp.tid()
    sample = samples[view, receiver]
    side = int(-1)
    mean = wp.vec3(1.0, 0.0, 0.0)
    count = int(0)
    if sample >= 0:
        side = sides[view, sample]
        is_at_corner = _is_at_corner(is_corner, view, sample)
        barycentric_sum = wp.vec3()
        first = _first_of_pixel(sample, width, supersampling)
        for i in range(supersampling * supersampling):
            other = sample_of_pixel(first, i, width, supersampling)
            if _shares_receiver(owner_samples[view], sides[view], is_at_corner, sample, other):
                barycentric_sum += barycentrics[view, other]
                count += 1
        mean = barycentric_sum / float(count)
        if points:
            # the mean point of all faces that share, or the point nearest to it on one of them
            mean_point = wp.vec3()
            shared_count = int(0)
            for i in range(supersampling * supersampling):
                other = sample_of_pixel(first, i, width, supersampling)
                if owner_samples[view, other] == sample:
                    mean_point += points[view, other]
                    shared_count += 1
            if shared_count > count:
                mean_point = mean_point / float(shared_count)
                min_distance = float(wp.inf)
                for i in range(supersampling * supersampling):
                    other = sample_of_pixel(first, i, width, supersampling)
                    if owner_samples[view, other] == sample:
                        face = faces[sides[view, other] % faces.shape[0]]
                        a, b, c = positions[face[0]], positions[face[1]], positions[face[2]]
                        weights = _nearest_on_face(mean_point, a, b, c)
                        distance = wp.length_sq(weights[0] * a + weights[1] * b + weights[2] * c - mean_point)
                        if distance < min_distance:
                            min_distance = distance
                            side = sides[view, other]
                            mean = weights
    fragment_sides[view, receiver] = side
    means[view, receiver] = mean
    counts[view, receiver] = count


@wp.kernel(enable_backward=False)
def _find_means_adjoint(
    # in
    sides: wp.array2d(dtype=wp.int32),
    owner_samples: wp.array2d(dtype=wp.int32),
    is_corner: wp.array2d(dtype=wp.bool),
    samples: wp.array2d(dtype=wp.int32),
    counts: wp.array2d(dtype=wp.int32),
    has_mean_slope: wp.array2d(dtype=wp.bool),
    width: int,
    supersampling: int,
    adj_means: wp.array2d(dtype=wp.vec3),
    # out
    adj_barycentrics: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a receiver: each of n samples that share it gets an n-th of its gradient, or has a mean slope."""
    view, receiver = wp.tid()
    sample = samples[view, receiver]
    if sample >= 0:
        is_at_corner = _is_at_corner(is_corner, view, sample)
        adj = adj_means[view, receiver] / float(counts[view, receiver])
        first = _first_of_pixel(sample, width, supersampling)
        for i in range(supersampling * supersampling):
            other = sample_of_pixel(first, i, width, supersampling)
            if _shares_receiver(owner_samples[view], sides[view], is_at_corner, sample, other):
                is_pointwise = bool(True)
                if has_mean_slope:
                    is_pointwise = not has_mean_slope[view, other]
                if is_pointwise:
                    wp.atomic_add(adj_barycentrics, view, other, adj)


def mean_fragments(
    surface: VisibleSurface | None,
    fragments: Fragments,
    owner_samples: wp.array,
    is_corner: wp.array | None,
    samples: wp.array,
    supersampling: int,
    has_mean_slope: wp.array | None = None,
) -> Fragments:
    """Find the fragments of receivers.

    Args:
        surface: As for :func:`.sample_receivers.find_sample_receivers`.
        fragments: Sides that samples see, and barycentrics.
        owner_samples: The sample that owns the receiver of each, int32 of shape [view, sample].
        is_corner: Whether each is at the corner of a square, bool of the same shape; None without squares.
        samples: The sample that owns each receiver, −1 for none, int32 of shape [view, receiver].
        has_mean_slope: As for :func:`.sample_receivers.find_sample_receivers`.
    Returns:
        Sides and barycentrics, of shape [view, receiver].
    Differentiable: barycentrics, but for those of samples that have mean slopes.
    """
    sides, barycentrics = fragments.rows
    width, device = fragments.face_ids.shape[2], samples.device
    fragment_sides, counts = (empty(samples.shape, dtype=wp.int32, device=device) for _ in range(2))
    surface_arrays = (surface.points, surface.positions, surface.faces) if surface else (None, None, None)
    inputs = [*surface_arrays, sides, barycentrics, owner_samples, is_corner, samples, width, supersampling]
    means = differentiable(
        lambda means: launch(_find_means, samples.shape, inputs=inputs, outputs=[fragment_sides, means, counts]),
        lambda adj_means: launch(
            _find_means_adjoint,
            samples.shape,
            inputs=[sides, owner_samples, is_corner, samples, counts, has_mean_slope, width, supersampling, adj_means],
            outputs=[barycentrics.grad],
        ),
        result=empty(samples.shape, dtype=wp.vec3, device=device),
        variables=[barycentrics],
    )
    return Fragments(fragment_sides, means)
