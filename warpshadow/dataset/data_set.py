"""The scenes of a recipe, by their numbers, and which meshes and maps each split draws from."""

import functools
import hashlib
import itertools
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Generic, NamedTuple, TypeVar

import warp as wp

from warpshadow import check
from warpshadow.assets.light import EnvironmentMap
from warpshadow.assets.mesh_files import MESH_SUFFIXES
from warpshadow.dataset.recipe import Recipe, RecipeError
from warpshadow.device.progress import progress_bar
from warpshadow.scene.body import Body
from warpshadow.scene.random_scenes import DrawnScene, RandomScenes, primitives
from warpshadow.scene.visibility import AUTO, SPHERE_METHODS
from warpshadow.spheres import Spheres, fit_spheres

Item = TypeVar("Item")

_MAP_SUFFIXES = (".exr", ".hdr", ".pic")

_CACHED_BODIES = 64
_CACHED_MAPS = 16  # how many files a process keeps in memory; it reads others again when a scene has them
_LISTED_FAULTS = 10  # files that an error names at most


class SplitAssets(NamedTuple):
    """Assets that a split draws from."""

    meshes: tuple[str, ...]  # names of files in the folder of meshes, or of simple shapes
    maps: tuple[str, ...] | None  # names of files in the folder of maps; None where light is drawn


class DataSet:
    """The scenes of a recipe. To make one reads each mesh and map once, and fits the spheres that are not fitted yet.

    A mesh or map belongs to a split by a hash of the seed and of its content. So a copy under another name is in the
    same split, and files that are added move no others. Sending a data set to other processes is cheap: they read the
    files themselves.

    Args:
        recipe: Its recipe.
    Attributes:
        recipe: Its recipe.
        stocks: The assets of each split, by its name.
        hashes: Of each mesh and map, by ``meshes`` and ``maps`` and then by names.
    Raises:
        RecipeError: for meshes and maps that cannot be used, all named, and for a split without any.
    """

    def __init__(self, recipe: Recipe, *, device: wp.DeviceLike = "cpu", progress: bool = True):
        check.instance("recipe", recipe, Recipe, "a Recipe; load_recipe(path) reads one")
        render_device = check.device("device", device)
        self.recipe, self.device = recipe, str(render_device)
        for split in recipe.splits:
            if not self.numbers(split):
                raise RecipeError(f"[splits]: {split} got none of the {recipe.images} images, expected one or more")
        for cache in (_read_body, _read_map):
            cache.cache_clear()  # of files as they were
        fits = recipe.visibility.method in (*SPHERE_METHODS, AUTO) or "spheres" in recipe.layers
        arguments = {"blockers": recipe.blockers, "creased": recipe.creased, "fits": fits, "device": self.device}
        self._read_mesh = functools.partial(_read_body, **arguments)
        self.hashes: dict[str, dict[str, str]] = {}
        if recipe.meshes is None:
            self.hashes["meshes"] = {body.name: body.mesh.content_hash for body in primitives()}
            self._primitives = [_with_fitted_spheres(body, self.device) if fits else body for body in primitives()]
        else:
            self.hashes["meshes"] = _hashes(
                recipe.meshes, "meshes", MESH_SUFFIXES, lambda path: self._read_mesh(path).content_hash, progress
            )
        if recipe.maps is not None:
            self.hashes["maps"] = _hashes(
                recipe.maps, "maps", _MAP_SUFFIXES, lambda path: _read_map(path).content_hash, progress
            )
        self.stocks = {split: self._split_assets(split) for split in recipe.splits}

    def __repr__(self) -> str:
        splits = ", ".join(f"{split} {len(self.numbers(split))}" for split in self.recipe.splits)
        return f"DataSet({splits} images of {self.recipe.size[0]} × {self.recipe.size[1]})"

    def _split_assets(self, split: str) -> SplitAssets:
        """The assets of a split; RecipeError if there are none."""
        names = {}
        for kind, hashes in self.hashes.items():
            split_of_names = {name: _split_of(self.recipe, content) for name, content in hashes.items()}
            names[kind] = tuple(name for name, name_split in split_of_names.items() if name_split == split)
            if not names[kind]:
                counts = ", ".join(f"{item} {list(split_of_names.values()).count(item)}" for item in self.recipe.splits)
                raise RecipeError(
                    f"[splits]: {split} got none of the {len(hashes)} {kind} ({counts}), expected one or more: try "
                    "another seed, a larger part, or more files"
                )
        return SplitAssets(names["meshes"], names.get("maps"))

    def numbers(self, split: str) -> range:
        """Numbers of the images of a split; splits follow one another."""
        check.choice("split", split, self.recipe.splits)
        split_ends = [round(self.recipe.images * part) for part in itertools.accumulate(self.recipe.splits.values())]
        starts = dict(zip(self.recipe.splits, itertools.pairwise([0, *split_ends]), strict=True))
        return range(*starts[split])

    def split_of(self, number: int) -> str:
        """The split of an image, by its number."""
        check.index("number", number, self.recipe.images, "image")
        return next(split for split in self.recipe.splits if number in self.numbers(split))

    def scenes(self, split: str) -> RandomScenes:
        """The scenes of a split, by the numbers of their images: ``scenes(split)[number]``."""
        recipe, stock = self.recipe, self.stocks[split]
        bodies: Sequence[Body]
        if recipe.meshes is None:
            bodies = [body for body in self._primitives if body.name in stock.meshes]
        else:
            bodies = _LazyFiles(recipe.meshes, stock.meshes, lambda path: self._read_mesh(path).body)
        maps = None if recipe.maps is None else _LazyFiles(recipe.maps, stock.maps or (), _read_map)
        arguments = recipe.visibility, recipe.supersampling, maps, recipe.ranges, recipe.bounces
        return RandomScenes(recipe.seed, recipe.images, recipe.size, bodies, *arguments)

    def draw(self, number: int) -> DrawnScene:
        """Draw the scene of an image."""
        return self.scenes(self.split_of(number)).draw(number)

    def __len__(self) -> int:
        """Number of images."""
        return self.recipe.images


