"""Task, perception and policy of a recorded session, from its description, and its replay with a progress bar."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gelflow.cli.options import part_task
from gelflow.cli.output import progress_bar
from gelflow.errors import PeerError, UsageError
from gelflow.observation import TactileFrame
from gelflow.protocols import Policy
from gelflow.session.decision_replay import Comparison, PerceptionPipeline, replay
from gelflow.session.messages import Damage
from gelflow.session.reader import SessionReader
from gelflow.session.records import described, file_digest
from gelflow.task import InsertionTask

if TYPE_CHECKING:
    from gelflow.policies.calibration.recordings import Recordings


def recorded_pipeline(
    description: Mapping[str, Any], checkpoint: Path | None
) -> tuple[InsertionTask, PerceptionPipeline, Policy]:
    """Task, perception and policy of a session; `checkpoint` replaces the recorded one."""
    from gelflow.policies.checkpoint import load_policy

    task, perception = _recorded_perception(description)
    return task, perception, load_policy(checkpoint or _recorded_checkpoint(description), task=task)


def replay_with_progress(
    session: SessionReader, task: InsertionTask, perception: PerceptionPipeline, policy: Policy, *, damage: Damage
) -> list[Comparison]:
    """All decisions of a session, recomputed; damaged records are counted in `damage`."""
    comparisons = []
    with progress_bar(count=True) as progress:
        bar = progress.add_task("replaying", total=session.counts().get("/decision", 0))
        for comparison in replay(session, perception=perception, policy=policy, task=task, damage=damage):
            comparisons.append(comparison)
            progress.advance(bar)
    return comparisons


def read_attempts(paths: Sequence[Path], part: str | None) -> "Recordings":
    """The recordings of sessions for the simulator; `part` is that of `--part`. Raises UsageError as both readers."""
    from gelflow.policies.calibration.session_recordings import read_recordings

    of_file = None if part is None else part_task(part).part
    return read_recordings(paths, part=of_file, visible_markers=visible_markers)


def visible_markers(description: Mapping[str, Any]) -> list[NDArray[np.bool_]]:
    """Which printed markers of each pad its camera shows, (markers,) each; empty where a session does not name them."""
    from gelflow.perception.frames import CameraMount

    if not all("pitch" in mount for mount in description["mounts"]):
        return []
    mounts = described(CameraMount, description, "mounts", what="camera mount")
    return [mount.marker_order() >= 0 for mount in mounts]


def _recorded_perception(description: Mapping[str, Any]) -> tuple[InsertionTask, PerceptionPipeline]:
    """Task and perception of the session's description. Raises PeerError when the description lacks a part."""
    from gelflow.perception.frames import CameraMount, decode_image, tactile_frame
    from gelflow.perception.tracker import MarkerTracker, TrackerConfig, TrackingResult

    try:
        task = InsertionTask.from_json(dict(description["task"]))
        mounts = described(CameraMount, description, "mounts", what="camera mount")
        configs = described(TrackerConfig, description, "trackers", what="tracker settings")
    except KeyError as error:
        raise PeerError(
            f"the session's description lacks {error}: it is not that of a run; a recording of gelflow track, for "
            "example, has no decisions. Record your own with describe_session"
        ) from error
    except TypeError as error:  # a value of another type, in a session that another program wrote
        raise PeerError(f"the session's description is invalid: {error}; expected that of describe_session") from error
    if not len(mounts) == len(configs) == task.sensors:
        raise PeerError(
            f"the session describes {len(mounts)} camera mounts and {len(configs)} trackers; its task has "
            f"{task.sensors} sensors"
        )

    class Tracker:
        """The marker tracker on compressed images."""

        def __init__(self, sensor: int) -> None:
            self._tracker = MarkerTracker(configs[sensor])

        def start(self, data: bytes) -> TrackingResult:
            return self._tracker.start(decode_image(data))

        def track(self, data: bytes) -> TrackingResult:
            return self._tracker.track(decode_image(data))

    def frame(tracked: Sequence[TrackingResult], stamp: float) -> TactileFrame:
        return tactile_frame(tracked, mounts, stamp)

    return task, PerceptionPipeline(Tracker, frame)


def _recorded_checkpoint(description: Mapping[str, Any]) -> Path:
    """The checkpoint of the session, at its recorded path or included in gelflow."""
    from gelflow.policies.checkpoint import shipped_checkpoints

    recorded = description.get("checkpoint")
    if not recorded:
        raise UsageError("the session names no checkpoint; name the policy's file with --checkpoint")
    for path in (Path(recorded["path"]), *shipped_checkpoints()):
        if path.is_file() and file_digest(path) == recorded["digest"]:
            return path
    wanted = f"{recorded['path']} (SHA-256 {recorded['digest'][:12]}…)"
    raise UsageError(f"the session ran {wanted}, which is missing or has changed; name the file with --checkpoint")
