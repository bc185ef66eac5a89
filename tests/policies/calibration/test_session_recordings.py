"""Calibration from recorded sessions: which are read and refused, `gelflow calibrate`, `gelflow replay --simulate`."""

import dataclasses
import io
import json
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from tests.policies.calibration.recorded_world import LITTLE

from gelflow.cli.main import main
from gelflow.cli.session_replay import visible_markers
from gelflow.clock import ScaledClock
from gelflow.errors import UsageError
from gelflow.observation import Grid
from gelflow.perception.frames import CameraMount
from gelflow.policies.calibration.calibrated_scene import write_scene
from gelflow.policies.calibration.calibration import Calibration
from gelflow.policies.calibration.comparison import SimulatedSession
from gelflow.policies.calibration.experiment.worlds import RecordedWorld
from gelflow.policies.calibration.flow_picture import MAX_SHOWN, draw_flow_maps
from gelflow.policies.calibration.recordings import Recordings
from gelflow.policies.calibration.session_recordings import read_recordings
from gelflow.session import SessionRecorder
from gelflow.session.records import Decision, describe_session
from gelflow.sim.scene import load_scene
from gelflow.sim.tasks.parts import load_part
from gelflow.task import INSERTION

LAB = {"gripper": {"grasp_force": 12.0}, "part": {"grasp_height": 0.03}}


def write_session(
    path: Path,
    world: RecordedWorld,
    *,
    contact: bool = True,
    mount: CameraMount | None = None,
    lab: Any = None,
    **task: Any,
) -> Path:
    """A session with the attempts of the first two insertions of a world."""
    recordings = world.recordings.of(np.array([0, 1]))
    described = describe_session(task=INSERTION, trackers=[{}, {}], mounts=[mount or {}] * 2, lab=lab or LAB)
    described["task"] = {**described["task"], **task}
    with SessionRecorder(path, ScaledClock()) as recorder:
        recorder.metadata(described)
        attempts = {0: 0, 1: 0}
        for i, flow in enumerate(recordings.flow):
            insertion = int(recordings.insertion[i])
            attempt = attempts[insertion]
            attempts[insertion] += 1
            divisor = 10 * float(np.linalg.norm(flow, axis=-1).max())
            image = (10 * flow / divisor).transpose(0, 3, 1, 2).reshape(-1, *flow.shape[1:3]).astype(np.float32)
            decision = Decision(
                insertion=insertion,
                attempt=attempt,
                tracked=((1, 2), (1, 2)),
                reference=(1, 1),
                frames=((2, 2),),
                flow=image,
                divisor=divisor,
                unit="mm",
                action=np.zeros(3),
                correction=np.zeros(3),
                depths=(0.0, float(recordings.depth[i])),
            )
            recorder.decision(decision.to_json())
            recorder.attempt_end(
                {
                    "insertion": insertion,
                    "attempt": attempt,
                    "outcome": "not inserted",
                    "planar_pose": recordings.planar_pose[i].tolist(),
                    "depth": float(recordings.depth[i]),
                    "contact": contact,
                    "slipped": False,
                }
            )
        for insertion, planar in recordings.inserted.items():
            values = {"insertion": insertion, "attempt": attempts[insertion], "outcome": "inserted"}
            recorder.attempt_end({**values, "planar_pose": planar.tolist(), "depth": 1e-3, "contact": False})
    return path


def test_recordings_are_read_from_sessions(tmp_path: Path, world: RecordedWorld) -> None:
    path, other = (write_session(tmp_path / name, world) for name in ("a.mcap", "b.mcap"))
    expected = world.recordings.of(np.array([0, 1]))
    read = read_recordings([path, other])
    n = len(expected)
    assert (read.names[0], read.names[n]) == ("a, insertion 0, attempt 0", "b, insertion 0, attempt 0")
    assert read.insertion.tolist() == [*expected.insertion, *(expected.insertion + 2)]
    np.testing.assert_allclose(read.flow[:n], 10 * expected.flow, rtol=1e-5, atol=1e-7)
    np.testing.assert_allclose(read.depth[n:], expected.depth)
    assert sorted(read.inserted) == [0, 1, 2, 3]
    assert read.grasp_force == 12.0
    assert read.grasp_height == pytest.approx(0.0)


def test_the_printed_markers_are_those_of_the_session(tmp_path: Path, world: RecordedWorld) -> None:
    mounts = CameraMount(), CameraMount(rows=9, cols=7, pitch=2.0)
    paths = [write_session(tmp_path / f"{mount.rows}.mcap", world, mount=mount) for mount in mounts]
    assert [read_recordings([path]).printed for path in paths] == [mount.grid for mount in mounts]
    with pytest.raises(UsageError, match=r"9\.mcap: the gels have other printed markers than in .*18\.mcap"):
        read_recordings(paths)
    assert read_recordings([write_session(tmp_path / "old.mcap", world)]).printed is None


