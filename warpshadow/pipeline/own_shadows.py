"""Own shadows: which bodies have their shadows on themselves from rays, and what is kept of them.

What a rigid body blocks of its own light does not change in its own frame. So rays find it once, and it is kept on disk
beside the spheres that are fitted to the mesh. Other bodies' spheres block their shares of what it leaves.
"""

import functools
import hashlib
import json
import weakref
from collections.abc import Callable, Mapping
from typing import NamedTuple, TypeVar

import numpy as np
import warp as wp

from warpshadow import check
from warpshadow.assets.cache import cache_path, remembered
from warpshadow.assets.mesh import Mesh
from warpshadow.device.batch import cut
from warpshadow.device.tape import unrecorded
from warpshadow.pipeline.assembly import Assembly, Geometry
from warpshadow.pipeline.node import Source
from warpshadow.spheres.normalized_mesh import normalize
from warpshadow.stages.normals import vertex_normals
from warpshadow.stages.own_shadows.buried import find_buried, find_lenders
from warpshadow.stages.own_shadows.lobes import Turned, find_turned, project_rows
from warpshadow.stages.own_shadows.lookup import Lookup, Supports, find_lookups, find_supports
from warpshadow.stages.own_shadows.sites import Places, Sites, SiteTable, find_sites, longest_edge
from warpshadow.stages.own_shadows.sun_cells import RaySites
from warpshadow.stages.own_shadows.trace import RAYS, RUN, OwnRows, ray_count, trace_rows
from warpshadow.stages.rasterize import Fragments
from warpshadow.stages.ray_packets import FaceTree, build_face_tree
from warpshadow.stages.receivers import Receivers, Span

VERSION = 4
"""Part of the key of cached rows: raise it whenever they would come out differently."""


Found = TypeVar("Found")

_OF_MESHES: weakref.WeakKeyDictionary[Mesh, dict[tuple[str, bool, str], object]] = weakref.WeakKeyDictionary()
"""Sites and rows of each mesh in memory, for all renderers, by their kind, whether samples receive, and device."""


class Blocking(NamedTuple):
    """How the bodies of a geometry block light: by their spheres, but for some."""

    traced: tuple[int, ...] = ()  # bodies that block their own light as rays found, not by their spheres
    rotations: Source | None = None  # of all bodies, mat33 of shape [batch, body]; None where none is traced
    why_spheres: tuple[str, ...] = ()  # of each body, why it blocks its own light by spheres; empty for the traced
    flats: tuple[int, ...] = ()  # bodies that block all light as the planes in which they lie


BY_SPHERES = Blocking()
"""All bodies block by their spheres."""


class OwnLookup(NamedTuple):
    """What receivers of a body look up of it."""

    rows: OwnRows
    lookup: Lookup
    supports: Supports
    rays: tuple[RaySites, wp.array] | None = None  # for a sun, and the rotations; None where it is looked up, too

    @property
    def turned(self) -> wp.array:
        """What of it depends on the rotations, of shape [batch, …]."""
        return self.lookup.weights


class OwnLobes(NamedTuple):
    """The same where light is in harmonics: the body's lobes, and how they are turned."""

    lobes: wp.array  # [row, order²]
    turn: Turned

    @property
    def turned(self) -> wp.array:
        """What of it depends on the rotations, of shape [batch, …]."""
        return self.turn.rotations


