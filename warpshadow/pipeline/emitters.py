"""Emitters: the light of bodies that emit, on receivers that the blockers between stand before.

A body with emission is a part of the direct light: the sum over its samples at a receiver (:mod:`.stages.emitters`) adds
to the light of the map, bounces as that does, and is blocked by the bodies between, not by bodies behind it. In the
image its surface has its radiance beside the light that it reflects.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator

import numpy as np
import warp as wp

from warpshadow.maths.directions import fibonacci
from warpshadow.pipeline.by_spheres import SphereMethod, placed_blockers, self_lookups_node
from warpshadow.pipeline.merged_scene import MergedScene
from warpshadow.pipeline.methods.directional import ProjectedCells
from warpshadow.pipeline.node import Node
from warpshadow.pipeline.receivers.groups import Blockers, Group, find_groups
from warpshadow.pipeline.receivers.lit_points import LitPoints, receiver_text
from warpshadow.pipeline.reflectance import Materials
from warpshadow.pipeline.self_visibility import SelfVisibilityLookup
from warpshadow.pipeline.transfers import joined
from warpshadow.stages.bounces.total import total_light
from warpshadow.stages.emitters.light import directions_to_samples, sum_light
from warpshadow.stages.emitters.planes import find_log_transmittance_of_planes
from warpshadow.stages.emitters.samples import (
    EmitterSamples,
    EmitterSpan,
    PlacedSamples,
    find_sample_weights,
    place_samples,
)
from warpshadow.stages.emitters.spheres import find_log_transmittance
from warpshadow.stages.gloss.transmittance import transmittance_of_directions
from warpshadow.stages.receivers import Receivers
from warpshadow.stages.self_visibility.gather import gather_self_transmittance
from warpshadow.stages.sparse import SparseMatrix, multiply

_SELF_CELLS = fibonacci(512)
"""Cells in which receivers look up the self-visibility of their body. With 128 in place of 512, a bear and a bunny at
vertices in a room with a lamp were 16.6 and 3.2% off in direct light in place of 12.7 and 1.9%."""


class SceneEmitters:
    """The bodies of a scene that emit.

    Args:
        merged_scene: All bodies.
    """

    def __init__(self, merged_scene: MergedScene):
        self._merged_scene = merged_scene

    @functools.cached_property
    def samples(self) -> EmitterSamples:
        """Samples of all emitters."""
        from scipy.sparse import csr_matrix, vstack

        merged_scene, of_vertices, of_faces = self._merged_scene, [], []
        bodies = np.flatnonzero(merged_scene.is_emitter).tolist()
        counts = [len(merged_scene.scene.bodies[body].mesh.surface.faces) for body in bodies]
        first_face = np.cumsum([0, *counts])
        for body, face in zip(bodies, first_face[:-1], strict=True):
            mesh = merged_scene.scene.bodies[body].mesh
            arguments = mesh.positions, mesh.surface.faces
            is_two_sided = bool(merged_scene.is_two_sided[body])
            weights = find_sample_weights(*arguments, is_two_sided=is_two_sided, device=merged_scene.device)
            sizes = (int(merged_scene.first_vertex[-1]), int(first_face[-1]))
            starts = int(merged_scene.first_vertex[body]), int(face)
            for matrix, parts, start, size in zip(weights, (of_vertices, of_faces), starts, sizes, strict=True):
                moved = csr_matrix((matrix.data, matrix.indices + start, matrix.indptr), (matrix.shape[0], size))
                parts.append(moved)
        is_emitting = np.isin(merged_scene.body_of_face, bodies)
        faces = wp.array(merged_scene.faces.numpy()[is_emitting], dtype=wp.vec3i, device=merged_scene.device)
        matrices = (SparseMatrix.from_matrix(vstack(parts), device=merged_scene.device) for parts in (of_vertices, of_faces))
        first = np.cumsum([0, *(matrix.shape[0] for matrix in of_vertices)])
        is_open = tuple(merged_scene.is_two_sided[bodies].tolist())
        return EmitterSamples(*matrices, faces, tuple(bodies), is_open, first)

    def placed(self, points: LitPoints) -> Node:
        """Node of the samples among the bodies around points."""
        return points.cached("emitters", None, lambda: Node("", place_samples, points.vertices, self.samples))

    def radiance(self, materials: Materials) -> Node:
        """Node of the samples' radiance, vec3 of shape [batch, sample]."""
        return Node("", lambda emission: multiply(self.samples.vertices, emission), materials.of_vertices("emission"))

    def unblocked_light(self, points: LitPoints, receivers: Node, materials: Materials) -> Node:
        """Node of their light without blockers on receivers among the bodies around points."""
        return Node("", self._find_unblocked, receivers, self.placed(points), self.radiance(materials))

    def _find_unblocked(self, receivers: Receivers, placed_samples: PlacedSamples, radiance: wp.array) -> wp.array:
        lights = [
            sum_light(receivers.points, receivers.normals, placed_samples, radiance, span)
            for span in self.samples.spans()
        ]
        return functools.reduce(lambda first, second: total_light([first, second]), lights)


