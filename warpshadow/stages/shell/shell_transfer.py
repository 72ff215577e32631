"""Transfer vectors to light from a shell: a sum over patches of it, with transmittance from the receivers' cells.

    E(x) = Σ_k L_k T(ω_k) g_k,   g_k = A max(n·b_k, 0) max(d_k·b_k, 0) / (|b_k|² √(π² |b_k|⁴ + A²)),
    b_k = c + R d_k − x

d_k is the direction from the center c to patch k, A = 4π R² / K the area of each of the K patches, ω_k = b_k / |b_k|.
E is over π. The root is π |b|² but for receivers closer to the shell than patches are to each other, as in
:mod:`warpshadow.stages.emitters.light`. T is interpolated between cells of directions as for lobes
(:mod:`warpshadow.stages.gloss.transmittance`), by a narrower kernel:

    T(ω) = Σ_q k_q min(T_q, H_q) / Σ_q k_q H_q,   k_q = max(ω·ω_q − cos hρ, 0)² + ε,   H_q = s(n·ω_q / ρ)

with the kernel's radius h = 1.6. All bodies are within the shell, so that all of them that lie in a direction block its
light: their transmittance depends on the direction alone.
"""

import numpy as np
import warp as wp

from warpshadow import check
from warpshadow.device.batch import common_batch, expand, expand_rows, instance_in
from warpshadow.device.constants import constant
from warpshadow.device.launch import differentiable, launch
from warpshadow.device.memory import empty
from warpshadow.device.parallel import split_row
from warpshadow.maths.directions import cell_radius, check_count
from warpshadow.stages.cell_neighbors import cell_neighbors, texel_of
from warpshadow.stages.shell.shell_rays import center_of

SHELL_KERNEL_RADIUS = 1.6
"""Distance of a cell from which it no longer counts, in cell radii: 3 to 6 cells count. The least that reaches one cell
in each direction is 1.1."""

_COST = 30.0  # nanoseconds that a patch takes, of which half are below the horizon

_NEGLIGIBLE = 1.0e-7

wp.set_module_options({"max_unroll": 1})


@wp.struct
class CellLookup:
    """Table by which cells near a direction are looked up."""

    cells: wp.array(dtype=wp.vec3)  # unit vectors
    neighbors: wp.array2d(dtype=wp.int32)  # of each texel of an octahedron
    reach_cosine: float  # of the kernel's radius
    per_radius: float  # one over the radius of a cell


@wp.func
def _form_factor(beam: wp.vec3, normal: wp.vec3, patch_direction: wp.vec3, area: float):
    """The factor g of a patch that faces the receiver, above its horizon."""
    distance2 = wp.length_sq(beam)
    denominator = distance2 * wp.sqrt(wp.pi * wp.pi * distance2 * distance2 + area * area)
    return area * wp.dot(normal, beam) * wp.dot(patch_direction, beam) / denominator


@wp.func
def _sum_cells(
    lookup: CellLookup, transmittance: wp.array(dtype=wp.float32), normal: wp.vec3, direction: wp.vec3, texel: int
):
    """The sums of k min(T, H) and of k H over the cells near a direction."""
    open_sum = float(0.0)
    weight_sum = float(0.0)
    for i in range(lookup.neighbors.shape[1]):
        cell = lookup.neighbors[texel, i]
        kernel = wp.max(wp.dot(direction, lookup.cells[cell]) - lookup.reach_cosine, 0.0)
        weight = kernel * kernel + _NEGLIGIBLE
        horizon_weight = wp.smoothstep(-1.0, 1.0, lookup.per_radius * wp.dot(normal, lookup.cells[cell])) + _NEGLIGIBLE
        open_sum += weight * wp.min(transmittance[cell], horizon_weight)
        weight_sum += weight * horizon_weight
    return open_sum, weight_sum


