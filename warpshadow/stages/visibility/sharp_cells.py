"""Sharp cells: cells whose light comes from a spot much smaller than they are, as a sun's.

Where nothing is known of the light in a cell, the soft edge of a shadow, w = κρ, is as wide as cells ask for. A spot of
half-angle s has a penumbra of ±s. So a sharp cell gets the edge of cells of radius ρ = 2.4 s: at κ = 0.35 it is ±0.84
s, a smoothstep about as steep as that penumbra. κ scales it as it does all edges. The transmittance T′ of sharp cells
is found by itself, and blended with their first, T, by the share σ of the cell's light that is the spot's:

    T ← T + σ (T′ − T)

Around a sun the sky is bright: 7% of the light of its cell. By σ = 1 the spot of a sun on the floor of a closed room
was 4% too bright, and a ball above it, which sees that sky and not the sun, 15% too dark.
"""

from typing import NamedTuple

import numpy as np
import warp as wp

from warpshadow.device.constants import constant
from warpshadow.device.launch import differentiable, launch, varies
from warpshadow.device.parallel import split_row
from warpshadow.maths.directions import CHUNK, MIN_WIDTH, brightest_chunk, cell_radius
from warpshadow.stages.visibility.directional import SOFTNESS

SHARP_CELL_RADII = 2.4
"""Radius of the cell whose soft edge is like a spot's penumbra, in half-angles of the spot."""

_MIN_SHARE = 0.1  # share of all light that sharp cells have at least: less is not worth their time

WIDEST_PAST_PLANES = 1.7
"""Radius up to which cells are sharp where planes block them, in radii of all cells: their edges are 0.6 times as wide
at κ = 0.35."""

_MIN_RADIUS = cell_radius(2048)
"""Radius [rad] down to which cells are sharp: an edge of ±0.9° at κ = 0.35, sharper than shadows of spheres are."""

_CELL_COST = 5.0  # nanoseconds that a sharp cell takes


class SharpCells(NamedTuple):
    """Sharp cells.

    Args:
        directions: Unit vectors to where their light comes from, some repeated: [16, 3].
        places: Index of each cell among them, −1 for cells that are not sharp: [direction].
        scale: Radius of the cells that their edges go by, in radii of one of 16 cells.
    """

    directions: np.ndarray
    places: np.ndarray
    scale: float


def find_sharp_cells(
    power: np.ndarray, directions: np.ndarray, spreads: np.ndarray, softness: float = SOFTNESS, widest: float = 1.0
) -> SharpCells | None:
    """Find the sharp cells of a light, at most the brightest 16; None where they have too little of it.

    Args:
        power: Light of each cell [direction].
        directions: Unit vectors to where it comes from [direction, 3].
        spreads: Half-angles s of the spots it comes from [radians], [direction].
        softness: κ, by which edges become no narrower than a falloff may be.
        widest: Radius up to which cells are sharp, in radii of all cells.
    """
    radii = np.maximum(SHARP_CELL_RADII * spreads, max(_MIN_RADIUS, 1.001 * MIN_WIDTH / softness))
    is_small = radii < widest * cell_radius(len(power))
    cells, repeated, places = brightest_chunk(power, is_small & (power > 0))
    if power[cells].sum() <= _MIN_SHARE * power.sum():
        return None
    radius = np.sqrt(np.average(radii[cells] ** 2, weights=power[cells]))
    return SharpCells(directions[cells[repeated]], places, float(radius / cell_radius(CHUNK)))


@wp.kernel(enable_backward=False)
def _blend_sharp_cells(
    first_row: int,
    worker: int,
    # in
    sharp_cells: wp.array3d(dtype=wp.float32),
    pairs: wp.array(dtype=wp.vec2i),
    shares: wp.array(dtype=wp.float32),
    # out
    passing: wp.array3d(dtype=wp.float32),
):
    """A thread owns a receiver; a pair is a sharp cell and its place."""
    batch, receiver = split_row(first_row + wp.tid(), passing.shape[1])
    for i in range(pairs.shape[0]):
        cell = pairs[i][0]
        sharp = sharp_cells[batch, receiver, pairs[i][1]]
        passing[batch, receiver, cell] = shares[i] * sharp + (1.0 - shares[i]) * passing[batch, receiver, cell]


@wp.kernel(enable_backward=False)
def _blend_sharp_cells_adjoint(
    first_row: int,
    worker: int,
    # in
    pairs: wp.array(dtype=wp.vec2i),
    shares: wp.array(dtype=wp.float32),
    # out
    adj_blended: wp.array3d(dtype=wp.float32),
    adj_sharp: wp.array3d(dtype=wp.float32),
    adj_passing: wp.array3d(dtype=wp.float32),
):
    """A thread owns a receiver: a cell's previous value counts for the rest."""
    batch, receiver = split_row(first_row + wp.tid(), adj_blended.shape[1])
    for i in range(pairs.shape[0]):
        cell = pairs[i][0]
        place = pairs[i][1]
        adj = adj_blended[batch, receiver, cell]
        adj_sharp[batch, receiver, place] = adj_sharp[batch, receiver, place] + shares[i] * adj
        adj_blended[batch, receiver, cell] = (1.0 - shares[i]) * adj
    if adj_passing:
        for cell in range(adj_blended.shape[2]):
            adj_passing[batch, receiver, cell] = adj_passing[batch, receiver, cell] + adj_blended[batch, receiver, cell]


def blend_sharp_cells(
    passing: wp.array, sharp_cells: wp.array, places: np.ndarray, shares: np.ndarray | None = None
) -> wp.array:
    """Blend sharp cells into all; in place, unless the adjoint of ``passing`` needs it: call before anything reads it.

    A copy of all cells takes as long as to shade them.

    Args:
        passing: Transmittance of all cells, float32 of shape [batch, receiver, direction]; it may be changed.
        sharp_cells: That of :attr:`SharpCells.directions`, float32 of shape [batch, receiver, 16].
        places: Of :class:`SharpCells`.
        shares: σ, the share of each cell's light that its spot has [direction]; None for 1.
    Returns:
        float32 of shape [batch, receiver, direction].
    Differentiable: passing, sharp_cells.
    """
    device, row_count = passing.device, passing.shape[0] * passing.shape[1]
    cells = np.flatnonzero(places >= 0)
    of_spots = np.ones(len(cells)) if shares is None else shares[cells]
    is_copied = varies([passing]) and bool((of_spots < 1).any())
    blended = wp.clone(passing, requires_grad=False) if is_copied else passing
    pairs = constant(np.stack([cells, places[cells]], axis=1), wp.vec2i, device)
    inputs, cost = [pairs, constant(of_spots.astype(np.float32), wp.float32, device)], _CELL_COST * len(cells)
    return differentiable(
        lambda result: launch(
            _blend_sharp_cells, row_count, inputs=[sharp_cells, *inputs], outputs=[result], cost=cost
        ),
        lambda adj: launch(
            _blend_sharp_cells_adjoint,
            row_count,
            inputs=inputs,
            outputs=[adj, sharp_cells.grad, passing.grad if is_copied else None],
            cost=cost,
        ),
        result=blended,
        variables=[passing, sharp_cells],
    )
