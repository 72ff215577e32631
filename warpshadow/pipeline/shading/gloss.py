"""Gloss: the light of bodies that shine, at receivers that pixels see.

Lobes are sampled at the receivers of glossy bodies; each sample looks up light without shadows, and without suns, in a
prefiltered map, and its transmittance in the way of the method. Suns and emitters are added one by one
(:mod:`.stages.gloss.suns`, :mod:`.stages.gloss.highlights`). Diffuse light is found as for all bodies, and mixed in at
the end.
"""

from __future__ import annotations

import functools

import numpy as np
import warp as wp

from warpshadow.device.batch import concatenate, cut, rows
from warpshadow.device.constants import constant
from warpshadow.pipeline.bodies.reflectance import Materials
from warpshadow.pipeline.node import Input, Node, detached, field_of
from warpshadow.pipeline.receivers.lit_points import LitPoints, receiver_text
from warpshadow.pipeline.shading.light_input import LightInput
from warpshadow.pipeline.shading.lobe_light import LitLobes
from warpshadow.pipeline.shading.method import Method
from warpshadow.pipeline.shading.transfers import change_basis
from warpshadow.scene.material import GLOSS_ARGUMENTS
from warpshadow.stages.gloss.lobes import LobeSamples, sample_lobes
from warpshadow.stages.gloss.normal_spread import NormalSpread, find_normal_spread
from warpshadow.stages.gloss.prefilter import look_up_light, prefilter
from warpshadow.stages.gloss.reflection import LobeLight, mix_reflection, number_runs, sum_lobes
from warpshadow.stages.gloss.suns import add_suns
from warpshadow.stages.light.sums import add_light
from warpshadow.stages.raster.interpolation import interpolate
from warpshadow.stages.raster.rasterization import Fragments
from warpshadow.stages.receivers.find import Receivers
from warpshadow.stages.receivers.sample_receivers import MAX_SHARED_SAMPLES, Span, places_in_pixels
from warpshadow.stages.shell.beams import exits_from_shell
from warpshadow.stages.textures.footprint import Footprints
from warpshadow.stages.textures.numbers import as_colors, as_scalars, average_over_receivers
from warpshadow.stages.textures.pyramid import Textures
from warpshadow.stages.textures.sample import sample_albedo

_CELL_ROWS = 64  # rows of the map of free light in cells: each pixel has the light of the nearest cell


