"""Image sources with damaged content: folders, videos, sessions, and a stream whose image size changes."""

import os
import re
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import cv2
import numpy as np
import pytest

from gelflow.errors import PeerError, PeerTimeout, UsageError
from gelflow.perception.errors import TrackerInitError
from gelflow.perception.sensors.profile import load_sensor_profile
from gelflow.perception.sources import ImageSource, SourceImage, image_source, start_on_image


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
    assert source.skipped.unreadable == 2
    assert source.skipped.first.startswith(f"{tmp_path / '1.jpg'}: ") and "truncated" in source.skipped.first


def test_a_folder_whose_image_size_changes_is_an_error(tmp_path: Path) -> None:
    for number, size in enumerate([(96, 64), (96, 64), (128, 96)]):
        (tmp_path / f"{number}.jpg").write_bytes(jpeg(number, size))
    with pytest.raises(PeerError, match=r"image 2\.jpg has 128 × 96 px, those before have 96 × 64"):
        names(image_source(str(tmp_path)))


def test_images_of_12_bits_are_reduced_alike(tmp_path: Path) -> None:
    for number, share in enumerate((1.0, 0.2)):  # the second image alone would count as one of 10 bits
        cv2.imwrite(str(tmp_path / f"{number}.png"), np.full((48, 64), round(share * 4095), dtype=np.uint16))
    assert [int(image.image.max()) for image in image_source(str(tmp_path))] == [255, 51]


def test_a_folder_with_the_number_of_a_camera_is_ambiguous(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "7").mkdir()
    (tmp_path / "7" / "0.jpg").write_bytes(jpeg(0))
    with pytest.raises(UsageError, match=r"write \./7 for this, 07 for the camera"):
        image_source("7")
    assert image_source("./7").kind == "folder"
    assert image_source("07").kind == image_source("6").kind == "camera"


@pytest.mark.parametrize(("text", "number"), [("uvc:0", "0"), ("uvc:12", "12"), ("uvc:/dev/video2", "2")])
def test_cameras_have_the_names_of_a_lab_file_too(text: str, number: str) -> None:
    source = image_source(text)
    assert (source.kind, source.text) == ("camera", number)


@pytest.mark.parametrize("text", ["uvc:", "uvc:left", "uvc:/dev/v4l/by-id/left", "uvc://0"])
def test_other_names_of_uvc_cameras_are_errors(text: str) -> None:
    with pytest.raises(UsageError, match=f"expected a folder, a file, a URL or a camera number; {text} does not exist"):
        image_source(text)


def test_a_tiff_file_with_several_pages_is_an_error(tmp_path: Path) -> None:
    cv2.imwritemulti(str(tmp_path / "1.tiff"), [picture(number) for number in range(3)])
    cv2.imwrite(str(tmp_path / "0.tif"), picture(0))
    for source, read in ((tmp_path / "1.tiff", 0), (tmp_path, 1)):
        images = iter(image_source(str(source)))
        assert [next(images).name for _ in range(read)] == ["0.tif"][:read]
        with pytest.raises(UsageError, match=r"1\.tiff has 3 pages; split it into a folder of images"):
            next(images)


def test_a_tiff_file_whose_name_is_not_utf_8_is_an_error(tmp_path: Path) -> None:
    # OpenCV would end the process.
    file = tmp_path / os.fsdecode(b"k\xe4.tif")
    file.write_bytes(bytes(cv2.imencode(".tif", picture(0))[1]))
    with pytest.raises(UsageError, match="is not valid UTF-8: rename the file"):
        names(image_source(str(file)))


def start(image: np.ndarray) -> int:
    """A start that fails on dark images."""
    if image.max() < 50:
        raise TrackerInitError(f"brightness {image.max()}", image)
    return int(image.max())


def images_of(levels: list[int], interval: float) -> Iterator[SourceImage]:
    """Images of these brightnesses, and then the end of the stream."""
    for number, level in enumerate(levels):
        yield SourceImage(f"{number:06d}", np.full((4, 4, 3), level, dtype=np.uint8), number * interval)
    raise PeerTimeout("the stream ended")


def test_a_tracker_starts_on_a_later_image_of_a_live_source() -> None:
    source, images = ImageSource("0", "camera"), images_of([0, 5, 200, 0], 0.1)
    first, result = start_on_image(source, images, start)
    assert first.name == "000002" and result == 200
    assert source.skipped.unreadable == 2 and source.skipped.first == "image 000000: brightness 0"
    assert next(images).name == "000003"


@pytest.mark.parametrize(
    ("kind", "levels", "skipped", "reason"),
    [
        ("camera", [0, 1, 2, 3, 200], 3, "brightness 3"),  # 2.1 s after the first
        ("camera", [0, 1], 2, "brightness 1"),
        ("folder", [0, 200], 0, "brightness 0"),
    ],
)
def test_the_last_reason_against_a_start_is_reported(kind: str, levels: list[int], skipped: int, reason: str) -> None:
    source = ImageSource("0", kind)
    with pytest.raises(TrackerInitError, match=reason):
        start_on_image(source, images_of(levels, 0.7), start)
    assert source.skipped.unreadable == skipped


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


