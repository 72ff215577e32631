"""Shading where spheres stand in for bodies: what such methods do, and the nodes of what they find of receivers."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from typing import Any, Protocol

import numpy as np
import warp as wp

from warpshadow.assets.light import EnvironmentMap
from warpshadow.device.progress import progress_bar
from warpshadow.pipeline.assembly import Geometry
from warpshadow.pipeline.flats import SceneFlats
from warpshadow.pipeline.groups import Group, Grouping, Seen
from warpshadow.pipeline.lighting import (
    LARGEST_COEFFICIENT,
    KnownLight,
    LitPoints,
    Method,
    converted,
    joined,
    receiver_words,
)
from warpshadow.pipeline.node import Call, Fixed, Node, Source
from warpshadow.pipeline.own_shadows import Blocking
from warpshadow.pipeline.reflectance import Materials
from warpshadow.pipeline.static import Rows, Static
from warpshadow.stages.shading import shade


class Bouncing(Protocol):
    """How light bounces in a scene: what is added to a method of spheres."""

    def shading(self, points: LitPoints, taken: Node, light: Source, materials: Materials) -> Node:
        """Shading of points, direct and bounced, given what the method takes of the light."""

    def free_shading(self, points: LitPoints, taken: Node, light: Source, materials: Materials) -> Node:
        """The same in free light."""

    def kept_shading(self, points: LitPoints, taken: Any, light: Source, materials: Materials) -> Node:
        """The same of points that do not move; what does not depend on light and materials is kept."""

    def kept_free_shading(self, direct: Node, points: LitPoints, light: Source, materials: Materials) -> Node:
        """The same in free light, given the direct shading."""


class SphereMethod(Method):
    """A method in which spheres stand in for the bodies: visibility, transfer vectors, and shading.

    Attributes:
        taken_if_free: What the method takes of any free light.
        why_no_shadows: Why the method has no shadows, in words; empty if it has.
        bounces: How light bounces; None where it does not.
        joins_kept: Whether visibility is found of kept rows and of what moves together.
        shades_what_is_seen: Whether known light is shaded without transfer vectors, by :meth:`light_seen`.
    """

    taken_if_free: Any
    why_no_shadows = ""
    joins_kept = False
    shades_what_is_seen = False
    bounces: Bouncing | None = None

    @functools.cached_property
    def blocking_flats(self) -> tuple[int, ...]:
        """Bodies that block as the planes in which they lie, in place of their spheres."""
        return ()

    @functools.cached_property
    def flats(self) -> SceneFlats:
        """The bodies that lie in planes."""
        return SceneFlats(self.assembly)

    def flats_in(self, geometry: Geometry | None) -> tuple[int, ...]:
        """Bodies that block as planes in a geometry, by default the scene's: where light does not bounce, no deformed
        ones.
        """
        deformed = () if geometry is None or self.assembly.scene.bounces else geometry.deformed
        return tuple(body for body in self.blocking_flats if body not in deformed)

    def past_flats(self, group: Group, seen: Seen, taken: Any) -> Seen:
        """What a group sees past the flat bodies around it, too, of what it sees past all else."""
        raise NotImplementedError

    def taken_from(self, light: KnownLight) -> Any:
        """What the method takes of known light: its coefficients, and what they belong to."""
        raise NotImplementedError

    def coefficient_count(self, light: Source | None) -> int:
        """Number of coefficients of the light that take part; None: light that is not known yet, so all of them."""
        raise NotImplementedError

    def look_up(self, bodies: tuple[int, ...], rotations: wp.array, taken: Any) -> dict[int, Any]:
        """What receivers of some bodies see past these, :attr:`Group.own_shadow` by body. Differentiable: rotations."""
        raise NotImplementedError

    def see(self, group: Group, taken: Any) -> Seen:
        """Visibility, or transmittance, past a group's spheres and its own body."""
        raise NotImplementedError

    def transfer(self, seen: Seen, group: Group, taken: Any) -> wp.array:
        """Transfer vectors of a group."""
        raise NotImplementedError

    def light_part(self, transfer: wp.array, group: Group, taken: Any) -> wp.array:
        """Shading of a group in known light."""
        return shade(transfer, taken.coefficients, most=LARGEST_COEFFICIENT)

    def light_seen(self, seen: Seen, group: Group, taken: Any) -> wp.array:
        """Shading of a group in known light."""
        raise NotImplementedError

    def sharp_share(self, group: Group) -> np.ndarray | None:
        """Light of the scene whose shadows are sharpest, as a group gets it, over all light if nothing blocked any.

        Returns:
            Shape [batch, receiver]; None where no shadow is sharp.
        """
        return None

    def kept_rows(self, static: Static, light: Source | None, blocking: Blocking) -> Rows:
        """Rows of what static bodies block, of known light or of any."""
        raise NotImplementedError

    @functools.cached_property
    def _taken_from_scene(self) -> Node:
        return Node("", self.taken_from, self.light)

    def shading(self, points: LitPoints, light: Source, materials: Materials) -> Node:
        """Shading of points in known light, which bounces from the materials."""
        taken = self._taken_from_scene if light is self.light else Node("", self.taken_from, light)
        if self.bounces is not None:
            is_kept = points.stands and materials is not points.materials
            return (self.bounces.kept_shading if is_kept else self.bounces.shading)(points, taken, light, materials)
        return InParts(self, points, taken, light, joined)

    def free_shading(self, points: LitPoints, light: Source, materials: Materials) -> Node:
        """Shading of points in free light; where it bounces between what moves, found as if the light were known."""
        if self.bounces is not None and not points.stands:
            return self.bounces.free_shading(points, Node("", self._taken_if_given, light), light, materials)
        direct = super().free_shading(points, light, materials)
        return direct if self.bounces is None else self.bounces.kept_free_shading(direct, points, light, materials)

    def openness(self, points: LitPoints) -> Node:
        """Light that points reflect as white surfaces under an even sky of 1, vec3 of shape [batch, receiver]."""
        sky = Source("light", EnvironmentMap.constant(1.0))
        return InParts(self, points, Node("", self.taken_from, sky), sky, joined, where=" in an even sky")

    def _taken_if_given(self, light: wp.array) -> Any:
        """What the method takes of free light that is given. Differentiable: light."""
        return self.taken_if_free._replace(coefficients=converted(light, self.native_from_basis))

    def transfers(self, points: LitPoints, where: str = "") -> Node:
        """Transfer vectors of points to :attr:`basis`; where they vary, to what the method computes in."""
        matrix = self.native_from_basis
        transfers = InParts(self, points, self.taken_if_free, None, list, keeps=matrix is None, where=where)
        if matrix is None or transfers.requires_grad:
            return transfers

        def to_basis(native: list[wp.array]) -> list[wp.array]:
            return [wp.array(each.numpy() @ matrix, dtype=wp.float32, device=each.device) for each in native]

        return Node("", to_basis, transfers)


