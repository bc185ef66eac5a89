"""Executes a fault plan on the devices of the mock robot."""

import math
import random
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from gelflow.clock import ScaledClock
from gelflow.errors import GelflowError, PeerError, UsageError
from gelflow.hardware_mocks.camera.device import MockMjpegCamera
from gelflow.hardware_mocks.egm.device import MockEgmArm
from gelflow.hardware_mocks.faults.plan import KINDS, Fault, FaultPlan
from gelflow.hardware_mocks.simulated_cell.insertion_progress import PHASES, InsertionProgress
from gelflow.hardware_mocks.simulated_cell.process import SimulatedCellProcess
from gelflow.hardware_mocks.wsg.device import MockWsgGripper
from gelflow.task import InsertionTask
from gelflow.time_sync import MIN_WAIT

_STOPS = ("emergency_stop", "motors_off", "rapid_stop")  # of the arm
_PERIOD = 0.002  # of the checks for events [s]
_AFTER_START = 0.1e-3  # below the start of descent and lowering they have begun, for faults without `below` [m]


@dataclass(frozen=True)
class Devices:
    """The devices of a mock robot, and the faults that are active on them."""

    arm: MockEgmArm
    gripper: MockWsgGripper
    cameras: tuple[MockMjpegCamera, ...]
    cell: SimulatedCellProcess
    _active: dict[int, Fault] = field(default_factory=dict)

    def begin(self, number: int, fault: Fault) -> None:
        """Begin a fault under this number."""
        self._active[number] = fault
        if fault.device == "arm":
            self._begin_arm(number, fault)
        elif fault.device == "gripper":
            self._begin_gripper(number, fault)
        elif fault.device == "world":
            self._begin_world(number)
        else:
            for camera in self._chosen(fault.device):
                camera.begin_fault(number, fault.kind, fault.values)

    def end(self, number: int, fault: Fault) -> None:
        """End a fault; an emergency stop is released, and the controller may start EGM again."""
        self._active.pop(number, None)
        if fault.device == "arm":
            if fault.kind in _STOPS:
                self._set_stops()
            else:
                self.arm.end_fault(number)
        elif fault.device == "gripper":
            self.gripper.end_fault(number)  # FAST STOP remains until it is acknowledged
        elif fault.device == "world":
            self._set_world()
        else:
            for camera in self._chosen(fault.device):
                camera.end_fault(number)

    def _begin_arm(self, number: int, fault: Fault) -> None:
        if fault.kind == "restart":
            self.arm.restart_sequence()
        elif fault.kind in _STOPS:
            self._set_stops()
        else:
            self.arm.begin_fault(number, fault.kind, fault.direction, fault.values)

    def _begin_gripper(self, number: int, fault: Fault) -> None:
        if fault.kind == "emergency_stop":
            self.gripper.raise_fast_stop()
        elif fault.kind == "lose_part":
            self.gripper.lose_part()
        else:
            self.gripper.begin_fault(number, fault.kind, fault.direction, fault.values)

    def _set_stops(self) -> None:
        """Motors and program run unless an active fault stops them."""
        kinds = {fault.kind for fault in self._active.values() if fault.device == "arm"}
        self.arm.motors(not kinds & {"emergency_stop", "motors_off"})
        self.arm.rapid(not kinds & {"emergency_stop", "rapid_stop"})

    def _begin_world(self, number: int) -> None:
        try:
            self._set_world()
        except UsageError:  # a value would leave its limits: the fault does not begin
            del self._active[number]
            raise

    def _set_world(self) -> None:
        factors = {"stiff_gel": 1.0, "slip": 1.0}
        for fault in self._active.values():
            if fault.device == "world":
                factors[fault.kind] *= fault.values["factor"]
        self.cell.change_world(gel_stiffness=factors["stiff_gel"], pad_friction=factors["slip"])

    def _chosen(self, device: str) -> tuple[MockMjpegCamera, ...]:
        return self.cameras if device == "cameras" else (self.cameras[device == "right_camera"],)


