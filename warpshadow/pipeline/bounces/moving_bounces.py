"""Bounces where geometry may move: patches reflect light in each call, by the proxies of their bodies.

Patches have a radiosity B, reflected from direct light S and bounced light I:

    B = a (S + I),   I = G[B]

G is applied as often as light bounces: first at patch samples, at last at the receivers of the image. It is a sum of
three stages: light from a body's own patches, from plane bodies, and from the proxies of other bodies. None counts
twice: the blocked part of a cell sends light of one of them alone.

The first is a small matrix that does not change. Hollow bodies hold light long, so it is applied ``SELF_BOUNCES`` more
times: after the last bounce between bodies; with bounces "all" after each of them.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import warp as wp

from warpshadow.device.batch import cut
from warpshadow.pipeline.bodies.reflectance import Materials
from warpshadow.pipeline.bounces.cell_transmittance import find_cell_transmittance
from warpshadow.pipeline.bounces.gathering import ALL_FLAT, BounceGatherer, OutgoingRadiance, PortionForBounces
from warpshadow.pipeline.bounces.patches import OF_PATCH_SAMPLES, ScenePatches, Senders, lit_patch_samples
from warpshadow.pipeline.bounces.proxies import PlacedProxies, Proxies
from warpshadow.pipeline.bounces.repeated import SELF_BOUNCES, after_bounces
from warpshadow.pipeline.bounces.self_form_factors import SelfFormFactors
from warpshadow.pipeline.node import Call, ExplainRow, Node, identity
from warpshadow.pipeline.receivers.shading_context import ShadingContext, receiver_text
from warpshadow.pipeline.shading.light_input import LightInput
from warpshadow.pipeline.shading.sphere_method import SphereMethod
from warpshadow.pipeline.shading.transfers import join_portions
from warpshadow.pipeline.shading.visibility_nodes import LitPortion, ShadingNode, TransferNode
from warpshadow.pipeline.shading.visibility_steps import ProjectedLight
from warpshadow.scene.scene import Bounces
from warpshadow.stages.bounces.patch_weights import PatchWeights, find_mean_transmittance, find_patch_weights
from warpshadow.stages.bounces.radiosity import patch_radiosity
from warpshadow.stages.light.sums import add_light
from warpshadow.stages.receivers.receivers import Receivers


def _portion_for_bounces(method: SphereMethod, portion: LitPortion) -> PortionForBounces:
    transmittance = find_cell_transmittance(method, portion.group, portion.visibility, portion.spheres)
    return PortionForBounces(portion.result, portion.group, transmittance)


class DirectLightNode(Node):
    """Direct light, in portions.

    Args:
        visibility: Visibility of the receivers in free light, or their direct light if it is known, a list of
            :class:`PortionForBounces`.
        free_light: Free light projected for the method; None if light is known.
        item_text: Number of receivers, in words.
        suffix: Ends the name of its stage.
        others: More that it depends on.
        rows: Further ones, as for :class:`Node`.
    """

    def __init__(
        self,
        visibility: TransferNode,
        free_light: Node | None,
        item_text: str | Callable[[], str],
        suffix: str = "",
        others: tuple[Node | None, ...] = (),
        rows: tuple[ExplainRow, ...] = (),
    ):
        self._visibility = visibility
        if free_light is not None:
            self._shading = ExplainRow(f"shading{suffix}", item_text, inputs=(visibility, free_light))
            rows = self._shading, *rows
        super().__init__("", None, free_light, *others, extra_inputs=(visibility,), rows=rows)

    def compute(self, call: Call) -> Any:
        """Light all portions."""
        (free_light,) = self.values(call)
        return [self._light(call, portion, free_light) for portion in self._visibility.value(call)]

    def _light(self, call: Call, portion: PortionForBounces, free_light: ProjectedLight | None) -> PortionForBounces:
        if free_light is None:
            return portion
        with self.timed(call, self._shading):
            direct = self._visibility.method.shade_transfer(portion.direct, portion.group, free_light)
        return portion._replace(direct=direct)


def _patch_weights(senders: Senders, visibility: list[PortionForBounces]) -> PatchWeights:
    """Weights of patch samples and patches by how open they are."""
    portions = [
        find_mean_transmittance(
            portion.group.normals,
            portion.transmittance.transmittance_self,
            portion.transmittance.transmittance_nonplanar,
            portion.transmittance.directions,
        )
        for portion in visibility
    ]
    return find_patch_weights(join_portions(portions), senders.mean, senders.patch_of_sample)


def _add_emitted(portions: list[PortionForBounces], emitted: wp.array) -> list[PortionForBounces]:
    """Add direct light of emitters, vec3 of shape [batch, receiver], to the direct light of portions."""
    result, first = [], 0
    for portion in portions:
        end = first + portion.direct.shape[1]
        result.append(portion._replace(direct=add_light(portion.direct, cut(emitted, first, end))))
        first = end
    return result


class PatchSampleNodes(NamedTuple):
    """Nodes of the points at which patches are lit."""

    context: ShadingContext
    visibility: TransferNode  # of the patch samples, a list of PortionForBounces
    frames: Node  # of flat bodies
    placed_proxies: Node  # proxies of the patches, in the world
    weights: Node  # of patch samples and patches, by how open they are


class Radiosity(Node):
    """Final radiosity of the patches: of direct light and of all bounces but the last, which the receivers gather."""

    def __init__(
        self,
        count: Bounces,
        proxies: Proxies,
        self_form_factors: SelfFormFactors,
        gatherer: BounceGatherer,
        portions: Node,
        albedo: Node,
        patch_samples: PatchSampleNodes,
    ):
        _, _, frames, placed_proxies, weights = patch_samples
        self._count, self._proxies, senders = count, proxies, proxies.senders
        self._self_form_factors, self._gatherer = self_form_factors, gatherer
        item_text = f"{len(senders.areas):,} patches"
        idle = ALL_FLAT if all(senders.merged_scene.is_flat[body] for body in senders.bodies) else ""
        self._reflection = ExplainRow("radiosity", item_text)
        self._self_reflection = ExplainRow("self light of patches", item_text, idle)
        rows = self._reflection, self._self_reflection, *gatherer.rows
        super().__init__("", None, portions, albedo, placed_proxies, frames, weights, rows=rows)

    def compute(self, call: Call) -> OutgoingRadiance:
        """Reflect direct light, then light that has bounced once, and so on; more often between patches of one body."""
        portions, albedo, placed_proxies, frames, weights = self.values(call)
        senders, count = self._proxies.senders, self._count
        self_factors = None  # between patches of one body
        if not self._self_reflection.why_idle:
            self_factors = self._self_form_factors.between_patches(senders, [portion.group for portion in portions])
        if self_factors is not None and self_factors.is_zero:
            self_factors = None

        def outgoing_of(radiosity: wp.array) -> OutgoingRadiance:
            return OutgoingRadiance(
                self._proxies, self._self_form_factors, radiosity, placed_proxies, frames, weights.weights
            )

        def radiosity_by_others(radiosity: wp.array | None) -> wp.array:
            """Radiosity of patches by light from the sky and from other bodies."""
            if radiosity is None:
                light = [portion.direct for portion in portions]
            else:
                outgoing = outgoing_of(radiosity)
                light = [self._gatherer.add_bounced(self, call, portion, outgoing) for portion in portions]
            with self.timed(call, self._reflection):
                return patch_radiosity(albedo, join_portions(light), senders.mean, weights.sample_weights)

        def add_radiosity_by_self(by_others: wp.array, radiosity: wp.array | None) -> wp.array:
            if self_factors is None or radiosity is None:
                return by_others
            with self.timed(call, self._self_reflection):
                return patch_radiosity(albedo, radiosity, self_factors, addend=by_others)

        self_bounces = 0 if self_factors is None else SELF_BOUNCES
        return outgoing_of(
            after_bounces(count, radiosity_by_others, add_radiosity_by_self, senders.areas, self_bounces=self_bounces)
        )


class BouncedShading(DirectLightNode):
    """Shading of receivers, direct and bounced.

    Args:
        visibility, free_light, item_text: As above; one portion after another where nothing is cached.
        radiosity: Radiosity of the patches.
        gatherer: Gathers it at receivers.
    """

    def __init__(
        self,
        visibility: TransferNode,
        free_light: Node | None,
        item_text: Callable[[], str],
        radiosity: Radiosity,
        gatherer: BounceGatherer,
    ):
        self._gatherer = gatherer
        super().__init__(visibility, free_light, item_text, others=(radiosity,), rows=gatherer.rows)

    def compute(self, call: Call) -> wp.array:
        """Light all portions, directly and by the patches' radiosity."""
        free_light, outgoing = self.values(call)
        visibility = self._visibility.value(call) if self._visibility.caches else self._visibility.portions(call)
        portions = (self._light(call, portion, free_light) for portion in visibility)
        return join_portions([self._gatherer.add_bounced(self, call, portion, outgoing) for portion in portions])


