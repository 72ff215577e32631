"""Free parameters of each view: its exposure, the offset of its outlines, and its camera."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import ArrayLike

from warpshadow import check
from warpshadow.assets.camera import Camera
from warpshadow.inverse.free.base import PRIOR, Free, Values
from warpshadow.inverse.world import FitContext, FittedScene, World, format_numbers
from warpshadow.scene.scene import Scene
from warpshadow.torch import rotation_matrices


@check.frozen()
@dataclass(frozen=True)
class Exposure(Free):
    """The exposure of each view, a factor of its colors; known light then keeps its unit.

    Args:
        white_balance: Whether the gains of red and blue are free, too; that of green is 1.
        reference: Number of a view whose exposure and gains stay 1, from 0: beside free light, which is then in its
            unit. None for none.
    """

    key = "exposure"

    white_balance: bool = False
    reference: int | None = None

    def __post_init__(self) -> None:
        check.flag("white_balance", self.white_balance)
        if self.reference is not None:
            check.integer("reference", self.reference, minimum=0)

    @property
    def scales(self) -> str:
        return "exposure" if self.reference is None else ""

    def check_scene(self, scene: Scene, view_count: int) -> None:
        if self.reference is not None:
            check.index("reference", self.reference, view_count, "view")

    def start(self, context: FitContext) -> Values:
        views = len(context.cameras)
        values = {"log": context.tensor(np.zeros(views))}
        return values | ({"log_white": context.tensor(np.zeros((views, 2)))} if self.white_balance else {})

    def _gains(self, values: Values) -> torch.Tensor:
        """Gains of red, green and blue, [view, 3]; or of all, [view, 1]."""
        if not self.white_balance:
            return torch.ones_like(values["log"])[:, None]
        red, blue = self._factors(values["log_white"]).unbind(dim=1)
        return torch.stack([red, torch.ones_like(red), blue], dim=1)

    def _factors(self, logarithms: torch.Tensor) -> torch.Tensor:
        """Factors of views, [view, …]; 1 of the reference."""
        is_free = torch.ones_like(logarithms)
        if self.reference is not None:
            is_free[self.reference] = 0
        return (is_free * logarithms).exp()

    def apply(self, values: Values, context: FitContext, world: World) -> None:
        world.exposures = self._factors(values["log"])[:, None] * self._gains(values)

    def export(self, values: Values, context: FitContext, fitted: FittedScene) -> None:
        fitted.exposures = self._factors(values["log"]).tolist()
        if self.white_balance:
            fitted.white_balances = [tuple(gains) for gains in self._gains(values).tolist()]

    def summary(self, fitted: FittedScene) -> Mapping[str, ArrayLike]:
        figures: dict[str, ArrayLike] = {"exposure": fitted.exposures}
        return figures | ({"white_balance": fitted.white_balances} if self.white_balance else {})

    def report(self, context: FitContext, fitted: FittedScene) -> list[tuple[str, str]]:
        return [("exposure", f"{format_numbers(np.log2(fitted.exposures))} stops")]


@check.frozen()
@dataclass(frozen=True)
class OutlineOffset(Free):
    """Distance by which painted outlines of each view lie inside the true ones: no mask is right to the pixel.

    Args:
        deviation: Standard deviation of its prior [pixels].
    """

    key = "outline_offset"
    shows_in_outlines = True
    has_prior = True

    deviation: float = 1.0

    def __post_init__(self) -> None:
        check.positive("deviation", self.deviation)

    def start(self, context: FitContext) -> Values:
        return {"offset": context.tensor(np.zeros(len(context.cameras)))}

    def apply(self, values: Values, context: FitContext, world: World) -> None:
        """Move the outlines; values are in standard deviations."""
        world.outline_offsets = values["offset"] * self.deviation

    def regularizer(self, values: Values, context: FitContext) -> torch.Tensor:
        return PRIOR * values["offset"].square().sum()

    def export(self, values: Values, context: FitContext, fitted: FittedScene) -> None:
        fitted.outline_offsets = (values["offset"] * self.deviation).tolist()

    def summary(self, fitted: FittedScene) -> Mapping[str, ArrayLike]:
        return {"outline_offset": fitted.outline_offsets}


@check.frozen()
@dataclass(frozen=True)
class CameraPose(Free):
    """Camera pose of each view: eye, rotation and, if free, focal length.

    Args:
        focal: Whether the focal length is free, too.
    """

    key = "camera"
    moves = True

    focal: bool = False

    def __post_init__(self) -> None:
        check.flag("focal", self.focal)

    def start(self, context: FitContext) -> Values:
        views = len(context.cameras)
        values = {"turn": context.tensor(np.zeros((views, 3))), "shift": context.tensor(np.zeros((views, 3)))}
        return values | ({"log_focal": context.tensor(np.zeros(views))} if self.focal else {})

    def _posed(
        self, values: Values, context: FitContext, cameras: tuple[Camera, ...]
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """R, t and K of the views; shifts of the eye are in units of its distance from the scene."""
        rotations = rotation_matrices(values["turn"]) @ context.tensor([camera.rotation for camera in cameras])
        eyes = context.tensor([camera.eye for camera in cameras])
        moved_eyes = eyes + context.tensor(context.distances) * values["shift"]
        intrinsics = context.tensor([camera.intrinsics for camera in cameras])
        if self.focal:
            zoom = torch.ones_like(intrinsics)
            zoom[:, :2, :2] = values["log_focal"].exp()[:, None, None]
            intrinsics = intrinsics * zoom
        return rotations, -(rotations @ moved_eyes[..., None])[..., 0], intrinsics

    def apply(self, values: Values, context: FitContext, world: World) -> None:
        rotations, translations, intrinsics = self._posed(values, context, world.cameras)
        world.clip_matrices = world.renderer.clip_matrices(rotations, translations, intrinsics)

    def export(self, values: Values, context: FitContext, fitted: FittedScene) -> None:
        rotations, translations, intrinsics = (
            part.cpu().numpy().astype(np.float64) for part in self._posed(values, context, context.cameras)
        )
        fitted.cameras = [
            replace(camera, rotation=rotations[view], translation=translations[view], intrinsics=intrinsics[view])
            for view, camera in enumerate(fitted.cameras)
        ]
        fitted.scene = replace(fitted.scene, camera=fitted.cameras[0])

    def summary(self, fitted: FittedScene) -> Mapping[str, ArrayLike]:
        """World to camera of each view, and its focal length [pixels]."""
        summary = {
            "camera.rotation": [camera.rotation for camera in fitted.cameras],
            "camera.translation": [camera.translation for camera in fitted.cameras],
        }
        focal = {"camera.focal": [camera.intrinsics[0, 0] for camera in fitted.cameras]} if self.focal else {}
        return summary | focal
