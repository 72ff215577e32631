"""Materials of bodies; the colors of the samples of a view, from albedo of bodies and vertices and from textures."""

import copy
import functools
import operator
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import warp as wp

from warpshadow import check
from warpshadow.device.array_checks import finite_arrays, postpone
from warpshadow.device.batch import concatenate
from warpshadow.device.constants import constant, gather_of_owners
from warpshadow.device.cuda_graph import is_readable
from warpshadow.device.warp_internals import item_shape
from warpshadow.pipeline.bodies.merged_scene import MergedScene
from warpshadow.pipeline.node import Input, Node, detached
from warpshadow.scene.material import GLOSS_ARGUMENTS, GLOSS_DEFAULTS, INPUTS_OF_BODIES, MATERIAL_FIELDS
from warpshadow.stages.raster.interpolation import interpolate
from warpshadow.stages.textures.footprint import find_footprints
from warpshadow.stages.textures.numbers import as_colors
from warpshadow.stages.textures.pyramid import mip_pyramids
from warpshadow.stages.textures.sample import sample_albedo

BodyArrays = Sequence[wp.array | None] | None
"""For each body an array, or None for the scene's own; None for all bodies' own."""


_LIMITS = {field.name: (field.minimum, field.maximum) for field in MATERIAL_FIELDS} | {"emission": (0.0, check.LARGEST)}


_MIN_CODE = 5.0  # mean from which on colors are codes from 0 to 255, and not reflectances that left [0, 1] in a fit


class SampleReflectance(NamedTuple):
    """Nodes of the samples' reflectance."""

    samples: Node  # vec3 of shape [batch, height, width]
    vertex_albedo: Node
    pyramids: Node
    footprints: Node


class BodyTextures:
    """The textures of bodies, of their reflectance or of their roughness or the like.

    Args:
        merged_scene: The bodies.
        source: Input of an array for each body; those of shape [batch, height, width] are textures, vec3 or float32.
    Attributes:
        images: The textures that there are.
        sizes: Heights and widths of the bodies' textures, None without one.
        pyramids: Node of the mip levels of the textures, all of them; numbers are grays.
    """

    def __init__(self, merged_scene: MergedScene, source: Input):
        self._merged_scene, self._source = merged_scene, source
        of_bodies = [image if image is not None and image.ndim == 3 else None for image in source.value()]
        self.images = [image for image in of_bodies if image is not None]
        self.sizes = tuple([None if image is None else image.shape[1:] for image in of_bodies])
        self.pyramids = self.pyramids_to(lambda: None)

    @property
    def texture_of_face(self) -> wp.array:
        """Index of each face's texture, -1 for none, int32 of shape [face]."""
        has_texture = np.array([size is not None for size in self.sizes])
        texture_of_body = np.where(has_texture, np.cumsum(has_texture) - 1, -1)
        return constant(
            gather_of_owners(texture_of_body, self._merged_scene.body_of_face), wp.int32, self._merged_scene.device
        )

    def pyramids_to(self, coarsest: Callable[[], int | None]) -> Node:
        """Node of the mip levels of the textures down to the coarsest that is wanted, None for all."""
        images = self.images

        def why_flat() -> str:
            is_flat = len(images) == 1 and coarsest() == 0
            return "no sample takes a coarser level of the only texture" if is_flat else ""

        return Node(
            "mip pyramids",
            lambda _: mip_pyramids([*map(as_colors, images)], coarsest=coarsest()),
            self._source,
            items=lambda: f"{sum(image.size for image in images):,} texels",
            why_idle=why_flat,
        )

    def footprints(self, fragments: Node, clip_positions: Node, pyramids: Node, items: str) -> Node:
        """Node of the samples' footprints in the textures."""
        merged_scene = self._merged_scene
        maps = merged_scene.uvs, merged_scene.uv_faces, self.texture_of_face
        sizes = detached(pyramids, is_constant=True)  # of which it takes these alone
        arguments = fragments, merged_scene.faces, clip_positions, *maps, sizes
        return Node("footprints", find_footprints, *arguments, items=items)


