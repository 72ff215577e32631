"""Free emission of a body: the radiance of a lamp."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from warpshadow import check
from warpshadow.inverse.free.base import Values
from warpshadow.inverse.free.reflectance import FreeOfSurface
from warpshadow.inverse.world import FitContext, FittedScene, World
from warpshadow.scene.body import Body
from warpshadow.scene.scene import Scene


@check.frozen()
@dataclass(frozen=True)
class Emission(FreeOfSurface):
    """The radiance of a body that emits in the scene, from where the fit starts: one color, or many.

    Args:
        body: The body, its number or name.
        per_vertex: A color for each vertex.
        size: Height and width of a texture [texels], which needs uvs; None for no texture.
        smoothness: Weight of the mean square of differences between neighboring texels, relative to the radiance.
    """

    key = "emission"
    value_key = "radiance"
    scales = "light"

    @property
    def is_light(self) -> bool:
        """Images are linear in it; one color is solved for, numbers of many vertices are descended to."""
        return self.is_one

    def check_scene(self, scene: Scene, view_count: int) -> None:
        check_emits(scene, self.number)
        super().check_scene(scene, view_count)

    def _unit(self, context: FitContext) -> float:
        """Radiance that counts as 1: a lamp is far brighter than its image."""
        start = context.scene.bodies[self.number].emission
        assert start is not None
        return float(start.mean()) or context.unit

    def rows(self, body: Body) -> np.ndarray:
        return np.atleast_2d(np.asarray(body.emission))

    def apply(self, values: Values, context: FitContext, world: World) -> None:
        radiance = values["radiance"].clamp(min=0) * self._unit(context)  # line searches look beyond
        world.emission[self.number] = radiance if self.size is None else radiance[None]

    def project(self, values: Values) -> None:
        values["radiance"].clamp_(min=0)

    def export(self, values: Values, context: FitContext, fitted: FittedScene) -> None:
        radiance = (values["radiance"] * self._unit(context)).cpu().numpy()
        fitted.change_body(self.number, emission=radiance[0] if self.is_one else radiance)


def check_emits(scene: Scene, body: int) -> None:
    """Raise ValueError for a body that does not emit."""
    if scene.bodies[body].emission is None:
        raise ValueError(f"body: got {body}, which does not emit; expected one that has emission")
