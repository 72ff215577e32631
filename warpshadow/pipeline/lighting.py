"""Lighting: where light is evaluated, and what each method of visibility makes of it there."""

import functools
from collections.abc import Callable, Hashable, Iterable, Iterator
from typing import Any, NamedTuple, Protocol, TypeVar

import numpy as np
import warp as wp

from warpshadow import check
from warpshadow.assets.basis import Basis, HarmonicBasis, conversion
from warpshadow.assets.light import EnvironmentMap
from warpshadow.device.batch import common_batch, concatenate, cut, expand
from warpshadow.device.constants import constant
from warpshadow.device.launch import varies
from warpshadow.device.progress import progress_bar
from warpshadow.maths import sh
from warpshadow.pipeline.assembly import Assembly, Geometry
from warpshadow.pipeline.flats import FlatsAround, SceneFlats
from warpshadow.pipeline.node import Call, Fixed, Node, Source
from warpshadow.pipeline.own_shadows import BY_SPHERES, Blocking, OwnLobes, OwnLookup, OwnShadows
from warpshadow.pipeline.reflectance import Materials
from warpshadow.pipeline.static import Rows, Static
from warpshadow.stages.kept_cells import KeptRows
from warpshadow.stages.normals import vertex_normals
from warpshadow.stages.own_shadows.sites import Places
from warpshadow.stages.receivers import Numbering, Receivers, number_receivers
from warpshadow.stages.shading import shade

KnownLight = EnvironmentMap | np.ndarray
Light = KnownLight | wp.array
"""A map, SH coefficients [order², 3], or free coefficients in the renderer's basis, vec3 [batch, coefficient]."""

Kept = TypeVar("Kept")

PART = 1 << 13
"""Receivers that are lit at once where no gradient is asked for."""

LARGEST_COEFFICIENT = 1e3 * check.LARGEST
"""Light is larger in another basis than it was given in: 64 harmonics add up in a direction."""


class LitPoints:
    """Points that are lit: what light takes of a view.

    Args:
        method: How their light is blocked.
        materials: What the scene's bodies reflect.
        vertices: Positions of all vertices.
        spheres: Centers and radii of the spheres.
        receivers: The points.
        call: Has what of them may not be kept.
        static: The static bodies among moving ones; None where any may move.
        normals: Node of the normals of all vertices, vec3 of shape [batch, vertex]; by default its own.
        blocking: How the bodies block light.
        stands: Whether bodies and points are where the scene and its camera have them, for good.
    """

    def __init__(
        self,
        method: "Method",
        materials: Materials,
        vertices: Source,
        spheres: Source,
        receivers: Node,
        call: Call,
        static: Static | None = None,
        normals: Node | None = None,
        blocking: Blocking = BY_SPHERES,
        stands: bool = False,
    ):
        self.blocking, self.stands = blocking, stands
        self.method, self.materials, self.assembly = method, materials, method.assembly
        self.vertices, self.spheres, self.receivers_node = vertices, spheres, receivers
        self.call, self.static = call, static
        self.normals = Node("", vertex_normals, vertices, method.assembly.faces) if normals is None else normals
        self._scene_shading: Node | None = None
        self._known: tuple[Source, Node] | None = None
        self._transfers: Node | None = None
        self._kept: dict[str, tuple[Hashable, Any]] = {}

    def kept(self, name: str, given: Hashable, make: Callable[[], Kept]) -> Kept:
        """What a method makes for the points: that which the name has, as long as it is asked for the same."""
        if name not in self._kept or self._kept[name][0] != given:
            self._kept[name] = given, make()
        return self._kept[name][1]

    @property
    def receivers(self) -> Receivers:
        """Where light is evaluated."""
        return self.receivers_node.value(self.call)

    def counts(self) -> tuple[str, int, int]:
        """How many receivers may move and how many are static; "up to " where they are not found yet."""
        receivers = self.receivers
        return "", receivers.points.size, len(receivers.still)

    def shading(self, light: Light | None, materials: Materials | None = None) -> Node:
        """What the receivers send back as white surfaces, vec3 of shape [batch, receiver]; None is the scene's light.

        What the scene's light and the last other known light make is kept. Materials, by default the scene's, matter
        where light bounces.
        """
        check_light(light)
        if materials is None or not self.assembly.scene.bounces:
            materials = self.materials
        if isinstance(light, wp.array):
            return self.method.free_shading(self, Source("light", light, news="light is given"), materials)
        if light is None or light is self.method.light.value():
            if materials is not self.materials:
                return self.method.shading(self, self.method.light, materials)
            if self._scene_shading is None:
                self._scene_shading = self.method.shading(self, self.method.light, materials)
            return self._scene_shading
        last, node = self._known or (None, None)
        source = Source.renewed("light", light, last)
        if node is None or source is not last:
            node = self.method.shading(self, source, self.materials)
            self._known = source, node
        return node if materials is self.materials else self.method.shading(self, source, materials)

    @property
    def transfers(self) -> Node:
        """Transfer vectors of the receivers to the renderer's basis, [batch, receiver, coefficient] for each group."""
        if self._transfers is None:
            self._transfers = self.method.transfers(self)
        return self._transfers


