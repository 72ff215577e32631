"""Shading with sphere blockers: the base of such methods, and the node of the receivers' visibility."""

import abc
import functools
import operator
from collections.abc import Callable, Iterator, Mapping
from typing import Any, Generic, NamedTuple, Protocol, TypeVar

import warp as wp

from warpshadow.assets.known_light import KnownLight
from warpshadow.assets.light import EnvironmentMap
from warpshadow.device.constants import IdentityKey
from warpshadow.device.progress import progress_bar
from warpshadow.pipeline.bodies.blockers import BlockerKinds, Blockers
from warpshadow.pipeline.bodies.geometry import Geometry
from warpshadow.pipeline.bodies.reflectance import Materials
from warpshadow.pipeline.bodies.self_visibility import SelfLookup
from warpshadow.pipeline.node import Call, ExplainRow, Input, Node, detached, identity
from warpshadow.pipeline.receivers.groups import Group, find_portions
from warpshadow.pipeline.receivers.shading_context import AdaptiveSurfaces, ShadingContext, receiver_text
from warpshadow.pipeline.receivers.static import StaticBodies, VertexRows
from warpshadow.pipeline.shading.found_visibility import CellVisibility, HarmonicVisibility
from warpshadow.pipeline.shading.light_input import LightInput
from warpshadow.pipeline.shading.method import Method
from warpshadow.pipeline.shading.scene_blockers import SceneBlockers
from warpshadow.pipeline.shading.transfers import LARGEST_COEFFICIENT, change_basis, join_portions
from warpshadow.stages.light.shading import shade
from warpshadow.stages.receivers.find import Receivers
from warpshadow.stages.receivers.quadtree import Quadtree

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
    """A method in which spheres, planes or convex parts stand in for bodies: visibility, transfer vectors, shading.

    Its two types are those of light and of visibility in its basis. A method gives these members, besides those of
    :class:`.Method` for bodies that shine:

    | member | needed for | default |
    | --- | --- | --- |
    | :attr:`free_basis` | free light | – |
    | :meth:`project_light` | known light | – |
    | :meth:`find_visibility`, :meth:`transfer` | any light | – |
    | :meth:`coefficient_count` | ``explain`` | – |
    | :meth:`self_lookups` | self-visibility by rays | – |
    | :meth:`cached_rows` | static bodies among moving ones | – |
    | :meth:`shade_transfer` | known light | a sum over the coefficients |
    | :meth:`shade_transmittance` | known light, where it is faster than transfer vectors | transfer vectors |
    | :meth:`find_visibility_past_planes` | planes, if :attr:`scene_blockers` has any | refused |
    | :meth:`free_basis_of_shell` | light from a shell that a call gives | refused |
    | :attr:`scene_blockers` | planes and convex parts | spheres, and self-visibility by rays |
    | :attr:`emitter_cells` | lamps, past the self-visibility of receivers | None: without it |
    | :meth:`share_of_sharpest_light` | adaptive receivers | None, as where nothing blocks |

    :class:`VisibilityNode` calls find_visibility, then find_visibility_past_planes; :class:`TransferNode`
    goes on with transfer, and :class:`ShadingNode` with that and shade_transfer, or with shade_transmittance.

    Attributes:
        free_basis: The basis in which the method projects any free light, of the scene's shell if it has one.
        why_no_shadows: Why the method has no shadows, in words; empty if it has.
        adds_cached_rows: Whether visibility combines cached rows with moving blockers.
        shades_without_transfer: Whether known light is summed from transmittance directly, :meth:`shade_transmittance`.
            No transfer vectors are then stored, but for cached rows and light from a shell.
    """

    free_basis: Projected
    why_no_shadows = ""
    adds_cached_rows = False
    shades_without_transfer = False

    @property
    def emitter_cells(self) -> Projected | None:
        """Even light in the cells in which self-visibility towards emitters is looked up; None where nothing is."""
        return None

    @functools.cached_property
    def scene_blockers(self) -> SceneBlockers:
        """The blockers that the bodies are."""
        return SceneBlockers(self.merged_scene, progress=self.progress)

    def blocker_kinds(self, geometry: Geometry | None, rotations: Input | None) -> BlockerKinds:
        """Choose the kind of blocker that each body of a geometry is; the scene's geometry by default."""
        return self.scene_blockers.kinds(geometry, rotations)

    def blocker_notes(self, blocker_kinds: BlockerKinds) -> list[str]:
        """Describe how each body blocks light, and why, a line each."""
        return [] if self.why_no_shadows else self.scene_blockers.notes(blocker_kinds)

    def find_visibility_past_planes(
        self, group: Group, visibility: FoundVisibility, projected_light: Projected
    ) -> FoundVisibility:
        """Visibility of a group past the flat bodies around it, given its visibility past all other blockers."""
        raise NotImplementedError

    @abc.abstractmethod
    def project_light(self, light: KnownLight, shell: wp.array | None = None) -> Projected:
        """Project known light for the method: its coefficients, and the cells or bands they belong to.

        Args:
            light: The light.
            shell: Center and radius of the sphere that sends it, vec4 of shape [batch]; None for light infinitely far.
        Differentiable: shell.
        """

    def free_basis_of_shell(self, shell: wp.array) -> Projected:
        """The basis in which the method projects free light of another shell than the scene's."""
        raise NotImplementedError

    @functools.cached_property
    def _projected_scene_light(self) -> Node:
        return Node("", self.project_light, self.light, self.shell)

    def projected_light(self, points: ShadingContext, light: LightInput) -> Node:
        """Node of light on points, projected for the method; the same for the same known light."""
        if light.is_free:
            return Node("", self._with_free_light, light, self.visibility_basis(points, light))
        if light is self.light:
            return self._projected_scene_light
        make = functools.partial(Node, "", self.project_light, light, self.shell_of(light))
        return points.cached_with_neighbors("projected", light, make)

    def visibility_basis(self, points: ShadingContext, light: LightInput) -> Node | Projected:
        """The light by which visibility is found, projected: known light, or any free light of the same shell."""
        return self.free_basis_of(points, light.shell) if light.is_free else self.projected_light(points, light)

    def free_basis_of(self, points: ShadingContext, shell: Input | None) -> Node | Projected:
        """The basis in which the method projects free light, or a node of it, the same for the same shell."""
        if shell is None:
            return self.free_basis
        make = functools.partial(Node, "", self.free_basis_of_shell, shell)
        return points.cached_with_neighbors("free basis", shell, make)

    def _with_free_light(self, light: wp.array, free_basis: Projected) -> Projected:
        """Project given free light for the method. Differentiable: light."""
        return free_basis.with_coefficients(change_basis(light, self.native_from_basis))

    @abc.abstractmethod
    def coefficient_count(self, light: Input | None) -> int:
        """Number of light coefficients that shading uses; all of them where the light is None, not known yet."""

    @abc.abstractmethod
    def self_lookups(
        self, bodies: tuple[int, ...], rotations: wp.array, projected_light: Projected
    ) -> Mapping[int, SelfLookup]:
        """Self-visibility of receivers of some bodies, by body. Differentiable: rotations."""

    @abc.abstractmethod
    def find_visibility(self, group: Group, projected_light: Projected) -> FoundVisibility:
        """Visibility, or transmittance, past a group's spheres, convex parts and its own body."""

    @abc.abstractmethod
    def transfer(self, visibility: FoundVisibility, group: Group, projected_light: Projected) -> wp.array:
        """Transfer vectors of a group."""

    def shade_transfer(self, transfer: wp.array, group: Group, projected_light: Projected) -> wp.array:
        """Shading of a group in known light, given its transfer vectors."""
        return shade(transfer, projected_light.coefficients, maximum=LARGEST_COEFFICIENT)

    def shade_transmittance(self, visibility: FoundVisibility, group: Group, projected_light: Projected) -> wp.array:
        """Shading of a group in known light, given its visibility."""
        transfer = self.transfer(visibility, group, projected_light)
        return self.shade_transfer(transfer, group, projected_light)

    def find_squares(self, blocker_kinds: BlockerKinds, surfaces: AdaptiveSurfaces) -> Quadtree:
        """Find the squares in which samples of adaptive bodies interpolate."""
        from warpshadow.pipeline.receivers.adaptive import find_squares

        place = functools.partial(self.scene_blockers.place_blockers, blocker_kinds)
        return find_squares(place, self.share_of_sharpest_light, surfaces)

    def share_of_sharpest_light(self, group: Group) -> wp.array | None:
        """Share of a group's unblocked light that comes from the cells with the sharpest shadows.

        Returns:
            Shape [batch, receiver], the brightest cells in place of sharp ones if none is; None where nothing blocks.
        """
        return None

    @abc.abstractmethod
    def cached_rows(self, static_bodies: StaticBodies, light: Input | None, blocker_kinds: BlockerKinds) -> VertexRows:
        """Rows of transmittance past static bodies, for known light or for any."""

    def emitted_light(self, points: ShadingContext, materials: Materials) -> Node:
        """Direct light of emitters on points, by the same blockers."""
        from warpshadow.pipeline.shading.emitted_light import find_emitted_light

        return self._sum_over_emitters("light of emitters", find_emitted_light, points, materials)

    def highlights(self, points: ShadingContext, materials: Materials, roughness: Node, cameras: Input) -> Node:
        """Direct light of emitters in the lobes of points, by the same blockers."""
        from warpshadow.pipeline.shading.emitted_light import find_highlights

        return self._sum_over_emitters("highlights", find_highlights, points, materials, roughness, cameras)

    def _sum_over_emitters(
        self, name: str, find: Callable[..., Any], points: ShadingContext, materials: Materials, *others: Node | Input
    ) -> Node:
        emitters, weak_points = self.emitters, points.weak_reference
        portions_of = _find_portions_of(points, by_body=True)

        def find_in_portions(
            receivers: Receivers, blockers: Blockers, self_lookups: Mapping[int, SelfLookup] | None, *arrays: Any
        ) -> Any:
            portions = portions_of(receivers, blockers, self_lookups)
            return find(emitters.samples, emitters.self_visibility, portions, blockers, *arrays)

        def lookups() -> Node:
            if self.emitter_cells is None:
                return Node("", None)
            return _self_visibility(self, points.blocker_kinds, self.emitter_cells)

        return Node(
            name,
            find_in_portions,
            points.receivers_node,
            blockers_node(self, points),
            points.cached_with_neighbors("self-visibility towards emitters", None, lookups),
            self.emitters.samples_node(points),
            self.emitters.radiance(materials),
            *others,
            items=lambda: f"{receiver_text(weak_points)} × {emitters.samples.first[-1]} samples",
        )

    def known_shading(self, points: ShadingContext, light: LightInput) -> Node:
        """Direct known light on points."""
        return ShadingNode(self, points, self.projected_light(points, light), light)

    def openness(self, points: ShadingContext) -> Node:
        """Light that points reflect as white surfaces under an even sky of 1, vec3 of shape [batch, receiver]."""
        sky = LightInput(EnvironmentMap.constant(1.0))
        return ShadingNode(self, points, Node("", self.project_light, sky), sky, suffix=" in an even sky")

    def transfers(self, points: ShadingContext, shell: Input | None) -> Node:
        """Transfer vectors of points: to the native basis if they require a gradient, else to :attr:`basis`.

        NumPy, which has no gradient, multiplies them by the matrix between both; with one, :meth:`_free_shading`
        converts the light instead.
        """
        matrix, visibility_light = self.native_from_basis, self.free_basis_of(points, shell)
        transfers = TransferNode(self, points, visibility_light, None, caches=matrix is None)
        if matrix is None or transfers.requires_grad:
            return transfers

        def to_basis(native: list[wp.array]) -> list[wp.array]:
            return [wp.array(item.numpy() @ matrix, dtype=wp.float32, device=item.device) for item in native]

        return Node("", to_basis, transfers)


