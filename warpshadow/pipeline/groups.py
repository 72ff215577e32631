"""Groups: receivers that the same bodies block in the same way, and what a group sees."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

import warp as wp

from warpshadow.device.batch import common_batch, cut, expand
from warpshadow.device.constants import constant
from warpshadow.device.launch import varies
from warpshadow.pipeline.assembly import Assembly
from warpshadow.pipeline.flats import FlatsAround, SceneFlats
from warpshadow.pipeline.lighting import LitPoints
from warpshadow.pipeline.node import Call
from warpshadow.pipeline.own_shadows import OwnLobes, OwnLookup
from warpshadow.stages.flats.fronts import NearestBlockers, find_fronts, lifted_points
from warpshadow.stages.flats.prepared import Flats
from warpshadow.stages.kept_cells import KeptRows
from warpshadow.stages.own_shadows.sites import Places
from warpshadow.stages.receivers import Receivers
from warpshadow.stages.visibility.walk import Clusters, find_clusters

PART = 1 << 13
"""Receivers of each instance that are lit at once where no gradient is asked for."""


def solid_bodies(assembly: Assembly) -> list[int]:
    """Bodies for which spheres stand in where light bounces: those that are not flat."""
    return [body for body in range(len(assembly.scene.bodies)) if not assembly.is_flat[body]]


class Group(NamedTuple):
    """Receivers whose light the same spheres block: those of all bodies, or of all but the receivers' own."""

    points: wp.array  # [batch, receiver] vec3
    normals: wp.array  # [batch, receiver] vec3
    centers: wp.array  # [batch, sphere] vec3
    radii: wp.array  # [batch, sphere] float32
    kept_rows: KeptRows | None = None  # of static bodies, which block their light, too
    body: int | None = None  # whose receivers they are, where bodies are told apart
    places: Places | None = None  # where they lie on that body
    own_shadow: OwnLookup | OwnLobes | None = None  # by rays; None where there is none, or its spheres block
    flats: FlatsAround | None = None  # bodies that block as planes; None without any
    nearest_blockers: NearestBlockers | None = None  # None where they are not sources of light
    corners: wp.array | None = None  # of the body, vec3 of shape [batch, corner]; None where it is not known
    skip: tuple[int, int] = (0, 0)  # spheres that do not block: the first, and the one after the last
    clusters: Clusters | None = None  # of the spheres, where they are found already

    def among(self, frames: wp.array, flats: Flats, skip: int | None) -> tuple[wp.array, wp.array]:
        """Where they are lit among flats, off the planes they lie in, and the part of each front that they see."""
        fronts = find_fronts(self.points, self.normals, self.corners, self.nearest_blockers, frames, flats)
        return lifted_points(self.points, fronts, frames, flats, skip), fronts

    def parts(self) -> Iterator[Group]:
        """Parts of at most PART receivers, with as many instances in all arrays where there are spheres.

        For a gradient they come all at once, and so do those with kept rows.
        """
        own_shadow, flats, clusters = self.own_shadow, self.flats, self.clusters
        turns = None if own_shadow is None else own_shadow.turned
        frames = None if flats is None else flats.frames
        given = points, normals, centers, radii = self[:4]
        if radii.shape[1] or turns is not None or frames is not None:
            arrays = {"points": points, "centers": centers, "radii": radii, "rotations": turns, "flats": frames}
            count = common_batch(arrays | {"corners": self.corners})
            points, normals, centers, radii = [expand(array, count) for array in given]
            clusters = clusters if radii is self.radii and centers is self.centers else None
        size = points.shape[1]
        if self.kept_rows is not None or size <= PART or varies([*given, turns, frames, self.corners]):
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


class Seen(NamedTuple):
    """What a group sees of the light."""

    past_all: wp.array | None  # visibility or transmittance past all bodies; None where nothing blocks
    past_own: wp.array | None = None  # a factor of it: transmittance past its own body; None where that is 1
    past_solid: wp.array | None = None  # transmittance past all but flats; None where no flats block


