"""Silhouettes: where neighboring samples see different surfaces, and one surface ends between them.

The line between two samples is one of three: the edge where the surface of the nearer one ends before the center of the
other; the line where two surfaces intersect; or, where both see one surface, a crease, an edge across which normals
jump, and so does color. Lines are found between neighbors in a row and between neighbors in a column, oblique lines in
both. From one row (or column) to the next a line shifts by m samples; there it has the weight ω = 1 / (1 + m⁴).
"""

from dataclasses import dataclass

import warp as wp

from warpshadow import check
from warpshadow.device.capacities import sizes_of
from warpshadow.device.launch import launch
from warpshadow.device.memory import empty, filled
from warpshadow.device.parallel import run_length, split_row, strip_count
from warpshadow.stages.raster.rasterization import Fragments
from warpshadow.stages.raster.screen import (
    direction_sign,
    face_plane,
    half_size,
    has_neighbor,
    neighbor,
    orientation,
    sample_center,
)
from warpshadow.stages.silhouettes.areas import LineArea, measure_area
from warpshadow.stages.silhouettes.edges import SNAP, edge_of_crossing, find_half_edge, is_crease, is_silhouette
from warpshadow.stages.silhouettes.lines import (
    INTERSECTION,
    NOTHING,
    FragmentArrays,
    image_index,
    line_between,
    make_fragment_arrays,
)

wp.set_module_options({"max_unroll": 1})  # it compiles in 2.2 s instead of 3.1 s, and runs as fast


MAX_SAMPLES = 2**29 - 1  # samples of all images of a batch: int32 holds the stride, in bytes, of [4, sample]

MIN_OPENING = 1e-4
"""Relative change of two surfaces' distance over a sample, below which rounding hides where they intersect."""


_FACE_COST, _SAMPLE_COST, _ENTRY_COST = 50.0, 4.0, 3.2
"""Nanoseconds that a face takes, if it is small, a sample that is looked at for an intersection, and for an entry."""

# In place of the edge between two samples: it was not looked for yet, or there is none.
_UNKNOWN_EDGE, _NO_EDGE = NOTHING, -2


@dataclass(frozen=True, eq=False)
class Silhouettes:
    """Silhouettes of an image: an entry for every sample beside one.

    Args:
        samples: Number of the sample in the flat images [batch, height, width], −1 in an entry that is not used, int32
            of shape [entry].
        edges: Vertices a, b of the edge between it and its neighbor to the right, left, below and above, in the order
            in which the line a × b is positive on its surface; (−1, −1) where there is none, (−2, −2) where their
            faces intersect; vec2i of shape [entry, 4]. At a crease each of the two has the vertices of its own side.
        line_areas: The area of the sample that lies beyond each, :class:`.LineArea` of shape [entry, 4].
        entries: Entry of each sample of the flat images, −1 for none, int32 of shape [sample].
        faces: The rasterized faces, vec3i of shape [face].
    """

    samples: wp.array
    edges: wp.array
    line_areas: wp.array
    entries: wp.array
    fragments: Fragments
    faces: wp.array

    def flat_shape(self, images: wp.array) -> tuple[int, int]:
        """Shape of the images that the silhouettes serve, one after another: [images of each, sample of all]."""
        batch_count, height, width = self.fragments.face_ids.shape
        return images.shape[0] // batch_count, batch_count * height * width


# ---------------------------------------------------------------------------------------------------- edges


@wp.func
def _endpoint_on_screen(p: wp.vec4, q: wp.vec4, samples_per_unit: wp.vec2):
    """Screen position [samples] of the end p of an edge pq, clipped at the near plane."""
    near_distance = p[2] - p[3]
    endpoint = p
    if near_distance > 0.0:
        endpoint = p + (near_distance / (near_distance - (q[2] - q[3]))) * (q - p)
    return wp.vec2(
        (endpoint[0] / endpoint[3] + 1.0) * samples_per_unit[0], (endpoint[1] / endpoint[3] + 1.0) * samples_per_unit[1]
    )


@wp.func
def _center_count_before(coordinate: float, count: int):
    """Number of the ``count`` samples whose centers are before a coordinate [samples]."""
    return int(wp.clamp(wp.ceil(coordinate - 0.5), 0.0, float(count)))


