"""Models: the images of a problem, and their loss, as functions of the free parameters."""

import contextlib
from collections.abc import Iterator, Mapping
from dataclasses import replace

import torch

from warpshadow.inverse.free.base import Values
from warpshadow.inverse.loss import clip_saturated
from warpshadow.inverse.problem import Problem
from warpshadow.inverse.schedule import Stage
from warpshadow.inverse.target import outlines_of, stack_targets
from warpshadow.inverse.world import FitContext, World
from warpshadow.torch import TorchRenderer

_LIGHTS_AT_ONCE = 16
_PIXELS_AT_ONCE = 65536
_SEEN_VERTICES = 0.5  # the part of all vertices that an image sees, about


class Model:
    """Images of a problem at a stage's size, and their loss against the targets."""

    def __init__(self, problem: Problem, context: FitContext, stage: Stage):
        self.problem, self.context, self.regularization = problem, context, stage.regularization
        self.cameras = tuple(camera.resized(stage.scale) for camera in context.cameras)
        self.renderer = self._make_renderer(stage)
        self.targets, self.weights, self.saturated = stack_targets(problem.targets, stage.scale, context.device)
        self.outlines = outlines_of(problem.targets, context.scene, stage.scale, context.device)
        self.compares_images = stage.compares == "all"

    def _make_renderer(self, stage: Stage) -> TorchRenderer:
        scene = self.context.scene
        scene = replace(
            scene,
            camera=self.cameras[0],
            visibility=stage.visibility(scene.visibility),
            supersampling=stage.supersampling or scene.supersampling,
        )
        camera, vertex_count = scene.camera, sum(body.mesh.vertex_count for body in scene.bodies)
        sample_count = len(self.cameras) * camera.width * camera.height * scene.supersampling**2
        is_coarse = stage.scale < 1 and sample_count < _SEEN_VERTICES * vertex_count
        if self.problem.moves and is_coarse:  # of samples and vertices, the fewer are shaded
            scene = replace(scene, bodies=tuple(replace(body, receivers="pixel") for body in scene.bodies))
        return TorchRenderer(scene, device=self.context.device, basis=self.problem.basis, cameras=self.cameras)

    def world(self, values: Mapping[str, Values]) -> World:
        """The world with values in it."""
        world = World(self.renderer, self.cameras)
        for free in self.problem.free:
            free.apply(values[free.name], self.context, world)
        return world

    def images(self, values: Mapping[str, Values]) -> torch.Tensor:
        """Images of the views, [view, height, width, 4]. Differentiable: values."""
        return self.world(values).images()

    def pixel_weights(self, images: torch.Tensor) -> torch.Tensor:
        """How much each pixel counts at images of the views: its mask times the loss's confidence, [view, height,
        width].
        """
        differences = clip_saturated(images, self.targets, self.saturated)[..., :3] - self.targets[..., :3]
        return self.weights * self.problem.loss.confidence(differences / self.context.unit)

    def loss(self, values: Mapping[str, Values]) -> tuple[torch.Tensor, torch.Tensor | None]:
        """The loss with its regularizers, and the images, if it took any. Differentiable: values."""
        total, images = self._data_loss(values)
        for free in self.problem.free:
            regularizer = free.regularizer(values[free.name], self.context)
            total = total if regularizer is None else total + self.regularization * regularizer
        return total, images

    def _data_loss(self, values: Mapping[str, Values]) -> tuple[torch.Tensor, torch.Tensor | None]:
        """Return (loss of images and outlines, images)."""
        world = self.world(values)
        total, images = torch.zeros((), device=self.context.device), None
        if self.compares_images:
            images = world.images()
            bounded_images = clip_saturated(images, self.targets, self.saturated)
            total = self.problem.loss(bounded_images, self.targets, self.weights, self.context.unit)
        if self.outlines is not None:
            masks, weight = world.masks(), self.problem.loss.coverage
            total = total + weight * self.outlines.loss(masks, world.outline_offsets)
        return total, images


class LightModel(Model):
    """Model where light alone is free and differences are squared: a quadratic form, computed without images.

    Images, without the light of emitters, are linear in the light, I_c = J_c L_c for each color c, so the loss is
    Σ_c L_cᵀ G_c L_c − 2 g_c·L_c + const with G_c = J_cᵀ W J_c and g_c = J_cᵀ W t_c, W the pixels' shares in the loss.
    Sums are float64: near the end they are small differences of large numbers.
    """

    def __init__(self, problem: Problem, context: FitContext, stage: Stage):
        super().__init__(problem, context, stage)
        assert problem.light is not None
        self.light = light = problem.light
        roots = problem.loss.pixel_shares(self.weights).sqrt()[..., None] / context.unit
        with torch.no_grad():
            black_image = self.renderer(torch.zeros(light.basis.size, 3, device=context.device))
            emitted = black_image[..., :3].reshape(self.targets[..., :3].shape)  # black where no body emits
            images = (image[..., :3] - emitted for image in self._images_of_units())
            columns = torch.cat([(image * roots).reshape(1, -1, 3) for image in images])
            target = ((self.targets[..., :3] - emitted) * roots).reshape(-1, 3)
            covered_targets = torch.cat([self.targets[..., :3], black_image[..., 3:]], dim=-1)  # but for coverage
            coverage = problem.loss(covered_targets, self.targets, self.weights, context.unit).double()
        columns, target = columns.permute(2, 0, 1), target.T[..., None]  # [color, coefficient, pixel]
        self._form = torch.stack([_product(column, column.T) for column in columns])
        self._slope = torch.stack(
            [_product(column, unit_color) for column, unit_color in zip(columns, target, strict=True)]
        )
        self._constant = coverage + target.double().square().sum()

    @staticmethod
    def applies(problem: Problem) -> bool:
        """Whether a problem is one of light alone, and of squares."""
        is_alone = problem.light is not None and len(problem.free) == 1
        is_plain = all(target.saturated is None and not target.outlines for target in problem.targets)
        return is_alone and is_plain and problem.loss.kind == "l2"

    def _images_of_units(self) -> list[torch.Tensor]:
        """Images by lights with one coefficient of 1 each, [view, height, width, 4]."""
        units = torch.eye(self.light.basis.size, device=self.context.device)[..., None].expand(-1, -1, 3).contiguous()
        if len(self.cameras) > 1:
            return [self.renderer(unit) for unit in units]
        return [image[None] for part in units.split(_LIGHTS_AT_ONCE) for image in self.renderer(part)]

    def _data_loss(self, values: Mapping[str, Values]) -> tuple[torch.Tensor, torch.Tensor | None]:
        light = self.light.coefficients(values[self.light.name], self.context).double().T[..., None]
        form = (light * (self._form @ light - 2 * self._slope)).sum()
        return (form + self._constant).float(), None


def _product(rows: torch.Tensor, columns: torch.Tensor) -> torch.Tensor:
    """A product of matrices in float64, some pixels at a time, so that no copy of all is made."""
    parts = zip(rows.split(_PIXELS_AT_ONCE, dim=1), columns.split(_PIXELS_AT_ONCE), strict=True)
    return torch.stack([row.double() @ column.double() for row, column in parts]).sum(dim=0)


@contextlib.contextmanager
def torch_on_one_thread() -> Iterator[None]:
    """Let torch compute on the calling thread alone, so that a fit is the same to the bit on any number of cores.

    Its sums depend on how many threads share them. Kernels keep their threads, on which results do not depend.
    """
    count = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(count)
