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
from warpshadow.stages.rays.ray_packets import PACKET, FaceTree, make_find_open, packets_of
from warpshadow.stages.rays.ray_tracing import progress_slices

RAYS = 4096  # rays of a probe, if memory allows
MIN_RAYS = 256  # rays of a probe, for any amount of memory
RAYS_PER_CELL = 8  # rays of a coarse cell
MAX_MEMORY = 2**28  # bytes that the rows of a body take at most, as long as probes have :data:`MIN_RAYS`

_MIRROR_DEPTH = 3.5
"""Angle below the horizon to which rays are mirrored, in radii of a coarse cell: no lookup reaches farther."""

_TRACE_DEPTH = 2.0
"""Angle below the horizon, in radii of a ray's cell, to which mirrored rays are traced: none above may be near."""

_MAP_ROWS = 128  # rows of the map of directions, each 1.4° high, that has the nearest ray
_BLOCK_RAYS = 2**22  # rays that are traced between two states of a progress bar
_RAY_COST = 30.0  # nanoseconds that a ray takes


def trace_seconds(rays: int, face_count: int, *, are_backs: bool = False) -> float:
    """Estimate the time of :func:`trace_rows` on one thread [s].

    Measured on a Zen 4, of bunnies of 12 200 and 69 000 faces 65 and 103 ns a ray, backs of the second 335; of wavy
    balls of 20 000, 82 000 and 330 000 faces 62, 75 and 103, backs, whose rays all meet faces, 267, 450 and 831.
    """
    seconds, exponent = (2.7e-7, 0.4) if are_backs else (8.0e-8, 0.2)
    return seconds * (max(face_count, 1) / 20_000) ** exponent * rays


class VisibilityRows(NamedTuple):
    """Self-visibility of the probes of a body: a row for each, then for each of their backs."""

    bits: wp.array  # whether rays escape, ray r is bit r % 32 of word r / 32: uint32 of shape [row, ray / 32]
    cells: wp.array  # shares of coarse cells that are open, in 255ths: uint8 of shape [row, ray / 8]

    @property
    def ray_count(self) -> int:
        """Number of rays of a probe."""
        return 32 * self.bits.shape[1]

    def fill(self, others: "VisibilityRows", first: int) -> None:
        """Overwrite rows from number ``first`` on by others."""
        for array, other in zip(self, others, strict=True):
            wp.copy(array[first : first + len(other)], other)

    def dilated(self, dilation: np.ndarray) -> "VisibilityRows":
        """Copy row ``dilation[row]`` to each row."""
        device = self.bits.device
        return VisibilityRows(*(wp.array(array.numpy()[dilation], device=device) for array in self))


def ray_count(row_count: int) -> int:
    """Number of rays of a probe if the body has ``row_count`` rows, a power of two."""
    count = RAYS
    while count > MIN_RAYS and row_count * count // 4 > MAX_MEMORY:
        count //= 2
    return count


