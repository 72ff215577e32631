"""Fit files: TOML that says which scene explains which images, checked key by key (README.md lists the keys)."""

import functools
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from warpshadow import check
from warpshadow.assets.camera import framed_points
from warpshadow.assets.image import image_size
from warpshadow.check import AnyPath
from warpshadow.inverse.descent import default_optimizer, fit, short_adam
from warpshadow.inverse.encoding import is_curve_file
from warpshadow.inverse.free import FREE
from warpshadow.inverse.free.base import Free, FreeOfBody
from warpshadow.inverse.loss import Loss
from warpshadow.inverse.problem import Problem
from warpshadow.inverse.quasi_newton import QuasiNewton
from warpshadow.inverse.result import Result
from warpshadow.inverse.schedule import READY_STAGES, Stage, check_stages
from warpshadow.inverse.target import Target
from warpshadow.scene import toml_tables
from warpshadow.scene.files import load_scene, parse_camera
from warpshadow.scene.scene import Scene
from warpshadow.scene.toml_tables import Table
from warpshadow.scene.visibility import Visibility

_KEYS = ("scene", "tolerance", "seed", "stages", "target", "free", "loss", "still", "optimizer", "stage")
_PHOTOGRAPH_KEYS = ("encoding", "exposure", "white_balance", "saturation", "moves_outlines", "distortion")
_TARGET_KEYS = ("image", "mask", "camera", "outlines", *_PHOTOGRAPH_KEYS)

_OPTIMIZERS: dict[str, tuple[Callable[..., torch.optim.Optimizer], dict[str, Callable[[str, object], Any]]]] = {
    "quasi-newton": (QuasiNewton, {}),
    "adam": (torch.optim.Adam, {"betas": lambda key, value: tuple(check.array(key, value, (2,)).tolist())}),
    "sgd": (torch.optim.SGD, {"momentum": check.number, "dampening": check.number, "nesterov": check.flag}),
    "rmsprop": (torch.optim.RMSprop, {"alpha": check.number, "eps": check.number, "momentum": check.number}),
    "lbfgs": (
        functools.partial(torch.optim.LBFGS, line_search_fn="strong_wolfe"),
        {"max_iter": check.integer, "history_size": check.integer},
    ),
}
"""Optimizers by name, and the checks of their options."""


class FitFileError(ValueError):
    """A fit file that cannot be used: the message names the place and the accepted values."""


@dataclass(frozen=True, eq=False)
class Fit:
    """A fit, ready to run.

    Args:
        problem, stages, optimizer, tolerance, seed: As of :func:`warpshadow.inverse.fit`.
    """

    problem: Problem
    stages: tuple[Stage, ...]
    optimizer: Callable[..., torch.optim.Optimizer]
    tolerance: float
    seed: int

    @property
    def run(self) -> Callable[..., Result]:
        """:func:`warpshadow.inverse.fit` of it; device, checkpoint, preview, progress and view are left to say."""
        run = functools.partial(fit, self.problem, self.stages, optimizer=self.optimizer)
        return functools.partial(run, tolerance=self.tolerance, seed=self.seed)


def load_fit(path: AnyPath) -> Fit:
    """Read a fit file.

    Args:
        path: A TOML file; paths in it are relative to it. README.md lists its keys.
    Raises:
        FitFileError: for a mistake in the file: it names the table, the key, the value it got and the accepted values.
        FileNotFoundError: for a file that is not there.
    """
    path = Path(path)
    with check.located(str(path), FitFileError):
        table = toml_tables.read(path, "fit file")
        _check_no_scene(path, table)
        return _fit(table, path.parent)


def check_kind(path: Path) -> None:
    """Raise FitFileError for a file that is no fit file: one of another suffix, or a scene file."""
    with check.located(str(path), FitFileError):
        if path.suffix.lower() != ".toml":
            raise ValueError(f"got extension {path.suffix!r}, expected a fit file, .toml, which names its images")
        try:
            table = toml_tables.read(path, "fit file")
        except ValueError:  # which the fit says
            return
        _check_no_scene(path, table)


def _check_no_scene(path: Path, table: Table) -> None:
    """Raise ValueError for the tables of a scene file."""
    if "scene" not in table and ("camera" in table or "body" in table):
        raise ValueError(f'got a scene file, expected a fit file, which names it: scene = "{path.name}"')


def _fit(table: Table, folder: Path) -> Fit:
    check.known_keys("the fit", table, _KEYS)
    for name in ("scene", "target", "free"):
        if name not in table:
            raise ValueError(f'{name} is missing; a fit has scene = "FILE", at least one [[target]], and [free]')
    tolerance = check.number("tolerance", table.get("tolerance", 1e-4))
    seed = check.integer("seed", table.get("seed", 0), minimum=0)
    scene = load_scene(toml_tables.file(table, "scene", folder)).with_method()
    targets = []
    for where, target in toml_tables.numbered(table, "target"):
        with check.located(where):
            targets.append(_target(target, folder))
    with check.located("[loss]"):
        loss = toml_tables.make(Loss, table.get("loss", {}))
    with check.located("[still]"):
        toml_tables.check_table(table.get("still", {}))
        still = toml_tables.make(Visibility, {"method": "ray-traced"} | table.get("still", {}))
    problem = Problem(scene, targets, _free(table["free"], scene, len(targets)), loss, still)
    _check_framing(toml_tables.file(table, "scene", folder), problem)
    with check.located("[optimizer]"):
        optimizer = _optimizer(table.get("optimizer", {}))
    return Fit(problem, _stages(table, problem), optimizer, tolerance, seed)


