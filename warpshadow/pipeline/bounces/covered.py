"""Covered bodies: slabs right behind flat bodies, as a table below its cloth, which take the light of these.

Spheres and convex parts block a cell before flat bodies do. Where a slab lies right behind a flat body, receivers
before both see the slab's covered side, which is dark, in place of the flat body: pieces on a board of chess, a plane
over a slab, lose 5 to 10% of their light.
"""

import numpy as np

from warpshadow.maths.plane import plane_normal
from warpshadow.scene.scene import Scene

_NEAR = 0.05  # how far behind a flat body covered sides lie, at most, in units of its size
_FACING = 0.9  # cosine between their normals and its own, at least
_COVERED = 0.25  # their area in units of the flat body's, at least
_REACH = 0.01  # how far bodies reach out before it that may see it, in units of its size


def covered_bodies(scene: Scene) -> list[str]:
    """Say which bodies lie right behind flat bodies that others see; a sentence for each."""
    meshes = [body.world_mesh() for body in scene.bodies]
    corners = [mesh.positions.astype(np.float64)[mesh.surface.faces] for mesh in meshes]
    normals = [plane_normal(faces) if mesh.is_flat else None for mesh, faces in zip(meshes, corners, strict=True)]
    solids = [number for number, normal in enumerate(normals) if normal is None and len(corners[number])]
    remarks = []
    for flat, plane in enumerate(normals):
        for facing in () if plane is None else (plane, -plane):
            seeing = [k for k in solids if _highest(corners[k], corners[flat], facing) > _REACH]
            remarks += [
                f"body {solid} ({scene.bodies[solid].called!r}) lies right behind body {flat} "
                f"({scene.bodies[flat].called!r}), which is flat, and hides the light that this one reflects; "
                'ws.render and method = "ray-traced" have it, and one mesh of both has it, too'
                for solid in solids
                if seeing not in ([], [solid]) and _covered_part(corners[solid], corners[flat], facing) > _COVERED
            ]
    return remarks


def _highest(corners: np.ndarray, flat: np.ndarray, normal: np.ndarray) -> float:
    """How far faces [face, 3, 3] reach out before a flat body, in units of its size."""
    points = flat.reshape(-1, 3)
    return float((corners @ normal).max() - (points @ normal).mean()) / float(np.linalg.norm(np.ptp(points, axis=0)))


def _covered_part(corners: np.ndarray, flat: np.ndarray, normal: np.ndarray) -> float:
    """Area of the faces right behind a flat body that face it, in units of its rectangle's area."""
    points = flat.reshape(-1, 3)
    side = points[1] - points[0]
    axes = np.stack([side, np.cross(normal, side)]) / np.linalg.norm(side)
    low, high = (points @ axes.T).min(axis=0), (points @ axes.T).max(axis=0)
    areas = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2
    middles, sizes = corners.mean(axis=1), np.linalg.norm(areas, axis=1)
    depths = (points @ normal).mean() - middles @ normal
    is_covered = (depths > 0) & (depths < _NEAR * np.linalg.norm(np.ptp(points, axis=0)))
    is_covered &= ((middles @ axes.T > low) & (middles @ axes.T < high)).all(axis=1)
    return float(sizes[is_covered & (areas @ normal > _FACING * sizes)].sum() / np.prod(high - low))
