"""Transmittance towards the samples of a lobe, interpolated between the cells of directions around them.

    T(l) = Σ_q k_q min(T_q, H_q) / Σ_q k_q H_q,   k_q = max(l·ω_q − cos 2.2ρ, 0)² + ε,   H_q = s(n·ω_q / ρ),

over the cells near l, ρ their radius and s the smoothstep from 0 at −1 to 1 at 1: the part of a cell that is above the
receiver's horizon. Of a ball, T_q is H_q: it blocks nothing above its horizon.
"""

import numpy as np
import warp as wp

from warpshadow import check
from warpshadow.device.batch import common_batch, instance_in
from warpshadow.device.constants import constant
from warpshadow.device.launch import launch
from warpshadow.device.parallel import split_row
from warpshadow.maths.directions import cell_radius
from warpshadow.stages.cell_neighbors import KERNEL_RADIUS, cell_neighbors, texel_of

_COST = 60.0  # nanoseconds that a sample takes

_NEGLIGIBLE = 1.0e-7

wp.set_module_options({"max_unroll": 1})


@wp.kernel
def _sum_near(
    first_row: int,
    worker: int,
    # in
    transmittance: wp.array3d(dtype=wp.float32),
    normals: wp.array2d(dtype=wp.vec3),
    directions: wp.array3d(dtype=wp.vec3),
    cells: wp.array(dtype=wp.vec3),
    neighbors: wp.array2d(dtype=wp.int32),
    reach_cosine: float,
    per_radius: float,
    # out
    weighted_sums: wp.array3d(dtype=wp.vec2),
):
    """A thread owns a receiver: the sums of k min(T, H) and of k H."""
    batch, receiver = split_row(first_row + wp.tid(), weighted_sums.shape[1])
    direction_batch = instance_in(batch, directions.shape[0])
    normal = normals[instance_in(batch, normals.shape[0]), receiver]
    row = transmittance[instance_in(batch, transmittance.shape[0])]
    for i in range(weighted_sums.shape[2]):
        direction = directions[direction_batch, receiver, i]
        texel = texel_of(direction)
        weighted_sum = wp.vec2()
        for k in range(neighbors.shape[1]):
            cell = neighbors[texel, k]
            kernel_weight = wp.max(wp.dot(direction, cells[cell]) - reach_cosine, 0.0)
            weight = kernel_weight * kernel_weight + _NEGLIGIBLE
            horizon_weight = wp.smoothstep(-1.0, 1.0, per_radius * wp.dot(normal, cells[cell])) + _NEGLIGIBLE
            weighted_sum += weight * wp.vec2(wp.min(row[receiver, cell], horizon_weight), horizon_weight)
        weighted_sums[batch, receiver, i] = weighted_sum


@wp.kernel
def _divide(
    # in
    weighted_sums: wp.array3d(dtype=wp.vec2),
    # out
    means: wp.array3d(dtype=wp.float32),
):
    """A thread owns a sample."""
    batch, receiver, i = wp.tid()
    means[batch, receiver, i] = weighted_sums[batch, receiver, i][0] / weighted_sums[batch, receiver, i][1]


def transmittance_of_directions(
    transmittance: wp.array, normals: wp.array, directions: wp.array, cells: np.ndarray
) -> wp.array:
    """Interpolate transmittance towards the samples of lobes.

    Args:
        transmittance: Towards cells, float32 of shape [batch, receiver, cell].
        normals: Unit normals, vec3 of shape [batch, receiver].
        directions: Of :func:`.lobes.sample_lobes`, vec3 of shape [batch, receiver, sample].
        cells: Unit vectors, NumPy of shape [cell, 3].

    Returns:
        Float32 of shape [batch, receiver, sample].

    Differentiable: transmittance, normals, directions.
    """
    check.shape("transmittance", transmittance.shape, ("batch", directions.shape[1], len(cells)))
    arrays = {"transmittance": transmittance, "directions": directions, "normals": normals}
    count, device = common_batch(arrays), directions.device
    radius = float(cell_radius(len(cells)))
    cos_radius = float(np.cos(KERNEL_RADIUS * radius))
    weighted_sums = wp.empty((count, *directions.shape[1:]), dtype=wp.vec2, device=device)
    cell_directions, neighbors = constant(cells, wp.vec3, device), cell_neighbors(cells, device)
    launch(
        _sum_near,
        count * directions.shape[1],
        inputs=[transmittance, normals, directions, cell_directions, neighbors, cos_radius, 1 / radius],
        outputs=[weighted_sums],
        shared=[transmittance, normals, directions],
        cost=_COST * directions.shape[2],
    )
    means = wp.empty(weighted_sums.shape, dtype=wp.float32, device=device)
    launch(_divide, means.shape, inputs=[weighted_sums], outputs=[means])
    return means
