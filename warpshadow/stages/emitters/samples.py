"""Samples of emitters: points of their surfaces that stand for patches of it.

A patch k has a middle y_k and an area vector A_k, its normal times its area. Both are sums over vertices and faces that
move with the body: of pieces p of faces f, with middles z_p,

    y_k = Σ_p |A_p| z_p / Σ_p |A_p|,   A_k = s_k Σ_p A_p,   A_p = share_p (b_f − a_f) × (c_f − a_f) / 2

A receiver in the direction ω has f = A_k·ω of it, if the patch is flat. Of one that is bent, such as a cap of a ball, a
part looks beyond its horizon, so around 0 f is soft:

    f → (f + w_k |A_k|)² / (4 w_k |A_k|) for |f| < w_k |A_k|,   1 + w_k² / 3 = S_k / |A_k|

S_k is the area of the patch at rest: the mean of f over all directions is then that of the surface. Patches that are
bent by more than w_k = 0.3, such as those around edges, have w_k = 0 and, in place of it, s_k = S_k / |A_k|.

Receivers close by see the pieces themselves (:mod:`.light`).
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import warp as wp

from warpshadow.device.constants import constant
from warpshadow.device.launch import launch
from warpshadow.device.memory import empty
from warpshadow.maths.adjacency import area_normals
from warpshadow.maths.spatial_sort import compact_order, z_order
from warpshadow.stages.patches import Patches, find_patches
from warpshadow.stages.sparse import SparseMatrix, multiply

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

SAMPLE_BUNDLE = 8  # samples next to each other that blockers are culled for together; an emitter has a multiple of them

SAMPLES = 64  # samples of an emitter

SURFACE_POINTS = 32  # points of each sample to which rays go

_MAX_STRETCH = 4.0  # greatest S_k / |A_k|

_MAX_SOFTNESS = wp.constant(0.3)  # greatest w

_TRIANGLE_POINTS = np.full((3, 3), 1 / 6) + np.eye(3) / 2
"""Barycentric coordinates of three points that have the second moments of a triangle."""


class SurfacePoints(NamedTuple):
    """Points on the surface of an emitter, spread evenly over each sample, in Z-order: so is every nth of them."""

    faces: np.ndarray  # face of the emitter that each lies on, int32 of shape [sample, point]
    weights: np.ndarray  # barycentric coordinates in it, float32 of shape [sample, point, 3]


class SampleWeights(NamedTuple):
    """Weights of the samples of a body, whose count is a multiple of SAMPLE_BUNDLE."""

    vertices: csr_matrix  # of its vertices in the samples' middles, [sample, vertex]
    faces: csr_matrix  # of its faces' area vectors in those of samples, [sample, face]
    corners: csr_matrix  # of its vertices in those of the samples' pieces, [3 · piece, vertex]
    first_pieces: np.ndarray  # where the pieces of each begin, and the end of the last, [sample + 1]
    elongations: np.ndarray  # square of half the diagonal over the area, float32 of shape [sample]
    softness: np.ndarray  # w, float32 of shape [sample]
    surface_points: SurfacePoints
    patches: Patches
    patch_of_samples: np.ndarray  # the patch that each stands for, [sample]


def find_sample_weights(
    positions: np.ndarray, faces: np.ndarray, *, is_two_sided: bool, device: wp.DeviceLike
) -> SampleWeights:
    """Find the samples of an emitter.

    Args:
        positions, faces: Vertices at rest [units of the body], shape [vertex, 3], and faces that wind alike, [face, 3].
        is_two_sided: Whether the body is open; samples of both sides are the same.
    """
    from scipy.sparse import csr_matrix, diags

    count = SAMPLES * (2 if is_two_sided else 1)
    patches = find_patches(positions, faces, is_two_sided=is_two_sided, count=count, patch_samples=1, device=device)
    pieces, labels = patches.pieces, patches.patch_of_pieces[0]
    corners = pieces.positions(positions, faces)
    piece_vectors = area_normals(corners) / 2
    is_used = labels >= 0
    labels, piece_faces, vectors = labels[is_used], pieces.faces[is_used], piece_vectors[is_used]
    areas, patch_count = np.linalg.norm(vectors, axis=1), int(labels.max(initial=-1)) + 1
    piece_shares = np.abs(np.linalg.det(pieces.corners[is_used].astype(np.float64)))
    sums = np.zeros((patch_count, 4))
    np.add.at(sums, labels, np.column_stack([vectors, areas]))
    stretch = np.minimum(sums[:, 3] / np.maximum(np.linalg.norm(sums[:, :3], axis=1), 1e-30), _MAX_STRETCH)
    middles = (areas / sums[labels, 3])[:, None] * pieces.corners[is_used].mean(axis=1)
    of_vertices = csr_matrix(
        (middles.ravel(), (np.repeat(labels, 3), faces[piece_faces].ravel())), shape=(patch_count, len(positions))
    )
    softness = np.sqrt(3 * np.maximum(stretch - 1, 0))
    softness[softness > _MAX_SOFTNESS] = 0
    of_faces = diags(stretch / (1 + softness**2 / 3)) @ csr_matrix(
        (piece_shares, (labels, piece_faces)), shape=(patch_count, len(faces))
    )
    permutation = compact_order(of_vertices @ positions.astype(np.float64), runs=(SAMPLE_BUNDLE,))
    padding = np.full(-patch_count % SAMPLE_BUNDLE, permutation[-1] if patch_count else 0)
    is_real = np.repeat([1.0, 0.0], [patch_count, len(padding)])
    chosen = np.concatenate([permutation, padding]).astype(int)
    permutation_of_pieces, first_pieces = _pieces_of_samples(labels, chosen)
    piece_vertices = faces[piece_faces[permutation_of_pieces]]
    of_corners = csr_matrix(
        (
            pieces.corners[is_used][permutation_of_pieces].ravel(),
            np.repeat(piece_vertices[:, None], 3, axis=1).ravel(),
            np.arange(0, 9 * len(permutation_of_pieces) + 1, 3),
        ),
        shape=(3 * len(permutation_of_pieces), len(positions)),
    )
    surface_points = _find_surface_points(piece_faces, pieces.corners[is_used], corners[is_used], labels, areas)
    return SampleWeights(
        of_vertices[chosen].tocsr(),
        (diags(is_real) @ of_faces[chosen]).tocsr(),
        of_corners,
        first_pieces,
        _find_elongations(corners[is_used], labels, areas)[chosen].astype(np.float32),
        softness[chosen].astype(np.float32),
        SurfacePoints(*(item[chosen] for item in surface_points)),
        patches,
        chosen,
    )


def _pieces_of_samples(labels: np.ndarray, chosen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pieces sorted by sample, and where each sample's begin, given the patch of each piece and of each sample."""
    permutation = np.argsort(labels, kind="stable")
    starts = np.searchsorted(labels[permutation], np.arange(int(labels.max(initial=-1)) + 2))
    spans = [permutation[starts[patch] : starts[patch + 1]] for patch in chosen]
    return np.concatenate([*spans, np.zeros(0, int)]), np.cumsum([0, *(len(span) for span in spans)])


