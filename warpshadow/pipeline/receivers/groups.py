"""Receiver groups: receivers of bodies that are lit by the same launches, and their visibility."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Hashable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
import warp as wp

from warpshadow.device.batch import common_batch, cut, expand
from warpshadow.device.constants import IdentityKey, constant
from warpshadow.device.launch import varies
from warpshadow.pipeline.bodies.convex import GroupConvexParts, SceneConvexParts
from warpshadow.pipeline.bodies.merged_scene import MergedScene
from warpshadow.pipeline.bodies.scene_planes import GroupPlanes, ScenePlanes
from warpshadow.pipeline.bodies.self_visibility import SelfLookup, SelfVisibility, SelfVisibilityLookup
from warpshadow.pipeline.receivers.shading_context import BlockerKinds
from warpshadow.pipeline.receivers.static import StaticBodies
from warpshadow.stages.convex.convex_blockers import PlacedParts
from warpshadow.stages.light.cached_cells import CachedRows
from warpshadow.stages.planes.fronts import NearestBlockers, PlaneFronts, find_body_sides, find_fronts
from warpshadow.stages.planes.plane_blockers import PlaneBlockers
from warpshadow.stages.receivers.body_spans import Span, relative_spans
from warpshadow.stages.receivers.find import Receivers
from warpshadow.stages.self_visibility.probes import ProbeWeights
from warpshadow.stages.visibility.traversal import ClusterTree, find_clusters

RECEIVERS_AT_ONCE = 1 << 13  # receivers of each instance that are lit at once where no gradient is asked for


class BodySides:
    """On which side of planes each body lies, by its farthest vertices; found once for all groups.

    Args:
        planes: Of the scene.
        positions: Vertices of all bodies, vec3 of shape [batch, vertex].
    """

    def __init__(self, planes: ScenePlanes, positions: wp.array):
        self._planes, self.positions = planes, positions
        self._is_captured = positions.device.is_capturing
        self._sides: dict[IdentityKey, wp.array] = {}

    def sides_of(self, frames: wp.array, planes: PlaneBlockers) -> wp.array:
        """The side of each plane on which each body lies, [batch, body, plane], found once for all receivers."""
        if (key := IdentityKey(frames)) in self._sides:
            return self._sides[key]
        corners, first_corner = self._planes.corners(self.positions), self._planes.first_corner
        sides = find_body_sides(corners, first_corner, frames, planes)
        if frames.device.is_capturing == self._is_captured:  # what a graph makes, only its replays fill
            self._sides[key] = sides
        return sides


@dataclass(frozen=True, eq=False)
class ReceiverBodies:
    """The bodies on which the receivers of a group lie, which may block their light."""

    spans: tuple[Span, ...]  # which receivers these are, by body
    receivers: Receivers  # among all
    self_visibility: SelfVisibility
    lookup: SelfLookup | None  # traced self-visibility; None where there is none, or their spheres block
    is_solid: bool  # whether they block their own light as their convex parts do
    parts: GroupConvexParts | None  # these, of one body, two or more: one alone never shades itself; else None
    body_sides: BodySides | None  # of all bodies; None without planes

    @property
    def number(self) -> int:
        """Of the body, where it is one."""
        assert len({span.body for span in self.spans}) == 1
        return self.spans[0].body

    @functools.cached_property
    def probe_weights(self) -> ProbeWeights:
        """Where on them they lie."""
        return self.self_visibility.probe_weights(self.receivers, self.spans)


@dataclass(frozen=True, eq=False)
class Group:
    """Receivers that the same launches light: past all bodies, all but their own, or the moving ones."""

    points: wp.array  # [batch, receiver] vec3
    normals: wp.array  # [batch, receiver] vec3
    centers: wp.array  # [batch, sphere] vec3
    radii: wp.array  # [batch, sphere] float32
    cached_rows: CachedRows | None = None  # of static bodies, which block their light, too
    receiver_bodies: ReceiverBodies | None = None  # where bodies are told apart
    planes: GroupPlanes | None = None  # bodies that block as planes; None without any
    convex_parts_around: GroupConvexParts | None = None  # bodies that block as convex parts; None without any
    nearest_blockers: NearestBlockers | None = None  # None where receivers are not patch samples
    self_spheres: Mapping[int, tuple[int, int]] = field(default_factory=dict)  # of bodies whose own light they let pass
    clusters: ClusterTree | None = None  # of the spheres, where they are found already
    footprints: wp.array | None = None  # [batch, receiver] vec3, areas for which they stand; None for points

    @property
    def is_blocked_by_planes(self) -> bool:
        """Whether planes block light of its receivers."""
        return self.planes is not None and bool(self.points.size and self.planes.blocking)

    @property
    def body(self) -> int | None:
        """The body whose receivers they are; None where bodies are not told apart. Not of groups of several."""
        return None if self.receiver_bodies is None else self.receiver_bodies.number

    @property
    def spans(self) -> tuple[Span, ...]:
        """The receivers by body, counted from the group's first; () where bodies are not told apart."""
        return () if self.receiver_bodies is None else relative_spans(self.receiver_bodies.spans)

    @property
    def skips(self) -> tuple[tuple[int, int], ...]:
        """Spheres that do not block light of each span: the first, and the one after the last."""
        return tuple(self.self_spheres.get(span.body, (0, 0)) for span in self.spans)

    @property
    def self_blocking_parts(self) -> GroupConvexParts | None:
        """Convex parts of the receivers' own body that block their light; None without any."""
        return None if self.receiver_bodies is None or not self.points.size else self.receiver_bodies.parts

    def self_coverage(self, directions: np.ndarray, radius: float | None = None) -> wp.array:
        """Coverage of cells by them."""
        assert self.self_blocking_parts is not None
        return self.self_blocking_parts.coverage(self.points, self.normals, directions, radius)

    def coverage_around(
        self, horizon_normals: wp.array | None, directions: np.ndarray, radius: float | None = None
    ) -> wp.array:
        """Coverage of cells by convex parts of other bodies."""
        assert self.convex_parts_around is not None
        return self.convex_parts_around.coverage(self.points, horizon_normals, directions, radius, self.spans)

    def looked_up_transmittance(self) -> wp.array | None:
        """Transmittance past the receivers' own body, looked up, [batch, receiver, cell]; None without rows."""
        bodies = self.receiver_bodies
        if bodies is None or not isinstance(bodies.lookup, SelfVisibilityLookup) or not self.points.size:
            return None
        return bodies.lookup.transmittance(self.normals, bodies.probe_weights, self.spans)

    @functools.cached_property
    def fronts_of_planes(self) -> PlaneFronts:
        """As :meth:`find_fronts`, of the planes around the group."""
        assert self.planes is not None
        return self.find_fronts(self.planes.frames, self.planes.blockers, self.planes.skip)

    def find_fronts(self, frames: wp.array, planes: PlaneBlockers, skip: int | None) -> PlaneFronts:
        """Which part of each plane's front the receivers see, and the receivers lifted off planes they lie in."""
        body_sides = None if self.receiver_bodies is None else self.receiver_bodies.body_sides
        sides = None if body_sides is None else body_sides.sides_of(frames, planes)
        arguments = self.points, self.normals, sides, self.nearest_blockers, frames, planes
        return find_fronts(*arguments, spans=self.spans, skip=skip)

    def portions(self) -> Iterator[Group]:
        """Portions of the receivers; all of them at once for a gradient, and where they have cached rows.

        All arrays of a portion have the same batch, if anything blocks.
        """
        bodies, planes, clusters = self.receiver_bodies, self.planes, self.clusters
        rotation_data = None if bodies is None or bodies.lookup is None else bodies.lookup.turned
        positions = None if bodies is None or bodies.body_sides is None else bodies.body_sides.positions
        frames = None if planes is None else planes.frames
        parts = self.convex_parts_around or (None if bodies is None else bodies.parts)
        part_corners = None if parts is None else parts.placed_parts.corners
        arguments = points, normals, centers, radii = self.points, self.normals, self.centers, self.radii
        others = {"rotations": rotation_data, "planes": frames, "positions": positions, "parts": part_corners}
        footprints = self.footprints
        if radii.shape[1] or any(array is not None for array in (rotation_data, frames, part_corners)):
            count = common_batch({"points": points, "centers": centers, "radii": radii} | others)
            points, normals, centers, radii = [expand(array, count) for array in arguments]
            footprints = None if footprints is None else expand(footprints, count)
            clusters = clusters if radii is self.radii and centers is self.centers else None
        size = points.shape[1]
        if self.cached_rows is not None or size <= RECEIVERS_AT_ONCE or varies([*arguments, *others.values()]):
            spheres = {"centers": centers, "radii": radii, "clusters": clusters}
            yield replace(self, points=points, normals=normals, footprints=footprints, **spheres)
            return
        offset = 0 if bodies is None else bodies.spans[0].first
        for spans in _cut_spans((Span(-1, 0, size),) if bodies is None else bodies.spans):
            portion = slice(spans[0].first - offset, spans[-1].end - offset)
            yield replace(
                self,
                points=points[:, portion].contiguous(),
                normals=normals[:, portion].contiguous(),
                centers=centers,
                radii=radii,
                receiver_bodies=None if bodies is None else replace(bodies, spans=spans),
                footprints=None if footprints is None else footprints[:, portion].contiguous(),
                nearest_blockers=None if self.nearest_blockers is None else self.nearest_blockers.cut(portion),
                clusters=clusters,
            )


