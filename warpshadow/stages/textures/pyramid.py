"""Mip pyramids: textures of any sizes with their levels, in one array.

A texture is an image of linear RGB reflectance with row 0 at v = 1; it repeats outside of [0, 1], and its texels have
their centers at +0.5. Each mip level is half as large as the one before, and a texel there is the mean of the texels
that it covers.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warpshadow import check
from warpshadow.device.batch import accumulate, common_batch, rows
from warpshadow.device.constants import cached_by_values, constant
from warpshadow.device.launch import differentiable, launch
from warpshadow.device.memory import empty
from warpshadow.device.parallel import run_length
from warpshadow.device.tape import unrecorded

if TYPE_CHECKING:  # it is imported where a matrix is made
    from scipy.sparse import csr_matrix

Sizes = tuple[tuple[int, int], ...]


@dataclass(frozen=True, eq=False)
class Textures:
    """Mip levels of several textures, of any sizes, in one array.

    Args:
        texels: All levels of all textures, linear RGB, vec3 of shape [batch, texel].
        levels: First texel, width and height of each level, the finest first, vec3i of shape [texture, level].
        level_counts: Levels that each texture has, int32 of shape [texture].
        sizes: Height and width of each texture.
    """

    texels: wp.array
    levels: wp.array
    level_counts: wp.array
    sizes: Sizes


def level_sizes(height: int, width: int) -> list[tuple[int, int]]:
    """Height and width of each level, rounded down, to a single texel."""
    sizes = [(height, width)]
    while max(sizes[-1]) > 1:
        height, width = max(height // 2, 1), max(width // 2, 1)
        sizes.append((height, width))
    return sizes


def level_matrices(height: int, width: int) -> Iterator[csr_matrix]:
    """The matrices from the texels of an image to the texels of each level, [texel of the level, texel], one by one."""
    from scipy.sparse import identity, kron

    row_matrix, column_matrix = identity(height, format="csr"), identity(width, format="csr")
    yield kron(row_matrix, column_matrix, format="csr")
    for rows_left, columns_left in level_sizes(height, width)[1:]:
        row_matrix = _halving(row_matrix.shape[0], rows_left) @ row_matrix
        column_matrix = _halving(column_matrix.shape[0], columns_left) @ column_matrix
        yield kron(row_matrix, column_matrix, format="csr")


def _halving(fine_count: int, coarse_count: int) -> csr_matrix:
    """Matrix of the shares (:func:`_shares`) of fine texels along a side in coarse ones."""
    from scipy.sparse import csr_matrix

    coarse = np.arange(coarse_count)
    if fine_count == 1:
        fine_weights = np.ones((1, 1))
    elif fine_count == 2 * coarse_count:
        fine_weights = np.full((coarse_count, 2), 0.5)
    else:
        weights = [coarse_count - coarse, np.full(coarse_count, coarse_count), coarse + 1]
        fine_weights = np.stack(weights, axis=1) / fine_count
    fine_indices = 2 * coarse[:, None] + np.arange(fine_weights.shape[1])
    starts = np.arange(coarse_count + 1) * fine_weights.shape[1]
    return csr_matrix((fine_weights.ravel(), fine_indices.ravel(), starts), (coarse_count, fine_count))


class _Layout:
    """Layout of the levels of textures in an array of texels."""

    def __init__(self, sizes: Sizes, device: str):
        level_sizes_of_textures = [level_sizes(*size) for size in sizes]
        self.level_counts = [len(texture_levels) for texture_levels in level_sizes_of_textures]
        self.levels = np.zeros((len(sizes), max(self.level_counts), 3), np.int32)
        self.texel_count = 0
        for texture, texture_levels in enumerate(level_sizes_of_textures):
            for level, (height, width) in enumerate(texture_levels):
                self.levels[texture, level] = self.texel_count, width, height
                self.texel_count += width * height
        self.device_levels = constant(self.levels, wp.vec3i, device)
        self.device_level_counts = constant(np.array(self.level_counts), wp.int32, device)

    def steps(self, texture: int, coarsest: int | None) -> list[tuple[wp.vec3i, wp.vec3i]]:
        """Pairs of a level of a texture and the next coarser one, from the finest to the ``coarsest``, None for all."""
        level_count = self.level_counts[texture]
        if coarsest is not None:
            level_count = min(level_count, coarsest + 1)
        levels = [wp.vec3i(*level) for level in self.levels[texture, :level_count].tolist()]
        return list(zip(levels[:-1], levels[1:], strict=True))


@cached_by_values
def _layout(sizes: Sizes, device: str) -> _Layout:
    return _Layout(sizes, device)


@wp.func
def _shares(coarse: int, fine_count: int, coarse_count: int):
    """Shares of the three fine texels from number 2 ``coarse`` on in a coarse one.

    An odd number of fine texels is not twice that of coarse ones, which cover 2 + 1/coarse_count each: the outer two
    of the three are shared with their neighbors.
    """
    if fine_count == 1:
        return wp.vec3(1.0, 0.0, 0.0)
    if fine_count == 2 * coarse_count:
        return wp.vec3(0.5, 0.5, 0.0)
    return wp.vec3(float(coarse_count - coarse), float(coarse_count), float(coarse + 1)) / float(fine_count)


@wp.func
def _fine_texels(texel: int, fine: wp.vec3i, coarse: wp.vec3i):
    """First of the 3 × 3 fine texels around a coarse one, and the weights of their columns and rows."""
    row = texel // coarse[1]
    column = texel - row * coarse[1]
    start = fine[0] + 2 * row * fine[1] + 2 * column
    return start, _shares(column, fine[1], coarse[1]), _shares(row, fine[2], coarse[2])


@wp.kernel(enable_backward=False)
def _halve(
    # in
    fine: wp.vec3i,
    coarse: wp.vec3i,
    run: int,
    # out
    texels: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a run of texels of the coarse level: means over the fine texels that they cover."""
    batch, thread = wp.tid()
    instance_texels = texels[batch]
    for texel in range(thread * run, (thread + 1) * run):
        start, column_weights, row_weights = _fine_texels(texel, fine, coarse)
        mean = wp.vec3()
        for i in range(3):
            if row_weights[i] > 0.0:
                for j in range(3):
                    if column_weights[j] > 0.0:
                        mean += (row_weights[i] * column_weights[j]) * instance_texels[start + i * fine[1] + j]
        instance_texels[coarse[0] + texel] = mean


