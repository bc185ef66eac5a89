"""Records in the standard schemas that Foxglove and Rerun display; replays read the JSON records beside them."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from numpy.typing import NDArray

from gelflow.session.records import to_plain

ERRORS = ("stopped", "arm stopped", "part lost")
WARNINGS = (
    *("pad not readable", "pads not observed", "reference repeated"),
    *("weight not shown", "camera latency", "forces ended"),
)


def flow_image(flow: NDArray[np.float32], nanoseconds: int) -> RawImage:
    """A flow map (channels, rows, cols) as one image of 32-bit floats, channels side by side."""
    channels, rows, cols = flow.shape
    picture = np.ascontiguousarray(flow.transpose(1, 0, 2).reshape(rows, channels * cols), dtype="<f4")
    message = RawImage(
        width=channels * cols, height=rows, encoding="32FC1", step=4 * channels * cols, data=picture.tobytes()
    )
    message.timestamp.FromNanoseconds(nanoseconds)
    return message


def event_log(name: str, values: Mapping[str, Any], nanoseconds: int) -> Log:
    """An event in words, as a line of a log."""
    level = Log.ERROR if name in ERRORS else Log.WARNING if name in WARNINGS else Log.INFO
    # Paths may have bytes that are not UTF-8, which a message cannot contain.
    text = event_text(name, values).encode("utf-8", "backslashreplace").decode()
    message = Log(level=level, name=name, message=text)
    message.timestamp.FromNanoseconds(nanoseconds)
    return message


def event_text(name: str, values: Mapping[str, Any]) -> str:
    """An event in words: its name and its values."""
    words = ", ".join(f"{key} {_text(value)}" for key, value in to_plain(values).items() if value is not None)
    return f"{name}: {words}" if words else name


def _text(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, list):
        return " ".join(_text(part) for part in value)
    if isinstance(value, dict):
        return "; ".join(f"{key} {_text(part)}" for key, part in value.items())
    return str(value)
