"""A free pose of a body."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import ArrayLike

from warpshadow import check
from warpshadow.inverse import constraints
from warpshadow.inverse.constraints import PoseConstraint
from warpshadow.inverse.free.base import PRIOR, FreeOfBody, Values
from warpshadow.inverse.world import FitContext, FittedScene, World
from warpshadow.scene.body import Body
from warpshadow.scene.scene import BodyLike, Scene
from warpshadow.torch import rotation_matrices

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

_NO_TURN = {"axis-angle": (0.0, 0.0, 0.0), "quaternion": (0.0, 0.0, 0.0, 1.0), "6d": (1.0, 0.0, 0.0, 0.0, 1.0, 0.0)}
_TURNS = np.array(
    [sign * axis for axis in np.eye(3) for sign in (-1, 1)] + list(itertools.product((-1.0, 1.0), repeat=3))
)


_MAX_TILT = 1.0  # degrees from the nearest stable support up to which a body stands as the scene has it
_OTHER_SIDE = 30.0  # degrees beyond which a body that touches its plane is meant to stand on another side
_MAX_DEPTH = 3.0  # how far a body may stand on its plane [distances from the eye at the start]
_GOLDEN_RATIO = 0.6180339887498949
_MAX_GAP = 1e-3  # part of a body's diagonal by which it may be off a plane that it touches


@check.frozen()
@dataclass(frozen=True)
class Pose(FreeOfBody):
    """The pose of a body: a rotation about the middle of its bounding box, a translation, and maybe a scale.

    Args:
        body: The body, its number or name.
        rotation: Parameters: "axis-angle" [radians], "quaternion" or "6d" (two columns).
        scale: Whether the size is free, too.
        spread: Angle by which candidates are turned [radians]: about each axis, either way, then about the eight
            directions between, then about any; a pose with one axis about that, farther and farther.
        stands_on: A flat body, its number or name, that the body touches from above; three degrees of freedom stay.
        resting: How it stands: "stable", turned onto the support of its convex hull that needs the least turn, if by
            more than 1°; "given", as the scene has it; "free", any way, so that five degrees of freedom stay. Its
            height always follows. By default "given" for a body that touches the plane in the scene, as
            :meth:`.Body.on_ground` places it, without a prior of its tilt; else "stable".
        tilt: Prior of its tilt from there about each of two axes, a standard deviation [radians]: five degrees of
            freedom stay. For scans: their bases are uneven, so a stable one is the plane nearest to all of the base.
        upright: Whether it turns about the world's y alone.
        axis: Direction about which alone it turns, shape [3].
        fixed: Coordinates of its middle that stay: "x", "y", "z". Beside ``stands_on`` the others must be able to move
            it onto the plane: "y" is never fixed above one that is horizontal.
        distance: Prior of the distance of its middle from the first view's eye, and its standard deviation [scene
            units]; not beside a free plane that it stands on.
        size: Prior of the diagonal of its bounding box, and its standard deviation [scene units], of a free scale.
        covariance: Prior of turn [radians] and shift [scene units] from where the scene has it, shape [6, 6]; or their
            six standard deviations. Where a free plane moves it along, from there.
    """

    key = "pose"
    moves = True
    reframes = True
    has_prior = True

    rotation: str = "axis-angle"
    scale: bool = False
    spread: float = 0.55
    stands_on: BodyLike | None = None
    resting: str | None = None
    tilt: float | None = None
    upright: bool = False
    axis: Sequence[float] | None = None
    fixed: Sequence[str] = ()
    distance: Sequence[float] | None = None
    size: Sequence[float] | None = None
    covariance: ArrayLike | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        check.choice("rotation", self.rotation, _NO_TURN)
        check.flag("scale", self.scale)
        if not (check.is_number(self.spread) and 0 <= self.spread <= np.pi):
            raise ValueError(f"spread: got {self.spread!r}, expected an angle from 0 to π")
        self._check_constraints()
        self._check_priors()

    @property
    def has_axis(self) -> bool:
        """Whether it turns about one axis alone, but for a small tilt."""
        return self.upright or self.axis is not None or (self.stands_on is not None and self.resting != "free")

    def _check_constraints(self) -> None:
        if self.resting is not None:
            check.choice("resting", self.resting, constraints.RESTING)
        check.flag("upright", self.upright)
        if isinstance(self.fixed, str) or not isinstance(self.fixed, Sequence):
            raise ValueError(f'fixed: got {check.described(self.fixed)}, expected a list of coordinates, such as ["y"]')
        object.__setattr__(self, "fixed", tuple(self.fixed))
        for coordinate in self.fixed:
            check.choice("fixed", coordinate, constraints.AXES)
        if self.axis is not None:
            object.__setattr__(self, "axis", constraints.checked_axis(self.axis))
        rotation_limits = [name for name in ("upright", "axis") if getattr(self, name)]
        if self.stands_on is not None and self.resting != "free":
            rotation_limits.append("stands_on")
        if len(rotation_limits) > 1:
            raise ValueError(
                f"{rotation_limits[0]}: got it beside {rotation_limits[1]}, expected one axis to turn about"
            )
        if rotation_limits and self.rotation != "axis-angle":
            raise ValueError(f'rotation: got {self.rotation!r} beside {rotation_limits[0]}, expected "axis-angle"')

    def _check_priors(self) -> None:
        if self.tilt is not None:
            check.positive("tilt", self.tilt)
            if self.stands_on is None or self.resting == "free":
                raise ValueError(
                    'tilt: got a prior of a tilt from no support, expected stands_on, not resting = "free"'
                )
        for name in ("distance", "size"):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, constraints.checked_prior(name, getattr(self, name)))
        if self.covariance is not None:
            object.__setattr__(self, "covariance", constraints.checked_covariance(self.covariance))
        if self.size is not None and not self.scale:
            raise ValueError("size: got a prior of a size that is not free, expected scale = true beside it")

    def numbered(self, scene: Scene) -> Pose:
        numbered_pose = replace(self, body=scene.body_number(self.body))
        if self.stands_on is None:
            return numbered_pose
        return replace(numbered_pose, stands_on=scene.body_number(self.stands_on, "stands_on"))

    def check_scene(self, scene: Scene, view_count: int) -> None:
        if self.stands_on is None:
            return
        ground = scene.body_number(self.stands_on, "stands_on")
        if ground == self.number:
            raise ValueError(f"stands_on: got {ground}, the body itself; expected another, such as the ground")
        constraints.onto_plane(constraints.plane_below(scene.bodies[ground], np.zeros(3)).normal, self.fixed)

    def constraint(self, context: FitContext) -> PoseConstraint:
        """The poses that are possible."""
        return context.cached(self, lambda: self._constraint(context))

    def _constraint(self, context: FitContext) -> PoseConstraint:
        body = context.scene.bodies[self.number]
        rotation = body.rotation_matrix()
        axis = constraints.UP if self.upright else self.axis
        turns = np.eye(3) if axis is None else np.array([axis])
        fixed_axes = [np.eye(3)[constraints.AXES[coordinate]] for coordinate in self.fixed]
        if self.stands_on is None:
            return PoseConstraint(turns, constraints.perpendicular_basis(fixed_axes), rotation)
        ground = context.scene.bodies[context.scene.body_number(self.stands_on, "stands_on")]
        plane = constraints.plane_below(ground, self._start_middle(context))
        if self.resting != "free":
            turns = plane.normal[None]
        if self.tilt is not None:
            turns = np.concatenate([turns, constraints.perpendicular_basis([plane.normal])])
        remark = ""
        if self.resting in ("stable", None):
            rotation, remark = self._resting_rotation(body, plane, context)
        shifts = constraints.perpendicular_basis([plane.normal, *fixed_axes])
        onto = constraints.onto_plane(plane.normal, self.fixed)
        return PoseConstraint(turns, shifts, rotation, plane, onto, constraints.hull_points(body.mesh), remark)

    def _resting_rotation(
        self, body: Body, plane: constraints.PlaneConstraint, context: FitContext
    ) -> tuple[np.ndarray, str]:
        """The rotation in which a body stands, its own or that of its stable support, and a remark if they differ."""
        from scipy.spatial.transform import Rotation

        start, is_scan = body.rotation_matrix(), self.tilt is not None
        rotation = constraints.stable_rotation(body.mesh, start, plane.normal, base_is_uneven=is_scan)
        angle = np.degrees(Rotation.from_matrix(rotation @ start.T).magnitude())
        if angle <= _MAX_TILT:
            return (rotation if is_scan else start), ""
        diagonal = 2 * body.scale * context.extent(self.number)
        gap = float((body.world_points() @ plane.normal).min()) - plane.offset
        if self.resting is None and not is_scan and abs(gap) < _MAX_GAP * diagonal:
            if angle > _OTHER_SIDE:
                return start, ""
            rotation, remark = start, f"stands {angle:.2g}° off its stable support"
            remedy = 'resting = "stable" turns it there'
        else:
            remark = f"was turned by {angle:.2g}° onto its stable support"
            remedy = 'resting = "given" keeps it as in the scene'
        check.warn(f"{body.name} {remark}; {remedy}")
        return rotation, remark

    def start(self, context: FitContext) -> Values:
        possible = self.constraint(context)
        turn = np.zeros(len(possible.turns)) if self.rotation == "axis-angle" else _NO_TURN[self.rotation]
        values = {"turn": context.tensor(turn), "shift": context.tensor(np.zeros(len(possible.shifts)))}
        return values | ({"log_scale": context.tensor(0.0)} if self.scale else {})

    def scattered(self, values: Values, number: int, generator: torch.Generator) -> Values:
        from scipy.spatial.transform import Rotation

        copies = super().scattered(values, number, generator)
        if self.has_axis:  # either way, and farther and farther
            copies["turn"][0] += self.spread * (number // 2 + 1) * (-1) ** number
            return copies
        is_listed = number < len(_TURNS)
        axis = _TURNS[number] if is_listed else torch.randn(3, generator=generator).numpy().astype(np.float64)
        return copies | self._turned(values, Rotation.from_rotvec(self.spread * axis / np.linalg.norm(axis)))

    def somewhere(
        self,
        values: Values,
        context: FitContext,
        number: int,
        direction: np.ndarray,
        distance: float,
        generator: np.random.Generator,
    ) -> Values:
        """Turn the body any way, and move it onto a ray of the first view.

        Args:
            values: Where it is.
            number: Of the place, from 0.
            direction: Of the ray, shape [3].
            distance: From the eye, in those of the body at the start; of one that stands on a plane, which says how far
                it is, where the ray does not meet it.
            generator: Of random rotations.
        """
        from scipy.spatial.transform import Rotation

        possible, eye, start = self.constraint(context), context.cameras[0].eye, self._start_middle(context)
        depth = distance * float(np.linalg.norm(start - eye))
        if possible.plane is not None:  # at the height of its middle
            normal = possible.plane.normal
            on_plane = float(normal @ (start - eye)) / float(normal @ direction or 1e-9)
            depth = on_plane if 0 < on_plane < _MAX_DEPTH * depth else depth
        shift = (eye + depth * direction - start) / (
            context.scene.bodies[self.number].scale * context.extent(self.number)
        )
        moved = super().scattered(values, number, torch.Generator()) | {
            "shift": context.tensor(possible.shifts @ shift)
        }
        if self.has_axis:  # evenly around it
            moved["turn"][0] = 2 * np.pi * (_GOLDEN_RATIO * number % 1)
            return moved
        return moved | self._turned(values, Rotation.random(random_state=generator))

    def _turned(self, values: Values, turn: Rotation) -> Values:
        """Values of its rotation, turned further."""
        from scipy.spatial.transform import Rotation

        start = values["turn"].cpu().numpy()
        if self.rotation == "axis-angle":
            turned_vector = (turn * Rotation.from_rotvec(start)).as_rotvec()
        elif self.rotation == "quaternion":
            turned_vector = (turn * Rotation.from_quat(start)).as_quat()
        else:
            turned_vector = turn.apply(start.reshape(2, 3)).ravel()
        return {"turn": torch.tensor(turned_vector, dtype=torch.float32, device=values["turn"].device)}

    def _posed(self, values: Values, context: FitContext) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Rotation, translation and scale of the body: it turns about its middle m, which moves by the shift."""
        rotation, center, scale = self.moved(values, context)
        return rotation, center - scale * rotation @ context.tensor(context.middle(self.number)), scale

    def moved(self, values: Values, context: FitContext) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Rotation, middle in the world, and scale of the body. Differentiable: values."""
        body, possible = context.scene.bodies[self.number], self.constraint(context)
        turn = possible.turn(values["turn"]) if self.rotation == "axis-angle" else values["turn"]
        rotation = rotation_matrices(turn) @ context.tensor(possible.rotation)
        scale = context.tensor(body.scale) * (values["log_scale"].exp() if self.scale else 1)
        shift = body.scale * context.extent(self.number) * possible.shift(values["shift"])
        center = context.tensor(self._start_middle(context)) + shift
        return (
            rotation,
            possible.lower_onto_plane(center, rotation, scale, context.tensor(context.middle(self.number))),
            scale,
        )

    def _start_middle(self, context: FitContext) -> np.ndarray:
        """Initial position of the body's middle in the world."""
        return context.scene.bodies[self.number].to_world(context.middle(self.number))

    def regularizer(self, values: Values, context: FitContext) -> torch.Tensor | None:
        body = context.scene.bodies[self.number]
        rotation, center, scale = self.moved(values, context)
        squares = []
        if self.distance is not None:
            mean, deviation = self.distance
            gap = (center - context.tensor(context.cameras[0].eye)).norm() - mean
            squares.append((gap / deviation).square())
        if self.size is not None:
            mean, deviation = self.size
            squares.append(((2 * context.extent(self.number) * scale - mean) / deviation).square())
        if self.tilt is not None:
            possible = self.constraint(context)
            normal, level = context.tensor(possible.turns[0]), context.tensor(possible.turns[1:])
            tilt = level @ (rotation @ context.tensor(possible.rotation).T @ normal)  # its sine
            squares.append((tilt / self.tilt).square().sum())
        if self.covariance is not None:
            turn = _rotation_vector(rotation @ context.tensor(body.rotation_matrix()).T)
            away = torch.cat([turn, center - context.tensor(self._start_middle(context))])
            squares.append(away @ context.tensor(np.linalg.inv(np.asarray(self.covariance, np.float64))) @ away)
        return PRIOR * torch.stack(squares).sum() if squares else None

    def apply(self, values: Values, context: FitContext, world: World) -> None:
        rotation, translation, scale = self._posed(values, context)
        world.rotations[self.number] = rotation
        world.translations[self.number] = translation
        world.scales[self.number] = scale
        world.moving.add(self.number)

    def export(self, values: Values, context: FitContext, fitted: FittedScene) -> None:
        rotation, translation, scale = (part.cpu().numpy() for part in self._posed(values, context))
        fitted.change_body(self.number, rotation=rotation, translation=translation, scale=float(scale))

    def report(self, context: FitContext, fitted: FittedScene) -> list[tuple[str, str]]:
        remark = self.constraint(context).remark
        return [(self.called(fitted), remark)] if remark else []

    @property
    def body_figures(self) -> tuple[str, ...]:
        return ("rotation", "translation", "scale") if self.scale else ("rotation", "translation")


def _rotation_vector(matrix: torch.Tensor) -> torch.Tensor:
    """The axis-angle vector of a rotation by less than π [radians]. Differentiable: matrix."""
    sine = torch.stack([matrix[2, 1] - matrix[1, 2], matrix[0, 2] - matrix[2, 0], matrix[1, 0] - matrix[0, 1]]) / 2
    length = (sine.square().sum() + 1e-20).sqrt()
    angle = torch.atan2(length, (matrix.trace() - 1) / 2)
    return sine * (angle / length)
