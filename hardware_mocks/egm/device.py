"""Mock IRB 120 on the wire: sends EGM feedback over UDP every 4 ms and follows the references in the answers.

The mock simulates the controller and its RAPID program (docs/guide/arm.md shows the real one): EGM waits for the first
answer, runs until no answer arrives for CommTimeout, and is restarted by the program one second later with a new
message count. The joints follow with a lag and the speed limit of MaxSpeedDeviation; the pose goes to an `ArmPlant`.

The controller runs in a helper process (`gelflow.hardware_mocks.egm.controller`) and exchanges only poses with the
plant, so that its 4 ms cycle does not depend on the simulation and the cameras. With time synchronization, robot time
waits for the controller and for the plant.
"""

import select
import threading
from dataclasses import asdict
from typing import Any

import numpy as np

from gelflow.clock import ScaledClock
from gelflow.errors import PeerError, PeerTimeout, SafetyError, UsageError
from gelflow.geometry import PoseTuple
from gelflow.hardware_mocks.egm.controller import MockEgmConfig, MockEgmReport, joints_of
from gelflow.hardware_mocks.plant import ArmPlant
from gelflow.helper_process import HelperProcess

_REPLY_TIMEOUT = 10.0  # of the helper process, including its start [s, wall]


class MockEgmArm:
    """The mock arm. Use `start` and `stop`; the other methods act as the operator or inject faults.

    Each of them has taken effect when it returns, and raises PeerError when the controller's process has ended.
    """

    def __init__(self, plant: ArmPlant, *, clock: ScaledClock, config: MockEgmConfig | None = None) -> None:
        self._plant = plant
        self._clock = clock
        self._config = config or MockEgmConfig()
        self._helper: HelperProcess | None = None
        self._thread: threading.Thread | None = None
        self._quit = threading.Event()
        self._replied = threading.Condition()
        self._replies: dict[int, MockEgmReport] = {}
        self._asked = 0

    def start(self) -> None:
        """Start to send feedback. Raises UsageError when the plant's pose is out of reach of the arm."""
        if self._helper is not None:
            raise UsageError("the mock arm is already running")
        pose = self._pose()
        try:
            joints_of(self._config, pose, self._config.near)
        except SafetyError as error:
            raise UsageError(f"the mock arm cannot start at the pose of its plant: {error}") from None
        settings = {"clock": self._clock.settings, "config": asdict(self._config), "pose": pose}
        self._quit.clear()
        self._helper = HelperProcess.start("gelflow.hardware_mocks.egm.controller", settings)
        self._thread = threading.Thread(target=self._serve, args=(self._helper,), name="mock-egm", daemon=True)
        self._thread.start()
        try:
            self._call("report")
        except PeerError:
            self.stop()
            raise

    def stop(self) -> None:
        """Stop sending, as a controller that is switched off. Raises PeerError when its process has ended before."""
        if self._helper is not None and self._thread is not None:
            self._quit.set()
            self._thread.join()
            helper, self._helper, self._thread = self._helper, None, None
            helper.messages.read()  # notices that the process has ended
            error = _ended(helper) if helper.messages.closed else None
            helper.close()
            if error is not None:
                raise error

    @property
    def report(self) -> MockEgmReport:
        """Counters and states of the controller so far."""
        return self._call("report")

    @property
    def running(self) -> bool:
        """Whether the process of the controller runs."""
        return self._helper is not None and self._helper.running

    @property
    def pid(self) -> int | None:
        """Process id of the controller; None when it is not running."""
        return None if self._helper is None else self._helper.pid

    def motors(self, on: bool) -> None:
        """Switch the motors, as an emergency stop or the operator does."""
        self._call("motors", on)

    def rapid(self, running: bool) -> None:
        """Stop or start the RAPID program."""
        self._call("rapid", running)

    def restart_sequence(self) -> None:
        """Restart the message count in the middle of a session."""
        self._call("restart_sequence")

    def lose(self, count: int = 0, *, share: float = 0.0) -> None:
        """Drop the next `count` messages, and from now on a random fraction `share` (0 to 1) of all messages."""
        self._call("lose", count, share)

    def silence(self, seconds: float) -> None:
        """Neither send nor receive for `seconds` of robot time."""
        self._call("silence", seconds)

    def begin_fault(self, number: int, kind: str, direction: str, values: dict[str, Any]) -> None:
        """Begin a fault of the arm (freeze, stall, disconnect) or of its messages (`MESSAGE_KINDS`), with parameters.

        `direction` is "out" (feedback), "in" (references) or "both".
        """
        self._call("begin_fault", number, kind, direction, values)

    def end_fault(self, number: int) -> None:
        """End the fault with this number."""
        self._call("end_fault", number)

    def _call(self, name: str, *values: Any) -> MockEgmReport:
        helper = self._helper
        if helper is None:
            raise UsageError("the mock arm is not running; call start() first")
        with self._replied:
            self._asked += 1
            number = self._asked
            try:
                helper.messages.send(["do", number, name, *values])
            except OSError:
                raise _ended(helper) from None
            self._replied.wait_for(lambda: number in self._replies or helper.messages.closed, _REPLY_TIMEOUT)
            if number in self._replies:
                return self._replies.pop(number)
        if helper.messages.closed:
            raise _ended(helper)
        raise PeerTimeout(f"the mock controller's process did not answer within {_REPLY_TIMEOUT} s")

    def _serve(self, helper: HelperProcess) -> None:
        """Forward commands to the plant and its pose to the controller; runs in a thread."""
        while not self._quit.is_set() and not helper.messages.closed:
            select.select((helper.messages,), (), (), 0.1)
            asked = False
            for kind, *values in helper.messages.read():
                if kind == "cycle":
                    asked = True
                    if values[0] is not None:
                        self._plant.command_arm(*map(np.array, values[0]))
                else:
                    with self._replied:
                        self._replies[values[0]] = MockEgmReport(**values[1])
                        self._replied.notify_all()
            if asked and not helper.messages.closed:
                self._answer(helper)
        with self._replied:
            self._replied.notify_all()

    def _answer(self, helper: HelperProcess) -> None:
        try:
            helper.messages.send(["pose", *self._pose()])
        except OSError:
            # The controller has just ended: the next read detects it, and the next call raises.
            return

    def _pose(self) -> PoseTuple:
        position, quaternion = self._plant.arm_pose()
        (x, y, z), (a, b, c, d) = position.tolist(), quaternion.tolist()
        return (x, y, z), (a, b, c, d)


def _ended(helper: HelperProcess) -> PeerError:
    return PeerError(f"the mock controller's process has ended ({helper.exit_reason()})")
