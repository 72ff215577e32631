"""Progress: one bar for one wait, from a second on; lines in files; and a quiet start."""

import importlib
import math
import re
import subprocess
import sys
import tempfile
import time

import pytest
import warp as wp

import warpshadow as ws
from warpshadow.device import progress
from warpshadow.device.progress import progress_bar, waiting
from warpshadow.device.warp_internals import kernel_modules


@pytest.fixture
def no_delay(monkeypatch):
    monkeypatch.setattr(progress, "_DELAY", 0)
    monkeypatch.setattr(progress, "_reporter", None)  # a new thread, which knows of it


@pytest.fixture
def terminal(monkeypatch, capsys):
    """As if what is shown went to a terminal; it can be read."""
    monkeypatch.setattr(progress, "_can_be_seen", lambda: True)
    return capsys


@pytest.fixture
def lines(monkeypatch, capsys):
    """As if a second were 20 ms and stderr a file; what is written there, line by line."""
    monkeypatch.setattr(progress, "_can_be_seen", lambda: False)
    monkeypatch.setattr(progress, "_DELAY", 0.02)
    monkeypatch.setattr(progress, "_LINE_INTERVAL", 0.2)
    for name, value in {"_reporter": None, "_line_time": -math.inf, "_end_time": -math.inf}.items():
        monkeypatch.setattr(progress, name, value)
    return lambda: capsys.readouterr().err.splitlines()


def test_in_a_file_a_line_says_now_and_then_how_far_it_is_and_how_long_it_takes(lines):
    with progress_bar(1000, "counting", "thing", done=200) as bar:
        for _ in range(5):
            bar.update(100)
            time.sleep(0.12)
    said = lines()
    assert len(said) >= 2
    for line in said:
        assert re.fullmatch(r"counting: [3-7]00 of 1,000 things, \d+ s, \d+ s left", line)


def test_what_is_waited_for_within_another_wait_is_on_the_same_line(lines):
    with waiting("rendering"), progress_bar(3, "fitting", "step") as bar:
        bar.describe("descending", "loss 3")
        with progress_bar(None, "compiling kernels", ""):
            time.sleep(0.3)
    said = r"rendering: \d s; descending: 0 of 3 steps, \d s, loss 3; compiling kernels: \d s"
    assert re.fullmatch(said, lines()[0])


def test_many_short_waits_are_not_silent_for_longer_than_one_long_one(lines):
    for _ in range(12):
        with progress_bar(3, "counting", "thing"):
            time.sleep(0.06)
    assert len(lines()) >= 2


def test_waits_that_take_no_second_say_nothing_however_many(lines, monkeypatch):
    monkeypatch.setattr(progress, "_DELAY", 1.0)
    for _ in range(100):
        with progress_bar(3, "counting", "thing"):
            time.sleep(0.004)
    assert not lines()


def test_a_loop_of_calls_says_nothing_and_one_long_call_does(lines):
    for _ in range(12):
        with waiting("rendering"), progress_bar(3, "shading", "receiver"):
            time.sleep(0.06)
    assert not lines()
    with waiting("rendering"):
        time.sleep(0.4)
    assert re.fullmatch(r"rendering: \d s", lines()[0])


def test_lines_are_hidden_as_bars_are(lines):
    with progress_bar(3, "counting", "thing", shows=False):
        time.sleep(0.3)
    with waiting("rendering", shows=False), progress._compiling():
        time.sleep(0.3)
    ws.quiet(progress=False)
    with waiting("rendering"), progress_bar(3, "counting", "thing"), progress._compiling():
        time.sleep(0.3)
    ws.quiet()
    assert not lines()


def test_compiled_kernels_are_counted(lines):
    @wp.kernel(enable_backward=False, module="unique")
    def name_that_no_other_kernel_has(numbers: wp.array(dtype=float), salt: int):
        numbers[wp.tid()] = float(salt)

    with pytest.MonkeyPatch.context() as patch, tempfile.TemporaryDirectory() as folder:
        patch.setattr(wp.config, "kernel_cache_dir", folder)
        patch.setattr(progress, "_LINE_INTERVAL", 0.05)
        wp.launch(name_that_no_other_kernel_has, dim=1, inputs=[wp.zeros(1, device="cpu"), 3], device="cpu")
        assert re.match(r"compiling kernels, module \d+: \d s", lines()[0])
        wp.launch(name_that_no_other_kernel_has, dim=1, inputs=[wp.zeros(1, device="cpu"), 3], device="cpu")
    assert not lines()


