"""Constants of kernels: values of the host that a device is given once."""

import contextlib
import functools
from collections.abc import Iterator

import numpy as np
import warp as wp


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
    values = np.ascontiguousarray(values)
    array = _constant(values.tobytes(), values.dtype.str, values.shape, dtype, str(device))
    for arrays in _collections:
        arrays.append(array)
    return array


_collections: list[list[wp.array]] = []


@contextlib.contextmanager
def collected() -> Iterator[list[wp.array]]:
    """Collect the constants that are used meanwhile. Whoever reads them later, as a graph does, must hold them."""
    arrays: list[wp.array] = []
    _collections.append(arrays)
    try:
        yield arrays
    finally:
        _collections.remove(arrays)


@functools.lru_cache(maxsize=256)
def _constant(values: bytes, kind: str, shape: tuple[int, ...], dtype: type, device: str) -> wp.array:
    if wp.get_device(device).is_capturing:
        raise RuntimeError("a graph is captured that needs new constants: call what it captures once before")
    return wp.array(np.frombuffer(values, kind).reshape(shape), dtype=dtype, device=device)
