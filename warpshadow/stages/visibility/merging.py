"""Merging: four neighboring spheres, seen from so far that they fall into one cell of directions, are one sphere.

Spheres that follow each other in memory make up a cluster. It has a sphere of its own at their middle, and an extent E,
about half of their diameter. A receiver at distance D sees it under a half-angle of about E/D, and takes

    m = smoothstep((τ² − (E/D)²) / (τ² − τ0²)),  τ0 = 0.7 τ

of the cluster's sphere and 1 − m of the four, so that nothing jumps as bodies move. The apparent displacement is τ at
most. [Ren et al. 2006, section 6.2, has hierarchies like this.]

The cluster's sphere is as large as the four look on average over all directions. That has two bounds: the sum of their
discs, S = Σ r²; and, nearly, the shadow of the ellipsoid with their moments M = Σ w_i (d_i d_iᵀ + r_i²/5 I), w_i their
parts of the volume: 5 √(e2(M)/3) on average, e2 the sum of the products of two eigenvalues, times 1.08, since
overlapping spheres bulge out of it. So r² = (S⁻⁴ + (5.4 √(e2/3))⁻⁴)^(−1/4): for four spheres at random the covered area
within 10%, on average.
"""

import functools
from typing import NamedTuple

import warp as wp

from warpshadow import check
from warpshadow.device.batch import concatenate
from warpshadow.device.lanes import lane_type, make_lane_functions, vectors_type
from warpshadow.device.launch import launch
from warpshadow.device.memory import empty
from warpshadow.device.warp_sums import sum_over_warp, sums_over_warp
from warpshadow.stages.visibility.cones import TINY_RADIUS

CLUSTER_SIZE = 4  # spheres that merge, in the order in which they are given: best near each other
NODES_PER_CLUSTER = CLUSTER_SIZE + 1  # spheres of a cluster, its own included
MERGING = 0.75  # τ: half-angle in cell radii under which four spheres are seen as one
MERGED_FROM = 512  # fewer spheres do not merge: they are so large that hardly a receiver is far enough from them

_BLEND_ANGLE_RATIO = 0.7  # τ0 / τ

_ELLIPSOID_AREA_FACTOR = 5.4  # squared radius of an ellipsoid's mean shadow over √(e2/3)

_MAX_DISTANCE2 = 1.0e30  # (D/E)² is kept where its products are float32


class ClusterNodes(NamedTuple):
    """Spheres and, after them, spheres of their clusters, if there are any."""

    centers: wp.array  # [batch, node] vec3
    radii: wp.array  # [batch, node] float32
    extents: wp.array  # [batch, cluster] float32


@wp.kernel
def _merge_clusters(
    # in
    centers: wp.array2d(dtype=wp.vec3),
    radii: wp.array2d(dtype=wp.float32),
    # out
    merged_centers: wp.array2d(dtype=wp.vec3),
    merged_radii: wp.array2d(dtype=wp.float32),
    extents: wp.array2d(dtype=wp.float32),
):
    """A thread owns a cluster."""
    batch, cluster = wp.tid()
    a = centers[batch, 4 * cluster]
    b = centers[batch, 4 * cluster + 1]
    c = centers[batch, 4 * cluster + 2]
    d = centers[batch, 4 * cluster + 3]
    radius = wp.vec4(
        radii[batch, 4 * cluster],
        radii[batch, 4 * cluster + 1],
        radii[batch, 4 * cluster + 2],
        radii[batch, 4 * cluster + 3],
    )
    max_radius = wp.max(radius)
    if max_radius > TINY_RADIUS:
        volume_shares = radius / max_radius
        volume_shares = wp.cw_mul(volume_shares, wp.cw_mul(volume_shares, volume_shares))
        volume_shares = volume_shares / (volume_shares[0] + volume_shares[1] + volume_shares[2] + volume_shares[3])
        center = volume_shares[0] * a + volume_shares[1] * b + volume_shares[2] * c + volume_shares[3] * d
        size = max_radius + wp.max(
            wp.max(wp.max(wp.abs(a - center)), wp.max(wp.abs(b - center))),
            wp.max(wp.max(wp.abs(c - center)), wp.max(wp.abs(d - center))),
        )
        a = (a - center) / size
        b = (b - center) / size
        c = (c - center) / size
        d = (d - center) / size
        squared_radii = wp.cw_mul(radius, radius) / (size * size)
        moments = volume_shares[0] * wp.outer(a, a) + volume_shares[1] * wp.outer(b, b)
        moments += volume_shares[2] * wp.outer(c, c) + volume_shares[3] * wp.outer(d, d)
        moments += 0.2 * wp.dot(volume_shares, squared_radii) * wp.identity(n=3, dtype=wp.float32)
        trace = wp.trace(moments)
        shadow = _ELLIPSOID_AREA_FACTOR * wp.sqrt(wp.max((trace * trace - wp.ddot(moments, moments)) / 6.0, 1.0e-30))
        squared_sum = wp.max(squared_radii[0] + squared_radii[1] + squared_radii[2] + squared_radii[3], 1.0e-15)
        min_square = wp.min(shadow, squared_sum)
        ratio = min_square / wp.max(shadow, squared_sum)
        ratio = ratio * ratio * ratio * ratio
        squared_reaches = squared_radii + wp.vec4(wp.dot(a, a), wp.dot(b, b), wp.dot(c, c), wp.dot(d, d))
        squared_reaches = wp.cw_mul(squared_reaches, squared_reaches)
        merged_centers[batch, cluster] = center
        merged_radii[batch, cluster] = size * wp.sqrt(min_square / wp.sqrt(wp.sqrt(1.0 + ratio)))
        extents[batch, cluster] = size * wp.sqrt(wp.sqrt(wp.sqrt(wp.dot(squared_reaches, squared_reaches))))
    else:
        merged_centers[batch, cluster] = a
        merged_radii[batch, cluster] = max_radius
        extents[batch, cluster] = max_radius


