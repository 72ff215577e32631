"""Scenes: bodies, light, camera and how visibility is computed; in Python or from a TOML file."""

import functools
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from warpshadow import check, sh
from warpshadow.camera import Camera
from warpshadow.directions import check_count
from warpshadow.image import read_image
from warpshadow.light import EnvironmentMap
from warpshadow.mesh import Mesh, icosphere, load_mesh, plane
from warpshadow.spheres import Spheres
from warpshadow.visibility.directional import SOFTNESS
from warpshadow.visibility.exponential import THRESHOLDS
from warpshadow.visibility.zonal_logs import LOGS

METHODS = ("directional", "log-sh", "none", "ray-traced")
RECEIVERS = ("vertex", "pixel")


class SceneError(ValueError):
    """A scene file that cannot be used: the message says where and what is accepted."""


@dataclass(frozen=True, eq=False)
class Visibility:
    """How visibility is computed.

    Args:
        method: "directional" transmittance of spheres, "log-sh" of spheres, "none" (no shadows), or "ray-traced"
            visibility of the meshes, the reference.
        directions: Number of direction cells of "directional", a multiple of 16.
        softness: κ of "directional": half-width of a shadow's soft edge in cell radii.
        order: Number of SH bands of "log-sh", 2 to 8.
        log: Logarithm of one cap of "log-sh": "eigen" or "cap".
        base: Base approximation of the exponential of "log-sh": "quadratic", "linear" or "optimal_linear".
        samples: Number of directions of "ray-traced".

    Raises:
        ValueError: naming the argument, what it got and what it accepts.
    """

    method: str = "directional"
    directions: int = 128
    softness: float = SOFTNESS
    order: int = 8
    log: str = "eigen"
    base: str = "quadratic"
    samples: int = 1024

    def __post_init__(self) -> None:
        """Validate."""
        check.choice("method", self.method, METHODS)
        check_count("directions", self.directions)
        sh.check_order(self.order)
        check.choice("log", self.log, LOGS)
        check.choice("base", self.base, THRESHOLDS)
        if self.samples < 1:
            raise ValueError(f"samples: got {self.samples!r}, expected a positive number of directions")
        if not (np.isfinite(self.softness) and self.softness > 0):
            raise ValueError(f"softness: got {self.softness!r}, expected a positive number of cell radii")


@dataclass(frozen=True, eq=False)
class Body:
    """A mesh with its reflectance, placed in the world: scale first, then rotation, then translation.

    Args:
        mesh: The mesh.
        albedo: Reflectance, linear RGB, for the body [3] or for each vertex [vertex, 3].
        texture: Reflectance as an image in place of ``albedo``, linear RGB of shape [height, width, 3]; needs uvs.
        blockers: Number of spheres to fit to the mesh, or the spheres themselves; 0 casts no shadow.
        rotation: Axis-angle vector [degrees], shape [3].
        translation: Offset [scene units], shape [3].
        scale: Factor, positive.
        receivers: Where light is evaluated: at every "vertex", or at every "pixel" that shows the body, which a mesh
            of few faces needs to receive a shadow.

    Raises:
        ValueError: naming the argument, what it got and what it accepts.
    """

    mesh: Mesh
    albedo: np.ndarray | tuple[float, float, float] = (0.8, 0.8, 0.8)
    texture: np.ndarray | None = field(default=None, repr=False)
    blockers: int | Spheres = 64
    rotation: tuple[float, float, float] = (0.0, 0.0, 0.0)
    translation: tuple[float, float, float] = (0.0, 0.0, 0.0)
    scale: float = 1.0
    receivers: str = "vertex"

    def __post_init__(self) -> None:
        """Validate, and hold arrays as float32."""
        albedo = np.array(self.albedo, np.float32)
        if albedo.shape not in ((3,), (self.mesh.vertex_count, 3)):
            raise ValueError(
                f"albedo: got shape {albedo.shape}, expected [3] or [{self.mesh.vertex_count}, 3] (one for each vertex)"
            )
        check.finite("albedo", albedo)
        if (albedo < 0).any():
            raise ValueError(f"albedo: got {albedo.min()}, expected reflectances of 0 or more")
        object.__setattr__(self, "albedo", albedo)
        if self.texture is not None:
            if self.mesh.uvs is None:
                raise ValueError(
                    f"texture: got an image, but mesh {self.mesh.name!r} has no uvs; expected none, or uvs"
                )
            texture = np.array(self.texture, np.float32)
            check.shape("texture", texture.shape, ("height", "width", 3))
            if texture.size == 0:
                raise ValueError(f"texture: got shape {texture.shape}, expected at least one texel")
            check.finite("texture", texture)
            object.__setattr__(self, "texture", texture)
        if not isinstance(self.blockers, Spheres):
            is_count = isinstance(self.blockers, (int, np.integer)) and not isinstance(self.blockers, bool)
            if not is_count or self.blockers < 0:
                raise ValueError(
                    f"blockers: got {self.blockers!r}, expected a number of spheres, 0 or more, or Spheres"
                )
            object.__setattr__(self, "blockers", int(self.blockers))
        for name in ("rotation", "translation"):
            vector = np.array(getattr(self, name), np.float64)
            check.shape(name, vector.shape, (3,))
            check.finite(name, vector)
            object.__setattr__(self, name, vector)
        if not (np.isfinite(self.scale) and self.scale > 0):
            raise ValueError(f"scale: got {self.scale!r}, expected a positive number")
        check.choice("receivers", self.receivers, RECEIVERS)

    def rotation_matrix(self) -> np.ndarray:
        """The rotation as a matrix, float64 of shape [3, 3] (Rodrigues' formula)."""
        angle = np.radians(np.linalg.norm(self.rotation))
        if angle == 0:
            return np.eye(3)
        x, y, z = np.array(self.rotation) / np.linalg.norm(self.rotation)
        cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross

    def world_mesh(self) -> Mesh:
        """The mesh in world space."""
        return self.mesh.transformed(
            rotation=self.rotation_matrix(), translation=np.array(self.translation), scale=self.scale
        )


