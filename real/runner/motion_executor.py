"""Executes motions: a thread renews the arm's target and monitors the age of all data that motion relies on."""

import contextlib
import math
import threading
from collections import deque
from collections.abc import Callable, Sequence
from types import TracebackType

import numpy as np

from gelflow.clock import Clock, raise_priority
from gelflow.errors import GelflowError, PeerError, SafetyError
from gelflow.geometry import Pose
from gelflow.protocols import ArmState, Camera, Gripper, GripperState
from gelflow.real.egm.cycle_log import EgmCycle
from gelflow.real.egm.driver import EgmArm
from gelflow.real.egm.reference_generator import EgmFlag
from gelflow.real.limits import LIMITS
from gelflow.real.runner.approach_monitor import ARRIVED, ApproachMonitor
from gelflow.real.runner.checks import DataChecks
from gelflow.real.runner.lab import Lab
from gelflow.real.runner.phases import with_advice
from gelflow.real.runner.supervisor import Supervisor
from gelflow.real.web_services.monitor import ControllerMonitor
from gelflow.real.wsg.checks import fingers_move, may_hold_part
from gelflow.session.recorder import SessionRecorder

RECORD_EVERY = 5  # EGM cycles: poses are recorded at 50 Hz, and in addition at every change of a cycle's flags
_HISTORY = 8192  # number of measured heights kept, one per cycle: 32 s
# Age of the newest readable image at which a guarded motion holds [s]: 250 ms, less the longest wait of the observer
# and tracking.
LONGEST_UNOBSERVED = LIMITS.image_age - 0.03
_HOLD_TIME = 0.01  # from the end of the time for an observation to the hold, at most [s]
_LEAST_TIME = 0.05  # for the next observation, however old the images are [s]
_WIDTH_CHANGE = 0.5e-3  # of the gripper since the grasp, above which the part has moved [m]
_WATCH_PERIOD = 0.004  # of the checks of all data, one cycle of EGM [s]
_CHECKS_PERIOD = 0.5  # between two records of the checks [s]
_LEAST_WAIT = 0.004  # between two checks, for clocks faster than real time [s, wall]


def record_events(arm: EgmArm, recorder: SessionRecorder) -> None:
    """Record all events of the arm's driver since the last call."""
    for event in arm.drain_events():
        recorder.event(f"arm {event.kind}", {"text": event.text, "at": event.stamp})


class PartLost(PeerError):
    """The gripper lost the part: the attempt ends."""


