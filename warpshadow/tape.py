"""Adjoints written by hand, under Warp's tape."""

from collections.abc import Callable, Iterable

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
