"""Bodies that stand still among moving ones: what is found out about them once is kept.

Where the spheres of moving bodies let the share T_q of the light of a cell pass, a receiver on a still body gets

    B = Σ_q T_q S_q,  S_q = ∫_{cell q} L(ω) V(ω) max(n·ω, 0) dω / π,

V the visibility past the meshes of the still bodies. S stands, so rays find it, and the shadows of still bodies on
still ones are exact. In log-SH space what stands is the sum over the spheres of the still bodies.
"""

import functools
from collections.abc import Callable

import numpy as np
import warp as wp

from warpshadow.assets.light import EnvironmentMap
from warpshadow.device.batch import concatenate
from warpshadow.device.cuda_graph import is_readable
from warpshadow.maths import sh
from warpshadow.pipeline.assembly import Assembly, Geometry
from warpshadow.stages.kept_cells import KeptRows
from warpshadow.stages.light_samples import CellSamples, LightSamples, cell_samples, even_samples, sample_map
from warpshadow.stages.normals import vertex_normals
from warpshadow.stages.project import to_clip
from warpshadow.stages.ray_tracing import trace_cells
from warpshadow.stages.visibility import log_sh

LOG_SUMS, CELLS, LIT_CELLS = "log sums", "cells", "lit cells"
"""What is kept: of the still spheres in log-SH space, of what still bodies let pass of unit light, of known light."""


class Still:
    """The bodies of a geometry that stand still, and what was found out about them.

    Args:
        assembly: The bodies.
        geometry: Has them; what moves in it does not matter.
        progress: Show progress where something takes longer than a second.

    Attributes:
        moving: The other bodies, from 0.
        is_still: Whether each vertex stands, bool of shape [vertex].

    Raises:
        ValueError: where the still bodies of the instances differ.
    """

    def __init__(self, assembly: Assembly, geometry: Geometry, *, progress: bool = False):
        assert geometry.moving is not None
        self.moving = geometry.moving
        self._assembly = assembly
        self._progress = progress
        self._bodies = [number for number in range(len(assembly.scene.bodies)) if number not in geometry.moving]
        self.is_still = np.isin(assembly.body_of_vertex, self._bodies)
        self._can_be_seen = np.concatenate(
            [self.is_still, self.is_still & assembly.is_two_sided[assembly.body_of_vertex]]
        )
        positions, centers, radii = map(_first_instance, geometry)
        self._geometry = Geometry(positions, centers, radii)
        if not self.holds(geometry):
            raise ValueError(
                f"geometry: got instances that differ in more than the bodies {self.moving}, expected their moving to "
                "name all that do"
            )
        self._seen = np.empty(0, int)
        self._rows: dict[str, _Rows] = {}
        self._drawn: dict[str, CellSamples] = {}
        self._clip: tuple[np.ndarray, wp.array] | None = None

    def holds(self, geometry: Geometry) -> bool:
        """Whether the still bodies of another geometry are these; on a GPU that is taken on trust."""
        if geometry.moving != self.moving:
            return False
        if not is_readable(self._assembly.device):
            return True
        starts = self._assembly.first_vertex, self._assembly.first_sphere, self._assembly.first_sphere
        return all(
            (array.numpy()[:, first:end] == own.numpy()[:, first:end]).all()
            for array, own, start in zip(geometry, self._geometry, starts, strict=True)
            for first, end in self._assembly.runs(start, self._bodies)
        )

    # ------------------------------------------------------------------------------------------ vertices

    @functools.cached_property
    def normals(self) -> wp.array:
        """Of all vertices, vec3 of shape [1, vertex]; those of moving ones mean nothing."""
        return vertex_normals(self._geometry.positions, self._assembly.faces)

    def clip_positions(self, clip_matrices: wp.array) -> wp.array:
        """Of all vertices, vec4 of shape [camera, vertex]; those of moving ones mean nothing."""
        if not is_readable(self._assembly.device):
            return to_clip(self._geometry.positions, clip_matrices)
        matrices = clip_matrices.numpy()
        if self._clip is None or not np.array_equal(self._clip[0], matrices):
            self._clip = matrices.copy(), to_clip(self._geometry.positions, clip_matrices)
        return self._clip[1]

    def receivers(self, vertices: np.ndarray) -> tuple[wp.array, wp.array]:
        """Points and normals of some vertices, after which their backs are numbered, vec3 of shape [1, receiver]."""
        if not np.array_equal(vertices, self._seen):
            self._seen = vertices
            self.__dict__.pop("_receivers", None)
        return self._receivers

    @functools.cached_property
    def _receivers(self) -> tuple[wp.array, wp.array]:
        return self._gathered(self._seen)

    def _gathered(self, vertices: np.ndarray) -> tuple[wp.array, wp.array]:
        count = len(self.is_still)
        outward = np.where(vertices < count, 1, -1).astype(np.float32)
        points, normals = (
            wp.array(array.numpy()[:, vertices % count] * sign, dtype=wp.vec3, device=array.device)
            for array, sign in ((self._geometry.positions, np.float32(1)), (self.normals, outward[:, None]))
        )
        return points, normals

    # ------------------------------------------------------------------------------------------ spheres

    def moving_spheres(self, geometry: Geometry) -> tuple[wp.array, wp.array]:
        """Centers and radii of the spheres of what moves in a geometry. Differentiable: geometry."""
        return _runs_of(geometry, self._assembly.runs(self._assembly.first_sphere, self.moving))

    @functools.cached_property
    def _still_spheres(self) -> tuple[wp.array, wp.array]:
        return _runs_of(self._geometry, self._assembly.runs(self._assembly.first_sphere, self._bodies))

    @property
    def blocks(self) -> bool:
        """Whether still bodies block light."""
        return self._still_spheres[1].shape[1] > 0

    def missing(self, kind: str, vertices: np.ndarray | None = None) -> int:
        """Number of still vertices, all or some, of which something is not kept yet."""
        if kind in self._rows:
            return self._rows[kind].missing(vertices)
        return int(self._can_be_seen.sum()) if vertices is None else len(vertices)

    # ------------------------------------------------------------------------------------------ what is kept

    def cells(
        self, vertices: np.ndarray, light: EnvironmentMap | np.ndarray | None, directions: np.ndarray, samples: int
    ) -> KeptRows:
        """The light S_q that still bodies let pass to some vertices: of shape [row, 3, direction].

        Args:
            vertices: The vertices; those that come for the first time are traced.
            light: The same in all calls; None for light of 1, of which there is one channel instead of 3.
            directions: Of the cells, NumPy of shape [direction, 3].
            samples: Number of rays of a vertex.
        """
        kind = CELLS if light is None else LIT_CELLS

        def trace(found: np.ndarray) -> wp.array:
            points, normals = self._gathered(found)
            numbers = wp.array(found % len(self.is_still), dtype=wp.int32, device=points.device)
            if kind not in self._drawn:
                self._drawn[kind] = cell_samples(_samples(light, samples), directions, device=points.device)
            drawn = self._drawn[kind]
            return trace_cells(self._casting_mesh, points[0], normals[0], numbers, drawn, progress=self._progress)

        return self._kept(kind, vertices, trace)

    def log_sums(self, vertices: np.ndarray, *, order: int, log: str, merging: float) -> KeptRows:
        """The log-visibility of the still spheres at some vertices: of shape [row, 1, order²]."""

        def accumulate(found: np.ndarray) -> wp.array:
            points, normals = self._gathered(found)
            logs = log_sh.accumulate(points, normals, *self._still_spheres, order=order, log=log, merging=merging)
            return logs.reshape((len(found), 1, order**2))

        return self._kept(LOG_SUMS, vertices, accumulate)

    def _kept(self, kind: str, vertices: np.ndarray, find: Callable[[np.ndarray], wp.array]) -> KeptRows:
        if kind not in self._rows:
            self._rows[kind] = _Rows(self._can_be_seen)
        return self._rows[kind].of(vertices, find)

    @functools.cached_property
    def _casting_mesh(self) -> wp.Mesh | None:
        return self._assembly.casting_mesh(self._geometry.positions[0], self._bodies)


