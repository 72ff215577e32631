"""Samples of textures: the mean over a footprint, and its adjoint."""

import numpy as np
import warp as wp

from warpshadow import check
from warpshadow.device.batch import common_batch, rows
from warpshadow.device.parallel import launch_slices, split_row
from warpshadow.device.tape import record_adjoint
from warpshadow.stages.rasterize import Fragments, run_length
from warpshadow.stages.textures.footprint import Footprints
from warpshadow.stages.textures.pyramid import Textures, _add_to_image, _launch, _layout

_SAMPLE_COST = 10.0
"""Nanoseconds that a sample takes."""

# A probe reaches beyond its width, so a line of n probes may be this many widths longer than n widths. Of 0 to 1, a
# quarter was nearest to the mean over the footprint, for noise, natural spectra and checkerboards.


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

    It is :func:`sample_albedo` and :func:`warpshadow.stages.film.expose` in one: neither albedo nor its gradient is
    written.

    Args:
        fragments, faces, vertex_albedo, textures, footprints: As for :func:`sample_albedo`.
        white: The samples if every surface were white, of :func:`warpshadow.stages.film.expose`, vec4 of shape
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
