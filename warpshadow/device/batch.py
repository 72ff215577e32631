"""Batches: every array of a stage has a leading dimension of instances, and a length of 1 serves them all."""

import functools
import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import warp as wp

from warpshadow.device.cuda_graph import is_readable
from warpshadow.device.launch import differentiable, launch
from warpshadow.device.memory import empty, reshaped
from warpshadow.device.warp_internals import contiguous_view


def common_batch(arrays: Mapping[str, Any]) -> int:
    """The common length of the leading dimensions of arrays, None passed over; a length of 1 serves any.

    Raises:
        ValueError: naming the array whose length is another.
    """
    counts = {name: len(array) for name, array in arrays.items() if array is not None}
    first, count = next(((name, count) for name, count in counts.items() if count != 1), ("", 1))
    for name, got in counts.items():
        if got not in (1, count):
            item, second = (of.replace("geometry.positions", "the poses of geometry") for of in (first, name))
            raise ValueError(
                f"{name}: got a batch of {got}, expected 1 or {count}, as {first} has; for all {got * count} pairs "
                f"repeat each of {item} {got} times in a row, in torch repeat_interleave({got}, 0), and all of "
                f"{second} {count} times, repeat({count}, 1, …)"
            )
    return count


@wp.func
def instance_in(batch: int, count: int):
    """Index of an instance in an array that has ``count`` of them: its own, or 0 where one serves all."""
    return wp.min(batch, count - 1)


def instance_of(batch: Any, instance: int) -> Any:
    """Item of a batch, an array or a list, for an instance: its own, or the last one, which serves the rest."""
    return batch[min(instance, len(batch) - 1)]


@functools.cache
def _make_copy(dtype: type) -> wp.Kernel:
    @wp.kernel(module="unique")
    def copy(
        # in
        part: wp.array2d(dtype=dtype),
        first: int,
        # out
        joined: wp.array2d(dtype=dtype),
    ):
        """A thread owns an item of an instance."""
        batch, item = wp.tid()
        joined[batch, first + item] = part[instance_in(batch, part.shape[0]), instance_in(item, part.shape[1])]

    return copy


def concatenate(parts: Sequence[wp.array], counts: Sequence[int], *, instances: int | None = None) -> wp.array:
    """Put arrays of items after one another, for every instance.

    Args:
        parts: Arrays of one dtype, shape [batch, count], or [batch, 1] where one item serves them all.
        counts: Items of each part.
        instances: Length of the batch, by default the parts' own.
    Differentiable: parts.
    """
    if instances is None:
        instances = common_batch({f"part {number}": part for number, part in enumerate(parts)})
    joined = empty((instances, sum(counts)), dtype=parts[0].dtype, device=parts[0].device)
    places = [(end - count, end) for end, count in zip(itertools.accumulate(counts), counts, strict=True)]
    if not is_readable(joined.device):
        for part, (first, end) in zip(parts, places, strict=True):
            launch(_make_copy(part.dtype), (instances, end - first), inputs=[part, first], outputs=[joined])
        return joined

    def copy(joined: wp.array) -> None:
        """By NumPy, ten times as fast as the kernel."""
        joined_values = np.asarray(joined)  # which takes half the time of numpy()
        for part, (first, end) in zip(parts, places, strict=True):
            joined_values[:, first:end] = np.asarray(part)

    def add(adj_joined: wp.array) -> None:
        adj_values = np.asarray(adj_joined)
        for part, (first, end) in zip(parts, places, strict=True):
            if part.requires_grad:
                gradient, values = np.asarray(part.grad), adj_values[:, first:end]
                summed_axes = tuple(axis for axis in range(2) if gradient.shape[axis] < values.shape[axis])
                gradient += values.sum(axis=summed_axes, keepdims=True) if summed_axes else values

    return differentiable(copy, add, joined, parts)


def cut(array: wp.array, first: int, end: int) -> wp.array:
    """Items of an array [batch, item] from one up to another, contiguous: a view of a batch of 1, else a copy.

    Differentiable: array.
    """
    if (first, end) == (0, array.shape[1]):
        return array
    if len(array) == 1 and end > first:
        view = contiguous_view(array, (1, end - first), array.dtype, first=first * array.strides[1])
        if view is not None:
            return view
        items = array[0][first:end]  # array[:, first:end] would not count as contiguous
        if items.is_contiguous:
            return items.reshape((1, end - first))
    return concatenate([array[:, first:end]], [end - first])


def expand(array: wp.array, instances: int) -> wp.array:
    """Repeat an array of shape [1, item] for every instance; one that has the instances stays as it is.

    Differentiable: array.
    """
    if array.shape[0] == instances:
        return array
    if array.shape[0] != 1:
        raise ValueError(f"array: got a batch of {array.shape[0]}, expected 1 or {instances}")
    return concatenate([array], array.shape[1:], instances=instances)


def expand_rows(rows: wp.array, instances: int) -> wp.array:
    """Repeat an array of shape [1, row, item] for every instance, as :func:`expand` does. Differentiable: rows."""
    if rows.shape[0] == instances:
        return rows
    return expand(rows.reshape((rows.shape[0], -1)), instances).reshape((instances, *rows.shape[1:]))


@functools.cache
def _make_add(dtype: type) -> wp.Kernel:
    @wp.kernel(module="unique", enable_backward=False)
    def add(
        # in
        values: wp.array2d(dtype=dtype),
        # out
        totals: wp.array2d(dtype=dtype),
    ):
        """A thread owns a total."""
        batch, item = wp.tid()
        totals[batch, item] = totals[batch, item] + values[batch, item]

    return add


def accumulate(values: wp.array, totals: wp.array) -> None:
    """Add values [item] or [batch, item] to totals, off the tape; on a CPU NumPy does, twice as fast as a kernel."""
    if is_readable(totals.device):
        sums = np.asarray(totals)
        sums += np.asarray(values)
        return
    if totals.ndim == 1:
        values, totals = values.reshape((1, -1)), totals.reshape((1, -1))
    launch(_make_add(totals.dtype), totals.shape, inputs=[values], outputs=[totals])


def rows(images: Any) -> Any:
    """View images [batch, height, width] as [batch, sample]; None stays None."""
    return None if images is None else reshaped(images, (images.shape[0], -1))
