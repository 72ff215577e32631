"""Light that bounces between bodies, by the spheres that stand in for them.

Patches of bodies have a radiosity B, what they send if direct light S and bounced light I meet them:

    B = a (S + I),   I = G[B],

and G is applied as often as light bounces: first at the sources, points where patches are lit, at last at the receivers
of the image. G has three parts, each a stage of its own: what a body's own patches send to it, what flat bodies send,
and what bodies send that spheres stand in for. Where the light of a cell is blocked one of them takes its place.
Between patches of one body the first part is a small matrix that does not change. Hollow bodies keep light for long:
there it goes on when it has bounced often enough between bodies. :mod:`.repeated` has how often.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from warpshadow.pipeline.bounces.gathering import (
    ALL_FLAT,
    Gathering,
    Outgoing,
    SeenCells,
    ShownPatches,
    StandIns,
    see_cells,
)
from warpshadow.pipeline.bounces.kept import KeptBounces
from warpshadow.pipeline.bounces.own_factors import OwnFactors
from warpshadow.pipeline.bounces.patches import ScenePatches, Senders
from warpshadow.pipeline.bounces.repeated import OWN_BOUNCES, after_bounces
from warpshadow.pipeline.by_spheres import InParts, SphereMethod
from warpshadow.pipeline.groups import Group
from warpshadow.pipeline.lighting import LitPoints, joined, receiver_words
from warpshadow.pipeline.node import Call, Node, Source
from warpshadow.pipeline.reflectance import Materials
from warpshadow.scene.scene import Bounces
from warpshadow.stages.bounces.radiosity import patch_radiosity
from warpshadow.stages.bounces.total import total_light
from warpshadow.stages.receivers import Receivers

_OF_SOURCES = " of sources"
"""Put after the names of stages."""


def _words(senders: Senders) -> str:
    """Number of sources, in words."""
    return f"{len(senders.sides):,} sources"


class SeenPart(NamedTuple):
    """Some receivers, and what they see whatever its light is."""

    transfer: wp.array  # of direct light, [batch, receiver, coefficient]
    group: Group
    cells: SeenCells


class LitPart(NamedTuple):
    """Some receivers, lit directly, and what they see of light that bounces."""

    direct: wp.array  # vec3 of shape [batch, receiver]
    group: Group
    cells: SeenCells


class SeenParts(InParts):
    """What receivers see of direct light and of light that bounces, in parts."""

    def find(self, call: Call, part: Group, taken: Any, spheres: tuple[wp.array, wp.array]) -> SeenPart:
        """What a part sees."""
        seen = self.see(call, part, taken)
        return SeenPart(self.light(call, part, seen, taken), part, see_cells(self.method, part, seen, taken, spheres))


class LitParts(Node):
    """Direct light, in parts.

    Args:
        seen: What they see.
        taken: What the method takes of the light.
        words: Number of receivers, in words.
        where: Put after the name of its stage.
        others: More that it depends on.
        beside: As for :class:`Node`.
    """

    def __init__(
        self,
        seen: SeenParts,
        taken: Node,
        words: str | Callable[[], str],
        where: str = "",
        others: tuple[Node, ...] = (),
        beside: tuple[Node, ...] = (),
    ):
        self._seen = seen
        self._shade = Node(f"shading{where}", seen.method.light_part, seen, taken, items=words, keeps=False)
        super().__init__("", None, taken, *others, beside=(seen, self._shade, *beside))

    def compute(self, call: Call) -> Any:
        """Light all parts."""
        (taken,) = self.values(call)
        return [self._light(call, part, taken) for part in self._seen.value(call)]

    def _light(self, call: Call, part: SeenPart, taken: Any) -> LitPart:
        return LitPart(self._shade.run(call, part.transfer, part.group, taken), part.group, part.cells)


class Sources(NamedTuple):
    """Nodes of the points at which patches are lit."""

    seen: SeenParts  # what they see
    frames: Node  # of flat bodies
    shown: Node  # patches as receivers see them


class Radiosity(Node):
    """What patches send in the end: of direct light, and of all bounces but the last, which the receivers find."""

    def __init__(
        self,
        count: Bounces,
        stand_ins: StandIns,
        own_factors: OwnFactors,
        gathering: Gathering,
        lit: Node,
        albedo: Node,
        sources: Sources,
    ):
        _, frames, shown = sources
        self._count, self._stand_ins, self._own_factors, self._gathering = count, stand_ins, own_factors, gathering
        senders = stand_ins.senders
        words = f"{len(senders.areas):,} patches"
        idle = ALL_FLAT if all(senders.assembly.is_flat[body] for body in senders.bodies) else ""
        self._reflect = Node("radiosity", patch_radiosity, albedo, lit, items=words, keeps=False)
        self._own = Node("own light of patches", patch_radiosity, albedo, lit, items=words, idle=idle, keeps=False)
        beside = self._reflect, self._own, *gathering.stages
        super().__init__("", None, lit, albedo, shown, frames, beside=beside)

    def compute(self, call: Call) -> Outgoing:
        """Reflect direct light, then light that has bounced once, and so on; what bodies send themselves for longer."""
        lit, albedo, shown, frames = self.values(call)
        senders, count = self._stand_ins.senders, self._count
        between = None if self._own.idle else self._own_factors.between_patches(senders, [part.group for part in lit])

        def sent(radiosity: wp.array) -> Outgoing:
            return Outgoing(self._stand_ins, radiosity, shown, frames)

        def past_own(radiosity: wp.array | None) -> wp.array:
            """Radiosity of patches by light from the sky and from other bodies."""
            if radiosity is None:
                parts = [part.direct for part in lit]
            else:
                outgoing = sent(radiosity)
                parts = [self._light(call, part, outgoing) for part in lit]
            return self._reflect.run(call, albedo, joined(parts), senders.mean)

        def with_own(past: wp.array, radiosity: wp.array | None) -> wp.array:
            if between is None or radiosity is None:
                return past
            return total_light([past, self._own.run(call, albedo, radiosity, between)])

        own_bounces = 0 if between is None else OWN_BOUNCES
        return sent(after_bounces(count, past_own, with_own, senders.areas, own_bounces=own_bounces))

    def _light(self, call: Call, part: LitPart, outgoing: Outgoing) -> wp.array:
        """Light of a part of the sources past its own body, from the sky and from others."""
        return total_light([part.direct, *self._gathering.run(call, part.group, part.cells, outgoing)])


class BouncedShading(LitParts):
    """Shading of receivers, direct and bounced.

    Args:
        seen: What they see; one part after another where nothing of it is kept.
        taken: What the method takes of the light.
        words: Number of receivers, in words.
        radiosity: What patches send.
        gathering: What receivers get of that.
    """

    def __init__(
        self, seen: SeenParts, taken: Node, words: Callable[[], str], radiosity: Radiosity, gathering: Gathering
    ):
        self._gathering = gathering
        super().__init__(seen, taken, words, others=(radiosity,), beside=gathering.stages)

    def compute(self, call: Call) -> wp.array:
        """Light all parts, directly and by what patches send."""
        taken, outgoing = self.values(call)
        parts = self._seen.value(call) if self._seen.keeps else self._seen.parts(call)
        return joined([self._bounced(call, self._light(call, part, taken), outgoing) for part in parts])

    def _bounced(self, call: Call, part: LitPart, outgoing: Outgoing) -> wp.array:
        return total_light([part.direct, *self._gathering.run(call, part.group, part.cells, outgoing)])


class SphereBounces:
    """How light bounces in a scene in which spheres stand in for bodies.

    Args:
        method: How light is blocked.
    """

    def __init__(self, method: SphereMethod):
        self._method, self._count = method, method.assembly.scene.bounces
        self._patches = ScenePatches(method.assembly)
        self._own_factors = OwnFactors(method.own_shadows, self._patches, progress=method.progress)
        self._stand_ins: dict[Senders, StandIns] = {}

    def shading(self, points: LitPoints, taken: Node, light: Source, materials: Materials) -> Node:
        """Node of the shading of points, direct and bounced, vec3 of shape [batch, receiver].

        What points see in a light is kept where colors vary; where they do not, the shading is.

        Args:
            points: The receivers.
            taken: What the method takes of the light.
            light: The light, known.
            materials: What the bodies reflect.
        """
        return self._shading(points, taken, taken, light, materials, is_free=False)

    def free_shading(self, points: LitPoints, taken: Node, light: Source, materials: Materials) -> Node:
        """The same in free light; what points see in any such light is kept."""
        return self._shading(points, taken, self._method.taken_if_free, light, materials, is_free=True)

    def _shading(
        self, points: LitPoints, taken: Node, seen_in: Any, light: Source, materials: Materials, *, is_free: bool
    ) -> Node:
        """Shading of points, given what the method takes of the light, and of that what they see depends on."""
        method, senders = self._method, self._patches.senders(materials)
        if not senders.bodies:
            idle = Node("bounces", None, idle="every body is black")
            return InParts(method, points, taken, light, joined, beside=(idle,))
        stand_ins = self._stand_ins.setdefault(senders, StandIns(senders, method.visibility.merging))
        see = functools.partial(SeenParts, method, taken=seen_in, light=light, finish=list, is_shaded=False)
        key, is_kept = None if is_free else light, is_free or materials is not points.materials
        seen = points.kept("seen", (key, is_kept), lambda: see(points, keeps=is_kept))
        of_sources = points.kept("of sources", (key, senders), lambda: self._sources(see, stand_ins, points))
        radiosity = self._radiosity(of_sources, taken, stand_ins, materials)
        words = functools.partial(receiver_words, points)
        at_points = self._gathering(senders, (points.receivers_node, radiosity), words)
        return BouncedShading(seen, taken, words, radiosity, at_points)

    def _sources(self, see: Callable[..., SeenParts], stand_ins: StandIns, points: LitPoints) -> Sources:
        """Sources among the bodies among which points are."""
        senders, flats, spheres = stand_ins.senders, stand_ins.flats, points.spheres

        def show(sources: Receivers, seen: list[SeenPart], *given: Any) -> ShownPatches:
            return stand_ins.shown(sources, [part.cells for part in seen], *given)

        make = functools.partial(Node, "sources", senders.sources, points.vertices, points.normals)
        sources = points.kept("sources", senders, lambda: make(items=_words(senders)))
        seen = see(self._at(sources, points, points.materials, stand_ins.blocker_of_source), where=_OF_SOURCES)
        frames = Node("", flats.all.frames if flats else lambda _: None, points.vertices)
        return Sources(seen, frames, Node("", show, sources, seen, spheres, frames))

    def _radiosity(self, sources: Sources, taken: Node, stand_ins: StandIns, materials: Materials) -> Radiosity:
        """What patches send in the light in which sources are."""
        senders, why_not = stand_ins.senders, "light bounces once" if self._count == 1 else ""
        lit = LitParts(sources.seen, taken, _words(senders), _OF_SOURCES)
        albedo = self._patches.albedo(materials, senders.bodies)
        given = lit, albedo, sources.frames
        among = self._gathering(senders, given, _words(senders), _OF_SOURCES, why_not, only_others=True)
        return Radiosity(self._count, stand_ins, self._own_factors, among, lit, albedo, sources)

    def _gathering(self, senders: Senders, *given: Any, **options: Any) -> Gathering:
        return Gathering(self._method.visibility, senders, self._own_factors, *given, **options)

    def kept_shading(self, points: LitPoints, taken: Any, light: Source, materials: Materials) -> Node:
        """The same of points that do not move: what they and the sources see is kept, and so are form factors by rays.

        Args:
            points: The receivers, among bodies that stand where the scene has them.
            taken: What the method takes of the light.
            light: The light, known.
            materials: What the bodies reflect.
        """
        sources, at_sources = self._kept_sources(points, materials)
        direct = points.kept("direct", light, lambda: InParts(self._method, points, taken, light, joined))
        make = functools.partial(InParts, self._method, at_sources, taken, light, joined, where=_OF_SOURCES)
        lit = points.kept("direct at sources", (light, sources), make)
        return self._still.in_known_light(direct, lit, points, materials)

    def kept_free_shading(self, direct: Node, points: LitPoints, light: Source, materials: Materials) -> Node:
        """The same in free light.

        Args:
            direct: Node of the direct shading of the receivers, vec3 of shape [batch, receiver].
            points, light, materials: As above.
        """
        sources, at_sources = self._kept_sources(points, materials)
        transfers = points.kept("transfer", sources, lambda: self._method.transfers(at_sources, _OF_SOURCES))
        return self._still.in_free_light(direct, transfers, light, points, materials)

    def _kept_sources(self, points: LitPoints, materials: Materials) -> tuple[Node, LitPoints]:
        """Node of the sources of bodies that do not move, and these as points that are lit."""
        sources = self._still.sources(points, materials)
        return sources, points.kept("lit sources", sources, lambda: self._at(sources, points, materials))

    @functools.cached_property
    def _still(self) -> KeptBounces:
        return KeptBounces(self._patches, self._count, progress=self._method.progress)

    def _at(
        self, sources: Node, points: LitPoints, materials: Materials, blocker_of_point: np.ndarray | None = None
    ) -> LitPoints:
        """Sources, to be lit among the bodies among which points are; the blockers nearest to them, if any."""
        given = self._method, materials, points.vertices, points.spheres, sources, points.call
        return LitPoints(*given, normals=points.normals, blocking=points.blocking, blocker_of_point=blocker_of_point)
