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

from warpshadow.device.batch import common_batch, cut, expand, expand_rows
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
from warpshadow.stages.flats.fronts import SpheresOfPoints, find_fronts
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
    def patches_of_spheres(self) -> tuple[np.ndarray, np.ndarray]:
        """The patches that each sphere stands in for: where they begin, and numbers."""
        return patches_of_nodes(*self._nearest, merging=self.merging)

    @functools.cached_property
    def _nearest(self) -> tuple[np.ndarray, np.ndarray]:
        """For each patch the nearest sphere of its body, and for each sphere the nearest patch; −1 for none."""
        rest, first_sphere, senders = self.assembly.rest, self.assembly.first_sphere, self.senders
        centers, radii = rest.centers.numpy()[0], rest.radii.numpy()[0]
        spheres, start = np.full(len(senders.areas), -1, np.int32), 0
        nearest = [np.empty(0, int)]
        for other in self.solid:
            of_body = slice(*first_sphere[other : other + 2])
            count = len(radii[of_body])
            of_spheres = np.full(count, -1)
            if count and other in senders.bodies:
                place = senders.bodies.index(other)
                patches, first = senders.patches[place], senders.first[place]
                nearest_spheres = patches.nearest_spheres(centers[of_body], radii[of_body])
                spheres[first : senders.first[place + 1]] = start + nearest_spheres
                gaps = np.linalg.norm(centers[of_body][:, None] - patches.centers, axis=2)
                of_spheres = first + gaps.argmin(axis=1)
            nearest.append(of_spheres)
            start += count
        return spheres, np.concatenate(nearest)

    @functools.cached_property
    def spheres_of_sources(self) -> np.ndarray:
        """The sphere that stands in for each source, among those of bodies that are not flat; −1 for none."""
        return self._nearest[0][self.senders.patch_of_source]

    def shown(
        self,
        sources: Receivers,
        cells: list[SeenCells],
        spheres: tuple[wp.array, wp.array],
        frames: wp.array | None,
    ) -> wp.array:
        """What patches show of their area towards cells, [batch, patch, cell].

        Args:
            sources: Where they are lit.
            cells: What the sources see, in parts.
            spheres: Centers and radii of all spheres.
            frames: Where flat bodies are.
        """
        normals, flats, senders = sources.normals, self.flats, self.senders
        if flats is not None:
            centers, radii = self.assembly.spheres_of(self.solid, spheres)
            numbers, points, device = self.spheres_of_sources, sources.points, normals.device
            of_sources = SpheresOfPoints(centers, radii, constant(numbers, wp.int32, device))
            fronts = find_fronts(points, normals, None, of_sources, frames, flats.all)
            normals = turn_from_flats(points, normals, radii, numbers, fronts, frames, flats.all)
        rows = [
            wp.full_like(part.past_solid, 1.0, requires_grad=False) if part.past_own is None else part.past_own
            for part in cells
        ]
        passing = joined([row.reshape((len(row), -1)) for row in rows])
        directions = cells[0].directions
        passing = passing.reshape((len(passing), len(senders.sides), len(directions)))
        return shown_areas(normals, passing, senders.mean, directions)


class Outgoing:
    """What patches send, in the forms in which receivers take it; each is found when it is first asked for.

    Args:
        stand_ins: What stands in for the bodies whose patches they are.
        radiosity: Of the patches, vec3 of shape [batch, patch].
        shown: Part of the area of each patch that it shows towards each cell, [batch, patch, cell].
        spheres: Centers and radii of all spheres.
        frames: Where flat bodies are, vec3 of shape [batch, 3 · flat].
    """

    def __init__(
        self,
        stand_ins: StandIns,
        radiosity: wp.array,
        shown: wp.array,
        spheres: tuple[wp.array, wp.array],
        frames: wp.array,
    ):
        self.stand_ins, self.senders, self.radiosity = stand_ins, stand_ins.senders, radiosity
        self._shown, self._spheres, self.frames = shown, spheres, frames

    def of_body(self, body: int) -> wp.array:
        """Radiosity of the patches of a body, vec3 of shape [batch, patch]."""
        place = self.senders.bodies.index(body)
        return cut(self.radiosity, *self.senders.first[place : place + 2].tolist())

    @functools.cached_property
    def of_spheres(self) -> tuple[wp.array, wp.array, wp.array, Clusters]:
        """Centers and radii of the spheres that stand in for bodies, what they send towards cells, and clusters."""
        stand_ins = self.stand_ins
        centers, radii = stand_ins.assembly.spheres_of(stand_ins.solid, self._spheres)
        given = self.radiosity, self._shown, self.senders.areas, *stand_ins.patches_of_spheres
        return centers, radii, sphere_exitance(*given), find_clusters(centers, radii, stand_ins.merging)


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
        stand_ins = outgoing.stand_ins
        skip = stand_ins.assembly.spheres_among(stand_ins.solid, group.body)
        if skip == (0, int(stand_ins.assembly.sphere_counts[stand_ins.solid].sum())):
            return None
        own_centers, own_radii, exitance, clusters = outgoing.of_spheres
        count = common_batch({"geometry": group.points, "light": exitance})
        spheres = own_centers, own_radii
        points, normals, centers, radii = (expand(a, count) for a in (group.points, group.normals, *spheres))
        given = (
            points,
            normals,
            centers,
            radii,
            exitance,
            expand_rows(cells.past_solid, count),
            cells.past_own,
            cells.directions,
        )
        options: dict[str, Any] = {"skip": skip}
        if radii is own_radii and centers is own_centers:
            options["clusters"] = clusters
        visibility = self._visibility
        return sphere_light(*given, softness=visibility.softness, merging=visibility.merging, **options)
