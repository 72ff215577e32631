"""How far openness that is interpolated between the vertices of faces is off the one at their middles.

A face from a vertex in a crease, or inside another body, to one in the open is dark at one end, however short it is in
the image. Where much of a body has such faces, light at its vertices does not tell the light on it.
"""

from collections.abc import Sequence

import numpy as np
import warp as wp

from warpshadow.maths.directions import fibonacci
from warpshadow.pipeline.merged_scene import MergedScene
from warpshadow.stages.normals import vertex_normals
from warpshadow.stages.ray_tracing import trace_visibility

_RAYS = 64  # of a point, half of them below its horizon
_FACES = 256  # of a body that are looked at, at most


def openness_errors(
    merged_scene: MergedScene,
    positions: np.ndarray,
    images: Sequence[tuple[np.ndarray, np.ndarray]],
    bodies: Sequence[int],
) -> np.ndarray:
    """Mean error of interpolated openness on bodies, over their pixels, relative.

    Args:
        merged_scene: All bodies.
        positions: Vertices of all [scene units], float32 of shape [vertex, 3].
        images: Of each the faces that it shows, and their pixels, [face]; some are looked at, the same each time.
        bodies: Bodies to look at.
    Returns:
        Of each of these bodies, shape [body]; 0 where no image shows it.
    """
    device, result = merged_scene.device, np.zeros(len(bodies))
    seen, counts = (np.concatenate(parts) for parts in zip(*images, strict=True))
    of_body = [np.flatnonzero(merged_scene.body_of_face[seen] == body) for body in bodies]
    chosen = [rows[:: -(-len(rows) // _FACES)] if len(rows) else rows for rows in of_body]
    if not merged_scene.casting or not any(map(len, chosen)):
        return result
    points = wp.array(positions, dtype=wp.vec3, device=device)
    mesh = merged_scene.casting_mesh(points)
    assert mesh is not None
    normals = vertex_normals(points.reshape((1, -1)), merged_scene.faces).numpy()[0]
    corners = merged_scene.faces.numpy()[seen[np.concatenate(chosen)]]
    vertices, place = np.unique(corners, return_inverse=True)
    middles = positions[corners].mean(axis=1), _unit(normals[corners].mean(axis=1))
    at = np.concatenate([positions[vertices], middles[0]]), np.concatenate([normals[vertices], middles[1]])
    openness = _openness(mesh, *at, device)
    of_vertices, of_middles = openness[: len(vertices)], openness[len(vertices) :]
    errors = np.abs(of_vertices[place.reshape(-1, 3)].mean(axis=1) - of_middles)
    ends = np.cumsum([0, *map(len, chosen)])
    for number, rows in enumerate(chosen):
        part, weights = slice(ends[number], ends[number + 1]), counts[rows]
        light = (weights * of_middles[part]).sum()
        if light > 0:
            result[number] = (weights * errors[part]).sum() / light
    return result


def _openness(mesh: wp.Mesh, points: np.ndarray, normals: np.ndarray, device: wp.Device) -> np.ndarray:
    """Part of an even sky's light that reaches points, shape [point]."""
    directions = fibonacci(_RAYS)
    at, facing = (wp.array(values[None], dtype=wp.vec3, device=device) for values in (points, normals))
    rays = wp.array(directions, dtype=wp.vec3, device=device)
    cosines = np.maximum(normals @ directions.T, 0)
    return (cosines * trace_visibility(mesh, at, facing, rays).numpy()[0]).sum(axis=1) / cosines.sum(axis=1).clip(1e-9)


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-30)
