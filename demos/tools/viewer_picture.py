"""A picture of the viewer, as a browser shows it: warpshadow/viewer/viewer.png.

    python demos/tools/viewer_picture.py [--output PNG] [--chromium /usr/bin/chromium]

Needs Playwright and a Chromium, which draws in software.
"""

import argparse
import shutil
import sys
from pathlib import Path

from playwright.sync_api import sync_playwright

sys.path.append(str(Path(__file__).parents[2]))  # the folder of demos
import warpshadow as ws
from demos.scenes import on_ground, shipped_mesh

FLAGS = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
SIZE = {"width": 1000, "height": 640}


def main(output: Path, chromium: str) -> None:
    ws.quiet()
    ground = ws.Body(ws.plane(12.0, 64), receivers="pixel", name="ground")
    bunny = on_ground(shipped_mesh("bunny"), ws.synthetic_sky(), ground=ground)
    camera = ws.Camera.look_at((1.2, 2.8, 5.6), (0.9, 0.8, 0), fov_y=36)
    viewer = ws.view(ws.Scene(bunny.bodies, bunny.light, camera), port=0, browser=False)
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=[*FLAGS, "--ignore-gpu-blocklist"])
        page = browser.new_page(viewport=SIZE)
        page.goto(viewer.url)
        page.get_by_text("at rest").wait_for(timeout=90e3)
        page.get_by_text("Software WebGL").locator("xpath=../..").get_by_role("button").click()
        page.get_by_label("Drag").click()
        page.get_by_text("0: bunny").click()
        page.locator(".mantine-ScrollArea-viewport").first.evaluate("panel => panel.scrollTo(0, 0)")
        page.wait_for_timeout(12e3)
        page.screenshot(path=output)
        browser.close()
    viewer.close()
    print(f"wrote {output}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=Path("warpshadow/viewer/viewer.png"), help="where it goes")
    parser.add_argument("--chromium", default=shutil.which("chromium"), help="the browser")
    arguments = parser.parse_args()
    main(arguments.output, arguments.chromium)
