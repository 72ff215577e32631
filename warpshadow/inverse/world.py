"""The world that a fit renders: its scene, in which free parameters have put their own tensors."""

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import ArrayLike

from warpshadow.assets.camera import Camera
from warpshadow.pipeline.bodies.geometry import Geometry
from warpshadow.scene.blockers import fit_scene_spheres
from warpshadow.scene.material import GLOSS_ARGUMENTS
from warpshadow.scene.scene import Scene
from warpshadow.scene.visibility import SPHERE_METHODS, Visibility
from warpshadow.spheres import Spheres
from warpshadow.stages.geometry.deform import DeformationGraph
from warpshadow.torch import TorchRenderer

T = TypeVar("T")

_FAR = 1e3  # distance at which a body is taken away [distances of the scene from the eye]


def format_numbers(values: ArrayLike) -> str:
    """Numbers as reports have them."""
    return ", ".join(f"{value:.4g}" for value in np.ravel(values))


class FitContext:
    """Shared by all stages of a fit: the scene at the start and the units of its parameters.

    Args:
        scene: The scene, its blockers fitted where its method has spheres.
        cameras: One for each target, of one size.
        unit: Radiance that counts as 1: the root mean square of the targets.
    """

    def __init__(self, scene: Scene, cameras: Sequence[Camera], unit: float, device: torch.device):
        self.scene = scene
        self.cameras = tuple(cameras)
        self.unit = unit
        self.device = device
        self._cached: dict[object, Any] = {}

    def cached(self, key: object, make: Callable[[], T]) -> T:
        """A result that is the same for the whole fit, by its key."""
        if key not in self._cached:
            self._cached[key] = make()
        return self._cached[key]

    @functools.cached_property
    def distances(self) -> np.ndarray:
        """Distance from the scene's middle to the eye of each view, [view, 1]: the unit of the eye's shifts."""
        low, high = zip(*(body.world_mesh().bounds for body in self.scene.bodies), strict=True)
        center = (np.min(low, axis=0) + np.max(high, axis=0)) / 2
        return np.linalg.norm([camera.eye - center for camera in self.cameras], axis=1, keepdims=True)

    def graph(self, body: int, count: int) -> DeformationGraph:
        """The deformation graph of a body, whose nodes are its spheres, even if the method casts no shadows."""

        def bind() -> DeformationGraph:
            shadowed_scene = replace(self.scene, visibility=Visibility())
            centers = fit_scene_spheres(shadowed_scene, device=str(self.device))[body].centers
            points = self.scene.bodies[body].mesh.positions
            return DeformationGraph.bind(points, centers, count=count, device=str(self.device))

        return self.cached(("graph", body, count), bind)

    def smoothing(self, body: int, count: int, weight: float) -> torch.Tensor:
        """Matrix that smooths values over the nodes of a body's graph, (I + λ L)⁻¹, [node, node]."""

        def smooth() -> torch.Tensor:
            graph = self.graph(body, count)
            pairs = graph.neighbors.numpy()
            laplacian = np.zeros((graph.node_positions.shape[0],) * 2)
            laplacian[pairs[:, 0], pairs[:, 1]] = -1
            np.fill_diagonal(laplacian, -laplacian.sum(axis=1))
            laplacian /= len(pairs) / len(laplacian)
            return self.tensor(np.linalg.inv(np.eye(len(laplacian)) + weight * laplacian))

        return self.cached(("smoothing", body, count, weight), smooth)

    def spheres(self, body: int) -> Spheres:
        """Spheres of a body in its own space."""
        return _spheres(self.scene, body)

    def middle(self, body: int) -> np.ndarray:
        """Middle of a body's bounding box in its own space, shape [3]."""
        low, high = self.scene.bodies[body].mesh.bounds
        return (low.astype(np.float64) + high) / 2

    def extent(self, body: int) -> float:
        """Half the diagonal of a body's bounding box, in its own space: the unit of its shifts.

        A turn by a radian moves vertices about as far.
        """
        low, high = self.scene.bodies[body].mesh.bounds
        return float(np.linalg.norm(high.astype(np.float64) - low) / 2)

    def tensor(self, values: np.ndarray | Sequence | float) -> torch.Tensor:
        """Numbers as a float32 tensor on the device."""
        return torch.tensor(np.asarray(values, np.float32), device=self.device)