class Method:
    """How light is blocked: a method of visibility.

    Args:
        assembly: The bodies.
        native_basis: What the method computes light in.
        basis: What free light is expressed in; None for the method's own.
        progress: Show progress where something takes longer than a second.
    """

    lights_samples = False
    """Whether every sample is a receiver, whatever its body says."""

    traces_own_shadows = False
    """Whether bodies' shadows on themselves may come from rays, where the others' come from spheres."""

    def __init__(self, assembly: Assembly, native_basis: Basis, basis: Basis | None, *, progress: bool = False):
        self.assembly, self.native_basis, self.progress = assembly, native_basis, progress
        self.basis = native_basis if basis is None else basis
        self.visibility = assembly.scene.visibility
        self.light = Source("light", assembly.scene.light)
        self._numberings: dict[tuple[tuple[int, ...], ...], list[Numbering]] = {}

    @functools.cached_property
    def samples_receive(self) -> np.ndarray:
        """Bodies on which every sample is a receiver, bool of shape [body]."""
        return np.array([self.lights_samples or body.receivers == "pixel" for body in self.assembly.scene.bodies])

    @functools.cached_property
    def can_receive(self) -> np.ndarray:
        """Vertices that may be receivers, and those whose backs may be, bool of shape [2, vertex]."""
        body_of_vertex, receives = self.assembly.body_of_vertex, ~self.samples_receive
        return np.stack([receives[body_of_vertex], (receives & self.assembly.is_two_sided)[body_of_vertex]])

    @functools.cached_property
    def own_shadows(self) -> OwnShadows:
        """The bodies' shadows on themselves, from rays."""
        return OwnShadows(self.assembly, self.samples_receive, progress=self.progress)

    def apart(self, blocking: Blocking) -> np.ndarray | None:
        """Bodies whose receivers are groups of their own, −1 for others, shape [body]; None where all share a group."""
        bodies = np.arange(len(self.assembly.scene.bodies))
        if self.assembly.scene.bounces:
            return bodies
        named = (*blocking.traced, *blocking.flats)
        return np.where(np.isin(bodies, named), bodies, -1) if named else None

    def numbering(self, blocking: Blocking, has_backs: bool) -> Numbering:
        """Of all vertices, or of all with their backs; a first call makes both, so that a capture finds them."""
        key = blocking.traced, blocking.flats
        if key not in self._numberings:
            faces, can_receive, apart = self.assembly.faces, self.can_receive, self.apart(blocking)
            bodies = None if apart is None else apart[self.assembly.body_of_vertex]
            sides = can_receive[:1], can_receive
            self._numberings[key] = [number_receivers(faces, each, bodies=bodies) for each in sides]
        return self._numberings[key][has_backs]

    def shading(self, points: LitPoints, light: Source, materials: Materials) -> Node:
        """Shading of points in known light, which bounces from the materials."""
        raise NotImplementedError

    def free_shading(self, points: LitPoints, light: Source, materials: Materials) -> Node:
        """Shading of points in free light, which is converted where the transfer vectors are not."""
        matrix = self.native_from_basis if points.transfers.requires_grad else None
        items = functools.partial(receiver_words, points)
        return Node("shading", functools.partial(_shade, matrix=matrix), points.transfers, light, items=items)

    @functools.cached_property
    def native_from_basis(self) -> np.ndarray | None:
        """What takes free light to what the method computes in; None where it is that, or bands of it."""
        given, native = self.basis, self.native_basis
        if isinstance(native, HarmonicBasis) and isinstance(given, HarmonicBasis) and given.order <= native.order:
            return None
        return conversion(given, native)

    def transfers(self, points: LitPoints) -> Node:
        """Transfer vectors of points to :attr:`basis`, an array for each group."""
        raise NotImplementedError


