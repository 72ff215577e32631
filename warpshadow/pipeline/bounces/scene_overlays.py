"""Overlays of a scene: the patches right behind a plane, as a table's below its cloth, and its texels before them."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from warpshadow.pipeline.bounces.patches import Senders

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

_NEAR = 0.25  # how far behind a flat body covered patches lie, at most, in radii of their proxies
_FACING = 0.9  # cosine between their normals and its own, at least
_COVERED = 0.25  # part of its area behind which such patches lie, at least
_MIN_HIDDEN_SHARE = 0.5  # part of the area of a covered patch that it hides, at least
_REACH = 0.01  # how far bodies reach out before it that may see it, in units of its size


class Overlays(NamedTuple):
    """Texels before covered patches."""

    before: csr_matrix  # their weights, [patch, patch]
    distances: np.ndarray  # how far they are from the patches' proxies, 0 for patches that nothing covers, [patch]


def find_overlays(senders: Senders, depths: np.ndarray) -> Overlays | None:
    """Find the patches that flat bodies cover where the scene has them; None without any.

    Args:
        senders: All patches.
        depths: How far below its patch each proxy is, in radii, shape [patch].
    """
    from scipy.sparse import csr_matrix
    from scipy.spatial import cKDTree

    bodies, is_flat = senders.merged_scene.scene.bodies, senders.merged_scene.is_flat
    bodies_and_patches = [(bodies[number], item) for number, item in zip(senders.bodies, senders.patches, strict=True)]
    normals = np.concatenate([item.normals @ body.rotation_matrix().T for body, item in bodies_and_patches])
    centers = np.concatenate([body.to_world(item.centers) for body, item in bodies_and_patches])
    radii = np.sqrt(senders.areas / 2)
    is_nonplanar = ~is_flat[senders.body_of_patch]
    weights = np.zeros((0, 3))
    for number, first, end in zip(senders.bodies, senders.first[:-1], senders.first[1:], strict=True):
        texels = first + np.flatnonzero(senders.areas[first:end] > 0)
        for facing in np.unique(normals[texels].round(4), axis=0) if is_flat[number] else ():
            side = texels[normals[texels] @ facing > 0]
            points = centers[side]
            heights = (centers - points[0]) @ facing
            chosen = np.flatnonzero(
                is_nonplanar & (heights < 0) & (heights > -_NEAR * radii) & (normals @ facing > _FACING)
            )
            seeing = senders.body_of_patch[is_nonplanar & (heights > _REACH * np.linalg.norm(np.ptp(points, axis=0)))]
            chosen = chosen[[np.any(seeing != body) for body in senders.body_of_patch[chosen]]]
            if not len(chosen):
                continue
            gaps, nearest = cKDTree(centers[chosen]).query(points)
            is_before = gaps < 1.5 * radii[chosen][nearest]
            if senders.areas[side[is_before]].sum() < _COVERED * senders.areas[side].sum():
                continue
            rows, columns = chosen[nearest[is_before]], side[is_before]
            covered = np.bincount(rows, senders.areas[columns], len(radii)) > _MIN_HIDDEN_SHARE * senders.areas
            rows, columns = rows[covered[rows]], columns[covered[rows]]
            weights = np.concatenate([weights, np.stack([rows, columns, senders.areas[columns]], axis=1)])
    if not len(weights):
        return None
    rows, columns = weights[:, :2].astype(int).T
    totals = np.bincount(rows, weights[:, 2], len(radii))
    before = csr_matrix((weights[:, 2] / totals[rows], (rows, columns)), shape=(len(radii), len(radii)))
    proxies = centers - (depths * radii)[:, None] * normals
    gaps = np.linalg.norm(proxies - before @ proxies, axis=1)
    return Overlays(before, np.where(totals > 0, np.maximum(gaps, radii), 0).astype(np.float32))