def _cut_spans(spans: Iterable[Span]) -> Iterator[tuple[Span, ...]]:
    """Cut spans into portions of at most :data:`RECEIVERS_AT_ONCE` receivers."""
    portion: list[Span] = []
    for body, begin, end in spans:
        for first in range(begin, end, RECEIVERS_AT_ONCE):
            piece = Span(body, first, min(first + RECEIVERS_AT_ONCE, end))
            if portion and piece.end - portion[0].first > RECEIVERS_AT_ONCE:
                yield tuple(portion)
                portion = []
            portion.append(piece)
    yield tuple(portion)


class CellCoverages(NamedTuple):
    """Coverage (h, μ) of cells by blockers, vec4 of shape [batch, receiver, direction]."""

    all_cells: wp.array
    sharp_cells: wp.array | None = None  # [batch, receiver, 16]; None where no cell is sharp


class HarmonicVisibility(NamedTuple):
    """Visibility of a group in bands of spherical harmonics, past its spheres."""

    coefficients: wp.array | None  # float32 of shape [batch, receiver, order²]; None where nothing blocks


class CellVisibility(NamedTuple):
    """Visibility of a group in cells of directions: transmittances, float32 of shape [batch, receiver, cell].

    | transmittance | past | None |
    | --- | --- | --- |
    | ``_total`` | all bodies; before ``find_visibility_past_planes`` all but planes | before, without bounces |
    | ``_self`` | the receivers' body | where it is 1 |
    | ``_nonplanar`` | all bodies but planes | where no planes block, or light does not bounce |
    | ``_self_and_spheres`` | the receivers' body, and spheres | where it is 1 |
    """

    directions: np.ndarray  # of the cells, [cell, 3]
    transmittance_total: wp.array | None
    transmittance_self: wp.array | None = None
    transmittance_nonplanar: wp.array | None = None
    transmittance_self_and_spheres: wp.array | None = None
    part_coverages: CellCoverages | None = None  # by convex parts; None without any around


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

    def sphere_blockers(self, bodies: Iterable[int]) -> list[int]:
        """Bodies among some that block light by their spheres."""
        return [
            body for body in bodies if body not in self.blocker_kinds.planes and body not in self.blocker_kinds.convex
        ]

    def spheres_of(self, bodies: Iterable[int]) -> tuple[wp.array, wp.array]:
        """Centers and radii of the spheres of bodies that block by spheres."""
        return self.merged_scene.spheres_of(self.sphere_blockers(bodies), self.spheres)

    @property
    def bodies(self) -> range:
        """All bodies."""
        return range(len(self.merged_scene.scene.bodies))

    def planes_around(self, body: int = -1, of_bodies: Iterable[int] | None = None) -> GroupPlanes | None:
        """Flat bodies around receivers of one body: all that block, or some."""
        planes = self.blocker_kinds.planes
        chosen = _choose_blocking(planes, body, of_bodies)
        if self.frames is None or not chosen:
            return None
        skip = planes.index(body) if body in planes else None
        return GroupPlanes(self.planes.blockers(planes, chosen), self.frames, skip)

    def convex_parts_around(self, body: int = -1, of_bodies: Iterable[int] | None = None) -> GroupConvexParts | None:
        """Convex parts of bodies around receivers of one body: all that block, or some."""
        bodies = self.blocker_kinds.convex
        chosen = _choose_blocking(bodies, body, of_bodies)
        if self.placed_parts is None or not chosen:
            return None
        return GroupConvexParts(self.parts.blockers(bodies, chosen), self.placed_parts, bodies)

    def self_blocking_parts(self, body: int) -> GroupConvexParts | None:
        """The convex parts of a body, where they block its own light: one alone does not."""
        bodies = self.blocker_kinds.convex
        if self.placed_parts is None or body not in self.blocker_kinds.solids or len(self.parts.parts[body]) == 1:
            return None
        return GroupConvexParts(self.parts.blockers(bodies, (body,)), self.placed_parts, on_surface=True)

    def around_plane(self, points: wp.array, normals: wp.array, footprints: wp.array, body: int) -> Group:
        """The group of points of a flat body."""
        planes, parts = self.planes_around(body), self.convex_parts_around()
        spheres = self.spheres_of(self.bodies)
        return Group(points, normals, *spheres, planes=planes, convex_parts_around=parts, footprints=footprints)


