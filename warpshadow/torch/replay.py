"""Replays: calls that come again with tensors of the same shapes are captured as graphs, forward and backward.

On a GPU Python takes longer to launch the kernels of a call than they run, on a CPU a fifth of an iteration of 256²
pixels. So a :class:`TorchRenderer` with ``graphs=True`` captures a call of a kind that has come twice, and replays it
from then on: it copies the tensors to where the graph reads them, launches the graph, and copies the results. A kind
has shapes, tensors that require a gradient, and arguments that are no tensors. Tensors are checked as ever; results in
between are not, as in all graphs (:mod:`warpshadow.device.cuda_graph`).

Calls are plain where nothing would be won, or cannot be captured: while torch captures, where geometry or cameras
without a gradient are the same as before, so that results about them are cached, where the function reads back, where a
graph takes longer, and once where an image shows more than the graph has room for
(:mod:`warpshadow.device.capacities`). :attr:`Replays.reason` says which it was.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Collection, Hashable, Sequence
from typing import Any, TypeVar

import torch
import warp as wp

from warpshadow.device.array_checks import postponed_checks
from warpshadow.device.capacities import Capacities
from warpshadow.device.constants import collecting_constants
from warpshadow.device.cuda_graph import capture
from warpshadow.device.tape import unrecorded
from warpshadow.torch.autograd import (
    CallResults,
    TensorFunction,
    array_of,
    as_array,
    current_stream,
    is_capturing,
    tensor_of,
)

_PLAIN_CALLS = 2  # of a kind before it is captured: the first compiles kernels and fills caches, as may the second
_MAX_FAILURES = 2  # after which calls of a kind stay plain
_MAX_DIFFERENCE = 1e-4  # of results of a graph and a plain call, over the largest of these
_MAX_HISTORIES = 8  # captured at a time: each holds the memory of its call


_Result = TypeVar("_Result")


class Replays:
    """The captured calls of a renderer."""

    def __init__(self, *, is_on: bool):
        self.is_on = is_on
        self.reason = "nothing was called yet"  # why the last call was plain; empty if it was replayed
        self._histories: dict[Hashable, _CallHistory] = {}

    def __reduce__(self) -> tuple[Any, ...]:
        """Copies begin anew."""
        return functools.partial(Replays, is_on=self.is_on), ()

    def results(
        self,
        key_of: Callable[[], Hashable],
        reused: Collection[int],
        function: TensorFunction,
        tensors: Sequence[torch.Tensor],
        requires_grad: Sequence[bool],
    ) -> CallResults:
        """The results of a call of a function, replayed where there is a graph for it.

        Args:
            key_of: Makes the key of the arguments of the call but the tensors.
            reused: Indices of tensors about which results are cached while they stay the same.
        """
        self.reason = self._why_plain(function.device)
        if self.reason:
            return function.plain_results(tensors, requires_grad)
        pairs = zip(tensors, requires_grad, strict=True)
        call_key = str(function.device), key_of(), tuple((tuple(tensor.shape), needs) for tensor, needs in pairs)
        history = self._histories.pop(call_key, None) or _CallHistory(wp.device_from_torch(function.device))
        self._histories[call_key] = history  # the last that was used
        while len(self._histories) > _MAX_HISTORIES:
            del self._histories[next(iter(self._histories))]
        unchanged = [tensors[number] for number in reused if not requires_grad[number]]
        results, self.reason = history.replay(function, tensors, requires_grad, unchanged)
        if results is None:
            with history.capacities.used():
                results = function.plain_results(tensors, requires_grad)
        return results

    def _why_plain(self, device: torch.device) -> str:
        if not self.is_on:
            return "graphs = False"
        return "torch captures the call" if is_capturing(device) else ""


class _CallHistory:
    """Calls that a graph can stand for.

    Attributes:
        capacities: The capacities of graphs for sizes that plain calls count.
    """

    def __init__(self, device: wp.Device) -> None:
        self.capacities = Capacities(device)
        self._plain_calls = self._failures = 0
        self._capture: Capture | None = None
        self._failure = ""
        self._unchanged: list[torch.Tensor] = []  # of the last call: held, so that no other lies where they did
        self._versions: list[tuple[int, object]] | None = None  # of these

    def replay(
        self,
        function: TensorFunction,
        tensors: Sequence[torch.Tensor],
        requires_grad: Sequence[bool],
        unchanged: Sequence[torch.Tensor],
    ) -> tuple[CallResults | None, str]:
        """The results of a replay, or why there are none."""
        before, self._versions = self._versions, [_version_of(tensor) for tensor in unchanged]
        self._unchanged = [tensor.detach() for tensor in unchanged]
        if unchanged and self._versions == before:
            return None, "geometry or cameras are the same as before: results about them are cached"
        if self._failures == _MAX_FAILURES:
            return None, self._failure
        self._plain_calls += self._capture is None
        if self._capture is None and self._plain_calls <= _PLAIN_CALLS:
            return None, "calls of this kind have not come often enough"
        if self._capture is None:
            try:
                capture = Capture(function, tensors, requires_grad, self.capacities)
            except (RuntimeError, MemoryError) as error:  # such as for a constant that is missing: plain calls make it
                self._plain_calls, self._failures = 0, self._failures + 1
                self._failure = f"it cannot be captured: {error}"
                return None, self._failure
            if capture.seconds > capture.plain_seconds:  # such as on many threads, of which a graph takes one on a CPU
                milliseconds = [f"{1e3 * seconds:.1f} ms" for seconds in (capture.seconds, capture.plain_seconds)]
                self._failures = _MAX_FAILURES
                self._failure = f"its graph takes {milliseconds[0]}, a plain call {milliseconds[1]}"
                return None, self._failure
            self._capture = capture
        results = self._capture.replay(tensors)
        if results is None:
            self._capture = None
            return None, "the image shows more than its graph has room for: the next call is captured anew"
        return results, ""


class Capture:
    """A call as graphs: one forward, and one backward if a tensor requires a gradient.

    Raises:
        RuntimeError: where the function cannot be captured.
        MemoryError: likewise.
    Attributes:
        seconds, plain_seconds: How long it takes forward as a graph, and as a plain call.
    """

    def __init__(
        self,
        function: TensorFunction,
        tensors: Sequence[torch.Tensor],
        requires_grad: Sequence[bool],
        capacities: Capacities,
    ):
        self._device, self._capacities = function.device, capacities
        self._inputs = [tensor.detach().clone(memory_format=torch.contiguous_format) for tensor in tensors]
        self._arguments = [as_array(*pair) for pair in zip(self._inputs, function.dtypes, strict=True)]
        self._state = 0  # counts replays; gradients are of the last
        self._backward: wp.Graph | None = None
        warp_device = wp.device_from_torch(function.device)
        no_gradients = self._arguments, [False] * len(self._arguments)
        with current_stream(function.device), capacities.used():
            plain_results, self.plain_seconds = self._timed(lambda: self._copies(function.record(*no_gradients)[1]))
        with collecting_constants() as self._cached_values, postponed_checks(self._arguments) as self._checks:
            with capture(warp_device) as captured, capacities.used():
                self._tape, self._results = function.record(self._arguments, requires_grad)  # zeroes gradients, too
            self._forward = captured.graph
            if self._tape is not None:
                self._adjoints = [torch.zeros_like(tensor_of(result)) for result in self._results]
                sources = [
                    array_of(adjoint, result.dtype)
                    for adjoint, result in zip(self._adjoints, self._results, strict=True)
                ]
                with capture(warp_device) as captured, unrecorded():
                    for result, source in zip(self._results, sources, strict=True):
                        if result.requires_grad:
                            wp.copy(result.grad, source)
                    self._tape.backward()
                self._backward = captured.graph
        with current_stream(function.device):
            self.seconds = min(self._timed(lambda: wp.capture_launch(self._forward))[1] for _ in range(2))
            results = self._copies(self._results)
        if not all(map(_agree, plain_results, results)):
            raise RuntimeError("its graph has other results than the plain call")

    def _timed(self, run: Callable[[], _Result]) -> tuple[_Result, float]:
        """The result of a call, and how long it takes on the device [s]."""
        wp.synchronize_device(wp.device_from_torch(self._device))
        start = time.perf_counter()
        result = run()
        wp.synchronize_device(wp.device_from_torch(self._device))
        return result, time.perf_counter() - start

    @staticmethod
    def _copies(results: Sequence[wp.array]) -> tuple[torch.Tensor, ...]:
        return tuple(tensor_of(result).clone() for result in results)

    def replay(self, tensors: Sequence[torch.Tensor]) -> CallResults | None:
        """Replay it forward; None where its graph has no room for the results."""
        self._launch_forward(tensors)
        if self._capacities.is_exceeded:
            return None
        with current_stream(self._device):
            results = self._copies(self._results)
        playback = functools.partial(self._gradients, [tensor.detach() for tensor in tensors], self._state)
        return CallResults(results, [result.requires_grad for result in self._results], playback)

    def _launch_forward(self, tensors: Sequence[torch.Tensor]) -> None:
        self._state += 1
        for unchanged, tensor in zip(self._inputs, tensors, strict=True):
            unchanged.copy_(tensor.detach())
        for check_argument in self._checks:
            check_argument()
        with current_stream(self._device):
            wp.capture_launch(self._forward)

    def _gradients(
        self, tensors: Sequence[torch.Tensor], state: int, adjoints: Sequence[torch.Tensor]
    ) -> tuple[torch.Tensor | None, ...]:
        """The gradient to each tensor; the call is replayed once more if another has been since, or its gradients."""
        if state != self._state:
            self._launch_forward(tensors)
        self._state += 1  # the memory of this state holds its gradients now
        for unchanged, adjoint in zip(self._adjoints, adjoints, strict=True):
            unchanged.copy_(adjoint.detach())
        with current_stream(self._device):
            wp.capture_launch(self._backward)
            return tuple(
                tensor_of(argument.grad).clone() if argument.requires_grad else None for argument in self._arguments
            )


def _version_of(tensor: torch.Tensor) -> tuple[int, object]:
    """Where a tensor is, and how often it was written to; torch counts no writes in ``inference_mode``."""
    return tensor.data_ptr(), object() if tensor.is_inference() else tensor._version


def _agree(result: torch.Tensor, other: torch.Tensor) -> bool:
    """Whether the results of two calls are equal, but for rounding."""
    if result.shape != other.shape:
        return False
    result, difference = result.double(), (result.double() - other.double()).abs()
    return not result.numel() or bool(difference.max() <= _MAX_DIFFERENCE * result.abs().max())
