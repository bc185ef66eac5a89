"""The simulated insertion as training and evaluation use it: which environment, which noise."""

from gelflow.policies.evaluation import Attempts, Noise
from gelflow.sim.tasks.environments import InsertionVectorEnv
from gelflow.task import INSERTION, InsertionTask


def simulated(
    count: int, *, noise: Noise | None = None, preset: str | None = None, task: InsertionTask = INSERTION
) -> Attempts:
    """`count` simulated insertions side by side, domain randomized, with `noise` on their flow maps.

    `preset` says how exactly they are simulated. Raises UsageError when the insertion scene has no such preset.
    """
    return Attempts(InsertionVectorEnv(count, task=task, preset=preset), task, noise)