class InParts(Node):
    """Shading or transfer vectors of receivers, found group by group and part by part.

    So without a gradient transfer vectors of all receivers are in memory at once only where light is free.

    Args:
        method: The method.
        points: The receivers.
        taken: What the method takes of the light.
        light: Known or free light; None where it is not given yet: parts end with transfer vectors.
        finish: What is made of the list of those of all parts.
        keeps: As for :class:`Node`.
        where: Put after the names of its stages, where others have those names.
        is_shaded: Whether parts are shaded in known light; else they end with transfer vectors, too.
        beside: As for :class:`Node`.
    """

    def __init__(
        self,
        method: SphereMethod,
        points: LitPoints,
        taken: Any,
        light: Source | None,
        finish: Callable[[list[wp.array]], Any],
        *,
        keeps: bool = True,
        where: str = "",
        is_shaded: bool = True,
        beside: tuple[Node, ...] = (),
    ):
        self.method, self._grouping = method, Grouping(points, method.flats)
        self._finish, self._progress = finish, method.progress and light is not None
        receivers, spheres, words = points.receivers_node, points.spheres, functools.partial(receiver_words, points)
        own_shadows = _own_shadows(method, points, taken)
        self._visibility = Node(
            f"visibility{where}",
            method.see,
            receivers,
            spheres,
            taken,
            own_shadows,
            items=lambda: _pairs(method, points),
            idle=lambda: _why_unblocked(method, points),
            keeps=False,
        )
        flats = points.blocking.flats
        place = functools.partial(method.flats.frames, flats) if flats else lambda _: None
        frames = Node("", place, points.vertices)
        corners = Node("", method.flats.corners if method.flats.numbers else lambda _: None, points.vertices)
        self._passing = Node(
            f"flats{where}",
            method.past_flats,
            receivers,
            self._visibility,
            taken,
            frames,
            items=lambda: f"{words()} × {len(flats)} flat {'body' if len(flats) == 1 else 'bodies'}",
            idle="" if flats else "spheres stand in for what casts shadows",
            keeps=False,
        )
        is_lit = light is not None and is_shaded
        self._is_transferred = not (is_lit and method.shades_what_is_seen)
        self._transfer = result = Node(
            f"transfer{where}",
            method.transfer if self._is_transferred else None,
            self._passing,
            taken,
            items=lambda: f"{words()} × {method.coefficient_count(light)} coefficients",
            idle="" if self._is_transferred else "known light is shaded without transfer vectors",
            keeps=False,
        )
        self._shading = None
        if is_lit:
            shade_part = method.light_part if self._is_transferred else method.light_seen
            given = self._transfer, taken
            self._shading = result = Node(f"shading{where}", shade_part, *given, items=words, keeps=False)
        shadows = _static_shadows(method, points, light)
        kept_rows = shadows if shadows.function else None
        looked_up: Node | dict = own_shadows if own_shadows.function else {}
        before = receivers, spheres, taken, kept_rows, looked_up, frames, corners
        super().__init__("", None, *before, beside=(own_shadows, shadows, result, *beside), keeps=keeps)

    def compute(self, call: Call) -> Any:
        """Find it for all parts."""
        return self._finish(list(self.parts(call)))

    def parts(self, call: Call) -> Iterator[Any]:
        """Find it for one part after another."""
        receivers, spheres, taken, kept_rows, looked_up, *planes = self.values(call)
        groups = self._grouping.groups(call, receivers, spheres, kept_rows, looked_up, *planes)
        total = len(receivers.on_static) + receivers.points.shape[1]
        with progress_bar(total, "shading", "receiver", wanted=self._progress) as bar:
            for group in groups:
                for part in group.parts():
                    yield self.find(call, part, taken, spheres)
                    bar.update(part.points.shape[1])

    def find(self, call: Call, part: Group, taken: Any, spheres: tuple[wp.array, wp.array]) -> Any:
        """Find it for a part, given what the method takes of the light, and all spheres."""
        return self.light(call, part, self.see(call, part, taken), taken)

    def see(self, call: Call, part: Group, taken: Any) -> Seen:
        """What a part sees."""
        seen = self._visibility.run(call, part, taken)
        return seen if part.flats is None else self._passing.run(call, part, seen, taken)

    def light(self, call: Call, part: Group, seen: Seen, taken: Any) -> wp.array:
        """Transfer vectors of a part that sees something, or its shading."""
        if not self._is_transferred:
            assert self._shading is not None
            return self._shading.run(call, seen, part, taken)
        transfer = self._transfer.run(call, seen, part, taken)
        return transfer if self._shading is None else self._shading.run(call, transfer, part, taken)


