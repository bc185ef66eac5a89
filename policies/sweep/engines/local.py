"""Runs as processes of this machine."""

import time
from collections import deque
from collections.abc import Sequence

from gelflow.policies.sweep.engines.engine import Engine
from gelflow.policies.sweep.run import Run, RunRecord
from gelflow.policies.sweep.run_process import RunProcess

_POLL = 0.1  # [s, wall]


class LocalEngine(Engine):
    """At most `jobs` processes at a time. `close` ends those that are still active."""

    def __init__(self, jobs: int) -> None:
        self._jobs = jobs
        self._queue: deque[Run] = deque()
        self._active: dict[str, tuple[Run, RunProcess]] = {}

    def submit(self, runs: Sequence[Run]) -> None:
        self._queue.extend(runs)

    def ended(self) -> list[tuple[Run, RunRecord]]:
        while self._queue and len(self._active) < self._jobs:
            run = self._queue.popleft()
            self._active[run.name] = run, RunProcess(run)
        found = []
        for name, (run, process) in list(self._active.items()):
            record = process.poll()
            if record is not None:
                process.close()
                del self._active[name]
                found.append((run, record))
        if not found:
            time.sleep(_POLL)
        return found

    def close(self) -> None:
        for _, process in self._active.values():  # all of them first: they end at the same time
            process.terminate()
        for _, process in self._active.values():
            process.close()
        self._active.clear()
