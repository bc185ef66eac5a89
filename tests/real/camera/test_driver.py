"""Camera drivers over HTTP and, for OpenCV, from a file: newest images, faults, time-outs."""

import socket
import threading
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest

from gelflow.clock import ScaledClock
from gelflow.errors import PeerError, PeerRefused, PeerTimeout, UsageError
from gelflow.hardware_mocks.camera.device import CLOCK_OFFSET, Corruption, MockMjpegCamera
from gelflow.protocols import Camera, CameraImage
from gelflow.real.camera.driver import MjpegCamera, UvcCamera, open_camera

CLOCK = ScaledClock(1.0)
PATIENT = 10.0  # time-out that only a failing test reaches [s]


class Source:
    """JPEGs with increasing brightness; some are padded with zeros, as those of some cameras."""

    def __init__(self) -> None:
        self.made: list[bytes] = []

    def __call__(self) -> bytes:
        picture = np.full((24, 32, 3), len(self.made) % 250, np.uint8)
        self.made.append(cv2.imencode(".jpg", picture)[1].tobytes() + bytes(len(self.made) % 3))
        return self.made[-1]


@contextmanager
def served(rate: float = 100.0) -> Iterator[tuple[MockMjpegCamera, Source]]:
    source = Source()
    with MockMjpegCamera(source, CLOCK, rate=rate) as server:
        yield server, source