@wp.kernel(enable_backward=False)
def _find_transfer(
    first_row: int,
    worker: int,
    # in
    points: wp.array2d(dtype=wp.vec3),
    normals: wp.array2d(dtype=wp.vec3),
    transmittance: wp.array3d(dtype=wp.float32),
    shell: wp.array(dtype=wp.vec4),
    patches: wp.array(dtype=wp.vec3),
    lookup: CellLookup,
    # out
    transfer: wp.array3d(dtype=wp.float32),
):
    """A thread owns a receiver."""
    batch, receiver = split_row(first_row + wp.tid(), transfer.shape[1])
    instance_shell = shell[instance_in(batch, shell.shape[0])]
    point = points[batch, receiver]
    normal = normals[batch, receiver]
    offset = center_of(instance_shell) - point
    area = 4.0 * wp.pi / float(patches.shape[0]) * instance_shell[3] * instance_shell[3]
    for k in range(patches.shape[0]):
        patch_direction = patches[k]
        beam = offset + instance_shell[3] * patch_direction
        value = float(0.0)
        if wp.dot(normal, beam) > 0.0 and wp.dot(patch_direction, beam) > 0.0:
            value = _form_factor(beam, normal, patch_direction, area)
            if transmittance:
                direction = wp.normalize(beam)
                cells = transmittance[batch, receiver]
                open_sum, weight_sum = _sum_cells(lookup, cells, normal, direction, texel_of(direction))
                value *= open_sum / weight_sum
        transfer[batch, receiver, k] = value


@wp.kernel(enable_backward=False)
def _find_transfer_adjoint(
    first_row: int,
    worker: int,
    # in
    points: wp.array2d(dtype=wp.vec3),
    normals: wp.array2d(dtype=wp.vec3),
    transmittance: wp.array3d(dtype=wp.float32),
    shell: wp.array(dtype=wp.vec4),
    patches: wp.array(dtype=wp.vec3),
    lookup: CellLookup,
    adj_transfer: wp.array3d(dtype=wp.float32),
    # out
    adj_points: wp.array2d(dtype=wp.vec3),
    adj_normals: wp.array2d(dtype=wp.vec3),
    adj_transmittance: wp.array3d(dtype=wp.float32),
    # sums
    adj_shell: wp.array(dtype=wp.vec4),
):
    """A thread owns a receiver.

    With T = P / W of the sums above and |b|² = D, r = π² D² + A²:

        P̄ = g t̄ / W,   W̄ = −P̄ T,   T̄_q = P̄ k_q where T_q < H_q,   H̄_q = W̄ k_q (+ P̄ k_q elsewhere),
        ω̄ = Σ 2 max(ω·ω_q − …, 0) (P̄ min(T_q, H_q) + W̄ H_q) ω_q,   n̄ = Σ H̄_q s' ω_q / ρ + ḡ g b / (n·b),
        b̄ = ḡ g (n / (n·b) + d / (d·b) − 2 (1/D + π² D / r) b) + (ω̄ − ω (ω·ω̄)) / |b|,   x̄ = −Σ b̄,   c̄ = Σ b̄,
        R̄ = Σ d·b̄ + 2 ḡ g (1 − A² / r) / R
    """
    batch, receiver = split_row(first_row + wp.tid(), adj_transfer.shape[1])
    shell_batch = instance_in(batch, shell.shape[0])
    instance_shell = shell[shell_batch]
    point = points[batch, receiver]
    normal = normals[batch, receiver]
    offset = center_of(instance_shell) - point
    radius = instance_shell[3]
    area = 4.0 * wp.pi / float(patches.shape[0]) * radius * radius
    adj_normal = wp.vec3()
    adj_center = wp.vec3()
    adj_radius = float(0.0)
    for k in range(patches.shape[0]):
        patch_direction = patches[k]
        beam = offset + radius * patch_direction
        adj = adj_transfer[batch, receiver, k]
        if adj != 0.0 and wp.dot(normal, beam) > 0.0 and wp.dot(patch_direction, beam) > 0.0:
            factor = _form_factor(beam, normal, patch_direction, area)
            distance2 = wp.length_sq(beam)
            adj_beam = wp.vec3()
            mean = float(1.0)
            if transmittance:
                distance = wp.sqrt(distance2)
                direction = beam / distance
                texel = texel_of(direction)
                open_sum, weight_sum = _sum_cells(lookup, transmittance[batch, receiver], normal, direction, texel)
                mean = open_sum / weight_sum
                adj_open_sum = factor * adj / weight_sum
                adj_weight_sum = -adj_open_sum * mean
                adj_direction = wp.vec3()
                for i in range(lookup.neighbors.shape[1]):
                    cell = lookup.neighbors[texel, i]
                    cell_direction = lookup.cells[cell]
                    kernel = wp.max(wp.dot(direction, cell_direction) - lookup.reach_cosine, 0.0)
                    weight = kernel * kernel + _NEGLIGIBLE
                    height = lookup.per_radius * wp.dot(normal, cell_direction)
                    horizon_weight = wp.smoothstep(-1.0, 1.0, height) + _NEGLIGIBLE
                    cell_transmittance = transmittance[batch, receiver, cell]
                    adj_weight = (
                        adj_open_sum * wp.min(cell_transmittance, horizon_weight) + adj_weight_sum * horizon_weight
                    )
                    adj_direction += 2.0 * kernel * adj_weight * cell_direction
                    adj_horizon_weight = adj_weight_sum * weight
                    if cell_transmittance < horizon_weight:
                        if adj_transmittance:
                            adj_transmittance[batch, receiver, cell] = (
                                adj_transmittance[batch, receiver, cell] + adj_open_sum * weight
                            )
                    else:
                        adj_horizon_weight += adj_open_sum * weight
                    if height > -1.0 and height < 1.0:
                        slope = 0.75 * (1.0 - height * height)  # of the smoothstep from −1 to 1
                        adj_normal += adj_horizon_weight * slope * lookup.per_radius * cell_direction
                adj_beam += (adj_direction - wp.dot(direction, adj_direction) * direction) / distance
            product = adj * mean * factor
            square = wp.pi * wp.pi * distance2 * distance2
            adj_normal += product / wp.dot(normal, beam) * beam
            adj_beam += (
                product / wp.dot(normal, beam) * normal + product / wp.dot(patch_direction, beam) * patch_direction
            )
            adj_beam -= 2.0 * product / distance2 * (1.0 + square / (square + area * area)) * beam
            adj_center += adj_beam
            adj_radius += wp.dot(patch_direction, adj_beam) + 2.0 * product / radius * square / (square + area * area)
    if adj_points:
        adj_points[batch, receiver] = adj_points[batch, receiver] - adj_center
    if adj_normals:
        adj_normals[batch, receiver] = adj_normals[batch, receiver] + adj_normal
    if adj_shell:
        adj_shell[shell_batch] = adj_shell[shell_batch] + wp.vec4(
            adj_center[0], adj_center[1], adj_center[2], adj_radius
        )


