"""Scenarios without a device fault: refused input, an undisturbed run, and an insertion without tactile evidence."""

import math
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from gelflow.errors import SafetyError, UsageError
from gelflow.geometry import Pose, yaw_quaternion
from gelflow.mock_lab.promises.outcome import Outcome, conditions
from gelflow.mock_lab.promises.rig import Rig, Run, end_after, far_seed, in_descent, near_seed, while_lowering
from gelflow.real.egm import driver as driver_module
from gelflow.real.egm.driver import EgmArm
from gelflow.real.runner import supervisor as supervisor_module
from gelflow.real.runner.cell import egm_config
from gelflow.real.runner.lab import Lab
from gelflow.real.runner.lab_file import load_lab, save_lab
from gelflow.real.runner.supervisor import Supervisor

_MICROMETRE = 1e6  # per metre


def refused_run(change: Callable[[Rig], Lab], reason: str) -> Callable[[Path], Outcome]:
    """Motion of the arm in a run that preflight refuses [µm]. `change` prepares the robot and returns the lab."""

    def scenario(folder: Path) -> Outcome:
        with Rig(folder, seed=near_seed()) as rig:
            lab = change(rig)
            run = rig.run(lab=lab)
            return Outcome(_motion(rig), _refused(run, reason))

    return scenario


def gripper_with_fault(rig: Rig) -> Lab:
    """The gripper is in FAST STOP."""
    rig.robot.gripper.raise_fast_stop()
    return rig.lab


def wrong_scale(rig: Rig) -> Lab:
    """The scale of the left camera is wrong by 20 %."""
    cameras = rig.lab.cameras
    left = replace(cameras.left, pixels_per_mm=1.2 * cameras.left.pixels_per_mm)
    return replace(rig.lab, cameras=replace(cameras, left=left))


def one_camera_for_both(rig: Rig) -> Lab:
    """The right camera is the left one under another name."""
    cameras = rig.lab.cameras
    right = replace(cameras.right, source=cameras.left.source.replace("127.0.0.1", "localhost"))
    return replace(rig.lab, cameras=replace(cameras, right=right))


def invalid_targets(folder: Path) -> Outcome:
    """Motion of the arm while invalid targets are given to supervisor and driver [µm]."""
    with Rig(folder, seed=near_seed()) as rig:
        lab = rig.lab
        with EgmArm(egm_config(lab), clock=rig.robot.clock) as arm:
            arm.wait_following(5.0)
            accepted = [name for name, refuses in _refusals(lab, arm) if not refuses()]
            time.sleep(0.3)
            return Outcome(_motion(rig), tuple(f"{name} is refused" for name in accepted))


def _refusals(lab: Lab, arm: EgmArm) -> list[tuple[str, Callable[[], bool]]]:
    """Each kind of invalid target, and a function that gives it to supervisor and driver."""
    state = arm.state()
    here = lab.gripper_pose(state.position, state.quaternion)
    space, arm_limits = lab.workspace, lab.arm
    fast, turn = arm_limits.max_speed, math.radians(arm_limits.max_turn_speed_deg)

    def refuses(target: Pose, speed: float = fast, turn_speed: float = turn) -> bool:
        tool = lab.tool_pose(target)
        checks: tuple[Callable[[], object], ...] = (
            lambda: Supervisor(lab).check(target, here, speed=speed, turn_speed=turn_speed),
            lambda: arm.target(tool.position, tool.quaternion, lifetime=0.1, speed=speed, turn_speed=turn_speed),
        )
        return all(map(_raises, checks))

    def moved(x: float = 0.0, y: float = 0.0, z: float = 0.0, yaw: float = 0.0) -> Pose:
        return here @ Pose(np.array([x, y, z]), yaw_quaternion(yaw))

    return [
        ("a target outside in x", lambda: refuses(moved(x=space.x + 0.005))),
        ("a target outside in y", lambda: refuses(moved(y=-space.y - 0.005))),
        ("a target too high", lambda: refuses(moved(z=space.height_max))),
        ("a target too low", lambda: refuses(moved(z=-0.045))),
        ("a large turn", lambda: refuses(moved(yaw=math.radians(space.max_turn_deg + 5)))),
        ("a target that is not a number", lambda: refuses(moved(x=math.nan))),
        ("a high speed", lambda: refuses(moved(z=0.001), speed=1.1 * fast)),
        ("a high angular speed", lambda: refuses(moved(z=0.001), turn_speed=1.1 * turn)),
        ("a speed that is not a number", lambda: refuses(moved(z=0.001), speed=math.nan)),
    ]


def _raises(check: Callable[[], object]) -> bool:
    try:
        check()
    except SafetyError:
        return True
    return False


def budget(folder: Path) -> Outcome:
    """Time by which the hold is later than the end of the time allowed for an attempt, 1 s [ms]."""
    with Rig(folder, seed=near_seed()) as rig:
        lab = replace(rig.lab, limits=replace(rig.lab.limits, attempt_time=1.0))
        run = rig.run(lab=lab)
        begun = next((e.time for e in run.events if e.values.get("state") == "approach"), math.inf)
        return Outcome(1e3 * (run.stop(begun) - begun - 1.0), _refused(run, "more than 1 s"))


