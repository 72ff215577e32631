"""A free shell: how far away light is that comes from a sphere around the scene."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import ArrayLike

from warpshadow import check
from warpshadow.inverse.free.base import Free, Values
from warpshadow.inverse.world import FitContext, FittedScene, World
from warpshadow.scene.scene import Scene

_REACH = 4.0  # logarithm of the gap between bodies and shell, for a value of 1
_CLEARANCE = 0.02  # smallest gap, in distances of the farthest body from the center
_MIN_GAP = 1e-3  # that a fit starts with, in the same


@check.frozen()
@dataclass(frozen=True)
class Shell(Free):
    """The radius of the light's shell, around the center that the scene has.

    The bodies stay within it: their farthest point, where the scene has them, is nearer to the center. Its radiance is
    :class:`.Light`, in cells.
    """

    key = "shell"
    shows_in_outlines = False
    moves = True  # rays, which lights alone may have, have no gradient to it

    def check_scene(self, scene: Scene, view_count: int) -> None:
        if scene.shell is None:
            raise ValueError(
                "shell: got it for a scene whose light is infinitely far away, expected light of a radius: "
                "EnvironmentMap(…, radius=…)"
            )

    def start(self, context: FitContext) -> Values:
        return {"log_gap": context.tensor(0.0)}

    def _start(self, context: FitContext) -> tuple[np.ndarray, float, float]:
        """The center, the smallest radius, and the gap between that and the radius in the scene."""

        def find() -> tuple[np.ndarray, float, float]:
            assert context.scene.shell is not None
            *center, radius = context.scene.shell.tolist()
            points = np.concatenate([body.world_points() for body in context.scene.bodies])
            farthest = float(np.linalg.norm(points - center, axis=1).max())
            smallest = min((1 + _CLEARANCE) * farthest, radius)
            return np.array(center), smallest, max(radius - smallest, _MIN_GAP * farthest)

        return context.cached(self, find)

    def shell(self, values: Values, context: FitContext) -> torch.Tensor:
        """Center and radius [scene units], shape [4]. Differentiable: values."""
        center, smallest, gap = self._start(context)
        radius = smallest + gap * (_REACH * values["log_gap"]).exp()
        return torch.cat([context.tensor(center), radius.reshape(1)])

    def apply(self, values: Values, context: FitContext, world: World) -> None:
        world.shell = self.shell(values, context)

    def export(self, values: Values, context: FitContext, fitted: FittedScene) -> None:
        before = fitted.scene.known_light.as_map
        assert before is not None
        light = replace(before, radius=float(self.shell(values, context)[3]))
        fitted.scene = replace(fitted.scene, light=light)

    def summary(self, fitted: FittedScene) -> Mapping[str, ArrayLike]:
        assert fitted.scene.shell is not None
        return {"light.radius": fitted.scene.shell[3]}

    def report(self, context: FitContext, fitted: FittedScene) -> list[tuple[str, str]]:
        assert fitted.scene.shell is not None
        return [("light radius", f"{fitted.scene.shell[3]:.4g} scene units")]
