"""A snapshot of a session in words."""

import math
from collections.abc import Mapping
from typing import Any

from gelflow.geometry import Pose
from gelflow.session.decision_replay import Comparison
from gelflow.session.records import SENSORS
from gelflow.view.session.recorded_session import RecordedSession
from gelflow.view.session.snapshot import Snapshot
from gelflow.view.session.timeline_events import correction_text


def snapshot_text(snapshot: Snapshot, session: RecordedSession, *, comparison: Comparison | None = None) -> str:
    """The state of run, arm, gripper and policy, as Markdown; `comparison` is that of the last decision."""
    since = snapshot.time - session.start
    lines = [f"**{since:.2f} s** of {session.end - session.start:.1f} s"]
    if snapshot.phase:
        lines[0] += f", phase **{snapshot.phase}**"
    if snapshot.insertion is not None:
        lines[0] += f", insertion {snapshot.insertion}, attempt {snapshot.attempt}"
    if snapshot.flange is not None and session.cell is not None:
        lines.append(arm_text(session.cell.gripper(snapshot.flange), session.cell.part_height(snapshot.flange)))
    if snapshot.gripper is not None:
        lines.append(gripper_text(snapshot))
    lines += [
        f"{sensor} pad: {force_text(force)}"
        for sensor, force in zip(SENSORS, snapshot.forces, strict=False)
        if force is not None
    ]
    if any(pad is not None and pad.tracked is not None for pad in snapshot.pads):
        reference = session.reference_time(snapshot.time) - session.start
        lines.append(f"markers: displacement since {reference:.2f} s, lines 5 times as long")
    if snapshot.decision is not None:
        lines.append(_decision_text(snapshot))
    if comparison is not None:
        lines.append(comparison_text(comparison))
    lines += session.notes
    if session.index.damaged:
        lines.append(f"**{session.index.damaged} damaged parts of the file are not shown**")
    return "  \n".join(lines)


def arm_text(gripper: Pose, height: float) -> str:
    """The pose of the gripper frame, and the height of the part's lower face [m], in words."""
    x, y, z = 1e3 * gripper.position
    return (
        f"gripper at {x:.1f}, {y:.1f}, {z:.1f} mm, yaw {math.degrees(gripper.yaw):.1f}°; "
        f"part {1e3 * height:.2f} mm above the floor"
    )


def gripper_text(snapshot: Snapshot) -> str:
    """Width, force and grasp of the gripper in words."""
    gripper = snapshot.gripper or {}
    text = f"grip: {1e3 * float(gripper['width']):.2f} mm, {float(gripper['force']):.1f} N, {gripper['grasp']}"
    return text + (f", **fault: {gripper['fault']}**" if gripper.get("fault") else "")


def force_text(force: Mapping[str, Any]) -> str:
    """Normal force, shear force and slip of a pad in words; `force` is a record of `gelflow.Force`.

    A number that is not finite is recorded as a string.
    """
    if not force["contact"]:
        return "no contact"
    normal, deviation, shear = float(force["normal"]), float(force["normal_deviation"]), map(float, force["shear"])
    text = f"normal {normal:.2f} ± {deviation:.2f} N, shear {math.hypot(*shear):.2f} N"
    if force.get("gross_slip"):
        return f"{text}, **gross slip**"
    share, spread = force.get("stick_share"), force.get("stick_share_deviation")
    if share is None or spread is None:
        return text
    return f"{text}, sticks {100 * float(share):.0f} ± {100 * float(spread):.0f} %"


def comparison_text(comparison: Comparison) -> str:
    """Whether the replay repeated a decision, in words."""
    if comparison.skipped:
        return f"**replay: not recomputed, {comparison.skipped}**"
    if comparison.identical:
        return "replay: identical"
    flow = f"by {comparison.flow_difference:.2g} of its longest arrow" if comparison.flow_difference else "identical"
    return f"**replay differs**: correction {correction_text(comparison.action, 3)}; flow map {flow}"


def _decision_text(snapshot: Snapshot) -> str:
    decision = snapshot.decision
    assert decision is not None
    return (
        f"last decision (insertion {decision.insertion}, attempt {decision.attempt}): "
        f"correction {correction_text(decision.action)}"
    )


def checks_text(snapshot: Snapshot) -> str:
    """The state of every check of the run, as Markdown; those that fail first."""
    if not snapshot.checks:
        return ""
    failed = [f"**{check['name']}: {check['text']}**" for check in snapshot.checks if not check["ok"]]
    good = [f"{check['name']}: {check['text']}" for check in snapshot.checks if check["ok"]]
    head = f"**{len(failed)} of {len(snapshot.checks)} checks fail**" if failed else f"all {len(good)} checks pass"
    return "  \n".join([head, *failed, *good])
