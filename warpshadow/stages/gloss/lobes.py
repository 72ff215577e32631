"""Lobes: the directions from which a glossy receiver takes its light, and how much of it.

With a normal n, a viewer v, light from l, n·v = μ and n·l = c the surface reflects f = D V, whose mirrors have normals
h and the width α = roughness² (:mod:`.ggx`). Where normals vary over a receiver by a and b (:mod:`.normal_spread`), its
mirrors are as wide as those of its surface and of its normals together [Kaplanyan et al. 2016, Filtering Distributions
of Normals for Shading Antialiasing]: with a, b and h_t across the normal, and half the variance of a Gaussian, since
the tails of GGX are long,

    W² = α² + (a aᵀ + b bᵀ) / 12,  D = 1 / (π |W| (|W⁻¹h_t|² + (n·h)²)²),  Λ(v) = √((n·v)² + |W v_t|²),

which is that of :mod:`.ggx` for a = b = 0. Samples are mirrors that the viewer sees, spread evenly over them [Dupuy
and Benyoub 2023, Sampling Visible GGX Normals with Spherical Caps]: sample i of N has the weight

    w = G₂ / G₁ / N = c (μ + Λ(μ)) / (c Λ(μ) + μ Λ(c)) / N,   w' = w (1 − v·h)⁵,

so that ∫ f L c dω = Σ w L, and the light of F₀ + (1 − F₀)(1 − v·h)⁵ is F₀ Σ w L + (1 − F₀) Σ w' L. Each sample stands
for a solid angle of 1 / (N p), p = D / (2 (μ + Λ)), so it looks up light that is blurred by a Gaussian of as large
a solid angle, 2π σ² [Křivánek and Colbert 2008, Real-time Shading with Filtered Importance Sampling]:

    σ = (|W⁻¹h_t|² + (n·h)²) √(|W| (μ + Λ) / N) K^(−1/5),

where each of the K samples of a pixel may be a receiver, with N samples of the lobe each.
"""

import functools
from typing import NamedTuple

import numpy as np
import warp as wp

from warpshadow import check
from warpshadow.device.batch import common_batch, instance_in
from warpshadow.device.constants import constant
from warpshadow.device.lanes import lane_count, lane_type, make_lane_functions, module_options, vectors_type
from warpshadow.device.launch import any_requires_grad, launch
from warpshadow.device.memory import empty, in_huge_pages, require_gradient
from warpshadow.device.parallel import split_row
from warpshadow.device.tape import record_adjoint
from warpshadow.stages.gloss.ggx import make_ggx
from warpshadow.stages.gloss.normal_spread import NormalSpread
from warpshadow.stages.raster.project import eye_position

MIN_ROUGHNESS = 0.1  # roughness of the smoothest surface; maps of 128 rows have nothing sharper

MIN_COSINE = 0.02  # cosine between a receiver's normal and its viewer, of those whose interpolated normal turns away
MAX_COSINE = 0.99999

_BLUR_POWER = 0.2
"""Power of the number of places by which blur is narrower, as samples of other places lie between those of one: with 4
places and 8 samples a metal of roughness 0.4 in a room with windows is 2.9% off, 4.2% with 0 and 2.8% with 0.5;
under a sun, before suns were taken out of maps, 16, 10 and 33%."""

_SHAPE_COST, _COST = 50.0, 15.0  # nanoseconds that a lobe takes, and a sample

wp.set_module_options({"max_unroll": 1})


def hemisphere_points(count: int, sample_count: int, place_count: int = 1) -> np.ndarray:
    """Height in the cap and cosine and sine of the azimuth of samples, on spirals: shape [place, sample, 3].

    The spiral of each place is turned, so that together they sample a lobe better. Those past the last, up to a count,
    are all the same.
    """
    i = np.minimum(np.arange(count), sample_count - 1)
    azimuth = np.pi * (1 + np.sqrt(5)) * i + 2 * np.pi / place_count * np.arange(place_count)[:, None]
    return np.stack(
        [np.broadcast_to((i + 0.5) / sample_count, azimuth.shape), np.cos(azimuth), np.sin(azimuth)], axis=2
    )


