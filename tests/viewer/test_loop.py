"""The loop that renders, with pages that are none: no browser, no server."""

import dataclasses
import threading
import time

import numpy as np
import pytest

import warpshadow as ws
from warpshadow.viewer.loop import Loop
from warpshadow.viewer.page_camera import PageCamera
from warpshadow.viewer.painter import Frame
from warpshadow.viewer.state import ViewerState

REST = 0.05
PATIENCE = 60.0  # seconds: a busy machine is slow, and what comes, comes at once


def viewer_state():
    body = ws.Body(ws.icosphere(subdivisions=1), blockers=1)
    return ViewerState.of(ws.Scene([body], ws.EnvironmentMap.constant(1.0), ws.Camera.look_at((0, 0, 5), (0, 0, 0))))


def camera(x=0.0):
    return PageCamera((1, 0, 0, 0), (x, 0, -5), 40.0, 640, 480)


class FakePage:
    """Notes what it is sent; takes pictures only while it may."""

    def __init__(self):
        self.frames, self.errors, self.delays = [], [], []
        self.takes = threading.Event()
        self.takes.set()
        self.changed = threading.Condition()

    def send(self, frame, delay):
        with self.changed:
            self.frames.append(frame)
            self.delays.append(delay)
            self.changed.notify_all()

    def wait(self):
        assert self.takes.wait(PATIENCE)

    def fail(self, message):
        with self.changed:
            self.errors.append(message)
            self.changed.notify_all()

    def until(self, condition):
        with self.changed:
            assert self.changed.wait_for(condition, PATIENCE), (len(self.frames), self.errors)


class FakePainter:
    """Notes what it is asked for; paints nothing, as quickly or slowly as it is told."""

    def __init__(self):
        self.asked = []
        self.may_paint = threading.Event()
        self.may_paint.set()
        self.begun = threading.Semaphore(0)
        self.error = None
        self.at_once = 0

    def __call__(self, viewer_state, page, quality, *, depth):
        self.at_once += 1
        assert self.at_once == 1, "two threads paint at once"
        self.asked.append((viewer_state, page, quality, depth))
        self.begun.release()
        assert self.may_paint.wait(PATIENCE)
        self.at_once -= 1
        if self.error is not None:
            raise self.error
        return Frame(np.zeros((2, 2, 3), np.uint8), None, quality, 0.0, "")


@pytest.fixture
def painter():
    return FakePainter()


@pytest.fixture
def loop(painter):
    loop = Loop(painter, viewer_state(), rest=REST)
    yield loop
    painter.may_paint.set()
    loop.close()


def is_full(page):
    return bool(page.frames) and page.frames[-1].quality.pixels == 640 * 480


def test_a_page_is_sent_a_quick_picture_then_better_ones_up_to_all_its_pixels_then_nothing(loop):
    page = FakePage()
    loop.join("a", page)
    time.sleep(0.05)
    assert not page.frames  # nobody said from where
    loop.look_from("a", camera())
    page.until(lambda: is_full(page))
    qualities = [frame.quality for frame in page.frames]
    assert [quality.is_moving for quality in qualities] == [True, False, False, False]
    assert [quality.pixels for quality in qualities] == [256**2, 256**2, 512**2, 640 * 480]
    assert qualities[0].cells < qualities[1].cells
    time.sleep(4 * REST)
    assert len(page.frames) == 4


def test_of_many_requests_while_one_is_painted_only_the_latest_is(loop, painter):
    page = FakePage()
    loop.join("a", page)
    painter.may_paint.clear()
    loop.look_from("a", camera(0.0))
    assert painter.begun.acquire(timeout=PATIENCE)
    for x in range(1, 50):
        loop.look_from("a", camera(x))
    painter.may_paint.set()
    page.until(lambda: len(page.frames) >= 2)
    assert [page.position[0] for _, page, _, _ in painter.asked[:2]] == [0, 49]


def test_a_slow_page_gets_fewer_pictures_and_then_the_latest_and_delays_no_other(loop, painter):
    slow, quick = FakePage(), FakePage()
    loop.join("slow", slow)
    loop.join("quick", quick)
    slow.takes.clear()
    loop.look_from("slow", camera(0.0))
    for x in range(20):
        loop.look_from("slow", camera(100.0 + x))
        count = len(quick.frames)
        loop.look_from("quick", camera(x))
        quick.until(lambda count=count: len(quick.frames) > count)
    assert not slow.frames
    slow.takes.set()
    slow.until(lambda: len(slow.frames) >= 2)
    painted = [page.position[0] for _, page, quality, _ in painter.asked if page.position[0] >= 100 or quality is None]
    assert painted[-1] == 119 and len(set(painted)) <= 3


