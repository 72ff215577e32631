"""Triangle meshes: files, primitives, topology, unwrapping and vertex normals.

Position topology and uv topology stay apart: a seam of the texture gives a vertex two uvs, never two normals.
Vertices keep the order they have in the file. Texture coordinates have their origin at the lower left of the
image, v up.
"""

from __future__ import annotations

import functools
import hashlib
import json
import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from warpshadow import check, files
from warpshadow.tape import launch


class MeshError(ValueError):
    """A mesh, or a mesh file, that cannot be used; the message says what is wrong and where."""


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh on the host, validated; its arrays are read-only copies.

    Args:
        positions: Vertex positions [scene units], float32, shape [vertex, 3].
        faces: Indices of positions, counter-clockwise seen from outside, int32, shape [face, 3].
        uvs: Texture coordinates, origin at the lower left of the image, float32, shape [uv, 2], or None.
        uv_faces: Indices of uvs, int32, shape [face, 3], or None.
        name: What messages call the mesh.

    Raises:
        MeshError: when the mesh is empty, holds NaN or Inf, or an index is out of range.
    """

    positions: np.ndarray = field(repr=False)
    faces: np.ndarray = field(repr=False)
    uvs: np.ndarray | None = field(default=None, repr=False)
    uv_faces: np.ndarray | None = field(default=None, repr=False)
    name: str = "mesh"

    def __post_init__(self) -> None:
        """Copy, convert and validate the arrays."""
        self._set("positions", _coordinates("positions", self.positions, 3, "vertex"))
        self._set("faces", _indices("faces", self.faces, len(self.positions), "vertex"))
        if self.uvs is not None and self.uv_faces is not None:
            self._set("uvs", _coordinates("uvs", self.uvs, 2, "uv"))
            self._set("uv_faces", _indices("uv_faces", self.uv_faces, len(self.uvs), "uv"))
            if len(self.uv_faces) != self.face_count:
                raise MeshError(f"uv_faces: got {len(self.uv_faces)} faces, expected {self.face_count}")
        elif self.uvs is not self.uv_faces:
            missing = "uvs" if self.uvs is None else "uv_faces"
            raise MeshError(f"{missing}: got None, expected both uvs and uv_faces or neither")

    def _set(self, name: str, array: np.ndarray) -> None:
        array.setflags(write=False)
        object.__setattr__(self, name, array)

    @property
    def vertex_count(self) -> int:
        """Number of vertices, referenced by a face or not."""
        return len(self.positions)

    @property
    def face_count(self) -> int:
        """Number of triangles."""
        return len(self.faces)

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper corner of the box around the vertices that faces refer to, each shape [3]."""
        used = self.positions[np.unique(self.faces)]
        return used.min(axis=0), used.max(axis=0)

    @property
    def content_hash(self) -> str:
        """SHA-256 of the arrays, in hexadecimal; the name does not count."""
        digest = hashlib.sha256()
        for array in (self.positions, self.faces, self.uvs, self.uv_faces):
            digest.update(b"none" if array is None else f"{array.shape}".encode() + array.tobytes())
        return digest.hexdigest()

    @functools.cached_property
    def surface(self) -> Surface:
        """How its faces are joined."""
        return _surface(self)

    def transformed(
        self,
        *,
        rotation: np.ndarray | None = None,
        translation: np.ndarray | None = None,
        scale: float | np.ndarray = 1.0,
    ) -> Mesh:
        """Scale, then rotate, then translate; a transform that mirrors also turns the faces over.

        Args:
            rotation: Matrix that multiplies column vectors, shape [3, 3]; the identity by default.
            translation: Offset [scene units], shape [3]; none by default.
            scale: One factor, or one for each axis, shape [3].

        Returns:
            A new mesh with the same uvs and name.
        """
        rotation = np.eye(3) if rotation is None else np.asarray(rotation, np.float64)
        translation = np.zeros(3) if translation is None else np.asarray(translation, np.float64)
        check.shape("rotation", rotation.shape, (3, 3))
        check.shape("translation", translation.shape, (3,))
        part = _Part(self.positions, self.faces, self.uvs, self.uv_faces)
        moved = _move(part, rotation * np.broadcast_to(scale, 3), translation)
        return replace(self, positions=moved.positions, faces=moved.faces, uv_faces=moved.uv_faces)

    def write(self, path: str | Path) -> None:
        """Write a Wavefront OBJ file that reads back as the same arrays, bit for bit."""
        path = Path(path)
        if path.suffix.lower() != ".obj":
            raise MeshError(f"{path}: got extension {path.suffix!r}, expected .obj")
        lines = ["v {:.9g} {:.9g} {:.9g}".format(*position) for position in self.positions.tolist()]
        if self.uvs is None or self.uv_faces is None:
            lines += ["f {} {} {}".format(*face) for face in (self.faces + 1).tolist()]
        else:
            lines += ["vt {:.9g} {:.9g}".format(*uv) for uv in self.uvs.tolist()]
            corners = np.stack([self.faces, self.uv_faces], axis=-1).reshape(-1, 6) + 1
            lines += ["f {}/{} {}/{} {}/{}".format(*corner) for corner in corners.tolist()]
        with files.whole(path) as unfinished:
            unfinished.write_text("\n".join(lines) + "\n")


