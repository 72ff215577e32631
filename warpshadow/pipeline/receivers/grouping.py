"""Grouping: which receivers go together, by the blockers around them.

The blockers of a group hold for all its receivers, on however many bodies these lie: receivers share a group where
their blockers are equal. So a kind of blocker that differs by body divides groups by itself.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Iterable, Iterator, Mapping
from typing import NamedTuple

import numpy as np
import warp as wp

from warpshadow.device.batch import cut
from warpshadow.device.constants import constant
from warpshadow.pipeline.bodies.blockers import Blockers
from warpshadow.pipeline.bodies.self_visibility import SelfLookup
from warpshadow.pipeline.receivers.groups import Group, GroupBlockers, GroupConvexParts, GroupPlanes, GroupSpheres
from warpshadow.pipeline.receivers.static import StaticBodies
from warpshadow.stages.light.cached_cells import CachedRows
from warpshadow.stages.planes.fronts import NearestBlockers
from warpshadow.stages.receivers.body_spans import Span, relative_spans
from warpshadow.stages.receivers.receivers import Receivers
from warpshadow.stages.visibility.traversal import find_clusters


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
        group_blockers = blockers_around(blockers, group_spheres(blockers, moving), of_bodies=moving)
        yield from Group(*points_and_normals, group_blockers, cached_rows=cached_rows).portions()
        if not receivers.points.shape[1]:
            return
    nearest_blockers = _nearest_blockers(nearest_spheres, blockers)
    if receivers.spans:
        groups = _groups_by_body(receivers, blockers, self_lookups or {}, nearest_blockers, by_body)
    else:
        has_any = bool(receivers.points.size)
        group_blockers = blockers_around(blockers, group_spheres(blockers)) if has_any else GroupBlockers()
        arrays = receivers.points, receivers.normals, group_blockers
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
    spheres = group_spheres(blockers, None, kinds.self_traced)
    find_probe_weights = functools.partial(blockers.self_visibility.probe_weights, receivers)

    @functools.cache
    def clustered_spheres() -> GroupSpheres | None:
        return spheres and spheres._replace(clusters=find_clusters(spheres.centers, spheres.radii, blockers.merging))

    def key_of(span: Span) -> GroupKey:
        body, lookup = span.body, self_lookups.get(span.body)
        blocks_any = spheres is not None and spheres.skip(body) != (0, spheres.radii.shape[1])
        group_blockers = blockers_around(blockers, clustered_spheres() if blocks_any else None, body, None, lookup)
        if body < 0:
            return GroupKey(span.first < vertex_count, False, None, group_blockers)
        # where light bounces, these shadow themselves by their spheres (find_cell_transmittance)
        has_self_spheres = merged_scene.scene.bounces and lookup is None and body not in kinds.solids
        has_self_blocker = group_blockers.self_blocker is not None  # parts of one body without a lookup
        is_of_one_body = has_self_blocker and (lookup is None or lookup.is_of_one_body)
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


def group_spheres(
    blockers: Blockers, bodies: Iterable[int] | None = None, self_traced: tuple[int, ...] = ()
) -> GroupSpheres | None:
    """Spheres by which some bodies, by default all, block light; None without any.

    Args:
        self_traced: Bodies whose spheres block none of their own light.
    """
    merged_scene, others = blockers.merged_scene, blockers.blocker_kinds.without_spheres
    chosen = range(len(merged_scene.scene.bodies)) if bodies is None else bodies
    blocking = [body for body in chosen if body not in others]
    centers, radii = merged_scene.spheres_of(blocking, blockers.spheres)
    return GroupSpheres(centers, radii, merged_scene.sphere_ranges(blocking), self_traced) if radii.shape[1] else None


def blockers_around(
    blockers: Blockers,
    spheres: GroupSpheres | None,
    body: int = -1,
    of_bodies: Iterable[int] | None = None,
    self_lookup: SelfLookup | None = None,
) -> GroupBlockers:
    """Blockers of all kinds that block light of receivers.

    Args:
        spheres: Those that do, from :func:`group_spheres`.
        body: The receivers' own; −1 if it is not known.
        of_bodies: The bodies that may block; by default all.
        self_lookup: Traced self-visibility of their own body; None where that is not traced.
    """
    plane_bodies, convex = blockers.blocker_kinds.plane_bodies, blockers.blocker_kinds.convex

    def choose(bodies: tuple[int, ...]) -> tuple[int, ...]:
        chosen = bodies if of_bodies is None else tuple(number for number in bodies if number in of_bodies)
        return chosen if set(chosen) - {body} else ()

    group_planes = group_parts = None
    self_blocker: GroupConvexParts | SelfLookup | None = self_lookup
    if chosen := choose(plane_bodies):
        assert blockers.frames is not None and blockers.body_sides is not None
        self_plane = plane_bodies.index(body) if body in plane_bodies else None
        plane_blockers = blockers.scene_planes.blockers(plane_bodies, chosen)
        group_planes = GroupPlanes(plane_blockers, blockers.frames, plane_bodies, blockers.body_sides, self_plane)
    if chosen := choose(convex):
        assert blockers.placed_parts is not None
        group_parts = GroupConvexParts(blockers.scene_parts.blockers(convex, chosen), blockers.placed_parts, convex)
    if body in blockers.blocker_kinds.solids and len(blockers.scene_parts.parts[body]) > 1:  # one alone blocks none
        assert blockers.placed_parts is not None
        parts_of_body = blockers.scene_parts.blockers(convex, (body,))
        self_blocker = GroupConvexParts(parts_of_body, blockers.placed_parts, on_surface=True)
    return GroupBlockers(spheres, group_planes, group_parts, self_blocker, blockers.body_sides if body >= 0 else None)
