"""Sample receivers: points that samples see, at which light is evaluated for them.

Samples of a pixel that see the same side share one, at the mean of their points: with four samples a pixel that is 1.1
to 1.5 receivers a pixel, where faces have 400 to 10 pixels. In stills those that see different faces share one, too, if
these belong to one smooth piece and the surface is even: shared by two slats of a bench, it lay in the gap or in the
leg behind, and was black. (Stills of the cage of demos/kinds.py, 128², were 3.5% off, and are 2.5%.) In squares of a
quadtree there is one at each corner, and samples interpolate in triangles of these.
"""

import itertools
from typing import NamedTuple

import numpy as np
import warp as wp

from warpshadow.device.batch import rows
from warpshadow.device.constants import cached_by_values, constant
from warpshadow.device.launch import differentiable, launch
from warpshadow.device.memory import empty, from_numpy
from warpshadow.device.parallel import run_length, split_row
from warpshadow.stages.quadtree import Quadtree, sample_at
from warpshadow.stages.rasterization import Fragments

TILE = 16  # pixels of a side of the tiles whose receivers follow each other

ALIKE = 0.9  # cosine between normals of samples of a pixel from which they may share a receiver …
LEVEL = 0.3  # … where a line from one to the other is not steeper than that: the sine of its angle to the surface

_SHARING_COST, _SAMPLE_COST = 12.0, 3.5  # nanoseconds of a sample, to find whose receiver it shares and to get it


class Span(NamedTuple):
    """Consecutive receivers of one body; body −1 has all receivers that share their blockers."""

    body: int
    first: int
    end: int


def spans_of(bodies: np.ndarray) -> tuple[Span, ...]:
    """Runs of the same body."""
    changes = np.flatnonzero(np.diff(bodies)) + 1
    bounds = [0, *changes.tolist(), len(bodies)] if len(bodies) else []
    return tuple(Span(int(bodies[first]), first, end) for first, end in itertools.pairwise(bounds))


class SeenSurface(NamedTuple):
    """The points that samples see."""

    points: wp.array  # [view, sample] vec3
    normals: wp.array  # [view, sample] vec3
    positions: wp.array  # [vertex] vec3
    faces: wp.array  # [face] vec3i
    pieces: wp.array  # [face] int32, the smooth piece that each is of


class SampleReceivers(NamedTuple):
    """Receivers that samples have."""

    fragments: Fragments  # of the mesh's sides, then of a face for each receiver, then of triangles
    sample_fragments: Fragments  # sides and barycentrics that receivers see, [view, receiver]; −1 for none
    triangles: np.ndarray  # [triangle, 3], the receivers in which others interpolate
    spans: tuple[Span, ...]


@wp.func
def _is_one_surface(points: wp.array(dtype=wp.vec3), normals: wp.array(dtype=wp.vec3), sample: int, other: int):
    """Whether two samples see one smooth surface, which is not steep between them."""
    normal = normals[sample]
    step = points[other] - points[sample]
    return wp.dot(normal, normals[other]) > ALIKE and wp.abs(wp.dot(normal, step)) <= LEVEL * wp.length(step)


