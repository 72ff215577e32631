"""Receivers: the points at which light is evaluated, and how the samples of an image get theirs from them.

Receivers are vertices of visible faces, or for some bodies the points that pixels show: samples of a pixel that see the
same face share one, at the mean of their points. (With four samples a pixel that is 1.1 to 1.5 receivers a pixel, where
faces have 400 to 10 pixels.) The back of a face (:mod:`warpshadow.stages.sides`) has receivers of its own, at the same
points, with opposite normals.
"""

import itertools
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from warpshadow.device.batch import common_batch, instance_in, rows
from warpshadow.device.constants import constant
from warpshadow.device.launch import launch
from warpshadow.device.parallel import run_length
from warpshadow.stages.interpolate import at_point
from warpshadow.stages.rasterize import Fragments
from warpshadow.stages.sides import split_side, split_sides
from warpshadow.stages.silhouettes.find import Silhouettes


class Span(NamedTuple):
    """Receivers of one body that follow each other; of body −1 are those of all that share what blocks them."""

    body: int
    first: int
    end: int


class Receivers(NamedTuple):
    """Receivers of every instance.

    The first receivers are vertices of static bodies: they have indices, but no points and normals here. A sample of a
    pixel with a receiver r of its own sees a face (r, r, r), which follows the mesh's faces.
    """

    points: wp.array  # [batch, receiver − on static] vec3
    normals: wp.array  # [batch, receiver − on static] vec3
    faces: wp.array  # [face or side + own] vec3i, indices of receivers
    of_vertices: wp.array  # [vertex, then their backs if fragments have sides] int32, receiver or -1 for none
    fragments: Fragments  # of these faces
    on_static: np.ndarray = np.empty(0, int)  # [on static], the vertices that the first receivers are
    spans: tuple[Span, ...] = ()  # of the others, where bodies are told apart; () for one group
    vertices: wp.array | None = None  # [vertex receiver] int32, the vertices and backs that the first of them are, …
    seen: Fragments | None = None  # … and what the rest see: sides and barycentrics, [batch, own]; −1 for none

    def without_owners(self) -> "Receivers":
        """The same receivers, as points of which nobody knows the body."""
        return self._replace(spans=(), vertices=None, seen=None)


