"""Outlines: the edges around triangles of a plane and around their holes, and convex polygons into which these cut it."""

from __future__ import annotations

import numpy as np

_STRAIGHT = 1e-5
"""Distance from the line through its neighbors, over the size of the outline, up to which a corner is none; and angle
[rad] by which a corner may be reflex."""


def find_outline(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Find the edges that the triangles of a plane have not in common.

    The outline of a sheet does not depend on how it is triangulated. Where triangles overlap, their outlines do, too.

    Args:
        points: Float64 of shape [point, 2], no two at one place.
        triangles: Of any winding, shape [triangle, 3]; those without area do not count.
    Returns:
        Points where each edge begins and ends, with the triangles to its left, int of shape [edge, 2].
    """
    a, b, c = np.moveaxis(points[triangles], 1, 0)
    areas = _cross(b - a, c - a)
    corners = np.where((areas < 0)[:, None], triangles[:, ::-1], triangles)[areas != 0]
    begins, ends = corners.ravel(), np.roll(corners, -1, axis=1).ravel()
    pairs, number = np.unique(np.sort([begins, ends], axis=0), axis=1, return_inverse=True)
    excess = np.bincount(number.reshape(-1), np.where(begins < ends, 1, -1), pairs.shape[1]).astype(int)
    directed = np.where(excess > 0, pairs, pairs[::-1])
    return _without_straight(points, np.repeat(directed, np.abs(excess), axis=1).T)


def _without_straight(points: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Join edges at corners that are none."""
    outgoing: dict[int, list[int]] = {}
    incoming: dict[int, list[int]] = {}
    for begin, end in edges.tolist():
        outgoing.setdefault(begin, []).append(end)
        incoming.setdefault(end, []).append(begin)
    tolerance = _STRAIGHT * np.ptp(points[edges], axis=(0, 1)).max() if len(edges) else 0.0
    for corner in sorted(outgoing):
        if len(outgoing[corner]) != 1 or len(incoming[corner]) != 1:
            continue
        (after,), (before,) = outgoing[corner], incoming[corner]
        along, beside = points[after] - points[before], points[corner] - points[before]
        length = np.hypot(*along)
        if before != after and abs(_cross(along, beside)) <= tolerance * length and 0 < beside @ along < length**2:
            del outgoing[corner], incoming[corner]
            outgoing[before][outgoing[before].index(corner)] = after
            incoming[after][incoming[after].index(corner)] = before
    return np.array([[begin, end] for begin, others in outgoing.items() for end in others], int).reshape(-1, 2)


def cut_outline(points: np.ndarray, edges: np.ndarray, maximum: int) -> list[np.ndarray] | None:
    """Cut what an outline encloses into convex polygons, by lines between its corners.

    From each reflex corner a line goes to a corner that leaves none there, to another reflex one if it can be, or else
    two lines go to the nearest. Lines that no corner needs any more are left out [Hertel and Mehlhorn 1983].

    Args:
        points: Float64 of shape [point, 2].
        edges: Of the outline, shape [edge, 2], with the inside to their left.
        maximum: Number of polygons at most.
    Returns:
        Corners of each polygon, numbers of points counterclockwise, int of shape [corner]; None where there are more,
        or where the outline touches or crosses itself.
    """
    after, before = dict(edges.tolist()), dict(edges[:, ::-1].tolist())
    if not len(after) == len(before) == len(edges):
        return None
    reflex = {corner for corner in after if _turns_right(points, before[corner], corner, after[corner])}
    if len(reflex) > 2 * maximum:
        return None
    plan = _Plan(points, edges)
    for corner in sorted(reflex):
        while sector := plan.reflex_sector(corner):
            end = plan.best_end(corner, sector, reflex)
            if end is None:
                return None
            plan.add(corner, end)
    plan.leave_out_needless()
    polygons = plan.polygons()
    return polygons if polygons is not None and len(polygons) <= maximum else None


class _Plan:
    """An outline, and the lines that cut it.

    Attributes:
        neighbors: Where lines lead from each corner, the next edge first, then counterclockwise, the edge before last.
    """

    def __init__(self, points: np.ndarray, edges: np.ndarray):
        self._points, self._edges = points, edges
        self._cuts: list[tuple[int, int]] = []
        self._corners = np.unique(edges)
        before = dict(edges[:, ::-1].tolist())
        self.neighbors = {begin: [end, before[begin]] for begin, end in edges.tolist()}

    def reflex_sector(self, corner: int) -> tuple[int, int] | None:
        """Neighbors of a corner, one after the other, between which it is reflex."""
        around = self.neighbors[corner]
        for first, last in zip(around[:-1], around[1:], strict=True):
            if _turns_right(self._points, last, corner, first):
                return first, last
        return None

    def best_end(self, corner: int, sector: tuple[int, int], reflex: set[int]) -> int | None:
        """The corner to which a line goes; None where none is seen."""
        first, last = sector
        seen = [end for end in self._corners.tolist() if end not in (corner, first, last)]
        seen = [end for end in seen if self._is_between(corner, first, end, last) and self._sees(corner, end)]

        def cost(end: int) -> tuple[bool, bool, float]:
            leaves_none = not _turns_right(self._points, end, corner, first) and not _turns_right(
                self._points, last, corner, end
            )
            return not leaves_none, end not in reflex, float(np.hypot(*(self._points[end] - self._points[corner])))

        return min(seen, key=cost, default=None)

    def _is_between(self, corner: int, first: int, end: int, last: int) -> bool:
        """Whether the line to an end is inside a reflex sector."""
        to_first, to_end, to_last = self._points[[first, end, last]] - self._points[corner]
        is_outside = _cross(to_last, to_end) >= 0 and _cross(to_end, to_first) >= 0
        return not is_outside and self._is_inside(end, corner)

    def _is_inside(self, corner: int, end: int) -> bool:
        """Whether a line from a corner begins inside the outline."""
        to_first, to_end, to_last = self._points[[self.neighbors[corner][0], end, self.neighbors[corner][-1]]] - (
            self._points[corner]
        )
        if _cross(to_first, to_last) >= 0:
            return bool(_cross(to_first, to_end) > 0 and _cross(to_end, to_last) > 0)
        return not (_cross(to_last, to_end) >= 0 and _cross(to_end, to_first) >= 0)

    def _sees(self, corner: int, end: int) -> bool:
        """Whether nothing is between two corners."""
        a, b = self._points[[corner, end]]
        others = np.concatenate([self._edges, np.array(self._cuts, int).reshape(-1, 2)])
        others = others[~np.isin(others, [corner, end]).any(axis=1)]
        c, d = self._points[others[:, 0]], self._points[others[:, 1]]
        parts = _cross(b - a, c - a) * _cross(b - a, d - a) <= 0
        return not (parts & (_cross(d - c, a - c) * _cross(d - c, b - c) <= 0)).any()

    def add(self, corner: int, end: int) -> None:
        """Cut from one corner to another."""
        self._cuts.append((corner, end))
        for own, other in ((corner, end), (end, corner)):
            around = self.neighbors[own]
            around.insert(1 + sum(self._precedes(own, each, other) for each in around[1:-1]), other)

    def _precedes(self, corner: int, one: int, other: int) -> bool:
        """Whether one line from a corner comes before another, counterclockwise from the next edge on."""
        start = self._points[self.neighbors[corner][0]] - self._points[corner]
        angles = [self._angle(start, self._points[end] - self._points[corner]) for end in (one, other)]
        return angles[0] < angles[1]

    @staticmethod
    def _angle(start: np.ndarray, along: np.ndarray) -> float:
        return float(np.arctan2(_cross(start, along), start @ along) % (2 * np.pi))

    def leave_out_needless(self) -> None:
        """Take cuts away that leave no corner reflex."""
        for cut in sorted(self._cuts, key=lambda cut: -np.hypot(*(self._points[cut[0]] - self._points[cut[1]]))):
            if all(self._is_needless(own, other) for own, other in (cut, cut[::-1])):
                self.neighbors[cut[0]].remove(cut[1])
                self.neighbors[cut[1]].remove(cut[0])

    def _is_needless(self, corner: int, end: int) -> bool:
        around = self.neighbors[corner]
        place = around.index(end)
        return not _turns_right(self._points, around[place + 1], corner, around[place - 1])

    def polygons(self) -> list[np.ndarray] | None:
        """Walk around each polygon; None where one is not convex."""
        left = {(corner, end) for corner, around in self.neighbors.items() for end in around[:-1]}
        result = []
        while left:
            corner, end = start = min(left)
            polygon = []
            while (corner, end) in left:
                left.remove((corner, end))
                polygon.append(corner)
                around = self.neighbors[end]
                corner, end = end, around[around.index(corner) - 1]
            sides = zip(polygon, np.roll(polygon, -1).tolist(), np.roll(polygon, -2).tolist(), strict=True)
            if (corner, end) != start or any(_turns_right(self._points, *side) for side in sides):
                return None
            result.append(np.array(polygon))
        return result


def _turns_right(points: np.ndarray, before: int, corner: int, after: int) -> bool:
    """Whether a way past a corner turns right there."""
    along, onward = points[corner] - points[before], points[after] - points[corner]
    return bool(_cross(along, onward) < -_STRAIGHT * np.hypot(*along) * np.hypot(*onward))


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
