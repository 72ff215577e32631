"""Smoothing: samples at a silhouette blend, so that an image changes smoothly as it moves.

A rasterized image jumps at a silhouette, and does not change while the line between two samples moves. So each takes of
the other's color as much as its own area beyond the line (:mod:`warpshadow.stages.silhouettes.areas`; after Laine et
al. 2020, section 3.5, who take edges as upright). A sample of color c, with neighbors of colors c_k, areas e_k beyond
the lines and weights ω_k of the lines (:mod:`warpshadow.stages.silhouettes.silhouettes`), becomes

    c + Σ_k e_k (ω_k − Σ_l π_kl max(ω_k + ω_l − 1, 0) e_l) (c_k − c)          l: the two directions across k

This is a mean: the weights are positive, and at most 1 in all. The inner sum is the overlap of two areas: nothing if
they lie beyond one line, their product if beyond two upright ones, of which each loses half, π = ½. If one lies beyond
the end of a surface (π = 0) and the other beyond a crease of it (π = 1), the crease's loses all of it.
"""

import functools

import warp as wp

from warpshadow import check
from warpshadow.device.batch import accumulate
from warpshadow.device.launch import differentiable, launch
from warpshadow.device.memory import copied, reshaped
from warpshadow.device.warp_internals import scalar_type
from warpshadow.stages.raster.interpolation import inner_product
from warpshadow.stages.raster.screen import neighbor, opposite
from warpshadow.stages.silhouettes.areas import LineArea, measure_area_adjoint
from warpshadow.stages.silhouettes.lines import INTERSECTION, FragmentArrays, make_fragment_arrays
from warpshadow.stages.silhouettes.silhouettes import Silhouettes


@wp.func
def _overlap_loss(line: LineArea, other: LineArea):
    """Loss of an area to one beyond a neighboring line, as a fraction of their product."""
    loss_share = 0.5 * (1.0 + other.is_surface_end - line.is_surface_end)
    return loss_share * wp.max(line.weight + other.weight - 1.0, 0.0)


@wp.func
def _area_weight(lines: wp.array(dtype=LineArea), direction: int):
    """Weight of the area in a direction: ω, less its loss to the areas in both directions across."""
    perpendicular = wp.where(direction < 2, 2, 0)
    line, first, second = lines[direction], lines[perpendicular], lines[perpendicular + 1]
    weight = line.weight - _overlap_loss(line, first) * first.area
    return weight - _overlap_loss(line, second) * second.area


@wp.func
def find_image_weight(
    sample: int, entry: int, entries: wp.array(dtype=wp.int32), line_areas: wp.array2d(dtype=LineArea), width: int
):
    """Weight of a sample that has an entry in all of the smoothed image: of its own color, and in its neighbors'."""
    weight = float(1.0)
    for direction in range(4):
        line = line_areas[entry, direction]
        if line.weight > 0.0:
            other_entry = entries[neighbor(sample, direction, width)]
            back = opposite(direction)
            weight -= line.area * _area_weight(line_areas[entry], direction)
            weight += line_areas[other_entry, back].area * _area_weight(line_areas[other_entry], back)
    return weight


@functools.cache
def _make_blend(dtype: type) -> wp.Kernel:
    """Make the kernel for images of a dtype."""

    @wp.kernel(module="unique", enable_backward=False)
    def blend(
        # in
        image: wp.array2d(dtype=dtype),
        samples: wp.array(dtype=wp.int32),
        line_areas: wp.array2d(dtype=LineArea),
        width: int,
        # out
        smoothed: wp.array2d(dtype=dtype),
    ):
        """A thread owns an entry's sample of an image; the smoothed image is a copy before."""
        instance, entry = wp.tid()
        sample = samples[entry]
        if sample >= 0:
            lines = line_areas[entry]
            color = image[instance, sample]
            blended = color
            for direction in range(4):
                area = lines[direction].area
                if area > 0.0:
                    contrast = image[instance, neighbor(sample, direction, width)] - color
                    blended += area * _area_weight(lines, direction) * contrast
            smoothed[instance, sample] = blended

    return blend


