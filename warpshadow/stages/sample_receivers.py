"""Sample receivers: points that samples see, at which light is evaluated for them.

Samples of a pixel that see the same side share one, at the mean of their points: with four samples a pixel that is 1.1
to 1.5 receivers a pixel, where faces have 400 to 10 pixels. In squares of a quadtree there is one at each corner, and
samples interpolate in triangles of these.
"""

import itertools
from typing import NamedTuple

import numpy as np
import warp as wp

from warpshadow.device.batch import rows
from warpshadow.device.constants import constant
from warpshadow.device.launch import differentiable, launch
from warpshadow.device.parallel import run_length
from warpshadow.stages.quadtree import Quadtree, sample_at
from warpshadow.stages.rasterize import Fragments

TILE = 16
"""Pixels of a side of the tiles whose receivers follow each other."""


class Span(NamedTuple):
    """Receivers of one body that follow each other; of body −1 are those of all that share what blocks them."""

    body: int
    first: int
    end: int


def spans_of(bodies: np.ndarray) -> tuple[Span, ...]:
    """Runs of the same body."""
    changes = np.flatnonzero(np.diff(bodies)) + 1
    bounds = [0, *changes.tolist(), len(bodies)] if len(bodies) else []
    return tuple(Span(int(bodies[first]), first, end) for first, end in itertools.pairwise(bounds))


class SampleReceivers(NamedTuple):
    """Receivers that samples have."""

    fragments: Fragments  # of the mesh's sides, then of a face for each receiver, then of triangles
    seen: Fragments  # sides and barycentrics that receivers see, [view, receiver]; −1 for none
    triangles: np.ndarray  # [triangle, 3], the receivers in which others interpolate
    spans: tuple[Span, ...]


@wp.kernel(enable_backward=False)
def _find_sharing(
    # in
    sides: wp.array2d(dtype=wp.int32),
    barycentrics: wp.array2d(dtype=wp.vec3),
    wants_samples: wp.array(dtype=wp.bool),
    sizes: wp.array3d(dtype=wp.int32),
    numbers: wp.array3d(dtype=wp.int32),
    is_corner: wp.array2d(dtype=wp.bool),
    keys: wp.array(dtype=wp.int32),
    width: int,
    across: int,
    run: int,
    # out
    firsts: wp.array2d(dtype=wp.int32),
    weights: wp.array2d(dtype=wp.vec3),
    is_first: wp.array2d(dtype=wp.bool),
):
    """A thread owns a run of pixels of a row.

    A sample gets the first sample with which it shares a receiver, −1 if its receivers are vertices, or −2 − t in a
    triangle t; and the weights of its receivers. A corner of squares is shared by those of its pixel that see its body.
    """
    view, thread = wp.tid()
    pixels = width // across
    height = sides.shape[1] // width
    row = thread * run // pixels
    for column in range(thread * run - row * pixels, (thread + 1) * run - row * pixels):
        corner = (row * width + column) * across
        size = int(0)
        square = int(0)
        square_key = int(-1)
        corner_key = int(-1)
        low = wp.vec2()  # of the pixel in the square, from 0 to 1
        step = wp.vec2()  # of a sample
        if sizes:
            size = sizes[view, row, column]
            if size > 0:
                top = row & -size
                left = column & -size
                square = -2 - 2 * numbers[view, top, left]
                square_key = keys[sides[view, sample_at(top, left, across, height, width)]]
                wide = wp.min((left + size) * across, width - 1) - left * across
                tall = wp.min((top + size) * across, height - 1) - top * across
                step = wp.vec2(1.0 / float(wp.max(wide, 1)), 1.0 / float(wp.max(tall, 1)))
                low = float(across) * wp.vec2(float(column - left) * step[0], float(row - top) * step[1])
            if is_corner[view, corner]:
                corner_key = keys[sides[view, corner]]
        for i in range(across):
            for j in range(across):
                sample = corner + i * width + j
                side = sides[view, sample]
                weight = barycentrics[view, sample]
                first = int(-1)
                key = int(-1)
                if sizes and side >= 0:
                    key = keys[side]
                if key >= 0 and key == square_key:
                    u = low[0] + float(j) * step[0]
                    v = low[1] + float(i) * step[1]
                    first = square
                    weight = wp.vec3(1.0 - u - v, u, v)
                    if u + v > 1.0:
                        first -= 1
                        weight = wp.vec3(u + v - 1.0, 1.0 - u, 1.0 - v)
                elif key >= 0 and key == corner_key:
                    first = corner
                    weight = wp.vec3(1.0, 0.0, 0.0)
                elif side >= 0 and wants_samples[side % wants_samples.shape[0]]:
                    first = sample
                    weight = wp.vec3(1.0, 0.0, 0.0)
                    for k in range(i * across + j):
                        other = corner + k // across * width + k % across
                        if first == sample and sides[view, other] == side:
                            first = other
                firsts[view, sample] = first
                weights[view, sample] = weight
                is_own = first == sample
                if sizes:
                    is_own = is_own or is_corner[view, sample]
                is_first[view, sample] = is_own


