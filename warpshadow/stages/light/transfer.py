"""Transfer vectors: visibility times cosine, so that light is shaded by a dot product.

The radiance B that a receiver of albedo a reflects (README.md has the integral) is linear in the light L, so it has a
*transfer vector* T with B = a · (T · L): its coefficients belong to the light's, either spherical harmonics or cells of
directions. The 1/π is in T: white under L = 1, unoccluded, gives 1.
"""

import functools
from typing import Any

import numpy as np
import warp as wp

from warpshadow import check
from warpshadow.device.constants import constant
from warpshadow.device.lanes import (
    Chunk,
    as_chunks,
    block_count,
    is_positive_in_chunk,
    lane_count,
    lane_type,
    make_lane_functions,
    module_options,
    total_of_chunk,
    use_vector_registers,
)
from warpshadow.device.launch import differentiable, launch, launch_with_adjoint
from warpshadow.device.memory import empty, require_gradient, zeros
from warpshadow.device.parallel import Scratch, scratch_slot, split_row
from warpshadow.maths import sh
from warpshadow.maths.directions import CHUNK, check_count
from warpshadow.stages.sh_kernels import (
    PRODUCT_COST,
    ProductTable,
    make_add_rotated_zonal,
    make_multiply,
    make_rotated_zonal_adjoint,
    product_table,
    zonal_type,
)

_CELL_COST = 0.3  # nanoseconds that a cell of a receiver takes

wp.set_module_options({"max_unroll": 1})


@functools.cache
def _make_sh_transfer(order: int, is_shadowed: bool, lanes: int) -> tuple[wp.Kernel, wp.Kernel]:
    """Make the kernel and its adjoint."""
    Lane, Zonal = lane_type(lanes), zonal_type(order, lanes)
    fn = make_lane_functions(lanes)
    find_block, dot, is_positive, load, add_vectors = fn.find_block, fn.dot, fn.is_positive, fn.load, fn.add_vectors
    load_rows, store_rows, add_rows = fn.load_rows, fn.store_rows, fn.add_rows
    add_rotated_zonal, multiply = make_add_rotated_zonal(order, lanes), make_multiply(order, lanes)
    rotated_zonal_adjoint = make_rotated_zonal_adjoint(order, lanes)
    COSINE = wp.types.vector(length=order, dtype=wp.float32)(*(sh.clamped_cosine(order) / np.pi))

    @wp.func
    def load_cosines(normals: wp.array(dtype=wp.vec3), block: int):
        """A block's normals and the zonal coefficients of their clamped cosines, 0 around a zero normal."""
        normal = load(normals, block)
        is_there = is_positive(dot(normal, normal))
        zonal = Zonal()
        for band in range(order):
            zonal[band] = COSINE[band] * is_there
        return normal, zonal

    @wp.kernel(module="unique", module_options=module_options(lanes), enable_backward=False)
    def transfer_sh(
        first_row: int,
        worker: int,
        # in
        visibility: wp.array3d(dtype=wp.float32),
        normals: wp.array2d(dtype=wp.vec3),
        table: ProductTable,
        # scratch
        scratch: wp.array3d(dtype=Lane),
        # out
        transfer: wp.array3d(dtype=wp.float32),
    ):
        """A thread owns a block of receivers: the SH product of their visibility and clamped cosine."""
        row = first_row + wp.tid()
        batch, block = find_block(row, normals.shape[1])
        slot = scratch_slot(worker, row)
        cosine = scratch[slot, 0]
        for i in range(wp.static(order**2)):
            cosine[i] = Lane(0.0)
        normal, zonal = load_cosines(normals[batch], block)
        add_rotated_zonal(normal, zonal, cosine)
        if wp.static(is_shadowed):
            factor = scratch[slot, 1]
            product = scratch[slot, 2]
            load_rows(visibility[batch], block, factor)
            multiply(factor, cosine, table, product)
            store_rows(product, block, transfer[batch])
        else:
            store_rows(cosine, block, transfer[batch])

    @wp.kernel(module="unique", module_options=module_options(lanes), enable_backward=False)
    def transfer_sh_adjoint(
        first_row: int,
        worker: int,
        # in
        visibility: wp.array3d(dtype=wp.float32),
        normals: wp.array2d(dtype=wp.vec3),
        table: ProductTable,
        adj_transfer: wp.array3d(dtype=wp.float32),
        # scratch
        scratch: wp.array3d(dtype=Lane),
        # out
        adj_visibility: wp.array3d(dtype=wp.float32),
        adj_normals: wp.array2d(dtype=wp.vec3),
    ):
        """A thread owns a block of receivers. Γ is symmetric:  T = V * H  has  V̄ = H * T̄  and  H̄ = V * T̄."""
        row = first_row + wp.tid()
        batch, block = find_block(row, normals.shape[1])
        slot = scratch_slot(worker, row)
        adj_row = scratch[slot, 0]
        factor = scratch[slot, 1]
        product = scratch[slot, 2]
        normal, zonal = load_cosines(normals[batch], block)
        for i in range(adj_transfer.shape[2], wp.static(order**2)):
            adj_row[i] = Lane(0.0)
        load_rows(adj_transfer[batch], block, adj_row)
        if wp.static(is_shadowed):
            if adj_visibility:
                for i in range(wp.static(order**2)):
                    factor[i] = Lane(0.0)
                add_rotated_zonal(normal, zonal, factor)
                multiply(factor, adj_row, table, product)
                add_rows(product, block, adj_visibility[batch])
            load_rows(visibility[batch], block, factor)
            multiply(factor, adj_row, table, product)
            for i in range(wp.static(order**2)):
                adj_row[i] = product[i]
        if adj_normals:
            adj_normal, _adj_zonal = rotated_zonal_adjoint(normal, zonal, adj_row)
            add_vectors(adj_normal, block, adj_normals[batch])

    return transfer_sh, transfer_sh_adjoint


