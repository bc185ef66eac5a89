"""Training of the insertion policy: PPO (stable-baselines3) over the history's input, exported to our checkpoint.

The flow maps are reduced to their features before PPO sees them, so its buffers and updates are small. The reward is
what the correction gained: the environment's reward of the pose after it, less that of the pose before. It comes at
once, so the discount is small; and a part that happens to start far off does not drown what the correction did.
"""

import dataclasses
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import stable_baselines3
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvStepReturn

from gelflow.errors import UsageError
from gelflow.policies import checkpoint
from gelflow.policies import learning_curve as curve
from gelflow.policies.environment import FlowMapNoise, PolicyEnv
from gelflow.policies.evaluation import EvaluationResult, NetworkActor, evaluate
from gelflow.policies.learning_curve import LearningCurvePoint
from gelflow.policies.networks import Architecture, Network, polynomial_basis, reduce_maps, tensor_shapes

Array = NDArray[np.float64]


@dataclass(frozen=True)
class PPOSettings:
    """Everything that decides a training run beside the environment; stored in the checkpoint."""

    attempts: int = 200_000  # attempts in all
    minutes: float = float("inf")  # stop after this time [min]; a run cut off by time can not be repeated exactly
    seed: int = 0
    rollout: int = 16  # attempts of each environment between updates
    batch: int = 256
    epochs: int = 10
    learning_rate: float = 2e-3  # falls to a tenth, linearly
    discount: float = 0.5
    gae: float = 0.95
    clip: float = 0.2
    value: float = 0.5
    entropy: float = 0.0
    gradient_norm: float = 0.5
    spread: float = 0.4  # first standard deviation of the actions, in units of the reach
    calibration: int = 2_000  # random attempts that give the features' root mean square
    evaluate_every: int = 20_000  # attempts
    evaluate_episodes: int = 512


CHECKPOINT, CURVE, PICTURE = "insertion.safetensors", "learning_curve.csv", "learning_curve.png"


@dataclass(frozen=True)
class TrainingResult:
    """What a training run made."""

    checkpoint: Path
    best: EvaluationResult
    curve: Path
    picture: Path


class HistoryVecEnv(VecEnv):
    """Insertion attempts as stable-baselines3 wants them: observation is the history's input, action ±1 the reach."""

    render_mode = None

    def __init__(
        self, attempts: PolicyEnv, architecture: Architecture, basis: Array, scale: Array, *, seed: int
    ) -> None:
        size = architecture.inputs(attempts.task)
        super().__init__(
            attempts.count,
            spaces.Box(-np.inf, np.inf, (size,), np.float32),
            spaces.Box(-1.0, 1.0, (3,), np.float32),
        )
        tensors = _zeros(architecture, attempts) | {"basis": basis, "scale": scale}
        self._attempts = attempts
        self._network = Network(architecture, attempts.task, tensors)
        self._history = self._network.history(attempts.count)
        self._reach = np.asarray(architecture.reach)
        self._seed = seed
        self._actions: Array = np.zeros((attempts.count, 3))
        self._signs: Array = np.ones((attempts.count, 3))
        self.rewards: list[float] = []
        self.successes: deque[bool] = deque(maxlen=512)

    def reset(self) -> NDArray[np.float32]:
        self._history.reset()
        return self._observe(self._attempts.reset(self._seed))

    def step_async(self, actions: NDArray[Any]) -> None:
        self._actions = np.asarray(actions, dtype=float) * self._signs * self._reach

    def step_wait(self) -> VecEnvStepReturn:
        self._history.record(self._actions)
        outcome = self._attempts.step(self._actions)
        self.rewards.append(float(outcome.reward.mean()))
        self.successes.extend(bool(value) for value in outcome.success[outcome.done])
        self._history.reset(outcome.done)
        # The attempts used up are part of the observation, so the last one is an end like any other.
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        return self._observe(outcome.images), outcome.better.astype(np.float32), outcome.done, infos

    def _observe(self, images: NDArray[np.float32]) -> NDArray[np.float32]:
        inputs, self._signs = self._network.canonical(self._history.observe(self._network.encode(images)))
        return inputs.astype(np.float32)

    def close(self) -> None:
        self._attempts.env.close()

    def env_is_wrapped(self, wrapper_class: type, indices: VecEnvIndices = None) -> list[bool]:
        return [False] * self.num_envs

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        return [getattr(self, attr_name)] * self.num_envs

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        setattr(self, attr_name, value)

    def env_method(self, method_name: str, *args: Any, indices: VecEnvIndices = None, **kwargs: Any) -> list[Any]:
        return [getattr(self, method_name)(*args, **kwargs)] * self.num_envs


