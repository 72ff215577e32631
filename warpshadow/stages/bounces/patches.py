"""Patches: parts of a body's surface that send light as one, and the points at which they are lit.

Most bodies are cut into pieces of about one size, and k-means of position and normal makes patches of them. A body that
lies in a plane has a grid instead, finer near the other bodies, whose shadows it shows. All is found once, in the
body's own frame and at rest; patches move with the body.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import warp as wp

from warpshadow.maths.spatial_sort import compact_order
from warpshadow.stages.planes.grid import PlaneTexture, find_grid
from warpshadow.stages.self_visibility.buried import find_buried

MAX_PATCHES = 256  # patches of a body
PIECES = 8  # pieces of each patch, at least

_NEEDLE = 0.01
"""Area of a piece that stays whole however long it is, where pieces should be 1 long: so the number of pieces is
bounded."""

SAMPLES_PER_PATCH = 4  # patch samples of a patch, at most

_NORMAL_WEIGHT = 1.0
"""How far apart opposite normals are, in units of the body's size: both sides of a thin wall have patches of their own.
With 0.4, images with two bounces of nested boxes and of stairs were 8.6 and 10.5% off images with all patches, by this
7.6 and 9.3%; for a bowl, rooms and chairs they are the same."""

_COMPACT = np.repeat([1.0, 10.0], 3)
"""Weights of position and normal by which patches are put in order. Kernels look at patch samples that follow each
other at once, and leave out spheres below the horizon of all: in a city of 60 boxes and cylinders that saves a fifth of
their time."""

_COMPACT_RUN = 4  # patches that are best near each other

_LIFT = 1e-4
"""How far above a piece rays start that find out whether it is inside another part, in units of the body's size: where
two parts touch, each is inside the other."""

_INWARD = 0.1  # how far from a corner towards the middle a piece is looked at, to see whether it reaches out

_LLOYD_STEPS = 8

_LEARNED = 20_000  # pieces that k-means looks at, at most


class Pieces(NamedTuple):
    """Small triangles that faces are cut into; most are whole faces."""

    faces: np.ndarray  # the face that each is a part of, int32 of shape [piece]
    corners: np.ndarray  # barycentric coordinates of its corners in that face, float32 of shape [piece, 3, 3]

    def positions(self, positions: np.ndarray, faces: np.ndarray) -> np.ndarray:
        """Corners of all pieces, float64 of shape [piece, 3, 3]."""
        return self.corners.astype(np.float64) @ positions.astype(np.float64)[faces[self.faces]]


class PatchSamples(NamedTuple):
    """Points of a mesh at which its patches are lit, consecutive for each patch; a vertex is a special case."""

    faces: np.ndarray  # face that each lies on, int32 of shape [patch sample]
    barycentrics: np.ndarray  # and where on it, float32 of shape [patch sample, 3]
    is_back: np.ndarray  # whether it is lit from the face's back, bool of shape [patch sample]
    patches: np.ndarray  # patch that each belongs to, ascending, int32 of shape [patch sample]
    weights: np.ndarray  # share of that patch, which add up to 1 in each, float32 of shape [patch sample]


@dataclass(frozen=True, eq=False)
class Patches:
    """Patches of a body in its own frame.

    Args:
        areas: Area of each, float32 of shape [patch].
        centers: Mean position, float32 of shape [patch, 3].
        normals: Mean normal, of unit length, float32 of shape [patch, 3].
        patch_samples: Where they are lit.
        pieces: Their pieces.
        of_pieces: Patch of each piece's front and back, int32 of shape [2, piece]; −1 for sides that send nothing.
        grid: The grid of a plane body, None for others.
    """

    areas: np.ndarray
    centers: np.ndarray
    normals: np.ndarray
    patch_samples: PatchSamples
    pieces: Pieces
    of_pieces: np.ndarray
    grid: PlaneTexture | None = None

    @property
    def count(self) -> int:
        """Number of patches."""
        return len(self.areas)

    def nearest_spheres(self, centers: np.ndarray, radii: np.ndarray) -> np.ndarray:
        """The sphere whose surface is nearest to each patch, of spheres [sphere, 3], [sphere]: int32 [patch]."""
        gaps = np.linalg.norm(self.centers[:, None] - centers, axis=2) - radii
        return np.abs(gaps).argmin(axis=1).astype(np.int32)


def find_patches(
    positions: np.ndarray,
    faces: np.ndarray,
    *,
    is_two_sided: bool,
    count: int = MAX_PATCHES,
    patch_samples: int = SAMPLES_PER_PATCH,
    device: wp.DeviceLike = None,
) -> Patches:
    """Find the patches of a body, by k-means of position and normal.

    Pieces inside another part of a closed body, as those between the steps of stairs that are boxes, belong to none. A
    piece that is mostly inside, and reaches out, sends the light of the nearest patch, whose area does not count it.

    Args:
        positions: Vertices [units of the body], shape [vertex, 3].
        faces: Faces that wind alike, shape [face, 3].
        is_two_sided: Whether the backs of faces send light, too: each side then has half of the patches.
        count: Number of patches, at most.
        patch_samples: Number of patch samples of each, at most.
    Returns:
        Patches; none where no face has an area.
    """
    sides = 2 if is_two_sided else 1
    count //= sides
    total = np.linalg.norm(_areas(positions.astype(np.float64)[faces]), axis=1).sum()
    longest = 2 * np.sqrt(total / (PIECES * count))  # as in right triangles
    cut = _cut(positions, faces, lambda points: points / longest)
    areas = np.linalg.norm(cut.areas, axis=1)
    half_size = np.linalg.norm(np.ptp(cut.middles, axis=0)) / 2 if len(areas) else 1.0
    unit_normals = cut.areas / areas[:, None]
    features = np.concatenate([cut.middles / half_size, _NORMAL_WEIGHT * unit_normals], axis=1)
    is_outside, reaches_out = np.ones(len(areas), bool), np.zeros(len(areas), bool)
    if len(areas) and not is_two_sided:
        points = wp.array(positions, dtype=wp.vec3, device=device)
        mesh = wp.Mesh(points, wp.array(faces.ravel(), dtype=wp.int32, device=device))
        is_outside, reaches_out = _find_outside(mesh, cut.pieces.positions(positions, faces), float(_LIFT * half_size))
    labels = np.full(len(areas), -1)
    labels[is_outside] = _clusters(features[is_outside], areas[is_outside], count)
    result: list[tuple[int, np.ndarray, int, float]] = []
    for patch, members in enumerate(_members(labels)):
        for group in _split(members, cut.middles, areas, patch_samples):
            middle = np.average(cut.middles[group], axis=0, weights=areas[group])
            piece = group[np.linalg.norm(cut.middles[group] - middle, axis=1).argmin()]
            barycentrics = cut.pieces.corners[piece]
            if np.array_equal(barycentrics, np.eye(3)):  # a vertex has its own visibility, a point has that of three
                corners = positions[faces[cut.pieces.faces[piece]]]
                barycentrics = barycentrics[np.linalg.norm(corners - middle, axis=1).argmin()]
            else:
                barycentrics = barycentrics.mean(axis=0)
            result.append((cut.pieces.faces[piece], barycentrics, patch, areas[group].sum() / areas[members].sum()))
    weighted = np.concatenate([areas[:, None] * cut.middles, cut.areas, areas[:, None]], axis=1)
    sums = _sums(labels[is_outside], weighted[is_outside])
    labels[reaches_out] = labels[is_outside][_nearest(features[is_outside], features[reaches_out])]
    return Patches(
        *_on_sides(sides, sums[:, 6], sums[:, :3] / sums[:, 6:], _unit(sums[:, 3:6])),
        _patch_samples_of(result, sides, len(sums)),
        cut.pieces,
        _of_sides(labels, sides, len(sums)),
    )


def find_plane_patches(
    positions: np.ndarray, faces: np.ndarray, *, is_two_sided: bool, others: np.ndarray | None = None
) -> Patches:
    """Find the patches of a body that lies in a plane: the texels of a grid over its smallest rectangle.

    Args:
        positions, faces, is_two_sided, others: As for :func:`warpshadow.stages.planes.grid.find_grid`.
    Returns:
        Patches, row by row: texels off the mesh have no area and no patch sample.
    """
    grid, covered = find_grid(positions, faces, is_two_sided=is_two_sided, others=others)
    frame, origin = grid.frame, grid.origin
    texels = grid.texel_sizes().reshape(-1, 2)

    def in_texels(points: np.ndarray) -> np.ndarray:
        places = grid.in_texels((points - origin) @ frame.T[:, :2])
        return np.concatenate([places, np.zeros_like(places[..., :1])], axis=-1)

    cut = _cut(positions, faces, in_texels)
    labels = grid.texels_of((cut.middles - origin) @ frame.T[:, :2])
    centers = origin + grid.middles().reshape(-1, 2) @ frame[:2]
    areas = grid.covered.ravel() * texels.prod(axis=1)
    return Patches(
        *_on_sides(grid.sides, areas, centers, np.tile(frame[2], (len(areas), 1))),
        _patch_samples_of([(*point, 1.0) for point in zip(*covered, strict=True)], grid.sides, len(areas)),
        cut.pieces,
        _of_sides(labels, grid.sides, len(areas)),
        grid,
    )


# ---------------------------------------------------------------------------------------------------- pieces


class _Cut(NamedTuple):
    """A mesh cut into pieces."""

    pieces: Pieces
    middles: np.ndarray  # [piece, 3]
    areas: np.ndarray  # normals as long as areas, [piece, 3]


def _areas(corners: np.ndarray) -> np.ndarray:
    """Normals of triangles, as long as their areas are large."""
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2


def _cut(positions: np.ndarray, faces: np.ndarray, measured: Callable[[np.ndarray], np.ndarray]) -> _Cut:
    """Halve faces across their longest edges, until none is longer than 1.

    Args:
        positions: Vertices [units of the body], shape [vertex, 3].
        faces: Faces, shape [face, 3].
        measured: Maps points [..., 3] to the space in which lengths count.
    """
    whole = positions.astype(np.float64)[faces]
    owners = np.flatnonzero(_areas(whole).any(axis=1)).astype(np.int32)
    corners = np.tile(np.eye(3), (len(owners), 1, 1))
    parts = []
    while len(owners):
        places = measured(corners @ whole[owners])
        edges = np.linalg.norm(np.roll(places, -1, axis=1) - np.roll(places, -2, axis=1), axis=2)
        is_long = (edges.max(axis=1) > 1) & (np.linalg.norm(_areas(places), axis=1) > _NEEDLE)
        parts.append((owners[~is_long], corners[~is_long]))
        opposite = edges[is_long].argmax(axis=1)[:, None]
        a, b, c = np.moveaxis(np.take_along_axis(corners[is_long], (opposite + np.arange(3))[..., None] % 3, 1), 1, 0)
        middle = (b + c) / 2
        owners = np.tile(owners[is_long], 2)
        corners = np.concatenate([np.stack([a, b, middle], axis=1), np.stack([a, middle, c], axis=1)])
    owners, corners = (np.concatenate(item) for item in zip((owners, corners), *parts, strict=True))
    permutation = np.argsort(owners, kind="stable")
    pieces = Pieces(owners[permutation], corners[permutation].astype(np.float32))
    places = corners[permutation] @ whole[owners[permutation]]
    return _Cut(pieces, places.mean(axis=1), _areas(places))


def _find_outside(mesh: wp.Mesh, corners: np.ndarray, lift: float) -> tuple[np.ndarray, np.ndarray]:
    """Which pieces are outside of all parts of their body, and which of the others reach out.

    Args:
        mesh: The body, of parts that are closed.
        corners: Of the pieces, shape [piece, 3, 3].
        lift: How far above them rays start.
    Returns:
        Whether the middle is outside, bool of shape [piece]; all are where none would be. And whether it is not, but a
        place near a corner is.
    """
    normals = _unit(_areas(corners))
    middles = corners.mean(axis=1)

    def is_buried(points: np.ndarray, chosen: np.ndarray) -> np.ndarray:
        lifted, facing = (points + lift * normals[chosen]).astype(np.float32), normals[chosen].astype(np.float32)
        return find_buried(mesh, lifted, facing, len(lifted))

    is_inside = is_buried(middles, np.arange(len(corners)))
    if is_inside.all():
        return is_inside, ~is_inside
    inside, reaches_out = np.flatnonzero(is_inside), np.zeros(len(corners), bool)
    for corner in np.moveaxis(corners[inside], 1, 0):
        reaches_out[inside] |= ~is_buried(corner + _INWARD * (middles[inside] - corner), inside)
    return ~is_inside, reaches_out


# ---------------------------------------------------------------------------------------------------- clusters


def _clusters(features: np.ndarray, weights: np.ndarray, count: int) -> np.ndarray:
    """K-means [Lloyd 1982], from halves of halves: the cluster of each item, none empty."""
    learned = np.arange(0, len(features), max(1, len(features) // _LEARNED))
    groups = _split(learned, features, weights, count)
    centers = np.array([np.average(features[group], axis=0, weights=weights[group]) for group in groups])
    if not len(centers):
        return np.zeros(0, int)
    for _ in range(_LLOYD_STEPS):
        nearest = _nearest(centers, features[learned])
        sums = _sums(nearest, weights[learned, None] * features[learned], len(centers))
        total = np.bincount(nearest, weights[learned], len(centers))[:, None]
        centers = np.where(total > 0, sums / np.where(total > 0, total, 1), centers)
    used, labels = np.unique(_nearest(centers, features), return_inverse=True)
    return np.argsort(compact_order(centers[used] * _COMPACT, runs=(_COMPACT_RUN,)))[labels]


def _nearest(centers: np.ndarray, features: np.ndarray) -> np.ndarray:
    """The nearest center of each feature."""
    from scipy.spatial import cKDTree

    return cKDTree(centers).query(features)[1]


def _split(items: np.ndarray, points: np.ndarray, weights: np.ndarray, count: int) -> list[np.ndarray]:
    """Split items into at most ``count`` groups of about one weight, along the axes on which they extend most."""
    if count <= 1 or len(items) <= 1:
        return [items] if len(items) else []
    offsets = points[items] - points[items].mean(axis=0)
    _, axes = np.linalg.eigh(offsets.T @ offsets)
    permutation = items[np.argsort(offsets @ axes[:, -1], kind="stable")]
    below = np.cumsum(weights[permutation])
    cut = np.searchsorted(below, below[-1] * (count // 2) / count) + 1
    cut = min(cut, len(permutation) - 1)
    first, second = _split(permutation[:cut], points, weights, count // 2), permutation[cut:]
    return first + _split(second, points, weights, count - count // 2)


def _members(labels: np.ndarray) -> list[np.ndarray]:
    """Items of each cluster; those of −1 belong to none."""
    permutation = np.argsort(labels, kind="stable")[np.count_nonzero(labels < 0) :]
    return np.split(permutation, np.flatnonzero(np.diff(labels[permutation])) + 1) if len(permutation) else []


def _sums(labels: np.ndarray, values: np.ndarray, count: int = 0) -> np.ndarray:
    """Sums of values [item, n] over the items of each cluster, [cluster, n]."""
    return np.stack([np.bincount(labels, column, count) for column in values.T], axis=1)


def _unit(vectors: np.ndarray) -> np.ndarray:
    """Vectors of length 1; vectors of length 0 stay 0."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors / np.where(length > 0, length, 1)


