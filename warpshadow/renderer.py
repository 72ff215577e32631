"""The pipeline: from a scene to an image, each stage computed once while what it depends on stands still.

Geometry and cameras make a view, which has transfer vectors; they and light make shading; shading, albedo and textures
make the image.
"""

import functools
import warnings
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import warp as wp

from warpshadow import check, film, sh
from warpshadow.assembly import Assembly, Geometry
from warpshadow.basis import Basis, CellBasis, HarmonicBasis, conversion
from warpshadow.batch import common_batch, concatenate, expand
from warpshadow.camera import Camera, to_clip
from warpshadow.directions import fibonacci
from warpshadow.light import EnvironmentMap
from warpshadow.mesh import vertex_normals
from warpshadow.raster import Fragments, interpolate, rasterize
from warpshadow.receivers import Receivers, find_receivers, seen_vertices
from warpshadow.reference import sample_map, trace_shading, trace_transfer
from warpshadow.scene import Scene
from warpshadow.shading import shade
from warpshadow.silhouette import Silhouettes, find_contrasts, find_silhouettes, smooth_silhouettes
from warpshadow.texture import Footprints, Textures, find_footprints, mip_pyramids, sample_albedo, seen_texels
from warpshadow.transfer import directional_transfer, sh_transfer
from warpshadow.visibility import directional, exponential, log_sh

COARSE_FACE = 400
"""Pixels of an average face beyond which shading at its corners draws a warning."""

Light = EnvironmentMap | np.ndarray | wp.array
"""A map, SH coefficients [order², 3], or free coefficients in the renderer's basis, vec3 [batch, coefficient]."""


class View(NamedTuple):
    """What cameras see of a geometry: all that an image takes but light and reflectance."""

    geometry: Geometry
    receivers: Receivers
    clip_positions: wp.array  # [batch, vertex] vec4
    fragments: Fragments  # of the samples
    silhouettes: Silhouettes


