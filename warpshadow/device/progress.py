"""Progress: bars in terminals and notebooks, from a second on; elsewhere a line every ten seconds.

One wait has one bar or line. Work within it, such as the compilation of kernels, is named there, too, also of other
threads. Lines tell of a call of a renderer that lasts ten seconds by itself: bars of a loop of shorter calls would say
nothing.
"""

import builtins
import contextlib
import itertools
import math
import os
import sys
import threading
import time
import warnings
from collections.abc import Iterator
from typing import Any

from warpshadow.device.parallel import thread_count
from warpshadow.device.warp_internals import around_compilation, load_silently

_DELAY = 1.0  # time before a bar shows, and between its states where nothing is done [s]
_LINE_INTERVAL = 10.0  # time between lines [s]

ANNOUNCED_SECONDS = 30.0  # time of work beyond which it is announced, with the setting that avoids it [s]

_bars_show = True  # whether bars and lines may show, in all of the process


def show_bars(shows: bool) -> None:
    """Show progress bars and lines from now on, or hide all, whatever ``progress`` functions get."""
    global _bars_show
    _bars_show = shows


def report_every(seconds: float) -> None:
    """Set the time between progress lines where no bar can show; ten seconds without."""
    global _LINE_INTERVAL
    _LINE_INTERVAL = seconds


def in_ipython() -> bool:
    """Whether this runs in IPython, which notebooks do."""
    return hasattr(builtins, "__IPYTHON__")


def _can_be_seen() -> bool:
    """Whether output can be overwritten: in a file, every state of a bar would stay."""
    return in_ipython() or (sys.stderr is not None and sys.stderr.isatty())


def say(text: str) -> None:
    """Write a line to stderr, above a bar that shows."""
    if sys.stderr is None:  # as of a service
        return
    from tqdm import tqdm

    with contextlib.suppress(OSError, ValueError):  # of a closed file
        tqdm.write(text, file=sys.stderr)
        sys.stderr.flush()


def remark(text: str, *, shows: bool = True) -> None:
    """Write a line to stderr, unless progress is hidden."""
    if shows and _bars_show:
        say(text)


def announce(work: str, seconds: float, alternative: str, *, shows: bool = True) -> None:
    """Announce work of more than half a minute: its time, and a setting that avoids it.

    Args:
        work: Name of the work, such as "tracing the shadow of a body on itself".
        seconds: How long it takes on one thread [s]; it runs on all.
        alternative: A setting that avoids the work, such as 'method="ray-traced" needs none'.
        shows: Whether to say it.
    """
    seconds /= thread_count()
    if seconds > ANNOUNCED_SECONDS:
        remark(f"{work} takes about {show_time(seconds)}, {alternative}", shows=shows)


def show_time(seconds: float) -> str:
    """A time as people say it."""
    if seconds < 120:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"


class Wait:
    """Work that somebody waits for, and how much of it is done.

    Args:
        label, total, unit, done: As of a :func:`progress_bar`.
        patience: Time before lines tell of it, and of work within it [s].
    """

    def __init__(self, label: str = "", total: int | None = None, unit: str = "", done: int = 0, patience: float = 0.0):
        self.label, self.total, self.unit, self.done, self.patience = label, total, unit, done, patience
        self.remark = ""
        self.bar: Any = None  # tqdm's, where it shows one
        self._start = time.monotonic()
        self._done_at_start, self._label_start = done, self._start  # of the work that the label names
        self._compiled_at_start = _compile_seconds

    @property
    def age(self) -> float:
        """Elapsed time [s]."""
        return time.monotonic() - self._start

    def update(self, count: int = 1) -> None:
        """Count units that are done."""
        self.done += count
        if self.bar is not None:
            self.bar.update(count)

    def expect(self, left: int) -> None:
        """Let so many more units follow, where these are fewer or more than was thought."""
        if self.total == self.done + left:
            return
        self.total = self.done + left
        if self.bar is not None:
            self.bar.total = self.total
            if hasattr(self.bar, "container"):  # a notebook's, whose widget has a total of its own
                self.bar.container.children[1].max = self.total
            self.bar.refresh()

    def describe(self, label: str, remark: str = "") -> None:
        """Label the bar, from its next update, with the work under way, which has a pace of its own, and a remark."""
        if label != self.label:
            self._done_at_start, self._label_start = self.done, time.monotonic()
            self._compiled_at_start = _compile_seconds
        self.label, self.remark = label, remark
        if self.bar is not None:
            self.bar.set_description_str(label, refresh=False)
            self.bar.set_postfix_str(remark, refresh=False)

    def line(self) -> str:
        """Progress, as text."""
        parts = [show_time(self.age)]
        if self.unit and self.total is not None:
            parts.insert(0, f"{self.done:,} of {self.total:,} {self.unit}s")
            if self.done > self._done_at_start:
                compiling = _compile_seconds - self._compiled_at_start  # once: it tells nothing of the steps to come
                age = max(time.monotonic() - self._label_start - compiling, 0.0)
                left = age * max(self.total - self.done, 0) / (self.done - self._done_at_start)
                parts.append(f"{show_time(left)} left")
        if self.remark:
            parts.append(self.remark)
        return f"{self.label}: {', '.join(parts)}"


