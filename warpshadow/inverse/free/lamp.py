"""A free lamp: the place of a body that emits."""

from dataclasses import dataclass

import numpy as np
import torch

from warpshadow import check
from warpshadow.inverse import constraints
from warpshadow.inverse.free.base import FreeOfBody, Values
from warpshadow.inverse.free.emission import check_emits
from warpshadow.inverse.world import FitContext, FittedScene, World
from warpshadow.maths.directions import fibonacci
from warpshadow.scene.scene import Scene

_REACH = 4.0  # turn [radians], and logarithm of the distance, for a value of 1: a lamp moves farther than a pose


@check.frozen()
@dataclass(frozen=True)
class Lamp(FreeOfBody):
    """The place of a lamp, a body that emits: its direction and distance from the middle of the others.

    It keeps the size that it has as seen from there. So its distance says how fast its light falls off and how shadows
    spread, and neither how bright the middle is nor how soft shadows are there. Its radiance is :class:`Emission`.

    Args:
        body: The body, its number or name.
    """

    key = "lamp"
    shows_in_outlines = False
    moves = True
    excludes = {"pose": "both place the body"}
    relocation_count = 8  # directions above the middle of a scene
    body_figures = ("translation", "scale")

    def check_scene(self, scene: Scene, view_count: int) -> None:
        check_emits(scene, self.number)
        if all(body.is_emitter for body in scene.bodies):
            raise ValueError(f"body: got {self.number} in a scene of lamps alone, expected another body that it lights")

    def start(self, context: FitContext) -> Values:
        return {"turn": context.tensor(np.zeros(2)), "log_distance": context.tensor(0.0)}

    def _start(self, context: FitContext) -> tuple[np.ndarray, np.ndarray, float]:
        """Middle of the others, and from there the direction and the distance of the lamp in the scene."""

        def find() -> tuple[np.ndarray, np.ndarray, float]:
            others = [body for body in context.scene.bodies if not body.is_emitter]
            solid = [body for body in others if not body.mesh.is_flat]  # which count alone, if there are any
            middle = np.mean([np.mean(body.world_mesh().bounds, axis=0) for body in solid or others], axis=0)
            offset = context.scene.bodies[self.number].to_world(context.middle(self.number)) - middle
            distance = float(np.linalg.norm(offset))
            return middle, (offset / distance if distance > 0 else np.array(constraints.UP)), distance

        return context.cached(self, find)

    def _placed(self, values: Values, context: FitContext) -> tuple[torch.Tensor, torch.Tensor]:
        """Translation and scale of the body. Differentiable: values."""
        middle, start_direction, distance = self._start(context)
        body = context.scene.bodies[self.number]
        factor = (_REACH * values["log_distance"]).exp()
        direction = constraints.turned_direction(start_direction, _REACH * values["turn"])
        scale = body.scale * factor
        own_middle = context.tensor(body.rotation_matrix() @ context.middle(self.number))
        return context.tensor(middle) + distance * factor * direction - scale * own_middle, scale

    def relocated(self, values: Values, context: FitContext, number: int) -> Values:
        """The lamp in another direction above, as far away; directions repeat."""
        _, start_direction, _ = self._start(context)
        above = fibonacci(2 * self.relocation_count)[:, [0, 2, 1]]
        direction = above[above[:, 1] > 0][number % self.relocation_count]
        sideways = constraints.perpendicular_basis([start_direction]) @ direction
        angle = np.arctan2(np.linalg.norm(sideways), direction @ start_direction)
        turn = angle / max(float(np.linalg.norm(sideways)), 1e-12) * sideways / _REACH
        return {"turn": context.tensor(turn), "log_distance": values["log_distance"].detach().clone()}

    def apply(self, values: Values, context: FitContext, world: World) -> None:
        world.translations[self.number], world.scales[self.number] = self._placed(values, context)
        world.moving.add(self.number)

    def export(self, values: Values, context: FitContext, fitted: FittedScene) -> None:
        translation, scale = (part.cpu().numpy() for part in self._placed(values, context))
        fitted.change_body(self.number, translation=translation, scale=float(scale))
