"""Patches: the parts of a body's surface that send light as one, and the patch samples at which they are lit.

Faces are cut at their longest edges into pieces of about one size, and patches are clusters of pieces by position and
normal (k-means): 256 at most, of 8 pieces or more, smaller where the body touches another
(:mod:`warpshadow.maths.contacts`). A body that lies in a plane has a grid of texels instead, which are small near the
other bodies, whose shadows it shows (:mod:`warpshadow.stages.planes.grid`). A patch has up to four patch samples, with
weights by area. Pieces inside another part of the body belong to no patch.

All is found once, in the body's own frame and at rest; patches move with the body. Patches of backs follow those of
fronts.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import warp as wp

from warpshadow.maths.adjacency import area_normals
from warpshadow.maths.contacts import Contact, contact_excess
from warpshadow.maths.spatial_sort import compact_order
from warpshadow.stages.planes.grid import PlaneTexture, find_grid
from warpshadow.stages.self_visibility.buried import find_buried

MAX_PATCHES = 256  # patches of a body
PIECES_PER_PATCH = 8  # pieces of each patch, at least

_NEEDLE_AREA = 0.01
"""Area of a piece that stays whole however long it is, where pieces should be 1 long: so the number of pieces is
bounded."""

SAMPLES_PER_PATCH = 4  # patch samples of a patch, at most

_NORMAL_WEIGHT = 1.0
"""Distance of opposite normals in feature space, in units of the body's size: both sides of a thin wall have patches of
their own. With 0.4, images with two bounces of nested boxes and of stairs were 8.6 and 10.5% off images with all
patches, by this 7.6 and 9.3%; for a bowl, rooms and chairs they are the same."""

_SORT_WEIGHTS = np.repeat([1.0, 10.0], 3)
"""Weights of position and normal by which patches are put in order. Kernels look at patch samples that follow each
other at once, and leave out spheres below the horizon of all: in a city of 60 boxes and cylinders that saves a fifth of
their time."""

_SORT_RUN = 4  # patches that are best near each other

_LIFT = 1e-4
"""Height above a piece at which rays start that tell whether it is inside another part, in units of the body's size:
where two parts touch, each is inside the other."""

_INWARD_SHARE = 0.1  # how far from a corner towards the middle a piece is looked at, to see whether it reaches out

_LLOYD_STEPS = 8

_CONTACT_WEIGHT = 2.0  # w of :mod:`warpshadow.maths.contacts`, at most …
_CONTACT_SHARE = 2.0  # … and patches that contacts add, in units of those without: a third are left elsewhere

_MAX_CLUSTERED_PIECES = 20_000  # pieces that k-means looks at, at most


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
        spreads: Largest angle of its surface to the mean normal [radians], float32 of shape [patch].
        sagittas: How far its surface lies below its tangent plane, at most, float32 of shape [patch].
        patch_samples: Where they are lit.
        pieces: Their pieces.
        patch_of_pieces: Patch of each piece's front and back, int32 of shape [2, piece]; −1 for sides that send
            nothing.
        grid: The grid of a plane body, None for others.
    """

    areas: np.ndarray
    centers: np.ndarray
    normals: np.ndarray
    spreads: np.ndarray
    sagittas: np.ndarray
    patch_samples: PatchSamples
    pieces: Pieces
    patch_of_pieces: np.ndarray
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
    contacts: Sequence[Contact] = (),
    device: wp.DeviceLike = None,
) -> Patches:
    """Find the patches of a body, by k-means of position and normal.

    Pieces inside another part of a closed body, such as between steps of stairs that are boxes, belong to none. A
    piece that is mostly inside, and reaches out, sends the light of the nearest patch, whose area does not count it.

    Args:
        positions, faces: Vertices [units of the body], shape [vertex, 3], and faces that wind alike, [face, 3].
        is_two_sided: Whether the backs of faces send light, too: each side then has half of the patches.
        count: Number of patches, at most.
        patch_samples: Number of patch samples of each, at most.
        contacts: Where the body touches others, in its own frame: patches are smaller there.
    Returns:
        Patches; none where no face has an area.
    """
    side_count = 2 if is_two_sided else 1
    count //= side_count
    total_area = np.linalg.norm(_area_vectors(positions.astype(np.float64)[faces]), axis=1).sum()
    max_edge = 2 * np.sqrt(total_area / (PIECES_PER_PATCH * count))  # as in right triangles
    piece_mesh = _cut_faces(positions, faces, lambda points: points / max_edge)
    contact_weight = _contact_weight(piece_mesh, contacts)
    if contact_weight > 0:

        def to_unit_lengths(points: np.ndarray) -> np.ndarray:
            density = 1 + contact_weight * contact_excess(*_bounding_spheres(points), contacts)
            return points * np.sqrt(density)[:, None, None] / max_edge

        piece_mesh = _cut_faces(positions, faces, to_unit_lengths)
    areas = np.linalg.norm(piece_mesh.area_vectors, axis=1)
    half_size = np.linalg.norm(np.ptp(piece_mesh.centroids, axis=0)) / 2 if len(areas) else 1.0
    unit_normals = piece_mesh.area_vectors / areas[:, None]
    features = np.concatenate([piece_mesh.centroids / half_size, _NORMAL_WEIGHT * unit_normals], axis=1)
    is_outside, reaches_out = np.ones(len(areas), bool), np.zeros(len(areas), bool)
    if len(areas) and not is_two_sided:
        points = wp.array(positions, dtype=wp.vec3, device=device)
        mesh = wp.Mesh(points, wp.array(faces.ravel(), dtype=wp.int32, device=device))
        is_outside, reaches_out = _find_outside(
            mesh, piece_mesh.pieces.positions(positions, faces), float(_LIFT * half_size)
        )
    labels = np.full(len(areas), -1)
    density = 1 + contact_weight * contact_excess(piece_mesh.centroids, 0.0, contacts)
    labels[is_outside] = _cluster(features[is_outside], areas[is_outside], density[is_outside], count)
    front_samples: list[tuple[int, np.ndarray, int, float]] = []
    for patch, members in enumerate(_cluster_members(labels)):
        for sample_pieces in _split_evenly(members, piece_mesh.centroids, areas, patch_samples):
            sample_center = np.average(piece_mesh.centroids[sample_pieces], axis=0, weights=areas[sample_pieces])
            nearest_piece = sample_pieces[
                np.linalg.norm(piece_mesh.centroids[sample_pieces] - sample_center, axis=1).argmin()
            ]
            barycentrics = piece_mesh.pieces.corners[nearest_piece]
            if np.array_equal(barycentrics, np.eye(3)):  # a vertex has its own visibility, a point has that of three
                corners = positions[faces[piece_mesh.pieces.faces[nearest_piece]]]
                barycentrics = barycentrics[np.linalg.norm(corners - sample_center, axis=1).argmin()]
            else:
                barycentrics = barycentrics.mean(axis=0)
            front_samples.append(
                (
                    piece_mesh.pieces.faces[nearest_piece],
                    barycentrics,
                    patch,
                    areas[sample_pieces].sum() / areas[members].sum(),
                )
            )
    weighted_moments = np.concatenate(
        [areas[:, None] * piece_mesh.centroids, piece_mesh.area_vectors, areas[:, None]], axis=1
    )
    sums = _cluster_sums(labels[is_outside], weighted_moments[is_outside])
    centers, normals = sums[:, :3] / sums[:, 6:], _normalized(sums[:, 3:6])
    of_outside = labels[is_outside]
    cosines = (unit_normals[is_outside] * normals[of_outside]).sum(axis=1)
    corners = piece_mesh.pieces.positions(positions, faces)[is_outside]
    heights = ((corners - centers[of_outside, None]) * normals[of_outside, None]).sum(axis=2)
    spreads, lowest, highest = (np.zeros(len(sums)) for _ in range(3))
    np.maximum.at(spreads, of_outside, np.arccos(np.clip(cosines, -1, 1)))
    np.minimum.at(lowest, of_outside, heights.min(axis=1, initial=0))
    np.maximum.at(highest, of_outside, heights.max(axis=1, initial=0))
    labels[reaches_out] = labels[is_outside][_nearest_center(features[is_outside], features[reaches_out])]
    return Patches(
        *_repeat_on_sides(side_count, sums[:, 6], centers, normals),
        np.tile(spreads, side_count).astype(np.float32),
        np.concatenate([-lowest, highest][:side_count]).astype(np.float32),
        _patch_samples_of(front_samples, side_count, len(sums)),
        piece_mesh.pieces,
        _patches_of_sides(labels, side_count, len(sums)),
    )