def _choose_blocking(bodies: tuple[int, ...], body: int, of_bodies: Iterable[int] | None) -> tuple[int, ...]:
    """Bodies of one kind that block light around a body, () if none but itself does."""
    chosen = bodies if of_bodies is None else tuple(number for number in bodies if number in of_bodies)
    return chosen if set(chosen) - {body} else ()


def find_portions(
    receivers: Receivers,
    blockers: Blockers,
    self_lookups: Mapping[int, SelfLookup] | None = None,
    cached_rows: CachedRows | None = None,
    static_normals: wp.array | None = None,
    *,
    by_body: bool = False,
    static_bodies: StaticBodies | None,
    nearest_spheres: np.ndarray | None,
) -> Iterator[Group]:
    """Put receivers into groups, and cut these into portions.

    Args:
        receivers: All of them.
        blockers: Their surroundings.
        self_lookups: Self-visibility of receivers, by body; None without any.
        cached_rows: Cached transmittance past static bodies, for receivers on them.
        static_normals: Normals of all vertices of static bodies; None where any may move.
        by_body: Whether receivers of each body are a group of their own.
        static_bodies, nearest_spheres: As of the :class:`ShadingContext` that they are.
    """
    if static_bodies is not None and len(receivers.static_vertices):
        assert static_normals is not None
        moving = static_bodies.moving
        points_and_normals = static_bodies.receivers(receivers.static_vertices, static_normals)
        planes, parts = blockers.planes_around(of_bodies=moving), blockers.convex_parts_around(of_bodies=moving)
        spheres = blockers.spheres_of(moving)
        group = Group(*points_and_normals, *spheres, cached_rows, planes=planes, convex_parts_around=parts)
        yield from group.portions()
        if not receivers.points.shape[1]:
            return
    for group in _groups_that_move(receivers, blockers, self_lookups or {}, nearest_spheres, by_body):
        yield from group.portions()


