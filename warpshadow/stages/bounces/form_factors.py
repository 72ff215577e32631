"""Form factors by rays: which share of a receiver's hemisphere each patch takes, weighted by the cosine."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import warp as wp

from warpshadow import check
from warpshadow.device.lanes import lane_type, module_options, vectors_type
from warpshadow.device.launch import launch
from warpshadow.device.memory import zeros
from warpshadow.maths.directions import check_count
from warpshadow.maths.spatial_sort import compact_order
from warpshadow.stages.bounces.bright_patches import BrightPatches, hit_weight, point_of_bright_side
from warpshadow.stages.patches import Patches
from warpshadow.stages.rays.ray_packets import PACKET, FaceTree, build_face_tree, make_find_first, packets_of
from warpshadow.stages.rays.ray_tracing import RAY_COST, first_hit, progress_slices

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

_Lane = lane_type(PACKET)

_MAX_HITS = 1 << 22  # sums of hits that are held at once [receivers × patches]

GOLDEN_TURN = (5**0.5 - 1) / 2  # turn from ray to ray, as a part of a full turn


BLACK_ENTRIES = ("black surfaces", "insides of closed bodies")
"""Entries for rays that meet surfaces which send nothing, told apart from the sky: after all patches."""

_BURIED_SHARE = 0.5
"""Part of its hemisphere from which a point that sees insides of closed bodies counts as inside one itself."""


@functools.cache
def _make_sum_hits() -> wp.Kernel:
    Vectors, find_first = vectors_type(PACKET), make_find_first()

    @wp.kernel(module="unique", module_options=module_options(PACKET), enable_backward=False)
    def sum_hits(
        first_row: int,
        worker: int,
        # in
        mesh: wp.uint64,
        tree: FaceTree,
        corners: wp.array(dtype=wp.vec3),
        patch_of_sides: wp.array2d(dtype=wp.int32),
        bright: BrightPatches,
        points: wp.array(dtype=wp.vec3),
        normals: wp.array(dtype=wp.vec3),
        lattice: wp.array2d(dtype=_Lane),
        first_receiver: int,
        # out
        hits: wp.array2d(dtype=wp.float32),
    ):
        """A thread owns a receiver, whose hits are zero before."""
        receiver = first_row + wp.tid()
        point = points[receiver]
        normal = normals[receiver]
        if wp.length_sq(normal) == 0.0:
            return
        sign = wp.where(normal[2] < 0.0, -1.0, 1.0)  # [Duff et al. 2017]
        duff_a = -1.0 / (sign + normal[2])
        duff_b = normal[0] * normal[1] * duff_a
        tangent = wp.vec3(1.0 + sign * normal[0] * normal[0] * duff_a, sign * duff_b, -sign * normal[0])
        bitangent = wp.vec3(duff_b, sign + normal[1] * normal[1] * duff_a, -normal[1])
        state = wp.rand_init(29, first_receiver + receiver)
        turn = 2.0 * wp.pi * wp.randf(state)
        u = wp.cos(turn) * tangent + wp.sin(turn) * bitangent
        v = wp.cos(turn) * bitangent - wp.sin(turn) * tangent
        ray_count = PACKET * lattice.shape[0]
        for packet in range(lattice.shape[0]):
            x = lattice[packet, 0]
            y = lattice[packet, 1]
            z = lattice[packet, 2]
            rays = Vectors(
                u[0] * x + v[0] * y + normal[0] * z,
                u[1] * x + v[1] * y + normal[1] * z,
                u[2] * x + v[2] * y + normal[2] * z,
            )
            first_hits = find_first(tree, point, normal, rays)
            for lane in range(PACKET):
                if first_hits[lane] >= 0:
                    face = tree.face_ids[first_hits[lane] // 2]
                    patch = patch_of_sides[first_hits[lane] % 2, face]
                    if patch >= 0:
                        hits[receiver, patch] += hit_weight(
                            bright,
                            patch,
                            corners,
                            face,
                            point,
                            normal,
                            wp.vec3(rays.x[lane], rays.y[lane], rays.z[lane]),
                            ray_count,
                        )
        for ray in range(bright.ray_count):
            choice = (float(ray) + wp.randf(state)) / float(bright.ray_count)
            side, target = point_of_bright_side(bright, corners, choice, wp.randf(state), wp.randf(state))
            ray_direction = wp.normalize(target - point)
            if wp.dot(normal, ray_direction) > 0.0:
                hit = first_hit(mesh, point, normal, ray_direction)
                if hit.face >= 0 and side == hit.face + wp.where(hit.is_back, patch_of_sides.shape[1], 0):
                    patch = patch_of_sides[wp.where(hit.is_back, 1, 0), hit.face]
                    hits[receiver, patch] += hit_weight(
                        bright, patch, corners, hit.face, point, normal, ray_direction, ray_count
                    )

    return sum_hits


@functools.cache
def _lattice(ray_count: int) -> np.ndarray:
    """A Fibonacci lattice on the disc below the hemisphere: so directions are as dense as their cosine is large.

    Returns:
        Unit vectors around +z, each run of 16 compact, of shape [ray, 3].
    """
    radius2 = (np.arange(ray_count) + 0.5) / ray_count
    angle = 2 * np.pi * GOLDEN_TURN * np.arange(ray_count)
    directions = np.stack([*(np.sqrt(radius2) * (np.cos(angle), np.sin(angle))), np.sqrt(1 - radius2)], axis=1)
    return directions[compact_order(directions)]


def patch_mesh(patches: Patches, positions: np.ndarray, faces: np.ndarray, *, device: wp.DeviceLike) -> wp.Mesh:
    """Make a mesh for rays, with a face for each piece of a body.

    Args:
        positions, faces: The mesh that they are pieces of, NumPy.
    """
    return loose_mesh(patches.pieces.positions(positions, faces), device=device)


def loose_mesh(corners: np.ndarray, *, device: wp.DeviceLike) -> wp.Mesh:
    """Make a mesh of triangles that share no vertices, given their corners [face, 3, 3]."""
    points = wp.array(corners.reshape(-1, 3), dtype=wp.vec3, device=device)
    return wp.Mesh(points, wp.array(np.arange(points.size), dtype=wp.int32, device=device))


def build_loose_tree(mesh: wp.Mesh) -> FaceTree:
    """Build the hierarchy of the faces of a mesh, by which packets of rays miss it at once."""
    corners = mesh.points.numpy()[mesh.indices.numpy()]
    return build_face_tree(corners, np.arange(len(corners)).reshape(-1, 3), mesh.device)


def trace_form_factors(
    mesh: wp.Mesh,
    patch_of_sides: np.ndarray,
    count: int,
    points: np.ndarray,
    normals: np.ndarray,
    *,
    rays: int = 512,
    bright: BrightPatches | None = None,
    tree: FaceTree | None = None,
    progress: bool = False,
) -> csr_matrix:
    """Trace which patches receivers see.

        F_xp = 1/π ∫ [x sees p towards ω] max(n·ω, 0) dω

    so that Σ_p F_xp B_p is the light that x, if white, reflects of the radiosity B of patches. Rays are as dense as the
    cosine, on a lattice that is turned at random for each receiver: F has a standard error below √(F (1 − F) / rays).

    Args:
        mesh: The mesh for rays; :func:`patch_mesh` makes it of a body.
        patch_of_sides: Patch of the front and the back of each of its faces, −1 for black, shape [2, face].
        points: Receivers, which may lie on the mesh, shape [receiver, 3].
        normals: Unit normals, shape [receiver, 3]. Where one is zero nothing is seen.
        rays: Rays of each receiver in all directions, a multiple of 16.
        bright: Patches of the mesh that more rays are sent to; None for none.
        tree: Hierarchy of its faces, of :func:`build_loose_tree`; None for one that is built for this call.
    Returns:
        F, float32 of shape [receiver, patch].
    Differentiable: no.
    """
    from scipy.sparse import csr_matrix, vstack

    check.shape("patch_of_sides", patch_of_sides.shape, (2, "face"))
    check.shape("points", points.shape, ("receiver", 3))
    check.shape("normals", normals.shape, points.shape)
    check_count("rays", rays)
    device = mesh.device
    patch_array = wp.array(patch_of_sides, dtype=wp.int32, device=device)
    bright = BrightPatches() if bright is None else bright
    ray_count = rays + bright.ray_count
    tree = build_loose_tree(mesh) if tree is None else tree
    lattice = wp.array(packets_of(_lattice(rays)), dtype=_Lane, device=device)
    factors = []
    for receivers in progress_slices(len(points), _MAX_HITS // max(count, 1), progress):
        hits = zeros((receivers.stop - receivers.start, count), dtype=wp.float32, device=device)
        receiver_arrays = [wp.array(values[receivers], dtype=wp.vec3, device=device) for values in (points, normals)]
        inputs = [mesh.id, tree, mesh.points, patch_array, bright, *receiver_arrays, lattice, receivers.start]
        launch(_make_sum_hits(), len(receiver_arrays[0]), inputs=inputs, outputs=[hits], cost=RAY_COST * ray_count)
        factors.append(csr_matrix(hits.numpy()))
    if not factors:
        return csr_matrix((0, count), dtype=np.float32)
    return (vstack(factors, format="csr") / rays).astype(np.float32)


# ---------------------------------------------------------------------------------------------------- with direct light


class PatchFormFactors(NamedTuple):
    """Form factors of points to patches."""

    factors: csr_matrix  # [point, patch]
    blocked: np.ndarray  # part of the hemisphere that blockers take, those that send nothing, too, shape [point]
    is_buried: np.ndarray  # whether they lie inside another body, bool of shape [point]


def scale_to_sky(factors: csr_matrix, is_blocker: np.ndarray, sky: np.ndarray | None) -> PatchFormFactors:
    """Scale form factors so that they and the sky of direct light fill the hemisphere: by (1 − s) / f.

    Args:
        factors: f by rays, of patches and of BLACK_ENTRIES, shape [point, patch + 2].
        is_blocker: Which of these cast shadows, bool of shape [patch + 2]; the others take nothing of the sky.
        sky: s, part of the hemisphere that is open where direct light is found, shape [point]; None for rays, too.
    """
    from scipy.sparse import diags

    is_buried = factors[:, [-1]].toarray().ravel() > _BURIED_SHARE
    blocker_factors = factors @ diags(is_blocker.astype(np.float32))
    blocked = np.asarray(blocker_factors.sum(axis=1)).ravel()
    if sky is not None:
        scaling = scaling_factors(1 - sky, blocked)
        factors, blocked = (factors + scale_rows(blocker_factors, scaling - 1)).tocsr(), scaling * blocked
    return PatchFormFactors(factors[:, : -len(BLACK_ENTRIES)], blocked, is_buried)


def scaling_factors(target: np.ndarray, current_values: np.ndarray) -> np.ndarray:
    """Factors that scale current values to targets: 0 for negative targets, 1 where the value is 0."""
    return np.where(current_values > 0, np.maximum(target, 0) / np.where(current_values > 0, current_values, 1), 1)


def scale_rows(matrix: csr_matrix, factors: np.ndarray) -> csr_matrix:
    """Scale the rows of a matrix."""
    from scipy.sparse import diags

    return (diags(factors) @ matrix).tocsr()


def mean_outside(means: csr_matrix, is_buried: np.ndarray) -> csr_matrix:
    """Means over the items of each row that are not buried, [row, item]; over all items of a row that is all buried."""
    open_means = scale_rows(means.T, (~is_buried).astype(np.float32)).T.tocsr()
    target, open_sums = (np.asarray(item.sum(axis=1)).ravel() for item in (means, open_means))
    return scale_rows(open_means, scaling_factors(target, open_sums)) + scale_rows(
        means, (open_sums == 0).astype(np.float32)
    )
