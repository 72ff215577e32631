"""Rasterize triangles: which face each sample of an image sees, and where on it.

Samples and clip space follow :mod:`warpshadow.stages.raster.screen`. Coverage is decided in integers, so it is exact:
vertices snap to 1/4096 sample, a sample sees the face that holds its center, and a center on an edge belongs to one of
the two faces that share it (the top-left rule). Both sides of a face are drawn. Of the faces over a sample the nearest
wins; of equally near ones, that of the lowest index.

Coverage has no derivative. Barycentrics are computed from the face that a sample sees, and have one.
"""

import functools
from dataclasses import dataclass

import numpy as np
import warp as wp

from warpshadow import check
from warpshadow.device.array_checks import look_at_values
from warpshadow.device.batch import rows
from warpshadow.device.launch import launch
from warpshadow.device.memory import empty, reshaped, zeros
from warpshadow.device.parallel import run_length, split_row, strip_count, thread_count
from warpshadow.stages.raster.barycentrics import find_barycentrics

MAX_SIZE = 1 << 15  # largest image width or height [samples]: beyond, fixed-point edge functions could overflow

# Fixed-point positions [samples] have 12 fractional bits and, with sign, 29 bits in all. So edge coefficients
# have at most 30 bits, their products with positions 59, and their sums fit 64.
_ONE = 1 << 12
_HALF = _ONE // 2
_SHIFT = 12
_LIMIT = 1 << 28
_CLIPPED = -(1 << 31)  # the x of a vertex that has no fixed-point position: behind the eye or beyond the limit

# In boxes wider than this each row is trimmed to the span inside the edges; else testing samples is faster.
_TRIM_WIDTH = 8

_VERTEX_COST, _FACE_COST, _SAMPLE_COST = 15.0, 70.0, 1.6
"""Nanoseconds that a vertex and a face take, if faces are small, and a sample of one layer. Vertices of an image are
not shared by threads."""

_MIN_FACES_COST = 4.0  # of a layer, for one of its samples: less than that is not worth another layer

_INT32_MASK = (1 << 32) - 1
_DEPTH_ONE = 0x3F800000

_Edge = wp.types.vector(length=3, dtype=wp.int64)


@dataclass(frozen=True, eq=False)
class Fragments:
    """Fragment of each sample.

    Args:
        face_ids: Index of the visible face, -1 where there is none, int32, shape [batch, height, width].
        barycentrics: Perspective-correct weights of the face's three vertices, non-negative with sum 1, zero
            where there is no face, vec3, shape [batch, height, width].
        sides: Index of the visible side (`warpshadow.stages.raster.sides`), -1 where there is no face, int32, shape
            [batch, height, width]; None where no face is known to be seen from behind.
    """

    face_ids: wp.array
    barycentrics: wp.array
    sides: wp.array | None = None

    @functools.cached_property
    def rows(self) -> list[wp.array]:
        """The arrays as [batch, sample]."""
        return [rows(self.face_ids), rows(self.barycentrics)]

    @functools.cached_property
    def flat(self) -> list[wp.array]:
        """The arrays as [sample], instance after instance."""
        return [reshaped(self.face_ids, (-1,)), reshaped(self.barycentrics, (-1,))]


@wp.kernel(enable_backward=False)
def _snap_vertices(
    first_row: int,
    worker: int,
    # in
    clip_positions: wp.array2d(dtype=wp.vec4),
    width: int,
    height: int,
    # out
    corners: wp.array2d(dtype=wp.vec2i),
    depths: wp.array2d(dtype=float),
    fault_counts: wp.array2d(dtype=int),
):
    """One thread owns one vertex: its fixed-point position and its depth z/w."""
    row, vertex = wp.tid()
    instance = first_row + row
    p = clip_positions[instance, vertex]
    if not (wp.isfinite(p[0]) and wp.isfinite(p[1]) and wp.isfinite(p[2]) and wp.isfinite(p[3])):
        wp.atomic_add(fault_counts, instance, 0, 1)
    corner = wp.vec2i(_CLIPPED, _CLIPPED)
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
def _to_homogeneous(p: wp.vec4, width: int, height: int):
    """Clip position to homogeneous fixed-point coordinates."""
    w = wp.float64(p[3])
    x = (wp.float64(p[0]) + w) * wp.float64(width * _HALF)
    y = (wp.float64(p[1]) + w) * wp.float64(height * _HALF)
    return wp.vec3d(x, y, w)


