"""The robot's side of EGM: an IRB 120 that sends its feedback over UDP every 4 ms and follows what it is answered.

It plays the controller together with its RAPID program (docs/guide/arm.md): EGM waits for the first answer,
runs until answers stay out for CommTimeout, and is started again by the program a second later, with a new message
count. Motion goes through the joints (lag, then the speed limit of MaxSpeedDeviation) to an `ArmPlant`.

As on a robot, the controller keeps its 4 ms whatever the physics and the cameras cost: it runs in a process of its own
(`egm_controller`), and only poses go back and forth. A paced clock waits for it and for the plant's answers.
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

_REPLY_LIMIT = 10.0  # of our own process, its start included [s, wall]


class MockEgmArm:
    """The controller on the wire. `start` and `stop`; the other methods are the operator and the faults.

    Each of those takes effect before it returns, and raises PeerError when the controller's process is gone.
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
        """Begin to send. Raises UsageError when the plant stands where the arm can't reach."""
        if self._helper is not None:
            raise UsageError("the mock EGM robot runs already")
        pose = self._pose()
        try:
            joints_of(self._config, pose, self._config.near)
        except SafetyError as error:
            raise UsageError(f"the mock arm cannot start where its plant is: {error}") from None
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
        """Cease sending: as if the controller were switched off."""
        if self._helper is not None and self._thread is not None:
            self._quit.set()
            self._thread.join()
            self._helper.close()
            self._helper = self._thread = None

    @property
    def report(self) -> MockEgmReport:
        """What the controller saw so far."""
        return self._call("report")

    @property
    def pid(self) -> int | None:
        """Of the controller's process; None when it is not running."""
        return None if self._helper is None else self._helper.pid

    def motors(self, on: bool) -> None:
        """Switch the motors, as an emergency stop or the operator does."""
        self._call("motors", on)

    def rapid(self, running: bool) -> None:
        """Stop or start the RAPID program."""
        self._call("rapid", running)

    def restart_sequence(self) -> None:
        """Begin to count messages anew in the middle of a session."""
        self._call("restart_sequence")

    def lose(self, count: int = 0, *, share: float = 0.0) -> None:
        """Lose the next `count` messages on the way, and from now on a random `share` (0 to 1) of all."""
        self._call("lose", count, share)

    def silence(self, seconds: float) -> None:
        """Send and hear nothing for `seconds` of robot time."""
        self._call("silence", seconds)

    def _call(self, name: str, *values: Any) -> MockEgmReport:
        helper = self._helper
        if helper is None:
            raise UsageError("the mock EGM robot is not running; call start() first")
        with self._replied:
            self._asked += 1
            number = self._asked
            try:
                helper.messages.send(["do", number, name, *values])
            except OSError:
                raise PeerError(f"the mock controller's process is gone ({helper.exit_reason()})") from None
            self._replied.wait_for(lambda: number in self._replies or helper.messages.closed, _REPLY_LIMIT)
            if number in self._replies:
                return self._replies.pop(number)
        if helper.messages.closed:
            raise PeerError(f"the mock controller's process is gone ({helper.exit_reason()})")
        raise PeerTimeout(f"the mock controller's process did not answer within {_REPLY_LIMIT} s")

    def _serve(self, helper: HelperProcess) -> None:
        """The plant's side: moves it, and says where it is."""
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
            # It ended just now; the next read says so, and whoever asks it anything is told.
            return

    def _pose(self) -> PoseTuple:
        position, quaternion = self._plant.arm_pose()
        (x, y, z), (a, b, c, d) = position.tolist(), quaternion.tolist()
        return (x, y, z), (a, b, c, d)
