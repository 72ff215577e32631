"""Plane light: light that planes, such as a ground or walls, send to receivers through the cells that they block.

    I = 4/Q Σ_q max(n·ω_q, 0) T_q min(1, Σ_k h_k) Σ_k h_k o_k B_k / Σ_k h_k o_k

For each side k of a plane that cell q meets, h_k is its coverage, o_k the share that nearer sides leave open of that,
and B_k the radiosity of the visible part (:mod:`.plane_hits`), from the texels of the plane (:mod:`.plane_texels`). T_q
is the transmittance past all other bodies. Planes send all that they block of a cell
(:mod:`warpshadow.stages.planes.coverage`), as much of it as is seen of each: by Σ h_k o_k B_k alone, cells in which
walls meet would lose h_k h_j. A plane is seen from both sides; its back is black unless it has patches there.

A ball over a ground with the shadow of a disc is 2.0% off in 128 cells, and 1.3% in 1024.
"""

import numpy as np
import warp as wp

from warpshadow import check
from warpshadow.device.batch import common_batch, expand, expand_rows, instance_in
from warpshadow.device.constants import constant
from warpshadow.device.launch import launch_with_adjoint
from warpshadow.maths.directions import cell_radius
from warpshadow.stages.bounces.plane_hits import (
    PlaneHit,
    find_side_hits,
    find_side_hits_adjoint,
    hit_scratch,
    is_hit,
    mean_radiosity,
)
from warpshadow.stages.cell_coverage import ViewedEdge
from warpshadow.stages.light.sums import begin_sum
from warpshadow.stages.planes.cells import check_planes, plane_arrays
from warpshadow.stages.planes.plane_blockers import PlaneBlockers
from warpshadow.stages.planes.sides import (
    PlaneInputs,
    StoredSide,
    plane_inputs,
    prepare_receiver,
    prepare_receiver_adjoint,
    receiver_scratch,
    visible_cell,
)

_CELL_COST = 15.0  # mean time of a cell of a receiver [ns], over cells that hit a plane and cells that do not


