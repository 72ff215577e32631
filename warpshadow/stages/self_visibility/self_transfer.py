"""Self-transfer: transfer vectors of probes past their own body, in SH, computed once in the body's frame.

    L_k = 1/π ∫ S(ω) max(n·ω, 0) y_k(ω) dω

S the visibility that rays found (:mod:`.trace`). A rotation R of the body turns harmonics band by band, so receivers
have

    K = D(R) Σ_j b_j L[row_j]

over the three rows of a receiver with their weights b (:mod:`.probes`): no direction is looked up again. K is smooth in
R; if R turns on by a small angle δ, K changes by Σ_a δ_a G_a K, G the generators of rotations.
"""

import functools
from typing import NamedTuple

import numpy as np
import warp as wp

from warpshadow.device.batch import common_batch, expand, instance_in
from warpshadow.device.constants import constant
from warpshadow.device.lanes import lane_type, vectors_type
from warpshadow.device.launch import differentiable, launch
from warpshadow.device.memory import empty, zeros
from warpshadow.device.parallel import split_row
from warpshadow.maths import sh
from warpshadow.maths.directions import fibonacci
from warpshadow.stages.self_visibility.probes import ProbeWeights
from warpshadow.stages.self_visibility.trace import VisibilityRows
from warpshadow.stages.sh_kernels import make_add_rotated_zonal, zonal_type

_ROTATION_COST = 0.5  # nanoseconds that an entry of D takes for a receiver
_ROWS_PER_CHUNK = 1 << 9  # rows that are projected at once


def project_rows(rows: VisibilityRows, normals: np.ndarray, order: int) -> wp.array:
    """Find the self-transfer of probes: the clamped cosine of open probes, minus the light of blocked rays.

    Args:
        rows: Visibility of the probes past their body.
        normals: Their unit normals in the frame of the body [row, 3]; a zero normal has none.
    Returns:
        L, float32 of shape [row, order²]. Not differentiable.
    """
    normals = np.asarray(normals, np.float64)
    rays, bits = fibonacci(rows.ray_count), rows.bits.numpy()
    ray_light = (4 / len(rays) * sh.evaluate(order, rays)).astype(np.float32)
    band = sh.band_of(order)
    zonal = (sh.clamped_cosine(order) / np.pi * np.sqrt(4 * np.pi / (2 * np.arange(order) + 1)))[band]
    probe_transfer = (zonal * sh.evaluate(order, normals)).astype(np.float32)
    probe_transfer[~normals.any(axis=1)] = 0
    for start in range(0, len(normals), _ROWS_PER_CHUNK):
        row_slice = slice(start, start + _ROWS_PER_CHUNK)
        is_open = bits[row_slice, :, None] >> np.arange(32, dtype=np.uint32) & 1
        cosines = np.maximum(normals[row_slice].astype(np.float32) @ rays.T.astype(np.float32), 0)
        probe_transfer[row_slice] -= np.where(is_open.reshape(cosines.shape), 0, cosines) @ ray_light
    return wp.array(probe_transfer, dtype=wp.float32, device=rows.bits.device)


@functools.cache
def _make_evaluate_rotated(order: int) -> wp.Kernel:
    Lane, Vectors, Zonal = lane_type(1), vectors_type(1), zonal_type(order, 1)
    add_rotated_zonal = make_add_rotated_zonal(order, 1)
    UNIT = wp.types.vector(length=order, dtype=wp.float32)(*np.sqrt((2 * np.arange(order) + 1) / (4 * np.pi)))

    @wp.kernel(module="unique", enable_backward=False)
    def evaluate_rotated(
        # in
        rotations: wp.array2d(dtype=wp.mat33),
        body: int,
        directions: wp.array(dtype=wp.vec3),
        # out
        basis: wp.array3d(dtype=Lane),
    ):
        """A thread owns a direction ω:  y(Rᵀω)."""
        batch, q = wp.tid()
        local_direction = wp.normalize(wp.transpose(rotations[batch, body]) * directions[q])
        zonal = Zonal()
        for band in range(order):
            zonal[band] = Lane(UNIT[band])
        add_rotated_zonal(
            Vectors(Lane(local_direction[0]), Lane(local_direction[1]), Lane(local_direction[2])),
            zonal,
            basis[batch, q],
        )

    return evaluate_rotated


@wp.kernel(enable_backward=False)
def _find_harmonic_rotations(
    # in
    weighted_basis: wp.array2d(dtype=wp.float32),
    basis: wp.array3d(dtype=wp.float32),
    order: int,
    # out
    harmonic_rotations: wp.array3d(dtype=wp.float32),
):
    """A thread owns a row of D:  D_ki = ∫ y_k(ω) y_i(Rᵀω) dω, by a quadrature that is exact."""
    batch, k = wp.tid()
    band = int(wp.sqrt(float(k) + 0.5))
    for i in range(band * band, (band + 1) * (band + 1)):
        entry = float(0.0)
        for q in range(weighted_basis.shape[0]):
            entry += weighted_basis[q, k] * basis[batch, q, i]
        harmonic_rotations[batch, k, i] = entry


