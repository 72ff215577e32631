"""Receiver groups: receivers of one or many bodies that are lit by the same launches."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from warpshadow.device.batch import common_batch, cut, expand
from warpshadow.device.constants import constant
from warpshadow.device.launch import varies
from warpshadow.pipeline.bodies.blockers import Blockers, GroupBlockers, GroupSpheres
from warpshadow.pipeline.bodies.self_visibility import SelfLookup, SelfVisibilityLookup
from warpshadow.pipeline.receivers.static import StaticBodies
from warpshadow.stages.light.cached_cells import CachedRows
from warpshadow.stages.planes.fronts import NearestBlockers, PlaneFronts, find_fronts
from warpshadow.stages.planes.plane_blockers import PlaneBlockers
from warpshadow.stages.receivers.body_spans import Span, relative_spans
from warpshadow.stages.receivers.find import Receivers
from warpshadow.stages.self_visibility.probes import ProbeWeights
from warpshadow.stages.visibility.traversal import find_clusters

RECEIVERS_AT_ONCE = 1 << 13  # receivers of each instance that are lit at once where no gradient is asked for


@dataclass(frozen=True, eq=False)
class Group:
    """Receivers that the same launches light.

    Arrays have an item for each receiver, [batch, receiver]: :meth:`portions` cuts them. Blockers hold for all.
    """

    points: wp.array  # vec3
    normals: wp.array  # vec3
    blockers: GroupBlockers
    footprints: wp.array | None = None  # vec3, areas for which receivers stand; None for points
    spans: tuple[Span, ...] = ()  # the receivers by body; () where their bodies are not known
    first: int = 0  # number of the first receiver among all that are not on static bodies
    nearest_blockers: NearestBlockers | None = None  # of each receiver; None where they are not patch samples
    body: int | None = None  # the only one on which receivers lie; None where there may be several
    is_glossy: bool = False  # whether the bodies shine
    cached_rows: CachedRows | None = None  # of static bodies, which block the receivers' light, too
    find_probe_weights: Callable[[int, tuple[Span, ...]], ProbeWeights] | None = None  # of receivers from a first on

    @functools.cached_property
    def probe_weights(self) -> ProbeWeights:
        """Probes of their bodies around the receivers, and the weights of these."""
        assert self.find_probe_weights is not None
        return self.find_probe_weights(self.first, self.spans)

    def self_coverage(self, directions: np.ndarray, radius: float | None = None) -> wp.array:
        """Coverage of cells by convex parts of the receivers' own body."""
        assert self.blockers.self_parts is not None
        return self.blockers.self_parts.coverage(self.points, self.normals, directions, radius)

    def coverage_around(
        self, horizon_normals: wp.array | None, directions: np.ndarray, radius: float | None = None
    ) -> wp.array:
        """Coverage of cells by convex parts of other bodies."""
        assert self.blockers.convex_parts is not None
        return self.blockers.convex_parts.coverage(self.points, horizon_normals, directions, radius, self.spans)

    def looked_up_transmittance(self) -> wp.array | None:
        """Transmittance past the receivers' own bodies, [batch, receiver, cell]; None where none is looked up."""
        lookup = self.blockers.self_lookup
        if not isinstance(lookup, SelfVisibilityLookup):
            return None
        return lookup.transmittance(self.normals, self.probe_weights, self.spans)

    @functools.cached_property
    def fronts_of_planes(self) -> PlaneFronts:
        """As :meth:`find_fronts`, of the planes around the group."""
        planes = self.blockers.planes
        assert planes is not None
        return self.find_fronts(planes.frames, planes.blockers, planes.self_plane)

    def find_fronts(self, frames: wp.array, planes: PlaneBlockers, self_plane: int | None) -> PlaneFronts:
        """Which part of each plane's front the receivers see, and the receivers lifted off planes they lie in."""
        sides = None if self.blockers.body_sides is None else self.blockers.body_sides.sides_of(frames, planes)
        arguments = self.points, self.normals, sides, self.nearest_blockers, frames, planes
        return find_fronts(*arguments, spans=self.spans, self_plane=self_plane)

    def portions(self) -> Iterator[Group]:
        """Portions of the receivers; all of them at once for a gradient, and where they have cached rows.

        All arrays of a portion have the same batch, if anything blocks.
        """
        placed_arrays, size, group = self.blockers.placed_arrays, self.points.shape[1], self
        if placed_arrays:
            count = common_batch({"points": self.points, **placed_arrays})
            group = self._with_arrays(lambda array: expand(array, count), blockers=self.blockers.expanded(count))
        is_whole = self.cached_rows is not None or size <= RECEIVERS_AT_ONCE
        if is_whole or varies([self.points, self.normals, *placed_arrays.values()]):
            yield group
            return
        for spans in _cut_spans(self.spans or (Span(-1, 0, size),)):
            yield group._cut(spans)

    def _cut(self, spans: tuple[Span, ...]) -> Group:
        """Cut consecutive receivers out."""
        first, end = spans[0].first, spans[-1].end
        return self._with_arrays(
            lambda array: cut(array, first, end),
            spans=relative_spans(spans) if self.spans else (),
            first=self.first + first,
            nearest_blockers=None if self.nearest_blockers is None else self.nearest_blockers.cut(slice(first, end)),
        )

    def _with_arrays(self, function: Callable[[wp.array], wp.array], **others: Any) -> Group:
        """Apply a function to each array, and replace other values."""
        values = {item.name: getattr(self, item.name) for item in fields(self)}
        arrays = {name: function(value) for name, value in values.items() if isinstance(value, wp.array)}
        return replace(self, **arrays, **others)


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


