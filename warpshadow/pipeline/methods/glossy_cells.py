"""Transmittance of the cells of receivers on bodies that shine, which their shading in known light finds on its way."""

from __future__ import annotations

import functools
from typing import NamedTuple

import warp as wp

from warpshadow.pipeline.node import Node
from warpshadow.pipeline.receivers.shading_context import ShadingContext
from warpshadow.pipeline.shading.found_visibility import CellVisibility
from warpshadow.pipeline.shading.light_input import LightInput
from warpshadow.pipeline.shading.projected_cells import ProjectedCells
from warpshadow.pipeline.shading.sphere_method import SphereMethod
from warpshadow.pipeline.shading.transfers import join_portions, join_rows
from warpshadow.pipeline.shading.visibility_nodes import LitPortion, ShadingNode, VisibilityNode

CellMethod = SphereMethod[ProjectedCells, CellVisibility]


def shading_with_cells_node(method: CellMethod, context: ShadingContext, light: LightInput) -> Node:
    """Node of the :class:`ShadingAndTransmittance` of points in known light that does not bounce."""
    join, projected_light = functools.partial(_join_both, method), method.projected_light_node(context, light)
    make_shading = functools.partial(ShadingNode, result_of=_shading_and_cells, join=join)
    make = functools.partial(make_shading, method, context, projected_light, light)
    return method.cached_for_light("direct with cells", context, light, make)


def cell_transmittance_node(method: CellMethod, context: ShadingContext, light: LightInput) -> Node:
    """Node of the transmittance of points towards cells, float32 of shape [batch, receiver, direction]."""
    join, basis = functools.partial(_join, method), method.visibility_basis_node(context, light)
    make = functools.partial(VisibilityNode, suffix=" of gloss", result_of=_transmittance_of, join=join)
    return context.cached("cells", light.visibility_key, lambda: make(method, context, basis, None))


class ShadingAndTransmittance(NamedTuple):
    """Shading of receivers, and their transmittance towards cells."""

    shading: wp.array  # vec3 of shape [batch, receiver]
    transmittance: wp.array  # of receivers on bodies that shine, float32 of shape [batch, receiver, direction]


def _shading_and_cells(portion: LitPortion) -> tuple[wp.array, wp.array | None]:
    """Shading of a portion, and the transmittance of its cells if its bodies shine."""
    return portion.result, _transmittance_of(portion) if portion.group.is_glossy else None


def _join_both(method: CellMethod, portions: list[tuple[wp.array, wp.array | None]]) -> ShadingAndTransmittance:
    """Join the shading of portions, and the transmittance of cells that some have. Differentiable: portions."""
    cells = [transmittance for _, transmittance in portions if transmittance is not None]
    return ShadingAndTransmittance(join_portions([shading for shading, _ in portions]), _join(method, cells))


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
