"""Silhouettes: edges that a rasterized image has between pixels, smoothed so that their gradient moves vertices.

Where the surface that the nearer of two neighboring pixels sees ends before the other's center, at a silhouette edge,
each of the two takes of the other's color what of itself lies beyond the edge (after Laine et al. 2020, section 3.5,
who take edges as upright). With the edge at distance t from a pixel's own center towards the other's, leaning by m
pixels a pixel (at most 1), that is the area beyond a straight edge,

    e = ½ − t                     t ≤ (1 − m)/2
        ((1 + m)/2 − t)² / 2m     between
        0                         t ≥ (1 + m)/2

An edge cuts rows and columns of pixels. It counts ω = 1 / (1 + m⁴) where it does the one, and the rest where it does
the other. A pixel of color c, with neighbors of colors c_k, so becomes

    c + Σ_k e_k (ω_k − ½ Σ_l max(ω_k + ω_l − 1, 0) e_l) (c_k − c)          sides l across side k

which is a mean: the weights are positive, and at most 1 in all. The inner sum is what two areas have in common, nothing
if they lie beyond one edge, their product if they lie beyond two upright ones. Lines where two surfaces intersect are
smoothed alike.

On screen an edge with ends a, b is the line ℓ = a × b, and the intersection of two faces the line ℓ = n − n′ on which
their planes n·(x, y, w) = 1 have the same depth. In a row, where ℓ·(x, y, 1) = 0, lines move by

    dx = (α ℓ·da + β ℓ·db) / ℓ_x                            α, β: the point on the edge is α a + β b, with w = 1
    dx = Σ_i (λ_i u n·dv_i − λ′_i u′ n′·dv′_i) / ℓ_x        λ: barycentrics of what the pixels see, u: its 1/w

How m changes is left out: it hardly matters to what two pixels take of each other on balance (1e-4 of the gradient by
a rigid motion), and at edges far below a pixel it would outweigh the rest, pulling their ends opposite ways.
"""

from dataclasses import dataclass

import warp as wp

from warpshadow import check
from warpshadow.stages.rasterize import Fragments, run_length

wp.set_module_options({"max_unroll": 1})  # it compiles in 2.2 s instead of 3.1 s, and runs as fast

MOST_STEPS = 32
"""Faces that are walked over between the centers of two pixels before the search for an edge is given up."""

LEAST_OPENING = 1e-4
"""Relative change of two surfaces' distance over a pixel, below which rounding hides where they intersect."""

# Rasterization moves vertices by up to 1/8192 pixel, so an edge may be this far on the wrong side of a center [pixels].
_SNAP = 1.0 / 2048.0

# In place of the silhouette between two pixels, which may be none (−1).
_UNKNOWN = -2

# In place of an edge's vertices.
NOTHING = -1
_INTERSECTION = -2


@dataclass(frozen=True, eq=False)
class Silhouettes:
    """Where an image has silhouettes: an entry for every pixel beside one.

    Args:
        pixels: Index of the pixel in the flat images [batch, height, width], −1 in an entry that is not used, int32 of
            shape [entry].
        edges: Vertices a, b of the edge between it and its neighbor to the right, left, below and above, in the order
            in which the line a × b is positive on its surface; (−1, −1) where there is none, (−2, −2) where their
            faces intersect; vec2i of shape [entry, 4].
        shares: The area e of the pixel that lies beyond each, and how much it counts, ω; vec2 of shape [entry, 4].
        entries: Entry of each pixel of the flat images, −1 for none, int32 of shape [pixel].
        fragments: What each pixel sees.
        faces: The rasterized faces, vec3i of shape [face].
    """

    pixels: wp.array
    edges: wp.array
    shares: wp.array
    entries: wp.array
    fragments: Fragments
    faces: wp.array


# --------------------------------------------------------------------------------------------------- lines on screen


@wp.func
def pixel_center(pixel: int, width: int, height: int):
    """Center of a pixel of the flat images, in normalized device coordinates."""
    row = pixel / width
    x = float(2 * (pixel - row * width) + 1 - width) / float(width)
    y = float(2 * (row % height) + 1 - height) / float(height)
    return wp.vec2(x, y)


@wp.func
def neighbor(pixel: int, side: int, width: int):
    """Pixel to the right (side 0), left, below or above."""
    step = wp.where(side < 2, 1, width)
    return pixel + wp.where(side % 2 == 0, step, -step)


