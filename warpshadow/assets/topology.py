"""Topology: pieces of a mesh that wind alike, whether they are closed, and their sharp edges."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from warpshadow.maths.adjacency import area_normals, edge_neighbors, number_positions
from warpshadow.maths.components import connected_components

CREASE = 30.0  # edges whose faces bend by more are sharp [degrees]
_MIN_CHAIN = 12  # sharp edges that make a long chain; eyes of a monkey's head are rings of 8
_CHAINED_SHARE = 0.8  # share of sharp edges in long chains from which on a mesh counts as designed


def welded(positions: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Weld vertices at the same position, and drop vertices without faces: positions, faces.

    The first of each stays, in order: so split vertices become one again.
    """
    referenced_vertices = np.unique(faces)
    position_ids = number_positions(positions[referenced_vertices])
    _, first, position_index = np.unique(position_ids, return_index=True, return_inverse=True)
    first_vertices = np.sort(first)
    number = np.searchsorted(first_vertices, first)[position_index]
    renumbered = np.zeros(len(positions), np.int32)
    renumbered[referenced_vertices] = number
    return positions[referenced_vertices[first_vertices]], renumbered[faces]


def join_at_positions(positions: np.ndarray, faces: np.ndarray, *attributes: np.ndarray) -> np.ndarray:
    """Let faces refer to the first of the vertices at one place that agree in all attributes.

    Where a mesh has many sharp edges, as boxes have, and most of them are parted, they stay so. Where angles of all
    sizes occur, normals round them.

    Args:
        positions: Vertices, shape [vertex, 3].
        faces: Indices of positions, shape [face, 3].
        attributes: Of vertices, such as colors, [vertex, n] each.
    Returns:
        The faces by the vertices that stay, shape [face, 3].
    """
    first_vertices = first_at_positions(np.column_stack([positions, *attributes]))
    if (first_vertices == np.arange(len(first_vertices))).all():
        return faces
    is_first = is_listed_first(positions, faces)  # edges of the others would have too many faces
    unique_corners = first_vertices[faces[is_first]].astype(np.int32)
    surface = join_faces(positions, unique_corners, None)
    split_surface = join_faces(positions, faces[is_first], None)
    if rounds_edges(surface, positions) and _parted_share(split_surface, positions, CREASE, 180.0) > 0.5:
        fans, _ = part_at_creases(unique_corners, surface, positions, CREASE)
        count = len(positions)
        fan_count = int(fans.max()) + 1
        smooth = connected_components(faces[is_first].ravel(), count + fans.ravel(), count + fan_count)[:count]
        first_vertices = first_at_positions(smooth[:, None])
    return first_vertices[faces]


def first_at_positions(rows: np.ndarray) -> np.ndarray:
    """Index of the first row that equals each, shape [row]."""
    group = number_positions(rows)
    first = np.empty(len(group), np.int64)
    first[group[::-1]] = np.arange(len(group))[::-1]  # the last of these assignments stays
    return first[group]


def part_at_creases(
    faces: np.ndarray, surface: MeshTopology, positions: np.ndarray, angle: float
) -> tuple[np.ndarray, ...]:
    """Part the vertices of faces along sharp edges.

    Faces that meet in a vertex keep it together where edges that are not sharp lead from one to the other around it.

    Args:
        faces: Indices of positions, shape [face, 3].
        surface: How they are joined.
        positions: Vertices, shape [vertex, 3].
        angle: Edges are sharp where the normals of their faces differ by more [degrees]; borders are, too.
    Returns:
        The faces by new vertices, int32 of shape [face, 3]; and the vertex that each new one is a copy of, int32 of
        shape [vertex]: the old ones are the first, in their order.
    """
    position_ids = number_positions(positions)[surface.faces]
    face, edge, neighbor, cosines = _find_bends(surface, positions, each_once=False)
    is_smooth = cosines >= np.cos(np.radians(angle))
    face, edge, neighbor = face[is_smooth], edge[is_smooth], neighbor[is_smooth]
    links = []
    for end in (1, 2):
        corner = (edge + end) % 3
        other = (position_ids[neighbor] == position_ids[face, corner][:, None]).argmax(axis=1)
        links.append((3 * face + corner, 3 * neighbor + other))
    ends, other_ends = np.concatenate(links, axis=1)
    count = 3 * len(faces)
    fan = connected_components(ends, other_ends, count).reshape(-1, 3)
    is_turned = (surface.faces != faces).any(axis=1)
    keys = faces.astype(np.int64) * count + np.where(is_turned[:, None], fan[:, ::-1], fan)
    _, first, number = np.unique(keys, return_index=True, return_inverse=True)
    owner_faces = faces.ravel()[first]
    is_copy = np.append(False, owner_faces[1:] == owner_faces[:-1])
    vertex = np.where(is_copy, len(positions) - 1 + np.cumsum(is_copy), owner_faces)
    origins = np.concatenate([np.arange(len(positions)), owner_faces[is_copy]])
    return vertex[number].reshape(-1, 3).astype(np.int32), origins.astype(np.int32)


