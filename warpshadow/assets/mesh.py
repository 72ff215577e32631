"""Triangle meshes: files, primitives, topology, unwrapping and vertex normals.

Position topology and uv topology stay apart: a seam of the texture gives a vertex two uvs, never two normals. Vertices
keep the order they have in the file. Texture coordinates have their origin at the lower left of the image, v up.
"""

from __future__ import annotations

import functools
import hashlib
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from warpshadow import check
from warpshadow.assets import files, topology
from warpshadow.assets.color import linear_to_srgb
from warpshadow.check import AnyPath
from warpshadow.maths.adjacency import area_normals
from warpshadow.maths.convex import ConvexPart, find_convex_parts, is_convex
from warpshadow.maths.hull import find_hull
from warpshadow.maths.plane import plane_normal


class MeshError(ValueError):
    """A mesh, or a mesh file, that cannot be used; the message names the fault and its place."""


@check.frozen()
@dataclass(frozen=True, eq=False, init=False)
class Mesh:
    """A triangle mesh on the host, validated; its arrays are read-only copies.

    Positions are in units and axes of the mesh's own, right-handed; a :class:`warpshadow.Body` places them in the
    world, whose y is up. Normals point to the side from which faces are counter-clockwise. At a vertex they are the
    mean of its faces' normals, so edges look smooth unless :meth:`creased` parts them.

    Args:
        positions: Vertex positions [scene units], float32, shape [vertex, 3].
        faces: Indices of positions, counter-clockwise seen from outside, int32, shape [face, 3].
        uvs: Texture coordinates, origin at the lower left of the image, float32, shape [uv, 2], or None.
        uv_faces: Indices of uvs, int32, shape [face, 3]; None, where uvs are one for each vertex, for the faces'.
        name: Name of the mesh in messages.
        origins: Where :meth:`creased` parted vertices, the one of the mesh before that each is a copy of, int32, shape
            [vertex]: ``values[mesh.origins]``. Files do not have it. By default None.
        colors: Reflectance at vertices, linear RGB in [0, 1], float32, shape [vertex, 3], or None. It is the default of
            ``Body(mesh)``.

    Of faces that are listed again, with either winding, as in "double-sided" exports, the first alone is kept, with its
    uvs: rays would meet the others in the same place, and normals of both would cancel. Vertices keep their numbers.
    Raises:
        MeshError: when the mesh is empty, holds NaN or Inf, or an index is out of range.
        ValueError: for colors or origins of another shape, and colors out of range.
    Warns:
        Of the faces that are dropped.
    """

    positions: np.ndarray = field(repr=False)
    faces: np.ndarray = field(repr=False)
    uvs: np.ndarray | None = field(repr=False)
    uv_faces: np.ndarray | None = field(repr=False)
    name: str
    origins: np.ndarray | None = field(repr=False)
    colors: np.ndarray | None = field(repr=False)

    def __init__(
        self,
        positions: npt.ArrayLike,
        faces: npt.ArrayLike,
        uvs: npt.ArrayLike | None = None,
        uv_faces: npt.ArrayLike | None = None,
        name: str = "mesh",
        origins: npt.ArrayLike | None = None,
        colors: npt.ArrayLike | None = None,
    ):
        if uvs is None and uv_faces is not None:
            raise MeshError("uvs: got None beside uv_faces, expected the uvs that those are indices of")
        checked_arrays: dict[str, np.ndarray | None] = {"uvs": None, "uv_faces": None, "origins": None, "colors": None}
        checked_arrays["positions"] = vertices = _coordinates("positions", positions, 3, "vertex")
        checked_arrays["faces"] = indices = checked_indices("faces", faces, len(vertices), "vertex")
        if uvs is not None:
            checked_arrays["uvs"] = corners = _coordinates("uvs", uvs, 2, "uv")
            if uv_faces is None and len(corners) != len(vertices):
                raise MeshError(
                    f"uvs: got {len(corners)} for {len(vertices)} vertices, expected one for each, or uv_faces, which "
                    "say which uvs each face has"
                )
            uv_faces = indices if uv_faces is None else uv_faces
            checked_arrays["uv_faces"] = uv_indices = checked_indices("uv_faces", uv_faces, len(corners), "uv")
            if len(uv_indices) != len(indices):
                raise MeshError(f"uv_faces: got {len(uv_indices)} faces, expected {len(indices)}")
        if origins is not None:
            checked_arrays["origins"] = copied_array = np.array(origins, np.int32)
            check.shape("origins", copied_array.shape, (len(vertices),))
        if colors is not None:
            expected = "linear RGB [vertex, 3]"
            checked_arrays["colors"] = reflectances = check.pixels("colors", colors, expected=expected, error=MeshError)
            check.shape("colors", reflectances.shape, (len(vertices), 3))
            check.reflectance("colors", reflectances)
        is_first = topology.is_listed_first(vertices, indices)
        if not is_first.all():
            check.warn(f"{name}: {np.sum(~is_first)} duplicate faces dropped")
            checked_arrays |= {
                key: values[is_first] for key in ("faces", "uv_faces") if (values := checked_arrays[key]) is not None
            }
        for array in checked_arrays.values():
            if array is not None:
                array.setflags(write=False)
        vars(self).update(checked_arrays, name=name)

    def __repr__(self) -> str:
        return f"Mesh({self.name!r}, {self.vertex_count} vertices, {self.face_count} faces)"

    if not TYPE_CHECKING:  # to which it would hide names that there are not

        def __getattr__(self, name: str) -> Any:
            """Map names of other libraries to ours."""
            hint = {"vertices": "positions", "verts": "positions", "triangles": "faces"}.get(name)
            raise AttributeError(f"a Mesh has no {name!r}{hint and f' (write {hint})' or ''}")

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
        points = self.world_points()
        return points.min(axis=0), points.max(axis=0)

    def world_points(self) -> np.ndarray:
        """The vertices that faces refer to [scene units], float32 of shape [point, 3]."""
        return self.positions[self._referenced_vertices]

    @functools.cached_property
    def _referenced_vertices(self) -> np.ndarray:
        """Vertices that faces refer to, rising."""
        return np.unique(self.faces)

    @property
    def content_hash(self) -> str:
        """SHA-256 of the shape and its uvs, in hexadecimal; the name and colors do not count."""
        digest = hashlib.sha256()
        for array in (self.positions, self.faces, self.uvs, self.uv_faces):
            digest.update(b"none" if array is None else f"{array.shape}".encode() + array.tobytes())
        return digest.hexdigest()

    @functools.cached_property
    def surface(self) -> topology.MeshTopology:
        """Topology of its faces."""
        return topology.join_faces(self.positions, self.faces, self.uv_faces)

    @functools.cached_property
    def is_flat(self) -> bool:
        """Whether it lies in a plane."""
        return plane_normal(self.positions[self.surface.faces].astype(np.float64)) is not None

    @functools.cached_property
    def is_convex(self) -> bool:
        """Whether no part of it sees another: it is flat, or closed around a convex solid."""
        return self.is_flat or self.surface.is_closed and is_convex(self.positions, self.surface.faces)

    @functools.cached_property
    def convex_parts(self) -> list[ConvexPart]:
        """Its convex solids and panels of cloth; empty if other faces remain."""
        return find_convex_parts(self.positions, self.surface.faces) or []

    @functools.cached_property
    def hull_of_parts(self) -> ConvexPart | None:
        """The convex hull of its convex solids, if these stand side by side: see :mod:`.maths.hull`."""
        return find_hull(self.positions, self.convex_parts)

    @functools.cached_property
    def area(self) -> float:
        """Area of its surface [square of its units]."""
        normals = area_normals(self.positions.astype(np.float64)[self.surface.faces])
        return float(np.linalg.norm(normals, axis=1).sum() / 2)

    @functools.cached_property
    def flat_parts(self) -> list[ConvexPart]:
        """Its convex solids and flat panels; empty if other faces remain."""
        return find_convex_parts(self.positions, self.surface.faces, flat_panels=True) or []

    def transformed(
        self,
        *,
        rotation: npt.ArrayLike | None = None,
        translation: npt.ArrayLike | None = None,
        scale: npt.ArrayLike = 1.0,
    ) -> Mesh:
        """Scale, then rotate, then translate; a transform that mirrors also turns the faces over.

        Args:
            rotation: Matrix that multiplies column vectors, shape [3, 3]; the identity by default.
            translation: Offset [scene units], shape [3]; none by default.
            scale: One factor, or one for each axis, shape [3].
        Returns:
            A new mesh with the same uvs and name.
        """
        rotation = np.eye(3) if rotation is None else check.array("rotation", rotation, (3, 3))
        translation = np.zeros(3) if translation is None else check.array("translation", translation, (3,))
        part = MeshPart(self.positions, self.faces, self.uvs, self.uv_faces)
        placed_part = moved_part(part, rotation * np.broadcast_to(scale, 3), translation)
        return replace(self, positions=placed_part.positions, faces=placed_part.faces, uv_faces=placed_part.uv_faces)

    def normalized(self, size: float = 1.0) -> Mesh:
        """Move the middle of its bounds to the origin, and scale their longest edge to a size [scene units]."""
        low, high = (corner.astype(np.float64) for corner in self.bounds)
        scale = check.positive("size", size) / (high - low).max() if (high > low).any() else 1.0
        return self.transformed(scale=scale, translation=-scale * (low + high) / 2)

    def creased(self, angle: float = topology.CREASE) -> Mesh:
        """Part vertices along sharp edges, so that normals do not round them; spheres are not fitted again.

        Where a file has one vertex for all faces of a corner, normals are smooth there: edges turn dark, or bright.
        Positions, the winding of faces and uvs stay. Vertices stay the first, and copies follow: ``origins`` says of
        which, so that ``values[mesh.origins]`` are the colors or deformed positions of the new mesh.

        Args:
            angle: Edges are sharp where their faces bend by more [degrees], 0 to 180.
        """
        if not (check.is_number(angle) and 0 <= angle <= 180):
            raise MeshError(f"angle: got {check.described(angle)}, expected degrees from 0 to 180")
        faces, origins = topology.part_at_creases(self.faces, self.surface, self.positions, angle)
        colors = None if self.colors is None else self.colors[origins]
        return replace(self, positions=self.positions[origins], faces=faces, origins=origins, colors=colors)

    def welded(self) -> Mesh:
        """Join the vertices at one place, so that normals are smooth across them; a seam of uvs stays one of uvs alone.

        Exporters split vertices along such seams, and each part has normals of its own: lines run over the surface.
        Vertices of two colors stay apart, and vertices at sharp edges of boxes and the like, if they are. Vertices keep
        their numbers: faces refer to the first at each place.
        """
        colors = [] if self.colors is None else [self.colors]
        return replace(self, faces=topology.join_at_positions(self.positions, self.faces, *colors), origins=None)

    @functools.cached_property
    def split_count(self) -> int:
        """Count the vertices that :meth:`welded` would join, if normals draw lines over a smooth surface, or 0."""
        is_creased = self.origins is not None  # on purpose
        if is_creased or not topology.draws_lines(self.surface, self.positions):
            return 0
        return len(self._referenced_vertices) - len(self.welded()._referenced_vertices)

    @functools.cached_property
    def rounds_edges(self) -> bool:
        """Whether it has many sharp edges whose faces share normals, and looks better :meth:`creased`."""
        return topology.rounds_edges(self.surface, self.positions)

    @functools.cached_property
    def edge_rounding(self) -> float:
        """Mean length, over its surface, of the differences of its normals from the normals of :meth:`creased`."""
        corners = self.positions[self.faces]
        first, second = (topology.corner_normals(corners, faces) for faces in (self.faces, self.creased().faces))
        areas = np.linalg.norm(area_normals(corners.astype(np.float64)), axis=1)
        return float(areas @ np.linalg.norm(first - second, axis=2).mean(axis=1) / areas.sum())

    @functools.cached_property
    def creases(self) -> np.ndarray:
        """Edges across which normals jump, 2ᵏ for that opposite to corner k of each face, int32 of shape [face]."""
        return topology.creases(self.surface, self.positions)

    @functools.cached_property
    def smooth_pieces(self) -> np.ndarray:
        """Number of the piece of each face of ``surface``, shape [face]; no sharp edge leads through a piece."""
        return topology.smooth_pieces(self.surface, self.positions)

    def write(self, path: AnyPath) -> None:
        """Write a Wavefront OBJ file that reads back as the same arrays, bit for bit; colors stand in it as sRGB."""
        path = Path(path)
        if path.suffix.lower() != ".obj":
            raise MeshError(f"{path}: got extension {path.suffix!r}, expected .obj")
        columns = [self.positions.astype(np.float64)]
        if self.colors is not None:
            columns.append(linear_to_srgb(self.colors.astype(np.float64)))
        lines = ["v " + " ".join(f"{value:.9g}" for value in row) for row in np.hstack(columns).tolist()]
        if self.uvs is None or self.uv_faces is None:
            lines += ["f {} {} {}".format(*face) for face in (self.faces + 1).tolist()]
        else:
            lines += ["vt {:.9g} {:.9g}".format(*uv) for uv in self.uvs.tolist()]
            corners = np.stack([self.faces, self.uv_faces], axis=-1).reshape(-1, 6) + 1
            lines += ["f {}/{} {}/{} {}/{}".format(*corner) for corner in corners.tolist()]
        with files.atomic_write(path) as temporary_path:
            temporary_path.write_text("\n".join(lines) + "\n")