@wp.kernel(enable_backward=False)
def _see_own(
    # in
    sides: wp.array2d(dtype=wp.int32),
    firsts: wp.array2d(dtype=wp.int32),
    is_first: wp.array2d(dtype=wp.bool),
    numbers: wp.array2d(dtype=wp.int32),
    rooms: wp.array(dtype=wp.int32),
    side_count: int,
    run: int,
    # out
    own_sides: wp.array2d(dtype=wp.int32),
    samples: wp.array2d(dtype=wp.int32),
):
    """A thread owns a run of samples. Receivers have numbers, or else a room each in those of their face's body."""
    view, thread = wp.tid()
    for sample in range(thread * run, (thread + 1) * run):
        side = sides[view, sample]
        first = firsts[view, sample]
        room = int(0)
        if not numbers and side >= 0:
            room = rooms[side % rooms.shape[0]] * sides.shape[1]
        if first >= 0:
            number = room + first
            if numbers:
                number = numbers[view, first]
            side = side_count + number
        elif first < -1:
            side = side_count + samples.shape[1] - 2 - first
        own_sides[view, sample] = side
        if is_first[view, sample]:
            number = room + sample
            if numbers:
                number = numbers[view, sample]
            samples[view, number] = sample


@wp.func
def _shares(firsts: wp.array(dtype=wp.int32), is_corner: bool, sample: int, other: int):
    """Whether a receiver at a first sample is at the mean of others, too: a corner of squares is not."""
    return other == sample or (firsts[other] == sample and not is_corner)


