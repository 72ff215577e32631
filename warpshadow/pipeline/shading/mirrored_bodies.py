"""Mirrored bodies: radiance of the blockers of each sample of lobes, where rays say which metals these meet."""

from __future__ import annotations

import functools
from collections.abc import Callable

import numpy as np
import warp as wp

from warpshadow.device.batch import common_batch, instance_of
from warpshadow.device.constants import constant
from warpshadow.device.memory import empty
from warpshadow.device.tape import unrecorded
from warpshadow.pipeline.bodies.merged_scene import MergedScene
from warpshadow.pipeline.bodies.reflectance import Materials
from warpshadow.pipeline.node import Node, detached, field_of
from warpshadow.pipeline.receivers.shading_context import ShadingContext, receiver_text
from warpshadow.pipeline.shading.light_input import LightInput
from warpshadow.stages.gloss.lobe_hits import LobeHits, trace_hits
from warpshadow.stages.gloss.mirrored import find_mirrors, mix_mirrored
from warpshadow.stages.receivers.find import Receivers


class MirroredBodies:
    """The bodies as rays from lobes meet them: a mesh whose hierarchy is refitted to each geometry.

    Args:
        merged_scene: The bodies.
    """

    def __init__(self, merged_scene: MergedScene):
        self._merged_scene = merged_scene
        self._mesh: wp.Mesh | None = None

    def mirrors(self, materials: Materials) -> tuple[int, ...]:
        """Bodies that lobes may meet as metals: they have no textures, and other bodies shine or they are not convex.

        Args:
            materials: Of the bodies.
        """
        bodies, is_glossy = self._merged_scene.scene.bodies, self._merged_scene.is_glossy
        has_texture = np.any([[size is not None for size in of.sizes] for of in materials.textures_of.values()], axis=0)
        return tuple(
            number
            for number in np.flatnonzero(is_glossy & ~has_texture).tolist()
            if materials.may_be_metal(number) and (is_glossy.sum() > 1 or not bodies[number].mesh.is_convex)
        )

    def radiance(
        self,
        points: ShadingContext,
        light: LightInput,
        materials: Materials,
        mirrors: tuple[int, ...],
        samples: Node,
        transmittance: Node,
        mean_radiance: Node,
        look_up: Callable[[Node, Node, Node], Node],
    ) -> Node:
        """Node of the radiance of blockers, vec3 of shape [batch, receiver, sample].

        Args:
            points: The receivers.
            light: Known or free.
            materials: Of the bodies.
            mirrors: Of :meth:`mirrors`.
            samples: Node of the lobes' samples, cached with the roughness.
            transmittance: Node of the samples' transmittance.
            mean_radiance: Node of the mean radiance of each receiver's blockers.
            look_up: Makes the node of light without shadows, of nodes of directions, filters, and where rays start.
        """
        faces = self._merged_scene.faces
        starts, directions = field_of(points.receivers_node, "points"), field_of(samples, "directions")

        def trace() -> Node:
            find = functools.partial(self._find_hits, mirrors)
            traced = points.vertices, points.normals, points.receivers_node, directions, transmittance
            items = functools.partial(receiver_text, points.weak)
            return Node("hits of lobes", find, *map(detached, traced), items=items)

        hits = points.cached("hits", (samples, light.visibility_key, mirrors), trace)
        roughness, albedo, metallic = (materials.of_vertices(name) for name in ("roughness", "albedo", "metallic"))
        of_vertices, of_samples = (
            (points.vertices, points.normals, roughness),
            (directions, field_of(samples, "filters")),
        )
        found = Node("", find_mirrors, hits, faces, *of_vertices, starts, *of_samples)
        mirrored_light = look_up(*(field_of(found, name) for name in ("directions", "filters", "points")))
        of_metals = found, albedo, metallic, mirrored_light
        return Node("light of metals", mix_mirrored, hits, faces, *of_metals, mean_radiance)

    def _find_hits(
        self,
        mirrors: tuple[int, ...],
        positions: wp.array,
        vertex_normals: wp.array,
        receivers: Receivers,
        directions: wp.array,
        transmittance: wp.array,
    ) -> LobeHits:
        """Trace all instances: arrays of shape [batch, receiver, sample]."""
        merged_scene, device = self._merged_scene, directions.device
        is_mirror = constant(np.isin(merged_scene.body_of_face, mirrors).astype(np.int32), wp.int32, device)
        batches = positions, vertex_normals, receivers.points, receivers.normals, directions, transmittance
        shape = common_batch({str(number): batch for number, batch in enumerate(batches)}), *directions.shape[1:]
        hits = LobeHits(*(empty(shape, dtype=dtype, device=device) for dtype in (wp.int32, wp.float32)))
        for instance in range(shape[0] if directions.size else 0):
            of_vertices, *of_receivers = (instance_of(batch, instance) for batch in batches)
            mesh, of_instance = self._refitted(of_vertices), LobeHits(*(array[instance] for array in hits))
            trace_hits(mesh, is_mirror, merged_scene.faces, *of_receivers, of_instance)
        return hits

    def _refitted(self, positions: wp.array) -> wp.Mesh:
        """The mesh of all bodies, of vertices [vertex]; until the next one is asked for."""
        if self._mesh is None:
            self._mesh = self._merged_scene.mesh(positions)
        with unrecorded():
            wp.copy(self._mesh.points, positions)
        self._mesh.refit()
        return self._mesh
