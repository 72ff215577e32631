"""Reflectance: the colors of the samples of a view, from albedo of bodies and vertices and from textures."""

import copy
import operator
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import warp as wp

from warpshadow import check
from warpshadow.device.batch import concatenate
from warpshadow.device.constants import constant
from warpshadow.device.cuda_graph import is_readable
from warpshadow.pipeline.merged_scene import MergedScene
from warpshadow.pipeline.node import Input, Node, detached
from warpshadow.scene.scene import GLOSS
from warpshadow.stages.interpolation import interpolate
from warpshadow.stages.textures.footprint import find_footprints
from warpshadow.stages.textures.pyramid import mip_pyramids
from warpshadow.stages.textures.sample import sample_albedo

BodyArrays = Sequence[wp.array | None] | None
"""For each body an array, or None for the scene's own; None for all bodies' own."""


GLOSS_DEFAULTS = {"roughness": 1.0, "metallic": 0.0, "specular": 1.0}
"""Of bodies that do not say; their roughness does not count where they do not shine."""


class Reflection(NamedTuple):
    """Nodes of the samples' reflectance."""

    samples: Node  # vec3 of shape [batch, height, width]
    vertex_albedo: Node
    pyramids: Node
    footprints: Node


class Materials:
    """Reflectance of each body.

    Args:
        merged_scene: The bodies.
        albedo: Of each body, vec3 of shape [batch, 1] or [batch, vertex].
        textures: Of each body, vec3 of shape [batch, height, width], None without one.
    Attributes:
        images: The textures that there are.
        sizes: Heights and widths of the bodies' textures, None without one.
        vertex_albedo: Node of the reflectance of all vertices.
        pyramids: Node of the mip levels of the textures, all of them.
    """

    def __init__(self, merged_scene: MergedScene, albedo: Input, textures: Input):
        self.merged_scene = merged_scene
        self._take_albedo(albedo)
        self._take_textures(textures)
        self._of_scene = list(albedo.value()), list(textures.value())
        self.gloss: dict[str, Input] = {}

    def _take_albedo(self, albedo: Input) -> None:
        counts = np.diff(self.merged_scene.first_vertex).tolist()
        self.albedo, self.vertex_albedo = albedo, Node("", lambda colors: concatenate(colors, counts), albedo)

    def _take_textures(self, textures: Input) -> None:
        self.textures, images = textures, textures.value()
        self.images = [image for image in images if image is not None]
        self.sizes = tuple([None if image is None else image.shape[1:] for image in images])
        self.pyramids = self.pyramids_to(lambda: None)

    @classmethod
    def of_scene(cls, merged_scene: MergedScene) -> "Materials":
        """The scene's own materials."""

        def array(values: np.ndarray) -> wp.array:
            return wp.array(values[None], dtype=wp.vec3, device=merged_scene.device)

        bodies = merged_scene.scene.bodies
        albedo = Input("albedo", [array(np.atleast_2d(body.albedo)) for body in bodies])
        textures = Input("textures", [None if body.texture is None else array(body.texture) for body in bodies])
        materials = cls(merged_scene, albedo, textures)
        if merged_scene.is_glossy.any():
            materials.gloss = {name: Input(name, _of_bodies(merged_scene, name)) for name in GLOSS}
        return materials

    def is_black(self, number: int) -> bool:
        """Whether a body is known to reflect nothing: it is black in the scene, and nothing is given in place of it."""
        colors, images = self._of_scene
        arguments = (
            self.albedo.value()[number] is not colors[number] or self.textures.value()[number] is not images[number]
        )
        body = self.merged_scene.scene.bodies[number]
        return not arguments and not np.any(body.albedo if body.texture is None else body.texture)

    def replaced(
        self, albedo: BodyArrays, textures: BodyArrays, gloss: Mapping[str, BodyArrays] | None = None
    ) -> "Materials":
        """A copy with some materials replaced, checked; nodes of the others are shared.

        Itself where nothing is given.
        """
        shiny = self._shiny(gloss or {})
        return self._colored(albedo, textures) if shiny is self else shiny._colored(albedo, textures)

    def _shiny(self, gloss: Mapping[str, BodyArrays]) -> "Materials":
        """A copy with other roughness and the like; itself where nothing is given."""
        bodies, changed = self.merged_scene.scene.bodies, {}
        for name, arrays in gloss.items():
            values = list(self.gloss[name].value()) if self.gloss else []
            for number, array in enumerate(arrays or ()):
                if array is None:
                    continue
                if not bodies[number].is_glossy:
                    expected = "one for bodies that have roughness in the scene"
                    raise ValueError(f"{name}[{number}]: got some for {bodies[number].called!r}, expected {expected}")
                count = 1 if array.shape[1:] == (1,) else bodies[number].mesh.vertex_count
                check.shape(f"{name}[{number}]", array.shape, ("batch", count))
                check.finite_arrays({f"{name}[{number}]": array})
                values[number] = array
                changed[name] = values
        if not changed:
            return self
        materials = copy.copy(self)
        inputs = {name: Input(name, values, news=f"{name} is given") for name, values in changed.items()}
        materials.gloss = self.gloss | inputs
        return materials

    def _colored(self, albedo: BodyArrays, textures: BodyArrays) -> "Materials":
        """A copy with other albedo and textures; itself where nothing is given."""
        bodies = self.merged_scene.scene.bodies
        colors, images = list(self.albedo.value()), list(self.textures.value())
        for number, color in enumerate(albedo or ()):
            if color is not None:
                vertex_count = bodies[number].mesh.vertex_count
                check.shape(f"albedo[{number}]", color.shape, ("batch", 1 if color.shape[1:] == (1,) else vertex_count))
                check.finite_arrays({f"albedo[{number}]": color})
                self._warn_of_growth(f"albedo[{number}]", color)
                colors[number], images[number] = color, None
        for number, image in enumerate(textures or ()):
            if image is not None:
                check.shape(f"textures[{number}]", image.shape, ("batch", "height", "width"))
                if bodies[number].mesh.uvs is None:
                    raise ValueError(f"textures[{number}]: got an image, but the mesh has no uvs; expected None")
                if not image.is_contiguous:
                    raise ValueError(f"textures[{number}]: got a strided array, expected a contiguous one")
                if albedo is not None and albedo[number] is not None:
                    raise ValueError(f"albedo[{number}], textures[{number}]: got both, expected one of them")
                check.finite_arrays({f"textures[{number}]": image})
                self._warn_of_growth(f"textures[{number}]", image)
                images[number] = image
        has_colors, has_images = (
            all(map(operator.is_, *item)) for item in ((colors, self.albedo.value()), (images, self.textures.value()))
        )
        if has_colors and has_images:
            return self
        materials = copy.copy(self)
        if not has_colors:
            materials._take_albedo(Input("albedo", colors, news="albedo is given"))
        if not has_images:
            materials._take_textures(Input("textures", images, news="textures are given"))
        return materials

    def _warn_of_growth(self, name: str, values: wp.array) -> None:
        """Say, where the host need not wait for it, that more light is reflected than falls in; Python says it once."""
        if self.merged_scene.scene.bounces and is_readable(values.device) and values.numpy().max(initial=0.0) > 1:
            check.warn(
                f"{name}: got values above 1, with which light grows with each bounce, expected reflectances in "
                "[0, 1]; clamp them after each step of an optimizer, or free the input of a sigmoid",
            )

    def vertex_gloss(self, name: str) -> Node:
        """Node of the roughness of all vertices, or of their metallic or specular, float32 of shape [batch, vertex]."""
        counts = np.diff(self.merged_scene.first_vertex).tolist()
        return Node("", lambda values: concatenate(values, counts), self.gloss[name])

    @property
    def texture_of_face(self) -> wp.array:
        """Index of each face's texture, -1 for none, int32 of shape [face]."""
        has_texture = np.array([size is not None for size in self.sizes])
        texture_of_body = np.where(has_texture, np.cumsum(has_texture) - 1, -1)
        return constant(texture_of_body[self.merged_scene.body_of_face], wp.int32, self.merged_scene.device)

    def pyramids_to(self, coarsest: Callable[[], int | None]) -> Node:
        """Node of the mip levels of the textures down to the coarsest that is wanted, None for all."""

        def why_flat() -> str:
            is_flat = len(self.images) == 1 and coarsest() == 0
            return "no sample takes a coarser level of the only texture" if is_flat else ""

        return Node(
            "mip pyramids",
            lambda _: mip_pyramids(self.images, coarsest=coarsest()),
            self.textures,
            items=lambda: f"{sum(image.size for image in self.images):,} texels",
            idle=why_flat,
        )

    def footprints(self, fragments: Node, clip_positions: Node, pyramids: Node, items: Callable[[], str]) -> Node:
        """Node of the samples' footprints in the textures."""
        merged_scene = self.merged_scene
        maps = merged_scene.uvs, merged_scene.uv_faces, self.texture_of_face
        sizes = detached(pyramids, is_constant=True)  # of which it takes these alone
        arguments = fragments, merged_scene.faces, clip_positions, *maps, sizes
        return Node("footprints", find_footprints, *arguments, items=items)

    def reflection(self, fragments: Node, pyramids: Node, footprints: Node, items: Callable[[], str]) -> Reflection:
        """Nodes of the samples' reflectance by albedo and textures."""
        seen = fragments, self.merged_scene.faces, self.vertex_albedo
        samples = Node("reflectance", sample_albedo, *seen, pyramids, footprints, items=items)
        return Reflection(samples, self.vertex_albedo, pyramids, footprints)

    def plain_reflection(self, fragments: Node, items: Callable[[], str]) -> Reflection:
        """The same where no body has a texture."""
        none = [Node(name, None, idle="no body has a texture") for name in ("mip pyramids", "footprints")]
        seen = fragments, self.merged_scene.faces, self.vertex_albedo
        samples = Node("reflectance", interpolate, *seen, items=items, extra_inputs=tuple(none))
        return Reflection(samples, self.vertex_albedo, *none)


def _of_bodies(merged_scene: MergedScene, name: str) -> list[wp.array]:
    """Roughness or the like of each body, float32 of shape [1, 1] or [1, vertex]."""
    values = (getattr(body, name) for body in merged_scene.scene.bodies)
    rows = [GLOSS_DEFAULTS[name] if value is None else value for value in values]
    return [wp.array(np.atleast_2d(row), dtype=wp.float32, device=merged_scene.device) for row in rows]