def _coordinates(name: str, values: np.ndarray, width: int, item: str) -> np.ndarray:
    """Copy to float32 [item, width]; MeshError when empty, of another shape, not finite or too large."""
    expected = f"an array [{item}, {width}]; load_mesh(path) reads a file"
    values = check.numbers(name, values, expected=expected, error=MeshError)
    if values.ndim != 2 or values.shape[1] != width or len(values) == 0:
        raise MeshError(f"{name}: got shape {values.shape}, expected [{item}, {width}] with at least one {item}")
    bad = np.flatnonzero(~(np.abs(values) <= check.LARGEST).all(axis=1))
    if len(bad):
        raise MeshError(
            f"{name}: got NaN, Inf or numbers beyond {check.LARGEST:g} at {len(bad)} of {len(values)} "
            f"(first at {item} {bad[0]}: {values[bad[0]].tolist()}), expected finite numbers"
        )
    return values


def _indices(name: str, faces: np.ndarray, count: int, item: str) -> np.ndarray:
    """Copy to int32 [face, 3]; MeshError when empty, of another shape, or out of range."""
    check.numbers(name, faces, expected="integers [face, 3]", error=MeshError)
    faces = np.asarray(faces)
    if faces.ndim != 2 or faces.shape[1] != 3 or len(faces) == 0:
        polygons = "; triangulate other polygons" if faces.ndim == 2 and faces.shape[1] > 3 else ""
        raise MeshError(f"{name}: got shape {faces.shape}, expected [face, 3] with at least one face{polygons}")
    if not np.issubdtype(faces.dtype, np.integer):
        raise MeshError(f"{name}: got {faces.dtype}, expected integers, such as faces.astype(int)")
    bad = np.argwhere((faces < 0) | (faces >= count))
    if len(bad):
        face, corner = bad[0]
        counts_from_one = faces.min() == 1 and faces.max() == count
        raise MeshError(
            f"{name}: got {len(bad)} indices out of range "
            f"(first at face {face}: {item} {faces[face, corner]}), expected 0 to {count - 1}"
            f"{f'; those that count from 1 are {name} - 1 here' if counts_from_one else ''}"
        )
    return np.array(faces, dtype=np.int32, order="C")


# ------------------------------------------------------------------------------------------------------ files


class _Part(NamedTuple):
    """One piece of a file; ``welded`` vertices lost their faces to the first of their duplicates."""

    positions: np.ndarray
    faces: np.ndarray
    uvs: np.ndarray | None = None
    uv_faces: np.ndarray | None = None
    welded: int = 0
    remark: str = ""


def load_mesh(path: str | Path) -> Mesh:
    """Read an OBJ, PLY, STL, GLB/glTF or USD file as one mesh.

    Vertices keep the file's order and none is merged or dropped. Polygons become fans of triangles. The nodes
    of a scene are concatenated in world space. Where a format ties uvs to vertices (PLY, glTF), faces refer
    to the first of the vertices that are duplicated only for their uvs (same position, and same normal where
    the file stores normals), so that a seam does not break the shading; without uvs they stay as they are.
    A USD stage is read at its earliest time, z-up turned to y-up, subdivision surfaces as their control cage.
    uvs are kept only when every face has them.

    Args:
        path: A .obj, .ply, .stl, .glb, .gltf, .usd, .usda, .usdc or .usdz file.

    Returns:
        The mesh, named after the file.

    Raises:
        MeshError: for what is not such a file, or holds no usable triangles.
        FileNotFoundError: when the file does not exist.
        ImportError: for USD without the package usd-core.

    Warns:
        Once, with the counts of degenerate faces, duplicate faces, unreferenced vertices, and dropped uvs.
    """
    path = check.path("path", path)
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        raise MeshError(f"{path}: got extension {path.suffix!r}, expected one of {', '.join(_READERS)}")
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such mesh file")
    try:
        mesh, remarks = _concatenate(reader(path), path.stem)
    except (MeshError, ImportError) as error:
        raise type(error)(f"{path}: {error}") from error
    except Exception as error:  # the readers of other libraries raise anything on a damaged file
        raise MeshError(f"{path}: not a readable {path.suffix} file ({type(error).__name__}: {error})") from error
    if remarks:
        warnings.warn(f"{path}: {', '.join(remarks)}", stacklevel=2)
    return mesh


