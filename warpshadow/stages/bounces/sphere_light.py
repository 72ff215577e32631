"""Light from spheres: the light that proxies send to receivers through the cells that they block.

    I = 4/Q Σ_q max(n·ω_q, 0) (F_q − T_q) R_q
    R_q = Σ_j w_j a_jq L_jq / Σ_j w_j a_jq S_jq

The light is all that a cell lacks: T_q is the transmittance past the proxies j, F_q that without them. R is the mean
radiosity of those that block the cell in part, blended without sorting [McGuire and Bavoil 2013, weighted blended
order-independent transparency]: a_jq are the shares of the transmittance, T_q = F_q Π_j (1 − a_jq), w the weights of
:mod:`.proxy_weights`, L and S the light and the area that proxies show (:mod:`.proxy_radiance`). R is smooth, within
the radiosities of the patches, and independent of the scene's units.

The traversal is that of the transmittance, with other visits. For the adjoint the forward launch stores both sums of R:
16 bytes a receiver and cell, touched only in bundles of cells that are blocked in part; N bounces store N times that.
"""

import functools
from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from warpshadow import check
from warpshadow.device.batch import common_batch, expand, instance_in
from warpshadow.device.lanes import lane_type, make_lane_functions, module_options, sector_count, vectors_type
from warpshadow.device.launch import any_requires_grad, launch_with_adjoint
from warpshadow.device.memory import empty
from warpshadow.device.parallel import Scratch, run_dimensions, scratch_slot, split_launch
from warpshadow.maths.directions import BUNDLE, cell_radius
from warpshadow.stages.bounces.proxy_weights import WeightInputs, make_weight_functions
from warpshadow.stages.bounces.tangent_planes import TangentPlanes
from warpshadow.stages.light.sums import begin_sum
from warpshadow.stages.receivers.body_spans import ReceiverBlock, Span
from warpshadow.stages.visibility.cones import TINY_RADIUS
from warpshadow.stages.visibility.culling import (
    DirectionCells,
    cap_type,
    make_cap_functions,
    make_cells,
    make_cull,
    make_is_bundle_above,
)
from warpshadow.stages.visibility.directional import PAIR_COST, SOFTNESS
from warpshadow.stages.visibility.falloff import make_cap_adjoint, make_falloff
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

_MIN_DENOMINATOR = 1.0e-30
"""The least denominator of R: spheres that block so little of a cell that they have less leave T at F."""

_SUMS = 4  # Σ w a L, of three colors, and Σ w a S


@functools.cache
def _task_type(lanes: int) -> Any:
    """Struct of a thread's work: a sector of directions."""
    Lane, Vectors = lane_type(lanes), vectors_type(lanes)

    @wp.struct
    class LightTask:
        cells: DirectionCells
        first_bundle: int
        opaque_from: wp.array(dtype=wp.int32)  # [bundle] 0 where nothing is blocked, else the traversal's end
        reached_bundles: wp.array2d(dtype=wp.int32)  # bundles that a run, and then a cluster, may reach
        blocked: wp.array(dtype=Lane)  # [direction] F − T
        transmittance_others: wp.array(dtype=Lane)  # [direction] F, until F − T is loaded
        sums: wp.array(dtype=Lane)  # [direction · sum] of R
        factors: wp.array(dtype=Lane)  # [direction] f of share_adjoint, in the memory of F − T, which it needs no more
        adj_cells: wp.array(dtype=Lane)  # [direction] Ī·R, in the memory of F
        adj_blocked: wp.array(dtype=Lane)  # [direction] the adjoint of F − T: added to that of F, subtracted from T's
        adj_light: Vectors
        proxy_radiance: wp.array2d(dtype=wp.vec4)  # [proxy, direction]
        adj_radiance: wp.array2d(dtype=wp.vec4)
        weights: WeightInputs

    return LightTask


@wp.struct
class LightInputs:
    """Inputs of the light that spheres send, and of its adjoint."""

    traversed: TraversalInputs
    cells: DirectionCells
    proxy_radiance: wp.array3d(dtype=wp.vec4)
    equations: wp.array2d(dtype=wp.vec4)  # of tangent planes, [batch, proxy]
    tolerances: wp.array(dtype=wp.vec2)
    transmittance: wp.array3d(dtype=wp.float32)
    transmittance_others: wp.array3d(dtype=wp.float32)
    factor: float
    sector_count: int
    stores_sums: bool


