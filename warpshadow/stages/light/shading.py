"""Shading: the light that receivers send back as white surfaces, T · L of their transfer vectors and the light.

Where the light is known and in cells, transfer vectors are not written down: so the shading takes a third of the time.
"""

import numpy as np
import warp as wp

from warpshadow import check
from warpshadow.device.array_checks import finite_arrays
from warpshadow.device.batch import common_batch, instance_in
from warpshadow.device.cuda_graph import is_readable
from warpshadow.device.lanes import Chunk, as_chunks, total_of_chunk, use_vector_registers
from warpshadow.device.launch import differentiable, launch, launch_with_adjoint
from warpshadow.device.memory import empty
from warpshadow.device.parallel import split_row
from warpshadow.maths.directions import CHUNK
from warpshadow.stages.light.transfer import broadcast_normal, prepare_cells, transfer_chunk, transfer_chunk_adjoint

# receivers whose gradients to light a thread sums before it adds them to the others', on a CPU and on a GPU
_SLICE, _GPU_SLICE = 256, 16
_COEFFICIENT_COST, _RECEIVER_COST = 0.4, 30.0  # nanoseconds that a coefficient of a receiver takes, and a receiver


wp.set_module_options({"max_unroll": 1})


@wp.kernel(enable_backward=False)
def _split_channels(
    # in
    light: wp.array2d(dtype=wp.vec3),
    # out
    channels: wp.array3d(dtype=wp.float32),
):
    """A thread owns a coefficient of a channel."""
    batch, channel, k = wp.tid()
    channels[batch, channel, k] = light[batch, k][channel]


