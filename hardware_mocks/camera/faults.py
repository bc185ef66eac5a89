"""Faults of the images and of the stream of a mock camera."""

from collections import deque
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gelflow.hardware_mocks.message_faults import MESSAGE_KINDS, MessageFault, MessageFaults

IMAGE_KINDS = ("freeze", "blacken", "rescale")
_BLACK = (2.0, 1.5)  # mean and standard deviation of the pixels of a covered camera [grey levels]


class CameraFaults:
    """The active faults of one camera. The caller holds a lock."""

    def __init__(self) -> None:
        self._streams: list[MessageFaults] = []  # one per client
        self._messages: dict[int, tuple[str, dict[str, Any]]] = {}
        self._images: dict[int, tuple[str, dict[str, Any]]] = {}
        self._recent: deque[bytes] = deque(maxlen=32)  # newest last
        self._loops: dict[int, list[bytes]] = {}
        self._random = np.random.default_rng(0)

    def begin(self, number: int, kind: str, values: dict[str, Any]) -> None:
        """Begin a fault; `values` are the parameters of its kind."""
        if kind in MESSAGE_KINDS:
            self._messages[number] = kind, values
            for stream in self._streams:
                stream.begin(number, MessageFault(kind, **values))
            return
        self._images[number] = kind, values
        if kind == "freeze":
            self._loops[number] = list(self._recent)[-int(values["loop"]) :]

    def end(self, number: int) -> None:
        """End a fault."""
        self._messages.pop(number, None)
        for stream in self._streams:
            stream.end(number)
        self._images.pop(number, None)
        self._loops.pop(number, None)

    def add_stream(self) -> MessageFaults:
        """The faults of the stream of a new client."""
        stream = MessageFaults(ordered=True)
        for number, (kind, values) in self._messages.items():
            stream.begin(number, MessageFault(kind, **values))
        self._streams.append(stream)
        return stream

    def remove_stream(self, stream: MessageFaults) -> None:
        """Forget the stream of a client that has disconnected."""
        self._streams.remove(stream)

    def image(self, jpeg: bytes) -> bytes:
        """The image that the camera sends instead of `jpeg`."""
        self._recent.append(jpeg)
        for number, (kind, values) in self._images.items():
            if kind == "freeze":
                jpeg = self._next_of_loop(number, jpeg)
            else:
                pixels = _decode(jpeg)
                changed = self._black(pixels) if kind == "blacken" else _zoomed(pixels, values["zoom"])
                jpeg = cv2.imencode(".jpg", changed, [cv2.IMWRITE_JPEG_QUALITY, 88])[1].tobytes()
        return jpeg

    def _next_of_loop(self, number: int, jpeg: bytes) -> bytes:
        loop = self._loops[number] or [jpeg]
        self._loops[number] = [*loop[1:], loop[0]]
        return loop[0]

    def _black(self, pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
        mean, deviation = _BLACK
        return np.asarray(self._random.normal(mean, deviation, pixels.shape).clip(0, 255), dtype=np.uint8)


def _decode(jpeg: bytes) -> NDArray[np.uint8]:
    return np.asarray(cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR), dtype=np.uint8)


def _zoomed(pixels: NDArray[np.uint8], zoom: float) -> NDArray[np.uint8]:
    """`pixels` magnified about the image centre."""
    height, width = pixels.shape[:2]
    middle = np.array([(width - 1) / 2, (height - 1) / 2])
    matrix = np.column_stack([np.eye(2) * zoom, middle * (1 - zoom)])
    border = cv2.BORDER_REFLECT
    return np.asarray(cv2.warpAffine(pixels, matrix, (width, height), borderMode=border), dtype=np.uint8)
