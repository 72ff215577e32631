"""OBJ files: their items, read at once where lines are alike, and else line by line; and materials' pictures."""

from __future__ import annotations

import itertools
import re
from pathlib import Path
from typing import NamedTuple

import numpy as np

from warpshadow.assets.mesh import BaseColor, MeshError

_WITHOUT_CORNERS = str.maketrans("", "", "0123456789/ \t\n")


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
    return read_alike(text) or read_by_line(text)


def read_alike(text: str) -> ObjItems | None:
    """Read a file whose lines of a kind have as many numbers, in a seventh of the time; None for any other.

    Faces may have any number of corners, but all corners have a uv, or none.
    """
    vertices, uvs, faces, libraries = (re.findall(rf"^{word} (.*)", text, re.M) for word in ("v", "vt", "f", "mtllib"))
    marks = re.findall(r"^(?:usemtl (.*)|(f) )", text, re.M)
    other_lines = re.findall(r"^(?:#|vn |s |o |g |$)", text, re.M)
    lines = (vertices, uvs, libraries, marks, other_lines)
    if sum(map(len, lines)) < text.count("\n") + 1 or not (vertices and faces):
        return None
    body = "\n".join(faces)
    counts = np.array([len(line.split()) for line in faces], np.int64)
    corner_count, slashes = int(counts.sum()), (body.count("/"), body.count("//"))
    layouts = {(0, 0): 1, (corner_count, 0): 2, (2 * corner_count, corner_count): 2, (2 * corner_count, 0): 3}
    width = layouts.get(slashes)
    if width is None or body.translate(_WITHOUT_CORNERS):
        return None
    numbers = np.fromstring(body.replace("/", " "), np.int64, sep=" ") - 1
    if len(numbers) != width * corner_count:
        return None
    try:
        values = np.loadtxt(vertices, ndmin=2, comments=None)
        coordinates = np.loadtxt(uvs, ndmin=2, comments=None) if uvs else np.zeros((0, 2))
    except ValueError:  # as where lines differ in length: the other reader says which
        return None
    if values.shape[1] < 3 or coordinates.shape[1] < 2:
        return None
    corners, has_uvs = numbers.reshape(-1, width), width > 1 and not slashes[1]
    return ObjItems(
        values[:, :3],
        values[:, 3 + (values.shape[1] > 6) :][:, :3] if values.shape[1] >= 6 else np.zeros((0, 3)),
        coordinates[:, :2],
        corners[:, 0],
        corners[:, 1] if has_uvs else np.zeros(0, np.int64),
        counts,
        [_name(line) for line in libraries],
        {
            _name(name)
            for (name, is_face), (_, is_next_face) in itertools.pairwise([("", ""), *marks])
            if is_next_face and not is_face
        },
    )


def _name(line: str) -> str:
    """A name on the rest of a line, after which a comment may stand."""
    return " ".join(line.partition("#")[0].split())


def read_by_line(text: str) -> ObjItems:
    """Read any file.

    Raises:
        MeshError: naming a line that cannot be read.
    """
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
