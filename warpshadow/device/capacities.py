"""Capacities: sizes of arrays for items that are counted on a device, such as the receivers of an image.

A plain call reads such a count, and makes arrays of just that size. While a graph is captured nothing can be read: its
arrays have capacity for a quarter more than the plain calls before it counted. A replay that counts more marks that it
is exceeded, and its results are void: the call is to be made plainly, and captured anew.
"""

import collections
import contextlib
from collections.abc import Iterator

import numpy as np
import warp as wp

from warpshadow.device.launch import launch
from warpshadow.device.memory import empty, from_numpy

_AT_ONCE = 64  # numbers that a launch has as arguments
_Numbers = wp.types.vector(length=_AT_ONCE, dtype=wp.int32)

_capacities: "Capacities | None" = None  # of the call that is made


class Capacities:
    """Capacities of calls of a kind, by the names of their counts, and which count of a name it is.

    Args:
        device: Where it counts.
    """

    def __init__(self, device: wp.Device):
        self._sizes: dict[tuple[str, int], np.ndarray] = {}  # the most that plain calls counted
        self._names: collections.Counter[str] = collections.Counter()  # of the counts of a call
        self._is_exceeded = wp.zeros(1, dtype=wp.int32, device=device)

    @contextlib.contextmanager
    def used(self) -> Iterator[None]:
        """Use them for the call that is made within, be it plain or captured."""
        global _capacities
        before, _capacities, self._names = _capacities, self, collections.Counter()
        try:
            yield
        finally:
            _capacities = before

    @property
    def is_exceeded(self) -> bool:
        """Whether the last replay counted more than its graph has capacity for; waits for the device."""
        return bool(self._is_exceeded.numpy()[0])

    def _key(self, name: str) -> tuple[str, int]:
        self._names[name] += 1
        return name, self._names[name]

    def note(self, name: str, sizes: np.ndarray) -> None:
        """Note the counts of a plain call."""
        key = self._key(name)
        before = self._sizes.get(key)
        self._sizes[key] = np.maximum(sizes, before) if before is not None and len(before) == len(sizes) else sizes

    def reserve(self, name: str, counts: wp.array) -> np.ndarray:
        """Sizes for the items that a graph counts; its replays compare them."""
        if not self._names:
            self._is_exceeded.zero_()
        sizes = self._sizes.get(self._key(name))
        if sizes is None or len(sizes) != counts.size:
            raise RuntimeError(f"a graph is captured that counts {name}, which no call before it did")
        sizes = np.where(sizes > 0, sizes + sizes // 4 + 8, 0)
        for first in range(0, len(sizes), _AT_ONCE):
            part = sizes[first : first + _AT_ONCE]
            inputs = [counts, _vector_of(part), first]
            launch(_compare, len(part), inputs=inputs, outputs=[self._is_exceeded])
        return sizes


def sizes_of(name: str, counts: wp.array, maximum: int) -> np.ndarray:
    """Sizes of arrays for items that a device counted: read, which waits for it, or the capacity of a graph.

    Args:
        name: Names the items.
        counts: int32 of shape [count].
        maximum: No count is larger: the size in a graph without :class:`Capacities`, such as one that torch captures.
    """
    if not counts.device.is_capturing:
        sizes = counts.numpy().astype(int)
        if _capacities is not None:
            _capacities.note(name, sizes)
        return sizes
    return np.full(counts.size, maximum) if _capacities is None else _capacities.reserve(name, counts)


@wp.kernel(enable_backward=False)
def _compare(
    # in
    counts: wp.array(dtype=wp.int32),
    sizes: _Numbers,
    first: int,
    # out
    is_exceeded: wp.array(dtype=wp.int32),
):
    """A thread owns a count; threads that write write the same."""
    i = wp.tid()
    if counts[first + i] > sizes[i]:
        is_exceeded[0] = 1


@wp.kernel(enable_backward=False)
def _write_numbers(
    # in
    numbers: _Numbers,
    first: int,
    # out
    result: wp.array(dtype=wp.int32),
):
    """A thread owns a number."""
    i = wp.tid()
    result[first + i] = numbers[i]


def _vector_of(numbers: np.ndarray) -> _Numbers:
    return _Numbers(*numbers.tolist(), *[0] * (_AT_ONCE - len(numbers)))


def write_numbers(numbers: np.ndarray, device: wp.Device) -> wp.array:
    """Copy int32 numbers to a device; in a graph, to whose memory the host may not write, as arguments of launches."""
    if not device.is_capturing:
        return from_numpy(numbers, dtype=wp.int32, device=device)
    result = empty(len(numbers), dtype=wp.int32, device=device)
    for first in range(0, len(numbers), _AT_ONCE):
        part = numbers[first : first + _AT_ONCE]
        launch(_write_numbers, len(part), inputs=[_vector_of(part), first], outputs=[result])
    return result
