"""Receiver groups: receivers with the same blockers, and their visibility."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

import warp as wp

from warpshadow.device.batch import common_batch, cut, expand
from warpshadow.device.constants import constant
from warpshadow.device.launch import varies
from warpshadow.pipeline.convex import PartsOfGroup, SceneParts
from warpshadow.pipeline.lighting import LitPoints
from warpshadow.pipeline.merged_scene import MergedScene
from warpshadow.pipeline.node import Call
from warpshadow.pipeline.planes import PlanesOfGroup, ScenePlanes
from warpshadow.pipeline.self_visibility import SelfVisibility, SelfVisibilityLobes, SelfVisibilityLookup
from warpshadow.stages.cached_cells import CachedRows
from warpshadow.stages.convex.prepared import PlacedParts
from warpshadow.stages.planes.fronts import NearestBlockers, find_fronts, lifted_points
from warpshadow.stages.planes.prepared import PlaneBlockers
from warpshadow.stages.receivers import Receivers
from warpshadow.stages.self_visibility.probes import ProbeWeights
from warpshadow.stages.visibility.traversal import ClusterTree, find_clusters

PART = 1 << 13  # receivers of each instance that are lit at once where no gradient is asked for


def solid_bodies(merged_scene: MergedScene) -> list[int]:
    """Bodies that spheres represent in bounced light: all that are not flat."""
    return [body for body in range(len(merged_scene.scene.bodies)) if not merged_scene.is_flat[body]]


class Group(NamedTuple):
    """Receivers whose light the same spheres block: the spheres of all bodies, or of all but the receivers' own."""

    points: wp.array  # [batch, receiver] vec3
    normals: wp.array  # [batch, receiver] vec3
    centers: wp.array  # [batch, sphere] vec3
    radii: wp.array  # [batch, sphere] float32
    cached_rows: CachedRows | None = None  # of static bodies, which block their light, too
    body: int | None = None  # whose receivers they are, where bodies are told apart
    places: ProbeWeights | None = None  # where they lie on that body
    self_lookup: SelfVisibilityLookup | SelfVisibilityLobes | None = (
        None  # by rays; None where there is none, or its spheres block
    )
    planes: PlanesOfGroup | None = None  # bodies that block as planes; None without any
    parts_around: PartsOfGroup | None = None  # bodies that block as convex parts; None without any
    nearest_blockers: NearestBlockers | None = None  # None where they are not sources of light
    corners: wp.array | None = None  # of the body, vec3 of shape [batch, corner]; None where it is not known
    skip: tuple[int, int] = (0, 0)  # spheres that do not block: the first, and the one after the last
    clusters: ClusterTree | None = None  # of the spheres, where they are found already

    def among(self, frames: wp.array, planes: PlaneBlockers, skip: int | None) -> tuple[wp.array, wp.array]:
        """Where they are lit among planes, off the planes they lie in, and the part of each front that they see."""
        fronts = find_fronts(self.points, self.normals, self.corners, self.nearest_blockers, frames, planes)
        return lifted_points(self.points, fronts, frames, planes, skip), fronts

    def parts(self) -> Iterator[Group]:
        """Parts of at most PART receivers, with as many instances in all arrays where there are spheres.

        For a gradient all of them come at once, and so do receivers with cached rows.
        """
        self_lookup, planes, clusters = self.self_lookup, self.planes, self.clusters
        turns = None if self_lookup is None else self_lookup.turned
        frames = None if planes is None else planes.frames
        solids = None if self.parts_around is None else self.parts_around.placed.corners
        arguments = points, normals, centers, radii = self[:4]
        if radii.shape[1] or any(array is not None for array in (turns, frames, solids)):
            arrays = {"points": points, "centers": centers, "radii": radii, "rotations": turns, "planes": frames}
            count = common_batch(arrays | {"corners": self.corners, "parts": solids})
            points, normals, centers, radii = [expand(array, count) for array in arguments]
            clusters = clusters if radii is self.radii and centers is self.centers else None
        size = points.shape[1]
        if self.cached_rows is not None or size <= PART or varies([*arguments, turns, frames, solids, self.corners]):
            yield self._replace(points=points, normals=normals, centers=centers, radii=radii, clusters=clusters)
            return
        for start in range(0, size, PART):
            part = slice(start, min(start + PART, size))
            yield self._replace(
                points=points[:, part].contiguous(),
                normals=normals[:, part].contiguous(),
                centers=centers,
                radii=radii,
                places=None if self.places is None else self.places.part(part),
                nearest_blockers=None if self.nearest_blockers is None else self.nearest_blockers.part(part),
                clusters=clusters,
            )


class Transmittance(NamedTuple):
    """Visibility of a group."""

    transmittance_total: wp.array | None  # visibility or transmittance past all bodies; None where nothing blocks
    transmittance_self: wp.array | None = None  # a factor of it: transmittance past its own body; None where that is 1
    transmittance_spheres: wp.array | None = None  # transmittance past all but planes; None where no planes block


