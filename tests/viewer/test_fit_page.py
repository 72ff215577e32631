"""A fit and its page: what it shows, what its buttons do, and that nothing that happens to it changes the fit."""

import functools
import http.client
import io
import os
import re
import subprocess
import sys
import threading
import time
from urllib.parse import urlsplit

import numpy as np
import pytest
import torch
from PIL import Image

import warpshadow as ws
from warpshadow import inverse
from warpshadow.inverse import checkpoint, watch

viser = pytest.importorskip("viser", reason="viser is not installed")
from browser import opened, shot  # noqa: E402
from pages import PATIENCE, WirePage  # noqa: E402

pytestmark = pytest.mark.filterwarnings("ignore:Queued a .* on a closed connection")

PROGRAM = [sys.executable, "-c", "from warpshadow.cli import app; app(prog_name='warpshadow')"]


@pytest.fixture(autouse=True)
def often(monkeypatch):
    """Show whatever happens at once."""
    monkeypatch.setattr(watch, "_MIN_INTERVAL", 0.02)
    monkeypatch.setattr(watch, "_MAX_TIME_SHARE", 0.5)


@pytest.fixture
def viewer():
    viewer = inverse.FitViewer(port=0)
    yield viewer
    viewer.close()


@pytest.fixture
def page(viewer):
    page = viewer_state(viewer)
    yield page
    page.close()


@functools.cache
def problem():
    """The albedo of a ball."""
    ball = ws.Body(ws.icosphere(subdivisions=1), blockers=0)
    scene = ws.Scene([ball], ws.synthetic_sky(height=16), ws.Camera.look_at((0, 0, 5), (0, 0, 0), size=(16, 12)))
    return inverse.Problem(scene, inverse.Target(0.5 * ws.render(scene)), inverse.Albedo(0))


STAGES = inverse.Stage(8, learning_rate=1e-3, scale=0.5, candidates=2), inverse.Stage(8, learning_rate=1e-3)


def viewer_state(viewer):
    """A page that looks: until it says from where, it is none to the server."""
    page = WirePage(viewer.url)
    page.look_from()
    page.until(lambda message: "preparing" in str(message) or "stage" in str(message))
    return page


class Running:
    """A fit in a thread of its own."""

    def __init__(self, viewer, stages=STAGES, **options):
        def run():
            self.result = inverse.fit(problem(), stages, tolerance=0, view=viewer, progress=False, **options)

        self._thread = threading.Thread(target=run)
        self._thread.start()

    def ended(self):
        self._thread.join(PATIENCE)
        assert not self._thread.is_alive()
        return self.result


@functools.cache
def unwatched():
    return inverse.fit(problem(), STAGES, tolerance=0, progress=False)


def assert_same(result, expected):
    assert result.losses == expected.losses and result.reason == expected.reason
    for name, own in expected.values.items():
        for key, tensor in own.items():
            assert torch.equal(result.values[name][key], tensor)


def press(page, label):
    page.say("GuiUpdateMessage", uuid=page.input(label), updates={"value": True})


def pictures(page):
    """Those that a page was sent."""
    sent = [m.get("updates", {}).get("_data") for m in page.heard if m["type"] == "GuiUpdateMessage"]
    return [data for data in sent if isinstance(data, bytes)]


def iterations(page):
    """The most that a page was told."""
    said = [str(message.get("updates", {}).get("content")) for message in page.heard]
    return max((int(count) for note in said for count in re.findall(r"iteration (\d+) · loss", note)), default=0)


@pytest.fixture
def waiting(viewer, page, tmp_path):
    """A fit that waits after its first iteration, since Pause was pressed before it began."""
    press(page, "Pause")
    page.until(lambda message: "Go on" in str(message))
    running = Running(viewer, checkpoint=tmp_path / "fit", checkpoint_seconds=1e9)
    page.until(lambda message: "waits · stage 1 of 2 · iteration 1 " in str(message))
    return running


def test_a_page_shows_pictures_losses_and_candidates_and_the_fit_is_as_without_it(page, waiting):
    page.until(lambda message: "least loss" in str(message))
    press(page, "Pause")  # the button as it was called at first
    page.until(lambda message: "finished after 24 iterations" in str(message))
    page.until(lambda message: "<polyline" in str(message))
    assert_same(waiting.ended(), unwatched())
    image = np.asarray(Image.open(io.BytesIO(pictures(page)[-1])).convert("RGB")).astype(float)
    assert image.shape == (12 * 16, 3 * 16 * 16, 3)
    target, found, difference = np.split(image, 3, axis=1)
    middle = slice(80, 110), slice(110, 140)
    assert found[middle].mean() > target[middle].mean() + 20  # it starts white, and the ball is gray
    assert difference[middle].mean() > difference[:20].mean() + 20 and abs(difference[:20].mean() - 128) < 3