def test_kernels_of_the_library_are_loaded_without_a_line_of_warps(capfd, monkeypatch):
    @wp.kernel(enable_backward=False, module="unique")
    def somebody_elses(numbers: wp.array(dtype=float)):
        numbers[wp.tid()] = 1.0

    def said(level):
        monkeypatch.setattr(wp.config, "log_level", level)
        for module in (kernel_modules()["warpshadow.stages.image.film"], somebody_elses.module):
            module.unload()
            module.load("cpu", 1)
        assert wp.config.log_level == level
        return capfd.readouterr().out

    importlib.import_module("warpshadow.stages.image.film")
    assert "film" not in (lines := said(wp.LOG_INFO)) and "somebody_elses" in lines
    assert "film" in said(wp.LOG_DEBUG)
    assert "load" not in said(wp.LOG_WARNING)


def test_a_wait_that_fails_is_over(lines):
    with pytest.raises(ZeroDivisionError), progress_bar(1, "dividing", "number"):
        _ = 1 / 0
    time.sleep(0.3)
    assert not lines()


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
    with progress_bar(3, "counting", "thing", shows=False, stays=True) as bar:
        bar.update(3)
        with progress_bar(2, "sorting", "thing") as inner:  # which is
            inner.update(2)
    shown = terminal.readouterr().err
    assert "counting" not in shown and "sorting" in shown


def test_within_a_bar_there_is_no_second_but_its_label(terminal, no_delay):
    with progress_bar(3, "fitting", "step", stays=True) as outer:
        with progress_bar(7, "tracing rays", "ray") as inner:
            inner.update(7)
            time.sleep(0.1)
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


def test_the_time_that_is_left_is_that_of_the_work_under_way(monkeypatch):
    """After 60 s of preparing, ten of twenty steps took 10 s."""
    now = 0.0
    monkeypatch.setattr(progress.time, "monotonic", lambda: now)
    wait = progress.Wait("preparing", 20, "step")
    now = 60.0
    wait.describe("fitting")
    now = 70.0
    wait.update(10)
    assert wait.line() == "fitting: 10 of 20 steps, 70 s, 10 s left"


def test_the_time_that_is_left_leaves_out_that_of_kernels(monkeypatch):
    """The first of twenty steps took 50 s, 48 of them to compile kernels."""
    now = 0.0
    monkeypatch.setattr(progress.time, "monotonic", lambda: now)
    monkeypatch.setattr(progress, "_compile_seconds", 7.0)  # of an earlier wait
    wait = progress.Wait("fitting", 20, "step")
    with progress._compiling():
        now = 48.0
    now = 50.0
    wait.update(1)
    assert wait.line() == "fitting: 1 of 20 steps, 50 s, 38 s left"


def test_a_bar_ends_where_less_was_to_do(terminal, no_delay):
    with progress_bar(100, "fitting", "it", stays=True) as bar:
        bar.update(30)
        bar.expect(20)
        bar.update(5)
        bar.expect(0)
    states = terminal.readouterr().err.split("\r")
    assert any("30/50" in state for state in states)
    assert "100%" in states[-1] and "35/35" in states[-1]


# A kernel of Jupyter's, as far as tqdm looks; its bars are of widgets where there are any.
NOTEBOOK = """
import builtins, sys, warnings
from types import ModuleType
import IPython
builtins.__IPYTHON__ = True
sys.modules["ipykernel.zmqshell"] = ModuleType("zmqshell")
warnings.simplefilter("always")
from warpshadow.device.progress import progress_bar
with progress_bar(100, "counting", "thing", stays=True) as bar:
    bar.update(3)
    bar.expect(4)
    shown, widget = bar.bar, getattr(bar.bar, "container", None)
    print(type(shown).__mro__[1].__module__, shown.total, widget is not None and widget.children[1].max == 7)
"""


def in_a_notebook(before):
    """What a bar is there, and what is shown."""
    run = subprocess.run([sys.executable, "-c", before + NOTEBOOK], capture_output=True, text=True, check=True)
    return run.stdout, run.stderr


@pytest.mark.slow
def test_a_notebook_without_widgets_has_bars_of_text_and_no_warning():
    pytest.importorskip("IPython")
    made, shown = in_a_notebook("import sys\nsys.modules['ipywidgets'] = None\n")
    assert made == "tqdm.std 7 False\n"
    assert "IProgress" not in shown and "Warning" not in shown
    assert "counting:" in shown and "3/7" in shown


@pytest.mark.slow
def test_a_notebook_with_widgets_has_bars_of_them():
    pytest.importorskip("ipywidgets")
    made, shown = in_a_notebook("")
    assert made.endswith("tqdm.notebook 7 True\n") and "Warning" not in shown


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