@dataclass(frozen=True)
class _Run:
    """What belongs together while a run lasts."""

    env: HistoryVecEnv
    validation: PolicyEnv
    architecture: Architecture
    basis: Array
    scale: Array
    settings: PPOSettings
    noise: FlowMapNoise | None
    out: Path
    command: Sequence[str]
    report: Callable[[LearningCurvePoint], None] | None


def train(
    attempts: PolicyEnv,
    validation: PolicyEnv,
    *,
    out: Path,
    architecture: Architecture | None = None,
    settings: PPOSettings | None = None,
    command: Sequence[str] = (),
    report: Callable[[LearningCurvePoint], None] | None = None,
) -> TrainingResult:
    """Train on `attempts`, keep the checkpoint that does best on `validation`.

    Parameters
    ----------
    out: folder for insertion.safetensors, learning_curve.csv and learning_curve.png; made when missing
    command: the command line to store in the checkpoint
    report: called after every update and every evaluation

    Raises UsageError when the settings do not fit each other, or `out` holds a trained policy already.
    """
    architecture = architecture or Architecture()
    settings = settings or PPOSettings()
    _check(settings, attempts)
    if (out / CHECKPOINT).exists():  # hours of another run, perhaps one that is still going on
        raise UsageError(f"{out} already holds a trained policy; give another folder, or delete that one")
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"cannot write into {out}: {error.strerror}") from error
    torch.set_num_threads(1)  # the products are tiny, and one thread makes a run repeatable
    basis = polynomial_basis(attempts.task.grid, architecture.degree)
    scale = calibrate(attempts, architecture, basis, settings)
    env = HistoryVecEnv(attempts, architecture, basis, scale, seed=settings.seed)
    run = _Run(
        env, validation, architecture, basis, scale, settings, attempts.noise, out, command=command, report=report
    )
    keeper = _Keeper(run)
    _model(env, architecture, settings).learn(settings.attempts, callback=keeper)
    return keeper.finish()


def _model(env: HistoryVecEnv, architecture: Architecture, settings: PPOSettings) -> PPO:
    return PPO(
        "MlpPolicy",
        env,
        n_steps=settings.rollout,
        batch_size=min(settings.batch, settings.rollout * env.num_envs),
        n_epochs=settings.epochs,
        learning_rate=lambda left: settings.learning_rate * (0.1 + 0.9 * left),
        gamma=settings.discount,
        gae_lambda=settings.gae,
        clip_range=settings.clip,
        vf_coef=settings.value,
        ent_coef=settings.entropy,
        max_grad_norm=settings.gradient_norm,
        policy_kwargs={
            "net_arch": {"pi": list(architecture.hidden), "vf": list(architecture.hidden)},
            "activation_fn": torch.nn.Tanh,
            "log_std_init": float(np.log(settings.spread)),
        },
        seed=settings.seed,
        device="cpu",
    )


def export(model: PPO, architecture: Architecture, basis: Array, scale: Array) -> dict[str, NDArray[Any]]:
    """The actor of a PPO model as the tensors of our network."""
    modules = [*model.policy.mlp_extractor.policy_net.modules(), model.policy.action_net]
    linear = [module for module in modules if isinstance(module, torch.nn.Linear)]
    tensors: dict[str, NDArray[Any]] = {"basis": basis, "scale": scale}
    for i, layer in enumerate(linear):
        tensors[f"{i}.weight"] = layer.weight.detach().numpy().astype(np.float32)
        tensors[f"{i}.bias"] = layer.bias.detach().numpy().astype(np.float32)
    return tensors


