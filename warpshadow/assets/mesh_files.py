"""Mesh files: OBJ, PLY, GLB, STL and USD, read without reordering vertices; and meshes of trimesh."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Protocol, TypeGuard

import numpy as np

from warpshadow import check
from warpshadow.assets.color import srgb_to_linear
from warpshadow.assets.image import read_rgb
from warpshadow.assets.mesh import BaseColor, Mesh, MeshError, MeshPart, moved_part, turned_over
from warpshadow.check import AnyPath

if TYPE_CHECKING:  # it is imported where a file is read by it
    import trimesh


class OfTrimesh(Protocol):
    """A ``trimesh.Trimesh`` or a ``trimesh.Scene``."""

    @property
    def metadata(self) -> Mapping[str, object]:
        """What trimesh knows of it, such as the file."""


MeshSource = AnyPath | OfTrimesh
"""What is read as a mesh."""


def is_of_trimesh(value: object) -> TypeGuard[trimesh.Trimesh | trimesh.Scene]:
    """Whether a value is a mesh or a scene of trimesh."""
    trimesh = sys.modules.get("trimesh")  # before it is imported, nothing is
    return trimesh is not None and isinstance(value, (trimesh.Trimesh, trimesh.Scene))


COLORS_DROPPED = (
    "colors of vertices dropped, which Body(albedo=…) takes, linear, [vertex, 3]: srgb_to_linear(colors / 255)"
)
"""A remark on files whose colors are not read."""


def load_mesh(path: MeshSource) -> Mesh:
    """Read an OBJ, PLY, STL, GLB/glTF or USD file, or take what trimesh has, as one mesh.

    Vertices keep the file's order and none is merged or dropped. Polygons become fans of triangles. The nodes
    of a scene are concatenated in world space. Where a format ties uvs to vertices (PLY, glTF), faces refer
    to the first of the vertices that are duplicated only for their uvs (same position, and same normal where
    the file stores normals), so that a seam does not break the shading; without uvs they stay as they are.
    A USD stage is read at its earliest time, z-up turned to y-up, subdivision surfaces as their control cage.
    uvs are kept only when every face has them. Colors, materials and textures are not read: they are a body's, and
    ``Body(path)`` takes the texture, too.

    Args:
        path: A .obj, .ply, .stl, .glb, .gltf, .usd, .usda, .usdc or .usdz file; or a ``trimesh.Trimesh``, or the
            meshes of a ``trimesh.Scene``, which are taken as those of files are.

    Returns:
        The mesh, named after the file.

    Raises:
        MeshError: for what is not such a file, or holds no usable triangles.
        FileNotFoundError: when the file does not exist.
        ImportError: for USD without the package usd-core.

    Warns:
        Once, with the counts of degenerate faces, duplicate faces and unreferenced vertices, and what was dropped: uvs
        that some faces lack, textures, and the colors of vertices in OBJ, PLY and glTF files.
    """
    mesh, picture, remarks = _read(path)
    if picture is not None:
        remarks.append("its texture dropped, which Body(path) takes")
    _remark(path, remarks)
    return mesh


def load_textured_mesh(path: MeshSource, *, wanted: bool = True) -> tuple[Mesh, np.ndarray | None]:
    """Read a mesh as :func:`load_mesh` does, and the texture that the file names or holds.

    A texture is the base color of glTF (times its factor), the ``map_Kd`` of OBJ, or the image of PLY, where all faces
    have the same one, and uvs. Those of USD are not read.

    Args:
        path: As there.
        wanted: Whether the texture is to be read, and colors of vertices are to be warned of.

    Returns:
        The mesh; and its texture, linear RGB of shape [height, width, 3], or None.

    Warns:
        As there; and of a texture that cannot be read.
    """
    mesh, picture, remarks = _read(path)
    texture = None
    if not wanted:
        remarks = [remark for remark in remarks if remark != COLORS_DROPPED]
    if wanted and picture is not None:
        try:
            texture = _texels(picture)
        except (OSError, ValueError) as error:
            remarks.append(f"its texture dropped ({error})")
    _remark(path, remarks)
    return mesh, texture


def _remark(path: MeshSource, remarks: list[str]) -> None:
    if remarks:
        check.warn(f"{path if check.is_path(path) else 'mesh'}: {', '.join(remarks)}")


def _read(source: MeshSource) -> tuple[Mesh, BaseColor | None, list[str]]:
    """A mesh, the picture that all its faces have, and remarks on what may surprise."""
    if is_of_trimesh(source):
        return _concatenate(_trimesh_parts(source), Path(source.metadata.get("file_name") or "mesh").stem)
    path = check.path("path", source)
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        raise MeshError(f"{path}: got extension {path.suffix!r}, expected one of {', '.join(_READERS)}")
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such mesh file")
    try:
        return _concatenate(reader(path), path.stem)
    except (MeshError, ImportError) as error:
        raise type(error)(f"{path}: {error}") from error
    except Exception as error:  # the readers of other libraries raise anything on a damaged file
        raise MeshError(f"{path}: not a readable {path.suffix} file ({type(error).__name__}: {error})") from error


def _texels(picture: BaseColor) -> np.ndarray:
    """A picture as linear RGB, float32 of shape [height, width, 3]."""
    if isinstance(picture.image, Path):
        return read_rgb(picture.image)
    codes = np.asarray(picture.image.convert("RGB"))
    return (srgb_to_linear(codes / 255) * picture.factor).astype(np.float32)


def _concatenate(parts: list[MeshPart], name: str) -> tuple[Mesh, BaseColor | None, list[str]]:
    """Join parts into one mesh, find the picture that all have, and remark on what may surprise."""
    vertex_count = sum(len(part.positions) for part in parts)
    parts = [part for part in parts if len(part.faces)]
    if not parts:
        raise MeshError(f"faces: got none ({vertex_count} vertices), expected at least one triangle")
    positions, faces = _stack((part.positions, part.faces) for part in parts)
    textured = [(part.uvs, part.uv_faces) for part in parts if part.uvs is not None]
    uvs, uv_faces = _stack(textured) if len(textured) == len(parts) else (None, None)
    mesh = Mesh(positions, faces, uvs, uv_faces, name)

    a, b, c = np.moveaxis(mesh.positions.astype(np.float64)[mesh.faces], 1, 0)
    counts = {
        "degenerate faces (no area)": np.sum(~np.cross(b - a, c - a).any(axis=1)),
        "duplicate faces": mesh.face_count - len(np.unique(np.sort(mesh.faces, axis=1), axis=0)),
        "unreferenced vertices": mesh.vertex_count - len(np.unique(mesh.faces)) - sum(part.welded for part in parts),
    }
    remarks = [f"{count} {what}" for what, count in counts.items() if count]
    remarks += [part.remark for part in parts if part.remark]
    if 0 < len(textured) < len(parts):
        remarks.append(f"uvs dropped because {len(parts) - len(textured)} of {len(parts)} parts have none")
    if any(part.has_colors for part in parts):
        remarks.append(COLORS_DROPPED)
    pictures = [picture for part in parts for picture in part.pictures]
    is_one = mesh.uvs is not None and all(picture == pictures[0] for picture in pictures)
    if any(pictures) and not is_one:
        remarks.append("textures dropped, since a body takes one that all its faces have")
    return mesh, pictures[0] if is_one else None, remarks


def _stack(blocks: Iterable[tuple]) -> tuple[np.ndarray, np.ndarray]:
    """Concatenate pairs of values and faces; the faces' indices move along."""
    values, faces = zip(*blocks, strict=True)
    offsets = np.cumsum([0] + [len(block) for block in values[:-1]])
    moved = [block + offset for block, offset in zip(faces, offsets, strict=True)]
    return np.concatenate(values), np.concatenate(moved)


