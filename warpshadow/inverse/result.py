"""Results: the values that a fit found, and all that follows from them."""

import functools
import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import torch

from warpshadow.assets.camera import Camera
from warpshadow.inverse.found_light import FoundLight, found_light
from warpshadow.inverse.free.base import Values
from warpshadow.inverse.model import Model
from warpshadow.inverse.problem import Problem
from warpshadow.inverse.schedule import Stage
from warpshadow.inverse.uncertainty import Uncertainty, uncertainty
from warpshadow.inverse.verdict import Verdict, verdict
from warpshadow.inverse.world import FitContext, FittedScene
from warpshadow.scene.scene import Scene


@dataclass(frozen=True, eq=False)
class Result:
    """Result of a fit.

    Args:
        problem: The problem that was fitted.
        context: Its scene at the start and its units.
        values: Free parameters by name, at the least loss of the last stage.
        losses: Loss of each iteration before its step, a list for each candidate of each stage.
        reason: Why the fit ended: "converged", "finished" (all iterations done), "stopped" (on its page), or the name
            of a non-finite quantity.
        seconds: Median time of an iteration of the last stage [s].
        last: The last stage.
    """

    problem: Problem
    context: FitContext = field(repr=False)
    values: dict[str, Values] = field(repr=False)
    losses: list[list[float]] = field(repr=False)
    reason: str
    seconds: float
    last: Stage = field(default=Stage(), repr=False)

    def __repr__(self) -> str:
        free = ", ".join(self.values)
        count = sum(map(len, self.losses))
        loss = min(self.losses[-1], default=math.nan)
        return f"Result({free}: {self.reason} after {count} iterations, loss {loss:.3g})"

    @functools.cached_property
    def found(self) -> FittedScene:
        """Scene, cameras and exposures."""
        return self.problem.fitted_scene(self.values, self.context)

    @property
    def scene(self) -> Scene:
        """The scene that explains the targets."""
        return self.found.scene

    @functools.cached_property
    def light(self) -> FoundLight | None:
        """The light that was found, and which directions of it the images determined; None where it was not free."""
        if self.problem.light is None:
            return None
        return found_light(self.scene.light, self.problem, self.context, self.values)

    @functools.cached_property
    def verdict(self) -> Verdict:
        """Whether it explains the targets: a descent that converged may have found another minimum."""
        return verdict(self.problem, self.context, self.values, self.last)

    @functools.cached_property
    def uncertainty(self) -> Uncertainty | None:
        """Uncertainty of its few parameters, such as poses and exposures; None without any."""
        return uncertainty(self.problem, self.context, self.values, self.found, self.verdict)

    @property
    def cameras(self) -> list[Camera]:
        """The cameras of the views."""
        return self.found.cameras

    @property
    def figures(self) -> dict[str, list[float]]:
        """The fitted parameters that are a few numbers, by their keys in scene files."""
        figures: dict[str, list[float]] = {}
        for free in self.problem.free:
            for key, numbers in free.summary(self.found).items():
                figures[key] = np.ravel(numbers).astype(float).tolist()
        return figures

    def images(self, values: Mapping[str, Values] | None = None) -> np.ndarray:
        """Images of the views, [view, height, width, 4], of the result or of other values."""
        model = Model(self.problem, self.context, Stage())
        with torch.no_grad():
            return model.images(self.values if values is None else values).cpu().numpy()

    @functools.cached_property
    def pixel_weights(self) -> np.ndarray:
        """How much each pixel of the targets counts in the end, 0 to 1, [view, height, width].

        The masks times the weights that a robust loss learned: about 0 where a redescending one, "geman-mcclure" or
        "barron", took a pixel for that of an occluder or a highlight.
        """
        model = Model(self.problem, self.context, Stage())
        with torch.no_grad():
            return model.pixel_weights(model.images(self.values)).cpu().numpy()

    def images_at_start(self) -> np.ndarray:
        """Images of the views before the fit, [view, height, width, 4]."""
        return self.images(self.problem.start(self.context))
