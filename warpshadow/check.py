"""Argument checks: one clear error that names the argument, its value and the accepted values; and warnings."""

import contextlib
import dataclasses
import difflib
import functools
import importlib
import inspect
import math
import os
import re
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any, ParamSpec, TypeGuard, TypeVar

import numpy as np
import warp as wp

P = ParamSpec("P")
T = TypeVar("T")

AnyPath = str | os.PathLike[str]  # a path as it may be given
LARGEST = 1.0e18  # the largest magnitude of any number that is given: its square, summed up, still fits a float32

_OWN_FOLDER = str(Path(__file__).parent) + os.sep

_PASSED_OVER = ("contextlib", "dataclasses", "functools", "torch")  # modules between a user's line and ours

_MAX_QUOTED_LENGTH = 60  # characters of a value that messages quote


_SYNONYMS = {
    **dict.fromkeys(("color", "colour", "base_color", "diffuse", "reflectance"), ("albedo",)),
    **dict.fromkeys(("position", "pos", "location", "offset", "foot"), ("eye", "translation")),
    **dict.fromkeys(("at", "look_at", "lookat"), ("target",)),
    **dict.fromkeys(("width", "height", "resolution"), ("size", "on_ground")),
    **dict.fromkeys(("file", "path", "filename"), ("mesh", "envmap", "image")),
    **dict.fromkeys(("map", "hdri", "hdr", "env", "environment"), ("envmap",)),
    **dict.fromkeys(("intensity", "strength", "brightness"), ("scale",)),
    **dict.fromkeys(("steps", "epochs"), ("iterations",)),
    **dict.fromkeys(("load", "open", "from_file"), ("read",)),
    "lr": ("learning_rate",),
    "size": ("on_ground",),
}
"""Names that other libraries have for arguments, keys and functions, and ours: the first that there is, is meant."""


class _Nothing:
    def __repr__(self) -> str:
        return "nothing"


NOTHING = _Nothing()  # a missing argument, so that its check names the accepted values


def choice(name: str, value: object, choices: Iterable[object]) -> None:
    """Raise ValueError unless ``value`` is one of ``choices``; the message names the nearest one."""
    choices = list(choices)
    if value in choices:
        return
    accepted = ", ".join(map(repr, choices))
    raise ValueError(f"{name}: got {value!r}, expected one of {accepted}{suggestion(value, choices)}")


def known_keys(where: str, keys: Iterable[str], known: Iterable[str], *, noun: str = "key") -> None:
    """Raise ValueError for the first of ``keys`` that is not ``known``; the message names the nearest one.

    Args:
        where: Their place; empty where :func:`located` says it.
        keys, known: The keys, and all that there are.
        noun: Name of a key in the message.
    """
    known = list(known)
    for key in keys:
        if key not in known:
            raise ValueError(
                f"{where and f'{where}: '}unknown {noun} {key!r}{suggestion(key, known)}; "
                f"known {noun}s are {', '.join(known)}"
            )


def keywords(**instead: str) -> Callable[[Callable[P, T]], Callable[P, T]]:
    """Make the TypeError of a function for an unknown, missing or superfluous argument name the remedy.

    Args:
        instead: Remedies for keywords that are likely mistakes, other keywords are compared with the
            arguments' names; and for arguments that are missing.
    """

    def decorate(function: Callable[P, T]) -> Callable[P, T]:
        signature = inspect.signature(function)
        known = [name for name in signature.parameters if name not in ("self", "cls")]
        name = function.__qualname__.removesuffix(".__init__")

        @functools.wraps(function)
        def checked(*args: P.args, **arguments: P.kwargs) -> T:
            for key in arguments:
                if key not in known:
                    hint = f" (write {instead[key]})" if key in instead else suggestion(key, known)
                    raise TypeError(f"{name}: unknown argument {key!r}{hint}")
            try:
                return function(*args, **arguments)
            except TypeError:
                try:
                    signature.bind(*args, **arguments)
                except TypeError as error:
                    key = _unmatched_argument(signature, args, error)
                    hint = f" (write {instead[key]})" if key in instead else _named_argument(signature, args)
                    raise TypeError(f"{name}: {error}{hint}; its arguments are {_listed(signature)}") from None
                raise

        return checked

    return decorate


