"""Materials of bodies in two tables: the numbers that say how a surface shines, and all that images take of bodies.

Checks of bodies and scene files follow the first table; arrays and tensors of renderers follow the second, of which the
first is a part. A new number is a row here, a field of :class:`.Body` and one of :class:`.ImageInputs`; then
:mod:`.pipeline.shading.gloss` asks for it. Color, texture and emission are fields of a body with code of their own.
"""

from typing import NamedTuple


class MaterialField(NamedTuple):
    """A number of a surface: of a body, of each vertex, or a texture [height, width]."""

    name: str  # of the field of a body, of the key of a scene file, and of the argument of a renderer
    default: float  # for bodies without the number; of roughness a filler in arrays, since such bodies are diffuse
    minimum: float = 0.0  # the range that is accepted
    maximum: float = 1.0
    is_in_files: bool = False  # whether materials of meshes' files have it, as glTF's do


MATERIAL_FIELDS = (
    MaterialField("roughness", 1.0, is_in_files=True),
    MaterialField("metallic", 0.0, is_in_files=True),
    MaterialField("specular", 1.0),
)

GLOSS_ARGUMENTS = tuple(field.name for field in MATERIAL_FIELDS)
GLOSS_DEFAULTS = {field.name: field.default for field in MATERIAL_FIELDS}


class BodyInput(NamedTuple):
    """An input of images that bodies have each, as an array or a tensor."""

    is_color: bool = True  # whether its items are linear RGB; else they are numbers
    has_rows: bool = True  # whether it may be one item, or one for each vertex
    has_images: bool = False  # whether it may be an image, [height, width]

    def is_image(self, shape: tuple[int, ...], vertex_count: int) -> bool:
        """Whether a value of a shape, with a batch or without, is an image, for a mesh of so many vertices."""
        if not (self.has_rows and self.has_images):
            return self.has_images
        if self.is_color:
            return len(shape) > 3 or (len(shape) == 3 and shape[1] not in (1, vertex_count))
        return len(shape) > 2 or (len(shape) == 2 and shape[1] not in (1, vertex_count))


INPUTS_OF_BODIES = {
    "albedo": BodyInput(),
    "textures": BodyInput(has_rows=False, has_images=True),
    "emission": BodyInput(has_images=True),
    **dict.fromkeys(GLOSS_ARGUMENTS, BodyInput(is_color=False, has_images=True)),
}
"""By the names of their arguments."""
