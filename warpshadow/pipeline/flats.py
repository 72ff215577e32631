"""Flats: bodies that lie in a plane, such as a ground or walls, and block light as that.

Small spheres in a sheet would bulge out of it, and a large one that touches it from behind leaves light between them.
What a plane takes of a cell of directions is known instead.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import numpy as np
import warp as wp

from warpshadow.pipeline.assembly import Assembly
from warpshadow.stages.flats.grid import find_grid
from warpshadow.stages.flats.prepared import FlatBody, Flats


class FlatsAround(NamedTuple):
    """Flat bodies around some receivers."""

    flats: Flats
    frames: wp.array  # where they are, vec3 of shape [batch, 3 · flat]
    skip: int | None = None  # the one that the receivers are part of


class SceneFlats:
    """The flat bodies of a scene, each prepared when it is first asked for.

    Args:
        assembly: All bodies.
    """

    def __init__(self, assembly: Assembly):
        self._assembly = assembly
        self._bodies: dict[int, FlatBody] = {}
        self._among: dict[tuple[tuple[int, ...], tuple[int, ...]], Flats] = {}

    @functools.cached_property
    def numbers(self) -> tuple[int, ...]:
        """Bodies that lie in a plane."""
        return tuple(np.flatnonzero(self._assembly.is_flat).tolist())

    def others(self, number: int) -> list[np.ndarray]:
        """Vertices of each other body where the scene has it, in a body's frame."""
        bodies = self._assembly.scene.bodies
        own = bodies[number]
        return [
            (body.world_mesh().positions - own.translation) @ own.rotation_matrix() / own.scale
            for other, body in enumerate(bodies)
            if other != number
        ]

    def among(self, bodies: tuple[int, ...], blocking: tuple[int, ...]) -> Flats:
        """Some flat bodies, of which some block light; they send none."""
        key = bodies, blocking
        if key not in self._among:
            chosen = [self._body(number)._replace(blocks=number in blocking) for number in bodies]
            vertex_count = int(self._assembly.first_vertex[-1])
            self._among[key] = Flats.of(chosen, 0, vertex_count, device=self._assembly.device)
        return self._among[key]

    def frames(self, bodies: tuple[int, ...], positions: wp.array) -> wp.array:
        """Where some flat bodies are, of vertices [batch, vertex]; see :meth:`Flats.frames`. Differentiable in them."""
        return self.among(bodies, bodies).frames(positions)

    def _body(self, number: int) -> FlatBody:
        if number not in self._bodies:
            mesh, others = self._assembly.scene.bodies[number].mesh, self.others(number)
            corners = mesh.positions, mesh.surface.faces
            grid, _ = find_grid(*corners, is_two_sided=False, others=np.concatenate(others) if others else None)
            first_vertex = int(self._assembly.first_vertex[number])
            self._bodies[number] = FlatBody(grid, *corners, first_vertex, 0, blocks=True)
        return self._bodies[number]
