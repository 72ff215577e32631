"""The viewer in a browser: viser's server, a page for each client, and the panel beside the picture."""

import contextlib
import html
import time
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import viser
import warp as wp

from warpshadow.scene.scene import Scene
from warpshadow.scene.visibility import SPHERE_METHODS
from warpshadow.tuning.tune import resolved
from warpshadow.viewer.loop import Loop
from warpshadow.viewer.page_camera import PageCamera, rotation, upward
from warpshadow.viewer.painter import Frame, Painter, bounds, own_page
from warpshadow.viewer.panel import Panel
from warpshadow.viewer.preparing import Preparation, is_cached_on_disk
from warpshadow.viewer.quality import Quality
from warpshadow.viewer.server import Server, check_address
from warpshadow.viewer.state import ViewerState

_PICTURE_TIMEOUT = 2.0  # seconds that a page has to take a picture before it is sent the next
_STATUS_SECONDS = 0.25  # between two notes of how long pictures take
_CORNER = (  # of the page: below the picture on the left, out of the mouse's way
    "position:fixed;left:0.8em;bottom:0.8em;padding:0.2em 0.6em;font-size:12px;line-height:1.4;color:#ddd;"
    "background:#0008;border-radius:4px;pointer-events:none"
)
_MOVING_JPEG, _RESTING_JPEG = 80, 95


class ViewerApp:
    """A scene in the browser, until it is closed.

    Args:
        path: The scene's file, which is saved with the changes in it; None where it has none.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        host: str,
        port: int,
        device: wp.DeviceLike = "cpu",
        progress: bool = True,
        path: Path | None = None,
    ):
        check_address(host, port)
        scene = resolved(scene, device=device, progress=progress)
        self.painter = Painter(scene, device=device, progress=progress)  # paints pictures
        self._is_prepared = is_cached_on_disk(self.painter, device=device)
        self._preparation: Preparation | None = None
        self._pages: dict[int, _ViserPage] = {}
        stops = self.painter.natural_stops(self._look_for_now(ViewerState.of(scene)))
        self.loop = Loop(self._paint, ViewerState.of(scene, stops))  # renders for pages
        self._server = Server(host, port)
        self.url = self._server.url  # where the page is
        self._start_where_the_scene_looks()
        self._panel = Panel(self._server, self.loop, self.painter, path)
        self._server.on_client_connect(self._let_in)
        self._server.on_client_disconnect(self._let_go)
        if not self._is_prepared:
            self._preparation = Preparation(scene, self._note, device=device)

    def close(self) -> None:
        """Close all pages and the server."""
        if self._preparation is not None:
            self._preparation.close()
        self.loop.close()
        self._server.close()

    def _paint(self, viewer_state: ViewerState, page: PageCamera, quality: Quality, *, depth: bool) -> Frame:
        return self.painter.paint(self._look_for_now(viewer_state), page, quality, depth=depth)

    def _look_for_now(self, viewer_state: ViewerState) -> ViewerState:
        """Shown until spheres, tables and kernels are there: the same by rays, as stills, which need none."""
        uses_rays = not self._is_prepared and viewer_state.method in SPHERE_METHODS
        return replace(viewer_state, method="ray-traced", sampling="shared") if uses_rays else viewer_state

    def _note(self, text: str) -> None:
        """Name on all pages the work under way; paint again when all is done."""
        for page in list(self._pages.values()):
            page.note(f"by rays until all is prepared: {text}" if text else "")
        if not text:
            self._is_prepared = True
            self.loop.repaint()

    def _start_where_the_scene_looks(self) -> None:
        scene, scale = self.painter.scene, self.painter.page_scale
        page = own_page(scene, scale)
        forward, position = rotation(page.wxyz).as_matrix()[:, 2], np.array(page.position)
        low, high = bounds(scene)
        distance = max(float(forward @ (scale * 0.5 * (low + high) - position)), 0.5)
        up = upward(scene.camera)
        self._server.scene.set_up_direction(up)
        first = self._server.initial_camera
        first.position = position
        first.look_at = position + distance * forward
        first.up = np.array(up)
        first.fov = float(np.radians(page.fov_y))

    async def _let_in(self, client: viser.ClientHandle) -> None:
        page = self._pages[client.client_id] = _ViserPage(client)
        self.loop.join(client.client_id, page)
        self._moved(client)

        @client.camera.on_update
        async def _(_: viser.CameraHandle) -> None:
            self._moved(client)

    def _moved(self, client: viser.ClientHandle) -> None:
        """Move a page's view, unless its message is no camera."""
        camera = client.camera
        try:
            seen_camera = PageCamera(
                tuple(camera.wxyz),
                tuple(camera.position),
                float(np.degrees(camera.fov)),
                camera.image_width,
                camera.image_height,
            )
        except (ValueError, TypeError) as error:
            self._pages[client.client_id].fail(f"camera: {error}")
        else:
            self.loop.look_from(client.client_id, seen_camera)

    async def _let_go(self, client: viser.ClientHandle) -> None:
        self.loop.leave(client.client_id)
        page = self._pages.pop(client.client_id, None)
        if page is not None:
            page.close()