class LitPortion(NamedTuple):
    """A portion of receivers, and the results of its steps."""

    group: Group
    visibility: CellVisibility | HarmonicVisibility
    spheres: tuple[wp.array, wp.array]  # centers and radii of all spheres
    result: Any = None  # of the step after visibility: transfer vectors, or shading


class VisibilityNode(Node):
    """Visibility of receivers, found group by group and portion by portion; classes below add steps.

    Each step is a function of the method. The value is a list of the results of all portions. Without a gradient,
    known light is shaded portion by portion, and each portion's transfer vectors are dropped after it. They are kept
    for free light, and where bounces reuse them. Receivers with cached rows are one portion.

    Args:
        method: How light is blocked.
        points: The receivers.
        projected_light: The light projected for the method.
        light: Known or free light; None where it is not given yet.
        caches: As for :class:`Node`.
        suffix: Ends the names of its stages, such as " of patch samples"; by default the suffix of the points.
        result_of: Result of a portion; by default the last step's.
        join: Makes the value of the list of these; by default the list itself, of shading one array.
    """

    steps: tuple[str, ...] = ("visibility", "planes")
    """Its steps, each a row of ``explain``."""
    join: Callable[[list[Any]], Any] = staticmethod(identity)

    def __init__(
        self,
        method: SphereMethod,
        points: ShadingContext,
        projected_light: Node | ProjectedLight,
        light: Input | None,
        *,
        caches: bool = True,
        suffix: str | None = None,
        result_of: Callable[[LitPortion], Any] = operator.attrgetter("result"),
        join: Callable[[list[Any]], Any] | None = None,
    ):
        self.method, self._portions_of = method, _find_portions_of(points)
        self._result_of, self._join = result_of, self.join if join is None else join
        self._progress, weak_points = method.progress and light is not None, points.weak_reference
        suffix, planes = points.suffix if suffix is None else suffix, points.blocker_kinds.planes
        item_text = functools.partial(receiver_text, weak_points)
        rows = {
            "visibility": ExplainRow(
                f"visibility{suffix}",
                lambda: method.scene_blockers.pairs_with(weak_points),
                lambda: _why_unblocked(method, weak_points),
            ),
            "planes": ExplainRow(
                f"planes{suffix}",
                lambda: f"{item_text()} × {len(planes)} flat {'body' if len(planes) == 1 else 'bodies'}",
                "" if planes else "no flat body casts shadows by its plane",
            ),
            "transfer": ExplainRow(
                f"transfer{suffix}",
                lambda: f"{item_text()} × {method.coefficient_count(light)} coefficients",
                "" if self.needs_transfer else "shading takes transmittance at once",
            ),
            "shading": ExplainRow(f"shading{suffix}", item_text),
        }
        self._rows = {step: rows[step] for step in self.steps}
        super().__init__(
            "",
            None,
            points.receivers_node,
            blockers_node(method, points),
            projected_light,
            self_visibility_node(method, points, projected_light),
            _static_shadows_node(method, points, light),
            None if points.static_bodies is None else points.static_bodies.normals,
            rows=tuple(self._rows.values()),
            caches=caches,
        )

    @property
    def needs_transfer(self) -> bool:
        """Whether transfer vectors are found."""
        return "transfer" in self.steps

    def compute(self, call: Call) -> Any:
        """Find it for all portions."""
        return self._join(list(self.portions(call)))

    def portions(self, call: Call) -> Iterator[Any]:
        """Find it for one portion after another."""
        receivers, blockers, projected_light, self_lookups, *of_static_bodies = self.values(call)
        total = len(receivers.static_vertices) + receivers.points.shape[1]
        with progress_bar(total, "shading", "receiver", shows=self._progress) as bar:
            for group in self._portions_of(receivers, blockers, self_lookups, *of_static_bodies):
                portion = LitPortion(group, self._find_visibility(call, group, projected_light), blockers.spheres)
                yield self._result_of(self.add_step(call, portion, projected_light))
                bar.update(group.points.shape[1])

    def _find_visibility(
        self, call: Call, group: Group, projected_light: ProjectedLight
    ) -> CellVisibility | HarmonicVisibility:
        with self.timed(call, self._rows["visibility"]):
            visibility: CellVisibility | HarmonicVisibility = self.method.find_visibility(group, projected_light)
        if group.blockers.planes is not None:
            with self.timed(call, self._rows["planes"]):
                visibility = self.method.find_visibility_past_planes(group, visibility, projected_light)
        return visibility

    def add_step(self, call: Call, portion: LitPortion, projected_light: ProjectedLight) -> LitPortion:
        """The portion with the result of the steps after visibility; none here."""
        return portion


