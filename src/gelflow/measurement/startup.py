"""Start-up times of gelflow: imports and the command line in fresh processes."""

import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Mapping

from gelflow.measurement.timing import BenchmarkOptions, Report

# name → program, and the limit of its processor time [s] beyond that of an empty program
PROGRAMS: Mapping[str, tuple[str, float | None]] = {
    "python": ("", None),
    "import gelflow": ("import gelflow", 0.2),
    "import gelflow.sim": ("import gelflow.sim", 0.2),
    "gelflow --help": ("from gelflow.cli.main import main; main(['--help'])", 0.3),
}


def measure_startup(options: BenchmarkOptions) -> Report:
    """Time fresh interpreters that import gelflow or print its help, in turn.

    Limits apply to the median processor time, which does not depend on the load of the machine, minus that of an empty
    program.
    """
    options.progress.begin("startup", len(PROGRAMS) * (options.repeats + 1))
    samples: dict[str, list[tuple[float, float]]] = {name: [] for name in PROGRAMS}
    for repeat in range(options.repeats + 1):
        for name, (program, _) in PROGRAMS.items():
            times = _process_times(program)
            if repeat > 0:  # the first round fills the file cache and compiles bytecode
                samples[name].append(times)
            options.progress.advance()
    wall, cpu = ({name: statistics.median(t[i] for t in times) for name, times in samples.items()} for i in (0, 1))
    rows, results, violations = [], [], []
    for name, (_, limit) in PROGRAMS.items():
        own = cpu[name] - cpu["python"]
        figures = (f"{1e3 * wall[name]:.0f}", f"{1e3 * cpu[name]:.0f}")
        rows.append((name, *figures, *(("", "") if limit is None else (f"{1e3 * own:.0f}", f"{1e3 * limit:.0f}"))))
        results.append({"program": name, "seconds": wall[name], "cpu_seconds": cpu[name], "own": own, "limit": limit})
        if limit is not None and own > limit:
            violations.append(f"startup, {name}: {own:.2f} s of processor time, allowed is {limit:g} s")
    return Report(
        name="startup",
        title="Start-up: ms of a fresh process",
        columns=("program", "wall clock", "processor", "− python", "limit"),
        rows=rows,
        note=f"Medians of {options.repeats} processes. − python: processor time beyond that of an empty program.",
        results=results,
        violations=violations,
    )


def _process_times(program: str) -> tuple[float, float]:
    """Wall-clock and processor time of one Python process [s]. Raises CalledProcessError when it fails."""
    start, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([sys.executable, "-c", program], check=True, capture_output=True)
    elapsed, after = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
    return elapsed, after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime
