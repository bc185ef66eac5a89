"""Runs as jobs of SLURM, through submitit."""

import importlib
import platform
import shlex
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from gelflow.errors import UsageError
from gelflow.policies.sweep.engines.engine import Engine, lost
from gelflow.policies.sweep.run import Run, RunRecord, check_arguments
from gelflow.policies.sweep.run_process import execute
from gelflow.toml_tables import TomlTable

_POLL = 0.5  # [s, wall]; submitit asks SLURM itself less often
_UNKNOWN_LIMIT = 600.0  # time from the submission of a job until `sacct` lists it [s, wall]
_TIME_LIMITS = 1000  # a run may reach the time limit of its job as often; it continues each time


@dataclass(frozen=True)
class SlurmSettings:
    """Table `[slurm]` of a grid file."""

    minutes: int = 60  # time limit of a job; a run that needs longer is queued again and continues
    memory_gb: float | None = None
    partition: str | None = None
    account: str | None = None
    qos: str | None = None
    parallel: int | None = None  # jobs at a time; None: as many as SLURM permits
    setup: tuple[str, ...] = ()  # shell commands before a run, such as the activation of an environment
    sbatch: dict[str, Any] = field(default_factory=dict)  # further options of sbatch
    cluster: str = "slurm"  # "local": the jobs are processes of this machine, to try a grid file out

    @classmethod
    def from_table(cls, table: TomlTable) -> "SlurmSettings":
        """Raises UsageError for an unknown key or a wrong value."""
        table.check_keys(cls.__dataclass_fields__)
        given: dict[str, Any] = {key: table.integer(key) for key in ("minutes", "parallel") if key in table.data}
        given |= {key: table.string(key) for key in ("partition", "account", "qos") if key in table.data}
        if "memory_gb" in table.data:
            given["memory_gb"] = table.number("memory_gb", minimum=0)
        if "setup" in table.data:
            given["setup"] = table.strings("setup")
        cluster = table.string("cluster", "slurm", choices=("slurm", "local"))
        return cls(cluster=cluster, sbatch=dict(table.table("sbatch").data), **given)

    def parameters(self, cpus: int) -> dict[str, Any]:
        """The settings under submitit's names, without those that are not given."""
        values = {
            "timeout_min": self.minutes,
            "mem_gb": self.memory_gb,
            "cpus_per_task": cpus,
            "slurm_partition": self.partition,
            "slurm_account": self.account,
            "slurm_qos": self.qos,
            "slurm_array_parallelism": self.parallel,
            "slurm_setup": list(self.setup) or None,
            "slurm_additional_parameters": self.sbatch or None,
            "name": "gelflow",
        }
        return {name: value for name, value in values.items() if value is not None}


class SlurmEngine(Engine):
    """Each run is a job; runs that are submitted together are one job array.

    `close` leaves the jobs in the queue, and another engine with the same folder waits for them instead of submitting
    their runs again. Raises UsageError when submitit is not installed or this machine has no SLURM.
    """

    def __init__(self, folder: Path, settings: SlurmSettings, *, cpus: int) -> None:
        try:
            submitit: Any = importlib.import_module("submitit")
        except ModuleNotFoundError:
            raise UsageError("submitit is not installed; install it with: pip install 'gelflow[slurm]'") from None
        self._folder = folder / "jobs"
        try:
            self._executor = submitit.AutoExecutor(
                folder=self._folder, cluster=settings.cluster, **{f"{settings.cluster}_max_num_timeout": _TIME_LIMITS}
            )
            self._executor.update_parameters(**settings.parameters(cpus))
        except RuntimeError as error:  # no srun
            raise UsageError(f"this machine has no SLURM ({error}); start the sweep on a login node") from None
        self._job_class = {"slurm": submitit.SlurmJob, "local": submitit.LocalJob}[settings.cluster]
        self._jobs: dict[str, tuple[Run, Any]] = {}

    def submit(self, runs: Sequence[Run]) -> None:
        new = [run for run in runs if not self._attach(run)]
        if not new:
            return
        with self._executor.batch():
            jobs = [self._executor.submit(_Job(run)) for run in new]
        for run, job in zip(new, jobs, strict=True):
            self._jobs[run.name] = run, job
            self._id_file(run).write_text(f"{job.job_id}\n{shlex.join(run.arguments)}", encoding="utf-8")

    def ended(self) -> list[tuple[Run, RunRecord]]:
        found = []
        for name, (run, job) in list(self._jobs.items()):
            if job.done():
                del self._jobs[name]
                error = job.exception()
                found.append((run, job.result() if error is None else lost(run, str(error))))
        if not found:
            time.sleep(_POLL)
        return found

    def close(self) -> None:
        self._jobs.clear()

    def _id_file(self, run: Run) -> Path:
        """File with the id of the job in its first line, then the arguments of the run."""
        return self._folder / f"{run.name}.id"

    def _attach(self, run: Run) -> bool:
        """Whether a job of an earlier sweep still executes the run, or waits in the queue.

        Raises UsageError when this job has other options.
        """
        try:
            job_id, _, arguments = self._id_file(run).read_text(encoding="utf-8").partition("\n")
        except FileNotFoundError:
            return False
        job = self._job_class(self._folder, job_id)
        if job.done(force_check=True) or (job.state == "UNKNOWN" and self._is_forgotten(run)):
            return False
        if arguments:  # earlier versions wrote the id only
            check_arguments(run, tuple(shlex.split(arguments)))
        self._jobs[run.name] = run, job
        return True

    def _is_forgotten(self, run: Run) -> bool:
        """Whether SLURM has forgotten a job of unknown state: it may not know one yet that was submitted just now."""
        return time.time() - self._id_file(run).stat().st_mtime > _UNKNOWN_LIMIT


class _Job:
    """The function of a job. submitit calls `checkpoint` before the time limit and when the job is preempted."""

    def __init__(self, run: Run) -> None:
        self._run = run

    def __call__(self) -> RunRecord:
        return execute(self._run, platform.node())

    def checkpoint(self) -> Any:
        """The job that is queued in place of this one; the run continues in its folder."""
        submitit: Any = importlib.import_module("submitit")
        return submitit.helpers.DelayedSubmission(_Job(self._run))
