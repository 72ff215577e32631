"""Narrow cells: those whose light comes from a spot much smaller than they are, as a sun's.

Where nothing is known of the light in a cell, the soft edge of a shadow, w = κρ, is as wide as cells ask for. A spot of
half-angle s has a penumbra of ±s. So a narrow cell gets the edge of cells of radius ρ = 2.4 s: at κ = 0.35 it is
±0.84 s, a smoothstep about as steep as that penumbra. κ scales it as it does all edges. What passes towards narrow
cells is found by itself, and takes the place of what they had.
"""

from typing import NamedTuple

import numpy as np
import warp as wp

from warpshadow.device.constants import constant
from warpshadow.device.launch import differentiable, launch
from warpshadow.device.parallel import split_row
from warpshadow.maths.directions import CHUNK, LEAST_WIDTH, cell_radius
from warpshadow.stages.visibility.directional import SOFTNESS

_RADII = 2.4
"""Radius of the cell whose soft edge is like a spot's penumbra, in half-angles of the spot."""

_LEAST_SHARE = 0.1
"""Share of all light that narrow cells have at least: less is not worth their time."""

_LEAST_RADIUS = cell_radius(2048)
"""Radius [rad] down to which cells are narrow: an edge of ±0.9° at κ = 0.35, sharper than shadows of spheres are."""

_CELL_COST = 5.0
"""Nanoseconds that a narrow cell takes."""


class Narrow(NamedTuple):
    """Narrow cells.

    Args:
        directions: Unit vectors to where their light comes from, some repeated: [16, 3].
        places: Where each of all cells is among them, −1 for those that are not narrow: [direction].
        scale: Radius of the cells that their edges go by, in radii of one of 16 cells.
    """

    directions: np.ndarray
    places: np.ndarray
    scale: float


def find_narrow(
    power: np.ndarray, directions: np.ndarray, spreads: np.ndarray, softness: float = SOFTNESS
) -> Narrow | None:
    """Find the narrow cells of a light, at most the brightest 16; None where they have too little of it.

    Args:
        power: Light of each cell [direction].
        directions: Unit vectors to where it comes from [direction, 3].
        spreads: Half-angles s of the spots it comes from [radians], [direction].
        softness: κ, by which edges become no narrower than a falloff may be.
    """
    radii = np.maximum(_RADII * spreads, max(_LEAST_RADIUS, 1.001 * LEAST_WIDTH / softness))
    found = np.flatnonzero((radii < cell_radius(len(power))) & (power > 0))
    found = np.sort(found[np.argsort(-power[found], kind="stable")[:CHUNK]])
    if power[found].sum() <= _LEAST_SHARE * power.sum():
        return None
    repeated = np.arange(CHUNK) * len(found) // CHUNK
    places = np.full(len(power), -1, np.int32)
    places[found] = np.searchsorted(repeated, np.arange(len(found)))
    radius = np.sqrt(np.average(radii[found] ** 2, weights=power[found]))
    return Narrow(directions[found[repeated]], places, float(radius / cell_radius(CHUNK)))


@wp.kernel(enable_backward=False)
def _put_narrow(
    first_row: int,
    worker: int,
    # in
    narrow: wp.array3d(dtype=wp.float32),
    pairs: wp.array(dtype=wp.vec2i),
    # out
    passing: wp.array3d(dtype=wp.float32),
):
    """A thread owns a receiver; a pair is a narrow cell and its place."""
    batch, receiver = split_row(first_row + wp.tid(), passing.shape[1])
    for i in range(pairs.shape[0]):
        passing[batch, receiver, pairs[i][0]] = narrow[batch, receiver, pairs[i][1]]


@wp.kernel(enable_backward=False)
def _put_narrow_adjoint(
    first_row: int,
    worker: int,
    # in
    pairs: wp.array(dtype=wp.vec2i),
    # out
    adj_passing: wp.array3d(dtype=wp.float32),
    adj_narrow: wp.array3d(dtype=wp.float32),
):
    """A thread owns a receiver: what a cell had before does not matter any more."""
    batch, receiver = split_row(first_row + wp.tid(), adj_passing.shape[1])
    for i in range(pairs.shape[0]):
        cell = pairs[i][0]
        place = pairs[i][1]
        adj_narrow[batch, receiver, place] = adj_narrow[batch, receiver, place] + adj_passing[batch, receiver, cell]
        adj_passing[batch, receiver, cell] = 0.0


def put_narrow(passing: wp.array, narrow: wp.array, places: np.ndarray) -> wp.array:
    """Put what passes towards narrow cells in the place of what they had, which nobody may have read.

    A copy of all cells would take as long as to shade them.

    Args:
        passing: Transmittance of all cells, float32 of shape [batch, receiver, direction]; it is changed.
        narrow: That of :attr:`Narrow.directions`, float32 of shape [batch, receiver, 16].
        places: Of :class:`Narrow`.

    Returns:
        ``passing``.

    Differentiable: passing, narrow.
    """
    device, row_count = passing.device, passing.shape[0] * passing.shape[1]
    cells = np.flatnonzero(places >= 0)
    pairs, cost = constant(np.stack([cells, places[cells]], axis=1), wp.vec2i, device), _CELL_COST * len(cells)
    return differentiable(
        lambda result: launch(_put_narrow, row_count, inputs=[narrow, pairs], outputs=[result], cost=cost),
        lambda adj: launch(_put_narrow_adjoint, row_count, inputs=[pairs], outputs=[adj, narrow.grad], cost=cost),
        result=passing,
        variables=[passing, narrow],
    )
