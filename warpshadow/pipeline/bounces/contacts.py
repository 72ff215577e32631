"""Contacts of a scene: where its bodies touch each other as the scene has them, so that patches are finer there."""

import functools
import itertools

import numpy as np
import warp as wp

from warpshadow.maths.adjacency import area_normals
from warpshadow.maths.contacts import MAX_GAP, Contact, touching_numbers
from warpshadow.pipeline.bodies.merged_scene import MergedScene
from warpshadow.scene.body import Body
from warpshadow.stages.bounces.gaps import find_gaps


class _Surface:
    """A body's surface in the world."""

    def __init__(self, body: Body, *, device: wp.DeviceLike):
        referenced_vertices, faces = np.unique(body.mesh.surface.faces, return_inverse=True)
        self.points, self.faces = body.to_world(body.mesh.positions[referenced_vertices]), faces.reshape(-1, 3)
        self.low, self.high = self.points.min(axis=0), self.points.max(axis=0)
        self.half_size = float((self.high - self.low).max()) / 2
        self._device = device

    @functools.cached_property
    def area_vectors(self) -> np.ndarray:
        """Normals of the faces, as long as their areas are large, [face, 3]."""
        return area_normals(self.points[self.faces]) / 2

    @functools.cached_property
    def areas(self) -> np.ndarray:
        """A third of the area of the faces around each vertex, [vertex]."""
        areas = np.linalg.norm(self.area_vectors, axis=1)
        return np.bincount(self.faces.ravel(), np.repeat(areas / 3, 3), len(self.points))

    @functools.cached_property
    def normals(self) -> np.ndarray:
        """Mean normal of the faces around each vertex by area, of any length, [vertex, 3]."""
        corners = self.faces.ravel()
        sums = [np.bincount(corners, np.repeat(column, 3), len(self.points)) for column in self.area_vectors.T]
        return np.stack(sums, axis=1)

    @functools.cached_property
    def mesh(self) -> wp.Mesh:
        """The mesh that distances are to."""
        indices = wp.array(self.faces.ravel(), dtype=wp.int32, device=self._device)
        return wp.Mesh(wp.array(self.points, dtype=wp.vec3, device=self._device), indices)


def find_contacts(merged_scene: MergedScene) -> list[list[Contact]]:
    """Find the contacts of each body with others, in its own frame. Two flat bodies have none."""
    bodies, is_flat = merged_scene.scene.bodies, merged_scene.is_flat
    surfaces = [_Surface(body, device=merged_scene.device) for body in bodies]
    contacts: list[list[Contact]] = [[] for _ in bodies]
    for pair in itertools.combinations(range(len(bodies)), 2):
        if is_flat[list(pair)].all():
            continue
        # distances are from the vertices of the one that is not flat; of two such, of the one with more
        first, second = sorted(pair, key=lambda number: (is_flat[number], -len(surfaces[number].points)))
        half_size = min(surfaces[number].half_size for number in pair if not is_flat[number])
        points = _find_touching_points(surfaces[first], surfaces[second], half_size)
        if len(points):
            for number in pair:
                body = bodies[number]
                contacts[number].append(Contact(body.from_world(points), half_size / body.scale))
    return contacts


def _find_touching_points(surface: _Surface, other: _Surface, half_size: float) -> np.ndarray:
    """Vertices of a surface that touch another one, [point, 3]."""
    margin = MAX_GAP * half_size
    if not ((surface.low <= other.high + margin) & (other.low <= surface.high + margin)).all():
        return np.empty((0, 3))
    is_near = ((surface.points >= other.low - margin) & (surface.points <= other.high + margin)).all(axis=1)
    gaps = np.full(len(surface.points), np.inf)
    gaps[is_near] = find_gaps(other.mesh, surface.points[is_near], surface.normals[is_near], margin)
    return surface.points[touching_numbers(gaps, surface.areas, half_size)]
