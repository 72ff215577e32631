"""What takes long to find is kept on disk, by a hash of all that it depends on."""

from __future__ import annotations

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
Kind = Literal["spheres", "own_shadows", "form_factors"]

KINDS: Mapping[Kind, str] = {
    "spheres": "fits of spheres",
    "own_shadows": "shadows of bodies on themselves",
    "form_factors": "form factors of bounces within bodies",
}
"""What is kept, by the folder that it is in."""


_OWN_NAME = re.compile(r"[0-9a-f]{32,}\.npz|\.[0-9a-f]{12}\.unfinished\.npz")
"""Names of what is kept, and of what a killed process left: nothing else in the folders is ours."""


def cache_folder() -> Path:
    """Where all is kept: WARPSHADOW_CACHE_DIR, or the platform's folder for caches."""
    from platformdirs import user_cache_path

    override = os.environ.get("WARPSHADOW_CACHE_DIR")
    return Path(override) if override else user_cache_path("warpshadow", appauthor=False, opinion=False)


def cache_path(kind: Kind, key: str) -> Path:
    """Where something is kept."""
    return cache_folder() / kind / f"{key}.npz"


def cached_files(kind: Kind) -> list[Path]:
    """What is kept of a kind, and what a killed process left half written."""
    found = (cache_folder() / kind).glob("*.npz")
    return sorted(path for path in found if _OWN_NAME.fullmatch(path.name) and path.is_file())


def remembered(
    path: Path,
    read: Callable[[Mapping[str, np.ndarray]], Item],
    make: Callable[[], Item],
    arrays: Callable[[Item], Mapping[str, np.ndarray]],
    *,
    what: str,
) -> Item:
    """Read something from the cache, or make it and write it there; a second process that wants it, too, waits for it.

    Args:
        path: From :func:`cache_path`.
        read: Makes it of the arrays in the file.
        make: Makes it anew.
        arrays: The arrays that are kept of it.
        what: What it is, for warnings, such as "fit".
    """
    with contextlib.ExitStack() as held:
        if not path.exists():
            with contextlib.suppress(OSError):  # of a folder that cannot be written to
                path.parent.mkdir(parents=True, exist_ok=True)
                held.enter_context(files.locked(path))
        if path.exists():
            try:
                with path.open("rb") as file, np.load(file, allow_pickle=False) as stored:
                    return read(stored)
            except Exception as problem:  # whatever a damaged file raises: it can always be made again
                check.warn(f"cached {what} {path} cannot be read ({problem}); it is made again")
        made = make()
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with files.whole(path) as unfinished:
                np.savez(unfinished, allow_pickle=False, **arrays(made))
        except OSError as problem:
            check.warn(f"the {what} could not be cached in {path.parent} ({problem})")
    return made