def _split_of(recipe: Recipe, content: str) -> str:
    """The split that a content hash belongs to."""
    position = int(hashlib.sha256(f"{recipe.seed} {content}".encode()).hexdigest()[:16], 16) / 16**16
    split_ends = itertools.accumulate(recipe.splits.values())
    return next(
        (split for split, end in zip(recipe.splits, split_ends, strict=True) if position < end), [*recipe.splits][-1]
    )


class _LazyFiles(Sequence[Item], Generic[Item]):
    """Files of a folder, each read when it is asked for."""

    def __init__(self, folder: Path, names: Sequence[str], read: Callable[[Path], Item]):
        self._folder, self._names, self._read = folder, names, read

    def __len__(self) -> int:
        return len(self._names)

    def __getitem__(self, position):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # all warnings about a file were given when the data set was made
            return self._read(self._folder / self._names[position])


class _ReadMesh(NamedTuple):
    """A mesh as it was read."""

    body: Body  # with its spheres, creased if that is wanted
    content_hash: str  # of the file's content, with its colors and texture, but not how it is creased


@functools.lru_cache(_CACHED_BODIES)
def _read_body(path: Path, blockers: int | str, creased: float | None, fits: bool, device: str) -> _ReadMesh:
    body = Body(path, blockers=blockers)
    content_hash = body.mesh.content_hash
    colors = body.albedo if body.texture is None else body.texture
    if body.texture is not None or body.mesh.colors is not None:
        content_hash = hashlib.sha256(content_hash.encode() + colors.tobytes()).hexdigest()
    body = body if creased is None else body.creased(creased)
    return _ReadMesh(_with_fitted_spheres(body, device) if fits else body, content_hash)


def _with_fitted_spheres(body: Body, device: str) -> Body:
    """The body with its fitted spheres; a flat body has none and blocks as a plane."""
    if isinstance(body.blockers, Spheres) or body.mesh.is_flat:
        return body
    return replace(body, blockers=fit_spheres(body.mesh, body.blockers, device=device).spheres)


@functools.lru_cache(_CACHED_MAPS)
def _read_map(path: Path) -> EnvironmentMap:
    return EnvironmentMap.read(path)


def _hashes(
    folder: Path, noun: str, suffixes: Sequence[str], hash_of: Callable[[Path], str], progress: bool
) -> dict[str, str]:
    """Hashes of the files below a folder, by their names in it; RecipeError names all faults."""
    paths = sorted(path for path in folder.rglob("*") if path.suffix.lower() in suffixes and path.is_file())
    if not paths:
        raise RecipeError(f"{noun}: got the folder {folder} without any, expected files {', '.join(suffixes)}")
    hashes, faults = {}, []
    with progress_bar(len(paths), f"reading {noun}", "file", shows=progress) as bar:
        for path in paths:
            try:
                with check.located(str(path)):
                    hashes[path.relative_to(folder).as_posix()] = hash_of(path)
            except (ValueError, OSError) as fault:
                faults.append(str(fault).replace(f"{path}: mesh: {path}: ", f"{path}: "))
            bar.update()
    if faults:
        rest_text = f"\nand {len(faults) - _LISTED_FAULTS} more" * (len(faults) > _LISTED_FAULTS)
        listed = "\n".join(faults[:_LISTED_FAULTS])
        raise RecipeError(f"{noun}: got {len(faults)} of {len(paths)} that cannot be used:\n{listed}{rest_text}")
    return hashes
