"""Constants of kernels: values of the host that a device is given once."""

import contextlib
import functools
from collections.abc import Iterator

import numpy as np
import warp as wp


def constant(values: np.ndarray, dtype: type, device: wp.DeviceLike) -> wp.array:
    """An array of values on a device, the same one each time for the same values. It must not be written to.

    A loop so copies them once; and a CUDA graph, which would copy from where the host had them at the capture, finds
    them on the device if they were there before.

    Args:
        values: The values, of the array's shape and then that of an item.
        dtype: Warp dtype of the items.
        device: Where the array lives.

    Raises:
        RuntimeError: for values that come for the first time while a graph is captured: what is made then is filled
            by the graph alone, and cannot be kept.
    """
    values = np.ascontiguousarray(values)
    array = _constant(values.tobytes(), values.dtype.str, values.shape, dtype, str(device))
    for arrays in _collections:
        arrays.append(array)
    return array


_collections: list[list[wp.array]] = []


@contextlib.contextmanager
def collected() -> Iterator[list[wp.array]]:
    """Collect the constants that are asked for meanwhile: who reads them later, as a graph does, has to hold them."""
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