@wp.kernel(enable_backward=False)
def _find_edges(
    first_row: int,
    worker: int,
    # in
    fragments: FragmentArrays,
    neighbors: wp.array(dtype=wp.vec3i),
    creases: wp.array(dtype=wp.int32),
    strips: int,
    # out
    half_edges: wp.array2d(dtype=wp.int32),
    crossings: wp.array2d(dtype=wp.int32),
):
    """A thread owns every ``strips``-th row and column that silhouette edges and creases of a face of an instance cut.

    Both faces of an edge follow it; the face over which the surface comes to the edge has its crossings. Several edges
    may pass between two samples: ``half_edges`` caches the visible one, for which all threads write the same value.
    """
    row_of_faces, strip = wp.tid()
    batch, face = split_row(first_row + row_of_faces, fragments.faces.shape[0])
    clip = fragments.clip_positions[batch]
    corners = fragments.faces[face]
    adjacent_faces = neighbors[face]
    samples_per_unit = half_size(fragments.width, fragments.height)
    volume = orientation(clip[corners[0]], clip[corners[1]], clip[corners[2]])
    for k in range(3):
        a = clip[corners[(k + 1) % 3]]
        b = clip[corners[(k + 2) % 3]]
        is_drawn_edge = a[3] > a[2] or b[3] > b[2]  # else it lies behind the near plane
        if is_drawn_edge and not is_silhouette(face, adjacent_faces[k], a, b, volume, fragments.faces, neighbors, clip):
            is_drawn_edge = is_crease(face, k, creases)
        if is_drawn_edge:
            screen_a = _endpoint_on_screen(a, b, samples_per_unit)
            screen_b = _endpoint_on_screen(b, a, samples_per_unit)
            for axis in range(2):
                # Said for axis 0: along rows, from the lower to the higher row. Axis 1 goes along columns.
                lower_end = wp.where(screen_a[1 - axis] < screen_b[1 - axis], screen_a, screen_b)
                upper_end = wp.where(screen_a[1 - axis] < screen_b[1 - axis], screen_b, screen_a)
                extent = upper_end[1 - axis] - lower_end[1 - axis]
                slope = (upper_end[axis] - lower_end[axis]) / wp.max(extent, 1.0e-30)
                row_count = wp.where(axis == 0, fragments.height, fragments.width)
                column_count = wp.where(axis == 0, fragments.width, fragments.height)
                row = _center_count_before(lower_end[1 - axis] - SNAP, row_count) + strip
                row_end = _center_count_before(upper_end[1 - axis] + SNAP, row_count)
                while row < row_end:
                    x = lower_end[axis] + slope * wp.clamp(float(row) + 0.5 - lower_end[1 - axis], 0.0, extent)
                    column = wp.max(_center_count_before(x - SNAP, column_count) - 1, 0)
                    column_end = wp.min(_center_count_before(x + SNAP, column_count), column_count - 1)
                    while column < column_end:
                        sample = batch * fragments.width * fragments.height
                        sample += wp.where(axis == 0, row * fragments.width + column, column * fragments.width + row)
                        if (
                            fragments.face_ids[sample]
                            != fragments.face_ids[neighbor(sample, 2 * axis, fragments.width)]
                        ):
                            half_edge = half_edges[axis, sample]
                            if half_edge == _UNKNOWN_EDGE:
                                half_edge = find_half_edge(fragments, neighbors, creases, sample, 2 * axis)
                                half_edges[axis, sample] = wp.where(half_edge < 0, _NO_EDGE, half_edge)
                            if half_edge == 3 * face + k:
                                crossings[axis, sample] = half_edge
                        column += 1
                    row += strips


# ---------------------------------------------------------------------------------------------------- intersections


@wp.func
def _intersects_between(fragments: FragmentArrays, sample: int, direction: int):
    """Whether the faces of a sample and its neighbor intersect between them, by more than rounding."""
    axis = direction // 2
    clip = fragments.clip_positions[image_index(fragments, sample)]
    line = line_between(fragments, sample, direction, wp.vec2i(INTERSECTION, INTERSECTION))
    center = sample_center(sample, fragments.width, fragments.height)
    inverse_depth = face_plane(fragments.faces[fragments.face_ids[sample]], center, clip)[2]
    opening_rate = -direction_sign(direction) * line[axis] / half_size(fragments.width, fragments.height)[axis]
    return opening_rate > MIN_OPENING * inverse_depth


