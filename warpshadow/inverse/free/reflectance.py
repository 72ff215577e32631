"""Free reflectance of a body: its colors or its texture."""

from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
import torch

from warpshadow import check
from warpshadow.inverse.free.base import FreeOfBody, Values
from warpshadow.inverse.world import FitContext, FittedScene, World
from warpshadow.pipeline.renderer import SceneRenderer
from warpshadow.scene.body import Body
from warpshadow.scene.scene import Scene
from warpshadow.scene.visibility import Visibility
from warpshadow.stages.textures.seen import fill_unseen

_SMOOTHING_LENGTH = 1e-3
"""Length of a difference of reflectances below which its variation is smooth: lengths have no derivative at 0."""
_MAX_PLAIN_DEVIATION = 1e-3  # deviation below which texels are of one color


def _one_color(body: Body) -> np.ndarray:
    """A body's albedo, or the mean over its vertices, shape [3]."""
    return np.atleast_2d(body.albedo).mean(axis=0)


def checked_size(size: Any) -> tuple[int, int]:
    """Height and width of a texture [texels]."""
    is_pair = isinstance(size, (tuple, list, np.ndarray)) and len(size) == 2
    if not is_pair or not all(check.is_integer(count) and count > 0 for count in size):
        raise ValueError(f"size: got {size!r}, expected height and width in whole texels, (256, 256)")
    return size[0], size[1]


def check_uvs(number: int, scene: Scene) -> None:
    """Raise ValueError for a body that cannot have a texture."""
    if scene.bodies[number].mesh.uvs is None:
        raise ValueError(f"body: got {number}, whose mesh has no uvs; expected uvs, as warpshadow.unwrap makes them")


def resized(image: torch.Tensor, size: tuple[int, int]) -> torch.Tensor:
    """An image [height, width, channel] of another height and width."""
    mode = "area" if size[0] <= image.shape[0] else "bilinear"
    return (
        torch.nn.functional.interpolate(image.permute(2, 0, 1)[None], size, mode=mode)[0].permute(1, 2, 0).contiguous()
    )


def variation(texels: torch.Tensor) -> torch.Tensor:
    """Mean square of differences between neighboring texels, [height, width, …]. Differentiable: texels."""
    squares = [texels.diff(dim=dim).square().sum() for dim in (0, 1)]  # sums: a single row has no mean down
    return (squares[0] + squares[1]) / texels.numel()


@dataclass(frozen=True)
class FreeOfSurface(FreeOfBody):
    """Numbers or colors of a body's surface, from where the scene has them: one, or one for each vertex, or a texture.

    Args:
        body: The body, its number or name.
        per_vertex: One for each vertex.
        size: Height and width of a texture [texels], which needs uvs; None for no texture. Texels that no view sees
            stay as they start.
        smoothness: Weight of the mean square of differences between neighboring texels.
    """

    value_key: ClassVar[str] = "value"

    per_vertex: bool = False
    size: tuple[int, int] | None = None
    smoothness: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        check.flag("per_vertex", self.per_vertex)
        check.nonnegative("smoothness", self.smoothness)
        if self.size is not None:
            object.__setattr__(self, "size", checked_size(self.size))
        if self.per_vertex and self.size is not None:
            raise ValueError(f"per_vertex: got it beside size={self.size}, expected one of them")
        if self.smoothness and self.size is None:
            raise ValueError("smoothness: got it without size, expected size, too, as of a texture")

    @property
    def is_one(self) -> bool:
        """Whether one value is free, for the whole body."""
        return not self.per_vertex and self.size is None

    @property
    def body_figures(self) -> tuple[str, ...]:
        return (self.key,) if self.is_one else ()

    def check_scene(self, scene: Scene, view_count: int) -> None:
        if self.size is not None:
            check_uvs(self.number, scene)
        elif self.per_vertex and self.rows(scene.bodies[self.number]).ndim == 3:
            raise ValueError(f"per_vertex: got it of a body whose {self.key} is a texture, expected size")

    def rows(self, body: Body) -> np.ndarray:
        """The body's values, [1, channel] or [vertex, channel], or [height, width, channel]."""
        raise NotImplementedError

    def _unit(self, context: FitContext) -> float:
        """Body's value that counts as 1."""
        return 1.0

    def start(self, context: FitContext) -> Values:
        """The body's values; their mean, where one is free."""
        body = context.scene.bodies[self.number]
        rows = self.rows(body) / self._unit(context)
        if self.per_vertex:
            return {self.value_key: context.tensor(np.broadcast_to(rows, (body.mesh.vertex_count, rows.shape[1])))}
        mean = context.tensor(rows.reshape(-1, rows.shape[-1]).mean(axis=0)[None])
        if self.size is None:
            return {self.value_key: mean}
        return {self.value_key: resized(context.tensor(rows) if rows.ndim == 3 else mean[None], self.size)}

    def regularizer(self, values: Values, context: FitContext) -> torch.Tensor | None:
        return self.smoothness * variation(values[self.value_key]) if self.smoothness else None