def _find_elongations(corners: np.ndarray, labels: np.ndarray, areas: np.ndarray) -> np.ndarray:
    """Squares of half the diagonal of samples over their areas, given the corners, samples and areas of pieces."""
    points, weights = _TRIANGLE_POINTS @ corners, areas[:, None, None] / 3
    totals = np.bincount(labels, areas)
    means, squares = (
        np.stack([np.bincount(labels, (weights * powers).sum(axis=1)[:, k]) for k in range(3)]) / totals
        for powers in (points, points**2)
    )
    return 3 * (squares - means**2).sum(axis=0) / totals  # a rectangle a × b has the moments a²/12 and b²/12


def _find_surface_points(
    faces: np.ndarray, corners: np.ndarray, positions: np.ndarray, labels: np.ndarray, areas: np.ndarray
) -> SurfacePoints:
    """Spread points over samples, given the pieces: their faces, corners in these and in space, samples and areas."""
    permutation = np.argsort(labels, kind="stable")
    sums = np.cumsum(areas[permutation])
    ends = sums[np.searchsorted(labels[permutation], np.arange(labels.max(initial=-1) + 1), side="right") - 1]
    starts = np.concatenate([[0.0], ends[:-1]])
    quantiles = (np.arange(SURFACE_POINTS) + 0.5) / SURFACE_POINTS
    pieces = permutation[
        np.minimum(np.searchsorted(sums, starts[:, None] + quantiles * (ends - starts)[:, None]), len(sums) - 1)
    ]
    u, v = np.random.default_rng(0).uniform(size=(2, *pieces.shape, 1))
    in_pieces = np.concatenate([1 - np.sqrt(u), np.sqrt(u) * (1 - v), np.sqrt(u) * v], axis=-1)
    points = np.einsum("spk,spkx->spx", in_pieces, positions[pieces].astype(np.float64))
    orders = np.array([z_order(of_sample) for of_sample in points], dtype=int).reshape(pieces.shape)
    pieces = np.take_along_axis(pieces, orders, axis=1)
    weights = np.einsum("spk,spkc->spc", np.take_along_axis(in_pieces, orders[..., None], axis=1), corners[pieces])
    return SurfacePoints(faces[pieces].astype(np.int32), weights.astype(np.float32))


EVERYWHERE = (3.0, 4.0)
"""The beam (:mod:`.spot_cones`) of an emitter that has none."""


