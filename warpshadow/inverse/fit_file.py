"""Fit files: TOML that says which scene explains which images, checked key by key (README.md lists the keys)."""

from __future__ import annotations

import functools
import types
import typing
from collections.abc import Callable
from dataclasses import MISSING, dataclass, fields
from pathlib import Path
from typing import Any

import torch

from warpshadow import check
from warpshadow.inverse import (
    Albedo,
    CameraPose,
    Deformation,
    Exposure,
    Free,
    Light,
    Loss,
    Pose,
    Problem,
    Radii,
    Result,
    Stage,
    Target,
    Texture,
    deformation_stages,
    fit,
    pose_stages,
    short_adam,
)
from warpshadow.inverse.stages import check_stages
from warpshadow.inverse.target import read_target
from warpshadow.scene import toml_tables
from warpshadow.scene.files import load_scene, parse_camera, parse_visibility
from warpshadow.scene.scene import Scene
from warpshadow.scene.toml_tables import Table

_KEYS = ("scene", "tolerance", "seed", "stages", "target", "free", "loss", "still", "optimizer", "stage")
_TARGET_KEYS = ("image", "mask", "camera")
_FREE_OF_SCENE: dict[str, type[Free]] = {"light": Light, "exposure": Exposure, "camera": CameraPose}
_FREE_OF_BODIES: dict[str, type[Free]] = {
    "albedo": Albedo,
    "texture": Texture,
    "pose": Pose,
    "deformation": Deformation,
    "radii": Radii,
}
_OPTIMIZERS: dict[str, tuple[Callable[..., torch.optim.Optimizer], dict[str, Any]]] = {
    "adam": (torch.optim.Adam, {"betas": tuple[float, float]}),
    "sgd": (torch.optim.SGD, {"momentum": float, "dampening": float, "nesterov": bool}),
    "rmsprop": (torch.optim.RMSprop, {"alpha": float, "eps": float, "momentum": float}),
    "lbfgs": (
        functools.partial(torch.optim.LBFGS, line_search_fn="strong_wolfe"),
        {"max_iter": int, "history_size": int},
    ),
}
_STAGES: dict[str, Callable[[Problem], tuple[Stage, ...]]] = {"pose": pose_stages, "deformation": deformation_stages}
_EXPECTED = {
    bool: "true or false",
    int: "a whole number",
    float: "a finite number",
    str: "a string",
    tuple[int, int]: "two whole numbers",
    tuple[float, float]: "two finite numbers",
}


class FitFileError(ValueError):
    """A fit file that cannot be used: the message says where and what is accepted."""


@dataclass(frozen=True, eq=False)
class Fit:
    """A fit, ready to run.

    Args:
        problem: What is to be solved.
        stages: What to do in which order.
        optimizer: Makes an optimizer of a list of tensors and ``lr``.
        tolerance: A stage has converged when over 25 iterations its loss fell by less than this part.
        seed: Of what is scattered where a stage has candidates.
    """

    problem: Problem
    stages: tuple[Stage, ...]
    optimizer: Callable[..., torch.optim.Optimizer]
    tolerance: float
    seed: int

    def run(self, **options: Any) -> Result:
        """Run it; the options are those of :func:`warpshadow.inverse.fit`: device, checkpoint, preview, progress."""
        return fit(
            self.problem,
            self.stages,
            optimizer=self.optimizer,
            tolerance=self.tolerance,
            seed=self.seed,
            **options,
        )


def load_fit(path: str | Path) -> Fit:
    """Read a fit file.

    Args:
        path: A TOML file; paths in it are relative to it. README.md lists its keys.

    Raises:
        FitFileError: for what the file says wrongly: it names the table, the key, what it got and what it accepts.
        FileNotFoundError: for a file that is not there.
    """
    path = Path(path)
    with toml_tables.located(str(path), FitFileError):
        return _fit(toml_tables.read(path, "fit file"), path.parent)


def _fit(table: Table, folder: Path) -> Fit:
    check.known_keys("the fit", table, _KEYS)
    for name in ("scene", "target", "free"):
        if name not in table:
            raise ValueError(f'{name} is missing; a fit has scene = "FILE", at least one [[target]], and [free]')
    tolerance = toml_tables.number(table, "tolerance", 1e-4)
    toml_tables.check_integer(table, "seed")
    scene = load_scene(toml_tables.file(table, "scene", folder))
    targets = []
    for where, target in toml_tables.numbered(table, "target"):
        with toml_tables.located(where):
            targets.append(_target(target, folder))
    with toml_tables.located("[loss]"):
        loss = _make(Loss, table.get("loss", {}))
    with toml_tables.located("[still]"):
        toml_tables.check_table(table.get("still", {}))
        still = parse_visibility({"method": "ray-traced"} | table.get("still", {}))
    problem = Problem(scene, targets, _free(table["free"], scene), loss, still)
    with toml_tables.located("[optimizer]"):
        optimizer = _optimizer(table.get("optimizer", {}))
    return Fit(problem, _stages(table, problem), optimizer, tolerance, table.get("seed", 0))


