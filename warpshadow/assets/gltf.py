"""Materials and lights of glTF, as trimesh reads them and as it does not."""

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from warpshadow import check
from warpshadow.assets.color import srgb_to_linear
from warpshadow.assets.mesh import EmissiveColor, Gloss, MeshPart

Factors = Mapping[tuple[int, ...], tuple[float, ...]]
"""Linear factors of materials, by the codes that trimesh rounds them to."""

NO_FACTORS: Factors = {}  # of meshes whose file is not known


def gltf_tree(path: Path) -> dict:
    """The JSON of a glTF file; on bad JSON trimesh would even read a model.gltf beside the file instead."""
    content = path.read_bytes()
    if content[:4] == b"glTF":
        content = content[20:][: int.from_bytes(content[12:16], "little")]
    return json.loads(content)


def cuts_colors(tree: dict) -> bool:
    """Whether trimesh would take the lower half of 16-bit colors: in a glTF file without a material for them."""
    primitives = [primitive for mesh in tree.get("meshes", []) for primitive in mesh["primitives"]]
    colors = [item["attributes"].get("COLOR_0") for item in primitives if "material" not in item]
    return any(color is not None and tree["accessors"][color]["componentType"] == 5123 for color in colors)


def base_color_factors(tree: dict) -> Factors:
    """Factors of a glTF file's materials by the codes that trimesh rounds them to; the mean where several have one."""
    result: dict[tuple[int, ...], list[np.ndarray]] = {}
    for material in tree.get("materials", []):
        factor = material.get("pbrMetallicRoughness", {}).get("baseColorFactor", (1.0, 1.0, 1.0))
        exact = np.clip(np.array(factor[:3], np.float64), 0.0, 1.0)
        result.setdefault(tuple((255 * exact).round().astype(int).tolist()), []).append(exact)
    return {codes: tuple(np.mean(factors, axis=0).tolist()) for codes, factors in result.items()}


def base_color_factor(material, factors: Factors) -> tuple[float, ...] | None:
    """The linear factor of a material of trimesh, in steps of 1/255 where its file is not known; None where none is."""
    factor = getattr(material, "baseColorFactor", None)
    if factor is None:
        return None
    codes = tuple(factor[:3].tolist())
    return factors.get(codes, tuple(code / 255 for code in codes))


def emission_of(material) -> EmissiveColor | None:
    """The emission of a material of trimesh; None for none."""
    factor = getattr(material, "emissiveFactor", None)
    if factor is None or not np.any(factor):
        return None
    red, green, blue = np.array(factor, np.float64).tolist()
    image, name = (getattr(material, attribute, None) for attribute in ("emissiveTexture", "name"))
    return EmissiveColor((red, green, blue), image, name)


def emission_texels(emission: EmissiveColor) -> np.ndarray:
    """Radiance of a surface, float32 of shape [3], or [height, width, 3] where it varies."""
    if emission.image is None:
        return np.array(emission.factor, np.float32)
    texels = srgb_to_linear(np.asarray(emission.image.convert("RGB")) / 255) * np.array(emission.factor)
    return (texels if np.ptp(texels, axis=(0, 1)).any() else texels[0, 0]).astype(np.float32)


class EmissiveEntry(NamedTuple):
    """Emission in a material's JSON that trimesh does not read."""

    strength: float  # of KHR_materials_emissive_strength
    has_own_uvs: bool  # whether its texture is on other uvs than a file's first, which are the mesh's


def emissive_entries(tree: dict) -> Mapping[tuple[Any, ...], EmissiveEntry]:
    """Entries of all materials, by their names and factors."""
    result = {}
    for material in tree.get("materials", []):
        key = (material.get("name"), *_float32_key(material.get("emissiveFactor", (0, 0, 0))))
        extension = material.get("extensions", {}).get("KHR_materials_emissive_strength", {})
        texture = material.get("emissiveTexture", {})
        transform = texture.get("extensions", {}).get("KHR_texture_transform", {})
        has_own_uvs = transform.get("texCoord", texture.get("texCoord", 0)) != 0
        result[key] = EmissiveEntry(extension.get("emissiveStrength", 1.0), has_own_uvs)
    return result


def _float32_key(factor: Sequence[float]) -> tuple[float, ...]:
    return tuple(np.array(factor, np.float32).tolist())


