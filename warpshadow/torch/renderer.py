"""A renderer of one scene, whose arguments are tensors."""

import dataclasses
import functools
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
import warp as wp

from warpshadow import check
from warpshadow.assets.basis import Basis, describe_coefficients
from warpshadow.assets.camera import Camera
from warpshadow.device.threads import locked, with_lock_and_progress
from warpshadow.device.warp_internals import item_shape
from warpshadow.pipeline.bodies.geometry import GEOMETRY_DTYPES, Geometry, Pivot
from warpshadow.pipeline.explain import Explanation
from warpshadow.pipeline.image_inputs import ImageArrays, ImageInputs, accepts_fields_of
from warpshadow.rendering.renderer import Renderer
from warpshadow.scene.material import INPUTS_OF_BODIES
from warpshadow.scene.scene import BodyLike, PerBody, Scene
from warpshadow.stages.geometry.deform import DeformationGraph
from warpshadow.stages.geometry.poses import Poses
from warpshadow.stages.raster.project import compose_clip_matrices
from warpshadow.torch.arguments import Arguments, Slot
from warpshadow.torch.autograd import outside_torch_compile
from warpshadow.torch.replay import Replays

_KEYWORD_REMEDIES = {
    **dict.fromkeys(
        ("camera", "cameras"),
        "TorchRenderer(scene, cameras=[…]), or for free cameras clip_matrices=renderer.clip_matrices(R, t, K)",
    ),
    **dict.fromkeys(
        ("vertices", "positions"),
        "geometry=renderer.placed(R, t, rest=renderer.deformed(body, vertices)), R and t of renderer.scene_poses()",
    ),
    **dict.fromkeys(("poses", "rotations", "translations"), "geometry=renderer.placed(rotations, translations)"),
    "envmap": "light=",
}
"""Remedies for keywords that a call does not have."""


ImageTensors = ImageInputs[torch.Tensor, Geometry[torch.Tensor]]
ImageSlots = ImageInputs[Slot, Geometry[Slot]]


class LayerTensors(NamedTuple):
    """Layers of images beside color, with a batch dimension before the others where images have one."""

    depth: torch.Tensor
    """Distance along the view [scene units] at pixel centers, 0 where nothing is; [height, width]."""
    normals: torch.Tensor
    """Unit normals in the world at pixel centers, towards the camera's side of open surfaces; [height, width, 3]."""
    bodies: torch.Tensor
    """Number of the body at pixel centers, from 0, −1 for none; int32 of [height, width]. Not differentiable."""
    masks: torch.Tensor
    """Part of each pixel that each body covers; [body, height, width]."""

    def __repr__(self) -> str:
        return f"LayerTensors({self.masks.shape[-1]} × {self.masks.shape[-2]}, {self.masks.shape[-3]} bodies)"

    @property
    def coverage(self) -> torch.Tensor:
        """Part of each pixel that any body covers, the alpha of the image; [height, width]."""
        return self.masks.sum(dim=-3)