@wp.func
def _ray_bit(bits: wp.array2d(dtype=wp.uint32), row: int, ray: int):
    """Whether a ray escapes, 1 or 0."""
    return int((bits[row, ray // 32] >> wp.uint32(ray % 32)) & wp.uint32(1))


@functools.cache
def _nearest_rays(count: int) -> np.ndarray:
    """The ray that is nearest to each direction of a map, int32 of shape [row, column]: by polar angle and azimuth."""
    from scipy.spatial import KDTree

    angles = np.pi / _MAP_ROWS * (np.arange(2 * _MAP_ROWS) + 0.5)
    polar, azimuth = np.broadcast_arrays(angles[:_MAP_ROWS, None], angles - np.pi)
    radius = np.sin(polar)
    map_directions = np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), np.cos(polar)], axis=2)
    return KDTree(fibonacci(count)).query(map_directions)[1].astype(np.int32)


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
        mirror_sine: float,
        trace_sine: float,
        nearest_rays: wp.array2d(dtype=wp.int32),
        # out
        bits: wp.array2d(dtype=wp.uint32),
    ):
        """A thread owns a row, whose bits are zero before."""
        row = first_row + wp.tid()
        point = points[row]
        normal = normals[row]
        last_face = int(-1)
        for packet in range(directions.shape[0]):
            ray_directions = Vectors(directions[packet, 0], directions[packet, 1], directions[packet, 2])
            cosine = dot_direction(normal, ray_directions)
            if is_any_above(cosine, -trace_sine):
                facing_rays = bits_above(cosine, -trace_sine)
                for lane in range(PACKET):
                    cosine[lane] = 2.0 * wp.min(cosine[lane], 0.0)
                ray_directions.x -= normal[0] * cosine
                ray_directions.y -= normal[1] * cosine
                ray_directions.z -= normal[2] * cosine
                open_rays, last_face = find_open(tree, point, normal, ray_directions, facing_rays, last_face)
                word = PACKET * packet // 32
                bits[row, word] = bits[row, word] | (wp.uint32(open_rays) << wp.uint32(PACKET * packet % 32))
        for packet in range(directions.shape[0]):
            ray_directions = Vectors(directions[packet, 0], directions[packet, 1], directions[packet, 2])
            cosine = dot_direction(normal, ray_directions)
            if is_any_above(cosine, -mirror_sine):
                for lane in range(PACKET):
                    if cosine[lane] > -mirror_sine and cosine[lane] <= -trace_sine:
                        mirrored = (
                            wp.vec3(ray_directions.x[lane], ray_directions.y[lane], ray_directions.z[lane])
                            - 2.0 * cosine[lane] * normal
                        )
                        rows_per_radian = float(nearest_rays.shape[0]) / wp.pi
                        row_in_map = wp.min(
                            int(rows_per_radian * wp.acos(wp.clamp(mirrored[2], -1.0, 1.0))), nearest_rays.shape[0] - 1
                        )
                        column_in_map = wp.clamp(
                            int(rows_per_radian * (wp.atan2(mirrored[1], mirrored[0]) + wp.pi)),
                            0,
                            nearest_rays.shape[1] - 1,
                        )
                        ray = PACKET * packet + lane
                        is_open = wp.uint32(_ray_bit(bits, row, nearest_rays[row_in_map, column_in_map]))
                        bits[row, ray // 32] = bits[row, ray // 32] | (is_open << wp.uint32(ray % 32))

    return trace_row


@wp.kernel(enable_backward=False)
def _average_cells(
    # in
    normals: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    mirror_sine: float,
    bits: wp.array2d(dtype=wp.uint32),
    # out
    cells: wp.array2d(dtype=wp.uint8),
):
    """A thread owns a coarse cell of a row."""
    row, cell = wp.tid()
    open_weight = float(0.0)
    weight_sum = float(0.0)
    for ray in range(RAYS_PER_CELL * cell, RAYS_PER_CELL * cell + RAYS_PER_CELL):
        cosine = wp.dot(normals[row], directions[ray])
        if cosine > -mirror_sine:
            weight_sum += wp.abs(cosine)
            open_weight += wp.abs(cosine) * float(_ray_bit(bits, row, ray))
    open_share = float(1.0)
    if weight_sum > 0.0:
        open_share = open_weight / weight_sum
    cells[row, cell] = wp.uint8(int(255.0 * open_share + 0.5))


def trace_rows(
    tree: FaceTree,
    points: np.ndarray,
    normals: np.ndarray,
    count: int = RAYS,
    *,
    cached_bits: np.ndarray | None = None,
    store_bits: Callable[[wp.array], None] | None = None,
    progress: bool = False,
) -> VisibilityRows:
    """Trace the self-visibility of points on a mesh.

    Args:
        tree: The mesh, in the frame of the points.
        points: Probes, [row, 3].
        normals: Unit normals [row, 3].
        count: Rays of a probe, from :func:`ray_count`.
        cached_bits: Bits of the first rows that an interrupted call traced, uint32 of shape [traced row, ray / 32].
        store_bits: Gets the rows traced so far, after every block of them.
    Differentiable: no.
    """
    device, row_count = tree.corners.device, len(points)
    point_array, normal_array = (wp.array(values, dtype=wp.vec3, device=device) for values in (points, normals))
    directions = wp.array(fibonacci(count), dtype=wp.vec3, device=device)
    packets = wp.array(packets_of(fibonacci(count)), dtype=lane_type(PACKET), device=device)
    rows = VisibilityRows(
        zeros((row_count, count // 32), dtype=wp.uint32, device=device),
        empty((row_count, count // RAYS_PER_CELL), dtype=wp.uint8, device=device),
    )
    mirror_sine = float(np.sin(min(_MIRROR_DEPTH * cell_radius(count // RAYS_PER_CELL), np.pi / 2)))
    trace_sine = float(np.sin(min(_TRACE_DEPTH * cell_radius(count), np.pi / 2)))
    nearest_rays = wp.array(_nearest_rays(count), dtype=wp.int32, device=device)
    first_row = 0
    if cached_bits is not None:
        first_row = len(cached_bits)
        wp.copy(rows.bits[:first_row], wp.array(cached_bits, dtype=wp.uint32, device=device))
    for row_slice in progress_slices(
        row_count, _BLOCK_RAYS // count, progress, "tracing self-shadows", first=first_row
    ):
        inputs = [tree, point_array[row_slice], normal_array[row_slice], packets, mirror_sine, trace_sine, nearest_rays]
        slice_count = row_slice.stop - row_slice.start
        launch(_make_trace(), slice_count, inputs=inputs, outputs=[rows.bits[row_slice]], cost=_RAY_COST * count)
        if store_bits is not None:
            store_bits(rows.bits[: row_slice.stop])
    launch(
        _average_cells,
        rows.cells.shape,
        inputs=[normal_array, directions, mirror_sine, rows.bits],
        outputs=[rows.cells],
    )
    return rows