class GroupKey(NamedTuple):
    """Values that hold for all receivers of a group: consecutive spans with equal ones form one."""

    is_at_vertices: bool
    is_glossy: bool
    body: int | None  # of spans that need a group of their own
    blockers: GroupBlockers


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
        static_bodies, nearest_spheres: Those of the :class:`.ShadingContext` whose receivers these are.
    """
    if static_bodies is not None and len(receivers.static_vertices):
        assert static_normals is not None
        moving = static_bodies.moving
        points_and_normals = static_bodies.receivers(receivers.static_vertices, static_normals)
        group_blockers = blockers.around(of_bodies=moving)
        yield from Group(*points_and_normals, group_blockers, cached_rows=cached_rows).portions()
        if not receivers.points.shape[1]:
            return
    nearest_blockers = _nearest_blockers(nearest_spheres, blockers)
    if receivers.spans:
        groups = _groups_by_body(receivers, blockers, self_lookups or {}, nearest_blockers, by_body)
    else:
        arrays = receivers.points, receivers.normals, blockers.around() if receivers.points.size else GroupBlockers()
        groups = iter([Group(*arrays, receivers.footprints, nearest_blockers=nearest_blockers)])
    for group in groups:
        yield from group.portions()


def _groups_by_body(
    receivers: Receivers,
    blockers: Blockers,
    self_lookups: Mapping[int, SelfLookup],
    nearest_blockers: NearestBlockers | None,
    by_body: bool,
) -> Iterator[Group]:
    """Put spans of receivers into groups."""
    assert receivers.vertices is not None
    footprints = receivers.footprints
    vertex_count, kinds, merged_scene = receivers.vertices.size, blockers.blocker_kinds, blockers.merged_scene
    spheres = blockers.group_spheres(blockers.bodies, kinds.self_traced)
    find_probe_weights = functools.partial(blockers.self_visibility.probe_weights, receivers)

    @functools.cache
    def clustered_spheres() -> GroupSpheres | None:
        return spheres and spheres._replace(clusters=find_clusters(spheres.centers, spheres.radii, blockers.merging))

    def key_of(span: Span) -> GroupKey:
        body, lookup = span.body, self_lookups.get(span.body)
        blocks_alone = spheres is None or spheres.ranges.get(body) == (0, spheres.radii.shape[1])
        group_blockers = blockers.shapes_around(body)._replace(
            spheres=None if blocks_alone else clustered_spheres(),
            self_lookup=lookup,
            body_sides=blockers.body_sides if body >= 0 else None,
        )
        if body < 0:
            return GroupKey(span.first < vertex_count, False, None, group_blockers)
        # where light bounces, these shadow themselves by their spheres (find_cell_transmittance)
        has_self_spheres = merged_scene.scene.bounces and lookup is None and body not in kinds.solids
        is_of_one_body = group_blockers.self_parts is not None or (lookup is not None and lookup.is_of_one_body)
        is_alone = by_body or merged_scene.is_flat[body] or has_self_spheres or is_of_one_body
        is_glossy = bool(merged_scene.is_glossy[body])
        return GroupKey(span.first < vertex_count, is_glossy, body if is_alone else None, group_blockers)

    for key, consecutive in itertools.groupby(receivers.spans, key_of):
        spans = tuple(consecutive)
        first, end = spans[0].first, spans[-1].end
        points_and_normals = receivers.points, receivers.normals
        if key.is_at_vertices and len(blockers.positions) == 1 < len(receivers.points):
            points_and_normals = receivers.points[:1], receivers.normals[:1]  # all cameras see the same vertices
        points, normals = (cut(array, first, end) for array in points_and_normals)
        yield Group(
            points,
            normals,
            key.blockers,
            None if footprints is None or key.is_at_vertices else cut(footprints, first, end),
            relative_spans(spans),
            first,
            None if nearest_blockers is None else nearest_blockers.cut(slice(first, end)),
            key.body,
            key.is_glossy,
            find_probe_weights=find_probe_weights,
        )


def _nearest_blockers(nearest_spheres: np.ndarray | None, blockers: Blockers) -> NearestBlockers | None:
    """The blockers nearest to the receivers; None where these are not patch samples."""
    if nearest_spheres is None:
        return None
    merged_scene = blockers.merged_scene
    sphere_arrays = merged_scene.spheres_of(merged_scene.nonplanar_bodies, blockers.spheres)
    return NearestBlockers(*sphere_arrays, constant(nearest_spheres, wp.int32, merged_scene.device))
