"""Proximal policy optimization (PPO, Schulman et al. 2017) with a Gaussian actor, feedforward or recurrent.

Each iteration collects a rollout of all environments (`_collect`), estimates advantages (`_advantages`), and improves
actor and critic by several epochs over minibatches (`_learn`). The hidden state of a recurrent actor is carried over
between rollouts; gradients are truncated at the start of a rollout.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from gelflow.errors import UsageError
from gelflow.policies.networks.actor import ActorArchitecture
from gelflow.policies.networks.mlp import MLP
from gelflow.policies.networks.torch_actor import TorchActor, VectorEncoder
from gelflow.policies.ranges import COUNT, NOT_NEGATIVE, POSITIVE, SHARE, check_settings
from gelflow.policies.training.learner import Learner
from gelflow.policies.training.state import (
    RunState,
    generator_from,
    generator_value,
    load_optimizer_tensors,
    optimizer_tensors,
)
from gelflow.sim.tasks.task_batch import TaskBatch


@dataclass(frozen=True)
class PPOSettings:
    """Settings of PPO."""

    rollout: int = 32  # steps of each environment between updates
    batch: int = 256  # steps of a minibatch
    epochs: int = 10  # passes over a rollout
    learning_rate: float = 3e-4  # decreases linearly
    last_learning_rate: float = 0.0  # at the end, relative to the first
    discount: float = 0.99
    trace: float = 0.95  # λ of the generalized advantage estimation
    clip: float = 0.2  # largest change of the ratio of probabilities
    value: float = 0.5  # coefficient of the value loss
    entropy: float = 0.01  # coefficient of the entropy
    gradient_norm: float = 0.5  # largest norm of a gradient
    deviation: float = 0.6  # initial standard deviation of the actions, whose range is ±1
    privileged_critic: bool = False  # the critic observes `info["privileged"]`

    def __post_init__(self) -> None:
        check_settings(
            self,
            rollout=COUNT,
            batch=COUNT,
            epochs=COUNT,
            learning_rate=POSITIVE,
            last_learning_rate=NOT_NEGATIVE,
            discount=SHARE,
            trace=SHARE,
            clip=POSITIVE,
            value=NOT_NEGATIVE,
            entropy=NOT_NEGATIVE,
            gradient_norm=POSITIVE,
            deviation=POSITIVE,
        )


@dataclass
class Rollout:
    """Steps of all environments; tensors (T, N, …)."""

    observations: Tensor
    critic_inputs: Tensor
    starts: Tensor  # true where an episode starts with this observation
    actions: Tensor
    log_probs: Tensor
    values: Tensor
    advantages: Tensor
    actor_memory: Tensor  # (N, h), before the first step
    critic_memory: Tensor

    def sequences(self) -> list[Tensor]:
        """All but the memories, in the order of the fields."""
        return list(vars(self).values())[:-2]


class PPO(Learner):
    """PPO on a task."""

    columns = ("reward", "success", "deviation", "value_loss", "clipped")

    def __init__(
        self, task: TaskBatch, architecture: ActorArchitecture, settings: PPOSettings, *, seed: int, steps: int
    ) -> None:
        """`steps` is the number of environment steps until the learning rate has decreased to its last value."""
        super().__init__(task, architecture)
        self._recurrent = architecture.recurrent > 0
        _check_minibatches(task, settings, recurrent=self._recurrent)
        self._actions = architecture.actions
        torch.manual_seed(seed)  # initial weights
        self._settings, self._total = settings, steps
        self._actor = TorchActor(architecture)
        self._critic = TorchActor(_critic_architecture(task, architecture, settings))
        self._log_deviation = nn.Parameter(torch.full((architecture.actions,), float(np.log(settings.deviation))))
        self._parameters = [*self._actor.parameters(), *self._critic.parameters(), self._log_deviation]
        self._optimizer = torch.optim.Adam(self._parameters, settings.learning_rate, eps=1e-5)
        self._rng = np.random.default_rng([seed, 0])
        self._noise = torch.Generator().manual_seed(seed)
        self._return = np.zeros(task.num_envs)  # discounted return so far, whose deviation scales the rewards
        self._return_moments = np.zeros(3)  # count, sum, sum of squares
        self.restart_episodes()

    def restart_episodes(self) -> None:
        """Starts new episodes in all environments."""
        n = self.task.num_envs
        self.task.reset(self.task.all, self._rng)
        self._starts = torch.ones(n, dtype=torch.bool)
        self._actor_memory, self._critic_memory = self._actor.initial_memory(n), self._critic.initial_memory(n)
        self._return[:] = 0
        self._in_first = np.ones(n, dtype=bool)  # environments whose first episode since the restart has not ended
        self._successes: list[bool] = []  # of the episodes that ended since the restart and are in no row yet

    def update(self) -> dict[str, float]:
        """Collects one rollout and learns from it."""
        if self.steps == 0 and isinstance(self._actor.encoder, VectorEncoder):
            self._calibrate()
        with self.clock.timed("simulation"):
            rollout, numbers = self._collect()
        with self.clock.timed("learning"):
            return numbers | self._learn(rollout)

    @torch.no_grad()
    def _calibrate(self) -> None:
        """Initializes the normalization of the observations by one rollout of random actions."""
        with self.clock.timed("simulation"):
            n, k = self.task.num_envs, self._actions
            for _ in range(self._settings.rollout):
                self._actor.absorb(torch.from_numpy(self.task.observation))
                self._critic.absorb(self._critic_inputs())
                self.task.step(self._rng.uniform(-1, 1, (n, k)), self._rng)
                if (done := self.task.terminated | self.task.truncated).any():
                    self.task.reset(done, self._rng)
        self.steps += n * self._settings.rollout
        self.restart_episodes()

    @torch.no_grad()
    def _collect(self) -> tuple[Rollout, dict[str, float]]:
        """Acts for `rollout` steps in all environments."""
        task, s = self.task, self._settings
        rows: list[tuple[Tensor, ...]] = []
        rewards, final_values, mean_rewards = [], [], []
        memories = self._actor_memory, self._critic_memory
        deviation = self._log_deviation.exp()
        for _ in range(s.rollout):
            observation, critic_input = torch.from_numpy(task.observation.copy()), self._critic_inputs()
            mean, self._actor_memory = self._actor(observation, self._actor_memory)
            value, self._critic_memory = self._critic(critic_input, self._critic_memory)
            action = mean + deviation * torch.randn(mean.shape, generator=self._noise)
            rows.append((observation, critic_input, self._starts, action, self._log_prob(mean, action), value[:, 0]))
            task.step(action.clamp(-1, 1).numpy(), self._rng)
            done = task.terminated | task.truncated
            mean_rewards.append(task.reward.mean())
            self._successes.extend(task.info["success"][done])
            self._in_first &= ~done
            rewards.append(self._scaled_reward(done))
            final_values.append(self._value_after_truncation())
            self._begin(done)
        self.steps += task.num_envs * s.rollout
        columns = [torch.stack(column) for column in zip(*rows, strict=True)]
        last_value = self._critic(self._critic_inputs(), self._critic_memory)[0][None, :, 0]
        ends = torch.cat([columns[2][1:], self._starts[None]])
        next_values = torch.where(ends, torch.stack(final_values), torch.cat([columns[5][1:], last_value]))
        advantages = _advantages(torch.stack(rewards), columns[5], next_values, ends, s)
        numbers = {
            "reward": float(np.mean(mean_rewards)),
            "success": self._success_rate(),
            "deviation": float(deviation.mean()),
        }
        return Rollout(*columns, advantages, *memories), numbers  # type: ignore[call-arg]

    def _success_rate(self) -> float:
        """Success rate of the episodes that ended since the last rate; nan until every environment has ended one.

        After a restart all episodes start together, so the first ones to end are short: their success rate is biased.
        """
        if self._in_first.any() or not self._successes:
            return float("nan")
        rate = float(np.mean(self._successes))
        self._successes.clear()
        return rate

    def _value_after_truncation(self) -> Tensor:
        """Values (N,) of the last observations where an episode would have continued, 0 where its task ended it.

        An episode whose simulation failed is truncated too: the value 0 would reward it where rewards are negative.
        """
        continues = self.task.truncated
        if not continues.any():
            return torch.zeros(self.task.num_envs)
        values: Tensor = self._critic(self._critic_inputs(), self._critic_memory)[0][:, 0]
        return values * torch.from_numpy(continues)

    def _begin(self, done: NDArray[np.bool_]) -> None:
        """Starts new episodes in the environments that are `done`."""
        if done.any():
            self.task.reset(done, self._rng)
        self._starts = torch.from_numpy(done.copy())
        going = (~self._starts)[:, None]
        self._actor_memory, self._critic_memory = self._actor_memory * going, self._critic_memory * going

    def _scaled_reward(self, done: NDArray[np.bool_]) -> Tensor:
        """The rewards divided by the standard deviation of the discounted return, so that values are of order 1."""
        self._return = self._settings.discount * self._return + self.task.reward
        self._return_moments += [self._return.size, self._return.sum(), (self._return**2).sum()]
        self._return[done] = 0
        count, total, squares = self._return_moments
        deviation = np.sqrt(max(squares / count - (total / count) ** 2, 1e-8))
        return torch.from_numpy((self.task.reward / deviation).astype(np.float32))

    def _critic_inputs(self) -> Tensor:
        """Observations of the critic: those of the actor, or privileged quantities (with the actor's, if vectors)."""
        observation = torch.from_numpy(self.task.observation.copy())
        if not self._settings.privileged_critic:
            return observation
        privileged = torch.from_numpy(self.task.info["privileged"].astype(np.float32))
        return torch.cat([observation, privileged], 1) if observation.ndim == 2 else privileged

    def _log_prob(self, mean: Tensor, action: Tensor) -> Tensor:
        """Logarithm of the probability density of actions, up to a constant."""
        return -(0.5 * ((action - mean) / self._log_deviation.exp()) ** 2 + self._log_deviation).sum(-1)

    def _learn(self, rollout: Rollout) -> dict[str, float]:
        """Improves actor and critic on a rollout."""
        s = self._settings
        progress = min(1.0, self.steps / self._total)
        for group in self._optimizer.param_groups:
            group["lr"] = s.learning_rate * (1 + progress * (s.last_learning_rate - 1))
        losses, clipped = [], []
        for _ in range(s.epochs):
            for sample in self._minibatches(rollout):
                mean, value = self._evaluate(sample)
                ratio = (self._log_prob(mean, sample.actions) - sample.log_probs).exp()
                advantage = (sample.advantages - sample.advantages.mean()) / (sample.advantages.std() + 1e-8)
                gain = torch.min(ratio * advantage, ratio.clamp(1 - s.clip, 1 + s.clip) * advantage)
                value_loss = (value - sample.values - sample.advantages).square().mean()
                loss = -gain.mean() + s.value * value_loss - s.entropy * self._log_deviation.sum()
                self._optimizer.zero_grad()
                loss.backward()
                nn.utils.clip_grad_norm_(self._parameters, s.gradient_norm)
                self._optimizer.step()
                losses.append(value_loss.item())
                clipped.append(((ratio - 1).abs() > s.clip).float().mean().item())
        # The statistics change after the update, since the ratio of probabilities requires those of the rollout.
        self._actor.absorb(rollout.observations.flatten(0, 1))
        self._critic.absorb(rollout.critic_inputs.flatten(0, 1))
        return {"value_loss": float(np.mean(losses)), "clipped": float(np.mean(clipped))}

    def _minibatches(self, rollout: Rollout) -> list[Rollout]:
        """Random parts of a rollout: single steps (1, batch, …), or whole sequences (T, n, …) if recurrent.

        A part of one step is omitted: the advantages of a minibatch are relative to their mean.
        """
        steps, envs = rollout.log_probs.shape
        size = self._settings.batch
        if self._recurrent:
            order = torch.randperm(envs, generator=self._noise).split(_sequences(size, steps))
            order = [i for i in order if steps * len(i) > 1]
            parts = [[value[:, i] for value in rollout.sequences()] for i in order]
            memories = [(rollout.actor_memory[i], rollout.critic_memory[i]) for i in order]
        else:
            order = torch.randperm(steps * envs, generator=self._noise).split(size)
            order = [i for i in order if len(i) > 1]
            flat = [value.flatten(0, 1) for value in rollout.sequences()]
            parts = [[value[None, i] for value in flat] for i in order]
            memories = [(torch.zeros(0), torch.zeros(0))] * len(parts)
        return [Rollout(*part, *memory) for part, memory in zip(parts, memories, strict=True)]  # type: ignore[call-arg]

    def _evaluate(self, sample: Rollout) -> tuple[Tensor, Tensor]:
        """Means of the actions (T, n, k) and values (T, n) under the present networks."""
        actor_memory, critic_memory = sample.actor_memory, sample.critic_memory
        means, values = [], []
        for t in range(len(sample.starts)):
            if self._recurrent:
                going = (~sample.starts[t])[:, None]
                actor_memory, critic_memory = actor_memory * going, critic_memory * going
            mean, actor_memory = self._actor(sample.observations[t], actor_memory)
            value, critic_memory = self._critic(sample.critic_inputs[t], critic_memory)
            means.append(mean)
            values.append(value[:, 0])
        return torch.stack(means), torch.stack(values)

    def tensors(self) -> dict[str, NDArray[np.float32]]:
        """The tensors of the actor."""
        return self._actor.tensors()

    def state(self) -> RunState:
        """Everything that determines the next updates, except the episodes, which are restarted."""
        state = RunState()
        state.add("actor", self._actor.state_dict())
        state.add("critic", self._critic.state_dict())
        state.add("optimizer", optimizer_tensors(self._optimizer))
        state.add(
            "other",
            {
                "log_deviation": self._log_deviation,
                "noise": self._noise.get_state(),
                "return_moments": torch.from_numpy(self._return_moments.copy()),
            },
        )
        state.values |= {"rng": generator_value(self._rng), "steps": self.steps}
        return state

    def load(self, state: RunState) -> None:
        """Restores `state`."""
        self._actor.load_state_dict(state.part("actor"))
        self._critic.load_state_dict(state.part("critic"))
        load_optimizer_tensors(self._optimizer, state.part("optimizer"))
        other = state.part("other")
        with torch.no_grad():
            self._log_deviation.copy_(other["log_deviation"])
        self._noise.set_state(other["noise"])
        self._return_moments = other["return_moments"].numpy().copy()
        self._rng = generator_from(state.values["rng"])
        self.steps = state.values["steps"]


def _sequences(batch: int, steps: int) -> int:
    """Number of sequences of `steps` steps in a minibatch of a recurrent actor."""
    return max(1, batch // steps)


def _check_minibatches(task: TaskBatch, s: PPOSettings, *, recurrent: bool) -> None:
    """Raises UsageError when every minibatch has one step: its advantage relative to their mean is 0."""
    largest = s.rollout * min(task.num_envs, _sequences(s.batch, s.rollout)) if recurrent else s.batch
    if min(largest, s.rollout * task.num_envs) < 2:
        raise UsageError(
            f"PPO learns nothing from minibatches of one step: rollout {s.rollout}, batch {s.batch} and "
            f"{task.num_envs} environments; increase them"
        )


def _advantages(rewards: Tensor, values: Tensor, next_values: Tensor, ends: Tensor, s: PPOSettings) -> Tensor:
    """Generalized advantage estimation (Schulman et al. 2016); `ends[t]` is true where step t ended an episode."""
    errors = rewards + s.discount * next_values - values
    advantages = torch.zeros_like(errors)
    advantage = torch.zeros_like(errors[0])
    for t in reversed(range(len(errors))):
        advantage = errors[t] + s.discount * s.trace * advantage * ~ends[t]
        advantages[t] = advantage
    return advantages


def _critic_architecture(task: TaskBatch, actor: ActorArchitecture, settings: PPOSettings) -> ActorArchitecture:
    """The architecture of the actor with one output, or a perceptron of privileged quantities."""
    values: dict[str, Any] = {**vars(actor), "actions": 1}
    if not settings.privileged_critic:
        return type(actor)(**values)
    privileged = task.info["privileged"].shape[1]
    if not privileged:
        raise UsageError(f"task {task.description.name} has no privileged quantities for a critic")
    size = privileged + (actor.observation_shape[0] if len(actor.observation_shape) == 1 else 0)
    hidden = actor.hidden if isinstance(actor, MLP) else (64, 64)
    return MLP(observation_shape=(size,), actions=1, hidden=hidden)
