"""Unwrapping: texture coordinates for a mesh that has none."""

from dataclasses import replace

import numpy as np

from warpshadow import check
from warpshadow.assets.mesh import Mesh, MeshError
from warpshadow.maths.adjacency import area_normals, edge_neighbors
from warpshadow.maths.components import connected_components


def unwrap(mesh: Mesh, *, size: int = 1024, padding: int = 4) -> Mesh:
    """Give a mesh uvs of its own: cut it into charts and lay them out side by side, with xatlas.

    Positions and faces stay as they are: a vertex on the edge of a chart has several uvs. Faces without area lie on a
    point of the texture.

    Args:
        mesh: The mesh; uvs that it has are replaced.
        size: Width and height of the texture that the uvs are meant for [texels].
        padding: Least distance between charts [texels]: half of it is how far a filter may reach beyond its chart.
    Returns:
        The mesh with uvs from 0 to 1.
    Raises:
        ImportError: when xatlas, the extra ``unwrap``, is not installed.
    """
    check.importable("xatlas", "unwrapping", "xatlas", "unwrap")
    import xatlas

    if not (isinstance(size, int) and isinstance(padding, int) and 0 <= padding < size):
        raise MeshError(f"size, padding: got {size} and {padding}, expected integers with 0 <= padding < size")
    positions = _to_unit_edges(mesh)
    pieces = _pieces(positions[mesh.faces], edge_neighbors(mesh.faces, mesh.positions))
    atlas = xatlas.Atlas()
    for piece in pieces:
        atlas.add_mesh(positions, mesh.faces[piece].astype(np.uint32))
    options = xatlas.PackOptions()
    options.resolution, options.padding = size, padding
    atlas.generate(pack_options=options)
    if not atlas.atlas_count:  # no face has an area
        return replace(mesh, uvs=np.zeros((1, 2), np.float32), uv_faces=np.zeros_like(mesh.faces))
    uvs: list[np.ndarray] = []
    uv_faces = np.empty_like(mesh.faces)
    for number, piece in enumerate(pieces):
        _, uv_faces_of_piece, uvs_of_piece = atlas[number]
        uv_faces[piece] = uv_faces_of_piece + sum(map(len, uvs))
        uvs.append(uvs_of_piece)
    return replace(mesh, uvs=np.concatenate(uvs), uv_faces=uv_faces)


def _to_unit_edges(mesh: Mesh) -> np.ndarray:
    """Vertices of the mesh scaled to edges of length 1: xatlas ignores faces that are small in its units."""
    corners = mesh.positions[mesh.faces].astype(np.float64)
    lengths = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1)
    center = np.mean(mesh.bounds, axis=0, dtype=np.float64)
    return ((mesh.positions - center) / (np.median(lengths) or 1.0)).astype(np.float32)


# Cosines: of the angle between faces that may count as flat (2.6°; xatlas takes 0.8°), and of that within a flat part.
_FLAT_COSINE = 0.999
_SAME_SIDE = 0.5


def _pieces(corners: np.ndarray, neighbors: np.ndarray) -> list[np.ndarray]:
    """Faces [face, 3, 3] that xatlas may chart at once, given the neighbors across their edges: all of them, as a rule.

    It cuts nothing where neighbors are all but coplanar, and crashes where these close around a round, finely
    tessellated body. Such a mesh comes in six pieces, by the axis that a face looks along.
    """
    normals = area_normals(corners.astype(np.float64))
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    face, edge = np.nonzero(neighbors >= 0)
    other = neighbors[face, edge]
    is_flat = np.sum(normals[face] * normals[other], axis=1) > _FLAT_COSINE
    part = connected_components(face[is_flat], other[is_flat], len(normals))
    means = np.zeros((part.max() + 1, 3))
    np.add.at(means, part, normals)
    cosines = np.sum(normals * means[part], axis=1)
    if (cosines >= _SAME_SIDE * np.linalg.norm(means[part], axis=1)).all():
        return [np.arange(len(normals))]
    axis = np.abs(normals).argmax(axis=1)
    side = 2 * axis + (np.take_along_axis(normals, axis[:, None], axis=1)[:, 0] > 0)
    return [np.flatnonzero(side == number) for number in np.unique(side)]
