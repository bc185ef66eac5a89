"""`gelflow calibrate`: fit the simulator to recorded insertions, and plan the attempts to record next."""

import argparse
import dataclasses
import math
import os
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.table import Table

from gelflow.cli.exit_codes import SUCCESS
from gelflow.cli.options import (
    add_json,
    add_out,
    add_part,
    add_quick,
    add_seed,
    check_at_least,
    is_taken,
    part_task,
    removed_on_error,
)
from gelflow.cli.output import Output, progress_bar
from gelflow.cli.session_replay import read_attempts
from gelflow.errors import UsageError
from gelflow.part import CUBOID, Part
from gelflow.policies.calibration.calibrated_scene import MODEL, SCENE, write_scene
from gelflow.policies.calibration.calibration import Calibration, calibrate
from gelflow.policies.calibration.fit import FitSettings
from gelflow.policies.calibration.planning.information import Known
from gelflow.policies.calibration.planning.motions import (
    MOTIONS,
    SCENARIOS,
    STOP_SHEAR_MM,
    Plan,
    candidates,
    plan_motions,
)
from gelflow.policies.calibration.recordings import Recordings
from gelflow.policies.calibration.report import advice_lines, error_lines, page, plain_report
from gelflow.policies.calibration.session_recordings import nothing_recorded
from gelflow.policies.training.folder import create_folder
from gelflow.real.runner.lab import Lab
from gelflow.real.runner.lab_file import load_lab
from gelflow.session.motion_plan import save_motion_plan
from gelflow.session.records import readable_json
from gelflow.sim.tasks.parts import load_part, part_names

_FOLDER = Path("out/calibration")
_QUICK = FitSettings(starts=2, members=48, nearby=32, poses=8, steps=1)


