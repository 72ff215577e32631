"""Transmittance towards the samples of a lobe, by rays: 0 or 1, through packets of 16."""

import functools

import warp as wp

from warpshadow.device.lanes import lane_type, make_lane_functions, module_options, vectors_type
from warpshadow.device.launch import launch
from warpshadow.stages.rays.ray_packets import PACKET, FaceTree, make_find_open

_PACKET_COST = 2000.0  # nanoseconds that a packet takes


@functools.cache
def _make_trace() -> wp.Kernel:
    Lane, Vectors, fn = lane_type(PACKET), vectors_type(PACKET), make_lane_functions(PACKET)
    find_open, dot_direction, bits_above = make_find_open(), fn.dot_direction, fn.bits_above

    @wp.kernel(module="unique", module_options=module_options(PACKET), enable_backward=False)
    def trace_lobes(
        first_row: int,
        worker: int,
        # in
        tree: FaceTree,
        points: wp.array(dtype=wp.vec3),
        normals: wp.array(dtype=wp.vec3),
        directions: wp.array2d(dtype=wp.vec3),
        # out
        transmittance: wp.array2d(dtype=wp.float32),
    ):
        """A thread owns a receiver."""
        receiver = first_row + wp.tid()
        point = points[receiver]
        normal = normals[receiver]
        last_face = int(-1)
        for packet in range(directions.shape[1] / PACKET):
            x = Lane()
            y = Lane()
            z = Lane()
            for lane in range(PACKET):
                direction = directions[receiver, packet * PACKET + lane]
                x[lane] = direction[0]
                y[lane] = direction[1]
                z[lane] = direction[2]
            ray_directions = Vectors(x, y, z)
            facing_rays = bits_above(dot_direction(normal, ray_directions), 0.0)
            open_rays, last_face = find_open(tree, point, normal, ray_directions, facing_rays, last_face)
            for lane in range(PACKET):
                transmittance[receiver, packet * PACKET + lane] = float((open_rays >> lane) % 2)

    return trace_lobes


def trace_lobes(tree: FaceTree, points: wp.array, normals: wp.array, directions: wp.array) -> wp.array:
    """Trace which samples of lobes meet no face.

    Args:
        tree: The faces that block light.
        points: Receiver positions [scene units], vec3 of shape [receiver].
        normals: Unit normals, vec3 of shape [receiver].
        directions: Of :func:`.lobes.sample_lobes`, of an instance, vec3 of shape [receiver, sample], a multiple of 16.

    Returns:
        1 for samples that meet none, else 0, float32 of shape [receiver, sample].

    Differentiable: no.
    """
    if directions.shape[1] % PACKET:
        raise ValueError(f"directions: got {directions.shape[1]} samples, expected a multiple of {PACKET}")
    transmittance = wp.empty(directions.shape, dtype=wp.float32, device=points.device)
    launch(
        _make_trace(),
        len(points),
        inputs=[tree, points, normals, directions],
        outputs=[transmittance],
        cost=_PACKET_COST * directions.shape[1] / PACKET,
    )
    return transmittance
