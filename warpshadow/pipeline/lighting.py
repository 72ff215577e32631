"""Lighting: where light is evaluated, and the interface of visibility methods."""

from __future__ import annotations

import copy
import functools
from collections.abc import Callable, Hashable
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import numpy as np
import warp as wp

from warpshadow import check
from warpshadow.assets.basis import Basis, HarmonicBasis, conversion
from warpshadow.assets.harmonic_light import as_light
from warpshadow.assets.light import LIGHT, EnvironmentMap, check_coefficients
from warpshadow.device.batch import concatenate
from warpshadow.device.constants import constant
from warpshadow.pipeline.geometry import Geometry
from warpshadow.pipeline.merged_scene import MergedScene
from warpshadow.pipeline.node import Call, Input, Node
from warpshadow.pipeline.reflectance import Materials
from warpshadow.stages.gloss.prefilter import prefilter
from warpshadow.stages.normals import vertex_normals
from warpshadow.stages.receivers import Numbering, Receivers, number_receivers
from warpshadow.stages.shading import shade

if TYPE_CHECKING:
    from warpshadow.pipeline.static import StaticBodies

KnownLight = EnvironmentMap | np.ndarray
Light = KnownLight | wp.array
"""A map, SH coefficients [order², 3], or free coefficients in the renderer's basis, vec3 [batch, coefficient]."""

Cached = TypeVar("Cached")
Points = TypeVar("Points", bound="LitPoints")

LARGEST_COEFFICIENT = 1e3 * check.LARGEST
"""Light is larger in another basis than it was given in: 64 harmonics add up in a direction."""


class BlockerKinds(NamedTuple):
    """Which bodies block light as planes, convex parts or by traced self-visibility; spheres block the rest."""

    traced: tuple[int, ...] = ()  # bodies that block their own light as rays found, not by their spheres
    rotations: Input | None = None  # of all bodies, mat33 of shape [batch, body]; None where none is traced
    why_spheres: tuple[str, ...] = ()  # of each body, why it blocks its own light by spheres; empty for the traced
    planes: tuple[int, ...] = ()  # bodies that block all light as the planes in which they lie
    convex: tuple[int, ...] = ()  # traced ones that block the light of others by the convex parts that they consist of
    bulging: tuple[int, ...] = ()  # bodies out of which spheres bulge: they receive at vertices, for any choice


ONLY_SPHERES = BlockerKinds()  # all bodies block by their spheres


