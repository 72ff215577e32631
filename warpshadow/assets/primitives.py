"""Primitives: planes, grounds and spheres."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from warpshadow import check
from warpshadow.assets.mesh import Mesh, MeshError


def plane(size: float | tuple[float, float] = 2.0, segments: int | tuple[int, int] = 64) -> Mesh:
    """Make a grid in the plane y = 0, centered at the origin, facing +y; :func:`infinite_ground` has no edge in sight.

    Args:
        size: Edge length along x and z [scene units], one for both or a pair.
        segments: Quads along x and z, one count for both or a pair; each quad is two triangles.
    Returns:
        The mesh; u runs along +x, v along -z, both from 0 to 1.
    """
    size_x, size_z = _pair(size)
    columns, rows = _pair(segments)
    if not all(check.is_number(edge) and edge > 0 for edge in (size_x, size_z)):
        raise MeshError(f"size: got {check.described(size)}, expected a positive number, or one for x and one for z")
    if not all(check.is_integer(count) and count > 0 for count in (columns, rows)):
        raise MeshError(
            f"segments: got {check.described(segments)}, expected a positive integer, or one for x and one for z"
        )
    v, u = np.meshgrid(np.linspace(0, 1, rows + 1), np.linspace(0, 1, columns + 1), indexing="ij")
    uvs = np.stack([u, v], axis=-1).reshape(-1, 2)
    positions = np.stack([(uvs[:, 0] - 0.5) * size_x, np.zeros(len(uvs)), (0.5 - uvs[:, 1]) * size_z], axis=-1)
    corner = np.arange((rows + 1) * (columns + 1)).reshape(rows + 1, columns + 1)
    a, b, c, d = corner[:-1, :-1], corner[:-1, 1:], corner[1:, 1:], corner[1:, :-1]
    faces = np.stack([a, b, c, a, c, d], axis=-1).reshape(-1, 3)
    return Mesh(positions, faces, uvs, faces, "plane")


_INFINITE_EXTENT = 1e4
"""Extent of an infinite ground, in sizes: seen from one size above, it ends 0.006 degrees below the horizon."""


def infinite_ground(size: float = 2.0, segments: int = 64, texture_size: float | None = None) -> Mesh:
    """Make a ground in the plane y = 0 that goes to the horizon, around the origin, facing +y.

    Its faces are fine where bodies stand, and yet few: of one size within a disc, and further out longer in proportion
    to their distance. It ends 10⁴ sizes away. Framings leave it out, as they do all flat bodies.

    Args:
        size: Diameter of the disc [scene units], such as the extent of the bodies on it with their shadows.
        segments: Faces around the origin, 8 to 4096: in the disc they are π size / segments long.
        texture_size: Edge length of a texture, which repeats [scene units]; None for no uvs.
    Returns:
        The mesh; a texture's middle is at the origin, u runs along +x, v along -z.
    """
    if not (check.is_number(size) and 0 < size <= check.LARGEST / _INFINITE_EXTENT):
        raise MeshError(f"size: got {check.described(size)}, expected a positive number of scene units")
    if not check.is_integer(segments) or not 8 <= segments <= 4096:
        raise MeshError(f"segments: got {check.described(segments)}, expected a whole number from 8 to 4096")
    if texture_size is not None and not (check.is_number(texture_size) and texture_size > 0):
        raise MeshError(f"texture_size: got {check.described(texture_size)}, expected a positive number of scene units")
    step = 2 * np.pi / segments
    inner = np.linspace(0, 0.5, round(1 / step) + 1)[1:]
    outer = np.geomspace(0.5, _INFINITE_EXTENT, int(np.ceil(np.log(2 * _INFINITE_EXTENT) / np.log1p(step))) + 1)[1:]
    radii = size * np.concatenate([inner, outer])
    angles = step * np.arange(segments)
    rim = np.stack([np.cos(angles), np.zeros(segments), -np.sin(angles)], axis=-1)
    positions = np.concatenate([np.zeros((1, 3)), (radii[:, None, None] * rim).reshape(-1, 3)])
    first = 1 + segments * np.arange(len(radii))
    indices, next_indices = np.arange(segments), np.roll(np.arange(segments), -1)
    fan = np.stack([np.zeros(segments, int), first[0] + indices, first[0] + next_indices], axis=-1)
    a, b = first[:-1, None] + indices, first[:-1, None] + next_indices
    c, d = first[1:, None] + indices, first[1:, None] + next_indices
    rings = np.stack([a, c, d, a, d, b], axis=-1).reshape(-1, 3)
    faces = np.concatenate([fan, rings])
    if texture_size is None:
        return Mesh(positions, faces, name="infinite_ground")
    return Mesh(positions, faces, positions[:, [0, 2]] / (texture_size, -texture_size) + 0.5, faces, "infinite_ground")


def _pair(value: Any) -> tuple[Any, Any]:
    """Two values, or one for both."""
    values = tuple(value) if isinstance(value, (Sequence, np.ndarray)) and not isinstance(value, str) else (value,)
    return values if len(values) == 2 else (value, value)  # the value itself is refused if it is several


def icosphere(radius: float = 1.0, subdivisions: int = 3) -> Mesh:
    """Make a sphere around the origin from an icosahedron whose faces are split in four, without uvs.

    Args:
        radius: Distance of the vertices from the origin [scene units].
        subdivisions: Number of splits s, 0 to 8: 10·4ˢ + 2 vertices and 20·4ˢ faces.
    """
    if not (check.is_number(radius) and radius > 0):
        raise MeshError(f"radius: got {check.described(radius)}, expected a positive number")
    if not check.is_integer(subdivisions) or subdivisions not in range(9):
        raise MeshError(f"subdivisions: got {subdivisions!r}, expected an integer from 0 to 8")
    # The twelve corners are the cyclic shifts of (0, ±1, ±golden); neighbors are 2 apart.
    golden = (1 + 5**0.5) / 2
    corners = np.array([(0, y, z * golden) for y in (-1, 1) for z in (-1, 1)])
    positions = np.concatenate([np.roll(corners, shift, axis=1) for shift in range(3)])
    is_neighbor = np.isclose(np.linalg.norm(positions[:, None] - positions, axis=-1), 2)
    triples = [
        (a, b, c)
        for a in range(12)
        for b in range(a)
        for c in range(b)
        if is_neighbor[a, b] and is_neighbor[b, c] and is_neighbor[a, c]
    ]
    faces = np.array([t if np.linalg.det(positions[list(t)]) > 0 else t[::-1] for t in triples])
    for _ in range(subdivisions):
        edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]], axis=-1).reshape(-1, 2)
        edges, middle_index = np.unique(edges, axis=0, return_inverse=True)
        ab, bc, ca = middle_index.reshape(-1, 3).T + len(positions)
        a, b, c = faces.T
        positions = np.concatenate([positions, positions[edges].mean(axis=1)])
        faces = np.stack([a, ab, ca, ab, b, bc, ca, bc, c, ab, bc, ca], axis=1).reshape(-1, 3)
        positions /= np.linalg.norm(positions, axis=1, keepdims=True)
    return Mesh(positions * (radius / np.linalg.norm(positions, axis=1, keepdims=True)), faces, name="icosphere")
