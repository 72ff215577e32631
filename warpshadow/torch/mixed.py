"""A renderer of several scenes, whose images come as one batch.

Meshes that differ have other faces and other spheres, and a launch works on one scene. So each scene has a renderer of
its own, which is called once, with all images of its scene. One scene of all bodies, of which each instance hides the
ones it does not show, would take five times as long.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, cast

import numpy as np
import torch

from warpshadow import check
from warpshadow.assets.basis import Basis, CellBasis
from warpshadow.pipeline.bodies.geometry import Geometry, as_geometry
from warpshadow.pipeline.image_inputs import ImageInputs, accepts_fields_of
from warpshadow.scene.material import INPUTS_OF_BODIES
from warpshadow.scene.scene import BodyLike, PerBody
from warpshadow.torch.autograd import check_float32, outside_torch_compile
from warpshadow.torch.renderer import TorchRenderer

_KEYWORD_REMEDIES = {
    **dict.fromkeys(
        ("camera", "cameras"),
        "clip_matrices=renderer.clip_matrices(R, t, K), R, t and K of renderer.scene_cameras(), one for each image",
    ),
    **dict.fromkeys(("poses", "rotations", "translations"), "geometry=renderer.placed(which, rotations, translations)"),
    "envmap": "light=",
}
"""Remedies for keywords that a call does not have."""

MixedTensors = ImageInputs[torch.Tensor, Sequence[Geometry[torch.Tensor] | None]]


class _Placed(list[Geometry[torch.Tensor] | None]):
    """Geometries of the scenes; ``which`` as it was when they were placed, None if one pose serves all images."""

    which: tuple[int, ...] | None = None


class MixedRenderer(torch.nn.Module):
    """Render batches whose images are of different scenes.

    ``which`` says of which scene each image is. The other arguments are as for a
    :class:`~warpshadow.torch.TorchRenderer`, with an item for each image; an argument without a batch dimension, or
    with one of 1, serves all. Scenes may have different bodies: a dimension of bodies is as long as the scene with the
    most needs it, one of vertices as the mesh with the most, and each scene reads the first items. The rest is padding,
    whose gradient is 0: ``torch.nn.utils.rnn.pad_sequence(tensors, batch_first=True)`` makes it.

    Args:
        renderers: One for each scene, of one basis, device, image size and near plane.
    Attributes:
        renderers: The same, as a ``torch.nn.ModuleList``. Each caches the results of its scene.

    It is moved, copied, pickled and saved as its renderers are, and has no parameters.
    """

    def __init__(self, renderers: Iterable[TorchRenderer]):
        super().__init__()
        self.renderers = torch.nn.ModuleList(_as_batch(renderers))
        scenes = [self._renderer(number).scene for number in range(len(self.renderers))]
        self._body_count = max(len(scene.bodies) for scene in scenes)
        self._vertex_counts: list[dict[BodyLike, int]] = [
            {key: body.mesh.vertex_count for number, body in enumerate(scene.bodies) for key in (number, body.name)}
            for scene in scenes
        ]
        self._maximum_vertices: dict[BodyLike, int] = {}  # of items with a number or a name
        for counts in self._vertex_counts:
            self._maximum_vertices |= {key: max(n, self._maximum_vertices.get(key, 0)) for key, n in counts.items()}

    @property
    def basis(self) -> Basis:
        """Basis of free light."""
        return self._renderer(0).basis

    @property
    def device(self) -> torch.device:
        """Device of its tensors."""
        return self._renderer(0).device

    @outside_torch_compile
    @accepts_fields_of(MixedTensors, **_KEYWORD_REMEDIES)
    def forward(self, which: torch.Tensor | Sequence[int], inputs: MixedTensors) -> torch.Tensor:
        """Render a batch of images.

        Lists for bodies are as long as the scene with the most has bodies. A scene passes over bodies that it has not.
        Images of roughness and the like that are as wide as the mesh with the most vertices has of them, or 1 wide,
        need the batch.

        Args:
            which: Scene of each image, from 0, whole numbers of shape [batch]. The host reads them: best on a CPU.
            inputs: All that an image takes, with an item for each image; a missing one is each scene's own. The
                geometry is from :meth:`placed` with the same ``which``; or a list of the results of the renderers' own
                ``placed``, for each scene that of its images, in their order, None where it has no image.
        Returns:
            Linear RGB, premultiplied, and coverage, float32 of shape [batch, height, width, 4]: the images of the
            renderers of each scene.
        Differentiable: all but which.
        """
        batch = _Batch(which, len(self.renderers))
        arguments: dict[int, dict[str, Any]] = {scene: {} for scene in batch.rows}
        for name, entry in inputs.of_images.items():
            for scene, part in batch.split(name, *entry).items():
                arguments[scene][name] = part
        for name, values in inputs.of_bodies.items():
            for body, tensor in self._by_body(name, values).items():
                for scene, part in self._split_item(batch, name, body, tensor).items():
                    arguments[scene].setdefault(name, {})[body] = part
        geometries = batch.of_scenes(inputs.geometry)
        return batch.join(
            {
                scene: self._renderer(scene)(geometry=geometries[scene], **arguments_of_scene)
                for scene, arguments_of_scene in arguments.items()
            }
        )

    @outside_torch_compile
    def placed(
        self,
        which: torch.Tensor | Sequence[int],
        rotations: torch.Tensor,
        translations: torch.Tensor,
        scales: torch.Tensor | None = None,
        *,
        moving: Iterable[BodyLike] | None = None,
        pivot: str | None = None,
    ) -> list[Geometry[torch.Tensor] | None]:
        """Place the bodies of each image in the world.

        Args:
            which: Scene of each image, from 0, whole numbers of shape [batch].
            rotations, translations, scales: As of a TorchRenderer, of as many bodies as the scene with the most has.
            moving: Bodies that the poses move, as of a TorchRenderer; a scene ignores bodies that it does not have.
            pivot: "center", or None, as of a TorchRenderer.
        Returns:
            For each scene the geometry of its images, None where it has none.
        Differentiable: rotations, translations, scales.
        """
        batch = _Batch(which, len(self.renderers))
        poses = [
            self._split_poses(batch, "rotations", rotations, (3, 3)),
            self._split_poses(batch, "translations", translations, (3,)),
            self._split_poses(batch, "scales", scales, ()),
        ]
        bodies = None if moving is None else self._check_bodies("moving", moving)
        geometries = _Placed([None] * len(self.renderers))
        if any(
            tensor is not None and tensor.ndim > ndim and len(tensor) > 1
            for tensor, ndim in ((rotations, 3), (translations, 2), (scales, 1))
        ):
            geometries.which = batch.numbers
        for scene in batch.rows:
            moved = None if bodies is None else [body for body in bodies if body in self._vertex_counts[scene]]
            R, t, s = (parts[scene] for parts in poses)
            geometries[scene] = self._renderer(scene).placed(R, t, s, moving=moved, pivot=pivot)
        return geometries

    @outside_torch_compile
    def scene_poses(self, *, pivot: str | None = None) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """The bodies' poses, as copies; ``poses[which]`` are the poses of images, as :meth:`placed` takes them.

        Args:
            pivot: As for :meth:`placed`.
        Returns:
            Rotations [scene, body, 3, 3], translations [scene, body, 3] and scales [scene, body], for as many bodies as
            the scene with the most has; bodies that a scene lacks stand as they are modeled.
        """
        scene_count, body_count = len(self.renderers), self._body_count
        rotations = torch.eye(3, device=self.device).repeat(scene_count, body_count, 1, 1)
        translations = torch.zeros(scene_count, body_count, 3, device=self.device)
        scales = torch.ones(scene_count, body_count, device=self.device)
        for scene in range(scene_count):
            poses_of_scene = self._renderer(scene).scene_poses(pivot=pivot)
            for all_poses, poses in zip((rotations, translations, scales), poses_of_scene, strict=True):
                all_poses[scene, : len(poses)] = poses
        return rotations, translations, scales

    @outside_torch_compile
    def scene_cameras(self) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """The cameras, as copies; ``cameras[which]`` are the cameras of images, as :meth:`clip_matrices` takes them.

        Returns:
            Rotations [scene, 3, 3] and translations [scene, 3] from the world to the camera (OpenCV's axes), and
            intrinsics [scene, 3, 3].
        """
        cameras = (self._renderer(scene).scene_cameras() for scene in range(len(self.renderers)))
        R, t, K = (torch.stack(item) for item in zip(*cameras, strict=True))
        return R, t, K

    @outside_torch_compile
    def clip_matrices(
        self, rotations: torch.Tensor, translations: torch.Tensor, intrinsics: torch.Tensor
    ) -> torch.Tensor:
        """Compose cameras for :meth:`forward`, as :meth:`TorchRenderer.clip_matrices` does. Differentiable: all."""
        return self._renderer(0).clip_matrices(rotations, translations, intrinsics)

    def _renderer(self, scene: int) -> TorchRenderer:
        return cast(TorchRenderer, self.renderers[scene])

    def _check_bodies(self, argument: str, bodies: Iterable[BodyLike]) -> list[BodyLike]:
        """Numbers and names of bodies, checked: some scene has each."""
        if not isinstance(bodies, Iterable) or isinstance(bodies, str):
            raise ValueError(f"{argument}: got {check.described(bodies)}, expected a list of bodies, such as [0]")
        known_bodies = list(bodies)
        for body in known_bodies:
            check.choice(argument, body, self._maximum_vertices)
        return known_bodies

    def _by_body(self, argument: str, tensors: PerBody[torch.Tensor] | None) -> dict[Any, torch.Tensor]:
        """Arguments for bodies, by their numbers or names."""
        if tensors is None:
            return {}
        if isinstance(tensors, Mapping):
            self._check_bodies(argument, tensors)
        else:
            count = self._body_count
            check.instance(argument, tensors, (list, tuple), f"a list of {count} items, or a mapping by bodies")
            if len(tensors) != count:
                raise ValueError(
                    f"{argument}: got {len(tensors)} items, expected {count}, one for each body of the scene with the "
                    "most"
                )
            tensors = dict(enumerate(tensors))
        return {body: tensor for body, tensor in tensors.items() if tensor is not None}

    def _split_item(self, batch: "_Batch", argument: str, body: BodyLike, tensor: Any) -> dict[int, Any]:
        """An input of a body for the images of each scene that has it, checked; without padding where of vertices."""
        name, maximum = f"{argument}[{body!r}]", self._maximum_vertices[body]
        body_input, shape = INPUTS_OF_BODIES[argument], np.shape(tensor)
        counts = {scene: self._vertex_counts[scene][body] for scene in batch.rows if body in self._vertex_counts[scene]}
        ndim = 2 if body_input.is_color else 1
        if body_input.has_rows:
            check_float32(name, tensor)
        if body_input.is_image(shape, maximum):
            parts = batch.split(name, tensor, ndim + 1)
            return {scene: parts[scene] for scene in counts}
        if body_input.is_color and len(shape) > 1 and shape[-2] != 1:
            _check_padded(name, tensor, (maximum, 3), f"or one color; the mesh with the most vertices has {maximum}")
        elif not body_input.is_color and len(shape) == 1 and shape[0] != 1:
            _check_padded(name, tensor, (maximum,), "or one number, or an image")
        return batch.split(name, tensor, ndim, counts)

    def _split_poses(
        self, batch: "_Batch", name: str, poses: torch.Tensor | None, item: tuple[int, ...]
    ) -> dict[int, Any]:
        """Poses for the images of each scene, given for as many bodies as the scene with the most has."""
        if poses is None:
            return dict.fromkeys(batch.rows)
        check_float32(name, poses)
        _check_padded(name, poses, (self._body_count, *item), "for as many bodies as the scene with the most has")
        counts = {scene: len(self._renderer(scene).scene.bodies) for scene in batch.rows}
        return batch.split(name, poses, 1 + len(item), counts)


def _check_padded(name: str, tensor: torch.Tensor, shape: tuple[int, ...], meaning: str) -> None:
    """Raise ValueError unless a tensor has a shape, or is a batch of it."""
    check.shape(name, tuple(tensor.shape), shape if tensor.ndim <= len(shape) else ("batch", *shape), meaning)


class _Batch:
    """Scenes of the images of a batch."""

    def __init__(self, which: torch.Tensor | Sequence[int], scene_count: int):
        numbers = which.tolist() if isinstance(which, torch.Tensor) else which
        if not isinstance(numbers, Sequence) or isinstance(numbers, str) or not numbers:
            raise ValueError(f"which: got {check.described(which)}, expected the scene of each image, [batch]")
        for row, scene in enumerate(numbers):
            check.index(f"which[{row}]", scene, scene_count, "scene")
        self.numbers, self.count, self._scene_count = tuple(numbers), len(numbers), scene_count
        self.rows: dict[int, list[int]] = {}
        for row, scene in enumerate(numbers):
            self.rows.setdefault(scene, []).append(row)

    def split(self, name: str, values: Any, ndim: int, counts: Mapping[int, int] | None = None) -> dict[int, Any]:
        """The values of the images of each scene: all that serve every image, or their items of a batch.

        Args:
            name: Its name in messages.
            values: A tensor; anything else is given to all.
            ndim: Dimensions of an item.
            counts: Of each scene that takes them, how long the first of these dimensions is without padding; None for
                all scenes and no padding. An item of length 1 has none.
        """
        parts = dict.fromkeys(self.rows if counts is None else counts, values)
        if not isinstance(values, torch.Tensor):
            return parts
        if values.ndim > ndim and len(values) != 1:
            if len(values) != self.count:
                raise ValueError(f"{name}: got a batch of {len(values)}, expected 1 or {self.count}, as which has")
            items = values.unbind()  # once: the gradient of a choice of items is as large as the whole
            parts = {scene: torch.stack([items[row] for row in self.rows[scene]]) for scene in parts}
        if counts is None or values.ndim < ndim or values.shape[-ndim] == 1:
            return parts
        return {scene: part.narrow(-ndim, 0, counts[scene]) for scene, part in parts.items()}

    def of_scenes(
        self, geometry: Sequence[Geometry[torch.Tensor] | None] | None
    ) -> dict[int, Geometry[torch.Tensor] | None]:
        """The geometry of each scene that has images, checked."""
        if geometry is None:
            return dict.fromkeys(self.rows)
        expected = f"a list of {self._scene_count}, one for each scene, as placed returns it"
        check.instance("geometry", geometry, (list, tuple), expected)
        if len(geometry) != self._scene_count:
            raise ValueError(f"geometry: got {len(geometry)} items, expected {expected}")
        if isinstance(geometry, _Placed) and geometry.which not in (None, self.numbers):
            raise ValueError(
                f"geometry: got that of placed with which = {check.described([*geometry.which])}, expected that of the "
                f"same which, {check.described([*self.numbers])}: its poses are those of images in their order"
            )
        for scene, geometry_of_scene in enumerate(geometry):
            count = len(self.rows.get(scene, ()))
            got = 0
            if geometry_of_scene is not None:
                positions = as_geometry(f"geometry[{scene}]", geometry_of_scene).positions
                got = len(positions) if positions.ndim > 2 else 1
            if got != count and not (got == 1 and count):
                raise ValueError(
                    f"geometry[{scene}]: got {got} instances, expected {count}, as many images as which has of the "
                    "scene: placed takes the same which"
                )
        return dict(enumerate(geometry))

    def join(self, images_of_scenes: Mapping[int, torch.Tensor]) -> torch.Tensor:
        """The images of all scenes, in the order of the batch."""
        images: dict[int, torch.Tensor] = {}
        for scene, image in images_of_scenes.items():
            rows = self.rows[scene]
            images |= zip(rows, image.expand(len(rows), *image.shape[-3:]), strict=True)
        return torch.stack([images[row] for row in range(self.count)])


def _as_batch(renderers: Iterable[TorchRenderer]) -> list[TorchRenderer]:
    """Renderers whose images are a batch, checked."""
    check.instance("renderers", renderers, Iterable, "a list of TorchRenderers, one for each scene")
    checked_renderers = list(renderers)
    if not checked_renderers:
        raise ValueError("renderers: got none, expected at least one")
    for number, renderer in enumerate(checked_renderers):
        name = f"renderers[{number}]"
        check.instance(name, renderer, TorchRenderer, "a TorchRenderer")
        if renderer.array_renderer.has_camera_batch:
            raise ValueError(f"{name}: got one with cameras of its own, expected one that has its scene's camera")
        got, expected = _batch_description(renderer), _batch_description(checked_renderers[0])
        if got != expected or not _is_same_basis(renderer.basis, checked_renderers[0].basis):
            raise ValueError(f"{name}: got {got}, expected {expected}, as the first has")
    return checked_renderers


def _batch_description(renderer: TorchRenderer) -> str:
    """Shared by renderers whose images are a batch."""
    camera, basis = renderer.cameras[0], renderer.basis
    return (
        f"{camera.width} × {camera.height} pixels, near = {camera.near:g}, {renderer.device}, and a "
        f"{type(basis).__name__} of {basis.size} coefficients"
    )


def _is_same_basis(one: Basis, other: Basis) -> bool:
    if isinstance(one, CellBasis) and isinstance(other, CellBasis):
        return np.array_equal(one.directions, other.directions)
    return one == other
