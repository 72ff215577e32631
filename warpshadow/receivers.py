"""Receivers: the points at which light is evaluated, and how the samples of an image get theirs from them.

They are the vertices of what is seen, and for bodies that want it the points that the samples see. Where a surface is
seen from behind (:mod:`warpshadow.sides`), they are others, at the same places, with opposite normals.
"""

from typing import NamedTuple

import numpy as np
import warp as wp

from warpshadow.batch import common_batch, rows
from warpshadow.constants import constant
from warpshadow.raster import Fragments
from warpshadow.silhouette import Silhouettes
from warpshadow.tape import launch


class Receivers(NamedTuple):
    """Receivers of every instance."""

    points: wp.array  # [batch, receiver − still] vec3
    normals: wp.array  # [batch, receiver − still] vec3
    faces: wp.array  # [face or side + own] vec3i, indices of receivers
    of_vertices: wp.array  # [vertex, and their backs if any is seen] int32, -1 for none
    fragments: Fragments  # a sample with a receiver of its own sees one of the added faces, whose corners are all it
    still: np.ndarray = np.empty(0, int)  # [still], vertices that are the first receivers; points are of those after


@wp.func
def _outward(number: int, count: int):
    """Sign of the normal of a side of a face or of a vertex, of which there are ``count``."""
    return wp.where(number < count, 1.0, -1.0)


