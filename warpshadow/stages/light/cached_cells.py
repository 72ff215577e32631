"""Cached visibility of static bodies, combined with the visibility past moving bodies."""

from typing import NamedTuple

import warp as wp

from warpshadow.device.lanes import Chunk, as_chunks, total_of_chunk, use_vector_registers
from warpshadow.device.launch import launch, launch_with_adjoint
from warpshadow.device.memory import empty, require_gradient
from warpshadow.device.parallel import split_row

_CELL_COST = 2.0  # nanoseconds that a cell of a receiver takes


class CachedRows(NamedTuple):
    """Rows of numbers, and which of them each receiver has."""

    rows: wp.array  # [row, channel, item] float32
    index: wp.array  # [receiver] int32


@wp.kernel(enable_backward=False)
def _shade_cells(
    first_row: int,
    worker: int,
    # in
    transmittance: wp.array3d(dtype=Chunk),
    index: wp.array(dtype=wp.int32),
    cells: wp.array3d(dtype=Chunk),
    # out
    shading: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a receiver."""
    batch, receiver = split_row(first_row + wp.tid(), shading.shape[1])
    row = index[receiver]
    red = Chunk(0.0)
    green = Chunk(0.0)
    blue = Chunk(0.0)
    for chunk in range(cells.shape[2]):
        t = transmittance[batch, receiver, chunk]
        red += wp.cw_mul(t, cells[row, 0, chunk])
        green += wp.cw_mul(t, cells[row, 1, chunk])
        blue += wp.cw_mul(t, cells[row, 2, chunk])
    shading[batch, receiver] = wp.vec3(total_of_chunk(red), total_of_chunk(green), total_of_chunk(blue))


@wp.kernel(enable_backward=False)
def _shade_cells_adjoint(
    first_row: int,
    worker: int,
    # in
    transmittance: wp.array3d(dtype=Chunk),
    index: wp.array(dtype=wp.int32),
    cells: wp.array3d(dtype=Chunk),
    adj_shading: wp.array2d(dtype=wp.vec3),
    # out
    adj_transmittance: wp.array3d(dtype=Chunk),
):
    """A thread owns a receiver:  T̄_q += S_q · B̄."""
    batch, receiver = split_row(first_row + wp.tid(), adj_shading.shape[1])
    row = index[receiver]
    adj = adj_shading[batch, receiver]
    for chunk in range(cells.shape[2]):
        adj_transmittance[batch, receiver, chunk] = (
            adj_transmittance[batch, receiver, chunk]
            + adj[0] * cells[row, 0, chunk]
            + adj[1] * cells[row, 1, chunk]
            + adj[2] * cells[row, 2, chunk]
        )


def shade_cached_cells(transmittance: wp.array, cached: CachedRows) -> wp.array:
    """Light receivers on static bodies by known light, which static and moving bodies shadow.

    Args:
        transmittance: Of the spheres of moving bodies, float32 of shape [batch, receiver, direction].
        cached: Irradiance from each cell of directions, shadowed by static bodies, [row, 3, direction].
    Returns:
        Shading, vec3 of shape [batch, receiver].
    Differentiable: transmittance.
    """
    device = transmittance.device
    use_vector_registers(__name__, device)
    batch_count, receiver_count, direction_count = transmittance.shape
    chunks = as_chunks(transmittance)
    return launch_with_adjoint(
        _shade_cells,
        _shade_cells_adjoint,
        batch_count * receiver_count,
        inputs=[chunks, cached.index, as_chunks(cached.rows)],
        result=empty((batch_count, receiver_count), dtype=wp.vec3, device=device),
        variables=[chunks],
        cost=_CELL_COST * direction_count,
        adj_cost=_CELL_COST * direction_count,
    )


@wp.kernel
def _multiply_cells(
    # in
    factors: wp.array3d(dtype=Chunk),
    index: wp.array(dtype=wp.int32),
    cells: wp.array3d(dtype=Chunk),
    # out
    products: wp.array3d(dtype=Chunk),
):
    """A thread owns a receiver."""
    batch, receiver = wp.tid()
    row = index[receiver]
    for chunk in range(cells.shape[2]):
        products[batch, receiver, chunk] = wp.cw_mul(factors[batch, receiver, chunk], cells[row, 0, chunk])


def cell_transfer(transmittance: wp.array, cached: CachedRows) -> wp.array:
    """Transfer vectors of receivers on static bodies: their cached transfer, times the others' transmittance.

    Args:
        transmittance: Of the spheres of moving bodies, float32 of shape [batch, receiver, direction].
        cached: Transfer vectors with static bodies alone, [row, 1, direction].
    Returns:
        Transfer vectors, float32 of shape [batch, receiver, direction].
    Differentiable: transmittance.
    """
    device = transmittance.device
    use_vector_registers(__name__, device)
    transfer = empty(transmittance.shape, dtype=wp.float32, device=device)
    if transmittance.requires_grad:
        require_gradient(transfer)  # before it is seen as chunks
    inputs = [as_chunks(transmittance), cached.index, as_chunks(cached.rows)]
    launch(_multiply_cells, transfer.shape[:2], inputs=inputs, outputs=[as_chunks(transfer)])
    return transfer


@wp.kernel(enable_backward=False)
def _add_cached_rows(
    # in
    index: wp.array(dtype=wp.int32),
    rows: wp.array3d(dtype=wp.float32),
    channel: int,
    # out
    sums: wp.array3d(dtype=wp.float32),
):
    """A thread owns a receiver, to whose sums it adds."""
    batch, receiver = wp.tid()
    row = index[receiver]
    for item in range(rows.shape[2]):
        sums[batch, receiver, item] = sums[batch, receiver, item] + rows[row, channel, item]


def add_rows(cached: CachedRows, sums: wp.array, channel: int = 0) -> None:
    """Add the cached sums over static bodies to sums over moving bodies, in place.

    No adjoint is needed: a constant leaves the gradient as it is.

    Args:
        cached: Of shape [row, channel, item].
        sums: Float32 of shape [batch, receiver, item], which no recorded launch has read yet.
    """
    launch(_add_cached_rows, sums.shape[:2], inputs=[cached.index, cached.rows, channel], outputs=[sums])