def test_what_is_shown_changes_for_all_pages(loop, painter):
    pages = [FakePage(), FakePage()]
    for name, page in enumerate(pages):
        loop.join(name, page)
        loop.look_from(name, camera(name))
    for page in pages:
        page.until(lambda page=page: is_full(page))
    count = len(painter.asked)
    loop.change(turn=30.0)
    for page in pages:
        page.until(lambda page=page: page.frames[-1].quality.is_moving or len(page.frames) > 5)
        page.until(lambda page=page: is_full(page))
    assert {asked[0].turn for asked in painter.asked[count:]} == {30.0}
    assert {asked[1].position[0] for asked in painter.asked[count:]} == {0.0, 1.0}


def test_an_error_is_shown_and_the_next_request_is_painted(loop, painter):
    page = FakePage()
    loop.join("a", page)
    painter.error = RuntimeError("out of memory")
    loop.look_from("a", camera(0.0))
    page.until(lambda: "RuntimeError: out of memory" in page.errors)
    time.sleep(4 * REST)
    assert len(painter.asked) == 1  # it is not tried again by itself
    painter.error = None
    loop.look_from("a", camera(1.0))
    page.until(lambda: is_full(page))
    assert page.errors[-1] is None


def test_a_look_that_is_refused_changes_nothing(loop):
    before = loop.viewer_state
    for changes in ({"turn": float("nan")}, {"directions": 1 << 20}, {"method": "magic"}, {"scale": float("inf")}):
        with pytest.raises(ValueError, match=f"{next(iter(changes))}: got .*, expected"):
            loop.change(**changes)
    assert loop.viewer_state is before


def test_a_page_that_left_is_sent_nothing(loop, painter):
    page = FakePage()
    loop.join("a", page)
    painter.may_paint.clear()
    loop.look_from("a", camera(0.0))
    assert painter.begun.acquire(timeout=PATIENCE)
    loop.leave("a")
    painter.may_paint.set()
    loop.look_from("a", camera(1.0))
    time.sleep(4 * REST)
    assert not page.frames and len(painter.asked) == 1


def test_nothing_is_refined_while_another_page_moves(loop, painter):
    resting, moving = FakePage(), FakePage()
    loop.join("resting", resting)
    loop.join("moving", moving)
    loop.look_from("resting", camera(1000.0))
    begun = time.monotonic()
    while time.monotonic() - begun < 6 * REST:
        loop.look_from("moving", camera(time.monotonic() - begun))
        time.sleep(REST / 20)
        is_steady = time.monotonic() - loop._last_request < REST / 2
        if not is_steady:
            pytest.skip("the machine is too busy to move steadily")
    assert all(quality.is_moving for _, _, quality, _ in painter.asked)
    resting.until(lambda: is_full(resting))


def test_a_delay_counts_from_the_oldest_request_that_is_answered(loop, painter):
    page = FakePage()
    loop.join("a", page)
    painter.may_paint.clear()
    loop.look_from("a", camera(0.0))
    assert painter.begun.acquire(timeout=PATIENCE)
    loop.look_from("a", camera(1.0))
    time.sleep(0.2)
    painter.may_paint.set()
    page.until(lambda: len(page.frames) >= 2)
    assert page.delays[1] >= 0.2


def test_depth_is_asked_for_once_something_needs_it(loop, painter):
    page = FakePage()
    loop.join("a", page)
    loop.look_from("a", camera())
    page.until(lambda: is_full(page))
    assert not any(asked[3] for asked in painter.asked)
    count = len(painter.asked)
    loop.repaint(depth=True)
    page.until(lambda: len(painter.asked) > count and is_full(page))
    assert all(asked[3] for asked in painter.asked[count:])


def test_two_changes_at_once_both_count(loop):
    barrier = threading.Barrier(8)

    def nudge():
        barrier.wait()
        for _ in range(20):
            loop.update(lambda viewer_state: dataclasses.replace(viewer_state, turn=viewer_state.turn + 1))

    threads = [threading.Thread(target=nudge) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert loop.viewer_state.turn == 160
