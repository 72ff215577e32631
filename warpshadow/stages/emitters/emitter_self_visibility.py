"""Self-visibility of emitters: the part of a lamp that its own surface hides, such as the far side of a shade.

Rays from points of each sample, traced once in the body's own frame, find for cells q of directions ω_q the share s_q
of the sample that is open to infinity, and the distance D_q of the surface that hides the rest. A receiver at the
distance d in the direction ω sees

    T = Σ_q k_q (s_q + (1 − s_q) S(D_q, d)) / Σ_q k_q,   k_q = max(ω·ω_q − cos 2.2ρ, 0)² + ε,

S falling from 1 to 0 around d = D_q: receivers within a lamp are nearer than its far side. The frame is the rotation R
that takes the samples y⁰_k at rest nearest to the placed ones, that of Σ_k y_k y⁰_kᵀ, and so is the scale of D_q.
A convex body hides nothing that faces a receiver, and has no table.
"""

from typing import NamedTuple

import numpy as np
import warp as wp

from warpshadow.device.batch import common_batch, instance_in
from warpshadow.device.constants import constant
from warpshadow.device.launch import launch
from warpshadow.device.memory import empty, from_numpy
from warpshadow.device.parallel import split_row
from warpshadow.maths.adjacency import area_normals
from warpshadow.maths.directions import cell_radius, fibonacci
from warpshadow.stages.cell_neighbors import KERNEL_RADIUS, cell_neighbors, texel_of
from warpshadow.stages.emitters.samples import EmitterSpan, PlacedSamples, SurfacePoints
from warpshadow.stages.geometry.nearest_rotation import nearest_rotations

CELLS = fibonacci(512)

_COST = 60.0  # nanoseconds that a sample takes
_NEGLIGIBLE = 1.0e-7
_LIFT = 1.0e-4  # height above the surface at which rays start [sizes of the body]
_MIN_HIDDEN = 1.0e-3  # mean hidden share of a body below which it has no table: rounding at edges of convex bodies

_FALL_HALF_WIDTH = 0.1  # half-width of the fall of S [D_q]
_REACH_ON_LAMP = 1.25  # middle of that fall for receivers on the lamp itself, which are at D_q
_REACH_COSINE = float(np.cos(KERNEL_RADIUS * cell_radius(len(CELLS))))

wp.set_module_options({"max_unroll": 1})


class EmitterSelfVisibility(NamedTuple):
    """Self-visibility of the samples of one emitter."""

    rest_points: wp.array  # samples at rest around their middle y⁰, of squares that sum up to 1; vec3 of shape [sample]
    far_transmittance: wp.array  # s, float32 of shape [sample, cell]
    distances: wp.array  # D [lengths of rest_points], float32 of shape [sample, cell]


@wp.kernel(enable_backward=False)
def _trace_samples(
    first_row: int,
    worker: int,
    # in
    mesh: wp.uint64,
    points: wp.array2d(dtype=wp.vec3),
    normals: wp.array2d(dtype=wp.vec3),
    cells: wp.array(dtype=wp.vec3),
    is_two_sided: int,
    lift: float,
    # out
    far_transmittance: wp.array2d(dtype=wp.float32),
    distances: wp.array2d(dtype=wp.float32),
):
    """A thread owns a sample. Cells below the horizon of all its points have the rays of their mirror images."""
    sample = first_row + wp.tid()
    mean_normal = wp.vec3()
    for i in range(points.shape[1]):
        mean_normal += normals[sample, i]
    mean_normal = wp.normalize(mean_normal)
    for c in range(cells.shape[0]):
        direction = cells[c]
        depth = wp.dot(direction, mean_normal)
        if is_two_sided == 0 and depth < 0.0:
            direction = direction - 2.0 * depth * mean_normal
        open_weight = float(0.0)
        hidden_weight = float(0.0)
        total_distance = float(0.0)
        for i in range(points.shape[1]):
            cosine = wp.dot(normals[sample, i], direction)
            if is_two_sided == 1:
                cosine = wp.abs(cosine)
            if cosine > 0.0:
                side = wp.sign(wp.dot(normals[sample, i], direction))
                origin = points[sample, i] + lift * side * normals[sample, i]
                hit = wp.mesh_query_ray(mesh, origin, direction, 1.0e6)
                if hit.result:
                    hidden_weight += cosine
                    total_distance += cosine * hit.t
                else:
                    open_weight += cosine
        if hidden_weight > 0.0:
            far_transmittance[sample, c] = open_weight / (open_weight + hidden_weight)
            distances[sample, c] = total_distance / hidden_weight
        else:
            far_transmittance[sample, c] = 1.0
            distances[sample, c] = 1.0