@wp.kernel(enable_backward=False)
def _join_channels(
    # in
    channels: wp.array3d(dtype=wp.float32),
    # out
    light: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a coefficient, to which it adds."""
    batch, k = wp.tid()
    light[batch, k] = light[batch, k] + wp.vec3(channels[batch, 0, k], channels[batch, 1, k], channels[batch, 2, k])


@wp.kernel(enable_backward=False)
def _shade(
    first_row: int,
    worker: int,
    # in
    transfer: wp.array3d(dtype=wp.float32),
    transfer_chunks: wp.array3d(dtype=Chunk),
    light: wp.array3d(dtype=wp.float32),
    light_chunks: wp.array3d(dtype=Chunk),
    # out
    shading: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a receiver; whole chunks of coefficients use the vector units, the remainder follows."""
    batch, receiver = split_row(first_row + wp.tid(), shading.shape[1])
    transfer_batch = instance_in(batch, transfer.shape[0])
    light_batch = instance_in(batch, light.shape[0])
    red = Chunk(0.0)
    green = Chunk(0.0)
    blue = Chunk(0.0)
    for chunk in range(transfer_chunks.shape[2]):
        t = transfer_chunks[transfer_batch, receiver, chunk]
        red += wp.cw_mul(t, light_chunks[light_batch, 0, chunk])
        green += wp.cw_mul(t, light_chunks[light_batch, 1, chunk])
        blue += wp.cw_mul(t, light_chunks[light_batch, 2, chunk])
    irradiance = wp.vec3(total_of_chunk(red), total_of_chunk(green), total_of_chunk(blue))
    for k in range(CHUNK * transfer_chunks.shape[2], transfer.shape[2]):
        irradiance += transfer[transfer_batch, receiver, k] * wp.vec3(
            light[light_batch, 0, k], light[light_batch, 1, k], light[light_batch, 2, k]
        )
    shading[batch, receiver] = irradiance


@wp.kernel(enable_backward=False)
def _shade_adjoint_transfer(
    first_row: int,
    worker: int,
    # in
    light: wp.array3d(dtype=wp.float32),
    light_chunks: wp.array3d(dtype=Chunk),
    adj_shading: wp.array2d(dtype=wp.vec3),
    # out
    adj_transfer: wp.array3d(dtype=wp.float32),
    adj_transfer_chunks: wp.array3d(dtype=Chunk),
):
    """A thread owns a transfer vector and the instances that it serves:  T̄ = Σ_instances L s̄."""
    transfer_batch, receiver = split_row(first_row + wp.tid(), adj_shading.shape[1])
    begin = transfer_batch
    end = transfer_batch + 1
    if adj_transfer.shape[0] == 1:
        end = adj_shading.shape[0]
    for batch in range(begin, end):
        light_batch = instance_in(batch, light.shape[0])
        adj_irradiance = adj_shading[batch, receiver]
        for chunk in range(light_chunks.shape[2]):
            adj_transfer_chunks[transfer_batch, receiver, chunk] = (
                adj_transfer_chunks[transfer_batch, receiver, chunk]
                + adj_irradiance[0] * light_chunks[light_batch, 0, chunk]
                + adj_irradiance[1] * light_chunks[light_batch, 1, chunk]
                + adj_irradiance[2] * light_chunks[light_batch, 2, chunk]
            )
        for k in range(CHUNK * light_chunks.shape[2], light.shape[2]):
            adj_transfer[transfer_batch, receiver, k] = adj_transfer[transfer_batch, receiver, k] + wp.dot(
                adj_irradiance, wp.vec3(light[light_batch, 0, k], light[light_batch, 1, k], light[light_batch, 2, k])
            )


@wp.kernel(enable_backward=False)
def _shade_adjoint_light(
    first_row: int,
    worker: int,
    # in
    transfer: wp.array3d(dtype=wp.float32),
    transfer_chunks: wp.array3d(dtype=Chunk),
    adj_shading: wp.array2d(dtype=wp.vec3),
    slice_size: int,
    # out
    adj_light: wp.array3d(dtype=wp.float32),
):
    """A thread owns a chunk of coefficients, the last one the remainder, and a slice of receivers:  L̄ = Σ T s̄."""
    row, batch, slice_index = wp.tid()
    chunk = first_row + row
    transfer_batch = instance_in(batch, transfer.shape[0])
    light_batch = instance_in(batch, adj_light.shape[0])
    begin = slice_index * slice_size
    end = wp.min(begin + slice_size, transfer.shape[1])
    first_direction = chunk * CHUNK
    if chunk < transfer_chunks.shape[2]:
        red = Chunk(0.0)
        green = Chunk(0.0)
        blue = Chunk(0.0)
        for receiver in range(begin, end):
            adj_irradiance = adj_shading[batch, receiver]
            t = transfer_chunks[transfer_batch, receiver, chunk]
            red += adj_irradiance[0] * t
            green += adj_irradiance[1] * t
            blue += adj_irradiance[2] * t
        for i in range(CHUNK):
            wp.atomic_add(adj_light, light_batch, 0, first_direction + i, red[i])
            wp.atomic_add(adj_light, light_batch, 1, first_direction + i, green[i])
            wp.atomic_add(adj_light, light_batch, 2, first_direction + i, blue[i])
    else:
        for k in range(first_direction, transfer.shape[2]):
            adj_coefficient = wp.vec3()
            for receiver in range(begin, end):
                adj_coefficient += transfer[transfer_batch, receiver, k] * adj_shading[batch, receiver]
            for channel in range(3):
                wp.atomic_add(adj_light, light_batch, channel, k, adj_coefficient[channel])


def _channels(light: wp.array) -> wp.array:
    """Light [batch, coefficient] as float32 of shape [batch, channel, coefficient]."""
    channels = empty((light.shape[0], 3, light.shape[1]), dtype=wp.float32, device=light.device)
    if light.size and is_readable(light.device):  # NumPy takes a tenth of the time of a launch
        np.asarray(channels)[...] = np.asarray(light).transpose(0, 2, 1)
    else:
        launch(_split_channels, channels.shape, inputs=[light], outputs=[channels])
    return channels


def shade(transfer: wp.array, light: wp.array, *, maximum: float = check.LARGEST) -> wp.array:
    """Light receivers: the radiance T · L of a white surface.

    Args:
        transfer: Transfer vectors, float32 of shape [batch, receiver, coefficient].
        light: Coefficients of the light, linear RGB, vec3 of shape [batch, coefficient].
            Either batch may be 1 and then serves every instance of the other.
        maximum: Largest magnitude of a coefficient.
    Returns:
        Shading, vec3 of shape [batch, receiver].
    Differentiable: transfer, light. Exact, both being linear.
    """
    check.shape("light", light.shape, ("batch", transfer.shape[2]))
    finite_arrays({"light": light}, maximum=maximum)
    for name, array in (("transfer", transfer), ("light", light)):
        if not array.is_contiguous:
            raise ValueError(f"{name}: got a strided array, expected a contiguous one")
    device = transfer.device
    count = light.shape[1]
    instances = common_batch({"transfer": transfer, "light": light})
    use_vector_registers(__name__, device)
    channels = _channels(light)
    transfer_inputs, light_inputs = [transfer, as_chunks(transfer)], [channels, as_chunks(channels)]
    cost = _RECEIVER_COST + _COEFFICIENT_COST * count

    def adjoint(adj_shading: wp.array) -> None:
        if transfer.requires_grad:
            launch(
                _shade_adjoint_transfer,
                transfer.shape[0] * transfer.shape[1],
                inputs=[*light_inputs, adj_shading],
                outputs=[transfer.grad, as_chunks(transfer.grad)],
                cost=cost * instances / transfer.shape[0],
            )
        if light.requires_grad:
            adj_channels = wp.zeros_like(channels)
            slice_size = _GPU_SLICE if device.is_cuda else _SLICE
            launch(
                _shade_adjoint_light,
                (-(-count // CHUNK), instances, -(-transfer.shape[1] // slice_size)),
                inputs=[*transfer_inputs, adj_shading, slice_size],
                outputs=[adj_channels],
                cost=_COEFFICIENT_COST * CHUNK * slice_size,
            )
            launch(_join_channels, light.shape, inputs=[adj_channels], outputs=[light.grad])

    return differentiable(
        lambda shading: launch(
            _shade, shading.size, inputs=[*transfer_inputs, *light_inputs], outputs=[shading], cost=cost
        ),
        adjoint,
        result=empty((instances, transfer.shape[1]), dtype=wp.vec3, device=device),
        variables=[transfer, light],
    )


# ---------------------------------------------------------------------------------------------------- known light


@wp.kernel(enable_backward=False)
def _shade_cells(
    first_row: int,
    worker: int,
    # in
    transmittance: wp.array3d(dtype=Chunk),
    normals: wp.array2d(dtype=wp.vec3),
    directions: wp.array2d(dtype=Chunk),
    weight: float,
    light: wp.array3d(dtype=Chunk),
    # out
    shading: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a receiver."""
    batch, receiver = split_row(first_row + wp.tid(), shading.shape[1])
    light_batch = instance_in(batch, light.shape[0])
    nx, ny, nz = broadcast_normal(normals[batch, receiver])
    red = Chunk(0.0)
    green = Chunk(0.0)
    blue = Chunk(0.0)
    for chunk in range(directions.shape[1]):
        x = directions[0, chunk]
        y = directions[1, chunk]
        z = directions[2, chunk]
        transfer = transfer_chunk(1.0, nx, ny, nz, x, y, z, transmittance[batch, receiver, chunk])
        red += wp.cw_mul(transfer, light[light_batch, 0, chunk])
        green += wp.cw_mul(transfer, light[light_batch, 1, chunk])
        blue += wp.cw_mul(transfer, light[light_batch, 2, chunk])
    shading[batch, receiver] = weight * wp.vec3(total_of_chunk(red), total_of_chunk(green), total_of_chunk(blue))


@wp.kernel(enable_backward=False)
def _shade_cells_adjoint(
    first_row: int,
    worker: int,
    # in
    transmittance: wp.array3d(dtype=Chunk),
    normals: wp.array2d(dtype=wp.vec3),
    directions: wp.array2d(dtype=Chunk),
    weight: float,
    light: wp.array3d(dtype=Chunk),
    adj_shading: wp.array2d(dtype=wp.vec3),
    # out
    adj_transmittance: wp.array3d(dtype=Chunk),
    adj_normals: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a receiver:  with t̄_q = w L_q·s̄,  T̄_q += max(n·ω_q, 0) t̄_q,  n̄ += Σ T_q t̄_q ω_q where n·ω_q > 0."""
    batch, receiver = split_row(first_row + wp.tid(), adj_shading.shape[1])
    light_batch = instance_in(batch, light.shape[0])
    nx, ny, nz = broadcast_normal(normals[batch, receiver])
    adj = weight * adj_shading[batch, receiver]
    adj_x = Chunk(0.0)
    adj_y = Chunk(0.0)
    adj_z = Chunk(0.0)
    for chunk in range(directions.shape[1]):
        x = directions[0, chunk]
        y = directions[1, chunk]
        z = directions[2, chunk]
        adj_transfer = (
            adj[0] * light[light_batch, 0, chunk]
            + adj[1] * light[light_batch, 1, chunk]
            + adj[2] * light[light_batch, 2, chunk]
        )
        t = transmittance[batch, receiver, chunk]
        adj_t, adj_cosine = transfer_chunk_adjoint(nx, ny, nz, x, y, z, t, adj_transfer)
        if adj_transmittance:
            adj_transmittance[batch, receiver, chunk] = adj_transmittance[batch, receiver, chunk] + adj_t
        adj_x += wp.cw_mul(adj_cosine, x)
        adj_y += wp.cw_mul(adj_cosine, y)
        adj_z += wp.cw_mul(adj_cosine, z)
    if adj_normals:
        adj_normal = wp.vec3(total_of_chunk(adj_x), total_of_chunk(adj_y), total_of_chunk(adj_z))
        adj_normals[batch, receiver] = adj_normals[batch, receiver] + adj_normal


def shade_cells(
    transmittance: wp.array,
    normals: wp.array,
    directions: np.ndarray,
    light: wp.array,
    *,
    maximum: float = check.LARGEST,
) -> wp.array:
    """Light receivers by known light in cells: Σ_q T_q max(n·ω_q, 0) (4/Q) L_q.

    That is :func:`shade` of :func:`warpshadow.stages.light.transfer.directional_transfer`.

    Args:
        transmittance: T, float32 of shape [batch, receiver, direction].
        normals: Unit normals n, vec3 of shape [batch, receiver].
        directions: Unit vectors ω, NumPy of shape [direction, 3].
        light: L, linear RGB, vec3 of shape [batch, direction]; its batch may be 1.
        maximum: Largest magnitude of light.
    Returns:
        Shading, vec3 of shape [batch, receiver].
    Differentiable: transmittance, normals. Not: light.
    """
    cells, device = prepare_cells(transmittance, normals, directions), normals.device
    check.shape("light", light.shape, ("batch", len(directions)))
    finite_arrays({"light": light}, maximum=maximum)
    use_vector_registers(__name__, device)
    cost = _RECEIVER_COST + _COEFFICIENT_COST * len(directions)
    return launch_with_adjoint(
        _shade_cells,
        _shade_cells_adjoint,
        normals.size,
        inputs=[*cells, as_chunks(_channels(light))],
        result=empty(normals.shape, dtype=wp.vec3, device=device),
        variables=cells[:2],
        cost=cost,
        adj_cost=cost,
    )