# ---------------------------------------------------------------------------------------------- targets


def _target(table: Table, folder: Path) -> Target:
    toml_tables.check_table(table)
    check.known_keys("key", table, _TARGET_KEYS)
    if "image" not in table:
        raise ValueError("image: missing, expected a file name")
    image = read_target(toml_tables.file(table, "image", folder))
    mask: Any = toml_tables.file(table, "mask", folder) if "mask" in table else None
    camera = None
    if "camera" in table:
        with toml_tables.located("camera"):
            toml_tables.check_table(table["camera"])
            camera = parse_camera({"size": [image.shape[1], image.shape[0]]} | table["camera"])
    return Target(image, mask, camera)


# ---------------------------------------------------------------------------------------------- what is free


def _free(table: Table, scene: Scene) -> list[Free]:
    with toml_tables.located("[free]"):
        toml_tables.check_table(table)
        check.known_keys("key", table, (*_FREE_OF_SCENE, *_FREE_OF_BODIES))
    free: list[Free] = []
    for key, kind in _FREE_OF_SCENE.items():
        value = table.get(key, False)
        if value is False:
            continue
        with toml_tables.located(f"[free] {key}"):
            free.append(_make(kind, {} if value is True else value))
    for key, kind in _FREE_OF_BODIES.items():
        for where, value in toml_tables.numbered({key: []} | table, key, "free."):
            with toml_tables.located(where):
                free.append(_make(kind, value))
                free[-1].check_scene(scene)
    return free


# ---------------------------------------------------------------------------------------------- how


def _stages(table: Table, problem: Problem) -> tuple[Stage, ...]:
    if "stages" in table:
        if "stage" in table:
            raise ValueError("expected either stages or [[stage]]")
        check.choice("stages", table["stages"], _STAGES)
        return _STAGES[table["stages"]](problem)
    stages = []
    for where, stage in toml_tables.numbered({"stage": [{}]} | table, "stage"):
        with toml_tables.located(where):
            stages.append(_make(Stage, stage))
    check_stages(stages, problem)
    return tuple(stages)


def _optimizer(table: Table) -> Callable[..., torch.optim.Optimizer]:
    toml_tables.check_table(table)
    name = table.get("name", "adam")
    check.choice("name", name, _OPTIMIZERS)
    kind, hints = _OPTIMIZERS[name]
    check.known_keys("key", table, ("name", *hints))
    options = {key: _typed(key, value, hints[key]) for key, value in table.items() if key != "name"}
    if name == "adam" and not options:
        return short_adam
    make = functools.partial(kind, **options)
    make([torch.zeros(1, requires_grad=True)], lr=1.0)  # raises where an option is out of range
    return make


# ---------------------------------------------------------------------------------------------- tables


def _make(kind: type, table: Table) -> Any:
    """Make a dataclass of a table whose keys are its fields, checked by their annotations."""
    toml_tables.check_table(table)
    hints = {field.name: typing.get_type_hints(kind)[field.name] for field in fields(kind)}
    check.known_keys("key", table, hints)
    for field in fields(kind):
        if field.name not in table and field.default is MISSING:
            raise ValueError(f"{field.name}: missing, expected {_EXPECTED[_essence(hints[field.name])]}")
    values = {key: _typed(key, value, _essence(hints[key])) for key, value in table.items()}
    if kind is Light and "directions" in values:
        values = {"order": None} | values  # in place of the default
    return kind(**values)


def _essence(hint: Any) -> Any:
    """A type without "or None": a key that is missing says that."""
    is_union = typing.get_origin(hint) in (typing.Union, types.UnionType)
    return next(each for each in typing.get_args(hint) if each is not types.NoneType) if is_union else hint


def _typed(key: str, value: Any, hint: Any) -> Any:
    """A value of a key as the type that it should have."""
    if not _is(value, hint):
        raise ValueError(f"{key}: got {value!r}, expected {_EXPECTED[hint]}")
    return tuple(value) if isinstance(value, list) else float(value) if hint is float else value


def _is(value: Any, hint: Any) -> bool:
    if hint is float:
        return check.is_number(value)
    if hint is int:
        return check.is_integer(value)
    parts = typing.get_args(hint)
    if not parts:
        return isinstance(value, hint)
    return isinstance(value, list) and len(value) == len(parts) and all(map(_is, value, parts))
