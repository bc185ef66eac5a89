"""MJPEG parser without I/O: only complete images are extracted, for any split and any damage of the stream."""

import itertools
import time

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gelflow.errors import PeerError, PeerRefused
from gelflow.real.camera import codec

BOUNDARY = b"boundarydonotcross"


def jpeg(number: int, size: int = 40) -> bytes:
    return b"\xff\xd8" + bytes([number]) * size + b"\xff\xd9"


def part(body: bytes, *, length: int | None = None, newline: bytes = b"\r\n", dashes: bytes = b"--") -> bytes:
    headers = [b"Content-Type: image/jpeg"]
    if length is not None:
        headers.append(b"Content-Length: %d" % length)
    return dashes + BOUNDARY + newline + newline.join(headers) + newline * 2 + body + newline


def parse(data: bytes, cuts: list[int] | None = None) -> tuple[list[bytes], int]:
    parser = codec.MultipartParser(BOUNDARY)
    images = []
    edges = [0, *sorted(cut % (len(data) + 1) for cut in cuts or []), len(data)]
    for start, end in itertools.pairwise(edges):
        images += [part.data for part in parser.feed(data[start:end])]
    return images, parser.damaged


BODIES = st.binary(max_size=60).filter(lambda body: BOUNDARY not in body)
IMAGES = BODIES.map(lambda body: b"\xff\xd8" + body + b"\xff\xd9")
PIECES = (
    jpeg(1),
    part(jpeg(2), length=44),
    part(jpeg(3)),
    part(jpeg(4)[:20], length=44),
    part(jpeg(5), length=9000),
    b"--" + BOUNDARY,
    b"\r\n\r\n",
    b"\xff",
    b"Content-Length: 7\r\n",
    b"-",
)


@given(st.lists(IMAGES, max_size=5), st.booleans(), st.sampled_from([b"\r\n", b"\n"]), st.lists(st.integers(0, 4000)))
def test_every_image_is_extracted_for_any_split_of_the_stream(
    images: list[bytes], with_length: bool, newline: bytes, cuts: list[int]
) -> None:
    parts = [part(image, length=len(image) if with_length else None, newline=newline) for image in images]
    data = b"".join(parts) + b"--" + BOUNDARY + newline
    assert parse(data, cuts) == (images, 0)


@given(st.lists(st.sampled_from(PIECES), max_size=12), st.lists(st.integers(0, 4000)))
def test_result_with_garbage_is_independent_of_the_split_and_contains_complete_images_only(
    pieces: list[bytes], cuts: list[int]
) -> None:
    data = b"".join(pieces)
    assert parse(data, cuts) == parse(data)
    assert all(image.startswith(b"\xff\xd8") and image.endswith(b"\xff\xd9") for image in parse(data)[0])


@given(st.binary(max_size=300), st.integers(0, 2))
def test_parser_resynchronizes_after_garbage(noise: bytes, kind: int) -> None:
    before = [b"", b"--" + BOUNDARY + b"\r\n", part(jpeg(1), length=5000)[:80]][kind]
    images, _ = parse(before + noise + b"".join(part(jpeg(n), length=44) for n in (7, 8, 9)) + b"--" + BOUNDARY)
    assert images[-2:] == [jpeg(8), jpeg(9)]  # the noise may damage the following part


def test_image_with_a_length_is_complete_with_its_last_byte() -> None:
    parser = codec.MultipartParser(BOUNDARY)
    data = part(jpeg(1), length=44)
    assert parser.feed(data[:-3]) == []
    assert parser.feed(data[-3:-2]) == [codec.Part(jpeg(1))]


@pytest.mark.parametrize(
    ("header", "expected"),
    [
        (b"X-Timestamp: 1700000000.000025", 1700000000.000025),
        (b"x-timestamp:12.500", 12.5),
        (b"X-Timestamp: 7", 7.0),
        (b"X-Timestamp: 0.000000", None),  # of an input plugin without a clock
        (b"X-Timestamp: -1.5", None),
        (b"X-Timestamp: nan", None),
        (b"X-Timestamp: 1e300", None),
        (b"X-Timestamp: 12:30:05", None),
        (b"X-Timestamp:", None),
        (b"X-Framerate: 30", None),
    ],
)
def test_time_of_the_camera_is_read_from_the_header_of_its_part(header: bytes, expected: float | None) -> None:
    opening = b"--" + BOUNDARY + b"\r\nContent-Type: image/jpeg\r\nContent-Length: 44\r\n"
    first = opening + header + b"\r\n\r\n" + jpeg(1) + b"\r\n"
    parts = codec.MultipartParser(BOUNDARY).feed(first + part(jpeg(2), length=44))
    assert parts == [codec.Part(jpeg(1), expected), codec.Part(jpeg(2), None)]


