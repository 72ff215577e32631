"""Proxies: the spheres that send the light of patches of bodies that are not flat.

A patch of area A has a proxy of radius ρ = √(A/2), as wide as the diagonal of a square patch, so that neighbors
overlap; it grows with the body, in the ratio of the nearest sphere that blocks light. Where the body is h thick, its
center is below the patch at the depth

    (3/4 min(h / 2ρ, 1) − 1/4) ρ

- Under a thick body, ρ/2: the proxy bulges out by ρ/2.
- In a sheet, ρ/4 above: the other side has patches of its own.

So a receiver is nearer to visible patches than to those behind them, whose light would shine through a tent or a thin
wall. One that touches a body is within proxies of several of its sides, and sees those whose tangent planes it is above
(:mod:`.tangent_planes`).

One proxy for each patch, not each blocking sphere: the foot of a ball on a ground sees the dark part below the ball.
"""

import numpy as np
import warp as wp

from warpshadow import check
from warpshadow.device.batch import common_batch, instance_in
from warpshadow.device.constants import constant
from warpshadow.device.launch import launch
from warpshadow.device.memory import empty

_DEPTH, _DEPTH_OF_SHEETS = 0.5, -0.25  # how far below its patch a center is, in radii
_OPPOSITE = -0.5  # cosine between the normals of patches on opposite sides of a body, at most
_ABOVE = 0.1  # how far above a patch the other side may lie, in radii: patches of bent sheets are not flat


def find_depths(centers: np.ndarray, normals: np.ndarray, areas: np.ndarray) -> np.ndarray:
    """Find the depth of proxies below their patches, in radii: less where the body is thinner than the proxy.

    Args:
        centers, normals, areas: Of the patches [units of the body], shapes [patch, 3], [patch, 3] and [patch].
    Returns:
        float32 of shape [patch].
    """
    radii = np.sqrt(areas / 2)
    offsets = centers[None] - centers[:, None]
    heights_below = -(normals[:, None] * offsets).sum(axis=2)
    lateral_distances = np.sqrt(np.maximum((offsets**2).sum(axis=2) - heights_below**2, 0))
    is_opposite = normals @ normals.T < _OPPOSITE
    is_opposite &= (lateral_distances < np.maximum(radii[:, None], radii)) & (heights_below > -_ABOVE * radii[:, None])
    thickness = np.where(is_opposite, np.maximum(heights_below, 0), np.inf).min(axis=1, initial=np.inf)
    thickness_shares = np.minimum(thickness / np.maximum(2 * radii, 1e-30), 1)
    return (_DEPTH_OF_SHEETS + (_DEPTH - _DEPTH_OF_SHEETS) * thickness_shares).astype(np.float32)


@wp.kernel
def _place_proxies(
    # in
    points: wp.array2d(dtype=wp.vec3),
    normals: wp.array2d(dtype=wp.vec3),
    blocker_radii: wp.array2d(dtype=wp.float32),
    blocker_indices: wp.array(dtype=wp.int32),
    radius_ratios: wp.array(dtype=wp.float32),
    depths: wp.array(dtype=wp.float32),
    # out
    centers: wp.array2d(dtype=wp.vec3),
    radii: wp.array2d(dtype=wp.float32),
):
    """A thread owns a patch of an instance."""
    batch, patch = wp.tid()
    radius = float(0.0)
    if blocker_indices[patch] >= 0:
        radius = (
            radius_ratios[patch] * blocker_radii[instance_in(batch, blocker_radii.shape[0]), blocker_indices[patch]]
        )
    point = points[instance_in(batch, points.shape[0]), patch]
    normal = normals[instance_in(batch, normals.shape[0]), patch]
    centers[batch, patch] = point - depths[patch] * radius * normal
    radii[batch, patch] = radius


def place_proxies(
    points: wp.array,
    normals: wp.array,
    blocker_radii: wp.array,
    blocker_indices: np.ndarray,
    radius_ratios: np.ndarray,
    depths: np.ndarray,
) -> tuple[wp.array, wp.array]:
    """Place the proxies of patches.

    Args:
        points, normals: Means of the patches, vec3 of shape [batch, patch].
        blocker_radii: Radii of the spheres that block light [scene units], float32 of shape [batch, sphere].
        blocker_indices: One of them beside each patch, −1 for patches without a proxy, shape [patch].
        radius_ratios: Radius of each proxy in radii of that sphere, shape [patch].
        depths: How far below its patch the center of each is, in radii of the proxy, shape [patch].
    Returns:
        Centers, vec3 of shape [batch, patch], and radii, float32 of the same shape.
    Differentiable: points, normals, blocker_radii.
    """
    patch_count = points.shape[1]
    check.shape("blocker_indices", blocker_indices.shape, (patch_count,))
    check.shape("radius_ratios", radius_ratios.shape, (patch_count,))
    check.shape("depths", depths.shape, (patch_count,))
    batch_count = common_batch({"points": points, "normals": normals, "radii": blocker_radii})
    device = blocker_radii.device
    centers = empty((batch_count, len(blocker_indices)), dtype=wp.vec3, device=device)
    radii = empty((batch_count, len(blocker_indices)), dtype=wp.float32, device=device)
    patch_arrays = [constant(np.asarray(blocker_indices, np.int32), wp.int32, device)]
    patch_arrays += [constant(values, wp.float32, device) for values in (radius_ratios, depths)]
    inputs = [points, normals, blocker_radii, *patch_arrays]
    launch(_place_proxies, centers.shape, inputs=inputs, outputs=[centers, radii])
    return centers, radii
