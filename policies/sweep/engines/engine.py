"""The interface of engines. An engine does not repeat runs: the sweep decides which run is started again."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from types import TracebackType

from gelflow.policies.sweep.run import Run, RunRecord

_REASON = 200  # characters of a reason; some are whole tracebacks


class Engine(ABC):
    """Executes runs with `gelflow.policies.sweep.run_process` on machines that share the folder of the sweep."""

    @abstractmethod
    def submit(self, runs: Sequence[Run]) -> None:
        """Queue runs; returns at once."""

    @abstractmethod
    def ended(self) -> list[tuple[Run, RunRecord]]:
        """The runs that ended since the last call, possibly none; waits for a short time.

        A run whose worker was lost or could not start it has a record with state "failed" and without exit code.
        """

    @abstractmethod
    def close(self) -> None:
        """Release the engine. The class states what happens to runs that have not ended."""

    def __enter__(self) -> "Engine":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def lost(run: Run, reason: str) -> RunRecord:
    """The record of a run whose worker was lost."""
    text = " ".join(reason.split())
    return RunRecord(run.name, run.arguments, "failed", error=f"its worker was lost: {text[:_REASON]}")