def _concatenate(parts: list[_Part], name: str) -> tuple[Mesh, list[str]]:
    """Join parts into one mesh and remark on what may surprise."""
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
    return mesh, remarks


def _stack(blocks: Iterable[tuple]) -> tuple[np.ndarray, np.ndarray]:
    """Concatenate pairs of values and faces; the faces' indices move along."""
    values, faces = zip(*blocks, strict=True)
    offsets = np.cumsum([0] + [len(block) for block in values[:-1]])
    moved = [block + offset for block, offset in zip(faces, offsets, strict=True)]
    return np.concatenate(values), np.concatenate(moved)


def _move(part: _Part, linear: np.ndarray, translation: np.ndarray) -> _Part:
    """Apply x ↦ linear x + translation; a mirroring turns the faces over."""
    positions = part.positions.astype(np.float64) @ linear.T + translation
    part = part._replace(positions=positions.astype(np.float32))
    return _turned_over(part) if np.linalg.det(linear) < 0 else part


def _turned_over(part: _Part) -> _Part:
    """Reverse the winding of every face."""
    return part._replace(faces=part.faces[:, ::-1], uv_faces=None if part.uv_faces is None else part.uv_faces[:, ::-1])


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


def _read_obj(path: Path) -> list[_Part]:
    """Read v, vt and f lines: trimesh would split the vertices at uv seams and reorder them."""
    positions, uvs, corners, uv_corners, corner_counts = [], [], [], [], []
    text = path.read_text(encoding="utf-8", errors="replace").replace("\\\n", " ")
    for number, line in enumerate(text.split("\n"), start=1):
        try:
            match line.partition("#")[0].split():
                case ["v", x, y, z, *_]:
                    positions.append((float(x), float(y), float(z)))
                case ["vt", u, *rest]:
                    uvs.append((float(u), float(rest[0]) if rest else 0.0))
                case ["f", *tokens]:
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
    part = _Part(np.array(positions).reshape(-1, 3), np.array(corners, dtype=np.int64)[faces])
    if not uv_corners:
        return [part]
    if len(uv_corners) < len(corners):
        missing = len(corners) - len(uv_corners)
        return [part._replace(remark=f"uvs dropped because {missing} of {len(corners)} corners have none")]
    return [part._replace(uvs=np.array(uvs).reshape(-1, 2), uv_faces=np.array(uv_corners)[faces])]


def _obj_index(token: str, count: int) -> int:
    """Zero-based index of a one-based one, or of one that counts back from the last item so far."""
    index = int(token)
    return index + count if index < 0 else index - 1


def _read_trimesh(path: Path) -> list[_Part]:
    """Read PLY, STL, GLB or glTF through trimesh, with its merging, cleaning and reordering switched off."""
    import trimesh

    if path.suffix.lower() == ".gltf":
        json.loads(path.read_bytes())  # on bad JSON trimesh would read a model.gltf beside the file instead
    scene = trimesh.load_scene(path, process=False, maintain_order=True, fix_texture=False)
    parts = []
    for node in scene.graph.nodes_geometry:
        transform, geometry = scene.graph[node]
        shape = scene.geometry[geometry]
        if isinstance(shape, trimesh.Trimesh):
            parts.append(_move(_trimesh_part(shape), transform[:3, :3], transform[:3, 3]))
    return parts


def _trimesh_part(shape) -> _Part:
    """Take the arrays of a trimesh.Trimesh, its faces welded across uv seams."""
    positions, faces = np.asarray(shape.vertices, np.float32), np.asarray(shape.faces)
    corner_uvs = _ply_corner_uvs(shape)
    if corner_uvs is not None and len(corner_uvs) == 3 * len(faces):
        return _Part(positions, faces, corner_uvs, np.arange(len(corner_uvs)).reshape(-1, 3))
    uvs = getattr(shape.visual, "uv", None)
    if uvs is None:
        return _Part(positions, faces)
    # Normals in the cache are the file's; shape.vertex_normals computes missing ones, which differ at seams.
    normals = [shape.vertex_normals] if "vertex_normals" in shape._cache else []
    welded = _weld(faces, positions, *normals)
    return _Part(positions, welded, uvs, faces, len(np.unique(faces)) - len(np.unique(welded)))