@wp.func
def _clipped_edge(a: wp.vec3d, b: wp.vec3d, a_corner: wp.vec2i, b_corner: wp.vec2i):
    """Line of an edge with a vertex behind the eye or far away.

    In homogeneous coordinates the line is a x b, wherever its ends are. It is rounded to integers, made to
    pass through an end that has a snapped position, and computed in one order of a and b, so that both faces
    of the edge get the same.
    """
    if a_corner[0] != _CLIPPED and b_corner[0] != _CLIPPED:
        return _edge(a_corner, b_corner)
    is_swapped = a[0] > b[0] or (a[0] == b[0] and (a[1] > b[1] or (a[1] == b[1] and a[2] > b[2])))
    line = wp.where(is_swapped, wp.cross(b, a), wp.cross(a, b))
    sign = wp.where(is_swapped, wp.int64(-1), wp.int64(1))
    slope = wp.max(wp.abs(line[0]), wp.abs(line[1]))
    # The point of the line that is nearest to the origin; the line misses the screen if that is far.
    offset = wp.float64(0.0)
    if slope > wp.float64(0.0):
        line = line / slope
        offset = line[2] / (line[0] * line[0] + line[1] * line[1])
    anchor_x = wp.int64(0)
    anchor_y = wp.int64(0)
    if a_corner[0] != _CLIPPED:
        anchor_x = wp.int64(a_corner[0])
        anchor_y = wp.int64(a_corner[1])
    elif b_corner[0] != _CLIPPED:
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
def _first_index(fixed: int):
    """Least sample index whose center is not before a fixed-point position."""
    return (fixed + (_HALF - 1)) >> _SHIFT


@wp.func
def _shift_to_centers(edge: _Edge, sign: wp.int64):
    """Edge function of sample indices instead of positions, non-negative exactly on the samples inside.

    Top-left rule: a center on the line is inside if the inside lies to the right of the line or straight below it.
    """
    x = sign * edge[0]
    y = sign * edge[1]
    origin_value = sign * edge[2] + (x + y) * wp.int64(_HALF)
    if not (x > wp.int64(0) or (x == wp.int64(0) and y > wp.int64(0))):
        origin_value -= wp.int64(1)
    return _Edge(x * wp.int64(_ONE), y * wp.int64(_ONE), origin_value)


@wp.func
def _trim(columns: wp.vec2i, step: wp.int64, value: wp.int64):
    """Shrink a span of columns to where an edge function may be non-negative, with a column to spare."""
    if step == wp.int64(0):
        return columns
    zero_crossing = -wp.float64(value) / wp.float64(step)
    column = int(wp.clamp(zero_crossing, wp.float64(-2.0), wp.float64(MAX_SIZE)))
    if step > wp.int64(0):
        return wp.vec2i(wp.max(columns[0], column - 1), columns[1])
    return wp.vec2i(columns[0], wp.min(columns[1], column + 1))


@wp.func
def _unclipped_depth(
    a: wp.vec2i, b: wp.vec2i, c: wp.vec2i, area: wp.int64, depth_a: float, depth_b: float, depth_c: float
):
    """Depth of a face as a linear function of sample indices: p[0] column + p[1] row + p[2]."""
    scale = wp.float64(_ONE) / wp.float64(area)
    depth_step_ab = wp.float64(depth_b - depth_a) * scale
    depth_step_ac = wp.float64(depth_c - depth_a) * scale
    x = depth_step_ab * wp.float64(c[1] - a[1]) - depth_step_ac * wp.float64(b[1] - a[1])
    y = depth_step_ac * wp.float64(b[0] - a[0]) - depth_step_ab * wp.float64(c[0] - a[0])
    column = wp.float64(a[0] - _HALF) / wp.float64(_ONE)
    row = wp.float64(a[1] - _HALF) / wp.float64(_ONE)
    return wp.vec3d(x, y, wp.float64(depth_a) - x * column - y * row)


@wp.func
def _clipped_depth(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, z: wp.vec3d):
    """`_unclipped_depth` for a face with vertices behind the eye or far away."""
    cross_ab = wp.cross(a, b)
    p = (z[0] * wp.cross(b, c) + z[1] * wp.cross(c, a) + z[2] * cross_ab) / wp.dot(cross_ab, c)
    half = wp.float64(_HALF)
    one = wp.float64(_ONE)
    return wp.vec3d(p[0] * one, p[1] * one, p[2] + (p[0] + p[1]) * half)


