"""Footprints: the areas for which receivers at samples stand, a pixel of their plane or a sample of it.

An edge of a shadow that is narrower than a footprint is seen at few receivers, and its motion by none between. So edges
are wide enough that each receiver has about the mean over its footprint (:mod:`.visibility.directional`).
"""

import numpy as np
import warp as wp

from warpshadow.device.batch import instance_in
from warpshadow.device.constants import constant
from warpshadow.device.launch import launch
from warpshadow.device.memory import empty
from warpshadow.stages.raster.rasterization import Fragments
from warpshadow.stages.raster.screen import volume_rates


@wp.kernel(enable_backward=False)
def _find_receiver_footprints(
    # in
    sides: wp.array2d(dtype=wp.int32),
    barycentrics: wp.array2d(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    widths: wp.array(dtype=wp.float32),
    positions: wp.array2d(dtype=wp.vec3),
    clip_positions: wp.array2d(dtype=wp.vec4),
    pixel: wp.vec2,
    first: int,
    # out
    footprints: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a receiver; receivers at samples are the last."""
    batch, receiver = wp.tid()
    fragment_batch = instance_in(batch, sides.shape[0])
    sample = receiver - first
    side = int(-1)
    if sample >= 0:
        side = sides[fragment_batch, sample]
    face = wp.max(side, 0) % faces.shape[0]
    footprint = wp.vec3()
    if side >= 0 and widths[face] > 0.0:
        corners = faces[face]
        clip = clip_positions[instance_in(batch, clip_positions.shape[0])]
        corner_positions = positions[instance_in(batch, positions.shape[0])]
        a = clip[corners[0]]
        b = clip[corners[1]]
        c = clip[corners[2]]
        weights = barycentrics[fragment_batch, sample]
        point = weights[0] * a + weights[1] * b + weights[2] * c
        rates_x, rates_y = volume_rates(a, b, c, wp.vec2(point[0] / point[3], point[1] / point[3]), pixel)
        origin = corner_positions[corners[0]]
        along_b = corner_positions[corners[1]] - origin
        along_c = corner_positions[corners[2]] - origin
        by_x = rates_x - (rates_x[0] + rates_x[1] + rates_x[2]) * weights
        by_y = rates_y - (rates_y[0] + rates_y[1] + rates_y[2]) * weights
        area = wp.cross(by_x[1] * along_b + by_x[2] * along_c, by_y[1] * along_b + by_y[2] * along_c)
        footprint = widths[face] * widths[face] * area
    footprints[batch, receiver] = footprint


def find_receiver_footprints(
    fragments: Fragments,
    faces: wp.array,
    widths: np.ndarray,
    positions: wp.array,
    clip_positions: wp.array,
    size: tuple[int, int],
    shape: tuple[int, int],
) -> wp.array:
    """Find the footprints of receivers at samples, which are the last of all.

    Args:
        fragments: Sides that they see, −1 for none, and barycentrics, [view, sample receiver].
        faces: Vertex indices, vec3i of shape [face].
        widths: Of footprints on each face [pixels], 0 for points, shape [face].
        positions, clip_positions: Vertices [scene units], vec3, and in clip space, vec4, of shape [batch, vertex].
        size: Height and width of the image [pixels].
        shape: Of all receivers, [batch, receiver].
    Returns:
        Areas, as vectors along the normal or against it [scene units²], vec3; 0 for other receivers.

    Not differentiable.
    """
    device, count = faces.device, fragments.face_ids.shape[1]
    footprints = empty(shape, dtype=wp.vec3, device=device)
    inputs = [fragments.face_ids, fragments.barycentrics, faces, constant(widths, wp.float32, device)]
    inputs += [positions, clip_positions, wp.vec2(2.0 / size[1], 2.0 / size[0]), shape[1] - count]
    launch(_find_receiver_footprints, shape, inputs=inputs, outputs=[footprints])
    return footprints
