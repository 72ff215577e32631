"""The descent: from where a problem's scene is to where its images are like their targets."""

from __future__ import annotations

import math
import statistics
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

from warpshadow.camera import Camera
from warpshadow.inverse import checkpoint as checkpoints
from warpshadow.inverse.free import Values
from warpshadow.inverse.preview import write_preview
from warpshadow.inverse.problem import Problem
from warpshadow.inverse.target import stacked
from warpshadow.inverse.world import Found, Setting, World, make_renderer
from warpshadow.scene import Scene

WINDOW = 25
"""Iterations over which a loss must fall for its stage to go on."""

LAST_RATE = 0.05
"""Share of its learning rate that a stage ends with."""


class FitWarning(UserWarning):
    """A fit that ended before its time."""


@dataclass(frozen=True)
class Stage:
    """A part of a descent; coarse ones first.

    Args:
        iterations: At most so many.
        learning_rate: At the start; it falls along a cosine to a twentieth.
        scale: Size of the images as a part of the targets'.
        softness: κ of directional visibility; by default the scene's. Softer shadows reach farther.
        directions: Number of cells of directional visibility; by default the scene's.

    Raises:
        ValueError: naming the argument, what it got and what it accepts.
    """

    iterations: int = 200
    learning_rate: float = 0.02
    scale: float = 1.0
    softness: float | None = None
    directions: int | None = None

    def __post_init__(self) -> None:
        """Validate."""
        if isinstance(self.iterations, bool) or not isinstance(self.iterations, int) or self.iterations < 1:
            raise ValueError(f"iterations: got {self.iterations!r}, expected a whole number from 1 on")
        if not (math.isfinite(self.learning_rate) and self.learning_rate > 0):
            raise ValueError(f"learning_rate: got {self.learning_rate!r}, expected a positive number")
        if not 0 < self.scale <= 1:
            raise ValueError(f"scale: got {self.scale!r}, expected a part of the image, above 0 and up to 1")

    def rate(self, iteration: int) -> float:
        """Learning rate of an iteration."""
        fall = 0.5 * (1 + math.cos(math.pi * iteration / self.iterations))
        return self.learning_rate * (LAST_RATE + (1 - LAST_RATE) * fall)


@dataclass(frozen=True, eq=False)
class Result:
    """What a fit ended with.

    Args:
        problem: What was to be solved.
        setting: Its scene at the start and its units.
        values: Of what is free, by its name: those of the least loss in the last stage that had one.
        losses: Loss of each iteration before its step, a list for each stage begun.
        reason: Why the fit ended: "converged", "finished" (all iterations done), or what became non-finite.
        seconds: Median time of an iteration of the last stage [s].
    """

    problem: Problem
    setting: Setting = field(repr=False)
    values: dict[str, Values] = field(repr=False)
    losses: list[list[float]] = field(repr=False)
    reason: str
    seconds: float

    @property
    def found(self) -> Found:
        """Scene, cameras and exposures."""
        return self.problem.found(self.values, self.setting)

    @property
    def scene(self) -> Scene:
        """The scene that explains the targets."""
        return self.found.scene

    @property
    def cameras(self) -> list[Camera]:
        """The cameras of the views."""
        return self.found.cameras

    def images(self, values: Mapping[str, Values] | None = None) -> np.ndarray:
        """Images of the views, [view, height, width, 4], of the result or of other values."""
        model = _Model(self.problem, self.setting, Stage())
        with torch.no_grad():
            return model.images(self.values if values is None else values).cpu().numpy()

    def images_at_start(self) -> np.ndarray:
        """Images of the views before the fit, [view, height, width, 4]."""
        return self.images(self.problem.start(self.setting))


class _Model:
    """Images of a problem as a function of its values, at a stage's size."""

    def __init__(self, problem: Problem, setting: Setting, stage: Stage, progress: bool = False):
        self.problem, self.setting = problem, setting
        self.renderer, self.cameras = make_renderer(
            setting, stage.scale, stage.softness, stage.directions, problem.basis, progress
        )
        self.targets, self.weights = stacked(problem.targets, stage.scale, setting.device)

    def images(self, values: Mapping[str, Values]) -> torch.Tensor:
        world = World(self.renderer, self.cameras)
        for free in self.problem.free:
            free.place(values[free.name], self.setting, world)
        return world.images()

    def loss(self, values: Mapping[str, Values]) -> tuple[torch.Tensor, torch.Tensor]:
        """Loss with its regularizers, and the images."""
        images = self.images(values)
        total = self.problem.loss(images, self.targets, self.weights, self.setting.unit)
        for free in self.problem.free:
            energy = free.energy(values[free.name], self.setting)
            total = total if energy is None else total + energy
        return total, images