class Stream:
    """An MJPEG stream over HTTP, which sends `images` at the pace of the reader and then ends."""

    def __init__(self, images: list[bytes], *, paced: bool = True) -> None:
        self.images, self.paced = images, paced
        self.free = threading.Semaphore(6)  # images that may be sent
        self.sent = threading.Event()  # all of them

    def read(self, source: ImageSource) -> Iterator[SourceImage]:
        for image in source:
            yield image
            self.free.release()

    @contextmanager
    def serve(self) -> Iterator[str]:
        stream = self

        class Handler(BaseHTTPRequestHandler):
            def log_message(self, *_: object) -> None:
                pass

            def do_GET(self) -> None:
                self.send_response(200)
                self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame")
                self.end_headers()
                for data in stream.images:
                    if stream.paced:
                        stream.free.acquire(timeout=5)
                    head = f"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {len(data)}\r\n\r\n"
                    self.wfile.write(head.encode() + data + b"\r\n")
                stream.sent.set()

        server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        threading.Thread(target=server.serve_forever, daemon=True).start()
        try:
            yield f"http://127.0.0.1:{server.server_port}/stream"
        finally:
            server.shutdown()
            server.server_close()


def read_stream(stream: Stream, *, profile: str = "generic") -> tuple[ImageSource, list[SourceImage], PeerError]:
    """The source, the images before the error that ends it, and the error."""
    seen = []
    with stream.serve() as url:
        source = image_source(url, profile=load_sensor_profile(profile))
        with pytest.raises(PeerError) as ended:
            for image in stream.read(source):
                seen.append(image)
    return source, seen, ended.value


def test_images_of_a_stream_keep_the_bytes_of_the_camera() -> None:
    sent = [jpeg(number) for number in range(40)]
    source, seen, error = read_stream(Stream(sent))
    assert "ended after 40 images" in str(error) and isinstance(error, PeerTimeout)
    assert [image.data for image in seen] == sent and source.skipped.dropped == 0
    assert all(image.image.shape == (64, 96, 3) for image in seen)


def test_a_stream_whose_image_size_changes_is_an_error() -> None:
    sent = [jpeg(number) for number in range(40)] + [jpeg(number, (128, 96)) for number in range(20)]
    _, seen, error = read_stream(Stream(sent))
    assert "image 000040 has 128 × 96 px, those before have 96 × 64" in str(error) and len(seen) == 40


def test_a_slow_reader_drops_the_oldest_images_and_counts_them() -> None:
    stream = Stream([jpeg(number) for number in range(60)], paced=False)
    names: list[int] = []
    with stream.serve() as url:
        source = image_source(url)
        with pytest.raises(PeerTimeout):
            for image in source:
                names.append(stream.images.index(image.data or b""))
                stream.sent.wait(10)
    assert source.skipped.dropped > 30 and len(names) + source.skipped.dropped == 60
    assert names == sorted(names) and names[-1] == 59


def test_images_of_a_profile_are_reduced_and_cropped(tmp_path: Path) -> None:
    (tmp_path / "s.toml").write_text(
        'format = 1\ntitle = "s"\n[image]\nwidth = 384\nheight = 256\nreduce = 4\ncrop = [0.125, 0, 0.25, 0.5]\n'
    )
    stream = Stream([jpeg(number, (384, 256)) for number in range(10)])
    _, seen, _ = read_stream(stream, profile=str(tmp_path / "s.toml"))
    assert len(seen) == 10 and all(image.data is None for image in seen)
    whole = cv2.imdecode(np.frombuffer(stream.images[3], dtype=np.uint8), cv2.IMREAD_REDUCED_COLOR_4)
    assert whole is not None
    np.testing.assert_array_equal(seen[3].image, whole[0:32, 12:72])


def test_a_relative_name_of_a_video_may_contain_a_colon(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    size = (64, 48)
    video = cv2.VideoWriter(str(tmp_path / "12:30.mkv"), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*"MJPG"), 25.0, size)
    for number in range(3):
        video.write(picture(number, size))
    video.release()
    assert names(image_source("12:30.mkv")) == ["000000", "000001", "000002"]


def test_images_of_a_video_with_an_uneven_rate_have_their_own_times(tmp_path: Path) -> None:
    path = tmp_path / "uneven.mkv"
    video = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*"MJPG"), 25.0, (64, 48))
    for number in range(10):
        video.write(np.full((48, 64, 3), 20 * number, dtype=np.uint8))
    video.release()
    even = [image.stamp for image in image_source(str(path))]
    np.testing.assert_allclose(even, np.arange(10) / 25)
    # A block is the number of its track, its time [ms] in two bytes, flags, and the JPEG image.
    head, *blocks = re.split(rb"(?=\x81...\xff\xd8)", path.read_bytes(), flags=re.DOTALL)
    assert len(blocks) == 10
    for times in (
        [0, 40, 80, 120, 160, 300, 340, 380, 420, 460],
        [0, 40, 80, 300, 300, 340, 380, 380, 420, 460],  # two bursts, each within one millisecond
    ):
        timed = [block[:1] + time.to_bytes(2, "big") + block[3:] for time, block in zip(times, blocks, strict=True)]
        path.write_bytes(head + b"".join(timed))
        uneven = [image.stamp for image in image_source(str(path))]
        np.testing.assert_allclose(uneven, np.array(times) / 1e3, atol=2e-3)
        assert (np.diff(uneven) > 0).all()


@pytest.mark.parametrize("kept", [0, 300])  # without its first bytes it cannot be recognized as a JPEG image
def test_a_damaged_image_of_a_stream_is_skipped_and_counted(kept: int) -> None:
    sent = [jpeg(number) for number in range(40)]
    sent[25] = sent[25][:kept] + bytes(200) + b"\xff\xd9"
    source, seen, _ = read_stream(Stream(sent))
    assert len(seen) + source.skipped.unreadable == 40
