"""Sign of life of cameras: a frozen or looping stream ends in a time-out and never returns an old image as new."""

import itertools
import socket
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from tests.common.manual_clock import ManualClock

from gelflow.clock import ScaledClock
from gelflow.errors import PeerTimeout, UsageError
from gelflow.hardware_mocks.camera.device import MockMjpegCamera
from gelflow.perception.synthetic.appearance import GelAppearance
from gelflow.perception.synthetic.fast_renderer import FastGelRenderer
from gelflow.protocols import CameraImage
from gelflow.real.camera.driver import MjpegCamera, UvcCamera
from gelflow.real.camera.liveness import HISTORY, CameraClock, RepeatFilter, picture_digest

CLOCK = ScaledClock(1.0)
PATIENT = 10.0  # time-out that only a failing test reaches [s]


def jpeg(number: int) -> bytes:
    noise = np.random.default_rng(number).integers(0, 255, (24, 32, 3), dtype=np.uint8)
    return cv2.imencode(".jpg", noise)[1].tobytes()


class Server:
    """A source whose images the test freezes: it then repeats `loop` images."""

    def __init__(self) -> None:
        self.made = 0
        self.loop: list[bytes] = []

    def __call__(self) -> bytes:
        self.made += 1
        return self.loop[self.made % len(self.loop)] if self.loop else jpeg(self.made)


class TimedStream:
    """An MJPEG server on a socket that sends X-Timestamp, and a camera on it; each `send` waits for the reception."""

    def __init__(self, **settings: Any) -> None:
        self.clock = ManualClock(100.0)
        self.seen: list[CameraImage] = []
        self._listener = socket.create_server(("127.0.0.1", 0))
        url = f"http://127.0.0.1:{self._listener.getsockname()[1]}/?action=stream"
        self.camera = MjpegCamera(url, "left", self.clock, on_image=self.seen.append, **settings)

    def __enter__(self) -> "TimedStream":
        head = b"HTTP/1.0 200 OK\r\nContent-Type: multipart/x-mixed-replace;boundary=xyz\r\n\r\n--xyz\r\n"
        opening = threading.Thread(target=self.camera.open)
        opening.start()
        self._link = self._listener.accept()[0]
        self._link.recv(4096)
        self._link.sendall(head)
        opening.join(PATIENT)
        return self

    def __exit__(self, *_: object) -> None:
        self.camera.close()
        self._link.close()
        self._listener.close()

    def send(self, received: float, camera_time: float, *, repeat: bool = False) -> CameraImage:
        """Send an image that is received at the robot time `received` [s]; returns the recorded image."""
        self.clock.time = received
        rejected, count = self._rejected(), len(self.seen)
        image = self.seen[-1].data if repeat else jpeg(count)
        header = f"Content-Type: image/jpeg\r\nContent-Length: {len(image)}\r\nX-Timestamp: {camera_time:.6f}\r\n\r\n"
        self._link.sendall(header.encode() + image + b"\r\n--xyz\r\n")
        wait(lambda: len(self.seen) > count)
        wait(lambda: self.camera._newest is self.seen[-1] or self._rejected() > rejected)
        return self.seen[-1]

    def _rejected(self) -> int:
        return self.camera.repeated + self.camera.unclocked + self.camera.late


def segment(marker: int, content: bytes) -> bytes:
    return bytes([0xFF, marker]) + (len(content) + 2).to_bytes(2) + content


