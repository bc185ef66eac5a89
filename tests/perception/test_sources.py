"""Image sources with damaged content: folders, videos, sessions, and a stream whose image size changes."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import cv2
import numpy as np
import pytest

from gelflow.errors import PeerError, PeerTimeout
from gelflow.perception.sources import ImageSource, image_source


def picture(number: int, size: tuple[int, int] = (96, 64)) -> np.ndarray:
    noise = np.random.default_rng(number).integers(0, 255, (size[1], size[0], 3), dtype=np.uint8)
    return np.asarray(cv2.GaussianBlur(noise, (0, 0), 3), dtype=np.uint8)


def jpeg(number: int, size: tuple[int, int] = (96, 64)) -> bytes:
    return bytes(cv2.imencode(".jpg", picture(number, size))[1])


def names(source: ImageSource) -> list[str]:
    return [image.name for image in source]


def test_unreadable_images_of_a_folder_are_skipped_and_counted(tmp_path: Path) -> None:
    for number in range(6):
        (tmp_path / f"{number}.jpg").write_bytes(jpeg(number))
    (tmp_path / "1.jpg").write_bytes(jpeg(1)[:700])
    (tmp_path / "4.jpg").write_bytes(b"")
    source = image_source(str(tmp_path))
    images = list(source)
    assert [image.name for image in images] == ["0.jpg", "2.jpg", "3.jpg", "5.jpg"]
    assert [image.stamp for image in images] == [0 / 25, 2 / 25, 3 / 25, 5 / 25]
    assert source.unreadable.count == 2
    assert source.unreadable.first.startswith(f"{tmp_path / '1.jpg'}: ") and "truncated" in source.unreadable.first


def test_a_folder_without_a_readable_image_is_an_error(tmp_path: Path) -> None:
    for number in range(3):
        (tmp_path / f"{number}.png").write_text("not an image")
    with pytest.raises(PeerError, match=r"none of the 3 images of .* can be read; .*0\.png: expected a JPEG or PNG"):
        names(image_source(str(tmp_path)))


@pytest.mark.parametrize(("suffix", "codec"), [("avi", "MJPG"), ("mkv", "MJPG"), ("avi", "mp4v")])
def test_a_truncated_video_is_an_error_after_its_images(suffix: str, codec: str, tmp_path: Path) -> None:
    whole, cut = tmp_path / f"whole.{suffix}", tmp_path / f"cut.{suffix}"
    video = cv2.VideoWriter(str(whole), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*codec), 30, (96, 64))
    for number in range(60):
        video.write(picture(number))
    video.release()
    assert len(names(image_source(str(whole)))) == 60
    data = whole.read_bytes()
    cut.write_bytes(data[: int(0.45 * len(data))])
    seen = []
    with pytest.raises(PeerError, match=r"ends after 2\d of \d+ images: it is truncated or damaged"):
        for image in image_source(str(cut)):
            seen.append(image.name)
    assert 20 <= len(seen) < 30


@contextmanager
def stream(images: list[bytes]) -> Iterator[str]:
    """An MJPEG stream over HTTP, which ends after `images`."""

    class Handler(BaseHTTPRequestHandler):
        def log_message(self, *_: object) -> None:
            pass

        def do_GET(self) -> None:
            self.send_response(200)
            self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame")
            self.end_headers()
            for data in images:
                head = f"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {len(data)}\r\n\r\n"
                self.wfile.write(head.encode() + data + b"\r\n")

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{server.server_port}/stream"
    finally:
        server.shutdown()
        server.server_close()


def test_images_of_a_stream_keep_the_bytes_of_the_camera() -> None:
    sent = [jpeg(number) for number in range(40)]
    seen = []
    with stream(sent) as url, pytest.raises(PeerTimeout, match="ended after 40 images"):
        for image in image_source(url):
            seen.append(image)
    assert [image.data for image in seen] == sent
    assert all(image.image.shape == (64, 96, 3) for image in seen)


def test_a_stream_whose_image_size_changes_is_an_error() -> None:
    sent = [jpeg(number) for number in range(40)] + [jpeg(number, (128, 96)) for number in range(20)]
    seen = []
    with stream(sent) as url, pytest.raises(PeerError, match="image 000040 has 128 × 96 px, those before have 96 × 64"):
        for image in image_source(url):
            seen.append(image.name)
    assert len(seen) == 40


def test_a_damaged_image_of_a_stream_is_skipped_and_counted() -> None:
    sent = [jpeg(number) for number in range(40)]
    sent[25] = sent[25][:300] + bytes(200) + b"\xff\xd9"
    with stream(sent) as url:
        source = image_source(url)
        seen = []
        with pytest.raises(PeerTimeout):
            for image in source:
                seen.append(image.name)
    assert len(seen) + source.unreadable.count == 40
