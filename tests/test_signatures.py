"""What users import says what it takes and returns: every argument and result has a type, and none is Any."""

import dataclasses
import importlib
import inspect
import os
import typing
from collections import abc
from collections.abc import Iterator

import pytest

FACADES = ("warpshadow", "warpshadow.torch", "warpshadow.inverse", "warpshadow.stages")


def functions_of(name: str, value: object) -> Iterator[tuple[str, object]]:
    """Public functions behind a name: itself, or a class's own methods and properties."""
    if inspect.isfunction(value):
        yield name, value
    if not inspect.isclass(value):
        return
    for base in value.__mro__:
        if not base.__module__.startswith("warpshadow"):
            continue
        for key, member in vars(base).items():
            is_made = key == "__init__" and dataclasses.is_dataclass(base)  # of fields, which have a test of their own
            if is_made or (key.startswith("_") and key not in ("__init__", "__call__")):
                continue
            member = getattr(member, "__func__", member)
            member = getattr(member, "fget", None) or getattr(member, "func", None) or member
            if inspect.isfunction(member):
                yield f"{name}.{key}", member


BARE = {dict, list, tuple, set, os.PathLike, *(getattr(abc, name) for name in abc.__all__)}
"""What has items of any type where it is not said of which."""


def is_any(hint: object) -> bool:
    """Whether a type is Any somewhere, said or meant."""
    if isinstance(hint, list):  # arguments of a callable
        return any(map(is_any, hint))
    is_bare = isinstance(hint, abc.Hashable) and hint in BARE
    return hint is typing.Any or is_bare or any(map(is_any, typing.get_args(hint)))


def faults(name: str, function) -> list[str]:
    """What a signature does not say."""
    hints = typing.get_type_hints(function)
    parameters = list(inspect.signature(function).parameters.values())
    wanted = [each.name for each in parameters if each.name not in ("self", "cls")]
    wanted += [] if function.__name__ == "__init__" else ["return"]
    return [f"{name}: {each} has no type" for each in wanted if each not in hints] + [
        f"{name}: {each} is {hint}" for each, hint in hints.items() if is_any(hint)
    ]


@pytest.mark.parametrize("facade", FACADES)
def test_public_signatures_have_types_and_no_any(facade):
    module = importlib.import_module(facade)
    found = [pair for name in module.__all__ for pair in functions_of(name, getattr(module, name))]
    assert len(found) > 2
    assert not [fault for pair in found for fault in faults(*pair)]


@pytest.mark.parametrize("facade", FACADES)
def test_public_fields_have_types_and_no_any(facade):
    module = importlib.import_module(facade)
    classes = [value for value in map(module.__dict__.get, module.__all__) if dataclasses.is_dataclass(value)]
    for each in classes:
        hints = typing.get_type_hints(each)
        assert not [field.name for field in dataclasses.fields(each) if is_any(hints[field.name])], each


@pytest.mark.parametrize("facade", FACADES)
def test_a_facade_lists_what_it_exports_in_order(facade):
    module = importlib.import_module(facade)
    assert list(module.__all__) == sorted(set(module.__all__))
    assert all(hasattr(module, name) for name in module.__all__)
