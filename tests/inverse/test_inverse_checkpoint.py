"""Checkpoints: whenever a process ends, a whole file remains, and what is damaged is noticed."""

import contextlib
import os
import subprocess
import sys
import warnings
from pathlib import Path

import pytest
import torch

from warpshadow.inverse import CheckpointError
from warpshadow.inverse.checkpoint import exclusive, load, previous_path, save


class PowerCut(BaseException):
    """The process ends here: nothing catches it."""


def state(number: int) -> dict:
    return {"number": number, "values": torch.arange(5.0) + number, "nested": [{"lr": 0.1 * number}, "text", None]}


def number_in(path: Path) -> int | None:
    """Of the state that is loaded, without a warning."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        loaded = load(path)
    return None if loaded is None else loaded["number"]


@pytest.fixture
def path(tmp_path) -> Path:
    return tmp_path / "fit.checkpoint"


def test_what_is_saved_is_loaded_bit_for_bit(path):
    saved = state(1) | {"tiny": torch.tensor([1e-38, float("inf")]), "loss": 0.1 + 0.2}
    save(path, saved)
    loaded = load(path)
    assert loaded.keys() == saved.keys()
    assert torch.equal(loaded["values"], saved["values"]) and torch.equal(loaded["tiny"], saved["tiny"])
    assert loaded["nested"] == saved["nested"] and loaded["loss"] == saved["loss"]


def test_without_files_there_is_no_state(path):
    assert load(path) is None


def test_the_one_before_is_kept_and_nothing_else_remains(path):
    for number in range(4):
        save(path, state(number))
    assert number_in(path) == 3
    assert number_in(previous_path(path)) == 2
    assert {file.name for file in path.parent.iterdir()} == {path.name, previous_path(path).name}


STEPS = 8
"""More than a save takes."""


def cut_power_at(step: int, monkeypatch) -> list[str]:
    """Let the process end before the step-th operation on files from now on; returns the names of those done."""
    done: list[str] = []

    def cut(name, function):
        def operate(*args, **kwargs):
            if len(done) >= step:
                raise PowerCut(name)
            done.append(name)
            return function(*args, **kwargs)

        return operate

    for owner, name in ((os, "fsync"), (os, "replace"), (Path, "open"), (Path, "unlink")):
        monkeypatch.setattr(owner, name, cut(name, getattr(owner, name)))
    return done


def test_power_can_be_cut_between_all_operations_of_a_save(path, monkeypatch):
    """Those that the next test counts on: files are written and renamed by nothing else."""
    save(path, state(0))
    with monkeypatch.context() as patch:
        done = cut_power_at(99, patch)
        save(path, state(1))
    assert [name for name in done if name != "open"] == ["fsync", "replace", "replace", "unlink"]
    assert len(done) < STEPS


@pytest.mark.parametrize("saves_before", [0, 1, 2])
@pytest.mark.parametrize("step", range(STEPS))
def test_a_process_that_ends_between_two_operations_leaves_the_last_or_the_one_before(
    path, monkeypatch, step, saves_before
):
    for number in range(saves_before):
        save(path, state(number))
    last = saves_before - 1 if saves_before else None
    has_ended = False
    with monkeypatch.context() as patch:
        cut_power_at(step, patch)
        try:
            save(path, state(saves_before))
        except PowerCut:
            has_ended = True
    found = number_in(path)
    assert found in ((last, saves_before) if has_ended else (saves_before,))
    # and the process after it goes on saving
    save(path, state(10))
    assert number_in(path) == 10


def test_a_file_that_is_only_half_written_is_not_taken_for_one(path, monkeypatch):
    save(path, state(0))

    def lose_the_rest(descriptor):
        os.ftruncate(descriptor, 40)
        raise PowerCut

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", lose_the_rest)
        with pytest.raises(PowerCut):
            save(path, state(1))
    assert number_in(path) == 0


# Where a file may end: nothing, within the mark, after it, within the digest, after it, within the payload, at its end.
def lengths(size: int) -> list[int]:
    return [0, 1, 12, 24, 40, 56, 57, (56 + size) // 2, size - 1]


@pytest.mark.parametrize("which", range(9))
def test_a_truncated_file_gives_way_to_the_one_before_with_a_warning(path, which):
    save(path, state(0))
    save(path, state(1))
    whole = path.read_bytes()
    path.write_bytes(whole[: lengths(len(whole))[which]])
    with pytest.warns(UserWarning, match=r"fit\.checkpoint: not a whole .*going on from fit\.checkpoint\.previous"):
        assert load(path)["number"] == 0


@pytest.mark.parametrize("place", [0, 24, 55, 56, 200, -1])
def test_a_flipped_bit_is_noticed(path, place):
    save(path, state(0))
    content = bytearray(path.read_bytes())
    content[place] ^= 1
    path.write_bytes(content)
    with pytest.raises(CheckpointError, match="fit.checkpoint: not a whole checkpoint"):
        load(path)


def test_what_follows_the_end_is_noticed(path):
    save(path, state(0))
    path.write_bytes(path.read_bytes() + b"\0")
    with pytest.raises(CheckpointError):
        load(path)


def test_two_damaged_files_are_an_error_that_names_both(path):
    save(path, state(0))
    save(path, state(1))
    for file in (path, previous_path(path)):
        file.write_bytes(file.read_bytes()[:-1])
    with pytest.raises(CheckpointError, match=r"fit\.checkpoint: .*fit\.checkpoint\.previous: .*remove"):
        load(path)


def test_a_damaged_file_does_not_replace_the_whole_one_before_it(path, monkeypatch):
    """Or a process that ends while it saves next would leave nothing whole."""
    save(path, state(0))
    save(path, state(1))
    path.write_bytes(path.read_bytes()[:-1])
    found = []
    for step in range(STEPS):
        with monkeypatch.context() as patch, contextlib.suppress(PowerCut):
            cut_power_at(step, patch)
            save(path, state(2))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found.append(load(path)["number"])
    assert found[0] == 0 and found[-1] == 2 and set(found) == {0, 2}


def test_a_file_that_is_something_else_is_refused_and_stays(path):
    path.write_text("[scene]\nenvmap = 'sky.exr'\n")
    with pytest.raises(CheckpointError):
        load(path)
    assert path.read_text().startswith("[scene]")


def test_a_state_with_more_than_data_is_not_executed(path):
    """A checkpoint from elsewhere cannot run code: what is loaded is tensors, numbers, strings and containers."""
    for kept, message in (({"function": os.getcwd}, "more than data .UnpicklingError"), ([1, 2], r"got \[1, 2\]")):
        save(path, kept)
        with pytest.raises(CheckpointError, match=rf"^{path}: .*{message}.*remove it"):
            load(path)


def test_a_folder_that_is_not_there_is_an_error(tmp_path):
    with pytest.raises(FileNotFoundError):
        save(tmp_path / "nowhere" / "fit.checkpoint", state(0))


# ---------------------------------------------------------------------------------------------- two at once

HOLD = """import sys
from warpshadow.inverse.checkpoint import exclusive
with exclusive(sys.argv[1]):
    print("held", flush=True)
    input()
"""


@pytest.mark.slow
@pytest.mark.parametrize("ending", ["closed", "killed"])
def test_a_file_that_another_process_fits_to_is_refused_until_that_ends(path, ending):
    command = [sys.executable, "-c", HOLD, str(path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout.readline() == "held\n"
        with pytest.raises(CheckpointError, match=r"fit\.checkpoint: another fit is writing it; .*folder by -o"):
            exclusive(path).__enter__()
        with exclusive(path.with_name("another")):
            pass
        other.kill() if ending == "killed" else other.communicate("\n")
    with exclusive(path):
        save(path, state(1))
    assert number_in(path) == 1


def test_two_fits_of_one_process_do_not_share_a_file(path):
    with exclusive(path), pytest.raises(CheckpointError, match="another fit is writing it"), exclusive(path):
        pass
    with exclusive(None), exclusive(None):
        pass
