"""Free light."""

import functools
from dataclasses import dataclass, replace

import numpy as np
import torch

from warpshadow import check
from warpshadow.assets.basis import Basis, CellBasis, HarmonicBasis
from warpshadow.assets.light import EnvironmentMap
from warpshadow.inverse.free.base import Free, Values
from warpshadow.inverse.world import FitContext, FittedScene, World
from warpshadow.maths.directions import check_count, fibonacci
from warpshadow.maths.sh import check_order
from warpshadow.scene.scene import Scene

# light of cells starts no lower [radiance of the targets]: a logarithm has to come back from there
_MIN_RADIANCE = 1e-3
_ORDER = 5  # of spherical harmonics, by default


@check.frozen()
@dataclass(frozen=True)
class Light(Free):
    """The light, in spherical harmonics or as a map of cells.

    Args:
        order: Number of SH bands; by default 5 without ``directions``.
        directions: In place of ``order`` the number of cells, whose radiance is the exponential of a value and so never
            negative: sharper light, and a longer way to it.
        nonnegativity: Weight of the mean square of negative radiance in spherical harmonics [targets' radiance].
            Without it light that images do not determine takes any value.
        smoothness: Weight of the mean square of differences between neighboring cells [targets' radiance].
    """

    key = "light"
    is_light = True
    scales = "light"

    order: int | None = None
    directions: int | None = None
    nonnegativity: float = 0.01
    smoothness: float = 1e-4

    def __post_init__(self) -> None:
        if self.order is not None and self.directions is not None:
            raise ValueError(
                f"order, directions: got {self.order!r} and {self.directions!r}, expected one of them, such as "
                "Light(5) or Light(directions=512)"
            )
        if self.directions is not None:
            check_count("directions", self.directions)
        elif self.order is None:
            object.__setattr__(self, "order", _ORDER)
        else:
            check_order(self.order)
        for name in ("nonnegativity", "smoothness"):
            check.nonnegative(name, getattr(self, name))

    def check_scene(self, scene: Scene, view_count: int) -> None:
        if scene.shell is not None and self.order is not None:
            raise ValueError(
                f"order: got {self.order} for light that has a radius, expected cells: Light(directions=512)"
            )

    @functools.cached_property
    def basis(self) -> Basis:
        """The basis of the light."""
        return CellBasis(fibonacci(self.directions)) if self.order is None else HarmonicBasis(self.order)

    def start(self, context: FitContext) -> Values:
        radiance = self.basis.coefficients(context.scene.light) / context.unit
        if isinstance(self.basis, CellBasis):
            return {"log_radiance": context.tensor(np.log(np.maximum(radiance, _MIN_RADIANCE)))}
        return {"coefficients": context.tensor(radiance / np.sqrt(4 * np.pi))}

    def coefficients(self, values: Values, context: FitContext) -> torch.Tensor:
        """Light in the basis, linear RGB, [coefficient, 3]. Differentiable: values."""
        if isinstance(self.basis, CellBasis):
            return values["log_radiance"].exp() * context.unit
        return values["coefficients"] * (context.unit * np.sqrt(4 * np.pi))

    def apply(self, values: Values, context: FitContext, world: World) -> None:
        world.light = self.coefficients(values, context)

    def regularizer(self, values: Values, context: FitContext) -> torch.Tensor | None:
        """Penalize negative radiance, and differences between neighboring cells."""
        if isinstance(self.basis, CellBasis):
            first, second = neighboring_cells(self.basis.size)
            radiance = values["log_radiance"].exp()
            return self.smoothness * (radiance[first] - radiance[second]).square().mean() if self.smoothness else None
        if not self.nonnegativity:
            return None
        basis_values = np.sqrt(4 * np.pi) * self.basis.functions(fibonacci(512))
        radiance = context.tensor(basis_values) @ values["coefficients"]
        return self.nonnegativity * torch.relu(-radiance).square().mean()

    def export(self, values: Values, context: FitContext, fitted: FittedScene) -> None:
        """Spherical harmonics stay; cells become a map, of the radius that the scene's light has."""
        coefficients = self.coefficients(values, context).cpu().numpy()
        light: np.ndarray | EnvironmentMap = coefficients
        if isinstance(self.basis, CellBasis):
            light, before = self.basis.to_map(coefficients), fitted.scene.known_light.as_map
            if before is not None:
                light = replace(before, radiance=light.radiance)
        fitted.scene = replace(fitted.scene, light=light)


@functools.cache
def neighboring_cells(count: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Pairs of cells that lie side by side: each and the six nearest to it."""
    from scipy.spatial import cKDTree

    directions = fibonacci(count)
    _, nearest = cKDTree(directions).query(directions, k=7)
    pairs = np.stack([np.repeat(np.arange(count), 6), nearest[:, 1:].ravel()])
    pairs = np.unique(np.sort(pairs, axis=0), axis=1)
    return torch.from_numpy(pairs[0]), torch.from_numpy(pairs[1])
