"""Receivers: the points at which light is evaluated, and how the samples of an image get theirs from them.

Receivers are vertices of visible faces, or for some bodies points that samples see
(:mod:`warpshadow.stages.receivers.sample_receivers`). The back of a face (:mod:`warpshadow.stages.raster.sides`) has
receivers of its own, at the same points, with opposite normals.
"""

from typing import NamedTuple

import numpy as np
import warp as wp

from warpshadow.device.batch import common_batch, instance_in
from warpshadow.device.constants import constant
from warpshadow.device.launch import launch, without_gradient
from warpshadow.device.memory import empty, reshaped
from warpshadow.device.parallel import run_dimensions, split_launch
from warpshadow.stages.raster.interpolation import interpolate_at
from warpshadow.stages.raster.rasterization import Fragments
from warpshadow.stages.raster.sides import split_side
from warpshadow.stages.receivers.body_spans import Span, spans_of
from warpshadow.stages.receivers.quadtree import Quadtree
from warpshadow.stages.receivers.receiver_footprints import FootprintInputs, find_pixel_area
from warpshadow.stages.receivers.receiver_means import VisibleSurface
from warpshadow.stages.receivers.sample_receivers import find_sample_receivers
from warpshadow.stages.receivers.vertex_receivers import Numbering

_GATHER_COST = 40.0  # nanoseconds that a receiver takes


class Receivers(NamedTuple):
    """Receivers of every instance.

    The first receivers are vertices of static bodies: they have indices, but no points and normals here. The others are
    vertex receivers, then sample receivers.

    ``faces`` has three receiver numbers a row: first a row for each face of the mesh (or each side); then a row
    (r, r, r) for each sample receiver r; then the triangles between samples. A fragment's face number is a row of it,
    −1 for none.
    """

    points: wp.array  # [batch, receiver − on static] vec3
    normals: wp.array  # [batch, receiver − on static] vec3
    faces: wp.array  # [face or side + sample receiver + triangle] vec3i, indices of receivers
    receiver_of_vertex: wp.array  # [vertex, then their backs if fragments have sides] int32, receiver or -1 for none
    fragments: Fragments  # of these faces
    static_vertices: np.ndarray = np.empty(0, int)  # [static vertex], the vertices that the first receivers are
    spans: tuple[Span, ...] = ()  # of the others, by body; () where no body is distinct
    vertices: wp.array | None = None  # int32, the vertex or back of each vertex receiver, [vertex receiver]
    sample_fragments: Fragments | None = None  # side and barycentrics of each sample receiver, [batch, sample receiver]
    samples: wp.array | None = None  # [view, sample receiver] int32, the sample that owns each, −1 for none
    has_mean_slope: wp.array | None = None  # [view, sample] bool, samples whose receivers do not move over the screen
    footprints: wp.array | None = None  # [batch, receiver − on static] vec3; None where receivers are points

    def without_bodies(self) -> "Receivers":
        """Drop the bodies of receivers."""
        return self._replace(spans=(), vertices=None, sample_fragments=None, samples=None)


_FULL_RISE_COSINE, _NO_RISE_COSINE = 0.866, 0.707
"""Least cosine between a face and its vertices' normals from which its points rise in full (30°), and not at all (45°):
such normals round the edges of a box, whose points would rise into its neighbors."""


@wp.func
def _rise_to_smooth_surface(
    positions: wp.array(dtype=wp.vec3), normals: wp.array(dtype=wp.vec3), corners: wp.vec3i, weights: wp.vec3
):
    """Offsets of a point from its face, seen from front and back, towards the surface that smooth normals describe.

    Each corner's tangent plane, where it is above the point, raises it [Hanika 2021, "Hacking the shadow terminator"]:
    to twice the height of a sphere through the corners. With half of that a bunny of 3,500 vertices keeps some of the
    dark specks where light grazes its normals, which come from flat faces in their own shadow.
    """
    point = interpolate_at(positions, corners, weights)
    # of unit length, so that no product of three leaves the range of float32
    edge = wp.normalize(positions[corners[1]] - positions[corners[0]])
    other_edge = wp.normalize(positions[corners[2]] - positions[corners[0]])
    face_normal = wp.normalize(wp.cross(edge, other_edge))
    front = wp.vec3()
    back = wp.vec3()
    cosine = float(1.0)
    for k in range(3):
        normal = normals[corners[k]]
        height = weights[k] * wp.dot(positions[corners[k]] - point, normal)
        front += wp.max(height, 0.0) * normal
        back += wp.min(height, 0.0) * normal
        cosine = wp.min(cosine, wp.abs(wp.dot(normal, face_normal)))
    rise_weight = wp.smoothstep(_NO_RISE_COSINE, _FULL_RISE_COSINE, cosine)
    return rise_weight * front, rise_weight * back


