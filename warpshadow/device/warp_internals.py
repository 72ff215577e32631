"""All uses of Warp's private interface: a release of Warp may change them without notice.

``tests/device/test_warp_internals.py`` tells which of these a release breaks. pyproject.toml accepts the releases that
have passed it.
"""

import contextlib
import copy
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import warp as wp


class _TapeOfThread(threading.local):
    """Warp's ``runtime.tape`` as each thread sees it; Warp asks and sets it by this attribute alone."""

    def __init__(self) -> None:
        self.own: list[wp.Tape | None] = []  # the thread's, the last of which is in use; without any the process's is

    def __get__(self, runtime: Any, owner: type | None = None) -> Any:
        if runtime is None:
            return self
        return self.own[-1] if self.own else vars(runtime).get("tape")

    def __set__(self, runtime: Any, tape: wp.Tape | None) -> None:
        if self.own:
            self.own[-1] = tape
        else:
            vars(runtime)["tape"] = tape


_Runtime = wp._src.context.Runtime
if "tape" not in vars(_Runtime):
    _Runtime.tape = _TapeOfThread()


def current_tape() -> wp.Tape | None:
    """The tape that records this thread's launches."""
    return wp._src.context.runtime.tape


@contextlib.contextmanager
def own_tape(tape: wp.Tape | None) -> Iterator[None]:
    """Record this thread's launches on a tape that other threads do not see; None for no recording."""
    own = _Runtime.tape.own
    own.append(tape)
    try:
        yield
    finally:
        own.pop()


def resized_launch(command: wp.Launch, dim: Sequence[int]) -> wp.Launch:
    """Copy a recorded launch, with other dimensions and arguments of its own."""
    copied = copy.copy(command)
    copied.params, copied.fwd_args = list(command.params), list(command.fwd_args)
    copied.adj_args = None if command.adj_args is None else list(command.adj_args)
    copied.set_dim(list(dim))
    return copied


def item_shape(dtype: type) -> tuple[int, ...]:
    """Shape of an item of a dtype: (3,) of vec3, () of float32."""
    return getattr(dtype, "_shape_", ())


def scalar_type(dtype: type) -> type:
    """Type of the numbers in an item of a dtype: float32 of vec3, and of float32 itself."""
    return getattr(dtype, "_wp_scalar_type_", dtype)


def is_view(array: wp.array) -> bool:
    """Whether an array is a part of another, or another of its shapes."""
    return getattr(array, "_ref", None) is not None


def kernel_modules() -> dict[str, wp.Module]:
    """Warp's modules by the names of the Python modules whose kernels they hold."""
    return wp._src.context.user_modules


def around_compilation(context: Callable[[str], contextlib.AbstractContextManager]) -> None:
    """From now on, compile modules of kernels within a context, which is made of the folder that they are put in.

    A module that was compiled before, maybe where nothing can be written, is read without.
    """
    compile_before = wp.Module._compile

    def compile_within(
        module: wp.Module, device: Any = None, output_dir: Any = None, *rest: Any, **options: Any
    ) -> bool:
        is_new = output_dir is not None and not os.path.exists(output_dir)
        with context(os.fspath(output_dir)) if is_new else contextlib.nullcontext():
            return compile_before(module, device, output_dir, *rest, **options)

    wp.Module._compile = compile_within


def compile_in_turn() -> None:
    """From now on, let one process compile a module that several need: others wait, and load it from Warp's cache.

    Should it be killed, its lock ends with it, and the next compiles.
    """
    around_compilation(_locked)


@contextlib.contextmanager
def _locked(folder: str) -> Iterator[None]:
    from filelock import FileLock

    lock = FileLock(f"{folder}.lock")
    with lock:
        try:
            yield
        finally:
            with contextlib.suppress(OSError):  # of Windows, where filelock removes it
                os.unlink(lock.lock_file)
