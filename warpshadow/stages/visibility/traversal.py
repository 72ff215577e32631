"""The traversal of spheres: a block of receivers visits the spheres that it can see, many at once left out.

Four spheres that follow each other make up a cluster, which has a sphere of its own for receivers far away
(:mod:`warpshadow.stages.visibility.merging`), and four clusters a run. Runs are culled as a whole; then clusters; then
spheres are visited. A method supplies culling and a visit; the traversal is generated around them, forward and adjoint.
"""

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import warp as wp

from warpshadow.device.lanes import lane_count, lane_type, make_lane_functions, vectors_type
from warpshadow.device.launch import launch
from warpshadow.device.memory import empty
from warpshadow.device.warp_internals import struct_of
from warpshadow.stages.receivers.body_spans import (
    ReceiverSpans,
    Span,
    SpanValues,
    make_find_span,
    receiver_spans,
    span_values,
    value_of_span,
)
from warpshadow.stages.visibility.cones import TINY_RADIUS, check_spheres, cone_type, make_cone
from warpshadow.stages.visibility.merging import (
    CLUSTER_SIZE,
    NODES_PER_CLUSTER,
    ClusterNodes,
    Gradients,
    SphereClusters,
    is_skipped,
    is_skipped_partly,
    make_add_to_node,
    make_cluster_weight,
    make_cluster_weight_adjoint,
    merge_if_many,
)

CLUSTERS_PER_RUN = 4  # clusters culled by one bound, which is tight if neighbors in the list are neighbors in space
ALL_BUNDLES = -1  # number of candidates of a run: all bundles


@wp.func
def find_node(cluster: int, item: int, sphere_count: int, node_count: int):
    """Node of an item of a cluster: its four spheres and then its own; −1 where there is none."""
    node = cluster * CLUSTER_SIZE + item
    end_node = sphere_count
    if item == CLUSTER_SIZE:
        node = sphere_count + cluster
        end_node = node_count
    if node >= end_node:
        node = -1
    return node


@wp.kernel(enable_backward=False)
def _bound_clusters(
    # in
    centers: wp.array2d(dtype=wp.vec3),
    radii: wp.array2d(dtype=wp.float32),
    sphere_count: int,
    # out
    cluster_bounds: wp.array2d(dtype=wp.vec4),
    run_bounds: wp.array2d(dtype=wp.vec4),
):
    """A thread owns a cluster, or a run: center and radius of a sphere around its spheres, below 0 for none."""
    batch, item = wp.tid()
    cluster_count = int(1)
    index = item
    if item >= cluster_bounds.shape[1]:
        cluster_count = CLUSTERS_PER_RUN
        index = item - cluster_bounds.shape[1]
    lower = wp.vec3(wp.inf)
    upper = wp.vec3(-wp.inf)
    for k in range(cluster_count * NODES_PER_CLUSTER):
        node = find_node(
            index * cluster_count + k // NODES_PER_CLUSTER, k % NODES_PER_CLUSTER, sphere_count, radii.shape[1]
        )
        if node >= 0 and radii[batch, wp.max(node, 0)] > TINY_RADIUS:
            extent = wp.vec3(radii[batch, node])
            lower = wp.min(lower, centers[batch, node] - extent)
            upper = wp.max(upper, centers[batch, node] + extent)
    center = 0.5 * (lower + upper)
    radius_of_bound = float(-1.0)
    for k in range(cluster_count * NODES_PER_CLUSTER):
        node = find_node(
            index * cluster_count + k // NODES_PER_CLUSTER, k % NODES_PER_CLUSTER, sphere_count, radii.shape[1]
        )
        if node >= 0 and radii[batch, wp.max(node, 0)] > TINY_RADIUS:
            radius_of_bound = wp.max(radius_of_bound, wp.length(centers[batch, node] - center) + radii[batch, node])
    if radius_of_bound < 0.0:
        center = wp.vec3(0.0)
    bound = wp.vec4(center[0], center[1], center[2], radius_of_bound)
    if item < cluster_bounds.shape[1]:
        cluster_bounds[batch, index] = bound
    else:
        run_bounds[batch, index] = bound


