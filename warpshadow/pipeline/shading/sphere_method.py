"""Shading with sphere blockers: the base of such methods, and the node of the receivers' visibility."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from typing import Any, Generic, Protocol, TypeVar

import numpy as np
import warp as wp

from warpshadow.assets.harmonic_light import KnownLight
from warpshadow.assets.light import EnvironmentMap
from warpshadow.device.progress import progress_bar
from warpshadow.pipeline.bodies.geometry import Geometry
from warpshadow.pipeline.bodies.reflectance import Materials
from warpshadow.pipeline.node import Call, Input, Node, NodeStage, detached
from warpshadow.pipeline.receivers.groups import Blockers, CellVisibility, Group, HarmonicVisibility, find_groups
from warpshadow.pipeline.receivers.lit_points import BlockerKinds, LitPoints, receiver_text
from warpshadow.pipeline.receivers.static import StaticBodies, VertexRows
from warpshadow.pipeline.shading.method import LightInput, Method
from warpshadow.pipeline.shading.scene_blockers import SceneBlockers
from warpshadow.pipeline.shading.transfers import LARGEST_COEFFICIENT, change_basis, joined
from warpshadow.stages.quadtree import Quadtree
from warpshadow.stages.rasterization import Fragments
from warpshadow.stages.receivers import Receivers
from warpshadow.stages.shading import shade

Projected = TypeVar("Projected", bound="ProjectedLight")
FoundVisibility = TypeVar("FoundVisibility", CellVisibility, HarmonicVisibility)


class ProjectedLight(Protocol):
    """Light in the basis in which a method finds visibility: cells of directions, or bands of spherical harmonics.

    Without coefficients it is the basis alone, by which visibility is found for any free light.
    """

    @property
    def coefficients(self) -> wp.array | None:
        """Of known or given light, vec3 of shape [batch, coefficient]; of light from a shell, those of its patches."""

    def with_coefficients(self: Projected, coefficients: wp.array) -> Projected:
        """Light of the same basis."""


class SphereMethod(Method, Generic[Projected, FoundVisibility]):
    """A method in which spheres stand in for the bodies: visibility, transfer vectors, and shading.

    Its two types say in which basis it has light, and visibility.

    Attributes:
        free_projection: The basis in which the method projects any free light, of the scene's shell if it has one.
        why_no_shadows: Why the method has no shadows, in words; empty if it has.
        joins_cached: Whether visibility combines cached rows with moving blockers.
        shades_transmittance: Whether known light is summed from transmittance at once (:meth:`shade_transmittance`);
            transfer vectors are then made only with cached rows, and for light from a shell.
    """

    free_projection: Projected
    why_no_shadows = ""
    joins_cached = False
    shades_transmittance = False
    has_proxies = True

    @property
    def emitter_projection(self) -> Projected | None:
        """Even light in the cells in which self-visibility towards emitters is looked up; None where nothing is."""
        return None

    @functools.cached_property
    def scene_blockers(self) -> SceneBlockers:
        """The blockers that the bodies are."""
        return SceneBlockers(self.merged_scene, self.samples_receive(), progress=self.progress)

    def blocker_kinds(self, geometry: Geometry | None, rotations: Input | None) -> BlockerKinds:
        """Choose the kind of blocker that each body of a geometry is; the scene's geometry by default."""
        return self.scene_blockers.kinds(geometry, rotations)

    def find_visibility_past_planes(
        self, group: Group, visibility: FoundVisibility, projected_light: Projected
    ) -> FoundVisibility:
        """Visibility of a group past the flat bodies around it, given its visibility past all other blockers."""
        raise NotImplementedError

    def project_light(self, light: KnownLight, shell: wp.array | None = None) -> Projected:
        """Project known light for the method: its coefficients, and the cells or bands they belong to.

        Args:
            light: The light.
            shell: Center and radius of the sphere that sends it, vec4 of shape [batch]; None for light infinitely far.
        Differentiable: shell.
        """
        raise NotImplementedError

    def project_free_light(self, shell: wp.array) -> Projected:
        """The basis in which the method projects free light of another shell than the scene's."""
        raise NotImplementedError

    @functools.cached_property
    def _projected_from_scene(self) -> Node:
        return Node("", self.project_light, self.light, self.shell)

    def projected(self, points: LitPoints, light: LightInput) -> Node:
        """Node of light on points, projected for the method; the same for the same known light."""
        if light.is_free:
            return Node("", self._projected_if_given, light, self.projection(points, light))
        if light is self.light:
            return self._projected_from_scene
        make = functools.partial(Node, "", self.project_light, light, self.shell_of(light))
        return points.cached_of_bodies("projected", light, make)

    def projection(self, points: LitPoints, light: LightInput) -> Node | Projected:
        """The light by which visibility is found, projected: known light, or any free light of the same shell."""
        return self.free_projection_of(points, light.shell) if light.is_free else self.projected(points, light)

    def free_projection_of(self, points: LitPoints, shell: Input | None) -> Node | Projected:
        """The basis in which the method projects free light, or a node of it, the same for the same shell."""
        if shell is None:
            return self.free_projection
        make = functools.partial(Node, "", self.project_free_light, shell)
        return points.cached_of_bodies("free projection", shell, make)

    def _projected_if_given(self, light: wp.array, free_projection: Projected) -> Projected:
        """Project given free light for the method. Differentiable: light."""
        return free_projection.with_coefficients(change_basis(light, self.native_from_basis))

    def coefficient_count(self, light: Input | None) -> int:
        """Number of light coefficients that shading uses; all of them where the light is None, not known yet."""
        raise NotImplementedError

    def self_lookups(self, bodies: tuple[int, ...], rotations: wp.array, projected_light: Projected) -> dict[int, Any]:
        """Self-visibility of receivers of some bodies, :attr:`.OwnBody.lookup` by body. Differentiable: rotations."""
        raise NotImplementedError

    def find_visibility(self, group: Group, projected_light: Projected) -> FoundVisibility:
        """Visibility, or transmittance, past a group's spheres, convex parts and its own body."""
        raise NotImplementedError

    def transfer(self, visibility: FoundVisibility, group: Group, projected_light: Projected) -> wp.array:
        """Transfer vectors of a group."""
        raise NotImplementedError

    def shade_transfer(self, transfer: wp.array, group: Group, projected_light: Projected) -> wp.array:
        """Shading of a group in known light."""
        return shade(transfer, projected_light.coefficients, maximum=LARGEST_COEFFICIENT)

    def shade_transmittance(self, visibility: FoundVisibility, group: Group, projected_light: Projected) -> wp.array:
        """Shading of a group in known light."""
        raise NotImplementedError

    def find_squares(
        self,
        blocker_kinds: BlockerKinds,
        positions: wp.array,
        normals: wp.array,
        fragments: Fragments,
        spheres: tuple[wp.array, wp.array],
        is_adaptive: np.ndarray,
        supersampling: int,
    ) -> Quadtree:
        """Find the squares in which samples of adaptive bodies interpolate."""
        from warpshadow.pipeline.receivers.adaptive import find_squares

        place = functools.partial(self.scene_blockers.placed, blocker_kinds)
        seen = positions, normals, fragments, spheres
        return find_squares(place, self.sharp_share, *seen, is_adaptive, supersampling)

    def sharp_share(self, group: Group) -> np.ndarray | None:
        """Share of a group's unblocked light that comes from the cells with the sharpest shadows.

        Returns:
            Shape [batch, receiver], the brightest cells in place of sharp ones if none is; None where nothing blocks.
        """
        return None

    def cached_rows(self, static_bodies: StaticBodies, light: Input | None, blocker_kinds: BlockerKinds) -> VertexRows:
        """Rows of transmittance past static bodies, for known light or for any."""
        raise NotImplementedError

    def emitted_light(self, points: LitPoints, materials: Materials) -> Node:
        """Direct light of emitters on points, by the same blockers."""
        from warpshadow.pipeline.shading.emitters import find_emitted_light

        return self._sum_over_emitters("light of emitters", find_emitted_light, points, materials)

    def highlights(self, points: LitPoints, materials: Materials, roughness: Node, cameras: Input) -> Node:
        """Direct light of emitters in the lobes of points, by the same blockers."""
        from warpshadow.pipeline.shading.emitters import find_highlights

        return self._sum_over_emitters("highlights", find_highlights, points, materials, roughness, cameras)

    def _sum_over_emitters(
        self, name: str, find: Callable[..., Any], points: LitPoints, materials: Materials, *others: Node | Input
    ) -> Node:
        emitters, words = (self.emitters.samples, self.emitters.self_visibility), points.in_words
        bodies_and_spheres = points.static_bodies, points.nearest_spheres

        def find_in_groups(
            receivers: Receivers, blockers: Blockers, self_lookups: dict[int, Any] | None, *arrays: Any
        ) -> Any:
            groups = find_groups(*bodies_and_spheres, receivers, blockers, self_lookups, None, None)
            return find(*emitters, groups, blockers, *arrays)

        def lookups() -> Node:
            if self.emitter_projection is None:
                return Node("", None)
            return _self_visibility(self, points.blocker_kinds, self.emitter_projection)

        return Node(
            name,
            find_in_groups,
            points.receivers_node,
            placed_blockers(self, points),
            points.cached_of_bodies("self-visibility towards emitters", None, lookups),
            self.emitters.placed(points),
            self.emitters.radiance(materials),
            *others,
            items=lambda: f"{receiver_text(words)} × {emitters[0].first[-1]} samples",
        )

    def known_shading(self, points: LitPoints, light: LightInput) -> Node:
        """Direct known light on points."""
        return PortionedShading(self, points, self.projected(points, light), light, joined)

    def openness(self, points: LitPoints) -> Node:
        """Light that points reflect as white surfaces under an even sky of 1, vec3 of shape [batch, receiver]."""
        sky = LightInput(EnvironmentMap.constant(1.0))
        return PortionedShading(self, points, Node("", self.project_light, sky), sky, joined, suffix=" in an even sky")

    def transfers(self, points: LitPoints, shell: Input | None) -> Node:
        """Transfer vectors of points to :attr:`basis`; where they vary, to the method's native basis."""
        matrix, projection = self.native_from_basis, self.free_projection_of(points, shell)
        transfers = PortionedShading(self, points, projection, None, list, caches=matrix is None)
        if matrix is None or transfers.requires_grad:
            return transfers

        def to_basis(native: list[wp.array]) -> list[wp.array]:
            return [wp.array(item.numpy() @ matrix, dtype=wp.float32, device=item.device) for item in native]

        return Node("", to_basis, transfers)


