"""Convex polygons into which triangles of a surface are joined."""

import heapq

import numpy as np

_STRAIGHT = 1e-6  # angle [rad] up to which a corner may turn the other way
_BEND = 0.1
"""How far corners are from a plane at most, over the tolerance. A bent polygon leaps from one side to the other as a
receiver passes its plane: with 1 gradients of the shadow of a dome are twice as large as differences, with 0.25 off by
2%, with 0.05 by 0.2%."""

_GAP = 0.01  # distance of a corner from the line between those beside it up to which it is none, over the tolerance


def join_triangles(points: np.ndarray, triangles: np.ndarray, tolerance: float) -> list[np.ndarray]:
    """Join neighboring triangles to convex polygons, the thinnest first, while they are thin.

    Polygons beside each other share whole sides, so there is no gap between them, wherever they are seen from.

    Args:
        points: Float64 of shape [point, 3].
        triangles: That wind alike, shape [triangle, 3].
        tolerance: Thickness of a polygon at most, of all corners of its triangles [units of points].

    Returns:
        Points at the corners of each, in order around it, int of shape [corner].
    """
    joiner = _Joiner(points, triangles, tolerance)
    joiner.join()
    return [np.array(_without_straight(points, outline, _GAP * tolerance)) for outline in joiner.outlines.values()]


class _Joiner:
    """Polygons, by their numbers.

    Args:
        points, triangles, tolerance: As of :func:`join_triangles`.
    """

    def __init__(self, points: np.ndarray, triangles: np.ndarray, tolerance: float):
        self.outlines: dict[int, list[int]] = dict(enumerate(triangles.tolist()))
        self._points, self._tolerance = points, tolerance
        self._corners = {number: frozenset(outline) for number, outline in self.outlines.items()}
        self._polygon_at = {side: number for number, outline in self.outlines.items() for side in _sides(outline)}
        self._pairs: list[tuple[float, int, int, list[int]]] = []  # of polygons that may be joined, with the outline

    def join(self) -> None:
        """Join polygons until no two can be."""
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
        """List the neighbors with which a polygon may be joined."""
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
        """The outline around two polygons; None if they touch in more than one line."""
        sides = {side for polygon in (number, neighbor) for side in _sides(self.outlines[polygon])}
        rim = [side for side in sorted(sides) if side[::-1] not in sides]
        next_corner = dict(rim)
        if len(next_corner) < max(len(rim), 3):
            return None
        outline = [rim[0][0]]
        while (corner := next_corner[outline[-1]]) != outline[0]:
            outline.append(corner)
        return outline if len(outline) == len(rim) else None


def _sides(outline: list[int]) -> list[tuple[int, int]]:
    """Sides of a polygon, each from one corner to the next."""
    return list(zip(outline, outline[1:] + outline[:1], strict=True))


def _normal(corners: np.ndarray) -> np.ndarray:
    """Unit normal of a polygon in space, the mean over its area."""
    offsets = corners - corners[0]
    normal = np.cross(offsets[1:-1], offsets[2:]).sum(axis=0)
    return normal / max(np.linalg.norm(normal), 1e-30)


def _is_convex(corners: np.ndarray, normal: np.ndarray) -> bool:
    """Whether a polygon, seen along its normal, turns left at each corner, once around."""
    sides = np.roll(corners, -1, axis=0) - corners
    before = np.roll(sides, 1, axis=0)
    turns = np.arctan2(np.cross(before, sides) @ normal, (before * sides).sum(axis=1))
    return bool(turns.min() > -_STRAIGHT and turns.sum() < 3 * np.pi)


def _without_straight(points: np.ndarray, outline: list[int], gap: float) -> list[int]:
    """Corners around a polygon, without points on straight sides."""
    for corner in list(outline):
        index = outline.index(corner)
        before, after = outline[index - 1], outline[(index + 1) % len(outline)]
        side, offset = points[after] - points[before], points[corner] - points[before]
        if len(outline) > 3 and np.linalg.norm(np.cross(side, offset)) <= gap * np.linalg.norm(side):
            outline = outline[:index] + outline[index + 1 :]
    return outline
