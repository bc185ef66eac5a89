"""Records in the standard schemas of viewers."""

from pathlib import Path

import numpy as np

from gelflow.clock import ScaledClock
from gelflow.session.reader import SessionReader
from gelflow.session.recorder import SessionRecorder

CLOCK = ScaledClock(1.0)


def test_the_name_of_a_file_need_not_be_utf_8(tmp_path: Path) -> None:
    with SessionRecorder(tmp_path / "a.mcap", CLOCK) as recorder:
        recorder.event("stopped", {"reason": "cannot write caf\udce9/w.mcap"})
    with SessionReader(tmp_path / "a.mcap") as session:
        assert [record.value.message for record in session.records(["/log"])] == [
            "stopped: reason cannot write caf\\udce9/w.mcap"
        ]


def test_events_are_lines_of_a_log(tmp_path: Path) -> None:
    with SessionRecorder(tmp_path / "a.mcap", CLOCK) as recorder:
        recorder.event("move", {"speed": 0.0251234567, "position": np.array([0.3, 0.1])})
        recorder.event("stopped", {"reason": "the part is lost"})
        recorder.event("tick")
    with SessionReader(tmp_path / "a.mcap") as session:
        lines = [record.value for record in session.records(["/log"])]
    assert [line.message for line in lines] == [
        "move: speed 0.0251235, position 0.3 0.1",
        "stopped: reason the part is lost",
        "tick",
    ]
    assert [line.Level.Name(line.level) for line in lines] == ["INFO", "ERROR", "INFO"]
