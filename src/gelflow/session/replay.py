"""Makes each recorded decision again from the recorded images, and compares.

The tracker, the step from tracked markers to tactile frames, and the policy are handed in: this module knows only what
a session holds and in which order a live run used it.
"""

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import PeerError
from gelflow.observation import FlowMap, TactileFrame, flow_map
from gelflow.protocols import CameraImage, Policy
from gelflow.session.reader import SessionReader
from gelflow.session.records import SENSORS, Decision
from gelflow.task import InsertionTask


class ImageTracker(Protocol):
    """Follows the markers of one sensor from image to image (compressed bytes). What it returns is opaque here."""

    def start(self, data: bytes) -> Any: ...

    def track(self, data: bytes) -> Any: ...


@dataclass(frozen=True)
class Perception:
    """The way from images to tactile frames, the same as in the live run."""

    tracker: Callable[[int], ImageTracker]  # a fresh tracker for a sensor
    frame: Callable[[Sequence[Any], float], TactileFrame]  # tracked images of all sensors, and a stamp


@dataclass(frozen=True)
class Comparison:
    """A decision as recorded, and as made again."""

    recorded: Decision
    flow: FlowMap
    action: NDArray[np.float64]

    @property
    def action_difference(self) -> float:
        """Largest difference of the action's components [m, m, rad]; infinite where NaN or shapes differ."""
        return difference(self.recorded.action, self.action)

    @property
    def flow_difference(self) -> float:
        """Largest difference of the flow maps' values (largest vector 1), and of their divisors as a share."""
        if self.flow.unit != self.recorded.unit:
            return float("inf")
        divisors = difference(np.array(self.flow.divisor), np.array(self.recorded.divisor))
        share = divisors / max(abs(self.recorded.divisor), np.finfo(float).tiny)
        return max(difference(self.recorded.flow, self.flow.image), share)

    @property
    def identical(self) -> bool:
        return self.action_difference == 0 and self.flow_difference == 0


def difference(one: NDArray[Any], other: NDArray[Any]) -> float:
    """Largest absolute difference; infinite where shapes differ or one is NaN."""
    if one.shape != other.shape:
        return float("inf")
    largest = float(np.abs(one.astype(float) - other.astype(float)).max(initial=0.0))
    return largest if np.isfinite(largest) else float("inf")


def replay(
    session: SessionReader, *, perception: Perception, policy: Policy, task: InsertionTask
) -> Iterator[Comparison]:
    """Each decision of `session` in order, made again. The policy is reset at the start of each insertion.

    Raises PeerError when an image that a decision was made from is not in the file.
    """
    needed: Counter[tuple[int, int]] = Counter()
    for decision in session.decisions():
        if len(decision.tracked) != task.sensors:
            raise PeerError(f"a decision names {len(decision.tracked)} sensors, but the task has {task.sensors}")
        needed.update(_images_of(decision))
    images: dict[tuple[int, int], CameraImage] = {}
    insertion: int | None = None
    # One pass: images stand before the decisions made from them, and are let go after the last of these.
    for record in session.records(["/decision", *(f"/{sensor}/image" for sensor in SENSORS)]):
        if isinstance(record.value, CameraImage):
            sensor = SENSORS.index(record.topic.split("/")[1])
            if (sensor, record.value.sequence) in needed:
                images[sensor, record.value.sequence] = record.value
            continue
        decision = record.value
        if decision.insertion != insertion:
            policy.reset()
            insertion = decision.insertion
        observation = observe(decision, images, perception=perception, task=task)
        yield Comparison(decision, observation, np.asarray(policy.act(observation), dtype=float))
        for key in _images_of(decision):
            needed[key] -= 1
            if needed[key] == 0:
                images.pop(key, None)


def observe(
    decision: Decision, images: dict[tuple[int, int], CameraImage], *, perception: Perception, task: InsertionTask
) -> FlowMap:
    """The flow map of `decision` from images by (sensor, sequence), tracked as the live run tracked them."""
    picked = {(s, sequence) for moment in (decision.reference, *decision.frames) for s, sequence in enumerate(moment)}
    tracked: dict[tuple[int, int], Any] = {}
    for sensor, sequences in enumerate(decision.tracked):
        tracker = perception.tracker(sensor)
        for place, sequence in enumerate(sequences):
            image = images.get((sensor, sequence))
            if image is None:
                raise PeerError(
                    f"insertion {decision.insertion}, attempt {decision.attempt} was decided from image {sequence} of "
                    f"sensor {sensor}, which the session lacks before it; it can not be replayed"
                )
            try:
                tracked[sensor, sequence] = tracker.track(image.data) if place else tracker.start(image.data)
            except PeerError:
                # The live run was told so too, and went on without this image unless it needed it.
                if (sensor, sequence) in picked:
                    raise

    def at(moment: tuple[int, ...]) -> TactileFrame:
        stamp = max(images[sensor, sequence].stamp for sensor, sequence in enumerate(moment))
        return perception.frame([tracked[sensor, sequence] for sensor, sequence in enumerate(moment)], stamp)

    frames = [at(moment) for moment in decision.frames]
    return flow_map(frames, at(decision.reference), grid=task.grid)


def _images_of(decision: Decision) -> set[tuple[int, int]]:
    return {(sensor, sequence) for sensor, sequences in enumerate(decision.tracked) for sequence in sequences}
