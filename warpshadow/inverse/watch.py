"""A fit in the browser: its page shows progress, and its buttons control the fit.

All of it runs in the fit's own thread, between two iterations: pictures are made of images that the fit has anyway, as
often as a small part of its time allows, and only while a browser looks.
"""

import contextlib
import time
from collections.abc import Callable, Iterator, Sequence
from itertools import islice
from typing import Protocol

import numpy as np
import torch

from warpshadow import check
from warpshadow.assets.color import auto_exposure, srgb_to_linear
from warpshadow.device.progress import in_ipython
from warpshadow.inverse.free.base import Values
from warpshadow.inverse.model import Model
from warpshadow.inverse.schedule import Stage
from warpshadow.viewer import FitViewer
from warpshadow.viewer.painter import picture

_MIN_INTERVAL = 0.5  # between two pictures, at least
_MAX_TIME_SHARE = 0.02  # of the fit's time that pictures may take; encoding and sending in other threads come on top
_PICTURE_WIDTH = 768  # pixels of a picture, about


class Watched(Protocol):
    """State of a running fit, for its page."""

    stages: tuple[Stage, ...]
    stage: int
    losses: list[list[float]]
    descents: list[int]  # of each stage that has begun
    model: Model
    values: dict[str, Values]
    images: torch.Tensor | None  # of the last iteration, if it took any


class Watch:
    """Show a fit on a page, and obey the page's buttons."""

    def __init__(self, viewer: FitViewer):
        self._page = viewer.page
        self._next = 0.0  # time of the next picture
        self._has_failed = False

    def update(self, fit: Watched, save: Callable[[], None]) -> bool:
        """Show how far a fit is, wait while it is to pause, and say whether it goes on."""
        page = self._page
        if page.pauses:
            save()
            self._show(fit, "waits")
            while page.pauses:
                page.wait(0.5)
        if time.perf_counter() >= self._next:
            self._next = time.perf_counter() + _MIN_INTERVAL
            if page.is_watched:
                self._show(fit, "runs")
        return not page.stops

    def end(self, fit: Watched, reason: str) -> None:
        """Show how a fit ended."""
        self._show(fit, reason)
        with self._report_page_errors():
            self._page.end(f"{reason} after {sum(map(len, fit.losses))} iterations")

    def _show(self, fit: Watched, note: str) -> None:
        start = time.perf_counter()
        with self._report_page_errors():
            words = [note, f"stage {fit.stage + 1} of {len(fit.stages)}", f"iteration {sum(map(len, fit.losses))}"]
            last = next((run[-1] for run in reversed(fit.losses) if run), None)
            words += [] if last is None else [f"loss {last:.3e}"]
            losses = losses_by_stage(fit.losses, fit.descents)
            self._page.show(" · ".join(words), losses, fit.stage, fit.stages[fit.stage].candidates)
            self._page.show_pictures(pictures(fit))
            self._page.fail(None)
        current_time = time.perf_counter()
        self._next = current_time + max(_MIN_INTERVAL, (current_time - start) / _MAX_TIME_SHARE)

    @contextlib.contextmanager
    def _report_page_errors(self) -> Iterator[None]:
        """Report an error of the page on the page, and once in a warning, and leave the fit alone."""
        try:
            yield
        except Exception as error:
            message = f"{type(error).__name__}: {error}"
            if not self._has_failed:
                self._has_failed = True
                check.warn(f"the view of the fit failed ({message}); the fit goes on")
            with contextlib.suppress(Exception):
                self._page.fail(message)


def losses_by_stage(losses: Sequence[list[float]], descents: Sequence[int]) -> list[list[list[float]]]:
    """Split the losses of consecutive descents by the number of the stage that each belongs to."""
    runs = iter(losses)
    return [list(islice(runs, count)) for count in descents]


def side_by_side(targets: torch.Tensor, images: torch.Tensor) -> np.ndarray:
    """Targets, images and differences (gray where equal), a row for each view: linear RGB, 0 to 1.

    Of [view, height, width, 3 or more] both, to [view · height, 3 · width, 3].
    """
    target, got = targets[..., :3].cpu().numpy(), images[..., :3].cpu().numpy()
    white = 2.0 ** -auto_exposure(target)
    difference = srgb_to_linear(np.clip(0.5 + 0.5 * (got - target) / white, 0, 1))  # in steps that look even
    parts = zip(target / white, got / white, difference, strict=True)
    return np.concatenate([np.concatenate(view, axis=1) for view in parts], axis=0)


def pictures(fit: Watched) -> np.ndarray:
    """Target, image and difference, a row for each view: uint8 of shape [height, width, 3], of some 768 columns."""
    images = fit.images
    if images is None:
        with torch.no_grad():
            images = fit.model.images(fit.values)
    width = 3 * images.shape[2]
    step, factor = max(1, width // _PICTURE_WIDTH), max(1, _PICTURE_WIDTH // width)
    comparison = side_by_side(fit.model.targets[:, ::step, ::step], images[:, ::step, ::step])
    comparison = comparison.repeat(factor, axis=0).repeat(factor, axis=1).astype(np.float32)
    opaque = np.ones((*comparison.shape[:2], 1), np.float32)
    return picture(np.concatenate([comparison, opaque], axis=-1), 0.0, np.zeros(3))


@contextlib.contextmanager
def watching(view: bool | FitViewer, *, progress: bool) -> Iterator[Watch | None]:
    """Watch a fit if that is asked for; a page that was made here is closed at the end."""
    if isinstance(view, FitViewer):
        yield Watch(view)
        return
    check.flag("view", view)
    if not view:
        yield None
        return
    viewer = FitViewer()
    try:
        if progress:
            print(viewer.url)
        if in_ipython():
            from IPython.display import display

            display(viewer)
        viewer.open(None)
        yield Watch(viewer)
    finally:
        viewer.close()