def _fan(corner_counts: np.ndarray) -> np.ndarray:
    """Corner numbers [triangle, 3] of the fans that triangulate consecutive polygons."""
    if (corner_counts < 3).any():
        polygon = np.flatnonzero(corner_counts < 3)[0]
        raise MeshError(f"faces: got {corner_counts[polygon]} corners at face {polygon}, expected 3 or more")
    triangle_counts = corner_counts - 2
    first = np.repeat(np.cumsum(corner_counts) - corner_counts, triangle_counts)
    step = np.arange(len(first)) - np.repeat(np.cumsum(triangle_counts) - triangle_counts, triangle_counts)
    return np.stack([first, first + step + 1, first + step + 2], axis=1)


def _weld(faces: np.ndarray, *attributes: np.ndarray) -> np.ndarray:
    """Let faces refer to the first of the vertices that agree in all attributes."""
    rows = np.column_stack(attributes) + 0.0  # makes -0 equal to 0
    _, first, group = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    return first[group.reshape(-1)][faces]


def _read_obj(path: Path) -> list[MeshPart]:
    """Read v, vt and f lines: trimesh would split the vertices at uv seams and reorder them."""
    positions, uvs, corners, uv_corners, corner_counts, has_colors = [], [], [], [], [], False
    libraries, material, materials = [], "", set()
    text = path.read_text(encoding="utf-8", errors="replace").replace("\\\n", " ")
    for number, line in enumerate(text.split("\n"), start=1):
        try:
            match line.partition("#")[0].split():
                case ["v", x, y, z, *rest]:
                    positions.append((float(x), float(y), float(z)))
                    has_colors |= len(rest) >= 3  # one number is a weight
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
                        vertex, _, others = token.partition("/")
                        corners.append(_obj_index(vertex, len(positions)))
                        if uv := others.partition("/")[0]:
                            uv_corners.append(_obj_index(uv, len(uvs)))
                case ["v" | "vt", *coordinates]:
                    raise ValueError(f"{len(coordinates)} coordinates are too few")
        except ValueError as error:
            raise MeshError(f"line {number}: {error}, got {line.strip()!r}") from None
    faces = _fan(np.array(corner_counts, dtype=np.int64))
    part = MeshPart(np.array(positions).reshape(-1, 3), np.array(corners, dtype=np.int64)[faces], has_colors=has_colors)
    if not uv_corners:
        return [part]
    if len(uv_corners) < len(corners):
        missing = len(corners) - len(uv_corners)
        return [part._replace(remark=f"uvs dropped because {missing} of {len(corners)} corners have none")]
    pictures = _obj_pictures([path.parent / library for library in libraries])
    part = part._replace(pictures=tuple(pictures.get(name) for name in sorted(materials)))
    return [part._replace(uvs=np.array(uvs).reshape(-1, 2), uv_faces=np.array(uv_corners)[faces])]


