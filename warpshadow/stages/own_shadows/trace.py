"""A body's visibility of itself, traced once in its own frame: a bit for each ray, and means over compact cells.

Rays leave in D Fibonacci directions. Each run of 8 of them is a coarse cell, which keeps the share of its rays that
escape, weighted with their cosines. A ray below the horizon of its site takes the fate of the ray mirrored at the
tangent plane: so a cell at the horizon, half of which is below, is as open as its upper half.

Of each bundle of 4 rays, the one in the middle is traced first, the probe. The others are traced if the 9 probes in and
around the bundle differ; else they take their fate. Two fifths of the rays so find the edges of shadows: of a bunny
0.03% of the bits differ. Rods less than 3° wide, which pass between probes, lose a few percent of their shadows.

A site takes D/8 bytes of bits and D/8 bytes of cells, 1 kB with 4096 rays; its back takes as much. Of a body whose
sites would so take more than :data:`MOST_MEMORY`, fewer rays are traced.
"""

import functools
from typing import NamedTuple

import numpy as np
import warp as wp

from warpshadow.device.launch import launch
from warpshadow.maths.directions import BUNDLE, cell_radius, fibonacci
from warpshadow.stages.ray_tracing import RAY_COST, find_blocker, is_met, parts

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

_PROBES = 9
"""Probes that must agree: a bundle's own and those next to it."""


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

    def lent(self, lenders: np.ndarray) -> "OwnRows":
        """Rows that have what others see; numbers of rows, [row]."""
        device = self.bits.device
        return OwnRows(*(wp.array(array.numpy()[lenders], device=device) for array in self))


def ray_count(row_count: int) -> int:
    """Rays of a site of a body with so many rows, a power of two."""
    count = RAYS
    while count > LEAST_RAYS and row_count * count // 4 > MOST_MEMORY:
        count //= 2
    return count


class _Pass(NamedTuple):
    """Bundles of rays that are traced unless probes agree.

    Args:
        members: Rays of each bundle, first its probe if that is known: int32 of shape [bundle, 4].
        probes: Those that must agree, int32 of shape [bundle, 9]; none in the first pass.
        known: Members whose fate is known before.
    """

    members: np.ndarray
    probes: np.ndarray
    known: int


@functools.cache
def _passes(count: int) -> tuple[_Pass, _Pass]:
    """Find the probes, and then what is between them."""
    directions, members = fibonacci(count), np.arange(count).reshape(-1, BUNDLE)
    cosines = np.einsum("bmx,bx->bm", directions[members], directions[members].sum(axis=1))
    members = np.take_along_axis(members, np.argsort(-cosines, axis=1), axis=1)
    probes = members[:, 0]
    nearest = np.argpartition(-directions[probes] @ directions[probes].T, _PROBES - 1, axis=1)[:, :_PROBES]
    first = probes.reshape(-1, BUNDLE)
    return _Pass(first, np.empty((len(first), 0), int), 0), _Pass(members, probes[nearest], 1)


@wp.func
def _bit(bits: wp.array2d(dtype=wp.uint32), row: int, ray: int):
    """Whether a ray escapes, 1 or 0."""
    return int((bits[row, ray // 32] >> wp.uint32(ray % 32)) & wp.uint32(1))


@wp.kernel(enable_backward=False)
def _trace_pass(
    first_row: int,
    worker: int,
    # in
    mesh: wp.uint64,
    points: wp.array(dtype=wp.vec3),
    normals: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    lowest: float,
    members: wp.array2d(dtype=wp.int32),
    probes: wp.array2d(dtype=wp.int32),
    known: int,
    # out
    bits: wp.array2d(dtype=wp.uint32),
):
    """A thread owns a row, whose bits are zero before the first pass."""
    row = first_row + wp.tid()
    point = points[row]
    normal = normals[row]
    last = int(-1)
    for bundle in range(members.shape[0]):
        count = int(0)
        open_count = int(0)
        for k in range(probes.shape[1]):
            probe = probes[bundle, k]
            if wp.dot(normal, directions[probe]) > -lowest:
                count += 1
                open_count += _bit(bits, row, probe)
        is_open = count > 0 and open_count == count
        is_blocked = count > 0 and open_count == 0
        if not is_blocked:
            for k in range(known, members.shape[1]):
                ray = members[bundle, k]
                toward = directions[ray]
                cosine = wp.dot(normal, toward)
                if cosine > -lowest:
                    blocker = int(-1)
                    if not is_open:
                        up = toward - 2.0 * wp.min(cosine, 0.0) * normal
                        blocker = last  # the likeliest
                        if last < 0 or not is_met(mesh, last, point, normal, up):
                            blocker = find_blocker(mesh, point, normal, up)
                    if blocker < 0:
                        bits[row, ray // 32] = bits[row, ray // 32] | (wp.uint32(1) << wp.uint32(ray % 32))
                    else:
                        last = blocker


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
    passes = [
        (*(wp.array(rays, dtype=wp.int32, device=device) for rays in (step.members, step.probes)), step.known)
        for step in _passes(count)
    ]
    rows = OwnRows(
        wp.zeros((row_count, count // 32), dtype=wp.uint32, device=device),
        wp.empty((row_count, count // RUN), dtype=wp.uint8, device=device),
    )
    lowest = float(np.sin(min(_MIRRORED * cell_radius(count // RUN), np.pi / 2)))
    for part in parts(row_count, 2**21 // count, progress, "tracing own shadows"):
        at, cost = (places[part], facing[part], directions, lowest), RAY_COST * count / 8
        for step in passes:
            launch(_trace_pass, len(at[0]), inputs=[mesh.id, *at, *step], outputs=[rows.bits[part]], cost=cost)
    launch(_average, rows.cells.shape, inputs=[facing, directions, lowest, rows.bits], outputs=[rows.cells])
    return rows