def check_light(light: object) -> None:
    """Raise ValueError for what is no light, or None."""
    expected = (
        "an EnvironmentMap, as EnvironmentMap.read(path) reads it, known SH coefficients as an array [order², 3], or "
        "free coefficients in renderer.basis as a tensor"
    )
    check.instance("light", light, (EnvironmentMap, np.ndarray, wp.array, type(None)), expected)
    if isinstance(light, np.ndarray):
        check.shape("light", light.shape, ("order²", 3))
        check.finite("light", light)


def map_of(light: KnownLight) -> np.ndarray:
    """Radiance of known light as a map, shape [height, 2 height, 3]."""
    return light.radiance if isinstance(light, EnvironmentMap) else sh.reconstruct_map(light, 64)


def receiver_words(points: LitPoints, *, moving: bool = True, static: bool = True) -> str:
    """Number of receivers, in words."""
    up_to, moving_count, static_count = points.counts()
    return f"{up_to}{moving * moving_count + static * static_count:,} receivers"


def _shade(transfers: list[wp.array], light: wp.array, *, matrix: np.ndarray | None) -> wp.array:
    """Light the receivers of all groups, by light that a matrix converts. Differentiable: transfers, light."""
    most = check.LARGEST
    if matrix is not None:
        light, most = _converted(light, matrix), LARGEST_COEFFICIENT
    return joined([shade(transfer, light, most=most) for transfer in transfers])


def _converted(light: wp.array, matrix: np.ndarray | None) -> wp.array:
    """Coefficients of light in another basis, to which a matrix takes them, None for the same; differentiable in it."""
    return light if matrix is None else shade(constant(matrix[None], wp.float32, light.device), light)


def joined(parts: list[wp.array]) -> wp.array:
    """Receivers of parts one after another, of shape [batch, receiver]. Differentiable: parts."""
    return parts[0] if len(parts) == 1 else concatenate(parts, [part.shape[1] for part in parts])


# ---------------------------------------------------------------------------------------------- by spheres


class Group(NamedTuple):
    """Receivers that the same spheres block: those of all bodies, or of those other than the receivers' own."""

    points: wp.array  # [batch, receiver] vec3
    normals: wp.array  # [batch, receiver] vec3
    centers: wp.array  # [batch, sphere] vec3
    radii: wp.array  # [batch, sphere] float32
    kept_rows: KeptRows | None = None  # of static bodies, which block their light, too
    body: int | None = None  # whose receivers they are, where bodies are told apart
    places: Places | None = None  # where they lie on that body
    own_shadow: OwnLookup | OwnLobes | None = None  # by rays; None where there is none, or its spheres block
    flats: FlatsAround | None = None  # bodies that block as planes; None without any

    def parts(self) -> Iterator["Group"]:
        """Parts of at most PART receivers, with as many instances in all arrays where there are spheres.

        For a gradient they come all at once, and so do those with kept rows.
        """
        points, normals, centers, radii, kept_rows, _, places, own_shadow, flats = self
        size = points.shape[1]
        turns = None if own_shadow is None else own_shadow.turned
        frames = None if flats is None else flats.frames
        if radii.shape[1] or turns is not None or frames is not None:
            given = {"points": points, "centers": centers, "radii": radii, "rotations": turns, "flats": frames}
            count = common_batch(given)
            points, normals, centers, radii = [expand(array, count) for array in self[:4]]
        varying = [*self[:4], turns, frames]
        if kept_rows is not None or size <= PART or varies(varying):
            yield self._replace(points=points, normals=normals, centers=centers, radii=radii)
            return
        for start in range(0, size, PART):
            part = slice(start, min(start + PART, size))
            yield self._replace(
                points=points[:, part].contiguous(),
                normals=normals[:, part].contiguous(),
                centers=centers,
                radii=radii,
                places=None if places is None else places.part(part),
            )


