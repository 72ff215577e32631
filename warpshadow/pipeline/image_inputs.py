"""Inputs of an image: all that a call may give in place of the scene's own, named, typed and explained once."""

import dataclasses
import functools
import inspect
import re
import textwrap
import typing
from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass, field
from typing import Any, Concatenate, Generic, ParamSpec, Protocol, TypeVar, overload

import warp as wp

from warpshadow import check
from warpshadow.assets.light import KnownLightArgument
from warpshadow.pipeline.bodies.geometry import Geometry
from warpshadow.scene.material import INPUTS_OF_BODIES
from warpshadow.scene.scene import PerBody

Array = TypeVar("Array")  # Warp's arrays, or tensors
Placed = TypeVar("Placed")  # a geometry of these; of a renderer of several scenes one for each

_DIMENSIONS = "dimensions of an item"


@dataclass(frozen=True, eq=False)
class ImageInputs(Generic[Array, Placed]):
    """All that an image takes.

    Shapes below are of tensors, which may have a batch dimension before them. Warp's arrays have one always, and items
    of the last dimensions are of a dtype: [vertex, 3] is vec3 of shape [batch, vertex], a number [batch, 1]. A batch of
    1 serves every instance of the others.

    Args:
        light: Free light, coefficients in the renderer's ``basis``, linear RGB, [coefficient, 3]; or known light, as a
            map or as an ``ndarray`` of SH coefficients [order², 3] (not beside tensors), which is shaded more
            accurately than free light can be; by default the scene's.
        albedo: Reflectance of bodies in linear RGB, one color [3], or one for each vertex [vertex, 3]: a list for all
            bodies, None for the scene's own, or a mapping for some, by their numbers or names: ``{"bunny": color}``.
            Values above 1, which a Body refuses, are taken as they are: free ones may pass 1 on their way.
        textures: Reflectance of bodies as images, [height, width, 3], which needs uvs; a list or a mapping likewise.
        emission: Radiance, 0 or more, of bodies that have emission in the scene: colors as of albedo, or images as of
            textures.
        roughness: Of bodies that have roughness in the scene, one number, [] or [1], one for each vertex, [vertex], or
            an image, [height, width]; a list or a mapping likewise. Numbers beyond [0, 1] are refused: clamp them after
            each step of an optimizer, or free the input of a sigmoid. An image that is as wide as there are vertices,
            or 1 wide, needs the batch; so does one of emission.
        metallic, specular: Likewise, of the same bodies.
        shell: Where the scene's light has a radius: center and radius of the sphere that sends the light [scene units],
            [4], in place of the scene's or a map's own; all bodies are inside.
        geometry: Vertices and spheres in world space, from the renderer's ``placed``; by default the scene's, which
            stand still.
        clip_matrices: Cameras, [4, 4], from :func:`warpshadow.stages.raster.project.compose_clip_matrices`, or a
            TorchRenderer's ``clip_matrices``; by default the renderer's own.
    """

    light: Array | KnownLightArgument | None = field(default=None, metadata={_DIMENSIONS: 2})
    _: KW_ONLY
    albedo: PerBody[Array] | None = None
    textures: PerBody[Array] | None = None
    emission: PerBody[Array] | None = None
    roughness: PerBody[Array] | None = None
    metallic: PerBody[Array] | None = None
    specular: PerBody[Array] | None = None
    shell: Array | None = field(default=None, metadata={_DIMENSIONS: 1})
    geometry: Placed | None = None
    clip_matrices: Array | None = field(default=None, metadata={_DIMENSIONS: 2})

    def __post_init__(self) -> None:
        items = self.light if isinstance(self.light, (tuple, list)) else [self.light]
        if any(isinstance(item, Geometry) for item in items):
            raise ValueError("light: got a Geometry, expected light first: renderer(light, geometry=…), or geometry=…")

    @property
    def of_bodies(self) -> dict[str, PerBody[Array] | None]:
        """The materials of bodies, by name."""
        return {name: getattr(self, name) for name in INPUTS_OF_BODIES}

    @property
    def of_images(self) -> dict[str, tuple[Any, int]]:
        """All others but the geometry, by name, and how many dimensions an item of their tensors has."""
        others = (part for part in dataclasses.fields(self) if part.name not in (*INPUTS_OF_BODIES, "geometry"))
        return {part.name: (getattr(self, part.name), part.metadata[_DIMENSIONS]) for part in others}


