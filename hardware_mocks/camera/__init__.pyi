from .device import MockMjpegCamera as MockMjpegCamera

__all__ = [
    "MockMjpegCamera",
]
