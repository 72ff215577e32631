"""The server, with a page that speaks its wire format: what it is sent, and what it cannot do."""

import http.client
import io
import time
from urllib.parse import urlsplit

import numpy as np
import pytest
from PIL import Image

import warpshadow as ws

viser = pytest.importorskip("viser", reason="viser is not installed")
from pages import PATIENCE, WirePage, is_image  # noqa: E402
from websockets.exceptions import ConnectionClosed  # noqa: E402

from warpshadow.viewer.app import ViewerApp  # noqa: E402
from warpshadow.viewer.server import is_own  # noqa: E402

pytestmark = pytest.mark.filterwarnings("ignore:Queued a .* on a closed connection")  # a site says so to all but pytest


def scene():
    ball = ws.Body(ws.icosphere(subdivisions=2), blockers=ws.Spheres([[0, 0, 0]], [1.0]), name="ball", roughness=0.6)
    camera = ws.Camera.look_at((0, 0, 5), (0, 0, 0), size=(160, 120))
    return ws.Scene([ball], ws.synthetic_sky(), camera)


@pytest.fixture(scope="module")
def site():
    site = ViewerApp(scene(), host="127.0.0.1", port=0)
    yield site
    site.close()


@pytest.fixture
def page(site):
    page = WirePage(site.url)
    yield page
    page.close()


def eventually(condition):
    end = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.02)


def picture(data):
    return np.asarray(Image.open(io.BytesIO(data)).convert("RGB")).astype(float)


def shown(site, page, since=0):
    """The best picture of what was asked for since some number of messages."""
    page.until(is_image, since)
    page.until(lambda _: site.loop.is_content)
    page.rest(0.5)
    return picture(page.images()[-1])


def test_a_page_is_sent_the_ball_and_a_note_of_how_long_it_took(site, page):
    page.look_from(position=(0, 0, -8.0))
    image = shown(site, page)
    assert image.shape == (120, 160, 3)
    middle, corner = image[55:65, 75:85].mean(), image[:5, :5].mean()
    assert middle > corner + 30 and len(page.images()) >= 2
    assert any("160 × 120, 128 directions" in str(message) for message in page.heard)


def test_a_camera_that_is_none_is_refused_and_the_next_is_taken(page):
    page.look_from(position=(float("nan"), 0, 0))
    page.until(lambda message: "camera: position: got" in str(message))
    assert not page.images()
    page.look_from(size=(1 << 30, 10))
    page.until(lambda message: "camera: width: got" in str(message))
    page.look_from()
    page.until(is_image)


def test_inputs_change_the_light_unless_they_make_no_sense(site, page):
    page.look_from(position=(0, 0, -8.0))
    before = shown(site, page)
    since = len(page.heard)
    page.enter("Turn [°]", 120.0)
    assert np.abs(shown(site, page, since) - before).mean() > 2
    assert site.loop.viewer_state.turn == 120.0
    for value in (float("nan"), 1e9):
        since = len(page.heard)
        page.enter("Turn [°]", value)
        page.until(lambda message: "turn: got" in str(message), since)  # and says so
        assert site.loop.viewer_state.turn == 120.0
    page.enter("Method", "magic")
    page.until(lambda message: "method: got 'magic'" in str(message))
    page.enter("Turn [°]", 0.0)
    eventually(lambda: site.loop.viewer_state.turn == 0.0)


def test_a_slider_changes_the_gloss_of_a_body(site, page):
    page.look_from(position=(0, 0, -8.0))
    before = shown(site, page)
    since = len(page.heard)
    page.enter("ball: metallic", 1.0)
    assert np.abs(shown(site, page, since) - before).mean() > 1
    assert site.loop.viewer_state.gloss[0]["metallic"] == 1.0
    page.enter("ball: roughness", 7.0)
    page.until(lambda message: "roughness: got 7.0" in str(message))
    page.enter("ball: metallic", 0.0)
    eventually(lambda: site.loop.viewer_state.gloss[0] == {"roughness": 0.6, "metallic": 0.0, "specular": 1.0})


def test_a_body_is_dragged_by_handles_and_put_back(site, page):
    page.look_from(position=(0, 0, -8.0))
    before = shown(site, page)
    page.enter("Drag", "0: ball")
    page.until(lambda message: message["type"] == "TransformControlsMessage")
    page.until(lambda message: is_image(message) and message["depth_data"])  # which hides handles
    since = len(page.heard)
    page.say("TransformControlsUpdateMessage", name="/handles", wxyz=(1, 0, 0, 0), position=(1.5, 0, 0), owner="")
    eventually(lambda: site.loop.viewer_state.poses[0].translation[0] > 0.1)
    after = shown(site, page, since)
    columns = np.arange(160)

    def center(image):
        weights = np.clip(image.mean(axis=(0, 2)) - image[:5, :5].mean(), 0, None)
        return (weights * columns).sum() / weights.sum()

    assert center(after) > center(before) + 5
    page.say("TransformControlsUpdateMessage", name="/handles", wxyz=(0, 0, 0, 0), position=(9, 9, 9), owner="")
    page.enter("Drag", "nothing")
    page.say("GuiUpdateMessage", uuid=page.input("Put back"), updates={"value": True})
    eventually(lambda: site.loop.viewer_state.poses[0].translation == (0.0, 0.0, 0.0))


def test_spheres_are_shown_and_hidden(site, page):
    page.look_from()
    page.enter("Show spheres", True)
    message = page.until(lambda message: message["type"] == "BatchedMeshesMessage")
    assert message["name"] == "/spheres/0"
    since = len(page.heard)
    page.enter("Show spheres", False)
    page.until(lambda message: message["type"] == "RemoveSceneNodeMessage", since)
    for shows in (True, False, True, False):  # faster than they can be shown
        page.enter("Show spheres", shows)
    page.rest()
    assert not site._panel._spheres


