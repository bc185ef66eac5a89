"""`gelflow replay`: make the decisions of a session again from its recorded images, and compare."""

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.progress import track
from rich.table import Table

from gelflow.errors import PeerError, UsageError
from gelflow.observation import TactileFrame
from gelflow.session.decision_replay import Comparison, PerceptionPipeline, replay
from gelflow.session.reader import SessionReader
from gelflow.session.records import file_digest, from_plain, software_versions
from gelflow.task import InsertionTask


def configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("session", type=Path, help="a recorded session (.mcap)")
    parser.add_argument("--checkpoint", type=Path, help="the policy; default: the one that the session ran")
    parser.add_argument("--picture", type=Path, help="also draw the flow maps and corrections into this .png")


def run(args: argparse.Namespace) -> int:
    from gelflow.policies.checkpoint import load_policy

    console = Console(highlight=False)
    with SessionReader(args.session) as session:
        description = session.description()
        task, perception = _wiring(description)
        policy = load_policy(args.checkpoint or _recorded_checkpoint(description), task=task)
        _tell_differences(console, description, args.checkpoint)
        made = replay(session, perception=perception, policy=policy, task=task)
        total = session.counts().get("/decision", 0)
        comparisons = list(track(made, "replaying", total=total, console=console, transient=True))
    if not comparisons:
        console.print("The session holds no decision: there is nothing to compare.")
        return 1
    console.print(_table(comparisons))
    if args.picture:
        from gelflow.session.decision_picture import draw_decisions

        draw_decisions([comparison.recorded for comparison in comparisons], task.grid, args.picture)
        console.print(f"picture: {args.picture}", markup=False, soft_wrap=True)
    return _verdict(console, comparisons)


def _wiring(description: Mapping[str, Any]) -> tuple[InsertionTask, PerceptionPipeline]:
    """Task and perception as the session describes them. Raises PeerError when the description lacks a part."""
    from gelflow.perception.frames import CameraMount, decode_image, tactile_frame
    from gelflow.perception.tracker import MarkerTracker, TrackerConfig, TrackingResult

    try:
        task = InsertionTask.from_json(dict(description["task"]))
        mounts = [from_plain(CameraMount, mount, what="camera mount") for mount in description["mounts"]]
        configs = [from_plain(TrackerConfig, config, what="tracker settings") for config in description["trackers"]]
    except KeyError as error:
        raise PeerError(f"the session's description lacks {error}; record it with describe_session") from error

    class Tracker:
        """The marker tracker, fed with the bytes that the camera sent."""

        def __init__(self, sensor: int) -> None:
            self._tracker = MarkerTracker(configs[sensor])

        def start(self, data: bytes) -> TrackingResult:
            return self._tracker.start(decode_image(data))

        def track(self, data: bytes) -> TrackingResult:
            return self._tracker.track(decode_image(data))

    def frame(trackeds: Sequence[TrackingResult], stamp: float) -> TactileFrame:
        return tactile_frame(trackeds, mounts, stamp)

    return task, PerceptionPipeline(Tracker, frame)


def _recorded_checkpoint(description: Mapping[str, Any]) -> Path:
    """The file of the policy that the session ran: where it was, or the one that comes with gelflow if it is that."""
    from gelflow.policies.checkpoint import default_checkpoint

    recorded = description.get("checkpoint")
    if not recorded:
        raise UsageError("the session names no checkpoint; name the policy's file with --checkpoint")
    for path in (Path(recorded["path"]), default_checkpoint()):
        if path.is_file() and file_digest(path) == recorded["digest"]:
            return path
    wanted = f"{recorded['path']} (SHA-256 {recorded['digest'][:12]}…)"
    raise UsageError(f"the session ran {wanted}, which is not there or has changed; name the file with --checkpoint")


def _tell_differences(console: Console, description: Mapping[str, Any], checkpoint: Path | None) -> None:
    recorded = description.get("checkpoint")
    if checkpoint and recorded and file_digest(checkpoint) != recorded["digest"]:
        console.print(f"note: {checkpoint} is not the policy that the session ran", markup=False)
    here = software_versions()
    for name, version in description.get("versions", {}).items():
        if here.get(name) != version:
            console.print(f"note: recorded with {name} {version}, here is {here.get(name, 'none')}", markup=False)


def _table(comparisons: Sequence[Comparison]) -> Table:
    table = Table(title="Decisions as recorded, and how far those made again differ (Δ)", box=SIMPLE_HEAD)
    for name in ("insertion", "attempt", "images", "x mm", "y mm", "yaw °", "Δ action", "Δ map"):
        table.add_column(name, justify="right", no_wrap=True)
    for made in comparisons:
        one = made.recorded
        dx, dy, turn = one.action * (1e3, 1e3, 180 / np.pi)
        numbers = (f"{one.insertion}", f"{one.attempt}", f"{sum(map(len, one.tracked))}")
        table.add_row(
            *numbers, f"{dx:+.3f}", f"{dy:+.3f}", f"{turn:+.3f}", f"{made.action_difference:.3g}",
            f"{made.flow_difference:.3g}", style=None if made.identical else "red",
        )  # fmt: skip
    return table


def _verdict(console: Console, comparisons: Sequence[Comparison]) -> int:
    action = max(made.action_difference for made in comparisons)
    flow = max(made.flow_difference for made in comparisons)
    wrong = sum(not made.identical for made in comparisons)
    count = len(comparisons)
    verdict = f"{wrong} of {count} decisions differ" if wrong else f"all {count} decisions identical"
    console.print(f"{verdict}; largest difference: action {action:.3g} [m, rad], flow map {flow:.3g}", markup=False)
    return 1 if wrong else 0