class OwnShadows:
    """What rays found of the bodies' shadows on themselves, each in its own frame.

    Args:
        assembly: The bodies.
        samples_receive: Bodies on which samples are receivers, bool of shape [body]: they have sites within faces.
        progress: Show progress where something takes longer than a second.
    """

    def __init__(self, assembly: Assembly, samples_receive: np.ndarray, *, progress: bool = False):
        self._assembly, self._samples_receive, self._progress = assembly, samples_receive, progress
        self._sites: dict[int, Sites] = {}
        self._tables: dict[int, SiteTable] = {}
        self._rows: dict[int, OwnRows] = {}
        self._lobes: dict[tuple[int, int], wp.array] = {}

    # ------------------------------------------------------------------------------------------ which bodies

    def blocking(self, geometry: Geometry | None, rotations: Source | None) -> Blocking:
        """How the bodies of a geometry, by default the scene's, block light; none as planes."""
        why = tuple(self._why_spheres(body, geometry) for body in range(len(self._samples_receive)))
        return Blocking(tuple(body for body, reason in enumerate(why) if not reason), rotations, why)

    def _why_spheres(self, body: int, geometry: Geometry | None) -> str:
        """Why a body's own spheres block its light in a geometry, by default the scene's; empty if they do not."""
        scene = self._assembly.scene
        if not scene.bodies[body].casts_shadow:
            return "it casts no shadow"
        if self._how(body) == "spheres":
            return 'self_shadows = "spheres"'
        if geometry is not None and body in geometry.deformed:
            return "its shape is free"
        if geometry is not None and geometry.rotations is None:
            return "geometry has no rotations; placed(…) makes one that has them"
        return ""

    @property
    def wants_rays(self) -> bool:
        """Whether receivers of some body send rays to sun cells."""
        return any(map(self._sends_rays, range(len(self._samples_receive))))

    def _sends_rays(self, body: int) -> bool:
        """Whether receivers of a body do: those that are pixels. Between vertices an edge would be too sharp."""
        return self._how(body) == "rays" and bool(self._samples_receive[body])

    def _how(self, body: int) -> str:
        """The kind of shadow that a body casts on itself: one of SELF_SHADOWS."""
        scene = self._assembly.scene
        return scene.bodies[body].self_shadows or scene.visibility.self_shadows

    # ------------------------------------------------------------------------------------------ where

    def sites(self, body: int) -> Sites:
        """The sites of a body, in the frame of its fit."""
        if body not in self._sites:
            mesh, device = self._assembly.scene.bodies[body].mesh, self._assembly.device
            faces = mesh.surface.faces

            def find() -> Sites:
                used, positions = np.unique(faces), np.zeros(mesh.positions.shape, np.float32)
                positions[used], *_ = normalize(mesh.positions[used].astype(np.float64))
                points = wp.array(positions[None], dtype=wp.vec3, device=device)
                normals = vertex_normals(points, wp.array(faces, dtype=wp.vec3i, device=device)).numpy()[0]
                longest = longest_edge(positions, faces, samples_receive=bool(self._samples_receive[body]))
                return find_sites(positions, normals, faces, longest)

            self._sites[body] = self._of_mesh(body, "sites", find)
        return self._sites[body]

    def _of_mesh(self, body: int, what: str, find: Callable[[], Found]) -> Found:
        """What is found of the mesh of a body once, by whichever renderer asks for it first."""
        kept: dict = _OF_MESHES.setdefault(self._assembly.scene.bodies[body].mesh, {})
        key = what, bool(self._samples_receive[body]), self._assembly.device.alias
        if key not in kept:
            kept[key] = find()
        return kept[key]

    def places(self, receivers: Receivers, span: Span) -> Places:
        """Where receivers of a body lie among its sites. Differentiable: barycentrics of samples."""
        assert receivers.vertices is not None
        table, first, end = self._table(span.body), span.first, span.end
        vertex_count = receivers.vertices.size
        if first < vertex_count:
            return table.of_vertices(receivers.vertices[first:end])
        seen, first, end = receivers.seen, first - vertex_count, end - vertex_count
        assert seen is not None
        return table.of_samples(Fragments(cut(seen.face_ids, first, end), cut(seen.barycentrics, first, end)))

    def places_of(self, body: int, vertices: np.ndarray) -> Places:
        """Where vertices of a body, after the last of which backs are numbered, lie among its sites."""
        return self._table(body).of_vertices(wp.array(vertices, dtype=wp.int32, device=self._assembly.device))

    def _table(self, body: int) -> SiteTable:
        if body not in self._tables:
            assembly, sites = self._assembly, self.sites(body)
            self._tables[body] = SiteTable(
                int(assembly.first_vertex[body]),
                int(assembly.first_vertex[-1]),
                int(assembly.first_face[body]),
                int(assembly.first_face[-1]),
                len(sites.positions),
                wp.array(sites.pieces, dtype=wp.vec4i, device=assembly.device),
            )
        return self._tables[body]

    # ------------------------------------------------------------------------------------------ what

    def lookups(
        self,
        bodies: tuple[int, ...],
        rotations: wp.array,
        directions: np.ndarray,
        spreads: np.ndarray | None,
        *,
        has_sun: bool = False,
    ) -> dict[int, OwnLookup]:
        """What receivers of bodies look up of them for cells, as for find_supports. Differentiable: rotations.

        Args:
            bodies, rotations, directions, spreads: What is looked up.
            has_sun: Whether there are sun cells, to which receivers of some bodies send rays.
        """
        found = {}
        for body in bodies:
            if not self._assembly.is_flat[body]:
                rows = self.rows(body)
                supports = find_supports(directions, spreads, rows.ray_count, rotations.device)
                rays = (self._ray_sites(body), rotations) if has_sun and self._sends_rays(body) else None
                found[body] = OwnLookup(rows, find_lookups(rotations, body, supports), supports, rays)
        return found

    def _ray_sites(self, body: int) -> RaySites:
        """Where rays for a sun start."""
        normals, positions = self._normals(body), self.sites(body).positions

        def find() -> RaySites:
            places = np.tile(positions, (len(normals) // len(positions), 1))
            at = (wp.array(values, dtype=wp.vec3, device=self._assembly.device) for values in (places, normals))
            return RaySites(self._tree(body), *at)

        return self._of_mesh(body, "ray sites", find)

    def _tree(self, body: int) -> FaceTree:
        """The hierarchy of a body's faces."""
        faces = self._assembly.scene.bodies[body].mesh.surface.faces
        build = functools.partial(build_face_tree, self.sites(body).positions, faces, self._assembly.device)
        return self._of_mesh(body, "tree", build)

    def turned_lobes(self, bodies: tuple[int, ...], rotations: wp.array, order: int) -> dict[int, OwnLobes]:
        """The lobes of bodies in bands of spherical harmonics, and how they are turned. Differentiable: rotations."""
        return {
            body: OwnLobes(self._lobes_of(body, order), find_turned(rotations, body, order))
            for body in bodies
            if not self._assembly.is_flat[body]
        }

    def _lobes_of(self, body: int, order: int) -> wp.array:
        if (body, order) not in self._lobes:
            self._lobes[body, order] = project_rows(self.rows(body), self._normals(body), order)
        return self._lobes[body, order]

    def missing(self, bodies: tuple[int, ...]) -> int:
        """Number of bodies, of some, of which nothing is in memory yet."""
        return sum(not (self._assembly.is_flat[body] or body in self._rows) for body in bodies)

    def _row_count(self, body: int) -> int:
        return len(self.sites(body).positions) * (1 + bool(self._assembly.is_two_sided[body]))

    def _normals(self, body: int) -> np.ndarray:
        """Normals of the sites of a body, and of their backs if it is open."""
        sides = (1, -1) if self._assembly.is_two_sided[body] else (1,)
        return np.concatenate([side * self.sites(body).normals for side in sides])

    def rows(self, body: int) -> OwnRows:
        """What the sites of a body see past it: in memory, on disk, or traced."""
        if body not in self._rows:
            self._rows[body] = self._of_mesh(body, "rows", lambda: self._find_rows(body))
        return self._rows[body]

    def _find_rows(self, body: int) -> OwnRows:
        mesh, device = self._assembly.scene.bodies[body].mesh, self._assembly.device
        sites, faces = self.sites(body), mesh.surface.faces
        count = ray_count(self._row_count(body))
        if count < RAYS:
            called = self._assembly.scene.bodies[body].called
            check.warn(
                f"body {body} ({called!r}): {len(sites.positions):,} points have {count} rays each for the body's "
                f"shadow on itself, in place of {RAYS}, which would take too much memory",
            )
        numbers = [VERSION, count, len(sites.positions), bool(self._assembly.is_two_sided[body]), len(mesh.positions)]
        key = hashlib.sha256(json.dumps(numbers).encode())
        key.update(sites.positions.tobytes())
        key.update(np.asarray(faces, np.int32).tobytes())

        def read(stored: Mapping[str, np.ndarray]) -> OwnRows:
            for name, dtype, width in (("bits", np.uint32, count // 32), ("cells", np.uint8, count // RUN)):
                check.shape(name, stored[name].shape, (self._row_count(body), width))
                if stored[name].dtype != dtype:
                    raise ValueError(f"{name}: got {stored[name].dtype}, expected {np.dtype(dtype)}")
            return OwnRows(*(wp.array(stored[name], device=device) for name in OwnRows._fields))

        def trace() -> OwnRows:
            points = wp.array(sites.positions[: len(mesh.positions)], dtype=wp.vec3, device=device)
            whole = wp.Mesh(points, wp.array(faces.ravel(), dtype=wp.int32, device=device))
            normals = self._normals(body)
            places = np.tile(sites.positions, (len(normals) // len(sites.normals), 1))
            with unrecorded():
                rows = trace_rows(self._tree(body), places, normals, count, progress=self._progress)
                is_buried = find_buried(whole, places, normals, len(sites.positions), rows)
                return rows.lent(find_lenders(sites, is_buried))

        return remembered(
            cache_path("own_shadows", key.hexdigest()),
            read,
            trace,
            lambda rows: {name: array.numpy() for name, array in rows._asdict().items()},
            what="own shadow",
        )
