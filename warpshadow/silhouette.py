"""Silhouettes: edges that a rasterized image has between pixels, smoothed so that their gradient moves vertices.

Where two neighboring pixels see different faces and a silhouette edge of the nearer one runs between their centers, the
pixel whose half the edge cuts takes that share of the other's color (Laine et al. 2020, section 3.5):

    t = where the edge crosses the line from the nearer pixel's center (0) to the other's (1)
    t > ½: the other pixel takes t − ½ of the nearer's color;   t < ½: the nearer takes ½ − t of the other's
"""

import functools

import numpy as np
import warp as wp

from warpshadow import check
from warpshadow.raster import Fragments

MOST_STEPS = 32
"""Faces that are walked over between the centers of two pixels before the search for an edge is given up."""

_NOT_MANIFOLD = -2


def edge_neighbors(faces: np.ndarray, positions: np.ndarray | None = None) -> np.ndarray:
    """Find the face on the other side of each edge.

    Args:
        faces: Indices of positions, shape [face, 3]: edges belong together by position topology, whatever the uvs.
        positions: Vertices, shape [vertex, 3]; when given, those at the same place count as one, as a mesh needs
            whose faces have vertices of their own.

    Returns:
        Face across the edges opposite to corners 0, 1 and 2, int32 of shape [face, 3]; −1 at a border, −2 where more
        than two faces meet. Both are silhouettes from everywhere.
    """
    check.shape("faces", faces.shape, ("face", 3))
    if positions is not None:
        *_, place = np.unique(positions, axis=0, return_inverse=True)
        faces = place.reshape(-1)[faces]
    count = len(faces)
    ends = np.sort(np.stack([np.roll(faces, -1, axis=1), np.roll(faces, -2, axis=1)], axis=-1), axis=-1).reshape(-1, 2)
    _, edge, sharing = np.unique(ends, axis=0, return_inverse=True, return_counts=True)
    edge = edge.reshape(-1)
    owner = np.repeat(np.arange(count), 3)
    total = np.zeros(len(sharing), np.int64)
    np.add.at(total, edge, owner)
    across = np.where(sharing[edge] == 2, total[edge] - owner, np.where(sharing[edge] == 1, -1, _NOT_MANIFOLD))
    return across.reshape(-1, 3).astype(np.int32)


@wp.func
def _side(a: wp.vec4, b: wp.vec4, x: float, y: float):
    """Volume that the ray through screen point (x, y) spans with two vertices; its sign is the side of the line ab."""
    ax = a[0] - x * a[3]
    ay = a[1] - y * a[3]
    bx = b[0] - x * b[3]
    by = b[1] - y * b[3]
    return ax * by - ay * bx


@wp.func
def _facing(clip_positions: wp.array(dtype=wp.vec4), face: wp.vec3i):
    """Sign of the orientation of a face on screen."""
    a = clip_positions[face[0]]
    b = clip_positions[face[1]]
    c = clip_positions[face[2]]
    volume = (
        a[0] * (b[1] * c[3] - c[1] * b[3]) - a[1] * (b[0] * c[3] - c[0] * b[3]) + a[3] * (b[0] * c[1] - c[0] * b[1])
    )
    return wp.sign(volume)


@wp.func
def _depth(face: int, weights: wp.vec3, faces: wp.array(dtype=wp.vec3i), clip_positions: wp.array(dtype=wp.vec4)):
    """Distance of a pixel's point along the view, infinite for the background."""
    depth = float(wp.inf)
    if face >= 0:
        corners = faces[face]
        depth = (
            weights[0] * clip_positions[corners[0]][3]
            + weights[1] * clip_positions[corners[1]][3]
            + weights[2] * clip_positions[corners[2]][3]
        )
    return depth