def rounds_edges(surface: MeshTopology, positions: np.ndarray) -> bool:
    """Whether many sharp edges have faces that share vertices, and so normals.

    Those of a piece are many if edges of more than 50° are longer in all than the diagonal of its bounds, and ten times
    as long as edges of 20° to 50°. In organic meshes, where angles of all sizes occur, they are at most 2.6 times as
    long (bunny, cow, monkey, man). In voxels, whose steps normals round on purpose, they are longer than 25 diagonals.
    Such pieces, as many boxes are, have most of the sharp edges, longer in all than the diagonal of the mesh.

    A mesh whose edges of 20° to 50° are long, such as a vase of 16 sides, has many, too, if most sharp edges are in
    long chains, as around its lip (:func:`_chained_length`): 0.87 to 1 of their length in a machine part, a car and
    vases, and at most 0.71 in 15 organic meshes.
    """
    corners = positions[surface.faces].astype(np.float64)
    face, edge, neighbor, cosines = _find_bends(surface, positions)
    bent_edges = np.flatnonzero(cosines < np.cos(np.radians(20)))
    bent_edges = bent_edges[~_is_parted(surface, face[bent_edges], edge[bent_edges], neighbor[bent_edges])]
    face, edge, cosines = face[bent_edges], edge[bent_edges], cosines[bent_edges]
    lengths = np.linalg.norm(np.subtract(*corners[face, (edge + [[1], [2]]) % 3]), axis=1)
    diagonal = np.linalg.norm(np.ptp(corners.reshape(-1, 3), axis=0))
    is_sharp = cosines < np.cos(np.radians(50))
    sharp_length = lengths[is_sharp].sum()
    if sharp_length <= diagonal:
        return False
    if sharp_length < 25 * diagonal:
        ends = number_positions(positions)[surface.faces][face, (edge + [[1], [2]]) % 3]
        chained_length = _chained_length(ends[:, is_sharp], lengths[is_sharp])
        if chained_length > max(diagonal, _CHAINED_SHARE * sharp_length):
            return True
    linked_face, edge = np.nonzero(surface.neighbors >= 0)
    pieces = connected_components(linked_face, surface.neighbors[linked_face, edge], len(surface.faces))
    count = int(pieces.max()) + 1
    sharp_lengths, bent_edges = (
        np.bincount(pieces[face], lengths * (cosines < np.cos(np.radians(angle))), count) for angle in (50, 20)
    )
    low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    np.minimum.at(low, pieces, corners.min(axis=1))
    np.maximum.at(high, pieces, corners.max(axis=1))
    diagonals = np.linalg.norm(high - low, axis=1)
    is_many = (
        (diagonals < sharp_lengths)
        & (sharp_lengths < 25 * diagonals)
        & (bent_edges - sharp_lengths < 0.1 * sharp_lengths)
    )
    return bool(sharp_lengths[is_many].sum() > max(diagonal, sharp_lengths.sum() / 2))


def _chained_length(ends: np.ndarray, lengths: np.ndarray) -> float:
    """Length of edges in chains of :data:`_MIN_CHAIN` or more: at each vertex within them just two of the edges meet.

    Args:
        ends: Vertices, shape [2, edge].
        lengths: Of the edges, shape [edge].
    """
    count = len(lengths)
    vertex_count = int(ends.max()) + 1
    edge, vertex = np.tile(np.arange(count), 2), ends.ravel()
    is_within = np.bincount(vertex, minlength=vertex_count)[vertex] == 2
    chain = connected_components(edge[is_within], count + vertex[is_within], count + vertex_count)[:count]
    return float(lengths[np.bincount(chain)[chain] >= _MIN_CHAIN].sum())


def draws_lines(surface: MeshTopology, positions: np.ndarray) -> bool:
    """Whether lines run over a smooth surface: faces at edges that bend by 1° to 30° have vertices of their own.

    Not where most such edges do: then the mesh is faceted on purpose.
    """
    return 0 < _parted_share(surface, positions, 1.0, CREASE) <= 0.5


def _parted_share(surface: MeshTopology, positions: np.ndarray, low: float, high: float) -> float:
    """Part of the edges that bend by some angles [degrees] whose faces have vertices of their own; 0 without any."""
    face, edge, neighbor, cosines = _find_bends(surface, positions)
    is_bent = (np.cos(np.radians(high)) <= cosines) & (cosines < np.cos(np.radians(low)))
    is_parted = _is_parted(surface, face[is_bent], edge[is_bent], neighbor[is_bent])
    return float(is_parted.mean()) if len(is_parted) else 0.0