# ---------------------------------------------------------------------------------------------------- sides


def _on_sides(
    sides: int, areas: np.ndarray, centers: np.ndarray, normals: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Areas, centers and normals of the patches of all sides."""
    turned = np.concatenate([normals, -normals][:sides])
    return (
        np.tile(areas, sides).astype(np.float32),
        np.tile(centers, (sides, 1)).astype(np.float32),
        turned.astype(np.float32),
    )


def _of_sides(labels: np.ndarray, sides: int, count: int) -> np.ndarray:
    """Patch of each piece's front and back."""
    return np.stack([labels, labels + count if sides == 2 else np.full_like(labels, -1)]).astype(np.int32)


def _patch_samples_of(result: list[tuple[int, np.ndarray, int, float]], sides: int, count: int) -> PatchSamples:
    """Patch samples on all sides from the patch samples on the front: face, barycentrics, patch and weight of each."""
    faces, barycentrics, patches, weights = zip(*result, strict=True) if result else ([], [], [], [])
    number = len(result)
    owners = np.array(patches, np.int32)
    return PatchSamples(
        np.tile(np.array(faces, np.int32), sides),
        np.tile(np.array(barycentrics, np.float32).reshape(-1, 3), (sides, 1)),
        np.repeat([False, True][:sides], number),
        np.concatenate([owners, owners + np.int32(count)][:sides]),
        np.tile(np.array(weights, np.float32), sides),
    )
