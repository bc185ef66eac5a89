"""Endurance of EGM at 250 Hz: the mock robot in this process; cameras, tracking, motion and recording in another."""

import contextlib
import itertools
import json
import math
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from gelflow.errors import PeerError, PeerTimeout
from gelflow.geometry import Pose
from gelflow.measurement.machine import processor
from gelflow.measurement.stalls import StallWatch, overlaps
from gelflow.mock_lab.promises.report import load
from gelflow.mock_lab.promises.rig import Rig, near_seed
from gelflow.real.egm.cycle_log import EgmCycle
from gelflow.real.egm.reference_generator import EgmFlag
from gelflow.real.runner.cell import Cell, open_cell
from gelflow.real.runner.lab import Lab
from gelflow.real.runner.lab_file import load_lab, save_lab
from gelflow.real.runner.motion_executor import MotionExecutor
from gelflow.real.runner.phases import Phase
from gelflow.real.runner.run_plan import create_motion
from gelflow.real.runner.touch.observer import TactileObserver
from gelflow.session.recorder import SessionRecorder

BOUND = 0.001  # largest fraction of missed cycles
_PERIOD = 0.004  # of EGM [s]
_STROKE, _SPEED = 2e-3, 1e-3  # of the motion up and down [m], [m/s]
_PROGRESS_PERIOD = 1.0  # [s]
_START_LIMIT = 60.0  # of the runner's process in addition to the measured time [s]


@dataclass
class CycleStatistics:
    """Counts and times of all cycles of EGM."""

    cycles: int = 0  # messages received and answered
    lost: int = 0  # messages that did not arrive
    unanswered: int = 0  # messages that a newer one had overtaken
    missed: list[tuple[float, float, int]] = field(default_factory=list)  # start and end [s], number of missed cycles
    intervals: list[float] = field(default_factory=list)  # between two receptions [s]
    latencies: list[float] = field(default_factory=list)  # from reception to answer [s]
    _last: EgmCycle | None = None

    def add(self, cycles: Sequence[EgmCycle]) -> None:
        """Add cycles in the order of their reception."""
        for cycle in cycles:
            if self._last is not None:
                self._miss(self._last.stamp, cycle.stamp, lost=max(0, cycle.sequence - self._last.sequence - 1))
                self.intervals.append(cycle.stamp - self._last.stamp)
            unanswered = EgmFlag.UNANSWERED in cycle.flags or math.isnan(cycle.answered)
            self._miss(cycle.stamp - _PERIOD, cycle.stamp, unanswered=int(unanswered))
            self.cycles += not unanswered
            if not unanswered:
                self.latencies.append(cycle.answered - cycle.stamp)
            self._last = cycle

    def stop(self, silence: float) -> None:
        """Count a stop after `silence` [s] without a message: its cycles are lost, the next one is a new start."""
        begin = math.inf if self._last is None else self._last.stamp  # inf: before any message, overlaps no stall
        self._miss(begin, begin + silence, lost=round(silence / _PERIOD))
        self._last = None

    def _miss(self, begin: float, end: float, *, lost: int = 0, unanswered: int = 0) -> None:
        self.lost += lost
        self.unanswered += unanswered
        if lost + unanswered:
            self.missed.append((begin, end, lost + unanswered))

    def summary(self) -> dict[str, float]:
        """Fraction of missed cycles, and times in milliseconds."""
        jitter = 1e3 * np.abs(np.array(self.intervals or [math.nan]) - _PERIOD)
        latency = 1e3 * np.array(self.latencies or [math.nan])
        total = self.cycles + self.lost + self.unanswered
        return {
            "cycles": self.cycles,
            "lost": self.lost,
            "unanswered": self.unanswered,
            "missed": (self.lost + self.unanswered) / max(1, total),
            "jitter_median_ms": float(np.median(jitter)),
            "jitter_99_ms": float(np.percentile(jitter, 99)),
            "jitter_max_ms": float(jitter.max()),
            "latency_median_ms": float(np.median(latency)),
            "latency_99_ms": float(np.percentile(latency, 99)),
            "latency_max_ms": float(latency.max()),
        }


@dataclass(frozen=True)
class Endurance:
    """Result of an endurance run."""

    seconds: float
    cycles: dict[str, float]  # see `CycleStatistics.summary`
    images: tuple[int, int]  # tracked of each camera
    recorded: int  # bytes
    late: int  # cycles that the mock controller skipped, because this computer was busy
    stalls: list[float]  # lengths of the stalls of this computer [s], see `gelflow.measurement.stalls`
    missed_in_stalls: int  # missed cycles that overlap a stall
    stops: list[str]  # reasons why the arm was stopped; it was connected again each time
    load_before: float | None
    load_after: float | None

    @property
    def missed(self) -> float:
        """Fraction of the cycles that were sent and not answered in time."""
        return self.cycles["missed"]

    @property
    def missed_by_program(self) -> float:
        """Fraction of the cycles that were missed while this computer did not stall."""
        c = self.cycles
        total = c["cycles"] + c["lost"] + c["unanswered"]
        return (c["lost"] + c["unanswered"] - self.missed_in_stalls) / max(1.0, total)

    def to_json(self) -> dict[str, Any]:
        """As JSON data, with the computer."""
        return {"processor": processor(), "bound": BOUND, **asdict(self)}

    def lines(self) -> list[str]:
        """The result as text."""
        c = self.cycles
        return [
            f"{self.seconds:.0f} s of EGM: {c['cycles']:.0f} cycles answered; missed {100 * self.missed:.3f} % "
            f"(at most {100 * BOUND:g} %): {c['lost']:.0f} lost, {c['unanswered']:.0f} overtaken",
            f"interval of the messages, deviation from 4 ms: median {c['jitter_median_ms']:.3f}, "
            f"99 % {c['jitter_99_ms']:.3f}, largest {c['jitter_max_ms']:.1f} ms",
            f"answer after: median {c['latency_median_ms']:.3f}, 99 % {c['latency_99_ms']:.3f}, "
            f"largest {c['latency_max_ms']:.1f} ms",
            f"stalls of this computer, in which no program ran: {len(self.stalls)}, in total {sum(self.stalls):.1f} s, "
            f"the longest {1e3 * max(self.stalls, default=0.0):.0f} ms; {self.missed_in_stalls} cycles were missed in "
            f"them, {100 * self.missed_by_program:.3f} % outside them",
            f"tracked images: {self.images[0]} and {self.images[1]}; recorded {self.recorded / 1e6:.1f} MB; the mock "
            f"controller skipped {self.late} cycles; load before {self.load_before}, after {self.load_after}",
            *(f"stopped, then connected again: {reason}" for reason in self.stops),
        ]


