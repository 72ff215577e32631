"""Lookups: which rays or cells of a body, turned by R, lie under each cell of directions of the world.

World direction ω is direction d = Rᵀω / |Rᵀω| of the body. It reads the rays or coarse cells within an angle h of d:

    T_self = Σ_k w_k S_k,  w_k ∝ x_k²,  x_k = max(0, (c_k·d − cos h) / (1 − cos h)),  Σ w_k = 1,

c_k the directions of rays or coarse cells, and S_k whether they are open. The weights are C¹ in R.

h follows the light, whose mean squared angle it matches: of the weights, h²/4, and the table's cells, ρ²/2, with the
radius ρ = 2/√C of one of C cells, to that of an evenly bright cap of half-angle s, s²/2:

    h²/4 + ρ²/2 = s²/2,  so  h² = 2 (s² − ρ²),  and h ≥ 2.2 ρ, so that something is always near.

A cell with a sun looks at few rays, an even one at some 6 coarse cells.
"""

from typing import NamedTuple

import numpy as np
import warp as wp

from warpshadow.device.constants import cached_by_values, constant, note_use
from warpshadow.device.launch import differentiable, launch
from warpshadow.device.memory import empty
from warpshadow.device.parallel import split_row
from warpshadow.maths.directions import cell_radius, fibonacci
from warpshadow.stages.self_visibility.trace import RAYS_PER_CELL

_MIN_KERNEL_RADIUS = 2.2  # least h, in radii of the coarse cells
_MAX_RAYS, _MAX_RAYS_OF_FINE_CELLS = 32, 16
"""Rays that a cell looks up on average at most, of up to 128 cells and of more; a wider one looks up coarse cells."""
_CELL_COST = 1600.0  # nanoseconds that a cell takes


@wp.struct
class ResamplingKernels:
    """Resampling kernels of the cells of directions."""

    directions: wp.array(dtype=wp.vec3)  # ω [direction]
    cos_radii: wp.array(dtype=wp.float32)  # cos h [direction]
    cos_outer_radii: wp.array(dtype=wp.float32)  # cosine that axes of coarse cells exceed if they may be sampled
    uses_rays: wp.array(dtype=wp.int32)  # 1, or 0 for coarse cells [direction]
    rays: wp.array(dtype=wp.vec3)  # directions of rays, and of coarse cells, in the body's frame
    cells: wp.array(dtype=wp.vec3)
    max_lookups: int  # of a cell


@cached_by_values
def find_resampling_kernels(
    directions: np.ndarray, half_angles: np.ndarray | None, ray_count: int, device: wp.Device
) -> ResamplingKernels:
    """Find the resampling kernels of cells.

    Args:
        directions: Unit vectors ω [direction, 3].
        half_angles: Half-angles s of where their light comes from [radians], [direction]; None for even cells.
        ray_count: Rays of a probe.
    """
    count, cell_count = len(directions), ray_count // RAYS_PER_CELL
    half_angles = (
        np.full(count, cell_radius(count)) if half_angles is None else np.minimum(half_angles, cell_radius(count))
    )
    ray_radii, cell_radii = (
        np.maximum(np.sqrt(2 * np.maximum(half_angles**2 - radius**2, 0)), _MIN_KERNEL_RADIUS * radius)
        for radius in map(cell_radius, (ray_count, cell_count))
    )
    uses_rays = ray_count * (1 - np.cos(ray_radii)) / 2 <= (_MAX_RAYS if count <= 128 else _MAX_RAYS_OF_FINE_CELLS)
    radii = np.where(uses_rays, ray_radii, cell_radii)
    cos_radii = np.cos(radii)
    counts = np.where(uses_rays, ray_count, cell_count) * (1 - cos_radii) / 2
    rays = fibonacci(ray_count)
    cells = rays.reshape(cell_count, RAYS_PER_CELL, 3).sum(axis=1)
    cells /= np.linalg.norm(cells, axis=1, keepdims=True)
    half_width = np.arccos(np.einsum("crx,cx->cr", rays.reshape(cell_count, RAYS_PER_CELL, 3), cells).min())
    outer_radii = np.minimum(radii + np.where(uses_rays, half_width + 1e-3, 0), np.pi)
    kernels = ResamplingKernels()
    kernels.directions = constant(np.asarray(directions), wp.vec3, device)
    kernels.cos_radii = constant(cos_radii, wp.float32, device)
    kernels.cos_outer_radii = constant(np.cos(outer_radii), wp.float32, device)
    kernels.uses_rays = constant(uses_rays.astype(np.int32), wp.int32, device)
    kernels.rays, kernels.cells = constant(rays, wp.vec3, device), constant(cells, wp.vec3, device)
    kernels.max_lookups = int(1.4 * counts.max() + 8)
    return kernels