@wp.kernel(enable_backward=False)
def _find_sharing(
    first_row: int,
    worker: int,
    # in
    sides: wp.array2d(dtype=wp.int32),
    points: wp.array2d(dtype=wp.vec3),
    normals: wp.array2d(dtype=wp.vec3),
    pieces: wp.array(dtype=wp.int32),
    barycentrics: wp.array2d(dtype=wp.vec3),
    wants_samples: wp.array(dtype=wp.bool),
    sizes: wp.array3d(dtype=wp.int32),
    numbers: wp.array3d(dtype=wp.int32),
    is_corner: wp.array2d(dtype=wp.bool),
    keys: wp.array(dtype=wp.int32),
    width: int,
    supersampling: int,
    run: int,
    # out
    owner_samples: wp.array2d(dtype=wp.int32),
    weights: wp.array2d(dtype=wp.vec3),
    is_owner: wp.array2d(dtype=wp.bool),
):
    """A thread owns a run of pixels of a row.

    A sample gets the owner of its receiver, the first sample that shares it, −1 if its receivers are vertices, or
    −2 − t in a triangle t; and the weights of its receivers. A corner of squares is shared by the samples of its pixel
    that see its body.
    """
    view, thread = split_row(first_row + wp.tid(), sides.shape[1] // (supersampling * supersampling) // run)
    pixels = width // supersampling
    height = sides.shape[1] // width
    row = thread * run // pixels
    for column in range(thread * run - row * pixels, (thread + 1) * run - row * pixels):
        corner = (row * width + column) * supersampling
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
                square_key = keys[sides[view, sample_at(top, left, supersampling, height, width)]]
                wide = wp.min((left + size) * supersampling, width - 1) - left * supersampling
                tall = wp.min((top + size) * supersampling, height - 1) - top * supersampling
                step = wp.vec2(1.0 / float(wp.max(wide, 1)), 1.0 / float(wp.max(tall, 1)))
                low = float(supersampling) * wp.vec2(float(column - left) * step[0], float(row - top) * step[1])
            if is_corner[view, corner]:
                corner_key = keys[sides[view, corner]]
        for i in range(supersampling):
            for j in range(supersampling):
                sample = corner + i * width + j
                side = sides[view, sample]
                weight = barycentrics[view, sample]
                owner = int(-1)
                key = int(-1)
                if sizes and side >= 0:
                    key = keys[side]
                if key >= 0 and key == square_key:
                    u = low[0] + float(j) * step[0]
                    v = low[1] + float(i) * step[1]
                    owner = square
                    weight = wp.vec3(1.0 - u - v, u, v)
                    if u + v > 1.0:
                        owner -= 1
                        weight = wp.vec3(u + v - 1.0, 1.0 - u, 1.0 - v)
                elif key >= 0 and key == corner_key:
                    owner = corner
                    weight = wp.vec3(1.0, 0.0, 0.0)
                elif side >= 0 and wants_samples[side % wants_samples.shape[0]]:
                    owner = sample
                    weight = wp.vec3(1.0, 0.0, 0.0)
                    for k in range(i * supersampling + j):
                        other = corner + k // supersampling * width + k % supersampling
                        if owner == sample and sides[view, other] == side:
                            owner = owner_samples[view, other]
                        # (kernels evaluate both sides of "and")
                        if points and owner == sample and owner_samples[view, other] == other:
                            other_side = sides[view, other]
                            # (two slats are no surface, however even they are)
                            if pieces[side % pieces.shape[0]] == pieces[other_side % pieces.shape[0]]:  # noqa: SIM102
                                if _is_one_surface(points[view], normals[view], sample, other):
                                    owner = other
                owner_samples[view, sample] = owner
                weights[view, sample] = weight
                has_receiver = owner == sample
                if sizes:
                    has_receiver = has_receiver or is_corner[view, sample]
                is_owner[view, sample] = has_receiver


@wp.kernel(enable_backward=False)
def _see_fragments(
    first_row: int,
    worker: int,
    # in
    sides: wp.array2d(dtype=wp.int32),
    owner_samples: wp.array2d(dtype=wp.int32),
    is_owner: wp.array2d(dtype=wp.bool),
    numbers: wp.array2d(dtype=wp.int32),
    body_ranks: wp.array(dtype=wp.int32),
    side_count: int,
    run: int,
    # out
    own_sides: wp.array2d(dtype=wp.int32),
    samples: wp.array2d(dtype=wp.int32),
):
    """A thread owns a run of samples.

    ``numbers`` are the receivers' numbers; where they cannot be read (a capture), each body gets a range with a place
    for every sample.
    """
    view, thread = split_row(first_row + wp.tid(), sides.shape[1] // run)
    for sample in range(thread * run, (thread + 1) * run):
        side = sides[view, sample]
        owner = owner_samples[view, sample]
        first_number = int(0)
        if not numbers and side >= 0:
            first_number = body_ranks[side % body_ranks.shape[0]] * sides.shape[1]
        if owner >= 0:
            number = first_number + owner
            if numbers:
                number = numbers[view, owner]
            side = side_count + number
        elif owner < -1:
            side = side_count + samples.shape[1] - 2 - owner
        own_sides[view, sample] = side
        if is_owner[view, sample]:
            number = first_number + sample
            if numbers:
                number = numbers[view, sample]
            samples[view, number] = sample


@wp.func
def _shares(
    owner_samples: wp.array(dtype=wp.int32), sides: wp.array(dtype=wp.int32), is_corner: bool, sample: int, other: int
):
    """Whether an owner's receiver takes the mean with another sample: of its face, and not at squares' corners."""
    return other == sample or (owner_samples[other] == sample and sides[other] == sides[sample] and not is_corner)


@wp.func
def _nearest_on_edge(start: wp.vec3, end: wp.vec3, point: wp.vec3):
    """How far along an edge the point on it is that is nearest to a point, from 0 to 1."""
    step = end - start
    return wp.clamp(wp.dot(point - start, step) / wp.max(wp.length_sq(step), 1.0e-37), 0.0, 1.0)


@wp.func
def _nearest(point: wp.vec3, a: wp.vec3, b: wp.vec3, c: wp.vec3):
    """Barycentrics of the point on a face that is nearest to a point."""
    doubled_normal = wp.cross(b - a, c - a)
    doubled = wp.max(wp.length_sq(doubled_normal), 1.0e-37)
    v = wp.dot(wp.cross(a - c, point - c), doubled_normal) / doubled
    w = wp.dot(wp.cross(b - a, point - a), doubled_normal) / doubled
    weights = wp.vec3(1.0 - v - w, v, w)
    if wp.min(weights) < 0.0:
        nearest = float(wp.inf)
        corners = wp.matrix_from_rows(a, b, c)
        for k in range(3):
            start = corners[k]
            end = corners[(k + 1) % 3]
            part = _nearest_on_edge(start, end, point)
            distance = wp.length_sq(start + part * (end - start) - point)
            if distance < nearest:
                nearest = distance
                weights = wp.vec3()
                weights[k] = 1.0 - part
                weights[(k + 1) % 3] = part
    return weights


@wp.kernel(enable_backward=False)
def _find_means(
    # in
    points: wp.array2d(dtype=wp.vec3),
    positions: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    sides: wp.array2d(dtype=wp.int32),
    barycentrics: wp.array2d(dtype=wp.vec3),
    owner_samples: wp.array2d(dtype=wp.int32),
    is_corner: wp.array2d(dtype=wp.bool),
    samples: wp.array2d(dtype=wp.int32),
    width: int,
    supersampling: int,
    # out
    seen_sides: wp.array2d(dtype=wp.int32),
    means: wp.array2d(dtype=wp.vec3),
    counts: wp.array2d(dtype=wp.int32),
):
    """A thread owns a receiver, whose owner ``samples`` has, −1 for none."""
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
        corner = (sample // width // supersampling * width + sample % width // supersampling) * supersampling
        for i in range(supersampling * supersampling):
            other = corner + i // supersampling * width + i % supersampling
            if _shares(owner_samples[view], sides[view], at_corner, sample, other):
                total += barycentrics[view, other]
                count += 1
        mean = total / float(count)
        if points:
            # the mean point of all faces that share, or the point nearest to it on one of them
            middle = wp.vec3()
            shared = int(0)
            for i in range(supersampling * supersampling):
                other = corner + i // supersampling * width + i % supersampling
                if owner_samples[view, other] == sample:
                    middle += points[view, other]
                    shared += 1
            if shared > count:
                middle = middle / float(shared)
                nearest = float(wp.inf)
                for i in range(supersampling * supersampling):
                    other = corner + i // supersampling * width + i % supersampling
                    if owner_samples[view, other] == sample:
                        face = faces[sides[view, other] % faces.shape[0]]
                        a = positions[face[0]]
                        b = positions[face[1]]
                        c = positions[face[2]]
                        weights = _nearest(middle, a, b, c)
                        distance = wp.length_sq(weights[0] * a + weights[1] * b + weights[2] * c - middle)
                        if distance < nearest:
                            nearest = distance
                            side = sides[view, other]
                            mean = weights
    seen_sides[view, receiver] = side
    means[view, receiver] = mean
    counts[view, receiver] = count


@wp.kernel(enable_backward=False)
def _find_means_adjoint(
    # in
    sides: wp.array2d(dtype=wp.int32),
    owner_samples: wp.array2d(dtype=wp.int32),
    is_corner: wp.array2d(dtype=wp.bool),
    samples: wp.array2d(dtype=wp.int32),
    counts: wp.array2d(dtype=wp.int32),
    width: int,
    supersampling: int,
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
        corner = (sample // width // supersampling * width + sample % width // supersampling) * supersampling
        for i in range(supersampling * supersampling):
            other = corner + i // supersampling * width + i % supersampling
            if _shares(owner_samples[view], sides[view], at_corner, sample, other):
                wp.atomic_add(adj_barycentrics, view, other, adj)


def find_sample_receivers(
    fragments: Fragments,
    side_count: int,
    wants_samples: np.ndarray,
    bodies: np.ndarray,
    supersampling: int,
    quadtree: Quadtree | None = None,
    surface: SeenSurface | None = None,
) -> SampleReceivers:
    """Find the receivers of samples.

    They come body by body. While a graph is captured nobody knows how many there are, and each body has room for one at
    every sample.

    Args:
        fragments: Sides that samples see, and barycentrics.
        side_count: Faces that receivers at vertices have.
        wants_samples: Faces whose samples have receivers, bool of shape [face].
        bodies: Body of each face, −1 for faces that need not be told apart, shape [face].
        supersampling: Samples of a pixel across and down.
        quadtree: Squares at whose corners there are receivers; None for none.
        surface: What samples see, of one instance, where those of a pixel share a receiver that see different faces
            of one smooth surface, too; None where they do not.
    Differentiable: barycentrics, where receivers see them.
    """
    shape, device = fragments.face_ids.shape, fragments.face_ids.device
    sides, barycentrics = fragments.rows
    view_count, sample_count, width = shape[0], shape[1] * shape[2], shape[2]
    sizes = squares = is_corner = keys = None
    if quadtree is not None:
        sizes, squares, keys = quadtree.sizes, quadtree.numbers, quadtree.keys
        is_corner = from_numpy(quadtree.is_corner, dtype=wp.bool, device=device)
    owner_samples, own_sides = (empty(sides.shape, dtype=wp.int32, device=device) for _ in range(2))
    weights = empty(sides.shape, dtype=wp.vec3, device=device)
    is_owner = empty(sides.shape, dtype=wp.bool, device=device)
    run = run_length(device, width // supersampling)
    launch(
        _find_sharing,
        view_count * (sample_count // supersampling**2 // run),
        cost=_SHARING_COST * supersampling**2 * run,
        inputs=[
            sides,
            *((surface.points, surface.normals, surface.pieces) if surface else (None, None, None)),
            barycentrics,
            constant(wants_samples, wp.bool, device),
            sizes,
            squares,
            is_corner,
            keys,
            width,
            supersampling,
            run,
        ],
        outputs=[owner_samples, weights, is_owner],
    )
    names, body_ranks, ranks_on_device = _body_ranks(bodies, wants_samples, device)
    triangles = np.empty((0, 3), np.int32)
    numbers, ends = None, sample_count * np.arange(len(names) + 1)
    if not device.is_capturing:
        chosen = np.flatnonzero(is_owner.numpy())
        rank = body_ranks[sides.numpy().ravel()[chosen] % len(bodies)]
        if quadtree is not None:
            # in tiles: light is found fastest where neighbors follow each other
            tile = chosen // width // (TILE * supersampling) * width + chosen % width // (TILE * supersampling)
            permutation = np.argsort(tile, kind="stable")
            chosen, rank = chosen[permutation], rank[permutation]
        numbers_of_chosen, ends = _packed_by_body(chosen // sample_count, rank, view_count, len(names))
        numbers_of = np.empty(sides.size, np.int32)
        numbers_of[chosen] = numbers_of_chosen
        numbers = from_numpy(numbers_of.reshape(sides.shape), dtype=wp.int32, device=device)
        if quadtree is not None:
            triangles = numbers_of[quadtree.triangles]
    samples = wp.full((view_count, int(ends[-1])), -1, dtype=wp.int32, device=device)
    run = run_length(device, width)
    launch(
        _see_fragments,
        view_count * (sample_count // run),
        cost=_SAMPLE_COST * run,
        inputs=[sides, owner_samples, is_owner, numbers, ranks_on_device, side_count, run],
        outputs=[own_sides, samples],
    )
    seen_sides, counts = (empty(samples.shape, dtype=wp.int32, device=device) for _ in range(2))
    on_surface = (surface.points, surface.positions, surface.faces) if surface else (None, None, None)
    inputs = [*on_surface, sides, barycentrics, owner_samples, is_corner, samples, width, supersampling]
    means = differentiable(
        lambda means: launch(_find_means, samples.shape, inputs=inputs, outputs=[seen_sides, means, counts]),
        lambda adj_means: launch(
            _find_means_adjoint,
            samples.shape,
            inputs=[sides, owner_samples, is_corner, samples, counts, width, supersampling, adj_means],
            outputs=[barycentrics.grad],
        ),
        result=empty(samples.shape, dtype=wp.vec3, device=device),
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


@cached_by_values
def _body_ranks(
    bodies: np.ndarray, wants_samples: np.ndarray, device: wp.DeviceLike
) -> tuple[np.ndarray, np.ndarray, wp.array]:
    """The bodies whose samples have receivers, and the rank among them of each face's body; that on the device, too."""
    names = np.unique(bodies[wants_samples])
    body_ranks = np.searchsorted(names, bodies)
    return names, body_ranks, constant(body_ranks, wp.int32, device)


def _packed_by_body(
    view: np.ndarray, rank: np.ndarray, view_count: int, body_count: int
) -> tuple[np.ndarray, np.ndarray]:
    """Number receivers body by body, with as many numbers for a body as the view with the most of its receivers has.

    Args:
        view, rank: View and body of each receiver.
        view_count, body_count: Numbers of them.
    Returns:
        The number of each; and where the bodies begin, and the last ends.
    """
    view_and_body = view * body_count + rank
    counts = np.bincount(view_and_body, minlength=view_count * body_count)
    ends = np.concatenate([[0], np.cumsum(counts.reshape(view_count, body_count).max(axis=0))])
    places = np.empty(len(view_and_body), int)
    permutation = np.argsort(view_and_body, kind="stable")
    places[permutation] = np.arange(len(view_and_body)) - np.repeat(np.cumsum(counts) - counts, counts)
    return places + ends[rank], ends


def see_samples(fragments: Fragments, samples: np.ndarray) -> Fragments:
    """Fragments of some samples: sides and barycentrics [view, sample], without a gradient.

    Args:
        fragments: The fragments of all samples.
        samples: Which, int of shape [view, sample], −1 for none.
    """
    sides = rows(fragments.face_ids if fragments.sides is None else fragments.sides)
    view = np.arange(len(samples))[:, None]
    seen_sides = np.where(samples < 0, -1, sides.numpy()[view, samples])
    seen = rows(fragments.barycentrics).numpy()[view, samples]
    device = sides.device
    return Fragments(
        from_numpy(seen_sides, dtype=wp.int32, device=device), from_numpy(seen, dtype=wp.vec3, device=device)
    )
