"""Shared rays: all receivers look for light in the same directions, so that an image has no grain.

With directions ω_i and the light l_i that each stands for (:func:`.light_samples.cut_map`), a receiver gets

    Σ_i l_i V_i max(n·ω_i, 0) / π

Some receivers tell where light comes from, so that most directions go there (:func:`find_shares`).
Rays go through the scene in packets of 16 that are close to each other (:mod:`.ray_packets`).
"""

import functools

import numpy as np
import warp as wp

from warpshadow.device.constants import constant
from warpshadow.device.lanes import lane_type, make_lane_functions, module_options, vectors_type
from warpshadow.device.launch import launch
from warpshadow.device.memory import empty, zeros
from warpshadow.stages.light_samples import LightSamples
from warpshadow.stages.ray_packets import PACKET, FaceTree, make_find_open, packets_of
from warpshadow.stages.ray_tracing import parts

_PACKET_COST = 2000.0
"""Nanoseconds that a packet takes."""

_PILOTS = 256
"""Receivers that stand for all, where directions are chosen."""


@functools.cache
def _make_trace() -> wp.Kernel:
    Lane, Vectors, fn = lane_type(PACKET), vectors_type(PACKET), make_lane_functions(PACKET)
    find_open, dot_direction, bits_above = make_find_open(), fn.dot_direction, fn.bits_above

    @wp.kernel(module="unique", module_options=module_options(PACKET), enable_backward=False)
    def trace_shared(
        first_row: int,
        worker: int,
        # in
        tree: FaceTree,
        points: wp.array(dtype=wp.vec3),
        normals: wp.array(dtype=wp.vec3),
        directions: wp.array2d(dtype=Lane),
        light: wp.array2d(dtype=wp.vec3),
        # out
        shading: wp.array(dtype=wp.vec3),
        received: wp.array3d(dtype=wp.float32),
    ):
        """A thread owns a receiver; what it gets from each direction is told where there is room for it."""
        receiver = first_row + wp.tid()
        point = points[receiver]
        normal = normals[receiver]
        total = wp.vec3()
        last = int(-1)
        for packet in range(directions.shape[0]):
            toward = Vectors(directions[packet, 0], directions[packet, 1], directions[packet, 2])
            cosine = dot_direction(normal, toward)
            facing_rays = bits_above(cosine, 0.0)
            if facing_rays != 0:
                result = find_open(
                    tree.corners, tree.lowers, tree.uppers, tree.leaf_count, point, normal, toward, facing_rays, last
                )
                last = result[1]
                for lane in range(PACKET):
                    if (result[0] >> lane) % 2 == 1:
                        total += cosine[lane] * light[packet, lane]
                        if received.shape[0] > 0:
                            received[receiver, packet, lane] = cosine[lane] * wp.length(light[packet, lane])
        shading[receiver] = total / wp.pi

    return trace_shared


def find_shares(tree: FaceTree, points: wp.array, normals: wp.array, samples: LightSamples) -> np.ndarray:
    """Find what share of receivers' light comes from each direction, on average over receivers, dim and bright ones.

    Args:
        tree: What blocks the light.
        points: Receiver positions [scene units], vec3 of shape [receiver]; a few stand for all.
        normals: Unit normals, vec3 of shape [receiver].
        samples: As for :func:`trace_shared`.

    Returns:
        Shares, of shape [direction], whose sum is 1, or less where some receivers see no light.

    Differentiable: no.
    """
    count = points.shape[0]
    chosen = np.arange(min(count, _PILOTS)) * count // max(min(count, _PILOTS), 1)
    at, facing = (wp.array(rows.numpy()[chosen], dtype=wp.vec3, device=points.device) for rows in (points, normals))
    received = zeros((len(chosen), samples.directions.shape[1] // PACKET, PACKET), dtype=wp.float32, device=at.device)
    _trace(tree, at, facing, samples, received)
    light = received.numpy().reshape(len(chosen), -1)
    light /= np.maximum(light.sum(axis=1, keepdims=True), 1e-12)
    return light.sum(axis=0) / max(len(chosen), 1)


def trace_shared(
    tree: FaceTree, points: wp.array, normals: wp.array, samples: LightSamples, *, progress: bool = False
) -> wp.array:
    """Trace the shading of receivers: the radiance of a white surface in direct light.

    Args:
        tree: What blocks the light.
        points: Receiver positions [scene units], vec3 of shape [receiver].
        normals: Unit normals, vec3 of shape [receiver].
        samples: One set of directions, a multiple of 16, each run of 16 close to each other.
        progress: Show a progress bar where it takes longer than a second.

    Returns:
        Shading, vec3 of shape [receiver].

    Differentiable: no.
    """
    shading = empty(points.shape, dtype=wp.vec3, device=points.device)
    untracked = zeros((0, 0, 0), dtype=wp.float32, device=points.device)
    for part in parts(points.shape[0], 2**24 // samples.directions.shape[1], progress):
        wp.copy(shading[part], _trace(tree, points[part], normals[part], samples, untracked))
    return shading


def _trace(tree: FaceTree, points: wp.array, normals: wp.array, samples: LightSamples, received: wp.array) -> wp.array:
    """Shading of receivers; ``received`` gets what each gets from each direction, [receiver, packet, lane], if any."""
    device = points.device
    packets = packets_of(samples.directions[0])
    directions = constant(packets, lane_type(PACKET), device)
    light = constant(samples.radiance[0].reshape(-1, PACKET, 3), wp.vec3, device)
    shading = empty(points.shape, dtype=wp.vec3, device=device)
    launch(
        _make_trace(),
        len(points),
        inputs=[tree, points, normals, directions, light],
        outputs=[shading, received],
        cost=_PACKET_COST * len(packets),
    )
    return shading
