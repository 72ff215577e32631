"""Warp in torch's autograd: functions of arrays are applied to tensors."""

import functools
import math
import os
import sys
import threading
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from typing import NamedTuple, ParamSpec, TypeAlias, TypeVar, overload

import numpy as np
import torch
import warp as wp

from warpshadow.device.memory import drop_gradient, require_gradient
from warpshadow.device.tape import recorded, unrecorded
from warpshadow.device.threads import one_call
from warpshadow.device.warp_internals import array_at, item_shape

P = ParamSpec("P")
R = TypeVar("R")


Playback: TypeAlias = Callable[[Sequence[torch.Tensor]], tuple[torch.Tensor | None, ...]]
"""The gradient to each argument of a call, given the results' gradients; None where it requires none."""


class CallResults(NamedTuple):
    """Results of a function of arrays as tensors, and the way back."""

    tensors: tuple[torch.Tensor, ...]
    require_grad: list[bool]  # whether each depends on arguments that require a gradient
    playback: Playback | None  # None if none does


def outside_torch_compile(function: Callable[P, R]) -> Callable[P, R]:
    """Make a function that ``torch.compile`` leaves as it is: it launches Warp's kernels, which cannot be traced.

    ``torch.compiler.disable`` would do at once, but imports the compiler, for more than a second.
    """

    @functools.wraps(function)
    def recorded_call(*args: P.args, **kwargs: P.kwargs) -> R:
        if torch.compiler.is_compiling():  # only while this very line is traced
            return torch.compiler.disable(recorded_call)(*args, **kwargs)
        return function(*args, **kwargs)

    # code of its own, since the compiler gives up on code of which it has compiled eight variants
    recorded_call.__code__ = recorded_call.__code__.replace(co_name=function.__name__)  # type: ignore[attr-defined]
    return recorded_call


@overload
def apply(
    function: Callable[..., tuple[wp.array, ...]],
    *tensors: torch.Tensor,
    dtypes: Sequence[type],
    device: torch.device | None = None,
    names: Sequence[str] | None = None,
    affine: Collection[str] = (),
) -> tuple[torch.Tensor, ...]: ...


@overload
def apply(
    function: Callable[..., wp.array],
    *tensors: torch.Tensor,
    dtypes: Sequence[type],
    device: torch.device | None = None,
    names: Sequence[str] | None = None,
    affine: Collection[str] = (),
) -> torch.Tensor: ...


@outside_torch_compile
def apply(
    function: Callable[..., wp.array | tuple[wp.array, ...]],
    *tensors: torch.Tensor,
    dtypes: Sequence[type],
    device: torch.device | None = None,
    names: Sequence[str] | None = None,
    affine: Collection[str] = (),
) -> torch.Tensor | tuple[torch.Tensor, ...]:
    """Apply a differentiable function of Warp arrays to tensors.

    Args:
        function: Takes an array for each tensor and returns an array, or a tuple of them; its launches are recorded on
            a tape of this thread's if a tensor requires a gradient.
        tensors: Float32; contiguous or not. Items of a dtype lie in the last dimensions: a [batch, vertex, 3] tensor
            is an array of vec3 of shape [batch, vertex].
        dtypes: Warp's dtype of each.
        device: Where the function runs, by default the tensors' own; launched on torch's current stream there.
        names: Names of the tensors in messages, by default ``tensors[0]`` and so on.
        affine: Names of the tensors in which the function is affine while all others are fixed: only gradients to
            these can be differentiated again.
    Returns:
        The array as a tensor, or a tuple of tensors for a tuple of arrays.
    Raises:
        NotImplementedError: where a gradient to a tensor that is not among the affine ones is differentiated again.
    Differentiable: as the function is, once; gradients to affine tensors again, in all tensors.
    """
    names = names or [f"tensors[{number}]" for number in range(len(tensors))]
    for name, tensor in zip(names, tensors, strict=True):
        check_float32(name, tensor)
    results = TensorFunction(function, dtypes, device or tensors[0].device, names, affine)(*tensors)
    return results if len(results) > 1 else results[0]