class EmitterBeams(NamedTuple):
    """Beams of emitters (:mod:`.spot_cones`); some emitters may have none."""

    beams: np.ndarray  # of the emitters, EVERYWHERE for none, shape [emitter, 2]
    vertices: SparseMatrix  # weights of all vertices in the emitters' axes, [emitter, vertex]
    faces: SparseMatrix  # weights of the emitting faces' area vectors in them, [emitter, face]


class EmitterSpan(NamedTuple):
    """Samples of one emitter among all samples."""

    emitter: int  # its number among the emitters
    first: int  # of the samples
    end: int
    is_two_sided: bool  # whether it is open
    beam: tuple[float, float] | None = None

    @property
    def size(self) -> int:
        """Number of its samples."""
        return self.end - self.first


class SamplePieces(NamedTuple):
    """Triangles that samples are made of."""

    corners: SparseMatrix  # weights of all vertices in their corners, [3 · piece, vertex]
    first: wp.array  # where those of each sample begin, and the end of the last, int32 of shape [sample + 1]
    elongations: wp.array  # square of half a sample's diagonal over its area, float32 of shape [sample]
    softness: wp.array  # w of each, float32 of shape [sample]

    @classmethod
    def of_emitters(cls, weights: Sequence[SampleWeights], corners: SparseMatrix) -> SamplePieces:
        """Make the pieces of some emitters' samples, given the weights of all vertices in the pieces' corners."""
        device = corners.rows.row_starts.device
        first = np.cumsum([0, *itertools.chain.from_iterable(np.diff(item.first_pieces) for item in weights)])
        constants = zip(*((item.elongations, item.softness) for item in weights), strict=True)
        return cls(
            corners,
            wp.array(first, dtype=wp.int32, device=device),
            *(wp.array(np.concatenate(item), dtype=wp.float32, device=device) for item in constants),
        )


class EmitterSamples(NamedTuple):
    """Samples of all emitters of a scene."""

    vertices: SparseMatrix  # weights of all vertices in the samples' middles, [sample, vertex]
    face_weights: SparseMatrix  # weights of the emitting faces in the samples' area vectors, [sample, face]
    pieces: SamplePieces  # pieces of each sample
    surface_points: SurfacePoints  # points of the samples, on ``faces``
    faces: wp.array  # emitting faces, vec3i of shape [face]
    bodies: tuple[int, ...]  # the emitters, by number
    is_two_sided: tuple[bool, ...]  # whether each is open
    first: np.ndarray  # where the samples of each begin, and the end of the last, shape [emitter + 1]
    beams: EmitterBeams | None = None  # of the emitters; None where none has one

    def spans(self) -> Iterator[EmitterSpan]:
        """The samples of each emitter."""
        for number, span in enumerate(itertools.pairwise(self.first.tolist())):
            beam = EVERYWHERE if self.beams is None else tuple(self.beams.beams[number].tolist())
            yield EmitterSpan(number, *span, self.is_two_sided[number], None if beam == EVERYWHERE else beam)


class PlacedSamples(NamedTuple):
    """Samples of emitters where they are in the world.

    Args:
        points: Middles y [scene units], vec3 of shape [batch, sample].
        areas: Area vectors A [square of scene units], vec3 of shape [batch, sample].
        corners: Of their pieces [scene units], vec3 of shape [batch, 3 · piece].
        pieces: Which pieces belong to which sample.
        bundles: Middle and radius of a sphere around each bundle, vec4 of shape [batch, bundle], without a gradient.
        balls: The same of each emitter, vec4 of shape [batch, emitter].
        axes: Of the emitters' beams, of any length, vec3 of shape [batch, emitter]; None where none has one.
    """

    points: wp.array
    areas: wp.array
    corners: wp.array
    pieces: SamplePieces
    bundles: wp.array
    balls: wp.array
    axes: wp.array | None = None