def calibrate(attempts: PolicyEnv, architecture: Architecture, basis: Array, settings: PPOSettings) -> Array:
    """Root mean square of every feature over random attempts, noise included: what the features are divided by.

    The same for both pads of a frame and never less than 1e-3, so that a feature which is only noise stays small.
    """
    rng = np.random.default_rng([settings.seed, 1])
    images = attempts.reset(settings.seed)
    squares = []
    for _ in range(max(1, min(settings.calibration, settings.attempts) // attempts.count)):
        squares.append(reduce_maps(images, basis) ** 2)
        reach = np.asarray(architecture.reach)
        images = attempts.step(rng.uniform(-reach, reach, (attempts.count, 3)) / 2).images
    mean = np.concatenate(squares).mean(0)
    pads = mean.reshape(-1, attempts.task.sensors, 2, basis.shape[1])
    mean = np.broadcast_to(pads.mean(axis=(0, 1), keepdims=True), pads.shape).reshape(-1)
    return np.asarray(np.maximum(np.sqrt(mean), 1e-3))


class _Keeper(BaseCallback):
    """Follows a run: points of the curve, evaluations, the best checkpoint, the end of the time."""

    def __init__(self, run: _Run) -> None:
        super().__init__()
        self._run = run
        self._start = time.monotonic()
        self._next = run.settings.evaluate_every
        self._best: EvaluationResult | None = None
        self._points: list[LearningCurvePoint] = []

    def _on_step(self) -> bool:
        return self._minutes() < self._run.settings.minutes

    def _on_rollout_end(self) -> None:
        self._point(None)

    def _on_rollout_start(self) -> None:
        if self.num_timesteps >= self._next:
            self._next += self._run.settings.evaluate_every
            self._evaluate()

    def _on_training_end(self) -> None:
        self._evaluate()

    def _minutes(self) -> float:
        return (time.monotonic() - self._start) / 60

    def _point(self, evaluation: EvaluationResult | None) -> None:
        env = self._run.env
        spread = float(torch.as_tensor(self.model.policy.log_std).detach().exp().mean())
        reward = float(np.mean(env.rewards)) if env.rewards else float("nan")
        success = float(np.mean(env.successes)) if env.successes else float("nan")
        env.rewards.clear()
        point = LearningCurvePoint(self.num_timesteps, self._minutes(), reward, success, spread, evaluation)
        self._points.append(point)
        if self._run.report:
            self._run.report(point)

    def _evaluate(self) -> None:
        run, settings = self._run, self._run.settings
        assert isinstance(self.model, PPO)
        tensors = export(self.model, run.architecture, run.basis, run.scale)
        task = run.validation.task
        actor = NetworkActor(Network(run.architecture, task, tensors), run.validation.count)
        seed = settings.seed + 1_000_003  # parts that training does not begin with
        episodes = min(settings.evaluate_episodes, settings.attempts)  # a trial run is not mostly evaluation
        result = evaluate("validation", actor, run.validation, episodes=episodes, seed=seed)
        if self._best is None or (result.success, result.reward) > (self._best.success, self._best.reward):
            self._best = result
            training = {
                "command": list(run.command),
                "settings": _plain(settings),
                "noise": None if run.noise is None else dataclasses.asdict(run.noise),
                "attempts": self.num_timesteps,
                "validation": {"episodes": result.episodes, "success": result.success, "attempts": result.attempts},
                "versions": {"torch": str(torch.__version__), "stable_baselines3": stable_baselines3.__version__},
            }
            path = run.out / CHECKPOINT
            checkpoint.save_checkpoint(
                path, task=task, architecture=run.architecture, tensors=tensors, training=training
            )
        self._point(result)
        curve.write_table(run.out / CURVE, self._points)

    def finish(self) -> TrainingResult:
        """Draw the curve; what was made."""
        assert self._best is not None
        curve.draw(self._run.out / PICTURE, self._points)
        out = self._run.out
        return TrainingResult(out / CHECKPOINT, self._best, out / CURVE, out / PICTURE)


def _plain(settings: PPOSettings) -> dict[str, Any]:
    """Settings as JSON has them: no infinity."""
    return {key: None if value == float("inf") else value for key, value in dataclasses.asdict(settings).items()}


def _zeros(architecture: Architecture, attempts: PolicyEnv) -> dict[str, NDArray[Any]]:
    return {name: np.zeros(shape) for name, shape in tensor_shapes(architecture, attempts.task).items()}


def _check(settings: PPOSettings, attempts: PolicyEnv) -> None:
    """One line for settings that stable-baselines3 would take and misuse, or refuse with a traceback."""
    collected = settings.rollout * attempts.count
    if settings.attempts < 1 or not settings.minutes > 0:
        raise UsageError(f"training needs attempts and minutes above 0, got {settings.attempts}, {settings.minutes}")
    if collected < 2 or collected % min(settings.batch, collected):
        raise UsageError(
            f"{attempts.count} environments × {settings.rollout} attempts must be a multiple of the batch,"
            f" {settings.batch}: choose another number of environments"
        )
