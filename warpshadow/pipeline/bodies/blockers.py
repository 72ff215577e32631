"""Blockers of a geometry, by kind, and those of them around a group of receivers.

The blockers of a group hold for all its receivers, on however many bodies these lie: receivers share a group where
their blockers are equal. So a kind of blocker that differs by body divides groups by itself.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import NamedTuple, Protocol

import warp as wp

from warpshadow.device.batch import expand
from warpshadow.pipeline.bodies.convex import GroupConvexParts, SceneConvexParts
from warpshadow.pipeline.bodies.merged_scene import MergedScene
from warpshadow.pipeline.bodies.scene_planes import BodySides, GroupPlanes, ScenePlanes
from warpshadow.pipeline.bodies.self_visibility import SelfLookup, SelfVisibility
from warpshadow.pipeline.node import Input
from warpshadow.stages.convex.convex_blockers import PlacedParts
from warpshadow.stages.receivers.body_spans import Span
from warpshadow.stages.visibility.traversal import ClusterTree


class BlockerKinds(NamedTuple):
    """Which bodies block light as planes, convex parts or by traced self-visibility; spheres block the rest."""

    self_traced: tuple[int, ...] = ()  # bodies whose self-visibility is traced, not that of their spheres
    rotations: Input | None = None  # of all bodies, mat33 of shape [batch, body]; None where they are not known
    why_spheres: tuple[str, ...] = ()  # of each body, why it blocks its own light by spheres; empty for others
    planes: tuple[int, ...] = ()  # bodies that block all light as the planes in which they lie
    convex: tuple[int, ...] = ()  # bodies that block the light of others by the convex parts that they consist of
    solids: tuple[int, ...] = ()  # convex bodies whose parts block their own light, too; of others rays are traced
    bulging_bodies: tuple[int, ...] = ()  # bodies out of which their spheres bulge; they are lit at vertices

    @property
    def without_spheres(self) -> set[int]:
        """Bodies that block the light of others by something else than their spheres."""
        return {*self.planes, *self.convex}

    @property
    def distinct_bodies(self) -> set[int]:
        """Bodies whose receivers form spans of their own, since they leave out, or look up, their own body."""
        return {*self.self_traced, *self.solids, *self.planes}


ONLY_SPHERES = BlockerKinds()  # all bodies block by their spheres


class BlockersOfKind(Protocol):
    """Blockers of one kind around receivers."""

    @property
    def placed_arrays(self) -> Mapping[str, wp.array]:
        """Arrays of shape [batch, …] that say where they are, by their names in messages."""


class GroupSpheres(NamedTuple):
    """Spheres around some receivers."""

    centers: wp.array  # vec3 of shape [batch, sphere]
    radii: wp.array  # float32 of shape [batch, sphere]
    ranges: Mapping[int, tuple[int, int]]  # spheres that block none of their own body's light: the first, and the end
    clusters: ClusterTree | None = None  # of the spheres, where they are found already

    @property
    def placed_arrays(self) -> Mapping[str, wp.array]:
        """Where they are."""
        return {"centers": self.centers, "radii": self.radii}

    def skips(self, spans: Iterable[Span]) -> tuple[tuple[int, int], ...]:
        """Spheres that block no light of the receivers of each span: the first, and the one after the last."""
        return tuple(self.ranges.get(span.body, (0, 0)) for span in spans)

    def expanded(self, instances: int) -> GroupSpheres:
        """Repeat spheres of a batch of 1 for every instance. Differentiable: centers, radii."""
        centers, radii = expand(self.centers, instances), expand(self.radii, instances)
        is_same = centers is self.centers and radii is self.radii
        return self._replace(centers=centers, radii=radii, clusters=self.clusters if is_same else None)


class GroupBlockers(NamedTuple):
    """Blockers around a group of receivers, by kind; None where none of a kind blocks their light.

    A body blocks light of receivers that lie on it by ``self_parts`` and ``self_lookup`` alone, or by its spheres.
    """

    spheres: GroupSpheres | None = None
    planes: GroupPlanes | None = None
    convex_parts: GroupConvexParts | None = None
    self_parts: GroupConvexParts | None = None  # by which the one body of the receivers blocks their light
    self_lookup: SelfLookup | None = None  # traced self-visibility of the receivers' bodies
    body_sides: BodySides | None = None  # on which side of planes these lie; None where they are not known

    @property
    def placed_arrays(self) -> dict[str, wp.array]:
        """Where the blockers of all kinds are, by name."""
        kinds: tuple[BlockersOfKind | None, ...] = self
        return {name: array for kind in kinds if kind is not None for name, array in kind.placed_arrays.items()}

    def expanded(self, instances: int) -> GroupBlockers:
        """The blockers, with the spheres repeated for every instance. Differentiable: spheres."""
        return self if self.spheres is None else self._replace(spheres=self.spheres.expanded(instances))


class Blockers(NamedTuple):
    """The blockers of a geometry, where they are in the world."""

    merged_scene: MergedScene
    blocker_kinds: BlockerKinds
    planes: ScenePlanes
    parts: SceneConvexParts
    self_visibility: SelfVisibility
    merging: float
    positions: wp.array  # of all vertices, vec3 [batch, vertex]
    spheres: tuple[wp.array, wp.array]  # centers and radii of all spheres, blocking or not
    frames: wp.array | None  # where bodies are that block as planes, vec3 [batch, 3 · plane]; None without any
    placed_parts: PlacedParts | None  # where convex parts are; None without any
    body_sides: BodySides | None  # on which side of planes bodies lie; None where there are no planes

    @property
    def bodies(self) -> range:
        """All bodies."""
        return range(len(self.merged_scene.scene.bodies))

    def sphere_blockers(self, bodies: Iterable[int]) -> list[int]:
        """Bodies among some that block light by their spheres."""
        return [body for body in bodies if body not in self.blocker_kinds.without_spheres]

    def group_spheres(self, bodies: Iterable[int], self_traced: Iterable[int] = ()) -> GroupSpheres | None:
        """Spheres by which some bodies block light; None without any.

        Args:
            self_traced: Bodies whose spheres block none of their own light.
        """
        blocking = self.sphere_blockers(bodies)
        centers, radii = self.merged_scene.spheres_of(blocking, self.spheres)
        ranges = {body: self.merged_scene.spheres_among(blocking, body) for body in self_traced}
        return GroupSpheres(centers, radii, ranges) if radii.shape[1] else None

    def around(self, body: int = -1, of_bodies: Iterable[int] | None = None) -> GroupBlockers:
        """Spheres, planes and convex parts that block light of receivers.

        Args:
            body: The receivers' own; −1 if it is not known.
            of_bodies: The bodies that may block; by default all.
        """
        spheres = self.group_spheres(self.bodies if of_bodies is None else of_bodies)
        return self.shapes_around(body, of_bodies)._replace(spheres=spheres)

    def shapes_around(self, body: int, of_bodies: Iterable[int] | None = None) -> GroupBlockers:
        """As :meth:`around`, without the spheres."""
        return GroupBlockers(
            planes=self._planes_around(body, of_bodies),
            convex_parts=self._convex_parts_around(body, of_bodies),
            self_parts=self._self_parts(body),
        )

    def _planes_around(self, body: int, of_bodies: Iterable[int] | None) -> GroupPlanes | None:
        planes = self.blocker_kinds.planes
        chosen = _choose_blocking(planes, body, of_bodies)
        if self.frames is None or not chosen:
            return None
        self_plane = planes.index(body) if body in planes else None
        return GroupPlanes(self.planes.blockers(planes, chosen), self.frames, self_plane)

    def _convex_parts_around(self, body: int, of_bodies: Iterable[int] | None) -> GroupConvexParts | None:
        bodies = self.blocker_kinds.convex
        chosen = _choose_blocking(bodies, body, of_bodies)
        if self.placed_parts is None or not chosen:
            return None
        return GroupConvexParts(self.parts.blockers(bodies, chosen), self.placed_parts, bodies)

    def _self_parts(self, body: int) -> GroupConvexParts | None:
        """The convex parts of a body, where they block its own light: one alone does not."""
        bodies = self.blocker_kinds.convex
        if self.placed_parts is None or body not in self.blocker_kinds.solids or len(self.parts.parts[body]) == 1:
            return None
        return GroupConvexParts(self.parts.blockers(bodies, (body,)), self.placed_parts, on_surface=True)


def _choose_blocking(bodies: tuple[int, ...], body: int, of_bodies: Iterable[int] | None) -> tuple[int, ...]:
    """Bodies of one kind that block light around a body, () if none but itself does."""
    chosen = bodies if of_bodies is None else tuple(number for number in bodies if number in of_bodies)
    return chosen if set(chosen) - {body} else ()
