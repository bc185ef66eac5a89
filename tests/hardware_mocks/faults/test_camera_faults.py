"""Faults of the mock camera, as an independent client of its MJPEG stream sees them."""

import re
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from urllib.error import HTTPError
from urllib.request import urlopen

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from gelflow.clock import ScaledClock
from gelflow.errors import PeerError
from gelflow.hardware_mocks.camera.device import MockMjpegCamera

CLOCK = ScaledClock(1.0)
BOUNDARY = b"--boundarydonotcross\r\n"


class Source:
    """JPEGs with a square that grows by a pixel per image; all differ."""

    def __init__(self) -> None:
        self.made: list[bytes] = []

    def __call__(self) -> bytes:
        picture = np.full((48, 64, 3), 120, np.uint8)
        half = 4 + len(self.made) % 12
        picture[24 - half : 24 + half, 32 - half : 32 + half] = 20 + len(self.made) % 50
        self.made.append(cv2.imencode(".jpg", picture)[1].tobytes())
        return self.made[-1]


class Client:
    """Collects the bytes of the stream, read by read."""

    def __init__(self, port: int) -> None:
        self._link = socket.create_connection(("127.0.0.1", port), 5.0)
        self._link.sendall(b"GET /?action=stream HTTP/1.0\r\n\r\n")
        self.data, self.closed = b"", False
        self.reads: list[bytes] = []
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def _read(self) -> None:
        try:
            while data := self._link.recv(65536):
                self.data += data
                self.reads.append(data)
        except OSError:
            pass
        self.closed = True

    def parts(self) -> list[tuple[float, bytes]]:
        """Stamp and body of each complete part so far."""
        found = []
        for part in self.data.split(BOUNDARY)[1:-1]:
            head, _, body = part.partition(b"\r\n\r\n")
            stamp = re.search(rb"X-Timestamp: ([\d.]+)", head)
            found.append((float(stamp[1]) if stamp else 0.0, body[:-2]))
        return found

    def next_parts(self, count: int) -> list[tuple[float, bytes]]:
        """The next complete parts; those before are not returned."""
        before, end = len(self.parts()), time.monotonic() + 10.0
        while len(self.parts()) < before + count:
            assert time.monotonic() < end, "the mock camera sent nothing"
            time.sleep(0.005)
        return self.parts()[before : before + count]


@contextmanager
def faulty(kind: str, **values: Any) -> Iterator[tuple[Client, Source, MockMjpegCamera]]:
    """A camera whose fault begins after five parts."""
    source = Source()
    with MockMjpegCamera(source, CLOCK, rate=50.0) as camera:
        client = Client(camera.port)
        client.next_parts(5)
        camera.begin_fault(3, kind, values)
        client.next_parts(2) if kind not in ("disconnect", "stall", "delay") else None  # may be under way
        yield client, source, camera


def pixels(jpeg: bytes) -> NDArray[np.uint8]:
    image = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
    assert image is not None
    return np.asarray(image, dtype=np.uint8)


def test_frozen_camera_repeats_its_images_with_new_stamps() -> None:
    for loop in (1, 3):
        with faulty("freeze", loop=loop) as (client, _, camera):
            parts = client.next_parts(9)
            assert len({body for _, body in parts}) == loop
            assert len({stamp for stamp, _ in parts}) == 9
            camera.end_fault(3)
            client.next_parts(2)
            assert len({body for _, body in client.next_parts(5)}) == 5


def test_covered_camera_sends_dark_images_that_differ() -> None:
    with faulty("blacken") as (client, _, _):
        bodies = [body for _, body in client.next_parts(5)]
        assert max(pixels(body).mean() for body in bodies) < 6
        assert len(set(bodies)) == 5 and pixels(bodies[0]).shape == (48, 64, 3)


