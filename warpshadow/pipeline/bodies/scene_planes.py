"""Plane blockers: bodies that lie in a plane, such as a ground or walls, and block light as that.

Small spheres in a sheet would bulge out of it, and a large one that touches it from behind leaves light between them.
Instead, the share of a cell of directions that a plane covers is computed.
"""

import functools
from collections.abc import Mapping

import numpy as np
import warp as wp

from warpshadow.device.constants import IdentityKey
from warpshadow.maths.directions import fibonacci
from warpshadow.maths.plane import principal_axes
from warpshadow.pipeline.bodies.merged_scene import MergedScene
from warpshadow.stages.planes.fronts import find_body_sides
from warpshadow.stages.planes.grid import find_grid
from warpshadow.stages.planes.plane_blockers import PlaneBlockers, PlaneBody
from warpshadow.stages.sparse import SparseMatrix, multiply

_ROUNDING = 1e-5  # height over a plane, in sizes of its body, up to which a point counts as in it
_CORNERS = 64  # directions in which the vertices of a body are sought that are farthest out


class ScenePlanes:
    """The flat bodies of a scene, each prepared when it is first asked for.

    Args:
        merged_scene: All bodies.
    """

    def __init__(self, merged_scene: MergedScene):
        self._merged_scene = merged_scene
        self._bodies: dict[int, PlaneBody] = {}
        self._blockers: dict[tuple[tuple[int, ...], tuple[int, ...]], PlaneBlockers] = {}

    @functools.cached_property
    def numbers(self) -> tuple[int, ...]:
        """Bodies that lie in a plane."""
        return tuple(np.flatnonzero(self._merged_scene.is_flat).tolist())

    def others(self, number: int) -> list[np.ndarray]:
        """Vertices of each other body where the scene has it, in a body's frame."""
        bodies = self._merged_scene.scene.bodies
        return [bodies[number].from_world(body.world_points()) for other, body in enumerate(bodies) if other != number]

    def half_spaces(self, number: int) -> np.ndarray:
        """Planes (n, d) of the other flat bodies, in a body's frame, n·x + d > 0 on the side from which they are seen.

        That is where the bodies that are not flat are, or all if every body is; a plane that has some on both sides is
        left out.
        """
        body, result = self._merged_scene.scene.bodies[number], []
        for other, (point, normal) in self._seen_sides.items():
            if other != number:
                own_normal = normal @ body.rotation_matrix()
                result.append([*own_normal, -own_normal @ body.from_world(point)])
        return np.array(result).reshape(-1, 4)

    @functools.cached_property
    def _seen_sides(self) -> dict[int, tuple[np.ndarray, np.ndarray]]:
        """A point of each flat body that is seen from one side, and its normal on that side, in the world."""
        bodies, result = self._merged_scene.scene.bodies, {}
        middles = np.array([body.world_points().mean(axis=0) for body in bodies])
        is_flat = self._merged_scene.is_flat
        middles = middles if is_flat.all() else middles[~is_flat]
        for number in self.numbers:
            points = bodies[number].world_points()
            normal = principal_axes(points)[2]
            heights = (middles - points[0]) @ normal
            sides = np.unique(np.sign(heights[np.abs(heights) > _ROUNDING * np.ptp(points, axis=0).max()]))
            if len(sides) == 1:
                result[number] = points[0], sides[0] * normal
        return result

    def blockers(self, bodies: tuple[int, ...], blocking_bodies: tuple[int, ...]) -> PlaneBlockers:
        """Plane blockers of some flat bodies, which send no light; ``blocking_bodies`` cast shadows."""
        key = bodies, blocking_bodies
        if key not in self._blockers:
            chosen = [self._body(number)._replace(blocks=number in blocking_bodies) for number in bodies]
            vertex_count = int(self._merged_scene.first_vertex[-1])
            self._blockers[key] = PlaneBlockers.from_bodies(chosen, 0, vertex_count, device=self._merged_scene.device)
        return self._blockers[key]

    def frames(self, bodies: tuple[int, ...], positions: wp.array) -> wp.array:
        """Frames of some flat bodies, see :meth:`.PlaneBlockers.frames`. Differentiable: positions."""
        return self.blockers(bodies, bodies).frames(positions)

    @functools.cached_property
    def first_corner(self) -> np.ndarray:
        """Where each body's corners begin, and the end of the last, shape [body + 1]."""
        return np.cumsum([0, *map(len, self._corners)])

    def corners(self, positions: wp.array) -> wp.array:
        """Vertices of all bodies that are farthest out, vec3 of shape [batch, corner]. Differentiable in vertices."""
        return multiply(self._corners_of_vertices, positions)

    @functools.cached_property
    def _corners(self) -> list[np.ndarray]:
        """For each body, the vertices that are farthest out in some direction."""
        directions = np.concatenate([fibonacci(_CORNERS), np.eye(3), -np.eye(3)])
        result = []
        for body in self._merged_scene.scene.bodies:
            used = np.unique(body.mesh.faces)
            result.append(np.unique(used[(body.mesh.positions[used] @ directions.T).argmax(axis=0)]))
        return result

    @functools.cached_property
    def _corners_of_vertices(self) -> SparseMatrix:
        from scipy.sparse import csr_matrix

        starts = self._merged_scene.first_vertex
        columns = np.concatenate([first + corners for first, corners in zip(starts[:-1], self._corners, strict=True)])
        entries = np.ones(len(columns)), (np.arange(len(columns)), columns)
        matrix = csr_matrix(entries, shape=(len(columns), int(starts[-1])))
        return SparseMatrix.from_matrix(matrix, device=self._merged_scene.device)

    def _body(self, number: int) -> PlaneBody:
        if number not in self._bodies:
            mesh, others = self._merged_scene.scene.bodies[number].mesh, self.others(number)
            surface = mesh.positions, mesh.surface.faces
            grid, _ = find_grid(*surface, is_two_sided=False, others=np.concatenate(others) if others else None)
            first_vertex = int(self._merged_scene.first_vertex[number])
            self._bodies[number] = PlaneBody(grid, *surface, first_vertex, 0, blocks=True)
        return self._bodies[number]


class BodySides:
    """On which side of planes each body lies, by its farthest vertices; found once for all groups.

    Args:
        planes: Of the scene.
        positions: Vertices of all bodies, vec3 of shape [batch, vertex].
    """

    def __init__(self, planes: ScenePlanes, positions: wp.array):
        self._planes, self._positions = planes, positions
        self._is_captured = positions.device.is_capturing
        self._sides: dict[IdentityKey, wp.array] = {}

    @property
    def placed_arrays(self) -> Mapping[str, wp.array]:
        """Where the bodies are."""
        return {"positions": self._positions}

    def sides_of(self, frames: wp.array, planes: PlaneBlockers) -> wp.array:
        """The side of each plane on which each body lies, [batch, body, plane], found once for all receivers."""
        if (key := IdentityKey(frames)) in self._sides:
            return self._sides[key]
        corners, first_corner = self._planes.corners(self._positions), self._planes.first_corner
        sides = find_body_sides(corners, first_corner, frames, planes)
        if frames.device.is_capturing == self._is_captured:  # what a graph makes, only its replays fill
            self._sides[key] = sides
        return sides
