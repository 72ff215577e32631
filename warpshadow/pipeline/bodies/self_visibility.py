"""Self-visibility: which bodies trace their shadows on themselves with rays, and the cached results.

The self-visibility of a rigid body does not change in its own frame. So rays find it once, and it is cached on disk
beside the spheres that are fitted to the mesh. Spheres of other bodies block their shares of the remaining light.
"""

import functools
import hashlib
import json
import weakref
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np
import warp as wp

from warpshadow import check
from warpshadow.assets.cache import Unfinished, cache_path, load_or_compute
from warpshadow.assets.mesh import Mesh
from warpshadow.device.batch import cut
from warpshadow.device.cuda_graph import is_readable
from warpshadow.device.memory import from_numpy, zeros
from warpshadow.device.progress import announce
from warpshadow.device.tape import unrecorded
from warpshadow.pipeline.bodies.geometry import Geometry
from warpshadow.pipeline.bodies.merged_scene import MergedScene
from warpshadow.scene.blockers import blocking_parts, find_solids
from warpshadow.spheres.normalized_mesh import normalize
from warpshadow.stages.geometry.normals import vertex_normals
from warpshadow.stages.raster.rasterization import Fragments
from warpshadow.stages.rays.ray_packets import FaceTree, build_face_tree
from warpshadow.stages.receivers.body_spans import Span
from warpshadow.stages.receivers.receivers import Receivers
from warpshadow.stages.self_visibility.buried import find_buried, find_dilation
from warpshadow.stages.self_visibility.gather import BodyTables, gather_self_transmittance
from warpshadow.stages.self_visibility.lookup import (
    BodyKernels,
    ResamplingWeights,
    find_body_kernels,
    find_resampling_weights,
)
from warpshadow.stages.self_visibility.probes import (
    ProbeTables,
    ProbeWeights,
    VisibilityProbes,
    find_probes,
    longest_edge,
)
from warpshadow.stages.self_visibility.self_transfer import (
    BodyRotation,
    find_body_rotation,
    find_self_transfer,
    project_rows,
)
from warpshadow.stages.self_visibility.sun_cells import RayProbes
from warpshadow.stages.self_visibility.trace import (
    RAYS,
    RAYS_PER_CELL,
    VisibilityRows,
    ray_count,
    trace_rows,
    trace_seconds,
)

VERSION = 7  # part of the key of cached rows: raise it whenever they would come out differently
_FRONT, _BACK = 1, -1  # sides of a body, as signs of the normals of its probes
FREE_SHAPE = "its shape is free"  # why a body of free shape blocks its own light, and that of others, by spheres


Found = TypeVar("Found")

_OF_MESHES: weakref.WeakKeyDictionary[Mesh, dict[tuple[str, bool, str], object]] = weakref.WeakKeyDictionary()
"""Probes and rows of each mesh in memory, for all renderers, by their kind, whether samples receive, and device."""


class SelfVisibilityLookup(NamedTuple):
    """Self-visibility lookups of receivers of some bodies."""

    bodies: tuple[int, ...]
    trace_seen_backs: Callable[[ProbeWeights, tuple[Span, ...]], None]  # fills rows of backs with receivers
    tables: BodyTables
    weights: ResamplingWeights
    kernels: BodyKernels
    rays: tuple[RayProbes, wp.array] | None = None  # for a sun, and the rotations; None where it is looked up, too

    @property
    def placed_arrays(self) -> Mapping[str, wp.array]:
        """The part that depends on the rotations."""
        return {"rotations": self.weights.weights}

    @property
    def is_of_one_body(self) -> bool:
        """Whether it serves the receivers of one body alone."""
        return self.rays is not None

    def transmittance(self, normals: wp.array, weights: ProbeWeights, spans: tuple[Span, ...]) -> wp.array:
        """Transmittance of receivers in spans past their bodies, [batch, receiver, cell]."""
        self.trace_seen_backs(weights, spans)
        table_of_span = [self.bodies.index(span.body) for span in spans]
        return gather_self_transmittance(
            normals, weights, self.weights, self.kernels, self.tables, spans, table_of_span
        )


