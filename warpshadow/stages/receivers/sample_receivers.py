"""Sample receivers: points that samples see, at which light is evaluated for them.

- Samples of a pixel that see the same side share one, at the mean of their points: of four samples, 1.1 to 1.5
  receivers a pixel.
- On bodies that shine each sample has its own, but by rays: means leap as samples pass to the next face, and narrow
  highlights with them.
- In stills samples of different faces share one, too, if these belong to one smooth piece and the surface is even:
  shared by two slats of a bench, it would lie in the gap.
- In squares of a quadtree there is one at each corner, and samples interpolate in triangles of these.
"""

from typing import NamedTuple

import numpy as np
import warp as wp

from warpshadow.device.batch import rows
from warpshadow.device.constants import cached_by_values, constant
from warpshadow.device.launch import launch
from warpshadow.device.memory import empty, reshaped
from warpshadow.device.parallel import run_length, split_row
from warpshadow.stages.raster.rasterization import Fragments
from warpshadow.stages.receivers.body_spans import Span, spans_between
from warpshadow.stages.receivers.numbering import number_items
from warpshadow.stages.receivers.quadtree import Quadtree, sample_at
from warpshadow.stages.receivers.receiver_means import VisibleSurface, mean_fragments, sample_of_pixel

TILE = 16  # pixels of a side of the tiles whose receivers follow each other

MIN_SHARED_COSINE = 0.9  # cosine between normals of samples of a pixel from which they may share a receiver …
MAX_SHARED_SLOPE = 0.3
"""… where a line from one to the other is not steeper than that: the sine of its angle to the surface."""

MAX_SHARED_SAMPLES = 2
"""Samples of a pixel across in stills up to which those on a smooth surface share a receiver: whoever asks for more
wants edges and bumps within pixels resolved."""

_SHARING_COST, _SAMPLE_COST = 12.0, 3.5  # nanoseconds of a sample, to find whose receiver it shares and to get it


class SampleReceivers(NamedTuple):
    """Receivers that samples have."""

    fragments: Fragments  # of the mesh's sides, then of a face for each receiver, then of triangles
    sample_fragments: Fragments  # sides and barycentrics that receivers see, [view, receiver]; −1 for none
    samples: wp.array  # [view, receiver] int32, the sample that owns each, −1 for none
    numbers: wp.array  # [view, sample] int32, the receiver that each owns, −1 for none
    spans: tuple[Span, ...]


@wp.func
def _is_one_surface(points: wp.array(dtype=wp.vec3), normals: wp.array(dtype=wp.vec3), sample: int, other: int):
    """Whether two samples see one smooth surface, which is not steep between them."""
    normal = normals[sample]
    offset = points[other] - points[sample]
    return wp.dot(normal, normals[other]) > MIN_SHARED_COSINE and wp.abs(
        wp.dot(normal, offset)
    ) <= MAX_SHARED_SLOPE * wp.length(offset)