class BodyRotation(NamedTuple):
    """The rotation of a body, and of spherical harmonics by it.

    Args:
        rotations: R of each body, mat33 of shape [batch, body].
        body: Index of the body.
        harmonics: The rotation of harmonics by R, D: float32 of shape [batch, order², order²]; only its bands are
            filled.
    """

    rotations: wp.array
    body: int
    harmonics: wp.array


def find_body_rotation(rotations: wp.array, body: int, order: int) -> BodyRotation:
    """Find a body's rotation of harmonics. Differentiable: rotations, in :func:`find_self_transfer`."""
    batch_count, device = len(rotations), rotations.device
    directions, weights = sh.quadrature(2 * order - 2)
    weighted_basis = constant(
        (weights[:, None] * sh.evaluate(order, directions)).astype(np.float32), wp.float32, device
    )
    basis = zeros((batch_count, len(weights), order**2), dtype=wp.float32, device=device)
    harmonic_rotations = empty((batch_count, order**2, order**2), dtype=wp.float32, device=device)
    inputs = [rotations, body, constant(directions, wp.vec3, device)]
    launch(_make_evaluate_rotated(order), basis.shape[:2], inputs=inputs, outputs=[basis.view(lane_type(1))])
    launch(
        _find_harmonic_rotations,
        harmonic_rotations.shape[:2],
        inputs=[weighted_basis, basis, order],
        outputs=[harmonic_rotations],
    )
    return BodyRotation(rotations, body, harmonic_rotations)


@wp.func
def _self_coefficient(probe_transfer: wp.array2d(dtype=wp.float32), row: wp.vec3i, corner_weights: wp.vec3, i: int):
    """Coefficient i of a receiver, in the body's frame."""
    if row[0] == row[1] and row[0] == row[2]:
        return probe_transfer[row[0], i]
    return (
        corner_weights[0] * probe_transfer[row[0], i]
        + corner_weights[1] * probe_transfer[row[1], i]
        + corner_weights[2] * probe_transfer[row[2], i]
    )


@wp.kernel(enable_backward=False)
def _rotate_transfer(
    first_row: int,
    worker: int,
    # in
    probe_transfer: wp.array2d(dtype=wp.float32),
    rows: wp.array2d(dtype=wp.vec3i),
    probe_weights: wp.array2d(dtype=wp.vec3),
    harmonic_rotations: wp.array3d(dtype=wp.float32),
    bands: int,
    # out
    self_transfer: wp.array3d(dtype=wp.float32),
):
    """A thread owns a receiver."""
    batch, receiver = split_row(first_row + wp.tid(), self_transfer.shape[1])
    rotation_batch = instance_in(batch, harmonic_rotations.shape[0])
    row = rows[instance_in(batch, rows.shape[0]), receiver]
    corner_weights = probe_weights[instance_in(batch, probe_weights.shape[0]), receiver]
    for k in range(bands * bands):
        self_transfer[batch, receiver, k] = 0.0
    for band in range(bands):
        start = band * band
        end = start + 2 * band + 1
        for i in range(start, end):
            coefficient = _self_coefficient(probe_transfer, row, corner_weights, i)
            for k in range(start, end):
                self_transfer[batch, receiver, k] = (
                    self_transfer[batch, receiver, k] + harmonic_rotations[rotation_batch, k, i] * coefficient
                )