class ResamplingWeights(NamedTuple):
    """Resampling weights of each cell of directions under the rotations of some bodies."""

    counts: wp.array  # number of lookups, int32 of shape [batch, body, direction]
    indices: wp.array  # rays or coarse cells, int32 of shape [batch, body, direction, lookup]
    weights: wp.array  # their weights, float32 of shape [batch, body, direction, lookup]; 0 after the last


class BodyKernels(NamedTuple):
    """Resampling kernels of the cells of several bodies, which have their own numbers of rays."""

    kernels: tuple[ResamplingKernels, ...]  # of each body
    bodies: wp.array  # numbers of the bodies, int32
    table: wp.array  # of the kernels, [body]


@cached_by_values
def find_body_kernels(
    bodies: tuple[int, ...],
    ray_counts: tuple[int, ...],
    directions: np.ndarray,
    half_angles: np.ndarray | None,
    device: wp.Device,
) -> BodyKernels:
    """Find the resampling kernels of bodies.

    Args:
        bodies, ray_counts: Their numbers, and the rays of a probe of each.
        directions, half_angles: As for :func:`find_resampling_kernels`.
    """
    kernels = tuple(find_resampling_kernels(directions, half_angles, count, device) for count in ray_counts)
    table = wp.array(list(kernels), dtype=ResamplingKernels, device=device)
    note_use(table)
    return BodyKernels(kernels, constant(np.array(bodies), wp.int32, device), table)


@wp.func
def _load_kernel(kernels: ResamplingKernels, rotation: wp.mat33, direction: int):
    """Load d·|Rᵀω|, d, cos h and the directions that the kernel of a cell samples."""
    rotated_direction = wp.transpose(rotation) * kernels.directions[direction]
    candidates = kernels.cells
    if kernels.uses_rays[direction] == 1:
        candidates = kernels.rays
    return rotated_direction, wp.normalize(rotated_direction), kernels.cos_radii[direction], candidates


@wp.func
def _profile(cosine: float, cos_radius: float):
    """Profile x_k of a resampling kernel."""
    return wp.max(0.0, (cosine - cos_radius) / (1.0 - cos_radius))


@wp.kernel(enable_backward=False)
def _find_weights(
    first_row: int,
    worker: int,
    # in
    rotations: wp.array2d(dtype=wp.mat33),
    bodies: wp.array(dtype=wp.int32),
    table: wp.array(dtype=ResamplingKernels),
    # out
    all_counts: wp.array3d(dtype=wp.int32),
    all_indices: wp.array4d(dtype=wp.int32),
    all_weights: wp.array4d(dtype=wp.float32),
):
    """A thread owns a cell of directions of a body of an instance."""
    item, direction = split_row(first_row + wp.tid(), all_counts.shape[2])
    batch, body = split_row(item, all_counts.shape[1])
    kernels = table[body]
    indices, weights = all_indices[batch, body, direction], all_weights[batch, body, direction]
    rotation = rotations[batch, bodies[body]]
    _rotated_direction, kernel_axis, cos_radius, candidates = _load_kernel(kernels, rotation, direction)
    count = int(0)
    weight_sum = float(0.0)
    width = candidates.shape[0] // kernels.cells.shape[0]
    for cell in range(kernels.cells.shape[0]):
        if wp.dot(kernels.cells[cell], kernel_axis) > kernels.cos_outer_radii[direction]:
            for candidate in range(width * cell, width * cell + width):
                profile = _profile(wp.dot(candidates[candidate], kernel_axis), cos_radius)
                if profile > 0.0 and count < weights.shape[0]:
                    indices[count] = candidate
                    weights[count] = profile * profile
                    weight_sum += profile * profile
                    count += 1
    all_counts[batch, body, direction] = count
    for k in range(weights.shape[0]):
        if k < count:
            weights[k] = weights[k] / weight_sum
        else:
            indices[k] = 0
            weights[k] = 0.0


