"""The insertion runner against the whole mock robot, through pty, TCP, UDP and HTTP: it inserts, and it stops.

Nothing is patched. Faults are ordered from the mocks; what the runner did is read at the mocks' side of the wire.
"""

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from gelflow.cli.commands.mock import lab_for
from gelflow.cli.main import main
from gelflow.errors import GelflowError, PeerTimeout, SafetyError
from gelflow.hardware_mocks.robot import MockRobot, MockRobotConfig
from gelflow.hardware_mocks.simulated_cell.cell import SimulatedCellConfig
from gelflow.observation import FlowMap
from gelflow.real.runner.insertion_runner import Attempt, Insertion
from gelflow.real.runner.lab import Lab
from gelflow.real.runner.lab_file import load_lab, save_lab
from gelflow.real.runner.run_plan import RunPlan, dry_run, run_insertions
from gelflow.real.wsg.codec import Decoder, Packet, plausible_request
from gelflow.real.wsg.constants import Command
from gelflow.session.reader import SessionReader
from gelflow.task import INSERTION

FACTOR = 4.0
MOTIONS = {Command.HOME, Command.PRE_POSITION, Command.GRASP, Command.RELEASE, Command.STOP, Command.FAST_STOP}


def free_port(kind: socket.SocketKind) -> int:
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@pytest.fixture
def robot() -> Iterator[MockRobot]:
    config = MockRobotConfig(
        cell=SimulatedCellConfig(seed=2), egm_port=free_port(socket.SOCK_DGRAM), rotations=(90, 180)
    )
    with MockRobot(FACTOR, config) as running:
        yield running


class Told:
    """A scripted policy that is told the truth and corrects two thirds of what is wrong."""

    def __init__(self, robot: MockRobot, *, answer: Callable[[], None] = lambda: None) -> None:
        self._robot, self._answer = robot, answer
        self._place = np.zeros(3)
        self.seen: list[FlowMap] = []

    def reset(self) -> None:
        self._place = np.zeros(3)

    def act(self, observation: FlowMap) -> NDArray[np.float64]:
        self.seen.append(observation)
        self._answer()
        x, y, yaw = self._robot.cell.truth()["part"]["misalignment"]
        back, here = -yaw, -self._place[2]
        wanted = np.array([-np.cos(back) * x + np.sin(back) * y, -np.sin(back) * x - np.cos(back) * y, -yaw])
        dx, dy, turn = wanted - self._place
        local = [np.cos(here) * dx - np.sin(here) * dy, np.sin(here) * dx + np.cos(here) * dy, turn]
        correction = np.array(local) * 2 / 3
        self._place = INSERTION.corrected(self._place, correction)
        return correction


def mean_displacement(robot: MockRobot) -> NDArray[np.float64]:
    """Of each pad's markers along the finger, now [mm]."""
    return np.array([robot.cell.marker_displacement(finger)[:, 0].mean() for finger in (0, 1)])


def plan_for(robot: MockRobot, folder: Path, policy: Any, **changes: Any) -> RunPlan:
    lab = changes.pop("lab", None) or lab_for(robot)
    return RunPlan(lab=lab, policy=policy, task=INSERTION, session=folder / "session.mcap", **changes)


def events(path: Path) -> list[tuple[str, Any]]:
    with SessionReader(path) as session:
        return [(record.value["name"], record.value["values"]) for record in session.records(["/event"])]


def in_background(work: Callable[[], Any]) -> Callable[[], Any]:
    """Run `work` in a thread; the returned function waits for it and raises what it raised."""
    outcome: list[Any] = []

    def run() -> None:
        try:
            outcome.append(work())
        except BaseException as error:  # noqa: BLE001 - handed to the test's thread
            outcome.append(error)

    thread = threading.Thread(target=run)
    thread.start()

    def finish() -> Any:
        thread.join(120)
        assert not thread.is_alive(), "the run did not end"
        if isinstance(outcome[0], BaseException):
            raise outcome[0]
        return outcome[0]

    return finish


def wait_for(condition: Callable[[], bool], seconds: float = 60.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.01)


