"""Land: height fields, which are open meshes, whose rim is closed behind them, so that a solid stands in for them.

Spheres in a sheet bulge out of both sides. Where nobody sees one side, they may lie behind it, as deep as they like.
"""

from typing import NamedTuple
from weakref import WeakKeyDictionary, ref

import numpy as np
import warp as wp

from warpshadow.assets.mesh import Mesh
from warpshadow.assets.topology import welded
from warpshadow.maths.adjacency import area_normals, edges_of
from warpshadow.scene.body import Body, into_own_space
from warpshadow.stages.rays.ray_tracing import trace_visibility_on_host

DEPTH = 1 / 4
"""How far the solid reaches beyond the mesh, over the longest side of its bounds. Large spheres leave narrow
gaps: with 1/16 the land of demos/kinds.py is 4.1% off, and a bottle on it 5% too bright in place of 2%."""

_POINTS = 1024  # of meshes, from which rays tell which bodies lie before the field, and which behind

_MIN_RATIO_BEFORE = 0.1
"""Ratio of rays that meet a body before the field to rays that meet it behind: from here on it sticks in the field.

So do rocks and water in land; a ground that a tent stands on does not."""

_DEEP = 0.25
"""Depth of bowls, over the longest side of their bounds. A ball in half a shell (0.5) is 18% too bright past spheres of
the solid under an even sky, 2% too dark past panels; in a shell of 0.35 5% and 0%. Land of demos/kinds.py has 0.1."""

_MAX_SHARE_BEHIND = 0.3
"""Share of a body between panels and the bowl they stand for, above which panels would shade it: a slab that lies in a
basin is 24% too dark past panels, and 1% past spheres. A ball on the bottom of that basin has 0.51. A ball in the
smaller of two bowls of one mesh has 0.12, and is 50% too bright past spheres, which are as large as the other bowl."""

_UPWARD = 0.5  # cosine of the angle to +y up to which land leans


class Land(NamedTuple):
    """The solid that stands in for land."""

    solid: Mesh  # the land, with walls from its rim to a bottom behind it, in its own space
    seen_from: tuple[float, float, float]  # unit vector, in its own space, to the side on which bodies are
    is_bowl: bool  # whether panels are better blockers: it is deep, and no body stands between it and its panels


_SOLIDS: WeakKeyDictionary[Body, dict[tuple["ref[Body]", ...], Land | None]] = WeakKeyDictionary()
"""Of bodies among others: a scene asks several times of each open one."""


def solid_behind(body: Body, others: tuple[Body, ...]) -> Land | None:
    """Close a body that is land behind.

    Returns:
        The solid. None where it is no land: its mesh is closed or flat, faces look to both sides of any plane or lie
        above each other; others stand on both sides, as of a tent, or on none; or the side on which they stand does not
        look up, as under a roof, past which light comes.
    """
    if body.mesh.surface.is_closed or body.mesh.is_flat:
        return None
    known, key = _SOLIDS.setdefault(body, {}), tuple(map(ref, others))
    if key not in known:
        known[key] = _solid_behind(body, others)
    return known[key]


def _solid_behind(body: Body, others: tuple[Body, ...]) -> Land | None:
    """The solid behind an open, bent body, if it is land."""
    mesh, to_own = body.mesh, into_own_space(body)
    axis = _upward_axis(mesh, to_own["rotation"][:, 1])
    if axis is None or _count_overlaps(mesh, mesh, axis):
        return None
    meshes = [other.world_mesh().transformed(**to_own) for other in others]
    above, below = (np.array([_count_overlaps(mesh, other, side) for other in meshes]) for side in (axis, -axis))
    if not above.any() or (above < _MIN_RATIO_BEFORE * below).any():
        return None
    x, y, z = axis.tolist()
    is_deep = np.ptp(mesh.positions @ axis) > _DEEP * np.ptp(mesh.positions, axis=0).max()
    is_bowl = (
        bool(is_deep)
        and max(_share_behind_panels(mesh, axis, _spread_points(other)) for other in meshes) <= _MAX_SHARE_BEHIND
    )
    return Land(_close_height_field(mesh, axis), (x, y, z), is_bowl)