def _coordinates(name: str, array: npt.ArrayLike, width: int, item: str) -> np.ndarray:
    """Copy to float32 [item, width]; MeshError when empty, of another shape, not finite or too large."""
    expected = f"an array [{item}, {width}]; load_mesh(path) reads a file"
    values = check.numbers(name, array, expected=expected, error=MeshError)
    if values.ndim != 2 or values.shape[1] != width or len(values) == 0:
        raise MeshError(f"{name}: got shape {values.shape}, expected [{item}, {width}] with at least one {item}")
    bad_indices = np.flatnonzero(~(np.abs(values) <= check.LARGEST).all(axis=1))
    if len(bad_indices):
        raise MeshError(
            f"{name}: got NaN, Inf or numbers beyond {check.LARGEST:g} at {len(bad_indices)} of {len(values)} "
            f"(first at {item} {bad_indices[0]}: {values[bad_indices[0]].tolist()}), expected finite numbers"
        )
    return values


def checked_indices(name: str, array: npt.ArrayLike, count: int, item: str) -> np.ndarray:
    """Copy to int32 [face, 3]; MeshError when empty, of another shape, or out of range."""
    check.numbers(name, array, expected="integers [face, 3]", error=MeshError)
    faces = np.asarray(array)
    if faces.ndim != 2 or faces.shape[1] != 3 or len(faces) == 0:
        polygons = "; triangulate other polygons" if faces.ndim == 2 and faces.shape[1] > 3 else ""
        raise MeshError(f"{name}: got shape {faces.shape}, expected [face, 3] with at least one face{polygons}")
    if not np.issubdtype(faces.dtype, np.integer):
        raise MeshError(f"{name}: got {faces.dtype}, expected integers, such as faces.astype(int)")
    bad_indices = np.argwhere((faces < 0) | (faces >= count))
    if len(bad_indices):
        face, corner = bad_indices[0]
        counts_from_one = faces.min() == 1 and faces.max() == count
        raise MeshError(
            f"{name}: got {len(bad_indices)} indices out of range "
            f"(first at face {face}: {item} {faces[face, corner]}), expected 0 to {count - 1}"
            f"{f'; those that count from 1 are {name} - 1 here' if counts_from_one else ''}"
        )
    return np.array(faces, dtype=np.int32, order="C")


