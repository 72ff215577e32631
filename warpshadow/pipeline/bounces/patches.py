"""Patches of a scene: the bodies that send bounced light, their patch samples, and their reflectance."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
import warp as wp

from warpshadow.assets.mesh import Mesh
from warpshadow.device.batch import rows
from warpshadow.maths.adjacency import area_normals
from warpshadow.maths.contacts import Contact
from warpshadow.maths.plane import plane_normal
from warpshadow.pipeline.bodies.merged_scene import MergedScene
from warpshadow.pipeline.bodies.reflectance import Materials
from warpshadow.pipeline.bodies.scene_planes import ScenePlanes
from warpshadow.pipeline.bounces.contacts import find_contacts
from warpshadow.pipeline.node import Node
from warpshadow.pipeline.receivers.shading_context import ShadingContext
from warpshadow.stages.bounces.albedo import mean_over_texels, mean_over_vertices
from warpshadow.stages.bounces.radiosity import mean_over_patch_samples
from warpshadow.stages.patches import MAX_PATCHES, SAMPLES_PER_PATCH, Patches, find_patches, find_plane_patches
from warpshadow.stages.planes.face_texels import FaceTexels, find_face_texels, no_face_texels
from warpshadow.stages.planes.plane_blockers import PlaneBlockers, PlaneBody
from warpshadow.stages.receivers.receivers import Receivers, receivers_on_faces
from warpshadow.stages.sparse import SparseMatrix, multiply
from warpshadow.stages.textures.numbers import as_colors

_MIN_PATCHES = 128
"""Patches of a body of few faces, which may have as many sides as stairs. With 32 in place of 128 images of stairs with
all bounces were 7.2 in place of 6.2% off, of nested boxes 7.5 in place of 6.7%; a room's, a corner's the same."""

_PATCHES_OF_SIDE = 3
"""Patches of each smooth side: a shelf whose rows of books have 78 each was 3.3% off with 128 patches, and is 3.0%."""

_FACES_OF_PATCH = 8

OF_PATCH_SAMPLES = " of patch samples"  # suffix of the names of stages

_SCENE_PATCHES = 2048  # patches of a scene of more than 8 bodies, but no fewer than _MIN_BODY_PATCHES of each
_MIN_BODY_PATCHES = 32  # patches of each of many bodies, at least: a side of a box has some
_MIN_CONTACT_SIZE = 0.25  # of a body around whose contact texels are small, in units of the size of all bodies
_SCENE_PATCH_SAMPLES = 4096  # patch samples of the patches of a scene, but at least one of each


def _patch_count(mesh: Mesh) -> int:
    """Number of patches that a mesh wants, by its faces and its smooth sides."""
    side_count = len(np.unique(mesh.smooth_pieces))
    return min(
        MAX_PATCHES, max(_MIN_PATCHES, _PATCHES_OF_SIDE * side_count, len(mesh.surface.faces) // _FACES_OF_PATCH)
    )


class ScenePatches:
    """The patches of a scene's bodies; each body's are found when they are first asked for.

    Args:
        merged_scene: The bodies.
    Attributes:
        plane_bodies: The flat bodies among them.
    """

    def __init__(self, merged_scene: MergedScene):
        self.merged_scene = merged_scene
        self._scene_planes = ScenePlanes(merged_scene)
        self.plane_bodies = self._scene_planes.numbers
        self._of_body: dict[int, Patches] = {}
        self._means: dict[tuple, SparseMatrix] = {}
        self._senders: dict[tuple[int, ...], Senders] = {}
        self._albedo: WeakKeyDictionary[Materials, dict[tuple[int, ...], Node]] = WeakKeyDictionary()

    def of_body(self, number: int) -> Patches:
        """Patches of a body in its own frame; a flat body has a grid of them."""
        if number not in self._of_body:
            mesh, is_two_sided = (
                self.merged_scene.scene.bodies[number].mesh,
                bool(self.merged_scene.is_two_sided[number]),
            )
            corners = mesh.positions, mesh.surface.faces
            if self.merged_scene.is_flat[number]:
                others = self._scene_planes.others(number)
                normal = plane_normal(mesh.positions[mesh.surface.faces].astype(np.float64))
                heights = [(points - mesh.positions[mesh.surface.faces[0, 0]]) @ normal for points in others]
                # nobody sees the back of a ground
                is_two_sided = is_two_sided and (not others or bool(min(map(np.mean, heights)) < 0))
                points = np.concatenate(others) if others else None
                self._of_body[number] = find_plane_patches(
                    *corners,
                    is_two_sided=is_two_sided,
                    others=points,
                    contact=self._contact_of_grid(number),
                    half_spaces=self._scene_planes.half_spaces(number),
                )
            else:
                counts = self._counts
                patch_samples = max(1, min(SAMPLES_PER_PATCH, _SCENE_PATCH_SAMPLES // sum(counts.values())))
                self._of_body[number] = find_patches(
                    *corners,
                    is_two_sided=is_two_sided,
                    count=counts[number],
                    patch_samples=patch_samples,
                    contacts=self._contacts[number],
                    device=self.merged_scene.device,
                )
        return self._of_body[number]

    @functools.cached_property
    def _contacts(self) -> list[list[Contact]]:
        """Where the scene's bodies touch each other."""
        return find_contacts(self.merged_scene)

    def _contact_of_grid(self, number: int) -> Contact | None:
        """The contact of a flat body around which its texels are small.

        Texels are smallest around one point at most. None where several bodies touch it, or a small one does: then
        they are small around all bodies.
        """
        contacts = [contact for contact in self._contacts[number] if contact.is_point]
        if len(contacts) != 1:
            return None
        bodies = self.merged_scene.scene.bodies
        points = np.concatenate([body.world_points() for n, body in enumerate(bodies) if n not in self.plane_bodies])
        is_large = contacts[0].half_size * bodies[number].scale >= _MIN_CONTACT_SIZE * np.ptp(points, axis=0).max() / 2
        return contacts[0] if is_large else None

    @functools.cached_property
    def _counts(self) -> dict[int, int]:
        """Patches of each body that is not flat: of many, by its share of their area, as powers of 2.

        So bodies of one shape that differ little in size have the same.
        """
        bodies = self.merged_scene.scene.bodies
        areas = {n: body.scale**2 * body.mesh.area for n, body in enumerate(bodies) if n not in self.plane_bodies}
        total, counts = sum(areas.values()), {}
        for number, area in areas.items():
            patch_count = _SCENE_PATCHES * area / total if total > 0 else _MIN_BODY_PATCHES
            counts[number] = _patch_count(bodies[number].mesh)
            if len(areas) * MAX_PATCHES > _SCENE_PATCHES:
                maximum = int(2 ** np.floor(np.log2(max(patch_count, _MIN_BODY_PATCHES))))
                counts[number] = min(counts[number], maximum)
        return counts

    def senders(self, materials: Materials) -> Senders:
        """The bodies that are not known to be black, and flat ones that cast shadows, with their patches."""
        casting = [number for number in self.plane_bodies if self.merged_scene.scene.bodies[number].casts_shadow]
        bodies = tuple(
            number
            for number in range(len(self.merged_scene.scene.bodies))
            if number in casting or not materials.is_black(number)
        )
        if bodies not in self._senders:
            self._senders[bodies] = Senders(self.merged_scene, bodies, [self.of_body(n) for n in bodies])
        return self._senders[bodies]

    # ------------------------------------------------------------------------------------------ albedo

    def albedo(self, materials: Materials, bodies: tuple[int, ...]) -> Node:
        """Node of the mean reflectance of the patches of some bodies, of gloss with it, vec3 of shape [batch, patch].

        It is cached for as long as the materials live: that of the scene's is computed once.
        """
        nodes = self._albedo.setdefault(materials, {})
        if bodies not in nodes:
            nodes[bodies] = self._make_albedo(materials, bodies)
        return nodes[bodies]

    def _make_albedo(self, materials: Materials, bodies: tuple[int, ...]) -> Node:
        items = f"{sum(self.of_body(number).count for number in bodies):,} patches"
        means = functools.partial(self._means_of_patches, bodies, bodies)
        albedo = Node("patch albedo", means, materials.albedo, materials.textures, items=items)
        glossy_bodies = [number for number in bodies if self.merged_scene.is_glossy[number]]
        if not glossy_bodies:
            return albedo
        from warpshadow.stages.gloss.total_reflectance import total_reflectance

        means = functools.partial(self._means_of_patches, glossy_bodies, bodies)
        gloss = [Node("", means, materials.input_of(name)) for name in ("roughness", "metallic", "specular")]
        return Node("", total_reflectance, albedo, *gloss)

    def _means_of_patches(
        self,
        numbers: Sequence[int],
        bodies: tuple[int, ...],
        values: Sequence[wp.array],
        textures: Sequence[wp.array | None] | None = None,
    ) -> wp.array:
        """Means of some of the bodies' colors or numbers over the patches of all of them, where others have 0."""
        pairs = zip(values, textures or [None] * len(values), strict=True)
        all_arrays = [value if texture is None else texture for value, texture in pairs]
        arrays = {number: all_arrays[number] for number in numbers}
        total = None
        # so only varying inputs have an adjoint
        for number in sorted(numbers, key=lambda n: arrays[n].requires_grad):
            array = as_colors(arrays[number])
            size = array.shape[1:] if array.ndim == 3 else None
            colors = array if size is None else rows(array)
            total = multiply(self._mean(number, bodies, colors.shape[1], size), colors, addend=total)
        return total

    def _mean(self, number: int, bodies: Sequence[int], color_count: int, size: tuple[int, int] | None) -> SparseMatrix:
        """Weights of a body's colors in the patches of some bodies, [patch, color]; of its texels if it has a size."""
        key = number, tuple(bodies), color_count, size
        if key not in self._means:
            from scipy.sparse import csr_matrix, vstack

            mesh, patches = self.merged_scene.scene.bodies[number].mesh, self.of_body(number)
            shape = mesh.positions, mesh.surface.faces
            if size is not None:
                assert mesh.uvs is not None and mesh.surface.uv_faces is not None
                means = mean_over_texels(patches, *shape, mesh.uvs, mesh.surface.uv_faces, size)
            elif color_count == 1:
                means = csr_matrix(np.ones((patches.count, 1)))
            else:
                means = mean_over_vertices(patches, *shape)
            others = {other: csr_matrix((self.of_body(other).count, color_count)) for other in bodies}
            matrix = vstack([*(others | {number: means}).values()])
            self._means[key] = SparseMatrix.from_matrix(matrix, device=self.merged_scene.device)
        return self._means[key]


