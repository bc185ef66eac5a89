"""Scenarios with a fault during a run: the time from the fault to the hold of the arm, and what follows."""

import contextlib
import math
import os
import signal
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from gelflow.hardware_mocks.robot import MockRobot
from gelflow.hardware_mocks.simulated_cell.insertion_progress import InsertionProgress
from gelflow.hardware_mocks.simulated_cell.world import TaughtError, World
from gelflow.mock_lab.promises.outcome import Outcome, conditions
from gelflow.mock_lab.promises.rig import Rig, Run, RunningRunner, end_after, far_seed, gripped, in_descent, near_seed
from gelflow.session.reader import SessionReader
from gelflow.session.recovery import recover

_AT_REST = 5e-6  # motion of an arm at rest [m]
_SETTLING = 0.15  # from a hold to rest [s]

Fault = Callable[[MockRobot], object]
Scenario = Callable[[Path], Outcome]
Condition = Callable[[InsertionProgress], bool]


def robot_fault(fault: Fault, reason: str, *, when: Condition = in_descent, latches: bool = False) -> Scenario:
    """Time from a fault of the robot to the hold, or with `latches` to the stop of the transmission [ms]."""

    def scenario(folder: Path) -> Outcome:
        with Rig(folder, seed=near_seed()) as rig:
            run = rig.run(lambda process: fault(rig.robot), when=when)
            stop = run.first("arm stopped", after=run.at) if latches else None
            stopped = stop.time if stop is not None else math.inf if latches else run.stop(run.at)
            return Outcome(1e3 * (stopped - run.at), _ended_safely(rig, run, reason))

    return scenario


def interrupted(number: signal.Signals) -> Scenario:
    """Time from a signal to the hold [ms]."""

    def scenario(folder: Path) -> Outcome:
        with Rig(folder, seed=near_seed()) as rig:
            run = rig.run(lambda process: process.signal(number), when=in_descent)
            broken = conditions(
                exit_status_is_that_of_the_signal=run.exit_code == 128 + number,
                recording_is_complete=bool(run.events),
                part_is_still_held=rig.still_holds_the_part(),
                gripper_is_not_in_fast_stop=not rig.robot.gripper.fast_stopped,
            )
            return Outcome(1e3 * (run.stop(run.at) - run.at), broken)

    return scenario


def blind(kind: str, *, when: Condition = in_descent) -> Scenario:
    """Time from the last new image of a camera to the hold, after a fault of its images [ms]."""

    def scenario(folder: Path) -> Outcome:
        with Rig(folder, seed=near_seed()) as rig:
            values = {"loop": 1} if kind == "freeze" else {}
            run = rig.run(lambda process: rig.robot.cameras[1].begin_fault(1, kind, values), when=when)
            hold = run.stop(run.at)
            unreadable = run.first("pad not readable", after=run.at)
            if kind == "blacken":
                last = unreadable.time - unreadable.values["seconds"] if unreadable is not None else -math.inf
            else:
                last = _last_new_image(run)
            return Outcome(1e3 * (hold - last), _ended_safely(rig, run, "right"))

    return scenario


def lost_packets(folder: Path) -> Outcome:
    """Time by which the hold is later than the time-out of the pose [ms]."""
    with Rig(folder, seed=near_seed()) as rig:
        run = rig.run(lambda process: rig.robot.arm.silence(60.0), when=in_descent)
        hold = run.first("arm hold", after=run.at)
        age = _age(hold.values["text"]) if hold is not None else math.inf
        late = 1e3 * (age - rig.lab.limits.stale_pose)
        return Outcome(late, _ended_safely(rig, run, "ms old", "no EGM message", "EGM message is"))


def contact_in_descent(folder: Path) -> Outcome:
    """Time from the reception of the image that exceeds the threshold to the hold [ms]."""
    with Rig(folder, seed=far_seed()) as rig:
        run = rig.run(lambda process: end_after(process.signal, 5.0), when=in_descent)
        return Outcome(*_contact(run, "stopped by contact"))


def contact_in_approach(folder: Path) -> Outcome:
    """The same, while a part approaches a hole that is taught 1.5 mm too low [ms]."""
    with Rig(folder, seed=far_seed(), world=World(taught_error=TaughtError(z=-1.5e-3))) as rig:
        run = rig.run(lambda process: end_after(process.signal, 10.0), when=lambda progress: progress.approaching)
        return Outcome(*_contact(run, "contact during the approach"))


