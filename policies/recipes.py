"""Recipes: how each task is trained, by name of the task and of the recipe."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from gelflow.errors import UsageError
from gelflow.policies.backpropagation import Backpropagation, BackpropagationSettings
from gelflow.policies.checkpoint import load_checkpoint
from gelflow.policies.imitation import Imitation, ImitationSettings, architecture_for
from gelflow.policies.insertion_ppo import InsertionPPO
from gelflow.policies.networks.actor import ActorArchitecture
from gelflow.policies.networks.cnn import CNN
from gelflow.policies.networks.mlp import MLP
from gelflow.policies.networks.polynomial_mlp import PolynomialMLP
from gelflow.policies.ppo import PPO, PPOSettings
from gelflow.policies.training.learner import Learner
from gelflow.policies.training.progress_log import table_columns
from gelflow.policies.training.run import POLICY, Progress, RunSettings, TrainingResult, TrainingRun
from gelflow.sim.tasks.cap_rotation import CapRotationTask
from gelflow.sim.tasks.differentiable_pushing import DifferentiablePushing
from gelflow.sim.tasks.grasp import GraspTask
from gelflow.sim.tasks.gripper.flow_map_noise import FlowMapNoise
from gelflow.sim.tasks.insertion_environments import Insertion
from gelflow.sim.tasks.pushing import Pushing, PushingTask
from gelflow.sim.tasks.registry import make_task
from gelflow.sim.tasks.task_batch import TaskBatch
from gelflow.task import INSERTION, InsertionTask

DEFAULT, PAPER, FINE_TUNING = "default", "paper", "fine-tuning"


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
    best_by: str = "success"  # which evaluation is the best, see `RunSettings`
    policy_name: str = POLICY  # of the checkpoint
    yaw_factor: float = 1.0  # of the insertion: largest yaw of a start in the training, relative to that of the task

    @property
    def curve_columns(self) -> tuple[str, ...]:
        """Columns of the learning curve, over the steps."""
        return table_columns(_LEARNERS[self.algorithm].columns)[1:]

    def make_task(self, envs: int | None = None, **options: Any) -> TaskBatch:
        """A batch of environments of the recipe; `options` are those of the task."""
        return make_task(self.task, self.envs if envs is None else envs, **{"threads": 1, **self.options, **options})

    def make_training_task(self, envs: int | None = None, **options: Any) -> TaskBatch:
        """As `make_task`, with the starts of the training."""
        if self.yaw_factor == 1:
            return self.make_task(envs, **options)
        task: InsertionTask = {**self.options, **options}.get("task", INSERTION)
        x, y, yaw = task.misalignment
        wider = (x, y, min(self.yaw_factor * yaw, max(yaw, task.workspace[2])))
        return self.make_task(envs, **{**options, "task": dataclasses.replace(task, misalignment=wider)})

    def make_learner(self, task: TaskBatch, *, seed: int, steps: int) -> Learner:
        """The learner on `task`; `steps` is the length of the whole training."""
        return self.learner(self, task, seed, steps)

    def configuration(self, **options: Any) -> dict[str, Any]:
        """The settings that determine the result, as JSON data; a `preset` in `options` replaces that of the recipe."""
        values = {"algorithm": self.algorithm, "settings": dataclasses.asdict(self.settings)}
        if (noise := self.options.get("noise")) is not None:
            values["noise"] = dataclasses.asdict(noise)
        if (preset := self.options.get("preset")) is not None:
            values["preset"] = options.get("preset", preset)
        return values


_LEARNERS: dict[str, type[Learner]] = {"ppo": PPO, "backpropagation": Backpropagation, "imitation": Imitation}


def actor_for(task: TaskBatch, settings: Mapping[str, Any]) -> ActorArchitecture:
    """The architecture for the observations of `task`: a convolutional network for images, otherwise a perceptron."""
    shape = tuple(int(size) for size in task.observation_space.shape)
    architecture = CNN if len(shape) == 3 else MLP
    return architecture(observation_shape=shape, actions=int(task.action_space.shape[0]), **settings)


def _ppo(recipe: Recipe, task: TaskBatch, seed: int, steps: int) -> Learner:
    return PPO(task, actor_for(task, recipe.network), recipe.settings, seed=seed, steps=steps)


def _backpropagation(recipe: Recipe, task: TaskBatch, seed: int, steps: int) -> Learner:
    assert isinstance(task, Pushing)
    episodes, architecture = DifferentiablePushing(task), actor_for(task, recipe.network)
    return Backpropagation(episodes, architecture, recipe.settings, seed=seed, steps=steps)


def _imitation(recipe: Recipe, task: TaskBatch, seed: int, steps: int) -> Learner:
    assert isinstance(task, Insertion)
    return Imitation(task, architecture_for(task.description), recipe.settings, seed=seed, steps=steps)


def _insertion_ppo(recipe: Recipe, task: TaskBatch, seed: int, steps: int) -> Learner:
    return InsertionPPO(task, PolynomialMLP(**recipe.network), recipe.settings, seed=seed, steps=steps)


# Table 6 of the paper: 32 environments, 32 steps a rollout.
_TABLE_6 = PPOSettings(
    rollout=32, batch=256, epochs=10, learning_rate=3e-4, discount=0.99, trace=0.95, clip=0.2, value=0.5, entropy=0.01
)
# Long rollouts of many environments for an action of 9 joints; the critic sees the cap, which the hand cannot.
_LONG_ROLLOUTS = PPOSettings(
    rollout=64,
    batch=1024,
    epochs=5,
    learning_rate=1e-3,
    last_learning_rate=0.1,
    discount=0.98,
    entropy=0.0,
    privileged_critic=True,
)
# Where actions change the measured angles, three epochs lead to more success than five.
_CAP_AS_PUBLISHED = dataclasses.replace(_LONG_ROLLOUTS, epochs=3)


# The critic sees the distance to the centre of mass; a small discount makes each attempt cost.
_GRASP = dataclasses.replace(
    _TABLE_6, learning_rate=1e-3, last_learning_rate=0.02, discount=0.9, entropy=0.0, privileged_critic=True
)
# The paper's comparison with back-propagation, B.3.
_PUSHING_PPO = PPOSettings(rollout=80, batch=128, entropy=0.0)


def _grasp(settings: PPOSettings, **task: Any) -> Recipe:
    return Recipe("grasp", 20_480, 32, 4_096, 256, "ppo", settings, _ppo, options={"task": GraspTask(**task)})


def _cap(settings: PPOSettings, envs: int, *, steps: int = 400_000, **task: Any) -> Recipe:
    options = {"task": CapRotationTask(**task)}
    return Recipe("cap", steps, envs, 102_400, 256, "ppo", settings, _ppo, {"hidden": (128, 128)}, options)


def _pushing(observation: str, *, recurrent: int = 0) -> Recipe:
    """300 updates of 16 episodes of 100 steps, as in the paper."""
    network, options = {"recurrent": recurrent}, {"task": PushingTask(observation=observation)}
    # With memory or touch the published learning rate diverges after some 50 updates.
    settings = BackpropagationSettings(learning_rate=0.003 if recurrent else 0.005)
    recipe = Recipe("pushing", 480_000, 16, 80_000, 64, "backpropagation", settings, _backpropagation, network, options)
    return dataclasses.replace(recipe, best_by="return")


# With more environments the network is updated less often for the same number of attempts, and learns less from them.
_INSERTION = Recipe(
    "insertion",
    400_000,
    256,
    50_000,
    512,
    "imitation",
    ImitationSettings(),
    _imitation,
    options={"noise": FlowMapNoise(), "threads": None},
    policy_name="insertion.safetensors",
)
# An improvement is immediate: a small discount.
_INSERTION_PPO = PPOSettings(
    rollout=16, learning_rate=2e-3, last_learning_rate=0.1, discount=0.5, entropy=0.0, deviation=0.4
)

RECIPES: dict[str, dict[str, Recipe]] = {
    "grasp": {
        DEFAULT: _grasp(_GRASP),
        PAPER: _grasp(_TABLE_6),
        "chosen-force": _grasp(_GRASP, force_range=(1.0, 16.0)),
    },
    "pushing": {
        DEFAULT: _pushing("tactile", recurrent=64),
        PAPER: _pushing("tactile"),
        "privileged": _pushing("privileged"),
        "no-touch": _pushing("none"),
        "ppo": Recipe("pushing", 480_000, 32, 76_800, 64, "ppo", _PUSHING_PPO, _ppo, best_by="return"),
    },
    "cap": {
        DEFAULT: _cap(_LONG_ROLLOUTS, 64, commanded=True, reward="progress"),
        "no-touch": _cap(_LONG_ROLLOUTS, 64, commanded=True, touch=False, reward="progress"),
        "paper-observation": _cap(_LONG_ROLLOUTS, 64, reward="progress"),
        "paper-observation-no-touch": _cap(_LONG_ROLLOUTS, 64, touch=False, reward="progress"),
        "published": _cap(_CAP_AS_PUBLISHED, 64, steps=2_400_000, use_target=False, reward="progress"),
        "published-no-touch": _cap(
            _CAP_AS_PUBLISHED, 64, steps=2_400_000, use_target=False, touch=False, reward="progress"
        ),
        PAPER: _cap(_TABLE_6, 32, use_target=False),
    },
    "insertion": {
        DEFAULT: _INSERTION,
        # Parts that are not inserted into a tight hole mostly start near the largest yaw, and few starts are there. The
        # preset nearly doubles the attempts of a minute.
        FINE_TUNING: dataclasses.replace(
            _INSERTION,
            steps=60_000,
            evaluate_every=30_000,
            options={**_INSERTION.options, "preset": "fast"},
            settings=ImitationSettings(memory=16, bounded_after=0.0, exploration=(0.1, 0.03)),
            yaw_factor=1.3,
        ),
        "ppo": dataclasses.replace(
            _INSERTION,
            steps=200_000,
            envs=64,
            evaluate_every=20_000,
            algorithm="ppo",
            settings=_INSERTION_PPO,
            learner=_insertion_ppo,
        ),
    },
}


def recipe_for(task: str, name: str = DEFAULT) -> Recipe:
    """The recipe `name` of a task. Raises UsageError for an unknown task or name."""
    if task == "rolling":
        raise UsageError("no recipe trains 'rolling': the paper measures in this scene and trains nothing there")
    if task not in RECIPES:
        raise UsageError(f"no recipe trains {task!r}; there are {', '.join(RECIPES)}")
    recipes = RECIPES[task]
    if name not in recipes:
        raise UsageError(f"{task} has no recipe {name!r}; there are {', '.join(recipes)}")
    return recipes[name]


def train(task: str, folder: Path, **settings: Any) -> TrainingResult:
    """Trains a policy on a task into `folder`; the same call resumes an unfinished run. See `training_run`."""
    return training_run(task, folder, **settings).train()


def training_run(
    task: str,
    folder: Path,
    *,
    recipe: str = DEFAULT,
    seed: int = 0,
    steps: int | None = None,
    envs: int | None = None,
    minutes: float = float("inf"),
    options: Mapping[str, Any] | None = None,
    start: Path | None = None,
    command: Sequence[str] = (),
    report: Callable[[Progress], None] | None = None,
) -> TrainingRun:
    """The run that trains a policy on a task into `folder`.

    Parameters
    ----------
    task, recipe: names, see `recipe_for`
    steps, envs: environment steps in total and parallel environments; None: those of the recipe
    minutes: time limit; a run that reaches it is not reproducible
    options: of the task's batch, such as `preset` and `friction`; JSON data, except `task`, the description
    start: checkpoint of the policy that a recipe of fine-tuning starts from; others start from random weights
    command: that repeats the run, stored in the folder
    report: called after each update

    Raises UsageError for an unknown task, recipe or option, and for a checkpoint that the recipe cannot start from.
    """
    chosen, given = recipe_for(task, recipe), dict(options or {})
    total = chosen.steps if steps is None else steps
    settings = RunSettings(
        steps=total,
        seed=seed,
        minutes=minutes,
        evaluate_every=chosen.evaluate_every,
        evaluate_episodes=min(chosen.evaluate_episodes, total),
        best_by=chosen.best_by,
    )
    batch = chosen.make_training_task(envs, **given)
    learner = chosen.make_learner(batch, seed=seed, steps=total)
    if (recipe == FINE_TUNING) != (start is not None):
        needs = "needs" if start is None else "has no"
        raise UsageError(f"the recipe {recipe} of {task} {needs} policy to start from")
    origin = {}
    if start is not None:
        checkpoint = load_checkpoint(start)
        learner.start_from(checkpoint)
        origin["start"] = checkpoint.digest
    stored = {name: value for name, value in given.items() if name != "task"}  # the run stores the description
    configuration = {"recipe": recipe, "options": stored, **origin, **chosen.configuration(**stored)}
    validation = chosen.make_task(envs, **given)
    return TrainingRun(learner, validation, folder, settings, configuration, command, report, chosen.policy_name)
