"""Mock of ABB Robot Web Services 1.0: an HTTP server with digest authentication (RFC 2617), sessions and faults."""

import hashlib
import json
import re
import secrets
import threading
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from types import TracebackType
from typing import Self
from urllib.parse import parse_qs, urlsplit

from gelflow.errors import UsageError

REALM = "validusers@robapi.abb"
MAX_SESSIONS = 70


class MockWebServices:
    """The panel and program state of a controller; set its attributes as an operator changes them.

    `latency` [s, wall] delays each answer. `broken` replaces the body of each answer. A client without the cookie of
    its session opens a new one, and the 71st session is refused, as on a controller.
    """

    def __init__(
        self, *, host: str = "127.0.0.1", port: int = 0, user: str = "Default User", password: str = "robotics"
    ):
        self.opmode = "AUTO"  # AUTO, MANR, MANF, AUTO_CH, MANF_CH, INIT, UNDEF
        self.ctrlstate = "motoron"  # motoron, motoroff, guardstop, emergencystop, emergencystopreset, sysfail, init
        self.execution = "running"  # running, stopped
        self.latency = 0.0
        self.broken: bytes | None = None
        self.requests = 0  # answered, with a correct login
        self.sessions: set[str] = set()
        self._login = (user, password)
        self._where = (host, port)
        self._nonce = secrets.token_hex(16)
        self._server: _Server | None = None

    def start(self) -> Self:
        """Bind and serve. Raises UsageError when the address is in use."""
        try:
            self._server = _Server(self._where, self)
        except OSError as error:
            host, port = self._where
            raise UsageError(
                f"cannot serve web services at {host}:{port}: {error.strerror}; use another port"
            ) from error
        threading.Thread(target=self._server.serve_forever, args=(0.05,), name="web services", daemon=True).start()
        return self

    @property
    def url(self) -> str:
        """Address for the lab file."""
        if self._server is None:
            raise UsageError("the mock web services are not started")
        return f"http://{self._where[0]}:{self._server.server_address[1]}"

    def close(self) -> None:
        """Stop serving."""
        server, self._server = self._server, None
        if server is not None:
            server.shutdown()
            server.server_close()

    def __enter__(self) -> Self:
        return self if self._server is not None else self.start()

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        self.close()

    # Called by the server's threads

    def challenge(self) -> str:
        """The header WWW-Authenticate."""
        return f'Digest realm="{REALM}", domain="/", qop="auth", nonce="{self._nonce}", algorithm="MD5"'

    def accepts(self, method: str, authorization: str) -> bool:
        """Whether the header Authorization proves the knowledge of the password."""
        if not authorization.startswith("Digest "):
            return False
        given = {name: quoted or plain for name, quoted, plain in _PARAMETER.findall(authorization[7:])}
        user, password = self._login
        secret = _md5(f"{user}:{REALM}:{password}")
        asked = _md5(f"{method}:{given.get('uri', '')}")
        parts = (secret, self._nonce, given.get("nc", ""), given.get("cnonce", ""), given.get("qop", ""), asked)
        expected = _md5(":".join(parts))
        known = given.get("username") == user and given.get("nonce") == self._nonce and given.get("qop") == "auth"
        return known and secrets.compare_digest(given.get("response", ""), expected)

    def answer(self, path: str) -> dict[str, str] | None:
        """The state at a resource; None for an unknown one."""
        return {
            "/rw/panel/opmode": {"_type": "pnl-opmode", "_title": "opmode", "opmode": self.opmode},
            "/rw/panel/ctrlstate": {"_type": "pnl-ctrlstate", "_title": "ctrlstate", "ctrlstate": self.ctrlstate},
            "/rw/rapid/execution": {
                "_type": "rap-execution",
                "_title": "execution",
                "ctrlexecstate": self.execution,
                "cycle": "forever",
            },
        }.get(path)


_PARAMETER = re.compile(r'(\w+)=(?:"([^"]*)"|([^\s,]+))')


def _md5(text: str) -> str:
    return hashlib.md5(text.encode(), usedforsecurity=False).hexdigest()


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    block_on_close = False

    def __init__(self, where: tuple[str, int], mock: MockWebServices) -> None:
        self.mock = mock
        super().__init__(where, _Handler)

    def handle_error(self, request: object, client_address: object) -> None:
        """Ignore clients that disconnect; mocks do not print."""


class _Handler(BaseHTTPRequestHandler):
    server: _Server
    timeout = 5.0  # of the socket [s]

    def do_GET(self) -> None:
        mock = self.server.mock
        time.sleep(mock.latency)
        cookie = re.search(r"-http-session-=(\w+)", self.headers.get("Cookie", ""))
        session = cookie[1] if cookie else ""
        if session not in mock.sessions and not mock.accepts("GET", self.headers.get("Authorization", "")):
            self._send(401, b"", [("WWW-Authenticate", mock.challenge())])
            return
        headers = []
        if session not in mock.sessions:
            if len(mock.sessions) >= MAX_SESSIONS:
                self._send(503, b"")
                return
            session = secrets.token_hex(8)
            mock.sessions.add(session)
            headers.append(("Set-Cookie", f"-http-session-={session}; path=/; httponly"))
        mock.requests += 1
        url = urlsplit(self.path)
        if url.path == "/logout":
            mock.sessions.discard(session)
            self._send(200, b"")
            return
        state = mock.answer(url.path)
        if state is None or parse_qs(url.query).get("json") != ["1"]:
            self._send(404, b"{}", headers)
            return
        links = {"base": {"href": f"{mock.url}/rw/panel/"}}
        body = json.dumps({"_links": links, "_embedded": {"_state": [state]}}).encode()
        self._send(200, body if mock.broken is None else mock.broken, headers)

    def log_message(self, format: str, *args: object) -> None:
        """Mocks do not print."""

    def _send(self, code: int, body: bytes, headers: list[tuple[str, str]] | None = None) -> None:
        self.send_response(code)
        for name, value in headers or []:
            self.send_header(name, value)
        self.send_header("Content-Type", "application/json")
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)