class PortionedShading(Node):
    """Shading or transfer vectors of receivers, found group by group and portion by portion.

    Without a gradient, transfer vectors of all receivers are in memory at once only where they are the result: for free
    light, and in the visibility that bounces cache while colors vary. Receivers with cached rows are one portion.

    Args:
        points: The receivers.
        projected_light: The light projected for the method.
        light: Known or free light; None where it is not given yet: portions end with transfer vectors.
        finish: Combines the list of results of all portions.
        caches: As for :class:`Node`.
        suffix: Ends the names of its stages, such as " of patch samples"; by default the suffix of the points.
        is_shaded: Whether portions are shaded in known light; else they end with transfer vectors, too.
        stages: Further ones, as for :class:`Node`.
    """

    def __init__(
        self,
        method: SphereMethod,
        points: LitPoints,
        projected_light: Node | ProjectedLight,
        light: Input | None,
        finish: Callable[[list[wp.array]], Any],
        *,
        caches: bool = True,
        suffix: str | None = None,
        is_shaded: bool = True,
        stages: tuple[NodeStage, ...] = (),
    ):
        self.method, self._bodies_and_spheres = method, (points.static_bodies, points.nearest_spheres)
        self._finish, self._progress = finish, method.progress and light is not None
        receivers, words = points.receivers_node, points.in_words
        suffix = points.suffix if suffix is None else suffix
        item_text = functools.partial(receiver_text, words)
        self_visibility = self_visibility_node(method, points, projected_light)
        shadows = _static_shadows(method, points, light)
        planes = points.blocker_kinds.planes
        blockers = placed_blockers(method, points)
        self._is_shaded = light is not None and is_shaded
        self._is_transferred = not (self._is_shaded and method.shades_transmittance)
        self._visibility = NodeStage(
            f"visibility{suffix}",
            lambda: method.scene_blockers.pairs_with(words),
            lambda: _why_unblocked(method, words),
        )
        self._planes = NodeStage(
            f"planes{suffix}",
            lambda: f"{item_text()} × {len(planes)} flat {'body' if len(planes) == 1 else 'bodies'}",
            "" if planes else "spheres stand in for the bodies that cast shadows",
        )
        self._transfer = NodeStage(
            f"transfer{suffix}",
            lambda: f"{item_text()} × {method.coefficient_count(light)} coefficients",
            "" if self._is_transferred else "shading takes transmittance at once",
        )
        self._shading = NodeStage(f"shading{suffix}", item_text)
        own_stages = self._visibility, self._planes, self._transfer, self._shading
        static_normals = None if points.static_bodies is None else points.static_bodies.normals
        super().__init__(
            "",
            None,
            receivers,
            blockers,
            projected_light,
            self_visibility,
            shadows,
            static_normals,
            stages=(*(own_stages if self._is_shaded else own_stages[:3]), *stages),
            caches=caches,
        )

    def compute(self, call: Call) -> Any:
        """Find it for all portions."""
        return self._finish(list(self.portions(call)))

    def portions(self, call: Call) -> Iterator[Any]:
        """Find it for one portion after another."""
        receivers, blockers, projected_light, *cached = self.values(call)
        groups = find_groups(*self._bodies_and_spheres, receivers, blockers, *cached)
        total = len(receivers.on_static) + receivers.points.shape[1]
        with progress_bar(total, "shading", "receiver", shows=self._progress) as bar:
            for group in groups:
                for portion in group.portions():
                    yield self.find(call, portion, projected_light, blockers.spheres)
                    bar.update(portion.points.shape[1])

    def find(
        self, call: Call, portion: Group, projected_light: ProjectedLight, spheres: tuple[wp.array, wp.array]
    ) -> Any:
        """Compute a portion's visibility, given the projected light and all spheres."""
        return self.light(call, portion, self.find_visibility(call, portion, projected_light), projected_light)

    def find_visibility(self, call: Call, portion: Group, projected_light: ProjectedLight) -> Any:
        """Find the visibility of a portion, of the method's type."""
        with self.timed(call, self._visibility):
            visibility = self.method.find_visibility(portion, projected_light)
        if portion.planes is None:
            return visibility
        with self.timed(call, self._planes):
            return self.method.find_visibility_past_planes(portion, visibility, projected_light)

    def light(
        self,
        call: Call,
        portion: Group,
        visibility: CellVisibility | HarmonicVisibility,
        projected_light: ProjectedLight,
    ) -> wp.array:
        """Transfer vectors of a portion, or its shading."""
        if not self._is_transferred:
            with self.timed(call, self._shading):
                return self.method.shade_transmittance(visibility, portion, projected_light)
        with self.timed(call, self._transfer):
            transfer = self.method.transfer(visibility, portion, projected_light)
        if not self._is_shaded:
            return transfer
        with self.timed(call, self._shading):
            return self.method.shade_transfer(transfer, portion, projected_light)