def test_truncated_part_costs_one_image() -> None:
    cut = part(jpeg(1)[:20], length=44)
    for lost in range(30):  # also when the announced length ends within the next boundary
        short = part(jpeg(1)[: 44 - lost], length=44)
        images, damaged = parse(short + part(jpeg(2), length=44) + part(jpeg(3), length=44))
        assert images[-2:] == [jpeg(2), jpeg(3)]
        assert damaged == (1 if lost else 0)
    assert parse(cut + part(jpeg(2)) + b"--" + BOUNDARY) == ([jpeg(2)], 1)


def test_wrong_length_costs_one_image() -> None:
    for length in (43, 30, 9000, 10**8):
        images, damaged = parse(part(jpeg(1), length=length) + part(jpeg(2), length=44))
        assert (images, damaged) in [([jpeg(2)], 1), ([jpeg(1), jpeg(2)], 0)]
    assert parse(part(jpeg(1), length=0) + part(jpeg(2), length=44)) == ([jpeg(1), jpeg(2)], 0)


def test_parts_that_are_not_jpeg_are_skipped() -> None:
    page = b"<html>camera is busy</html>"
    assert parse(part(page, length=len(page)) + part(page) + part(jpeg(2), length=44)) == ([jpeg(2)], 2)


def test_padding_and_extra_dashes_are_accepted() -> None:
    padded = jpeg(1) + bytes(20)
    assert parse(part(padded, length=len(padded))) == ([padded], 0)
    dashed = part(jpeg(1), dashes=b"----") + part(jpeg(2), dashes=b"----") + b"----" + BOUNDARY
    assert parse(dashed) == ([jpeg(1), jpeg(2)], 0)


def test_endless_garbage_needs_bounded_memory_and_time() -> None:
    for opening in (b"", b"--" + BOUNDARY, part(b"")):
        parser = codec.MultipartParser(BOUNDARY)
        parser.feed(opening)
        started = time.monotonic()
        for _ in range(40):
            assert parser.feed(b"\0" * 1_000_000) == []
        assert len(parser._buffer) <= codec.MAX_PART + 1_000_000
        assert parser.feed(part(jpeg(1), length=44) + part(jpeg(2), length=44))[-1] == codec.Part(jpeg(2))
        assert time.monotonic() - started < 20  # a quadratic search takes hours


def test_response_head_is_parsed_when_complete() -> None:
    data = b'HTTP/1.0 200 OK\r\nContent-Type: multipart/x-mixed-replace; boundary="--abc"\r\n\r\nrest'
    for length in range(len(data) - 4):
        assert codec.parse_head(data[:length]) is None
    head = codec.parse_head(data)
    assert head is not None and head[1] == b"rest" and head[0].boundary() == b"abc"


@pytest.mark.parametrize(
    ("data", "kind", "text"),
    [
        (b"HTTP/1.1 404 Not Found\r\n\r\n", PeerRefused, "404 Not Found"),
        (b"HTTP/1.1 200\r\nContent-Type: image/jpeg\r\n\r\n", PeerError, "image/jpeg"),
        (b"HTTP/1.1 200 OK\r\n\r\n", PeerError, "no content type"),
        (b"HTTP/1.1 200 OK\r\nContent-Type: multipart/x-mixed-replace; boundary=--\r\n\r\n", PeerError, "dashes"),
        (b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\n", PeerError, "chunked"),
        (b"SSH-2.0-OpenSSH\r\n", PeerError, "SSH"),
        (b"HTTP/x 200 OK\r\n\r\n", PeerError, "status line"),
        (b"HTTP/1.0 200 OK\r\n" + b"X: y\r\n" * 5000, PeerError, "longer"),
    ],
)
def test_invalid_responses_are_reported(data: bytes, kind: type[PeerError], text: str) -> None:
    with pytest.raises(kind, match=text) as caught:
        head = codec.parse_head(data)
        assert head is not None
        head[0].boundary()
    assert type(caught.value) is kind