class Grouping:
    """How receivers are put into groups.

    Args:
        points: The receivers.
        planes: The scene's bodies that lie in a plane.
        parts: And those that consist of convex parts.
        self_visibility: Has the probes of bodies.
    """

    def __init__(self, points: LitPoints, planes: ScenePlanes, parts: SceneParts, self_visibility: SelfVisibility):
        self._points, self._planes, self._parts, self._self_visibility = points, planes, parts, self_visibility
        self._merged_scene, self._static = points.merged_scene, points.static

    def groups(
        self,
        call: Call,
        receivers: Receivers,
        spheres: tuple[wp.array, wp.array],
        cached_rows: CachedRows | None,
        self_visibility: dict[int, Any],
        frames: wp.array | None,
        corners: wp.array | None,
        placed: PlacedParts | None,
    ) -> list[Group]:
        """Put receivers into groups.

        Args:
            call: Has the normals of static bodies.
            receivers: All of them.
            spheres: Centers and radii of all spheres.
            cached_rows: Cached transmittance past static bodies, for receivers on them.
            self_visibility: Self-visibility of receivers, by body.
            frames: Where flat bodies are that block as planes, vec3 of shape [batch, 3 · plane]; None without any.
            corners: Vertices of all bodies that are farthest out, vec3 of shape [batch, corner]; None without planes.
            placed: Where convex parts are of bodies that block as such; None without any.
        """
        groups = list(self._that_move(call, receivers, spheres, self_visibility, frames, corners, placed))
        if self._static is None or not len(receivers.on_static):
            return groups
        on_static = self._static.receivers(receivers.on_static, self._static.normals.value(call))
        moving = self._merged_scene.spheres_of(self._solid(self._static.moving), spheres)
        planes = self._planes_around(frames, self._static.moving)
        parts_around = self._parts_around(placed, self._static.moving)
        group = Group(*on_static, *moving, cached_rows, planes=planes, parts_around=parts_around)
        return [group, *groups] if receivers.points.shape[1] else [group]

    def _that_move(
        self,
        call: Call,
        receivers: Receivers,
        spheres: tuple[wp.array, wp.array],
        self_visibility: dict[int, Any],
        frames: wp.array | None,
        corners: wp.array | None,
        placed: PlacedParts | None,
    ) -> Iterator[Group]:
        """Receivers that may move."""
        bodies = self._solid(range(len(self._merged_scene.scene.bodies)))
        blocking, none = (self._merged_scene.spheres_of(some, spheres) for some in (bodies, []))
        clusters = None
        nearest_blockers = self._nearest_blockers(spheres)
        if not receivers.spans:
            planes = self._planes_around(frames)
            yield Group(
                receivers.points, receivers.normals, *blocking, planes=planes, nearest_blockers=nearest_blockers
            )
        pose_count = len(self._points.vertices.value(call))
        for span in receivers.spans:
            facing = receivers.points, receivers.normals
            assert receivers.vertices is not None
            if span.first < receivers.vertices.size and pose_count == 1:  # all cameras see the same vertices
                facing = receivers.points[:1], receivers.normals[:1]
            points, normals = (cut(array, span.first, span.end) for array in facing)
            is_traced = span.body in self._points.blocking.traced
            skip = self._merged_scene.spheres_among(bodies, span.body) if is_traced else (0, 0)
            others = none if skip == (0, blocking[1].shape[1]) else blocking
            group = Group(points, normals, *others, planes=self._planes_around(frames, but=span.body))
            group = group._replace(parts_around=self._parts_around(placed, but=span.body))
            if others is blocking:
                clusters = clusters or find_clusters(*blocking, self._points.method.visibility.merging)
                group = group._replace(skip=skip, clusters=clusters)
            if span.body >= 0:
                places = self._self_visibility.places(receivers, span)
                group = group._replace(body=span.body, places=places, self_lookup=self_visibility.get(span.body))
                if corners is not None:
                    bounds = self._planes.first_corner[span.body : span.body + 2].tolist()
                    group = group._replace(corners=cut(corners, *bounds))
            if nearest_blockers is not None:
                group = group._replace(nearest_blockers=nearest_blockers.part(slice(span.first, span.end)))
            yield group

    def around(
        self,
        points: wp.array,
        normals: wp.array,
        body: int,
        spheres: tuple[wp.array, wp.array],
        frames: wp.array | None,
        placed: PlacedParts | None,
    ) -> Group:
        """The group of points of a flat body, with its blockers."""
        blocking = self._merged_scene.spheres_of(self._solid(range(len(self._merged_scene.scene.bodies))), spheres)
        planes, parts_around = self._planes_around(frames, but=body), self._parts_around(placed)
        return Group(points, normals, *blocking, planes=planes, parts_around=parts_around)

    def _solid(self, bodies: Iterable[int]) -> list[int]:
        """Bodies among some that block light by their spheres."""
        blocking = self._points.blocking
        return [body for body in bodies if body not in blocking.planes and body not in blocking.convex]

    def _nearest_blockers(self, spheres: tuple[wp.array, wp.array]) -> NearestBlockers | None:
        """The blockers nearest to the receivers; None where these are not sources."""
        numbers, merged_scene = self._points.blocker_of_point, self._merged_scene
        if numbers is None:
            return None
        own = merged_scene.spheres_of(solid_bodies(merged_scene), spheres)
        return NearestBlockers(*own, constant(numbers, wp.int32, merged_scene.device))

    def _parts_around(
        self, placed: PlacedParts | None, blocking: tuple[int, ...] | None = None, *, but: int = -1
    ) -> PartsOfGroup | None:
        """Convex parts of bodies around receivers of one body: all that block, or some."""
        bodies = self._points.blocking.convex
        named = bodies if blocking is None else tuple(body for body in bodies if body in blocking)
        if placed is None or not set(named) - {but}:
            return None
        return PartsOfGroup(self._parts.among(bodies, named), placed, bodies.index(but) if but in bodies else None)

    def _planes_around(
        self, frames: wp.array | None, blocking: tuple[int, ...] | None = None, *, but: int = -1
    ) -> PlanesOfGroup | None:
        """Flat bodies around receivers of one body: all that block, or some."""
        planes = self._points.blocking.planes
        named = planes if blocking is None else tuple(body for body in planes if body in blocking)
        if frames is None or not set(named) - {but}:
            return None
        return PlanesOfGroup(self._planes.among(planes, named), frames, planes.index(but) if but in planes else None)
