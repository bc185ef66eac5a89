"""Execution of a run on the machine of its worker, the same under every engine."""

import contextlib
import dataclasses
import json
import os
import platform
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import TracebackType
from typing import IO, Any

from gelflow.errors import UsageError
from gelflow.policies.sweep import launcher
from gelflow.policies.sweep.run import Run, RunRecord, read_record, write_record
from gelflow.policies.training.folder import try_lock

_POLL = 0.1  # interval of looking at the process [s, wall]
_EXIT_LIMIT = 10.0  # time from SIGTERM to SIGKILL [s, wall]
_WITH_RESULT = (0, 1)  # exit codes of a command that ran to its end; 1: with a negative result


def execute(run: Run, machine: str = "") -> RunRecord:
    """Start a run and wait until it ends; the entry point of workers. Returns at once when the run is complete.

    The record of a run that this machine cannot start has the reason and no exit code, and is not written.
    """
    try:
        with RunProcess(run, machine) as process:
            while (record := process.poll()) is None:
                time.sleep(_POLL)
            return record
    except UsageError as error:
        return RunRecord(run.name, run.arguments, "failed", machine=machine, error=str(error))


class RunProcess:
    """The process of a run. As a context manager it ends the process at its end.

    Only one process at a time executes a run, on all machines that share the folder: others wait for its lock.
    """

    def __init__(self, run: Run, machine: str = "") -> None:
        self._run = run
        self._machine = machine or platform.node()
        self._process: subprocess.Popen[bytes] | None = None
        self._lock: IO[bytes] | None = None
        self._started = 0.0

    def __enter__(self) -> "RunProcess":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def poll(self) -> RunRecord | None:
        """Start the run when it can start; its record when it has ended, otherwise None.

        Raises UsageError when this machine does not have the folders of the run.
        """
        if self._process is None:
            if not self._locked():
                return None
            record = read_record(self._run)
            if record.state == "complete":  # by the process that had the lock
                return record
            if record.starts and record.exit_code is None and (result := _json_object(self._run.output)) is not None:
                # It ended after its worker was lost. The output of a run without starts is not of this record.
                return self._complete(dataclasses.replace(record, exit_code=0), result)
            self._start(dataclasses.replace(record, starts=record.starts + 1))
            return None
        code = self._process.poll()
        return None if code is None else self._end(code)

    def terminate(self) -> None:
        """Ask the process to end (SIGTERM), without waiting for it."""
        self._signal(signal.SIGTERM)

    def close(self) -> None:
        """End the process and release its files."""
        if self._process is not None and self._process.poll() is None:
            self.terminate()
            try:
                self._process.wait(_EXIT_LIMIT)
            except subprocess.TimeoutExpired:
                self._signal(signal.SIGKILL)
                self._process.wait()
        if self._lock is not None:
            self._lock.close()

    def _signal(self, number: signal.Signals) -> None:
        if self._process is not None and self._process.poll() is None:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self._process.pid, number)  # it leads a group: with the processes that it started itself

    def _locked(self) -> bool:
        """Whether this object holds the lock of the run."""
        run = self._run
        for folder in (run.lock.parent, run.working_folder):
            if not folder.is_dir():
                raise UsageError(f"{self._machine} has no folder {folder}; all machines of a sweep must share it")
        if self._lock is None:
            self._lock = run.lock.open("ab")
        return try_lock(self._lock)

    def _start(self, record: RunRecord) -> None:
        run = self._run
        assert self._lock is not None
        record = dataclasses.replace(record, state="started", machine=self._machine, exit_code=None, error="")
        write_record(run, record)
        command = [sys.executable, *run.program, *run.arguments]
        threads = str(run.cpus)
        with run.log.open("ab") as log, run.output.open("wb") as output:
            log.write(f"=== start {record.starts} on {self._machine}: {shlex.join(command)}\n".encode())
            log.flush()
            self._process = subprocess.Popen(
                [sys.executable, "-I", "-S", launcher.__file__, str(os.getpid()), *command],
                cwd=run.working_folder,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=log,
                pass_fds=(self._lock.fileno(),),  # the lock lasts as long as the process
                start_new_session=True,  # signals of the terminal end the sweep, which ends its runs
                env=os.environ | {"OMP_NUM_THREADS": threads, "OPENBLAS_NUM_THREADS": threads},
            )
        self._started = time.monotonic()

    def _end(self, code: int) -> RunRecord:
        result = _json_object(self._run.output)
        record = dataclasses.replace(
            read_record(self._run), seconds=time.monotonic() - self._started, exit_code=code, machine=self._machine
        )
        # The object is printed last: a process with a complete one that a signal ended had finished its work.
        if (code < 0 or code in _WITH_RESULT) and result is not None:
            return self._complete(record, result)
        record = dataclasses.replace(record, state="failed", error=_reason(code, self._run.log))
        write_record(self._run, record)
        return record

    def _complete(self, record: RunRecord, result: dict[str, Any]) -> RunRecord:
        record = dataclasses.replace(record, state="complete", error="", result=result)
        write_record(self._run, record)
        return record


def _json_object(path: Path) -> dict[str, Any] | None:
    try:
        value = json.loads(path.read_bytes())
    except (FileNotFoundError, ValueError):
        return None
    return value if isinstance(value, dict) else None


def _reason(code: int, log: Path) -> str:
    """Why a process failed, with the last line of its standard error."""
    if code < 0:
        try:
            return f"ended by {signal.Signals(-code).name}"
        except ValueError:  # a real-time signal
            return f"ended by signal {-code}"
    if code == 0:
        return "it printed no JSON object"
    with log.open("rb") as file:
        file.seek(max(0, log.stat().st_size - 4096))
        lines = [line for line in file.read().decode(errors="replace").splitlines() if line.strip()]
    last = lines[-1].strip() if lines and not lines[-1].startswith("===") else "no message"
    return f"exit code {code}: {last}"