@wp.kernel(enable_backward=False)
def _find_means(
    # in
    sides: wp.array2d(dtype=wp.int32),
    barycentrics: wp.array2d(dtype=wp.vec3),
    firsts: wp.array2d(dtype=wp.int32),
    is_corner: wp.array2d(dtype=wp.bool),
    samples: wp.array2d(dtype=wp.int32),
    width: int,
    across: int,
    # out
    seen_sides: wp.array2d(dtype=wp.int32),
    means: wp.array2d(dtype=wp.vec3),
    counts: wp.array2d(dtype=wp.int32),
):
    """A thread owns a receiver, which its first sample names, −1 for none."""
    view, receiver = wp.tid()
    sample = samples[view, receiver]
    side = int(-1)
    mean = wp.vec3(1.0, 0.0, 0.0)
    count = int(0)
    if sample >= 0:
        side = sides[view, sample]
        at_corner = bool(False)
        if is_corner:
            at_corner = is_corner[view, sample]
        total = wp.vec3()
        corner = (sample // width // across * width + sample % width // across) * across
        for i in range(across * across):
            other = corner + i // across * width + i % across
            if _shares(firsts[view], at_corner, sample, other):
                total += barycentrics[view, other]
                count += 1
        mean = total / float(count)
    seen_sides[view, receiver] = side
    means[view, receiver] = mean
    counts[view, receiver] = count


@wp.kernel(enable_backward=False)
def _find_means_adjoint(
    # in
    firsts: wp.array2d(dtype=wp.int32),
    is_corner: wp.array2d(dtype=wp.bool),
    samples: wp.array2d(dtype=wp.int32),
    counts: wp.array2d(dtype=wp.int32),
    width: int,
    across: int,
    adj_means: wp.array2d(dtype=wp.vec3),
    # out
    adj_barycentrics: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a receiver: each of n samples that share it gets an n-th of its gradient."""
    view, receiver = wp.tid()
    sample = samples[view, receiver]
    if sample >= 0:
        at_corner = bool(False)
        if is_corner:
            at_corner = is_corner[view, sample]
        adj = adj_means[view, receiver] / float(counts[view, receiver])
        corner = (sample // width // across * width + sample % width // across) * across
        for i in range(across * across):
            other = corner + i // across * width + i % across
            if _shares(firsts[view], at_corner, sample, other):
                wp.atomic_add(adj_barycentrics, view, other, adj)


def find_sample_receivers(
    fragments: Fragments,
    side_count: int,
    wants_samples: np.ndarray,
    bodies: np.ndarray,
    across: int,
    quadtree: Quadtree | None = None,
) -> SampleReceivers:
    """Find the receivers of samples.

    They come body by body. While a graph is captured nobody knows how many there are, and each body has room for one at
    every sample.

    Args:
        fragments: Sides that samples see, and barycentrics.
        side_count: Faces that receivers at vertices have.
        wants_samples: Faces whose samples have receivers, bool of shape [face].
        bodies: Body of each face, −1 for those that need not be told apart, shape [face].
        across: Samples of a pixel across and down.
        quadtree: Squares at whose corners there are receivers; None for none.

    Differentiable: barycentrics, in those that receivers see.
    """
    shape, device = fragments.face_ids.shape, fragments.face_ids.device
    sides, barycentrics = fragments.rows
    view_count, sample_count, width = shape[0], shape[1] * shape[2], shape[2]
    sizes = squares = is_corner = keys = None
    if quadtree is not None:
        sizes, squares, keys = quadtree.sizes, quadtree.numbers, quadtree.keys
        is_corner = wp.array(quadtree.is_corner, dtype=wp.bool, device=device)
    firsts, own_sides = (wp.empty(sides.shape, dtype=wp.int32, device=device) for _ in range(2))
    weights = wp.empty(sides.shape, dtype=wp.vec3, device=device)
    is_first = wp.empty(sides.shape, dtype=wp.bool, device=device)
    run = run_length(device, width // across)
    launch(
        _find_sharing,
        (view_count, sample_count // across**2 // run),
        inputs=[
            sides,
            barycentrics,
            constant(wants_samples, wp.bool, device),
            sizes,
            squares,
            is_corner,
            keys,
            width,
            across,
            run,
        ],
        outputs=[firsts, weights, is_first],
    )
    names = np.unique(bodies[wants_samples])
    rooms = np.searchsorted(names, bodies)
    triangles = np.empty((0, 3), np.int32)
    numbers, ends = None, sample_count * np.arange(len(names) + 1)
    if not device.is_capturing:
        chosen = np.flatnonzero(is_first.numpy())
        room = rooms[sides.numpy().ravel()[chosen] % len(bodies)]
        if quadtree is not None:
            # in tiles: light is found fastest where neighbors follow each other
            tile = chosen // width // (TILE * across) * width + chosen % width // (TILE * across)
            order = np.argsort(tile, kind="stable")
            chosen, room = chosen[order], room[order]
        numbers_of_chosen, ends = _in_rooms(chosen // sample_count, room, view_count, len(names))
        numbers_of = np.empty(sides.size, np.int32)
        numbers_of[chosen] = numbers_of_chosen
        numbers = wp.array(numbers_of.reshape(sides.shape), dtype=wp.int32, device=device)
        if quadtree is not None:
            triangles = numbers_of[quadtree.triangles]
    samples = wp.full((view_count, int(ends[-1])), -1, dtype=wp.int32, device=device)
    run = run_length(device, width)
    launch(
        _see_own,
        (view_count, sample_count // run),
        inputs=[sides, firsts, is_first, numbers, constant(rooms, wp.int32, device), side_count, run],
        outputs=[own_sides, samples],
    )
    seen_sides, counts = (wp.empty(samples.shape, dtype=wp.int32, device=device) for _ in range(2))
    inputs = [sides, barycentrics, firsts, is_corner, samples, width, across]
    means = differentiable(
        lambda means: launch(_find_means, samples.shape, inputs=inputs, outputs=[seen_sides, means, counts]),
        lambda adj_means: launch(
            _find_means_adjoint,
            samples.shape,
            inputs=[firsts, is_corner, samples, counts, width, across, adj_means],
            outputs=[barycentrics.grad],
        ),
        result=wp.empty(samples.shape, dtype=wp.vec3, device=device),
        variables=[barycentrics],
    )
    return SampleReceivers(
        Fragments(own_sides.reshape(shape), weights.reshape(shape)),
        Fragments(seen_sides, means),
        triangles,
        tuple(
            Span(name, first, end)
            for name, (first, end) in zip(names.tolist(), itertools.pairwise(ends.tolist()), strict=True)
            if end > first
        ),
    )


def _in_rooms(view: np.ndarray, room: np.ndarray, view_count: int, room_count: int) -> tuple[np.ndarray, np.ndarray]:
    """Put items into rooms one after another, each as wide as the view with the most needs it.

    Args:
        view, room: Of each item.
        view_count, room_count: Numbers of them.

    Returns:
        The place of each; and where the rooms begin, and the last ends.
    """
    part = view * room_count + room
    counts = np.bincount(part, minlength=view_count * room_count)
    ends = np.concatenate([[0], np.cumsum(counts.reshape(view_count, room_count).max(axis=0))])
    places = np.empty(len(part), int)
    order = np.argsort(part, kind="stable")
    places[order] = np.arange(len(part)) - np.repeat(np.cumsum(counts) - counts, counts)
    return places + ends[room], ends


def see_samples(fragments: Fragments, samples: np.ndarray) -> Fragments:
    """What some samples see: sides and barycentrics [view, sample], without a gradient.

    Args:
        fragments: What all see.
        samples: Which, int of shape [view, sample], −1 for none.
    """
    sides = rows(fragments.face_ids if fragments.sides is None else fragments.sides)
    view = np.arange(len(samples))[:, None]
    seen_sides = np.where(samples < 0, -1, sides.numpy()[view, samples])
    seen = rows(fragments.barycentrics).numpy()[view, samples]
    device = sides.device
    return Fragments(wp.array(seen_sides, dtype=wp.int32, device=device), wp.array(seen, dtype=wp.vec3, device=device))
