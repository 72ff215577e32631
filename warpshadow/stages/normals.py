"""Normals: smooth vertex normals, weighted by the area of faces."""

from __future__ import annotations

import warp as wp

from warpshadow import check
from warpshadow.device.launch import launch

_THINNEST = 1.0e-12  # faces of a smaller height, in their length, have no area: there gradients could overflow
_SHORTEST = 1.0e-20  # so have faces of shorter edges [scene units]


@wp.kernel
def _sum_face_normals(
    # in
    positions: wp.array2d(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    # out
    sums: wp.array2d(dtype=wp.vec3d),
):
    """A thread adds the normal of one face, as long as twice its area, to its three vertices."""
    batch, face = wp.tid()
    i, j, k = faces[face][0], faces[face][1], faces[face][2]
    origin = wp.vec3d(positions[batch, i])
    along_j = wp.vec3d(positions[batch, j]) - origin
    along_k = wp.vec3d(positions[batch, k]) - origin
    normal = wp.cross(along_j, along_k)
    longest2 = wp.max(wp.dot(along_j, along_j), wp.dot(along_k, along_k))
    if wp.length(normal) > wp.float64(_THINNEST) * longest2 and longest2 > wp.float64(_SHORTEST * _SHORTEST):
        wp.atomic_add(sums, batch, i, normal)
        wp.atomic_add(sums, batch, j, normal)
        wp.atomic_add(sums, batch, k, normal)


@wp.kernel
def _normalize(
    # in
    sums: wp.array2d(dtype=wp.vec3d),
    # out
    normals: wp.array2d(dtype=wp.vec3),
):
    """A thread normalizes one vertex; zero stays zero, with a zero gradient."""
    batch, vertex = wp.tid()
    normals[batch, vertex] = wp.vec3(wp.normalize(sums[batch, vertex]))


def vertex_normals(positions: wp.array, faces: wp.array) -> wp.array:
    """Compute unit vertex normals, faces weighted by their area.

        n_v = normalize(Σ_{faces at v} (x_j − x_i) × (x_k − x_i))

    Sums are float64, since areas are squares, and lengths of normals those of areas: a mesh may have any scale. On a
    GPU their order, so their last bits, may differ between runs; see ``wp.config.deterministic``.

    Args:
        positions: Vertex positions [scene units], vec3, shape [batch, vertex].
        faces: Vertex indices, counter-clockwise seen from outside, vec3i, shape [face].

    Returns:
        Normals, vec3, shape [batch, vertex]; zero where the faces have no area or the vertex has no face.

    Raises:
        ValueError: for NaN, Inf and positions beyond 1e18.

    Differentiable: positions (with a zero gradient where the normal is zero). Not: faces.
    """
    check.finite_arrays({"positions": positions})
    device, shape = positions.device, positions.shape
    sums, normals = wp.zeros(shape, dtype=wp.vec3d, device=device), wp.empty(shape, dtype=wp.vec3, device=device)
    launch(_sum_face_normals, (shape[0], faces.shape[0]), inputs=[positions, faces], outputs=[sums])
    launch(_normalize, shape, inputs=[sums], outputs=[normals])
    return normals
