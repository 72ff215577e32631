"""Methods of an object that one of its parts does."""

import functools
from collections.abc import Callable
from typing import Any, Concatenate, ParamSpec, TypeVar

P = ParamSpec("P")
R = TypeVar("R")


def delegated(part: str, function: Callable[Concatenate[Any, P], R]) -> Callable[Concatenate[Any, P], R]:
    """Make a method of a part one of the object that has the part."""

    @functools.wraps(function)
    def called(self: Any, *args: P.args, **kwargs: P.kwargs) -> R:
        return function(getattr(self, part), *args, **kwargs)

    return called