@wp.func
def _crosses(a: wp.vec4, b: wp.vec4, x0: float, y0: float, x1: float, y1: float):
    """Whether an edge before the eye runs between two screen points: they on two sides of it, its ends of theirs."""
    result = False
    if a[3] > 0.0 and b[3] > 0.0 and _side(a, b, x0, y0) * _side(a, b, x1, y1) < 0.0:
        # the line through the points is a row or a column
        start = wp.where(y0 == y1, a[1] - y0 * a[3], a[0] - x0 * a[3])
        end = wp.where(y0 == y1, b[1] - y0 * b[3], b[0] - x0 * b[3])
        result = wp.min(start, end) <= 0.0 and wp.max(start, end) > 0.0
    return result


@wp.kernel(enable_backward=False)
def _find_crossings(
    # in
    face_ids: wp.array3d(dtype=wp.int32),
    barycentrics: wp.array3d(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    neighbors: wp.array(dtype=wp.vec3i),
    clip_positions: wp.array2d(dtype=wp.vec4),
    # out
    crossings: wp.array4d(dtype=wp.vec2i),
):
    """A thread owns a pixel and its right (axis 0) or lower (axis 1) neighbor: the silhouette edge between them.

    It walks over the surface from the nearer pixel towards the other, from face to face, until it leaves it. A crossing
    is the edge's two vertices, −1 for none.
    """
    batch, row, column = wp.tid()
    height = face_ids.shape[1]
    width = face_ids.shape[2]
    here = face_ids[batch, row, column]
    clip = clip_positions[batch]
    for axis in range(2):
        crossing = wp.vec2i(-1, -1)
        other_row = row + axis
        other_column = column + 1 - axis
        there = here
        if other_row < height and other_column < width:
            there = face_ids[batch, other_row, other_column]
        if here != there:
            x0 = float(2 * column + 1 - width) / float(width)
            y0 = float(2 * row + 1 - height) / float(height)
            x1 = float(2 * other_column + 1 - width) / float(width)
            y1 = float(2 * other_row + 1 - height) / float(height)
            face = here
            depth = _depth(here, barycentrics[batch, row, column], faces, clip)
            if _depth(there, barycentrics[batch, other_row, other_column], faces, clip) < depth:
                face = there
            came_from = int(-1)
            step = int(0)
            while face >= 0 and step < MOST_STEPS:
                corners = faces[face]
                facing = _facing(clip, corners)
                onward = int(-1)
                for k in range(3):
                    across = neighbors[face][k]
                    i = corners[(k + 1) % 3]
                    j = corners[(k + 2) % 3]
                    if (across < 0 or across != came_from) and _crosses(clip[i], clip[j], x0, y0, x1, y1):
                        is_silhouette = across < 0
                        if across >= 0:
                            is_silhouette = _facing(clip, faces[across]) * facing <= 0.0
                        if is_silhouette:
                            # steep edges cut rows, flat ones columns, so that no share is counted twice
                            a = clip[i]
                            b = clip[j]
                            across_x = wp.abs(b[0] * a[3] - a[0] * b[3]) * float(width)
                            across_y = wp.abs(b[1] * a[3] - a[1] * b[3]) * float(height)
                            if (across_y >= across_x) == (axis == 0):
                                crossing = wp.vec2i(i, j)
                            onward = -1
                        elif crossing[0] < 0:
                            onward = across
                came_from = face
                face = onward
                if crossing[0] >= 0:
                    face = -1
                step += 1
        crossings[batch, axis, row, column] = crossing


@functools.cache
def _blend_kernel(dtype: type) -> wp.Kernel:
    @wp.func
    def share(
        crossings: wp.array4d(dtype=wp.vec2i),
        clip_positions: wp.array2d(dtype=wp.vec4),
        batch: int,
        axis: int,
        row: int,
        column: int,
        place: int,
        height: int,
        width: int,
    ):
        """What a pixel takes of its neighbor's color; place says whether it is the first or the second of the pair."""
        taken = float(0.0)
        crossing = crossings[batch, axis, row, column]
        if crossing[0] >= 0:
            a = clip_positions[batch, crossing[0]]
            b = clip_positions[batch, crossing[1]]
            x = float(2 * column + 1 - width) / float(width)
            y = float(2 * row + 1 - height) / float(height)
            first = _side(a, b, x, y)
            second = _side(a, b, x + 2.0 * float(1 - axis) / float(width), y + 2.0 * float(axis) / float(height))
            t = first / (first - second)  # from the first pixel's center
            if place == 0:
                t = 1.0 - t
            # t is now from the neighbor's center: where the edge lies beyond the middle, its color reaches here, be
            # the neighbor in front (its face juts out) or behind (this pixel's face ends short)
            taken = wp.max(t - 0.5, 0.0)
        return taken

    @wp.kernel(module="unique")
    def blend(
        # in
        image: wp.array3d(dtype=dtype),
        crossings: wp.array4d(dtype=wp.vec2i),
        clip_positions: wp.array2d(dtype=wp.vec4),
        # out
        smoothed: wp.array3d(dtype=dtype),
    ):
        """A thread owns a pixel and takes what its four neighbors' edges give it."""
        batch, row, column = wp.tid()
        height = image.shape[1]
        width = image.shape[2]
        here = image[batch, row, column]
        total = here
        if column + 1 < width:
            taken = share(crossings, clip_positions, batch, 0, row, column, 0, height, width)
            total += taken * (image[batch, row, column + 1] - here)
        if column > 0:
            taken = share(crossings, clip_positions, batch, 0, row, column - 1, 1, height, width)
            total += taken * (image[batch, row, column - 1] - here)
        if row + 1 < height:
            taken = share(crossings, clip_positions, batch, 1, row, column, 0, height, width)
            total += taken * (image[batch, row + 1, column] - here)
        if row > 0:
            taken = share(crossings, clip_positions, batch, 1, row - 1, column, 1, height, width)
            total += taken * (image[batch, row - 1, column] - here)
        smoothed[batch, row, column] = total

    return blend


def smooth_silhouettes(
    image: wp.array, fragments: Fragments, faces: wp.array, neighbors: wp.array, clip_positions: wp.array
) -> wp.array:
    """Smooth a rasterized image along silhouettes, by how much of a pixel the edge's face covers.

    Args:
        image: float32 or a vector of them, shape [batch, height, width]; of ones and zeros it becomes the coverage.
        fragments: What each pixel sees.
        faces: The rasterized faces, vec3i of shape [face].
        neighbors: :func:`edge_neighbors` of the faces, vec3i of shape [face].
        clip_positions: Vertices in clip space, vec4 of shape [batch, vertex].

    Returns:
        Smoothed image, like ``image``.

    Raises:
        ValueError: naming the argument, what it got and what it accepts.

    Differentiable: image, clip_positions. Which edges cross where is not, as it changes at isolated poses only. An edge
    with a vertex behind the eye, and lines where surfaces intersect, are not smoothed.
    """
    check.shape("image", image.shape, fragments.face_ids.shape)
    check.shape("neighbors", neighbors.shape, faces.shape)
    batch_count, height, width = image.shape
    device = image.device
    crossings = wp.empty((batch_count, 2, height, width), dtype=wp.vec2i, device=device)
    wp.launch(
        _find_crossings,
        dim=image.shape,
        inputs=[fragments.face_ids, fragments.barycentrics, faces, neighbors, clip_positions],
        outputs=[crossings],
        device=device,
        record_tape=False,
    )
    smoothed = wp.empty(
        image.shape,
        dtype=image.dtype,
        device=device,
        requires_grad=image.requires_grad or clip_positions.requires_grad,
    )
    wp.launch(
        _blend_kernel(image.dtype),
        dim=image.shape,
        inputs=[image, crossings, clip_positions],
        outputs=[smoothed],
        device=device,
    )
    return smoothed
