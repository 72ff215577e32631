"""Proxies of the bodies that send light: planes for themselves, spheres for all others.

The spheres are placed in each call, where the patches are (:mod:`warpshadow.stages.bounces.proxies`).
"""

import functools
from typing import NamedTuple

import numpy as np
import warp as wp

from warpshadow.device.batch import concatenate
from warpshadow.device.constants import constant
from warpshadow.pipeline.bounces.cell_transmittance import CellTransmittance
from warpshadow.pipeline.bounces.patches import Senders
from warpshadow.pipeline.bounces.scene_overlays import find_overlays
from warpshadow.pipeline.shading.transfers import join_rows
from warpshadow.stages.bounces.projected_areas import find_projected_areas, tilt_normals_off_planes
from warpshadow.stages.bounces.proxies import find_depths, place_proxies
from warpshadow.stages.bounces.proxy_radiance import patches_of_clusters
from warpshadow.stages.bounces.tangent_planes import TangentPlanes, find_tangent_planes, find_tolerances
from warpshadow.stages.planes.fronts import NearestBlockers, find_fronts
from warpshadow.stages.receivers.receivers import Receivers
from warpshadow.stages.sparse import SparseMatrix, multiply
from warpshadow.stages.visibility.traversal import ClusterTree, find_clusters


class PlacedProxies(NamedTuple):
    """Proxy spheres of patches of bodies that are not flat, in the world."""

    projected_areas: (
        wp.array
    )  # part of its area that each shows towards each cell, [batch, patch, cell]; 0 on flat bodies
    centers: wp.array  # of the spheres, vec3 of shape [batch, patch + sphere of dark bodies]
    radii: wp.array  # likewise, 0 for patches of flat bodies
    clusters: ClusterTree
    tangent_planes: TangentPlanes


