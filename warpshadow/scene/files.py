"""Scene files: TOML, checked key by key (README.md lists the keys), and written so that they read back the same."""

import difflib
import functools
import inspect
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, fields
from pathlib import Path

import numpy as np
import numpy.typing as npt

from warpshadow import check
from warpshadow.assets import files
from warpshadow.assets.camera import Camera, ImageSize
from warpshadow.assets.camera_conventions import HALF_PIXEL
from warpshadow.assets.image import write_image
from warpshadow.assets.known_light import as_light
from warpshadow.assets.light import EnvironmentMap, KnownLightArgument
from warpshadow.assets.mesh import Mesh
from warpshadow.assets.mesh_files import MESH_SUFFIXES
from warpshadow.assets.primitives import icosphere, infinite_ground, plane
from warpshadow.assets.sky import synthetic_sky
from warpshadow.check import AnyPath
from warpshadow.maths import sh
from warpshadow.scene import toml_tables
from warpshadow.scene.body import ARRAY_SUFFIX, Body
from warpshadow.scene.material import GLOSS_ARGUMENTS
from warpshadow.scene.scene import Bounces, Scene, check_bounces, check_scene, check_supersampling
from warpshadow.scene.toml_tables import Table
from warpshadow.scene.visibility import METHODS_OF_SETTING, Visibility
from warpshadow.spheres import Spheres

_VIEW_KEYS = ("eye", "target", "up", "fov_y")
_FRAMING_KEYS = ("framing", "direction", "margin")
_PINHOLE_KEYS = ("intrinsics", "rotation", "translation")
_CAMERA_KEYS = (*_VIEW_KEYS, *_PINHOLE_KEYS, "pixel_centers", "size", "near")
_PIXEL_CENTERS = {"half": np.zeros((3, 3)), "whole": HALF_PIXEL}
_LIGHT_KEYS = ("envmap", "sky", "sh", "sun", "rotation", "scale", "radius", "center", "bounces")
_PLACE_KEYS = (*(field.name for field in fields(Body) if field.name != "mesh"), "spheres", "on_ground", "creased")
_PRIMITIVES: dict[str, Callable[..., Mesh]] = {
    "plane": plane,
    "icosphere": icosphere,
    "infinite_ground": infinite_ground,
}
_SHAPE_KEYS = {name: tuple(inspect.signature(make).parameters) for name, make in _PRIMITIVES.items()}
_KEYS = {
    "[camera]": (*_CAMERA_KEYS, *_FRAMING_KEYS, "supersampling"),
    "[light]": _LIGHT_KEYS,
    "[visibility]": ("method", *METHODS_OF_SETTING),
    "[[body]]": ("mesh", "primitive", *(key for keys in _SHAPE_KEYS.values() for key in keys), *_PLACE_KEYS),
}
"""Keys that each table of a scene file may have."""


class SceneError(ValueError):
    """A scene file that cannot be used: the message names the place and the accepted values."""


def load_scene(
    path: AnyPath, *, bounces: Bounces | None = None, size: ImageSize | None = None, **settings: object
) -> Scene:
    """Read a scene file.

    Args:
        path: A TOML file; paths in it are relative to it. README.md lists its keys.
        bounces: How often light bounces, in place of the file's.
        size: Width and height of the image [pixels], or one number for both, in place of the file's. The vertical field
            of view stays, unless the camera is framed.
        settings: Settings of visibility in place of the file's, such as ``method="log-sh"``. A file may hold settings
            for several methods; settings that the method does not read are left out.
    Raises:
        SceneError: for a mistake in the file: it names the table, the key, the value it got and the accepted values.
        FileNotFoundError: for a file that is not there.
    """
    path = check.path("path", path)
    if path.suffix.lower() in MESH_SUFFIXES:
        raise SceneError(
            f'{path}: got a mesh, expected a scene file, which names it: [[body]] mesh = "{path.name}"; '
            "default_scene(path) makes a scene of it alone, as the commands render and view do"
        )
    with check.located(str(path), SceneError):
        table = toml_tables.read(path, "scene file")
        if "scene" in table and not {"camera", "body"} & {*table}:
            raise ValueError(
                f"got a fit file, expected a scene file, such as the one that it names, {table['scene']}; "
                f"warpshadow fit {path.name} -o FOLDER runs it, and FOLDER/scene.toml is the result"
            )
        return _scene(table, path.parent, bounces, size, settings)