class LitPoints:
    """Points that are lit: the receivers of a view.

    Args:
        method: How their light is blocked.
        materials: Reflectance of the scene's bodies.
        vertices: Positions of all vertices.
        spheres: Centers and radii of the spheres.
        receivers: The points.
        call: Holds values of the points that may not be cached.
        static_bodies: Those among moving ones; None where any may move.
        normals: Node of the normals of all vertices, vec3 of shape [batch, vertex]; by default its own.
        blocker_kinds: Which bodies block light by something else than their spheres.
        is_scene_view: Whether bodies and points are where the scene and its camera have them, for good.
        blocker_of_point: Of points that send light, the number of the blocker nearest to the patch of each, among the
            spheres of bodies that are not flat, −1 for none: NumPy of shape [receiver].
    """

    def __init__(
        self,
        method: Method,
        materials: Materials,
        vertices: Input,
        spheres: Input,
        receivers: Node,
        call: Call,
        static_bodies: StaticBodies | None = None,
        normals: Node | None = None,
        blocker_kinds: BlockerKinds = ONLY_SPHERES,
        is_scene_view: bool = False,
        blocker_of_point: np.ndarray | None = None,
    ):
        self.blocker_kinds, self.is_scene_view, self.blocker_of_point = blocker_kinds, is_scene_view, blocker_of_point
        self.method, self.materials, self.merged_scene = method, materials, method.merged_scene
        self.vertices, self.spheres, self.receivers_node = vertices, spheres, receivers
        self.call, self.static_bodies = call, static_bodies
        self.normals = Node("", vertex_normals, vertices, method.merged_scene.faces) if normals is None else normals
        self._last_light: Input | None = None  # that was known, but for the scene's
        self._cached: dict[str, tuple[Hashable, Any]] = {}

    def cached(self, name: str, key: Hashable, make: Callable[[], Cached]) -> Cached:
        """A value for the points, such as a node, cached under a name while its inputs stay the same."""
        if name not in self._cached or self._cached[name][0] != key:
            self._cached[name] = key, make()
        return self._cached[name][1]

    def with_receivers(self: Points, receivers: Node) -> Points:
        """Other receivers, of which nothing is cached, among the same blockers, any of which may move."""
        points = copy.copy(self)
        points.receivers_node, points.static_bodies, points.is_scene_view = receivers, None, False
        points._cached, points._last_light = {}, None
        return points

    def preview(self: Points) -> Points:
        """The points with the values cached so far, which does not add its own to them."""
        points = copy.copy(self)
        points._cached = {
            name: (key, value.preview() if isinstance(value, LitPoints) else value)
            for name, (key, value) in self._cached.items()
        }
        return points

    @property
    def receivers(self) -> Receivers:
        """Where light is evaluated."""
        return self.receivers_node.value(self.call)

    def counts(self) -> tuple[str, int, int]:
        """How many receivers may move and how many are static; "up to " where they are not found yet."""
        receivers = self.receivers
        return "", receivers.points.size, len(receivers.on_static)

    def shading(self, light: Light | None, materials: Materials | None = None) -> Node:
        """Light reflected by the receivers as white surfaces, vec3 of shape [batch, receiver]; None: the scene's.

        Results for the scene's light and the last other known light are cached. Materials, by default the scene's,
        matter where light bounces.
        """
        check_light(light)
        if materials is None or not self.merged_scene.scene.bounces:
            materials = self.materials
        light_input = self.light_input(light)
        if light_input.is_free:
            return self.method.free_shading(self, light_input, materials)
        shade = functools.partial(self.method.known_shading, self, light_input, materials)
        if materials is not self.materials:
            return shade()
        return self.cached(
            "shading of the scene" if light_input is self.method.light else "shading", light_input, shade
        )

    def light_input(self, light: Light | None) -> Input:
        """The light as an input; the same for the same known light."""
        if light is None or light is self.method.light.value():
            return self.method.light
        if isinstance(light, wp.array):
            return Input("light", light, news="light is given")
        self._last_light = Input.renewed("light", light, self._last_light)
        return self._last_light

    @property
    def transfers(self) -> Node:
        """Transfer vectors of the receivers to the renderer's basis, [batch, receiver, coefficient] for each group."""
        return self.cached("transfers", None, lambda: self.method.transfers(self))


