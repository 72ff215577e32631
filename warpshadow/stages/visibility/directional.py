"""Visibility as transmittance towards cells of directions.

Each sphere blocks a cone of directions of half-angle θ. Its transmittance rises smoothly from θ − w to θ + w, the
falloff, and the opacity A makes up for that: the blocked solid angle is exactly the cone's.

    T_q(x) = Π_i (1 − A_i smoothstep((u_i·ω_q − lo_i) / (hi_i − lo_i)))
    lo = cos(θ+w),  hi = cos(max(θ−w, 0)),  A = min(1, (1 − cos θ) / (1 − (hi+lo)/2)),  ρ = 2/√Q

There is no band limit, so no ringing; T stays in [0, 1] however many spheres overlap; tiny spheres block as much as
they should; and the falloff has a smooth gradient.

w = κρ for receivers that are points. One that stands for an area f² sees the mean over it, in which an edge at distance
d moves by an angle of f/d:

    sin²w = sin²κρ + 5/12 f² / (d² + 5/6 f²),   d² = D² − r²

By 5/12 a smoothstep has the variance of the mean over a square; 5/6 f² keeps w below 45° where κρ is small. Otherwise
an edge narrower than a pixel, as a sun's at the foot of a body, has a huge derivative at few receivers.
"""

import functools
from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from warpshadow import check
from warpshadow.device.lanes import lane_type, make_lane_functions, module_options, sector_count
from warpshadow.device.launch import launch_with_adjoint
from warpshadow.device.memory import empty
from warpshadow.device.parallel import Scratch, run_dimensions, scratch_slot, split_launch
from warpshadow.maths.directions import BUNDLE, cell_radius
from warpshadow.stages.receivers.body_spans import Span
from warpshadow.stages.visibility.culling import (
    DirectionCells,
    cap_type,
    make_cap_functions,
    make_cells,
    make_cull,
    make_is_bundle_above,
)
from warpshadow.stages.visibility.falloff import make_cap_adjoint, make_falloff, make_squared_edge_distance
from warpshadow.stages.visibility.merging import MERGING, NODES_PER_CLUSTER, Gradients
from warpshadow.stages.visibility.traversal import (
    ClusterTree,
    TraversalInputs,
    lane_structs,
    make_load_receivers,
    make_traversal,
    prepare_traversal,
    receiver_lanes_type,
    sphere_view_type,
)

SOFTNESS = 0.35  # κ: half-width of the falloff in cell radii. More gives wider gradients and more bias

_OPAQUE_BELOW = 1.0e-4  # below this transmittance a bundle is not looked at any more

PAIR_COST = 0.15  # nanoseconds that a sphere costs for a receiver and a direction, culling included

_LAUNCH_BOUNDS = 256, 3
"""Threads that a multiprocessor has registers for, in blocks: 80 a thread, where spans' skips would take up to 96."""


@functools.cache
def _task_type(lanes: int) -> Any:
    """Struct of a thread's work: a sector of directions."""
    Lane = lane_type(lanes)

    @wp.struct
    class TransmittanceTask:
        cells: DirectionCells
        first_bundle: int
        opaque_from: wp.array(dtype=wp.int32)  # [bundle] the traversal index from which on nothing is left to block
        reached_bundles: wp.array2d(dtype=wp.int32)  # bundles that a run, and then a cluster, may reach
        transmittances: wp.array(dtype=Lane)  # [direction] transmittance; for the adjoint its product with its adjoint

    return TransmittanceTask


@functools.cache
def _make_load_task(has_horizon: bool, has_footprints: bool, lanes: int) -> wp.Function:
    """Make the kernel function that loads the receivers and directions of a thread."""
    Lane, TransmittanceTask = lane_type(lanes), _task_type(lanes)
    load_receivers, fn = make_load_receivers(has_horizon, lanes), make_lane_functions(lanes)
    load, dot_direction = fn.load, fn.dot_direction

    @wp.func(inline=lanes == 1)
    def load_task(
        row: int,
        sector: int,
        worker: int,
        inputs: TraversalInputs,
        cells: DirectionCells,
        opaque_rows: wp.array3d(dtype=wp.int32),
        scratch: wp.array2d(dtype=Lane),
        reached_bundles: wp.array3d(dtype=wp.int32),
    ):
        block, receivers = load_receivers(inputs, row)
        if wp.static(has_footprints):  # as the light sees them, on average over its directions
            footprints = load(inputs.footprints[block.batch][block.first : block.end], block.number)
            for direction in range(cells.directions.shape[0]):
                receivers.footprints += wp.abs(dot_direction(cells.directions[direction], footprints))
            receivers.footprints = receivers.footprints / float(cells.directions.shape[0])
        slot = scratch_slot(worker, row * opaque_rows.shape[1] + sector)
        opaque_from = opaque_rows[row, sector]
        task = TransmittanceTask(
            cells, sector * opaque_from.shape[0], opaque_from, reached_bundles[slot], scratch[slot]
        )
        return block, receivers, task

    return load_task