@wp.kernel
def _find_area_vectors(
    # in
    positions: wp.array2d(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    # out
    vectors: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a face of an instance."""
    batch, face = wp.tid()
    corners = faces[face]
    a = positions[batch, corners[0]]
    vectors[batch, face] = 0.5 * wp.cross(positions[batch, corners[1]] - a, positions[batch, corners[2]] - a)


@wp.kernel(enable_backward=False)
def _find_bundles(
    # in
    points: wp.array2d(dtype=wp.vec3),
    areas: wp.array2d(dtype=wp.vec3),
    # out
    bundles: wp.array2d(dtype=wp.vec4),
):
    """A thread owns a bundle of an instance."""
    batch, bundle = wp.tid()
    middle = wp.vec3()
    for i in range(SAMPLE_BUNDLE):
        middle += points[batch, bundle * SAMPLE_BUNDLE + i] / float(SAMPLE_BUNDLE)
    radius = float(0.0)
    for i in range(SAMPLE_BUNDLE):
        sample = bundle * SAMPLE_BUNDLE + i
        radius = wp.max(radius, wp.length(points[batch, sample] - middle) + sample_radius(areas[batch, sample]))
    bundles[batch, bundle] = wp.vec4(middle[0], middle[1], middle[2], radius)


@wp.kernel(enable_backward=False)
def _find_balls(
    # in
    bundles: wp.array2d(dtype=wp.vec4),
    first_samples: wp.array(dtype=wp.int32),
    # out
    balls: wp.array2d(dtype=wp.vec4),
):
    """A thread owns an emitter of an instance."""
    batch, emitter = wp.tid()
    first = first_samples[emitter] // SAMPLE_BUNDLE
    end = first_samples[emitter + 1] // SAMPLE_BUNDLE
    middle = wp.vec3()
    for bundle in range(first, end):
        middle += wp.vec3(bundles[batch, bundle][0], bundles[batch, bundle][1], bundles[batch, bundle][2])
    middle = middle / float(wp.max(end - first, 1))
    radius = float(0.0)
    for bundle in range(first, end):
        center = wp.vec3(bundles[batch, bundle][0], bundles[batch, bundle][1], bundles[batch, bundle][2])
        radius = wp.max(radius, wp.length(center - middle) + bundles[batch, bundle][3])
    balls[batch, emitter] = wp.vec4(middle[0], middle[1], middle[2], radius)


@wp.func
def sample_radius(area: wp.vec3):
    """Radius of a disc of a sample's area."""
    return wp.sqrt(wp.length(area) / wp.pi)


@wp.func
def facing_area(beam: wp.vec3, area: wp.vec3, softness: float, is_two_sided: int):
    """Area of a sample that a receiver sees, of its front or of both sides, times the length of the way to it."""
    facing = -wp.dot(beam, area)
    width = softness * wp.length(area) * wp.length(beam)
    area_seen = _soft_positive(facing, width)
    if is_two_sided == 1:
        area_seen = area_seen + _soft_positive(-facing, width)
    return area_seen


@wp.func
def _soft_positive(value: float, width: float):
    """The maximum of a value and 0, soft where it is closer to 0 than a width."""
    if wp.abs(value) < width:
        step = (value / width + 1.0) / 2.0
        return width * step * step
    return wp.max(value, 0.0)


@wp.func
def may_light(beam: wp.vec3, area: wp.vec3, normal: wp.vec3, is_two_sided: int):
    """Whether a part of a sample may light a receiver, even if its middle does not.

    Not if the middle is √|A| or more below the receiver's horizon, nor, unless two-sided, if the receiver is behind the
    sample's plane by a sine of 0.3 or more.
    """
    size = wp.length(area)
    is_above = wp.dot(beam, normal) > -wp.sqrt(size) and wp.length_sq(beam) > 0.0
    return is_above and (wp.dot(beam, area) < _MAX_SOFTNESS * size * wp.length(beam) or is_two_sided == 1)


@wp.func
def sample_transmittance(transmittance: wp.array3d(dtype=wp.float32), batch: int, receiver: int, i: int):
    """Transmittance from a receiver to a sample, 1 where nothing blocks."""
    result = float(1.0)
    if transmittance:
        result = transmittance[batch, receiver, i]
    return result


def place_samples(positions: wp.array, samples: EmitterSamples) -> PlacedSamples:
    """Place the samples of emitters by the vertices of all bodies.

    Args:
        positions: Of all vertices [scene units], vec3 of shape [batch, vertex].
    Differentiable: positions.
    """
    count, device = len(positions), positions.device
    vectors = empty((count, len(samples.faces)), dtype=wp.vec3, device=device)
    launch(_find_area_vectors, vectors.shape, inputs=[positions, samples.faces], outputs=[vectors])
    points, areas = multiply(samples.vertices, positions), multiply(samples.face_weights, vectors)
    bundles = empty((count, points.shape[1] // SAMPLE_BUNDLE), dtype=wp.vec4, device=device)
    launch(_find_bundles, bundles.shape, inputs=[points, areas], outputs=[bundles])
    balls = empty((count, len(samples.bodies)), dtype=wp.vec4, device=device)
    launch(_find_balls, balls.shape, inputs=[bundles, constant(samples.first, wp.int32, device)], outputs=[balls])
    axes = None
    if samples.beams is not None:
        of_vertices = multiply(samples.beams.vertices, positions)
        axes = multiply(samples.beams.faces, vectors, addend=of_vertices)
    corners = multiply(samples.pieces.corners, positions)
    return PlacedSamples(points, areas, corners, samples.pieces, bundles, balls, axes)
