"""Training of the insertion policy by imitation (DAgger) of an expert that knows the true pose.

The misalignment is available in simulation, so each attempt is labelled with the correction that centres the part. The
policy makes attempts, with exploration, and the network is fitted to the labels. Because the attempts are those of the
policy itself, the training data cover the states that the policy visits (Ross, Gordon and Bagnell, A Reduction of
Imitation Learning and Structured Prediction to No-Regret Online Learning, 2011).

The first attempts of a part often allow several explanations. The mean of the corrections inserts none of them, so the
loss is bounded: the network learns to correct the most probable one (a mode), and the next attempt shows the error.
"""

import dataclasses
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.policies import checkpoint
from gelflow.policies import learning_curve as curve
from gelflow.policies.environment import PolicyEnv
from gelflow.policies.evaluation import EvaluationResult, NetworkActor, evaluate
from gelflow.policies.insertion_expert import expert_correction, part_tolerance
from gelflow.policies.learning_curve import LearningCurvePoint, TrainingResult
from gelflow.policies.networks.polynomial_features import polynomial_basis, reduce_maps
from gelflow.policies.networks.polynomial_gru import PolynomialGRU, PolynomialGRUNetwork
from gelflow.policies.networks.polynomial_gru_torch import TorchPolynomialGRU
from gelflow.policies.training_state import check_same_run, finish_state, load_state, save_state
from gelflow.task import InsertionTask

Array = NDArray[np.float64]

_SAVE_INTERVAL = 20.0  # [s] between savings of an unfinished run, at the end of an iteration


@dataclass(frozen=True)
class ImitationSettings:
    """Settings of a training run, stored in the checkpoint."""

    attempts: int = 400_000  # total number of attempts
    minutes: float = float("inf")  # time limit [min]; a run that reaches it is not reproducible
    seed: int = 0
    rollout: int = 16  # attempts per environment in an iteration, which starts with new parts
    updates: int = 60  # of the network per iteration
    batch: int = 64  # sequences of `rollout` attempts in an update
    memory: int = 40  # iterations whose attempts are learned from
    learning_rate: float = 3e-3  # decreases linearly to zero
    gradient_norm: float = 1.0  # largest norm of the gradient
    # Error of a correction that counts as 1 [m, m, rad]; None: `part_tolerance`.
    tolerance: tuple[float, float, float] | None = None
    bounded: float = 0.9  # share of the bounded loss, reached after `bounded_after` of the training
    bounded_after: float = 0.3
    # Largest standard deviation of the exploration, in units of the reach: at the start and at the end.
    exploration: tuple[float, float] = (0.4, 0.03)
    evaluate_every: int = 50_000  # attempts
    evaluate_episodes: int = 512

    def __post_init__(self) -> None:
        counts = (self.attempts, self.rollout, self.updates, self.batch, self.memory, self.evaluate_episodes)
        if min(counts) < 1 or not self.minutes > 0:
            raise UsageError(f"training requires attempts, minutes and counts above 0, got {self}")


@dataclass(frozen=True)
class Attempts:
    """Attempts of one iteration, in the canonical (mirrored) coordinates of the network; steps × parts."""

    inputs: NDArray[np.float32]  # shape (steps, n, inputs)
    targets: NDArray[np.float32]  # corrections that centre the part, in units of the reach, shape (steps, n, 3)
    starts: NDArray[np.bool_]  # first attempts of a part, shape (steps, n)


