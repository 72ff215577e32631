"""Recipes: TOML files that describe a data set, checked key by key (README.md lists the keys)."""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import TypeAlias

from warpshadow import check
from warpshadow.check import AnyPath
from warpshadow.dataset.layers import LAYERS
from warpshadow.scene import toml_tables
from warpshadow.scene.random_scenes import Ranges
from warpshadow.scene.scene import Bounces, Scene, check_bounces, check_supersampling
from warpshadow.scene.toml_tables import Table
from warpshadow.scene.visibility import AUTO, FULL_LIGHT_METHODS, Visibility

Plain: TypeAlias = "dict[str, Plain] | list[Plain] | str | int | float | None"  # values that JSON has

_LAYERS = (*LAYERS, "spheres", "light")  # parts of each scene that may be written

FORMATS = ("exr", "png")  # file formats of layers

_KEYS = {
    "bodies": (
        *("meshes", "blockers", "creased", "count", "size", "upright", "gap", "albedo", "ground_albedo"),
        *("glossy", "roughness", "metal"),
    ),
    "light": ("maps", "rotation", "scale", "radius", "bounces"),
    "camera": ("size", "supersampling", "fov_y", "elevation", "distance"),
    "visibility": None,
    "splits": None,
}
"""The tables of a recipe and their keys, but where others know these."""


class RecipeError(ValueError):
    """A recipe that cannot be used: the message names the place and the accepted values."""


@dataclass(frozen=True, eq=False)
class Recipe:
    """Description of a data set.

    Args:
        images: Number of images in all splits together.
        seed: Number of the data set, 0 or more.
        shard: Images in a shard; the last one of a split has fewer.
        layers: Written for each scene: some of :mod:`warpshadow.dataset.layers`, "spheres", "light".
        format: Of the layers of pixels: "exr", as they are, or "png", in 8 and 16 bits.
        splits: Part of the images, and about that part of the meshes and maps, by the name of the split; their sum
            is 1.
        meshes: Folder of meshes, searched recursively; None for simple shapes.
        blockers: Spheres that are fitted to each mesh of the folder, or "auto" for as many as it needs.
        creased: The meshes of the folder are parted where faces bend by more [degrees], 0 to 180; None for nowhere. See
            :meth:`warpshadow.Mesh.creased`.
        maps: Folder of environment maps; None for skies and lamps that are drawn.
        size: Width and height of the images [pixels].
        ranges: Ranges of poses, colors, light and cameras.
        visibility, supersampling, bounces: As of a :class:`warpshadow.Scene`.
    """

    images: int
    seed: int = 0
    shard: int = 200
    layers: tuple[str, ...] = ("color", "shadow", "depth", "normals")
    format: str = "exr"
    splits: Mapping[str, float] = field(default_factory=lambda: {"train": 1.0})
    meshes: Path | None = None
    blockers: int | str = 64
    creased: float | None = None
    maps: Path | None = None
    size: tuple[int, int] = (128, 128)
    ranges: Ranges = Ranges()
    visibility: Visibility = field(default_factory=Visibility)
    supersampling: int = Scene.supersampling
    bounces: Bounces = 0

    def __post_init__(self) -> None:
        check.integer("images", self.images)
        check.integer("seed", self.seed, minimum=0)
        check.integer("shard", self.shard, unit="images")
        check.instance("layers", self.layers, (list, tuple), f"a list of some of {', '.join(map(repr, _LAYERS))}")
        for layer in self.layers:
            check.choice("layers", layer, _LAYERS)
        if not self.layers or len(set(self.layers)) < len(self.layers):
            raise ValueError(f"layers: got {check.described(self.layers)}, expected one or more, each once")
        object.__setattr__(self, "layers", tuple(self.layers))
        check.choice("format", self.format, FORMATS)
        object.__setattr__(self, "splits", _checked_splits(self.splits))
        if self.blockers != AUTO:
            check.integer("blockers", self.blockers, minimum=0)
        if self.creased is not None and not (check.is_number(self.creased) and 0 <= self.creased <= 180):
            raise ValueError(f"creased: got {check.described(self.creased)}, expected degrees from 0 to 180")
        object.__setattr__(self, "visibility", self.visibility.with_method())
        shows_all = self.visibility.method in (*FULL_LIGHT_METHODS, AUTO)
        for name in ("glossy", "radius"):
            if getattr(self.ranges, name) and not shows_all:
                methods = ", ".join(map(repr, FULL_LIGHT_METHODS))
                raise ValueError(
                    f"{name}: got {getattr(self.ranges, name)}, which {self.visibility.method!r} does not show, "
                    f"expected none, or method = one of {methods}"
                )
        object.__setattr__(self, "size", check.image_size(self.size))
        check_supersampling(self.supersampling)
        check_bounces(self.bounces)

    def plain(self) -> dict[str, Plain]:
        """All that decides the bits of the images but the files' contents, as JSON has it."""
        table = {item.name: getattr(self, item.name) for item in fields(self) if item.name not in ("meshes", "maps")}
        tables = {"ranges": vars(self.ranges), "visibility": vars(self.visibility), "splits": dict(self.splits)}
        plain: dict[str, Plain] = json.loads(json.dumps(table | tables))
        return plain


