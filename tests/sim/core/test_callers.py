"""Processes, threads and signals around a simulator: fork, two threads on one simulator, Ctrl-C."""

import multiprocessing
import subprocess
import sys
import threading
from typing import Any

import numpy as np
import pytest

from gelflow.errors import UsageError
from gelflow.sim.scene import load_scene
from gelflow.sim.simulator import Simulator


def results(sim: Simulator) -> list[np.ndarray]:
    """Steps, a rollout and its gradient, from the start."""
    u = np.random.default_rng(0).normal(scale=0.1, size=(sim.num_envs, sim.model.nu))
    sim.reset()
    sim.step(u, 20)
    trajectory = sim.rollout(np.tile(u, (10, 1, 1)))
    gradient = sim.rollout_gradient(trajectory, q=np.ones_like(trajectory.q), params=True)
    return [sim.q.copy(), sim.tactile(), trajectory.q, gradient.u, gradient.params]


def same(a: list[np.ndarray], b: list[np.ndarray]) -> bool:
    return all(np.array_equal(x, y) for x, y in zip(a, b, strict=True))


@pytest.mark.filterwarnings("ignore:.*multi-threaded.*fork:DeprecationWarning")
@pytest.mark.parametrize("precision", ["double", "single"])
def test_simulator_works_in_the_child_of_a_fork(precision: Any) -> None:
    sim = Simulator(load_scene("rolling"), num_envs=4, threads=2, precision=precision)
    before = results(sim)
    context = multiprocessing.get_context("fork")
    queue = context.Queue()
    child = context.Process(target=lambda: queue.put(results(sim)))
    child.start()
    assert same(queue.get(timeout=120), before)
    child.join(120)
    assert child.exitcode == 0
    assert same(results(sim), before)


def test_two_threads_on_one_simulator() -> None:
    """A call during a call is refused; the call that runs is not disturbed."""
    sim = Simulator(load_scene("rolling"), num_envs=2, threads=2)
    u = np.zeros((2, sim.model.nu))
    refused: list[str] = []
    taken = []

    def step() -> None:
        for _ in range(50):
            try:
                sim.step(u, 20)
                taken.append(20)
            except UsageError as error:
                refused.append(str(error))

    threads = [threading.Thread(target=step) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert set(refused) <= {"the simulator is busy with a call of another thread; give each thread its own simulator"}
    alone = Simulator(sim.scene, num_envs=2)
    alone.step(u, sum(taken))
    assert np.array_equal(sim.q, alone.q)


def test_call_during_a_call_is_refused() -> None:
    """A handler of a signal runs in the middle of a call."""
    assert (
        interrupted("sim.tactile()") == "UsageError: the simulator is busy with a call of another thread; give each "
        "thread its own simulator"
    )


GRADIENT = """
tr = sim.rollout(np.zeros((2000, 3, sim.model.nu)))
while True: sim.rollout_gradient(tr, q=np.ones_like(tr.q))"""


@pytest.mark.parametrize(
    ("call", "threads"),
    [
        ("sim.step(np.zeros((3, sim.model.nu)), 2_000_000_000)", 1),
        ("sim.step(np.zeros((3, sim.model.nu)), 2_000_000_000)", 2),
        ("while True: sim.rollout(np.zeros((5000, 3, sim.model.nu)))", 1),
        (GRADIENT, 2),
    ],
    ids=["step", "step in threads", "rollout", "gradient"],
)
def test_signal_ends_a_call(call: str, threads: int) -> None:
    assert interrupted("raise KeyboardInterrupt", call, threads) == "KeyboardInterrupt"


def test_two_simulators_in_two_threads() -> None:
    scene = load_scene("rolling")
    expected = results(Simulator(scene, num_envs=2))
    found: list[list[np.ndarray]] = []
    threads = [threading.Thread(target=lambda: found.append(results(Simulator(scene, num_envs=2)))) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(found) == 2 and all(same(result, expected) for result in found)


def interrupted(
    handler: str, call: str = "sim.step(np.zeros((3, sim.model.nu)), 2_000_000_000)", threads: int = 1
) -> str:
    """Runs `call` in another process, where a timer runs `handler`; the last line of what it reports."""
    script = f"""
import signal
import numpy as np
from gelflow.sim import Simulator, load_scene

def handle(signum, frame):
    {handler}

sim = Simulator(load_scene("rolling"), num_envs=3, threads={threads})
signal.signal(signal.SIGALRM, handle)
signal.setitimer(signal.ITIMER_REAL, 0.3)
{call}
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=120, check=False)
    return done.stderr.strip().splitlines()[-1].removeprefix("gelflow.errors.")


def test_a_simulator_in_use_by_a_daemon_thread_does_not_abort_the_end_of_the_process() -> None:
    script = """
import threading, time
import numpy as np
from gelflow.sim import Simulator, load_scene

sim = Simulator(load_scene("rolling"))

def step():
    while True:
        sim.step(np.zeros(sim.model.nu), 5)

threading.Thread(target=step, daemon=True).start()
time.sleep(0.3)
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=120, check=False)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.skipif(sys.platform != "linux", reason="needs a limit of the address space")
def test_threads_that_cannot_be_started_are_refused() -> None:
    script = """
import resource
from pathlib import Path
from gelflow.errors import UsageError
from gelflow.sim import Simulator, load_scene

scene = load_scene("rolling")
Simulator(scene, num_envs=2, threads=2).poses()
used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (used + 100 * 2**20,) * 2)  # some twelve stacks of threads
try:
    Simulator(scene, num_envs=64, threads=64)
except UsageError as error:
    print(error)
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=120, check=False)
    assert done.stdout.startswith("cannot start thread") and done.stdout.endswith("of 64; choose fewer threads\n")
