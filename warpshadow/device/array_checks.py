"""Checks of arrays on a device: NaN, Inf and numbers out of range, found on a GPU when a call ends.

On a CPU arrays are looked at where they are checked. On a GPU that would stop the host each time: arrays of a call wait
for its end, and few launches look at all of them. While a CUDA graph is captured nothing can be read back, and nothing
is checked.
"""

import contextlib
import functools
import threading
from collections.abc import Callable, Collection, Hashable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import warp as wp

from warpshadow import check

_AT_ONCE = 8  # arrays that a launch looks at
_MAX_LATE = 64  # checks that wait, since they hold their arrays
_SMALL = 10_000  # numbers up to which BLAS sums on one thread

_Limits = wp.types.vector(length=_AT_ONCE, dtype=wp.float32)
_Counts = wp.types.vector(length=_AT_ONCE, dtype=wp.int32)
_Addresses = wp.types.vector(length=_AT_ONCE, dtype=wp.uint64)


@wp.kernel(enable_backward=False)
def _count_outside(
    # in
    addresses: _Addresses,
    counts: _Counts,
    minima: _Limits,
    maxima: _Limits,
    first: int,
    # out
    faults: wp.array(dtype=wp.int32),
):
    """A thread owns a number of an array, which is given by its address and its count of numbers."""
    argument, item = wp.tid()
    if item < counts[argument]:
        values = wp.array(ptr=addresses[argument], shape=(counts[argument],), dtype=wp.float32)
        if not (values[item] >= minima[argument] and values[item] <= maxima[argument]):  # so NaN, too
            wp.atomic_add(faults, first + argument, 1)


class _LateChecks(threading.local):
    """Checks of a thread's call that wait for the end of the call, on a GPU."""

    def __init__(self) -> None:
        self.depth = 0  # of calls in each other
        self.arrays: dict[Hashable, tuple[str, wp.array, tuple[float, float]]] = {}  # their names and ranges
        self.others: list[tuple[wp.array, Callable[[np.ndarray], None]]] = []
        self.faults: dict[str, wp.array] = {}  # by device: zero but while arrays are looked at

    def __enter__(self) -> None:
        self.depth += 1

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        try:
            if self.depth == 1 and (kind is None or issubclass(kind, Exception)):
                self.run()
        finally:
            self.depth -= 1
            if not self.depth:
                self.clear()

    def clear(self) -> None:
        """Leave them out."""
        self.arrays, self.others = {}, []

    def run_if_due(self) -> None:
        """Run them where no call waits for them, or they hold many arrays."""
        if not self.depth or len(self.arrays) + len(self.others) >= _MAX_LATE:
            self.run()

    def run(self) -> None:
        """Run them in their order."""
        if not (self.arrays or self.others):
            return
        arrays, others = list(self.arrays.values()), self.others
        self.clear()
        for alias in dict.fromkeys(array.device.alias for _, array, _ in arrays):
            of_device = [item for item in arrays if item[1].device.alias == alias]
            for number in self._outside(of_device):
                name, array, (minimum, maximum) = of_device[number]
                check.finite(name, array.numpy(), minimum=minimum, maximum=maximum)
        for array, judge in others:
            judge(array.numpy())

    def _outside(self, arrays: Sequence[tuple[str, wp.array, tuple[float, float]]]) -> list[int]:
        """Which arrays, of one device, hold a number out of their range: few launches, and one wait."""
        device = arrays[0][1].device
        if device.alias not in self.faults or len(self.faults[device.alias]) < len(arrays):
            self.faults[device.alias] = wp.zeros(2 * len(arrays), dtype=wp.int32, device=device)
        faults = self.faults[device.alias]
        for first in range(0, len(arrays), _AT_ONCE):
            batch = arrays[first : first + _AT_ONCE]
            values = [array.contiguous() for _, array, _ in batch]
            counts = [array.size * wp.types.type_size(array.dtype) for array in values]
            padding = [0] * (_AT_ONCE - len(batch))
            minima, maxima = zip(*(range_ for *_, range_ in batch), strict=True)
            wp.launch(
                _count_outside,
                dim=(len(batch), max(counts)),
                inputs=[
                    _Addresses(*(array.ptr for array in values), *padding),
                    _Counts(*counts, *padding),
                    _Limits(*minima, *padding),
                    _Limits(*maxima, *padding),
                    first,
                ],
                outputs=[faults],
                device=device,
                record_tape=False,
            )
        faulty_indices = np.flatnonzero(faults.numpy()).tolist()
        if faulty_indices:
            faults.zero_()
        return faulty_indices


