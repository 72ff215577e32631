"""Known light of any kind: maps, and spherical harmonics with the members of a map that the package asks for."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from warpshadow.assets.cells import CellLight
from warpshadow.assets.light import EnvironmentMap, KnownLightArgument
from warpshadow.maths import sh

_ROWS = 64  # of maps of harmonics: the last of eight bands loses 0.5% to the size of a pixel


@dataclass(frozen=True, eq=False)
class HarmonicLight:
    """Light as coefficients in spherical harmonics, which answers as an :class:`EnvironmentMap` does.

    Two of the same coefficients are equal.
    """

    coefficients: np.ndarray  # linear RGB of any order, [order², 3]; it holds a copy

    def __post_init__(self) -> None:
        sh.order_of("light", self.coefficients)
        copied = np.array(self.coefficients)
        copied.setflags(write=False)
        object.__setattr__(self, "coefficients", copied)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, HarmonicLight) and np.array_equal(self.coefficients, other.coefficients)

    def __hash__(self) -> int:
        return hash(self.coefficients.tobytes())

    def __repr__(self) -> str:
        return f"{len(self.coefficients)} SH coefficients"

    @functools.cached_property
    def radiance(self) -> np.ndarray:
        """The light as a map [height, 2·height, 3], negative where it rings."""
        return sh.reconstruct_map(self.coefficients, _ROWS)

    @property
    def shell(self) -> None:
        """None: it comes from infinitely far away."""
        return None

    @property
    def as_map(self) -> EnvironmentMap | None:
        """None: it has no pixels."""
        return None

    @property
    def as_argument(self) -> np.ndarray:
        """The light as scenes and renderers take it: its coefficients."""
        return self.coefficients

    def coarsened(self, row_count: int) -> HarmonicLight:
        """The light itself, which is as smooth as a map of few rows."""
        return self

    def radiance_from(self, directions: np.ndarray) -> np.ndarray:
        """Radiance from directions [..., 3], 0 where it rings below that, float64 of shape [..., 3]."""
        harmonics = sh.evaluate(sh.order_of("light", self.coefficients), directions.reshape(-1, 3))
        radiance: np.ndarray = np.maximum(harmonics @ self.coefficients, 0).reshape(directions.shape)
        return radiance

    def rotated(self, degrees: float) -> HarmonicLight:
        """Turn the light about +y, as :meth:`EnvironmentMap.rotated` does."""
        from scipy.spatial.transform import Rotation

        about_y = Rotation.from_rotvec([0, degrees, 0], degrees=True).as_matrix()
        return HarmonicLight(sh.harmonic_rotation(sh.order_of("light", self.coefficients), about_y) @ self.coefficients)

    def scaled(self, factor: float) -> HarmonicLight:
        """Multiply the radiance by a factor."""
        return HarmonicLight(factor * self.coefficients)

    def bands(self, order: int) -> int:
        """Number of bands, of some, in which there may be light."""
        return min(order, sh.order_of("light", self.coefficients))

    def sh(self, order: int) -> np.ndarray:
        """The coefficients of an order: the first bands, or zeros after the last; float32 [order², 3]."""
        coefficients = np.zeros((order**2, 3), np.float32)
        count = min(len(coefficients), len(self.coefficients))
        coefficients[:count] = self.coefficients[:count]
        return coefficients

    def cells(self, directions: np.ndarray) -> CellLight:
        """The radiance in the middle of cells: no part of a cell is much brighter than the rest."""
        functions = sh.evaluate(sh.order_of("light", self.coefficients), directions)
        return CellLight((functions @ self.coefficients).astype(np.float32), directions, None, None)


KnownLight: TypeAlias = EnvironmentMap | HarmonicLight
"""Known light with its methods, of whichever kind it is: all kinds have the members of :class:`HarmonicLight`."""


def as_light(light: KnownLightArgument) -> KnownLight:
    """The light of a user with its methods: a map as it is, SH coefficients [order², 3] as :class:`HarmonicLight`."""
    return HarmonicLight(light) if isinstance(light, np.ndarray) else light
