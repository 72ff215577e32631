"""Base classes: a free parameter, and a free parameter of one body, with all that other files ask of one."""

from __future__ import annotations

import abc
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from numpy.typing import ArrayLike

from warpshadow import check
from warpshadow.assets.basis import Basis
from warpshadow.inverse.world import FitContext, FittedScene, World
from warpshadow.scene.scene import BodyLike, Scene

Values = dict[str, torch.Tensor]

PRIOR = 1e-3
"""Loss of a prior that is missed by one standard deviation: about 3% of the targets' root mean square in each pixel."""


class Free(abc.ABC):
    """A free parameter of a scene. Fits ask it for most that they have to know; few files ask for a class."""

    key: ClassVar[str]
    """Its name in fit files."""

    moves: ClassVar[bool] = False
    """Whether geometry or cameras change with it."""

    moves_last: ClassVar[bool] = False
    """Whether it moves bodies that others have placed, and so comes after them."""

    excludes: ClassVar[Mapping[str, str]] = {}
    """Keys of parameters, of the same body, that cannot be free beside it, and why."""

    has_prior: ClassVar[bool] = False
    """Whether its regularizer is a prior, which counts as a measurement in uncertainties."""

    relocation_count: ClassVar[int] = 0
    """Number of places from which a search for it starts, see :meth:`relocated`."""

    @property
    def shows_in_outlines(self) -> bool:
        """Whether outlines change with it, so that stages that compare these alone descend to it."""
        return self.moves

    @property
    def is_light(self) -> bool:
        """Whether images are linear in it, so that variable projection solves for it."""
        return False

    @property
    def basis(self) -> Basis | None:
        """Basis of the light that images have by it; None where it leaves them the scene's."""
        return None

    @property
    def min_directions(self) -> int:
        """Cells of directional visibility that it needs."""
        return 0

    @property
    def scales(self) -> str:
        """Factor of images that it may be: "light", "reflectance", "exposure" or "", none of these."""
        return ""

    @property
    def name(self) -> str:
        """Its name in values and messages."""
        return self.key

    def numbered(self, scene: Scene) -> Free:
        """Replace the name of its body by the number; ValueError where a scene has no such body."""
        return self

    def check_scene(self, scene: Scene, view_count: int) -> None:
        """Raise ValueError if the scene's value cannot be free; the message names the argument."""
        return

    def beside(self, others: Sequence[Free]) -> Free:
        """Adapt the parameter to all free ones, itself among them; ValueError where it cannot be free beside them."""
        return self

    @abc.abstractmethod
    def start(self, context: FitContext) -> Values:
        """Values where the scene has them."""

    @abc.abstractmethod
    def apply(self, values: Values, context: FitContext, world: World) -> None:
        """Put values into the world. Differentiable: values."""

    def scattered(self, values: Values, number: int, generator: torch.Generator) -> Values:
        """Draw values around others, for a descent that starts at several places; equal ones where one start will do.

        Args:
            values: The first place.
            number: Of the other place, from 0.
            generator: Of random numbers.
        """
        return {key: tensor.detach().clone() for key, tensor in values.items()}

    def relocated(self, values: Values, context: FitContext, number: int) -> Values:
        """Values in another of the places from which a search starts; equal ones where there are none."""
        return {key: tensor.detach().clone() for key, tensor in values.items()}

    @abc.abstractmethod
    def export(self, values: Values, context: FitContext, fitted: FittedScene) -> None:
        """Write final values into the fitted scene."""

    def summary(self, fitted: FittedScene) -> Mapping[str, ArrayLike]:
        """The fitted numbers by their keys in scene files, if they are few."""
        return {}

    def report(self, context: FitContext, fitted: FittedScene) -> list[tuple[str, str]]:
        """Lines of a report, name and value, beside the lines of changed fields of bodies."""
        return []

    def regularizer(self, values: Values, context: FitContext) -> torch.Tensor | None:
        """Regularizer, to be added to the loss; None for none. Differentiable: values."""
        return None

    def project(self, values: Values) -> None:
        """Move values in place to the nearest that are possible, after each step."""
        return


@dataclass(frozen=True)
class FreeOfBody(Free):
    """A free parameter of a body.

    Args:
        body: The body, its number or name.
    """

    reframes: ClassVar[bool] = False
    """Whether a camera that is framed on the bodies would stand elsewhere by it."""

    reshapes: ClassVar[bool] = False
    """Whether the spheres of its body change by it, even if it blocks light as a plane."""

    body: BodyLike

    def __post_init__(self) -> None:
        if not isinstance(self.body, str) and (not check.is_integer(self.body) or self.body < 0):
            got = check.described(self.body)
            raise ValueError(f"body: got {got}, expected the number of a body, from 0, or its name")

    @property
    def number(self) -> int:
        """The body, from 0; a problem puts numbers in place of names."""
        assert isinstance(self.body, int)
        return self.body

    @property
    def name(self) -> str:
        """Its name in values and messages."""
        return f"{self.key}[{self.body}]"

    @property
    def paints_shadows(self) -> bool:
        """Whether the surface may keep a shadow that was never there."""
        return False

    @property
    def body_figures(self) -> tuple[str, ...]:
        """Fields of its body that are a few numbers and change with it."""
        return ()

    def summary(self, fitted: FittedScene) -> Mapping[str, ArrayLike]:
        body = fitted.scene.bodies[self.number]
        return {f"{self.called(fitted)}.{name}": getattr(body, name) for name in self.body_figures}

    def called(self, fitted: FittedScene) -> str:
        """The name of its body, or its number if the name is not unique."""
        return fitted.scene.unique_names[self.number]

    def numbered(self, scene: Scene) -> FreeOfBody:
        return replace(self, body=scene.body_number(self.body))
