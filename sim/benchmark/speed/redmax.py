"""The ball rolling run in the published simulator (DiffRedMax), if its Python module `redmax_py` is installed."""

import importlib
import importlib.util
import re
import tempfile
from pathlib import Path

from gelflow.errors import UsageError
from gelflow.measurement.timing import Workload
from gelflow.sim.benchmark.speed.timed_run import TimedRun

MODULE = "redmax_py"


def unavailable_reason(model: Path | None) -> str | None:
    """Reason why the simulator cannot be timed, or None. Raises UsageError for a missing model file."""
    if importlib.util.find_spec(MODULE) is None:
        return f"The paper's simulator is not timed: the Python module {MODULE} is not installed."
    if model is None:
        return f"The paper's simulator is not timed: {MODULE} needs its rolling scene, --paper-model …/tactile_pad.xml."
    if not model.is_file():
        raise UsageError(f"--paper-model must be the paper's tactile_pad.xml, but there is no file {model}")
    return None


class RedMaxRolling:
    """The rolling run on the published `tactile_pad.xml`, with side × side markers."""

    def __init__(self, model: Path, side: int, run: TimedRun) -> None:
        text, changed = re.subn(r'(<tactile [^>]*resolution=)"[^"]*"', rf'\1"{side} {side}"', model.read_text("utf-8"))
        if changed != 1:
            raise UsageError(f'{model}: expected one <tactile … resolution="…"/>, found {changed}')
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / model.name
            file.write_text(text, "utf-8")
            self._sim = importlib.import_module(MODULE).Simulation(str(file))
        self._run = run

    def execute(self) -> None:
        """Execute the run with the calls of the published examples."""
        for steps, u, read in self._run.blocks:
            self._sim.set_u(u)
            self._sim.forward(steps, verbose=False, test_derivatives=False)
            if read:
                self._sim.get_tactile_force_vector()

    def workload(self) -> Workload:
        """The run as a workload; a unit is a step."""
        return Workload(self.execute, self._run.steps, lambda: self._sim.reset(backward_flag=False))