def _scene(scene: Table, folder: Path, bounces: Bounces | None, size: ImageSize | None, settings: Table) -> Scene:
    with check.located("the scene"):
        _check_keys("", scene, ("camera", "light", "visibility", "body"), noun="table")
    for name in ("camera", "light", "body"):
        if name not in scene:
            raise ValueError(f"[{name}] is missing; a scene has [camera], [light] and at least one [[body]]")
    bodies = []
    for where, table in toml_tables.numbered(scene, "body"):
        with check.located(where):
            bodies.append(_body(table, folder))
    with check.located("[light]"):
        light = _light(scene["light"], folder)
        if bounces is None:
            bounces = scene["light"].get("bounces", Scene.bounces)
            check_bounces(bounces)
    with check.located("[camera]"):
        toml_tables.check_table(scene["camera"])
        _check_keys("[camera]", scene["camera"])
        camera_table = dict(scene["camera"])
        supersampling = camera_table.pop("supersampling", Scene.supersampling)
        check_supersampling(supersampling)
        unframed_key = next(
            (key for key in _FRAMING_KEYS if key in camera_table and "framing" not in camera_table), None
        )
        if unframed_key is not None:
            raise ValueError(f'{unframed_key} goes with framing = "auto", in place of eye and target')
        if "framing" in camera_table:
            camera = _framing(camera_table | ({} if size is None else {"size": size}), bodies)
        else:
            camera = parse_camera(camera_table)
            camera = camera if size is None else camera.with_size(size)
    with check.located("[visibility]"):
        value = scene.get("visibility", {})
        toml_tables.check_table(value)
        _check_keys("[visibility]", value)
        visibility = Visibility.of(value | settings)  # a file may hold settings for another --method
    with check.located("the scene"):
        return Scene(tuple(bodies), light, camera, visibility, supersampling, bounces)


def _framing(table: Table, bodies: Sequence[Body]) -> Camera:
    """A camera from a table that leaves it to show all bodies."""
    check.choice("framing", table.pop("framing"), ("auto",))
    placed = next((key for key in ("eye", "target", *_PINHOLE_KEYS) if key in table), None)
    if placed is not None:
        raise ValueError(f"{placed}: got it beside framing, which finds the place of the camera; expected one of them")
    return toml_tables.make(functools.partial(Camera.framing, bodies), table)


def _check_keys(name: str, table: Table, known: Iterable[str] = (), *, noun: str = "key") -> None:
    """Raise ValueError for a key that is not known in a table; where others have it the message names them."""
    known = tuple(known) or _KEYS[name]
    for key in table:
        is_typo = bool(difflib.get_close_matches(key, known, n=1, cutoff=0.9))  # "direction", of another table
        others = [] if is_typo else [other for other, keys in _KEYS.items() if key in keys]
        if key not in known and others and name not in others:
            raise ValueError(f"got {key}, expected it in {' or '.join(others)}")
    check.known_keys("", table, known, noun=noun)


