"""Convex polygons of a surface, merged from its triangles."""

import heapq

import numpy as np

_STRAIGHT = 1e-6  # largest reflex angle of a corner [rad]
_BEND = 0.1
"""Largest distance of corners from a plane, over the tolerance. A bent polygon flips from one side to the other as a
receiver passes its plane: with 1 gradients of the shadow of a dome are twice as large as differences, with 0.25 off by
2%, with 0.05 by 0.2%."""

_GAP = 0.01  # corners are straight up to this distance from the line through their neighbors, over the tolerance


def merge_triangles(points: np.ndarray, triangles: np.ndarray, tolerance: float) -> list[np.ndarray]:
    """Merge adjacent triangles into thin convex polygons, the thinnest first.

    Adjacent polygons share whole sides, so no gap is seen between them from anywhere.

    Args:
        points: Float64 of shape [point, 3].
        triangles: Consistently wound, shape [triangle, 3].
        tolerance: Maximum thickness of a polygon, measured at all corners of its triangles [units of points].

    Returns:
        Corners of each polygon in order, indices of points, int of shape [corner].
    """
    merger = _Merger(points, triangles, tolerance)
    merger.merge()
    return [np.array(_without_collinear(points, outline, _GAP * tolerance)) for outline in merger.outlines.values()]


class _Merger:
    """Polygons by number, and pairs of them that may merge.

    Args:
        points, triangles, tolerance: As of :func:`merge_triangles`.
    """

    def __init__(self, points: np.ndarray, triangles: np.ndarray, tolerance: float):
        self.outlines: dict[int, list[int]] = dict(enumerate(triangles.tolist()))
        self._points, self._tolerance = points, tolerance
        self._corners = {number: frozenset(outline) for number, outline in self.outlines.items()}
        self._polygon_at = {side: number for number, outline in self.outlines.items() for side in _sides(outline)}
        self._pairs: list[tuple[float, int, int, list[int]]] = []  # thickness, polygons, merged outline

    def merge(self) -> None:
        """Merge polygons while a pair is left."""
        for number in self.outlines:
            self._find_pairs(number)
        new = len(self.outlines)
        while self._pairs:
            _thickness, one, other, outline = heapq.heappop(self._pairs)
            if one not in self.outlines or other not in self.outlines:
                continue
            for number in (one, other):
                for side in _sides(self.outlines.pop(number)):
                    self._polygon_at.pop(side, None)
            self.outlines[new] = outline
            self._corners[new] = self._corners[one] | self._corners[other]
            self._polygon_at.update(dict.fromkeys(_sides(outline), new))
            self._find_pairs(new, later_only=False)
            new += 1

    def _find_pairs(self, number: int, later_only: bool = True) -> None:
        """Queue the neighbors with which a polygon may merge."""
        neighbors = {self._polygon_at.get(side[::-1], -1) for side in _sides(self.outlines[number])} - {-1, number}
        for neighbor in sorted(neighbors):
            if later_only and neighbor < number:
                continue
            outline = self._outline_of_both(number, neighbor)
            if outline is None:
                continue
            normal = _normal(self._points[outline])
            corners = self._points[sorted(self._corners[number] | self._corners[neighbor])]
            thickness = float(np.ptp(corners @ normal))
            height_range = float(np.ptp(self._points[outline] @ normal))
            if (
                thickness <= self._tolerance
                and height_range <= _BEND * self._tolerance
                and _is_convex(self._points[outline], normal)
            ):
                heapq.heappush(self._pairs, (thickness, number, neighbor, outline))

    def _outline_of_both(self, number: int, neighbor: int) -> list[int] | None:
        """The outline of two polygons together; None if it is not one loop."""
        sides = {side for polygon in (number, neighbor) for side in _sides(self.outlines[polygon])}
        boundary = [side for side in sorted(sides) if side[::-1] not in sides]
        next_corner = dict(boundary)
        if len(next_corner) < max(len(boundary), 3):
            return None
        outline = [boundary[0][0]]
        while (corner := next_corner[outline[-1]]) != outline[0]:
            outline.append(corner)
        return outline if len(outline) == len(boundary) else None


def _sides(outline: list[int]) -> list[tuple[int, int]]:
    """Sides of a polygon, each from one corner to the next."""
    return list(zip(outline, outline[1:] + outline[:1], strict=True))


def _normal(corners: np.ndarray) -> np.ndarray:
    """Unit normal of a polygon in space, weighted by area (Newell)."""
    offsets = corners - corners[0]
    normal = np.cross(offsets[1:-1], offsets[2:]).sum(axis=0)
    return normal / max(np.linalg.norm(normal), 1e-30)


def _is_convex(corners: np.ndarray, normal: np.ndarray) -> bool:
    """Whether a polygon, seen against its normal, turns left at each corner, 360° in all."""
    sides = np.roll(corners, -1, axis=0) - corners
    before = np.roll(sides, 1, axis=0)
    turns = np.arctan2(np.cross(before, sides) @ normal, (before * sides).sum(axis=1))
    return bool(turns.min() > -_STRAIGHT and turns.sum() < 3 * np.pi)


def _without_collinear(points: np.ndarray, outline: list[int], gap: float) -> list[int]:
    """The corners of a polygon without straight ones."""
    for corner in list(outline):
        index = outline.index(corner)
        before, after = outline[index - 1], outline[(index + 1) % len(outline)]
        side, offset = points[after] - points[before], points[corner] - points[before]
        if len(outline) > 3 and np.linalg.norm(np.cross(side, offset)) <= gap * np.linalg.norm(side):
            outline = outline[:index] + outline[index + 1 :]
    return outline