@dataclass(frozen=True, eq=False)
class Scene:
    """What is rendered.

    Args:
        bodies: One or more bodies; they cast shadows on each other and on themselves.
        light: Environment map, or SH coefficients [order², 3].
        camera: The camera.
        visibility: How visibility is computed.
        supersampling: Each pixel averages this many samples across and down, which smooths silhouettes.

    Raises:
        ValueError: naming the argument, what it got and what it accepts.
    """

    bodies: tuple[Body, ...]
    light: EnvironmentMap | np.ndarray
    camera: Camera
    visibility: Visibility = field(default_factory=Visibility)
    supersampling: int = 2

    def __post_init__(self) -> None:
        """Validate."""
        object.__setattr__(self, "bodies", tuple(self.bodies))
        if not self.bodies:
            raise ValueError("bodies: got none, expected one or more")
        if not isinstance(self.light, EnvironmentMap):
            light = np.array(self.light, np.float32)
            check.shape("light", light.shape, ("order²", 3))
            check.finite("light", light)
            sh.check_order(sh.order_of("light", light))
            object.__setattr__(self, "light", light)
        if isinstance(self.supersampling, bool) or self.supersampling not in range(1, 17):
            raise ValueError(f"supersampling: got {self.supersampling!r}, expected a whole number from 1 to 16")


# ---------------------------------------------------------------------------------------------- scene files

_CAMERA_KEYS = ("eye", "target", "up", "fov_y", "size", "near", "supersampling")
_LIGHT_KEYS = ("envmap", "sh", "rotation", "scale")
_VISIBILITY_KEYS = ("method", "directions", "softness", "order", "log", "base", "samples")
_PLACE_KEYS = ("albedo", "texture", "blockers", "rotation", "translation", "scale", "receivers")
_PRIMITIVES: dict[str, tuple[Callable[..., Mesh], tuple[str, ...]]] = {
    "plane": (plane, ("size", "segments")),
    "icosphere": (icosphere, ("radius", "subdivisions")),
}


def load_scene(path: str | Path) -> Scene:
    """Read a scene file.

    Args:
        path: A TOML file; paths in it are relative to it. README.md lists its keys.

    Raises:
        SceneError: for what the file says wrongly: it names the table, the key, what it got and what it accepts.
        FileNotFoundError: for a file that is not there.
    """
    if sys.version_info >= (3, 11):
        import tomllib
    else:
        import tomli as tomllib

    path = Path(path)
    try:
        with path.open("rb") as file:
            tables = tomllib.load(file)
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise SceneError(f"{path}: not valid TOML: {error}") from error

    def build(where: str, make: Callable[[], Any]) -> Any:
        try:
            return make()
        except FileNotFoundError as error:
            raise FileNotFoundError(f"{path}: {where}: {error}") from error
        except (ValueError, TypeError) as error:
            raise SceneError(f"{path}: {where}: {error}") from error

    build("the scene", lambda: check.known_keys("table", tables, ("camera", "light", "visibility", "body")))
    for name in ("camera", "light", "body"):
        if name not in tables:
            raise SceneError(f"{path}: [{name}] is missing; a scene has [camera], [light] and at least one [[body]]")
    if not isinstance(tables["body"], list):
        raise SceneError(f"{path}: [body]: expected [[body]], since a scene may have several")
    for name in ("camera", "light", "visibility"):
        build(f"[{name}]", functools.partial(_check_table, tables.get(name, {})))
    bodies = tuple(
        build(f"[[body]] number {number}", functools.partial(_body, table, path.parent))
        for number, table in enumerate(tables["body"], start=1)
    )
    light = build("[light]", lambda: _light(tables["light"], path.parent))
    camera = build("[camera]", lambda: _camera(tables["camera"]))
    visibility = build("[visibility]", lambda: _visibility(tables.get("visibility", {})))
    supersampling = tables["camera"].get("supersampling", Scene.supersampling)
    return build("the scene", lambda: Scene(bodies, light, camera, visibility, supersampling))


