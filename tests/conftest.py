"""Shared test set-up: pictures without a display, threads, reproducible examples, a separate cache, signals."""

import os
import signal
from collections.abc import Iterator

import pytest
from hypothesis import settings

os.environ.setdefault("MPLBACKEND", "Agg")
# Tests run in one process per core: several threads of NumPy, torch and the core in each only wait for one another.
for _library in ("OMP", "OPENBLAS", "MKL"):
    os.environ.setdefault(f"{_library}_NUM_THREADS", "1")

# A shell ignores SIGINT and SIGQUIT for background jobs, nohup ignores SIGHUP, and child processes inherit that: tests
# of signals need the defaults.
for _number, _handler in (
    (signal.SIGINT, signal.default_int_handler),
    (signal.SIGHUP, signal.SIG_DFL),
    (signal.SIGQUIT, signal.SIG_DFL),
):
    if signal.getsignal(_number) == signal.SIG_IGN:
        signal.signal(_number, _handler)

# No deadline: tests do not depend on the speed of the machine. Derandomized: a failed run is reproducible.
settings.register_profile("gelflow", deadline=None, derandomize=True)
settings.load_profile("gelflow")


@pytest.fixture(autouse=True)
def _normal_priority() -> Iterator[None]:
    """A test that raises the priority of its own thread would starve all later tests beside it."""
    yield
    if hasattr(os, "sched_getscheduler"):
        assert os.sched_getscheduler(0) == os.SCHED_OTHER


@pytest.fixture(scope="session", autouse=True)
def _own_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Distance grids are cached in a folder of this run instead of the user's cache."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("GELFLOW_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield
