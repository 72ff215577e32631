"""The loop that renders: for each page the latest that it asked for, quickly while something moves, well once it rests.

A page has a thread and a place for one request; a newer request takes the place of an older one, so none waits behind
another. All threads paint with one painter, one at a time. A page is sent its next picture only after it has taken the
last, so a slow page gets fewer of them and delays no other. Nothing here knows of browsers: tests put their own pages.
"""

from __future__ import annotations

import dataclasses
import threading
import time
from collections.abc import Callable, Hashable
from typing import Any, Protocol

from warpshadow.viewer.page_camera import PageCamera
from warpshadow.viewer.painter import Frame
from warpshadow.viewer.quality import FrameRate, Quality
from warpshadow.viewer.state import ViewerState

REST = 0.2  # so long after the last request of any page all rests [s]


class Page(Protocol):
    """Interface of a page for the loop. Its functions run in the page's own thread."""

    def send(self, frame: Frame, delay: float) -> None:
        """Begin to send a picture, ``delay`` seconds after it was asked for."""

    def wait(self) -> None:
        """Return when the page has taken the last picture, or after a while if it does not say so."""

    def fail(self, message: str | None) -> None:
        """Show an error; None clears it."""


class Paint(Protocol):
    """The painter: :meth:`warpshadow.viewer.painter.Painter.paint`."""

    def __call__(self, viewer_state: ViewerState, page: PageCamera, quality: Quality, *, depth: bool) -> Frame:
        """Paint the image of a page."""


class Loop:
    """Paints for any number of pages."""

    def __init__(self, paint: Paint, viewer_state: ViewerState, *, rest: float = REST):
        self.viewer_state = viewer_state
        self.depth = False  # whether pages are sent how far away everything is
        self._paint, self._rest = paint, rest
        self._painting = threading.Lock()
        self._changed = threading.Condition()  # guards the attributes below
        self._clients: dict[Hashable, _Client] = {}
        self._last_request = 0.0

    def join(self, name: Hashable, page: Page) -> None:
        """Let a page in; it is sent nothing until it says where it looks from."""
        client = _Client(page)
        with self._changed:
            self._clients[name] = client
        threading.Thread(target=self._serve, args=(client,), name=f"page {name}", daemon=True).start()

    def leave(self, name: Hashable) -> None:
        """Let a page go."""
        with self._changed:
            client = self._clients.pop(name, None)
            if client is not None:
                client.is_open = False
            self._changed.notify_all()

    def close(self) -> None:
        """Let all pages go."""
        for name in list(self._clients):
            self.leave(name)

    def look_from(self, name: Hashable, camera: PageCamera) -> None:
        """A page looks from somewhere else."""
        with self._changed:
            client = self._clients.get(name)
            if client is not None and camera != client.camera:
                client.camera = camera
                self._ask(client)

    def change(self, **changes: Any) -> ViewerState:
        """Show something else to all pages.

        Raises:
            ValueError: for an invalid state; then nothing changes.
        """
        return self.update(lambda viewer_state: dataclasses.replace(viewer_state, **changes))

    def update(self, change: Callable[[ViewerState], ViewerState]) -> ViewerState:
        """Send all pages a function of the current state, with no other change between."""
        with self._changed:
            viewer_state = change(self.viewer_state)
            if viewer_state != self.viewer_state:
                self.viewer_state = viewer_state
                self._ask(*self._clients.values())
            return self.viewer_state

    def repaint(self, *, depth: bool | None = None) -> None:
        """Paint again for all pages, with or without depth."""
        with self._changed:
            self.depth = self.depth if depth is None else depth
            self._ask(*self._clients.values())

    def camera_of(self, name: Hashable) -> PageCamera | None:
        """Camera of a page; None where the page is gone or has sent none."""
        with self._changed:
            client = self._clients.get(name)
            return None if client is None else client.camera

    @property
    def is_content(self) -> bool:
        """Whether all pages have their best pictures, or the reason why they have none."""
        with self._changed:
            return all(client.is_content and client.request_time is None for client in self._clients.values())

    def _ask(self, *clients: _Client) -> None:
        self._last_request = time.monotonic()
        for client in clients:
            if client.request_time is None:  # a delay counts from the oldest request that a picture answers
                client.request_time = self._last_request
        self._changed.notify_all()

    def _serve(self, client: _Client) -> None:
        frame_rate, last = FrameRate(), None
        while (job := self._next(client, frame_rate, last)) is not None:
            camera, quality, request_time = job
            try:
                with self._painting:
                    start = time.monotonic()
                    viewer_state = self.viewer_state
                    frame = self._paint(viewer_state, camera, quality, depth=self.depth)
            except Exception as error:  # report any error on the page, and go on with the others
                client.page.fail(f"{type(error).__name__}: {error}")
                last = None
                continue
            seconds = time.monotonic() - start
            if quality.is_moving:
                frame_rate.learn_from(seconds)
            client.page.fail(None)
            client.page.wait()
            if client.is_open:
                client.page.send(frame, time.monotonic() - request_time)
            last = camera, quality, seconds

    def _next(
        self, client: _Client, frame_rate: FrameRate, last: tuple[PageCamera, Quality, float] | None
    ) -> tuple[PageCamera, Quality, float] | None:
        """Wait for the next request to paint, and return it with its time. None where the page is gone."""
        with self._changed:
            while client.is_open:
                if client.request_time is not None and client.camera is not None:
                    request_time, client.request_time, client.is_content = client.request_time, None, False
                    return client.camera, frame_rate.moving(), request_time
                better_image = None
                if last is not None:
                    camera, quality, seconds = last
                    better_image = frame_rate.find_better(quality, seconds, camera.width * camera.height)
                client.is_content = better_image is None
                if better_image is None:
                    self._changed.wait()
                    continue
                left = self._last_request + self._rest - time.monotonic()
                if left <= 0:
                    return camera, better_image, time.monotonic()
                self._changed.wait(left)
        return None


class _Client:
    """A page, and the latest that it asked for."""

    def __init__(self, page: Page):
        self.page = page
        self.camera: PageCamera | None = None
        self.request_time: float | None = None  # when; None where that is answered
        self.is_content = False  # whether it has the best picture of the latest that it asked for
        self.is_open = True