def _camera(table: dict[str, Any]) -> Camera:
    check.known_keys("key", table, _CAMERA_KEYS)
    for key in ("eye", "target"):
        if key not in table:
            raise ValueError(f"{key}: missing, expected three numbers")
    for key in ("eye", "target", "up"):
        _vector(table, key)
    for key in ("fov_y", "near"):
        _number(table, key, 1.0)
    _integer(table, "supersampling")
    _vector(table, "size", 2)
    return Camera.look_at(**{key: value for key, value in table.items() if key != "supersampling"})


def _light(table: dict[str, Any], folder: Path) -> EnvironmentMap | np.ndarray:
    check.known_keys("key", table, _LIGHT_KEYS)
    if ("envmap" in table) == ("sh" in table):
        raise ValueError('expected either envmap = "FILE" or sh = [[r, g, b], …]')
    rotation, scale = _number(table, "rotation", 0.0), _number(table, "scale", 1.0)
    if scale < 0:
        raise ValueError(f"scale: got {scale!r}, expected a factor of 0 or more")
    if "envmap" in table:
        light = EnvironmentMap.read(_file(table, "envmap", folder))
        light = light.rotated(rotation) if rotation else light
        return light.scaled(scale) if scale != 1 else light
    if not isinstance(table["sh"], list):
        raise ValueError(f"sh: got {table['sh']!r}, expected [[r, g, b], …]")
    coefficients = np.array([_vector({"sh": row}, "sh") for row in table["sh"]], np.float64).reshape(-1, 3)
    angle = np.radians(rotation)
    about_y = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    return scale * sh.rotation_matrix(sh.order_of("sh", coefficients), about_y) @ coefficients


def _visibility(table: dict[str, Any]) -> Visibility:
    check.known_keys("key", table, _VISIBILITY_KEYS)
    for key in ("directions", "order", "samples"):
        _integer(table, key)
    _number(table, "softness", 1.0)
    return Visibility(**table)


def _body(table: dict[str, Any], folder: Path) -> Body:
    _check_table(table)
    if ("mesh" in table) == ("primitive" in table):
        raise ValueError(f'expected either mesh = "FILE" or primitive = one of {", ".join(map(repr, _PRIMITIVES))}')
    if "albedo" in table and "texture" in table:
        raise ValueError("expected either albedo or texture")
    if "primitive" in table:
        check.choice("primitive", table["primitive"], _PRIMITIVES)
        make, shape_keys = _PRIMITIVES[table["primitive"]]
        check.known_keys("key", table, ("primitive", *shape_keys, *_PLACE_KEYS))
        _number(table, "radius", 1.0)
        for key in ("subdivisions", "segments"):
            _integer(table, key, pair=key == "segments")
        if isinstance(table.get("size"), list):
            _vector(table, "size", 2)
        else:
            _number(table, "size", 1.0)
        mesh = make(**{key: table[key] for key in shape_keys if key in table})
    else:
        check.known_keys("key", table, ("mesh", *_PLACE_KEYS))
        mesh = load_mesh(_file(table, "mesh", folder))
    place = {key: table[key] for key in _PLACE_KEYS if key in table}
    if "texture" in place:
        pixels = read_image(_file(table, "texture", folder))
        place["texture"] = np.repeat(pixels[..., :1], 3, axis=2) if pixels.shape[2] < 3 else pixels[..., :3]
    for key in ("albedo", "rotation", "translation"):
        _vector(table, key)
    _integer(table, "blockers")
    _number(table, "scale", 1.0)
    return Body(mesh, **place)


def _check_table(table: object) -> None:
    if not isinstance(table, dict):
        raise ValueError(f"got {table!r}, expected a table of keys")


def _is_number(value: object) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and bool(np.isfinite(value))


def _number(table: dict[str, Any], key: str, default: float) -> float:
    value = table.get(key, default)
    if not _is_number(value):
        raise ValueError(f"{key}: got {value!r}, expected a finite number")
    return value


def _integer(table: dict[str, Any], key: str, *, pair: bool = False) -> None:
    value = table.get(key, 1)
    values = value if pair and isinstance(value, list) and len(value) == 2 else [value]
    if any(isinstance(each, bool) or not isinstance(each, int) for each in values):
        raise ValueError(f"{key}: got {value!r}, expected a whole number{' or two' if pair else ''}")


def _vector(table: dict[str, Any], key: str, count: int = 3) -> list[float]:
    value = table.get(key, [0.0] * count)
    if not (isinstance(value, list) and len(value) == count and all(map(_is_number, value))):
        raise ValueError(f"{key}: got {value!r}, expected {count} finite numbers")
    return value


def _file(table: dict[str, Any], key: str, folder: Path) -> Path:
    if not isinstance(table[key], str):
        raise ValueError(f"{key}: got {table[key]!r}, expected a file name")
    path = folder / table[key]
    if not path.is_file():
        raise FileNotFoundError(f"{key}: no such file: {path}")
    return path
