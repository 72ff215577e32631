"""Convex blockers of a scene: bodies that consist of convex parts, such as boxes, rods and panels of cloth.

The share of a cell of directions that each part covers is computed: spheres would bulge out of flat sides and thin
boards, with light between them. The parts of solids block their own light, too. Sheets' self-shadows come from rays:
panels are chords of bent cloth, in which its receivers do not lie.
"""

import functools
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import warp as wp

from warpshadow.maths.convex import ConvexPart
from warpshadow.pipeline.bodies.merged_scene import MergedScene
from warpshadow.scene.blockers import blocking_parts, find_solids
from warpshadow.stages.convex.convex_blockers import ConvexBlockers, ConvexBody, PlacedParts
from warpshadow.stages.convex.coverage import part_coverage
from warpshadow.stages.receivers.body_spans import Span


class GroupConvexParts(NamedTuple):
    """Convex parts around some receivers."""

    blockers: ConvexBlockers
    placed_parts: PlacedParts
    bodies: tuple[int, ...] = ()  # as ``blockers`` numbers them; each blocks no light of receivers that lie on it
    on_surface: bool = False  # whether receivers lie on the parts, which are those of one body

    @property
    def placed_arrays(self) -> Mapping[str, wp.array]:
        """Where they are."""
        return {"parts": self.placed_parts.corners}

    def number_of(self, body: int) -> int:
        """The number that a body has here; −1 for none."""
        return self.bodies.index(body) if body in self.bodies else -1

    def coverage(
        self,
        points: wp.array,
        horizon_normals: wp.array | None,
        directions: np.ndarray,
        radius: float | None = None,
        spans: Sequence[Span] = (),
    ) -> wp.array:
        """Coverage of cells by them for receivers in spans, see :func:`.part_coverage`. Differentiable: points."""
        return part_coverage(
            points,
            self.placed_parts,
            self.blockers,
            directions,
            radius=radius,
            horizon_normals=horizon_normals,
            body_spans=spans,
            self_bodies=[self.number_of(span.body) for span in spans] or [-1],
            on_surface=self.on_surface,
        )


class SceneConvexParts:
    """The bodies of a scene that consist of convex parts.

    Args:
        merged_scene: All bodies.
    """

    def __init__(self, merged_scene: MergedScene):
        self._merged_scene = merged_scene
        self._blockers: dict[tuple[tuple[int, ...], tuple[int, ...]], ConvexBlockers] = {}

    @functools.cached_property
    def parts(self) -> dict[int, list[ConvexPart]]:
        """The parts of each body that blocks as some: see :func:`.blocking_parts`. Flat bodies block as planes."""
        is_flat = self._merged_scene.is_flat
        parts = blocking_parts(self._merged_scene.scene)
        return {number: parts[number] for number in parts if not is_flat[number]}

    @functools.cached_property
    def solids(self) -> frozenset[int]:
        """Bodies whose parts block their own light, too."""
        return find_solids(self._merged_scene.scene, self.parts)

    def blockers(self, bodies: tuple[int, ...], blocking_bodies: tuple[int, ...]) -> ConvexBlockers:
        """Convex blockers of some of these bodies; ``blocking_bodies`` cast shadows."""
        key = bodies, blocking_bodies
        if key not in self._blockers:
            starts, device = self._merged_scene.first_vertex, self._merged_scene.device
            scene_bodies = self._merged_scene.scene.bodies
            chosen = [
                ConvexBody(
                    self.parts[number],
                    int(starts[number]),
                    number in blocking_bodies,
                    scene_bodies[number].mesh.hull_of_parts,
                )
                for number in bodies
            ]
            self._blockers[key] = ConvexBlockers.from_bodies(chosen, int(starts[-1]), device=device)
        return self._blockers[key]

    def place_parts(self, bodies: tuple[int, ...], positions: wp.array) -> PlacedParts:
        """Place the parts of some bodies by all vertices, [batch, vertex]. Differentiable in them."""
        return self.blockers(bodies, bodies).place(positions)