def _why_unblocked(method: SphereMethod, points: LitPoints) -> str:
    """Reason why no visibility is computed; empty if it is."""
    if method.why_no_shadows:
        return method.why_no_shadows
    blockers, kinds, static_bodies = method.scene_blockers, points.blocker_kinds, points.static_bodies
    if not blockers.has_any(kinds):
        return f"no body {'but flat ones ' if kinds.planes else ''}has blockers"
    _, moving, static = points.counts()
    if moving or (static_bodies and static and (method.joins_cached or blockers.has_any(kinds, static_bodies.moving))):
        return ""
    return "no moving body has blockers" if static else "nothing is seen"


def placed_blockers(method: SphereMethod, points: LitPoints) -> Node:
    """Node of the blockers around points, where they are in the world."""
    place = functools.partial(method.scene_blockers.placed, points.blocker_kinds)
    return points.cached_of_bodies("blockers", None, lambda: Node("", place, points.vertices, points.spheres))


def self_visibility_node(method: SphereMethod, points: LitPoints, projected_light: Node | ProjectedLight) -> Node:
    """Node of the receivers' self-visibility lookups, by body; the same for any receivers among the same bodies."""
    make = functools.partial(_self_visibility, method, points.blocker_kinds, projected_light)
    return points.cached_of_bodies("self-visibility", id(projected_light), make)


