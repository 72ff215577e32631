"""Methods of a renderer that one of its parts does."""

import functools
from collections.abc import Callable
from typing import Any, Concatenate, ParamSpec, TypeVar

from warpshadow.device.threads import locked

P = ParamSpec("P")
R = TypeVar("R")


def delegated(part: str, function: Callable[Concatenate[Any, P], R]) -> Callable[Concatenate[Any, P], R]:
    """Make a method of a part one of the renderer that has the part; it waits until no other thread is in a call."""

    @locked
    @functools.wraps(function)
    def called(self: Any, *args: P.args, **kwargs: P.kwargs) -> R:
        return function(getattr(self, part), *args, **kwargs)

    return called
