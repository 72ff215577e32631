"""The viewer in a real browser: pixels of its page, where a Chromium and Playwright are found."""

import time

import numpy as np
import pytest
from browser import PATIENCE, chromium, opened, shot

import warpshadow as ws

pytest.importorskip("viser", reason="viser is not installed")
pytest.importorskip("playwright.sync_api", reason="Playwright is not installed: pip install playwright")
chromium()

from warpshadow.viewer.app import ViewerApp  # noqa: E402

WIDTH, HEIGHT = 900, 600
PANEL = 560  # column where the panel begins

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore:Queued a .* on a closed connection")]


def scene():
    """A bunny on a ground that fills the picture, under a sun from the left."""
    from warp.examples import get_asset_directory

    mesh = ws.load_mesh(f"{get_asset_directory()}/bunny.usd")
    low, high = mesh.bounds
    # a ball for the body and one for the head, which need no fit
    size = float((high - low).max())
    middle = 0.5 * (low + high)
    spheres = ws.Spheres(
        [middle - (0, 0.15 * size, 0), middle + (-0.2 * size, 0.15 * size, 0)], [0.3 * size, 0.2 * size]
    )
    bunny = ws.Body(
        mesh, albedo=(0.9, 0.2, 0.1), blockers=spheres, scale=2 / size, translation=(0, -2 * low[1] / size, 0)
    )
    ground = ws.Body(ws.plane(12.0, 48), albedo=(0.6, 0.6, 0.6), blockers=0, name="ground")
    light = ws.synthetic_sky(sun_direction=(-1.0, 0.8, 0.3))
    camera = ws.Camera.look_at((0.0, 5.0, 4.0), (0.6, 0.4, 0), fov_y=40, size=(WIDTH, HEIGHT))
    return ws.Scene([bunny, ground], light, camera)


@pytest.fixture(scope="module")
def site():
    site = ViewerApp(scene(), host="127.0.0.1", port=0)
    yield site
    site.close()


@pytest.fixture(scope="module")
def page(site):
    with opened(site.url, WIDTH, HEIGHT) as page:
        page.get_by_text("at rest").wait_for()
        yield page


def settled(page):
    """Pixels left of the panel, once they do not change any more."""
    last, end = shot(page)[:, :PANEL], time.monotonic() + PATIENCE
    quiet = 0
    while quiet < 3:
        assert time.monotonic() < end
        time.sleep(0.5)
        now = shot(page)[:, :PANEL]
        quiet = quiet + 1 if np.abs(now - last).max() < 8 else 0
        last = now
    return last


def red(image):
    """Where the bunny is."""
    return image[..., 0] > 1.8 * np.maximum(image[..., 1], image[..., 2])


def shadow(image):
    """Where the ground is dark: its color under the sky alone, far from any that the bunny or a notice has."""
    rows = np.arange(len(image))[:, None]
    rows = (rows > 200) & (rows < len(image) - 100)  # notices are above, the note of times below
    return rows & ~red(image) & (image.mean(axis=-1) < 0.75 * np.median(image.mean(axis=-1)))


def center(mask):
    assert mask.sum() > 200
    return np.argwhere(mask).mean(axis=0)


def enter(page, label, value):
    """Type a number beside a slider."""
    box = page.get_by_text(label, exact=True).locator("xpath=ancestor::*[.//input][1]").locator("input").last
    box.fill(str(value))
    box.press("Enter")
    box.blur()


def test_the_bunny_is_in_the_picture_where_the_camera_sees_it(site, page):
    image = settled(page)
    camera = site.painter.scene.camera
    low, high = site.painter.scene.bodies[0].world_mesh().bounds
    column, row = camera.project(0.5 * (low + high))
    found = center(red(image))
    assert abs(found[1] - column) < 0.05 * WIDTH and abs(found[0] - row) < 0.08 * HEIGHT


def test_turning_the_light_moves_the_shadow_and_not_the_bunny(site, page):
    before = settled(page)
    enter(page, "Turn [°]", 180)
    end = time.monotonic() + PATIENCE
    while site.loop.viewer_state.turn != 180 and time.monotonic() < end:
        page.wait_for_timeout(100)
    after = settled(page)
    assert site.loop.viewer_state.turn == 180
    assert center(shadow(before))[1] - center(red(before))[1] > 30  # the sun is on the left
    assert center(shadow(after))[1] - center(red(after))[1] < -30
    assert np.abs(center(red(after)) - center(red(before))).max() < 25  # its dark side is less red
    enter(page, "Turn [°]", 0)


def test_dragging_moves_the_body(site, page):
    before = settled(page)
    site._panel._drag(0)  # as its dropdown does
    page.wait_for_timeout(3000)
    handles = settled(page)
    changed = np.abs(handles - before).max(axis=-1) > 60
    assert changed.sum() > 100  # handles are seen
    # the arrow along x is red, and to the right of the bunny
    row, column = center(red(before))
    arrow = changed & red(handles) & (np.arange(PANEL)[None] > column + 40)
    y, x = np.argwhere(arrow)[np.argwhere(arrow)[:, 1].argmax()] if arrow.any() else (row, column + 120)
    page.mouse.move(int(x) - 4, int(y))
    page.wait_for_timeout(500)
    page.mouse.down()
    for step in range(1, 11):
        page.mouse.move(int(x) - 4 - 12 * step, int(y))
        page.wait_for_timeout(100)
    page.mouse.up()
    site._panel._drag(None)
    after = settled(page)
    assert site.loop.viewer_state.poses[0].translation[0] < -0.2
    assert center(red(after))[1] < center(red(before))[1] - 40