def test_sessions_of_different_set_ups_are_not_calibrated_together(tmp_path: Path, world: RecordedWorld) -> None:
    usual = write_session(tmp_path / "usual.mcap", world, mount=CameraMount())
    part = LAB["part"]
    for name, changed, expected in (
        (
            "turned",
            {"mount": CameraMount(pixels_per_mm=12.0)},
            "the cameras are mounted or calibrated differently than",
        ),
        ("force", {"lab": LAB | {"gripper": {"grasp_force": 40.0}}}, "the grasp force is 40 N, in .*usual.mcap 12 N"),
        ("height", {"lab": LAB | {"part": part | {"grasp_height": 0.031}}}, "the part is grasped at another height"),
    ):
        other = write_session(tmp_path / f"{name}.mcap", world, **{"mount": CameraMount()} | changed)
        with pytest.raises(UsageError, match=rf"{name}\.mcap: {expected}.*; calibrate it alone"):
            read_recordings([usual, other])


def test_a_record_of_an_attempt_without_its_values_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """As a program of one's own may record it."""
    path = tmp_path / "own.mcap"
    with SessionRecorder(path, ScaledClock()) as recorder:
        recorder.metadata(describe_session(task=INSERTION, trackers=[{}, {}], mounts=[{}, {}], lab=LAB))
        recorder.attempt_end({"insertion": 0, "attempt": 0, "outcome": "inserted"})
    with pytest.raises(UsageError, match=r"own\.mcap: a record of /attempt has no planar_pose, depth, contact"):
        read_recordings([path])
    assert main(["calibrate", str(path), "--out", str(tmp_path / "out")]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_a_session_is_not_calibrated_together_with_its_copy(tmp_path: Path, world: RecordedWorld) -> None:
    path = write_session(tmp_path / "a.mcap", world)
    copy = Path(shutil.copy(path, tmp_path / "copy.mcap"))
    for other in (path, copy):
        with pytest.raises(UsageError, match=r"the same session as .*a\.mcap; name it once"):
            read_recordings([path, other])


def test_sessions_that_cannot_be_calibrated_are_refused(tmp_path: Path, world: RecordedWorld) -> None:
    with pytest.raises(UsageError, match="needs a session of the task insertion, got 'pushing'"):
        read_recordings([write_session(tmp_path / "pushing.mcap", world, name="pushing")])
    with pytest.raises(UsageError, match="no attempt with contact"):
        read_recordings([write_session(tmp_path / "free.mcap", world, contact=False)])
    with SessionRecorder(tmp_path / "bare.mcap", ScaledClock()) as recorder:
        recorder.metadata({"task": INSERTION.to_json(), "lab": LAB})
    with pytest.raises(UsageError, match="has no camera mounts"):
        read_recordings([tmp_path / "bare.mcap"])
    usual, deeper = write_session(tmp_path / "a.mcap", world), write_session(tmp_path / "b.mcap", world, descent=2e-3)
    with pytest.raises(UsageError, match="another part or task"):
        read_recordings([usual, deeper])


def test_meshes_of_parts_come_from_gelflow_or_from_the_part_file(tmp_path: Path, world: RecordedWorld) -> None:
    hexagon = load_part("hexagon").part
    shipped = write_session(tmp_path / "hexagon.mcap", world, part=hexagon.to_json())
    assert Path(read_recordings([shipped]).task.part.mesh_file).samefile(hexagon.mesh_file)
    own = dataclasses.replace(hexagon, mesh="0" * 64, mesh_file="own.obj")
    session = write_session(tmp_path / "own.mcap", world, part=own.to_json())
    with pytest.raises(UsageError, match="the part is a mesh, which a session does not contain; add --part"):
        read_recordings([session])
    assert read_recordings([session], part=own).task.part.mesh_file == "own.obj"
    with pytest.raises(UsageError, match="another part than --part"):
        read_recordings([session], part=hexagon)


def test_markers_that_the_camera_does_not_show_are_not_compared(tmp_path: Path, world: RecordedWorld) -> None:
    mount = CameraMount(rows=13, cols=10, pitch=1.5, visible_rows=(1, 11), pixels_per_mm=12.0)
    session = write_session(tmp_path / "part.mcap", world, mount=mount)
    everything = read_recordings([session]).used
    used = read_recordings([session], visible_markers=visible_markers).used
    assert (everything | ~used).all()
    for hidden in np.logical_not(used.reshape(2, 13, 10).any(2)):
        assert hidden.sum() == 2 and (hidden[:2].all() or hidden[-2:].all())


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"planar_pose": [0.0, 0.0]}, "insertion 0, attempt 0: planar_pose must be three finite numbers"),
        ({"planar_pose": [0.0, float("nan"), 0.0]}, "insertion 0, attempt 0: planar_pose must be three finite numbers"),
        ({"planar_pose": ["a", "b", "c"]}, "a value of another kind"),
        ({"planar_pose": {"x": 0.0}}, "a value of another kind"),
        ({"insertion": "a"}, "a value of another kind"),
        ({"attempt": None}, "a value of another kind"),
        ({"depth": "deep"}, "a value of another kind"),
    ],
)
@pytest.mark.parametrize("outcome", ["inserted", "not inserted"])
def test_values_of_another_kind_are_refused(
    tmp_path: Path, changes: dict[str, Any], message: str, outcome: str
) -> None:
    path = tmp_path / "own.mcap"
    attempt = {"insertion": 0, "attempt": 0, "planar_pose": [0.0] * 3, "depth": 1e-3, "contact": True}
    with SessionRecorder(path, ScaledClock()) as recorder:
        recorder.metadata(describe_session(task=INSERTION, trackers=[{}, {}], mounts=[{}, {}], lab=LAB))
        recorder.attempt_end({**attempt, "outcome": outcome, **changes})
    with pytest.raises(UsageError, match=message):
        read_recordings([path])


