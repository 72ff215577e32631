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

from warpshadow.viewer.look import Look
from warpshadow.viewer.page_camera import PageCamera
from warpshadow.viewer.painter import Frame
from warpshadow.viewer.quality import Pace, Quality

REST = 0.2
"""So long after the last request of any page all rests [s]."""


class Page(Protocol):
    """What the loop needs of a page. Its functions run in the page's own thread."""

    def send(self, frame: Frame, delay: float) -> None:
        """Begin to send a picture, ``delay`` seconds after it was asked for."""

    def wait(self) -> None:
        """Return when the page has taken the last picture, or after a while if it does not say so."""

    def fail(self, message: str | None) -> None:
        """Show what went wrong; None: nothing does any more."""


class Paint(Protocol):
    """What paints: :meth:`warpshadow.viewer.painter.Painter.paint`."""

    def __call__(self, look: Look, page: PageCamera, quality: Quality, *, depth: bool) -> Frame:
        """Paint what a page sees."""


class Loop:
    """Paints for any number of pages.

    Args:
        paint: Paints a picture.
        look: What is shown at first.
        rest: So long after the last request all rests [s].

    Attributes:
        look: What is shown.
        depth: Whether pages are sent how far away everything is.
    """

    def __init__(self, paint: Paint, look: Look, *, rest: float = REST):
        self.look = look
        self.depth = False
        self._paint, self._rest = paint, rest
        self._painting = threading.Lock()
        self._asked = threading.Condition()  # guards what follows
        self._seats: dict[Hashable, _Seat] = {}
        self._last_asked = 0.0

    def join(self, name: Hashable, page: Page) -> None:
        """Let a page in; it is sent nothing until it says where it looks from."""
        seat = _Seat(page)
        with self._asked:
            self._seats[name] = seat
        threading.Thread(target=self._serve, args=(seat,), name=f"page {name}", daemon=True).start()

    def leave(self, name: Hashable) -> None:
        """Let a page go."""
        with self._asked:
            seat = self._seats.pop(name, None)
            if seat is not None:
                seat.is_open = False
            self._asked.notify_all()

    def close(self) -> None:
        """Let all pages go."""
        for name in list(self._seats):
            self.leave(name)

    def look_from(self, name: Hashable, camera: PageCamera) -> None:
        """A page looks from somewhere else."""
        with self._asked:
            seat = self._seats.get(name)
            if seat is not None and camera != seat.camera:
                seat.camera = camera
                self._ask(seat)

    def change(self, **changes: Any) -> Look:
        """Show something else to all pages.

        Args:
            changes: Fields of :class:`Look`.

        Raises:
            ValueError: for what no look may have; then nothing changes.
        """
        return self.update(lambda look: dataclasses.replace(look, **changes))

    def update(self, change: Callable[[Look], Look]) -> Look:
        """Show to all pages what is made of what is shown, with no other change between."""
        with self._asked:
            look = change(self.look)
            if look != self.look:
                self.look = look
                self._ask(*self._seats.values())
            return self.look

    def again(self, *, depth: bool | None = None) -> None:
        """Paint again for all pages, with or without depth."""
        with self._asked:
            self.depth = self.depth if depth is None else depth
            self._ask(*self._seats.values())

    def camera_of(self, name: Hashable) -> PageCamera | None:
        """From where a page looks; None where it is gone, or has not said."""
        with self._asked:
            seat = self._seats.get(name)
            return None if seat is None else seat.camera

    @property
    def is_content(self) -> bool:
        """Whether all pages have the best pictures of what they asked for, or the reason why they have none."""
        with self._asked:
            return all(seat.is_content and seat.asked is None for seat in self._seats.values())

    def _ask(self, *seats: _Seat) -> None:
        self._last_asked = time.monotonic()
        for seat in seats:
            if seat.asked is None:  # a delay counts from the oldest request that a picture answers
                seat.asked = self._last_asked
        self._asked.notify_all()

    # ------------------------------------------------------------------------------------------ the thread of a page

    def _serve(self, seat: _Seat) -> None:
        pace, last = Pace(), None
        while (job := self._next(seat, pace, last)) is not None:
            camera, quality, asked = job
            try:
                with self._painting:
                    start = time.monotonic()
                    look = self.look
                    frame = self._paint(look, camera, quality, depth=self.depth)
            except Exception as error:  # whatever it is, the page says it, and the others go on
                seat.page.fail(f"{type(error).__name__}: {error}")
                last = None
                continue
            seconds = time.monotonic() - start
            if quality.is_moving:
                pace.took(seconds)
            seat.page.fail(None)
            seat.page.wait()
            if seat.is_open:
                seat.page.send(frame, time.monotonic() - asked)
            last = camera, quality, seconds

    def _next(
        self, seat: _Seat, pace: Pace, last: tuple[PageCamera, Quality, float] | None
    ) -> tuple[PageCamera, Quality, float] | None:
        """What to paint next, and when it was asked for; waits for it. None where the page is gone."""
        with self._asked:
            while seat.is_open:
                if seat.asked is not None and seat.camera is not None:
                    asked, seat.asked, seat.is_content = seat.asked, None, False
                    return seat.camera, pace.moving(), asked
                better = None
                if last is not None:
                    camera, quality, seconds = last
                    better = pace.better(quality, seconds, camera.width * camera.height)
                seat.is_content = better is None
                if better is None:
                    self._asked.wait()
                    continue
                left = self._last_asked + self._rest - time.monotonic()
                if left <= 0:
                    return camera, better, time.monotonic()
                self._asked.wait(left)
        return None


class _Seat:
    """A page, and the latest that it asked for."""

    def __init__(self, page: Page):
        self.page = page
        self.camera: PageCamera | None = None
        self.asked: float | None = None  # when; None where that is answered
        self.is_content = False  # whether it has the best picture of the latest that it asked for
        self.is_open = True
