"""Bounces between static patches: rays once for a geometry, then small matrices for each light and reflectance.

Rays find the form factors F from patches to patch samples and to receivers, once (:mod:`.static_form_factors`). With
direct shading S and albedo a an iteration finds the radiosity of patches after n − 1 bounces, or after all,

    B = a (M S + M F B),  M the mean over patch samples outside of other bodies,        starting from B = a M S,

and receivers gather F B. Light within one body may bounce more often than that. Receivers of an image are many: F is
found at some of them, and interpolated.

The radiosity is linear in light: of free light among bodies of known colors it is one matrix, which is cached.
Differentiable in light and albedo.
"""

from __future__ import annotations

import functools
from collections.abc import Callable

import numpy as np
import warp as wp

from warpshadow.pipeline.bodies.reflectance import Materials
from warpshadow.pipeline.bounces.patches import ScenePatches, Senders, lit_patch_samples
from warpshadow.pipeline.bounces.repeated import SELF_BOUNCES, after_bounces
from warpshadow.pipeline.bounces.static_form_factors import StaticFormFactors, find_form_factors
from warpshadow.pipeline.node import Input, Node, field_of
from warpshadow.pipeline.receivers.shading_context import ShadingContext, receiver_text
from warpshadow.pipeline.shading.method import Method
from warpshadow.stages.bounces.colored import ColoredTransfer, colored_light
from warpshadow.stages.bounces.radiosity import reflect
from warpshadow.stages.sparse import multiply


