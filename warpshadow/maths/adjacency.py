"""Triangles: normals, solid angles, edges, adjacency, and vertices that share a position."""

import numpy as np

from warpshadow import check

_NOT_MANIFOLD = -2


def area_normals(corners: np.ndarray) -> np.ndarray:
    """Normals of triangles, of twice their area in length, given corners [triangle, 3, 3]; shape [triangle, 3]."""
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def solid_angles(corners: np.ndarray) -> np.ndarray:
    """Solid angles of triangles from the origin [Van Oosterom and Strackee 1983].

    Args:
        corners: float64 of shape [triangle, 3, 3].
    Returns:
        Of each triangle, −2π to 2π, positive where its back is seen; shape [triangle]. The solid angles of a closed
        mesh that faces outwards add up to 4π inside and to 0 outside.
    """
    a, b, c = np.moveaxis(corners, 1, 0)
    length_a, length_b, length_c = np.moveaxis(np.linalg.norm(corners, axis=2), 1, 0)
    numerator = (a * np.cross(b, c)).sum(axis=1)
    denominator = length_a * length_b * length_c
    denominator += (a * b).sum(axis=1) * length_c + (b * c).sum(axis=1) * length_a + (c * a).sum(axis=1) * length_b
    return 2 * np.arctan2(numerator, denominator)


def edges_of(triangles: np.ndarray) -> np.ndarray:
    """Directed edges of triangles, shape [3 triangle, 2]: edges from all first corners come first."""
    return np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])


def edge_neighbors(faces: np.ndarray, positions: np.ndarray | None = None) -> np.ndarray:
    """Find the face on the other side of each edge.

    Args:
        faces: Indices of positions, shape [face, 3]: faces are joined where edges share positions, whatever the uvs.
        positions: Vertices, shape [vertex, 3]; when given, vertices at one position count as one, for
            meshes whose faces share no vertices.
    Returns:
        Face across the edges opposite to corners 0, 1 and 2, int32 of shape [face, 3]; −1 at a boundary, −2 at
        non-manifold edges. Both are silhouettes from everywhere. Degenerate faces, with two corners at one position,
        neither are neighbors nor have any.
    """
    check.shape("faces", faces.shape, ("face", 3))
    faces = faces.astype(np.int64) if positions is None else number_positions(positions)[faces]
    neighbor = np.full(faces.shape, -1, np.int32)
    proper = np.flatnonzero((faces != np.roll(faces, 1, axis=1)).all(axis=1))
    edge_ends = np.sort(
        np.stack([np.roll(faces[proper], -1, axis=1), np.roll(faces[proper], -2, axis=1)], axis=-1), axis=-1
    )
    first, last = edge_ends.reshape(-1, 2).T
    lines, edge_faces = first * (faces.max(initial=0) + 1) + last, np.repeat(proper, 3)
    permutation = np.argsort(lines)
    is_next = np.zeros(len(lines) + 2, bool)  # of the same edge as the one before
    is_next[1:-2] = lines[permutation[1:]] == lines[permutation[:-1]]
    neighbors = np.full(len(lines), -1, np.int32)
    neighbors[permutation[is_next[:-2] | is_next[1:-1]]] = _NOT_MANIFOLD
    pair_starts = np.flatnonzero(~is_next[:-2] & is_next[1:-1] & ~is_next[2:])
    one, other = permutation[pair_starts], permutation[pair_starts + 1]
    neighbors[one], neighbors[other] = edge_faces[other], edge_faces[one]
    neighbor[proper] = neighbors.reshape(-1, 3)
    return neighbor


def number_positions(positions: np.ndarray) -> np.ndarray:
    """Number distinct positions, or rows of any width: equal ones share a number, shape [vertex]."""
    permutation = np.lexsort(positions.T)
    is_new = (np.diff(positions[permutation], axis=0) != 0).any(axis=1)
    position_ids = np.zeros(len(positions), np.int64)
    position_ids[permutation[1:]] = np.cumsum(is_new)
    return position_ids
