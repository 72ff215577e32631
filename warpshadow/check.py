"""Argument checks: one clear error that names the argument, what it got and what it accepts."""

from __future__ import annotations

import difflib
from collections.abc import Iterable

import numpy as np


def choice(name: str, value: object, choices: Iterable[object]) -> None:
    """Raise ValueError unless ``value`` is one of ``choices``; the message names the nearest one."""
    choices = list(choices)
    if value in choices:
        return
    accepted = ", ".join(map(repr, choices))
    raise ValueError(f"{name}: got {value!r}, expected one of {accepted}{_suggestion(value, choices)}")


def known_keys(where: str, keys: Iterable[str], known: Iterable[str]) -> None:
    """Raise ValueError for the first of ``keys`` that is not ``known``; the message names the nearest one."""
    known = list(known)
    for key in keys:
        if key not in known:
            raise ValueError(
                f"{where}: unknown key {key!r}{_suggestion(key, known)}; known keys are {', '.join(known)}"
            )


def finite(name: str, values: np.ndarray) -> None:
    """Raise ValueError when a floating-point array holds NaN or Inf, with their count and the first place."""
    bad = ~np.isfinite(values)
    if bad.any():
        place = tuple(int(i) for i in np.argwhere(bad)[0])
        raise ValueError(
            f"{name}: got {int(bad.sum())} NaN or Inf values (first at index {place}), expected finite numbers"
        )


def shape(name: str, got: tuple[int, ...], expected: tuple[int | str, ...]) -> None:
    """Raise ValueError unless ``got`` matches ``expected``, where a string stands for any length."""
    matches = len(got) == len(expected) and all(
        isinstance(wanted, str) or have == wanted for have, wanted in zip(got, expected, strict=True)
    )
    if not matches:
        raise ValueError(f"{name}: got shape {tuple(got)}, expected [{', '.join(map(str, expected))}]")


def _suggestion(value: object, choices: list) -> str:
    near = difflib.get_close_matches(str(value), map(str, choices), n=1, cutoff=0.5)
    return f" (did you mean {near[0]!r}?)" if near else ""