class TransferNode(VisibilityNode):
    """Transfer vectors of receivers."""

    steps = (*VisibilityNode.steps, "transfer")

    def add_step(self, call: Call, portion: LitPortion, projected_light: ProjectedLight) -> LitPortion:
        """The portion with its transfer vectors, if they are needed."""
        if not self.needs_transfer:
            return portion
        with self.timed(call, self._rows["transfer"]):
            return portion._replace(result=self.method.transfer(portion.visibility, portion.group, projected_light))


class ShadingNode(TransferNode):
    """Shading of receivers, vec3 of shape [batch, receiver]."""

    steps = (*TransferNode.steps, "shading")
    join = staticmethod(join_portions)

    @property
    def needs_transfer(self) -> bool:
        """Whether the method shades by transfer vectors."""
        return not self.method.shades_without_transfer

    def add_step(self, call: Call, portion: LitPortion, projected_light: ProjectedLight) -> LitPortion:
        """The portion with its shading."""
        transfer = super().add_step(call, portion, projected_light).result
        with self.timed(call, self._rows["shading"]):
            result = (
                self.method.shade_transmittance(portion.visibility, portion.group, projected_light)
                if transfer is None
                else self.method.shade_transfer(transfer, portion.group, projected_light)
            )
        return portion._replace(result=result)