def _unmatched_argument(signature: inspect.Signature, args: tuple[object, ...], error: TypeError) -> str:
    """Name of the argument that is missing; or of the class of the first value that is superfluous."""
    names = re.findall(r"missing a required argument: '(\w+)'", str(error))
    by_position = [one for one in signature.parameters.values() if one.kind is one.POSITIONAL_OR_KEYWORD]
    superfluous = [type(value).__name__.lower() for value in args[len(by_position) :]]
    return next(iter([*names, *superfluous]), "")


def _named_argument(signature: inspect.Signature, args: tuple[object, ...]) -> str:
    """The value that is superfluous as the one argument that is given by name, for messages; empty without such."""
    kinds = [one.kind for one in signature.parameters.values()]
    by_name = [one.name for one in signature.parameters.values() if one.kind is one.KEYWORD_ONLY]
    superfluous = args[kinds.count(inspect.Parameter.POSITIONAL_OR_KEYWORD) :]
    if len(superfluous) != 1 or len(by_name) != 1:
        return ""
    return f" (write {by_name[0]}={described(superfluous[0])})"


def _listed(signature: inspect.Signature) -> str:
    """Arguments of a function, as it is called."""
    by_name = [one for one in signature.parameters.values() if one.name not in ("self", "cls")]
    return ", ".join(f"{one.name}=…" if one.kind is one.KEYWORD_ONLY else one.name for one in by_name)


def frozen(**instead: str) -> Callable[[type[T]], type[T]]:
    """Make the errors of a frozen dataclass name the remedy, for its arguments, and where a field is assigned to.

    Args:
        instead: As for :func:`keywords`, for classes without an ``__init__`` that has them.
    """

    def decorate(kind: type[T]) -> type[T]:
        label = kind.__name__

        def refuse(self: T, name: str, value: object) -> None:
            remedy = f"a {label} has no such field, and does not change"
            if name in getattr(kind, "__dataclass_fields__", ()):
                variable = label.lower()
                remedy = f"that of a {label} does not change; dataclasses.replace({variable}, {name}=…) makes another"
            raise dataclasses.FrozenInstanceError(f"{name}: {remedy}")

        initialize = vars(kind)["__init__"]
        checked = initialize if hasattr(initialize, "__wrapped__") else keywords(**instead)(initialize)
        checked.__doc__ = f"Make one: help({label}) describes the arguments."
        for name, function in (("__init__", checked), ("__setattr__", refuse)):
            setattr(kind, name, function)
        return kind

    return decorate


class Hinting(type):
    """Class of classes whose AttributeError names the nearest of their own names, as of a function to read files."""

    if not TYPE_CHECKING:  # it would have any name

        def __getattr__(cls, name: str) -> Any:
            own_names = [own for own in dir(cls) if not own.startswith("_")]
            raise AttributeError(f"{cls.__name__} has no {name!r}{suggestion(name, own_names)}")


@contextlib.contextmanager
def located(where: str, error: type[ValueError] = ValueError) -> Iterator[None]:
    """Begin the message of a mistake with where it is, and raise it as ``error``, or as FileNotFoundError if it is one.

    Nested, the message goes from the file to the table in it. "got nothing", of NOTHING, becomes "missing".
    """
    try:
        yield
    except FileNotFoundError as cause:
        raise FileNotFoundError(f"{where}: {cause}") from cause
    except (ValueError, TypeError) as cause:
        raise error(f"{where}: {cause}".replace(f"got {NOTHING!r},", "missing,")) from cause


def warn(message: str, category: type[Warning] = UserWarning) -> None:
    """Warn, and point at the line from which the package was called."""
    level, frame = 2, sys._getframe(1)
    while frame.f_back is not None and _is_passed_over(frame):
        level, frame = level + 1, frame.f_back
    warnings.warn(message, category, stacklevel=level)


def _is_passed_over(frame: FrameType) -> bool:
    module = frame.f_globals.get("__name__", "").partition(".")[0]
    return frame.f_code.co_filename.startswith(_OWN_FOLDER) or module in _PASSED_OVER


