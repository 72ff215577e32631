"""Normals: smooth vertex normals, weighted by the area of faces."""

from dataclasses import dataclass

import numpy as np
import warp as wp

from warpshadow.device.array_checks import finite_arrays
from warpshadow.device.launch import launch_with_adjoint
from warpshadow.device.memory import empty
from warpshadow.device.parallel import split_row

_MIN_HEIGHT = 1.0e-12  # faces of a smaller height, in their length, have no area: there gradients could overflow
_MIN_EDGE = 1.0e-20  # so have faces of shorter edges [scene units]

_COST, _ADJOINT_COST = 60.0, 110.0  # nanoseconds that a vertex of six faces takes


@dataclass(frozen=True, eq=False)
class OneRings:
    """The faces around each vertex, lower indices first."""

    starts: wp.array  # where the faces of each vertex begin, and the end of the last, int32 of shape [vertex + 1]
    faces: wp.array  # vertex indices of each, vec3i

    @staticmethod
    def of_faces(faces: np.ndarray, vertex_count: int, *, device: wp.DeviceLike) -> "OneRings":
        """Find the rings of ``vertex_count`` vertices from faces [face, 3]."""
        corners = faces.ravel()
        starts = np.cumsum([0, *np.bincount(corners, minlength=vertex_count)])
        faces = faces[np.argsort(corners, kind="stable") // 3]
        return OneRings(*(wp.array(a, dtype=t, device=device) for a, t in ((starts, wp.int32), (faces, wp.vec3i))))


@wp.func
def _edge_vectors(positions: wp.array(dtype=wp.vec3), corners: wp.vec3i):
    """Edge vectors from the first corner of a face to the others."""
    origin = wp.vec3d(positions[corners[0]])
    return wp.vec3d(positions[corners[1]]) - origin, wp.vec3d(positions[corners[2]]) - origin


@wp.func
def _has_area(edge_j: wp.vec3d, edge_k: wp.vec3d, normal: wp.vec3d):
    longest2 = wp.max(wp.dot(edge_j, edge_j), wp.dot(edge_k, edge_k))
    is_long = longest2 > wp.float64(_MIN_EDGE * _MIN_EDGE)
    return is_long and wp.dot(normal, normal) > wp.float64(_MIN_HEIGHT * _MIN_HEIGHT) * longest2 * longest2


@wp.kernel(enable_backward=False)
def _find_normals(
    first_row: int,
    worker: int,
    # in
    positions: wp.array2d(dtype=wp.vec3),
    starts: wp.array(dtype=wp.int32),
    faces: wp.array(dtype=wp.vec3i),
    # out
    inverse_lengths: wp.array2d(dtype=wp.float64),
    normals: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a vertex: it adds up the normals of its faces, as long as twice their area; zero stays zero."""
    batch, vertex = split_row(first_row + wp.tid(), positions.shape[1])
    points = positions[batch]
    normal_sum = wp.vec3d()
    for face in range(starts[vertex], starts[vertex + 1]):
        edge_j, edge_k = _edge_vectors(points, faces[face])
        normal = wp.cross(edge_j, edge_k)
        normal_sum += wp.where(_has_area(edge_j, edge_k, normal), wp.float64(1.0), wp.float64(0.0)) * normal
    length = wp.length(normal_sum)
    inverse_length = wp.where(length > wp.float64(0.0), wp.float64(1.0) / length, wp.float64(0.0))
    inverse_lengths[batch, vertex] = inverse_length
    normals[batch, vertex] = wp.vec3(inverse_length * normal_sum)


@wp.func
def _normalize_adjoint(normal: wp.vec3, inverse_length: wp.float64, adj_normal: wp.vec3):
    """The adjoint of a sum by its direction:  s̄ = (n̄ − n n·n̄) / |s|, zero where s is."""
    return inverse_length * wp.vec3d(adj_normal - wp.dot(normal, adj_normal) * normal)


@wp.kernel(enable_backward=False)
def _find_normals_adjoint(
    first_row: int,
    worker: int,
    # in
    positions: wp.array2d(dtype=wp.vec3),
    starts: wp.array(dtype=wp.int32),
    faces: wp.array(dtype=wp.vec3i),
    inverse_lengths: wp.array2d(dtype=wp.float64),
    normals: wp.array2d(dtype=wp.vec3),
    adj_normals: wp.array2d(dtype=wp.vec3),
    # out
    adj_positions: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a vertex:  with n = (x_j − x_i) × (x_k − x_i),  x̄_i = Σ (x_j − x_k) × n̄,  n̄ = s̄_i + s̄_j + s̄_k."""
    batch, vertex = split_row(first_row + wp.tid(), positions.shape[1])
    points = positions[batch]
    adj_sum = _normalize_adjoint(normals[batch, vertex], inverse_lengths[batch, vertex], adj_normals[batch, vertex])
    adj_position = wp.vec3d()
    for face in range(starts[vertex], starts[vertex + 1]):
        corners = faces[face]
        edge_j, edge_k = _edge_vectors(points, corners)
        if _has_area(edge_j, edge_k, wp.cross(edge_j, edge_k)):
            i = wp.where(vertex == corners[0], 0, wp.where(vertex == corners[1], 1, 2))
            j = corners[(i + 1) % 3]
            k = corners[(i + 2) % 3]
            adj_normal = (
                adj_sum
                + _normalize_adjoint(normals[batch, j], inverse_lengths[batch, j], adj_normals[batch, j])
                + _normalize_adjoint(normals[batch, k], inverse_lengths[batch, k], adj_normals[batch, k])
            )
            adj_position += wp.cross(wp.vec3d(points[j]) - wp.vec3d(points[k]), adj_normal)
    adj_positions[batch, vertex] += wp.vec3(adj_position)


def vertex_normals(positions: wp.array, faces: wp.array | OneRings) -> wp.array:
    """Compute unit vertex normals, faces weighted by their area.

        n_v = normalize(Σ_{faces at v} (x_j − x_i) × (x_k − x_i))

    Sums are float64, since areas are squares of lengths: a mesh may have any scale.

    Args:
        positions: Vertex positions [scene units], vec3, shape [batch, vertex].
        faces: Vertex indices, counter-clockwise seen from outside, vec3i, shape [face], which are read back; or their
            one-rings, to be found once.
    Returns:
        Normals, vec3, shape [batch, vertex]; zero where the faces have no area or the vertex has no face.
    Raises:
        ValueError: for NaN, Inf and positions beyond 1e18.
    Differentiable: positions (with a zero gradient where the normal is zero). Not: faces.
    """
    finite_arrays({"positions": positions})
    device, shape = positions.device, positions.shape
    rings = faces if isinstance(faces, OneRings) else OneRings.of_faces(faces.numpy(), shape[1], device=device)
    inverse_lengths, normals = (empty(shape, dtype=dtype, device=device) for dtype in (wp.float64, wp.vec3))
    return launch_with_adjoint(
        _find_normals,
        _find_normals_adjoint,
        positions.size,
        inputs=[positions, rings.starts, rings.faces],
        outputs=[inverse_lengths],
        result=normals,
        adj_inputs=[inverse_lengths, normals],
        variables=[positions],
        cost=_COST,
        adj_cost=_ADJOINT_COST,
    )
