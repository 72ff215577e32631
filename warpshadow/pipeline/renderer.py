"""Renderers: from a scene to an image; each stage is computed once for the same inputs.

:meth:`SceneRenderer.explain` lists the stages that a call skips, and why.
"""

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
import warp as wp

from warpshadow import check
from warpshadow.assets.basis import Basis
from warpshadow.assets.camera import Camera
from warpshadow.assets.light import KnownLightArgument
from warpshadow.device.array_checks import finite_arrays
from warpshadow.device.memory import keep_pool
from warpshadow.device.progress import waiting
from warpshadow.device.tape import unrecorded
from warpshadow.device.threads import locked, with_lock_and_progress
from warpshadow.pipeline.bodies.free_shapes import FreeShapes
from warpshadow.pipeline.bodies.geometry import Geometry, as_geometry
from warpshadow.pipeline.bodies.merged_scene import MergedScene
from warpshadow.pipeline.bodies.reflectance import Materials
from warpshadow.pipeline.delegation import delegated
from warpshadow.pipeline.explain import Explanation, decide_which_nodes_run, shell_notes
from warpshadow.pipeline.image_inputs import ImageArrays, accepts_fields_of
from warpshadow.pipeline.methods.by_name import make_method
from warpshadow.pipeline.node import Clock, Input, Node
from warpshadow.pipeline.receivers.choice_of_receivers import choose_receivers, receiver_notes, with_receivers
from warpshadow.pipeline.receivers.shading_context import ShadingContext
from warpshadow.pipeline.receivers.unevenness import EmitterLuminance
from warpshadow.pipeline.shading.transfers import LightArgument, join_rows
from warpshadow.pipeline.transport import LightTransport
from warpshadow.pipeline.views.catchers import CatcherScene
from warpshadow.pipeline.views.layers import LayerArrays, Layers, find_layer_arrays, find_layers
from warpshadow.pipeline.views.scene_views import SceneViews, camera_batch
from warpshadow.pipeline.views.shading_ratio import shading_ratio
from warpshadow.pipeline.views.view import View
from warpshadow.pipeline.views.view_warnings import warn_of_vertex_receivers
from warpshadow.scene.scene import BodyLike, PerBody, Scene
from warpshadow.scene.visibility import METHODS

RendererType = TypeVar("RendererType", bound="SceneRenderer")


@dataclass(frozen=True, eq=False, kw_only=True)
class ViewArrays(ImageArrays):
    """All that an image takes, and its view, which may be made before.

    Args:
        view: From ``view``, in place of geometry and cameras; by default the scene's own. Where it is given, only the
            stages after it are explained.
    """

    view: View | None = None


_CACHED_BY_CAMERAS = ("_scene_view", "_catcher_scene")  # cached values of a renderer's cameras


