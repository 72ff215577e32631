"""Lobes: the directions from which a glossy receiver takes its light, and how much of it.

The surface is made of mirrors with normals h of the GGX distribution of width α = roughness², which hide each other as
Smith says, correlated by height [glTF 2.0, appendix B]. With n·v = μ and n·l = c it reflects, but for Fresnel's factor,

    f = D V,  D = α² / (π ((n·h)² (α² − 1) + 1)²),  V = ½ / (c Λ(μ) + μ Λ(c)),  Λ(x) = √(x² (1 − α²) + α²).

Samples are mirrors that the viewer sees, spread evenly over them [Dupuy and Benyoub 2023, Sampling Visible GGX Normals
with Spherical Caps]: sample i of N has the weight

    w = G₂ / G₁ / N = c (μ + Λ(μ)) / (c Λ(μ) + μ Λ(c)) / N,   w' = w (1 − v·h)⁵,

so that ∫ f L c dω = Σ w L, and the light of F₀ + (1 − F₀)(1 − v·h)⁵ is F₀ Σ w L + (1 − F₀) Σ w' L. Each sample stands
for a solid angle of 1 / (N p), p = D / (2 (μ + Λ(μ))), so it looks up light that is blurred by a Gaussian of as large
a solid angle, 2π σ² [Křivánek and Colbert 2008, Real-time Shading with Filtered Importance Sampling]:

    σ = (1 − (1 − α²) (n·h)²) √((μ + Λ(μ)) / N) / α.
"""

import functools
from typing import NamedTuple

import numpy as np
import warp as wp

from warpshadow import check
from warpshadow.device.batch import common_batch, instance_in
from warpshadow.device.constants import constant
from warpshadow.device.lanes import lane_count, lane_type, make_lane_functions, module_options
from warpshadow.device.launch import launch
from warpshadow.device.parallel import split_row

MIN_ROUGHNESS = 0.1  # roughness of the smoothest surface; maps of 128 rows have nothing sharper

MIN_COSINE = 0.02  # cosine between a receiver's normal and its viewer, of those whose interpolated normal turns away
MAX_COSINE = 0.99999

_COST = 15.0  # nanoseconds that a sample takes

wp.set_module_options({"max_unroll": 1})


def hemisphere_points(count: int, sample_count: int) -> np.ndarray:
    """Height in the cap and cosine and sine of the azimuth of samples, on a spiral: shape [sample, 3].

    Those past the last, up to a count, are all the same.
    """
    i = np.minimum(np.arange(count), sample_count - 1)
    azimuth = np.pi * (1 + np.sqrt(5)) * i
    return np.stack([(i + 0.5) / sample_count, np.cos(azimuth), np.sin(azimuth)], axis=1)


@wp.func
def eye_position(clip_matrix: wp.mat44):
    """The point that a camera sees the world from, where x, y and w of clip space are all 0."""
    rows = wp.mat33(
        clip_matrix[0, 0],
        clip_matrix[0, 1],
        clip_matrix[0, 2],
        clip_matrix[1, 0],
        clip_matrix[1, 1],
        clip_matrix[1, 2],
        clip_matrix[3, 0],
        clip_matrix[3, 1],
        clip_matrix[3, 2],
    )
    return -(wp.inverse(rows) * wp.vec3(clip_matrix[0, 3], clip_matrix[1, 3], clip_matrix[3, 3]))


@wp.func
def _axis_across(direction: wp.vec3):
    """The axis along which a direction has its smallest component."""
    x, y, z = wp.abs(direction[0]), wp.abs(direction[1]), wp.abs(direction[2])
    if x <= y and x <= z:
        return wp.vec3(1.0, 0.0, 0.0)
    if y <= z:
        return wp.vec3(0.0, 1.0, 0.0)
    return wp.vec3(0.0, 0.0, 1.0)


