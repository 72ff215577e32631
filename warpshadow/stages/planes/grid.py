"""Grids: texels in the plane of a flat body, small near the other bodies, and the mesh's coverage of them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from warpshadow.maths.outline import find_outline
from warpshadow.maths.plane import plane_normal

_GRID = 24  # texels along a grid's longer side
_EVEN_SPREAD = 100.0  # spread of a grid that is even, in sizes of its body
_ROUNDING = 1e-6  # how far off a face a point may lie and still count as on it, as a part of the face or texel
_WHOLE = 1e-4  # share of its rectangle up to which gaps of a mesh do not count
# points along each side of a texel that are tested to lie on the mesh; odd, so that its middle is one
_TESTS_PER_SIDE = 3


class PlaneTexture(NamedTuple):
    """Texels in a plane, even in coordinates that are stretched far from the middle.

    A point has the coordinates (a, b, d) = frame (x − origin). With

        ξ = g(a / spread),  η = g(b / spread),  g(z) = sign(z) log(1 + |z|)

    texels divide the rectangle from ``low`` to ``high`` evenly in ξ and in η, row by row in η.
    """

    frame: np.ndarray  # rows: both axes and the normal, float64 of shape [3, 3]
    origin: np.ndarray  # point of the plane around which texels are small, float64 of shape [3]
    spread: float  # distance from there within which texels are about even [units of the body]
    low: np.ndarray
    high: np.ndarray  # corners of the rectangle in (ξ, η), float64 of shape [2]
    covered: np.ndarray  # share of each texel that the mesh covers, float32 of shape [row, column]
    sides: int  # 1 if the front alone sends light, 2 if the back does, too; its patches follow the front's
    outline: np.ndarray  # edges (a, b) around the mesh and its holes, the mesh to their left, float64 [edge, 2, 2]

    @property
    def is_whole(self) -> bool:
        """Whether the mesh covers the rectangle."""
        (a, b), (low, high) = self.outline.swapaxes(0, 1), self.corners()
        area = (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum() / 2
        return bool((self.covered == 1).all() and area > (1 - _WHOLE) * (high - low).prod())

    def rectangle(self) -> np.ndarray:
        """Edges of the rectangle, as the outline's are, [4, 2, 2]."""
        (left, below), (right, above) = self.corners()
        corners = np.array([[left, below], [right, below], [right, above], [left, above]])
        return np.stack([corners, np.roll(corners, -1, axis=0)], axis=1)

    def corners(self) -> np.ndarray:
        """Corners of the rectangle in the plane, (a, b), float64 of shape [2, 2]."""
        return self.spread * stretched(np.stack([self.low, self.high]))

    def middles(self) -> np.ndarray:
        """Middles of the texels in the plane, (a, b), float64 of shape [row, column, 2]."""
        return self.points(1)

    def texel_sizes(self) -> np.ndarray:
        """Widths and heights of the texels at their middles, [row, column, 2]."""
        count = np.array(self.covered.shape[::-1])
        edges = [
            self.spread * stretched(np.linspace(low, high, number + 1))
            for low, high, number in zip(self.low, self.high, count, strict=True)
        ]
        return np.stack(np.meshgrid(*map(np.diff, edges)), axis=-1)

    def in_texels(self, points: np.ndarray) -> np.ndarray:
        """Where points (a, b) are [..., 2], in texels from the corner ``low``."""
        height, width = self.covered.shape
        return (squeezed(points / self.spread) - self.low) / (self.high - self.low) * (width, height)

    def texels_of(self, points: np.ndarray) -> np.ndarray:
        """Number of the texel that is nearest to each point (a, b) [point, 2]."""
        height, width = self.covered.shape
        column, row = np.clip(self.in_texels(points).astype(int), 0, (width - 1, height - 1)).T
        return row * width + column

    def points(self, split: int) -> np.ndarray:
        """Points evenly over every texel, ``split`` along each side: [row · split, column · split, 2]."""
        height, width = self.covered.shape
        axes = [
            self.spread * stretched(low + (high - low) * (np.arange(number) + 0.5) / number)
            for low, high, number in zip(self.low, self.high, (width * split, height * split), strict=True)
        ]
        return np.stack(np.meshgrid(*axes), axis=-1)


def squeezed(z: np.ndarray) -> np.ndarray:
    """g(z) = sign(z) log(1 + |z|): steps are as long as the distance from the middle, but no shorter than there."""
    return np.sign(z) * np.log1p(np.abs(z))


def stretched(y: np.ndarray) -> np.ndarray:
    """The inverse of :func:`squeezed`."""
    return np.sign(y) * np.expm1(np.abs(y))


class CoveredPoints(NamedTuple):
    """Points of the mesh, one in each texel of a grid that it covers, as near as may be to the texel's middle."""

    faces: np.ndarray  # [point]
    barycentrics: np.ndarray  # [point, 3]
    texels: np.ndarray  # [point]


