"""The EGM driver and the mock robot, over real UDP, each in its own process, at clock factors 1 to 5."""

import contextlib
import dataclasses
import itertools
import math
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from gelflow.clock import ScaledClock
from gelflow.errors import PeerError, PeerTimeout, SafetyError, UsageError
from gelflow.hardware_mocks.egm.controller import MockEgmConfig
from gelflow.hardware_mocks.egm.device import MockEgmArm
from gelflow.hardware_mocks.plant import KinematicArm
from gelflow.protocols import Arm
from gelflow.real.egm.codec import EgmFeedback, decode_sensor, encode_robot
from gelflow.real.egm.config import EgmConfig
from gelflow.real.egm.driver import EgmArm
from gelflow.real.egm.reference_generator import EgmFlag
from gelflow.real.kinematics import HOME, forward, inverse

START = np.array([0.40, 0.0, 0.30])
DOWN = np.array([0.0, 0.0, 1.0, 0.0])
# A busy test machine may stall any process for tens of ms: only the tests of staleness itself ask for less patience.
CONFIG = EgmConfig(
    workspace_min=(0.35, -0.05, 0.25), workspace_max=(0.45, 0.05, 0.35), host="127.0.0.1", stale=1.0, silence=5.0
)
MOCK = MockEgmConfig(joint_speed=math.radians(30), comm_timeout=2.0)


def beside(x: float, y: float, z: float) -> np.ndarray:
    """A place near the start [m]."""
    there: np.ndarray = START + np.array([x, y, z])
    return there


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


class Cell:
    """An arm and a mock that talk to each other."""

    def __init__(self, factor: float = 1.0, *, config: EgmConfig = CONFIG, mock: MockEgmConfig = MOCK) -> None:
        self.clock = ScaledClock(factor)
        port = free_port()
        self.plant = KinematicArm(self.clock, position=START, quaternion=DOWN, lag=0.004)
        self.mock = MockEgmArm(self.plant, clock=self.clock, config=dataclasses.replace(mock, port=port))
        self.arm = EgmArm(dataclasses.replace(config, port=port), clock=self.clock)

    def __enter__(self) -> "Cell":
        self.mock.start()
        try:
            self.arm.connect(timeout=60)
            self.arm.wait_following(60)
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self.arm.close()
        self.mock.stop()

    def until(self, done: Callable[[], bool], what: str) -> None:
        """Wait for it as long as a very busy machine may need."""
        end = time.monotonic() + 20
        while not done():
            assert time.monotonic() < end, f"never: {what}"
            time.sleep(0.005)

    def go(self, position: np.ndarray, within: float = 1e-5) -> None:
        """Renew the target until the robot is there."""

        def there() -> bool:
            self.arm.target(position, DOWN, lifetime=0.5)
            return bool(np.linalg.norm(self.arm.state().position - position) < within)

        self.until(there, f"at {position}, is at {self.arm.state().position}")

    def latched(self) -> str:
        def fault() -> str:
            # Feedback that stays out is said by state() until the process has latched too.
            with contextlib.suppress(PeerTimeout):
                return self.arm.state().fault
            return ""

        self.until(lambda: bool(fault()), "latched")
        return fault()


@pytest.fixture
def cell() -> Iterator[Cell]:
    with Cell() as cell:
        yield cell


@pytest.mark.parametrize("factor", [1.0, 5.0])
def test_follows_targets_and_logs_every_cycle(factor: float) -> None:
    with Cell(factor) as cell:
        assert isinstance(cell.arm, Arm)
        assert cell.arm.abortable
        state = cell.arm.state()
        assert state.running
        assert state.motors_on
        assert state.operating_mode == "unknown"
        assert np.allclose(forward(state.joints.tolist())[0], START, atol=1e-6)
        goal = beside(0.005, -0.003, -0.002)
        cell.go(goal)
        assert np.allclose(cell.plant.arm_pose()[0], goal, atol=2e-5)
        records = cell.arm.drain_log()
        report = cell.mock.report
    # Promise: the first reference equals the feedback, each cycle's change is bounded.
    assert report.first_error < 1e-12
    assert report.largest_step <= CONFIG.max_speed * CONFIG.cycle * (1 + 1e-9)
    assert report.invalid == 0
    # One record a message, none left out: what is missing in the count was lost on the way, and says so.
    sequences = np.array([r.sequence for r in records])
    gaps = np.diff(sequences) != 1
    assert (np.diff(sequences) >= 1).all()
    assert gaps.tolist() == [EgmFlag.LOST in r.flags for r in records[1:]]
    assert gaps.sum() <= 0.02 * len(records)
    moving = [r for r in records if r.commanded is not None]
    assert moving[-1].commanded == (tuple(goal), tuple(DOWN))
    applied = [r.applied for r in records if r.applied is not None]
    assert applied[0][0] == pytest.approx(START, abs=1e-9)
    assert applied[-1][0] == pytest.approx(goal, abs=1e-6)
    steps = [math.dist(a[0], b[0]) for a, b in itertools.pairwise(applied)]
    assert max(steps) <= CONFIG.max_speed * CONFIG.cycle * (1 + 1e-9)
    # What was answered was answered once, soon after it came, in the order of the messages.
    assert [r.answered >= r.stamp for r in records if r.applied is not None].count(False) == 0
    assert (np.diff([r.stamp for r in records]) >= 0).all()


