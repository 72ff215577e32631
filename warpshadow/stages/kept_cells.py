"""Kept visibility of static bodies, combined with that of what moves."""

from typing import NamedTuple

import warp as wp

from warpshadow.device.lanes import Chunk, as_chunks, use_vector_registers
from warpshadow.device.tape import record_adjoint


class KeptRows(NamedTuple):
    """Rows of numbers, and which of them each receiver has."""

    rows: wp.array  # [row, channel, item] float32
    index: wp.array  # [receiver] int32


# ---------------------------------------------------------------------------------------------- joined with what moves


@wp.kernel(enable_backward=False)
def _light_cells(
    # in
    transmittance: wp.array3d(dtype=Chunk),
    index: wp.array(dtype=wp.int32),
    cells: wp.array3d(dtype=Chunk),
    # out
    shading: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a receiver:  B = Σ_q T_q S_q."""
    batch, receiver = wp.tid()
    row = index[receiver]
    total = wp.vec3()
    for chunk in range(cells.shape[2]):
        t = transmittance[batch, receiver, chunk]
        total += wp.vec3(
            wp.dot(t, cells[row, 0, chunk]), wp.dot(t, cells[row, 1, chunk]), wp.dot(t, cells[row, 2, chunk])
        )
    shading[batch, receiver] = total


@wp.kernel(enable_backward=False)
def _light_cells_adjoint(
    # in
    index: wp.array(dtype=wp.int32),
    cells: wp.array3d(dtype=Chunk),
    adj_shading: wp.array2d(dtype=wp.vec3),
    # out
    adj_transmittance: wp.array3d(dtype=Chunk),
):
    """A thread owns a receiver:  T̄_q += S_q · B̄."""
    batch, receiver = wp.tid()
    row = index[receiver]
    adj = adj_shading[batch, receiver]
    for chunk in range(cells.shape[2]):
        adj_transmittance[batch, receiver, chunk] = (
            adj_transmittance[batch, receiver, chunk]
            + adj[0] * cells[row, 0, chunk]
            + adj[1] * cells[row, 1, chunk]
            + adj[2] * cells[row, 2, chunk]
        )


def light_cells(transmittance: wp.array, kept: KeptRows) -> wp.array:
    """Light receivers on still bodies by what still bodies let pass of known light and moving ones of that.

    Args:
        transmittance: Of the spheres of moving bodies, float32 of shape [batch, receiver, direction].
        kept: Light of the cells, [row, 3, direction].

    Returns:
        Shading, vec3 of shape [batch, receiver].

    Differentiable: transmittance.
    """
    device, requires_grad = transmittance.device, transmittance.requires_grad
    if device.is_cpu:
        use_vector_registers(__name__)
    shading = wp.empty(transmittance.shape[:2], dtype=wp.vec3, device=device, requires_grad=requires_grad)
    factors = [kept.index, as_chunks(kept.rows)]
    wp.launch(
        _light_cells,
        dim=shading.shape,
        inputs=[as_chunks(transmittance), *factors],
        outputs=[shading],
        device=device,
        record_tape=False,
    )

    def adjoint() -> None:
        wp.launch(
            _light_cells_adjoint,
            dim=shading.shape,
            inputs=[*factors, shading.grad],
            outputs=[as_chunks(transmittance.grad)],
            device=device,
            record_tape=False,
        )

    record_adjoint(adjoint, [transmittance, shading])
    return shading


@wp.kernel(enable_backward=False)
def _multiply_cells(
    # in
    factors: wp.array3d(dtype=Chunk),
    index: wp.array(dtype=wp.int32),
    cells: wp.array3d(dtype=Chunk),
    # out
    products: wp.array3d(dtype=Chunk),
):
    """A thread owns a receiver, to whose products it adds."""
    batch, receiver = wp.tid()
    row = index[receiver]
    for chunk in range(cells.shape[2]):
        products[batch, receiver, chunk] = products[batch, receiver, chunk] + wp.cw_mul(
            factors[batch, receiver, chunk], cells[row, 0, chunk]
        )


def cell_transfer(transmittance: wp.array, kept: KeptRows) -> wp.array:
    """Transfer vectors of receivers on still bodies: what still bodies let pass times what moving ones do.

    Args:
        transmittance: Of the spheres of moving bodies, float32 of shape [batch, receiver, direction].
        kept: What of light of 1 the still bodies let pass, [row, 1, direction].

    Returns:
        Transfer vectors, float32 of shape [batch, receiver, direction].

    Differentiable: transmittance.
    """
    device, requires_grad = transmittance.device, transmittance.requires_grad
    if device.is_cpu:
        use_vector_registers(__name__)
    transfer = wp.zeros(transmittance.shape, dtype=wp.float32, device=device, requires_grad=requires_grad)
    factors = [kept.index, as_chunks(kept.rows)]

    def multiply(values: wp.array, products: wp.array) -> None:
        wp.launch(
            _multiply_cells,
            dim=transmittance.shape[:2],
            inputs=[as_chunks(values), *factors],
            outputs=[as_chunks(products)],
            device=device,
            record_tape=False,
        )

    multiply(transmittance, transfer)
    record_adjoint(lambda: multiply(transfer.grad, transmittance.grad), [transmittance, transfer])
    return transfer


@wp.kernel(enable_backward=False)
def _add_rows(
    # in
    index: wp.array(dtype=wp.int32),
    rows: wp.array3d(dtype=wp.float32),
    # out
    sums: wp.array3d(dtype=wp.float32),
):
    """A thread owns a receiver, to whose sums it adds."""
    batch, receiver = wp.tid()
    row = index[receiver]
    for item in range(rows.shape[2]):
        sums[batch, receiver, item] = sums[batch, receiver, item] + rows[row, 0, item]


def add_rows(kept: KeptRows, sums: wp.array) -> None:
    """Add what stands to sums over what moves, in place.

    No adjoint is needed: a constant leaves the gradient as it is.

    Args:
        kept: Of shape [row, 1, item].
        sums: Float32 of shape [batch, receiver, item], which no recorded launch has read yet.
    """
    wp.launch(
        _add_rows,
        dim=sums.shape[:2],
        inputs=[kept.index, kept.rows],
        outputs=[sums],
        device=sums.device,
        record_tape=False,
    )
