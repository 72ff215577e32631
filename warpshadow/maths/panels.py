"""Panels: nearly flat, convex regions of a sheet, which is a mesh of one layer, such as cloth or a box without a lid."""

from __future__ import annotations

import numpy as np

TOLERANCE = 0.02
"""Thickness and mean gap of a panel at most, over the size of the mesh.

A tent of 2048 faces has 6 panels, and an image of it is 3.1% off, the ground by pixel; with 0.01 it has 16, and the image
is 2.9% off, in 1.5 times the time. The spheres that stood in for it had 10.2%.
"""

MOST_PANELS = 32
"""Panels of a sheet at most: where a sheet bends so often, spheres are faster."""


def find_panels(points: np.ndarray, triangles: np.ndarray, tolerance: float, most: int) -> list[np.ndarray] | None:
    """Cut a sheet into panels.

    A region of it that is too thick, or whose outline is not convex, is cut in two across the principal axis that
    leaves the flatter halves, until none is [Lien and Amato 2007: approximate convex decomposition].

    Args:
        points: Vertices, float64 of shape [vertex, 3].
        triangles: Triangles, none of them without area, shape [triangle, 3].
        tolerance: Thickness and mean gap of a panel at most [units of points].
        most: Number of panels at most.

    Returns:
        Vertices at the corners of each, in order around it, int of shape [corner]; None where there are more.
    """
    regions, deviations = [triangles], [_deviation(points, triangles)]
    while len(regions) + sum(deviation > tolerance for deviation in deviations) <= most:
        if max(deviations) <= tolerance:
            return [_outline(points, region, tolerance / 2) for region in regions]
        worst = int(np.argmax(deviations))
        halves = min(_cuts(points, regions[worst]), key=lambda cut: max(_deviation(points, half) for half in cut))
        regions[worst : worst + 1] = halves
        deviations[worst : worst + 1] = [_deviation(points, half) for half in halves]
    return None


def _principal_axes(places: np.ndarray) -> np.ndarray:
    """Unit vectors along which places spread, the longest first, shape [3, 3]."""
    centered = places - places.mean(axis=0)
    return np.linalg.eigh(centered.T @ centered)[1].T[::-1]


def _cuts(points: np.ndarray, region: np.ndarray) -> list[list[np.ndarray]]:
    """Halves of a region, across each of its principal axes."""
    middles = points[region].mean(axis=1)
    order = np.argsort(middles @ _principal_axes(middles).T, axis=0, kind="stable")
    return [[region[half] for half in np.array_split(column, 2)] for column in order.T]


def _deviation(points: np.ndarray, region: np.ndarray) -> float:
    """How far a region is from a panel: its thickness, or the mean width by which a convex outline is larger."""
    from scipy.spatial import ConvexHull

    places = points[region] @ _principal_axes(points[np.unique(region)]).T
    flat = places[..., :2]
    outline = ConvexHull(flat.reshape(-1, 2))
    u, v = flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0]
    area = np.abs(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]).sum() / 2
    return float(max(np.ptp(places[..., 2]), (outline.volume - area) / np.ptp(flat[..., 0])))


def _outline(points: np.ndarray, region: np.ndarray, tolerance: float) -> np.ndarray:
    """Corners around a region, but for those that stand out by less than the tolerance."""
    from scipy.spatial import ConvexHull

    used = np.unique(region)
    flat = points[used] @ _principal_axes(points[used])[:2].T
    around = ConvexHull(flat).vertices
    chosen = np.array([flat[around, 0].argmin(), flat[around, 0].argmax()])  # of those around, in order
    while True:
        corners = flat[around[np.sort(chosen)]]
        sides = np.roll(corners, -1, axis=0) - corners
        outward = np.stack([sides[:, 1], -sides[:, 0]], axis=1) / np.linalg.norm(sides, axis=1, keepdims=True)
        heights = ((flat[around][:, None] - corners) * outward).sum(axis=-1).max(axis=1)
        if len(chosen) > 2 and heights.max() <= tolerance:
            return used[around[np.sort(chosen)]]
        chosen = np.append(chosen, heights.argmax())
