"""A promise of the runner, and the outcome of its scenario on the mock robot."""

import math
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from gelflow.errors import GelflowError
from gelflow.mock_lab.promises.rig import FalseStop

_TRIES = 3  # of a scenario that a busy computer ended before its fault


@dataclass(frozen=True)
class Outcome:
    """The result of a scenario."""

    value: float  # in the unit of the promise
    broken: tuple[str, ...] = ()  # conditions that do not hold
    note: str = ""


@dataclass(frozen=True)
class Promise:
    """One promise: it holds when its scenario breaks no condition and measures at most `bound`."""

    name: str
    text: str
    measured: str  # the quantity that the scenario measures
    bound: float
    unit: str
    scenario: Callable[[Path], Outcome]  # its argument is an empty folder
    tests: tuple[str, ...]  # that show the same without a measured time: file::function


@dataclass(frozen=True)
class Row:
    """The result of one promise."""

    promise: Promise
    outcome: Outcome
    seconds: float  # duration of the scenario

    @property
    def held(self) -> bool:
        """Whether the promise was held."""
        return not self.outcome.broken and self.outcome.value <= self.promise.bound


def conditions(**conditions: bool) -> tuple[str, ...]:
    """Names of the conditions that are false, in words."""
    return tuple(name.replace("_", " ") for name, holds in conditions.items() if not holds)


def measure(promise: Promise) -> Row:
    """Run the scenario of a promise; repeats it when a busy computer ended it too early."""
    begun = time.monotonic()
    stops: list[str] = []
    outcome = Outcome(math.inf)
    for _ in range(_TRIES):
        with tempfile.TemporaryDirectory(prefix="gelflow-promise-") as folder:
            try:
                outcome = promise.scenario(Path(folder))
                break
            except FalseStop as error:
                stops.append(str(error))
                outcome = Outcome(math.inf, ("the scenario was reached",))
            except GelflowError as error:
                outcome = Outcome(math.inf, (str(error),))
                break
    note = outcome.note
    if stops:
        note = "; ".join(filter(None, [note, f"{len(stops)} earlier stops by the load of this computer: {stops[-1]}"]))
    return Row(promise, Outcome(outcome.value, outcome.broken, note), time.monotonic() - begun)
