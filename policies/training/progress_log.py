"""The progress of a training run as a CSV table and as TensorBoard logs, both continued by a resumed run."""

import csv
import math
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from gelflow.policies.evaluation import EvaluationResult

TABLE, LOGS = "progress.csv", "tensorboard"
_TIMES = ("steps", "minutes", "simulation_s", "learning_s", "evaluation_s")
EVALUATION = ("evaluated_success", "success_low", "success_high", "evaluated_length", "evaluated_reward")


class ProgressLog:
    """The files in the folder of a run. Rows beyond `steps`, of an interrupted interval, are dropped."""

    def __init__(self, folder: Path, columns: Sequence[str], steps: int) -> None:
        self._columns = (*_TIMES, *columns, *EVALUATION)
        kept = [row for row in read_table(folder / TABLE) if float(row["steps"]) <= steps] if steps else []
        self._file = (folder / TABLE).open("w", newline="")
        self._writer = csv.DictWriter(self._file, self._columns, restval="")
        self._writer.writeheader()
        self._writer.writerows(kept)
        self._file.flush()
        self._board = _tensorboard(folder / LOGS, steps)

    def add(
        self,
        steps: int,
        minutes: float,
        seconds: Mapping[str, float],
        numbers: Mapping[str, float],
        evaluation: EvaluationResult | None,
    ) -> None:
        """Adds the numbers after an update."""
        row: dict[str, float] = {"minutes": minutes}
        row |= {name: seconds.get(name.removesuffix("_s"), 0.0) for name in _TIMES[2:]}
        row |= numbers
        if evaluation is not None:
            values = (evaluation.success, *evaluation.confidence_interval(), evaluation.length, evaluation.reward)
            row |= dict(zip(EVALUATION, values, strict=True))
        self._writer.writerow({"steps": steps, **{name: f"{value:.6g}" for name, value in row.items()}})
        self._file.flush()
        if self._board is not None:
            for name, value in row.items():
                group = "evaluation" if name in EVALUATION else "time" if name in _TIMES else "training"
                if math.isfinite(value):  # without an episode that ended there is no rate of success
                    self._board.add_scalar(f"{group}/{name}", value, steps)

    def close(self) -> None:
        """Closes the files."""
        self._file.close()
        if self._board is not None:
            self._board.close()


def read_table(path: Path) -> list[dict[str, str]]:
    """The complete rows of a progress table, empty if there is none."""
    if not path.exists():
        return []
    with path.open(newline="") as file:
        return [row for row in csv.DictReader(file) if None not in row.values() and row["steps"]]


def _tensorboard(folder: Path, steps: int) -> Any:
    """A writer of TensorBoard logs; None, with a warning, if tensorboardX is not installed."""
    try:
        from tensorboardX import SummaryWriter
    except ImportError:
        warnings.warn(f"no TensorBoard logs: install tensorboardX; {TABLE} has the same numbers", stacklevel=2)
        return None
    return SummaryWriter(str(folder), purge_step=steps + 1 if steps else None)