def is_number(value: object) -> TypeGuard[float]:
    """Whether a value is a finite number, Python's or NumPy's."""
    if isinstance(value, bool) or not isinstance(value, (int, float, np.integer, np.floating)):
        return False
    try:
        return math.isfinite(value)
    except OverflowError:  # an integer that is no float
        return False


def is_integer(value: object) -> TypeGuard[int]:
    """Whether a value is a whole number, Python's or NumPy's, and of an integer type."""
    return isinstance(value, (int, np.integer)) and not isinstance(value, bool)


def is_path(value: object) -> TypeGuard[AnyPath]:
    """Whether a value may name a file."""
    return isinstance(value, (str, os.PathLike))


def path(name: str, value: object) -> Path:
    """A path; ValueError for a value that names no file."""
    if not is_path(value):
        raise ValueError(f"{name}: got {described(value)}, expected the path of a file")
    return Path(value)


def index(name: str, value: object, count: int, noun: str, alternative: str = "") -> None:
    """Raise ValueError unless a value is the number of one of ``count`` things, from 0; the message calls one that."""
    if not is_integer(value) or value not in range(count):
        raise ValueError(
            f"{name}: got {described(value)}, expected the number of a {noun}, from 0 to {count - 1}{alternative}"
        )


def instance(name: str, value: object, kind: type | tuple[type, ...], expected: str) -> None:
    """Raise ValueError unless a value is of a class; the message says which class is expected, and how to make one."""
    if not isinstance(value, kind):
        raise ValueError(f"{name}: got {described(value)}, expected {expected}")


def file(name: str, value: AnyPath) -> Path:
    """The path of a file, relative to the current folder; FileNotFoundError if there is none."""
    result = Path(value)
    if not result.is_file():
        where = "" if result.is_absolute() else f" (in {Path.cwd()})"
        hint = ", which is a folder" if result.is_dir() else nearest_file(result)
        raise FileNotFoundError(f"{name}: no such file: {result}{where}{hint}")
    return result


def nearest_file(missing_path: Path) -> str:
    """Name the file of the same folder that has nearly the name of a missing one, for messages; empty without such."""
    names: list[str] = []
    with contextlib.suppress(OSError):  # no such folder, or one that may not be read
        names = [item.name for item in missing_path.parent.iterdir() if item.is_file()]
    near = difflib.get_close_matches(missing_path.name, names, n=1, cutoff=0.85)
    return f" (did you mean {near[0]!r}?)" if near else ""


def device(name: str, value: object) -> wp.Device:
    """Warp's device for one of its own, torch's, a name, or None for its default; ValueError lists all devices."""
    wp.init()
    has_gpu = wp.is_cuda_available()
    alias = None if value is None else str(value)
    if has_gpu or alias is None or not alias.startswith("cuda"):  # without, Warp would print errors of its driver
        try:
            return wp.get_device(alias)
        except ValueError:
            pass
    known = ", ".join(repr(device_.alias) for device_ in wp.get_devices())
    raise ValueError(f"{name}: got {alias!r}, expected one of {known}{'' if has_gpu else '; there is no CUDA device'}")


def numbers(
    name: str,
    values: object,
    *,
    expected: str = "numbers",
    dtype: type = np.float32,
    error: type[ValueError] = ValueError,
) -> np.ndarray:
    """Copy numbers to an array of floats.

    Args:
        name: Of the argument.
        values: An array, a tensor, numbers or nested sequences of them.
        expected: The accepted values, for the message.
        dtype: Of the copy; numbers too large for it become Inf.
        error: The exception type to raise: for text, None, rows of different lengths, and tensors whose gradient would
            be lost.
    """
    if getattr(values, "requires_grad", False):
        raise error(
            f"{name}: got {described(values)} that requires a gradient, which would end here, expected {expected}: "
            ".detach() is without one"
        )
    try:
        result = np.asarray(values)
    except ValueError as cause:  # rows of different lengths
        raise error(f"{name}: got {described(values)}, expected {expected}") from cause
    except TypeError as cause:  # a tensor on a GPU, or of a type that NumPy has not
        raise error(f"{name}: got {described(values)}, expected {expected} ({cause})") from cause
    if result.dtype.kind not in "iuf" or _holds_booleans(values):
        raise error(f"{name}: got {described(values)}, expected {expected}")
    with np.errstate(over="ignore"):
        return np.array(result, dtype, order="C")


