"""Static bodies: bodies that do not move while others do. Results about them are computed once and cached.

Where moving spheres let the share T_q of the light of a cell through, a receiver on a static body gets

    B = Σ_q T_q S_q,  S_q = ∫_{cell q} L(ω) V(ω) max(n·ω, 0) dω / π,

V the visibility past the meshes of the static bodies, by as many rays as ``samples`` says. S does not change. In log-SH
space the sum over the spheres of the static bodies does not.
"""

import functools
from collections.abc import Callable, Hashable

import numpy as np
import warp as wp

from warpshadow.device.constants import note_use
from warpshadow.device.cuda_graph import is_readable
from warpshadow.device.memory import empty, from_numpy
from warpshadow.maths.inset import inset_vertices
from warpshadow.pipeline.bodies.geometry import Geometry, splice
from warpshadow.pipeline.bodies.merged_scene import MergedScene
from warpshadow.pipeline.node import Input, Node
from warpshadow.stages.geometry.normals import vertex_normals
from warpshadow.stages.light.cached_cells import CachedRows
from warpshadow.stages.raster.project import to_clip
from warpshadow.stages.raster.sides import split_sides
from warpshadow.stages.receivers.receivers import Receivers


class StaticBodies:
    """The static bodies of a geometry, and cached results about them.

    Args:
        merged_scene: All bodies.
        geometry: Geometry with the static bodies; its moving bodies are ignored.
    Attributes:
        moving: The other bodies, from 0.
        has_vertex: Whether each vertex is static, bool of shape [vertex].
        normals: Node of the normals of all vertices, vec3 of shape [1, vertex]; normals of moving vertices are
            undefined.
    Raises:
        ValueError: where the static bodies of the instances differ.
    """

    def __init__(self, merged_scene: MergedScene, geometry: Geometry):
        assert geometry.moving is not None
        self.moving = geometry.moving
        self.bodies = [number for number in range(len(merged_scene.scene.bodies)) if number not in geometry.moving]
        self.has_vertex = np.isin(merged_scene.body_of_vertex, self.bodies)
        self._merged_scene = merged_scene
        self._geometry = geometry.map(_first_instance)
        if not self.matches(geometry):
            raise ValueError(
                f"geometry: got instances that differ in more than the bodies {self.moving}, expected their moving to "
                "name all that do"
            )
        self._vertex_ranges = merged_scene.ranges_of(merged_scene.first_vertex, self.moving)
        self.normals = Node("", vertex_normals, self._geometry.positions, merged_scene.one_rings)
        self._clip_positions: Node | None = None
        self._gathered: tuple = (None,)  # vertices, and points and normals of them
        self._rows: dict[Hashable, VertexRows] = {}

    def matches(self, geometry: Geometry) -> bool:
        """Whether another geometry has the same static bodies; on a GPU this is assumed."""
        if geometry.moving != self.moving:
            return False
        if not is_readable(self._merged_scene.device):
            return True
        starts = self._merged_scene.first_vertex, self._merged_scene.first_sphere, self._merged_scene.first_sphere
        return all(
            (array.numpy()[:, first:end] == static.numpy()[:, first:end]).all()
            for array, static, start in zip(
                geometry.arrays().values(), self._geometry.arrays().values(), starts, strict=True
            )
            for first, end in self._merged_scene.ranges_of(start, self.bodies)
        )

    # ------------------------------------------------------------------------------------------ vertices

    def clip_positions(self, cameras: Input) -> Node:
        """Clip positions of all vertices, vec4 of shape [camera, vertex]; moving vertices' are undefined."""
        if self._clip_positions is None or self._clip_positions.dependencies != [cameras]:
            self._clip_positions = Node("", to_clip, self._geometry.positions, cameras)
        return self._clip_positions

    def with_moving_clip_positions(self, positions: wp.array, clip_matrices: wp.array, cached: wp.array) -> wp.array:
        """Overwrite the clip positions of moving vertices. Differentiable: positions."""
        return splice(cached, self._vertex_ranges, lambda a, b: to_clip(positions[:, a:b], clip_matrices))

    def with_moving_normals(self, positions: wp.array, cached: wp.array) -> wp.array:
        """Overwrite the normals of moving vertices. Differentiable: positions."""
        rings_of = self._merged_scene.rings_of
        return splice(cached, self._vertex_ranges, lambda a, b: vertex_normals(positions[:, a:b], rings_of(a, b)))

    def receivers(self, vertices: np.ndarray, normals: wp.array) -> tuple[wp.array, wp.array]:
        """Gather points and normals of some vertices: vec3 of shape [1, receiver].

        Args:
            vertices: Their numbers, after which their backs are numbered.
            normals: Of all vertices: the value of :attr:`normals`.
        """
        if not np.array_equal(vertices, self._gathered[0]):
            self._gathered = vertices, *self.gathered(vertices, normals)
        note_use(*self._gathered[1:])
        return self._gathered[1:]

    def gathered(self, vertices: np.ndarray, normals: wp.array) -> tuple[wp.array, wp.array]:
        """Gather points and normals as :meth:`receivers` does, without the cache."""
        vertices, is_back = split_sides(vertices, len(self.has_vertex))
        outward = np.where(is_back, -1, 1).astype(np.float32)[:, None]
        return tuple(
            from_numpy(array.numpy()[:, vertices] * sign, dtype=wp.vec3, device=array.device)
            for array, sign in ((self._geometry.positions, np.float32(1)), (normals, outward))
        )

    # ------------------------------------------------------------------------------------------ blockers

    @property
    def rotations(self) -> wp.array | None:
        """Rotations of all bodies, mat33 of shape [1, body], undefined for moving bodies; None if unknown."""
        return self._geometry.rotations

    def spheres_of(self, bodies: list[int]) -> tuple[wp.array, wp.array]:
        """Centers and radii of the spheres of some of them."""
        return self._merged_scene.spheres_of(bodies, (self._geometry.centers, self._geometry.radii))

    @functools.cached_property
    def spheres(self) -> tuple[wp.array, wp.array]:
        """Centers and radii of their spheres."""
        return self.spheres_of(self.bodies)

    @functools.cached_property
    def ray_origins(self) -> np.ndarray:
        """Points from which rays of all vertices leave, [vertex, 3]: within the wall of a vertex where walls meet."""
        return inset_vertices(self._geometry.positions.numpy()[0], self._merged_scene.faces.numpy())

    @functools.cached_property
    def mesh(self) -> wp.Mesh | None:
        """The mesh of the static bodies that rays meet."""
        return self._merged_scene.blocker_mesh(self._geometry.positions[0], self.bodies)

    def rows(self, key: Hashable, find: Callable[["StaticBodies", np.ndarray, wp.array], wp.array]) -> "VertexRows":
        """Rows of numbers, such as log sums, of static vertices.

        Args:
            key: Names the numbers' meaning.
            find: Finds the rows of some vertices, given these bodies, the vertices and :attr:`normals`.
        """
        if key not in self._rows:
            is_two_sided = self._merged_scene.is_two_sided[self._merged_scene.body_of_vertex]
            maximum = self.has_vertex.sum() + (self.has_vertex & is_two_sided).sum()
            self._rows[key] = VertexRows(2 * len(self.has_vertex), int(maximum), functools.partial(find, self))
        return self._rows[key]


