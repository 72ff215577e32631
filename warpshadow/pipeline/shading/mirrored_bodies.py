"""Mirrored bodies: light that bodies add to the mean radiance of blockers, where rays say which ones lobes meet.

As bodies and cameras move, two terms of the gradient nearly cancel: the mirrored light changes within a metal's outline
in a lobe, and the outline moves. Hits give the first alone, which is 2.6 times too large (two balls). So neither is
used: hits, and how much of them is seen, are constants, and the gradient is that of the mean radiance.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import warp as wp

from warpshadow.device.batch import instance_of
from warpshadow.device.constants import constant
from warpshadow.device.launch import without_gradient
from warpshadow.pipeline.bodies.merged_scene import MergedScene
from warpshadow.pipeline.bodies.reflectance import Materials
from warpshadow.pipeline.node import Node, detached, field_of
from warpshadow.pipeline.receivers.shading_context import ShadingContext, receiver_text
from warpshadow.pipeline.shading.light_input import LightInput
from warpshadow.stages.gloss.lobe_hits import HIT_TYPES, MIRRORS, REFLECTIONS, SENDS, LobeHits, hit_shapes, trace_hits
from warpshadow.stages.gloss.mirrored import mirror, mix_mirrored
from warpshadow.stages.planes.face_texels import FaceTexels
from warpshadow.stages.receivers.receivers import Receivers

SMOOTH = 0.3
"""Roughness up to which bodies that are no metals show others. With a floor of plastic of 0.2 in a niche the image is
8.4% off in place of 9.7, a moved image takes 2% longer."""


class ShownBodies(NamedTuple):
    """Bodies whose own light counts where lobes meet them, by number."""

    mirrors: tuple[int, ...]  # metals
    nonmetals: tuple[int, ...]  # others, which show their radiosity; () if nothing is smooth, or if it is not known


class MirroredBodies:
    """The bodies that lobes meet, which cast shadows, in a mesh that is made once and refitted to each geometry.

    Args:
        merged_scene: The bodies.
    """

    def __init__(self, merged_scene: MergedScene):
        self._merged_scene = merged_scene
        self._mesh: wp.Mesh | None = None

    @functools.cached_property
    def _has_smooth(self) -> bool:
        """Whether the scene has a smooth body, metal or not."""
        roughness = (body.roughness for body in self._merged_scene.scene.bodies)
        return any(values is not None and np.min(values) <= SMOOTH for values in roughness)

    def shown(self, materials: Materials, *, have_radiosity: bool) -> ShownBodies:
        """Find the bodies whose own light counts where lobes meet them.

        A metal without textures mirrors light if a lobe can meet it: if another body shines, or it is not convex.
        Where there is a metal or a smooth body, bodies that are no metals show their radiosity.

        Args:
            materials: Of the bodies.
            have_radiosity: Whether their radiosity is known.
        """
        bodies, is_glossy, metals = self._merged_scene.scene.bodies, self._merged_scene.is_glossy, materials.metals
        mirrors = tuple(
            number
            for number in metals
            if all(textures.sizes[number] is None for textures in materials.textures_of.values())
            and (is_glossy.sum() > 1 or not bodies[number].mesh.is_convex)
        )
        nonmetals = set(range(len(bodies))) - {*metals} if (metals or self._has_smooth) and have_radiosity else set()
        return ShownBodies(mirrors, tuple(sorted(nonmetals)))

    def radiance(
        self,
        shown: ShownBodies,
        context: ShadingContext,
        light: LightInput,
        materials: Materials,
        samples: Node,
        transmittance: Node,
        mean_radiance: Node,
        look_up: Callable[[Node, Node, Node], Node],
        radiosity: tuple[Node, FaceTexels] | None,
    ) -> Node:
        """Node of the radiance that bodies add to the mean of blockers, vec3 of shape [batch, receiver, sample].

        Args:
            shown: The bodies, of :meth:`shown`.
            context: The receivers.
            light: Known or free.
            materials: Of the bodies.
            samples: Node of the samples of lobes, cached for a roughness.
            transmittance: Node of the samples' transmittance.
            mean_radiance: Node of the mean radiance of each receiver's blockers.
            look_up: Makes the node of light without shadows, of nodes of directions, blurs, and where these rays
                start.
            radiosity: As of :meth:`.LightTransport.radiosity`.
        """
        faces, blurs = self._merged_scene.side_faces, field_of(samples, "blurs")
        directions, transmittance = (
            Node("", without_gradient, node) for node in (field_of(samples, "directions"), transmittance)
        )

        def trace() -> Node:
            find = functools.partial(self._find_hits, shown)
            traced = context.vertices, context.normals, context.receivers_node, directions, transmittance
            items = functools.partial(receiver_text, context.weak_reference)
            return Node("hits of lobes", find, *(detached(source) for source in traced), items=items)

        hits = context.cached("hits", (samples, light.visibility_key, shown), trace)
        roughness, albedo, metallic = (materials.of_vertices(name) for name in ("roughness", "albedo", "metallic"))
        mirrored = Node("", mirror, hits, faces, roughness, directions, blurs)
        directions, fresnel_weights, blurs = (
            field_of(mirrored, name) for name in ("directions", "fresnel_weights", "blurs")
        )
        mirrored_light = look_up(directions, blurs, field_of(hits, "points"))
        surface_radiosity, texels = radiosity or (None, None)
        inputs = faces, albedo, metallic, fresnel_weights, mirrored_light, mean_radiance, transmittance
        mix = functools.partial(mix_mirrored, texels=texels)
        return Node("light of mirrored bodies", mix, hits, *inputs, surface_radiosity)

    def _find_hits(
        self,
        shown: ShownBodies,
        positions: wp.array,
        vertex_normals: wp.array,
        receivers: Receivers,
        directions: wp.array,
        transmittance: wp.array,
    ) -> LobeHits:
        """Trace all instances: arrays of batches."""
        merged_scene = self._merged_scene
        light_of_bodies = np.zeros(len(merged_scene.scene.bodies), np.int32)
        light_of_bodies[[*shown.nonmetals]], light_of_bodies[[*shown.mirrors]] = SENDS, MIRRORS
        light_of_face = constant(light_of_bodies[merged_scene.body_of_face], wp.int32, positions.device)
        reflections = REFLECTIONS if shown.mirrors else 1
        hits = [
            trace_hits(
                self._refitted(instance_of(positions, instance)),
                light_of_face,
                merged_scene.faces,
                instance_of(vertex_normals, instance),
                instance_of(receivers.points, instance),
                instance_of(receivers.normals, instance),
                instance_of(directions, instance),
                instance_of(transmittance, instance),
                reflections,
            )
            for instance in range(len(directions) if directions.size else 0)
        ]
        shapes = hit_shapes(reflections, *directions.shape[1:])
        joined = [
            wp.empty((len(directions), *shape), dtype=dtype, device=directions.device)
            for shape, dtype in zip(shapes, HIT_TYPES, strict=True)
        ]
        for array, parts in zip(joined, zip(*hits, strict=True), strict=False):
            for instance, part in enumerate(parts):
                wp.copy(array[instance], part)
        return LobeHits(*joined)

    def _refitted(self, positions: wp.array) -> wp.Mesh:
        """The mesh, of vertices of shape [vertex]; until the next is asked for."""
        if self._mesh is None:
            self._mesh = self._merged_scene.mesh(positions, only_casters=True)
        wp.copy(self._mesh.points, positions)
        self._mesh.refit()
        return self._mesh
