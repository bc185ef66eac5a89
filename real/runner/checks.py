"""The checks of all data that motion relies on, as a table: each has a name, a test and its present state in words."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from gelflow.clock import Clock
from gelflow.errors import GelflowError, PeerError, PeerTimeout
from gelflow.protocols import Camera, Gripper
from gelflow.real.egm.driver import EgmArm
from gelflow.real.runner.lab import Lab
from gelflow.real.runner.supervisor import Supervisor
from gelflow.real.web_services.monitor import ControllerMonitor
from gelflow.session.recorder import SessionRecorder
from gelflow.session.records import SENSORS


@dataclass(frozen=True)
class Check:
    """One check. `test` raises a GelflowError when it fails; `state` describes the present values."""

    name: str
    test: Callable[[], None]
    state: Callable[[], str]


@dataclass(frozen=True)
class CheckState:
    """The state of a check at one time."""

    name: str
    ok: bool
    text: str


class DataChecks:
    """Checks of a running cell, in the order in which they are tested."""

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
        controller: ControllerMonitor | None,
    ) -> None:
        self._arm, self._gripper, self._clock, self._lab = arm, gripper, clock, lab
        self._supervisor, self._recorder = supervisor, recorder
        self.table: list[Check] = [Check("arm", self._test_arm, self._arm_state)]
        if controller is not None:
            self.table.append(Check("controller", controller.check, lambda: f"mode {controller.operating_mode}"))
        self.table += [
            Check("measured pose", self._test_pose, self._pose_state),
            Check("recording", recorder.check, lambda: f"{recorder.delay:.2f} s behind"),
            *(self._camera_check(sensor, camera) for sensor, camera in zip(SENSORS, cameras, strict=False)),
            Check("gripper", self._test_gripper, self._gripper_state),
        ]

    def test(self) -> None:
        """Test everything. Raises the error of the first check that fails."""
        for check in self.table:
            check.test()

    def states(self) -> list[CheckState]:
        """The state of every check, including those after a failed one, and of the bounds of the last target."""
        found = [_state(check) for check in self.table]
        latched = self._supervisor.latched
        found.append(
            CheckState("motion", not latched, f"stopped: {latched.removeprefix('stopped: ')}" if latched else "allowed")
        )
        return found + [CheckState(f"target: {b.name}", b.ok, b.text) for b in self._supervisor.last_bounds]

    def _camera_check(self, sensor: str, camera: Camera) -> Check:
        def state() -> str:
            return f"newest image {1e3 * (self._clock.now() - camera.latest().stamp):.0f} ms old"

        def test() -> None:
            camera.latest()

        return Check(f"{sensor} camera", test, state)

    def _test_arm(self) -> None:
        self._supervisor.watch(self._arm.state())

    def _arm_state(self) -> str:
        state = self._arm.state()
        return f"motors {'on' if state.motors_on else 'off'}, program {'running' if state.running else 'stopped'}"

    def _test_pose(self) -> None:
        now = self._clock.now()  # before the state is read: a delay of this thread in between is no age
        age, limit = now - self._arm.state().stamp, self._lab.limits.stale_pose
        if age > limit:
            raise PeerTimeout(f"the arm's pose is {1e3 * age:.0f} ms old, at most {1e3 * limit:.0f} ms is allowed")

    def _pose_state(self) -> str:
        age = self._clock.now() - self._arm.state().stamp
        return f"{1e3 * age:.0f} ms old, at most {1e3 * self._lab.limits.stale_pose:.0f} ms"

    def _test_gripper(self) -> None:
        if fault := self._gripper.state().fault:
            raise PeerError(f"the gripper reports {fault}; inspect it before anything moves again")

    def _gripper_state(self) -> str:
        state = self._gripper.state()
        return f"{state.grasp}, {1e3 * state.width:.1f} mm, {1e3 * (self._clock.now() - state.stamp):.0f} ms old"


def _state(check: Check) -> CheckState:
    try:
        check.test()
        return CheckState(check.name, True, check.state())
    except GelflowError as error:
        return CheckState(check.name, False, str(error))