def _checked_splits(splits: object) -> dict[str, float]:
    check.instance("splits", splits, Mapping, "parts by names, such as train = 0.8, val = 0.2")
    parts = {}
    for name, part in splits.items():  # type: ignore[attr-defined]
        if not (isinstance(name, str) and name.isidentifier()):
            raise ValueError(f"splits: got the name {name!r}, expected letters, digits and _ alone")
        if not (check.is_number(part) and 0 < part <= 1):
            raise ValueError(f"{name}: got {check.described(part)}, expected a part of all images, above 0 up to 1")
        parts[name] = float(part)
    total = math.fsum(parts.values())
    if abs(total - 1) > 1e-6:
        raise ValueError(f"splits: got parts with the sum {total:g}, expected 1")
    return parts


def load_recipe(path: AnyPath) -> Recipe:
    """Read a recipe.

    Args:
        path: A TOML file; paths in it are relative to it. README.md lists its keys.
    Raises:
        RecipeError: for a mistake in the file: it names the table, the key, the value it got and the accepted values.
        FileNotFoundError: for a file or folder that is not there.
    """
    path = check.path("path", path)
    with check.located(str(path), RecipeError):
        return _recipe(toml_tables.read(path, "recipe"), path.parent)


def _recipe(table: Table, folder: Path) -> Recipe:
    plain = ("images", "seed", "shard", "layers", "format")
    check.known_keys("the recipe", table, (*plain, *_KEYS))
    bodies, light, camera, visibility, splits = (dict(_table(table, name)) for name in _KEYS)
    recipe = toml_tables.make(Recipe, _pop_keys(dict(table), *plain))
    with check.located("[bodies]"):
        result = _pop_keys(bodies, "blockers", "creased")
        if "meshes" in bodies:
            result["meshes"] = _folder(bodies, "meshes", folder)
        elif result:
            raise ValueError(f"{next(iter(result))}: got it without meshes, for which it is")
        recipe = replace(recipe, **result, ranges=replace(recipe.ranges, **bodies))
    with check.located("[light]"):
        result = _pop_keys(light, "bounces")
        if "maps" in light:
            result["maps"] = _folder(light, "maps", folder)
        elif "rotation" in light:
            raise ValueError("rotation: got it without maps, which it turns")
        recipe = replace(recipe, **result, ranges=replace(recipe.ranges, **light))
    with check.located("[camera]"):
        result = _pop_keys(camera, "size", "supersampling")
        recipe = replace(recipe, **result, ranges=replace(recipe.ranges, **camera))
    with check.located("[visibility]"):
        recipe = replace(recipe, visibility=Visibility.of(visibility))
    if "splits" in table:
        with check.located("[splits]"):
            recipe = replace(recipe, splits=splits)
    return recipe


def _pop_keys(table: Table, *keys: str) -> Table:
    """Pop some keys from a table and return them."""
    return {key: table.pop(key) for key in keys if key in table}


def _table(values: Table, name: str) -> Table:
    with check.located(f"[{name}]"):
        table: Table = values.get(name, {})
        toml_tables.check_table(table)
        known_keys = _KEYS[name]
        if known_keys is not None:
            check.known_keys("", table, known_keys)
        return table


def _folder(table: Table, key: str, folder: Path) -> Path:
    """Take the path of a folder that is there out of a table."""
    value = table.pop(key)
    if not isinstance(value, str):
        raise ValueError(f"{key}: got {check.described(value)}, expected the name of a folder")
    if not (folder / value).is_dir():
        raise FileNotFoundError(f"{key}: no such folder: {folder / value}")
    return folder / value
