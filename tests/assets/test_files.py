"""Files appear whole or not at all, as any new file of the user's would, and are refused before the work."""

import errno
import os
import stat

import numpy as np
import pytest

import warpshadow as ws
from warpshadow.assets import files
from warpshadow.inverse import checkpoint
from warpshadow.scene import toml_tables
from warpshadow.spheres.plot import plot_spheres

BALL = ws.icosphere(1.0, 1)
SPHERES = ws.Spheres(np.zeros((1, 3)), np.ones(1))

# All that the package writes by itself; a scene and a fit's results consist of these.
WRITERS = {
    "a.exr": lambda path: ws.write_image(path, np.ones((2, 3, 3))),
    "a.png": lambda path: ws.write_image(path, np.ones((2, 3, 3))),
    "a.jpg": lambda path: ws.write_image(path, np.ones((2, 3, 3))),
    "a.toml": lambda path: toml_tables.write(path, {"a": 1}),
    "a.obj": BALL.write,
    "a.npz": SPHERES.write,
    "checkpoint": lambda path: checkpoint.save(path, {"step": 1}),
    "plot.png": lambda path: plot_spheres(BALL, SPHERES, path),
}


@pytest.fixture
def umask():
    """Files for the group, as in a folder that is shared."""
    before = os.umask(0o002)
    yield
    os.umask(before)


@pytest.mark.skipif(os.name == "nt", reason="Windows has no umask")
@pytest.mark.parametrize("name", WRITERS)
def test_permissions_are_those_of_any_new_file(tmp_path, umask, name):
    WRITERS[name](tmp_path / name)
    assert [path.name for path in tmp_path.iterdir()] == [name]
    assert stat.S_IMODE((tmp_path / name).stat().st_mode) == 0o664


@pytest.mark.parametrize("name", WRITERS)
def test_what_was_there_stays_where_writing_fails(tmp_path, monkeypatch, name):
    (tmp_path / name).write_bytes(b"before")

    def fail(*args):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(OSError, match="No space left on device") as raised:
        WRITERS[name](tmp_path / name)
    assert raised.value.filename == str(tmp_path / name)
    assert [(path.name, path.read_bytes()) for path in tmp_path.iterdir()] == [(name, b"before")]


def test_a_block_that_fails_leaves_nothing(tmp_path):
    with pytest.raises(KeyboardInterrupt), files.atomic_write(tmp_path / "a.txt") as unfinished:
        unfinished.write_text("half")
        raise KeyboardInterrupt
    assert not list(tmp_path.iterdir())


def test_a_missing_folder_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match="/no: no such folder$"), files.atomic_write(tmp_path / "no" / "a.txt"):
        pytest.fail("there is nothing to write to")


def test_a_file_can_be_written_where_a_folder_takes_files(tmp_path):
    files.check_file(tmp_path / "new.txt")
    (tmp_path / "old.txt").write_text("")
    files.check_file(tmp_path / "old.txt")
    assert [path.name for path in tmp_path.iterdir()] == ["old.txt"]


@pytest.mark.parametrize(
    ("path", "error", "message"),
    [
        (".", IsADirectoryError, "got a folder, expected a file"),
        ("no/a.txt", FileNotFoundError, "no: no such folder"),
        ("file/a.txt", FileNotFoundError, "file: no such folder"),
    ],
)
def test_where_no_file_can_be_written_is_said(tmp_path, path, error, message):
    (tmp_path / "file").write_text("")
    with pytest.raises(error, match=message):
        files.check_file(tmp_path / path)


def test_a_file_that_is_write_protected_is_refused(tmp_path, monkeypatch):
    (tmp_path / "a.txt").write_text("")
    (tmp_path / "a.txt").chmod(0o444)
    monkeypatch.setattr(os, "access", lambda path, mode: os.stat(path).st_mode & 0o222 != 0)  # root may do anything
    with pytest.raises(PermissionError, match=r"a\.txt: got a file that is write-protected"):
        files.check_file(tmp_path / "a.txt")


@pytest.mark.skipif(os.name == "nt", reason="Windows has other permissions and links")
def test_a_link_stays_and_what_it_names_is_written_with_its_permissions(tmp_path):
    target, link = tmp_path / "target.txt", tmp_path / "link.txt"
    target.write_text("before")
    target.chmod(0o640)
    link.symlink_to(target)
    with files.atomic_write(link) as unfinished:
        unfinished.write_text("after")
    assert link.is_symlink()
    assert target.read_text() == "after"
    assert target.stat().st_mode & 0o777 == 0o640
    assert sorted(path.name for path in tmp_path.iterdir()) == ["link.txt", "target.txt"]
