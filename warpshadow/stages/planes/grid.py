"""Grids: texels in the plane of a flat body, small near the other bodies, and the mesh's coverage of them."""

from typing import NamedTuple

import numpy as np

from warpshadow.maths.contacts import Contact
from warpshadow.maths.outline import find_outline
from warpshadow.maths.plane import plane_normal

_GRID = 24  # texels along a grid's longer side …
_GRID_OF_CONTACT = 28  # … and of a grid around a contact
_CONTACT_SPREAD = 0.05  # within how far of a contact texels are about even, in units of its size
_EVEN_SPREAD = 100.0  # spread of a grid that is even, in sizes of its body
_ROUNDING = 1e-6  # how far off a face a point may lie and still count as on it, as a part of the face or texel
_WHOLE = 1e-4  # share of its rectangle up to which gaps of a mesh do not count
_HIDDEN_WEIGHT = 1e-5  # of a texel that another plane hides; much less than the weight of texels in their neighbors …
_MAX_HIDING = 5  # … for each of so many planes, so that products do not underflow
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
    texel_weights: np.ndarray  # weight of each texel, 1 unless another plane hides it, float32 of shape [row, column]
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
            self.spread * stretched(np.linspace(low, high, axis_count + 1))
            for low, high, axis_count in zip(self.low, self.high, count, strict=True)
        ]
        return np.stack(np.meshgrid(*map(np.diff, edges)), axis=-1)

    def in_texels(self, points: np.ndarray) -> np.ndarray:
        """Map points (a, b) [..., 2] to texels, counted from the corner ``low``."""
        height, width = self.covered.shape
        return (squeezed(points / self.spread) - self.low) / (self.high - self.low) * (width, height)

    def texels_of(self, points: np.ndarray) -> np.ndarray:
        """Number of the texel that is nearest to each point (a, b) [point, 2]."""
        height, width = self.covered.shape
        column, row = np.clip(self.in_texels(points).astype(int), 0, (width - 1, height - 1)).T
        return row * width + column

    def points(self, points_per_texel: int) -> np.ndarray:
        """Points evenly over every texel, ``points_per_texel`` along each side.

        Float64 of shape [row · points_per_texel, column · points_per_texel, 2].
        """
        height, width = self.covered.shape
        axes = [
            self.spread * stretched(low + (high - low) * (np.arange(axis_count) + 0.5) / axis_count)
            for low, high, axis_count in zip(
                self.low, self.high, (width * points_per_texel, height * points_per_texel), strict=True
            )
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
    positions: np.ndarray,
    faces: np.ndarray,
    *,
    is_two_sided: bool,
    others: np.ndarray | None = None,
    contact: Contact | None = None,
    half_spaces: np.ndarray | None = None,
) -> tuple[PlaneTexture, CoveredPoints]:
    """Find the grid of a body that lies in a plane, over its smallest rectangle.

    Args:
        positions, faces: Vertices [units of the body], shape [vertex, 3], and faces that wind alike, [face, 3].
        is_two_sided: Whether the back sends light, too.
        others: Points of the scene's other bodies, in this body's frame, shape [point, 3]: texels are small near them.
            None for an even grid.
        contact: Where another body touches this one, in its frame, if texels are to be smallest there.
        half_spaces: Other planes (n, d), in its frame, shape [plane, 4]: n·x + d is positive on the side from which
            they are seen. A texel that one of them crosses, as a wall does a ground, has its point on that side, and
            beside it texels behind the plane hardly count.
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
    center, spread = (low + high) / 2, _EVEN_SPREAD * (high - low).max()
    if others is not None and len(others):
        nearby_points = others @ frame.T[:, :2]
        nearby_radius = np.ptp(nearby_points, axis=0).max() / 2
        if nearby_radius > 0:
            center, spread = (nearby_points.min(axis=0) + nearby_points.max(axis=0)) / 2, min(nearby_radius, spread)
    count = _GRID
    if contact is not None:
        center, count = contact.points.mean(axis=0) @ frame.T[:, :2], _GRID_OF_CONTACT
        spread = min(_CONTACT_SPREAD * contact.half_size, spread)
    origin = frame.T @ [*center, points[:, 2].mean()]
    low, high = squeezed((low - center) / spread), squeezed((high - center) / spread)
    width, height = np.maximum(np.rint(count * (high - low) / (high - low).max()), 1).astype(int)
    sides = 2 if is_two_sided else 1
    corners = ((corners - origin) @ frame.T)[..., :2]
    _, unique_vertices, vertex_index = np.unique(positions, axis=0, return_index=True, return_inverse=True)
    vertices_in_plane = (positions[unique_vertices].astype(np.float64) - origin) @ frame[:2].T
    outline = vertices_in_plane[find_outline(vertices_in_plane, vertex_index.reshape(-1)[faces])]
    full_coverage = np.ones((height, width), np.float32)
    grid = PlaneTexture(frame, origin, float(spread), low, high, full_coverage, sides, full_coverage, outline)
    return _with_covered(grid, corners, np.empty((0, 4)) if half_spaces is None else half_spaces)


def _smallest_rectangle(points: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Axes of the smallest rectangle around points of a plane, and its normal, as rows."""
    from scipy.spatial import ConvexHull

    tangent = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
    basis = np.stack([tangent, np.cross(normal, tangent)]) / np.linalg.norm(tangent)
    flat = points @ basis.T
    hull = flat[ConvexHull(flat).vertices]
    edges = np.roll(hull, -1, axis=0) - hull
    edges = edges[edges.any(axis=1)]
    edges = edges / np.linalg.norm(edges, axis=1, keepdims=True)
    normals_of_edges = np.stack([-edges[:, 1], edges[:, 0]], axis=1)
    sizes = np.ptp(hull @ edges.T, axis=0) * np.ptp(hull @ normals_of_edges.T, axis=0)
    smallest = np.flatnonzero(sizes < sizes.min() * (1 + 1e-6))[0]
    return np.stack([edges[smallest] @ basis, normals_of_edges[smallest] @ basis, normal])


