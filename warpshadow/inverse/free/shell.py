"""A free shell: how far away light is that comes from a sphere around the scene."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import ArrayLike

from warpshadow import check
from warpshadow.assets.light import EnvironmentMap
from warpshadow.inverse.free.base import Free, Values
from warpshadow.inverse.world import FittedScene, Setting, World
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

    def check_scene(self, scene: Scene) -> None:
        if scene.shell is None:
            raise ValueError(
                "shell: got it for a scene whose light is infinitely far away, expected light of a radius: "
                "EnvironmentMap(…, radius=…)"
            )

    def start(self, setting: Setting) -> Values:
        return {"log_gap": setting.tensor(0.0)}

    def _start(self, setting: Setting) -> tuple[np.ndarray, float, float]:
        """The center, the smallest radius, and the gap between that and the radius in the scene."""

        def find() -> tuple[np.ndarray, float, float]:
            assert setting.scene.shell is not None
            *center, radius = setting.scene.shell.tolist()
            points = np.concatenate([body.world_points() for body in setting.scene.bodies])
            farthest = float(np.linalg.norm(points - center, axis=1).max())
            smallest = min((1 + _CLEARANCE) * farthest, radius)
            return np.array(center), smallest, max(radius - smallest, _MIN_GAP * farthest)

        return setting.cached(self, find)

    def shell(self, values: Values, setting: Setting) -> torch.Tensor:
        """Center and radius [scene units], shape [4]. Differentiable: values."""
        center, smallest, gap = self._start(setting)
        radius = smallest + gap * (_REACH * values["log_gap"]).exp()
        return torch.cat([setting.tensor(center), radius.reshape(1)])

    def apply(self, values: Values, setting: Setting, world: World) -> None:
        world.shell = self.shell(values, setting)

    def export(self, values: Values, setting: Setting, fitted: FittedScene) -> None:
        assert isinstance(fitted.scene.light, EnvironmentMap)
        light = replace(fitted.scene.light, radius=float(self.shell(values, setting)[3]))
        fitted.scene = replace(fitted.scene, light=light)

    def summary(self, fitted: FittedScene) -> Mapping[str, ArrayLike]:
        assert fitted.scene.shell is not None
        return {"light.radius": fitted.scene.shell[3]}
