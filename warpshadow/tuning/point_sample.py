"""Points that a camera sees, at which the shading of a setting is compared with shading by rays through the meshes."""

import functools
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import warp as wp

from warpshadow.maths.spatial_sort import z_order_of_cells
from warpshadow.pipeline.renderer import SceneRenderer
from warpshadow.pipeline.views.view import View
from warpshadow.scene.scene import Bounces, Scene, change_bodies
from warpshadow.scene.visibility import AUTO, Visibility
from warpshadow.stages.geometry.normals import vertex_normals


class PointReceivers(NamedTuple):
    """Receivers from which the shading of points is interpolated."""

    points: np.ndarray  # positions [scene units], float32 of shape [receiver, 3]
    normals: np.ndarray  # unit normals, float32 of shape [receiver, 3]
    sides: np.ndarray  # faces that they lie on, after the last of which backs are numbered, of shape [receiver]
    barycentrics: np.ndarray  # and where on them, of shape [receiver, 3]
    corners: np.ndarray  # receivers of each point, of shape [point, 3]
    weights: np.ndarray  # weights of the corners, of shape [point, 3]


class PointSample:
    """A seeded sample of the points that the camera of a scene sees, each pixel as likely as any other.

    Each is drawn from a compact patch of the image, as many pixels as any other's, since errors concentrate along
    the edges of shadows, and each sample should have its share of them.

    Args:
        scene: The scene; its method is not looked at.
        count: Number of points; fewer where the camera sees fewer.
        direction_count: Rays of each point, drawn in proportion to light.
        bounces: How often light bounces in the reference, by default as in the scene.
        seed: Of the choice of points.
    Attributes:
        bodies: Body of each point, shape [point].
    Raises:
        ValueError: where the camera sees nothing, or no light falls on the visible surfaces.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        count: int = 1024,
        direction_count: int = 2048,
        bounces: Bounces | None = None,
        seed: int = 0,
        device: wp.DeviceLike = "cpu",
        progress: bool = False,
    ):
        self.device = wp.get_device(device)
        self._progress = progress
        self._direction_count = direction_count
        self._bounces = scene.bounces if bounces is None else bounces
        bare = replace(scene, visibility=Visibility(method="none"), supersampling=1, bounces=0)
        stage = SceneRenderer(bare, device=device)
        self._view = stage.view()
        face_ids = self._view.fragments.face_ids.numpy()[0]
        chosen_samples = _draw_spread_pixels(face_ids >= 0, count, seed)
        if not len(chosen_samples):
            raise ValueError("scene: the camera sees no body, expected one in the image")
        positions = stage.geometry().positions.numpy()[0]
        normals = vertex_normals(stage.geometry().positions, stage.merged_scene.one_rings).numpy()[0]
        # the backs of vertices are numbered after them
        self._positions, self._normals = np.tile(positions, (2, 1)), np.concatenate([normals, -normals])
        self._sides, self._vertices, self._weights = seen_on_faces(self._view, chosen_samples)
        self.bodies = stage.merged_scene.body_of_face[face_ids.ravel()[chosen_samples]]
        self._scene = scene
        self._chosen = [body.receivers for body in stage.scene.bodies]
        if not self.reference.any():
            raise ValueError("light: none falls on the surfaces that the camera sees, so nothing can be compared")

    @functools.cached_property
    def reference(self) -> np.ndarray:
        """Shading by rays, each point a receiver, of shape [point, 3]."""
        return self._trace("pixel")

    @functools.cached_property
    def interpolated_reference(self) -> np.ndarray:
        """Shading by rays at the corners of faces, interpolated, but of bodies that shine; of shape [point, 3]."""
        return self._trace("vertex")

    def _trace(self, receivers: str) -> np.ndarray:
        visibility = Visibility(method="ray-traced", samples=self._direction_count)
        changes = {k: "pixel" if body.is_glossy else receivers for k, body in enumerate(self._scene.bodies)}
        scene = change_bodies(self._scene, "receivers", changes)
        return self.shading(replace(scene, visibility=visibility, supersampling=1, bounces=self._bounces))

    def with_chosen_receivers(self, scene: Scene) -> Scene:
        """A variant of the scene with the receivers that a renderer of the whole image chooses for "auto"."""
        is_open = [body.receivers == AUTO for body in scene.bodies]
        return change_bodies(scene, "receivers", {k: self._chosen[k] for k in np.flatnonzero(is_open).tolist()})

    def shading(self, scene: Scene) -> np.ndarray:
        """Shade the points, as white surfaces, with the visibility, spheres and receivers of a variant of the scene.

        Returns:
            Linear RGB, float32 of shape [point, 3].
        """
        scene = self.with_chosen_receivers(scene)
        # it draws no image, so a renderer may prepare as little as possible
        glimpse = replace(scene.camera, width=1, height=1)
        renderer = SceneRenderer(scene, cameras=[glimpse], device=self.device, progress=self._progress)
        receivers = self.receivers([body.receivers for body in scene.bodies])
        sides = receivers.sides
        permutation = np.argsort(
            renderer.merged_scene.body_of_face[sides % renderer.merged_scene.first_face[-1]], kind="stable"
        )
        shading = np.empty((len(sides), 3), np.float32)
        view = renderer.on_faces(sides[permutation], receivers.barycentrics[permutation])
        shading[permutation] = renderer.shade(view=view).numpy()[0]
        return np.einsum("pk,pkc->pc", receivers.weights, shading[receivers.corners])

    def receivers(self, of_bodies: Sequence[str]) -> PointReceivers:
        """Find where light is evaluated, by the receivers of each body: at "vertex" its points are interpolated."""
        is_receiver = np.array([receivers != "vertex" for receivers in of_bodies])[self.bodies]
        receiver_rows, weights, corners = places_of_receivers(self._vertices, self._weights, is_receiver)
        points, normals = (
            np.einsum("pk,pkc->pc", weights, values[self._vertices[receiver_rows]])
            for values in (self._positions, self._normals)
        )
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        receiver_weights = np.where(is_receiver[:, None], np.array([1, 0, 0], np.float32), self._weights)
        return PointReceivers(points, normals, self._sides[receiver_rows], weights, corners, receiver_weights)

    def error(self, shading: np.ndarray) -> float:
        """Relative L2 error ‖B − B_mesh‖ / ‖B_mesh‖ of shading [point, 3] against rays."""
        return float(np.linalg.norm(shading - self.reference) / np.linalg.norm(self.reference))

    def interpolation_errors(self) -> np.ndarray:
        """Share of the error that interpolation between vertices adds, for each body, of shape [body]."""
        squares = ((self.interpolated_reference - self.reference) ** 2).sum(axis=1)
        sums = np.bincount(self.bodies, squares, minlength=len(self._scene.bodies))
        return np.sqrt(sums) / np.linalg.norm(self.reference)


def seen_on_faces(view: View, chosen_samples: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions on faces of samples of a view's first image, by their flat indices [point].

    Returns:
        Faces, after the last of which backs are numbered, [point]; their vertices, or the backs of these, numbered
        likewise, [point, 3]; and barycentric coordinates, [point, 3].
    """
    fragments, merged_scene = view.fragments, view.merged_scene
    face_ids = fragments.face_ids.numpy()[0].ravel()[chosen_samples]
    sides = face_ids if fragments.sides is None else fragments.sides.numpy()[0].ravel()[chosen_samples]
    vertices = merged_scene.faces.numpy()[face_ids] + merged_scene.first_vertex[-1] * (sides != face_ids)[:, None]
    return sides, vertices, fragments.barycentrics.numpy()[0].reshape(-1, 3)[chosen_samples]


