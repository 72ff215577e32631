"""Samples of textures: the mean over a footprint, and its adjoint.

A probe is bilinear in two mip levels, blended so that their mean texel is as wide as the minor axis of the footprint.
Each texel in view gets its share of the gradient: a texture that is fitted has no holes. Where a texel is larger than
the footprint, one probe of the finest level is left, which is bilinear interpolation.
"""

import math
from collections.abc import Sequence

import warp as wp

from warpshadow import check
from warpshadow.device.batch import common_batch, instance_in, rows
from warpshadow.device.launch import any_requires_grad, differentiable, launch
from warpshadow.device.memory import empty
from warpshadow.device.parallel import run_length, split_row
from warpshadow.stages.raster.interpolation import (
    interpolate_at,
    interpolate_values_adjoint,
    interpolate_weights_adjoint,
)
from warpshadow.stages.raster.rasterization import Fragments
from warpshadow.stages.textures.footprint import Footprints
from warpshadow.stages.textures.pyramid import Textures

_COST = 10.0  # nanoseconds that a sample takes


@wp.struct
class _SampleInputs:
    """The faces and the parts of textures that samples see, all but their colors."""

    face_ids: wp.array2d(dtype=wp.int32)
    barycentrics: wp.array2d(dtype=wp.vec3)
    faces: wp.array(dtype=wp.vec3i)
    levels: wp.array2d(dtype=wp.vec3i)
    level_counts: wp.array(dtype=wp.int32)
    texture_ids: wp.array2d(dtype=wp.int32)
    uvs: wp.array2d(dtype=wp.vec2)
    probes: wp.array2d(dtype=wp.vec4)
    run: int  # samples that a thread owns


# ---------------------------------------------------------------------------------------------------- colors


@wp.func
def _split_level(width: float, level_count: int):
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
def _line_reach(count: float):
    """Number of probes on either side of the middle one."""
    return int(wp.ceil(0.5 * (count - 1.0)))


@wp.func
def _find_probe_weight(probe: int, count: float):
    """Weight of a probe among ``count``: its share of the line, so that outer probes fade in as the line grows."""
    return wp.min(0.5 * (count + 1.0) - float(wp.abs(probe)), 1.0)


@wp.struct
class _Cell:
    """The four texels around a point of a level, and its position between them."""

    above_left: int
    above_right: int
    below_left: int
    below_right: int
    s: float
    t: float


@wp.func
def _texel_position(level: wp.vec3i, uv: wp.vec2):
    """Position in a level [texels] of a uv, which repeats outside [0, 1]; relative to the center of the first texel."""
    x = (uv[0] - wp.floor(uv[0])) * float(level[1]) - 0.5
    y = (1.0 - (uv[1] - wp.floor(uv[1]))) * float(level[2]) - 0.5
    return wp.vec2(x, y)


@wp.func
def _repeated(texel: int, count: int):
    """Index among ``count`` texels of one that may lie outside: texels repeat."""
    return (texel % count + count) % count


@wp.func
def _cell(level: wp.vec3i, x: float, y: float):
    """Find the texels around a position in a level, the level of `_texel_position` or one beside it."""
    cell = _Cell()
    cell.s = x - wp.floor(x)
    cell.t = y - wp.floor(y)
    left_column = int(wp.floor(x))
    top = int(wp.floor(y))
    right_column = left_column + 1
    bottom = top + 1
    # few do, and remainders take long
    if wp.min(left_column, top) < 0 or right_column >= level[1] or bottom >= level[2]:
        left_column = _repeated(left_column, level[1])
        right_column = _repeated(right_column, level[1])
        top = _repeated(top, level[2])
        bottom = _repeated(bottom, level[2])
    upper_row = level[0] + top * level[1]
    lower_row = level[0] + bottom * level[1]
    cell.above_left = upper_row + left_column
    cell.above_right = upper_row + right_column
    cell.below_left = lower_row + left_column
    cell.below_right = lower_row + right_column
    return cell