@wp.kernel(enable_backward=False)
def _find_intersections(
    first_row: int,
    worker: int,
    # in
    fragments: FragmentArrays,
    neighbors: wp.array(dtype=wp.vec3i),
    bodies: wp.array(dtype=wp.int32),
    creases: wp.array(dtype=wp.int32),
    run: int,
    # out
    crossings: wp.array2d(dtype=wp.int32),
):
    """A thread owns ``run`` samples after one another: the crossings to their right and their lower neighbors."""
    first_sample = (first_row + wp.tid()) * run
    count = fragments.face_ids.shape[0]
    for sample in range(first_sample, wp.min(first_sample + run, count)):
        face = fragments.face_ids[sample]
        if face >= 0:
            # Nearly all samples end here, so this comes first, and without branches.
            body = bodies[face]
            right_body = bodies[wp.max(fragments.face_ids[wp.min(sample + 1, count - 1)], 0)]
            lower_body = bodies[wp.max(fragments.face_ids[wp.min(sample + fragments.width, count - 1)], 0)]
            if right_body != body or lower_body != body:
                for axis in range(2):
                    direction = 2 * axis
                    differs = wp.where(axis == 0, right_body, lower_body) != body
                    if differs and has_neighbor(sample, direction, fragments.width, fragments.height):
                        is_face = fragments.face_ids[neighbor(sample, direction, fragments.width)] >= 0
                        if is_face and _intersects_between(fragments, sample, direction):
                            half_edge = find_half_edge(fragments, neighbors, creases, sample, direction)
                            if half_edge < 0:
                                crossings[axis, sample] = INTERSECTION


# ---------------------------------------------------------------------------------------------------- entries


@wp.func
def _has_crossing(crossings: wp.array2d(dtype=wp.int32), sample: int, width: int):
    """Whether a line crosses between a sample and any of its neighbors; NOTHING has all bits."""
    preceding_crossings = crossings[0, wp.max(sample - 1, 0)] & crossings[1, wp.max(sample - width, 0)]
    if sample < width:
        preceding_crossings = crossings[0, wp.max(sample - 1, 0)]
    return (preceding_crossings & crossings[0, sample] & crossings[1, sample]) != NOTHING


@wp.kernel(enable_backward=False)
def _count_entries(
    first_row: int,
    worker: int,
    # in
    crossings: wp.array2d(dtype=wp.int32),
    width: int,
    run: int,
    # out
    entries: wp.array(dtype=wp.int32),
    counts: wp.array(dtype=wp.int32),
):
    """A thread owns ``run`` samples after one another: the number of each among samples that have an entry, else −1."""
    thread = first_row + wp.tid()
    count = int(0)
    for sample in range(thread * run, wp.min((thread + 1) * run, entries.shape[0])):
        has_entry = _has_crossing(crossings, sample, width)
        entries[sample] = wp.where(has_entry, count, -1)
        count += wp.where(has_entry, 1, 0)
    counts[thread] = count


@wp.kernel(enable_backward=False)
def _make_entries(
    first_row: int,
    worker: int,
    # in
    crossings: wp.array2d(dtype=wp.int32),
    fragments: FragmentArrays,
    neighbors: wp.array(dtype=wp.vec3i),
    creases: wp.array(dtype=wp.int32),
    ends: wp.array(dtype=wp.int32),
    run: int,
    # out
    samples: wp.array(dtype=wp.int32),
    edges: wp.array2d(dtype=wp.vec2i),
    line_areas: wp.array2d(dtype=LineArea),
    entries: wp.array(dtype=wp.int32),
):
    """A thread owns ``run`` samples after one another, whose entries begin where the run before ends.

    Samples for which there is no room get none.
    """
    thread = first_row + wp.tid()
    first_entry = int(0)
    if thread > 0:
        first_entry = ends[thread - 1]
    for sample in range(thread * run, wp.min((thread + 1) * run, entries.shape[0])):
        entry = int(-1)
        if entries[sample] >= 0 and first_entry + entries[sample] < samples.shape[0]:
            entry = first_entry + entries[sample]
            samples[entry] = sample
            for direction in range(4):
                edge = wp.vec2i(NOTHING, NOTHING)
                neighbor_edge = wp.vec2i(NOTHING, NOTHING)
                is_before = direction % 2 == 0  # crossings are of the sample before
                crossing_sample = wp.where(is_before, sample, neighbor(sample, direction, fragments.width))
                if crossing_sample >= 0:
                    axis = direction // 2
                    edge = edge_of_crossing(
                        fragments, neighbors, creases, crossings, crossing_sample, 2 * axis, not is_before
                    )
                    neighbor_edge = edge_of_crossing(
                        fragments, neighbors, creases, crossings, crossing_sample, 2 * axis, is_before
                    )
                edges[entry, direction] = edge
                line_areas[entry, direction] = measure_area(fragments, sample, direction, edge, neighbor_edge)
        entries[sample] = entry


