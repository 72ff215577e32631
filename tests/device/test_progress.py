"""Progress: one bar for one wait, from a second on; and a quiet start."""

import re
import subprocess
import sys
import time

import pytest

import warpshadow as ws
from warpshadow.device import progress
from warpshadow.device.progress import progress_bar


@pytest.fixture
def no_delay(monkeypatch):
    monkeypatch.setattr(progress, "_DELAY", 0)


@pytest.fixture
def terminal(monkeypatch, capsys):
    """As if what is shown went to a terminal; it can be read."""
    monkeypatch.setattr(progress, "_can_be_seen", lambda: True)
    return capsys


def test_in_a_file_there_are_no_bars(capsys, no_delay):
    with progress_bar(3, "counting", "thing", stays=True) as bar:
        bar.update(3)
        with progress_bar(2, "sorting", "thing") as inner:
            inner.update(2)
    assert not capsys.readouterr().err


def test_all_bars_can_be_hidden(terminal, no_delay):
    ws.quiet(progress=False)
    with progress_bar(3, "counting", "thing", stays=True) as bar:
        bar.update(3)
    assert not terminal.readouterr().err
    ws.quiet()
    with progress_bar(3, "counting", "thing") as bar:
        bar.update(3)
    assert "counting" in terminal.readouterr().err


def test_what_takes_no_second_shows_no_bar(terminal):
    with progress_bar(3, "counting", "thing") as bar:
        bar.update(3)
    assert "counting" not in terminal.readouterr().err


def test_what_takes_longer_shows_a_bar_that_goes_away(terminal, monkeypatch):
    monkeypatch.setattr(progress, "_DELAY", 0.05)
    with progress_bar(3, "counting", "thing") as bar:
        time.sleep(0.2)
        bar.update(2)
    shown = terminal.readouterr().err
    assert "counting" in shown and "2/3" in shown
    assert not shown.split("\r")[-1].strip()


def test_a_bar_that_is_not_wanted_is_not_shown(terminal, no_delay):
    with progress_bar(3, "counting", "thing", wanted=False, stays=True) as bar:
        bar.update(3)
        with progress_bar(2, "sorting", "thing") as inner:  # which is
            inner.update(2)
    shown = terminal.readouterr().err
    assert "counting" not in shown and "sorting" in shown


def test_within_a_bar_there_is_no_second_but_its_words(terminal, no_delay):
    with progress_bar(3, "fitting", "step", stays=True) as outer:
        with progress_bar(7, "tracing rays", "ray") as inner:
            inner.update(7)
        outer.update(3)
    shown = terminal.readouterr().err
    assert re.search(r"fitting: .*0/3 .*tracing rays", shown)
    assert "7/7" not in shown and "3/3" in shown
    assert "tracing rays" not in shown.split("\r")[-1]
    with progress_bar(2, "sorting", "thing") as bar:  # and after it, bars show again
        bar.update(2)
    assert "sorting" in terminal.readouterr().err


def test_a_bar_whose_block_fails_makes_way(terminal, no_delay):
    with pytest.raises(ZeroDivisionError), progress_bar(1, "dividing", "number"):
        _ = 1 / 0
    with progress_bar(2, "sorting", "thing") as bar:
        bar.update(2)
    assert "sorting" in terminal.readouterr().err


START = """
import os, sys
import warp as wp
import warpshadow as ws
init = wp.init
def remarking():
    os.write(2, b"Warp CUDA warning: Could not find or load the NVIDIA CUDA driver. GPU execution is not.\\n")
    os.write(2, b"something else\\n")
    init()
wp.init = remarking
ws.quiet()
print(wp.zeros(3, device="cpu").numpy().sum())
os.write(2, b"later\\n")
"""


@pytest.mark.slow
def test_a_quiet_start_says_nothing_of_drivers_and_passes_on_the_rest():
    run = subprocess.run([sys.executable, "-c", START], capture_output=True, text=True, check=True)
    assert run.stdout == "0.0\n"
    assert run.stderr == "something else\nlater\n"
