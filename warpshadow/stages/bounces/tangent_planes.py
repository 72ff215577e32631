"""Tangent planes of nodes: a receiver below the plane of a proxy's patches sees nothing of them.

The area that a patch shows towards a direction tells which side of it is seen from afar. A receiver beside or inside
its proxy, such as a wall that carries a roof, has the proxy in all directions, and would see the sunlit top of the roof
through those that the top faces. So a node with mean normal n and mean point p of its patches, σ the largest angle of
their surface to n, counts for a receiver x, at a distance d from the node's center, by

    f = ε + (1 − ε) smoothstep((n·(x − p) + d sin σ) / w),  w = b + r/20,

with b how far the surface lies below the plane, and r the node's radius. A flat patch is seen from above alone, one of
a ball by σ from farther below. ε is small beside the weight of what is seen; where nothing is, in cells that are
blocked by spheres that bulge out of a flat side, it leaves the mean of all. Without f, planks under a barn's eaves got
five times as much light from the roof.
"""

import functools
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import warp as wp

from warpshadow import check
from warpshadow.device.batch import common_batch, instance_in
from warpshadow.device.constants import constant
from warpshadow.device.lanes import lane_type, make_lane_functions, vectors_type
from warpshadow.device.launch import launch
from warpshadow.device.memory import empty

if TYPE_CHECKING:
    from warpshadow.stages.bounces.patches import Patches

_MIN_WIDTH = 0.05  # least w, in radii
_HIDDEN = 1.0e-8  # ε
_TINY = 1.0e-18  # distance that has a derivative


class TangentPlanes(NamedTuple):
    """Tangent planes of nodes: spheres, and the clusters that they merge into.

    Args:
        planes: n, and the height of p above the node's center [scene units], vec4 of shape [batch, node].
        tolerances: sin σ and r/w, vec2 of shape [node].
    """

    planes: wp.array
    tolerances: wp.array


def find_tolerances(patches: "Sequence[Patches]", starts: np.ndarray, patch_indices: np.ndarray) -> np.ndarray:
    """Find sin σ and r/w of nodes.

    Args:
        patches: Of each body, one after another.
        starts, patch_indices: The patches of each node, from :func:`.proxy_radiance.patches_of_clusters`. A node of
            none, or of patches of several bodies, is seen from everywhere.
    Returns:
        Shape [node, 2].
    """
    bodies = np.repeat(np.arange(len(patches)), [item.count for item in patches])[patch_indices]
    normals, centers, areas, spreads, sagittas = (
        np.concatenate([getattr(item, name) for item in patches])[patch_indices]
        for name in ("normals", "centers", "areas", "spreads", "sagittas")
    )
    node_count = len(starts) - 1
    nodes = np.repeat(np.arange(node_count), np.diff(starts))  # of each patch

    def gathered(ufunc: np.ufunc, values: np.ndarray, initial: float = 0.0) -> np.ndarray:
        result = np.full((node_count, *values.shape[1:]), initial)
        ufunc.at(result, nodes, values)
        return result

    normal_sums = gathered(np.add, normals)
    node_normals = (normal_sums / np.maximum(np.linalg.norm(normal_sums, axis=1, keepdims=True), 1e-30))[nodes]
    node_centers = (gathered(np.add, centers) / np.maximum(np.diff(starts), 1)[:, None])[nodes]
    angles = gathered(np.maximum, np.arccos(np.clip((normals * node_normals).sum(axis=1), -1, 1)) + spreads)
    depths = gathered(np.maximum, ((node_centers - centers) * node_normals).sum(axis=1) + sagittas)
    radii = np.maximum(np.sqrt(gathered(np.add, areas) / 2), 1e-30)
    tolerances = np.stack([np.sin(np.minimum(angles, np.pi / 2)), radii / (depths + _MIN_WIDTH * radii)], axis=1)
    is_of_one_body = gathered(np.maximum, bodies, -1) == gathered(np.minimum, bodies, len(patches))
    return np.where(is_of_one_body[:, None], tolerances, 1.0)


@wp.kernel
def _find_planes(
    # in
    points: wp.array2d(dtype=wp.vec3),
    normals: wp.array2d(dtype=wp.vec3),
    node_centers: wp.array2d(dtype=wp.vec3),
    starts: wp.array(dtype=wp.int32),
    patch_indices: wp.array(dtype=wp.int32),
    # out
    planes: wp.array2d(dtype=wp.vec4),
):
    """A thread owns a node of an instance."""
    batch, node = wp.tid()
    normal_sum = wp.vec3()
    point_sum = wp.vec3()
    for k in range(starts[node], starts[node + 1]):
        normal_sum += wp.normalize(normals[instance_in(batch, normals.shape[0]), patch_indices[k]])
        point_sum += points[instance_in(batch, points.shape[0]), patch_indices[k]]
    normal = wp.normalize(normal_sum)
    count = float(wp.max(starts[node + 1] - starts[node], 1))
    center = node_centers[instance_in(batch, node_centers.shape[0]), node]
    height = wp.dot(normal, point_sum / count - center)
    planes[batch, node] = wp.vec4(normal[0], normal[1], normal[2], height)


