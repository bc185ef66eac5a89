"""Client of ABB Robot Web Services 1.0 (IRC5, RobotWare 6): reads three states over HTTP with digest authentication."""

import contextlib
import http.client
import json
import urllib.error
import urllib.request
from dataclasses import dataclass
from http.cookiejar import CookieJar
from urllib.parse import urlsplit

from gelflow.errors import PeerError, PeerRefused, PeerTimeout, UsageError
from gelflow.real.addresses import is_host

USER, PASSWORD = "Default User", "robotics"  # of every controller, unless a site has changed them
_MAX_ANSWER = 64 * 1024  # [bytes]

# Words of the controller → words of gelflow. Other words are shown as they are, and count as not ready.
MODES = {
    "AUTO": "auto",
    "MANR": "manual reduced",
    "MANF": "manual full",
    "AUTO_CH": "change to auto not confirmed",
    "MANF_CH": "change to manual full not confirmed",
    "INIT": "starting",
    "UNDEF": "undefined",
}
STATES = {
    "motoron": "motors on",
    "motoroff": "motors off",
    "guardstop": "guard stop",
    "emergencystop": "emergency stop",
    "emergencystopreset": "emergency stop not reset",
    "sysfail": "system failure",
    "init": "starting",
}


@dataclass(frozen=True)
class ControllerReading:
    """The state of the controller, as it answers."""

    operating_mode: str  # "auto", "manual reduced", "manual full", … (`MODES`)
    controller_state: str  # "motors on", "motors off", "guard stop", "emergency stop", … (`STATES`)
    execution: str  # of the RAPID program: "running" or "stopped"

    def __str__(self) -> str:
        return f"mode {self.operating_mode}, {self.controller_state}, program {self.execution}"


class WebServicesClient:
    """Reads the state of the controller at `address`, for example "http://192.168.125.1".

    An answer takes up to hundreds of milliseconds; `timeout` [s, wall] bounds each wait for the network. The client
    keeps the cookies of its session, because a controller accepts at most 70 sessions. Not thread-safe.
    """

    def __init__(self, address: str, *, timeout: float = 2.0) -> None:
        refused = UsageError(f"web services: expected http://HOST or http://HOST:PORT, got {address!r}")
        try:
            parts = urlsplit(address)
            valid = parts.scheme == "http" and is_host(parts.hostname or "") and (parts.port is None or parts.port > 0)
        except ValueError:
            raise refused from None
        if not valid or parts.path not in ("", "/") or parts.query or "@" in parts.netloc or not address.isascii():
            raise refused
        self.address = f"http://{parts.netloc}"
        self._timeout = timeout
        passwords = urllib.request.HTTPPasswordMgrWithDefaultRealm()
        passwords.add_password(None, self.address, USER, PASSWORD)
        self._opener = urllib.request.build_opener(
            urllib.request.ProxyHandler({}),  # a robot is in the local network
            urllib.request.HTTPDigestAuthHandler(passwords),
            urllib.request.HTTPCookieProcessor(CookieJar()),
        )

    def read(self) -> ControllerReading:
        """The present state. Raises PeerError, PeerRefused for a refused login, PeerTimeout without an answer."""
        mode = self._value("/rw/panel/opmode", "opmode")
        state = self._value("/rw/panel/ctrlstate", "ctrlstate")
        execution = self._value("/rw/rapid/execution", "ctrlexecstate")
        return ControllerReading(MODES.get(mode, mode), STATES.get(state, state), execution)

    def logout(self) -> None:
        """End the session of the controller; errors are ignored, because it ends by itself after some minutes."""
        with contextlib.suppress(PeerError):
            self._get("/logout")

    def _value(self, resource: str, key: str) -> str:
        return parse_state(self._get(f"{resource}?json=1"), key)

    def _get(self, target: str) -> bytes:
        try:
            with self._opener.open(self.address + target, timeout=self._timeout) as answer:
                return bytes(answer.read(_MAX_ANSWER))
        except urllib.error.HTTPError as error:
            error.close()
            raise self._refused(target, error.code, error.reason) from error
        except (TimeoutError, urllib.error.URLError) as error:
            reason = error.reason if isinstance(error, urllib.error.URLError) else error
            if isinstance(reason, TimeoutError):
                text = f"web services: no answer from {self.address} within {self._timeout:g} s"
                raise PeerTimeout(f"{text}; is the controller on?") from error
            text = getattr(reason, "strerror", None) or str(reason)
            raise PeerError(f"web services: cannot reach {self.address}: {text}; is the address right?") from error
        except (OSError, http.client.HTTPException, ValueError) as error:
            # ValueError: an authentication that urllib does not support.
            text = " ".join(str(error).split()) or type(error).__name__
            raise PeerError(f"web services: {self.address} sent no valid answer: {text}") from error

    def _refused(self, target: str, code: int, reason: str) -> PeerError:
        if code in (401, 403):
            return PeerRefused(
                f"web services: {self.address} refuses the user {USER!r} with the default password ({code}); "
                "restore them on the controller, or remove web_services from the lab file"
            )
        hint = "; too many sessions, wait some minutes" if code == 503 else ""
        return PeerRefused(f"web services: {self.address}{target} answers {code} {reason}{hint}")


def parse_state(data: bytes, key: str) -> str:
    """The value of `key` in an answer of Robot Web Services 1.0 in JSON. Raises PeerError for any other data."""
    try:
        states = json.loads(data)["_embedded"]["_state"]
        value = next(state[key] for state in states if key in state)
    except (ValueError, TypeError, KeyError, StopIteration, RecursionError):
        value = None
    if not isinstance(value, str) or not 0 < len(value) <= 40 or not value.isprintable():
        raise PeerError(
            f"web services: expected an answer with {key}, got {data[:60]!r}; is it a RobotWare 6 controller?"
        )
    return value
