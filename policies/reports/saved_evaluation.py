"""The folder that `gelflow eval --out` has written, read again for a page."""

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image as Pictures
from PIL import ImageSequence

from gelflow.errors import UsageError
from gelflow.policies.reports.evaluation_report import EPISODES, FAILURE_PICTURE, FORMAT, RESULTS
from gelflow.policies.reports.failures import FailureRange, worst_ranges
from gelflow.policies.reports.shown_episodes import Image, ShownEpisodes

_LENGTHS = ("corrections", "attempts", "steps")  # units of the length of an episode


class SavedEvaluation:
    """The folder of an evaluation.

    Raises UsageError when it is not one.
    """

    def __init__(self, folder: Path) -> None:
        if not is_evaluation(folder):
            raise UsageError(f"{folder} is not the folder of an evaluation: it needs {RESULTS} and {EPISODES}")
        self.folder = folder
        self._read = 0  # time of change of the newest file that was read [ns]

    @property
    def name(self) -> str:
        """The folder's name."""
        return self.folder.resolve().name

    def curve(self) -> Image | None:
        """None: an evaluation has no learning curve."""
        return None

    def evaluate(self, progress: Callable[[str], None] = lambda text: None) -> ShownEpisodes | None:
        """The results, failures and films in the folder; None if nothing has changed since the last call.

        Raises UsageError when a file cannot be read or has a newer format.
        """
        newest = max((path.stat().st_mtime_ns for path in self.folder.iterdir()), default=0)
        if newest == self._read:
            return None
        self._read = newest
        progress("reading the films")
        try:
            text = _text(_read_results(self.folder / RESULTS))
            failures = self.folder / FAILURE_PICTURE
            picture = np.asarray(Pictures.open(failures).convert("RGB")) if failures.is_file() else None
            found = {name: self.folder / f"{name}.gif" for name in ("success", "failure")}
            films = {name: _film(path) for name, path in found.items() if path.is_file()}
        except (LookupError, TypeError, ValueError, OSError) as error:
            if isinstance(error, UsageError):
                raise
            raise UsageError(f"{self.folder} cannot be read: {error}; run gelflow eval again") from error
        rate = max((rate for _, rate in films.values()), default=1.0)
        return ShownEpisodes(text, picture, {name: frames for name, (frames, _) in films.items()}, rate)


def is_evaluation(folder: Path) -> bool:
    """Whether the folder has the files of `gelflow eval --out`."""
    return (folder / RESULTS).is_file() and (folder / EPISODES).is_file()


def _read_results(path: Path) -> dict[str, Any]:
    """The contents of `results.json`. Raises UsageError when it has a newer format."""
    values = dict(json.loads(path.read_text("utf-8")))
    version = values.get("format", 1)  # the first version wrote no number
    if version > FORMAT:
        raise UsageError(f"{path} has format {version}; this gelflow reads format {FORMAT}: update gelflow")
    return values


def _text(values: Mapping[str, Any]) -> str:
    """The results as a Markdown table, and the quantities on which failures depend most."""
    rows = values["results"]
    unit = next((unit for unit in _LENGTHS if unit in rows[0]), "length")
    lines = [f"| | success | 95 % | {unit} | return |", "|---|---|---|---|---|"]
    for row in rows:
        low, high = row["success_95"]
        length = "" if row.get(unit) is None else f"{row[unit]:.2f}"
        numbers = f"{row['success']:.1%} | {low:.1%} to {high:.1%} | {length} | {row['reward']:.1f}"
        lines.append(f"| {row['name']} of {row['episodes']} episodes | {numbers} |")
    ranges = [FailureRange.from_json(entry) for entry in values["failures"]]
    return "\n".join([*lines, "", *(f"{line}  " for line in worst_ranges(ranges))])


def _film(path: Path) -> tuple[list[Image], float]:
    """The frames of a GIF, and their rate [1/s]."""
    with Pictures.open(path) as film:
        duration = film.info.get("duration", 1000)
        frames = [np.asarray(frame.convert("RGB")) for frame in ImageSequence.Iterator(film)]
    return frames, 1000 / max(duration, 1)
