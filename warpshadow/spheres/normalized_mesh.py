"""The mesh in the frame of the fit: its bounding box has diagonal 1 and its center at the origin, y up."""

from __future__ import annotations

import numpy as np
import warp as wp

from warpshadow.assets.topology import CREASE, join_faces, part_at_creases, rounds_edges
from warpshadow.device.launch import launch
from warpshadow.stages.normals import vertex_normals


@wp.func
def signed_distance(mesh: wp.uint64, point: wp.vec3):
    """Distance to the surface, negative where the mesh winds around the point, and its gradient."""
    query = wp.mesh_query_point_sign_winding_number(mesh, point, 1.0e6)
    away = query.sign * (point - wp.mesh_eval_position(mesh, query.face, query.u, query.v))
    return query.sign * wp.length(away), wp.normalize(away)


@wp.kernel(enable_backward=False)
def _signed_distances(
    # in
    mesh: wp.uint64,
    points: wp.array[wp.vec3],
    # out
    distances: wp.array[float],
    slopes: wp.array[wp.vec3],
):
    """Each thread owns one point."""
    i = wp.tid()
    distance, slope = signed_distance(mesh, points[i])
    distances[i] = distance
    slopes[i] = slope


def normalize(positions: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Take vertices [vertex, 3] to the frame of the fit, onto a grid so fine that no shadow changes.

    So what is found there, and the key that it is kept by, are the same wherever the mesh is and however large.

    Returns:
        Vertices of float32, the middle of the bounds, and their diagonal.
    """
    low, high = positions.min(axis=0), positions.max(axis=0)
    middle, diagonal = (low + high) / 2, float(np.linalg.norm(high - low))
    return (np.round((positions - middle) / diagonal * 2**18) / 2**18).astype(np.float32), middle, diagonal


class NormalizedMesh:
    """A mesh in the frame of the fit, ready to be sampled and queried; open meshes, too.

    Normals do not round the edges of boxes.

    Args:
        positions: Vertex positions [diagonals of the bounding box], float32, shape [vertex, 3].
        faces: Indices of positions, int32, shape [face, 3].
        device: Where queries run.
    """

    def __init__(self, positions: np.ndarray, faces: np.ndarray, device: wp.Device):
        self.device = device
        surface = join_faces(positions, faces, None)
        if rounds_edges(surface, positions):
            faces, origins = part_at_creases(faces, surface, positions, CREASE)
            positions = positions[origins]
        self.positions, self.faces = positions, faces
        points = wp.array(positions, dtype=wp.vec3, device=device)
        normals = vertex_normals(points.reshape((1, -1)), wp.array(faces, dtype=wp.vec3i, device=device))
        self.normals = normals.numpy()[0].astype(np.float64)
        self.mesh = wp.Mesh(points, wp.array(faces.ravel(), dtype=wp.int32, device=device), support_winding_number=True)
        corners = positions[faces].astype(np.float64)
        edges = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        lengths = np.linalg.norm(edges, axis=1)
        self.face_areas = lengths / 2
        self.face_normals = edges / np.maximum(lengths, 1e-30)[:, None]
        self.area = self.face_areas.sum()
        areas = np.bincount(faces.ravel(), np.repeat(self.face_areas, 3), minlength=len(positions))
        self.vertex_shares = areas / areas.sum()
        self.low = positions.min(axis=0).astype(np.float64)
        self.high = positions.max(axis=0).astype(np.float64)
        self.longest = (self.high - self.low).max()

    def sample(self, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Draw points evenly from the surface: positions and interpolated normals, both [count, 3]."""
        shares = np.cumsum(self.face_areas) / self.area
        chosen = np.searchsorted(shares, (np.arange(count) + rng.uniform(size=count)) / count)
        chosen = np.minimum(chosen, len(shares) - 1)
        u, v = np.sqrt(rng.uniform(size=count)), rng.uniform(size=count)
        weights = np.stack([1 - u, u * (1 - v), u * v], axis=1)[:, :, None]
        corners = self.faces[chosen]
        normals = (weights * self.normals[corners]).sum(axis=1)
        lengths = np.linalg.norm(normals, axis=1, keepdims=True)
        normals = np.where(lengths > 1e-3, normals / np.maximum(lengths, 1e-3), self.face_normals[chosen])
        return (weights * self.positions[corners]).sum(axis=1), normals

    def sample_vertices(self, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Draw vertices in proportion to the area around them: positions and normals, both [count, 3]."""
        chosen = rng.choice(len(self.positions), count, p=self.vertex_shares)
        return self.positions[chosen].astype(np.float64), self.normals[chosen]

    def signed_distances(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Distances to the surface [point], negative inside, and their gradients [point, 3]."""
        distances = wp.empty(len(points), dtype=wp.float32, device=self.device)
        slopes = wp.empty(len(points), dtype=wp.vec3, device=self.device)
        inputs = [self.mesh.id, wp.array(points.astype(np.float32), dtype=wp.vec3, device=self.device)]
        launch(_signed_distances, len(points), inputs=inputs, outputs=[distances, slopes])
        return distances.numpy().astype(np.float64), slopes.numpy().astype(np.float64)
