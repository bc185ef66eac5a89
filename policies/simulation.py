"""The simulated insertion as training and evaluation use it: which environment, which noise."""

from gelflow.policies.attempts import Attempts, Noise
from gelflow.sim.tasks.gym import InsertionVectorEnv
from gelflow.task import INSERTION, InsertionTask


def simulated(count: int, *, noise: Noise | None = None, task: InsertionTask = INSERTION) -> Attempts:
    """`count` simulated insertions side by side, domain randomized, with `noise` on their flow maps."""
    return Attempts(InsertionVectorEnv(count, task=task), task, noise)
