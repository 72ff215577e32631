"""A body's visibility of itself, traced once in its own frame: a bit for each ray, and means over compact cells.

Rays leave in D Fibonacci directions. Each run of 8 of them is a coarse cell, which keeps the share of its rays that
escape, weighted with their cosines. A ray below the horizon of its probe takes the fate of the ray that is nearest to
it mirrored at the tangent plane: so a cell at the horizon, half of which is below, is as open as its upper half.

A probe takes D/8 bytes of bits and D/8 bytes of cells, 1 kB with 4096 rays; its back takes as much. Of a body whose
probes would so take more than :data:`MAX_MEMORY`, fewer rays are traced.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import warp as wp

from warpshadow.device.lanes import lane_type, make_lane_functions, module_options, vectors_type
from warpshadow.device.launch import launch
from warpshadow.device.memory import empty, zeros
from warpshadow.maths.directions import cell_radius, fibonacci
from warpshadow.stages.ray_packets import PACKET, FaceTree, make_find_open, packets_of
from warpshadow.stages.ray_tracing import progress_slices

RAYS = 4096  # rays of a probe, if memory allows
MIN_RAYS = 256  # rays of a probe, for any amount of memory
RUN = 8  # rays of a coarse cell
MAX_MEMORY = 2**28  # bytes that the rows of a body take at most, as long as probes have :data:`MIN_RAYS`

_MIRRORED = 3.5
"""Angle below the horizon to which rays are mirrored, in radii of a coarse cell: no lookup reaches farther."""

_LEVEL = 2.0
"""Angle below the horizon, in radii of a ray's cell, to which mirrored rays are traced: none above may be near."""

_GRID = 128  # rows of the map of directions, each 1.4° high, that has the nearest ray
_BLOCK = 2**22  # rays that are traced between two states of a progress bar
_RAY_COST = 30.0  # nanoseconds that a ray takes


def trace_seconds(row_count: int, face_count: int) -> float:
    """How long :func:`trace_rows` takes, about, on one thread [s].

    Measured on a Zen 4, of a bunny of 12 200 faces 89 ns a ray; of wavy balls of 20 000, 82 000 and 330 000 faces 130,
    200 and 280.
    """
    return 1.3e-7 * (max(face_count, 1) / 20_000) ** 0.27 * row_count * ray_count(row_count)


class VisibilityRows(NamedTuple):
    """Self-visibility of the probes, and then of their backs.

    Args:
        bits: Whether rays escape, ray r is bit r % 32 of word r / 32: uint32 of shape [row, ray / 32].
        cells: Shares of coarse cells that are open, in 255ths: uint8 of shape [row, ray / 8].
    """

    bits: wp.array
    cells: wp.array

    @property
    def ray_count(self) -> int:
        """Rays of a probe."""
        return 32 * self.bits.shape[1]

    def dilated(self, dilation: np.ndarray) -> "VisibilityRows":
        """Rows that copy other rows; numbers of rows, [row]."""
        device = self.bits.device
        return VisibilityRows(*(wp.array(array.numpy()[dilation], device=device) for array in self))


def ray_count(row_count: int) -> int:
    """Rays of a probe of a body with so many rows, a power of two."""
    count = RAYS
    while count > MIN_RAYS and row_count * count // 4 > MAX_MEMORY:
        count //= 2
    return count


@wp.func
def _bit(bits: wp.array2d(dtype=wp.uint32), row: int, ray: int):
    """Whether a ray escapes, 1 or 0."""
    return int((bits[row, ray // 32] >> wp.uint32(ray % 32)) & wp.uint32(1))


@functools.cache
def _nearest_rays(count: int) -> np.ndarray:
    """The ray that is nearest to each direction of a map, int32 of shape [row, column]: by polar angle and azimuth."""
    from scipy.spatial import KDTree

    angles = np.pi / _GRID * (np.arange(2 * _GRID) + 0.5)
    polar, azimuth = np.broadcast_arrays(angles[:_GRID, None], angles - np.pi)
    radius = np.sin(polar)
    towards = np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), np.cos(polar)], axis=2)
    return KDTree(fibonacci(count)).query(towards)[1].astype(np.int32)