def _sphere_counts(method: SphereMethod, points: LitPoints) -> np.ndarray:
    """Number of spheres by which each body blocks light."""
    bodies = np.arange(len(method.assembly.scene.bodies))
    return np.where(np.isin(bodies, points.blocking.flats), 0, method.assembly.sphere_counts)


def _pairs(method: SphereMethod, points: LitPoints) -> str:
    """Receivers and the spheres that block them, in words."""
    counts = _sphere_counts(method, points)
    words = f"{receiver_words(points, static=False)} × {counts.sum():,} spheres"
    if points.static is None:
        return words
    moving = counts[list(points.static.moving)].sum()
    return f"{words}, {receiver_words(points, moving=False)} on static bodies × {moving:,} spheres"


def _why_unblocked(method: SphereMethod, points: LitPoints) -> str:
    """Why no visibility has to be found; empty if it has."""
    counts, (_, moving, static) = _sphere_counts(method, points), points.counts()
    if method.why_no_shadows or not counts.sum():
        rest = "but flat ones " if points.blocking.flats else ""
        return method.why_no_shadows or f"no body {rest}has blockers"
    if moving or (points.static and static and (method.joins_kept or counts[list(points.static.moving)].sum())):
        return ""
    return "no moving body has blockers" if static else "nothing is seen"


def _own_shadows(method: SphereMethod, points: LitPoints, taken: Any) -> Node:
    """Node of what bodies' receivers look up of their own bodies, by body."""
    bodies, rotations = points.blocking.traced, points.blocking.rotations
    named = [body for body in bodies if not method.assembly.is_flat[body]]
    if not named or rotations is None:
        return Node("own shadows", None, idle=lambda: _why_no_own(method, points))

    def state() -> str:
        missing = method.own_shadows.missing(bodies)
        known = f"{missing} to be traced, or read from the cache" if missing else "traced once, kept"
        return f"{len(named)} {'body' if len(named) == 1 else 'bodies'}: {known}"

    return Node("own shadows", functools.partial(method.look_up, bodies), rotations, taken, items=state)


def _why_no_own(method: SphereMethod, points: LitPoints) -> str:
    """Why no body's shadow on itself is looked up."""
    if not method.traces_own_shadows:
        return "the method takes those of spheres"
    names = [body.called for body in method.assembly.scene.bodies]
    whys = {name: why for name, why in zip(names, points.blocking.why_spheres, strict=False) if why}
    return "; ".join(f"{name}: {why}" for name, why in whys.items()) or "bodies are flat"


def _static_shadows(method: SphereMethod, points: LitPoints, light: Source | None) -> Node:
    """Node of what static bodies block of the light of receivers on them; its value is None where there is nothing."""
    static = points.static
    if static is None or not static.spheres[1].shape[1]:
        bouncing = bool(method.assembly.scene.bounces)
        why = "light bounces: nothing of static bodies is kept" if bouncing else "no static body has blockers"
        return Node("static shadows", None, idle=why)
    rows = method.kept_rows(static, light, points.blocking)

    def missing() -> int:
        receivers = points.receivers_node.known(points.call)
        return rows.missing(None if receivers is None else receivers.on_static)

    return Node(
        "static shadows",
        rows.of_receivers,
        Fixed(points.receivers_node),
        static.normals,
        items=lambda: f"up to {missing():,} vertices not seen before",
        idle=lambda: method.why_no_shadows or ("" if missing() else "kept: static bodies are the same"),
        keeps=False,
    )
