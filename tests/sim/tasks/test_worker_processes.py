"""Simulators and environments in worker processes: PyTorch's DataLoader and Gymnasium's AsyncVectorEnv."""

import subprocess
import sys
from pathlib import Path

import pytest

# A script, because processes that are spawned import the main module.
DATA_LOADER = """
import sys
import numpy as np
from torch.utils.data import DataLoader, Dataset
from gelflow.sim import Simulator, load_scene

class Pushes(Dataset):
    def __init__(self):
        self.sim = Simulator(load_scene("pushing", friction="elastic"), num_envs=2, threads=2)
        self[0]  # a forked worker inherits a simulator that has run

    def __len__(self):
        return 6

    def __getitem__(self, index):
        u = np.random.default_rng(index).normal(scale=0.1, size=(5, 2, self.sim.model.nu))
        self.sim.reset()
        run = self.sim.rollout(u, read_after=[5])
        gradient = self.sim.rollout_gradient(run, tactile=np.ones_like(run.tactile))
        self.sim.step(u[0], 3)
        return np.concatenate([run.q.ravel(), run.tactile.ravel(), gradient.u.ravel(), self.sim.q.ravel()])

if __name__ == "__main__":
    data = Pushes()
    options = {"num_workers": 2, "multiprocessing_context": sys.argv[1], "batch_size": 2}
    batches = list(DataLoader(data, **options))
    assert len(batches) == 3
    for i, values in enumerate(row for batch in batches for row in batch.numpy()):
        np.testing.assert_array_equal(values, data[i])
    print("same")
"""

ENVIRONMENTS = """
import sys
import gymnasium
import numpy as np
import gelflow

def run(**options):
    envs = gymnasium.make_vec(sys.argv[2], num_envs=2, **options)
    results = [envs.reset(seed=3)[0]]
    for _ in range(3):
        actions = np.random.default_rng(4).uniform(-1, 1, envs.action_space.shape).astype(np.float32)
        results += envs.step(actions)[:4]
    envs.close()
    return results

if __name__ == "__main__":
    one = run(vectorization_mode="sync")
    other = run(vectorization_mode="async", vector_kwargs={"context": sys.argv[1]})
    for a, b in zip(one, other, strict=True):
        np.testing.assert_array_equal(a, b)
    print("same")
"""


def output(script: str, folder: Path, *arguments: str) -> str:
    """Run a script in a process of its own and return its standard output."""
    path = folder / "script.py"
    path.write_text(script)
    command = [sys.executable, "-W", "ignore::DeprecationWarning", str(path), *arguments]
    done = subprocess.run(command, capture_output=True, text=True, timeout=250, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout.strip()


@pytest.mark.parametrize("start", ["fork", pytest.param("spawn", marks=pytest.mark.slow)])
def test_data_loader(start: str, tmp_path: Path) -> None:
    assert output(DATA_LOADER, tmp_path, start) == "same"


@pytest.mark.parametrize(
    ("start", "name"),
    [("fork", "gelflow/Pushing-v0"), pytest.param("spawn", "gelflow/Insertion-v0", marks=pytest.mark.slow)],
)
def test_async_vector_environment(start: str, name: str, tmp_path: Path) -> None:
    assert output(ENVIRONMENTS, tmp_path, start, name) == "same"