def find_grid(
    positions: np.ndarray, faces: np.ndarray, *, is_two_sided: bool, others: np.ndarray | None = None
) -> tuple[PlaneTexture, CoveredPoints]:
    """Find the grid of a body that lies in a plane, over its smallest rectangle.

    Args:
        positions: Vertices [units of the body], shape [vertex, 3].
        faces: Faces that wind alike, shape [face, 3].
        is_two_sided: Whether the back sends light, too.
        others: Points of the scene's other bodies, in this body's frame, shape [point, 3]: texels are small near them.
            None for an even grid.
    Returns:
        The grid, and a point in each texel of which the mesh covers some.
    Raises:
        ValueError: for a body that does not lie in a plane.
    """
    corners = positions.astype(np.float64)[faces]
    normal = plane_normal(corners)
    if normal is None:
        raise ValueError(f"faces: got {len(faces)} that do not lie in one plane, expected a flat body")
    frame = _smallest_rectangle(corners.reshape(-1, 3), normal)
    points = corners.reshape(-1, 3) @ frame.T
    low, high = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
    middle, spread = (low + high) / 2, _EVEN_SPREAD * (high - low).max()
    if others is not None and len(others):
        near = others @ frame.T[:, :2]
        reach = np.ptp(near, axis=0).max() / 2
        if reach > 0:
            middle, spread = (near.min(axis=0) + near.max(axis=0)) / 2, min(reach, spread)
    origin = frame.T @ [*middle, points[:, 2].mean()]
    low, high = squeezed((low - middle) / spread), squeezed((high - middle) / spread)
    width, height = np.maximum(np.rint(_GRID * (high - low) / (high - low).max()), 1).astype(int)
    sides = 2 if is_two_sided else 1
    corners = ((corners - origin) @ frame.T)[..., :2]
    _, first, place = np.unique(positions, axis=0, return_index=True, return_inverse=True)
    in_plane = (positions[first].astype(np.float64) - origin) @ frame[:2].T
    outline = in_plane[find_outline(in_plane, place.reshape(-1)[faces])]
    whole = np.ones((height, width), np.float32)
    grid = PlaneTexture(frame, origin, float(spread), low, high, whole, sides, outline)
    covered, result = _find_covered(grid, corners)
    return grid._replace(covered=covered), result


def _smallest_rectangle(points: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Axes of the smallest rectangle around points of a plane, and its normal, as rows."""
    from scipy.spatial import ConvexHull

    aside = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
    basis = np.stack([aside, np.cross(normal, aside)]) / np.linalg.norm(aside)
    flat = points @ basis.T
    hull = flat[ConvexHull(flat).vertices]
    edges = np.roll(hull, -1, axis=0) - hull
    edges = edges[edges.any(axis=1)]
    edges = edges / np.linalg.norm(edges, axis=1, keepdims=True)
    normals_of_edges = np.stack([-edges[:, 1], edges[:, 0]], axis=1)
    sizes = np.ptp(hull @ edges.T, axis=0) * np.ptp(hull @ normals_of_edges.T, axis=0)
    best = np.flatnonzero(sizes < sizes.min() * (1 + 1e-6))[0]
    return np.stack([edges[best] @ basis, normals_of_edges[best] @ basis, normal])


def _find_covered(grid: PlaneTexture, corners: np.ndarray) -> tuple[np.ndarray, CoveredPoints]:
    """Find which share of each texel the faces [face, 3, 2] cover, and a point in each that is not empty."""
    height, width = grid.covered.shape
    points = grid.points(_TESTS_PER_SIDE)
    shape = np.array([width, height]) * _TESTS_PER_SIDE
    places = grid.in_texels(corners) * _TESTS_PER_SIDE - 0.5
    first = np.maximum(np.ceil(places.min(axis=1) - _ROUNDING), 0).astype(int)
    last = np.minimum(np.floor(places.max(axis=1) + _ROUNDING), shape - 1).astype(int)
    counts = np.maximum(last - first + 1, 0)
    faces = np.repeat(np.arange(len(corners)), counts.prod(axis=1))
    number = np.arange(len(faces)) - np.repeat(
        np.cumsum(counts.prod(axis=1)) - counts.prod(axis=1), counts.prod(axis=1)
    )
    column = first[faces, 0] + number % counts[faces, 0]
    row = first[faces, 1] + number // counts[faces, 0]
    barycentrics = _barycentrics(corners[faces], points[row, column])
    inside = (barycentrics > -_ROUNDING).all(axis=1)
    owner = np.full(points.shape[:2], -1)
    owner[row[inside], column[inside]] = np.flatnonzero(inside)
    tested = owner.reshape(height, _TESTS_PER_SIDE, width, _TESTS_PER_SIDE).swapaxes(1, 2).reshape(height * width, -1)
    covered = (tested >= 0).mean(axis=1)
    from_middle = np.abs(np.arange(_TESTS_PER_SIDE**2) - _TESTS_PER_SIDE**2 // 2).argsort(kind="stable")
    best = (tested[:, from_middle] >= 0).argmax(axis=1)
    chosen = tested[np.arange(len(tested)), from_middle[best]]
    texels = np.flatnonzero(chosen >= 0)
    result = CoveredPoints(faces[chosen[texels]], np.maximum(barycentrics[chosen[texels]], 0), texels)
    return covered.reshape(height, width).astype(np.float32), result


def _barycentrics(triangles: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Barycentric coordinates of points [item, 2] in triangles [item, 3, 2]; NaN in triangles without an area."""
    a, b, c = np.moveaxis(triangles - points[:, None], 1, 0)
    parts = np.stack([_cross(b, c), _cross(c, a), _cross(a, b)], axis=1)
    total = parts.sum(axis=1, keepdims=True)
    return parts / np.where(total != 0, total, np.nan)


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
