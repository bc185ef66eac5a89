"""Training of the insertion policy by imitation (DAgger) of an expert that knows the true pose.

The misalignment is available in simulation, so each attempt is labelled with the correction that centres the part. The
policy makes attempts, with exploration, and the network is fitted to the labels. Because the attempts are those of the
policy itself, the training data cover the states that the policy visits (Ross, Gordon and Bagnell, A Reduction of
Imitation Learning and Structured Prediction to No-Regret Online Learning, 2011).

The first attempts of a part often allow several explanations. The mean of the corrections inserts none of them, so the
loss is bounded: the network learns to correct the most probable one (a mode), and the next attempt shows the error.
"""

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.policies.checkpoint import Checkpoint, task_differences
from gelflow.policies.insertion_expert import expert_correction, part_tolerance
from gelflow.policies.networks.flow_map_policy import insertion_task
from gelflow.policies.networks.polynomial_features import polynomial_basis, reduce_maps
from gelflow.policies.networks.polynomial_gru import PolynomialGRU, PolynomialGRUNetwork
from gelflow.policies.networks.polynomial_gru_torch import TorchPolynomialGRU
from gelflow.policies.ranges import COUNT, NOT_NEGATIVE, POSITIVE, SHARE, check_settings
from gelflow.policies.training.learner import Learner
from gelflow.policies.training.state import RunState, load_optimizer_tensors, optimizer_tensors
from gelflow.sim.tasks.task_batch import TaskBatch
from gelflow.task import InsertionTask

Array = NDArray[np.float64]

# Fields of a task that differ between parts whose policies have the same inputs and outputs.
_OF_PART = (
    "part",
    "misalignment",
    "workspace",
    "rim_height",
    "start_height",
    "success_height",
    "descent",
    "frame_depths",
)


@dataclass(frozen=True)
class ImitationSettings:
    """Settings of the algorithm, stored in the checkpoint."""

    rollout: int = 16  # attempts per environment in an iteration, which starts with new parts
    updates: int = 60  # of the network per iteration
    batch: int = 64  # sequences of `rollout` attempts in an update
    memory: int = 40  # iterations whose attempts are learned from
    learning_rate: float = 3e-3  # decreases linearly to zero
    gradient_norm: float = 1.0  # largest norm of the gradient
    # Error of a correction that counts as 1 [m, m, rad]; None: `part_tolerance`.
    tolerance: tuple[float, float, float] | None = None
    bounded: float = 0.9  # share of the bounded loss, reached after the part `bounded_after` of the training
    bounded_after: float = 0.3  # 0: from the first update
    # Largest standard deviation of the exploration, in units of the reach: at the start and at the end.
    exploration: tuple[float, float] = (0.4, 0.03)

    def __post_init__(self) -> None:
        check_settings(
            self,
            rollout=COUNT,
            updates=COUNT,
            batch=COUNT,
            memory=COUNT,
            learning_rate=POSITIVE,
            gradient_norm=POSITIVE,
            bounded=SHARE,
            bounded_after=SHARE,
            exploration=(NOT_NEGATIVE, 2),
        )
        if self.tolerance is not None:
            check_settings(self, tolerance=(POSITIVE, 3))


@dataclass(frozen=True)
class Attempts:
    """Attempts of one iteration, in the canonical (mirrored) coordinates of the network; steps × parts."""

    inputs: NDArray[np.float32]  # shape (steps, n, inputs)
    targets: NDArray[np.float32]  # corrections that centre the part, in units of the reach, shape (steps, n, 3)
    starts: NDArray[np.bool_]  # first attempts of a part, shape (steps, n)