@wp.func
def _filter_line(texels: wp.array(dtype=wp.vec3), level: wp.vec3i, uv: wp.vec2, probe_line: wp.vec4):
    """Mean of a level over the probes of a footprint, each bilinear between four texels."""
    texel_position = _texel_position(level, uv)
    line_reach = _line_reach(probe_line[3])
    scale = 1.0 / probe_line[3]
    color = wp.vec3()
    for probe in range(-line_reach, line_reach + 1):
        x = texel_position[0] + float(probe) * probe_line[0] * float(level[1])
        y = texel_position[1] - float(probe) * probe_line[1] * float(level[2])
        cell = _cell(level, x, y)
        probe_weight = scale * _find_probe_weight(probe, probe_line[3])
        lower_weight = probe_weight * cell.t
        upper_weight = probe_weight - lower_weight
        color += (
            (upper_weight * (1.0 - cell.s)) * texels[cell.above_left]
            + (upper_weight * cell.s) * texels[cell.above_right]
            + (lower_weight * (1.0 - cell.s)) * texels[cell.below_left]
            + (lower_weight * cell.s) * texels[cell.below_right]
        )
    return color


@wp.func
def interpolate_uv(texels: wp.array(dtype=wp.vec3), level: wp.vec3i, uv: wp.vec2):
    """A level at a point, bilinear between four texels."""
    return _filter_line(texels, level, uv, wp.vec4(0.0, 0.0, 0.0, 1.0))


@wp.func
def _scatter(
    adj_texels: wp.array(dtype=wp.vec3), level: wp.vec3i, uv: wp.vec2, probe_line: wp.vec4, adj_color: wp.vec3
):
    """Add to the gradients of a level's texels: the adjoint of `_filter_line`, by its value."""
    texel_position = _texel_position(level, uv)
    line_reach = _line_reach(probe_line[3])
    adj_sum = (1.0 / probe_line[3]) * adj_color
    for probe in range(-line_reach, line_reach + 1):
        x = texel_position[0] + float(probe) * probe_line[0] * float(level[1])
        y = texel_position[1] - float(probe) * probe_line[1] * float(level[2])
        cell = _cell(level, x, y)
        lower_weight = _find_probe_weight(probe, probe_line[3]) * cell.t
        upper_weight = _find_probe_weight(probe, probe_line[3]) - lower_weight
        wp.atomic_add(adj_texels, cell.above_left, (upper_weight * (1.0 - cell.s)) * adj_sum)
        wp.atomic_add(adj_texels, cell.above_right, (upper_weight * cell.s) * adj_sum)
        wp.atomic_add(adj_texels, cell.below_left, (lower_weight * (1.0 - cell.s)) * adj_sum)
        wp.atomic_add(adj_texels, cell.below_right, (lower_weight * cell.s) * adj_sum)


@wp.func
def _color(
    sample_inputs: _SampleInputs,
    instance: int,
    sample: int,
    vertex_albedo: wp.array(dtype=wp.vec3),
    texels: wp.array(dtype=wp.vec3),
):
    """Reflectance of a sample of an instance."""
    footprint_batch = instance_in(instance, sample_inputs.texture_ids.shape[0])
    texture = sample_inputs.texture_ids[footprint_batch, sample]
    color = wp.vec3()
    if texture >= 0:
        probe_line = sample_inputs.probes[footprint_batch, sample]
        uv = sample_inputs.uvs[footprint_batch, sample]
        level, coarse_share = _split_level(probe_line[2], sample_inputs.level_counts[texture])
        color = _filter_line(texels, sample_inputs.levels[texture, level], uv, probe_line)
        if coarse_share > 0.0:
            coarse = _filter_line(texels, sample_inputs.levels[texture, level + 1], uv, probe_line)
            color = (1.0 - coarse_share) * color + coarse_share * coarse
    else:
        fragment_batch = instance_in(instance, sample_inputs.face_ids.shape[0])
        face = sample_inputs.face_ids[fragment_batch, sample]
        if face >= 0:
            color = interpolate_at(
                vertex_albedo, sample_inputs.faces[face], sample_inputs.barycentrics[fragment_batch, sample]
            )
    return color