def measure_endurance(seconds: float, progress: Callable[[float], object] = lambda elapsed: None) -> Endurance:
    """Run for `seconds`; `progress` is called with the time since the start [s].

    Raises PeerError with its last line when the runner's process ends with an error.
    """
    before = load()
    with tempfile.TemporaryDirectory(prefix="gelflow-egm-") as name, Rig(Path(name), seed=near_seed()) as rig:
        save_lab(rig.lab, rig.folder / "lab.toml", title="Written by gelflow soak --egm.")
        arguments = [sys.executable, "-m", "gelflow.mock_lab.promises.endurance", str(rig.folder), repr(seconds)]
        late = rig.robot.arm.report.late
        with StallWatch() as watch:
            values = json.loads(_run(arguments, seconds + _START_LIMIT, progress))
        recorded = os.path.getsize(rig.folder / "session.mcap")
        late = rig.robot.arm.report.late - late
    missed_in_stalls = sum(n for begin, end, n in values["missed"] if overlaps((begin, end), watch.intervals))
    return Endurance(
        seconds,
        values["cycles"],
        tuple(values["images"]),
        recorded,
        late,
        [end - begin for begin, end in watch.intervals],
        missed_in_stalls,
        values["stops"],
        before,
        load(),
    )


def _run(arguments: list[str], limit: float, progress: Callable[[float], object]) -> bytes:
    """Standard output of a process that may take `limit` seconds."""
    begin = time.monotonic()
    with subprocess.Popen(arguments, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        try:
            while (elapsed := time.monotonic() - begin) < limit:
                with contextlib.suppress(subprocess.TimeoutExpired):
                    output, errors = process.communicate(timeout=_PROGRESS_PERIOD)
                    break
                progress(elapsed)
            else:
                raise PeerError(f"the endurance run did not end within {limit:.0f} s")
        finally:
            process.kill()
    if process.returncode != 0:
        lines = errors.decode(errors="replace").strip().splitlines()
        raise PeerError(f"the endurance run ended early: {lines[-1] if lines else 'no reason given'}")
    return output


def run_devices(folder: Path, seconds: float) -> dict[str, Any]:
    """Connect, move up and down, track both cameras and record, for `seconds`; the counts of the cycles.

    After a stop because of an old pose, image or gripper state, everything is connected again.
    """
    lab = load_lab(folder / "lab.toml")
    statistics, images, stops = CycleStatistics(), [0, 0], []
    end = time.monotonic() + seconds
    with SessionRecorder(folder / "session.mcap", lab.clock, max_delay=lab.limits.recording_delay).open() as recorder:
        recorder.metadata({})
        while time.monotonic() < end:
            try:
                _run_until(end, lab, recorder, statistics, images)
            except PeerTimeout as error:
                statistics.stop(lab.limits.stale_pose)
                stops.append(str(error))
    return {"cycles": statistics.summary(), "missed": statistics.missed, "images": images, "stops": stops}


def _run_until(end: float, lab: Lab, recorder: SessionRecorder, statistics: CycleStatistics, images: list[int]) -> None:
    """Connect and move until the time `end` [s, wall]; adds to the statistics and to the number of tracked images."""
    with open_cell(lab, recorder) as cell:
        cell.arm.wait_following(5.0)
        supervisor, motion = create_motion(cell)
        motion.on_cycles = statistics.add
        supervisor.phases.enter(Phase.LOAD)
        with motion:
            _move_and_track(cell, motion, end, images)


def _move_and_track(cell: Cell, motion: MotionExecutor, end: float, images: list[int]) -> None:
    """Move up and down while all images are tracked; adds the number of tracked images of each camera to `images`."""
    mounts = (cell.lab.cameras.left.mount, cell.lab.cameras.right.mount)
    observer = TactileObserver(cell.cameras, mounts, clock=cell.clock, stale=cell.lab.limits.stale_frame)
    observer.start(cell.clock.now())
    start = motion.pose()
    for up in itertools.cycle((True, False)):
        target = Pose(start.position + np.array([0.0, 0.0, _STROKE if up else 0.0]), start.quaternion)
        motion.start_motion(target, speed=_SPEED)
        while not motion.arrived():
            motion.wait(0.0)
            before = [len(tracked) for tracked in observer.tracked]
            observer.update()
            for sensor, tracked in enumerate(observer.tracked):
                images[sensor] += len(tracked) - before[sensor]
            if time.monotonic() > end:
                return


def main(arguments: Sequence[str]) -> int:
    """Entry point of the runner's process; writes the counts as JSON to standard output."""
    sys.setswitchinterval(5e-4)  # as `gelflow run` does
    sys.stdout.write(json.dumps(run_devices(Path(arguments[0]), float(arguments[1]))) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
