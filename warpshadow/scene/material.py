"""Material of bodies beside their color: numbers that say how a surface shines, in one table.

Bodies, scene files, arrays and tensors of renderers, and materials of meshes' files follow the table. A new number is a
row here, a field and an argument of :class:`.Body`, and its part in :mod:`.pipeline.gloss`.
"""

from typing import NamedTuple


class MaterialField(NamedTuple):
    """A number of a surface: of a body, of each vertex, or a texture [height, width].

    Args:
        name: Of the field of a body, of the key of a scene file, and of the argument of a renderer.
        default: Of a body that shines and does not say.
        minimum, maximum: The range that is accepted.
        is_in_files: Whether materials of meshes' files have it, as glTF's do.
    """

    name: str
    default: float
    minimum: float = 0.0
    maximum: float = 1.0
    is_in_files: bool = False


MATERIAL_FIELDS = (
    MaterialField("roughness", 1.0, is_in_files=True),  # a body shines that has it; the default is for all others
    MaterialField("metallic", 0.0, is_in_files=True),
    MaterialField("specular", 1.0),
)

GLOSS_ARGUMENTS = tuple(field.name for field in MATERIAL_FIELDS)
GLOSS_DEFAULTS = {field.name: field.default for field in MATERIAL_FIELDS}
