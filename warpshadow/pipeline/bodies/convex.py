"""Convex blockers of a scene: bodies that consist of convex parts, such as boxes, rods and panels of cloth.

The share of a cell of directions that each part covers is computed: spheres would bulge out of flat sides and thin
boards, with light between them. The parts of solids block their own light, too. Sheets' self-shadows come from rays:
panels are chords of bent cloth, in which its receivers do not lie.
"""

import functools

import warp as wp

from warpshadow.maths.convex import ConvexPart
from warpshadow.pipeline.bodies.merged_scene import MergedScene
from warpshadow.scene.blockers import blocking_parts, find_solids
from warpshadow.stages.convex.convex_blockers import ConvexBlockers, ConvexBody, PlacedParts


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