class BaseColor(NamedTuple):
    """A texture that a file of a mesh names or holds: the path of an image, or one of Pillow's; and a linear factor."""

    image: Any
    factor: tuple[float, ...] = (1.0, 1.0, 1.0)


class Gloss(NamedTuple):
    """glTF's roughness and metallic of a surface: factors, of green and blue of an image of Pillow's, if any."""

    roughness: float
    metallic: float
    image: Any = None


class EmissiveColor(NamedTuple):
    """The radiance of a glTF surface: a linear factor, of an image of Pillow's in sRGB, if any; and its material.

    ``has_own_uvs`` says that the image is on other uvs than the mesh's.
    """

    factor: tuple[float, float, float]
    image: Any = None
    material: str | None = None
    has_own_uvs: bool = False


DIFFUSE = Gloss(1.0, 0.0)  # a surface that does not shine


class MeshPart(NamedTuple):
    """One piece of a file; ``welded`` vertices lost their faces to the first of their duplicates.

    ``colors`` are linear, [vertex, 3]; ``colorless`` says why colors that it has are not. ``pictures`` has one for each
    material, None for a material without one. ``gloss`` and ``emission`` are None where the file says none.
    """

    positions: np.ndarray
    faces: np.ndarray
    uvs: np.ndarray | None = None
    uv_faces: np.ndarray | None = None
    welded: int = 0
    remark: str = ""
    colors: np.ndarray | None = None
    colorless: str = ""
    pictures: tuple[BaseColor | None, ...] = (None,)
    gloss: Gloss | None = None
    emission: EmissiveColor | None = None


def moved_part(part: MeshPart, linear: np.ndarray, translation: np.ndarray) -> MeshPart:
    """Apply x ↦ linear x + translation; a mirroring turns the faces over."""
    positions = part.positions.astype(np.float64) @ linear.T + translation
    part = part._replace(positions=positions.astype(np.float32))
    return turned_over(part) if np.linalg.det(linear) < 0 else part


def turned_over(part: MeshPart) -> MeshPart:
    """Reverse the winding of every face."""
    return part._replace(faces=part.faces[:, ::-1], uv_faces=None if part.uv_faces is None else part.uv_faces[:, ::-1])