class TorchRenderer(torch.nn.Module):
    """Render a scene whose light, reflectance, geometry and camera are tensors.

    Tensors are float32 on the renderer's device. One without a batch dimension, or with one of 1, serves all instances.
    Images are linear RGB, premultiplied with coverage, and coverage, [height, width, 4], row 0 on top. Rotations are
    matrices that take points of a mesh to the right-handed world, whose y is up: :func:`rotation_matrices` makes them
    of axis-angle vectors in radians (``Body.rotation`` is in degrees). Cameras have OpenCV's axes.

    Args:
        scene: The scene; arguments that a call omits are taken from it.
        cameras: In place of the scene's camera any number of them, of one size and near plane, whose images are a
            batch.
        device: Device of the tensors and the kernels.
        basis: Basis of free light: ``HarmonicBasis(order)`` or ``CellBasis(directions)``; None for the native basis of
            the scene's method.
        graphs: Whether calls that come again with tensors of the same shapes are captured as graphs and replayed where
            that is faster (:mod:`warpshadow.torch.replay`); on a GPU it has not been tested.
    Attributes:
        replays: The captured calls; ``replays.reason`` says why the last call was not replayed.
        array_renderer: The :class:`warpshadow.Renderer` of Warp's arrays that it calls; most users need it not.

    Functions under ``torch.compile`` may call it: it and the functions of this package run as they are, between parts
    that are compiled, so ``fullgraph=True`` refuses them.

    Threads may share it, and it can be copied and pickled, as :class:`warpshadow.Renderer` can. It has no parameters.
    ``to`` and ``cuda`` move it, which computes all anew there; ``half`` and ``double`` are refused. Its ``state_dict``
    holds the meaning of tensors beside it: the basis of the light, and the bodies with their numbers of vertices.
    ``load_state_dict`` raises ValueError where they are others.
    """

    @outside_torch_compile
    def __init__(
        self,
        scene: Scene,
        *,
        cameras: Sequence[Camera] | None = None,
        device: str | torch.device = "cpu",
        basis: Basis | None = None,
        progress: bool = True,
        graphs: bool = False,
    ):
        super().__init__()
        self.replays = Replays(is_on=check.flag("graphs", graphs))
        self.array_renderer = Renderer(scene, cameras=cameras, device=str(device), basis=basis, progress=progress)

    @property
    def scene(self) -> Scene:
        """The scene; a method "auto" has been replaced by the chosen one."""
        return self.array_renderer.scene

    def extra_repr(self) -> str:
        """Its bodies and images, for its repr."""
        return repr(self.array_renderer)

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """The cameras whose images a call makes: ``cameras``, or the scene's."""
        return self.array_renderer.cameras

    @property
    def basis(self) -> Basis:
        """Basis of free light."""
        return self.array_renderer.basis

    @property
    def device(self) -> torch.device:
        """Device of its tensors."""
        return torch.device(wp.device_to_torch(self.array_renderer.device))

    @property
    def progress(self) -> bool:
        """Whether it shows its progress."""
        return self.array_renderer.progress

    def _apply(self, fn: Callable[[torch.Tensor], torch.Tensor], recurse: bool = True) -> "TorchRenderer":
        """Go where a tensor would go: torch calls this for ``to``, ``cuda``, ``half`` and the like."""
        try:
            moved = fn(torch.empty(0, device=self.device))
        except (AssertionError, RuntimeError):
            if not torch.cuda.is_available():
                check.device("device", "cuda")  # which raises an error that says so
            raise
        if moved.dtype != torch.float32:
            raise ValueError(
                f"dtype: got {moved.dtype} for a TorchRenderer, expected torch.float32, as it computes in: "
                "convert the other modules alone"
            )
        if moved.device != self.device:
            self.array_renderer = self.array_renderer.moved(str(moved.device))
        return super()._apply(fn, recurse)

    def get_extra_state(self) -> torch.Tensor:
        """Meaning of tensors beside it, for ``state_dict``: JSON as bytes, since some formats hold tensors alone."""
        bodies = [[body.name, body.mesh.vertex_count] for body in self.scene.bodies]
        meaning = {"basis": type(self.basis).__name__, "coefficients": self.basis.size, "bodies": bodies}
        return torch.tensor(list(json.dumps(meaning).encode()), dtype=torch.uint8)

    def set_extra_state(self, state: torch.Tensor) -> None:
        """Raise ValueError unless a ``state_dict`` is of a renderer whose tensors mean the same."""
        stored_meaning, expected = (bytes(item.tolist()).decode() for item in (state, self.get_extra_state()))
        if stored_meaning != expected:
            raise ValueError(f"state_dict: got that of a TorchRenderer with {stored_meaning}, expected {expected}")

    @outside_torch_compile
    @accepts_fields_of(ImageTensors, **_KEYWORD_REMEDIES)
    @with_lock_and_progress
    def forward(self, inputs: ImageTensors) -> torch.Tensor:
        """Render images.

        Args:
            inputs: All that an image takes.
        Returns:
            Linear RGB, premultiplied, and coverage, float32 of shape [height, width, 4], or [batch, height, width, 4]
            where an argument has a batch dimension or the renderer's own cameras have; the background is 0.
        Differentiable: all; by "ray-traced" not geometry, clip_matrices and shell. stages/README.md says how exactly.
            Gradients to light and emission,
            and where no light bounces to albedo and textures, may be differentiated again, in all tensors;
            others raise NotImplementedError then.
        """
        arguments, slots = self._slots_of(inputs)
        affine_inputs = ("light", "emission") if self.scene.bounces else ("light", "emission", "albedo", "textures")
        affine = [name for name in arguments.names if name.startswith(affine_inputs)]
        return arguments.apply(self.array_renderer.draw_inputs, slots, affine=affine, replays=self.replays)

    @outside_torch_compile
    @locked
    def layers(
        self, *, geometry: Geometry[torch.Tensor] | None = None, clip_matrices: torch.Tensor | None = None
    ) -> LayerTensors:
        """Find layers beside color: depth, normals, bodies and their masks.

        Args:
            geometry, clip_matrices: As for :meth:`forward`.
        Differentiable: geometry, clip_matrices. Depth and normals change as the surface at a pixel's center moves, and
            have no gradient for another that comes in front of it; masks and coverage have that of silhouettes, as
            images have.
        """
        arguments, slots = self._slots_of(ImageInputs(geometry=geometry, clip_matrices=clip_matrices))

        def find(inputs: ImageArrays) -> tuple[wp.array, ...]:
            result = self.array_renderer.layer_arrays(self.array_renderer.view(inputs.geometry, inputs.clip_matrices))
            return (*result[:3], *result.masks)

        depth, normals, bodies, *quartets = arguments.apply(find, slots)
        masks = torch.cat(quartets, dim=-1)[..., : len(self.scene.bodies)]
        return LayerTensors(depth, normals, bodies, masks.movedim(-1, -3))

    @outside_torch_compile
    @accepts_fields_of(ImageTensors, **_KEYWORD_REMEDIES)
    @with_lock_and_progress
    def insert(self, photograph: torch.Tensor, inputs: ImageTensors) -> torch.Tensor:
        """Render the bodies in a photograph whose surfaces the scene's shadow catchers model.

        Args:
            photograph: Linear RGB, of radiance in the units of the light, of the size of the cameras' images,
                [height, width, 3] or [batch, height, width, 3].
            inputs: All that an image takes.
        Returns:
            Linear RGB, [height, width, 3] or [batch, height, width, 3]; see :mod:`warpshadow.stages.image.photograph`.
        Raises:
            ValueError: where no body of the scene is a catcher.
        Differentiable: all, as :meth:`forward` is, but once; both the light with and that without the other bodies are.
        """
        arguments, slots = self._slots_of(inputs)
        size = self.cameras[0].height, self.cameras[0].width
        photograph_slot = arguments.add("photograph", photograph, wp.vec3, size, "linear RGB")
        return arguments.apply(self.array_renderer.insert_inputs, photograph_slot, slots)

    @outside_torch_compile
    @accepts_fields_of(ImageTensors, **_KEYWORD_REMEDIES)
    @locked
    def explain(self, inputs: ImageTensors) -> Explanation:
        """List the stages that a call with the same arguments computes and skips, as :meth:`Renderer.explain` does.

        Args:
            inputs: All that an image takes.
        """
        arguments, slots = self._slots_of(inputs)
        return self.array_renderer.explain_inputs(arguments.filled(slots))

    def _slots_of(self, inputs: ImageTensors) -> tuple[Arguments, ImageSlots]:
        """The tensors of an image, checked, and its inputs with slots in their place."""
        light, geometry, clip_matrices = inputs.light, inputs.geometry, inputs.clip_matrices
        has_cameras = self.array_renderer.has_camera_batch and clip_matrices is None
        arguments = Arguments(self.device, cameras=self.cameras if has_cameras else None)
        slots: dict[str, Any] = {}
        if isinstance(light, torch.Tensor):
            description = describe_coefficients(self.basis, light.shape[-2] if light.ndim > 1 else 0)
            if light.ndim == 3 and light.shape[1] == 2 * light.shape[0]:
                description += (
                    "; of a map [height, width, 3] that is known, light=EnvironmentMap(map.numpy()); its coefficients "
                    "are torch.as_tensor(renderer.basis.coefficients(EnvironmentMap(map.numpy())), dtype=torch.float32)"
                )
            slots["light"] = arguments.add("light", light, wp.vec3, (self.basis.size,), description)
        elif isinstance(light, np.ndarray):  # which a renderer takes for known light
            raise ValueError("light: got ndarray, expected a tensor of torch.float32: torch.as_tensor makes one")
        if geometry is not None:
            slots["geometry"] = arguments.add_geometry("geometry", geometry, self.array_renderer.rest())
        if clip_matrices is not None:
            slots["clip_matrices"] = arguments.add("clip_matrices", clip_matrices, wp.mat44, ())
        if inputs.shell is not None:
            slots["shell"] = arguments.add("shell", inputs.shell, wp.vec4, (), "its center and radius")
        for name, values in inputs.of_bodies.items():
            of_bodies: list[Slot | None] = [None] * len(self.scene.bodies)
            for number, tensor in enumerate(self.scene.per_body(values, name)):
                if tensor is not None:
                    message_name = self._item_name(name, values, number)
                    body_rows = self._body_rows(name, number, tensor)
                    of_bodies[number] = arguments.add(f"{name}[{number}]", *body_rows, message_name=message_name)
            slots[name] = of_bodies
        filled_inputs: Any = dataclasses.replace(inputs, **slots)  # tensors without a slot stay, and fail
        return arguments, filled_inputs

    def _body_rows(
        self, name: str, number: int, tensor: torch.Tensor
    ) -> tuple[torch.Tensor, type, tuple[int | str, ...], str]:
        """A tensor of a body as rows or images of items, their dtype, the shape to expect, and a remedy."""
        body_input, mesh = INPUTS_OF_BODIES[name], self.scene.bodies[number].mesh
        dtype = wp.vec3 if body_input.is_color else wp.float32
        item, can_be_image = item_shape(dtype), mesh.uvs is not None or not body_input.has_rows
        if can_be_image and body_input.is_image(np.shape(tensor), mesh.vertex_count):
            remedy = check.channels_last(np.shape(tensor)) if body_input.is_color else ""
            return tensor, dtype, ("height", "width"), remedy
        if isinstance(tensor, torch.Tensor) and tuple(tensor.shape) == item:  # one for the whole body
            tensor = tensor[None]
        shape = np.shape(tensor)
        counts = shape[: len(shape) - len(item)][-1:]
        return tensor, dtype, counts if counts in ((), (1,)) else (mesh.vertex_count,), ""

    def _item_name(self, argument: str, values: PerBody[torch.Tensor] | None, number: int) -> str:
        """Name of an item for a body in messages: by the name of the body where that was given."""
        keys = values if isinstance(values, Mapping) else ()
        return f"{argument}[{next((repr(key) for key in keys if self.scene.body_number(key) == number), number)}]"

    @outside_torch_compile
    @locked
    def placed(
        self,
        rotations: torch.Tensor,
        translations: torch.Tensor,
        scales: torch.Tensor | None = None,
        *,
        rest: Geometry[torch.Tensor] | None = None,
        moving: Iterable[BodyLike] | None = None,
        pivot: str | torch.Tensor | None = None,
    ) -> Geometry[torch.Tensor]:
        """Place the bodies in the world: x → s R (x − pivot) + t.

        Args:
            rotations: Of each body, [body, 3, 3] or [batch, body, 3, 3], from :func:`rotation_matrices`. Entries of RᵀR
                may differ from the identity by 0.05, which a step of 0.01 in each of the nine numbers leaves them; to
                go on from there, ``rotation_matrices(rotations.flatten(-2))`` are the nearest rotations.
            translations: Of each body [scene units], [body, 3] or [batch, body, 3].
            scales: Of each body, [body] or [batch, body]; by default the scene's.
            rest: The bodies in their own spaces, from :meth:`deformed`; by default as their meshes are.
            moving: Bodies that the poses move, by number or name; None for any. The others stand where the scene has
                them, without a gradient, and results about them are cached, but not where light bounces or is near,
                with lamps, or by rays. By "directional" these come from rays against their meshes, so that they shadow
                each other by meshes. Bodies that ``rest`` deforms count as moving.
            pivot: Point of each body's own space that it is turned about and that ``translations`` put in its place:
                "center", the middle of its mesh's bounds, or points, [body, 3] or [batch, body, 3]; None for the
                origin, which is the one of the mesh's file. ``scene_poses(pivot=…)`` are the poses to begin with.
        Returns:
            Vertices and spheres for :meth:`forward`, with a batch dimension if an argument has one; tensors of their
            own, which may be written to. Who changes a body's shape that way gives a geometry without ``rotations``:
            with them the body's shadow on itself is that of its mesh.
        Differentiable: all.
        """
        count = len(self.scene.bodies)
        scales = self.scene_poses()[2] if scales is None else scales
        arguments = Arguments(self.device)
        all_bodies = f"of all {count} bodies, as scene_poses() has them"
        remedy = f"matrices {all_bodies}; rotation_matrices(…) makes them of axis-angle vectors and quaternions"
        pose_slots = [
            arguments.add("rotations", rotations, wp.mat33, (count,), remedy),
            arguments.add("translations", translations, wp.vec3, (count,), all_bodies),
            arguments.add("scales", scales, wp.float32, (count,), all_bodies),
        ]
        pivot_slot: Any = pivot
        if isinstance(pivot, torch.Tensor):
            pivot_slot = arguments.add("pivot", pivot, wp.vec3, (count,), "a point of each body's own space")
        arguments.expand()
        rest_slots = None if rest is None else arguments.add_geometry("rest", rest, self.array_renderer.rest())

        def place(poses: list[wp.array], rest: Geometry[wp.array] | None, pivot: Pivot) -> Geometry[wp.array]:
            return self.array_renderer.placed(Poses(*poses), rest, moving=moving, pivot=pivot)

        placed: Geometry[torch.Tensor] = arguments.apply(place, pose_slots, rest_slots, pivot_slot)
        return placed

    @outside_torch_compile
    def scene_poses(
        self, *, pivot: str | torch.Tensor | None = None
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """The bodies' poses as :meth:`placed` takes them, as copies.

        Args:
            pivot: As for :meth:`placed`, without a batch: translations are then where the pivots are.
        Returns:
            Rotations [body, 3, 3], which multiply column vectors, translations [body, 3] and scales [body].
        """
        points = pivot.detach().cpu().numpy() if isinstance(pivot, torch.Tensor) else pivot
        poses = self.array_renderer.scene_poses(pivot=points)
        rotations, translations, scales = (
            wp.to_torch(array)[0].clone() for array in (poses.rotations, poses.translations, poses.scales)
        )
        return rotations, translations, scales

    @outside_torch_compile
    def scene_cameras(self) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """The cameras as :meth:`clip_matrices` takes them, as copies; one camera has no batch.

        Returns:
            Rotations [camera, 3, 3] and translations [camera, 3] from the world to the camera (OpenCV's axes), and
            intrinsics [camera, 3, 3]; [3, 3], [3] and [3, 3] of the scene's own camera.
        """
        names = "rotation", "translation", "intrinsics"
        stacked_arrays = (np.stack([getattr(camera, name) for camera in self.cameras]) for name in names)
        camera_tensors = (torch.tensor(item, dtype=torch.float32, device=self.device) for item in stacked_arrays)
        R, t, K = camera_tensors if self.array_renderer.has_camera_batch else (item[0] for item in camera_tensors)
        return R, t, K

    @outside_torch_compile
    @locked
    def deformed(
        self,
        body: BodyLike,
        positions: torch.Tensor | None = None,
        centers: torch.Tensor | None = None,
        radii: torch.Tensor | None = None,
        *,
        rest: Geometry[torch.Tensor] | None = None,
    ) -> Geometry[torch.Tensor]:
        """Exchange the shape of one body at rest, as :meth:`warpshadow.Renderer.deformed` does.

        Args:
            body, rest: As there.
            positions, centers, radii: As there, [vertex, 3], [sphere, 3] and [sphere], each maybe with a batch before.
        Returns:
            All bodies at rest, for :meth:`placed`; tensors of their own, which may be written to.
        Differentiable: all.
        """
        parts = {"positions": positions, "centers": centers, "radii": radii}
        arguments = Arguments(self.device)
        slots = [
            None if tensor is None else arguments.add(name, tensor, GEOMETRY_DTYPES[name], ("item",))
            for name, tensor in parts.items()
        ]
        rest_slots = None if rest is None else arguments.add_geometry("rest", rest, self.array_renderer.rest())
        deformed: Geometry[torch.Tensor] = arguments.apply(
            lambda rest, *arrays: self.array_renderer.deformed(body, *arrays, rest=rest), rest_slots, *slots
        )
        return deformed

    @outside_torch_compile
    def deformation_graph(self, body: BodyLike, *, count: int = 4) -> DeformationGraph:
        """Bind the vertices of a body to its spheres, which are the nodes, as :meth:`Renderer.deformation_graph` does.

        Its functions take Warp's arrays: ``apply(graph.points, matrices, shifts, dtypes=(wp.mat33, wp.vec3))``.
        """
        return self.array_renderer.deformation_graph(body, count=count)

    @outside_torch_compile
    def clip_matrices(
        self, rotations: torch.Tensor, translations: torch.Tensor, intrinsics: torch.Tensor
    ) -> torch.Tensor:
        """Compose cameras for :meth:`forward`, which have the size and the near plane of the renderer's own.

        Args:
            rotations: R, world to camera, [3, 3] or [batch, 3, 3].
            translations: t, world to camera [scene units], [3] or [batch, 3].
            intrinsics: K [pixels], last row (0, 0, 1), [3, 3] or [batch, 3, 3].
        Returns:
            Maps from world to clip space, [4, 4] or [batch, 4, 4].
        Differentiable: all, so focal lengths and the principal point, too.
        """
        camera = self.cameras[0]
        arguments = Arguments(self.device)
        compose = functools.partial(compose_clip_matrices, size=(camera.width, camera.height), near=camera.near)
        return arguments.apply(
            compose,
            arguments.add("intrinsics", intrinsics, wp.mat33, ()),
            arguments.add("rotations", rotations, wp.mat33, ()),
            arguments.add("translations", translations, wp.vec3, ()),
        )