def sh_transfer(visibility: wp.array | None, normals: wp.array, *, order: int, bands: int | None = None) -> wp.array:
    """Transfer vectors to light in spherical harmonics: (V * H_n)_k / π, H_n the clamped cosine around the normal.

    Args:
        visibility: SH visibility, float32 of shape [batch, receiver, order²]; None where nothing blocks.
        normals: Unit normals, vec3 of shape [batch, receiver].
        order: Number of SH bands, 2 to 8.
        bands: Number of bands that the light has, all of them by default; of others no product is computed.
    Returns:
        Transfer vectors, float32 of shape [batch, receiver, bands²].
    Differentiable: visibility, normals.
    """
    sh.check_order(order)
    bands = order if bands is None else bands
    check.choice("bands", bands, range(1, order + 1))
    if visibility is None:
        order = max(bands, 2)  # the first bands of a cosine are the same in any order
    device = normals.device
    lanes = lane_count(device)
    batch_count, receiver_count = normals.shape
    if visibility is not None:
        check.shape("visibility", visibility.shape, (batch_count, receiver_count, order**2))
    row_count = batch_count * block_count(receiver_count, lanes)
    variables = [visibility, normals]
    scratch = [Scratch((3, order**2), lane_type(lanes))]
    cost = PRODUCT_COST * lanes * order**2 * bands**2
    transfer_kernel, adjoint_kernel = _make_sh_transfer(order, visibility is not None, lanes)
    lit_bands = tuple(band for band in range(order) if band < 2 or band % 2 == 0)  # of a clamped cosine
    return differentiable(
        lambda transfer: launch(
            transfer_kernel,
            row_count,
            inputs=[*variables, product_table(order, str(device), lit_bands, bands)],
            scratch=scratch,
            outputs=[transfer],
            cost=cost,
        ),
        lambda adj_transfer: launch(
            adjoint_kernel,
            row_count,
            inputs=[*variables, product_table(order, str(device), tuple(range(bands))), adj_transfer],
            scratch=scratch,
            outputs=[None if variable is None else variable.grad for variable in variables],
            cost=2 * cost,
        ),
        result=empty((batch_count, receiver_count, bands**2), dtype=wp.float32, device=device),
        variables=variables,
    )


