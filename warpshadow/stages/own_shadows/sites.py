"""Sites: the points of a body where its visibility of itself is known, and where receivers lie among them.

Sites are the body's vertices. Where faces are few and large, each is also cut evenly into n² small ones, and their
corners are sites, too: what a sample sees is interpolated between the three nearest. The first sites are the vertices;
then come those on edges, then those inside faces. The backs of all sites of an open body follow.
"""

from typing import NamedTuple

import numpy as np
import warp as wp

from warpshadow.device.launch import launch
from warpshadow.stages.rasterize import Fragments
from warpshadow.stages.sides import split_side

SMALL_FACES = 10_000
"""Faces that a body is cut into at least, so that what lies between sites is seen: 507 vertices alone lose 3.5%."""


class Places(NamedTuple):
    """Where receivers lie on their body: three rows of numbers, and what each weighs."""

    rows: wp.array  # [batch, receiver] vec3i, sites and then their backs; a vertex has one thrice
    weights: wp.array  # [batch, receiver] vec3 with sum 1

    def part(self, part: slice) -> "Places":
        """Those of some receivers, without a gradient."""
        return Places(self.rows[:, part].contiguous(), self.weights[:, part].contiguous())


class Sites(NamedTuple):
    """The sites of a body in its own space.

    Args:
        positions: Shape [site, 3], float32.
        normals: Unit normals [site, 3], float32.
        corners: Site of each point of the lattice of a face, int32 of shape [face, (n + 1)(n + 2) / 2]: point (i, j),
            i steps of n towards its second corner and j towards its third, is number j (n + 1) − j (j − 1) / 2 + i.
        cuts: n.
    """

    positions: np.ndarray
    normals: np.ndarray
    corners: np.ndarray
    cuts: int

    @property
    def edges(self) -> np.ndarray:
        """Pairs of sites that are next to each other on a face, int of shape [pair, 2]; some stand there twice."""
        steps = [(i, j) for j in range(self.cuts) for i in range(self.cuts - j)]
        near, along_u, along_v = (
            self.corners[:, [_point_number(i + di, j + dj, self.cuts) for i, j in steps]].ravel()
            for di, dj in ((0, 0), (1, 0), (0, 1))
        )
        return np.concatenate(
            [np.stack(pair, axis=1) for pair in ((near, along_u), (along_u, along_v), (along_v, near))]
        )


def cuts_of(face_count: int) -> int:
    """Pieces n that edges are cut into, so that faces make up at least :data:`SMALL_FACES`."""
    return int(np.ceil(np.sqrt(SMALL_FACES / face_count)))


def find_sites(positions: np.ndarray, normals: np.ndarray, faces: np.ndarray, cuts: int = 1) -> Sites:
    """Find the sites of a mesh.

    Args:
        positions: Vertices [vertex, 3].
        normals: Their unit normals [vertex, 3]; between them normals are interpolated.
        faces: Indices of vertices [face, 3].
        cuts: Pieces n that each edge is cut into; 1 for the vertices alone.
    """
    lattice = np.array([(cuts - i - j, i, j) for j in range(cuts + 1) for i in range(cuts + 1 - j)])
    faces = np.asarray(faces, np.int64)
    # a point is told by its vertices, in order, and what each weighs; shared ones are so found on both faces
    shape = len(faces), *lattice.shape
    own_weights = np.broadcast_to(lattice, shape)
    own_vertices = np.where(own_weights > 0, faces[:, None], -1)
    order = np.argsort(own_vertices, axis=2)
    own_vertices, own_weights = (np.take_along_axis(values, order, axis=2) for values in (own_vertices, own_weights))
    corner_count = (own_weights > 0).sum(axis=2)
    keys = np.concatenate([corner_count[..., None], own_vertices, own_weights], axis=2).reshape(-1, 7)
    is_inner = corner_count.ravel() > 1
    unique, numbers = np.unique(keys[is_inner], axis=0, return_inverse=True)
    corners = np.empty(len(keys), np.int32)
    corners[~is_inner] = keys[~is_inner, 1:4].max(axis=1)
    corners[is_inner] = len(positions) + numbers.ravel()
    vertices, weights = np.maximum(unique[:, 1:4], 0), unique[:, 4:, None] / cuts
    found = [(values[vertices] * weights).sum(axis=1) for values in (positions, normals)]
    lengths = np.linalg.norm(found[1], axis=1, keepdims=True)
    found[1] = found[1] / np.maximum(lengths, 1e-30)
    points, directions = (
        np.concatenate([values, new]).astype(np.float32)
        for values, new in zip((positions, normals), found, strict=True)
    )
    return Sites(points, directions, corners.reshape(len(faces), -1), cuts)


