"""Form factors between a body's patches and its own sites: found once, by rays in its frame, and kept on disk."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warpshadow.assets.cache import cache_path, remembered
from warpshadow.pipeline.bounces.patches import ScenePatches, Senders
from warpshadow.pipeline.groups import Group
from warpshadow.pipeline.own_shadows import OwnShadows
from warpshadow.stages.bounces.factors import patch_mesh, trace_factors
from warpshadow.stages.bounces.patches import Patches
from warpshadow.stages.sparse import SparseMatrix

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

VERSION = 1
"""Part of the key of cached form factors: raise it whenever they would come out differently."""

_RAYS = 512
"""Rays of a site."""


class OwnFactors:
    """Form factors of bodies for themselves, each body's found when it is first asked for.

    Args:
        own_shadows: Has the bodies' sites.
        patches: Has their patches.
        progress: Show progress where it takes longer than a second.
    """

    def __init__(self, own_shadows: OwnShadows, patches: ScenePatches, *, progress: bool = False):
        self._own_shadows, self._patches, self._progress = own_shadows, patches, progress
        self._of_body: dict[int, SparseMatrix] = {}
        self._between: dict[Senders, SparseMatrix] = {}

    def of(self, body: int) -> SparseMatrix:
        """What share of the hemisphere of each of a body's sites its own patches take."""
        if body not in self._of_body:
            assembly, sites = self._patches.assembly, self._own_shadows.sites(body)
            mesh, points, normals = assembly.scene.bodies[body].mesh, sites.positions, sites.normals
            if assembly.is_two_sided[body]:
                points, normals = np.tile(points, (2, 1)), np.concatenate([normals, -normals])
            vertices = sites.positions[: len(mesh.positions)]
            given = self._patches.of_body(body), vertices, mesh.surface.faces, points, normals
            found = own_factors(*given, device=assembly.device, progress=self._progress)
            self._of_body[body] = SparseMatrix.of(found, device=assembly.device)
        return self._of_body[body]

    def between_patches(self, senders: Senders, sources: Sequence[Group]) -> SparseMatrix:
        """What share of the hemisphere of each patch others of its body take, in the mean over its sources."""
        if senders not in self._between:
            from scipy.sparse import vstack

            of_sources = vstack([self._of_group(senders, group) for group in sources])
            between = senders.mean.on_host() @ of_sources
            self._between[senders] = SparseMatrix.of(between, device=senders.assembly.device)
        return self._between[senders]

    def _of_group(self, senders: Senders, group: Group) -> csr_matrix:
        """What share of the hemisphere of each source of a group the patches of its body take, of all patches."""
        from scipy.sparse import csr_matrix

        shape, body = (group.points.shape[1], len(senders.areas)), group.body
        if body not in senders.bodies or senders.assembly.is_flat[body]:
            return csr_matrix(shape, dtype=np.float32)
        assert body is not None and group.places is not None
        factors, (sites, weights) = self.of(body).on_host(), (each.numpy()[0] for each in group.places)
        starts = np.arange(0, sites.size + 1, 3)
        of_patches = csr_matrix((weights.ravel(), sites.ravel(), starts), (shape[0], factors.shape[0])) @ factors
        first = senders.first[senders.bodies.index(body)]
        return csr_matrix((of_patches.data, of_patches.indices + first, of_patches.indptr), shape)


def own_factors(
    patches: Patches,
    positions: np.ndarray,
    faces: np.ndarray,
    points: np.ndarray,
    normals: np.ndarray,
    *,
    device: wp.DeviceLike,
    progress: bool = False,
) -> csr_matrix:
    """What share of the hemisphere of each site of a body its own patches take: from the cache, or traced.

    Args:
        patches: Of the body.
        positions, faces: Its mesh, NumPy.
        points: Its sites, shape [site, 3].
        normals: Unit normals, shape [site, 3].
        device: Where rays are traced.
        progress: Show a progress bar where it takes longer than a second.

    Returns:
        As :func:`~warpshadow.stages.bounces.factors.trace_factors` does.
    """
    key = hashlib.sha256(json.dumps([VERSION, _RAYS, patches.count, len(points)]).encode())
    for array in (patches.pieces.positions(positions, faces), patches.of_pieces, points, normals):
        key.update(np.ascontiguousarray(array).tobytes())

    def read(stored: Mapping[str, np.ndarray]) -> csr_matrix:
        from scipy.sparse import csr_matrix

        found = csr_matrix((stored["data"], stored["indices"], stored["indptr"]), (len(points), patches.count))
        found.check_format(full_check=True)
        return found

    def trace() -> csr_matrix:
        mesh = patch_mesh(patches, positions, faces, device=device)
        given = patches.of_pieces, patches.count, points, normals
        return trace_factors(mesh, *given, rays=_RAYS, progress=progress)

    return remembered(
        cache_path("form_factors", key.hexdigest()),
        read,
        trace,
        lambda found: {name: getattr(found, name) for name in ("data", "indices", "indptr")},
        what="form factors",
    )
