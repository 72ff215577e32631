"""Tables of TOML files: read, turned into objects, and written."""

import inspect
import json
import math
import sys
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from warpshadow import check
from warpshadow.assets import files

Table = dict[str, Any]
T = TypeVar("T")


def read(path: Path, kind: str) -> Table:
    """Read a TOML file; messages call it a ``kind``, and leave the path to :func:`warpshadow.check.located`."""
    if sys.version_info >= (3, 11):
        import tomllib
    else:
        import tomli as tomllib

    if not path.is_file():
        raise FileNotFoundError(f"no such {kind}{check.nearest_file(path)}")
    try:
        return tomllib.loads(path.read_bytes().decode("utf-8-sig"))  # editors on Windows begin files with a mark
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as cause:
        raise ValueError(f"not valid TOML: {cause}{_remedy(str(cause))}") from cause


def _remedy(fault: str) -> str:
    """Likely causes of TOML's errors."""
    if " twice" in fault:
        return "; a table that comes several times has two brackets, [[body]]"
    return '; text is in quotes, "…"' if fault.startswith("Invalid value") else ""


def check_table(value: object) -> None:
    """Raise ValueError unless a value is a table."""
    check.instance("table", value, Mapping, "a table of keys")


def numbered(table: Table, key: str, within: str = "") -> Iterator[tuple[str, Any]]:
    """Tables of a list, each with its name for messages."""
    if not isinstance(table[key], list):
        raise ValueError(f"[{within}{key}]: expected [[{within}{key}]], since there may be several")
    for place, item in enumerate(table[key], start=1):
        ending = "th" if place % 100 in (11, 12, 13) else {1: "st", 2: "nd", 3: "rd"}.get(place % 10, "th")
        yield f"{place}{ending} [[{within}{key}]]", item


def make(kind: Callable[..., T], table: Table) -> T:
    """Call a function with a table's keys as its arguments and check their values; a missing one is check.NOTHING.

    Not done by msgspec or pydantic: Python users get the same messages, with the value they gave and the nearest key,
    neither of which these libraries name.
    """
    check_table(table)
    arguments = inspect.signature(kind).parameters
    check.known_keys("", table, arguments)
    missing = {key: check.NOTHING for key, argument in arguments.items() if argument.default is argument.empty}
    return kind(**missing | table)


def file(table: Table, key: str, folder: Path) -> Path:
    """The path of a file that is there, relative to a folder."""
    if not isinstance(table.get(key), str):
        raise ValueError(f"{key}: got {table.get(key, check.NOTHING)!r}, expected a file name")
    return check.file(key, folder / table[key])


def write(path: Path, tables: Mapping[str, object], *, comment: str = "") -> None:
    """Write a TOML file of tables, as :func:`text` has them, maybe below a line of comment."""
    with files.atomic_write(path) as unfinished:
        unfinished.write_text(f"# {comment}\n\n" * bool(comment) + text(tables), encoding="utf-8")


def text(tables: Mapping[str, object]) -> str:
    """Tables as TOML that reads back as the same values, to the last bit of a number.

    By hand: tomli-w gives each number of a matrix a line, and puts all bodies into one list; tomlkit is slower to
    import than the rest of a scene file is to read.

    Args:
        tables: Strings, numbers, truth values and lists of them, tables of these, and lists of tables.
    """
    plain, blocks = {}, []
    for name, value in tables.items():
        if isinstance(value, Mapping):
            blocks.append(block(f"[{name}]", value))
        elif isinstance(value, list) and value and isinstance(value[0], Mapping):
            blocks += [block(f"[[{name}]]", table) for table in value]
        else:
            plain[name] = value
    return "\n".join([_lines(plain), *blocks] if plain else blocks)


def block(header: str, table: Mapping[str, object]) -> str:
    """A table as lines of a TOML file, under its header."""
    return f"{header}\n{_lines(table)}"


def _lines(table: Mapping[str, object]) -> str:
    return "".join(f"{key} = {_value(value)}\n" for key, value in table.items())


def _value(value: object) -> str:
    """TOML for a value, NumPy's or Python's; matrices get a line for each row."""
    if isinstance(value, (np.generic, np.ndarray)):
        value = value.tolist()
    if isinstance(value, (list, tuple)):
        is_matrix = bool(value) and isinstance(value[0], (list, tuple))
        items = [_value(item) for item in value]
        return "[\n" + "".join(f"    {item},\n" for item in items) + "]" if is_matrix else f"[{', '.join(items)}]"
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{key} = {_value(item)}" for key, item in value.items()) + "}"
    if isinstance(value, float) and not math.isfinite(value):
        return repr(value)  # nan, inf: as TOML has them
    return json.dumps(value, ensure_ascii=False)  # of the rest, JSON's notation is TOML's