class Seen(NamedTuple):
    """What a group sees of the light."""

    past_all: wp.array | None  # visibility or transmittance past all bodies; None where nothing blocks
    past_own: wp.array | None = None  # a factor of it: transmittance past its own body; None where that is 1
    past_solid: wp.array | None = None  # transmittance past all but flats; None where no flats block


class Bouncing(Protocol):
    """How light bounces in a scene: what is added to a method of spheres.

    Attributes:
        flats: Bodies that lie in a plane.
    """

    flats: tuple[int, ...]

    def shading(self, points: LitPoints, taken: Node, light: Source, materials: Materials) -> Node:
        """Shading of points, direct and bounced, given what the method takes of the light."""

    def kept_shading(self, points: LitPoints, taken: Any, light: Source, materials: Materials) -> Node:
        """The same of points that stand still; what does not depend on light and materials is kept."""


class SphereMethod(Method):
    """A method in which spheres stand in for the bodies: visibility, transfer vectors, and shading.

    Attributes:
        taken_if_free: What the method takes of any free light.
        why_no_shadows: Why the method has no shadows, in words; empty if it has.
        bounces: How light bounces; None where it does not.
        joins_kept: Whether visibility is found of kept rows and of what moves together.
    """

    taken_if_free: Any
    why_no_shadows = ""
    joins_kept = False
    bounces: "Bouncing | None" = None

    @functools.cached_property
    def blocking_flats(self) -> tuple[int, ...]:
        """Bodies that block as the planes in which they lie, in place of their spheres."""
        return ()

    @functools.cached_property
    def flats(self) -> SceneFlats:
        """The bodies that lie in planes."""
        return SceneFlats(self.assembly)

    def flats_in(self, geometry: Geometry | None) -> tuple[int, ...]:
        """Bodies that block as planes in a geometry, by default the scene's: where light does not bounce, no deformed
        ones.
        """
        deformed = () if geometry is None or self.assembly.scene.bounces else geometry.deformed
        return tuple(body for body in self.blocking_flats if body not in deformed)

    def past_flats(self, group: Group, seen: Seen, taken: Any) -> Seen:
        """What a group sees past the flat bodies around it, too, of what it sees past all else."""
        raise NotImplementedError

    def taken_from(self, light: KnownLight) -> Any:
        """What the method takes of known light: its coefficients, and what they belong to."""
        raise NotImplementedError

    def coefficient_count(self, light: Source | None) -> int:
        """Number of coefficients of known light that take part; None for free light."""
        raise NotImplementedError

    def look_up(self, bodies: tuple[int, ...], rotations: wp.array, taken: Any) -> dict[int, Any]:
        """What receivers of some bodies see past these, :attr:`Group.own_shadow` by body. Differentiable: rotations."""
        raise NotImplementedError

    def see(self, group: Group, taken: Any) -> Seen:
        """Visibility, or transmittance, past a group's spheres and its own body."""
        raise NotImplementedError

    def transfer(self, seen: Seen, group: Group, taken: Any) -> wp.array:
        """Transfer vectors of a group."""
        raise NotImplementedError

    def light_part(self, transfer: wp.array, group: Group, taken: Any) -> wp.array:
        """Shading of a group in known light."""
        return shade(transfer, taken.coefficients, most=LARGEST_COEFFICIENT)

    def kept_rows(self, static: Static, light: Source | None, blocking: Blocking) -> Rows:
        """Rows of what static bodies block, of known light or of any."""
        raise NotImplementedError

    @functools.cached_property
    def _taken_from_scene(self) -> Node:
        return Node("", self.taken_from, self.light)

    def shading(self, points: LitPoints, light: Source, materials: Materials) -> Node:
        """Shading of points in known light, which bounces from the materials."""
        taken = self._taken_from_scene if light is self.light else Node("", self.taken_from, light)
        if self.bounces is not None:
            is_kept = points.stands and materials is not points.materials
            return (self.bounces.kept_shading if is_kept else self.bounces.shading)(points, taken, light, materials)
        return InParts(self, points, taken, light, joined)

    def free_shading(self, points: LitPoints, light: Source, materials: Materials) -> Node:
        """Shading of points in free light; where it bounces, found with the light as if that were known."""
        if self.bounces is None:
            return super().free_shading(points, light, materials)
        if points.stands:
            return self.bounces.kept_shading(points, self.taken_if_free, light, materials)
        return self.bounces.shading(points, Node("", self._taken_if_given, light), light, materials)

    def _taken_if_given(self, light: wp.array) -> Any:
        """What the method takes of free light that is given. Differentiable: light."""
        return self.taken_if_free._replace(coefficients=_converted(light, self.native_from_basis))

    def transfers(self, points: LitPoints, where: str = "") -> Node:
        """Transfer vectors of points to :attr:`basis`; where they vary, to what the method computes in."""
        matrix = self.native_from_basis
        transfers = InParts(self, points, self.taken_if_free, None, list, keeps=matrix is None, where=where)
        if matrix is None or transfers.requires_grad:
            return transfers

        def converted(native: list[wp.array]) -> list[wp.array]:
            return [wp.array(each.numpy() @ matrix, dtype=wp.float32, device=each.device) for each in native]

        return Node("", converted, transfers)


