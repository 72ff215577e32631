"""A free sun: where it is, how strong, and how large."""

import functools
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import ArrayLike

from warpshadow import check
from warpshadow.assets.basis import CellBasis
from warpshadow.assets.light import EnvironmentMap
from warpshadow.inverse import constraints
from warpshadow.inverse.free.base import Free, Values
from warpshadow.inverse.world import FitContext, FittedScene, World, format_numbers
from warpshadow.maths.directions import check_count, fibonacci
from warpshadow.scene.scene import Scene

_REACH = 4.0  # turn [radians], and logarithm of strength, for a value of 1: as of a lamp
_LARGEST = 30.0  # angular radius [degrees]: one of twelve suns that started 20° to 30° off became as wide as a sky
_WEIGHT_WIDTH = 0.4  # standard deviation of the weights of a point's cells, in distances between cells
_NEWTON_STEPS = 12
_UNRESOLVED = 1.2  # times the resolution, up to which a fitted size is none


@check.frozen(
    **dict.fromkeys(("intensity", "strength", "radiance", "color"), "irradiance"),
    **dict.fromkeys(("radius", "size"), "angular_radius, in degrees"),
)
@dataclass(frozen=True)
class Sun(Free):
    """A sun beside the scene's map: its direction, irradiance and angular radius, which a fit starts from.

    While a fit runs its light is spread over cells around its direction d, with local maximum-entropy weights
    [Arroyo and Ortiz 2006],

        w_q ∝ exp((d·d_q − 1) / σ² + λ·d_q),  Σ w_q d_q ∥ d,

    which are smooth in d, and light that comes from d on average. So images have a gradient to the direction. No sun is
    smaller meanwhile than :attr:`resolution`, and a fit tells the size of larger ones alone. The scene that it finds
    has the sun as :meth:`.EnvironmentMap.with_sun` adds it.

    Args:
        direction: Towards the sun, of any length, shape [3].
        irradiance: Of a surface that faces it, one number or RGB, positive.
        angular_radius: Of the disc [degrees]; kept, up to the resolution, where the fitted one is below 1.2 times that.
        directions: Number of cells.
    """

    key = "sun"
    excludes = {"light": "free light has any sun in it"}

    direction: ArrayLike
    irradiance: ArrayLike
    angular_radius: float = 0.27
    directions: int = 512

    def __post_init__(self) -> None:
        check_count("directions", self.directions)
        EnvironmentMap.constant(0.0).with_sun(self.direction, self.irradiance, angular_radius=self.angular_radius)
        strength = np.asarray(self.irradiance, np.float64)
        if not (strength > 0).all():
            got = strength.tolist()
            raise ValueError(f"irradiance: got {got}, expected positive numbers, as its logarithm is fitted")
        strength = np.broadcast_to(strength, 3)
        direction = np.asarray(self.direction, np.float64)
        # tuples, which compare and print
        vars(self).update(direction=tuple(direction.tolist()), irradiance=tuple(strength.tolist()))

    def check_scene(self, scene: Scene, view_count: int) -> None:
        light = scene.known_light.as_map
        if light is None:
            raise ValueError(
                "sun: got it for light in spherical harmonics, expected a map, to which it is added: "
                "HarmonicBasis(order).to_map(coefficients)"
            )
        light.with_sun(self.direction, self.irradiance, angular_radius=self.angular_radius)

    @functools.cached_property
    def basis(self) -> CellBasis:
        """The cells."""
        return CellBasis(fibonacci(self.directions))

    @property
    def min_directions(self) -> int:
        """As many as it has: fewer would move it, by 3° of 128."""
        return self.directions

    @property
    def _spacing(self) -> float:
        """Distance between cells [radians]."""
        return float(np.sqrt(4 * np.pi / self.directions))

    @property
    def resolution(self) -> float:
        """Angular radius [degrees] of the disc that spreads as a point's cells do: 8.8° of 512 cells."""
        return float(np.degrees(2 * self._spacing * np.sqrt(_WEIGHT_WIDTH**2 + 1 / (4 * np.pi))))

    def start(self, context: FitContext) -> Values:
        """The given sun, or one of one and a half times the resolution if that is larger."""
        return {
            "turn": context.tensor(np.zeros(2)),
            "log_irradiance": context.tensor(np.zeros(3)),
            "log_radius": context.tensor(0.0),
        }

    @property
    def _first_radius(self) -> float:
        return max(self.angular_radius, 1.5 * self.resolution)

    def project(self, values: Values) -> None:
        """Keep its radius between the resolution and 30°, or the given one if that is larger."""
        largest = max(_LARGEST, self._first_radius)
        values["log_radius"].clamp_(*(float(np.log(size / self._first_radius)) for size in (self.resolution, largest)))

    def _sun(self, values: Values, context: FitContext) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Direction [3], irradiance [3], and angular radius [radians], at least the resolution.

        Differentiable: values.
        """
        start_direction = np.array(self.direction) / np.linalg.norm(self.direction)
        turn = _REACH * values["turn"].double()
        direction = constraints.turned_direction(start_direction, turn)
        strength = torch.tensor(self.irradiance).to(turn) * (_REACH * values["log_irradiance"].double()).exp()
        radius = np.radians(self._first_radius) * values["log_radius"].double().exp()
        return direction / direction.norm(), strength, radius

    def coefficients(self, values: Values, context: FitContext) -> torch.Tensor:
        """Its light in cells, linear RGB, [cell, 3]. Differentiable: values."""
        direction, strength, radius = self._sun(values, context)
        cells = torch.tensor(self.basis.directions).to(direction)
        variance = radius**2 / 4 - self._spacing**2 / (4 * np.pi)  # of the weights: cells are wide themselves
        weights = _weights(direction, variance, cells)
        unit_irradiance = weights @ (cells @ direction).clamp_min(0)
        light = self.directions / (4 * np.pi) * (weights / unit_irradiance)[:, None] * strength
        return light.to(values["turn"])

    def apply(self, values: Values, context: FitContext, world: World) -> None:
        of_map = context.cached(
            (self.name, "map"), lambda: context.tensor(self.basis.coefficients(context.scene.light))
        )
        world.light = of_map + self.coefficients(values, context)

    def export(self, values: Values, context: FitContext, fitted: FittedScene) -> None:
        direction, strength, radius = (part.cpu().numpy() for part in self._sun(values, context))
        degrees = float(np.degrees(radius))
        if degrees < _UNRESOLVED * self.resolution:
            degrees = min(self.angular_radius, self.resolution)
        before = fitted.scene.known_light.as_map
        assert before is not None
        light = before.with_sun(direction, strength, angular_radius=degrees)
        fitted.scene = replace(fitted.scene, light=light)
        fitted.sun = {"direction": direction, "irradiance": strength, "angular_radius": degrees}

    def summary(self, fitted: FittedScene) -> Mapping[str, ArrayLike]:
        return {f"sun.{name}": value for name, value in fitted.sun.items()}

    def report(self, context: FitContext, fitted: FittedScene) -> list[tuple[str, str]]:
        units = {"angular_radius": "°"}
        return [
            (f"sun {name}", f"({format_numbers(value)}){units.get(name, '')}") for name, value in fitted.sun.items()
        ]


def _weights(direction: torch.Tensor, variance: torch.Tensor, cells: torch.Tensor) -> torch.Tensor:
    """Weights of cells [cell] of a given variance, whose mean is along a direction.

    Newton's method finds λ without a record; one more step from there has its derivatives.

    Differentiable: direction, variance.
    """
    helper = torch.eye(3).to(direction)[int(direction.detach().abs().argmin())]
    first = torch.linalg.cross(helper, direction)
    first = first / first.norm()
    sideways = cells @ torch.stack([first, torch.linalg.cross(direction, first)], dim=1)  # [cell, 2]
    logits = (cells @ direction - 1) / variance

    def weighted(tilt: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        weights = torch.softmax(logits + sideways @ tilt, dim=0)
        mean = weights @ sideways
        return weights, mean, (sideways * weights[:, None]).T @ sideways - torch.outer(mean, mean)

    with torch.no_grad():
        tilt = torch.zeros(2).to(direction)
        for _ in range(_NEWTON_STEPS):
            _, mean, covariance = weighted(tilt)
            tilt = tilt - torch.linalg.solve(covariance, mean)
        covariance = weighted(tilt)[2]
    tilt = tilt - torch.linalg.solve(covariance, weighted(tilt)[1])
    return weighted(tilt)[0]
