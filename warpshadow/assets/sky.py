"""Skies: environment maps made of formulas."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from warpshadow import check
from warpshadow.assets.color import LUMINANCE
from warpshadow.assets.light import EnvironmentMap
from warpshadow.maths import sh


@check.keywords(
    **dict.fromkeys(("sun", "direction"), "sun_direction=(x, y, z), towards the sun"),
    strength="sun_strength",
    **dict.fromkeys(("radius", "sun_size"), "sun_radius, in degrees"),
)
def synthetic_sky(
    sun_direction: npt.ArrayLike = (0.5, 0.7, 0.2),
    *,
    sun_strength: float = 3.0,
    sun_radius: float = 1.5,
    ground_albedo: float = 0.2,
    height: int = 256,
) -> EnvironmentMap:
    """Make a clear daylight sky with a sun, over a diffuse ground.

    The unit is set by the sky without its sun: its irradiance on the ground is π in luminance; white ground looks 1.
    The sky is the CIE standard clear sky (ISO 15469, type 12), blue with a pale haze at the horizon; the sun
    reddens as it sinks. The ground is as bright as sky and sun make it, and fades into the haze.

    Args:
        sun_direction: Direction to the sun, of any length, shape [3]; below the horizon there is no sun.
        sun_strength: Irradiance of the sun on a surface that faces it, as a multiple of π.
        sun_radius: Angular radius [degrees], at least half a pixel (the real sun's is 0.27).
        ground_albedo: Reflectance of the ground.
        height: Rows of the map.
    """
    sun = check.array("sun_direction", sun_direction, (3,), "a direction (x, y, z)")
    if not np.any(sun):
        raise ValueError("sun_direction: got a zero vector, expected a direction")
    for name, value in (("sun_strength", sun_strength), ("sun_radius", sun_radius), ("ground_albedo", ground_albedo)):
        check.nonnegative(name, value)
    check.integer("height", height, unit="rows")
    sun = sun / np.linalg.norm(sun)
    pixel_directions, weights = sh.equirectangular_directions(height), sh.pixel_solid_angles(height)[:, None]
    edges = np.minimum(np.pi * np.arange(height + 1) / height, np.pi / 2)
    # ∫ max(cos θ, 0) dω over a pixel of each row
    horizontal_weights = np.pi / height * np.diff(np.sin(edges) ** 2 / 2)[:, None]
    heights = pixel_directions[..., 1]
    is_above = heights > 0
    sun_angle = np.arccos(np.clip(pixel_directions @ sun, -1, 1))

    sun_color = _sunlight(max(sun[1], 0.0))
    glow = 1 + 10 * (np.exp(-3 * sun_angle) - np.exp(-1.5 * np.pi)) + 0.45 * np.cos(sun_angle) ** 2
    gradation = 1 - np.exp(-0.32 / np.maximum(heights, 1e-3))
    haze = np.exp(-5 * np.maximum(heights, 0))[..., None]
    near_sun = np.exp(-3 * sun_angle)[..., None]
    color = (1 - haze) * _chroma([0.22, 0.45, 1.0]) + haze * _chroma([0.75, 0.88, 1.0])
    color = (1 - near_sun) * color + near_sun * sun_color
    sky = (is_above * glow * gradation)[..., None] * color
    sky *= np.pi / np.sum(sky @ LUMINANCE * horizontal_weights)

    pixel = np.pi / height
    radius = max(np.radians(sun_radius), pixel / 2)
    disc = np.clip((radius + pixel / 2 - sun_angle) / pixel, 0, 1)
    disc *= is_above * np.pi * sun_strength / np.sum(disc * weights)

    ground_irradiance = np.pi + np.sum(disc * horizontal_weights) * sun_color
    distance_haze = np.exp(np.minimum(20 * heights, 0))[..., None]
    horizon = sky[height // 2 - 1]
    ground = (1 - distance_haze) * (ground_albedo / np.pi * ground_irradiance) + distance_haze * horizon
    return EnvironmentMap(np.where(is_above[..., None], sky + disc[..., None] * sun_color, ground))


def _chroma(rgb: Sequence[float]) -> np.ndarray:
    """The color at luminance 1."""
    return np.array(rgb) / (LUMINANCE @ rgb)


def _sunlight(elevation_sine: float) -> np.ndarray:
    """Color of the sun through the air mass of Kasten and Young (1989), at luminance 1."""
    degrees = np.degrees(np.arcsin(elevation_sine))
    air_mass = 1 / (elevation_sine + 0.50572 * (degrees + 6.07995) ** -1.6364)
    return _chroma(np.exp(-np.array([0.07, 0.12, 0.25]) * air_mass))  # Rayleigh at 610, 550, 465 nm and thin haze
