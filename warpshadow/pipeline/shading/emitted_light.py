"""Light of emitters on receivers past the blockers between: direct light, and highlights in lobes."""

import functools
from collections.abc import Iterable, Iterator, Sequence

import numpy as np
import warp as wp

from warpshadow.device.batch import common_batch, cut
from warpshadow.device.tape import unrecorded
from warpshadow.maths.directions import fibonacci
from warpshadow.pipeline.bodies.blockers import Blockers
from warpshadow.pipeline.receivers.groups import Group, GroupConvexParts
from warpshadow.pipeline.shading.transfers import join_portions
from warpshadow.stages.emitters.emitter_self_visibility import EmitterSelfVisibility, look_up_self_visibility
from warpshadow.stages.emitters.light import (
    find_directions_to_samples,
    find_transmittance_to_samples,
    replace_instances,
    sum_light,
)
from warpshadow.stages.emitters.samples import EmitterSamples, EmitterSpan, PlacedSamples
from warpshadow.stages.emitters.spot_cones import weigh_by_beam
from warpshadow.stages.gloss.highlights import sum_highlights
from warpshadow.stages.gloss.reflection import LobeLight
from warpshadow.stages.gloss.transmittance import interpolate_transmittance
from warpshadow.stages.joint_coverage import transmittance_past
from warpshadow.stages.light.sums import add_light

EMITTER_CELLS = fibonacci(512)
"""Cells in which receivers look up the self-visibility of their body. With 128 in place of 512, a bear and a bunny at
vertices in a room with a lamp were 16.6 and 3.2% off in direct light in place of 12.7 and 1.9%."""


def find_emitted_light(
    emitters: EmitterSamples,
    self_visibility: Sequence[EmitterSelfVisibility | None],
    portions: Iterable[Group],
    blockers: Blockers,
    placed_samples: PlacedSamples,
    radiance: wp.array,
) -> wp.array:
    """Direct light of emitters on receivers, vec3 of shape [batch, receiver].

    Args:
        emitters: Their samples.
        self_visibility: Of each; None of one that hides nothing of itself.
        portions: The receivers, with the self-visibility of their bodies in EMITTER_CELLS.
        blockers: All of them.
        placed_samples: Where the samples are.
        radiance: Of the samples, vec3 of shape [batch, sample].
    Differentiable: blockers, receivers of the portions, placed_samples, radiance.
    """

    def light_of(portion: Group) -> wp.array:
        total = wp.zeros(portion.points.shape, dtype=wp.vec3, device=portion.points.device)
        lit = portion.points, portion.normals, placed_samples, radiance
        for pair in _find_transmittances(emitters, self_visibility, portion, blockers, placed_samples):
            total = add_light(total, sum_light(*lit, *pair))
        return total

    return join_portions(list(map(light_of, portions)))


def find_highlights(
    emitters: EmitterSamples,
    self_visibility: Sequence[EmitterSelfVisibility | None],
    portions: Iterable[Group],
    blockers: Blockers,
    placed_samples: PlacedSamples,
    radiance: wp.array,
    roughness: wp.array,
    clip_matrices: wp.array,
) -> LobeLight:
    """Direct light of emitters in the lobes of receivers (:mod:`.stages.gloss.highlights`).

    Args:
        emitters, self_visibility, portions, blockers, placed_samples, radiance: As for :func:`find_emitted_light`.
        roughness: Of all receivers, float32 of shape [batch, receiver].
        clip_matrices: Cameras, mat44 of shape [batch].
    Differentiable: as that, and roughness and clip_matrices.
    """
    sums, first = [], 0
    for portion in portions:
        end = first + portion.points.shape[1]
        seen = portion.points, portion.normals, cut(roughness, first, end), clip_matrices
        zeros = wp.zeros(portion.points.shape, dtype=wp.vec3, device=portion.points.device)
        emitter_sums = [
            sum_highlights(*seen, placed_samples, radiance, *pair)
            for pair in _find_transmittances(emitters, self_visibility, portion, blockers, placed_samples)
        ]
        sums.append([add_light(zeros, *parts) for parts in zip(*emitter_sums, strict=True)] or [zeros, zeros])
        first = end
    return LobeLight(*(join_portions(list(portions)) for portions in zip(*sums, strict=True)))