def check_merging(merging: float) -> None:
    """Raise ValueError unless ``merging`` is a half-angle in cell radii, 0 to 1."""
    if not (check.is_number(merging) and 0 <= merging <= 1):
        raise ValueError(f"merging: got {merging!r}, expected 0 (never) to 1 cell radius")


def merged_count(sphere_count: int, merging: float) -> int:
    """Number of clusters that spheres merge into, 0 where they do not.

    Raises:
        ValueError: for ``merging`` out of range.
    """
    check_merging(merging)
    return sphere_count // CLUSTER_SIZE if merging > 0 and sphere_count >= MERGED_FROM else 0


def merge(centers: wp.array, radii: wp.array) -> ClusterNodes:
    """Merge every four consecutive spheres; the remainder stays as it is.

    Args:
        centers, radii: Spheres [scene units], vec3 and float32 of shape [batch, sphere].
    Differentiable: centers, radii.
    """
    batch_count, sphere_count = radii.shape
    shape = batch_count, sphere_count // CLUSTER_SIZE
    merged_centers = empty(shape, dtype=wp.vec3, device=radii.device)
    merged_radii, extents = (empty(shape, dtype=wp.float32, device=radii.device) for _ in range(2))
    launch(_merge_clusters, shape, inputs=[centers, radii], outputs=[merged_centers, merged_radii, extents])
    counts = [sphere_count, shape[1]]
    return ClusterNodes(
        concatenate([centers, merged_centers], counts), concatenate([radii, merged_radii], counts), extents
    )


def merge_if_many(centers: wp.array, radii: wp.array, merging: float) -> ClusterNodes:
    """Merge spheres where there are enough of them and ``merging``, in cell radii, is not 0.

    Raises:
        ValueError: for ``merging`` out of range.
    Differentiable: centers, radii.
    """
    if merged_count(radii.shape[1], merging):
        return merge(centers, radii)
    return ClusterNodes(centers, radii, empty((radii.shape[0], 0), dtype=wp.float32, device=radii.device))


@wp.struct
class SphereClusters:
    """Spheres and their clusters, as kernels see them."""

    centers: wp.array2d(dtype=wp.vec3)  # [batch, node]
    radii: wp.array2d(dtype=wp.float32)
    extents: wp.array2d(dtype=wp.float32)  # [batch, cluster]
    cluster_bounds: wp.array2d(dtype=wp.vec4)
    run_bounds: wp.array2d(dtype=wp.vec4)
    count: int  # of nodes that are no cluster's
    merging_angle: float


@wp.func
def is_skipped_partly(begin: int, end: int, skip: wp.vec2i):
    """Whether any sphere from ``begin`` to ``end`` is skipped."""
    return wp.max(begin, skip[0]) < wp.min(end, skip[1])


@wp.func
def is_skipped(begin: int, end: int, skip: wp.vec2i):
    """Whether all spheres from ``begin`` to ``end`` are skipped."""
    return begin >= skip[0] and end <= skip[1]


@wp.struct
class Gradients:
    """Gradients of spheres, to which adjoints add; arrays of no gradient are empty."""

    centers: wp.array2d(dtype=wp.vec3)
    radii: wp.array2d(dtype=wp.float32)
    extents: wp.array2d(dtype=wp.float32)


@functools.cache
def make_add_to_node(lanes: int) -> wp.Function:
    """Make the kernel function that adds the gradients of a block to a node's."""
    Lane, Vectors = lane_type(lanes), vectors_type(lanes)
    total = make_lane_functions(lanes).total

    @wp.func(inline=True)
    def add_to_node(adj_offset: Vectors, adj_radius: Lane, batch: int, node: int, gradients: Gradients):
        adj = wp.vec4(total(adj_offset.x), total(adj_offset.y), total(adj_offset.z), total(adj_radius))
        if wp.static(lanes == 1):
            node_count = wp.max(gradients.centers.shape[1], gradients.radii.shape[1])
            adj = sums_over_warp(adj, batch * node_count + node)
        if not adj == wp.vec4():  # noqa: SIM201 (vectors have no !=)
            if gradients.centers:
                wp.atomic_add(gradients.centers, batch, node, wp.vec3(adj[0], adj[1], adj[2]))
            if gradients.radii:
                wp.atomic_add(gradients.radii, batch, node, adj[3])

    return add_to_node


