"""Checkpoints: the state of a long computation in a file that is whole or not there; and the folder of a fit.

A file holds a mark, the SHA-256 of the payload, and the payload in torch's own format. It replaces the one before by a
rename, and that one is kept beside it, so whenever a process is killed a whole file remains.
"""

import contextlib
import hashlib
import io
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from warpshadow import check
from warpshadow.assets import files
from warpshadow.check import AnyPath

CHECKPOINT, PREVIEW = "checkpoint", "preview.png"  # files in the folder of a fit

OTHER_FILE_REMEDY = "choose another file, which on the command line is another folder by -o"
"""Remedy for messages about an unusable checkpoint."""

_FILE_HEADER = b"warpshadow checkpoint 1\n"


class CheckpointError(ValueError):
    """A checkpoint that cannot be used; the message says why."""


def exclusive(path: AnyPath | None) -> contextlib.AbstractContextManager[None]:
    """Refuse a second fit that would write the same file; without a file nothing is refused.

    Raises:
        CheckpointError: while another fit, of this process or another, holds the file.
    """
    if path is None:
        return contextlib.nullcontext()
    busy = CheckpointError(f"{path}: another fit is writing it; wait for its end, or {OTHER_FILE_REMEDY}")
    return files.file_lock(Path(path), timeout=0, busy=busy)


def save(path: AnyPath, state: Mapping[str, object]) -> None:
    """Write a state, atomically; the checkpoint before it stays as FILE.previous.

    Args:
        path: The file; its folder must exist.
        state: Tensors, numbers, strings, and lists and dictionaries of them.
    """
    path = Path(path)
    buffer = io.BytesIO()
    torch.save(state, buffer)
    payload = buffer.getvalue()
    with files.atomic_write(path) as temporary_path:
        with temporary_path.open("wb") as file:
            file.write(_FILE_HEADER + hashlib.sha256(payload).digest() + payload)
            file.flush()
            os.fsync(file.fileno())
        if _payload(path) is not None:  # a damaged one does not take the place of the whole one before it
            os.replace(path, previous_path(path))


def load(path: AnyPath) -> dict[str, Any] | None:
    """Read the last whole state.

    Returns:
        The state, its tensors on the CPU; that of FILE.previous, with a warning, where the file is damaged, and without
        one where it is missing because a process ended between two renames; None where there is neither.
    Raises:
        CheckpointError: where files are there but none is whole; and for a whole one that holds more than data, of
            which nothing is executed.
    """
    path = Path(path)
    faults: list[str] = []
    for candidate in (path, previous_path(path)):
        if not candidate.exists():
            continue
        payload = _payload(candidate)
        if payload is not None:
            if faults:
                check.warn(f"{faults[0]}; going on from {candidate.name}")
            return _state(candidate, payload)
        faults.append(f"{candidate}: not a whole checkpoint (truncated or damaged)")
    if faults:
        raise CheckpointError(f"{'; '.join(faults)}; remove the damaged files to start anew")
    return None


def _payload(path: Path) -> bytes | None:
    """Read the payload of a checkpoint; None where the file is missing or damaged."""
    if not path.exists():
        return None
    content = path.read_bytes()
    start = len(_FILE_HEADER) + hashlib.sha256().digest_size
    payload = content[start:]
    return payload if content[:start] == _FILE_HEADER + hashlib.sha256(payload).digest() else None


def _state(path: Path, payload: bytes) -> dict[str, Any]:
    """The state in a payload; CheckpointError where torch finds more than data in it, or no state."""
    try:
        state = torch.load(io.BytesIO(payload), map_location="cpu", weights_only=True)
    except Exception as error:  # bytes with a right digest may still be anything, and unpicklers raise anything
        reason = str(error).partition("\n")[0]
        raise CheckpointError(
            f"{path}: got more than data ({type(error).__name__}: {reason}), expected tensors, numbers, strings, and "
            f"lists and dictionaries of them; remove it, or {OTHER_FILE_REMEDY}"
        ) from error
    if not isinstance(state, dict):
        raise CheckpointError(
            f"{path}: got {check.described(state)}, expected a dictionary; remove it, or {OTHER_FILE_REMEDY}"
        )
    return state


def previous_path(path: Path) -> Path:
    """Path of the previous checkpoint."""
    return path.with_name(f"{path.name}.previous")


def check_writable(path: Path) -> None:
    """Raise OSError unless a folder can be written into, or made."""
    if path.exists() and not path.is_dir():
        raise NotADirectoryError(f"{path}: got a file, expected a folder")
    files.check_folder(path if path.is_dir() else path.parent)


def check_folder(path: Path) -> None:
    """Raise OSError unless a folder is new, or a fit's."""
    check_writable(path)
    if not path.is_dir() or has_checkpoint(path):
        return
    others = sorted(item.name for item in path.iterdir() if not item.name.startswith(".") and item.name != PREVIEW)
    if others:
        raise FileExistsError(f"{path}: got a folder with {others[0]} in it, expected a new one or that of this fit")


def has_checkpoint(folder: Path) -> bool:
    """Whether a fit in a folder can go on."""
    return any(folder.glob(f"{CHECKPOINT}*"))