class StaticBounces:
    """Light that bounces between bodies whose form factors rays find once.

    Args:
        method: How light is blocked.
        patches: Of the scene.
    """

    def __init__(self, method: Method, patches: ScenePatches):
        self._patches, self._progress, self._openness = patches, method.progress, method.openness_node
        self._bounces = method.merged_scene.scene.bounces  # 1 or more, or "all" until nothing is left
        self._is_still = method.shares_directions

    def patch_samples(self, context: ShadingContext, materials: Materials) -> ShadingContext:
        """The points of patches that are lit, of one instance."""
        senders = self._patches.senders(materials)
        return context.cached("patch samples", senders, lambda: lit_patch_samples(senders, context))

    def add_bounces(self, direct: Node, at_patch_samples: Node, context: ShadingContext, materials: Materials) -> Node:
        """Add bounces to direct shading.

        Args:
            direct: Node of the direct shading of the receivers, vec3 of shape [batch, receiver].
            at_patch_samples: Node of that of :meth:`patch_samples`, vec3 of shape [batch, patch sample].
            context: The receivers.
            materials: Of the bodies.
        """
        senders = self._patches.senders(materials)
        if not senders.bodies:
            return direct
        factors = self._factors(context, materials, senders, at_patch_samples)
        return self._shading(direct, _patch_light(at_patch_samples, factors, context), factors, context, materials)

    def add_free_bounces(
        self, direct: Node, transfers: Node, light: Input, context: ShadingContext, materials: Materials
    ) -> Node:
        """Add bounces to the shading of free light; its transfer among the colors of the scene is cached.

        Args:
            direct: As above.
            transfers: Node of the transfer vectors of the patch samples, [1, patch sample, coefficient], in portions.
            light: The coefficients.
            context: The receivers.
            materials: Of the bodies.
        """
        senders = self._patches.senders(materials)
        if not senders.bodies:
            return direct

        def light_on_patches(portions: list[wp.array], factors: StaticFormFactors) -> wp.array:
            """Light on patches by each coefficient of white light, vec3 of shape [coefficient, patch]."""
            white_light = np.concatenate([portion.numpy()[0] for portion in portions]).T[..., None]
            return _light_on_patches(
                wp.array(np.repeat(white_light, 3, axis=2), dtype=wp.vec3, device=portions[0].device), factors
            )

        factors = self._factors(context, materials, senders)
        make_light = functools.partial(Node, "", light_on_patches, transfers, factors)
        patch_light = context.cached("patches in each coefficient", transfers, make_light)
        if materials is not context.materials:
            make_transfer = functools.partial(Node, "", _as_transfer, patch_light)
            transfer = context.cached("transfer of patches", patch_light, make_transfer)
            return self._shading(direct, Node("", colored_light, transfer, light), factors, context, materials)

        def bounced() -> Node:
            def find(albedo: wp.array, patch_light: wp.array, factors: StaticFormFactors) -> ColoredTransfer:
                return _as_transfer(self._light_at_cache_points(albedo, patch_light, factors, senders))

            albedo = self._patches.albedo(materials, senders.bodies)
            return Node("transfer of bounces", find, albedo, patch_light, factors)

        def shade(direct: wp.array, transfer: ColoredTransfer, light: wp.array, factors: StaticFormFactors) -> wp.array:
            return factors.to_receivers(direct, colored_light(transfer, light))

        transfer = context.cached("bounces", patch_light, bounced)
        return Node("bounces", shade, direct, transfer, light, factors, items=self._item_text(context, senders))

    def _shading(
        self, direct: Node, patch_light: Node, factors: Node, context: ShadingContext, materials: Materials
    ) -> Node:
        """Shading with bounces, given the direct light on patches, vec3 of shape [batch, patch]."""
        senders = self._patches.senders(materials)

        def bounce(direct: wp.array, radiosity: wp.array, factors: StaticFormFactors) -> wp.array:
            return factors.to_receivers(direct, multiply(factors.to_cache_points, radiosity))

        radiosity = self._radiosity_node(patch_light, factors, context, materials)
        return Node("bounces", bounce, direct, radiosity, factors, items=self._item_text(context, senders))

    def radiosity(self, at_patch_samples: Node, context: ShadingContext, materials: Materials) -> Node:
        """Node of the radiosity of patches in the light of :meth:`add_bounces`, vec3 of shape [batch, patch]."""
        factors = self._factors(context, materials, self._patches.senders(materials), at_patch_samples)
        return self._radiosity_node(_patch_light(at_patch_samples, factors, context), factors, context, materials)

    def _radiosity_node(self, patch_light: Node, factors: Node, context: ShadingContext, materials: Materials) -> Node:
        senders = self._patches.senders(materials)
        find = functools.partial(self._find_radiosity, senders=senders)
        albedo = self._patches.albedo(materials, senders.bodies)
        make = functools.partial(Node, "", find, albedo, patch_light, factors)
        return context.cached("radiosity", (patch_light, materials), make)

    def _light_at_cache_points(
        self, albedo: wp.array, patch_light: wp.array, factors: StaticFormFactors, senders: Senders
    ) -> wp.array:
        """Bounced light at cache points, vec3 of shape [batch, cache point]. Differentiable: albedo, patch_light."""
        return multiply(factors.to_cache_points, self._find_radiosity(albedo, patch_light, factors, senders))

    def _find_radiosity(
        self, albedo: wp.array, patch_light: wp.array, factors: StaticFormFactors, senders: Senders
    ) -> wp.array:
        """Radiosity, vec3 of shape [batch, patch]. Differentiable: albedo, patch_light."""

        def light_of_others(radiosity: wp.array | None) -> wp.array:
            """Light on patches from the sky and from other bodies."""
            return patch_light if radiosity is None else multiply(factors.between_bodies, radiosity, addend=patch_light)

        def reflect_all(by_others: wp.array, radiosity: wp.array | None) -> wp.array:
            return reflect(
                albedo, by_others if radiosity is None else multiply(factors.within_bodies, radiosity, addend=by_others)
            )

        return after_bounces(self._bounces, light_of_others, reflect_all, senders.areas, self_bounces=SELF_BOUNCES)

    def openness(self, context: ShadingContext, materials: Materials, at_patch_samples: Node | None) -> Node | None:
        """Part of the hemispheres of points that no blocker takes, by the rays that find the light of blockers.

        So openness and bounced light have the same noise, which cancels in their ratio, the blockers' mean radiance.

        Args:
            context, materials: As above.
            at_patch_samples: Node of direct shading as above; None in free light.

        Returns:
            Node of vec3 of shape [view, receiver]; None where no body sends light.
        """
        senders = self._patches.senders(materials)
        if not senders.bodies:
            return None
        return field_of(self._factors(context, materials, senders, at_patch_samples), "openness")

    def _item_text(self, context: ShadingContext, senders: Senders) -> Callable[[], str]:
        weak_context = context.weak_reference
        return lambda: f"{receiver_text(weak_context)}, {len(senders.areas):,} patches, {self._bounces} bounces"

    def _factors(
        self, context: ShadingContext, materials: Materials, senders: Senders, at_patch_samples: Node | None = None
    ) -> Node:
        """Node of the form factors, the same in any light: light at patch samples tells where rays are sent."""
        if not self._is_still or materials is not context.materials:  # form factors of a fit must not follow its light
            at_patch_samples = None

        def make() -> Node:
            patch_samples = self.patch_samples(context, materials)
            find = functools.partial(find_form_factors, senders, is_still=self._is_still, progress=self._progress)
            return Node(
                "form factors",
                find,
                context.vertices,
                patch_samples.receivers_node,
                context.receivers_node,
                self._openness(patch_samples),
                self._openness(context),
                at_patch_samples,
                None if at_patch_samples is None else self._patches.albedo(materials, senders.bodies),
                items=lambda: f"{len(senders.sides):,} patch samples × {len(senders.areas):,} patches",
                has_adjoint=False,
            )

        return context.cached("form factors", (senders, at_patch_samples), make)


def _patch_light(at_patch_samples: Node, factors: Node, context: ShadingContext) -> Node:
    """Node of the light on patches, vec3 of shape [batch, patch], cached for that at their samples."""
    make = functools.partial(Node, "", _light_on_patches, at_patch_samples, factors)
    return context.cached("light of patches", at_patch_samples, make)


def _light_on_patches(at_patch_samples: wp.array, factors: StaticFormFactors) -> wp.array:
    """Mean light on patches, vec3 of shape [batch, patch], of that at their samples, in which it is differentiable."""
    return multiply(factors.patch_sample_means, at_patch_samples)


def _as_transfer(light: wp.array) -> ColoredTransfer:
    """The matrix of light that each coefficient alone sends to receivers, vec3 of shape [coefficient, receiver]."""
    return ColoredTransfer.from_lit_receivers(light.numpy(), device=light.device)