def test_a_scene_is_saved_to_the_page_not_to_the_server(page):
    page.look_from()
    page.until(is_image)
    page.say("GuiUpdateMessage", uuid=page.input("Save scene"), updates={"value": True})
    start = page.until(lambda message: message["type"] == "FileTransferStartDownload")
    assert start["filename"] == "scene.zip" and start["size_bytes"] > 1000


def test_two_pages_look_from_where_they_want_and_see_one_scene(site, page):
    other = WirePage(site.url)
    page.look_from(position=(0, 0, -8.0))
    other.look_from(position=(0, 0, -4.0))
    for each in (page, other):
        each.until(is_image)
    while not site.loop.is_content:  # each page answers for itself
        page.listen(0.02)
        other.listen(0.02)
    near, far = shown(site, other), shown(site, page)
    background = far[:3, :3].mean()
    assert (near.mean(axis=-1) > background + 30).mean() > 2 * (far.mean(axis=-1) > background + 30).mean()
    other.enter("Turn [°]", 60.0)
    before = len(page.images())
    page.until(lambda _: len(page.images()) > before)
    other.close()
    page.enter("Turn [°]", 0.0)
    eventually(lambda: site.loop.viewer_state.turn == 0.0)


def test_a_page_that_leaves_is_forgotten(site):
    page = WirePage(site.url)
    page.look_from()
    eventually(lambda: site._pages)
    page.close()
    eventually(lambda: not site._pages)


def test_pages_of_others_are_not_let_in_and_one_line_says_so(site, caplog):
    with pytest.raises((ConnectionClosed, AssertionError)):
        stranger = WirePage(site.url, origin="http://example.com")
        stranger.look_from()
        for _ in range(50):
            stranger.listen(0.1)
        assert stranger.heard
    assert not site._pages
    (record,) = [record for record in caplog.records if record.name == "websockets.server"]
    assert record.getMessage().startswith("warpshadow: a page of http://example.com at 127.0.0.1:")
    assert record.exc_info is None and record.exc_text is None


@pytest.mark.parametrize(
    ("origin", "host", "is_local", "expected"),
    [
        ("http://127.0.0.1:8080", "127.0.0.1:8080", True, True),
        ("http://localhost:8080", "localhost:8080", True, True),
        ("http://[::1]:8080", "[::1]:8080", True, True),
        (None, "127.0.0.1:8080", True, True),
        ("http://example.com", "127.0.0.1:8080", True, False),
        ("http://127.0.0.1:9999", "127.0.0.1:8080", True, False),
        ("http://example.com:8080", "example.com:8080", True, False),  # a name that points here
        ("http://workstation:8080", "workstation:8080", False, True),
        ("http://example.com", "workstation:8080", False, False),
        ("null", "127.0.0.1:8080", True, False),
    ],
)
def test_a_page_is_our_own_if_it_came_from_where_it_connects_to(origin, host, is_local, expected):
    assert is_own(origin, host, is_local=is_local) is expected


def test_files_are_not_taken_and_no_tunnel_is_opened(site, page):
    page.look_from()
    uuid = page.input("Turn [°]")
    start = {"source_component_uuid": uuid, "transfer_uuid": "x", "filename": "a", "mime_type": "b", "part_count": 9}
    page.say("FileTransferStartUpload", size_bytes=1 << 40, **start)
    page.say("ShareUrlRequest")
    page.rest()
    assert not site._server.gui._current_file_upload_states
    for client in site._server.get_clients().values():
        assert not client.gui._current_file_upload_states
    assert site._server._share_tunnel is None


@pytest.mark.parametrize("path", ["/../../../../etc/passwd", "/%2e%2e/%2e%2e/etc/passwd", "//etc/passwd", "/_viser.py"])
def test_files_of_the_machine_are_not_served(site, path):
    connection = http.client.HTTPConnection(urlsplit(site.url).netloc, timeout=PATIENCE)
    connection.request("GET", path)
    assert connection.getresponse().status == 404


def test_an_error_in_rendering_is_shown_and_leaves_the_server_up(site, page, monkeypatch):
    page.look_from()
    page.until(is_image)

    def broken(*_, **__):
        raise RuntimeError("no <memory>")

    working = site.loop._paint
    monkeypatch.setattr(site.loop, "_paint", broken)
    page.look_from(position=(0, 0, -9.0))
    page.until(lambda message: "RuntimeError: no &lt;memory&gt;" in str(message))
    monkeypatch.setattr(site.loop, "_paint", working)
    since = len(page.heard)
    page.look_from(position=(0, 0, -10.0))
    page.until(is_image, since)


@pytest.mark.parametrize(("host", "port"), [("no.such.host.invalid", 0), ("203.0.113.7", 0), (7, 0)])
def test_an_address_where_nobody_can_serve_is_refused(host, port):
    with pytest.raises(ValueError, match="host: got .*expected an address"):
        ViewerApp(scene(), host=host, port=port)


def test_a_port_out_of_range_is_refused():
    with pytest.raises(ValueError, match="port: got 70000, expected at most 65535"):
        ViewerApp(scene(), host="127.0.0.1", port=70000)


def test_a_viewer_for_everybody_warns_and_a_notebook_shows_it():
    with pytest.warns(UserWarning, match="everybody who can reach"):
        viewer = ws.view(scene(), host="0.0.0.0", port=0, browser=False)
    assert f'<iframe src="{viewer.url}"' in viewer._repr_html_() and viewer.url.startswith("http://localhost:")
    viewer.close()


def test_what_is_no_scene_is_refused():
    with pytest.raises(ValueError, match="scene: got 'scene.toml', expected a Scene"):
        ws.view("scene.toml")
