"""Light around a scene: equirectangular environment maps, and their projections.

Pixel (row, col) of a map of H × 2H looks along θ = π(row+½)/H, φ = 2π(col+½)/W,

    d = (sin φ sin θ, cos θ, −cos φ sin θ),

in a right-handed world with y up (Mitsuba's convention): the center of the map is +z, the left quarter +x.
"""

from __future__ import annotations

import functools
import hashlib
import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from warpshadow import check
from warpshadow.assets.cells import CellLight, gather_cells
from warpshadow.assets.color import LUMINANCE
from warpshadow.assets.image import INTEGER_SUFFIXES, ImageError, read_rgb, write_image
from warpshadow.assets.picture import Picture
from warpshadow.check import AnyPath
from warpshadow.maths import sh

# Degrees about +y that turn a map of the convention into ours, and so the direction that its center shows.
CONVENTIONS = {"mitsuba": 0, "openexr": 0, "usd": 0, "blender": 90, "three.js": 90, "debevec": 180}

LIGHT = (
    "an EnvironmentMap (EnvironmentMap.read(path), EnvironmentMap(pixels) of [height, 2·height, 3], "
    "EnvironmentMap.constant(1.0)), or SH coefficients [order², 3], such as 9 rows"
)
"""The types of known light that functions accept, for messages."""

_ORIGIN = np.zeros(3)

_MAX_SUN_ROWS = 4096  # of a map that gets a sun
_DRAWN_ROWS = 256  # of a map in a notebook, and less than twice as many


def _warn_of_white(path: Path, pixels: np.ndarray) -> None:
    """Warn of a file of integers whose brightest pixels are as bright as it can tell."""
    white_count = int((pixels >= 1).any(axis=2).sum()) if path.suffix.lower() in INTEGER_SUFFIXES else 0
    if white_count:
        check.warn(
            f"{path}: {white_count} of its pixels have a channel at 1.0, the most that a {path.suffix} file holds: "
            "brighter light, such as a sun's, is cut off; an .exr or .hdr file holds it"
        )


def check_coefficients(name: str, values: np.ndarray) -> None:
    """Raise ValueError unless an array is one of SH coefficients, finite and of shape [order², 3]."""
    if values.ndim != 2 or values.shape[1] != 3 or math.isqrt(len(values)) ** 2 != len(values) or not len(values):
        raise ValueError(f"{name}: got shape {values.shape}, expected {LIGHT}")
    check.finite(name, values)


