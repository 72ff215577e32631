"""Receivers at vertices: which vertices an image sees, and their numbers as receivers."""

from typing import NamedTuple

import numpy as np
import warp as wp

from warpshadow.device.constants import cached_by_values, constant
from warpshadow.device.launch import launch
from warpshadow.device.memory import empty, from_numpy, reshaped, zeros
from warpshadow.device.parallel import run_length
from warpshadow.stages.raster.rasterization import Fragments
from warpshadow.stages.raster.sides import split_side
from warpshadow.stages.receivers.body_spans import Span, spans_between, spans_of
from warpshadow.stages.receivers.numbering import number_items
from warpshadow.stages.silhouettes.silhouettes import Silhouettes

_MARK_COST = 5.0  # nanoseconds that a sample takes, to mark the corners of its face


class Numbering(NamedTuple):
    """Vertices that are receivers, and their indices."""

    # [receiver − on static] int32, receivers not on static bodies; None for all vertices as they are
    vertices: wp.array | None
    static_vertices: np.ndarray  # [static vertex], the receivers on static bodies, which come first
    receiver_of_vertex: wp.array  # [vertex, and their backs] int32, -1 for none
    spans: tuple[Span, ...] = ()  # of receivers not on static bodies, by body; () where no body is distinct

    @property
    def moving_count(self) -> int:
        """Number of receivers at vertices that are not on static bodies."""
        return self.receiver_of_vertex.size if self.vertices is None else self.vertices.size

    @property
    def receiver_count(self) -> int:
        """Number of receivers at vertices."""
        return len(self.static_vertices) + self.moving_count


def number_receivers(
    keeps_vertex: np.ndarray,
    is_static: np.ndarray | None = None,
    sequence: np.ndarray | None = None,
    bodies: np.ndarray | None = None,
    *,
    device: wp.DeviceLike,
) -> Numbering:
    """Choose the vertices that are receivers.

    Args:
        keeps_vertex: Which are, bool of shape [1, vertex], or [2, vertex] with their backs: see :func:`seen_vertices`.
        is_static: Vertices of static bodies, bool of shape [vertex]; None if there are none.
        sequence: All vertices in the sequence in which they become receivers, shape [vertex]: light is found fastest
            where neighbors follow each other. None for the mesh's.
        bodies: Body of each vertex, −1 where it is not distinct, shape [vertex]: receivers of a body
            then follow each other. None where no body is distinct.
        device: Where they are.
    """
    side_count, vertex_count = keeps_vertex.shape
    if side_count == 1 and keeps_vertex.all() and is_static is None and sequence is None and bodies is None:
        receiver_of_vertex = constant(np.arange(vertex_count), wp.int32, device)
        return Numbering(None, np.empty(0, int), receiver_of_vertex)
    sequence, bodies = _order_sides(vertex_count, side_count, sequence, bodies)
    is_moving_receiver, static_vertices = keeps_vertex.ravel(), np.empty(0, int)
    if is_static is not None:
        is_moving_receiver, is_static_receiver = (keeps_vertex & ~is_static).ravel(), (keeps_vertex & is_static).ravel()
        static_vertices = sequence[is_static_receiver[sequence]]
    vertices = sequence[is_moving_receiver[sequence]]
    receiver_of_vertex = np.full(keeps_vertex.size, -1, np.int32)
    receiver_of_vertex[static_vertices] = np.arange(len(static_vertices))
    receiver_of_vertex[vertices] = len(static_vertices) + np.arange(len(vertices))
    return Numbering(
        from_numpy(vertices, dtype=wp.int32, device=device),
        static_vertices,
        from_numpy(receiver_of_vertex, dtype=wp.int32, device=device),
        () if bodies is None else spans_of(bodies[vertices]),
    )


