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

from warpshadow.device.constants import cached_by_values, constant
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
    """Resampling weights of each cell of directions under a rotation."""

    counts: wp.array  # number of lookups, int32 of shape [batch, direction]
    indices: wp.array  # rays or coarse cells, int32 of shape [batch, direction, lookup]
    weights: wp.array  # their weights, float32 of shape [batch, direction, lookup]; 0 after the last


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
    """The kernel's profile x_k."""
    return wp.max(0.0, (cosine - cos_radius) / (1.0 - cos_radius))


@wp.kernel(enable_backward=False)
def _find_weights(
    first_row: int,
    worker: int,
    # in
    rotations: wp.array2d(dtype=wp.mat33),
    body: int,
    kernels: ResamplingKernels,
    # out
    counts: wp.array2d(dtype=wp.int32),
    indices: wp.array3d(dtype=wp.int32),
    weights: wp.array3d(dtype=wp.float32),
):
    """A thread owns a cell of directions of an instance."""
    batch, direction = split_row(first_row + wp.tid(), kernels.directions.shape[0])
    _rotated_direction, kernel_axis, cos_radius, candidates = _load_kernel(kernels, rotations[batch, body], direction)
    count = int(0)
    weight_sum = float(0.0)
    width = candidates.shape[0] // kernels.cells.shape[0]
    for cell in range(kernels.cells.shape[0]):
        if wp.dot(kernels.cells[cell], kernel_axis) > kernels.cos_outer_radii[direction]:
            for candidate in range(width * cell, width * cell + width):
                profile = _profile(wp.dot(candidates[candidate], kernel_axis), cos_radius)
                if profile > 0.0 and count < weights.shape[2]:
                    indices[batch, direction, count] = candidate
                    weights[batch, direction, count] = profile * profile
                    weight_sum += profile * profile
                    count += 1
    counts[batch, direction] = count
    for k in range(weights.shape[2]):
        if k < count:
            weights[batch, direction, k] = weights[batch, direction, k] / weight_sum
        else:
            indices[batch, direction, k] = 0
            weights[batch, direction, k] = 0.0


@wp.kernel(enable_backward=False)
def _find_weights_adjoint(
    # in
    rotations: wp.array2d(dtype=wp.mat33),
    body: int,
    kernels: ResamplingKernels,
    counts: wp.array2d(dtype=wp.int32),
    indices: wp.array3d(dtype=wp.int32),
    weights: wp.array3d(dtype=wp.float32),
    adj_weights: wp.array3d(dtype=wp.float32),
    # out
    adj_rotations: wp.array2d(dtype=wp.mat33),
):
    """A thread owns a cell of directions of an instance.

    With v = Rᵀω and S = Σ x²:  x̄_k = 2 x_k (w̄_k − Σ w̄ w) / S,  d̄ = Σ x̄_k c_k / (1 − cos h),
    v̄ = (d̄ − d d·d̄) / |v|,  R̄ += ω v̄ᵀ
    """
    batch, direction = wp.tid()
    rotated_direction, kernel_axis, cos_radius, candidates = _load_kernel(kernels, rotations[batch, body], direction)
    weight_sum = float(0.0)
    adj_weight_mean = float(0.0)
    for k in range(counts[batch, direction]):
        profile = _profile(wp.dot(candidates[indices[batch, direction, k]], kernel_axis), cos_radius)
        weight_sum += profile * profile
        adj_weight_mean += adj_weights[batch, direction, k] * weights[batch, direction, k]
    adj_axis = wp.vec3()
    for k in range(counts[batch, direction]):
        candidate = candidates[indices[batch, direction, k]]
        profile = _profile(wp.dot(candidate, kernel_axis), cos_radius)
        adj_axis += (
            2.0
            * profile
            * (adj_weights[batch, direction, k] - adj_weight_mean)
            / weight_sum
            / (1.0 - cos_radius)
            * candidate
        )
    adj_rotated = (adj_axis - wp.dot(adj_axis, kernel_axis) * kernel_axis) / wp.length(rotated_direction)
    wp.atomic_add(adj_rotations, batch, body, wp.outer(kernels.directions[direction], adj_rotated))


def find_resampling_weights(rotations: wp.array, body: int, kernels: ResamplingKernels) -> ResamplingWeights:
    """Find the resampling weights of cells of directions.

    Args:
        rotations: R of each body, mat33 of shape [batch, body].
    Differentiable: rotations.
    """
    shape = len(rotations), kernels.directions.size
    device = rotations.device
    counts = empty(shape, dtype=wp.int32, device=device)
    indices = empty((*shape, kernels.max_lookups), dtype=wp.int32, device=device)
    inputs = [rotations, body, kernels]
    weights = differentiable(
        lambda weights: launch(
            _find_weights, shape[0] * shape[1], inputs=inputs, outputs=[counts, indices, weights], cost=_CELL_COST
        ),
        lambda adj_weights: launch(
            _find_weights_adjoint,
            shape,
            inputs=[*inputs, counts, indices, weights, adj_weights],
            outputs=[rotations.grad],
        ),
        result=empty((*shape, kernels.max_lookups), dtype=wp.float32, device=device),
        variables=[rotations],
    )
    return ResamplingWeights(counts, indices, weights)
