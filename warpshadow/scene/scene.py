"""Scenes: bodies, light, camera and how visibility is computed."""

from __future__ import annotations

import functools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar

import numpy as np
import numpy.typing as npt

from warpshadow import check
from warpshadow.assets.camera import Camera
from warpshadow.assets.image import ImageError
from warpshadow.assets.known_light import KnownLight, as_light
from warpshadow.assets.light import KNOWN_LIGHTS, LIGHT, EnvironmentMap, KnownLightArgument, check_coefficients
from warpshadow.assets.mesh import Mesh
from warpshadow.check import AnyPath
from warpshadow.maths import sh
from warpshadow.maths.plane import is_flat, principal_axes
from warpshadow.scene.body import Body
from warpshadow.scene.visibility import (
    BOUNCE_METHODS,
    DEFAULT_METHOD,
    DIRECTIONS,
    DIRECTIONS_OF_GLOSS,
    DIRECTIONS_OF_SPOTS,
    FULL_LIGHT_METHODS,
    METHODS,
    NARROW_ROUGHNESS,
    Visibility,
)
from warpshadow.stages.shell.shell_rays import exits_on_host

MAX_BOUNCES = 16

Bounces = int | Literal["all"]  # how often light bounces

BodyLike = int | str  # a body of a scene: its number, from 0, or its name

Item = TypeVar("Item")
PerBody = Sequence[Item | None] | Mapping[int, Item | None] | Mapping[str, Item | None]
"""Something for each body of a scene, a list of them all; or for some, by their numbers or names."""


FUNCTIONS_OF_SCENES = {
    "render": "warpshadow.render(scene)",
    "explain": "warpshadow.Renderer(scene).explain()",
    "tune": "warpshadow.tune(scene)",
    "view": "warpshadow.view(scene)",
    "insert": "warpshadow.insert(scene, photograph)",
    "fit": "warpshadow.inverse.fit(warpshadow.inverse.Problem(scene, targets, free))",
}
"""Functions that are looked for among a scene's methods."""

_DEFAULT_VISIBILITY = Visibility()

_NARROW_SPOT = 0.16
"""Radius of a narrow spot, at most, in units of the flat body's size, or the scene's if that is smaller."""

_SEVERAL_CAMERAS = "several go to Renderer(scene, cameras=[…]), or in a torch loop to TorchRenderer(scene, cameras=[…])"


def check_scene(value: object) -> None:
    """Raise ValueError unless it is a scene; the message says how to make one of the value."""
    remedy, own_scene = "", getattr(value, "scene", None)
    items = value if isinstance(value, (list, tuple)) else [value]
    if check.is_path(value):
        is_scene_file = Path(value).suffix.lower() == ".toml"
        remedy = f"; {'load' if is_scene_file else 'default'}_scene({str(value)!r}) makes one of that file"
    elif isinstance(value, (Body, Mesh)):
        remedy = f"; default_scene({type(value).__name__.lower()}) puts it on a ground under a sky"
    elif items and all(isinstance(item, Body) for item in items):
        remedy = "; Scene([…], synthetic_sky()) makes one of bodies"
    elif isinstance(own_scene, Scene) and not isinstance(value, type):
        remedy = f"; renderer.scene is its, and renderer{'' if callable(value) else '.render'}() is an image of it"
    check.instance("scene", value, Scene, f"a Scene; load_scene(path) reads one{remedy}")


def check_supersampling(count: object) -> None:
    """Raise ValueError unless it is a number of samples across a pixel, 1 to 16."""
    if not check.is_integer(count) or count not in range(1, 17):
        raise ValueError(f"supersampling: got {check.described(count)}, expected a whole number from 1 to 16")


def check_bounces(count: object) -> None:
    """Raise ValueError unless it is a number of bounces, 0 to 16, or "all"."""
    is_all = isinstance(count, str) and count == "all"
    if not is_all and (not check.is_integer(count) or count not in range(MAX_BOUNCES + 1)):
        expected = f'a whole number from 0 to {MAX_BOUNCES}, or "all"'
        raise ValueError(f"bounces: got {check.described(count)}, expected {expected}")


def _check_order(settings: Mapping[str, object]) -> None:
    """Raise ValueError where a scene's arguments stand in each other's places."""
    swapped = [
        f"{role} in place of {name}"
        for name, value in settings.items()
        if (role := _argument_role(value, name)) != name
    ]
    if swapped:
        raise ValueError(f"Scene: got {' and '.join(swapped)}, expected Scene(bodies, light, camera, visibility)")


