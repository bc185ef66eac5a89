"""MJPEG over HTTP as bytes: the head of the response and the multipart stream, in portions of any size. No I/O.

Streams differ (with or without Content-Length, boundary with or without leading dashes, LF or CRLF), and a failing
connection or server sends partial data. An incomplete part is counted and skipped, and the parser continues at the
next boundary, so that one damaged part costs one image.
"""

import re
from dataclasses import dataclass

from gelflow.errors import PeerError, PeerRefused

MAX_HEAD = 16 * 1024  # bytes of an HTTP head or of a part's headers
MAX_PART = 16 * 1024 * 1024  # bytes of one image
_BLANK_LINE = re.compile(rb"\r?\n\r?\n")
_TIMESTAMP = re.compile(r"[0-9]{1,12}(\.[0-9]{1,9})?")
_START, _END = b"\xff\xd8", b"\xff\xd9"  # first and last marker of every JPEG


@dataclass(frozen=True)
class Head:
    """The head of an HTTP response."""

    status: int
    reason: str
    headers: dict[str, str]  # names in lower case

    def boundary(self) -> bytes:
        """The multipart boundary without its leading dashes.

        Raises PeerRefused when the status is not 200, PeerError when the content is not a multipart stream.
        """
        if self.status != 200:
            raise PeerRefused(f"expected 200, got {self.status} {self.reason}".rstrip())
        if "chunked" in self.headers.get("transfer-encoding", "").lower():
            raise PeerError("expected a plain HTTP/1.0 body, got chunked transfer encoding")
        content = self.headers.get("content-type", "")
        boundary = re.search(r'boundary\s*=\s*(?:"([^"]+)"|([^\s;]+))', content, re.IGNORECASE)
        if not content.lower().startswith("multipart/") or boundary is None:
            raise PeerError(f"expected multipart/x-mixed-replace with a boundary, got {content or 'no content type'!r}")
        token = (boundary[1] or boundary[2]).lstrip("-")
        if not token:
            raise PeerError(f"expected a boundary that consists of more than dashes, got {content!r}")
        return token.encode("latin-1")


def request(host: str, target: str) -> bytes:
    """The HTTP request for a stream. HTTP/1.0 excludes chunked transfer encoding."""
    lines = (f"GET {target} HTTP/1.0", f"Host: {host}", "User-Agent: gelflow", "Accept: multipart/x-mixed-replace")
    return "".join(f"{line}\r\n" for line in (*lines, "")).encode("latin-1")


def parse_head(data: bytes) -> tuple[Head, bytes] | None:
    """The head of an HTTP response and the data after it; None while the head is incomplete.

    Raises PeerError when `data` is not the start of an HTTP response.
    """
    if not b"HTTP/".startswith(data[:5]):
        raise PeerError(f"expected an HTTP response, got {data[:20]!r}")
    blank = _BLANK_LINE.search(data)
    if blank is None or blank.end() > MAX_HEAD:
        if len(data) >= MAX_HEAD:
            raise PeerError(f"expected an HTTP head of at most {MAX_HEAD} bytes, got a longer one")
        return None
    first, *lines = data[: blank.start()].decode("latin-1").splitlines()
    status = re.match(r"HTTP/\d(?:\.\d)? (\d{3})(?: (.*))?$", first)
    if status is None:
        raise PeerError(f"expected an HTTP status line, got {first[:60]!r}")
    return Head(int(status[1]), (status[2] or "").strip(), _headers(lines)), data[blank.end() :]


@dataclass(frozen=True)
class Part:
    """One JPEG image of a multipart stream."""

    data: bytes
    camera_time: float | None = None  # X-Timestamp: time of the image on the camera's own clock [s]