def train(
    env: PolicyEnv,
    validation: PolicyEnv,
    *,
    out: Path,
    architecture: PolynomialGRU | None = None,
    settings: ImitationSettings | None = None,
    command: Sequence[str] = (),
    report: Callable[[LearningCurvePoint], None] | None = None,
) -> TrainingResult:
    """Trains a policy on `env` and keeps the checkpoint with the best result on `validation`.

    Parameters
    ----------
    env: environment of the training
    validation: environment of the evaluations
    out: folder of insertion.safetensors, learning_curve.csv and learning_curve.png; created if missing
    architecture: of the network; None takes the mirror symmetry and the largest turn of the task
    settings: of the algorithm
    command: command line, stored in the checkpoint
    report: called after each iteration and each evaluation

    A run that was killed resumes from the last saved state, at most 20 s or one iteration old, and gives the result of
    an uninterrupted one. Raises UsageError when `out` contains a trained policy, or an unfinished run with
    other settings.
    """
    torch.set_num_threads(1)  # small matrices; one thread makes a run repeatable
    if architecture is None:
        reach_x, reach_y, _ = PolynomialGRU.reach
        architecture = PolynomialGRU(mirror=env.task.part.mirror, reach=(reach_x, reach_y, env.task.action_scale[2]))
    run = _Run(env, validation, architecture, settings or ImitationSettings(), out, command, report)
    settings = run.settings
    while run.attempts < settings.attempts and run.minutes() < settings.minutes:
        progress = run.attempts / settings.attempts
        sigma = np.interp(progress, [0, 1], settings.exploration)
        begun = time.perf_counter()
        attempts, success, reward = collect(run.network(), env, settings, seed=run.seed(), sigma=float(sigma))
        run.simulation_time += time.perf_counter() - begun
        begun = time.perf_counter()
        run.memory.append(attempts)
        learn(run.layers, run.optimizer, list(run.memory), settings, run.scaled_tolerance, progress, run.rng())
        run.learning_time += time.perf_counter() - begun
        run.finish_iteration(success, reward, float(sigma))
    return run.finish()


def collect(
    network: PolynomialGRUNetwork, env: PolicyEnv, settings: ImitationSettings, *, seed: int, sigma: float
) -> tuple[Attempts, float, float]:
    """Attempts of the policy with exploration, its success rate, and its mean reward.

    The standard deviation of the exploration is drawn for each part, up to `sigma`.
    """
    rng = np.random.default_rng([seed, 1])
    policy = network.batch_policy(env.count)
    images = env.reset(seed)
    spread = sigma * rng.uniform(size=(env.count, 1))
    explored = np.array([1.0, 1.0, 0.0 if env.task.part.is_round else 1.0])
    inputs, targets, starts, rewards = [], [], [], []
    ended = inserted = 0
    for _ in range(settings.rollout):
        starts.append(policy.new.copy())
        inputs.append(policy.observe(images).astype(np.float32))
        targets.append(
            (expert_correction(env.task, env.pose, policy.signs) / np.asarray(network.reach)).astype(np.float32)
        )
        output = policy.output(inputs[-1].astype(float))
        corrections = policy.correct(np.clip(output, -1, 1) + spread * rng.standard_normal(output.shape) * explored)
        result = env.step(corrections)
        images = result.images
        policy.reset(result.done)
        spread = np.where(result.done[:, None], sigma * rng.uniform(size=spread.shape), spread)
        rewards.append(result.reward.mean())
        ended += int(result.done.sum())
        inserted += int(result.success.sum())
    attempts = Attempts(np.stack(inputs), np.stack(targets), np.stack(starts))
    return attempts, inserted / ended if ended else float("nan"), float(np.mean(rewards))


def learn(
    layers: TorchPolynomialGRU,
    optimizer: torch.optim.Optimizer,
    memory: Sequence[Attempts],
    settings: ImitationSettings,
    tolerance: Array,
    progress: float,
    rng: np.random.Generator,
) -> None:
    """Updates the network with sequences drawn from `memory`.

    `tolerance` (3,) is in units of the reach, `progress` is the share of the training that is done.
    """
    for group in optimizer.param_groups:
        group["lr"] = settings.learning_rate * (1 - progress)
    bounded = settings.bounded * min(1.0, progress / settings.bounded_after)
    scale = torch.as_tensor(tolerance, dtype=torch.float32)
    for _ in range(settings.updates):
        inputs, targets, starts = _draw_batch(memory, settings.batch, rng)
        error = (layers(inputs, starts) - targets) / scale
        loss = imitation_loss(error, bounded)
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(layers.parameters(), settings.gradient_norm)
        optimizer.step()


def imitation_loss(error: torch.Tensor, bounded: float) -> torch.Tensor:
    """Mean over errors (…, 3): a share `bounded` of 1 − exp(−r²/2), which seeks modes, the rest √(1 + r²) − 1.

    The second term has a gradient at any distance and dominates the start of a training.
    """
    squared = error.pow(2).sum(-1)
    return (bounded * (1 - torch.exp(-squared / 2)) + (1 - bounded) * (torch.sqrt(1 + squared) - 1)).mean()