@cached_by_values
def _order_sides(
    vertex_count: int, side_count: int, sequence: np.ndarray | None, bodies: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray | None]:
    """Order vertices, and then their backs, body by body: their sequence, and the body of each vertex and back."""
    sequence = np.arange(vertex_count) if sequence is None else sequence
    sequence = (sequence + vertex_count * np.arange(side_count)[:, None]).ravel()
    if bodies is not None:
        bodies = np.tile(bodies, side_count)
        sequence = sequence[np.argsort(bodies[sequence], kind="stable")]
    return sequence, bodies


@wp.kernel(enable_backward=False)
def _mark_visible_corners(
    first_row: int,
    worker: int,
    # in
    sides: wp.array(dtype=wp.int32),
    faces: wp.array(dtype=wp.vec3i),
    run: int,
    # out
    is_visible: wp.array2d(dtype=wp.bool),
):
    """A thread owns a run of samples: it marks the corners of the sides that they see."""
    thread = first_row + wp.tid()
    last_side = int(-1)
    for sample in range(thread * run, (thread + 1) * run):
        side = sides[sample]
        if side != last_side and side >= 0:
            face, is_back = split_side(side, faces.shape[0])
            corners = faces[face]
            for k in range(3):
                is_visible[wp.where(is_back, 1, 0), corners[k]] = True
        last_side = side


@wp.kernel(enable_backward=False)
def _mark_edges(
    # in
    samples: wp.array(dtype=wp.int32),
    edges: wp.array2d(dtype=wp.vec2i),
    sides: wp.array(dtype=wp.int32),
    face_count: int,
    # out
    is_visible: wp.array2d(dtype=wp.bool),
):
    """A thread owns an entry of silhouettes: it marks the ends of its edges, on the side that its sample sees."""
    entry = wp.tid()
    sample = int(0)
    if samples:
        sample = samples[entry]
    row = int(0)
    if is_visible.shape[0] > 1 and sample >= 0:
        _, is_back = split_side(sides[sample], face_count)
        row = wp.where(is_back, 1, 0)
    if sample >= 0:
        for direction in range(4):
            edge = edges[entry, direction]
            for k in range(2):
                if edge[k] >= 0:
                    is_visible[row, edge[k]] = True


def seen_vertices(fragments: Fragments, silhouettes: Silhouettes, vertex_count: int) -> np.ndarray:
    """Find the vertices that have a part in an image, as :func:`mark_seen_vertices` does, on the host."""
    return mark_seen_vertices(fragments, silhouettes, vertex_count).numpy()


def mark_seen_vertices(fragments: Fragments, silhouettes: Silhouettes, vertex_count: int) -> wp.array:
    """Find the vertices that have a part in an image: corners of visible faces, and of edges at silhouettes.

    Args:
        fragments: The fragments, of any number of instances.
        silhouettes: Of :func:`warpshadow.stages.silhouettes.silhouettes.find_silhouettes`, whose edges have colors of
            their own.
        vertex_count: Number of vertices.
    Returns:
        bool of shape [1, vertex], or [2, vertex] where fragments have sides: the union over all instances, so that all
        have as many receivers.
    """
    sides, side_count = (fragments.face_ids, 1) if fragments.sides is None else (fragments.sides, 2)
    device, flat_sides = sides.device, reshaped(sides, (-1,))
    is_visible = zeros((side_count, vertex_count), wp.bool, device, outlives_recording=False)
    run = run_length(device, sides.shape[2])
    launch(
        _mark_visible_corners,
        sides.size // run,
        cost=_MARK_COST * run,
        inputs=[flat_sides, silhouettes.faces, run],
        outputs=[is_visible],
    )
    inputs = [silhouettes.samples, silhouettes.edges, flat_sides, len(silhouettes.faces)]
    launch(_mark_edges, len(silhouettes.edges), inputs=inputs, outputs=[is_visible])
    return is_visible