def _first_instance(array: wp.array) -> wp.array:
    """A copy of the first instance, which is there even where it is empty."""
    first = empty((1, *array.shape[1:]), dtype=array.dtype, device=array.device)
    if array.size:
        wp.copy(first, array[:1])
    return first


class VertexRows:
    """Rows of numbers of vertices, each computed when it is first asked for; the array doubles when it is full.

    Args:
        count: Number of vertices and backs.
        maximum: Upper bound of the count.
        find: Finds the rows of some vertices, float32 of shape [vertex, channel, item], given normals.
    """

    def __init__(self, count: int, maximum: int, find: Callable[[np.ndarray, wp.array], wp.array]):
        self._maximum, self._find = maximum, find
        self._row_of_vertex = np.full(count, -1, np.int32)
        self._count = 0
        self._rows: wp.array | None = None
        self._vertices = np.empty(0, int)
        self._index: wp.array | None = None

    def missing(self, vertices: np.ndarray | None = None) -> int:
        """Number of vertices, all or some, without a row."""
        if vertices is None:
            return self._maximum - self._count
        return int((self._row_of_vertex[vertices] < 0).sum())

    def of_receivers(self, receivers: Receivers, normals: wp.array) -> CachedRows | None:
        """Rows of the static receivers, computed for vertices that come for the first time; None without any."""
        vertices = receivers.static_vertices
        if not len(vertices):
            return None
        new = vertices[self._row_of_vertex[vertices] < 0]
        if len(new):
            self._append(self._find(new, normals))
            self._row_of_vertex[new] = np.arange(self._count - len(new), self._count)
        assert self._rows is not None
        if self._index is None or not np.array_equal(vertices, self._vertices):
            self._vertices = vertices
            self._index = from_numpy(self._row_of_vertex[vertices], dtype=wp.int32, device=self._rows.device)
        note_use(self._rows, self._index)
        return CachedRows(self._rows, self._index)

    def _append(self, rows: wp.array) -> None:
        count = self._count + rows.shape[0]
        if self._rows is None or self._rows.shape[0] < count:
            room = min(max(2 * self._count, count), self._maximum)
            larger = empty((room, *rows.shape[1:]), dtype=wp.float32, device=rows.device)
            if self._rows is not None:
                wp.copy(larger[: self._count], self._rows[: self._count])
            self._rows = larger
        wp.copy(self._rows[self._count : count], rows)
        self._count = count
