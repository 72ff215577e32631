"""Beams between points within a shell and the shell, a sphere of center c and radius R, kept as (c, R).

A small solid angle dω around a direction d from the center is the area R² dω of the shell at y = c + R d. A receiver x
sees it in the direction b / |b|, b = y − x, as the solid angle w dω,

    w = R² max(d·b, 0) / |b|³.

A radius of 0 stands for light from infinitely far away, where the direction is d and w is 1.
"""

import numpy as np
import warp as wp

from warpshadow import check
from warpshadow.device.array_checks import finite_arrays
from warpshadow.device.batch import common_batch, instance_in
from warpshadow.device.constants import constant
from warpshadow.device.cuda_graph import is_readable
from warpshadow.device.launch import launch
from warpshadow.device.memory import empty, reshaped

MIN_DISTANCE = 1.0e-6  # between a receiver and the shell, in radii, nearer than which light no longer grows

FAR = np.zeros(4, np.float32)  # the shell of light from infinitely far away

wp.set_module_options({"max_unroll": 1})


@wp.func
def center_of(shell: wp.vec4):
    """Center of a shell."""
    return wp.vec3(shell[0], shell[1], shell[2])


@wp.func
def beam_to_shell(shell: wp.vec4, point: wp.vec3, direction: wp.vec3):
    """Direction from a point to the shell's point in a direction from its center, and the factor w, as a vec4."""
    beam = direction
    weight = float(1.0)
    if shell[3] > 0.0:
        beam = center_of(shell) + shell[3] * direction - point
        distance = wp.max(wp.length(beam), MIN_DISTANCE * shell[3])
        beam = beam / distance
        relative_radius = shell[3] / distance
        weight = relative_radius * relative_radius * wp.max(wp.dot(direction, beam), 0.0)
    return wp.vec4(beam[0], beam[1], beam[2], weight)


@wp.kernel
def _find_exits(
    # in
    points: wp.array3d(dtype=wp.vec3),
    directions: wp.array3d(dtype=wp.vec3),
    shell: wp.array(dtype=wp.vec4),
    # out
    exits: wp.array3d(dtype=wp.vec3),
):
    """A thread owns a ray: the root of |x + t ω − c| = R in front of it."""
    batch, receiver, i = wp.tid()
    instance_shell = shell[instance_in(batch, shell.shape[0])]
    point = points[instance_in(batch, points.shape[0]), receiver, instance_in(i, points.shape[2])]
    offset = point - center_of(instance_shell)
    direction = directions[instance_in(batch, directions.shape[0]), receiver, i]
    projection = wp.dot(offset, direction)
    square = projection * projection - wp.dot(offset, offset) + instance_shell[3] * instance_shell[3]
    exits[batch, receiver, i] = wp.normalize(offset + (wp.sqrt(wp.max(square, 0.0)) - projection) * direction)


def exits_from_shell(points: wp.array, directions: wp.array, shell: wp.array) -> wp.array:
    """Directions from the center of a shell to where rays meet it.

    Args:
        points: Where rays start, within the shell [scene units], vec3 of shape [batch, receiver], or of each ray,
            [batch, receiver, ray].
        directions: Of the rays, unit vectors, vec3 of shape [batch, receiver, ray].
        shell: Center and radius [scene units], vec4 of shape [batch].
    Returns:
        Unit vectors, vec3 of shape [batch, receiver, ray].
    Differentiable: points, directions, shell.
    """
    if points.ndim == 2:
        points = reshaped(points, (*points.shape, 1))
    count = common_batch({"points": points, "directions": directions, "shell": shell})
    exits = empty((count, *directions.shape[1:]), dtype=wp.vec3, device=directions.device)
    launch(_find_exits, exits.shape, inputs=[points, directions, shell], outputs=[exits])
    return exits


def exits_on_host(points: np.ndarray, directions: np.ndarray, shell: np.ndarray) -> np.ndarray:
    """Exits of rays in NumPy, [..., 3], with broadcasting; a ray that misses the shell leaves it where it is nearest.

    Args:
        shell: Center and radius, shape [4].
    """
    offset = points - shell[:3]
    projection = (offset * directions).sum(axis=-1, keepdims=True)
    square = projection**2 - (offset**2).sum(axis=-1, keepdims=True) + shell[3] ** 2
    exits = offset + (np.sqrt(np.maximum(square, 0)) - projection) * directions
    return exits / np.linalg.norm(exits, axis=-1, keepdims=True)


def shell_array(shell: np.ndarray, device: wp.DeviceLike) -> wp.array:
    """A shell, its center and radius [4], as kernels take it, vec4 of shape [1]."""
    return constant(shell[None], wp.vec4, device)


def check_shell(shell: wp.array) -> None:
    """Raise ValueError unless an array is one of shells: finite, of positive radii."""
    check.shape("shell", shell.shape, ("batch",), "center and radius")
    finite_arrays({"shell": shell})
    if is_readable(shell.device) and (shell.numpy()[:, 3] <= 0).any():
        raise ValueError(f"shell: got a radius of {shell.numpy()[:, 3].min():.4g}, expected radii above 0")


def check_within(points: wp.array, shell: wp.array) -> None:
    """Raise ValueError where points, vec3 of shape [batch, receiver], are outside of their shells, if that is known."""
    if not (points.size and is_readable(points.device)):
        return
    shells = shell.numpy()
    offsets = points.numpy() - shells[:, None, :3]
    distance = np.sqrt(np.einsum("brk,brk->br", offsets, offsets).max(axis=1) / shells[:, 3] ** 2).max()
    if distance > 1:
        raise ValueError(
            f"shell: got receivers {distance:.4g} radii from its center, expected all bodies inside, at most one: a "
            "larger radius, or bodies that stay within it"
        )
