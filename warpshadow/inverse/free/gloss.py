"""Free gloss of a body: how rough it is, and how much of it is metal."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import ArrayLike

from warpshadow import check
from warpshadow.inverse.free.base import FreeOfBody, Values
from warpshadow.inverse.free.reflectance import check_texture_settings, check_uvs, resized, variation
from warpshadow.inverse.world import FittedScene, Setting, World
from warpshadow.scene.material import GLOSS_DEFAULTS
from warpshadow.scene.scene import Scene
from warpshadow.stages.gloss.lobes import MIN_ROUGHNESS


@dataclass(frozen=True)
class _Gloss(FreeOfBody):
    """A number of a body that shines, or one for each vertex, or a texture.

    Args:
        body: The body, its number or name; it has roughness in the scene, from which the fit starts.
        per_vertex: A number for each vertex.
        size: Height and width of a texture [texels], which needs uvs; None for no texture. Texels that no view sees
            stay as they start.
        smoothness: Weight of the mean square of differences between neighboring texels.
    """

    per_vertex: bool = False
    size: tuple[int, int] | None = None
    smoothness: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        check.flag("per_vertex", self.per_vertex)
        check_texture_settings(self)

    def check_scene(self, scene: Scene) -> None:
        """Raise ValueError for a body that is diffuse."""
        body = scene.bodies[self.number]
        if not body.is_glossy:
            raise ValueError(f"body: got {self.number}, which is diffuse; expected one that has roughness")
        if self.size is not None:
            check_uvs(self.number, scene)
        elif self.per_vertex and np.ndim(getattr(body, self.key)) == 2:
            raise ValueError(f"per_vertex: got it of a body whose {self.key} is a texture, expected size")

    def start(self, setting: Setting) -> Values:
        """The body's numbers; their mean, where one is free; or its texture."""
        body = setting.scene.bodies[self.number]
        body_value = getattr(body, self.key)
        numbers = np.full(1, GLOSS_DEFAULTS[self.key]) if body_value is None else body_value
        if self.per_vertex:
            return {"value": setting.tensor(np.broadcast_to(numbers, (body.mesh.vertex_count,)))}
        mean = setting.tensor(numbers.mean().reshape(1))
        if self.size is None:
            return {"value": mean}
        image = setting.tensor(numbers)[..., None] if numbers.ndim == 2 else mean[:, None, None]
        return {"value": resized(image, self.size)[..., 0]}

    def apply(self, values: Values, setting: Setting, world: World) -> None:
        """Make the body shine so."""
        value = self._bounded(values["value"])  # line searches look beyond
        world.gloss[self.key][self.number] = value if self.size is None else value[None]

    def regularizer(self, values: Values, setting: Setting) -> torch.Tensor | None:
        """Penalty of rugged textures."""
        return self.smoothness * variation(values["value"]) if self.smoothness else None

    def project(self, values: Values) -> None:
        """Numbers are in [0, 1]; roughness is at least the lowest that is shown."""
        values["value"].copy_(self._bounded(values["value"]))

    def _bounded(self, numbers: torch.Tensor) -> torch.Tensor:
        return numbers.clamp(MIN_ROUGHNESS if self.key == "roughness" else 0, 1)

    def export(self, values: Values, setting: Setting, fitted: FittedScene) -> None:
        """Make the body shine so."""
        fitted.change_body(self.number, **{self.key: values["value"].cpu().numpy()})

    def summary(self, fitted: FittedScene) -> Mapping[str, ArrayLike]:
        """The number, of a body that has one."""
        if self.per_vertex or self.size is not None:
            return {}
        return {f"{self.called(fitted)}.{self.key}": getattr(fitted.scene.bodies[self.number], self.key)[0]}


@check.frozen()
@dataclass(frozen=True)
class Roughness(_Gloss):
    """Roughness of a glossy body."""

    key = "roughness"


@check.frozen()
@dataclass(frozen=True)
class Metallic(_Gloss):
    """Metallic share of a glossy body."""

    key = "metallic"
