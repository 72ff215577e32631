"""Probes: the points of a body at which self-visibility is tabulated, and the interpolation between them.

Probes are the body's vertices and, where edges are long, points between them: light changes along a rail that has no
vertex between its ends. Faces and their pieces are cut at the middle of their longest edge until no edge is too long,
nor cut by the face beside it, so that faces agree (Rivara 1984). The visibility of a sample is interpolated between the
corners of its piece. The first probes are the vertices; the backs of all probes of an open body follow.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from warpshadow.device.launch import launch
from warpshadow.device.memory import empty
from warpshadow.maths.inset import inset_vertices
from warpshadow.stages.raster.rasterization import Fragments
from warpshadow.stages.raster.sides import split_side
from warpshadow.stages.receivers.body_spans import (
    ReceiverSpans,
    Span,
    SpanValues,
    receiver_spans,
    span_values,
    value_of_receiver,
)

_EVEN_FACES = 10_000
"""Edges are judged by the edges of an even cut of the surface into so many faces (507 vertices alone lose 3.5%)."""

_MAX_SAMPLE_EDGE = 1.2  # longest edge where samples receive, in edges of the even cut

_MAX_VERTEX_EDGE = 4.0  # likewise where only vertices receive; probes between them are for buried vertices

_SLIVER_RATIO = 3.0  # there an edge is cut only if it is longer than 3 × the ⅓-quantile of edges: those of slivers

_ENTRY_RATIO = 1 / 3
"""Longest edge that enters another part of the body, as a spoke a hub, over other edges' (demos/kinds.py, cage, and
chair, wheel and fence: 7.1 and 5.1% off; with 1: 7.5 and 5.5%; with 1/8 probes elsewhere are missing)."""

_MAX_PROBES = 2**14  # probes of a body at most, as long as it has fewer than half as many vertices
_LENGTH_STEP = 1.3  # how much longer edges may be at each try to have fewer probes


class ProbeWeights(NamedTuple):
    """Barycentric interpolation between probes: three rows of each receiver, and their weights."""

    rows: wp.array  # [batch, receiver] vec3i, probes and then their backs; a vertex has one thrice
    weights: wp.array  # [batch, receiver] vec3 with sum 1


class VisibilityProbes(NamedTuple):
    """The probes of a body in its own space.

    Args:
        positions: Shape [probe, 3], float32.
        normals: Unit normals [probe, 3], float32.
        pieces: Faces, and then the pieces that they are cut into, int32 of shape [piece, 4]: three probes and −1 for
            a whole piece. A piece that is cut in two has the number 3 p + k in place of −1: its halves are the pieces
            p and p + 1, and the edge opposite to its corner k is cut. The probe in the middle of that edge replaces
            corner k + 2 (modulo 3) in piece p, and corner k + 1 in piece p + 1; other corners are the same.
    """

    positions: np.ndarray
    normals: np.ndarray
    pieces: np.ndarray

    @property
    def uncut_pieces(self) -> np.ndarray:
        """Corners of the pieces that are whole, [piece, 3]."""
        return self.pieces[self.pieces[:, 3] < 0, :3]

    @property
    def edges(self) -> np.ndarray:
        """Pairs of probes that are next to each other on a face, int of shape [pair, 2]; some stand there twice."""
        return np.concatenate([self.uncut_pieces[:, [k, (k + 1) % 3]] for k in range(3)])

    @property
    def ray_origins(self) -> np.ndarray:
        """Points from which rays of the probes leave, [probe, 3]: within the wall of a probe where walls meet."""
        return inset_vertices(self.positions, self.uncut_pieces)


def longest_edge(positions: np.ndarray, faces: np.ndarray, *, has_sample_receivers: bool) -> float:
    """Longest edge for a body's pieces, shorter where samples, not only vertices, are receivers."""
    corners = np.asarray(positions, np.float64)[faces]
    sides = corners - np.roll(corners, 1, axis=1)
    area = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1).sum() / 2
    even_edge = np.sqrt(4 / np.sqrt(3) * area / _EVEN_FACES)
    if has_sample_receivers:
        return float(_MAX_SAMPLE_EDGE * even_edge)
    return float(max(_MAX_VERTEX_EDGE * even_edge, _SLIVER_RATIO * np.quantile(np.linalg.norm(sides, axis=2), 1 / 3)))


