"""Light transport: which nodes make the light on receivers, direct and bounced.

Light on receivers is a sum: direct light of the map, light that bounces, direct light of emitters. Which nodes make the
first two, by light, bounces, reflectance, and where bodies and cameras are:

| light | bounces | reflectance | bodies, cameras | spheres stand in for bodies | rays meet bodies |
| --- | --- | --- | --- | --- | --- |
| known | none | any | any | shaded at once | shaded at once |
| free | none | any | any | transfer vectors | transfer vectors |
| known | some | the scene's | any | moving patches | paths; where receivers share directions, static patches |
| known | some | given | the scene's | static patches | static patches |
| known | some | given | given | moving patches | static patches |
| free | some | any | the scene's | static patches | static patches |
| free | some | any | given | moving patches | static patches |

Cameras are the scene's where a call gives none and the renderer has one. The first two rows are
:meth:`.Method.direct_shading_node`, the others :func:`choose_bounce_solver`. Static patches cache form factors, so that
an iteration is small matrices; moving ones find all but cached visibility in each call. A shell is part of the light.
Light of emitters is added here; the radiance that they show, and gloss, in :meth:`.View.image`.
"""

from __future__ import annotations

import enum
import functools
from typing import TYPE_CHECKING

from warpshadow.pipeline.bodies.reflectance import Materials
from warpshadow.pipeline.node import Node, field_of
from warpshadow.pipeline.receivers.shading_context import ShadingContext
from warpshadow.pipeline.shading.light_input import LightInput
from warpshadow.pipeline.shading.method import Method
from warpshadow.stages.light.sums import add_light
from warpshadow.stages.planes.face_texels import FaceTexels
from warpshadow.stages.sparse import multiply

if TYPE_CHECKING:  # they are imported where light bounces, or bodies shine
    from warpshadow.pipeline.bounces.moving_bounces import MovingBounces
    from warpshadow.pipeline.bounces.patches import ScenePatches
    from warpshadow.pipeline.bounces.static_bounces import StaticBounces
    from warpshadow.pipeline.shading.lobe_light import LitLobes


class BounceSolver(enum.Enum):
    """How light bounces, in words."""

    PATHS = "along paths"
    STATIC = "between static patches"
    MOVING = "between patches that may move"


def choose_bounce_solver(
    *, is_free: bool, is_given: bool, is_of_scene: bool, has_spheres: bool, shares_directions: bool
) -> BounceSolver:
    """Choose how light bounces: the lower rows of the table above.

    Args:
        is_free: Whether the light is free.
        is_given: Whether some reflectance is given in place of the scene's.
        is_of_scene: Whether bodies and the only camera are where the scene has them, for good, and no shell moves.
        has_spheres, shares_directions: Of the method.
    """
    if has_spheres:
        return BounceSolver.STATIC if is_of_scene and (is_free or is_given) else BounceSolver.MOVING
    return BounceSolver.STATIC if is_free or is_given or shares_directions else BounceSolver.PATHS


