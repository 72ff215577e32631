"""Bright patches: the few that most light comes from, as in a lampshade. Rays are sent to them on purpose.

Rays that are as dense as the cosine find small patches by chance. To N of these, M are added to points of bright
patches, drawn in proportion to radiosity and area, with a density q by area. Rays of both kinds count alike, by the
balance heuristic:

    F_xp = Σ g / (N g + q),   g = V max(n·ω, 0) |m·ω| / (π d²)        [Veach & Guibas 1995, "Optimally Combining
                                                                       Sampling Techniques for Monte Carlo Rendering"]

m is the normal of the patch, d the distance; of a patch that is not bright q is 0, and each ray counts 1 / N.
"""

import numpy as np
import warp as wp

from warpshadow.maths.adjacency import area_normals

_BRIGHT = 8.0  # radiosity from which a patch is bright, in means of the scene: an evenly lit scene has none


@wp.struct
class BrightPatches:
    """Sides of a mesh that get rays of their own."""

    sides: wp.array(dtype=wp.int32)  # face, or face count + face for its back, [bright side]
    distribution: wp.array(dtype=wp.float32)  # sums of their probabilities, [bright side]
    density: wp.array(dtype=wp.float32)  # rays by area of each patch [1 / scene units²], 0 if not bright, [patch]
    ray_count: int


def find_bright_patches(
    radiosity: np.ndarray,
    patch_of_sides: np.ndarray,
    corners: np.ndarray,
    *,
    rays: int,
    min_share: float = 0.0,
    device: wp.DeviceLike,
) -> BrightPatches:
    """Find bright patches, and how rays are shared among them.

    Args:
        radiosity: Of each patch, shape [patch, 3].
        patch_of_sides: Patch of the front and the back of each face, −1 for none, shape [2, face].
        corners: Of the faces [scene units], shape [face, 3, 3].
        rays: To all bright patches, from each receiver; none are sent if no patch is bright.
        min_share: Part of all light that bright patches send at least; otherwise none is bright.
    """
    brightness = radiosity.mean(axis=-1)
    areas = np.linalg.norm(area_normals(corners), axis=1) / 2
    areas, patches = np.tile(areas, 2), patch_of_sides.ravel()
    power = np.where(patches >= 0, areas * brightness[patches], 0)
    mean = power.sum() / max(areas[patches >= 0].sum(), 1e-30)
    is_bright = (patches >= 0) & (brightness[patches] > _BRIGHT * mean) & (power > 0)
    if power[is_bright].sum() < min_share * power.sum():
        is_bright[:] = False
    sides, probability = np.flatnonzero(is_bright), power[is_bright] / max(power[is_bright].sum(), 1e-30)
    density = np.zeros(len(brightness))
    density[patches[sides]] = rays * probability / areas[sides]  # alike on all sides of a patch
    result = BrightPatches()
    result.sides = wp.array(sides, dtype=wp.int32, device=device)
    result.distribution = wp.array(np.cumsum(probability), dtype=wp.float32, device=device)
    result.density = wp.array(density, dtype=wp.float32, device=device)
    result.ray_count = rays if len(sides) else 0
    return result


@wp.func
def point_of_bright_side(bright: BrightPatches, corners: wp.array(dtype=wp.vec3), choice: float, u: float, v: float):
    """Draw a side of bright patches and a point on it, given three numbers even in [0, 1)."""
    side = bright.sides[wp.min(wp.lower_bound(bright.distribution, choice), bright.sides.shape[0] - 1)]
    face = side % (corners.shape[0] // 3)
    root = wp.sqrt(u)
    point = (
        (1.0 - root) * corners[3 * face] + root * (1.0 - v) * corners[3 * face + 1] + root * v * corners[3 * face + 2]
    )
    return side, point


@wp.func
def hit_weight(
    bright: BrightPatches,
    patch: int,
    corners: wp.array(dtype=wp.vec3),
    face: int,
    point: wp.vec3,
    normal: wp.vec3,
    ray_direction: wp.vec3,
    ray_count: int,
):
    """Weight of a ray that meets a patch, N g / (N g + q); 1 if the patch is not bright."""
    if bright.ray_count == 0:
        return 1.0
    density = bright.density[patch]
    if density == 0.0:
        return 1.0
    a = corners[3 * face]
    face_normal = wp.normalize(wp.cross(corners[3 * face + 1] - a, corners[3 * face + 2] - a))
    slope = wp.abs(wp.dot(face_normal, ray_direction))
    height = wp.dot(face_normal, a - point)  # d slope: 0 for a point in the face's plane
    rays = float(ray_count) * wp.dot(normal, ray_direction) * slope * slope * slope
    total = rays + wp.pi * height * height * density
    return wp.where(total > 0.0, rays / total, 1.0)