_late_checks = _LateChecks()


def late_checks() -> contextlib.AbstractContextManager[None]:
    """Check arrays on a GPU when the call ends, so that it waits for the device once.

    A call within a call ends with it. A fault is raised in place of the error that it led to.
    """
    return _late_checks


_postponed: tuple[list[tuple[int, int]], list[Callable[[], None]]] | None = None  # memory of arguments, and checks


@contextlib.contextmanager
def postponed_checks(arguments: Sequence[wp.array]) -> Iterator[list[Callable[[], None]]]:
    """Collect the checks of the arguments of a call while a graph of it is captured, due before each replay."""
    global _postponed
    before, checks = _postponed, list[Callable[[], None]]()
    _postponed = [(array.ptr, array.ptr + array.capacity) for array in arguments if array.size], checks
    try:
        yield checks
    finally:
        _postponed = before


def postpone(array: wp.array, check_array: Callable[[], None]) -> bool:
    """Whether an array cannot be read since a graph is captured: the check is then collected, if one of arguments."""
    if not array.device.is_capturing:
        return False
    if _postponed is not None and any(first <= array.ptr < end for first, end in _postponed[0]):
        _postponed[1].append(check_array)
    return True


def _is_awaited(device: wp.Device) -> bool:
    """Whether the host waits where it reads a device's arrays."""
    return device.is_cuda


def finite_arrays(
    arrays: Mapping[str, wp.array | None],
    *,
    minimum: float | None = None,
    maximum: float = check.LARGEST,
    nonnegative: Collection[str] = (),
) -> None:
    """Raise ValueError when float32 arrays on a device, of any dtype, hold NaN, Inf or numbers out of range.

    On a GPU that is found when the call ends (:func:`late_checks`), at once where there is none. While a graph is
    captured nothing can be read back, and nothing is checked, or before its replays (:func:`postponed_checks`).

    Args:
        arrays: By the names of their arguments; None is passed over.
        minimum: Smallest number that is accepted, by default minus the largest.
        maximum: Largest number that is accepted.
        nonnegative: Names of the arrays that must hold nothing below 0.
    """
    present = {name: array for name, array in arrays.items() if array is not None and array.size}
    devices = [array.device for array in present.values()]
    if not devices:
        return
    if any(device.is_capturing for device in devices):
        options: dict[str, Any] = {"minimum": minimum, "maximum": maximum, "nonnegative": nonnegative}
        for name, array in present.items():
            postpone(array, functools.partial(finite_arrays, {name: array}, **options))
        return
    smallest = -maximum if minimum is None else minimum
    ranges = {name: (0.0 if name in nonnegative else smallest, maximum) for name in present}
    if not any(map(_is_awaited, devices)):
        for name, array in present.items():
            if not _is_within(np.asarray(array), *ranges[name]):
                check.finite(name, array.numpy(), minimum=ranges[name][0], maximum=maximum)
        return
    for name, array in present.items():
        key = array.ptr, array.shape, array.strides, ranges[name]
        _late_checks.arrays.setdefault(key, (name, array, ranges[name]))
    _late_checks.run_if_due()


def look_at_values(array: wp.array, judge: Callable[[np.ndarray], None]) -> None:
    """Let a function look at an array's values and raise an error: on a GPU when the call ends, as finite_arrays does.

    While a graph is captured it does not, or before its replays (:func:`postponed_checks`).
    """
    if postpone(array, functools.partial(look_at_values, array, judge)):
        return
    if not _is_awaited(array.device):
        judge(array.numpy())
        return
    _late_checks.others.append((array, judge))
    _late_checks.run_if_due()


def _is_within(values: np.ndarray, minimum: float, maximum: float) -> bool:
    """Whether no number is NaN or out of a range; of most small arrays the sum of squares tells, which is quicker."""
    is_small = values.size <= _SMALL and values.flags.c_contiguous
    if is_small and minimum == -maximum and float(np.vdot(values, values)) < (0.5 * maximum) ** 2:
        return True
    return bool(minimum <= np.minimum.reduce(values, None) and np.maximum.reduce(values, None) <= maximum)
