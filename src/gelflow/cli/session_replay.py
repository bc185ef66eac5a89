"""Task, perception and policy of a recorded session, from its description."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from gelflow.errors import PeerError, UsageError
from gelflow.observation import TactileFrame
from gelflow.session.decision_replay import PerceptionPipeline
from gelflow.session.records import file_digest, from_plain
from gelflow.task import InsertionTask


def recorded_perception(description: Mapping[str, Any]) -> tuple[InsertionTask, PerceptionPipeline]:
    """Task and perception of the session's description. Raises PeerError when the description lacks a part."""
    from gelflow.perception.frames import CameraMount, decode_image, tactile_frame
    from gelflow.perception.tracker import MarkerTracker, TrackerConfig, TrackingResult

    try:
        task = InsertionTask.from_json(dict(description["task"]))
        mounts = [from_plain(CameraMount, mount, what="camera mount") for mount in description["mounts"]]
        configs = [from_plain(TrackerConfig, config, what="tracker settings") for config in description["trackers"]]
    except KeyError as error:
        raise PeerError(f"the session's description lacks {error}; record it with describe_session") from error

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


def recorded_checkpoint(description: Mapping[str, Any]) -> Path:
    """The checkpoint of the session, at its recorded path or shipped with gelflow."""
    from gelflow.policies.checkpoint import shipped_checkpoints

    recorded = description.get("checkpoint")
    if not recorded:
        raise UsageError("the session names no checkpoint; name the policy's file with --checkpoint")
    for path in (Path(recorded["path"]), *shipped_checkpoints()):
        if path.is_file() and file_digest(path) == recorded["digest"]:
            return path
    wanted = f"{recorded['path']} (SHA-256 {recorded['digest'][:12]}…)"
    raise UsageError(f"the session ran {wanted}, which is missing or has changed; name the file with --checkpoint")