def creases(surface: MeshTopology, positions: np.ndarray) -> np.ndarray:
    """Find the edges across which color jumps: their faces bend by more than a degree, and do not share both ends.

    A jump of the normal by a degree changes the light that a face receives by up to 1.7%.

    Returns:
        2ᵏ for the edge opposite to corner k of each face, int32 of shape [face].
    """
    face, edge = np.nonzero(surface.neighbors >= 0)
    neighbor = surface.neighbors[face, edge]
    is_parted = _is_parted(surface, face, edge, neighbor)
    face, edge, neighbor = face[is_parted], edge[is_parted], neighbor[is_parted]
    normals = (face_normals(positions[surface.faces[numbers]]) for numbers in (face, neighbor))
    is_bent = np.einsum("ij,ij->i", *normals) < np.cos(np.radians(1.0))
    result = np.zeros(surface.faces.shape, np.int32)
    result[face[is_bent], edge[is_bent]] = 1
    return result @ np.array([1, 2, 4], np.int32)


def smooth_pieces(surface: MeshTopology, positions: np.ndarray) -> np.ndarray:
    """Number the pieces of a mesh within which faces join across edges that are not sharp, shape [face]."""
    face, _, neighbor, cosines = _find_bends(surface, positions)
    is_smooth = cosines >= np.cos(np.radians(CREASE))
    return connected_components(face[is_smooth], neighbor[is_smooth], len(surface.faces))


def _find_bends(surface: MeshTopology, positions: np.ndarray, *, each_once: bool = True) -> tuple[np.ndarray, ...]:
    """Edges of faces, opposite to corners, with the faces across and the cosines of the angles by which they bend."""
    normals = face_normals(positions[surface.faces])
    face, edge = np.nonzero(surface.neighbors > (np.arange(len(normals))[:, None] if each_once else -1))
    neighbor = surface.neighbors[face, edge]
    return face, edge, neighbor, np.einsum("ij,ij->i", normals[face], normals[neighbor])


def _is_parted(surface: MeshTopology, face: np.ndarray, edge: np.ndarray, neighbor: np.ndarray) -> np.ndarray:
    """Whether an end of edges, of faces, opposite to corners, is a vertex of one of their two faces only."""
    ends = surface.faces[face, (edge + [[1], [2]]) % 3]
    is_shared = [(surface.faces[neighbor] == vertex[:, None]).any(axis=1) for vertex in ends]
    return ~np.logical_and(*is_shared)


def face_normals(corners: np.ndarray) -> np.ndarray:
    """Unit normals of faces [face, corner, 3], float64 of shape [face, 3]; 0 where a face has no area."""
    normals = area_normals(corners.astype(np.float64))
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    return normals / np.where(lengths > 0, lengths, 1)


def corner_normals(corners: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Unit normals at the corners of faces [face, corner, 3], of the vertices at these, float64 of the same shape."""
    normals = np.zeros((int(faces.max()) + 1, 3))
    np.add.at(normals, faces, area_normals(corners.astype(np.float64))[:, None])
    return (normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300))[faces]


class MeshTopology(NamedTuple):
    """Topology of a mesh: how its faces are joined, and the volume they enclose.

    Faces joined along an edge wind alike: where some wind against most of their piece, they are turned over. So normals
    of neighbors add up, and one side of a piece is its front, all over. On a one-sided piece (a Möbius strip) they
    cannot, and stay as they are.
    """

    faces: np.ndarray
    """Indices of positions, int32 of shape [face, 3]."""
    uv_faces: np.ndarray | None
    """Indices of uvs, int32 of shape [face, 3]."""
    neighbors: np.ndarray
    """Face across each edge, :func:`edge_neighbors` of vertices by their places, int32 of shape [face, 3]."""
    is_closed: bool
    """Whether no face shows its back to an outside viewer: two or more share each edge, half of them run along it
    either way, and pieces look outward.

    A shell that is hollow inside does not count as closed: it costs a launch more, and gets the same image.
    """


def is_listed_first(positions: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Whether no face before each has the same three corners, by their places and in any order, bool of shape [face].

    Faces without area are not compared.
    """
    position_ids = number_positions(positions)
    sums = _scramble(position_ids)[faces].sum(axis=1)  # equal for the same corners, and hardly ever for others
    sorted_sums = np.sort(sums)
    repeated_sums = sorted_sums[1:][sorted_sums[1:] == sorted_sums[:-1]]
    is_first = np.ones(len(faces), bool)
    if not len(repeated_sums):
        return is_first
    candidates = np.flatnonzero(np.isin(sums, repeated_sums))
    corners = np.sort(position_ids[faces[candidates]], axis=1)
    permutation = np.lexsort(corners.T)  # which keeps the order of equal ones
    is_equal = (corners[permutation[1:]] == corners[permutation[:-1]]).all(axis=1) & (
        np.diff(corners[permutation[1:]], axis=1) != 0
    ).all(1)
    is_first[candidates[permutation[1:]]] = ~is_equal
    return is_first


def _scramble(numbers: np.ndarray) -> np.ndarray:
    """Scramble whole numbers to 64 bits, uint64 [Steele et al. 2014, SplitMix]."""
    words = (numbers.astype(np.uint64) + np.uint64(1)) * np.uint64(0x9E3779B97F4A7C15)
    for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):
        words = (words ^ (words >> np.uint64(shift))) * np.uint64(factor)
    return words ^ (words >> np.uint64(31))