@wp.kernel
def _gather(
    # in
    positions: wp.array2d(dtype=wp.vec3),
    normals: wp.array2d(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    sides: wp.array2d(dtype=wp.int32),
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
    if own < 0:
        vertex = vertices[receiver] % positions.shape[1]
        points[batch, receiver] = positions[instance, vertex]
        point_normals[batch, receiver] = _outward(vertices[receiver], positions.shape[1]) * normals[instance, vertex]
    else:
        side = int(0)
        weights = wp.vec3(1.0, 0.0, 0.0)
        view = wp.min(batch, sides.shape[0] - 1)
        sample = samples[view, own]
        if sample >= 0:
            side = sides[view, sample]
            weights = barycentrics[view, sample]
        corners = faces[side % faces.shape[0]]
        i = corners[0]
        j = corners[1]
        k = corners[2]
        points[batch, receiver] = (
            weights[0] * positions[instance, i]
            + weights[1] * positions[instance, j]
            + weights[2] * positions[instance, k]
        )
        point_normals[batch, receiver] = _outward(side, faces.shape[0]) * wp.normalize(
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
    is_still: np.ndarray | None = None,
    order: np.ndarray | None = None,
) -> Receivers:
    """Gather the points at which light is evaluated.

    Args:
        positions: Vertices [scene units], vec3 of shape [batch, vertex].
        normals: Unit normals of the vertices, vec3 of shape [batch, vertex].
        faces: Vertex indices, vec3i of shape [face].
        fragments: What each sample sees, one batch for all or one each.
        keeps_vertex: Which vertices are receivers, bool of shape [vertex]: all of those of a face that a sample sees,
            unless the face wants samples; see :func:`seen_vertices`. Where fragments have sides, their backs follow.
        wants_samples: Faces whose samples have receivers of their own, bool of shape [face].
        is_still: Vertices that stand still, bool of shape [vertex]; None where any may move.
        order: Order in which vertices become receivers, shape [vertex]: light is found fastest for neighbors side by
            side. None for their own.

    Returns:
        Receivers; where no face wants samples, many views of one geometry share them.

    Differentiable: positions, normals, barycentrics of the fragments.
    """
    device = positions.device
    has_own = wants_samples.any()
    if not has_own and keeps_vertex.all() and is_still is None and order is None and fragments.sides is None:
        return Receivers(positions, normals, faces, constant(np.arange(len(keeps_vertex)), wp.int32, device), fragments)
    count, corners, sides = positions.shape[1], faces.numpy(), fragments.face_ids
    is_still = np.zeros(count, bool) if is_still is None else is_still
    order = np.arange(count) if order is None else order
    if fragments.sides is not None:
        sides = fragments.sides
        is_still, order = np.tile(is_still, 2), np.concatenate([order, order + count])
        corners, wants_samples = np.concatenate([corners, corners + count]), np.tile(wants_samples, 2)
    still, vertices = order[(keeps_vertex & is_still)[order]], order[(keeps_vertex & ~is_still)[order]]
    vertex_count = len(still) + len(vertices)
    samples = np.empty((len(sides), 0), int)
    batch_count = len(positions)
    receiver_of_vertex = np.full(len(keeps_vertex), -1, np.int32)
    receiver_of_vertex[np.concatenate([still, vertices])] = np.arange(vertex_count)
    receiver_faces = receiver_of_vertex[corners]
    receiver_fragments = fragments if fragments.sides is None else Fragments(sides, fragments.barycentrics)
    if has_own:
        batch_count = common_batch({"positions": positions, "fragments": sides})
        samples, receiver_fragments = _own_samples(receiver_fragments, wants_samples)
        own_faces = np.repeat(vertex_count + np.arange(samples.shape[1])[:, None], 3, axis=1)
        receiver_faces = np.concatenate([receiver_faces, own_faces])
    variables = [positions, normals, fragments.barycentrics][: 3 if has_own else 2]
    requires_grad = any(array.requires_grad for array in variables)
    shape = batch_count, len(vertices) + samples.shape[1]
    points, point_normals = (
        wp.empty(shape, dtype=wp.vec3, device=device, requires_grad=requires_grad) for _ in range(2)
    )
    launch(
        _gather,
        dim=shape,
        inputs=[
            positions,
            normals,
            faces,
            rows(sides),
            rows(fragments.barycentrics) if has_own else None,
            wp.array(vertices, dtype=wp.int32, device=device),
            wp.array(samples, dtype=wp.int32, device=device),
        ],
        outputs=[points, point_normals],
        device=device,
    )
    return Receivers(
        points,
        point_normals,
        wp.array(receiver_faces, dtype=wp.vec3i, device=device),
        wp.array(receiver_of_vertex, dtype=wp.int32, device=device),
        receiver_fragments,
        still,
    )


def seen_vertices(fragments: Fragments, silhouettes: Silhouettes, vertex_count: int) -> np.ndarray:
    """Find the vertices that have a part in an image: those of faces that samples see, and of edges at silhouettes.

    Args:
        fragments: What each sample sees, of any number of instances.
        silhouettes: Of :func:`warpshadow.silhouette.find_silhouettes`, whose edges have colors of their own.
        vertex_count: Number of vertices.

    Returns:
        bool of shape [vertex]: what any instance sees, so that all have as many receivers. Where fragments have sides,
        their backs follow.
    """
    corners, edges, seen = silhouettes.faces.numpy(), silhouettes.edges.numpy(), fragments.face_ids.numpy()
    takes_part = np.zeros(vertex_count, bool)
    if fragments.sides is not None:
        seen = fragments.sides.numpy()
        # an edge is seen from the side that one of the pixels beside it sees, each of which has an entry for it
        is_back = seen.ravel()[silhouettes.pixels.numpy()] >= len(corners)
        edges = np.where((edges >= 0) & is_back[:, None, None], edges + vertex_count, edges)
        corners, takes_part = np.concatenate([corners, corners + vertex_count]), np.tile(takes_part, 2)
    is_seen = np.zeros(len(corners) + 1, bool)
    is_seen[seen] = True  # the last item is for samples that see none
    takes_part[corners[is_seen[:-1]]] = True
    takes_part[edges[edges >= 0]] = True
    return takes_part


def _own_samples(fragments: Fragments, wants_samples: np.ndarray) -> tuple[np.ndarray, Fragments]:
    """Samples of each view that have receivers of their own, −1 after the last, and fragments that see those."""
    device = fragments.face_ids.device
    face_ids = fragments.face_ids.numpy()
    is_own = (face_ids >= 0) & wants_samples[face_ids]
    samples, own_counts = _ragged(is_own.reshape(len(is_own), -1))
    own_face_ids = face_ids.copy()
    own_face_ids[is_own] = len(wants_samples) + np.concatenate([np.arange(count) for count in own_counts])
    weights = wp.empty(
        fragments.barycentrics.shape,
        dtype=wp.vec3,
        device=device,
        requires_grad=fragments.barycentrics.requires_grad,
    )
    launch(
        _weigh_own,
        dim=weights.size,
        inputs=[wp.array(is_own.ravel(), dtype=wp.bool, device=device), fragments.barycentrics.flatten()],
        outputs=[weights.flatten()],
        device=device,
    )
    return samples, Fragments(wp.array(own_face_ids, dtype=wp.int32, device=device), weights)


def _ragged(chosen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Columns that are chosen in each row, −1 after the last: [row, most of a row], and how many."""
    counts = chosen.sum(axis=1)
    columns = np.full((len(chosen), counts.max()), -1)
    row, column = np.nonzero(chosen)
    columns[row, np.concatenate([np.arange(count) for count in counts])] = column
    return columns, counts