def test_it_inserts_a_part_and_records_what_it_did(robot: MockRobot, tmp_path: Path) -> None:
    felt: list[NDArray[np.float64]] = []  # mean shear of each pad along the finger, at each decision [mm]
    policy = Told(robot, answer=lambda: felt.append(mean_displacement(robot)))
    made: list[Attempt] = []
    plan = plan_for(robot, tmp_path, policy, on_attempt=lambda number, attempt: made.append(attempt))
    results: list[Insertion] = run_insertions(plan)

    assert [result.outcome for result in results] == ["inserted"]
    assert robot.cell.truth()["parts"][0]["inserted"]
    assert len(made) == len(results[0].attempts) >= 2 and made[-1].inserted
    # The rim was met, which stopped the descent, and every map that the policy saw is normalized.
    first = made[0]
    assert first.contact and first.stopped_by_contact and 0.3e-3 < first.depth < 1.15e-3
    # The depth of the last frames is the depth where they were taken, not where the arm was a moment before.
    assert made[-1].depth == pytest.approx(INSERTION.descent, abs=0.05e-3)
    for seen in policy.seen:
        assert seen.image.shape == INSERTION.observation_shape and seen.unit == "mm"
        assert np.hypot(seen.image[0::2], seen.image[1::2]).max() == pytest.approx(1, abs=1e-5)
        # Turned cameras and all: the rim pushes both pads towards the fingers' base.
        assert seen.image[0].mean() < -0.2 and seen.image[2].mean() < -0.2

    # Both pads were seen at the same moment, at rest: all differ from the truth by what the grip alone does to them.
    shown = [seen.divisor * seen.image[[0, 2]].mean(axis=(1, 2)) for seen in policy.seen]
    assert np.ptp(np.array(shown) - np.array(felt)) < 0.005

    with SessionReader(plan.session) as session:
        counts = session.counts()
        decisions = list(session.decisions())
        lab = session.description()["lab"]
    assert len(decisions) == len(policy.seen) == counts["/decision"]
    assert counts["/attempt"] == len(made)
    for topic in ("/left/image", "/right/image", "/arm/pose", "/arm/applied", "/gripper/state", "/gripper/command"):
        assert counts[topic] > 10 or topic == "/gripper/command"
    assert lab["gripper"]["grasp_force"] == plan.lab.gripper.grasp_force
    report = robot.arm.report
    assert report.first_error < 1e-4  # the first reference was the feedback
    assert report.largest_step < 5e-3 * 0.004 * 1.5  # no cycle moved faster than the lab allows
    assert not robot.gripper.fast_stopped  # the disconnect was announced


def test_a_dry_run_sends_no_motion_byte(robot: MockRobot, tmp_path: Path) -> None:
    relay = Relay(robot.gripper.tcp_address)
    with relay:
        lab = lab_for(robot)
        lab = replace(lab, gripper=replace(lab.gripper, address=f"tcp:127.0.0.1:{relay.port}"))
        found = dry_run(plan_for(robot, tmp_path, Told(robot), lab=lab))
    assert [item.good for item in found.items] == [True] * 5 and len(found.targets) == 4
    assert np.isfinite(found.action).all()
    asked = relay.commands()
    assert Command.DISCONNECT in asked and Command.DEVICE_INFO in asked
    assert not MOTIONS & set(asked)
    assert robot.arm.report.answers == 0  # not one EGM message was sent
    assert robot.gripper.fast_stopped is False


class Relay:
    """Stands between driver and mock gripper and keeps what the driver sends."""

    def __init__(self, target: tuple[str, int]) -> None:
        self._target = target
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = int(self._listener.getsockname()[1])
        self._sent = b""
        self._threads: list[threading.Thread] = []

    def __enter__(self) -> "Relay":
        thread = threading.Thread(target=self._serve, daemon=True)
        thread.start()
        self._threads.append(thread)
        return self

    def __exit__(self, *_: object) -> None:
        self._listener.close()
        for thread in self._threads:
            thread.join(5)

    def _serve(self) -> None:
        try:
            client, _ = self._listener.accept()
        except OSError:
            return
        with client, socket.create_connection(self._target) as device:
            back = threading.Thread(target=self._pass, args=(device, client, False), daemon=True)
            back.start()
            self._pass(client, device, True)
            device.shutdown(socket.SHUT_WR)
            back.join(5)

    def _pass(self, source: socket.socket, sink: socket.socket, keep: bool) -> None:
        try:
            while data := source.recv(4096):
                if keep:
                    self._sent += data
                sink.sendall(data)
        except OSError:
            return

    def commands(self) -> list[int]:
        """The ids of all frames that the driver sent."""
        frames = Decoder(plausible=plausible_request).feed(self._sent)
        assert frames and all(isinstance(frame, Packet) for frame in frames)
        return [frame.id for frame in frames if isinstance(frame, Packet)]