def join_faces(positions: np.ndarray, faces: np.ndarray, uv_faces: np.ndarray | None) -> MeshTopology:
    """Join lists of different faces."""
    position_ids = number_positions(positions)[faces]
    neighbors = edge_neighbors(position_ids)
    # of the edges opposite to corners
    first, last = np.roll(position_ids, -1, axis=1), np.roll(position_ids, -2, axis=1)
    neighbor = np.maximum(neighbors, 0)
    runs_back = (first[neighbor] == last[:, :, None]) & (last[neighbor] == first[:, :, None])
    winds_alike = runs_back.any(axis=2) | (neighbors < 0)
    if not winds_alike.all():
        is_turned = _find_faces_to_turn(neighbors, winds_alike)
        winds_alike ^= is_turned[:, None] ^ is_turned[neighbor]
        winds_alike |= neighbors < 0
        faces, position_ids, neighbors = (_turn_faces(values, is_turned) for values in (faces, position_ids, neighbors))
        uv_faces = None if uv_faces is None else _turn_faces(uv_faces, is_turned)
    is_closed = bool(winds_alike.all()) and _is_closed(positions, faces, position_ids, neighbors)
    return MeshTopology(faces, uv_faces, neighbors, is_closed)


def _is_closed(positions: np.ndarray, faces: np.ndarray, position_ids: np.ndarray, neighbors: np.ndarray) -> bool:
    """Whether as many faces run along each edge one way as the other, and each piece encloses a positive volume.

    So boxes that share an edge, at which four faces meet, are closed as each of them is. Faces wind alike, and
    ``position_ids`` of their corners are the same where positions are.
    """
    is_proper = (position_ids != np.roll(position_ids, 1, axis=1)).all(axis=1)
    if (neighbors[is_proper] == -1).any():  # a border
        return False
    count = len(faces)
    if (neighbors[is_proper] >= 0).all():
        face, edge = np.nonzero(neighbors > np.arange(count)[:, None])
        piece = connected_components(face, neighbors[face, edge], count)
    else:
        starts, ends = position_ids[is_proper].ravel(), np.roll(position_ids[is_proper], -1, axis=1).ravel()
        lines = np.minimum(starts, ends) * (position_ids.max(initial=0) + 1) + np.maximum(starts, ends)
        _, edge = np.unique(lines, return_inverse=True)
        if np.bincount(edge, np.where(starts < ends, 1, -1)).any():
            return False
        links = np.repeat(np.flatnonzero(is_proper), 3), count + edge
        piece = connected_components(*links, count + int(edge.max(initial=-1)) + 1)[:count]
    a, b, c = np.moveaxis(positions[faces] - positions[0].astype(np.float64), 1, 0)
    volumes = np.bincount(piece[is_proper], np.einsum("ij,ij->i", a, np.cross(b, c))[is_proper])
    return bool((volumes[np.unique(piece[is_proper])] > 0).all())


def _find_faces_to_turn(neighbors: np.ndarray, winds_alike: np.ndarray) -> np.ndarray:
    """Faces to turn over, as few as can be, so that neighbors wind alike, bool of shape [face].

    A graph has two nodes a face, "as it is" and "turned over". Nodes of neighbors that wind alike are joined, so each
    piece of the mesh is there in both windings; the one that turns fewer faces over is taken.
    """
    count = len(neighbors)
    face, edge = np.nonzero(neighbors >= 0)
    other = neighbors[face, edge] + np.where(winds_alike[face, edge], 0, count)
    ends = np.concatenate([face, face + count]), np.concatenate([other, (other + count) % (2 * count)])
    part = connected_components(*ends, 2 * count)
    as_it_is, over = part[:count], part[count:]
    unturned_count = np.bincount(as_it_is, minlength=len(part))
    return (unturned_count[as_it_is] < unturned_count[over]) | (
        (unturned_count[as_it_is] == unturned_count[over]) & (as_it_is > over)
    )


def _turn_faces(values: np.ndarray, is_turned: np.ndarray) -> np.ndarray:
    """Reverse the corner order [face, 3] of some faces."""
    flipped = np.where(is_turned[:, None], values[:, ::-1], values)
    flipped.setflags(write=False)
    return flipped
