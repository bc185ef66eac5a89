"""Forces on the pads during a run: estimated in a helper process from the tracked images, and recorded.

No decision waits for an estimate: the observer passes on its results after the decisions that they lead to, a thread
sends the newest one of each pad to the helper, and results that arrive meanwhile replace those that wait.
"""

import contextlib
import threading
import time
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import GelflowError
from gelflow.gel.gel_file import ElasticGel
from gelflow.helper_process import HelperProcess
from gelflow.perception.force.image_forces import GridScale, grid_angle
from gelflow.perception.frames import CameraMount
from gelflow.perception.tracker import TrackingResult
from gelflow.protocols import CameraImage
from gelflow.real.runner.lab import Lab
from gelflow.real.runner.touch.force_process import estimator_settings
from gelflow.session.recorder import SessionRecorder

_KEPT = 64  # estimates
_LONGEST_WAIT = 0.5  # for the estimate of one image [s, wall]
_END_LIMIT = 1.0  # of thread and process [s, wall]

ForceRecord = dict[str, Any]  # as `gelflow.Force` in sessions, without its stamp


@dataclass(frozen=True)
class RestingPad:
    """The markers of an unloaded pad."""

    position: NDArray[np.float64]  # (right, down) [px], shape (markers, 2)
    valid: NDArray[np.bool_]  # measured, shape (markers,)


@dataclass(frozen=True)
class _Tracked:
    """The newest result of one pad."""

    rest: RestingPad
    image: CameraImage
    result: TrackingResult


class PadForces:
    """Estimates and records the forces on the pads that have a gel. Use `with`.

    Forces are known from `set_rest` on. `problem` states why there are none any more; the run goes on without them.
    """

    def __init__(
        self, gels: Sequence[ElasticGel | None], mounts: Sequence[CameraMount], recorder: SessionRecorder
    ) -> None:
        """One gel (None: no forces on this pad) and one mount per sensor; every mount of a gel has a scale."""
        self._mounts, self._recorder = mounts, recorder
        self._gels = {sensor: gel for sensor, gel in enumerate(gels) if gel is not None}
        self._changed = threading.Condition()
        self._rest: dict[int, RestingPad] = {}
        self._newest: dict[int, _Tracked] = {}  # results that wait, by sensor
        self._known: deque[tuple[int, int, ForceRecord | None]] = deque(maxlen=_KEPT)  # sensor, sequence, estimate
        self._ended = False
        self.problem = ""
        self._thread = threading.Thread(target=self._run, name="forces of the pads", daemon=True)

    def __enter__(self) -> "PadForces":
        pads = {
            sensor: estimator_settings(gel, self._mounts[sensor].image_grid, _scale(self._mounts[sensor]))
            for sensor, gel in self._gels.items()
        }
        self._helper = HelperProcess.start("gelflow.real.runner.touch.force_process", {"pads": pads})
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        with self._changed:
            self._ended = True
            self._changed.notify_all()
        self._thread.join(_END_LIMIT)
        self._helper.close()

    def set_rest(self, pads: Sequence[RestingPad]) -> None:
        """Set the unloaded pads, one per sensor, relative to which forces are estimated from now on."""
        with self._changed:
            self._rest = dict(enumerate(pads))
            self._newest.clear()

    def add(self, sensor: int, image: CameraImage, result: TrackingResult) -> None:
        """Estimate the forces in an image, unless a newer one of this pad arrives before. Returns at once."""
        with self._changed:
            if sensor in self._gels and sensor in self._rest:
                self._newest[sensor] = _Tracked(self._rest[sensor], image, result)
                self._changed.notify_all()

    def of(self, images: Sequence[CameraImage]) -> tuple[ForceRecord | None, ...]:
        """The estimates of one image per sensor, which was passed to `add`; waits for them, at most 0.5 s.

        None for a pad without a gel, with too few valid markers, and where the estimate is late.
        """
        wanted = {(sensor, image.sequence) for sensor, image in enumerate(images) if sensor in self._gels}
        end = time.monotonic() + _LONGEST_WAIT
        with self._changed:
            while not wanted <= {known[:2] for known in self._known} and not self._ended:
                if (left := end - time.monotonic()) <= 0:
                    break
                self._changed.wait(left)
            estimates = {known[:2]: known[2] for known in self._known}
        return tuple(estimates.get((sensor, image.sequence)) for sensor, image in enumerate(images))

    def _run(self) -> None:
        """Body of the thread: estimate and record until the end of the run, or of the helper."""
        used: dict[int, RestingPad] = {}
        try:
            while waiting := self._take():
                for sensor, tracked in waiting.items():
                    begin: dict[str, Any] = {}
                    if used.get(sensor) is not tracked.rest:
                        used[sensor] = tracked.rest
                        begin = {"angle": grid_angle(tracked.rest.position, *self._mounts[sensor].image_grid)}
                    self._estimate(sensor, tracked, begin)
        except (OSError, ValueError, GelflowError) as error:  # ValueError: this side has closed the link
            self._end(str(error))

    def _take(self) -> dict[int, _Tracked]:
        """The results that wait; empty at the end of the run."""
        with self._changed:
            while not self._newest and not self._ended:
                self._changed.wait()
            waiting, self._newest = self._newest, {}
            return {} if self._ended else waiting

    def _estimate(self, sensor: int, tracked: _Tracked, begin: dict[str, Any]) -> None:
        """Estimate and record; `begin` is part of the first request after a new rest, and otherwise empty."""
        request = _request(tracked, self._mounts[sensor])
        self._helper.messages.send(request | {"sensor": sensor} | begin)
        answers = self._helper.messages.wait()
        if not answers:
            raise ConnectionError(self._helper.exit_reason())
        if answers[0] is not None:
            self._recorder.force(sensor, tracked.image.stamp, answers[0])
        with self._changed:
            self._known.append((sensor, tracked.image.sequence, answers[0]))
            self._changed.notify_all()

    def _end(self, reason: str) -> None:
        with self._changed:
            if self._ended:
                return
            self._ended = True
            self._changed.notify_all()
        self.problem = f"the forces on the pads are not estimated any more: {reason}"
        with contextlib.suppress(GelflowError):
            self._recorder.event("forces ended", {"reason": reason})


@contextlib.contextmanager
def pad_forces(lab: Lab, recorder: SessionRecorder) -> Iterator[PadForces | None]:
    """The estimates of a run; None where no pad has a gel, and then nothing is started."""
    cameras = (lab.cameras.left, lab.cameras.right)
    gels = [camera.elastic_gel for camera in cameras]
    if not any(gels):
        yield None
        return
    with PadForces(gels, [camera.mount for camera in cameras], recorder) as forces:
        yield forces


def _scale(mount: CameraMount) -> GridScale:
    if mount.calibration is not None:
        return GridScale(mount.pitch, float(np.mean(mount.calibration.pixels_per_mm())), along_grid=True)
    assert mount.pixels_per_mm is not None, "the lab file states a scale"
    return GridScale(mount.pitch, mount.pixels_per_mm)


def _request(tracked: _Tracked, mount: CameraMount) -> dict[str, Any]:
    """A request: displacements (right, down) [mm] from the unloaded pad, shape (markers, 2), and validity."""
    displacement = tracked.result.position - tracked.rest.position
    moved = mount.displacement_mm(replace(tracked.result, displacement=displacement))
    valid = tracked.result.valid & tracked.rest.valid
    return {
        "stamp": tracked.image.stamp,
        "displacement_mm": np.where(valid[:, None], moved, 0.0).tolist(),
        "valid": valid.tolist(),
    }
