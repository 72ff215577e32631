"""Tables of TOML files: read, checked key by key, and written."""

import contextlib
import json
import math
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from warpshadow import check
from warpshadow.assets import files

Table = dict[str, Any]


def read(path: Path, kind: str) -> Table:
    """Read a TOML file; messages call it a ``kind``, and leave the path to :func:`located`."""
    if sys.version_info >= (3, 11):
        import tomllib
    else:
        import tomli as tomllib

    if not path.is_file():
        raise FileNotFoundError(f"no such {kind}")
    try:
        return tomllib.loads(path.read_bytes().decode("utf-8-sig"))  # editors on Windows begin files with a mark
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as cause:
        raise ValueError(f"not valid TOML: {cause}") from cause


def write(path: Path, tables: Mapping[str, Any]) -> None:
    """Write a TOML file that reads back as the same values, to the last bit of a number.

    Args:
        path: The file.
        tables: Strings, numbers, truth values and lists of them, tables of these, and lists of tables.
    """
    plain = {key: value for key, value in tables.items() if not _is_table(value) and not _is_tables(value)}
    blocks = [_lines(plain)] if plain else []
    for name, value in tables.items():
        if _is_table(value):
            blocks.append(block(f"[{name}]", value))
        elif _is_tables(value):
            blocks += [block(f"[[{name}]]", table) for table in value]
    with files.whole(path) as unfinished:
        unfinished.write_text("\n".join(blocks), encoding="utf-8")


def block(header: str, table: Mapping[str, Any]) -> str:
    """A table as lines of a TOML file, under its header."""
    return f"{header}\n{_lines(table)}"


@contextlib.contextmanager
def located(where: str, error: type[ValueError] = ValueError) -> Iterator[None]:
    """Begin the message of a mistake with where it is, and raise it as ``error``, or as FileNotFoundError if it is one.

    Nested, the message goes from the file to the table in it.
    """
    try:
        yield
    except FileNotFoundError as cause:
        raise FileNotFoundError(f"{where}: {cause}") from cause
    except (ValueError, TypeError) as cause:
        raise error(f"{where}: {cause}") from cause


# ---------------------------------------------------------------------------------------------- values


def check_table(value: object) -> None:
    """Raise ValueError unless a value is a table."""
    if not _is_table(value):
        raise ValueError(f"got {value!r}, expected a table of keys")


def numbered(table: Table, key: str, within: str = "") -> Iterator[tuple[str, Any]]:
    """Tables of a list, each with what messages call it."""
    if not isinstance(table[key], list):
        raise ValueError(f"[{within}{key}]: expected [[{within}{key}]], since there may be several")
    for position, item in enumerate(table[key], start=1):
        yield f"[[{within}{key}]] number {position}", item


def number(table: Table, key: str, default: float) -> float:
    """A finite number."""
    value = table.get(key, default)
    if not check.is_number(value):
        raise ValueError(f"{key}: got {value!r}, expected a finite number")
    return value


def check_integer(table: Table, key: str, *, pair: bool = False) -> None:
    """Raise ValueError unless a key is missing or a whole number, or maybe a pair of them."""
    value = table.get(key, 1)
    values = value if pair and isinstance(value, list) and len(value) == 2 else [value]
    if not all(map(check.is_integer, values)):
        raise ValueError(f"{key}: got {value!r}, expected a whole number{' or two' if pair else ''}")


def check_vector(table: Table, key: str, count: int = 3) -> None:
    """Raise ValueError unless a key is missing or a vector."""
    if key in table and not _is_vector(table[key], count):
        raise ValueError(f"{key}: got {table[key]!r}, expected {count} finite numbers")


def rows(table: Table, key: str, count: int | None = None) -> list[list[float]]:
    """Rows of three numbers: so many, or any number."""
    value = table[key]
    is_right = isinstance(value, list) and all(_is_vector(row, 3) for row in value)
    if not is_right or (count is not None and len(value) != count):
        raise ValueError(
            f"{key}: got {value!r}, expected {'' if count is None else f'{count} '}rows of 3 finite numbers"
        )
    return value


def file(table: Table, key: str, folder: Path) -> Path:
    """The path of a file that is there, relative to a folder."""
    if not isinstance(table[key], str):
        raise ValueError(f"{key}: got {table[key]!r}, expected a file name")
    path = folder / table[key]
    if not path.is_file():
        raise FileNotFoundError(f"{key}: no such file: {path}")
    return path


def _is_table(value: object) -> bool:
    return isinstance(value, Mapping)


def _is_tables(value: object) -> bool:
    return isinstance(value, Sequence) and len(value) > 0 and all(map(_is_table, value))


def _is_vector(value: object, count: int) -> bool:
    return isinstance(value, list) and len(value) == count and all(map(check.is_number, value))


def _lines(table: Mapping[str, Any]) -> str:
    return "".join(f"{key} = {_value(value)}\n" for key, value in table.items())


def _value(value: Any) -> str:
    """TOML for a value, NumPy's or Python's; matrices get a line for each row."""
    if isinstance(value, (np.generic, np.ndarray)):
        value = value.tolist()
    if isinstance(value, (list, tuple)):
        is_matrix = bool(value) and isinstance(value[0], (list, tuple))
        items = [_value(item) for item in value]
        return "[\n" + "".join(f"    {item},\n" for item in items) + "]" if is_matrix else f"[{', '.join(items)}]"
    if isinstance(value, float) and not math.isfinite(value):
        return repr(value)  # nan, inf: as TOML has them
    return json.dumps(value, ensure_ascii=False)  # of the rest, JSON's notation is TOML's