def event_occurred(fault: Fault, progress: InsertionProgress, task: InsertionTask) -> bool:
    """Whether the event of a fault has occurred in the insertion `task`."""
    gripped = progress.phase == PHASES.index("gripped")
    if fault.event == "gripped":
        return gripped
    if fault.event == "released":
        return progress.phase == PHASES.index("released")
    if fault.event == "approach":
        return progress.approaching
    if not gripped or progress.attempts < fault.attempt:
        return False
    if fault.event == "attempt":
        return True
    if fault.below is not None:
        return progress.height < fault.below
    start = task.start_height - (task.descent if fault.event == "lowering" else 0)
    return progress.height < start - _AFTER_START


class Occurrence:
    """The state of one fault of the plan: when it begins next, and when it ends."""

    def __init__(self, number: int, fault: Fault, task: InsertionTask) -> None:
        self.number, self.fault, self._task = number, fault, task
        self._random = random.Random(f"begin {fault.seed}")
        self._due: float | None = None  # of the next start [s]
        self._done = False
        self._end = math.inf  # while it is active [s]
        self.active = False

    def begins(self, now: float, progress: InsertionProgress) -> bool:
        """Whether it begins now; `now` is robot time [s]."""
        fault = self.fault
        if self.active or self._done or not progress.started <= now:  # started is NaN before the first command
            return False
        if self._due is None:
            if fault.rate > 0:
                self._due = now + self._random.expovariate(fault.rate)
            elif fault.at is not None:
                self._due = progress.started + fault.at
            elif event_occurred(fault, progress, self._task):
                self._due = now + fault.after
        if self._due is None or now < self._due:
            return False
        self.active, self._due = not KINDS[fault.kind].momentary, None
        self._end = now + fault.duration
        self._done = fault.rate == 0
        return True

    def ends(self, now: float) -> bool:
        """Whether it ends now."""
        if not self.active or now < self._end:
            return False
        self.active = False
        return True


class FaultInjector:
    """Begins and ends the faults of a plan in a thread. Use `start` and `stop`."""

    def __init__(self, plan: FaultPlan, devices: Devices, clock: ScaledClock, task: InsertionTask) -> None:
        self._devices, self._clock = devices, clock
        self._occurrences = [Occurrence(number, fault, task) for number, fault in enumerate(plan.faults)]
        self._ending = threading.Event()
        self._thread: threading.Thread | None = None
        self._failure: Exception | None = None
        self.log: list[dict[str, Any]] = []  # begins and ends: time [s], fault, what

    def start(self) -> None:
        """Start to watch for the times and events of the plan."""
        self._thread = threading.Thread(target=self._run, name="faults", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Stop; active faults stay active. Raises PeerError when the injector has failed."""
        self._ending.set()
        if self._thread is not None:
            self._thread.join()
        if self._failure is not None:
            raise PeerError(f"a fault could not be injected: {self._failure}") from self._failure

    def _run(self) -> None:
        try:
            self._watch()
        except Exception as error:  # noqa: BLE001 - `stop` raises it
            self._failure = error

    def _watch(self) -> None:
        wait = max(self._clock.wall(_PERIOD), MIN_WAIT)
        while not self._ending.wait(wait):
            now, progress = self._clock.now(), self._devices.cell.progress()
            for occurrence in self._occurrences:
                if occurrence.ends(now):
                    self._do("end", occurrence, self._devices.end)
                elif occurrence.begins(now, progress):
                    self._do("begin", occurrence, self._devices.begin)

    def _do(self, what: str, occurrence: Occurrence, action: Callable[[int, Fault], None]) -> None:
        entry = {"time": self._clock.now(), "fault": str(occurrence.fault), "what": what}
        try:
            action(occurrence.number, occurrence.fault)
        except GelflowError as error:
            entry["error"] = str(error)
        self.log.append(entry)