class Imitation(Learner):
    """Imitation of `expert_correction` along the policy's own attempts.

    Parameters
    ----------
    task: environments of the insertion, whose `info["privileged"]` are the poses of the gripper in the hole's frame
    architecture: of the network, see `architecture_for`
    seed: of the initial weights, the parts and the batches
    steps: attempts until the learning rate is 0

    Every iteration starts with new parts, and its random numbers follow from `seed` and its number.
    """

    columns = ("reward", "success", "exploration")

    def __init__(
        self, task: TaskBatch, architecture: PolynomialGRU, settings: ImitationSettings, *, seed: int, steps: int
    ) -> None:
        super().__init__(task, architecture)
        self._description = insertion_task(task.description, architecture.kind)
        self._architecture, self._settings, self._seed, self._total = architecture, settings, seed, steps
        with torch.random.fork_rng():
            torch.manual_seed(seed)
            self._layers = TorchPolynomialGRU(architecture, self._description)
        self._optimizer = torch.optim.Adam(self._layers.parameters(), settings.learning_rate)
        self._tolerance = np.asarray(settings.tolerance or part_tolerance(self._description)) / architecture.reach
        self._basis = polynomial_basis(self._description.grid, architecture.degree)
        self._scale: Array | None = None  # of the features; from the first update
        self._memory: deque[Attempts] = deque(maxlen=settings.memory)
        self._iterations = 0

    def start_from(self, checkpoint: Checkpoint) -> None:
        """Takes the weights of a policy, which may be that of another part and of descents to another depth.

        Raises UsageError when its observations, actions or layers are others.
        """
        mine = self._description.to_json()
        different = task_differences(_without_part(checkpoint.task), _without_part(mine))
        if different or checkpoint.architecture != self._architecture:
            layers = task_differences(checkpoint.architecture.to_json(), self._architecture.to_json())
            raise UsageError(f"training cannot start from a policy with other {different or layers}")
        tensors = checkpoint.tensors
        checkpoint.architecture.network(self._description, tensors)  # checks names, shapes and values
        self._layers.load_state_dict({name: torch.tensor(tensors[name]) for name in self._layers.state_dict()})
        self._scale = tensors["scale"].astype(float)

    def update(self) -> dict[str, float]:
        """One iteration: attempts of the present network with exploration, then updates of the network."""
        progress = min(1.0, self.steps / self._total)
        sigma = float(np.interp(progress, [0, 1], self._settings.exploration))
        with self.clock.timed("simulation"):
            if self._scale is None:
                self._scale = feature_scale(self.task, self._basis, self._seed)
            seed = int(np.random.SeedSequence([self._seed, self._iterations]).generate_state(1)[0])
            attempts, success, reward = collect(
                self._network(), self.task, self._settings.rollout, seed=seed, sigma=sigma
            )
        with self.clock.timed("learning"):
            self._memory.append(attempts)
            self._learn(progress, np.random.default_rng([self._seed, self._iterations, 2]))
        self._iterations += 1
        self.steps += self._settings.rollout * self.task.num_envs
        return {"reward": reward, "success": success, "exploration": sigma}

    def _learn(self, progress: float, rng: np.random.Generator) -> None:
        """Updates the network with sequences drawn from the memory; `progress` is the share of the training done."""
        settings = self._settings
        for group in self._optimizer.param_groups:
            group["lr"] = settings.learning_rate * (1 - progress)
        reached = min(1.0, progress / settings.bounded_after) if settings.bounded_after > 0 else 1.0
        bounded = settings.bounded * reached
        scale = torch.as_tensor(self._tolerance, dtype=torch.float32)
        for _ in range(settings.updates):
            inputs, targets, starts = _draw_batch(self._memory, settings.batch, rng)
            error = (self._layers(inputs, starts) - targets) / scale
            loss = imitation_loss(error, bounded)
            self._optimizer.zero_grad()
            loss.backward()
            torch.nn.utils.clip_grad_norm_(self._layers.parameters(), settings.gradient_norm)
            self._optimizer.step()

    def _known_scale(self) -> Array:
        assert self._scale is not None, "the first update sets the scale"
        return self._scale

    def _network(self) -> PolynomialGRUNetwork:
        """The present network for inference."""
        return self._architecture.network(self._description, self.tensors())

    def restart_episodes(self) -> None:
        """Does nothing: every update starts new parts."""

    def tensors(self) -> dict[str, NDArray[Any]]:
        """Tensors of the present network."""
        tensors = {"basis": self._basis, "scale": self._known_scale(), **self._layers.tensors()}
        return {name: values.astype(np.float32) for name, values in tensors.items()}

    def state(self) -> RunState:
        """Everything that determines the next updates."""
        state = RunState(values={"iterations": self._iterations, "steps": self.steps, "memory": len(self._memory)})
        state.add("layers", self._layers.state_dict())
        state.add("optimizer", optimizer_tensors(self._optimizer))
        state.add("fixed", {"scale": torch.from_numpy(self._known_scale())})
        for i, attempts in enumerate(self._memory):
            state.add(f"memory/{i}", {name: torch.from_numpy(values) for name, values in vars(attempts).items()})
        return state

    def load(self, state: RunState) -> None:
        """Restores `state`."""
        self._layers.load_state_dict(state.part("layers"))
        load_optimizer_tensors(self._optimizer, state.part("optimizer"))
        self._scale = state.part("fixed")["scale"].numpy()
        self._memory.clear()
        for i in range(state.values["memory"]):
            arrays = {name: tensor.numpy() for name, tensor in state.part(f"memory/{i}").items()}
            self._memory.append(Attempts(**arrays))
        self._iterations, self.steps = state.values["iterations"], state.values["steps"]