def _argument_role(value: object, name: str) -> str:
    """The argument of a scene that a value is meant for; by its name where it is of no such class."""
    items = value if isinstance(value, (list, tuple)) else [value]
    if any(isinstance(item, Body) for item in items):
        return "bodies"
    roles = dict.fromkeys(KNOWN_LIGHTS, "light") | {Camera: "camera", Visibility: "visibility"}
    return next((role for kind, role in roles.items() if isinstance(value, kind)), name)


def check_bodies_within(bodies: Iterable[Body], shell: np.ndarray) -> None:
    """Raise ValueError unless all bodies are within the shell of the light, center and radius [4]."""
    for body in bodies:
        distance = np.linalg.norm(body.world_points() - shell[:3], axis=1).max()
        if distance > shell[3]:
            raise ValueError(
                f"light: got a map of radius {shell[3]:g} around {shell[:3].tolist()}, outside of which body "
                f"{body.name!r} reaches, {distance:.4g} from there; expected a larger radius, or smaller bodies"
            )


def _has_narrow_spot(bodies: Sequence[Body]) -> bool:
    """Whether a lamp is so near a flat body that light bounces off a narrow spot of it.

    The radius of a spot is the lamp's distance, or half of the lamp's size.
    """
    is_lamp = np.array([body.is_emitter for body in bodies])
    if not is_lamp.any():
        return False
    points = [body.world_points().astype(np.float64) for body in bodies]
    low, high = (np.stack([end(item, axis=0) for item in points]) for end in (np.min, np.max))
    middles, radii = (low + high) / 2, (high - low).max(axis=1) / 2
    for number, body in enumerate(bodies):
        if is_flat(points[number]):
            others = np.arange(len(points)) != number
            extent = (high[others].max(axis=0) - low[others].min(axis=0)).max() if others.any() else 0.0
            size = min(body.scale * np.sqrt(body.mesh.area), extent)
            heights = np.abs((middles - middles[number]) @ principal_axes(points[number])[2])
            distances = np.linalg.norm(middles - np.clip(middles, low[number], high[number]), axis=1)
            spots = np.maximum.reduce([heights, distances, radii])
            if (spots < _NARROW_SPOT * size)[is_lamp & others].any():
                return True
    return False


class Bodies(tuple[Body, ...]):
    """The bodies of a scene, by their numbers, from 0, or names."""

    def __getitem__(self, key: Any) -> Any:
        """A body by its number or name, or several by a slice."""
        return super().__getitem__(self.number(key) if isinstance(key, str) else key)

    def number(self, body: BodyLike, argument: str = "body") -> int:
        """Number of a body, from 0, given that or its name.

        Raises:
            ValueError: for a body that there is not, and for a name that two bodies have from their meshes.
        """
        if not isinstance(body, str):
            by_name = f", or its name, such as {self[-1].name!r}"
            check.index(argument, body, len(self), "body", by_name)
            return int(body)
        names = [item.name for item in self]
        check.choice(argument, body, names)
        if names.count(body) > 1:
            numbers = [number for number, name in enumerate(names) if name == body]
            raise ValueError(
                f"{argument}: got {body!r}, as bodies {numbers} are called, expected a number, or "
                'a name of its own for each: Body(…, name="…")'
            )
        return names.index(body)


