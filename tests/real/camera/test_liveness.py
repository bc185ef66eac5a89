"""Sign of life of cameras: a frozen or looping stream ends in a time-out and never returns an old image as new."""

import itertools
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from gelflow.clock import ScaledClock
from gelflow.errors import PeerTimeout
from gelflow.hardware_mocks.camera.device import MockMjpegCamera
from gelflow.perception.synthetic.appearance import GelAppearance
from gelflow.perception.synthetic.fast_renderer import FastGelRenderer
from gelflow.protocols import CameraImage
from gelflow.real.camera.driver import MjpegCamera, UvcCamera
from gelflow.real.camera.liveness import HISTORY, RepeatFilter, picture_digest

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
        assert camera.next(last.sequence, PATIENT).sequence > last.sequence  # the camera runs again
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
