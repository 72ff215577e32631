"""Rasterize triangles: which face a pixel sees, where on it, and what an attribute is worth there.

Pixels and clip space are those of `warpshadow.assets.camera`. Coverage is decided in integers, so it is exact:
vertices snap to 1/4096 pixel, a pixel belongs to the face that holds its center, and a center on an edge
belongs to one of the two faces that share it (the top-left rule). Both sides of a face are drawn. Of the
faces over a pixel the nearest wins; of equally near ones, that of the lowest index.

Coverage has no derivative. Barycentrics are recomputed from the face of each pixel, so they do.
"""

import functools
from dataclasses import dataclass

import warp as wp

from warpshadow import check
from warpshadow.device.batch import common_batch, rows
from warpshadow.device.parallel import launch_slices, run_length, split_row
from warpshadow.device.tape import record_adjoint
from warpshadow.device.warp_internals import scalar_type

MAX_SIZE = 1 << 15
"""Largest image width or height [pixels]: beyond, fixed-point edge functions could overflow."""

# Fixed-point pixel positions have 12 fractional bits and, with sign, 29 bits in all. So edge coefficients
# have at most 30 bits, their products with positions 59, and their sums fit 64.
_ONE = 1 << 12
_HALF = _ONE // 2
_SHIFT = 12
_LIMIT = 1 << 28
_WILD = -(1 << 31)  # the x of a vertex that has no fixed-point position: behind the eye or beyond the limit

# In boxes wider than this each row is trimmed to the span inside the edges; else testing pixels is faster.
_TRIM_WIDTH = 8

_PIXEL_COST = 5.0
"""Nanoseconds that a pixel takes."""

_INT32_MASK = (1 << 32) - 1
_DEPTH_ONE = 0x3F800000

_Edge = wp.types.vector(length=3, dtype=wp.int64)


@dataclass(frozen=True, eq=False)
class Fragments:
    """What each pixel sees.

    Args:
        face_ids: Index of the visible face, -1 where there is none, int32, shape [batch, height, width].
        barycentrics: Perspective-correct weights of the face's three vertices, non-negative with sum 1, zero
            where there is no face, vec3, shape [batch, height, width].
        sides: Index of the visible side (`warpshadow.stages.sides`), -1 where there is no face, int32, shape
            [batch, height, width]; None where no face is known to be seen from behind.
    """

    face_ids: wp.array
    barycentrics: wp.array
    sides: wp.array | None = None

    @functools.cached_property
    def rows(self) -> list[wp.array]:
        """The arrays as [batch, pixel]."""
        return [rows(self.face_ids), rows(self.barycentrics)]


@wp.kernel(enable_backward=False)
def _snap(
    # in
    clip_positions: wp.array2d(dtype=wp.vec4),
    width: int,
    height: int,
    # out
    corners: wp.array2d(dtype=wp.vec2i),
    depths: wp.array2d(dtype=float),
    faults: wp.array(dtype=int),
):
    """One thread owns one vertex: its fixed-point pixel position and its depth z/w."""
    instance, vertex = wp.tid()
    p = clip_positions[instance, vertex]
    if not (wp.isfinite(p[0]) and wp.isfinite(p[1]) and wp.isfinite(p[2]) and wp.isfinite(p[3])):
        wp.atomic_add(faults, 0, 1)
    corner = wp.vec2i(_WILD, _WILD)
    depth = 0.0
    if p[3] > 0.0:
        inverse = wp.float64(1.0) / wp.float64(p[3])
        x = (wp.float64(p[0]) * inverse + wp.float64(1.0)) * wp.float64(width * _HALF)
        y = (wp.float64(p[1]) * inverse + wp.float64(1.0)) * wp.float64(height * _HALF)
        if wp.max(wp.abs(x), wp.abs(y)) < wp.float64(_LIMIT):
            corner = wp.vec2i(int(wp.rint(x)), int(wp.rint(y)))
            depth = p[2] / p[3]
    corners[instance, vertex] = corner
    depths[instance, vertex] = depth


@wp.func
def _edge(a: wp.vec2i, b: wp.vec2i):
    """Line through snapped vertices: E(x, y) = e0 x + e1 y + e2, positive to the right of a -> b."""
    x = wp.int64(a[1] - b[1])
    y = wp.int64(b[0] - a[0])
    return _Edge(x, y, -(x * wp.int64(a[0]) + y * wp.int64(a[1])))