@functools.cache
def _let_waiting_threads_sleep() -> None:
    """Let the threads of torch's OpenMP sleep where they wait for each other, rather than spin.

    They spin for milliseconds before they sleep, which is quickest if each has a core to itself. Beside other work, or
    the threads of our own pool, they use up their share of the cores by spinning, and the thread that all wait for is
    the last to run: each operation on more than 32 768 numbers then takes tens of milliseconds. GNU's OpenMP spins for
    microseconds once it has more threads than there are cores (its manual, GOMP_SPINCOUNT). So it is given some that
    sleep for good. No setting of torch changes; and settings of the environment about waiting are left alone.
    """
    is_set = "OMP_WAIT_POLICY" in os.environ or "GOMP_SPINCOUNT" in os.environ
    if is_set or sys.platform != "linux" or not torch.backends.openmp.is_available():
        return
    others = torch.get_num_threads() - 1  # that a team has beside the thread that begins it
    started_events = [threading.Event() for _ in range(-(-len(os.sched_getaffinity(0)) // others))]

    def begin_team(is_started: threading.Event) -> None:
        torch.zeros(1 << 17).add_(1.0)
        is_started.set()
        threading.Event().wait()  # a team ends with the thread that began it

    for event in started_events:
        threading.Thread(target=begin_team, args=(event,), name="warpshadow-sleeper", daemon=True).start()
    for event in started_events:
        event.wait()


def as_array(tensor: torch.Tensor, dtype: type) -> wp.array:
    """A tensor as an array that requires no gradient, of the same memory if that is contiguous."""
    array = array_of(tensor.detach().contiguous(), dtype)
    if not tensor.is_inference():  # by it a renderer on a GPU knows which arrays have not been written to
        array.origin, array.version = tensor if tensor._base is None else tensor._base, tensor._version
    return array


def array_of(tensor: torch.Tensor, dtype: type) -> wp.array:
    """A contiguous tensor as an array of the same memory, as ``wp.from_torch`` makes one."""
    shape, item = tuple(tensor.shape), item_shape(dtype)
    leading_shape = shape[: len(shape) - len(item)]
    if tensor.device.type != "cpu" or not tensor.numel() or shape[len(leading_shape) :] != item or not leading_shape:
        # torch calls any stride of a length of 1 contiguous, Warp does not
        strides = [math.prod(shape[axis + 1 :]) for axis in range(len(shape))]
        return wp.from_torch(tensor.as_strided(shape, strides), dtype=dtype, requires_grad=False)
    return array_at(tensor.data_ptr(), leading_shape, dtype, owner=tensor)


def tensor_of(array: wp.array) -> torch.Tensor:
    """An array as a tensor of the same memory: ``wp.to_torch``, but quicker."""
    is_cpu = array.device.is_cpu
    return torch.from_numpy(np.asarray(array)) if is_cpu else wp.to_torch(array, requires_grad=False)


@dataclass(frozen=True)
class TensorFunction:
    """A function of arrays that is applied to tensors, as :func:`apply` says.

    Args:
        find_results: Finds its results for tensors and whether a gradient to each is asked for, by graphs where it can
            (:mod:`.replay`); None where calls are plain.
    """

    function: Callable[..., wp.array | tuple[wp.array, ...]]
    dtypes: Sequence[type]
    device: torch.device
    names: Sequence[str]
    affine: Collection[str]
    find_results: "Callable[[TensorFunction, Sequence[torch.Tensor], Sequence[bool]], CallResults] | None" = None

    def __call__(self, *tensors: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """The results, a tuple also of one."""
        wp.init()
        if torch.get_num_threads() > 1:
            _let_waiting_threads_sleep()
        return _WarpFunction.apply(
            self, tuple(tensor.requires_grad and torch.is_grad_enabled() for tensor in tensors), *tensors
        )

    def record(
        self, arguments: Sequence[wp.array], requires_grad: Sequence[bool]
    ) -> tuple[wp.Tape | None, tuple[wp.array, ...]]:
        """Call it with arrays, on a tape if a gradient to any is asked for: the tape and the results."""
        with recorded() if any(requires_grad) else unrecorded() as tape:
            for argument, needs_gradient in zip(arguments, requires_grad, strict=True):
                if needs_gradient:
                    require_gradient(argument)  # here, so that a graph that is captured zeroes the gradient
            results = self.function(*arguments)
        return tape, results if isinstance(results, tuple) else (results,)

    def results(self, tensors: Sequence[torch.Tensor], requires_grad: Sequence[bool]) -> CallResults:
        """The results of a call, replayed where there are graphs for it."""
        if self.find_results is None:
            return self.plain_results(tensors, requires_grad)
        with one_call:
            return self.find_results(self, tensors, requires_grad)

    def plain_results(self, tensors: Sequence[torch.Tensor], requires_grad: Sequence[bool]) -> CallResults:
        """The results of a call that runs the function."""
        arguments = [as_array(*pair) for pair in zip(tensors, self.dtypes, strict=True)]
        with one_call, current_stream(self.device):  # streams are the device's, as Warp has it, not a thread's
            tape, results = self.record(arguments, requires_grad)
        outputs = tuple(_as_tensor(result, self.device) for result in results)
        playback = None if tape is None else _Playback(tape, arguments, results)
        return CallResults(outputs, [result.requires_grad for result in results], playback)

    def change_along(
        self, tensors: Sequence[torch.Tensor], directions: Sequence[torch.Tensor | None]
    ) -> list[torch.Tensor]:
        """Change of the results as tensors move in directions d: Σ s (f(…, d⁺/s, …) − f(…, d⁻/s, …)), exact if affine.

        With d = d⁺ − d⁻ and s = max |d| the function gets no number below 0 or above 1, such as no color is.
        Differentiable: tensors, directions.
        """
        total: list[torch.Tensor] = []
        for number, (name, direction) in enumerate(zip(self.names, directions, strict=True)):
            if direction is None:
                continue
            if name not in self.affine:
                affine_names = ", ".join(item for item in self.names if item in self.affine)
                raise NotImplementedError(
                    f"{name}: got asked for a second derivative (create_graph=True, hessian or functional.jvp), "
                    "expected one of first order"
                    f"{f'; of second order there are those of {affine_names}' if affine_names else ''}"
                )
            before, after = tensors[:number], tensors[number + 1 :]
            scale = direction.detach().abs().amax() if direction.numel() else direction.new_ones(())
            scale = torch.where(scale > 0, scale, 1.0)
            positive, negative = ((direction.abs() + sign * direction) / (2 * scale) for sign in (1, -1))
            ends = (self(*before, end, *after) for end in (positive, negative))
            change = [scale * (one - other) for one, other in zip(*ends, strict=True)]
            total = [one + other for one, other in zip(total, change, strict=True)] if total else change
        return total


class _Playback:
    """A recorded call, to be played back as often as asked."""

    def __init__(self, tape: wp.Tape, arguments: list[wp.array], results: tuple[wp.array, ...]):
        self._tape, self._arguments, self._results, self._is_played = tape, arguments, results, False

    def __del__(self) -> None:
        """Let go of the gradients: results, which tensors hold, would keep the memory of all."""
        for result in self._results:
            drop_gradient(result)

    def __call__(self, adjoints: Sequence[torch.Tensor]) -> tuple[torch.Tensor | None, ...]:
        """The gradient to each argument: :data:`Playback`."""
        with one_call, current_stream(adjoints[0].device), unrecorded():
            if self._is_played:  # before, gradients are zero
                self._tape.zero()
            self._is_played = True
            # copies, since memory shared with torch is reused behind the tape's back
            for result, adjoint in zip(self._results, adjoints, strict=True):
                if result.requires_grad:
                    tensor_of(result.grad).copy_(adjoint.detach())
            self._tape.backward()
            return tuple(
                tensor_of(argument.grad).clone() if argument.requires_grad else None for argument in self._arguments
            )


class _WarpFunction(torch.autograd.Function):
    """Records Warp launches on a tape in forward and plays it back in backward."""

    @staticmethod
    def forward(ctx, function: TensorFunction, requires_grad: tuple[bool, ...], *tensors: torch.Tensor):
        results = function.results(tensors, requires_grad)
        if any(requires_grad):
            ctx.save_for_backward(*tensors)  # torch then notices if they change before backward
            ctx.function, ctx.playback = function, results.playback
            pairs = zip(results.tensors, results.require_grad, strict=True)
            ctx.mark_non_differentiable(*(tensor for tensor, requires in pairs if not requires))
        return results.tensors

    @staticmethod
    def backward(ctx, *adjoints: torch.Tensor):
        tensors = ctx.saved_tensors
        if torch.is_grad_enabled():  # create_graph=True
            return None, None, *_WarpAdjoint.apply(ctx.function, ctx.playback, len(tensors), *tensors, *adjoints)
        return None, None, *ctx.playback(adjoints)


class _WarpAdjoint(torch.autograd.Function):
    """Gradients that may be differentiated again: d⟨v, Jᵀa⟩ = d⟨a, J v⟩, and J v of an affine function is one call."""

    @staticmethod
    def forward(ctx, function: TensorFunction, playback: Playback, count: int, *arguments: torch.Tensor):
        ctx.function, ctx.count = function, count
        ctx.save_for_backward(*arguments)
        ctx.set_materialize_grads(False)
        return playback(arguments[count:])

    @staticmethod
    def backward(ctx, *directions: torch.Tensor | None):
        creates_graph = torch.is_grad_enabled()
        with torch.enable_grad():
            # views, so that gradients end here where one argument was computed from another
            arguments = [tensor.view_as(tensor) for tensor in ctx.saved_tensors]
            changes = ctx.function.change_along(arguments[: ctx.count], directions)
            pairs = zip(arguments[ctx.count :], changes, strict=True)
            total = torch.stack([(adjoint * change).sum() for adjoint, change in pairs]).sum()
            variables = [tensor for tensor in arguments if tensor.requires_grad] if total.requires_grad else []
            result = iter(
                torch.autograd.grad(total, variables, create_graph=creates_graph, allow_unused=True)
                if variables
                else ()
            )
        gradients = [next(result, None) if tensor.requires_grad else None for tensor in arguments]
        return None, None, None, *gradients


def current_stream(device: torch.device) -> wp.ScopedStream:
    """Launch on torch's current stream; Warp's own then waits for it, since Warp frees memory there.

    While a stream is captured neither waits: it may not depend on one that is not captured.
    """
    is_cuda = device.type == "cuda"
    stream = wp.stream_from_torch(torch.cuda.current_stream(device)) if is_cuda else None
    waits = not is_capturing(device)
    return wp.ScopedStream(stream, sync_enter=waits, sync_exit=waits)


def _is_on_side_stream(device: torch.device) -> bool:
    """Whether torch's current stream is one that the device's default stream does not wait for."""
    return device.type == "cuda" and torch.cuda.current_stream(device) != torch.cuda.default_stream(device)


def _as_tensor(result: wp.array, device: torch.device) -> torch.Tensor:
    """A result as a tensor: of Warp's memory, or on a side stream of torch's, whose later work Warp cannot await."""
    tensor = tensor_of(result)
    return tensor.clone() if _is_on_side_stream(device) else tensor


def is_capturing(device: torch.device) -> bool:
    """Whether torch captures a CUDA graph on its current stream."""
    return device.type == "cuda" and torch.cuda.is_current_stream_capturing()


def check_float32(name: str, tensor: object) -> None:
    """Raise ValueError unless it is a tensor of float32."""
    if not isinstance(tensor, torch.Tensor):
        raise ValueError(
            f"{name}: got {type(tensor).__name__}, expected a tensor of torch.float32: "
            "torch.as_tensor(…, dtype=torch.float32)"
        )
    if tensor.dtype != torch.float32:
        remedy = ".float() converts it"
        if tensor.dtype == torch.uint8:
            remedy = "of an 8-bit picture warpshadow.srgb_to_linear(values / 255)"
        raise ValueError(f"{name}: got {tensor.dtype}, expected a tensor of torch.float32: {remedy}")