def _self_visibility(method: SphereMethod, blocker_kinds: BlockerKinds, projected_light: Node | ProjectedLight) -> Node:
    bodies, rotations, blockers = blocker_kinds.self_traced, blocker_kinds.rotations, method.scene_blockers
    curved_bodies = [body for body in bodies if not method.merged_scene.is_flat[body]]
    if not curved_bodies or rotations is None:
        return Node("self-shadows", None, idle=lambda: blockers.why_none_is_traced(blocker_kinds))

    def state() -> str:
        missing = blockers.self_visibility.missing(bodies)
        known = f"{missing} to be traced, or read from the cache" if missing else "traced once, cached"
        return f"{len(curved_bodies)} {'body' if len(curved_bodies) == 1 else 'bodies'}: {known}"

    return Node("self-shadows", functools.partial(method.self_lookups, bodies), rotations, projected_light, items=state)


def _static_shadows(method: SphereMethod, points: LitPoints, light: Input | None) -> Node:
    """Node of cached transmittance past static bodies; its value is None if there are none."""
    static_bodies, words = points.static_bodies, points.in_words
    if static_bodies is None or not static_bodies.spheres[1].shape[1]:
        bouncing = bool(method.merged_scene.scene.bounces)
        why = "light bounces: nothing of static bodies is cached" if bouncing else "no static body has blockers"
        return Node("static shadows", None, idle=why)
    rows = method.cached_rows(static_bodies, light, points.blocker_kinds)

    def missing() -> int:
        receivers = words.receivers_node.value_if_known(words.call)
        return rows.missing(None if receivers is None else receivers.on_static)

    return Node(
        "static shadows",
        rows.of_receivers,
        detached(points.receivers_node),
        static_bodies.normals,
        items=lambda: f"up to {missing():,} vertices not seen before",
        idle=lambda: method.why_no_shadows or ("" if missing() else "cached: static bodies are the same"),
        caches=False,
    )
