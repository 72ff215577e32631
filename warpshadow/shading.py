"""Shading: visibility times light times cosine.

    B(x) = a(x)/π ∫ L(ω) V(ω, x) max(n·ω, 0) dω

is linear in the light, so a receiver that stands still has a *transfer vector* T with B = a · (T · L): its
coefficients belong to the light's, either spherical harmonics or cells of directions. The 1/π is in T: white under
L = 1, unoccluded, gives 1. *Shading* below is T · L, the radiance of a white surface.
"""

import functools

import numpy as np
import warp as wp

from warpshadow import check, sh
from warpshadow.directions import CHUNK, check_count
from warpshadow.lanes import MODULE_OPTIONS, group_count, lane_count, lane_functions, lane_type

# ---------------------------------------------------------------------------------------------- transfer vectors


@functools.cache
def _sh_transfer_kernel(order: int, is_shadowed: bool, lanes: int) -> wp.Kernel:
    Lane, Zonal = lane_type(lanes), sh.zonal_type(order, lanes)
    fn = lane_functions(lanes)
    load, load_rows, store_rows = fn.load, fn.load_rows, fn.store_rows
    add_rotated_zonal = sh.add_rotated_zonal(order, lanes)
    multiply = sh.multiply(order, lanes)
    COSINE = wp.types.vector(length=order, dtype=wp.float32)(*(sh.clamped_cosine(order) / np.pi))

    @wp.kernel(module="unique", module_options=MODULE_OPTIONS, enable_backward=False)
    def transfer_sh(
        # in
        visibility: wp.array3d(dtype=wp.float32),
        normals: wp.array2d(dtype=wp.vec3),
        first: wp.array(dtype=wp.int32),
        pairs: wp.array(dtype=wp.vec2i),
        values: wp.array(dtype=wp.float32),
        # scratch
        scratch: wp.array4d(dtype=Lane),
        # out
        transfer: wp.array3d(dtype=wp.float32),
    ):
        """A thread owns a group of receivers: the SH product of their visibility and clamped cosine."""
        batch, group = wp.tid()
        cosine = scratch[batch, group, 0]
        for i in range(wp.static(order**2)):
            cosine[i] = Lane(0.0)
        zonal = Zonal()
        for band in range(order):
            zonal[band] = Lane(COSINE[band])
        x, y, z = load(normals[batch], group)
        add_rotated_zonal(x, y, z, zonal, cosine)
        if wp.static(is_shadowed):
            factor = scratch[batch, group, 1]
            product = scratch[batch, group, 2]
            load_rows(visibility[batch], group, factor)
            multiply(factor, cosine, first, pairs, values, product)
            store_rows(product, group, transfer[batch])
        else:
            store_rows(cosine, group, transfer[batch])

    return transfer_sh


def sh_transfer(visibility: wp.array | None, normals: wp.array, *, order: int) -> wp.array:
    """Transfer vectors to light in spherical harmonics: (V * H_n)_k / π, H_n the clamped cosine around the normal.

    Args:
        visibility: SH visibility, float32 of shape [batch, vertex, order²]; None where nothing blocks.
        normals: Unit normals, vec3 of shape [batch, vertex].
        order: Number of SH bands, 2 to 8.

    Returns:
        Transfer vectors, float32 of shape [batch, vertex, order²].

    Differentiable: nothing yet.
    """
    sh.check_order(order)
    device = normals.device
    lanes = lane_count(device)
    batch_count, vertex_count = normals.shape
    if visibility is not None:
        check.shape("visibility", visibility.shape, (batch_count, vertex_count, order**2))
    groups = group_count(vertex_count, lanes)
    transfer = wp.empty((batch_count, vertex_count, order**2), dtype=wp.float32, device=device)
    lit_bands = tuple(band for band in range(order) if band < 2 or band % 2 == 0)
    wp.launch(
        _sh_transfer_kernel(order, visibility is not None, lanes),
        dim=(batch_count, groups),
        inputs=[
            visibility,
            normals,
            *sh.product_table(order, str(device), bands_of_j=lit_bands),
            wp.empty((batch_count, groups, 3, order**2), dtype=lane_type(lanes), device=device),
        ],
        outputs=[transfer],
        device=device,
    )
    return transfer


_Chunk = wp.types.vector(length=CHUNK, dtype=wp.float32)


@wp.kernel(enable_backward=False)
def _transfer_directions(
    # in
    transmittance: wp.array3d(dtype=_Chunk),
    normals: wp.array2d(dtype=wp.vec3),
    directions: wp.array2d(dtype=_Chunk),
    weight: float,
    # out
    transfer: wp.array3d(dtype=_Chunk),
):
    """A thread owns a receiver."""
    batch, vertex = wp.tid()
    n = normals[batch, vertex]
    for chunk in range(directions.shape[1]):
        cosine = n[0] * directions[0, chunk] + n[1] * directions[1, chunk] + n[2] * directions[2, chunk]
        cosine = weight * wp.max(cosine, _Chunk(0.0))
        transfer[batch, vertex, chunk] = wp.cw_mul(cosine, transmittance[batch, vertex, chunk])