@wp.func
def _axis_across(direction: wp.vec3):
    """The axis along which a direction has its smallest component."""
    x, y, z = wp.abs(direction[0]), wp.abs(direction[1]), wp.abs(direction[2])
    if x <= y and x <= z:
        return wp.vec3(1.0, 0.0, 0.0)
    if y <= z:
        return wp.vec3(0.0, 1.0, 0.0)
    return wp.vec3(0.0, 0.0, 1.0)


@wp.kernel
def _shape_lobes(
    first_row: int,
    worker: int,
    # in
    points: wp.array2d(dtype=wp.vec3),
    normals: wp.array2d(dtype=wp.vec3),
    roughness: wp.array2d(dtype=wp.float32),
    clip_matrices: wp.array(dtype=wp.mat44),
    along_x: wp.array2d(dtype=wp.vec3),
    along_y: wp.array2d(dtype=wp.vec3),
    # out
    lobe_normals: wp.array2d(dtype=wp.vec3),
    tangents: wp.array2d(dtype=wp.vec3),
    view_terms: wp.array2d(dtype=wp.vec3),
    cap_axes: wp.array2d(dtype=wp.vec3),
    widths: wp.array2d(dtype=wp.vec3),
    cosines: wp.array2d(dtype=wp.float32),
):
    """A thread owns a receiver: the frame of its lobe, sine, cosine and Λ of its view, its cap's axis, and W."""
    batch, receiver = split_row(first_row + wp.tid(), cosines.shape[1])
    point_batch = instance_in(batch, points.shape[0])
    normal = normals[point_batch, receiver]
    eye = eye_position(clip_matrices[instance_in(batch, clip_matrices.shape[0])])
    view = wp.normalize(eye - points[point_batch, receiver])
    rough = wp.max(roughness[instance_in(batch, roughness.shape[0]), receiver], MIN_ROUGHNESS)
    cosine = wp.clamp(wp.dot(normal, view), MIN_COSINE, MAX_COSINE)
    sine = wp.sqrt(1.0 - cosine * cosine)
    across_view = view - wp.dot(normal, view) * normal
    if wp.length_sq(across_view) < 1.0e-10:
        across_view = wp.cross(normal, _axis_across(normal))
    tangent = wp.normalize(across_view)
    square_xx = rough * rough * rough * rough
    square_yy = square_xx
    square_xy = float(0.0)
    if along_x:
        spread_batch = instance_in(batch, along_x.shape[0])
        bitangent = wp.cross(normal, tangent)
        a = along_x[spread_batch, receiver]
        b = along_y[spread_batch, receiver]
        a_x, a_y = wp.dot(a, tangent), wp.dot(a, bitangent)
        b_x, b_y = wp.dot(b, tangent), wp.dot(b, bitangent)
        square_xx += (a_x * a_x + b_x * b_x) / 12.0
        square_xy += (a_x * a_y + b_x * b_y) / 12.0
        square_yy += (a_y * a_y + b_y * b_y) / 12.0
    determinant = wp.sqrt(square_xx * square_yy - square_xy * square_xy)
    trace = wp.sqrt(square_xx + square_yy + 2.0 * determinant)  # of W
    width = wp.vec3(square_xx + determinant, square_xy, square_yy + determinant) / trace
    stretched_view = wp.vec3(width[0] * sine, width[1] * sine, cosine)
    lambda_of_view = wp.length(stretched_view)
    lobe_normals[batch, receiver] = normal
    tangents[batch, receiver] = tangent
    view_terms[batch, receiver] = wp.vec3(sine, cosine, lambda_of_view)
    cap_axes[batch, receiver] = stretched_view / lambda_of_view
    widths[batch, receiver] = width
    cosines[batch, receiver] = cosine


