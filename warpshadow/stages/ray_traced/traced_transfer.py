"""Transfer vectors by rays: the transmittance of a mesh for light in a basis, exact but for sampling."""

import functools
from collections.abc import Callable

import numpy as np
import warp as wp

from warpshadow.device.lanes import lane_type, make_lane_functions, module_options, vectors_type
from warpshadow.device.launch import launch
from warpshadow.device.memory import empty
from warpshadow.maths.directions import CHUNK, fibonacci
from warpshadow.stages.rays.beam_packets import make_beams
from warpshadow.stages.rays.ray_packets import PACKET, FaceTree, build_face_tree, make_find_open, packets_of
from warpshadow.stages.rays.ray_tracing import progress_slices
from warpshadow.stages.shell.shell_rays import FAR

_RAY_COST = 60.0  # nanoseconds that a ray takes


@functools.cache
def _make_trace_cosines(is_near: bool) -> wp.Kernel:
    Lane, Vectors, fn = lane_type(PACKET), vectors_type(PACKET), make_lane_functions(PACKET)
    find_open, bits_above, (beams_to_light, cosines_of) = make_find_open(), fn.bits_above, make_beams(is_near)

    @wp.kernel(module="unique", module_options=module_options(PACKET), enable_backward=False)
    def trace_cosines(
        first_row: int,
        worker: int,
        # in
        tree: FaceTree,
        points: wp.array(dtype=wp.vec3),
        normals: wp.array(dtype=wp.vec3),
        directions: wp.array2d(dtype=Lane),
        shell: wp.vec4,
        # out
        cosines: wp.array2d(dtype=wp.float32),
    ):
        """A thread owns a receiver: its cosines of the rays that escape, 0 of the others."""
        receiver = first_row + wp.tid()
        point = points[receiver]
        normal = normals[receiver]
        last_face = int(-1)
        for packet in range(directions.shape[0]):
            light_directions = Vectors(directions[packet, 0], directions[packet, 1], directions[packet, 2])
            ray_directions = beams_to_light(shell, point, light_directions)
            cosine = cosines_of(shell, normal, light_directions, ray_directions)
            facing_rays = bits_above(cosine, 0.0)
            open_rays, last_face = find_open(tree, point, normal, ray_directions, facing_rays, last_face)
            for lane in range(PACKET):
                is_open = ((open_rays & facing_rays) >> lane) & 1
                cosines[receiver, PACKET * packet + lane] = wp.where(is_open == 1, cosine[lane], 0.0)

    return trace_cosines


def _tree(mesh: wp.Mesh | None, device: wp.Device) -> FaceTree:
    """The hierarchy of a mesh's faces; of none, where nothing blocks the light."""
    if mesh is None:
        return build_face_tree(np.zeros((0, 3)), np.zeros((0, 3), np.int32), device)
    return build_face_tree(mesh.points.numpy(), mesh.indices.numpy().reshape(-1, 3), device)


def trace_transfer(
    mesh: wp.Mesh | None,
    points: wp.array,
    normals: wp.array,
    functions: Callable[[np.ndarray], np.ndarray],
    count: int,
    *,
    shell: np.ndarray = FAR,
    progress: bool = False,
) -> wp.array:
    """Trace transfer vectors: light of a basis is then shadowed by the mesh itself, exactly but for sampling.

    Args:
        mesh, points, normals: As for :func:`warpshadow.stages.rays.ray_tracing.trace_shading`.
        functions: Evaluates the basis functions of the light at unit vectors [direction, 3]: shape [direction,
            coefficient].
        count: Number of directions, evenly over the sphere.
        shell: As for :func:`warpshadow.stages.rays.ray_tracing.trace_shading`.
    Returns:
        Transfer vectors, float32 of shape [receiver, coefficient].
    Differentiable: no.
    """
    directions = fibonacci(-(-count // CHUNK) * CHUNK)
    packets = wp.array(packets_of(directions), dtype=lane_type(PACKET), device=points.device)
    values = (4 / len(directions) * functions(directions)).astype(np.float32)
    transfer = np.empty((points.shape[0], values.shape[1]), np.float32)
    tree = _tree(mesh, points.device)
    for receivers in progress_slices(points.shape[0], 2**22 // len(directions), progress):
        shape = receivers.stop - receivers.start, len(directions)
        cosines = empty(shape, dtype=wp.float32, device=points.device)
        inputs = [tree, points[receivers], normals[receivers], packets, wp.vec4(*shell)]
        launch(
            _make_trace_cosines(bool(shell[3])), shape[0], inputs=inputs, outputs=[cosines], cost=_RAY_COST * shape[1]
        )
        transfer[receivers] = cosines.numpy() @ values
    return wp.array(transfer, device=points.device)
