"""Sign of life of a camera: distinguishes new images from repeated and from late ones."""

import hashlib
from collections import deque

HISTORY = 3000  # images that a new one is compared with: 100 s at 30 images per second
# Largest relative error of the camera's clock against this computer's: two crystals, and the rate at which NTP slews.
_MAX_DRIFT = 500e-6
_PADDING = b"\0\r\n"
_START_OF_SCAN = 0xDA


class RepeatFilter:
    """Compares each image with the last `HISTORY` different ones.

    The noise of an image sensor makes two identical images practically impossible, so an equal image was not taken
    anew: the camera or its server repeats one image, or a loop of images.
    """

    def __init__(self) -> None:
        self._order: deque[bytes] = deque()
        self._known: set[bytes] = set()

    def is_repeat(self, data: bytes) -> bool:
        """Whether the picture in `data` (JPEG or PNG) equals a recent one; a new picture is remembered."""
        digest = picture_digest(data)
        if digest in self._known:
            return True
        self._order.append(digest)
        self._known.add(digest)
        if len(self._order) > HISTORY:
            self._known.remove(self._order.popleft())
        return False


class CameraClock:
    """Relates a camera's own clock to robot time, by the shortest transmission seen.

    The offset between both clocks is unknown and drifts by at most 0.05 %. The smallest difference between reception
    and camera time therefore belongs to the fastest transmission, and a larger one is the additional delay of an image.
    A constant delay, such as the exposure and the readout, cannot be seen from the times alone.
    """

    def __init__(self) -> None:
        self._last: tuple[float, float] | None = None  # reception and camera time of the last image [s]
        self._offset = 0.0  # reception − camera time of the fastest transmission [s]

    def delay(self, received: float, camera_time: float) -> float | None:
        """Delay of an image in addition to the shortest one seen [s]; None when the camera's clock did not advance.

        `received` is robot time [s]. After a clock was set, the measurement starts again.
        """
        offset = received - camera_time
        last, self._last = self._last, (received, camera_time)
        if last is None:
            self._offset = offset
            return 0.0
        if camera_time <= last[1]:
            if camera_time < last[1]:
                self._offset = offset
            return None
        self._offset = min(offset, self._offset + _MAX_DRIFT * (received - last[0]))
        return offset - self._offset


def picture_digest(data: bytes) -> bytes:
    """Digest of an image without the parts that do not affect its pixels.

    These are the padding after the image and, in a JPEG, the comments and application segments, which may contain the
    time of the server.
    """
    digest = hashlib.blake2b(digest_size=16)
    view = memoryview(data.rstrip(_PADDING))
    position = 2 if data.startswith(b"\xff\xd8") else len(view)
    kept = 0  # everything before is in the digest, or is skipped
    while position + 4 <= len(view) and view[position] == 0xFF and view[position + 1] != _START_OF_SCAN:
        marker, end = view[position + 1], position + 2 + int.from_bytes(view[position + 2 : position + 4])
        if marker == 0xFE or 0xE0 <= marker <= 0xEF:  # COM, APP0 to APP15
            digest.update(view[kept:position])
            kept = end
        position = end
    digest.update(view[kept:])
    return digest.digest()
