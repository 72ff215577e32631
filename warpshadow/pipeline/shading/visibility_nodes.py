"""Nodes of methods with sphere blockers: visibility of receivers, transfer vectors and shading, portion by portion."""

import functools
import operator
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import warp as wp

from warpshadow.device.constants import IdentityKey
from warpshadow.device.progress import progress_bar
from warpshadow.pipeline.bodies.blockers import BlockerKinds
from warpshadow.pipeline.node import Call, ExplainRow, Input, Node, detached, identity
from warpshadow.pipeline.receivers.grouping import find_portions
from warpshadow.pipeline.receivers.groups import Group
from warpshadow.pipeline.receivers.shading_context import ShadingContext, receiver_text
from warpshadow.pipeline.shading.found_visibility import CellVisibility, HarmonicVisibility
from warpshadow.pipeline.shading.transfers import join_portions
from warpshadow.pipeline.shading.visibility_steps import ProjectedLight, VisibilitySteps


class LitPortion(NamedTuple):
    """A portion of receivers, and the results of its steps."""

    group: Group
    visibility: CellVisibility | HarmonicVisibility
    spheres: tuple[wp.array, wp.array]  # centers and radii of all spheres
    result: Any = None  # of the step after visibility: transfer vectors, or shading


class VisibilityNode(Node):
    """Visibility of receivers, found group by group and portion by portion; classes below add steps.

    Each step is a function of the method. The value is a list of the results of all portions. Without a gradient,
    known light is shaded portion by portion, and each portion's transfer vectors are dropped after it. They are kept
    for free light, and where bounces reuse them. Receivers with cached rows are one portion.

    Args:
        method: How light is blocked.
        context: The receivers.
        projected_light: The light projected for the method.
        light: Known or free light; None where it is not given yet.
        caches: As for :class:`Node`.
        suffix: Ends the names of its stages, such as " of patch samples"; by default the suffix of the points.
        result_of: Result of a portion; by default the last step's.
        join: Makes the value of the list of these; by default the list itself, of shading one array.
    """

    steps: tuple[str, ...] = ("visibility", "planes")
    """Its steps, each a row of ``explain``."""
    join: Callable[[list[Any]], Any] = staticmethod(identity)

    def __init__(
        self,
        method: VisibilitySteps,
        context: ShadingContext,
        projected_light: Node | ProjectedLight,
        light: Input | None,
        *,
        caches: bool = True,
        suffix: str | None = None,
        result_of: Callable[[LitPortion], Any] = operator.attrgetter("result"),
        join: Callable[[list[Any]], Any] | None = None,
    ):
        self.method, self._portions_of = method, find_portions_of(context)
        self._result_of, self._join = result_of, self.join if join is None else join
        self._progress, weak_context = method.progress and light is not None, context.weak_reference
        suffix, planes = context.suffix if suffix is None else suffix, context.blocker_kinds.plane_bodies
        item_text = functools.partial(receiver_text, weak_context)
        rows = {
            "visibility": ExplainRow(
                f"visibility{suffix}",
                lambda: method.scene_blockers.pairs_with(weak_context),
                lambda: _why_unblocked(method, weak_context),
            ),
            "planes": ExplainRow(
                f"planes{suffix}",
                lambda: f"{item_text()} × {len(planes)} flat {'body' if len(planes) == 1 else 'bodies'}",
                "" if planes else "no flat body casts shadows by its plane",
            ),
            "transfer": ExplainRow(
                f"transfer{suffix}",
                lambda: f"{item_text()} × {method.coefficient_count(light)} coefficients",
                "" if self.needs_transfer else "shading takes transmittance at once",
            ),
            "shading": ExplainRow(f"shading{suffix}", item_text),
        }
        self._rows = {step: rows[step] for step in self.steps}
        super().__init__(
            "",
            None,
            context.receivers_node,
            blockers_node(method, context),
            projected_light,
            self_visibility_node(method, context, projected_light),
            _static_shadows_node(method, context, light),
            None if context.static_bodies is None else context.static_bodies.normals,
            rows=tuple(self._rows.values()),
            caches=caches,
        )

    @property
    def needs_transfer(self) -> bool:
        """Whether transfer vectors are found."""
        return "transfer" in self.steps

    def compute(self, call: Call) -> Any:
        """Find it for all portions."""
        return self._join(list(self.portions(call)))

    def portions(self, call: Call) -> Iterator[Any]:
        """Find it for one portion after another."""
        receivers, blockers, projected_light, self_lookups, *of_static_bodies = self.values(call)
        total = len(receivers.static_vertices) + receivers.points.shape[1]
        with progress_bar(total, "shading", "receiver", shows=self._progress) as bar:
            for group in self._portions_of(receivers, blockers, self_lookups, *of_static_bodies):
                portion = LitPortion(group, self._find_visibility(call, group, projected_light), blockers.spheres)
                yield self._result_of(self.add_step(call, portion, projected_light))
                bar.update(group.points.shape[1])

    def _find_visibility(
        self, call: Call, group: Group, projected_light: ProjectedLight
    ) -> CellVisibility | HarmonicVisibility:
        with self.timed(call, self._rows["visibility"]):
            visibility: CellVisibility | HarmonicVisibility = self.method.find_visibility(group, projected_light)
        if group.blockers.planes is not None:
            with self.timed(call, self._rows["planes"]):
                visibility = self.method.find_visibility_past_planes(group, visibility, projected_light)
        return visibility

    def add_step(self, call: Call, portion: LitPortion, projected_light: ProjectedLight) -> LitPortion:
        """The portion with the result of the steps after visibility; none here."""
        return portion