@functools.cache
def _make_load_task(lanes: int) -> wp.Function:
    """Make the kernel function that loads the receivers and directions of a thread."""
    Lane, LightTask = lane_type(lanes), _task_type(lanes)
    fn = make_lane_functions(lanes)
    is_any_above, load_columns = fn.is_any_above, fn.load_columns
    load_receivers, is_bundle_above = make_load_receivers(True, lanes), make_is_bundle_above(True, lanes)

    @wp.func(inline=True)
    def load_blocked(block: ReceiverBlock, bundle: int, inputs: LightInputs, task: LightTask):
        """Load F − T of a bundle's cells; return whether light of any cell is blocked."""
        first_slot = bundle * BUNDLE
        first_direction = (task.first_bundle + bundle) * BUNDLE
        rows = inputs.transmittance[block.batch][block.first : block.end]
        load_columns(rows, first_direction, BUNDLE, block.number, 1.0, task.blocked, first_slot)
        if inputs.transmittance_others:
            others = inputs.transmittance_others[instance_in(block.batch, inputs.transmittance_others.shape[0])]
            rows_others = others[block.first : block.end]
            load_columns(rows_others, first_direction, BUNDLE, block.number, 1.0, task.transmittance_others, first_slot)
        is_any_blocked = bool(False)
        for slot in range(first_slot, first_slot + BUNDLE):
            cell_transmittance_others = Lane(1.0)
            if inputs.transmittance_others:
                cell_transmittance_others = task.transmittance_others[slot]
            blocked = cell_transmittance_others - task.blocked[slot]
            task.blocked[slot] = blocked
            is_any_blocked = is_any_blocked or is_any_above(wp.max(blocked, -blocked), 0.0)
        return is_any_blocked

    @wp.func(inline=lanes == 1)
    def load_task(
        row: int,
        sector: int,
        worker: int,
        inputs: LightInputs,
        scratch: wp.array3d(dtype=Lane),
        reached_bundles: wp.array3d(dtype=wp.int32),
        sums: wp.array2d(dtype=Lane),
    ):
        block, receivers = load_receivers(inputs.traversed, row)
        batch = block.batch
        spheres = inputs.traversed.spheres
        item = row * inputs.sector_count + sector
        slot = scratch_slot(worker, item)
        task = LightTask()
        task.cells = inputs.cells
        task.first_bundle = sector * (scratch.shape[2] // BUNDLE)
        task.reached_bundles = reached_bundles[slot]
        task.opaque_from = reached_bundles[slot, 2]
        task.blocked = scratch[slot, 0]
        task.factors = scratch[slot, 0]
        task.transmittance_others = scratch[slot, 1]
        task.adj_cells = scratch[slot, 1]
        task.adj_blocked = scratch[slot, 2]
        task.sums = sums[wp.where(inputs.stores_sums, item, slot)]
        task.proxy_radiance = inputs.proxy_radiance[instance_in(batch, inputs.proxy_radiance.shape[0])]
        if inputs.equations:
            task.weights.equations = inputs.equations[instance_in(batch, inputs.equations.shape[0])]
            task.weights.tolerances = inputs.tolerances
        largest_radius = float(TINY_RADIUS)
        for run in range(spheres.run_bounds.shape[1]):
            largest_radius = wp.max(largest_radius, spheres.run_bounds[batch, run][3])
        task.weights.inverse_size = 1.0 / largest_radius
        for bundle in range(task.opaque_from.shape[0]):
            task.opaque_from[bundle] = 0
            is_above = is_bundle_above(task.cells, task.first_bundle + bundle, receivers.normals)
            if is_above and load_blocked(block, bundle, inputs, task):
                task.opaque_from[bundle] = spheres.cluster_bounds.shape[1] * NODES_PER_CLUSTER
        return block, receivers, task

    return load_task


@functools.cache
def _make_light(lanes: int) -> wp.Kernel:
    Lane, Vectors, Cap = lane_type(lanes), vectors_type(lanes), cap_type(lanes)
    ReceiverLanes, SphereView, LightTask = receiver_lanes_type(lanes), sphere_view_type(lanes), _task_type(lanes)
    fn = make_lane_functions(lanes)
    sqrt, is_any_above, dot_direction, add_vectors = fn.sqrt, fn.is_any_above, fn.dot_direction, fn.add_vectors
    load_task, falloff = _make_load_task(lanes), make_falloff(lanes)
    find_weight = make_weight_functions(lanes).weight
    widen_cone, _, reaches_bundle, is_above_horizon, soft_edge = make_cap_functions(True, lanes)
    SUMS = wp.constant(_SUMS)
    MIN_DENOMINATOR = wp.constant(_MIN_DENOMINATOR)

    @wp.func(inline=True)
    def add_to_bundle(cap: Cap, slope: Lane, opacity: Lane, node: int, bundle: int, task: LightTask):
        """Add a proxy to the sums of R of a bundle's cells."""
        first_direction = (task.first_bundle + bundle) * BUNDLE
        for i in range(BUNDLE):
            t, step = soft_edge(task.cells.directions[first_direction + i], cap, slope)
            if is_any_above(t, 0.0):
                blocked_share = wp.cw_mul(opacity, step)
                radiance = task.proxy_radiance[node, first_direction + i]
                slot = (bundle * BUNDLE + i) * SUMS
                # (a loop is not unrolled, and reads the radiance from memory)
                task.sums[slot] = task.sums[slot] + radiance[0] * blocked_share
                task.sums[slot + 1] = task.sums[slot + 1] + radiance[1] * blocked_share
                task.sums[slot + 2] = task.sums[slot + 2] + radiance[2] * blocked_share
                task.sums[slot + 3] = task.sums[slot + 3] + radiance[3] * blocked_share

    @wp.func(inline=True)
    def visit(receivers: ReceiverLanes, sphere_view: SphereView, count: int, task: LightTask):
        cone = sphere_view.cone
        cells = task.cells
        sine = sqrt(cone.sine2)
        cap = widen_cone(cone.axis, cone.cosine, sine, Lane(0.0), receivers, cells)
        if is_above_horizon(cap, receivers.normals):
            slope, opacity = falloff(cone, sine, cap.cosine, cap.cos_width, cap.sin_width)
            weight = find_weight(sphere_view.offset, sphere_view.curvature, sphere_view.node, task.weights)
            opacity = wp.cw_mul(opacity, weight)
            for k in range(count):
                bundle = task.reached_bundles[1, k]
                direction_bundle = task.first_bundle + bundle
                if reaches_bundle(cap, cells.axes[direction_bundle], cells.half_angles[direction_bundle]):
                    add_to_bundle(cap, slope, opacity, sphere_view.node, bundle, task)

    traverse = make_traversal(make_cull(True, LightTask, lanes), visit, LightTask, False, lanes)

    @wp.kernel(module="unique", module_options=module_options(lanes), enable_backward=False)
    def add_light(
        first_row: int,
        worker: int,
        # in
        inputs: LightInputs,
        # scratch
        scratch: wp.array3d(dtype=Lane),
        reached_bundles: wp.array3d(dtype=wp.int32),
        # scratch, or out where the adjoint needs them
        sums: wp.array2d(dtype=Lane),
        # out
        light: wp.array2d(dtype=wp.vec3),
    ):
        """A thread owns a block of receivers and a sector of directions, and adds to the light."""
        i, j = wp.tid()
        sector, row = split_launch(worker, first_row + i, j)
        block, receivers, task = load_task(row, sector, worker, inputs, scratch, reached_bundles, sums)
        for bundle in range(task.opaque_from.shape[0]):
            if task.opaque_from[bundle] > 0:
                for k in range(BUNDLE * SUMS):
                    task.sums[bundle * BUNDLE * SUMS + k] = Lane(0.0)
        traverse(receivers, block.batch, inputs.traversed.spheres, Gradients(), task)
        light_sum = Vectors()
        for bundle in range(task.opaque_from.shape[0]):
            if task.opaque_from[bundle] > 0:
                for i in range(BUNDLE):
                    slot = bundle * BUNDLE + i
                    omega = task.cells.directions[(task.first_bundle + bundle) * BUNDLE + i]
                    cosine = inputs.factor * wp.max(dot_direction(omega, receivers.normals), Lane(0.0))
                    weight_factor = wp.cw_mul(cosine, task.blocked[slot])
                    weight_factor = wp.cw_div(weight_factor, wp.max(task.sums[slot * SUMS + 3], Lane(MIN_DENOMINATOR)))
                    light_sum.x += wp.cw_mul(weight_factor, task.sums[slot * SUMS])
                    light_sum.y += wp.cw_mul(weight_factor, task.sums[slot * SUMS + 1])
                    light_sum.z += wp.cw_mul(weight_factor, task.sums[slot * SUMS + 2])
        add_vectors(light_sum, block.number, light[block.batch][block.first : block.end])

    return add_light


@functools.cache
def _make_light_adjoint(lanes: int) -> wp.Kernel:
    Lane, Vectors, LightTask = lane_type(lanes), vectors_type(lanes), _task_type(lanes)
    ReceiverLanes, SphereView, _SphereAdjoint = lane_structs(lanes)
    fn = make_lane_functions(lanes)
    dot_direction, dot, total, add = fn.dot_direction, fn.dot, fn.total, fn.add
    is_positive, load, add_vectors, add_columns = fn.is_positive, fn.load, fn.add_vectors, fn.add_columns
    load_task, weight_functions = _make_load_task(lanes), make_weight_functions(lanes)
    find_weight_of_proxy, weight_adjoint = weight_functions.weight, weight_functions.adjoint
    SUMS = wp.constant(_SUMS)
    MIN_DENOMINATOR = wp.constant(_MIN_DENOMINATOR)

    @wp.func(inline=True)
    def find_weight(sphere_view: SphereView, task: LightTask):
        return find_weight_of_proxy(sphere_view.offset, sphere_view.curvature, sphere_view.node, task.weights)

    @wp.func(inline=True)
    def share_adjoint(
        sphere_view: SphereView, weight: Lane, blocked_share: Lane, slot: int, direction: int, task: LightTask
    ):
        """With f = 4/Q max(n·ω, 0) (F − T) / Σ w a S:  ā = w f (Ī·L − S Ī·R),  L̄ = f w a Ī,  S̄ = −f w a Ī·R."""
        weighted_factor = wp.cw_mul(weight, task.factors[slot])
        adj_cell = task.adj_cells[slot]
        radiance = task.proxy_radiance[sphere_view.node, direction]
        light = dot_direction(wp.vec3(radiance[0], radiance[1], radiance[2]), task.adj_light)
        if task.adj_radiance:
            weighted_blocked_share = wp.cw_mul(weighted_factor, blocked_share)
            adj_radiance_of_proxy = wp.vec4(
                total(wp.cw_mul(weighted_blocked_share, task.adj_light.x)),
                total(wp.cw_mul(weighted_blocked_share, task.adj_light.y)),
                total(wp.cw_mul(weighted_blocked_share, task.adj_light.z)),
                -total(wp.cw_mul(weighted_blocked_share, adj_cell)),
            )
            # summed over a warp first it took 1.4 times as long on an H200
            wp.atomic_add(task.adj_radiance, sphere_view.node, direction, adj_radiance_of_proxy)
        return wp.cw_mul(weighted_factor, light - radiance[3] * adj_cell)

    cap_adjoint = make_cap_adjoint(True, find_weight, share_adjoint, True, LightTask, lanes)

    @wp.func(inline=True)
    def bundle_adjoint(receivers: ReceiverLanes, bundle: int, factor: float, task: LightTask):
        """Store Ī·R, F̄ = −T̄ and the factors f of a bundle's cells, in place of F and F − T; returns their n̄."""
        adj_normal = Vectors()
        for i in range(BUNDLE):
            slot = bundle * BUNDLE + i
            omega = task.cells.directions[(task.first_bundle + bundle) * BUNDLE + i]
            inverse = wp.cw_div(Lane(1.0), wp.max(task.sums[slot * SUMS + 3], Lane(MIN_DENOMINATOR)))
            mean = Vectors(task.sums[slot * SUMS], task.sums[slot * SUMS + 1], task.sums[slot * SUMS + 2])
            adj_cell = wp.cw_mul(inverse, dot(task.adj_light, mean))
            cosine = dot_direction(omega, receivers.normals)
            adj_cosine = factor * wp.cw_mul(is_positive(cosine), wp.cw_mul(task.blocked[slot], adj_cell))
            adj_normal.x += omega[0] * adj_cosine
            adj_normal.y += omega[1] * adj_cosine
            adj_normal.z += omega[2] * adj_cosine
            factored_cosine = factor * wp.max(cosine, Lane(0.0))
            task.adj_blocked[slot] = wp.cw_mul(factored_cosine, adj_cell)
            task.factors[slot] = wp.cw_mul(wp.cw_mul(factored_cosine, task.blocked[slot]), inverse)
            task.adj_cells[slot] = adj_cell
        return adj_normal

    @wp.func(inline=True)
    def visit(receivers: ReceiverLanes, sphere_view: SphereView, count: int, task: LightTask):
        """Add to the gradients of a proxy by its cone and its weight w: w̄ w = Σ ā a."""
        adj_sphere, relative_adjoint = cap_adjoint(receivers, sphere_view, count, task)
        if adj_sphere.is_any:
            adj_offset, adj_radius = weight_adjoint(
                sphere_view.offset, sphere_view.curvature, sphere_view.node, relative_adjoint, task.weights
            )
            adj_sphere.offset = add(adj_sphere.offset, adj_offset)
            adj_sphere.radius += adj_radius
        return adj_sphere

    traverse = make_traversal(make_cull(True, LightTask, lanes), visit, LightTask, True, lanes)

    @wp.kernel(module="unique", module_options=module_options(lanes), enable_backward=False)
    def add_light_adjoint(
        first_row: int,
        worker: int,
        # in
        inputs: LightInputs,
        sums: wp.array2d(dtype=Lane),
        adj_light: wp.array2d(dtype=wp.vec3),
        # scratch
        scratch: wp.array3d(dtype=Lane),
        reached_bundles: wp.array3d(dtype=wp.int32),
        # out
        adj_points: wp.array2d(dtype=wp.vec3),
        adj_normals: wp.array2d(dtype=wp.vec3),
        adj_transmittance: wp.array3d(dtype=wp.float32),
        adj_addend: wp.array2d(dtype=wp.vec3),
        # out, or a sum where one instance serves all
        adj_transmittance_others: wp.array3d(dtype=wp.float32),
        # sums
        adj_radiance: wp.array3d(dtype=wp.vec4),
        adj_equations: wp.array2d(dtype=wp.vec4),
        adj_centers: wp.array2d(dtype=wp.vec3),
        adj_radii: wp.array2d(dtype=wp.float32),
        adj_extents: wp.array2d(dtype=wp.float32),
    ):
        """A thread owns a block of receivers and a sector of directions.

        T̄ = −4/Q max(n·ω, 0) Ī·R = −F̄,  n̄ = 4/Q Σ ω (F − T) Ī·R where n·ω > 0
        """
        i, j = wp.tid()
        sector, row = split_launch(worker, first_row + i, j)
        block, receivers, task = load_task(row, sector, worker, inputs, scratch, reached_bundles, sums)
        batch = block.batch
        task.adj_light = load(adj_light[batch][block.first : block.end], block.number)
        if adj_radiance:
            task.adj_radiance = adj_radiance[instance_in(batch, inputs.proxy_radiance.shape[0])]
        if adj_equations:
            task.weights.adj_equations = adj_equations[instance_in(batch, adj_equations.shape[0])]
        adj_normal = Vectors()
        for bundle in range(task.opaque_from.shape[0]):
            if task.opaque_from[bundle] > 0:
                adj_normal = add(adj_normal, bundle_adjoint(receivers, bundle, inputs.factor, task))
                first_slot = bundle * BUNDLE
                first_direction = (task.first_bundle + bundle) * BUNDLE
                if adj_transmittance:
                    rows = adj_transmittance[batch][block.first : block.end]
                    add_columns(-1.0, task.adj_blocked, first_slot, rows, first_direction, BUNDLE, block.number)
                if adj_transmittance_others:
                    others = adj_transmittance_others[instance_in(batch, adj_transmittance_others.shape[0])]
                    rows_others = others[block.first : block.end]
                    add_columns(1.0, task.adj_blocked, first_slot, rows_others, first_direction, BUNDLE, block.number)
        adj_receivers = traverse(
            receivers, batch, inputs.traversed.spheres, Gradients(adj_centers, adj_radii, adj_extents), task
        )
        if adj_points:
            add_vectors(adj_receivers.points, block.number, adj_points[batch][block.first : block.end])
        if adj_normals:
            add_vectors(adj_normal, block.number, adj_normals[batch][block.first : block.end])
        if adj_addend and sector == 0:
            add_vectors(task.adj_light, block.number, adj_addend[batch][block.first : block.end])

    return add_light_adjoint


def sphere_light(
    points: wp.array,
    normals: wp.array,
    centers: wp.array,
    radii: wp.array,
    proxy_radiance: wp.array,
    transmittance: wp.array,
    transmittance_others: wp.array | None,
    directions: np.ndarray,
    *,
    softness: float = SOFTNESS,
    merging: float = MERGING,
    body_spans: Sequence[Span] = (),
    skips: Sequence[tuple[int, int]] = (),
    clusters: ClusterTree | None = None,
    tangent_planes: TangentPlanes | None = None,
    addend: wp.array | None = None,
) -> wp.array:
    """Light that proxies send to receivers, through the cells that they block, added to other light.

    Args:
        points, normals, centers, radii, directions, softness, merging, body_spans, skips, clusters: As
            for :func:`warpshadow.stages.visibility.directional.transmittance`.
        proxy_radiance: Light and area that proxies, clusters included, show towards cells, vec4 of shape [batch, proxy,
            direction], from :func:`.proxy_radiance.find_proxy_radiance`.
        transmittance: T past these spheres and all else that F is past, float32 of shape [batch, receiver, direction],
            made with the same directions, softness, merging and skips.
        transmittance_others: F, the factor of T without these spheres, of the same shape; None for 1.
        tangent_planes: Of the proxies, which show nothing below them; None for proxies that are seen from everywhere.
            Batches of 1 of these, of proxy_radiance and of transmittance_others serve every instance.
        addend: The other light, vec3 of shape [batch, receiver]; None for 0.
    Returns:
        Light that a white receiver reflects of it, vec3 of shape [batch, receiver]: 1 where all patches are white and
        radiant by 1.
    Raises:
        ValueError: for NaN, Inf, numbers beyond 1e18 and negative radii of receivers and spheres, as the transmittance.
    Differentiable: points, normals, centers, radii, proxy_radiance, transmittance, transmittance_others, equations of
    the tangent planes, addend. (The derivative in T is the one at a fixed blend of proxies.) Not: directions, softness,
    merging, skips, clusters, tolerances.
    """
    cells = make_cells(directions, softness, points.device)
    arguments = points, normals, centers, radii, cell_radius(len(directions))
    traversal = prepare_traversal(*arguments, merging=merging, body_spans=body_spans, skips=skips, clusters=clusters)
    equations, tolerances = (None, None) if tangent_planes is None else tangent_planes
    common_batch(
        {
            "points": points,
            "proxy_radiance": proxy_radiance,
            "transmittance_others": transmittance_others,
            "tangent_planes": equations,
        }
    )
    proxy_count, directions_shape = traversal.nodes.radii.shape[1], (points.shape[1], len(directions))
    check.shape("proxy_radiance", proxy_radiance.shape, (len(proxy_radiance), proxy_count, len(directions)))
    check.shape("transmittance", transmittance.shape, (len(points), *directions_shape))
    if transmittance_others is not None:
        check.shape("transmittance_others", transmittance_others.shape, (len(transmittance_others), *directions_shape))
    if equations is not None:
        check.shape("tangent_planes", equations.shape, (len(equations), proxy_count))
    device, lanes, sectors = points.device, traversal.lanes, sector_count(points.device, len(directions))
    sector_direction_count = len(directions) // sectors
    is_shared = transmittance_others is not None and len(transmittance_others) < len(points)
    addend = None if addend is None else expand(addend, len(points))
    variables = [points, normals, transmittance, addend, *([] if is_shared else [transmittance_others])]
    shared = [*([transmittance_others] if is_shared else []), proxy_radiance, equations, *traversal.nodes]
    stores_sums = any_requires_grad([*variables, *shared])
    scratch = [
        Scratch((3, sector_direction_count), lane_type(lanes)),
        Scratch((3, sector_direction_count // BUNDLE), wp.int32),
    ]
    sums = Scratch((sector_direction_count * _SUMS,), lane_type(lanes))
    stored = [empty((traversal.row_count * sectors, *sums.shape), sums.dtype, device=device)] if stores_sums else []
    inputs = LightInputs()
    inputs.traversed, inputs.cells = traversal.inputs, cells
    inputs.proxy_radiance, inputs.transmittance = proxy_radiance, transmittance
    inputs.transmittance_others = transmittance_others
    if equations is not None:
        inputs.equations, inputs.tolerances = equations, tolerances
    inputs.factor, inputs.sector_count, inputs.stores_sums = 4 / len(directions), sectors, stores_sums
    return launch_with_adjoint(
        _make_light(lanes),
        lambda: _make_light_adjoint(lanes),
        run_dimensions(device, traversal.row_count, sectors),
        inputs=[inputs],
        result=begin_sum(addend, points.shape, device),
        variables=variables,
        shared=shared,
        outputs=stored,
        adj_inputs=stored,
        scratch=scratch if stores_sums else [*scratch, sums],
        cost=PAIR_COST * lanes * radii.shape[1] * sector_direction_count,
    )
