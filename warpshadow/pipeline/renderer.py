"""Renderers: from a scene to an image, each stage computed once while what it depends on is the same.

What a call leaves out, and why, :meth:`Renderer.explain` says.
"""

import functools
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np
import warp as wp

from warpshadow import check
from warpshadow.assets.basis import Basis, check_basis
from warpshadow.assets.camera import Camera
from warpshadow.assets.light import EnvironmentMap
from warpshadow.device.batch import common_batch
from warpshadow.device.cuda_graph import is_readable
from warpshadow.device.tape import unrecorded
from warpshadow.device.threads import one_at_a_time
from warpshadow.pipeline.assembly import PLACED, Assembly, Geometry, as_geometry
from warpshadow.pipeline.by_spheres import SphereMethod
from warpshadow.pipeline.choice_of_receivers import (
    COARSE_FACE,
    Choice,
    choose_receivers,
    face_sizes,
    receiver_notes,
    with_receivers,
)
from warpshadow.pipeline.directional import Directional
from warpshadow.pipeline.explain import Explanation, decide
from warpshadow.pipeline.layers import Layers, find_layers
from warpshadow.pipeline.lighting import Light, LitPoints, joined
from warpshadow.pipeline.log_sh import LogSH
from warpshadow.pipeline.node import Call, Clock, Node, Source
from warpshadow.pipeline.own_shadows import BY_SPHERES, Blocking
from warpshadow.pipeline.rays import Rays
from warpshadow.pipeline.reflectance import Materials
from warpshadow.pipeline.static import Static
from warpshadow.pipeline.view import View
from warpshadow.scene.creases import rounded_edges
from warpshadow.scene.placement import enclosures, misplacements
from warpshadow.scene.scene import SCENE, BodyLike, PerBody, Scene
from warpshadow.stages.deform import DeformationGraph
from warpshadow.stages.normals import vertex_normals
from warpshadow.stages.poses import Poses
from warpshadow.stages.project import check_clip_space
from warpshadow.stages.receivers import Receivers, receivers_on_faces

METHODS = {"directional": Directional, "log-sh": LogSH, "none": LogSH, "ray-traced": Rays}
"""How light is blocked."""

Own = TypeVar("Own", bound="Renderer")

_OF_CAMERAS = ("_own_view", "_without_others")
"""What is kept of a renderer's cameras."""