def _first_instance(array: wp.array) -> wp.array:
    """A copy of the first instance, which is there even where it is empty."""
    first = wp.empty((1, *array.shape[1:]), dtype=array.dtype, device=array.device)
    if array.size:
        wp.copy(first, array[:1])
    return first


def _samples(light: EnvironmentMap | np.ndarray | None, count: int) -> LightSamples:
    if light is None:
        return even_samples(count)
    return sample_map(light.radiance if isinstance(light, EnvironmentMap) else sh.reconstruct_map(light, 64), count)


def _runs_of(geometry: Geometry, runs: list[tuple[int, int]]) -> tuple[wp.array, wp.array]:
    """Centers and radii of some spheres, in runs of consecutive ones."""
    if not runs:
        device = geometry.radii.device
        return wp.empty((1, 0), dtype=wp.vec3, device=device), wp.empty((1, 0), dtype=wp.float32, device=device)
    if runs == [(0, geometry.radii.shape[1])]:
        return geometry.centers, geometry.radii
    counts = [end - first for first, end in runs]
    centers, radii = (
        concatenate([array[:, first:end] for first, end in runs], counts)
        for array in (geometry.centers, geometry.radii)
    )
    return centers, radii


class _Rows:
    """Rows that vertices get when they are first asked for; room for them doubles."""

    def __init__(self, wanted: np.ndarray):
        self._most = int(wanted.sum())
        self._row_of_vertex = np.full(len(wanted), -1, np.int32)
        self._count = 0
        self._rows: wp.array | None = None
        self._vertices = np.empty(0, int)
        self._index: wp.array | None = None

    def missing(self, vertices: np.ndarray | None = None) -> int:
        """Number of vertices, all or some, without a row."""
        if vertices is None:
            return self._most - self._count
        return int((self._row_of_vertex[vertices] < 0).sum())

    def of(self, vertices: np.ndarray, find: Callable[[np.ndarray], wp.array]) -> KeptRows:
        """Rows of some vertices; ``find`` makes those of vertices that have none."""
        new = vertices[self._row_of_vertex[vertices] < 0]
        if len(new):
            self._append(find(new))
            self._row_of_vertex[new] = np.arange(self._count - len(new), self._count)
        assert self._rows is not None
        if self._index is None or not np.array_equal(vertices, self._vertices):
            self._vertices = vertices
            self._index = wp.array(self._row_of_vertex[vertices], dtype=wp.int32, device=self._rows.device)
        return KeptRows(self._rows, self._index)

    def _append(self, rows: wp.array) -> None:
        count = self._count + rows.shape[0]
        if self._rows is None or self._rows.shape[0] < count:
            room = min(max(2 * self._count, count), self._most)
            larger = wp.empty((room, *rows.shape[1:]), dtype=wp.float32, device=rows.device)
            if self._rows is not None:
                wp.copy(larger[: self._count], self._rows[: self._count])
            self._rows = larger
        wp.copy(self._rows[self._count : count], rows)
        self._count = count