def _ply_corner_uvs(shape) -> np.ndarray | None:
    """The uvs [corner, 2] of a PLY file that stores them with faces; trimesh gives each vertex only one."""
    data = shape.metadata.get("_ply_raw", {}).get("face", {}).get("data", {})
    names = data.dtype.names or () if isinstance(data, np.ndarray) else data
    if "texcoord" not in names:
        return None
    uvs = data["texcoord"]  # binary files hold [count, values], ASCII files the values alone
    return np.asarray(uvs["f1"] if getattr(uvs.dtype, "names", None) else uvs).reshape(-1, 2)


def _read_usd(path: Path) -> list[_Part]:
    """Read the visible meshes of a USD stage in world space, y up."""
    try:
        from pxr import Usd, UsdGeom
    except ImportError:
        raise ImportError("USD needs the package usd-core: pip install usd-core") from None

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
            parts.append(_move(part, to_y_up @ world[:3, :3].T, to_y_up @ world[3, :3]))
    return parts


def _usd_part(mesh, primvars, time) -> _Part:
    """Take the arrays of a UsdGeom.Mesh, polygons triangulated, in its own space."""
    positions = np.array(mesh.GetPointsAttr().Get(time) or [], dtype=np.float32).reshape(-1, 3)
    corners = np.array(mesh.GetFaceVertexIndicesAttr().Get(time) or [], dtype=np.int64)
    corner_counts = np.array(mesh.GetFaceVertexCountsAttr().Get(time) or [], dtype=np.int64)
    if corner_counts.sum() != len(corners):
        raise MeshError(f"{mesh.GetPath()}: got {len(corners)} corners, expected {corner_counts.sum()} from the counts")
    faces = _fan(corner_counts)
    part = _Part(positions, corners[faces])
    st = primvars.GetPrimvar("st")
    uv_items = {"faceVarying": np.arange(len(corners)), "vertex": corners, "varying": corners}
    if st.HasValue() and st.GetInterpolation() in uv_items:
        uvs = np.array(st.Get(time), dtype=np.float32)
        indices = np.array(st.GetIndices(time) if st.IsIndexed() else np.arange(len(uvs)))
        part = part._replace(uvs=uvs, uv_faces=indices[uv_items[st.GetInterpolation()]][faces])
    return _turned_over(part) if mesh.GetOrientationAttr().Get() == "leftHanded" else part


_READERS: dict[str, Callable[[Path], list[_Part]]] = {
    ".obj": _read_obj,
    **dict.fromkeys([".ply", ".stl", ".glb", ".gltf"], _read_trimesh),
    **dict.fromkeys([".usd", ".usda", ".usdc", ".usdz"], _read_usd),
}


# ------------------------------------------------------------------------------------------------- primitives


def plane(size: float | tuple[float, float] = 2.0, segments: int | tuple[int, int] = 64) -> Mesh:
    """Make a grid in the plane y = 0, centered at the origin, facing +y.

    Args:
        size: Edge length along x and z [scene units], one for both or a pair.
        segments: Quads along x and z, one count for both or a pair; each quad is two triangles.

    Returns:
        The mesh; u runs along +x, v along -z, both from 0 to 1.
    """
    size_x, size_z = _pair(size)
    columns, rows = _pair(segments)
    if not all(check.is_number(edge) and edge > 0 for edge in (size_x, size_z)):
        raise MeshError(f"size: got {check.described(size)}, expected a positive number, or one for x and one for z")
    if not all(check.is_integer(count) and count > 0 for count in (columns, rows)):
        raise MeshError(
            f"segments: got {check.described(segments)}, expected a positive integer, or one for x and one for z"
        )
    v, u = np.meshgrid(np.linspace(0, 1, rows + 1), np.linspace(0, 1, columns + 1), indexing="ij")
    uvs = np.stack([u, v], axis=-1).reshape(-1, 2)
    positions = np.stack([(uvs[:, 0] - 0.5) * size_x, np.zeros(len(uvs)), (0.5 - uvs[:, 1]) * size_z], axis=-1)
    corner = np.arange((rows + 1) * (columns + 1)).reshape(rows + 1, columns + 1)
    a, b, c, d = corner[:-1, :-1], corner[:-1, 1:], corner[1:, 1:], corner[1:, :-1]
    faces = np.stack([a, b, c, a, c, d], axis=-1).reshape(-1, 3)
    return Mesh(positions, faces, uvs, faces, "plane")