def _share_behind_panels(mesh: Mesh, axis: np.ndarray, points: np.ndarray) -> float:
    """Share of some points before a mesh, seen along an axis, that are behind its panels, which are chords of it."""
    is_behind = np.zeros(len(points), bool)
    for panel in mesh.convex_parts:
        corners = mesh.positions[panel.corners].astype(np.float64)
        middle, edge_vectors = corners.mean(axis=0), np.roll(corners, -1, axis=0) - corners
        spokes = corners - middle
        normal = np.cross(spokes, np.roll(spokes, -1, axis=0)).sum(axis=0)
        normal /= np.linalg.norm(normal)
        edge_distances = ((points[:, None] - corners) * np.cross(normal, edge_vectors)).sum(axis=-1)
        depths = -np.sign(normal @ axis) * ((points - middle) @ normal)
        radius = np.linalg.norm(spokes, axis=1).max()
        is_behind |= (edge_distances >= 0).all(axis=1) & (depths > 0) & (depths < radius)
    return float(is_behind.mean())


def _upward_axis(mesh: Mesh, up: np.ndarray) -> np.ndarray | None:
    """Mean normal of a mesh, turned to look up; None if it hardly does, or if some face looks against it."""
    corners = mesh.positions[mesh.surface.faces].astype(np.float64)
    normals = area_normals(corners)
    mean = normals.sum(axis=0)
    heights = normals @ mean
    if (heights < 0).any() or abs(mean @ up) <= _UPWARD * np.linalg.norm(mean):
        return None
    return np.sign(mean @ up) * mean / np.linalg.norm(mean)


def _count_overlaps(mesh: Mesh, other: Mesh, axis: np.ndarray) -> int:
    """How many rays from points of a mesh along an axis meet another one, and from there against it."""
    return _count_hits(mesh, other, axis) + _count_hits(other, mesh, -axis)


def _count_hits(mesh: Mesh, other: Mesh, axis: np.ndarray) -> int:
    """How many rays along an axis, from points of a mesh that are spread evenly, meet another one."""
    horizons = np.broadcast_to(axis, (_POINTS, 3))
    vertices = wp.array(other.positions, dtype=wp.vec3, device="cpu")
    blocker = wp.Mesh(vertices, wp.array(other.faces.ravel(), dtype=wp.int32, device="cpu"))
    visibility = trace_visibility_on_host(blocker, _spread_points(mesh), horizons, axis[None], "cpu")
    return int((~visibility).sum())


def _spread_points(mesh: Mesh) -> np.ndarray:
    """Points of a mesh that are spread evenly, [point, 3]."""
    corners = mesh.positions[mesh.surface.faces]
    areas = np.linalg.norm(area_normals(corners), axis=1).cumsum()
    chosen = np.searchsorted(areas, areas[-1] * (np.arange(_POINTS) + 0.5) / _POINTS)
    return corners[chosen].mean(axis=1)


def _close_height_field(mesh: Mesh, axis: np.ndarray) -> Mesh:
    """A height field that is seen from where an axis points, with walls and a bottom on the other side."""
    points, faces = welded(mesh.positions, mesh.surface.faces)
    normals = area_normals(points[faces])
    if normals.sum(axis=0) @ axis < 0:
        faces = faces[:, ::-1]
    heights = points.astype(np.float64) @ axis
    level = heights.min() - DEPTH * np.ptp(points, axis=0).max()
    bottom = points - np.outer(heights - level, axis)
    edges = edges_of(faces)
    places, codes = len(points), edges @ [len(points), 1]
    rim = edges[~np.isin(codes, edges @ [1, len(points)])]
    a, b = rim.T
    walls = np.concatenate([np.stack([b, a, places + a], axis=1), np.stack([b, places + a, places + b], axis=1)])
    closed = np.concatenate([faces, places + faces[:, ::-1], walls])
    return Mesh(np.concatenate([points, bottom]).astype(np.float32), closed, name=mesh.name)
