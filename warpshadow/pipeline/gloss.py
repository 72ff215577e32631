"""Gloss: the light of bodies that shine, at receivers that pixels see.

Lobes are sampled at the receivers of glossy bodies; each sample looks up light without shadows in a prefiltered map,
and its transmittance in the way of the method. Diffuse light is found as for all bodies, and mixed in at the end.
"""

from __future__ import annotations

import functools
import operator

import numpy as np
import warp as wp

from warpshadow.device.batch import concatenate, cut, rows
from warpshadow.device.constants import constant
from warpshadow.pipeline.lighting import Light, LitPoints, change_basis, receiver_text
from warpshadow.pipeline.node import Input, Node, detached
from warpshadow.pipeline.reflectance import Materials
from warpshadow.scene.body import GLOSS_ARGUMENTS
from warpshadow.stages.gloss.lobes import sample_lobes
from warpshadow.stages.gloss.prefilter import look_up_light, prefilter
from warpshadow.stages.gloss.reflection import mix_reflection, sum_lobes
from warpshadow.stages.interpolation import interpolate
from warpshadow.stages.rasterization import Fragments
from warpshadow.stages.receivers import Receivers
from warpshadow.stages.sample_receivers import Span
from warpshadow.stages.sides import front_faces
from warpshadow.stages.textures.footprint import find_footprints
from warpshadow.stages.textures.numbers import as_colors, as_numbers
from warpshadow.stages.textures.pyramid import Textures
from warpshadow.stages.textures.sample import sample_albedo

_CELL_ROWS = 64  # rows of the map of free light in cells: each pixel has the light of the nearest cell


class GlossyPoints(LitPoints):
    """The receivers of a view on bodies that shine.

    Args:
        view: The view.
        cameras: Clip matrices of its cameras, or one for all.
        clip_positions: Node of the vertices in their clip space.
        image_size: Height and width of its images.
    """

    def __init__(self, view: LitPoints, cameras: Input, clip_positions: Node, image_size: tuple[int, int]):
        glossy = view.merged_scene.is_glossy
        receivers = Node("", functools.partial(_glossy_receivers, glossy), view.receivers_node)
        self._all_receivers, self._cameras = view.receivers_node, cameras
        self._clip_positions, self._image_size = clip_positions, image_size
        self._fragments = Node("", self._fragments_of, receivers)
        arguments = view.method, view.materials, view.vertices, view.spheres, receivers, view.call
        super().__init__(*arguments, normals=view.normals, blocker_kinds=view.blocker_kinds, is_static=view.is_static)
        self._numbers = Node("", functools.partial(_numbers, glossy), detached(view.receivers_node))

    def mixed(self, view: LitPoints, diffuse: Node, light: Light | None, materials: Materials) -> tuple[Node, Node]:
        """Light that colored and that white surfaces reflect, of all receivers of the view: vec3 [batch, receiver].

        Args:
            view: The view, or its preview.
            diffuse: Node of the view's shading.
            light: As for :meth:`LitPoints.shading`.
            materials: Of the bodies.
        """
        item_text = functools.partial(receiver_text, self)
        roughness, metallic, specular = (self._values(materials, name) for name in GLOSS_ARGUMENTS)
        key = materials.roughness

        def lobes() -> Node:
            inputs = self.receivers_node, roughness, self._cameras, self.method.lobe_samples
            return Node("lobes", _sample, *inputs, items=item_text)

        sampled = self.cached("lobes", key, lobes)
        directions, filters, cosines = (Node("", operator.itemgetter(part), sampled) for part in range(3))
        source = self.light_input(light)
        texels = self.cached("prefiltered", source, lambda: self._prefiltered(source))
        radiance = Node("prefiltered light", look_up_light, texels, directions, filters, items=item_text)
        through = self.method.lobe_transmittance(self, directions, source)
        blocked = None
        if self.merged_scene.scene.bounces:
            blocked = self.method.blocked_radiance(self, self.chosen(diffuse), source, view, self.chosen)
        sums = Node("gloss", sum_lobes, filters, radiance, through, blocked, items=item_text)
        straight, grazing = (Node("", operator.itemgetter(part), sums) for part in range(2))
        arguments = self._numbers, diffuse, straight, grazing, cosines, metallic, specular
        mix = Node("reflection", mix_reflection, *arguments, items=item_text)
        return Node("", operator.itemgetter(0), mix), Node("", operator.itemgetter(1), mix)

    def chosen(self, light: Node) -> Node:
        """Node of light on these receivers, given that of all receivers of the view."""
        return Node("", _chosen, light, detached(self._all_receivers), self.merged_scene.is_glossy)

    def _values(self, materials: Materials, name: str) -> Node:
        """Roughness or the like at the receivers, float32 of shape [batch, receiver]."""
        inputs, textures = (self._fragments, materials.of_vertices(name)), materials.textures_of[name]
        if not textures.images:
            return Node("", self._interpolate, *inputs)
        sample = functools.partial(self._sample, textures.texture_of_face)
        return Node("", sample, *inputs, self._clip_positions, textures.pyramids)

    def _fragments_of(self, receivers: Receivers) -> Fragments:
        """The faces that the receivers lie on, [batch, 1, receiver]. Differentiable: barycentrics."""
        assert receivers.seen is not None
        faces = front_faces(receivers.seen.face_ids, self.merged_scene.faces.size)
        return Fragments(*(array.reshape((len(array), 1, -1)) for array in (faces, receivers.seen.barycentrics)))

    def _interpolate(self, fragments: Fragments, values: wp.array) -> wp.array:
        """Numbers of the receivers, from those of all vertices."""
        if not fragments.face_ids.size:
            return wp.empty((1, 0), dtype=wp.float32, device=values.device)
        return rows(interpolate(fragments, self.merged_scene.faces, values))

    def _sample(
        self, texture_of_face: wp.array, fragments: Fragments, values: wp.array, clip: wp.array, textures: Textures
    ) -> wp.array:
        """Numbers of the receivers, from textures and, on bodies without one, from those of all vertices."""
        if not fragments.face_ids.size:
            return wp.empty((1, 0), dtype=wp.float32, device=values.device)
        merged_scene = self.merged_scene
        seen = fragments, merged_scene.faces
        maps = merged_scene.uvs, merged_scene.uv_faces, texture_of_face
        footprints = find_footprints(*seen, clip, *maps, textures, self._image_size)
        return as_numbers(sample_albedo(*seen, as_colors(values), textures, footprints))

    def _prefiltered(self, light: Input) -> Node:
        """Node of the texels of light, vec3 of shape [batch, texel]."""
        if isinstance(light.value(), wp.array):
            return Node("prefiltering", self._blurred, light, items=lambda: f"{self.method.basis.size} coefficients")
        return self.method.prefiltered(light)

    def _blurred(self, light: wp.array) -> wp.array:
        """Prefiltered texels of free light. Differentiable: light."""
        return change_basis(light, _blurred_basis(self.method.basis))


