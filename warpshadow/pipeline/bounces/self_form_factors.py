"""Form factors between a body's patches and its own probes: found once, by rays in its frame, and cached on disk."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import warp as wp

from warpshadow.assets.cache import Unfinished, cache_path, load_or_compute
from warpshadow.pipeline.bodies.self_visibility import SelfVisibility
from warpshadow.pipeline.bounces.patches import ScenePatches, Senders
from warpshadow.pipeline.receivers.groups import Group
from warpshadow.stages.bounces.form_factors import patch_mesh, trace_form_factors
from warpshadow.stages.patches import Patches
from warpshadow.stages.receivers.body_spans import Span
from warpshadow.stages.sparse import SparseMatrix

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

VERSION = 3  # part of the key of cached form factors: raise it whenever they would come out differently
_RAYS = 512  # rays of a probe


class ProbeFormFactors(NamedTuple):
    """Form factors of the probes of bodies to their own patches."""

    matrix: SparseMatrix  # [probe, patch], of the bodies that send themselves light, and of all patches
    first_probes: dict[int, int]  # where the probes of each of these bodies begin

    def first_of(self, spans: Sequence[Span]) -> list[int]:
        """Where the probes of each span's body begin; −1 for none."""
        return [self.first_probes.get(span.body, -1) for span in spans]


class SelfFormFactors:
    """Form factors of bodies for themselves, each body's found when it is first asked for.

    Args:
        self_visibility: Has the bodies' probes.
        patches: Has their patches.
    """

    def __init__(self, self_visibility: SelfVisibility, patches: ScenePatches, *, progress: bool = False):
        self._self_visibility, self._patches, self._progress = self_visibility, patches, progress
        self._of_body: dict[int, csr_matrix] = {}
        self._of_senders: dict[Senders, ProbeFormFactors] = {}
        self._between: dict[Senders, SparseMatrix] = {}

    def of(self, body: int) -> csr_matrix:
        """Form factors of each of a body's probes to its own patches."""
        if body not in self._of_body:
            merged_scene, probes = self._patches.merged_scene, self._self_visibility.probes(body)
            mesh, points, normals = merged_scene.scene.bodies[body].mesh, probes.ray_origins, probes.normals
            if merged_scene.is_two_sided[body]:
                points, normals = np.tile(points, (2, 1)), np.concatenate([normals, -normals])
            vertices = probes.positions[: len(mesh.positions)]
            self._of_body[body] = self_form_factors(
                self._patches.of_body(body),
                vertices,
                mesh.surface.faces,
                points,
                normals,
                device=merged_scene.device,
                progress=self._progress,
            )
        return self._of_body[body]

    def of_senders(self, senders: Senders) -> ProbeFormFactors:
        """Form factors of senders for themselves; flat and convex ones, which send themselves nothing, are left out."""
        if senders not in self._of_senders:
            from scipy.sparse import csr_matrix, vstack

            patch_count, probe_count, first_probes = len(senders.areas), 0, {}
            rows = [csr_matrix((0, patch_count), dtype=np.float32)]
            for first, body in zip(senders.first.tolist(), senders.bodies, strict=False):
                if not senders.merged_scene.is_flat[body] and (factors := self.of(body)).nnz:
                    entries = factors.data, factors.indices + first, factors.indptr
                    rows.append(csr_matrix(entries, (factors.shape[0], patch_count)))
                    first_probes[body] = probe_count
                    probe_count += factors.shape[0]
            matrix = SparseMatrix.from_matrix(vstack(rows), device=senders.merged_scene.device)
            self._of_senders[senders] = ProbeFormFactors(matrix, first_probes)
        return self._of_senders[senders]

    def between_patches(self, senders: Senders, patch_samples: Sequence[Group]) -> SparseMatrix:
        """Form factors of each patch to other patches of its body, averaged over its patch samples."""
        if senders not in self._between:
            from scipy.sparse import vstack

            of_patch_samples = vstack([self._of_group(senders, group) for group in patch_samples])
            form_factors = senders.mean.to_scipy() @ of_patch_samples
            self._between[senders] = SparseMatrix.from_matrix(form_factors, device=senders.merged_scene.device)
        return self._between[senders]

    def _of_group(self, senders: Senders, group: Group) -> csr_matrix:
        """Form factors of each patch sample of a group to the patches of its body, among all patches."""
        from scipy.sparse import csr_matrix

        factors, spans = self.of_senders(senders), group.spans
        first_probes = np.repeat(factors.first_of(spans), [span.end - span.first for span in spans])
        if not (first_probes >= 0).any():
            return csr_matrix((group.points.shape[1], len(senders.areas)), dtype=np.float32)
        probes, weights = (item.numpy()[0] for item in group.probe_weights)
        sends = first_probes[:, None] >= 0
        entries = np.where(sends, weights, 0), np.where(sends, probes + first_probes[:, None], 0)
        starts, shape = np.arange(0, probes.size + 1, 3), (len(probes), factors.matrix.shape[0])
        return csr_matrix((*(item.ravel() for item in entries), starts), shape) @ factors.matrix.to_scipy()


def self_form_factors(
    patches: Patches,
    positions: np.ndarray,
    faces: np.ndarray,
    points: np.ndarray,
    normals: np.ndarray,
    *,
    device: wp.DeviceLike,
    progress: bool = False,
) -> csr_matrix:
    """Form factors of each probe of a body to its own patches: from the cache, or traced.

    Args:
        patches: Of the body.
        positions, faces: Its mesh, NumPy.
        points: Its probes, shape [probe, 3].
        normals: Unit normals, shape [probe, 3].
    Returns:
        As :func:`~warpshadow.stages.bounces.form_factors.trace_form_factors` does.
    """
    key = hashlib.sha256(json.dumps([VERSION, _RAYS, patches.count, len(points)]).encode())
    for array in (patches.pieces.positions(positions, faces), patches.patch_of_pieces, points, normals):
        key.update(np.ascontiguousarray(array).tobytes())

    def read(stored: Mapping[str, np.ndarray]) -> csr_matrix:
        from scipy.sparse import csr_matrix

        form_factors = csr_matrix((stored["data"], stored["indices"], stored["indptr"]), (len(points), patches.count))
        form_factors.check_format(full_check=True)
        return form_factors

    def trace(_: Unfinished) -> csr_matrix:
        mesh = patch_mesh(patches, positions, faces, device=device)
        numbers, count = patches.patch_of_pieces, patches.count
        return trace_form_factors(mesh, numbers, count, points, normals, rays=_RAYS, progress=progress)

    return load_or_compute(
        cache_path("form_factors", key.hexdigest()),
        read,
        trace,
        lambda form_factors: {name: getattr(form_factors, name) for name in ("data", "indices", "indptr")},
        noun="form factors",
    )