def _pair(value: Any) -> tuple[Any, Any]:
    """Two values, or one for both."""
    values = tuple(value) if isinstance(value, (Sequence, np.ndarray)) and not isinstance(value, str) else (value,)
    return values if len(values) == 2 else (value, value)  # the value itself is refused if it is several


def icosphere(radius: float = 1.0, subdivisions: int = 3) -> Mesh:
    """Make a sphere around the origin from an icosahedron whose faces are split in four, without uvs.

    Args:
        radius: Distance of the vertices from the origin [scene units].
        subdivisions: Number of splits s, 0 to 8: 10·4ˢ + 2 vertices and 20·4ˢ faces.
    """
    if not (check.is_number(radius) and radius > 0):
        raise MeshError(f"radius: got {check.described(radius)}, expected a positive number")
    if not check.is_integer(subdivisions) or subdivisions not in range(9):
        raise MeshError(f"subdivisions: got {subdivisions!r}, expected an integer from 0 to 8")
    # The twelve corners are the cyclic shifts of (0, ±1, ±golden); neighbors are 2 apart.
    golden = (1 + 5**0.5) / 2
    corners = np.array([(0, y, z * golden) for y in (-1, 1) for z in (-1, 1)])
    positions = np.concatenate([np.roll(corners, shift, axis=1) for shift in range(3)])
    near = np.isclose(np.linalg.norm(positions[:, None] - positions, axis=-1), 2)
    triples = [
        (a, b, c) for a in range(12) for b in range(a) for c in range(b) if near[a, b] and near[b, c] and near[a, c]
    ]
    faces = np.array([t if np.linalg.det(positions[list(t)]) > 0 else t[::-1] for t in triples])
    for _ in range(subdivisions):
        edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]], axis=-1).reshape(-1, 2)
        edges, middle = np.unique(edges, axis=0, return_inverse=True)
        ab, bc, ca = middle.reshape(-1, 3).T + len(positions)
        a, b, c = faces.T
        positions = np.concatenate([positions, positions[edges].mean(axis=1)])
        faces = np.stack([a, ab, ca, ab, b, bc, ca, bc, c, ab, bc, ca], axis=1).reshape(-1, 3)
        positions /= np.linalg.norm(positions, axis=1, keepdims=True)
    return Mesh(positions * (radius / np.linalg.norm(positions, axis=1, keepdims=True)), faces, name="icosphere")


# --------------------------------------------------------------------------------------------------- topology

_NOT_MANIFOLD = -2


def edge_neighbors(faces: np.ndarray, positions: np.ndarray | None = None) -> np.ndarray:
    """Find the face on the other side of each edge.

    Args:
        faces: Indices of positions, shape [face, 3]: edges belong together by position topology, whatever the uvs.
        positions: Vertices, shape [vertex, 3]; when given, those at the same place count as one, as a mesh needs
            whose faces have vertices of their own.

    Returns:
        Face across the edges opposite to corners 0, 1 and 2, int32 of shape [face, 3]; −1 at a border, −2 where more
        than two faces meet. Both are silhouettes from everywhere. A face with two corners at one place is passed over
        and has no neighbors itself.
    """
    check.shape("faces", faces.shape, ("face", 3))
    faces = faces.astype(np.int64) if positions is None else _places(positions)[faces]
    across = np.full(faces.shape, -1, np.int32)
    proper = np.flatnonzero((faces != np.roll(faces, 1, axis=1)).all(axis=1))
    ends = np.sort(np.stack([np.roll(faces[proper], -1, axis=1), np.roll(faces[proper], -2, axis=1)], axis=-1), axis=-1)
    first, last = ends.reshape(-1, 2).T
    _, edge, sharing = np.unique(first * (faces.max(initial=0) + 1) + last, return_inverse=True, return_counts=True)
    owner = np.repeat(proper, 3)
    total = np.zeros(len(sharing), np.int64)
    np.add.at(total, edge, owner)
    found = np.where(sharing[edge] == 2, total[edge] - owner, np.where(sharing[edge] == 1, -1, _NOT_MANIFOLD))
    across[proper] = found.reshape(-1, 3)
    return across


def _places(positions: np.ndarray) -> np.ndarray:
    """Number the places of vertices, the same for those at the same, shape [vertex]."""
    order = np.lexsort(positions.T)
    is_new = (np.diff(positions[order], axis=0) != 0).any(axis=1)
    places = np.zeros(len(positions), np.int64)
    places[order[1:]] = np.cumsum(is_new)
    return places