class ClusterTree(NamedTuple):
    """Spheres with their clusters and the bounds of these, which serve any receivers."""

    nodes: ClusterNodes
    cluster_bounds: wp.array
    run_bounds: wp.array


def find_clusters(centers: wp.array, radii: wp.array, merging: float) -> ClusterTree:
    """Merge spheres where there are enough of them, and bound their clusters and runs.

    Args:
        centers, radii: Spheres, [batch, sphere].
        merging: τ, 0 for never.
    Differentiable: centers, radii to the nodes.
    """
    nodes, (batch_count, sphere_count), device = merge_if_many(centers, radii, merging), radii.shape, radii.device
    counts = [-(-sphere_count // (CLUSTER_SIZE * clusters)) for clusters in (1, CLUSTERS_PER_RUN)]
    bounds = [empty((batch_count, count), dtype=wp.vec4, device=device) for count in counts]
    inputs = [nodes.centers, nodes.radii, sphere_count]
    launch(_bound_clusters, (batch_count, sum(counts)), inputs=inputs, outputs=bounds)
    return ClusterTree(nodes, *bounds)


@wp.struct
class TraversalInputs:
    """Receivers, and the spheres that they may see."""

    points: wp.array2d(dtype=wp.vec3)
    normals: wp.array2d(dtype=wp.vec3)  # empty where there is no horizon
    footprints: wp.array2d(dtype=wp.vec3)  # empty where receivers are points
    spans: ReceiverSpans
    skip_begins: SpanValues  # spheres that a span leaves out
    skip_ends: SpanValues
    spheres: SphereClusters


class SphereTraversal(NamedTuple):
    """A launch in which each block of receivers traverses spheres."""

    inputs: TraversalInputs
    nodes: ClusterNodes  # the spheres as arrays, to whose gradients all rows add
    lanes: int  # receivers of a block
    row_count: int  # blocks of all instances


def prepare_traversal(
    points: wp.array,
    normals: wp.array | None,
    centers: wp.array,
    radii: wp.array,
    cell_radius: float,
    *,
    merging: float,
    body_spans: Sequence[Span] = (),
    skips: Sequence[tuple[int, int]] = (),
    clusters: ClusterTree | None = None,
) -> SphereTraversal:
    """Put receivers together with spheres and their clusters.

    Args:
        points, normals: Receivers, [batch, receiver].
        centers, radii: Spheres, [batch, sphere].
        cell_radius: Radius of a cell [rad].
        merging: τ in cell radii, 0 for never.
        body_spans: Of the receivers; () for one of all.
        skips: Spheres that each span leaves out: the first, and the one after the last; () for none.
        clusters: Of these spheres, where they are found already.
    Raises:
        ValueError: for NaN, Inf, numbers beyond 1e18 and negative radii.
    Differentiable: centers, radii to the nodes.
    """
    check_spheres(points, normals, centers, radii)
    count, lanes = radii.shape[1], lane_count(points.device)
    skips = skips or ((0, 0),) * max(len(body_spans), 1)
    for skip in skips:
        if not 0 <= skip[0] <= skip[1] <= count:
            raise ValueError(f"skips: got {skip!r}, expected a first and an end of {count} spheres")
    nodes, cluster_bounds, run_bounds = find_clusters(centers, radii, merging) if clusters is None else clusters
    inputs = struct_of(
        TraversalInputs,
        points=points,
        normals=normals,
        footprints=None,
        spans=receiver_spans(body_spans, points.shape[1], lanes, points.device),
        skip_begins=span_values([begin for begin, _ in skips], points.device),
        skip_ends=span_values([end for _, end in skips], points.device),
        spheres=struct_of(
            SphereClusters,
            **nodes._asdict(),
            cluster_bounds=cluster_bounds,
            run_bounds=run_bounds,
            count=count,
            merging_angle=merging * cell_radius,
        ),
    )
    return SphereTraversal(inputs, nodes, lanes, points.shape[0] * inputs.spans.block_count)


@functools.cache
def receiver_lanes_type(lanes: int) -> Any:
    """Struct of a block of receivers."""
    Lane, Vectors = lane_type(lanes), vectors_type(lanes)

    @wp.struct
    class ReceiverLanes:
        points: Vectors
        normals: Vectors  # 0 where there is no horizon
        footprints: Lane  # areas as the light sees them, 0 where they are points
        skip: wp.vec2i  # spheres that they leave out: the first, and the one after the last

    return ReceiverLanes


@functools.cache
def make_load_receivers(has_horizon: bool, lanes: int) -> wp.Function:
    """Make the kernel function that loads receivers without footprints: inputs, row → block, receivers."""
    Lane, Vectors, ReceiverLanes = lane_type(lanes), vectors_type(lanes), receiver_lanes_type(lanes)
    load, find_span = make_lane_functions(lanes).load, make_find_span(lanes)

    @wp.func(inline=True)
    def load_receivers(inputs: TraversalInputs, row: int):
        block = find_span(inputs.spans, row)
        normals = Vectors()
        if wp.static(has_horizon):
            normals = load(inputs.normals[block.batch][block.first : block.end], block.number)
        points = load(inputs.points[block.batch][block.first : block.end], block.number)
        skip = wp.vec2i(value_of_span(inputs.skip_begins, block.span), value_of_span(inputs.skip_ends, block.span))
        return block, ReceiverLanes(points, normals, Lane(), skip)

    return load_receivers


@functools.cache
def sphere_view_type(lanes: int) -> Any:
    """Struct of a sphere as a block of receivers sees it."""
    Lane, Vectors, Cone = lane_type(lanes), vectors_type(lanes), cone_type(lanes)

    @wp.struct
    class SphereView:
        traversal_index: int  # its number in the traversal
        node: int
        offset: Vectors  # from the receivers to its center
        curvature: float  # 1/radius
        cone: Cone  # its weight has merge_weight as a factor
        merge_weight: Lane  # that merging gives the sphere

    return SphereView


@functools.cache
def sphere_adjoint_type(lanes: int) -> Any:
    """Struct of the adjoints of a sphere's contribution to a block of receivers."""
    Lane, Vectors = lane_type(lanes), vectors_type(lanes)

    @wp.struct
    class SphereAdjoint:
        is_any: bool  # if not, all is 0
        offset: Vectors
        radius: Lane
        weight: Lane  # of the cone
        normals: Vectors

    return SphereAdjoint


def lane_structs(lanes: int) -> tuple[Any, Any, Any]:
    """Structs of receivers, of a sphere as they see it, and of its adjoints."""
    return receiver_lanes_type(lanes), sphere_view_type(lanes), sphere_adjoint_type(lanes)


@functools.cache
def make_traversal(cull: wp.Function, visit: wp.Function, Task: type, is_adjoint: bool, lanes: int) -> wp.Function:
    """Make the kernel function that visits the spheres that a block of receivers can see.

    Args:
        cull: (receivers, bound, traversal_index, candidates, task) → number of bundles of directions that a bounding
            sphere may darken, out of ``candidates``: :data:`ALL_BUNDLES` for a run, and for a cluster the bundles that
            its run may darken. ``traversal_index`` is the place of the first sphere in the traversal.
        visit: (receivers, sphere_view, count, task), called for each sphere with the count of its cluster; for an
            adjoint → SphereAdjoint.
        Task: Struct of all else that these two read and write.
        is_adjoint: Whether to sum the results of the visits.
    """
    Lane = lane_type(lanes)
    ReceiverLanes, SphereView = receiver_lanes_type(lanes), sphere_view_type(lanes)
    fn = make_lane_functions(lanes)
    is_any_above, offset, add, subtract = fn.is_any_above, fn.offset, fn.add, fn.subtract
    cone, find_cluster_weight = make_cone(lanes), make_cluster_weight(lanes)
    cluster_weight_adjoint, add_to_node = make_cluster_weight_adjoint(lanes), make_add_to_node(lanes)

    @wp.func(inline=lanes == 1)
    def traverse(receivers: ReceiverLanes, batch: int, spheres: SphereClusters, gradients: Gradients, task: Task):
        """Returns the adjoint of the receivers."""
        adj_receivers = ReceiverLanes()
        for run in range(spheres.run_bounds.shape[1]):
            begin = run * CLUSTERS_PER_RUN
            end = wp.min(begin + CLUSTERS_PER_RUN, spheres.cluster_bounds.shape[1])
            run_count = int(0)
            if not is_skipped(begin * CLUSTER_SIZE, wp.min(end * CLUSTER_SIZE, spheres.count), receivers.skip):
                run_count = cull(
                    receivers, spheres.run_bounds[batch, run], begin * NODES_PER_CLUSTER, ALL_BUNDLES, task
                )
            if run_count == 0:
                end = begin
            for cluster in range(begin, end):
                count = cull(
                    receivers, spheres.cluster_bounds[batch, cluster], cluster * NODES_PER_CLUSTER, run_count, task
                )
                if count > 0:
                    is_merged = cluster < spheres.extents.shape[1] and not is_skipped_partly(
                        CLUSTER_SIZE * cluster, CLUSTER_SIZE * (cluster + 1), receivers.skip
                    )
                    cluster_weight = Lane(0.0)
                    if is_merged:
                        cluster_weight = find_cluster_weight(receivers.points, batch, cluster, spheres)
                    adj_cluster_weight = Lane(0.0)
                    for item in range(NODES_PER_CLUSTER):
                        node = find_node(cluster, item, spheres.count, spheres.centers.shape[1])
                        merge_weight = Lane(1.0) - cluster_weight
                        sign = float(-1.0)
                        if item == CLUSTER_SIZE:
                            merge_weight = cluster_weight
                            sign = 1.0
                        radius = float(0.0)
                        is_left_out = item < CLUSTER_SIZE and is_skipped(node, node + 1, receivers.skip)
                        if node >= 0 and not is_left_out and is_any_above(merge_weight, 0.0):
                            radius = spheres.radii[batch, node]
                        if radius > TINY_RADIUS:
                            sphere_view = SphereView()
                            sphere_view.traversal_index = cluster * NODES_PER_CLUSTER + item
                            sphere_view.node = node
                            sphere_view.offset = offset(spheres.centers[batch, node], receivers.points)
                            sphere_view.curvature = 1.0 / radius
                            sphere_view.cone = cone(sphere_view.offset, sphere_view.curvature)
                            cone_weight = sphere_view.cone.weight
                            sphere_view.cone.weight = wp.cw_mul(cone_weight, merge_weight)
                            sphere_view.merge_weight = merge_weight
                            if wp.static(is_adjoint):
                                adj_sphere = visit(receivers, sphere_view, count, task)
                                if adj_sphere.is_any:
                                    adj_cluster_weight += sign * wp.cw_mul(adj_sphere.weight, cone_weight)
                                    adj_receivers.points = subtract(adj_receivers.points, adj_sphere.offset)
                                    adj_receivers.normals = add(adj_receivers.normals, adj_sphere.normals)
                                    add_to_node(adj_sphere.offset, adj_sphere.radius, batch, node, gradients)
                            else:
                                visit(receivers, sphere_view, count, task)
                    if wp.static(is_adjoint):  # noqa: SIM102  (the forward kernel has none of this)
                        if is_merged:
                            adj_offset = cluster_weight_adjoint(
                                receivers.points, batch, cluster, adj_cluster_weight, spheres, gradients
                            )
                            adj_receivers.points = subtract(adj_receivers.points, adj_offset)
        return adj_receivers

    return traverse