ImageArrays = ImageInputs[wp.array, Geometry[wp.array]]

P = ParamSpec("P")
Inputs_co = TypeVar("Inputs_co", covariant=True)
Owner = TypeVar("Owner")
First = TypeVar("First")
R = TypeVar("R")


class _AcceptsFields(Protocol[P, Inputs_co]):
    """A decorator of methods that take a record, by itself or after another argument."""

    @overload
    def __call__(self, method: Callable[[Owner, Inputs_co], R]) -> Callable[Concatenate[Owner, P], R]: ...
    @overload
    def __call__(self, method: Callable[[Owner, First, Inputs_co], R]) -> Callable[Concatenate[Owner, First, P], R]: ...


def accepts_fields_of(record: Callable[P, Inputs_co], **remedies: str) -> _AcceptsFields[P, Inputs_co]:
    """Let users give the fields of a record as arguments to a method whose last argument is the record, ``inputs``.

    The method's signature, types and documentation then say them one by one.

    Args:
        record: A dataclass such as :class:`ImageInputs`, of some type of arrays.
        remedies: Remedies for other keywords, as of :func:`.check.keywords`.
    """
    kind: Any = typing.get_origin(record) or record
    types = _field_types(record)
    fields = [part.replace(annotation=types[name]) for name, part in inspect.signature(kind).parameters.items()]
    classes = [base for base in reversed(kind.__mro__) if dataclasses.is_dataclass(base)]
    documentation = "\n".join((inspect.getdoc(base) or "").partition("Args:\n")[2] for base in classes)
    entries = textwrap.indent(documentation, 8 * " ")

    def decorate(method: Callable[..., Any]) -> Callable[..., Any]:
        *others, _ = inspect.signature(method).parameters.values()
        signature = inspect.signature(method).replace(parameters=[*others, *fields])

        @functools.wraps(method)
        def accepting_fields(*args: Any, **arguments: Any) -> Any:
            bound = signature.bind(*args, **arguments).arguments
            inputs = record(**{name: bound.pop(name) for name in types if name in bound})  # type: ignore[call-arg]
            return method(**bound, inputs=inputs)

        accepting_fields.__signature__ = signature  # type: ignore[attr-defined]
        hints = {name: hint for name, hint in method.__annotations__.items() if name != "inputs"}
        accepting_fields.__annotations__ = hints | types
        accepting_fields.__doc__ = re.sub(
            r"^ +inputs: .*$", lambda _: entries, method.__doc__ or "", flags=re.MULTILINE
        )
        return check.keywords(**remedies)(accepting_fields)

    return decorate  # type: ignore[return-value]


def _field_types(record: Any) -> dict[str, Any]:
    """Types of the fields of a dataclass, with its types of arrays in the place of variables."""
    kind = typing.get_origin(record) or record
    types: dict[str, Any] = {}
    for base in getattr(kind, "__orig_bases__", ()):
        types |= _field_types(base) if dataclasses.is_dataclass(typing.get_origin(base)) else {}
    values = dict(zip(getattr(kind, "__parameters__", ()), typing.get_args(record), strict=True))
    for name, hint in vars(kind).get("__annotations__", {}).items():
        if hint is not KW_ONLY:
            variables = tuple(values[variable] for variable in getattr(hint, "__parameters__", ()))
            types[name] = (
                values.get(hint, hint) if isinstance(hint, TypeVar) else hint[variables] if variables else hint
            )
    return types
