"""Emitters: the bodies that emit, their samples and radiance; their light is found in :mod:`.emitted_light`.

A body with emission is a part of the direct light: the sum over its samples at a receiver (:mod:`.stages.emitters`)
adds to the light of the map, and bounces as that does. Bodies between block it, bodies behind it do not. In the image
its surface has its radiance beside the light that it reflects.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warpshadow.assets.color import LUMINANCE
from warpshadow.device.batch import rows
from warpshadow.device.constants import constant
from warpshadow.device.tape import unrecorded
from warpshadow.pipeline.bodies.merged_scene import MergedScene
from warpshadow.pipeline.bodies.reflectance import Materials
from warpshadow.pipeline.node import Call, Clock, Node
from warpshadow.pipeline.receivers.shading_context import ShadingContext
from warpshadow.stages.bounces.albedo import mean_over_texels
from warpshadow.stages.emitters.emitter_self_visibility import EmitterSelfVisibility, find_self_visibility
from warpshadow.stages.emitters.light import sum_light
from warpshadow.stages.emitters.samples import (
    EmitterBeams,
    EmitterSamples,
    EmitterSpan,
    PlacedSamples,
    SamplePieces,
    SampleWeights,
    SurfacePoints,
    place_samples,
)
from warpshadow.stages.emitters.shown_beams import show_beams
from warpshadow.stages.emitters.spot_cones import find_axis_weights, weigh_by_beam
from warpshadow.stages.gloss.highlights import sum_highlights
from warpshadow.stages.gloss.reflection import LobeLight
from warpshadow.stages.light.sums import add_light
from warpshadow.stages.raster.rasterization import Fragments
from warpshadow.stages.receivers.receivers import Receivers
from warpshadow.stages.sparse import SparseMatrix, multiply

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix


class SceneEmitters:
    """The bodies of a scene that emit.

    Args:
        merged_scene: All bodies.
    """

    def __init__(self, merged_scene: MergedScene):
        self._merged_scene = merged_scene
        self._texel_matrices: dict[tuple[int, tuple[int, int]], SparseMatrix] = {}

    @functools.cached_property
    def samples(self) -> EmitterSamples:
        """Samples of all emitters."""
        from scipy.sparse import block_diag

        merged_scene, weights = self._merged_scene, self._merged_scene.emitter_sample_weights
        bodies = np.flatnonzero(merged_scene.is_emitter).tolist()
        is_emitting = np.isin(merged_scene.body_of_face, bodies)
        first_faces = np.cumsum([0, *(item.faces.shape[1] for item in weights[:-1])])
        surface_faces = [item.surface_points.faces + first for item, first in zip(weights, first_faces, strict=True)]
        surface_weights = np.concatenate([item.surface_points.weights for item in weights])
        return EmitterSamples(
            self._over_all_vertices([item.vertices for item in weights]),
            SparseMatrix.from_matrix(block_diag([item.faces for item in weights]), device=merged_scene.device),
            SamplePieces.of_emitters(weights, self._over_all_vertices([item.corners for item in weights])),
            SurfacePoints(np.concatenate(surface_faces), surface_weights),
            wp.array(merged_scene.faces.numpy()[is_emitting], dtype=wp.vec3i, device=merged_scene.device),
            tuple(bodies),
            tuple(merged_scene.is_two_sided[bodies].tolist()),
            np.cumsum([0, *(item.vertices.shape[0] for item in weights)]),
            self._find_beams(),
        )

    def _over_all_vertices(self, weights: Sequence[np.ndarray | csr_matrix]) -> SparseMatrix:
        """Weights of all vertices of the scene, given weights of each emitter's, [row, vertex]."""
        from scipy.sparse import block_diag, csr_matrix

        merged_scene, matrix = self._merged_scene, block_diag(weights, format="csr")
        vertices = np.flatnonzero(merged_scene.is_emitter[merged_scene.body_of_vertex])
        shape = matrix.shape[0], int(merged_scene.first_vertex[-1])
        matrix = csr_matrix((matrix.data, vertices[matrix.indices], matrix.indptr), shape)
        return SparseMatrix.from_matrix(matrix, device=merged_scene.device)

    def _find_beams(self) -> EmitterBeams | None:
        """Beams of the emitters; None where none has one."""
        from scipy.sparse import block_diag

        merged_scene = self._merged_scene
        if not merged_scene.has_beams:
            return None
        bodies = [body for body in merged_scene.scene.bodies if body.is_emitter]
        weights = [find_axis_weights(body.mesh.positions, body.mesh.surface.faces) for body in bodies]
        of_vertices, of_faces = ([row[None] for row in rows] for rows in zip(*weights, strict=True))
        of_emitting_faces = SparseMatrix.from_matrix(block_diag(of_faces, format="csr"), device=merged_scene.device)
        return EmitterBeams(merged_scene.emitter_beams, self._over_all_vertices(of_vertices), of_emitting_faces)

    def emission_towards_cameras(
        self,
        emission: wp.array,
        fragments: Fragments,
        vertices: wp.array,
        cameras: wp.array,
        placed_samples: PlacedSamples,
    ) -> wp.array:
        """Emission that samples of an image show, given all of it, vec3 of shape [batch, height, width]."""
        merged_scene, beams = self._merged_scene, self.samples.beams
        assert beams is not None
        emitter_of_face = constant(merged_scene.emitter_of_face, wp.int32, merged_scene.device)
        return show_beams(
            emission, fragments, merged_scene.faces, vertices, cameras, placed_samples, emitter_of_face, beams.beams
        )

    @functools.cached_property
    def self_visibility(self) -> list[EmitterSelfVisibility | None]:
        """Self-visibility of each emitter; None of one that hides nothing of itself."""
        pairs = zip(self.samples.bodies, self._merged_scene.emitter_sample_weights, strict=True)
        return [self._find_self_visibility(body, weights) for body, weights in pairs]

    def _find_self_visibility(self, body: int, weights: SampleWeights) -> EmitterSelfVisibility | None:
        merged_scene = self._merged_scene
        mesh, is_open = merged_scene.scene.bodies[body].mesh, bool(merged_scene.is_two_sided[body])
        is_convex = len(mesh.convex_parts) == 1 and not is_open
        if merged_scene.is_flat[body] or is_convex or body not in merged_scene.shadow_casters:
            return None
        positions, faces, device = mesh.positions, mesh.surface.faces, merged_scene.device
        samples, surface_points = weights.vertices @ positions.astype(np.float64), weights.surface_points
        with unrecorded():
            return find_self_visibility(positions, faces, samples, surface_points, is_two_sided=is_open, device=device)

    def direct_luminance(
        self, vertices: wp.array, mesh: wp.Mesh | None, points: np.ndarray, normals: np.ndarray
    ) -> np.ndarray:
        """Luminance of their light past the scene's meshes, a :data:`.EmitterLuminance`."""
        from warpshadow.stages.emitters.traced_transmittance import trace_transmittance

        merged_scene, samples = self._merged_scene, self.samples
        point_array, normal_array = (
            wp.array(item[None], dtype=wp.vec3, device=merged_scene.device) for item in (points, normals)
        )
        placed_samples = place_samples(vertices.reshape((1, -1)), samples)
        radiance = self.radiance(Materials.of_scene(merged_scene)).value(Call(Clock()))
        total = np.zeros(len(points))
        for span in samples.spans():
            trace = functools.partial(trace_transmittance, mesh, point_array[0], normal_array[0], samples, vertices)
            traced = trace(placed_samples.points[0], placed_samples.areas[0], span, rays=1)
            transmittance = weigh_by_beam(point_array, placed_samples, span, traced.reshape((1, *traced.shape)))
            light = sum_light(point_array, normal_array, placed_samples, radiance, span, transmittance)
            total += light.numpy()[0] @ LUMINANCE
        return total

    def ray_counts(self, placed_samples: PlacedSamples, mean: int) -> list[np.ndarray]:
        """Rays from each receiver to the samples of each emitter, ints of shape [sample].

        Of emitters whose radiance varies, samples get as many as they have of the light, at least one. In the light of
        walls of a room under a sky with a sun, edges of shadows so have a tenth of the noise.

        Args:
            placed_samples: Where the samples are.
            mean: Rays to each sample of an emitter of one radiance, and on average of those whose radiance varies.
        """
        first, emissions = self.samples.first, [body.emission for body in self._merged_scene.scene.bodies]
        varies = [bool(np.ptp(item.reshape(-1, 3), axis=0).any()) for item in emissions if item is not None]
        is_varying = np.repeat(varies, np.diff(first))
        counts = np.full(len(is_varying), mean)
        if any(varies):
            radiance = self.radiance(Materials.of_scene(self._merged_scene)).value(Call(Clock())).numpy()[0]
            power = (radiance @ LUMINANCE) * np.linalg.norm(placed_samples.areas.numpy()[0], axis=1) * is_varying
            budget = mean * is_varying.sum() / max(power.sum(), 1e-30)
            counts[is_varying] = np.maximum(np.rint(budget * power[is_varying]), 1)
        return np.split(counts, first[1:-1])

    def samples_node(self, context: ShadingContext) -> Node:
        """Node of the samples among the bodies around points."""
        return context.cached_for_bodies("emitters", None, lambda: Node("", self._place, context.vertices))

    def _place(self, vertices: wp.array) -> PlacedSamples:
        return place_samples(vertices, self.samples)

    def radiance(self, materials: Materials) -> Node:
        """Node of the samples' radiance, vec3 of shape [batch, sample]."""
        of_vertices = materials.of_vertices("emission")
        if not materials.textures_of["emission"].images:
            return Node("", lambda emission: multiply(self.samples.vertices, emission), of_vertices)

        def radiance(emission: wp.array, of_bodies: list[wp.array]) -> wp.array:
            total = multiply(self.samples.vertices, emission)
            for number, body in enumerate(self.samples.bodies):
                image = of_bodies[body]
                if image.ndim == 3:
                    total = multiply(self._texel_weights(number, image.shape[1:]), rows(image), addend=total)
            return total

        return Node("", radiance, of_vertices, materials.emission)

    def _texel_weights(self, number: int, size: tuple[int, int]) -> SparseMatrix:
        """Weights of the texels of an emitter's texture in the radiance of all samples, [sample, texel]."""
        if (number, size) not in self._texel_matrices:
            from scipy.sparse import csr_matrix, vstack

            mesh = self._merged_scene.scene.bodies[self.samples.bodies[number]].mesh
            counts = [item.vertices.shape[0] for item in self._merged_scene.emitter_sample_weights]
            blocks = [csr_matrix((count, size[0] * size[1])) for count in counts]
            faces, uvs, uv_faces = mesh.surface.faces, mesh.uvs, mesh.surface.uv_faces
            assert uvs is not None and uv_faces is not None
            weights = self._merged_scene.emitter_sample_weights[number]
            means = mean_over_texels(weights.patches, mesh.positions, faces, uvs, uv_faces, size)
            blocks[number] = means[weights.patch_of_samples]
            matrix = SparseMatrix.from_matrix(vstack(blocks), device=self._merged_scene.device)
            self._texel_matrices[number, size] = matrix
        return self._texel_matrices[number, size]

    def traced_light(
        self, receivers: Receivers, placed_samples: PlacedSamples, radiance: wp.array, transmittance: list[wp.array]
    ) -> wp.array:
        """Their light on receivers, given the transmittance to the samples of each."""
        sum_of = functools.partial(sum_light, receivers.points, receivers.normals, placed_samples, radiance)
        pairs = self._within_beams(receivers, placed_samples, transmittance)
        return add_light(*(sum_of(span, transmittances) for span, transmittances in pairs))

    def traced_highlights(
        self,
        receivers: Receivers,
        placed_samples: PlacedSamples,
        radiance: wp.array,
        transmittance: list[wp.array],
        roughness: wp.array,
        clip_matrices: wp.array,
    ) -> LobeLight:
        """Their light in the lobes of receivers, G and G', given transmittance as for :meth:`traced_light`."""
        points, normals = receivers.points, receivers.normals
        pairs = self._within_beams(receivers, placed_samples, transmittance)
        sum_of = functools.partial(sum_highlights, points, normals, roughness, clip_matrices, placed_samples, radiance)
        emitter_sums = [sum_of(span, transmittances) for span, transmittances in pairs]
        return LobeLight(*(add_light(*parts) for parts in zip(*emitter_sums, strict=True)))

    def _within_beams(
        self, receivers: Receivers, placed_samples: PlacedSamples, transmittance: list[wp.array]
    ) -> Iterator[tuple[EmitterSpan, wp.array | None]]:
        """Samples of each emitter, and the part of their light that receivers get, given the transmittance."""
        for span, item in zip(self.samples.spans(), transmittance, strict=True):
            yield span, weigh_by_beam(receivers.points, placed_samples, span, item)
