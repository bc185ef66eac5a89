"""`gelflow demo`: insertions with the mock robot over its network protocols; a table, pictures and a session."""

import argparse
import math
import re
import shlex
import sys
import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.table import Table

from gelflow.cli.exit_codes import SUCCESS
from gelflow.cli.insertion_text import ATTEMPT_HEADER, attempt_line, insertion_to_json
from gelflow.cli.options import (
    add_checkpoint,
    add_json,
    add_out,
    add_part,
    add_preset,
    add_quick,
    add_seed,
    add_view,
    check_at_least,
    check_page_address,
    checkpoint_for,
    part_task,
)
from gelflow.cli.output import Output, progress_bar
from gelflow.errors import GelflowError, PeerTimeout, UsageError
from gelflow.interrupts import interruptible
from gelflow.mock_lab.robot_process import mock_robot, true_state
from gelflow.session.reader import is_being_recorded
from gelflow.task import InsertionTask

if TYPE_CHECKING:
    from gelflow.policies.evaluation import EvaluationResult
    from gelflow.policies.networks.flow_map_policy import NetworkPolicy
    from gelflow.real.runner.insertion.attempt import Attempt, Insertion
    from gelflow.real.runner.lab import Lab
    from gelflow.view.live.live_view import LiveView

_DELAY_NOTE = 0.1  # share of the wall time that robot time must have waited for a note below the table
_FOLDER = Path("out/demo")  # unless --out names another one
_MARKER = ".gelflow-demo"  # in a folder whose sessions and pictures are those of a demo
_WRITTEN = re.compile(r"session(-real-time)?\.mcap|insertion-(real-time-)?\d+\.png")  # names of its files
_EPISODES = 100  # parts in simulation without the mock robot


