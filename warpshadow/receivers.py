"""Receivers: the points at which light is evaluated, and how the samples of an image get theirs from them.

They are the vertices, and for bodies that want it the points that the samples see.
"""

from typing import NamedTuple

import numpy as np
import warp as wp

from warpshadow.batch import common_batch
from warpshadow.raster import Fragments
from warpshadow.tape import launch


class Receivers(NamedTuple):
    """Receivers of every instance."""

    points: wp.array  # [batch, receiver] vec3
    normals: wp.array  # [batch, receiver] vec3
    faces: wp.array  # [face + own] vec3i, indices of receivers
    of_vertices: wp.array  # [vertex] int32, -1 for none
    fragments: Fragments  # a sample with a receiver of its own sees one of the added faces, whose corners are all it


@wp.kernel
def _gather(
    # in
    positions: wp.array2d(dtype=wp.vec3),
    normals: wp.array2d(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    face_ids: wp.array2d(dtype=wp.int32),
    barycentrics: wp.array2d(dtype=wp.vec3),
    vertices: wp.array(dtype=wp.int32),
    samples: wp.array2d(dtype=wp.int32),
    # out
    points: wp.array2d(dtype=wp.vec3),
    point_normals: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a receiver: a vertex, or a sample's point, −1 for none."""
    batch, receiver = wp.tid()
    instance = wp.min(batch, positions.shape[0] - 1)
    own = receiver - vertices.shape[0]
    corners = faces[0]
    weights = wp.vec3(1.0, 0.0, 0.0)
    if own < 0:
        vertex = vertices[receiver]
        corners = wp.vec3i(vertex, vertex, vertex)
    elif samples[batch, own] >= 0:
        corners = faces[face_ids[batch, samples[batch, own]]]
        weights = barycentrics[batch, samples[batch, own]]
    i = corners[0]
    j = corners[1]
    k = corners[2]
    points[batch, receiver] = (
        weights[0] * positions[instance, i] + weights[1] * positions[instance, j] + weights[2] * positions[instance, k]
    )
    point_normals[batch, receiver] = wp.normalize(
        weights[0] * normals[instance, i] + weights[1] * normals[instance, j] + weights[2] * normals[instance, k]
    )


@wp.kernel
def _weigh_own(
    # in
    is_own: wp.array(dtype=wp.bool),
    barycentrics: wp.array(dtype=wp.vec3),
    # out
    weights: wp.array(dtype=wp.vec3),
):
    """A thread owns a sample; all of the weight is on the first corner where the receiver is its own."""
    sample = wp.tid()
    if is_own[sample]:
        weights[sample] = wp.vec3(1.0, 0.0, 0.0)
    else:
        weights[sample] = barycentrics[sample]


def find_receivers(
    positions: wp.array,
    normals: wp.array,
    faces: wp.array,
    fragments: Fragments,
    keeps_vertex: np.ndarray,
    wants_samples: np.ndarray,
) -> Receivers:
    """Gather the points at which light is evaluated.

    Args:
        positions: Vertices [scene units], vec3 of shape [batch, vertex].
        normals: Unit normals of the vertices, vec3 of shape [batch, vertex].
        faces: Vertex indices, vec3i of shape [face].
        fragments: What each sample sees, one batch for all or one each.
        keeps_vertex: Which vertices are receivers, bool of shape [vertex].
        wants_samples: Faces whose samples have receivers of their own, bool of shape [face].

    Differentiable: positions, normals, barycentrics of the fragments.
    """
    if not wants_samples.any():
        every = wp.array(np.arange(len(keeps_vertex)), dtype=wp.int32, device=positions.device)
        return Receivers(positions, normals, faces, every, fragments)
    device = positions.device
    face_ids = fragments.face_ids.numpy()
    is_own = (face_ids >= 0) & wants_samples[face_ids]
    samples, own_counts = _ragged(is_own.reshape(len(is_own), -1))
    vertices = np.flatnonzero(keeps_vertex)
    own_faces = np.repeat(np.arange(len(vertices), len(vertices) + samples.shape[1])[:, None], 3, axis=1)
    receiver_of_vertex = np.maximum(np.cumsum(keeps_vertex) - 1, 0)
    own_face_ids = face_ids.copy()
    own_face_ids[is_own] = len(wants_samples) + np.concatenate([np.arange(count) for count in own_counts])

    batch_count = common_batch({"positions": positions, "fragments": fragments.face_ids})
    samples = np.repeat(samples, batch_count // len(samples), axis=0)
    shape = batch_count, len(vertices) + samples.shape[1]
    variables = [positions, normals, fragments.barycentrics]
    requires_grad = any(array.requires_grad for array in variables)
    points, point_normals = (
        wp.empty(shape, dtype=wp.vec3, device=device, requires_grad=requires_grad) for _ in range(2)
    )
    weights = wp.empty(
        fragments.barycentrics.shape,
        dtype=wp.vec3,
        device=device,
        requires_grad=fragments.barycentrics.requires_grad,
    )
    flat = len(face_ids), is_own[0].size
    launch(
        _gather,
        dim=shape,
        inputs=[
            positions,
            normals,
            faces,
            fragments.face_ids.reshape(flat),
            fragments.barycentrics.reshape(flat),
            wp.array(vertices, dtype=wp.int32, device=device),
            wp.array(samples, dtype=wp.int32, device=device),
        ],
        outputs=[points, point_normals],
        device=device,
    )
    launch(
        _weigh_own,
        dim=weights.size,
        inputs=[wp.array(is_own.ravel(), dtype=wp.bool, device=device), fragments.barycentrics.flatten()],
        outputs=[weights.flatten()],
        device=device,
    )
    all_faces = np.concatenate([receiver_of_vertex[faces.numpy()], own_faces])
    return Receivers(
        points,
        point_normals,
        wp.array(all_faces, dtype=wp.vec3i, device=device),
        wp.array(np.where(keeps_vertex, receiver_of_vertex, -1), dtype=wp.int32, device=device),
        Fragments(wp.array(own_face_ids, dtype=wp.int32, device=device), weights),
    )


def _ragged(chosen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Columns that are chosen in each row, −1 after the last: [row, most of a row], and how many."""
    counts = chosen.sum(axis=1)
    columns = np.full((len(chosen), counts.max()), -1)
    row, column = np.nonzero(chosen)
    columns[row, np.concatenate([np.arange(count) for count in counts])] = column
    return columns, counts
