"""The image classes of the tracking benchmark."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from gelflow.perception.benchmark.baselines import TRACKERS
from gelflow.perception.benchmark.metrics import TrackedSequence, run_trackers
from gelflow.perception.synthetic.appearance import FACTORS, PRESETS, DegradedGelAppearance, make_appearance
from gelflow.perception.synthetic.sequences import FIELDS, Field, GelSequence

if TYPE_CHECKING:
    from gelflow.perception.benchmark.baselines import BenchmarkTracker

SMALL, LARGE = (320, 240), (640, 480)  # image sizes [px]
MARKERS = (63, 130, 154)
MOST_MARKERS = 252  # those of a GelSlim; timed only


@dataclass(frozen=True)
class ImageClass:
    """A class of images: a preset with changed parameters."""

    name: str
    preset: str
    changed: Mapping[str, Any]
    markers: int = 130
    size: tuple[int, int] = SMALL  # width, height [px]

    def appearance(self, seed: int) -> DegradedGelAppearance:
        """The appearance with the illumination and print of `seed`."""
        width, height = self.size
        size = {"markers": self.markers, "width": width, "height": height}
        return make_appearance(self.preset, seed=seed, **size, **dict(self.changed))

    def track(self, names: Iterable[str], fields: Sequence[Field], **motion: Any) -> dict[str, list[TrackedSequence]]:
        """Tracks one sequence per field, each with another print and illumination, by the trackers `names`.

        `motion` are further fields of `GelSequence`.
        """
        sequences: dict[str, list[TrackedSequence]] = {name: [] for name in names}
        for field in fields:
            appearance = self.appearance(seed=FIELDS.index(field))
            trackers: dict[str, BenchmarkTracker] = {name: TRACKERS[name]() for name in sequences}
            sequence = GelSequence(appearance, field, **motion)
            tracked = run_trackers(sequence, appearance.grid.rows, appearance.grid.cols, trackers)
            for name, result in tracked.items():
                sequences[name].append(result)
        return sequences


CLASSES = tuple(ImageClass(preset, preset, {}) for preset in PRESETS)
SIZED = tuple(
    ImageClass(f"{preset} {markers}{' 640' if size == LARGE else ''}", preset, {}, markers, size)
    for preset in PRESETS
    for size in (SMALL, LARGE)
    for markers in MARKERS
    if (markers, size) != (130, SMALL)
)
FACTORED = tuple(ImageClass(name, "typical", changed) for name, changed in FACTORS.items())
