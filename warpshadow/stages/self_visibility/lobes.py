"""Self-visibility lobes: SH light that a probe gets past its own body, computed once in the body's frame.

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

_TURN_COST = 0.5  # nanoseconds that an entry of D takes for a receiver
_PART = 1 << 9  # rows that are projected at once


def project_rows(rows: VisibilityRows, normals: np.ndarray, order: int) -> wp.array:
    """Find the lobes of probes: the lobes of open probes, minus the light of blocked rays.

    Args:
        rows: Visibility of the probes past their body.
        normals: Their unit normals in the frame of the body [row, 3]; a zero normal has no lobe.
        order: Number of SH bands n.
    Returns:
        L, float32 of shape [row, order²]. Not differentiable.
    """
    normals = np.asarray(normals, np.float64)
    rays, bits = fibonacci(rows.ray_count), rows.bits.numpy()
    brought = (4 / len(rays) * sh.evaluate(order, rays)).astype(np.float32)
    band = sh.band_of(order)
    zonal = (sh.clamped_cosine(order) / np.pi * np.sqrt(4 * np.pi / (2 * np.arange(order) + 1)))[band]
    lobes = (zonal * sh.evaluate(order, normals)).astype(np.float32)
    lobes[~normals.any(axis=1)] = 0
    for start in range(0, len(normals), _PART):
        part = slice(start, start + _PART)
        is_open = bits[part, :, None] >> np.arange(32, dtype=np.uint32) & 1
        cosines = np.maximum(normals[part].astype(np.float32) @ rays.T.astype(np.float32), 0)
        lobes[part] -= np.where(is_open.reshape(cosines.shape), 0, cosines) @ brought
    return wp.array(lobes, dtype=wp.float32, device=rows.bits.device)


@functools.cache
def _make_evaluate(order: int) -> wp.Kernel:
    Lane, Vectors, Zonal = lane_type(1), vectors_type(1), zonal_type(order, 1)
    add_rotated_zonal = make_add_rotated_zonal(order, 1)
    UNIT = wp.types.vector(length=order, dtype=wp.float32)(*np.sqrt((2 * np.arange(order) + 1) / (4 * np.pi)))

    @wp.kernel(module="unique", enable_backward=False)
    def evaluate_turned(
        # in
        rotations: wp.array2d(dtype=wp.mat33),
        body: int,
        directions: wp.array(dtype=wp.vec3),
        # out
        basis: wp.array3d(dtype=Lane),
    ):
        """A thread owns a direction ω:  y(Rᵀω)."""
        batch, q = wp.tid()
        toward = wp.normalize(wp.transpose(rotations[batch, body]) * directions[q])
        zonal = Zonal()
        for band in range(order):
            zonal[band] = Lane(UNIT[band])
        add_rotated_zonal(Vectors(Lane(toward[0]), Lane(toward[1]), Lane(toward[2])), zonal, basis[batch, q])

    return evaluate_turned


@wp.kernel(enable_backward=False)
def _find_turns(
    # in
    weighted: wp.array2d(dtype=wp.float32),
    basis: wp.array3d(dtype=wp.float32),
    order: int,
    # out
    turns: wp.array3d(dtype=wp.float32),
):
    """A thread owns a row of D:  D_ki = ∫ y_k(ω) y_i(Rᵀω) dω, by a quadrature that is exact."""
    batch, k = wp.tid()
    band = int(wp.sqrt(float(k) + 0.5))
    for i in range(band * band, (band + 1) * (band + 1)):
        total = float(0.0)
        for q in range(weighted.shape[0]):
            total += weighted[q, k] * basis[batch, q, i]
        turns[batch, k, i] = total


class BodyRotation(NamedTuple):
    """How a body is turned.

    Args:
        rotations: R of each body, mat33 of shape [batch, body].
        body: Whose is meant.
        harmonics: The rotation of harmonics by R, D: float32 of shape [batch, order², order²]; only its bands are
            filled.
    """

    rotations: wp.array
    body: int
    harmonics: wp.array


def find_turned(rotations: wp.array, body: int, order: int) -> BodyRotation:
    """Find how a body turns harmonics. Differentiable: rotations, in :func:`self_visibility_lobes`."""
    count, device = len(rotations), rotations.device
    directions, weights = sh.quadrature(2 * order - 2)
    weighted = constant((weights[:, None] * sh.evaluate(order, directions)).astype(np.float32), wp.float32, device)
    basis = zeros((count, len(weights), order**2), dtype=wp.float32, device=device)
    turns = empty((count, order**2, order**2), dtype=wp.float32, device=device)
    inputs = [rotations, body, constant(directions, wp.vec3, device)]
    launch(_make_evaluate(order), basis.shape[:2], inputs=inputs, outputs=[basis.view(lane_type(1))])
    launch(_find_turns, turns.shape[:2], inputs=[weighted, basis, order], outputs=[turns])
    return BodyRotation(rotations, body, turns)


@wp.func
def _self_coefficient(lobes: wp.array2d(dtype=wp.float32), row: wp.vec3i, share: wp.vec3, i: int):
    """Coefficient i of a receiver, in the body's frame."""
    if row[0] == row[1] and row[0] == row[2]:
        return lobes[row[0], i]
    return share[0] * lobes[row[0], i] + share[1] * lobes[row[1], i] + share[2] * lobes[row[2], i]