def configure(parser: argparse.ArgumentParser) -> None:
    """Options of the command."""
    parser.add_argument("--insertions", type=int, default=5, metavar="N", help="number of parts (default %(default)s)")
    parser.add_argument("--factor", type=float, default=5.0, metavar="X", help="robot time over wall time (default 5)")
    parser.add_argument("--no-real-time", action="store_true", help="omit the additional insertion in real time")
    add_part(parser)
    add_checkpoint(parser)
    add_view(parser)
    add_quick(parser)
    add_seed(parser, default=1)
    add_preset(parser)
    add_out(parser, "folder for pictures and sessions", default=_FOLDER, folder=True)
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Insert the parts, show the results, and compare with the same policy in simulation."""
    from gelflow.cli.live_page import live_page
    from gelflow.policies.checkpoint import load_policy

    check_at_least(args, insertions=1, seed=0)
    check_page_address(args, "view")
    # With the default of 5 ms a computing thread delays the threads of gripper and cameras.
    sys.setswitchinterval(5e-4)
    output = Output(args.json)
    task = part_task(args.part)
    checkpoint = checkpoint_for(task, args.checkpoint)
    policy = load_policy(checkpoint, task=task)
    _check_earlier_files(args.out)
    with live_page(args, output) as view:
        results = _run_all(output, args, policy, task, checkpoint, view)
    first = results[0]
    robot, truth = (sum(part) for part in zip(*first.successes(), strict=True)) if first.insertions else (0, 0)
    parts = len(first.insertions)
    output.text(
        f"inserted: {robot} of {parts} as measured by the robot, {truth} of {parts} in truth; {first.wall:.0f} s."
    )
    evaluations = [] if args.quick else _in_simulation(output, policy, task, preset=args.preset)
    session = args.out / "session.mcap"
    if first.insertions:
        output.text(f"pictures of what the policy saw: {args.out}/insertion-*.png")
    output.text(f"the session is {session}; recompute its decisions with:")
    output.text(f"  gelflow replay {shlex.quote(str(session))}")
    output.result(_to_json(session, results, evaluations))
    for result in results:
        if result.error is not None:
            raise result.error
    return SUCCESS


def _run_all(
    output: Output,
    args: argparse.Namespace,
    policy: "NetworkPolicy",
    task: InsertionTask,
    checkpoint: Path,
    view: "LiveView | None",
) -> "list[_SeriesResult]":
    """The insertions at the requested factor, and one in real time."""
    count = 1 if args.quick else args.insertions
    plan = _Series(
        policy, task, args.part, checkpoint, args.out,
        count=count, factor=args.factor, seed=args.seed, preset=args.preset,
        title=f"Insertions with the mock robot at {args.factor:g} times real time", view=view,
    )  # fmt: skip
    results = [_run_series(output, plan, clear=True)]
    if not (args.no_real_time or args.quick) and results[0].error is None:
        plan = replace(
            plan, count=1, factor=1.0, seed=args.seed + count, title="One more in real time (factor 1)",
            name="session-real-time", pictures="insertion-real-time",
        )  # fmt: skip
        results.append(_run_series(output, plan))
    return results


@dataclass(frozen=True)
class _Series:
    """Insertions with one mock robot, recorded in one session."""

    policy: "NetworkPolicy"
    task: InsertionTask
    part: str | None  # as --part names it
    checkpoint: Path
    out: Path
    count: int
    factor: float
    seed: int
    preset: str | None
    title: str
    name: str = "session"
    pictures: str = "insertion"
    view: "LiveView | None" = None


@dataclass(frozen=True)
class _SeriesResult:
    """Results of a series: each insertion with the true state of its part."""

    insertions: list[tuple["Insertion", dict[str, Any]]]
    wall: float  # duration [s]
    note: str  # empty, or the speed that the simulation reached instead of `factor`
    error: GelflowError | None  # the error that ended the series early

    def successes(self) -> list[tuple[bool, bool]]:
        """For each part: inserted as measured by the robot, and in truth."""
        return [(insertion.inserted, bool(part["inserted"])) for insertion, part in self.insertions]


@dataclass
class _Observer:
    """Prints the attempts of a series and collects the true state of each part."""

    output: Output
    truth_url: str
    insertions: list[tuple["Insertion", dict[str, Any]]] = field(default_factory=list)
    _seeds: dict[int, int] = field(default_factory=dict)  # by part

    def on_attempt(self, number: int, attempt: "Attempt") -> None:
        self._seeds[number] = true_state(self.truth_url)["parts"][-1]["seed"]
        self.output.text(attempt_line(number, attempt))

    def on_insertion(self, result: "Insertion") -> None:
        # The newest part may already be the next one: parts are identified by their seed.
        parts = {part["seed"]: part for part in true_state(self.truth_url)["parts"]}
        self.insertions.append((result, parts[self._seeds.get(result.number, max(parts))]))
        self.output.text(f"{result.number + 1:6d}  {result.outcome} after {result.duration:.0f} s of robot time")


def _run_series(output: Output, series: _Series, *, clear: bool = False) -> _SeriesResult:
    """Start a mock robot, insert the parts, draw the pictures, and print the table.

    `clear` removes the files of an earlier demo once the mock robot has started, which checks the options.
    """
    from gelflow.cli.live_page import motion_observer
    from gelflow.real.runner.lab_file import load_lab
    from gelflow.real.runner.run_plan import RunPlan, run_insertions

    begun = time.monotonic()
    robot = mock_robot(factor=series.factor, seed=series.seed, preset=series.preset, part=series.part)
    with robot as (lab_path, truth_url):
        lab = load_lab(lab_path)
        if clear:
            _clear(series.out)
        output.console.print(series.title, style="bold")
        output.text(f"{lab.gripper.address}, UDP {lab.arm.egm_port}, two MJPEG cameras")
        output.text(ATTEMPT_HEADER)
        observer = _Observer(output, truth_url)
        plan = RunPlan(
            lab=lab,
            policy=series.policy,
            task=series.task,
            session=series.out / f"{series.name}.mcap",
            checkpoint=series.checkpoint,
            insertions=series.count,
            on_attempt=observer.on_attempt,
            on_insertion=observer.on_insertion,
            on_warning=lambda line: output.text(f"warning: {line}"),
        )
        error = None
        with interruptible() as at_once:
            plan = replace(plan, on_motion=motion_observer(series.view, at_once))
            if series.view is not None:
                series.view.show(plan.session)
            try:
                run_insertions(plan)
            except GelflowError as caught:
                error = _explained(caught, series.factor)  # raised after the results so far are shown
        waited = true_state(truth_url)["waited"] / series.factor
    wall = time.monotonic() - begun
    note = ""
    if waited > _DELAY_NOTE * wall:
        note = f"this computer reached {series.factor * (1 - waited / wall):.1f} times real time"
    result = _SeriesResult(observer.insertions, wall, note, error)
    _draw(result, lab, series)
    output.console.print(_table(result, series.title))
    return result


def _explained(error: GelflowError, factor: float) -> GelflowError:
    """The error, with a remedy where a short delay of the computer is a time-out because robot time is faster."""
    if factor <= 1 or not isinstance(error, PeerTimeout):
        return error
    remedy = f"delays of this computer are {factor:g} times as long in robot time: close programs, or use --factor 1"
    return PeerTimeout(f"{error}; {remedy}")


def _draw(result: _SeriesResult, lab: "Lab", series: _Series) -> None:
    from gelflow.real.runner.insertion.insertion_picture import draw_insertion

    mounts = (lab.cameras.left.mount, lab.cameras.right.mount)
    for insertion, _ in result.insertions:
        draw_insertion(insertion, mounts, series.task, series.out / f"{series.pictures}-{insertion.number + 1}.png")


def _table(result: _SeriesResult, title: str) -> Table:
    """Misalignment, attempts, outcome as measured by the robot and in truth, time."""
    view = Table(title=title, caption=result.note or None)
    view.add_column("part", justify="right")
    view.add_column("misalignment\nx, y [mm], yaw [°]", justify="right")
    view.add_column("attempts", justify="right")
    view.add_column("robot")
    view.add_column("truth")
    view.add_column("robot time\n[s]", justify="right")
    for insertion, part in result.insertions:
        x, y, yaw = part["misalignment"]
        view.add_row(
            str(insertion.number + 1),
            f"{1e3 * x:+.1f}, {1e3 * y:+.1f}, {math.degrees(yaw):+.1f}",
            str(len(insertion.attempts)),
            insertion.outcome,
            "inserted" if part["inserted"] else "not inserted",
            f"{insertion.duration:.0f}",
            style=None if part["inserted"] and insertion.inserted else "red",
        )
    return view


def _in_simulation(
    output: Output, policy: "NetworkPolicy", task: InsertionTask, *, preset: str | None
) -> "list[EvaluationResult]":
    """Success in simulation without protocols and cameras, of the policy and of random corrections."""
    from gelflow.policies.episodes import RandomPolicy, evaluate_task
    from gelflow.policies.networks.base import BatchPolicy
    from gelflow.sim.tasks.insertion_environments import Insertion

    batch, network = Insertion(_EPISODES, task=task, preset=preset), policy.network
    reach = np.asarray(network.reach) / np.asarray(task.action_scale)
    actors: dict[str, BatchPolicy] = {
        "policy": network.batch_policy(_EPISODES),
        "random": RandomPolicy(_EPISODES, reach, 0),
    }
    results = []
    with progress_bar() as progress:
        bar = progress.add_task("the same policy in simulation", total=len(actors))
        for name, actor in actors.items():
            results.append(evaluate_task(name, actor, batch, episodes=_EPISODES, seed=1))
            progress.advance(bar)
    own, random = results
    output.text(
        f"in simulation, {_EPISODES} parts: this policy {own.success:.0%} in {own.length:.1f} corrections,"
        f" random corrections {random.success:.0%}."
    )
    return results


def _to_json(session: Path, results: list[_SeriesResult], evaluations: "list[EvaluationResult]") -> dict[str, Any]:
    return {
        "session": session,
        "series": [
            {
                "insertions": [insertion_to_json(insertion) | {"truth": part} for insertion, part in result.insertions],
                "seconds": result.wall,
                "note": result.note,
                "error": None if result.error is None else str(result.error),
            }
            for result in results
        ],
        "simulation": {result.name: result.success for result in evaluations},
    }


def _check_earlier_files(out: Path) -> list[Path]:
    """Create the folder `out` if it does not exist; returns the files of an earlier demo in it.

    Raises UsageError when the folder cannot be used, when files with these names are not of a demo, and when one is
    being recorded.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
        old = sorted(path for path in out.iterdir() if _WRITTEN.fullmatch(path.name))
        if old and not (out / _MARKER).exists():
            raise UsageError(f"{old[0]} is not the file of a demo; name another folder with --out")
        for path in old:
            with path.open("rb") as stream:
                if is_being_recorded(stream):
                    raise UsageError(f"another demo records {path}; wait for its end or name another --out")
    except OSError as error:
        raise UsageError(f"cannot write to {out}: {error.strerror}; name another folder with --out") from error
    return old


def _clear(out: Path) -> None:
    """Remove the files of an earlier demo. Raises UsageError as `_check_earlier_files`."""
    try:
        for path in _check_earlier_files(out):
            path.unlink()
        (out / _MARKER).touch()
    except OSError as error:
        raise UsageError(f"cannot write to {out}: {error.strerror}; name another folder with --out") from error