class GlossyPoints(LitPoints):
    """The receivers of a view on bodies that shine.

    Args:
        method: How their light is blocked.
        cameras: Clip matrices of its cameras, or one for all.
        fragments, clip_positions: Nodes of its samples, and of the vertices in clip space.
    """

    def __init__(self, method: Method, view: LitPoints, cameras: Input, fragments: Node, clip_positions: Node):
        glossy = view.merged_scene.is_glossy
        receivers = Node("", functools.partial(_select_glossy_receivers, glossy), view.receivers_node)
        self._all_receivers, self._cameras = view.receivers_node, cameras
        self._fragments, self._clip_positions = fragments, clip_positions
        self.method = method
        arguments = view.merged_scene, view.materials, view.vertices, view.spheres, receivers, view.call
        super().__init__(
            *arguments,
            normals=view.normals,
            blocker_kinds=view.blocker_kinds,
            is_scene_view=view.is_scene_view,
            neighbors=view,
        )
        self._numbers = Node("", functools.partial(_number_glossy, glossy), detached(view.receivers_node))

    def lit(self, light: LightInput, view: LitPoints) -> LitLobes:
        """The points in some light, among the receivers of the view or its preview."""
        return LitLobes(self, light, view, self.select)

    def mix(self, lobes: LitLobes, diffuse: Node, materials: Materials, blocked: Node | None) -> tuple[Node, Node]:
        """Mix mirrored light with diffuse light, of all receivers of the view.

        Returns:
            Nodes of the light that colored and that white surfaces reflect, vec3 of shape [batch, receiver].

        Args:
            lobes: The points in their light, from :meth:`lit`.
            diffuse: Node of the view's shading.
            materials: Of the bodies.
            blocked: As of :meth:`.LightTransport.blocked_radiance`.
        """
        item_text, visibility = functools.partial(receiver_text, self.weak), self.method.lobes
        values = {name: self._find_values(materials, name) for name in GLOSS_ARGUMENTS}
        roughness, light = values["roughness"], lobes.light

        def sample() -> Node:
            geometry = self.normals, self.vertices, self._cameras
            spread = Node("", self._find_normal_spread, self.receivers_node, *geometry, self._fragments)
            inputs = self.receivers_node, roughness, self._cameras, spread, self._fragments
            return Node("lobes", self._sample_lobes, *inputs, items=item_text)

        samples = self.cached("lobes", materials.roughness, sample)
        directions, filters = field_of(samples, "directions"), field_of(samples, "filters")
        texels = self._prefiltered(light)
        radiance = self._look_up("prefiltered light", light, texels, directions, filters)
        transmittance = visibility.transmittance(lobes, directions)
        if blocked is not None and visibility.traces_hits and materials.may_be_metal:
            from warpshadow.pipeline.shading.mirrored_bodies import find_mirrored_radiance

            texels = texels if light.is_free else visibility.prefiltered(self, light, with_suns=True)
            look_up = functools.partial(self._look_up, "", light, texels)
            blocked = find_mirrored_radiance(self, materials, samples, transmittance, blocked, look_up)
        lobe_light = Node("gloss", sum_lobes, filters, radiance, transmittance, blocked, items=item_text)
        suns = visibility.suns(self, light)
        if suns is not None:
            sun_transmittance = visibility.sun_transmittance(lobes, suns)
            inputs = lobe_light, field_of(samples, "lobes"), suns, sun_transmittance
            lobe_light = Node("suns", add_suns, *inputs, items=item_text)
        if materials.emission:
            highlights = self.method.highlights(self, materials, roughness, self._cameras)
            lobe_light = Node("", _add_highlights, lobe_light, highlights)
        light_in_lobes = field_of(lobe_light, "straight"), field_of(lobe_light, "grazing")
        of_surface = field_of(samples, "cosines"), values["metallic"], values["specular"]
        mix = Node("reflection", mix_reflection, self._numbers, diffuse, *light_in_lobes, *of_surface, items=item_text)
        return field_of(mix, "colored"), field_of(mix, "white")

    def _look_up(self, name: str, light: LightInput, texels: Node, directions: Node, filters: Node) -> Node:
        """Node of light without shadows from directions, vec3 of shape [batch, receiver, sample]."""
        shell = self.method.shell_of(light)
        if shell is not None:
            directions = Node("", exits_from_shell, field_of(self.receivers_node, "points"), directions, shell)
        items = functools.partial(receiver_text, self.weak)
        return Node(name, look_up_light, texels, directions, filters, items=items)

    def select(self, light: Node) -> Node:
        """Select the light on these receivers from that on all receivers of the view; a node."""
        return Node("", _select_glossy, light, detached(self._all_receivers), self.merged_scene.is_glossy)

    def _find_values(self, materials: Materials, name: str) -> Node:
        """Node of roughness or the like at the receivers, float32 of shape [batch, receiver]."""
        of_vertices, textures = materials.of_vertices(name), materials.textures_of[name]
        if not textures.images:
            return Node("", self._interpolate, self.receivers_node, of_vertices)
        arguments = self._fragments, self._clip_positions, textures.pyramids, ""
        cached_name = f"footprints in textures of {textures.sizes}"
        footprints = self.cached(cached_name, None, functools.partial(textures.footprints, *arguments))
        samples = Node("", self._sample_textures, self._fragments, of_vertices, textures.pyramids, footprints)
        return self.select(Node("", _average_samples, self._all_receivers, samples))

    def _interpolate(self, receivers: Receivers, values: wp.array) -> wp.array:
        """Interpolate numbers at the receivers between those of vertices."""
        samples = receivers.sample_fragments
        assert samples is not None
        if not samples.face_ids.size:
            return wp.empty((1, 0), dtype=wp.float32, device=values.device)
        fragments = Fragments(
            *(array.reshape((len(array), 1, -1)) for array in (samples.face_ids, samples.barycentrics))
        )
        return rows(interpolate(fragments, self.merged_scene.side_faces, values))

    def _find_normal_spread(
        self, receivers: Receivers, normals: wp.array, positions: wp.array, cameras: wp.array, seen: Fragments
    ) -> NormalSpread:
        """Find how normals vary over the receivers. Differentiable: all but seen."""
        supersampling = self.merged_scene.scene.supersampling
        sharing = supersampling // self.method.lobes.receivers_across  # samples of a receiver, across
        if self.method.shares_directions and supersampling > MAX_SHARED_SAMPLES:
            sharing = 1
        _, height, width = seen.face_ids.shape
        fragments, size = receivers.sample_fragments, (width // sharing, height // sharing)
        assert fragments is not None
        arguments = fragments, self.merged_scene.side_faces, normals, positions, cameras
        return find_normal_spread(*arguments, size, sharing)

    def _sample_lobes(
        self, receivers: Receivers, roughness: wp.array, cameras: wp.array, spread: NormalSpread, seen: Fragments
    ) -> LobeSamples:
        """Samples of the lobes of the receivers. Differentiable: all but seen."""
        places, receivers_across = None, self.method.lobes.receivers_across
        if receivers_across > 1 and receivers.samples is not None:
            places = places_in_pixels(receivers.samples, seen.face_ids.shape[2], receivers_across)
        arguments = receivers.points, receivers.normals, roughness, cameras, self.method.lobes.samples_of_receiver
        return sample_lobes(*arguments, spread, places, receivers_across**2)

    def _sample_textures(
        self, fragments: Fragments, values: wp.array, textures: Textures, footprints: Footprints
    ) -> wp.array:
        """Find numbers of the view's samples: of textures and, on bodies without one, of vertices."""
        return as_scalars(sample_albedo(fragments, self.merged_scene.faces, as_colors(values), textures, footprints))

    def _prefiltered(self, light: LightInput) -> Node:
        """Node of prefiltered light, vec3 of shape [batch, texel]."""
        if not light.is_free:
            return self.method.lobes.prefiltered(self, light)
        find, items = self._prefilter_free, f"{self.method.basis.size} coefficients"
        return self.cached("prefiltered", light, lambda: Node("prefiltering", find, light, items=items))

    def _prefilter_free(self, light: wp.array) -> wp.array:
        """Prefilter free light. Differentiable: light."""
        return change_basis(light, _prefilter_basis(self.method.basis))


@functools.lru_cache(maxsize=4)
def _prefilter_basis(basis: object) -> np.ndarray:
    """Prefilter the functions of a basis: a matrix from coefficients to texels, float32 [texel, coefficient]."""
    from warpshadow.maths import sh

    directions = sh.equirectangular_directions(_CELL_ROWS)
    functions = basis.functions(directions.reshape(-1, 3))  # type: ignore[attr-defined]
    return prefilter(functions.reshape(_CELL_ROWS, 2 * _CELL_ROWS, -1))


def _add_highlights(lobe_light: LobeLight, highlights: LobeLight) -> LobeLight:
    """Add the highlights of emitters to other light in lobes. Differentiable: all."""
    return LobeLight(*(add_light(*pair) for pair in zip(lobe_light, highlights, strict=True)))


def _average_samples(receivers: Receivers, samples: wp.array) -> wp.array:
    """Average the samples that share a receiver, float32 of shape [batch, receiver]. Differentiable: samples."""
    count = len(receivers.static_vertices) + receivers.points.shape[1]
    return average_over_receivers(samples, rows(receivers.fragments.face_ids), receivers.faces, count)


def _find_glossy_spans(is_glossy: np.ndarray, receivers: Receivers) -> list[Span]:
    return [span for span in receivers.spans if span.body >= 0 and is_glossy[span.body]]


def _number_glossy(is_glossy: np.ndarray, receivers: Receivers) -> wp.array:
    """Number the glossy ones among the receivers of a view, −1 for diffuse ones, int32 of shape [receiver]."""
    first = len(receivers.static_vertices)
    runs = [(first + span.first, first + span.end) for span in _find_glossy_spans(is_glossy, receivers)]
    return number_runs(first + receivers.points.shape[1], runs, receivers.points.device)


def _select_glossy(light: wp.array, receivers: Receivers, is_glossy: np.ndarray) -> wp.array:
    """Select light, or another value, of the glossy ones among a view's receivers. Differentiable: light."""
    return _cut_spans(light, _find_glossy_spans(is_glossy, receivers), -len(receivers.static_vertices))


def _cut_spans(array: wp.array, spans: list[Span], first: int) -> wp.array:
    """Cut spans of items out of an array, counting from an item."""
    parts = [cut(array, span.first - first, span.end - first) for span in spans]
    if not parts:
        return wp.empty((len(array), 0), dtype=array.dtype, device=array.device)
    return parts[0] if len(parts) == 1 else concatenate(parts, [part.shape[1] for part in parts])


def _select_glossy_receivers(is_glossy: np.ndarray, receivers: Receivers) -> Receivers:
    """Select the glossy receivers of a view, all of which pixels see. Differentiable: points, normals."""
    spans, count = _find_glossy_spans(is_glossy, receivers), 0
    assert receivers.vertices is not None
    at_vertices, samples = receivers.vertices.size, receivers.sample_fragments
    renumbered = []
    for span in spans:
        renumbered.append(Span(span.body, count, count + span.end - span.first))
        count = renumbered[-1].end

    if samples is None:
        device = receivers.points.device
        samples = Fragments(*(wp.empty((1, 0), dtype=dtype, device=device) for dtype in (wp.int32, wp.vec3)))
    fragments = Fragments(
        *(_cut_spans(array, spans, at_vertices) for array in (samples.face_ids, samples.barycentrics))
    )
    numbers = None if receivers.samples is None else _cut_spans(receivers.samples, spans, at_vertices)
    none = constant(np.empty(0, int), wp.int32, receivers.points.device)
    points, normals = (_cut_spans(array, spans, 0) for array in (receivers.points, receivers.normals))
    arguments = points, normals, receivers.faces, none, fragments
    return Receivers(*arguments, spans=tuple(renumbered), vertices=none, sample_fragments=fragments, samples=numbers)
