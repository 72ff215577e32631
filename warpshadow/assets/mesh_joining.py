"""Joining the parts of a mesh file: into one mesh with one picture, gloss and colors."""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from warpshadow.assets.color import GRAY, srgb_to_linear
from warpshadow.assets.gltf import emission_texels, gloss_texels
from warpshadow.assets.mesh import DIFFUSE, BaseColor, Gloss, Mesh, MeshError, MeshPart, checked_indices
from warpshadow.assets.topology import CREASE, first_at_positions, is_listed_first
from warpshadow.maths.adjacency import area_normals


class JoinedMesh(NamedTuple):
    """A mesh, the picture that all its faces share, its gloss, and remarks on surprises: on shape, colors and gloss.

    ``gloss`` has roughness and metallic of the body, each [1], of each vertex, [vertex], or a texture [height, width];
    ``emission`` radiance of the body, [3], of each vertex, [vertex, 3], or a texture [height, width, 3].
    """

    mesh: Mesh
    picture: BaseColor | None
    gloss: tuple[np.ndarray, np.ndarray] | None
    emission: np.ndarray | None
    remarks: list[str]
    of_colors: list[str]
    of_gloss: list[str]


def join_parts(parts: list[MeshPart], name: str) -> JoinedMesh:
    """Join parts into one mesh, and find the picture that all have."""
    vertex_count = sum(len(part.positions) for part in parts)
    parts = [part for part in parts if len(part.faces)]
    if not parts:
        cause = "; is it a cloud of points, or cut off?" if vertex_count else ""
        raise MeshError(f"faces: got none ({vertex_count} vertices), expected at least one triangle{cause}")
    positions, faces = stack((part.positions, part.faces) for part in parts)
    textured = [(part.uvs, part.uv_faces) for part in parts if part.uvs is not None]
    uvs, uv_faces = stack(textured) if len(textured) == len(parts) else (None, None)
    referenced_vertices = np.unique(checked_indices("faces", faces, len(positions), "vertex"))
    is_first = is_listed_first(positions, faces)  # here, so that one warning has all remarks
    own_uv_faces = None if uv_faces is None else uv_faces[is_first]
    mesh = Mesh(positions, faces[is_first], uvs, own_uv_faces, name, colors=_joined_colors(parts))

    normals = area_normals(mesh.positions.astype(np.float64)[mesh.faces])
    counts = {
        "degenerate faces (no area)": np.sum(~normals.any(axis=1)),
        "duplicate faces dropped": np.sum(~is_first),
        "unreferenced vertices": mesh.vertex_count - len(referenced_vertices) - sum(part.welded for part in parts),
    }
    remarks = [f"{count} {fault}" for fault, count in counts.items() if count]
    remarks += [part.remark for part in parts if part.remark]
    if 0 < len(textured) < len(parts):
        remarks.append(f"uvs dropped because {len(parts) - len(textured)} of {len(parts)} parts have none")
    of_colors = sorted({part.colorless for part in parts if part.colorless})
    reason = "which need uvs" if mesh.uvs is None else "since a body takes one that all its faces have"
    pictures = [picture for part in parts for picture in part.pictures]
    is_one = mesh.uvs is not None and all(picture == pictures[0] for picture in pictures)
    if any(pictures) and not is_one:
        of_colors.append(f"textures dropped, {reason}")
    glosses = [part.gloss or DIFFUSE for part in parts]
    of_gloss = []
    if any(gloss.image for gloss in glosses) and (mesh.uvs is None or any(gloss != glosses[0] for gloss in glosses)):
        of_gloss.append(f"of textures of roughness and metallic the means count, {reason}")
    gloss = _joined_gloss(glosses, [len(part.positions) for part in parts], has_textures=not of_gloss)
    emissions = [part.emission for part in parts]
    has_images = any(emission and emission.image for emission in emissions)
    has_own_uvs = any(emission and emission.image and emission.has_own_uvs for emission in emissions)
    is_shared = mesh.uvs is not None and not has_own_uvs and all(emission == emissions[0] for emission in emissions)
    if has_images and not is_shared:
        reason = "since a body takes those on the first uvs, of texCoord 0" if has_own_uvs else reason
        of_gloss.append(f"of textures of emission the means count, {reason}")
    picture, emission = pictures[0] if is_one else None, _joined_emission(parts, has_textures=is_shared)
    return JoinedMesh(mesh, picture, gloss, emission, remarks, of_colors, of_gloss)


def _joined_emission(parts: list[MeshPart], *, has_textures: bool) -> np.ndarray | None:
    """Radiance of all parts, of each vertex where they differ; None if no part emits."""
    texels = [np.zeros(3, np.float32) if part.emission is None else emission_texels(part.emission) for part in parts]
    if has_textures and texels[0].ndim == 3:
        return texels[0]
    radiance = np.array([item.reshape(-1, 3).mean(axis=0) for item in texels], np.float32)
    if not radiance.any():
        return None
    is_one = (radiance == radiance[0]).all()
    return radiance[0] if is_one else np.repeat(radiance, [len(part.positions) for part in parts], axis=0)


