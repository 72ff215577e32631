"""Preparing in another process: what it leaves in the caches, what it says, and how it ends."""

import dataclasses
import time

import pytest

import warpshadow as ws
from warpshadow.assets.cache import cached_files

pytest.importorskip("viser", reason="viser is not installed")
from pages import PATIENCE, WirePage

from warpshadow.viewer.app import ViewerApp
from warpshadow.viewer.painter import Painter
from warpshadow.viewer.preparing import Preparation, is_cached_on_disk

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore:Queued a .* on a closed connection")]

LONG = 10 * PATIENCE  # a process compiles kernels


@pytest.fixture(autouse=True)
def empty_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("WARPSHADOW_CACHE_DIR", str(tmp_path))


def scene(blockers=2, subdivisions=2):
    ball = ws.Body(ws.icosphere(subdivisions=subdivisions), blockers=blockers)
    camera = ws.Camera.look_at((0, 0, 5), (0, 0, 0), size=(64, 48))
    return ws.Scene([ball], ws.synthetic_sky(height=32), camera, ws.Visibility(method="directional"))


def eventually(condition):
    end = time.monotonic() + LONG
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.05)


def test_another_process_fills_the_caches_and_says_how_far_it_is():
    notes = []
    assert not is_cached_on_disk(Painter(scene()))
    Preparation(scene(), notes.append)
    eventually(lambda: "" in notes)
    assert is_cached_on_disk(Painter(scene())) and len(cached_files("spheres")) == 1
    assert len(cached_files("self_shadows")) == 2  # as it moves, and at rest
    assert all(note.startswith("rendering: ") for note in notes[:-1]) and notes[-1] == ""  # a fast one says nothing


def test_a_process_that_is_closed_ends_and_keeps_what_it_has():
    for count in (512, 504, 496, 488, 480):  # one may be closed before there is a part to keep, or after
        notes = []
        preparation = Preparation(scene(count, subdivisions=3), notes.append)
        eventually(lambda notes=notes: any("fitting" in note and " 0 of" not in note for note in notes))
        preparation.close()
        assert preparation._process.wait(LONG) is not None
        assert "" not in notes
        if any(path.name.endswith(".part.npz") for path in cached_files("spheres")):
            return
    pytest.fail("no process kept a part of its fit")


def test_pages_see_rays_until_spheres_are_there():
    site = ViewerApp(scene(), host="127.0.0.1", port=0)
    page = WirePage(site.url)
    try:
        page.look_from(position=(0, 0, -8.0))
        page.until(lambda message: " rays," in str(message))
        eventually(lambda: site._is_prepared)
        page.until(lambda message: " directions," in str(message))
    finally:
        page.close()
        site.close()


def test_spheres_and_tables_that_are_cached_are_used_at_once_and_both_are_needed():
    ws.spheres.fit_spheres(scene().bodies[0].mesh, 2, progress=False)
    assert not is_cached_on_disk(Painter(scene()))  # its shadow on itself is not traced yet
    for receivers in ("vertex", "pixel"):  # as bodies that move have it, and those at rest
        ball = dataclasses.replace(scene().bodies[0], receivers=receivers)
        ws.Renderer(dataclasses.replace(scene(), bodies=(ball,)), progress=False).render()
    site = ViewerApp(scene(), host="127.0.0.1", port=0)
    assert site._preparation is None
    site.close()