class Surface(NamedTuple):
    """How the faces of a mesh are joined, and what they enclose.

    Faces joined along an edge wind alike: where some wind against most of their piece, they are turned over. So normals
    of neighbors add up, and one side of a piece is its front, all over. On a one-sided piece (a Möbius strip) they
    cannot, and stay as they are. Of faces listed twice, as in "double-sided" exports, the copies wind as the first, or
    their normals would cancel.
    """

    faces: np.ndarray
    """Indices of positions, int32 of shape [face, 3]."""
    uv_faces: np.ndarray | None
    """Indices of uvs, int32 of shape [face, 3]."""
    neighbors: np.ndarray
    """Face across each edge, :func:`edge_neighbors` of vertices by their places, int32 of shape [face, 3]."""
    is_closed: bool
    """Whether no face shows its back to those outside: two share each edge and wind alike, and pieces look outward.

    A shell that is hollow inside does not count as closed: it costs a launch more, and gets the same image.
    """


def _surface(mesh: Mesh) -> Surface:
    """Join the faces; those that are listed again, with either winding, become as the first of them."""
    places = _places(mesh.positions)[mesh.faces]
    first = _first_of_equal(places)
    own = np.unique(first)
    if len(own) == len(first):
        return _joined(mesh.positions, mesh.faces, mesh.uv_faces)
    joined = _joined(mesh.positions, mesh.faces[own], None if mesh.uv_faces is None else mesh.uv_faces[own])
    row = np.searchsorted(own, first)
    wanted = _places(mesh.positions)[joined.faces][row]
    is_turned = ~np.any([(np.roll(wanted, k, axis=1) == places).all(axis=1) for k in range(3)], axis=0)
    corner = (_with_turned(places, is_turned)[:, :, None] == wanted[:, None, :]).argmax(axis=2)
    across = np.take_along_axis(joined.neighbors[row], corner, axis=1)
    return Surface(
        _with_turned(mesh.faces, is_turned),
        None if mesh.uv_faces is None else _with_turned(mesh.uv_faces, is_turned),
        np.where(across < 0, across, own[across]).astype(np.int32),
        joined.is_closed,
    )


def _first_of_equal(places: np.ndarray) -> np.ndarray:
    """The first face with the same three corners as each, in any order; a face without area is its own."""
    corners = np.sort(places, axis=1)
    _, first, group = np.unique(corners, axis=0, return_index=True, return_inverse=True)
    has_area = (np.diff(corners, axis=1) != 0).all(axis=1)
    return np.where(has_area, first[group.ravel()], np.arange(len(places)))


def _joined(positions: np.ndarray, faces: np.ndarray, uv_faces: np.ndarray | None) -> Surface:
    """Join faces of which none is listed twice."""
    neighbors, places = edge_neighbors(faces, positions), _places(positions)[faces]
    first, last = np.roll(places, -1, axis=1), np.roll(places, -2, axis=1)  # of the edges opposite to corners
    across = np.maximum(neighbors, 0)
    runs_back = (first[across] == last[:, :, None]) & (last[across] == first[:, :, None])
    winds_alike = runs_back.any(axis=2) | (neighbors < 0)
    if not winds_alike.all():
        is_turned = _turned(neighbors, winds_alike)
        winds_alike ^= is_turned[:, None] ^ is_turned[across]
        winds_alike |= neighbors < 0
        faces, neighbors = (_with_turned(values, is_turned) for values in (faces, neighbors))
        uv_faces = None if uv_faces is None else _with_turned(uv_faces, is_turned)
    is_proper = (places != first).all(axis=1)
    has_no_border = winds_alike.all() and (neighbors[is_proper] >= 0).all()
    is_closed = has_no_border and (_volumes(positions, faces[is_proper], neighbors, is_proper) > 0).all()
    return Surface(faces, uv_faces, neighbors, bool(is_closed))


def _volumes(positions: np.ndarray, faces: np.ndarray, neighbors: np.ndarray, is_proper: np.ndarray) -> np.ndarray:
    """What each piece of a mesh without borders encloses, negative where its faces look inward."""
    a, b, c = np.moveaxis((positions - positions[0].astype(np.float64))[faces], 1, 0)
    parts = np.einsum("ij,ij->i", a, np.cross(b, c)) / 6
    _, piece = np.unique(_pieces_of(neighbors)[is_proper], return_inverse=True)
    return np.bincount(piece, weights=parts)


