"""Transmittance of the cells of receivers on bodies that shine, which their shading in known light finds on its way."""

from __future__ import annotations

import functools
from typing import NamedTuple

import warp as wp

from warpshadow.pipeline.node import Call, Node
from warpshadow.pipeline.receivers.groups import CellVisibility
from warpshadow.pipeline.receivers.shading_context import ShadingContext
from warpshadow.pipeline.shading.light_input import LightInput
from warpshadow.pipeline.shading.projected_cells import ProjectedCells
from warpshadow.pipeline.shading.sphere_method import LitPortion, ShadingNode, SphereMethod, VisibilityNode
from warpshadow.pipeline.shading.transfers import join_portions, join_rows

CellMethod = SphereMethod[ProjectedCells, CellVisibility]


def shading_with_cells(method: CellMethod, points: ShadingContext, light: LightInput) -> Node:
    """Node of the :class:`ShadingAndTransmittance` of points in known light that does not bounce."""
    make = functools.partial(_ShadingWithCells, method, points, method.projected_light(points, light), light)
    return method.cached_for_light("direct with cells", points, light, make)


def transmittance_of_cells(method: CellMethod, points: ShadingContext, light: LightInput) -> Node:
    """Node of the transmittance of points towards cells, float32 of shape [batch, receiver, direction]."""
    arguments = method, points, method.visibility_basis(points, light), None
    make = functools.partial(_TransmittanceOfCells, *arguments, suffix=" of gloss")
    return points.cached("cells", light.visibility_key, make)


class ShadingAndTransmittance(NamedTuple):
    """Shading of receivers, and their transmittance towards cells."""

    shading: wp.array  # vec3 of shape [batch, receiver]
    transmittance: wp.array  # of receivers on bodies that shine, float32 of shape [batch, receiver, direction]


class _ShadingWithCells(ShadingNode):
    """Shading of receivers, and the transmittance of cells at bodies that shine."""

    def compute(self, call: Call) -> ShadingAndTransmittance:
        """Shade all portions."""
        portions = list(self.portions(call))
        cells = [transmittance for _, transmittance in portions if transmittance is not None]
        return ShadingAndTransmittance(join_portions([shading for shading, _ in portions]), _join(self.method, cells))

    def result_of(self, portion: LitPortion) -> tuple[wp.array, wp.array | None]:
        """Shading of a portion, and the transmittance of its cells if its body shines."""
        body = portion.group.body
        is_glossy = body is not None and self.method.merged_scene.is_glossy[body]
        return portion.result, _transmittance_of(portion) if is_glossy else None


class _TransmittanceOfCells(VisibilityNode):
    """Transmittance of receivers towards cells, float32 of shape [batch, receiver, direction]."""

    def compute(self, call: Call) -> wp.array:
        """Find it for all portions."""
        return _join(self.method, list(self.portions(call)))

    def result_of(self, portion: LitPortion) -> wp.array | None:
        """Transmittance of the cells of a portion."""
        return _transmittance_of(portion)


def _transmittance_of(portion: LitPortion) -> wp.array | None:
    """Transmittance of a portion past all bodies, float32 of shape [batch, receiver, direction]."""
    assert isinstance(portion.visibility, CellVisibility)
    return portion.visibility.transmittance_total


def _join(method: SphereMethod, portions: list[wp.array]) -> wp.array:
    """Join the transmittance of portions, [batch, receiver, direction]. Differentiable: portions."""
    merged_scene = method.merged_scene
    if not portions:
        return wp.empty((1, 0, merged_scene.scene.direction_count), dtype=wp.float32, device=merged_scene.device)
    return join_rows(portions)
