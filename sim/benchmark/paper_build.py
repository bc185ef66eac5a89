"""The paper's own simulator in the same run, where a user has built it: its public Python module, `redmax_py`."""

import importlib
import importlib.util
import re
import tempfile
from pathlib import Path

from gelflow.errors import UsageError
from gelflow.measurement.timing import Workload
from gelflow.sim.benchmark.runs import TimedRun

MODULE = "redmax_py"


def unavailable_reason(model: Path | None) -> str | None:
    """Why it is not timed, in one line; None where it is. Raises UsageError where the model file can't be read."""
    if importlib.util.find_spec(MODULE) is None:
        return f"The paper's simulator is not timed: no Python module {MODULE} here."
    if model is None:
        return (
            f"The paper's simulator is not timed: give its rolling scene, --paper-model …/tactile_pad.xml, to {MODULE}."
        )
    if not model.is_file():
        raise UsageError(f"--paper-model must be the paper's tactile_pad.xml, but there is no file {model}")
    return None


class PaperRolling:
    """The run on the paper's `tactile_pad.xml`, with side × side markers."""

    def __init__(self, model: Path, side: int, run: TimedRun) -> None:
        text, changed = re.subn(r'(<tactile [^>]*resolution=)"[^"]*"', rf'\1"{side} {side}"', model.read_text("utf-8"))
        if changed != 1:
            raise UsageError(f'{model}: expected one <tactile … resolution="…"/>, found {changed}')
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / model.name
            file.write_text(text, "utf-8")
            self._sim = importlib.import_module(MODULE).Simulation(str(file))
        self._run = run

    def go(self) -> None:
        """The run, as the paper's own examples step and read it."""
        for steps, u, read in self._run.blocks:
            self._sim.set_u(u)
            self._sim.forward(steps, verbose=False, test_derivatives=False)
            if read:
                self._sim.get_tactile_force_vector()

    def work(self) -> Workload:
        """To time it."""
        return Workload(self.go, self._run.steps, lambda: self._sim.reset(backward_flag=False))