def _pieces_of(neighbors: np.ndarray) -> np.ndarray:
    """Number of the piece that each face belongs to; those joined across an edge belong together."""
    face, edge = np.nonzero(neighbors >= 0)
    return _connected(face, neighbors[face, edge], len(neighbors))


def _connected(ends: np.ndarray, other_ends: np.ndarray, count: int) -> np.ndarray:
    """Number of the part of a graph that each of its nodes is in."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    links = coo_array((np.ones(len(ends)), (ends, other_ends)), shape=(count, count))
    return connected_components(links, directed=False)[1]


def _turned(neighbors: np.ndarray, winds_alike: np.ndarray) -> np.ndarray:
    """Faces to turn over, as few as can be, so that neighbors wind alike, bool of shape [face].

    A graph has two nodes a face, "as it is" and "turned over". Nodes of neighbors that wind alike are joined, so each
    piece of the mesh is there in both windings; the one that turns fewer faces over is taken.
    """
    count = len(neighbors)
    face, edge = np.nonzero(neighbors >= 0)
    other = neighbors[face, edge] + np.where(winds_alike[face, edge], 0, count)
    ends = np.concatenate([face, face + count]), np.concatenate([other, (other + count) % (2 * count)])
    part = _connected(*ends, 2 * count)
    as_it_is, over = part[:count], part[count:]
    kept = np.bincount(as_it_is, minlength=len(part))
    return (kept[as_it_is] < kept[over]) | ((kept[as_it_is] == kept[over]) & (as_it_is > over))


def _with_turned(values: np.ndarray, is_turned: np.ndarray) -> np.ndarray:
    """What faces have for each corner, [face, 3], with that of some faces the other way round."""
    turned = np.where(is_turned[:, None], values[:, ::-1], values)
    turned.setflags(write=False)
    return turned


# ------------------------------------------------------------------------------------------------- unwrapping


def unwrap(mesh: Mesh, *, size: int = 1024, padding: int = 4) -> Mesh:
    """Give a mesh uvs of its own: cut it into charts and lay them out side by side, with xatlas.

    Positions and faces stay as they are: a vertex on the edge of a chart has several uvs. Faces without area lie on a
    point of the texture.

    Args:
        mesh: The mesh; uvs that it has are replaced.
        size: Width and height of the texture that the uvs are meant for [texels].
        padding: Least distance between charts [texels]: half of it is how far a filter may reach beyond its chart.

    Returns:
        The mesh with uvs from 0 to 1.

    Raises:
        ImportError: when xatlas, the extra ``unwrap``, is not installed.
        MeshError: naming the argument, what it got and what it accepts.
    """
    try:
        import xatlas
    except ImportError:
        raise ImportError('unwrapping needs the package xatlas: pip install "warpshadow[unwrap]"') from None

    if not (isinstance(size, int) and isinstance(padding, int) and 0 <= padding < size):
        raise MeshError(f"size, padding: got {size} and {padding}, expected integers with 0 <= padding < size")
    positions = _to_unit_edges(mesh)
    pieces = _pieces(positions[mesh.faces], edge_neighbors(mesh.faces, mesh.positions))
    atlas = xatlas.Atlas()
    for piece in pieces:
        atlas.add_mesh(positions, mesh.faces[piece].astype(np.uint32))
    options = xatlas.PackOptions()
    options.resolution, options.padding = size, padding
    atlas.generate(pack_options=options)
    if not atlas.atlas_count:  # no face has an area
        return replace(mesh, uvs=np.zeros((1, 2), np.float32), uv_faces=np.zeros_like(mesh.faces))
    uvs: list[np.ndarray] = []
    uv_faces = np.empty_like(mesh.faces)
    for number, piece in enumerate(pieces):
        _, uv_faces_of_piece, uvs_of_piece = atlas[number]
        uv_faces[piece] = uv_faces_of_piece + sum(map(len, uvs))
        uvs.append(uvs_of_piece)
    return replace(mesh, uvs=np.concatenate(uvs), uv_faces=uv_faces)


def _to_unit_edges(mesh: Mesh) -> np.ndarray:
    """Vertices of the mesh scaled to edges of length 1: xatlas ignores faces that are small in its units."""
    corners = mesh.positions[mesh.faces].astype(np.float64)
    lengths = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1)
    center = np.mean(mesh.bounds, axis=0, dtype=np.float64)
    return ((mesh.positions - center) / (np.median(lengths) or 1.0)).astype(np.float32)


# Cosines: of the angle between faces that may count as flat (2.6°; xatlas takes 0.8°), and of that within a flat part.
_FLAT = 0.999
_SAME_SIDE = 0.5


def _pieces(corners: np.ndarray, neighbors: np.ndarray) -> list[np.ndarray]:
    """Faces [face, 3, 3] that xatlas may have at once, given those across their edges: all of them, as a rule.

    It cuts nothing where neighbors are all but coplanar, and crashes where these close around a round, finely
    tessellated body. Such a mesh comes in six pieces, by the axis that a face looks along.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    a, b, c = np.moveaxis(corners.astype(np.float64), 1, 0)
    normals = np.cross(b - a, c - a)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    face, edge = np.nonzero(neighbors >= 0)
    other = neighbors[face, edge]
    is_flat = np.sum(normals[face] * normals[other], axis=1) > _FLAT
    links = coo_array((is_flat[is_flat], (face[is_flat], other[is_flat])), shape=(len(normals), len(normals)))
    count, part = connected_components(links, directed=False)
    means = np.zeros((count, 3))
    np.add.at(means, part, normals)
    cosines = np.sum(normals * means[part], axis=1)
    if (cosines >= _SAME_SIDE * np.linalg.norm(means[part], axis=1)).all():
        return [np.arange(len(normals))]
    axis = np.abs(normals).argmax(axis=1)
    side = 2 * axis + (np.take_along_axis(normals, axis[:, None], axis=1)[:, 0] > 0)
    return [np.flatnonzero(side == number) for number in np.unique(side)]


