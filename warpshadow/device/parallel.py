"""All cores: kernels that take long on a CPU run in slices, on threads of a pool.

Warp runs a CPU kernel on the thread that launches it, one item after another. It calls the kernel through ctypes, which
lets go of Python's lock; so the rows of a launch are cut into slices that several threads run at once. A kernel that
is launched with a cost has two arguments for this, before all others:

    first_row   the slice's first row, to which it adds the row that Warp tells it
    worker      which thread runs it, so which scratch memory is its own; -1 on a GPU, where each row has some

Where rows add to the same numbers, each slice adds to numbers of its own, which are then summed in the slices' order.
So results are bit-equal for any number of threads. A GPU gets the whole launch as one slice.
"""

import collections
import contextlib
import functools
import itertools
import math
import os
import queue
import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from warpshadow.device import warp_internals
from warpshadow.device.memory import empty, zeros
from warpshadow.device.tape import gradients_of

ENVIRONMENT_VARIABLE = "WARPSHADOW_NUM_THREADS"

_MIN_WORK = 1.0e5  # minimum work of a slice [ns]: waking a thread and fetching its inputs take a third of that
_MIN_SUMMED_WORK = 3.0e5  # the same where a slice has sums of its own, which are zeroed and added up
_SLICES_PER_THREAD = 4  # rows differ in cost; threads that finish early take the remaining slices
_SUMMED_SLICES = 16  # most slices of a launch in which each slice has sums of its own
_SUMMED_SIZE = 100_000  # items that the sums of all slices have at most, beyond two slices: they are to be added up

_thread_count: int | None = None


def thread_count() -> int:
    """Threads that kernels run on on a CPU."""
    if _thread_count is not None:
        return _thread_count
    text = os.environ.get(ENVIRONMENT_VARIABLE, "")
    if not text:
        return _core_count()
    if not text.isdecimal() or int(text) < 1:
        raise ValueError(f"{ENVIRONMENT_VARIABLE}: got {text!r}, expected a positive whole number")
    return int(text)


@functools.cache
def _core_count() -> int:
    """Cores that this process may use, as it had them at the first launch."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def set_thread_count(count: int | None) -> None:
    """Set how many threads kernels run on on a CPU; results do not depend on it.

    Args:
        count: Positive; None for the environment variable WARPSHADOW_NUM_THREADS, or all cores.
    Raises:
        ValueError: for another count.
    """
    global _thread_count
    if count is not None and (isinstance(count, bool) or not isinstance(count, int) or count < 1):
        raise ValueError(f"count: got {count!r}, expected a positive whole number, or None for all cores")
    _thread_count = count


@functools.cache
def _pool(count: int) -> "queue.SimpleQueue[Callable[[], None]]":
    """The queue that serves a pool's threads, all but the calling one. ``concurrent.futures`` is 15 µs slower."""
    offers: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()

    def serve() -> None:
        while True:
            offers.get()()

    for number in range(1, count):
        threading.Thread(target=serve, name=f"warpshadow_{number}", daemon=True).start()
    return offers


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_pool.cache_clear)  # a child process has the pool but not its threads


@wp.func
def scratch_slot(worker: int, row: int):
    """The scratch memory that a kernel's thread may use."""
    slot = worker
    if worker < 0:
        slot = row
    return slot


@wp.func
def split_row(row: int, count: int):
    """Instance and item of a row, where the items of all instances follow each other, ``count`` of each."""
    batch = row // count
    return batch, row - batch * count


class Scratch(NamedTuple):
    """Scratch memory of a kernel: a row [*shape] of an array for each thread, not read after the launch."""

    shape: tuple[int, ...]
    dtype: type

    def allocate(self, rows: int, device: wp.Device) -> wp.array:
        """Make the array."""
        return empty((rows, *self.shape), self.dtype, device)


class ScratchStruct(NamedTuple):
    """Scratch memory of a kernel whose arrays are the fields of a struct: of each the shape of a thread's row."""

    struct: Any
    shapes: Mapping[str, tuple[int, ...]]

    def allocate(self, rows: int, device: wp.Device) -> Any:
        """Make the struct with its arrays."""
        return warp_internals.struct_of(
            self.struct,
            **{
                field: empty((rows, *shape), warp_internals.field_dtype(self.struct, field), device)
                for field, shape in self.shapes.items()
            },
        )


