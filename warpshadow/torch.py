"""Rendering with torch tensors: images that are differentiable in light, albedo and textures.

Geometry and camera stand still, so visibility and rasterization are computed once, by any method, the ray-traced mesh
included; an iteration is a matrix product and a gather.
"""

import functools
from collections.abc import Callable, Sequence

import numpy as np
import torch
import warp as wp

from warpshadow import check
from warpshadow.basis import Basis
from warpshadow.raster import interpolate
from warpshadow.renderer import Renderer, average_samples
from warpshadow.scene import Scene
from warpshadow.shading import sample_texture


class TorchRenderer(torch.nn.Module):
    """Render a scene whose light and reflectance are tensors.

    Args:
        scene: The scene; what a call is not given is taken from it.
        device: Device of the tensors and the kernels.
        basis: What the light is expressed in: ``HarmonicBasis(order)`` or ``CellBasis(directions)``; None for what the
            scene's method computes in.
        progress: Show progress where something takes longer than a second.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        device: str | torch.device = "cpu",
        basis: Basis | None = None,
        progress: bool = False,
    ):
        super().__init__()
        self.renderer = Renderer(scene, device=str(device), basis=basis, progress=progress)
        self.device = torch.device(wp.device_to_torch(self.renderer.device))

    @functools.cached_property
    def transfer(self) -> torch.Tensor:
        """Transfer vectors to free light, shape [receiver, coefficient]."""
        return wp.to_torch(self.renderer.transfer)[0]

    @functools.cached_property
    def coverage(self) -> torch.Tensor:
        """1 where a sample sees a body, shape [height, width, 1]."""
        return torch.from_numpy(self.renderer.body_ids >= 0).to(self.device, torch.float32)[..., None]

    def forward(
        self, light: torch.Tensor | None = None, albedo: Sequence[torch.Tensor | None] | None = None
    ) -> torch.Tensor:
        """Render the image.

        Args:
            light: Coefficients of the light in ``renderer.basis``, linear RGB, float32 of shape [coefficient, 3]. By
                default the scene's light, which is shaded once, more accurately than free light can be.
            albedo: For each body, its reflectance in linear RGB, float32: one color [3], one for each vertex
                [vertex, 3], or a texture [height, width, 3], which needs uvs; None for the scene's.

        Returns:
            Linear RGB, premultiplied, and coverage, float32 of shape [height, width, 4]; the background is 0.

        Raises:
            ValueError: naming the argument, what it got and what it accepts.

        Differentiable: light, albedo. Exact, both being linear in the image.
        """
        receivers = self.renderer.receivers
        shading = wp.to_torch(self.renderer.scene_shading) if light is None else self._shade(light)
        shaded = apply(lambda values: interpolate(receivers.fragments, receivers.faces, values), shading)
        color = shaded[0] * self._albedo_image(albedo)
        samples = torch.cat([color, self.coverage], dim=-1)
        return average_samples(samples, self.renderer.scene.supersampling)

    def _shade(self, light: torch.Tensor) -> torch.Tensor:
        _check_tensor("light", light, self.device, [(self.renderer.basis.size, 3)])
        return (self.transfer @ light)[None]

    def _albedo_image(self, albedo: Sequence[torch.Tensor | None] | None) -> torch.Tensor:
        """Reflectance that the samples see, shape [height, width, 3]."""
        renderer, bodies = self.renderer, self.renderer.scene.bodies
        kept = wp.to_torch(renderer.albedo)[0]
        if albedo is None:
            return kept
        if len(albedo) != len(bodies):
            raise ValueError(f"albedo: got {len(albedo)} items, expected {len(bodies)}, one for each body")
        image = kept
        for number, (values, body) in enumerate(zip(albedo, bodies, strict=True)):
            if values is None:
                continue
            shapes = [(3,), (body.mesh.vertex_count, 3)] + [("height", "width", 3)] * (body.mesh.uvs is not None)
            _check_tensor(f"albedo[{number}]", values, self.device, shapes)
            shows = torch.from_numpy(renderer.body_ids == number).to(self.device)[..., None]
            image = torch.where(shows, self._body_albedo(number, values), image)
        return image

    def _body_albedo(self, number: int, values: torch.Tensor) -> torch.Tensor:
        renderer = self.renderer
        if values.ndim == 1:
            return values
        if values.ndim == 3:
            pixels = renderer.pixels_of(number)

            def sample(texture: wp.array) -> wp.array:
                image = wp.zeros(renderer.uvs.shape, dtype=wp.vec3, device=renderer.device, requires_grad=True)
                sample_texture(texture, pixels, renderer.uvs.flatten(), image.flatten())
                return image

            return apply(sample, values)[0]
        first, last = renderer.geometry.first_vertex[number : number + 2]
        before = torch.nn.functional.pad(values, (0, 0, int(first), int(renderer.geometry.first_vertex[-1] - last)))
        faces = renderer.geometry.faces
        return apply(lambda values: interpolate(renderer.fragments, faces, values), before[None])[0]


def apply(function: Callable[[wp.array], wp.array], values: torch.Tensor) -> torch.Tensor:
    """Apply a differentiable function of Warp arrays of vec3 to a float32 tensor of shape [..., 3]."""
    return _WarpFunction.apply(function, values)


class _WarpFunction(torch.autograd.Function):
    """Records Warp launches on a tape in forward and plays it back in backward, as often as asked."""

    @staticmethod
    def forward(ctx, function: Callable[[wp.array], wp.array], values: torch.Tensor) -> torch.Tensor:
        argument = wp.from_torch(values.detach().contiguous(), dtype=wp.vec3, requires_grad=values.requires_grad)
        with _current_stream(values):
            if not values.requires_grad:
                return wp.to_torch(function(argument), requires_grad=False)
            with wp.Tape() as tape:
                result = function(argument)
        ctx.tape, ctx.argument, ctx.result = tape, argument, result
        return wp.to_torch(result, requires_grad=False)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, gradient: torch.Tensor) -> tuple[None, torch.Tensor]:
        with _current_stream(gradient):
            # copies, since memory shared with torch is reused behind the tape's back
            wp.copy(ctx.result.grad, wp.from_torch(gradient.detach().contiguous(), dtype=wp.vec3))
            ctx.tape.backward()
            result = wp.to_torch(ctx.argument.grad, requires_grad=False).clone()
            ctx.tape.zero()
        return None, result


def _current_stream(tensor: torch.Tensor) -> wp.ScopedStream:
    """Launch on torch's current stream."""
    return wp.ScopedStream(wp.stream_from_torch(torch.cuda.current_stream(tensor.device)) if tensor.is_cuda else None)


def _check_tensor(name: str, tensor: torch.Tensor, device: torch.device, shapes: list[tuple]) -> None:
    """Raise ValueError unless a tensor has the type, the device and one of the shapes."""
    if not isinstance(tensor, torch.Tensor) or tensor.dtype != torch.float32:
        got = tensor.dtype if isinstance(tensor, torch.Tensor) else type(tensor).__name__
        raise ValueError(f"{name}: got {got}, expected a tensor of torch.float32")
    if tensor.device != device:
        raise ValueError(f"{name}: got device {tensor.device}, expected {device}")
    fitting = [shape for shape in shapes if len(shape) == tensor.ndim] or shapes[:1]
    check.shape(name, tuple(tensor.shape), fitting[0])
    if tensor.numel() == 0:
        raise ValueError(f"{name}: got shape {tuple(tensor.shape)}, expected at least one value")
    if not np.isfinite(float(tensor.detach().sum())):
        check.finite(name, tensor.detach().cpu().numpy())