class _Diverged(Exception):
    """Something became non-finite; the message names it."""


class _Descent:
    """A fit under way: all of its state is in ``state()``."""

    def __init__(self, problem: Problem, stages: tuple[Stage, ...], optimizer: Callable, device: torch.device):
        self.problem, self.stages, self.make_optimizer = problem, stages, optimizer
        self.setting = problem.setting(device)
        self.values = problem.start(self.setting)
        self.best = _copied(self.values)
        self.stage, self.iteration = 0, 0
        self.losses: list[list[float]] = [[]]
        self.reason: str | None = None
        self.is_new_stage = True
        self._begin()

    def _begin(self) -> None:
        """Set up the model and the optimizer of a stage."""
        self.tensors = {f"{name}.{key}": t for name, own in self.values.items() for key, t in own.items()}
        for tensor in self.tensors.values():
            tensor.requires_grad_()
        self.model = _Model(self.problem, self.setting, self.stages[self.stage])
        self.optimizer = self.make_optimizer(list(self.tensors.values()), lr=self.stages[self.stage].learning_rate)

    # ---------------------------------------------------------------------------------------- state

    def state(self) -> dict[str, Any]:
        """What a descent is continued from."""
        return {
            "fingerprint": self.fingerprint(),
            "values": _copied(self.values),
            "best": self.best,
            "stage": self.stage,
            "iteration": self.iteration,
            "losses": self.losses,
            "reason": self.reason,
            "optimizer": self.optimizer.state_dict(),
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        """Continue from a state."""
        if state["fingerprint"] != self.fingerprint():
            raise checkpoints.CheckpointError(
                "checkpoint: got one of another problem, other stages or another optimizer, expected one of this fit; "
                "name another file or remove it"
            )
        self.values, self.best = _copied(state["values"]), state["best"]
        self.stage, self.iteration = state["stage"], state["iteration"]
        self.losses, self.reason = state["losses"], state["reason"]
        self._begin()
        self.optimizer.load_state_dict(state["optimizer"])

    def fingerprint(self) -> str:
        """Of all that the result depends on."""
        name = getattr(self.make_optimizer, "__qualname__", repr(self.make_optimizer))
        return f"{self.problem.fingerprint()} {self.stages!r} {name}"

    # ---------------------------------------------------------------------------------------- steps

    def run(self, tolerance: float) -> Iterator[torch.Tensor]:
        """Descend; yields the images of each iteration, after its step."""
        while self.reason is None:
            try:
                images = self._step()
            except _Diverged as error:
                self.reason = str(error)
                warnings.warn(
                    f"the fit stopped in iteration {self.iteration + 1} of stage {self.stage + 1}: {error}; "
                    "the best values before it are kept",
                    FitWarning,
                    stacklevel=3,
                )
                return
            yield images
            self._advance(tolerance)

    def _step(self) -> torch.Tensor:
        """Evaluate the loss and take a step."""
        stage = self.stages[self.stage]
        for group in self.optimizer.param_groups:
            group["lr"] = stage.rate(self.iteration)
        evaluated: list[tuple[torch.Tensor, torch.Tensor]] = []

        def closure() -> torch.Tensor:
            self.optimizer.zero_grad()
            try:
                loss, images = self.model.loss(self.values)
            except ValueError as error:
                if not self.losses[0]:
                    raise  # what was wrong from the beginning
                raise _Diverged(str(error)) from error
            _check_finite({"the images": images, "the loss": loss})
            loss.backward()
            _check_finite({f"the gradient of {name}": tensor.grad for name, tensor in self.tensors.items()})
            evaluated.append((loss.detach(), images.detach()))
            return loss

        before = _copied(self.values)
        self.optimizer.step(closure)
        with torch.no_grad():
            for free in self.problem.free:
                free.project(self.values[free.name])
        loss, images = evaluated[0]
        losses = self.losses[-1]
        losses.append(float(loss))
        if losses[-1] == min(losses):
            self.best = before
        _check_finite(self.tensors)
        return images

    def _advance(self, tolerance: float) -> None:
        """Count the iteration, and begin the next stage where one ends."""
        self.iteration += 1
        losses = self.losses[-1]
        has_converged = len(losses) > WINDOW and min(losses[-WINDOW:]) > (1 - tolerance) * min(losses[:-WINDOW])
        if not has_converged and self.iteration < self.stages[self.stage].iterations:
            return
        if self.stage + 1 == len(self.stages):
            self.reason = "converged" if has_converged else "finished"
            return
        self.stage, self.iteration = self.stage + 1, 0
        self.values = _copied(self.best)
        self.losses.append([])
        self._begin()


def _copied(values: Mapping[str, Values]) -> dict[str, Values]:
    return {name: {key: tensor.detach().clone() for key, tensor in own.items()} for name, own in values.items()}


def _check_finite(tensors: Mapping[str, torch.Tensor | None]) -> None:
    for name, tensor in tensors.items():
        if tensor is not None and not torch.isfinite(tensor).all():
            raise _Diverged(f"{name} became NaN or Inf")


def fit(
    problem: Problem,
    stages: Sequence[Stage] = (Stage(),),
    *,
    optimizer: Callable[..., torch.optim.Optimizer] = torch.optim.Adam,
    tolerance: float = 1e-4,
    device: str | torch.device = "cpu",
    checkpoint: str | Path | None = None,
    checkpoint_seconds: float = 10.0,
    preview: str | Path | None = None,
    preview_seconds: float = 2.0,
    progress: bool = False,
) -> Result:
    """Fit what a problem leaves free.

    Args:
        problem: The problem.
        stages: What to do in which order. The paper's reference setting is ``[Stage(1000, learning_rate=1e-2)]`` with
            ``optimizer=torch.optim.SGD``.
        optimizer: Makes an optimizer of a list of tensors and ``lr``: any class of ``torch.optim``.
        tolerance: A stage has converged when over 25 iterations its loss fell by less than this part.
        device: Where to compute.
        checkpoint: File to which the state is written, and from which a fit goes on where one that was interrupted left
            off, with the result that it would have had.
        checkpoint_seconds: Time between checkpoints [s].
        preview: PNG that shows targets, images and their difference while the fit runs.
        preview_seconds: Time between previews [s].
        progress: Show a progress bar.

    Returns:
        The result. Where something became NaN or Inf it has the best values before that, and a :class:`FitWarning`
        says what.

    Raises:
        ValueError: for a problem that cannot be rendered, naming the argument.
        CheckpointError: for a checkpoint of another problem.
    """
    from tqdm import tqdm

    stages = tuple(stages)
    if not stages:
        raise ValueError("stages: got none, expected one or more")
    descent = _Descent(problem, stages, optimizer, torch.device(device))
    state = None if checkpoint is None else checkpoints.load(checkpoint)
    if state is not None:
        descent.restore(state)

    def save() -> None:
        if checkpoint is not None:
            checkpoints.save(checkpoint, descent.state())

    saved = previewed = time.perf_counter()
    durations: list[float] = []
    with tqdm(total=sum(stage.iterations for stage in stages), unit="it", disable=not progress) as bar:
        bar.update(sum(map(len, descent.losses)))
        start = time.perf_counter()
        for images in descent.run(tolerance):
            now = time.perf_counter()
            durations = [*durations[-99:], now - start]
            if now - saved >= checkpoint_seconds:
                save()
                saved = time.perf_counter()
            if preview is not None and now - previewed >= preview_seconds:
                write_preview(preview, descent.model.targets, images)
                previewed = time.perf_counter()
            bar.set_postfix_str(f"stage {descent.stage + 1}, loss {descent.losses[-1][-1]:.3e}", refresh=False)
            bar.update()
            start = time.perf_counter()
    save()
    seconds = statistics.median(durations) if durations else math.nan
    return Result(problem, descent.setting, descent.best, descent.losses, descent.reason or "", seconds)