def find_self_visibility(
    positions: np.ndarray,
    faces: np.ndarray,
    sample_points: np.ndarray,
    surface_points: SurfacePoints,
    *,
    is_two_sided: bool,
    device: wp.DeviceLike,
) -> EmitterSelfVisibility | None:
    """Trace the self-visibility of an emitter at rest.

    Args:
        positions, faces: Its mesh [units of the body], shapes [vertex, 3] and [face, 3].
        sample_points: Middles of its samples [units of the body], shape [sample, 3].
    Returns:
        None for a body that hides next to nothing of itself, such as a convex one.
    """
    rest_points = sample_points - sample_points.mean(axis=0)
    size = float(np.linalg.norm(rest_points))
    if not size > 0:
        return None
    corners = (positions.astype(np.float64)[faces] - sample_points.mean(axis=0)) / size
    points = np.einsum("spk,spkx->spx", surface_points.weights, corners[surface_points.faces])
    normals = area_normals(corners)[surface_points.faces]
    normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-30)
    vertices = from_numpy(corners.reshape(-1, 3), dtype=wp.vec3, device=device)
    mesh = wp.Mesh(vertices, wp.array(np.arange(len(vertices)), dtype=wp.int32, device=device))
    shape = len(points), len(CELLS)
    far_transmittance, distances = (empty(shape, dtype=wp.float32, device=device) for _ in range(2))
    arrays = [from_numpy(item, dtype=wp.vec3, device=device) for item in (points, normals)]
    launch(
        _trace_samples,
        len(points),
        inputs=[mesh.id, *arrays, constant(CELLS, wp.vec3, device), int(is_two_sided), _LIFT],
        outputs=[far_transmittance, distances],
        cost=200.0 * len(CELLS) * points.shape[1],
    )
    if 1 - far_transmittance.numpy().mean() < _MIN_HIDDEN:
        return None
    return EmitterSelfVisibility(
        from_numpy(rest_points / size, dtype=wp.vec3, device=device), far_transmittance, distances
    )


@wp.kernel
def _find_moments(
    # in
    rest_points: wp.array(dtype=wp.vec3),
    sample_points: wp.array2d(dtype=wp.vec3),
    first_sample: int,
    # out
    moments: wp.array2d(dtype=wp.mat33),
):
    """A thread owns an instance: Σ_k y_k y⁰_kᵀ."""
    batch = wp.tid()
    total = wp.mat33()
    for k in range(rest_points.shape[0]):
        offset = sample_points[batch, first_sample + k] - sample_points[batch, first_sample]
        total += wp.outer(offset, rest_points[k])
    moments[batch, 0] = total


