"""Graphs: an iteration whose shapes stay, captured once and replayed as a single launch.

On a GPU an iteration is some hundred kernels of a few microseconds each, and Python takes five times as long to launch
them as they take to run. A CUDA graph holds all of them, forward and backward, and is launched at once:

    turn = wp.zeros((1, 2), dtype=wp.vec3, device=device, requires_grad=True)
    step = Captured(with_gradients(lambda: compare(renderer.draw(view=place(turn)), target), [turn]), device)
    for _ in range(100):
        loss = step()
        optimizer.step([turn.grad.flatten()])   # writes to turn where it is

A capture records launches on arrays at their addresses: an input that changes between calls has to be written into the
same array (``array.assign``, ``wp.copy``), and decisions in Python are fixed at the capture. So nothing is read back
meanwhile: inputs are not checked for NaN and indices, and images have room for some more receivers and silhouettes than
those before (:mod:`warpshadow.device.capacities`). A function of other shapes takes a graph of its own.

Memory that is allocated inside belongs to the graph (by CUDA's stream-ordered allocator, Warp's default), so tapes and
arrays that the function makes and lets go cost nothing at a replay. Cached values that it reads, the graph holds.
"""

import contextlib
import functools
import threading
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Generic, TypeVar

import warp as wp

from warpshadow.device.capacities import Capacities
from warpshadow.device.constants import collecting_constants
from warpshadow.device.tape import recorded
from warpshadow.device.threads import locked

Result = TypeVar("Result")


def is_readable(device: wp.Device) -> bool:
    """Whether arrays can be read without waiting: on a CPU, unless their launches are only being captured."""
    return device.is_cpu and not device.is_capturing


def is_captured(device: wp.Device) -> bool:
    """Whether :class:`Captured` captures on a device: not on a CPU, whose graphs run on one thread."""
    return device.is_cuda


@contextlib.contextmanager
def refusing_unrecorded() -> Iterator[None]:
    """Refuse, on this thread, reads of arrays, host data for them, and new meshes: a CPU's graph records none."""
    thread = threading.get_ident()
    methods = [(wp.array, "numpy"), (wp.array, "_init_from_data"), (wp.Mesh, "__init__"), (wp.Mesh, "refit")]
    functions = [getattr(*method) for method in methods]

    def refusing(function: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(function)
        def refuse(*arguments: Any, **options: Any) -> Any:
            if threading.get_ident() == thread:
                raise RuntimeError("a graph is captured, which takes no data from the host or to it, and no mesh")
            return function(*arguments, **options)

        return refuse

    for method, function in zip(methods, functions, strict=True):
        setattr(*method, refusing(function))
    try:
        yield
    finally:
        for method, function in zip(methods, functions, strict=True):
            setattr(*method, function)


@contextlib.contextmanager
def capture(device: wp.Device) -> Iterator[wp.ScopedCapture]:
    """Capture the launches made within; its ``graph`` has them then.

    Reading an array, and making or refitting a mesh, raise RuntimeError on a CPU, too: its graphs do not record them.
    So does a GPU without the stream-ordered allocator.
    """
    if device.is_cuda and not wp.is_mempool_enabled(device):
        raise RuntimeError(f"{device}: a capture that allocates needs wp.set_mempool_enabled")
    with (
        wp.ScopedCapture(device=device) as captured,
        refusing_unrecorded() if device.is_cpu else contextlib.nullcontext(),
    ):
        yield captured


class Captured(Generic[Result]):
    """A function that is called as it is at first, captured at the second call, and replayed from then on.

    The first call compiles kernels, checks inputs and fills caches, none of which a capture can do.
    Each call runs the function's launches once, but for a replay that counts more than its graph has room for: it is
    void, a plain call follows at once, and the next one is captured anew. That waits for the device.

    Args:
        function: The function to call. It may read arrays back at the first call only (``device.is_capturing`` tells).
    Raises:
        RuntimeError: by a call, for a device without the stream-ordered allocator, and where the function reads back,
            synchronizes or copies from the host while it is captured. The next call is then as the first one.
    """

    def __init__(self, function: Callable[[], Result], device: wp.DeviceLike):
        self._function = function
        self._device = wp.get_device(device)
        self._has_run = False
        self._capacities = Capacities(self._device)
        self._captured: tuple[wp.Graph, Result, list[Any]] | None = None

    @locked
    def __call__(self) -> Result:
        """Call or replay it; the captured call's result is written anew by each replay."""
        if not is_captured(self._device) or not self._has_run:
            return self._call()
        if self._captured is None:
            self._has_run = False  # unless the capture succeeds: caches may lack values that it asked for
            self._captured = self._capture()
            self._has_run = True
        graph, result, _ = self._captured
        wp.capture_launch(graph)
        if self._capacities.is_exceeded:
            self._captured = None
            return self._call()
        return result

    def _call(self) -> Result:
        with self._capacities.used():
            result = self._function()
        self._has_run = True
        return result

    def _capture(self) -> tuple[wp.Graph, Result, list[Any]]:
        """The graph, the result that it writes, and the constants and cached values that it reads."""
        with collecting_constants() as cached_values, capture(self._device) as captured, self._capacities.used():
            result = self._function()
        return captured.graph, result, cached_values


def with_gradients(loss: Callable[[], wp.array], variables: Sequence[wp.array]) -> Callable[[], wp.array]:
    """Make a function that evaluates a loss and leaves its gradient in the variables' ``grad``.

    Args:
        loss: Evaluates to a float32 array of one item, by launches that a tape records.
        variables: Arrays that require a gradient; their gradients are overwritten.
    Returns:
        A function that returns the loss, as an array on its device.
    """

    def evaluate() -> wp.array:
        for variable in variables:
            variable.grad.zero_()
        with recorded() as tape:
            value = loss()
        tape.backward(value)
        return value

    return evaluate