class InParts(Node):
    """Shading or transfer vectors of receivers, found group by group and part by part.

    So without a gradient transfer vectors of all receivers are never in memory at once.

    Args:
        method: The method.
        points: The receivers.
        taken: What the method takes of the light.
        light: Known light, in which parts are shaded; None to end with transfer vectors.
        finish: What is made of the list of those of all parts.
        keeps: As for :class:`Node`.
        where: Put after the names of its stages, where others have those names.
        extra: More that parts depend on.
        beside: As for :class:`Node`.
    """

    def __init__(
        self,
        method: SphereMethod,
        points: LitPoints,
        taken: Any,
        light: Source | None,
        finish: Callable[[list[wp.array]], Any],
        *,
        keeps: bool = True,
        where: str = "",
        extra: tuple[Node, ...] = (),
        beside: tuple[Node, ...] = (),
    ):
        self._static, self._finish, self._progress = points.static, finish, method.progress and light is not None
        self._method, self._points = method, points
        receivers, spheres, words = points.receivers_node, points.spheres, functools.partial(receiver_words, points)
        own_shadows = _own_shadows(method, points, taken)
        self._visibility = Node(
            f"visibility{where}",
            method.see,
            receivers,
            spheres,
            taken,
            own_shadows,
            items=lambda: _pairs(method, points),
            idle=lambda: _why_unblocked(method, points),
            keeps=False,
        )
        flats = points.blocking.flats
        place = functools.partial(method.flats.frames, flats) if flats else lambda _: None
        frames = Node("", place, points.vertices)
        self._passing = Node(
            f"flats{where}",
            method.past_flats,
            receivers,
            self._visibility,
            taken,
            frames,
            items=lambda: f"{words()} × {len(flats)} flat {'body' if len(flats) == 1 else 'bodies'}",
            idle="" if flats else "spheres stand in for what casts shadows",
            keeps=False,
        )
        self._transfer = result = Node(
            f"transfer{where}",
            method.transfer,
            self._passing,
            taken,
            items=lambda: f"{words()} × {method.coefficient_count(light)} coefficients",
            keeps=False,
        )
        self._shading = None
        if light is not None:
            given = self._transfer, taken
            self._shading = result = Node(f"shading{where}", method.light_part, *given, items=words, keeps=False)
        shadows = _static_shadows(method, points, light)
        kept_rows = shadows if shadows.function else None
        looked_up: Node | dict = own_shadows if own_shadows.function else {}
        given = receivers, spheres, taken, kept_rows, looked_up, frames, *extra
        super().__init__("", None, *given, beside=(own_shadows, shadows, result, *beside), keeps=keeps)

    def compute(self, call: Call) -> Any:
        """Find it for one part after another."""
        receivers, spheres, taken, kept_rows, looked_up, frames, *extra = self.values(call)
        groups = list(self._groups(receivers, spheres, looked_up, frames))
        if self._static is not None and len(receivers.still):
            on_static = self._static.receivers(receivers.still, self._static.normals.value(call))
            moving = self._method.assembly.spheres_of(self._solid(self._static.moving), spheres)
            group = Group(*on_static, *moving, kept_rows, flats=self._flats_around(frames, self._static.moving))
            groups = [group, *groups] if receivers.points.shape[1] else [group]
        total, results = len(receivers.still) + receivers.points.shape[1], []
        with progress_bar(total, "shading", "receiver", wanted=self._progress) as bar:
            for group in groups:
                for part in group.parts():
                    results.append(self.find(call, part, taken, spheres, *extra))
                    bar.update(part.points.shape[1])
        return self._finish(results)

    def find(self, call: Call, part: Group, taken: Any, spheres: tuple[wp.array, wp.array], *_: Any) -> Any:
        """Find it for a part, given what the method takes of the light, all spheres, and values of what is extra."""
        return self.light(call, part, self.see(call, part, taken), taken)

    def see(self, call: Call, part: Group, taken: Any) -> Seen:
        """What a part sees."""
        seen = self._visibility.run(call, part, taken)
        return seen if part.flats is None else self._passing.run(call, part, seen, taken)

    def light(self, call: Call, part: Group, seen: Seen, taken: Any) -> wp.array:
        """Transfer vectors of a part that sees something, or its shading."""
        transfer = self._transfer.run(call, seen, part, taken)
        return transfer if self._shading is None else self._shading.run(call, transfer, part, taken)

    def _groups(
        self,
        receivers: Receivers,
        spheres: tuple[wp.array, wp.array],
        looked_up: dict[int, Any],
        frames: wp.array | None,
    ) -> Iterator[Group]:
        """Receivers that may move, in groups that the same spheres block."""
        method = self._method
        bodies = self._solid(range(len(method.assembly.scene.bodies)))
        if not receivers.spans:
            blocking = method.assembly.spheres_of(bodies, spheres)
            yield Group(receivers.points, receivers.normals, *blocking, flats=self._flats_around(frames))
        for span in receivers.spans:
            points, normals = (cut(array, span.first, span.end) for array in (receivers.points, receivers.normals))
            is_traced = span.body in self._points.blocking.traced
            others = [body for body in bodies if not (is_traced and body == span.body)]
            blocking = method.assembly.spheres_of(others, spheres)
            group = Group(points, normals, *blocking, flats=self._flats_around(frames, but=span.body))
            if span.body >= 0:
                places = method.own_shadows.places(receivers, span)
                group = group._replace(body=span.body, places=places, own_shadow=looked_up.get(span.body))
            yield group

    def _solid(self, bodies: Iterable[int]) -> list[int]:
        """Those of some bodies that block by their spheres."""
        return [body for body in bodies if body not in self._points.blocking.flats]

    def _flats_around(
        self, frames: wp.array | None, blocking: tuple[int, ...] | None = None, *, but: int = -1
    ) -> FlatsAround | None:
        """Flat bodies around receivers of one body: all that block, or some."""
        flats = self._points.blocking.flats
        named = flats if blocking is None else tuple(body for body in flats if body in blocking)
        if frames is None or not set(named) - {but}:
            return None
        return FlatsAround(self._method.flats.among(flats, named), frames, flats.index(but) if but in flats else None)


