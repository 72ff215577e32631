"""Free emission of a body: the radiance of a lamp."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import ArrayLike

from warpshadow import check
from warpshadow.inverse.free.base import FreeOfBody, Values
from warpshadow.inverse.free.reflectance import check_texture_settings, check_uvs, resized, variation
from warpshadow.inverse.world import FittedScene, Setting, World
from warpshadow.scene.scene import Scene


@check.frozen()
@dataclass(frozen=True)
class Emission(FreeOfBody):
    """The radiance of a body that emits in the scene, from where the fit starts: one color, or many.

    Args:
        body: The body, its number or name.
        per_vertex: A color for each vertex.
        size: Height and width of a texture [texels], which needs uvs; None for no texture.
        smoothness: Weight of the mean square of differences between neighboring texels, relative to the radiance.
    """

    key: ClassVar[str] = "emission"

    per_vertex: bool = False
    size: tuple[int, int] | None = None
    smoothness: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        check.flag("per_vertex", self.per_vertex)
        check_texture_settings(self)

    @property
    def is_light(self) -> bool:
        """Images are linear in it; one color is solved for, numbers of many vertices are descended to."""
        return not self.per_vertex and self.size is None

    def check_scene(self, scene: Scene) -> None:
        """Raise ValueError for a body that does not emit."""
        check_emits(scene, self.number)
        emission = scene.bodies[self.number].emission
        if self.per_vertex and emission is not None and emission.ndim == 3:
            raise ValueError("per_vertex: got it of a body whose emission is a texture, expected size")
        if self.size is not None:
            check_uvs(self.number, scene)

    def _unit(self, setting: Setting) -> float:
        """Radiance that counts as 1: a lamp is far brighter than its image."""
        start = setting.scene.bodies[self.number].emission
        assert start is not None
        return float(start.mean()) or setting.unit

    def start(self, setting: Setting) -> Values:
        """The body's radiance; the mean of its vertices' or texels', where one is free."""
        body = setting.scene.bodies[self.number]
        radiance = np.atleast_2d(np.asarray(body.emission)) / self._unit(setting)
        if self.per_vertex:
            return {"radiance": setting.tensor(np.broadcast_to(radiance, (body.mesh.vertex_count, 3)))}
        mean = setting.tensor(radiance.reshape(-1, 3).mean(axis=0)[None])
        if self.size is None:
            return {"radiance": mean}
        return {"radiance": resized(setting.tensor(radiance) if radiance.ndim == 3 else mean[None], self.size)}

    def apply(self, values: Values, setting: Setting, world: World) -> None:
        """Let the body emit it."""
        radiance = values["radiance"].clamp(min=0) * self._unit(setting)  # line searches look beyond
        world.emission[self.number] = radiance if self.size is None else radiance[None]

    def regularizer(self, values: Values, setting: Setting) -> torch.Tensor | None:
        """Penalty of rugged textures."""
        return self.smoothness * variation(values["radiance"]) if self.smoothness else None

    def project(self, values: Values) -> None:
        """Radiance is 0 or more."""
        values["radiance"].clamp_(min=0)

    def export(self, values: Values, setting: Setting, fitted: FittedScene) -> None:
        """Let the body emit it."""
        radiance = (values["radiance"] * self._unit(setting)).cpu().numpy()
        fitted.change_body(self.number, emission=radiance[0] if self.is_light else radiance)

    def summary(self, fitted: FittedScene) -> Mapping[str, ArrayLike]:
        """The radiance, of a body that has one."""
        emission = fitted.scene.bodies[self.number].emission
        return {f"{self.called(fitted)}.emission": emission} if self.is_light and emission is not None else {}


def check_emits(scene: Scene, body: int) -> None:
    """Raise ValueError for a body that does not emit."""
    if scene.bodies[body].emission is None:
        raise ValueError(f"body: got {body}, which does not emit; expected one that has emission")