@wp.kernel(enable_backward=False)
def _find_owner_samples(
    first_row: int,
    worker: int,
    # in
    sides: wp.array2d(dtype=wp.int32),
    points: wp.array2d(dtype=wp.vec3),
    normals: wp.array2d(dtype=wp.vec3),
    pieces: wp.array(dtype=wp.int32),
    barycentrics: wp.array2d(dtype=wp.vec3),
    has_sample_receivers: wp.array(dtype=wp.bool),
    shares_receivers: wp.array(dtype=wp.bool),
    sizes: wp.array3d(dtype=wp.int32),
    square_numbers: wp.array3d(dtype=wp.int32),
    is_corner: wp.array2d(dtype=wp.bool),
    keys: wp.array(dtype=wp.int32),
    body_ranks: wp.array(dtype=wp.int32),
    width: int,
    supersampling: int,
    run: int,
    # out
    owner_samples: wp.array2d(dtype=wp.int32),
    weights: wp.array2d(dtype=wp.vec3),
    owner_ranks: wp.array2d(dtype=wp.int32),
):
    """A thread owns a run of pixels of a row: it finds where each sample has its light, and the weights there.

    | owner sample | light of the sample |
    | --- | --- |
    | ≥ 0 | of the receiver that this sample owns, the first of those that share it |
    | −1 | interpolated between the vertices of the face |
    | −2 − t | interpolated in triangle t |

    A corner of squares is at its sample, so others do not share it. Samples that own a receiver get the rank of their
    body, others −1.
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
        first_shared = int(0)
        square_position = wp.vec2()  # of the pixel in the square, from 0 to 1
        sample_step = wp.vec2()  # of a sample
        if sizes:
            size = sizes[view, row, column]
            top = row & -size
            left = column & -size
            if size > 0 and square_numbers[view, top, left] >= 0:
                square = -2 - 2 * square_numbers[view, top, left]
                square_key = keys[sides[view, sample_at(top, left, supersampling, height, width)]]
                square_width = wp.min((left + size) * supersampling, width - 1) - left * supersampling
                square_height = wp.min((top + size) * supersampling, height - 1) - top * supersampling
                sample_step = wp.vec2(1.0 / float(wp.max(square_width, 1)), 1.0 / float(wp.max(square_height, 1)))
                square_position = float(supersampling) * wp.vec2(
                    float(column - left) * sample_step[0], float(row - top) * sample_step[1]
                )
            if is_corner[view, corner]:
                first_shared = 1
        for i in range(supersampling):
            for j in range(supersampling):
                sample = corner + i * width + j
                side = sides[view, sample]
                weight = barycentrics[view, sample]
                owner_sample = int(-1)
                key = int(-1)
                if sizes and side >= 0:
                    key = keys[side]
                if key >= 0 and key == square_key:
                    u = square_position[0] + float(j) * sample_step[0]
                    v = square_position[1] + float(i) * sample_step[1]
                    owner_sample = square
                    weight = wp.vec3(1.0 - u - v, u, v)
                    if u + v > 1.0:
                        owner_sample -= 1
                        weight = wp.vec3(u + v - 1.0, 1.0 - u, 1.0 - v)
                elif side >= 0 and has_sample_receivers[side % has_sample_receivers.shape[0]]:
                    owner_sample = sample
                    weight = wp.vec3(1.0, 0.0, 0.0)
                    other_count = i * supersampling + j
                    if shares_receivers:
                        other_count = wp.where(shares_receivers[side % shares_receivers.shape[0]], other_count, 0)
                    for k in range(first_shared, other_count):
                        other = sample_of_pixel(corner, k, width, supersampling)
                        if owner_sample == sample and sides[view, other] == side:
                            owner_sample = owner_samples[view, other]
                        # (kernels evaluate both sides of "and")
                        if points and owner_sample == sample and owner_samples[view, other] == other:
                            other_side = sides[view, other]
                            # (two slats are no surface, however even they are)
                            if pieces[side % pieces.shape[0]] == pieces[other_side % pieces.shape[0]]:  # noqa: SIM102
                                if _is_one_surface(points[view], normals[view], sample, other):
                                    owner_sample = other
                owner_samples[view, sample] = owner_sample
                weights[view, sample] = weight
                has_receiver = owner_sample == sample
                if sizes:
                    has_receiver = has_receiver or is_corner[view, sample]
                rank = int(-1)
                if has_receiver:
                    rank = body_ranks[side % body_ranks.shape[0]]
                owner_ranks[view, sample] = rank


@wp.kernel(enable_backward=False)
def _find_receiver_sides(
    first_row: int,
    worker: int,
    # in
    sides: wp.array2d(dtype=wp.int32),
    owner_samples: wp.array2d(dtype=wp.int32),
    receiver_numbers: wp.array2d(dtype=wp.int32),
    side_count: int,
    receiver_count: int,
    run: int,
    # out
    receiver_sides: wp.array2d(dtype=wp.int32),
):
    """A thread owns a run of samples."""
    view, thread = split_row(first_row + wp.tid(), sides.shape[1] // run)
    for sample in range(thread * run, (thread + 1) * run):
        side = sides[view, sample]
        owner_sample = owner_samples[view, sample]
        if owner_sample >= 0:
            side = side_count + receiver_numbers[view, owner_sample]
        elif owner_sample < -1:
            side = side_count + receiver_count - 2 - owner_sample
        receiver_sides[view, sample] = side


def find_sample_receivers(
    fragments: Fragments,
    side_count: int,
    has_sample_receivers: np.ndarray,
    bodies: np.ndarray,
    supersampling: int,
    quadtree: Quadtree | None = None,
    surface: VisibleSurface | None = None,
    has_mean_slope: wp.array | None = None,
    shares_receivers: np.ndarray | None = None,
) -> SampleReceivers:
    """Find the receivers of samples.

    They come body by body, in tiles where there is a quadtree: light is found fastest where neighbors follow each
    other.

    Args:
        fragments: Sides that samples see, and barycentrics.
        side_count: Faces that receivers at vertices have.
        has_sample_receivers: Faces whose samples have receivers, bool of shape [face].
        bodies: Body of each face, −1 where it is not distinct, shape [face].
        quadtree: Squares at whose corners there are receivers; None for none.
        surface: Visible surface of one instance, where samples of a pixel share a receiver if they see different faces
            of one smooth surface, too; None where they do not.
        has_mean_slope: Samples whose motion over the screen :mod:`.slopes` follows, bool of shape [view, sample]; None
            for none. Their receivers do not move with it.
        shares_receivers: Faces whose samples of a pixel share a receiver, bool of shape [face]; None for all.
    Differentiable: barycentrics, where receivers see them.
    """
    shape, device = fragments.face_ids.shape, fragments.face_ids.device
    sides, barycentrics = fragments.rows
    view_count, sample_count, width = shape[0], shape[1] * shape[2], shape[2]
    sizes = squares = is_corner = keys = None
    if quadtree is not None:
        sizes, squares, keys = quadtree.sizes, quadtree.numbers, quadtree.square_key_of_side
        is_corner = quadtree.is_corner
    owner_samples, receiver_sides = (empty(sides.shape, dtype=wp.int32, device=device) for _ in range(2))
    weights = empty(sides.shape, dtype=wp.vec3, device=device)
    owner_ranks = empty(sides.shape, dtype=wp.int32, device=device)
    body_ids, body_ranks = _body_ranks(bodies, has_sample_receivers, device)
    run = run_length(device, width // supersampling)
    launch(
        _find_owner_samples,
        view_count * (sample_count // supersampling**2 // run),
        cost=_SHARING_COST * supersampling**2 * run,
        inputs=[
            sides,
            *((surface.points, surface.normals, surface.pieces) if surface else (None, None, None)),
            barycentrics,
            constant(has_sample_receivers, wp.bool, device),
            None if shares_receivers is None else constant(shares_receivers, wp.bool, device),
            sizes,
            squares,
            is_corner,
            keys,
            body_ranks,
            width,
            supersampling,
            run,
        ],
        outputs=[owner_samples, weights, owner_ranks],
    )
    order = None if quadtree is None else _order_by_tiles(shape[1], width, TILE * supersampling, device)
    numbers, samples, ends, _ = number_items("receivers at samples", owner_ranks, len(body_ids), order)
    if device.is_capturing and not samples.shape[1]:
        raise RuntimeError("a graph is captured of an image without receivers at samples")
    run = run_length(device, width)
    launch(
        _find_receiver_sides,
        view_count * (sample_count // run),
        cost=_SAMPLE_COST * run,
        inputs=[sides, owner_samples, numbers, side_count, samples.shape[1], run],
        outputs=[receiver_sides],
    )
    arguments = surface, fragments, owner_samples, is_corner, samples, supersampling, has_mean_slope
    sample_fragments = mean_fragments(*arguments)
    return SampleReceivers(
        Fragments(reshaped(receiver_sides, shape), reshaped(weights, shape)),
        sample_fragments,
        samples,
        numbers,
        spans_between(body_ids.tolist(), ends),
    )


@wp.kernel(enable_backward=False)
def _find_places(
    # in
    samples: wp.array2d(dtype=wp.int32),
    width: int,
    supersampling: int,
    # out
    places: wp.array2d(dtype=wp.int32),
):
    """A thread owns a receiver."""
    batch, receiver = wp.tid()
    sample = wp.max(samples[batch, receiver], 0)
    row = sample // width
    places[batch, receiver] = row % supersampling * supersampling + (sample - row * width) % supersampling


def places_in_pixels(samples: wp.array, width: int, supersampling: int) -> wp.array:
    """Find where in their pixels samples are, row by row: int32 of their shape.

    Args:
        samples: The samples, int32 of shape [batch, receiver].
        width: Samples of an image in a row.
    """
    places = empty(samples.shape, dtype=wp.int32, device=samples.device)
    launch(_find_places, samples.shape, inputs=[samples, width, supersampling], outputs=[places])
    return places


@cached_by_values
def _body_ranks(
    bodies: np.ndarray, has_sample_receivers: np.ndarray, device: wp.DeviceLike
) -> tuple[np.ndarray, wp.array]:
    """The bodies whose samples have receivers, and the rank among them of each face's body, on the device."""
    body_ids = np.unique(bodies[has_sample_receivers])
    return body_ids, constant(np.searchsorted(body_ids, bodies), wp.int32, device)


