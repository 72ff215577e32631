"""How many images a second a viewer makes while a page orbits, and how long it takes from mouse to picture.

    python demos/benchmarks/viewer.py [--size 256] [--seconds 5]

The bunny scene of scenes.py with the shadows of its ground, rendered by the viewer's loop, encoded as JPEG as viser
does it, for pages that take each picture at once: what is left out is the browser. A page asks 50 times a second, as
viser's do. First at a fixed size, one image after another; then as the viewer chooses the size.
"""

import argparse
import dataclasses
import io
import os
import sys
import time
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

sys.path.append(str(Path(__file__).parents[2]))  # the folder of demos
import warpshadow as ws
from demos.scenes import on_ground, shipped_mesh
from warpshadow.viewer.loop import Loop
from warpshadow.viewer.page_camera import PageCamera, quaternion, rotation
from warpshadow.viewer.painter import Frame, Painter, own_page
from warpshadow.viewer.quality import FrameRate
from warpshadow.viewer.state import ViewerState

QUALITY = 80  # of the JPEGs


def encoded(frame: Frame) -> bytes:
    """A frame as a page gets it."""
    packed = io.BytesIO()
    Image.fromarray(frame.rgb).save(packed, "JPEG", quality=QUALITY)
    return packed.getvalue()


def orbited(page: PageCamera, degrees: float) -> PageCamera:
    """A page that went around the scene."""
    turned = Rotation.from_rotvec([0, degrees, 0], degrees=True)
    wxyz = quaternion(turned * rotation(page.wxyz))
    return dataclasses.replace(page, wxyz=tuple(wxyz), position=tuple(turned.apply(page.position)))


class QuickPage:
    """Takes each picture at once."""

    def __init__(self) -> None:
        self.delays: list[float] = []
        self.sizes: list[int] = []
        self.bytes: list[int] = []

    def send(self, frame: Frame, delay: float) -> None:
        """Encode a picture."""
        start = time.perf_counter()
        self.bytes.append(len(encoded(frame)))
        self.delays.append(delay + time.perf_counter() - start)
        self.sizes.append(frame.rgb.shape[0] * frame.rgb.shape[1])

    def wait(self) -> None:
        """Have it."""

    def fail(self, message: str | None) -> None:
        """Fail, too."""
        if message:
            raise RuntimeError(message)


def one_after_another(painter: Painter, viewer_state: ViewerState, page: PageCamera, count: int) -> np.ndarray:
    """Seconds of each image of an orbit, encoding included."""
    pace, seconds = FrameRate(), []
    pace.pixels = page.width * page.height
    for number in range(count):
        start = time.perf_counter()
        encoded(painter.paint(viewer_state, orbited(page, 2.0 * number), pace.moving()))
        seconds.append(time.perf_counter() - start)
    return np.array(seconds[2:])  # what is made once was made


def in_the_loop(painter: Painter, viewer_state: ViewerState, page: PageCamera, seconds: float) -> QuickPage:
    """What a page that orbits for some seconds is sent."""
    loop, taker = Loop(painter.paint, viewer_state), QuickPage()
    loop.join("page", taker)
    start = time.monotonic()
    while (now := time.monotonic() - start) < seconds:
        loop.look_from("page", orbited(page, 45.0 * now))
        time.sleep(0.02)
    loop.close()
    return taker


def main(size: int, seconds: float) -> None:
    ws.quiet()
    scene = on_ground(shipped_mesh("bunny"), ws.synthetic_sky())
    painter = Painter(scene)
    viewer_state = ViewerState.of(scene, painter.natural_stops())
    page = dataclasses.replace(own_page(scene, painter.page_scale), width=size, height=size)
    one_after_another(painter, viewer_state, page, 3)
    used = time.process_time()
    times = one_after_another(painter, viewer_state, page, 60)
    used = (time.process_time() - used) / 60
    print(f"load of the machine {os.getloadavg()[0]:.1f}, {os.cpu_count()} cores")
    print(
        f"{size} × {size}, encoding included: {1 / np.median(times):.0f} images/s at the median, {1 / times.min():.0f} "
        f"at best ({1e3 * np.median(times):.1f} and {1e3 * times.min():.1f} ms; {1e3 * used:.1f} ms of one core)"
    )
    large = dataclasses.replace(page, width=1280, height=960)
    in_the_loop(painter, viewer_state, large, 1.0)
    taker = in_the_loop(painter, viewer_state, large, seconds)
    print(
        f"in a page of 1280 × 960 for {seconds:g} s: {len(taker.delays) / seconds:.0f} images/s of "
        f"{np.median(taker.sizes):.0f} pixels and {np.median(taker.bytes) / 1e3:.0f} kB; from mouse to picture "
        f"{1e3 * np.median(taker.delays):.0f} ms"
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, default=256, help="width and height of the fixed size")
    parser.add_argument("--seconds", type=float, default=5.0, help="how long the page orbits")
    arguments = parser.parse_args()
    main(arguments.size, arguments.seconds)