def _sphere_counts(method: SphereMethod, points: LitPoints) -> np.ndarray:
    """Number of spheres by which each body blocks light."""
    bodies = np.arange(len(method.assembly.scene.bodies))
    return np.where(np.isin(bodies, points.blocking.flats), 0, method.assembly.sphere_counts)


def _pairs(method: SphereMethod, points: LitPoints) -> str:
    """Receivers and the spheres that block them, in words."""
    counts = _sphere_counts(method, points)
    words = f"{receiver_words(points, static=False)} × {counts.sum():,} spheres"
    if points.static is None:
        return words
    moving = counts[list(points.static.moving)].sum()
    return f"{words}, {receiver_words(points, moving=False)} on static bodies × {moving:,} spheres"


def _why_unblocked(method: SphereMethod, points: LitPoints) -> str:
    """Why no visibility has to be found; empty if it has."""
    counts, (_, moving, static) = _sphere_counts(method, points), points.counts()
    if method.why_no_shadows or not counts.sum():
        rest = "but flat ones " if points.blocking.flats else ""
        return method.why_no_shadows or f"no body {rest}has blockers"
    if moving or (points.static and static and (method.joins_kept or counts[list(points.static.moving)].sum())):
        return ""
    return "no moving body has blockers" if static else "nothing is seen"