@wp.func
def _is_outside(a: wp.vec4, b: wp.vec4, c: wp.vec4):
    """Whether all of a face lies beyond one side of the view frustum."""
    return (
        (a[0] > a[3] and b[0] > b[3] and c[0] > c[3])
        or (a[0] < -a[3] and b[0] < -b[3] and c[0] < -c[3])
        or (a[1] > a[3] and b[1] > b[3] and c[1] > c[3])
        or (a[1] < -a[3] and b[1] < -b[3] and c[1] < -c[3])
        or (a[2] > a[3] and b[2] > b[3] and c[2] > c[3])
        or (a[2] <= 0.0 and b[2] <= 0.0 and c[2] <= 0.0)
    )


@wp.struct
class _ScreenFace:
    """A face over the samples of an image."""

    is_drawn: bool  # not where it is outside, or seen from the side
    a: _Edge  # edge functions of sample indices, non-negative on the samples inside
    b: _Edge
    c: _Edge
    depth: wp.vec3d  # of sample indices: linear, as the edges
    min_depth_bits: int  # of the float32 depth at its samples
    max_depth_bits: int


@wp.func
def _place_unclipped(a: wp.vec2i, b: wp.vec2i, c: wp.vec2i, depth_a: float, depth_b: float, depth_c: float):
    """A face of snapped vertices."""
    face = _ScreenFace()
    edge_c = _edge(a, b)
    area = edge_c[0] * wp.int64(c[0]) + edge_c[1] * wp.int64(c[1]) + edge_c[2]
    if area != wp.int64(0):
        sign = wp.where(area > wp.int64(0), wp.int64(1), wp.int64(-1))
        face.is_drawn = True
        face.a = _shift_to_centers(_edge(b, c), sign)
        face.b = _shift_to_centers(_edge(c, a), sign)
        face.c = _shift_to_centers(edge_c, sign)
        face.depth = _unclipped_depth(a, b, c, area, depth_a, depth_b, depth_c)
        # Rounding must not carry the depth of a sliver beyond that of its vertices.
        face.min_depth_bits = wp.cast(wp.min(depth_a, wp.min(depth_b, depth_c)), wp.int32)
        face.max_depth_bits = wp.cast(wp.max(depth_a, wp.max(depth_b, depth_c)), wp.int32)
    return face


@wp.func
def _place_clipped(
    clip_a: wp.vec4, clip_b: wp.vec4, clip_c: wp.vec4, a: wp.vec2i, b: wp.vec2i, c: wp.vec2i, width: int, height: int
):
    """A face with vertices behind the eye or far away."""
    face = _ScreenFace()
    if not _is_outside(clip_a, clip_b, clip_c):
        fixed_a = _to_homogeneous(clip_a, width, height)
        fixed_b = _to_homogeneous(clip_b, width, height)
        fixed_c = _to_homogeneous(clip_c, width, height)
        volume = wp.dot(wp.cross(fixed_a, fixed_b), fixed_c)
        if volume != wp.float64(0.0):
            sign = wp.where(volume > wp.float64(0.0), wp.int64(1), wp.int64(-1))
            face.is_drawn = True
            face.a = _shift_to_centers(_clipped_edge(fixed_b, fixed_c, b, c), sign)
            face.b = _shift_to_centers(_clipped_edge(fixed_c, fixed_a, c, a), sign)
            face.c = _shift_to_centers(_clipped_edge(fixed_a, fixed_b, a, b), sign)
            z = wp.vec3d(wp.float64(clip_a[2]), wp.float64(clip_b[2]), wp.float64(clip_c[2]))
            face.depth = _clipped_depth(fixed_a, fixed_b, fixed_c, z)
            face.max_depth_bits = int(_DEPTH_ONE + 1)
    return face


