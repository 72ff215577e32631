"""Transmittance towards the samples of a lobe, interpolated between the cells of directions around them.

    T(l) = Σ_q k_q min(T_q, H_q) / Σ_q k_q H_q,   k_q = max(l·ω_q − cos 2.2ρ, 0)² + ε,   H_q = s(n·ω_q / ρ),

over the cells near l, ρ their radius and s the smoothstep from 0 at −1 to 1 at 1: the part of a cell that is above the
receiver's horizon. Of a ball, T_q is H_q: it blocks nothing above its horizon.

A sample of a lobe is narrower than a cell, and so mostly blocked wholly or not at all; but an edge of a shadow that is
interpolated between cells is as wide as three of them. T² (3 − 2 T) is taken in place of T: edges stay where they are,
and are 1.5 times as steep, as magnified coverage is [Green 2007, Improved Alpha-Tested Magnification for Vector
Textures]. In direct light a metal ball on a ground is 3.4 in place of 6.3% off (roughness 0.2), a bear 8.1 in place of
9.6%.
"""

import numpy as np
import warp as wp

from warpshadow import check
from warpshadow.device.batch import common_batch, expand, expand_rows
from warpshadow.device.constants import constant
from warpshadow.device.lanes import Chunk, as_chunks, is_positive_in_chunk, total_of_chunk, use_vector_registers
from warpshadow.device.launch import differentiable, launch
from warpshadow.device.memory import empty
from warpshadow.device.parallel import Scratch, scratch_slot, split_row
from warpshadow.maths.directions import CHUNK, cell_radius, check_count
from warpshadow.stages.cell_neighbors import KERNEL_RADIUS, near_chunks, texel_of

_COST, _SHARPENING_COST = 30.0, 2.0  # nanoseconds that a sample takes

_OPEN = 1.0 - 1.0e-6  # transmittance from which on a sharpened sample counts as open, and has no gradient

_MIN_KERNEL = 1.0e-10  # ε: of cells that are further away, where none is near
_MIN_HORIZON_WEIGHT = 1.0e-7

wp.set_module_options({"max_unroll": 1})


@wp.func(inline=True)
def _heights(normal: wp.vec3, x: Chunk, y: Chunk, z: Chunk, per_radius: float):
    """Heights of cells over the horizon, clamped to [0, 1]: the argument of H."""
    cosine = normal[0] * x + normal[1] * y + normal[2] * z
    return wp.min(wp.max(0.5 * per_radius * cosine + Chunk(0.5), Chunk(0.0)), Chunk(1.0))


@wp.func(inline=True)
def _horizon_weights(heights: Chunk):
    """Weights H of cells, plus a little, so that none is 0."""
    return wp.cw_mul(wp.cw_mul(heights, heights), Chunk(3.0) - 2.0 * heights) + Chunk(_MIN_HORIZON_WEIGHT)


@wp.func
def horizon_weight(height: float):
    """Weight H of one cell, plus the same."""
    return height * height * (3.0 - 2.0 * height) + _MIN_HORIZON_WEIGHT


@wp.func(inline=True)
def _kernels(direction: wp.vec3, x: Chunk, y: Chunk, z: Chunk, reach_cosine: float):
    """Square roots of the kernel k of cells, without ε."""
    return wp.max(direction[0] * x + direction[1] * y + direction[2] * z - Chunk(reach_cosine), Chunk(0.0))


@wp.kernel(enable_backward=False)
def _interpolate_cells(
    first_row: int,
    worker: int,
    # in
    transmittance: wp.array3d(dtype=Chunk),
    normals: wp.array2d(dtype=wp.vec3),
    directions: wp.array3d(dtype=wp.vec3),
    cells: wp.array2d(dtype=Chunk),
    neighbors: wp.array2d(dtype=wp.int32),
    reach_cosine: float,
    per_radius: float,
    # scratch
    scratch: wp.array3d(dtype=Chunk),
    # out
    weights: wp.array3d(dtype=wp.float32),
    means: wp.array3d(dtype=wp.float32),
):
    """A thread owns a receiver: Σ k H and T of its samples."""
    item = first_row + wp.tid()
    batch, receiver = split_row(item, means.shape[1])
    normal = normals[batch, receiver]
    slot = scratch_slot(worker, item)
    capped_transmittance = scratch[slot, 0]
    horizon_weights = scratch[slot, 1]
    for chunk in range(cells.shape[1]):
        heights = _heights(normal, cells[0, chunk], cells[1, chunk], cells[2, chunk], per_radius)
        horizon_weights[chunk] = _horizon_weights(heights)
        capped_transmittance[chunk] = wp.min(transmittance[batch, receiver, chunk], horizon_weights[chunk])
    for i in range(means.shape[2]):
        direction = directions[batch, receiver, i]
        texel = texel_of(direction)
        transmittance_sums = Chunk(0.0)
        horizon_sums = Chunk(0.0)
        for k in range(neighbors.shape[1]):
            chunk = neighbors[texel, k]
            if chunk < 0:
                break
            kernel = _kernels(direction, cells[0, chunk], cells[1, chunk], cells[2, chunk], reach_cosine)
            weight = wp.cw_mul(kernel, kernel) + Chunk(_MIN_KERNEL)
            transmittance_sums += wp.cw_mul(weight, capped_transmittance[chunk])
            horizon_sums += wp.cw_mul(weight, horizon_weights[chunk])
        weights[batch, receiver, i] = total_of_chunk(horizon_sums)
        means[batch, receiver, i] = total_of_chunk(transmittance_sums) / weights[batch, receiver, i]