class TransferNode(VisibilityNode):
    """Transfer vectors of receivers."""

    steps = (*VisibilityNode.steps, "transfer")

    def add_step(self, call: Call, portion: LitPortion, projected_light: ProjectedLight) -> LitPortion:
        """The portion with its transfer vectors, if they are needed."""
        if not self.needs_transfer:
            return portion
        with self.timed(call, self._rows["transfer"]):
            transfer = self.method.find_transfer(portion.visibility, portion.group, projected_light)
        return portion._replace(result=transfer)


class ShadingNode(TransferNode):
    """Shading of receivers, vec3 of shape [batch, receiver]."""

    steps = (*TransferNode.steps, "shading")
    join = staticmethod(join_portions)

    @property
    def needs_transfer(self) -> bool:
        """Whether the method shades by transfer vectors."""
        return not self.method.shades_without_transfer

    def add_step(self, call: Call, portion: LitPortion, projected_light: ProjectedLight) -> LitPortion:
        """The portion with its shading."""
        transfer = super().add_step(call, portion, projected_light).result
        with self.timed(call, self._rows["shading"]):
            result = (
                self.method.shade_transmittance(portion.visibility, portion.group, projected_light)
                if transfer is None
                else self.method.shade_transfer(transfer, portion.group, projected_light)
            )
        return portion._replace(result=result)


def find_portions_of(context: ShadingContext, *, by_body: bool = False) -> Callable[..., Iterator[Group]]:
    """Make :func:`find_portions` for the receivers of points, without a reference to these."""
    return functools.partial(
        find_portions, by_body=by_body, static_bodies=context.static_bodies, nearest_spheres=context.nearest_spheres
    )


def _why_unblocked(method: VisibilitySteps, context: ShadingContext) -> str:
    """Reason why no visibility is computed; empty if it is."""
    if method.why_no_shadows:
        return method.why_no_shadows
    blockers, kinds, static_bodies = method.scene_blockers, context.blocker_kinds, context.static_bodies
    if not blockers.has_any(kinds):
        return f"no body {'but flat ones ' if kinds.plane_bodies else ''}has blockers"
    moving, static, _ = context.counts()
    blocks_static = static_bodies and (method.adds_cached_rows or blockers.has_any(kinds, static_bodies.moving))
    if moving or (static and blocks_static):
        return ""
    return "no moving body has blockers" if static else "nothing is seen"


def blockers_node(method: VisibilitySteps, context: ShadingContext) -> Node:
    """Node of the blockers around points, where they are in the world."""
    place = functools.partial(method.scene_blockers.place_blockers, context.blocker_kinds)
    return context.cached_for_bodies("blockers", None, lambda: Node("", place, context.vertices, context.spheres))


def self_visibility_node(
    method: VisibilitySteps, context: ShadingContext, projected_light: Node | ProjectedLight
) -> Node:
    """Node of the receivers' self-visibility lookups, by body; the same for any receivers among the same bodies."""
    make = functools.partial(self_lookup_node, method, context.blocker_kinds, projected_light)
    return context.cached_for_bodies("self-visibility", IdentityKey(projected_light), make)


def self_lookup_node(
    method: VisibilitySteps, blocker_kinds: BlockerKinds, projected_light: Node | ProjectedLight
) -> Node:
    """Node of the self-visibility lookups of bodies whose rays are traced."""
    bodies, rotations, blockers = blocker_kinds.self_traced, blocker_kinds.rotations, method.scene_blockers
    curved_bodies = [body for body in bodies if not method.merged_scene.is_flat[body]]
    if not curved_bodies or rotations is None:
        return Node("self-shadows", None, why_idle=lambda: blockers.why_none_is_traced(blocker_kinds))

    def state() -> str:
        missing = blockers.self_visibility.missing(bodies)
        known = f"{missing} to be traced, or read from the cache" if missing else "traced once, cached"
        return f"{len(curved_bodies)} {'body' if len(curved_bodies) == 1 else 'bodies'}: {known}"

    return Node("self-shadows", functools.partial(method.self_lookups, bodies), rotations, projected_light, items=state)


def _static_shadows_node(method: VisibilitySteps, context: ShadingContext, light: Input | None) -> Node:
    """Node of cached transmittance past static bodies; its value is None if there are none."""
    static_bodies, weak_context = context.static_bodies, context.weak_reference
    if static_bodies is None or not static_bodies.spheres[1].shape[1]:
        light_bounces = bool(method.merged_scene.scene.bounces)
        why = "light bounces: nothing of static bodies is cached" if light_bounces else "no static body has blockers"
        return Node("static shadows", None, why_idle=why)
    rows = method.cached_rows(static_bodies, light, context.blocker_kinds)

    def missing() -> int:
        receivers = weak_context.receivers_node.value_if_known(weak_context.call)
        return rows.missing(None if receivers is None else receivers.static_vertices)

    return Node(
        "static shadows",
        rows.of_receivers,
        detached(context.receivers_node),
        static_bodies.normals,
        items=lambda: f"up to {missing():,} vertices not seen before",
        why_idle=lambda: method.why_no_shadows or ("" if missing() else "cached: static bodies are the same"),
        caches=False,
    )