@functools.lru_cache(maxsize=4)
def _blurred_basis(basis: object) -> np.ndarray:
    """The matrix from coefficients of a basis to texels, float32 of shape [texel, coefficient]."""
    from warpshadow.maths import sh

    directions = sh.equirectangular_directions(_CELL_ROWS)
    functions = basis.functions(directions.reshape(-1, 3))  # type: ignore[attr-defined]
    return prefilter(functions.reshape(_CELL_ROWS, 2 * _CELL_ROWS, -1))


def _sample(
    receivers: Receivers, roughness: wp.array, cameras: wp.array, sample_count: int
) -> tuple[wp.array, wp.array, wp.array]:
    return sample_lobes(receivers.points, receivers.normals, roughness, cameras, sample_count)


def _spans(is_glossy: np.ndarray, receivers: Receivers) -> list[Span]:
    return [span for span in receivers.spans if span.body >= 0 and is_glossy[span.body]]


def _numbers(is_glossy: np.ndarray, receivers: Receivers) -> wp.array:
    """Of each receiver of a view among the glossy ones, −1 for diffuse ones, int32 of shape [receiver]."""
    first = len(receivers.on_static)
    numbers, count = np.full(first + receivers.points.shape[1], -1, np.int32), 0
    for span in _spans(is_glossy, receivers):
        numbers[first + span.first : first + span.end] = count + np.arange(span.end - span.first)
        count += span.end - span.first
    return wp.array(numbers, dtype=wp.int32, device=receivers.points.device)


def _chosen(light: wp.array, receivers: Receivers, is_glossy: np.ndarray) -> wp.array:
    """Light on the glossy ones among a view's receivers, vec3 of shape [batch, receiver]. Differentiable: light."""
    return _of_spans(light, _spans(is_glossy, receivers), -len(receivers.on_static))


def _of_spans(array: wp.array, spans: list[Span], first: int) -> wp.array:
    """Cut spans of items out of an array, counting from an item."""
    parts = [cut(array, span.first - first, span.end - first) for span in spans]
    if not parts:
        return wp.empty((len(array), 0), dtype=array.dtype, device=array.device)
    return parts[0] if len(parts) == 1 else concatenate(parts, [part.shape[1] for part in parts])


def _glossy_receivers(is_glossy: np.ndarray, receivers: Receivers) -> Receivers:
    """The glossy ones among the receivers of a view, all of which pixels see. Differentiable: points, normals."""
    spans, count = _spans(is_glossy, receivers), 0
    assert receivers.vertices is not None
    at_vertices, seen = receivers.vertices.size, receivers.seen
    renumbered = []
    for span in spans:
        renumbered.append(Span(span.body, count, count + span.end - span.first))
        count = renumbered[-1].end

    if seen is None:
        device = receivers.points.device
        seen = Fragments(*(wp.empty((1, 0), dtype=dtype, device=device) for dtype in (wp.int32, wp.vec3)))
    fragments = Fragments(*(_of_spans(array, spans, at_vertices) for array in (seen.face_ids, seen.barycentrics)))
    none = constant(np.empty(0, int), wp.int32, receivers.points.device)
    points, normals = (_of_spans(array, spans, 0) for array in (receivers.points, receivers.normals))
    arguments = points, normals, receivers.faces, none, fragments
    return Receivers(*arguments, spans=tuple(renumbered), vertices=none, seen=fragments)
