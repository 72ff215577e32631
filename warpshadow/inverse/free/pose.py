"""A free pose of a body."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import ArrayLike

from warpshadow import check
from warpshadow.inverse.free.base import FreeOfBody, Values
from warpshadow.inverse.world import FittedScene, Setting, World
from warpshadow.torch import rotation_matrices

_NO_TURN = {
    "axis-angle": (0.0, 0.0, 0.0),
    "quaternion": (0.0, 0.0, 0.0, 1.0),
    "6d": (1.0, 0.0, 0.0, 0.0, 1.0, 0.0),
}
_TURNS = np.array(
    [sign * axis for axis in np.eye(3) for sign in (-1, 1)] + list(itertools.product((-1.0, 1.0), repeat=3))
)


@dataclass(frozen=True)
class Pose(FreeOfBody):
    """The pose of a body: a rotation about the middle of its bounding box, a translation, and maybe a scale.

    Args:
        body: The body, its number or name.
        rotation: Parameters: "axis-angle" [radians], "quaternion" or "6d" (two columns).
        scale: Whether the size is free, too.
        spread: Angle by which candidates are turned [radians]: about each axis, either way, then about the eight
            directions between, then about any.
    """

    key: ClassVar[str] = "pose"
    moves: ClassVar[bool] = True

    rotation: str = "axis-angle"
    scale: bool = False
    spread: float = 0.55

    def __post_init__(self) -> None:
        super().__post_init__()
        check.choice("rotation", self.rotation, _NO_TURN)
        check.flag("scale", self.scale)
        if not (check.is_number(self.spread) and 0 <= self.spread <= np.pi):
            raise ValueError(f"spread: got {self.spread!r}, expected an angle from 0 to π")

    def start(self, setting: Setting) -> Values:
        """Where the body is."""
        values = {"turn": setting.tensor(_NO_TURN[self.rotation]), "shift": setting.tensor(np.zeros(3))}
        return values | ({"log_scale": setting.tensor(0.0)} if self.scale else {})

    def scattered(self, values: Values, number: int, generator: torch.Generator) -> Values:
        """The pose, turned."""
        from scipy.spatial.transform import Rotation

        known = number < len(_TURNS)
        axis = _TURNS[number] if known else torch.randn(3, generator=generator).numpy().astype(np.float64)
        turn = Rotation.from_rotvec(self.spread * axis / np.linalg.norm(axis))
        start = values["turn"].cpu().numpy()
        if self.rotation == "axis-angle":
            turned = (turn * Rotation.from_rotvec(start)).as_rotvec()
        elif self.rotation == "quaternion":
            turned = (turn * Rotation.from_quat(start)).as_quat()
        else:
            turned = turn.apply(start.reshape(2, 3)).ravel()
        copies = super().scattered(values, number, generator)
        return copies | {"turn": torch.tensor(turned, dtype=torch.float32, device=values["turn"].device)}

    def _posed(self, values: Values, setting: Setting) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Rotation, translation and scale of the body: it turns about its middle m, which moves by the shift."""
        body = setting.scene.bodies[self.number]
        at_start, middle = setting.tensor(body.rotation_matrix()), setting.tensor(setting.middle(self.number))
        rotation = rotation_matrices(values["turn"]) @ at_start
        scale = setting.tensor(body.scale) * (values["log_scale"].exp() if self.scale else 1)
        moved = body.scale * at_start @ middle + setting.tensor(body.translation)
        moved = moved + body.scale * setting.extent(self.number) * values["shift"]
        return rotation, moved - scale * rotation @ middle, scale

    def apply(self, values: Values, setting: Setting, world: World) -> None:
        """Move the body."""
        rotation, translation, scale = self._posed(values, setting)
        world.rotations[self.number] = rotation
        world.translations[self.number] = translation
        world.scales[self.number] = scale
        world.moving.add(self.number)

    def export(self, values: Values, setting: Setting, fitted: FittedScene) -> None:
        """Move the body."""
        from scipy.spatial.transform import Rotation

        rotation, translation, scale = (part.cpu().numpy() for part in self._posed(values, setting))
        vector = Rotation.from_matrix(rotation).as_rotvec(degrees=True)
        fitted.change_body(self.number, rotation=vector, translation=translation, scale=float(scale))

    def summary(self, fitted: FittedScene) -> Mapping[str, ArrayLike]:
        """The pose."""
        body = fitted.scene.bodies[self.number]
        names = ("rotation", "translation", "scale") if self.scale else ("rotation", "translation")
        return {f"{self.called(fitted)}.{name}": getattr(body, name) for name in names}