@wp.kernel(enable_backward=False)
def _turn_lobes(
    first_row: int,
    worker: int,
    # in
    lobes: wp.array2d(dtype=wp.float32),
    rows: wp.array2d(dtype=wp.vec3i),
    places: wp.array2d(dtype=wp.vec3),
    turns: wp.array3d(dtype=wp.float32),
    bands: int,
    # out
    turned: wp.array3d(dtype=wp.float32),
):
    """A thread owns a receiver."""
    batch, receiver = split_row(first_row + wp.tid(), turned.shape[1])
    turn_batch = instance_in(batch, turns.shape[0])
    row = rows[instance_in(batch, rows.shape[0]), receiver]
    share = places[instance_in(batch, places.shape[0]), receiver]
    for k in range(bands * bands):
        turned[batch, receiver, k] = 0.0
    for band in range(bands):
        start = band * band
        end = start + 2 * band + 1
        for i in range(start, end):
            coefficient = _self_coefficient(lobes, row, share, i)
            for k in range(start, end):
                turned[batch, receiver, k] = turned[batch, receiver, k] + turns[turn_batch, k, i] * coefficient


@wp.kernel(enable_backward=False)
def _turn_lobes_adjoint(
    first_row: int,
    worker: int,
    # in
    lobes: wp.array2d(dtype=wp.float32),
    rows: wp.array2d(dtype=wp.vec3i),
    turns: wp.array3d(dtype=wp.float32),
    bands: int,
    turned: wp.array3d(dtype=wp.float32),
    generators_first: wp.array(dtype=wp.int32),
    generators_index: wp.array(dtype=wp.int32),
    generators: wp.array(dtype=wp.vec3),
    adj_turned: wp.array3d(dtype=wp.float32),
    # out
    adj_places: wp.array2d(dtype=wp.vec3),
    adj_turns: wp.array(dtype=wp.vec3),
):
    """A thread owns a receiver:  δ̄_a += K̄ᵀ G_a K,  b̄_j += L_jᵀ Dᵀ K̄."""
    batch, receiver = split_row(first_row + wp.tid(), adj_turned.shape[1])
    turn_batch = instance_in(batch, turns.shape[0])
    if adj_turns:
        adj_turn = wp.vec3()
        for k in range(bands * bands):
            spun = wp.vec3()
            for t in range(generators_first[k], generators_first[k + 1]):
                spun += turned[batch, receiver, generators_index[t]] * generators[t]
            adj_turn += adj_turned[batch, receiver, k] * spun
        wp.atomic_add(adj_turns, turn_batch, adj_turn)
    if adj_places:
        row = rows[instance_in(batch, rows.shape[0]), receiver]
        adj_share = wp.vec3()
        for band in range(bands):
            start = band * band
            end = start + 2 * band + 1
            for i in range(start, end):
                adj_coefficient = float(0.0)
                for k in range(start, end):
                    adj_coefficient += turns[turn_batch, k, i] * adj_turned[batch, receiver, k]
                adj_share += adj_coefficient * wp.vec3(lobes[row[0], i], lobes[row[1], i], lobes[row[2], i])
        adj_places[batch, receiver] = adj_places[batch, receiver] + adj_share


@wp.kernel(enable_backward=False)
def _add_turns(
    # in
    adj_turns: wp.array(dtype=wp.vec3),
    rotations: wp.array2d(dtype=wp.mat33),
    body: int,
    # out
    adj_rotations: wp.array2d(dtype=wp.mat33),
):
    """A thread owns an instance. dR = [δ]× R, so R̄ = ½ [δ̄]× R."""
    batch = wp.tid()
    adj = 0.5 * wp.skew(adj_turns[batch]) * rotations[batch, body]
    adj_rotations[batch, body] = adj_rotations[batch, body] + adj


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


def self_visibility_lobes(
    lobes: wp.array, places: ProbeWeights, turned: BodyRotation, *, order: int, bands: int | None = None
) -> wp.array:
    """Find the lobes of receivers of a body.

    Args:
        lobes: L of its probes, float32 of shape [row, order²].
        places: Where receivers lie on the body.
        turned: How it is turned.
        order: Number of SH bands n.
        bands: Number of bands to be found; all by default.
    Returns:
        K, float32 of shape [batch, receiver, bands²].
    Differentiable: rotations, as they turn on; weights of places.
    """
    bands = order if bands is None else bands
    rotations, body, turns = turned
    count = common_batch({"places": places.rows, "rotations": turns})
    shape, device = (count, places.rows.shape[1], bands**2), lobes.device
    if places.weights.requires_grad:
        places = ProbeWeights(places.rows, expand(places.weights, count))  # whose gradients are apart
    result = empty(shape, dtype=wp.float32, device=device)
    cost = _TURN_COST * bands**3

    def forward(open_rays: wp.array) -> None:
        inputs = [lobes, *places, turns, bands]
        launch(_turn_lobes, shape[0] * shape[1], inputs=inputs, outputs=[open_rays], cost=cost)

    def adjoint(adj: wp.array) -> None:
        first, index, vectors = _generator_rows(bands)
        generators = (
            constant(values, dtype, device)
            for values, dtype in ((first, wp.int32), (index, wp.int32), (vectors, wp.vec3))
        )
        adj_turns = None
        if rotations.requires_grad:
            adj_turns = zeros(len(rotations), dtype=wp.vec3, device=device)
        launch(
            _turn_lobes_adjoint,
            shape[0] * shape[1],
            inputs=[lobes, places.rows, turns, bands, result, *generators, adj],
            outputs=[places.weights.grad],
            sums=[adj_turns],
            cost=2 * cost,
        )
        if adj_turns is not None:
            inputs = [adj_turns, rotations, body]
            launch(_add_turns, len(rotations), inputs=inputs, outputs=[rotations.grad])

    return differentiable(forward, adjoint, result=result, variables=[places.weights, rotations])
