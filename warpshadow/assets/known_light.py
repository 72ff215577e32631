"""Known light of any kind: all that the package asks of one, and a user's light as one by one function."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from warpshadow.assets.cells import CellLight
from warpshadow.assets.harmonic_light import HarmonicLight
from warpshadow.assets.light import KnownLightArgument


class KnownLight(Protocol):
    """Known light of any kind: all that the package asks of one, but for maps in files. Kinds compare by value."""

    @property
    def radiance(self) -> np.ndarray:
        """The light as a map, linear RGB, [height, 2·height, 3]."""

    @property
    def shell(self) -> np.ndarray | None:
        """Center and radius of the sphere that sends it, float32 of shape [4]; None for light infinitely far away."""

    @property
    def as_argument(self) -> KnownLightArgument:
        """The light as scenes and renderers take it."""

    def radiance_from(self, directions: np.ndarray) -> np.ndarray:
        """Radiance from directions [..., 3], shape [..., 3]."""

    def rotated(self, degrees: float) -> KnownLight:
        """Turn the light about +y."""

    def scaled(self, factor: float) -> KnownLight:
        """Multiply the radiance by a factor."""

    def coarsened(self, row_count: int) -> KnownLight:
        """The light with as much detail as a map of some rows has."""

    def bands(self, order: int) -> int:
        """Number of SH bands, of some, in which there may be light."""

    def sh(self, order: int) -> np.ndarray:
        """SH coefficients of an order, float32 of shape [order², 3]."""

    def cells(self, directions: np.ndarray) -> CellLight:
        """The light in cells around directions [cell, 3]."""


def as_light(light: KnownLightArgument) -> KnownLight:
    """The light of a user with its methods: a map as it is, SH coefficients [order², 3] as :class:`HarmonicLight`."""
    return HarmonicLight(light) if isinstance(light, np.ndarray) else light