def find_silhouettes(
    fragments: Fragments,
    faces: wp.array,
    neighbors: wp.array,
    clip_positions: wp.array,
    bodies: wp.array | None = None,
    creases: wp.array | None = None,
) -> Silhouettes:
    """Find the edges at which the surfaces in an image end, the lines where they intersect, and creases.

    Args:
        faces: The rasterized faces, vec3i of shape [face].
        neighbors: :func:`warpshadow.maths.adjacency.edge_neighbors` of the faces, vec3i of shape [face].
        clip_positions: Vertices in clip space, vec4 of shape [batch, vertex].
        bodies: Number of each face's body, int32 of shape [face]. Intersections are looked for between different ones;
            without it there are none, and where bodies intersect they have no gradient.
        creases: Of each face the edges that are creases, 2ᵏ for that opposite to corner k, int32 of shape [face]; None
            where there are none.
    Returns:
        Silhouettes. They have as many entries as need be: the count is read back, which waits for the device. In a
        graph there is room for some more, −1 for no sample (:mod:`warpshadow.device.capacities`).

    Not differentiable: which lines lie between which samples changes at isolated poses only.
    """
    check.shape("neighbors", neighbors.shape, faces.shape)
    check.shape("clip_positions", clip_positions.shape, (fragments.face_ids.shape[0], "vertex"))
    device, sample_count = faces.device, fragments.face_ids.size
    if sample_count > MAX_SAMPLES:
        raise ValueError(f"fragments: got {sample_count} samples in all, expected at most {MAX_SAMPLES}")
    arrays, strips = make_fragment_arrays(fragments, faces, clip_positions), strip_count(device)
    crossing_arrays = filled((4, sample_count), NOTHING, dtype=wp.int32, device=device)
    half_edges, crossings = crossing_arrays[:2], crossing_arrays[2:]  # 3 face + corner, or INTERSECTION
    if creases is not None:
        check.shape("creases", creases.shape, faces.shape)
    launch(
        _find_edges,
        (len(clip_positions) * faces.shape[0], strips),
        cost=_FACE_COST,
        inputs=[arrays, neighbors, creases, strips],
        outputs=[half_edges, crossings],
    )
    run = run_length(device, arrays.width)
    thread_count = -(-sample_count // run)
    if bodies is not None:
        check.shape("bodies", bodies.shape, faces.shape)
        inputs = [arrays, neighbors, bodies, creases, run]
        launch(_find_intersections, thread_count, cost=_SAMPLE_COST * run, inputs=inputs, outputs=[crossings])
    entries, ends = (empty(count, wp.int32, device) for count in (sample_count, thread_count))
    inputs = [crossings, arrays.width, run]
    launch(_count_entries, thread_count, cost=_ENTRY_COST * run, inputs=inputs, outputs=[entries, ends])
    entry_count = 0
    if thread_count:
        wp.utils.array_scan(ends, ends)
        entry_count = int(sizes_of("samples at silhouettes", ends[-1:], sample_count)[0])
    samples = filled(entry_count, -1, wp.int32, device) if device.is_capturing else empty(entry_count, wp.int32, device)
    edges, line_areas = (empty((entry_count, 4), dtype, device) for dtype in (wp.vec2i, LineArea))
    inputs, outputs = [crossings, arrays, neighbors, creases, ends, run], [samples, edges, line_areas, entries]
    launch(_make_entries, thread_count, cost=_ENTRY_COST * run, inputs=inputs, outputs=outputs)
    return Silhouettes(samples, edges, line_areas, entries, fragments, faces)