@wp.kernel(enable_backward=False)
def _interpolate_cells_adjoint(
    first_row: int,
    worker: int,
    # in
    transmittance: wp.array3d(dtype=Chunk),
    normals: wp.array2d(dtype=wp.vec3),
    directions: wp.array3d(dtype=wp.vec3),
    cells: wp.array2d(dtype=Chunk),
    neighbors: wp.array2d(dtype=wp.int32),
    reach_cosine: float,
    per_radius: float,
    weights: wp.array3d(dtype=wp.float32),
    means: wp.array3d(dtype=wp.float32),
    adj_means: wp.array3d(dtype=wp.float32),
    # scratch
    scratch: wp.array3d(dtype=Chunk),
    # out
    adj_transmittance: wp.array3d(dtype=Chunk),
    adj_normals: wp.array2d(dtype=wp.vec3),
    adj_directions: wp.array3d(dtype=wp.vec3),
):
    """A thread owns a receiver. With T = t / h:  t̄ = T̄ / h,  h̄ = −T t̄, and from them k̄ and the cells' gradients.

    Sharpened samples that are wholly open or blocked have T̄ = 0, and are passed over.
    """
    item = first_row + wp.tid()
    batch, receiver = split_row(item, means.shape[1])
    normal = normals[batch, receiver]
    slot = scratch_slot(worker, item)
    capped_transmittance = scratch[slot, 0]
    horizon_weights = scratch[slot, 1]
    adj_capped_cells = scratch[slot, 2]
    adj_horizon_cells = scratch[slot, 3]
    for chunk in range(cells.shape[1]):
        heights = _heights(normal, cells[0, chunk], cells[1, chunk], cells[2, chunk], per_radius)
        horizon_weights[chunk] = _horizon_weights(heights)
        capped_transmittance[chunk] = wp.min(transmittance[batch, receiver, chunk], horizon_weights[chunk])
        adj_capped_cells[chunk] = Chunk(0.0)
        adj_horizon_cells[chunk] = Chunk(0.0)
    for i in range(means.shape[2]):
        if adj_means[batch, receiver, i] == 0.0:
            continue
        direction = directions[batch, receiver, i]
        texel = texel_of(direction)
        adj_capped = adj_means[batch, receiver, i] / weights[batch, receiver, i]
        adj_weight_sum = -means[batch, receiver, i] * adj_capped
        adj_x = Chunk(0.0)
        adj_y = Chunk(0.0)
        adj_z = Chunk(0.0)
        for k in range(neighbors.shape[1]):
            chunk = neighbors[texel, k]
            if chunk < 0:
                break
            x = cells[0, chunk]
            y = cells[1, chunk]
            z = cells[2, chunk]
            kernel = _kernels(direction, x, y, z, reach_cosine)
            weight = wp.cw_mul(kernel, kernel) + Chunk(_MIN_KERNEL)
            adj_weight = adj_capped * capped_transmittance[chunk] + adj_weight_sum * horizon_weights[chunk]
            adj_kernel = 2.0 * wp.cw_mul(kernel, adj_weight)
            adj_x += wp.cw_mul(adj_kernel, x)
            adj_y += wp.cw_mul(adj_kernel, y)
            adj_z += wp.cw_mul(adj_kernel, z)
            adj_capped_cells[chunk] = adj_capped_cells[chunk] + adj_capped * weight
            adj_horizon_cells[chunk] = adj_horizon_cells[chunk] + adj_weight_sum * weight
        if adj_directions:
            adj_direction = wp.vec3(total_of_chunk(adj_x), total_of_chunk(adj_y), total_of_chunk(adj_z))
            adj_directions[batch, receiver, i] = adj_directions[batch, receiver, i] + adj_direction
    adj_normal = wp.vec3()
    for chunk in range(cells.shape[1]):
        x = cells[0, chunk]
        y = cells[1, chunk]
        z = cells[2, chunk]
        is_blocked = is_positive_in_chunk(horizon_weights[chunk] - capped_transmittance[chunk])
        adj_blocked = wp.cw_mul(is_blocked, adj_capped_cells[chunk])
        if adj_transmittance:
            adj_transmittance[batch, receiver, chunk] = adj_transmittance[batch, receiver, chunk] + adj_blocked
        if adj_normals:
            t = _heights(normal, x, y, z, per_radius)
            adj_heights = adj_horizon_cells[chunk] + adj_capped_cells[chunk] - adj_blocked
            adj_cosines = 3.0 * per_radius * wp.cw_mul(wp.cw_mul(t, Chunk(1.0) - t), adj_heights)
            adj_normal += wp.vec3(wp.dot(adj_cosines, x), wp.dot(adj_cosines, y), wp.dot(adj_cosines, z))
    if adj_normals:
        adj_normals[batch, receiver] = adj_normals[batch, receiver] + adj_normal


