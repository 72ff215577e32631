"""Worker processes: what becomes of tasks, results, errors, and of processes that die."""

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
import warp as wp

import warpshadow as ws
from warpshadow.device.workers import WorkerDied, run_tasks

pytestmark = pytest.mark.slow  # a process starts in a second


class Unpicklable(Exception):
    def __init__(self, first, second):
        super().__init__(first)


def refuse(*_):
    raise ValueError("not again")


class Unreadable:
    """Can be pickled, but not unpickled."""

    def __reduce__(self):
        return refuse, ()


class Mute(Exception):
    def __str__(self):
        raise ValueError("no words")


ODD = {
    "return a lock": "the result cannot be pickled (TypeError: cannot pickle '_thread.lock' object)",
    "return what cannot be read": "the result cannot be unpickled (ValueError: not again)",
    "raise what cannot be sent": "test_workers.Unpicklable: so",
    "raise what says nothing": "test_workers.Mute: <exception str() failed>",
}
"""Tasks, and what their errors say."""


def play(task):
    """Do as the task says."""
    what, value = task
    if what == "square":
        return value**2, ws.thread_count(), os.getpid()
    if what == "raise":
        raise ValueError(f"value: got {value}")
    if what == "raise what cannot be sent":
        raise Unpicklable("so", 1)
    if what == "raise what says nothing":
        raise Mute
    if what == "return a lock":
        return threading.Lock()
    if what == "return what cannot be read":
        return Unreadable()
    if what == "exit":
        sys.exit(value)
    if what == "die once":
        if not Path(value).exists():
            Path(value).touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return "lived"
    return os.kill(os.getpid(), signal.SIGKILL)


def test_tasks_are_shared_out_and_failures_cost_only_themselves(tmp_path):
    others = [
        ("raise", 7),
        ("die once", str(tmp_path / "died")),
        ("die", 0),
        ("exit", 3),
        *((what, 0) for what in ODD),
        (lock := threading.Lock(), 0),
        (unreadable := Unreadable(), 0),
    ]
    tasks = [*(("square", k) for k in range(6)), *others, *(("square", k) for k in range(6, 12))]
    ended = {task: (result, error) for task, result, error in run_tasks(play, tasks, workers=2, threads=3)}
    assert set(ended) == set(tasks)
    squares = [result for (what, _), (result, _) in ended.items() if what == "square"]
    assert sorted(square for square, *_ in squares) == [k**2 for k in range(12)]
    assert {threads for _, threads, _ in squares} == {3}
    assert len({process for *_, process in squares}) >= 2
    errors = {what: error for (what, _), (_, error) in ended.items()}
    assert errors["square"] is None
    assert isinstance(errors["raise"], ValueError) and str(errors["raise"]) == "value: got 7"
    assert {what: str(errors[what]) for what in ODD} == ODD
    assert str(errors["exit"]) == "SystemExit: 3"
    assert str(errors[lock]) == "the task cannot be pickled (TypeError: cannot pickle '_thread.lock' object)"
    assert isinstance(errors[unreadable], ValueError) and str(errors[unreadable]) == "not again"
    assert ended[others[1]] == ("lived", None)
    assert isinstance(errors["die"], WorkerDied)
    assert str(errors["die"]) == "its process ended by SIGKILL, 2 times"


PARENT = """
import os, sys, time
sys.path.insert(0, {folder!r})
import test_workers

def main():
    for ended in test_workers.run_tasks(test_workers.wait, range(2), workers=2):
        print(ended)

if __name__ == "__main__":
    main()
"""


def wait(task):
    Path(os.environ["TEST_FOLDER"], f"{os.getpid()}").touch()
    wp.init()
    time.sleep(600)


def is_running(process):
    """Whether there is such a process, which is not one that only waits to be forgotten."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="no /proc to look for processes in")
def test_workers_end_with_a_parent_that_is_killed(tmp_path):
    program = tmp_path / "parent.py"
    program.write_text(PARENT.format(folder=str(Path(__file__).parent)))
    seen = tmp_path / "seen"
    seen.mkdir()
    parent = subprocess.Popen([sys.executable, program], env=os.environ | {"TEST_FOLDER": str(seen)})
    try:
        until(lambda: len(list(seen.iterdir())) == 2)
    finally:
        parent.kill()
        parent.wait()
    children = [int(each.name) for each in seen.iterdir()]
    until(lambda: not any(map(is_running, children)))


def until(condition, seconds=300):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.05)


def test_a_script_whose_main_part_would_run_in_its_workers_is_told_so(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(
        "from warpshadow.device.workers import run_tasks\nlist(run_tasks(print, [1], workers=1))\n", "utf-8"
    )
    result = subprocess.run([sys.executable, script], capture_output=True, text=True, timeout=300)
    assert result.returncode == 1
    last = result.stderr.strip().splitlines()[-1]
    assert last.startswith("ChildProcessError: a worker process cannot start") and '__name__ == "__main__"' in last
