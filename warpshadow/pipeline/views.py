"""Views: what cameras see of a geometry, made anew only when geometry or cameras changed."""

import functools
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import warp as wp

from warpshadow import check
from warpshadow.assets.camera import Camera
from warpshadow.assets.light import EnvironmentMap
from warpshadow.device.batch import common_batch
from warpshadow.device.cuda_graph import is_readable
from warpshadow.pipeline.assembly import Assembly, Geometry, exchanged
from warpshadow.pipeline.plan import CAMERAS, SPHERES, VERTICES, Decision, Ledger, ViewFacts, ViewPlan, plan_view
from warpshadow.pipeline.still import Still
from warpshadow.stages.normals import vertex_normals
from warpshadow.stages.project import to_clip
from warpshadow.stages.rasterize import Fragments, rasterize
from warpshadow.stages.receivers import Numbering, Receivers, find_receivers, number_receivers, seen_vertices
from warpshadow.stages.sides import find_sides
from warpshadow.stages.silhouettes.find import Silhouettes, find_silhouettes
from warpshadow.stages.textures.footprint import Footprints


@dataclass
class Kept:
    """What was computed from a view and stands while it does.

    Args:
        shading: In the scene's light.
        other_shading: In the last other known light, and a copy of that light.
        transfer: Transfer vectors to the renderer's basis, one array for each group of receivers.
        reflectance: Of the samples in the scene.
        footprints: By the sizes of the textures, with the coarsest level that is taken, once it is known.
        white: The samples if every surface were white, and the shading that they received.
    """

    shading: wp.array | None = None
    other_shading: tuple[EnvironmentMap | np.ndarray, wp.array] | None = None
    transfer: list[wp.array] | None = None
    reflectance: wp.array | None = None
    footprints: dict[tuple, tuple[Footprints, int | None]] = field(default_factory=dict)
    white: tuple[wp.array, wp.array] | None = None


class _ViewFields(NamedTuple):
    geometry: Geometry
    receivers: Receivers
    clip_positions: wp.array
    fragments: Fragments
    silhouettes: Silhouettes
    assembly: Assembly
    varying: tuple[str, ...] = ()
    still: Still | None = None


class View(_ViewFields):
    """What cameras see of a geometry: all that an image takes but light and reflectance.

    Args:
        geometry: The geometry; where it requires no gradient, a copy of it.
        receivers: Where light is evaluated.
        clip_positions: Of the vertices, vec4 of shape [batch, vertex].
        fragments: What each sample sees.
        silhouettes: Where neighboring samples see different surfaces.
        assembly: The renderer's that sees it and keeps with it what it computes from it; no other draws it.
        varying: Which of vertices, spheres and cameras require a gradient.
        still: The bodies that stand still among moving ones; None where any may move.
    """

    @functools.cached_property
    def kept(self) -> Kept:
        """What was computed from it."""
        return Kept()

    @property
    def keeps(self) -> bool:
        """Whether what is computed from it may be kept: no input needs a gradient, and no CUDA graph is captured."""
        return not (self.varying or self.clip_positions.device.is_capturing)

    @property
    def facts(self) -> ViewFacts:
        """What plans of what is computed from it need to know."""
        kept = self.kept
        points = self.receivers.points
        return ViewFacts(
            self.varying,
            lit_by=self.varying if points.requires_grad or SPHERES in self.varying else (),
            moving=self.geometry.moving,
            samples=self.fragments.face_ids.size,
            receivers=points.size,
            still_receivers=len(self.receivers.still),
            is_made=True,
            keeps_transfer=kept.transfer is not None,
            keeps_reflectance=kept.reflectance is not None,
        )


class Prospect(NamedTuple):
    """What is known of a view before it is asked for."""

    plan: ViewPlan | None  # what it takes; None for a view that was given
    facts: ViewFacts
    view: View | None  # the same view, which is kept
    still: Still | None  # what is known of the bodies that stand still among moving ones


