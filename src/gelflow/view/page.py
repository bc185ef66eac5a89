"""A page in the browser: viser's server on one port, behind the rules of `gelflow.view.access`."""

import contextlib
import errno
import socket
import threading
from collections.abc import Iterator
from typing import Any
from unittest import mock

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.view.access import Access, guarded, is_loopback

DEFAULT_HOST, DEFAULT_PORT = "127.0.0.1", 8080
_CONTROLS = 0.14  # height of the controls above a picture, in heights of the view
_NARROWEST = 0.1  # smallest shape (width / height) of a view for which a picture is framed
_BLANK = 250  # grey of the space around a picture
_starting = threading.Lock()


def import_viser() -> Any:
    """The package viser. Raises UsageError with the command that installs it."""
    try:
        import viser  # deferred: optional, and slow to import
    except ImportError as error:
        raise UsageError(f"the viewer needs viser ({error}); install it with: pip install 'gelflow[view]'") from None
    return viser


class Page:
    """An empty page that is served in the background until `close`.

    Parameters
    ----------
    host: address to bind to; any other than a loopback address needs the random token in `url`
    port: TCP port; 0 takes a free one

    Raises UsageError when viser is not installed, and when the address is invalid or in use.
    """

    def __init__(self, *, host: str = DEFAULT_HOST, port: int = DEFAULT_PORT) -> None:
        viser = import_viser()
        access = Access.of(host)
        listening = _listen(host, port)
        self.port: int = listening.getsockname()[1]
        with _starting, _served_on(listening, access):
            self.server: Any = viser.ViserServer(host=host, port=self.port, verbose=False)
        self.gui: Any = self.server.gui
        self.scene: Any = self.server.scene
        shown = host if is_loopback(host) else socket.gethostname() if host in ("0.0.0.0", "::", "") else host
        address = f"[{shown}]" if ":" in shown else shown
        self.url = f"http://{address}:{self.port}/" + (f"?token={access.token}" if access.token else "")
        self.gui.configure_theme(control_width="large", show_logo=False, show_share_button=False)

    def watched(self) -> bool:
        """Whether a browser shows the page."""
        return bool(self.server.get_clients())

    def show_picture(self, picture: NDArray[np.uint8]) -> None:
        """Show a picture, RGB (height, width, 3), in the view of every browser, below its controls."""
        for client in self.server.get_clients().values():
            width, height = client.camera.image_width, client.camera.image_height
            if width < 1 or height < 1:  # a window that is minimized, or not laid out yet
                continue
            framed = below_controls(picture, min(max(width / height, _NARROWEST), 1 / _NARROWEST))
            client.scene.set_background_image(framed, format="jpeg", jpeg_quality=85)

    def close(self) -> None:
        """Stop serving; further calls have no effect."""
        server, self.server = self.server, None
        if server is not None:
            with _starting, _quiet():
                server.stop()


def below_controls(picture: NDArray[np.uint8], aspect: float) -> NDArray[np.uint8]:
    """The picture with blank space above it for the controls, in the shape (width / height) of a browser's view.

    The view stretches a background image to its own shape.
    """
    height, width = picture.shape[:2]
    rows = round(max(height / (1 - _CONTROLS), width / aspect))
    columns = max(round(rows * aspect), width)
    framed = np.full((rows, columns, 3), _BLANK, dtype=np.uint8)
    left = (columns - width) // 2
    framed[rows - height :, left : left + width] = picture
    return framed


def _listen(host: str, port: int) -> socket.socket:
    if not (isinstance(port, int) and 0 <= port < 65536):
        raise UsageError(f"port must be 0 to 65535, got {port!r}")
    try:
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
        return socket.create_server((host, port), family=family)
    except (OSError, UnicodeError) as error:
        if isinstance(error, OSError) and error.errno == errno.EADDRINUSE:
            raise UsageError(
                f"port {port} of {host} is in use; choose another with --port, or 0 for a free one"
            ) from None
        reason = getattr(error, "strerror", None) or error
        raise UsageError(
            f"cannot serve a page on {host} port {port}: {reason}; choose another --port or --host"
        ) from None


@contextlib.contextmanager
def _served_on(listening: socket.socket, access: Access) -> Iterator[None]:
    """Let the next server of viser use a socket and the rules: viser has no setting for either.

    viser would take the next free port when one is in use, and serves its files to everybody.
    """
    import websockets.asyncio.server as websocket_server

    real = websocket_server.serve
    port = listening.getsockname()[1]

    def serve(handler: Any, _host: Any, requested: int, *, process_request: Any, **options: Any) -> Any:
        assert requested == port, "another server started at the same time"
        return real(handler, sock=listening, process_request=guarded(process_request, access, port), **options)

    with mock.patch.object(websocket_server, "serve", serve), _quiet():
        yield


def _quiet() -> Any:
    """viser prints the address, without its token, and the end of its server to standard output."""
    return mock.patch("rich.print")