def find_probes(
    positions: np.ndarray,
    normals: np.ndarray,
    faces: np.ndarray,
    max_edge: float = np.inf,
    find_buried: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None,
) -> VisibilityProbes:
    """Find the probes of a mesh.

    Args:
        positions: Vertices [vertex, 3].
        normals: Their unit normals [vertex, 3]; between them normals are interpolated.
        faces: Indices of vertices [face, 3].
        max_edge: Length beyond which edges are cut; it is raised where probes would be too many.
        find_buried: Whether points [point, 3] with unit normals lie inside another part of the body, bool of
            shape [point]. Edges from one to another kind are cut to a third of that length. None where there are none.
    """
    max_points = max(_MAX_PROBES, 2 * len(positions))
    while (probe_data := _cut_faces(positions, normals, faces, max_edge, max_points, find_buried)) is None:
        max_edge *= _LENGTH_STEP
    points, directions, pieces = probe_data
    directions = _normalized(directions)
    directions[: len(normals)] = normals
    return VisibilityProbes(points.astype(np.float32), directions.astype(np.float32), pieces.astype(np.int32))


def _normalized(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-30)


def _cut_faces(
    positions: np.ndarray,
    normals: np.ndarray,
    faces: np.ndarray,
    max_edge: float,
    max_points: int,
    find_buried: Callable[[np.ndarray, np.ndarray], np.ndarray] | None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Points, their normals of any length, and pieces; None for more than ``max_points`` points."""
    points, directions = (np.asarray(values, np.float64) for values in (positions, normals))
    is_buried = np.zeros(len(points), bool) if find_buried is None else find_buried(points, directions)
    pieces = np.concatenate([faces, np.full((len(faces), 1), -1)], axis=1).astype(np.int64)
    cut_edges, edge_middles = np.empty(0, np.int64), np.empty(0, np.int64)
    while True:
        uncut_pieces = np.flatnonzero(pieces[:, 3] < 0)
        corners = pieces[uncut_pieces, :3]
        edge_ends = np.sort(np.stack([np.roll(corners, -1, axis=1), np.roll(corners, -2, axis=1)], axis=2), axis=2)
        lengths = np.linalg.norm(points[edge_ends[..., 0]] - points[edge_ends[..., 1]], axis=2)  # of the edges across
        enters_part = is_buried[edge_ends[..., 0]] != is_buried[edge_ends[..., 1]]
        is_cut = np.isin(edge_ends[..., 0] << 32 | edge_ends[..., 1], cut_edges)  # by the piece beside it
        is_long = ((lengths > np.where(enters_part, _ENTRY_RATIO * max_edge, max_edge)) | is_cut).any(axis=1)
        uncut_pieces, cut_corner = uncut_pieces[is_long], np.argmax(lengths[is_long], axis=1)
        if not len(uncut_pieces):
            return points, directions, pieces
        piece_numbers = np.arange(len(uncut_pieces))
        edge_ends = edge_ends[is_long][piece_numbers, cut_corner]
        edge_keys, edge_indices = np.unique(edge_ends[:, 0] << 32 | edge_ends[:, 1], return_inverse=True)
        new_edges = np.setdiff1d(edge_keys, cut_edges, assume_unique=True)
        first_probes, second_probes = new_edges >> 32, new_edges & 0xFFFFFFFF
        edge_middles = np.concatenate([edge_middles, len(points) + np.arange(len(new_edges))])
        points, directions = (
            np.concatenate([values, (values[first_probes] + values[second_probes]) / 2])
            for values in (points, directions)
        )
        if len(points) > max_points:
            return None
        middle_is_buried = np.zeros(len(new_edges), bool)
        if find_buried is not None and len(new_edges):
            middle_is_buried = find_buried(points[-len(new_edges) :], _normalized(directions[-len(new_edges) :]))
        is_buried = np.concatenate([is_buried, middle_is_buried])
        cut_edges = np.concatenate([cut_edges, new_edges])
        permutation = np.argsort(cut_edges)
        cut_edges, edge_middles = cut_edges[permutation], edge_middles[permutation]
        cut_middles = edge_middles[np.searchsorted(cut_edges, edge_keys)][edge_indices.ravel()]
        new_pieces = np.repeat(pieces[uncut_pieces], 2, axis=0)
        new_pieces[2 * piece_numbers, (cut_corner + 2) % 3] = new_pieces[
            2 * piece_numbers + 1, (cut_corner + 1) % 3
        ] = cut_middles
        pieces[uncut_pieces, 3] = 3 * (len(pieces) + 2 * piece_numbers) + cut_corner
        pieces = np.concatenate([pieces, new_pieces])


@wp.struct
class ProbeTable:
    """Pieces of the faces of one body, and where its vertices, faces and probes begin."""

    first_vertex: int  # of the body's vertices among all
    first_face: int  # likewise of its faces
    probe_count: int  # number of its probes; their backs follow
    pieces: wp.array(dtype=wp.vec4i)  # as in VisibilityProbes


@wp.kernel(enable_backward=False)
def _find_vertex_weights(
    # in
    vertices: wp.array(dtype=wp.int32),
    vertex_count: int,
    spans: ReceiverSpans,
    tables: wp.array(dtype=ProbeTable),
    table_of_span: SpanValues,
    # out
    rows: wp.array2d(dtype=wp.vec3i),
    weights: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a receiver at a vertex."""
    receiver = wp.tid()
    table = tables[value_of_receiver(table_of_span, spans, receiver)]
    vertex, is_back = split_side(vertices[receiver], vertex_count)
    row = vertex - table.first_vertex + wp.where(is_back, table.probe_count, 0)
    rows[0, receiver] = wp.vec3i(row, row, row)
    weights[0, receiver] = wp.vec3(1.0, 0.0, 0.0)


@wp.func
def _find_piece_and_matrix(pieces: wp.array(dtype=wp.vec4i), face: int, barycentrics: wp.vec3):
    """Corners of the piece of a face around a point, its barycentrics there, and M, from the face's to these."""
    piece = pieces[face]
    weights = barycentrics
    matrix = wp.identity(n=3, dtype=wp.float32)
    while piece[3] >= 0:
        cut_corner = piece[3] % 3
        nearer_corner = (cut_corner + 1) % 3
        farther_corner = (cut_corner + 2) % 3
        piece_number = piece[3] // 3
        if weights[nearer_corner] < weights[farther_corner]:
            previous = nearer_corner
            nearer_corner = farther_corner
            farther_corner = previous
            piece_number += 1
        weights[nearer_corner] = weights[nearer_corner] - weights[farther_corner]
        weights[farther_corner] = 2.0 * weights[farther_corner]
        for k in range(3):
            matrix[nearer_corner, k] = matrix[nearer_corner, k] - matrix[farther_corner, k]
            matrix[farther_corner, k] = 2.0 * matrix[farther_corner, k]
        piece = pieces[piece_number]
    return wp.vec3i(piece[0], piece[1], piece[2]), weights, matrix


@wp.func
def _find_piece(pieces: wp.array(dtype=wp.vec4i), face: int, barycentrics: wp.vec3):
    """Corners of the piece of a face around a point, and its barycentrics there."""
    corners, weights, _matrix = _find_piece_and_matrix(pieces, face, barycentrics)
    return corners, weights


@wp.func_grad(_find_piece)
def _find_piece_adjoint(
    pieces: wp.array(dtype=wp.vec4i), face: int, barycentrics: wp.vec3, adj_corners: wp.vec3i, adj_weights: wp.vec3
):
    """On a piece M does not change:  b̄ = Mᵀ w̄."""
    _corners, _weights, matrix = _find_piece_and_matrix(pieces, face, barycentrics)
    wp.adjoint[barycentrics] += wp.transpose(matrix) * adj_weights


@wp.kernel
def _find_sample_weights(
    # in
    sides: wp.array2d(dtype=wp.int32),
    barycentrics: wp.array2d(dtype=wp.vec3),
    face_count: int,
    spans: ReceiverSpans,
    tables: wp.array(dtype=ProbeTable),
    table_of_span: SpanValues,
    # out
    rows: wp.array2d(dtype=wp.vec3i),
    weights: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a receiver at a fragment, −1 for none."""
    batch, receiver = wp.tid()
    table = tables[value_of_receiver(table_of_span, spans, receiver)]
    face, is_back = split_side(wp.max(sides[batch, receiver], table.first_face), face_count)
    corners, piece_weights = _find_piece(table.pieces, face - table.first_face, barycentrics[batch, receiver])
    back_offset = wp.where(is_back, table.probe_count, 0)
    rows[batch, receiver] = corners + wp.vec3i(back_offset, back_offset, back_offset)
    weights[batch, receiver] = piece_weights


class ProbeTables(NamedTuple):
    """Tables of some bodies, in which their receivers find the probes around them."""

    tables: tuple[ProbeTable, ...]  # of each body
    table: wp.array  # the same on the device
    vertex_count: int  # of all bodies
    face_count: int

    @classmethod
    def of_bodies(
        cls,
        probes: Sequence[VisibilityProbes],
        first_vertices: Sequence[int],
        first_faces: Sequence[int],
        vertex_count: int,
        face_count: int,
        device: wp.DeviceLike,
    ) -> "ProbeTables":
        """Tables of some bodies, given the probes of each, and where its vertices and faces begin among all."""
        tables = []
        for of_body, first_vertex, first_face in zip(probes, first_vertices, first_faces, strict=True):
            table = ProbeTable()
            table.first_vertex, table.first_face, table.probe_count = first_vertex, first_face, len(of_body.positions)
            table.pieces = wp.array(of_body.pieces, dtype=wp.vec4i, device=device)
            tables.append(table)
        return cls(tuple(tables), wp.array(tables, dtype=ProbeTable, device=device), vertex_count, face_count)

    def of_vertices(
        self, vertices: wp.array, spans: Sequence[Span] = (), table_of_span: Sequence[int] = (0,)
    ) -> ProbeWeights:
        """Probe weights of receivers at vertices, of batch 1.

        Args:
            vertices: Indices among all vertices, after which their backs are numbered, int32 of shape [receiver].
            spans: Of the receivers, by body; () for one of all.
            table_of_span: The number of each span's body among those of the tables.
        """
        probe_weights = _empty_weights(1, vertices.size, vertices.device)
        inputs = [vertices, self.vertex_count, *self._inputs(vertices.size, spans, table_of_span)]
        launch(_find_vertex_weights, vertices.size, inputs=inputs, outputs=list(probe_weights))
        return probe_weights

    def of_samples(
        self, fragments: Fragments, spans: Sequence[Span] = (), table_of_span: Sequence[int] = (0,)
    ) -> ProbeWeights:
        """Find the probe weights of receivers at fragments of sides [batch, receiver]. Differentiable: barycentrics."""
        sides, barycentrics = fragments.face_ids, fragments.barycentrics
        probe_weights = _empty_weights(len(sides), sides.shape[1], sides.device)
        inputs = [sides, barycentrics, self.face_count, *self._inputs(sides.shape[1], spans, table_of_span)]
        launch(_find_sample_weights, sides.shape, inputs=inputs, outputs=list(probe_weights))
        return probe_weights

    def _inputs(self, receiver_count: int, spans: Sequence[Span], table_of_span: Sequence[int]) -> list[Any]:
        device = self.table.device
        return [receiver_spans(spans, receiver_count, 1, device), self.table, span_values(table_of_span, device)]


def _empty_weights(batch_count: int, count: int, device: wp.Device) -> ProbeWeights:
    shape = batch_count, count
    return ProbeWeights(empty(shape, dtype=wp.vec3i, device=device), empty(shape, dtype=wp.vec3, device=device))
