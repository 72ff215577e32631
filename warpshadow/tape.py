"""Warp's tape: adjoints written by hand go under it, and what needs no gradient stays off it."""

import contextlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import warp as wp


def record_adjoint(adjoint: Callable[[], None], arrays: Iterable[wp.array | None]) -> None:
    """Record an adjoint on the tape that is recording, if one is and any of the arrays requires a gradient.

    Args:
        adjoint: Launches that add to the gradients of the inputs, called when the tape plays back.
        arrays: What it reads and writes the gradients of; the tape zeroes them; None is passed over.
    """
    tape = wp._src.context.runtime.tape  # Warp has no public way to ask
    wanted = [array for array in arrays if array is not None and array.requires_grad]
    if tape is not None and wanted:
        tape.record_func(adjoint, wanted)


def launch(
    kernel: wp.Kernel, dim: int | Sequence[int], *, inputs: Sequence[Any], outputs: Sequence[wp.array], device: Any
) -> None:
    """Launch a kernel, on the tape only if an input requires a gradient.

    Warp records every launch, and playing it back compiles its adjoint and runs it, be a gradient asked for or not.
    """
    is_wanted = any(isinstance(value, wp.array) and value.requires_grad for value in inputs)
    wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=device, record_tape=is_wanted)


@contextlib.contextmanager
def unrecorded() -> Iterator[None]:
    """Launch beside the tape that is recording, if one is."""
    runtime = wp._src.context.runtime  # Warp has no public way to ask
    tape = None if runtime is None else runtime.tape
    if tape is None:
        yield
        return
    runtime.tape = None
    try:
        yield
    finally:
        runtime.tape = tape