@wp.func
def _draw_row(face: _ScreenFace, face_bits: wp.int64, row: int, left: int, right: int, keys: wp.array(dtype=wp.int64)):
    """Offer a face to the samples of a row, from a column to another."""
    y = wp.int64(row)
    inside_a = face.a[1] * y + face.a[2]
    inside_b = face.b[1] * y + face.b[2]
    inside_c = face.c[1] * y + face.c[2]
    columns = wp.vec2i(left, right)
    if right - left >= _TRIM_WIDTH:
        columns = _trim(columns, face.a[0], inside_a)
        columns = _trim(columns, face.b[0], inside_b)
        columns = _trim(columns, face.c[0], inside_c)
    column = columns[0]
    x = wp.int64(column)
    inside_a += face.a[0] * x
    inside_b += face.b[0] * x
    inside_c += face.c[0] * x
    depth_of_row = face.depth[1] * wp.float64(row) + face.depth[2]
    while column <= columns[1]:
        if (inside_a | inside_b | inside_c) >= wp.int64(0):
            depth = float(face.depth[0] * wp.float64(column) + depth_of_row)
            bits = wp.clamp(wp.cast(depth, wp.int32), face.min_depth_bits, face.max_depth_bits)
            if bits > 0 and bits <= _DEPTH_ONE:
                key = (wp.int64(bits) << wp.int64(32)) | face_bits
                if key > keys[column]:
                    wp.atomic_max(keys, column, key)
        inside_a += face.a[0]
        inside_b += face.b[0]
        inside_c += face.c[0]
        column += 1


@wp.kernel(enable_backward=False)
def _rasterize_faces(
    first_row: int,
    worker: int,
    # in
    clip_positions: wp.array2d(dtype=wp.vec4),
    corners: wp.array2d(dtype=wp.vec2i),
    depths: wp.array2d(dtype=float),
    faces: wp.array(dtype=wp.vec3i),
    width: int,
    height: int,
    strip_step: int,
    layer_count: int,
    # out
    keys: wp.array3d(dtype=wp.int64),
    fault_counts: wp.array2d(dtype=int),
):
    """One thread owns every ``strip_step``-th row of one face and offers the face to the samples of a layer there.

    A sample keeps the largest key: nearest depth above, lowest face below. Zero is the background. An image has several
    layers, each with a part of the faces, so that threads can share it.
    """
    row_of_layer, face_in_layer, strip = wp.tid()
    layer_index = first_row + row_of_layer
    instance, layer = split_row(layer_index, layer_count)
    face_count = faces.shape[0]
    face_id = layer * face_count // layer_count + face_in_layer
    if face_id >= (layer + 1) * face_count // layer_count:
        return
    vertices = faces[face_id]
    if wp.min(vertices) < 0 or wp.max(vertices) >= corners.shape[1]:
        if strip == 0:
            wp.atomic_add(fault_counts, layer_index, 1, 1)
        return
    a = corners[instance, vertices[0]]
    b = corners[instance, vertices[1]]
    c = corners[instance, vertices[2]]
    is_clipped = a[0] == _CLIPPED or b[0] == _CLIPPED or c[0] == _CLIPPED

    left = 0
    right = width - 1
    top = 0
    bottom = height - 1
    if not is_clipped:
        left = wp.max(left, _first_index(wp.min(a[0], wp.min(b[0], c[0]))))
        right = wp.min(right, _first_index(wp.max(a[0], wp.max(b[0], c[0])) + 1) - 1)
        top = wp.max(top, _first_index(wp.min(a[1], wp.min(b[1], c[1]))))
        bottom = wp.min(bottom, _first_index(wp.max(a[1], wp.max(b[1], c[1])) + 1) - 1)
    if left > right or top > bottom:
        return

    face = _ScreenFace()
    if is_clipped:
        clip = clip_positions[instance]
        face = _place_clipped(clip[vertices[0]], clip[vertices[1]], clip[vertices[2]], a, b, c, width, height)
    else:
        depth = depths[instance]
        face = _place_unclipped(a, b, c, depth[vertices[0]], depth[vertices[1]], depth[vertices[2]])
    if face.is_drawn:
        row = top + strip
        while row <= bottom:
            _draw_row(face, wp.int64(_INT32_MASK) - wp.int64(face_id), row, left, right, keys[layer_index, row])
            row += strip_step