class Method:
    """How light is blocked: a method of visibility.

    Args:
        merged_scene: The bodies.
        native_basis: Basis in which the method computes light.
        basis: Basis of free light; None for the method's own.
    """

    lights_samples = False  # whether every sample is a receiver, overriding the bodies

    shares_directions = False
    """Whether all receivers look for light in the same directions, so that one is enough for a surface in a pixel."""

    lobe_samples = 32
    """Samples of a lobe of a body that shines. Light without shadows of an indoor map is 2.1% off with 32, 3.5% with 16
    (roughness 0.35)."""

    def __init__(self, merged_scene: MergedScene, native_basis: Basis, basis: Basis | None, *, progress: bool = False):
        self.merged_scene, self.native_basis, self.progress = merged_scene, native_basis, progress
        self.basis = native_basis if basis is None else basis
        self.visibility = merged_scene.scene.visibility
        self.light = Input("light", merged_scene.scene.light)
        self._numberings: dict[tuple[tuple[int, ...], ...], list[Numbering]] = {}
        self._can_receive: dict[tuple[int, ...], np.ndarray] = {}  # by the bodies out of which spheres bulge

    def blocker_kinds(self, geometry: Geometry | None, rotations: Input | None) -> BlockerKinds:
        """Choose the kind of blocker that each body of a geometry is; the scene's geometry by default.

        Args:
            rotations: Of its bodies; None where nobody knows on which body a receiver is.
        """
        return ONLY_SPHERES

    def samples_receive(self, blocker_kinds: BlockerKinds = ONLY_SPHERES) -> np.ndarray:
        """Bodies on which samples are receivers while bodies block in some ways, bool of shape [body]."""
        by_vertex = [body.receivers == "vertex" for body in self.merged_scene.scene.bodies]
        is_bulging = np.isin(np.arange(len(by_vertex)), blocker_kinds.bulging)
        return ~(np.array(by_vertex) | is_bulging) | self.lights_samples

    @functools.cached_property
    def is_adaptive(self) -> np.ndarray:
        """Flat bodies on which samples interpolate between receivers, bool of shape [body]."""
        adaptive = np.array([body.receivers == "adaptive" for body in self.merged_scene.scene.bodies])
        return adaptive & self.merged_scene.is_flat & (not self.lights_samples)

    def can_receive(self, blocker_kinds: BlockerKinds) -> np.ndarray:
        """Vertices that may be receivers, and vertices whose backs may be, bool of shape [2, vertex]."""
        key = blocker_kinds.bulging
        if key not in self._can_receive:
            body_of_vertex, receives = self.merged_scene.body_of_vertex, ~self.samples_receive(blocker_kinds)
            backs = (receives & self.merged_scene.is_two_sided)[body_of_vertex]
            self._can_receive[key] = np.stack([receives[body_of_vertex], backs])
        return self._can_receive[key]

    def separate_bodies(self, blocker_kinds: BlockerKinds) -> np.ndarray | None:
        """Number of each body whose receivers form a group, −1 for others, shape [body]; None where all share one."""
        bodies = np.arange(len(self.merged_scene.scene.bodies))
        if self.merged_scene.scene.bounces:
            return bodies
        separate = (*blocker_kinds.traced, *blocker_kinds.planes, *np.flatnonzero(self.merged_scene.is_glossy))
        return np.where(np.isin(bodies, separate), bodies, -1) if separate else None

    def numbering(self, blocker_kinds: BlockerKinds, has_backs: bool) -> Numbering:
        """Number all vertices, or all with their backs; the first call makes both, so that a capture finds them."""
        key = blocker_kinds.traced, blocker_kinds.planes, blocker_kinds.bulging
        if key not in self._numberings:
            faces, can_receive, separate_bodies = (
                self.merged_scene.faces,
                self.can_receive(blocker_kinds),
                self.separate_bodies(blocker_kinds),
            )
            bodies = None if separate_bodies is None else separate_bodies[self.merged_scene.body_of_vertex]
            sides = can_receive[:1], can_receive
            self._numberings[key] = [number_receivers(faces, item, bodies=bodies) for item in sides]
        return self._numberings[key][has_backs]

    def known_shading(self, points: LitPoints, light: Input, materials: Materials) -> Node:
        """Shading of points in known light, which bounces from the materials."""
        raise NotImplementedError

    def free_shading(self, points: LitPoints, light: Input, materials: Materials) -> Node:
        """Shading of points in free light, which is converted where the transfer vectors are not."""
        matrix = self.native_from_basis if points.transfers.requires_grad else None
        items = functools.partial(receiver_text, points)
        return Node("shading", functools.partial(_shade, matrix=matrix), points.transfers, light, items=items)

    @functools.cached_property
    def native_from_basis(self) -> np.ndarray | None:
        """Matrix from free light to the method's native basis; None if they are the same, or bands of it."""
        basis, native = self.basis, self.native_basis
        if isinstance(native, HarmonicBasis) and isinstance(basis, HarmonicBasis) and basis.order <= native.order:
            return None
        return conversion(basis, native)

    def transfers(self, points: LitPoints) -> Node:
        """Transfer vectors of points to :attr:`basis`, an array for each group."""
        raise NotImplementedError

    @functools.cached_property
    def _prefiltered_from_scene(self) -> Node:
        return Node("prefiltering", self._prefilter, self.light)

    def prefiltered(self, light: Input) -> Node:
        """Node of known light, prefiltered for bodies that shine, vec3 [1, texel]; the scene's is cached."""
        return self._prefiltered_from_scene if light is self.light else Node("prefiltering", self._prefilter, light)

    def _prefilter(self, light: KnownLight) -> wp.array:
        return wp.array(prefilter(map_of(light))[None], dtype=wp.vec3, device=self.merged_scene.device)

    def lobe_transmittance(self, points: LitPoints, directions: Node, light: Input) -> Node:
        """Transmittance towards the samples of lobes of points, float32 of shape [batch, receiver, sample].

        Args:
            points: Receivers on bodies that shine.
            directions: Node of the samples' directions, vec3 of shape [batch, receiver, sample].
            light: Known or free light, which says where shadows have to be sharp.

        Without shadows it is 1.
        """
        return Node("", lambda towards: wp.full(towards.shape, 1.0, wp.float32, device=towards.device), directions)

    def blocked_radiance(
        self, points: LitPoints, diffuse: Node, light: Input, view: LitPoints, choose: Callable[[Node], Node]
    ) -> Node:
        """Mean radiance of the blockers of points, where light bounces, vec3 of shape [batch, receiver].

        Args:
            points, light: As for :meth:`lobe_transmittance`.
            diffuse: Node of their shading.
            view: The receivers among which they are, which are shaded.
            choose: Makes a node of light on the view's receivers one of light on these.
        """
        raise NotImplementedError

    def openness(self, points: LitPoints) -> Node | None:
        """Light that points reflect as white surfaces under an even sky of 1; None where rays find it on average."""
        return None