def largest_steps(folder: Path) -> Outcome:
    """Largest step between two references of an undisturbed run, over the step at the largest speed [1]."""
    with Rig(folder, seed=near_seed()) as rig:
        run = rig.run(limit=120.0)
        run.require_no_false_stop()
        report = rig.robot.arm.report
        allowed = rig.lab.arm.max_speed * 0.004
        broken = conditions(
            first_reference_equals_the_feedback=report.first_error < 1e-9,
            part_is_inserted=run.exit_code == 0 and bool(run.part.get("inserted")),
        )
        return Outcome(report.largest_step / allowed, broken, run.errors.strip())


def replayed(folder: Path) -> Outcome:
    """Replays that differ from the recorded decisions of a run with contact [1]."""
    with Rig(folder, seed=far_seed()) as rig:
        run = rig.run(lambda process: end_after(process.signal, 8.0), when=in_descent)
    if run.first("stopped by contact") is None:
        run.require_no_false_stop()
    command = "import sys; from gelflow.cli.main import main; sys.exit(main(sys.argv[1:]))"
    session = str(folder / "run" / "session.mcap")
    replay = subprocess.run([sys.executable, "-c", command, "replay", session], capture_output=True, check=False)
    broken = conditions(contact_led_to_a_decision=run.first("stopped by contact") is not None)
    return Outcome(float(replay.returncode != 0), broken, replay.stderr.decode(errors="replace").strip())


def dry_run(folder: Path) -> Outcome:
    """References received by the arm, and its motion, in a dry run [1]."""
    with Rig(folder, seed=near_seed()) as rig:
        run = rig.run(options=("--dry-run",))
        width = rig.robot.cell.gripper_state()[0]
        broken = conditions(
            exit_status_is_0=run.exit_code == 0,
            arm_did_not_move=_motion(rig) == 0.0,
            fingers_did_not_move=abs(width - rig.robot.config.cell.start_width) < 1e-4,
        )
        return Outcome(float(rig.robot.arm.report.answers), broken)


def statement(folder: Path) -> Outcome:
    """Places without the statement that this is no safety-rated function [1]."""
    texts = (supervisor_module.__doc__, driver_module.__doc__)
    missing = ["not a safety-rated function" not in " ".join((text or "").split()).lower() for text in texts]
    return Outcome(float(sum(missing)))


def unbounded_limits(folder: Path) -> Outcome:
    """Lab files with limits out of range that are accepted [1]."""
    with Rig(folder, seed=near_seed()) as rig:
        save_lab(rig.lab, folder / "good.toml", title="test")
    text = (folder / "good.toml").read_text()
    accepted = []
    for key, value in (("max_speed", "1e6"), ("stale_pose", "1e9"), ("stale_frame", "inf"), ("clock_factor", "0.01")):
        lines = [f"{key} = {value}" if line.startswith(f"{key} =") else line for line in text.splitlines()]
        (folder / "bad.toml").write_text("\n".join(lines) + "\n")
        try:
            load_lab(folder / "bad.toml")
            accepted.append(key)
        except UsageError:
            continue
    return Outcome(float(len(accepted)), tuple(f"{key} is refused" for key in accepted))


def no_weight(folder: Path) -> Outcome:
    """Motion of the arm after a grasp that a pad does not show as it must [µm]: its camera is mounted upside down."""
    with Rig(folder, seed=near_seed()) as rig:
        cameras = rig.lab.cameras
        left = replace(cameras.left, rotation_deg=180)
        run = rig.run(lab=replace(rig.lab, cameras=replace(cameras, left=left)))
        grasp = min((e.time for e in run.events if e.values.get("state") == "load"), default=math.inf)
        heights = [sample.height for sample in rig.samples_between(grasp + 3.0, math.inf)] or [math.inf, 0.0]
        return Outcome(_MICROMETRE * (max(heights) - min(heights)), _refused(run, "weight of the grasped part"))


def release_without_change(folder: Path) -> Outcome:
    """Parts called inserted although no pad shows the release [1]: the gels do not move any more."""
    with Rig(folder, seed=near_seed()) as rig:

        def fault(process: object) -> None:
            cell = rig.robot.cell
            still = [cell.marker_displacement(finger) for finger in (0, 1)]
            cell.marker_displacement = lambda finger: still[finger]  # type: ignore[method-assign]

        run = rig.run(fault, when=while_lowering)
        return Outcome(float(run.exit_code == 0), _refused(run, "no change at the release"))


def _refused(run: Run, reason: str) -> tuple[str, ...]:
    stated = reason.lower() in run.errors.lower()
    if not stated:
        run.require_no_false_stop()
    return conditions(exit_status_is_2=run.exit_code == 2, reason_is_stated=stated)


def _motion(rig: Rig) -> float:
    """Vertical motion of the tool since the start of the robot [µm]."""
    heights = [sample.height for sample in rig.samples]
    return _MICROMETRE * (max(heights) - min(heights))
