"""Constants of kernels: values of the host that a device is given once."""

import collections
import contextlib
import functools
import weakref
from collections.abc import Callable, Hashable, Iterator
from typing import Any, ParamSpec, TypeVar

import numpy as np
import warp as wp

P = ParamSpec("P")
R = TypeVar("R")

_MAX_RESULTS = 256  # results of a function that are cached; those not used for longest go first

_collections: dict[int, list[Any]] = {}  # by their identity

_immutable: "weakref.WeakValueDictionary[int, np.ndarray]" = weakref.WeakValueDictionary()  # likewise


@contextlib.contextmanager
def collecting_constants() -> Iterator[list[Any]]:
    """Collect the constants and cached values that are used meanwhile.

    Whoever reads them later, as a graph does, must hold them: caches let them go.
    """
    values: list[Any] = []
    _collections[id(values)] = values
    try:
        yield values
    finally:
        del _collections[id(values)]


def cached_by_values(function: Callable[P, R]) -> Callable[P, R]:
    """Make a function of NumPy arrays and other values that computes once for equal values.

    Nobody may change a result. The constants that it used count as used at every call.
    """
    results: collections.OrderedDict[Hashable, tuple[R, list[Any]]] = collections.OrderedDict()

    @functools.wraps(function)
    def cached(*args: P.args, **kwargs: P.kwargs) -> R:
        assert not kwargs
        key = tuple(map(_key, args))
        cached_result = results.get(key)
        if cached_result is None:
            with collecting_constants() as arrays:
                cached_result = function(*args), arrays  # type: ignore[call-arg]
            while len(results) >= _MAX_RESULTS:
                results.pop(next(iter(results)), None)
            results[key] = cached_result
        else:
            with contextlib.suppress(KeyError):  # another thread may have dropped it
                results.move_to_end(key)
            if _collections:
                note_use(*cached_result[1])
        return cached_result[0]

    return cached


def immutable(values: np.ndarray) -> np.ndarray:
    """Make a long array that is used again read-only, for good: caches then compare its identity, not its values."""
    values.flags.writeable = False
    _immutable[id(values)] = values
    return values


class IdentityKey:
    """A key that holds an object, and equals keys of the same object only."""

    __slots__ = ("_value",)

    def __init__(self, value: object):
        self._value = value

    def __hash__(self) -> int:
        return id(self._value)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, IdentityKey) and self._value is other._value


def _key(value: Any) -> Hashable:
    if isinstance(value, np.ndarray):
        if _immutable.get(id(value)) is value:
            return IdentityKey(value)
        return value.tobytes(), value.dtype.str, value.shape
    return str(value) if isinstance(value, wp.Device) else value


def note_use(*values: Any) -> None:
    """Note that constants or cached values are used: arrays, or objects that hold some."""
    for collection in list(_collections.values()):
        collection.extend(values)


@cached_by_values
def gather_of_owners(values: np.ndarray, owners: np.ndarray) -> np.ndarray:
    """The value of each item's owner, as of a face's body, given one for each owner; made once, and immutable."""
    return immutable(values[owners])


@cached_by_values
def constant(values: np.ndarray, dtype: type, device: wp.DeviceLike) -> wp.array:
    """Give constants to a device: equal values give the same array, which must not be written to.

    So a loop copies its constants once, and a CUDA graph copies none. (A graph would record the address of the host's
    values, which may be gone at a replay; constants that were on the device before the capture are safe.)

    Args:
        values: The values, of the array's shape and then that of an item.
        dtype: Warp dtype of the items.
    Raises:
        RuntimeError: for new values while a graph is captured: only a replay of the graph would fill the array.
    """
    if wp.get_device(device).is_capturing:
        raise RuntimeError("a graph is captured that needs new constants: call the function once before its capture")
    array = wp.array(np.ascontiguousarray(values), dtype=dtype, device=device)
    note_use(array)
    return array