def test_slow_descent_keeps_its_speed(cell: Cell) -> None:
    """0.5 mm/s: the policy reads its frames by depth, but the speed is what the contact was trained for."""
    floor = beside(0, 0, -0.002)
    start = cell.clock.now()
    while cell.clock.now() - start < 1.5:
        cell.arm.target(floor, DOWN, lifetime=0.5, speed=0.5e-3)
        cell.clock.sleep(0.05)
    records = [r for r in cell.arm.drain_log() if r.commanded is not None and r.applied is not None]
    half = records[len(records) // 3 :]
    heights = np.array([r.applied[0][2] for r in half if r.applied is not None])
    times = np.array([r.controller_time for r in half])
    speed = -np.polyfit(times, heights, 1)[0]
    assert speed == pytest.approx(0.5e-3, rel=0.05)
    measured = np.array([r.measured[0][2] for r in half])
    # The robot lags 10 to 20 ms behind, which is 5 to 10 µm here.
    assert np.median(measured - heights) < 20e-6


def test_expired_target_and_hold_freeze_the_reference(cell: Cell) -> None:
    far = beside(0.04, 0, 0)
    cell.arm.target(far, DOWN, lifetime=0.15)
    cell.until(lambda: any(e.text == "the target expired" for e in cell.arm.drain_events()), "the target expired")
    first, _ = cell.arm.reference()
    cell.clock.sleep(0.1)
    assert np.array_equal(cell.arm.reference()[0], first)
    assert START[0] < first[0] < far[0]
    cell.arm.target(far, DOWN, lifetime=1.0)
    cell.clock.sleep(0.1)
    cell.arm.hold()
    cell.until(lambda: any(e.text == "hold was called" for e in cell.arm.drain_events()), "a hold")
    second, _ = cell.arm.reference()
    cell.clock.sleep(0.1)
    third, _ = cell.arm.reference()
    assert math.dist(second, third) <= CONFIG.max_speed * CONFIG.cycle
    assert third[0] > first[0]
    assert cell.arm.state().running


@pytest.mark.parametrize(
    ("position", "quaternion", "options", "text"),
    [
        (beside(0.2, 0, 0), DOWN, {}, "outside the workspace"),
        (START * math.nan, DOWN, {}, "not finite"),
        (START, DOWN * math.nan, {}, "not finite"),
        (START, DOWN * 1.1, {}, "unit quaternion"),
        (beside(0.049, 0.049, 0), DOWN, {}, "from the reference, at most 0.05 m"),
        (START, np.array([1.0, 0, 0, 0]), {}, "180.000° from the reference"),
        (START, DOWN, {"speed": 0.5}, "speed 0.5 is not"),
        (START, DOWN, {"lifetime": 5.0}, "lifetime 5.0 s is not"),
        (START, DOWN, {"lifetime": math.nan}, "lifetime nan s is not"),
    ],
)
def test_wrong_targets_are_refused_in_the_caller(
    shared: Cell, position: np.ndarray, quaternion: np.ndarray, options: dict[str, float], text: str
) -> None:
    before = shared.arm.reference()[0]
    with pytest.raises(SafetyError, match=text) as caught:
        shared.arm.target(position, quaternion, **{"lifetime": 0.5, **options})
    assert "\n" not in str(caught.value)
    shared.clock.sleep(0.03)
    assert np.array_equal(shared.arm.reference()[0], before)
    assert not [e for e in shared.arm.drain_events() if e.kind == "refused"], "it was posted all the same"


@pytest.fixture(scope="module")
def shared() -> Iterator[Cell]:
    with Cell() as cell:
        yield cell


def test_wrong_targets_are_refused_once_more_in_the_process(cell: Cell) -> None:
    """A caller that goes round the checks: the process refuses and holds."""
    cell.arm.target(beside(0.04, 0, 0), DOWN, lifetime=1.0)
    cell.arm._send("target", (0.9, 0.0, 0.3), DOWN.tolist(), cell.clock.now() + 1.0, 0.02, 0.1)
    refused: list[str] = []

    def said() -> bool:
        refused.extend(e.text for e in cell.arm.drain_events() if e.kind == "refused")
        return bool(refused)

    cell.until(said, "a refusal")
    assert "x = 0.900000 m is outside the workspace" in refused[0]
    first, _ = cell.arm.reference()
    cell.clock.sleep(0.05)
    assert np.array_equal(cell.arm.reference()[0], first)


def test_wrong_shapes_are_the_callers_mistake(shared: Cell) -> None:
    with pytest.raises(UsageError, match=r"expected a position \(3,\)"):
        shared.arm.target(np.zeros(4), DOWN, lifetime=0.1)


def test_stop_ceases_sending_and_latches_until_reset(cell: Cell) -> None:
    cell.arm.target(beside(0.04, 0, 0), DOWN, lifetime=1.0)
    cell.clock.sleep(0.1)
    cell.arm.stop("contact was too hard")
    answers = cell.mock.report.answers
    cell.clock.sleep(0.2)
    assert cell.mock.report.answers - answers <= 1, "an answer on its way may still come"
    assert cell.arm.state().fault == "contact was too hard"
    assert not cell.arm.state().running
    with pytest.raises(SafetyError, match="stopped: contact was too hard; after the cause is removed, an operator"):
        cell.arm.target(START, DOWN, lifetime=0.5)
    # The robot's own time-out ends EGM where the arm is; its program starts EGM again, and still nothing is sent.
    cell.until(lambda: cell.mock.report.sessions == 2, "EGM was started again")
    assert cell.mock.report.reason == "no answer for 2.0 s"
    stood = cell.plant.arm_pose()[0]
    assert cell.mock.report.answers - answers <= 1
    cell.arm.reset()
    cell.arm.wait_following(20)
    cell.clock.sleep(0.1)
    assert np.allclose(cell.plant.arm_pose()[0], stood, atol=1e-7), "it moved by itself after the reset"
    assert cell.mock.report.first_error < 1e-9
    cell.go(START)


def test_motors_off_and_rapid_stop_latch(cell: Cell) -> None:
    cell.mock.motors(False)
    assert cell.latched() == "motors off"
    assert not cell.arm.state().motors_on
    cell.mock.motors(True)
    cell.until(lambda: cell.mock.report.sessions == 2, "EGM was started again")
    cell.clock.sleep(0.1)
    assert not cell.arm.state().running
    cell.arm.reset()
    cell.arm.wait_following(20)
    cell.mock.rapid(False)
    assert cell.latched() == "RAPID stopped"
    with pytest.raises(SafetyError, match="RAPID stopped"):
        cell.arm.target(START, DOWN, lifetime=0.5)


def test_a_reset_while_the_cause_stands_does_not_start_motion(cell: Cell) -> None:
    cell.mock.motors(False)
    cell.latched()
    cell.arm.reset()
    with pytest.raises(PeerTimeout, match=r"motors off\): switch the motors on and start the RAPID program"):
        cell.arm.wait_following(0.2)
    with pytest.raises(SafetyError, match="does not follow references"):
        cell.arm.target(START, DOWN, lifetime=0.5)


def test_sequence_restart_latches(cell: Cell) -> None:
    cell.until(lambda: cell.mock.report.sent > 30, "30 messages")
    cell.mock.restart_sequence()
    assert "EGM was restarted" in cell.latched()
    answers = cell.mock.report.answers
    cell.clock.sleep(0.1)
    assert cell.mock.report.answers == answers


def test_stale_feedback_holds_then_stops() -> None:
    with Cell(config=dataclasses.replace(CONFIG, stale=0.1, silence=0.6)) as cell:
        cell.arm.target(beside(0.04, 0, 0), DOWN, lifetime=1.0)
        cell.clock.sleep(0.05)
        cell.mock.silence(0.3)
        cell.until(lambda: any("no EGM message for" in e.text for e in cell.arm.drain_events()), "a hold")
        # Feedback is back: it stands, though the target had not expired, and takes new ones.
        cell.until(lambda: cell.clock.now() - cell.arm.state().stamp < 0.05, "fresh feedback")
        first, _ = cell.arm.reference()
        cell.clock.sleep(0.05)
        assert np.array_equal(cell.arm.reference()[0], first)
        cell.arm.target(START, DOWN, lifetime=0.5)
        cell.mock.silence(60)
        assert "at most 0.6 s is allowed" in cell.latched()
        with pytest.raises(SafetyError, match="the arm is stopped"):
            cell.arm.target(START, DOWN, lifetime=0.5)


def test_lost_messages_are_flagged_and_do_no_harm(cell: Cell) -> None:
    cell.mock.lose(3, share=0.2)
    cell.go(beside(0.003, 0, 0))
    records = cell.arm.drain_log()
    lost = sum(EgmFlag.LOST in r.flags for r in records)
    assert lost > 0.05 * len(records)
    assert cell.mock.report.largest_step <= CONFIG.max_speed * CONFIG.cycle * (1 + 1e-9)


def test_a_full_log_stops_the_arm_and_drops_nothing() -> None:
    with Cell(config=dataclasses.replace(CONFIG, log_records=64)) as cell:
        assert "the log is full: 64 cycles were not fetched with drain_log()" in cell.latched()
        records = cell.arm.drain_log()
        assert len(records) == 64
        gaps = [(r.sequence, EgmFlag.LOST in r.flags) for r in records]
        assert all(b[0] == a[0] + 1 or b[1] for a, b in itertools.pairwise(gaps))
        answers = cell.mock.report.answers
        cell.clock.sleep(0.1)
        assert cell.mock.report.answers == answers, "draining does not resume"


def test_dry_run_checks_targets_and_sends_nothing() -> None:
    clock = ScaledClock()
    port = free_port()
    plant = KinematicArm(clock, position=START, quaternion=DOWN)
    mock = MockEgmArm(plant, clock=clock, config=dataclasses.replace(MOCK, port=port))
    mock.start()
    try:
        with EgmArm(dataclasses.replace(CONFIG, port=port, dry_run=True), clock=clock) as arm:
            arm.connect(timeout=60)
            arm.target(beside(0.01, 0, 0), DOWN, lifetime=0.5)
            with pytest.raises(SafetyError, match="outside the workspace"):
                arm.target(beside(0.1, 0, 0), DOWN, lifetime=0.5)
            clock.sleep(0.2)
            assert arm.drain_log()[-1].applied is None
        assert mock.report.answers == mock.report.invalid == 0
    finally:
        mock.stop()


def test_the_arm_may_be_there_before_the_robot() -> None:
    cell = Cell(5.0)
    failed: list[BaseException] = []

    def connect() -> None:
        try:
            cell.arm.connect(timeout=200)
        except PeerError as error:
            failed.append(error)

    waiting = threading.Thread(target=connect)
    waiting.start()
    try:
        cell.until(lambda: cell.arm.pid is not None, "the process")
        time.sleep(0.3)
        cell.mock.start()
        waiting.join(30)
        assert not failed
        cell.arm.wait_following(60)
    finally:
        waiting.join(45)
        cell.__exit__()


def test_no_robot_gives_one_clear_line_and_leaves_nothing_behind() -> None:
    arm = EgmArm(dataclasses.replace(CONFIG, port=free_port(), connect_timeout=2.0), clock=ScaledClock(10))
    for _ in range(2):
        with pytest.raises(PeerTimeout) as caught:
            arm.connect()
        assert str(caught.value) == (
            f"no EGM packet on UDP port {arm.port} within 2 s: "
            "start the RAPID program with EGMRunPose, check UCDevice address"
        )
        assert arm.pid is None
    with pytest.raises(UsageError, match="not connected"):
        arm.state()


def test_a_port_in_use_is_said() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", 0))
        port = other.getsockname()[1]
        with pytest.raises(UsageError, match=f"cannot listen for EGM on 127.0.0.1:{port}: Address already in use"):
            EgmArm(dataclasses.replace(CONFIG, port=port), clock=ScaledClock()).connect()


def test_an_egm_process_that_died_is_noticed(cell: Cell) -> None:
    assert cell.arm.pid is not None
    os.kill(cell.arm.pid, signal.SIGKILL)
    said = ""

    def refused() -> bool:
        nonlocal said
        try:
            cell.arm.target(START, DOWN, lifetime=0.5)
        except PeerError as error:
            said = str(error)
        return bool(said)

    cell.until(refused, "a target is refused")
    assert "the EGM process has ended (exit status -9)" in said
    cell.arm.stop("the end")


def test_ctrl_c_is_the_parents_matter(cell: Cell) -> None:
    assert cell.arm.pid is not None
    os.kill(cell.arm.pid, signal.SIGINT)
    cell.clock.sleep(0.1)
    cell.go(beside(0.001, 0, 0))


def _gone(pid: int | None) -> bool:
    with contextlib.suppress(OSError):
        # A process that nobody has waited for yet is gone all the same.
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] == "Z"
    return True