def shell_transfer(
    points: wp.array,
    normals: wp.array,
    transmittance: wp.array | None,
    cells: np.ndarray,
    shell: wp.array,
    patches: np.ndarray,
) -> wp.array:
    """Transfer vectors to the patches of a shell, g_k T(ω_k).

    Args:
        points: Receivers within the shell [scene units], vec3 of shape [batch, receiver].
        normals: Their unit normals, vec3 of shape [batch, receiver].
        transmittance: Towards cells, float32 of shape [batch, receiver, cell]; None where nothing blocks.
        cells: Unit vectors, NumPy of shape [cell, 3].
        shell: Center and radius [scene units], vec4 of shape [batch].
        patches: Directions from the center to the light of the patches, each of 1/K of the area, NumPy of shape
            [patch, 3].
            Any batch may be 1.
    Returns:
        Float32 of shape [batch, receiver, patch].
    Differentiable: points, normals, transmittance, shell. Not: cells, patches.
    """
    check_count("patches", len(patches))
    check.shape("normals", normals.shape, ("batch", points.shape[1]))
    check.shape("shell", shell.shape, ("batch",))
    arrays = {"points": points, "normals": normals, "transmittance": transmittance, "shell": shell}
    count, device = common_batch(arrays), points.device
    points, normals = expand(points, count), expand(normals, count)
    lookup = CellLookup()
    if transmittance is not None:
        check.shape("transmittance", transmittance.shape, ("batch", points.shape[1], len(cells)))
        transmittance = expand_rows(transmittance, count)
        lookup.cells = constant(cells, wp.vec3, device)
        lookup.neighbors = cell_neighbors(cells, device, SHELL_KERNEL_RADIUS)
        lookup.reach_cosine = float(np.cos(SHELL_KERNEL_RADIUS * cell_radius(len(cells))))
        lookup.per_radius = 1 / float(cell_radius(len(cells)))
    variables = [points, normals, transmittance, shell]
    inputs = [*variables, constant(patches, wp.vec3, device), lookup]
    rows, cost = count * points.shape[1], _COST * len(patches)

    def adjoint(adj_transfer: wp.array) -> None:
        *outputs, adj_shell = (None if item is None else item.grad for item in variables)
        launch(
            _find_transfer_adjoint,
            rows,
            inputs=[*inputs, adj_transfer],
            outputs=outputs,
            sums=[adj_shell],
            cost=3 * cost,
        )

    return differentiable(
        lambda transfer: launch(_find_transfer, rows, inputs=inputs, outputs=[transfer], cost=cost),
        adjoint,
        result=empty((count, points.shape[1], len(patches)), dtype=wp.float32, device=device),
        variables=variables,
    )
