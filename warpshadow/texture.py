"""Textures: mip levels, and the reflectance that each sample of an image sees of them.

A texture is an image of linear RGB reflectance with row 0 at v = 1; it repeats outside of [0, 1], and its texels have
their centers at +0.5. Each mip level is half as large as the one before, and a texel there is the mean of those that
it covers.

A sample does not see a point of the texture but its *footprint*: to first order an ellipse, the image of the sample
under the derivative of uv by its position. The footprint is filtered by *probes* on a line along its major axis. A
probe is bilinear in two mip levels, blended so that their mean texel is as wide as the minor axis. So a ground seen
at a grazing angle neither blurs nor aliases, and each texel in view gets its share of the gradient: a texture that is
fitted has no holes. Where a texel is larger than the footprint, one probe of the finest level is left, which is
bilinear interpolation.
"""

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp

from warpshadow import check
from warpshadow.batch import common_batch, rows
from warpshadow.parallel import launch_slices, split_row
from warpshadow.raster import Fragments, _instance, _relative, _volumes, run_length
from warpshadow.tape import launch, record_adjoint

_SAMPLE_COST = 10.0
"""Nanoseconds that a sample takes."""

MAX_PROBES = 7
"""Most probes of a footprint, an odd number; where it is longer still, its probes grow wider."""

# A probe reaches beyond its width, so a line of n probes may be this many widths longer than n widths. Of 0 to 1, a
# quarter was nearest to the mean over the footprint, for noise, natural spectra and checkerboards.
_REACH = 0.25

# Derivatives of uv are cut off here [texels per sample], so that their fourth powers stay finite.
_MAX_DERIVATIVE = 1.0e6


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
    sizes: tuple[tuple[int, int], ...]


@dataclass(frozen=True, eq=False)
class Footprints:
    """Where each sample lies in its texture, and what it covers there.

    Args:
        texture_ids: Texture that the sample sees, -1 where none, int32 of shape [batch, height, width].
        uvs: Texture coordinates, vec2 of shape [batch, height, width].
        probes: (Δu, Δv, width, count): probes lie Δ apart on a line through uv, each as wide as ``width`` texels of
            the finest level; ``count`` is the length of the line in widths, at least 1, and need not be whole. Vec4 of
            shape [batch, height, width].
    """

    texture_ids: wp.array
    uvs: wp.array
    probes: wp.array

    @functools.cached_property
    def rows(self) -> list[wp.array]:
        """The arrays as [batch, sample]."""
        return [*map(rows, (self.texture_ids, self.uvs, self.probes))]

    def coarsest_level(self) -> int:
        """Coarsest level that a probe takes, if textures have that many; it waits for the device."""
        width = self.probes.numpy()[..., 2].max(initial=1.0)
        return math.ceil(math.log2(width))


# ---------------------------------------------------------------------------------------------------- mip levels