def _own_shadows(method: SphereMethod, points: LitPoints, taken: Any) -> Node:
    """Node of what bodies' receivers look up of their own bodies, by body."""
    bodies, rotations = points.blocking.traced, points.blocking.rotations
    named = [body for body in bodies if not method.assembly.is_flat[body]]
    if not named or rotations is None:
        return Node("own shadows", None, idle=lambda: _why_no_own(method, points))

    def state() -> str:
        missing = method.own_shadows.missing(bodies)
        known = f"{missing} to be traced, or read from the cache" if missing else "traced once, kept"
        return f"{len(named)} {'body' if len(named) == 1 else 'bodies'}: {known}"

    return Node("own shadows", functools.partial(method.look_up, bodies), rotations, taken, items=state)


def _why_no_own(method: SphereMethod, points: LitPoints) -> str:
    """Why no body's shadow on itself is looked up."""
    if not method.traces_own_shadows:
        return "the method takes those of spheres"
    names = [body.called for body in method.assembly.scene.bodies]
    whys = {name: why for name, why in zip(names, points.blocking.why_spheres, strict=False) if why}
    return "; ".join(f"{name}: {why}" for name, why in whys.items()) or "bodies are flat"


def _static_shadows(method: SphereMethod, points: LitPoints, light: Source | None) -> Node:
    """Node of what static bodies block of the light of receivers on them; its value is None where there is nothing."""
    static = points.static
    if static is None or not static.spheres[1].shape[1]:
        bouncing = method.assembly.scene.bounces > 0
        why = "light bounces: nothing of static bodies is kept" if bouncing else "no static body has blockers"
        return Node("static shadows", None, idle=why)
    rows = method.kept_rows(static, light, points.blocking)

    def missing() -> int:
        receivers = points.receivers_node.known(points.call)
        return rows.missing(None if receivers is None else receivers.still)

    return Node(
        "static shadows",
        rows.of_receivers,
        Fixed(points.receivers_node),
        static.normals,
        items=lambda: f"up to {missing():,} vertices not seen before",
        idle=lambda: method.why_no_shadows or ("" if missing() else "kept: static bodies are the same"),
        keeps=False,
    )
