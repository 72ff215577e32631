"""Light that bounces between bodies, by the spheres that stand in for them.

Patches of bodies have a radiosity B, what they send if direct light S and bounced light I meet them:

    B = a (S + I),   I = G[B],

and G is applied as often as light bounces: first at the sources, points where patches are lit, at last at the receivers
of the image. G has three parts, each a stage of its own: what a body's own patches send to it, what flat bodies send,
and what bodies send that spheres stand in for. Where the light of a cell is blocked one of them takes its place.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from warpshadow.device.batch import common_batch, cut, expand, expand_rows
from warpshadow.maths.directions import fibonacci
from warpshadow.pipeline.by_spheres import InParts, SphereMethod
from warpshadow.pipeline.directional import Cells
from warpshadow.pipeline.groups import Group, Seen
from warpshadow.pipeline.kept_bounces import KeptBounces
from warpshadow.pipeline.lighting import LitPoints, joined, receiver_words
from warpshadow.pipeline.node import Call, Node, Source
from warpshadow.pipeline.own_factors import own_factors
from warpshadow.pipeline.patches import ScenePatches, Senders
from warpshadow.pipeline.reflectance import Materials
from warpshadow.stages.bounces.exitance import patches_of_nodes, sphere_exitance
from warpshadow.stages.bounces.flat_light import flat_light
from warpshadow.stages.bounces.openness import shown_areas, turn_from_flats
from warpshadow.stages.bounces.own_light import own_light
from warpshadow.stages.bounces.radiosity import patch_radiosity
from warpshadow.stages.bounces.sphere_light import sphere_light
from warpshadow.stages.bounces.total import total_light
from warpshadow.stages.flats.prepared import FlatBody, Flats
from warpshadow.stages.receivers import Receivers
from warpshadow.stages.shading import shade
from warpshadow.stages.sparse import SparseMatrix
from warpshadow.stages.visibility.directional import transmittance

CELLS = fibonacci(64)
"""Where receivers look for bounced light if direct light is found in harmonics."""


class SeenCells(NamedTuple):
    """What a part of receivers sees in cells of directions."""

    past_own: wp.array | None  # [batch, receiver, cell], transmittance past its own body; None where that is 1
    past_solid: wp.array  # [batch, receiver, cell], past all bodies but flats, its own included
    directions: np.ndarray  # [cell, 3]


class Outgoing:
    """What patches send, in the forms in which receivers take it; each is found when it is first asked for.

    Args:
        bounces: How light bounces.
        senders: The bodies whose patches they are.
        radiosity: Of the patches, vec3 of shape [batch, patch].
        shown: Part of the area of each patch that it shows towards each cell, [batch, patch, cell].
        spheres: Centers and radii of all spheres.
        frames: Where flat bodies are, vec3 of shape [batch, 3 · flat].
    """

    def __init__(
        self,
        bounces: SphereBounces,
        senders: Senders,
        radiosity: wp.array,
        shown: wp.array,
        spheres: tuple[wp.array, wp.array],
        frames: wp.array,
    ):
        self._bounces, self.senders, self.radiosity = bounces, senders, radiosity
        self._shown, self._spheres, self.frames = shown, spheres, frames
        self._of_spheres: dict[int | None, tuple[wp.array, wp.array, wp.array]] = {}

    def of_body(self, body: int) -> wp.array:
        """Radiosity of the patches of a body, vec3 of shape [batch, patch]."""
        place = self.senders.bodies.index(body)
        return cut(self.radiosity, *self.senders.first[place : place + 2].tolist())

    def of_spheres(self, body: int | None, directions: np.ndarray) -> tuple[wp.array, wp.array, wp.array]:
        """Centers and radii of the spheres of bodies other than one, and what they send towards cells."""
        if body not in self._of_spheres:
            bounces, senders = self._bounces, self.senders
            others = bounces.blocking(body)
            centers, radii = bounces.assembly.spheres_of(others, self._spheres)
            given = self.radiosity, self._shown, senders.areas, *bounces.patches_of_spheres(senders, body)
            self._of_spheres[body] = centers, radii, sphere_exitance(*given)
        return self._of_spheres[body]


class Gathering:
    """What receivers get of the light that patches send: G.

    Args:
        bounces: How light bounces.
        senders: The bodies whose patches send light.
        given: Nodes that radiosity, receivers and spheres depend on.
        words: Number of receivers, in words.
        where: Put after the names of its stages.
        why_not: Why nobody asks for it, in words; empty if somebody does.

    Attributes:
        stages: Nodes of its three parts.
    """

    def __init__(
        self,
        bounces: SphereBounces,
        senders: Senders,
        given: tuple[Node | Source, ...],
        words: str | Callable[[], str],
        where: str = "",
        why_not: str = "",
    ):
        self._bounces = bounces
        flats = bounces.flats
        solid = [body for body in senders.bodies if body not in flats]
        idle = (
            "" if solid else "all that reflects is flat",
            "" if len(solid) < len(senders.bodies) else "nothing flat reflects",
            "" if any(bounces.assembly.sphere_counts[body] for body in solid) else "nothing that reflects has spheres",
        )
        functions = self._from_itself, self._from_flats, self._from_spheres
        names = "own light", "flat light", "sphere light"
        self.stages = tuple(
            Node(f"{name}{where}", function, *given, items=words, idle=why_not or why, keeps=False)
            for name, function, why in zip(names, functions, idle, strict=True)
        )

    def run(self, call: Call, group: Group, cells: SeenCells, outgoing: Outgoing) -> list[wp.array]:
        """What a group gets in each way in which it gets some, vec3 of shape [batch, receiver]."""
        found = [node.run(call, group, cells, outgoing) for node in self.stages if not node.idle]
        return [light for light in found if light is not None]

    def _from_itself(self, group: Group, _: SeenCells, outgoing: Outgoing) -> wp.array | None:
        if group.body not in outgoing.senders.bodies or group.body in self._bounces.flats:
            return None
        assert group.body is not None and group.places is not None
        return own_light(self._bounces.factors(group.body), outgoing.of_body(group.body), *group.places)

    def _from_flats(self, group: Group, cells: SeenCells, outgoing: Outgoing) -> wp.array:
        flats = self._bounces.flats_of(outgoing.senders)
        assert flats is not None
        given = group.points, group.normals, cells.past_solid, outgoing.frames, outgoing.radiosity, flats.all
        return flat_light(*given, cells.directions, skip=flats.number.get(group.body))

    def _from_spheres(self, group: Group, cells: SeenCells, outgoing: Outgoing) -> wp.array | None:
        centers, radii, exitance = outgoing.of_spheres(group.body, cells.directions)
        if not radii.shape[1]:
            return None
        visibility = self._bounces.method.visibility
        count = common_batch({"geometry": group.points, "light": exitance})
        points, normals, centers, radii = (expand(a, count) for a in (group.points, group.normals, centers, radii))
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
        return sphere_light(*given, softness=visibility.softness, merging=visibility.merging)


def _shade(transfers: list[wp.array], light: wp.array) -> wp.array:
    """Light receivers by what groups of them see of free light. Differentiable: light."""
    return joined([shade(transfer, light) for transfer in transfers])


class LitPart(NamedTuple):
    """Some sources, lit directly."""

    shading: wp.array
    group: Group
    cells: SeenCells


class LitSources(InParts):
    """Direct light at the sources; what they see is kept with it, for light that bounces."""

    def __init__(self, bounces: SphereBounces, points: LitPoints, taken: Node, light: Source):
        self._bounces = bounces
        super().__init__(bounces.method, points, taken, light, list, where=" of sources")

    def find(self, call: Call, part: Group, taken: Any, spheres: tuple[wp.array, wp.array], *extra: Any) -> LitPart:
        """Light a part, and keep what it sees."""
        seen = self.see(call, part, taken)
        shading = self.light(call, part, seen, taken)
        return LitPart(shading, part, self._bounces.cells(part, seen, taken, spheres))


class Radiosity(Node):
    """What patches send in the end: of direct light, and of all bounces but the last, which the receivers find."""

    def __init__(
        self,
        bounces: SphereBounces,
        senders: Senders,
        sources: Node,
        lit: Node,
        albedo: Node,
        spheres: Source,
        frames: Node,
    ):
        self._bounces, self._senders = bounces, senders
        count = f"{len(senders.areas):,} patches"
        self._reflect = Node("radiosity", patch_radiosity, albedo, lit, items=count, keeps=False)
        given = lit, albedo, frames
        words = f"{len(senders.sides):,} sources"
        why_not = "light bounces once" if bounces.count == 1 else ""
        self._gathering = Gathering(bounces, senders, given, words, " of sources", why_not)
        beside = self._reflect, *self._gathering.stages
        super().__init__("", None, sources, lit, albedo, spheres, frames, beside=beside)

    def compute(self, call: Call) -> Outgoing:
        """Reflect direct light, then light that has bounced once, and so on."""
        sources, lit, albedo, spheres, frames = self.values(call)
        mean = self._senders.mean
        shown = self._bounces.shown(self._senders, sources, [part.cells for part in lit], spheres, frames)
        direct = joined([part.shading for part in lit])
        bounced: list[wp.array] = []
        for bounce in range(self._bounces.count):
            light = total_light([direct, *bounced])
            radiosity = self._reflect.run(call, albedo, light, mean)
            outgoing = Outgoing(self._bounces, self._senders, radiosity, shown, spheres, frames)
            if bounce + 1 < self._bounces.count:
                bounced = [joined([self._gather(call, part, outgoing) for part in lit])]
        return outgoing

    def _gather(self, call: Call, part: LitPart, outgoing: Outgoing) -> wp.array:
        parts = self._gathering.run(call, part.group, part.cells, outgoing)
        if parts:
            return total_light(parts)
        return wp.zeros((1, part.group.points.shape[1]), dtype=wp.vec3, device=outgoing.radiosity.device)


class BouncedShading(InParts):
    """Shading of receivers, direct and bounced."""

    def __init__(
        self,
        bounces: SphereBounces,
        points: LitPoints,
        taken: Node,
        light: Source,
        radiosity: Radiosity,
        senders: Senders,
    ):
        self._bounces = bounces
        given = points.receivers_node, radiosity
        self._gathering = Gathering(bounces, senders, given, functools.partial(receiver_words, points))
        stages = self._gathering.stages
        super().__init__(bounces.method, points, taken, light, joined, extra=(radiosity,), beside=stages)

    def find(self, call: Call, part: Group, taken: Any, spheres: tuple[wp.array, wp.array], *extra: Any) -> wp.array:
        """Light a part, directly and by what patches send."""
        (outgoing,) = extra
        seen = self.see(call, part, taken)
        direct = self.light(call, part, seen, taken)
        cells = self._bounces.cells(part, seen, taken, spheres)
        return total_light([direct, *self._gathering.run(call, part, cells, outgoing)])


class PlacedFlats(NamedTuple):
    """Flat bodies."""

    all: Flats
    number: dict[int | None, int]  # of each among them, by the number of the body


class SphereBounces:
    """How light bounces in a scene in which spheres stand in for bodies.

    Args:
        method: How light is blocked.

    Attributes:
        count: How often light bounces.
        patches: What sends light.
        flats: Bodies that lie in a plane.
    """

    def __init__(self, method: SphereMethod):
        self.method, self.assembly = method, method.assembly
        self.count = method.assembly.scene.bounces
        self.patches = ScenePatches(method.assembly)
        self.flats = self.patches.flats
        self._factors: dict[int, SparseMatrix] = {}
        self._flats: dict[Senders, PlacedFlats] = {}
        self._spheres_of_sources: dict[Senders, np.ndarray] = {}
        self._nodes: dict[tuple[Senders, int | None], tuple[np.ndarray, np.ndarray]] = {}

    def shading(self, points: LitPoints, taken: Node, light: Source, materials: Materials) -> Node:
        """Node of the shading of points, direct and bounced, vec3 of shape [batch, receiver].

        Args:
            points: The receivers.
            taken: What the method takes of the light.
            light: The light.
            materials: What the bodies reflect.
        """
        senders = self.patches.senders(materials)
        if not senders.bodies:
            idle = Node("bounces", None, idle="every body is black")
            return InParts(self.method, points, taken, light, joined, beside=(idle,))
        frames = self._frames(points, senders)
        words = f"{len(senders.sides):,} sources"
        sources = Node("sources", senders.sources, points.vertices, points.normals, items=words)
        lit = LitSources(self, self._at(sources, points, materials), taken, light)
        albedo = self.patches.albedo(materials, senders.bodies)
        radiosity = Radiosity(self, senders, sources, lit, albedo, points.spheres, frames)
        return BouncedShading(self, points, taken, light, radiosity, senders)

    def kept_shading(self, points: LitPoints, taken: Any, light: Source, materials: Materials) -> Node:
        """The same of points that stand still: what they and the sources see is kept, and so are form factors by rays.

        Args:
            points: The receivers, among bodies that stand where the scene has them.
            taken: What the method takes of the light, or of any where it is free.
            light: The light, known or free.
            materials: What the bodies reflect.
        """
        sources, where = self._still.sources(points, materials), " of sources"
        at_sources = points.kept("lit sources", sources, lambda: self._at(sources, points, materials))
        if isinstance(light.value(), wp.array):
            direct = Node("shading", _shade, points.transfers, light)
            transfers = points.kept("transfer", sources, lambda: self.method.transfers(at_sources, where))
            return self._still.in_free_light(direct, transfers, light, points, materials)
        direct = points.kept("direct", light, lambda: InParts(self.method, points, taken, light, joined))
        make = functools.partial(InParts, self.method, at_sources, taken, light, joined, where=where)
        lit = points.kept("direct at sources", (light, sources), make)
        return self._still.in_known_light(direct, lit, points, materials)

    @functools.cached_property
    def _still(self) -> KeptBounces:
        return KeptBounces(self.patches, self.count, progress=self.method.progress)

    def _at(self, sources: Node, points: LitPoints, materials: Materials) -> LitPoints:
        """Sources, to be lit among the bodies among which points are."""
        given = self.method, materials, points.vertices, points.spheres, sources, points.call
        return LitPoints(*given, normals=points.normals, blocking=points.blocking)

    def _frames(self, points: LitPoints, senders: Senders) -> Node:
        """Node of where flat bodies are; its value is None without any."""
        flats = self.flats_of(senders)
        return Node("", flats.all.frames if flats else lambda _: None, points.vertices)

    def flats_of(self, senders: Senders) -> PlacedFlats | None:
        """The flat bodies among the senders; None without any."""
        numbers = [number for number in senders.bodies if number in self.flats]
        if senders not in self._flats and numbers:
            bodies = []
            for number in numbers:
                place, mesh = senders.bodies.index(number), self.assembly.scene.bodies[number].mesh
                grid, blocks = senders.patches[place].grid, self.assembly.scene.bodies[number].casts_shadow
                assert grid is not None
                starts = int(self.assembly.first_vertex[number]), int(senders.first[place])
                bodies.append(FlatBody(grid, mesh.positions, mesh.surface.faces, *starts, blocks))
            counts = len(senders.areas), int(self.assembly.first_vertex[-1])
            found = Flats.of(bodies, *counts, device=self.assembly.device)
            self._flats[senders] = PlacedFlats(found, {number: k for k, number in enumerate(numbers)})
        return self._flats.get(senders)

    def patches_of_spheres(self, senders: Senders, body: int | None) -> tuple[np.ndarray, np.ndarray]:
        """The patches that each sphere that blocks a body's receivers stands in for: where they begin, and numbers."""
        key = senders, body
        if key not in self._nodes:
            self._nodes[key] = patches_of_nodes(*self._nearest(senders, body), merging=self.method.visibility.merging)
        return self._nodes[key]

    def _nearest(self, senders: Senders, body: int | None) -> tuple[np.ndarray, np.ndarray]:
        """For each patch the nearest sphere of its body, and for each sphere the nearest patch; −1 for none."""
        rest, first_sphere = self.assembly.rest, self.assembly.first_sphere
        centers, radii = rest.centers.numpy()[0], rest.radii.numpy()[0]
        spheres, start = np.full(len(senders.areas), -1, np.int32), 0
        nearest = [np.empty(0, int)]
        for other in self.blocking(body):
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

    def blocking(self, body: int | None) -> list[int]:
        """Bodies whose spheres block the light of a body's receivers: neither flat ones nor itself."""
        return [other for other in range(len(self.assembly.scene.bodies)) if other != body and other not in self.flats]

    def shown(
        self,
        senders: Senders,
        sources: Receivers,
        cells: list[SeenCells],
        spheres: tuple[wp.array, wp.array],
        frames: wp.array | None,
    ) -> wp.array:
        """What patches show of their area towards cells, [batch, patch, cell].

        Args:
            senders: The bodies whose patches they are.
            sources: Where these are lit.
            cells: What the sources see, in parts.
            spheres: Centers and radii of all spheres.
            frames: Where flat bodies are.
        """
        normals, flats = sources.normals, self.flats_of(senders)
        if flats is not None:
            _, radii = self.assembly.spheres_of(self.blocking(None), spheres)
            normals = turn_from_flats(sources.points, normals, radii, self._spheres_of(senders), frames, flats.all)
        rows = [
            wp.full_like(part.past_solid, 1.0, requires_grad=False) if part.past_own is None else part.past_own
            for part in cells
        ]
        passing = joined([row.reshape((len(row), -1)) for row in rows])
        directions = cells[0].directions
        passing = passing.reshape((len(passing), len(senders.sides), len(directions)))
        return shown_areas(normals, passing, senders.mean, directions)

    def _spheres_of(self, senders: Senders) -> np.ndarray:
        """The sphere that stands in for each source, among those of bodies that are not flat; −1 for none."""
        if senders not in self._spheres_of_sources:
            self._spheres_of_sources[senders] = self._nearest(senders, None)[0][senders.patch_of_source]
        return self._spheres_of_sources[senders]

    def cells(self, group: Group, seen: Seen, taken: Any, spheres: tuple[wp.array, wp.array]) -> SeenCells:
        """What a group sees in cells, of what it sees, what the method takes of the light, and all spheres."""
        if isinstance(taken, Cells):
            directions, past_own = taken.directions, seen.past_own
            past_solid = seen.past_all if seen.past_solid is None else seen.past_solid
        else:
            directions, past_own = CELLS, None
            past_solid = self._transmittance(group, self.blocking(None), spheres, directions)
        if past_own is None and group.body is not None and group.body not in self.flats:
            past_own = self._transmittance(group, [group.body], spheres, directions)
        if past_solid is None:
            past_solid = wp.full((*group.points.shape, len(directions)), 1.0, wp.float32, device=group.points.device)
        return SeenCells(past_own, past_solid, directions)

    def _transmittance(
        self, group: Group, bodies: list[int], spheres: tuple[wp.array, wp.array], directions: np.ndarray
    ) -> wp.array | None:
        """Transmittance of the spheres of some bodies, [batch, receiver, cell]; None without any."""
        blocking = self.assembly.spheres_of(bodies, spheres)
        if not (blocking[1].shape[1] and group.points.size):
            return None
        softness, merging = self.method.visibility.softness, self.method.visibility.merging
        return transmittance(group.points, group.normals, *blocking, directions, softness=softness, merging=merging)

    def factors(self, body: int) -> SparseMatrix:
        """What share of the hemisphere of each of a body's sites its own patches take, found once, by rays."""
        if body not in self._factors:
            sites, patches = self.method.own_shadows.sites(body), self.patches.of_body(body)
            faces = self.assembly.scene.bodies[body].mesh.surface.faces
            vertices = sites.positions[: self.assembly.first_vertex[body + 1] - self.assembly.first_vertex[body]]
            points, normals = sites.positions, sites.normals
            if self.assembly.is_two_sided[body]:
                points, normals = np.tile(points, (2, 1)), np.concatenate([normals, -normals])
            given = patches, vertices, faces, points, normals
            found = own_factors(*given, device=self.assembly.device, progress=self.method.progress)
            self._factors[body] = SparseMatrix.of(found, device=self.assembly.device)
        return self._factors[body]
