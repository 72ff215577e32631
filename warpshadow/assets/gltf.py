"""Materials of glTF, as trimesh reads them and as it does not."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from warpshadow.assets.mesh import Gloss

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


def gloss_of(material) -> Gloss | None:
    """The roughness and metallic of a material of trimesh; None where its file says neither.

    Of a texture the means count. Without one metallic is the file's, or else 0: glTF's own default is 1, but
    files that leave it out, such as trimesh's, rarely mean a metal.
    """
    roughness, metallic = (getattr(material, name, None) for name in ("roughnessFactor", "metallicFactor"))
    image = getattr(material, "metallicRoughnessTexture", None)
    if image is None:
        is_silent = roughness is None and metallic is None
        return None if is_silent else _gloss(1.0 if roughness is None else roughness, metallic or 0.0)
    _, green, blue = np.asarray(image.convert("RGB")).reshape(-1, 3).mean(axis=0) / 255
    gloss = _gloss(
        *((1.0 if factor is None else factor) * mean for factor, mean in ((roughness, green), (metallic, blue)))
    )
    means = f"roughness {gloss.roughness:.2g}, metallic {gloss.metallic:.2g}"
    return gloss._replace(remark=f"of its metallic-roughness texture the means count ({means})")


def _gloss(roughness: float, metallic: float) -> Gloss:
    return Gloss(*np.clip((roughness, metallic), 0.0, 1.0).tolist())