@wp.func
def _pixel_homogeneous(p: wp.vec4, width: int, height: int):
    """Clip position to homogeneous fixed-point pixel coordinates."""
    w = wp.float64(p[3])
    x = (wp.float64(p[0]) + w) * wp.float64(width * _HALF)
    y = (wp.float64(p[1]) + w) * wp.float64(height * _HALF)
    return wp.vec3d(x, y, w)


@wp.func
def _wild_edge(a: wp.vec3d, b: wp.vec3d, a_corner: wp.vec2i, b_corner: wp.vec2i):
    """Line of an edge with a vertex behind the eye or far away.

    In homogeneous coordinates the line is a x b, wherever its ends are. It is rounded to integers, made to
    pass through an end that has a snapped position, and computed in one order of a and b, so that both faces
    of the edge get the same.
    """
    if a_corner[0] != _WILD and b_corner[0] != _WILD:
        return _edge(a_corner, b_corner)
    swap = a[0] > b[0] or (a[0] == b[0] and (a[1] > b[1] or (a[1] == b[1] and a[2] > b[2])))
    line = wp.where(swap, wp.cross(b, a), wp.cross(a, b))
    sign = wp.where(swap, wp.int64(-1), wp.int64(1))
    slope = wp.max(wp.abs(line[0]), wp.abs(line[1]))
    # The point of the line that is nearest to the origin; the line misses the screen if that is far.
    offset = wp.float64(0.0)
    if slope > wp.float64(0.0):
        line = line / slope
        offset = line[2] / (line[0] * line[0] + line[1] * line[1])
    anchor_x = wp.int64(0)
    anchor_y = wp.int64(0)
    if a_corner[0] != _WILD:
        anchor_x = wp.int64(a_corner[0])
        anchor_y = wp.int64(a_corner[1])
    elif b_corner[0] != _WILD:
        anchor_x = wp.int64(b_corner[0])
        anchor_y = wp.int64(b_corner[1])
    elif slope == wp.float64(0.0) or wp.abs(offset) > wp.float64(_LIMIT):
        return _Edge(wp.int64(0), wp.int64(0), sign * wp.int64(wp.sign(line[2])))
    else:
        anchor_x = wp.int64(wp.rint(-line[0] * offset))
        anchor_y = wp.int64(wp.rint(-line[1] * offset))
    x = sign * wp.int64(wp.rint(line[0] * wp.float64(_LIMIT)))
    y = sign * wp.int64(wp.rint(line[1] * wp.float64(_LIMIT)))
    return _Edge(x, y, -(x * anchor_x + y * anchor_y))


@wp.func
def _first_pixel(fixed: int):
    """Least pixel index whose center is not before a fixed-point position."""
    return (fixed + (_HALF - 1)) >> _SHIFT


@wp.func
def _at_pixel_centers(edge: _Edge, sign: wp.int64):
    """Edge function of pixel indices instead of positions, non-negative exactly on the pixels inside.

    Top-left rule: a center on the line is inside if the inside lies to the right of the line or straight
    below it.
    """
    x = sign * edge[0]
    y = sign * edge[1]
    at_origin = sign * edge[2] + (x + y) * wp.int64(_HALF)
    if not (x > wp.int64(0) or (x == wp.int64(0) and y > wp.int64(0))):
        at_origin -= wp.int64(1)
    return _Edge(x * wp.int64(_ONE), y * wp.int64(_ONE), at_origin)


@wp.func
def _trim(span: wp.vec2i, step: wp.int64, value: wp.int64):
    """Shrink a span of columns to where an edge function may be non-negative, with a column to spare."""
    if step == wp.int64(0):
        return span
    root = -wp.float64(value) / wp.float64(step)
    column = int(wp.clamp(root, wp.float64(-2.0), wp.float64(MAX_SIZE)))
    if step > wp.int64(0):
        return wp.vec2i(wp.max(span[0], column - 1), span[1])
    return wp.vec2i(span[0], wp.min(span[1], column + 1))