@wp.func
def _opposite(side: int):
    """The side opposite to a side."""
    return wp.where(side % 2 == 0, side + 1, side - 1)


@wp.func
def _has_neighbor(pixel: int, side: int, width: int, height: int):
    """Whether the image goes on to a side of a pixel."""
    row = pixel / width
    place = wp.where(side < 2, pixel - row * width, row % height)
    last = wp.where(side < 2, width, height) - 1
    return wp.where(side % 2 == 0, place < last, place > 0)


@wp.func
def relative(p: wp.vec4, center: wp.vec2):
    """The x, y and w of a vertex relative to the ray through a point of the screen, so that nothing cancels there."""
    return wp.vec3(p[0] - center[0] * p[3], p[1] - center[1] * p[3], p[3])


@wp.func
def _plane(face: wp.vec3i, center: wp.vec2, clip_positions: wp.array(dtype=wp.vec4)):
    """Plane n·(x, y, w) = 1 of a face relative to the ray through a point of the screen; n_w is 1/w there."""
    a = relative(clip_positions[face[0]], center)
    b = relative(clip_positions[face[1]], center)
    c = relative(clip_positions[face[2]], center)
    normal = wp.cross(b - a, c - a)
    return normal / wp.dot(normal, a)


@wp.func
def _line(
    pixel: int,
    side: int,
    edge: wp.vec2i,
    width: int,
    height: int,
    face_ids: wp.array(dtype=wp.int32),
    faces: wp.array(dtype=wp.vec3i),
    clip_positions: wp.array(dtype=wp.vec4),
):
    """The line ℓ between a pixel and its neighbor to a side, relative to the pixel's center."""
    center = pixel_center(pixel, width, height)
    if edge[0] >= 0:
        return wp.cross(relative(clip_positions[edge[0]], center), relative(clip_positions[edge[1]], center))
    here = faces[face_ids[pixel]]
    there = faces[face_ids[neighbor(pixel, side, width)]]
    return _plane(here, center, clip_positions) - _plane(there, center, clip_positions)


@wp.func
def distance(line: wp.vec3, side: int, half_size: wp.vec2):
    """Where a line crosses the way from a pixel's center to its neighbor's, t [pixels]."""
    axis = side / 2
    return float(2 * (side % 2) - 1) * half_size[axis] * line[2] / line[axis]


@wp.func
def _lean(line: wp.vec3, side: int, half_size: wp.vec2):
    """How far along that way a line moves from one row (or column) of pixels to the next, m [pixels]."""
    axis = side / 2
    return wp.abs(line[1 - axis] / line[axis]) * half_size[axis] / half_size[1 - axis]


@wp.func
def ends_before(line: wp.vec3, side: int):
    """Whether an edge bounds the surface of the pixel itself, not that of its neighbor to a side."""
    return float(2 * (side % 2) - 1) * line[side / 2] > 0.0


# ---------------------------------------------------------------------------------------------------- where they are


@wp.func
def _volume(a: wp.vec4, b: wp.vec4, c: wp.vec4):
    """Volume that the eye spans with a face: its sign is the face's orientation on screen."""
    origin = wp.vec3(a[0], a[1], a[3])
    return wp.dot(wp.cross(wp.vec3(b[0], b[1], b[3]) - origin, wp.vec3(c[0], c[1], c[3]) - origin), origin)


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
def _is_silhouette(
    face: int,
    across: int,
    a: wp.vec4,
    b: wp.vec4,
    volume: float,
    faces: wp.array(dtype=wp.vec3i),
    neighbors: wp.array(dtype=wp.vec3i),
    clip_positions: wp.array(dtype=wp.vec4),
):
    """Whether the faces on both sides of edge ab lie on one side of it on screen, however they wind."""
    if across < 0:
        return True
    back = neighbors[across]
    corner = wp.where(back[0] == face, 0, wp.where(back[1] == face, 1, 2))
    return volume * _volume(a, b, clip_positions[faces[across][corner]]) >= 0.0


