"""Soak test: rules on known runs, facts of recorded sessions, and a ledger that survives a crash."""

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gelflow.clock import ScaledClock
from gelflow.errors import UsageError
from gelflow.geometry import Pose, yaw_quaternion
from gelflow.hardware_mocks.simulated_cell.random_world import changed_groups, random_world
from gelflow.hardware_mocks.simulated_cell.world import World, plain_world, world_from_tables
from gelflow.mock_lab.soak.ledger import Ledger
from gelflow.mock_lab.soak.rules import RULES, RunFacts, violations
from gelflow.mock_lab.soak.session_facts import SessionFacts, longest_wait, read_session
from gelflow.real.runner import lab as labs
from gelflow.session.recorder import SessionRecorder
from gelflow.toml_tables import read_toml, toml_text

GOOD = RunFacts(
    outcome="inserted",
    exit_code=0,
    errors="",
    idle=3.0,
    allowed_idle=61.0,
    truth={"inserted": True, "largest_push": 0.4e-3},
    session=SessionFacts("yes", stop_recorded=True, moved=True),
)


def lab() -> labs.Lab:
    camera = labs.CameraSettings(source="http://127.0.0.1:1/", rows=18, cols=14, pitch_mm=1.4, pixels_per_mm=15.7)
    return labs.Lab(
        gripper=labs.GripperSettings("tcp:127.0.0.1:1", grasp_force=12.0, part_width=0.035, open_width=0.06),
        arm=labs.ArmSettings(),
        cameras=labs.CamerasSettings(camera, dataclasses.replace(camera, source="http://127.0.0.1:2/")),
        tool=labs.ToolSettings((0.0, 0.0, 0.18), (0.0, 1.0, 0.0, 0.0)),
        hole=labs.HoleSettings((0.374, 0.05, 0.05), 0.0),
        part=labs.PartSettings(grasp_height=0.03),
    )


class Recording:
    """A session whose references and events are given at chosen times."""

    def __init__(self, path: Path) -> None:
        self.path, self._lab = path, lab()
        self.recorder = SessionRecorder(path, ScaledClock()).open()
        self.start = ScaledClock().now()

    def reference(self, time: float, height: float, x: float = 0.0) -> None:
        """A reference `time` s after the start, the lower face at `height` [m] above the hole."""
        above = Pose(np.array([x, 0.0, height + self._lab.part.grasp_height]), yaw_quaternion(0.0))
        tool = self._lab.tool_pose(self._lab.hole.pose @ above)
        self.recorder.arm_command(self.start + time, tool.position, tool.quaternion, kind="applied")

    def event(self, name: str, **values: Any) -> None:
        self.recorder.event(name, values)

    def facts(self) -> SessionFacts:
        self.recorder.close()
        return read_session(self.path, self._lab)


def test_a_run_without_a_mistake_violates_no_rule() -> None:
    assert violations(GOOD) == []
    stopped = dataclasses.replace(GOOD, outcome="error", exit_code=2, truth={})
    assert violations(stopped) == []


@pytest.mark.parametrize(
    ("rule", "change"),
    [
        ("called inserted, but is not", {"truth": {"inserted": False}}),
        ("called inserted, but is not", {"truth": {}}),
        ("pushed in the grip without a stop", {"truth": {"inserted": True, "largest_push": 1.01e-3}}),
        ("motion after a latch", {"session": SessionFacts("yes", moved_after_latch=1e-4, stop_recorded=True)}),
        ("target outside was not refused", {"session": SessionFacts("yes", outside=3e-3, stop_recorded=True)}),
        ("hang", {"exit_code": None}),
        ("hang", {"idle": 61.1}),
        ("unexpected exception", {"errors": "Traceback (most recent call last):", "exit_code": 1}),
        ("unexpected exception", {"exit_code": -11}),
        ("no stop was sent", {"session": SessionFacts("recovered", moved=True)}),
        ("recording not readable", {"session": SessionFacts("no")}),
    ],
)
def test_each_rule_is_violated_by_its_mistake_alone(rule: str, change: dict[str, Any]) -> None:
    assert violations(dataclasses.replace(GOOD, **change)) == [rule]
    assert rule in RULES


def test_motion_after_a_latch_is_read_from_the_session(tmp_path: Path) -> None:
    for number, (last, moved) in enumerate([(0.025, 0.0), (0.0249, 1e-4)]):
        recording = Recording(tmp_path / f"{number}.mcap")
        recording.event("state", state="lower")
        recording.reference(-0.1, 0.0255)
        recording.event("stopped", reason="motors are off")
        recording.event("state", state="latched")
        recording.reference(0.05, 0.0254)  # the hold returns the reference to the arm
        for time in (0.5, 0.6, 0.7):
            recording.reference(time, 0.025)
        recording.reference(0.8, last)
        facts = recording.facts()
        assert facts.readable == "yes" and facts.states == ("lower", "latched") and facts.stop_recorded
        assert facts.reason == "motors are off" and facts.moved
        assert facts.moved_after_latch == pytest.approx(moved, abs=1e-9)