def parse_camera(table: Table) -> Camera:
    """A camera from its table: eye and target, or intrinsics and world-to-camera [R | t]."""
    toml_tables.check_table(table)
    check.known_keys("", table, _CAMERA_KEYS)
    if not any(key in table for key in ("eye", "target", *_PINHOLE_KEYS)):
        raise ValueError('eye: missing, expected eye and target, or framing = "auto", or intrinsics and the rest')
    if not any(key in table for key in _PINHOLE_KEYS):
        return toml_tables.make(Camera.look_at, table)
    mixed = next((key for key in _VIEW_KEYS if key in table), None)
    if mixed is not None:
        raise ValueError(
            f"{mixed}: got it beside intrinsics, rotation or translation; "
            f"expected either {', '.join(_VIEW_KEYS)} or {', '.join(_PINHOLE_KEYS)}"
        )
    width, height = check.image_size(table.get("size", check.NOTHING))
    arguments = {key: table[key] for key in table if key not in ("size", "pixel_centers")}
    arguments |= {"width": width, "height": height}
    centers = table.get("pixel_centers", "half")
    check.choice("pixel_centers", centers, _PIXEL_CENTERS)
    if "intrinsics" in table:
        arguments["intrinsics"] = check.array("intrinsics", table["intrinsics"], (3, 3)) + _PIXEL_CENTERS[centers]
    return toml_tables.make(Camera, arguments)


def _light(table: Table, folder: Path) -> KnownLightArgument:
    toml_tables.check_table(table)
    _check_keys("[light]", table)
    if sum(key in table for key in ("envmap", "sky", "sh")) != 1:
        raise ValueError('expected one of envmap = "FILE", sky = {} and sh = [[r, g, b], …]')
    rotation = check.number("rotation", table.get("rotation", 0.0))
    scale = check.nonnegative("scale", table.get("scale", 1.0))
    shell = {key: table[key] for key in ("radius", "center") if key in table}
    if shell and "envmap" not in table:
        raise ValueError(f'{next(iter(shell))}: got it without envmap, expected envmap = "FILE" beside it')
    if "sh" in table and "sun" in table:
        raise ValueError("sun: got it beside sh, expected envmap or sky beside it, which hold one")
    if "sh" in table:
        coefficients = check.numbers("sh", table["sh"], expected="rows of 3 finite numbers", dtype=np.float64)
        check.shape("sh", coefficients.shape, ("order²", 3), "rows of 3 finite numbers")
        check.finite("sh", coefficients)
        sh.order_of("sh", coefficients)
        return turned_light(coefficients, rotation, scale)
    if "envmap" in table:
        envmap = EnvironmentMap.read(toml_tables.file(table, "envmap", folder), **shell)
    else:
        with check.located("sky"):
            envmap = toml_tables.make(synthetic_sky, table["sky"])
    if "sun" in table:
        with check.located("sun"):
            envmap = toml_tables.make(envmap.with_sun, table["sun"])
    return turned_light(envmap, rotation, scale)


def turned_light(light: KnownLightArgument, rotation: float, scale: float) -> KnownLightArgument:
    """Light as the keys ``rotation`` [degrees about +y] and ``scale`` make it of a map or of SH coefficients."""
    changed = as_light(light)
    changed = changed.rotated(rotation) if rotation else changed
    changed = changed.scaled(scale) if scale != 1 else changed
    return changed.as_argument


def _body(table: Table, folder: Path) -> Body:
    toml_tables.check_table(table)
    if not {"mesh", "primitive"} & {*table}:
        _check_keys("[[body]]", table)  # a misspelled "mesh"
    if ("mesh" in table) == ("primitive" in table):
        raise ValueError(f'expected either mesh = "FILE" or primitive = one of {", ".join(map(repr, _PRIMITIVES))}')
    for one, other in (("albedo", "texture"), ("blockers", "spheres")):
        if one in table and other in table:
            raise ValueError(f"expected either {one} or {other}")
    if "primitive" in table:
        check.choice("primitive", table["primitive"], _PRIMITIVES)
        make, shape_keys = _PRIMITIVES[table["primitive"]], _SHAPE_KEYS[table["primitive"]]
        _check_keys("[[body]]", table, ("primitive", *shape_keys, *_PLACE_KEYS))
        mesh: object = make(**{key: table[key] for key in shape_keys if key in table})
    else:
        _check_keys("[[body]]", table, ("mesh", *_PLACE_KEYS))
        mesh = toml_tables.file(table, "mesh", folder)
    place: Table = {"mesh": mesh} | {key: table[key] for key in _PLACE_KEYS if key in table}
    if "texture" in place:
        place["texture"] = toml_tables.file(table, "texture", folder)
    for name in ("albedo", "emission", *GLOSS_ARGUMENTS):
        if isinstance(place.get(name), str) and place[name].endswith(ARRAY_SUFFIX):
            place[name] = toml_tables.file(table, name, folder)
    if "spheres" in place:
        path = toml_tables.file(place, "spheres", folder)
        with check.located("spheres"):
            place["blockers"] = Spheres.read(path)
        del place["spheres"]
    on_ground = place.pop("on_ground", False)
    angle = place.pop("creased", None)
    body = Body(**place)
    if angle is not None:
        with check.located("creased"):
            body = body.creased(angle)
    if isinstance(on_ground, bool):
        return body.on_ground(body.translation) if on_ground else body
    check.instance("on_ground", on_ground, Mapping, "true or false, or a table such as {size = 2.0}")
    with check.located("on_ground"):
        if "foot" in on_ground:
            raise ValueError(f"foot: got {on_ground['foot']!r}, expected it as translation, a key of the body")
        check.known_keys("", on_ground, ("size",))
        if "size" in on_ground and "scale" in table:
            raise ValueError("size: got it beside the body's scale, expected one of them")
        return body.on_ground(body.translation, **on_ground)