def _find_transmittances(
    emitters: EmitterSamples,
    self_visibility: Sequence[EmitterSelfVisibility | None],
    group: Group,
    blockers: Blockers,
    placed_samples: PlacedSamples,
) -> Iterator[tuple[EmitterSpan, wp.array | None]]:
    """Samples of all emitters that light a portion of receivers, and the transmittance to them.

    An emitter also lights itself, if it is not convex.
    """
    merged_scene, points, normals = blockers.merged_scene, group.points, group.normals
    if not points.size:
        return
    transmittance_of_cells = (
        transmittance_past(None, group.blockers.self_blocker.coverage(group, EMITTER_CELLS))
        if isinstance(group.blockers.self_blocker, GroupConvexParts)
        else group.looked_up_transmittance()
    )

    @functools.cache
    def self_meshes() -> list[wp.Mesh | None]:
        """The receivers' own body in each geometry, for all emitters within it."""
        bodies = () if group.body is None else (group.body,)
        positions = blockers.positions
        return [merged_scene.blocker_mesh(positions[geometry], bodies) for geometry in range(len(positions))]

    for body, span, hidden_by_itself in zip(emitters.bodies, emitters.spans(), self_visibility, strict=True):
        is_on_emitter = body == group.body
        if is_on_emitter and hidden_by_itself is None:
            continue
        transmittance_self = None
        if transmittance_of_cells is not None and not is_on_emitter:
            is_within = _find_where_enclosed(blockers, body, group.body)
            if not is_within.all():
                directions = find_directions_to_samples(points, placed_samples, span)
                transmittance_self = interpolate_transmittance(
                    transmittance_of_cells, normals, directions, EMITTER_CELLS
                )
            if is_within.any():
                # cells tell whether rays leave the body: a bulb in a shade would be hidden by the shade's far side
                with unrecorded():
                    arguments = self_meshes(), points, normals, emitters, blockers.positions, placed_samples, span
                    traced = trace_transmittances(*arguments, rays=1)
                transmittance_self = replace_instances(transmittance_self, traced, is_within)
        transmittance_of_emitter = None
        if hidden_by_itself is not None:
            lookup = points, placed_samples, span, hidden_by_itself
            transmittance_of_emitter = look_up_self_visibility(*lookup, is_on_emitter=is_on_emitter)
        logs = {
            f"log_of_{name}": kind.log_transmittance(group, placed_samples, span, body)
            for name, kind in group.blockers.kinds.items()
        }
        yield (
            span,
            find_transmittance_to_samples(
                **logs,
                transmittance_self=transmittance_self,
                transmittance_of_emitter=weigh_by_beam(points, placed_samples, span, transmittance_of_emitter),
            ),
        )


def _find_where_enclosed(blockers: Blockers, emitter: int, body: int | None) -> np.ndarray:
    """Find the geometries with an emitter inside the bounds of a body, so that parts may be behind it, bool.

    On a GPU, which would have to wait for that, the scene's own bodies tell. A graph of a CPU is refused by the read.
    """
    if body is None:
        return np.zeros(1, bool)
    starts = blockers.merged_scene.first_vertex
    if blockers.positions.device.is_cpu:
        positions = blockers.positions.numpy()
        emitter_positions, body_positions = (
            positions[:, starts[number] : starts[number + 1]] for number in (emitter, body)
        )
    else:
        bodies = blockers.merged_scene.scene.bodies
        emitter_positions, body_positions = (bodies[number].world_points()[None] for number in (emitter, body))
    middle = (emitter_positions.min(axis=1) + emitter_positions.max(axis=1)) / 2
    is_within: np.ndarray = ((body_positions.min(axis=1) < middle) & (middle < body_positions.max(axis=1))).all(axis=1)
    return is_within


def trace_transmittances(
    meshes: Sequence[wp.Mesh | None],
    points: wp.array,
    normals: wp.array,
    emitters: EmitterSamples,
    positions: wp.array,
    placed_samples: PlacedSamples,
    span: EmitterSpan,
    *,
    rays: int | np.ndarray,
    progress: bool = False,
) -> wp.array:
    """Trace the transmittance to the samples of an emitter in all instances.

    Args:
        meshes: The blockers of each geometry; None for none.
        points, normals: Receivers, vec3 of shape [batch, receiver].
        emitters, span: Samples of all emitters, and those of one.
        positions: All vertices, vec3 of shape [geometry, vertex].
        placed_samples: Where the samples are in each geometry.
        rays: To each sample, one number, or ints of shape [sample].
    Returns:
        Float32 of shape [batch, receiver, sample].
    Differentiable: no.
    """
    from warpshadow.stages.emitters.traced_transmittance import trace_transmittance

    count = common_batch({"points": points, "geometry": positions})
    traced = wp.empty((count, points.shape[1], span.size), dtype=wp.float32, device=points.device)
    for instance in range(count if points.size else 0):
        geometry, view = min(instance, len(positions) - 1), min(instance, len(points) - 1)
        rows = trace_transmittance(
            *(meshes[geometry], points[view], normals[view], emitters, positions[geometry]),
            *(placed_samples.points[geometry], placed_samples.areas[geometry], span),
            rays=rays,
            progress=progress,
        )
        wp.copy(traced[instance], rows)
    return traced
