"""Memory: new arrays, huge pages for large ones, and views of arrays.

Memory that is new to a process comes in pages of 4 kB, each of which stops the kernel that first writes to it: a fifth
of a call on 64 small images. Huge pages, of 2 MB, take a fourth of that. Linux gives them on request.
"""

import ctypes
import functools
import math
import mmap
from collections.abc import Callable, Sequence

import numpy as np
import warp as wp

from warpshadow.device.warp_internals import contiguous_view, item_shape, new_array, scalar_type, set_gradient

_HUGE = 2**21  # bytes of a huge page
_MIN_BYTES = 2 * _HUGE  # bytes of an array that is worth asking


@functools.cache
def _advise() -> Callable[[int, int, int], int] | None:
    """The system's function that is told how memory will be used: address, bytes, advice; None where there is none."""
    if not hasattr(mmap, "MADV_HUGEPAGE"):
        return None
    advise = ctypes.CDLL(None).madvise
    advise.argtypes = ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int
    return advise


def in_huge_pages(array: wp.array) -> wp.array:
    """Request huge pages for a large array before its first write. Returns the array.

    It is a request: where the system refuses, memory comes in small pages as before.
    """
    size = array.size * wp.types.type_size_in_bytes(array.dtype)
    if size >= _MIN_BYTES and array.device.is_cpu and (advise := _advise()) is not None:
        first, end = -(-array.ptr // _HUGE) * _HUGE, (array.ptr + size) // _HUGE * _HUGE
        advise(first, end - first, mmap.MADV_HUGEPAGE)
    return array


def empty(shape: int | Sequence[int], dtype: type, device: wp.DeviceLike) -> wp.array:
    """Make an array of uninitialized memory: ``wp.empty``, but quicker."""
    return new_array(shape, dtype, device if isinstance(device, wp.Device) else wp.get_device(device))


def zeros(shape: int | Sequence[int], dtype: type, device: wp.DeviceLike) -> wp.array:
    """Make an array of zeros: ``wp.zeros``, but quicker."""
    array = empty(shape, dtype, device)
    array.zero_()
    return array


def from_numpy(values: np.ndarray, dtype: type, device: wp.DeviceLike) -> wp.array:
    """Copy values [*shape, *shape of an item] to an array: ``wp.array``, but quicker."""
    shape = values.shape[: values.ndim - len(item_shape(dtype))]
    device = device if isinstance(device, wp.Device) else wp.get_device(device)
    if not device.is_cpu or not values.size:
        return wp.array(values, dtype=dtype, device=device)
    values = np.ascontiguousarray(values, wp.dtype_to_numpy(scalar_type(dtype)))
    array = empty(shape, dtype, device)
    ctypes.memmove(array.ptr, values.__array_interface__["data"][0], values.nbytes)
    return array


def copied(array: wp.array) -> wp.array:
    """Copy an array without its gradient: ``wp.clone``, but quicker."""
    if not array.device.is_cpu or not array.is_contiguous or not array.size:
        return wp.clone(array, requires_grad=False)
    copy = empty(array.shape, array.dtype, array.device)
    ctypes.memmove(copy.ptr, array.ptr, array.size * wp.types.type_size_in_bytes(array.dtype))
    return copy


def reshaped(array: wp.array, shape: Sequence[int]) -> wp.array:
    """View an array in another shape: ``array.reshape``, but quicker. One length may be −1."""
    if -1 in shape:
        rest = -math.prod(shape)
        shape = [array.size // rest if length == -1 else length for length in shape] if rest else shape
    view = contiguous_view(array, shape, array.dtype) if math.prod(shape) == array.size else None
    return array.reshape(tuple(shape)) if view is None else view


def require_gradient(array: wp.array) -> None:
    """Let an array require a gradient, which is zero."""
    if not array.requires_grad:
        gradient = in_huge_pages(empty(array.shape, array.dtype, array.device))
        gradient.zero_()
        set_gradient(array, gradient)


def as_items(array: wp.array, dtype: type, count: int) -> wp.array:
    """View every ``count`` items of the last dimension as one of another dtype; the remainder is left out."""
    *lengths, last = array.shape
    shape, strides = (*lengths, last // count), (*array.strides[:-1], count * array.strides[-1])
    is_whole = last % count == 0
    if is_whole and (view := contiguous_view(array, shape, dtype)) is not None:
        return view
    gradient = as_items(array.grad, dtype, count) if array.requires_grad else None
    items = wp.array(ptr=array.ptr, dtype=dtype, shape=shape, strides=strides, device=array.device, grad=gradient)
    items.viewed = array  # the memory stays while the view does
    return items
