"""Methods with sphere blockers: their steps, and the functions that make nodes of them."""

import functools
from collections.abc import Callable, Mapping
from typing import Any

import warp as wp

from warpshadow.assets.light import EnvironmentMap
from warpshadow.pipeline.bodies.blockers import Blockers
from warpshadow.pipeline.bodies.reflectance import Materials
from warpshadow.pipeline.bodies.self_visibility import SelfLookup
from warpshadow.pipeline.node import Input, Node
from warpshadow.pipeline.receivers.shading_context import ShadingContext, receiver_text
from warpshadow.pipeline.shading.light_input import LightInput
from warpshadow.pipeline.shading.transfers import change_basis
from warpshadow.pipeline.shading.visibility_nodes import (
    ShadingNode,
    TransferNode,
    blockers_node,
    find_portions_of,
    self_lookup_node,
)
from warpshadow.pipeline.shading.visibility_steps import FoundVisibility, Projected, VisibilitySteps
from warpshadow.stages.receivers.receivers import Receivers


class SphereMethod(VisibilitySteps[Projected, FoundVisibility]):
    """A method in which spheres, planes or convex parts stand in for bodies: its functions here make nodes."""

    @functools.cached_property
    def _projected_scene_light(self) -> Node:
        return Node("", self.project_light, self.light, self.shell)

    def projected_light_node(self, context: ShadingContext, light: LightInput) -> Node:
        """Node of light on points, projected for the method; the same for the same known light."""
        if light.is_free:
            return Node("", self._with_free_light, light, self.visibility_basis_node(context, light))
        if light is self.light:
            return self._projected_scene_light
        make = functools.partial(Node, "", self.project_light, light, self.shell_of(light))
        return context.cached_for_bodies("projected", light, make)

    def visibility_basis_node(self, context: ShadingContext, light: LightInput) -> Node | Projected:
        """The light by which visibility is found, projected: known light, or any free light of the same shell."""
        return (
            self.free_basis_node(context, light.shell) if light.is_free else self.projected_light_node(context, light)
        )

    def free_basis_node(self, context: ShadingContext, shell: Input | None) -> Node | Projected:
        """The basis in which the method projects free light, or a node of it, the same for the same shell."""
        if shell is None:
            return self.free_basis
        make = functools.partial(Node, "", self.free_basis_of_shell, shell)
        return context.cached_for_bodies("free basis", shell, make)

    def _with_free_light(self, light: wp.array, free_basis: Projected) -> Projected:
        """Project given free light for the method. Differentiable: light."""
        return free_basis.with_coefficients(change_basis(light, self.native_from_basis))

    def emitted_light_node(self, context: ShadingContext, materials: Materials) -> Node:
        """Direct light of emitters on points, by the same blockers."""
        from warpshadow.pipeline.shading.emitted_light import find_emitted_light

        return self._emitter_node("light of emitters", find_emitted_light, context, materials)

    def highlights_node(self, context: ShadingContext, materials: Materials, roughness: Node, cameras: Input) -> Node:
        """Direct light of emitters in the lobes of points, by the same blockers."""
        from warpshadow.pipeline.shading.emitted_light import find_highlights

        return self._emitter_node("highlights", find_highlights, context, materials, roughness, cameras)

    def _emitter_node(
        self, name: str, find: Callable[..., Any], context: ShadingContext, materials: Materials, *others: Node | Input
    ) -> Node:
        emitters, weak_context = self.emitters, context.weak_reference
        portions_of = find_portions_of(context, by_body=True)

        def find_in_portions(
            receivers: Receivers, blockers: Blockers, self_lookups: Mapping[int, SelfLookup] | None, *arrays: Any
        ) -> Any:
            portions = portions_of(receivers, blockers, self_lookups)
            return find(emitters.samples, emitters.self_visibility, portions, blockers, *arrays)

        def lookups() -> Node:
            if self.emitter_cells is None:
                return Node("", None)
            return self_lookup_node(self, context.blocker_kinds, self.emitter_cells)

        return Node(
            name,
            find_in_portions,
            context.receivers_node,
            blockers_node(self, context),
            context.cached_for_bodies("self-visibility towards emitters", None, lookups),
            self.emitters.samples_node(context),
            self.emitters.radiance(materials),
            *others,
            items=lambda: f"{receiver_text(weak_context)} × {emitters.samples.first[-1]} samples",
        )

    def known_shading_node(self, context: ShadingContext, light: LightInput) -> Node:
        """Direct known light on points."""
        return ShadingNode(self, context, self.projected_light_node(context, light), light)

    def openness_node(self, context: ShadingContext) -> Node:
        """Light that points reflect as white surfaces under an even sky of 1, vec3 of shape [batch, receiver]."""
        sky = LightInput(EnvironmentMap.constant(1.0))
        return ShadingNode(self, context, Node("", self.project_light, sky), sky, suffix=" in an even sky")

    def transfer_node(self, context: ShadingContext, shell: Input | None) -> Node:
        """Transfer vectors of points: to the native basis if they require a gradient, else to :attr:`basis`.

        NumPy, which has no gradient, multiplies them by the matrix between both; with one, :meth:`_free_shading_node`
        converts the light instead.
        """
        matrix, visibility_light = self.native_from_basis, self.free_basis_node(context, shell)
        transfers = TransferNode(self, context, visibility_light, None, caches=matrix is None)
        if matrix is None or transfers.requires_grad:
            return transfers

        def to_basis(native: list[wp.array]) -> list[wp.array]:
            return [wp.array(item.numpy() @ matrix, dtype=wp.float32, device=item.device) for item in native]

        return Node("", to_basis, transfers)
