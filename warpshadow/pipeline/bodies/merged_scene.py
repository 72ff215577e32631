"""Merged scene: the bodies of a scene as one mesh with one set of spheres, at rest and placed in the world."""

import copy
import functools
import itertools
from collections.abc import Callable, Collection, Iterable, Sequence
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import warp as wp

from warpshadow import check
from warpshadow.device.batch import concatenate
from warpshadow.device.constants import constant, immutable
from warpshadow.device.memory import empty
from warpshadow.device.threads import locked
from warpshadow.maths.spatial_sort import z_order
from warpshadow.pipeline.bodies.geometry import CENTER, Geometry, Pivot, as_geometry, splice
from warpshadow.scene.blockers import fit_scene_spheres
from warpshadow.scene.scene import BodyLike, Scene
from warpshadow.scene.visibility import AUTO
from warpshadow.spheres import SHADOW_SPHERES, Spheres
from warpshadow.stages.geometry.normals import OneRings
from warpshadow.stages.geometry.poses import Poses

if TYPE_CHECKING:  # it is imported where a body emits
    from warpshadow.stages.emitters.samples import SampleWeights
    from warpshadow.stages.emitters.traced_transmittance import EmittingFaces
    from warpshadow.stages.textures.pyramid import Textures


class MergedScene:
    """Shared by all poses of a scene: topology, and the bodies' rest shapes, each in its own space.

    Args:
        scene: The scene; its spheres are fitted when first asked for.
    Attributes:
        faces: Indices of vertices, vec3i of shape [face]; the faces of a body wind alike.
        uvs: Texture coordinates, vec2 of shape [1, uv].
        uv_faces: Indices of uvs, vec3i of shape [face].
        has_chosen_receivers: Bodies whose receivers were chosen for them, see :meth:`with_settings`, bool of shape
            [body].
        first_vertex, first_face: Where each body begins, and the end of the last, NumPy of shape [body + 1].
    """

    def __init__(self, scene: Scene, *, device: wp.DeviceLike = "cpu", progress: bool = False):
        self.scene = scene.with_method()
        self.device = wp.get_device(device)
        self.has_chosen_receivers = np.zeros(len(scene.bodies), bool)
        self._progress = progress
        self._rings_of: dict[tuple[int, int], OneRings] = {}
        self._take_spheres: Callable[[], list[Spheres]] | None = None
        meshes = [body.mesh for body in scene.bodies]
        uvs = [np.zeros((1, 2), np.float32) if mesh.uvs is None else mesh.uvs for mesh in meshes]
        surfaces = [mesh.surface for mesh in meshes]
        faces = [surface.faces for surface in surfaces]
        uv_faces = [np.zeros_like(item.faces) if item.uv_faces is None else item.uv_faces for item in surfaces]
        self.first_vertex = _starts([mesh.positions for mesh in meshes])
        self.first_face = _starts([mesh.faces for mesh in meshes])
        self.faces = self._array(_stacked_faces(faces, self.first_vertex), wp.vec3i)
        self.uvs = self._array(np.concatenate(uvs)[None], wp.vec2)
        self.uv_faces = self._array(_stacked_faces(uv_faces, _starts(uvs)), wp.vec3i)

    def with_settings(self, scene: Scene) -> "MergedScene":
        """Copy with other settings of the bodies, such as receivers; both share the arrays that are made already."""
        other = copy.copy(self)
        other.scene = scene
        pairs = zip(self.scene.bodies, scene.bodies, strict=True)
        other.has_chosen_receivers = np.array([original.receivers != body.receivers for original, body in pairs])
        return other

    @functools.cached_property
    def vertex_order(self) -> np.ndarray:
        """Order in which neighboring vertices of a body follow each other, shape [vertex]."""
        orders = [z_order(body.mesh.positions.astype(np.float64)) for body in self.scene.bodies]
        starts = zip(self.first_vertex[:-1], orders, strict=True)
        return immutable(np.concatenate([first + order for first, order in starts]))

    @functools.cached_property
    def body_of_face(self) -> np.ndarray:
        """Body that each face belongs to, shape [face]."""
        return immutable(np.repeat(np.arange(len(self.scene.bodies)), np.diff(self.first_face)))

    @functools.cached_property
    def body_of_vertex(self) -> np.ndarray:
        """Body that each vertex belongs to, shape [vertex]."""
        return immutable(np.repeat(np.arange(len(self.scene.bodies)), np.diff(self.first_vertex)))

    @functools.cached_property
    def face_bodies(self) -> wp.array | None:
        """Number of the body that each face belongs to, int32 of shape [face]; None where there is one."""
        return self._array(self.body_of_face, wp.int32) if len(self.scene.bodies) > 1 else None

    @functools.cached_property
    def side_faces(self) -> wp.array:
        """Corners of the fronts of all faces, and then of their backs, vec3i of shape [2 · face]."""
        return self._array(np.tile(self.faces.numpy(), (2, 1)), wp.vec3i)

    @functools.cached_property
    def face_neighbors(self) -> wp.array:
        """Face across each edge, vec3i of shape [face]: :func:`warpshadow.maths.adjacency.edge_neighbors`."""
        parts = [body.mesh.surface.neighbors for body in self.scene.bodies]
        moved = [
            np.where(part < 0, part, part + first) for part, first in zip(parts, self.first_face[:-1], strict=True)
        ]
        return self._array(np.concatenate(moved), wp.vec3i)

    @functools.cached_property
    def creases(self) -> wp.array | None:
        """Creases of bodies that are shaded by pixel, int32 of shape [face]: ``Mesh.creases``; None where none has any.

        On bodies that are shaded at vertices mean slopes (:mod:`warpshadow.stages.image.slopes`) go across creases.
        """
        is_all = self.scene.visibility.traits.every_sample_receives
        is_by_pixel = [is_all or body.receivers == "pixel" for body in self.scene.bodies]
        result = np.zeros(self.first_face[-1], np.int32)
        for body in np.flatnonzero(is_by_pixel):
            result[self.first_face[body] : self.first_face[body + 1]] = self.scene.bodies[body].mesh.creases
        return self._array(result, wp.int32) if result.any() else None

    @functools.cached_property
    def smooth_pieces(self) -> wp.array:
        """Number of the smooth piece that each face is of, int32 of shape [face]: ``Mesh.smooth_pieces``.

        Each face of a body that shines is a piece: lobes may be narrower than normals turn within a pixel.
        """
        bodies = self.scene.bodies
        parts = [np.arange(len(b.mesh.faces)) if b.is_glossy else b.mesh.smooth_pieces for b in bodies]
        first = np.cumsum([0, *(part.max(initial=-1) + 1 for part in parts[:-1])])
        return self._array(np.concatenate([part + shift for part, shift in zip(parts, first, strict=True)]), wp.int32)

    @functools.cached_property
    def is_two_sided(self) -> np.ndarray:
        """Open bodies, which may be seen from behind, bool of shape [body]."""
        return np.array([not body.mesh.surface.is_closed for body in self.scene.bodies])

    @functools.cached_property
    def is_flat(self) -> np.ndarray:
        """Bodies that lie in a plane, bool of shape [body]."""
        return np.array([body.mesh.is_flat for body in self.scene.bodies])

    @functools.cached_property
    def nonplanar_bodies(self) -> list[int]:
        """Bodies that are not flat, which spheres represent in bounced light."""
        return np.flatnonzero(~self.is_flat).tolist()

    @functools.cached_property
    def is_glossy(self) -> np.ndarray:
        """Bodies that shine, bool of shape [body]."""
        return np.array([body.is_glossy for body in self.scene.bodies])

    @functools.cached_property
    def is_emitter(self) -> np.ndarray:
        """Bodies that emit light, bool of shape [body]."""
        return np.array([body.is_emitter for body in self.scene.bodies])

    @functools.cached_property
    def emitter_sample_weights(self) -> "list[SampleWeights]":
        """Samples of each emitter, at rest."""
        from warpshadow.stages.emitters.samples import find_sample_weights

        result = []
        for number in np.flatnonzero(self.is_emitter).tolist():
            mesh, is_open = self.scene.bodies[number].mesh, bool(self.is_two_sided[number])
            arguments = mesh.positions, mesh.surface.faces
            result.append(find_sample_weights(*arguments, is_two_sided=is_open, device=self.device))
        return result

    @property
    def has_beams(self) -> bool:
        """Whether a body emits within a cone alone."""
        return any(body.beam is not None for body in self.scene.bodies)

    @functools.cached_property
    def emitter_of_face(self) -> np.ndarray:
        """Number of the emitter that each face is of, −1 for none, shape [face]."""
        return np.where(self.is_emitter, np.cumsum(self.is_emitter) - 1, -1)[self.body_of_face]

    @functools.cached_property
    def emitter_beams(self) -> np.ndarray:
        """Beams of the emitters (:mod:`warpshadow.stages.emitters.spot_cones`), shape [emitter, 2]."""
        from warpshadow.stages.emitters.spot_cones import beam_of

        return np.array([beam_of(body.beam) for body in self.scene.bodies if body.is_emitter])

    def emitting_faces(
        self,
        positions: wp.array,
        emission: wp.array,
        textures: "Textures | None",
        texture_of_face: wp.array,
        axes: wp.array | None,
    ) -> "EmittingFaces":
        """Prepare the faces of emitters for rays.

        Args:
            positions, emission: Of all vertices, the radiance 0 where textures have it, vec3 of shape [vertex].
            textures: Of radiance, of one instance; None for none.
            texture_of_face: The texture of each face, −1 for none, int32 of shape [face].
            axes: Of the emitters' beams, of one instance, vec3 of shape [emitter]; None where none has one.
        """
        from warpshadow.stages.emitters.traced_transmittance import EmissionTextures, FaceBeams, emitting_faces

        is_emitting = self.is_emitter[self.body_of_face]
        faces, uv_faces = (self._array(item.numpy()[is_emitting], wp.vec3i) for item in (self.faces, self.uv_faces))
        emission_textures = None
        if textures is not None:
            texture_ids = self._array(texture_of_face.numpy()[is_emitting], wp.int32)
            emission_textures = EmissionTextures(textures, texture_ids, self.uvs[0], uv_faces)
        is_two_sided = self.is_two_sided[self.body_of_face[is_emitting]]
        face_beams = None
        if axes is not None:
            emitter_ids = self.emitter_of_face[is_emitting]
            face_beams = FaceBeams(axes.numpy()[emitter_ids], self.emitter_beams[emitter_ids])
        return emitting_faces(positions, emission, faces, is_two_sided, emission_textures, face_beams)

    @functools.cached_property
    def two_sided_faces(self) -> wp.array:
        """Indices of the faces of open bodies, int32 of shape [two-sided face]."""
        return self._array(np.flatnonzero(self.is_two_sided[self.body_of_face]), wp.int32)

    @functools.cached_property
    @locked
    def body_spheres(self) -> list:
        """Spheres of each body in its own space; none where the method asks for none."""
        if self._take_spheres is not None:
            return self._take_spheres()
        return fit_scene_spheres(self.scene, device=self.device, progress=self._progress)

    @property
    def sphere_counts(self) -> np.ndarray:
        """Number of spheres of each body, shape [body]; until they are fitted, how many are asked for, or 64."""
        if "body_spheres" in self.__dict__:
            return np.diff(self.first_sphere)
        if not self.scene.visibility.traits.has_spheres:
            return np.zeros(len(self.scene.bodies), int)
        blockers = (SHADOW_SPHERES if body.blockers == AUTO else body.blockers for body in self.scene.bodies)
        return np.array([len(spheres) if isinstance(spheres, Spheres) else spheres for spheres in blockers])

    @functools.cached_property
    def first_sphere(self) -> np.ndarray:
        """Where each body's spheres begin, and the end of the last, shape [body + 1]."""
        return _starts([spheres.radii for spheres in self.body_spheres])

    @functools.cached_property
    def rest(self) -> Geometry:
        """The bodies at rest, each in its own space; the batch is 1."""
        positions = np.concatenate([body.mesh.positions for body in self.scene.bodies])
        centers = np.concatenate([spheres.centers for spheres in self.body_spheres])
        radii = np.concatenate([spheres.radii for spheres in self.body_spheres])
        return Geometry(
            self._array(positions[None], wp.vec3),
            self._array(centers[None], wp.vec3),
            self._array(radii[None], wp.float32),
            moving=(),
            rotations=self._array(np.tile(np.eye(3), (1, len(self.scene.bodies), 1, 1)), wp.mat33),
        )

    @functools.cached_property
    def poses(self) -> Poses:
        """Where the scene has its bodies; the batch is 1."""
        bodies = self.scene.bodies
        return Poses(
            self._array(np.stack([body.rotation_matrix() for body in bodies])[None], wp.mat33),
            self._array(np.stack([body.translation for body in bodies])[None], wp.vec3),
            self._array(np.array([[body.scale for body in bodies]]), wp.float32),
        )

    def pivots(self, pivot: str | npt.ArrayLike | wp.array) -> wp.array:
        """Pivots of the bodies, each in its own space, vec3 of shape [batch, body]. Not to be written to."""
        if isinstance(pivot, wp.array):
            return pivot
        if isinstance(pivot, str):
            check.choice("pivot", pivot, (CENTER,))
            points = np.array([np.mean(body.mesh.bounds, axis=0) for body in self.scene.bodies])
        else:
            count = len(self.scene.bodies)
            points = check.numbers("pivot", pivot, expected=f"'center', or a point, [3], or one a body, [{count}, 3]")
            check.shape("pivot", points.shape, (3,) if points.ndim < 2 else (count, 3), "in a body's own space")
            check.finite("pivot", points)
        return constant(np.broadcast_to(points, (len(self.scene.bodies), 3))[None], wp.vec3, self.device)

    def scene_poses(self, *, pivot: Pivot = None) -> Poses:
        """Where the scene has its bodies; the batch is 1. Not to be written to.

        Args:
            pivot: As for :meth:`placed`: translations are then where the pivots are.
        """
        return self.poses if pivot is None else self.poses.of_pivots(self.pivots(pivot))

    @functools.cached_property
    def scene_geometry(self) -> Geometry:
        """Where the scene has its bodies and their spheres; the batch is 1."""
        return self.placed()

    def placed(
        self,
        poses: Poses | None = None,
        rest: Geometry | None = None,
        *,
        moving: Iterable[BodyLike] | None = None,
        pivot: Pivot = None,
    ) -> Geometry[wp.array]:
        """Place the bodies in the world, in arrays of their own: x → s R (x − pivot) + t.

        Args:
            poses: Of each body, by default the scene's.
            rest: The bodies in their own spaces, by default as their meshes are.
                Either batch may be 1 and then serves every instance of the other.
            moving: Bodies that ``poses`` move, by number or name; None for any. The others stand where the scene has
                them, without a gradient, unless ``rest`` comes from :meth:`deformed`: deformed bodies count as moving.
            pivot: Point of each body's own space that it is turned about and that translations put in its place:
                "center", the middle of its mesh's bounds; a point [3] for all; one for each, [body, 3], or vec3 of
                shape [batch, body]; None for the origin. ``scene_poses(pivot=…)`` are the poses to begin with.
        Differentiable: poses, rest, pivot.
        """
        rest = self.rest if rest is None else as_geometry("rest", rest)
        if poses is None:  # the scene's poses are the same for any pivot
            poses, pivot = self.poses, None
        check.shape("poses", poses.scales.shape, ("batch", len(self.scene.bodies)))
        if pivot is not None:
            poses = poses.about(self.pivots(pivot))
        numbers = None if moving is None else self.scene.body_numbers(moving, "moving")
        turned = None if rest.rotations is None else poses.turned(rest.rotations)
        if numbers is None or rest.moving is None:
            spheres = rest.centers, rest.radii, self._sphere_bodies
            arrays = poses.placed(rest.positions, self._vertex_bodies, *spheres)
            return Geometry(*arrays, rotations=turned, deformed=rest.deformed)
        bodies = {*numbers, *rest.moving}
        vertices, sphere_ranges = self.ranges_of(self.first_vertex, bodies), self.ranges_of(self.first_sphere, bodies)
        static = self.scene_geometry
        moved = {
            (a, b): poses.spheres(rest.centers[:, a:b], rest.radii[:, a:b], self._sphere_bodies[a:b])
            for a, b in sphere_ranges
        }
        if turned is not None:
            assert static.rotations is not None
            every, given_rotations = self.ranges_of(np.arange(len(self.scene.bodies) + 1), bodies), turned
            turned = splice(static.rotations, every, lambda a, b: given_rotations[:, a:b])
        return Geometry(
            splice(
                static.positions, vertices, lambda a, b: poses.points(rest.positions[:, a:b], self._vertex_bodies[a:b])
            ),
            splice(static.centers, sphere_ranges, lambda a, b: moved[a, b][0]),
            splice(static.radii, sphere_ranges, lambda a, b: moved[a, b][1]),
            moving=tuple(bodies),
            rotations=turned,
            deformed=rest.deformed,
        )

    def take_spheres(self, other: "MergedScene", bodies: Sequence[int]) -> None:
        """Take the spheres of this scene's bodies, some of another's, from the other when they are first asked for."""
        self._take_spheres = lambda: [other.body_spheres[number] for number in bodies]

    def part(self, geometry: Geometry, bodies: Sequence[int]) -> Geometry:
        """Cut some bodies, in rising order, out of a geometry of all. Differentiable in it."""

        def items(array: wp.array, starts: np.ndarray) -> wp.array:
            ranges = self.ranges_of(starts, bodies)
            return concatenate([array[:, first:end] for first, end in ranges], [end - first for first, end in ranges])

        centers, radii = self.spheres_of(bodies, (geometry.centers, geometry.radii))
        every, turned = np.arange(len(self.scene.bodies) + 1), geometry.rotations
        return Geometry(
            items(geometry.positions, self.first_vertex),
            centers,
            radii,
            rotations=None if turned is None else items(turned, every),
            deformed=tuple(bodies.index(body) for body in geometry.deformed if body in bodies),
        )

    def spheres_of(self, bodies: Collection[int], spheres: tuple[wp.array, wp.array]) -> tuple[wp.array, wp.array]:
        """Centers and radii of the spheres of some bodies, from those of all. Differentiable: spheres."""
        ranges = self.ranges_of(self.first_sphere, bodies)
        if ranges == [(0, spheres[1].shape[1])]:
            return spheres
        if not ranges:
            centers, radii = (empty((1, 0), dtype=array.dtype, device=array.device) for array in spheres)
            return centers, radii
        counts = [end - first for first, end in ranges]
        centers, radii = (concatenate([array[:, first:end] for first, end in ranges], counts) for array in spheres)
        return centers, radii

    def sphere_ranges(self, bodies: Sequence[int]) -> dict[int, tuple[int, int]]:
        """Begin and end of each body's spheres among the spheres of some bodies, rising."""
        ends = np.cumsum(self.sphere_counts[list(bodies)]).tolist() if bodies else []
        return dict(zip(bodies, itertools.pairwise([0, *ends]), strict=True))

    @staticmethod
    def ranges_of(starts: np.ndarray, bodies: Collection[int]) -> list[tuple[int, int]]:
        """Ranges of the items of some bodies; consecutive ranges are joined, empty ones left out.

        Args:
            starts: Where each body's items begin, and the end of the last: :attr:`first_vertex`, :attr:`first_sphere`
                or :attr:`first_face`.
            bodies: The bodies, from 0.
        """
        ranges: list[tuple[int, int]] = []
        for first, end in ((int(starts[number]), int(starts[number + 1])) for number in sorted(bodies)):
            if ranges and ranges[-1][1] == first:
                ranges[-1] = ranges[-1][0], end
            elif end > first:
                ranges.append((first, end))
        return ranges

    @property
    def shadow_casters(self) -> list[int]:
        """Bodies that cast shadows, from 0."""
        return [number for number, body in enumerate(self.scene.bodies) if body.casts_shadow]

    def blocker_mesh(self, positions: wp.array, bodies: Collection[int] | None = None) -> wp.Mesh | None:
        """Build the mesh for rays: the faces of bodies that cast shadows.

        Args:
            positions: Vertices of all bodies [scene units], vec3 of shape [vertex]; they are copied.
            bodies: Which bodies count, from 0; None for all.
        Returns:
            None where no such body casts a shadow.
        """
        casters = [number for number in self.shadow_casters if bodies is None or number in bodies]
        return self._mesh(positions, self.faces.numpy()[np.isin(self.body_of_face, casters)]) if casters else None

    def mesh(self, positions: wp.array, *, only_casters: bool = False) -> wp.Mesh:
        """Make the mesh of all bodies.

        Args:
            positions: Their vertices [scene units], vec3 of shape [vertex]; they are copied.
            only_casters: Whether rays miss the bodies that cast no shadows, whose faces then are points.
        """
        faces = self.faces.numpy()
        if only_casters:
            casts = np.isin(self.body_of_face, self.shadow_casters)
            faces = np.where(casts[:, None], faces, faces[:, :1])
        return self._mesh(positions, faces)

    def _mesh(self, positions: wp.array, faces: np.ndarray) -> wp.Mesh:
        return wp.Mesh(wp.clone(positions, requires_grad=False), self._array(faces.ravel(), wp.int32))

    @functools.cached_property
    def one_rings(self) -> OneRings:
        """The faces around each vertex, for normals."""
        return self.rings_of(0, int(self.first_vertex[-1]))

    def rings_of(self, first: int, end: int) -> OneRings:
        """The faces around the vertices of consecutive bodies, which have numbers from ``first`` on."""
        if (first, end) not in self._rings_of:
            faces = self.faces.numpy()
            body_faces = faces[(faces[:, 0] >= first) & (faces[:, 0] < end)] - first
            self._rings_of[first, end] = OneRings.of_faces(body_faces, end - first, device=self.device)
        return self._rings_of[first, end]

    @functools.cached_property
    def _vertex_bodies(self) -> wp.array:
        return self._members(self.first_vertex)

    @functools.cached_property
    def _sphere_bodies(self) -> wp.array:
        return self._members(self.first_sphere)

    def _members(self, starts: np.ndarray) -> wp.array:
        """Body of each item, int32."""
        return self._array(np.repeat(np.arange(len(starts) - 1), np.diff(starts)), wp.int32)

    def _array(self, values: np.ndarray, dtype: type) -> wp.array:
        return wp.array(values, dtype=dtype, device=self.device)


def _starts(parts: list[np.ndarray]) -> np.ndarray:
    """Offsets of parts that are concatenated, and the end of the last."""
    return np.cumsum([0, *map(len, parts)])


def _stacked_faces(parts: list[np.ndarray], starts: np.ndarray) -> np.ndarray:
    return np.concatenate([part + first for part, first in zip(parts, starts[:-1], strict=True)])