@pytest.mark.slow
def test_a_browser_shows_pictures_losses_and_candidates_and_its_buttons_are_pressed(viewer, tmp_path):
    with opened(viewer.url, 1300, 700) as page:
        page.get_by_text("preparing").wait_for()
        page.get_by_role("button", name="Pause").click()
        page.get_by_role("button", name="Go on").wait_for()
        running = Running(viewer, checkpoint=tmp_path / "fit")
        page.get_by_text("waits · stage 1 of 2 · iteration 1 ").wait_for()
        page.get_by_text("least loss").wait_for()
        image = shot(page.locator("img[src^='data:image/jpeg'], img[src^='blob:']").last)
        height, width = (length // 6 for length in image.shape[:2])
        assert (image[3 * height, 3 * width] > 150).all()  # a ball, which starts white
        assert (image[3 * height, 5 * width] > 140).all()  # where it is brighter than in the target
        assert np.abs(image[5, 4 * width + 20] - 128).max() < 5  # and beside it, where both are black
        page.get_by_role("button", name="Go on").click()
        page.get_by_text("finished after 24 iterations").wait_for()
        assert page.get_by_role("button", name="Stop").is_disabled()
        assert page.locator("polyline").count() == 3  # of two candidates, and of the second stage
    assert_same(running.ended(), unwatched())


def test_pause_keeps_a_fit_until_it_is_to_go_on(page, waiting):
    page.rest(0.5)
    assert iterations(page) == 1
    press(page, "Pause")  # the button as it was called at first
    page.until(lambda message: "finished after" in str(message))
    assert_same(waiting.ended(), unwatched())


def test_stop_leaves_a_checkpoint_that_the_same_fit_goes_on_from(tmp_path, page, waiting):
    press(page, "Stop")
    stopped = waiting.ended()
    page.until(lambda message: "stopped after 1 iterations" in str(message))
    assert stopped.reason == "stopped" and [len(run) for run in stopped.losses] == [1]
    assert stopped.images().shape == (1, 12, 16, 4)
    again = inverse.fit(problem(), STAGES, tolerance=0, progress=False, checkpoint=tmp_path / "fit")
    assert_same(again, unwatched())


def test_what_is_stopped_has_the_best_values_so_far(viewer, page):
    stages = [inverse.Stage(10**6, learning_rate=0.02)]
    running = Running(viewer, stages)
    page.until(lambda _: iterations(page) > 5)
    press(page, "Stop")
    result = running.ended()
    color = result.values["albedo[0]"]["color"]
    with torch.no_grad():
        model = inverse.model.Model(problem(), result.context, inverse.Stage())
        loss = float(model.loss(result.values)[0])
    assert loss <= min(result.losses[0]) < result.losses[0][0] and torch.isfinite(color).all()


def test_a_closed_page_stops_nothing(viewer, page, waiting):
    page.close()
    other = viewer_state(viewer)
    press(other, "Go on")  # what the new page was told
    other.until(lambda message: "finished after 24 iterations" in str(message))
    other.close()
    assert_same(waiting.ended(), unwatched())


def test_nothing_is_drawn_while_nobody_looks(viewer, monkeypatch):
    drawn = []
    monkeypatch.setattr(watch, "pictures", lambda fit: drawn.append(fit) or np.zeros((8, 8, 3), np.uint8))
    assert_same(Running(viewer).ended(), unwatched())
    assert len(drawn) == 1  # at the end


def test_an_error_in_the_view_is_shown_and_leaves_the_fit_running(viewer, page, monkeypatch):
    def broken(_):
        raise RuntimeError("no <memory>")

    monkeypatch.setattr(watch, "pictures", broken)
    with pytest.warns(UserWarning, match="the view of the fit failed .*no <memory>.*; the fit goes on") as warned:
        running = Running(viewer)
        page.until(lambda message: "RuntimeError: no &lt;memory&gt;" in str(message))
        assert_same(running.ended(), unwatched())
    assert len([each for each in warned if "view of the fit" in str(each.message)]) == 1
    page.until(lambda message: "finished after" in str(message))


def test_an_error_that_is_over_is_not_shown_any_more(viewer, page, monkeypatch):
    working = watch.pictures
    calls, seen = [], threading.Event()

    def broken_once(fit):
        calls.append(fit)
        if len(calls) == 1:
            raise RuntimeError("once")
        assert seen.wait(PATIENCE)  # the page is sent only the newest of two messages that follow close on each other
        return working(fit)

    monkeypatch.setattr(watch, "pictures", broken_once)
    with pytest.warns(UserWarning, match="once"):
        running = Running(viewer)
        page.until(lambda message: "RuntimeError: once" in str(message))
        since = len(page.heard)
        seen.set()
        page.until(lambda message: message.get("updates") == {"content": ""}, since)
        running.ended()


def test_light_alone_which_takes_no_images_is_drawn_too(viewer, page):
    lit = problem()
    light = inverse.Problem(lit.scene, lit.targets, inverse.Light(2), still=None)
    inverse.fit(light, [inverse.Stage(3)], view=viewer, progress=False)
    page.until(lambda message: "finished after 3 iterations" in str(message))
    assert pictures(page)


def test_pages_hear_the_end_of_a_fit_whose_process_ends_right_after(viewer, page):
    server = viewer.page._server
    server._websock_server._background_event_loop.call_soon_threadsafe(time.sleep, 0.3)  # a busy machine
    viewer.page.end("finished after 3 iterations")
    server.stop()  # as Python does at its exit
    page.until(lambda message: "finished after 3 iterations" in str(message))


def test_view_is_asked_for_by_true_or_a_viewer(monkeypatch, capsys):
    opened = []
    monkeypatch.setattr("webbrowser.open", opened.append)
    inverse.fit(problem(), [inverse.Stage(2)], view=True, progress=True)
    (url,) = opened
    assert url.startswith("http://127.0.0.1:") and url in capsys.readouterr().out
    with pytest.raises(OSError):  # it is closed
        http.client.HTTPConnection(urlsplit(url).netloc, timeout=2).request("GET", "/")
    with pytest.raises(ValueError, match="view: got 'page', expected"):
        inverse.fit(problem(), [inverse.Stage(2)], view="page", progress=False)


def test_a_page_for_everybody_warns_and_a_port_out_of_range_is_refused():
    with pytest.raises(ValueError, match="port: got 70000, expected at most 65535"):
        inverse.FitViewer(port=70000)
    with pytest.warns(UserWarning, match="everybody who can reach"):
        viewer = inverse.FitViewer(host="0.0.0.0", port=0)
    viewer.close()


def test_files_are_not_taken(viewer, page):
    start = {"source_component_uuid": page.input("Stop"), "transfer_uuid": "x", "filename": "a", "mime_type": "b"}
    page.say("FileTransferStartUpload", size_bytes=1 << 40, part_count=9, **start)
    page.rest(0.5)
    server = viewer.page._server
    assert not server.gui._current_file_upload_states
    assert not any(client.gui._current_file_upload_states for client in server.get_clients().values())


FILE = """
scene = "scene.toml"
tolerance = 0
[[target]]
image = "target.exr"
[[free.albedo]]
body = 0
[[stage]]
iterations = 100000
"""


@pytest.mark.slow
def test_stop_is_to_the_command_what_an_interrupt_is(tmp_path):
    ws.write_scene(problem().scene, tmp_path)
    ws.write_image(tmp_path / "target.exr", problem().targets[0].image)
    (tmp_path / "fit.toml").write_text(FILE)
    command = [*PROGRAM, "fit", str(tmp_path / "fit.toml"), "-o", str(tmp_path / "out")]
    command += ["--view", "--port", "0", "--no-browser"]
    environment = os.environ | {"PYTHONUNBUFFERED": "1"}
    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen(command, **streams, text=True, env=environment) as run:
        try:
            page = WirePage(re.search(r"http://127\.0\.0\.1:\d+", run.stdout.readline()).group())
            page.look_from()
            page.until(lambda _: iterations(page))
            press(page, "Stop")
            page.until(lambda message: "stopped after" in str(message))
            _, err = run.communicate(timeout=300)
        finally:
            run.kill()
    assert run.returncode == 130 and "the same command goes on from" in err and "Traceback" not in err
    state = checkpoint.load(tmp_path / "out" / "checkpoint")
    assert len(state["losses"][0]) >= iterations(page) and state["reason"] is None
    assert not (tmp_path / "out" / "scene.toml").exists()
