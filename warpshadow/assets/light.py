"""Distant light: equirectangular environment maps, what they project to, and maps made from a formula.

Pixel (row, col) of a map of H × 2H looks along θ = π(row+½)/H, φ = 2π(col+½)/W,

    d = (sin φ sin θ, cos θ, −cos φ sin θ),

in a right-handed world with y up (Mitsuba's convention): the center of the map is +z, the left quarter +x.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np

from warpshadow import check
from warpshadow.assets.image import ImageError, read_rgb, write_image
from warpshadow.maths import sh

LUMINANCE = np.array([0.2126, 0.7152, 0.0722])  # of linear sRGB, Rec. 709

# Degrees about +y that turn a map of the convention into ours, and so what its center shows.
CONVENTIONS = {"mitsuba": 0, "openexr": 0, "usd": 0, "blender": 90, "three.js": 90, "debevec": 180}


class CellLight(NamedTuple):
    """The light of cells of directions, and where in its cell it comes from.

    Args:
        radiance: Mean radiance, L_q = Q/4π ∫_cell L dω, so that Σ_q (4π/Q) L_q = ∫ L dω; float32 [direction, 3].
        directions: Mean directions, weighted with luminance; float32 [direction, 3].
        spreads: Half-angles of the evenly bright caps whose mean vectors are as long: 0 for a point, about 2/√Q for an
            even cell [radians]; float32 [direction].
    """

    radiance: np.ndarray
    directions: np.ndarray
    spreads: np.ndarray


@dataclass(frozen=True, eq=False)
class EnvironmentMap:
    """Light from infinitely far away, as an equirectangular map, validated; the array is a read-only copy.

    Args:
        radiance: Linear RGB, 0 to 1e18, float32, shape [height, 2·height, 3].

    Raises:
        ImageError: for another shape or aspect, or NaN, Inf, negative values or values beyond 1e18.
    """

    radiance: np.ndarray = field(repr=False)

    def __post_init__(self) -> None:
        """Copy, convert and validate the pixels."""
        expected = "an array [height, 2·height, 3]; EnvironmentMap.read(path) reads a file"
        radiance = check.pixels("radiance", self.radiance, expected=expected, error=ImageError)
        _check_aspect(radiance)
        bad = _bad_values(radiance)
        if bad.any():
            row, col, channel = np.argwhere(bad)[0]
            raise ImageError(
                f"radiance: got {bad.sum()} NaN, Inf or negative values or such beyond {check.LARGEST:g} (first at row "
                f"{row}, column {col}, channel {channel}: {radiance[row, col, channel]}), expected finite values of 0 "
                "or more; sanitize='zero' or 'neighbors' repairs them on reading"
            )
        radiance.setflags(write=False)
        object.__setattr__(self, "radiance", radiance)

    @classmethod
    def read(
        cls,
        path: str | Path,
        *,
        sanitize: str | None = None,
        part: str | int | None = None,
        convention: str = "mitsuba",
    ) -> EnvironmentMap:
        """Read a map; gray becomes RGB and alpha is dropped.

        Args:
            path: An .exr or .hdr file, or any other that :func:`warpshadow.read_image` reads.
            sanitize: What becomes of NaN, Inf, negative values and those beyond 1e18: None raises, "zero" makes them 0,
                "neighbors" the mean of the good values among the eight pixels around, spreading inward.
            part: Name or index of the part of a multi-part OpenEXR file.
            convention: Where the center of the file and its right quarter look, in a world with y up:
                "mitsuba", "openexr" and "usd" (DomeLight): +z, then -x;
                "blender" (exported with y up) and "three.js": +x, then +z;
                "debevec" (light probe gallery, HDRShop): -z, then +x.

        Raises:
            ImageError: for what is not a usable map; cube maps are named as such.
        """
        check.choice("sanitize", sanitize, [None, "zero", "neighbors"])
        check.choice("convention", convention, CONVENTIONS)
        pixels = read_rgb(path, part=part)
        try:
            _check_aspect(pixels)
            if sanitize:
                pixels = _sanitized(pixels, sanitize)
            return cls(pixels).rotated(CONVENTIONS[convention])
        except ImageError as error:
            raise ImageError(f"{path}: {error}") from error

    @classmethod
    def constant(cls, rgb: float | Sequence[float] = 1.0, height: int = 16) -> EnvironmentMap:
        """Make a map of the same radiance everywhere, one number or RGB."""
        check_height(height)
        return cls(np.broadcast_to(_color("rgb", rgb), (height, 2 * height, 3)))

    def write(self, path: str | Path) -> None:
        """Write an OpenEXR file of float32 RGB."""
        if Path(path).suffix.lower() != ".exr":
            raise ImageError(
                f"{path}: got extension {Path(path).suffix!r}, expected .exr, which holds radiance unclipped"
            )
        write_image(path, self.radiance)

    def rotated(self, degrees: float) -> EnvironmentMap:
        """Turn the light about +y, counter-clockwise seen from above: +90 takes what is at +z to +x.

        Whole pixels are exact; between them columns are interpolated linearly, which blurs a map of few columns. Either
        way the energy is kept.
        """
        if not check.is_number(degrees):
            raise ValueError(f"degrees: got {check.described(degrees)}, expected a finite angle about +y")
        width = self.radiance.shape[1]
        shift = -degrees / 360 * width % width
        if abs(shift - round(shift)) < 1e-6:  # 90 degrees computed from an angle are still whole pixels
            shift = round(shift)
        whole, fraction = divmod(shift, 1)
        rolled = np.roll(self.radiance, int(whole), axis=1)
        if fraction:
            rolled = (1 - fraction) * rolled + fraction * np.roll(rolled, 1, axis=1)
        return EnvironmentMap(rolled)

    def scaled(self, factor: float | Sequence[float]) -> EnvironmentMap:
        """Multiply the radiance by one factor, or by one for each of R, G, B."""
        return EnvironmentMap(self.radiance * _color("factor", factor))

    def directions(self) -> np.ndarray:
        """Unit vectors to the pixel centers, float32, shape [height, width, 3]."""
        return sh.equirectangular_directions(len(self.radiance)).astype(np.float32)

    def solid_angles(self) -> np.ndarray:
        """Solid angle of one pixel of each row [sr], exact, float64, shape [height]; all pixels sum to 4π."""
        return sh.pixel_solid_angles(len(self.radiance))

    def sh(self, order: int) -> np.ndarray:
        """Project onto spherical harmonics: the integral over what the pixels cover, however few they are.

        Args:
            order: Number of bands n.

        Returns:
            Coefficients, index l² + l + m, float32, shape [order², 3], not writable.
        """
        if order not in self._kept_sh:
            self._kept_sh[order] = sh.project_map(self.radiance, order).astype(np.float32)
            self._kept_sh[order].setflags(write=False)
        return self._kept_sh[order]

    @functools.cached_property
    def _kept_sh(self) -> dict[int, np.ndarray]:
        return {}

    def cells(self, directions: np.ndarray) -> CellLight:
        """Gather the light of the cells around directions: every pixel belongs to the nearest one.

        The cells are taken to be of one size, 4π/Q, as those of Fibonacci directions nearly are; pixels that are not
        much smaller than a cell are split. A dark cell gets its own direction and the spread of a cap of 4π/Q.

        Args:
            directions: Unit vectors, shape [direction, 3].

        Returns:
            The cells; the arrays are not writable.
        """
        key = np.asarray(directions, np.float64).tobytes()
        if key not in self._kept_cells:
            self._kept_cells[key] = self._gathered(directions)
            for array in self._kept_cells[key]:
                array.setflags(write=False)
        return self._kept_cells[key]

    @functools.cached_property
    def _kept_cells(self) -> dict[bytes, CellLight]:
        return {}

    def _gathered(self, directions: np.ndarray) -> CellLight:
        energy, moment = self._cell_integrals(directions)
        power, length = energy @ LUMINANCE, np.linalg.norm(moment, axis=1)
        lit = length > 0
        mean = np.where(lit[:, None], moment / np.where(lit, length, 1)[:, None], directions)
        concentration = np.where(lit, length / np.where(lit, power, 1), 1 - 1 / len(energy))
        spreads = np.arccos(np.clip(2 * concentration - 1, -1, 1))
        radiance = energy * (len(energy) / (4 * np.pi))
        return CellLight(radiance.astype(np.float32), mean.astype(np.float32), spreads.astype(np.float32))

    def _cell_integrals(self, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Over every cell, ∫ L dω [direction, RGB] and ∫ luminance d dω [direction, 3], float64."""
        directions = np.asarray(directions, dtype=np.float64)
        check.shape("directions", directions.shape, ("direction", 3))
        if not len(directions) or not np.allclose(np.linalg.norm(directions, axis=1), 1, atol=1e-3):
            raise ValueError("directions: expected at least one, all unit vectors")
        count, height = len(directions), len(self.radiance)
        split = int(np.ceil(4 * np.pi * np.sqrt(count) / height))  # an eighth of a cell's angular radius 2/√Q
        owners = _cells_of_pixels(height * split, directions.astype(np.float32).tobytes())
        weights = sh.pixel_solid_angles(height * split)
        integrals = np.zeros((6, count))
        for row, towards in enumerate(sh.equirectangular_directions(height * split)):
            power = weights[row] * np.repeat(self.radiance[row // split], split, axis=0).astype(np.float64)
            values = np.concatenate([power, (power @ LUMINANCE)[:, None] * towards], axis=1)
            for integral, value in zip(integrals, values.T, strict=True):
                integral += np.bincount(owners[row], value, minlength=count)
        return integrals[:3].T, integrals[3:].T

    def statistics(self) -> dict[str, object]:
        """Measure the radiance (mean over the sphere), its integral and its peak, in plain numbers."""
        height, width, _ = self.radiance.shape
        weights = np.repeat(self.solid_angles(), width)
        pixels = self.radiance.reshape(-1, 3).astype(np.float64)
        luminance = pixels @ LUMINANCE
        integral = weights @ pixels
        order = np.argsort(-luminance, kind="stable")
        power = np.cumsum((luminance * weights)[order])
        brightest = np.interp(0.01 * 4 * np.pi, np.cumsum(weights[order]), power)
        return {
            "width": width,
            "height": height,
            "min_radiance": pixels.min(axis=0).tolist(),
            "max_radiance": pixels.max(axis=0).tolist(),
            "mean_radiance": (integral / (4 * np.pi)).tolist(),
            "integral": integral.tolist(),
            "brightest_direction": self.directions().reshape(-1, 3)[order[0]].tolist(),
            "brightest_percent_share": float(brightest / power[-1]) if power[-1] > 0 else 0.0,
        }


@functools.lru_cache(maxsize=4)
def _cells_of_pixels(height: int, directions: bytes) -> np.ndarray:
    """Number of the direction, of float32 vectors, that is nearest to each pixel, int32 of shape [height, 2·height]."""
    columns = np.frombuffer(directions, np.float32).reshape(-1, 3).T
    towards = sh.equirectangular_directions(height)
    return np.stack([np.argmax(row.astype(np.float32) @ columns, axis=1).astype(np.int32) for row in towards])


def _check_aspect(pixels: np.ndarray) -> None:
    if pixels.ndim != 3 or pixels.shape[2] != 3 or pixels.size == 0:
        remedy = check.channels_last(pixels.shape)
        raise ImageError(
            f"radiance: got shape {pixels.shape}, expected [height, 2·height, 3]{remedy and f': {remedy}'}"
        )
    height, width, _ = pixels.shape
    if width != 2 * height:
        faces_or_crosses = [(6, 1), (1, 6), (4, 3), (3, 4)]
        is_cube = any(width * down == height * across for across, down in faces_or_crosses)
        cube = ", which looks like a cube map" if is_cube else ""
        raise ImageError(
            f"radiance: got {width} x {height} pixels{cube}, expected an equirectangular map, twice as wide as high"
        )


def _color(name: str, values: float | Sequence[float]) -> np.ndarray:
    """One number, or one for each of R, G, B; not negative."""
    expected = "one number, or one for each of R, G, B"
    color = check.numbers(name, values, expected=expected, error=ImageError)
    if color.shape not in ((), (3,)):
        raise ImageError(f"{name}: got shape {color.shape}, expected {expected}")
    if (color < 0).any():
        raise ImageError(f"{name}: got {check.described(values)}, expected nothing negative")
    return color


def check_height(height: int) -> None:
    """Raise ValueError for what is no number of rows."""
    if not check.is_integer(height) or height < 1:
        raise ValueError(f"height: got {check.described(height)}, expected a positive whole number of rows")


def _bad_values(radiance: np.ndarray) -> np.ndarray:
    return ~((radiance >= 0) & (radiance <= check.LARGEST))


def _sanitized(radiance: np.ndarray, how: str) -> np.ndarray:
    """Replace what no map may hold."""
    bad = _bad_values(radiance)
    values = np.where(bad, 0, radiance)
    if how == "zero" or not bad.any():
        return values
    if bad.all(axis=(0, 1)).any():
        raise ImageError("radiance: a channel has no good value, so sanitize='neighbors' has nothing to go by")
    good = (~bad).astype(np.float32)
    while (good == 0).any():
        total, count = _around(values * good), _around(good)
        fill = (good == 0) & (count > 0)
        values = np.where(fill, total / np.maximum(count, 1), values)
        good = np.maximum(good, fill)
    return values


def _around(image: np.ndarray) -> np.ndarray:
    """Sum over each pixel and the eight around it; columns wrap around, rows end at the poles."""
    across = image + np.roll(image, 1, axis=1) + np.roll(image, -1, axis=1)
    padded = np.pad(across, ((1, 1), (0, 0), (0, 0)))
    return padded[:-2] + padded[1:-1] + padded[2:]