def directional_transfer(transmittance: wp.array, normals: wp.array, directions: np.ndarray) -> wp.array:
    """Transfer vectors to light in cells of directions: T_q max(n·ω_q, 0) · (4π/Q) / π.

    Args:
        transmittance: Float32 of shape [batch, vertex, direction].
        normals: Unit normals, vec3 of shape [batch, vertex].
        directions: Unit vectors ω, NumPy of shape [direction, 3].

    Returns:
        Transfer vectors, float32 of shape [batch, vertex, direction].

    Differentiable: nothing yet.
    """
    count = len(directions)
    check_count("directions", count)
    check.shape("transmittance", transmittance.shape, (*normals.shape, count))
    device = normals.device
    transmittance = transmittance.contiguous()  # to be viewed as chunks
    transfer = wp.empty_like(transmittance)
    shape = (*normals.shape, count // CHUNK)
    wp.launch(
        _transfer_directions,
        dim=normals.shape,
        inputs=[
            _as_chunks(transmittance, shape),
            normals,
            wp.array(directions.T.reshape(3, -1, CHUNK), dtype=_Chunk, device=device),
            4.0 / count,
        ],
        outputs=[_as_chunks(transfer, shape)],
        device=device,
    )
    return transfer


def _as_chunks(values: wp.array, shape: tuple[int, ...]) -> wp.array:
    """View rows of float32 as rows of chunks."""
    return wp.array(ptr=values.ptr, dtype=_Chunk, shape=shape, device=values.device)


# ---------------------------------------------------------------------------------------------- light


@wp.kernel
def _shade(
    # in
    transfer: wp.array3d(dtype=wp.float32),
    light: wp.array2d(dtype=wp.vec3),
    # out
    shading: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a receiver."""
    batch, vertex = wp.tid()
    total = wp.vec3()
    for k in range(transfer.shape[2]):
        total += transfer[batch, vertex, k] * light[batch, k]
    shading[batch, vertex] = total


def shade(transfer: wp.array, light: wp.array) -> wp.array:
    """Light receivers: the radiance T · L of a white surface.

    Args:
        transfer: Transfer vectors, float32 of shape [batch, vertex, coefficient].
        light: Coefficients of the light, linear RGB, vec3 of shape [batch, coefficient].

    Returns:
        Shading, vec3 of shape [batch, vertex].

    Differentiable: transfer, light.
    """
    check.shape("light", light.shape, (transfer.shape[0], transfer.shape[2]))
    shading = wp.empty(
        transfer.shape[:2],
        dtype=wp.vec3,
        device=transfer.device,
        requires_grad=transfer.requires_grad or light.requires_grad,
    )
    wp.launch(_shade, dim=shading.shape, inputs=[transfer, light], outputs=[shading], device=transfer.device)
    return shading


# ---------------------------------------------------------------------------------------------- textures


@wp.kernel
def _sample_texture(
    # in
    texture: wp.array2d(dtype=wp.vec3),
    pixels: wp.array(dtype=wp.int32),
    uvs: wp.array(dtype=wp.vec2),
    # out
    albedo: wp.array(dtype=wp.vec3),
):
    """A thread owns a textured pixel: the four texels around its uv, which repeats outside of [0, 1]."""
    thread = wp.tid()
    height = texture.shape[0]
    width = texture.shape[1]
    pixel = pixels[thread]
    uv = uvs[pixel]
    x = (uv[0] - wp.floor(uv[0])) * float(width) - 0.5
    y = (1.0 - (uv[1] - wp.floor(uv[1]))) * float(height) - 0.5
    left = int(wp.floor(x))
    top = int(wp.floor(y))
    s = x - float(left)
    t = y - float(top)
    left = (left + width) % width
    top = (top + height) % height
    right = (left + 1) % width
    bottom = (top + 1) % height
    above = (1.0 - s) * texture[top, left] + s * texture[top, right]
    below = (1.0 - s) * texture[bottom, left] + s * texture[bottom, right]
    albedo[pixel] = (1.0 - t) * above + t * below


def sample_texture(texture: wp.array, pixels: wp.array, uvs: wp.array, albedo: wp.array) -> None:
    """Fill the pixels of a textured body with its texture, bilinearly; it repeats outside of [0, 1].

    Args:
        texture: Linear RGB, row 0 at v = 1, vec3 of shape [height, width].
        pixels: Flat indices of the pixels that show the body, int32 of shape [textured pixel].
        uvs: Texture coordinates of all pixels, vec2 of shape [pixel].
        albedo: Filled at ``pixels``, vec3 of shape [pixel].

    Differentiable: texture.
    """
    wp.launch(
        _sample_texture,
        dim=pixels.shape,
        inputs=[texture, pixels, uvs],
        outputs=[albedo],
        device=texture.device,
    )