@functools.cache
def _make_sh_product(order: int, lanes: int) -> wp.Kernel:
    Lane, fn = lane_type(lanes), make_lane_functions(lanes)
    find_block, load_rows, add_rows = fn.find_block, fn.load_rows, fn.add_rows
    multiply = make_multiply(order, lanes)

    @wp.kernel(module="unique", module_options=module_options(lanes), enable_backward=False)
    def multiply_sh(
        first_row: int,
        worker: int,
        # in
        first_factor: wp.array3d(dtype=wp.float32),
        second_factor: wp.array3d(dtype=wp.float32),
        table: ProductTable,
        # scratch
        scratch: wp.array3d(dtype=Lane),
        # out
        products: wp.array3d(dtype=wp.float32),
    ):
        """A thread owns a block of receivers, to whose products it adds. Factors may have bands 0 … n' < n only."""
        row = first_row + wp.tid()
        batch, block = find_block(row, products.shape[1])
        slot = scratch_slot(worker, row)
        first = scratch[slot, 0]
        second = scratch[slot, 1]
        product = scratch[slot, 2]
        for i in range(second_factor.shape[2], wp.static(order**2)):
            second[i] = Lane(0.0)
        load_rows(first_factor[batch], block, first)
        load_rows(second_factor[batch], block, second)
        multiply(first, second, table, product)
        add_rows(product, block, products[batch])

    return multiply_sh


def sh_product(visibility: wp.array, self_transfer: wp.array, *, order: int, bands: int | None = None) -> wp.array:
    """Transfer vectors of receivers with self-transfer, in place of the clamped cosine: (V * K)_k.

    Args:
        visibility: V, float32 of shape [batch, receiver, order²].
        self_transfer: K, float32 of shape [batch, receiver, order²].
        order: Number of SH bands, 2 to 8.
        bands: As for :func:`sh_transfer`.
    Returns:
        Transfer vectors, float32 of shape [batch, receiver, bands²].
    Differentiable: visibility, self_transfer.
    """
    sh.check_order(order)
    bands = order if bands is None else bands
    check.choice("bands", bands, range(1, order + 1))
    check.shape("self_transfer", self_transfer.shape, visibility.shape)
    device, (batch_count, receiver_count, _) = visibility.device, visibility.shape
    lanes = lane_count(device)
    row_count = batch_count * block_count(receiver_count, lanes)

    def add_product(first: wp.array, second: wp.array, table: ProductTable, total: wp.array) -> None:
        launch(
            _make_sh_product(order, lanes),
            row_count,
            inputs=[first, second, table],
            scratch=[Scratch((3, order**2), lane_type(lanes))],
            outputs=[total],
            cost=2 * PRODUCT_COST * lanes * order**2 * bands**2,
        )

    def forward(transfer: wp.array) -> None:
        add_product(visibility, self_transfer, product_table(order, str(device), None, bands), transfer)

    def adjoint(adj: wp.array) -> None:
        """Γ is symmetric:  V̄ = K * T̄  and  K̄ = V * T̄."""
        table = product_table(order, str(device), tuple(range(bands)))
        for factor, other in ((visibility, self_transfer), (self_transfer, visibility)):
            if factor.requires_grad:
                add_product(other, adj, table, factor.grad)

    return differentiable(
        forward,
        adjoint,
        result=zeros((batch_count, receiver_count, bands**2), dtype=wp.float32, device=device),
        variables=[visibility, self_transfer],
    )


@wp.func(inline=True)
def broadcast_normal(normal: wp.vec3):
    """Coordinates of a normal, each repeated for the cells of a chunk."""
    return Chunk(normal[0]), Chunk(normal[1]), Chunk(normal[2])


@wp.func(inline=True)
def transfer_chunk(weight: float, nx: Chunk, ny: Chunk, nz: Chunk, x: Chunk, y: Chunk, z: Chunk, transmittance: Chunk):
    """Transfer w max(n·ω_q, 0) T_q to a chunk of cells."""
    cosine = wp.cw_mul(nx, x) + wp.cw_mul(ny, y) + wp.cw_mul(nz, z)
    return wp.cw_mul(weight * wp.max(cosine, Chunk(0.0)), transmittance)


@wp.func(inline=True)
def transfer_chunk_adjoint(
    nx: Chunk, ny: Chunk, nz: Chunk, x: Chunk, y: Chunk, z: Chunk, transmittance: Chunk, adj_transfer: Chunk
):
    """The adjoint of `transfer_chunk` by transmittance, and by the cosine where that is above 0; w is in t̄."""
    cosine = wp.cw_mul(nx, x) + wp.cw_mul(ny, y) + wp.cw_mul(nz, z)
    adj_cosine = wp.cw_mul(wp.cw_mul(adj_transfer, transmittance), is_positive_in_chunk(cosine))
    return wp.cw_mul(adj_transfer, wp.max(cosine, Chunk(0.0))), adj_cosine


