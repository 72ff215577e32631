"""Receivers of a view: at the vertices that it shows, at samples, and on flat bodies at the corners of squares."""

import functools

import numpy as np
import warp as wp

from warpshadow.device.constants import constant, gather_of_owners
from warpshadow.device.cuda_graph import is_readable
from warpshadow.device.launch import without_gradient
from warpshadow.pipeline.bodies.blockers import BlockerKinds
from warpshadow.pipeline.receivers.scene_receivers import SceneReceivers
from warpshadow.pipeline.receivers.shading_context import AdaptiveSurfaces
from warpshadow.pipeline.receivers.static import StaticBodies
from warpshadow.pipeline.shading.method import Method
from warpshadow.stages.image.outlines import find_outline_samples
from warpshadow.stages.raster.rasterization import Fragments
from warpshadow.stages.receivers.receiver_footprints import FootprintInputs
from warpshadow.stages.receivers.receivers import Receivers, find_receivers
from warpshadow.stages.receivers.sample_receivers import MAX_SHARED_SAMPLES
from warpshadow.stages.receivers.vertex_receivers import Numbering, mark_seen_vertices, number_receivers
from warpshadow.stages.silhouettes.silhouettes import Silhouettes

_MIN_SHARED_SIZE = 128
"""Shorter side of a still [pixels] from which samples of different faces share a receiver. In smaller stills shadows
are as thin as pixels: crowds and fences of 72² to 96² pixels were 3.5 to 6.9% off, and are 2.7 to 2.9% off with a
receiver for each sample, in 2.2 times the CPU time. From 128² on the error is the same."""