class Viewer:
    """Sees geometries of a scene through cameras; the last view stands until what it was made of changes.

    Args:
        assembly: The scene's bodies.
        cameras: Those that see the scene, of one size and near plane.
        ledger: Where times are noted.
        progress: Show progress where something takes longer than a second.
    """

    def __init__(self, assembly: Assembly, cameras: Sequence[Camera], ledger: Ledger, *, progress: bool = False):
        self.assembly = assembly
        self.cameras = cameras
        self._scene = assembly.scene
        self._ledger = ledger
        self._progress = progress
        self._scene_view: View | None = None
        self._last: tuple[View, np.ndarray] | None = None  # with its cameras
        self._stills: dict[tuple[int, ...] | None, Still] = {}  # by what moves
        self._has_warned = False

    @functools.cached_property
    def clip_matrices(self) -> wp.array:
        """The cameras, mat44 of shape [camera]."""
        matrices = np.stack([camera.clip_matrix() for camera in self.cameras])
        return wp.array(matrices, dtype=wp.mat44, device=self.assembly.device)

    def see(self, geometry: Geometry | None = None, clip_matrices: wp.array | None = None) -> View:
        """See a geometry through cameras, by default the scene's own, unless the last view still shows it."""
        plan, facts, view, still = self.plan(geometry, clip_matrices)
        if view is not None:
            return view
        assert plan is not None
        is_scenes = geometry is None and clip_matrices is None
        geometry, clip_matrices = self._given(geometry, clip_matrices)
        if not {VERTICES, SPHERES} & set(facts.varying):
            geometry = Geometry(*map(wp.clone, geometry), moving=geometry.moving)
        if still is None and self._stands(geometry).any():
            still = self._stills[geometry.moving] = Still(self.assembly, geometry, progress=self._progress)
        view = self._made(plan, facts.varying, geometry, clip_matrices, still)
        device = self.assembly.device
        if not self._has_warned and (is_readable(device) or (is_scenes and not device.is_capturing)):
            self._warn_of_empty_images(view)
        if is_scenes:
            self._scene_view = view
        elif view.keeps and is_readable(self.assembly.device):
            self._last = view, clip_matrices.numpy().copy()
        return view

    # ------------------------------------------------------------------------------------------ what changed

    def plan(self, geometry: Geometry | None = None, clip_matrices: wp.array | None = None) -> Prospect:
        """What it takes to see a geometry; nothing is computed."""
        view, change = self._change(geometry, clip_matrices)
        stands, vertex_counts = self._stands(geometry), np.diff(self.assembly.first_vertex)
        facts = self._expected(geometry, clip_matrices, stands) if view is None else view.facts
        plan = plan_view(
            change,
            facts,
            vertices=int(vertex_counts.sum()),
            still_vertices=int(vertex_counts[stands].sum()),
            faces=len(self.assembly.body_of_face),
            two_sided_faces=self.assembly.two_sided_faces.size,
        )
        still = None
        known = None if geometry is None else self._stills.get(geometry.moving)
        if geometry is not None and stands.any() and known is not None and known.holds(geometry):
            still = known
        return Prospect(plan, facts, view, still)

    def _change(self, geometry: Geometry | None, clip_matrices: wp.array | None) -> tuple[View | None, Decision]:
        """The view that is kept of what is given, and whether and why there is a new one."""
        if geometry is None and clip_matrices is None:
            if self._scene_view is None:
                return None, Decision(True, "the scene is seen for the first time")
            return self._scene_view, Decision(False, "kept: the scene's geometry and cameras stand")
        varying = _varying(geometry, clip_matrices)
        if varying:
            return None, Decision(True, f"a gradient to {' and '.join(varying)} is asked for")
        if not is_readable(self.assembly.device):
            return None, Decision(True, "values are not compared on a GPU, which would have to wait")
        if self._last is None:
            return None, Decision(True, "nothing is kept yet")
        view, matrices = self._last
        geometry, clip_matrices = self._given(geometry, clip_matrices)
        changed = [
            name
            for name, stands in (
                ("geometry", _is_same(geometry, view.geometry)),
                (CAMERAS, np.array_equal(clip_matrices.numpy(), matrices)),
            )
            if not stands
        ]
        if changed:
            return None, Decision(True, f"{' and '.join(changed)} changed since the last view")
        return view, Decision(False, "kept: geometry and cameras are those of the last view")

    def _given(self, geometry: Geometry | None, clip_matrices: wp.array | None) -> tuple[Geometry, wp.array]:
        if geometry is not None:
            for name, array, own in zip(Geometry._fields, geometry, self.assembly.rest, strict=True):
                check.shape(f"geometry.{name}", array.shape, ("batch", *own.shape[1:]))
        geometry = self.assembly.scene_geometry if geometry is None else geometry
        clip_matrices = self.clip_matrices if clip_matrices is None else clip_matrices
        common_batch({"geometry": geometry.positions, "clip_matrices": clip_matrices})
        return geometry, clip_matrices

    def _expected(self, geometry: Geometry | None, clip_matrices: wp.array | None, stands: np.ndarray) -> ViewFacts:
        """What is known of a view before it is made."""
        varying = _varying(geometry, clip_matrices)
        camera, across = self.cameras[0], self._scene.supersampling
        poses = 1 if geometry is None else len(geometry.positions)
        images = max(poses, len(self.cameras) if clip_matrices is None else len(clip_matrices))
        samples = images * camera.width * camera.height * across**2
        has_own, at_vertices = bool(self.samples_receive.any()), ~self.samples_receive
        vertex_counts = np.diff(self.assembly.first_vertex) * (1 + self.assembly.is_two_sided)
        return ViewFacts(
            varying,
            lit_by=varying if has_own else tuple(name for name in varying if name != CAMERAS),
            moving=None if geometry is None else geometry.moving,
            samples=samples,
            receivers=poses * int(vertex_counts[at_vertices & ~stands].sum()) + samples * has_own,
            still_receivers=int(vertex_counts[at_vertices & stands].sum()),
            is_made=False,
        )

    # ------------------------------------------------------------------------------------------ seeing

    @functools.cached_property
    def samples_receive(self) -> np.ndarray:
        """Bodies on which every sample is a receiver, bool of shape [body]."""
        return np.array([self._is_traced or body.receivers == "pixel" for body in self._scene.bodies])

    @property
    def _is_traced(self) -> bool:
        return self._scene.visibility.method == "ray-traced"

    def _stands(self, geometry: Geometry | None) -> np.ndarray:
        """Bodies that stand still among moving ones, bool of shape [body]; none where rays treat all alike."""
        stands = np.zeros(len(self._scene.bodies), bool)
        if geometry is not None and geometry.moving is not None and not self._is_traced:
            stands[:] = True
            stands[list(geometry.moving)] = False
        return stands

    def _made(
        self,
        plan: ViewPlan,
        varying: tuple[str, ...],
        geometry: Geometry,
        clip_matrices: wp.array,
        still: Still | None,
    ) -> View:
        assembly, timed = self.assembly, self._ledger.timed
        camera, across = self.cameras[0], self._scene.supersampling
        with timed(plan.clipping, [geometry.positions, clip_matrices]):
            clip_positions = self._clipped(geometry, clip_matrices, still)
        with timed(plan.rasterization, [clip_positions]):
            fragments = rasterize(clip_positions, assembly.faces, across * camera.width, across * camera.height)
        if plan.sides:
            with timed(plan.sides):
                two_sided = assembly.two_sided_faces
                fragments = find_sides(fragments, assembly.faces, two_sided, geometry.positions, clip_matrices)
        with timed(plan.silhouettes):
            silhouettes = find_silhouettes(fragments, assembly.faces, assembly.edges, clip_positions, assembly.surfaces)
        with timed(plan.normals, [geometry.positions]):
            normals = self._normals(geometry, still)
        with timed(plan.receivers, [geometry.positions, fragments.barycentrics]):
            numbering = self._numbering(fragments, silhouettes, still)
            wants_samples = self.samples_receive[assembly.body_of_face]
            receivers = find_receivers(geometry.positions, normals, assembly.faces, fragments, numbering, wants_samples)
        return View(geometry, receivers, clip_positions, fragments, silhouettes, assembly, varying, still)

    def _numbering(self, fragments: Fragments, silhouettes: Silhouettes, still: Still | None) -> Numbering:
        """The vertices that are receivers: those that are seen, or all where that cannot be read without waiting."""
        assembly = self.assembly
        has_backs = fragments.sides is not None
        if is_readable(assembly.device):
            keeps_vertex = self._can_receive[: 1 + has_backs]
            keeps_vertex = keeps_vertex & seen_vertices(fragments, silhouettes, keeps_vertex.shape[1])
            is_still = None if still is None else still.is_still
            return number_receivers(assembly.faces, keeps_vertex, is_still, assembly.vertex_order)
        if still is None:
            return self._numberings[has_backs]
        return number_receivers(assembly.faces, self._can_receive[: 1 + has_backs], still.is_still)

    @functools.cached_property
    def _can_receive(self) -> np.ndarray:
        """Vertices that may be receivers, and those whose backs may be, bool of shape [2, vertex]."""
        body_of_vertex = self.assembly.body_of_vertex
        receives = ~self.samples_receive
        return np.stack([receives[body_of_vertex], (receives & self.assembly.is_two_sided)[body_of_vertex]])

    @functools.cached_property
    def _numberings(self) -> tuple[Numbering, Numbering]:
        """Of all vertices, and of all with their backs; a first call makes both, so that a capture finds them."""
        faces, can_receive = self.assembly.faces, self._can_receive
        return number_receivers(faces, can_receive[:1]), number_receivers(faces, can_receive)

    def _clipped(self, geometry: Geometry, clip_matrices: wp.array, still: Still | None) -> wp.array:
        """Clip positions; those of what stands still are kept while the cameras do."""
        positions = geometry.positions
        if still is None or clip_matrices.requires_grad:
            return to_clip(positions, clip_matrices)
        runs = self.assembly.runs(self.assembly.first_vertex, still.moving)
        return exchanged(
            still.clip_positions(clip_matrices), runs, lambda a, b: to_clip(positions[:, a:b], clip_matrices)
        )

    def _normals(self, geometry: Geometry, still: Still | None) -> wp.array:
        """Normals of the vertices; those of what stands still are kept."""
        assembly, positions = self.assembly, geometry.positions
        if still is None:
            return vertex_normals(positions, assembly.faces)
        runs = assembly.runs(assembly.first_vertex, still.moving)
        return exchanged(still.normals, runs, lambda a, b: vertex_normals(positions[:, a:b], assembly.faces_of(a, b)))

    def _warn_of_empty_images(self, view: View) -> None:
        """Say, once, which image shows nothing of the scene, and why."""
        face_ids = view.fragments.face_ids.numpy()
        empty = np.flatnonzero(face_ids.max(axis=(1, 2), initial=-1) < 0)
        if not len(empty):
            return
        self._has_warned = True
        number, near = int(empty[0]), self.cameras[0].near
        depths = view.clip_positions.numpy()[min(number, len(view.clip_positions) - 1), :, 3]
        nearest, farthest = float(depths.min()), float(depths.max())
        if farthest <= 0:
            reason = f"all of it is behind the camera, by {-farthest:g} or more"
        elif farthest <= near:
            reason = f"near = {near:g} cuts all of it away, which is {farthest:g} or less in front of the camera"
        else:
            reason = f"it is outside of the frame, at depths from {nearest:g} to {farthest:g}"
        which = f"image {number} of {len(face_ids)}" if len(face_ids) > 1 else "the image"
        warnings.warn(f"camera: {which} shows nothing of the scene: {reason}", stacklevel=4)


def _varying(geometry: Geometry | None, clip_matrices: wp.array | None) -> tuple[str, ...]:
    """What requires a gradient."""
    positions, *spheres = (None, None, None) if geometry is None else geometry
    arrays = {VERTICES: [positions], SPHERES: spheres, CAMERAS: [clip_matrices]}
    return tuple(
        name for name, items in arrays.items() if any(item is not None and item.requires_grad for item in items)
    )


def _is_same(geometry: Geometry, other: Geometry) -> bool:
    """Whether geometries are of the same values and say the same of what moves."""
    pairs = zip(geometry, other, strict=True)
    return geometry.moving == other.moving and all(np.array_equal(a.numpy(), b.numpy()) for a, b in pairs)
