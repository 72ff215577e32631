"""Gathering: what receivers get of the light that patches send, given what stands in for the bodies that send it.

A body's patches send to the body itself by form factors, a flat body's by its grid, and others' by the spheres that
stand in for them. Where the light of a cell is blocked, one of these takes its place.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from warpshadow.device.batch import common_batch, concatenate, cut, expand, expand_rows
from warpshadow.device.constants import constant
from warpshadow.maths.directions import fibonacci
from warpshadow.pipeline.bounces.own_factors import OwnFactors
from warpshadow.pipeline.bounces.patches import Senders
from warpshadow.pipeline.by_spheres import SphereMethod
from warpshadow.pipeline.directional import Cells
from warpshadow.pipeline.groups import Group, Seen, solid_bodies
from warpshadow.pipeline.lighting import joined
from warpshadow.pipeline.node import Call, Node, Source
from warpshadow.scene.scene import Visibility
from warpshadow.stages.bounces.exitance import patches_of_nodes, sphere_exitance
from warpshadow.stages.bounces.flat_light import flat_light
from warpshadow.stages.bounces.openness import shown_areas, turn_from_flats
from warpshadow.stages.bounces.own_light import own_light
from warpshadow.stages.bounces.sphere_light import sphere_light
from warpshadow.stages.bounces.stand_ins import place_stand_ins
from warpshadow.stages.flats.fronts import NearestBlockers, find_fronts
from warpshadow.stages.flats.prepared import FlatBody, Flats
from warpshadow.stages.receivers import Receivers
from warpshadow.stages.visibility.directional import transmittance
from warpshadow.stages.visibility.walk import Clusters, find_clusters

CELLS = fibonacci(64)
"""Where receivers look for bounced light if direct light is found in harmonics."""

ALL_FLAT = "all that reflects is flat"
"""Why no body sends light to itself, in words."""


class SeenCells(NamedTuple):
    """What a part of receivers sees in cells of directions."""

    past_own: wp.array | None  # [batch, receiver, cell], transmittance past its own body; None where that is 1
    past_solid: wp.array  # [batch, receiver, cell], past all bodies but flats, its own included
    directions: np.ndarray  # [cell, 3]


def see_cells(
    method: SphereMethod, group: Group, seen: Seen, taken: Any, spheres: tuple[wp.array, wp.array]
) -> SeenCells:
    """What a group sees in cells of directions.

    Args:
        method: How light is blocked.
        group: The receivers.
        seen: What they see of direct light.
        taken: What the method takes of that.
        spheres: Centers and radii of all spheres.
    """
    assembly = method.assembly
    if isinstance(taken, Cells):
        directions, past_own = taken.directions, seen.past_own
        past_solid = seen.past_all if seen.past_solid is None else seen.past_solid
    else:
        directions, past_own = CELLS, None
        past_solid = _transmittance(method, group, solid_bodies(assembly), spheres, directions)
    if past_own is None and group.body is not None and not assembly.is_flat[group.body]:
        past_own = _transmittance(method, group, [group.body], spheres, directions)
    if past_solid is None:
        past_solid = wp.full((*group.points.shape, len(directions)), 1.0, wp.float32, device=group.points.device)
    return SeenCells(past_own, past_solid, directions)


def _transmittance(
    method: SphereMethod, group: Group, bodies: list[int], spheres: tuple[wp.array, wp.array], directions: np.ndarray
) -> wp.array | None:
    """Transmittance of the spheres of some bodies, [batch, receiver, cell]; None without any."""
    blocking = method.assembly.spheres_of(bodies, spheres)
    if not (blocking[1].shape[1] and group.points.size):
        return None
    softness, merging = method.visibility.softness, method.visibility.merging
    return transmittance(group.points, group.normals, *blocking, directions, softness=softness, merging=merging)


class PlacedFlats(NamedTuple):
    """Flat bodies."""

    all: Flats
    number: dict[int | None, int]  # of each among them, by the number of the body


class ShownPatches(NamedTuple):
    """Patches as receivers see them, by the spheres that stand in for those of bodies that are not flat."""

    areas: wp.array  # part of its area that each shows towards each cell, [batch, patch, cell]
    centers: wp.array  # of the spheres, vec3 of shape [batch, patch + sphere of dark bodies]
    radii: wp.array  # likewise, 0 for patches of flat bodies
    clusters: Clusters


class StandIns:
    """What stands in for bodies that send light: flats for those in a plane, spheres for all others.

    Args:
        senders: The bodies.
        merging: As for the method of visibility.
    """

    def __init__(self, senders: Senders, merging: float):
        self.senders, self.assembly, self.merging = senders, senders.assembly, merging

    @functools.cached_property
    def flats(self) -> PlacedFlats | None:
        """The flat bodies among them; None without any."""
        assembly, senders = self.assembly, self.senders
        numbers = [number for number in senders.bodies if assembly.is_flat[number]]
        if not numbers:
            return None
        bodies = []
        for number in numbers:
            place, body = senders.bodies.index(number), assembly.scene.bodies[number]
            grid = senders.patches[place].grid
            assert grid is not None
            starts = int(assembly.first_vertex[number]), int(senders.first[place])
            bodies.append(FlatBody(grid, body.mesh.positions, body.mesh.surface.faces, *starts, body.casts_shadow))
        counts = len(senders.areas), int(assembly.first_vertex[-1])
        found = Flats.of(bodies, *counts, device=assembly.device)
        return PlacedFlats(found, {number: k for k, number in enumerate(numbers)})

    @functools.cached_property
    def solid(self) -> list[int]:
        """The bodies for which spheres stand in."""
        return solid_bodies(self.assembly)

    @functools.cached_property
    def dark(self) -> list[int]:
        """Bodies that are not flat and send nothing: the spheres by which they block stand in for them."""
        return [body for body in self.solid if body not in self.senders.bodies]

    def span_of(self, body: int | None) -> tuple[int, int]:
        """Where the stand-ins of a body begin and end."""
        first = self.senders.first
        if body in self.senders.bodies:
            place = self.senders.bodies.index(body)
            return int(first[place]), int(first[place + 1])
        begin, end = self.assembly.spheres_among(self.dark, body)
        return (int(first[-1]) + begin, int(first[-1]) + end) if end else (0, 0)

    @functools.cached_property
    def patches_of_nodes(self) -> tuple[np.ndarray, np.ndarray]:
        """The patches of each stand-in, and of those that they merge into: where they begin, and numbers."""
        count = int(self.assembly.sphere_counts[self.dark].sum())
        numbers = np.arange(len(self.senders.areas))
        return patches_of_nodes(numbers, np.full(len(numbers) + count, -1), merging=self.merging)

    @functools.cached_property
    def _blockers(self) -> tuple[np.ndarray, np.ndarray]:
        """The sphere of its body beside each patch, −1 for none, and the radius of its stand-in in that sphere's."""
        rest, first_sphere, senders = self.assembly.rest, self.assembly.first_sphere, self.senders
        centers, radii = rest.centers.numpy()[0], rest.radii.numpy()[0]
        numbers, ratios = np.full(len(senders.areas), -1, np.int32), np.zeros(len(senders.areas), np.float32)
        start = 0
        for body in self.solid:
            of_body = slice(*first_sphere[body : body + 2])
            if len(radii[of_body]) and body in senders.bodies:
                place = senders.bodies.index(body)
                patches, own = senders.patches[place], slice(*senders.first[place : place + 2])
                nearest = patches.nearest_spheres(centers[of_body], radii[of_body])
                numbers[own] = start + nearest
                ratios[own] = np.sqrt(patches.areas / 2) / np.maximum(radii[of_body][nearest], 1e-30)
            start += len(radii[of_body])
        return numbers, ratios

    @functools.cached_property
    def blocker_of_source(self) -> np.ndarray:
        """The blocker nearest to the patch of each source, among spheres of bodies that are not flat; −1 for none."""
        return self._blockers[0][self.senders.patch_of_source]

    def shown(
        self,
        sources: Receivers,
        cells: list[SeenCells],
        spheres: tuple[wp.array, wp.array],
        frames: wp.array | None,
    ) -> ShownPatches:
        """Patches as receivers see them.

        Args:
            sources: Where they are lit.
            cells: What the sources see, in parts.
            spheres: Centers and radii of all spheres.
            frames: Where flat bodies are.
        """
        normals, flats, senders = sources.normals, self.flats, self.senders
        centers, radii = self.assembly.spheres_of(self.solid, spheres)
        if flats is not None:
            numbers, points, device = self.blocker_of_source, sources.points, normals.device
            of_sources = NearestBlockers(centers, radii, constant(numbers, wp.int32, device))
            fronts = find_fronts(points, normals, None, of_sources, frames, flats.all)
            normals = turn_from_flats(points, normals, radii, numbers, fronts, frames, flats.all)
        rows = [
            wp.full_like(part.past_solid, 1.0, requires_grad=False) if part.past_own is None else part.past_own
            for part in cells
        ]
        passing = joined([row.reshape((len(row), -1)) for row in rows])
        directions = cells[0].directions
        passing = passing.reshape((len(passing), len(senders.sides), len(directions)))
        placed = place_stand_ins(sources, senders.mean, radii, *self._blockers)
        if self.dark:
            others = self.assembly.spheres_of(self.dark, spheres)
            counts = [len(senders.areas), others[1].shape[1]]
            placed = tuple(concatenate(pair, counts) for pair in zip(placed, others, strict=True))
        areas = shown_areas(normals, passing, senders.mean, directions)
        return ShownPatches(areas, *placed, find_clusters(*placed, self.merging))


