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
from warpshadow.pipeline.shading.method import LightInput, LitLobes, Method
from warpshadow.pipeline.shading.transfers import change_basis
from warpshadow.scene.material import GLOSS_ARGUMENTS
from warpshadow.stages.gloss.lobes import LobeSamples, sample_lobes
from warpshadow.stages.gloss.normal_spread import NormalSpread, find_normal_spread
from warpshadow.stages.gloss.prefilter import look_up_light, prefilter
from warpshadow.stages.gloss.reflection import LobeLight, mix_reflection, number_runs, sum_lobes
from warpshadow.stages.gloss.suns import Suns, add_suns
from warpshadow.stages.light.sums import add_light
from warpshadow.stages.raster.interpolation import interpolate
from warpshadow.stages.raster.rasterization import Fragments
from warpshadow.stages.receivers.find import Receivers
from warpshadow.stages.receivers.sample_receivers import Span, places_in_pixels
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

    def mix(
        self,
        view: LitPoints,
        diffuse: Node,
        light: LightInput,
        materials: Materials,
        bounced: Node,
        openness: Node | None,
    ) -> tuple[Node, Node]:
        """Mix mirrored light with diffuse light, of all receivers of the view.

        Returns:
            Nodes of the light that colored and that white surfaces reflect, vec3 of shape [batch, receiver].

        Args:
            view: The view, or its preview.
            diffuse: Node of the view's shading.
            light: As for :meth:`.LightTransport.shading`.
            materials: Of the bodies.
            bounced: Node of the view's shading without direct light of emitters.
            openness: Of the view, as of :meth:`.LightTransport.openness`.
        """
        item_text = functools.partial(receiver_text, self.weak)
        values = {name: self._find_values(materials, name) for name in GLOSS_ARGUMENTS}
        roughness = values["roughness"]
        key = materials.roughness

        def lobes() -> Node:
            geometry = self.normals, self.vertices, self._cameras
            spread = Node("", self._find_normal_spread, self.receivers_node, *geometry, self._fragments)
            inputs = self.receivers_node, roughness, self._cameras, spread, self._fragments
            return Node("lobes", self._sample_lobes, *inputs, items=item_text)

        sampled = self.cached("lobes", key, lobes)
        directions, filters = field_of(sampled, "directions"), field_of(sampled, "filters")
        texels = self.cached("prefiltered", light, lambda: self._prefilter(light))
        shell, exits = self.method.shell_of(light), directions
        if shell is not None:
            exits = Node("", _find_exits, self.receivers_node, directions, shell)
        radiance = Node("prefiltered light", look_up_light, texels, exits, filters, items=item_text)
        lit_lobes = LitLobes(self, light, view, self.select)
        transmittance = self.method.lobe_transmittance(lit_lobes, directions)
        blocked = None
        if self.merged_scene.scene.bounces:
            own_openness = None if openness is None else self.select(openness)
            blocked = self.method.blocked_radiance(lit_lobes, self.select(bounced), own_openness)
        sums = Node("gloss", sum_lobes, filters, radiance, transmittance, blocked, items=item_text)
        suns = self.method.suns(light)
        if suns is not None:
            past_blockers = self.method.sun_transmittance(lit_lobes, suns)
            sums = Node("suns", _add_suns, sums, sampled, suns, past_blockers, items=item_text)
        if materials.emission:
            sums = Node("", _add_highlights, sums, self.method.highlights(self, materials, roughness, self._cameras))
        lobe_light = field_of(sums, "straight"), field_of(sums, "grazing")
        arguments = (
            self._numbers,
            diffuse,
            *lobe_light,
            field_of(sampled, "cosines"),
            values["metallic"],
            values["specular"],
        )
        mix = Node("reflection", mix_reflection, *arguments, items=item_text)
        return field_of(mix, "colored"), field_of(mix, "white")

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
        sharing = self.merged_scene.scene.supersampling // self.method.lobes_across  # samples of a receiver, across
        _, height, width = seen.face_ids.shape
        fragments, size = receivers.sample_fragments, (width // sharing, height // sharing)
        assert fragments is not None
        arguments = fragments, self.merged_scene.side_faces, normals, positions, cameras
        return find_normal_spread(*arguments, size, sharing)

    def _sample_lobes(
        self, receivers: Receivers, roughness: wp.array, cameras: wp.array, spread: NormalSpread, seen: Fragments
    ) -> LobeSamples:
        """Samples of the lobes of the receivers. Differentiable: all but seen."""
        places, lobes_across = None, self.method.lobes_across
        if lobes_across > 1 and receivers.samples is not None:
            places = places_in_pixels(receivers.samples, seen.face_ids.shape[2], lobes_across)
        arguments = receivers.points, receivers.normals, roughness, cameras, self.method.lobe_samples_of_receiver
        return sample_lobes(*arguments, spread, places, lobes_across**2)

    def _sample_textures(
        self, fragments: Fragments, values: wp.array, textures: Textures, footprints: Footprints
    ) -> wp.array:
        """Find numbers of the view's samples: of textures and, on bodies without one, of vertices."""
        return as_scalars(sample_albedo(fragments, self.merged_scene.faces, as_colors(values), textures, footprints))

    def _prefilter(self, light: LightInput) -> Node:
        """Node of prefiltered light, vec3 of shape [batch, texel]."""
        if light.is_free:
            return Node(
                "prefiltering", self._prefilter_free, light, items=lambda: f"{self.method.basis.size} coefficients"
            )
        return self.method.prefiltered(light)

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


def _find_exits(receivers: Receivers, directions: wp.array, shell: wp.array) -> wp.array:
    """Find directions from the center of a shell to where samples of lobes meet it. Differentiable: all."""
    return exits_from_shell(receivers.points, directions, shell)


def _add_suns(lobe_light: LobeLight, samples: LobeSamples, suns: Suns, transmittance: wp.array) -> LobeLight:
    """Add the light of suns to other light in lobes. Differentiable: all but suns."""
    return add_suns(lobe_light, samples.lobes, suns, transmittance)


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