def _obj_pictures(libraries: list[Path]) -> dict[str, BaseColor]:
    """The diffuse pictures of the materials of MTL files, those that are there."""
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


def _obj_index(token: str, count: int) -> int:
    """Zero-based index of a one-based one, or of one that counts back from the last item so far."""
    index = int(token)
    return index + count if index < 0 else index - 1


def _read_trimesh(path: Path) -> list[MeshPart]:
    """Read PLY, STL, GLB or glTF through trimesh, with its merging, cleaning and reordering switched off."""
    import trimesh

    if path.suffix.lower() == ".gltf":
        json.loads(path.read_bytes())  # on bad JSON trimesh would read a model.gltf beside the file instead
    return _trimesh_parts(trimesh.load_scene(path, process=False, maintain_order=True, fix_texture=False))


def _trimesh_parts(given: trimesh.Trimesh | trimesh.Scene) -> list[MeshPart]:
    """The meshes of a scene of trimesh in world space; or one mesh, as it is."""
    import trimesh

    if isinstance(given, trimesh.Trimesh):
        return [_trimesh_part(given)]
    scene, parts = given, []
    for node in scene.graph.nodes_geometry:
        transform, geometry = scene.graph[node]
        shape = scene.geometry[geometry]
        if isinstance(shape, trimesh.Trimesh):
            parts.append(moved_part(_trimesh_part(shape), transform[:3, :3], transform[:3, 3]))
    return parts


def _trimesh_part(shape) -> MeshPart:
    """Take the arrays of a trimesh.Trimesh, its faces welded across uv seams."""
    pictures = (_trimesh_picture(getattr(shape.visual, "material", None)),)
    positions, faces = np.asarray(shape.vertices, np.float32), np.asarray(shape.faces)
    corner_uvs = _ply_corner_uvs(shape)
    if corner_uvs is not None and len(corner_uvs) == 3 * len(faces):
        return MeshPart(positions, faces, corner_uvs, np.arange(len(corner_uvs)).reshape(-1, 3), pictures=pictures)
    uvs = getattr(shape.visual, "uv", None)
    if uvs is None:
        return MeshPart(positions, faces, has_colors=shape.visual.kind == "vertex")
    # Normals in the cache are the file's; shape.vertex_normals computes missing ones, which differ at seams.
    normals = [shape.vertex_normals] if "vertex_normals" in shape._cache else []
    welded = _weld(faces, positions, *normals)
    part = MeshPart(positions, welded, uvs, faces, pictures=pictures)
    return part._replace(welded=len(np.unique(faces)) - len(np.unique(welded)))