@wp.kernel(enable_backward=False)
def _find_weights_adjoint(
    # in
    rotations: wp.array2d(dtype=wp.mat33),
    bodies: wp.array(dtype=wp.int32),
    table: wp.array(dtype=ResamplingKernels),
    all_counts: wp.array3d(dtype=wp.int32),
    all_indices: wp.array4d(dtype=wp.int32),
    all_weights: wp.array4d(dtype=wp.float32),
    all_adj_weights: wp.array4d(dtype=wp.float32),
    # out
    adj_rotations: wp.array2d(dtype=wp.mat33),
):
    """A thread owns a cell of directions of a body of an instance.

    With v = Rᵀω and S = Σ x²:  x̄_k = 2 x_k (w̄_k − Σ w̄ w) / S,  d̄ = Σ x̄_k c_k / (1 − cos h),
    v̄ = (d̄ − d d·d̄) / |v|,  R̄ += ω v̄ᵀ
    """
    batch, body, direction = wp.tid()
    kernels = table[body]
    count, indices = all_counts[batch, body, direction], all_indices[batch, body, direction]
    weights, adj_weights = all_weights[batch, body, direction], all_adj_weights[batch, body, direction]
    rotation = rotations[batch, bodies[body]]
    rotated_direction, kernel_axis, cos_radius, candidates = _load_kernel(kernels, rotation, direction)
    weight_sum = float(0.0)
    adj_weight_mean = float(0.0)
    for k in range(count):
        profile = _profile(wp.dot(candidates[indices[k]], kernel_axis), cos_radius)
        weight_sum += profile * profile
        adj_weight_mean += adj_weights[k] * weights[k]
    adj_axis = wp.vec3()
    for k in range(count):
        candidate = candidates[indices[k]]
        profile = _profile(wp.dot(candidate, kernel_axis), cos_radius)
        adj_axis += 2.0 * profile * (adj_weights[k] - adj_weight_mean) / weight_sum / (1.0 - cos_radius) * candidate
    adj_rotated = (adj_axis - wp.dot(adj_axis, kernel_axis) * kernel_axis) / wp.length(rotated_direction)
    wp.atomic_add(adj_rotations, batch, bodies[body], wp.outer(kernels.directions[direction], adj_rotated))


def find_resampling_weights(rotations: wp.array, body_kernels: BodyKernels) -> ResamplingWeights:
    """Find the resampling weights of cells of directions.

    Args:
        rotations: R of all bodies of the scene, mat33 of shape [batch, body].
        body_kernels: Of some of them, whose weights these are.
    Differentiable: rotations.
    """
    kernels, bodies, table = body_kernels
    shape, device = (len(rotations), len(kernels), kernels[0].directions.size), rotations.device
    lookups = *shape, max(of_body.max_lookups for of_body in kernels)
    counts = empty(shape, dtype=wp.int32, device=device)
    indices = empty(lookups, dtype=wp.int32, device=device)
    inputs = [rotations, bodies, table]
    weights = differentiable(
        lambda weights: launch(
            _find_weights, counts.size, inputs=inputs, outputs=[counts, indices, weights], cost=_CELL_COST
        ),
        lambda adj_weights: launch(
            _find_weights_adjoint,
            shape,
            inputs=[*inputs, counts, indices, weights, adj_weights],
            outputs=[rotations.grad],
        ),
        result=empty(lookups, dtype=wp.float32, device=device),
        variables=[rotations],
    )
    return ResamplingWeights(counts, indices, weights)