# ---------------------------------------------------------------------------------------------- writing


_COMMENT = "written by warpshadow.write_scene, which replaces it and the files of its bodies"


def write_scene(scene: Scene, folder: AnyPath, *, stems: Sequence[str] | None = None) -> list[Path]:
    """Write a scene file and all that it names; :func:`load_scene` reads back the same scene, bit for bit.

    Args:
        folder: Made if it is not there. It gets scene.toml, light.exr for an environment map, and for a body called
            NAME NAME.obj, NAME.npz where it has spheres of its own, NAME.npy where it has a color for each vertex,
            NAME_roughness.npy and the like where it has one for each vertex or a texture of it, and where it has a
            texture of its color NAME.exr, with NAME.png and NAME.mtl for programs that draw OBJ files. NAME is body_N
            for body N (from 0) where its name is more than a word, or another's, or a file of the folder has it that
            this function did not write.
        stems: Names of the bodies' files in place of these, without suffixes.
    Returns:
        The files.
    """
    check_scene(scene)
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    written: list[Path] = []
    bodies = []
    names = [body.name for body in scene.bodies]
    path = folder / "scene.toml"
    others = {file.stem for file in folder.iterdir()} - _written_stems(path)
    stems = file_stems(scene, {"light", *others}) if stems is None else stems
    for body, stem in zip(scene.bodies, stems, strict=True):
        table, files = _write_body(body, folder / stem)
        if body.has_own_name or names.count(body.name) == 1:
            table["name"] = body.name
        bodies.append(table)
        written += files
    light, files_of_light = _write_light(scene.light, folder)
    written += files_of_light
    light["bounces"] = scene.bounces if scene.bounces == "all" else int(scene.bounces)
    visibility = {name: value for name, value in asdict(scene.visibility).items() if value is not None}
    camera = camera_table(scene.camera) | {"supersampling": scene.supersampling}
    tables = {"camera": camera, "light": light, "visibility": visibility, "body": bodies}
    toml_tables.write(path, tables, comment=_COMMENT)
    return [path, *written]


def _write_light(light: KnownLightArgument, folder: Path) -> tuple[Table, list[Path]]:
    """Write the file that the table of a light names, if it names one, and make the table, which ``_light`` reads."""
    if isinstance(light, np.ndarray):
        return {"sh": [_numbers(row) for row in light]}, []
    light.write(folder / "light.exr")
    shell = {} if light.radius is None else {"radius": light.radius, "center": light.center.tolist()}
    return {"envmap": "light.exr"} | shell, [folder / "light.exr"]


def _written_stems(path: Path) -> set[str]:
    """Names of the bodies' files of a scene file that was written before; none of others' scene files."""
    text = path.read_text("utf-8", errors="replace") if path.is_file() else ""
    return set(re.findall(r'^mesh = "(.*)\.obj"$', text, re.MULTILINE)) if text.startswith(f"# {_COMMENT}") else set()


