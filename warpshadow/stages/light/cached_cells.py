"""Cached visibility of static bodies, combined with the visibility past moving bodies."""

from typing import NamedTuple

import warp as wp

from warpshadow.device.lanes import Chunk, as_chunks, use_vector_registers
from warpshadow.device.launch import launch
from warpshadow.device.memory import empty, require_gradient


class CachedRows(NamedTuple):
    """Rows of numbers, and which of them each receiver has."""

    rows: wp.array  # [row, channel, item] float32
    index: wp.array  # [receiver] int32


@wp.func
def _sum_cells(transmittance: Chunk, red: Chunk, green: Chunk, blue: Chunk):
    """Light of a chunk of cells:  Σ_q T_q S_q."""
    return wp.vec3(wp.dot(transmittance, red), wp.dot(transmittance, green), wp.dot(transmittance, blue))


@wp.func_grad(_sum_cells)
def _sum_cells_adjoint(transmittance: Chunk, red: Chunk, green: Chunk, blue: Chunk, adj_light: wp.vec3):
    """The gradient to transmittance alone, by the vector units:  T̄_q = S_q · B̄."""
    wp.adjoint[transmittance] += adj_light[0] * red + adj_light[1] * green + adj_light[2] * blue


@wp.kernel
def _shade_cells(
    # in
    transmittance: wp.array3d(dtype=Chunk),
    index: wp.array(dtype=wp.int32),
    cells: wp.array3d(dtype=Chunk),
    # out
    shading: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a receiver."""
    batch, receiver = wp.tid()
    row = index[receiver]
    irradiance = wp.vec3()
    for chunk in range(cells.shape[2]):
        irradiance += _sum_cells(
            transmittance[batch, receiver, chunk], cells[row, 0, chunk], cells[row, 1, chunk], cells[row, 2, chunk]
        )
    shading[batch, receiver] = irradiance


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
    shading = empty(transmittance.shape[:2], dtype=wp.vec3, device=device)
    inputs = [as_chunks(transmittance), cached.index, as_chunks(cached.rows)]
    launch(_shade_cells, shading.shape, inputs=inputs, outputs=[shading])
    return shading


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