def find_plane_patches(
    positions: np.ndarray,
    faces: np.ndarray,
    *,
    is_two_sided: bool,
    others: np.ndarray | None = None,
    contact: Contact | None = None,
    half_spaces: np.ndarray | None = None,
) -> Patches:
    """Find the patches of a body that lies in a plane: the texels of a grid over its smallest rectangle.

    Args:
        positions, faces, is_two_sided, others, contact, half_spaces: As for :func:`.stages.planes.grid.find_grid`.
    Returns:
        Patches, row by row: texels off the mesh have no area and no patch sample.
    """
    grid, texel_points = find_grid(
        positions, faces, is_two_sided=is_two_sided, others=others, contact=contact, half_spaces=half_spaces
    )
    frame, origin = grid.frame, grid.origin
    texel_sizes = grid.texel_sizes().reshape(-1, 2)

    def to_texels(points: np.ndarray) -> np.ndarray:
        texel_coordinates = grid.in_texels((points - origin) @ frame.T[:, :2])
        return np.concatenate([texel_coordinates, np.zeros_like(texel_coordinates[..., :1])], axis=-1)

    piece_mesh = _cut_faces(positions, faces, to_texels)
    labels = grid.texels_of((piece_mesh.centroids - origin) @ frame.T[:, :2])
    centers = origin + grid.middles().reshape(-1, 2) @ frame[:2]
    is_shown = grid.texel_weights.ravel() == 1
    if half_spaces is not None and not is_shown.all():
        # a piece that reaches out from behind a plane has the light before it
        heights = piece_mesh.pieces.positions(positions, faces) @ half_spaces[:, :3].T + half_spaces[:, 3]
        reaches_out = (heights > _LIFT * np.ptp(heights, axis=(0, 1))).all(axis=2).any(axis=1) & ~is_shown[labels]
        shown_texels = np.flatnonzero(is_shown & (grid.covered.ravel() > 0))
        nearest = _nearest_center(centers[shown_texels], piece_mesh.centroids[reaches_out])
        labels[reaches_out] = shown_texels[nearest]
    areas = grid.covered.ravel() * texel_sizes.prod(axis=1)
    return Patches(
        *_repeat_on_sides(grid.sides, areas, centers, np.tile(frame[2], (len(areas), 1))),
        np.zeros(grid.sides * len(areas), np.float32),
        np.zeros(grid.sides * len(areas), np.float32),
        _patch_samples_of([(*point, 1.0) for point in zip(*texel_points, strict=True)], grid.sides, len(areas)),
        piece_mesh.pieces,
        _patches_of_sides(labels, grid.sides, len(areas)),
        grid,
    )


