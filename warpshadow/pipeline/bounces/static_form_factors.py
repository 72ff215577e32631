"""Form factors between static patches, and from them to receivers: by rays, once for a geometry.

The form factors F of a point are scaled so that s + Σ F = 1, where s is the part of the hemisphere that spheres leave
open, by which direct light goes. Rays hit bodies in another part than 1 − s; unscaled, energy was lost and gained:
eighteen white balls in a white furnace were 0.91 to 1.06 bright.

Points inside another body count neither in means over patch samples nor as cache points: they see its inside. A patch
whose samples are all inside has the light of the nearest patch of its body, as a part between them may be seen.
"""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import warp as wp

from warpshadow.maths.inset import inset_vertices
from warpshadow.pipeline.bounces.patches import Senders
from warpshadow.stages.bounces.bright_patches import BrightPatches, find_bright_patches
from warpshadow.stages.bounces.form_factors import (
    BLACK_ENTRIES,
    PatchFormFactors,
    build_loose_tree,
    loose_mesh,
    mean_outside,
    scale_rows,
    scale_to_sky,
    scaling_factors,
    trace_form_factors,
)
from warpshadow.stages.bounces.irradiance_cache import choose_cache_points, interpolation_matrix
from warpshadow.stages.rays.ray_packets import FaceTree
from warpshadow.stages.receivers.receivers import Receivers
from warpshadow.stages.sparse import SparseMatrix, multiply

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

RAYS = 1024  # rays of a cache point or patch sample, which find its form factors …

STILL_RAYS = 256
"""… and for a still, which has no time to spare: of the table of demos/kinds.py (128²) it has an error of 1.95%
against paths with these, and of 1.93% with 1024, in 3.1 and 7.1 s of CPU time."""

_BRIGHT_PART = 4
"""Rays of a still for each one that it sends to bright patches besides. In a room lit by a bulb in a shade stills are
9.2% off without such rays, 3.0% with 32, 2.3% with 64 and 1.2% with 256."""


class StaticFormFactors(NamedTuple):
    """Form factors between the static patches of a geometry, and from them to receivers."""

    patch_sample_means: SparseMatrix  # [patch, patch sample], means over the patch samples that lie in no other body
    within_bodies: SparseMatrix  # [patch, patch] of the same body, means over the patch samples of the first
    between_bodies: SparseMatrix  # [patch, patch] of different ones, likewise
    to_cache_points: SparseMatrix  # [cache point, patch], those of each view after one another
    receiver_weights: SparseMatrix  # [receiver, cache point]
    openness: wp.array  # part of receivers' hemispheres that no blocker takes, by the same rays, vec3 [view, receiver]
    shape: tuple[int, int]  # views, receivers of each

    def to_receivers(self, direct: wp.array, bounced: wp.array) -> wp.array:
        """Add bounced light of cache points to direct shading, vec3 [batch, receiver]. Differentiable: both."""
        if self.shape[0] == 1:
            return multiply(self.receiver_weights, bounced, addend=direct)
        if len(bounced) > 1:
            raise ValueError(
                f"light, albedo, textures: got a batch of {len(bounced)} for {self.shape[0]} views by "
                'method "ray-traced" with bounces, expected one for them all; method = "directional" takes '
                "batches"
            )
        return multiply(self.receiver_weights, bounced, addend=direct.reshape((1, -1))).reshape(self.shape)