@functools.cache
def _make_attenuate(lanes: int) -> wp.Function:
    """Make the kernel function that lets a sphere block its share of a bundle's transmittance."""
    Lane, TransmittanceTask, Cap = lane_type(lanes), _task_type(lanes), cap_type(lanes)
    is_any_above, soft_edge = make_lane_functions(lanes).is_any_above, make_cap_functions(False, lanes).soft_edge

    @wp.func(inline=True)
    def attenuate(cap: Cap, slope: Lane, opacity: Lane, bundle: int, task: TransmittanceTask):
        """Multiply the transmittance of a bundle; return whether any light is left."""
        max_transmittance = Lane(0.0)
        direction = (task.first_bundle + bundle) * BUNDLE
        slot = bundle * BUNDLE
        for cell in range(BUNDLE):
            _t, step = soft_edge(task.cells.directions[direction + cell], cap, slope)
            transmitted = wp.cw_mul(task.transmittances[slot + cell], Lane(1.0) - wp.cw_mul(opacity, step))
            max_transmittance = wp.max(max_transmittance, transmitted)
            task.transmittances[slot + cell] = transmitted
        return is_any_above(max_transmittance, _OPAQUE_BELOW)

    return attenuate


@functools.cache
def _make_transmit(has_horizon: bool, has_footprints: bool, lanes: int) -> wp.Kernel:
    Lane, TransmittanceTask = lane_type(lanes), _task_type(lanes)
    ReceiverLanes, SphereView = receiver_lanes_type(lanes), sphere_view_type(lanes)
    store_columns, sqrt = make_lane_functions(lanes).store_columns, make_lane_functions(lanes).sqrt
    is_bundle_above = make_is_bundle_above(has_horizon, lanes)
    load_task = _make_load_task(has_horizon, has_footprints, lanes)
    falloff, attenuate, squared_edge_distance = (
        make_falloff(lanes),
        _make_attenuate(lanes),
        make_squared_edge_distance(lanes),
    )
    widen_cone, _, reaches_bundle, is_above_horizon, _ = make_cap_functions(has_horizon, lanes, has_footprints)

    @wp.func(inline=True)
    def visit(receivers: ReceiverLanes, sphere_view: SphereView, count: int, task: TransmittanceTask):
        cone = sphere_view.cone
        cells = task.cells
        sine = sqrt(cone.sine2)
        cap = widen_cone(cone.axis, cone.cosine, sine, squared_edge_distance(sphere_view), receivers, cells)
        if is_above_horizon(cap, receivers.normals):
            slope, opacity = falloff(cone, sine, cap.cosine, cap.cos_width, cap.sin_width)
            for k in range(count):
                bundle = task.reached_bundles[1, k]
                direction_bundle = task.first_bundle + bundle
                is_candidate = task.opaque_from[bundle] > sphere_view.traversal_index and reaches_bundle(
                    cap, cells.axes[direction_bundle], cells.half_angles[direction_bundle]
                )
                if is_candidate and not attenuate(cap, slope, opacity, bundle, task):
                    task.opaque_from[bundle] = sphere_view.traversal_index + 1

    cull = make_cull(has_horizon, TransmittanceTask, lanes, has_footprints)
    traverse = make_traversal(cull, visit, TransmittanceTask, False, lanes)

    @wp.kernel(
        module="unique", module_options=module_options(lanes), enable_backward=False, launch_bounds=_LAUNCH_BOUNDS
    )
    def transmit(
        first_row: int,
        worker: int,
        # in
        inputs: TraversalInputs,
        cells: DirectionCells,
        # scratch
        scratch: wp.array2d(dtype=Lane),
        reached_bundles: wp.array3d(dtype=wp.int32),
        # out
        opaque_rows: wp.array3d(dtype=wp.int32),
        transmittance: wp.array3d(dtype=wp.float32),
    ):
        """A thread owns a block of receivers and a sector of directions; past ``opaque_rows`` no sphere counts."""
        i, j = wp.tid()
        sector, row = split_launch(worker, first_row + i, j)
        block, receivers, task = load_task(row, sector, worker, inputs, cells, opaque_rows, scratch, reached_bundles)
        for bundle in range(task.opaque_from.shape[0]):
            for cell in range(BUNDLE):
                task.transmittances[bundle * BUNDLE + cell] = Lane(1.0)
            task.opaque_from[bundle] = 0  # wholly below the horizon: the cosine is zero there
            if is_bundle_above(cells, task.first_bundle + bundle, receivers.normals):
                task.opaque_from[bundle] = inputs.spheres.cluster_bounds.shape[1] * NODES_PER_CLUSTER
        traverse(receivers, block.batch, inputs.spheres, Gradients(), task)
        direction_count = task.opaque_from.shape[0] * BUNDLE
        rows = transmittance[block.batch][block.first : block.end]
        store_columns(task.transmittances, 0, rows, task.first_bundle * BUNDLE, direction_count, block.number)

    return transmit


