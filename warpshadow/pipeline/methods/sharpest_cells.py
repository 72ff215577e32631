"""Cells of the scene's light whose shadows are sharpest, by which receivers are chosen adaptively."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from warpshadow.assets.color import LUMINANCE
from warpshadow.device.constants import constant
from warpshadow.device.launch import launch
from warpshadow.maths.directions import CHUNK, cell_radius
from warpshadow.pipeline.receivers.groups import Group
from warpshadow.pipeline.shading.projected_cells import ProjectedCells
from warpshadow.pipeline.shading.transfers import LARGEST_COEFFICIENT
from warpshadow.stages.joint_coverage import transmittance_past
from warpshadow.stages.light.shading import shade_cells
from warpshadow.stages.visibility.sharp_cells import SharpCells


class SharpestCells(NamedTuple):
    """Sixteen cells of the scene's light whose shadows are sharpest."""

    directions: np.ndarray  # [16, 3]
    light: wp.array  # luminance in channel 0, for cells of 4π/16, vec3 of shape [1, 16]
    relative_radius: float  # of the cells by which edges of spheres' shadows go, over that of cells of 4π/16
    has_footprints: bool  # whether these edges are as wide as footprints: where cells are sharp to spheres
    edge_radius: float  # of the disc by which planes and convex parts cover them [rad]
    power: np.ndarray  # luminance of all cells [direction]


def find_sharpest_cells(
    projected_light: ProjectedCells, edge_radius_of: Callable[[SharpCells], float]
) -> SharpestCells:
    """Find the cells of known light whose shadows are sharpest: sharp cells if the brightest is one, or the brightest.

    Args:
        projected_light: The light.
        edge_radius_of: Finds the radius of the disc by which planes and convex parts cover sharp cells [rad].
    """
    assert projected_light.coefficients is not None
    power = projected_light.coefficients.numpy()[0] @ LUMINANCE
    of_planes, of_spheres = (
        cells if cells is not None and cells.slots[power.argmax()] >= 0 else None
        for cells in (projected_light.sharp_cells_past_planes, projected_light.sharp_cells)
    )
    directions, light = np.empty((CHUNK, 3)), np.zeros(CHUNK)
    if of_planes is None:
        chosen = np.sort(np.argsort(-power, kind="stable")[:CHUNK])
        directions, light = projected_light.blocking_directions[chosen], power[chosen]
        edge_radius = cell_radius(len(power))
    else:
        directions, slots, _ = of_planes
        light[slots[slots >= 0]] = power[slots >= 0]
        edge_radius = edge_radius_of(of_planes)
    relative_radius = cell_radius(len(power)) / cell_radius(CHUNK) if of_spheres is None else of_spheres.scale
    light = light[:, None] * [CHUNK / len(power), 0, 0]
    on_device = constant(light[None], wp.vec3, projected_light.coefficients.device)
    return SharpestCells(directions, on_device, relative_radius, of_spheres is not None, edge_radius, power)


def find_share_of_sharpest_light(
    group: Group, sharpest: SharpestCells, cell_directions: np.ndarray, *, softness: float, merging: float
) -> wp.array | None:
    """Share of a group's unblocked light that still comes from the sharpest cells.

    Args:
        group: The receivers, with the blockers around them.
        sharpest: The sharpest cells.
        cell_directions: Directions of all cells, [direction, 3].
        softness, merging: Of spheres' shadows, in radii of the sharpest cells.
    Returns:
        float32 of shape [batch, receiver]; None where nothing blocks.
    """
    directions, light, _, has_footprints, edge_radius, power = sharpest
    footprints, transmittance = group.footprints if has_footprints else None, None
    if group.blockers.spheres is not None:
        options: dict[str, Any] = {"softness": softness, "merging": merging, "footprints": footprints}
        transmittance = group.blockers.spheres.transmittance(group, directions, **options)
    coverages = [kind.coverage(group, directions, edge_radius) for kind in group.blockers.covering]
    if coverages:
        transmittance = transmittance_past(transmittance, *coverages)
    if transmittance is None:
        return None
    normals = group.normals
    lit = shade_cells(transmittance, normals, directions, light, maximum=LARGEST_COEFFICIENT)
    ratios = wp.empty(normals.shape, dtype=wp.float32, device=normals.device)
    on_device = constant(cell_directions, wp.vec3d, normals.device), constant(power, wp.float64, normals.device)
    unblocked = wp.empty((len(normals), 2), dtype=wp.float64, device=normals.device)
    launch(_find_unblocked, unblocked.shape, inputs=[normals, *on_device], outputs=[unblocked])
    launch(_divide, ratios.shape, inputs=[lit, normals, unblocked], outputs=[ratios])
    return ratios


@wp.kernel(enable_backward=False)
def _find_unblocked(
    # in
    normals: wp.array2d(dtype=wp.vec3),
    cell_directions: wp.array(dtype=wp.vec3d),
    power: wp.array(dtype=wp.float64),
    # out
    unblocked: wp.array2d(dtype=wp.float64),
):
    """A thread owns a side of a plane: luminance on it if nothing blocks, 0 of the side of the first receiver."""
    batch, side = wp.tid()
    normal = wp.where(side == 0, 1.0, -1.0) * normals[batch, 0]
    total = wp.float64(0.0)
    for cell in range(power.shape[0]):
        direction = cell_directions[cell]
        cosine = wp.float64(normal[0]) * direction[0] + wp.float64(normal[1]) * direction[1]
        cosine += wp.float64(normal[2]) * direction[2]
        total += wp.max(cosine, wp.float64(0.0)) * power[cell]
    unblocked[batch, side] = wp.float64(4.0) / wp.float64(power.shape[0]) * total


@wp.kernel(enable_backward=False)
def _divide(
    # in
    lit: wp.array2d(dtype=wp.vec3),
    normals: wp.array2d(dtype=wp.vec3),
    unblocked: wp.array2d(dtype=wp.float64),
    # out
    ratios: wp.array2d(dtype=float),
):
    """A thread owns a receiver: on a plane it has the normal of the first one or its opposite."""
    batch, receiver = wp.tid()
    side = wp.where(wp.dot(normals[batch, receiver], normals[batch, 0]) > 0.0, 0, 1)
    ratio = wp.float64(0.0)
    if unblocked[batch, side] > wp.float64(0.0):
        ratio = wp.float64(lit[batch, receiver][0]) / unblocked[batch, side]
    ratios[batch, receiver] = float(ratio)
