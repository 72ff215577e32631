"""Memory: new arrays, huge pages for large ones, and views of arrays.

Memory that is new to a process comes in pages of 4 kB, each of which stops the kernel that first writes to it. Huge
pages, of 2 MB, stop it less often. Linux gives them on request.
"""

import ctypes
import functools
import math
import mmap
from collections.abc import Callable, Hashable, Sequence
from typing import ClassVar

import numpy as np
import warp as wp

from warpshadow.device.warp_internals import (
    byte_count,
    contiguous_view,
    current_tape,
    empty,
    item_shape,
    scalar_type,
    set_gradient,
    viewed_array,
)

_HUGE = 2**21  # bytes of a huge page
_MIN_BYTES = 2 * _HUGE  # bytes of an array that is worth asking

_ALIGNMENT = 256  # bytes at whose multiples arrays in a block begin, as CUDA's allocations do
_MAX_SHARED = 2**28  # bytes of a block; larger arrays have memory of their own
_MAX_SIZES = 256  # kinds of recordings whose sizes are kept

_POOL_BYTES = 2**30  # freed memory that a GPU's pool keeps


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
    size = array.capacity
    if size >= _MIN_BYTES and array.device.is_cpu and (advise := _advise()) is not None:
        first, end = -(-array.ptr // _HUGE) * _HUGE, (array.ptr + size) // _HUGE * _HUGE
        advise(first, end - first, mmap.MADV_HUGEPAGE)
    return array


def keep_pool(device: wp.Device) -> None:
    """Let the memory pool of a GPU keep up to 1 GB of freed memory, unless the pool already keeps some.

    By default CUDA gives all of it back to the system whenever the host waits for the device, as each iteration does.
    """
    if device.is_cuda and wp.is_mempool_enabled(device) and not wp.get_mempool_release_threshold(device):
        wp.set_mempool_release_threshold(device, _POOL_BYTES)


def zeros(
    shape: int | Sequence[int], dtype: type, device: wp.DeviceLike, *, outlives_recording: bool = True
) -> wp.array:
    """Make an array of zeros: ``wp.zeros``, but quicker.

    Args:
        shape, dtype, device: As of ``wp.zeros``.
        outlives_recording: Whether the array may be needed after the recording, if this thread records. Others are in
            the recording's memory, as gradients are.
    """
    if not outlives_recording and (memory := _memory_of_recording()) is not None:
        return memory.take((shape,) if isinstance(shape, int) else shape, dtype, wp.get_device(device))
    array = empty(shape, dtype, device)
    array.zero_()
    return array


def filled(shape: int | Sequence[int], value: float, dtype: type, device: wp.DeviceLike) -> wp.array:
    """Make an array of one value: ``wp.full``, but quicker."""
    array = empty(shape, dtype, device)
    array.fill_(value)
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
    device = array.device
    if not device.is_cpu or device.is_capturing or not array.is_contiguous or not array.size:
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
    """Let an array require a gradient, which is zero: in the memory of the recording, if this thread records."""
    if not array.requires_grad:
        memory = _memory_of_recording() or ZeroedMemory()
        set_gradient(array, memory.take(array.shape, array.dtype, array.device))


def drop_gradient(array: wp.array) -> None:
    """Let go of the gradient of an array, and of the arrays that it is a view of."""
    owner: wp.array | None = array
    while owner is not None:
        owner.requires_grad = False
        owner = viewed_array(owner)


def _memory_of_recording() -> "ZeroedMemory | None":
    """Memory of the recording of this thread; None where there is none, or another's tape."""
    return getattr(current_tape(), "memory", None)


class ZeroedMemory:
    """Zeros for the gradients of a recording, which are parts of few blocks, each zeroed at once.

    A recording that begins with an array of a shape and dtype is likely to take as much as the last one that did: so
    much the first block has. A block stays as long as any array in it.
    """

    _sizes: ClassVar[dict[Hashable, int]] = {}  # bytes that a recording took, by the first array that it asked for

    def __init__(self) -> None:
        self._block: wp.array | None = None
        self._used, self._total = 0, 0  # bytes of the block, and of all arrays
        self._key: Hashable = None

    def take(self, shape: Sequence[int], dtype: type, device: wp.Device) -> wp.array:
        """Take an array of zeros."""
        size = -(-byte_count(tuple(shape), dtype) // _ALIGNMENT) * _ALIGNMENT
        if not size or size > _MAX_SHARED:
            array = in_huge_pages(empty(shape, dtype, device))
            array.zero_()
            return array
        self._key = self._key or (tuple(shape), dtype, device.alias)
        block = self._block
        if block is None or block.device is not device or self._used + size > block.size:
            expected = self._sizes.get(self._key, 0) - self._total
            block = self._block = empty(min(_MAX_SHARED, max(size, expected, self._total)), wp.uint8, device)
            in_huge_pages(block).zero_()
            self._used = 0
        array = part(block, self._used, shape, dtype)
        self._used += size
        self._total += size
        return array

    def end(self) -> None:
        """Note how much was taken."""
        if self._key is not None:
            self._sizes.pop(self._key, None)
            self._sizes[self._key] = self._total
            if len(self._sizes) > _MAX_SIZES:
                del self._sizes[next(iter(self._sizes))]


def part(block: wp.array, first: int, shape: Sequence[int], dtype: type) -> wp.array:
    """View a block of bytes, from one on, as an array, which holds it."""
    view = contiguous_view(block, shape, dtype, first=first)
    if view is None:
        view = wp.array(ptr=block.ptr + first, dtype=dtype, shape=tuple(shape), device=block.device)
        view.viewed = block
    return view


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