def _joined_gloss(
    glosses: list[Gloss], vertex_counts: list[int], *, has_textures: bool
) -> tuple[np.ndarray, np.ndarray] | None:
    """Roughness and metallic of all parts, of each vertex where they differ; None if all parts are diffuse."""
    if has_textures and all(gloss == glosses[0] for gloss in glosses):
        roughness, metallic = gloss_texels(glosses[0])
    else:
        means = [[texels.mean() for texels in gloss_texels(gloss)] for gloss in glosses]
        counts = [1] if all(mean == means[0] for mean in means) else vertex_counts
        roughness, metallic = np.repeat(np.array(means[: len(counts)], np.float32), counts, axis=0).T
    return (roughness, metallic) if roughness.min() < 1 or metallic.max() > 0 else None


def _joined_colors(parts: list[MeshPart]) -> np.ndarray | None:
    """Colors of the vertices of all parts, gray where a part has none; None if no part has any."""
    if all(part.colors is None for part in parts):
        return None
    gray = np.array(GRAY, np.float32)
    shapes = [(len(part.positions), 3) for part in parts]
    return np.concatenate(
        [
            np.broadcast_to(gray if part.colors is None else part.colors, shape)
            for part, shape in zip(parts, shapes, strict=True)
        ]
    )


def stack(blocks: Iterable[tuple]) -> tuple[np.ndarray, np.ndarray]:
    """Concatenate pairs of values and faces; the faces' indices move along."""
    values, faces = zip(*blocks, strict=True)
    offsets = np.cumsum([0] + [len(block) for block in values[:-1]])
    offset_faces = [block + offset for block, offset in zip(faces, offsets, strict=True)]
    return np.concatenate(values), np.concatenate(offset_faces)


def fan(corner_counts: np.ndarray) -> np.ndarray:
    """Corner numbers [triangle, 3] of the fans that triangulate consecutive polygons."""
    if (corner_counts < 3).any():
        polygon = np.flatnonzero(corner_counts < 3)[0]
        raise MeshError(f"faces: got {corner_counts[polygon]} corners at face {polygon}, expected 3 or more")
    triangle_counts = corner_counts - 2
    first = np.repeat(np.cumsum(corner_counts) - corner_counts, triangle_counts)
    step = np.arange(len(first)) - np.repeat(np.cumsum(triangle_counts) - triangle_counts, triangle_counts)
    return np.stack([first, first + step + 1, first + step + 2], axis=1)


def weld(faces: np.ndarray, *attributes: np.ndarray) -> np.ndarray:
    """Let faces refer to the first of the vertices that agree in all attributes."""
    return first_at_positions(np.column_stack(attributes))[faces]


def joined_normals(positions: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Normals [vertex, 3], where vertices at one place get the first one's, unless they bend by more than a crease."""
    _, position_ids = np.unique(positions + 0.0, axis=0, return_inverse=True)
    position_ids = position_ids.reshape(-1)
    welded_normals, first, left = np.array(normals), np.empty(len(position_ids), np.int64), np.arange(len(position_ids))
    while len(left):
        first[position_ids[left[::-1]]] = left[::-1]
        first_normals = normals[first[position_ids[left]]]
        is_close = (normals[left] * first_normals).sum(axis=1) >= np.cos(np.radians(CREASE))
        is_close |= (first[position_ids[left]] == left) | ~normals[left].any(axis=1)  # vertices of no face get zero
        welded_normals[left[is_close]] = first_normals[is_close]
        left = left[~is_close]
    return welded_normals


def with_colors(part: MeshPart, values: np.ndarray, *, linear: bool = False) -> MeshPart:
    """Give a part colors of its vertices, or of the corners of its faces if no vertex gets two.

    Args:
        part: Their mesh.
        values: Codes, up to 65535 in unsigned numbers of 16 bits, up to 255 in other whole ones; or floats from 0 to 1;
            of shape [vertex, 3 or 4] or [face, 3, 3 or 4].
        linear: Whether they are; else they are sRGB.
    """
    values = values[..., :3]
    values = values / (65535 if values.dtype == np.uint16 else 255 if values.dtype.kind in "ui" else 1.0)
    if not ((values >= 0) & (values <= 1)).all():
        reason = f"got values from {values.min():g} to {values.max():g}, expected 0 to 1"
        return part._replace(colorless=f"colors dropped ({reason})")
    colors = (values if linear else srgb_to_linear(values)).astype(np.float32)
    if colors.ndim == 2:
        return part._replace(colors=colors)
    vertex_colors = np.tile(np.array(GRAY, np.float32), (len(part.positions), 1))
    vertex_colors[part.faces] = colors
    if np.array_equal(vertex_colors[part.faces], colors):
        return part._replace(colors=vertex_colors)
    reason = "faces of different colors share vertices, which trimesh's unmerge_vertices() parts"
    return part._replace(colorless=f"colors of faces dropped ({reason})")