def configure(parser: argparse.ArgumentParser) -> None:
    """Options of the command."""
    parser.add_argument("sessions", nargs="*", type=Path, metavar="SESSION", help="recorded sessions (.mcap)")
    parser.add_argument(
        "--plan",
        type=Path,
        metavar="FILE",
        help="also write the attempts with the most information about what is unknown, for gelflow run insertion "
        "--plan; without a SESSION nothing is known",
    )
    parser.add_argument("--motions", type=int, metavar="N", help=f"number of attempts of --plan (default {MOTIONS})")
    parser.add_argument(
        "--lab",
        type=Path,
        metavar="FILE",
        help="lab file whose workspace and largest shear --plan keeps to, and without a SESSION its grasp and markers",
    )
    add_part(
        parser,
        "part of the plan or of the sessions, which do not contain meshes",
        default="the cuboid, or that of the sessions",
    )
    add_out(parser, f"new folder for report.html, report.json and scene.toml (default {_FOLDER})", folder=True)
    add_seed(parser)
    add_quick(parser)
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Fit, print the parameters, and write the report; write the plan."""
    output = Output(args.json)
    _check(args)
    # A wrong file or folder is refused before minutes of computing.
    lab = None if args.lab is None else load_lab(args.lab)
    if args.plan is not None:
        create_folder(args.plan.parent)
    if not args.sessions:
        recordings = _lab_recordings(args, lab)
        plan = _make_plan(args, lab, recordings, None)
        try:
            _write_plan(args, output, recordings, plan)
        finally:  # the result is printed even where its file cannot be written
            output.result({"plan": _plain_plan(plan)})
        return SUCCESS
    args.out = args.out or _FOLDER
    files = [args.out / "report.json", args.out / "report.html", args.out / SCENE, args.out / MODEL]
    for file in files:
        if is_taken(file):
            raise UsageError(f"{file} exists; name a new folder with --out")
        if args.plan is not None and args.plan.resolve() in (file.resolve(), args.out.resolve()):
            raise UsageError(f"--plan {args.plan} is the folder of --out or a file in it; give the plan another name")
    recordings = read_attempts(args.sessions, args.part)
    if args.plan is not None:
        candidates(recordings.task, _workspace(lab))
    create_folder(args.out)
    settings = _QUICK if args.quick else FitSettings()
    with progress_bar(count=True) as progress:
        bar = progress.add_task("fitting", total=settings.starts)
        result = calibrate(
            recordings,
            seed=args.seed,
            settings=settings,
            processes=min(settings.starts, os.cpu_count() or 1),
            progress=lambda done: progress.update(bar, completed=done),
        )
    values = plain_report(result, args.sessions)
    try:
        _write_report(args, output, result, files, readable_json(values))
        if args.plan is not None:
            plan = _make_plan(args, lab, recordings, result.known)
            values["plan"] = _plain_plan(plan)
            _write_plan(args, output, recordings, plan)
    finally:  # the result is printed even where a file cannot be written
        output.result(values)
    return SUCCESS


def _write_report(
    args: argparse.Namespace, output: Output, result: Calibration, files: Sequence[Path], report: str
) -> None:
    """Write the new files: `report` as report.json, the page, and the scene; then print the result.

    Raises UsageError if the files cannot be written; the result is printed nevertheless.
    """
    try:
        with removed_on_error(*files):
            _write_new(files[0], report)
            _write_new(files[1], page(result, args.sessions, result.recordings.task.grid))
            scene = write_scene(result, args.out)
    except OSError as error:
        raise UsageError(f"cannot write the report to {args.out}: {error}") from error
    finally:
        if not output.json:
            _show(output, result)
    output.text(f"the report is {files[1]}")
    if scene:
        output.text(f"the scene with the known values is {scene[0]}")


def _write_new(file: Path, text: str) -> None:
    """Write a new file. Raises FileExistsError where another calibration has written one meanwhile."""
    with file.open("x", encoding="utf-8", errors="replace") as out:
        out.write(text)


def _check(args: argparse.Namespace) -> None:
    """Raise UsageError for options that contradict each other, before anything is computed."""
    check_at_least(args, seed=0)
    if args.motions is not None:
        check_at_least(args, motions=1)
        if args.plan is None:
            raise UsageError(
                "--motions is the number of attempts of --plan; name the plan file, or leave --motions out"
            )
    if not args.sessions and args.plan is None:
        raise UsageError("name a recorded session, or a new plan file with --plan")
    if args.plan is None and args.lab is not None:
        raise UsageError("--lab gives the limits of --plan; name the plan file, or leave --lab out")
    if not args.sessions and args.out is not None:
        raise UsageError("--out is the folder for the report on a SESSION; leave it out")
    if not args.sessions and args.quick:
        raise UsageError("--quick is for the fit of a SESSION; leave it out")
    if args.plan is not None and is_taken(args.plan):
        raise UsageError(f"{args.plan} exists; name a new file with --plan")


def _lab_recordings(args: argparse.Namespace, lab: Lab | None) -> Recordings:
    """No attempts, with the part of --part and the grasp of --lab."""
    task = part_task(args.part)
    if lab is None:
        return nothing_recorded(task, grasp_force=None, grasp_height=None)
    height = lab.part.grasp_height - task.part.size[2] / 2
    mounts = [camera.mount for camera in (lab.cameras.left, lab.cameras.right)]
    return nothing_recorded(
        task,
        grasp_force=lab.gripper.grasp_force,
        grasp_height=height,
        printed=mounts[0].grid,
        visible=[mount.marker_order() >= 0 for mount in mounts],
    )


def _make_plan(args: argparse.Namespace, lab: Lab | None, recordings: Recordings, known: Known | None) -> Plan:
    """The plan of --plan and --motions, with a progress bar."""
    stop = STOP_SHEAR_MM if lab is None else lab.descent.largest_stop_shear_mm
    with progress_bar(count=True) as progress:
        bar = progress.add_task("planning", total=SCENARIOS)
        return plan_motions(
            recordings,
            known=known,
            count=_wanted(args),
            workspace=_workspace(lab),
            stop_shear_mm=stop,
            seed=args.seed,
            progress=lambda done: progress.update(bar, completed=done),
        )


def _write_plan(args: argparse.Namespace, output: Output, recordings: Recordings, plan: Plan) -> None:
    """Write a plan, then print it. Raises UsageError when its file exists or cannot be written."""
    known = "what the sessions leave open" if args.sessions else "an unknown lab"
    try:
        save_motion_plan(plan.motions, args.plan, title=f"Written by gelflow calibrate --plan for {known}.")
    finally:
        for line in _plan_lines(plan):
            output.text(line)
        if len(plan.motions) < (wanted := _wanted(args)):
            output.text(f"the workspace has {len(plan.motions)} motions to choose from, fewer than --motions {wanted}")
    output.text(f"the plan is {args.plan}; record it with: {_run_command(args, recordings.task.part)}")


def _wanted(args: argparse.Namespace) -> int:
    """Number of motions of the plan."""
    return MOTIONS if args.motions is None else int(args.motions)


def _plain_plan(plan: Plan) -> list[dict[str, Any]]:
    """The motions of a plan, with the gain of each, as plain data."""
    return [dataclasses.asdict(motion) | {"gain": gain} for motion, gain in zip(plan.motions, plan.gains, strict=True)]


def _workspace(lab: Lab | None) -> tuple[float, float, float] | None:
    """Largest |x|, |y| [m] and |yaw| [rad] of a plan; None: those of the task."""
    return None if lab is None else (lab.workspace.x, lab.workspace.y, math.radians(lab.workspace.yaw_deg))


def _run_command(args: argparse.Namespace, part: Part) -> str:
    """The command that records the plan on two parts, so that one of them can be held out."""
    words = ["gelflow", "run", "insertion", "--lab", "LAB" if args.lab is None else str(args.lab)]
    if args.part is not None:
        words += ["--part", args.part]
    elif part != CUBOID:
        words += ["--part", part.name if _is_included(part) else "PART.toml"]
    return shlex.join([*words, "--plan", str(args.plan), "--insertions", "2"])


def _is_included(part: Part) -> bool:
    """Whether the name of a part loads the same part from gelflow; parts from a file have any name."""
    return part.name in part_names() and load_part(part.name).part.to_json() == part.to_json()


def _plan_lines(plan: Plan) -> list[str]:
    """Lines about the motions and what they are expected to determine."""
    lines = [
        f"motion {k + 1}: {motion.text}: information {gain:.1f} nat"
        for k, (motion, gain) in enumerate(zip(plan.motions, plan.gains, strict=True))
    ]
    narrowed = sorted((after / before, name) for name, (before, after) in plan.widths.items() if after < 0.9 * before)
    if narrowed:
        widths = ", ".join(f"{name} {100 * ratio:.0f} %" for ratio, name in narrowed)
        lines.append(f"expected widths of the 95 % intervals, relative to the present ones: {widths}")
    return lines


def _show(output: Output, result: Calibration) -> None:
    output.console.print(_table(result))
    for line in error_lines(result):
        output.text(line)
    for line in advice_lines(result):
        output.text(f"record next: {line}")


def _table(result: Calibration) -> Table:
    table = Table("parameter", "value", "95 % interval", "unit", "from the recordings")
    table.columns[0].no_wrap = True
    for column in table.columns[1:3]:
        column.justify = "right"
    for estimate in result.estimates:
        interval = f"{estimate.low:.3g} … {estimate.high:.3g}"
        style = "dim" if estimate.verdict == "unknown" else None
        unit = estimate.parameter.unit
        table.add_row(estimate.parameter.name, f"{estimate.value:.3g}", interval, unit, estimate.verdict, style=style)
    return table
