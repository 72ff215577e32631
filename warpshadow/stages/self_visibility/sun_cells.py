"""Sun cells: self-visibility of receivers in the brightest cells, by rays from each.

Between probes the sharp edge of a sun's shadow is interpolated, and has teeth. With ``self_shadows = "rays"`` each
receiver at a pixel, which then has no gradient to a rotation, sends 16 rays ω_r, drawn from the light of the cell, as a
packet in the frame of the body:

    T_self = Σ_r V_r max(n·ω_r, 0) / Σ_r max(n·ω_r, 0)

A receiver is put where the corners of its piece interpolate it to, in the frame of the body.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import warp as wp

from warpshadow.device.batch import common_batch, instance_in
from warpshadow.device.constants import constant
from warpshadow.device.lanes import lane_type, make_lane_functions, module_options, vectors_type
from warpshadow.device.launch import launch
from warpshadow.device.memory import empty
from warpshadow.device.parallel import split_row
from warpshadow.maths.directions import CHUNK, brightest_chunk
from warpshadow.stages.rays.ray_packets import PACKET, FaceTree, make_find_open
from warpshadow.stages.self_visibility.probes import ProbeWeights

_PACKET_COST = 2000.0  # nanoseconds that a packet takes
_MIN_SUN_SHARE = 0.05  # share of all light that a sun cell has at least


class SunCells(NamedTuple):
    """The brightest cells.

    Args:
        directions: Rays to their light, unit vectors of shape [16, 16, 3], with the rays of some cells repeated.
        slots: Index of each cell among them, −1 for cells that are not bright: [direction].
    """

    directions: np.ndarray
    slots: np.ndarray


def find_sun_cells(power: np.ndarray, draw: Callable[[np.ndarray, int], np.ndarray]) -> SunCells | None:
    """Find the sun cells of a light, at most 16; None where it is even.

    Args:
        power: Light of each cell [direction].
        draw: Draws directions from the light of some cells, of their numbers and how many of each: unit vectors [cell,
            count, 3].
    """
    cells, repeated_cells, slots = brightest_chunk(power, power > _MIN_SUN_SHARE * power.sum())
    return SunCells(draw(cells, PACKET)[repeated_cells], slots) if len(cells) else None


class RayProbes(NamedTuple):
    """Points at which rays of a body start."""

    tree: FaceTree  # its faces, in its own frame
    points: wp.array  # of its probes, and then of their backs, vec3 of shape [row]
    normals: wp.array


@functools.cache
def _make_trace() -> wp.Kernel:
    Lane, Vectors, fn = lane_type(PACKET), vectors_type(PACKET), make_lane_functions(PACKET)
    find_open, dot_direction, bits_above = make_find_open(), fn.dot_direction, fn.bits_above

    @wp.kernel(module="unique", module_options=module_options(PACKET), enable_backward=False)
    def trace_sun(
        first_row: int,
        worker: int,
        # in
        tree: FaceTree,
        points: wp.array(dtype=wp.vec3),
        normals: wp.array(dtype=wp.vec3),
        probe_rows: wp.array2d(dtype=wp.vec3i),
        probe_weights: wp.array2d(dtype=wp.vec3),
        rotations: wp.array2d(dtype=wp.mat33),
        body: int,
        directions: wp.array2d(dtype=Lane),
        first_slots: wp.array(dtype=wp.int32),
        # out
        transmittance: wp.array3d(dtype=wp.float32),
    ):
        """A thread owns a receiver. A cell's first slot has its rays, and the others copy it."""
        batch, receiver = split_row(first_row + wp.tid(), transmittance.shape[1])
        rows = probe_rows[instance_in(batch, probe_rows.shape[0]), receiver]
        weights = probe_weights[instance_in(batch, probe_weights.shape[0]), receiver]
        point = wp.vec3()
        normal = wp.vec3()
        for corner in range(3):
            point += weights[corner] * points[rows[corner]]
            normal += weights[corner] * normals[rows[corner]]
        normal = wp.normalize(normal)
        rotation = rotations[instance_in(batch, rotations.shape[0]), body]
        axes = wp.matrix_from_rows(
            wp.normalize(rotation[:, 0]), wp.normalize(rotation[:, 1]), wp.normalize(rotation[:, 2])
        )
        last_face = int(-1)
        for slot in range(first_slots.shape[0]):
            if first_slots[slot] < slot:
                transmittance[batch, receiver, slot] = transmittance[batch, receiver, first_slots[slot]]
            else:
                world_directions = Vectors(directions[slot, 0], directions[slot, 1], directions[slot, 2])
                ray_directions = Vectors(
                    dot_direction(axes[0], world_directions),
                    dot_direction(axes[1], world_directions),
                    dot_direction(axes[2], world_directions),
                )
                cosine = dot_direction(normal, ray_directions)
                open_rays, last_face = find_open(
                    tree, point, normal, ray_directions, bits_above(cosine, 0.0), last_face
                )
                cosine_sum = float(0.0)
                open_cosine_sum = float(0.0)
                for lane in range(PACKET):
                    cosine_sum += wp.max(cosine[lane], 0.0)
                    if (open_rays >> lane) % 2 == 1:
                        open_cosine_sum += cosine[lane]
                transmittance[batch, receiver, slot] = wp.where(cosine_sum > 0.0, open_cosine_sum / cosine_sum, 1.0)

    return trace_sun


def trace_sun_cells(
    probes: RayProbes, probe_weights: ProbeWeights, rotations: wp.array, body: int, cells: SunCells
) -> wp.array:
    """Trace the self-visibility of a body's receivers in sun cells.

    Args:
        rotations: R of each body, mat33 of shape [batch, body].
    Returns:
        Transmittance in [0, 1], float32 of shape [batch, receiver, 16].
    Differentiable: no.
    """
    device, cell_count = rotations.device, int((cells.slots >= 0).sum())
    batch_count = common_batch({"probe_weights": probe_weights.rows, "rotations": rotations})
    transmittance = empty(
        (batch_count, probe_weights.rows.shape[1], len(cells.directions)), dtype=wp.float32, device=device
    )
    direction_lanes = constant(cells.directions.swapaxes(1, 2), lane_type(PACKET), device)
    starts = np.sort(cells.slots[cells.slots >= 0])
    first_slots = constant(starts[np.searchsorted(starts, np.arange(CHUNK), side="right") - 1], wp.int32, device)
    launch(
        _make_trace(),
        batch_count * transmittance.shape[1],
        inputs=[*probes, *probe_weights, rotations, body, direction_lanes, first_slots],
        outputs=[transmittance],
        cost=_PACKET_COST * cell_count,
    )
    return transmittance