@functools.cache
def _make_trace() -> wp.Kernel:
    Lane, Vectors, fn = lane_type(PACKET), vectors_type(PACKET), make_lane_functions(PACKET)
    find_open, dot_direction, is_any_above = make_find_open(), fn.dot_direction, fn.is_any_above
    bits_above = fn.bits_above

    @wp.kernel(module="unique", module_options=module_options(PACKET), enable_backward=False)
    def trace_row(
        first_row: int,
        worker: int,
        # in
        tree: FaceTree,
        points: wp.array(dtype=wp.vec3),
        normals: wp.array(dtype=wp.vec3),
        directions: wp.array2d(dtype=Lane),
        lowest: float,
        level: float,
        nearest: wp.array2d(dtype=wp.int32),
        # out
        bits: wp.array2d(dtype=wp.uint32),
    ):
        """A thread owns a row, whose bits are zero before."""
        row = first_row + wp.tid()
        normal = normals[row]
        last = int(-1)
        for packet in range(directions.shape[0]):
            toward = Vectors(directions[packet, 0], directions[packet, 1], directions[packet, 2])
            cosine = dot_direction(normal, toward)
            if is_any_above(cosine, -level):
                facing_rays = bits_above(cosine, -level)
                for lane in range(PACKET):
                    cosine[lane] = 2.0 * wp.min(cosine[lane], 0.0)
                toward.x -= normal[0] * cosine
                toward.y -= normal[1] * cosine
                toward.z -= normal[2] * cosine
                at = points[row]
                result = find_open(
                    tree.corners, tree.lowers, tree.uppers, tree.leaf_count, at, normal, toward, facing_rays, last
                )
                last = result[1]
                word = PACKET * packet // 32
                bits[row, word] = bits[row, word] | (wp.uint32(result[0]) << wp.uint32(PACKET * packet % 32))
        for packet in range(directions.shape[0]):
            toward = Vectors(directions[packet, 0], directions[packet, 1], directions[packet, 2])
            cosine = dot_direction(normal, toward)
            if is_any_above(cosine, -lowest):
                for lane in range(PACKET):
                    if cosine[lane] > -lowest and cosine[lane] <= -level:
                        up = wp.vec3(toward.x[lane], toward.y[lane], toward.z[lane]) - 2.0 * cosine[lane] * normal
                        size = float(nearest.shape[0]) / wp.pi
                        i = wp.min(int(size * wp.acos(wp.clamp(up[2], -1.0, 1.0))), nearest.shape[0] - 1)
                        j = wp.clamp(int(size * (wp.atan2(up[1], up[0]) + wp.pi)), 0, nearest.shape[1] - 1)
                        ray = PACKET * packet + lane
                        is_open = wp.uint32(_bit(bits, row, nearest[i, j]))
                        bits[row, ray // 32] = bits[row, ray // 32] | (is_open << wp.uint32(ray % 32))

    return trace_row


@wp.kernel(enable_backward=False)
def _average(
    # in
    normals: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    lowest: float,
    bits: wp.array2d(dtype=wp.uint32),
    # out
    cells: wp.array2d(dtype=wp.uint8),
):
    """A thread owns a coarse cell of a row."""
    row, cell = wp.tid()
    passing = float(0.0)
    total = float(0.0)
    for ray in range(RUN * cell, RUN * cell + RUN):
        cosine = wp.dot(normals[row], directions[ray])
        if cosine > -lowest:
            total += wp.abs(cosine)
            passing += wp.abs(cosine) * float(_bit(bits, row, ray))
    share = float(1.0)
    if total > 0.0:
        share = passing / total
    cells[row, cell] = wp.uint8(int(255.0 * share + 0.5))


def trace_rows(
    tree: FaceTree,
    points: np.ndarray,
    normals: np.ndarray,
    count: int = RAYS,
    *,
    before: np.ndarray | None = None,
    keep: Callable[[wp.array], None] | None = None,
    progress: bool = False,
) -> VisibilityRows:
    """Trace the self-visibility of points on a mesh.

    Args:
        tree: The mesh, in the frame of the points.
        points: Probes, [row, 3].
        normals: Unit normals [row, 3].
        count: Rays of a probe, from :func:`ray_count`.
        before: Bits of the first rows that an interrupted call traced, uint32 of shape [traced row, ray / 32].
        keep: Gets the rows traced so far, after every block of them.
    Differentiable: no.
    """
    device, row_count = tree.corners.device, len(points)
    places, facing = (wp.array(values, dtype=wp.vec3, device=device) for values in (points, normals))
    directions = wp.array(fibonacci(count), dtype=wp.vec3, device=device)
    packets = wp.array(packets_of(fibonacci(count)), dtype=lane_type(PACKET), device=device)
    rows = VisibilityRows(
        zeros((row_count, count // 32), dtype=wp.uint32, device=device),
        empty((row_count, count // RUN), dtype=wp.uint8, device=device),
    )
    lowest = float(np.sin(min(_MIRRORED * cell_radius(count // RUN), np.pi / 2)))
    level = float(np.sin(min(_LEVEL * cell_radius(count), np.pi / 2)))
    nearest = wp.array(_nearest_rays(count), dtype=wp.int32, device=device)
    first = 0
    if before is not None:
        first = len(before)
        wp.copy(rows.bits[:first], wp.array(before, dtype=wp.uint32, device=device))
    for part in progress_slices(row_count, _BLOCK // count, progress, "tracing self-shadows", first=first):
        inputs = [tree, places[part], facing[part], packets, lowest, level, nearest]
        size = part.stop - part.start
        launch(_make_trace(), size, inputs=inputs, outputs=[rows.bits[part]], cost=_RAY_COST * count)
        if keep is not None:
            keep(rows.bits[: part.stop])
    launch(_average, rows.cells.shape, inputs=[facing, directions, lowest, rows.bits], outputs=[rows.cells])
    return rows