def test_rescaled_images_show_larger_objects() -> None:
    with faulty("rescale", zoom=2.0) as (client, source, _):
        shown = pixels(client.next_parts(1)[0][1])
        dark = (shown[..., 0] < 90).sum()
        areas = [(pixels(jpeg)[..., 0] < 90).sum() for jpeg in source.made[-6:]]
        assert any(dark == pytest.approx(4 * area, rel=0.25) for area in areas)


def test_stalled_camera_sends_nothing_and_keeps_the_connection() -> None:
    with faulty("stall") as (client, _, camera):
        time.sleep(0.1)
        size = len(client.data)
        time.sleep(0.3)
        assert len(client.data) == size and not client.closed
        camera.end_fault(3)
        client.next_parts(2)


def test_disconnected_camera_closes_the_stream_and_refuses_clients() -> None:
    with faulty("disconnect") as (client, _, camera):
        end = time.monotonic() + 5.0
        while not client.closed:
            assert time.monotonic() < end
            time.sleep(0.005)
        refused = Client(camera.port)
        while not refused.closed:
            assert time.monotonic() < end
            time.sleep(0.005)
        assert refused.data.startswith(b"HTTP/1.0 503")
        camera.end_fault(3)
        Client(camera.port).next_parts(2)


def test_dropped_parts_are_missing_from_the_stream() -> None:
    with faulty("drop", share=0.5, seed=1) as (client, _, _):
        stamps = np.array([stamp for stamp, _ in client.next_parts(12)])
        assert (np.diff(stamps) > 0.03).any()


def test_duplicated_parts_have_the_same_stamp() -> None:
    with faulty("duplicate", share=1.0, seed=1) as (client, _, _):
        stamps = [stamp for stamp, _ in client.next_parts(12)]
        assert len(set(stamps)) <= 7


def test_reordered_parts_have_stamps_that_go_back() -> None:
    with faulty("reorder", share=0.5, seed=1) as (client, _, _):
        stamps = np.array([stamp for stamp, _ in client.next_parts(20)])
        assert (np.diff(stamps) < 0).any()


def test_delayed_parts_arrive_with_old_stamps() -> None:
    with faulty("delay", share=1.0, delay=0.4, seed=1) as (client, _, camera):
        client.next_parts(4)
        while client.parts()[-1][0] < client.parts()[4][0] + 0.1:
            client.next_parts(1)
        assert camera._stamp - client.parts()[-1][0] > 0.25


def test_corrupt_parts_do_not_contain_an_image_of_the_source() -> None:
    with faulty("corrupt", share=1.0, count=200, seed=1) as (client, source, _):
        size = len(client.data)
        time.sleep(0.3)
        rest = client.data[size:]
        assert len(rest) > 2000 and not any(jpeg in rest for jpeg in source.made)


def test_split_parts_arrive_in_two_portions() -> None:
    with faulty("split", share=1.0, delay=0.05, seed=1) as (client, source, _):
        before = len(client.reads)
        parts = client.next_parts(4)
        assert all(body in source.made for _, body in parts)
        assert sum(not data.endswith(BOUNDARY) for data in client.reads[before:]) >= 3


def test_garbage_stands_between_the_parts() -> None:
    with faulty("garbage", share=1.0, count=300, seed=1) as (client, source, _):
        size = len(client.data)
        time.sleep(0.3)
        rest = client.data[size:]
        complete = sum(jpeg in rest for jpeg in source.made)
        assert complete >= 3
        assert len(rest) > sum(len(jpeg) for jpeg in source.made if jpeg in rest) + 250 * complete


def test_a_snapshot_of_a_failed_source_is_refused() -> None:
    def fail() -> bytes:
        raise ValueError("no image")

    camera = MockMjpegCamera(fail, CLOCK).start()
    for _ in range(2):  # when the source fails, and afterwards
        with pytest.raises(HTTPError, match="503"):
            urlopen(camera.url.replace("stream", "snapshot"), timeout=20)
    with pytest.raises(PeerError, match="ValueError: no image"):
        camera.close()