def test_flow_maps_of_another_grid_are_refused(tmp_path: Path, world: RecordedWorld) -> None:
    path = write_session(tmp_path / "a.mcap", world, grid=dataclasses.asdict(Grid(9, 7, 2.0)))
    with pytest.raises(
        UsageError, match=r"has a flow map of shape \(2, 13, 10, 2\), the task of the session \(2, 9, 7"
    ):
        read_recordings([path])


def test_values_that_are_not_finite_are_refused(tmp_path: Path, world: RecordedWorld) -> None:
    recordings = dataclasses.replace(world.recordings, depth=world.recordings.depth * np.nan)
    session = write_session(tmp_path / "nan.mcap", dataclasses.replace(world, recordings=recordings))
    with pytest.raises(UsageError, match=r"nan\.mcap: insertion 0, attempt 0 contains values that are not finite"):
        read_recordings([session])


def test_replay_compares_flow_maps_with_the_simulation(
    tmp_path: Path, world: RecordedWorld, capsys: pytest.CaptureFixture[str]
) -> None:
    session, picture = write_session(tmp_path / "a.mcap", world), tmp_path / "maps.png"
    assert main(["replay", str(session), "--simulate", "--out", str(picture), "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    names = [a["name"] for a in printed["attempts"]]
    assert names[0] == "insertion 0, attempt 0"
    assert len(names) == len(world.recordings.of(np.array([0, 1])))
    assert all(0 <= a["relative_error"] < 2 and -1 <= a["cosine"] <= 1.000001 for a in printed["attempts"])
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert main(["replay", str(session), "--simulate", "--checkpoint", "x.safetensors"]) == 2
    assert "leave one of them out" in capsys.readouterr().err


def test_a_picture_states_how_many_attempts_it_omits(world: RecordedWorld) -> None:
    flow = np.repeat(world.recordings.flow[:1].reshape(1, -1, 2), MAX_SHOWN + 1, axis=0)
    for count, text in ((MAX_SHOWN, "blue"), (MAX_SHOWN + 1, f"first {MAX_SHOWN} of {MAX_SHOWN + 1} attempts; blue")):
        figure = draw_flow_maps(
            flow[:count], [("", flow)], ["name"] * count, INSERTION.grid, "mm", used=world.recordings.used, note=""
        )
        assert figure._supxlabel.get_text().startswith(text)


def test_replay_prints_the_errors_before_it_saves_the_picture(
    tmp_path: Path, world: RecordedWorld, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def simulated(recordings: Recordings, **options: Any) -> SimulatedSession:
        flow = recordings.flow.reshape(len(recordings), -1, 2)
        return SimulatedSession(flow, flow, recordings.used)

    def full(*arguments: Any, **options: Any) -> None:
        raise UsageError("No space left on device")

    monkeypatch.setattr("gelflow.cli.simulated_replay.simulate", simulated)
    monkeypatch.setattr("gelflow.cli.simulated_replay.save", full)
    command = ["replay", str(write_session(tmp_path / "a.mcap", world)), "--simulate", "--out", str(tmp_path / "a.png")]
    assert main([*command, "--json"]) == 2
    printed = capsys.readouterr()
    assert json.loads(printed.out)["error"] == 0 and "No space left" in printed.err
    assert main(command) == 2
    printed = capsys.readouterr()
    assert "root mean square error 0 mm" in printed.out and "picture" not in printed.out


def test_replay_warns_of_flow_maps_with_nothing_in_common(
    tmp_path: Path, world: RecordedWorld, capsys: pytest.CaptureFixture[str]
) -> None:
    flow = np.random.default_rng(0).normal(size=world.recordings.flow.shape)
    noise = dataclasses.replace(world, recordings=dataclasses.replace(world.recordings, flow=flow))
    assert main(["replay", str(write_session(tmp_path / "a.mcap", noise)), "--simulate"]) == 0
    assert "insertion 0, attempt 0: recorded and simulated flow map have nothing in common" in capsys.readouterr().out


@pytest.mark.parametrize("name", ["report.json", "report.html", "scene.toml", "insertion.xml"])
def test_no_file_of_the_folder_is_overwritten(tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str) -> None:
    (tmp_path / name).write_text("mine")
    assert main(["calibrate", "missing.mcap", "--out", str(tmp_path)]) == 2
    assert f"{name} exists; name a new folder with --out" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == [name] and (tmp_path / name).read_text() == "mine"


def test_the_report_is_neither_a_plan_nor_a_link(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    for plan in (out, out / "report.json"):
        assert main(["calibrate", "missing.mcap", "--out", str(out), "--plan", str(plan)]) == 2
        assert "is the folder of --out or a file in it; give the plan another name" in capsys.readouterr().err
    assert main(["calibrate", "--out", str(out), "--plan", str(tmp_path / "plan.toml")]) == 2
    assert "--out is the folder for the report on a SESSION" in capsys.readouterr().err
    (tmp_path / "scene.toml").symlink_to("nowhere")
    assert main(["calibrate", "missing.mcap", "--out", str(tmp_path)]) == 2
    assert "scene.toml exists; name a new folder with --out" in capsys.readouterr().err


def test_a_folder_that_cannot_be_written_to_is_refused_before_the_fit(
    tmp_path: Path, world: RecordedWorld, capsys: pytest.CaptureFixture[str]
) -> None:
    session, file = write_session(tmp_path / "a.mcap", world), tmp_path / "file"
    file.touch()
    plan = file / "plan.toml"
    for options in (["--out", str(file)], ["--out", str(tmp_path / "out"), "--plan", str(plan)]):
        assert main(["calibrate", str(session), *options]) == 2
        assert f"cannot write into {file}" in capsys.readouterr().err
    assert main(["calibrate", str(session), "--plan", str(tmp_path / "plan.toml"), "--lab", "missing.toml"]) == 2
    assert "missing.toml" in capsys.readouterr().err


def test_the_scene_does_not_depend_on_the_encoding_of_the_locale(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    known = SimpleNamespace(parameter=SimpleNamespace(name="arm_stiffness"), value=2e3, verdict="known")
    monkeypatch.setattr(io, "text_encoding", lambda encoding, _=2: encoding or "ascii")  # the default of the locale
    result: Any = SimpleNamespace(estimates=[known])
    scene, model = write_scene(result, tmp_path)
    assert load_scene(scene).name and model.exists()
    before = scene.read_bytes()
    with pytest.raises(FileExistsError):  # written by another calibration in the meantime
        write_scene(result, tmp_path)
    assert scene.read_bytes() == before


def test_the_report_is_written_where_the_output_cannot_be_printed(
    tmp_path: Path, world: RecordedWorld, calibrated: Calibration, monkeypatch: pytest.MonkeyPatch
) -> None:
    def closed(*arguments: Any) -> None:
        raise SystemExit(1)  # as when `head` has read enough

    monkeypatch.setattr("gelflow.cli.commands.calibrate.calibrate", lambda *arguments, **options: calibrated)
    monkeypatch.setattr("gelflow.cli.commands.calibrate._show", closed)
    with pytest.raises(SystemExit):
        main(["calibrate", str(write_session(tmp_path / "a.mcap", world)), "--out", str(tmp_path / "out")])
    assert (tmp_path / "out" / "report.json").exists() and (tmp_path / "out" / "report.html").exists()


@pytest.mark.slow
def test_the_command_writes_a_report_and_overwrites_nothing(
    tmp_path: Path, world: RecordedWorld, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    little = dataclasses.replace(LITTLE, starts=2)  # in two processes
    monkeypatch.setattr("gelflow.cli.commands.calibrate._QUICK", little)
    session, out = write_session(tmp_path / "a.mcap", world), tmp_path / "out"
    assert main(["calibrate", str(session), "--quick", "--out", str(out), "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed == json.loads((out / "report.json").read_text())
    assert printed["attempts"]["held_out"] > 0
    before = (out / "report.html").read_bytes()
    assert main(["calibrate", str(session), "--quick", "--out", str(out)]) == 2
    assert "exists; name a new folder with --out" in capsys.readouterr().err
    assert (out / "report.html").read_bytes() == before
    assert main(["calibrate", str(tmp_path / "missing.mcap"), "--out", str(tmp_path / "other")]) == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1
    assert not (tmp_path / "other").exists()