# ---------------------------------------------------------------------------------------------------- normals


_THINNEST = 1.0e-12  # faces of a smaller height, in their length, have no area: there gradients could overflow
_SHORTEST = 1.0e-20  # so have faces of shorter edges [scene units]


@wp.kernel
def _sum_face_normals(
    # in
    positions: wp.array2d(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    # out
    sums: wp.array2d(dtype=wp.vec3d),
):
    """A thread adds the normal of one face, as long as twice its area, to its three vertices."""
    batch, face = wp.tid()
    i, j, k = faces[face][0], faces[face][1], faces[face][2]
    origin = wp.vec3d(positions[batch, i])
    along_j = wp.vec3d(positions[batch, j]) - origin
    along_k = wp.vec3d(positions[batch, k]) - origin
    normal = wp.cross(along_j, along_k)
    longest2 = wp.max(wp.dot(along_j, along_j), wp.dot(along_k, along_k))
    if wp.length(normal) > wp.float64(_THINNEST) * longest2 and longest2 > wp.float64(_SHORTEST * _SHORTEST):
        wp.atomic_add(sums, batch, i, normal)
        wp.atomic_add(sums, batch, j, normal)
        wp.atomic_add(sums, batch, k, normal)


@wp.kernel
def _normalize(
    # in
    sums: wp.array2d(dtype=wp.vec3d),
    # out
    normals: wp.array2d(dtype=wp.vec3),
):
    """A thread normalizes one vertex; zero stays zero, with a zero gradient."""
    batch, vertex = wp.tid()
    normals[batch, vertex] = wp.vec3(wp.normalize(sums[batch, vertex]))


def vertex_normals(positions: wp.array, faces: wp.array) -> wp.array:
    """Compute unit vertex normals, faces weighted by their area.

        n_v = normalize(Σ_{faces at v} (x_j − x_i) × (x_k − x_i))

    Sums are float64, since areas are squares, and lengths of normals those of areas: a mesh may have any scale. On a
    GPU their order, so their last bits, may differ between runs; see ``wp.config.deterministic``.

    Args:
        positions: Vertex positions [scene units], vec3, shape [batch, vertex].
        faces: Vertex indices, counter-clockwise seen from outside, vec3i, shape [face].

    Returns:
        Normals, vec3, shape [batch, vertex]; zero where the faces have no area or the vertex has no face.

    Raises:
        ValueError: for NaN, Inf and positions beyond 1e18.

    Differentiable: positions (with a zero gradient where the normal is zero). Not: faces.
    """
    check.finite_arrays({"positions": positions})
    device, requires_grad = positions.device, positions.requires_grad
    sums = wp.zeros(positions.shape, dtype=wp.vec3d, device=device, requires_grad=requires_grad)
    normals = wp.empty(positions.shape, dtype=wp.vec3, device=device, requires_grad=requires_grad)
    launch(
        _sum_face_normals,
        dim=(positions.shape[0], faces.shape[0]),
        inputs=[positions, faces],
        outputs=[sums],
        device=device,
    )
    launch(_normalize, dim=positions.shape, inputs=[sums], outputs=[normals], device=device)
    return normals