@wp.func
def _tame_plane(a: wp.vec2i, b: wp.vec2i, c: wp.vec2i, area: wp.int64, depth_a: float, depth_b: float, depth_c: float):
    """Depth of a face as a linear function of pixel indices: plane0 column + plane1 row + plane2."""
    scale = wp.float64(_ONE) / wp.float64(area)
    ab = wp.float64(depth_b - depth_a) * scale
    ac = wp.float64(depth_c - depth_a) * scale
    x = ab * wp.float64(c[1] - a[1]) - ac * wp.float64(b[1] - a[1])
    y = ac * wp.float64(b[0] - a[0]) - ab * wp.float64(c[0] - a[0])
    column = wp.float64(a[0] - _HALF) / wp.float64(_ONE)
    row = wp.float64(a[1] - _HALF) / wp.float64(_ONE)
    return wp.vec3d(x, y, wp.float64(depth_a) - x * column - y * row)


@wp.func
def _wild_plane(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, z: wp.vec3d):
    """`_tame_plane` for a face with vertices behind the eye or far away."""
    ab = wp.cross(a, b)
    plane = (z[0] * wp.cross(b, c) + z[1] * wp.cross(c, a) + z[2] * ab) / wp.dot(ab, c)
    half = wp.float64(_HALF)
    one = wp.float64(_ONE)
    return wp.vec3d(plane[0] * one, plane[1] * one, plane[2] + (plane[0] + plane[1]) * half)


@wp.func
def _outside(a: wp.vec4, b: wp.vec4, c: wp.vec4):
    """Whether all of a face lies beyond one side of the view frustum."""
    return (
        (a[0] > a[3] and b[0] > b[3] and c[0] > c[3])
        or (a[0] < -a[3] and b[0] < -b[3] and c[0] < -c[3])
        or (a[1] > a[3] and b[1] > b[3] and c[1] > c[3])
        or (a[1] < -a[3] and b[1] < -b[3] and c[1] < -c[3])
        or (a[2] > a[3] and b[2] > b[3] and c[2] > c[3])
        or (a[2] <= 0.0 and b[2] <= 0.0 and c[2] <= 0.0)
    )