def moving(robot: MockRobot) -> bool:
    """Whether the arm follows a descent: a part is held and lowered."""
    part = robot.cell.truth()["part"]
    return part is not None and part["phase"] == "gripped" and part["height"] < 0.0315


@pytest.mark.parametrize(
    ("fault", "named"),
    [
        (lambda robot: robot.cameras[1].stall(), "camera right"),
        (lambda robot: robot.cameras[0].drop_clients(), "camera left"),
        (lambda robot: robot.arm.silence(60.0), "pose is"),
        (lambda robot: robot.arm.motors(False), "motors"),
        (lambda robot: robot.gripper.raise_fast_stop(), "FAST"),
    ],
    ids=["frames stall", "stream ends", "poses stall", "motors off", "fast stop"],
)
def test_what_goes_stale_or_stops_holds_the_arm_and_ends_the_run(
    robot: MockRobot, tmp_path: Path, fault: Callable[[MockRobot], None], named: str
) -> None:
    plan = plan_for(robot, tmp_path, Told(robot))
    finish = in_background(lambda: run_insertions(plan))
    wait_for(lambda: moving(robot))
    fault(robot)
    with pytest.raises(GelflowError) as error:
        finish()
    assert named.lower() in str(error.value).lower() and "\n" not in str(error.value)

    # The arm stands, no reference is sent any more, and the part is still held.
    answers = robot.arm.report.answers
    before = robot.cell.arm_pose()[0]
    time.sleep(0.3)
    assert robot.arm.report.answers == answers
    assert robot.cell.arm_pose()[0] == pytest.approx(before, abs=1e-6)
    assert robot.cell.truth()["part"]["phase"] == "gripped"
    assert robot.cell.gripper_state()[2] > 10
    # The recording is whole, and says why.
    told = dict(events(plan.session))
    assert named.lower() in told["stopped"]["reason"].lower()


def test_a_lost_part_ends_its_insertion_and_the_next_one_goes_on(robot: MockRobot, tmp_path: Path) -> None:
    lost: list[bool] = []

    def lose() -> None:
        if not lost:
            robot.gripper.lose_part()
            lost.append(True)

    results = run_insertions(plan_for(robot, tmp_path, Told(robot, answer=lose), insertions=2))
    assert [result.outcome for result in results] == ["part lost", "inserted"]
    assert "part lost" in dict(events(tmp_path / "session.mcap"))


@pytest.mark.parametrize("answer", [[np.nan, 0, 0], [0, np.inf, 0], [0, 0]])
def test_a_policy_that_says_nonsense_moves_nothing(robot: MockRobot, tmp_path: Path, answer: list[float]) -> None:
    class Nonsense:
        def reset(self) -> None: ...

        def act(self, observation: FlowMap) -> NDArray[np.float64]:
            return np.array(answer)

    with pytest.raises(SafetyError, match="expected three finite numbers"):
        run_insertions(plan_for(robot, tmp_path, Nonsense()))
    assert robot.cell.truth()["part"]["phase"] == "gripped"


def test_preflight_names_all_that_is_wrong_and_nothing_moves(robot: MockRobot, tmp_path: Path) -> None:
    lab = lab_for(robot)
    lab = replace(
        lab,
        gripper=replace(lab.gripper, home_at_start=False),
        hole=replace(lab.hole, position=(0.374, 0.10, 0.05)),
    )
    with pytest.raises(SafetyError) as error:
        run_insertions(plan_for(robot, tmp_path, Told(robot), lab=lab))
    message = str(error.value)
    assert "gripper: it is not homed" in message and "pose: target refused: |y| = 50.00 mm" in message
    assert robot.arm.report.largest_step < 1e-9
    assert robot.cell.gripper_state()[0] == pytest.approx(0.06, abs=1e-4)