def _level_sizes(height: int, width: int) -> list[tuple[int, int]]:
    """Height and width of each level, rounded down, to a single texel."""
    sizes = [(height, width)]
    while max(sizes[-1]) > 1:
        height, width = max(height // 2, 1), max(width // 2, 1)
        sizes.append((height, width))
    return sizes


class _Layout:
    """Where the levels of textures lie in an array of texels."""

    def __init__(self, sizes: tuple[tuple[int, int], ...], device: str):
        level_sizes = [_level_sizes(*size) for size in sizes]
        self.level_counts = [len(part) for part in level_sizes]
        self.levels = np.zeros((len(sizes), max(self.level_counts), 3), np.int32)
        self.texel_count = 0
        for texture, part in enumerate(level_sizes):
            for level, (height, width) in enumerate(part):
                self.levels[texture, level] = self.texel_count, width, height
                self.texel_count += width * height
        self.device_levels = wp.array(self.levels, dtype=wp.vec3i, device=device)
        self.device_level_counts = wp.array(self.level_counts, dtype=wp.int32, device=device)

    def steps(self, texture: int, coarsest: int | None) -> list[tuple[wp.vec3i, wp.vec3i]]:
        """Each level of a texture with the next, coarser one, from the finest to the coarsest that is wanted."""
        level_count = self.level_counts[texture]
        if coarsest is not None:
            level_count = min(level_count, coarsest + 1)
        levels = [wp.vec3i(*level) for level in self.levels[texture, :level_count].tolist()]
        return list(zip(levels[:-1], levels[1:], strict=True))


@functools.lru_cache(maxsize=64)
def _layout(sizes: tuple[tuple[int, int], ...], device: str) -> _Layout:
    return _Layout(sizes, device)


@wp.kernel(enable_backward=False)
def _copy(
    # in
    values: wp.array(dtype=wp.vec3),
    # out
    copies: wp.array(dtype=wp.vec3),
):
    """A thread owns a value."""
    thread = wp.tid()
    copies[thread] = values[thread]


@wp.kernel(enable_backward=False)
def _add(
    # in
    values: wp.array(dtype=wp.vec3),
    # out
    sums: wp.array(dtype=wp.vec3),
):
    """A thread owns a sum."""
    thread = wp.tid()
    sums[thread] = sums[thread] + values[thread]


@wp.func
def _shares(coarse: int, fine_count: int, coarse_count: int):
    """What part of a coarse texel each of the three fine ones from number 2 ``coarse`` on is.

    An odd number of fine texels is not twice that of coarse ones, which cover 2 + 1/coarse_count each: the outer two
    of the three are shared with their neighbors.
    """
    if fine_count == 1:
        return wp.vec3(1.0, 0.0, 0.0)
    if fine_count == 2 * coarse_count:
        return wp.vec3(0.5, 0.5, 0.0)
    return wp.vec3(float(coarse_count - coarse), float(coarse_count), float(coarse + 1)) / float(fine_count)


@wp.kernel(enable_backward=False)
def _halve(
    # in
    fine: wp.vec3i,
    coarse: wp.vec3i,
    run: int,
    # out
    texels: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a run of texels of the coarse level: the means of what they cover of the fine one."""
    batch, thread = wp.tid()
    of_instance = texels[batch]
    for texel in range(thread * run, (thread + 1) * run):
        row = texel // coarse[1]
        column = texel - row * coarse[1]
        across = _shares(column, fine[1], coarse[1])
        down = _shares(row, fine[2], coarse[2])
        start = fine[0] + 2 * row * fine[1] + 2 * column
        mean = wp.vec3()
        for i in range(3):
            if down[i] > 0.0:
                for j in range(3):
                    if across[j] > 0.0:
                        mean += (down[i] * across[j]) * of_instance[start + i * fine[1] + j]
        of_instance[coarse[0] + texel] = mean


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
    of_instance = adj_texels[batch]
    for texel in range(thread * run, (thread + 1) * run):
        row = texel // coarse[1]
        column = texel - row * coarse[1]
        across = _shares(column, fine[1], coarse[1])
        down = _shares(row, fine[2], coarse[2])
        start = fine[0] + 2 * row * fine[1] + 2 * column
        adj_mean = of_instance[coarse[0] + texel]
        for i in range(3):
            if down[i] > 0.0:
                for j in range(3):
                    if across[j] > 0.0:
                        wp.atomic_add(of_instance, start + i * fine[1] + j, (down[i] * across[j]) * adj_mean)


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
        All levels, those beyond the coarsest unwritten or left out. One image without coarser levels is not copied.

    Raises:
        ValueError: naming the argument, what it got and what it accepts.

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
    texels = wp.empty(
        (common_batch({f"images[{number}]": image for number, image in enumerate(images)}), layout.texel_count),
        dtype=wp.vec3,
        device=device,
        requires_grad=any(image.requires_grad for image in images),
    )
    for number, image in enumerate(images):
        for from_image, to_texels in _finest(image, texels, layout, number):
            _launch(_copy, to_texels.size, [from_image], [to_texels])
        for fine, coarse in layout.steps(number, coarsest):
            _launch_on_level(_halve, fine, coarse, texels)

    def adjoint() -> None:
        for number, image in enumerate(images):
            if image.requires_grad:
                _add_to_image(image.grad, texels.grad, layout, number, coarsest)

    record_adjoint(adjoint, [*images, texels])
    return Textures(texels, layout.device_levels, layout.device_level_counts, sizes)


def _add_to_image(
    adj_image: wp.array, adj_texels: wp.array, layout: _Layout, number: int, coarsest: int | None
) -> None:
    """Gather the gradients of all levels of a texture, the coarsest first, in its image."""
    for fine, coarse in reversed(layout.steps(number, coarsest)):
        _launch_on_level(_halve_adjoint, fine, coarse, adj_texels)
    for to_image, from_texels in _finest(adj_image, adj_texels, layout, number):
        _launch(_add, to_image.size, [from_texels], [to_image])


def _finest(image: wp.array, texels: wp.array, layout: _Layout, number: int) -> list[tuple[wp.array, wp.array]]:
    """An image [height · width] and the texels of its finest level, in each instance."""
    first, width, height = layout.levels[number, 0].tolist()
    flat = image.reshape((image.shape[0], width * height))
    return [
        (flat[min(batch, image.shape[0] - 1)], texels[batch, first : first + width * height])
        for batch in range(texels.shape[0])
    ]


def _launch_on_level(kernel: wp.Kernel, fine: wp.vec3i, coarse: wp.vec3i, texels: wp.array) -> None:
    """Launch for a coarse level of every instance."""
    run = run_length(texels.device, coarse[1])
    _launch(kernel, (texels.shape[0], coarse[1] * coarse[2] // run), [fine, coarse, run], [texels])


def _launch(kernel: wp.Kernel, dim: int | tuple[int, ...], inputs: list, outputs: list) -> None:
    """Launch off the tape, on the device of the first array."""
    device = next(value.device for value in [*inputs, *outputs] if isinstance(value, wp.array))
    wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=device, record_tape=False)


# ---------------------------------------------------------------------------------------------------- footprints


@wp.func
def _uv_derivatives(
    a: wp.vec4, b: wp.vec4, c: wp.vec4, to_a: wp.vec2, to_b: wp.vec2, to_c: wp.vec2, ray: wp.vec2, pixel: wp.vec2
):
    """Derivative of uv by the position of a sample [1/sample], its columns by column and row.

    ``a``, ``b`` and ``c`` are the vertices in clip space, ``to_a``, ``to_b`` and ``to_c`` their uvs relative to that of
    the sample, and ``pixel`` the steps of the ray from one sample to the next. With volumes v, linear in the ray,
    uv = Σ v_i uv_i / Σ v_i has the derivative Σ v_i' (uv_i - uv) / Σ v_i, on the whole plane of the face.
    """
    at_a = _relative(a, ray)
    at_b = _relative(b, ray)
    at_c = _relative(c, ray)
    volumes = _volumes(at_a, at_b, at_c)
    total = volumes[0] + volumes[1] + volumes[2]
    by_x = wp.vec3(at_b[1] * c[3] - b[3] * at_c[1], at_c[1] * a[3] - c[3] * at_a[1], at_a[1] * b[3] - a[3] * at_b[1])
    by_y = wp.vec3(b[3] * at_c[0] - at_b[0] * c[3], c[3] * at_a[0] - at_c[0] * a[3], a[3] * at_b[0] - at_a[0] * b[3])
    # seen edge-on the total vanishes: no less, then, than a millionth of what the volumes change within a sample
    least = 1.0e-6 * (
        pixel[0] * (wp.abs(by_x[0]) + wp.abs(by_x[1]) + wp.abs(by_x[2]))
        + pixel[1] * (wp.abs(by_y[0]) + wp.abs(by_y[1]) + wp.abs(by_y[2]))
    )
    scale = wp.where(wp.abs(total) > least, total, least + 1.0e-30)
    x = (pixel[0] / scale) * (by_x[0] * to_a + by_x[1] * to_b + by_x[2] * to_c)
    y = (pixel[1] / scale) * (by_y[0] * to_a + by_y[1] * to_b + by_y[2] * to_c)
    return wp.mat22(x[0], y[0], x[1], y[1])


@wp.func
def _probes(derivatives: wp.mat22, width: float, height: float):
    """Probes of a footprint (`Footprints`) in a texture of a size [texels].

    The derivative's singular values are the major and the minor axis of the footprint.
    """
    limit = wp.static(_MAX_DERIVATIVE)
    ux = wp.clamp(derivatives[0, 0] * width, -limit, limit)
    uy = wp.clamp(derivatives[0, 1] * width, -limit, limit)
    vx = wp.clamp(derivatives[1, 0] * height, -limit, limit)
    vy = wp.clamp(derivatives[1, 1] * height, -limit, limit)
    uu = ux * ux + uy * uy
    vv = vx * vx + vy * vy
    probes = wp.vec4(0.0, 0.0, 1.0, 1.0)
    if uu + vv > 1.0:  # else one probe of the finest level is enough
        uv = ux * vx + uy * vy
        half = 0.5 * (uu - vv)
        # the axes of a round footprint have no derivative: 1e-12 keeps it finite
        root = wp.sqrt(half * half + uv * uv + 1.0e-12 * (uu + vv) * (uu + vv))
        major = wp.sqrt(0.5 * (uu + vv) + root)
        minor = wp.abs(ux * vy - uy * vx) / major
        probe_width = wp.max(wp.max(minor, major / wp.static(MAX_PROBES + _REACH)), 1.0)
        count = wp.max(major / probe_width - wp.static(_REACH), 1.0)
        # eigenvector of the major axis, from the row in which nothing cancels
        along_u = wp.where(half > 0.0, root + half, uv)
        along_v = wp.where(half > 0.0, uv, root - half)
        step = probe_width / wp.sqrt(along_u * along_u + along_v * along_v)
        probes = wp.vec4(along_u * step / width, along_v * step / height, probe_width, count)
    return probes


@wp.kernel
def _find_footprints(
    # in
    face_ids: wp.array2d(dtype=wp.int32),
    barycentrics: wp.array2d(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    clip_positions: wp.array2d(dtype=wp.vec4),
    uv_faces: wp.array(dtype=wp.vec3i),
    uvs: wp.array2d(dtype=wp.vec2),
    texture_of_face: wp.array(dtype=wp.int32),
    levels: wp.array2d(dtype=wp.vec3i),
    image_width: int,
    image_height: int,
    batch_count: int,
    # out
    texture_ids: wp.array(dtype=wp.int32),
    sample_uvs: wp.array(dtype=wp.vec2),
    probes: wp.array(dtype=wp.vec4),
):
    """A thread owns a sample; uvs and probes are zero before."""
    thread = wp.tid()
    instance = _instance(thread, image_width * image_height, batch_count)
    sample = thread - instance * image_width * image_height
    fragment = wp.min(instance, face_ids.shape[0] - 1)
    face = face_ids[fragment, sample]
    texture = int(-1)
    if face >= 0:
        texture = texture_of_face[face]
    texture_ids[thread] = texture
    if texture >= 0:
        projected = wp.min(instance, clip_positions.shape[0] - 1)
        a = clip_positions[projected, faces[face][0]]
        b = clip_positions[projected, faces[face][1]]
        c = clip_positions[projected, faces[face][2]]
        mapped = wp.min(instance, uvs.shape[0] - 1)
        uv_a = uvs[mapped, uv_faces[face][0]]
        uv_b = uvs[mapped, uv_faces[face][1]]
        uv_c = uvs[mapped, uv_faces[face][2]]
        weights = barycentrics[fragment, sample]
        uv = weights[0] * uv_a + weights[1] * uv_b + weights[2] * uv_c
        row = sample // image_width
        pixel = wp.vec2(2.0 / float(image_width), 2.0 / float(image_height))
        ray = wp.vec2((float(sample - row * image_width) + 0.5) * pixel[0] - 1.0, (float(row) + 0.5) * pixel[1] - 1.0)
        derivatives = _uv_derivatives(a, b, c, uv_a - uv, uv_b - uv, uv_c - uv, ray, pixel)
        sample_uvs[thread] = uv
        probes[thread] = _probes(derivatives, float(levels[texture, 0][1]), float(levels[texture, 0][2]))


def find_footprints(
    fragments: Fragments,
    faces: wp.array,
    clip_positions: wp.array,
    uvs: wp.array,
    uv_faces: wp.array,
    texture_of_face: wp.array,
    textures: Textures,
) -> Footprints:
    """Find where each sample lies in its texture, and what it covers there.

    Footprints depend on the sizes of the textures, not on what is in them: where geometry and camera stand still,
    they are found once. A footprint is that of the sample's face, continued beyond its edges, so neither seams of
    the uvs nor occlusions disturb it.

    Args:
        fragments: What each sample sees.
        faces: Vertex indices, vec3i of shape [face].
        clip_positions: The rasterized vertices in clip space, vec4 of shape [batch, vertex].
        uvs: Texture coordinates, vec2 of shape [batch, uv].
        uv_faces: Indices of uvs, vec3i of shape [face]; those of a face without a texture are not read.
            Any batch may be 1 and then serves every instance.
        texture_of_face: Texture on each face, -1 for none, int32 of shape [face].
        textures: The textures.

    Returns:
        Footprints.

    Raises:
        ValueError: naming the argument, what it got and what it accepts.

    Differentiable: clip_positions, barycentrics of the fragments, uvs; the width and the direction of a footprint
    included, which matter: neglected, they were 1% to 15% of the gradient of a textured plane's pose.
    """
    check.shape("uv_faces", uv_faces.shape, faces.shape)
    check.shape("texture_of_face", texture_of_face.shape, faces.shape)
    check.finite_arrays({"uvs": uvs})
    variables = {"fragments": fragments.barycentrics, "clip_positions": clip_positions, "uvs": uvs}
    batch_count = common_batch(variables)
    _, height, width = fragments.face_ids.shape
    shape = batch_count, height, width
    device = fragments.face_ids.device
    requires_grad = any(array.requires_grad for array in variables.values())
    texture_ids = wp.empty(shape, dtype=wp.int32, device=device)
    sample_uvs = wp.zeros(shape, dtype=wp.vec2, device=device, requires_grad=requires_grad)
    probes = wp.zeros(shape, dtype=wp.vec4, device=device, requires_grad=requires_grad)
    launch(
        _find_footprints,
        dim=texture_ids.size,
        inputs=[
            rows(fragments.face_ids),
            rows(fragments.barycentrics),
            faces,
            clip_positions,
            uv_faces,
            uvs,
            texture_of_face,
            textures.levels,
            width,
            height,
            batch_count,
        ],
        outputs=[texture_ids.flatten(), sample_uvs.flatten(), probes.flatten()],
        device=device,
    )
    return Footprints(texture_ids, sample_uvs, probes)


# ---------------------------------------------------------------------------------------------------- reflectance


@wp.func
def _level_of(width: float, level_count: int):
    """Finer of the two levels that a probe blends, and the part of the coarser one.

    With the part width/2^level - 1 the mean width of their texels is that of the probe.
    """
    level = int(0)
    texel_width = float(1.0)
    while level < level_count - 1 and width >= 2.0 * texel_width:
        level += 1
        texel_width *= 2.0
    return level, wp.where(level < level_count - 1, width / texel_width - 1.0, 0.0)


@wp.func
def _reach(count: float):
    """Number of the outermost probe on either side."""
    return int(wp.ceil(0.5 * (count - 1.0)))


@wp.func
def _share(probe: int, count: float):
    """What a probe weighs of ``count``: the part of the line in its stretch, so outer ones fade in as it grows."""
    return wp.min(0.5 * (count + 1.0) - float(wp.abs(probe)), 1.0)


@wp.struct
class _Cell:
    """The four texels around a point of a level, and where it lies between them."""

    above_left: int
    above_right: int
    below_left: int
    below_right: int
    s: float
    t: float


@wp.func
def _place(level: wp.vec3i, uv: wp.vec2):
    """Where a uv lies in a level [texels], relative to the center of its first texel; it repeats outside of [0, 1]."""
    x = (uv[0] - wp.floor(uv[0])) * float(level[1]) - 0.5
    y = (1.0 - (uv[1] - wp.floor(uv[1]))) * float(level[2]) - 0.5
    return wp.vec2(x, y)


@wp.func
def _repeated(texel: int, count: int):
    """The texel among ``count`` that one outside of them repeats."""
    return (texel % count + count) % count


@wp.func
def _cell(level: wp.vec3i, x: float, y: float):
    """Find the texels around a place in a level, as `_place` has it or beside that."""
    cell = _Cell()
    cell.s = x - wp.floor(x)
    cell.t = y - wp.floor(y)
    left = int(wp.floor(x))
    top = int(wp.floor(y))
    right = left + 1
    bottom = top + 1
    if wp.min(left, top) < 0 or right >= level[1] or bottom >= level[2]:  # few do, and remainders take long
        left = _repeated(left, level[1])
        right = _repeated(right, level[1])
        top = _repeated(top, level[2])
        bottom = _repeated(bottom, level[2])
    above = level[0] + top * level[1]
    below = level[0] + bottom * level[1]
    cell.above_left = above + left
    cell.above_right = above + right
    cell.below_left = below + left
    cell.below_right = below + right
    return cell


@wp.func
def _filtered(texels: wp.array(dtype=wp.vec3), level: wp.vec3i, uv: wp.vec2, line: wp.vec4):
    """Mean of a level over the probes of a footprint, each bilinear between four texels."""
    place = _place(level, uv)
    reach = _reach(line[3])
    scale = 1.0 / line[3]
    color = wp.vec3()
    for probe in range(-reach, reach + 1):
        x = place[0] + float(probe) * line[0] * float(level[1])
        y = place[1] - float(probe) * line[1] * float(level[2])
        cell = _cell(level, x, y)
        share = scale * _share(probe, line[3])
        below = share * cell.t
        above = share - below
        color += (
            (above * (1.0 - cell.s)) * texels[cell.above_left]
            + (above * cell.s) * texels[cell.above_right]
            + (below * (1.0 - cell.s)) * texels[cell.below_left]
            + (below * cell.s) * texels[cell.below_right]
        )
    return color


@wp.func
def _scatter(adj_texels: wp.array(dtype=wp.vec3), level: wp.vec3i, uv: wp.vec2, line: wp.vec4, adj_color: wp.vec3):
    """Add to the gradients of a level's texels: the adjoint of `_filtered`, by what is filtered."""
    place = _place(level, uv)
    reach = _reach(line[3])
    adj_sum = (1.0 / line[3]) * adj_color
    for probe in range(-reach, reach + 1):
        x = place[0] + float(probe) * line[0] * float(level[1])
        y = place[1] - float(probe) * line[1] * float(level[2])
        cell = _cell(level, x, y)
        below = _share(probe, line[3]) * cell.t
        above = _share(probe, line[3]) - below
        wp.atomic_add(adj_texels, cell.above_left, (above * (1.0 - cell.s)) * adj_sum)
        wp.atomic_add(adj_texels, cell.above_right, (above * cell.s) * adj_sum)
        wp.atomic_add(adj_texels, cell.below_left, (below * (1.0 - cell.s)) * adj_sum)
        wp.atomic_add(adj_texels, cell.below_right, (below * cell.s) * adj_sum)


@wp.func
def _color(
    sample: int,
    face_ids: wp.array(dtype=wp.int32),
    barycentrics: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    vertex_albedo: wp.array(dtype=wp.vec3),
    texels: wp.array(dtype=wp.vec3),
    levels: wp.array2d(dtype=wp.vec3i),
    level_counts: wp.array(dtype=wp.int32),
    texture_ids: wp.array(dtype=wp.int32),
    uvs: wp.array(dtype=wp.vec2),
    probes: wp.array(dtype=wp.vec4),
):
    """What a sample reflects."""
    texture = texture_ids[sample]
    color = wp.vec3()
    if texture >= 0:
        line = probes[sample]
        level, coarse_part = _level_of(line[2], level_counts[texture])
        color = _filtered(texels, levels[texture, level], uvs[sample], line)
        if coarse_part > 0.0:
            coarse = _filtered(texels, levels[texture, level + 1], uvs[sample], line)
            color = (1.0 - coarse_part) * color + coarse_part * coarse
    else:
        face = face_ids[sample]
        if face >= 0:
            weights = barycentrics[sample]
            color = (
                weights[0] * vertex_albedo[faces[face][0]]
                + weights[1] * vertex_albedo[faces[face][1]]
                + weights[2] * vertex_albedo[faces[face][2]]
            )
    return color


@wp.func
def _color_adjoint(
    sample: int,
    face_ids: wp.array(dtype=wp.int32),
    barycentrics: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    levels: wp.array2d(dtype=wp.vec3i),
    level_counts: wp.array(dtype=wp.int32),
    texture_ids: wp.array(dtype=wp.int32),
    uvs: wp.array(dtype=wp.vec2),
    probes: wp.array(dtype=wp.vec4),
    instance: int,
    adj_color: wp.vec3,
    adj_vertex_albedo: wp.array2d(dtype=wp.vec3),
    adj_texels: wp.array2d(dtype=wp.vec3),
):
    """The adjoint of `_color` by what reflects."""
    texture = texture_ids[sample]
    if texture >= 0:
        if adj_texels:
            adj_of_instance = adj_texels[wp.min(instance, adj_texels.shape[0] - 1)]
            line = probes[sample]
            level, coarse_part = _level_of(line[2], level_counts[texture])
            _scatter(adj_of_instance, levels[texture, level], uvs[sample], line, (1.0 - coarse_part) * adj_color)
            if coarse_part > 0.0:
                _scatter(adj_of_instance, levels[texture, level + 1], uvs[sample], line, coarse_part * adj_color)
    elif adj_vertex_albedo:
        face = face_ids[sample]
        if face >= 0:
            row = wp.min(instance, adj_vertex_albedo.shape[0] - 1)
            weights = barycentrics[sample]
            for corner in range(3):
                wp.atomic_add(adj_vertex_albedo, row, faces[face][corner], weights[corner] * adj_color)


@wp.kernel(enable_backward=False)
def _sample(
    first_row: int,
    worker: int,
    # in
    face_ids: wp.array2d(dtype=wp.int32),
    barycentrics: wp.array2d(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    vertex_albedo: wp.array2d(dtype=wp.vec3),
    texels: wp.array2d(dtype=wp.vec3),
    levels: wp.array2d(dtype=wp.vec3i),
    level_counts: wp.array(dtype=wp.int32),
    texture_ids: wp.array2d(dtype=wp.int32),
    uvs: wp.array2d(dtype=wp.vec2),
    probes: wp.array2d(dtype=wp.vec4),
    run: int,
    # out
    albedo: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a run of samples."""
    instance, thread = split_row(first_row + wp.tid(), texture_ids.shape[1] // run)
    footprint = wp.min(instance, texture_ids.shape[0] - 1)
    fragment = wp.min(instance, face_ids.shape[0] - 1)
    of_vertices = vertex_albedo[wp.min(instance, vertex_albedo.shape[0] - 1)]
    of_instance = texels[wp.min(instance, texels.shape[0] - 1)]
    for sample in range(thread * run, (thread + 1) * run):
        albedo[instance, sample] = _color(
            sample,
            face_ids[fragment],
            barycentrics[fragment],
            faces,
            of_vertices,
            of_instance,
            levels,
            level_counts,
            texture_ids[footprint],
            uvs[footprint],
            probes[footprint],
        )


@wp.kernel(enable_backward=False)
def _expose(
    first_row: int,
    worker: int,
    # in
    face_ids: wp.array2d(dtype=wp.int32),
    barycentrics: wp.array2d(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    vertex_albedo: wp.array2d(dtype=wp.vec3),
    texels: wp.array2d(dtype=wp.vec3),
    levels: wp.array2d(dtype=wp.vec3i),
    level_counts: wp.array(dtype=wp.int32),
    texture_ids: wp.array2d(dtype=wp.int32),
    uvs: wp.array2d(dtype=wp.vec2),
    probes: wp.array2d(dtype=wp.vec4),
    run: int,
    white: wp.array2d(dtype=wp.vec4),
    # out
    samples: wp.array2d(dtype=wp.vec4),
):
    """A thread owns a run of samples."""
    instance, thread = split_row(first_row + wp.tid(), texture_ids.shape[1] // run)
    footprint = wp.min(instance, texture_ids.shape[0] - 1)
    fragment = wp.min(instance, face_ids.shape[0] - 1)
    of_vertices = vertex_albedo[wp.min(instance, vertex_albedo.shape[0] - 1)]
    of_instance = texels[wp.min(instance, texels.shape[0] - 1)]
    lit = wp.min(instance, white.shape[0] - 1)
    for sample in range(thread * run, (thread + 1) * run):
        color = _color(
            sample,
            face_ids[fragment],
            barycentrics[fragment],
            faces,
            of_vertices,
            of_instance,
            levels,
            level_counts,
            texture_ids[footprint],
            uvs[footprint],
            probes[footprint],
        )
        samples[instance, sample] = wp.cw_mul(white[lit, sample], wp.vec4(color[0], color[1], color[2], 1.0))


@wp.kernel(enable_backward=False)
def _sample_adjoint_by_albedo(
    # in
    face_ids: wp.array2d(dtype=wp.int32),
    barycentrics: wp.array2d(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    levels: wp.array2d(dtype=wp.vec3i),
    level_counts: wp.array(dtype=wp.int32),
    texture_ids: wp.array2d(dtype=wp.int32),
    uvs: wp.array2d(dtype=wp.vec2),
    probes: wp.array2d(dtype=wp.vec4),
    run: int,
    adj_albedo: wp.array2d(dtype=wp.vec3),
    # out
    adj_vertex_albedo: wp.array2d(dtype=wp.vec3),
    adj_texels: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a run of samples: the adjoint of `_sample` by what reflects."""
    instance, thread = wp.tid()
    footprint = wp.min(instance, texture_ids.shape[0] - 1)
    fragment = wp.min(instance, face_ids.shape[0] - 1)
    for sample in range(thread * run, (thread + 1) * run):
        _color_adjoint(
            sample,
            face_ids[fragment],
            barycentrics[fragment],
            faces,
            levels,
            level_counts,
            texture_ids[footprint],
            uvs[footprint],
            probes[footprint],
            instance,
            adj_albedo[instance, sample],
            adj_vertex_albedo,
            adj_texels,
        )


@wp.kernel(enable_backward=False)
def _expose_adjoint(
    # in
    face_ids: wp.array2d(dtype=wp.int32),
    barycentrics: wp.array2d(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    levels: wp.array2d(dtype=wp.vec3i),
    level_counts: wp.array(dtype=wp.int32),
    texture_ids: wp.array2d(dtype=wp.int32),
    uvs: wp.array2d(dtype=wp.vec2),
    probes: wp.array2d(dtype=wp.vec4),
    run: int,
    white: wp.array2d(dtype=wp.vec4),
    adj_samples: wp.array2d(dtype=wp.vec4),
    # out
    adj_vertex_albedo: wp.array2d(dtype=wp.vec3),
    adj_texels: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a run of samples: the adjoint of `_expose` by what reflects."""
    instance, thread = wp.tid()
    footprint = wp.min(instance, texture_ids.shape[0] - 1)
    fragment = wp.min(instance, face_ids.shape[0] - 1)
    lit = wp.min(instance, white.shape[0] - 1)
    for sample in range(thread * run, (thread + 1) * run):
        adj_color = wp.cw_mul(white[lit, sample], adj_samples[instance, sample])
        _color_adjoint(
            sample,
            face_ids[fragment],
            barycentrics[fragment],
            faces,
            levels,
            level_counts,
            texture_ids[footprint],
            uvs[footprint],
            probes[footprint],
            instance,
            wp.vec3(adj_color[0], adj_color[1], adj_color[2]),
            adj_vertex_albedo,
            adj_texels,
        )


@wp.func
def _slopes(texels: wp.array(dtype=wp.vec3), level: wp.vec3i, uv: wp.vec2, step: wp.vec2, adj_color: wp.vec3):
    """Derivatives of a level's color by u and v, a step from a uv, and the color itself, each times ``adj_color``."""
    place = _place(level, uv)
    cell = _cell(level, place[0] + step[0] * float(level[1]), place[1] - step[1] * float(level[2]))
    above_left = wp.dot(texels[cell.above_left], adj_color)
    above_right = wp.dot(texels[cell.above_right], adj_color)
    below_left = wp.dot(texels[cell.below_left], adj_color)
    below_right = wp.dot(texels[cell.below_right], adj_color)
    above = (1.0 - cell.s) * above_left + cell.s * above_right
    below = (1.0 - cell.s) * below_left + cell.s * below_right
    across = (1.0 - cell.t) * (above_right - above_left) + cell.t * (below_right - below_left)
    return wp.vec3(across * float(level[1]), (above - below) * float(level[2]), (1.0 - cell.t) * above + cell.t * below)


@wp.kernel(enable_backward=False)
def _sample_adjoint_by_place(
    # in
    face_ids: wp.array2d(dtype=wp.int32),
    faces: wp.array(dtype=wp.vec3i),
    vertex_albedo: wp.array2d(dtype=wp.vec3),
    texels: wp.array2d(dtype=wp.vec3),
    levels: wp.array2d(dtype=wp.vec3i),
    level_counts: wp.array(dtype=wp.int32),
    texture_ids: wp.array2d(dtype=wp.int32),
    uvs: wp.array2d(dtype=wp.vec2),
    probes: wp.array2d(dtype=wp.vec4),
    run: int,
    adj_albedo: wp.array2d(dtype=wp.vec3),
    # out
    adj_barycentrics: wp.array2d(dtype=wp.vec3),
    adj_uvs: wp.array2d(dtype=wp.vec2),
    adj_probes: wp.array2d(dtype=wp.vec4),
):
    """A thread owns a run of samples: the adjoint of `_sample` by where on their faces, and how wide, they are."""
    instance, thread = wp.tid()
    footprint = wp.min(instance, texture_ids.shape[0] - 1)
    for sample in range(thread * run, (thread + 1) * run):
        texture = texture_ids[footprint, sample]
        adj_color = adj_albedo[instance, sample]
        if texture >= 0:
            of_instance = texels[wp.min(instance, texels.shape[0] - 1)]
            line = probes[footprint, sample]
            count = line[3]
            level, coarse_part = _level_of(line[2], level_counts[texture])
            reach = _reach(count)
            adj_u = float(0.0)
            adj_v = float(0.0)
            adj_line = wp.vec4()
            for probe in range(-reach, reach + 1):
                uv = uvs[footprint, sample]
                step = float(probe) * wp.vec2(line[0], line[1])
                weight = _share(probe, count) / count
                slopes = _slopes(of_instance, levels[texture, level], uv, step, adj_color)
                adj_width = float(0.0)
                if coarse_part > 0.0:
                    coarse = _slopes(of_instance, levels[texture, level + 1], uv, step, adj_color)
                    adj_width = weight * (coarse[2] - slopes[2]) / float(1 << level)
                    slopes += coarse_part * (coarse - slopes)
                # as the line grows, the outermost probes gain half a width each, and all share a longer line
                adj_count = -weight * slopes[2] / count
                if wp.abs(probe) == reach:
                    adj_count += 0.5 * slopes[2] / count
                adj_u += weight * slopes[0]
                adj_v += weight * slopes[1]
                along = float(probe) * weight
                adj_line += wp.vec4(along * slopes[0], along * slopes[1], adj_width, adj_count)
            if adj_uvs:
                wp.atomic_add(adj_uvs, footprint, sample, wp.vec2(adj_u, adj_v))
            if adj_probes:
                if reach == 0:
                    adj_line[3] = 0.0
                wp.atomic_add(adj_probes, footprint, sample, adj_line)
        elif adj_barycentrics:
            fragment = wp.min(instance, face_ids.shape[0] - 1)
            face = face_ids[fragment, sample]
            if face >= 0:
                row = wp.min(instance, vertex_albedo.shape[0] - 1)
                adj_weights = wp.vec3()
                for corner in range(3):
                    adj_weights[corner] = wp.dot(vertex_albedo[row, faces[face][corner]], adj_color)
                wp.atomic_add(adj_barycentrics, fragment, sample, adj_weights)


def sample_albedo(
    fragments: Fragments, faces: wp.array, vertex_albedo: wp.array, textures: Textures, footprints: Footprints
) -> wp.array:
    """Find the reflectance that each sample sees: that of its texture, or of the vertices where there is none.

    It is a continuous function of the footprint: levels blend, and probes fade in at the ends of their line.

    Args:
        fragments: What each sample sees.
        faces: Vertex indices, vec3i of shape [face].
        vertex_albedo: Reflectance of the vertices, vec3 of shape [batch, vertex]; not seen on textured faces.
        textures: The textures.
        footprints: Of the samples, from :func:`find_footprints` with textures of these sizes.
            Any batch may be 1 and then serves every instance.

    Returns:
        Reflectance, linear RGB, vec3 of shape [batch, height, width], zero where there is no face.

    Raises:
        ValueError: naming the argument, what it got and what it accepts.

    Differentiable: textures, footprints, vertex_albedo, barycentrics of the fragments.
    """
    arrays = {"fragments": fragments.barycentrics, "vertex_albedo": vertex_albedo, "textures": textures.texels}
    _check_samples(arrays, fragments, footprints)
    reflecting = [vertex_albedo, textures.texels]
    placed = [fragments.barycentrics, footprints.uvs, footprints.probes]
    albedo = wp.empty(
        (common_batch(arrays | {"footprints": footprints.uvs}), *fragments.face_ids.shape[1:]),
        dtype=wp.vec3,
        device=vertex_albedo.device,
        requires_grad=any(array.requires_grad for array in [*reflecting, *placed]),
    )
    seen, dim, flat = _seen(textures, footprints), _threads(albedo), rows(albedo)
    _launch_samples(_sample, dim, [*fragments.rows, faces, *reflecting, *seen], flat)

    def adjoint() -> None:
        if any(array.requires_grad for array in reflecting):
            inputs = [*fragments.rows, faces, *seen, flat.grad]
            _launch(_sample_adjoint_by_albedo, dim, inputs, [array.grad for array in reflecting])
        if any(array.requires_grad for array in placed):
            inputs = [fragments.rows[0], faces, *reflecting, *seen, flat.grad]
            _launch(_sample_adjoint_by_place, dim, inputs, [rows(array.grad) for array in placed])

    record_adjoint(adjoint, [*reflecting, *placed, albedo])
    return albedo


def expose_albedo(
    fragments: Fragments,
    faces: wp.array,
    vertex_albedo: wp.array,
    textures: Textures,
    footprints: Footprints,
    white: wp.array,
) -> wp.array:
    """Expose samples as it is found what they reflect, where all else stands still.

    It is :func:`sample_albedo` and :func:`warpshadow.film.expose` in one: neither albedo nor its gradient is written.

    Args:
        fragments, faces, vertex_albedo, textures, footprints: As for :func:`sample_albedo`.
        white: The samples if every surface were white, of :func:`warpshadow.film.expose`, vec4 of shape
            [batch, height, width]; a batch of 1 serves every instance.

    Returns:
        Linear RGB and coverage, 1 or 0, vec4 of shape [batch, height, width].

    Raises:
        ValueError: naming the argument, what it got and what it accepts.

    Differentiable: textures, vertex_albedo. Not: fragments, footprints, white.
    """
    arrays = {"fragments": fragments.face_ids, "vertex_albedo": vertex_albedo, "textures": textures.texels}
    _check_samples(arrays, fragments, footprints)
    check.shape("white", white.shape, ("batch", *fragments.face_ids.shape[1:]))
    reflecting = [vertex_albedo, textures.texels]
    samples = wp.empty(
        (common_batch(arrays | {"footprints": footprints.uvs, "white": white}), *white.shape[1:]),
        dtype=wp.vec4,
        device=vertex_albedo.device,
        requires_grad=any(array.requires_grad for array in reflecting),
    )
    seen, dim, flat = [*_seen(textures, footprints), rows(white)], _threads(samples), rows(samples)
    _launch_samples(_expose, dim, [*fragments.rows, faces, *reflecting, *seen], flat)

    def adjoint() -> None:
        inputs = [*fragments.rows, faces, *seen, flat.grad]
        _launch(_expose_adjoint, dim, inputs, [array.grad for array in reflecting])

    record_adjoint(adjoint, [*reflecting, samples])
    return samples


def _check_samples(arrays: dict[str, wp.array], fragments: Fragments, footprints: Footprints) -> None:
    check.shape("vertex_albedo", arrays["vertex_albedo"].shape, ("batch", "vertex"))
    check.shape("footprints", footprints.uvs.shape, ("batch", *fragments.face_ids.shape[1:]))


def _threads(samples: wp.array) -> tuple[int, int]:
    """Instances and the runs of samples of each."""
    batch_count, height, width = samples.shape
    return batch_count, height * width // run_length(samples.device, width)


def _launch_samples(kernel: wp.Kernel, dim: tuple[int, int], inputs: list, samples: wp.array) -> None:
    """Launch for all samples [batch, sample]."""
    cost = _SAMPLE_COST * samples.shape[1] / dim[1]
    launch_slices(kernel, [dim[0] * dim[1]], cost=cost, inputs=inputs, outputs=[samples], device=samples.device)


def _seen(textures: Textures, footprints: Footprints) -> list:
    """What kernels take of textures, but for the texels, and of footprints; and how many samples a thread owns."""
    run = run_length(footprints.uvs.device, footprints.uvs.shape[2])
    return [textures.levels, textures.level_counts, *footprints.rows, run]


# ---------------------------------------------------------------------------------------------------- export


def seen_texels(textures: Textures, footprints: Footprints) -> list[np.ndarray]:
    """Sum what each texel weighs in the samples of all images that see it.

    Args:
        textures: The textures; what is in them does not matter.
        footprints: Of the samples, from :func:`find_footprints`.

    Returns:
        For each texture the weights of its texels, float32 of shape [batch, height, width]: 0 where none sees the
        texel, and small where it is only seen as a part of a coarser level.

    Raises:
        ValueError: naming the argument, what it got and what it accepts.
    """
    device = footprints.uvs.device
    layout = _layout(textures.sizes, str(device))
    batch_count = common_batch({"textures": textures.texels, "footprints": footprints.uvs})
    weights = wp.zeros(textures.texels.shape, dtype=wp.vec3, device=device)
    ones = wp.ones((batch_count, *footprints.uvs.shape[1:]), dtype=wp.vec3, device=device)
    inputs = [None, None, None, *_seen(textures, footprints), rows(ones)]
    _launch(_sample_adjoint_by_albedo, _threads(ones), inputs, [None, weights])
    images = [wp.zeros((weights.shape[0], *size), dtype=wp.vec3, device=device) for size in textures.sizes]
    for number, image in enumerate(images):
        _add_to_image(image, weights, layout, number, footprints.coarsest_level())
    return [image.numpy()[..., 0].copy() for image in images]


def fill_unseen(texture: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Give texels that were never seen the color of the nearest one that was, so that seams do not bleed.

    Args:
        texture: Linear RGB, shape [height, width, 3].
        weights: What each texel weighs in the images (:func:`seen_texels`), shape [height, width].

    Returns:
        The texture, filled, shape [height, width, 3]; unchanged where no texel was seen.

    Raises:
        ValueError: naming the argument, what it got and what it accepts.
    """
    from scipy.ndimage import distance_transform_edt

    check.shape("texture", texture.shape, ("height", "width", 3))
    check.shape("weights", weights.shape, texture.shape[:2])
    if not weights.any():
        return texture.copy()
    row, column = distance_transform_edt(weights == 0, return_distances=False, return_indices=True)
    return texture[row, column]