@wp.kernel(enable_backward=False)
def _place_vertices(
    # in
    vertices: wp.array(dtype=wp.int32),
    vertex_count: int,
    first_vertex: int,
    site_count: int,
    # out
    rows: wp.array2d(dtype=wp.vec3i),
    weights: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a receiver at a vertex."""
    receiver = wp.tid()
    vertex, is_back = split_side(vertices[receiver], vertex_count)
    row = vertex - first_vertex + wp.where(is_back, site_count, 0)
    rows[0, receiver] = wp.vec3i(row, row, row)
    weights[0, receiver] = wp.vec3(1.0, 0.0, 0.0)


@wp.func
def _point_number(i: int, j: int, cuts: int):
    """Number of a point of a face's lattice."""
    return j * (cuts + 1) - j * (j - 1) // 2 + i


@wp.kernel
def _place_samples(
    # in
    sides: wp.array2d(dtype=wp.int32),
    barycentrics: wp.array2d(dtype=wp.vec3),
    face_count: int,
    first_face: int,
    site_count: int,
    corners: wp.array2d(dtype=wp.int32),
    cuts: int,
    # out
    rows: wp.array2d(dtype=wp.vec3i),
    weights: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a receiver at a sample's point; −1 for none."""
    batch, receiver = wp.tid()
    side = sides[batch, receiver]
    face, is_back = split_side(wp.max(side, first_face), face_count)
    face -= first_face
    b = barycentrics[batch, receiver]
    u = wp.clamp(float(cuts) * b[1], 0.0, float(cuts))
    v = wp.clamp(float(cuts) * b[2], 0.0, float(cuts))
    i = wp.min(int(u), cuts - 1)
    j = wp.min(int(v), cuts - 1 - i)
    u -= float(i)
    v -= float(j)
    # of the two small faces between four points, the far one has the far corner in place of the near one
    near = _point_number(i, j, cuts)
    along_u = _point_number(i + 1, j, cuts)
    along_v = _point_number(i, j + 1, cuts)
    w = wp.vec3(1.0 - u - v, u, v)
    if u + v > 1.0 and i + j < cuts - 1:
        near = _point_number(i + 1, j + 1, cuts)
        swapped = along_u
        along_u = along_v
        along_v = swapped
        w = wp.vec3(u + v - 1.0, 1.0 - u, 1.0 - v)
    shift = wp.where(is_back, site_count, 0)
    rows[batch, receiver] = wp.vec3i(
        corners[face, near] + shift, corners[face, along_u] + shift, corners[face, along_v] + shift
    )
    weights[batch, receiver] = w


class SiteTable(NamedTuple):
    """What places receivers of a body on its sites, in arrays.

    Args:
        first_vertex, vertex_count: Of the body's vertices among all, and how many all are.
        first_face, face_count: Likewise of its faces.
        site_count: Number of its sites; their backs follow.
        corners, cuts: As in :class:`Sites`.
    """

    first_vertex: int
    vertex_count: int
    first_face: int
    face_count: int
    site_count: int
    corners: wp.array
    cuts: int

    def of_vertices(self, vertices: wp.array) -> Places:
        """Places of vertices and their backs, int32 of shape [receiver], numbered among all: batch 1."""
        places = _empty_places(1, vertices.size, vertices.device)
        inputs = [vertices, self.vertex_count, self.first_vertex, self.site_count]
        launch(_place_vertices, vertices.size, inputs=inputs, outputs=list(places))
        return places

    def of_samples(self, seen: Fragments) -> Places:
        """Places of what samples see: sides and barycentrics, [batch, receiver]. Differentiable: barycentrics."""
        batch_count, count = seen.face_ids.shape
        places = _empty_places(batch_count, count, seen.face_ids.device)
        counts = [self.face_count, self.first_face, self.site_count]
        inputs = [seen.face_ids, seen.barycentrics, *counts, self.corners, self.cuts]
        launch(_place_samples, places.rows.shape, inputs=inputs, outputs=list(places))
        return places


def _empty_places(batch_count: int, count: int, device: wp.Device) -> Places:
    shape = batch_count, count
    return Places(wp.empty(shape, dtype=wp.vec3i, device=device), wp.empty(shape, dtype=wp.vec3, device=device))
