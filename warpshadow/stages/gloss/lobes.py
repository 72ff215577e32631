"""Lobes: the directions from which a glossy receiver takes its light, and how much of it.

The surface is made of mirrors with normals h of the GGX distribution of width α = roughness², which hide each other as
Smith says, correlated by height [glTF 2.0, appendix B]. With n·v = μ and n·l = c it reflects, but for Fresnel's factor,

    f = D V,  D = α² / (π ((n·h)² (α² − 1) + 1)²),  V = ½ / (c Λ(μ) + μ Λ(c)),  Λ(x) = √(x² (1 − α²) + α²).

Samples are mirrors that the viewer sees, spread evenly over them [Dupuy and Benyoub 2023, Sampling Visible GGX Normals
with Spherical Caps]: sample i of N has the weight

    w = G₂ / G₁ / N = c (μ + Λ(μ)) / (c Λ(μ) + μ Λ(c)) / N,   w' = w (1 − v·h)⁵,

so that ∫ f L c dω = Σ w L, and the light of F₀ + (1 − F₀)(1 − v·h)⁵ is F₀ Σ w L + (1 − F₀) Σ w' L. Each sample stands
for a solid angle of 1 / (N p), p = D / (2 (μ + Λ(μ))), so it looks up light that is blurred by a Gaussian of as large
a solid angle, 2π σ² [Křivánek and Colbert 2008, Real-time Shading with Filtered Importance Sampling].
"""

import numpy as np
import warp as wp

from warpshadow import check
from warpshadow.device.batch import common_batch, instance_in
from warpshadow.device.constants import constant
from warpshadow.device.launch import launch
from warpshadow.device.parallel import split_row

MIN_ROUGHNESS = 0.1  # roughness of the smoothest surface; maps of 128 rows have nothing sharper

_MIN_COSINE = 0.02  # cosine between a receiver's normal and its viewer, of those whose interpolated normal turns away

_COST = 60.0  # nanoseconds that a sample takes

wp.set_module_options({"max_unroll": 1})


def hemisphere_points(count: int) -> np.ndarray:
    """Height in the cap and cosine and sine of the azimuth of each sample, on a spiral: shape [sample, 3]."""
    i = np.arange(count)
    azimuth = np.pi * (1 + np.sqrt(5)) * i
    return np.stack([(i + 0.5) / count, np.cos(azimuth), np.sin(azimuth)], axis=1)


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
def _slant(x: float, width: float):
    """Λ."""
    return wp.sqrt(x * x * (1.0 - width * width) + width * width)


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
def _sample_lobes(
    first_row: int,
    worker: int,
    # in
    points: wp.array2d(dtype=wp.vec3),
    normals: wp.array2d(dtype=wp.vec3),
    roughness: wp.array2d(dtype=wp.float32),
    clip_matrices: wp.array(dtype=wp.mat44),
    sample_points: wp.array(dtype=wp.vec3),
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
    cosine = wp.clamp(wp.dot(normal, view), _MIN_COSINE, 0.99999)
    sine = wp.sqrt(1.0 - cosine * cosine)
    across_view = view - wp.dot(normal, view) * normal
    if wp.length_sq(across_view) < 1.0e-10:
        across_view = wp.cross(normal, _axis_across(normal))
    tangent = wp.normalize(across_view)
    bitangent = wp.cross(normal, tangent)
    slant = _slant(cosine, width)
    cosines[batch, receiver] = cosine
    # in the frame of tangent, bitangent and normal; the cap is that of mirrors of width 1
    stretched_view = wp.normalize(wp.vec3(width * sine, 0.0, cosine))
    for i in range(directions.shape[2]):
        sample_point = sample_points[i]
        height = (1.0 - sample_point[0]) * (1.0 + stretched_view[2]) - stretched_view[2]
        radius = wp.sqrt(wp.max(1.0 - height * height, 1.0e-12))
        mirror = wp.normalize(
            wp.vec3(
                width * (radius * sample_point[1] + stretched_view[0]),
                width * radius * sample_point[2],
                (1.0 - sample_point[0]) * (1.0 + stretched_view[2]),
            )
        )
        view_cosine = mirror[0] * sine + mirror[2] * cosine
        reflected_cosine = 2.0 * view_cosine * mirror[2] - cosine
        direction = (
            (2.0 * view_cosine * mirror[0] - sine) * tangent
            + 2.0 * view_cosine * mirror[1] * bitangent
            + reflected_cosine * normal
        )
        directions[batch, receiver, i] = wp.normalize(direction)
        weight = float(0.0)
        if reflected_cosine > 0.0:
            weight = (
                reflected_cosine
                * (cosine + slant)
                / (reflected_cosine * slant + cosine * _slant(reflected_cosine, width))
                / float(directions.shape[2])
            )
        grazing_base = wp.max(1.0 - view_cosine, 0.0)
        ellipsoid = mirror[2] * mirror[2] * (width * width - 1.0) + 1.0
        density = width * width / (wp.pi * ellipsoid * ellipsoid) / (2.0 * (cosine + slant))
        blur = wp.sqrt(1.0 / (2.0 * wp.pi * float(directions.shape[2]) * density))
        filters[batch, receiver, i] = wp.vec3(
            weight, weight * grazing_base * grazing_base * grazing_base * grazing_base * grazing_base, blur
        )


def sample_lobes(
    points: wp.array, normals: wp.array, roughness: wp.array, clip_matrices: wp.array, sample_count: int
) -> tuple[wp.array, wp.array, wp.array]:
    """Sample the lobes of receivers.

    Args:
        points: Receiver positions [scene units], vec3 of shape [batch, receiver].
        normals: Unit normals, vec3 of shape [batch, receiver].
        roughness: Float32 of shape [batch, receiver].
        clip_matrices: Cameras, mat44 of shape [batch].
            Any batch may be 1 and then serves every instance.
        sample_count: Number of samples.

    Returns:
        Directions, unit vectors, vec3 of shape [batch, receiver, sample]; filters, w, w' and the blur σ [radians],
        vec3 of the same shape; and the cosines μ between normals and viewers, float32 of shape [batch, receiver].

    Differentiable: points, normals, roughness, clip_matrices.
    """
    check.shape("normals", normals.shape, points.shape)
    check.shape("roughness", roughness.shape, ("batch", points.shape[1]))
    count = common_batch({"points": points, "roughness": roughness, "clip_matrices": clip_matrices})
    device, shape = points.device, (count, points.shape[1], sample_count)
    directions, filters = (wp.empty(shape, dtype=wp.vec3, device=device) for _ in range(2))
    cosines = wp.empty(shape[:2], dtype=wp.float32, device=device)
    launch(
        _sample_lobes,
        shape[0] * shape[1],
        inputs=[points, normals, roughness, clip_matrices, constant(hemisphere_points(sample_count), wp.vec3, device)],
        outputs=[directions, filters, cosines],
        shared=[clip_matrices, points, normals, roughness],
        cost=_COST * sample_count,
    )
    return directions, filters, cosines
