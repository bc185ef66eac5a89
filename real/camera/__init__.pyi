from .driver import MjpegCamera as MjpegCamera
from .driver import UvcCamera as UvcCamera
from .driver import open_camera as open_camera
from .latency import LatencyEstimate as LatencyEstimate
from .latency import combine_latencies as combine_latencies
from .latency import estimate_latency as estimate_latency
from .stream import StreamCamera as StreamCamera

__all__ = [
    "LatencyEstimate",
    "MjpegCamera",
    "StreamCamera",
    "UvcCamera",
    "combine_latencies",
    "estimate_latency",
    "open_camera",
]