@wp.func
def _end_of_surface(
    start: int,
    goal: int,
    end: wp.vec2,
    axis: int,
    faces: wp.array(dtype=wp.vec3i),
    neighbors: wp.array(dtype=wp.vec3i),
    clip_positions: wp.array(dtype=wp.vec4),
):
    """Walk over a surface, from face to face along a row or column, until below a point of the screen.

    Returns 3 face + corner of the silhouette edge at which the surface ends before, −1 if it does not.
    """
    found = int(-1)
    face = start
    step = int(0)
    while face >= 0 and face != goal and step < MOST_STEPS:
        corners = faces[face]
        around = neighbors[face]
        volume = _volume(clip_positions[corners[0]], clip_positions[corners[1]], clip_positions[corners[2]])
        onward = int(-1)
        for k in range(3):
            p = clip_positions[corners[(k + 1) % 3]]
            q = clip_positions[corners[(k + 2) % 3]]
            a = relative(p, end)
            b = relative(q, end)
            across_a = a[1 - axis]
            across_b = b[1 - axis]
            if wp.min(across_a, across_b) <= 0.0 and wp.max(across_a, across_b) > 0.0:
                line = wp.cross(a, b)
                is_before_eye = wp.where(axis == 0, -line[0], line[1]) * (across_b - across_a) > 0.0
                if line[2] * volume < 0.0 and is_before_eye:
                    if _is_silhouette(face, around[k], p, q, volume, faces, neighbors, clip_positions):
                        found = 3 * face + k
                    else:
                        onward = around[k]
        face = wp.where(found >= 0, -1, onward)
        step += 1
    return found


@wp.func
def _silhouette_between(
    pixel: int,
    side: int,
    width: int,
    height: int,
    face_ids: wp.array(dtype=wp.int32),
    barycentrics: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    neighbors: wp.array(dtype=wp.vec3i),
    clip_positions: wp.array(dtype=wp.vec4),
):
    """The one silhouette edge between a pixel and its neighbor to a side, as 3 face + corner, or −1.

    It is where the nearer one's surface ends; only if that goes on, below the other's, is it where the other's ends.
    """
    other = neighbor(pixel, side, width)
    here = face_ids[pixel]
    there = face_ids[other]
    depth_here = _depth(here, barycentrics[pixel], faces, clip_positions)
    depth_there = _depth(there, barycentrics[other], faces, clip_positions)
    axis = side / 2
    first = pixel_center(pixel, width, height)
    last = pixel_center(other, width, height)
    margin = _SNAP * (last - first)
    found = int(-1)
    for attempt in range(2):
        if found < 0:
            from_here = (depth_here <= depth_there) == (attempt == 0)
            start = wp.where(from_here, here, there)
            goal = wp.where(from_here, there, here)
            end = wp.where(from_here, last + margin, first - margin)
            found = _end_of_surface(start, goal, end, axis, faces, neighbors, clip_positions)
    return found


@wp.func
def _add_crossing(
    pixel: int,
    side: int,
    edge: wp.vec2i,
    width: int,
    crossing_count: wp.array(dtype=wp.int32),
    crossings: wp.array(dtype=wp.vec4i),
    claims: wp.array(dtype=wp.int32),
):
    """Add what lies between two pixels to the list. Of the crossings beside a pixel one claims it, no matter which."""
    crossing = wp.atomic_add(crossing_count, 0, 1)
    crossings[crossing] = wp.vec4i(pixel, side, edge[0], edge[1])
    claims[pixel] = 2 * crossing
    claims[neighbor(pixel, side, width)] = 2 * crossing + 1


@wp.func
def _add_edge_if_seen(
    pixel: int,
    side: int,
    edge: wp.vec2i,
    half_edge: int,
    width: int,
    height: int,
    face_ids: wp.array(dtype=wp.int32),
    barycentrics: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    neighbors: wp.array(dtype=wp.vec3i),
    clip_positions: wp.array(dtype=wp.vec4),
    between: wp.array2d(dtype=wp.int32),
    crossing_count: wp.array(dtype=wp.int32),
    crossings: wp.array(dtype=wp.vec4i),
    claims: wp.array(dtype=wp.int32),
):
    """Add an edge that passes between a pixel and its neighbor if it is what they see.

    Several edges do, from both of their faces, so what is between them is kept.
    """
    if face_ids[pixel] != face_ids[neighbor(pixel, side, width)]:
        found = between[side / 2, pixel]
        if found == _UNKNOWN:
            found = _silhouette_between(
                pixel, side, width, height, face_ids, barycentrics, faces, neighbors, clip_positions
            )
            between[side / 2, pixel] = found
        if found == half_edge:
            _add_crossing(pixel, side, edge, width, crossing_count, crossings, claims)


