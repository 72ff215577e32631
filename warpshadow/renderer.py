"""The pipeline: from a scene to an image, each stage computed once while what it depends on stands still."""

import functools
import warnings
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from warpshadow import sh, shading
from warpshadow.basis import Basis, CellBasis, HarmonicBasis
from warpshadow.blockers import Blockers, scene_blockers
from warpshadow.camera import to_clip
from warpshadow.directions import fibonacci
from warpshadow.light import EnvironmentMap
from warpshadow.mesh import vertex_normals
from warpshadow.raster import Fragments, interpolate, rasterize
from warpshadow.reference import sample_map, trace_shading, trace_transfer
from warpshadow.scene import Scene
from warpshadow.visibility import directional, exponential, log_sh

COARSE_FACE = 400
"""Pixels of an average face beyond which shading at its corners draws a warning."""


class Geometry(NamedTuple):
    """All bodies in world space as one mesh."""

    positions: wp.array  # [1, vertex] vec3
    normals: wp.array  # [1, vertex] vec3
    faces: wp.array  # [face] vec3i
    uvs: wp.array  # [1, uv] vec2
    uv_faces: wp.array  # [face] vec3i
    body_of_face: np.ndarray  # [face]
    first_vertex: np.ndarray  # [body + 1]


class Receivers(NamedTuple):
    """The points at which light is evaluated, and how the pixels get theirs from them."""

    points: wp.array  # [1, receiver] vec3
    normals: wp.array  # [1, receiver] vec3
    faces: wp.array  # [face + pixel] vec3i, indices of receivers
    fragments: Fragments  # pixels of their own see face number face_count + i, whose corners are all receiver i


