from .driver import MjpegCamera as MjpegCamera
from .driver import UvcCamera as UvcCamera
from .driver import open_camera as open_camera
from .stream import StreamCamera as StreamCamera

__all__ = [
    "MjpegCamera",
    "StreamCamera",
    "UvcCamera",
    "open_camera",
]