@wp.kernel
def _gather_points(
    first_row: int,
    worker: int,
    # in
    positions: wp.array2d(dtype=wp.vec3),
    normals: wp.array2d(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    vertices: wp.array(dtype=wp.int32),
    fragment_sides: wp.array2d(dtype=wp.int32),
    fragment_barycentrics: wp.array2d(dtype=wp.vec3),
    lifts_to_smooth_surface: bool,
    clip_positions: wp.array2d(dtype=wp.vec4),
    footprint_widths: wp.array(dtype=wp.float32),
    pixel: wp.vec2,
    # out
    points: wp.array2d(dtype=wp.vec3),
    point_normals: wp.array2d(dtype=wp.vec3),
    footprints: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a receiver: a vertex, or a fragment, −1 for nothing. Footprints of vertices are 0."""
    row, column = wp.tid()
    batch, receiver = split_launch(worker, first_row + row, column)
    position_batch = instance_in(batch, positions.shape[0])
    fragment = receiver - vertices.shape[0]
    footprint = wp.vec3()
    if fragment < 0:
        vertex, is_back = split_side(vertices[receiver], positions.shape[1])
        points[batch, receiver] = positions[position_batch, vertex]
        point_normals[batch, receiver] = wp.where(is_back, -1.0, 1.0) * normals[position_batch, vertex]
    else:
        fragment_batch = instance_in(batch, fragment_sides.shape[0])
        weights = fragment_barycentrics[fragment_batch, fragment]
        side = fragment_sides[fragment_batch, fragment]
        face, is_back = split_side(wp.max(side, 0), faces.shape[0])
        point = interpolate_at(positions[position_batch], faces[face], weights)
        if lifts_to_smooth_surface:
            front, back = _rise_to_smooth_surface(
                positions[position_batch], normals[position_batch], faces[face], weights
            )
            point += wp.where(is_back, back, front)
        points[batch, receiver] = point
        normal = wp.normalize(interpolate_at(normals[position_batch], faces[face], weights))
        point_normals[batch, receiver] = wp.where(is_back, -1.0, 1.0) * normal
        if footprints:
            width = footprint_widths[face]
            if side >= 0 and width > 0.0:
                clip = clip_positions[instance_in(batch, clip_positions.shape[0])]
                area = find_pixel_area(positions[position_batch], clip, faces[face], weights, pixel)
                footprint = width * width * area
    if footprints:
        footprints[batch, receiver] = footprint


@wp.kernel(enable_backward=False)
def _find_faces(
    # in
    faces: wp.array(dtype=wp.vec3i),
    receiver_of_vertex: wp.array(dtype=wp.int32),
    vertex_count: int,
    side_count: int,
    receiver_count: int,
    # out
    receiver_faces: wp.array(dtype=wp.vec3i),
):
    """A thread owns a face: a side of one of the mesh, or of a sample receiver."""
    face = wp.tid()  # the array may have room for triangles after these
    receiver = receiver_count + face - side_count
    result = wp.vec3i(receiver, receiver, receiver)
    if face < side_count:
        side = face / faces.shape[0]
        corners = faces[face - side * faces.shape[0]]
        for k in range(3):
            result[k] = receiver_of_vertex[side * vertex_count + corners[k]]
    receiver_faces[face] = result


@wp.kernel(enable_backward=False)
def _find_triangles(
    # in
    corners: wp.array2d(dtype=wp.int32),
    receiver_numbers: wp.array(dtype=wp.int32),
    receiver_count: int,
    first_face: int,
    # out
    receiver_faces: wp.array(dtype=wp.vec3i),
):
    """A thread owns a square of corners a b / c d, −1 for none, and its triangles a b c and d c b."""
    square = wp.tid()
    receivers = wp.vec4i()
    for k in range(4):
        receivers[k] = receiver_count + receiver_numbers[wp.max(corners[square, k], 0)]
    if corners[square, 0] < 0:
        receivers = wp.vec4i()
    face = first_face + 2 * square
    receiver_faces[face] = wp.vec3i(receivers[0], receivers[1], receivers[2])
    receiver_faces[face + 1] = wp.vec3i(receivers[3], receivers[2], receivers[1])


def find_receivers(
    positions: wp.array,
    normals: wp.array,
    faces: wp.array,
    fragments: Fragments,
    numbering: Numbering,
    has_sample_receivers: np.ndarray,
    bodies: np.ndarray | None = None,
    supersampling: int = 1,
    quadtree: Quadtree | None = None,
    smooth_pieces: wp.array | None = None,
    lifts_to_smooth_surface: bool = False,
    has_mean_slope: wp.array | None = None,
    shares_receivers: np.ndarray | None = None,
    footprint_inputs: FootprintInputs | None = None,
) -> Receivers:
    """Gather the points at which light is evaluated.

    Args:
        positions: Vertices [scene units], vec3 of shape [batch, vertex].
        normals: Unit normals of the vertices, vec3 of shape [batch, vertex].
        faces: Vertex indices, vec3i of shape [face].
        fragments: Of one batch for all, or of one each.
        numbering: The vertices that are receivers: those of faces that a sample sees, unless the face wants samples;
            with their backs where fragments have sides.
        has_sample_receivers: Faces whose samples have receivers of their own, bool of shape [face].
        bodies: Body of each face, −1 where it is not distinct, shape [face]; None where no body is, as for
            :func:`.vertex_receivers.number_receivers`.
        supersampling: Samples of a pixel across and down: samples of a pixel with the same face share a receiver.
        quadtree: Squares in which samples of faces that want them interpolate; None for none.
        smooth_pieces: Smooth piece of each face, int32 of shape [face], where samples that see different faces of one
            share a receiver, too; None where they do not.
        lifts_to_smooth_surface: Whether receivers of samples, from which rays leave, are lifted from flat faces onto
            the curved surface that the vertex normals describe.
        has_mean_slope, shares_receivers: As for :func:`.sample_receivers.find_sample_receivers`.
        footprint_inputs: By which those of samples have footprints; None where all are points.
    Returns:
        Receivers; where no face wants samples, many views of one geometry share them.
    Differentiable: positions, normals, barycentrics of the fragments.
    """
    device = positions.device
    vertices, static_vertices, receiver_of_vertex, spans = numbering
    sides = fragments.face_ids if fragments.sides is None else fragments.sides
    receiver_fragments = fragments if fragments.sides is None else Fragments(sides, fragments.barycentrics)
    batch_count, sample_fragments, samples = len(positions), None, None
    side_count, receiver_count = receiver_of_vertex.size // positions.shape[1] * len(faces), numbering.receiver_count
    count = face_count = side_count
    if has_sample_receivers.any():
        batch_count = common_batch({"positions": positions, "fragments": sides})
        body_keys = np.zeros(len(faces), int) if bodies is None else bodies
        surface = None
        if smooth_pieces is not None and len(positions) == 1:
            visible_points = points_of_fragments(positions, normals, faces, Fragments(*receiver_fragments.rows))
            surface = VisibleSurface(*visible_points[:2], positions[0], faces, smooth_pieces)
        arguments = receiver_fragments, side_count, has_sample_receivers, body_keys, supersampling, quadtree, surface
        sample_receivers = find_sample_receivers(*arguments, has_mean_slope, shares_receivers)
        receiver_fragments, sample_fragments = sample_receivers.fragments, sample_receivers.sample_fragments
        moving_count = numbering.moving_count
        spans += tuple(
            Span(body, moving_count + first, moving_count + end) for body, first, end in sample_receivers.spans
        )
        samples = sample_receivers.samples
        count += samples.shape[1]
        face_count = count if quadtree is None else count + 2 * len(quadtree.corners)
    elif vertices is None:
        return Receivers(positions, normals, faces, receiver_of_vertex, receiver_fragments)
    receiver_faces = empty(face_count, dtype=wp.vec3i, device=device)
    inputs = [faces, receiver_of_vertex, positions.shape[1], side_count, receiver_count]
    launch(_find_faces, count, inputs=inputs, outputs=[receiver_faces])
    if quadtree is not None and sample_fragments is not None:
        numbers = reshaped(sample_receivers.numbers, (-1,))
        inputs = [quadtree.corners, numbers, receiver_count, count]
        launch(_find_triangles, len(quadtree.corners), inputs=inputs, outputs=[receiver_faces])
    vertices = receiver_of_vertex if vertices is None else vertices
    if bodies is None or sample_fragments is None or not sample_fragments.face_ids.size:
        footprint_inputs = None
    points, point_normals, footprints = _gather_receiver_points(
        batch_count,
        positions,
        normals,
        faces,
        vertices,
        sample_fragments,
        footprint_inputs,
        lifts_to_smooth_surface=lifts_to_smooth_surface,
    )
    receivers = Receivers(
        points,
        point_normals,
        receiver_faces,
        receiver_of_vertex,
        receiver_fragments,
        static_vertices,
        has_mean_slope=has_mean_slope,
        footprints=footprints,
    )
    if bodies is None:
        return receivers
    if sample_fragments and not sample_fragments.face_ids.size:
        sample_fragments = samples = None
    return receivers._replace(spans=spans, vertices=vertices, sample_fragments=sample_fragments, samples=samples)


def _gather_receiver_points(
    count: int,
    positions: wp.array,
    normals: wp.array,
    faces: wp.array,
    vertices: wp.array,
    sample_fragments: Fragments | None,
    footprint_inputs: FootprintInputs | None = None,
    *,
    lifts_to_smooth_surface: bool = False,
) -> tuple[wp.array, wp.array, wp.array | None]:
    """Points and normals of vertices and of fragments, for a number of instances; and footprints, if there are inputs.

    Differentiable: positions, normals, barycentrics. Not: footprints.
    """
    device = positions.device
    if sample_fragments is None:
        sample_fragments = Fragments(*(empty((1, 0), dtype=dtype, device=device) for dtype in (wp.int32, wp.vec3)))
    shape = count, vertices.size + sample_fragments.face_ids.shape[1]
    points, point_normals = (empty(shape, dtype=wp.vec3, device=device) for _ in range(2))
    footprints = None if footprint_inputs is None else empty(shape, dtype=wp.vec3, device=device)
    launch(
        _gather_points,
        run_dimensions(device, shape[1], count),
        cost=_GATHER_COST,
        inputs=[
            positions,
            normals,
            faces,
            vertices,
            sample_fragments.face_ids,
            sample_fragments.barycentrics,
            lifts_to_smooth_surface,
            *(footprint_inputs or FootprintInputs()),
        ],
        outputs=[points, point_normals, footprints],
        shared=[positions, normals],
    )
    return points, point_normals, None if footprints is None else without_gradient(footprints)


def receivers_on_faces(
    positions: wp.array,
    normals: wp.array,
    faces: wp.array,
    sides: np.ndarray,
    barycentrics: np.ndarray,
    bodies: np.ndarray | None = None,
) -> Receivers:
    """Make receivers of given points on faces, for light alone: no image gets it from them.

    Args:
        positions, normals: Vertices [scene units] and their unit normals, vec3 of shape [batch, vertex].
        faces: Vertex indices, vec3i of shape [face].
        sides: Faces, from the front or from behind, int of shape [receiver].
        barycentrics: Where on them, shape [receiver, 3].
        bodies: Body of each, −1 where it is not distinct, shape [receiver]: those of a body follow each other. None
            where no body is distinct.
    Differentiable: positions, normals.
    """
    device = positions.device
    sample_fragments = Fragments(constant(sides[None], wp.int32, device), constant(barycentrics[None], wp.vec3, device))
    points, point_normals, _ = points_of_fragments(positions, normals, faces, sample_fragments)
    no_vertices = constant(np.empty(0, int), wp.int32, device)
    spans = () if bodies is None else spans_of(bodies)
    return Receivers(
        points,
        point_normals,
        faces,
        no_vertices,
        sample_fragments,
        spans=spans,
        vertices=no_vertices,
        sample_fragments=sample_fragments,
    )


def points_of_fragments(
    positions: wp.array,
    normals: wp.array,
    faces: wp.array,
    fragments: Fragments,
    footprint_inputs: FootprintInputs | None = None,
) -> tuple[wp.array, wp.array, wp.array | None]:
    """Points, normals and, where there are inputs, footprints of fragments: vec3 of shape [batch, receiver].

    Args:
        fragments: Sides and barycentrics [view, receiver].
    Differentiable: positions, normals, barycentrics. Not: footprints.
    """
    count = common_batch({"positions": positions, "fragments": fragments.face_ids})
    no_vertices = constant(np.empty(0, int), wp.int32, positions.device)
    return _gather_receiver_points(count, positions, normals, faces, no_vertices, fragments, footprint_inputs)
