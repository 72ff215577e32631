"""How far light that is interpolated between the vertices of faces is off the light at their middles.

A face from a vertex in a crease, or inside another body, to one in the open is dark at one end, and one that a shadow's
edge crosses is gray, however short it is in the image. Where much of a body's light is on such faces, light at its
vertices does not tell the light on it.
"""

from collections.abc import Callable, Sequence
from typing import TypeAlias

import numpy as np
import warp as wp

from warpshadow.assets.camera import Camera
from warpshadow.assets.color import LUMINANCE
from warpshadow.assets.known_light import KnownLight
from warpshadow.maths.directions import fibonacci
from warpshadow.maths.inset import inset_vertices
from warpshadow.pipeline.bodies.merged_scene import MergedScene
from warpshadow.stages.geometry.normals import vertex_normals
from warpshadow.stages.rays.ray_tracing import trace_visibility_on_host

_CELLS = 128  # of directions; the default of "directional", which has them already
_RAYS = 64  # from a point, to cells by their light
_FACES = 256  # of a body that are looked at, at most
_DARK = 1e-3  # of the brightest middle of a face, up to which a body's light is no matter


EmitterLuminance: TypeAlias = Callable[[wp.array, wp.Mesh | None, np.ndarray, np.ndarray], np.ndarray]
"""Gives the luminance of light of emitters, given the vertices of all bodies, vec3 of shape [vertex], the mesh of all
that block, None for none, and points with unit normals, [point, 3]."""


def light_unevenness(
    merged_scene: MergedScene,
    positions: np.ndarray,
    images: Sequence[tuple[Camera, np.ndarray, np.ndarray]],
    bodies: Sequence[int],
    light: KnownLight,
    emitter_luminance: EmitterLuminance | None = None,
) -> np.ndarray:
    """Error of direct light on bodies that is interpolated between their vertices, over their pixels, relative L2.

    Args:
        merged_scene: All bodies.
        positions: Vertices of all [scene units], float32 of shape [vertex, 3].
        images: Of each its camera, the faces that it shows, and their pixels, [face]; some are looked at, the same
            each time.
        bodies: Bodies to look at.
        light: Their light from afar.
        emitter_luminance: That of emitters; None without any.
    Returns:
        Of each of these bodies, shape [body]; 0 where no image shows it.
    """
    device, result = merged_scene.device, np.zeros(len(bodies))
    eyes = np.concatenate([np.tile(camera.eye, (len(seen_faces), 1)) for camera, seen_faces, _ in images])
    seen_faces, counts = (np.concatenate([image[item] for image in images]) for item in (1, 2))
    rows_by_body = [np.flatnonzero(merged_scene.body_of_face[seen_faces] == body) for body in bodies]
    chosen = [rows[:: -(-len(rows) // _FACES)] if len(rows) else rows for rows in rows_by_body]
    rows = np.concatenate(chosen)
    if not len(rows) or not (merged_scene.shadow_casters or emitter_luminance):
        return result
    vertices = wp.array(positions, dtype=wp.vec3, device=device)
    mesh = merged_scene.blocker_mesh(vertices)
    normals = vertex_normals(vertices.reshape((1, -1)), merged_scene.one_rings).numpy()[0]
    faces = merged_scene.faces.numpy()
    origins, corners = inset_vertices(positions, faces), faces[seen_faces[rows]]
    points, point_normals = (_with_middles(values[corners]) for values in (origins, normals))
    is_behind = ((eyes[rows] - points[:, 3]) * point_normals[:, 3]).sum(axis=1) < 0
    is_behind &= merged_scene.is_two_sided[merged_scene.body_of_face[seen_faces[rows]]]
    lengths = np.linalg.norm(point_normals, axis=2, keepdims=True)
    point_normals *= np.where(is_behind, -1, 1)[:, None, None] / lengths.clip(1e-30)
    received = _irradiance(mesh, points, point_normals, light, device)
    if emitter_luminance is not None:
        receivers = points.reshape(-1, 3), point_normals.reshape(-1, 3)
        received += emitter_luminance(vertices, mesh, *receivers).reshape(received.shape)
    at_middles, errors = received[:, 3], received[:, :3].mean(axis=1) - received[:, 3]
    threshold, first = _DARK * at_middles.max(initial=0.0), 0
    for number, part in enumerate(chosen):
        items, weights = slice(first, first + len(part)), counts[part]
        power, first = (weights * at_middles[items] ** 2).sum(), first + len(part)
        if power > weights.sum() * threshold**2:
            result[number] = np.sqrt((weights * errors[items] ** 2).sum() / power)
    return result


def _with_middles(corners: np.ndarray) -> np.ndarray:
    """Values at the corners of faces, [face, 3, 3], and at their middles, [face, 4, 3]."""
    return np.concatenate([corners, corners.mean(axis=1, keepdims=True)], axis=1)


def _irradiance(
    mesh: wp.Mesh | None, points: np.ndarray, normals: np.ndarray, light: KnownLight, device: wp.Device
) -> np.ndarray:
    """Luminance of the light that reaches points, [face, point], of rays that are shared out by the light of cells."""
    cell_light = light.cells(fibonacci(_CELLS))
    power = np.cumsum(np.maximum(cell_light.radiance @ LUMINANCE, 0))
    chosen, counts = np.unique(np.searchsorted(power, power[-1] * (np.arange(_RAYS) + 0.5) / _RAYS), return_counts=True)
    directions = (cell_light.directions if cell_light.spots is None else cell_light.spots)[chosen]
    receivers = points.reshape(-1, 3), normals.reshape(-1, 3)
    visibility = trace_visibility_on_host(mesh, *receivers, directions, device)
    shaded = visibility.reshape(*points.shape[:2], -1) * np.maximum(normals @ directions.T, 0)
    result: np.ndarray = shaded @ (power[-1] / _RAYS * counts)
    return result