@check.frozen()
@dataclass(frozen=True, eq=False, init=False)
class Scene:
    """Bodies, their light and a camera, in a right-handed world with y up, in units of length of your choice.

    Light is linear RGB radiance from infinitely far away, or from a sphere around all bodies. An image is its color
    times reflectance, without exposure: white ground under light of 1 from everywhere is 1. Pictures have their own
    exposure, :class:`warpshadow.Picture`.

    Args:
        bodies: One or more bodies; they cast shadows on each other and on themselves. ``scene.bodies`` finds them by
            name, too: ``scene.bodies["cow"]``.
        light: Environment map, or SH coefficients [order², 3] as of a :class:`warpshadow.HarmonicBasis`, or the path of
            a map, relative to the current folder. Coefficients in cells become a map by ``basis.to_map``.
        camera: The camera; None for one that shows all bodies, :meth:`Camera.framing`.
        visibility: How visibility is computed.
        supersampling: Each pixel averages this many samples across and down, which smooths silhouettes.
        bounces: How often light bounces between bodies before it reaches a visible surface, 0 to 16; 0 is direct light
            alone, which is the paper's model. Within a body, such as a bowl, it then goes on eight times more, which
            costs next to nothing; only paths, of ``ray-traced``, end after so many bounces of any kind. "all" adds all
            further ones as a sum of three geometric series (:mod:`.stages.bounces.tail`), in 1.5 times the time of two.
    """

    bodies: tuple[Body, ...]
    light: KnownLightArgument
    camera: Camera
    visibility: Visibility
    supersampling: int = 2
    bounces: Bounces = 0

    @check.keywords(
        cameras=f"camera; {_SEVERAL_CAMERAS}",
        method="visibility=Visibility(method)",
        light="Scene(bodies, synthetic_sky()), or the path of a map",
    )
    def __init__(
        self,
        bodies: Iterable[Body],
        light: EnvironmentMap | npt.ArrayLike | AnyPath,
        camera: Camera | None = None,
        visibility: Visibility = _DEFAULT_VISIBILITY,
        supersampling: int = supersampling,
        bounces: Bounces = bounces,
    ):
        _check_order({"bodies": bodies, "light": light, "camera": camera, "visibility": visibility})
        check.instance("bodies", bodies, Iterable, "a list of one or more: [Body(mesh)]")
        vars(self).update(bodies=Bodies(bodies), light=light, camera=camera)
        vars(self).update(visibility=visibility, supersampling=supersampling, bounces=bounces)
        if not self.bodies:
            raise ValueError("bodies: got none, expected one or more")
        for number, body in enumerate(self.bodies):
            check.instance(f"bodies[{number}]", body, Body, "a Body, as Body(mesh) makes it of a mesh")
            own_names = [other.name for other in self.bodies[:number] if other.has_own_name]
            if body.has_own_name and body.name in own_names:
                raise ValueError(f"bodies[{number}]: name: got {body.name!r}, as another has, expected one of its own")
        if camera is None:
            object.__setattr__(self, "camera", Camera.framing(self.bodies))
        check.instance("camera", self.camera, Camera, f"a Camera; {_SEVERAL_CAMERAS}")
        method = self.visibility if str(self.visibility) in METHODS else DEFAULT_METHOD
        check.instance("visibility", self.visibility, Visibility, f"a Visibility, such as Visibility({method!r})")
        value: Any = self.light
        if check.is_path(value):
            path = check.file("light", value)
            with check.located("light", ImageError):
                object.__setattr__(self, "light", EnvironmentMap.read(path))
        if not isinstance(self.light, KNOWN_LIGHTS):
            light = check.numbers("light", self.light, expected=f"{LIGHT}, or the path of a map")
            check_coefficients("light", light)
            with check.located("light"):
                sh.check_order(sh.order_of("light", light))
            light.setflags(write=False)
            object.__setattr__(self, "light", light)
        check_supersampling(self.supersampling)
        check_bounces(self.bounces)
        self._check_method()

    def _check_method(self) -> None:
        """Raise ValueError for bodies, light and bounces that the named method does not show."""
        method, methods = repr(self.visibility.method), ", ".join(map(repr, FULL_LIGHT_METHODS))
        glossy = [body.name for body in self.bodies if body.is_glossy]
        emitters = [body.name for body in self.bodies if body.is_emitter]
        lacks = [
            f"roughness: got some for body {name!r}, which {method} does not show, expected None" for name in glossy
        ]
        lacks += [
            f"emission: got some for body {name!r}, whose light {method} lacks, expected None" for name in emitters
        ]
        if self.shell is not None:
            lacks.append(f"light: got a radius, which {method} does not know, expected a map without one")
        if lacks and not self.visibility.traits.shows_all_light:
            raise ValueError(f"{lacks[0]}, or method = one of {methods}")
        if self.shell is not None:
            check_bodies_within(self.bodies, self.shell)
        if self.bounces and not self.visibility.traits.finds_bounces:
            finders = ", ".join(map(repr, BOUNCE_METHODS))
            raise ValueError(
                f"bounces: got {self.bounces}, which {self.visibility.method!r} does not find, expected 0, or "
                f"method = one of {finders}"
            )

    if not TYPE_CHECKING:  # to which it would hide names that there are not

        def __getattr__(self, name: str) -> Any:
            """Say which function of a scene is meant."""
            hint = FUNCTIONS_OF_SCENES.get(name)
            raise AttributeError(f"a Scene has no {name!r}{f' (write {hint})' if hint else ''}")

    def __getitem__(self, body: BodyLike) -> Body:
        """A body, given its number or name."""
        return self.bodies[self.body_number(body)]

    __iter__ = None  # one goes over scene.bodies

    def __repr__(self) -> str:
        bounces = f", {self.bounces} bounces" if self.bounces else ""
        bodies = ", ".join(map(repr, self.bodies))
        method = "" if self.visibility.method is None else f", {self.visibility.method!r}"
        return f"Scene([{bodies}], {self.known_light}, {self.camera!r}{method}{bounces})"

    @functools.cached_property
    def known_light(self) -> KnownLight:
        """The light with its methods, of whichever kind it is."""
        return as_light(self.light)

    @property
    def shell(self) -> np.ndarray | None:
        """Center and radius of the sphere that sends the light, [4]; None for light from infinitely far away."""
        return self.known_light.shell

    @property
    def methods(self) -> tuple[str, ...]:
        """Methods of visibility that show all that the scene has: gloss, emission and near light."""
        is_any = self.shell is None and not any(body.is_glossy or body.is_emitter for body in self.bodies)
        return tuple(method for method in METHODS if is_any or method in FULL_LIGHT_METHODS)

    @functools.cached_property
    def direction_count(self) -> int:
        """Cells of "directional": as many as asked for, or as many as :data:`DIRECTIONS` and constants below it say.

        Roughness and emission that calls of a renderer pass do not count, nor those that a fit finds.
        """
        if self.visibility.directions is not None:
            return self.visibility.directions
        if self.bounces and _has_narrow_spot(self.bodies):
            return DIRECTIONS_OF_SPOTS
        roughness = [body.roughness.min() for body in self.bodies if body.roughness is not None]
        return DIRECTIONS_OF_GLOSS if min(roughness, default=1.0) < NARROW_ROUGHNESS else DIRECTIONS

    def with_method(self) -> Scene:
        """The scene as renderers have it: "directional" where no method is named."""
        return self if self.visibility.method else replace(self, visibility=self.visibility.with_method())

    def background(self) -> np.ndarray:
        """The light as the camera sees it where no body is, linear RGB, float32 of shape [height, width, 3]."""
        supersampling = self.supersampling
        _, directions = self.camera.resized(supersampling).rays()
        if self.shell is not None:
            directions = exits_on_host(self.camera.eye, directions, self.shell)
        radiance = self.known_light.radiance_from(directions)
        height, width, _ = directions.shape
        samples = radiance.reshape(height // supersampling, supersampling, width // supersampling, supersampling, 3)
        return samples.mean(axis=(1, 3)).astype(np.float32)

    def body_number(self, body: BodyLike, argument: str = "body") -> int:
        """Number of a body, from 0, given that or its name: :meth:`Bodies.number`."""
        return Bodies(self.bodies).number(body, argument)

    def body_numbers(self, bodies: Iterable[BodyLike], argument: str = "bodies") -> tuple[int, ...]:
        """Numbers of some bodies, given numbers or names."""
        if not isinstance(bodies, Iterable) or isinstance(bodies, str):
            got, example = check.described(bodies), [bodies] if isinstance(bodies, str) else [0]
            raise ValueError(
                f"{argument}: got {got}, expected a list of bodies, by numbers or names, such as {example}"
            )
        return tuple(self.body_number(body, argument) for body in bodies)

    @property
    def unique_names(self) -> list[str]:
        """Names of the bodies; body_0 and so on, by number, where several have one."""
        names = [body.name for body in self.bodies]
        return [name if names.count(name) == 1 else f"body_{number}" for number, name in enumerate(names)]

    @property
    def catchers(self) -> tuple[int, ...]:
        """Numbers of the bodies that model surfaces of the photograph."""
        return tuple(number for number, body in enumerate(self.bodies) if body.shadow_catcher)

    def per_body(self, value: PerBody[Item] | None, argument: str) -> list[Item | None]:
        """One item for each body, None where nothing is given.

        Args:
            value: A list of as many as there are bodies; or a mapping of some of them, by numbers or names.
            argument: Its name in messages.
        Raises:
            ValueError: for a list of another length, and for bodies that there are not, or that come twice.
        """
        count = len(self.bodies)
        if value is None:
            return [None] * count
        if isinstance(value, Mapping):
            items: dict[int, Item | None] = {}
            for body, item in value.items():
                number = self.body_number(body, argument)
                if number in items:
                    raise ValueError(f"{argument}: got {body!r} beside the same body's number, expected one of them")
                items[number] = item
            return [items.get(number) for number in range(count)]
        if not isinstance(value, Sequence) or isinstance(value, str):
            example = f"{{{self.bodies[0].name!r}: …}}"
            raise ValueError(
                f"{argument}: got {check.described(value)}, expected a list of {count} items, one for each body, None "
                f"for the scene's own; or some by their bodies, such as {example}"
            )
        if len(value) != count:
            raise ValueError(f"{argument}: got {len(value)} items, expected {count}, one for each body")
        return list(value)


def change_bodies(scene: Scene, field: str, values: Mapping[int, Any]) -> Scene:
    """The scene with other values of a field of some bodies, by their numbers; itself where there are none."""
    if not values:
        return scene
    bodies = list(scene.bodies)
    for number, value in values.items():
        bodies[number] = replace(bodies[number], **{field: value})
    return replace(scene, bodies=tuple(bodies))
