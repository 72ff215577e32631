"""Scene files: TOML, checked key by key (README.md lists the keys)."""

import functools
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from warpshadow import check, sh
from warpshadow.camera import Camera
from warpshadow.image import read_image
from warpshadow.light import EnvironmentMap
from warpshadow.mesh import Mesh, icosphere, load_mesh, plane
from warpshadow.scene import Body, Scene, Visibility

_CAMERA_KEYS = ("eye", "target", "up", "fov_y", "size", "near", "supersampling")
_LIGHT_KEYS = ("envmap", "sh", "rotation", "scale")
_VISIBILITY_KEYS = ("method", "directions", "softness", "order", "log", "base", "samples")
_PLACE_KEYS = ("albedo", "texture", "blockers", "rotation", "translation", "scale", "receivers")
_PRIMITIVES: dict[str, tuple[Callable[..., Mesh], tuple[str, ...]]] = {
    "plane": (plane, ("size", "segments")),
    "icosphere": (icosphere, ("radius", "subdivisions")),
}


class SceneError(ValueError):
    """A scene file that cannot be used: the message says where and what is accepted."""


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
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such scene file")
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