@wp.func
def _end_on_screen(p: wp.vec4, q: wp.vec4, half_size: wp.vec2):
    """The end p of an edge pq, or where the edge meets the near plane if p lies behind it [pixels]."""
    behind = p[2] - p[3]
    end = p
    if behind > 0.0:
        end = p + (behind / (behind - (q[2] - q[3]))) * (q - p)
    return wp.vec2((end[0] / end[3] + 1.0) * half_size[0], (end[1] / end[3] + 1.0) * half_size[1])


@wp.func
def _centers_before(coordinate: float, count: int):
    """How many of ``count`` pixels have their centers before a coordinate [pixels]."""
    return int(wp.clamp(wp.ceil(coordinate - 0.5), 0.0, float(count)))


@wp.kernel(enable_backward=False)
def _find_edges(
    # in
    face_ids: wp.array(dtype=wp.int32),
    barycentrics: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    neighbors: wp.array(dtype=wp.vec3i),
    clip_positions: wp.array2d(dtype=wp.vec4),
    width: int,
    height: int,
    strip_count: int,
    # out
    between: wp.array2d(dtype=wp.int32),
    crossing_count: wp.array(dtype=wp.int32),
    crossings: wp.array(dtype=wp.vec4i),
    claims: wp.array(dtype=wp.int32),
):
    """A thread owns every ``strip_count``-th row and column that the silhouette edges of a face of an instance cut.

    Both faces of an edge follow it; the one over which the surface comes to the edge adds its crossings.
    """
    batch, face, strip = wp.tid()
    clip = clip_positions[batch]
    corners = faces[face]
    around = neighbors[face]
    half_size = 0.5 * wp.vec2(float(width), float(height))
    volume = _volume(clip[corners[0]], clip[corners[1]], clip[corners[2]])
    for k in range(3):
        edge = wp.vec2i(corners[(k + 1) % 3], corners[(k + 2) % 3])
        a = clip[edge[0]]
        b = clip[edge[1]]
        is_before_near_plane = a[3] > a[2] or b[3] > b[2]
        if is_before_near_plane and _is_silhouette(face, around[k], a, b, volume, faces, neighbors, clip):
            if volume < 0.0:
                edge = wp.vec2i(edge[1], edge[0])
            p = _end_on_screen(a, b, half_size)
            q = _end_on_screen(b, a, half_size)
            for axis in range(2):
                # Said for axis 0: along rows, from the lower to the higher row. Axis 1 goes along columns.
                low = wp.where(p[1 - axis] < q[1 - axis], p, q)
                high = wp.where(p[1 - axis] < q[1 - axis], q, p)
                extent = high[1 - axis] - low[1 - axis]
                slope = (high[axis] - low[axis]) / wp.max(extent, 1.0e-30)
                row_count = wp.where(axis == 0, height, width)
                column_count = wp.where(axis == 0, width, height)
                row = _centers_before(low[1 - axis] - _SNAP, row_count) + strip
                row_end = _centers_before(high[1 - axis] + _SNAP, row_count)
                while row < row_end:
                    x = low[axis] + slope * wp.clamp(float(row) + 0.5 - low[1 - axis], 0.0, extent)
                    column = wp.max(_centers_before(x - _SNAP, column_count) - 1, 0)
                    column_end = wp.min(_centers_before(x + _SNAP, column_count), column_count - 1)
                    while column < column_end:
                        _add_edge_if_seen(
                            batch * width * height + wp.where(axis == 0, row * width + column, column * width + row),
                            2 * axis,
                            edge,
                            3 * face + k,
                            width,
                            height,
                            face_ids,
                            barycentrics,
                            faces,
                            neighbors,
                            clip,
                            between,
                            crossing_count,
                            crossings,
                            claims,
                        )
                        column += 1
                    row += strip_count


@wp.func
def _approach(
    pixel: int,
    side: int,
    width: int,
    height: int,
    face_ids: wp.array(dtype=wp.int32),
    faces: wp.array(dtype=wp.vec3i),
    clip_positions: wp.array(dtype=wp.vec4),
):
    """Whether the face of a pixel's neighbor gets clearly nearer than the pixel's from one to the other."""
    axis = side / 2
    line = _line(pixel, side, wp.vec2i(_INTERSECTION, _INTERSECTION), width, height, face_ids, faces, clip_positions)
    inverse_depth = _plane(faces[face_ids[pixel]], pixel_center(pixel, width, height), clip_positions)[2]
    half_size = wp.where(axis == 0, 0.5 * float(width), 0.5 * float(height))
    opening = float(2 * (side % 2) - 1) * line[axis] / half_size
    return opening > LEAST_OPENING * inverse_depth