class Renderer:
    """A scene whose geometry and camera stand still, so that an image costs a dot product and a gather.

    Args:
        scene: The scene.
        device: Warp device, "cpu" by default.
        basis: What free light is expressed in (:attr:`transfer`); None for what the method computes in: cells of
            directions ("directional") or spherical harmonics.
        progress: Show progress where something takes longer than a second.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        device: wp.DeviceLike = "cpu",
        basis: Basis | None = None,
        progress: bool = False,
    ):
        self.scene = scene
        self.device = wp.get_device(device)
        self.progress = progress
        visibility = scene.visibility
        is_cellular = visibility.method == "directional"
        self._own_basis = (
            CellBasis(fibonacci(visibility.directions)) if is_cellular else HarmonicBasis(visibility.order)
        )
        self.basis = self._own_basis if basis is None else basis

    # ------------------------------------------------------------------------------------------ what stands still

    @functools.cached_property
    def geometry(self) -> Geometry:
        """Bodies in world space."""
        meshes = [body.world_mesh() for body in self.scene.bodies]
        first_vertex = np.cumsum([0] + [mesh.vertex_count for mesh in meshes])
        uvs = [np.zeros((1, 2), np.float32) if mesh.uvs is None else mesh.uvs for mesh in meshes]
        uv_faces = [np.zeros_like(mesh.faces) if mesh.uvs is None else mesh.uv_faces for mesh in meshes]
        first_uv = np.cumsum([0] + [len(uv) for uv in uvs])
        positions = self._array(np.concatenate([mesh.positions for mesh in meshes])[None], wp.vec3)
        faces = self._array(
            np.concatenate([mesh.faces + first for mesh, first in zip(meshes, first_vertex, strict=False)]),
            wp.vec3i,
        )
        return Geometry(
            positions,
            vertex_normals(positions, faces),
            faces,
            self._array(np.concatenate(uvs)[None], wp.vec2),
            self._array(np.concatenate([uv + first for uv, first in zip(uv_faces, first_uv, strict=False)]), wp.vec3i),
            np.repeat(np.arange(len(meshes)), [mesh.face_count for mesh in meshes]),
            first_vertex,
        )

    @functools.cached_property
    def fragments(self) -> Fragments:
        """What each sample of the image sees."""
        camera = self.scene.camera.resized(self.scene.supersampling)
        clip_matrices = self._array(camera.clip_matrix()[None], wp.mat44)
        clip_positions = to_clip(self.geometry.positions, clip_matrices)
        return rasterize(clip_positions, self.geometry.faces, camera.width, camera.height)

    @functools.cached_property
    def body_ids(self) -> np.ndarray:
        """Body that each sample of the image sees, -1 for none, shape [height, width]."""
        face_ids = self.fragments.face_ids.numpy()[0]
        return np.where(face_ids >= 0, self.geometry.body_of_face[face_ids], -1)

    @functools.cached_property
    def receivers(self) -> Receivers:
        """Vertices, and for bodies that want it (all where rays are traced) the points that the samples see."""
        geometry, fragments = self.geometry, self.fragments
        is_traced = self.scene.visibility.method == "ray-traced"
        wants_pixels = np.array([is_traced or body.receivers == "pixel" for body in self.scene.bodies])
        self._warn_of_coarse_faces(~wants_pixels)
        if not wants_pixels.any():
            return Receivers(geometry.positions, geometry.normals, geometry.faces, fragments)
        keeps_vertices = np.repeat(~wants_pixels, np.diff(geometry.first_vertex))
        shows_pixel = (self.body_ids >= 0) & wants_pixels[self.body_ids]

        def points_of(attribute: wp.array) -> np.ndarray:
            at_pixels = interpolate(fragments, geometry.faces, attribute).numpy()[0, shows_pixel]
            return np.concatenate([attribute.numpy()[0, keeps_vertices], at_pixels])

        points, normals = points_of(geometry.positions), points_of(geometry.normals)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
        receiver_of_vertex = np.maximum(np.cumsum(keeps_vertices) - 1, 0)
        own = np.arange(keeps_vertices.sum(), len(points))
        faces = np.concatenate([receiver_of_vertex[geometry.faces.numpy()], np.repeat(own[:, None], 3, axis=1)])
        face_ids = fragments.face_ids.numpy().copy()
        face_ids[0, shows_pixel] = len(geometry.body_of_face) + np.arange(len(own))
        weights = fragments.barycentrics.numpy().copy()
        weights[0, shows_pixel] = (1, 0, 0)
        return Receivers(
            self._array(points[None], wp.vec3),
            self._array(normals[None], wp.vec3),
            self._array(faces, wp.vec3i),
            Fragments(self._array(face_ids, wp.int32), self._array(weights, wp.vec3)),
        )

    def _warn_of_coarse_faces(self, is_vertex_lit: np.ndarray) -> None:
        """Say which bodies show faces so large that light at their corners alone misses shadows."""
        face_ids = self.fragments.face_ids.numpy()[0]
        shown = np.unique(face_ids[face_ids >= 0])
        face_counts = np.bincount(self.geometry.body_of_face[shown], minlength=len(is_vertex_lit))
        pixel_counts = np.bincount(self.body_ids[self.body_ids >= 0], minlength=len(is_vertex_lit))
        pixels_per_face = pixel_counts / np.maximum(face_counts, 1) / self.scene.supersampling**2
        for number in np.flatnonzero(is_vertex_lit & (pixels_per_face > COARSE_FACE)):
            warnings.warn(
                f"body number {number + 1} ({self.scene.bodies[number].mesh.name!r}): a face covers "
                f"{pixels_per_face[number]:.0f} pixels on average, and light is evaluated at its corners alone; "
                'receivers = "pixel" evaluates it at every pixel',
                stacklevel=2,
            )

    @functools.cached_property
    def blockers(self) -> Blockers:
        """The spheres of all bodies."""
        return scene_blockers(self.scene, device=self.device, progress=self.progress)

    @functools.cached_property
    def transfer(self) -> wp.array:
        """Transfer vectors of the receivers to :attr:`basis`, float32 of shape [1, receiver, coefficient]."""
        if self.scene.visibility.method == "ray-traced":
            points, normals, *_ = self.receivers
            count = self.scene.visibility.samples
            traced = trace_transfer(
                self._ray_mesh, points.flatten(), normals.flatten(), self.basis, count, progress=self.progress
            )
            return traced.reshape((1, *traced.shape))
        return self._to_basis(self._own_transfer())

    def _own_transfer(self) -> wp.array:
        """Transfer vectors to what the method computes in."""
        if isinstance(self._own_basis, CellBasis):
            return self._cell_transfer(self._own_basis.directions)
        return self._harmonic_transfer()

    def _cell_transfer(self, directions: np.ndarray) -> wp.array:
        points, normals, *_ = self.receivers
        if not self.blockers.radii.size:
            seen = wp.full((*points.shape, len(directions)), 1.0, dtype=wp.float32, device=self.device)
            return shading.directional_transfer(seen, normals, directions)
        softness = self.scene.visibility.softness
        seen = directional.transmittance(points, normals, *self.blockers, directions, softness=softness)
        return shading.directional_transfer(seen, normals, directions)

    def _harmonic_transfer(self) -> wp.array:
        points, normals, *_ = self.receivers
        visibility = self.scene.visibility
        seen = None
        if visibility.method == "log-sh" and self.blockers.radii.size:
            log = log_sh.accumulate(points, normals, *self.blockers, order=visibility.order, log=visibility.log)
            seen = exponential.exponentiate(log, base=visibility.base)
        return shading.sh_transfer(seen, normals, order=visibility.order)

    def _to_basis(self, transfer: wp.array) -> wp.array:
        """Take transfer vectors from what the method computes in to what the light is expressed in."""
        if self.basis == self._own_basis:
            return transfer
        if isinstance(self._own_basis, CellBasis) and not isinstance(self.basis, CellBasis):
            matrix = self.basis.functions(self._own_basis.directions)
        else:  # to cells: the mean of the harmonics over a cell, or how cells overlap, from many directions
            fine = fibonacci(64 * max(self.basis.size, self._own_basis.size))
            own, cells = self._own_basis.functions(fine), self.basis.functions(fine)
            is_cellular = isinstance(self._own_basis, CellBasis)
            weights = 1 / own.sum(axis=0)[:, None] if is_cellular else 4 * np.pi / len(fine)
            matrix = weights * (own.T @ cells)
        return self._array(transfer.numpy() @ matrix.astype(np.float32), wp.float32)

    @functools.cached_property
    def _ray_mesh(self) -> wp.Mesh:
        geometry = self.geometry
        return wp.Mesh(points=geometry.positions[0].contiguous(), indices=geometry.faces.view(wp.int32).flatten())

    def pixels_of(self, number: int) -> wp.array:
        """Flat indices of the samples that show a body, int32."""
        return self._array(np.flatnonzero(self.body_ids.ravel() == number).astype(np.int32), wp.int32)

    @functools.cached_property
    def uvs(self) -> wp.array:
        """Texture coordinates of the samples, vec2 of shape [1, height, width]."""
        return interpolate(self.fragments, self.geometry.uv_faces, self.geometry.uvs)

    @functools.cached_property
    def scene_shading(self) -> wp.array:
        """The receivers in the scene's light, each as a white surface: vec3 of shape [1, receiver]."""
        return self.shade(self.scene.light)

    def shade(self, light: EnvironmentMap | np.ndarray) -> wp.array:
        """Light the receivers, each as a white surface, as accurately as the method can for known light.

        Args:
            light: Environment map or SH coefficients [order², 3].

        Returns:
            Shading, vec3 of shape [1, receiver].
        """
        method = self.scene.visibility.method
        if method == "ray-traced":
            return self._trace(light)
        if isinstance(self._own_basis, CellBasis) and isinstance(light, EnvironmentMap):
            # a cell looks to where its light comes from: a sun is rarely in the middle
            coefficients, aims, _ = light.cells(self._own_basis.directions)
            transfer = self._cell_transfer(aims)
        else:
            coefficients = self._own_basis.coefficients(light)
            transfer = self._own_transfer()
        return shading.shade(transfer, self._array(coefficients[None], wp.vec3))

    def _trace(self, light: EnvironmentMap | np.ndarray) -> wp.array:
        radiance = light.radiance if isinstance(light, EnvironmentMap) else sh.reconstruct_map(light, 64)
        count = max(1, self.scene.visibility.samples // self.scene.supersampling**2)
        points, normals, *_ = self.receivers
        samples = sample_map(radiance, count)
        traced = trace_shading(self._ray_mesh, points.flatten(), normals.flatten(), samples, progress=self.progress)
        return traced.reshape(points.shape)

    @functools.cached_property
    def albedo(self) -> wp.array:
        """Reflectance that the samples see, vec3 of shape [1, height, width]."""
        counts = np.diff(self.geometry.first_vertex)
        of_vertices = np.concatenate(
            [np.broadcast_to(body.albedo, (count, 3)) for body, count in zip(self.scene.bodies, counts, strict=True)]
        )
        albedo = interpolate(self.fragments, self.geometry.faces, self._array(of_vertices[None], wp.vec3))
        for number, body in enumerate(self.scene.bodies):
            if body.texture is not None:
                texture = self._array(body.texture, wp.vec3)
                shading.sample_texture(texture, self.pixels_of(number), self.uvs.flatten(), albedo.flatten())
        return albedo

    def render(self, light: EnvironmentMap | np.ndarray | None = None) -> np.ndarray:
        """Render the image.

        Args:
            light: Environment map or SH coefficients [order², 3] in place of the scene's.

        Returns:
            Linear RGB, premultiplied, and coverage, float32 of shape [height, width, 4]; the background is 0.
        """
        receivers = self.receivers
        lit = self.scene_shading if light is None else self.shade(light)
        color = interpolate(receivers.fragments, receivers.faces, lit).numpy()[0] * self.albedo.numpy()[0]
        coverage = (self.body_ids >= 0).astype(np.float32)
        samples = np.concatenate([color, coverage[..., None]], axis=-1)
        return average_samples(samples, self.scene.supersampling)

    def _array(self, values: np.ndarray, dtype: type) -> wp.array:
        return wp.array(values, dtype=dtype, device=self.device)


def average_samples(samples: Any, factor: int) -> Any:
    """Average the samples of each pixel: [height·factor, width·factor, channel] to [height, width, channel].

    Args:
        samples: A NumPy array or a torch tensor.
        factor: Samples of a pixel across and down.
    """
    height, width, channels = samples.shape
    return samples.reshape(height // factor, factor, width // factor, factor, channels).mean(axis=(1, 3))


def render(scene: Scene, *, device: wp.DeviceLike = "cpu", progress: bool = False) -> np.ndarray:
    """Render a scene.

    Args:
        scene: The scene; its ``visibility`` says how shadows are computed.
        device: Warp device.
        progress: Show progress where something takes longer than a second.

    Returns:
        Linear RGB, premultiplied, and coverage, float32 of shape [height, width, 4]; the background is 0.

    Differentiable: no; see :mod:`warpshadow.torch`.
    """
    return Renderer(scene, device=device, progress=progress).render()