class Lobes(NamedTuple):
    """Lobes of receivers, vec3 of shape [batch, receiver]."""

    normals: wp.array
    tangents: wp.array  # the view is in the plane of these
    view_terms: wp.array  # sine, cosine and Λ of the view
    cap_axes: wp.array  # axes of the caps of mirrors of width 1, in the frame of tangent, bitangent and normal
    widths: wp.array  # W: xx, xy, yy


@functools.cache
def _make_sample_lobes(lanes: int) -> tuple[wp.Kernel, wp.Kernel]:
    """Make the kernel and its adjoint, which take as many samples of a lobe at once as there are lanes."""
    Lane, Vectors, fn = lane_type(lanes), vectors_type(lanes), make_lane_functions(lanes)
    sqrt, is_positive, dot, dot_direction, total = fn.sqrt, fn.is_positive, fn.dot, fn.dot_direction, fn.total
    stretch, smith_lambda, fresnel_weight, fresnel_rate = make_ggx(lanes)

    @wp.func
    def load_or_zero(vectors: wp.array(dtype=wp.vec3), first: int):
        """Load a block of vectors, zeros past the last, since sums over lanes include those."""
        x = Lane()
        y = Lane()
        z = Lane()
        for lane in range(wp.min(lanes, vectors.shape[0] - first)):
            vector = vectors[first + lane]
            x[lane] = vector[0]
            y[lane] = vector[1]
            z[lane] = vector[2]
        return Vectors(x, y, z)

    @wp.func
    def total_vector(x: Lane, y: Lane, z: Lane):
        return wp.vec3(total(x), total(y), total(z))

    @wp.func
    def find_cap(cap: wp.vec3, height_share: Lane, cosine: Lane, sine: Lane):
        """Mirrors of width 1 that are seen, not of unit length, and the cap's radius at their heights."""
        z = (1.0 + cap[2]) * (Lane(1.0) - height_share)
        height = z - Lane(cap[2])
        radius = sqrt(wp.max(Lane(1.0) - wp.cw_mul(height, height), Lane(1.0e-12)))
        x = wp.cw_mul(radius, cosine) + Lane(cap[0])
        y = wp.cw_mul(radius, sine) + Lane(cap[1])
        return Vectors(x, y, z), radius

    @wp.kernel(module="unique", module_options=module_options(lanes), enable_backward=False)
    def sample_lobes(
        first_row: int,
        worker: int,
        # in
        normals: wp.array2d(dtype=wp.vec3),
        tangents: wp.array2d(dtype=wp.vec3),
        view_terms: wp.array2d(dtype=wp.vec3),
        cap_axes: wp.array2d(dtype=wp.vec3),
        widths: wp.array2d(dtype=wp.vec3),
        blur_share: float,
        places: wp.array2d(dtype=wp.int32),
        sample_points: wp.array3d(dtype=Lane),
        # out
        directions: wp.array3d(dtype=wp.vec3),
        weights: wp.array3d(dtype=wp.vec2),
        blurs: wp.array3d(dtype=wp.float32),
    ):
        """A thread owns a receiver."""
        batch, receiver = split_row(first_row + wp.tid(), directions.shape[1])
        normal = normals[batch, receiver]
        tangent = tangents[batch, receiver]
        bitangent = wp.cross(normal, tangent)
        view = view_terms[batch, receiver]
        sine, cosine, lambda_of_view = view[0], view[1], view[2]
        width = widths[batch, receiver]
        weight_scale = (cosine + lambda_of_view) / float(directions.shape[2])
        blur_scale = blur_share * wp.sqrt(weight_scale * (width[0] * width[2] - width[1] * width[1]))
        place = int(0)
        if places:
            place = places[instance_in(batch, places.shape[0]), receiver]
        for block in range(sample_points.shape[2]):
            height_share = sample_points[place, 0, block]
            azimuth_cosine = sample_points[place, 1, block]
            azimuth_sine = sample_points[place, 2, block]
            cap, _radius = find_cap(cap_axes[batch, receiver], height_share, azimuth_cosine, azimuth_sine)
            mirror_x, mirror_y = stretch(width, cap.x, cap.y)
            upright = wp.cw_mul(cap.z, cap.z)
            square = wp.cw_mul(mirror_x, mirror_x) + wp.cw_mul(mirror_y, mirror_y) + upright
            blur = blur_scale * wp.cw_div(wp.cw_mul(cap.x, cap.x) + wp.cw_mul(cap.y, cap.y) + upright, square)
            length = sqrt(square)
            mirror_x = wp.cw_div(mirror_x, length)
            mirror_y = wp.cw_div(mirror_y, length)
            mirror_z = wp.cw_div(cap.z, length)
            view_cosine = sine * mirror_x + cosine * mirror_z
            x = 2.0 * wp.cw_mul(view_cosine, mirror_x) - Lane(sine)
            y = 2.0 * wp.cw_mul(view_cosine, mirror_y)
            z = 2.0 * wp.cw_mul(view_cosine, mirror_z) - Lane(cosine)
            direction_x = tangent[0] * x + bitangent[0] * y + normal[0] * z
            direction_y = tangent[1] * x + bitangent[1] * y + normal[1] * z
            direction_z = tangent[2] * x + bitangent[2] * y + normal[2] * z
            up = wp.max(z, Lane(0.0))
            spread_x, spread_y = stretch(width, x, y)
            lambda_of_light = smith_lambda(spread_x, spread_y, up)
            weight = wp.cw_div(weight_scale * up, lambda_of_view * up + cosine * lambda_of_light)
            weight_f90 = wp.cw_mul(weight, fresnel_weight(view_cosine))
            first = block * lanes
            for lane in range(wp.min(lanes, directions.shape[2] - first)):
                directions[batch, receiver, first + lane] = wp.vec3(
                    direction_x[lane], direction_y[lane], direction_z[lane]
                )
                weights[batch, receiver, first + lane] = wp.vec2(weight[lane], weight_f90[lane])
                blurs[batch, receiver, first + lane] = blur[lane]

    @wp.kernel(module="unique", module_options=module_options(lanes), enable_backward=False)
    def sample_lobes_adjoint(
        first_row: int,
        worker: int,
        # in
        normals: wp.array2d(dtype=wp.vec3),
        tangents: wp.array2d(dtype=wp.vec3),
        view_terms: wp.array2d(dtype=wp.vec3),
        cap_axes: wp.array2d(dtype=wp.vec3),
        widths: wp.array2d(dtype=wp.vec3),
        blur_share: float,
        places: wp.array2d(dtype=wp.int32),
        sample_points: wp.array3d(dtype=Lane),
        adj_directions: wp.array3d(dtype=wp.vec3),
        adj_weights: wp.array3d(dtype=wp.vec2),
        adj_blurs: wp.array3d(dtype=wp.float32),
        # out
        adj_normals: wp.array2d(dtype=wp.vec3),
        adj_tangents: wp.array2d(dtype=wp.vec3),
        adj_views: wp.array2d(dtype=wp.vec3),
        adj_caps: wp.array2d(dtype=wp.vec3),
        adj_widths: wp.array2d(dtype=wp.vec3),
    ):
        """A thread owns a receiver. Gradients are found in the reverse order of the values, by the chain rule."""
        batch, receiver = split_row(first_row + wp.tid(), adj_directions.shape[1])
        normal = normals[batch, receiver]
        tangent = tangents[batch, receiver]
        bitangent = wp.cross(normal, tangent)
        view = view_terms[batch, receiver]
        sine, cosine, lambda_of_view = view[0], view[1], view[2]
        width = widths[batch, receiver]
        weight_scale = (cosine + lambda_of_view) / float(adj_directions.shape[2])
        determinant = width[0] * width[2] - width[1] * width[1]
        blur_scale = blur_share * wp.sqrt(weight_scale * determinant)
        adj_sine = Lane(0.0)
        adj_cosine = Lane(0.0)
        adj_lambda_of_view = Lane(0.0)
        adj_weight_scale = Lane(0.0)
        adj_blur_scale = Lane(0.0)
        adj_width_xx = Lane(0.0)
        adj_width_xy = Lane(0.0)
        adj_width_yy = Lane(0.0)
        adj_axis_x = Lane(0.0)
        adj_axis_y = Lane(0.0)
        adj_axis_z = Lane(0.0)
        adj_tangent = wp.vec3()
        adj_bitangent = wp.vec3()
        adj_normal = wp.vec3()
        place = int(0)
        if places:
            place = places[instance_in(batch, places.shape[0]), receiver]
        for block in range(sample_points.shape[2]):
            height_share = sample_points[place, 0, block]
            azimuth_cosine = sample_points[place, 1, block]
            azimuth_sine = sample_points[place, 2, block]
            cap, radius = find_cap(cap_axes[batch, receiver], height_share, azimuth_cosine, azimuth_sine)
            long_x, long_y = stretch(width, cap.x, cap.y)
            upright = wp.cw_mul(cap.z, cap.z)
            cap_square = wp.cw_mul(cap.x, cap.x) + wp.cw_mul(cap.y, cap.y) + upright
            square = wp.cw_mul(long_x, long_x) + wp.cw_mul(long_y, long_y) + upright
            length = sqrt(square)
            mirror = Vectors(wp.cw_div(long_x, length), wp.cw_div(long_y, length), wp.cw_div(cap.z, length))
            view_cosine = sine * mirror.x + cosine * mirror.z
            x = 2.0 * wp.cw_mul(view_cosine, mirror.x) - Lane(sine)
            y = 2.0 * wp.cw_mul(view_cosine, mirror.y)
            z = 2.0 * wp.cw_mul(view_cosine, mirror.z) - Lane(cosine)
            up = wp.max(z, Lane(0.0))
            spread_x, spread_y = stretch(width, x, y)
            lambda_of_light = smith_lambda(spread_x, spread_y, up)
            denominator = lambda_of_view * up + cosine * lambda_of_light
            weight = wp.cw_div(weight_scale * up, denominator)

            adj_direction = load_or_zero(adj_directions[batch, receiver], block * lanes)
            adj_weight = Lane()
            adj_weight_f90 = Lane()
            adj_blur = Lane()
            first = block * lanes
            for lane in range(wp.min(lanes, adj_directions.shape[2] - first)):
                adj_pair = adj_weights[batch, receiver, first + lane]
                adj_weight[lane] = adj_pair[0]
                adj_weight_f90[lane] = adj_pair[1]
                adj_blur[lane] = adj_blurs[batch, receiver, first + lane]
            adj_weight += wp.cw_mul(adj_weight_f90, fresnel_weight(view_cosine))
            adj_view_cosine = wp.cw_mul(wp.cw_mul(adj_weight_f90, weight), fresnel_rate(view_cosine))
            adj_ratio = wp.cw_div(adj_weight, denominator)
            adj_weight_scale += wp.cw_mul(adj_ratio, up)
            adj_denominator = -1.0 * wp.cw_mul(adj_ratio, weight)
            adj_lambda_of_view += wp.cw_mul(adj_denominator, up)
            adj_cosine += wp.cw_mul(adj_denominator, lambda_of_light)
            adj_square = wp.cw_div(cosine * adj_denominator, lambda_of_light)
            adj_spread_x = wp.cw_mul(adj_square, spread_x)
            adj_spread_y = wp.cw_mul(adj_square, spread_y)
            adj_up = weight_scale * adj_ratio + lambda_of_view * adj_denominator + wp.cw_mul(adj_square, up)
            adj_x, adj_y = stretch(width, adj_spread_x, adj_spread_y)
            adj_x += dot_direction(tangent, adj_direction)
            adj_y += dot_direction(bitangent, adj_direction)
            adj_z = dot_direction(normal, adj_direction) + wp.cw_mul(is_positive(z), adj_up)
            adj_tangent += wp.vec3(wp.dot(x, adj_direction.x), wp.dot(x, adj_direction.y), wp.dot(x, adj_direction.z))
            adj_bitangent += wp.vec3(wp.dot(y, adj_direction.x), wp.dot(y, adj_direction.y), wp.dot(y, adj_direction.z))
            adj_normal += wp.vec3(wp.dot(z, adj_direction.x), wp.dot(z, adj_direction.y), wp.dot(z, adj_direction.z))
            adj_view_cosine += 2.0 * dot(mirror, Vectors(adj_x, adj_y, adj_z))
            adj_sine += wp.cw_mul(adj_view_cosine, mirror.x) - adj_x
            adj_cosine += wp.cw_mul(adj_view_cosine, mirror.z) - adj_z
            adj_mirror = Vectors(
                2.0 * wp.cw_mul(view_cosine, adj_x) + sine * adj_view_cosine,
                2.0 * wp.cw_mul(view_cosine, adj_y),
                2.0 * wp.cw_mul(view_cosine, adj_z) + cosine * adj_view_cosine,
            )
            # of the unit vector, and of the blur, which is |cap|² / |mirror|²
            radial = dot(mirror, adj_mirror)
            blur_ratio = wp.cw_div(adj_blur, square)
            adj_blur_scale += wp.cw_mul(blur_ratio, cap_square)
            adj_cap_square = 2.0 * blur_scale * blur_ratio
            radial += wp.cw_mul(adj_cap_square, cap_square)
            adj_long_x = wp.cw_div(adj_mirror.x - wp.cw_mul(mirror.x, radial), length)
            adj_long_y = wp.cw_div(adj_mirror.y - wp.cw_mul(mirror.y, radial), length)
            adj_cap_z = wp.cw_div(adj_mirror.z - wp.cw_mul(mirror.z, radial), length)
            adj_cap_x, adj_cap_y = stretch(width, adj_long_x, adj_long_y)
            adj_cap_x += wp.cw_mul(adj_cap_square, cap.x)
            adj_cap_y += wp.cw_mul(adj_cap_square, cap.y)
            adj_cap_z += wp.cw_mul(adj_cap_square, cap.z)
            adj_width_xx += wp.cw_mul(adj_long_x, cap.x) + wp.cw_mul(adj_spread_x, x)
            adj_width_yy += wp.cw_mul(adj_long_y, cap.y) + wp.cw_mul(adj_spread_y, y)
            adj_width_xy += wp.cw_mul(adj_long_x, cap.y) + wp.cw_mul(adj_long_y, cap.x)
            adj_width_xy += wp.cw_mul(adj_spread_x, y) + wp.cw_mul(adj_spread_y, x)
            adj_axis_x += adj_cap_x
            adj_axis_y += adj_cap_y
            adj_radius = wp.cw_mul(azimuth_cosine, adj_cap_x) + wp.cw_mul(azimuth_sine, adj_cap_y)
            height = cap.z - Lane(cap_axes[batch, receiver][2])
            adj_height = -1.0 * wp.cw_div(wp.cw_mul(adj_radius, height), radius)
            adj_axis_z += wp.cw_mul(adj_cap_z, Lane(1.0) - height_share) - wp.cw_mul(adj_height, height_share)
        scale_rate = total(adj_weight_scale) / float(adj_directions.shape[2])
        blur_rate = 0.5 * blur_scale * total(adj_blur_scale)
        scale_rate += blur_rate / (cosine + lambda_of_view)
        blur_rate = blur_rate / determinant
        adj_normals[batch, receiver] = adj_normals[batch, receiver] + adj_normal + wp.cross(tangent, adj_bitangent)
        adj_tangents[batch, receiver] = adj_tangents[batch, receiver] + adj_tangent + wp.cross(adj_bitangent, normal)
        adj_views[batch, receiver] = adj_views[batch, receiver] + wp.vec3(
            total(adj_sine), total(adj_cosine) + scale_rate, total(adj_lambda_of_view) + scale_rate
        )
        adj_caps[batch, receiver] = adj_caps[batch, receiver] + total_vector(adj_axis_x, adj_axis_y, adj_axis_z)
        adj_widths[batch, receiver] = (
            adj_widths[batch, receiver]
            + total_vector(adj_width_xx, adj_width_xy, adj_width_yy)
            + blur_rate * wp.vec3(width[2], -2.0 * width[1], width[0])
        )

    return sample_lobes, sample_lobes_adjoint