def _groups_that_move(
    receivers: Receivers,
    blockers: Blockers,
    self_lookups: Mapping[int, SelfLookup],
    nearest_spheres: np.ndarray | None,
    by_body: bool,
) -> Iterator[Group]:
    sphere_bodies = blockers.sphere_blockers(blockers.bodies)
    spheres, none = blockers.spheres_of(sphere_bodies), blockers.spheres_of([])
    clusters, nearest_blockers = None, _nearest_blockers(nearest_spheres, blockers)
    if not receivers.spans:
        yield Group(
            receivers.points,
            receivers.normals,
            *spheres,
            planes=blockers.planes_around(),
            nearest_blockers=nearest_blockers,
            footprints=receivers.footprints,
        )
        return
    assert receivers.vertices is not None
    vertex_count, kinds, merged_scene = receivers.vertices.size, blockers.blocker_kinds, blockers.merged_scene
    self_spheres = {body: merged_scene.spheres_among(sphere_bodies, body) for body in kinds.self_traced}

    def kind_of(span: Span) -> tuple[Hashable, ...]:
        """All in which receivers of a group are the same; in the end their body, if it is alone in its group."""
        body = span.body
        is_alone = by_body or merged_scene.is_flat[body] or blockers.self_blocking_parts(body) is not None
        if merged_scene.scene.bounces and body not in self_lookups and body not in kinds.solids:
            is_alone = True
        has_spheres = self_spheres.get(body, (0, 0)) != (0, spheres[1].shape[1])
        is_glossy = body >= 0 and merged_scene.is_glossy[body]
        has_parts = blockers.convex_parts_around(body) is not None
        kind = IdentityKey(self_lookups.get(body)), is_glossy, has_parts, ("alone", body) if is_alone else body >= 0
        return span.first < vertex_count, has_spheres, *kind

    for (is_at_vertices, has_spheres, *_), consecutive in itertools.groupby(receivers.spans, kind_of):
        spans = tuple(consecutive)
        body, first, end = spans[0].body, spans[0].first, spans[-1].end
        points_and_normals = receivers.points, receivers.normals
        if is_at_vertices and len(blockers.positions) == 1 < len(receivers.points):  # all cameras see the same vertices
            points_and_normals = receivers.points[:1], receivers.normals[:1]
        points, normals = (cut(array, first, end) for array in points_and_normals)
        planes, parts = blockers.planes_around(body), blockers.convex_parts_around(body)
        group = Group(points, normals, *(spheres if has_spheres else none), planes=planes, convex_parts_around=parts)
        if receivers.footprints is not None and not is_at_vertices:
            group = replace(group, footprints=cut(receivers.footprints, first, end))
        if has_spheres:
            clusters = clusters or find_clusters(*spheres, blockers.merging)
            group = replace(group, self_spheres=self_spheres, clusters=clusters)
        if body >= 0:
            receiver_bodies = ReceiverBodies(
                spans,
                receivers,
                blockers.self_visibility,
                self_lookups.get(body),
                body in kinds.solids,
                blockers.self_blocking_parts(body),
                blockers.body_sides,
            )
            group = replace(group, receiver_bodies=receiver_bodies)
        if nearest_blockers is not None:
            group = replace(group, nearest_blockers=nearest_blockers.cut(slice(first, end)))
        yield group


def _nearest_blockers(nearest_spheres: np.ndarray | None, blockers: Blockers) -> NearestBlockers | None:
    """The blockers nearest to the receivers; None where these are not patch samples."""
    if nearest_spheres is None:
        return None
    merged_scene = blockers.merged_scene
    sphere_arrays = merged_scene.spheres_of(merged_scene.nonplanar_bodies, blockers.spheres)
    return NearestBlockers(*sphere_arrays, constant(nearest_spheres, wp.int32, merged_scene.device))