@contextmanager
def raw_server(answer: bytes, *, close: bool = False, delay: float = 0.0) -> Iterator[str]:
    """A server that sends these bytes to every client after a delay [s], and then nothing."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        links: list[socket.socket] = []

        def serve() -> None:
            try:
                while True:
                    link, _ = listener.accept()
                    links.append(link)
                    link.recv(4096)
                    time.sleep(delay)
                    link.sendall(answer)
                    if close:
                        link.close()
            except OSError:
                return

        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        yield f"http://127.0.0.1:{listener.getsockname()[1]}/?action=stream"
        listener.shutdown(socket.SHUT_RDWR)
        for link in links:
            link.close()
        thread.join(2)


def test_images_arrive_unchanged_in_order_and_with_stamps() -> None:
    seen: list[CameraImage] = []
    with served() as (server, source):
        before = CLOCK.now()
        with MjpegCamera(server.url, "left", CLOCK, on_image=seen.append) as camera:
            assert isinstance(camera, Camera)
            image = camera.next(-1, PATIENT)
            for _ in range(5):
                later = camera.next(image.sequence, PATIENT)
                assert later.sequence > image.sequence and later.stamp >= image.stamp
                image = later
        after = CLOCK.now()
    assert [image.sequence for image in seen] == list(range(len(seen)))
    assert all(before <= image.stamp <= after and image.encoding == "jpeg" for image in seen)
    order = [source.made.index(image.data) for image in seen]
    assert order == sorted(order)


def test_latest_returns_the_newest_image_and_slow_readers_skip_images() -> None:
    with served() as (server, _), MjpegCamera(server.url, "left", CLOCK, timeout=PATIENT) as camera:
        first = camera.latest()
        deadline = time.monotonic() + PATIENT
        while camera.latest().sequence < first.sequence + 10 and time.monotonic() < deadline:
            time.sleep(0.01)
        assert camera.next(first.sequence, PATIENT).sequence >= first.sequence + 10


def test_two_clients_and_a_snapshot_share_one_source() -> None:
    with served() as (server, source):
        with MjpegCamera(server.url, "a", CLOCK) as a, MjpegCamera(server.url, "b", CLOCK) as b:
            one, two = a.next(5, PATIENT), b.next(5, PATIENT)
            assert one.data in source.made and two.data in source.made
            with urllib.request.urlopen(server.url.replace("stream", "snapshot"), timeout=PATIENT) as answer:
                assert answer.headers["Content-Type"] == "image/jpeg" and answer.read() in source.made
        with pytest.raises(urllib.error.HTTPError, match="404"):
            urllib.request.urlopen(server.url.replace("stream", "dance"), timeout=PATIENT)


def test_no_image_is_created_without_a_client() -> None:
    with served() as (server, source):
        time.sleep(0.1)
        assert source.made == [] and server.clients == 0


def test_stall_is_reported_and_later_images_are_used() -> None:
    with served() as (server, _), MjpegCamera(server.url, "left", CLOCK, timeout=0.3) as camera:
        image = camera.next(3, PATIENT)
        server.stall()
        with pytest.raises(PeerTimeout, match=r"left.*action=stream") as caught:
            while True:
                image = camera.next(image.sequence, 0.2)
        assert "\n" not in str(caught.value)
        time.sleep(0.3)
        with pytest.raises(PeerTimeout):
            camera.latest()
        server.resume()
        assert camera.next(image.sequence, PATIENT).sequence > image.sequence


def test_closed_stream_requires_a_reconnect() -> None:
    with served() as (server, _), MjpegCamera(server.url, "left", CLOCK, timeout=PATIENT) as camera:
        image = camera.next(-1, PATIENT)
        server.drop_clients()
        with pytest.raises(PeerError, match=r"left.*closed the stream"):
            while True:
                image = camera.next(image.sequence, PATIENT)
        for _ in range(2):
            with pytest.raises(PeerError, match="closed the stream"):
                camera.latest()
        camera.reconnect()
        assert camera.latest().sequence > image.sequence  # sequence numbers are unique within a session


@pytest.mark.parametrize("how", ["truncated", "length"])
def test_damaged_images_are_skipped_and_counted(how: Corruption) -> None:
    seen: list[CameraImage] = []
    with served() as (server, source), MjpegCamera(server.url, "left", CLOCK, on_image=seen.append) as camera:
        image = camera.next(3, PATIENT)
        server.corrupt(3, how=how)
        while camera.damaged < 3:
            image = camera.next(image.sequence, PATIENT)
        camera.next(image.sequence, PATIENT)
        assert {image.data for image in seen} <= set(source.made)


def test_noise_within_an_image_is_passed_on_unchanged() -> None:
    seen: list[CameraImage] = []
    with served() as (server, source), MjpegCamera(server.url, "left", CLOCK, on_image=seen.append) as camera:
        server.corrupt(1, how="garbage")
        camera.next(20, PATIENT)
    assert len([image for image in seen if image.data not in source.made]) == 1


def test_failing_source_ends_the_streams_and_is_raised_by_close() -> None:
    def broken() -> bytes:
        raise ValueError("no gel")

    server = MockMjpegCamera(broken, CLOCK).start()
    with MjpegCamera(server.url, "left", CLOCK) as camera, pytest.raises(PeerError, match="closed the stream"):
        camera.next(-1, PATIENT)
    with pytest.raises(PeerError, match="no gel"):
        server.close()


def test_unreachable_address_is_reported() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
    with pytest.raises(PeerError, match=rf"cannot reach http://127.0.0.1:{port}/") as caught:
        MjpegCamera(f"http://127.0.0.1:{port}/", "left", CLOCK).open()
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("answer", "kind", "text"),
    [
        (b"", PeerTimeout, "no answer from"),
        (b"HTTP/1.0 200 O", PeerTimeout, "no answer from"),
        (b"HTTP/1.0 404 Not Found\r\n\r\n", PeerRefused, "404"),
        (b"220 ftp ready\r\n", PeerError, "expected an HTTP response"),
        (b"HTTP/1.0 200 OK\r\nContent-Type: text/html\r\n\r\n", PeerError, "text/html"),
    ],
)
def test_other_servers_are_reported(answer: bytes, kind: type[PeerError], text: str) -> None:
    with raw_server(answer) as url, pytest.raises(kind, match=text) as caught:
        MjpegCamera(url, "left", CLOCK, connect_timeout=0.3 if kind is PeerTimeout else PATIENT).open()
    assert url in str(caught.value) and "\n" not in str(caught.value)


def test_a_fast_clock_does_not_shorten_the_wait_for_the_server() -> None:
    head = b"HTTP/1.0 200 OK\r\nContent-Type: multipart/x-mixed-replace;boundary=x123\r\n\r\n"
    with raw_server(head, delay=0.2) as url:
        MjpegCamera(url, "left", ScaledClock(1000.0), connect_timeout=PATIENT).open().close()


def test_server_that_closes_before_it_answers_is_reported() -> None:
    with raw_server(b"", close=True) as url, pytest.raises(PeerError, match=r"before it answered|failed"):
        MjpegCamera(url, "left", CLOCK, connect_timeout=PATIENT).open()


def test_incomplete_image_is_a_timeout() -> None:
    head = b"HTTP/1.0 200 OK\r\nContent-Type: multipart/x-mixed-replace;boundary=x123\r\n\r\n"
    half = b"--x123\r\nContent-Length: 500\r\n\r\n\xff\xd8half"
    with raw_server(head + half) as url, MjpegCamera(url, "left", CLOCK, timeout=0.2) as camera:
        with pytest.raises(PeerTimeout, match="none so far"):
            camera.latest()
        with pytest.raises(PeerTimeout):
            camera.next(-1, 0.1)


def test_camera_must_be_open() -> None:
    with served() as (server, _):
        camera = MjpegCamera(server.url, "left", CLOCK)
        with pytest.raises(UsageError, match="open it first"):
            camera.latest()
        camera.open()
        camera.close()
        camera.close()
        with pytest.raises(PeerError, match="closed here"):
            camera.next(-1, PATIENT)
        camera.open()
        camera.next(-1, PATIENT)
        with pytest.raises(UsageError, match="already open"):
            camera.open()
        camera.close()


def test_errors_of_the_recorder_are_raised_to_the_caller() -> None:
    def full(image: CameraImage) -> None:
        raise PeerError("the disk is full")

    with served() as (server, _), MjpegCamera(server.url, "left", CLOCK, on_image=full) as camera:
        for _ in range(2):
            with pytest.raises(PeerError, match="the disk is full"):
                camera.next(-1, PATIENT)


def test_image_rate_is_in_robot_time() -> None:
    clock, source = ScaledClock(10.0), Source()
    begun = clock.now()
    server = MockMjpegCamera(source, clock, rate=20)
    with server, MjpegCamera(server.url, "left", clock, timeout=PATIENT) as camera:
        camera.next(40, 10 * PATIENT)
    assert 40 < len(source.made) <= (clock.now() - begun) * 20 + 3


@pytest.mark.parametrize(
    "url",
    [
        "ftp://host/",
        "http://",
        "http://host:port/",
        "http://user:word@host/",
        "http://ho st/",
        "http://höst/",
        "http://a..b/",
    ],
)
def test_invalid_addresses_are_refused(url: str) -> None:
    with pytest.raises(UsageError, match="camera left"):
        MjpegCamera(url, "left", CLOCK)


def test_invalid_sources_and_settings_are_refused() -> None:
    with pytest.raises(UsageError, match="uvc:INDEX"):
        open_camera("left.jpg", "left", CLOCK)
    for number in ("²", "99999999999999999999"):
        with pytest.raises(UsageError, match="is not that of a camera"):
            open_camera(f"uvc:{number}", "left", CLOCK)
    with pytest.raises(UsageError, match="timeout"):
        MjpegCamera("http://host/", "left", CLOCK, timeout=0)
    with pytest.raises(UsageError, match="rate"):
        MockMjpegCamera(Source(), CLOCK, rate=0)
    with served() as (server, _):
        with pytest.raises(UsageError, match="use another port"):
            MockMjpegCamera(Source(), CLOCK, port=server.port).start()
        with pytest.raises(UsageError, match="how must be"):
            server.corrupt(how="painted")  # type: ignore[arg-type]


def test_missing_device_is_reported(capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(PeerError, match="video device 97"):
        open_camera("uvc:97", "left", CLOCK)
    assert capfd.readouterr().err == ""


def test_pixels_of_a_device_are_stored_without_loss(tmp_path: Path) -> None:
    path = tmp_path / "gel.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 30, (64, 48))
    assert writer.isOpened()
    rng = np.random.default_rng(1)
    for _ in range(4):
        writer.write(rng.integers(0, 255, (48, 64, 3), dtype=np.uint8))
    writer.release()
    expected = []
    capture = cv2.VideoCapture(str(path))
    while (read := capture.read())[0]:
        expected.append(read[1])

    seen: list[CameraImage] = []
    device = UvcCamera(str(path), "left", CLOCK, timeout=PATIENT, on_image=seen.append)
    with device as camera, pytest.raises(PeerError, match="sent no image"):
        camera.next(99, PATIENT)
    assert len(seen) == 4
    for image, pixels in zip(seen, expected, strict=True):
        decoded = cv2.imdecode(np.frombuffer(image.data, np.uint8), cv2.IMREAD_UNCHANGED)
        assert image.encoding == "png" and decoded is not None and np.array_equal(decoded, pixels)


def test_jpeg_bytes_of_a_device_are_passed_on() -> None:
    camera = UvcCamera(0, "left", CLOCK)
    jpeg = cv2.imencode(".jpg", np.zeros((8, 8, 3), np.uint8))[1].tobytes()
    buffer = np.frombuffer(jpeg + bytes(100), np.uint8).reshape(1, -1)
    assert camera._encode(buffer) == (jpeg, "jpeg")
    assert camera._encode(np.zeros((1, 50), np.uint8)) is None  # damaged: skipped and counted


def test_mock_camera_stamps_each_image_with_its_own_clock() -> None:
    # Slow enough that an image which is late on a busy computer is not close to the next one.
    with served(rate=10.0) as (server, _), socket.create_connection(("127.0.0.1", server.port), 5.0) as link:
        link.sendall(b"GET /?action=stream HTTP/1.0\r\n\r\n")
        data = b""
        while data.count(b"X-Timestamp: ") < 6:
            data += link.recv(65536)
    heads = [head.split(b"\r\n\r\n")[0] for head in data.split(b"--boundarydonotcross\r\n")[1:6]]
    stamps = [float(head.split(b"X-Timestamp: ")[1]) for head in heads]
    assert all(head.startswith(b"Content-Type: image/jpeg\r\nContent-Length: ") for head in heads)
    assert all(b - a > 0.01 for a, b in pairwise(stamps))
    assert stamps[-1] - stamps[0] < 1.0 and stamps[0] > CLOCK_OFFSET


def test_mock_camera_stamps_the_exposure_of_an_image_and_not_its_end() -> None:
    exposed: list[float] = []

    def slow() -> bytes:
        exposed.append(CLOCK.now())
        time.sleep(0.01)
        return b"%d" % len(exposed)

    server = MockMjpegCamera(slow, CLOCK, rate=50.0)
    with server, socket.create_connection(("127.0.0.1", server.port), 5.0) as link:
        link.sendall(b"GET /?action=stream HTTP/1.0\r\n\r\n")
        data = b""
        while data.count(b"X-Timestamp: ") < 6:
            data += link.recv(65536)
    for part in data.split(b"--boundarydonotcross\r\n")[1:6]:
        head, image = part.split(b"\r\n\r\n", 1)
        stamp = float(head.split(b"X-Timestamp: ")[1]) - CLOCK_OFFSET
        assert stamp <= exposed[int(image) - 1] + 1e-5