class Proxies:
    """Proxies of sending bodies: plane bodies for themselves, spheres for all others.

    Args:
        senders: The bodies.
        merging: As for the method of visibility.
    """

    def __init__(self, senders: Senders, merging: float):
        self.senders, self.merged_scene, self.merging = senders, senders.merged_scene, merging

    @functools.cached_property
    def black_bodies(self) -> list[int]:
        """Nonplanar bodies that send no light: their blocker spheres are their proxies."""
        return [body for body in self.merged_scene.nonplanar_bodies if body not in self.senders.bodies]

    @functools.cached_property
    def overlays(self) -> tuple[SparseMatrix, np.ndarray] | None:
        """Texels before the patches that flat bodies cover, and how far away they are; None without any."""
        overlays = find_overlays(self.senders, self._depths)
        if overlays is None:
            return None
        return SparseMatrix.from_matrix(overlays.before, device=self.merged_scene.device), overlays.distances

    def range_of(self, body: int) -> tuple[int, int]:
        """Where the proxies of a body begin and end."""
        first = self.senders.first
        if body in self.senders.bodies:
            sender_index = self.senders.bodies.index(body)
            return int(first[sender_index]), int(first[sender_index + 1])
        begin, end = self.merged_scene.sphere_ranges(self.black_bodies).get(body, (0, 0))
        return (int(first[-1]) + begin, int(first[-1]) + end) if end else (0, 0)

    @functools.cached_property
    def patches_of_clusters(self) -> tuple[np.ndarray, np.ndarray]:
        """The patches of each proxy, and of the clusters that they merge into: where they begin, and numbers."""
        count = int(self.merged_scene.sphere_counts[self.black_bodies].sum())
        numbers = np.arange(len(self.senders.areas))
        return patches_of_clusters(numbers, np.full(len(numbers) + count, -1), merging=self.merging)

    @functools.cached_property
    def seen_patches(self) -> tuple[np.ndarray, np.ndarray]:
        """Patches of each proxy and cluster as receivers see them: none of flat bodies, whose proxies nobody sees."""
        starts, patches = self.patches_of_clusters
        proxies = np.repeat(np.arange(len(starts) - 1), np.diff(starts))
        is_flat = self.merged_scene.is_flat[self.senders.body_of_patch[patches]]
        is_seen = np.bincount(proxies, ~is_flat, minlength=len(starts) - 1)[proxies] > 0
        counts = np.bincount(proxies[is_seen], minlength=len(starts) - 1)
        return np.cumsum([0, *counts]).astype(np.int32), patches[is_seen]

    @functools.cached_property
    def _mean_of_seen(self) -> SparseMatrix:
        """The matrix of means over patch samples, empty for patches that no proxy shows."""
        from scipy.sparse import diags

        is_seen = np.isin(np.arange(len(self.senders.areas)), self.seen_patches[1])
        matrix = diags(is_seen.astype(np.float32)) @ self.senders.mean.to_scipy()
        return SparseMatrix.from_matrix(matrix, device=self.merged_scene.device)

    @functools.cached_property
    def _blockers(self) -> tuple[np.ndarray, np.ndarray]:
        """For each patch, the nearest sphere of its body, −1 for none, and its proxy's radius relative to it."""
        rest, first_sphere, senders = self.merged_scene.rest, self.merged_scene.first_sphere, self.senders
        centers, radii = rest.centers.numpy()[0], rest.radii.numpy()[0]
        numbers, ratios = np.full(len(senders.areas), -1, np.int32), np.zeros(len(senders.areas), np.float32)
        start = 0
        for body in self.merged_scene.nonplanar_bodies:
            sphere_range = slice(*first_sphere[body : body + 2])
            if len(radii[sphere_range]) and body in senders.bodies:
                sender_index = senders.bodies.index(body)
                patches = senders.patches[sender_index]
                patch_range = slice(*senders.first[sender_index : sender_index + 2])
                nearest = patches.nearest_spheres(centers[sphere_range], radii[sphere_range])
                numbers[patch_range] = start + nearest
                ratios[patch_range] = np.sqrt(patches.areas / 2) / np.maximum(radii[sphere_range][nearest], 1e-30)
            start += len(radii[sphere_range])
        return numbers, ratios

    @functools.cached_property
    def _depths(self) -> np.ndarray:
        """How far below each patch its proxy is, in radii."""
        return np.concatenate([find_depths(item.centers, item.normals, item.areas) for item in self.senders.patches])

    @functools.cached_property
    def _tolerances(self) -> np.ndarray:
        """How bent the patches of each proxy and cluster are, from :func:`.tangent_planes.find_tolerances`."""
        return find_tolerances(self.senders.patches, *self.patches_of_clusters)

    @functools.cached_property
    def nearest_spheres(self) -> np.ndarray:
        """Sphere nearest to the patch of each patch sample, −1 for none: int32 of shape [patch sample]."""
        return self._blockers[0][self.senders.patch_of_sample]

    def place(
        self,
        patch_samples: Receivers,
        transmittances: list[CellTransmittance],
        spheres: tuple[wp.array, wp.array],
        frames: wp.array | None,
    ) -> PlacedProxies:
        """Place the proxies in the world, with the areas that receivers see of their patches.

        Args:
            patch_samples: Where they are lit.
            transmittances: Of the patch samples, in portions.
            spheres: Centers and radii of all spheres.
            frames: Where flat bodies are.
        """
        normals, planes, senders = patch_samples.normals, self.senders.planes, self.senders
        centers, radii = self.merged_scene.spheres_of(self.merged_scene.nonplanar_bodies, spheres)
        if planes is not None:
            numbers, points, device = self.nearest_spheres, patch_samples.points, normals.device
            nearest_blockers = NearestBlockers(centers, radii, constant(numbers, wp.int32, device))
            front_weights = find_fronts(points, normals, None, nearest_blockers, frames, planes.blockers).front_weights
            if self.overlays is not None:
                numbers = np.where(self.overlays[1][senders.patch_of_sample] > 0, np.int32(-1), numbers)
            normals = tilt_normals_off_planes(points, normals, radii, numbers, front_weights, frames, planes.blockers)
        directions, transmittance = transmittances[0].directions, _self_transmittance(transmittances)
        mean_points = multiply(senders.mean, patch_samples.points)
        mean_normals = multiply(senders.mean, patch_samples.normals)
        proxies = place_proxies(mean_points, mean_normals, radii, *self._blockers, self._depths)
        if self.black_bodies:
            others = self.merged_scene.spheres_of(self.black_bodies, spheres)
            counts = [len(senders.areas), others[1].shape[1]]
            proxies = tuple(concatenate(pair, counts) for pair in zip(proxies, others, strict=True))
        areas = find_projected_areas(normals, transmittance, self._mean_of_seen, directions)
        clusters = find_clusters(*proxies, self.merging)
        cluster_inputs = clusters.nodes.centers, *self.patches_of_clusters, self._tolerances
        tangent_planes = find_tangent_planes(mean_points, mean_normals, *cluster_inputs)
        return PlacedProxies(areas, *proxies, clusters, tangent_planes)


def _self_transmittance(transmittances: list[CellTransmittance]) -> wp.array | None:
    """Transmittance of patch samples past their own bodies, of all portions; None where that is 1."""
    if all(portion.transmittance_self is None for portion in transmittances):
        return None
    rows = [
        wp.full_like(portion.transmittance_nonplanar, 1.0, requires_grad=False)
        if portion.transmittance_self is None
        else portion.transmittance_self
        for portion in transmittances
    ]
    return join_rows(rows)
