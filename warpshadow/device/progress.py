"""Progress bars: one for one wait, after a second, in terminals and notebooks; none in files."""

from __future__ import annotations

import builtins
import contextlib
import sys
import threading
import time
from collections.abc import Iterator
from typing import Any

_DELAY = 1.0  # before a bar shows [s]


class _Shown(threading.local):
    """The bar that a thread shows."""

    bar: Any = None


class _Wish:
    """Whether bars may show, in all of the process."""

    shows = True


_shown = _Shown()


def show_bars(wanted: bool) -> None:
    """Let bars show from now on, or none, whatever functions are told."""
    _Wish.shows = wanted


def in_ipython() -> bool:
    """Whether this runs in IPython, which notebooks do."""
    return hasattr(builtins, "__IPYTHON__")


def _can_be_seen() -> bool:
    """Whether what is shown can change: in a file, every state of a bar would stay."""
    return in_ipython() or (sys.stderr is not None and sys.stderr.isatty())


class _Within:
    """What a block within another bar updates: once it takes longer than a second, the bar says what it waits for."""

    def __init__(self, bar: Any, what: str):
        self._bar, self._what, self._start = bar, what, time.monotonic()

    def update(self, count: int = 1) -> None:
        """Called as a bar's."""
        if self._what and time.monotonic() - self._start >= _DELAY:
            self._bar.set_postfix_str(self._what)
            self._what = ""  # said


@contextlib.contextmanager
def progress_bar(total: int | None, what: str, unit: str, *, wanted: bool = True, stays: bool = False) -> Iterator[Any]:
    """Show a bar while a block runs, if that takes longer than a second; within another bar, its words alone.

    None shows where stderr is neither a terminal nor a notebook's.

    Args:
        total: Number of units; None where it is not known.
        what: What is done, such as "shading".
        unit: What is counted, such as "receiver".
        wanted: Whether to show it.
        stays: Whether it shows at once, and the full bar stays on the terminal.

    Returns:
        A bar of tqdm's, on which the block calls ``update(count)``.
    """
    from tqdm.auto import tqdm

    wanted = wanted and _Wish.shows and _can_be_seen()
    outer = _shown.bar
    if wanted and outer is not None:
        try:
            yield _Within(outer, what)
        finally:
            outer.set_postfix_str("", refresh=False)
        return
    delay = 0 if stays else _DELAY
    with tqdm(total=total, desc=what, unit=unit, delay=delay, leave=stays, disable=not wanted) as bar:
        try:
            _shown.bar = bar if wanted else outer
            yield bar
        finally:
            _shown.bar = outer
