"""Suns: the light of small bright discs of a map in lobes, one by one.

A sun that is narrower than the gap between samples of a lobe would show as a star. So suns are taken out of the map
that samples look up, and each, of irradiance E and solid angle Ω around ω, adds to a lobe's light G and G'

    f c T E,   f c T E (1 − v·h)⁵,   f = D V,   c = n·ω,

with the transmittance T towards it, the reflection f and the widths W of :mod:`.lobes`, and the mean of D over the
disc: the mirrors that reflect it to the viewer have slopes W⁻¹h_t / n·h that fill about a disc of radius q, at a
distance d from 0. In these slopes D is the area of a sphere, projected from its pole, so its integral over a disc is
known, the share F of a sphere:

    D = 4 (v·h) F / (Ω n·h),   F = 2 q² / (B (B + d² + 1 − q²)),   B² = (d² + 1 − q²)² + 4 q²,
    d = |W⁻¹h_t| / n·h,        q² = Ω / (4π (v·h) (n·h)³ |W|).

For Ω → 0 this is D of :mod:`.lobes`.
"""

import numpy as np
import warp as wp

from warpshadow.device.batch import common_batch, instance_in
from warpshadow.device.constants import constant
from warpshadow.device.launch import launch
from warpshadow.device.memory import empty
from warpshadow.device.parallel import split_row
from warpshadow.maths.directions import cell_radius
from warpshadow.maths.suns import Suns
from warpshadow.stages.gloss.ggx import fresnel_weight, masking, smith_lambda
from warpshadow.stages.gloss.lobes import Lobes
from warpshadow.stages.gloss.reflection import LobeLight
from warpshadow.stages.gloss.transmittance import horizon_weight

_COST = 20.0  # nanoseconds that a sun takes

wp.set_module_options({"max_unroll": 1})


@wp.kernel
def _find_sun_transmittance(
    first_row: int,
    worker: int,
    # in
    transmittance: wp.array3d(dtype=wp.float32),
    normals: wp.array2d(dtype=wp.vec3),
    cells: wp.array(dtype=wp.int32),
    directions: wp.array(dtype=wp.vec3),
    per_radius: float,
    # out
    sun_transmittance: wp.array3d(dtype=wp.float32),
):
    """A thread owns a receiver."""
    batch, receiver = split_row(first_row + wp.tid(), sun_transmittance.shape[1])
    normal = normals[instance_in(batch, normals.shape[0]), receiver]
    transmittance_batch = instance_in(batch, transmittance.shape[0])
    for i in range(cells.shape[0]):
        height = wp.clamp(0.5 * per_radius * wp.dot(normal, directions[i]) + 0.5, 0.0, 1.0)
        cell_transmittance = transmittance[transmittance_batch, receiver, cells[i]]
        sun_transmittance[batch, receiver, i] = wp.min(cell_transmittance / horizon_weight(height), 1.0)


def find_sun_transmittance(
    transmittance: wp.array, normals: wp.array, suns: Suns, middles: np.ndarray, directions: np.ndarray
) -> wp.array:
    """Transmittance towards suns: that of their cells, min(T / H, 1), with H of :mod:`.transmittance`.

    Args:
        transmittance: Towards cells, float32 of shape [batch, receiver, cell].
        normals: Unit normals, vec3 of shape [batch, receiver].
        suns: The suns.
        middles: Of the cells, unit vectors [cell, 3].
        directions: Where the light of cells comes from, unit vectors [cell, 3].

    Returns:
        Float32 of shape [batch, receiver, sun].

    Differentiable: transmittance, normals.
    """
    count, device = common_batch({"transmittance": transmittance, "normals": normals}), normals.device
    cells = (suns.directions @ middles.T).argmax(axis=1)
    sun_transmittance = empty((count, normals.shape[1], len(cells)), dtype=wp.float32, device=device)
    constants = constant(cells, wp.int32, device), constant(directions[cells], wp.vec3, device)
    launch(
        _find_sun_transmittance,
        count * normals.shape[1],
        inputs=[transmittance, normals, *constants, 1 / float(cell_radius(len(middles)))],
        outputs=[sun_transmittance],
        shared=[array for array in (transmittance, normals) if len(array) < count],
        cost=_COST * len(cells),
    )
    return sun_transmittance


@wp.func
def _disc_density(slope_square: float, disc: float):
    """The term F of the formula, by d² and q²."""
    difference = slope_square + 1.0 - disc
    root = wp.sqrt(difference * difference + 4.0 * disc)
    if difference > 0.0:
        return 2.0 * disc / (root * (root + difference))
    return 0.5 - 0.5 * difference / root