@functools.cache
def _make_transmit_adjoint(has_horizon: bool, has_footprints: bool, lanes: int) -> wp.Kernel:
    Lane, TransmittanceTask = lane_type(lanes), _task_type(lanes)
    ReceiverLanes, SphereView, _SphereAdjoint = lane_structs(lanes)
    fn = make_lane_functions(lanes)
    load_columns, multiply_by_columns, add_vectors = fn.load_columns, fn.multiply_by_columns, fn.add_vectors
    load_task = _make_load_task(has_horizon, has_footprints, lanes)

    @wp.func(inline=True)
    def find_weight(sphere_view: SphereView, task: TransmittanceTask):
        """All spheres have weight 1."""
        return Lane(1.0)

    @wp.func(inline=True)
    def share_adjoint(
        sphere_view: SphereView, weight: Lane, blocked_share: Lane, slot: int, direction: int, task: TransmittanceTask
    ):
        """ā_i = −T̄ T / (1 − a_i)."""
        return -wp.cw_div(task.transmittances[slot], wp.max(Lane(1.0) - blocked_share, Lane(1.0e-7)))

    cap_adjoint = make_cap_adjoint(
        has_horizon, find_weight, share_adjoint, False, TransmittanceTask, lanes, has_footprints
    )

    @wp.func(inline=True)
    def visit(receivers: ReceiverLanes, sphere_view: SphereView, count: int, task: TransmittanceTask):
        adj_sphere, _relative_adjoint = cap_adjoint(receivers, sphere_view, count, task)
        return adj_sphere

    cull = make_cull(has_horizon, TransmittanceTask, lanes, has_footprints)
    traverse = make_traversal(cull, visit, TransmittanceTask, True, lanes)

    @wp.kernel(module="unique", module_options=module_options(lanes), enable_backward=False)
    def transmit_adjoint(
        first_row: int,
        worker: int,
        # in
        inputs: TraversalInputs,
        cells: DirectionCells,
        opaque_rows: wp.array3d(dtype=wp.int32),
        transmittance: wp.array3d(dtype=wp.float32),
        adj_transmittance: wp.array3d(dtype=wp.float32),
        # scratch
        scratch: wp.array2d(dtype=Lane),
        reached_bundles: wp.array3d(dtype=wp.int32),
        # out
        adj_points: wp.array2d(dtype=wp.vec3),
        # sums
        adj_centers: wp.array2d(dtype=wp.vec3),
        adj_radii: wp.array2d(dtype=wp.float32),
        adj_extents: wp.array2d(dtype=wp.float32),
    ):
        """A thread owns a block of receivers and a sector of directions."""
        i, j = wp.tid()
        sector, row = split_launch(worker, first_row + i, j)
        block, receivers, task = load_task(row, sector, worker, inputs, cells, opaque_rows, scratch, reached_bundles)
        first_direction, count = task.first_bundle * BUNDLE, task.opaque_from.shape[0] * BUNDLE
        rows = transmittance[block.batch][block.first : block.end]
        adj_rows = adj_transmittance[block.batch][block.first : block.end]
        load_columns(rows, first_direction, count, block.number, 0.0, task.transmittances, 0)
        multiply_by_columns(adj_rows, first_direction, count, block.number, task.transmittances, 0)
        gradients = Gradients(adj_centers, adj_radii, adj_extents)
        adj_receivers = traverse(receivers, block.batch, inputs.spheres, gradients, task)
        if adj_points:
            add_vectors(adj_receivers.points, block.number, adj_points[block.batch][block.first : block.end])

    return transmit_adjoint


