"""Threads: any number of them may call the library, which does the work of one call after another.

Warp loads modules and makes kernels on the thread that first needs them, and neither bears company (1.19: two threads
that load at once lose kernels). So whatever is called from outside and launches kernels holds one lock, which also
guards what renderers keep between calls. Nothing is lost by it: a call runs on all cores (:mod:`warpshadow.parallel`),
and what lies between launches is Python, which runs one thread at a time.
"""

import functools
import os
import threading
from collections.abc import Callable
from typing import ParamSpec, TypeVar

P = ParamSpec("P")
R = TypeVar("R")

one_call = threading.RLock()
"""Held by the thread whose call runs."""

if hasattr(os, "register_at_fork"):  # a child would wait for ever for a thread that it does not have
    os.register_at_fork(before=one_call.acquire, after_in_parent=one_call.release, after_in_child=one_call.release)


def one_at_a_time(function: Callable[P, R]) -> Callable[P, R]:
    """Make a function that waits until no other thread is in one of these."""

    @functools.wraps(function)
    def alone(*args: P.args, **kwargs: P.kwargs) -> R:
        with one_call:
            return function(*args, **kwargs)

    return alone