class Renderer:
    """Renders a scene, or instances of it with other geometry, cameras, light and reflectance.

    Geometry and cameras of the scene itself stand still, so that their image costs a dot product and a gather. All
    methods are differentiable under Warp's tape in the arrays they are given, as far as those require gradients.

    Args:
        scene: The scene.
        cameras: In place of the scene's camera any number of them, of one size and near plane, whose images are a
            batch.
        device: Warp device, "cpu" by default.
        basis: What free light is expressed in; None for what the method computes in: cells of directions
            ("directional") or spherical harmonics.
        progress: Show progress where something takes longer than a second.

    Attributes:
        cameras: Those that see the scene.
        has_camera_batch: Whether they were given as a batch.

    Raises:
        ValueError: naming the argument, what it got and what it accepts.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        cameras: Sequence[Camera] | None = None,
        device: wp.DeviceLike = "cpu",
        basis: Basis | None = None,
        progress: bool = False,
    ):
        self.scene = scene
        self.has_camera_batch = cameras is not None
        self.cameras = (scene.camera,) if cameras is None else _alike(cameras)
        self.device = wp.get_device(device)
        self.progress = progress
        self.assembly = Assembly(scene, device=self.device, progress=progress)
        visibility = scene.visibility
        is_cellular = visibility.method == "directional"
        self._own_basis = (
            CellBasis(fibonacci(visibility.directions)) if is_cellular else HarmonicBasis(visibility.order)
        )
        self.basis = self._own_basis if basis is None else basis
        self._kept_footprints: dict[tuple, tuple[Footprints, int]] = {}  # with their coarsest level

    # ------------------------------------------------------------------------------------------ geometry and cameras

    @functools.cached_property
    def geometry(self) -> Geometry:
        """Where the scene has its bodies and their spheres; the batch is 1."""
        return self.assembly.placed()

    @functools.cached_property
    def clip_matrices(self) -> wp.array:
        """The cameras, mat44 of shape [camera]."""
        return self._array(np.stack([camera.clip_matrix() for camera in self.cameras]), wp.mat44)

    def view(self, geometry: Geometry | None = None, clip_matrices: wp.array | None = None) -> View:
        """See a geometry through cameras.

        Args:
            geometry: Instances of vertices and spheres, by default the scene's own.
            clip_matrices: Cameras, mat44 of shape [batch], by default :attr:`clip_matrices`; see
                :func:`warpshadow.camera.compose_clip_matrices`.

        Raises:
            ValueError: naming the argument, what it got and what it accepts.

        Differentiable: geometry, clip_matrices.
        """
        assembly, across = self.assembly, self.scene.supersampling
        geometry = self.geometry if geometry is None else geometry
        clip_positions = to_clip(geometry.positions, self.clip_matrices if clip_matrices is None else clip_matrices)
        camera = self.cameras[0]
        fragments = rasterize(clip_positions, assembly.faces, across * camera.width, across * camera.height)
        silhouettes = find_silhouettes(fragments, assembly.faces, assembly.edges, clip_positions, assembly.surfaces)
        keeps_vertex = self._vertices_receive
        if self.device.is_cpu:  # a GPU would have to wait until the host knows what is seen, which no graph captures
            keeps_vertex = keeps_vertex & seen_vertices(fragments, silhouettes, len(keeps_vertex))
        receivers = find_receivers(
            geometry.positions,
            vertex_normals(geometry.positions, assembly.faces),
            assembly.faces,
            fragments,
            keeps_vertex,
            self._samples_receive[assembly.body_of_face],
        )
        return View(geometry, receivers, clip_positions, fragments, silhouettes)

    @functools.cached_property
    def _samples_receive(self) -> np.ndarray:
        """Bodies on which every sample is a receiver."""
        return np.array([self._is_traced or body.receivers == "pixel" for body in self.scene.bodies])

    @functools.cached_property
    def _vertices_receive(self) -> np.ndarray:
        """Vertices of the other bodies."""
        return np.repeat(~self._samples_receive, np.diff(self.assembly.first_vertex))

    @functools.cached_property
    def scene_view(self) -> View:
        """What the cameras see of the scene."""
        view = self.view()
        self._warn_of_coarse_faces(view.fragments)
        return view

    def body_ids(self, view: View | None = None) -> np.ndarray:
        """Body that each sample sees, -1 for none, shape [batch, height, width]."""
        view = self.scene_view if view is None else view
        face_ids = view.fragments.face_ids.numpy()
        return np.where(face_ids >= 0, self.assembly.body_of_face[face_ids], -1)

    def _warn_of_coarse_faces(self, fragments: Fragments) -> None:
        """Say which bodies show faces so large that light at their corners alone misses shadows."""
        bodies = self.scene.bodies
        body_of_face = self.assembly.body_of_face
        sample_counts, face_counts = np.zeros((2, len(bodies)))
        for face_ids in fragments.face_ids.numpy():
            seen = face_ids[face_ids >= 0]
            sample_counts += np.bincount(body_of_face[seen], minlength=len(bodies))
            face_counts += np.bincount(body_of_face[np.unique(seen)], minlength=len(bodies))
        pixels_per_face = sample_counts / self.scene.supersampling**2 / np.maximum(face_counts, 1)
        for number, body in enumerate(bodies):
            if body.receivers == "vertex" and not self._is_traced and pixels_per_face[number] > COARSE_FACE:
                warnings.warn(
                    f"body number {number + 1} ({body.mesh.name!r}): a face covers {pixels_per_face[number]:.0f} "
                    "pixels on average, and light is evaluated at its corners alone; "
                    'receivers = "pixel" evaluates it at every pixel',
                    stacklevel=2,
                )

    # ------------------------------------------------------------------------------------------ light

    @functools.cached_property
    def transfer(self) -> wp.array:
        """Transfer vectors of what the scene shows to :attr:`basis`, float32 of shape [view, receiver, coefficient].

        Cameras share the receivers at vertices, for which there is one view.
        """
        view = self.scene_view
        if self._is_traced:
            return self._trace_transfer(view)
        own = self._own_transfer(view)
        matrix = self._own_from_basis
        return own if matrix is None else self._array(own.numpy() @ matrix, wp.float32)

    @functools.cached_property
    def _own_from_basis(self) -> np.ndarray | None:
        return conversion(self.basis, self._own_basis)

    def _own_transfer(self, view: View, directions: np.ndarray | None = None) -> wp.array:
        """Transfer vectors of a view's receivers to what the method computes in, or to other cells of directions."""
        points, normals, *_ = view.receivers
        visibility = self.scene.visibility
        spheres = [view.geometry.centers, view.geometry.radii]
        has_spheres = spheres[0].shape[1] > 0
        if has_spheres:
            count = common_batch({"points": points, "centers": spheres[0], "radii": spheres[1]})
            points, normals, *spheres = (expand(array, count) for array in (points, normals, *spheres))
        centers, radii = spheres
        if isinstance(self._own_basis, CellBasis):
            directions = self._own_basis.directions if directions is None else directions
            if has_spheres:
                softness = visibility.softness
                seen = directional.transmittance(points, normals, centers, radii, directions, softness=softness)
            else:
                seen = wp.full((*points.shape, len(directions)), 1.0, dtype=wp.float32, device=self.device)
            return directional_transfer(seen, normals, directions)
        seen = None
        if has_spheres:
            log = log_sh.accumulate(points, normals, centers, radii, order=visibility.order, log=visibility.log)
            seen = exponential.exponentiate(log, base=visibility.base)
        return sh_transfer(seen, normals, order=visibility.order)

    @functools.cached_property
    def scene_shading(self) -> wp.array:
        """The scene's receivers in the scene's light, each as a white surface: vec3 of shape [view, receiver]."""
        return self._shade_known(self.scene_view, self.scene.light)

    def shade(self, light: Light | None = None, view: View | None = None) -> wp.array:
        """Light receivers, each as a white surface.

        Args:
            light: By default the scene's. Known light is shaded as accurately as the method can; free light, an array
                of coefficients in :attr:`basis`, vec3 of shape [batch, coefficient], is differentiable.
            view: By default the scene's own.

        Returns:
            Shading, vec3 of shape [batch, receiver].

        Raises:
            ValueError: naming the argument; so where rays are asked for a gradient to geometry.

        Differentiable: light, view.
        """
        is_static = view is None or view is self.scene_view
        view = self.scene_view if view is None else view
        if not isinstance(light, wp.array):
            if light is None and is_static:
                return self.scene_shading
            return self._shade_known(view, self.scene.light if light is None else light)
        if is_static:
            return shade(self.transfer, light)
        if self._is_traced:
            raise ValueError("light: got free light for moving geometry, which rays cannot shade; expected known light")
        if self._own_from_basis is not None:
            matrix = self._array(self._own_from_basis[None], wp.float32)
            light = shade(matrix, light)
        return shade(self._own_transfer(view), light)

    def _shade_known(self, view: View, light: EnvironmentMap | np.ndarray) -> wp.array:
        if self._is_traced:
            return self._trace(view, light)
        coefficients, directions = self._scene_light if light is self.scene.light else self._express(light)
        return shade(self._own_transfer(view, directions), coefficients)

    @functools.cached_property
    def _scene_light(self) -> tuple[wp.array, np.ndarray | None]:
        return self._express(self.scene.light)

    def _express(self, light: EnvironmentMap | np.ndarray) -> tuple[wp.array, np.ndarray | None]:
        """Known light in what the method computes in, vec3 of shape [1, coefficient], and where its cells look."""
        if isinstance(self._own_basis, CellBasis) and isinstance(light, EnvironmentMap):
            # a cell looks to where its light comes from: a sun is rarely in the middle
            coefficients, directions, _ = light.cells(self._own_basis.directions)
        else:
            coefficients, directions = self._own_basis.coefficients(light), None
        return self._array(coefficients[None], wp.vec3), directions

    def _trace_transfer(self, view: View) -> wp.array:
        """Transfer vectors of what a view of the scene's geometry shows."""
        points, normals, *_ = view.receivers
        mesh, count = self._ray_mesh(view, 0), self.scene.visibility.samples
        transfer = wp.empty((*points.shape, self.basis.size), dtype=wp.float32, device=self.device)
        for instance in range(points.shape[0] if points.size else 0):
            traced = trace_transfer(
                mesh, points[instance], normals[instance], self.basis, count, progress=self.progress
            )
            wp.copy(transfer[instance], traced)
        return transfer

    def _trace(self, view: View, light: EnvironmentMap | np.ndarray) -> wp.array:
        points, normals, *_ = view.receivers
        if points.requires_grad:
            raise ValueError(
                "geometry: got arrays that require a gradient, which rays do not have; expected none, or another method"
            )
        radiance = light.radiance if isinstance(light, EnvironmentMap) else sh.reconstruct_map(light, 64)
        count = max(1, self.scene.visibility.samples // self.scene.supersampling**2)
        samples = sample_map(radiance, count)
        traced = wp.empty(points.shape, dtype=wp.vec3, device=self.device)
        for instance in range(points.shape[0] if points.size else 0):
            if instance < view.geometry.positions.shape[0]:
                mesh = self._ray_mesh(view, instance)
            lit = trace_shading(mesh, points[instance], normals[instance], samples, progress=self.progress)
            wp.copy(traced[instance], lit)
        return traced

    def _ray_mesh(self, view: View, instance: int) -> wp.Mesh:
        points = wp.clone(view.geometry.positions[instance], requires_grad=False)
        return wp.Mesh(points=points, indices=self.assembly.faces.view(wp.int32).flatten())

    @property
    def _is_traced(self) -> bool:
        return self.scene.visibility.method == "ray-traced"

    # ------------------------------------------------------------------------------------------ reflectance

    @functools.cached_property
    def albedo(self) -> wp.array:
        """Reflectance that the scene's samples see, vec3 of shape [camera, height, width]."""
        return self._reflect(self.scene_view, self._body_albedo, self._body_textures)

    @functools.cached_property
    def _body_albedo(self) -> list[wp.array]:
        """Reflectance of each body in the scene, vec3 of shape [1, 1] or [1, vertex]."""
        return [self._array(np.atleast_2d(body.albedo)[None], wp.vec3) for body in self.scene.bodies]

    @functools.cached_property
    def _body_textures(self) -> list[wp.array | None]:
        """Texture of each body in the scene, vec3 of shape [1, height, width]."""
        images = (body.texture for body in self.scene.bodies)
        return [None if image is None else self._array(image[None], wp.vec3) for image in images]

    @functools.cached_property
    def _scene_vertex_albedo(self) -> wp.array:
        return self._join(self._body_albedo)

    @functools.cached_property
    def _scene_pyramids(self) -> Textures:
        return mip_pyramids([image for image in self._body_textures if image is not None])

    def reflect(
        self,
        albedo: Sequence[wp.array | None] | None = None,
        textures: Sequence[wp.array | None] | None = None,
        view: View | None = None,
    ) -> wp.array:
        """Find the reflectance that samples see.

        Args:
            albedo: For each body, vec3 of shape [batch, 1] or [batch, vertex]; None for what the scene has.
            textures: For each body, vec3 of shape [batch, height, width], which needs uvs; None for what the scene has.
            view: By default the scene's own.

        Returns:
            vec3 of shape [batch, height, width].

        Raises:
            ValueError: naming the argument, what it got and what it accepts.

        Differentiable: albedo, textures, view.
        """
        is_scenes = not any(given is not None for given in (*(albedo or ()), *(textures or ())))
        if is_scenes and (view is None or view is self.scene_view):
            return self.albedo
        bodies = self.scene.bodies
        colors, images = list(self._body_albedo), list(self._body_textures)
        for name, given in (("albedo", albedo), ("textures", textures)):
            if given is not None and len(given) != len(bodies):
                raise ValueError(f"{name}: got {len(given)} items, expected {len(bodies)}, one for each body")
        for number, color in enumerate(albedo or ()):
            if color is not None:
                vertex_count = bodies[number].mesh.vertex_count
                check.shape(f"albedo[{number}]", color.shape, ("batch", 1 if color.shape[1:] == (1,) else vertex_count))
                check.finite_arrays({f"albedo[{number}]": color}, most=check.LARGEST)
                colors[number], images[number] = color, None
        for number, image in enumerate(textures or ()):
            if image is not None:
                check.shape(f"textures[{number}]", image.shape, ("batch", "height", "width"))
                if bodies[number].mesh.uvs is None:
                    raise ValueError(f"textures[{number}]: got an image, but the mesh has no uvs; expected None")
                if albedo is not None and albedo[number] is not None:
                    raise ValueError(f"albedo[{number}], textures[{number}]: got both, expected one of them")
                check.finite_arrays({f"textures[{number}]": image}, most=check.LARGEST)
                images[number] = image
        return self._reflect(self.scene_view if view is None else view, colors, images)

    def _reflect(self, view: View, colors: list[wp.array], images: list[wp.array | None]) -> wp.array:
        faces = self.assembly.faces
        vertex_albedo = self._scene_vertex_albedo if _same(colors, self._body_albedo) else self._join(colors)
        present = [image for image in images if image is not None]
        if not present:
            return interpolate(view.fragments, faces, vertex_albedo)
        sizes = tuple(None if image is None else image.shape[1:] for image in images)
        is_static = view is self.scene_view
        footprints, coarsest = self._kept_footprints.get(sizes, (None, None)) if is_static else (None, None)
        is_kept = _same(images, self._body_textures)
        pyramids = self._scene_pyramids if is_kept else mip_pyramids(present, coarsest=coarsest)
        if footprints is None:
            footprints = self._find_footprints(view, pyramids, sizes)
            if is_static:
                self._kept_footprints = {sizes: (footprints, footprints.coarsest_level())}
        return sample_albedo(view.fragments, faces, vertex_albedo, pyramids, footprints)

    def seen_texels(self, number: int) -> np.ndarray:
        """What each texel of the texture of a body weighs in the samples that the scene's cameras take.

        Args:
            number: The body, from 0; it needs a texture.

        Returns:
            Float32 of shape [height, width]: 0 where no sample sees the texel; see
            :func:`warpshadow.texture.seen_texels`.

        Raises:
            ValueError: for a body without a texture.
        """
        has_texture = [image is not None for image in self._body_textures]
        check.choice("number", number, [body for body, has in enumerate(has_texture) if has])
        sizes = tuple(None if image is None else image.shape[1:] for image in self._body_textures)
        footprints = self._find_footprints(self.scene_view, self._scene_pyramids, sizes)
        return seen_texels(self._scene_pyramids, footprints)[sum(has_texture[:number])].sum(axis=0)

    def _join(self, colors: list[wp.array]) -> wp.array:
        """Reflectance of all vertices."""
        return concatenate(colors, np.diff(self.assembly.first_vertex).tolist())

    def _find_footprints(self, view: View, pyramids: Textures, sizes: tuple) -> Footprints:
        """What each sample covers of its texture; sizes are those of the bodies' textures, None without one."""
        assembly = self.assembly
        has_texture = np.array([size is not None for size in sizes])
        texture_of_body = np.where(has_texture, np.cumsum(has_texture) - 1, -1)
        return find_footprints(
            view.fragments,
            assembly.faces,
            view.clip_positions,
            assembly.uvs,
            assembly.uv_faces,
            self._array(texture_of_body[assembly.body_of_face], wp.int32),
            pyramids,
        )

    # ------------------------------------------------------------------------------------------ image

    def draw(
        self,
        light: Light | None = None,
        *,
        albedo: Sequence[wp.array | None] | None = None,
        textures: Sequence[wp.array | None] | None = None,
        view: View | None = None,
    ) -> wp.array:
        """Draw images.

        Args:
            light: As for :meth:`shade`.
            albedo: As for :meth:`reflect`.
            textures: As for :meth:`reflect`.
            view: From :meth:`view`, by default the scene's own.
                Batches of 1 serve every instance of the others.

        Returns:
            Linear RGB, premultiplied, and coverage, vec4 of shape [batch, height, width]; the background is 0.

        Raises:
            ValueError: naming the argument, what it got and what it accepts.

        Differentiable: light, albedo, textures, view.
        """
        lit = self.shade(light, view)
        reflected = self.reflect(albedo, textures, view)
        view = self.scene_view if view is None else view
        receivers, silhouettes, clip_positions = view.receivers, view.silhouettes, view.clip_positions
        samples = film.expose(receivers.fragments, receivers.faces, lit, reflected)
        contrasts = None
        if clip_positions.requires_grad:
            contrasts = find_contrasts(samples, silhouettes, clip_positions, lit, receivers.of_vertices, reflected)
        smoothed = smooth_silhouettes(samples, silhouettes, clip_positions, contrasts)
        return film.average(smoothed, self.scene.supersampling)

    def render(self, light: EnvironmentMap | np.ndarray | None = None) -> np.ndarray:
        """Render the image of the scene.

        Args:
            light: Environment map or SH coefficients [order², 3] in place of the scene's.

        Returns:
            Linear RGB, premultiplied, and coverage, float32 of shape [height, width, 4], or
            [camera, height, width, 4] where cameras were given; the background is 0.
        """
        images = self.draw(light).numpy().copy()
        return images if self.has_camera_batch else images[0]

    def _array(self, values: np.ndarray, dtype: type) -> wp.array:
        return wp.array(values, dtype=dtype, device=self.device)


def _same(arrays: Sequence[wp.array | None], others: Sequence[wp.array | None]) -> bool:
    """Whether arrays are the same objects."""
    return all(array is other for array, other in zip(arrays, others, strict=True))


def _alike(cameras: Sequence[Camera]) -> tuple[Camera, ...]:
    """Cameras whose images are a batch, checked."""
    if not cameras:
        raise ValueError("cameras: got none, expected at least one, or None for the scene's")
    first = cameras[0]
    for number, camera in enumerate(cameras):
        if (camera.width, camera.height, camera.near) != (first.width, first.height, first.near):
            raise ValueError(
                f"cameras[{number}]: got {camera.width} × {camera.height} pixels and near = {camera.near}, "
                f"expected {first.width} × {first.height} and {first.near}, as the first has"
            )
    return tuple(cameras)


def render(scene: Scene, *, device: wp.DeviceLike = "cpu", progress: bool = False) -> np.ndarray:
    """Render a scene once; for several images of it, keep a :class:`Renderer`.

    Args:
        scene: The scene.
        device: Warp device.
        progress: Show progress where something takes longer than a second.

    Returns:
        Linear RGB, premultiplied, and coverage, float32 of shape [height, width, 4]; the background is 0.
    """
    return Renderer(scene, device=device, progress=progress).render()
