"""Mirrored bodies: radiance of the blockers of each sample of lobes, where rays say which metals these meet."""

from __future__ import annotations

import functools
from collections.abc import Callable

import numpy as np
import warp as wp

from warpshadow.device.batch import instance_of
from warpshadow.device.constants import constant
from warpshadow.pipeline.bodies.merged_scene import MergedScene
from warpshadow.pipeline.bodies.reflectance import Materials
from warpshadow.pipeline.node import Node, detached, field_of
from warpshadow.pipeline.receivers.shading_context import ShadingContext, receiver_text
from warpshadow.stages.gloss.lobe_hits import HIT_TYPES, LobeHits, trace_hits
from warpshadow.stages.gloss.mirrored import mirror, mix_mirrored
from warpshadow.stages.receivers.find import Receivers


def find_mirrored_radiance(
    points: ShadingContext,
    materials: Materials,
    samples: Node,
    transmittance: Node,
    mean_radiance: Node,
    look_up: Callable[[Node, Node, Node], Node],
) -> Node:
    """Node of the radiance of blockers, vec3 of shape [batch, receiver, sample].

    Args:
        points: The receivers.
        materials: Of the bodies.
        samples: Node of their lobes' samples.
        transmittance: Node of the samples' transmittance, 0 or 1.
        mean_radiance: Node of the mean radiance of each receiver's blockers.
        look_up: Makes the node of light without shadows, of nodes of directions, filters, and where these rays start.
    """
    merged_scene, faces = points.merged_scene, points.merged_scene.faces
    directions = field_of(samples, "directions")
    find = functools.partial(_find_hits, merged_scene, _mirror_faces(merged_scene, materials))
    traced = points.vertices, points.normals, points.receivers_node, directions, transmittance
    items = functools.partial(receiver_text, points.weak)
    hits = Node("hits of lobes", find, *(detached(source) for source in traced), items=items)
    roughness, albedo, metallic = (materials.of_vertices(name) for name in ("roughness", "albedo", "metallic"))
    mirrored = Node("", mirror, hits, faces, roughness, directions, field_of(samples, "filters"))
    filters = field_of(mirrored, "filters")
    light = look_up(field_of(mirrored, "directions"), filters, field_of(hits, "points"))
    return Node("light of metals", mix_mirrored, hits, faces, albedo, metallic, filters, light, mean_radiance)


def _mirror_faces(merged_scene: MergedScene, materials: Materials) -> wp.array:
    """1 for faces of bodies that shine and have no textures, whose color and roughness vertices have."""
    is_mirror = merged_scene.is_glossy.copy()
    for textures in materials.textures_of.values():
        is_mirror &= np.array([size is None for size in textures.sizes])
    return constant(is_mirror[merged_scene.body_of_face].astype(np.int32), wp.int32, merged_scene.device)


def _find_hits(
    merged_scene: MergedScene,
    is_mirror: wp.array,
    positions: wp.array,
    vertex_normals: wp.array,
    receivers: Receivers,
    directions: wp.array,
    transmittance: wp.array,
) -> LobeHits:
    """Trace all instances: arrays of shape [batch, receiver, sample]."""
    hits = [
        trace_hits(
            merged_scene.mesh(instance_of(positions, instance)),
            is_mirror,
            merged_scene.faces,
            instance_of(vertex_normals, instance),
            instance_of(receivers.points, instance),
            instance_of(receivers.normals, instance),
            instance_of(directions, instance),
            instance_of(transmittance, instance),
        )
        for instance in range(len(directions) if directions.size else 0)
    ]
    joined = [wp.empty(directions.shape, dtype=dtype, device=directions.device) for dtype in HIT_TYPES]
    for array, parts in zip(joined, zip(*hits, strict=True), strict=False):
        for instance, part in enumerate(parts):
            wp.copy(array[instance], part)
    return LobeHits(*joined)
