"""The mesh in the frame of the fit: its bounding box has diagonal 1 and its center at the origin, y up."""

from functools import partial

import numpy as np
import warp as wp

from warpshadow.assets.topology import CREASE, join_faces, part_at_creases, rounds_edges
from warpshadow.device.launch import launch
from warpshadow.device.memory import empty
from warpshadow.maths.adjacency import area_normals
from warpshadow.maths.directions import fibonacci
from warpshadow.stages.geometry.normals import vertex_normals

ENCLOSED = 0.9
"""Of the points that an open mesh winds around, the share that sees next to nothing but the mesh if it is a solid with
holes. Of a scan with holes in its foot it is 0.95, of a box without its front 0.1, of half a ball 0."""

_MIN_SEEN_COSINE = 1e-3  # of faces that are seen from one side: walls of solids behind land do not look there

_RAYS = 32  # rays that tell whether a point sees next to nothing but the mesh: all but one meet it


@wp.kernel(enable_backward=False)
def _signed_distances(
    # in
    mesh: wp.uint64,
    is_sheet: bool,
    points: wp.array[wp.vec3],
    # out
    distances: wp.array[float],
    slopes: wp.array[wp.vec3],
):
    """Each thread owns one point: its distance to the surface, negative where a solid winds around it, and gradient."""
    i = wp.tid()
    sign = float(1.0)
    face = int(0)
    u = float(0.0)
    v = float(0.0)
    if is_sheet:
        nearest = wp.mesh_query_point_no_sign(mesh, points[i], 1.0e6)
        face = nearest.face
        u = nearest.u
        v = nearest.v
    else:
        query = wp.mesh_query_point_sign_winding_number(mesh, points[i], 1.0e6)
        sign = query.sign
        face = query.face
        u = query.u
        v = query.v
    away = sign * (points[i] - wp.mesh_eval_position(mesh, face, u, v))
    distances[i] = sign * wp.length(away)
    slopes[i] = wp.normalize(away)


@wp.kernel(enable_backward=False)
def _count_escaping(
    # in
    mesh: wp.uint64,
    points: wp.array[wp.vec3],
    directions: wp.array[wp.vec3],
    # out
    counts: wp.array[int],
):
    """Each thread owns one point: how many rays from it miss the mesh."""
    i = wp.tid()
    count = int(0)
    for k in range(directions.shape[0]):
        if not wp.mesh_query_ray_anyhit(mesh, points[i], directions[k], 1.0e30):
            count += 1
    counts[i] = count