@wp.kernel(enable_backward=False)
def _find_intersections(
    # in
    face_ids: wp.array(dtype=wp.int32),
    barycentrics: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    neighbors: wp.array(dtype=wp.vec3i),
    surfaces: wp.array(dtype=wp.int32),
    clip_positions: wp.array2d(dtype=wp.vec4),
    width: int,
    height: int,
    run: int,
    # out
    crossing_count: wp.array(dtype=wp.int32),
    crossings: wp.array(dtype=wp.vec4i),
    claims: wp.array(dtype=wp.int32),
):
    """A thread owns ``run`` pixels after one another: what is between each and its right and its lower neighbor."""
    first = wp.tid() * run
    for pixel in range(first, wp.min(first + run, face_ids.shape[0])):
        here = face_ids[pixel]
        if here >= 0:
            # Nearly all pixels end here, so this comes first, and without branches.
            last = face_ids.shape[0] - 1
            surface = surfaces[here]
            right = surfaces[wp.max(face_ids[wp.min(pixel + 1, last)], 0)]
            below = surfaces[wp.max(face_ids[wp.min(pixel + width, last)], 0)]
            if right != surface or below != surface:
                row = pixel / width
                batch = row / height
                clip = clip_positions[batch]
                for axis in range(2):
                    side = 2 * axis
                    other = neighbor(pixel, side, width)
                    is_last = wp.where(axis == 0, other == (row + 1) * width, other >= (batch + 1) * height * width)
                    differs = not is_last and wp.where(axis == 0, right, below) != surface and face_ids[other] >= 0
                    if differs and _approach(pixel, side, width, height, face_ids, faces, clip):
                        found = _silhouette_between(
                            pixel, side, width, height, face_ids, barycentrics, faces, neighbors, clip
                        )
                        if found < 0:
                            edge = wp.vec2i(_INTERSECTION, _INTERSECTION)
                            _add_crossing(pixel, side, edge, width, crossing_count, crossings, claims)


@wp.kernel(enable_backward=False)
def _gather(
    # in
    crossing_count: wp.array(dtype=wp.int32),
    crossings: wp.array(dtype=wp.vec4i),
    claims: wp.array(dtype=wp.int32),
    width: int,
    has_all: bool,
    # out
    pixels: wp.array(dtype=wp.int32),
    edges: wp.array2d(dtype=wp.vec2i),
    entries: wp.array(dtype=wp.int32),
):
    """A thread owns a crossing: it goes to the entries of its two pixels; all outputs are −1 before.

    If there is an entry for all pixels, it is the pixel's own.
    """
    thread = wp.tid()
    if thread < crossing_count[0]:
        crossing = crossings[thread]
        side = crossing[1]
        edge = wp.vec2i(crossing[2], crossing[3])
        pixel = crossing[0]
        other = neighbor(pixel, side, width)
        entry = wp.where(has_all, pixel, claims[pixel])
        other_entry = wp.where(has_all, other, claims[other])
        pixels[entry] = pixel
        pixels[other_entry] = other
        entries[pixel] = entry
        entries[other] = other_entry
        edges[entry, side] = edge
        edges[other_entry, side + 1] = edge


@wp.kernel(enable_backward=False)
def _measure(
    # in
    pixels: wp.array(dtype=wp.int32),
    edges: wp.array2d(dtype=wp.vec2i),
    face_ids: wp.array(dtype=wp.int32),
    faces: wp.array(dtype=wp.vec3i),
    clip_positions: wp.array2d(dtype=wp.vec4),
    width: int,
    height: int,
    # out
    shares: wp.array2d(dtype=wp.vec2),
):
    """A thread owns a side of an entry's pixel: the area e beyond the line there, and how much it counts, ω."""
    entry, side = wp.tid()
    edge = edges[entry, side]
    share = wp.vec2()
    if edge[0] != NOTHING:
        pixel = pixels[entry]
        half_size = 0.5 * wp.vec2(float(width), float(height))
        clip = clip_positions[pixel / (width * height)]
        line = _line(pixel, side, edge, width, height, face_ids, faces, clip)
        t = wp.clamp(distance(line, side, half_size), 0.0, 1.0)
        lean = _lean(line, side, half_size)
        m = wp.min(lean, 1.0)
        area = float(0.0)
        if t <= 0.5 * (1.0 - m):
            area = 0.5 - t
        elif t < 0.5 * (1.0 + m):
            rest = 0.5 * (1.0 + m) - t
            area = 0.5 * rest * rest / m
        if wp.isfinite(line / line[side / 2]):  # else vertices are so far away that products overflow
            share = wp.vec2(area, 1.0 / (1.0 + lean * lean * lean * lean))
    shares[entry, side] = share


