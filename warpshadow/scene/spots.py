"""Spots of lamps: where a lamp is near a flat body, light bounces off a narrow part of it."""

from collections.abc import Sequence

import numpy as np

from warpshadow.maths.plane import is_flat, principal_axes
from warpshadow.scene.body import Body

_NARROW = 0.16
"""Radius of a narrow spot, at most, in units of the flat body's size, or the scene's if that is smaller."""


def has_narrow_spot(bodies: Sequence[Body]) -> bool:
    """Whether a lamp's spot on a flat body is narrow; its radius is the lamp's distance, or half of the lamp's size."""
    is_lamp = np.array([body.is_emitter for body in bodies])
    if not is_lamp.any():
        return False
    points = [body.world_points().astype(np.float64) for body in bodies]
    low, high = (np.stack([end(item, axis=0) for item in points]) for end in (np.min, np.max))
    middles, radii = (low + high) / 2, (high - low).max(axis=1) / 2
    for number, body in enumerate(bodies):
        if is_flat(points[number]):
            others = np.arange(len(points)) != number
            extent = (high[others].max(axis=0) - low[others].min(axis=0)).max() if others.any() else 0.0
            size = min(body.scale * np.sqrt(body.mesh.area), extent)
            heights = np.abs((middles - middles[number]) @ principal_axes(points[number])[2])
            distances = np.linalg.norm(middles - np.clip(middles, low[number], high[number]), axis=1)
            spots = np.maximum.reduce([heights, distances, radii])
            if (spots < _NARROW * size)[is_lamp & others].any():
                return True
    return False
