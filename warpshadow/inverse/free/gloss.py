"""Free gloss of a body: how rough it is, and how much of it is metal."""

from dataclasses import dataclass

import numpy as np
import torch

from warpshadow import check
from warpshadow.inverse.free.base import Values
from warpshadow.inverse.free.reflectance import FreeOfSurface
from warpshadow.inverse.world import FitContext, FittedScene, World
from warpshadow.scene.body import Body
from warpshadow.scene.material import GLOSS_DEFAULTS
from warpshadow.scene.scene import Scene
from warpshadow.stages.gloss.lobes import MIN_ROUGHNESS


class _Gloss(FreeOfSurface):
    """A number of a body that shines, and has roughness in the scene; its values have no dimension of channels."""

    def check_scene(self, scene: Scene, view_count: int) -> None:
        if not scene.bodies[self.number].is_glossy:
            raise ValueError(f"body: got {self.number}, which is diffuse; expected one that has roughness")
        super().check_scene(scene, view_count)

    def rows(self, body: Body) -> np.ndarray:
        value = getattr(body, self.key)
        return (np.full(1, GLOSS_DEFAULTS[self.key]) if value is None else value)[..., None]

    def start(self, context: FitContext) -> Values:
        return {"value": super().start(context)["value"][..., 0].contiguous()}

    def apply(self, values: Values, context: FitContext, world: World) -> None:
        value = self._bounded(values["value"])  # line searches look beyond
        world.gloss[self.key][self.number] = value if self.size is None else value[None]

    def project(self, values: Values) -> None:
        """Numbers are in [0, 1]; roughness is at least the lowest that is shown."""
        values["value"].copy_(self._bounded(values["value"]))

    def _bounded(self, numbers: torch.Tensor) -> torch.Tensor:
        return numbers.clamp(MIN_ROUGHNESS if self.key == "roughness" else 0, 1)

    def export(self, values: Values, context: FitContext, fitted: FittedScene) -> None:
        fitted.change_body(self.number, **{self.key: values["value"].cpu().numpy()})


@check.frozen()
@dataclass(frozen=True)
class Roughness(_Gloss):
    """Roughness of a glossy body; arguments as of :class:`.FreeOfSurface`."""

    key = "roughness"


@check.frozen()
@dataclass(frozen=True)
class Metallic(_Gloss):
    """Metallic share of a glossy body; arguments as of :class:`.FreeOfSurface`."""

    key = "metallic"
