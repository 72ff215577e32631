"""Sparse matrices multiplied with colors: patches from patch samples, receivers from patches, patches from texels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import warp as wp

from warpshadow import check
from warpshadow.device.batch import accumulate, common_batch, expand
from warpshadow.device.launch import differentiable, launch
from warpshadow.device.memory import empty
from warpshadow.device.parallel import split_row

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix, sparray, spmatrix

_ENTRY_COST, _ROW_COST = 2.5, 4.0  # nanoseconds that an entry takes, and a row beside
_RUN = 32  # rows that a thread owns on a CPU, where starting one takes longer than a row of a few entries


class Entries(NamedTuple):
    """Entries of a sparse matrix, row after row."""

    starts: wp.array  # [row + 1] int32
    columns: wp.array  # [entry] int32
    weights: wp.array  # [entry] float32


@dataclass(frozen=True, eq=False)
class SparseMatrix:
    """A matrix by its rows, and by its columns for the adjoint, which so needs no sums across threads.

    Args:
        shape: Number of rows and columns.
        rows: Its entries by rows.
        columns: The rows of its transpose.
    """

    shape: tuple[int, int]
    rows: Entries
    columns: Entries

    @staticmethod
    def of(matrix: np.ndarray | spmatrix | sparray, *, device: wp.DeviceLike) -> SparseMatrix:
        """Give a matrix of SciPy, or NumPy, to a device, without its zeros."""
        from scipy.sparse import csr_matrix

        by_rows = csr_matrix(matrix, copy=True)
        return SparseMatrix(by_rows.shape, _entries(by_rows, device), _entries(by_rows.T.tocsr(), device))

    def on_host(self) -> csr_matrix:
        """The matrix of SciPy."""
        from scipy.sparse import csr_matrix

        starts, columns, weights = (array.numpy() for array in self.rows)
        return csr_matrix((weights, columns, starts), self.shape)


def _entries(matrix: csr_matrix, device: wp.DeviceLike) -> Entries:
    matrix.eliminate_zeros()
    return Entries(
        wp.array(matrix.indptr, dtype=wp.int32, device=device),
        wp.array(matrix.indices, dtype=wp.int32, device=device),
        wp.array(matrix.data, dtype=wp.float32, device=device),
    )


@wp.kernel(enable_backward=False)
def _multiply(
    first_row: int,
    worker: int,
    # in
    starts: wp.array(dtype=wp.int32),
    columns: wp.array(dtype=wp.int32),
    weights: wp.array(dtype=wp.float32),
    values: wp.array2d(dtype=wp.vec3),
    plus: wp.array2d(dtype=wp.vec3),
    run: int,
    # out
    products: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a run of rows of an instance: their products, added to a term, which may be the previous values."""
    row_count = starts.shape[0] - 1
    batch, thread = split_row(first_row + wp.tid(), (row_count + run - 1) // run)
    of_instance = values[batch]
    for row in range(thread * run, wp.min((thread + 1) * run, row_count)):
        total = wp.vec3()
        if plus:
            total = plus[batch, row]
        for entry in range(starts[row], starts[row + 1]):
            total += weights[entry] * of_instance[columns[entry]]
        products[batch, row] = total


def multiply(matrix: SparseMatrix, values: wp.array, *, plus: wp.array | None = None) -> wp.array:
    """Multiply a sparse matrix with colors.

    Args:
        matrix: Of shape [row, column].
        values: vec3 of shape [batch, column].
        plus: Added to the product, vec3 of shape [batch, row].
            Either batch may be 1 and then serves every instance of the other.
    Returns:
        vec3 of shape [batch, row].
    Differentiable: values, plus. Exact, being linear. Not: the matrix.
    """
    check.shape("values", values.shape, ("batch", matrix.shape[1]))
    if plus is not None:
        check.shape("plus", plus.shape, ("batch", matrix.shape[0]))
        count = common_batch({"values": values, "plus": plus})
        values, plus = expand(values, count), expand(plus, count)

    def times(entries: Entries, factors: wp.array, plus: wp.array | None, products: wp.array) -> None:
        batch_count, row_count = products.shape
        run = 1 if products.device.is_cuda else _RUN
        cost = run * (_ENTRY_COST * entries.columns.size / max(row_count, 1) + _ROW_COST)
        inputs = [*entries, factors, plus, run]
        launch(_multiply, batch_count * -(-row_count // run), inputs=inputs, outputs=[products], cost=cost)

    def adjoint(adj_products: wp.array) -> None:
        if values.requires_grad:
            times(matrix.columns, adj_products, values.grad, values.grad)
        if plus is not None and plus.requires_grad:
            accumulate(adj_products, plus.grad)

    return differentiable(
        lambda products: times(matrix.rows, values, plus, products),
        adjoint,
        result=empty((values.shape[0], matrix.shape[0]), dtype=wp.vec3, device=values.device),
        variables=[values, plus],
    )
