"""Tangent planes of proxies: whether a receiver is above the surface that a proxy stands for.

A receiver x at the distance d from a proxy's center takes of its light the factor

    f = ε + (1 − ε) smoothstep((n·(x − p) + d sin σ) / w),  w = b + r/20

with n and p the mean normal and point of the proxy's patches, σ the largest angle of their surface to n, b how far it
lies below the tangent plane, and r the proxy's radius. A flat patch is seen from above alone, one of a ball by σ from
farther below. From afar the area that patches show (:mod:`.projected_areas`) decides that; but a receiver beside or
inside a proxy, as a wall under a roof, has it in all directions.

ε keeps the sum of weights above 0: where cells are blocked by spheres that bulge out of a flat side, and no patch faces
the receiver, the light is the plain mean. Here are n, p, sin σ and w; f is part of a proxy's weight
(:mod:`.proxy_weights`).
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import warp as wp

from warpshadow import check
from warpshadow.device.batch import common_batch, instance_in
from warpshadow.device.constants import constant
from warpshadow.device.launch import launch
from warpshadow.device.memory import empty

if TYPE_CHECKING:
    from warpshadow.stages.patches import Patches

_MIN_WIDTH = 0.05  # least w, in radii


class TangentPlanes(NamedTuple):
    """Tangent planes of proxies."""

    equations: wp.array  # n, and the height of p above the proxy's center [scene units], vec4 of shape [batch, proxy]
    tolerances: wp.array  # sin σ and r/w, vec2 of shape [proxy]


def find_tolerances(patches: "Sequence[Patches]", starts: np.ndarray, patch_indices: np.ndarray) -> np.ndarray:
    """Find sin σ and r/w of proxies.

    Args:
        patches: Of each body, one after another.
        starts, patch_indices: The patches of each proxy, from :func:`.proxy_radiance.patches_of_clusters`. A proxy of
            none, or of patches of several bodies, is seen from everywhere.
    Returns:
        Shape [proxy, 2].
    """
    bodies = np.repeat(np.arange(len(patches)), [item.count for item in patches])[patch_indices]
    normals, centers, areas, spreads, sagittas = (
        np.concatenate([getattr(item, name) for item in patches])[patch_indices]
        for name in ("normals", "centers", "areas", "spreads", "sagittas")
    )
    proxy_count = len(starts) - 1
    proxies = np.repeat(np.arange(proxy_count), np.diff(starts))  # of each patch

    def gathered(ufunc: np.ufunc, values: np.ndarray, initial: float = 0.0) -> np.ndarray:
        result = np.full((proxy_count, *values.shape[1:]), initial)
        ufunc.at(result, proxies, values)
        return result

    normal_sums = gathered(np.add, normals)
    proxy_normals = (normal_sums / np.maximum(np.linalg.norm(normal_sums, axis=1, keepdims=True), 1e-30))[proxies]
    proxy_centers = (gathered(np.add, centers) / np.maximum(np.diff(starts), 1)[:, None])[proxies]
    angles = gathered(np.maximum, np.arccos(np.clip((normals * proxy_normals).sum(axis=1), -1, 1)) + spreads)
    depths = gathered(np.maximum, ((proxy_centers - centers) * proxy_normals).sum(axis=1) + sagittas)
    radii = np.maximum(np.sqrt(gathered(np.add, areas) / 2), 1e-30)
    tolerances = np.stack([np.sin(np.minimum(angles, np.pi / 2)), radii / (depths + _MIN_WIDTH * radii)], axis=1)
    is_of_one_body = gathered(np.maximum, bodies, -1) == gathered(np.minimum, bodies, len(patches))
    return np.where(is_of_one_body[:, None], tolerances, 1.0)


@wp.kernel
def _find_equations(
    # in
    points: wp.array2d(dtype=wp.vec3),
    normals: wp.array2d(dtype=wp.vec3),
    proxy_centers: wp.array2d(dtype=wp.vec3),
    starts: wp.array(dtype=wp.int32),
    patch_indices: wp.array(dtype=wp.int32),
    # out
    equations: wp.array2d(dtype=wp.vec4),
):
    """A thread owns a proxy of an instance."""
    batch, proxy = wp.tid()
    normal_sum = wp.vec3()
    point_sum = wp.vec3()
    for k in range(starts[proxy], starts[proxy + 1]):
        normal_sum += wp.normalize(normals[instance_in(batch, normals.shape[0]), patch_indices[k]])
        point_sum += points[instance_in(batch, points.shape[0]), patch_indices[k]]
    normal = wp.normalize(normal_sum)
    count = float(wp.max(starts[proxy + 1] - starts[proxy], 1))
    center = proxy_centers[instance_in(batch, proxy_centers.shape[0]), proxy]
    height = wp.dot(normal, point_sum / count - center)
    equations[batch, proxy] = wp.vec4(normal[0], normal[1], normal[2], height)


def find_tangent_planes(
    points: wp.array,
    normals: wp.array,
    proxy_centers: wp.array,
    starts: np.ndarray,
    patch_indices: np.ndarray,
    tolerances: np.ndarray,
) -> TangentPlanes:
    """Find the tangent planes of proxies.

    Args:
        points, normals: Mean points and normals of the patches, of any length, vec3 of shape [batch, patch].
        proxy_centers: vec3 of shape [batch, proxy], clusters included.
        starts, patch_indices: The patches of each proxy, from :func:`.proxy_radiance.patches_of_clusters`. A proxy of
            none is seen from everywhere.
        tolerances: From :func:`find_tolerances`, float of shape [proxy, 2].
            Any batch may be 1.
    Differentiable: points, normals, proxy_centers.
    """
    check.shape("tolerances", tolerances.shape, (len(starts) - 1, 2))
    count = common_batch({"points": points, "normals": normals, "proxy_centers": proxy_centers})
    device = proxy_centers.device
    equations = empty((count, len(tolerances)), dtype=wp.vec4, device=device)
    indices = [constant(np.asarray(values, np.int32), wp.int32, device) for values in (starts, patch_indices)]
    launch(_find_equations, equations.shape, inputs=[points, normals, proxy_centers, *indices], outputs=[equations])
    return TangentPlanes(equations, constant(np.asarray(tolerances, np.float32), wp.vec2, device))