class _ViserPage:
    """A client of viser's, for the loop.

    A page answers a question about its storage after it has taken all that was sent before; so we know that it has
    taken a picture, and how long that took.
    """

    def __init__(self, client: viser.ClientHandle):
        self._client = client
        self._asking = ThreadPoolExecutor(1)
        self._receipt: Future[None] | None = None
        self._status = client.gui.add_html("", order=-1.0)
        self._last_status, self._message, self._prepared, self._content = 0.0, "", "", ""

    def send(self, frame: Frame, delay: float) -> None:
        """Begin to send a picture."""
        quality = _MOVING_JPEG if frame.quality.is_moving else _RESTING_JPEG
        request_time = time.monotonic() - delay
        self._client.scene.set_background_image(frame.rgb, format="jpeg", jpeg_quality=quality, depth=frame.depth)
        self._client.flush()
        with contextlib.suppress(RuntimeError):  # it was closed in the meantime
            self._receipt = self._asking.submit(self._ask, frame, request_time)

    def wait(self) -> None:
        """Return when the page has taken the last picture, or after some seconds."""
        if self._receipt is not None:
            with contextlib.suppress(CancelledError):  # it was closed
                self._receipt.result()

    def fail(self, message: str | None) -> None:
        """Show an error, or clear it."""
        if (message or "") != self._message:
            self._message = message or ""
            self._write(f'<b style="color:#f66">{html.escape(self._message)}</b>' if message else "")

    def note(self, text: str) -> None:
        """Show the work under way; empty for none."""
        self._prepared = text
        self._write(self._content)

    def close(self) -> None:
        """Ask nothing more."""
        self._asking.shutdown(wait=False, cancel_futures=True)

    def _ask(self, frame: Frame, request_time: float) -> None:
        with contextlib.suppress(RuntimeError, TimeoutError):  # RuntimeError: gone, or its storage is blocked
            self._client.local_storage.get_item("taken", timeout=_PICTURE_TIMEOUT)
        current_time = time.monotonic()
        if not self._message and (current_time - self._last_status > _STATUS_SECONDS or not frame.quality.is_moving):
            self._last_status = current_time
            height, width, _ = frame.rgb.shape
            delay = (
                f"{1e3 * (current_time - request_time):.0f} ms from mouse to picture"
                if frame.quality.is_moving
                else "at rest"
            )
            error = "" if frame.error is None else f"<br>error against rays {frame.error:.2%}"
            self._write(f"{delay}<br>{width} × {height}, {frame.cells}, {1e3 * frame.seconds:.0f} ms{error}")

    def _write(self, content: str) -> None:
        self._content = content
        content_and_notes = "<br>".join(filter(None, (content, html.escape(self._prepared))))
        self._status.content = f'<div style="{_CORNER}">{content_and_notes}</div>' if content_and_notes else ""
