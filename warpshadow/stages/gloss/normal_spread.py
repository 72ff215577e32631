"""Normal spread: how normals vary over the part of a pixel that a receiver stands for.

Highlights of surfaces that are more curved than their lobes are wide alias without it. To first order normals are

    n + x a + y b,   a = r_x ∂n/∂x,   b = r_y ∂n/∂y,   x and y from −½ to ½,

along the rows and the columns of an image [pixels], seen in the plane across the normal; in that of the face where the
normal is far from its own. r is the part of a pixel along a row or a column that the face fills: with β its
barycentrics min(1, 0.8 / max|∂β/∂x|), at least that of a sample. Lobes are so much wider (:mod:`.lobes`).
"""

from typing import NamedTuple

import warp as wp

from warpshadow import check
from warpshadow.device.batch import common_batch, instance_in
from warpshadow.device.launch import launch
from warpshadow.device.memory import zeros
from warpshadow.stages.raster.rasterization import Fragments

_RANGE = 0.8
"""Change of a barycentric within a face: it deviates over a triangle as much as a uniform number of a range
of 0.8."""

_MAX_SQUARE = 1.0  # most of |a|² + |b|²

_FLAT_COSINE, _SMOOTH_COSINE = 0.9, 0.96
"""Cosines between a normal and its face from which on a pixel is seen in the plane of the face, and across the normal.

Across normals it does not step from face to face: errors of gradients under a sun (tests/test_gloss.py) are 0.5 and
5.1% of metals, and 8.1 and 5.8% in planes of faces. At bevels of boxes normals say nothing of the surface: a still of a
bear of roughness 0.2 would be 12% off in place of 10%."""

_MIN_SLANT = 0.1  # least cosine, about, at which that plane is seen: beyond outlines it would have all normals

wp.set_module_options({"max_unroll": 1})


@wp.func
def _steps_in_plane(clip_matrix: wp.mat44, point: wp.vec3, normal: wp.vec3, pixel: wp.vec2):
    """Steps from a point in a plane that are a pixel to the right, and one down, or both up and left, in the image."""
    clip_point = clip_matrix * wp.vec4(point[0], point[1], point[2], 1.0)
    depth = clip_point[3]
    row_w = wp.vec3(clip_matrix[3, 0], clip_matrix[3, 1], clip_matrix[3, 2])
    to_right = wp.vec3(clip_matrix[0, 0], clip_matrix[0, 1], clip_matrix[0, 2]) - clip_point[0] / depth * row_w
    down = wp.vec3(clip_matrix[1, 0], clip_matrix[1, 1], clip_matrix[1, 2]) - clip_point[1] / depth * row_w
    volume = wp.dot(normal, wp.cross(to_right, down))
    minimum = _MIN_SLANT * wp.length(to_right) * wp.length(down)
    scale = depth / wp.sqrt(volume * volume + minimum * minimum)
    return pixel[0] * scale * wp.cross(down, normal), pixel[1] * scale * wp.cross(normal, to_right)


@wp.func
def _rates_on_face(a: wp.vec3, b: wp.vec3, c: wp.vec3):
    """Gradients of barycentrics on a face, the rows of a matrix, and its normal."""
    edge = wp.normalize(b - a)  # so that no product of three lengths leaves the range of float32
    size = wp.max(wp.length(b - a), 1.0e-30)
    other_edge = (c - a) / size
    face_normal = wp.cross(edge, other_edge)
    square = wp.max(wp.length_sq(face_normal), 1.0e-20) * size
    by_b = wp.cross(other_edge, face_normal) / square
    by_c = wp.cross(face_normal, edge) / square
    return wp.matrix_from_rows(-by_b - by_c, by_b, by_c), wp.normalize(face_normal)


@wp.kernel
def _find_spread(
    # in
    face_ids: wp.array2d(dtype=wp.int32),
    barycentrics: wp.array2d(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    normals: wp.array2d(dtype=wp.vec3),
    positions: wp.array2d(dtype=wp.vec3),
    clip_matrices: wp.array(dtype=wp.mat44),
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
        normal_batch = instance_in(batch, normals.shape[0])
        corner_normals = wp.matrix_from_cols(
            normals[normal_batch, corners[0]], normals[normal_batch, corners[1]], normals[normal_batch, corners[2]]
        )
        mean = corner_normals * weights
        length = wp.length(mean)
        normal = mean / length
        position_batch = instance_in(batch, positions.shape[0])
        a = positions[position_batch, corners[0]]
        b = positions[position_batch, corners[1]]
        c = positions[position_batch, corners[2]]
        rates, face_normal = _rates_on_face(a, b, c)
        cosine = wp.dot(face_normal, normal)
        smoothness = wp.smoothstep(_FLAT_COSINE, _SMOOTH_COSINE, wp.abs(cosine))
        flat_share = (1.0 - smoothness) * wp.where(cosine < 0.0, -1.0, 1.0)
        plane_normal = wp.normalize(smoothness * normal + flat_share * face_normal)
        clip_matrix = clip_matrices[instance_in(batch, clip_matrices.shape[0])]
        point = weights[0] * a + weights[1] * b + weights[2] * c
        to_x, to_y = _steps_in_plane(clip_matrix, point, plane_normal, pixel)
        by_x = rates * to_x
        by_y = rates * to_y
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
    positions: wp.array,
    clip_matrices: wp.array,
    size: tuple[int, int],
    supersampling: int,
) -> NormalSpread:
    """Find how normals vary over receivers.

    Args:
        fragments: Faces that receivers see, −1 for none, and barycentrics, [batch, receiver].
        faces: Vertex indices, vec3i of shape [face].
        normals: Of vertices, vec3 of shape [batch, vertex].
        positions: Of vertices [scene units], vec3 of shape [batch, vertex].
        clip_matrices: Cameras, mat44 of shape [batch].
            Any batch may be 1 and then serves every instance.
        size: Width and height of the image [pixels].
        supersampling: Samples of a pixel in a row.

    Differentiable: barycentrics, normals, positions, clip_matrices.
    """
    check.shape("normals", normals.shape, ("batch", positions.shape[1]))
    arrays = {"fragments": fragments.barycentrics, "positions": positions, "clip_matrices": clip_matrices}
    arrays["normals"] = normals
    shape, device = (common_batch(arrays), fragments.face_ids.shape[1]), faces.device
    spread = NormalSpread(*(zeros(shape, dtype=wp.vec3, device=device) for _ in range(2)))
    inputs = [fragments.face_ids, fragments.barycentrics, faces, normals, positions, clip_matrices]
    pixel = wp.vec2(2.0 / size[0], 2.0 / size[1])
    launch(_find_spread, shape, inputs=[*inputs, pixel, 1.0 / supersampling], outputs=[*spread])
    return spread
