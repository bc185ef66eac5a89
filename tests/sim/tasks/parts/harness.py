"""Shared helpers of the tests of parts."""

import dataclasses

import pytest

from gelflow.sim.tasks.insertion import InsertionAttempts
from gelflow.sim.tasks.insertion_randomization import NOMINAL
from gelflow.task import PUBLISHED_INSERTION, InsertionTask

STIFF = NOMINAL.replace(hole_kn=2e4, stop_shear=0.03)  # walls into which no deep descent presses a part
both_depths = pytest.mark.parametrize("deep", [False, True], ids=["published descent", "deep descent, stiff walls"])


def with_published_descent(task: InsertionTask) -> InsertionTask:
    """The task with the depth of the published descents."""
    published = PUBLISHED_INSERTION
    return dataclasses.replace(task, descent=published.descent, frame_depths=published.frame_depths)


def make_attempts(count: int, task: InsertionTask, *, deep: bool) -> InsertionAttempts:
    """Attempts with the task's own descents and stiff walls, or with the published descents and the scene's walls."""
    if deep:
        return InsertionAttempts(count, task=task, randomization=STIFF, threads=1)
    return InsertionAttempts(count, task=with_published_descent(task), randomization=NOMINAL, threads=1)
