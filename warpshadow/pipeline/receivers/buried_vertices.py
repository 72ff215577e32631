"""Buried vertices: corners of visible faces that lie inside another body, as below a box, or behind a plane.

They are dark, and pixels beside the other body would interpolate between them and vertices in the open: a dark line
along the toe of a wedge, at the foot of a wall on a ground, or of a ball that sinks into it. Such a line, one pixel
high with 0.58 of the light, is too little of a ground to count as uneven.
"""

from collections.abc import Sequence

import numpy as np
import warp as wp

from warpshadow.maths.plane import principal_axes
from warpshadow.pipeline.bodies.merged_scene import MergedScene
from warpshadow.stages.geometry.normals import vertex_normals
from warpshadow.stages.self_visibility.buried import find_buried

_ROUNDING = 1e-5  # of the largest coordinate, by which a vertex may lie outside the bounds of a body that it touches


def find_bodies_with_buried_vertices(
    merged_scene: MergedScene, positions: np.ndarray, face_ids: Sequence[np.ndarray], bodies: Sequence[int]
) -> np.ndarray:
    """Find bodies with a face in view from a buried vertex to one in the open, or through a plane.

    Args:
        merged_scene: All bodies.
        positions: Vertices of all [scene units], float32 of shape [vertex, 3].
        face_ids: Faces that each image shows.
        bodies: Bodies to look at.
    Returns:
        Bool of shape [body], of these bodies.
    """
    result, faces = np.zeros(len(bodies), bool), merged_scene.faces.numpy()
    visible_faces = np.unique(np.concatenate([*face_ids, np.empty(0, int)])).astype(int)
    margin = _ROUNDING * np.abs(positions).max(initial=0.0)
    starts = merged_scene.first_vertex
    body_positions = [positions[starts[number] : starts[number + 1]] for number in merged_scene.shadow_casters]
    bounds = [(vertices.min(axis=0) - margin, vertices.max(axis=0) + margin) for vertices in body_positions]
    is_plane = merged_scene.is_flat[merged_scene.shadow_casters]
    planes = [vertices for vertices, is_flat in zip(body_positions, is_plane, strict=True) if is_flat]
    mesh = normals = None
    for number, body in enumerate(bodies):
        corners = faces[visible_faces[merged_scene.body_of_face[visible_faces] == body]]
        if any(_crosses(positions[corners], points, margin) for points in planes):
            result[number] = True
            continue
        vertices = np.unique(corners)
        points, is_within = positions[vertices], np.zeros(len(vertices), bool)
        for caster, (low, high) in zip(merged_scene.shadow_casters, bounds, strict=True):
            if caster != body:
                is_within |= ((points >= low) & (points <= high)).all(axis=1)
        candidates = vertices[is_within]
        if len(candidates):
            if mesh is None or normals is None:
                on_device = wp.array(positions, dtype=wp.vec3, device=merged_scene.device)
                mesh = merged_scene.blocker_mesh(on_device)
                normals = vertex_normals(on_device.reshape((1, -1)), merged_scene.one_rings).numpy()[0]
            is_buried = np.zeros(len(positions), bool)
            is_buried[candidates] = find_buried(mesh, positions[candidates], normals[candidates])
            result[number] = (is_buried[corners].any(axis=1) & ~is_buried[corners].all(axis=1)).any()
    return result


def _crosses(corners: np.ndarray, plane_points: np.ndarray, margin: float) -> bool:
    """Whether a face [face, 3, 3] goes through the rectangle around points of a plane."""
    axes, middle = principal_axes(plane_points.astype(np.float64)), plane_points.mean(axis=0)
    local, (half_width, half_height, _) = (corners - middle) @ axes.T, np.abs((plane_points - middle) @ axes.T).max(0)
    heights = local[..., 2]
    is_cut = (heights.min(axis=1) < -margin) & (heights.max(axis=1) > margin)
    is_beside = (np.abs(local[..., :2]) <= (half_width, half_height)).all(axis=-1).any(axis=1)
    return bool((is_cut & is_beside).any())
