"""Sparse matrices multiplied with colors: patches from patch samples, receivers from patches, patches from texels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import warp as wp

from warpshadow import check
from warpshadow.device.batch import accumulate, common_batch, expand, instance_in
from warpshadow.device.launch import differentiable, launch
from warpshadow.device.memory import empty
from warpshadow.device.parallel import run_length, split_row

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix, sparray, spmatrix

_ENTRY_COST, _ROW_COST = 2.5, 4.0  # nanoseconds that an entry takes, and a row beside
_RUN = 32  # rows that a thread owns on a CPU, where starting one takes longer than a row of a few entries


class Entries(NamedTuple):
    """Entries of a sparse matrix, row after row."""

    row_starts: wp.array  # [row + 1] int32
    columns: wp.array  # [entry] int32
    weights: wp.array  # [entry] float32


@dataclass(frozen=True, eq=False)
class SparseMatrix:
    """A sparse matrix in compressed rows (CSR), and its transpose for the adjoint, so without sums across threads."""

    shape: tuple[int, int]  # number of rows and columns
    rows: Entries  # its entries by rows
    columns: Entries  # the rows of its transpose

    @property
    def is_zero(self) -> bool:
        """Whether it has no entries."""
        return not self.rows.columns.size

    @staticmethod
    def from_matrix(matrix: np.ndarray | spmatrix | sparray, *, device: wp.DeviceLike) -> SparseMatrix:
        """Copy a matrix of SciPy or NumPy to a device, without its zeros."""
        from scipy.sparse import csr_matrix

        by_rows = csr_matrix(matrix, copy=True)
        return SparseMatrix(by_rows.shape, _entries(by_rows, device), _entries(by_rows.T.tocsr(), device))

    def to_scipy(self) -> csr_matrix:
        """Copy it to a matrix of SciPy."""
        from scipy.sparse import csr_matrix

        row_starts, columns, weights = (array.numpy() for array in self.rows)
        return csr_matrix((weights, columns, row_starts), self.shape)


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
    row_starts: wp.array(dtype=wp.int32),
    columns: wp.array(dtype=wp.int32),
    weights: wp.array(dtype=wp.float32),
    factor_batches: wp.array2d(dtype=wp.vec3),
    column_scales: wp.array2d(dtype=wp.vec3),
    row_scales: wp.array2d(dtype=wp.vec3),
    addend: wp.array2d(dtype=wp.vec3),
    run: int,
    # out
    products: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a run of rows of an instance: their products, added to a term, which may be the previous values."""
    row_count = row_starts.shape[0] - 1
    batch, thread = split_row(first_row + wp.tid(), (row_count + run - 1) // run)
    factors = factor_batches[batch]
    for row in range(thread * run, wp.min((thread + 1) * run, row_count)):
        product = wp.vec3()
        if addend and not row_scales:
            product = addend[batch, row]
        for entry in range(row_starts[row], row_starts[row + 1]):
            factor = factors[columns[entry]]
            if column_scales:
                factor = wp.cw_mul(column_scales[instance_in(batch, column_scales.shape[0]), columns[entry]], factor)
            product += weights[entry] * factor
        if row_scales:
            product = wp.cw_mul(row_scales[instance_in(batch, row_scales.shape[0]), row], product)
            if addend:
                product += addend[batch, row]
        products[batch, row] = product


@wp.kernel(enable_backward=False)
def _multiply_adjoint(
    first_row: int,
    worker: int,
    # in
    column_starts: wp.array(dtype=wp.int32),
    rows: wp.array(dtype=wp.int32),
    weights: wp.array(dtype=wp.float32),
    row_scales: wp.array2d(dtype=wp.vec3),
    values: wp.array2d(dtype=wp.vec3),
    column_scales: wp.array2d(dtype=wp.vec3),
    adj_products: wp.array2d(dtype=wp.vec3),
    run: int,
    # out
    adj_values: wp.array2d(dtype=wp.vec3),
    adj_column_scales: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a run of columns of an instance:  with u = Mᵀ (r ∘ p̄),  v̄ += s ∘ u,  s̄ += v ∘ u."""
    column_count = column_starts.shape[0] - 1
    batch, thread = split_row(first_row + wp.tid(), (column_count + run - 1) // run)
    for column in range(thread * run, wp.min((thread + 1) * run, column_count)):
        adj = wp.vec3()
        for entry in range(column_starts[column], column_starts[column + 1]):
            adj_product = adj_products[batch, rows[entry]]
            if row_scales:
                adj_product = wp.cw_mul(row_scales[instance_in(batch, row_scales.shape[0]), rows[entry]], adj_product)
            adj += weights[entry] * adj_product
        if adj_column_scales:
            adj_scale = wp.cw_mul(values[batch, column], adj)
            adj_column_scales[batch, column] = adj_column_scales[batch, column] + adj_scale
        if adj_values:
            if column_scales:
                adj = wp.cw_mul(column_scales[instance_in(batch, column_scales.shape[0]), column], adj)
            adj_values[batch, column] = adj_values[batch, column] + adj


def multiply(
    matrix: SparseMatrix,
    values: wp.array,
    *,
    addend: wp.array | None = None,
    row_scales: wp.array | None = None,
    column_scales: wp.array | None = None,
) -> wp.array:
    """Multiply a sparse matrix M with colors v: c + r ∘ M (s ∘ v).

    Args:
        matrix: Of shape [row, column].
        values: v, vec3 of shape [batch, column].
        addend: c, vec3 of shape [batch, row]; None for 0.
        row_scales: r, vec3 of shape [batch, row]; None for 1.
        column_scales: s, vec3 of shape [batch, column]; None for 1.
            Any batch may be 1 and then serves every instance of the others.
    Returns:
        vec3 of shape [batch, row].
    Differentiable: values, addend, scales. Exact, being linear in each. Not: the matrix.
    """
    row_count, column_count = matrix.shape
    arrays = {"values": values, "addend": addend, "row_scales": row_scales, "column_scales": column_scales}
    for (name, array), length in zip(arrays.items(), (column_count, row_count, row_count, column_count), strict=True):
        if array is not None:
            check.shape(name, array.shape, ("batch", length))
    count = common_batch(arrays)
    values, addend = expand(values, count), None if addend is None else expand(addend, count)
    row_scales, column_scales = (
        expand(scales, count) if scales is not None and scales.requires_grad else scales
        for scales in (row_scales, column_scales)
    )

    run = run_length(values.device, _RUN)

    def launch_rows(kernel: wp.Kernel, entries: Entries, inputs: list, outputs: list) -> None:
        row_count = len(entries.row_starts) - 1
        cost = run * (_ENTRY_COST * entries.columns.size / max(row_count, 1) + _ROW_COST)
        inputs = [*entries, *inputs, run]
        launch(kernel, count * -(-row_count // run), inputs=inputs, outputs=outputs, cost=cost)

    def multiply_rows(row_scales: wp.array | None, addend: wp.array | None, products: wp.array) -> None:
        launch_rows(_multiply, matrix.rows, [values, column_scales, row_scales, addend], [products])

    def adjoint(adj_products: wp.array) -> None:
        adj_scales = None if column_scales is None else column_scales.grad
        if values.requires_grad or adj_scales is not None:
            inputs = [row_scales, values, column_scales, adj_products]
            launch_rows(_multiply_adjoint, matrix.columns, inputs, [values.grad, adj_scales])
        if row_scales is not None and row_scales.requires_grad:
            multiply_rows(adj_products, row_scales.grad, row_scales.grad)
        if addend is not None and addend.requires_grad:
            accumulate(adj_products, addend.grad)

    return differentiable(
        lambda products: multiply_rows(row_scales, addend, products),
        adjoint,
        result=empty((count, row_count), dtype=wp.vec3, device=values.device),
        variables=[values, addend, row_scales, column_scales],
    )
