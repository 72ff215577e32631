"""Free gloss of a body: how rough it is, and how much of it is metal."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from warpshadow import check
from warpshadow.inverse.free.base import FreeOfBody, Values
from warpshadow.inverse.world import FittedScene, Setting, World
from warpshadow.pipeline.reflectance import GLOSS_DEFAULTS
from warpshadow.scene.scene import Scene
from warpshadow.stages.gloss.lobes import MIN_ROUGHNESS


@dataclass(frozen=True)
class _Gloss(FreeOfBody):
    """A number of a body that shines, or one for each vertex.

    Args:
        body: The body, its number or name; it has roughness in the scene, from which the fit starts.
        per_vertex: A number for each vertex.
    """

    per_vertex: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        check.flag("per_vertex", self.per_vertex)

    def check_scene(self, scene: Scene) -> None:
        """Raise ValueError for a body that is diffuse."""
        if not scene.bodies[self.number].is_glossy:
            raise ValueError(f"body: got {self.number}, which is diffuse; expected one that has roughness")

    def start(self, setting: Setting) -> Values:
        """The body's numbers; their mean, where one is free."""
        body = setting.scene.bodies[self.number]
        body_value = getattr(body, self.key)
        numbers = np.full(1, GLOSS_DEFAULTS[self.key]) if body_value is None else body_value
        numbers = (
            np.broadcast_to(numbers, (body.mesh.vertex_count,)) if self.per_vertex else numbers.mean(keepdims=True)
        )
        return {"value": setting.tensor(numbers)}

    def apply(self, values: Values, setting: Setting, world: World) -> None:
        """Make the body shine so."""
        world.gloss[self.key][self.number] = values["value"]

    def project(self, values: Values) -> None:
        """Numbers are in [0, 1]; roughness is at least the lowest that is shown."""
        values["value"].clamp_(MIN_ROUGHNESS if self.key == "roughness" else 0, 1)

    def export(self, values: Values, setting: Setting, fitted: FittedScene) -> None:
        """Make the body shine so."""
        fitted.change_body(self.number, **{self.key: values["value"].cpu().numpy()})

    def summary(self, fitted: FittedScene) -> Mapping[str, ArrayLike]:
        """The number, of a body that has one."""
        if self.per_vertex:
            return {}
        return {f"{self.called(fitted)}.{self.key}": getattr(fitted.scene.bodies[self.number], self.key)[0]}


@dataclass(frozen=True)
class Roughness(_Gloss):
    """How rough a body is that shines."""

    key = "roughness"


@dataclass(frozen=True)
class Metallic(_Gloss):
    """How much of a body that shines is metal."""

    key = "metallic"