@check.frozen()
@dataclass(frozen=True, eq=False, init=False)
class EnvironmentMap(metaclass=check.Hinting):
    """Light from all around, as an equirectangular map, validated; arrays are read-only copies.

    It comes from infinitely far away; or with a radius from a sphere around the scene, the *shell*, such as the walls
    of a room: then bodies at different places see it in different directions, and more of the parts that are near.

    The world is right-handed with y up. Pixel (row, col) of H × 2H covers a rectangle around the direction
    (sin φ sin θ, cos θ, −cos φ sin θ) of its center, θ = π(row+½)/H, φ = π(col+½)/H: the top row looks up along +y, the
    center of the map along +z, the middle of its left half along +x (Mitsuba's convention; :meth:`read` takes others).

    Args:
        radiance: Linear RGB, 0 to 1e18, float32, shape [height, 2·height, 3]; with a radius, as its center sees it.
        radius: Of the shell [scene units], within which all bodies must be; None for infinitely far away.
        center: Of the shell [scene units], float64 of shape [3].
    Raises:
        ImageError: for another shape or aspect, or NaN, Inf, negative values or values beyond 1e18.
    """

    radiance: np.ndarray = field(repr=False)
    radius: float | None = None
    center: np.ndarray = field(default_factory=lambda: _ORIGIN)

    def __init__(self, radiance: npt.ArrayLike, *, radius: float | None = None, center: npt.ArrayLike = _ORIGIN):
        expected = "an array [height, 2·height, 3]; EnvironmentMap.read(path) reads a file"
        pixels = check.pixels("radiance", radiance, expected=expected, error=ImageError)
        _check_aspect(pixels)
        bad_values = _bad_values(pixels)
        if bad_values.any():
            row, col, channel = np.argwhere(bad_values)[0]
            raise ImageError(
                f"radiance: got {bad_values.sum()} NaN, Inf or negative values or such beyond "
                f"{check.LARGEST:g} (first at row {row}, column {col}, channel {channel}: "
                f"{pixels[row, col, channel]}), expected finite values of 0 or more; sanitize='zero' "
                "or 'neighbors' repairs them on reading"
            )
        pixels.setflags(write=False)
        middle = check.array("center", center, (3,), "a point (x, y, z)")
        if radius is None and middle.any():
            raise ValueError(f"center: got {middle.tolist()} without a radius, expected both")
        distance = None if radius is None else check.positive("radius", radius)
        vars(self).update(radiance=pixels, radius=distance, center=middle)

    def __repr__(self) -> str:
        height, width, _ = self.radiance.shape
        shell = "" if self.radius is None else f", radius {self.radius:g} around {self.center.tolist()}"
        return f"EnvironmentMap({width} × {height}{shell})"

    @classmethod
    def read(
        cls,
        path: AnyPath,
        *,
        sanitize: str | None = None,
        part: str | int | None = None,
        convention: str = "mitsuba",
        radius: float | None = None,
        center: npt.ArrayLike = _ORIGIN,
    ) -> EnvironmentMap:
        """Read a map; gray becomes RGB and alpha is dropped.

        Args:
            path: An .exr or .hdr file, or any other that :func:`warpshadow.read_image` reads: of a .png, .jpg or .tif
                that is white somewhere, where a sun would be cut off, a warning says so.
            sanitize: How to treat NaN, Inf, negative values and values beyond 1e18: None raises, "zero" makes them 0,
                "neighbors" takes the mean of the good values among the eight pixels around, spreading inward.
            part: Name or index of the part of a multi-part OpenEXR file.
            convention: Where the center of the file and its right quarter look, in a world with y up:
                "mitsuba", "openexr" and "usd" (DomeLight): +z, then -x;
                "blender" (exported with y up) and "three.js": +x, then +z;
                "debevec" (light probe gallery, HDRShop): -z, then +x.
            radius, center: Of its shell, as for the class.
        Raises:
            ImageError: for a file that is not a usable map; cube maps are named as such.
        """
        check.choice("sanitize", sanitize, [None, "zero", "neighbors"])
        check.choice("convention", convention, CONVENTIONS)
        pixels = read_rgb(path, part=part)
        try:
            _check_aspect(pixels)
            _warn_of_white(Path(path), pixels)
            if sanitize:
                pixels = _sanitized(pixels, sanitize)
            return cls(pixels, radius=radius, center=center).rotated(CONVENTIONS[convention])
        except ImageError as error:
            raise ImageError(f"{path}: {error}") from error

    @classmethod
    def constant(
        cls, rgb: npt.ArrayLike = 1.0, height: int = 16, *, radius: float | None = None, center: npt.ArrayLike = _ORIGIN
    ) -> EnvironmentMap:
        """Make a map of the same radiance everywhere, one number or RGB; radius and center as for the class."""
        check.integer("height", height, unit="rows")
        return cls(np.broadcast_to(_color("rgb", rgb), (height, 2 * height, 3)), radius=radius, center=center)

    def write(self, path: AnyPath) -> None:
        """Write an OpenEXR file of float32 RGB; scene files, not it, have a radius."""
        if Path(path).suffix.lower() != ".exr":
            raise ImageError(
                f"{path}: got extension {Path(path).suffix!r}, expected .exr, which holds radiance unclipped"
            )
        write_image(path, self.radiance)

    @property
    def content_hash(self) -> str:
        """SHA-256 of the radiance, and of the shell if there is one, in hexadecimal."""
        shell = b"" if self.shell is None else self.shell.tobytes()
        return hashlib.sha256(f"{self.radiance.shape}".encode() + self.radiance.tobytes() + shell).hexdigest()

    @property
    def shell(self) -> np.ndarray | None:
        """Center and radius of the shell [scene units], float32 of shape [4]; None for light infinitely far away."""
        return None if self.radius is None else np.array([*self.center, self.radius], np.float32)

    @property
    def as_map(self) -> EnvironmentMap:
        """The map itself: only light that is one has pixels, to which suns are added."""
        return self

    @property
    def as_argument(self) -> EnvironmentMap:
        """The light as scenes and renderers take it: the map itself."""
        return self

    def coarsened(self, row_count: int) -> EnvironmentMap:
        """Reduce the map to that many rows; each pixel is the mean of the pixels that it covers, by solid angle.

        One of fewer rows, or not of a multiple of them, stays as it is.
        """
        step = len(self.radiance) // row_count
        if step < 2 or len(self.radiance) % step:
            return self
        rows, columns, _ = self.radiance.shape
        weights = self.solid_angles().reshape(-1, step, 1, 1, 1)
        blocks = self.radiance.reshape(rows // step, step, columns // step, step, 3)
        return replace(self, radiance=(weights * blocks).sum(axis=(1, 3)) / (step * weights.sum(axis=(1, 3))))

    def rotated(self, degrees: float) -> EnvironmentMap:
        """Turn the light about +y, around its center, counter-clockwise from above: +90 takes light from +z to +x.

        Whole pixels are exact; between them columns are interpolated linearly, which blurs a map of few columns. Either
        way the energy is kept.
        """
        if not check.is_number(degrees):
            raise ValueError(f"degrees: got {check.described(degrees)}, expected a finite angle about +y")
        width = self.radiance.shape[1]
        shift = -degrees / 360 * width % width
        if abs(shift - round(shift)) < 1e-6:  # 90 degrees computed from an angle are still whole pixels
            shift = round(shift)
        whole_columns, fraction = divmod(shift, 1)
        rolled_radiance = np.roll(self.radiance, int(whole_columns), axis=1)
        if fraction:
            rolled_radiance = (1 - fraction) * rolled_radiance + fraction * np.roll(rolled_radiance, 1, axis=1)
        return replace(self, radiance=rolled_radiance)

    def scaled(self, factor: npt.ArrayLike) -> EnvironmentMap:
        """Multiply the radiance by one factor, or by one for each of R, G, B."""
        return replace(self, radiance=self.radiance * _color("factor", factor))

    @check.keywords(**dict.fromkeys(("radius", "sun_radius", "size"), "angular_radius, in degrees"), color="irradiance")
    def with_sun(
        self, direction: npt.ArrayLike, irradiance: npt.ArrayLike, *, angular_radius: float = 0.27
    ) -> EnvironmentMap:
        """Add a sun: an even disc infinitely far away, whose shadows have edges as soft as it is wide.

        Args:
            direction: Towards the sun, of any length, shape [3].
            irradiance: Of a surface that faces it [the map's radiance · sr], one number or RGB; white there looks
                irradiance / π.
            angular_radius: Of the disc [degrees], up to 90; the real sun's is the default. The pixels of the result are
                no wider than that: those of a coarser map are divided, which changes none of its light.
        Raises:
            ValueError: for a disc so small that the map would have more than 4096 rows, and for a map with a radius.
        """
        if self.radius is not None:
            raise ValueError(f"radius: got {self.radius:g}, expected a map infinitely far away, as a sun is")
        axis = check.array("direction", direction, (3,), "a direction (x, y, z)")
        if not axis.any():
            raise ValueError("direction: got a zero vector, expected a direction")
        if check.positive("angular_radius", angular_radius) > 90:
            raise ValueError(f"angular_radius: got {angular_radius:g}, expected degrees up to 90")
        radius, rows = np.radians(angular_radius), len(self.radiance)
        division = max(1, math.ceil(np.pi / rows / radius))
        if division > 1 and rows * division > _MAX_SUN_ROWS:
            raise ValueError(
                f"angular_radius: got {angular_radius:g}, expected {180 / (_MAX_SUN_ROWS // rows * rows):.2g} or more, "
                f"for which this map gets {_MAX_SUN_ROWS} rows"
            )
        pixels = self.radiance.repeat(division, axis=0).repeat(division, axis=1)
        height = rows * division
        pixel = np.pi / height
        cosines = sh.equirectangular_directions(height) @ (axis / np.linalg.norm(axis))
        disc = np.clip((radius + pixel / 2 - np.arccos(np.clip(cosines, -1, 1))) / pixel, 0, 1)
        disc /= np.sum(disc * np.maximum(cosines, 0) * sh.pixel_solid_angles(height)[:, None])
        return replace(self, radiance=pixels + disc[..., None] * _color("irradiance", irradiance))

    def _repr_png_(self) -> bytes:
        """The map as notebooks draw it: at most some 512 columns, at its automatic exposure."""
        height, width, _ = self.radiance.shape
        step = max(1, height // _DRAWN_ROWS)
        cropped_radiance = self.radiance[: height // step * step, : width // step * step].astype(np.float64)
        blocks = cropped_radiance.reshape(height // step, step, width // step, step, 3)
        return Picture(blocks.mean(axis=(1, 3)))._repr_png_()

    def radiance_from(self, directions: np.ndarray) -> np.ndarray:
        """Radiance from directions, interpolated between pixels.

        Args:
            directions: Unit vectors from the center, shape [..., 3].
        Returns:
            Linear RGB, float64 of shape [..., 3].
        """
        height, width, _ = self.radiance.shape
        x, y, z = np.moveaxis(np.asarray(directions, np.float64), -1, 0)
        row = np.arccos(np.clip(y, -1, 1)) / np.pi * height - 0.5
        column = np.arctan2(x, -z) / (2 * np.pi) * width - 0.5
        up, left = np.floor(row).astype(int), np.floor(column).astype(int)
        radiance = np.zeros((*row.shape, 3))
        for down, right in np.ndindex(2, 2):
            weight = np.abs(1 - down - (row - up)) * np.abs(1 - right - (column - left))
            rows, columns = np.clip(up + down, 0, height - 1), (left + right) % width
            radiance += weight[..., None] * self.radiance[rows, columns]
        return radiance

    def directions(self) -> np.ndarray:
        """Unit vectors to the pixel centers, float32, shape [height, width, 3]."""
        return sh.equirectangular_directions(len(self.radiance)).astype(np.float32)

    def solid_angles(self) -> np.ndarray:
        """Solid angle of one pixel of each row [sr], exact, float64, shape [height]; all pixels sum to 4π."""
        return sh.pixel_solid_angles(len(self.radiance))

    def bands(self, order: int) -> int:
        """Number of bands of spherical harmonics, of some, in which there may be light: all."""
        return order

    def sh(self, order: int) -> np.ndarray:
        """Project onto spherical harmonics: the integral over the solid angles of the pixels, however few they are.

        Args:
            order: Number of bands n.
        Returns:
            Coefficients, index l² + l + m, float32, shape [order², 3], not writable.
        """
        if order not in self._cached_sh:
            self._cached_sh[order] = sh.project_map(self.radiance, order).astype(np.float32)
            self._cached_sh[order].setflags(write=False)
        return self._cached_sh[order]

    @functools.cached_property
    def _cached_sh(self) -> dict[int, np.ndarray]:
        return {}

    def cells(self, directions: np.ndarray) -> CellLight:
        """Gather the light of the cells around directions: every pixel belongs to the nearest one.

        Args:
            directions: Unit vectors, shape [direction, 3].
        Returns:
            The cells; the arrays are not writable.
        """
        key = np.asarray(directions, np.float64).tobytes()
        if key not in self._cached_cells:
            self._cached_cells[key] = gather_cells(self.radiance, directions)
            for array in self._cached_cells[key]:
                array.setflags(write=False)  # type: ignore[union-attr]
        return self._cached_cells[key]

    @functools.cached_property
    def _cached_cells(self) -> dict[bytes, CellLight]:
        return {}

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


def _check_aspect(pixels: np.ndarray) -> None:
    if pixels.ndim != 3 or pixels.shape[2] != 3 or pixels.size == 0:
        remedy = check.channels_last(pixels.shape)
        raise ImageError(
            f"radiance: got shape {pixels.shape}, expected [height, 2·height, 3]{remedy and f': {remedy}'}"
        )
    height, width, _ = pixels.shape
    if width != 2 * height:
        cube_maps = {6: "looks like a cube map", 4 / 3: "looks like a cube map or a photograph"}
        kind = cube_maps.get(max(width, height) / min(width, height), "")
        raise ImageError(
            f"radiance: got {width} x {height} pixels{kind and f', which {kind}'}, expected an equirectangular map, "
            "360° wide and 180° high, so twice as wide as high"
        )


def _color(name: str, values: npt.ArrayLike) -> np.ndarray:
    """One number, or one for each of R, G, B; not negative."""
    expected = "one number, or one for each of R, G, B"
    color = check.numbers(name, values, expected=expected, error=ImageError)
    if color.shape not in ((), (3,)):
        raise ImageError(f"{name}: got shape {color.shape}, expected {expected}")
    if not ((color >= 0) & (color <= check.LARGEST)).all():
        raise ImageError(f"{name}: got {check.described(values)}, expected numbers from 0 to {check.LARGEST:g}")
    return color


def _bad_values(radiance: np.ndarray) -> np.ndarray:
    return ~((radiance >= 0) & (radiance <= check.LARGEST))


def _sanitized(radiance: np.ndarray, replacement: str) -> np.ndarray:
    """Replace values that no map may hold."""
    bad_values = _bad_values(radiance)
    values = np.where(bad_values, 0, radiance)
    if replacement == "zero" or not bad_values.any():
        return values
    if bad_values.all(axis=(0, 1)).any():
        raise ImageError("radiance: a channel has no good value, so sanitize='neighbors' has nothing to go by")
    is_good = (~bad_values).astype(np.float32)
    while (is_good == 0).any():
        total, count = _sums_around(values * is_good), _sums_around(is_good)
        fill = (is_good == 0) & (count > 0)
        values = np.where(fill, total / np.maximum(count, 1), values)
        is_good = np.maximum(is_good, fill)
    return values


def _sums_around(image: np.ndarray) -> np.ndarray:
    """Sum over each pixel and the eight around it; columns wrap around, rows end at the poles."""
    row_sums = image + np.roll(image, 1, axis=1) + np.roll(image, -1, axis=1)
    padded_sums = np.pad(row_sums, ((1, 1), (0, 0), (0, 0)))
    return padded_sums[:-2] + padded_sums[1:-1] + padded_sums[2:]


KnownLightArgument: TypeAlias = EnvironmentMap | np.ndarray
"""A known light as scenes and renderers take it: a map, or SH coefficients [order², 3]."""

KNOWN_LIGHTS = (EnvironmentMap,)  # its classes; arrays are SH coefficients
