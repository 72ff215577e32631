"""Edge colors: the colors that surfaces have where they end or have a crease, by which moving edges change an image."""

import warp as wp

from warpshadow.device.batch import instance_in, rows
from warpshadow.device.launch import launch
from warpshadow.device.memory import reshaped, zeros
from warpshadow.stages.raster.screen import (
    ends_before,
    half_size,
    has_neighbor,
    line_distance,
    neighbor,
    opposite,
    relative_to_ray,
    sample_center,
)
from warpshadow.stages.raster.sides import join_side, split_side
from warpshadow.stages.silhouettes.lines import NOTHING, FragmentArrays, image_index, line_between, make_fragment_arrays
from warpshadow.stages.silhouettes.silhouettes import Silhouettes

wp.set_module_options({"max_unroll": 1})  # loops that are not unrolled compile faster, and run as fast


@wp.kernel(enable_backward=False)
def _find_edge_colors(
    # in
    image: wp.array2d(dtype=wp.vec4),
    samples: wp.array(dtype=wp.int32),
    edges: wp.array2d(dtype=wp.vec2i),
    fragments: FragmentArrays,
    sides: wp.array(dtype=wp.int32),
    shading: wp.array2d(dtype=wp.vec3),
    receivers: wp.array(dtype=wp.int32),
    albedo: wp.array2d(dtype=wp.vec3),
    # out
    edge_colors: wp.array3d(dtype=wp.vec4),
):
    """A thread owns an entry's sample of an image."""
    instance, entry = wp.tid()
    sample = samples[entry]
    if sample >= 0:
        batch = image_index(fragments, sample)
        receiver_shading = shading[instance_in(instance + batch, shading.shape[0])]
        sample_albedo = albedo[instance_in(instance + batch, albedo.shape[0])]
        center = sample_center(sample, fragments.width, fragments.height)
        samples_per_unit = half_size(fragments.width, fragments.height)
        clip = fragments.clip_positions[batch]
        sample_color = image[instance, sample]
        for direction in range(4):
            edge = edges[entry, direction]
            if edge[0] != NOTHING:
                line = line_between(fragments, sample, direction, edge)
                color = sample_color
                opposite_direction = opposite(direction)
                if edges[entry, opposite_direction][0] == NOTHING and has_neighbor(
                    sample, opposite_direction, fragments.width, fragments.height
                ):
                    color_step = sample_color - image[instance, neighbor(sample, opposite_direction, fragments.width)]
                    if color_step[3] == 0.0:
                        color += wp.clamp(line_distance(line, direction, samples_per_unit), 0.0, 1.0) * color_step
                if edge[0] >= 0 and ends_before(line, direction):
                    is_back = bool(False)
                    if sides:
                        _, is_back = split_side(sides[sample], fragments.faces.shape[0])
                    receiver_a = receivers[join_side(edge[0], is_back, clip.shape[0])]
                    receiver_b = receivers[join_side(edge[1], is_back, clip.shape[0])]
                    if wp.min(receiver_a, receiver_b) >= 0:
                        offset_a = relative_to_ray(clip[edge[0]], center)[1 - direction // 2]
                        offset_b = relative_to_ray(clip[edge[1]], center)[1 - direction // 2]
                        edge_position = wp.clamp(offset_a / (offset_a - offset_b), 0.0, 1.0)
                        edge_radiance = wp.lerp(
                            receiver_shading[receiver_a], receiver_shading[receiver_b], edge_position
                        )
                        edge_radiance = wp.cw_mul(
                            edge_radiance, sample_albedo[sample % (fragments.width * fragments.height)]
                        )
                        color = wp.vec4(edge_radiance[0], edge_radiance[1], edge_radiance[2], 1.0)
                edge_colors[instance, entry, direction] = wp.where(wp.isfinite(color), color, sample_color)


def find_edge_colors(
    image: wp.array,
    silhouettes: Silhouettes,
    clip_positions: wp.array,
    shading: wp.array,
    receivers: wp.array,
    albedo: wp.array,
) -> wp.array:
    """Find the colors that surfaces have at the edges themselves.

    The color of the near surface, which ends at the edge, is interpolated between the edge's vertices: shading changes
    fastest where a surface turns away from the eye, over the last half sample of a ball by a tenth. Where these are no
    receivers, as of a body shaded by pixel, and on the far surface, color is extrapolated linearly from the two nearest
    samples that see the surface.

    Args:
        image: Color and coverage before smoothing, vec4 of shape [batch, height, width].
        silhouettes: Of :func:`find_silhouettes`.
        clip_positions: The vertices that the silhouettes were found for, vec4 of shape [batch, vertex].
        shading: Of the receivers, vec3 of shape [batch, receiver].
        receivers: Receiver of each vertex, −1 for none, int32 of shape [vertex]; where the silhouettes' fragments have
            sides, the backs' receivers follow.
        albedo: Of the samples, vec3 of shape [batch, height, width].
    Returns:
        For each direction of each entry, the color of its sample's surface at the edge, vec4 of shape [instance, entry,
        4], for :func:`warpshadow.stages.silhouettes.smooth.smooth_silhouettes`.

    Not differentiable.
    """
    fragments, shape = silhouettes.fragments, silhouettes.flat_shape(image)
    color_shape = shape[0], *silhouettes.edges.shape
    edge_colors = zeros(color_shape, dtype=wp.vec4, device=image.device, outlives_recording=False)
    launch(
        _find_edge_colors,
        edge_colors.shape[:2],
        inputs=[
            reshaped(image, shape),
            silhouettes.samples,
            silhouettes.edges,
            make_fragment_arrays(fragments, silhouettes.faces, clip_positions),
            None if fragments.sides is None else reshaped(fragments.sides, (-1,)),
            shading,
            receivers,
            rows(albedo),
        ],
        outputs=[edge_colors],
    )
    return edge_colors