@wp.func
def _reflect_disc(view: wp.vec3, width: wp.vec3, direction: wp.vec3, solid_angle: float):
    """Reflection f c of a disc, and that with (1 − v·h)⁵, in the frame of a lobe."""
    towards_viewer = wp.vec3(view[0], 0.0, view[1])
    mirror = wp.normalize(towards_viewer + direction)
    view_cosine = wp.dot(towards_viewer, mirror)
    area = width[0] * width[2] - width[1] * width[1]
    slope_x = (width[2] * mirror[0] - width[1] * mirror[1]) / (area * mirror[2])
    slope_y = (width[0] * mirror[1] - width[1] * mirror[0]) / (area * mirror[2])
    disc = solid_angle / (4.0 * wp.pi * view_cosine * area * mirror[2] * mirror[2] * mirror[2])
    density = _disc_density(slope_x * slope_x + slope_y * slope_y, disc)
    density = density * 4.0 * view_cosine / (solid_angle * mirror[2])
    lambda_of_light = smith_lambda(width, direction[0], direction[1], direction[2])
    weight = density * direction[2] * masking(direction[2], lambda_of_light, view[1], view[2])
    return wp.vec2(weight, weight * fresnel_weight(view_cosine))


@wp.kernel
def _reflect_suns(
    first_row: int,
    worker: int,
    # in
    normals: wp.array2d(dtype=wp.vec3),
    tangents: wp.array2d(dtype=wp.vec3),
    view_terms: wp.array2d(dtype=wp.vec3),
    widths: wp.array2d(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    irradiance: wp.array(dtype=wp.vec3),
    solid_angles: wp.array(dtype=wp.float32),
    transmittance: wp.array3d(dtype=wp.float32),
    light_f0: wp.array2d(dtype=wp.vec3),
    light_f90: wp.array2d(dtype=wp.vec3),
    # out
    sum_f0: wp.array2d(dtype=wp.vec3),
    sum_f90: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a receiver: G and G'."""
    batch, receiver = split_row(first_row + wp.tid(), sum_f0.shape[1])
    lobe_batch = instance_in(batch, normals.shape[0])
    light_batch = instance_in(batch, light_f0.shape[0])
    normal = normals[lobe_batch, receiver]
    tangent = tangents[lobe_batch, receiver]
    bitangent = wp.cross(normal, tangent)
    view = view_terms[lobe_batch, receiver]
    width = widths[lobe_batch, receiver]
    count = transmittance.shape[2] / directions.shape[0]  # directions of each sun
    transmittance_batch = instance_in(batch, transmittance.shape[0])
    suns_f0 = wp.vec3()
    suns_f90 = wp.vec3()
    for i in range(directions.shape[0]):
        cosine = wp.dot(normal, directions[i])
        if cosine > 0.0:
            direction = wp.vec3(wp.dot(tangent, directions[i]), wp.dot(bitangent, directions[i]), cosine)
            weights = _reflect_disc(view, width, direction, solid_angles[i]) / float(count)
            for k in range(count):
                light = transmittance[transmittance_batch, receiver, i * count + k] * irradiance[i]
                suns_f0 += weights[0] * light
                suns_f90 += weights[1] * light
    sum_f0[batch, receiver] = light_f0[light_batch, receiver] + suns_f0
    sum_f90[batch, receiver] = light_f90[light_batch, receiver] + suns_f90


def add_suns(lobe_light: LobeLight, lobes: Lobes, suns: Suns, transmittance: wp.array) -> LobeLight:
    """Add the light of suns in lobes.

    Args:
        lobe_light: Other light in them.
        lobes: Of :func:`.lobes.sample_lobes`.
        suns: The suns.
        transmittance: Towards as many directions of each sun, the last index of the sun, float32 of shape [batch,
            receiver, direction].

    Differentiable: all but suns.
    """
    device = transmittance.device
    if not len(suns.directions):
        return lobe_light
    if transmittance.shape[2] % len(suns.directions):
        raise ValueError(f"transmittance: got {transmittance.shape[2]} directions of {len(suns.directions)} suns")
    arrays = {"lobe_light": lobe_light.light_f0, "lobes": lobes.normals, "transmittance": transmittance}
    count, receiver_count = common_batch(arrays), lobe_light.light_f0.shape[1]
    sums = LobeLight(*(empty((count, receiver_count), dtype=wp.vec3, device=device) for _ in range(2)))
    of_lobes = [lobes.normals, lobes.tangents, lobes.view_terms, lobes.widths]
    of_suns = [
        constant(suns.directions, wp.vec3, device),
        constant(suns.irradiance, wp.vec3, device),
        constant(suns.solid_angles, wp.float32, device),
    ]
    launch(
        _reflect_suns,
        count * receiver_count,
        inputs=[*of_lobes, *of_suns, transmittance, *lobe_light],
        outputs=[*sums],
        shared=[array for array in (*of_lobes, transmittance, *lobe_light) if len(array) < count],
        cost=_COST * len(suns.directions),
    )
    return sums