class MultipartParser:
    """Extracts the JPEG images of a multipart body, independently of how the data is split.

    A part with a Content-Length is complete with its last byte, a part without one with the next boundary. A part is
    an image when it starts and ends with the JPEG markers. `damaged` counts the skipped parts.
    """

    def __init__(self, boundary: bytes) -> None:
        self.damaged = 0
        self._delimiter = b"--" + boundary
        self._buffer = bytearray()
        self._scanned = 0  # no delimiter starts before this offset
        self._state = self._seek
        self._length: int | None = None
        self._camera_time: float | None = None

    def feed(self, data: bytes) -> list[Part]:
        """Add received bytes; returns the images that they complete, in order."""
        self._buffer += data
        images: list[Part] = []
        while self._state(images):
            pass
        return images

    # Each state returns False when it needs more bytes.

    def _seek(self, images: list[Part]) -> bool:
        """Between parts: skip to the next delimiter."""
        position = self._find(len(self._buffer))
        if position < 0:
            del self._buffer[: self._scanned]
            self._scanned = 0
            return False
        self._begin(position)
        return True

    def _read_headers(self, images: list[Part]) -> bool:
        """After a delimiter: the rest of its line, then headers, then a blank line."""
        blank = _BLANK_LINE.search(self._buffer, 0, MAX_HEAD)
        again = self._find(blank.start() if blank else min(len(self._buffer), MAX_HEAD))
        if again >= 0:  # a part that ends within its headers, or the closing delimiter of a stream that continues
            self._begin(again)
            return True
        if blank is None:
            if len(self._buffer) < MAX_HEAD:
                return False
            self._drop(self._scanned)
            return True
        headers = _headers(bytes(self._buffer[: blank.start()]).decode("latin-1").splitlines()[1:])
        length = headers.get("content-length", "")
        # An implausible length is ignored: the delimiter ends the part.
        self._length = int(length) if length.isascii() and length.isdigit() and len(length) < 10 else None
        if self._length is not None and not 0 < self._length <= MAX_PART:
            self._length = None
        self._camera_time = parse_timestamp(headers.get("x-timestamp", ""))
        self._advance(blank.end())
        self._state = self._read_body
        return True

    def _read_body(self, images: list[Part]) -> bool:
        limit = MAX_PART + len(self._delimiter) if self._length is None else self._length
        position = self._find(min(len(self._buffer), limit))
        if position >= 0:
            # A delimiter before the announced length means that the part is truncated.
            if self._length is None:
                self._emit(bytes(self._buffer[:position]).rstrip(b"-").rstrip(b"\r\n"), images)
            else:
                self.damaged += 1
            self._begin(position)
            return True
        if len(self._buffer) < limit:
            return False
        if self._length is None:
            self._drop(self._scanned)
        elif self._emit(bytes(self._buffer[:limit]), images):
            self._advance(limit)
        else:  # the end of the part may be the start of a delimiter
            self._advance(max(0, limit - len(self._delimiter) + 1))
        self._state = self._seek
        return True

    def _find(self, end: int) -> int:
        """Start of the first delimiter that ends before `end`, or -1; stores how far the buffer was searched."""
        position = self._buffer.find(self._delimiter, self._scanned, end)
        if position < 0:
            self._scanned = max(self._scanned, end - len(self._delimiter) + 1)
        return position

    def _begin(self, delimiter: int) -> None:
        self._advance(delimiter + len(self._delimiter))
        self._state = self._read_headers

    def _advance(self, count: int) -> None:
        del self._buffer[:count]
        self._scanned = 0

    def _drop(self, count: int) -> None:
        """Skip a part that is too long."""
        self.damaged += 1
        self._advance(count)
        self._state = self._seek

    def _emit(self, body: bytes, images: list[Part]) -> bool:
        # Some cameras pad the image with zeros.
        whole = body.startswith(_START) and body.rstrip(b"\0\r\n").endswith(_END)
        if whole:
            images.append(Part(body, self._camera_time))
        else:
            self.damaged += 1
        return whole


def parse_timestamp(text: str) -> float | None:
    """The time in mjpg-streamer's header "X-Timestamp: SEC.USEC" [s]; None for a missing, malformed or zero one.

    Some input plugins of mjpg-streamer send zero because they have no time.
    """
    seconds = float(text) if _TIMESTAMP.fullmatch(text) else 0.0
    return seconds if seconds > 0 else None


def _headers(lines: list[str]) -> dict[str, str]:
    pairs = (line.split(":", 1) for line in lines if ":" in line)
    return {name.strip().lower(): value.strip() for name, value in pairs}