class VertexKeys(NamedTuple):
    """Vertices that may be receivers, and in which order they become such, for :func:`number_seen_vertices`."""

    ranks: wp.array  # [vertex, and their backs] int32, rank of the body of each that may be a receiver, else −1
    order: wp.array  # [vertex, and their backs] int32, all of them in this order
    bodies: tuple[int, ...]  # of each rank, −1 where it is not distinct
    first_vertices: wp.array  # [rank] int32, a vertex of each that may be a receiver


def vertex_keys(
    may_receive: np.ndarray, sequence: np.ndarray | None, bodies: np.ndarray | None, device: wp.DeviceLike
) -> VertexKeys:
    """Prepare the numbering of vertices.

    Args:
        may_receive: Which may be receivers, bool of shape [1, vertex], or [2, vertex] with their backs.
        sequence, bodies: As for :func:`number_receivers`.
    """
    side_count, vertex_count = may_receive.shape
    order, body_of_item = _order_sides(vertex_count, side_count, sequence, bodies)
    body_of_item = np.full(may_receive.size, -1) if body_of_item is None else body_of_item
    items = np.flatnonzero(may_receive)
    body_ids, first_items = np.unique(body_of_item[items], return_index=True)
    ranks = np.where(may_receive.ravel(), np.searchsorted(body_ids, body_of_item), -1)
    arrays = (constant(numbers, wp.int32, device) for numbers in (ranks, order, items[first_items]))
    ranks_on_device, order_on_device, first_vertices = arrays
    return VertexKeys(ranks_on_device, order_on_device, tuple(body_ids.tolist()), first_vertices)


@wp.kernel(enable_backward=False)
def _find_ranks_of_seen(
    # in
    is_seen: wp.array(dtype=wp.bool),
    ranks: wp.array(dtype=wp.int32),
    # out
    ranks_of_seen: wp.array2d(dtype=wp.int32),
):
    """A thread owns a vertex or its back."""
    vertex = wp.tid()
    ranks_of_seen[0, vertex] = wp.where(is_seen[vertex], ranks[vertex], -1)


@wp.kernel(enable_backward=False)
def _fill_room(
    # in
    ends: wp.array(dtype=wp.int32),
    first_vertices: wp.array(dtype=wp.int32),
    # out
    vertices: wp.array(dtype=wp.int32),
):
    """A thread owns a receiver: where there is room for more, it is a vertex of the same body."""
    receiver = wp.tid()
    if vertices[receiver] < 0:
        vertices[receiver] = first_vertices[wp.lower_bound(ends, receiver + 1) - 1]


def number_seen_vertices(is_seen: wp.array, keys: VertexKeys, *, are_distinct: bool) -> Numbering:
    """Choose the vertices that are receivers on the device.

    Args:
        is_seen: Of :func:`mark_seen_vertices`.
        keys: Which may be, for as many sides.
        are_distinct: Whether any body is distinct.
    """
    device = is_seen.device
    ranks = empty((1, is_seen.size), dtype=wp.int32, device=device)
    launch(_find_ranks_of_seen, is_seen.size, inputs=[reshaped(is_seen, (-1,)), keys.ranks], outputs=[ranks])
    no_static_vertices = np.empty(0, int)
    if not keys.bodies:
        return Numbering(constant(no_static_vertices, wp.int32, device), no_static_vertices, reshaped(ranks, (-1,)))
    numbers, items, ends, ends_on_device = number_items("receivers at vertices", ranks, len(keys.bodies), keys.order)
    vertices, receiver_of_vertex = (reshaped(array, (-1,)) for array in (items, numbers))
    if device.is_capturing:
        if not vertices.size:
            raise RuntimeError("a graph is captured of an image without receivers at vertices")
        launch(_fill_room, vertices.size, inputs=[ends_on_device, keys.first_vertices], outputs=[vertices])
    spans = spans_between(keys.bodies, ends) if are_distinct else ()
    return Numbering(vertices, no_static_vertices, receiver_of_vertex, spans)