class LightTransport:
    """Light on the receivers of a scene.

    Args:
        method: How light is blocked.
    """

    def __init__(self, method: Method):
        self.method = method

    def shading(self, context: ShadingContext, light: LightInput, materials: Materials | None = None) -> Node:
        """Light reflected by points as white surfaces, vec3 of shape [batch, receiver].

        Results for the scene's light and the last other known light are cached.

        Args:
            context: The receivers.
            light: From :meth:`.Method.light_input`.
            materials: They matter where light bounces, and where bodies emit; None for the scene's.
        """
        without_emitters = self.shading_without_emitters(context, light, materials)
        return self._with_emitters(without_emitters, context, materials or context.materials)

    def shading_without_emitters(
        self, context: ShadingContext, light: LightInput, materials: Materials | None = None
    ) -> Node:
        """Light that white points reflect, without direct light of emitters, but with their bounced light."""
        if not self.method.merged_scene.scene.bounces:
            return self.method.direct_shading_node(context, light)
        materials = materials or context.materials
        bounce = functools.partial(self._bounced, context, light, materials)
        if light.is_free or materials is not context.materials:
            return bounce()
        return self.method.cached_for_light("shading", context, light, bounce)

    def bounce_solver(self, context: ShadingContext, light: LightInput, materials: Materials) -> BounceSolver:
        """How light bounces onto points."""
        varies = light.shell is not None and (light.shell.requires_grad or light.is_free and light.shell_count > 1)
        return choose_bounce_solver(
            is_free=light.is_free,
            is_given=materials is not context.materials,
            is_of_scene=context.is_scene_view and not varies,
            has_spheres=self.method.visibility.traits.has_spheres,
            shares_directions=self.method.shares_directions,
        )

    def notes(self, context: ShadingContext, light: LightInput, materials: Materials) -> list[str]:
        """Say how often light bounces, and how, where it does."""
        count = self.method.merged_scene.scene.bounces
        if not count:
            return []
        times = "until none is left" if count == "all" else f"{count} time{'s' * (count != 1)}"
        return [f"Light bounces {times}, {self.bounce_solver(context, light, materials).value}."]

    def _bounced(self, context: ShadingContext, light: LightInput, materials: Materials) -> Node:
        """Shading of points, direct and bounced."""
        bounce_solver = self.bounce_solver(context, light, materials)
        if bounce_solver is BounceSolver.MOVING:
            return self._moving_bounces.shading(context, light, materials)
        direct = self.method.direct_shading_node(context, light)
        if bounce_solver is BounceSolver.PATHS:
            return self.method.path_shading_node(direct, context, light, materials)
        static = self._static_bounces
        if not light.is_free:
            return static.add_bounces(direct, self._lit_patch_samples(context, light, materials), context, materials)
        if light.shell_count > 1:
            raise ValueError(
                f"shell: got {light.shell_count} for free light that bounces along rays, expected one, or the method "
                "'directional'"
            )
        samples = static.patch_samples(context, materials)
        if materials.emission:
            emitted = self.method.cached_emitted_light_node(samples, materials)
            direct = static.add_bounces(direct, emitted, context, materials)
        return static.add_free_bounces(
            direct, self.method.cached_transfer_node(samples, light.shell), light, context, materials
        )

    def _lit_patch_samples(self, context: ShadingContext, light: LightInput, materials: Materials) -> Node:
        """Direct shading of the samples of static patches in known light, vec3 of shape [batch, patch sample]."""
        samples = self._static_bounces.patch_samples(context, materials)
        return self._with_emitters(self.method.direct_shading_node(samples, light), samples, materials)

    def blocked_radiance(self, lobes: LitLobes, materials: Materials) -> Node | None:
        """Mean radiance of the blockers of receivers on bodies that shine; None where light does not bounce."""
        if not self.method.merged_scene.scene.bounces:
            return None
        bounced = self.shading_without_emitters(lobes.all_points, lobes.light, materials)
        openness = self._openness(lobes.all_points, lobes.light, materials)
        selected_openness = None if openness is None else lobes.points.select(openness)
        return self.method.lobes.blocked_radiance(lobes, lobes.points.select(bounced), selected_openness)

    def radiosity(
        self, context: ShadingContext, light: LightInput, materials: Materials
    ) -> tuple[Node, FaceTexels] | None:
        """Radiosity of surfaces, where patches of known light or of moving bodies have it.

        Returns:
            Node of that of the texels of flat bodies and of the sides of faces, vec3 of shape [batch, texel +
            2 · face], and where faces are on texels; None where light does not bounce, or where it is free among
            static patches, of which only transfer is known. Beside light along paths it is that of static patches.
        """
        senders = self._patches.senders(materials) if self.method.merged_scene.scene.bounces else None
        if senders is None or not senders.bodies:
            return None
        solver = self.bounce_solver(context, light, materials)
        if solver is BounceSolver.MOVING:
            patch_radiosity = field_of(self._moving_bounces.radiosity(context, light, materials), "radiosity")
        elif not light.is_free:
            at_patch_samples = self._lit_patch_samples(context, light, materials)
            patch_radiosity = self._static_bounces.radiosity(at_patch_samples, context, materials)
        else:
            return None
        surface_radiosity = Node("", lambda radiosity: multiply(senders.mean_over_surfaces, radiosity), patch_radiosity)
        return surface_radiosity, senders.face_texels

    def _openness(self, context: ShadingContext, light: LightInput, materials: Materials) -> Node | None:
        """Part of the hemispheres of points that no blocker takes, vec3 of shape [view, receiver].

        It is found by the rays along which light bounces between static patches; None where light bounces in another
        way.
        """
        if self.bounce_solver(context, light, materials) is not BounceSolver.STATIC:
            return None
        at_patch_samples = None if light.is_free else self._lit_patch_samples(context, light, materials)
        return self._static_bounces.openness(context, materials, at_patch_samples)

    def _with_emitters(self, light: Node, context: ShadingContext, materials: Materials) -> Node:
        """Add direct light of emitters to other light on points; nothing where no body emits."""
        if not materials.emission:
            return light
        emitted = self.method.cached_emitted_light_node(context, materials)
        return context.cached("light with emitters", (light, emitted), lambda: Node("", add_light, light, emitted))

    @functools.cached_property
    def _patches(self) -> ScenePatches:
        from warpshadow.pipeline.bounces.patches import ScenePatches

        return ScenePatches(self.method.merged_scene)

    @functools.cached_property
    def _static_bounces(self) -> StaticBounces:
        from warpshadow.pipeline.bounces.static_bounces import StaticBounces

        return StaticBounces(self.method, self._patches)

    @functools.cached_property
    def _moving_bounces(self) -> MovingBounces:
        from warpshadow.pipeline.bounces.moving_bounces import MovingBounces
        from warpshadow.pipeline.shading.sphere_method import SphereMethod

        assert isinstance(self.method, SphereMethod)
        return MovingBounces(self.method, self._patches)
