"""Argument checks: one clear error that names the argument, what it got and what it accepts."""

import difflib
from collections.abc import Collection, Iterable, Mapping

import numpy as np
import warp as wp

LARGEST = 1.0e18
"""The largest magnitude of any number that is given: its square, summed up, still fits a float32."""


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


def finite(name: str, values: np.ndarray, *, least: float = -LARGEST, most: float = LARGEST) -> None:
    """Raise ValueError when an array holds NaN, Inf or numbers out of range, with their count and the first place."""
    bad = ~np.isfinite(values)
    if bad.any():
        place = tuple(int(i) for i in np.argwhere(bad)[0])
        raise ValueError(
            f"{name}: got {int(bad.sum())} NaN or Inf values (first at index {place}), expected finite numbers"
        )
    outside = (values < least) | (values > most)
    if outside.any():
        place = tuple(int(i) for i in np.argwhere(outside)[0])
        raise ValueError(
            f"{name}: got {int(outside.sum())} values out of range (first at index {place}: {values[place]:g}), "
            f"expected {least:g} to {most:g}"
        )


@wp.kernel(enable_backward=False)
def _count_outside(
    # in
    values: wp.array(dtype=wp.float32),
    least: float,
    most: float,
    argument: int,
    # out
    faults: wp.array(dtype=wp.int32),
):
    """A thread owns a number."""
    value = values[wp.tid()]
    if not (value >= least and value <= most):  # so NaN, too
        wp.atomic_add(faults, argument, 1)


def finite_arrays(
    arrays: Mapping[str, wp.array | None], *, most: float = LARGEST, nonnegative: Collection[str] = ()
) -> None:
    """Raise ValueError when float32 arrays on a device hold NaN, Inf or numbers out of range, of whatever dtype.

    On a GPU, one count for all of them is read back, which waits for the device. While a CUDA graph is captured that
    cannot be, and nothing is checked.

    Args:
        arrays: By the names of their arguments; None is passed over.
        most: Largest magnitude that is accepted.
        nonnegative: Names of the arrays that must hold nothing below 0.
    """
    present = {name: array for name, array in arrays.items() if array is not None and array.size}
    if not present or any(array.device.is_capturing for array in present.values()):
        return
    ranges = {name: (0.0 if name in nonnegative else -most, most) for name in present}
    is_on_host = all(array.device.is_cpu for array in present.values())
    find = _outside_on_host if is_on_host else _outside_on_device
    for name in find(present, ranges):
        finite(name, present[name].numpy(), least=ranges[name][0], most=most)


def _outside_on_host(arrays: Mapping[str, wp.array], ranges: Mapping[str, tuple[float, float]]) -> list[str]:
    """Names of the arrays that hold a number out of their range, by NumPy."""
    views = {name: array.numpy() for name, array in arrays.items()}
    return [
        name
        for name, (least, most) in ranges.items()
        if not least <= views[name].min() <= views[name].max() <= most  # NaN is the least and the largest of any
    ]


def _outside_on_device(arrays: Mapping[str, wp.array], ranges: Mapping[str, tuple[float, float]]) -> list[str]:
    """The same by a kernel, with one readback."""
    device = next(iter(arrays.values())).device
    faults = wp.zeros(len(arrays), dtype=wp.int32, device=device)
    for argument, (name, array) in enumerate(arrays.items()):
        values = _scalars(array)
        wp.launch(
            _count_outside,
            dim=values.shape,
            inputs=[values, *ranges[name], argument],
            outputs=[faults],
            device=device,
            record_tape=False,
        )
    return [name for name, count in zip(arrays, faults.numpy(), strict=True) if count]


def _scalars(array: wp.array) -> wp.array:
    """View an array of vectors or matrices as one of numbers."""
    array = array.contiguous()
    count = array.size * wp.types.type_size(array.dtype)
    values = wp.array(ptr=array.ptr, dtype=wp.float32, shape=count, device=array.device)
    values._ref = array  # the memory stays while the view does
    return values


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