@wp.kernel(enable_backward=False)
def _halve_adjoint(
    # in
    fine: wp.vec3i,
    coarse: wp.vec3i,
    run: int,
    # out
    adj_texels: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a run of texels of the coarse level."""
    batch, thread = wp.tid()
    instance_texels = adj_texels[batch]
    for texel in range(thread * run, (thread + 1) * run):
        start, column_weights, row_weights = _fine_texels(texel, fine, coarse)
        adj_mean = instance_texels[coarse[0] + texel]
        for i in range(3):
            if row_weights[i] > 0.0:
                for j in range(3):
                    if column_weights[j] > 0.0:
                        wp.atomic_add(
                            instance_texels, start + i * fine[1] + j, (row_weights[i] * column_weights[j]) * adj_mean
                        )


def mip_pyramids(images: Sequence[wp.array], *, coarsest: int | None = None) -> Textures:
    """Compute the mip levels of textures, down to a single texel.

    A level has half the width and the height of the one before, rounded down; its texels have the same size and cover
    the same square, so where a number is odd a texel is shared by its two neighbors. Each level has the image's mean.

    Args:
        images: Linear RGB, row 0 at v = 1, vec3 of shape [batch, height, width], each of its own size; a batch may be
            1 and then serves every instance.
        coarsest: Coarsest level that is wanted, 0 for the image itself, if footprints are known and take none beyond;
            by default all.
    Returns:
        All levels, except levels beyond the coarsest, which are unwritten or left out. One image without coarser levels
        is not copied.
    Differentiable: images.
    """
    if not images:
        raise ValueError("images: got none, expected at least one")
    for number, image in enumerate(images):
        check.shape(f"images[{number}]", image.shape, ("batch", "height", "width"))
        if image.dtype != wp.vec3 or not image.size or not image.is_contiguous:
            got = f"{'' if image.is_contiguous else 'strided '}{image.dtype.__name__} of shape {image.shape}"
            raise ValueError(f"images[{number}]: got {got}, expected contiguous vec3 with at least one texel")
    sizes = tuple(image.shape[1:] for image in images)
    device = images[0].device
    layout = _layout(sizes, str(device))
    if len(images) == 1 and coarsest == 0:
        return Textures(rows(images[0]), layout.device_levels, layout.device_level_counts, sizes)
    batch_count = common_batch({f"images[{number}]": image for number, image in enumerate(images)})

    def fill(texels: wp.array) -> None:
        with unrecorded():  # Warp's tape would record copies
            for number, image in enumerate(images):
                for image_region, texel_region in _finest_levels(image, texels, layout, number):
                    wp.copy(texel_region, image_region)
                for fine, coarse in layout.steps(number, coarsest):
                    _launch_on_level(_halve, fine, coarse, texels)

    texels = differentiable(
        fill,
        lambda adj_texels: gather_levels(adj_texels, [image.grad for image in images], sizes, coarsest=coarsest),
        result=empty((batch_count, layout.texel_count), dtype=wp.vec3, device=device),
        variables=images,
    )
    return Textures(texels, layout.device_levels, layout.device_level_counts, sizes)


def gather_levels(
    adj_texels: wp.array, adj_images: Sequence[wp.array | None], sizes: Sizes, *, coarsest: int | None
) -> None:
    """The adjoint of :func:`mip_pyramids`: add the gradients of all levels to the images' gradients.

    Args:
        adj_texels: Of the texels, vec3 of shape [batch, texel]; finer levels gather the gradients of coarser ones.
        adj_images: Of the images, vec3 of shape [batch, height, width]; None to skip one.
        sizes: Height and width of each image.
        coarsest: Coarsest level that has gradients, None for the last.
    """
    layout = _layout(sizes, str(adj_texels.device))
    for number, image in enumerate(adj_images):
        if image is not None:
            for fine, coarse in reversed(layout.steps(number, coarsest)):
                _launch_on_level(_halve_adjoint, fine, coarse, adj_texels)
            for image_region, texel_region in _finest_levels(image, adj_texels, layout, number):
                accumulate(texel_region, image_region)


def _finest_levels(image: wp.array, texels: wp.array, layout: _Layout, number: int) -> list[tuple[wp.array, wp.array]]:
    """An image [height · width] and the texels of its finest level, in each instance."""
    first, width, height = layout.levels[number, 0].tolist()
    flat = rows(image)
    return [
        (flat[min(batch, image.shape[0] - 1)], texels[batch, first : first + width * height])
        for batch in range(texels.shape[0])
    ]


def _launch_on_level(kernel: wp.Kernel, fine: wp.vec3i, coarse: wp.vec3i, texels: wp.array) -> None:
    """Launch for a coarse level of every instance."""
    run = run_length(texels.device, coarse[1])
    launch(kernel, (texels.shape[0], coarse[1] * coarse[2] // run), inputs=[fine, coarse, run], outputs=[texels])
