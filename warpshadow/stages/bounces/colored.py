"""Colored transfer: free light at receivers after bounces, by a matrix for each color.

    I_x = Σ_k T_xk ∘ L_k      for red, green and blue

Bodies reflect colors, so T has three numbers where transfer vectors of direct light have one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp

from warpshadow import check
from warpshadow.device.launch import differentiable, launch
from warpshadow.device.memory import as_items, empty
from warpshadow.device.parallel import split_row

_COEFFICIENT_COST, _ROW_COST = 1.0, 8.0  # nanoseconds that a coefficient of a receiver takes, and a receiver beside


@dataclass(frozen=True, eq=False)
class ColoredTransfer:
    """Transfer of each color, and its transpose for the adjoint, which so needs no sums across threads."""

    rows: wp.array  # vec3 of shape [receiver, coefficient]
    columns: wp.array  # vec3 of shape [coefficient, receiver]

    @staticmethod
    def from_lit_receivers(lit_receivers: np.ndarray, *, device: wp.DeviceLike) -> ColoredTransfer:
        """Make it of the light that each coefficient alone sends to receivers, float32 [coefficient, receiver, 3]."""
        columns = wp.array(lit_receivers, dtype=wp.vec3, device=device)
        return ColoredTransfer(wp.array(lit_receivers.swapaxes(0, 1), dtype=wp.vec3, device=device), columns)


Quad = wp.types.vector(length=12, dtype=wp.float32)
"""Four colors after one another, which take a third of the time of four by themselves."""


@wp.kernel(enable_backward=False)
def _multiply(
    first_row: int,
    worker: int,
    # in
    matrix: wp.array2d(dtype=wp.vec3),
    matrix_quads: wp.array2d(dtype=Quad),
    values: wp.array2d(dtype=wp.vec3),
    value_quads: wp.array2d(dtype=Quad),
    addend: wp.array2d(dtype=wp.vec3),
    # out
    products: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a row of an instance: its product, added to a term, which may be the previous value."""
    batch, row = split_row(first_row + wp.tid(), matrix.shape[0])
    quads = Quad(0.0)
    for quad in range(matrix_quads.shape[1]):
        quads += wp.cw_mul(matrix_quads[row, quad], value_quads[batch, quad])
    product = wp.vec3(
        (quads[0] + quads[3]) + (quads[6] + quads[9]),
        (quads[1] + quads[4]) + (quads[7] + quads[10]),
        (quads[2] + quads[5]) + (quads[8] + quads[11]),
    )
    for column in range(4 * matrix_quads.shape[1], matrix.shape[1]):
        product += wp.cw_mul(matrix[row, column], values[batch, column])
    if addend:
        product += addend[batch, row]
    products[batch, row] = product


def colored_light(transfer: ColoredTransfer, light: wp.array) -> wp.array:
    """Light receivers by coefficients.

    Args:
        light: Coefficients of the light, linear RGB, vec3 of shape [batch, coefficient].
    Returns:
        vec3 of shape [batch, receiver].
    Differentiable: light. Exact, being linear. Not: transfer.
    """
    check.shape("light", light.shape, ("batch", transfer.columns.shape[0]))

    def multiply_rows(matrix: wp.array, values: wp.array, addend: wp.array | None, products: wp.array) -> None:
        cost = _COEFFICIENT_COST * matrix.shape[1] + _ROW_COST
        inputs = [matrix, as_items(matrix, Quad, 4), values, as_items(values, Quad, 4), addend]
        launch(_multiply, products.size, inputs=inputs, outputs=[products], cost=cost)

    return differentiable(
        lambda lit_receivers: multiply_rows(transfer.rows, light, None, lit_receivers),
        lambda adj_receivers: multiply_rows(transfer.columns, adj_receivers, light.grad, light.grad),
        result=empty((len(light), transfer.rows.shape[0]), dtype=wp.vec3, device=light.device),
        variables=[light],
    )
