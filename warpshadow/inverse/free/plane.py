"""A free plane: height and tilt of the ground."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import ArrayLike

from warpshadow import check
from warpshadow.inverse import constraints
from warpshadow.inverse.free.base import PRIOR, Free, FreeOfBody, Values
from warpshadow.inverse.free.pose import Pose
from warpshadow.inverse.world import FitContext, FittedScene, World
from warpshadow.scene.scene import BodyLike, Scene
from warpshadow.torch import rotation_matrices


@check.frozen()
@dataclass(frozen=True)
class Plane(FreeOfBody):
    """The height and the tilt of a flat body, such as the ground; bodies that stand on it move along.

    It moves as a rigid body that neither slides nor turns about its normal, so all that stands on it stays there, and
    its poses are relative to it.

    Args:
        body: The flat body, its number or name.
        height: Prior: standard deviation of its height along the normal from where the scene has it, below the middle
            of the other bodies [scene units]; None for none.
        tilt: Prior: standard deviation of its tilt about each of two axes [radians]; None for none.
        points: Points that lie on it, such as of a calibration pattern or a depth camera, [point, 3], three or more:
            it starts at the nearest plane.
        deviation: Standard deviation of their distances from it [scene units].
        carries: Further bodies that move with it, beside bodies that a free pose stands on it: numbers or names.
    """

    key = "plane"
    moves = True
    moves_last = True
    excludes = {"pose": "both place the body"}
    has_prior = True
    body_figures = ("rotation", "translation")

    height: float | None = None
    tilt: float | None = None
    points: ArrayLike | None = None
    deviation: float | None = None
    carries: Sequence[BodyLike] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("height", "tilt", "deviation"):
            if getattr(self, name) is not None:
                check.positive(name, getattr(self, name))
        if (self.points is None) != (self.deviation is None):
            raise ValueError("points, deviation: got one of them, expected both: points and how far they are off")
        if self.points is not None:
            points = check.numbers("points", self.points, expected="points [point, 3]", dtype=np.float64)
            check.shape("points", points.shape, ("point", 3))
            check.finite("points", points)
            if np.linalg.matrix_rank(points - points.mean(axis=0), tol=1e-6 * float(np.ptp(points, axis=0).max())) < 2:
                raise ValueError(f"points: got {len(points)} in a line, expected three or more that span a plane")
            object.__setattr__(self, "points", tuple(map(tuple, points.tolist())))
        if isinstance(self.carries, str) or not isinstance(self.carries, Sequence):
            raise ValueError(f"carries: got {check.described(self.carries)}, expected a list of bodies")
        object.__setattr__(self, "carries", tuple(self.carries))

    def numbered(self, scene: Scene) -> Plane:
        carries = tuple(scene.body_number(body, "carries") for body in self.carries)
        return replace(self, body=scene.body_number(self.body), carries=carries)

    def check_scene(self, scene: Scene, view_count: int) -> None:
        constraints.plane_below(scene.bodies[self.number], np.zeros(3), "body")
        if self.number in self.carries:
            raise ValueError(f"carries: got {self.number}, the plane itself; expected bodies that stand on it")

    def beside(self, others: Sequence[Free]) -> Plane:
        """The plane that carries all bodies whose free poses stand on it."""
        poses = [pose for pose in others if isinstance(pose, Pose) and pose.stands_on == self.number]
        for pose in poses:
            if pose.distance is not None:
                raise ValueError(f"{pose.name}: got a distance beside a free {self.name}, expected priors of the plane")
        return replace(self, carries=tuple(sorted({*self._moving()[1:], *(pose.number for pose in poses)})))

    def _moving(self) -> list[int]:
        """The bodies that move: itself, and all that it carries."""
        return [self.number, *(body for body in self.carries if isinstance(body, int))]

    def _start(self, context: FitContext) -> tuple[np.ndarray, np.ndarray, float]:
        """The normal at the start, the point about which it tilts, and the unit of its height."""
        return context.cached(self, lambda: self._find_start(context))

    def _find_start(self, context: FitContext) -> tuple[np.ndarray, np.ndarray, float]:
        bodies = context.scene.bodies
        others = [number for number in range(len(bodies)) if number != self.number] or [self.number]
        middles = [np.mean(bodies[number].world_mesh().bounds, axis=0) for number in others]
        plane = constraints.plane_below(bodies[self.number], context.cameras[0].eye, "body")
        above = np.mean(middles, axis=0)
        foot = above - plane.normal * (plane.normal @ above - plane.offset)
        return plane.normal, foot, float(np.mean([bodies[n].scale * context.extent(n) for n in others]))

    def start(self, context: FitContext) -> Values:
        """Plane of the scene, or the plane nearest to the points."""
        tilt, height = np.zeros(2), 0.0
        if self.points is not None:
            from scipy.spatial.transform import Rotation

            normal, foot, unit = self._start(context)
            points = np.asarray(self.points)
            middle = points.mean(axis=0)
            nearest = np.linalg.svd(points - middle)[2][-1]
            nearest = nearest * np.sign(nearest @ normal)
            turn = Rotation.from_matrix(constraints.turn_onto(normal, nearest)).as_rotvec()
            tilt = constraints.perpendicular_basis([normal]) @ turn
            height = (nearest @ (middle - foot)) / (nearest @ normal) / unit
        return {"tilt": context.tensor(tilt), "height": context.tensor(height)}

    def moved(
        self, values: Values, context: FitContext, rotation: torch.Tensor, point: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Move a rotation and a point along with the plane. Differentiable: all but context."""
        normal, foot, unit = self._start(context)
        tangents = context.tensor(constraints.perpendicular_basis([normal]))
        turn = rotation_matrices(tangents.T @ values["tilt"])
        pivot = context.tensor(foot)
        return turn @ rotation, turn @ (point - pivot) + pivot + unit * values["height"] * context.tensor(normal)

    def regularizer(self, values: Values, context: FitContext) -> torch.Tensor | None:
        normal, foot, unit = self._start(context)
        squares = []
        if self.height is not None:
            squares.append((unit * values["height"] / self.height).square())
        if self.tilt is not None:
            squares.append((values["tilt"] / self.tilt).square().sum())
        if self.points is not None and self.deviation is not None:
            turn, moved_foot = self.moved(values, context, context.tensor(np.eye(3)), context.tensor(foot))
            gaps = (context.tensor(np.asarray(self.points)) - moved_foot) @ (turn @ context.tensor(normal))
            squares.append((gaps / self.deviation).square().sum())
        return PRIOR * torch.stack(squares).sum() if squares else None

    def apply(self, values: Values, context: FitContext, world: World) -> None:
        for number in self._moving():
            world.rotations[number], world.translations[number] = self.moved(
                values, context, world.rotations[number], world.translations[number]
            )
            world.moving.add(number)

    def export(self, values: Values, context: FitContext, fitted: FittedScene) -> None:
        for number in self._moving():
            body = fitted.scene.bodies[number]
            start = context.tensor(body.rotation_matrix()), context.tensor(body.translation)
            rotation, translation = (part.cpu().numpy() for part in self.moved(values, context, *start))
            fitted.change_body(number, rotation=rotation, translation=translation)
