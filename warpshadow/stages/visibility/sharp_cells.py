"""Sharp cells: transmittance of cells whose light comes from a spot much smaller than they are, as a sun's.

    T ← T + σ (T′ − T)

with T the transmittance by edges as wide as cells ask for, w = κρ, T′ that by the edge of cells of radius 2.4 s, s the
half-angle of the spot, and σ the share of the cell's light that is the spot's. A spot has a penumbra of ±s; at κ = 0.35
the edge is ±0.84 s, a smoothstep about as steep. κ scales it as it does all edges.

Without σ a ball in a room that sees the sky around the sun, not the sun, was 15% too dark.
"""

from typing import NamedTuple

import numpy as np
import warp as wp

from warpshadow.device.constants import cached_by_values, constant
from warpshadow.device.launch import any_requires_grad, differentiable, launch
from warpshadow.device.memory import copied
from warpshadow.device.parallel import split_row
from warpshadow.maths.directions import CHUNK, MIN_WIDTH, brightest_chunk, cell_radius
from warpshadow.stages.visibility.directional import SOFTNESS

RADII_PER_HALF_ANGLE = 2.4  # radius of the cell whose soft edge is like a spot's penumbra, in half-angles of the spot

_MIN_SHARE = 0.1  # share of all light that sharp cells have at least: less is not worth their time

MAX_RADIUS_PAST_PLANES = 1.7
"""Radius up to which cells are sharp where planes block them, in radii of all cells: their edges are 0.6 times as wide
at κ = 0.35."""

_MIN_RADIUS = cell_radius(2048)
"""Radius [rad] down to which cells are sharp: an edge of ±0.9° at κ = 0.35, sharper than shadows of spheres are."""

_RECEIVER_COST, _CELL_COST = 40.0, 5.0  # nanoseconds that the cells of a receiver take to be fetched, and a sharp one


class SharpCells(NamedTuple):
    """Sharp cells of a light, and their spots."""

    directions: np.ndarray  # unit vectors to where their light comes from, some repeated: [16, 3]
    slots: np.ndarray  # index of each cell among them, −1 for cells that are not sharp: [direction]
    scale: float  # radius of the cells that their edges go by, in radii of one of 16 cells


def find_sharp_cells(
    power: np.ndarray,
    directions: np.ndarray,
    half_angles: np.ndarray,
    softness: float = SOFTNESS,
    max_radius: float = 1.0,
) -> SharpCells | None:
    """Find the sharp cells of a light, at most the brightest 16; None where they have too little of it.

    Args:
        power: Light of each cell [direction].
        directions: Unit vectors to where it comes from [direction, 3].
        half_angles: Half-angles s of the spots it comes from [radians], [direction].
        softness: κ, by which edges become no narrower than a falloff may be.
        max_radius: Radius up to which cells are sharp, in radii of all cells.
    """
    radii = np.maximum(RADII_PER_HALF_ANGLE * half_angles, max(_MIN_RADIUS, 1.001 * MIN_WIDTH / softness))
    is_small = radii < max_radius * cell_radius(len(power))
    cells, repeated_cells, slots = brightest_chunk(power, is_small & (power > 0))
    if power[cells].sum() <= _MIN_SHARE * power.sum():
        return None
    radius = np.sqrt(np.average(radii[cells] ** 2, weights=power[cells]))
    return SharpCells(directions[cells[repeated_cells]], slots, float(radius / cell_radius(CHUNK)))


@wp.kernel(enable_backward=False)
def _blend_sharp_cells(
    first_row: int,
    worker: int,
    # in
    sharp_cells: wp.array3d(dtype=wp.float32),
    pairs: wp.array(dtype=wp.vec2i),
    spot_shares: wp.array(dtype=wp.float32),
    # out
    transmittance: wp.array3d(dtype=wp.float32),
):
    """A thread owns a receiver; a pair is a sharp cell and its slot."""
    batch, receiver = split_row(first_row + wp.tid(), transmittance.shape[1])
    for i in range(pairs.shape[0]):
        cell = pairs[i][0]
        sharp_transmittance = sharp_cells[batch, receiver, pairs[i][1]]
        transmittance[batch, receiver, cell] = (
            spot_shares[i] * sharp_transmittance + (1.0 - spot_shares[i]) * transmittance[batch, receiver, cell]
        )


@wp.kernel(enable_backward=False)
def _blend_sharp_cells_adjoint(
    first_row: int,
    worker: int,
    # in
    pairs: wp.array(dtype=wp.vec2i),
    spot_shares: wp.array(dtype=wp.float32),
    # out
    adj_blended: wp.array3d(dtype=wp.float32),
    adj_sharp: wp.array3d(dtype=wp.float32),
):
    """A thread owns a receiver. T ← s T′ + (1 − s) T in place has, in this order,  T̄′ += s T̄  and  T̄ ← (1 − s) T̄."""
    batch, receiver = split_row(first_row + wp.tid(), adj_blended.shape[1])
    for i in range(pairs.shape[0]):
        cell = pairs[i][0]
        slot = pairs[i][1]
        adj_cell = adj_blended[batch, receiver, cell]
        adj_sharp[batch, receiver, slot] = adj_sharp[batch, receiver, slot] + spot_shares[i] * adj_cell
        adj_blended[batch, receiver, cell] = (1.0 - spot_shares[i]) * adj_cell


@cached_by_values
def _find_pairs(
    slots: np.ndarray, spot_shares: np.ndarray | None, device: wp.Device
) -> tuple[wp.array, wp.array, bool]:
    """Sharp cells and their slots, the shares of their spots, and whether any is below 1."""
    cells = np.flatnonzero(slots >= 0)
    pair_shares = np.ones(len(cells)) if spot_shares is None else spot_shares[cells]
    pairs = constant(np.stack([cells, slots[cells]], axis=1), wp.vec2i, device)
    return pairs, constant(pair_shares.astype(np.float32), wp.float32, device), bool((pair_shares < 1).any())


def blend_sharp_cells(
    transmittance: wp.array, sharp_cells: wp.array, slots: np.ndarray, spot_shares: np.ndarray | None = None
) -> wp.array:
    """Blend sharp cells into all; in place, unless the adjoint of ``transmittance`` needs it: call before anything
    reads it.

    A copy of all cells takes as long as to shade them.

    Args:
        transmittance: Transmittance of all cells, float32 of shape [batch, receiver, direction]; it may be changed.
        sharp_cells: That of :attr:`SharpCells.directions`, float32 of shape [batch, receiver, 16].
        slots: Of :class:`SharpCells`.
        spot_shares: σ, the share of each cell's light that its spot has [direction]; None for 1.
    Returns:
        float32 of shape [batch, receiver, direction].
    Differentiable: transmittance, sharp_cells.
    """
    row_count = transmittance.shape[0] * transmittance.shape[1]
    pairs, pair_shares, is_partial = _find_pairs(slots, spot_shares, transmittance.device)
    is_copied = is_partial and any_requires_grad([transmittance])
    blended = transmittance
    if is_copied:
        blended = copied(transmittance)
        blended.grad = transmittance.grad  # which is changed in place, as the values else are
    inputs, cost = [pairs, pair_shares], _RECEIVER_COST + _CELL_COST * pairs.size
    return differentiable(
        lambda result: launch(
            _blend_sharp_cells, row_count, inputs=[sharp_cells, *inputs], outputs=[result], cost=cost
        ),
        lambda adj_blended: launch(
            _blend_sharp_cells_adjoint, row_count, inputs=inputs, outputs=[adj_blended, sharp_cells.grad], cost=cost
        ),
        result=blended,
        variables=[transmittance, sharp_cells],
    )
