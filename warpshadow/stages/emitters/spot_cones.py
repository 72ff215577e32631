"""Beams: emitters that emit within a cone alone, as spot lights do.

Towards ω, at an angle θ from the emitter's axis a, its radiance is its emission times

    s = t² (3 − 2 t),   t = min(max((v_o − v) / (v_o − v_i), 0), 1),   v = 1 − cos θ = |ω − a|² / 2

1 within the inner angle and 0 beyond the outer one [Pharr et al. 2023, Physically Based Rendering, section 12.2.1]. A
beam is the pair v_i, v_o.
"""

from collections.abc import Sequence

import numpy as np
import warp as wp

from warpshadow.device.batch import common_batch, expand, expand_rows, instance_in
from warpshadow.device.launch import launch
from warpshadow.device.memory import empty
from warpshadow.device.parallel import split_row
from warpshadow.maths.adjacency import area_normals
from warpshadow.stages.emitters.samples import EVERYWHERE, EmitterSpan, PlacedSamples, sample_transmittance

_COST = 4.0  # nanoseconds that a sample takes
_MIN_FACING = 0.1  # of its area, that a surface faces a direction with on average
_LEAST_FALLOFF = 1e-6  # of a beam, relative: float32 tells both ends of it

wp.set_module_options({"max_unroll": 1})


def beam_of(angles: Sequence[float] | None) -> tuple[float, float]:
    """The beam of inner and outer angles [degrees]; all directions for None."""
    if angles is None:
        return EVERYWHERE
    inner, outer = (1 - np.cos(np.radians(angles))).tolist()
    return min(inner, outer * (1 - _LEAST_FALLOFF)), outer


def find_axis_weights(positions: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Weights of the vertices and of the faces' area vectors in a multiple of the axis of a body.

    It is the mean normal; or −z at rest where normals nearly cancel, as those of a closed body do.

    Args:
        positions, faces: Vertices at rest [units of the body], shape [vertex, 3], and faces that wind alike, [face, 3].
    Returns:
        Of shape [vertex] and [face].
    """
    positions = positions.astype(np.float64)
    vectors = area_normals(positions[faces])
    areas = np.linalg.norm(vectors, axis=1).sum()
    if np.linalg.norm(vectors.sum(axis=0)) > _MIN_FACING * areas:
        return np.zeros(len(positions)), np.full(len(faces), 1 / areas)
    is_used = np.zeros((len(positions), 1))
    is_used[faces] = 1
    offsets = is_used * (positions - positions[is_used[:, 0] > 0].mean(axis=0))
    return offsets @ np.linalg.pinv(offsets.T @ offsets, rcond=1e-9) @ (0, 0, -1.0), np.zeros(len(faces))


@wp.func
def spot_falloff(axis: wp.vec3, to_receiver: wp.vec3, beam: wp.vec2):
    """Part of its emission that an emitter sends towards a receiver, given its axis, of length 1, and the way there."""
    return wp.smoothstep(beam[1], beam[0], 0.5 * wp.length_sq(wp.normalize(to_receiver) - axis))


@wp.kernel
def _dim_by_beam(
    first_row: int,
    worker: int,
    # in
    points: wp.array2d(dtype=wp.vec3),
    sample_points: wp.array2d(dtype=wp.vec3),
    axes: wp.array2d(dtype=wp.vec3),
    transmittance: wp.array3d(dtype=wp.float32),
    emitter: int,
    first_sample: int,
    beam: wp.vec2,
    # out
    dimmed: wp.array3d(dtype=wp.float32),
):
    """A thread owns a receiver of an instance."""
    batch, receiver = split_row(first_row + wp.tid(), dimmed.shape[1])
    point = points[batch, receiver]
    sample_batch = instance_in(batch, sample_points.shape[0])
    axis = wp.normalize(axes[sample_batch, emitter])
    for i in range(dimmed.shape[2]):
        falloff = spot_falloff(axis, point - sample_points[sample_batch, first_sample + i], beam)
        dimmed[batch, receiver, i] = falloff * sample_transmittance(transmittance, batch, receiver, i)


def weigh_by_beam(
    points: wp.array, samples: PlacedSamples, span: EmitterSpan, transmittance: wp.array | None
) -> wp.array | None:
    """Multiply the transmittance to the samples of an emitter with the part of their emission that receivers get.

    Args:
        points: Receivers [scene units], vec3 of shape [batch, receiver].
        transmittance: Float32 of shape [batch, receiver, sample]; None for 1. Any batch may be 1.
    Returns:
        Float32 of shape [batch, receiver, sample]; the transmittance itself where the emitter has no beam.
    Differentiable: points, samples, transmittance.
    """
    if span.beam is None:
        return transmittance
    count = common_batch({"points": points, "emitters": samples.points, "transmittance": transmittance})
    dimmed = empty((count, points.shape[1], span.size), dtype=wp.float32, device=points.device)
    launch(
        _dim_by_beam,
        count * points.shape[1],
        inputs=[
            *(expand(points, count), samples.points, samples.axes),
            None if transmittance is None else expand_rows(transmittance, count),
            *(span.emitter, span.first, wp.vec2(*span.beam)),
        ],
        outputs=[dimmed],
        shared=[samples.points, samples.axes],
        cost=_COST * span.size,
    )
    return dimmed