class MovingBounces:
    """How light bounces between bodies that may move.

    Args:
        method: How light is blocked.
        patches: Of the scene.
    """

    def __init__(self, method: SphereMethod, patches: ScenePatches):
        self._method, self._count, self._patches = method, method.merged_scene.scene.bounces, patches
        self._self_form_factors = SelfFormFactors(
            method.scene_blockers.self_visibility, patches, progress=method.progress
        )
        self._proxies: dict[Senders, Proxies] = {}

    def shading(self, context: ShadingContext, light: LightInput, materials: Materials) -> Node:
        """Node of the shading of points, direct and bounced, vec3 of shape [batch, receiver].

        Their visibility is cached where it holds for other calls: in free light, and where colors vary.

        Args:
            context: The receivers.
            light: The light.
            materials: Of the bodies.
        """
        method, senders = self._method, self._patches.senders(materials)
        projected_light = method.projected_light_node(context, light)
        if not senders.bodies:
            direct = ShadingNode(method, context, projected_light, light)
            return Node("bounces", identity, direct, why_idle="every body is black")
        make_visibility = self._visibility_maker(context, light)
        key, is_cached = light.visibility_key, light.is_free or materials is not context.materials
        visibility = context.cached("visibility", (key, is_cached), lambda: make_visibility(context, caches=is_cached))
        radiosity = self.radiosity(context, light, materials)
        item_text = functools.partial(receiver_text, context.weak_reference)
        free_light = projected_light if light.is_free else None
        return BouncedShading(visibility, free_light, item_text, radiosity, self._gatherer(senders, item_text))

    def radiosity(self, context: ShadingContext, light: LightInput, materials: Materials) -> Radiosity:
        """Node of the radiosity of the patches around points, if a body sends light."""
        return context.cached("radiosity", (light, materials), lambda: self._make_radiosity(context, light, materials))

    def _make_radiosity(self, context: ShadingContext, light: LightInput, materials: Materials) -> Radiosity:
        method, senders = self._method, self._patches.senders(materials)
        proxies = self._proxies.setdefault(senders, Proxies(senders, method.visibility.merging))
        patch_samples = context.cached(
            "of patch samples",
            (light.visibility_key, senders),
            lambda: self._patch_samples(self._visibility_maker(context, light), proxies, context),
        )
        why_not = "light bounces once" if self._count == 1 else ""
        item_text = f"{len(senders.sides):,} patch samples"
        portions: Node = patch_samples.visibility
        if light.is_free:
            free_light = method.projected_light_node(context, light)
            portions = DirectLightNode(patch_samples.visibility, free_light, item_text, OF_PATCH_SAMPLES)
        if materials.emission:
            portions = Node(
                "", _add_emitted, portions, method.cached_emitted_light_node(patch_samples.context, materials)
            )
        albedo = self._patches.albedo(materials, senders.bodies)
        gatherer = self._gatherer(senders, item_text, OF_PATCH_SAMPLES, why_not, only_others=True)
        return Radiosity(self._count, proxies, self._self_form_factors, gatherer, portions, albedo, patch_samples)

    def _visibility_maker(self, context: ShadingContext, light: LightInput) -> Callable[..., TransferNode]:
        """Makes nodes of visibility in free light, or of light if it is known."""
        return functools.partial(
            TransferNode if light.is_free else ShadingNode,
            self._method,
            projected_light=self._method.visibility_basis_node(context, light),
            light=light,
            result_of=functools.partial(_portion_for_bounces, self._method),
            join=identity,
        )

    def _patch_samples(
        self, make_visibility: Callable[..., TransferNode], proxies: Proxies, context: ShadingContext
    ) -> PatchSampleNodes:
        """Nodes of the patch samples of the bodies around points."""
        senders, planes, spheres = proxies.senders, proxies.senders.planes, context.spheres

        def project(patch_samples: Receivers, visibility: list[PortionForBounces], *arguments: Any) -> PlacedProxies:
            return proxies.place(patch_samples, [portion.transmittance for portion in visibility], *arguments)

        make_samples = functools.partial(lit_patch_samples, senders, context, proxies.nearest_spheres)
        lit_samples = context.cached("patch samples beside proxies", proxies, make_samples)
        visibility = make_visibility(lit_samples)
        frames = Node("", planes.blockers.frames if planes else lambda _: None, context.vertices)
        placed_proxies = Node("", project, lit_samples.receivers_node, visibility, spheres, frames)
        weights = Node("", functools.partial(_patch_weights, senders), visibility)
        return PatchSampleNodes(lit_samples, visibility, frames, placed_proxies, weights)

    def _gatherer(self, senders: Senders, *arguments: Any, **options: Any) -> BounceGatherer:
        return BounceGatherer(self._method.visibility, senders, *arguments, **options)