@wp.kernel
def _look_up(
    first_row: int,
    worker: int,
    # in
    points: wp.array2d(dtype=wp.vec3),
    sample_points: wp.array2d(dtype=wp.vec3),
    first_sample: int,
    moments: wp.array2d(dtype=wp.mat33),
    rotations: wp.array2d(dtype=wp.mat33),
    far_transmittance: wp.array2d(dtype=wp.float32),
    distances: wp.array2d(dtype=wp.float32),
    cells: wp.array(dtype=wp.vec3),
    neighbors: wp.array2d(dtype=wp.int32),
    reach_cosine: float,
    reach: float,
    # out
    weighted_sums: wp.array3d(dtype=wp.vec2),
):
    """A thread owns a receiver: the sums of k T and of k for each sample."""
    batch, receiver = split_row(first_row + wp.tid(), weighted_sums.shape[1])
    sample_batch = instance_in(batch, sample_points.shape[0])
    point = points[instance_in(batch, points.shape[0]), receiver]
    rotation = rotations[sample_batch, 0]
    scale = wp.ddot(rotation, moments[sample_batch, 0])
    for i in range(weighted_sums.shape[2]):
        beam = wp.transpose(rotation) * (point - sample_points[sample_batch, first_sample + i])
        distance = wp.length(beam) / scale
        direction = wp.normalize(beam)
        texel = texel_of(direction)
        weighted_sum = wp.vec2()
        for k in range(neighbors.shape[1]):
            cell = neighbors[texel, k]
            kernel_weight = wp.max(wp.dot(direction, cells[cell]) - reach_cosine, 0.0)
            weight = kernel_weight * kernel_weight + _NEGLIGIBLE
            cell_transmittance = far_transmittance[i, cell]
            middle = reach * distances[i, cell]
            nearness = 1.0 - wp.smoothstep(
                (1.0 - _FALL_HALF_WIDTH) * middle, (1.0 + _FALL_HALF_WIDTH) * middle, distance
            )
            weighted_sum += weight * wp.vec2(cell_transmittance + (1.0 - cell_transmittance) * nearness, 1.0)
        weighted_sums[batch, receiver, i] = weighted_sum


@wp.kernel
def _divide(
    # in
    weighted_sums: wp.array3d(dtype=wp.vec2),
    # out
    transmittance: wp.array3d(dtype=wp.float32),
):
    """A thread owns a sample of a receiver."""
    batch, receiver, i = wp.tid()
    transmittance[batch, receiver, i] = weighted_sums[batch, receiver, i][0] / weighted_sums[batch, receiver, i][1]


def look_up_self_visibility(
    points: wp.array,
    samples: PlacedSamples,
    span: EmitterSpan,
    self_visibility: EmitterSelfVisibility,
    *,
    is_on_emitter: bool = False,
) -> wp.array:
    """Transmittance of an emitter's own body between receivers and its samples.

    Args:
        points: Receivers [scene units], vec3 of shape [batch, receiver].
        is_on_emitter: Whether the receivers lie on the emitter.
    Returns:
        Float32 of shape [batch, receiver, sample].
    Differentiable: points, samples.
    """
    device, sample_points = points.device, samples.points
    moments = empty((len(sample_points), 1), dtype=wp.mat33, device=device)
    launch(
        _find_moments,
        len(sample_points),
        inputs=[self_visibility.rest_points, sample_points, span.first],
        outputs=[moments],
    )
    count = common_batch({"points": points, "emitters": sample_points})
    weighted_sums = empty((count, points.shape[1], span.size), dtype=wp.vec2, device=device)
    table = self_visibility.far_transmittance, self_visibility.distances
    cells = constant(CELLS, wp.vec3, device), cell_neighbors(CELLS, device)
    launch(
        _look_up,
        count * points.shape[1],
        inputs=[
            *(points, sample_points, span.first, moments, nearest_rotations(moments), *table, *cells),
            *(_REACH_COSINE, _REACH_ON_LAMP if is_on_emitter else 1.0),
        ],
        outputs=[weighted_sums],
        shared=[points, sample_points, moments],
        cost=_COST * span.size,
    )
    transmittance = empty(weighted_sums.shape, dtype=wp.float32, device=device)
    launch(_divide, transmittance.shape, inputs=[weighted_sums], outputs=[transmittance])
    return transmittance
