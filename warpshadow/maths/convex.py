"""Convex decomposition of a mesh.

Parts are closed convex pieces, such as the boxes and rods of furniture; convex prisms of other pieces, such as a thick
wall with a window; segments of bent rods; panels of sheets and of the outer layers of thin walls.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from warpshadow.maths.adjacency import area_normals, edges_of
from warpshadow.maths.components import connected_components
from warpshadow.maths.outline import cut_outline, find_outline
from warpshadow.maths.panels import MAX_FLAT_PANELS_OF, MAX_PANELS_OF, find_panels_of_sheets
from warpshadow.maths.thin_walls import find_layer
from warpshadow.maths.tubes import MAX_SEGMENTS, find_tube

MAX_FACES = 64  # of a part; a cylinder of 48 sides has 50

MAX_PRISMS = 64
"""Maximum number of prisms of a piece. A wall with a door and a round window of 48 edges has 49: an image of 64²,
with the sun behind it, is 2.2% off. Past 1024 spheres, between which the sun leaks, it is 6.4% off, in 0.4 times the
time, after a fit of 18 s. A gear with five round holes has 300: as many spheres are faster."""

_FEW_PRISMS = 32  # a tube with more prisms has segments instead: a washer of 48 sides has 24 segments

_MAX_AXES = 8  # normals of the largest faces that are tried as the axis of a prism

_MAX_TRIANGLES = 16 * MAX_FACES  # of a solid, whose faces may be subdivided

_FLATNESS = 1e-4
"""Vertices lie in the plane of a face, and on a straight edge, up to this distance over the size of the part;
neighboring triangles are coplanar up to this 1 − cos α."""

_MAX_HOLES = 0.05
"""Maximum length of the boundary of a thin wall, over its size. A lathe's profile that does not reach the axis leaves a
pinhole."""

_TWIST = 5e-3  # the flatness of segments of bent tubes, whose sides twist


class ConvexPart(NamedTuple):
    """A closed convex solid, coplanar triangles merged into faces; or a panel, whose two faces are its sides."""

    corners: np.ndarray  # indices of vertices of the mesh, int of shape [corner]
    faces: np.ndarray
    """Three corners of each face, counterclockwise from outside, indices of corners, shape [face, 3]."""
    edges: np.ndarray  # ends of each edge, indices of corners, and the faces to its left and right, [edge, 4]
    is_seam: bool = False
    """Whether it is a face that two prisms share. Both cover it when seen at a slant, so its coverage is subtracted."""
    piece: int = 0  # index of the piece of the mesh. Parts of one piece do not overlap.
    gap: float = 0.0
    """Largest distance of the mesh from a part that approximates a bent piece, over the radius of the part."""


def is_panel(part: ConvexPart) -> bool:
    """Whether a part is a panel, which encloses no volume."""
    return len(part.faces) == 2 and not part.is_seam


def is_convex(positions: np.ndarray, faces: np.ndarray) -> bool:
    """Whether a closed mesh is convex: its volume is that of its convex hull, up to a ten-thousandth.

    Args:
        positions: Vertices, shape [vertex, 3].
        faces: Consistently wound triangles, shape [face, 3].
    """
    from scipy.spatial import ConvexHull

    points = positions[np.unique(faces)].astype(np.float64)
    corners = positions[faces] - points.mean(axis=0)
    volume = (area_normals(corners) * corners[:, 0]).sum() / 6
    return bool(abs(volume) > (1 - _FLATNESS) * ConvexHull(points).volume)


def find_convex_parts(
    positions: np.ndarray, faces: np.ndarray, *, flat_panels: bool = False
) -> list[ConvexPart] | None:
    """Decompose a mesh into convex parts.

    Args:
        positions: Vertices, shape [vertex, 3]; vertices at one position count as one.
        faces: Consistently wound triangles, shape [face, 3].
        flat_panels: Whether panels must be flat, so that bent sheets have none.

    Returns:
        The parts, sorted by piece, in each the seams last; parts of different pieces may overlap. A closed piece is a
        convex solid, prisms (if it is a prism itself, with holes or without), or segments of a bent tube. An open piece
        is panels; sheets that share edges are one piece. A thin wall (:mod:`.thin_walls`), closed but for pinholes, has
        one-sided panels: those for receivers outside are one piece, those for receivers inside another, since a
        receiver may see both walls of a mug. None if a closed piece is hollow or curved otherwise, if a part has more
        than 64 faces, or with more than 64 prisms of a piece, 128 segments of all tubes, or 352 panels (64 flat ones).
    """
    _, first, vertex = np.unique(positions, axis=0, return_index=True, return_inverse=True)
    triangles = vertex.reshape(-1)[faces]
    triangles = triangles[(triangles != np.roll(triangles, 1, axis=1)).all(axis=1)]
    if not len(triangles):
        return None
    points, pieces, sheets, layers = positions.astype(np.float64)[first], [], [], []
    segment_count = 0
    piece = _pieces(triangles)
    for number in range(piece.max() + 1):
        piece_triangles = triangles[piece == number]
        boundary, parts_of_piece = _boundary_length(points, piece_triangles), None
        if not boundary:
            solid = _solid(points, piece_triangles)
            parts_of_piece = [solid] if solid else _prisms(points, piece_triangles)
            if parts_of_piece is None or _solid_count(parts_of_piece) > _FEW_PRISMS:
                segments = _segments(points, piece_triangles, MAX_SEGMENTS - segment_count)
                segment_count += _solid_count(segments or [])
                parts_of_piece = segments or parts_of_piece
        if parts_of_piece is not None:
            pieces.append(parts_of_piece)
            continue
        has_layer = boundary <= _MAX_HOLES and not flat_panels
        layer = find_layer(points, piece_triangles) if has_layer else None
        if layer is not None:
            layers.append(layer)
        elif boundary:
            sheets.append(piece_triangles)
        else:
            return None
    max_panels_of = MAX_FLAT_PANELS_OF if flat_panels else MAX_PANELS_OF
    panels = find_panels_of_sheets(points, [*sheets, *layers], max_panels_of)
    if panels is None:
        return None
    panels_of_group: dict[int, list[ConvexPart]] = {}
    for number, panels_of_sheet in zip(_groups(sheets).tolist(), panels, strict=False):
        panels_of_group.setdefault(number, []).extend(map(_panel, panels_of_sheet))
    pieces += filter(None, panels_of_group.values())
    for layer, polygons in zip(layers, panels[len(sheets) :], strict=True):
        pieces += _one_sided_panels(points, layer, polygons)
    return [
        part._replace(corners=first[part.corners], piece=number)
        for number, parts in enumerate(pieces)
        for part in parts
    ]


def _solid_count(parts: Sequence[ConvexPart]) -> int:
    """Number of parts without seams."""
    return sum(not part.is_seam for part in parts)


def _pieces(triangles: np.ndarray) -> np.ndarray:
    """Index of the piece of each triangle; at non-manifold edges, adjacent triangles in the list are joined."""
    edges, count = np.sort(edges_of(triangles), axis=1), len(triangles)
    _, edge, counts = np.unique(edges, axis=0, return_inverse=True, return_counts=True)
    permutation = np.lexsort((np.arange(len(edges)) % count, edge.reshape(-1)))
    pairs = permutation[np.repeat(counts % 2 == 0, counts)].reshape(-1, 2) % count
    return connected_components(pairs[:, 0], pairs[:, 1], count)


def _groups(sheets: list[np.ndarray]) -> np.ndarray:
    """Index of the group of each sheet; sheets that share edges, such as walls that meet in a T, are one group."""
    edges, none = [np.unique(np.sort(edges_of(sheet), axis=1), axis=0) for sheet in sheets], np.zeros((0, 2), int)
    sheet = np.repeat(np.arange(len(sheets)), list(map(len, edges)))
    _, edge = np.unique(np.concatenate([none, *edges]), axis=0, return_inverse=True)
    permutation = np.argsort(edge.reshape(-1), kind="stable")
    is_shared = np.diff(edge.reshape(-1)[permutation]) == 0
    return connected_components(sheet[permutation[:-1][is_shared]], sheet[permutation[1:][is_shared]], len(sheets))


def _boundary_length(points: np.ndarray, triangles: np.ndarray) -> float:
    """Length of the boundary of triangles over their size; 0 if they are closed."""
    edges, counts = np.unique(np.sort(edges_of(triangles), axis=1), axis=0, return_counts=True)
    ends = points[edges[counts % 2 == 1]]
    return float(np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1).sum() / np.ptp(points[triangles], axis=(0, 1)).max())


def _panel(corners: np.ndarray) -> ConvexPart:
    """Make a panel of its corners in order."""
    count = len(corners)
    one_third, two_thirds = count // 3, 2 * count // 3
    sides = np.array([[0, one_third, two_thirds], [0, two_thirds, one_third]])
    begin = np.arange(count)
    edges = np.stack([begin, np.roll(begin, -1), np.zeros(count, int), np.ones(count, int)], axis=1)
    return ConvexPart(corners, sides, edges)


def _one_sided_panels(
    points: np.ndarray, triangles: np.ndarray, polygons: Sequence[np.ndarray]
) -> tuple[list[ConvexPart], list[ConvexPart]]:
    """Make one-sided panels of a layer: some block for receivers outside, the others for receivers inside."""
    corners = points[triangles]
    normals = np.repeat(area_normals(corners), 3, axis=0)
    vertex_normals = np.zeros_like(points)
    np.add.at(vertex_normals, triangles.ravel(), normals)
    panels: tuple[list[ConvexPart], list[ConvexPart]] = [], []
    for polygon in polygons:
        spokes = points[polygon] - points[polygon[0]]
        normal = np.cross(spokes, np.roll(spokes, -1, axis=0)).sum(axis=0)
        outside = polygon if normal @ vertex_normals[polygon].sum(axis=0) > 0 else polygon[::-1]
        for side, corners_of_side in zip(panels, (outside, outside[::-1]), strict=True):
            panel = _panel(corners_of_side)
            panel.faces[1] = 0  # degenerate: its back is never seen
            side.append(panel)
    return panels


def _solid(points: np.ndarray, triangles: np.ndarray, flatness: float = _FLATNESS) -> ConvexPart | None:
    """The convex solid that triangles enclose; None if it is not convex."""
    if len(triangles) > _MAX_TRIANGLES:
        return None
    edges, count = edges_of(triangles), len(triangles)
    triangle_at = {(a, b): number % count for number, (a, b) in enumerate(edges.tolist())}
    if len(triangle_at) != len(edges) or not all((b, a) in triangle_at for a, b in triangle_at):
        return None
    used_vertices = np.unique(triangles)
    corners = points[triangles] - points[used_vertices].mean(axis=0)
    normals = area_normals(corners)
    volume, size = (normals * corners[:, 0]).sum() / 6, np.ptp(points[used_vertices], axis=0).max()
    if volume < 0:
        return _solid(points, triangles[:, ::-1], flatness)
    lengths = np.linalg.norm(normals, axis=1)
    if volume <= flatness**2 * size**3 or not lengths.all():
        return None
    units = normals / lengths[:, None]
    heights = (points[used_vertices] - points[triangles[:, 0]][:, None]) @ units[..., None]  # [triangle, vertex, 1]
    if heights.max() > flatness * size:
        return None
    right = np.array([triangle_at[b, a] for a, b in edges.tolist()])
    left = np.tile(np.arange(count), 3)
    is_flat = (units[left] * units[right]).sum(axis=1) > 1 - flatness
    pairs = np.stack([left, right])[:, is_flat]
    face = connected_components(pairs[0], pairs[1], count)
    face_count = face.max() + 1
    if face_count > MAX_FACES:
        return None
    largest_faces = [np.flatnonzero(face == number)[lengths[face == number].argmax()] for number in range(face_count)]
    plane_offsets = points[triangles] - points[triangles[largest_faces, 0]][face][:, None]
    if np.abs(plane_offsets @ units[largest_faces][face][..., None]).max() > flatness * size:
        return None  # small bends add up to a curve
    runs: dict[tuple[int, int], list[list[int]]] = {}
    for (a, b), f, g in zip(edges.tolist(), face[left].tolist(), face[right].tolist(), strict=True):
        if f < g:
            runs.setdefault((f, g), []).append([a, b])
    straight = []
    for (f, g), run in runs.items():  # collinear edges must form one chain
        starts, ends = map(set, zip(*run, strict=True))
        if len(starts - ends) != 1 or len(ends - starts) != 1:
            return None
        (begin,), (end,) = starts - ends, ends - starts
        if _bulge(points[[*starts | ends]], points[begin], points[end]) > flatness * size:
            return None
        straight.append([begin, end, f, g])
    straight_edges = np.array(straight)
    straight_edges[:, :2] = np.searchsorted(used_vertices, straight_edges[:, :2])  # to indices of corners
    return ConvexPart(used_vertices, np.searchsorted(used_vertices, triangles[largest_faces]), straight_edges)


def _prisms(points: np.ndarray, triangles: np.ndarray) -> list[ConvexPart] | None:
    """Convex prisms of the prism that triangles enclose; None if it is no prism."""
    corners = points[triangles]
    normals = area_normals(corners)
    lengths = np.linalg.norm(normals, axis=1)
    permutation = np.argsort(-lengths)[: np.count_nonzero(lengths)]
    axes = normals[permutation] / lengths[permutation, None]
    for _ in range(_MAX_AXES):
        if not len(axes):
            return None
        prisms = _prisms_along(axes[0], points, triangles, normals)
        if prisms is not None:
            return prisms
        axes = axes[np.abs(axes @ axes[0]) < 1 - _FLATNESS]
    return None


def _prisms_along(
    axis: np.ndarray, points: np.ndarray, triangles: np.ndarray, normals: np.ndarray
) -> list[ConvexPart] | None:
    """Convex prisms along an axis."""
    from scipy.spatial import cKDTree

    used_vertices = np.unique(triangles)
    heights, size = points @ axis, np.ptp(points[used_vertices], axis=0).max()
    low, high = heights[used_vertices].min(), heights[used_vertices].max()
    is_high, is_low = (np.abs(heights - level) < _FLATNESS * size for level in (high, low))
    on_top, on_bottom = is_high[triangles].all(axis=1), is_low[triangles].all(axis=1)
    is_side = np.abs(normals @ axis) > _FLATNESS * size**2
    if (
        high - low < 2 * _FLATNESS * size
        or not (is_high | is_low)[used_vertices].all()
        or is_side[~(on_top | on_bottom)].any()
    ):
        return None
    tangent = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    plane = points @ np.stack([tangent, np.cross(axis, tangent)]).T / np.linalg.norm(tangent)
    polygons = cut_outline(plane, find_outline(plane, triangles[on_top]), MAX_PRISMS)
    bottom = np.unique(find_outline(plane, triangles[on_bottom]))
    if not polygons or max(map(len, polygons)) > MAX_FACES - 2 or not len(bottom):
        return None
    gaps, below = cKDTree(plane[bottom]).query(plane[np.concatenate(polygons)])
    if gaps.max() > _FLATNESS * size:
        return None
    below_top = dict(zip(np.concatenate(polygons).tolist(), bottom[below].tolist(), strict=True))
    prisms = [_prism(polygon, np.array([below_top[corner] for corner in polygon.tolist()])) for polygon in polygons]
    seams = [[a, b, below_top[b], below_top[a]] for a, b in _shared_sides(plane, polygons)]
    return prisms + [_panel(np.array(corners))._replace(is_seam=True) for corners in seams]


def _segments(points: np.ndarray, triangles: np.ndarray, maximum: int) -> list[ConvexPart] | None:
    """Straight segments of the tube that triangles enclose; None if it is no tube."""
    tube = find_tube(points, triangles, maximum)
    if tube is None:
        return None
    parts = []
    for segment, gap in zip(tube.segments, tube.gaps.tolist(), strict=True):
        solid = _solid(points, segment, _TWIST)
        if solid is None:
            return None
        corners = points[solid.corners]
        radius = np.linalg.norm(corners - corners.mean(axis=0), axis=1).max()
        parts.append(solid._replace(gap=gap / radius + _TWIST))
    sections = tube.sections
    is_closed = (sections[0] == sections[-1]).all()
    return parts + [_panel(section)._replace(is_seam=True) for section in sections[int(not is_closed) : -1]]


def _shared_sides(plane: np.ndarray, polygons: Sequence[np.ndarray]) -> list[tuple[int, int]]:
    """Indices of the points at both ends of each line along which two polygons in a plane touch."""
    ends = np.concatenate([np.stack([polygon, np.roll(polygon, -1)], axis=1) for polygon in polygons])
    starts, side_vectors = plane[ends[:, 0]], plane[ends[:, 1]] - plane[ends[:, 0]]
    lengths = np.linalg.norm(side_vectors, axis=1)
    offsets = plane[ends] - starts[:, None, None]  # [side, other side, end, 2]
    units = side_vectors / lengths[:, None]
    positions = np.einsum("sotx,sx->sot", offsets, units)
    heights = np.abs(offsets[..., 0] * units[:, None, None, 1] - offsets[..., 1] * units[:, None, None, 0]).max(axis=2)
    size = lengths.max()
    first, last = np.maximum(positions[..., 1], 0), np.minimum(positions[..., 0], lengths[:, None])
    is_shared = (
        (heights < _FLATNESS * size) & (positions[..., 0] > positions[..., 1]) & (last - first > _FLATNESS * size)
    )
    seams = set()
    for side, other in np.argwhere(is_shared).tolist():
        begin = ends[side, 0] if positions[side, other, 1] <= _FLATNESS * size else ends[other, 1]
        end = ends[side, 1] if positions[side, other, 0] >= lengths[side] - _FLATNESS * size else ends[other, 0]
        seams.add((int(min(begin, end)), int(max(begin, end))))
    return sorted(seams)


def _prism(top: np.ndarray, bottom: np.ndarray) -> ConvexPart:
    """Make a prism of the corners of its top, counterclockwise from above, and the corners below them."""
    count = len(top)
    begin, one_third = np.arange(count), count // 3
    end = np.roll(begin, -1)
    face, bases = (
        begin + 2,
        np.array([[0, one_third, 2 * one_third], [count, count + 2 * one_third, count + one_third]]),
    )
    sides = np.stack([count + begin, count + end, end], axis=1)
    around_top = np.stack([begin, end, np.zeros_like(begin), face], axis=1)
    around_bottom = np.stack([count + begin, count + end, face, np.ones_like(begin)], axis=1)
    upward = np.stack([count + end, end, face, np.roll(face, -1)], axis=1)
    faces, edges = np.concatenate([bases, sides]), np.concatenate([around_top, around_bottom, upward])
    return ConvexPart(np.concatenate([top, bottom]), faces, edges)


def _bulge(points: np.ndarray, begin: np.ndarray, end: np.ndarray) -> float:
    """Largest distance of points from a line."""
    direction = (end - begin) / np.linalg.norm(end - begin)
    return float(np.linalg.norm(np.cross(points - begin, direction), axis=1).max())