def with_entry(part: MeshPart, entries: Mapping[tuple[Any, ...], EmissiveEntry]) -> MeshPart:
    """A part that emits as its material says."""
    if part.emission is None:
        return part
    factor, image, material, _ = part.emission
    entry = entries.get((material, *_float32_key(factor)), EmissiveEntry(1.0, False))
    red, green, blue = (entry.strength * color for color in factor)
    return part._replace(emission=EmissiveColor((red, green, blue), image, has_own_uvs=entry.has_own_uvs))


def gloss_of(material) -> Gloss | None:
    """The roughness and metallic of a material of trimesh; None where its file says neither.

    Without a texture, metallic is the value of the file, or else 0: glTF's own default is 1, but files that leave it
    out, such as those of trimesh, rarely mean a metal.
    """
    roughness, metallic = (getattr(material, name, None) for name in ("roughnessFactor", "metallicFactor"))
    image = getattr(material, "metallicRoughnessTexture", None)
    if image is None and roughness is None and metallic is None:
        return None
    default_metallic = 0.0 if image is None else 1.0
    factors = 1.0 if roughness is None else roughness, default_metallic if metallic is None else metallic
    roughness, metallic = np.clip(factors, 0.0, 1.0).tolist()
    return Gloss(roughness, metallic, image)


def gloss_texels(gloss: Gloss) -> tuple[np.ndarray, np.ndarray]:
    """Roughness and metallic of a surface, float32 of shape [1] each, or [height, width] where they vary."""
    codes = np.zeros((1, 1, 3)) + 255 if gloss.image is None else np.asarray(gloss.image.convert("RGB"))
    textures = codes[..., 1] / 255 * gloss.roughness, codes[..., 2] / 255 * gloss.metallic
    roughness, metallic = ((texels if np.ptp(texels) else texels[0, :1]).astype(np.float32) for texels in textures)
    return roughness, metallic


class PunctualLight(NamedTuple):
    """A light of KHR_lights_punctual."""

    kind: str  # "point", "spot" or "directional"
    name: str
    position: np.ndarray
    direction: np.ndarray  # in which it shines, of length 1
    intensity: np.ndarray  # color times candela or lux, shape [3]
    beam: tuple[float, float] | None  # inner and outer angle of a spot's cone [degrees]


def punctual_lights(tree: dict) -> list[PunctualLight]:
    """The lights of the scene in a glTF file."""
    lights = tree.get("extensions", {}).get("KHR_lights_punctual", {}).get("lights", [])
    result = []
    for node, to_world in _nodes(tree):
        number = node.get("extensions", {}).get("KHR_lights_punctual", {}).get("light")
        if number is None:
            continue
        light, backward = lights[number], to_world[:3, 2]
        check.choice("type", light["type"], ("point", "spot", "directional"))
        beam = None
        if light["type"] == "spot":
            cone = light.get("spot", {})
            angles = cone.get("innerConeAngle", 0.0), cone.get("outerConeAngle", np.pi / 4)
            beam = tuple(np.degrees(angles).tolist())
        intensity = light.get("intensity", 1.0) * np.array(light.get("color", (1.0, 1.0, 1.0)), np.float64)
        name = node.get("name") or light.get("name") or f"{light['type']} light"
        direction = -backward / np.linalg.norm(backward)
        result.append(PunctualLight(light["type"], name, to_world[:3, 3], direction, intensity, beam))
    return result


def _nodes(tree: dict) -> Iterator[tuple[dict, np.ndarray]]:
    """The nodes of a file's scene, each with the matrix from its own space to the world."""
    nodes, scenes = tree.get("nodes", []), tree.get("scenes", [])
    roots = scenes[tree.get("scene", 0)].get("nodes", []) if scenes else []
    waiting = [(number, np.eye(4)) for number in roots]
    while waiting:
        number, parent = waiting.pop()
        to_world = parent @ _local_matrix(nodes[number])
        yield nodes[number], to_world
        waiting += [(child, to_world) for child in nodes[number].get("children", [])]


def _local_matrix(node: dict) -> np.ndarray:
    """The matrix of a node, in its parent's space."""
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T
    from scipy.spatial.transform import Rotation

    rotation = Rotation.from_quat(node.get("rotation", (0.0, 0.0, 0.0, 1.0))).as_matrix()
    matrix = np.eye(4)
    matrix[:3, :3] = rotation * node.get("scale", (1.0, 1.0, 1.0))
    matrix[:3, 3] = node.get("translation", (0.0, 0.0, 0.0))
    return matrix