def _target(table: Table, folder: Path) -> Target:
    toml_tables.check_table(table)
    check.known_keys("", table, _TARGET_KEYS)
    path = toml_tables.file(table, "image", folder)
    options: Table = {key: table[key] for key in _PHOTOGRAPH_KEYS if key in table}
    if is_curve_file(options.get("encoding")):
        options["encoding"] = toml_tables.file(table, "encoding", folder)
    if "mask" in table:
        options["mask"] = toml_tables.file(table, "mask", folder)
    if "outlines" in table:
        with check.located("outlines"):
            toml_tables.check_table(table["outlines"])
            files = {key: toml_tables.file(table["outlines"], key, folder) for key in table["outlines"]}
            options["outlines"] = {int(key) if key.isdecimal() else key: file for key, file in files.items()}
    if "camera" in table:
        with check.located("camera"):
            toml_tables.check_table(table["camera"])
            options["camera"] = parse_camera({"size": image_size(path)} | table["camera"])
    return Target(path, **options)


def _check_framing(path: Path, problem: Problem) -> None:
    """Warn of a camera that stands where the start is framed: images of other poses are framed otherwise."""
    moving = [free for free in problem.free_of_bodies if free.reframes]
    is_framed = "framing" in toml_tables.read(path, "scene file")["camera"]
    if not (is_framed and moving and any(target.camera is None for target in problem.targets)):
        return
    names = dict.fromkeys(problem.scene.bodies[item.number].name for item in moving)
    camera, points = problem.scene.camera, framed_points(problem.scene)
    forward = camera.rotation[2]
    center = (points.min(axis=0) + points.max(axis=0)) / 2
    target = camera.eye + forward @ (center - camera.eye) * forward
    eye, target = (np.round(point, 4).tolist() for point in (camera.eye, target))
    check.warn(
        f'{path}: the camera is framed on the start (framing = "auto"), but {" and ".join(names)} may have been '
        "elsewhere, and framed otherwise, when the images were made. In place of framing, direction and margin write "
        f"eye and target, the same as of the images; of this file they are\neye = {eye}\ntarget = {target}"
    )


def _free(table: Table, scene: Scene, view_count: int) -> list[Free]:
    with check.located("[free]"):
        toml_tables.check_table(table)
        check.known_keys("", table, [kind.key for kind in FREE])
    free: list[Free] = []
    for kind in FREE:
        key, entry = kind.key, table.get(kind.key, False)
        if not issubclass(kind, FreeOfBody):
            if entry is not False:
                with check.located(f"[free] {key}"):
                    settings = {} if entry is True else entry
                    toml_tables.check_table(settings)
                    free.append(toml_tables.make(kind, settings))
        elif isinstance(table.get(key), bool):
            lines = f'[[free.{key}]]\nbody = "{scene.bodies[0].name}"'
            raise ValueError(f"[free] {key}: got {str(entry).lower()}, expected a table for each body:\n{lines}")
        else:
            for where, value in toml_tables.numbered({key: []} | table, key, "free."):
                with check.located(where):
                    free.append(toml_tables.make(kind, value).numbered(scene))
                    free[-1].check_scene(scene, view_count)
    return free


def _stages(table: Table, problem: Problem) -> tuple[Stage, ...]:
    if "stages" in table:
        if "stage" in table:
            raise ValueError("expected either stages or [[stage]]")
        check.choice("stages", table["stages"], READY_STAGES)
        return READY_STAGES[table["stages"]](problem)
    stages = []
    for where, stage in toml_tables.numbered({"stage": [{}]} | table, "stage"):
        with check.located(where):
            stages.append(toml_tables.make(Stage, stage))
    check_stages(stages, problem)
    return tuple(stages)


def _optimizer(table: Table) -> Callable[..., torch.optim.Optimizer]:
    toml_tables.check_table(table)
    if not table:
        return default_optimizer
    name = table.get("name", "adam")
    check.choice("name", name, _OPTIMIZERS)
    kind, checks = _OPTIMIZERS[name]
    check.known_keys("", table, ("name", *checks))
    options = {key: checks[key](key, value) for key, value in table.items() if key != "name"}
    if name == "adam" and not options:
        return short_adam
    make = functools.partial(kind, **options)
    make([torch.zeros(1, requires_grad=True)], lr=1.0)  # raises where an option is out of range
    return make