def _find_portions_of(points: ShadingContext, *, by_body: bool = False) -> Callable[..., Iterator[Group]]:
    """Make :func:`find_portions` for the receivers of points, without a reference to these."""
    return functools.partial(
        find_portions, by_body=by_body, static_bodies=points.static_bodies, nearest_spheres=points.nearest_spheres
    )


def _why_unblocked(method: SphereMethod, points: ShadingContext) -> str:
    """Reason why no visibility is computed; empty if it is."""
    if method.why_no_shadows:
        return method.why_no_shadows
    blockers, kinds, static_bodies = method.scene_blockers, points.blocker_kinds, points.static_bodies
    if not blockers.has_any(kinds):
        return f"no body {'but flat ones ' if kinds.planes else ''}has blockers"
    moving, static, _ = points.counts()
    blocks_static = static_bodies and (method.adds_cached_rows or blockers.has_any(kinds, static_bodies.moving))
    if moving or (static and blocks_static):
        return ""
    return "no moving body has blockers" if static else "nothing is seen"


def blockers_node(method: SphereMethod, points: ShadingContext) -> Node:
    """Node of the blockers around points, where they are in the world."""
    place = functools.partial(method.scene_blockers.place_blockers, points.blocker_kinds)
    return points.cached_with_neighbors("blockers", None, lambda: Node("", place, points.vertices, points.spheres))