def _trimesh_picture(material) -> BaseColor | None:
    """The picture of a material, glTF's or a simple one."""
    from trimesh.visual.material import empty_material

    image = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
    if image is None or image == empty_material().image:  # which trimesh puts where there is none
        return None
    factor = getattr(material, "baseColorFactor", None)  # in steps of 1/255
    return BaseColor(image) if factor is None else BaseColor(image, tuple((factor[:3] / 255).tolist()))


def _ply_corner_uvs(shape) -> np.ndarray | None:
    """The uvs [corner, 2] of a PLY file that stores them with faces; trimesh gives each vertex only one."""
    raw = shape.metadata.get("_ply_raw", {})
    data = raw.get("face", {}).get("data", {})
    names = data.dtype.names or () if isinstance(data, np.ndarray) else data
    if "texcoord" not in names:
        return None
    corners = next((data[name] for name in ("vertex_indices", "vertex_index") if name in names), None)
    axes = [np.ravel(raw["vertex"]["data"][axis]) for axis in "xyz"]
    points = np.stack(axes, axis=-1).astype(np.float32)
    if corners is None or not np.array_equal(points[_ply_values(corners)], shape.triangles.astype(np.float32)):
        return None  # the faces are no longer those of the file
    return _ply_values(data["texcoord"]).reshape(-1, 2)


def _ply_values(lists) -> np.ndarray:
    """The values of lists: binary files hold [count, values], ASCII files the values alone."""
    return np.asarray(lists["f1"] if getattr(lists.dtype, "names", None) else lists)


def _read_usd(path: Path) -> list[MeshPart]:
    """Read the visible meshes of a USD stage in world space, y up."""
    try:
        from pxr import Usd, UsdGeom
    except ImportError:
        raise ImportError(check.missing("USD", "usd-core", "usd")) from None

    stage = Usd.Stage.Open(str(path))
    time = Usd.TimeCode.EarliestTime()
    transforms = UsdGeom.XformCache(time)
    z_up = UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.z
    to_y_up = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]]) if z_up else np.eye(3)
    parts = []
    for prim in Usd.PrimRange.Stage(stage, Usd.TraverseInstanceProxies()):
        mesh = UsdGeom.Mesh(prim)
        if (
            mesh
            and mesh.ComputeVisibility(time) != UsdGeom.Tokens.invisible
            and mesh.ComputePurpose() in (UsdGeom.Tokens.default_, UsdGeom.Tokens.render)
        ):
            world = np.array(transforms.GetLocalToWorldTransform(prim))  # multiplies row vectors
            part = _usd_part(mesh, UsdGeom.PrimvarsAPI(prim), time)
            parts.append(moved_part(part, to_y_up @ world[:3, :3].T, to_y_up @ world[3, :3]))
    return parts


def _usd_part(mesh, primvars, time) -> MeshPart:
    """Take the arrays of a UsdGeom.Mesh, polygons triangulated, in its own space."""
    positions = np.array(mesh.GetPointsAttr().Get(time) or [], dtype=np.float32).reshape(-1, 3)
    corners = np.array(mesh.GetFaceVertexIndicesAttr().Get(time) or [], dtype=np.int64)
    corner_counts = np.array(mesh.GetFaceVertexCountsAttr().Get(time) or [], dtype=np.int64)
    if corner_counts.sum() != len(corners):
        raise MeshError(f"{mesh.GetPath()}: got {len(corners)} corners, expected {corner_counts.sum()} from the counts")
    faces = _fan(corner_counts)
    part = MeshPart(positions, corners[faces])
    st = primvars.GetPrimvar("st")
    uv_items = {"faceVarying": np.arange(len(corners)), "vertex": corners, "varying": corners}
    if st.HasValue() and st.GetInterpolation() in uv_items:
        uvs = np.array(st.Get(time), dtype=np.float32)
        indices = np.array(st.GetIndices(time) if st.IsIndexed() else np.arange(len(uvs)))
        part = part._replace(uvs=uvs, uv_faces=indices[uv_items[st.GetInterpolation()]][faces])
    return turned_over(part) if mesh.GetOrientationAttr().Get() == "leftHanded" else part


_READERS: dict[str, Callable[[Path], list[MeshPart]]] = {
    ".obj": _read_obj,
    **dict.fromkeys([".ply", ".stl", ".glb", ".gltf"], _read_trimesh),
    **dict.fromkeys([".usd", ".usda", ".usdc", ".usdz"], _read_usd),
}

MESH_SUFFIXES = tuple(_READERS)
"""What files of meshes are called."""
