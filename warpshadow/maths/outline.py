"""Outlines: the boundary edges of triangles in a plane, those of holes included, and their convex decomposition."""

import numpy as np

_STRAIGHT = 1e-5
"""Corners are straight up to this distance from the line through their neighbors, over the size of the outline; corners
of a polygon up to this angle [rad]."""

_SLIVER = 1e-7  # area of a triangle, over the squared size of all, up to which rounding may turn it over


def find_outline(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Find the boundary edges of triangles in a plane.

    The outline of a sheet does not depend on how it is triangulated. Where triangles overlap, their outlines do, too.

    Args:
        points: Float64 of shape [point, 2], no two at one place.
        triangles: Of any winding, shape [triangle, 3]; slivers are taken to wind as most do, and triangles
            with a repeated corner do not count.
    Returns:
        Begin and end of each edge, with the triangles to its left, indices of points, int of shape [edge, 2].
    """
    a, b, c = np.moveaxis(points[triangles], 1, 0)
    areas = _cross(b - a, c - a)
    has_area = np.abs(areas) > _SLIVER * np.ptp(points, axis=0).max(initial=0.0) ** 2
    is_turned = np.where(has_area, areas, areas.sum()) < 0
    corners = np.where(is_turned[:, None], triangles[:, ::-1], triangles)
    begins, edge_ends = corners.ravel(), np.roll(corners, -1, axis=1).ravel()
    pairs, number = np.unique(np.sort([begins, edge_ends], axis=0), axis=1, return_inverse=True)
    excess = np.bincount(number.reshape(-1), np.where(begins < edge_ends, 1, -1), pairs.shape[1]).astype(int)
    excess[pairs[0] == pairs[1]] = 0
    directed_edges = np.where(excess > 0, pairs, pairs[::-1])
    return _without_collinear(points, np.repeat(directed_edges, np.abs(excess), axis=1).T)


def _without_collinear(points: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Merge collinear edges."""
    outgoing: dict[int, list[int]] = {}
    incoming: dict[int, list[int]] = {}
    for begin, end in edges.tolist():
        outgoing.setdefault(begin, []).append(end)
        incoming.setdefault(end, []).append(begin)
    tolerance = _STRAIGHT * np.ptp(points[edges], axis=(0, 1)).max() if len(edges) else 0.0
    for corner in sorted(outgoing):
        if len(outgoing[corner]) != 1 or len(incoming[corner]) != 1:
            continue
        (next_vertex,), (previous_vertex,) = outgoing[corner], incoming[corner]
        side, offset = points[next_vertex] - points[previous_vertex], points[corner] - points[previous_vertex]
        length = np.hypot(*side)
        if (
            previous_vertex != next_vertex
            and abs(_cross(side, offset)) <= tolerance * length
            and 0 < offset @ side < length**2
        ):
            del outgoing[corner], incoming[corner]
            outgoing[previous_vertex][outgoing[previous_vertex].index(corner)] = next_vertex
            incoming[next_vertex][incoming[next_vertex].index(corner)] = previous_vertex
    return np.array([[begin, end] for begin, end_vertices in outgoing.items() for end in end_vertices], int).reshape(
        -1, 2
    )


def is_convex(edges: np.ndarray) -> bool:
    """Whether an outline, float64 of shape [edge, 2, 2], is convex: no corner lies to the right of an edge."""
    begins, lines = edges[:, 0], edges[:, 1] - edges[:, 0]
    heights = _cross(lines[:, None], begins - begins[:, None])
    size = np.ptp(edges, axis=(0, 1)).max(initial=0.0)
    return bool((heights >= -_STRAIGHT * size * np.linalg.norm(lines, axis=1)[:, None]).all())


def cut_outline(points: np.ndarray, edges: np.ndarray, maximum: int) -> list[np.ndarray] | None:
    """Decompose the inside of an outline into convex polygons, by diagonals between its corners.

    Each diagonal begins at a reflex corner. It ends at a corner that leaves no reflex angle; among these at another
    reflex corner if there is one, else at the nearest. Diagonals that turn out to be redundant are removed [Hertel and
    Mehlhorn 1983].

    Args:
        points: Float64 of shape [point, 2].
        edges: Of the outline, shape [edge, 2], with the inside to their left.
        maximum: Maximum number of polygons.
    Returns:
        Corners of each polygon, indices of points counterclockwise, int of shape [corner]; None if more polygons are
        needed, or if the outline touches or crosses itself.
    """
    next_vertex, previous_vertex = dict(edges.tolist()), dict(edges[:, ::-1].tolist())
    if not len(next_vertex) == len(previous_vertex) == len(edges):
        return None
    reflex = {
        corner for corner in next_vertex if _is_reflex(points, previous_vertex[corner], corner, next_vertex[corner])
    }
    if len(reflex) > 2 * maximum:
        return None
    decomposition = _Decomposition(points, edges)
    for corner in sorted(reflex):
        while sector := decomposition.reflex_sector(corner):
            end = decomposition.best_end(corner, sector, reflex)
            if end is None:
                return None
            decomposition.add(corner, end)
    decomposition.remove_redundant()
    polygons = decomposition.polygons()
    return polygons if polygons is not None and len(polygons) <= maximum else None


class _Decomposition:
    """An outline, and diagonals that cut it.

    Each corner has the other ends of its edges and diagonals, counterclockwise: first of the edge after it, last of the
    edge before it.
    """

    def __init__(self, points: np.ndarray, edges: np.ndarray):
        self._points, self._lines = points, edges
        previous_vertex = dict(edges[:, ::-1].tolist())
        self._ends = {corner: [next_vertex, previous_vertex[corner]] for corner, next_vertex in edges.tolist()}

    def reflex_sector(self, corner: int) -> tuple[int, int] | None:
        """The ends of two consecutive lines from a corner that enclose a reflex angle; None where there are none."""
        edge_ends = self._ends[corner]
        sectors = zip(edge_ends[:-1], edge_ends[1:], strict=True)
        return next((sector for sector in sectors if _is_reflex(self._points, sector[1], corner, sector[0])), None)

    def best_end(self, corner: int, sector: tuple[int, int], reflex: set[int]) -> int | None:
        """The corner at which to end a diagonal that splits a reflex sector; None where none is visible."""
        first, last = sector
        first_offset, last_offset = self._points[[first, last]] - self._points[corner]

        def is_visible(end: int) -> bool:
            end_offset = self._points[end] - self._points[corner]
            is_outside = _cross(last_offset, end_offset) >= 0 and _cross(end_offset, first_offset) >= 0
            return not is_outside and not self._crosses(corner, end)

        def cost(end: int) -> tuple[bool, bool, float]:
            leaves_some = _is_reflex(self._points, end, corner, first) or _is_reflex(self._points, last, corner, end)
            return leaves_some, end not in reflex, float(np.hypot(*(self._points[end] - self._points[corner])))

        return min((end for end in self._ends if end != corner and is_visible(end)), key=cost, default=None)

    def _crosses(self, corner: int, end: int) -> bool:
        """Whether the diagonal between two corners crosses an edge or diagonal, or touches a corner."""
        a, b = self._points[[corner, end]]
        line, offsets = b - a, self._points[[other for other in self._ends if other not in (corner, end)]] - a
        heights, line_shares = _cross(line, offsets) / (line @ line), offsets @ line / (line @ line)
        if ((np.abs(heights) < _STRAIGHT) & (line_shares > 0) & (line_shares < 1)).any():
            return True
        c, d = self._points[self._lines].swapaxes(0, 1)
        parts_ends = _cross(line, c - a) * _cross(line, d - a) < 0
        return bool((parts_ends & (_cross(d - c, a - c) * _cross(d - c, b - c) < 0)).any())

    def add(self, corner: int, end: int) -> None:
        """Add the diagonal between two corners."""
        self._lines = np.concatenate([self._lines, [[corner, end]]])
        for one, other in ((corner, end), (end, corner)):
            edge_ends = self._ends[one]
            offsets = self._points[[*edge_ends, other]] - self._points[one]
            *angles, angle = np.arctan2(_cross(offsets[0], offsets), offsets @ offsets[0]) % (2 * np.pi)
            edge_ends.insert(1 + sum(other_angle < angle for other_angle in angles[1:-1]), other)

    def remove_redundant(self) -> None:
        """Remove diagonals without which both of their ends stay convex, in the order in which they were added."""
        for line in self._lines[len(self._ends) :].tolist():
            sectors = []
            for corner, end in (line, line[::-1]):
                edge_ends = self._ends[corner]
                position = edge_ends.index(end)
                sectors.append((edge_ends[position + 1], corner, edge_ends[position - 1]))
            if not any(_is_reflex(self._points, *sector) for sector in sectors):
                for corner, end in (line, line[::-1]):
                    self._ends[corner].remove(end)

    def polygons(self) -> list[np.ndarray] | None:
        """Traverse the boundary of each polygon; None where one is not convex."""
        steps = {(corner, end) for corner, edge_ends in self._ends.items() for end in edge_ends[:-1]}
        closed_polygons = []
        while steps:
            corner, end = start = min(steps)
            polygon = []
            while (corner, end) in steps:
                steps.remove((corner, end))
                polygon.append(corner)
                edge_ends = self._ends[end]
                corner, end = end, edge_ends[edge_ends.index(corner) - 1]
            turn_angles = _turns(self._points[polygon])
            if (corner, end) != start or turn_angles.min() < -_STRAIGHT:
                return None
            closed_polygons.append(np.array(polygon)[turn_angles > _STRAIGHT])
        return closed_polygons


def _is_reflex(points: np.ndarray, previous_vertex: int, corner: int, next_vertex: int) -> bool:
    """Whether a boundary turns right at a corner."""
    return bool(_turns(points[[previous_vertex, corner, next_vertex]])[1] < -_STRAIGHT)


def _turns(polygon: np.ndarray) -> np.ndarray:
    """Sine of the angle by which the boundary of a polygon turns left at each corner, [corner]."""
    inward, next_end = polygon - np.roll(polygon, 1, axis=0), np.roll(polygon, -1, axis=0) - polygon
    return _cross(inward, next_end) / (np.linalg.norm(inward, axis=1) * np.linalg.norm(next_end, axis=1))


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