@functools.cache
def _make_blend_adjoint(dtype: type) -> wp.Kernel:
    """Make the adjoint of the kernel of :func:`_make_blend`."""

    @wp.kernel(module="unique", enable_backward=False)
    def blend_adjoint(
        # in
        image: wp.array2d(dtype=dtype),
        samples: wp.array(dtype=wp.int32),
        line_areas: wp.array2d(dtype=LineArea),
        fragments: FragmentArrays,
        entries: wp.array(dtype=wp.int32),
        edges: wp.array2d(dtype=wp.vec2i),
        edge_colors: wp.array3d(dtype=dtype),
        adj_smoothed: wp.array2d(dtype=dtype),
        # out
        adj_image: wp.array2d(dtype=dtype),
        adj_clip_positions: wp.array2d(dtype=wp.vec4),
    ):
        """A thread owns an entry's sample of all images; ``adj_image`` already holds the part by its own color.

        Gradients of edges go by the contrast of the colors that both surfaces have there; without these, by the
        contrast of the samples.
        """
        entry = wp.tid()
        sample = samples[entry]
        if sample >= 0:
            lines = line_areas[entry]
            for direction in range(4):
                line = lines[direction]
                if line.area > 0.0:
                    other = neighbor(sample, direction, fragments.width)
                    weight = _area_weight(lines, direction)
                    adj_area = float(0.0)
                    for instance in range(image.shape[0]):
                        adj = adj_smoothed[instance, sample]
                        if adj_image:
                            wp.atomic_add(adj_image, instance, other, line.area * weight * adj)
                            wp.atomic_sub(adj_image, instance, sample, line.area * weight * adj)
                        contrast = image[instance, other] - image[instance, sample]
                        if edge_colors:
                            neighbor_color = edge_colors[instance, entries[other], opposite(direction)]
                            contrast = neighbor_color - edge_colors[instance, entry, direction]
                        adj_area += inner_product(adj, contrast)
                    if adj_clip_positions and adj_area != 0.0:
                        edge = edges[entry, direction]
                        adj_area *= wp.where(edge[0] == INTERSECTION, line.weight, 1.0)
                        measure_area_adjoint(fragments, sample, direction, edge, adj_area, adj_clip_positions)

    return blend_adjoint


def smooth_silhouettes(
    image: wp.array, silhouettes: Silhouettes, clip_positions: wp.array, edge_colors: wp.array | None = None
) -> wp.array:
    """Smooth an image along silhouettes, by how much of a sample lies beyond them.

    It takes a copy of the image and, beside that, time in proportion to the length of the silhouettes.

    Args:
        image: float32 or a vector of them, shape [batch, height, width]; of ones where there is a face and zeros
            elsewhere it becomes the coverage.
        silhouettes: Of :func:`warpshadow.stages.silhouettes.silhouettes.find_silhouettes`; if their batch is 1 they
            serve every image.
        clip_positions: The vertices that the silhouettes were found for, vec4 of shape [batch, vertex]; they are moved.
        edge_colors: Of :func:`warpshadow.stages.silhouettes.edge_colors.find_edge_colors`, by which gradients of edges
            go; by default the colors of samples.
    Returns:
        Smoothed image, like ``image``; a sample lies within the range of itself and its four neighbors.
    Differentiable: image; clip_positions, exactly on average over where samples lie
    (:mod:`warpshadow.stages.silhouettes.areas`), but for overlaps of areas, intersections within one surface, cuts by
    the near plane, and surfaces that leave the image, where there is no neighbor to take from. Without edge colors an
    edge has the colors of the samples beside it: where shading changes by δ over a sample, its gradient is δ/2 off.
    """
    fragments = silhouettes.fragments
    batch_count, height, width = fragments.face_ids.shape
    check.shape("image", image.shape, ("batch" if batch_count == 1 else batch_count, height, width))
    check.shape("clip_positions", clip_positions.shape, (batch_count, "vertex"))
    if scalar_type(image.dtype) is not wp.float32:
        raise ValueError(f"image: got dtype {image.dtype.__name__}, expected float32 or a vector of them")
    shape, samples, line_areas = silhouettes.flat_shape(image), silhouettes.samples, silhouettes.line_areas

    def blend(smoothed: wp.array) -> None:
        inputs = [reshaped(image, shape), samples, line_areas, width]
        outputs = [reshaped(smoothed, shape)]
        launch(_make_blend(image.dtype), (shape[0], samples.size), inputs=inputs, outputs=outputs)

    def adjoint(adj_smoothed: wp.array) -> None:
        adj_smoothed, adj_image = reshaped(adj_smoothed, shape), None
        if image.requires_grad:
            adj_image = reshaped(image.grad, shape)
            accumulate(adj_smoothed, adj_image)
        arrays = make_fragment_arrays(fragments, silhouettes.faces, clip_positions)
        edge_inputs = silhouettes.entries, silhouettes.edges, edge_colors
        launch(
            _make_blend_adjoint(image.dtype),
            samples.size,
            inputs=[reshaped(image, shape), samples, line_areas, arrays, *edge_inputs, adj_smoothed],
            outputs=[adj_image, clip_positions.grad],
        )

    return differentiable(blend, adjoint, copied(image), [image, clip_positions])