def run_length(device: wp.Device, width: int) -> int:
    """Consecutive samples that a thread owns: on a CPU a row, since starting a thread costs as much as some samples."""
    return 1 if device.is_cuda else width


def run_dimensions(device: wp.Device, run_count: int, instances: int) -> tuple[int, int]:
    """Dimensions (outer, inner) of a launch over runs of samples of all instances, which :func:`split_launch` splits.

    CPU: runs are outer. One slice owns a run for all instances, so no other adds to the gradient of inputs that serve
    them all. GPU: instances are outer. The 32 threads of a warp own adjacent samples.

    A run may also be a receiver, and sectors of directions take the place of instances: a warp then asks for the same
    directions at adjacent receivers, and its threads go the same way.
    """
    return (instances, run_count) if device.is_cuda else (run_count, instances)


@wp.func
def split_launch(worker: int, row: int, column: int):
    """Instance (or sector) and run (or receiver) of a thread, by the row and column of a launch of `run_dimensions`."""
    return wp.where(worker < 0, row, column), wp.where(worker < 0, column, row)


def strip_count(device: wp.Device) -> int:
    """Threads that share a face or an edge: on CUDA several, so that none follows a huge one alone."""
    return 16 if device.is_cuda else 1


def launch_slices(
    kernel: wp.Kernel,
    dim: int | Sequence[int],
    *,
    cost: float,
    inputs: Sequence[Any],
    outputs: Sequence[wp.array | None],
    scratch: Sequence[Scratch | ScratchStruct] = (),
    sums: Sequence[wp.array | None] = (),
    device: wp.Device,
) -> None:
    """Launch a kernel off the tape, on a CPU in slices that threads share; see :func:`.launch.launch`."""
    dim = _shape(dim)
    slice_count, workers = _count_slices(dim, cost, sums, device)
    rows = min(workers, slice_count) if device.is_cpu else math.prod(dim)
    arguments = [*inputs, *(memory.allocate(rows, device) for memory in scratch), *outputs]
    summed_arguments = {index: array for index, array in enumerate(sums, 2 + len(arguments)) if array is not None}
    _launch_slices(kernel, dim, [*arguments, *sums], summed_arguments, None, slice_count, workers, device)


def launch_adjoint_slices(
    kernel: wp.Kernel,
    dim: int | Sequence[int],
    *,
    cost: float,
    inputs: Sequence[Any],
    outputs: Sequence[wp.array | None],
    shared: Sequence[wp.array | None],
    device: wp.Device,
) -> None:
    """Launch Warp's adjoint of a kernel as :func:`launch_slices` does the kernel; it adds to gradients of inputs.

    Args:
        shared: Inputs to whose gradients all rows add.
    """
    dim, arguments = _shape(dim), [*inputs, *outputs]
    summed_arguments = {
        index: value.grad
        for index, value in enumerate(inputs, 2)
        if isinstance(value, wp.array) and value.requires_grad and any(value is array for array in shared)
    }
    counts = _count_slices(dim, cost, summed_arguments.values(), device)
    _launch_slices(kernel, dim, arguments, summed_arguments, gradients_of(arguments), *counts, device)


def _shape(dim: int | Sequence[int]) -> Sequence[int]:
    return (dim,) if isinstance(dim, int) else dim


