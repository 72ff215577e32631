"""A body's visibility of itself, traced once in its own frame: a bit for each ray, and means over compact cells.

Rays leave in D Fibonacci directions. Each run of 8 of them is a coarse cell, which keeps the share of its rays that
escape, weighted with their cosines. A ray below the horizon of its site takes the fate of the ray mirrored at the
tangent plane: so a cell at the horizon, half of which is below, is as open as its upper half.

A site takes D/8 bytes of bits and D/8 bytes of cells, 1 kB with 4096 rays; its back takes as much. Of a body whose
sites would so take more than :data:`MOST_MEMORY`, fewer rays are traced.
"""

from typing import NamedTuple

import numpy as np
import warp as wp

from warpshadow.device.launch import launch
from warpshadow.maths.directions import cell_radius, fibonacci
from warpshadow.stages.ray_tracing import RAY_COST, escapes, parts

RAYS = 4096
"""Rays of a site, if memory allows."""

LEAST_RAYS = 256
"""Rays of a site, whatever memory allows."""

RUN = 8
"""Rays of a coarse cell."""

MOST_MEMORY = 2**28
"""Bytes that the rows of a body take at most, as long as sites have :data:`LEAST_RAYS`."""

_MIRRORED = 3.5
"""Angle below the horizon to which rays are mirrored, in radii of a coarse cell: no lookup reaches farther."""


class OwnRows(NamedTuple):
    """What sites, and then their backs, see past their own body.

    Args:
        bits: Whether rays escape, ray r is bit r % 32 of word r / 32: uint32 of shape [row, ray / 32].
        cells: Shares of coarse cells that are open, in 255ths: uint8 of shape [row, ray / 8].
    """

    bits: wp.array
    cells: wp.array

    @property
    def ray_count(self) -> int:
        """Rays of a site."""
        return 32 * self.bits.shape[1]


def ray_count(row_count: int) -> int:
    """Rays of a site of a body with so many rows, a power of two."""
    count = RAYS
    while count > LEAST_RAYS and row_count * count // 4 > MOST_MEMORY:
        count //= 2
    return count


@wp.kernel(enable_backward=False)
def _trace_rows(
    first_row: int,
    worker: int,
    # in
    mesh: wp.uint64,
    points: wp.array(dtype=wp.vec3),
    normals: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    lowest: float,
    # out
    bits: wp.array2d(dtype=wp.uint32),
    cells: wp.array2d(dtype=wp.uint8),
):
    """A thread owns a row."""
    row = first_row + wp.tid()
    point = points[row]
    normal = normals[row]
    for word in range(bits.shape[1]):
        found = wp.uint32(0)
        for cell in range(4):
            passing = float(0.0)
            total = float(0.0)
            for i in range(8):
                toward = directions[32 * word + 8 * cell + i]
                cosine = wp.dot(normal, toward)
                if cosine > -lowest:
                    up = toward
                    if cosine < 0.0:
                        up = toward - 2.0 * cosine * normal
                    total += wp.abs(cosine)
                    if escapes(mesh, point, normal, up):
                        passing += wp.abs(cosine)
                        found |= wp.uint32(1) << wp.uint32(8 * cell + i)
            share = float(1.0)
            if total > 0.0:
                share = passing / total
            cells[row, 4 * word + cell] = wp.uint8(int(255.0 * share + 0.5))
        bits[row, word] = found


def trace_rows(
    mesh: wp.Mesh, points: np.ndarray, normals: np.ndarray, count: int = RAYS, *, progress: bool = False
) -> OwnRows:
    """Trace what points on a mesh see past it.

    Args:
        mesh: The mesh, in the frame of the points.
        points: Sites, [row, 3].
        normals: Unit normals [row, 3].
        count: Rays of a site, from :func:`ray_count`.
        progress: Show a progress bar where it takes longer than a second.

    Differentiable: no.
    """
    device, row_count = mesh.points.device, len(points)
    places, facing = (wp.array(values, dtype=wp.vec3, device=device) for values in (points, normals))
    directions = wp.array(fibonacci(count), dtype=wp.vec3, device=device)
    rows = OwnRows(
        wp.empty((row_count, count // 32), dtype=wp.uint32, device=device),
        wp.empty((row_count, count // RUN), dtype=wp.uint8, device=device),
    )
    lowest = float(np.sin(min(_MIRRORED * cell_radius(count // RUN), np.pi / 2)))
    for part in parts(row_count, 2**21 // count, progress):
        launch(
            _trace_rows,
            part.stop - part.start,
            inputs=[mesh.id, places[part], facing[part], directions, lowest],
            outputs=[array[part] for array in rows],
            cost=RAY_COST * count / 2,
        )
    return rows
