"""A page in a real browser, where Playwright and a Chromium are found; tests that ask for it are skipped elsewhere."""

import contextlib
import io
import shutil

import numpy as np
import pytest
from PIL import Image

# WebGL in software, which needs no GPU
FLAGS = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
FLAGS += ["--ignore-gpu-blocklist"]

PATIENCE = 60.0  # seconds: software WebGL on a busy machine


def chromium():
    """Where it is; without it, what asks is skipped: a test, or all of a module."""
    path = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if path is None:
        pytest.skip("no Chromium: apt-get install chromium", allow_module_level=True)
    return path


@contextlib.contextmanager
def opened(url, width, height):
    """Playwright's page of an address."""
    playwright = pytest.importorskip(
        "playwright.sync_api", reason="Playwright is not installed: pip install playwright"
    )
    path = chromium()
    with playwright.sync_playwright() as started:
        browser = started.chromium.launch(executable_path=path, args=FLAGS)
        page = browser.new_page(viewport={"width": width, "height": height})
        page.set_default_timeout(1e3 * PATIENCE)
        page.goto(url)
        yield page
        browser.close()


def shot(place):
    """What a page, or a part of it, shows: float of shape [row, column, 3]."""
    return np.asarray(Image.open(io.BytesIO(place.screenshot())).convert("RGB")).astype(float)
