"""The light that a fit found, and which directions of it the images determined.

Light from below a ground reaches no pixel, so a fit cannot determine it. The influence of a direction is the sum of the
changes that its light makes in all pixels,

    e(ω) = Σ_p w_p ∂I_p / ∂L(ω),

with the weights w of the targets' masks: a single adjoint gives it for all directions. It is about 0 where no light
comes from, since no pixel loses by light.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import torch

from warpshadow.assets.basis import CellBasis
from warpshadow.assets.color import auto_exposure
from warpshadow.assets.known_light import as_light
from warpshadow.assets.light import KnownLightArgument
from warpshadow.assets.picture import Picture
from warpshadow.inverse.free import Light
from warpshadow.inverse.free.base import Values
from warpshadow.inverse.model import Model
from warpshadow.inverse.problem import Problem
from warpshadow.inverse.verdict import small_stage
from warpshadow.inverse.world import FitContext
from warpshadow.maths.directions import fibonacci
from warpshadow.maths.sh import equirectangular_directions, pixel_solid_angles

MIN_INFLUENCE = 0.05
"""Influence below which a direction is not determined, as a fraction of the mean over all directions: noise in the
images disturbs it twenty times as much as on average.
"""

_CELLS = 512  # that directions are told apart by
_MAGNIFICATION, _STRIPE_WIDTH = 4, 6  # of its picture: pixels across one of the map; width of a stripe [pixels]


@dataclass(frozen=True, eq=False)
class FoundLight:
    """Light that a fit found; notebooks draw it, with stripes where the images did not determine it.

    Args:
        radiance: Linear RGB as an equirectangular map, shape [height, 2·height, 3]; below 0 where spherical harmonics
            are.
        influence: How much each direction matters to the images, 1 on the average over the sphere, [height, 2·height];
            of cells of some 9°, each of which few rays stand for, so it varies by a third between them.
    """

    radiance: np.ndarray = field(repr=False)
    influence: np.ndarray = field(repr=False)

    @property
    def determined(self) -> np.ndarray:
        """Whether the images determined a direction, bool of shape [height, 2·height]."""
        return self.influence >= MIN_INFLUENCE

    @property
    def undetermined_share(self) -> float:
        """Part of the sphere that the images did not determine."""
        return float(pixel_solid_angles(len(self.influence)) @ (~self.determined).sum(axis=1) / (4 * np.pi))

    def picture(self) -> Picture:
        """The light at the automatic exposure of its determined part; gray stripes over the rest."""
        positive_radiance = np.maximum(self.radiance, 0)
        displayed = positive_radiance[self.determined] if self.determined.any() else positive_radiance
        linear = np.clip(positive_radiance * 2 ** auto_exposure(displayed), 0, 1)
        enlarged, is_determined = (
            item.repeat(_MAGNIFICATION, 0).repeat(_MAGNIFICATION, 1) for item in (linear, self.determined)
        )
        rows, columns = np.indices(is_determined.shape)
        is_stripe = ~is_determined & ((rows + columns) // _STRIPE_WIDTH % 2 == 0)
        return Picture(np.where(is_stripe[..., None], 0.2, enlarged), exposure=0.0)

    def _repr_png_(self) -> bytes:
        return self.picture()._repr_png_()

    def __repr__(self) -> str:
        return f"FoundLight({self})"

    def __str__(self) -> str:
        return f"{self.undetermined_share:.0%} of the sphere was not determined by the images"


def found_light(
    light: KnownLightArgument, problem: Problem, context: FitContext, values: Mapping[str, Values]
) -> FoundLight:
    """The light of a fit, and which part of it the images determine."""
    radiance = as_light(light).radiance
    pixel_directions = equirectangular_directions(len(radiance))
    cells = CellBasis(fibonacci(_CELLS)).functions(pixel_directions.reshape(-1, 3))
    influence = cells @ influence_of_cells(problem, context, values)
    return FoundLight(radiance.astype(np.float32), influence.reshape(pixel_directions.shape[:2]).astype(np.float32))


def influence_of_cells(problem: Problem, context: FitContext, values: Mapping[str, Values]) -> np.ndarray:
    """Find the influence of each of 512 cells' light on the images, 1 on average, shape [cell]."""
    cells = Light(directions=_CELLS)
    free = [cells if isinstance(item, Light) else item for item in problem.free]
    by_cells = Problem(problem.scene, problem.targets, free, problem.loss, problem.still)
    model = Model(by_cells, context, small_stage(problem))
    logs = torch.zeros(_CELLS, 3, device=context.device, requires_grad=True)  # the derivative by them is that by light
    images = model.images({**values, cells.name: {"log_radiance": logs}})
    (model.weights[..., None] * images[..., :3]).sum().backward()
    assert logs.grad is not None
    influence = np.maximum(logs.grad.sum(dim=1).cpu().numpy().astype(np.float64), 0)
    return influence / (influence.mean() or 1.0)
