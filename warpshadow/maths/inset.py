"""Inset: boundary vertices of flat regions of a mesh, moved inward, off adjacent faces.

A vertex where walls meet lies in the planes of all of them. For rays that leave it, rounding or winding would decide on
which side of another wall it is. Moved a little into its own wall, it is on the right side of the others.
"""

import numpy as np

from warpshadow.maths.adjacency import area_normals

_SHARE = 1e-3  # of the distance to the mean centroid of the faces of a vertex
_ROUNDING = 2.0**-16  # minimum distance over the largest coordinate: rays do not resolve less
_FLATNESS = 1e-6  # faces of a vertex are coplanar up to this 1 − cosine


def inset_vertices(positions: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Move vertices whose faces are coplanar towards the centroids of these faces.

    Args:
        positions: Shape [vertex, 3].
        faces: Indices of vertices, shape [face, 3]; faces that share no vertices are regions of their own.
    Returns:
        Positions, float32 of shape [vertex, 3]; vertices on bent surfaces stay.
    """
    points = np.asarray(positions, np.float64)
    corners = points[faces]
    normals = area_normals(corners)
    lengths = np.linalg.norm(normals, axis=1)
    has_area = lengths > 0
    faces, middles, normals = faces[has_area], corners[has_area].mean(axis=1), normals[has_area]
    normals /= lengths[has_area, None]
    offsets, first_normals = np.zeros_like(points), np.zeros_like(points)
    counts, is_flat = np.bincount(faces.ravel(), minlength=len(points)), np.ones(len(points), bool)
    for corner in faces.T:
        first_normals[corner] = normals  # of any face of the vertex
    for corner in faces.T:
        np.add.at(offsets, corner, middles - points[corner])
        is_flat[corner[np.abs((first_normals[corner] * normals).sum(axis=1)) < 1 - _FLATNESS]] = False
    offsets /= np.maximum(counts, 1)[:, None]
    # projected onto the tangent plane, so that points stay in nearly flat surfaces
    offsets -= (offsets * first_normals).sum(axis=1, keepdims=True) * first_normals
    distances = np.linalg.norm(offsets, axis=1)
    smallest = _ROUNDING * np.abs(points[faces]).max(initial=0.0)
    inset_shares = np.clip(smallest / np.maximum(distances, 1e-30), _SHARE, 0.5)
    is_moved = is_flat & (distances > 0)
    return (points + np.where(is_moved, inset_shares, 0.0)[:, None] * offsets).astype(np.float32)
