"""OBJ files: their items, and materials' pictures."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from warpshadow.assets.mesh import BaseColor, MeshError


class ObjItems(NamedTuple):
    """Items of an OBJ file, in its order; indices count from 0."""

    positions: np.ndarray  # [vertex, 3]
    colors: np.ndarray  # sRGB of the vertices that have one, [color, 3]
    uvs: np.ndarray  # [uv, 2]
    corners: np.ndarray  # vertices of the corners of all faces, [corner]
    uv_corners: np.ndarray  # uvs of corners that have one
    corner_counts: np.ndarray  # [face]
    libraries: list[str]  # files of materials
    materials: set[str]  # of faces; "" where they have none


def read_items(path: Path) -> ObjItems:
    """Read v, vt and f lines, and the names of materials.

    Raises:
        MeshError: naming a line that cannot be read.
    """
    text = path.read_text(encoding="utf-8", errors="replace").replace("\\\n", " ")
    positions, colors, uvs, corners, uv_corners, corner_counts = [], [], [], [], [], []
    libraries, material, materials = [], "", set()
    for number, line in enumerate(text.split("\n"), start=1):
        try:
            match line.partition("#")[0].split():
                case ["v", x, y, z, *rest]:
                    positions.append((float(x), float(y), float(z)))
                    if len(rest) >= 3:  # a number before the color, or one alone, is a weight
                        r, g, b = rest[len(rest) > 3 :][:3]
                        colors.append((float(r), float(g), float(b)))
                case ["vt", u, *rest]:
                    uvs.append((float(u), float(rest[0]) if rest else 0.0))
                case ["mtllib", *words]:
                    libraries.append(" ".join(words))
                case ["usemtl", *words]:
                    material = " ".join(words)
                case ["f", *tokens]:
                    materials.add(material)
                    corner_counts.append(len(tokens))
                    for token in tokens:
                        vertex, _, uv_and_normal = token.partition("/")
                        corners.append(_index(vertex, len(positions)))
                        if uv := uv_and_normal.partition("/")[0]:
                            uv_corners.append(_index(uv, len(uvs)))
                case ["v" | "vt", *coordinates]:
                    raise ValueError(f"{len(coordinates)} coordinates are too few")
        except ValueError as error:
            raise MeshError(f"line {number}: {error}, got {line.strip()!r}") from None
    return ObjItems(
        np.array(positions).reshape(-1, 3),
        np.array(colors).reshape(-1, 3),
        np.array(uvs).reshape(-1, 2),
        np.array(corners, np.int64),
        np.array(uv_corners, np.int64),
        np.array(corner_counts, np.int64),
        libraries,
        materials,
    )


def _index(token: str, count: int) -> int:
    """Zero-based index of a one-based one, or of one that counts back from the last item so far."""
    index = int(token)
    return index + count if index < 0 else index - 1


def read_pictures(libraries: list[Path]) -> dict[str, BaseColor]:
    """The diffuse pictures of the materials of MTL files, as far as the files exist."""
    pictures, material = {}, ""
    for library in filter(Path.is_file, libraries):
        for line in library.read_text(encoding="utf-8", errors="replace").splitlines():
            match line.split():
                case ["newmtl", *words]:
                    material = " ".join(words)
                case [keyword, *words] if keyword.lower() == "map_kd":
                    name = words[-1] if words and words[0].startswith("-") else " ".join(words)  # after options
                    pictures[material] = BaseColor(library.parent / name.replace("\\", "/"))
    return pictures
