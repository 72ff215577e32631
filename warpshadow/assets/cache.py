"""The cache on disk: results that take long to compute, finished or interrupted, by a hash of all their inputs."""

import contextlib
import os
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Literal, TypeVar

import numpy as np

from warpshadow import check
from warpshadow.assets import files

Item = TypeVar("Item")
Kind = Literal["spheres", "self_shadows", "form_factors"]

KINDS: Mapping[Kind, str] = {
    "spheres": "fits of spheres",
    "self_shadows": "shadows of bodies on themselves",
    "form_factors": "form factors of bounces within bodies",
}
"""Kinds of cached results, by folder."""


_OWN_NAME = re.compile(r"[0-9a-f]{32,}(\.part)?\.npz|\.[0-9a-f]{12}\.unfinished\.npz")
"""Names of cached files, and of partial files from killed processes: nothing else in the folders is ours."""


def cache_folder() -> Path:
    """The folder of the cache: WARPSHADOW_CACHE_DIR, or the platform's folder for caches."""
    from platformdirs import user_cache_path

    override = os.environ.get("WARPSHADOW_CACHE_DIR")
    return Path(override) if override else user_cache_path("warpshadow", appauthor=False, opinion=False)


def cache_path(kind: Kind, key: str) -> Path:
    """File of a cached item."""
    return cache_folder() / kind / f"{key}.npz"


def cached_files(kind: Kind) -> list[Path]:
    """List the cached files of a kind, and the partial files that a killed process left."""
    cache_files = (cache_folder() / kind).glob("*.npz")
    return sorted(path for path in cache_files if _OWN_NAME.fullmatch(path.name) and path.is_file())


class Unfinished:
    """Progress of a computation whose result is to be cached; an interrupt leaves it for the next call."""

    def __init__(self, path: Path):
        self._path = path.with_suffix(".part.npz")
        self._arrays: Callable[[], Mapping[str, np.ndarray]] | None = None
        self._done = ""
        self.before: dict[str, np.ndarray] = {}  # arrays that an interrupted call left; none where the work begins
        # ignore a damaged file, whatever error it raises
        with (
            contextlib.suppress(Exception),
            self._path.open("rb") as file,
            np.load(file, allow_pickle=False) as cached_arrays,
        ):
            self.before = dict(cached_arrays)

    def keep(self, arrays: Callable[[], Mapping[str, np.ndarray]], done: str) -> None:
        """Note how far the work is.

        Args:
            arrays: Makes the arrays from which a later call goes on to the same bits; called at an interrupt.
            done: How far it is, for people, such as "2,048 of 10,327 points".
        """
        self._arrays, self._done = arrays, done

    def write(self, noun: str) -> str:
        """Write the last partial result; return a line that says so, or nothing if there is none."""
        if self._arrays is None:
            return ""
        try:
            _write(self._path, self._arrays())
        except OSError as problem:
            check.warn(f"the unfinished {noun} could not be cached in {self._path.parent} ({problem})")
            return ""
        return f"{self._done} of the {noun} are cached, and the next call goes on from there"

    def remove(self) -> None:
        """Remove the partial result of an interrupted call, since the work is done."""
        with contextlib.suppress(OSError):
            self._path.unlink(missing_ok=True)


def _write(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with files.atomic_write(path) as unfinished:
        np.savez(unfinished, allow_pickle=False, **arrays)


def load_or_compute(
    path: Path,
    read: Callable[[Mapping[str, np.ndarray]], Item],
    compute: Callable[[Unfinished], Item],
    arrays: Callable[[Item], Mapping[str, np.ndarray]],
    *,
    noun: str,
) -> Item:
    """Read something from the cache, or make it and write it there; a second process that wants it, too, waits for it.

    Args:
        path: From :func:`cache_path`.
        read: Makes it of the arrays in the file.
        compute: Makes it anew, from where an interrupt left it.
        arrays: The arrays of it that are cached.
        noun: Noun for warnings, such as "fit".
    Raises:
        KeyboardInterrupt: at an interrupt; it says how much is cached.
    """
    with contextlib.ExitStack() as lock_stack:
        if not path.exists():
            with contextlib.suppress(OSError):  # of a folder that cannot be written to
                path.parent.mkdir(parents=True, exist_ok=True)
                lock_stack.enter_context(files.file_lock(path))
        if path.exists():
            try:
                with path.open("rb") as file, np.load(file, allow_pickle=False) as cached_arrays:
                    return read(cached_arrays)
            except Exception as problem:  # any error of a damaged file: the result can be computed again
                check.warn(f"cached {noun} {path} cannot be read ({problem}); it is made again")
        unfinished = Unfinished(path)
        try:
            computed_item = compute(unfinished)
        except (KeyboardInterrupt, SystemExit) as interrupt:
            if (note := unfinished.write(noun)) and isinstance(interrupt, KeyboardInterrupt):
                interrupt.args = (note,)
            raise
        try:
            _write(path, arrays(computed_item))
            unfinished.remove()
        except OSError as problem:
            check.warn(f"the {noun} could not be cached in {path.parent} ({problem})")
    return computed_item
