"""Replay of a session: recomputes each decision from the recorded images and compares it with the recorded one.

The tracker, the conversion to tactile frames and the policy are arguments. This module depends only on the contents of
a session and on the order in which the live run used them. A decision whose images are missing or damaged is skipped;
its recorded flow map then takes the place of the recomputed one, so that the policy has the same state in the next
decision as in the live run.
"""

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import PeerError, UsageError
from gelflow.observation import FlowMap, TactileFrame, flow_map
from gelflow.protocols import CameraImage, Policy
from gelflow.session.messages import Damage
from gelflow.session.reader import SessionReader
from gelflow.session.records import SENSORS, Decision
from gelflow.task import InsertionTask


class ImageTracker(Protocol):
    """Tracks the markers of one sensor from image to image (compressed bytes). The result type is opaque here."""

    def start(self, data: bytes) -> Any: ...

    def track(self, data: bytes) -> Any: ...


@dataclass(frozen=True)
class PerceptionPipeline:
    """Conversion of images to tactile frames, the same as in the live run."""

    tracker: Callable[[int], ImageTracker]  # creates a tracker for a sensor
    frame: Callable[[Sequence[Any], float], TactileFrame]  # from the tracked images of all sensors and a stamp [s]


@dataclass(frozen=True)
class Comparison:
    """A recorded decision and the recomputed one."""

    recorded: Decision
    flow: FlowMap  # recomputed
    action: NDArray[np.float64]  # recomputed, shape (3,) [m, m, rad]
    skipped: str = ""  # the reason why the flow map could not be recomputed; `flow` is then the recorded one

    @property
    def action_difference(self) -> float:
        """Largest difference of the action components [m, m, rad]; infinite for NaN or different shapes."""
        return difference(self.recorded.action, self.action)

    @property
    def flow_difference(self) -> float:
        """Largest difference of the flow map values (longest vector 1) and relative difference of the divisors."""
        if self.flow.unit != self.recorded.unit:
            return float("inf")
        divisors = difference(np.array(self.flow.divisor), np.array(self.recorded.divisor))
        relative = divisors / max(abs(self.recorded.divisor), np.finfo(float).tiny)
        return max(difference(self.recorded.flow, self.flow.image), relative)

    @property
    def identical(self) -> bool:
        """Whether the decision was recomputed and agrees in every bit."""
        return not self.skipped and not self.differs

    @property
    def differs(self) -> bool:
        """Whether the action or the flow map differs in any bit."""
        return self.action_difference > 0 or self.flow_difference > 0


def difference(one: NDArray[Any], other: NDArray[Any]) -> float:
    """Largest absolute difference; infinite for NaN or different shapes."""
    if one.shape != other.shape:
        return float("inf")
    largest = float(np.abs(one.astype(float) - other.astype(float)).max(initial=0.0))
    return largest if np.isfinite(largest) else float("inf")


def replay(
    session: SessionReader,
    *,
    perception: PerceptionPipeline,
    policy: Policy,
    task: InsertionTask,
    damage: Damage | None = None,
) -> Iterator[Comparison]:
    """Recompute the decisions of `session` in order. The policy is reset at the start of each insertion.

    A decision whose images are missing or unreadable is `skipped`: only its action is recomputed, from the recorded
    flow map. With `damage`, damaged records are counted in it and passed over; without, they raise PeerError. A
    decision whose own record is lost does not appear: from there to the end of its insertion, a policy with a memory
    does not have the state of the live run.
    """
    reading = Damage() if damage is not None else None  # the first pass reads a part of the same records
    needed: Counter[tuple[int, int]] = Counter()
    for record in session.records(["/decision"], damage=reading):
        if len(record.value.tracked) != task.sensors:
            raise PeerError(f"a decision names {len(record.value.tracked)} sensors, but the task has {task.sensors}")
        needed.update(_images_of(record.value))
    images: dict[tuple[int, int], CameraImage] = {}
    insertion: int | None = None
    # One pass over the file: images precede their decisions and are dropped after the last one that uses them.
    topics = ["/decision", *(f"/{sensor}/image" for sensor in SENSORS)]
    for record in session.records(topics, damage=damage):
        if isinstance(record.value, CameraImage):
            sensor = SENSORS.index(record.topic.split("/")[1])
            if (sensor, record.value.sequence) in needed:
                images[sensor, record.value.sequence] = record.value
            continue
        decision = record.value
        if decision.insertion != insertion:
            policy.reset()
            insertion = decision.insertion
        yield _compare(decision, images, perception=perception, policy=policy, task=task)
        for key in _images_of(decision):
            needed[key] -= 1
            if needed[key] == 0:
                images.pop(key, None)


def _compare(
    decision: Decision,
    images: dict[tuple[int, int], CameraImage],
    *,
    perception: PerceptionPipeline,
    policy: Policy,
    task: InsertionTask,
) -> Comparison:
    skipped = ""
    try:
        observation = observe(decision, images, perception=perception, task=task)
    except PeerError as error:
        skipped, observation = str(error), decision.observation
    return Comparison(decision, observation, np.asarray(policy.act(observation), dtype=float), skipped)


def observe(
    decision: Decision,
    images: dict[tuple[int, int], CameraImage],
    *,
    perception: PerceptionPipeline,
    task: InsertionTask,
) -> FlowMap:
    """The flow map of `decision`, from images by (sensor, sequence), tracked in the order of the live run.

    Raises PeerError when an image is missing, or when one that the decision requires is unreadable.
    """
    required = {(s, sequence) for moment in (decision.reference, *decision.frames) for s, sequence in enumerate(moment)}
    tracked: dict[tuple[int, int], Any] = {}
    for sensor, sequences in enumerate(decision.tracked):
        tracker = perception.tracker(sensor)
        for order, sequence in enumerate(sequences):
            image = images.get((sensor, sequence))
            if image is None:
                raise PeerError(f"image {sequence} of the {SENSORS[sensor]} camera is missing")
            try:
                tracked[sensor, sequence] = tracker.track(image.data) if order else tracker.start(image.data)
            except (PeerError, UsageError) as error:
                # The live run got the same error, and continued unless the decision required this image.
                if (sensor, sequence) in required:
                    text = f"image {sequence} of the {SENSORS[sensor]} camera is unreadable: {error}"
                    raise PeerError(text) from error

    def at(moment: tuple[int, ...]) -> TactileFrame:
        stamp = max(images[sensor, sequence].stamp for sensor, sequence in enumerate(moment))
        return perception.frame([tracked[sensor, sequence] for sensor, sequence in enumerate(moment)], stamp)

    frames = [at(moment) for moment in decision.frames]
    return flow_map(frames, at(decision.reference), grid=task.grid)


def _images_of(decision: Decision) -> set[tuple[int, int]]:
    return {(sensor, sequence) for sensor, sequences in enumerate(decision.tracked) for sequence in sequences}