def check_light(light: object) -> None:
    """Raise ValueError for a value that is neither light nor None."""
    expected = f"{LIGHT}, or free coefficients in renderer.basis as a tensor"
    check.instance("light", light, (EnvironmentMap, np.ndarray, wp.array, type(None)), expected)
    if isinstance(light, np.ndarray):
        check_coefficients("light", light)


def map_of(light: KnownLight) -> np.ndarray:
    """Radiance of known light as a map, shape [height, 2 height, 3]."""
    return as_light(light).radiance


def receiver_text(points: LitPoints, *, moving: bool = True, static: bool = True) -> str:
    """Number of receivers, in words."""
    up_to, moving_count, static_count = points.counts()
    return f"{up_to}{moving * moving_count + static * static_count:,} receivers"


def _shade(transfers: list[wp.array], light: wp.array, *, matrix: np.ndarray | None) -> wp.array:
    """Light the receivers of all groups, by light that a matrix converts. Differentiable: transfers, light."""
    maximum = check.LARGEST
    if matrix is not None:
        light, maximum = change_basis(light, matrix), LARGEST_COEFFICIENT
    return joined([shade(transfer, light, maximum=maximum) for transfer in transfers])


def change_basis(light: wp.array, matrix: np.ndarray | None) -> wp.array:
    """Coefficients of light in another basis, to which a matrix takes them, None for the same; differentiable in it."""
    return light if matrix is None else shade(constant(matrix[None], wp.float32, light.device), light)


def joined(portions: list[wp.array]) -> wp.array:
    """Receivers of portions one after another, of shape [batch, receiver]. Differentiable: portions."""
    return portions[0] if len(portions) == 1 else concatenate(portions, [portion.shape[1] for portion in portions])


def one_transfer(portions: list[wp.array]) -> wp.array:
    """Transfer vectors of all groups one after another, float32 of shape [batch, receiver, coefficient]."""
    if len(portions) == 1:
        return portions[0]
    rows = joined([portion.reshape((portion.shape[0], -1)) for portion in portions])
    return rows.reshape((rows.shape[0], -1, portions[0].shape[2]))
