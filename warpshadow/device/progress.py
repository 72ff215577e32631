"""Progress bars: one for one wait, after a second, in terminals and notebooks."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator
from typing import Any

_DELAY = 1.0  # before a bar shows [s]


class _Shown(threading.local):
    """The bar that a thread shows."""

    bar: Any = None


_shown = _Shown()


@contextlib.contextmanager
def progress_bar(total: int, what: str, unit: str, *, wanted: bool = True, stays: bool = False) -> Iterator[Any]:
    """Show a bar while a block runs, if that takes longer than a second; within another bar, its words alone.

    Args:
        total: Number of units.
        what: What is done, such as "shading".
        unit: What is counted, such as "receiver".
        wanted: Whether to show it.
        stays: Whether it shows at once, and the full bar stays on the terminal.

    Returns:
        A bar of tqdm's, on which the block calls ``update(count)``.
    """
    from tqdm.auto import tqdm

    outer = _shown.bar
    is_seen = wanted and outer is None
    delay = 0 if stays else _DELAY
    with tqdm(total=total, desc=what, unit=unit, delay=delay, leave=stays, disable=not is_seen) as bar:
        if is_seen:
            _shown.bar = bar
        elif wanted:
            outer.set_postfix_str(what)
        try:
            yield bar
        finally:
            if is_seen:
                _shown.bar = None
            elif wanted:
                outer.set_postfix_str("", refresh=False)