@wp.kernel(enable_backward=False)
def _cover(
    # in
    clip_positions: wp.array2d(dtype=wp.vec4),
    corners: wp.array2d(dtype=wp.vec2i),
    depths: wp.array2d(dtype=float),
    faces: wp.array(dtype=wp.vec3i),
    width: int,
    height: int,
    strip_count: int,
    # out
    keys: wp.array3d(dtype=wp.int64),
    faults: wp.array(dtype=int),
):
    """One thread owns every strip_count-th row of one face and offers the face to the pixels there.

    A pixel keeps the largest key: nearest depth above, lowest face below. Zero is the background.
    """
    instance, face, strip = wp.tid()
    i = faces[face][0]
    j = faces[face][1]
    k = faces[face][2]
    if wp.min(i, wp.min(j, k)) < 0 or wp.max(i, wp.max(j, k)) >= corners.shape[1]:
        if strip == 0:
            wp.atomic_add(faults, 1, 1)
        return
    a = corners[instance, i]
    b = corners[instance, j]
    c = corners[instance, k]
    wild = a[0] == _WILD or b[0] == _WILD or c[0] == _WILD

    left = 0
    right = width - 1
    top = 0
    bottom = height - 1
    if not wild:
        left = wp.max(left, _first_pixel(wp.min(a[0], wp.min(b[0], c[0]))))
        right = wp.min(right, _first_pixel(wp.max(a[0], wp.max(b[0], c[0])) + 1) - 1)
        top = wp.max(top, _first_pixel(wp.min(a[1], wp.min(b[1], c[1]))))
        bottom = wp.min(bottom, _first_pixel(wp.max(a[1], wp.max(b[1], c[1])) + 1) - 1)
    if left > right or top > bottom:
        return

    edge_a = _edge(b, c)
    edge_b = _edge(c, a)
    edge_c = _edge(a, b)
    plane = wp.vec3d()
    farthest = 0
    nearest = int(_DEPTH_ONE + 1)
    sign = wp.int64(1)
    if wild:
        clip_a = clip_positions[instance, i]
        clip_b = clip_positions[instance, j]
        clip_c = clip_positions[instance, k]
        if _outside(clip_a, clip_b, clip_c):
            return
        pixel_a = _pixel_homogeneous(clip_a, width, height)
        pixel_b = _pixel_homogeneous(clip_b, width, height)
        pixel_c = _pixel_homogeneous(clip_c, width, height)
        volume = wp.dot(wp.cross(pixel_a, pixel_b), pixel_c)
        if volume == wp.float64(0.0):
            return
        sign = wp.where(volume > wp.float64(0.0), wp.int64(1), wp.int64(-1))
        edge_a = _wild_edge(pixel_b, pixel_c, b, c)
        edge_b = _wild_edge(pixel_c, pixel_a, c, a)
        edge_c = _wild_edge(pixel_a, pixel_b, a, b)
        z = wp.vec3d(wp.float64(clip_a[2]), wp.float64(clip_b[2]), wp.float64(clip_c[2]))
        plane = _wild_plane(pixel_a, pixel_b, pixel_c, z)
    else:
        area = edge_c[0] * wp.int64(c[0]) + edge_c[1] * wp.int64(c[1]) + edge_c[2]
        if area == wp.int64(0):
            return
        sign = wp.where(area > wp.int64(0), wp.int64(1), wp.int64(-1))
        depth_a = depths[instance, i]
        depth_b = depths[instance, j]
        depth_c = depths[instance, k]
        plane = _tame_plane(a, b, c, area, depth_a, depth_b, depth_c)
        # Rounding must not carry the depth of a sliver beyond that of its vertices.
        farthest = wp.cast(wp.min(depth_a, wp.min(depth_b, depth_c)), wp.int32)
        nearest = wp.cast(wp.max(depth_a, wp.max(depth_b, depth_c)), wp.int32)
    edge_a = _at_pixel_centers(edge_a, sign)
    edge_b = _at_pixel_centers(edge_b, sign)
    edge_c = _at_pixel_centers(edge_c, sign)

    low = wp.int64(_INT32_MASK) - wp.int64(face)
    row = top + strip
    while row <= bottom:
        y = wp.int64(row)
        in_a = edge_a[1] * y + edge_a[2]
        in_b = edge_b[1] * y + edge_b[2]
        in_c = edge_c[1] * y + edge_c[2]
        span = wp.vec2i(left, right)
        if right - left >= _TRIM_WIDTH:
            span = _trim(span, edge_a[0], in_a)
            span = _trim(span, edge_b[0], in_b)
            span = _trim(span, edge_c[0], in_c)
        column = span[0]
        x = wp.int64(column)
        in_a += edge_a[0] * x
        in_b += edge_b[0] * x
        in_c += edge_c[0] * x
        depth_of_row = plane[1] * wp.float64(row) + plane[2]
        while column <= span[1]:
            if (in_a | in_b | in_c) >= wp.int64(0):
                depth = float(plane[0] * wp.float64(column) + depth_of_row)
                bits = wp.clamp(wp.cast(depth, wp.int32), farthest, nearest)
                if bits > 0 and bits <= _DEPTH_ONE:
                    key = (wp.int64(bits) << wp.int64(32)) | low
                    if key > keys[instance, row, column]:
                        wp.atomic_max(keys, instance, row, column, key)
            in_a += edge_a[0]
            in_b += edge_b[0]
            in_c += edge_c[0]
            column += 1
        row += strip_count


@wp.kernel(enable_backward=False)
def _resolve(
    # in
    keys: wp.array(dtype=wp.int64),
    # out
    face_ids: wp.array(dtype=wp.int32),
):
    """One thread owns one pixel: the face in its key, and -1 for the key zero."""
    pixel = wp.tid()
    face_ids[pixel] = ~wp.int32(keys[pixel])


# Pixel kernels run over flat images: on a CPU, splitting an index into instance, row and column takes as long
# as the rest.
@wp.func
def _instance(pixel: int, pixels_per_instance: int, instance_count: int):
    """Instance of a pixel, without the division where there is only one."""
    instance = int(0)
    if instance_count > 1:
        instance = pixel // pixels_per_instance
    return instance


# Below this the volumes of a face are subnormal numbers, which have no reciprocal in float32.
TINY_VOLUME = 1.0e-36


@wp.func
def _relative(p: wp.vec4, ray: wp.vec2):
    """A vertex in clip space relative to the ray of a pixel, which passes through it if both are zero."""
    return wp.vec2(p[0] - ray[0] * p[3], p[1] - ray[1] * p[3])


