"""Variable projection: a light that is solved for at each geometry, not descended to [Golub and Pereyra 1973].

For known geometry and reflectance images are linear in the light, I = A L: that of the map, and that of lamps whose
emission is free and one color. The light of other emitters is subtracted. The loss at the best light,

    f(θ) = min_{L ≥ 0} loss(A(θ) L, I),

has the gradient of the loss at that light held fixed, since the loss does not change with it there. So a pose descends
through lights that explain as much as they can, and a light found at a wrong pose cannot confirm it.

The light is a sum of cells that are never negative: pixels of a map; or, for spherical harmonics, their projections, so
that it is the projection of a light that is nowhere negative. Least squares with that bound are solved by their normal
equations; other losses by reweighting them.
"""

from collections.abc import Mapping

import numpy as np
import torch

from warpshadow.assets.basis import CellBasis
from warpshadow.inverse.free import Emission, Light
from warpshadow.inverse.free.base import Values
from warpshadow.inverse.free.light import neighboring_cells
from warpshadow.inverse.model import LightModel, Model
from warpshadow.inverse.problem import Problem
from warpshadow.inverse.schedule import Stage
from warpshadow.inverse.world import FitContext, World
from warpshadow.maths.directions import fibonacci

_REWEIGHTINGS = 6  # of losses that are not squares
_RIDGE = 1e-6  # least eigenvalue of a form, as a share of the mean of its diagonal
_MIN_RADIANCE = 1e-6  # radiance of a cell whose logarithm is stored, where the solution is 0 [radiance of the targets]
_LIGHTS_AT_ONCE = 32
_ATOMS = 192  # cells of which light in spherical harmonics is made


