"""Transmittance of receivers in cells of directions, whose blocked part sends bounced light.

Where the method of visibility has no cells, it is found here, past spheres.
"""

from typing import NamedTuple

import numpy as np
import warp as wp

from warpshadow.device.batch import common_batch, expand
from warpshadow.maths.directions import fibonacci
from warpshadow.pipeline.receivers.groups import Group
from warpshadow.pipeline.shading.found_visibility import CellVisibility, HarmonicVisibility
from warpshadow.pipeline.shading.sphere_method import SphereMethod
from warpshadow.stages.visibility.directional import transmittance

HARMONIC_GATHER_CELLS = fibonacci(64)  # where receivers look for bounced light if direct light is found in harmonics


class CellTransmittance(NamedTuple):
    """Transmittance of a portion of the receivers in cells of directions."""

    transmittance_self: wp.array | None  # [batch, receiver, cell], past its own body; None where that is 1
    transmittance_nonplanar: wp.array  # [batch, receiver, cell], past all bodies but planes, its own included
    directions: np.ndarray  # [cell, 3]
    part_coverages: wp.array | None  # coverage by convex parts, vec4 of shape [batch, receiver, cell]; None without any


def find_cell_transmittance(
    method: SphereMethod,
    group: Group,
    visibility: CellVisibility | HarmonicVisibility,
    spheres: tuple[wp.array, wp.array],
) -> CellTransmittance:
    """Transmittance of a group in cells of directions.

    Args:
        method: How light is blocked.
        group: The receivers.
        visibility: Visibility of direct light.
        spheres: Centers and radii of all spheres.
    """
    merged_scene = method.merged_scene
    parts = None
    if isinstance(visibility, CellVisibility):
        directions, transmittance_self = visibility.directions, visibility.transmittance_self
        parts = None if visibility.part_coverages is None else visibility.part_coverages.all_cells
        transmittance_nonplanar = (
            visibility.transmittance_total
            if visibility.transmittance_nonplanar is None
            else visibility.transmittance_nonplanar
        )
    else:
        directions, transmittance_self = HARMONIC_GATHER_CELLS, None
        transmittance_nonplanar = _transmittance(method, group, merged_scene.nonplanar_bodies, spheres, directions)
    if transmittance_self is None and group.body is not None and not merged_scene.is_flat[group.body]:
        transmittance_self = _transmittance(method, group, [group.body], spheres, directions)
    if transmittance_nonplanar is None:
        transmittance_nonplanar = wp.full(
            (*group.points.shape, len(directions)), 1.0, wp.float32, device=group.points.device
        )
    return CellTransmittance(transmittance_self, transmittance_nonplanar, directions, parts)


def _transmittance(
    method: SphereMethod, group: Group, bodies: list[int], spheres: tuple[wp.array, wp.array], directions: np.ndarray
) -> wp.array | None:
    """Transmittance of the spheres of some bodies, [batch, receiver, cell]; None without any."""
    centers, radii = method.merged_scene.spheres_of(bodies, spheres)
    if not (radii.shape[1] and group.points.size):
        return None
    count = common_batch({"points": group.points, "spheres": radii})  # cameras may see one geometry at other points
    points, normals, centers, radii = (expand(array, count) for array in (group.points, group.normals, centers, radii))
    softness, merging = method.visibility.softness, method.visibility.merging
    return transmittance(points, normals, centers, radii, directions, softness=softness, merging=merging)