class SenderPlanes(NamedTuple):
    """The flat bodies among senders."""

    blockers: PlaneBlockers
    index_of_body: dict[int, int]  # of each among them, by the number of the body
    bodies: tuple[PlaneBody, ...]


class Senders:
    """Bodies that send light, and their patches one after another.

    Args:
        merged_scene: All bodies.
        bodies: The bodies that reflect.
        patches: Of each of them.
    Attributes:
        merged_scene, bodies, patches: As given.
        first: Where the patches of each begin, and the end of the last, NumPy of shape [body + 1].
        areas: Of all patches where the scene has their bodies [scene units²], float32 of shape [patch].
        sides: Side of a face that each patch sample lies on, int32 of shape [patch sample].
        barycentrics: And where on it, float32 of shape [patch sample, 3].
        patch_of_sample: The patch that it belongs to, int32 of shape [patch sample].
        body_of_patch: The body that it belongs to, by number, of shape [patch].
        mean: The matrix of means over patch samples, [patch, patch sample].
    """

    def __init__(self, merged_scene: MergedScene, bodies: tuple[int, ...], patches: list[Patches]):
        self.merged_scene, self.bodies, self.patches = merged_scene, bodies, patches
        self.first = np.cumsum([0, *(item.count for item in patches)])
        face_count = int(merged_scene.first_face[-1])
        sides = [
            item.patch_samples.faces + int(merged_scene.first_face[number]) + face_count * item.patch_samples.is_back
            for number, item in zip(bodies, patches, strict=True)
        ]
        owners = [item.patch_samples.patches + first for item, first in zip(patches, self.first[:-1], strict=True)]
        self.sides = _joined(sides, np.int32)
        self.barycentrics = _joined([item.patch_samples.barycentrics for item in patches], np.float32).reshape(-1, 3)
        scales = [merged_scene.scene.bodies[number].scale for number in bodies]
        areas = [scale**2 * item.areas for scale, item in zip(scales, patches, strict=True)]
        self.areas = _joined(areas, np.float32)
        self.patch_of_sample = _joined(owners, np.int32)
        weights = _joined([item.patch_samples.weights for item in patches], np.float32)
        self.body_of_patch = np.repeat(bodies, np.diff(self.first))
        self._bodies = np.repeat(bodies, [len(item) for item in sides])
        self.mean = mean_over_patch_samples(
            self.patch_of_sample, weights, int(self.first[-1]), device=merged_scene.device
        )

    def patch_samples(self, positions: wp.array, normals: wp.array) -> Receivers:
        """Patch samples as receivers, of all vertices, vec3 [batch, vertex]. Differentiable: positions, normals."""
        return receivers_on_faces(
            positions, normals, self.merged_scene.faces, self.sides, self.barycentrics, self._bodies
        )

    @functools.cached_property
    def planes(self) -> SenderPlanes | None:
        """The flat bodies among them; None without any."""
        merged_scene = self.merged_scene
        numbers = [number for number in self.bodies if merged_scene.is_flat[number]]
        if not numbers:
            return None
        bodies = []
        for number in numbers:
            sender_index, body = self.bodies.index(number), merged_scene.scene.bodies[number]
            grid = self.patches[sender_index].grid
            assert grid is not None
            starts = int(merged_scene.first_vertex[number]), int(self.first[sender_index])
            bodies.append(PlaneBody(grid, body.mesh.positions, body.mesh.surface.faces, *starts, body.casts_shadow))
        counts = len(self.areas), int(merged_scene.first_vertex[-1])
        blockers = PlaneBlockers.from_bodies(bodies, *counts, device=merged_scene.device)
        return SenderPlanes(blockers, {number: k for k, number in enumerate(numbers)}, tuple(bodies))

    @functools.cached_property
    def face_texels(self) -> FaceTexels:
        """Where the faces of flat bodies are on their grids."""
        if self.planes is None:
            return no_face_texels(self.merged_scene.device)
        merged_scene = self.merged_scene
        first_faces = merged_scene.first_face[[*self.planes.index_of_body]].tolist()
        counts = int(merged_scene.first_face[-1]), int(merged_scene.first_vertex[-1])
        return find_face_texels(self.planes.blockers, self.planes.bodies, first_faces, *counts)

    @functools.cached_property
    def mean_over_surfaces(self) -> SparseMatrix:
        """Weights of patches in the texels of flat bodies, and after these in the sides of faces, by area.

        The shape is [texel + 2 · face, patch]; rows of black surfaces are 0.
        """
        from scipy.sparse import coo_matrix, diags, vstack

        merged_scene, entries = self.merged_scene, []
        for number, first, item in zip(self.bodies, self.first[:-1], self.patches, strict=True):
            mesh = merged_scene.scene.bodies[number].mesh
            corners = item.pieces.positions(mesh.positions, mesh.surface.faces)
            areas = np.linalg.norm(area_normals(corners), axis=1) + 1e-30
            for is_back, owners in enumerate(item.patch_of_pieces):
                sides = item.pieces.faces + merged_scene.first_face[number] + is_back * merged_scene.first_face[-1]
                entries.append(np.stack([areas, sides, owners + first])[:, owners >= 0])
        areas, sides, owners = np.concatenate(entries, axis=1)
        shape = 2 * int(merged_scene.first_face[-1]), int(self.first[-1])
        matrix = coo_matrix((areas, (sides.astype(int), owners.astype(int))), shape).tocsr()
        if self.planes is not None:
            assert self.planes.blockers.texels_of_patches is not None
            matrix = vstack([self.planes.blockers.texels_of_patches.to_scipy(), matrix]).tocsr()
        sums = np.maximum(matrix.sum(axis=1).A1, 1e-30)
        return SparseMatrix.from_matrix(diags(1 / sums) @ matrix, device=merged_scene.device)

    def nearest_open_patches(self, is_open: np.ndarray) -> np.ndarray:
        """The patch whose light each has: itself if it is open, else the nearest open one of its body, if any is.

        Args:
            is_open: Bool of shape [patch].
        Returns:
            Numbers of patches, int of shape [patch].
        """
        from scipy.spatial import cKDTree

        result = np.arange(len(is_open))
        for first, end, item in zip(self.first[:-1], self.first[1:], self.patches, strict=True):
            open_patches = np.flatnonzero(is_open[first:end])
            if 0 < len(open_patches) < end - first:
                half_size = max(np.linalg.norm(np.ptp(item.centers, axis=0)) / 2, 1e-30)
                features = np.concatenate([item.centers / half_size, item.normals], axis=1)
                closed = np.flatnonzero(~is_open[first:end])
                nearest = cKDTree(features[open_patches]).query(features[closed])[1]
                result[first + closed] = first + open_patches[nearest]
        return result


def _joined(parts: list[np.ndarray], dtype: type) -> np.ndarray:
    return np.concatenate(parts).astype(dtype) if parts else np.empty(0, dtype)


def lit_patch_samples(
    senders: Senders, context: ShadingContext, nearest_spheres: np.ndarray | None = None
) -> ShadingContext:
    """Make lit points of the patch samples of bodies around other points."""
    items, find = f"{len(senders.sides):,} patch samples", senders.patch_samples
    receivers = Node("patch samples", find, context.vertices, context.normals, items=items)
    return ShadingContext(
        context.merged_scene,
        context.materials,
        context.vertices,
        context.spheres,
        receivers,
        context.call,
        normals=context.normals,
        blocker_kinds=context.blocker_kinds,
        nearest_spheres=nearest_spheres,
        shares_cache_with=context,
        suffix=OF_PATCH_SAMPLES,
    )