def file_stems(scene: Scene, others: Iterable[str]) -> list[str]:
    """Names of the bodies' files, without suffixes: the bodies' own, or body_0 and so on where others have them."""
    names = [body.name for body in scene.bodies]
    lower_names, lower_others = [name.lower() for name in names], {name.lower() for name in others}
    return [
        name
        if re.fullmatch(r"[\w-]+", name)
        and lower_names.count(name.lower()) == 1
        and name.lower() not in lower_others
        and not name.startswith("body_")
        and not name.endswith((*GLOSS_ARGUMENTS, "emission"))
        else f"body_{number}"
        for number, name in enumerate(names)
    ]


def camera_table(camera: Camera) -> Table:
    """The table of a camera in a scene file, without loss."""
    return {
        "intrinsics": camera.intrinsics.tolist(),
        "rotation": camera.rotation.tolist(),
        "translation": camera.translation.tolist(),
        "size": [camera.width, camera.height],
        "near": float(camera.near),
    }


def _write_body(body: Body, stem: Path) -> tuple[Table, list[Path]]:
    """Write the files that a body's table names, and make the table."""
    mesh, arrays, colors, texture = (stem.with_suffix(suffix) for suffix in (".obj", ".npz", ARRAY_SUFFIX, ".exr"))
    body.mesh.write(mesh)
    table: Table = {"mesh": mesh.name}
    written = [mesh]
    if body.texture is not None:
        write_image(texture, body.texture)
        table["texture"] = texture.name
        written += [texture, *_write_material(mesh, body.texture)]
    elif np.ndim(body.albedo) == 1:
        table["albedo"] = _numbers(body.albedo)
    else:
        written.append(_write_array(colors, body.albedo))
        table["albedo"] = colors.name
    if not isinstance(body.blockers, Spheres):
        table["blockers"] = body.blockers
    elif not len(body.blockers):
        table["blockers"] = 0
    else:
        body.blockers.write(arrays)
        table["spheres"] = arrays.name
        written.append(arrays)
    place: Table = {"rotation": list(body.rotation), "translation": list(body.translation), "scale": float(body.scale)}
    for name in (*GLOSS_ARGUMENTS, "emission"):
        values = getattr(body, name)
        if values is None:
            continue
        if values.shape == (1,):
            place[name] = _numbers(values)[0]
        elif name == "emission" and values.ndim == 1:
            place[name] = _numbers(values)
        else:
            written.append(_write_array(stem.with_name(f"{stem.name}_{name}{ARRAY_SUFFIX}"), values))
            place[name] = written[-1].name
    if body.beam is not None:
        place["beam"] = list(body.beam)
    if body.self_shadows is not None:
        place["self_shadows"] = body.self_shadows
    if body.shadow_catcher:
        place["shadow_catcher"] = True
    return table | place | {"receivers": body.receivers}, written


def _write_array(path: Path, values: np.ndarray) -> Path:
    """Write an .npy file and return its path."""
    with files.atomic_write(path) as unfinished:
        np.save(unfinished, values)
    return path


def _write_material(mesh: Path, texture: np.ndarray) -> list[Path]:
    """Let an OBJ file name its texture, as a PNG, which other programs draw."""
    picture, material = mesh.with_suffix(".png"), mesh.with_suffix(".mtl")
    write_image(picture, texture)
    with files.atomic_write(material) as unfinished:
        unfinished.write_text(f"newmtl textured\nKd 1 1 1\nmap_Kd {picture.name}\n")
    with files.atomic_write(mesh) as unfinished:
        unfinished.write_text(f"mtllib {material.name}\nusemtl textured\n{mesh.read_text()}")
    return [picture, material]


def _numbers(values: npt.ArrayLike) -> list[float]:
    """The shortest numbers that read back as the same float32."""
    return [float(str(value)) for value in np.asarray(values, np.float32)]