def _holds_booleans(values: object) -> bool:
    """Whether True or False is among numbers, which NumPy would take for 1 and 0."""
    return isinstance(values, (list, tuple)) and any(isinstance(v, bool) or _holds_booleans(v) for v in values)


def number(name: str, value: object) -> float:
    """Return a finite number as a float, or raise ValueError."""
    if not is_number(value):
        raise ValueError(f"{name}: got {described(value)}, expected a finite number")
    return float(value)


def array(name: str, values: object, lengths: tuple[int, ...], meaning: str = "") -> np.ndarray:
    """Copy finite numbers of a shape to a read-only array of float64; messages end with their meaning."""
    rows = "".join(f"{length} rows of " for length in lengths[:-1])
    expected = f"{rows}{lengths[-1]} finite numbers{meaning and f': {meaning}'}"
    copied = numbers(name, values, expected=expected, dtype=np.float64)
    if copied.shape != lengths:
        raise ValueError(f"{name}: got {described(values)}, expected {expected}")
    finite(name, copied)
    copied.setflags(write=False)
    return copied


def positive(name: str, value: object) -> float:
    """Return a positive number as a float, or raise ValueError."""
    if not (is_number(value) and 0.0 < value <= LARGEST):
        raise ValueError(f"{name}: got {described(value)}, expected a positive number up to {LARGEST:g}")
    return float(value)


def nonnegative(name: str, value: object) -> float:
    """Return a number of 0 or more as a float, or raise ValueError."""
    if not (is_number(value) and value >= 0.0):
        raise ValueError(f"{name}: got {described(value)}, expected a number of 0 or more")
    return float(value)


def integer(name: str, value: object, *, minimum: int = 1, unit: str = "") -> int:
    """Return a whole number, maybe of something, as an int, or raise ValueError."""
    if not is_integer(value) or value < minimum:
        of_unit = f"{unit}, " if unit else ""
        raise ValueError(f"{name}: got {described(value)}, expected a whole number of {of_unit}at least {minimum}")
    return int(value)


def flag(name: str, value: object) -> bool:
    """Return a truth value, or raise ValueError."""
    if not isinstance(value, (bool, np.bool_)):
        raise ValueError(f"{name}: got {described(value)}, expected true or false")
    return bool(value)


def image_size(size: object) -> tuple[int, int]:
    """Return width and height [pixels], of a square for one number, or raise ValueError."""
    if is_number(size):
        size = size, size
    if not isinstance(size, (Sequence, np.ndarray)) or isinstance(size, str) or len(size) != 2:
        raise ValueError(
            f"size: got {described(size)}, expected width and height [pixels], such as (640, 480), or a square's width"
        )
    return integer("size (width)", size[0], unit="pixels"), integer("size (height)", size[1], unit="pixels")


def pixels(name: str, values: object, *, expected: str, error: type[ValueError] = ValueError) -> np.ndarray:
    """Copy linear values of pixels as :func:`numbers` does; codes of a picture, which are integers, are refused."""
    copied = numbers(name, values, expected=expected, error=error)
    dtype = np.asarray(values).dtype
    if dtype.kind != "f":
        raise error(
            f"{name}: got values of {dtype}, expected linear ones as floats: those of an 8-bit picture are "
            "warpshadow.srgb_to_linear(values / 255), and read_image(path) reads one"
        )
    return copied


def photograph(name: str, values: object) -> np.ndarray:
    """Copy linear values of a photograph as :func:`pixels` does; codes of a picture are refused as floats, too.

    Those are whole numbers whose largest is 128 to 255, as in all but dark pictures.
    """
    copied = pixels(name, values, expected="linear RGB [height, width, 3], or the path of a picture")
    if copied.size and np.ptp(copied) > 0 and 128 <= copied.max() <= 255 and (copied == np.rint(copied)).all():
        raise ValueError(
            f"{name}: got whole numbers up to {copied.max():g}, expected linear values: those of an 8-bit picture are "
            "warpshadow.srgb_to_linear(values / 255), and read_image(path) reads one"
        )
    return copied


