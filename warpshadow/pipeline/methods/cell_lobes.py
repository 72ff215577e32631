"""Transmittance in lobes by the directional method, from the cells of receivers on bodies that shine."""

import functools

import numpy as np
import warp as wp

from warpshadow.maths.suns import Suns
from warpshadow.pipeline.methods.glossy_cells import CellMethod, cell_transmittance_node, shading_with_cells_node
from warpshadow.pipeline.node import Node, field_of
from warpshadow.pipeline.receivers.shading_context import receiver_text
from warpshadow.pipeline.shading.lobe_light import LitLobes, LobeVisibility
from warpshadow.pipeline.shading.projected_cells import ProjectedCells
from warpshadow.pipeline.shading.transfers import LARGEST_COEFFICIENT, change_basis
from warpshadow.stages.gloss.reflection import find_blocked_radiance
from warpshadow.stages.gloss.suns import find_sun_transmittance
from warpshadow.stages.gloss.transmittance import interpolate_transmittance, sharpen
from warpshadow.stages.light.shading import shade
from warpshadow.stages.light.transfer import directional_transfer
from warpshadow.stages.receivers.receivers import Receivers


class CellLobes(LobeVisibility):
    """Visibility in lobes between cells.

    Args:
        method: The method.
        middles: Of the cells, [direction, 3].
    """

    def __init__(self, method: CellMethod, middles: np.ndarray):
        super().__init__(method.merged_scene, method.light, shares_receivers=method.shares_lobes)
        self._method, self._middles = method, middles

    def _cells(self, lobes: LitLobes) -> tuple[Node, Node, Node | ProjectedCells]:
        """Nodes of the transmittance of cells and of their receivers, and the projected light that says which cells.

        In known light that does not bounce the shading of the view has found it.
        """
        points, light = lobes.points, lobes.light
        visibility_light = self._method.visibility_basis_node(points, light)
        if light.is_free or self._merged_scene.scene.bounces:
            transmittance = cell_transmittance_node(self._method, points, light)
        else:
            transmittance = field_of(shading_with_cells_node(self._method, lobes.all_points, light), "transmittance")
        return transmittance, points.receivers_node, visibility_light

    def transmittance(self, lobes: LitLobes, directions: Node) -> Node:
        """Transmittance towards the samples of lobes, between cells; in known light, between where their light is."""
        item_text = functools.partial(receiver_text, lobes.points.weak_reference)
        return Node("transmittance of lobes", _interpolate, *self._cells(lobes), directions, items=item_text)

    def sun_transmittance(self, lobes: LitLobes, suns: Node) -> Node:
        """Transmittance towards suns, of their cells."""
        item_text = functools.partial(receiver_text, lobes.points.weak_reference)
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
        cell_transfer = transfer = directional_transfer(
            transmittance, receivers.normals, projected_light.cosine_directions
        )
        if projected_light.shell_cells is not None:
            directions, find_transfer = projected_light.blocking_directions, projected_light.shell_cells.find_transfer
            transfer = find_transfer(receivers.points, receivers.normals, transmittance, directions)
        light = projected_light.coefficients if free is None else change_basis(free, self._method.native_from_basis)
        assert light is not None
        even = wp.full((1, transmittance.shape[2]), wp.vec3(1.0), dtype=wp.vec3, device=diffuse.device)
        direct, openness = shade(transfer, light, maximum=LARGEST_COEFFICIENT), shade(cell_transfer, even)
        return find_blocked_radiance(diffuse, direct, openness)


def _interpolate(
    transmittance: wp.array, receivers: Receivers, projected_light: ProjectedCells, directions: wp.array
) -> wp.array:
    if not directions.size:
        return wp.empty(directions.shape, dtype=wp.float32, device=directions.device)
    cells = projected_light.cosine_directions
    return sharpen(interpolate_transmittance(transmittance, receivers.normals, directions, cells))


def _find_sun_transmittance(
    middles: np.ndarray, transmittance: wp.array, receivers: Receivers, projected_light: ProjectedCells, suns: Suns
) -> wp.array:
    return find_sun_transmittance(transmittance, receivers.normals, suns, middles, projected_light.cosine_directions)
