"""Transmittance in lobes by the directional method: that of cells, which the shading of a view has found."""

import functools
from typing import NamedTuple

import numpy as np
import warp as wp

from warpshadow.pipeline.node import Call, Node, field_of
from warpshadow.pipeline.receivers.groups import CellVisibility
from warpshadow.pipeline.receivers.lit_points import LitPoints, receiver_text
from warpshadow.pipeline.shading.light_input import LightInput
from warpshadow.pipeline.shading.lobe_light import LitLobes, LobeVisibility
from warpshadow.pipeline.shading.projected_cells import ProjectedCells
from warpshadow.pipeline.shading.sphere_method import LitPortion, PortionedShading, PortionedVisibility, SphereMethod
from warpshadow.pipeline.shading.transfers import LARGEST_COEFFICIENT, change_basis, join_portions, join_rows
from warpshadow.stages.gloss.reflection import find_blocked_radiance
from warpshadow.stages.gloss.suns import Suns, find_sun_transmittance
from warpshadow.stages.gloss.transmittance import interpolate_transmittance
from warpshadow.stages.light.shading import shade
from warpshadow.stages.light.transfer import directional_transfer
from warpshadow.stages.receivers.find import Receivers


class CellLobes(LobeVisibility):
    """Visibility in lobes between cells.

    Args:
        method: The method.
        middles: Of the cells, [direction, 3].
    """

    def __init__(self, method: SphereMethod[ProjectedCells, CellVisibility], middles: np.ndarray):
        super().__init__(method.merged_scene, method.light, shares_receivers=method.shares_lobes)
        self._method, self._middles = method, middles

    def shading(self, points: LitPoints, light: LightInput) -> Node:
        """Node of the shading of points in known light, and of the transmittance of the glossy ones' cells."""
        projected_light = self._method.projected_light(points, light)
        make = functools.partial(_ShadingWithCells, self._method, points, projected_light, light)
        return self._method.cached_for_light("direct with cells", points, light, make)

    def _cells(self, lobes: LitLobes) -> tuple[Node, Node, Node | ProjectedCells]:
        """Nodes of the transmittance of cells and of their receivers, and the projected light that says which cells.

        In known light that does not bounce the shading of the view has found it.
        """
        points, light = lobes.points, lobes.light
        visibility_light = self._method.light_of_visibility(points, light)
        if light.is_free or self._merged_scene.scene.bounces:
            make = functools.partial(
                _TransmittanceOfCells, self._method, points, visibility_light, None, suffix=" of gloss"
            )
            return points.cached("cells", light.visibility_key, make), points.receivers_node, visibility_light
        transmittance = field_of(self.shading(lobes.all_points, light), "transmittance")
        return transmittance, points.receivers_node, visibility_light

    def transmittance(self, lobes: LitLobes, directions: Node) -> Node:
        """Transmittance towards the samples of lobes, between cells; in known light, between where their light is."""
        item_text = functools.partial(receiver_text, lobes.points.weak)
        return Node("transmittance of lobes", _interpolate, *self._cells(lobes), directions, items=item_text)

    def sun_transmittance(self, lobes: LitLobes, suns: Node) -> Node:
        """Transmittance towards suns, of their cells."""
        item_text = functools.partial(receiver_text, lobes.points.weak)
        find = functools.partial(_find_sun_transmittance, self._middles)
        return Node("transmittance of suns", find, *self._cells(lobes), suns, items=item_text)

    def blocked_radiance(self, lobes: LitLobes, diffuse: Node, openness: Node | None) -> Node:
        """Mean radiance of the blockers of receivers, by their light with bounces and without."""
        free = lobes.light if lobes.light.is_free else None
        return Node("light of blockers", self._mean_radiance_of_blockers, *self._cells(lobes), diffuse, free)

    def _mean_radiance_of_blockers(
        self,
        transmittance: wp.array,
        receivers: Receivers,
        projected_light: ProjectedCells,
        diffuse: wp.array,
        free: wp.array | None,
    ) -> wp.array:
        if not diffuse.size:
            return diffuse
        of_cells = transfer = directional_transfer(transmittance, receivers.normals, projected_light.cosine_directions)
        if projected_light.patches is not None:
            arguments = receivers.points, receivers.normals, transmittance, projected_light.blocking_directions
            transfer = projected_light.patches.transfer(*arguments)
        light = projected_light.coefficients if free is None else change_basis(free, self._method.native_from_basis)
        assert light is not None
        even = wp.full((1, transmittance.shape[2]), wp.vec3(1.0), dtype=wp.vec3, device=diffuse.device)
        direct, openness = shade(transfer, light, maximum=LARGEST_COEFFICIENT), shade(of_cells, even)
        return find_blocked_radiance(diffuse, direct, openness)


class _ShadingAndTransmittance(NamedTuple):
    """Shading of receivers, and their transmittance towards cells."""

    shading: wp.array  # vec3 of shape [batch, receiver]
    transmittance: wp.array  # of receivers on bodies that shine, float32 of shape [batch, receiver, direction]


class _ShadingWithCells(PortionedShading):
    """Shading of receivers, and the transmittance of cells at bodies that shine."""

    def compute(self, call: Call) -> _ShadingAndTransmittance:
        """Shade all portions."""
        portions = list(self.portions(call))
        cells = [transmittance for _, transmittance in portions if transmittance is not None]
        return _ShadingAndTransmittance(join_portions([shading for shading, _ in portions]), _join(self.method, cells))

    def result_of(self, portion: LitPortion) -> tuple[wp.array, wp.array | None]:
        """Shading of a portion, and the transmittance of its cells if its body shines."""
        body = portion.group.body
        is_glossy = body is not None and self.method.merged_scene.is_glossy[body]
        return portion.result, _transmittance_of(portion) if is_glossy else None


class _TransmittanceOfCells(PortionedVisibility):
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


def _interpolate(
    transmittance: wp.array, receivers: Receivers, projected_light: ProjectedCells, directions: wp.array
) -> wp.array:
    if not directions.size:
        return wp.empty(directions.shape, dtype=wp.float32, device=directions.device)
    return interpolate_transmittance(transmittance, receivers.normals, directions, projected_light.cosine_directions)


def _find_sun_transmittance(
    middles: np.ndarray, transmittance: wp.array, receivers: Receivers, projected_light: ProjectedCells, suns: Suns
) -> wp.array:
    return find_sun_transmittance(transmittance, receivers.normals, suns, middles, projected_light.cosine_directions)