def _draw_batch(
    memory: Sequence[Attempts], count: int, rng: np.random.Generator
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """`count` sequences of random iterations and parts: inputs, targets, starts; each (steps, count, …)."""
    parts = memory[0].starts.shape[1]
    chosen = [(memory[i], part) for i, part in rng.integers(0, (len(memory), parts), (count, 2))]
    arrays = (
        np.stack([attempts.inputs[:, part] for attempts, part in chosen], axis=1),
        np.stack([attempts.targets[:, part] for attempts, part in chosen], axis=1),
        np.stack([attempts.starts[:, part] for attempts, part in chosen], axis=1),
    )
    inputs, targets, starts = (torch.from_numpy(array) for array in arrays)
    return inputs, targets, starts


def feature_scale(env: PolicyEnv, basis: Array, seed: int) -> Array:
    """Root mean square of each feature over first attempts with noise, the divisor of the features.

    It is common to the pads and the shear components of a polynomial term, so that mirroring preserves it, and at least
    0.03, so that features without signal stay small.
    """
    squares = (reduce_maps(env.reset(seed), basis) ** 2).mean(0).reshape(-1, basis.shape[1])
    return np.asarray(np.maximum(np.sqrt(np.broadcast_to(squares.mean(0), squares.shape).reshape(-1)), 0.03))


class _Run:
    """State and files of a training run."""

    def __init__(
        self,
        env: PolicyEnv,
        validation: PolicyEnv,
        architecture: PolynomialGRU,
        settings: ImitationSettings,
        out: Path,
        command: Sequence[str],
        report: Callable[[LearningCurvePoint], None] | None,
    ) -> None:
        self.task: InsertionTask = env.task
        self.settings, self.architecture = settings, architecture
        self._env, self._validation, self._out, self._command, self._report = env, validation, out, command, report
        unfinished = load_state(out)
        if unfinished is None:
            curve.create_training_folder(out)
        with torch.random.fork_rng():
            torch.manual_seed(settings.seed)
            self.layers = TorchPolynomialGRU(architecture, self.task)
        self.optimizer = torch.optim.Adam(self.layers.parameters(), settings.learning_rate)
        self.scaled_tolerance = np.asarray(settings.tolerance or part_tolerance(self.task)) / architecture.reach
        self.memory: deque[Attempts] = deque(maxlen=settings.memory)
        self.attempts = 0
        self.simulation_time = self.learning_time = 0.0  # [s]
        self._begun = self._saved = time.monotonic()
        self._iterations = 0
        self._best: EvaluationResult | None = None
        self._points: list[LearningCurvePoint] = []
        # All of it must be equal when the run is continued.
        self._identity: dict[str, Any] = {
            "task": self.task.digest(),
            "network": architecture.to_json(),
            "settings": {name: str(value) for name, value in vars(settings).items() if name != "minutes"},
            "environments": env.count,
        }
        if unfinished is None:
            basis = polynomial_basis(self.task.grid, architecture.degree)
            self._fixed = {"basis": basis, "scale": feature_scale(env, basis, settings.seed)}
        else:
            self._continue(*unfinished)

    def minutes(self) -> float:
        """Duration of the run [min]."""
        return (time.monotonic() - self._begun) / 60

    def seed(self) -> int:
        """Seed of the present iteration's attempts."""
        return int(np.random.SeedSequence([self.settings.seed, self._iterations]).generate_state(1)[0])

    def rng(self) -> np.random.Generator:
        """Generator of the present iteration's batches."""
        return np.random.default_rng([self.settings.seed, self._iterations, 2])

    def tensors(self) -> dict[str, NDArray[Any]]:
        """Tensors of the present network, as a checkpoint stores them."""
        return {name: values.astype(np.float32) for name, values in (self._fixed | self.layers.tensors()).items()}

    def network(self) -> PolynomialGRUNetwork:
        """The present network for inference."""
        return self.architecture.network(self.task, self.tensors())

    def finish_iteration(self, success: float, reward: float, exploration: float) -> None:
        """Records an iteration, evaluates the network when it is due, and saves the state."""
        before, every = self.attempts, self.settings.evaluate_every
        self._iterations += 1
        self.attempts += self.settings.rollout * self._env.count
        self._add_point(LearningCurvePoint(self.attempts, self.minutes(), reward, success, exploration))
        if self.attempts // every > before // every and self.attempts < self.settings.attempts:
            self._evaluate()
        if time.monotonic() > self._saved + _SAVE_INTERVAL:
            self._save_state()

    def _save_state(self) -> None:
        """Saves everything that the remaining iterations depend on, so that a continued run gives the same result."""
        arrays: dict[str, NDArray[Any]] = {f"fixed.{name}": values for name, values in self._fixed.items()}
        arrays |= {f"layers.{name}": values for name, values in self.layers.tensors().items()}
        for index, values in self.optimizer.state_dict()["state"].items():
            arrays |= {f"optimizer.{index}.{name}": tensor.numpy() for name, tensor in values.items()}
        for index, attempts in enumerate(self.memory):
            arrays |= {f"memory.{index}.{name}": array for name, array in vars(attempts).items()}
        facts = {
            "identity": self._identity,
            "iterations": self._iterations,
            "attempts": self.attempts,
            "seconds": [self.simulation_time, self.learning_time, 60 * self.minutes()],
            "best": None if self._best is None else dataclasses.asdict(self._best),
            "points": [dataclasses.asdict(point) for point in self._points],
        }
        save_state(self._out, arrays, facts)
        self._saved = time.monotonic()

    def _continue(self, arrays: dict[str, NDArray[Any]], facts: dict[str, Any]) -> None:
        """Restores the state of an unfinished run. Raises UsageError when it was started with other settings."""
        check_same_run(self._out, facts["identity"], self._identity)
        groups: dict[str, dict[str, NDArray[Any]]] = {}
        for name, values in arrays.items():
            group, _, key = name.partition(".")
            groups.setdefault(group, {})[key] = values
        self._fixed = groups["fixed"]
        self.layers.load_state_dict({name: torch.from_numpy(values) for name, values in groups["layers"].items()})
        state: dict[int, dict[str, torch.Tensor]] = {}
        for name, values in groups["optimizer"].items():
            index, key = name.split(".")
            state.setdefault(int(index), {})[key] = torch.from_numpy(values)
        self.optimizer.load_state_dict({**self.optimizer.state_dict(), "state": state})
        memory = groups["memory"]
        for i in range(len(memory) // 3):
            self.memory.append(Attempts(*(memory[f"{i}.{name}"] for name in ("inputs", "targets", "starts"))))
        self._iterations, self.attempts = facts["iterations"], facts["attempts"]
        self.simulation_time, self.learning_time, seconds = facts["seconds"]
        self._begun -= seconds
        self._best = None if facts["best"] is None else EvaluationResult(**facts["best"])
        for point in facts["points"]:
            evaluation = None if point["evaluation"] is None else EvaluationResult(**point["evaluation"])
            self._points.append(LearningCurvePoint(**{**point, "evaluation": evaluation}))

    def _add_point(self, point: LearningCurvePoint) -> None:
        self._points.append(point)
        if self._report:
            self._report(point)

    def _evaluate(self) -> None:
        validation, settings = self._validation, self.settings
        actor = NetworkActor(self.network(), validation.count)
        episodes = min(settings.evaluate_episodes, settings.attempts)  # limits the evaluations of short runs
        seed = settings.seed + 1_000_003  # differs from the seeds of the training
        result = evaluate("validation", actor, validation, episodes=episodes, seed=seed)
        if self._best is None or (result.success, -result.length) > (self._best.success, -self._best.length):
            self._best = result
            self._save(result)
        last = self._points[-1]
        self._add_point(dataclasses.replace(last, minutes=self.minutes(), evaluation=result))
        curve.write_table(self._out / curve.CURVE, self._points)

    def _save(self, result: EvaluationResult) -> None:
        noise = self._env.noise
        training = {
            "algorithm": "imitation",
            "command": list(self._command),
            "settings": {k: None if v == float("inf") else v for k, v in dataclasses.asdict(self.settings).items()},
            "noise": None if noise is None else dataclasses.asdict(noise),
            "attempts": self.attempts,
            "validation": result.to_json(),
            "versions": {"torch": str(torch.__version__)},
        }
        checkpoint.save_checkpoint(
            self._out / curve.CHECKPOINT,
            task=self.task,
            architecture=self.architecture,
            tensors=self.tensors(),
            training=training,
        )

    def finish(self) -> TrainingResult:
        """Evaluates the last network, draws the learning curve and returns the result."""
        self._evaluate()
        assert self._best is not None
        curve.draw(self._out / curve.PICTURE, self._points)
        finish_state(self._out)
        shares = (self.simulation_time, self.learning_time)
        return TrainingResult(
            self._out / curve.CHECKPOINT, self._best, self._out / curve.CURVE, self._out / curve.PICTURE, *shares
        )
