"""Images of a session with their markers: tracked here, or as `gelflow track` has recorded them."""

import contextlib
import dataclasses
from collections import OrderedDict
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import GelflowError, PeerError, UsageError
from gelflow.perception.frames import CameraMount, ImageDecoder, tactile_frame
from gelflow.perception.tracker import MarkerTracker, TrackerConfig, TrackingResult
from gelflow.session.records import SENSORS, described
from gelflow.session.time_index import TimeIndex
from gelflow.view.session.snapshot import PadImage

_REFERENCES = 64  # that are kept
_TRIES = 5  # images that a tracker may start on


class MarkerReader:
    """Reads the newest image of a pad at a time, and its markers relative to a reference. For one thread.

    Parameters
    ----------
    index: of the session
    description: of the session; without one only recorded markers are known
    reference_time: the time [s] of the reference image for an image at a time [s]
    """

    def __init__(
        self, index: TimeIndex, description: Mapping[str, Any], reference_time: Callable[[float], float]
    ) -> None:
        self._index, self._reference_time = index, reference_time
        self.problem = ""  # the reason why nothing is tracked
        self._configs: list[TrackerConfig] = []
        self._mounts: list[CameraMount] = []
        try:
            if "mounts" in description:
                self._mounts = described(CameraMount, description, "mounts", what="camera mount")
            if "trackers" in description:
                self._configs = described(TrackerConfig, description, "trackers", what="tracker settings")
        except UsageError as error:
            self.problem = str(error)
        self._decoders: dict[int, ImageDecoder] = {}
        self._trackers: dict[int, MarkerTracker | str] = {}
        self._tried: dict[int, float] = {}  # duration of the session when a tracker was started last [s]
        self._references: OrderedDict[tuple[int, float], TrackingResult] = OrderedDict()
        self._recorded = {f"/{sensor}/markers" for sensor in SENSORS} & set(index.topics())

    def pad(self, sensor: int, time: float, *, track: bool = True) -> PadImage | None:
        """The newest image of a pad at a time [s]; None before the first one."""
        record = self._index.latest(f"/{SENSORS[sensor]}/image", time)
        if record is None:
            return None
        try:
            pixels = self._decode(sensor, record.value.data)
        except GelflowError as error:
            return PadImage(np.zeros((480, 640, 3), dtype=np.uint8), record.stamp, problem=str(error))
        if not track:
            return PadImage(pixels, record.stamp)
        try:
            tracked = self._track(sensor, pixels, record.time)
        except GelflowError as error:
            return PadImage(pixels, record.stamp, problem=str(error))
        return PadImage(pixels, record.stamp, tracked)

    def is_ready(self) -> bool:
        """Whether the trackers have started, which takes 0.1 s for each pad."""
        return all(sensor in self._trackers for sensor in range(len(self._configs)))

    @property
    def in_millimetres(self) -> bool:
        """Whether `shear` has the unit mm; otherwise the recording does not state how the cameras are mounted."""
        return bool(self._mounts)

    def shear(self, sensor: int, time: float) -> float:
        """Mean shear of a pad along its finger since the reference [mm]; NaN where the markers are not readable.

        Where the mount of the camera is not known, the mean length of the displacements [px].
        """
        pad = self.pad(sensor, time)
        if pad is None or pad.tracked is None:
            return float("nan")
        if sensor >= len(self._mounts):
            lengths = np.linalg.norm(pad.tracked.displacement[pad.tracked.valid], axis=-1)
            return float(lengths.mean()) if len(lengths) else float("nan")
        frame = tactile_frame([pad.tracked], [self._mounts[sensor]], pad.stamp)
        along = frame.shear[0, frame.valid[0], 0]
        return float(along.mean()) if len(along) and frame.unit == "mm" else float("nan")

    def _decode(self, sensor: int, data: bytes) -> NDArray[np.uint8]:
        """The decoded image of a pad. The first one of the session determines the bit depth, as in `gelflow track`."""
        if sensor not in self._decoders:
            decoder = self._decoders[sensor] = ImageDecoder()
            first = self._index.first(f"/{SENSORS[sensor]}/image", self._index.start)
            if first is not None:
                with contextlib.suppress(GelflowError):
                    decoder(first.value.data)
        return self._decoders[sensor](data)

    def _track(self, sensor: int, pixels: NDArray[np.uint8], time: float) -> TrackingResult | None:
        topic = f"/{SENSORS[sensor]}/markers"
        if topic in self._recorded:
            markers = self._index.latest(topic, time + 1e-6)
            return None if markers is None else _recorded_result(markers.value)
        if sensor >= len(self._configs):
            return None
        tracked = self._tracker(sensor).track(pixels)
        rest = self._reference(sensor, self._reference_time(time))
        return dataclasses.replace(
            tracked,
            displacement=tracked.displacement - rest.displacement,
            valid=tracked.valid & rest.valid,
            inferred=(tracked.valid | tracked.inferred) & (rest.valid | rest.inferred) & ~(tracked.valid & rest.valid),
        )

    def _reference(self, sensor: int, time: float) -> TrackingResult:
        """The markers in the reference image at a time [s]."""
        key = sensor, time
        if key not in self._references:
            topic = f"/{SENSORS[sensor]}/image"
            image = self._index.latest(topic, time) or self._index.first(topic, time)
            if image is None:
                raise PeerError("no reference image")
            self._references[key] = self._tracker(sensor).track(self._decode(sensor, image.value.data))
            if len(self._references) > _REFERENCES:
                self._references.popitem(last=False)
        self._references.move_to_end(key)
        return self._references[key]

    def _tracker(self, sensor: int) -> MarkerTracker:
        """The tracker of a pad, which started on the first readable image. Raises PeerError if there is none.

        While a session grows, a failed start is repeated each time its duration has doubled: it takes some 0.1 s.
        """
        found, duration = self._trackers.get(sensor), self._index.end - self._index.start
        if found is None or (isinstance(found, str) and duration > 2 * self._tried[sensor]):
            found = self._trackers[sensor] = self._started(sensor)
            self._tried[sensor] = duration
        if isinstance(found, str):
            raise PeerError(found)
        return found

    def _started(self, sensor: int) -> MarkerTracker | str:
        """A started tracker, or the reason why there is none."""
        problem = "no image"
        for time in np.linspace(self._index.start, self._index.end, _TRIES, endpoint=False):
            image = self._index.first(f"/{SENSORS[sensor]}/image", float(time))
            if image is None:
                continue
            tracker = MarkerTracker(self._configs[sensor])
            try:
                tracker.start(self._decode(sensor, image.value.data))
            except GelflowError as error:
                problem = str(error)
                continue
            return tracker
        return problem


def _recorded_result(values: Mapping[str, Any]) -> TrackingResult:
    return TrackingResult(
        position=np.asarray(values["position_px"], dtype=float),
        displacement=np.asarray(values["displacement_px"], dtype=float),
        valid=np.asarray(values["valid"], dtype=bool),
        inferred=np.asarray(values["inferred"], dtype=bool),
        quality=np.asarray(values["quality"], dtype=float),
        rows=int(values["rows"]),
        cols=int(values["cols"]),
        spacing=float(values["spacing_px"]),
    )