class ReceiverFinder:
    """Finds the receivers of a view; whether a body has them at vertices or at samples is known when the view is made.

    Args:
        method: Method of visibility.
        scene_receivers: Where bodies have receivers.
        blocker_kinds: Which bodies block light by something else than their spheres.
        static_bodies: Those among moving ones; None where any may move.
        supersampling: Samples of a pixel across and down.
    """

    def __init__(
        self,
        method: Method,
        scene_receivers: SceneReceivers,
        blocker_kinds: BlockerKinds,
        static_bodies: StaticBodies | None,
        supersampling: int,
    ):
        self._method, self._merged_scene, self._scene_receivers = method, method.merged_scene, scene_receivers
        self._blocker_kinds, self._static_bodies = blocker_kinds, static_bodies
        self._span_bodies = scene_receivers.span_bodies(blocker_kinds)
        self._supersampling = supersampling
        self._may_share_surfaces = method.shares_directions and supersampling <= MAX_SHARED_SAMPLES

    def find(
        self,
        positions: wp.array,
        normals: wp.array,
        fragments: Fragments,
        silhouettes: Silhouettes,
        clip_positions: wp.array,
        spheres: tuple[wp.array, wp.array] | None = None,
    ) -> Receivers:
        """Find the receivers of all instances.

        Args:
            positions, normals: Of the vertices, vec3 of shape [batch, vertex].
            fragments: The fragments, with sides where a body is open.
            silhouettes: Edges behind which vertices are needed, too.
            clip_positions: Vertices in clip space, vec4 of shape [batch, vertex].
            spheres: Centers and radii of all spheres, where bodies are adaptive.
        Differentiable: positions, normals, barycentrics of the fragments.
        """
        method, merged_scene, scene_receivers = self._method, self._merged_scene, self._scene_receivers
        quadtree, has_mean_slope = None, None
        size = fragments.face_ids.shape[1] // self._supersampling, fragments.face_ids.shape[2] // self._supersampling
        widths = constant(self._footprint_widths, wp.float32, merged_scene.device)
        pixel = wp.vec2(2.0 / size[1], 2.0 / size[0])
        footprint_inputs = FootprintInputs(without_gradient(clip_positions), widths, pixel)
        has_backs, at_samples = fragments.sides is not None, scene_receivers.at_samples(self._blocker_kinds)
        device, static_bodies, is_seen = merged_scene.device, self._static_bodies, None
        if static_bodies is None or is_readable(device):
            is_seen = mark_seen_vertices(fragments, silhouettes, positions.shape[1])
        if static_bodies is None:
            numbering = scene_receivers.number_seen(is_seen, self._blocker_kinds)
        elif is_seen is None:
            if device.is_cpu and (scene_receivers.is_adaptive & self._bodies_with_cached_rows()).any():
                raise RuntimeError("receivers of bodies beside static ones are chosen on the host")
            numbering = scene_receivers.number_all(self._blocker_kinds, has_backs, static_bodies)
        else:
            # cached rows are cheaper than receivers at samples
            has_cached_rows = scene_receivers.is_adaptive & self._bodies_with_cached_rows()
            at_samples = at_samples & ~has_cached_rows
            numbering = self._number_seen(is_seen.numpy(), has_cached_rows)
        is_adaptive = scene_receivers.is_adaptive & at_samples
        if device.is_cpu and spheres is not None and is_adaptive.any():
            surfaces = AdaptiveSurfaces(
                positions, normals, fragments, spheres, is_adaptive, self._supersampling, footprint_inputs
            )
            quadtree = method.find_squares(self._blocker_kinds, surfaces)
        if at_samples.any() and fragments.barycentrics.requires_grad:
            has_mean_slope = find_outline_samples(silhouettes, clip_positions, quadtree)
        shares_surfaces = (
            self._may_share_surfaces and min(fragments.face_ids.shape[1:]) >= _MIN_SHARED_SIZE * self._supersampling
        )
        body_of_face, span_bodies = merged_scene.body_of_face, self._span_bodies
        widens = method.edges_as_wide_as_footprints and self._footprint_widths.any()
        return find_receivers(
            positions,
            normals,
            merged_scene.faces,
            fragments,
            numbering,
            gather_of_owners(at_samples, body_of_face),
            bodies=None if span_bodies is None else gather_of_owners(span_bodies, body_of_face),
            supersampling=1 if method.shares_directions and not shares_surfaces else self._supersampling,
            quadtree=quadtree,
            lifts_to_smooth_surface=scene_receivers.at_all_samples,
            smooth_pieces=merged_scene.smooth_pieces if shares_surfaces else None,
            has_mean_slope=has_mean_slope,
            shares_receivers=None if method.shares_lobes else gather_of_owners(~merged_scene.is_glossy, body_of_face),
            footprint_inputs=footprint_inputs if widens else None,
        )

    @functools.cached_property
    def _footprint_widths(self) -> np.ndarray:
        """Width of the footprint of a receiver on each face [pixels]: 0 but on flat bodies.

        Towards the limb of a curved surface its plane has far more of a pixel than the surface.
        """
        merged_scene = self._merged_scene
        widths = np.where(merged_scene.is_glossy, 1 / self._supersampling, 1.0) * merged_scene.is_flat
        return widths[merged_scene.body_of_face].astype(np.float32)

    def _number_seen(self, is_seen: np.ndarray, has_cached_rows: np.ndarray) -> Numbering:
        """Number the vertices that are seen, of bodies with receivers there and of bodies with cached rows."""
        merged_scene, static_bodies, span_bodies = self._merged_scene, self._static_bodies, self._span_bodies
        keeps_vertex = self._scene_receivers.at_vertices(self._blocker_kinds)[: len(is_seen)] & is_seen
        if has_cached_rows.any():
            keeps_vertex |= gather_of_owners(has_cached_rows, merged_scene.body_of_vertex) & is_seen
        return number_receivers(
            keeps_vertex,
            None if static_bodies is None else static_bodies.has_vertex,
            merged_scene.vertex_order,
            None if span_bodies is None else gather_of_owners(span_bodies, merged_scene.body_of_vertex),
            device=merged_scene.device,
        )

    def _bodies_with_cached_rows(self) -> np.ndarray:
        """Static bodies on which shadows of others are cached at vertices, bool of shape [body]."""
        bodies = self._merged_scene.scene.bodies
        static = [] if self._static_bodies is None else self._static_bodies.bodies
        casting = {number for number in static if bodies[number].casts_shadow}
        return np.array([number in static and bool(casting - {number}) for number in range(len(bodies))])
