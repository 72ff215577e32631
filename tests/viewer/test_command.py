"""`warpshadow view`: it serves until Ctrl+C, and says in one line what is wrong."""

import functools
import http.client
import os
import re
import signal
import subprocess
import sys
import time
from urllib.parse import urlsplit

import pytest
from typer.testing import CliRunner

import warpshadow as ws
from warpshadow.cli import app

PROGRAM = [sys.executable, "-c", "from warpshadow.cli import app; app(prog_name='warpshadow')"]

SCENE = """
camera = {eye = [0, 2, 4], target = [0, 0.5, 0], size = [32, 24]}
light = {sh = [[1, 1, 1], [0.4, 0.4, 0.4], [0, 0, 0], [0, 0, 0]]}
[[body]]
primitive = "icosphere"
subdivisions = 1
blockers = 0
"""


@pytest.fixture
def scene(tmp_path):
    (tmp_path / "scene.toml").write_text(SCENE)
    return tmp_path / "scene.toml"


def seconds_to_end(scene) -> float:
    """How long the command takes to end after an interrupt, once it has served its page."""
    command = [*PROGRAM, "view", str(scene), "--port", "0", "--no-browser"]
    environment = os.environ | {"PYTHONUNBUFFERED": "1"}
    # a process that was started in the background ignores interrupts, and so do its children unless they are told
    heed = functools.partial(signal.signal, signal.SIGINT, signal.SIG_DFL)
    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen(command, **streams, text=True, env=environment, preexec_fn=heed) as run:
        try:
            line = run.stdout.readline()
            url = re.match(r"(http://127\.0\.0\.1:\d+) ", line).group(1)
            connection = http.client.HTTPConnection(urlsplit(url).netloc, timeout=300)
            connection.request("GET", "/")
            answer = connection.getresponse()
            assert answer.status == 200 and b"<html" in answer.read()
            run.send_signal(signal.SIGINT)
            start = time.monotonic()
            out, err = run.communicate(timeout=300)
            seconds = time.monotonic() - start
        finally:
            run.kill()
    assert run.returncode == 0 and out == "" and "Traceback" not in err
    return seconds


@pytest.mark.slow
def test_it_serves_the_page_until_it_is_interrupted(scene):
    """It ends in 0.1 s, where Python's own end took 4 on a busy machine; there one of three may take as long."""
    pytest.importorskip("viser", reason="viser is not installed")
    assert any(seconds_to_end(scene) < 3 for _ in range(3))


def test_a_mistake_is_one_line(scene, tmp_path):
    for arguments, part in (([tmp_path / "no.toml"], "no.toml"), ([scene, "--host", "no.host.invalid"], "host: got")):
        result = CliRunner().invoke(app, ["view", *map(str, arguments), "--no-browser"])
        assert result.exit_code == 1 and result.stderr.startswith("error: ") and part in result.stderr
        assert result.stderr.count("\n") == 1


def test_without_viser_it_says_what_to_install(scene, monkeypatch):
    monkeypatch.setitem(sys.modules, "warpshadow.viewer.app", None)
    message = r'the viewer needs the package viser: pip install "warpshadow\[viewer\]" \(.*viewer'
    with pytest.raises(ImportError, match=message):
        ws.view(ws.load_scene(scene))
    result = CliRunner().invoke(app, ["view", str(scene)])
    assert result.exit_code == 1 and 'pip install "warpshadow[viewer]"' in result.stderr