def contact_while_lowering(folder: Path) -> Outcome:
    """Travel of the arm from the crossing of the threshold in the simulation to rest, on the floor of the hole [mm]."""
    world = World(taught_error=TaughtError(z=-0.3e-3))
    with Rig(folder, seed=near_seed(), world=world) as rig:
        lab = rig.lab
        part, space = replace(lab.part, insert_to=1e-4), replace(lab.workspace, height_min=0.0)
        run = rig.run(lab=replace(lab, part=part, workspace=space), limit=120.0)
        reaction, broken = _contact(run, "contact with the floor")
        event, descend = run.first("contact with the floor"), run.first("stopped by contact", "grasp checked")
        if event is None or descend is None:
            return Outcome(math.inf, broken)
        image = float(event.values["image_at"])
        lowering = max(e.time for e in run.events if e.name == "move" and e.time < image)
        crossed = _crossing(rig, lowering, image, float(descend.values["contact_mm"]))
        lowest = min(sample.height for sample in rig.samples_between(image, event.time + 0.3))
        after_image = 1e3 * (_height_at(rig, image) - lowest)
        note = f"{after_image:.3f} mm from the reception of the image; hold after {reaction:.1f} ms"
        return Outcome(1e3 * (_height_at(rig, crossed) - lowest), broken, note)


def part_lost(folder: Path) -> Outcome:
    """Time from the loss of the part to the hold [ms]; the run goes on without it."""
    with Rig(folder, seed=near_seed()) as rig:
        run = rig.run(lambda process: rig.robot.gripper.lose_part(), when=in_descent, limit=90.0)
        run.require_no_false_stop()
        broken = conditions(exit_status_is_1=run.exit_code == 1, outcome_is_part_lost="part lost" in run.output)
        return Outcome(1e3 * (run.stop(run.at) - run.at), broken)


def killed_runner(folder: Path) -> Outcome:
    """Time from SIGKILL of the runner until the arm is at rest [ms]."""
    with Rig(folder, seed=near_seed()) as rig:
        run = rig.run(lambda process: process.kill(), when=in_descent)
        time.sleep(1.0)
        after = rig.samples_between(run.at, math.inf)
        moved = [sample.time for sample in after if abs(sample.height - after[-1].height) > _AT_REST]
        broken = conditions(part_is_still_held=rig.still_holds_the_part())
        return Outcome(1e3 * (max(moved, default=run.at) - run.at), broken)


def crash_loses_little(folder: Path) -> Outcome:
    """Time between the last record that is recovered after SIGKILL and the kill [ms]."""
    with Rig(folder, seed=near_seed()) as rig, tempfile.TemporaryDirectory() as copies:
        run = rig.run(lambda process: process.kill(), when=in_descent)
        copy = Path(copies) / "recovered.mcap"
        recover(folder / "run" / "session.mcap", copy)
        with SessionReader(copy) as session:
            last = max(record.time for record in session.records())
        return Outcome(1e3 * (run.at - last))


def slow_disk(folder: Path) -> Outcome:
    """Time from the moment at which every write takes 3 s to the hold [ms]."""
    flag = folder / "slow"
    prelude = (
        f"import os, time; fsync = os.fsync\n"
        f"def slow(descriptor):\n    time.sleep(3.0 if os.path.exists({str(flag)!r}) else 0.0); fsync(descriptor)\n"
        f"os.fsync = slow\n"
    )
    with Rig(folder, seed=near_seed()) as rig:
        run = rig.run(lambda process: flag.touch(), when=gripped, prelude=prelude)
        return Outcome(1e3 * (run.stop(run.at) - run.at), _ended_safely(rig, run, "behind"))


def prompt(folder: Path) -> Outcome:
    """Time from motors off, while the operator is asked for a part, to the stop [ms]."""
    import pty  # not available on every system

    ours, theirs = pty.openpty()
    with contextlib.ExitStack() as stack:
        for descriptor in (ours, theirs):
            stack.callback(os.close, descriptor)
        rig = stack.enter_context(Rig(folder, seed=near_seed()))
        lab = replace(rig.lab, part=replace(rig.lab.part, presentation="prompt"))

        def asked(progress: InsertionProgress) -> bool:
            return "press Enter" in rig.output

        run = rig.run(lambda process: rig.robot.arm.motors(False), when=asked, lab=lab, stdin=theirs, limit=10.0)
        stop = run.first("arm stopped", after=run.at)
        broken = conditions(exit_status_is_2=run.exit_code == 2, reason_is_stated="motors off" in run.errors)
        return Outcome(math.inf if stop is None else 1e3 * (stop.time - run.at), broken)


