"""Shards: plain .tar files of samples, in the format of WebDataset, each written once, whole, with the same bits."""

import contextlib
import functools
import gc
import io
import json
import re
import tarfile
import warnings
from collections.abc import Generator, Iterator, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple

from warpshadow import check
from warpshadow.assets import files
from warpshadow.check import AnyPath
from warpshadow.dataset.data_set import DataSet
from warpshadow.dataset.recipe import Plain
from warpshadow.dataset.samples import render_sample
from warpshadow.device.parallel import thread_count
from warpshadow.device.progress import progress_bar
from warpshadow.device.workers import run_tasks
from warpshadow.spheres.fit import ALGORITHM_VERSION

INDEX = "dataset.json"  # index file beside the shards


class Shard(NamedTuple):
    """A .tar file of a data set."""

    name: str
    """File name: the split, and the number within it."""
    numbers: range
    """Numbers of its images."""


def shards_of(data_set: DataSet) -> list[Shard]:
    """The shards of a data set, split by split."""
    shards = []
    for split in data_set.recipe.splits:
        numbers, length = data_set.numbers(split), data_set.recipe.shard
        parts = [numbers[start : start + length] for start in range(0, len(numbers), length)]
        shards += [Shard(f"{split}-{place:06d}.tar", part) for place, part in enumerate(parts)]
    return shards


def write_shards(
    data_set: DataSet, folder: AnyPath, *, workers: int | None = None, progress: bool = True
) -> list[Path]:
    """Render the missing shards of a data set; the bits do not depend on the workers.

    A shard has a temporary name until it is whole. An interrupted run resumes at the unfinished shards. Each
    kind of warning is said once, with the number of the first image that draws it.

    Args:
        data_set: The data set to render.
        folder: Made if it is not there. It gets the shards and ``dataset.json``, their index.
        workers: Processes that render, which share the threads; by default one for each thread, on a GPU one. 1 is this
            process, on all threads.
    Returns:
        All shards, including the ones already there.
    Raises:
        FileExistsError: for a folder of another data set, and for one into which another process writes.
        ChildProcessError: for an image that a worker could not render; finished shards stay.
    """
    check.instance("data_set", data_set, DataSet, "a DataSet, as DataSet(load_recipe(path)) makes one")
    folder = check.path("folder", folder)
    folder.mkdir(parents=True, exist_ok=True)
    shards = shards_of(data_set)
    busy = FileExistsError(f"{folder}: another process writes into this folder")
    with files.file_lock(folder / INDEX, timeout=0, busy=busy):
        _prepare_folder(folder, describe(data_set))
        missing_shards = [shard for shard in shards if not (folder / shard.name).exists()]
        numbers = [number for shard in missing_shards for number in shard.numbers]
        default = thread_count() if data_set.device == "cpu" else 1
        count = default if workers is None else check.integer("workers", workers, unit="processes")
        rendered_images, warned_kinds = _render_all(data_set, numbers, count), set[str]()
        with (
            contextlib.closing(rendered_images),
            progress_bar(len(numbers), "rendering", "image", shows=progress) as bar,
        ):
            for shard in missing_shards:
                with _new_archive(folder / shard.name) as archive:
                    for number in shard.numbers:
                        sample, remarks = next(rendered_images)
                        _warn_once(remarks, number, warned_kinds)
                        _add(archive, number, sample)
                        bar.update()
    return [folder / shard.name for shard in shards]


class _Rendered(NamedTuple):
    """A rendered image, and the warnings it gave."""

    files: dict[str, bytes]  # by the ends of their names
    warnings: list[str]