@wp.kernel(enable_backward=False)
def _sample(
    first_row: int,
    worker: int,
    # in
    sample_inputs: _SampleInputs,
    vertex_albedo: wp.array2d(dtype=wp.vec3),
    texels: wp.array2d(dtype=wp.vec3),
    white: wp.array2d(dtype=wp.vec4),
    # out
    albedo: wp.array2d(dtype=wp.vec3),
    radiance: wp.array2d(dtype=wp.vec4),
):
    """A thread owns a run of samples: their reflectance or, if samples of white surfaces are given, their radiance."""
    instance, thread = split_row(first_row + wp.tid(), sample_inputs.texture_ids.shape[1] // sample_inputs.run)
    instance_albedo = vertex_albedo[instance_in(instance, vertex_albedo.shape[0])]
    instance_texels = texels[instance_in(instance, texels.shape[0])]
    for sample in range(thread * sample_inputs.run, (thread + 1) * sample_inputs.run):
        color = _color(sample_inputs, instance, sample, instance_albedo, instance_texels)
        if radiance:
            light = white[instance_in(instance, white.shape[0]), sample]
            radiance[instance, sample] = wp.cw_mul(light, wp.vec4(color[0], color[1], color[2], 1.0))
        else:
            albedo[instance, sample] = color


@wp.kernel(enable_backward=False)
def _sample_adjoint_by_colors(
    # in
    sample_inputs: _SampleInputs,
    white: wp.array2d(dtype=wp.vec4),
    adj_albedo: wp.array2d(dtype=wp.vec3),
    adj_radiance: wp.array2d(dtype=wp.vec4),
    # out
    adj_vertex_albedo: wp.array2d(dtype=wp.vec3),
    adj_texels: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a run of samples: the adjoint of `_sample` by the reflectance."""
    instance, thread = wp.tid()
    footprint_batch = instance_in(instance, sample_inputs.texture_ids.shape[0])
    fragment_batch = instance_in(instance, sample_inputs.face_ids.shape[0])
    for sample in range(thread * sample_inputs.run, (thread + 1) * sample_inputs.run):
        adj_color = wp.vec3()
        if adj_radiance:
            light = white[instance_in(instance, white.shape[0]), sample]
            adj_color_and_alpha = wp.cw_mul(light, adj_radiance[instance, sample])
            adj_color = wp.vec3(adj_color_and_alpha[0], adj_color_and_alpha[1], adj_color_and_alpha[2])
        else:
            adj_color = adj_albedo[instance, sample]
        texture = sample_inputs.texture_ids[footprint_batch, sample]
        if texture >= 0:
            if adj_texels:
                adj_of_textures = adj_texels[instance_in(instance, adj_texels.shape[0])]
                probe_line = sample_inputs.probes[footprint_batch, sample]
                uv = sample_inputs.uvs[footprint_batch, sample]
                level, coarse_share = _split_level(probe_line[2], sample_inputs.level_counts[texture])
                fine_color = (1.0 - coarse_share) * adj_color
                _scatter(adj_of_textures, sample_inputs.levels[texture, level], uv, probe_line, fine_color)
                if coarse_share > 0.0:
                    _scatter(
                        adj_of_textures,
                        sample_inputs.levels[texture, level + 1],
                        uv,
                        probe_line,
                        coarse_share * adj_color,
                    )
        elif adj_vertex_albedo:
            face = sample_inputs.face_ids[fragment_batch, sample]
            if face >= 0:
                adj_instance_albedo = adj_vertex_albedo[instance_in(instance, adj_vertex_albedo.shape[0])]
                weights = sample_inputs.barycentrics[fragment_batch, sample]
                interpolate_values_adjoint(adj_instance_albedo, sample_inputs.faces[face], weights, adj_color)


@wp.func
def _slopes(texels: wp.array(dtype=wp.vec3), level: wp.vec3i, uv: wp.vec2, step: wp.vec2, adj_color: wp.vec3):
    """Derivatives of a level's color by u and v, a step from a uv, and the color itself, each times ``adj_color``."""
    texel_position = _texel_position(level, uv)
    cell = _cell(level, texel_position[0] + step[0] * float(level[1]), texel_position[1] - step[1] * float(level[2]))
    above_left = wp.dot(texels[cell.above_left], adj_color)
    above_right = wp.dot(texels[cell.above_right], adj_color)
    below_left = wp.dot(texels[cell.below_left], adj_color)
    below_right = wp.dot(texels[cell.below_right], adj_color)
    upper_color = (1.0 - cell.s) * above_left + cell.s * above_right
    lower_color = (1.0 - cell.s) * below_left + cell.s * below_right
    slope_s = (1.0 - cell.t) * (above_right - above_left) + cell.t * (below_right - below_left)
    return wp.vec3(
        slope_s * float(level[1]),
        (upper_color - lower_color) * float(level[2]),
        (1.0 - cell.t) * upper_color + cell.t * lower_color,
    )


@wp.kernel(enable_backward=False)
def _sample_adjoint_by_coordinates(
    # in
    sample_inputs: _SampleInputs,
    vertex_albedo: wp.array2d(dtype=wp.vec3),
    texels: wp.array2d(dtype=wp.vec3),
    adj_albedo: wp.array2d(dtype=wp.vec3),
    # out
    adj_barycentrics: wp.array2d(dtype=wp.vec3),
    adj_uvs: wp.array2d(dtype=wp.vec2),
    adj_probes: wp.array2d(dtype=wp.vec4),
):
    """A thread owns a run of samples: the adjoint of `_sample` by where on their faces, and how wide, they are."""
    instance, thread = wp.tid()
    footprint_batch = instance_in(instance, sample_inputs.texture_ids.shape[0])
    instance_texels = texels[instance_in(instance, texels.shape[0])]
    for sample in range(thread * sample_inputs.run, (thread + 1) * sample_inputs.run):
        texture = sample_inputs.texture_ids[footprint_batch, sample]
        adj_color = adj_albedo[instance, sample]
        if texture >= 0:
            probe_line = sample_inputs.probes[footprint_batch, sample]
            count = probe_line[3]
            level, coarse_share = _split_level(probe_line[2], sample_inputs.level_counts[texture])
            line_reach = _line_reach(count)
            adj_u = float(0.0)
            adj_v = float(0.0)
            adj_line = wp.vec4()
            for probe in range(-line_reach, line_reach + 1):
                uv = sample_inputs.uvs[footprint_batch, sample]
                step = float(probe) * wp.vec2(probe_line[0], probe_line[1])
                weight = _find_probe_weight(probe, count) / count
                slopes = _slopes(instance_texels, sample_inputs.levels[texture, level], uv, step, adj_color)
                adj_width = float(0.0)
                if coarse_share > 0.0:
                    coarse = _slopes(instance_texels, sample_inputs.levels[texture, level + 1], uv, step, adj_color)
                    adj_width = weight * (coarse[2] - slopes[2]) / float(1 << level)
                    slopes += coarse_share * (coarse - slopes)
                # as the line grows, the outermost probes gain half a width each, and all share a longer line
                adj_count = -weight * slopes[2] / count
                if wp.abs(probe) == line_reach:
                    adj_count += 0.5 * slopes[2] / count
                adj_u += weight * slopes[0]
                adj_v += weight * slopes[1]
                weighted_probe = float(probe) * weight
                adj_line += wp.vec4(weighted_probe * slopes[0], weighted_probe * slopes[1], adj_width, adj_count)
            if adj_uvs:
                wp.atomic_add(adj_uvs, footprint_batch, sample, wp.vec2(adj_u, adj_v))
            if adj_probes:
                if line_reach == 0:
                    adj_line[3] = 0.0
                wp.atomic_add(adj_probes, footprint_batch, sample, adj_line)
        elif adj_barycentrics:
            fragment_batch = instance_in(instance, sample_inputs.face_ids.shape[0])
            face = sample_inputs.face_ids[fragment_batch, sample]
            if face >= 0:
                instance_albedo = vertex_albedo[instance_in(instance, vertex_albedo.shape[0])]
                adj_weights = interpolate_weights_adjoint(instance_albedo, sample_inputs.faces[face], adj_color)
                wp.atomic_add(adj_barycentrics, fragment_batch, sample, adj_weights)


def sample_albedo(
    fragments: Fragments, faces: wp.array, vertex_albedo: wp.array, textures: Textures, footprints: Footprints
) -> wp.array:
    """Find the reflectance that each sample sees: of its texture, or of the vertices where there is none.

    It is a continuous function of the footprint: levels blend, and probes fade in at the ends of their line.

    Args:
        faces: Vertex indices, vec3i of shape [face].
        vertex_albedo: Reflectance of the vertices, vec3 of shape [batch, vertex]; not seen on textured faces.
        footprints: Of the samples, from :func:`warpshadow.stages.textures.footprint.find_footprints`, with textures of
            these sizes. Any batch may be 1 and then serves every instance.
    Returns:
        Reflectance, linear RGB, vec3 of shape [batch, height, width], zero where there is no face.
    Differentiable: textures, footprints, vertex_albedo, barycentrics of the fragments.
    """
    arrays = {"fragments": fragments.barycentrics, "vertex_albedo": vertex_albedo, "textures": textures.texels}
    shape = _checked_shape(arrays, fragments, footprints)
    colors, coordinates = [vertex_albedo, textures.texels], [fragments.barycentrics, footprints.uvs, footprints.probes]
    sample_inputs = _make_sample_inputs(textures, footprints, fragments, faces)

    def adjoint(adj_albedo: wp.array) -> None:
        if any_requires_grad(colors):
            inputs = [sample_inputs, None, rows(adj_albedo), None]
            outputs = [array.grad for array in colors]
            launch(_sample_adjoint_by_colors, _runs(adj_albedo), inputs=inputs, outputs=outputs)
        if any_requires_grad(coordinates):
            inputs = [sample_inputs, *colors, rows(adj_albedo)]
            outputs = [rows(array.grad) for array in coordinates]
            launch(_sample_adjoint_by_coordinates, _runs(adj_albedo), inputs=inputs, outputs=outputs)

    return differentiable(
        lambda albedo: _launch_sample([sample_inputs, *colors, None], albedo, [rows(albedo), None]),
        adjoint,
        result=empty(shape, dtype=wp.vec3, device=faces.device),
        variables=[*colors, *coordinates],
    )


def textured_radiance(
    fragments: Fragments,
    faces: wp.array,
    vertex_albedo: wp.array,
    textures: Textures,
    footprints: Footprints,
    white: wp.array,
) -> wp.array:
    """Radiance of samples whose reflectance is sampled here, where all else is cached.

    It is :func:`sample_albedo` and :func:`warpshadow.stages.image.film.sample_radiance` in one: neither albedo nor its
    gradient is written.

    Args:
        fragments, faces, vertex_albedo, textures, footprints: As for :func:`sample_albedo`.
        white: The samples if every surface were white, of :func:`warpshadow.stages.image.film.sample_radiance`, vec4 of
            shape [batch, height, width]; a batch of 1 serves every instance.
    Returns:
        Linear RGB and coverage, 1 or 0, vec4 of shape [batch, height, width].
    Differentiable: textures, vertex_albedo. Not: fragments, footprints, white.
    """
    check.shape("white", white.shape, ("batch", *fragments.face_ids.shape[1:]))
    arrays = {"fragments": fragments.face_ids, "vertex_albedo": vertex_albedo, "textures": textures.texels}
    shape = _checked_shape(arrays | {"white": white}, fragments, footprints)
    colors = [vertex_albedo, textures.texels]
    sample_inputs = _make_sample_inputs(textures, footprints, fragments, faces)
    return differentiable(
        lambda radiance: _launch_sample([sample_inputs, *colors, rows(white)], radiance, [None, rows(radiance)]),
        lambda adj_radiance: launch(
            _sample_adjoint_by_colors,
            _runs(adj_radiance),
            inputs=[sample_inputs, rows(white), None, rows(adj_radiance)],
            outputs=[array.grad for array in colors],
        ),
        result=empty(shape, dtype=wp.vec4, device=faces.device),
        variables=colors,
    )


def add_to_texels(adj_texels: wp.array, textures: Textures, footprints: Footprints, adj_albedo: wp.array) -> None:
    """The adjoint of :func:`sample_albedo` by the texels alone.

    Args:
        adj_texels: Gradients of the texels, to which it adds, vec3 of shape [batch, texel].
        adj_albedo: Gradients of the samples' reflectance, vec3 of shape [batch, height, width].
    """
    inputs = [_make_sample_inputs(textures, footprints), None, rows(adj_albedo), None]
    launch(_sample_adjoint_by_colors, _runs(adj_albedo), inputs=inputs, outputs=[None, adj_texels])


def _checked_shape(arrays: dict[str, wp.array], fragments: Fragments, footprints: Footprints) -> tuple[int, ...]:
    """Shape of an image of samples."""
    size = fragments.face_ids.shape[1:]
    check.shape("vertex_albedo", arrays["vertex_albedo"].shape, ("batch", "vertex"))
    check.shape("footprints", footprints.uvs.shape, ("batch", *size))
    return common_batch(arrays | {"footprints": footprints.uvs}), *size


def _make_sample_inputs(
    textures: Textures, footprints: Footprints, fragments: Fragments | None = None, faces: wp.array | None = None
) -> _SampleInputs:
    sample_inputs = _SampleInputs()
    if fragments is not None:
        (sample_inputs.face_ids, sample_inputs.barycentrics), sample_inputs.faces = fragments.rows, faces
    sample_inputs.levels, sample_inputs.level_counts = textures.levels, textures.level_counts
    sample_inputs.texture_ids, sample_inputs.uvs, sample_inputs.probes = footprints.rows
    sample_inputs.run = run_length(footprints.uvs.device, footprints.uvs.shape[2])
    return sample_inputs


def _runs(images: wp.array) -> tuple[int, int]:
    """Instances, and the runs of samples of each."""
    batch_count, height, width = images.shape
    return batch_count, height * width // run_length(images.device, width)


def _launch_sample(inputs: Sequence, images: wp.array, outputs: Sequence[wp.array | None]) -> None:
    dim = math.prod(_runs(images))
    launch(_sample, dim, cost=_COST * images.size / dim, inputs=inputs, outputs=outputs)