@wp.kernel(enable_backward=False)
def _light_receivers(
    first_row: int,
    worker: int,
    # in
    inputs: PlaneInputs,
    normals: wp.array2d(dtype=wp.vec3),
    transmittance: wp.array3d(dtype=wp.float32),
    coverages: wp.array3d(dtype=wp.vec4),
    texels: wp.array2d(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    # scratch
    sides: wp.array2d(dtype=StoredSide),
    edges: wp.array2d(dtype=ViewedEdge),
    hits: wp.array2d(dtype=PlaneHit),
    # out
    light: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a receiver, and adds to its light."""
    receiver = prepare_receiver(first_row + wp.tid(), worker, inputs, sides, edges)
    batch, index = receiver.batch, receiver.index
    hits_of_cell = hits[receiver.slot]
    texel_radiosity = texels[instance_in(batch, texels.shape[0])]
    normal = normals[batch, index]
    total = wp.vec3()
    part_coverage = wp.vec4()
    for q in range(directions.shape[0]):
        weight = wp.dot(normal, directions[q]) * transmittance[batch, index, q]
        if coverages:
            part_coverage = coverages[batch, index, q]
        cell = visible_cell(inputs.planes, normal, directions[q])
        if find_side_hits(inputs.planes, cell, texel_radiosity, weight, part_coverage, receiver, hits_of_cell) > 0:
            mean, _, total_coverage = mean_radiosity(receiver.side_count, hits_of_cell)
            total += (weight * wp.min(total_coverage, 1.0)) * mean
    light[batch, index] = light[batch, index] + (4.0 / float(directions.shape[0])) * total


@wp.kernel(enable_backward=False)
def _light_receivers_adjoint(
    first_row: int,
    worker: int,
    # in
    inputs: PlaneInputs,
    normals: wp.array2d(dtype=wp.vec3),
    transmittance: wp.array3d(dtype=wp.float32),
    coverages: wp.array3d(dtype=wp.vec4),
    texels: wp.array2d(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    adj_light: wp.array2d(dtype=wp.vec3),
    # scratch
    sides: wp.array2d(dtype=StoredSide),
    edges: wp.array2d(dtype=ViewedEdge),
    hits: wp.array2d(dtype=PlaneHit),
    adj_hits: wp.array2d(dtype=PlaneHit),
    # out
    adj_points: wp.array2d(dtype=wp.vec3),
    adj_normals: wp.array2d(dtype=wp.vec3),
    adj_transmittance: wp.array3d(dtype=wp.float32),
    adj_coverages: wp.array3d(dtype=wp.vec4),
    adj_front_weights: wp.array3d(dtype=wp.float32),
    adj_addend: wp.array2d(dtype=wp.vec3),
    # sums
    adj_frames: wp.array2d(dtype=wp.vec3),
    adj_texels: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a receiver."""
    receiver = prepare_receiver(first_row + wp.tid(), worker, inputs, sides, edges)
    batch, index = receiver.batch, receiver.index
    if adj_addend:
        adj_addend[batch, index] = adj_addend[batch, index] + adj_light[batch, index]
    hits_of_cell, adj_hits_of_cell = hits[receiver.slot], adj_hits[receiver.slot]
    texel_batch = instance_in(batch, texels.shape[0])
    texel_radiosity = texels[texel_batch]
    normal = normals[batch, index]
    adj_mean = (4.0 / float(directions.shape[0])) * adj_light[batch, index]
    adj_normal = wp.vec3()
    part_coverage = wp.vec4()
    for q in range(directions.shape[0]):
        direction = directions[q]
        cosine = wp.dot(normal, direction)
        cell_transmittance = transmittance[batch, index, q]
        weight = cosine * cell_transmittance
        cell = visible_cell(inputs.planes, normal, direction)
        if coverages:
            part_coverage = coverages[batch, index, q]
        hit_count = find_side_hits(inputs.planes, cell, texel_radiosity, cosine, part_coverage, receiver, hits_of_cell)
        if hit_count > 0:
            mean, weights, total_coverage = mean_radiosity(receiver.side_count, hits_of_cell)
            value = wp.dot(adj_mean, mean)
            total = wp.min(total_coverage, 1.0) * value
            factor = weight * wp.min(total_coverage, 1.0) / weights
            adj_coverage = wp.where(total_coverage < 1.0, weight * value, 0.0)
            for i in range(receiver.side_count):
                if is_hit(hits_of_cell, i):
                    hit = hits_of_cell[i]
                    adj_weight = factor * (wp.dot(adj_mean, hit.radiosity) - value)
                    adj_hit = PlaneHit()
                    adj_hit.coverage = adj_coverage + hit.open_share * adj_weight
                    adj_hit.open_share = hit.coverage * adj_weight
                    adj_hit.radiosity = (factor * hit.coverage * hit.open_share) * adj_mean
                    adj_hits_of_cell[i] = adj_hit
            adj_normal += (cell_transmittance * total) * direction
            if adj_transmittance:
                adj_transmittance[batch, index, q] = adj_transmittance[batch, index, q] + cosine * total
            if cell_transmittance > 0.0:
                adj_part_coverage = find_side_hits_adjoint(
                    inputs.planes,
                    cell,
                    texel_radiosity,
                    part_coverage,
                    hit_count,
                    receiver,
                    hits_of_cell,
                    adj_hits_of_cell,
                    texel_batch,
                    adj_texels,
                )
                if adj_coverages and part_coverage[0] > 0.0:
                    adj_coverages[batch, index, q] = adj_coverages[batch, index, q] + adj_part_coverage
    if adj_normals:
        adj_normals[batch, index] = adj_normals[batch, index] + adj_normal
    prepare_receiver_adjoint(receiver, inputs, adj_points, adj_front_weights, adj_frames)


def plane_light(
    points: wp.array,
    normals: wp.array,
    transmittance: wp.array,
    frames: wp.array,
    texels: wp.array,
    planes: PlaneBlockers,
    directions: np.ndarray,
    *,
    coverages: wp.array | None = None,
    front_weights: wp.array | None = None,
    self_plane: int | None = None,
    addend: wp.array | None = None,
) -> wp.array:
    """Light that planes send to receivers, added to other light.

    Args:
        points, normals: Receivers [scene units] and their unit normals, vec3 of shape [batch, receiver].
        transmittance: Past all else, without the planes, float32 of shape [batch, receiver, direction].
        frames: Where the planes are, vec3 of shape [batch, 3 · plane], from :meth:`PlaneBlockers.frames`.
        texels: Radiosity of the planes, vec3 of shape [batch, texel], from :func:`.plane_texels.find_texels`. A batch
            of 1 serves all instances here and above.
        directions: Unit vectors ω of the cells, NumPy of shape [direction, 3].
        coverages: Coverage (h, μ) of cells by bodies before all planes, which ``transmittance`` takes off, vec4 of
            shape [batch, receiver, direction]; None where it is not known.
        front_weights: Part of the front of each plane that receivers see, float32 of shape [batch, receiver,
            plane], from :func:`warpshadow.stages.planes.fronts.find_fronts`; by default their heights decide.
        self_plane: Number of the plane that the receivers are part of, which sends them nothing; None for none.
        addend: The other light, vec3 of shape [batch, receiver]; None for 0.
    Returns:
        Light that white receivers reflect of it, vec3 of shape [batch, receiver].
    Differentiable: points, normals, transmittance, frames, texels, coverages, front_weights, addend.
    """
    check_planes(planes, points, frames, directions, self_plane)
    check.shape("normals", normals.shape, ("batch", points.shape[1]))
    check.shape("transmittance", transmittance.shape, ("batch", points.shape[1], len(directions)))
    arguments = {"points": points, "normals": normals, "transmittance": transmittance, "coverages": coverages}
    arguments |= {"frames": frames, "texels": texels, "front_weights": front_weights, "addend": addend}
    batch_count = common_batch(arguments)
    addend = None if addend is None else expand(addend, batch_count)
    light = begin_sum(addend, (batch_count, points.shape[1]), points.device)
    if planes.count == (self_plane is not None):
        return light if addend is None else addend
    points, normals = (expand(array, batch_count) for array in (points, normals))
    transmittance = expand_rows(transmittance, batch_count)
    coverages, front_weights = (
        None if array is None else expand_rows(array, batch_count) for array in (coverages, front_weights)
    )
    arrays = plane_arrays(planes, cell_radius(len(directions)), self_plane)
    cell_directions = constant(directions, wp.vec3, points.device)
    planes_seen = plane_inputs(points, frames, front_weights, arrays)
    inputs = [planes_seen, normals, transmittance, coverages, texels, cell_directions]
    return launch_with_adjoint(
        _light_receivers,
        _light_receivers_adjoint,
        points.size,
        inputs=inputs,
        result=light,
        variables=[points, normals, transmittance, coverages, front_weights, addend],
        shared=[frames, texels],
        scratch=[*receiver_scratch(planes), hit_scratch(planes)],
        adj_scratch=[hit_scratch(planes)],
        cost=_CELL_COST * len(directions),
    )