def self_visibility_node(method: SphereMethod, points: ShadingContext, projected_light: Node | ProjectedLight) -> Node:
    """Node of the receivers' self-visibility lookups, by body; the same for any receivers among the same bodies."""
    make = functools.partial(_self_visibility, method, points.blocker_kinds, projected_light)
    return points.cached_with_neighbors("self-visibility", IdentityKey(projected_light), make)


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


def _static_shadows_node(method: SphereMethod, points: ShadingContext, light: Input | None) -> Node:
    """Node of cached transmittance past static bodies; its value is None if there are none."""
    static_bodies, weak_points = points.static_bodies, points.weak_reference
    if static_bodies is None or not static_bodies.spheres[1].shape[1]:
        light_bounces = bool(method.merged_scene.scene.bounces)
        why = "light bounces: nothing of static bodies is cached" if light_bounces else "no static body has blockers"
        return Node("static shadows", None, idle=why)
    rows = method.cached_rows(static_bodies, light, points.blocker_kinds)

    def missing() -> int:
        receivers = weak_points.receivers_node.value_if_known(weak_points.call)
        return rows.missing(None if receivers is None else receivers.static_vertices)

    return Node(
        "static shadows",
        rows.of_receivers,
        detached(points.receivers_node),
        static_bodies.normals,
        items=lambda: f"up to {missing():,} vertices not seen before",
        idle=lambda: method.why_no_shadows or ("" if missing() else "cached: static bodies are the same"),
        caches=False,
    )
