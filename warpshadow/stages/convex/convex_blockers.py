"""Convex blockers: the convex parts of bodies, as kernels read them, and where they are."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import warp as wp

from warpshadow import check
from warpshadow.device.launch import launch, without_gradient
from warpshadow.maths.convex import ConvexPart
from warpshadow.stages.sparse import SparseMatrix, multiply

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix


class ConvexBody(NamedTuple):
    """A body that consists of convex parts, among all bodies."""

    parts: Sequence[ConvexPart]
    first_vertex: int  # offset of its vertices among the vertices of all bodies
    blocks: bool = True  # whether it casts shadows
    hull: ConvexPart | None = None  # of its parts, if these are a compound: see :mod:`.convex.coverage`


UNSEEN = wp.constant(1.0e30)
"""Distance of the plane of a face without area, which nobody sees: the back of a one-sided panel."""


@wp.struct
class ConvexArrays:
    """Parts as kernels read them: corners, faces and edges of one part after another."""

    bodies: wp.array(dtype=wp.int32)  # of each piece
    blocks: wp.array(dtype=wp.int32)  # whether a piece casts shadows
    first_part: wp.array(dtype=wp.int32)  # of each piece, and the end of the last
    first_piece: wp.array(dtype=wp.int32)  # of each compound, and the end of the last
    hulls: wp.array(dtype=wp.int32)  # index of each compound's hull, a part after those of pieces; −1 without one
    signs: wp.array(dtype=wp.float32)  # of the coverage of each part: −1 for seams, which are a piece's last
    gaps: wp.array(dtype=wp.float32)  # height above each part up to which receivers of its body lie, over its radius
    first_corner: wp.array(dtype=wp.int32)  # of each part, and the end of the last
    first_face: wp.array(dtype=wp.int32)
    first_edge: wp.array(dtype=wp.int32)
    faces: wp.array(dtype=wp.vec3i)  # three corners of each, counterclockwise from outside
    edges: wp.array(dtype=wp.vec4i)  # begin, end, and numbers of the faces to the left and right among their part's


@dataclass(frozen=True, eq=False)
class ConvexBlockers:
    """The bodies of a scene that consist of convex parts."""

    body_count: int  # number of bodies
    edge_count: int  # edges of a part at most
    arrays: ConvexArrays  # their parts
    corners_of_vertices: SparseMatrix  # matrix that finds corners, [corner, vertex]

    @staticmethod
    def from_bodies(bodies: Sequence[ConvexBody], vertex_count: int, *, device: wp.DeviceLike) -> ConvexBlockers:
        """Prepare bodies, among bodies that have so many vertices together."""
        hulls = [body.hull for body in bodies if body.hull is not None]
        parts = [*(part for body in bodies for part in body.parts), *hulls]
        starts = {name: _starts([len(getattr(part, name)) for part in parts]) for name in ("corners", "faces", "edges")}
        faces = [part.faces + first for part, first in zip(parts, starts["corners"], strict=False)]
        shifted_edges = [
            part.edges + [first, first, 0, 0] for part, first in zip(parts, starts["corners"], strict=False)
        ]
        arrays = ConvexArrays()
        pieces = [(number, part.piece) for number, body in enumerate(bodies) for part in body.parts]
        counts = {piece: len(list(group)) for piece, group in itertools.groupby(pieces)}
        compounds = [(body, 0 if bodies[body].hull is not None else piece) for body, piece in counts]
        piece_counts = {compound: len(list(group)) for compound, group in itertools.groupby(compounds)}
        hull_numbers = iter(range(len(parts) - len(hulls), len(parts)))
        hull_of_each = [-1 if bodies[body].hull is None else next(hull_numbers) for body, _ in piece_counts]
        arrays.bodies = wp.array([body for body, _ in counts], dtype=wp.int32, device=device)
        blocks = [int(bodies[body].blocks) for body, _ in counts]
        arrays.blocks = wp.array(blocks, dtype=wp.int32, device=device)
        arrays.first_part = wp.array(_starts(list(counts.values())), dtype=wp.int32, device=device)
        arrays.first_piece = wp.array(_starts(list(piece_counts.values())), dtype=wp.int32, device=device)
        arrays.hulls = wp.array(hull_of_each, dtype=wp.int32, device=device)
        signs = [-1.0 if part.is_seam else 1.0 for part in parts]
        arrays.signs = wp.array(signs, dtype=wp.float32, device=device)
        arrays.gaps = wp.array([part.gap for part in parts], dtype=wp.float32, device=device)
        arrays.first_corner = wp.array(starts["corners"], dtype=wp.int32, device=device)
        arrays.first_face = wp.array(starts["faces"], dtype=wp.int32, device=device)
        arrays.first_edge = wp.array(starts["edges"], dtype=wp.int32, device=device)
        arrays.faces = wp.array(np.concatenate(faces), dtype=wp.vec3i, device=device)
        arrays.edges = wp.array(np.concatenate(shifted_edges), dtype=wp.vec4i, device=device)
        of_parts = [body.first_vertex + part.corners for body in bodies for part in body.parts]
        of_hulls = [body.first_vertex + body.hull.corners for body in bodies if body.hull is not None]
        vertices = np.concatenate([*of_parts, *of_hulls])
        return ConvexBlockers(
            len(bodies),
            max(len(part.edges) for part in parts),
            arrays,
            SparseMatrix.from_matrix(_selection_matrix(vertices, vertex_count), device=device),
        )

    def place(self, positions: wp.array) -> PlacedParts:
        """Convex parts in the world.

        Args:
            positions: Vertices of all bodies [scene units], vec3 of shape [batch, vertex]. Parts must stay convex:
                bodies may be moved and scaled.

        Differentiable: positions.
        """
        check.shape("positions", positions.shape, ("batch", self.corners_of_vertices.shape[1]))
        corners = multiply(self.corners_of_vertices, positions)
        count, device, arrays = corners.shape[0], corners.device, self.arrays
        face_planes = wp.empty((count, arrays.faces.size), dtype=wp.vec4, device=device)
        bounds = wp.empty((count, arrays.first_face.size - 1), dtype=wp.vec4, device=device)
        launch(_bound_parts, bounds.shape, inputs=[without_gradient(corners), arrays], outputs=[face_planes, bounds])
        return PlacedParts(corners, face_planes, bounds)


class PlacedParts(NamedTuple):
    """Convex parts in the world."""

    corners: wp.array  # vec3 of shape [batch, corner]
    face_planes: wp.array  # of faces: outward normals N, and N·x of their points, vec4 of shape [batch, face]
    bounds: wp.array  # of parts: center and radius of a sphere around each, vec4 of shape [batch, part]


@wp.kernel(enable_backward=False)
def _bound_parts(
    # in
    corners: wp.array2d(dtype=wp.vec3),
    parts: ConvexArrays,
    # out
    face_planes: wp.array2d(dtype=wp.vec4),
    bounds: wp.array2d(dtype=wp.vec4),
):
    """A thread owns a part of an instance."""
    batch, part = wp.tid()
    first, end = parts.first_corner[part], parts.first_corner[part + 1]
    corner_sum = wp.vec3()
    for corner in range(first, end):
        corner_sum += corners[batch, corner]
    center = corner_sum / float(end - first)
    radius = float(0.0)
    for corner in range(first, end):
        radius = wp.max(radius, wp.length(corners[batch, corner] - center))
    bounds[batch, part] = wp.vec4(center[0], center[1], center[2], radius)
    for face in range(parts.first_face[part], parts.first_face[part + 1]):
        a = corners[batch, parts.faces[face][0]]
        normal = wp.normalize(
            wp.cross(corners[batch, parts.faces[face][1]] - a, corners[batch, parts.faces[face][2]] - a)
        )
        distance = wp.where(parts.faces[face][0] == parts.faces[face][1], UNSEEN, wp.dot(normal, a))
        face_planes[batch, face] = wp.vec4(normal[0], normal[1], normal[2], distance)


def _starts(counts: Sequence[int]) -> np.ndarray:
    """First index of each part's items, and the end of the last."""
    return np.cumsum([0, *counts]).astype(np.int32)


def _selection_matrix(columns: np.ndarray, count: int) -> csr_matrix:
    """Matrix that selects some of ``count`` items."""
    from scipy.sparse import csr_matrix

    return csr_matrix((np.ones(len(columns)), (np.arange(len(columns)), columns)), shape=(len(columns), count))
