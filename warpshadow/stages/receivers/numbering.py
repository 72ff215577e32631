"""Numbering: items that are chosen on the device get numbers there, key by key, such as receivers body by body."""

import itertools
from typing import NamedTuple

import numpy as np
import warp as wp

from warpshadow.device.capacities import sizes_of, write_numbers
from warpshadow.device.launch import launch
from warpshadow.device.memory import empty, filled, zeros
from warpshadow.device.parallel import split_row

_RUN = 64  # items that a thread owns
_ITEM_COST = 2.0  # nanoseconds of an item


class Numbers(NamedTuple):
    """Numbers of the chosen items of several rows; those of a key follow each other."""

    of_items: wp.array  # [row, item] int32, −1 for items that are not chosen
    items: wp.array  # [row, number] int32, the item of each, −1 for none
    ends: np.ndarray  # [key + 1], where the numbers of each key begin, and the last end
    ends_on_device: wp.array  # likewise, int32


@wp.kernel(enable_backward=False)
def _count_items(
    first_row: int,
    worker: int,
    # in
    keys: wp.array2d(dtype=wp.int32),
    order: wp.array(dtype=wp.int32),
    run: int,
    # out
    counts: wp.array3d(dtype=wp.int32),
):
    """A thread owns a run of items, and their counts by key, 0 before."""
    row, thread = split_row(first_row + wp.tid(), counts.shape[2])
    for i in range(thread * run, wp.min((thread + 1) * run, keys.shape[1])):
        item = i
        if order:
            item = order[i]
        key = keys[row, item]
        if key >= 0:
            counts[row, key, thread] = counts[row, key, thread] + 1


@wp.func
def _first_of(ends: wp.array(dtype=wp.int32), row_and_key: int, thread_count: int):
    """Number of items before those of a row and key."""
    first = int(0)
    if row_and_key > 0:
        first = ends[row_and_key * thread_count - 1]
    return first


@wp.kernel(enable_backward=False)
def _find_totals(
    # in
    ends: wp.array(dtype=wp.int32),
    row_count: int,
    thread_count: int,
    # out
    totals: wp.array(dtype=wp.int32),
):
    """A thread owns a key: the count of the row with most of its items."""
    key = wp.tid()
    total = int(0)
    for row in range(row_count):
        i = row * totals.shape[0] + key
        total = wp.max(total, _first_of(ends, i + 1, thread_count) - _first_of(ends, i, thread_count))
    totals[key] = total


@wp.kernel(enable_backward=False)
def _number_items(
    first_row: int,
    worker: int,
    # in
    keys: wp.array2d(dtype=wp.int32),
    order: wp.array(dtype=wp.int32),
    run: int,
    ends: wp.array(dtype=wp.int32),
    ends_of_keys: wp.array(dtype=wp.int32),
    # out
    counts: wp.array3d(dtype=wp.int32),
    numbers: wp.array2d(dtype=wp.int32),
    items: wp.array2d(dtype=wp.int32),
):
    """A thread owns a run of items; it counts them down."""
    thread_count = counts.shape[2]
    row, thread = split_row(first_row + wp.tid(), thread_count)
    for i in range(thread * run, wp.min((thread + 1) * run, keys.shape[1])):
        item = i
        if order:
            item = order[i]
        key = keys[row, item]
        number = int(-1)
        if key >= 0:
            row_and_key = row * counts.shape[1] + key
            end = ends[row_and_key * thread_count + thread] - _first_of(ends, row_and_key, thread_count)
            number = ends_of_keys[key] + end - counts[row, key, thread]
            counts[row, key, thread] = counts[row, key, thread] - 1
            if number < ends_of_keys[key + 1]:
                items[row, number] = item
            number = wp.min(number, items.shape[1] - 1)  # no more is right where there is no room
        numbers[row, item] = number


def number_items(name: str, keys: wp.array, key_count: int, order: wp.array | None = None) -> Numbers:
    """Number the items that have keys, with as many numbers for a key as the row with most of its items has.

    Args:
        name: Names the items.
        keys: Key of each item, −1 for items that get no number, int32 of shape [row, item].
        key_count: Number of keys.
        order: All items, in the order in which those of a key get numbers, int32 of shape [item]; None for their own.
    Returns:
        Numbers; how many there are is read, or in a graph the room for them (:mod:`warpshadow.device.capacities`).
    """
    device, (row_count, item_count) = keys.device, keys.shape
    thread_count = -(-item_count // _RUN)
    counts = zeros((row_count, key_count, thread_count), wp.int32, device, outlives_recording=False)
    ends, totals = (empty(size, dtype=wp.int32, device=device) for size in (counts.size, key_count))
    dim, cost = row_count * thread_count, _RUN * _ITEM_COST
    launch(_count_items, dim, cost=cost, inputs=[keys, order, _RUN], outputs=[counts])
    wp.utils.array_scan(counts.flatten(), ends)
    launch(_find_totals, key_count, inputs=[ends, row_count, thread_count], outputs=[totals])
    sizes = sizes_of(name, totals, item_count)
    ends_of_keys = np.array(list(itertools.accumulate(sizes.tolist(), initial=0)), np.int32)
    ends_on_device = write_numbers(ends_of_keys, device)
    numbers = empty(keys.shape, dtype=wp.int32, device=device)
    items = filled((row_count, int(ends_of_keys[-1])), -1, dtype=wp.int32, device=device)
    inputs = [keys, order, _RUN, ends, ends_on_device]
    launch(_number_items, dim, cost=cost, inputs=inputs, outputs=[counts, numbers, items])
    return Numbers(numbers, items, ends_of_keys, ends_on_device)