class SelfTransfer(NamedTuple):
    """Self-visibility of a body where light is in harmonics: self-transfer of its probes, and its rotation."""

    probe_transfer: wp.array  # [row, order²]
    rotation: BodyRotation

    @property
    def placed_arrays(self) -> Mapping[str, wp.array]:
        """The part that depends on the rotations."""
        return {"rotations": self.rotation.rotations}

    @property
    def is_of_one_body(self) -> bool:
        """True: self-transfer is rotated with its body."""
        return True

    def of_receivers(self, weights: ProbeWeights, *, order: int, bands: int | None = None) -> wp.array:
        """Self-transfer of receivers, [batch, receiver, bands²]; by default all bands of an order."""
        return find_self_transfer(self.probe_transfer, weights, self.rotation, order=order, bands=bands)


SelfLookup = SelfVisibilityLookup | SelfTransfer
"""Self-visibility of receivers, in cells or in bands."""


class SelfVisibility:
    """Traced self-visibility of the bodies, each in its own frame.

    Args:
        merged_scene: The bodies.
        samples_receive: Bodies on which samples are receivers, bool of shape [body]: they have probes within faces.
        progress: Whether to show the progress of tracing.
    """

    def __init__(self, merged_scene: MergedScene, samples_receive: np.ndarray, *, progress: bool = False):
        self._merged_scene, self._samples_receive, self._progress = merged_scene, samples_receive, progress
        self._probes: dict[int, VisibilityProbes] = {}
        self._tables: dict[tuple[int, ...], ProbeTables] = {}
        self._rows: dict[int, VisibilityRows] = {}
        self._bodies_with_backs: set[int] = set()  # open ones whose backs have rows
        self._probe_transfer: dict[tuple[int, int], wp.array] = {}
        self._body_tables: dict[tuple[int, ...], BodyTables] = {}

    # ----------------------------------------------------------------------------------- kind of self-shadow

    def why_spheres(self, body: int, geometry: Geometry | None) -> str:
        """Why a body's own spheres block its light in a geometry, by default the scene's; empty if they do not."""
        scene = self._merged_scene.scene
        if not scene.bodies[body].casts_shadow:
            return "it casts no shadow"
        if self._how(body) == "spheres":
            return 'self_shadows = "spheres"'
        if geometry is not None and body in geometry.deformed:
            return FREE_SHAPE
        if geometry is not None and geometry.rotations is None:
            return "geometry has no rotations; placed(…) makes one that has them"
        return ""

    @property
    def wants_rays(self) -> bool:
        """Whether receivers of some body send rays to sun cells."""
        return any(map(self._sends_rays, range(len(self._samples_receive))))

    def _sends_rays(self, body: int) -> bool:
        """Whether receivers of a body send rays: at pixels, since between vertices an edge would be too sharp."""
        return self._how(body) == "rays" and bool(self._samples_receive[body])

    def _how(self, body: int) -> str:
        """The kind of shadow that a body casts on itself: one of SELF_SHADOWS."""
        scene = self._merged_scene.scene
        return scene.bodies[body].self_shadows_in(scene.visibility)

    # ----------------------------------------------------------------------------------------- probes

    def probes(self, body: int) -> VisibilityProbes:
        """The probes of a body, in the frame of its fit."""
        if body not in self._probes:
            mesh, device = self._merged_scene.scene.bodies[body].mesh, self._merged_scene.device
            faces = mesh.surface.faces

            def find() -> VisibilityProbes:
                used, positions = np.unique(faces), np.zeros(mesh.positions.shape, np.float32)
                positions[used], *_ = normalize(mesh.positions[used].astype(np.float64))
                points = from_numpy(positions[None], dtype=wp.vec3, device=device)
                normals = vertex_normals(points, from_numpy(faces, dtype=wp.vec3i, device=device)).numpy()[0]
                samples_receive = bool(self._samples_receive[body])
                longest = longest_edge(positions, faces, has_sample_receivers=samples_receive)
                if not samples_receive or mesh.smooth_pieces.max() == 0:
                    return find_probes(positions, normals, faces, longest)
                whole = wp.Mesh(points.flatten(), from_numpy(faces.ravel(), dtype=wp.int32, device=device))
                return find_probes(positions, normals, faces, longest, functools.partial(find_buried, whole))

            self._probes[body] = self._cached_by_mesh(body, "probes", find)
        return self._probes[body]

    def _cached_by_mesh(self, body: int, name: str, find: Callable[[], Found]) -> Found:
        """Self-visibility of a body's mesh, shared by all renderers, computed at first use."""
        cached: dict = _OF_MESHES.setdefault(self._merged_scene.scene.bodies[body].mesh, {})
        key = name, bool(self._samples_receive[body]), self._merged_scene.device.alias
        if key not in cached:
            cached[key] = find()
        return cached[key]

    def probe_weights(self, receivers: Receivers, first: int, spans: tuple[Span, ...]) -> ProbeWeights:
        """Where receivers lie among the probes of their bodies. Differentiable: barycentrics of samples.

        Args:
            receivers: All of them.
            first: The first of those asked for.
            spans: These, counted from there, all at vertices or all at samples.
        """
        assert receivers.vertices is not None
        bodies = tuple(dict.fromkeys(span.body for span in spans))
        end, vertex_count = first + spans[-1].end, receivers.vertices.size
        tables, table_indices = self._tables_of(bodies), [bodies.index(span.body) for span in spans]
        if first < vertex_count:
            return tables.of_vertices(receivers.vertices[first:end], spans, table_indices)
        fragments, first, end = receivers.sample_fragments, first - vertex_count, end - vertex_count
        assert fragments is not None
        cut_fragments = Fragments(cut(fragments.face_ids, first, end), cut(fragments.barycentrics, first, end))
        return tables.of_samples(cut_fragments, spans, table_indices)

    def probe_weights_of(self, body: int, vertices: np.ndarray) -> ProbeWeights:
        """Where vertices of a body lie among its probes; backs are numbered after the last vertex."""
        on_device = from_numpy(vertices, dtype=wp.int32, device=self._merged_scene.device)
        return self._tables_of((body,)).of_vertices(on_device)

    def _tables_of(self, bodies: tuple[int, ...]) -> ProbeTables:
        if bodies not in self._tables:
            first_vertex, first_face = self._merged_scene.first_vertex.tolist(), self._merged_scene.first_face.tolist()
            self._tables[bodies] = ProbeTables.of_bodies(
                [self.probes(body) for body in bodies],
                [first_vertex[body] for body in bodies],
                [first_face[body] for body in bodies],
                first_vertex[-1],
                first_face[-1],
                self._merged_scene.device,
            )
        return self._tables[bodies]

    # ----------------------------------------------------------------------------- tables and lookups

    def lookups(
        self,
        bodies: tuple[int, ...],
        rotations: wp.array,
        directions: np.ndarray,
        half_angles: np.ndarray | None,
        *,
        has_sun: bool = False,
    ) -> dict[int, SelfVisibilityLookup]:
        """Lookups of bodies' receivers for cells, as for find_resampling_kernels. Differentiable: rotations.

        Args:
            bodies, rotations, directions, half_angles: The inputs of the lookup.
            has_sun: Whether there are sun cells, to which receivers of some bodies send rays.
        """
        self._announce(bodies)
        curved = tuple(body for body in bodies if not self._merged_scene.is_flat[body])
        if curved not in self._body_tables:
            self._body_tables[curved] = BodyTables.of_rows(tuple(map(self.rows, curved)))
        tables = self._body_tables[curved]
        ray_counts = tuple(rows.ray_count for rows in tables.rows)
        kernels = find_body_kernels(curved, ray_counts, directions, half_angles, rotations.device)
        resampling_weights = find_resampling_weights(rotations, kernels)
        lookup = SelfVisibilityLookup(curved, self._trace_seen_backs, tables, resampling_weights, kernels)
        result = dict.fromkeys(curved, lookup)
        for body in curved:
            if has_sun and self._sends_rays(body):
                result[body] = lookup._replace(rays=(self._ray_probes(body), rotations))
        return result

    def _ray_probes(self, body: int) -> RayProbes:
        """Where rays for a sun start."""
        normals, positions = self._normals(body), self.probes(body).positions

        def find() -> RayProbes:
            as_array = functools.partial(from_numpy, dtype=wp.vec3, device=self._merged_scene.device)
            points = np.tile(positions, (len(normals) // len(positions), 1))
            return RayProbes(self._tree(body), as_array(points), as_array(normals))

        return self._cached_by_mesh(body, "ray probes", find)

    def _tree(self, body: int) -> FaceTree:
        faces = self._merged_scene.scene.bodies[body].mesh.surface.faces
        build = functools.partial(build_face_tree, self.probes(body).positions, faces, self._merged_scene.device)
        return self._cached_by_mesh(body, "tree", build)

    def self_transfer_of(self, bodies: tuple[int, ...], rotations: wp.array, order: int) -> dict[int, SelfTransfer]:
        """Self-transfer of bodies in bands of spherical harmonics, rotated with them. Differentiable: rotations."""
        self._announce(bodies)
        return {
            body: SelfTransfer(self._probe_transfer_of(body, order), find_body_rotation(rotations, body, order))
            for body in bodies
            if not self._merged_scene.is_flat[body]
        }

    def _probe_transfer_of(self, body: int, order: int) -> wp.array:
        if (body, order) not in self._probe_transfer:
            self._trace_backs(body)
            self._probe_transfer[body, order] = project_rows(self.rows(body), self._normals(body), order)
        return self._probe_transfer[body, order]

    def missing(self, bodies: tuple[int, ...]) -> int:
        """Number of bodies, of some, without rows in memory yet."""
        return sum(not (self._merged_scene.is_flat[body] or body in self._rows) for body in bodies)

    @property
    def is_cached(self) -> bool:
        """Whether the disk has the rows of all bodies that cast shadows on themselves, where the scene has them."""
        scene = self._merged_scene.scene
        solids = find_solids(scene, blocking_parts(scene))
        traced = (body for body, is_flat in enumerate(self._merged_scene.is_flat) if not (is_flat or body in solids))
        return all(self._rows_path(body, _FRONT).exists() for body in traced if not self.why_spheres(body, None))

    def _row_count(self, body: int) -> int:
        return len(self.probes(body).positions) * (1 + bool(self._merged_scene.is_two_sided[body]))

    def _normals(self, body: int) -> np.ndarray:
        """Normals of the probes of a body, and of their backs if it is open."""
        sides = (_FRONT, _BACK) if self._merged_scene.is_two_sided[body] else (_FRONT,)
        return np.concatenate([side * self.probes(body).normals for side in sides])

    def rows(self, body: int) -> VisibilityRows:
        """Self-visibility of the probes of a body: in memory, on disk, or traced.

        Backs of open bodies have rows once :meth:`_trace_backs` has filled them: few images show the inside of a scan.
        """
        if body not in self._rows:
            self._rows[body] = self._cached_by_mesh(body, "rows", lambda: self._find_rows(body))
        return self._rows[body]

    def _find_rows(self, body: int) -> VisibilityRows:
        fronts = self._find_side_rows(body, _FRONT)
        if not self._merged_scene.is_two_sided[body]:
            return fronts
        count, device = self._row_count(body), self._merged_scene.device
        rows = VisibilityRows(*(zeros((count, array.shape[1]), array.dtype, device) for array in fronts))
        rows.fill(fronts, 0)
        return rows

    def _trace_backs(self, body: int) -> None:
        """Fill the rows of the backs of an open body, if they are not filled yet."""

        def fill() -> bool:
            self._announce((body,), _BACK)
            self.rows(body).fill(self._find_side_rows(body, _BACK), len(self.probes(body).positions))
            return True

        if self._merged_scene.is_two_sided[body]:
            self._cached_by_mesh(body, "backs", fill)
            self._bodies_with_backs.add(body)

    def _trace_seen_backs(self, weights: ProbeWeights, spans: tuple[Span, ...]) -> None:
        """Fill the rows of backs if receivers lie on some, or if that cannot be read without waiting."""
        for body, first, end in spans:
            if self._merged_scene.is_two_sided[body] and body not in self._bodies_with_backs:
                count = len(self.probes(body).positions)
                if not is_readable(self._merged_scene.device) or weights.rows.numpy()[:, first:end].max() >= count:
                    self._trace_backs(body)

    def _announce(self, bodies: tuple[int, ...], side: int = _FRONT) -> None:
        """Say how long rows that are to be traced take, if that is long."""
        seconds, point_count, untraced_paths = 0.0, 0, set()
        for body in bodies:
            is_known = self._merged_scene.is_flat[body] or (side == _FRONT and body in self._rows)
            if not is_known and (path := self._rows_path(body, side)) not in untraced_paths and not path.exists():
                untraced_paths.add(path)
                points, faces = len(self.probes(body).positions), self._merged_scene.scene.bodies[body].mesh.faces
                point_count += points
                rays = points * ray_count(self._row_count(body))
                seconds += trace_seconds(rays, len(faces), are_backs=side == _BACK)
        of_bodies = "a body on itself" if len(untraced_paths) == 1 else f"{len(untraced_paths)} bodies on themselves"
        announce(
            f"tracing the shadow of {of_bodies}, from {point_count:,} points,",
            seconds,
            'once; self_shadows = "spheres" leaves it out, and so does method = "ray-traced", for still images',
            shows=self._progress,
        )

    def _rows_path(self, body: int, side: int) -> Path:
        """Where the cache has the rows of a side of a body."""
        mesh, probes = self._merged_scene.scene.bodies[body].mesh, self.probes(body)
        count = ray_count(self._row_count(body))
        numbers = [VERSION, count, len(probes.positions), side, len(mesh.positions)]
        key = hashlib.sha256(json.dumps(numbers).encode())
        key.update(probes.positions.tobytes())
        key.update(np.asarray(mesh.surface.faces, np.int32).tobytes())
        return cache_path("self_shadows", key.hexdigest())

    def _find_side_rows(self, body: int, side: int) -> VisibilityRows:
        """Rows of the fronts, or backs, of a body's probes: on disk, or traced."""
        mesh, device = self._merged_scene.scene.bodies[body].mesh, self._merged_scene.device
        probes, faces = self.probes(body), mesh.surface.faces
        count = ray_count(self._row_count(body))
        if count < RAYS:
            called = self._merged_scene.scene.bodies[body].name
            check.warn(
                f"body {body} ({called!r}): {len(probes.positions):,} points have {count} rays each for the body's "
                f"shadow on itself, in place of {RAYS}, which would take too much memory"
            )

        def read(stored: Mapping[str, np.ndarray]) -> VisibilityRows:
            for name, dtype, width in (("bits", np.uint32, count // 32), ("cells", np.uint8, count // RAYS_PER_CELL)):
                check.shape(name, stored[name].shape, (len(probes.positions), width))
                if stored[name].dtype != dtype:
                    raise ValueError(f"{name}: got {stored[name].dtype}, expected {np.dtype(dtype)}")
            return VisibilityRows(*(wp.array(stored[name], device=device) for name in VisibilityRows._fields))

        def trace(unfinished: Unfinished) -> VisibilityRows:
            points = from_numpy(probes.positions[: len(mesh.positions)], dtype=wp.vec3, device=device)
            mesh_of_body = wp.Mesh(points, from_numpy(faces.ravel(), dtype=wp.int32, device=device))
            origins, normals = probes.ray_origins, side * probes.normals

            def keep(bits: wp.array) -> None:
                done = f"{len(bits):,} of {len(origins):,} points"
                unfinished.keep(lambda: {"bits": bits.numpy()}, done)

            with unrecorded():
                rows = trace_rows(
                    self._tree(body),
                    origins,
                    normals,
                    count,
                    cached_bits=unfinished.before.get("bits"),
                    store_bits=keep,
                    progress=self._progress,
                )
                is_buried = find_buried(mesh_of_body, origins, normals, rows, are_backs=side == _BACK)
                return rows.dilated(find_dilation(probes, is_buried))

        return load_or_compute(
            self._rows_path(body, side),
            read,
            trace,
            lambda rows: {name: array.numpy() for name, array in rows._asdict().items()},
            noun="self-shadow",
        )
