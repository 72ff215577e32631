"""The page of a fit: pictures, how the loss falls, and buttons that pause and stop it.

It knows nothing of fits. It shows the fit's messages, and stores the requests of its buttons until the fit polls them:
a page that is slow or closed delays nothing.
"""

import html
import threading
from collections.abc import Sequence

import numpy as np
import viser

from warpshadow.viewer.loss_plot import COLORS, loss_plot
from warpshadow.viewer.server import Server, check_address

_JPEG = 90
_WIDTH = 760  # of the pictures' panel [CSS pixels]


class FitPage:
    """A page that shows a fit, until it is closed; all browsers share it."""

    def __init__(self, host: str, port: int):
        check_address(host, port)
        self._server = Server(host, port)
        self.url = self._server.url  # where it is
        self._wishes = threading.Condition()  # guards the attributes below
        self._pauses = self._stops = False
        gui = self._server.gui
        self._note = gui.add_html(_note_html("preparing"))
        self._failure = gui.add_html("")
        self._pause = gui.add_button("Pause", hint="The fit waits until it is to go on")
        self._stop = gui.add_button("Stop", color="gray", hint="A checkpoint is left from which the same fit goes on")
        self._plot, self._candidates = gui.add_html(""), gui.add_html("")
        self._pictures: viser.GuiImageHandle | None = None
        self._pause.on_click(self._pause_or_go_on)
        self._stop.on_click(self._ask_to_stop)

    @property
    def is_watched(self) -> bool:
        """Whether a browser shows it."""
        return bool(self._server.get_clients())

    @property
    def pauses(self) -> bool:
        """Whether the fit is to wait."""
        return self._pauses and not self._stops

    @property
    def stops(self) -> bool:
        """Whether the fit is to stop."""
        return self._stops

    def wait(self, seconds: float) -> None:
        """Return when another button was pressed, or after a while."""
        with self._wishes:
            self._wishes.wait(seconds)

    async def _pause_or_go_on(self, _: viser.GuiEvent) -> None:
        with self._wishes:
            self._pauses = not self._pauses
            self._wishes.notify_all()
        self._pause.label = "Go on" if self._pauses else "Pause"

    async def _ask_to_stop(self, _: viser.GuiEvent) -> None:
        with self._wishes:
            self._stops = True
            self._wishes.notify_all()

    def show(self, note: str, losses: Sequence[Sequence[Sequence[float]]], stage: int, candidates: int) -> None:
        """Show how far a fit is, by the losses of the iterations of each descent of each stage."""
        self._note.content = _note_html(html.escape(note))
        self._plot.content = _note_html(loss_plot(losses))
        color = COLORS[stage % len(COLORS)]
        least_losses = [min(run, default=np.inf) for run in losses[stage]]
        rows = []
        for number in range(candidates if candidates > 1 else 0):
            has_begun = number < len(least_losses) and np.isfinite(least_losses[number])
            style = f"color:{color}" if has_begun and least_losses[number] == min(least_losses) else ""
            is_present = number == len(least_losses) - 1
            loss_text = f"{least_losses[number]:.3e}" if has_begun else "waits"
            rows.append(
                f'<tr style="{style}"><td>{"▸" if is_present else ""}</td><td>{number + 1}</td><td>{loss_text}</td>'
            )
        head = "<tr><td></td><td>candidate</td><td>least loss</td></tr>"
        self._candidates.content = _note_html(f"<table>{head}{''.join(rows)}</table>") if rows else ""

    def show_pictures(self, pictures: np.ndarray) -> None:
        """Show target, image and difference: uint8 of shape [height, width, 3]."""
        if self._pictures is None:
            panel = self._server.gui.add_panel()
            with panel.add_tab("Pictures"):
                label = "target · image · difference (gray: alike)"
                self._pictures = self._server.gui.add_image(pictures, label=label, format="jpeg", jpeg_quality=_JPEG)
            panel.float(x=15, y=15, width=_WIDTH)
        else:
            self._pictures.image = pictures

    def fail(self, message: str | None) -> None:
        """Show an error in the view; None clears it."""
        content = _note_html(f'<b style="color:#f66">{html.escape(message)}</b>') if message else ""
        if content != self._failure.content:
            self._failure.content = content

    def end(self, note: str) -> None:
        """Show how the fit ended, to be seen as long as browsers stay open."""
        self._note.content = _note_html(html.escape(note))
        self._pause.disabled = self._stop.disabled = True
        self._server.deliver()  # the process may end right after

    def close(self) -> None:
        """Stop serving; browsers keep the last state."""
        self._server.close()


def _note_html(content: str) -> str:
    return f'<div style="padding:0.4em 1em;font-size:0.8em;line-height:1.4">{content}</div>'
