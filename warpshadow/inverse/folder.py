"""The folder of a fit: its files, and whether a fit may write into it."""

from pathlib import Path

from warpshadow.assets import files

CHECKPOINT = "checkpoint"
PREVIEW = "preview.png"


def check_writable(path: Path) -> None:
    """Raise OSError unless a folder can be written into, or made."""
    if path.exists() and not path.is_dir():
        raise NotADirectoryError(f"{path}: got a file, expected a folder")
    files.check_folder(path if path.is_dir() else path.parent)


def check_folder(path: Path) -> None:
    """Raise OSError unless a folder is new, or that of a fit."""
    check_writable(path)
    if not path.is_dir() or has_checkpoint(path):
        return
    others = sorted(item.name for item in path.iterdir() if not item.name.startswith(".") and item.name != PREVIEW)
    if others:
        raise FileExistsError(f"{path}: got a folder with {others[0]} in it, expected a new one or that of this fit")


def has_checkpoint(folder: Path) -> bool:
    """Whether a fit in a folder can go on."""
    return any(folder.glob(f"{CHECKPOINT}*"))