@wp.func
def _volumes(a: wp.vec2, b: wp.vec2, c: wp.vec2):
    """What a ray spans with two vertices each, given relative to it: all of one sign inside of the face."""
    return wp.vec3(b[0] * c[1] - b[1] * c[0], c[0] * a[1] - c[1] * a[0], a[0] * b[1] - a[1] * b[0])


@wp.func
def _weights(a: wp.vec4, b: wp.vec4, c: wp.vec4, ray: wp.vec2):
    """Perspective-correct barycentrics: to each other as the volumes that the ray spans in clip space.

    That holds for vertices behind the eye, too, so no clipping is needed; and relative to the ray nothing
    cancels when a face is small.
    """
    volumes = _volumes(_relative(a, ray), _relative(b, ray), _relative(c, ray))
    side = wp.sign(volumes[0] + volumes[1] + volumes[2])
    # A pixel's center may lie outside of the face by what the vertices moved when they snapped.
    inside = wp.max(side * volumes, wp.vec3(0.0, 0.0, 0.0))
    total = inside[0] + inside[1] + inside[2]
    if total > TINY_VOLUME:
        return inside / total
    return wp.vec3(1.0 / 3.0, 1.0 / 3.0, 1.0 / 3.0)  # edge-on, drawn only because its vertices snapped


@wp.struct
class _Pulls:
    """Gradients to the x, y and w of the corners of a face."""

    a: wp.vec3
    b: wp.vec3
    c: wp.vec3


@wp.func
def _weights_adjoint(a: wp.vec4, b: wp.vec4, c: wp.vec4, ray: wp.vec2, adj_weights: wp.vec3):
    """The adjoint of `_weights`.

    With volumes v, their sum t and weights w = v/t: dL/dv_i = (dL/dw_i - Σ_j w_j dL/dw_j) / t, but 0 where
    v_i is clamped. A volume of exactly 0, on an edge, is not clamped: meshes aligned with the pixels would
    lose gradients there.
    """
    at_a = _relative(a, ray)
    at_b = _relative(b, ray)
    at_c = _relative(c, ray)
    volumes = _volumes(at_a, at_b, at_c)
    side = wp.sign(volumes[0] + volumes[1] + volumes[2])
    inside = wp.max(side * volumes, wp.vec3(0.0, 0.0, 0.0))
    total = inside[0] + inside[1] + inside[2]
    pulls = _Pulls()
    if total > TINY_VOLUME:
        scale = side / total
        mean = wp.dot(inside, adj_weights) / total
        adj_a = wp.where(side * volumes[0] < 0.0, 0.0, scale * (adj_weights[0] - mean))
        adj_b = wp.where(side * volumes[1] < 0.0, 0.0, scale * (adj_weights[1] - mean))
        adj_c = wp.where(side * volumes[2] < 0.0, 0.0, scale * (adj_weights[2] - mean))
        ax = adj_c * at_b[1] - adj_b * at_c[1]
        ay = adj_b * at_c[0] - adj_c * at_b[0]
        bx = adj_a * at_c[1] - adj_c * at_a[1]
        by = adj_c * at_a[0] - adj_a * at_c[0]
        cx = adj_b * at_a[1] - adj_a * at_b[1]
        cy = adj_a * at_b[0] - adj_b * at_a[0]
        pulls.a = wp.vec3(ax, ay, -(ray[0] * ax + ray[1] * ay))
        pulls.b = wp.vec3(bx, by, -(ray[0] * bx + ray[1] * by))
        pulls.c = wp.vec3(cx, cy, -(ray[0] * cx + ray[1] * cy))
    return pulls


@wp.func
def _ray(column: int, row: int, width: int, height: int):
    """Center of a pixel, in normalized device coordinates."""
    x = float(2 * column + 1 - width) / float(width)
    y = float(2 * row + 1 - height) / float(height)
    return wp.vec2(x, y)