@wp.kernel(enable_backward=False)
def _resolve_layers(
    first_row: int,
    worker: int,
    # in
    keys: wp.array3d(dtype=wp.int64),
    run: int,
    # out
    face_ids: wp.array2d(dtype=wp.int32),
):
    """One thread owns a run of samples: the face in the largest key of all layers, and -1 for the key zero."""
    instance, thread = split_row(first_row + wp.tid(), keys.shape[2] // run)
    first_layer = keys[instance, 0]
    instance_faces = face_ids[instance]
    for sample in range(thread * run, (thread + 1) * run):
        key = first_layer[sample]
        for layer in range(1, keys.shape[1]):
            key = wp.max(key, keys[instance, layer, sample])
        instance_faces[sample] = ~wp.int32(key)


def rasterize(clip_positions: wp.array, faces: wp.array, width: int, height: int) -> Fragments:
    """Find the face that each sample sees, and where on that face.

    A face is drawn where it holds a sample's center, and 0 < z <= w (between the near plane and infinity).

    Args:
        clip_positions: Vertices in clip space, of :func:`warpshadow.stages.raster.project.to_clip`, vec4, shape [batch,
            vertex].
        faces: Vertex indices, vec3i, shape [face].
        width: Image width [samples], at most 32768.
        height: Image height [samples], at most 32768.
    Returns:
        Fragments. Distances along the view are ``interpolate(fragments, faces, w)``.
    Raises:
        ValueError: for NaN or Inf positions and for indices of no vertex. (Reading the two counts back waits for the
            device. While a CUDA graph is captured that cannot be, and nothing is checked.)
    Differentiable: barycentrics in clip_positions. Not: face_ids; nor a weight that is clamped to 0 where
        snapping put a sample's center just outside of its face.
    """
    check.shape("clip_positions", clip_positions.shape, ("batch", "vertex"))
    check.shape("faces", faces.shape, ("face",))
    for name, size in (("width", width), ("height", height)):
        if not 1 <= size <= MAX_SIZE:
            raise ValueError(f"{name}: got {size!r}, expected 1 to {MAX_SIZE} samples")
    face_ids = _visible_faces(clip_positions, faces, width, height)
    return Fragments(face_ids, find_barycentrics(face_ids, faces, clip_positions))


def _visible_faces(clip_positions: wp.array, faces: wp.array, width: int, height: int) -> wp.array:
    """Nearest face over each sample, -1 where there is none, int32, shape [batch, height, width]."""
    device = clip_positions.device
    batch_count, vertex_count = clip_positions.shape
    layer_count, strip_step, run = 1, strip_count(device), run_length(device, width)
    if device.is_cpu and batch_count:  # layers for threads that have no image of their own
        layer_bound = _FACE_COST * faces.shape[0] / (_MIN_FACES_COST * width * height)
        layer_count = max(1, min(thread_count() // batch_count, int(layer_bound)))
    corners = empty((batch_count, vertex_count), dtype=wp.vec2i, device=device)
    depths = empty((batch_count, vertex_count), dtype=float, device=device)
    make_scratch = functools.partial(zeros, device=device, outlives_recording=False)
    keys = make_scratch((batch_count * layer_count, height, width), wp.int64)
    face_ids = empty((batch_count, height, width), dtype=wp.int32, device=device)
    fault_counts = make_scratch((batch_count * layer_count, 2), wp.int32)
    launch(
        _snap_vertices,
        clip_positions.shape,
        cost=_VERTEX_COST,
        inputs=[clip_positions, width, height],
        outputs=[corners, depths, fault_counts],
    )
    launch(
        _rasterize_faces,
        (batch_count * layer_count, -(-faces.shape[0] // layer_count), strip_step),
        cost=_FACE_COST,
        inputs=[clip_positions, corners, depths, faces, width, height, strip_step, layer_count],
        outputs=[keys, fault_counts],
    )
    launch(
        _resolve_layers,
        face_ids.size // run,
        cost=_SAMPLE_COST * layer_count * run,
        inputs=[reshaped(keys, (batch_count, layer_count, height * width)), run],
        outputs=[rows(face_ids)],
    )

    def judge(counts: np.ndarray) -> None:
        bad_vertex_count, bad_face_count = counts.sum(axis=0).tolist()
        if bad_vertex_count:
            raise ValueError(f"clip_positions: got {bad_vertex_count} with NaN or Inf, expected finite numbers")
        if bad_face_count:
            raise ValueError(
                f"faces: got {bad_face_count} with an index out of range, expected 0 to {vertex_count - 1}"
            )

    look_at_values(fault_counts, judge)
    return face_ids