def _count_slices(
    dim: Sequence[int], cost: float, sums: Iterable[wp.array | None], device: wp.Device
) -> tuple[int, int]:
    """How many slices a launch has, and how many threads there are for them."""
    sizes = [array.size for array in sums if array is not None]
    slice_count = int(math.prod(dim) * cost / (_MIN_SUMMED_WORK if sizes else _MIN_WORK))
    if slice_count <= 1 or device.is_cuda or device.is_capturing:
        return 1, 1
    workers = thread_count()
    if sizes:  # as many for any number of threads
        return min(dim[0], _SUMMED_SLICES, max(2, _SUMMED_SIZE // max(1, *sizes)), slice_count), workers
    slice_count = min(dim[0], _SLICES_PER_THREAD * workers, slice_count)
    if slice_count > workers:
        slice_count -= slice_count % workers  # as many for each thread
    return (1, 1) if workers == 1 else (slice_count, workers)


def _launch_slices(
    kernel: wp.Kernel,
    dim: Sequence[int],
    arguments: Sequence[Any],
    summed_arguments: dict[int, wp.array],
    gradients: Sequence[wp.array | None] | None,
    slice_count: int,
    workers: int,
    device: wp.Device,
) -> None:
    """Launch a kernel, or its adjoint where gradients of its arguments are given.

    Args:
        summed_arguments: Arrays to which all rows add, by argument index; a gradient has the index of its argument.
    """
    arguments = [0, 0 if device.is_cpu else -1, *arguments]
    gradients = None if gradients is None else [None, None, *gradients]
    if slice_count == 1:
        warp_internals.bound_kernel(kernel, arguments, device, gradients=gradients)(dim)
        return
    slice_sums = {  # along the first axis: an array has four at most
        argument_index: zeros((slice_count * array.shape[0], *array.shape[1:]), array.dtype, device=device)
        for argument_index, array in summed_arguments.items()
    }
    kernel.module.load(device, 1)  # compiled here, not by each thread
    for argument_index, parts in slice_sums.items():
        shape = summed_arguments[argument_index].shape
        view = warp_internals.contiguous_view(parts, shape, parts.dtype)
        first_part = parts[: shape[0]] if view is None else view
        if gradients is None:
            arguments[argument_index] = first_part
        else:
            # kernels add to the gradient of the argument itself where they read a row of it as an array
            value = arguments[argument_index]
            assert value.is_contiguous
            arguments[argument_index] = wp.array(
                ptr=value.ptr, dtype=value.dtype, shape=value.shape, device=device, grad=first_part
            )
            gradients[argument_index] = first_part
    launch = warp_internals.bound_kernel(kernel, arguments, device, gradients=gradients)
    starts = [dim[0] * k // slice_count for k in range(slice_count + 1)]

    def run(number: int, worker: int) -> None:
        offsets = {
            argument_index: number * parts.shape[0] // slice_count * parts.strides[0]
            for argument_index, parts in slice_sums.items()
        }
        launch((starts[number + 1] - starts[number], *dim[1:]), starts[number], worker, offsets=offsets)

    _share(run, slice_count, workers)
    for argument_index, parts in slice_sums.items():
        sums = np.asarray(summed_arguments[argument_index])
        total, *others = np.asarray(parts).reshape(slice_count, *sums.shape)
        for other in others:
            total += other
        sums += total


def _share(run: Callable[[int, int], None], slice_count: int, workers: int) -> None:
    """Run slices, by slice and thread index, on the calling thread and the threads of the pool.

    Each begins with a part of its own, the same in every launch, so that rows stay in the caches of one core from
    kernel to kernel; one that is done takes over from the end of another's part. Threads that got no core before all
    was taken are not waited for.
    """
    count = min(workers, slice_count)
    bounds = [slice_count * worker // count for worker in range(count + 1)]
    parts = [collections.deque(range(first, end)) for first, end in itertools.pairwise(bounds)]
    absent = collections.deque(range(1, count))  # threads that have not begun
    finished: queue.SimpleQueue[BaseException | None] = queue.SimpleQueue()

    def run_slices(worker: int) -> None:
        for part in (parts[worker], *parts[worker + 1 :], *parts[:worker]):
            take_slice = part.popleft if part is parts[worker] else part.pop
            while True:
                try:
                    number = take_slice()
                except IndexError:
                    break
                run(number, worker)

    def help_out() -> None:
        try:
            worker = absent.popleft()
        except IndexError:
            return
        failure = None
        try:
            run_slices(worker)
        except BaseException as error:  # the calling thread raises it
            failure = error
        finished.put(failure)

    offers = _pool(workers)
    for _ in range(1, count):
        offers.put(help_out)
    try:
        run_slices(0)
    finally:
        begun = count - 1
        while absent:
            with contextlib.suppress(IndexError):
                absent.pop()
                begun -= 1
        failures = [failure for failure in (finished.get() for _ in range(begun)) if failure is not None]
    if failures:
        raise failures[0]
