"""Known light in spherical harmonics, and known light of any kind by one function."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np

from warpshadow.assets.cells import CellLight
from warpshadow.assets.light import EnvironmentMap
from warpshadow.maths import sh

_ROWS = 64  # of maps of harmonics: the last of eight bands loses 0.5% to the size of a pixel


@dataclass(frozen=True, eq=False)
class HarmonicLight:
    """Light as coefficients in spherical harmonics, which answers as an :class:`EnvironmentMap` does.

    Args:
        coefficients: Linear RGB of any order, [order², 3].
    """

    coefficients: np.ndarray

    def __post_init__(self) -> None:
        sh.order_of("light", self.coefficients)

    @functools.cached_property
    def radiance(self) -> np.ndarray:
        """The light as a map [height, 2·height, 3], negative where it rings."""
        return sh.reconstruct_map(self.coefficients, _ROWS)

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


def as_light(light: EnvironmentMap | np.ndarray) -> EnvironmentMap | HarmonicLight:
    """Known light with its methods: a map as it is, and SH coefficients [order², 3] as :class:`HarmonicLight`.

    A kind of known light has ``radiance``, ``bands``, ``sh`` and ``cells``; methods of visibility ask for no more.
    """
    return HarmonicLight(light) if isinstance(light, np.ndarray) else light
