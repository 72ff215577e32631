"""Contacts: where bodies touch so that a narrow gap opens around, as around the foot of a ball.

Light in such a gap falls with a power of the distance r to the contact, so patches there are to be about as wide as r.
They are

    1 + w L² / (r² + s²),  s = 0.05 L

times as dense as elsewhere, where L is half the size of the body; of two bodies that are not flat, of the smaller one.
:func:`warpshadow.stages.patches.find_patches` chooses w. Faces that lie on each other, as a box's bottom on a
ground, have no such gap; nor has an edge that a box stands on, or a body that sticks in another: there surfaces are not
parallel.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

_CORE_RADIUS = 0.05  # s in units of L: nearer to a contact nothing gets finer
MAX_GAP = 0.02  # the widest gap of bodies that touch, in units of L …
_EXTRA_GAP = 0.002  # … and how much wider it is where they touch, too
_MAX_AREA = 0.03  # share of its area in which a body touches another, at most: more is face on face
_MAX_POINTS = 32  # points of a contact
_POINT_EXTENT = 0.5  # extent of a contact that counts as a point, in units of L, at most


class Contact(NamedTuple):
    """Where two bodies touch, in the frame of one of them."""

    points: np.ndarray  # [point, 3]
    half_size: float  # L, of the smaller body that is not flat

    @property
    def is_point(self) -> bool:
        """Whether it is about a point, not a line."""
        return bool(np.ptp(self.points, axis=0).max() < _POINT_EXTENT * self.half_size)


def touching_numbers(gaps: np.ndarray, areas: np.ndarray, half_size: float) -> np.ndarray:
    """Which points of a body touch another.

    Args:
        gaps: Their distances to the other body; infinite where it is far away or not parallel, shape [point].
        areas: Parts of the body's surface around them, shape [point].
        half_size: L, of the smaller of both bodies that is not flat.
    Returns:
        Their numbers, spread over all that touch, ascending; none where bodies are apart, or touch face on face.
    """
    nearest = gaps.min(initial=np.inf)
    if nearest > MAX_GAP * half_size:
        return np.empty(0, int)
    touching = np.flatnonzero(gaps <= nearest + _EXTRA_GAP * half_size)
    if areas[touching].sum() > _MAX_AREA * areas.sum():
        return np.empty(0, int)
    return touching[np.linspace(0, len(touching) - 1, min(len(touching), _MAX_POINTS)).astype(int)]


def contact_excess(points: np.ndarray, radii: np.ndarray | float, contacts: Sequence[Contact]) -> np.ndarray:
    """L² / (r² + s²) of the nearest contacts, which w times is the density that they add.

    Args:
        points: Middles of pieces of a surface, shape [piece, 3].
        radii: Of spheres around the pieces: r counts from their nearest points, shape [piece]; or of all.
        contacts: Of their body.
    Returns:
        Shape [piece].
    """
    from scipy.spatial import cKDTree

    result = np.zeros(len(points))
    for contact in contacts:
        distances = np.maximum(cKDTree(contact.points).query(points)[0] - radii, 0)
        result = np.maximum(result, 1 / ((distances / contact.half_size) ** 2 + _CORE_RADIUS**2))
    return result