def find_form_factors(
    senders: Senders,
    positions: wp.array,
    patch_samples: Receivers,
    receivers: Receivers,
    sky_at_patch_samples: wp.array | None,
    sky_at_receivers: wp.array | None,
    light: wp.array | None,
    albedo: wp.array | None,
    *,
    is_still: bool,
    progress: bool,
) -> StaticFormFactors:
    """Find the form factors of a geometry.

    Args:
        senders: The bodies whose patches send light.
        positions: All vertices, vec3 of shape [1, vertex].
        patch_samples, receivers: Points to which light comes.
        sky_at_patch_samples, sky_at_receivers: s at these, vec3 of shape [view, point]; None for that of the rays.
        light: Direct light at patch samples, vec3 of shape [batch, patch sample], if more rays are to go to bright
            patches; else None.
        albedo: Of patches then, vec3 of shape [batch, patch].
        is_still: Whether rays are to be few.
    """
    from scipy.sparse import block_diag, vstack

    if len(positions) > 1:
        raise ValueError(
            f'geometry: got a batch of {len(positions)} for method "ray-traced" with bounces and free light, given '
            'reflectance or bodies of metal, expected one; method = "directional" takes batches'
        )
    mesh, patch_of_sides = _mesh(positions.numpy()[0], senders)
    rays, bright = STILL_RAYS if is_still else RAYS, None
    if light is not None and albedo is not None:
        bright = _bright_patches(light, albedo, mesh, patch_of_sides, senders, rays=rays // _BRIGHT_PART)
    rays_to_patches = _RaysToPatches(senders, mesh, build_loose_tree(mesh), patch_of_sides, bright, rays, progress)

    sky = None if sky_at_patch_samples is None else sky_at_patch_samples.numpy()[0, :, 0]
    sample_form_factors = rays_to_patches.trace(patch_samples.points.numpy()[0], patch_samples.normals.numpy()[0], sky)
    means, is_buried = senders.mean.to_scipy(), sample_form_factors.is_buried
    mean = mean_outside(means, is_buried)[senders.nearest_open_patches(means @ ~is_buried > 0)]
    within_bodies, between_bodies = _split_by_bodies(mean @ sample_form_factors.factors, senders.body_of_patch)

    points, normals = _ray_origins(receivers, positions, senders), receivers.normals.numpy()
    shape, device = points.shape[:2], positions.device
    skies = None if sky_at_receivers is None else np.broadcast_to(sky_at_receivers.numpy()[..., 0], shape)
    traced_views = map(rays_to_patches.trace_some, points, normals, [None] * shape[0] if skies is None else skies)
    receiver_weights, to_cache_points, openness = zip(*traced_views, strict=True)
    sparse = functools.partial(SparseMatrix.from_matrix, device=device)
    return StaticFormFactors(
        sparse(mean),
        sparse(within_bodies),
        sparse(between_bodies),
        sparse(vstack(to_cache_points)),
        sparse(block_diag(receiver_weights)),
        wp.array(np.repeat(np.stack(openness)[..., None], 3, axis=-1), dtype=wp.vec3, device=device),
        shape,
    )


class _RaysToPatches(NamedTuple):
    """Rays from points to the patches of a geometry."""

    senders: Senders
    mesh: wp.Mesh
    tree: FaceTree  # of its faces
    patch_of_sides: np.ndarray  # of the mesh's faces, int of shape [2, face]
    bright: BrightPatches | None  # to which more rays go
    rays: int  # of a point
    progress: bool

    def trace(self, points: np.ndarray, normals: np.ndarray, sky: np.ndarray | None) -> PatchFormFactors:
        """Trace the form factors of points, scaled to the sky that they see, s."""
        bodies, senders = self.senders.merged_scene.scene.bodies, self.senders
        count = len(senders.areas) + len(BLACK_ENTRIES)
        inputs = self.mesh, self.patch_of_sides, count, points, normals
        factors = trace_form_factors(
            *inputs, rays=self.rays, bright=self.bright, tree=self.tree, progress=self.progress
        )
        casts = np.array([body.casts_shadow for body in bodies])[senders.body_of_patch]
        return scale_to_sky(factors, np.append(casts, [True] * len(BLACK_ENTRIES)), sky)

    def trace_some(
        self, points: np.ndarray, normals: np.ndarray, sky: np.ndarray | None
    ) -> tuple[csr_matrix, csr_matrix, np.ndarray]:
        """Trace form factors of some receivers of a view, its cache points.

        Returns:
            Weights of cache points at receivers, [receiver, cache point]; form factors of cache points, [cache point,
            patch]; openness of receivers, shape [receiver].
        """
        cache_points = choose_cache_points(points)
        form_factors = self.trace(
            points[cache_points], normals[cache_points], None if sky is None else sky[cache_points]
        )
        is_cache_point = ~form_factors.is_buried | form_factors.is_buried.all()
        cache_points = cache_points[is_cache_point]
        means = interpolation_matrix(points, normals, cache_points)
        if sky is not None:
            means = scale_rows(means, scaling_factors(1 - sky, means @ (1 - sky[cache_points])))
        openness = 1 - means @ form_factors.blocked[is_cache_point]
        return means, form_factors.factors[is_cache_point], openness


def _split_by_bodies(factors: csr_matrix, body_of_patch: np.ndarray) -> list[csr_matrix]:
    """Split a matrix [patch, patch] into entries of patches of one body, and of two."""
    from scipy.sparse import coo_matrix

    entries = factors.tocoo()
    is_same_body = np.equal(*(body_of_patch[patches] for patches in entries.coords))
    return [
        coo_matrix((entries.data[is_chosen], (entries.row[is_chosen], entries.col[is_chosen])), entries.shape)
        for is_chosen in (is_same_body, ~is_same_body)
    ]


def _ray_origins(receivers: Receivers, positions: wp.array, senders: Senders) -> np.ndarray:
    """Points from which rays of receivers leave, [view, receiver, 3], inset at vertices (:mod:`.maths.inset`)."""
    points, vertices = receivers.points.numpy().copy(), positions.numpy()[0]
    if receivers.receiver_of_vertex is None:  # of points that are given
        return points
    receiver_of_side = receivers.receiver_of_vertex.numpy()
    sides = np.flatnonzero(receiver_of_side >= 0)
    origins = inset_vertices(vertices, senders.merged_scene.faces.numpy())
    points[:, receiver_of_side[sides]] = origins[sides % len(vertices)]
    return points


def _bright_patches(
    light: wp.array, albedo: wp.array, mesh: wp.Mesh, patch_of_sides: np.ndarray, senders: Senders, *, rays: int
) -> BrightPatches:
    """Patches that reflect much direct light, given light at patch samples, vec3 of shape [batch, patch sample]."""
    radiosity = albedo.numpy().mean(axis=0) * (senders.mean.to_scipy() @ light.numpy().mean(axis=0))
    radiosity = np.concatenate([radiosity, np.zeros((len(BLACK_ENTRIES), 3))])
    corners = mesh.points.numpy().reshape(-1, 3, 3).astype(np.float64)
    return find_bright_patches(radiosity, patch_of_sides, corners, rays=rays, device=mesh.device)


def _mesh(positions: np.ndarray, senders: Senders) -> tuple[wp.Mesh, np.ndarray]:
    """The mesh that rays meet, of the pieces of all bodies, and the patches of the sides of its faces.

    After all patches follow the entries BLACK_ENTRIES, for surfaces that send nothing.
    """
    merged_scene = senders.merged_scene
    corners, patches_of_sides, count = [], [], len(senders.areas)
    for number, body in enumerate(merged_scene.scene.bodies):
        body_positions = positions[merged_scene.first_vertex[number] : merged_scene.first_vertex[number + 1]]
        faces = body.mesh.surface.faces
        if number in senders.bodies:
            sender_index = senders.bodies.index(number)
            patches = senders.patches[sender_index]
            corners.append(patches.pieces.positions(body_positions, faces))
            patch_of_side = np.where(
                patches.patch_of_pieces < 0, -1, patches.patch_of_pieces + senders.first[sender_index]
            )
        else:
            corners.append(body_positions[faces])
            patch_of_side = np.full((2, len(faces)), -1)
        black_entry = np.array([0, 0 if merged_scene.is_two_sided[number] else 1])
        patches_of_sides.append(np.where(patch_of_side < 0, count + black_entry[:, None], patch_of_side))
    return loose_mesh(np.concatenate(corners), device=merged_scene.device), np.concatenate(patches_of_sides, axis=1)