def find_tangent_planes(
    points: wp.array,
    normals: wp.array,
    node_centers: wp.array,
    starts: np.ndarray,
    patch_indices: np.ndarray,
    tolerances: np.ndarray,
) -> TangentPlanes:
    """Find the tangent planes of nodes.

    Args:
        points, normals: Mean points and normals of the patches, of any length, vec3 of shape [batch, patch].
        node_centers: Of spheres and the clusters that they merge into, vec3 of shape [batch, node].
        starts, patch_indices: The patches of each node, from :func:`.proxy_radiance.patches_of_clusters`. A node of
            none is seen from everywhere.
        tolerances: From :func:`find_tolerances`, float of shape [node, 2].
            Any batch may be 1.
    Differentiable: points, normals, node_centers.
    """
    check.shape("tolerances", tolerances.shape, (len(starts) - 1, 2))
    count = common_batch({"points": points, "normals": normals, "node_centers": node_centers})
    device = node_centers.device
    planes = empty((count, len(tolerances)), dtype=wp.vec4, device=device)
    indices = [constant(np.asarray(values, np.int32), wp.int32, device) for values in (starts, patch_indices)]
    launch(_find_planes, planes.shape, inputs=[points, normals, node_centers, *indices], outputs=[planes])
    return TangentPlanes(planes, constant(np.asarray(tolerances, np.float32), wp.vec2, device))


class FacingFunctions(NamedTuple):
    """Functions for blocks of receivers."""

    share: wp.Function  # offset from a receiver to the node, 1/r, plane, tolerance → f
    adjoint: wp.Function  # … and f f̄ → the adjoints of offset, r and plane


@functools.cache
def make_facing(lanes: int) -> FacingFunctions:
    """Make the functions of the part of a node's light that receivers see by their tangent planes."""
    Lane, Vectors = lane_type(lanes), vectors_type(lanes)
    fn = make_lane_functions(lanes)
    sqrt, dot, dot_direction, total, scale, add = fn.sqrt, fn.dot, fn.dot_direction, fn.total, fn.scale, fn.add
    TINY = wp.constant(_TINY)
    HIDDEN = wp.constant(_HIDDEN)

    @wp.func(inline=True)
    def height(offset: Vectors, plane: wp.vec4, tolerance: wp.vec2):
        """How far receivers are above the plane, d sin σ added."""
        normal = wp.vec3(plane[0], plane[1], plane[2])
        return tolerance[0] * sqrt(dot(offset, offset)) - dot_direction(normal, offset) - Lane(plane[3])

    @wp.func(inline=True)
    def share(offset: Vectors, curvature: float, plane: wp.vec4, tolerance: wp.vec2):
        x = (tolerance[1] * curvature) * height(offset, plane, tolerance)
        x = wp.min(wp.max(x, Lane(0.0)), Lane(1.0))
        return Lane(HIDDEN) + (1.0 - HIDDEN) * wp.cw_mul(wp.cw_mul(x, x), Lane(3.0) - 2.0 * x)

    @wp.func(inline=True)
    def adjoint(offset: Vectors, curvature: float, plane: wp.vec4, tolerance: wp.vec2, weighted_adjoint: Lane):
        """With f = ε + (1 − ε) x² (3 − 2x): f' / f = (1 − ε) 6 x (1 − x) / f."""
        receiver_height = height(offset, plane, tolerance)
        x = (tolerance[1] * curvature) * receiver_height
        x = wp.min(wp.max(x, Lane(0.0)), Lane(1.0))
        slope = (6.0 * (1.0 - HIDDEN)) * wp.cw_mul(x, Lane(1.0) - x)
        relative_slope = wp.cw_div(slope, share(offset, curvature, plane, tolerance))
        adj_height = (tolerance[1] * curvature) * wp.cw_mul(relative_slope, weighted_adjoint)
        adj_normal = scale(-adj_height, offset)
        adj_plane = wp.vec4(total(adj_normal.x), total(adj_normal.y), total(adj_normal.z), -total(adj_height))
        distance = wp.max(sqrt(dot(offset, offset)), Lane(TINY))
        adj_offset = scale(wp.cw_div(tolerance[0] * adj_height, distance), offset)
        adj_offset = add(adj_offset, Vectors(-plane[0] * adj_height, -plane[1] * adj_height, -plane[2] * adj_height))
        adj_radius = -curvature * wp.cw_mul(adj_height, receiver_height)
        return adj_offset, adj_radius, adj_plane

    return FacingFunctions(share, adjoint)