def _with_covered(
    grid: PlaneTexture, corners: np.ndarray, half_spaces: np.ndarray
) -> tuple[PlaneTexture, CoveredPoints]:
    """Find which share of each texel the faces [face, 3, 2] cover, a point in each that is not empty, and weights."""
    height, width = grid.covered.shape
    points = grid.points(_TESTS_PER_SIDE)
    shape = np.array([width, height]) * _TESTS_PER_SIDE
    grid_coordinates = grid.in_texels(corners) * _TESTS_PER_SIDE - 0.5
    test_starts = np.maximum(np.ceil(grid_coordinates.min(axis=1) - _ROUNDING), 0).astype(int)
    test_ends = np.minimum(np.floor(grid_coordinates.max(axis=1) + _ROUNDING), shape - 1).astype(int)
    counts = np.maximum(test_ends - test_starts + 1, 0)
    faces = np.repeat(np.arange(len(corners)), counts.prod(axis=1))
    point_indices = np.arange(len(faces)) - np.repeat(
        np.cumsum(counts.prod(axis=1)) - counts.prod(axis=1), counts.prod(axis=1)
    )
    column = test_starts[faces, 0] + point_indices % counts[faces, 0]
    row = test_starts[faces, 1] + point_indices // counts[faces, 0]
    barycentrics = _barycentrics(corners[faces], points[row, column])
    is_inside = (barycentrics > -_ROUNDING).all(axis=1)
    pieces_of_points = np.full(points.shape[:2], -1)
    pieces_of_points[row[is_inside], column[is_inside]] = np.flatnonzero(is_inside)

    def by_texel(values: np.ndarray) -> np.ndarray:
        """Values of the points of each texel, [texel, point]."""
        parted = values.reshape(height, _TESTS_PER_SIDE, width, _TESTS_PER_SIDE)
        return parted.swapaxes(1, 2).reshape(height * width, -1)

    pieces_of_texels = by_texel(pieces_of_points)
    hidden_counts = by_texel(_count_hiding(grid, points, half_spaces))
    off_centers = np.abs(np.arange(_TESTS_PER_SIDE**2) - _TESTS_PER_SIDE**2 // 2)
    ranks = np.where(pieces_of_texels >= 0, hidden_counts * _TESTS_PER_SIDE**2 + off_centers, np.iinfo(int).max)
    chosen = np.arange(len(ranks)), ranks.argmin(axis=1)
    chosen_pieces, chosen_counts = pieces_of_texels[chosen], hidden_counts[chosen]
    texels = np.flatnonzero(chosen_pieces >= 0)
    min_count = chosen_counts[texels].min(initial=chosen_counts.max())
    texel_weights = np.float32(_HIDDEN_WEIGHT) ** np.minimum(chosen_counts - min_count, _MAX_HIDING)
    covered = (pieces_of_texels >= 0).mean(axis=1).astype(np.float32)
    grid = grid._replace(covered=covered.reshape(height, width), texel_weights=texel_weights.reshape(height, width))
    chosen_barycentrics = np.maximum(barycentrics[chosen_pieces[texels]], 0)
    return grid, CoveredPoints(faces[chosen_pieces[texels]], chosen_barycentrics, texels)


def _count_hiding(grid: PlaneTexture, points: np.ndarray, half_spaces: np.ndarray) -> np.ndarray:
    """Count the planes behind which points (a, b) [row, column, 2] of a grid lie."""
    heights = (grid.origin + points @ grid.frame[:2]) @ half_spaces[:, :3].T + half_spaces[:, 3]
    return (heights < -_ROUNDING * np.abs(grid.corners()).max()).sum(axis=-1)


def _barycentrics(triangles: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Barycentric coordinates of points [item, 2] in triangles [item, 3, 2]; NaN in triangles without an area."""
    a, b, c = np.moveaxis(triangles - points[:, None], 1, 0)
    areas = np.stack([_cross(b, c), _cross(c, a), _cross(a, b)], axis=1)
    area_sum = areas.sum(axis=1, keepdims=True)
    return areas / np.where(area_sum != 0, area_sum, np.nan)


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
