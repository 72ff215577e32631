"""Inset: vertices on the borders of flat parts of a mesh, moved into these parts, off the faces that border on them.

A vertex where walls meet lies in the planes of all of them. Which side of another wall it is on, to rays that leave
there, would be a matter of rounding or of winding. A little farther inside its own wall it is on the side of that wall.
"""

import numpy as np

from warpshadow.maths.adjacency import area_normals

_SHARE = 1e-3  # of the way to the middles of the faces around a vertex
_ROUNDING = 2.0**-16  # distance at least, as a share of the largest coordinate: rays take less for none
_FLATNESS = 1e-6  # 1 − cosine between the faces around a vertex, up to which they are flat


def inset_vertices(positions: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Move vertices towards the middles of the faces around them, where these lie in one plane.

    Args:
        positions: Shape [vertex, 3].
        faces: Indices of vertices, shape [face, 3]; faces with vertices of their own have borders of their own.
    Returns:
        Positions, float32 of shape [vertex, 3]; those of vertices on bent surfaces are the same.
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
        first_normals[corner] = normals  # of any of its faces
    for corner in faces.T:
        np.add.at(offsets, corner, middles - points[corner])
        is_flat[corner[np.abs((first_normals[corner] * normals).sum(axis=1)) < 1 - _FLATNESS]] = False
    offsets /= np.maximum(counts, 1)[:, None]
    # into the tangent plane, so that points stay in surfaces that are all but flat
    offsets -= (offsets * first_normals).sum(axis=1, keepdims=True) * first_normals
    distances = np.linalg.norm(offsets, axis=1)
    smallest = _ROUNDING * np.abs(points[faces]).max(initial=0.0)
    inset_shares = np.clip(smallest / np.maximum(distances, 1e-30), _SHARE, 0.5)
    is_moved = is_flat & (distances > 0)
    return (points + np.where(is_moved, inset_shares, 0.0)[:, None] * offsets).astype(np.float32)