def places_of_receivers(
    vertices: np.ndarray, barycentrics: np.ndarray, is_receiver: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Find the receivers of points of :func:`seen_on_faces`: the points themselves or vertices of their faces.

    Returns:
        A point on whose face each receiver lies, shape [receiver]; where on it, shape [receiver, 3]; and the receivers
        of each point, shape [point, 3].
    """
    themselves = np.flatnonzero(is_receiver)
    unique, vertex_places, corners = np.unique(vertices[~is_receiver], return_index=True, return_inverse=True)
    # a vertex lies on the face of a point of which it is a corner
    points = np.concatenate([np.flatnonzero(~is_receiver)[vertex_places // 3], themselves])
    weights = np.concatenate([np.eye(3, dtype=np.float32)[vertex_places % 3], barycentrics[themselves]])
    receivers = np.repeat(len(unique) + np.cumsum(is_receiver)[:, None] - 1, 3, axis=1)
    receivers[~is_receiver] = corners.reshape(-1, 3)
    return points, weights, receivers


def _draw_spread_pixels(mask: np.ndarray, count: int, seed: int) -> np.ndarray:
    """Draw pixels of a mask [height, width], one from each of as many patches along a Z-order curve: flat indices."""
    rows, columns = np.nonzero(mask)
    curve_order = z_order_of_cells(np.stack([columns, rows], axis=-1))
    count = min(count, len(curve_order))
    positions = (np.arange(count) + np.random.default_rng(seed).random(count)) * (len(curve_order) / max(count, 1))
    return np.ravel_multi_index((rows, columns), mask.shape)[curve_order[positions.astype(int)]]