def _render(data_set: DataSet, number: int) -> _Rendered:
    """Render an image, and keep the warnings."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        files = render_sample(data_set, number)
    gc.collect()  # renderers are reference cycles: without a collection, those of many images pile up to 1 GB
    gc.freeze()  # freeze the remaining objects: later collections skip them
    return _Rendered(files, [str(item.message) for item in caught])


def _warn_once(remarks: list[str], number: int, warned_kinds: set[str]) -> None:
    """Give each warning once for all images, ignoring names and numbers."""
    for remark in remarks:
        kind = re.sub(r"'[^']*'|[\d.]+", "", remark)
        if kind not in warned_kinds:
            check.warn(f"image {number}: {remark}")
        warned_kinds.add(kind)


def _render_all(data_set: DataSet, numbers: Sequence[int], workers: int) -> Generator[_Rendered, None, None]:
    """Render images, in the order of the numbers."""
    render = functools.partial(_render, data_set)
    if workers == 1:
        try:
            yield from map(render, numbers)
        finally:
            gc.unfreeze()  # of a process that has other things to do
        return
    early_images: dict[int, _Rendered] = {}
    with contextlib.closing(run_tasks(render, numbers, workers=workers)) as finished_images:
        for number in numbers:
            while number not in early_images:
                done_number, rendered_image, error = next(finished_images)
                if rendered_image is None:
                    raise ChildProcessError(f"image {done_number}: {error}") from error
                early_images[done_number] = rendered_image
            yield early_images.pop(number)


@contextlib.contextmanager
def _new_archive(path: Path) -> Iterator[tarfile.TarFile]:
    with (
        files.atomic_write(path) as temporary_path,
        tarfile.open(temporary_path, "w", format=tarfile.USTAR_FORMAT) as archive,
    ):
        yield archive


def _add(archive: tarfile.TarFile, number: int, sample: dict[str, bytes]) -> None:
    for ending, content in sorted(sample.items()):
        member = tarfile.TarInfo(f"{number:09d}.{ending}")  # of no user, and of 1970: always the same bits
        member.size = len(content)
        archive.addfile(member, io.BytesIO(content))


def describe(data_set: DataSet) -> dict[str, Plain]:
    """Everything that decides the bits of the shards, as stored in ``dataset.json``."""
    shards = shards_of(data_set)
    splits: dict[str, Plain] = {}
    for split, (meshes, maps) in data_set.stocks.items():
        numbers = data_set.numbers(split)
        names: list[Plain] = [shard.name for shard in shards if shard.numbers[0] in numbers]
        splits[split] = {
            "images": len(numbers),
            "shards": names,
            "meshes": list(meshes),
            "maps": None if maps is None else list(maps),
        }
    made_by = {"warpshadow": version("warpshadow"), "spheres": ALGORITHM_VERSION, "device": data_set.device[:4]}
    about = {"recipe": data_set.recipe.plain(), "splits": splits, "hashes": data_set.hashes, "made_by": made_by}
    plain: dict[str, Plain] = json.loads(json.dumps(about))
    return plain


def _prepare_folder(folder: Path, about: dict[str, Plain]) -> None:
    """Write the index, or compare it; remove partial files of an interrupted run."""
    path = folder / INDEX
    if path.exists():
        with check.located(str(path)):
            result = json.loads(path.read_text("utf-8"))
        if difference := _difference(result, about):
            raise FileExistsError(
                f"{folder}: got shards of another data set ({difference}), expected those of this one, or a new folder"
            )
    else:
        if others := sorted(item.name for item in folder.iterdir() if not item.name.startswith(".")):
            raise FileExistsError(f"{folder}: got a folder with {others[0]} in it, expected a new one or one of shards")
        with files.atomic_write(path) as temporary_path:
            temporary_path.write_text(json.dumps(about, indent=1, ensure_ascii=False), encoding="utf-8")
    for temporary_path in folder.glob(".*.unfinished.tar"):
        temporary_path.unlink(missing_ok=True)


def _difference(result: Plain, requested: Plain, position_text: str = "") -> str:
    """The first difference of two indices, in words; nothing if there is none."""
    if isinstance(result, dict) and isinstance(requested, dict):
        for key in [*requested, *(key for key in result if key not in requested)]:
            if key not in result or key not in requested:
                return f"{position_text}{key} is {'new' if key in requested else 'gone'}"
            if difference := _difference(result[key], requested[key], f"{position_text}{key}: "):
                return difference
        return ""
    return (
        "" if result == requested else f"{position_text}was {check.described(result)}, is {check.described(requested)}"
    )