def wait(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + PATIENT
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


@pytest.mark.parametrize("length", [1, 3])
def test_frozen_server_ends_in_a_timeout_of_latest_and_next(length: int) -> None:
    source = Server()
    seen: list[CameraImage] = []
    server = MockMjpegCamera(source, CLOCK, rate=50)
    with server, MjpegCamera(server.url, "left", CLOCK, timeout=0.25, on_image=seen.append) as camera:
        camera.next(5, PATIENT)
        source.loop = [jpeg(10_000 + number) for number in range(length)]
        wait(lambda: camera.repeated > 20)
        with pytest.raises(PeerTimeout, match=r"camera left: repeats the same image \(\d+ times\).*frozen") as caught:
            camera.latest()
        assert "\n" not in str(caught.value) and server.url in str(caught.value)
        last = camera._newest
        assert last is not None
        with pytest.raises(PeerTimeout, match="repeats the same image"):
            camera.next(last.sequence, 0.2)
        source.loop = []
        wait(lambda: not camera._frozen)  # the camera runs again
        assert camera.next(last.sequence, PATIENT).sequence > last.sequence
        camera.latest()
    # The recording holds the repeated images too.
    assert [image.sequence for image in seen] == list(range(len(seen)))
    assert sum(image.data in [jpeg(10_000 + number) for number in range(length)] for image in seen) > 20


def test_repeats_among_new_images_are_counted_and_not_returned() -> None:
    counter = itertools.count()
    returned: list[CameraImage] = []
    server = MockMjpegCamera(lambda: jpeg(next(counter) // 2), CLOCK, rate=100)  # sends each image twice
    with server, MjpegCamera(server.url, "left", CLOCK, timeout=PATIENT) as camera:
        returned.append(camera.next(-1, PATIENT))
        while len(returned) < 10:
            returned.append(camera.next(returned[-1].sequence, PATIENT))
        assert camera.repeated >= 8
    assert len({image.data for image in returned}) == len(returned)


def test_reconnect_does_not_make_an_image_new() -> None:
    source = Server()
    server = MockMjpegCamera(source, CLOCK, rate=50)
    with server, MjpegCamera(server.url, "left", CLOCK, timeout=1.0) as camera:
        camera.next(5, PATIENT)
        source.loop = [jpeg(10_000)]
        wait(lambda: camera.repeated > 5)
        camera.reconnect()
        with pytest.raises(PeerTimeout, match=r"none so far.*frozen"):
            camera.latest()


def test_frozen_pixels_of_a_device_end_in_a_timeout(tmp_path: Path) -> None:
    class Device:
        """An OpenCV capture that delivers the same pixels without end."""

        def read(self) -> tuple[bool, np.ndarray]:
            time.sleep(0.01)
            return True, np.full((8, 8, 3), 9, np.uint8)

        def release(self) -> None:
            """Nothing to release."""

    class Frozen(UvcCamera):
        def _connect(self) -> None:
            self._capture = Device()

    with Frozen(0, "right", CLOCK, timeout=0.2) as camera:
        camera.latest()
        with pytest.raises(PeerTimeout, match="camera right: repeats the same image"):
            camera.next(0, 0.2)


def test_digest_ignores_what_does_not_affect_pixels() -> None:
    image = jpeg(1)
    stamped = image[:2] + segment(0xFE, b"12:00:01") + segment(0xE1, b"Exif\0\0 12:00:01") + image[2:]
    later = image[:2] + segment(0xFE, b"12:00:02") + segment(0xE1, b"Exif\0\0 12:00:02") + image[2:]
    assert picture_digest(stamped) == picture_digest(later) == picture_digest(image + bytes(7)) == picture_digest(image)
    assert picture_digest(jpeg(2)) != picture_digest(image)


@pytest.mark.parametrize("data", [b"", b"\xff\xd8", b"\xff\xd8\xff\xe0\xff\xff", b"\xff\xd8\xff\xfe\0\0\xff\xfe\0\0"])
def test_digest_of_malformed_data_does_not_fail(data: bytes) -> None:
    assert len(picture_digest(data)) == 16


def test_growing_delay_of_a_server_is_a_timeout() -> None:
    """The images arrive at the full rate and differ, but each is taken ever longer before its reception."""
    with TimedStream(timeout=0.25) as stream:
        sent, number = 100.0, 0
        while stream.camera.late == 0:
            taken = 5000.0 + 0.08 * number
            sent = 100.0 + 0.08 * number + (0.0 if number < 5 else 0.02 * (number - 5))
            image = stream.send(sent, taken)
            if stream.camera.late == 0:
                assert stream.camera.latest() is image
            assert image.stamp == pytest.approx(100.0 + 0.08 * number, abs=2e-3)  # the time of the exposure
            number += 1
            assert number < 30
        assert 0.25 < sent - image.stamp < 0.29
        stream.clock.time = sent + 0.2
        with pytest.raises(PeerTimeout, match=r"camera left: sends images 0\.2\d s late by its own clock .*buffers"):
            stream.camera.latest()
        image = stream.send(sent + 0.5, 5000.0 + 0.5 + sent - 100.0)  # the server has caught up
        assert stream.camera.latest() is image


def test_frozen_camera_is_reported_before_a_longer_time_limit() -> None:
    with TimedStream(timeout=12.0, frozen_after=0.25) as stream:
        newest = stream.send(100.0, 50.0)
        for number in range(1, 4):  # late receptions of images that were sent 80 ms apart
            stream.send(100.0 + number, 50.0 + 0.08 * number, repeat=True)
            assert stream.camera.latest() is newest
        stream.send(104.0, 50.32, repeat=True)
        with pytest.raises(PeerTimeout, match=r"repeats the same image \(4 times\).*the last 4\.00 s ago"):
            stream.camera.latest()
        with pytest.raises(PeerTimeout, match="repeats the same image"):
            stream.camera.next(newest.sequence, 10.0)  # without waiting
        newest = stream.send(104.5, 50.4)
        assert stream.camera.latest() is newest is stream.camera.next(0, 10.0)


def test_image_in_order_of_arrival_but_not_of_the_camera_is_not_new() -> None:
    with TimedStream(timeout=0.25) as stream:
        stream.send(100.0, 50.0)
        newest = stream.send(100.08, 50.08)
        stream.send(100.10, 50.0)  # duplicated or reordered by the server
        assert stream.camera.latest() is newest and stream.camera.unclocked == 1
        assert stream.camera.latest() is newest
        newest = stream.send(100.16, 50.16)
        assert stream.camera.latest() is newest


def test_camera_whose_clock_stands_still_is_a_timeout() -> None:
    with TimedStream(timeout=0.25) as stream:
        for number in range(5):
            stream.send(100.0 + 0.08 * number, 50.0)
        with pytest.raises(PeerTimeout, match=r"X-Timestamp does not advance \(4 times\)"):
            stream.camera.latest()


def test_camera_clock_that_is_set_costs_at_most_one_image() -> None:
    with TimedStream(timeout=0.25) as stream:
        for number, shift in enumerate([0.0, 0.0, 3600.0, 3600.0, -7200.0, -7200.0, 0.0, 0.0]):
            image = stream.send(100.0 + 0.08 * number, 9000.0 + 0.08 * number + shift)
            assert image.stamp == pytest.approx(100.0 + 0.08 * number)
        assert stream.camera.latest() is image and stream.camera.unclocked == 1 and stream.camera.late == 0


def test_latency_is_subtracted_from_the_stamps() -> None:
    with TimedStream(timeout=0.25, latency=0.05) as stream:
        assert stream.send(100.0, 50.0).stamp == pytest.approx(99.95)
        assert stream.send(100.11, 50.08).stamp == pytest.approx(100.03, abs=1e-4)  # 30 ms late
        stream.clock.time = 100.27
        stream.camera.latest()
        stream.clock.time = 100.29  # 0.26 s after the exposure
        with pytest.raises(PeerTimeout, match=r"the last 0\.26 s ago"):
            stream.camera.latest()


@pytest.mark.parametrize("latency", [-0.01, 0.25, float("nan")])
def test_latency_outside_the_time_limit_is_refused(latency: float) -> None:
    with pytest.raises(UsageError, match="camera left: latency"):
        MjpegCamera("http://127.0.0.1:1/", "left", CLOCK, timeout=0.25, latency=latency)


def test_drift_of_the_camera_clock_is_not_a_delay() -> None:
    for drift in (-300e-6, 300e-6):
        clock, rng = CameraClock(), np.random.default_rng(1)
        for number in range(30 * 3600):  # one hour
            received = number / 30 + rng.uniform(0, 0.01)
            delay = clock.delay(received, 1e9 + number / 30 * (1 + drift))
            assert delay is not None and delay < 0.02


def test_memory_is_bounded() -> None:
    repeats = RepeatFilter()
    assert not any(repeats.is_repeat(b"%d" % number) for number in range(HISTORY + 1))
    assert repeats.is_repeat(b"1") and not repeats.is_repeat(b"0")
    assert len(repeats._known) == len(repeats._order) == HISTORY


def test_gel_at_rest_never_gives_the_same_image_twice() -> None:
    look = GelAppearance()
    renderer, repeats = FastGelRenderer(look), RepeatFilter()
    rest = np.zeros((look.grid.rows * look.grid.cols, 2))
    assert not any(repeats.is_repeat(renderer.encode(renderer.render(rest, sequence=k))) for k in range(400))
