"""Which vertices and samples of a scene receive light, and which bodies of theirs are distinct."""

from collections.abc import Hashable

import numpy as np
import warp as wp

from warpshadow.device.constants import note_use
from warpshadow.pipeline.bodies.blockers import ONLY_SPHERES, BlockerKinds
from warpshadow.pipeline.bodies.merged_scene import MergedScene
from warpshadow.pipeline.receivers.static import StaticBodies
from warpshadow.stages.receivers.vertex_receivers import (
    Numbering,
    VertexKeys,
    number_receivers,
    number_seen_vertices,
    vertex_keys,
)


class SceneReceivers:
    """Where the bodies of a scene receive light, in any view of it.

    Args:
        merged_scene: The bodies.
    Attributes:
        at_all_samples: Whether every sample is a receiver, overriding the bodies.
        is_adaptive: Flat bodies on which samples interpolate between receivers, bool of shape [body].
        caches_rows: Whether rows may be cached for receivers at vertices of static bodies.
    """

    def __init__(self, merged_scene: MergedScene):
        self._merged_scene, scene = merged_scene, merged_scene.scene
        self._sends_light = bool(scene.bounces or merged_scene.is_emitter.any())
        self.at_all_samples = scene.visibility.traits.every_sample_receives
        # probes look at the brightest cells of the map, which tell nothing of lamps, or of light from a shell
        is_far = not (self.at_all_samples or merged_scene.is_emitter.any() or scene.shell is not None)
        self.is_adaptive = np.array([body.receivers == "adaptive" for body in scene.bodies])
        self.is_adaptive &= merged_scene.is_flat & is_far
        # rows are valid only where nothing of moving bodies reaches them, neither rays nor bounced light nor light of
        # lamps; and rows are of light from infinitely far away, not from a shell
        self.caches_rows = is_far and not scene.bounces
        self._numberings: dict[Hashable, list[Numbering]] = {}
        self._vertex_keys: dict[Hashable, list[VertexKeys]] = {}
        self._at_vertices: dict[tuple[int, ...], np.ndarray] = {}  # by the bodies out of which spheres bulge

    def at_samples(self, blocker_kinds: BlockerKinds = ONLY_SPHERES) -> np.ndarray:
        """Bodies on which samples are receivers while bodies block in some ways, bool of shape [body]."""
        bodies = enumerate(self._merged_scene.scene.bodies)
        by_vertex = [body.receivers == "vertex" or number in blocker_kinds.bulging_bodies for number, body in bodies]
        return ~np.array(by_vertex) | self.at_all_samples

    def at_vertices(self, blocker_kinds: BlockerKinds) -> np.ndarray:
        """Vertices that may be receivers, and vertices whose backs may be, bool of shape [2, vertex]."""
        key = blocker_kinds.bulging_bodies
        if key not in self._at_vertices:
            receives = ~self.at_samples(blocker_kinds)
            sides = np.stack([receives, receives & self._merged_scene.is_two_sided])
            self._at_vertices[key] = sides[:, self._merged_scene.body_of_vertex]
        return self._at_vertices[key]

    def span_bodies(self, blocker_kinds: BlockerKinds) -> np.ndarray | None:
        """Body of the spans of each body's receivers, [body]: itself if it is distinct, else −1; None if none is."""
        bodies = np.arange(len(self._merged_scene.scene.bodies))
        if self._sends_light:
            return bodies
        distinct = {*blocker_kinds.distinct_bodies, *np.flatnonzero(self._merged_scene.is_glossy).tolist()}
        return np.where(np.isin(bodies, list(distinct)), bodies, -1) if distinct else None

    def number_seen(self, is_seen: wp.array, blocker_kinds: BlockerKinds) -> Numbering:
        """Number the vertices that are seen, and may be receivers, where no body is static."""
        key = frozenset(blocker_kinds.distinct_bodies), blocker_kinds.bulging_bodies
        merged_scene, span_bodies = self._merged_scene, self.span_bodies(blocker_kinds)
        if key not in self._vertex_keys:  # with backs and without, since a capture cannot make constants
            bodies = None if span_bodies is None else span_bodies[merged_scene.body_of_vertex]
            arguments = merged_scene.vertex_order, bodies, merged_scene.device
            both_sides = self.at_vertices(blocker_kinds)
            self._vertex_keys[key] = [vertex_keys(both_sides[:count], *arguments) for count in (1, 2)]
        keys = self._vertex_keys[key][len(is_seen) - 1]
        note_use(*keys)
        return number_seen_vertices(is_seen, keys, are_distinct=span_bodies is not None)

    def number_all(
        self, blocker_kinds: BlockerKinds, has_backs: bool, static_bodies: StaticBodies | None = None
    ) -> Numbering:
        """Number all vertices, or all with their backs.

        Both numberings are made at once, since a capture cannot make constants. Backs of static bodies are in both, so
        that rows cached for one serve the other.
        """
        moving = None if static_bodies is None else static_bodies.moving
        key = frozenset(blocker_kinds.distinct_bodies), blocker_kinds.bulging_bodies, moving
        if key not in self._numberings:
            device = self._merged_scene.device
            both_sides, span_bodies = self.at_vertices(blocker_kinds), self.span_bodies(blocker_kinds)
            bodies = None if span_bodies is None else span_bodies[self._merged_scene.body_of_vertex]
            is_static = None if static_bodies is None else static_bodies.has_vertex
            fronts = both_sides[:1]
            if is_static is not None and (both_sides[1] & is_static).any():
                fronts = np.stack([both_sides[0], both_sides[1] & is_static])
            sides = fronts, both_sides
            self._numberings[key] = [number_receivers(item, is_static, bodies=bodies, device=device) for item in sides]
        return self._numberings[key][has_backs]