@wp.kernel
def _gather(
    # in
    positions: wp.array2d(dtype=wp.vec3),
    normals: wp.array2d(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    sides: wp.array2d(dtype=wp.int32),
    means: wp.array2d(dtype=wp.vec3),
    vertices: wp.array(dtype=wp.int32),
    samples: wp.array2d(dtype=wp.int32),
    # out
    points: wp.array2d(dtype=wp.vec3),
    point_normals: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a receiver: a vertex, or what samples share, named by the first of them, −1 for none."""
    batch, receiver = wp.tid()
    instance = instance_in(batch, positions.shape[0])
    own = receiver - vertices.shape[0]
    if own < 0:
        vertex, is_back = split_side(vertices[receiver], positions.shape[1])
        points[batch, receiver] = positions[instance, vertex]
        point_normals[batch, receiver] = wp.where(is_back, -1.0, 1.0) * normals[instance, vertex]
    else:
        side = int(0)
        weights = wp.vec3(1.0, 0.0, 0.0)
        view = instance_in(batch, sides.shape[0])
        sample = samples[view, own]
        if sample >= 0:
            side = sides[view, sample]
            weights = means[view, sample]
        face, is_back = split_side(side, faces.shape[0])
        points[batch, receiver] = at_point(positions[instance], faces[face], weights)
        normal = wp.normalize(at_point(normals[instance], faces[face], weights))
        point_normals[batch, receiver] = wp.where(is_back, -1.0, 1.0) * normal


@wp.kernel
def _gather_seen(
    # in
    sides: wp.array2d(dtype=wp.int32),
    means: wp.array2d(dtype=wp.vec3),
    samples: wp.array2d(dtype=wp.int32),
    # out
    seen_sides: wp.array2d(dtype=wp.int32),
    seen_barycentrics: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a receiver that samples share, named by the first of them, −1 for none."""
    view, own = wp.tid()
    sample = samples[view, own]
    if sample >= 0:
        seen_sides[view, own] = sides[view, sample]
        seen_barycentrics[view, own] = means[view, sample]
    else:
        seen_sides[view, own] = -1
        seen_barycentrics[view, own] = wp.vec3(1.0, 0.0, 0.0)


@wp.kernel(enable_backward=False)
def _find_sharing(
    # in
    sides: wp.array2d(dtype=wp.int32),
    wants_samples: wp.array(dtype=wp.bool),
    width: int,
    across: int,
    run: int,
    # out
    firsts: wp.array2d(dtype=wp.int32),
    counts: wp.array2d(dtype=wp.int32),
):
    """A thread owns a run of pixels; counts are zero before."""
    view, thread = wp.tid()
    pixels = width // across
    for pixel in range(thread * run, (thread + 1) * run):
        corner = (pixel // pixels * width + pixel % pixels) * across
        for i in range(across * across):
            sample = corner + i // across * width + i % across
            side = sides[view, sample]
            first = int(-1)
            if side >= 0 and wants_samples[wp.max(side, 0) % wants_samples.shape[0]]:
                first = sample
                for k in range(i):
                    other = corner + k // across * width + k % across
                    if first == sample and sides[view, other] == side:
                        first = other
                counts[view, first] = counts[view, first] + 1
            firsts[view, sample] = first


@wp.kernel
def _share(
    # in
    firsts: wp.array2d(dtype=wp.int32),
    counts: wp.array2d(dtype=wp.int32),
    barycentrics: wp.array2d(dtype=wp.vec3),
    # out
    means: wp.array2d(dtype=wp.vec3),
    weights: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a sample; means are zero before, and stand at the first sample that shares a receiver.

    All of the weight of those that do is on the first corner.
    """
    view, sample = wp.tid()
    first = firsts[view, sample]
    if first >= 0:
        wp.atomic_add(means, view, first, barycentrics[view, sample] / float(counts[view, first]))
        weights[view, sample] = wp.vec3(1.0, 0.0, 0.0)
    else:
        weights[view, sample] = barycentrics[view, sample]


@wp.kernel(enable_backward=False)
def _see_own(
    # in
    sides: wp.array2d(dtype=wp.int32),
    firsts: wp.array2d(dtype=wp.int32),
    numbers: wp.array2d(dtype=wp.int32),
    rooms: wp.array(dtype=wp.int32),
    side_count: int,
    # out
    own_sides: wp.array2d(dtype=wp.int32),
    samples: wp.array2d(dtype=wp.int32),
):
    """A thread owns a sample. Receivers have numbers, or else a room each in those of their face's body."""
    view, sample = wp.tid()
    side = sides[view, sample]
    first = firsts[view, sample]
    if first >= 0:
        number = rooms[side % rooms.shape[0]] * sides.shape[1] + first
        if numbers:
            number = numbers[view, first]
        if first == sample:
            samples[view, number] = sample
        side = side_count + number
    own_sides[view, sample] = side


@wp.kernel(enable_backward=False)
def _add_faces(
    # in
    faces: wp.array(dtype=wp.vec3i),
    receiver_count: int,
    # out
    with_own: wp.array(dtype=wp.vec3i),
):
    """A thread owns a face: of the mesh, or of an own receiver."""
    face = wp.tid()
    own = receiver_count + face - faces.shape[0]
    corners = wp.vec3i(own, own, own)
    if own < receiver_count:
        corners = faces[face]
    with_own[face] = corners


class Numbering(NamedTuple):
    """Which vertices are receivers, and their numbers."""

    vertices: (
        wp.array | None
    )  # [receiver − on static] int32, those not on static bodies; None for all vertices as they are
    on_static: np.ndarray  # [on static], those on static bodies, which are the first receivers
    faces: wp.array  # [face or side] vec3i
    of_vertices: wp.array  # [vertex, and their backs] int32, -1 for none
    spans: tuple[Span, ...] = ()  # of those not on static bodies, where bodies are told apart

    @property
    def moving_count(self) -> int:
        """Number of receivers at vertices that are not on static bodies."""
        return self.of_vertices.size if self.vertices is None else self.vertices.size

    @property
    def receiver_count(self) -> int:
        """Number of receivers at vertices."""
        return len(self.on_static) + self.moving_count


def number_receivers(
    faces: wp.array,
    keeps_vertex: np.ndarray,
    is_static: np.ndarray | None = None,
    sequence: np.ndarray | None = None,
    bodies: np.ndarray | None = None,
) -> Numbering:
    """Choose the vertices that are receivers.

    Args:
        faces: Vertex indices, vec3i of shape [face].
        keeps_vertex: Which are, bool of shape [1, vertex], or [2, vertex] with their backs: see :func:`seen_vertices`.
        is_static: Vertices of static bodies, bool of shape [vertex]; None if there are none.
        sequence: All vertices in the sequence in which they become receivers, shape [vertex]: light is found fastest
            where neighbors follow each other. None for the mesh's.
        bodies: Body of each vertex, −1 for those that need not be told apart, shape [vertex]: receivers of a body then
            follow each other. None where all share what blocks them.
    """
    device, (side_count, vertex_count) = faces.device, keeps_vertex.shape
    if side_count == 1 and keeps_vertex.all() and is_static is None and sequence is None and bodies is None:
        of_vertices = constant(np.arange(vertex_count), wp.int32, device)
        return Numbering(None, np.empty(0, int), faces, of_vertices)
    is_static = np.zeros(vertex_count, bool) if is_static is None else is_static
    sequence = np.arange(vertex_count) if sequence is None else sequence
    shifts = vertex_count * np.arange(side_count)
    sequence = (sequence + shifts[:, None]).ravel()
    if bodies is not None:
        bodies = np.tile(bodies, side_count)
        sequence = sequence[np.argsort(bodies[sequence], kind="stable")]
    stays, moves = (keeps_vertex & is_static).ravel(), (keeps_vertex & ~is_static).ravel()
    on_static, vertices = sequence[stays[sequence]], sequence[moves[sequence]]
    of_vertices = np.full(keeps_vertex.size, -1, np.int32)
    of_vertices[np.concatenate([on_static, vertices])] = np.arange(len(on_static) + len(vertices))
    corners = of_vertices[faces.numpy() + shifts[:, None, None]].reshape(-1, 3)
    return Numbering(
        wp.array(vertices, dtype=wp.int32, device=device),
        on_static,
        wp.array(corners, dtype=wp.vec3i, device=device),
        wp.array(of_vertices, dtype=wp.int32, device=device),
        () if bodies is None else _spans(bodies[vertices]),
    )


def _spans(bodies: np.ndarray) -> tuple[Span, ...]:
    """Runs of the same body."""
    changes = np.flatnonzero(np.diff(bodies)) + 1
    bounds = [0, *changes.tolist(), len(bodies)] if len(bodies) else []
    return tuple(Span(int(bodies[first]), first, end) for first, end in itertools.pairwise(bounds))


def find_receivers(
    positions: wp.array,
    normals: wp.array,
    faces: wp.array,
    fragments: Fragments,
    numbering: Numbering,
    wants_samples: np.ndarray,
    bodies: np.ndarray | None = None,
    across: int = 1,
) -> Receivers:
    """Gather the points at which light is evaluated.

    Args:
        positions: Vertices [scene units], vec3 of shape [batch, vertex].
        normals: Unit normals of the vertices, vec3 of shape [batch, vertex].
        faces: Vertex indices, vec3i of shape [face].
        fragments: What each sample sees, one batch for all or one each.
        numbering: The vertices that are receivers: all of those of a face that a sample sees, unless the face wants
            samples; with their backs where fragments have sides.
        wants_samples: Faces whose samples have receivers of their own, bool of shape [face].
        bodies: Body of each face, −1 for those that need not be told apart, shape [face]; None where all share what
            blocks them, as for :func:`number_receivers`.
        across: Samples of a pixel across and down: those that see the same face share a receiver.

    Returns:
        Receivers; where no face wants samples, many views of one geometry share them. While a graph is captured every
        sample has room for one.

    Differentiable: positions, normals, barycentrics of the fragments.
    """
    device = positions.device
    vertices, on_static, receiver_faces, of_vertices, spans = numbering
    sides = fragments.face_ids if fragments.sides is None else fragments.sides
    receiver_fragments = fragments if fragments.sides is None else Fragments(sides, fragments.barycentrics)
    own, own_count = _Own(receiver_fragments), 0
    batch_count = len(positions)
    if wants_samples.any():
        batch_count = common_batch({"positions": positions, "fragments": sides})
        side_count = len(receiver_faces)
        keys = np.zeros(len(faces), int) if bodies is None else bodies
        own, own_spans = _find_own(receiver_fragments, side_count, wants_samples, keys, across, numbering.moving_count)
        spans += own_spans
        own_count = own.samples.shape[1]
        all_faces = wp.empty(side_count + own_count, dtype=wp.vec3i, device=device)
        inputs = [receiver_faces, numbering.receiver_count]
        launch(_add_faces, all_faces.shape, inputs=inputs, outputs=[all_faces])
        receiver_faces = all_faces
    elif vertices is None:
        return Receivers(positions, normals, receiver_faces, of_vertices, receiver_fragments)
    vertices = of_vertices if vertices is None else vertices
    points, point_normals = (
        wp.empty((batch_count, vertices.size + own_count), dtype=wp.vec3, device=device) for _ in range(2)
    )
    launch(
        _gather,
        points.shape,
        inputs=[positions, normals, faces, rows(sides), own.means, vertices, own.samples],
        outputs=[points, point_normals],
    )
    found = Receivers(points, point_normals, receiver_faces, of_vertices, own.fragments, on_static)
    if bodies is None:
        return found
    return found._replace(spans=spans, vertices=vertices, seen=_seen(sides, own) if own_count else None)


def receivers_on_faces(
    positions: wp.array,
    normals: wp.array,
    faces: wp.array,
    sides: np.ndarray,
    barycentrics: np.ndarray,
    bodies: np.ndarray | None = None,
) -> Receivers:
    """Make receivers of given points on faces, for light alone: no image gets it from them.

    Args:
        positions: Vertices [scene units], vec3 of shape [batch, vertex].
        normals: Unit normals of the vertices, vec3 of shape [batch, vertex].
        faces: Vertex indices, vec3i of shape [face].
        sides: Faces, from the front or from behind, int of shape [receiver].
        barycentrics: Where on them, shape [receiver, 3].
        bodies: Body of each, −1 for those that need not be told apart, shape [receiver], runs of the same one after
            another. None where all share what blocks them.

    Differentiable: positions, normals.
    """
    device, count = positions.device, len(sides)
    points, point_normals = (wp.empty((len(positions), count), dtype=wp.vec3, device=device) for _ in range(2))
    none, every = (constant(np.arange(number), wp.int32, device) for number in (0, count))
    seen = Fragments(constant(sides[None], wp.int32, device), constant(barycentrics[None], wp.vec3, device))
    launch(
        _gather,
        points.shape,
        inputs=[positions, normals, faces, seen.face_ids, seen.barycentrics, none, every.reshape((1, count))],
        outputs=[points, point_normals],
    )
    spans = () if bodies is None else _spans(bodies)
    return Receivers(points, point_normals, faces, none, seen, spans=spans, vertices=none, seen=seen)


def _seen(sides: wp.array, own: "_Own") -> Fragments:
    """What own receivers see: sides and barycentrics [batch, own]. Differentiable: barycentrics."""
    shape = own.samples.shape
    seen = Fragments(*(wp.empty(shape, dtype=dtype, device=sides.device) for dtype in (wp.int32, wp.vec3)))
    inputs = [rows(sides), own.means, own.samples]
    launch(_gather_seen, shape, inputs=inputs, outputs=[seen.face_ids, seen.barycentrics])
    return seen


def seen_vertices(fragments: Fragments, silhouettes: Silhouettes, vertex_count: int) -> np.ndarray:
    """Find the vertices that have a part in an image: those of faces that samples see, and of edges at silhouettes.

    Args:
        fragments: What each sample sees, of any number of instances.
        silhouettes: Of :func:`warpshadow.stages.silhouettes.find.find_silhouettes`, whose edges have colors of their
            own.
        vertex_count: Number of vertices.

    Returns:
        bool of shape [1, vertex], or [2, vertex] where fragments have sides: what any instance sees, so that all have
        as many receivers.
    """
    faces, edges, face_count = silhouettes.faces.numpy(), silhouettes.edges.numpy(), len(silhouettes.faces)
    sides, side_count = (fragments.face_ids, 1) if fragments.sides is None else (fragments.sides, 2)
    is_seen = np.zeros(side_count * face_count + 1, bool)
    is_seen[sides.numpy()] = True  # the last item is for samples that see none
    takes_part = np.zeros((side_count, vertex_count), bool)
    side_of_edge = np.zeros(edges.shape, int)
    if side_count == 2:
        # an edge is seen from the side that one of the samples beside it sees, each of which has an entry for it
        _, is_back = split_sides(sides.numpy().ravel()[silhouettes.samples.numpy()], face_count)
        side_of_edge[:] = is_back[:, None, None]
    for side in range(side_count):
        takes_part[side, faces[is_seen[side * face_count : (side + 1) * face_count]]] = True
    takes_part[side_of_edge[edges >= 0], edges[edges >= 0]] = True
    return takes_part


class _Own(NamedTuple):
    """Receivers that samples have of their own."""

    fragments: Fragments  # of faces of their own, which follow the mesh's
    samples: Any = None  # [view, receiver] int32, the first sample of each, −1 for none
    means: wp.array | None = None  # [view, sample] vec3, at the first samples: mean barycentrics


def _find_own(
    fragments: Fragments, side_count: int, wants_samples: np.ndarray, bodies: np.ndarray, across: int, first: int
) -> tuple[_Own, tuple[Span, ...]]:
    """Let samples of a pixel that see the same side share a receiver. Differentiable: barycentrics.

    Receivers come body by body. While a graph is captured nobody knows how many there are, and each body has room for
    one at every sample.

    Args:
        side_count: Faces that receivers at vertices have.
        wants_samples, bodies: Of faces.
        across: Samples of a pixel across and down.
        first: What the receivers in the spans of bodies, which are returned, too, are counted from.
    """
    shape, device = fragments.face_ids.shape, fragments.face_ids.device
    sides, sample_count = rows(fragments.face_ids), shape[1] * shape[2]
    firsts, own_sides = (wp.empty(sides.shape, dtype=wp.int32, device=device) for _ in range(2))
    counts = wp.zeros(sides.shape, dtype=wp.int32, device=device)
    run = run_length(device, shape[2] // across)
    inputs = [sides, constant(wants_samples, wp.bool, device), shape[2], across, run]
    launch(_find_sharing, (shape[0], sample_count // across**2 // run), inputs=inputs, outputs=[firsts, counts])
    names = np.unique(bodies[wants_samples])
    rooms = constant(np.searchsorted(names, bodies), wp.int32, device)
    if device.is_capturing:
        numbers, ends = None, sample_count * np.arange(len(names) + 1)
        samples = wp.full((shape[0], int(ends[-1])), -1, dtype=wp.int32, device=device)
    else:
        is_first = firsts.numpy() == np.arange(sample_count)
        numbers_of, columns, ends = np.zeros(sides.shape, int), [], [0]
        bodies_seen = bodies[sides.numpy() % len(bodies)]
        for name in names:
            is_bodys = is_first & (bodies_seen == name)
            numbers_of[is_bodys] = ends[-1] + (np.cumsum(is_bodys, axis=1) - 1)[is_bodys]
            columns.append(_ragged(is_bodys))
            ends.append(ends[-1] + columns[-1].shape[1])
        samples = wp.array(np.concatenate(columns, axis=1), dtype=wp.int32, device=device)
        numbers = wp.array(numbers_of, dtype=wp.int32, device=device)
    inputs = [sides, firsts, numbers, rooms, side_count]
    launch(_see_own, sides.shape, inputs=inputs, outputs=[own_sides, samples])
    means, weights = (wp.zeros(sides.shape, dtype=wp.vec3, device=device) for _ in range(2))
    launch(_share, sides.shape, inputs=[firsts, counts, rows(fragments.barycentrics)], outputs=[means, weights])
    own = _Own(Fragments(own_sides.reshape(shape), weights.reshape(shape)), samples, means)
    starts = zip(names, *(first + np.array(bounds) for bounds in (ends[:-1], ends[1:])), strict=True)
    return own, tuple(Span(int(name), int(start), int(end)) for name, start, end in starts if end > start)


def _ragged(chosen: np.ndarray) -> np.ndarray:
    """Columns that are chosen in each row, −1 after the last: [row, most of a row]."""
    counts = chosen.sum(axis=1)
    columns = np.full((len(chosen), counts.max()), -1)
    row, column = np.nonzero(chosen)
    columns[row, np.concatenate([np.arange(count) for count in counts])] = column
    return columns
