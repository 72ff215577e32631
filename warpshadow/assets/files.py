"""Files that appear whole or not at all, that one process holds, and whether one can be written."""

import contextlib
import os
import shutil
import tempfile
import uuid
from collections.abc import Iterator
from pathlib import Path

from warpshadow.check import AnyPath


@contextlib.contextmanager
def atomic_write(path: AnyPath) -> Iterator[Path]:
    """Give a new empty file beside ``path`` to write to, which takes its place if the block ends without an error.

    On an error the new file is removed and the old file at ``path`` stays. The temporary file has the suffix of
    ``path``, by which libraries tell formats, and the permissions of the file it replaces, or the user's umask for a
    new one.

    Raises:
        OSError: where it cannot be written, such as on a full disk; the message names ``path``, not the temporary file.
    """
    if not Path(path).parent.is_dir():
        raise FileNotFoundError(f"{Path(path).parent}: no such folder")
    path = Path(os.path.realpath(path))  # a link stays, and its target is written
    temporary_path = path.with_name(f".{uuid.uuid4().hex[:12]}.unfinished{path.suffix}")
    try:
        temporary_path.touch(exist_ok=False)
        try:
            yield temporary_path
            if path.exists():
                shutil.copymode(path, temporary_path)
            os.replace(temporary_path, path)
        finally:
            temporary_path.unlink(missing_ok=True)
    except OSError as error:
        if error.errno is None:  # not the system's: the message already names its file
            raise
        raise OSError(error.errno, error.strerror, str(path)) from error


@contextlib.contextmanager
def file_lock(path: Path, *, timeout: float = -1, busy: Exception | None = None) -> Iterator[None]:
    """Lock a file against others that want to hold it, in this process or another; the lock ends with the process.

    Args:
        timeout: How long another's lock is waited for [s]; by default as long as it takes.
        busy: The error to raise after that.
    """
    from filelock import FileLock, Timeout

    lock_path = path.with_name(f".{path.name}.lock")
    lock = FileLock(lock_path, timeout=timeout)
    try:
        lock.acquire()
    except Timeout as error:
        raise busy or error from error
    try:
        yield
    finally:
        with contextlib.suppress(OSError):  # of Windows, where filelock removes it
            lock_path.unlink()
        lock.release()


def check_file(path: Path) -> None:
    """Raise OSError unless a file can be written at a path, in place of one that may be there."""
    if path.is_dir():
        raise IsADirectoryError(f"{path}: got a folder, expected a file")
    check_folder(path.parent)
    if path.exists() and not os.access(path, os.W_OK):
        raise PermissionError(f"{path}: got a file that is write-protected")


def check_folder(path: Path) -> None:
    """Raise OSError unless a folder is there and new files can be written in it."""
    if not path.is_dir():
        raise FileNotFoundError(f"{path}: no such folder")
    try:
        tempfile.TemporaryFile(dir=path).close()
    except OSError as error:
        raise type(error)(f"{path}: no file can be written in this folder ({error.strerror})") from error