def reflectance(name: str, values: np.ndarray) -> None:
    """Raise ValueError unless all values are finite and in [0, 1]."""
    finite(name, values)
    if (values < 0).any() or (values > 1).any():
        raise ValueError(
            f"{name}: got values from {values.min()} to {values.max()}, expected reflectances in [0, 1], linear: those "
            "of sRGB colors from 0 to 255 are warpshadow.srgb_to_linear(colors / 255)"
        )


def channels_last(got: tuple[int, ...]) -> str:
    """Suggest how to get [height, width, 3] from an image's shape, for messages; empty where there is no such way."""
    if len(got) == 2:
        return "gray images are repeated for R, G, B"
    if got[-1:] == (4,):
        return "[..., :3] is without alpha"
    return "channels come last" if len(got) > 2 and got[-3] in (1, 3, 4) else ""


def described(value: object) -> str:
    """Name a value in messages: itself if that is short, else its type and shape."""
    if isinstance(value, type):
        return f"the class {value.__name__}"
    if isinstance(value, os.PathLike):
        return repr(str(value))
    if hasattr(value, "shape") and hasattr(value, "dtype") and len(value.shape):
        dtype = getattr(value.dtype, "__name__", value.dtype)
        return f"{type(value).__name__} of {dtype} and shape {tuple(value.shape)}"
    text = repr(value)
    if value is None or isinstance(value, (str, bytes, int, float, complex, np.number, _Nothing)):
        return text if len(text) <= _MAX_QUOTED_LENGTH else f"{text[:_MAX_QUOTED_LENGTH]}…"
    if isinstance(value, (list, tuple, dict)):
        return text if len(text) <= _MAX_QUOTED_LENGTH else f"{type(value).__name__} of {len(value)} items"
    return type(value).__name__


def finite(name: str, values: np.ndarray, *, minimum: float = -LARGEST, maximum: float = LARGEST) -> None:
    """Raise ValueError when an array holds NaN, Inf or numbers out of range, with their count and the first place."""
    is_bad = ~np.isfinite(values)
    if is_bad.any():
        first_index = tuple(int(i) for i in np.argwhere(is_bad)[0])
        raise ValueError(
            f"{name}: got {int(is_bad.sum())} NaN or Inf values (first at index {first_index}), expected finite numbers"
        )
    is_outside = (values < minimum) | (values > maximum)
    if is_outside.any():
        first_index = tuple(int(i) for i in np.argwhere(is_outside)[0])
        raise ValueError(
            f"{name}: got {int(is_outside.sum())} values out of range (first at index {first_index}: "
            f"{values[first_index]:g}), "
            f"expected {minimum:g} to {maximum:g}"
        )


def shape(name: str, got: tuple[int, ...], expected: tuple[int | str, ...], meaning: str = "") -> None:
    """Raise ValueError unless ``got`` matches ``expected``, where a string stands for any length.

    If ``meaning`` is given, the message ends with it and with how to make such an array.
    """
    matches = len(got) == len(expected)
    if matches and got != expected:
        for got_length, length in zip(got, expected, strict=True):
            matches &= got_length == length or isinstance(length, str)
    if not matches:
        lengths = ", ".join(map(str, expected))
        raise ValueError(f"{name}: got shape {tuple(got)}, expected [{lengths}]{meaning and f': {meaning}'}")


def importable(module: str, feature: str, package: str, extra: str) -> None:
    """Raise ImportError, which says how to install it, unless a module of one of our extras can be imported."""
    try:
        importlib.import_module(module)
    except ImportError as error:
        raise ImportError(missing(feature, package, extra)) from error


def missing(feature: str, package: str, extra: str) -> str:
    """The message for a package of one of our extras that is not installed."""
    return f'{feature} needs the package {package}: pip install "warpshadow[{extra}]"'


def suggestion(value: object, choices: list) -> str:
    """Name the nearest choice, for messages; empty where none is near."""
    near = [name for name in _SYNONYMS.get(str(value), ()) if name in choices]
    near = near or difflib.get_close_matches(str(value), map(str, choices), n=1, cutoff=0.5)
    return f" (did you mean {near[0]!r}?)" if near else ""