@check.frozen()
@dataclass(frozen=True)
class Albedo(FreeOfBody):
    """The reflectance of a body: one color, or one for each vertex.

    Args:
        body: The body, its number or name.
        per_vertex: A color for each vertex.
    """

    key = "albedo"
    scales = "reflectance"

    per_vertex: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        check.flag("per_vertex", self.per_vertex)

    @property
    def body_figures(self) -> tuple[str, ...]:
        return () if self.per_vertex else (self.key,)

    def check_scene(self, scene: Scene, view_count: int) -> None:
        if scene.bodies[self.number].texture is not None:
            raise ValueError(f"body: got {self.number}, which has a texture; expected one without, or Texture")

    def start(self, context: FitContext) -> Values:
        """The body's albedo; the mean of its vertices' colors, where one is free."""
        body = context.scene.bodies[self.number]
        if self.per_vertex:
            return {"color": context.tensor(np.broadcast_to(body.albedo, (body.mesh.vertex_count, 3)))}
        return {"color": context.tensor(_one_color(body)[None])}

    def apply(self, values: Values, context: FitContext, world: World) -> None:
        world.albedo[self.number] = values["color"]

    def project(self, values: Values) -> None:
        values["color"].clamp_(0, 1)

    def export(self, values: Values, context: FitContext, fitted: FittedScene) -> None:
        color = values["color"].cpu().numpy()
        fitted.change_body(self.number, albedo=color if self.per_vertex else color[0])


@check.frozen()
@dataclass(frozen=True)
class Texture(FreeOfBody):
    """The reflectance of a body as an image, which needs uvs.

    A texture that may be anything explains every shadow. Three weights make likely textures cheap:

    Args:
        body: The body, its number or name.
        size: Height and width [texels]; by default the size of the body's texture, or 256 × 256.
        smoothness: Weight of the mean square of differences between neighboring texels: no edges.
        total_variation: Weight of the mean length of these differences [Rudin et al. 1992]: few edges, and sharp ones.
        palette: Weight of the mean square distance of texels to the nearest of a few colors, which are free, too.
        colors: Number of these colors.
    """

    key = "texture"
    scales = "reflectance"
    excludes = {"albedo": "a texture takes its place"}

    size: tuple[int, int] | None = None
    smoothness: float = 0.0
    total_variation: float = 0.0
    palette: float = 0.0
    colors: int = 2

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.size is not None:
            object.__setattr__(self, "size", checked_size(self.size))
        for name in ("smoothness", "total_variation", "palette"):
            check.nonnegative(name, getattr(self, name))
        check.integer("colors", self.colors, minimum=2)

    @property
    def paints_shadows(self) -> bool:
        return not self.palette

    def check_scene(self, scene: Scene, view_count: int) -> None:
        check_uvs(self.number, scene)

    def start(self, context: FitContext) -> Values:
        """The body's texture, or its color: the mean of its vertices' colors, where each has one."""
        body = context.scene.bodies[self.number]
        image = _one_color(body)[None, None] if body.texture is None else body.texture
        size = self.size or ((256, 256) if body.texture is None else image.shape[:2])
        texels = resized(context.tensor(image), size)
        return {"texels": texels} | ({"palette": self._first_colors(texels)} if self.palette else {})

    def _first_colors(self, texels: torch.Tensor) -> torch.Tensor:
        """Colors of a palette, [color, 3]: quantiles of the texels by brightness; grays if all texels are alike."""
        flat = texels.reshape(-1, 3)
        quantiles = (torch.arange(self.colors, device=texels.device) + 0.5) / self.colors
        if flat.std(dim=0).max() < _MAX_PLAIN_DEVIATION:
            return quantiles[:, None].expand(-1, 3).contiguous()
        ranked_colors = flat[flat.sum(dim=1).argsort()]
        return ranked_colors[(quantiles * len(flat)).long()]

    def apply(self, values: Values, context: FitContext, world: World) -> None:
        world.textures[self.number] = values["texels"]

    def regularizer(self, values: Values, context: FitContext) -> torch.Tensor | None:
        texels = values["texels"]
        energies = []
        if self.smoothness:
            energies.append(self.smoothness * variation(texels))
        if self.total_variation:
            squares = [texels.diff(dim=dim).square() for dim in (0, 1)]
            lengths = [(square.sum(dim=-1) + _SMOOTHING_LENGTH**2).sqrt() - _SMOOTHING_LENGTH for square in squares]
            energies.append(self.total_variation * (lengths[0].sum() + lengths[1].sum()) / texels[..., 0].numel())
        if self.palette:
            gaps = (texels[:, :, None] - values["palette"]).square().sum(dim=-1)
            energies.append(self.palette * gaps.min(dim=-1).values.mean())
        return torch.stack(energies).sum() if energies else None

    def project(self, values: Values) -> None:
        for colors in values.values():
            colors.clamp_(0, 1)

    def export(self, values: Values, context: FitContext, fitted: FittedScene) -> None:
        """Cover the body; texels that no view sees get the color of the nearest one that is seen."""
        texels = values["texels"].cpu().numpy()
        fitted.change_body(self.number, texture=texels)
        unshadowed_scene = replace(fitted.scene, visibility=Visibility(method="none"), bounces=0)
        renderer = SceneRenderer(unshadowed_scene, cameras=fitted.cameras, device=str(context.device))
        fitted.change_body(self.number, texture=fill_unseen(texels, renderer.seen_texels(self.number)))