class World:
    """A scene on its way to an image; each free parameter replaces the scene's values with its tensors.

    All are as :class:`warpshadow.torch.TorchRenderer` takes them, None for the scene's own; poses are of each body.
    """

    def __init__(self, renderer: TorchRenderer, cameras: Sequence[Camera]):
        self.renderer = renderer
        self.cameras = tuple(cameras)
        count = len(renderer.scene.bodies)
        self.light: torch.Tensor | None = None
        self.albedo: list[torch.Tensor | None] = [None] * count
        self.textures: list[torch.Tensor | None] = [None] * count
        self.gloss: dict[str, list[torch.Tensor | None]] = {name: [None] * count for name in GLOSS_ARGUMENTS}
        self.emission: list[torch.Tensor | None] = [None] * count
        self.shell: torch.Tensor | None = None
        self.rotations, self.translations, self.scales = (list(poses.unbind()) for poses in renderer.scene_poses())
        self.rest: Geometry | None = None  # the bodies in their own spaces
        self.moving: set[int] = set()  # bodies that do not stand where the scene has them
        self.clip_matrices: torch.Tensor | None = None  # of the views, [view, 4, 4]
        self.exposures: torch.Tensor | None = None  # factors of colors, [view, 1] or [view, 3], None for 1
        self.outline_offsets: torch.Tensor | None = None  # inwards [pixels of targets], [view], None for 0

    @functools.cached_property
    def geometry(self) -> Geometry | None:
        """The bodies where they were moved; None where none was."""
        if not self.moving:
            return None
        poses = (torch.stack(parts) for parts in (self.rotations, self.translations, self.scales))
        return self.renderer.placed(*poses, rest=self.rest, moving=self.moving)

    def move_out_of_view(self, number: int, context: FitContext) -> None:
        """Move a body so far that neither it nor its shadow is seen."""
        away = _FAR * float(context.distances.max()) * torch.eye(3, device=context.device)[1]
        self.translations[number] = self.translations[number] - away
        self.moving.add(number)

    def images(self) -> torch.Tensor:
        """Render the views: premultiplied linear RGB and coverage, [view, height, width, 4]; of lights in their place.

        Lights of one view may be a batch, [light, coefficient, 3].
        """
        images = self.renderer(
            self.light,
            albedo=self.albedo,
            textures=self.textures,
            emission=self.emission,
            shell=self.shell,
            geometry=self.geometry,
            clip_matrices=self.clip_matrices,
            **self.gloss,
        )
        if self.exposures is not None:
            color = images[..., :3] * self.exposures[:, None, None]
            images = torch.cat([color, images[..., 3:]], dim=-1)
        return images

    def masks(self) -> torch.Tensor:
        """Part of each pixel that each body covers, [view, body, height, width]."""
        masks = self.renderer.layers(geometry=self.geometry, clip_matrices=self.clip_matrices).masks
        return masks.reshape(len(self.cameras), -1, *masks.shape[-2:])


@dataclass
class FittedScene:
    """The fitted scene, and the fitted values that are not in the scene, such as exposures."""

    scene: Scene  # the scene; its camera is that of the first view
    cameras: list[Camera]  # of the views
    exposures: list[float]  # factors of the views' colors
    white_balances: list[tuple[float, float, float]] = field(default_factory=list)  # gains; green has 1
    outline_offsets: list[float] = field(default_factory=list)  # of the views' painted outlines [pixels]
    sun: dict[str, ArrayLike] = field(default_factory=dict)  # of a free sun, which the scene's light has

    def spheres(self, body: int) -> Spheres:
        """Spheres of a body in its own space."""
        return _spheres(self.scene, body)

    def change_body(self, number: int, **changes: Any) -> None:
        """Replace fields of a body."""
        bodies = list(self.scene.bodies)
        bodies[number] = replace(bodies[number], **changes)
        self.scene = replace(self.scene, bodies=tuple(bodies))


def _spheres(scene: Scene, body: int) -> Spheres:
    spheres = scene.bodies[body].blockers
    if scene.visibility.method in SPHERE_METHODS and isinstance(spheres, Spheres):
        return spheres
    return Spheres.concatenate([])