class MotionExecutor:
    """Moves the gripper frame to targets.

    A thread renews the target of the arm, whose lifetime is short: if this program stops working, the arm holds. On
    the first failure (a stale pose, image or gripper state, a stopped controller, a refused target) the arm holds,
    then stops; `failure` stores the error, and every later call raises it.
    """

    def __init__(
        self,
        arm: EgmArm,
        gripper: Gripper,
        cameras: Sequence[Camera],
        *,
        lab: Lab,
        clock: Clock,
        supervisor: Supervisor,
        recorder: SessionRecorder,
        controller: ControllerMonitor | None = None,
    ) -> None:
        self._controller = controller
        self.checks = DataChecks(
            arm, gripper, cameras, lab=lab, clock=clock, supervisor=supervisor, recorder=recorder, controller=controller
        )
        self._arm, self._gripper = arm, gripper
        self._lab, self._clock = lab, clock
        self.supervisor = supervisor
        self._recorder = recorder
        self._lock = threading.Lock()
        self._goal: Pose | None = None
        self._speeds = (lab.arm.max_speed, math.radians(lab.arm.max_turn_speed_deg))
        self._observe_until = math.inf  # until then a caller must observe the pads again [s]
        self._unobserved = False  # a caller did not, and the arm holds
        self._part_lock = threading.Lock()  # of the following three; taken before `_lock`
        self._part_expected = False
        self._held: GripperState | None = None  # the gripper at the grasp
        self._part_lost = ""  # the evidence that the part was lost
        self._requested_stop = ""  # the reason, after `request_stop`
        self._ending = threading.Event()
        self._heights: deque[tuple[float, float]] = deque(maxlen=_HISTORY)
        self._checks_due = -math.inf  # time of their next record [s]
        self._cycles = 0
        self._flags = EgmFlag(0)
        self.on_cycles: Callable[[Sequence[EgmCycle]], None] = lambda cycles: None  # called with every cycle of EGM
        self.failure: GelflowError | None = None
        self._thread = threading.Thread(target=self._run, name="motion executor", daemon=True)

    def __enter__(self) -> "MotionExecutor":
        self._raise_failure()
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        """Hold; after an exception also stop and latch."""
        with contextlib.suppress(GelflowError):
            self.hold()
        self._ending.set()
        self._thread.join(2.0)
        if isinstance(error, Exception) and self.failure is None:
            self._fail(error)
        with contextlib.suppress(GelflowError):
            self._log()
            timing = self._arm.timing
            self._recorder.event("arm timing", timing._asdict() | {"missed": timing.missed})

    # Called from the runner's thread

    def pose(self) -> Pose:
        """Measured pose of the gripper frame in the base frame."""
        self._raise_failure()
        state = self._arm.state()
        return self._lab.gripper_pose(state.position, state.quaternion)

    def start_motion(
        self,
        target: Pose,
        *,
        speed: float | None = None,
        turn_speed: float | None = None,
        guarded: bool = False,
        age: float = 0.0,
    ) -> None:
        """Start a straight motion of the gripper frame to `target` and return.

        Speeds [m/s], [rad/s]; None: those of the lab file. `guarded` states that the caller observes both pads until
        the end of the motion, as `GuardedMotion` does, and calls `report_observation` each time; `age` is that of their
        images at the start [s]. Raises SafetyError when the supervisor refuses the target, when the phase allows no
        motion, and when a part is held and the motion is not guarded; the arm then holds.
        """
        self._raise_failure()
        self.supervisor.phases.require_motion()
        if self._part_expected and not guarded:
            raise SafetyError("target refused: a held part is moved only while both pads are observed")
        fastest = (self._lab.arm.max_speed, math.radians(self._lab.arm.max_turn_speed_deg))
        speeds = (fastest[0] if speed is None else speed, fastest[1] if turn_speed is None else turn_speed)
        try:
            with self._lock:  # so that no motion starts after `request_stop`
                self._check_requested_stop()
                if self._part_lost:
                    raise PartLost(self._part_lost)
                self._post(target, speeds)
                self._goal, self._speeds = target, speeds
                self._observe_until = self._next_observation(age) if guarded else math.inf
                self._unobserved = False
        except SafetyError:
            self.hold()
            raise
        stamp = self._clock.now()
        tool = self._lab.tool_pose(target)
        self._recorder.arm_command(stamp, tool.position, tool.quaternion, kind="command")
        self._recorder.event("move", {"speed": speeds[0], "turn_speed": speeds[1], "position": tool.position})

    def report_observation(self, age: float) -> bool:
        """The caller of a guarded motion has observed both pads, in images of at most this age [s].

        Returns False when the arm holds because this took too long: `start_motion` continues.
        """
        with self._lock:
            self._observe_until = self._next_observation(age)
            return not self._unobserved

    def _next_observation(self, age: float) -> float:
        """Time until which the pads must be observed again, after an observation in images of this age [s]."""
        return self._clock.now() + max(_LEAST_TIME, LIMITS.image_age - _HOLD_TIME - age)

    def hold(self) -> None:
        """Give up the target and come to rest; see `EgmArm.hold`."""
        with self._lock:
            self._goal, self._unobserved = None, False
            self._arm.hold()

    def arrived(self, *, within: float = ARRIVED[0]) -> bool:
        """Whether the arm is `within` [m] of the newest target."""
        goal = self._goal
        if goal is None:
            return False
        return self.pose().is_near(goal, within, ARRIVED[1])

    def move(self, target: Pose, *, speed: float | None = None) -> None:
        """Move to `target` and wait for the arrival. Raises PeerTimeout when the arm comes no closer for 3 s."""
        self.start_motion(target, speed=speed)
        approach = self.approach_monitor(target)
        while not self.arrived():
            approach.check()
            self.wait(0.02)

    def approach_monitor(self, target: Pose) -> ApproachMonitor:
        """Monitors from now on whether the arm comes closer to `target`."""
        return ApproachMonitor(self.pose, self.hold, target, self._clock)

    def wait(self, seconds: float) -> None:
        """Wait for `seconds` of robot time. Raises the failure of the thread, or PartLost."""
        self._clock.sleep(seconds)
        self._raise_failure()
        self._check_requested_stop()
        if self._part_lost:
            raise PartLost(self._part_lost)

    def expect_part(self, held: bool) -> None:
        """Set whether a part is held from now on. When it is lost, the arm holds and `wait` raises PartLost.

        A part is lost when the width of the grip or the grasp state changes from what the gripper reports now.
        """
        state = self._gripper.state()
        with self._part_lock:
            self._part_lost, self._held, self._part_expected = "", state, held

    def height_at(self, stamp: float) -> float:
        """Measured height of the gripper frame in the base frame at a robot time [m]."""
        state = self._arm.state()
        later = state.stamp, float(self._lab.gripper_pose(state.position, state.quaternion).position[2])
        if stamp >= later[0]:
            return later[1]
        with self._lock:
            for earlier in reversed(self._heights):  # an image is recent: few of the cycles are newer
                if earlier[0] <= stamp:
                    fraction = (stamp - earlier[0]) / (later[0] - earlier[0])
                    return earlier[1] + fraction * (later[1] - earlier[1])
                later = earlier
        return later[1]

    # Called from any thread

    def request_stop(self, reason: str) -> None:
        """Stop the arm, and fingers without a part, for the rest of the run: the arm holds before this call returns.

        For an operator's stop button, in addition to the robot's own. The next call of the runner raises SafetyError.
        """
        self._requested_stop = self._requested_stop or reason
        if self._thread.is_alive():
            with contextlib.suppress(GelflowError):
                self.hold()  # the thread stops the arm within its next cycle
        elif self.failure is None:
            try:
                self._check_requested_stop()
            except SafetyError as error:
                self._fail(error)

    # Thread

    def _run(self) -> None:
        raise_priority()
        period = self._lab.limits.target_lifetime / 4
        wait = max(self._clock.wall(_WATCH_PERIOD), _LEAST_WAIT)
        due = -math.inf  # of the next renewal of the target [s]
        while not self._ending.is_set():
            try:
                self._watch()
                now = self._clock.now()
                self._hold_unobserved(now)
                with self._lock:
                    goal, speeds = self._goal, self._speeds
                    if goal is not None and now >= due:
                        self._post(goal, speeds)
                        due = now + period
                self._log()
                self._record_checks(now)
            except Exception as error:  # noqa: BLE001 - a thread has no caller: the next call raises it
                self._fail(error)
                return
            self._ending.wait(wait)

    def _post(self, goal: Pose, speeds: tuple[float, float]) -> None:
        state = self._arm.state()
        now = self._lab.gripper_pose(state.position, state.quaternion)
        tool = self.supervisor.check(goal, now, speed=speeds[0], turn_speed=speeds[1])
        lifetime = self._lab.limits.target_lifetime
        self._arm.target(tool.position, tool.quaternion, lifetime=lifetime, speed=speeds[0], turn_speed=speeds[1])

    def _watch(self) -> None:
        """Raise when a stop was requested, data that motion relies on is stale, or a device reports a fault."""
        self._check_requested_stop()
        self.checks.test()
        self.watch_part()

    def _hold_unobserved(self, now: float) -> None:
        """Hold when the caller of a guarded motion has not observed the pads in time: its thread is delayed."""
        with self._lock:  # together with the test, so that no `start_motion` comes in between
            if self._goal is None or now <= self._observe_until or self.arrived():
                return
            self._unobserved, self._goal = True, None
            self._arm.hold()
        self._recorder.event("pads not observed", {})

    def _check_requested_stop(self) -> None:
        if self._requested_stop:
            raise SafetyError(with_advice(f"stopped: {self._requested_stop}"))

    def watch_part(self) -> None:
        """Hold when the gripper shows that the part is no longer held as it was grasped."""
        with self._part_lock:
            if self._part_expected and not self._part_lost:
                self._compare_grasp(self._gripper.state())

    def _compare_grasp(self, gripper: GripperState) -> None:
        assert self._held is not None
        change = gripper.width - self._held.width
        if gripper.grasp != self._held.grasp:
            self._part_lost = f"the gripper reports {gripper.grasp}, and {self._held.grasp} before"
        elif abs(change) > _WIDTH_CHANGE:
            self._part_lost = f"the grip width changed by {1e3 * change:+.2f} mm since the grasp: the part moved"
        if self._part_lost:
            self.hold()
            self._recorder.event("part lost", {"grasp": gripper.grasp, "width": gripper.width})

    def _log(self) -> None:
        records = self._arm.drain_log()
        self.on_cycles(records)
        with self._lock:
            self._heights.extend(zip((r.stamp for r in records), self._gripper_heights(records), strict=True))
        for record in records:
            self._cycles += 1
            if self._cycles % RECORD_EVERY == 0 or record.flags != self._flags:
                self._record(record)
            self._flags = record.flags
        record_events(self._arm, self._recorder)

    def _record_checks(self, now: float, *, always: bool = False) -> None:
        """Record the state of all checks from time to time."""
        if always or now >= self._checks_due:
            self._checks_due = now + _CHECKS_PERIOD
            self._recorder.checks(now, self.checks.states())

    def _gripper_heights(self, records: Sequence[EgmCycle]) -> list[float]:
        """Measured heights of the gripper frame in the base frame [m]: the third row of R t + p, vectorized."""
        if not records:
            return []
        w, x, y, z = np.array([record.measured[1] for record in records]).T
        rows = np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], axis=1)
        heights = rows @ np.array(self._lab.tool.position) + [record.measured[0][2] for record in records]
        return [float(height) for height in heights]

    def _record(self, record: EgmCycle) -> None:
        state = ArmState(
            position=np.array(record.measured[0]),
            quaternion=np.array(record.measured[1]),
            joints=np.array(record.joints),
            stamp=record.stamp,
            motors_on=EgmFlag.MOTORS_ON in record.flags,
            running=EgmFlag.FOLLOWING in record.flags,
            operating_mode="unknown" if self._controller is None else self._controller.operating_mode,
        )
        self._recorder.arm_state(state)
        if record.applied is not None:
            self._recorder.arm_command(record.stamp, record.applied[0], record.applied[1], kind="applied")

    def _fail(self, error: Exception) -> None:
        """Hold within this cycle, then stop the arm, and the fingers unless they may hold a part, which stays held."""
        known = isinstance(error, GelflowError)
        self.failure = error if isinstance(error, GelflowError) else PeerError(f"{type(error).__name__}: {error}")
        reason = str(self.failure)
        for action in (
            self.hold,
            lambda: self.supervisor.latch(reason),
            lambda: self._gripper.forbid_motion(reason),
            lambda: self._arm.stop(reason),
            lambda: self._stop_empty_fingers(reason),
            self._log,
            lambda: self._record_checks(self._clock.now(), always=True),
        ):
            # The first failure is reported; errors of the remaining actions are not.
            with contextlib.suppress(GelflowError):
                action()
        with contextlib.suppress(GelflowError):
            self._recorder.event("stopped", {"reason": str(self.failure), "expected": known})

    def _stop_empty_fingers(self, reason: str) -> None:
        if self._part_expected:
            return
        in_motion, state = self._gripper.forbid_motion(reason), None
        with contextlib.suppress(GelflowError):  # its data are old
            state = self._gripper.state()
        if in_motion:
            free = state is None or state.grasp != "holding"
        else:
            free = state is not None and (fingers_move(state) or not may_hold_part(state, grasped=False))
        if free:
            self._gripper.stop()

    def _raise_failure(self) -> None:
        if self.failure is not None:
            raise type(self.failure)(*self.failure.args) from self.failure
