"""Normals: smooth vertex normals, weighted by the area of faces."""

import warp as wp

from warpshadow.device.array_checks import finite_arrays
from warpshadow.device.launch import differentiable, launch
from warpshadow.device.memory import empty, zeros

_MIN_HEIGHT = 1.0e-12  # faces of a smaller height, in their length, have no area: there gradients could overflow
_MIN_EDGE = 1.0e-20  # so have faces of shorter edges [scene units]

_FACE_COST, _VERTEX_COST = 15.0, 6.0  # nanoseconds that a face and a vertex take. Instances are shared by threads


@wp.func
def _edge_vectors(positions: wp.array(dtype=wp.vec3), corners: wp.vec3i):
    """Edge vectors from the first corner of a face to the others."""
    origin = wp.vec3d(positions[corners[0]])
    return wp.vec3d(positions[corners[1]]) - origin, wp.vec3d(positions[corners[2]]) - origin


@wp.func
def _has_area(edge_j: wp.vec3d, edge_k: wp.vec3d, normal: wp.vec3d):
    longest2 = wp.max(wp.dot(edge_j, edge_j), wp.dot(edge_k, edge_k))
    is_long = longest2 > wp.float64(_MIN_EDGE * _MIN_EDGE)
    return is_long and wp.length(normal) > wp.float64(_MIN_HEIGHT) * longest2


@wp.kernel(enable_backward=False)
def _sum_face_normals(
    first_row: int,
    worker: int,
    # in
    positions: wp.array2d(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    # out
    sums: wp.array2d(dtype=wp.vec3d),
):
    """A thread adds the normal of one face, as long as twice its area, to its three vertices."""
    row, face = wp.tid()
    batch = first_row + row
    corners = faces[face]
    edge_j, edge_k = _edge_vectors(positions[batch], corners)
    normal = wp.cross(edge_j, edge_k)
    if _has_area(edge_j, edge_k, normal):
        for corner in range(3):
            wp.atomic_add(sums, batch, corners[corner], normal)


@wp.kernel(enable_backward=False)
def _sum_face_normals_adjoint(
    first_row: int,
    worker: int,
    # in
    positions: wp.array2d(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    adj_sums: wp.array2d(dtype=wp.vec3d),
    # out
    adj_positions: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a face:  with n = u × v,  ū = v × n̄,  v̄ = n̄ × u."""
    row, face = wp.tid()
    batch = first_row + row
    corners = faces[face]
    edge_j, edge_k = _edge_vectors(positions[batch], corners)
    if _has_area(edge_j, edge_k, wp.cross(edge_j, edge_k)):
        adj_normal = adj_sums[batch, corners[0]] + adj_sums[batch, corners[1]] + adj_sums[batch, corners[2]]
        adj_edge_j = wp.cross(edge_k, adj_normal)
        adj_edge_k = wp.cross(adj_normal, edge_j)
        wp.atomic_sub(adj_positions, batch, corners[0], wp.vec3(adj_edge_j + adj_edge_k))
        wp.atomic_add(adj_positions, batch, corners[1], wp.vec3(adj_edge_j))
        wp.atomic_add(adj_positions, batch, corners[2], wp.vec3(adj_edge_k))


@wp.kernel(enable_backward=False)
def _normalize(
    first_row: int,
    worker: int,
    # in
    sums: wp.array2d(dtype=wp.vec3d),
    # out
    normals: wp.array2d(dtype=wp.vec3),
):
    """A thread normalizes one vertex; zero stays zero."""
    row, vertex = wp.tid()
    batch = first_row + row
    normals[batch, vertex] = wp.vec3(wp.normalize(sums[batch, vertex]))


@wp.kernel(enable_backward=False)
def _normalize_adjoint(
    first_row: int,
    worker: int,
    # in
    sums: wp.array2d(dtype=wp.vec3d),
    adj_normals: wp.array2d(dtype=wp.vec3),
    # out
    adj_sums: wp.array2d(dtype=wp.vec3d),
):
    """A thread owns a vertex:  s̄ = (n̄ − n n·n̄) / |s|, zero where s is."""
    row, vertex = wp.tid()
    batch = first_row + row
    normal_sum = sums[batch, vertex]
    adj_normal = wp.vec3d()
    length = wp.length(normal_sum)
    if length > wp.float64(0.0):
        normal = normal_sum / length
        adj_normal = wp.vec3d(adj_normals[batch, vertex])
        adj_normal = (adj_normal - wp.dot(normal, adj_normal) * normal) / length
    adj_sums[batch, vertex] = adj_normal


def vertex_normals(positions: wp.array, faces: wp.array) -> wp.array:
    """Compute unit vertex normals, faces weighted by their area.

        n_v = normalize(Σ_{faces at v} (x_j − x_i) × (x_k − x_i))

    Sums are float64, since areas are squares of lengths: a mesh may have any scale. On a
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
    finite_arrays({"positions": positions})
    device, shape = positions.device, positions.shape
    sums = zeros(shape, dtype=wp.vec3d, device=device, outlives_recording=False)
    face_dim, vertex_dim = (shape[0], faces.shape[0]), shape

    def forward(normals: wp.array) -> None:
        launch(_sum_face_normals, face_dim, inputs=[positions, faces], outputs=[sums], cost=_FACE_COST)
        launch(_normalize, vertex_dim, inputs=[sums], outputs=[normals], cost=_VERTEX_COST)

    def adjoint(adj_normals: wp.array) -> None:
        adj_sums = empty(shape, dtype=wp.vec3d, device=device)
        launch(_normalize_adjoint, vertex_dim, inputs=[sums, adj_normals], outputs=[adj_sums], cost=_VERTEX_COST)
        inputs = [positions, faces, adj_sums]
        launch(_sum_face_normals_adjoint, face_dim, inputs=inputs, outputs=[positions.grad], cost=2 * _FACE_COST)

    return differentiable(forward, adjoint, empty(shape, dtype=wp.vec3, device=device), variables=[positions])
