"""Receiver groups: receivers of one or many bodies that are lit by the same launches, and the blockers around them.

A kind of blocker has the members of :class:`BlockersOfKind`, by which methods and lamps see it.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import numpy as np
import warp as wp

from warpshadow.device.batch import common_batch, cut, expand
from warpshadow.device.launch import any_requires_grad
from warpshadow.pipeline.bodies.scene_planes import BodySides
from warpshadow.pipeline.bodies.self_visibility import SelfLookup, SelfVisibilityLookup
from warpshadow.stages.convex.convex_blockers import ConvexBlockers, PlacedParts
from warpshadow.stages.convex.coverage import part_coverage
from warpshadow.stages.light.cached_cells import CachedRows
from warpshadow.stages.planes.fronts import NearestBlockers, PlaneFronts, find_fronts
from warpshadow.stages.planes.plane_blockers import PlaneBlockers
from warpshadow.stages.receivers.body_spans import Span, relative_spans
from warpshadow.stages.self_visibility.probes import ProbeWeights
from warpshadow.stages.visibility.traversal import ClusterTree

if TYPE_CHECKING:  # kernels of lamps take time to import
    from warpshadow.stages.emitters.samples import EmitterSpan, PlacedSamples

RECEIVERS_AT_ONCE = 1 << 13  # receivers of each instance that are lit at once where no gradient is asked for


class BlockersOfKind(Protocol):
    """Blockers of one kind around receivers."""

    @property
    def placed_arrays(self) -> Mapping[str, wp.array]:
        """Arrays of shape [batch, …] that say where they are, by their names in messages."""

    def log_transmittance(self, group: Group, samples: PlacedSamples, span: EmitterSpan, emitter: int) -> wp.array:
        """Logarithm of the transmittance to the samples of an emitter, float32 of shape [batch, receiver, sample].

        Neither the receivers' own body nor the emitter, a body, blocks. Differentiable: all arrays.
        """


class CoveringBlockers(BlockersOfKind, Protocol):
    """Blockers of a kind whose share of each cell of directions is known."""

    def coverage(self, group: Group, directions: np.ndarray, radius: float | None = None) -> wp.array:
        """Coverage (h, μ) of cells, vec4 of shape [batch, receiver, direction].

        Args:
            group: The receivers.
            directions: Of the cells, [direction, 3].
            radius: Of cells that do not tile the sphere [rad]; None for those that do.
        Differentiable: arrays of the group, and of the blockers.
        """


class GroupSpheres(NamedTuple):
    """Spheres around a group."""

    centers: wp.array  # vec3 of shape [batch, sphere]
    radii: wp.array  # float32 of shape [batch, sphere]
    ranges: Mapping[int, tuple[int, int]]  # spheres of each body: the first, and the one after the last
    self_traced: tuple[int, ...] = ()  # bodies whose spheres block none of their own light
    clusters: ClusterTree | None = None  # of the spheres, where they are found already

    @property
    def placed_arrays(self) -> Mapping[str, wp.array]:
        """Where they are."""
        return {"centers": self.centers, "radii": self.radii}

    def skip(self, body: int | None) -> tuple[int, int]:
        """Spheres that block no light of receivers on a body: the first, and the one after the last."""
        return self.ranges[body] if body in self.self_traced and body in self.ranges else (0, 0)

    def skips(self, spans: Iterable[Span]) -> list[tuple[int, int]]:
        """Ranges of spheres that block no light of the receivers of each span."""
        return [self.skip(span.body) for span in spans]

    def transmittance(self, group: Group, directions: np.ndarray, **options: Any) -> wp.array:
        """Transmittance of cells, with the options of :func:`.directional.transmittance`: how soft edges are."""
        from warpshadow.stages.visibility.directional import transmittance

        arguments = group.points, group.horizon_normals, self.centers, self.radii, directions
        options |= {"body_spans": group.spans, "skips": self.skips(group.spans), "clusters": self.clusters}
        return transmittance(*arguments, **options)

    def log_transmittance(self, group: Group, samples: PlacedSamples, span: EmitterSpan, emitter: int) -> wp.array:
        """Logarithm of the transmittance to an emitter, see :class:`BlockersOfKind`."""
        from warpshadow.stages.emitters.sphere_transmittance import find_log_transmittance

        skipped = self.skip(group.body), self.ranges.get(emitter, (0, 0))
        spheres = self.centers, self.radii
        return find_log_transmittance(group.points, group.normals, samples, span, *spheres, skipped)

    def expanded(self, instances: int) -> GroupSpheres:
        """Repeat spheres of a batch of 1 for every instance. Differentiable: centers, radii."""
        centers, radii = expand(self.centers, instances), expand(self.radii, instances)
        is_same = centers is self.centers and radii is self.radii
        return self._replace(centers=centers, radii=radii, clusters=self.clusters if is_same else None)


class GroupPlanes(NamedTuple):
    """Flat bodies around a group."""

    blockers: PlaneBlockers
    frames: wp.array  # where they are, vec3 of shape [batch, 3 · plane]
    bodies: tuple[int, ...]  # as ``blockers`` numbers them
    body_sides: BodySides
    self_plane: int | None = None  # the one that the receivers are part of

    @property
    def placed_arrays(self) -> Mapping[str, wp.array]:
        """Where they are."""
        return {"planes": self.frames}

    def coverage(self, group: Group, directions: np.ndarray, radius: float | None = None) -> wp.array:
        """Coverage of cells, see :class:`CoveringBlockers`."""
        from warpshadow.stages.planes.coverage import plane_coverage

        arguments = group.fronts_of_planes.lifted_points, self.frames, self.blockers, directions
        coverage = plane_coverage(*arguments, radius=radius, **self._options(group))
        assert coverage is not None  # planes besides their own are around the receivers
        return coverage

    def coverage_of_light(
        self, group: Group, coverage: wp.array, directions: np.ndarray, samples: np.ndarray
    ) -> wp.array:
        """Coverage of the light of cells, whose coverage is known, see :func:`.coverage_of_light`."""
        from warpshadow.stages.planes.partial_cells import coverage_of_light

        arguments = group.fronts_of_planes.lifted_points, coverage, self.frames, self.blockers, directions, samples
        return coverage_of_light(*arguments, **self._options(group))

    def _options(self, group: Group) -> dict[str, Any]:
        return {
            "horizon_normals": group.horizon_normals,
            "front_weights": group.fronts_of_planes.front_weights,
            "self_plane": self.self_plane,
        }

    def log_transmittance(self, group: Group, samples: PlacedSamples, span: EmitterSpan, emitter: int) -> wp.array:
        """Logarithm of the transmittance to an emitter, see :class:`BlockersOfKind`."""
        from warpshadow.stages.emitters.plane_transmittance import find_log_transmittance_of_planes

        receivers = group.fronts_of_planes.lifted_points, group.normals
        planes = self.frames, self.blockers, self.body_sides.sides_of(self.frames, self.blockers)
        emitter_plane = self.bodies.index(emitter) if emitter in self.bodies else -1
        skipped = -1 if self.self_plane is None else self.self_plane, emitter_plane
        return find_log_transmittance_of_planes(*receivers, samples, span, *planes, emitter, skipped)


class GroupConvexParts(NamedTuple):
    """Convex parts around a group, or of the body on which it lies."""

    blockers: ConvexBlockers
    placed_parts: PlacedParts
    bodies: tuple[int, ...] = ()  # as ``blockers`` numbers them; each blocks no light of receivers that lie on it
    on_surface: bool = False  # whether receivers lie on the parts, which are those of one body

    @property
    def placed_arrays(self) -> Mapping[str, wp.array]:
        """Where they are."""
        return {"parts": self.placed_parts.corners}

    def _number_of(self, body: int | None) -> int:
        """The number that a body has here; −1 for none."""
        return self.bodies.index(body) if body in self.bodies else -1

    def coverage(self, group: Group, directions: np.ndarray, radius: float | None = None) -> wp.array:
        """Coverage of cells, see :class:`CoveringBlockers` and :func:`.part_coverage`."""
        return part_coverage(
            group.points,
            self.placed_parts,
            self.blockers,
            directions,
            radius=radius,
            horizon_normals=group.horizon_normals,
            body_spans=group.spans,
            self_bodies=[self._number_of(span.body) for span in group.spans] or [-1],
            on_surface=self.on_surface,
        )

    def log_transmittance(self, group: Group, samples: PlacedSamples, span: EmitterSpan, emitter: int) -> wp.array:
        """Logarithm of the transmittance to an emitter, see :class:`BlockersOfKind`."""
        from warpshadow.stages.emitters.convex_transmittance import find_log_transmittance_of_parts

        skipped = self._number_of(group.body), self._number_of(emitter)
        parts = self.placed_parts, self.blockers
        return find_log_transmittance_of_parts(group.points, group.normals, samples, span, *parts, skipped)


class GroupBlockers(NamedTuple):
    """Blockers around a group of receivers, by kind; None where none of a kind blocks their light.

    A body blocks light of receivers that lie on it by ``self_blocker`` alone, or by its spheres.
    """

    spheres: GroupSpheres | None = None
    planes: GroupPlanes | None = None
    convex_parts: GroupConvexParts | None = None
    self_blocker: GroupConvexParts | SelfLookup | None = None  # of the receivers' bodies: parts of one, or rays
    body_sides: BodySides | None = None  # on which side of planes these lie; None where they are not known

    @property
    def kinds(self) -> dict[str, BlockersOfKind]:
        """The kinds that block light of others than their own body, by name."""
        kinds = {"spheres": self.spheres, "planes": self.planes, "parts": self.convex_parts}
        return {name: blockers for name, blockers in kinds.items() if blockers is not None}

    @property
    def covering(self) -> list[CoveringBlockers]:
        """Of these the kinds that cover cells."""
        return [blockers for blockers in (self.planes, self.convex_parts) if blockers is not None]

    @property
    def placed_arrays(self) -> dict[str, wp.array]:
        """Where the blockers of all kinds are, by name."""
        placed = [blockers.placed_arrays for blockers in self if blockers is not None]
        return {name: array for arrays in placed for name, array in arrays.items()}


@dataclass(frozen=True, eq=False)
class Group:
    """Receivers that the same launches light.

    Arrays have an item for each receiver, [batch, receiver]: :meth:`portions` cuts them. Blockers hold for all.
    """

    points: wp.array  # vec3
    normals: wp.array  # vec3
    blockers: GroupBlockers
    footprints: wp.array | None = None  # vec3, areas for which receivers stand; None for points
    spans: tuple[Span, ...] = ()  # the receivers by body; () where their bodies are not known
    first: int = 0  # number of the first receiver among all that are not on static bodies
    nearest_blockers: NearestBlockers | None = None  # of each receiver; None where they are not patch samples
    body: int | None = None  # the only one on which receivers lie; None where there may be several
    is_glossy: bool = False  # whether the bodies shine
    cached_rows: CachedRows | None = None  # of static bodies, which block the receivers' light, too
    find_probe_weights: Callable[[int, tuple[Span, ...]], ProbeWeights] | None = None  # of receivers from a first on

    @functools.cached_property
    def probe_weights(self) -> ProbeWeights:
        """Probes of their bodies around the receivers, and the weights of these."""
        assert self.find_probe_weights is not None
        return self.find_probe_weights(self.first, self.spans)

    @property
    def horizon_normals(self) -> wp.array | None:
        """Normals, below whose horizons nothing is lit; None for cached cells, whose light may be above it."""
        return self.normals if self.cached_rows is None else None

    def looked_up_transmittance(self) -> wp.array | None:
        """Transmittance past the receivers' own bodies, [batch, receiver, cell]; None where none is looked up."""
        lookup = self.blockers.self_blocker
        if not isinstance(lookup, SelfVisibilityLookup):
            return None
        return lookup.transmittance(self.normals, self.probe_weights, self.spans)

    @functools.cached_property
    def fronts_of_planes(self) -> PlaneFronts:
        """As :meth:`find_fronts`, of the planes around the group."""
        planes = self.blockers.planes
        assert planes is not None
        return self.find_fronts(planes.frames, planes.blockers, planes.self_plane)

    def find_fronts(self, frames: wp.array, planes: PlaneBlockers, self_plane: int | None) -> PlaneFronts:
        """Which part of each plane's front the receivers see, and the receivers lifted off planes they lie in."""
        body_sides = self.blockers.body_sides if self.spans else None
        sides = None if body_sides is None else body_sides.sides_of(frames, planes)
        arguments = self.points, self.normals, sides, self.nearest_blockers, frames, planes
        return find_fronts(*arguments, spans=self.spans, self_plane=self_plane)

    def portions(self) -> Iterator[Group]:
        """Portions of the receivers; all of them at once for a gradient, and where they have cached rows.

        All arrays of a portion have the same batch, if anything blocks.
        """
        placed_arrays, size, group = self.blockers.placed_arrays, self.points.shape[1], self
        if placed_arrays:
            count = common_batch({"points": self.points, **placed_arrays})
            spheres = self.blockers.spheres and self.blockers.spheres.expanded(count)
            blockers = self.blockers._replace(spheres=spheres)
            group = self._with_arrays(lambda array: expand(array, count), blockers=blockers)
        is_whole = self.cached_rows is not None or size <= RECEIVERS_AT_ONCE
        if is_whole or any_requires_grad([self.points, self.normals, *placed_arrays.values()]):
            yield group
            return
        for spans in _cut_spans(self.spans or (Span(-1, 0, size),)):
            yield group._cut(spans)

    def _cut(self, spans: tuple[Span, ...]) -> Group:
        """Cut consecutive receivers out."""
        first, end = spans[0].first, spans[-1].end
        return self._with_arrays(
            lambda array: cut(array, first, end),
            spans=relative_spans(spans) if self.spans else (),
            first=self.first + first,
            nearest_blockers=None if self.nearest_blockers is None else self.nearest_blockers.cut(slice(first, end)),
        )

    def _with_arrays(self, function: Callable[[wp.array], wp.array], **others: Any) -> Group:
        """Apply a function to each array, and replace other values."""
        values = {item.name: getattr(self, item.name) for item in fields(self)}
        arrays = {name: function(value) for name, value in values.items() if isinstance(value, wp.array)}
        return replace(self, **arrays, **others)


def _cut_spans(spans: Iterable[Span]) -> Iterator[tuple[Span, ...]]:
    """Cut spans into portions of at most :data:`RECEIVERS_AT_ONCE` receivers."""
    portion: list[Span] = []
    for body, begin, end in spans:
        for first in range(begin, end, RECEIVERS_AT_ONCE):
            piece = Span(body, first, min(first + RECEIVERS_AT_ONCE, end))
            if portion and piece.end - portion[0].first > RECEIVERS_AT_ONCE:
                yield tuple(portion)
                portion = []
            portion.append(piece)
    yield tuple(portion)