def normalize(positions: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Take vertices [vertex, 3] to the frame of the fit, onto a grid so fine that no shadow changes.

    So results, and their cache key, do not depend on where the mesh is and how large.

    Returns:
        Vertices of float32, the middle of the bounds, and their diagonal.
    """
    low, high = positions.min(axis=0), positions.max(axis=0)
    center, diagonal = (low + high) / 2, float(np.linalg.norm(high - low))
    return (np.round((positions - center) / diagonal * 2**18) / 2**18).astype(np.float32), center, diagonal


class NormalizedMesh:
    """A mesh in the frame of the fit, ready to be sampled and queried.

    Normals do not round the edges of boxes. An open mesh is sampled on both sides, for any winding. If it is no
    solid with a few holes, it is a sheet: nothing is inside it. So is a closed mesh that winds inward, a room.

    Args:
        positions: Vertex positions [diagonals of the bounding box], float32, shape [vertex, 3].
        faces: Indices of positions, int32, shape [face, 3].
        seen_from: Unit vector to the side from which alone it is seen, such as land: faces that look elsewhere are not
            sampled. None for all sides.
    """

    def __init__(
        self, positions: np.ndarray, faces: np.ndarray, device: wp.Device, seen_from: np.ndarray | None = None
    ):
        self.device, self.seen_from = device, seen_from
        surface = join_faces(positions, faces, None)
        faces = surface.faces
        self.is_open = bool((surface.neighbors == -1).any())
        if self.is_open and _volume(positions, faces) < 0:  # wound either way, it gets the same spheres
            surface = surface._replace(faces=faces[:, ::-1], neighbors=surface.neighbors[:, ::-1])
            faces = surface.faces
        if rounds_edges(surface, positions):
            faces, origins = part_at_creases(faces, surface, positions, CREASE)
            positions = positions[origins]
        self.positions, self.faces = positions, faces
        points = wp.array(positions, dtype=wp.vec3, device=device)
        normals = vertex_normals(points.reshape((1, -1)), wp.array(faces, dtype=wp.vec3i, device=device))
        self.normals = normals.numpy()[0].astype(np.float64)
        self.mesh = wp.Mesh(
            points, wp.array(np.ravel(faces), dtype=wp.int32, device=device), support_winding_number=True
        )
        corners = positions[faces].astype(np.float64)
        edges = area_normals(corners)
        lengths = np.linalg.norm(edges, axis=1)
        self.face_areas = lengths / 2
        self.face_normals = edges / np.maximum(lengths, 1e-30)[:, None]
        if seen_from is not None:
            self.face_areas *= self.face_normals @ seen_from > _MIN_SEEN_COSINE
        self.area = self.face_areas.sum()
        areas = np.bincount(faces.ravel(), np.repeat(self.face_areas, 3), minlength=len(positions))
        self.vertex_shares = areas / areas.sum()
        self.low = positions.min(axis=0).astype(np.float64)
        self.high = positions.max(axis=0).astype(np.float64)
        self.longest = (self.high - self.low).max()
        self.is_sheet = False
        self.is_sheet = self._is_sheet()
        self.has_two_sides = self.is_open or self.is_sheet

    def _is_sheet(self) -> bool:
        """Whether the mesh winds around nothing, or is open and light gets to where it winds around."""
        rng = np.random.default_rng(0)
        points = self.low + rng.uniform(size=(1024, 3)) * (self.high - self.low)
        if not self.is_open:
            return _volume(self.positions, self.faces) <= 0
        inner_points = points[self.signed_distances(points)[0] < 0]
        if not len(inner_points):
            return True
        counts = empty(len(inner_points), dtype=wp.int32, device=self.device)
        array = partial(wp.array, dtype=wp.vec3, device=self.device)
        inputs = [self.mesh.id, array(inner_points.astype(np.float32)), array(fibonacci(_RAYS).astype(np.float32))]
        launch(_count_escaping, len(inner_points), inputs=inputs, outputs=[counts])
        return bool((counts.numpy() <= 1).mean() < ENCLOSED)

    def _turn_to_sides(self, normals: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Normals, turned to either side at random if the mesh has two."""
        return normals * rng.choice([-1.0, 1.0], size=(len(normals), 1)) if self.has_two_sides else normals

    def sample(self, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Draw points evenly from the surface: positions and interpolated normals, both [count, 3]."""
        area_shares = np.cumsum(self.face_areas) / self.area
        face_indices = np.searchsorted(area_shares, (np.arange(count) + rng.uniform(size=count)) / count)
        face_indices = np.minimum(face_indices, len(area_shares) - 1)
        u, v = np.sqrt(rng.uniform(size=count)), rng.uniform(size=count)
        weights = np.stack([1 - u, u * (1 - v), u * v], axis=1)[:, :, None]
        corners = self.faces[face_indices]
        normals = (weights * self.normals[corners]).sum(axis=1)
        lengths = np.linalg.norm(normals, axis=1, keepdims=True)
        normals = np.where(lengths > 1e-3, normals / np.maximum(lengths, 1e-3), self.face_normals[face_indices])
        return (weights * self.positions[corners]).sum(axis=1), self._turn_to_sides(normals, rng)

    def sample_vertices(self, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Draw vertices in proportion to the area around them: positions and normals, both [count, 3]."""
        face_indices = rng.choice(len(self.positions), count, p=self.vertex_shares)
        return self.positions[face_indices].astype(np.float64), self._turn_to_sides(self.normals[face_indices], rng)

    def nearest(self, points: np.ndarray) -> np.ndarray:
        """Points of the surface nearest to others [point, 3]."""
        distances, slopes = self._distances(points, True)
        return points - distances[:, None] * slopes

    def signed_distances(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Distances to the surface [point], negative inside a solid, and their gradients [point, 3]."""
        return self._distances(points, self.is_sheet)

    def _distances(self, points: np.ndarray, is_sheet: bool) -> tuple[np.ndarray, np.ndarray]:
        distances = empty(len(points), dtype=wp.float32, device=self.device)
        slopes = empty(len(points), dtype=wp.vec3, device=self.device)
        inputs = [self.mesh.id, is_sheet, wp.array(points.astype(np.float32), dtype=wp.vec3, device=self.device)]
        launch(_signed_distances, len(points), inputs=inputs, outputs=[distances, slopes])
        return distances.numpy().astype(np.float64), slopes.numpy().astype(np.float64)


def _volume(positions: np.ndarray, faces: np.ndarray) -> float:
    """Volume that a mesh encloses, negative where it winds inward; of an open one with the middle of its bounds."""
    a, b, c = np.moveaxis(positions[faces].astype(np.float64), 1, 0)
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)