@wp.kernel(enable_backward=False)
def _rotate_transfer_adjoint(
    first_row: int,
    worker: int,
    # in
    probe_transfer: wp.array2d(dtype=wp.float32),
    rows: wp.array2d(dtype=wp.vec3i),
    harmonic_rotations: wp.array3d(dtype=wp.float32),
    bands: int,
    self_transfer: wp.array3d(dtype=wp.float32),
    generator_starts: wp.array(dtype=wp.int32),
    generator_columns: wp.array(dtype=wp.int32),
    generators: wp.array(dtype=wp.vec3),
    adj_self_transfer: wp.array3d(dtype=wp.float32),
    # out
    adj_probe_weights: wp.array2d(dtype=wp.vec3),
    # sums
    adj_angles: wp.array(dtype=wp.vec3),
):
    """A thread owns a receiver:  δ̄_a += K̄ᵀ G_a K,  b̄_j += L_jᵀ Dᵀ K̄."""
    batch, receiver = split_row(first_row + wp.tid(), adj_self_transfer.shape[1])
    rotation_batch = instance_in(batch, harmonic_rotations.shape[0])
    if adj_angles:
        adj_angle = wp.vec3()
        for k in range(bands * bands):
            generated = wp.vec3()
            for t in range(generator_starts[k], generator_starts[k + 1]):
                generated += self_transfer[batch, receiver, generator_columns[t]] * generators[t]
            adj_angle += adj_self_transfer[batch, receiver, k] * generated
        wp.atomic_add(adj_angles, rotation_batch, adj_angle)
    if adj_probe_weights:
        row = rows[instance_in(batch, rows.shape[0]), receiver]
        adj_weights = wp.vec3()
        for band in range(bands):
            start = band * band
            end = start + 2 * band + 1
            for i in range(start, end):
                adj_coefficient = float(0.0)
                for k in range(start, end):
                    adj_coefficient += harmonic_rotations[rotation_batch, k, i] * adj_self_transfer[batch, receiver, k]
                adj_weights += adj_coefficient * wp.vec3(
                    probe_transfer[row[0], i], probe_transfer[row[1], i], probe_transfer[row[2], i]
                )
        adj_probe_weights[batch, receiver] = adj_probe_weights[batch, receiver] + adj_weights


@wp.kernel(enable_backward=False)
def _add_rotation_gradients(
    # in
    adj_angles: wp.array(dtype=wp.vec3),
    rotations: wp.array2d(dtype=wp.mat33),
    body: int,
    # out
    adj_rotations: wp.array2d(dtype=wp.mat33),
):
    """A thread owns an instance. dR = [δ]× R, so R̄ = ½ [δ̄]× R."""
    batch = wp.tid()
    adj_rotation = 0.5 * wp.skew(adj_angles[batch]) * rotations[batch, body]
    adj_rotations[batch, body] = adj_rotations[batch, body] + adj_rotation


@functools.cache
def _generator_rows(order: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The generators as sparse rows: entries of row k are at first[k] … first[k + 1], each an index and a vec3."""
    generators = sh.rotation_generators(order)
    k, i = np.nonzero(np.abs(generators).max(axis=0) > 1e-9)
    return (
        np.searchsorted(k, np.arange(order**2 + 1)).astype(np.int32),
        i.astype(np.int32),
        generators[:, k, i].T.reshape(-1, 3),
    )


def find_self_transfer(
    probe_transfer: wp.array,
    probe_weights: ProbeWeights,
    rotation: BodyRotation,
    *,
    order: int,
    bands: int | None = None,
) -> wp.array:
    """Find the self-transfer of receivers of a body.

    Args:
        probe_transfer: L of its probes, float32 of shape [row, order²].
    Returns:
        K, float32 of shape [batch, receiver, bands²].
    Differentiable: the body's rotation, as it turns on; weights of the probes.
    """
    bands = order if bands is None else bands
    rotations, body, harmonic_rotations = rotation
    batch_count = common_batch({"probe_weights": probe_weights.rows, "rotations": harmonic_rotations})
    shape, device = (batch_count, probe_weights.rows.shape[1], bands**2), probe_transfer.device
    if probe_weights.weights.requires_grad:
        # each instance has a gradient of its own
        probe_weights = ProbeWeights(probe_weights.rows, expand(probe_weights.weights, batch_count))
    self_transfer = empty(shape, dtype=wp.float32, device=device)
    cost = _ROTATION_COST * bands**3

    def forward(result: wp.array) -> None:
        inputs = [probe_transfer, *probe_weights, harmonic_rotations, bands]
        launch(_rotate_transfer, shape[0] * shape[1], inputs=inputs, outputs=[result], cost=cost)

    def adjoint(adj_self_transfer: wp.array) -> None:
        first, index, vectors = _generator_rows(bands)
        generators = (
            constant(values, dtype, device)
            for values, dtype in ((first, wp.int32), (index, wp.int32), (vectors, wp.vec3))
        )
        adj_angles = None
        if rotations.requires_grad:
            adj_angles = zeros(len(rotations), dtype=wp.vec3, device=device)
        launch(
            _rotate_transfer_adjoint,
            shape[0] * shape[1],
            inputs=[
                probe_transfer,
                probe_weights.rows,
                harmonic_rotations,
                bands,
                self_transfer,
                *generators,
                adj_self_transfer,
            ],
            outputs=[probe_weights.weights.grad],
            sums=[adj_angles],
            cost=2 * cost,
        )
        if adj_angles is not None:
            inputs = [adj_angles, rotations, body]
            launch(_add_rotation_gradients, len(rotations), inputs=inputs, outputs=[rotations.grad])

    return differentiable(forward, adjoint, result=self_transfer, variables=[probe_weights.weights, rotations])