def emitted_light(method: SphereMethod, emitters: SceneEmitters, points: LitPoints, materials: Materials) -> Node:
    """Node of the direct light of emitters on points, vec3 of shape [batch, receiver]."""
    return Node(
        "light of emitters",
        functools.partial(_find_light, method, emitters, points),
        points.receivers_node,
        placed_blockers(method, points),
        _self_lookups(method, points),
        emitters.placed(points),
        emitters.radiance(materials),
        items=lambda: f"{receiver_text(points)} × {emitters.samples.first[-1]} samples",
    )


def _self_lookups(method: SphereMethod, points: LitPoints) -> Node:
    """Node of the self-visibility of bodies in fine cells, by body."""
    if not method.traces_self_visibility:
        return Node("", None)
    make = functools.partial(self_lookups_node, method, points, ProjectedCells(_SELF_CELLS))
    return points.cached("self-visibility towards emitters", None, make)


def _find_light(
    method: SphereMethod,
    emitters: SceneEmitters,
    points: LitPoints,
    receivers: Receivers,
    blockers: Blockers,
    self_lookups: dict[int, SelfVisibilityLookup] | None,
    placed_samples: PlacedSamples,
    radiance: wp.array,
) -> wp.array:
    lights = []
    for group in find_groups(points, receivers, blockers, self_lookups, None, None):
        for portion in group.portions():
            lights.append(_light_of(method, emitters, portion, blockers, placed_samples, radiance))
    return joined(lights)


def _light_of(
    method: SphereMethod,
    emitters: SceneEmitters,
    group: Group,
    blockers: Blockers,
    placed_samples: PlacedSamples,
    radiance: wp.array,
) -> wp.array:
    """Light of all emitters but the group's own body on a portion of the receivers."""
    merged_scene, points, normals = method.merged_scene, group.points, group.normals
    if not points.size:
        return wp.zeros(points.shape, dtype=wp.vec3, device=points.device)
    cells = _self_transmittance(group)
    sphere_bodies = [number for number in blockers.bodies if number not in blockers.blocker_kinds.planes]
    spheres = merged_scene.spheres_of(sphere_bodies, blockers.spheres)
    traced_body = group.body if group.body in blockers.blocker_kinds.traced else None
    total = wp.zeros(points.shape, dtype=wp.vec3, device=points.device)
    for body, span in zip(emitters.samples.bodies, emitters.samples.spans(), strict=True):
        if body == group.body:
            continue
        skipped_bodies = tuple(merged_scene.spheres_among(sphere_bodies, number) for number in (traced_body, body))
        transmittance_self = None
        if cells is not None:
            towards = directions_to_samples(points, placed_samples, span)
            transmittance_self = transmittance_of_directions(cells, normals, towards, _SELF_CELLS)
        light = sum_light(
            *(points, normals, placed_samples, radiance, span),
            log_of_spheres=find_log_transmittance(points, normals, placed_samples, span, *spheres, skipped_bodies),
            log_of_planes=_log_of_planes(group, blockers, placed_samples, span, body),
            transmittance_self=transmittance_self,
        )
        total = total_light([total, light])
    return total


def _self_transmittance(group: Group) -> wp.array | None:
    """Transmittance of the receivers' own body in even cells, [batch, receiver, cell]; None where that is 1."""
    if group.self_lookup is None:
        return None
    assert group.probe_weights is not None and isinstance(group.self_lookup, SelfVisibilityLookup)
    rows, lookup, kernels, _ = group.self_lookup
    return gather_self_transmittance(group.normals, group.probe_weights, lookup, kernels, rows)


def _log_of_planes(
    group: Group, blockers: Blockers, placed_samples: PlacedSamples, span: EmitterSpan, body: int
) -> wp.array | None:
    """Logarithm of the transmittance of planes between a group and an emitter; None without any."""
    planes, numbers = group.planes, blockers.blocker_kinds.planes
    if planes is None or not group.is_before_planes:
        return None
    points, _ = group.lifted_points_and_fronts(planes.frames, planes.planes, planes.skip)
    skipped = -1 if planes.skip is None else planes.skip, numbers.index(body) if body in numbers else -1
    return find_log_transmittance_of_planes(
        points, group.normals, placed_samples, span, planes.frames, planes.planes, skipped
    )