def test_ctrl_c_stops_announces_and_closes_the_recording(robot: MockRobot, tmp_path: Path) -> None:
    lab = lab_for(robot)
    save_lab(lab, tmp_path / "lab.toml", title="test")
    script = tmp_path / "run.py"
    script.write_text(_RUN_UNTIL_INTERRUPTED)
    process = subprocess.Popen(
        [sys.executable, str(script), str(tmp_path)], stderr=subprocess.PIPE, env=os.environ | {"PYTHONPATH": _SOURCE}
    )
    try:
        wait_for(lambda: moving(robot) or process.poll() is not None)
        assert process.poll() is None, process.communicate()[1].decode()
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == 130, errors.decode()
    told = dict(events(tmp_path / "session.mcap"))  # a file that was not finished would be refused
    assert "KeyboardInterrupt" in told["arm stopped"]["reason"]
    assert not robot.gripper.fast_stopped
    answers = robot.arm.report.answers
    time.sleep(0.2)
    assert robot.arm.report.answers == answers
    assert robot.cell.truth()["part"]["phase"] == "gripped"


_SOURCE = str(Path(__file__).resolve().parents[3] / "src")
_RUN_UNTIL_INTERRUPTED = """
import signal
import sys
from pathlib import Path
import numpy as np
from gelflow.real.runner.lab_file import load_lab
from gelflow.real.runner.run_plan import RunPlan, run_insertions
from gelflow.task import INSERTION

class Still:
    def reset(self): pass
    def act(self, observation): return np.zeros(3)

signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored in what a shell runs in the background
folder = Path(sys.argv[1])
try:
    run_insertions(RunPlan(load_lab(folder / "lab.toml"), Still(), INSERTION, folder / "session.mcap", insertions=9))
except KeyboardInterrupt:
    sys.exit(130)
"""


def closed_lab(robot_lab: Lab, **changes: str) -> Lab:
    lab = robot_lab
    if "gripper" in changes:
        lab = replace(lab, gripper=replace(lab.gripper, address=changes["gripper"]))
    if "camera" in changes:
        cameras = replace(lab.cameras, left=replace(lab.cameras.left, source=changes["camera"]))
        lab = replace(lab, cameras=cameras)
    return lab


@pytest.mark.parametrize("what", ["gripper", "serial", "camera", "arm"])
def test_what_does_not_answer_is_named_in_one_line(
    robot: MockRobot, tmp_path: Path, capsys: pytest.CaptureFixture[str], what: str
) -> None:
    dead = free_port(socket.SOCK_STREAM)
    lab = lab_for(robot)
    named = str(dead)
    if what == "gripper":
        lab = closed_lab(lab, gripper=f"tcp:127.0.0.1:{dead}")
    elif what == "serial":
        lab, named = closed_lab(lab, gripper="serial:/dev/no-such-gripper"), "/dev/no-such-gripper"
    elif what == "camera":
        lab = closed_lab(lab, camera=f"http://127.0.0.1:{dead}/?action=stream")
    else:
        silent = free_port(socket.SOCK_DGRAM)
        lab, named = replace(lab, arm=replace(lab.arm, egm_port=silent)), str(silent)
    path = tmp_path / "lab.toml"
    save_lab(lab, path, title="test")
    with pytest.raises((GelflowError, PeerTimeout)) as error:
        run_insertions(RunPlan(load_lab(path), Told(robot), INSERTION, tmp_path / "session.mcap"))
    assert named in str(error.value) and "\n" not in str(error.value)
    assert not robot.gripper.fast_stopped


def test_the_command_refuses_wrong_files_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "lab.toml").write_text("format = 1\nspeed = 3\n")
    (tmp_path / "policy").write_text("not a checkpoint")
    for arguments, named in (
        (["--lab", str(tmp_path / "none.toml")], "none.toml"),
        (["--lab", str(tmp_path / "lab.toml")], "unknown key 'speed'"),
        (["--lab", str(tmp_path / "lab.toml"), "--insertions", "0"], "--insertions must be at least 1"),
    ):
        assert main(["run", "insertion", *arguments]) == 2
        output = capsys.readouterr()
        assert named in output.err and output.err.count("\n") == 1
