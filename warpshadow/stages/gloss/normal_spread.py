"""Normal spread: how normals vary over the part of a pixel that a receiver stands for.

Highlights of surfaces that are more curved than their lobes are wide alias without it. To first order normals are

    n + x a + y b,   a = r_x ∂n/∂x,   b = r_y ∂n/∂y,   x and y from −½ to ½,

along the rows and the columns of an image [pixels]. r is the part of a pixel along a row or a column that the face
fills: with β its barycentrics min(1, 0.8 / max|∂β/∂x|), at least that of a sample. Lobes are so much wider
(:mod:`.lobes`).
"""

from typing import NamedTuple

import warp as wp

from warpshadow import check
from warpshadow.device.batch import common_batch, instance_in
from warpshadow.device.launch import launch
from warpshadow.device.memory import zeros
from warpshadow.stages.raster.rasterization import Fragments
from warpshadow.stages.raster.screen import volume_rates

_RANGE = 0.8
"""Change of a barycentric within a face: over a triangle one deviates by as much as numbers that are even over 0.8."""

_MAX_SQUARE = 1.0
"""Most of |a|² + |b|²: at outlines the plane of a face would have all normals within a pixel."""

wp.set_module_options({"max_unroll": 1})


@wp.kernel
def _find_spread(
    # in
    face_ids: wp.array2d(dtype=wp.int32),
    barycentrics: wp.array2d(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    normals: wp.array2d(dtype=wp.vec3),
    clip_positions: wp.array2d(dtype=wp.vec4),
    pixel: wp.vec2,
    min_share: float,
    # out
    along_x: wp.array2d(dtype=wp.vec3),
    along_y: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a receiver; both are zero before."""
    batch, receiver = wp.tid()
    fragment_batch = instance_in(batch, face_ids.shape[0])
    face = face_ids[fragment_batch, receiver]
    if face >= 0:
        corners = faces[face]
        weights = barycentrics[fragment_batch, receiver]
        clip_batch = instance_in(batch, clip_positions.shape[0])
        a = clip_positions[clip_batch, corners[0]]
        b = clip_positions[clip_batch, corners[1]]
        c = clip_positions[clip_batch, corners[2]]
        point = weights[0] * a + weights[1] * b + weights[2] * c
        rates_x, rates_y = volume_rates(a, b, c, wp.vec2(point[0] / point[3], point[1] / point[3]), pixel)
        by_x = rates_x - (rates_x[0] + rates_x[1] + rates_x[2]) * weights
        by_y = rates_y - (rates_y[0] + rates_y[1] + rates_y[2]) * weights
        normal_batch = instance_in(batch, normals.shape[0])
        corner_normals = wp.matrix_from_cols(
            normals[normal_batch, corners[0]], normals[normal_batch, corners[1]], normals[normal_batch, corners[2]]
        )
        mean = corner_normals * weights
        length = wp.length(mean)
        normal = mean / length
        slope_x = corner_normals * by_x / length
        slope_y = corner_normals * by_y / length
        slope_x = slope_x - wp.dot(normal, slope_x) * normal
        slope_y = slope_y - wp.dot(normal, slope_y) * normal
        scale_x = wp.clamp(_RANGE / wp.max(wp.max(wp.abs(by_x)), 1.0e-6), min_share, 1.0)
        scale_y = wp.clamp(_RANGE / wp.max(wp.max(wp.abs(by_y)), 1.0e-6), min_share, 1.0)
        square = scale_x * scale_x * wp.length_sq(slope_x) + scale_y * scale_y * wp.length_sq(slope_y)
        scale = wp.sqrt(wp.min(1.0, _MAX_SQUARE / wp.max(square, 1.0e-12)))
        along_x[batch, receiver] = scale * scale_x * slope_x
        along_y[batch, receiver] = scale * scale_y * slope_y


class NormalSpread(NamedTuple):
    """How normals vary over a receiver, vec3 of shape [batch, receiver]."""

    along_x: wp.array  # a
    along_y: wp.array  # b


def find_normal_spread(
    fragments: Fragments,
    faces: wp.array,
    normals: wp.array,
    clip_positions: wp.array,
    size: tuple[int, int],
    supersampling: int,
) -> NormalSpread:
    """Find how normals vary over receivers.

    Args:
        fragments: Faces that receivers see, −1 for none, and barycentrics, [batch, receiver].
        faces: Vertex indices, vec3i of shape [face].
        normals: Of vertices, vec3 of shape [batch, vertex].
        clip_positions: Vertices in clip space, vec4 of shape [batch, vertex].
            Any batch may be 1 and then serves every instance.
        size: Width and height of the image [pixels].
        supersampling: Samples of a pixel in a row.

    Differentiable: barycentrics, normals, clip_positions.
    """
    check.shape("normals", normals.shape, ("batch", clip_positions.shape[1]))
    arrays = {"fragments": fragments.barycentrics, "normals": normals, "clip_positions": clip_positions}
    shape, device = (common_batch(arrays), fragments.face_ids.shape[1]), faces.device
    spread = NormalSpread(*(zeros(shape, dtype=wp.vec3, device=device) for _ in range(2)))
    inputs = [fragments.face_ids, fragments.barycentrics, faces, normals, clip_positions]
    pixel = wp.vec2(2.0 / size[0], 2.0 / size[1])
    launch(_find_spread, shape, inputs=[*inputs, pixel, 1.0 / supersampling], outputs=[*spread])
    return spread
