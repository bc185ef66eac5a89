"""Record a short session and read it back."""

import tempfile
from pathlib import Path

from gelflow.clock import ScaledClock
from gelflow.protocols import CameraImage
from gelflow.session import SessionReader, SessionRecorder

IMAGES = Path(__file__).resolve().parents[1] / "tests" / "data" / "tracking" / "press"
clock = ScaledClock()
with tempfile.TemporaryDirectory() as folder:
    path = Path(folder, "session.mcap")
    with SessionRecorder(path, clock) as recorder:
        recorder.event("start", {"operator": "example"})
        for number, file in enumerate(sorted(IMAGES.glob("*.jpg"))):
            recorder.image(0, CameraImage(file.read_bytes(), stamp=clock.now(), sequence=number))  # 0: left finger

    with SessionReader(path) as session:
        print(session.counts())
        for record in session.records(["/event", "/left/image"]):
            if isinstance(record.value, CameraImage):
                print(f"{record.topic}: image {record.value.sequence}, {len(record.value.data)} bytes")
            else:
                print(f"{record.topic}: {record.value}")
