"""Access to a page: the token of its address, and the hosts and origins of requests.

A web page of another site can send requests to 127.0.0.1 from the same browser. Requests whose `Host` is not that of a
local page, and WebSockets that another site opens, are therefore refused on every page.
"""

import hmac
import ipaddress
import secrets
from collections.abc import Callable
from dataclasses import dataclass, field
from http import HTTPStatus
from http.cookies import CookieError, SimpleCookie
from typing import Any
from urllib.parse import parse_qs, urlsplit

_COOKIE = "gelflow_token"
_REFUSED = "gelflow: open the address that gelflow printed; its token is missing or wrong.\n"
_FOREIGN = "gelflow: the request comes from another site.\n"


def is_loopback(host: str) -> bool:
    """Whether only programs of this machine reach the host."""
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:  # a name such as 127.evil.example, which the other site resolves
        return False


@dataclass(frozen=True)
class Access:
    """The rules of one page."""

    host: str  # that the page is bound to
    token: str | None = field(default=None, repr=False)  # None: no token is needed

    @classmethod
    def of(cls, host: str) -> "Access":
        """The rules for a host: a new token unless it is a loopback address."""
        return cls(host, None if is_loopback(host) else secrets.token_urlsafe(24))

    def refusal(self, path: str, headers: Any, port: int) -> str | None:
        """The reason why a request is refused; None if it is allowed."""
        hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
        try:
            (name,) = (urlsplit(f"//{host}") for host in hosts)
            if any(urlsplit(origin).netloc != name.netloc for origin in origins):
                return _FOREIGN
            token = _query_token(path)
        except ValueError:  # several hosts, or a malformed address
            return _FOREIGN
        if self.token is None:
            return None if name.hostname is not None and is_loopback(name.hostname) else _FOREIGN
        return None if self._is_token(token) or self._is_token(_cookie_token(headers, port)) else _REFUSED

    def _is_token(self, given: str) -> bool:
        assert self.token is not None
        return hmac.compare_digest(given.encode(), self.token.encode())

    def cookie(self, path: str, port: int) -> str | None:
        """The `Set-Cookie` header of the answer to a request that has the token in its address."""
        if self.token is None or not self._is_token(_query_token(path)):
            return None
        return f"{_COOKIE}_{port}={self.token}; Path=/; HttpOnly; SameSite=Strict"


def _query_token(path: str) -> str:
    return parse_qs(urlsplit(path).query).get("token", [""])[0]


def _cookie_token(headers: Any, port: int) -> str:
    try:
        cookies = SimpleCookie("; ".join(headers.get_all("Cookie")))
    except CookieError:
        return ""
    found = cookies.get(f"{_COOKIE}_{port}")  # browsers share cookies between the ports of a host
    return found.value if found is not None else ""


def guarded(serve_page: Callable[[Any, Any], Any], access: Access, port: int) -> Callable[[Any, Any], Any]:
    """The HTTP handler of a page behind the rules; it answers both files and the start of WebSockets."""

    def answer(connection: Any, request: Any) -> Any:
        refusal = access.refusal(request.path, request.headers, port)
        if refusal is not None:
            return connection.respond(HTTPStatus.FORBIDDEN, refusal)
        response = serve_page(connection, request)
        cookie = access.cookie(request.path, port)
        if response is not None:
            response.headers["Cache-Control"] = "no-store"
            response.headers["Referrer-Policy"] = "no-referrer"  # the token stays in the address
            if cookie is not None:
                response.headers["Set-Cookie"] = cookie
        return response

    return answer
