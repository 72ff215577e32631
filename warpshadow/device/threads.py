"""Threads: any number of them may call the library, which does the work of one call after another.

Loading modules and making kernels is not thread-safe in Warp (1.19: two threads that load at once lose kernels). One
lock guards both, and the renderers' caches. These hold it: renderers, fits of spheres, `tune`, deformation graphs,
captured graphs, and everything in torch. The functions of single stages do not. Little is lost by it: a call runs on
all cores (:mod:`warpshadow.device.parallel`), and Python between launches runs one thread at a time.
"""

import functools
import os
import threading
from collections.abc import Callable
from typing import Concatenate, ParamSpec, Protocol, TypeVar

from warpshadow.device.array_checks import late_checks
from warpshadow.device.progress import waiting

P = ParamSpec("P")
R = TypeVar("R")

one_call = threading.RLock()  # held by the thread whose call runs

if hasattr(os, "register_at_fork"):  # a child would wait for ever for a thread that it does not have
    os.register_at_fork(before=one_call.acquire, after_in_parent=one_call.release, after_in_child=one_call.release)


def locked(function: Callable[P, R]) -> Callable[P, R]:
    """Hold the lock during a function, so that no two threads run such functions at once."""

    @functools.wraps(function)
    def alone(*args: P.args, **kwargs: P.kwargs) -> R:
        with one_call, late_checks():
            return function(*args, **kwargs)

    return alone


class _HasProgress(Protocol):
    @property
    def progress(self) -> bool:
        """Whether it shows its progress."""


Shown = TypeVar("Shown", bound=_HasProgress)


def with_lock_and_progress(function: Callable[Concatenate[Shown, P], R]) -> Callable[Concatenate[Shown, P], R]:
    """Hold the lock during a method, and print progress lines if it takes long and output goes to a file."""

    @locked
    @functools.wraps(function)
    def reporting(self: Shown, *args: P.args, **kwargs: P.kwargs) -> R:
        with waiting("rendering", shows=self.progress):
            return function(self, *args, **kwargs)

    return reporting