@functools.cache
def _make_sample_lobes(lanes: int) -> wp.Kernel:
    """Make the kernel, which takes as many samples of a lobe at once as there are lanes."""
    Lane, sqrt = lane_type(lanes), make_lane_functions(lanes).sqrt

    @wp.func
    def root(value: Lane):
        return sqrt(value)

    @wp.func_grad(root)
    def root_adjoint(value: Lane, adj_root: Lane):
        wp.adjoint[value] += wp.cw_div(0.5 * adj_root, sqrt(value))

    @wp.kernel(module="unique", module_options=module_options(lanes))
    def sample_lobes(
        first_row: int,
        worker: int,
        # in
        points: wp.array2d(dtype=wp.vec3),
        normals: wp.array2d(dtype=wp.vec3),
        roughness: wp.array2d(dtype=wp.float32),
        clip_matrices: wp.array(dtype=wp.mat44),
        sample_points: wp.array2d(dtype=Lane),
        # out
        directions: wp.array3d(dtype=wp.vec3),
        filters: wp.array3d(dtype=wp.vec3),
        cosines: wp.array2d(dtype=wp.float32),
    ):
        """A thread owns a receiver."""
        batch, receiver = split_row(first_row + wp.tid(), cosines.shape[1])
        point_batch = instance_in(batch, points.shape[0])
        normal = normals[point_batch, receiver]
        eye = eye_position(clip_matrices[instance_in(batch, clip_matrices.shape[0])])
        view = wp.normalize(eye - points[point_batch, receiver])
        rough = wp.max(roughness[instance_in(batch, roughness.shape[0]), receiver], MIN_ROUGHNESS)
        width = rough * rough
        cosine = wp.clamp(wp.dot(normal, view), MIN_COSINE, MAX_COSINE)
        sine = wp.sqrt(1.0 - cosine * cosine)
        across_view = view - wp.dot(normal, view) * normal
        if wp.length_sq(across_view) < 1.0e-10:
            across_view = wp.cross(normal, _axis_across(normal))
        tangent = wp.normalize(across_view)
        bitangent = wp.cross(normal, tangent)
        square = width * width
        slant = wp.sqrt(cosine * cosine * (1.0 - square) + square)
        blur_of_flat = wp.sqrt((cosine + slant) / (float(directions.shape[2]) * square))
        weight_scale = (cosine + slant) / float(directions.shape[2])
        cosines[batch, receiver] = cosine
        # in the frame of tangent, bitangent and normal; the cap is that of mirrors of width 1
        stretched_view = wp.normalize(wp.vec3(width * sine, 0.0, cosine))
        for block in range(sample_points.shape[1]):
            mirror_z = (1.0 + stretched_view[2]) * (Lane(1.0) - sample_points[0, block])
            height = mirror_z - Lane(stretched_view[2])
            radius = root(wp.max(Lane(1.0) - wp.cw_mul(height, height), Lane(1.0e-12)))
            mirror_x = width * (wp.cw_mul(radius, sample_points[1, block]) + Lane(stretched_view[0]))
            mirror_y = width * wp.cw_mul(radius, sample_points[2, block])
            horizontal = wp.cw_mul(mirror_x, mirror_x) + wp.cw_mul(mirror_y, mirror_y)
            length = root(horizontal + wp.cw_mul(mirror_z, mirror_z))
            mirror_x = wp.cw_div(mirror_x, length)
            mirror_y = wp.cw_div(mirror_y, length)
            mirror_z = wp.cw_div(mirror_z, length)
            view_cosine = sine * mirror_x + cosine * mirror_z
            x = 2.0 * wp.cw_mul(view_cosine, mirror_x) - Lane(sine)
            y = 2.0 * wp.cw_mul(view_cosine, mirror_y)
            z = 2.0 * wp.cw_mul(view_cosine, mirror_z) - Lane(cosine)
            direction_x = tangent[0] * x + bitangent[0] * y + normal[0] * z
            direction_y = tangent[1] * x + bitangent[1] * y + normal[1] * z
            direction_z = tangent[2] * x + bitangent[2] * y + normal[2] * z
            up = wp.max(z, Lane(0.0))
            reflected_slant = root((1.0 - square) * wp.cw_mul(up, up) + Lane(square))
            weight = wp.cw_div(weight_scale * up, slant * up + cosine * reflected_slant)
            grazing_base = wp.max(Lane(1.0) - view_cosine, Lane(0.0))
            grazing_square = wp.cw_mul(grazing_base, grazing_base)
            grazing = wp.cw_mul(weight, wp.cw_mul(wp.cw_mul(grazing_square, grazing_square), grazing_base))
            blur = blur_of_flat * (Lane(1.0) - (1.0 - square) * wp.cw_mul(mirror_z, mirror_z))
            first = block * lanes
            for lane in range(wp.min(lanes, directions.shape[2] - first)):
                directions[batch, receiver, first + lane] = wp.vec3(
                    direction_x[lane], direction_y[lane], direction_z[lane]
                )
                filters[batch, receiver, first + lane] = wp.vec3(weight[lane], grazing[lane], blur[lane])

    return sample_lobes


class LobeSamples(NamedTuple):
    """Samples of the lobes of receivers, and the receivers' cosines."""

    directions: wp.array  # unit vectors, vec3 of shape [batch, receiver, sample]
    filters: wp.array  # w, w' and the blur σ [radians], vec3 of the same shape
    cosines: wp.array  # μ between normals and viewers, float32 of shape [batch, receiver]


def sample_lobes(
    points: wp.array, normals: wp.array, roughness: wp.array, clip_matrices: wp.array, sample_count: int
) -> LobeSamples:
    """Sample the lobes of receivers.

    Args:
        points: Receiver positions [scene units], vec3 of shape [batch, receiver].
        normals: Unit normals, vec3 of shape [batch, receiver].
        roughness: Float32 of shape [batch, receiver].
        clip_matrices: Cameras, mat44 of shape [batch].
            Any batch may be 1 and then serves every instance.
        sample_count: Number of samples.

    Differentiable: points, normals, roughness, clip_matrices.
    """
    check.shape("normals", normals.shape, points.shape)
    check.shape("roughness", roughness.shape, ("batch", points.shape[1]))
    count = common_batch({"points": points, "roughness": roughness, "clip_matrices": clip_matrices})
    device, shape = points.device, (count, points.shape[1], sample_count)
    directions, filters = (wp.empty(shape, dtype=wp.vec3, device=device) for _ in range(2))
    cosines = wp.empty(shape[:2], dtype=wp.float32, device=device)
    lanes = lane_count(device)
    sample_points = hemisphere_points(-(-sample_count // lanes) * lanes, sample_count)
    inputs = [points, normals, roughness, clip_matrices]
    launch(
        _make_sample_lobes(lanes),
        shape[0] * shape[1],
        inputs=[*inputs, constant(sample_points.T.reshape(3, -1, lanes), lane_type(lanes), device)],
        outputs=[directions, filters, cosines],
        shared=[clip_matrices, *(array for array in inputs[:3] if len(array) < count)],
        cost=_COST * sample_count,
    )
    return LobeSamples(directions, filters, cosines)