def interpolate_transmittance(
    transmittance: wp.array, normals: wp.array, directions: wp.array, cells: np.ndarray
) -> wp.array:
    """Interpolate transmittance towards the samples of lobes.

    Args:
        transmittance: Towards cells, float32 of shape [batch, receiver, cell].
        normals: Unit normals, vec3 of shape [batch, receiver].
        directions: Of :func:`.lobes.sample_lobes`, vec3 of shape [batch, receiver, sample].
        cells: Unit vectors, NumPy of shape [cell, 3].

    Returns:
        Float32 of shape [batch, receiver, sample].

    Differentiable: transmittance, normals, directions.
    """
    check_count("cells", len(cells))
    check.shape("transmittance", transmittance.shape, ("batch", directions.shape[1], len(cells)))
    arrays = {"transmittance": transmittance, "directions": directions, "normals": normals}
    count, device = common_batch(arrays), directions.device
    transmittance, directions = expand_rows(transmittance, count), expand_rows(directions, count)
    normals = expand(normals, count)
    use_vector_registers(__name__, device)
    radius = float(cell_radius(len(cells)))
    inputs = [
        *(as_chunks(transmittance.contiguous()), normals, directions),
        constant(cells.T.reshape(3, -1, CHUNK), Chunk, device),
        near_chunks(cells, device),
        *(float(np.cos(KERNEL_RADIUS * radius)), 1 / radius),
    ]
    chunk_count = len(cells) // CHUNK
    weights = empty(directions.shape, dtype=wp.float32, device=device)
    row_count, cost = count * directions.shape[1], _COST * directions.shape[2]

    def adjoint(adj_means: wp.array) -> None:
        outputs = [as_chunks(transmittance.grad), normals.grad, directions.grad]
        launch(
            _interpolate_cells_adjoint,
            row_count,
            inputs=[*inputs, weights, means, adj_means],
            scratch=[Scratch((4, chunk_count), Chunk)],
            outputs=outputs,
            cost=3 * cost,
        )

    means = empty(directions.shape, dtype=wp.float32, device=device)
    return differentiable(
        lambda result: launch(
            _interpolate_cells,
            row_count,
            inputs=inputs,
            scratch=[Scratch((2, chunk_count), Chunk)],
            outputs=[weights, result],
            cost=cost,
        ),
        adjoint,
        result=means,
        variables=[transmittance, normals, directions],
    )


@wp.kernel
def _sharpen(
    first_row: int,
    worker: int,
    # in
    transmittance: wp.array3d(dtype=wp.float32),
    # out
    sharp: wp.array3d(dtype=wp.float32),
):
    """A thread owns a receiver."""
    batch, receiver = split_row(first_row + wp.tid(), sharp.shape[1])
    for i in range(sharp.shape[2]):
        between_cells = transmittance[batch, receiver, i]
        t = wp.where(between_cells > _OPEN, 1.0, between_cells)
        sharp[batch, receiver, i] = t * t * (3.0 - 2.0 * t)


def sharpen(transmittance: wp.array) -> wp.array:
    """Sharpen edges of shadows in transmittance that is interpolated between cells.

    Args:
        transmittance: Of :func:`interpolate_transmittance`, float32 of shape [batch, receiver, sample].

    Differentiable: transmittance.
    """
    count, receiver_count, sample_count = transmittance.shape
    sharp = wp.empty(transmittance.shape, dtype=wp.float32, device=transmittance.device)
    rows, cost = count * receiver_count, _SHARPENING_COST * sample_count
    launch(_sharpen, rows, inputs=[transmittance], outputs=[sharp], cost=cost)
    return sharp