@cached_by_values
def _order_by_tiles(height: int, width: int, tile: int, device: wp.DeviceLike) -> wp.array:
    """Order the samples of an image tile by tile."""
    row, column = np.divmod(np.arange(height * width), width)
    return constant(np.lexsort((column // tile, row // tile)), wp.int32, device)


@wp.kernel(enable_backward=False)
def _select_fragments(
    # in
    sides: wp.array2d(dtype=wp.int32),
    barycentrics: wp.array2d(dtype=wp.vec3),
    samples: wp.array2d(dtype=wp.int32),
    # out
    selected_sides: wp.array2d(dtype=wp.int32),
    selected_barycentrics: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a selected sample."""
    view, i = wp.tid()
    sample = samples[view, i]
    selected_sides[view, i] = wp.where(sample < 0, -1, sides[view, wp.max(sample, 0)])
    selected_barycentrics[view, i] = barycentrics[view, wp.max(sample, 0)]


def fragments_of_samples(fragments: Fragments, samples: wp.array) -> Fragments:
    """Select the fragments of some samples: sides and barycentrics [view, sample], without a gradient.

    Args:
        samples: Which, int32 of shape [view, sample], −1 for none.
    """
    sides = rows(fragments.face_ids if fragments.sides is None else fragments.sides)
    selected = Fragments(*(empty(samples.shape, dtype=dtype, device=sides.device) for dtype in (wp.int32, wp.vec3)))
    inputs = [sides, rows(fragments.barycentrics), samples]
    launch(_select_fragments, samples.shape, inputs=inputs, outputs=[selected.face_ids, selected.barycentrics])
    return selected