class Outgoing:
    """What patches send, in the forms in which receivers take it; each is found when it is first asked for.

    Args:
        stand_ins: What stands in for the bodies whose patches they are.
        radiosity: Of the patches, vec3 of shape [batch, patch].
        shown: The patches as receivers see them.
        frames: Where flat bodies are, vec3 of shape [batch, 3 · flat].
    """

    def __init__(
        self,
        stand_ins: StandIns,
        radiosity: wp.array,
        shown: ShownPatches,
        frames: wp.array,
    ):
        self.stand_ins, self.senders, self.radiosity = stand_ins, stand_ins.senders, radiosity
        self.shown, self.frames = shown, frames

    def of_body(self, body: int) -> wp.array:
        """Radiosity of the patches of a body, vec3 of shape [batch, patch]."""
        place = self.senders.bodies.index(body)
        return cut(self.radiosity, *self.senders.first[place : place + 2].tolist())

    @functools.cached_property
    def exitance(self) -> wp.array:
        """Light that stand-ins of patches send towards cells, vec4 of shape [batch, node, cell]."""
        stand_ins = self.stand_ins
        return sphere_exitance(self.radiosity, self.shown.areas, self.senders.areas, *stand_ins.patches_of_nodes)


class Gathering:
    """What receivers get of the light that patches send: G.

    Args:
        visibility: How spheres block light.
        senders: The bodies whose patches send light.
        own_factors: Form factors of bodies for themselves.
        given: Nodes that radiosity, receivers and spheres depend on.
        words: Number of receivers, in words.
        where: Put after the names of its stages.
        why_not: Why nobody asks for it, in words; empty if somebody does.
        only_others: Leave out what bodies send to themselves.

    Attributes:
        stages: Nodes of its parts.
    """

    def __init__(
        self,
        visibility: Visibility,
        senders: Senders,
        own_factors: OwnFactors,
        given: tuple[Node | Source, ...],
        words: str | Callable[[], str],
        where: str = "",
        why_not: str = "",
        only_others: bool = False,
    ):
        self._visibility, self._own_factors = visibility, own_factors
        self._is_flat, sphere_counts = senders.assembly.is_flat, senders.assembly.sphere_counts
        solid = [body for body in senders.bodies if not self._is_flat[body]]
        idle = (
            "" if solid else ALL_FLAT,
            "" if len(solid) < len(senders.bodies) else "nothing flat reflects",
            "" if any(sphere_counts[body] for body in solid) else "nothing that reflects has spheres",
        )
        functions = self._from_itself, self._from_flats, self._from_spheres
        names = "own light", "flat light", "sphere light"
        stages = tuple(
            Node(f"{name}{where}", function, *given, items=words, idle=why_not or why, keeps=False)
            for name, function, why in zip(names, functions, idle, strict=True)
        )
        self.stages = stages[1:] if only_others else stages

    def run(self, call: Call, group: Group, cells: SeenCells, outgoing: Outgoing) -> list[wp.array]:
        """What a group gets in each way in which it gets some, vec3 of shape [batch, receiver]."""
        found = [node.run(call, group, cells, outgoing) for node in self.stages if not node.idle]
        return [light for light in found if light is not None]

    def _from_itself(self, group: Group, _: SeenCells, outgoing: Outgoing) -> wp.array | None:
        if group.body not in outgoing.senders.bodies or self._is_flat[group.body]:
            return None
        assert group.body is not None and group.places is not None
        return own_light(self._own_factors.of(group.body), outgoing.of_body(group.body), *group.places)

    def _from_flats(self, group: Group, cells: SeenCells, outgoing: Outgoing) -> wp.array:
        flats = outgoing.stand_ins.flats
        assert flats is not None
        skip = flats.number.get(group.body)
        points, fronts = group.among(outgoing.frames, flats.all, skip)
        given = points, group.normals, cells.past_solid, outgoing.frames, outgoing.radiosity, flats.all
        return flat_light(*given, cells.directions, fronts=fronts, skip=skip)

    def _from_spheres(self, group: Group, cells: SeenCells, outgoing: Outgoing) -> wp.array | None:
        if not any(body != group.body and not self._is_flat[body] for body in outgoing.senders.bodies):
            return None
        shown, exitance = outgoing.shown, outgoing.exitance
        count = common_batch({"geometry": group.points, "light": exitance, "stand-ins": shown.radii})
        points, normals = expand(group.points, count), expand(group.normals, count)
        centers, radii = expand(shown.centers, count), expand(shown.radii, count)
        return sphere_light(
            points,
            normals,
            centers,
            radii,
            exitance,
            expand_rows(cells.past_solid, count),
            cells.past_own,
            cells.directions,
            softness=self._visibility.softness,
            merging=self._visibility.merging,
            skip=outgoing.stand_ins.span_of(group.body),
            clusters=shown.clusters if radii is shown.radii and centers is shown.centers else None,
        )