class SceneRenderer:
    """Renders a scene, or instances of it with other geometry, cameras, light and reflectance.

    Results that depend on the scene's own geometry and cameras alone are cached. In direct light on diffuse bodies
    other free light then costs a dot product for each receiver, and a gather; other reflectance the gather alone; other
    known light finds visibility again. Methods that return arrays are differentiable under Warp's tape, in the
    arguments that their docstrings name.

    Args:
        cameras: In place of the scene's camera any number of them, of one size and near plane, whose images are a
            batch.
        basis: Basis of free light; None for the method's own: cells of directions ("directional") or spherical
            harmonics.
    Attributes:
        scene: The scene; receivers "auto" have been replaced by the chosen ones.
        cameras: The cameras whose images it draws.
        has_camera_batch: Whether they were given as a batch.
        basis: Basis of free light.
        device: Device of its arrays.
        progress: Whether it shows its progress.
        merged_scene: The bodies as one mesh.
        clock: How long stages took; with ``clock.waits``, stages on a GPU are waited for.

    Threads may share it: their calls come one after another. Copied or pickled, it takes along its arguments, and the
    copy computes the rest anew when it is asked for.
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
        where, scene = check.device("device", device), scene.with_method()
        check.choice("scene.visibility.method", scene.visibility.method, METHODS)
        options = {"device": str(where), "basis": basis, "progress": progress}
        self._arguments = {"scene": scene, "cameras": cameras, **options}
        self.has_camera_batch = cameras is not None
        self.cameras = (scene.camera,) if cameras is None else camera_batch(cameras)
        self.device = where
        keep_pool(where)
        self.progress = progress
        with waiting("preparing", shows=progress):
            merged_scene = MergedScene(scene, device=self.device, progress=progress)
            with unrecorded():
                self._choices = choose_receivers(
                    merged_scene,
                    self.cameras,
                    is_light_free=basis is not None,
                    emitter_luminance=_emitter_luminance(merged_scene),
                )
        self._given_scene, self.scene = scene, with_receivers(scene, self._choices)
        self.merged_scene = merged_scene.with_settings(self.scene)
        self._free_shapes = FreeShapes(self.merged_scene)
        self.clock = Clock()
        self._method = make_method(self.merged_scene, basis, progress=progress)
        self._materials = Materials.of_scene(self.merged_scene)
        self.basis = self._method.basis
        self._transport = LightTransport(self._method)
        self._views = SceneViews(self._transport, self._materials, self.cameras, self.clock)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.scene!r}, {self.device.alias})"

    @locked
    def with_cameras(self: RendererType, cameras: Sequence[Camera]) -> RendererType:
        """Make a renderer of the same scene for other cameras, which may be of another size; it computes little anew.

        Both share the values that depend on no camera: spheres, self-visibility, known light. Receivers "auto" stay
        as they were chosen, and images that show nothing draw no warning.

        Args:
            cameras: Any number of them, of one size and near plane, whose images are a batch.
        """
        other = object.__new__(type(self))
        vars(other).update({name: value for name, value in vars(self).items() if name not in _CACHED_BY_CAMERAS})
        other._arguments = self._arguments | {"cameras": cameras}
        other.cameras, other.has_camera_batch = camera_batch(cameras), True
        other._views = self._views.with_cameras(other.cameras)
        if "_catcher_scene" in vars(self):
            vars(other)["_catcher_scene"] = self._catcher_scene.with_cameras(other.cameras)
        return other

    def moved(self: RendererType, device: wp.DeviceLike) -> RendererType:
        """Make the same renderer on another device; it computes all anew there."""
        return type(self)(**self._arguments | {"device": device})

    def __getstate__(self) -> dict[str, Any]:
        """The arguments it was made from."""
        return self._arguments

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Make it anew."""
        self.__init__(**state)  # type: ignore[misc]

    # ------------------------------------------------------------------------------------------ geometry and cameras

    @locked
    def geometry(self) -> Geometry[wp.array]:
        """Where the scene has its bodies and their spheres; the batch is 1. Not to be written to."""
        return self.merged_scene.scene_geometry

    @locked
    def rest(self) -> Geometry[wp.array]:
        """The bodies and their spheres at rest, each body in its own space; the batch is 1. Not to be written to."""
        return self.merged_scene.rest

    scene_poses = delegated("merged_scene", MergedScene.scene_poses)
    placed = delegated("merged_scene", MergedScene.placed)
    deformed = delegated("_free_shapes", FreeShapes.deformed)
    deformation_graph = delegated("_free_shapes", FreeShapes.deformation_graph)

    @property
    @locked
    def clip_matrices(self) -> wp.array:
        """The cameras, mat44 of shape [camera]."""
        return self._views.clip_matrices.value()

    @with_lock_and_progress
    def view(self, geometry: Geometry[wp.array] | None = None, clip_matrices: wp.array | None = None) -> View:
        """See a geometry through cameras; the last view again if nothing that it depends on changed.

        A view copies its arguments: arrays may change afterwards, unless they require a gradient. On a CPU changes are
        recognized by values. On a GPU these are not compared, since the host would have to wait: a changed tensor is
        recognized by torch's count of the writes to it, which leaves out writes through NumPy and ``.data``; with other
        arrays, hold on to the view.

        Args:
            geometry: Instances of vertices and spheres, by default the scene's own.
            clip_matrices: Cameras, mat44 of shape [batch], by default :attr:`clip_matrices`; see
                :func:`warpshadow.stages.raster.project.compose_clip_matrices`.
        Differentiable: geometry, clip_matrices.
        """
        return self._views.view(geometry, clip_matrices)

    at_points = delegated("_views", SceneViews.at_points)
    on_faces = delegated("_views", SceneViews.on_faces)

    @functools.cached_property
    def _scene_view(self) -> View:
        """Build the view of the cameras on the scene; a warning tells of coarse faces."""
        view = self._views.view()
        if not self.scene.visibility.traits.every_sample_receives:
            warn_of_vertex_receivers(view, self._given_scene.bodies, self.cameras[0])
        return view

    @locked
    def body_ids(self, view: View | None = None) -> np.ndarray:
        """Body that each sample sees, -1 for none, shape [batch, height, width]."""
        view = self._checked(view)
        face_ids = view.fragments.face_ids.numpy()
        return np.where(face_ids >= 0, self.merged_scene.body_of_face[face_ids], -1)

    def _checked(self, view: Any) -> Any:
        """A view of this renderer, by default the scene's; other views reuse their cached values."""
        if view is None:
            return self._scene_view
        if view.merged_scene is not self.merged_scene:
            raise ValueError("view: got one that another renderer made, expected one of this renderer's view()")
        return view

    # ------------------------------------------------------------------------------------------ light and reflectance

    @with_lock_and_progress
    def transfer(self) -> wp.array:
        """Transfer vectors of the visible receivers to :attr:`basis`, float32 of shape [view, receiver, coefficient].

        Cameras share the receivers at vertices, for which there is one view. Not to be written to.

        Raises:
            ValueError: where light bounces, which a vector for all colors cannot say.
        """
        if self.scene.bounces:
            raise ValueError(
                f"scene.bounces: got {self.scene.bounces}, expected 0 for transfer vectors, which are of direct light; "
                "shade and draw take free light that bounces, with any method"
            )
        view = self._scene_view
        return join_rows(view.transfers.value(self._views.call(view)))

    @with_lock_and_progress
    def shade(self, light: LightArgument | None = None, view: ShadingContext | None = None) -> wp.array:
        """Light the receivers of a view.

        Args:
            light: Known light, as a map or SH coefficients, by default the scene's: it is shaded as accurately as the
                method can. Free light, an array of coefficients in :attr:`basis`, vec3 of shape [batch, coefficient],
                is differentiable.
            view: From :meth:`view` or :meth:`at_points`, by default the scene's own.
        Returns:
            Light that each receiver, as a white surface, reflects: vec3 of shape [batch, receiver]. Not to be written
            to.
        Raises:
            ValueError: where rays are asked for a gradient to geometry.
        Differentiable: light, view, but for the motion over the screen of receivers at samples beside outlines, which
        images have by mean slopes of their colors (:mod:`warpshadow.stages.image.slopes`).
        """
        view = self._checked(view)
        light_input = self._method.light_input(view, light)
        return self._transport.shading(view, light_input).value(self._views.call(view))

    @with_lock_and_progress
    def reflect(
        self,
        albedo: PerBody[wp.array] | None = None,
        textures: PerBody[wp.array] | None = None,
        view: View | None = None,
    ) -> wp.array:
        """Find the reflectance that samples see.

        Args:
            albedo, textures: As of an image (:class:`.ImageInputs`).
            view: By default the scene's own.
        Returns:
            vec3 of shape [batch, height, width]. Not to be written to.
        Differentiable: albedo, textures, view.
        """
        view = self._checked(view)
        materials = self.materials({"albedo": albedo, "textures": textures})
        return view.reflectance(materials).samples.value(self._views.call(view))

    @locked
    def seen_texels(self, body: BodyLike) -> np.ndarray:
        """Weight of each texel of a body's texture in the samples of the scene's cameras.

        Args:
            body: The body, its number or name; it needs a texture.
        Returns:
            Float32 of shape [height, width]: 0 where no sample sees the texel; see
            :func:`warpshadow.stages.textures.seen.seen_texels`.
        Raises:
            ValueError: for a body without a texture.
        """
        return self._scene_view.seen_texels(self.scene.body_number(body))

    def materials(self, of_bodies: Mapping[str, PerBody[wp.array] | None]) -> Materials:
        """The scene's materials with others in their place, by name, checked."""
        return self._materials.replaced({name: self.scene.per_body(values, name) for name, values in of_bodies.items()})

    # ------------------------------------------------------------------------------------------ image

    @accepts_fields_of(ViewArrays)
    @with_lock_and_progress
    def draw(self, inputs: ViewArrays) -> wp.array:
        """Draw images.

        Args:
            inputs: All that an image takes.
        Returns:
            Linear RGB, premultiplied, and coverage, vec4 of shape [batch, height, width]; the background is 0.
        Differentiable: all; not by "ray-traced": geometry, clip_matrices, shell.
        """
        is_of_scene = inputs.view is None and inputs.geometry is None and inputs.clip_matrices is None
        return self.draw_inputs(inputs, self._scene_view if is_of_scene else inputs.view)  # the former warns

    def draw_inputs(self, inputs: ImageArrays, view: View | None = None) -> wp.array:
        """Draw images, as :meth:`draw` does, by a record of its arguments; it does not warn of coarse faces.

        The methods ``…_inputs`` take no lock: callers hold it.
        """
        view = self._views.view(inputs.geometry, inputs.clip_matrices) if view is None else self._checked(view)
        light = self._method.light_input(view, inputs.light, inputs.shell)
        return view.image(light, self.materials(inputs.of_bodies)).value(self._views.call(view))

    @check.keywords(**dict.fromkeys(("camera", "cameras"), "renderer.with_cameras([camera]).render()"))
    def render(self, light: KnownLightArgument | None = None) -> np.ndarray:
        """Render the image of the scene.

        Args:
            light: Environment map or SH coefficients [order², 3] in place of the scene's.
        Returns:
            Linear RGB, premultiplied, and coverage, float32 of shape [height, width, 4], or
            [camera, height, width, 4] where cameras were given; the background is 0.
        """
        if isinstance(light, Camera):
            raise ValueError(
                "light: got a Camera, expected a light, or none for the scene's; cameras go to the renderer: "
                "renderer.with_cameras([camera]).render(), or Renderer(scene, cameras=[camera])"
            )
        with unrecorded():
            images = (self.insert(None, light) if self.scene.catchers else self.draw(light)).numpy().copy()
        return images if self.has_camera_batch else images[0]

    @accepts_fields_of(ImageArrays)
    @with_lock_and_progress
    def insert(self, photograph: wp.array | None, inputs: ImageArrays) -> wp.array:
        """Draw images of the bodies in a photograph whose surfaces the shadow catchers model.

        Args:
            photograph: Linear RGB, of radiance in the units of the light, vec3 of shape [batch, height, width]; None
                for nothing, where shadows on catchers are coverage.
            inputs: All that an image takes; static bodies have no cached rows. A catcher's albedo matters where light
                bounces.
        Returns:
            Linear RGB, vec3 of shape [batch, height, width]; vec4 with coverage, without a photograph.
        Raises:
            ValueError: where no body of the scene is a catcher.
        Differentiable: all, as :meth:`draw` is; see :mod:`warpshadow.stages.image.photograph`.
        """
        return self.insert_inputs(photograph, inputs)

    def insert_inputs(self, photograph: wp.array | None, inputs: ImageArrays) -> wp.array:
        """Draw images in a photograph, as :meth:`insert` does, by a record of its arguments."""
        if not self.scene.catchers:
            raise ValueError(
                "scene: got no body that is a shadow catcher, expected one or more: Body(…, shadow_catcher=True)"
            )
        if photograph is not None:
            check.shape("photograph", photograph.shape, ("batch", *self._size))
            finite_arrays({"photograph": photograph})
        catchers, materials = self._catcher_scene, self.materials(inputs.of_bodies)
        geometry, alone = None, None
        if inputs.geometry is not None:
            geometry = as_geometry("geometry", inputs.geometry)
            alone = catchers.moved_geometry(geometry)
            geometry = replace(geometry, moving=None)  # else static catchers would be lit in another way than alone
        view = self._views.view(geometry, inputs.clip_matrices)
        light = self._method.light_input(view, inputs.light, inputs.shell)
        catcher_light = catchers.light(replace(inputs, geometry=alone), view)
        unshadowed = Input("light without the others", catcher_light)
        photo_input = None if photograph is None else Input("photograph", photograph)
        node = view.in_photograph(photo_input, unshadowed, catchers.has_face, light, materials)
        return node.value(self._views.call(view))

    @property
    def _size(self) -> tuple[int, int]:
        """Height and width of images [pixels]."""
        return self.cameras[0].height, self.cameras[0].width

    @functools.cached_property
    def _catcher_scene(self) -> CatcherScene:
        return CatcherScene(self._of_bodies_alone(self.scene.catchers)._views, self.merged_scene)

    def _of_bodies_alone(self, numbers: tuple[int, ...]) -> "SceneRenderer":
        """Make a renderer of some bodies alone, with the receivers and spheres that they have here; it never warns."""
        scene = replace(self.scene, bodies=tuple(self.scene.bodies[number] for number in numbers))
        arguments: dict[str, Any] = self._arguments | {"scene": scene, "cameras": self.cameras}
        alone = SceneRenderer(**arguments)
        alone.merged_scene.take_spheres(self.merged_scene, numbers)
        alone.merged_scene.has_chosen_receivers = self.merged_scene.has_chosen_receivers[list(numbers)]
        alone._views.has_warned = True
        return alone

    @locked
    def layers(self, view: View | None = None) -> Layers:
        """Find depth, normals, numbers of bodies and masks: the layers beside color.

        Args:
            view: From :meth:`view`, by default the scene's own.
        Returns:
            Arrays with a leading dimension of images where a view or cameras were given. Not differentiable;
            :meth:`layer_arrays` are, and ``TorchRenderer.layers``.
        """
        has_batch = self.has_camera_batch or view is not None
        height, width = self._size
        with unrecorded():
            layers = find_layers(self._checked(view), (width, height), supersampling=self.scene.supersampling)
        return layers if has_batch else Layers(*(item[0] for item in layers))

    @locked
    def layer_arrays(self, view: View | None = None) -> LayerArrays:
        """Find the same as :meth:`layers` in arrays on the device.

        Differentiable: view, as :func:`warpshadow.pipeline.views.layers.find_layer_arrays` says.
        """
        height, width = self._size
        return find_layer_arrays(self._checked(view), (width, height), supersampling=self.scene.supersampling)

    @locked
    def shadow(self) -> np.ndarray:
        """Compute the direct light on the bodies, divided by the same light without blockers.

        All surfaces count as white. Where no light would come from, and where there is no body, it is 1.

        Returns:
            float32 of shape [height, width, 3], or [camera, height, width, 3] where cameras were given. Not
            differentiable.
        """
        if self.scene.bounces:
            arguments: dict[str, Any] = self._arguments | {"scene": replace(self.scene, bounces=0)}
            return SceneRenderer(**arguments).shadow()
        with unrecorded():
            view = self._scene_view
            ratio = shading_ratio(view, self._views.call(view))
        return ratio if self.has_camera_batch else ratio[0]

    # ------------------------------------------------------------------------------------------ explanation

    @accepts_fields_of(ViewArrays)
    @locked
    def explain(self, inputs: ViewArrays) -> Explanation:
        """List the stages that the next call computes and skips, and why.

        Args:
            inputs: All that an image takes.
        Returns:
            The stages, which print as a table: whether each runs and on how many items, how long it took last, and why
            it does or does not run; then the same of the adjoints. Nothing of the call is computed, but the coarsest
            level of textures that is seen.
        """
        return self.explain_inputs(inputs, inputs.view)

    def explain_inputs(self, inputs: ImageArrays, view: View | None = None) -> Explanation:
        """List stages, as :meth:`explain` does, by a record of its arguments."""
        hidden: set[Node] = set()
        if view is not None:
            view = self._checked(view)
            hidden = {*decide_which_nodes_run(view.receivers_node, view.call), view.silhouettes}
        else:
            view = self._views.lazy_view(inputs.geometry, inputs.clip_matrices)
        preview = view.preview()  # which the nodes' words ask, so it stays meanwhile
        light = self._method.light_input(preview, inputs.light, inputs.shell)
        materials = self.materials(inputs.of_bodies)
        image = preview.image(light, materials)
        is_host = self.device.is_cpu or self.clock.waits
        receiver_lines = receiver_notes(self._given_scene, self._choices, view.blocker_kinds.bulging_bodies)
        bounce_lines = self._transport.notes(preview, light, materials)
        blocker_lines = self._method.blocker_notes(view.blocker_kinds)
        notes = [*receiver_lines, *blocker_lines, *bounce_lines, *shell_notes(self.scene.shell)]
        return Explanation(
            image, self._views.call(view), self.clock.timings, is_host=is_host, hidden=hidden, notes=notes
        )


def _emitter_luminance(merged_scene: MergedScene) -> EmitterLuminance | None:
    """Light of emitters for the choice of receivers; None without any."""
    if not merged_scene.is_emitter.any():
        return None
    from warpshadow.pipeline.shading.emitters import SceneEmitters

    return SceneEmitters(merged_scene).direct_luminance
