"""Suns of an equirectangular map: its small bright discs.

Gloss and remarks use them. Other parts of the package search for bright light by criteria of their own:

| where | bright light | reason |
| --- | --- | --- |
| :func:`.light_samples.cut_map` | pixels above 30 times the mean | windows, too, take too many directions |
| :func:`.sun_cells.find_sun_cells` | cells with 5% of all light | any such cell is worth its rays |
| :func:`.sharp_cells.find_sharp_cells` | cells whose light is smaller than they are | its shadows have sharper edges |
"""

from typing import NamedTuple

import numpy as np

from warpshadow.maths import sh

_MAX_SUNS = 8
_BRIGHTNESS = 10.0  # radiance above which a pixel may be of a sun, in means of the map
_MIN_SHARE = 0.003  # minimum share of all light
_RADII = np.radians([6.0, 3.0, 1.5])  # of discs to try around the brightest spot, the widest first
_MAX_SPREAD = 2.0  # largest solid angle by the variance over the bright one: 1 for discs, more for tubes and pairs
_ISOLATION = 0.9  # minimum share of the disc in the bright light within twice its radius: wider spots have less
_RIM = 1.25  # outer radius, in radii of the disc, of the ring in which no pixel may be half as bright as the brightest
_MAX_AREA = 1.2  # largest solid angle over that of the disc: a pixel of a coarse map has more
_MAX_TRIALS = 32  # number of bright spots to try


class Suns(NamedTuple):
    """Suns of a map, float64."""

    directions: np.ndarray  # unit vectors to their centers, [sun, 3]
    irradiance: np.ndarray  # on a surface that faces them, linear RGB, [sun, 3]
    solid_angles: np.ndarray  # Ω [sr], [sun]


class SeparatedLight(NamedTuple):
    """Suns, and the rest of a map."""

    suns: Suns
    without_suns: np.ndarray  # the map, their pixels clamped to ten times its mean radiance


def separate_suns(radiance: np.ndarray) -> SeparatedLight:
    """Separate up to 8 suns from a map: discs of up to 6° in radius that are much brighter than its mean.

    Args:
        radiance: Linear RGB, shape [height, 2·height, 3].
    """
    solid_angles = np.repeat(sh.pixel_solid_angles(len(radiance)), 2 * len(radiance))
    brightness = radiance.mean(axis=2, dtype=np.float64).ravel()
    total = brightness @ solid_angles
    limit = _BRIGHTNESS * max(total, 0.0) / (4 * np.pi)
    pixels = np.flatnonzero(brightness > limit)
    directions = sh.equirectangular_directions(len(radiance)).reshape(-1, 3)[pixels]
    sun_shares = 1 - limit / brightness[pixels]
    light = radiance.reshape(-1, 3)[pixels] * (sun_shares * solid_angles[pixels])[:, None]
    power = light.mean(axis=1)
    is_candidate, is_sun = np.ones(len(pixels), bool), np.zeros(len(pixels), bool)
    suns: list[tuple[np.ndarray, np.ndarray, float]] = []
    for _ in range(_MAX_TRIALS):
        if not is_candidate.any() or len(suns) == _MAX_SUNS:
            break
        brightest = np.argmax(np.where(is_candidate, brightness[pixels], -1))
        from_brightest, is_in_disc = directions @ directions[brightest], np.zeros(len(pixels), bool)
        for radius in _RADII:
            is_close = is_candidate & (from_brightest > np.cos(2 * radius))
            middle = power[is_close] @ directions[is_close]
            cosines = directions @ (middle / np.linalg.norm(middle))
            is_near = is_candidate & (cosines > np.cos(radius))
            disc, wider_power = power[is_near], power[cosines > np.cos(2 * radius)].sum()
            is_rim = (cosines <= np.cos(radius)) & (cosines > np.cos(_RIM * radius))
            has_ended = brightness[pixels[is_rim]].max(initial=0) < brightness[pixels[brightest]] / 2
            if has_ended and disc.sum() > max(_MIN_SHARE * total, _ISOLATION * wider_power):
                mean = disc @ directions[is_near] / disc.sum()
                length = np.linalg.norm(mean)
                # the variance of angles over a disc is Ω / (2π), plus that of its pixels
                size = 4 * np.pi * (1 - length) + disc @ solid_angles[pixels[is_near]] / disc.sum()
                area = disc.sum() ** 2 / (disc**2 / solid_angles[pixels[is_near]]).sum()
                if size < min(_MAX_SPREAD * area, _MAX_AREA * 2 * np.pi * (1 - np.cos(radius))):
                    suns.append((mean / length, light[is_near].sum(axis=0), size))
                    is_in_disc = is_near
                    break
        is_sun |= is_in_disc
        is_candidate &= ~(is_in_disc if is_in_disc.any() else from_brightest > np.cos(2 * _RADII[0]))
    without_suns = radiance.reshape(-1, 3).copy()
    without_suns[pixels[is_sun]] *= (1 - sun_shares[is_sun])[:, None]
    columns = np.array([[*direction, *irradiance, size] for direction, irradiance, size in suns]).reshape(-1, 7)
    suns_of_map = Suns(columns[:, :3], columns[:, 3:6], columns[:, 6])
    return SeparatedLight(suns_of_map, without_suns.reshape(radiance.shape))


def directions_in_suns(suns: Suns, count: int) -> np.ndarray:
    """Evenly distributed directions over each sun; unit vectors, [sun, direction, 3]."""
    i = np.arange(count)
    x, y = np.sqrt((i + 0.5) / count) * [np.cos(np.pi * (1 + np.sqrt(5)) * i), np.sin(np.pi * (1 + np.sqrt(5)) * i)]
    axes = np.eye(3)[np.abs(suns.directions).argmin(axis=1)]
    tangents = np.cross(suns.directions, axes)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    bitangents = np.cross(suns.directions, tangents)
    offsets = x[:, None] * tangents[:, None] + y[:, None] * bitangents[:, None] if count > 1 else np.zeros((1, 3))
    directions = suns.directions[:, None] + np.sqrt(suns.solid_angles / np.pi)[:, None, None] * offsets
    return directions / np.linalg.norm(directions, axis=2, keepdims=True)