class ProjectedModel(Model):
    """A model whose light is solved for before each loss, in place, so that no optimizer holds it."""

    def __init__(self, problem: Problem, context: FitContext, stage: Stage):
        super().__init__(problem, context, stage)
        assert problem.light is not None
        self.light = problem.light
        self.atoms = atoms(self.light)
        self.lamps = [emission for emission in problem.free_of(Emission) if emission.is_light]
        self.lamp_units = np.ones(len(self.lamps))  # emission that lights an image as much as an atom does
        self.solution = np.zeros((len(self.atoms) + len(self.lamps), 3))  # radiance of atoms and lamps, found last

    def loss(self, values: Mapping[str, Values]) -> tuple[torch.Tensor, torch.Tensor | None]:
        """The loss at the best light, and the images. Differentiable: values, but for the light's, which it sets."""
        with torch.no_grad():
            self.solve(values)
        return super().loss(values)

    def emitted(self, values: Mapping[str, Values]) -> torch.Tensor | float:
        """Images by emitters that are not solved for, [view, height, width, 3]; 0 where no body emits."""
        lamp_numbers = {lamp.number for lamp in self.lamps}
        if not any(body.is_emitter and n not in lamp_numbers for n, body in enumerate(self.context.scene.bodies)):
            return 0.0
        return self._images_by_lights(self.world(values), self._darkness)[0]

    @property
    def _darkness(self) -> torch.Tensor:
        return torch.zeros(1, self.light.basis.size, 3, device=self.context.device)

    def _images_by_lights(self, world: World, lights: torch.Tensor, lit_lamp: Emission | None = None) -> torch.Tensor:
        """Images by lights [light, coefficient, 3] and one of the solved lamps: [light, view, height, width, 3]."""
        for lamp in self.lamps:
            radiance = torch.full((1, 3), float(lamp is lit_lamp), device=self.context.device)
            lamp.apply({"radiance": radiance}, self.context, world)
        images = []
        for part in lights if len(self.cameras) > 1 else lights.split(_LIGHTS_AT_ONCE):
            world.light = part
            images.append(world.images().reshape(-1, *self.targets.shape[:3], 4)[..., :3])
        return torch.cat(images)

    def design(self, values: Mapping[str, Values], emitted: torch.Tensor | float = 0.0) -> torch.Tensor:
        """Images by single atoms and single lamps, less images by other emitters: [atom, view, height, width, 3]."""
        world = self.world(values)
        coefficients = torch.eye(self.light.basis.size, device=self.context.device)[..., None].expand(-1, -1, 3)
        images = self._images_by_lights(world, coefficients.contiguous()) - emitted
        images = torch.tensordot(torch.from_numpy(self.atoms).to(images), images, dims=1)
        if not self.lamps:
            return images
        lamps = torch.cat([self._images_by_lights(world, self._darkness, lamp) for lamp in self.lamps]) - emitted
        units = images.flatten(1).norm(dim=1).mean() / lamps.flatten(1).norm(dim=1).clamp_min(1e-12)
        self.lamp_units = units.cpu().numpy()
        return torch.cat([images, lamps * units[:, None, None, None, None]])

    def solve(self, values: Mapping[str, Values]) -> None:
        """Set light and lamps to their values of the least loss, for the other values."""
        emitted = self.emitted(values)
        design = self.design(values, emitted).permute(4, 0, 1, 2, 3).flatten(2)  # [color, atom, pixel]
        target = ((self.targets[..., :3] - emitted) / self.context.unit).permute(3, 0, 1, 2).flatten(1)
        pixel_shares = self.problem.loss.pixel_shares(self.weights).flatten()
        prior = self.prior()
        weights, radiance = pixel_shares.expand_as(target), np.zeros((3, design.shape[1]))
        for _ in range(1 if self.problem.loss.kind == "l2" and self.saturated is None else _REWEIGHTINGS):
            for color in range(3):
                weighted_design = design[color] * weights[color]
                form = (weighted_design @ design[color].T).double().cpu().numpy() + prior
                slope = (weighted_design @ target[color]).double().cpu().numpy()
                radiance[color] = nonnegative_least_squares(form, slope)
            images = torch.einsum("cap,ca->cp", design, torch.from_numpy(radiance).to(design))
            weights = pixel_shares * self._find_weights(images, target)
        self.solution = radiance.T
        self._store(self.solution[: len(self.atoms)], values[self.light.name])
        for lamp, unit, emission in zip(self.lamps, self.lamp_units, self.solution[len(self.atoms) :], strict=True):
            values[lamp.name]["radiance"].copy_(self.context.tensor(unit * self.context.unit * emission))

    def _find_weights(self, images: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
        """Weights of squares that stand for the loss at images, [color, pixel]; 0 where saturation allows them."""
        weights = self.problem.loss.pixel_weights((images - target).T).T
        if self.saturated is None:
            return weights
        saturated = self.saturated.permute(3, 0, 1, 2).flatten(1)
        return torch.where(saturated & (images > target), 0.0, weights)

    def prior(self) -> np.ndarray:
        """Quadratic form of the smoothness of cells, as :meth:`Light.regularizer` has it, [atom, atom]."""
        count = len(self.atoms)
        form = np.zeros((len(self.solution),) * 2)
        if isinstance(self.light.basis, CellBasis) and self.light.smoothness:
            first, second = (part.numpy() for part in neighboring_cells(count))
            weight = self.regularization * self.light.smoothness / (3 * len(first))
            np.add.at(form, (first, first), weight)
            np.add.at(form, (second, second), weight)
            np.add.at(form, (first, second), -weight)
            np.add.at(form, (second, first), -weight)
        return form

    def _store(self, radiance: np.ndarray, values: Values) -> None:
        """Write radiance of atoms, [atom, 3], into the light's values."""
        if isinstance(self.light.basis, CellBasis):
            stored_values = {"log_radiance": np.log(np.maximum(radiance, _MIN_RADIANCE))}
        else:
            stored_values = {"coefficients": self.atoms.T @ radiance / np.sqrt(4 * np.pi)}
        for key, numbers in stored_values.items():
            values[key].copy_(self.context.tensor(numbers))


def atoms(light: Light) -> np.ndarray:
    """Lights whose nonnegative sums are searched, in coefficients, float64 [atom, coefficient]."""
    if isinstance(light.basis, CellBasis):
        return np.eye(light.basis.size)
    return light.basis.functions(fibonacci(_ATOMS)).astype(np.float64) * (4 * np.pi / _ATOMS)


def nonnegative_least_squares(form: np.ndarray, slope: np.ndarray) -> np.ndarray:
    """The x ≥ 0 of the least xᵀ F x − 2 sᵀ x [Lawson and Hanson 1974, on a square root of F].

    The form F is symmetric and positive semidefinite, [n, n]; directions in which it is about 0 get a ridge.
    """
    from scipy.optimize import nnls

    scale = np.trace(form) / len(form)
    if scale <= 0:
        return np.zeros(len(form))
    # by torch, which a fit keeps on one thread: NumPy's threads wait for each other 50 times as long as they work
    values, vectors = (part.numpy() for part in torch.linalg.eigh(torch.from_numpy(form / scale)))
    roots = np.sqrt(np.maximum(values, _RIDGE))
    solution, _ = nnls(roots[:, None] * vectors.T, vectors.T @ slope / (scale * roots))
    return solution


def make_model(problem: Problem, context: FitContext, stage: Stage) -> Model:
    """The cheapest model that a problem and a stage allow."""
    if stage.solves_light:
        return ProjectedModel(problem, context, stage)
    return (LightModel if LightModel.applies(problem) else Model)(problem, context, stage)