ORPHANS = """
import sys, time
import numpy as np
from gelflow.clock import ScaledClock
from gelflow.hardware_mocks import KinematicArm, MockEgmArm, MockEgmConfig
from gelflow.real import EgmArm, EgmConfig
clock = ScaledClock()
port = int(sys.argv[1])
plant = KinematicArm(clock, position=np.array([0.4, 0.0, 0.3]), quaternion=np.array([0.0, 0.0, 1.0, 0.0]))
mock = MockEgmArm(plant, clock=clock, config=MockEgmConfig(port=port))
mock.start()
arm = EgmArm(EgmConfig((0.3, -0.1, 0.2), (0.5, 0.1, 0.4), port=port, stale=1.0, silence=5.0), clock=clock)
arm.connect(timeout=60)
arm.wait_following(60)
print(arm.pid, mock.pid, flush=True)
time.sleep(600)
"""


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks processes up in /proc")
def test_the_processes_die_with_their_parent() -> None:
    port = free_port()
    command = [sys.executable, "-c", ORPHANS, str(port)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        children = [int(word) for word in parent.stdout.readline().split()]
        assert len(children) == 2
        assert not any(map(_gone, children))
        parent.send_signal(signal.SIGKILL)
    end = time.monotonic() + 10
    while not all(map(_gone, children)):
        assert time.monotonic() < end, "a child outlived its parent"
        time.sleep(0.01)


def test_garbage_duplicates_and_strangers_are_counted_and_not_followed() -> None:
    """A robot played by hand: each good message is answered once, nothing else is answered at all."""
    port = free_port()
    arm = EgmArm(dataclasses.replace(CONFIG, port=port), clock=ScaledClock())
    joints = inverse(tuple(START), tuple(DOWN), near=HOME)

    def message(sequence: int) -> bytes:
        return encode_robot(EgmFeedback(sequence, sequence * 0.004, tuple(START), tuple(DOWN), joints))

    with contextlib.ExitStack() as stack:
        robot, stranger = (stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) for _ in range(2))
        stack.callback(arm.close)
        for one in (robot, stranger):
            one.bind(("127.0.0.1", 0))
            one.settimeout(10)
            done = threading.Event()

        def call() -> None:
            while not done.wait(0.02):
                robot.sendto(message(1), ("127.0.0.1", port))

        caller = threading.Thread(target=call)
        caller.start()
        try:
            arm.connect(timeout=60)
        finally:
            done.set()
            caller.join()
        answer = decode_sensor(robot.recv(4096))
        assert answer.sequence == 0
        assert answer.position == pytest.approx(tuple(START))
        before = arm.counts
        robot.sendto(b"\x00" * 7, ("127.0.0.1", port))
        robot.sendto(b"", ("127.0.0.1", port))
        robot.sendto(message(1), ("127.0.0.1", port))
        robot.sendto(message(2)[:40], ("127.0.0.1", port))
        stranger.sendto(message(3), ("127.0.0.1", port))
        robot.sendto(message(2), ("127.0.0.1", port))
        answer = decode_sensor(robot.recv(4096))
        assert answer.sequence == 1
        counts = arm.counts
        assert counts.malformed - before.malformed == 3
        assert counts.foreign == 1
        assert counts.duplicates - before.duplicates == 1
        robot.settimeout(0.2)
        with pytest.raises(TimeoutError):
            robot.recv(4096)
        assert [r.sequence for r in arm.drain_log()] == [1, 2]
        assert any(e.kind == "malformed" and "EgmRobot" in e.text for e in arm.drain_events())


def test_a_named_robot_is_the_only_one_heard() -> None:
    port = free_port()
    arm = EgmArm(dataclasses.replace(CONFIG, port=port, robot="192.0.2.1"), clock=ScaledClock(10))
    plant = KinematicArm(ScaledClock(10), position=START, quaternion=DOWN)
    mock = MockEgmArm(plant, clock=ScaledClock(10), config=dataclasses.replace(MOCK, port=port))
    mock.start()
    try:
        with pytest.raises(PeerTimeout, match="no EGM packet"):
            arm.connect(timeout=3)
    finally:
        mock.stop()