# ---------------------------------------------------------------------------------------------------- pieces


class _PieceMesh(NamedTuple):
    """A mesh cut into pieces."""

    pieces: Pieces
    centroids: np.ndarray  # [piece, 3]
    area_vectors: np.ndarray  # normals as long as areas, [piece, 3]


def _area_vectors(corners: np.ndarray) -> np.ndarray:
    """Normals of triangles, as long as their areas."""
    return area_normals(corners) / 2


def _cut_faces(
    positions: np.ndarray, faces: np.ndarray, to_unit_lengths: Callable[[np.ndarray], np.ndarray]
) -> _PieceMesh:
    """Halve faces across their longest edges, until none is longer than 1.

    Args:
        positions, faces: Vertices [units of the body], shape [vertex, 3], and faces, [face, 3].
        to_unit_lengths: Maps points [..., 3] to the space in which lengths count.
    """
    face_corners = positions.astype(np.float64)[faces]
    piece_faces = np.flatnonzero(_area_vectors(face_corners).any(axis=1)).astype(np.int32)
    corners = np.tile(np.eye(3), (len(piece_faces), 1, 1))
    short_pieces = []
    while len(piece_faces):
        scaled_corners = to_unit_lengths(corners @ face_corners[piece_faces])
        edges = np.linalg.norm(np.roll(scaled_corners, -1, axis=1) - np.roll(scaled_corners, -2, axis=1), axis=2)
        is_long = (edges.max(axis=1) > 1) & (np.linalg.norm(_area_vectors(scaled_corners), axis=1) > _NEEDLE_AREA)
        short_pieces.append((piece_faces[~is_long], corners[~is_long]))
        opposite = edges[is_long].argmax(axis=1)[:, None]
        a, b, c = np.moveaxis(np.take_along_axis(corners[is_long], (opposite + np.arange(3))[..., None] % 3, 1), 1, 0)
        edge_center = (b + c) / 2
        piece_faces = np.tile(piece_faces[is_long], 2)
        corners = np.concatenate([np.stack([a, b, edge_center], axis=1), np.stack([a, edge_center, c], axis=1)])
    piece_faces, corners = (np.concatenate(item) for item in zip((piece_faces, corners), *short_pieces, strict=True))
    permutation = np.argsort(piece_faces, kind="stable")
    pieces = Pieces(piece_faces[permutation], corners[permutation].astype(np.float32))
    piece_corners = corners[permutation] @ face_corners[piece_faces[permutation]]
    return _PieceMesh(pieces, piece_corners.mean(axis=1), _area_vectors(piece_corners))


