"""Training of the insertion policy with PPO of stable-baselines3, exported to a checkpoint.

PPO receives the features of the flow maps instead of the maps, which keeps its buffers and updates small. The training
reward is the improvement by a correction: the reward of the pose after it minus that of the pose before. It is
immediate, so the discount is small, and its variance does not depend on the initial misalignment.
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
from gelflow.policies.learning_curve import LearningCurvePoint, TrainingResult
from gelflow.policies.networks.polynomial_features import polynomial_basis, reduce_maps
from gelflow.policies.networks.polynomial_mlp import PolynomialMLP, PolynomialNetwork

Array = NDArray[np.float64]


@dataclass(frozen=True)
class PPOSettings:
    """Settings of a training run, stored in the checkpoint."""

    attempts: int = 200_000  # total number of attempts
    minutes: float = float("inf")  # time limit [min]; a run that reaches it is not reproducible
    seed: int = 0
    rollout: int = 16  # attempts per environment between updates
    batch: int = 256  # minibatch size
    epochs: int = 10  # per update
    learning_rate: float = 2e-3  # decreases linearly to a tenth
    discount: float = 0.5
    gae: float = 0.95  # λ of the generalized advantage estimation (GAE), 0 to 1
    clip: float = 0.2  # clip range of the policy ratio
    value: float = 0.5  # coefficient of the value loss
    entropy: float = 0.0  # coefficient of the entropy loss
    gradient_norm: float = 0.5  # largest norm of the gradient
    spread: float = 0.4  # initial standard deviation of the actions, whose range is ±1
    calibration: int = (
        2_000  # random attempts that determine the scale of the features (`feature_scale`), not camera calibration
    )
    evaluate_every: int = 20_000  # attempts
    evaluate_episodes: int = 512


class HistoryVecEnv(VecEnv):
    """`PolicyEnv` as an environment of stable-baselines3.

    Observations are canonical inputs of the network, actions of ±1 correspond to `PolynomialMLP.reach`.
    """

    render_mode = None

    def __init__(self, env: PolicyEnv, architecture: PolynomialMLP, basis: Array, scale: Array, *, seed: int) -> None:
        size = architecture.inputs(env.task)
        super().__init__(
            env.count,
            spaces.Box(-np.inf, np.inf, (size,), np.float32),
            spaces.Box(-1.0, 1.0, (3,), np.float32),
        )
        tensors = _zero_tensors(architecture, env) | {"basis": basis, "scale": scale}
        self._env = env
        self._network = PolynomialNetwork(architecture, env.task, tensors)
        self._history = self._network.history(env.count)
        self._reach = np.asarray(architecture.reach)
        self._seed = seed
        self._actions: Array = np.zeros((env.count, 3))
        self._signs: Array = np.ones((env.count, 3))
        self.pose_rewards: list[float] = []  # mean `InsertionTask.reward` of the poses after each step
        self.successes: deque[bool] = deque(maxlen=512)

    def reset(self) -> NDArray[np.float32]:
        self._history.reset()
        return self._observe(self._env.reset(self._seed))

    def step_async(self, actions: NDArray[Any]) -> None:
        self._actions = np.asarray(actions, dtype=float) * self._signs * self._reach

    def step_wait(self) -> VecEnvStepReturn:
        self._history.record(self._actions)
        result = self._env.step(self._actions)
        self.pose_rewards.append(float(result.reward.mean()))
        self.successes.extend(bool(value) for value in result.success[result.done])
        self._history.reset(result.done)
        # The number of attempts is part of the observation, so the last attempt is a regular end of the episode.
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        return self._observe(result.images), result.improvement.astype(np.float32), result.done, infos

    def _observe(self, images: NDArray[np.float32]) -> NDArray[np.float32]:
        inputs, self._signs = self._network.canonical(self._history.observe(self._network.encode(images)))
        return inputs.astype(np.float32)

    def close(self) -> None:
        self._env.env.close()

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
    """The inputs of a training run."""

    env: HistoryVecEnv
    validation: PolicyEnv
    architecture: PolynomialMLP
    basis: Array
    scale: Array
    settings: PPOSettings
    noise: FlowMapNoise | None
    out: Path
    command: Sequence[str]
    report: Callable[[LearningCurvePoint], None] | None


def train(
    env: PolicyEnv,
    validation: PolicyEnv,
    *,
    out: Path,
    architecture: PolynomialMLP | None = None,
    settings: PPOSettings | None = None,
    command: Sequence[str] = (),
    report: Callable[[LearningCurvePoint], None] | None = None,
) -> TrainingResult:
    """Trains a policy on `env` and keeps the checkpoint with the best result on `validation`.

    Parameters
    ----------
    env: environment of the training
    validation: environment of the evaluations
    out: folder of insertion.safetensors, learning_curve.csv and learning_curve.png; created if missing
    architecture: of the network
    settings: of PPO
    command: command line, stored in the checkpoint
    report: called after each update and each evaluation

    Raises UsageError for inconsistent settings, and when `out` already contains a trained policy.
    """
    architecture = architecture or PolynomialMLP()
    settings = settings or PPOSettings()
    _check_settings(settings, env)
    curve.create_training_folder(out)
    torch.set_num_threads(1)  # small matrices; one thread makes a run repeatable
    basis = polynomial_basis(env.task.grid, architecture.degree)
    scale = feature_scale(env, architecture, basis, settings)
    history_env = HistoryVecEnv(env, architecture, basis, scale, seed=settings.seed)
    run = _Run(
        history_env, validation, architecture, basis, scale, settings, env.noise, out, command=command, report=report
    )
    callback = _TrainingCallback(run)
    _make_model(history_env, architecture, settings).learn(settings.attempts, callback=callback)
    return callback.finish()


def _make_model(env: HistoryVecEnv, architecture: PolynomialMLP, settings: PPOSettings) -> PPO:
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


def export_actor(model: PPO, architecture: PolynomialMLP, basis: Array, scale: Array) -> dict[str, NDArray[Any]]:
    """The tensors of a `PolynomialNetwork` from the actor of a PPO model."""
    modules = [*model.policy.mlp_extractor.policy_net.modules(), model.policy.action_net]
    linear = [module for module in modules if isinstance(module, torch.nn.Linear)]
    tensors: dict[str, NDArray[Any]] = {"basis": basis, "scale": scale}
    for i, layer in enumerate(linear):
        tensors[f"{i}.weight"] = layer.weight.detach().numpy().astype(np.float32)
        tensors[f"{i}.bias"] = layer.bias.detach().numpy().astype(np.float32)
    return tensors


def feature_scale(env: PolicyEnv, architecture: PolynomialMLP, basis: Array, settings: PPOSettings) -> Array:
    """Root mean square of each feature over random attempts with noise, the divisor of the features.

    It is common to both pads and at least 1e-3, so that features without signal stay small.
    """
    rng = np.random.default_rng([settings.seed, 1])
    images = env.reset(settings.seed)
    squares = []
    for _ in range(max(1, min(settings.calibration, settings.attempts) // env.count)):
        squares.append(reduce_maps(images, basis) ** 2)
        reach = np.asarray(architecture.reach)
        images = env.step(rng.uniform(-reach, reach, (env.count, 3)) / 2).images
    mean = np.concatenate(squares).mean(0)
    pads = mean.reshape(-1, env.task.sensors, 2, basis.shape[1])
    mean = np.broadcast_to(pads.mean(axis=(0, 1), keepdims=True), pads.shape).reshape(-1)
    return np.asarray(np.maximum(np.sqrt(mean), 1e-3))


class _TrainingCallback(BaseCallback):
    """Records the learning curve, evaluates, saves the best checkpoint, and stops at the time limit."""

    def __init__(self, run: _Run) -> None:
        super().__init__()
        self._run = run
        self._start = time.monotonic()
        self._next_evaluation = run.settings.evaluate_every
        self._best: EvaluationResult | None = None
        self._points: list[LearningCurvePoint] = []

    def _on_step(self) -> bool:
        return self._minutes() < self._run.settings.minutes

    def _on_rollout_end(self) -> None:
        self._add_point(None)

    def _on_rollout_start(self) -> None:
        if self.num_timesteps >= self._next_evaluation:
            self._next_evaluation += self._run.settings.evaluate_every
            self._evaluate()

    def _on_training_end(self) -> None:
        self._evaluate()

    def _minutes(self) -> float:
        return (time.monotonic() - self._start) / 60

    def _add_point(self, evaluation: EvaluationResult | None) -> None:
        env = self._run.env
        spread = float(torch.as_tensor(self.model.policy.log_std).detach().exp().mean())
        reward = float(np.mean(env.pose_rewards)) if env.pose_rewards else float("nan")
        success = float(np.mean(env.successes)) if env.successes else float("nan")
        env.pose_rewards.clear()
        point = LearningCurvePoint(self.num_timesteps, self._minutes(), reward, success, spread, evaluation)
        self._points.append(point)
        if self._run.report:
            self._run.report(point)

    def _evaluate(self) -> None:
        run, settings = self._run, self._run.settings
        assert isinstance(self.model, PPO)
        tensors = export_actor(self.model, run.architecture, run.basis, run.scale)
        task = run.validation.task
        actor = NetworkActor(PolynomialNetwork(run.architecture, task, tensors), run.validation.count)
        seed = settings.seed + 1_000_003  # differs from the seed of the training
        episodes = min(settings.evaluate_episodes, settings.attempts)  # limits the evaluations of short runs
        result = evaluate("validation", actor, run.validation, episodes=episodes, seed=seed)
        if self._best is None or (result.success, result.reward) > (self._best.success, self._best.reward):
            self._best = result
            training = {
                "command": list(run.command),
                "settings": _to_json(settings),
                "noise": None if run.noise is None else dataclasses.asdict(run.noise),
                "attempts": self.num_timesteps,
                "validation": result.to_json(),
                "versions": {"torch": str(torch.__version__), "stable_baselines3": stable_baselines3.__version__},
            }
            path = run.out / curve.CHECKPOINT
            checkpoint.save_checkpoint(
                path, task=task, architecture=run.architecture, tensors=tensors, training=training
            )
        self._add_point(result)
        curve.write_table(run.out / curve.CURVE, self._points)

    def finish(self) -> TrainingResult:
        """Draws the learning curve and returns the result."""
        assert self._best is not None
        curve.draw(self._run.out / curve.PICTURE, self._points)
        out = self._run.out
        return TrainingResult(out / curve.CHECKPOINT, self._best, out / curve.CURVE, out / curve.PICTURE)


def _to_json(settings: PPOSettings) -> dict[str, Any]:
    """JSON data of the settings; infinity becomes None."""
    return {key: None if value == float("inf") else value for key, value in dataclasses.asdict(settings).items()}


def _zero_tensors(architecture: PolynomialMLP, env: PolicyEnv) -> dict[str, NDArray[Any]]:
    return {name: np.zeros(shape) for name, shape in architecture.tensor_shapes(env.task).items()}


def _check_settings(settings: PPOSettings, env: PolicyEnv) -> None:
    """Raises UsageError for settings that stable-baselines3 misinterprets or rejects with a traceback."""
    collected = settings.rollout * env.count
    if settings.attempts < 1 or not settings.minutes > 0:
        raise UsageError(f"training requires attempts and minutes above 0, got {settings.attempts}, {settings.minutes}")
    if collected < 2 or collected % min(settings.batch, collected):
        raise UsageError(
            f"{env.count} environments × {settings.rollout} attempts must be a multiple of the batch,"
            f" {settings.batch}: choose another number of environments"
        )