@functools.cache
def _make_find_blend(lanes: int) -> wp.Function:
    """Make the kernel function of the weight m of a cluster's sphere: d/E, τ → m, and its derivative by (D/E)²."""
    Lane, Vectors = lane_type(lanes), vectors_type(lanes)
    fn = make_lane_functions(lanes)
    dot, smoothstep = fn.dot, fn.smoothstep
    BLEND2 = wp.constant(_BLEND_ANGLE_RATIO**2)
    MAX_DISTANCE2 = wp.constant(_MAX_DISTANCE2)

    @wp.func
    def find_blend(relative_offset: Vectors, angle: float):
        distance2 = dot(relative_offset, relative_offset)
        inverse2 = wp.cw_div(Lane(1.0), wp.min(wp.max(distance2, Lane(1.0)), Lane(MAX_DISTANCE2)))
        slope = 1.0 / (angle * angle * (1.0 - BLEND2))
        t = wp.min(wp.max(slope * (Lane(angle * angle) - inverse2), Lane(0.0)), Lane(1.0))
        blend_slope = (6.0 * slope) * wp.cw_mul(wp.cw_mul(t, Lane(1.0) - t), wp.cw_mul(inverse2, inverse2))
        return smoothstep(t), blend_slope

    return find_blend


@functools.cache
def _make_offset_over_extent(lanes: int) -> wp.Function:
    """Make the kernel function of the offset from a block of receivers to a cluster, over its extent: d/E and 1/E."""
    Lane, Vectors = lane_type(lanes), vectors_type(lanes)

    @wp.func
    def offset_over_extent(points: Vectors, batch: int, cluster: int, spheres: SphereClusters):
        center = spheres.centers[batch, spheres.count + cluster]
        inverse_extent = 1.0 / wp.max(spheres.extents[batch, cluster], TINY_RADIUS)
        relative_offset = Vectors(
            inverse_extent * (Lane(center[0]) - points.x),
            inverse_extent * (Lane(center[1]) - points.y),
            inverse_extent * (Lane(center[2]) - points.z),
        )
        return relative_offset, inverse_extent

    return offset_over_extent


@functools.cache
def make_cluster_weight(lanes: int) -> wp.Function:
    """Make the kernel function of the weight that a cluster's sphere has for a block of receivers."""
    Vectors = vectors_type(lanes)
    find_blend, offset_over_extent = _make_find_blend(lanes), _make_offset_over_extent(lanes)

    @wp.func
    def find_cluster_weight(points: Vectors, batch: int, cluster: int, spheres: SphereClusters):
        relative_offset, _inverse_extent = offset_over_extent(points, batch, cluster, spheres)
        cluster_weight, _slope = find_blend(relative_offset, spheres.merging_angle)
        return cluster_weight

    return find_cluster_weight


@functools.cache
def make_cluster_weight_adjoint(lanes: int) -> wp.Function:
    """Make the adjoint of the cluster weight: m̄ → the adjoint of the offset to a cluster, added to the cluster's own.

    With x = d/E and X² = |x|²:  X̄² = m' m̄,  d̄ = 2 x X̄² / E,  Ē = −2 X² X̄² / E.
    """
    Lane, Vectors = lane_type(lanes), vectors_type(lanes)
    find_blend, offset_over_extent = _make_find_blend(lanes), _make_offset_over_extent(lanes)
    add_to_node = make_add_to_node(lanes)
    fn = make_lane_functions(lanes)
    is_any_above, scale, dot, total = fn.is_any_above, fn.scale, fn.dot, fn.total

    @wp.func
    def adjoint(
        points: Vectors,
        batch: int,
        cluster: int,
        adj_cluster_weight: Lane,
        spheres: SphereClusters,
        gradients: Gradients,
    ):
        adj_offset = Vectors()
        relative_offset, inverse_extent = offset_over_extent(points, batch, cluster, spheres)
        _cluster_weight, slope = find_blend(relative_offset, spheres.merging_angle)
        if is_any_above(slope, 0.0):
            adj_offset = scale((2.0 * inverse_extent) * wp.cw_mul(adj_cluster_weight, slope), relative_offset)
            add_to_node(adj_offset, Lane(0.0), batch, spheres.count + cluster, gradients)
            if gradients.extents:
                adj_extent = -total(dot(adj_offset, relative_offset))
                if wp.static(lanes == 1):
                    adj_extent = sum_over_warp(adj_extent, batch * gradients.extents.shape[1] + cluster)
                if adj_extent != 0.0:
                    wp.atomic_add(gradients.extents, batch, cluster, adj_extent)
        return adj_offset

    return adjoint