class LobeSamples(NamedTuple):
    """Samples of the lobes of receivers, and the receivers' cosines."""

    directions: wp.array  # unit vectors, vec3 of shape [batch, receiver, sample]
    weights: wp.array  # w and w', vec2 of the same shape
    blurs: wp.array  # σ [radians], float32 of the same shape
    cosines: wp.array  # μ between normals and viewers, float32 of shape [batch, receiver]
    lobes: Lobes


def sample_lobes(
    points: wp.array,
    normals: wp.array,
    roughness: wp.array,
    clip_matrices: wp.array,
    sample_count: int,
    spread: NormalSpread | None = None,
    places: wp.array | None = None,
    place_count: int = 1,
) -> LobeSamples:
    """Sample the lobes of receivers.

    Args:
        points: Receiver positions [scene units], vec3 of shape [batch, receiver].
        normals: Unit normals, vec3 of shape [batch, receiver].
        roughness: Float32 of shape [batch, receiver].
        clip_matrices: Cameras, mat44 of shape [batch].
            Any batch may be 1 and then serves every instance.
        sample_count: Number of samples.
        spread: How normals vary over the receivers; None for not at all.
        places: Place of each in its pixel, of a number of places, int32 of shape [batch, receiver]: samples of each are
            turned by another angle; None for one place.

    Differentiable: points, normals, roughness, clip_matrices, spread.
    """
    check.shape("normals", normals.shape, points.shape)
    check.shape("roughness", roughness.shape, ("batch", points.shape[1]))
    count = common_batch({"points": points, "roughness": roughness, "clip_matrices": clip_matrices})
    device, shape = points.device, (count, points.shape[1])
    cosines = empty(shape, dtype=wp.float32, device=device)
    lobes = Lobes(*(empty(shape, dtype=wp.vec3, device=device) for _ in Lobes._fields))
    inputs = [points, normals, roughness, clip_matrices, *(spread or (None, None))]
    rows, cost = count * points.shape[1], _COST * sample_count
    launch(
        _shape_lobes,
        rows,
        inputs=inputs,
        outputs=[*lobes, cosines],
        shared=[array for array in inputs if array is not None and (array is clip_matrices or len(array) < count)],
        cost=_SHAPE_COST,
    )
    lanes = lane_count(device)
    sample_points = hemisphere_points(-(-sample_count // lanes) * lanes, sample_count, place_count)
    sample_points = np.swapaxes(sample_points, 1, 2).reshape(place_count, 3, -1, lanes)
    sampled = [*lobes, place_count**-_BLUR_POWER, places, constant(sample_points, lane_type(lanes), device)]
    sample, sample_adjoint = _make_sample_lobes(lanes)
    dtypes = wp.vec3, wp.vec2, wp.float32
    results = [wp.empty((*shape, sample_count), dtype=dtype, device=device) for dtype in dtypes]
    if any_requires_grad(lobes):
        for result in results:
            require_gradient(result)
    launch(sample, rows, inputs=sampled, outputs=[*map(in_huge_pages, results)], cost=cost)

    def adjoint() -> None:
        gradients = [result.grad for result in results]
        outputs = [array.grad for array in lobes]
        launch(sample_adjoint, rows, inputs=[*sampled, *gradients], outputs=outputs, cost=2 * cost)

    record_adjoint(adjoint, [*lobes, *results])
    return LobeSamples(results[0], results[1], results[2], cosines, lobes)
