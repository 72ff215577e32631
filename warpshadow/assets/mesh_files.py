"""Mesh files: OBJ, PLY, GLB, STL and USD, read without reordering vertices; and meshes of trimesh."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, Protocol, TypeGuard

import numpy as np

from warpshadow import check
from warpshadow.assets import gltf, topology
from warpshadow.assets.color import srgb_to_linear
from warpshadow.assets.image import read_rgb
from warpshadow.assets.mesh import BaseColor, Mesh, MeshError, MeshPart, checked_indices, moved_part, turned_over
from warpshadow.assets.mesh_joining import JoinedMesh, fan, join_parts, joined_normals, weld, with_colors
from warpshadow.assets.obj import read_items, read_pictures
from warpshadow.assets.ply import ply_colors, ply_corner_uvs, ply_fault
from warpshadow.check import AnyPath

if TYPE_CHECKING:  # it is imported where a file is read by it
    import trimesh


class OfTrimesh(Protocol):
    """A ``trimesh.Trimesh`` or a ``trimesh.Scene``."""

    @property
    def metadata(self) -> Mapping[str, object]:
        """Metadata that trimesh has of it, such as the file."""


MeshSource = AnyPath | OfTrimesh  # accepted sources of a mesh


def is_of_trimesh(value: object) -> TypeGuard[trimesh.Trimesh | trimesh.Scene]:
    """Whether a value is a mesh or a scene of trimesh."""
    trimesh = sys.modules.get("trimesh")  # before it is imported, nothing is
    return trimesh is not None and isinstance(value, (trimesh.Trimesh, trimesh.Scene))


class Material(NamedTuple):
    """The surface of a file's mesh, None for all that the file does not say.

    Attributes:
        texture: Linear RGB, shape [height, width, 3].
        roughness, metallic: glTF's, one number [1], one for each vertex [vertex], or a texture [height, width].
        emission: Radiance, linear RGB, of the whole mesh [3], of each vertex [vertex, 3], or a texture
            [height, width, 3].
    """

    texture: np.ndarray | None = None
    roughness: np.ndarray | None = None
    metallic: np.ndarray | None = None
    emission: np.ndarray | None = None


def load_mesh(path: MeshSource) -> Mesh:
    """Read an OBJ, PLY, STL, GLB/glTF or USD file, or trimesh's objects, as one mesh.

    - **Vertices** keep the file's order, and none is merged or dropped, but: STL, where each face has three vertices of
      its own, is welded, except at edges that bend by more than 30° if the mesh has many (``rounds_edges``), as boxes
      have. PLY and trimesh's objects without stored normals are joined as by :meth:`Mesh.welded`.
    - **Seams.** Where a format ties uvs to vertices (PLY, glTF), faces refer to the first of the vertices that are
      duplicated only for their uvs: same position and color, and same normal where the file stores normals (of
      trimesh's objects, normals that bend by 30° or less). So a seam does not break the shading.
    - **Faces** that are listed twice are dropped. Polygons become fans of triangles. The nodes of a scene are
      concatenated in world space.
    - **USD** is read at its earliest time, z-up turned to y-up, subdivision surfaces as their control cage.
    - **Textures** are a body's, and ``Body(path)`` takes them. uvs are kept only when every face has them.
    - **Colors** are read where each vertex gets one: from vertices; from faces, where no vertex has two colors; from
      the base color factor of a glTF material. PLY, OBJ and trimesh have sRGB, which is decoded; glTF, USD
      (``displayColor``) and meshes of trimesh whose ``source`` is glTF, but not copies of them, have linear values.
      Transparency does not count, nor the ``Kd`` of .mtl files.

    Args:
        path: A .obj, .ply, .stl, .glb, .gltf, .usd, .usda, .usdc or .usdz file; or a ``trimesh.Trimesh``, or the meshes
            of a ``trimesh.Scene``, which are treated like files.
    Returns:
        The mesh, named after the file.
    Raises:
        MeshError: for a file of another format, or without usable triangles.
        FileNotFoundError: when the file does not exist.
        ImportError: for USD without the package usd-core.
    Warns: Once, with the counts of degenerate faces, duplicate faces and unreferenced vertices, and the attributes that
    were dropped: uvs that some faces lack, textures, and colors that vertices cannot have.
    """
    result = _read(path)
    of_texture = ["its texture dropped, which Body(path) takes"] if result.picture is not None else []
    _warn_of(path, [*result.remarks, *result.of_colors, *of_texture])
    return result.mesh


def load_material(path: MeshSource) -> tuple[Mesh, Material]:
    """Read a mesh as :func:`load_mesh` does, and the surface that the file describes.

    A texture is the base color of glTF (times its factor), the ``map_Kd`` of OBJ, or the image of PLY, where all faces
    have the same one, and uvs. USD colors are not read. glTF's materials have roughness and metallic: factors, times
    the green and the blue of a texture, which are linear, likewise if all faces have the same; else its means count.
    They emit by their emissive factor and strength, times a texture, likewise.

    Warns:
        As there; of a texture that cannot be read, or that counts in place of colors; and of textures of roughness or
        emission of which the means count.
    """
    mesh, picture, gloss, emission, remarks, of_colors, of_gloss = _read(path)
    texture = None
    if picture is not None:
        try:
            texture = _linear_pixels(picture)
            if mesh.colors is not None:
                of_colors.append("colors of vertices do not count beside its texture")
        except (OSError, ValueError) as error:
            of_colors.append(f"its texture dropped ({error})")
    _warn_of(path, remarks + of_colors + of_gloss)
    roughness, metallic = gloss or (None, None)
    return mesh, Material(texture, roughness, metallic, emission)


def load_shape(path: MeshSource) -> Mesh:
    """Read a mesh as :func:`load_mesh` does, without a word of the colors and textures that are not read."""
    result = _read(path)
    _warn_of(path, result.remarks)
    return result.mesh


def _warn_of(path: MeshSource, remarks: list[str]) -> None:
    if remarks:
        check.warn(f"{path if check.is_path(path) else 'mesh'}: {', '.join(remarks)}")


def _read(source: MeshSource) -> JoinedMesh:
    if is_of_trimesh(source):
        return join_parts(_trimesh_parts(source), Path(source.metadata.get("file_name") or "mesh").stem)
    path = check.path("path", source)
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        raise MeshError(f"{path}: got extension {path.suffix!r}, expected one of {', '.join(_READERS)}")
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such mesh file{check.nearest_file(path)}")
    try:
        return join_parts(reader(path), path.stem)
    except (MeshError, ImportError) as error:
        raise type(error)(f"{path}: {error}") from error
    except Exception as error:  # the readers of other libraries raise anything on a damaged file
        raise MeshError(f"{path}: not a readable {path.suffix} file ({type(error).__name__}: {error})") from error


def _linear_pixels(picture: BaseColor) -> np.ndarray:
    """A picture as linear RGB, float32 of shape [height, width, 3]."""
    if isinstance(picture.image, Path):
        return read_rgb(picture.image)
    codes = np.asarray(picture.image.convert("RGB"))
    return (srgb_to_linear(codes / 255) * picture.factor).astype(np.float32)


def _read_obj(path: Path) -> list[MeshPart]:
    """Read an OBJ file: trimesh would split the vertices at uv seams and reorder them."""
    items = read_items(path)
    positions, colors, corners = items.positions, items.colors, items.corners
    faces = fan(items.corner_counts)
    pictures = read_pictures([path.parent / library for library in items.libraries])
    part = MeshPart(positions, corners[faces])
    part = part._replace(pictures=tuple(pictures.get(name) for name in sorted(items.materials)))
    if 0 < len(colors) < len(positions):
        part = part._replace(colorless=f"colors dropped, which {len(positions) - len(colors)} vertices lack")
    elif len(colors):
        part = with_colors(part, colors)
    missing_count = len(corners) - len(items.uv_corners)
    if missing_count == len(corners):
        return [part]
    if missing_count:
        return [part._replace(remark=f"uvs dropped because {missing_count} of {len(corners)} corners have none")]
    return [part._replace(uvs=items.uvs, uv_faces=items.uv_corners[faces])]


def _read_trimesh(path: Path) -> list[MeshPart]:
    """Read PLY, STL, GLB or glTF through trimesh, with its merging, cleaning and reordering switched off."""
    import trimesh

    if path.suffix.lower() == ".ply" and (fault := ply_fault(path.read_bytes())):
        raise MeshError(f"the file is cut off: {fault}")
    tree = gltf.gltf_tree(path) if path.suffix.lower() in (".gltf", ".glb") else {}
    loaded_scene = trimesh.load_scene(path, process=False, maintain_order=True, fix_texture=False)
    parts = _trimesh_parts(loaded_scene, of_file=True, factors=gltf.base_color_factors(tree))
    entries = gltf.emissive_entries(tree)
    parts = [gltf.with_entry(part, entries) for part in parts]
    if path.suffix.lower() == ".stl":
        if not any(len(part.faces) for part in parts):
            raise MeshError(f"faces: got none, expected at least one triangle{_stl_fault(path.read_bytes())}")
        return [_weld_corners(part) for part in parts]
    if gltf.cuts_colors(tree):
        parts = [part._replace(colors=None, colorless="colors of 16 bits without a material dropped") for part in parts]
    return parts


def _stl_fault(content: bytes) -> str:
    """Why an STL file has no faces, for messages: it is often cut off, as by a download that was not whole."""
    if content[:5] == b"solid" and b"facet" in content:
        return "" if b"endsolid" in content else "; the file is cut off: it has no endsolid"
    count = int.from_bytes(content[80:84], "little")
    size = 84 + 50 * count
    if len(content) >= max(size, 84):
        return ""
    has_header = len(content) >= 84
    return f"; the file is cut off: got {len(content)} bytes" + (
        f", and its header says {count} triangles, which are {size}" if has_header else ", fewer than its header has"
    )


def _weld_corners(part: MeshPart) -> MeshPart:
    """Weld vertices of the same place and color, where every face has three of its own.

    Sharp edges keep two where they are many, as of boxes. Where angles of all sizes occur, normals round them, as
    in files of the same mesh without normals.
    """
    vertex_attributes = [] if part.colors is None else [part.colors]
    is_first = topology.is_listed_first(part.positions, part.faces)  # edges of the others would have too many faces
    remark = "" if is_first.all() else f"{np.sum(~is_first)} duplicate faces dropped"
    first_vertices, faces = np.unique(
        weld(part.faces[is_first], part.positions, *vertex_attributes), return_inverse=True
    )
    positions, faces = part.positions[first_vertices], faces.reshape(-1, 3)
    colors = None if part.colors is None else part.colors[first_vertices]
    surface = topology.join_faces(positions, faces, None)
    if topology.rounds_edges(surface, positions):
        faces, origins = topology.part_at_creases(faces, surface, positions, topology.CREASE)
        positions, colors = positions[origins], None if colors is None else colors[origins]
    return part._replace(positions=positions, faces=faces, colors=colors, remark=remark)


def _trimesh_parts(
    source: trimesh.Trimesh | trimesh.Scene, *, of_file: bool = False, factors: gltf.Factors = gltf.NO_FACTORS
) -> list[MeshPart]:
    """The meshes of a scene of trimesh in world space; or one mesh, as it is."""
    import trimesh

    if isinstance(source, trimesh.Trimesh):
        return [_trimesh_part(source, of_file, factors)]
    scene, parts = source, []
    for node in scene.graph.nodes_geometry:
        transform, geometry = scene.graph[node]
        shape = scene.geometry[geometry]
        if isinstance(shape, trimesh.Trimesh):
            parts.append(moved_part(_trimesh_part(shape, of_file, factors), transform[:3, :3], transform[:3, 3]))
    return parts


def _trimesh_part(shape, of_file: bool, factors: gltf.Factors) -> MeshPart:
    """Take the arrays of a trimesh.Trimesh, its faces welded across uv seams."""
    material = getattr(shape.visual, "material", None)
    pictures = (_trimesh_picture(material, factors),)
    positions, faces = np.asarray(shape.vertices, np.float32), np.asarray(shape.faces)
    gloss, emission = gltf.gloss_of(material), gltf.emission_of(material)
    part = MeshPart(positions, faces, pictures=pictures, gloss=gloss, emission=emission)
    part = _trimesh_colored(part, shape, factors)
    corner_uvs = ply_corner_uvs(shape)
    if corner_uvs is not None and len(corner_uvs) == 3 * len(faces):
        return part._replace(uvs=corner_uvs, uv_faces=np.arange(len(corner_uvs)).reshape(-1, 3))
    uvs = getattr(shape.visual, "uv", None)
    vertex_attributes = [] if part.colors is None else [part.colors]
    normals = _stored_normals(shape)
    keeps_faces = shape.source.file_type in ("glb", "gltf", "stl")  # faces without normals are flat; or welded later
    if normals is None and not keeps_faces and len(faces) and np.isfinite(positions).all():
        checked_faces = checked_indices("faces", faces, len(positions), "vertex")
        welded_vertices = topology.join_at_positions(positions, checked_faces, *vertex_attributes)
    elif uvs is None:
        return part
    else:  # normals of meshes that were changed differ a little at seams
        stored_normals = [] if normals is None else [normals if of_file else joined_normals(positions, normals)]
        welded_vertices = weld(faces, positions, *vertex_attributes, *stored_normals)
    welded_count = len(np.unique(faces)) - len(np.unique(welded_vertices))
    return part._replace(faces=welded_vertices, uvs=uvs, uv_faces=None if uvs is None else faces, welded=welded_count)


def _stored_normals(shape: trimesh.Trimesh) -> np.ndarray | None:
    """Normals of vertices, if they differ from trimesh's own, which it computes of the faces; else None."""
    import trimesh

    if "vertex_normals" not in shape._cache:
        return None
    computed_normals = trimesh.Trimesh(shape.vertices, shape.faces, process=False).vertex_normals
    return None if np.allclose(shape.vertex_normals, computed_normals, atol=1e-4) else shape.vertex_normals


def _trimesh_colored(part: MeshPart, shape, factors: gltf.Factors) -> MeshPart:
    """Give a part the colors that a mesh of trimesh has: of vertices, of faces, or of its material."""
    from trimesh.visual import to_rgba

    visual, linear = shape.visual, shape.source.file_type in ("glb", "gltf")
    if visual.kind == "face":
        return with_colors(part, visual.face_colors[:, None].repeat(3, axis=1), linear=linear)
    of_ply = ply_colors(shape)
    if visual.kind == "vertex":
        colors = visual.vertex_colors
        if of_ply is not None and np.array_equal(to_rgba(of_ply)[:, :3], colors[:, :3]):
            colors = of_ply  # which trimesh cut to 8 bits
        return with_colors(part, colors, linear=linear)
    if visual.kind != "texture":
        return part
    colors = visual.vertex_attributes.get("color", of_ply)
    if colors is not None:
        part = with_colors(part, colors, linear=linear)
    factor = gltf.base_color_factor(visual.material, factors)
    if factor is None or any(part.pictures) or factor == (1.0, 1.0, 1.0):  # white, glTF's default, says nothing
        return part
    white = np.ones((len(part.positions), 3), np.float32)
    return part._replace(colors=(white if part.colors is None else part.colors) * np.array(factor, np.float32))


def _trimesh_picture(material, factors: gltf.Factors) -> BaseColor | None:
    """The picture of a material, glTF's or a simple one."""
    from trimesh.visual.material import empty_material

    image = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
    if image is None or image == empty_material().image:  # which trimesh puts where there is none
        return None
    factor = gltf.base_color_factor(material, factors)
    return BaseColor(image) if factor is None else BaseColor(image, factor)


def _read_usd(path: Path) -> list[MeshPart]:
    """Read the visible meshes of a USD stage in world space, y up."""
    check.importable("pxr", "USD", "usd-core", "usd")
    from pxr import Usd, UsdGeom

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
    faces = fan(corner_counts)
    part = MeshPart(positions, corners[faces])
    polygons = np.repeat(np.arange(len(corner_counts)), corner_counts)
    items = {"faceVarying": np.arange(len(corners)), "vertex": corners, "varying": corners}
    color_items = items | {"uniform": polygons, "constant": np.zeros_like(corners)}
    display_color = primvars.GetPrimvar("displayColor")
    if display_color.HasValue() and display_color.GetInterpolation() in color_items:
        colors = np.array(display_color.ComputeFlattened(time), dtype=np.float32)
        part = with_colors(part, colors[color_items[display_color.GetInterpolation()]][faces], linear=True)
    st = primvars.GetPrimvar("st")
    if st.HasValue() and st.GetInterpolation() in items:
        uvs = np.array(st.Get(time), dtype=np.float32)
        indices = np.array(st.GetIndices(time) if st.IsIndexed() else np.arange(len(uvs)))
        part = part._replace(uvs=uvs, uv_faces=indices[items[st.GetInterpolation()]][faces])
    return turned_over(part) if mesh.GetOrientationAttr().Get() == "leftHanded" else part


_READERS: dict[str, Callable[[Path], list[MeshPart]]] = {
    ".obj": _read_obj,
    **dict.fromkeys([".ply", ".stl", ".glb", ".gltf"], _read_trimesh),
    **dict.fromkeys([".usd", ".usda", ".usdc", ".usdz"], _read_usd),
}

MESH_SUFFIXES = tuple(_READERS)  # suffixes of mesh files
