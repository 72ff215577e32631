"""Access control: only pages that our own server sent, and only messages that a viewer needs.

viser lets any page of the browser connect, keeps files that pages upload, and opens a tunnel to the internet when a
page asks for one. Here none of this is wanted. viser 1.1 has no setting for the first two, so this file, and no other,
uses its private attributes; tests/viewer/test_app.py notices if they change.
"""

import asyncio
import concurrent.futures
import contextlib
import io
import logging
import socket
import threading
import warnings
from collections.abc import Callable
from typing import Any
from urllib.parse import urlsplit

import viser
from viser import _messages as messages

from warpshadow import check

_DELIVERY_SECONDS = 5.0  # that messages may take; a page that hangs takes none
OWN_NAMES = ("localhost", "127.0.0.1", "::1")  # names that only this machine has for itself


class Server(viser.ViserServer):
    """viser's server without tunnels, uploads and pages of others.

    Args:
        host: Address to serve at; others than this machine's own let everybody in who can reach it.
        port: Port, or the next that is free.
    """

    def __init__(self, host: str, port: int):
        warnings.filterwarnings("ignore", "Queued a .* on a closed connection")  # a page may close at any time
        with contextlib.redirect_stdout(io.StringIO()):  # viser prints a table
            super().__init__(host=host, port=port, label="warpshadow", verbose=False)
        name = {"0.0.0.0": "localhost", "::": "localhost"}.get(host, host)
        self.url = f"http://{f'[{name}]' if ':' in name else name}:{self.get_port()}"  # where its page is
        logging.getLogger("websockets.server").addFilter(_in_one_line)  # the same filter is added once
        is_local = host in OWN_NAMES
        self._websock_server.on_client_connect(_guard(self, is_local))
        self._refuse_uploads(self._websock_server)
        self.on_client_connect(self._refuse_uploads_of)
        self.gui.configure_theme(show_logo=False, show_share_button=False, dark_mode=True)

    def deliver(self) -> None:
        """Send all messages to all pages, and return when they are sent; viser's ``flush`` returns at once."""
        loop = self._websock_server._background_event_loop
        if loop is None or loop.is_closed():
            return
        self.flush()
        delivery = asyncio.run_coroutine_threadsafe(self._wait_until_sent(), loop)
        with contextlib.suppress(concurrent.futures.TimeoutError):
            delivery.result(_DELIVERY_SECONDS)
        delivery.cancel()

    async def _wait_until_sent(self) -> None:
        """Return when no message waits for a page."""
        server = self._websock_server
        buffers = [server._broadcast_buffer, *(state.message_buffer for state in server._client_state_from_id.values())]
        while any(
            last_sent < buffer.message_counter - 1
            for buffer in buffers
            for last_sent in buffer.generator_cursors.values()
        ):
            await asyncio.sleep(1e-3)

    def close(self) -> None:
        """Let all pages go, when they have heard the last messages, and serve no more."""
        self.deliver()
        stop_thread = threading.Thread(target=self.stop, daemon=True)
        stop_thread.start()
        stop_thread.join(1.0)  # it waits six seconds for connections that browsers keep

    def request_share_url(self, verbose: bool = True) -> str | None:
        """Open no tunnel."""
        return None

    async def _refuse_uploads_of(self, client: viser.ClientHandle) -> None:
        self._refuse_uploads(client._websock_connection)

    @staticmethod
    def _refuse_uploads(connection: Any) -> None:
        for kind in (messages.FileTransferStartUpload, messages.FileTransferPart):
            connection._incoming_handlers.pop(kind, None)


class _NotLetIn(PermissionError):
    """A connection of a page that our own server did not send."""


def _guard(server: viser.ViserServer, is_local: bool) -> Callable[[Any], None]:
    def check_in(connection: Any) -> None:
        """Close a connection by raising an error."""
        request = server._websock_server._live_connections[connection.client_id].request
        assert request is not None
        origin, host = request.headers.get("Origin"), request.headers.get("Host", "")
        if not is_own(origin, host, is_local=is_local):
            raise _NotLetIn(f"warpshadow: a page of {origin} at {host} was not let in")

    return check_in


def _in_one_line(record: logging.LogRecord) -> bool:
    """Have the log say in one line that a page was not let in, where it would show a traceback."""
    error = record.exc_info[1] if record.exc_info else None
    if isinstance(error, _NotLetIn):
        record.msg, record.args, record.exc_info, record.exc_text = str(error), (), None, None
    return True


def is_own(origin: str | None, host: str, *, is_local: bool) -> bool:
    """Whether a page may connect.

    Args:
        origin: Origin of the page, as the browser reports it; None for another client.
        host: Its name for the server.
        is_local: Whether the server is for this machine alone; then other names for it are a trick of the page's
            (DNS rebinding).
    """
    if is_local and urlsplit(f"//{host}").hostname not in OWN_NAMES:
        return False
    return origin is None or urlsplit(origin).netloc == host


def check_address(host: object, port: object) -> None:
    """Raise ValueError unless one can serve there; warn where others can come in."""
    if check.integer("port", port, minimum=0) > 65535:
        raise ValueError(f"port: got {port}, expected at most 65535")
    expected = "an address or a name of this machine, such as '127.0.0.1', or '0.0.0.0' for all that it has"
    check.instance("host", host, str, expected)
    assert isinstance(host, str)
    try:
        family, _, _, _, address = socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM)[0]
        socket.create_server(address[:2], family=family).close()  # type: ignore[arg-type]
    except (OSError, UnicodeError) as cause:
        raise ValueError(f"host: got {host!r} ({cause}), expected {expected}") from cause
    if host not in OWN_NAMES:
        check.warn(
            f"host: got {host!r}: everybody who can reach this address sees the scene and can change the picture"
        )
