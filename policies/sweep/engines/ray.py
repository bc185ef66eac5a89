"""Runs as tasks of a Ray cluster."""

import importlib
import logging
import os
import platform
import signal
import threading
from collections.abc import Sequence
from typing import Any

from gelflow.errors import PeerError, UsageError
from gelflow.policies.sweep.engines.engine import Engine, lost
from gelflow.policies.sweep.run import Run, RunRecord
from gelflow.policies.sweep.run_process import execute

_POLL = 0.5  # [s, wall]


class RayEngine(Engine):
    """As many runs at a time as the cluster has processors. `close` ends those that are still active.

    Connects to the cluster of the environment variable RAY_ADDRESS, or to the one that runs on this machine, or starts
    one on this machine. Raises UsageError when Ray is not installed, PeerError when the cluster does not answer.
    """

    def __init__(self) -> None:
        try:
            self._ray: Any = importlib.import_module("ray")
        except ModuleNotFoundError:
            raise UsageError("Ray is not installed; install it with: pip install 'gelflow[ray]'") from None
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # of a cluster that is started here
        os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")  # a run without GPU sees those of the machine
        self._own = not self._ray.is_initialized()
        if self._own:
            on_term = signal.getsignal(signal.SIGTERM)
            try:
                self._ray.init(log_to_driver=False, logging_level=logging.ERROR)
            except (ConnectionError, RuntimeError, TimeoutError, OSError) as error:
                raise PeerError(f"no connection to the Ray cluster: {error}") from error
            if threading.current_thread() is threading.main_thread():
                signal.signal(signal.SIGTERM, on_term)  # Ray has replaced it
        self._tasks: dict[Any, Run] = {}
        self._function = self._ray.remote(_execute)

    def submit(self, runs: Sequence[Run]) -> None:
        for run in runs:
            # No retries: the sweep decides which run is started again.
            function = self._function.options(num_cpus=run.cpus, name=run.name, max_retries=0)
            self._tasks[function.remote(run)] = run

    def ended(self) -> list[tuple[Run, RunRecord]]:
        ready, _ = self._ray.wait(list(self._tasks), num_returns=1, timeout=_POLL)
        found = []
        for task in ready:
            run = self._tasks.pop(task)
            try:
                record = self._ray.get(task)
            except self._ray.exceptions.RayError as error:
                record = lost(run, str(error))
            found.append((run, record))
        return found

    def close(self) -> None:
        for task in self._tasks:
            self._ray.cancel(task, force=True)
        self._tasks.clear()
        if self._own:
            self._ray.shutdown()


def _execute(run: Run) -> RunRecord:
    """The task of a run; its record names the node and the machine."""
    ray: Any = importlib.import_module("ray")
    return execute(run, f"{platform.node()}/{ray.get_runtime_context().get_node_id()[:8]}")
