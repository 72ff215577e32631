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

_CELL_COST = 0.4
"""Nanoseconds that a cell takes."""


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
    passing: wp.array3d(dtype=wp.float32),
    narrow: wp.array3d(dtype=wp.float32),
    places: wp.array(dtype=wp.int32),
    # out
    result: wp.array3d(dtype=wp.float32),
):
    """A thread owns a receiver."""
    batch, receiver = split_row(first_row + wp.tid(), result.shape[1])
    for cell in range(result.shape[2]):
        place = places[cell]
        if place < 0:
            result[batch, receiver, cell] = passing[batch, receiver, cell]
        else:
            result[batch, receiver, cell] = narrow[batch, receiver, place]


@wp.kernel(enable_backward=False)
def _put_narrow_adjoint(
    first_row: int,
    worker: int,
    # in
    places: wp.array(dtype=wp.int32),
    adj_result: wp.array3d(dtype=wp.float32),
    # out
    adj_passing: wp.array3d(dtype=wp.float32),
    adj_narrow: wp.array3d(dtype=wp.float32),
):
    """A thread owns a receiver."""
    batch, receiver = split_row(first_row + wp.tid(), adj_result.shape[1])
    for cell in range(adj_result.shape[2]):
        place = places[cell]
        if place < 0:
            adj_passing[batch, receiver, cell] += adj_result[batch, receiver, cell]
        else:
            adj_narrow[batch, receiver, place] += adj_result[batch, receiver, cell]


def put_narrow(passing: wp.array, narrow: wp.array, places: np.ndarray) -> wp.array:
    """Put what passes towards narrow cells in the place of what they had.

    Args:
        passing: Transmittance of all cells, float32 of shape [batch, receiver, direction].
        narrow: That of :attr:`Narrow.directions`, float32 of shape [batch, receiver, 16].
        places: Of :class:`Narrow`.

    Returns:
        Transmittance of the shape of ``passing``.

    Differentiable: passing, narrow.
    """
    device, row_count = passing.device, passing.shape[0] * passing.shape[1]
    table, cost = constant(places, wp.int32, device), _CELL_COST * passing.shape[2]
    return differentiable(
        lambda result: launch(_put_narrow, row_count, inputs=[passing, narrow, table], outputs=[result], cost=cost),
        lambda adj_result: launch(
            _put_narrow_adjoint,
            row_count,
            inputs=[table, adj_result],
            outputs=[passing.grad, narrow.grad],
            cost=2 * cost,
        ),
        result=wp.empty(passing.shape, dtype=wp.float32, device=device),
        variables=[passing, narrow],
    )
