"""Warp in torch's autograd: functions of arrays are applied to tensors."""

import functools
import os
import sys
import threading
from collections.abc import Callable, Sequence
from typing import overload

import torch
import warp as wp

from warpshadow.device.tape import recorded, unrecorded
from warpshadow.device.threads import one_call


@overload
def apply(
    function: Callable[..., tuple[wp.array, ...]],
    *tensors: torch.Tensor,
    dtypes: Sequence[type],
    device: torch.device | None = None,
) -> tuple[torch.Tensor, ...]: ...


@overload
def apply(
    function: Callable[..., wp.array],
    *tensors: torch.Tensor,
    dtypes: Sequence[type],
    device: torch.device | None = None,
) -> torch.Tensor: ...


def apply(
    function: Callable[..., wp.array | tuple[wp.array, ...]],
    *tensors: torch.Tensor,
    dtypes: Sequence[type],
    device: torch.device | None = None,
) -> torch.Tensor | tuple[torch.Tensor, ...]:
    """Apply a differentiable function of Warp arrays to tensors.

    Args:
        function: Takes an array for each tensor and returns an array, or a tuple of them; what it launches is recorded
            on a tape of this thread's if a tensor requires a gradient.
        tensors: Float32; contiguous or not. Items of a dtype lie in the last dimensions: a [batch, vertex, 3] tensor
            is an array of vec3 of shape [batch, vertex].
        dtypes: Warp's dtype of each.
        device: Where the function runs, by default the tensors' own; launched on torch's current stream there.

    Returns:
        The array as a tensor, or a tuple of tensors for a tuple of arrays.

    Differentiable: as the function is, once.
    """
    for number, tensor in enumerate(tensors):
        check_float32(f"tensors[{number}]", tensor)
    wp.init()
    if torch.get_num_threads() > 1:
        _let_waiting_threads_sleep()
    wants = tuple(tensor.requires_grad and torch.is_grad_enabled() for tensor in tensors)
    results = _WarpFunction.apply(function, tuple(dtypes), wants, device or tensors[0].device, *tensors)
    return results if len(results) > 1 else results[0]


@functools.cache
def _let_waiting_threads_sleep() -> None:
    """Let the threads of torch's OpenMP sleep where they wait for each other, rather than spin.

    They spin for milliseconds before they sleep, which is quickest if each has a core to itself. Beside other work, or
    the threads of our own pool, they use up their share of the cores by spinning, and the thread that all wait for is
    the last to run: each operation on more than 32 768 numbers then takes tens of milliseconds. GNU's OpenMP spins for
    microseconds once it has more threads than there are cores (its manual, GOMP_SPINCOUNT). So it is given some that
    sleep for good. No setting of torch changes; and what the environment says about waiting is left alone.
    """
    is_said = "OMP_WAIT_POLICY" in os.environ or "GOMP_SPINCOUNT" in os.environ
    if is_said or sys.platform != "linux" or not torch.backends.openmp.is_available():
        return
    others = torch.get_num_threads() - 1  # that a team has beside the thread that begins it
    started = [threading.Event() for _ in range(-(-len(os.sched_getaffinity(0)) // others))]

    def begin_team(is_started: threading.Event) -> None:
        torch.zeros(1 << 17).add_(1.0)
        is_started.set()
        threading.Event().wait()  # a team ends with the thread that began it

    for event in started:
        threading.Thread(target=begin_team, args=(event,), name="warpshadow-sleeper", daemon=True).start()
    for event in started:
        event.wait()


def as_array(tensor: torch.Tensor, dtype: type) -> wp.array:
    """A tensor as an array that requires no gradient, of the same memory if that is contiguous."""
    array = wp.from_torch(tensor.detach().contiguous(), dtype=dtype, requires_grad=False)
    if not tensor.is_inference():  # a renderer on a GPU knows by it what has not been written to
        array.origin, array.version = tensor if tensor._base is None else tensor._base, tensor._version
    return array


class _WarpFunction(torch.autograd.Function):
    """Records Warp launches on a tape in forward and plays it back in backward, as often as asked."""

    @staticmethod
    def forward(
        ctx,
        function: Callable,
        dtypes: tuple[type, ...],
        wants: tuple[bool, ...],
        device: torch.device,
        *tensors: torch.Tensor,
    ):
        arguments = [as_array(*pair) for pair in zip(tensors, dtypes, strict=True)]
        # streams are the device's, as Warp has it, not a thread's
        with one_call, _current_stream(device), recorded() if any(wants) else unrecorded() as tape:
            for argument, is_wanted in zip(arguments, wants, strict=True):
                argument.requires_grad = is_wanted  # here, so that a graph that is captured zeroes the gradient
            results = function(*arguments)
        results = results if isinstance(results, tuple) else (results,)
        outputs = tuple(wp.to_torch(result, requires_grad=False) for result in results)
        if any(wants):
            ctx.save_for_backward(*tensors)  # torch then notices if they change before backward
            ctx.tape, ctx.arguments, ctx.results, ctx.is_played = tape, arguments, results, False
            pairs = zip(outputs, results, strict=True)
            ctx.mark_non_differentiable(*(output for output, result in pairs if not result.requires_grad))
        return outputs

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, *gradients: torch.Tensor):
        ctx.saved_tensors  # noqa: B018
        with one_call, _current_stream(gradients[0].device), unrecorded():
            if ctx.is_played:  # before, gradients are zero
                ctx.tape.zero()
            ctx.is_played = True
            # copies, since memory shared with torch is reused behind the tape's back
            for result, gradient in zip(ctx.results, gradients, strict=True):
                if result.requires_grad:
                    wp.copy(result.grad, wp.from_torch(gradient.detach().contiguous(), dtype=result.dtype))
            ctx.tape.backward()
            found = [
                wp.to_torch(argument.grad, requires_grad=False).clone() if argument.requires_grad else None
                for argument in ctx.arguments
            ]
        return None, None, None, None, *found


def _current_stream(device: torch.device) -> wp.ScopedStream:
    """Launch on torch's current stream, which while it is captured must not wait for streams that are not."""
    is_cuda = device.type == "cuda"
    stream = wp.stream_from_torch(torch.cuda.current_stream(device)) if is_cuda else None
    return wp.ScopedStream(stream, sync_enter=not is_capturing(device))


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
        raise ValueError(f"{name}: got {tensor.dtype}, expected a tensor of torch.float32: .float() converts it")
