"""Blockers of a geometry, by kind."""

from typing import NamedTuple

import warp as wp

from warpshadow.pipeline.bodies.convex import SceneConvexParts
from warpshadow.pipeline.bodies.merged_scene import MergedScene
from warpshadow.pipeline.bodies.scene_planes import BodySides, ScenePlanes
from warpshadow.pipeline.bodies.self_visibility import SelfVisibility
from warpshadow.pipeline.node import Input
from warpshadow.stages.convex.convex_blockers import PlacedParts


class BlockerKinds(NamedTuple):
    """Which bodies block light as planes, convex parts or by traced self-visibility; spheres block the rest."""

    self_traced: tuple[int, ...] = ()  # bodies whose self-visibility is traced, not that of their spheres
    rotations: Input | None = None  # of all bodies, mat33 of shape [batch, body]; None where they are not known
    why_spheres: tuple[str, ...] = ()  # of each body, why it blocks its own light by spheres; empty for others
    plane_bodies: tuple[int, ...] = ()  # bodies that block all light as the planes in which they lie
    convex: tuple[int, ...] = ()  # bodies that block the light of others by the convex parts that they consist of
    solids: tuple[int, ...] = ()  # convex bodies whose parts block their own light, too; of others rays are traced
    bulging_bodies: tuple[int, ...] = ()  # bodies out of which their spheres bulge; they are lit at vertices

    @property
    def without_spheres(self) -> set[int]:
        """Bodies that block the light of others by something else than their spheres."""
        return {*self.plane_bodies, *self.convex}

    @property
    def distinct_bodies(self) -> set[int]:
        """Bodies whose receivers form spans of their own, since they leave out, or look up, their own body."""
        return {*self.self_traced, *self.solids, *self.plane_bodies}


ONLY_SPHERES = BlockerKinds()  # all bodies block by their spheres


class Blockers(NamedTuple):
    """The blockers of a geometry, where they are in the world."""

    merged_scene: MergedScene
    blocker_kinds: BlockerKinds
    scene_planes: ScenePlanes
    scene_parts: SceneConvexParts
    self_visibility: SelfVisibility
    merging: float
    positions: wp.array  # of all vertices, vec3 [batch, vertex]
    spheres: tuple[wp.array, wp.array]  # centers and radii of all spheres, blocking or not
    frames: wp.array | None  # where bodies are that block as planes, vec3 [batch, 3 · plane]; None without any
    placed_parts: PlacedParts | None  # where convex parts are; None without any
    body_sides: BodySides | None  # on which side of planes bodies lie; None where there are no planes