def _without_part(task: Mapping[str, Any]) -> dict[str, Any]:
    """A description of the task, without part, misalignment and heights."""
    return {name: value for name, value in task.items() if name not in _OF_PART}


def architecture_for(task: InsertionTask) -> PolynomialGRU:
    """The architecture with the mirror symmetry and the largest turn of `task`."""
    reach_x, reach_y, _ = PolynomialGRU.reach
    return PolynomialGRU(mirror=task.part.mirror, reach=(reach_x, reach_y, task.action_scale[2]))


def collect(
    network: PolynomialGRUNetwork, task: TaskBatch, rollout: int, *, seed: int, sigma: float
) -> tuple[Attempts, float, float]:
    """`rollout` attempts per environment of the policy with exploration, its success rate, and its mean reward.

    The success rate is that of the first part of each environment: of later ones only those end that need few attempts.
    The standard deviation of the exploration is drawn for each part, up to `sigma`.
    """
    description, reach = network.task, np.asarray(network.reach)
    parts, rng = np.random.default_rng(seed), np.random.default_rng([seed, 1])
    policy = network.batch_policy(task.num_envs)
    task.reset(task.all, parts)
    spread = sigma * rng.uniform(size=(task.num_envs, 1))
    explored = np.array([1.0, 1.0, 0.0 if description.part.is_round else 1.0])
    inputs, targets, starts, rewards = [], [], [], []
    first, ended, inserted = task.all.copy(), 0, 0
    for _ in range(rollout):
        starts.append(policy.new.copy())
        inputs.append(policy.observe(task.observation).astype(np.float32))
        targets.append(
            (expert_correction(description, task.info["privileged"], policy.signs) / reach).astype(np.float32)
        )
        output = policy.output(inputs[-1].astype(float))
        corrections = policy.correct(np.clip(output, -1, 1) + spread * rng.standard_normal(output.shape) * explored)
        task.step(corrections / np.asarray(description.action_scale), parts)
        rewards.append(task.reward.mean())
        done = task.terminated | task.truncated
        ended += int((done & first).sum())
        inserted += int((task.terminated & first).sum())
        first &= ~done
        if done.any():
            task.reset(done, parts)
            policy.reset(done)
        spread = np.where(done[:, None], sigma * rng.uniform(size=spread.shape), spread)
    attempts = Attempts(np.stack(inputs), np.stack(targets), np.stack(starts))
    return attempts, inserted / ended if ended else float("nan"), float(np.mean(rewards))


def imitation_loss(error: torch.Tensor, bounded: float) -> torch.Tensor:
    """Mean of b (1 − exp(−r²/2)) + (1 − b) (√(1 + r²) − 1) over errors (…, 3) of length r, with b = `bounded`.

    The first term is bounded, so that its minimum is a mode and not a mean. The second one has a gradient at any
    distance and dominates the start of a training.
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


def feature_scale(task: TaskBatch, basis: Array, seed: int) -> Array:
    """Root mean square of each feature over first attempts, the divisor of the features.

    It is common to the pads and the shear components of a polynomial term, so that mirroring preserves it, and at least
    0.03, so that features without signal stay small.
    """
    task.reset(task.all, np.random.default_rng(seed))
    squares = (reduce_maps(task.observation, basis) ** 2).mean(0).reshape(-1, basis.shape[1])
    return np.asarray(np.maximum(np.sqrt(np.broadcast_to(squares.mean(0), squares.shape).reshape(-1)), 0.03))