@wp.kernel(enable_backward=False)
def _barycentrics(
    first_row: int,
    worker: int,
    # in
    face_ids: wp.array2d(dtype=wp.int32),
    faces: wp.array(dtype=wp.vec3i),
    clip_positions: wp.array2d(dtype=wp.vec4),
    width: int,
    run: int,
    # out
    barycentrics: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a run of pixels; barycentrics are zero before."""
    instance, thread = split_row(first_row + wp.tid(), face_ids.shape[1] // run)
    clip = clip_positions[instance]
    height = face_ids.shape[1] // width
    row = thread * run / width
    for pixel in range(thread * run, (thread + 1) * run):
        face = face_ids[instance, pixel]
        if face >= 0:
            corners = faces[face]
            ray = _ray(pixel - row * width, row, width, height)
            barycentrics[instance, pixel] = _weights(clip[corners[0]], clip[corners[1]], clip[corners[2]], ray)


@wp.kernel(enable_backward=False)
def _barycentrics_adjoint(
    first_row: int,
    worker: int,
    # in
    face_ids: wp.array2d(dtype=wp.int32),
    faces: wp.array(dtype=wp.vec3i),
    clip_positions: wp.array2d(dtype=wp.vec4),
    width: int,
    run: int,
    adj_barycentrics: wp.array2d(dtype=wp.vec3),
    # out
    adj_clip_positions: wp.array2d(dtype=wp.vec4),
):
    """A thread owns a run of pixels."""
    instance, thread = split_row(first_row + wp.tid(), face_ids.shape[1] // run)
    clip = clip_positions[instance]
    adj_clip = adj_clip_positions[instance]
    height = face_ids.shape[1] // width
    row = thread * run / width
    for pixel in range(thread * run, (thread + 1) * run):
        face = face_ids[instance, pixel]
        adj_weights = adj_barycentrics[instance, pixel]
        # What is the same at all corners does not depend on the weights, whose sum is 1.
        if face >= 0 and (adj_weights[0] != adj_weights[1] or adj_weights[1] != adj_weights[2]):
            i = faces[face]
            ray = _ray(pixel - row * width, row, width, height)
            pulls = _weights_adjoint(clip[i[0]], clip[i[1]], clip[i[2]], ray, adj_weights)
            wp.atomic_add(adj_clip, i[0], wp.vec4(pulls.a[0], pulls.a[1], 0.0, pulls.a[2]))
            wp.atomic_add(adj_clip, i[1], wp.vec4(pulls.b[0], pulls.b[1], 0.0, pulls.b[2]))
            wp.atomic_add(adj_clip, i[2], wp.vec4(pulls.c[0], pulls.c[1], 0.0, pulls.c[2]))


@functools.cache
def _interpolation(dtype: type) -> wp.Kernel:
    """Kernel of `interpolate` for attributes of one dtype."""

    @wp.kernel(module="unique", enable_backward=False)
    def interpolate(
        first_row: int,
        worker: int,
        # in
        face_ids: wp.array2d(dtype=wp.int32),
        barycentrics: wp.array2d(dtype=wp.vec3),
        faces: wp.array(dtype=wp.vec3i),
        attributes: wp.array2d(dtype=dtype),
        run: int,
        # out
        image: wp.array2d(dtype=dtype),
    ):
        """A thread owns a run of pixels; the image is zero before."""
        instance, thread = split_row(first_row + wp.tid(), image.shape[1] // run)
        view = wp.min(instance, face_ids.shape[0] - 1)
        own = attributes[wp.min(instance, attributes.shape[0] - 1)]
        for pixel in range(thread * run, (thread + 1) * run):
            face = face_ids[view, pixel]
            if face >= 0:
                corners = faces[face]
                weights = barycentrics[view, pixel]
                image[instance, pixel] = (
                    weights[0] * own[corners[0]] + weights[1] * own[corners[1]] + weights[2] * own[corners[2]]
                )

    return interpolate


@functools.cache
def _interpolation_adjoint(dtype: type) -> wp.Kernel:
    """Its adjoint."""
    inner = wp.mul if dtype is wp.float32 else wp.dot

    @wp.kernel(module="unique", enable_backward=False)
    def interpolate_adjoint(
        first_row: int,
        worker: int,
        # in
        face_ids: wp.array2d(dtype=wp.int32),
        barycentrics: wp.array2d(dtype=wp.vec3),
        faces: wp.array(dtype=wp.vec3i),
        attributes: wp.array2d(dtype=dtype),
        run: int,
        adj_image: wp.array2d(dtype=dtype),
        # out
        adj_barycentrics: wp.array2d(dtype=wp.vec3),
        adj_attributes: wp.array2d(dtype=dtype),
    ):
        """A thread owns a run of pixels of all instances."""
        thread = first_row + wp.tid()
        for instance in range(adj_image.shape[0]):
            view = wp.min(instance, face_ids.shape[0] - 1)
            row = wp.min(instance, attributes.shape[0] - 1)
            for pixel in range(thread * run, (thread + 1) * run):
                face = face_ids[view, pixel]
                if face >= 0:
                    corners = faces[face]
                    seed = adj_image[instance, pixel]
                    if adj_barycentrics:
                        adj_barycentrics[view, pixel] = adj_barycentrics[view, pixel] + wp.vec3(
                            inner(seed, attributes[row, corners[0]]),
                            inner(seed, attributes[row, corners[1]]),
                            inner(seed, attributes[row, corners[2]]),
                        )
                    if adj_attributes:
                        weights = barycentrics[view, pixel]
                        wp.atomic_add(adj_attributes, row, corners[0], weights[0] * seed)
                        wp.atomic_add(adj_attributes, row, corners[1], weights[1] * seed)
                        wp.atomic_add(adj_attributes, row, corners[2], weights[2] * seed)

    return interpolate_adjoint


def rasterize(clip_positions: wp.array, faces: wp.array, width: int, height: int) -> Fragments:
    """Find the face that each pixel sees, and where on that face.

    A face is drawn where it holds a pixel's center, however small it is, where 0 < z <= w (between the near
    plane and infinity); a face without area draws nothing.

    Args:
        clip_positions: Vertices in clip space (`warpshadow.stages.project.to_clip`), vec4, shape [batch, vertex].
        faces: Vertex indices, vec3i, shape [face].
        width: Image width [pixels], at most 32768.
        height: Image height [pixels], at most 32768.
    Returns:
        Fragments. Distances along the view are ``interpolate(fragments, faces, w)``.
    Raises:
        ValueError: naming the argument; so for NaN or Inf positions and for indices of no vertex. (Reading
            the two counts back waits for the device. While a CUDA graph is captured that cannot be, and
            nothing is checked.)
    Differentiable: barycentrics in clip_positions. Not: face_ids; nor a weight that is clamped to 0 where
        snapping put a pixel's center just outside of its face.
    """
    check.shape("clip_positions", clip_positions.shape, ("batch", "vertex"))
    check.shape("faces", faces.shape, ("face",))
    for name, size in (("width", width), ("height", height)):
        if not 1 <= size <= MAX_SIZE:
            raise ValueError(f"{name}: got {size!r}, expected 1 to {MAX_SIZE} pixels")
    face_ids = _visible_faces(clip_positions, faces, width, height)
    return Fragments(face_ids, barycentrics(face_ids, faces, clip_positions))


def barycentrics(face_ids: wp.array, faces: wp.array, clip_positions: wp.array) -> wp.array:
    """Find where on its face each pixel's center lies.

    Args:
        face_ids: Visible face or -1, int32, shape [batch, height, width].
        faces: Vertex indices, vec3i, shape [face].
        clip_positions: Vertices in clip space, vec4, shape [batch, vertex].
    Returns:
        Perspective-correct weights of the face's three vertices, vec3, shape [batch, height, width].
    Raises:
        ValueError: when the batches differ.
    Differentiable: clip_positions. Not: face_ids.
    """
    check.shape("clip_positions", clip_positions.shape, (face_ids.shape[0], "vertex"))
    device = clip_positions.device
    weights = wp.zeros(face_ids.shape, dtype=wp.vec3, device=device, requires_grad=clip_positions.requires_grad)
    width, flat = face_ids.shape[2], rows(weights)
    run = run_length(device, width)
    dim, cost = [face_ids.size // run], _PIXEL_COST * run
    inputs = [rows(face_ids), faces, clip_positions, width, run]
    launch_slices(_barycentrics, dim, cost=cost, inputs=inputs, outputs=[flat], device=device)

    def adjoint() -> None:
        launch_slices(
            _barycentrics_adjoint,
            dim,
            cost=3 * cost,
            inputs=[*inputs, flat.grad],
            outputs=[],
            sums=[clip_positions.grad],
            device=device,
        )

    record_adjoint(adjoint, [clip_positions, weights])
    return weights


def interpolate(fragments: Fragments, faces: wp.array, attributes: wp.array) -> wp.array:
    """Interpolate an attribute of the vertices over the pixels, perspective-correct.

    Args:
        fragments: What each pixel sees.
        faces: Indices of attributes, vec3i, shape [face]: the rasterized faces, or those of another topology
            of the same mesh (uv_faces), face by face.
        attributes: float32 or a vector of them (vec2, vec3, ...), shape [batch, attribute].
            Either batch may be 1 and then serves every instance of the other.
    Returns:
        Image, dtype of the attributes, shape [batch, height, width], zero where there is no face.
    Raises:
        ValueError: naming the argument, what it got and what it accepts.
    Differentiable: attributes, barycentrics of the fragments.
    """
    face_ids = fragments.face_ids
    check.shape("attributes", attributes.shape, ("batch", "attribute"))
    instances = common_batch({"fragments": face_ids, "attributes": attributes})
    if scalar_type(attributes.dtype) is not wp.float32:
        raise ValueError(f"attributes: got dtype {attributes.dtype.__name__}, expected float32 or a vector of them")
    image = wp.zeros(
        (instances, *face_ids.shape[1:]),
        dtype=attributes.dtype,
        device=face_ids.device,
        requires_grad=attributes.requires_grad or fragments.barycentrics.requires_grad,
    )
    device, flat = face_ids.device, rows(image)
    run = run_length(device, image.shape[2])
    run_count, cost = flat.shape[1] // run, _PIXEL_COST * run
    inputs = [*fragments.rows, faces, attributes, run]
    launch_slices(
        _interpolation(attributes.dtype),
        [instances * run_count],
        cost=cost,
        inputs=inputs,
        outputs=[flat],
        device=device,
    )

    def adjoint() -> None:
        launch_slices(
            _interpolation_adjoint(attributes.dtype),
            [run_count],
            cost=cost * instances,
            inputs=[*inputs, flat.grad],
            outputs=[rows(fragments.barycentrics.grad)],
            sums=[attributes.grad],
            device=device,
        )

    record_adjoint(adjoint, [fragments.barycentrics, attributes, image])
    return image


def _visible_faces(clip_positions: wp.array, faces: wp.array, width: int, height: int) -> wp.array:
    """Nearest face over each pixel, -1 where there is none, int32, shape [batch, height, width]."""
    device = clip_positions.device
    batch_count, vertex_count = clip_positions.shape
    corners = wp.empty((batch_count, vertex_count), dtype=wp.vec2i, device=device)
    depths = wp.empty((batch_count, vertex_count), dtype=float, device=device)
    keys = wp.zeros((batch_count, height, width), dtype=wp.int64, device=device)
    face_ids = wp.empty((batch_count, height, width), dtype=wp.int32, device=device)
    faults = wp.zeros(2, dtype=int, device=device)
    strip_count = _strip_count(device)
    wp.launch(
        _snap,
        dim=clip_positions.shape,
        inputs=[clip_positions, width, height],
        outputs=[corners, depths, faults],
        device=device,
        record_tape=False,
    )
    wp.launch(
        _cover,
        dim=(batch_count, faces.shape[0], strip_count),
        inputs=[clip_positions, corners, depths, faces, width, height, strip_count],
        outputs=[keys, faults],
        device=device,
        record_tape=False,
    )
    wp.launch(
        _resolve,
        dim=keys.size,
        inputs=[keys.flatten()],
        outputs=[face_ids.flatten()],
        device=device,
        record_tape=False,
    )
    if not device.is_capturing:
        bad_vertex_count, bad_face_count = faults.numpy().tolist()
        if bad_vertex_count:
            raise ValueError(f"clip_positions: got {bad_vertex_count} with NaN or Inf, expected finite numbers")
        if bad_face_count:
            raise ValueError(
                f"faces: got {bad_face_count} with an index out of range, expected 0 to {vertex_count - 1}"
            )
    return face_ids


def _strip_count(device: wp.Device) -> int:
    """Threads that share the rows of a face: on CUDA several, so that none draws a huge face alone."""
    return 16 if device.is_cuda else 1