def transmittance(
    points: wp.array,
    normals: wp.array | None,
    centers: wp.array,
    radii: wp.array,
    directions: np.ndarray,
    *,
    softness: float = SOFTNESS,
    merging: float = MERGING,
    body_spans: Sequence[Span] = (),
    skips: Sequence[tuple[int, int]] = (),
    clusters: ClusterTree | None = None,
    footprints: wp.array | None = None,
) -> wp.array:
    """Transmittance of spheres towards cells of directions.

    Args:
        points: Receiver positions [scene units], vec3 of shape [batch, receiver].
        normals: Unit normals, vec3 of shape [batch, receiver]: cells below a receiver's horizon, where the cosine is
            zero, may be left at 1. None computes it all.
        centers: Sphere centers [scene units], vec3 of shape [batch, sphere].
        radii: Sphere radii [scene units], float32 of shape [batch, sphere]; a radius of 0 blocks nothing.
        directions: Unit vectors ω, NumPy of shape [direction, 3], from :func:`warpshadow.fibonacci`.
        softness: κ, half-width of the falloff in cell radii.
        merging: τ, the half-angle in cell radii under which four spheres that follow each other are seen as one (see
            :mod:`warpshadow.stages.visibility.merging`), where there are 512 or more; 0 for never.
        body_spans: Of the receivers, by body; () for one of all.
        skips: Spheres that each span leaves out: the first, and the one after the last; () for none.
        clusters: Of these spheres, from :func:`.traversal.find_clusters`, where they are found already.
        footprints: Areas f² for which receivers stand, as vectors along the normals of their planes or against them
            [scene units²], vec3 of shape [batch, receiver]: by their size as the directions see it, on average, the
            falloff is wider; None where receivers are points.
    Returns:
        Transmittance in [0, 1], float32 of shape [batch, receiver, direction].
    Raises:
        ValueError: for NaN, Inf, numbers beyond 1e18 and negative radii. (That waits for the device. While a CUDA graph
            is captured, nothing is checked.)
    Differentiable: points, centers, radii. Not: normals (they only cull), directions, softness, merging, skips,
    clusters, footprints.
    """
    cells = make_cells(directions, softness, points.device, footprints is not None)
    arguments = points, normals, centers, radii, cell_radius(len(directions))
    inputs, nodes, lanes, row_count = prepare_traversal(
        *arguments, merging=merging, body_spans=body_spans, skips=skips, clusters=clusters
    )
    if footprints is not None:
        check.shape("footprints", footprints.shape, points.shape)
        inputs.footprints = footprints
    device, traits = points.device, (normals is not None, footprints is not None, lanes)
    sectors = sector_count(device, len(directions))
    bundle_count = len(directions) // (BUNDLE * sectors)
    opaque_from = empty((row_count, sectors, bundle_count), dtype=wp.int32, device=device)
    result = empty((*points.shape, len(directions)), dtype=wp.float32, device=device)
    return launch_with_adjoint(
        _make_transmit(*traits),
        lambda: _make_transmit_adjoint(*traits),
        run_dimensions(device, row_count, sectors),
        inputs=[inputs, cells],
        result=result,
        variables=[points],
        shared=nodes,
        outputs=[opaque_from],
        adj_inputs=[opaque_from, result],
        scratch=[Scratch((bundle_count * BUNDLE,), lane_type(lanes)), Scratch((2, bundle_count), wp.int32)],
        cost=PAIR_COST * lanes * radii.shape[1] * bundle_count * BUNDLE,
    )
