"""The receivers of a view on bodies that shine."""

from __future__ import annotations

import functools

import numpy as np
import warp as wp

from warpshadow.device.batch import concatenate, cut
from warpshadow.device.constants import constant
from warpshadow.pipeline.node import Input, Node, detached
from warpshadow.pipeline.receivers.shading_context import ShadingContext
from warpshadow.stages.gloss.reflection import number_runs
from warpshadow.stages.raster.rasterization import Fragments
from warpshadow.stages.receivers.body_spans import Span
from warpshadow.stages.receivers.receivers import Receivers


class GlossyPoints(ShadingContext):
    """The receivers of a view on bodies that shine; pixels see them all.

    Args:
        view: The view.
        cameras: Clip matrices of its cameras, or one for all.
        fragments, clip_positions: Nodes of its samples, and of the vertices in clip space.
    Attributes:
        all_receivers: Node of the receivers of the view.
        numbers: Node of the numbers of glossy ones among these, −1 for diffuse ones, int32 of shape [receiver].
    """

    def __init__(self, view: ShadingContext, cameras: Input, fragments: Node, clip_positions: Node):
        glossy = view.merged_scene.is_glossy
        self.all_receivers, self.cameras = view.receivers_node, cameras
        self.fragments, self.clip_positions = fragments, clip_positions
        receivers = Node("", functools.partial(_select_receivers, glossy), self.all_receivers)
        super().__init__(
            view.merged_scene,
            view.materials,
            view.vertices,
            view.spheres,
            receivers,
            view.call,
            normals=view.normals,
            blocker_kinds=view.blocker_kinds,
            is_scene_view=view.is_scene_view,
            shares_cache_with=view,
        )
        self.numbers = Node("", functools.partial(_number_glossy, glossy), detached(self.all_receivers))

    def select(self, light: Node) -> Node:
        """Select the light on these receivers from that on all receivers of the view; a node."""
        return Node("", _select_light, light, detached(self.all_receivers), self.merged_scene.is_glossy)


def _find_glossy_spans(is_glossy: np.ndarray, receivers: Receivers) -> list[Span]:
    return [span for span in receivers.spans if span.body >= 0 and is_glossy[span.body]]


def _number_glossy(is_glossy: np.ndarray, receivers: Receivers) -> wp.array:
    """Number the glossy ones among the receivers of a view, −1 for diffuse ones, int32 of shape [receiver]."""
    first = len(receivers.static_vertices)
    runs = [(first + span.first, first + span.end) for span in _find_glossy_spans(is_glossy, receivers)]
    return number_runs(first + receivers.points.shape[1], runs, receivers.points.device)


def _select_light(light: wp.array, receivers: Receivers, is_glossy: np.ndarray) -> wp.array:
    """Select light, or another value, of the glossy ones among a view's receivers. Differentiable: light."""
    return _cut_spans(light, _find_glossy_spans(is_glossy, receivers), -len(receivers.static_vertices))


def _cut_spans(array: wp.array, spans: list[Span], first: int) -> wp.array:
    """Cut spans of items out of an array, counting from an item."""
    parts = [cut(array, span.first - first, span.end - first) for span in spans]
    if not parts:
        return wp.empty((len(array), 0), dtype=array.dtype, device=array.device)
    return parts[0] if len(parts) == 1 else concatenate(parts, [part.shape[1] for part in parts])


def _select_receivers(is_glossy: np.ndarray, receivers: Receivers) -> Receivers:
    """Select the glossy receivers of a view; pixels see them all. Differentiable: points, normals."""
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
