"""Bounces for methods in which spheres stand in for bodies: whether bodies move decides by which bounces."""

from __future__ import annotations

import functools
from typing import Any

from warpshadow.pipeline.bounces.moving_bounces import OF_PATCH_SAMPLES, MovingBounces
from warpshadow.pipeline.bounces.patches import ScenePatches, lit_patch_samples
from warpshadow.pipeline.bounces.static_bounces import StaticBounces
from warpshadow.pipeline.method import LightInput
from warpshadow.pipeline.node import Node
from warpshadow.pipeline.receivers.lit_points import LitPoints
from warpshadow.pipeline.reflectance import Materials
from warpshadow.pipeline.sphere_method import PortionedShading, SphereMethod
from warpshadow.pipeline.transfers import joined


class SphereBounces:
    """How light bounces in a scene.

    Args:
        method: How light is blocked.
    """

    def __init__(self, method: SphereMethod):
        self._method, self._patches = method, ScenePatches(method.merged_scene)
        self._moving_bounces = MovingBounces(method, self._patches)

    def bounced_shading(
        self, points: LitPoints, projected_light: Node, light: LightInput, materials: Materials
    ) -> Node:
        """Node of the shading of points, direct and bounced, vec3 of shape [batch, receiver].

        If colors vary, the visibility of points is cached; otherwise their shading is.

        Args:
            points: The receivers.
            projected_light: The light projected for the method.
            light: The light, known.
            materials: Reflectance of the bodies.
        """
        return self._moving_bounces.shading(points, projected_light, projected_light, light, materials, is_free=False)

    def bounced_free_shading(
        self, points: LitPoints, projected_light: Node, light: LightInput, materials: Materials
    ) -> Node:
        """The same in free light; the points' visibility, which holds for any light, is cached."""
        return self._moving_bounces.shading(
            points,
            projected_light,
            self._method.free_projection_of(points, light),
            light,
            materials,
            is_free=True,
        )

    def cached_bounced_shading(
        self, points: LitPoints, projected_light: Any, light: LightInput, materials: Materials
    ) -> Node:
        """The same for static points: visibility of receivers and patch samples is cached, as are form factors."""
        patch_samples, at_patch_samples = self._cached_patch_samples(points, materials)
        direct = points.cached(
            "direct", light, lambda: PortionedShading(self._method, points, projected_light, light, joined)
        )
        make = functools.partial(
            PortionedShading, self._method, at_patch_samples, projected_light, light, joined, where=OF_PATCH_SAMPLES
        )
        by_map = points.cached("direct at patch samples", (light, patch_samples), make)
        lit = self._method.with_emitters(by_map, at_patch_samples, materials)
        return self._static_bounces.add_bounces(direct, lit, points, materials)

    def cached_bounced_free_shading(
        self, direct: Node, points: LitPoints, light: LightInput, materials: Materials
    ) -> Node:
        """The same in free light, given a node of the direct shading of the receivers."""
        patch_samples, at_patch_samples = self._cached_patch_samples(points, materials)
        transfers = points.cached(
            "transfer",
            (patch_samples, light.shell),
            lambda: self._method.transfers(at_patch_samples, light, OF_PATCH_SAMPLES),
        )
        if materials.emission:
            lit = self._method.light_of_emitters(at_patch_samples, materials)
            direct = self._static_bounces.add_bounces(direct, lit, points, materials)
        return self._static_bounces.add_free_bounces(direct, transfers, light, points, materials)

    def _cached_patch_samples(self, points: LitPoints, materials: Materials) -> tuple[Node, LitPoints]:
        """Node of the static patch samples, and the same patch samples as lit points."""
        patch_samples = self._static_bounces.patch_samples(points, materials)
        return patch_samples, points.cached(
            "lit patch samples", patch_samples, lambda: lit_patch_samples(patch_samples, points, materials)
        )

    @functools.cached_property
    def _static_bounces(self) -> StaticBounces:
        return StaticBounces(
            self._patches,
            self._method.merged_scene.scene.bounces,
            self._method.openness,
            progress=self._method.progress,
        )
