"""The progress of a training run as a CSV table and as TensorBoard logs, both continued by a resumed run."""

import csv
import io
import math
import time
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path

from gelflow.policies.checkpoint import replace_file
from gelflow.policies.evaluation import EvaluationResult

TABLE, LOGS = "progress.csv", "tensorboard"
_TIMES = ("steps", "minutes", "simulation_s", "learning_s", "evaluation_s")
EVALUATION = ("evaluated_success", "success_low", "success_high", "evaluated_length", "evaluated_reward")


def table_columns(columns: Sequence[str]) -> tuple[str, ...]:
    """The columns of the table of a learner with these `columns`; the first one counts the steps."""
    return (*_TIMES, *columns, *EVALUATION)


class ProgressLog:
    """The files in the folder of a run. Rows beyond `steps`, of an interrupted interval, are dropped."""

    def __init__(self, folder: Path, columns: Sequence[str], steps: int) -> None:
        self._columns = table_columns(columns)
        kept = [row for row in read_table(folder / TABLE) if float(row["steps"]) <= steps] if steps else []
        table = io.StringIO(newline="")
        writer = csv.DictWriter(table, self._columns)
        writer.writeheader()
        writer.writerows(kept)
        replace_file(folder / TABLE, table.getvalue().encode())  # as a whole: a full disk must not empty the table
        self._file = (folder / TABLE).open("a", newline="", encoding="utf-8")
        self._writer = csv.DictWriter(self._file, self._columns, restval="")
        self._board = _tensorboard(folder / LOGS, steps)

    def add(
        self,
        steps: int,
        minutes: float,
        seconds: Mapping[str, float],
        numbers: Mapping[str, float],
        evaluation: EvaluationResult | None,
    ) -> None:
        """Adds the numbers after an update; the cell of a number that is not finite stays empty."""
        row: dict[str, float] = {"minutes": minutes}
        row |= {name: seconds.get(name.removesuffix("_s"), 0.0) for name in _TIMES[2:]}
        row |= numbers
        if evaluation is not None:
            values = (evaluation.success, *evaluation.confidence_interval(), evaluation.length, evaluation.reward)
            row |= dict(zip(EVALUATION, values, strict=True))
        row = {name: value for name, value in row.items() if math.isfinite(value)}  # no success, no mean length
        self._writer.writerow({"steps": steps, **{name: f"{value:.6g}" for name, value in row.items()}})
        self._file.flush()
        if self._board is not None:
            self._board.add(steps, row)

    def close(self) -> None:
        """Closes the files."""
        self._file.close()
        if self._board is not None:
            self._board.close()


class _TensorBoard:
    """TensorBoard logs, written by the calling thread.

    The `SummaryWriter` of tensorboardX writes in a thread: when this thread fails, as on a full disk, the training
    waits for it forever.
    """

    def __init__(self, folder: Path, steps: int) -> None:
        """Raises ImportError without tensorboardX."""
        from tensorboardX import event_file_writer, summary
        from tensorboardX.proto import event_pb2

        self._event, self._scalar = event_pb2.Event, summary.scalar
        folder.mkdir(exist_ok=True)
        self._file = event_file_writer.EventsWriter(str(folder / "events"))
        if steps:  # TensorBoard hides the later steps of the interrupted process
            session = event_pb2.SessionLog(status=event_pb2.SessionLog.START)
            self._file.write_event(self._event(wall_time=time.time(), step=steps + 1, session_log=session))

    def add(self, steps: int, numbers: Mapping[str, float]) -> None:
        """Adds the numbers after an update."""
        for name, value in numbers.items():
            group = "evaluation" if name in EVALUATION else "time" if name in _TIMES else "training"
            summary = self._scalar(f"{group}/{name}", value)
            self._file.write_event(self._event(wall_time=time.time(), step=steps, summary=summary))
        self._file.flush()

    def close(self) -> None:
        """Closes the file."""
        self._file.close()


def read_table(path: Path) -> list[dict[str, str]]:
    """The complete rows of a progress table, empty if there is none."""
    if not path.exists():
        return []
    with path.open(newline="") as file:
        return [row for row in csv.DictReader(file) if None not in row.values() and row["steps"]]


def _tensorboard(folder: Path, steps: int) -> _TensorBoard | None:
    """TensorBoard logs; None, with a warning, if tensorboardX is not installed."""
    try:
        return _TensorBoard(folder, steps)
    except ImportError:
        warnings.warn(f"no TensorBoard logs: install tensorboardX; {TABLE} has the same numbers", stacklevel=2)
        return None
