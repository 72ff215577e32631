"""Who may come in: pages that our own server sent, and of what they send only what a viewer needs.

viser lets any page of the browser connect, keeps files that pages upload, and opens a tunnel to the internet when a
page asks for one. Here none of this is wanted. viser 1.1 has no setting for the first two, so this file, and no other,
uses its private attributes; tests/viewer/test_site.py notices if they change.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any
from urllib.parse import urlsplit

import viser
from viser import _messages as messages

OWN_NAMES = ("localhost", "127.0.0.1", "::1")
"""What only this machine calls itself."""


class Server(viser.ViserServer):
    """viser's server without tunnels, uploads and pages of others."""

    def __init__(self, host: str, port: int):
        super().__init__(host=host, port=port, label="warpshadow", verbose=False)
        is_local = host in OWN_NAMES
        self._websock_server.on_client_connect(_guard(self, is_local))
        self._refuse_uploads(self._websock_server)

    def request_share_url(self, verbose: bool = True) -> str | None:
        """Open no tunnel."""
        return None

    def refuse_uploads_of(self, client: viser.ClientHandle) -> None:
        """Take no files from a client."""
        self._refuse_uploads(client._websock_connection)

    @staticmethod
    def _refuse_uploads(connection: Any) -> None:
        for kind in (messages.FileTransferStartUpload, messages.FileTransferPart):
            connection._incoming_handlers.pop(kind, None)


def _guard(server: viser.ViserServer, is_local: bool) -> Callable[[Any], None]:
    def check_in(connection: Any) -> None:
        """Close a connection by raising PermissionError."""
        request = server._websock_server._live_connections[connection.client_id].request
        assert request is not None
        origin, host = request.headers.get("Origin"), request.headers.get("Host", "")
        if not is_own(origin, host, is_local=is_local):
            raise PermissionError(f"a page of {origin} at {host} was not let in")

    return check_in


def is_own(origin: str | None, host: str, *, is_local: bool) -> bool:
    """Whether a page may connect.

    Args:
        origin: Where the page came from, as the browser says; None for what is no browser.
        host: What it calls the server.
        is_local: Whether the server is for this machine alone; then other names for it are a trick of the page's
            (DNS rebinding).
    """
    if is_local and urlsplit(f"//{host}").hostname not in OWN_NAMES:
        return False
    return origin is None or urlsplit(origin).netloc == host
