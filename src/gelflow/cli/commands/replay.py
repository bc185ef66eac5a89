"""`gelflow replay`: recompute the decisions of a session from its recorded images and compare them."""

import argparse
import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.table import Table

from gelflow.cli.exit_codes import NEGATIVE_RESULT, SUCCESS
from gelflow.cli.options import add_checkpoint, add_json, add_out, add_part, check_new_file
from gelflow.cli.output import Output
from gelflow.cli.session_replay import recorded_pipeline, replay_with_progress
from gelflow.errors import UsageError
from gelflow.figures import PICTURE_FORMATS
from gelflow.real.camera.latency import LatencyEstimate, combine_latencies
from gelflow.session.decision_replay import Comparison
from gelflow.session.messages import Damage
from gelflow.session.reader import SessionReader
from gelflow.session.records import SENSORS, described, file_digest, software_versions

_FORMER_VERSIONS = {"tracker": "1"}  # of sessions that do not state them


def configure(parser: argparse.ArgumentParser) -> None:
    """Options of the command."""
    parser.add_argument("session", type=Path, metavar="SESSION", help="a recorded session (.mcap)")
    add_checkpoint(parser, default="the policy of the session")
    parser.add_argument(
        "--simulate", action="store_true", help="compare the flow maps with the simulation instead, error per decision"
    )
    add_part(parser, "part of --simulate, where the session does not contain its mesh", default="that of the session")
    add_out(parser, "a picture (.png) of flow maps and corrections, recorded and recomputed or simulated")
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Replay the session and print the differences.

    A negative result: a decision differs, could not be recomputed or is lost, or there is none.
    """
    if args.out:
        check_new_file(args.out, suffixes=PICTURE_FORMATS)
    if args.simulate:
        return _replay_in_simulation(args)
    if args.part is not None:
        raise UsageError("--part is for --simulate: a replay uses the part of the session; leave it out")
    output = Output(args.json)
    with SessionReader(args.session) as session:
        description = session.description()
        task, perception, policy = recorded_pipeline(description, args.checkpoint)
        notes = _notes(description, args.checkpoint)
        for note in notes:
            output.text(f"note: {note}")
        total, damage = session.counts().get("/decision", 0), Damage()
        comparisons = replay_with_progress(session, task, perception, policy, damage=damage)
        latencies = _latencies(session, description)
        result = _Result(comparisons, total - len(comparisons), damage, session.lost_chunks, notes, latencies)
    picture = args.out if comparisons else None
    if picture:
        from gelflow.session.decision_picture import draw_comparisons

        try:
            draw_comparisons(comparisons, task.grid, picture)
        except UsageError:
            _show(output, result, None)
            raise
    return _show(output, result, picture)


def _replay_in_simulation(args: argparse.Namespace) -> int:
    from gelflow.cli.simulated_replay import replay_in_simulation  # deferred: loads the simulator

    if args.checkpoint is not None:
        raise UsageError("--checkpoint names a policy, and --simulate evaluates none; leave one of them out")
    return replay_in_simulation(args)


@dataclass(frozen=True)
class _Result:
    """The result of a replay."""

    comparisons: Sequence[Comparison]
    lost: int  # decisions whose own record is damaged
    damage: Damage
    lost_chunks: int  # of the source of a recovered session
    notes: list[str]
    latencies: list[list[LatencyEstimate]]  # of each camera, from each grasp

    @property
    def skipped(self) -> list[Comparison]:
        return [comparison for comparison in self.comparisons if comparison.skipped]

    @property
    def identical(self) -> bool:
        """Whether there is a decision and all were recomputed identically."""
        nothing_lost = not self.lost and not self.lost_chunks
        return bool(self.comparisons) and nothing_lost and all(c.identical for c in self.comparisons)

    def verdict(self) -> list[str]:
        """Lines about all decisions together."""
        count = len(self.comparisons) + self.lost
        if not count:
            return ["The session contains no decision: there is nothing to compare."]
        differ = sum(comparison.differs for comparison in self.comparisons)
        same = sum(comparison.identical for comparison in self.comparisons)
        verdict = f"{differ} of {count} decisions differ" if differ else f"{same} of {count} decisions identical"
        action = max((comparison.action_difference for comparison in self.comparisons), default=0.0)
        flow = max((comparison.flow_difference for comparison in self.comparisons), default=0.0)
        verdict = f"all {count} decisions identical" if same == count else verdict
        lines = [f"{verdict}; largest difference: action {action:.3g} [m, rad], flow map {flow:.3g}"]
        if self.skipped:
            first = self.skipped[0].skipped
            lines.append(
                f"{len(self.skipped)} of {count} decisions could not be recomputed: images missing or unreadable "
                f"(first: {first}); their actions were recomputed from the recorded flow maps"
            )
        if self.damage:
            lines.append(f"passed over: {self.damage.records} damaged records, {self.damage.chunks} damaged chunks")
        if self.lost_chunks:
            lines.append(
                f"the session was recovered without {self.lost_chunks} damaged chunks, so decisions may be missing"
            )
        if self.lost:
            lines.append(
                f"{self.lost} of {count} decisions are lost with them; a policy with a memory has another state until "
                "the next insertion"
            )
        return lines


def _latencies(session: SessionReader, description: Mapping[str, Any]) -> list[list[LatencyEstimate]]:
    """For each camera the estimates of its latency, from the recorded grasps."""
    from gelflow.perception.tracker import TrackerConfig
    from gelflow.real.runner.session_latency import session_latencies

    configs = described(TrackerConfig, description, "trackers", what="tracker settings")
    return session_latencies(session, configs)


def _latency_lines(latencies: Sequence[Sequence[LatencyEstimate]]) -> Iterator[str]:
    for name, estimates in zip(SENSORS, latencies, strict=False):
        if not estimates:
            continue
        together = combine_latencies(estimates)
        if together is None:
            yield f"{name} camera: its {len(estimates)} grasps contradict each other, so its latency varies"
            continue
        hint = f": correct cameras.{name}.latency in the lab file" if together.low > 0 or together.high < 0 else ""
        grasps = "1 grasp" if len(estimates) == 1 else f"{len(estimates)} grasps"
        yield f"{name} camera: latency beyond that of the lab file {together}, from {grasps}{hint}"


def _notes(description: Mapping[str, Any], checkpoint: Path | None) -> list[str]:
    """Differences between the recording and this replay that may change the decisions."""
    notes = []
    recorded = description.get("checkpoint")
    if checkpoint and recorded and file_digest(checkpoint) != recorded["digest"]:
        notes.append(f"{checkpoint} is not the policy that the session ran")
    if checkpoint and not recorded:
        notes.append(
            f"the session names no policy, as that of a motion plan: its actions need not be those of {checkpoint}"
        )
    installed = software_versions()
    for name, version in (_FORMER_VERSIONS | (description.get("versions") or {})).items():
        if installed.get(name) != version:
            notes.append(f"recorded with {name} {version}, installed is {installed.get(name, 'none')}")
    return notes


def _show(output: Output, result: _Result, picture: Path | None) -> int:
    """Print the comparison and return the exit code."""
    decisions = [
        {
            "insertion": comparison.recorded.insertion,
            "attempt": comparison.recorded.attempt,
            "recorded_action": comparison.recorded.action,
            "action": comparison.action,
            "action_difference": comparison.action_difference,
            "flow_difference": None if comparison.skipped else comparison.flow_difference,
            "skipped": comparison.skipped,
        }
        for comparison in result.comparisons
    ]
    if not output.json and decisions:
        output.wide_table(_table(result.comparisons))
    if picture:
        output.text(f"picture: {picture}")
    for line in (*_latency_lines(result.latencies), *result.verdict()):
        output.text(line)
    output.result(
        {
            "decisions": decisions,
            "identical": result.identical,
            "skipped": len(result.skipped),
            "lost_decisions": result.lost,
            "damaged": dataclasses.asdict(result.damage),
            "lost_chunks": result.lost_chunks,
            "latency": {
                name: combine_latencies(estimates) for name, estimates in zip(SENSORS, result.latencies, strict=False)
            },
            "notes": result.notes,
            "picture": picture,
        }
    )
    return SUCCESS if result.identical else NEGATIVE_RESULT


def _table(comparisons: Sequence[Comparison]) -> Table:
    title = "Recorded decisions, and differences of the recomputed ones"
    table = Table(title=title, box=SIMPLE_HEAD, collapse_padding=True, pad_edge=False)
    differences = ("difference\nof action", "difference\nof map")
    for name in ("insertion", "attempt", "images", "x mm", "y mm", "yaw °", *differences):
        table.add_column(name, justify="right", no_wrap=True)
    for comparison in comparisons:
        recorded = comparison.recorded
        dx, dy, turn = recorded.action * (1e3, 1e3, 180 / np.pi)
        numbers = (f"{recorded.insertion}", f"{recorded.attempt}", f"{sum(map(len, recorded.tracked))}")
        table.add_row(
            *numbers,
            f"{dx:+.3f}",
            f"{dy:+.3f}",
            f"{turn:+.3f}",
            f"{comparison.action_difference:.3g}",
            "skipped" if comparison.skipped else f"{comparison.flow_difference:.3g}",
            style=None if comparison.identical else "red",
        )
    return table