def slip(folder: Path) -> Outcome:
    """Largest push of the part in the grip without a stop, with pads that suddenly are slippery [mm]."""
    with Rig(folder, seed=far_seed()) as rig:

        def fault(process: RunningRunner) -> None:
            rig.robot.cell.change_world(gel_stiffness=1.0, pad_friction=0.2)
            end_after(process.signal, 15.0)

        run = rig.run(fault, when=in_descent)
        broken = conditions(
            slip_ended_the_attempt=run.first("slip in the grip", "stopped by contact") is not None,
            not_called_inserted=run.exit_code != 0,
        )
        return Outcome(1e3 * run.part["largest_push"], broken)


def disturbed_links(folder: Path) -> Outcome:
    """Duration of a run with duplicated, split and invalid messages of all devices [s]."""
    with Rig(folder, seed=near_seed()) as rig:
        kinds: dict[str, dict[str, float]] = {"duplicate": {}, "garbage": {"count": 50}, "split": {"delay": 0.004}}
        for number, (kind, more) in enumerate(kinds.items()):
            values = {"share": 0.1, "seed": number} | more
            rig.robot.arm.begin_fault(number, kind, "out", values)
            for camera in rig.robot.cameras:
                camera.begin_fault(number, kind, values)
            if kind == "split":
                rig.robot.gripper.begin_fault(number, kind, "both", values)
        begun = time.monotonic()
        run = rig.run(limit=120.0)
        broken = conditions(
            run_ended_orderly=run.exit_code in (0, 1, 2) and "Traceback" not in run.errors,
            result_is_true=run.exit_code != 0 or bool(run.part.get("inserted")),
        )
        return Outcome(time.monotonic() - begun, broken, run.errors.strip())


def _ended_safely(rig: Rig, run: Run, *reasons: str) -> tuple[str, ...]:
    """Conditions after every fault: the run ended with one of the reasons, the arm rests, and the part is held."""
    stated = any(reason.lower() in run.errors.lower() for reason in reasons)
    if not stated:
        run.require_no_false_stop()
    rest = rig.samples_between(run.stop(run.at) + _SETTLING, math.inf)
    heights = [sample.height for sample in rest] or [math.inf]
    answers = rig.robot.arm.report.answers
    time.sleep(0.1)
    return conditions(
        exit_status_is_2=run.exit_code == 2,
        one_line_states_the_reason=stated and run.errors.count("\n") == 1,
        no_motion_after_the_stop=max(heights) - min(heights) <= _AT_REST,
        nothing_is_sent_after_the_run=rig.robot.arm.report.answers == answers,
        part_is_still_held=rig.still_holds_the_part(),
        recording_is_complete=bool(run.events),
    )


def _last_new_image(run: Run) -> float:
    """Stamp of the last image of the right camera that repeats no earlier one [s]."""
    seen: set[bytes] = set()
    last = -math.inf
    for image in run.images[1]:
        if image.data not in seen:
            last = image.stamp
        seen.add(image.data)
    return last


def _age(text: str) -> float:
    """The time in a text "no EGM message for 0.021 s" [s]."""
    words = text.split()
    return float(words[words.index("for") + 1]) if "for" in words else math.inf


def _contact(run: Run, name: str) -> tuple[float, tuple[str, ...]]:
    """Time from the image of the first event of this name to the hold [ms], and the conditions that do not hold."""
    event = run.first(name)
    if event is None:
        run.require_no_false_stop()
        return math.inf, conditions(contact_stopped_the_motion=False)
    image = float(event.values["image_at"])
    return 1e3 * (run.stop(image) - image), ()


def _crossing(rig: Rig, begin: float, end: float, threshold: float) -> float:
    """Time at which the true mean shear of a pad has changed by the threshold since `begin` [s]."""
    samples = rig.samples_between(begin - 0.2, end)
    before = [sample for sample in samples if sample.time < begin] or samples[:1]
    rest = [sum(sample.shear[pad] for sample in before) / len(before) for pad in (0, 1)]
    for sample in samples:
        if max(abs(sample.shear[pad] - rest[pad]) for pad in (0, 1)) > threshold:
            return sample.time
    return end


def _height_at(rig: Rig, stamp: float) -> float:
    return rig.samples_between(stamp - 0.05, stamp)[-1].height
