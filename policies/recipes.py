"""Recipes: how each task is trained, by name of the task and of the recipe."""

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from gelflow.errors import UsageError
from gelflow.policies.networks.actor import ActorArchitecture
from gelflow.policies.networks.cnn import CNN
from gelflow.policies.networks.mlp import MLP
from gelflow.policies.ppo_learner import PPO, PPOSettings
from gelflow.policies.training_run import Learner
from gelflow.sim.tasks.registry import make_task
from gelflow.sim.tasks.task_batch import TaskBatch

DEFAULT, PAPER = "default", "paper"


@dataclass(frozen=True)
class Recipe:
    """Algorithm, settings and length of a training."""

    task: str  # as in `gelflow train TASK`
    steps: int  # environment steps, over all environments
    envs: int  # parallel environments
    evaluate_every: int  # steps
    evaluate_episodes: int
    algorithm: str  # as in the configuration of a run
    settings: Any  # of the algorithm, a dataclass
    learner: Callable[["Recipe", TaskBatch, int, int], Learner]  # (recipe, task, seed, steps)
    network: Mapping[str, Any] = field(default_factory=dict)  # settings of the architecture
    options: Mapping[str, Any] = field(default_factory=dict)  # of the task's batch

    def make_task(self, envs: int | None = None, **options: Any) -> TaskBatch:
        """A batch of environments of the recipe; `options` are those of the task."""
        return make_task(self.task, envs or self.envs, threads=1, **{**self.options, **options})

    def make_learner(self, task: TaskBatch, *, seed: int, steps: int) -> Learner:
        """The learner on `task`; `steps` is the length of the whole training."""
        return self.learner(self, task, seed, steps)

    def configuration(self) -> dict[str, Any]:
        """The settings that determine the result, as JSON data."""
        return {"algorithm": self.algorithm, "settings": dataclasses.asdict(self.settings)}


def actor_for(task: TaskBatch, settings: Mapping[str, Any]) -> ActorArchitecture:
    """The architecture for the observations of `task`: a convolutional network for images, otherwise a perceptron."""
    shape = tuple(int(size) for size in task.observation_space.shape)
    architecture = CNN if len(shape) == 3 else MLP
    return architecture(observation_shape=shape, actions=int(task.action_space.shape[0]), **settings)


def _ppo(recipe: Recipe, task: TaskBatch, seed: int, steps: int) -> Learner:
    return PPO(task, actor_for(task, recipe.network), recipe.settings, seed=seed, steps=steps)


# Table 6 of the paper: 32 environments, 32 steps a rollout.
_PAPER_PPO = PPOSettings(
    rollout=32, batch=256, epochs=10, learning_rate=3e-4, discount=0.99, trace=0.95, clip=0.2, value=0.5, entropy=0.01
)

_RECIPES: dict[str, dict[str, Recipe]] = {
    "grasp": {
        DEFAULT: Recipe("grasp", 20_000, 32, 4_096, 512, "ppo", _PAPER_PPO, _ppo),
        PAPER: Recipe("grasp", 20_000, 32, 4_096, 512, "ppo", _PAPER_PPO, _ppo),
    },
}


def recipe_for(task: str, name: str = DEFAULT) -> Recipe:
    """The recipe `name` of a task. Raises UsageError for an unknown task or name."""
    if task not in _RECIPES:
        raise UsageError(f"no recipe trains {task!r}; there are {', '.join(_RECIPES)}")
    recipes = _RECIPES[task]
    if name not in recipes:
        raise UsageError(f"{task} has no recipe {name!r}; there are {', '.join(recipes)}")
    return recipes[name]


def trained_tasks() -> tuple[str, ...]:
    """Names of the tasks that have a recipe."""
    return tuple(_RECIPES)
