"""Contacts: where bodies touch at a point or along a line, with a narrow gap around, as a ball on a ground.

Light in the gap falls with a power of the distance r to the contact, so patches there should be about as wide as r.
Their density is

    1 + w L² / (r² + s²),  s = 0.05 L

times that elsewhere, where L is half the size of the body; of two bodies that are not flat, of the smaller one.
:func:`warpshadow.stages.patches.find_patches` chooses w. Faces that lie on each other, as a box on a ground, have
no such gap; nor has an edge that a box stands on, or a body that penetrates another: there surfaces are not parallel.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

_CORE_RADIUS = 0.05  # s in units of L: nearer to a contact the density is constant
MAX_GAP = 0.02  # widest gap of bodies that count as touching, in units of L …
_EXTRA_GAP = 0.002  # … and points of a contact have gaps up to this much wider than the narrowest
_MAX_AREA = 0.03  # largest share of its area in which a body touches another: more is face on face
_MAX_POINTS = 32  # maximum number of points of a contact
_POINT_EXTENT = 0.5  # largest extent of a contact that counts as a point, in units of L


class Contact(NamedTuple):
    """Where two bodies touch, in the frame of one of them."""

    points: np.ndarray  # [point, 3]
    half_size: float  # L, of the smaller body that is not flat

    @property
    def is_point(self) -> bool:
        """Whether the contact is a point, not a line."""
        return bool(np.ptp(self.points, axis=0).max() < _POINT_EXTENT * self.half_size)


def touching_numbers(gaps: np.ndarray, areas: np.ndarray, half_size: float) -> np.ndarray:
    """Find the points of a body that touch another.

    Args:
        gaps: Their distances to the other body; infinite where it is far away or not parallel, shape [point].
        areas: Parts of the body's surface around them, shape [point].
        half_size: L, of the smaller of both bodies that is not flat.
    Returns:
        Indices of an even sample of the points that touch, ascending; none if bodies are apart or touch face on face.
    """
    nearest = gaps.min(initial=np.inf)
    if nearest > MAX_GAP * half_size:
        return np.empty(0, int)
    touching = np.flatnonzero(gaps <= nearest + _EXTRA_GAP * half_size)
    if areas[touching].sum() > _MAX_AREA * areas.sum():
        return np.empty(0, int)
    return touching[np.linspace(0, len(touching) - 1, min(len(touching), _MAX_POINTS)).astype(int)]


def contact_excess(points: np.ndarray, radii: np.ndarray | float, contacts: Sequence[Contact]) -> np.ndarray:
    """L² / (r² + s²) of the nearest contacts; times w, it is the density that they add.

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
