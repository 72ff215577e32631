"""Warp's tape: each thread may have its own, and adjoints written by hand go on it.

Warp has one tape for the process: launches of all threads land on the tape that any of them has opened. Here a thread
may have one of its own, which other threads neither see nor close. Tapes that others open by ``with wp.Tape()`` are
the process's, as they were.
"""

import contextlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import warp as wp

from warpshadow.device import warp_internals
from warpshadow.device.memory import ZeroedMemory
from warpshadow.device.warp_internals import current_tape, thread_tape, verify_access


class Recording(wp.Tape):
    """A tape, and memory for the gradients that are asked for while it records."""

    def __init__(self) -> None:
        super().__init__()
        self.memory = ZeroedMemory()


@contextlib.contextmanager
def recorded() -> Iterator[wp.Tape]:
    """Record this thread's launches on a tape of their own, whatever tape is open around them or in other threads."""
    tape = Recording()
    with thread_tape(tape):
        yield tape
    tape.memory.end()


@contextlib.contextmanager
def unrecorded() -> Iterator[None]:
    """Record nothing that this thread launches."""
    with thread_tape(None):
        yield


def record_adjoint(adjoint: Callable[[], None], arrays: Iterable[wp.array | None]) -> None:
    """Record an adjoint on the tape that is recording, if one is and any of the arrays requires a gradient.

    Args:
        adjoint: Launches that add to the gradients of the inputs, called when the tape plays back.
        arrays: Arrays whose gradients it reads and writes; the tape zeroes them; None is skipped.
    """
    tape = current_tape()
    variables = [array for array in arrays if array is not None and array.requires_grad]
    if tape is not None and variables:
        tape.launches.append(adjoint)  # record_func looks at each array anew
        tape.gradients.update((array, array.grad) for array in variables)


def record_kernel(kernel: wp.Kernel, dim: Sequence[int], arguments: Sequence[Any], device: wp.Device) -> None:
    """Record Warp's adjoint of a kernel that was launched on the tape that is recording, if one is."""
    tape = current_tape()
    if tape is None:
        return
    gradients_of(arguments, tape)  # which the tape zeroes

    def play_back() -> None:
        warp_internals.bound_kernel(kernel, arguments, device, gradients=gradients_of(arguments))(dim)

    tape.launches.append(play_back)
    verify_access(tape, kernel, arguments)


def gradients_of(arguments: Sequence[Any], tape: wp.Tape | None = None) -> list[Any]:
    """Gradients of a kernel's arguments, None of an argument that has none; a tape that is given keeps them, too."""
    gradients: list[Any] = []
    for value in arguments:
        gradient = None
        if type(value) is wp.array:
            gradient = value.grad
            if gradient is not None and tape is not None:
                tape.gradients[value] = gradient
        elif value is not None and not isinstance(value, (int, float)):  # a struct has gradients of its arrays
            gradient = (tape or wp.Tape()).get_adjoint(value)
        gradients.append(gradient)
    return gradients


def record(function: Callable[[], None]) -> None:
    """Record a function that the tape that is recording, if one is, calls when it plays back to here."""
    tape = current_tape()
    if tape is not None:
        tape.launches.append(function)