def _contact_weight(piece_mesh: _PieceMesh, contacts: Sequence[Contact]) -> float:
    """Find w of :mod:`warpshadow.maths.contacts`: how many patches contacts add, before there are fewer elsewhere."""
    areas = np.linalg.norm(piece_mesh.area_vectors, axis=1)
    if not len(contacts) or not len(areas):
        return 0.0
    mean_excess = np.average(contact_excess(piece_mesh.centroids, 0.0, contacts), weights=areas)
    return min(_CONTACT_WEIGHT, _CONTACT_SHARE / mean_excess)


def _bounding_spheres(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Centers and radii of spheres around triangles [piece, 3, 3]."""
    centroids = corners.mean(axis=1)
    return centroids, np.linalg.norm(corners - centroids[:, None], axis=2).max(axis=1)


def _find_outside(mesh: wp.Mesh, corners: np.ndarray, lift: float) -> tuple[np.ndarray, np.ndarray]:
    """Find the pieces outside all parts of their body, and the pieces inside that reach out of it.

    Args:
        mesh: The body, of parts that are closed.
        corners: Of the pieces, shape [piece, 3, 3].
        lift: How far above them rays start.
    Returns:
        Whether the middle is outside, bool of shape [piece]; all are where none would be. And whether it is not, but a
        place near a corner is.
    """
    normals = _normalized(_area_vectors(corners))
    centroids = corners.mean(axis=1)

    def is_buried(points: np.ndarray, pieces: np.ndarray) -> np.ndarray:
        lifted_points, lifted_normals = (
            (points + lift * normals[pieces]).astype(np.float32),
            normals[pieces].astype(np.float32),
        )
        return find_buried(mesh, lifted_points, lifted_normals)

    is_inside = is_buried(centroids, np.arange(len(corners)))
    if is_inside.all():
        return is_inside, ~is_inside
    inside_pieces, reaches_out = np.flatnonzero(is_inside), np.zeros(len(corners), bool)
    for corner_points in np.moveaxis(corners[inside_pieces], 1, 0):
        reaches_out[inside_pieces] |= ~is_buried(
            corner_points + _INWARD_SHARE * (centroids[inside_pieces] - corner_points), inside_pieces
        )
    return ~is_inside, reaches_out


# ---------------------------------------------------------------------------------------------------- clusters


def _cluster(features: np.ndarray, areas: np.ndarray, density: np.ndarray, count: int) -> np.ndarray:
    """K-means [Lloyd 1982], from halves of halves: the cluster of each item, none empty.

    Clusters get as dense as the square root of the weights, in surfaces [Gersho 1979].
    """
    subset = np.arange(0, len(features), max(1, len(features) // _MAX_CLUSTERED_PIECES))
    subset_groups = _split_evenly(subset, features, areas * density, count)
    weights = areas * density**2
    centers = np.array([np.average(features[group], axis=0, weights=weights[group]) for group in subset_groups])
    if not len(centers):
        return np.zeros(0, int)
    for _ in range(_LLOYD_STEPS):
        nearest = _nearest_center(centers, features[subset])
        feature_sums = _cluster_sums(nearest, weights[subset, None] * features[subset], len(centers))
        weight_sums = np.bincount(nearest, weights[subset], len(centers))[:, None]
        centers = np.where(weight_sums > 0, feature_sums / np.where(weight_sums > 0, weight_sums, 1), centers)
    used_clusters, labels = np.unique(_nearest_center(centers, features), return_inverse=True)
    return np.argsort(compact_order(centers[used_clusters] * _SORT_WEIGHTS, runs=(_SORT_RUN,)))[labels]


def _nearest_center(centers: np.ndarray, features: np.ndarray) -> np.ndarray:
    from scipy.spatial import cKDTree

    return cKDTree(centers).query(features)[1]


def _split_evenly(items: np.ndarray, points: np.ndarray, weights: np.ndarray, count: int) -> list[np.ndarray]:
    """Split items into at most ``count`` groups of about one weight, along the axes on which they extend most."""
    if count <= 1 or len(items) <= 1:
        return [items] if len(items) else []
    offsets = points[items] - points[items].mean(axis=0)
    _, axes = np.linalg.eigh(offsets.T @ offsets)
    permutation = items[np.argsort(offsets @ axes[:, -1], kind="stable")]
    cumulative_weights = np.cumsum(weights[permutation])
    split_index = np.searchsorted(cumulative_weights, cumulative_weights[-1] * (count // 2) / count) + 1
    split_index = min(split_index, len(permutation) - 1)
    first_half, second_half = (
        _split_evenly(permutation[:split_index], points, weights, count // 2),
        permutation[split_index:],
    )
    return first_half + _split_evenly(second_half, points, weights, count - count // 2)


def _cluster_members(labels: np.ndarray) -> list[np.ndarray]:
    """Items of each cluster; items of label −1 belong to none."""
    permutation = np.argsort(labels, kind="stable")[np.count_nonzero(labels < 0) :]
    return np.split(permutation, np.flatnonzero(np.diff(labels[permutation])) + 1) if len(permutation) else []


def _cluster_sums(labels: np.ndarray, values: np.ndarray, count: int = 0) -> np.ndarray:
    """Sums of values [item, n] over the items of each cluster, [cluster, n]."""
    return np.stack([np.bincount(labels, column, count) for column in values.T], axis=1)


def _normalized(vectors: np.ndarray) -> np.ndarray:
    """Vectors of length 1; vectors of length 0 stay 0."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors / np.where(length > 0, length, 1)


# ---------------------------------------------------------------------------------------------------- sides


def _repeat_on_sides(
    side_count: int, areas: np.ndarray, centers: np.ndarray, normals: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Areas, centers and normals of the patches of all sides."""
    side_normals = np.concatenate([normals, -normals][:side_count])
    return (
        np.tile(areas, side_count).astype(np.float32),
        np.tile(centers, (side_count, 1)).astype(np.float32),
        side_normals.astype(np.float32),
    )


def _patches_of_sides(labels: np.ndarray, side_count: int, count: int) -> np.ndarray:
    """Patch of each piece's front and back."""
    return np.stack([labels, labels + count if side_count == 2 else np.full_like(labels, -1)]).astype(np.int32)


def _patch_samples_of(
    front_samples: list[tuple[int, np.ndarray, int, float]], side_count: int, count: int
) -> PatchSamples:
    """Patch samples on all sides from the patch samples on the front: face, barycentrics, patch and weight of each."""
    faces, barycentrics, patches, weights = zip(*front_samples, strict=True) if front_samples else ([], [], [], [])
    front_count = len(front_samples)
    front_patches = np.array(patches, np.int32)
    return PatchSamples(
        np.tile(np.array(faces, np.int32), side_count),
        np.tile(np.array(barycentrics, np.float32).reshape(-1, 3), (side_count, 1)),
        np.repeat([False, True][:side_count], front_count),
        np.concatenate([front_patches, front_patches + np.int32(count)][:side_count]),
        np.tile(np.array(weights, np.float32), side_count),
    )