class Renderer:
    """Renders a scene, or instances of it with other geometry, cameras, light and reflectance.

    Geometry and cameras of the scene itself do not move, so that an image costs a dot product and a gather. All
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
        scene: The scene; a method "auto" has been replaced by what was chosen, and so have receivers "auto".
        cameras: Those that see the scene.
        has_camera_batch: Whether they were given as a batch.
        basis: What free light is expressed in.
        clock: How long stages took; with ``clock.waits``, stages on a GPU are waited for.

    Threads may share it: their calls come one after another. Copied or pickled, it takes along what it was made of, and
    the copy computes the rest anew when it is asked for.
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
        check.instance("scene", scene, Scene, SCENE)
        check_basis(basis)
        where = check.device("device", device)
        check.choice("scene.visibility.method", scene.visibility.method, METHODS)
        make_method = METHODS[scene.visibility.method]
        self._arguments = {
            "scene": scene,
            "cameras": cameras,
            "device": str(where),
            "basis": basis,
            "progress": progress,
        }
        self.has_camera_batch = cameras is not None
        self.cameras = (scene.camera,) if cameras is None else _alike(cameras)
        self.device = where
        self.progress = progress
        self.assembly = Assembly(scene, device=self.device, progress=progress)
        self._given_scene, self._choices = scene, self._choose_receivers()
        self.assembly.scene = self.scene = with_receivers(scene, self._choices)
        self.clock = Clock()
        self._method = make_method(self.assembly, basis, progress=progress)
        if scene.bounces and isinstance(self._method, SphereMethod):
            from warpshadow.pipeline.bounces.by_spheres import SphereBounces

            self._method.bounces = SphereBounces(self._method)
        self._materials = Materials.of_scene(self.assembly)
        self.basis = self._method.basis
        self._vertices = Source("vertices", lambda: self.geometry().positions)
        self._spheres = Source("spheres", lambda: (self.geometry().centers, self.geometry().radii))
        clip_matrices = [camera.clip_matrix() for camera in self.cameras]
        self._rotations = Source("rotations", lambda: self.geometry().rotations)
        self._cameras = Source("cameras", lambda: wp.array(clip_matrices, dtype=wp.mat44, device=where))
        self._scene_view: View | None = None
        self._last_view: View | None = None
        self._last_cameras: Source | None = None
        self._statics: dict[tuple[int, ...], Static] = {}  # by what moves
        self._has_warned = False

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.scene!r}, {self.device.alias})"

    def _choose_receivers(self) -> list[Choice]:
        if METHODS[self.assembly.scene.visibility.method].lights_samples:  # whatever the bodies say
            return [Choice(body.receivers, None) for body in self.assembly.scene.bodies]
        with unrecorded():
            return choose_receivers(self.assembly, self.cameras, is_light_free=self._arguments["basis"] is not None)

    @one_at_a_time
    def with_cameras(self: Own, cameras: Sequence[Camera]) -> Own:
        """Make a renderer of the same scene for other cameras, which may be of another size; it computes little anew.

        Both share what depends on no camera: spheres, own shadows, what is known of the light. Receivers "auto" stay
        as they were chosen, and images that show nothing draw no warning.

        Args:
            cameras: Any number of them, of one size and near plane, whose images are a batch.
        """
        other = object.__new__(type(self))
        matrices = [camera.clip_matrix() for camera in _alike(cameras)]
        vars(other).update({name: value for name, value in vars(self).items() if name not in _OF_CAMERAS})
        other._arguments = self._arguments | {"cameras": cameras}
        other.cameras, other.has_camera_batch = tuple(cameras), True
        other._cameras = Source("cameras", lambda: wp.array(matrices, dtype=wp.mat44, device=other.device))
        other._scene_view = other._last_view = other._last_cameras = None
        other._has_warned = True
        if "_without_others" in vars(self):
            vars(other)["_without_others"] = self._without_others.with_cameras(cameras)
        return other

    def moved(self: Own, device: wp.DeviceLike) -> Own:
        """Make the same renderer on another device; it computes all anew there."""
        return type(self)(**self._arguments | {"device": device})

    def __getstate__(self) -> dict[str, Any]:
        """What it was made of."""
        return self._arguments

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Make it anew."""
        self.__init__(**state)  # type: ignore[misc]

    # ------------------------------------------------------------------------------------------ geometry and cameras

    @one_at_a_time
    def geometry(self) -> Geometry[wp.array]:
        """Where the scene has its bodies and their spheres; the batch is 1. Not to be written to."""
        return self.assembly.scene_geometry

    @one_at_a_time
    def rest(self) -> Geometry[wp.array]:
        """The bodies and their spheres at rest, each body in its own space; the batch is 1. Not to be written to."""
        return self.assembly.rest

    def scene_poses(self) -> Poses:
        """Where the scene has its bodies; the batch is 1. Not to be written to."""
        return self.assembly.poses

    def placed(
        self,
        poses: Poses | None = None,
        rest: Geometry[wp.array] | None = None,
        *,
        moving: Iterable[BodyLike] | None = None,
    ) -> Geometry[wp.array]:
        """Place the bodies in the world, in arrays of their own.

        Args:
            poses: Of each body, by default the scene's.
            rest: The bodies in their own spaces, by default as their meshes are.
                Either batch may be 1 and then serves every instance of the other.
            moving: Bodies that ``poses`` move, by number or name; None for any. The others stand where the scene has
                them, without a gradient, unless ``rest`` is that of :meth:`deformed`: what it deforms is among those
                that move.

        Differentiable: poses, rest.
        """
        return self.assembly.placed(poses, rest, moving=moving)

    def deformed(
        self,
        body: BodyLike,
        positions: wp.array | None = None,
        centers: wp.array | None = None,
        radii: wp.array | None = None,
        *,
        rest: Geometry[wp.array] | None = None,
    ) -> Geometry[wp.array]:
        """Exchange the shape of one body at rest.

        Args:
            body: The body, its number or name.
            positions: Its vertices in its own space, vec3 of shape [batch, vertex].
            centers: Its spheres' centers, vec3 of shape [batch, sphere].
            radii: Its spheres' radii, float32 of shape [batch, sphere].
                What is None stays as it is in ``rest``; but its spheres follow its vertices, both centers and radii,
                unless ``centers`` are given (:mod:`warpshadow.stages.bound_spheres`).
            rest: All bodies at rest, by default as their meshes are; batches of 1 serve every instance.

        Returns:
            All bodies at rest, for :meth:`placed`, in arrays of their own.

        Raises:
            ValueError: for other vertices of a flat body where light bounces by spheres, for which it stays in its
                plane.

        Differentiable: positions, centers, radii, rest.
        """
        if positions is not None and isinstance(self._method, SphereMethod) and self._method.bounces is not None:
            number = self.scene.body_number(body)
            if self.assembly.is_flat[number]:
                raise ValueError(
                    f"positions: got some for body {number} ({self.scene.bodies[number].called!r}), which is flat; "
                    f"expected None where light bounces (scene.bounces is {self.scene.bounces}), since a flat body "
                    'reflects and blocks as a part of a plane; set bounces = 0, or take method "ray-traced"'
                )
        return self.assembly.deformed(body, positions, centers, radii, rest=rest)

    def deformation_graph(self, body: BodyLike, *, count: int = 4) -> DeformationGraph:
        """Bind the vertices of a body to its spheres, which are the nodes (the paper, section 4).

        Args:
            body: The body, its number or name.
            count: Nodes that carry a vertex.

        Raises:
            ValueError: for a body with too few spheres.
        """
        return self.assembly.deformation_graph(body, count=count)

    @property
    def clip_matrices(self) -> wp.array:
        """The cameras, mat44 of shape [camera]."""
        return self._cameras.value()

    @one_at_a_time
    def view(self, geometry: Geometry[wp.array] | None = None, clip_matrices: wp.array | None = None) -> View:
        """See a geometry through cameras; the last view again if nothing that it depends on changed.

        A view sees what it is given as it is now: arrays may change afterwards, unless they require a gradient. A
        tensor is known again by torch's count of the writes to it, which leaves out those through NumPy and ``.data``;
        other arrays by their values. On a GPU values are not compared, since the host would have to wait: hold on to
        the view there.

        Args:
            geometry: Instances of vertices and spheres, by default the scene's own.
            clip_matrices: Cameras, mat44 of shape [batch], by default :attr:`clip_matrices`; see
                :func:`warpshadow.stages.project.compose_clip_matrices`.

        Differentiable: geometry, clip_matrices.
        """
        is_scenes = geometry is None and clip_matrices is None
        view = self._wired(None if geometry is None else as_geometry("geometry", geometry), clip_matrices)
        if view in (self._scene_view, self._last_view):
            return view
        for node in (view.receivers_node, view.silhouettes):
            node.value(view.call)
        if not self._has_warned and (is_readable(self.device) or (is_scenes and not self.device.is_capturing)):
            remarks = [view.emptiness()]
            if is_scenes:
                remarks += enclosures(self.scene, self.cameras)
                remarks += [*misplacements(self.scene), *rounded_edges(self.scene)]
            if found := [remark for remark in remarks if remark]:
                check.warn("; ".join(found))
                self._has_warned = True
        self._last_cameras = view.cameras
        if view.static is not None:
            self._statics[view.static.moving] = view.static
        if view.receivers_node.is_kept and is_scenes:
            self._scene_view = view
        elif view.receivers_node.is_kept:
            self._last_view = view
        return view

    def _wired(self, geometry: Geometry | None, clip_matrices: wp.array | None) -> View:
        """A view of which nothing is computed yet; the scene's or the last one where what is given is the same."""
        vertices, spheres, cameras, static = self._vertices, self._spheres, self._cameras, None
        last, poses, matrices = self._last_view, [None], self.cameras
        if geometry is not None:
            rest = self.assembly.rest.arrays()
            for name, array in geometry.arrays().items():
                check.shape(f"geometry.{name}", array.shape, ("batch", *rest[name].shape[1:]), PLACED)
            poses = geometry.positions
            vertices = Source.renewed("vertices", poses, last.vertices if last else None)
            spheres = Source.renewed("spheres", (geometry.centers, geometry.radii), last.spheres if last else None)
        if clip_matrices is not None:
            matrices = clip_matrices
            cameras = Source.renewed("cameras", matrices, self._last_cameras)
        image_count = common_batch({"geometry": poses, "clip_matrices": matrices})
        # rays look at all that moves, and light bounces from what moves to what does not
        keeps_rows = not (self._method.lights_samples or self.scene.bounces)
        if geometry is not None and geometry.moving is not None and keeps_rows:
            static = self._statics.get(geometry.moving)
            if static is None or not static.are_those_of(geometry):
                static = Static(self.assembly, geometry)
        given = vertices, spheres, cameras, static, self._blocking(geometry, last)
        for view in (self._scene_view, last):
            if view is not None and view.given == given:
                return view
        if clip_matrices is not None:
            check_clip_space(clip_matrices)
        return View(
            self._method,
            self._materials,
            *given,
            call=self._call(),
            camera=self.cameras[0],
            counts=(len(poses), image_count),
            stands=geometry is None and clip_matrices is None and image_count == 1,
        )

    def _blocking(self, geometry: Geometry | None, last: LitPoints | None = None) -> Blocking:
        """How the bodies of a geometry, by default the scene's, block light."""
        if not self._method.traces_own_shadows:
            return BY_SPHERES
        rotations = self._rotations
        if geometry is not None and geometry.rotations is not None:
            check.shape("geometry.rotations", geometry.rotations.shape, ("batch", len(self.scene.bodies)))
            rotations = Source.renewed("rotations", geometry.rotations, last.blocking.rotations if last else None)
        return self._method.own_shadows.blocking(geometry, rotations)._replace(flats=self._method.flats_in(geometry))

    def _call(self, view: LitPoints | None = None) -> Call:
        """A call, which knows what was computed of a view."""
        return Call(self.clock, view.call if view else None, keeps=not self.device.is_capturing)

    def at_points(self, points: wp.array, normals: wp.array, geometry: Geometry | None = None) -> LitPoints:
        """Points to be lit by :meth:`shade` that are given, not found in an image.

        Nobody knows which body a point is on: all spheres block its light, and where light bounces, none comes from its
        own body as such. For points of bodies take :meth:`on_faces`.

        Args:
            points: Positions [scene units], vec3 of shape [batch, receiver].
            normals: Unit normals, vec3 of shape [batch, receiver].
            geometry: What blocks light, by default the scene's bodies.

        Differentiable: all.
        """
        receivers = Source("receivers", Receivers(points, normals, None, None, None))  # type: ignore[arg-type]
        vertices, spheres = self._vertices, self._spheres
        if geometry is not None:
            vertices = Source("vertices", geometry.positions)
            spheres = Source("spheres", (geometry.centers, geometry.radii))
        node = Node("", lambda given: given, receivers)
        blocking = BY_SPHERES._replace(flats=self._method.flats_in(geometry))
        return LitPoints(self._method, self._materials, vertices, spheres, node, self._call(), blocking=blocking)

    def on_faces(self, sides: np.ndarray, barycentrics: np.ndarray, geometry: Geometry | None = None) -> LitPoints:
        """Points on faces of bodies to be lit by :meth:`shade`, by whose own bodies it knows them.

        Args:
            sides: Face of each, after the last of which their backs are numbered, int of shape [receiver]; those of a
                body after one another.
            barycentrics: Where on it, shape [receiver, 3].
            geometry: Where the bodies are, by default where the scene has them.

        Differentiable: geometry.
        """
        blocking, assembly, vertices, spheres = self._blocking(geometry), self.assembly, self._vertices, self._spheres
        if geometry is not None:
            vertices = Source("vertices", geometry.positions)
            spheres = Source("spheres", (geometry.centers, geometry.radii))
        apart = self._method.apart(blocking)
        bodies = None if apart is None else apart[assembly.body_of_face[sides % len(assembly.body_of_face)]]
        normals = Node("", vertex_normals, vertices, assembly.faces)
        given = assembly.faces, sides, barycentrics, bodies
        node = Node("", receivers_on_faces, vertices, normals, *given)
        points = self._method, self._materials, vertices, spheres, node, self._call()
        return LitPoints(*points, normals=normals, blocking=blocking)

    @functools.cached_property
    def _own_view(self) -> View:
        """What the cameras see of the scene; a warning tells of coarse faces."""
        view = self.view()
        self._warn_of_coarse_faces(view)
        return view

    @one_at_a_time
    def body_ids(self, view: View | None = None) -> np.ndarray:
        """Body that each sample sees, -1 for none, shape [batch, height, width]."""
        view = self._own(view)
        face_ids = view.fragments.face_ids.numpy()
        return np.where(face_ids >= 0, self.assembly.body_of_face[face_ids], -1)

    def _own(self, view: Any) -> Any:
        """A view of this renderer, by default the scene's; those of others keep what others computed."""
        if view is None:
            return self._own_view
        if view.assembly is not self.assembly:
            raise ValueError("view: got one that another renderer made, expected one of this renderer's view()")
        return view

    def _warn_of_coarse_faces(self, view: View) -> None:
        """Say which bodies show faces so large that light at their corners alone misses shadows."""
        asked = [body.receivers == "vertex" for body in self._given_scene.bodies]
        if self._method.lights_samples or not any(asked):
            return
        clip_positions = view.clip_positions.value(view.call).numpy()
        images = zip(view.fragments.face_ids.numpy(), clip_positions, strict=True)
        sizes = face_sizes(images, self.assembly, self.cameras[0])
        for number, (body, size) in enumerate(zip(self._given_scene.bodies, sizes, strict=True)):
            if asked[number] and size.exceeds(COARSE_FACE):
                check.warn(
                    f"body {number} ({body.called!r}): {size}, and light is evaluated at their corners alone; "
                    'receivers = "auto" or "pixel" evaluates it at every pixel',
                )

    # ------------------------------------------------------------------------------------------ light and reflectance

    @one_at_a_time
    def transfer(self) -> wp.array:
        """Transfer vectors of what the scene shows to :attr:`basis`, float32 of shape [view, receiver, coefficient].

        Cameras share the receivers at vertices, for which there is one view. Not to be written to.

        Raises:
            ValueError: where light bounces, which a vector for all colors cannot say.
        """
        if self.scene.bounces:
            raise ValueError(
                f"scene.bounces: got {self.scene.bounces}, expected 0 for transfer vectors, which are of direct light; "
                "shade and draw take free light that bounces, with any method"
            )
        view = self._own_view
        parts = view.transfers.value(self._call(view))
        if len(parts) == 1:
            return parts[0]
        count = parts[0].shape[2]
        rows = joined([part.reshape((part.shape[0], -1)) for part in parts])
        return rows.reshape((rows.shape[0], -1, count))

    @one_at_a_time
    def shade(self, light: Light | None = None, view: LitPoints | None = None) -> wp.array:
        """Light the receivers of a view.

        Args:
            light: Known light, as a map or SH coefficients, by default the scene's: it is shaded as accurately as the
                method can. Free light, an array of coefficients in :attr:`basis`, vec3 of shape [batch, coefficient],
                is differentiable.
            view: From :meth:`view` or :meth:`at_points`, by default the scene's own.

        Returns:
            What each receiver, as a white surface, reflects: vec3 of shape [batch, receiver]. Not to be written to.

        Raises:
            ValueError: where rays are asked for a gradient to geometry.

        Differentiable: light, view.
        """
        view = self._own(view)
        return view.shading(light).value(self._call(view))

    @one_at_a_time
    def reflect(
        self,
        albedo: PerBody[wp.array] | None = None,
        textures: PerBody[wp.array] | None = None,
        view: View | None = None,
    ) -> wp.array:
        """Find the reflectance that samples see.

        Args:
            albedo: Of bodies, vec3 of shape [batch, 1] or [batch, vertex]: a list for all, None for what the scene has,
                or a mapping for some, by their numbers or names.
            textures: Likewise, vec3 of shape [batch, height, width], which needs uvs.
            view: By default the scene's own.

        Returns:
            vec3 of shape [batch, height, width]. Not to be written to.

        Differentiable: albedo, textures, view.
        """
        view = self._own(view)
        albedo, textures = self._per_body(albedo, textures)
        return view.surfaces.reflect(view.materials.replaced(albedo, textures)).samples.value(self._call(view))

    @one_at_a_time
    def seen_texels(self, body: BodyLike) -> np.ndarray:
        """What each texel of the texture of a body weighs in the samples that the scene's cameras take.

        Args:
            body: The body, its number or name; it needs a texture.

        Returns:
            Float32 of shape [height, width]: 0 where no sample sees the texel; see
            :func:`warpshadow.stages.textures.seen.seen_texels`.

        Raises:
            ValueError: for a body without a texture.
        """
        return self._own_view.surfaces.seen_texels(self.scene.body_number(body))

    def _per_body(
        self, albedo: PerBody[wp.array] | None, textures: PerBody[wp.array] | None
    ) -> tuple[list[wp.array | None], list[wp.array | None]]:
        return self.scene.per_body(albedo, "albedo"), self.scene.per_body(textures, "textures")

    # ------------------------------------------------------------------------------------------ image

    @one_at_a_time
    def draw(
        self,
        light: Light | None = None,
        *,
        albedo: PerBody[wp.array] | None = None,
        textures: PerBody[wp.array] | None = None,
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

        Differentiable: light, albedo, textures, view.
        """
        view = self._own(view)
        return view.image(light, *self._per_body(albedo, textures)).value(self._call(view))

    def render(self, light: EnvironmentMap | np.ndarray | None = None) -> np.ndarray:
        """Render the image of the scene.

        Args:
            light: Environment map or SH coefficients [order², 3] in place of the scene's.

        Returns:
            Linear RGB, premultiplied, and coverage, float32 of shape [height, width, 4], or
            [camera, height, width, 4] where cameras were given; the background is 0.
        """
        with unrecorded():
            images = (self._in_photograph(None, light) if self.scene.catchers else self.draw(light)).numpy().copy()
        return images if self.has_camera_batch else images[0]

    @one_at_a_time
    def insert(
        self,
        photograph: wp.array,
        light: Light | None = None,
        *,
        albedo: PerBody[wp.array] | None = None,
        textures: PerBody[wp.array] | None = None,
        geometry: Geometry[wp.array] | None = None,
        clip_matrices: wp.array | None = None,
    ) -> wp.array:
        """Draw images of the bodies in a photograph of what the shadow catchers are.

        Args:
            photograph: Linear RGB, of radiance in the units of the light, vec3 of shape [batch, height, width].
            light: As for :meth:`draw`.
            albedo: As for :meth:`draw`; a catcher's matters where light bounces.
            textures: As for :meth:`draw`.
            geometry: As for :meth:`view`; but bodies that do not move have no kept rows.
            clip_matrices: As for :meth:`view`.
                Batches of 1 serve every instance of the others.

        Returns:
            Linear RGB, vec3 of shape [batch, height, width].

        Raises:
            ValueError: where no body of the scene is a catcher.

        Differentiable: all, as :meth:`draw` is; see :mod:`warpshadow.stages.photograph`.
        """
        if not self.scene.catchers:
            raise ValueError(
                "scene: got no body that is a shadow catcher, expected one or more: Body(…, shadow_catcher=True)"
            )
        check.shape("photograph", photograph.shape, ("batch", *self._size))
        check.finite_arrays({"photograph": photograph})
        return self._in_photograph(photograph, light, albedo, textures, geometry, clip_matrices)

    @one_at_a_time
    def _in_photograph(
        self,
        photograph: wp.array | None,
        light: Light | None = None,
        albedo: PerBody[wp.array] | None = None,
        textures: PerBody[wp.array] | None = None,
        geometry: Geometry[wp.array] | None = None,
        clip_matrices: wp.array | None = None,
    ) -> wp.array:
        """Images of bodies in a photograph; or over nothing, where the shadows on catchers are coverage, vec4."""
        catchers = self.scene.catchers
        alone = None
        if geometry is not None:
            geometry = as_geometry("geometry", geometry)
            if geometry.moving is None or set(geometry.moving) & set(catchers):
                alone = self.assembly.part(geometry, catchers)
            geometry = replace(geometry, moving=None)  # else static catchers would be lit in another way than alone
        colors, images = self._per_body(albedo, textures)
        without = self._without_others
        seen = without.view(alone, clip_matrices)
        reflecting = [colors[number] for number in catchers], [images[number] for number in catchers]
        view = self.view(geometry, clip_matrices)
        if self._method.lights_samples:  # rays are drawn by the number of a receiver, and so are the same for both
            seen = seen.at_receivers_of(view)
        received = seen.white(light, *reflecting).value(without._call(seen))
        taken = None if photograph is None else Source("photograph", photograph)
        given = taken, Source("light without the others", received)
        return view.in_photograph(*given, self._catches, light, colors, images).value(self._call(view))

    @property
    def _size(self) -> tuple[int, int]:
        """Height and width of images [pixels]."""
        return self.cameras[0].height, self.cameras[0].width

    @functools.cached_property
    def _catches(self) -> wp.array:
        """Whether each face is one of a catcher, bool of shape [face]."""
        return wp.array(np.isin(self.assembly.body_of_face, self.scene.catchers), dtype=wp.bool, device=self.device)

    @functools.cached_property
    def _without_others(self) -> "Renderer":
        """Renders the catchers alone, by the same receivers and spheres."""
        bodies = tuple(self.scene.bodies[number] for number in self.scene.catchers)
        scene = replace(self.scene, bodies=bodies)
        given: dict[str, Any] = self._arguments | {"scene": scene, "cameras": self.cameras}
        without = Renderer(**given)
        without.assembly.take_spheres(self.assembly, self.scene.catchers)
        without._has_warned = True
        return without

    @one_at_a_time
    def layers(self, view: View | None = None) -> Layers:
        """Find depth, normals, numbers of bodies and masks: what an image shows beside color.

        Args:
            view: From :meth:`view`, by default the scene's own.

        Returns:
            Arrays with a leading dimension of images where a view or cameras were given. Not differentiable:
            :func:`warpshadow.stages.interpolate.interpolate` makes differentiable ones of a view's fragments.
        """
        has_batch = self.has_camera_batch or view is not None
        height, width = self._size
        with unrecorded():
            layers = find_layers(self._own(view), (width, height), across=self.scene.supersampling)
        return layers if has_batch else Layers(*(each[0] for each in layers))

    @one_at_a_time
    def shadow(self) -> np.ndarray:
        """Find the direct light on the bodies over that which they would get if nothing blocked any.

        All surfaces count as white. Where no light would come from, and where there is no body, it is 1.

        Returns:
            float32 of shape [height, width, 3], or [camera, height, width, 3] where cameras were given. Not
            differentiable.
        """
        given: dict[str, Any] = self._arguments
        if self.scene.bounces:
            return Renderer(**given | {"scene": replace(self.scene, bounces=0)}).shadow()
        bodies = tuple(replace(body, blockers=0) for body in self.scene.bodies)
        others = Renderer(**given | {"scene": replace(self.scene, bodies=bodies)})
        with unrecorded():
            view = self._own_view
            call = self._call(view)
            receivers = Node("", Receivers.without_owners, view.receivers_node)
            none = tuple(wp.empty((1, 0), dtype=dtype, device=self.device) for dtype in (wp.vec3, wp.float32))
            spheres = Source("spheres", none)
            free = LitPoints(others._method, others._materials, self._vertices, spheres, receivers, call)
            images = (view.white_image(each.shading(None)).value(call) for each in (view, free))
            received, unblocked = (image.numpy()[..., :3].copy() for image in images)
        ratio = np.divide(received, unblocked, out=np.ones_like(received), where=unblocked > 0)
        return ratio if self.has_camera_batch else ratio[0]

    # ------------------------------------------------------------------------------------------ what runs

    @one_at_a_time
    def explain(
        self,
        light: Light | None = None,
        *,
        albedo: PerBody[wp.array] | None = None,
        textures: PerBody[wp.array] | None = None,
        view: View | None = None,
        geometry: Geometry[wp.array] | None = None,
        clip_matrices: wp.array | None = None,
    ) -> Explanation:
        """Say what the next call computes, stage by stage, and what it leaves out, and why.

        Args:
            light: As for :meth:`draw`.
            albedo: As for :meth:`draw`.
            textures: As for :meth:`draw`.
            view: As for :meth:`draw`: then only what comes after it is explained.
            geometry: As for :meth:`view`, which is explained with it.
            clip_matrices: As for :meth:`view`.

        Returns:
            The stages, which print as a table: whether each runs and on how many items, how long it took last, and why
            it does or does not run; then the same of the adjoints. Nothing is computed.
        """
        hidden: set[Node] = set()
        if view is not None:
            view = self._own(view)
            hidden = {*decide(view.receivers_node, view.call), view.silhouettes}
        else:
            view = self._wired(None if geometry is None else as_geometry("geometry", geometry), clip_matrices)
        image = view.preview().image(light, *self._per_body(albedo, textures))
        is_host = self.device.is_cpu or self.clock.waits
        notes = receiver_notes(self._given_scene, self._choices)
        if self.scene.bounces:
            count = self.scene.bounces
            notes.append(
                "Light bounces {}.".format(
                    "until none is left" if count == "all" else f"{count} time{'s' * (count != 1)}"
                )
            )
        return Explanation(image, self._call(view), self.clock.timings, is_host=is_host, hidden=hidden, notes=notes)


def _alike(cameras: Sequence[Camera]) -> tuple[Camera, ...]:
    """Cameras whose images are a batch, checked."""
    check.instance("cameras", cameras, Sequence, "a list of Cameras, [camera], or None for the scene's")
    if not cameras:
        raise ValueError("cameras: got none, expected at least one, or None for the scene's")
    first = cameras[0]
    for number, camera in enumerate(cameras):
        check.instance(f"cameras[{number}]", camera, Camera, "a Camera")
        if (camera.width, camera.height, camera.near) != (first.width, first.height, first.near):
            raise ValueError(
                f"cameras[{number}]: got {camera.width} × {camera.height} pixels and near = {camera.near}, "
                f"expected {first.width} × {first.height} and {first.near}, as the first has"
            )
    return tuple(cameras)
