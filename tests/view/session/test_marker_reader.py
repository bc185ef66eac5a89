"""Images of a session as its page shows them."""

from pathlib import Path

import cv2
import numpy as np
from tests.common.manual_clock import ManualClock

from gelflow.protocols import CameraImage
from gelflow.session.reader import SessionReader
from gelflow.session.recorder import SessionRecorder
from gelflow.session.time_index import TimeIndex
from gelflow.view.session.marker_reader import MarkerReader


def test_images_of_16_bits_have_one_scale(tmp_path: Path) -> None:
    path, clock = tmp_path / "s.mcap", ManualClock(10.0)
    with SessionRecorder(path, clock) as recorder:
        for number, level in enumerate((3000, 900, 3000)):  # the second image alone would count as one of 10 bits
            clock.time = 10.0 + number
            data = bytes(cv2.imencode(".png", np.full((48, 64), level, np.uint16))[1])
            recorder.image(0, CameraImage(data, clock.time, number, "png"))
    with SessionReader(path) as session:
        reader = MarkerReader(TimeIndex(session), {}, lambda time: 10.0)
        pads = [reader.pad(0, time) for time in (11.5, 10.5, 12.5)]
    assert [int(pad.pixels.max()) for pad in pads if pad is not None] == [900 >> 4, 3000 >> 4, 3000 >> 4]
