"""MJPEG over HTTP as bytes: the answer's head and the multipart stream, taken in pieces of any size. No I/O here.

What cameras send differs (with or without Content-Length, boundary named with or without its dashes, line ends LF or
CRLF), and a bad link or a dying server sends halves. A part that is not whole is counted and left out; the parser
then goes on at the next boundary, so that one bad part costs one image and nothing else.
"""

import re
from dataclasses import dataclass

from gelflow.errors import PeerError, PeerRefused

MAX_HEAD = 16 * 1024  # bytes of an HTTP head or of a part's headers
MAX_PART = 16 * 1024 * 1024  # bytes of one image
_BLANK_LINE = re.compile(rb"\r?\n\r?\n")
_START, _END = b"\xff\xd8", b"\xff\xd9"  # the markers that open and close every JPEG


@dataclass(frozen=True)
class Head:
    """The head of an HTTP answer."""

    status: int
    reason: str
    headers: dict[str, str]  # names in lower case

    def boundary(self) -> bytes:
        """The multipart boundary, without the dashes that stand before it.

        Raises PeerRefused when the server said no, PeerError when what it sends is no multipart stream.
        """
        if self.status != 200:
            raise PeerRefused(f"expected 200, got {self.status} {self.reason}".rstrip())
        if "chunked" in self.headers.get("transfer-encoding", "").lower():
            raise PeerError("expected a plain HTTP/1.0 body, got chunked transfer encoding")
        content = self.headers.get("content-type", "")
        found = re.search(r'boundary\s*=\s*(?:"([^"]+)"|([^\s;]+))', content, re.IGNORECASE)
        if not content.lower().startswith("multipart/") or found is None:
            raise PeerError(f"expected multipart/x-mixed-replace with a boundary, got {content or 'no content type'!r}")
        token = (found[1] or found[2]).lstrip("-")
        if not token:
            raise PeerError(f"expected a boundary that is more than dashes, got {content!r}")
        return token.encode("latin-1")


def request(host: str, target: str) -> bytes:
    """The request for a stream. HTTP/1.0, so that no server may cut the body into chunks."""
    lines = (f"GET {target} HTTP/1.0", f"Host: {host}", "User-Agent: gelflow", "Accept: multipart/x-mixed-replace")
    return "".join(f"{line}\r\n" for line in (*lines, "")).encode("latin-1")


def parse_head(data: bytes) -> tuple[Head, bytes] | None:
    """An HTTP answer's head and what follows it; None while the head is not complete.

    Raises PeerError when `data` can not become one.
    """
    if not b"HTTP/".startswith(data[:5]):
        raise PeerError(f"expected an HTTP answer, got {data[:20]!r}")
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


class MultipartParser:
    """Finds the JPEG images in a multipart body. The pieces fed may be cut anywhere; the images found are the same.

    A part with a Content-Length is given out when its last byte is there; one without when the next boundary is.
    Only what opens and closes as a JPEG counts as one. `damaged` counts the parts left out.
    """

    def __init__(self, boundary: bytes) -> None:
        self.damaged = 0
        self._delimiter = b"--" + boundary
        self._buffer = bytearray()
        self._scanned = 0  # the delimiter does not start before here
        self._state = self._seek
        self._length: int | None = None

    def feed(self, data: bytes) -> list[bytes]:
        """Images that `data` completed, in order."""
        self._buffer += data
        images: list[bytes] = []
        while self._state(images):
            pass
        return images

    # Each state returns whether it moved on: False means that it needs more bytes.

    def _seek(self, images: list[bytes]) -> bool:
        """Between parts: skip to the next delimiter."""
        found = self._find(len(self._buffer))
        if found < 0:
            del self._buffer[: self._scanned]
            self._scanned = 0
            return False
        self._begin(found)
        return True

    def _read_headers(self, images: list[bytes]) -> bool:
        """After a delimiter: the rest of its line, then headers, then a blank line."""
        blank = _BLANK_LINE.search(self._buffer, 0, MAX_HEAD)
        again = self._find(blank.start() if blank else min(len(self._buffer), MAX_HEAD))
        if again >= 0:  # a part that ended within its headers, or the closing delimiter of a stream that goes on
            self._begin(again)
            return True
        if blank is None:
            if len(self._buffer) < MAX_HEAD:
                return False
            self._drop(self._scanned)
            return True
        headers = _headers(bytes(self._buffer[: blank.start()]).decode("latin-1").splitlines()[1:])
        length = headers.get("content-length", "")
        # A length of 0, or one that no image has, is as good as none: the delimiter decides.
        self._length = int(length) if length.isascii() and length.isdigit() and len(length) < 10 else None
        if self._length is not None and not 0 < self._length <= MAX_PART:
            self._length = None
        self._advance(blank.end())
        self._state = self._read_body
        return True

    def _read_body(self, images: list[bytes]) -> bool:
        limit = MAX_PART + len(self._delimiter) if self._length is None else self._length
        found = self._find(min(len(self._buffer), limit))
        if found >= 0:
            # Before the promised length is reached a delimiter means that the part was cut off.
            if self._length is None:
                self._give(bytes(self._buffer[:found]).rstrip(b"-").rstrip(b"\r\n"), images)
            else:
                self.damaged += 1
            self._begin(found)
            return True
        if len(self._buffer) < limit:
            return False
        if self._length is None:
            self._drop(self._scanned)
        elif self._give(bytes(self._buffer[:limit]), images):
            self._advance(limit)
        else:  # its end may be the beginning of a delimiter
            self._advance(max(0, limit - len(self._delimiter) + 1))
        self._state = self._seek
        return True

    def _find(self, end: int) -> int:
        """Where the delimiter starts that lies wholly before `end`, or -1; remembers how far was searched."""
        found = self._buffer.find(self._delimiter, self._scanned, end)
        if found < 0:
            self._scanned = max(self._scanned, end - len(self._delimiter) + 1)
        return found

    def _begin(self, delimiter: int) -> None:
        self._advance(delimiter + len(self._delimiter))
        self._state = self._read_headers

    def _advance(self, count: int) -> None:
        del self._buffer[:count]
        self._scanned = 0

    def _drop(self, count: int) -> None:
        """Give up a part that is too long to be one."""
        self.damaged += 1
        self._advance(count)
        self._state = self._seek

    def _give(self, body: bytes, images: list[bytes]) -> bool:
        # Some cameras fill up with zeros behind the image.
        whole = body.startswith(_START) and body.rstrip(b"\0\r\n").endswith(_END)
        if whole:
            images.append(body)
        else:
            self.damaged += 1
        return whole


def _headers(lines: list[str]) -> dict[str, str]:
    pairs = (line.split(":", 1) for line in lines if ":" in line)
    return {name.strip().lower(): value.strip() for name, value in pairs}