def find_silhouettes(
    fragments: Fragments,
    faces: wp.array,
    neighbors: wp.array,
    clip_positions: wp.array,
    surfaces: wp.array | None = None,
) -> Silhouettes:
    """Find the edges at which the surfaces in an image end, and the lines where they intersect.

    Args:
        fragments: What each pixel sees.
        faces: The rasterized faces, vec3i of shape [face].
        neighbors: :func:`warpshadow.assets.topology.edge_neighbors` of the faces, vec3i of shape [face].
        clip_positions: Vertices in clip space, vec4 of shape [batch, vertex].
        surfaces: A number for each face, the same all over a body, int32 of shape [face]. Intersections are looked for
            between different ones; without it there are none, and where bodies intersect they have no gradient.

    Returns:
        Silhouettes, for :func:`smooth_silhouettes`. They have as many entries as need be: the count is read back, which
        waits for the device. While a CUDA graph is captured they have one for each pixel instead, and nothing is read.

    Raises:
        ValueError: naming the argument, what it got and what it accepts.

    Not differentiable: which lines lie between which pixels changes at isolated poses only.
    """
    batch_count, height, width = fragments.face_ids.shape
    check.shape("neighbors", neighbors.shape, faces.shape)
    check.shape("clip_positions", clip_positions.shape, (batch_count, "vertex"))
    face_ids, barycentrics = fragments.face_ids.flatten(), fragments.barycentrics.flatten()
    device = face_ids.device
    crossing_count = wp.zeros(1, dtype=wp.int32, device=device)
    crossings = wp.empty(2 * face_ids.size, dtype=wp.vec4i, device=device)
    claims = wp.empty(face_ids.size, dtype=wp.int32, device=device)
    strip_count = _strip_count(device)
    between = wp.full((2, face_ids.size), _UNKNOWN, dtype=wp.int32, device=device)
    wp.launch(
        _find_edges,
        dim=(batch_count, faces.shape[0], strip_count),
        inputs=[face_ids, barycentrics, faces, neighbors, clip_positions, width, height, strip_count],
        outputs=[between, crossing_count, crossings, claims],
        device=device,
        record_tape=False,
    )
    if surfaces is not None:
        check.shape("surfaces", surfaces.shape, faces.shape)
        run = run_length(device, width)
        wp.launch(
            _find_intersections,
            dim=-(-face_ids.size // run),
            inputs=[face_ids, barycentrics, faces, neighbors, surfaces, clip_positions, width, height, run],
            outputs=[crossing_count, crossings, claims],
            device=device,
            record_tape=False,
        )
    has_all = bool(device.is_capturing)
    most = crossings.size if has_all else int(crossing_count.numpy()[0])
    entry_count = face_ids.size if has_all else 2 * most
    pixels = wp.full(entry_count, -1, dtype=wp.int32, device=device)
    edges = wp.full((entry_count, 4), wp.vec2i(NOTHING, NOTHING), dtype=wp.vec2i, device=device)
    entries = wp.full(face_ids.size, -1, dtype=wp.int32, device=device)
    wp.launch(
        _gather,
        dim=most,
        inputs=[crossing_count, crossings, claims, width, has_all],
        outputs=[pixels, edges, entries],
        device=device,
        record_tape=False,
    )
    shares = wp.empty(edges.shape, dtype=wp.vec2, device=device)
    wp.launch(
        _measure,
        dim=shares.shape,
        inputs=[pixels, edges, face_ids, faces, clip_positions, width, height],
        outputs=[shares],
        device=device,
        record_tape=False,
    )
    return Silhouettes(pixels, edges, shares, entries, fragments, faces)


def _strip_count(device: wp.Device) -> int:
    """Threads that follow an edge: on CUDA several, so that none follows a long one alone."""
    return 16 if device.is_cuda else 1
