"""Height fields, such as land: open meshes whose rim is closed behind them, so that a solid stands in for them.

Spheres in a sheet bulge out of both sides. Where nobody sees one side, they may lie behind it, as deep as they like.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence

import numpy as np
import warp as wp

from warpshadow.assets.mesh import Mesh
from warpshadow.assets.topology import welded
from warpshadow.stages.ray_tracing import trace_visibility

DEPTH = 1 / 16
"""How far the solid reaches beyond the mesh, over the longest side of its bounds.

The deeper it is, the fewer and larger are the spheres that fill it, and the coarser is its front."""

_POINTS = 1024  # of meshes, from which rays tell which bodies lie before the field, and which behind

_STUCK = 0.1
"""Rays that meet a body before the field, over those that meet it behind, from which it sticks in the field.

So do rocks and water in land; a ground that a tent stands on does not."""


def solid_behind(mesh: Mesh, others: Sequence[Mesh], *, device: wp.DeviceLike) -> Mesh | None:
    """Close a height field on the side that no other body is on.

    Args:
        mesh: The mesh.
        others: The other bodies, in the space of the mesh.
        device: Where rays are traced.

    Returns:
        The mesh with walls from its rim to a bottom behind it. None where it is no height field: it is closed or flat,
        faces look to both sides of any plane or lie above each other; and where bodies lie on both sides, as with a
        tent on a ground, or on none.
    """
    axis = _axis(mesh)
    if axis is None or _overlap(mesh, mesh, axis, device):
        return None
    above, below = (np.array([_overlap(mesh, other, side, device) for other in others]) for side in (axis, -axis))
    for front, back, side in ((above, below, axis), (below, above, -axis)):
        if front.any() and (front >= _STUCK * back).all():
            return _closed(mesh, tuple(side.tolist()))
    return None


def _axis(mesh: Mesh) -> np.ndarray | None:
    """Unit vector to which all faces of an open, bent mesh look: their mean normal; None if some do not."""
    if mesh.surface.is_closed or mesh.is_flat:
        return None
    corners = mesh.positions[mesh.surface.faces].astype(np.float64)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    mean = normals.sum(axis=0)
    heights = normals @ mean
    return None if (heights < 0).any() or not heights.any() else mean / np.linalg.norm(mean)


def _overlap(mesh: Mesh, other: Mesh, axis: np.ndarray, device: wp.DeviceLike) -> int:
    """How many rays from points of a mesh along an axis meet another one, and from there against it."""
    return _meet(mesh, other, axis, device) + _meet(other, mesh, -axis, device)


def _meet(mesh: Mesh, other: Mesh, axis: np.ndarray, device: wp.DeviceLike) -> int:
    """How many rays along an axis, from points of a mesh that are spread evenly, meet another one."""
    corners = mesh.positions[mesh.surface.faces]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).cumsum()
    chosen = np.searchsorted(areas, areas[-1] * (np.arange(_POINTS) + 0.5) / _POINTS)
    points = wp.array(corners[chosen].mean(axis=1)[None], dtype=wp.vec3, device=device)
    horizons = wp.array(np.broadcast_to(axis, (1, _POINTS, 3)), dtype=wp.vec3, device=device)
    vertices = wp.array(other.positions, dtype=wp.vec3, device=device)
    blocker = wp.Mesh(vertices, wp.array(other.faces.ravel(), dtype=wp.int32, device=device))
    ray = wp.array(axis[None], dtype=wp.vec3, device=device)
    return int((trace_visibility(blocker, points, horizons, ray).numpy() == 0).sum())


@functools.lru_cache(16)
def _closed(mesh: Mesh, front: tuple[float, float, float]) -> Mesh:
    """A height field that is seen from one side, with walls and a bottom on the other."""
    axis = np.array(front)
    points, faces = welded(mesh.positions, mesh.surface.faces)
    normals = np.cross(points[faces[:, 1]] - points[faces[:, 0]], points[faces[:, 2]] - points[faces[:, 0]])
    if normals.sum(axis=0) @ axis < 0:
        faces = faces[:, ::-1]
    heights = points.astype(np.float64) @ axis
    level = heights.min() - DEPTH * np.ptp(points, axis=0).max()
    bottom = points - np.outer(heights - level, axis)
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    places, codes = len(points), edges @ [len(points), 1]
    rim = edges[~np.isin(codes, edges @ [1, len(points)])]
    a, b = rim.T
    walls = np.concatenate([np.stack([b, a, places + a], axis=1), np.stack([b, places + a, places + b], axis=1)])
    closed = np.concatenate([faces, places + faces[:, ::-1], walls])
    return Mesh(np.concatenate([points, bottom]).astype(np.float32), closed, name=mesh.name)
