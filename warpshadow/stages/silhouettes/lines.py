"""Lines between neighboring samples: the edge of a surface, a crease, or where two faces intersect."""

import warp as wp

from warpshadow.device.warp_internals import struct_of
from warpshadow.stages.raster.rasterization import Fragments
from warpshadow.stages.raster.screen import (
    face_plane,
    neighbor,
    relative_to_ray,
    relative_to_ray_adjoint,
    sample_center,
)

NOTHING = -1
INTERSECTION = -2  # in place of an edge's vertices, where there is no line, and where there is that of two faces


@wp.struct
class FragmentArrays:
    """Fragments as kernels take them: arrays of flat images, batch after batch."""

    face_ids: wp.array(dtype=wp.int32)
    barycentrics: wp.array(dtype=wp.vec3)
    faces: wp.array(dtype=wp.vec3i)
    clip_positions: wp.array2d(dtype=wp.vec4)
    width: int
    height: int


def make_fragment_arrays(fragments: Fragments, faces: wp.array, clip_positions: wp.array) -> FragmentArrays:
    """Fragments of rasterized faces of vertices in clip space."""
    face_ids, barycentrics = fragments.flat
    _, height, width = fragments.face_ids.shape
    return struct_of(
        FragmentArrays,
        face_ids=face_ids,
        barycentrics=barycentrics,
        faces=faces,
        clip_positions=clip_positions,
        width=width,
        height=height,
    )


@wp.func
def image_index(fragments: FragmentArrays, sample: int):
    """Index of the image that a sample of flat images belongs to."""
    return sample // (fragments.width * fragments.height)


@wp.func
def edge_line(edge: wp.vec2i, position: wp.vec2, clip_positions: wp.array(dtype=wp.vec4)):
    """The line of an edge, relative to a position."""
    return wp.cross(
        relative_to_ray(clip_positions[edge[0]], position), relative_to_ray(clip_positions[edge[1]], position)
    )


@wp.func
def edge_position_adjoint(
    edge: wp.vec2i, center: wp.vec2, axis: int, adj_position: float, clip_positions: wp.array(dtype=wp.vec4)
):
    """Gradients of an edge's ends, by its point's gradient along the row (axis 0) or column (1) of a position."""
    line = edge_line(edge, center, clip_positions)
    offset_a = relative_to_ray(clip_positions[edge[0]], center)[1 - axis]
    offset_b = relative_to_ray(clip_positions[edge[1]], center)[1 - axis]
    cross_component = wp.where(axis == 0, -line[0], line[1])
    point = line / line[axis]
    point[1 - axis] = 0.0
    adj_clip = adj_position * relative_to_ray_adjoint(center, point)
    return (offset_b / cross_component) * adj_clip, (-offset_a / cross_component) * adj_clip


@wp.func
def line_between(fragments: FragmentArrays, sample: int, direction: int, edge: wp.vec2i):
    """The line ℓ between a sample and its neighbor in a direction, relative to the sample's center."""
    position = sample_center(sample, fragments.width, fragments.height)
    clip = fragments.clip_positions[image_index(fragments, sample)]
    if edge[0] >= 0:
        return edge_line(edge, position, clip)
    face = fragments.faces[fragments.face_ids[sample]]
    neighbor_face = fragments.faces[fragments.face_ids[neighbor(sample, direction, fragments.width)]]
    return face_plane(face, position, clip) - face_plane(neighbor_face, position, clip)