def prepare_cells(transmittance: wp.array, normals: wp.array, directions: np.ndarray) -> list[Any]:
    """Check transmittance to cells; return it in chunks, normals, directions, and the cells' solid angle over π."""
    count, device = len(directions), normals.device
    check_count("directions", count)
    check.shape("transmittance", transmittance.shape, (*normals.shape, count))
    if transmittance.requires_grad and not transmittance.is_contiguous:
        raise ValueError("transmittance: got a strided array that requires a gradient, expected a contiguous one")
    chunks = constant(directions.T.reshape(3, -1, CHUNK), Chunk, device)
    return [as_chunks(transmittance.contiguous()), normals, chunks, 4.0 / count]


@wp.kernel(enable_backward=False)
def _transfer_directions(
    first_row: int,
    worker: int,
    # in
    transmittance: wp.array3d(dtype=Chunk),
    normals: wp.array2d(dtype=wp.vec3),
    directions: wp.array2d(dtype=Chunk),
    weight: float,
    # out
    transfer: wp.array3d(dtype=Chunk),
):
    """A thread owns a receiver."""
    batch, receiver = split_row(first_row + wp.tid(), normals.shape[1])
    nx, ny, nz = broadcast_normal(normals[batch, receiver])
    for chunk in range(directions.shape[1]):
        x = directions[0, chunk]
        y = directions[1, chunk]
        z = directions[2, chunk]
        t = transmittance[batch, receiver, chunk]
        transfer[batch, receiver, chunk] = transfer_chunk(weight, nx, ny, nz, x, y, z, t)


@wp.kernel(enable_backward=False)
def _transfer_directions_adjoint(
    first_row: int,
    worker: int,
    # in
    transmittance: wp.array3d(dtype=Chunk),
    normals: wp.array2d(dtype=wp.vec3),
    directions: wp.array2d(dtype=Chunk),
    weight: float,
    adj_transfer: wp.array3d(dtype=Chunk),
    # out
    adj_transmittance: wp.array3d(dtype=Chunk),
    adj_normals: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a receiver:  T̄_q += w max(n·ω_q, 0) t̄_q,  n̄ += Σ w T_q t̄_q ω_q where n·ω_q > 0."""
    batch, receiver = split_row(first_row + wp.tid(), normals.shape[1])
    nx, ny, nz = broadcast_normal(normals[batch, receiver])
    adj_x = Chunk(0.0)
    adj_y = Chunk(0.0)
    adj_z = Chunk(0.0)
    for chunk in range(directions.shape[1]):
        x = directions[0, chunk]
        y = directions[1, chunk]
        z = directions[2, chunk]
        t = transmittance[batch, receiver, chunk]
        adj = weight * adj_transfer[batch, receiver, chunk]
        adj_t, adj_cosine = transfer_chunk_adjoint(nx, ny, nz, x, y, z, t, adj)
        if adj_transmittance:
            adj_transmittance[batch, receiver, chunk] = adj_transmittance[batch, receiver, chunk] + adj_t
        adj_x += wp.cw_mul(adj_cosine, x)
        adj_y += wp.cw_mul(adj_cosine, y)
        adj_z += wp.cw_mul(adj_cosine, z)
    if adj_normals:
        adj_normal = wp.vec3(total_of_chunk(adj_x), total_of_chunk(adj_y), total_of_chunk(adj_z))
        adj_normals[batch, receiver] = adj_normals[batch, receiver] + adj_normal


def directional_transfer(transmittance: wp.array, normals: wp.array, directions: np.ndarray) -> wp.array:
    """Transfer vectors to light in cells of directions: T_q max(n·ω_q, 0) · (4π/Q) / π.

    Args:
        transmittance: Float32 of shape [batch, receiver, direction].
        normals: Unit normals, vec3 of shape [batch, receiver].
        directions: Unit vectors ω, NumPy of shape [direction, 3].
    Returns:
        Transfer vectors, float32 of shape [batch, receiver, direction].
    Differentiable: transmittance, normals.
    """
    inputs, device = prepare_cells(transmittance, normals, directions), normals.device
    use_vector_registers(__name__, device)
    transfer = empty(transmittance.shape, dtype=wp.float32, device=device)
    if transmittance.requires_grad or normals.requires_grad:
        require_gradient(transfer)  # before it is seen as chunks
    launch_with_adjoint(
        _transfer_directions,
        _transfer_directions_adjoint,
        normals.size,
        inputs=inputs,
        result=as_chunks(transfer),
        variables=inputs[:2],
        cost=_CELL_COST * len(directions),
    )
    return transfer
