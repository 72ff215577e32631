"""Interface of viewers for Python and the command line; viser is imported at first use."""

import contextlib
import html
import threading
import webbrowser
from collections.abc import Callable, Iterator
from pathlib import Path

import warp as wp

from warpshadow import check
from warpshadow.device.progress import in_ipython
from warpshadow.scene.scene import Scene, check_scene

HOST, PORT = "127.0.0.1", 8080  # where pages are by default: for this machine alone


class Viewer:
    """A scene in the browser, until it is closed; a notebook shows it.

    Args:
        url: Where its page is.
        close: Ends it.
    Attributes:
        url: Where its page is.
    """

    def __init__(self, url: str, close: Callable[[], None]):
        self.url = url
        self._close = close

    def open(self, browser: bool | None = True) -> None:
        """Open a browser, or leave it; None: unless this is a notebook."""
        if browser is None:
            browser = not in_ipython()
        if browser:
            webbrowser.open(self.url)

    def wait(self) -> None:
        """Serve until Ctrl+C."""
        with contextlib.suppress(KeyboardInterrupt):
            threading.Event().wait()
        self.close()

    def close(self) -> None:
        """Close its pages and its server."""
        self._close()

    def _repr_html_(self) -> str:
        return f'<iframe src="{html.escape(self.url)}" width="100%" height="600" style="border:none"></iframe>'

    def __repr__(self) -> str:
        return f"Viewer({self.url})"


class FitViewer(Viewer):
    """The page of a fit, which shows pictures and losses, and pauses and stops it; a notebook shows it.

    Needs viser: ``pip install "warpshadow[viewer]"``.

    Args:
        host: Address to serve at. The default is for this machine alone; at others everybody who can reach them sees
            the fit, and can stop it.
        port: Port, or the next one that is free.
    Raises:
        ImportError: without viser.
    """

    def __init__(self, *, host: str = HOST, port: int = PORT):
        with _viser():
            from warpshadow.viewer.fit_page import FitPage
        self.page = FitPage(host, port)
        super().__init__(self.page.url, self.page.close)

    def __repr__(self) -> str:
        return f"FitViewer({self.url})"


@contextlib.contextmanager
def _viser() -> Iterator[None]:
    """Tell how to install a missing package."""
    try:
        yield
    except ImportError as cause:
        raise ImportError(f"{check.missing('the viewer', 'viser', 'viewer')} ({cause})") from cause


def view(
    scene: Scene,
    *,
    host: str = HOST,
    port: int = PORT,
    browser: bool | None = None,
    device: wp.DeviceLike = "cpu",
    progress: bool = True,
) -> Viewer:
    """Show a scene in the browser, where mouse and panel turn it, its light and its bodies.

    Needs viser: ``pip install "warpshadow[viewer]"``.

    Args:
        host: Address to serve at. The default is for this machine alone; at others everybody who can reach them sees
            the scene, and can change it.
        port: Port, or the next one that is free.
        browser: Whether to open a browser; None for yes, unless this is a notebook, which shows the page itself.
    Returns:
        The viewer. A script ends with ``viewer.wait()``, since pages are served only while the process runs.
    Raises:
        ImportError: without viser.
    """
    check_scene(scene)
    viewer = serve(scene, host=host, port=port, device=device, progress=progress)
    viewer.open(browser)
    return viewer


def serve(
    scene: Scene,
    *,
    host: str = HOST,
    port: int = PORT,
    device: wp.DeviceLike = "cpu",
    progress: bool = True,
    path: Path | None = None,
) -> Viewer:
    """Serve the page of a scene; see :func:`view`.

    Args:
        scene, host, port, device, progress: As there.
        path: The scene's file, which is saved with the changes in it; None where it has none.
    """
    with _viser():
        from warpshadow.viewer.app import ViewerApp
    site = ViewerApp(scene, host=host, port=port, device=device, progress=progress, path=path)
    return Viewer(site.url, site.close)