_waits: list[Wait] = []  # of all threads, the innermost last
_lock = threading.RLock()  # guards them, and the bar
_reporter: threading.Thread | None = None  # while there are any
_line_time = _end_time = -math.inf  # when the last line was said, and a wait ended


class _ThreadState(threading.local):
    """Whether a thread is within a call that says nothing."""

    is_hidden = False


_this_thread = _ThreadState()


def _begin_anew() -> None:
    """Forget all waits: a process that was forked has them, but not the threads."""
    global _lock, _reporter
    _lock, _reporter = threading.RLock(), None
    _waits.clear()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_begin_anew)


@contextlib.contextmanager
def _reported(wait: Wait) -> Iterator[None]:
    """Report a wait while a block runs."""
    global _reporter, _line_time, _end_time
    with _lock:
        if not _waits and time.monotonic() - _end_time >= _LINE_INTERVAL:
            _line_time = time.monotonic()
        _waits.append(wait)
        if _reporter is None:
            _reporter = threading.Thread(target=_report, name="warpshadow-progress", daemon=True)
            _reporter.start()
    try:
        yield
    finally:
        with _lock:
            _waits.remove(wait)
            if wait.bar is not None:
                wait.bar.close()
            _name_inner_work(refresh=False)
            _end_time = time.monotonic()


def _report() -> None:
    """Draw the bar, or say lines, until no wait is left."""
    global _reporter, _line_time
    while True:
        time.sleep(min(_DELAY, _LINE_INTERVAL) / 2)
        with _lock:
            if not _waits:
                _reporter = None
                return
            if _can_be_seen():
                _name_inner_work(refresh=True)
                continue
            long_waits = [wait for wait in _waits if wait.age >= _DELAY]
            is_due = time.monotonic() - _line_time >= _LINE_INTERVAL
            if is_due and long_waits and long_waits[0].age >= long_waits[0].patience:
                _line_time = time.monotonic()
                say("; ".join(wait.line() for wait in long_waits))


def _name_inner_work(*, refresh: bool) -> None:
    """Name the innermost wait behind the bar; bars of notebooks are drawn by their own threads alone."""
    long_waits = [wait for wait in _waits if wait.age >= _DELAY]
    outer = next((wait for wait in long_waits if wait.bar is not None), None)
    if outer is not None and not in_ipython():
        inner = long_waits[-1]
        outer.bar.set_postfix_str(outer.remark if inner is outer else inner.label, refresh=refresh)


@contextlib.contextmanager
def waiting(label: str, *, shows: bool = True) -> Iterator[None]:
    """Say in files every ten seconds that a block runs, if it lasts as long; bars within it show as without.

    Args:
        label: Label of the work, such as "rendering".
        shows: Whether to say anything, of compiled kernels too.
    """
    if _waits or _this_thread.is_hidden:
        yield
    elif shows and _bars_show:
        with _reported(Wait(label, patience=_LINE_INTERVAL)):
            yield
    else:
        _this_thread.is_hidden = True
        try:
            yield
        finally:
            _this_thread.is_hidden = False


@contextlib.contextmanager
def progress_bar(
    total: int | None, label: str, unit: str, *, done: int = 0, shows: bool = True, stays: bool = False
) -> Iterator[Wait]:
    """Show a bar while a block runs, if that takes longer than a second; within another bar, its label alone.

    Where stderr is neither a terminal nor a notebook's, a line says every ten seconds how far it is.

    Args:
        total: Number of units; None where it is not known.
        label: Label of the work, such as "shading".
        unit: Unit of the count, such as "receiver"; empty where nothing is counted.
        done: Units that were done before.
        shows: Whether to show it.
        stays: Whether it shows at once, and the full bar stays on the terminal.
    Returns:
        On it the block calls ``update(count)``, and ``expect(left)`` where it ends early.
    """
    wait = Wait(label, total, unit, done)
    if not (shows and _bars_show):
        yield wait
        return
    if _can_be_seen() and all(outer.bar is None for outer in _waits):
        with warnings.catch_warnings():  # of a notebook without ipywidgets, whose bars are text then
            warnings.filterwarnings("ignore", "IProgress not found")
            from tqdm.auto import tqdm

        only_time = {} if unit else {"bar_format": "{desc} [{elapsed}]"}
        delay = 0 if stays else _DELAY
        wait.bar = tqdm(total=total, desc=label, unit=unit, initial=done, delay=delay, leave=stays, **only_time)
    with _reported(wait):
        yield wait


_module_numbers = itertools.count(1)
_compile_seconds = 0.0  # that kernels took to compile in this process [s]


@contextlib.contextmanager
def _compiling() -> Iterator[None]:
    """Say that kernels are compiled, and the number of their module in this process."""
    global _compile_seconds
    start = time.monotonic()
    label = f"compiling kernels, module {next(_module_numbers)}"
    try:
        with progress_bar(None, label, "", shows=not _this_thread.is_hidden):
            yield
    finally:
        _compile_seconds += time.monotonic() - start


around_compilation(_compiling)
load_silently("warpshadow")