class Materials:
    """Reflectance, numbers of gloss and emission of each body.

    Args:
        merged_scene: The bodies.
        inputs: Arrays of each body, by name: "albedo", vec3 of shape [batch, 1] or [batch, vertex]; "textures", vec3 of
            shape [batch, height, width], None without one; where a body shines, those of GLOSS_ARGUMENTS, float32
            of shape [batch, 1], [batch, vertex] or, a texture, [batch, height, width]; and where one emits, "emission",
            as albedo, or as a texture.
    Attributes:
        albedo, textures, roughness, emission: These inputs; None where no body shines, and where none emits.
        vertex_albedo: Node of the reflectance of all vertices.
        textures_of: By name, the textures among an input's arrays.
    """

    def __init__(self, merged_scene: MergedScene, inputs: dict[str, Input]):
        self.merged_scene, self._inputs, self._of_scene = merged_scene, inputs, inputs
        self.textures_of: dict[str, BodyTextures] = {}
        self._make_nodes(inputs)

    def _make_nodes(self, changed: Collection[str]) -> None:
        """Make the nodes of inputs that changed."""
        self.albedo, self.textures = self._inputs["albedo"], self._inputs["textures"]
        self.roughness, self.emission = self._inputs.get("roughness"), self._inputs.get("emission")
        if "albedo" in changed:
            self.vertex_albedo = self.of_vertices("albedo")
        textures = {
            name: BodyTextures(self.merged_scene, self._inputs[name])
            for name in changed
            if INPUTS_OF_BODIES[name].has_images
        }
        self.textures_of = self.textures_of | textures

    @classmethod
    def of_scene(cls, merged_scene: MergedScene) -> "Materials":
        """The scene's own materials."""

        def array(values: np.ndarray) -> wp.array:
            return wp.array(values[None], dtype=wp.vec3, device=merged_scene.device)

        bodies = merged_scene.scene.bodies
        arrays: dict[str, list[wp.array | None]] = {
            "albedo": [array(np.atleast_2d(body.albedo)) for body in bodies],
            "textures": [None if body.texture is None else array(body.texture) for body in bodies],
        }
        if merged_scene.is_glossy.any():
            arrays |= {name: _of_bodies(merged_scene, name) for name in GLOSS_ARGUMENTS}
        if merged_scene.is_emitter.any():
            emission = [np.zeros(3) if body.emission is None else body.emission for body in bodies]
            arrays["emission"] = [array(np.atleast_2d(colors)) for colors in emission]
        return cls(merged_scene, {name: Input(name, values) for name, values in arrays.items()})

    def input_of(self, name: str) -> Input:
        """The arrays of each body, by name, as given."""
        return self._inputs[name]

    @property
    def have_patterns(self) -> bool:
        """Whether a body has several colors: of its vertices, or of a texture."""
        sources = (self._inputs[name].value() for name in ("albedo", "textures", "emission") if name in self._inputs)
        return any(array.shape[1:] != (1,) for arrays in sources for array in arrays if array is not None)

    def is_black(self, number: int) -> bool:
        """Whether a body is known to reflect nothing: black in the scene, without gloss, and no color is given."""
        if self.merged_scene.is_glossy[number]:
            return False
        for name in ("albedo", "textures"):
            if self._inputs[name].value()[number] is not self._of_scene[name].value()[number]:
                return False
        body = self.merged_scene.scene.bodies[number]
        return not np.any(body.albedo if body.texture is None else body.texture)

    @property
    def metals(self) -> list[int]:
        """Bodies that shine and may be metals: they are in the scene, or a call says how metallic they are."""
        values, scene_values = (inputs["metallic"].value() for inputs in (self._inputs, self._of_scene))
        bodies = self.merged_scene.scene.bodies
        return [
            number
            for number in np.flatnonzero(self.merged_scene.is_glossy).tolist()
            if values[number] is not scene_values[number] or np.any(bodies[number].metallic)
        ]

    def replaced(self, replacements: Mapping[str, BodyArrays]) -> "Materials":
        """A copy with other arrays of some bodies, by name, checked; nodes of the others are shared.

        An albedo takes the place of a texture, too. Itself where nothing is given.
        """
        values = {name: list(source.value()) for name, source in self._inputs.items()}
        colored = {number for name, number, _ in _arrays_of(replacements) if name == "albedo"}
        for name, number, array in _arrays_of(replacements):
            self._check(name, number, array)
            if name == "textures" and number in colored:
                raise ValueError(f"albedo[{number}], textures[{number}]: got both, expected one of them")
            values[name][number] = array
            if name == "albedo":
                values["textures"][number] = None
        changed = {
            name: Input(name, arrays, why_new=f"{name} {'are' if name == 'textures' else 'is'} given")
            for name, arrays in values.items()
            if not all(map(operator.is_, arrays, self._inputs[name].value()))
        }
        if not changed:
            return self
        materials = copy.copy(self)
        materials._inputs = self._inputs | changed
        materials._make_nodes(changed)
        return materials

    def _check(self, name: str, number: int, array: wp.array) -> None:
        """Raise ValueError for an array that is not one of a body."""
        body, where, body_input = self.merged_scene.scene.bodies[number], f"{name}[{number}]", INPUTS_OF_BODIES[name]
        if name in GLOSS_ARGUMENTS and not body.is_glossy:
            expected = "one for bodies that have roughness in the scene, such as Body(…, roughness=0.5)"
            raise ValueError(f"{where}: got some for {body.name!r}, expected {expected}")
        if name == "emission" and body.emission is None:
            raise ValueError(f"{where}: got some for {body.name!r}, expected one for bodies that have it in the scene")
        if body_input.has_images and (array.ndim == 3 or not body_input.has_rows):
            check.shape(where, array.shape, ("batch", "height", "width"))
            if body.mesh.uvs is None:
                raise ValueError(
                    f"{where}: got an image, but the mesh of {body.name!r} has no uvs; expected None, or a body of "
                    "warpshadow.unwrap(mesh)"
                )
            if not array.is_contiguous:
                raise ValueError(f"{where}: got a strided array, expected a contiguous one")
        else:
            check.shape(where, array.shape, ("batch", 1 if array.shape[1:] == (1,) else body.mesh.vertex_count))
        minimum, maximum = _LIMITS.get(name, (-check.LARGEST, check.LARGEST))
        finite_arrays({where: array}, minimum=minimum, maximum=maximum)
        if name in ("albedo", "textures"):
            self._check_colors(where, array)

    def _check_colors(self, name: str, values: wp.array) -> None:
        """Refuse codes of a picture, and warn where light would grow, if the host need not wait for the values."""
        if postpone(values, functools.partial(self._check_colors, name, values)):
            return
        colors = values.numpy() if is_readable(values.device) else np.zeros(0)
        largest = colors.max(initial=0.0)
        if largest > _MIN_CODE and colors.mean() > _MIN_CODE:
            check.reflectance(name, colors)
        if self.merged_scene.scene.bounces and largest > 1:
            check.warn(
                f"{name}: got values above 1, with which light grows with each bounce, expected reflectances in "
                "[0, 1]; clamp them after each step of an optimizer, or free the input of a sigmoid"
            )

    def of_vertices(self, name: str) -> Node:
        """Node of an input of all vertices, such as their roughness, [batch, vertex]; 0 where a texture has it."""
        counts = np.diff(self.merged_scene.first_vertex).tolist()

        def of_vertices(arrays: list[wp.array]) -> wp.array:
            dtype = arrays[0].dtype
            zero = constant(np.zeros((1, 1, *item_shape(dtype))), dtype, self.merged_scene.device)
            return concatenate([zero if array.ndim == 3 else array for array in arrays], counts)

        return Node("", of_vertices, self._inputs[name])

    def reflectance(self, fragments: Node, pyramids: Node, footprints: Node, items: str) -> SampleReflectance:
        """Nodes of the samples' reflectance by albedo and textures."""
        seen = fragments, self.merged_scene.faces, self.vertex_albedo
        samples = Node("reflectance", sample_albedo, *seen, pyramids, footprints, items=items)
        return SampleReflectance(samples, self.vertex_albedo, pyramids, footprints)

    def untextured_reflectance(self, fragments: Node, items: str) -> SampleReflectance:
        """Nodes of the samples' reflectance where no body has a texture."""
        none = [Node(name, None, why_idle="no body has a texture") for name in ("mip pyramids", "footprints")]
        seen = fragments, self.merged_scene.faces, self.vertex_albedo
        samples = Node("reflectance", interpolate, *seen, items=items, extra_inputs=tuple(none))
        return SampleReflectance(samples, self.vertex_albedo, *none)


def _arrays_of(replacements: Mapping[str, BodyArrays]) -> Iterator[tuple[str, int, wp.array]]:
    """Arrays in the place of others, with their names and bodies."""
    for name, arrays in replacements.items():
        for number, array in enumerate(arrays or ()):
            if array is not None:
                yield name, number, array


def _of_bodies(merged_scene: MergedScene, name: str) -> list[wp.array | None]:
    """Roughness or the like of each body, 0 without gloss: float32 [1, 1], [1, vertex] or [1, height, width]."""
    values = ((body.is_glossy, getattr(body, name)) for body in merged_scene.scene.bodies)
    rows = [is_glossy * GLOSS_DEFAULTS[name] if value is None else value for is_glossy, value in values]
    return [wp.array(np.atleast_1d(row)[None], dtype=wp.float32, device=merged_scene.device) for row in rows]