def test_references_outside_the_workspace_are_found(tmp_path: Path) -> None:
    recording = Recording(tmp_path / "session.mcap")
    for _ in range(5):
        recording.reference(0.0, 0.03)
    for _ in range(5):
        recording.reference(0.1, 0.03, x=lab().workspace.x + 4e-3)
    facts = recording.facts()
    assert facts.outside == pytest.approx(4e-3, abs=1e-9)
    assert facts.latched_at is None and not facts.stop_recorded


def test_an_unfinished_session_is_read_from_its_recovered_copy(tmp_path: Path) -> None:
    recording = Recording(tmp_path / "session.mcap")
    recording.event("state", state="descend")
    recording.recorder.attempt_end({"insertion": 0, "attempt": 0})  # stores all records
    cut = tmp_path / "cut.mcap"
    cut.write_bytes((tmp_path / "session.mcap").read_bytes())
    assert read_session(cut, lab()).readable == "recovered"
    assert read_session(cut, lab()).states == ("descend",)
    recording.recorder.close()
    (tmp_path / "noise.mcap").write_bytes(b"noise" * 100)
    assert read_session(tmp_path / "noise.mcap", lab()).readable == "no"
    assert read_session(tmp_path / "missing.mcap", lab()).readable == "no session"


def test_longest_wait_is_the_longest_time_out_of_the_lab() -> None:
    assert longest_wait(lab()) == lab().limits.attempt_time


def row(**changes: Any) -> dict[str, Any]:
    return {"outcome": "inserted", "kinds": ["drop"], "violations": [], **changes}


def test_ledger_adds_up_over_several_runs(tmp_path: Path) -> None:
    path = tmp_path / "soak" / "soak.jsonl"
    Ledger(path).add(3, row())
    Ledger(path).add(4, row(outcome="error", kinds=["drop", "slip"], violations=["hang"]))
    again = Ledger(path)
    again.add(4, row(outcome="error", kinds=["slip"], violations=["hang"]))  # the same seed again
    assert set(again.rows) == {3, 4} and again.failing() == [4]
    assert Ledger(path).counts() == {
        "outcomes": {"inserted": 1, "error": 1},
        "kinds": {"drop": 1, "slip": 1},
        "violations": {"hang": 1},
    }


def test_a_row_that_was_cut_by_a_crash_is_dropped_and_the_file_continues(tmp_path: Path) -> None:
    path = tmp_path / "soak.jsonl"
    Ledger(path).add(1, row())
    with path.open("ab") as file:
        file.write(b'{"format":1,"seed":2,"outc')
    ledger = Ledger(path)
    assert set(ledger.rows) == {1}
    ledger.add(5, row())
    assert [json.loads(line)["seed"] for line in path.read_text().splitlines()] == [1, 5]


@pytest.mark.parametrize("line", ["noise\n", '{"seed": 1}\n', '{"format": 9, "seed": 1}\n', "[1]\n"])
def test_a_foreign_ledger_is_refused(tmp_path: Path, line: str) -> None:
    path = tmp_path / "soak.jsonl"
    path.write_text(line)
    with pytest.raises(UsageError, match="line 1, is not a row of a soak test"):
        Ledger(path)


def test_random_worlds_are_reproducible_and_change_every_group() -> None:
    worlds = [random_world(seed) for seed in range(200)]
    assert worlds == [random_world(seed) for seed in range(200)]
    assert 0.2 < sum(world == World() for world in worlds) / len(worlds) < 0.4
    changed = {name for world in worlds for name in changed_groups(world)}
    assert changed == {field.name for field in dataclasses.fields(World)}
    assert max(abs(world.taught_error.z) for world in worlds) > 2.5e-3


@pytest.mark.parametrize("tables", [lambda: plain_world(random_world(5)), lambda: {"a": 1, "b": {"c": [1.5, True]}}])
def test_tables_are_equal_after_writing_and_reading(tmp_path: Path, tables: Callable[[], dict[str, Any]]) -> None:
    path = tmp_path / "tables.toml"
    path.write_text(toml_text(tables()))
    assert read_toml(path) == tables()
    nested = {"list": [{"x": 1, "inner": {"y": "z"}}, {"x": 2}]}
    path.write_text(toml_text(nested))
    assert read_toml(path) == nested


def test_a_written_world_is_read_back_equal(tmp_path: Path) -> None:
    for seed in range(60):
        path = tmp_path / "world.toml"
        path.write_text(toml_text(plain_world(random_world(seed))))
        assert world_from_tables(read_toml(path), str(path)) == random_world(seed)