class Grouping:
    """How receivers are put into groups.

    Args:
        points: The receivers.
        flats: The scene's bodies that lie in a plane.
    """

    def __init__(self, points: LitPoints, flats: SceneFlats):
        self._points, self._flats = points, flats
        self._assembly, self._static = points.assembly, points.static

    def groups(
        self,
        call: Call,
        receivers: Receivers,
        spheres: tuple[wp.array, wp.array],
        kept_rows: KeptRows | None,
        own_shadows: dict[int, Any],
        frames: wp.array | None,
        corners: wp.array | None,
    ) -> list[Group]:
        """Put receivers into groups.

        Args:
            call: Has the normals of static bodies.
            receivers: All of them.
            spheres: Centers and radii of all spheres.
            kept_rows: What static bodies block of the light of those on them.
            own_shadows: What receivers of bodies see past these, by body.
            frames: Where flat bodies are that block as planes, vec3 of shape [batch, 3 · flat]; None without any.
            corners: Vertices of all bodies that are farthest out, vec3 of shape [batch, corner]; None without flats.
        """
        groups = list(self._that_move(call, receivers, spheres, own_shadows, frames, corners))
        if self._static is None or not len(receivers.on_static):
            return groups
        on_static = self._static.receivers(receivers.on_static, self._static.normals.value(call))
        moving = self._assembly.spheres_of(self._solid(self._static.moving), spheres)
        group = Group(*on_static, *moving, kept_rows, flats=self._flats_around(frames, self._static.moving))
        return [group, *groups] if receivers.points.shape[1] else [group]

    def _that_move(
        self,
        call: Call,
        receivers: Receivers,
        spheres: tuple[wp.array, wp.array],
        own_shadows: dict[int, Any],
        frames: wp.array | None,
        corners: wp.array | None,
    ) -> Iterator[Group]:
        """Those that may move."""
        bodies = self._solid(range(len(self._assembly.scene.bodies)))
        blocking, none = (self._assembly.spheres_of(some, spheres) for some in (bodies, []))
        clusters = None
        nearest_blockers = self._nearest_blockers(spheres)
        if not receivers.spans:
            flats = self._flats_around(frames)
            yield Group(receivers.points, receivers.normals, *blocking, flats=flats, nearest_blockers=nearest_blockers)
        pose_count = len(self._points.vertices.value(call))
        for span in receivers.spans:
            facing = receivers.points, receivers.normals
            assert receivers.vertices is not None
            if span.first < receivers.vertices.size and pose_count == 1:  # all cameras see the same vertices
                facing = receivers.points[:1], receivers.normals[:1]
            points, normals = (cut(array, span.first, span.end) for array in facing)
            is_traced = span.body in self._points.blocking.traced
            skip = self._assembly.spheres_among(bodies, span.body) if is_traced else (0, 0)
            others = none if skip == (0, blocking[1].shape[1]) else blocking
            group = Group(points, normals, *others, flats=self._flats_around(frames, but=span.body))
            if others is blocking:
                clusters = clusters or find_clusters(*blocking, self._points.method.visibility.merging)
                group = group._replace(skip=skip, clusters=clusters)
            if span.body >= 0:
                places = self._points.method.own_shadows.places(receivers, span)
                group = group._replace(body=span.body, places=places, own_shadow=own_shadows.get(span.body))
                if corners is not None:
                    bounds = self._flats.first_corner[span.body : span.body + 2].tolist()
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
    ) -> Group:
        """Points of a flat body, and what blocks their light."""
        blocking = self._assembly.spheres_of(self._solid(range(len(self._assembly.scene.bodies))), spheres)
        return Group(points, normals, *blocking, flats=self._flats_around(frames, but=body))

    def _solid(self, bodies: Iterable[int]) -> list[int]:
        """Those of some bodies that block by their spheres."""
        return [body for body in bodies if body not in self._points.blocking.flats]

    def _nearest_blockers(self, spheres: tuple[wp.array, wp.array]) -> NearestBlockers | None:
        """The blockers nearest to the receivers; None where these are not sources."""
        numbers, assembly = self._points.blocker_of_point, self._assembly
        if numbers is None:
            return None
        own = assembly.spheres_of(solid_bodies(assembly), spheres)
        return NearestBlockers(*own, constant(numbers, wp.int32, assembly.device))

    def _flats_around(
        self, frames: wp.array | None, blocking: tuple[int, ...] | None = None, *, but: int = -1
    ) -> FlatsAround | None:
        """Flat bodies around receivers of one body: all that block, or some."""
        flats = self._points.blocking.flats
        named = flats if blocking is None else tuple(body for body in flats if body in blocking)
        if frames is None or not set(named) - {but}:
            return None
        return FlatsAround(self._flats.among(flats, named), frames, flats.index(but) if but in flats else None)
