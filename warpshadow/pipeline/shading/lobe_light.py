"""Light in the lobes of bodies that shine, and how a method of visibility blocks it: by default not at all."""

import functools
from collections.abc import Callable
from typing import NamedTuple

import warp as wp

from warpshadow.assets.known_light import KnownLight
from warpshadow.device.batch import expand
from warpshadow.device.constants import constant
from warpshadow.maths.suns import SeparatedLight, Suns, directions_in_suns, separate_suns
from warpshadow.pipeline.bodies.merged_scene import MergedScene
from warpshadow.pipeline.node import Node, field_of
from warpshadow.pipeline.receivers.shading_context import ShadingContext
from warpshadow.pipeline.shading.glossy_points import GlossyPoints
from warpshadow.pipeline.shading.light_input import LightInput
from warpshadow.stages.gloss.prefilter import prefilter
from warpshadow.stages.receivers.receivers import Receivers

_MIN_SAMPLES = 8  # of a receiver, however many receivers a pixel has: as many as a processor finds at once


class LitLobes(NamedTuple):
    """Receivers on bodies that shine, and their light."""

    points: GlossyPoints
    light: LightInput  # known or free, which says where shadows have to be sharp
    all_points: ShadingContext  # the receivers of the image, among which they are


class LobeVisibility:
    """How a method blocks light in lobes.

    A method that lets bodies shine (its row of ``METHOD_TRAITS``) derives from it and gives these members; without
    shadows it needs none:

    | member | needed for | default |
    | --- | --- | --- |
    | :meth:`transmittance` | shadows in mirrored light | 1: no shadows |
    | :meth:`sun_transmittance` | suns | :meth:`transmittance` in :attr:`sun_sample_count` directions of each |
    | :meth:`blocked_radiance` | light that bounces | refused |
    | :attr:`sample_count`, of metals :attr:`metal_sample_count`; of suns :attr:`sun_sample_count` | noise | 32, 64; 1 |

    Args:
        merged_scene: The bodies.
        scene_light: Their light.
        shares_receivers: As :attr:`.Method.shares_lobes`.
    """

    sample_count = 32
    """Samples of a lobe. Light without shadows, and without its suns, of an indoor map is 2.1% off with 32, 3.5% with
    16 (roughness 0.35)."""

    metal_sample_count = 64
    """Samples of a lobe where a body is of metal, all of whose light is in lobes: with 32, a bear of roughness 0.35 and
    0.6 is 7.5 and 7.7 in place of 6.8 and 5.9% off in direct light."""

    sun_sample_count = 1  # directions in which each sun is looked for from the lobe of a receiver

    def __init__(self, merged_scene: MergedScene, scene_light: LightInput, *, shares_receivers: bool):
        self._merged_scene, self._scene_light = merged_scene, scene_light
        self._shares_receivers, self._of_scene = shares_receivers, dict[str, Node]()

    @property
    def receivers_across(self) -> int:
        """How many receivers a pixel has across and down, if it sees one face of a body that shines alone."""
        return 1 if self._shares_receivers else self._merged_scene.scene.supersampling

    def samples_of_receiver(self, *, has_metal: bool) -> int:
        """Number of samples of the lobe of a receiver, in a scene that may have a metal or not."""
        count = max(self.sample_count, self.metal_sample_count if has_metal else 0)
        return max(count // self.receivers_across**2, min(count, _MIN_SAMPLES))

    def _cached(self, name: str, context: ShadingContext, light: LightInput, make: Callable[[], Node]) -> Node:
        """A node of known light, cached for the scene's light and, with points, for the last other one."""
        if light is not self._scene_light:
            return context.cached(name, light, make)
        if name not in self._of_scene:
            self._of_scene[name] = make()
        return self._of_scene[name]

    def _separated(self, context: ShadingContext, light: LightInput) -> Node | None:
        """Node of known light that is separated from its suns; None for light whose suns are not separated."""
        if light.is_free or self._merged_scene.scene.shell is not None:
            return None
        return self._cached("separated light", context, light, lambda: Node("", _separate_suns, light))

    def suns(self, context: ShadingContext, light: LightInput) -> Node | None:
        """Node of the suns of known light, which prefiltered light is without; None for other light."""
        separated = self._separated(context, light)
        return None if separated is None else field_of(separated, "suns")

    def prefiltered(self, context: ShadingContext, light: LightInput, *, with_suns: bool = False) -> Node:
        """Node of known light, by default without its suns, prefiltered, vec3 [1, texel]."""
        separated = self._separated(context, light)
        name = "prefiltered light with suns" if with_suns and separated is not None else "prefiltered light"
        arguments = self._prefilter, light, None if with_suns else separated
        return self._cached(name, context, light, lambda: Node("prefiltering", *arguments))

    def _prefilter(self, light: KnownLight, separated: SeparatedLight | None) -> wp.array:
        radiance = light.radiance if separated is None else separated.without_suns
        return constant(prefilter(radiance)[None], wp.vec3, self._merged_scene.device)

    def transmittance(self, lobes: LitLobes, directions: Node) -> Node:
        """Transmittance towards the samples of lobes, float32 of shape [batch, receiver, sample].

        Args:
            lobes: The receivers.
            directions: Node of the samples' directions, vec3 of shape [batch, receiver, sample].

        Without shadows it is 1.
        """
        return Node("", lambda samples: wp.full(samples.shape, 1.0, wp.float32, device=samples.device), directions)

    def sun_transmittance(self, lobes: LitLobes, suns: Node) -> Node:
        """Transmittance towards directions in suns, as many in each, float32 of shape [batch, receiver, direction].

        Args:
            lobes: The receivers.
            suns: Node of the suns of their light.

        By default :meth:`transmittance` finds it, in :attr:`sun_sample_count` directions that are even over each sun.
        """
        find_directions = functools.partial(_find_sun_directions, self.sun_sample_count)
        return self.transmittance(lobes, Node("", find_directions, lobes.points.receivers_node, suns))

    def blocked_radiance(self, lobes: LitLobes, diffuse: Node, openness: Node | None) -> Node:
        """Mean radiance of the blockers of receivers, where light bounces, vec3 of shape [batch, receiver].

        Args:
            lobes: The receivers.
            diffuse: Node of their shading.
            openness: Of them, by the rays along which light bounces, vec3 of shape [batch, receiver]; None to find it.
        """
        raise NotImplementedError


def _separate_suns(light: KnownLight) -> SeparatedLight:
    return separate_suns(light.radiance)


def _find_sun_directions(count: int, receivers: Receivers, suns: Suns) -> wp.array:
    """Directions in suns, so many in each, for each receiver: vec3 of shape [1, receiver, direction]."""
    directions = directions_in_suns(suns, count).reshape(1, -1, 3)
    receiver_count, device = receivers.points.shape[1], receivers.points.device
    if not receiver_count or not directions.size:
        return wp.empty((1, receiver_count, directions.shape[1]), dtype=wp.vec3, device=device)
    return expand(constant(directions, wp.vec3, device), receiver_count).reshape((1, receiver_count, -1))
